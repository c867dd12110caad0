"""Find a noisy step: because of it alone, most earlier steps are dstates of their own.

A robot that goes round in circles finds no new dstates. But after one wrong view, or one missing
step in the log, each earlier step differs from all others by its distance to that step. The axioms
then allow no map with fewer dstates than the trace has steps.

The largest *clique* (set of steps that are different dstates in every map, see `apart.py`) shows
this without a map. The clique of the steps before the noisy step is small. With the noisy step, the
clique has nearly all steps, or two thirds of them if several places of a circuit look the same and
different actions follow there. When a robot only explores, the clique grows by one with each new
dstate.

>>> from ssh_abduction.solver.steps.noise import noise_in
>>> circuits = [0, 1, 2, 3] * 8
>>> noise_in(circuits, [0] * 31)
>>> noise_in([*circuits, 2], [0] * 32)
Noise(step=32, told_apart=32, without=4)
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass

from ssh_abduction.data.trace import Trace

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
