"""How far off the loops of a trace close: displacements and their covariances, composed along the trace.

>>> from ssh_abduction import Trace >>> from ssh_abduction.theory.evidence.loops import Loops >>>
square = [(10, 0, 0), (0, 0, 1.5708)] * 4 >>> loops = Loops.of(Trace.from_steps("abababab" + "a",
["travel", "left"] * 4, displacements=square)) >>> closing, covariance = loops.closings([0], [8])
>>> bool(abs(closing[0]).max() < 0.001), covariance.shape (True, (1, 3, 3))

A loop leads from step i to a later step j. It closes if the robot is then where it was before. By
the displacements d of the steps between, it closes off by P(j) - P(i), where P is the pose by dead
reckoning: all displacements composed from the first step on. An error e of a displacement that
leads to step k turns all that comes after it. So to first order it moves the end of the loop by

    R(k) e_xy + e_theta S (p(j) - p(k))        where R(k) is the heading before the displacement,
    and S a quarter turn,

and the covariance of the closing is the sum of these over the loop (Smith, Self & Cheeseman 1990,
"Estimating uncertain spatial relationships in robotics"). It is a polynomial in p(j), so that sums
from the first step on give it for any loop at once. Two errors repeat, and are unknown numbers of
the whole trace rather than noise: a wrong scale, and a steady drift of heading. What a robot takes
for the pose of a dstate may be off by itself at each visit, as where the middle of a place is told
from laser scans: that adds to the covariance at both ends of the loop, and does not grow along the
way.

*Where headings are lost.* First order takes an arc for its tangent. An error of heading that is
rare, at SIGMAS standard deviations, bends the way off the tangent by half of itself, as a share of
what first order says it moves the end by. So much is added to the covariance, in all directions:
where the heading is known to a few degrees that is next to nothing, and where it is lost nothing
can be said any more.
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

# Tests that together may refuse a true map once in a thousand traces refuse what is about so many
# standard deviations off.
SIGMAS = 6.0
# Nothing is said of loops after which the heading is uncertain by more than this, in radians: what
# is added for that outweighs any error.
LOST = 1.0
# So many values of a steady drift of heading are tried for each standard deviation of it: a loop is
# refused if it closes badly with each of them.
BENDS_A_SIGMA = 2
# Drifts of more standard deviations than this are as unlikely as what is refused.
MOST_BENDS = 6
# So many steps are worked on in one go: what is computed on the way takes some ten megabytes.
AT_A_TIME = 1000
# The columns of what is known of a step: its pose, and sums up to it.
COLUMNS = 3 + 17 + 3


@dataclass(frozen=True)
class Loops:
    """Dead reckoning of a trace, and the sums from which closings are made.

    poses     by dead reckoning, n x 3, in metres and radians; where a displacement is missing the next pose is that of the step before
    part      for each step, the number of displacements that are missing up to it: nothing is known of loops across one
    moments   sums over the displacements up to each step, n x 17
    ways      metres driven up to each step, and the sum of metres times where they were driven, turned by S: n x 3
    odometry  what is wrong with all displacements
    bend      drift of heading that was taken out of the displacements, in radians a metre
    drift     standard deviation of the drift that is left, in radians a metre
    """

    poses: Array
    part: Steps
    moments: Array
    ways: Array
    odometry: Odometry
    bend: float
    drift: float

    @staticmethod
    def of(trace: Trace, bend: float = 0.0, drift: float | None = None) -> Loops:
        """The loops of a trace, once a drift of heading was taken out of its displacements.

        bend   that drift, in radians a metre
        drift  standard deviation of the drift that is left; what the odometry says if not given
        """
        odometry = trace.odometry or Odometry()
        sums = _sums(trace, 0, len(trace), np.array([bend]), np.zeros((1, COLUMNS)))[0]
        return Loops._of(
            sums, _parts(trace), odometry, bend, odometry.bend if drift is None else drift
        )

    @staticmethod
    def _of(sums: Array, part: Steps, odometry: Odometry, bend: float, drift: float) -> Loops:
        return Loops(sums[..., :3], part, sums[..., 3:20], sums[..., 20:], odometry, bend, drift)

    def closings(self, first: ArrayLike, last: ArrayLike) -> tuple[Array, Array]:
        """How far off loops close, m x 3, and the covariance of that, m x 3 x 3; in metres and radians, and in the frame of the first step of the trace.

        first, last  the steps at which each loop begins and ends, m each
        """
        i, j = np.asarray(first, dtype=int), np.asarray(last, dtype=int)
        closing = self._closing(i, j)
        covariance = self.noise(i, j) + self.repeated(i, j)
        lost = self._heading_variance(i, j)
        moved_by_heading = self._moved_by_heading(i, j)
        bent = (
            (SIGMAS / 2) ** 2 * lost * moved_by_heading + ROUNDED**2 + 2 * self.odometry.offset**2
        )
        covariance[:, 0, 0] += bent
        covariance[:, 1, 1] += bent
        covariance[:, 2, 2] += ROUNDED**2 + 2 * self.odometry.facing**2
        return closing, covariance

    def shared(
        self, loops: tuple[ArrayLike, ArrayLike], others: tuple[ArrayLike, ArrayLike]
    ) -> Array:
        """The covariance between how far off loops close and how far off others do, m x 3 x 3: by the displacements that both have, and what is wrong with all."""
        (i, j), (k, m) = (
            tuple(np.asarray(steps, dtype=int) for steps in pair) for pair in (loops, others)
        )
        begin, end = np.maximum(i, k), np.minimum(j, m)
        covariance = self._white(begin, np.maximum(begin, end), j, m)
        return covariance + self._repeated((i, j), (k, m))

    def _white(self, i: Steps, j: Steps, end: Steps, other_end: Steps) -> Array:
        """What the noise of the displacements after step i, up to j, contributes to the covariance between loops that end at two steps."""
        sums = self.moments[j] - self.moments[i]
        position, mixed, mixed_across = (
            sums[:, :4].reshape(-1, 2, 2),
            sums[:, 4:6],
            sums[:, 6:10].reshape(-1, 2, 2),
        )
        angle, angle_across, angle_square = (
            sums[:, 10],
            sums[:, 11:13],
            sums[:, 13:17].reshape(-1, 2, 2),
        )
        a, b = _quarter_turned(self.poses[end, :2]), _quarter_turned(self.poses[other_end, :2])
        covariance = np.empty((len(sums), 3, 3))
        covariance[:, :2, :2] = (
            position
            + mixed[:, :, None] * b[:, None, :]
            - mixed_across
            + a[:, :, None] * mixed[:, None, :]
            - mixed_across.transpose(0, 2, 1)
            + angle[:, None, None] * a[:, :, None] * b[:, None, :]
            - a[:, :, None] * angle_across[:, None, :]
            - angle_across[:, :, None] * b[:, None, :]
            + angle_square
        )
        covariance[:, :2, 2] = mixed + angle[:, None] * a - angle_across
        covariance[:, 2, :2] = mixed + angle[:, None] * b - angle_across
        covariance[:, 2, 2] = angle
        return covariance

    def _repeated(self, loops: tuple[Steps, Steps], others: tuple[Steps, Steps]) -> Array:
        """What a wrong scale and a steady drift contribute to the covariance between closings."""
        scaled, other_scaled = (self._by_scale(*pair) for pair in (loops, others))
        bent, other_bent = (self._by_bend(*pair) for pair in (loops, others))
        by_scale: Array = self.odometry.scale**2 * scaled[:, :, None] * other_scaled[:, None, :]
        return by_scale + self.drift**2 * bent[:, :, None] * other_bent[:, None, :]

    def _closing(self, i: Steps, j: Steps) -> Array:
        closing = self.poses[j] - self.poses[i]
        closing[:, 2] = np.remainder(closing[:, 2] + math.pi, math.tau) - math.pi
        return closing

    def _by_scale(self, i: Steps, j: Steps) -> Array:
        """How a scale that is wrong by 1 moves the end of each loop."""
        return (self.poses[j] - self.poses[i]) * (1.0, 1.0, 0.0)

    def _by_bend(self, i: Steps, j: Steps) -> Array:
        """How a drift of 1 radian a metre moves the end of each loop."""
        sums = self.ways[j] - self.ways[i]
        return np.hstack(
            [sums[:, :1] * _quarter_turned(self.poses[j, :2]) - sums[:, 1:], sums[:, :1]]
        )

    def _heading_variance(self, i: Steps, j: Steps) -> Array:
        variance: Array = (
            self.moments[j, 10]
            - self.moments[i, 10]
            + (self.drift * (self.ways[j, 0] - self.ways[i, 0])) ** 2
        )
        return variance

    def _moved_by_heading(self, i: Steps, j: Steps) -> Array:
        """The variance of the end of each loop, in both directions together, that comes of errors of heading."""
        sums = self.moments[j] - self.moments[i]
        end = _quarter_turned(self.poses[j, :2])
        white = (
            sums[:, 10] * (end**2).sum(1)
            - 2 * (end * sums[:, 11:13]).sum(1)
            + sums[:, 13]
            + sums[:, 16]
        )
        moved: Array = np.maximum(white, 0.0) + self.drift**2 * (
            self._by_bend(i, j)[:, :2] ** 2
        ).sum(1)
        return moved

    def of_ends(self, end: int) -> Array:
        """What the noise of the displacements up to each step contributes to the covariance of where the robot is at step `end`, n x 9."""
        every = np.arange(end + 1)
        there = np.full(end + 1, end)
        return self._white(np.zeros_like(every), every, there, there).reshape(-1, 9)

    def noise(self, first: Steps, last: Steps) -> Array:
        """What the noise of the displacements from one step to a later one contributes to the covariance of where the robot is at the later one, m x 3 x 3."""
        return self._white(first, last, last, last)

    def repeated(self, first: Steps, last: Steps) -> Array:
        """What a wrong scale and a steady drift contribute to the covariances of closings, m x 3 x 3."""
        return self._repeated((first, last), (first, last))


class Reckoning:
    """Dead reckoning of a trace, for each drift of heading that it may have. No drift comes first.

    bends     the drifts, in radians a metre
    unlikely  the chi-square of each
    begins    for each step, the first step from which on it is known where this one is: no
        displacement is missing since, and the heading is not lost.
              That is the same whatever the drift, and of a longer trace, too
    """

    def __init__(self, trace: Trace, before: Reckoning | None = None) -> None:
        """The reckoning of a trace.

        before  that of a trace which has grown to this one
        """
        self.odometry = trace.odometry or Odometry()
        sigma = self.odometry.bend
        step = sigma / BENDS_A_SIGMA
        numbers = (
            sorted(range(-MOST_BENDS * BENDS_A_SIGMA, MOST_BENDS * BENDS_A_SIGMA + 1), key=abs)
            if sigma
            else [0]
        )
        self.bends = [number * step for number in numbers]
        # Each drift stands for those around it, and counts as the nearest of them.
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
        """The loops for one of the drifts."""
        return Loops._of(
            self._rows.array[number, : self._size],
            self._part,
            self.odometry,
            self.bends[number],
            self._drift,
        )

    def loops_of_unknown_drift(self) -> Loops:
        """The loops without a drift, where any that the odometry allows is left."""
        return Loops._of(
            self._rows.array[0, : self._size], self._part, self.odometry, 0.0, self.odometry.bend
        )

    def closings(self, numbers: Steps, first: Steps, last: Steps) -> tuple[Array, Array]:
        """As `Loops.closings`, but for loops each of which has a drift of its own."""
        array = self._rows.array
        flat = Loops._of(array.reshape(-1, COLUMNS), self._part, self.odometry, 0.0, self._drift)
        offset = numbers * array.shape[1]
        return flat.closings(first + offset, last + offset)

    def _begins(self, known: Steps) -> Steps:
        loops = self.loops(0)
        start = len(known)
        begin = int(known[-1]) if start else 0
        since = slice(begin, None)
        angle, way, part = (
            loops.moments[since, 10].tolist(),
            loops.ways[since, 0].tolist(),
            loops.part[since].tolist(),
        )
        found, shift = [], begin
        # The beginning never goes back, as the heading gets no better.
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
    """Rows of numbers for each drift, drifts x rows x columns, to which more are added where room was left: so a step costs what it adds, mostly."""

    def __init__(self, array: Array, size: int | None = None) -> None:
        self.array = array
        self._size = array.shape[1] if size is None else size
        self._lock = Lock()

    def extended(self, size: int, new: Array) -> _Rows:
        """The first `size` rows, and new ones.

        The array is the same, unless there is no room or somebody else added other rows.
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
    """For each step from `start` on, the number of displacements that are missing up to it, where so many are missing before."""
    unknown = [t > 0 and trace.steps[t].displacement is None for t in range(start, len(trace))]
    parts: Steps = missing + np.cumsum(unknown, dtype=int)
    return parts


