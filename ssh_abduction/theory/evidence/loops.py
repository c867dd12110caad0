"""The error at the end of the loops of a trace, and the covariance of the error.

>>> from ssh_abduction import Trace
>>> from ssh_abduction.theory.evidence.loops import Loops
>>> square = [(10, 0, 0), (0, 0, 1.5708)] * 4
>>> trace = Trace.from_steps("ababababa", ["travel", "left"] * 4, displacements=square)
>>> closing, covariance = Loops.of(trace).closings([0], [8])
>>> bool(abs(closing[0]).max() < 0.001), covariance.shape
(True, (1, 3, 3))

A loop leads from step i to a later step j. It closes if the robot is back where it was. Otherwise
its error, the *closing*, is P(j) - P(i). P is the pose by dead reckoning: all displacements
composed from the first step on. Let p be its position. An error e of the displacement that leads to
step k turns the rest of the loop. To first order, it moves the end of the loop by

    R(k) e_xy + e_theta S (p(j) - p(k))

where R(k) is the heading before the displacement, and S a quarter turn. The covariance of the
closing is the sum of the covariances of these moves (Smith, Self & Cheeseman 1990, "Estimating
uncertain spatial relationships in robotics").

The error moves the plane as a whole, so it is described by how it moves the pose at the origin: by
(R(k) e_xy - e_theta S p(k), e_theta), which is called its *twist*. A twist (t, e) moves the pose at
position p by (t + e S p, e). So the twists of all errors of a loop may be summed first, and moved
to the end of the loop then. Prefix sums of their covariances give the covariance of any loop at
once.

Two errors are not noise, but unknown constants of the whole trace: a wrong scale, and a steady
drift of heading. The measured pose of a dstate (a place and a heading) may also be off at each
visit, for example if the middle of a place is estimated from laser scans. This adds to the
covariance at both ends of the loop and does not grow along the way.

*Lost headings.* First order replaces an arc by its tangent. Let e be a rare error of heading, of
SIGMAS standard deviations. It moves the end off the tangent by e / 2 times the first-order move.
The square of this is added to the variance in all directions. If the heading is known to a few
degrees, this changes almost nothing. If the heading is lost, no closing is unlikely any more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from threading import Lock
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ssh_abduction.data.odometry import ROUNDED, Odometry
from ssh_abduction.data.trace import Trace

Array: TypeAlias = NDArray[np.float64]
Steps: TypeAlias = NDArray[np.int_]

# A test that rejects a true map once in a thousand traces allows about this many standard
# deviations.
SIGMAS = 6.0
# Loops with a more uncertain heading than this, in radians, are not tested: the covariance that is
# added for it exceeds any error.
LOST = 1.0
# How many values of the steady drift of heading are tried for each standard deviation of it. A loop
# is rejected if it closes badly with each of them.
BENDS_A_SIGMA = 2
# Drifts of more standard deviations than this are too unlikely to try.
MOST_BENDS = 6
# How many steps are computed at once. Intermediate arrays take some ten megabytes.
AT_A_TIME = 1000
# How many columns a step has: 3 for its pose, 9 for `twists`, 3 for `levers`, 3 for `bent`.
COLUMNS = 3 + 9 + 3 + 3


@dataclass(frozen=True)
class Loops:
    """Dead reckoning of a trace of n steps, with prefix sums for the covariances of loops.

    Attributes:
        poses: Poses by dead reckoning, n x 3, in metres and radians. After a missing displacement,
            the pose is the same as at the step before.
        part: For each step, the number of missing displacements up to it. If a displacement on a
            loop is missing, nothing is known about the loop.
        twists: The covariance of the twist by the noise of all displacements up to each step,
            n x 3 x 3.
        levers: The sum, over the displacements up to each step, of the variance of the heading
            times x, y and the squared distance of the step from the origin, n x 3.
        bent: The twist by a drift of heading of 1 radian per metre up to each step, n x 3. The last
            column is the metres driven.
        odometry: The noise model, for errors that all displacements share.
        bend: The drift of heading that was removed from the displacements, in radians per metre.
        drift: The standard deviation of the drift that is left, in radians per metre.
    """

    poses: Array
    part: Steps
    twists: Array
    levers: Array
    bent: Array
    odometry: Odometry
    bend: float
    drift: float

    @staticmethod
    def of(trace: Trace, bend: float = 0.0, drift: float | None = None) -> Loops:
        """Make the loops of a trace, and remove the steady drift of heading `bend`.

        It is in radians per metre. `drift` is the standard deviation of the remaining drift; that
        of the odometry by default.
        """
        odometry = trace.odometry or Odometry()
        sums = _sums(trace, 0, len(trace), np.array([bend]), np.zeros((1, COLUMNS)))[0]
        return Loops._of(
            sums, _parts(trace), odometry, bend, odometry.bend if drift is None else drift
        )

    @staticmethod
    def _of(sums: Array, part: Steps, odometry: Odometry, bend: float, drift: float) -> Loops:
        poses, twists, levers, bent = np.split(sums, (3, 12, 15), axis=-1)
        twists = twists.reshape(*twists.shape[:-1], 3, 3)
        return Loops(poses, part, twists, levers, bent, odometry, bend, drift)

    def closings(self, first: ArrayLike, last: ArrayLike) -> tuple[Array, Array]:
        """Return the errors at the end of m loops, in the frame of the first step of the trace.

        The loops lead from the steps `first` to the steps `last`. The errors are m x 3, in
        metres and radians, and their covariances m x 3 x 3.
        """
        i, j = np.asarray(first, dtype=int), np.asarray(last, dtype=int)
        closing = self.poses[j] - self.poses[i]
        closing[:, 2] = np.remainder(closing[:, 2] + math.pi, math.tau) - math.pi
        noise, repeated = self.noise(i, j), self._by_constants(i, j)
        covariance = noise + repeated @ repeated.swapaxes(-1, -2)
        # Add what is lost by first order: the variance of the heading, times how far errors of the
        # heading move the end.
        angle, end, levers = noise[:, 2, 2], self.poses[j, :2], self.levers[j] - self.levers[i]
        moved = angle * (end**2).sum(1) - 2 * (end * levers[:, :2]).sum(1) + levers[:, 2]
        moved = np.maximum(moved, 0.0) + (repeated[:, :2, 1] ** 2).sum(1)
        bent = (SIGMAS / 2) ** 2 * covariance[:, 2, 2] * moved + ROUNDED**2
        covariance += 2 * self.at_end
        covariance[:, 0, 0] += bent
        covariance[:, 1, 1] += bent
        covariance[:, 2, 2] += ROUNDED**2
        return closing, covariance

    def shared(
        self, loops: tuple[ArrayLike, ArrayLike], others: tuple[ArrayLike, ArrayLike]
    ) -> Array:
        """Return the covariances, m x 3 x 3, between the closings of m loops and of m other loops.

        Loops are given by the steps at which they begin, and those at which they end. Covariances
        come from displacements in both loops, and from errors that all displacements share.
        """
        (i, j), (k, m) = (
            tuple(np.asarray(steps, dtype=int) for steps in pair) for pair in (loops, others)
        )
        begin, end = np.maximum(i, k), np.minimum(j, m)
        covariance = self._white(begin, np.maximum(begin, end), j, m)
        return covariance + self._by_constants(i, j) @ self._by_constants(k, m).swapaxes(-1, -2)

    @property
    def at_end(self) -> Array:
        """The covariance of the pose of the robot relative to its dstate, 3 x 3."""
        odometry = self.odometry
        return np.diag([odometry.offset**2, odometry.offset**2, odometry.facing**2])

    def _white(self, i: Steps, j: Steps, end: Steps, other_end: Steps) -> Array:
        """The covariances, m x 3 x 3, between closings from the noise of displacements from i to j.

        They are between m loops that end at the steps `end`, and m loops that end at `other_end`.
        """
        onward, other = (_moved_from_origin(self.poses[steps, :2]) for steps in (end, other_end))
        covariance: Array = onward @ (self.twists[j] - self.twists[i]) @ other.swapaxes(-1, -2)
        return covariance

    def _by_constants(self, i: Steps, j: Steps) -> Array:
        """Return how far a standard deviation of the scale, and of the drift, moves ends of loops.

        The result is m x 3 x 2, for m loops from steps i to steps j.
        """
        # A scale that is wrong by 1 moves the end of a loop by the whole loop.
        scaled = (self.poses[j] - self.poses[i]) * (1.0, 1.0, 0.0)
        twist = (self.bent[j] - self.bent[i])[..., None]
        bent = (_moved_from_origin(self.poses[j, :2]) @ twist)[..., 0]
        return np.stack([self.odometry.scale * scaled, self.drift * bent], axis=-1)

    def of_ends(self, end: int) -> Array:
        """Compute the covariance of the pose at `end` by noise up to each step: (end + 1) x 9."""
        every = np.arange(end + 1)
        there = np.full(end + 1, end)
        return self._white(np.zeros_like(every), every, there, there).reshape(-1, 9)

    def noise(self, first: Steps, last: Steps) -> Array:
        """Return the covariances of m loop closings that noisy displacements cause, m x 3 x 3."""
        return self._white(first, last, last, last)

    def repeated(self, first: Steps, last: Steps) -> Array:
        """Return the covariances that a wrong scale and a steady drift cause, m x 3 x 3."""
        moved = self._by_constants(first, last)
        return np.asarray(moved @ moved.swapaxes(-1, -2))


class Reckoning:
    """Dead reckoning of a trace for each drift of heading that it may have.

    Attributes:
        bends: The drifts, in radians per metre. The first one is 0.
        unlikely: The chi-square of each drift.
        begins: For each step, the earliest step with a known pose relative to it: no displacement
            is missing since then, and the heading is not lost. It does not depend on the drift, or
            on later steps.
    """

    def __init__(self, trace: Trace, before: Reckoning | None = None) -> None:
        """Compute the poses and sums for each drift of heading. Reuse those of first steps."""
        self.odometry = trace.odometry or Odometry()
        sigma = self.odometry.bend
        step = sigma / BENDS_A_SIGMA
        numbers = (
            sorted(range(-MOST_BENDS * BENDS_A_SIGMA, MOST_BENDS * BENDS_A_SIGMA + 1), key=abs)
            if sigma
            else [0]
        )
        self.bends = [number * step for number in numbers]
        # Each drift represents an interval of drifts. Take the chi-square of the likeliest of them.
        self.unlikely = [(max(abs(number) - 0.5, 0.0) / BENDS_A_SIGMA) ** 2 for number in numbers]
        self._drift = step / 2
        self._size = len(trace)
        start = before._size if before else 0
        last = before._rows.array[:, start - 1] if before else np.zeros((len(numbers), COLUMNS))
        new = np.empty((len(numbers), self._size - start, COLUMNS))
        for at in range(start, self._size, AT_A_TIME):
            stop = min(at + AT_A_TIME, self._size)
            new[:, at - start : stop - start] = _sums(trace, at, stop, np.array(self.bends), last)
            last = new[:, stop - start - 1]
        self._rows: _Rows = before._rows.extended(start, new) if before else _Rows(new)
        self._part: Steps = (
            np.concatenate([before._part, _parts(trace, start, int(before._part[-1]))])
            if before
            else _parts(trace)
        )
        self.begins: Steps = self._begins(before.begins if before else np.zeros(0, dtype=int))

    def loops(self, number: int) -> Loops:
        """Return the loops with the drift `bends[number]` removed."""
        return Loops._of(
            self._rows.array[number, : self._size],
            self._part,
            self.odometry,
            self.bends[number],
            self._drift,
        )

    def loops_of_unknown_drift(self) -> Loops:
        """Return the loops with no drift removed. All drift adds to their covariances."""
        return Loops._of(
            self._rows.array[0, : self._size], self._part, self.odometry, 0.0, self.odometry.bend
        )

    def closings(self, numbers: Steps, first: Steps, last: Steps) -> tuple[Array, Array]:
        """Compute closings as `Loops.closings` does, each without the drift `bends[number]`."""
        array = self._rows.array
        flat = Loops._of(array.reshape(-1, COLUMNS), self._part, self.odometry, 0.0, self._drift)
        offset = numbers * array.shape[1]
        return flat.closings(first + offset, last + offset)

    def _begins(self, known: Steps) -> Steps:
        """Compute `begins` for all steps. `known` has it for the first steps."""
        loops = self.loops(0)
        start = len(known)
        begin = int(known[-1]) if start else 0
        since = slice(begin, None)
        angle, way, part = (
            loops.twists[since, 2, 2].tolist(),
            loops.bent[since, 2].tolist(),
            loops.part[since].tolist(),
        )
        found, shift = [], begin
        # The beginning never goes back, because the heading only becomes more uncertain.
        for t in range(start - shift, len(part)):
            here = begin - shift
            while (
                part[here] < part[t]
                or angle[t] - angle[here] + (self._drift * (way[t] - way[here])) ** 2 > LOST**2
            ):
                here += 1
            begin = here + shift
            found.append(begin)
        return np.concatenate([known, np.array(found, dtype=int)])


class _Rows:
    """An array of drifts x rows x columns with spare room, so that adding rows is cheap."""

    def __init__(self, array: Array, size: int | None = None) -> None:
        self.array = array
        self._size = array.shape[1] if size is None else size
        self._lock = Lock()

    def extended(self, size: int, new: Array) -> _Rows:
        """Return the first `size` rows, followed by new rows.

        They are copied if this object has no room.
        """
        total = size + new.shape[1]
        with self._lock:
            if self._size == size and total <= self.array.shape[1]:
                self.array[:, size:total] = new
                self._size = total
                return self
        array = np.zeros((len(new), 2 * total, new.shape[2]))
        array[:, :size], array[:, size:total] = self.array[:, :size], new
        return _Rows(array, total)


def _parts(trace: Trace, start: int = 0, missing: int = 0) -> Steps:
    """Return, for each step from `start` on, the number of missing displacements up to it."""
    unknown = [t > 0 and trace.steps[t].displacement is None for t in range(start, len(trace))]
    parts: Steps = missing + np.cumsum(unknown, dtype=int)
    return parts


def _sums(trace: Trace, start: int, stop: int, bends: Array, last: Array) -> Array:
    """The poses, twists, levers and bent of steps, as in Loops: drifts x steps x COLUMNS.

    `bends` are the drifts in radians per metre. `last` is the row of the step before, drifts x
    COLUMNS.
    """
    moved, noise = np.zeros((stop - start, 3)), np.zeros((stop - start, 3, 3))
    for t in range(max(start, 1), stop):
        displacement = trace.steps[t].displacement
        if displacement is not None:
            moved[t - start], noise[t - start] = displacement, trace.covariance(t)
    way = np.hypot(moved[:, 0], moved[:, 1])
    rotated = moved[:, 2] - bends[:, None] * way
    straight = vectors_turned(moved[None, :, :2], -bends[:, None] * way / 2)
    heading = _summed(last[:, 2], rotated)
    before = heading - rotated  # the heading at the start of each displacement
    onward = vectors_turned(straight, before)
    position = _summed(last[:, :2], onward)
    # The twist by an error of a displacement, and by a drift of heading.
    twist = _moved_from_origin(-position)
    twist[..., 0, 0] = twist[..., 1, 1] = np.cos(before)
    twist[..., 1, 0], twist[..., 0, 1] = np.sin(before), -np.sin(before)
    noise = twist @ noise @ twist.swapaxes(-1, -2)
    angle = noise[..., 2, 2, None]
    bent = way[:, None] * _moved_from_origin(onward / 2 - position)[..., 2]
    columns = [
        noise.reshape(*before.shape, 9),
        angle * position,
        angle * (position**2).sum(axis=-1, keepdims=True),
        bent,
    ]
    sums = _summed(last[:, 3:], np.concatenate(columns, axis=-1))
    return np.concatenate([position, heading[..., None], sums], axis=-1)


def _summed(before: Array, values: Array) -> Array:
    """Return cumulative sums along the second axis, starting from `before`."""
    summed: Array = np.cumsum(np.concatenate([before[:, None], values], axis=1), axis=1)[:, 1:]
    return summed


def chi_squares(closing: Array, covariance: Array) -> tuple[Array, Array]:
    """Return two chi-squares of each closing: by position, and by position and heading.

    They have 2 and 3 degrees of freedom. Closings are m x 3, and covariances m x 3 x 3.
    """
    (a, b, p), (_, c, q), (_, _, s) = covariance.transpose(1, 2, 0)
    x, y, turned = closing.T
    determinant = a * c - b * b
    by_position = (c * x * x - 2 * b * x * y + a * y * y) / determinant
    gain_x, gain_y = (c * p - b * q) / determinant, (a * q - b * p) / determinant
    left = s - gain_x * p - gain_y * q
    by_heading = (turned - gain_x * x - gain_y * y) ** 2 / left
    return by_position, by_position + by_heading


def vectors_turned(vectors: Array, angles: Array | float) -> Array:
    """Turn vectors of shape (..., 2) counterclockwise by angles in radians."""
    cos, sin = np.cos(angles), np.sin(angles)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def _moved_from_origin(positions: Array) -> Array:
    """Return how twists (see above) move poses at these positions (..., 2): (..., 3, 3)."""
    moved = np.zeros((*positions.shape[:-1], 3, 3))
    moved[..., range(3), range(3)] = 1.0
    moved[..., 0, 2], moved[..., 1, 2] = -positions[..., 1], positions[..., 0]
    return moved
