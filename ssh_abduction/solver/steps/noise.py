"""Find a noisy step: because of it alone, most earlier steps are dstates of their own.

A robot that goes round in circles finds no new dstates. But after one wrong view, or one missing
step in the log, each earlier step differs from all others by its distance to that step. The axioms
then allow no map with fewer dstates than the trace has steps. The largest clique of steps that are
apart (apart.py) shows this without a map. It is small before the noisy step. With it, it has nearly
all steps, or two thirds of them if a circuit shows the same in several places where different
actions follow. When a robot explores, the clique grows by one with each new dstate.

>>> from ssh_abduction.solver.steps.noise import noise_in
>>> circuits = [0, 1, 2, 3] * 8
>>> noise_in(circuits, [0] * 31)
>>> noise_in([*circuits, 2], [0] * 32)
Noise(step=32, told_apart=32, without=4)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ssh_abduction.data.trace import Trace

# No step is noise among this many first steps, as a robot may begin with a new dstate at each step.
LEAST = 20
# A step is noise only if it makes at least this share of the steps up to it dstates of their own.
MOST = 0.5
# The steps before it, and the whole trace without it, must need at most this share of those
# dstates. A step that doubles the dstates is no exploration, where each step adds one at most.
FALL = 0.5


@dataclass(frozen=True, slots=True)
class Noise:
    """A step that looks like noise.

    Attributes:
        step: The number of the step.
        told_apart: The number of steps up to this one that it makes dstates of their own.
        without: The number of steps of the whole trace that are dstates of their own if this
            step is ignored.
    """

    step: int
    told_apart: int
    without: int

    def sentence(self, trace: Trace) -> str:
        """The warning for a user."""
        return (
            f"{trace.at(self.step)}: view {trace.steps[self.step].view!r} looks like noise at step "
            f"{self.step}: because of it {self.told_apart} of the {self.step + 1} steps up to there"
            " have to be dstates of their own, and without it no more than "
            f"{self.without} of all steps; look at what was seen and done there, and mend the trace"
        )


def noise_in(views: Sequence[int], actions: Sequence[int]) -> Noise | None:
    """The step that looks like noise, or None. Takes n log³ n for n steps.

    Args:
        views: The view at each step, as a number.
        actions: The action after each step but the last, as a number.
    """
    if len(views) <= LEAST:
        return None
    fewest = len(_clique(views, actions, len(views))) / 2
    # The clique grows with the prefix. Bisect for the step that takes it past half of its final
    # size.
    short, long = 0, len(views)
    while long - short > 1:
        middle = (short + long) // 2
        if len(_clique(views, actions, middle)) > fewest:
            long = middle
        else:
            short = middle
    if long <= LEAST:
        return None
    before, up_to_there = len(_clique(views, actions, short)), len(_clique(views, actions, long))
    if up_to_there < MOST * long or not 1 < before <= FALL * up_to_there:
        return None
    without = len(_clique(views, _cut_off(actions, short), len(views)))
    return Noise(short, up_to_there, without) if without <= FALL * up_to_there else None


def _clique(views: Sequence[int], actions: Sequence[int], steps: int) -> list[int]:
    """A largest clique among the first steps."""
    # Imported here, as loading numpy takes longer than solving a short trace.
    from ssh_abduction.solver.steps.apart import Continuations

    return Continuations(views[:steps], actions[: steps - 1]).clique()


def _cut_off(actions: Sequence[int], step: int) -> list[int]:
    """The actions, with those to and from one step replaced by unique ones.

    So the view at that step, and the steps after it, distinguish no earlier steps.
    """
    other = max(actions, default=0) + 1
    return [other + t if t in (step - 1, step) else action for t, action in enumerate(actions)]