def _sums(trace: Trace, start: int, stop: int, bends: Array, last: Array) -> Array:
    """The poses, moments and ways of some steps, as in Loops, for each drift: drifts x steps x COLUMNS.

    last  those of the step before, drifts x COLUMNS; zeros where there is none
    """
    moved, noise = np.zeros((stop - start, 3)), np.zeros((stop - start, 3, 3))
    for t in range(max(start, 1), stop):
        displacement = trace.steps[t].displacement
        if displacement is not None:
            moved[t - start], noise[t - start] = displacement, trace.covariance(t)
    way = np.hypot(moved[:, 0], moved[:, 1])
    rotated = moved[:, 2] - bends[:, None] * way
    straight = turned(moved[None, :, :2], -bends[:, None] * way / 2)
    heading = _summed(last[:, 2], rotated)
    before = heading - rotated  # the heading in which each displacement begins
    onward = turned(straight, before)
    position = _summed(last[:, :2], onward)
    rotation = np.zeros((*before.shape, 3, 3))
    rotation[..., 0, 0] = rotation[..., 1, 1] = np.cos(before)
    rotation[..., 1, 0], rotation[..., 0, 1], rotation[..., 2, 2] = (
        np.sin(before),
        -np.sin(before),
        1.0,
    )
    noise = rotation @ noise @ rotation.swapaxes(-1, -2)
    across = _quarter_turned(position)
    angle, mixed = noise[..., 2, 2], noise[..., :2, 2]
    middle = position - onward / 2
    ways = np.broadcast_to(way, before.shape)[..., None]
    columns = [
        noise[..., :2, :2].reshape(*before.shape, 4),
        mixed,
        (mixed[..., :, None] * across[..., None, :]).reshape(*before.shape, 4),
        angle[..., None],
        angle[..., None] * across,
        (angle[..., None, None] * across[..., :, None] * across[..., None, :]).reshape(
            *before.shape, 4
        ),
        ways,
        ways * _quarter_turned(middle),
    ]
    sums = _summed(last[:, 3:], np.concatenate(columns, axis=-1))
    return np.concatenate([position, heading[..., None], sums], axis=-1)


