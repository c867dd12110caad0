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

from ssh_abduction.data.odometry import displacement_between, moved
from ssh_abduction.data.trace import Trace
from ssh_abduction.solver.geometry.equations import spreads_of
from ssh_abduction.solver.guesses.reckoning import BLUR

if TYPE_CHECKING:
    from ssh_abduction.solver.guesses.overlaying import Part

Array = NDArray[np.float64]


class Tie(NamedTuple):
    """A closure between two maps.

    Attributes:
        first: The dstate of its earlier step.
        last: The dstate of its later step.
        displacement: The pose of the later step relative to the earlier one: x and y in metres,
            and the turn in radians, (3,).
        covariance: Its covariance, with the scatter of both steps about their dstates, (3, 3).
        is_back: Whether the later step, and not the earlier one, is in the first map.
    """

    first: int
    last: int
    displacement: Array
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
                found.append(Tie(s, x, np.array(closure.displacement), covariance, x < old))
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
        between = tuple(tie.displacement)
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
    by, off = np.zeros((3 * len(ties), len(mean))), np.zeros(3 * len(ties))
    noise = np.zeros(2 * (len(off),))
    for k, (first, last, displacement, scatter, _) in enumerate(ties):
        rows = slice(3 * k, 3 * k + 3)
        at, to = (both.position[both.places[s]] for s in (first, last))
        heading, after = both.heading[first], both.heading[last]
        cos, sin = math.cos(mean[heading]), math.sin(mean[heading])
        back = np.array([[cos, sin], [-sin, cos]])
        gone = back @ (mean[to : to + 2] - mean[at : at + 2])
        by[rows, [to, to + 1]] = np.vstack([back, np.zeros(2)])
        by[rows, [at, at + 1]] = -by[rows, [to, to + 1]]
        by[rows, heading] = gone[1], -gone[0], -1.0
        by[3 * k + 2, after] = 1.0
        off[rows] = [*gone, mean[after] - mean[heading]] - displacement
        off[3 * k + 2] = math.remainder(off[3 * k + 2], math.tau)
        noise[rows, rows] = scatter
    across = covariance @ by.T
    solved = np.linalg.solve(by @ across + noise, np.column_stack([off, across.T]))
    covariance = covariance - across @ solved[:, 1:]
    return mean - across @ solved[:, 0], (covariance + covariance.T) / 2
