"""Poses by dead reckoning, and the covariance of their errors.

The error of the robot's pose is predicted as in a Kalman filter. Let E(t) be the error of the pose
by dead reckoning at step t, in the frame of the first step, and V(t) its covariance. An error at
step i persists at a later step j, rotated about the position of the robot at step i:

    F(j, i) = [[1, S (p(j) - p(i))], [0, 1]]        with S a quarter turn, and p the position.

A loop is the way from step i to a later step j at the same dstate or place. It closes with the
error E(j) - F(j, i) E(i). The covariance of this error is V(j) - F(j, i) V(i) F(j, i)', because the
noise of each step is independent of the steps before. Two loops share the noise between the later
of their first steps and the earlier of their last steps. Two more errors, a wrong scale and a drift
of the heading, are constant over the whole trace.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.odometry import Odometry
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import look_at_clock

Array: TypeAlias = NDArray[np.float64]
# The numbers of `one_pose` in docs/explanation/theory.md. SIGMAS: up to how many standard
# deviations of the heading the error of linearisation is bounded. LOST: the standard deviation in
# radians above which a heading is unknown. BENDS_A_SIGMA: how many drifts are tried per standard
# deviation. MOST_BENDS: the greatest drift, in standard deviations. ROUNDED: the rounding error in
# metres and radians.
SIGMAS, LOST, BENDS_A_SIGMA, MOST_BENDS, ROUNDED = 6.0, 1.0, 2, 6, 1e-3
# The number of steps or returns between two checks of the time limit. They take some milliseconds.
FEW = 64


class ErrorFilter:
    """Poses by dead reckoning, and the covariance of their errors.

    The errors are errors of the pose (x and y in metres, heading in radians), of the scale, and of
    the drift of the heading. The arguments `first` and `last` of the methods are the steps at the
    ends of m loops, as arrays of length m. For a single loop they may be two numbers; then the
    result lacks the axis of length m.

    Args:
        trace: The trace, with displacements.
        odometry: The noise model of the odometer.
        bend: The drift of the heading that is assumed, in radians per metre.
        drift: The standard deviation of the remaining drift, in radians per metre.
    """

    def __init__(self, trace: Trace, odometry: Odometry, bend: float, drift: float) -> None:
        size = len(trace)
        self.pose = np.zeros((size, 3))
        self.white = np.zeros((size, 3, 3))  # covariance of the pose by noise alone
        self.repeated = np.zeros((size, 3, 2))  # derivative of the pose by scale and drift
        self.broken = np.zeros(size, dtype=int)  # number of missing displacements so far
        self.sigma = np.array([odometry.scale, drift])
        # at both ends of a loop the robot may be off the pose of the dstate
        self.at_end = np.diag([odometry.offset, odometry.offset, odometry.facing]) ** 2
        for t in range(1, size):
            if t % FEW == 0:
                look_at_clock()
            x, y, heading = self.pose[t - 1]
            displacement, covariance = trace.steps[t].displacement, trace.covariance(t)
            self.broken[t] = self.broken[t - 1] + (displacement is None)
            if displacement is None or covariance is None:
                self.pose[t], self.white[t], self.repeated[t] = (
                    self.pose[t - 1],
                    self.white[t - 1],
                    self.repeated[t - 1],
                )
                continue
            dx, dy, turned = displacement
            way = math.hypot(dx, dy)
            cos, sin = math.cos(heading - bend * way / 2), math.sin(heading - bend * way / 2)
            moved = np.array([cos * dx - sin * dy, sin * dx + cos * dy])
            self.pose[t] = x + moved[0], y + moved[1], heading + turned - bend * way
            onward = _onward(moved)
            cos, sin = math.cos(heading), math.sin(heading)
            turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
            self.white[t] = (
                onward @ self.white[t - 1] @ onward.T + turn @ np.array(covariance) @ turn.T
            )
            new = np.array(
                [[moved[0], -moved[1] * way / 2], [moved[1], moved[0] * way / 2], [0.0, way]]
            )
            self.repeated[t] = onward @ self.repeated[t - 1] + new

    def onward(self, first: Any, last: Any) -> Array:
        """Compute F(last, first) of shape (m, 3, 3): how a pose error at `first` moves `last`."""
        return _onward(self.pose[last, :2] - self.pose[first, :2])

    def since(self, first: Any, last: Any) -> Array:
        """Compute the covariance at `last`, (m, 3, 3), that the noise since `first` causes."""
        onward = self.onward(first, last)
        covariance: Array = self.white[last] - onward @ self.white[first] @ onward.swapaxes(-1, -2)
        return covariance

    def new_until(self, end: int) -> Array:
        """Return the covariance at `end` from the noise up to each step, of shape (end + 1, 9)."""
        onward = self.onward(np.arange(end + 1), np.full(end + 1, end))
        covariance: Array = (onward @ self.white[: end + 1] @ onward.swapaxes(-1, -2)).reshape(
            -1, 9
        )
        return covariance

    def repeated_since(self, first: Any, last: Any) -> Array:
        """The closing errors of one standard deviation of scale, and of drift: (m, 3, 2)."""
        moved: Array = (
            self.repeated[last] - self.onward(first, last) @ self.repeated[first]
        ) * self.sigma
        return moved

    def covariance(self, first: Any, last: Any) -> Array:
        """Compute the covariance of the closing error of each loop, of shape (m, 3, 3).

        Errors of the heading have effects that are not linear. The covariance is enlarged by a
        bound on these effects.
        """
        white, repeated = self.since(first, last), self.repeated_since(first, last)
        heading = self.lost(first, last)
        moved = self._moved_by_heading(first, last) + (repeated[..., :2, 1] ** 2).sum(-1)
        bent = (SIGMAS / 2) ** 2 * heading * moved + ROUNDED**2
        added = (
            bent[..., None, None] * np.diag([1.0, 1.0, 0.0])
            + ROUNDED**2 * np.diag([0.0, 0.0, 1.0])
            + 2 * self.at_end
        )
        total: Array = white + repeated @ repeated.swapaxes(-1, -2) + added
        return total

    def lost(self, first: Any, last: Any) -> Array:
        """Compute the variance of the heading at the end of each loop, in radians squared."""
        variance: Array = (
            self.since(first, last)[..., 2, 2] + self.repeated_since(first, last)[..., 2, 1] ** 2
        )
        return variance

    def _moved_by_heading(self, first: Any, last: Any) -> Array:
        """Compute the variance that the noise of headings causes in the position of loop ends.

        For each loop this is the sum, over its steps, of the heading variance that the step adds
        times the squared distance from the step to the end of the loop.
        """
        angle = np.diff(self.white[:, 2, 2], prepend=0.0)
        x, y = self.pose[:, 0], self.pose[:, 1]
        sums = [np.cumsum(angle * factor) for factor in (np.ones_like(x), x, y, x * x + y * y)]
        one, by_x, by_y, square = (s[last] - s[first] for s in sums)
        moved: Array = np.maximum(
            square - 2 * (by_x * x[last] + by_y * y[last]) + one * (x[last] ** 2 + y[last] ** 2),
            0.0,
        )
        return moved

    def is_known(self, first: Any, last: Any) -> NDArray[np.bool_]:
        """For each loop from step `first` to `last`, tell whether its closing error is known.

        The error is known if no displacement of the loop is missing and the standard deviation of
        the heading at its end is at most LOST.
        """
        known: NDArray[np.bool_] = (self.broken[first] == self.broken[last]) & (
            self.lost(first, last) <= LOST**2
        )
        return known

    def closing(self, first: Any, last: Any) -> Array:
        """Compute the closing error (x, y, heading) of each loop, of shape (m, 3).

        This is the pose at `last` minus the pose at `first`, by dead reckoning.
        """
        off: Array = self.pose[last] - self.pose[first]
        off[..., 2] = (off[..., 2] + math.pi) % math.tau - math.pi
        return off


def _onward(moved: Array) -> Array:
    """Compute F of shape (m, 3, 3): how movements `moved`, (m, 2), change errors of the pose."""
    onward = np.zeros((*moved.shape[:-1], 3, 3))
    onward[..., range(3), range(3)] = 1.0
    onward[..., 0, 2], onward[..., 1, 2] = -moved[..., 1], moved[..., 0]
    return onward


class Drifts:
    """Iterates over possible drifts of the heading. The first one is no drift.

    For each drift it yields an `ErrorFilter` with the poses for this drift, and the chi-square of
    the drift itself. Poses are computed at their first use.
    """

    def __init__(self, trace: Trace) -> None:
        self._trace, self._odometry = trace, trace.odometry or Odometry()
        self._made: dict[int, ErrorFilter] = {}

    @property
    def none(self) -> ErrorFilter:
        """The error filter that uses the poses without a drift of heading."""
        return self._filter(0)

    def _filter(self, number: int) -> ErrorFilter:
        """Return the filter for a drift of `number` / BENDS_A_SIGMA standard deviations."""
        step = self._odometry.bend / BENDS_A_SIGMA
        if number not in self._made:
            self._made[number] = ErrorFilter(self._trace, self._odometry, number * step, step / 2)
        return self._made[number]

    def __iter__(self) -> Iterator[tuple[ErrorFilter, float]]:
        numbers = (
            range(-MOST_BENDS * BENDS_A_SIGMA, MOST_BENDS * BENDS_A_SIGMA + 1)
            if self._odometry.bend
            else [0]
        )
        for n in sorted(numbers, key=lambda n: (abs(n), n)):
            look_at_clock()
            yield self._filter(n), max(abs(n) - 0.5, 0.0) ** 2 / BENDS_A_SIGMA**2
