"""Guess missing displacements from the places that a map has on both sides of a gap.

A displacement is missing where a drive starts, or where it was not logged. Between two gaps lies a
*stretch* of steps. Dead reckoning gives the poses of its steps in a frame of its own. If two
stretches have a dstate or two places in common, this determines how their frames lie relative to
each other.

The guess is only a starting point: the misfit does not depend on it.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Collection, Iterator, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

# The direction from one place to another is too uncertain to use if they are closer than this many
# metres.
NEAR = 1.0

_Frame = tuple[complex, float]  # the position and the heading of the origin of a stretch


def likely_moves(
    moved: NDArray[np.float64],
    missing: Collection[int],
    dstates: Sequence[int],
    places: Sequence[int],
) -> Iterator[tuple[int, tuple[float, float, float]]]:
    """Guess the missing displacements.

    Args:
        moved: The displacement that leads to each of n steps, (n, 3), in metres and radians.
        missing: The steps to which no displacement is known.
        dstates: The dstate of each step.
        places: The place of each step.

    Yields:
        A step of `missing`, and the displacement that probably leads there.
    """
    begins = [0, *sorted(missing)]
    stretch = [range(a, b) for a, b in pairwise([*begins, len(moved)])]
    pose: list[_Frame] = []
    for t, (dx, dy, turned) in enumerate(moved.tolist()):
        if t in begins:
            pose.append((0j, 0.0))
            continue
        at, heading = pose[-1]
        pose.append((at + cmath.rect(1, heading) * complex(dx, dy), heading + turned))
    known: dict[int, int] = {}  # for each dstate, a step whose stretch has a frame
    position: dict[int, complex] = {}  # for each place, where it is
    waiting = list(range(len(stretch)))
    while waiting:
        number, frame = next(
            (
                (number, frame)
                for number in waiting
                if (frame := _frame(stretch[number], pose, dstates, places, known, position))
            ),
            (waiting[0], (0j, 0.0)),
        )
        waiting.remove(number)
        for t in stretch[number]:
            at, heading = pose[t]
            pose[t] = frame[0] + cmath.rect(1, frame[1]) * at, frame[1] + heading
            known.setdefault(dstates[t], t)
            position.setdefault(places[t], pose[t][0])
    for t in sorted(missing):
        (at, heading), (after, facing) = pose[t - 1], pose[t]
        gone = (after - at) * cmath.rect(1, -heading)
        yield t, (gone.real, gone.imag, math.remainder(facing - heading, math.tau))


def _frame(
    steps: range,
    pose: Sequence[_Frame],
    dstates: Sequence[int],
    places: Sequence[int],
    known: dict[int, int],
    position: dict[int, complex],
) -> _Frame | None:
    """Find the frame of a stretch, by a dstate or two places whose poses are known already.

    Args:
        pose: The pose of each step; those of `steps` are in the frame of the stretch.

    Returns:
        The position and the heading of the origin of the stretch; None if they are undetermined.
    """
    for t in steps:
        if dstates[t] in known:
            at, heading = pose[known[dstates[t]]]
            turn = heading - pose[t][1]
            return at - cmath.rect(1, turn) * pose[t][0], turn
    there = [t for t in steps if places[t] in position]
    for t in there:
        for u in there:
            way = position[places[u]] - position[places[t]]
            mine = pose[u][0] - pose[t][0]
            if min(abs(way), abs(mine)) > NEAR:
                turn = cmath.phase(way) - cmath.phase(mine)
                return position[places[t]] - cmath.rect(1, turn) * pose[t][0], turn
    return None
