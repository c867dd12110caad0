"""What a trace says about the poses of its steps: displacements and closures, as equations.

A displacement relates a step to the step before, a closure relates any two steps. Each gives three
equations, with a covariance. Displacements share two errors, their scale and a steady drift of
heading. Closures have neither, as they do not depend on the way that the robot drove.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.closure import Closure
from ssh_abduction.data.odometry import Odometry
from ssh_abduction.data.trace import Trace

Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Equations:
    """The displacements of a trace, and then its closures, n in all.

    Attributes:
        first: The step from which each leads, n.
        last: The step to which it leads, n.
        moved: The displacement in metres and radians, n x 3.
        noise: Its covariance, with the errors of both ends, n x 3 x 3.
        scaled: 1 if the shared error of scale applies, and 0 if not, n.
        way: The metres over which the shared drift of heading applies, n.
        sigma: The standard deviations of scale and drift, 2.
    """

    first: NDArray[np.int_]
    last: NDArray[np.int_]
    moved: Array
    noise: Array
    scaled: Array
    way: Array
    sigma: Array

    @staticmethod
    def of(trace: Trace) -> Equations:
        """Collect the equations of a trace."""
        odometry = trace.odometry or Odometry()
        steps = [t for t in range(1, len(trace)) if trace.steps[t].displacement is not None]
        matched = trace.closures
        moved = np.array(
            [
                *(trace.steps[t].displacement for t in steps),
                *(closure.displacement for closure in matched),
            ],
            dtype=float,
        ).reshape(-1, 3)
        scaled = np.repeat([1.0, 0.0], [len(steps), len(matched)])
        return Equations(
            first=np.array([*(t - 1 for t in steps), *(c.first for c in matched)], dtype=int),
            last=np.array([*steps, *(c.last for c in matched)], dtype=int),
            moved=moved,
            noise=np.concatenate(
                [noises(trace, steps), *(noise_of(c, odometry)[None] for c in matched)]
            ),
            scaled=scaled,
            way=scaled * np.hypot(moved[:, 0], moved[:, 1]),
            sigma=np.array([odometry.scale, odometry.bend]),
        )


def noises(trace: Trace, steps: Sequence[int]) -> Array:
    """The covariances of the displacements that lead to some steps: n x 3 x 3.

    A dstate has one pose in a map, but the robot is not at exactly this pose on each visit. That
    error counts in the displacements to the dstate and from it.
    """
    ends = _ends(trace.odometry or Odometry())
    travelled = np.array([trace.actions[t - 1].kind != "turn" for t in steps], dtype=float)
    noise = np.array([trace.covariance(t) for t in steps], dtype=float).reshape(-1, 3, 3)
    whole: Array = noise + travelled.reshape(-1, 1, 1) * ends
    return whole


def noise_of(closure: Closure, odometry: Odometry) -> Array:
    """The covariance of a closure, 3 x 3, with the errors of the poses at both of its steps."""
    noise: Array = np.array(closure.covariance) + _ends(odometry)
    return noise


def _ends(odometry: Odometry) -> Array:
    """The covariance that the errors of the poses at two visits add."""
    ends: Array = 2 * np.diag([odometry.offset, odometry.offset, odometry.facing]) ** 2
    return ends
