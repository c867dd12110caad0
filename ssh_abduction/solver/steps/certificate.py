"""A certificate that proves a lower bound on the number of dstates.

`checker/claims.py` checks certificates without a solver.

>>> from ssh_abduction import Trace, solve
>>> trace = Trace.from_steps(["a", "b", "a", "c"], ["travel", "travel", "travel"])
>>> solve(trace).certificate.clique
(0, 1, 2, 3)
>>> solve(trace).certificate.words(trace)[0, 2]
('travel',)
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any

from ssh_abduction.data.errors import SolverError
from ssh_abduction.data.groups import gathered
from ssh_abduction.data.trace import Trace, checked_trace
from ssh_abduction.data.words import counted
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
        written: dict[str, Any] = {"clique": list(self.clique), "refuted": list(self.refuted)}
        if trace is None:
            return written
        checked_trace(trace)
        words, actions = list[list[Any]](), 0
        for i, j in self._pairs_alike(trace):
            words.append([i, j, list(_word(trace, i, j))])
            actions += len(words[-1][2])
            if actions > WRITTEN:
                return written
        return {**written, "words": words}

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


# None of this many first steps is called noise, as a robot may begin with new dstates only.
LEAST = 20
# A step is noise only if at least this share of the steps up to it are dstates of their own.
MOST = 0.5
# A step is noise only if two cliques have at most this share of the size of the clique up to the
# step: the clique of the steps before, and the clique of the whole trace without the step. A step
# that doubles the clique is no exploration, as exploring adds at most one dstate per step.
FALL = 0.5


@dataclass(frozen=True, slots=True)
class Noise:
    """A step that looks like noise.

    Attributes:
        step: The number of the step.
        told_apart: The number of steps up to this one that must be different dstates.
        without: The number of steps of the whole trace that must be different dstates if this step
            is ignored.
    """

    step: int
    told_apart: int
    without: int

    def sentence(self, trace: Trace) -> str:
        """Return the warning for a user, as a sentence."""
        return (
            f"{trace.at(self.step)}: view {trace.steps[self.step].view!r} looks like noise at step "
            f"{self.step}: it forces {self.told_apart} of the {self.step + 1} steps up to there to "
            f"be different dstates. Without it, only {self.without} of all steps have to be; look "
            "at what was seen and done there, and mend the trace"
        )


def noise_in(views: Sequence[int], actions: Sequence[int]) -> Noise | None:
    """Find the step that looks like noise; None if there is none. Takes n log³ n for n steps."""
    if len(views) <= LEAST:
        return None
    fewest = len(_clique(views, actions, len(views))) / 2
    # The clique grows with the number of first steps. Bisect for the step at which it passes half
    # of its final size.
    sizes = range(len(views))
    long = bisect_left(
        sizes, True, lo=1, key=lambda size: len(_clique(views, actions, size)) > fewest
    )
    short = long - 1
    if long <= LEAST:
        return None
    before, up_to_there = len(_clique(views, actions, short)), len(_clique(views, actions, long))
    if up_to_there < MOST * long or not 1 < before <= FALL * up_to_there:
        return None
    # Replace the actions to and from the step by actions that occur only once. Then neither its
    # view nor any later step distinguishes earlier steps.
    other = max(actions, default=0) + 1
    cut_off = [other + t if t in (short - 1, short) else action for t, action in enumerate(actions)]
    without = len(_clique(views, cut_off, len(views)))
    return Noise(short, up_to_there, without) if without <= FALL * up_to_there else None


def _clique(views: Sequence[int], actions: Sequence[int], steps: int) -> list[int]:
    """Find a largest clique of the first `steps` steps: steps that are pairwise apart."""
    # Imported here, as loading numpy takes longer than solving a short trace.
    from ssh_abduction.solver.steps.apart import Continuations

    return Continuations(views[:steps], actions[: steps - 1]).clique()
