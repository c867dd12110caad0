"""The step at which a trace looks like noise: because of it alone, most steps before it are dstates of their own.

A robot that goes round in circles learns no new dstate, as each circuit shows what the ones before did. After one wrong view, or one step left out of the log,
each step of all circuits before is told apart from all others by how far it is from there. So the map has as many dstates as the trace has steps, and the axioms
allow no smaller one. That can be seen without a map: a largest clique of steps that are apart (apart.py) was small before that step, and with it is nearly all
steps, or two thirds of them where the same is seen in several places of a circuit and other things are done there. Where a robot explores, the clique grows with each new dstate, little by little.

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

# No step looks like noise among the first so many steps, nor in a trace that is no longer: a robot that has just begun may well be somewhere new at each step.
LEAST = 20
# A step looks like noise only if because of it at least this share of the steps up to there have to be dstates of their own.
MOST = 0.5
# And only if at most this share of those dstates is needed for the steps before it, and for the whole trace without it: one step that makes twice as many dstates
# necessary stands out from a robot that explores, where each step adds one at most.
FALL = 0.5


@dataclass(frozen=True, slots=True)
class Noise:
    """A step that looks like noise.

    step        the number of the step
    told_apart  how many of the steps up to this one have to be dstates of their own because of it
    without     how many steps of the whole trace have to be dstates of their own if this step tells none of them apart
    """

    step: int
    told_apart: int
    without: int

    def sentence(self, trace: Trace) -> str:
        """What a user is told."""
        return (
            f"{trace.at(self.step)}: view {trace.steps[self.step].view!r} looks like noise at step {self.step}: because of it {self.told_apart} of the "
            f"{self.step + 1} steps up to there have to be dstates of their own, and without it no more than {self.without} of all steps; "
            "look at what was seen and done there, and mend the trace"
        )


def noise_in(views: Sequence[int], actions: Sequence[int]) -> Noise | None:
    """The step that looks like noise, if one does. Takes n log³ n for n steps.

    views    what was seen at each step, as numbers
    actions  what was done after each step but the last, as numbers
    """
    if len(views) <= LEAST:
        return None
    fewest = len(_clique(views, actions, len(views))) / 2
    # The clique grows with the prefix. By bisection: the step with which it comes to be more than half of what it is in the end.
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
    """A largest clique of the first steps that are apart."""
    from ssh_abduction.solver.steps.apart import (
        Continuations,
    )  # loads numpy, which takes longer than to solve a short trace

    return Continuations(views[:steps], actions[: steps - 1]).clique()


def _cut_off(actions: Sequence[int], step: int) -> list[int]:
    """The actions, where those to and from one step are made unlike all others. So what was seen at that step and beyond it tells no earlier steps apart."""
    other = max(actions, default=0) + 1
    return [other + t if t in (step - 1, step) else action for t, action in enumerate(actions)]
