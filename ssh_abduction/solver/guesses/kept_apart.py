"""Which dstates, and which places, the steps of a trace or an existing map keep apart."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ssh_abduction.data.groups import gathered
from ssh_abduction.theory.pairs import pairs_in
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.theory import Theory

if TYPE_CHECKING:
    from ssh_abduction.solver.guesses.placed_map import Part


class KeptApart:
    """The dstates (or the places) of a map that are two, because two of their steps are apart.

    Those of one piece of a map that must be kept are two, as well.
    """

    def __init__(
        self,
        labels: Mapping[int, int],
        pairs: Iterable[tuple[int, int]],
        kept: Iterable[tuple[int, int]] = (),
    ) -> None:
        """Read pairs of steps that are apart. `labels` numbers steps; other steps are left out.

        `kept` has the numbers that a map keeps apart from each other, each with its piece.
        """
        size = max(labels.values()) + 1
        self._apart = np.zeros((size, size), bool)
        for of_piece in gathered((piece, number) for number, piece in kept).values():
            self._apart[np.ix_(of_piece, of_piece)] = True
        for t, u in pairs:
            if t in labels and u in labels:
                self._apart[labels[t], labels[u]] = self._apart[labels[u], labels[t]] = True

    @staticmethod
    def of_places(
        problem: Problem, labels: Mapping[int, int], kept: Iterable[tuple[int, int]]
    ) -> KeptApart:
        """List the places that are apart by evidence, or as a travel leads from one to the other.

        Travels are ignored if they may stay at a place, or if actions may have slipped.
        """
        theory, actions = problem.theory, enumerate(problem.trace.actions)
        leaves = theory.level == "topological" and "travel_leaves" in theory.hard
        travels = [(t, t + 1) for t, action in actions if action.kind == "travel"]
        known = travels if leaves and not theory.slipped else []
        return KeptApart(labels, [*pairs_in(problem.pairs.elsewhere), *known], kept)

    def includes(self, merged: Sequence[int], first: int, second: int) -> bool:
        """Whether any number merged into `first` is apart from any that is merged into `second`.

        `merged` has, for each number, the number that it is merged into.
        """
        into = np.asarray(merged)
        return self._apart[np.ix_(into == first, into == second)].any().item()


def denied_pairs(theory: Theory, first: Part, second: Part) -> set[tuple[int, int]]:
    """List the pairs of dstates of two maps that a person says are different.

    If one action leads from two dstates to such a pair, they are different, too.
    """
    here, there = first.labels, second.labels
    said = (pair for i, j in (*theory.different, *theory.elsewhere) for pair in ((i, j), (j, i)))
    todo = {(here[i], there[j]) for i, j in said if i in here and j in there}
    found = set[tuple[int, int]]()
    while todo:
        found.add(pair := todo.pop())
        todo |= {
            (s, x)
            for (s, action), y in first.links.items()
            for (x, other), z in second.links.items()
            if action == other and (y, z) == pair
        } - found
    return found