def _summed(before: Array, values: Array) -> Array:
    """Sums of values along the second axis, which go on from what was summed before."""
    summed: Array = np.cumsum(np.concatenate([before[:, None], values], axis=1), axis=1)[:, 1:]
    return summed


def chi_squares(closing: Array, covariance: Array) -> tuple[Array, Array]:
    """For each closing, its chi-square by position alone (2 degrees of freedom), and by position and heading (3)."""
    (a, b, p), (_, c, q), (_, _, s) = covariance.transpose(1, 2, 0)
    x, y, turned = closing.T
    determinant = a * c - b * b
    by_position = (c * x * x - 2 * b * x * y + a * y * y) / determinant
    gain_x, gain_y = (c * p - b * q) / determinant, (a * q - b * p) / determinant
    left = s - gain_x * p - gain_y * q
    by_heading = (turned - gain_x * x - gain_y * y) ** 2 / left
    return by_position, by_position + by_heading


def turned(vectors: Array, angles: Array) -> Array:
    """Vectors, ... x 2, turned counterclockwise by angles."""
    cos, sin = np.cos(angles), np.sin(angles)
    return np.stack(
        [
            cos * vectors[..., 0] - sin * vectors[..., 1],
            sin * vectors[..., 0] + cos * vectors[..., 1],
        ],
        axis=-1,
    )


def _quarter_turned(vectors: Array) -> Array:
    """Vectors, ... x 2, turned counterclockwise by a quarter."""
    return np.stack([-vectors[..., 1], vectors[..., 0]], axis=-1)
