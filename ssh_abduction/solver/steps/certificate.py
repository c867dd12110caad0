"""A certificate that proves a lower bound on the number of dstates.

`checker/claims.py` checks certificates without a solver.

>>> from ssh_abduction import Trace, solve
>>> trace = Trace.from_steps(["a", "b", "a", "c"], ["travel", "travel", "travel"])
>>> solve(trace).certificate.clique
(0, 1, 2, 3)
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from ssh_abduction.data.trace import Trace
from ssh_abduction.data.words import counted
from ssh_abduction.theory.speedups import CAUSAL

# Steps that are apart (the same actions lead from them to different views) are different dstates
# by these axioms.
RESTS_ON = CAUSAL


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

    def to_dict(self) -> dict[str, Any]:
        """Return the certificate as plain data."""
        return {"clique": list(self.clique), "refuted": list(self.refuted)}


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
