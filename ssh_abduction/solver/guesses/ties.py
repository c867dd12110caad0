"""Relate the maps of two drives by the closures between them.

A closure is the pose of a step relative to an earlier step, from a match of local maps. A *tie* is
a closure between steps of two maps. The poses of the dstates of these steps stand for the poses of
the robot.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from ssh_abduction.data.odometry import Displacement, displacement_between, moved
from ssh_abduction.data.trace import Trace
from ssh_abduction.solver.geometry.equations import spreads_of
from ssh_abduction.solver.guesses.reckoning import BLUR, closure_equations, updated

if TYPE_CHECKING:
    from ssh_abduction.solver.guesses.placed_map import Part

Array = NDArray[np.float64]


class Tie(NamedTuple):
    """A closure between two maps.

    Attributes:
        first: The dstate of its earlier step.
        last: The dstate of its later step.
        displacement: The pose of the later step relative to the earlier one: x and y in metres,
            and the turn in radians.
        covariance: Its covariance, with the scatter of both steps about their dstates, (3, 3).
        is_back: Whether the later step, and not the earlier one, is in the first map.
    """

    first: int
    last: int
    displacement: Displacement
    covariance: Array
    is_back: bool


def ties_between(trace: Trace, both: Part, old: int) -> list[Tie]:
    """List the closures between two maps. `old` is the number of dstates of the first one."""
    spreads = spreads_of(trace) + BLUR if trace.closures else np.zeros((0, 3))
    found = []
    for closure in trace.closures:
        if closure.first in both.labels and closure.last in both.labels:
            s, x = both.labels[closure.first], both.labels[closure.last]
            if (s < old) != (x < old):
                scatter = np.diag(spreads[closure.first] + spreads[closure.last])
                covariance = np.array(closure.covariance) + scatter
                found.append(Tie(s, x, closure.displacement, covariance, x < old))
    return found


def relation_of(both: Part, ties: Sequence[Tie]) -> tuple[int, Array, float]:
    """Find how the second map lies on the first one, by the mean of what all ties say.

    Returns:
        A dstate of the second map, where it is in the first map, (2,) metres, and by how many
        radians the second map is turned.
    """
    (at, facing), turns, here, there = both.poses, [], [], []
    for tie in ties:
        old, new = (tie.last, tie.first) if tie.is_back else (tie.first, tie.last)
        between = tie.displacement
        if tie.is_back:
            between = displacement_between(between, (0.0, 0.0, 0.0))
        x, y, heading = moved((*at[old], facing[old]), between)
        turns.append(heading - facing[new])
        here.append((x, y))
        there.append(new)
    angle = math.atan2(np.sin(turns).sum(), np.cos(turns).sum())
    middle = np.mean(at[there], axis=0)
    aside = moved((0.0, 0.0, angle), (*(at[new] - middle), 0.0))[:2]
    return new, np.mean(here, axis=0) + aside, angle


def tied(both: Part, ties: Sequence[Tie], mean: Array, covariance: Array) -> tuple[Array, Array]:
    """Condition the poses of two maps on the ties between them."""
    at, heading = both.position[both.places].tolist(), both.heading.tolist()
    by, off = zip(
        *(
            closure_equations(
                mean,
                (at[tie.first], heading[tie.first]),
                (at[tie.last], heading[tie.last]),
                tie.displacement,
            )
            for tie in ties
        ),
        strict=True,
    )
    noise = block_diag(*(tie.covariance for tie in ties))
    return updated(mean, covariance, np.concatenate(by), np.concatenate(off), noise)[:2]
