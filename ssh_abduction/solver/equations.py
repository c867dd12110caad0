"""What a trace says about the poses of its steps: displacements and closures, as equations.

A displacement relates a step to the step before, a closure relates any two steps. Each gives three
equations, with a covariance. If the robot is off the pose of its dstate, each step gives three
more. Displacements share two errors, their scale and a steady drift of heading. Closures have
neither, as they do not depend on the way that the robot drove.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.odometry import Odometry
from ssh_abduction.data.trace import Trace

Array: TypeAlias = NDArray[np.float64]

# If the robot is off the poses of dstates, then by this standard deviation at least, in metres and
# radians.
LEAST = 1e-3


@dataclass(frozen=True, eq=False)
class Equations:
    """The displacements of a trace, and then its closures, n in all.

    Attributes:
        first: The step from which each leads, n.
        last: The step to which it leads, n.
        moved: The displacement in metres and radians, n x 3.
        noise: Its covariance, n x 3 x 3.
        scaled: 1 if the shared error of scale applies, and 0 if not, n.
        way: The metres over which the shared drift of heading applies, n.
        sigma: The standard deviations of scale and drift, 2.
        spreads: The variances of the pose at each step, relative to its dstate (`spreads_of`).
    """

    first: NDArray[np.int_]
    last: NDArray[np.int_]
    moved: Array
    noise: Array
    scaled: Array
    way: Array
    sigma: Array
    spreads: Array

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
                [noises(trace, steps), *(np.array(c.covariance)[None] for c in matched)]
            ),
            scaled=scaled,
            way=scaled * np.hypot(moved[:, 0], moved[:, 1]),
            sigma=np.array([odometry.scale, odometry.bend]),
            spreads=spreads_of(trace),
        )

    def beside(self, labels: NDArray[np.int_], size: int) -> Equations:
        """These equations between dstates, and between dstates and the robot if it is off them.

        The robot has a pose of its own at each step, with the numbers from `size` on.

        Args:
            labels: The dstate of each step, n.
            size: The number of dstates.
        """
        if not self.spreads.any():
            return replace(self, first=labels[self.first], last=labels[self.last])
        n = len(labels)
        return replace(
            self,
            first=np.concatenate([size + self.first, labels]),
            last=np.concatenate([size + self.last, size + np.arange(n)]),
            moved=np.concatenate([self.moved, np.zeros((n, 3))]),
            noise=np.concatenate([self.noise, self.spreads[:, :, None] * np.identity(3)]),
            scaled=np.concatenate([self.scaled, np.zeros(n)]),
            way=np.concatenate([self.way, np.zeros(n)]),
        )


def noises(trace: Trace, steps: Sequence[int]) -> Array:
    """The covariances of the displacements that lead to some steps: n x 3 x 3."""
    return np.array([trace.covariance(t) for t in steps], dtype=float).reshape(-1, 3, 3)


def spreads_of(trace: Trace) -> Array:
    """The variances of the pose of the robot at each step, relative to its dstate: n x 3.

    A dstate has one pose in a map, but the robot is not at exactly this pose on each visit. Turns
    stay there, so the steps of a visit have one error of position. It counts once: each of k steps
    has k times the variance. All variances are 0 if the odometry declares no such errors.
    """
    odometry = trace.odometry or Odometry()
    visit = np.cumsum([1, *(action.kind != "turn" for action in trace.actions)]) - 1
    steps = np.bincount(visit)[visit].astype(float)
    spreads = np.zeros((len(trace), 3))
    if odometry.offset or odometry.facing:
        spreads[:, :2] = (steps * max(odometry.offset, LEAST) ** 2)[:, None]
        spreads[:, 2] = max(odometry.facing, LEAST) ** 2
    return spreads
