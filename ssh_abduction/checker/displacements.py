"""Check the returns of a map against the displacements of its trace (axiom `one_pose`).

A return is two steps that the map has at one place or dstate. Its loop is the way between these
steps. `ErrorFilter` computes the error with which a loop closes, and the covariance of this error.

Returns are tested alone and in pairs by their chi-square. Most pairs need no test, because a bound
shows that they are not rejected. Let z and y be the chi-squares of the two returns alone. Let M be
the inverse of the covariance of the later return, times the covariance of the noise that both
returns share. If s is at least the greatest eigenvalue of M, the chi-square of the pair is at most
(z + y) / (1 - sqrt(s)). The trace of M is such an s. It is fast to compute, as the difference of
two values of a table.

The error of the robot's pose is predicted as in a Kalman filter. Let E(t) be the error of the pose
by dead reckoning at step t, in the frame of the first step, and V(t) its covariance. An error at
step i persists at a later step j, rotated about the position of the robot at step i:

    F(j, i) = [[1, S (p(j) - p(i))], [0, 1]]        with S a quarter turn, and p the position.

The loop from step i to step j closes with the error E(j) - F(j, i) E(i). The covariance of this
error is V(j) - F(j, i) V(i) F(j, i)', because the noise of each step is independent of the steps
before. Two loops share the noise between the later of their first steps and the earlier of their
last steps. Two more errors, a wrong scale and a drift of the heading, are constant over the whole
trace.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammainccinv

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.odometry import Odometry
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.theory.theory import Theory

Steps: TypeAlias = NDArray[np.int_]
# Two steps, and the degrees of freedom: 2 at one place, 3 at one dstate.
Return: TypeAlias = tuple[int, int, int]

# The number of pairs of returns that numpy works on at once.
AT_A_TIME = 50_000
# If the bound leaves more pairs of returns than this, test only about this many of them, evenly
# spread. That takes a second or two.
MOST_SETS = 300_000
# The bound must hold with this margin, because numbers are rounded.
MARGIN = 1e-3
# The numbers of `one_pose` in docs/explanation/theory.md. SIGMAS: up to how many standard
# deviations of the heading the error of linearisation is bounded. LOST: the standard deviation in
# radians above which a heading is unknown. BENDS_A_SIGMA: how many drifts are tried per standard
# deviation. MOST_BENDS: the greatest drift, in standard deviations. ROUNDED: the rounding error in
# metres and radians.
SIGMAS, LOST, BENDS_A_SIGMA, MOST_BENDS, ROUNDED = 6.0, 1.0, 2, 6, 1e-3
# The number of steps or returns between two checks of the time limit. They take some milliseconds.
FEW = 64


@dataclass(frozen=True)
class Refused:
    """One return, or a pair of returns, that the displacements reject.

    Attributes:
        returns: For each return, its two steps and its degrees of freedom (2 for a place, 3 for a
            dstate).
        why: How far apart the steps of a single return are, or how far off two loops close.
        square: The chi-square of all returns together.
        most: The threshold that the chi-square exceeds.
    """

    returns: tuple[Return, ...]
    why: str
    square: float
    most: float


def refused_returns(
    trace: Trace, ssh_map: SSHMap, theory: Theory, since: int = 0
) -> Iterator[Refused]:
    """Find the single returns and the pair of returns that displacements reject most clearly.

    Yields at most one return to a place, one return to a dstate, and then one pair of returns. In
    the theory no field is "auto", and `returns` is the number of tests. Skips returns before step
    `since` that no displacement relates to that step, such as those of earlier drives.
    """
    if not trace.has_displacements:
        return
    drifts = Drifts(trace)
    returns = [*_returns(trace, ssh_map, theory, drifts, since)]
    for one, square, most in _refused_alone(returns, drifts, theory):
        yield Refused((one,), _apart(trace, *one), square, most)
    if theory.joint > 1:
        arrivals = [*_returns(trace, ssh_map, theory, drifts, since, of_arrivals=True)]
        for pair, square, most in _refused_together(arrivals, drifts, theory):
            yield Refused(pair, _off_together(trace, pair), square, most)


def _apart(trace: Trace, first: int, last: int, freedom: int) -> str:
    """Say how far apart two steps are by dead reckoning.

    The poses assume no drift of the heading. A possible drift adds to the standard deviations.
    """
    odometry = trace.odometry or Odometry()
    filtered = ErrorFilter(trace.prefix(last + 1), odometry, 0.0, odometry.bend)
    off, covariance = filtered.closing(first, last), filtered.covariance(first, last)
    size = float(np.hypot(*off[:2]))
    ahead = off[:2] / size if size else np.array([1.0, 0.0])
    sigma = math.sqrt(ahead @ covariance[:2, :2] @ ahead)
    turned, doubt = (math.degrees(x) for x in (abs(off[2]), math.sqrt(covariance[2, 2])))
    headings = f" and {turned:.0f} ± {doubt:.0f} degrees" if freedom == 3 else ""
    return f"they are {size:.1f} ± {sigma:.1f} m{headings} apart"


def _off_together(trace: Trace, pair: Sequence[Return]) -> str:
    """Say how far off the loops of two returns close by dead reckoning."""
    poses = ErrorFilter(trace, trace.odometry or Odometry(), 0.0, 0.0)
    moves = [np.hypot(*step.displacement[:2]) if step.displacement else 0.0 for step in trace.steps]
    ways = " and ".join(f"{math.fsum(moves[i + 1 : j + 1]):.0f} m" for i, j, _ in pair)
    sizes = " and ".join(f"{np.hypot(*poses.closing(i, j)[:2]):.1f} m" for i, j, _ in pair)
    return f"the loops of {ways} close {sizes} off"


def _returns(
    trace: Trace,
    ssh_map: SSHMap,
    theory: Theory,
    drifts: Drifts,
    since: int,
    of_arrivals: bool = False,
) -> Iterator[Return]:
    """Yield the returns with a known closing error: first step, last step, degrees of freedom.

    Returns to places are between the first steps of visits. So are returns to dstates with
    `of_arrivals`; else they are between any steps. The first stretch of the trace without a missing
    displacement that has returns here is the one of step `since`.
    """
    place = {s.id: s.place for s in ssh_map.dstates}
    size = min(len(trace), len(ssh_map.dstate_at))
    labels = ssh_map.dstate_at[:size]
    begin = int(np.searchsorted(drifts.none.broken, drifts.none.broken[since]))
    arrived = [t for t in range(begin, size) if t == 0 or trace.actions[t - 1].kind != "turn"]
    groups: dict[tuple[int, int], list[int]] = defaultdict(list)
    for t in arrived if of_arrivals else range(begin, size):
        groups[3, labels[t]].append(t)
    for t in arrived if theory.level == "topological" else ():
        there = place.get(labels[t])
        if there is not None:
            groups[2, there].append(t)
    for (freedom, _), steps in groups.items():
        for number, last in enumerate(steps):
            if number % FEW == FEW - 1:
                look_at_clock()
            if number:
                first = np.array(steps[:number], dtype=int)
                yield from (
                    (int(i), last, freedom)
                    for i in first[drifts.none.is_known(first, np.full(number, last))]
                )


def _most(theory: Theory, freedom: int, together: bool) -> float:
    """Compute the chi-square above which a return, or (`together`) a pair, is rejected."""
    share = theory.reject / 2 if theory.joint > 1 else theory.reject
    tests = theory.returns * (theory.returns - 1) / 2 if together else theory.returns
    return float(2 * gammainccinv(freedom / 2, share / max(tests, 1)))


def _refused_alone(
    returns: Sequence[Return], drifts: Drifts, theory: Theory
) -> Iterator[tuple[Return, float, float]]:
    """Find the return to a place and the return to a dstate that are rejected most clearly.

    Each comes with its chi-square, and the threshold that it exceeds.
    """
    for freedom in (2, 3) if returns else ():
        rows = np.array([r for r in returns if r[2] == freedom], dtype=int).reshape(-1, 3)
        most, least = _most(theory, freedom, together=False), np.full(len(rows), np.inf)
        for filtered, unlikely in drifts:
            left = np.flatnonzero(least > most)
            if not len(left):
                break
            square = _square(*_alone(filtered, rows[left])) + unlikely
            is_known = filtered.is_known(rows[left, 0], rows[left, 1])
            least[left] = np.minimum(least[left], np.where(is_known, square, 0.0))
        if len(rows) and least.max() > most:
            worst = int(least.argmax())
            yield _return_of(rows[worst]), float(least[worst]), most


def _refused_together(
    returns: Sequence[Return], drifts: Drifts, theory: Theory
) -> Iterator[tuple[tuple[Return, Return], float, float]]:
    """Find the pair of returns that is rejected most clearly, with chi-square and threshold.

    If the bound leaves more than MOST_SETS pairs to test, about MOST_SETS of them, evenly spread,
    are tested.
    """
    if len(returns) < 2:
        return
    rows = np.array(sorted(returns, key=lambda r: r[1]), dtype=int).reshape(-1, 3)
    thresholds = {freedom: _most(theory, freedom, together=True) for freedom in (4, 5, 6)}
    worst: list[tuple[tuple[Return, Return], float, float]] = []
    clearest = 0.0
    for first, second in _sets(rows, drifts.none, min(thresholds.values())):
        least = np.full(len(first), np.inf)
        most = np.array([thresholds[f] for f in (rows[first, 2] + rows[second, 2]).tolist()])
        for filtered, unlikely in drifts:
            left = np.flatnonzero(least > most)
            if not len(left):
                break
            square = _square_together(filtered, rows, first[left], second[left])
            least[left] = np.minimum(least[left], square + unlikely)
        # the clearest pair exceeds its threshold most
        excess = least - most
        if len(excess) and excess.max() > clearest:
            k = int(excess.argmax())
            pair = _return_of(rows[first[k]]), _return_of(rows[second[k]])
            clearest, worst = float(excess[k]), [(pair, float(least[k]), float(most[k]))]
    yield from worst


def _sets(rows: Steps, filtered: ErrorFilter, most: float) -> Iterator[tuple[Steps, Steps]]:
    """Yield the pairs of returns whose loops overlap and that need a test, in portions.

    A portion is two arrays: for each pair, the indices of its two returns in `rows`. `rows` is of
    shape (m, 3): the first step, last step and degrees of freedom of each return, sorted by last
    step. `most` is the least chi-square that may be rejected.
    """
    alone = _EachReturn(filtered, rows)
    found = []
    for end in np.unique(rows[:, 1]):
        look_at_clock()
        found.append(_unsafe(filtered, rows, alone, int(end), most))
    empty = np.zeros(0, dtype=int)
    first, second = (np.concatenate([empty, *(pair[k] for pair in found)]) for k in (0, 1))
    every = max(1, math.ceil(len(first) / MOST_SETS))
    for start in range(0, len(first), every * AT_A_TIME):
        portion = slice(start, start + every * AT_A_TIME, every)
        yield first[portion], second[portion]


class _EachReturn:
    """Values of m returns, each taken alone.

    Attributes:
        inverse: The inverse of the covariance of each closing error. Shape (m, 9).
        square: The chi-square of each return. Shape (m,).
        repeated: The part of each covariance that scale and drift cause. Shape (m, 9).
    """

    def __init__(self, filtered: ErrorFilter, rows: Steps) -> None:
        off, covariance = _alone(filtered, rows)
        repeated = filtered.repeated_since(rows[:, 0], rows[:, 1])
        inverse = np.linalg.inv(covariance)
        inverse[rows[:, 2] == 2, 2, 2] = 0.0
        self.square = np.einsum("mi,mij,mj->m", off, inverse, off)
        self.inverse = inverse.reshape(-1, 9)
        self.repeated = (repeated @ repeated.swapaxes(1, 2)).reshape(-1, 9)


def _alone(filtered: ErrorFilter, rows: Steps) -> tuple[Array, Array]:
    """Compute the closing errors, (m, 3), of returns and their covariances, (m, 3, 3).

    The heading of a return to a place does not count: its error is 0 and its variance 1.
    """
    first, last, free = rows[:, 0], rows[:, 1], rows[:, 2] == 2
    off, covariance = filtered.closing(first, last), filtered.covariance(first, last)
    off[free, 2] = covariance[free, 2, :2] = covariance[free, :2, 2] = 0.0
    covariance[free, 2, 2] = 1.0
    return off, covariance


def _unsafe(
    filtered: ErrorFilter, rows: Steps, alone: _EachReturn, end: int, most: float
) -> tuple[Steps, Steps]:
    """Find the pairs that need a test among those whose later return ends at step `end`."""
    later = np.arange(*np.searchsorted(rows[:, 1], [end, end + 1]))
    earlier = np.arange(
        np.searchsorted(rows[:, 1], rows[later, 0].min(), side="right"), later[-1] + 1
    )
    first, stop = rows[later, 0], rows[earlier, 1, None]
    new, at_end = filtered.new_until(end), filtered.at_end.ravel()
    table = new @ alone.inverse[later].T
    begin = np.maximum(rows[earlier, 0, None], first)
    trace = (
        table[rows[earlier, 1]]
        - np.take_along_axis(table, begin, axis=0)
        + (alone.inverse[later] * alone.repeated[later]).sum(1)
        + _common_ends(rows, earlier[:, None], later) * (alone.inverse[later] @ at_end)
    )
    squares = alone.square[earlier, None] + alone.square[later]
    left = 1 - squares / most
    is_safe = (left > 0) & (trace + MARGIN <= left**2)
    others, these = np.nonzero(~is_safe & (stop > first) & (earlier[:, None] < later))
    return earlier[others], later[these]


def _common_ends(rows: Steps, here: Steps, others: Steps) -> Steps:
    """Count the common ends of the loops of the returns `here` and `others` (indices)."""
    same: Steps = (rows[here, :2] == rows[others, :2]).sum(-1)
    return same


def _square_together(filtered: ErrorFilter, rows: Steps, here: Steps, others: Steps) -> Array:
    """Compute the chi-square of each pair of returns; 0 if a closing error is unknown."""
    one, other = rows[here], rows[others]
    begin, end = np.maximum(one[:, 0], other[:, 0]), np.minimum(one[:, 1], other[:, 1])
    mixed = (
        filtered.onward(end, one[:, 1])
        @ filtered.since(begin, end)
        @ filtered.onward(end, other[:, 1]).swapaxes(1, 2)
    )
    repeated = [filtered.repeated_since(row[:, 0], row[:, 1]) for row in (one, other)]
    mixed += repeated[0] @ repeated[1].swapaxes(1, 2)
    mixed += _common_ends(rows, here, others)[:, None, None] * filtered.at_end
    mixed[one[:, 2] == 2, 2, :] = mixed[other[:, 2] == 2, :, 2] = 0.0
    (off, covariance), (other_off, other_covariance) = (
        _alone(filtered, row) for row in (one, other)
    )
    joint = np.block([[covariance, mixed], [mixed.swapaxes(1, 2), other_covariance]])
    is_known = [filtered.is_known(row[:, 0], row[:, 1]) for row in (one, other)]
    square = _square(np.hstack([off, other_off]), joint)
    return np.where(is_known[0] & is_known[1], square, 0.0)


def _square(off: Array, covariance: Array) -> Array:
    """Compute the chi-squares of closing errors `off`, m x k, with covariances, m x k x k."""
    square: Array = np.einsum("mi,mi->m", off, np.linalg.solve(covariance, off[..., None])[..., 0])
    return square


def _return_of(row: Steps) -> Return:
    """Convert a row of an array (first step, last step, degrees of freedom) to a tuple."""
    first, last, freedom = map(int, row)
    return first, last, freedom


Array: TypeAlias = NDArray[np.float64]


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
        """Split the covariance at `end` by the step that each noise comes from: (end + 1, 9)."""
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
    the drift itself. Poses are computed at their first use. `none` is the filter without a drift.
    """

    def __init__(self, trace: Trace) -> None:
        odometry = trace.odometry or Odometry()
        step = odometry.bend / BENDS_A_SIGMA
        self._filter = cache(lambda n: ErrorFilter(trace, odometry, n * step, step / 2))
        most = MOST_BENDS * BENDS_A_SIGMA if odometry.bend else 0
        self._numbers = sorted(range(-most, most + 1), key=lambda n: (abs(n), n))
        self.none = self._filter(0)

    def __iter__(self) -> Iterator[tuple[ErrorFilter, float]]:
        for n in self._numbers:
            look_at_clock()
            yield self._filter(n), max(abs(n) - 0.5, 0.0) ** 2 / BENDS_A_SIGMA**2
