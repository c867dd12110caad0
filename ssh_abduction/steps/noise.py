"""The step at which a trace looks like noise: because of it alone, most steps before it are dstates of their own.

A robot that goes round in circles learns no new dstate, as each circuit shows what the ones before did. One wrong view, or one step left out of the log, and
each step of all circuits before is told apart from all others by how far it is from there: the map has as many dstates as the trace has steps, and the axioms allow no
smaller one. That is seen without a map: of the steps up to there a largest clique of steps that are apart (apart.py) is nearly all of them, or two thirds where the
same is seen in several places of a circuit and other things are done there; and of the steps before it was small. Where a robot explores, the clique grows with each new dstate, little by little.

>>> from ssh_abduction.steps.noise import noise_in
>>> circuits = [0, 1, 2, 3] * 8
>>> noise_in(circuits, [0] * 31)
>>> noise_in([*circuits, 2], [0] * 32)
Noise(step=32, told_apart=32, without=4)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ssh_abduction.trace import Trace

LEAST = 20  # steps of a trace, from which on it is asked
MOST = 0.5  # share of the steps up to there that are dstates of their own, at least
FALL = 0.5  # share of them, at most, that are left without the step


@dataclass(frozen=True, slots=True)
class Noise:
    """A step that looks like noise.

    step        that does
    told_apart  how many of the steps up to there are dstates of their own, with it
    without     how many of all steps have to be, if that step tells none of them apart
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
    short, long = 0, len(views)  # the clique grows with the prefix: between these it comes to be more than half of what it is in the end
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
    without = len(_clique(views, _cut(actions, short), len(views)))
    return Noise(short, up_to_there, without) if without <= FALL * up_to_there else None


def _clique(views: Sequence[int], actions: Sequence[int], steps: int) -> list[int]:
    """A largest clique of the first steps that are apart."""
    from ssh_abduction.steps.apart import Continuations  # loads numpy, which takes longer than to solve a short trace

    return Continuations(views[:steps], actions[: steps - 1]).clique()


def _cut(actions: Sequence[int], step: int) -> list[int]:
    """Actions, of which those to and from a step are like no other: what was seen beyond them tells no steps apart."""
    other = max(actions, default=0) + 1
    return [other + t if t in (step - 1, step) else action for t, action in enumerate(actions)]
