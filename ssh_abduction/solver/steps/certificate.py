"""A certificate that proves a lower bound on the number of dstates.

`checker/proof.py` checks certificates without a solver.

>>> from ssh_abduction import Trace, solve
>>> trace = Trace.from_steps(["a", "b", "a", "c"], ["travel", "travel", "travel"])
>>> solve(trace).certificate.clique
(0, 1, 2, 3)
>>> solve(trace).certificate.words(trace)[0, 2]
('travel',)
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any

from ssh_abduction.data.errors import SolverError
from ssh_abduction.data.groups import gathered
from ssh_abduction.data.trace import Trace, checked_trace
from ssh_abduction.data.words import counted
from ssh_abduction.solver.steps.noise import Noise, noise_in
from ssh_abduction.theory.speedups import CAUSAL

# Steps that are apart (the same actions lead from them to different views) are different dstates
# by these axioms.
RESTS_ON = CAUSAL
# Write a certificate with its words only if they have at most this many actions together, which are
# some megabytes. The number of actions may grow with the cube of the number of steps. A checker can
# compute the words again.
WRITTEN = 500_000


@dataclass(frozen=True, slots=True)
class Certificate:
    """A certificate that no map has fewer than `bound` dstates.

    Attributes:
        clique: Steps that are pairwise distinct, so each is a dstate of its own.
        refuted: The numbers of dstates for which clingo has proven that there is no map. They begin
            at the size of the clique and have no gap.
    """

    clique: tuple[int, ...]
    refuted: tuple[int, ...] = ()

    def __repr__(self) -> str:
        refuted = (
            f", and clingo refuted {counted(len(self.refuted), 'sizes')}" if self.refuted else ""
        )
        bound, steps = counted(self.bound, "dstates"), counted(len(self.clique), "steps")
        return f"<Certificate: at least {bound}; {steps} are pairwise apart{refuted}>"

    @property
    def bound(self) -> int:
        """The proven lower bound on the number of dstates of a map."""
        return len(self.clique) + len(self.refuted)

    def words(self, trace: Trace) -> dict[tuple[int, int], tuple[str, ...]]:
        """Return the words that distinguish the steps of the clique.

        The word of two steps is the sequence of actions that leads from both to different views. It
        is empty if their own views differ.

        Returns:
            For each pair of steps (the earlier one first) the names of the actions.

        Raises:
            SolverError: Two steps of the clique are not distinguished in this trace.
        """
        checked_trace(trace)
        return {pair: _word(trace, *pair) for pair in combinations(self.clique, 2)}

    def to_dict(self, trace: Trace | None) -> dict[str, Any]:
        """Return the certificate as plain data: "clique", "refuted", and perhaps "words".

        Pairs of steps with different views need no word, so they are left out.

        Args:
            trace: The trace, for the words. If it is None, or the words have more than WRITTEN
                actions together, there are no words.
        """
        if trace is None:
            return {"clique": list(self.clique), "refuted": list(self.refuted)}
        checked_trace(trace)
        words: list[list[Any]] = []
        written = 0
        for i, j in self._pairs_alike(trace):
            word = _word(trace, i, j)
            words.append([i, j, list(word)])
            written += len(word)
            if written > WRITTEN:
                return {"clique": list(self.clique), "refuted": list(self.refuted)}
        return {"clique": list(self.clique), "words": words, "refuted": list(self.refuted)}

    def _pairs_alike(self, trace: Trace) -> Iterator[tuple[int, int]]:
        """Yield only the pairs of steps of the clique that show the same view, in order."""
        alike = gathered((trace.steps[step].view, step) for step in self.clique)
        for i in self.clique:
            same = alike[trace.steps[i].view]
            yield from ((i, j) for j in same[bisect_right(same, i) :])


@dataclass(frozen=True)
class Basis:
    """The data for a certificate, which is made when it is first used.

    Making a certificate takes as long as solving a short trace.

    Attributes:
        views: The view of each of the first steps of the trace, as a number.
        actions: The action after each of these steps but the last, as a number.
        bound: The proven lower bound on dstates; 0 if none is proven.
    """

    views: tuple[int, ...]
    actions: tuple[int, ...]
    bound: int

    @cached_property
    def certificate(self) -> Certificate:
        """The certificate."""
        # Imported here, as loading numpy takes longer than solving a short trace.
        from ssh_abduction.solver.steps.apart import Continuations

        clique = tuple(Continuations(self.views, self.actions).clique())
        return Certificate(clique, tuple(range(len(clique), self.bound)))

    @cached_property
    def noise(self) -> Noise | None:
        """The step that looks like noise; None if there is none."""
        return noise_in(self.views, self.actions)


def _word(trace: Trace, i: int, j: int) -> tuple[str, ...]:
    """Return actions that lead from both steps to different views; SolverError if none do."""
    word: list[str] = []
    while True:
        here, there = trace.steps[i + len(word)], trace.steps[j + len(word)]
        if here.view != there.view:
            return tuple(word)
        if here.action is None or there.action is None or here.action.name != there.action.name:
            raise SolverError(
                f"clique: expected steps that are apart, got {i} and {j}, which may be one "
                "dstate; leave out one of them"
            )
        word.append(here.action.name)
