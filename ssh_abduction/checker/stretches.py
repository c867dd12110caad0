"""Guess displacements that are missing, from what a map claims.

A displacement is missing where a drive starts, or where it was not logged. Between two gaps lies a
*stretch* of steps, whose poses by dead reckoning have a frame of their own. If two stretches have a
dstate or two places in common, or if a closure connects them, this determines how their frames lie
relative to each other. Such guesses of missing displacements are only a starting point: the misfit
does not depend on them.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Collection, Iterator, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.odometry import Closure

# The direction from one place to another is too uncertain to use if they are closer than this many
# metres.
NEAR = 1.0

_Frame = tuple[complex, float]  # the position and the heading of the origin of a stretch


def likely_moves(
    moved: NDArray[np.float64],
    missing: Collection[int],
    dstates: Sequence[int],
    places: Sequence[int],
    closures: Sequence[Closure] = (),
) -> Iterator[tuple[int, tuple[float, float, float]]]:
    """Guess the displacements that lead to the `missing` steps.

    `moved`, of shape (n, 3), has the displacement that leads to each step, in metres and radians.
    `dstates` and `places` have the dstate and the place of each step. `closures` are used where
    these say nothing.
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
    framed: set[int] = set()  # the steps of stretches that have a frame
    waiting = list(range(len(stretch)))
    while waiting:
        number, frame = next(
            (
                (number, frame)
                for number in waiting
                if (frame := _frame(stretch[number], pose, dstates, places, known, position))
                or (frame := _frame_by_closure(stretch[number], pose, closures, framed))
            ),
            (waiting[0], (0j, 0.0)),
        )
        waiting.remove(number)
        framed.update(stretch[number])
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
    """Find the origin of a stretch of steps, from a dstate or two places with known poses.

    None if the stretch has neither.
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


def _frame_by_closure(
    steps: range, pose: Sequence[_Frame], closures: Sequence[Closure], framed: Collection[int]
) -> _Frame | None:
    """Find the origin of a stretch of steps, from a closure with a step that has a frame."""
    for closure in closures:
        x, y, turned = closure.displacement
        here, there, onward = closure.last, closure.first, complex(x, y)
        if closure.first in steps:
            here, there, onward = there, here, -cmath.rect(1, -turned) * onward
            turned = -turned
        if here in steps and there in framed:
            at, heading = pose[there]
            turn = heading + turned - pose[here][1]
            at += cmath.rect(1, heading) * onward
            return at - cmath.rect(1, turn) * pose[here][0], turn
    return None
