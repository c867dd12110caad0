"""Keeps "is the same place as" transitive in answers of visits.lp.

The rules of transitivity are not grounded beforehand, as there are millions of threes of visits.
`intransitive` finds the threes at which an answer fails. `Transitive` is a propagator for listing
many answers.
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from typing import TypeAlias

import clingo
import numpy as np

from ssh_abduction.solver.asp.facts import visits_lp
from ssh_abduction.solver.steps.chart import FramedChart

# Give clingo at most this many threes of visits at once: they are found faster than grounded.
AT_A_TIME = 20_000

# Visits I < J at one place, where slot 0 of I is slot R of J.
Pair: TypeAlias = tuple[int, int, int]
# Visits I < J < K at one place, and how I is turned to J, and J to K.
Three: TypeAlias = tuple[int, int, int, int, int]
# For each visit, the visits at its place, each with the slot that is its own slot 0.
Turned: TypeAlias = dict[int, dict[int, int]]


def intransitive(pairs: Sequence[Pair], fits: Set[Pair], chart: FramedChart) -> list[Three]:
    """Threes of visits at which an answer, with what follows from it, is not transitive.

    Args:
        pairs: The visits that are at one place in the answer.
        fits: The pairs that may be at one place for clingo.
        chart: The visits, and how they end.
    """
    found: dict[Three, None] = {}
    turned: Turned = {}
    leaves = chart.leaves
    work = scattered(pairs, len(chart.stars))
    if not work:
        return []
    for pair in pairs:
        take(turned, pair)
    for i, j, r in work:
        # If two visits are one and end alike, the next visits are also one.
        follows = (
            [(i + 1, j + 1, 0)]
            if i in leaves and leaves.get(j) == ((leaves[i][0] + r) % 4, leaves[i][1])
            else []
        )
        for first, (middle, half), (last, turn) in apart_yet_joined((i, j, r), turned):
            found[_in_order((first, 0), (middle, half), (last, turn))] = None
            follows.append(ordered_pair(first, last, turn))
        for pair in follows:
            if pair in fits and pair[1] not in turned.get(pair[0], ()):
                take(turned, pair)
                work.append(pair)
        if len(found) >= AT_A_TIME:
            break
    return list(found)


class Transitive(clingo.Propagator):
    """A propagator for listing: there are few conflicts, and each answer has to be transitive.

    Attributes:
        asked: Whether the propagator is at work.
        failed: How often an answer was not transitive since this was set to 0.
        literals: The program literals of pairs of visits.
    """

    def __init__(self) -> None:
        self.asked = False
        self.failed = 0
        self.literals: dict[Pair, int] = {}
        self._watched: dict[int, list[Pair]] = {}
        self._literals: dict[Pair, int] = {}  # the solver literals
        self._turned: Turned = {}

    def init(self, init: clingo.PropagateInit) -> None:
        """Watch the literals of pairs, and note those that are true."""
        for literal in self._watched:
            init.remove_watch(literal)
        self._watched, self._turned = {}, {}
        if not self.asked:
            return
        for pair, program_literal in self.literals.items():
            literal = self._literals[pair] = init.solver_literal(program_literal)
            self._watched.setdefault(literal, []).append(pair)
            if init.assignment.is_true(literal):
                take(self._turned, pair)
        for literal in self._watched:
            init.add_watch(literal)

    def propagate(self, control: clingo.PropagateControl, changes: Sequence[int]) -> None:
        """Add a clause for each three of visits that is not transitive."""
        pairs = [pair for literal in changes for pair in self._watched.get(literal, ())]
        for pair in pairs:
            take(self._turned, pair)
        for pair in pairs:
            for first, (middle, half), (last, turn) in apart_yet_joined(pair, self._turned):
                self.failed += 1
                clause = [
                    -self._literals[pair],
                    -self._literals[ordered_pair(middle, last, (turn - half) % 4)],
                ]
                if (third := self._literals.get(ordered_pair(first, last, turn))) is not None:
                    clause.append(third)
                if not control.add_clause(clause, lock=True) or not control.propagate():
                    return

    def undo(self, thread: int, assignment: clingo.Assignment, changes: Sequence[int]) -> None:
        """Forget pairs whose literals are no longer true."""
        for literal in changes:
            for i, j, _ in self._watched.get(literal, ()):
                self._turned.get(i, {}).pop(j, None)
                self._turned.get(j, {}).pop(i, None)


class PairOf(dict[clingo.Symbol, Pair]):
    """The visits that an atom says are one; each atom is read once."""

    def __missing__(self, symbol: clingo.Symbol) -> Pair:
        pair = self[symbol] = visits_lp.read_same(symbol)
        return pair


def scattered(pairs: Sequence[Pair], visits: int) -> list[Pair]:
    """The pairs whose group of visits is not yet a consistent clique.

    A group is consistent if each two of its visits are a pair, turned as the others say.
    """
    first, second, turns = np.array(pairs, dtype=int).reshape(-1, 3).T
    group = np.arange(visits)  # the first visit that each is one with
    np.minimum.at(group, second, first)
    turned = np.zeros(visits, dtype=int)  # the slot that slot 0 of that visit is
    at_first = group[second] == first
    turned[second[at_first]] = turns[at_first]
    members, joined = (
        np.bincount(group, minlength=visits),
        np.bincount(group[first], minlength=visits),
    )
    wrong = (group[first] != group[second]) | ((turned[second] - turned[first]) % 4 != turns)
    bad = joined != members * (members - 1) // 2
    bad[group[first[wrong]]] = bad[group[second[wrong]]] = True
    found = bad[group[first]] | bad[group[second]]
    return [pair for pair, is_bad in zip(pairs, found, strict=True) if is_bad]


def take(turned: Turned, pair: Pair) -> None:
    """Note that two visits are at one place."""
    i, j, r = pair
    turned.setdefault(i, {})[j] = r
    turned.setdefault(j, {})[i] = -r % 4


def apart_yet_joined(
    pair: Pair, turned: Turned
) -> list[tuple[int, tuple[int, int], tuple[int, int]]]:
    """Visits that are not the same though each is the same as a third one.

    The third one is one of this pair.

    Returns:
        Triples: the first visit, the third one, and the last one. The latter two come with the
        slot that slot 0 of the first would be.
    """
    i, j, r = pair
    of_i, of_j = turned[i], turned[j]
    joined = [
        (i, (j, r), (k, (r + q) % 4))
        for k, q in of_j.items()
        if k != i and of_i.get(k) != (r + q) % 4
    ]
    return joined + [
        (j, (i, -r % 4), (k, (q - r) % 4))
        for k, q in of_i.items()
        if k != j and of_j.get(k) != (q - r) % 4
    ]


def ordered_pair(i: int, j: int, r: int) -> Pair:
    """Two visits in order, where slot 0 of the one is slot R of the other."""
    return (i, j, r) if i < j else (j, i, -r % 4)


def _in_order(*visits: tuple[int, int]) -> Three:
    """Three visits at one place, each given with the slot that slot 0 of the first one is."""
    (i, a), (j, b), (k, c) = sorted(visits)
    return i, j, k, (b - a) % 4, (c - b) % 4
