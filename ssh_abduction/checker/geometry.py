"""Whether the returns of a map agree with the displacements of its trace: the judge's own account of the axiom `one_pose`.

It follows the error of the robot's pose as a Kalman filter predicts it. Let E(t) be the error of the pose by dead reckoning at step t, in the frame of the
first step, and V(t) its covariance. What was wrong at step i is wrong at a later step j, too, turned about where the robot was:

    F(j, i) = [[1, S (p(j) - p(i))], [0, 1]]        with S a quarter turn, and p where the robot was.

So the loop from i to j closes with the error E(j) - F(j, i) E(i). Its covariance is V(j) - F(j, i) V(i) F(j, i)', as what is new at each step is independent of what
was before; and two loops have in common what was new between the later of their beginnings b and the earlier of their ends e. A scale that is wrong and a
heading that drifts are carried along as two more errors, which never change.

Most sets of two are passed by a bound. Let z and y be the chi-squares of two returns alone. If what both have in common is a share s of what there is of the first
one, in any direction, at most, then together they have a chi-square of (z + y) / (1 - sqrt(s)) at most. The trace of the share is a bound on it, and is the difference
of two values of a table; so is the share itself, and the square root of the trace of its square is another bound.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammainccinv

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.odometry import Odometry
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.theory.theory import Theory

Array: TypeAlias = NDArray[np.float64]
Steps: TypeAlias = NDArray[np.int_]
Return: TypeAlias = tuple[
    int, int, int
]  # two steps, and the degrees of freedom: 2 at one place, 3 at one dstate
_Found: TypeAlias = tuple[
    tuple[Return, ...], float, float
]  # returns that are refused, their chi-square and the threshold

# What docs/explanation/theory.md says of one_pose: the errors of heading that are reckoned with, the uncertainty at which a heading is lost, the steps in which a drift is tried and how far.
SIGMAS, LOST, BENDS_A_SIGMA, MOST_BENDS, ROUNDED = 6.0, 1.0, 2, 6, 1e-3
# So many sets are worked on in one go.
AT_A_TIME = 50_000
# Of a map with more sets of two returns that the bound does not pass so many are looked at, which takes a second or two.
MOST_SETS = 300_000
# A bound passes a set only if it is this far from not doing so, as numbers are rounded.
MARGIN = 1e-3
# Between two looks at the clock so many steps or returns are read, which takes some milliseconds.
FEW = 64


@dataclass(frozen=True)
class Closing:
    """How far off a loop closes by dead reckoning, with standard deviations, in metres and degrees, and how many metres it is long."""

    way: float
    size: float
    size_sigma: float
    turned: float
    turned_sigma: float


@dataclass(frozen=True)
class Refused:
    """Returns of a map that are refused, alone or two together: their steps, how far off they close, and the chi-square of that and its threshold."""

    returns: tuple[Return, ...]
    closings: tuple[Closing, ...]
    square: float
    most: float

    def __str__(self) -> str:
        """In words: how far apart the steps of one return are, or how far off the loops of two close."""
        if len(self.closings) == 2:
            ways, sizes = (
                " and ".join(f"{value:{form}} m" for value in values)
                for form, values in self._of_loops()
            )
            return f"the loops of {ways} close {sizes} off"
        closing, (_, _, freedom) = self.closings[0], self.returns[0]
        turned = (
            f" and {closing.turned:.0f} ± {closing.turned_sigma:.0f} degrees"
            if freedom == 3
            else ""
        )
        return f"they are {closing.size:.1f} ± {closing.size_sigma:.1f} m{turned} apart"

    def _of_loops(self) -> Iterator[tuple[str, list[float]]]:
        yield ".0f", [closing.way for closing in self.closings]
        yield ".1f", [closing.size for closing in self.closings]


def refused_returns(trace: Trace, ssh_map: SSHMap, theory: Theory) -> Iterator[Refused]:
    """The return of a map that is refused most clearly, and the set of two, if there are any.

    trace   the whole trace
    theory  resolved, so that it says how many returns may be true
    """
    if not trace.has_displacements:
        return
    drifts = _Drifts(trace)
    for returns, square, most in _refused(trace, ssh_map, theory, drifts):
        yield Refused(returns, tuple(_closing(trace, i, j) for i, j, _ in returns), square, most)


def _refused(trace: Trace, ssh_map: SSHMap, theory: Theory, drifts: _Drifts) -> Iterator[_Found]:
    """What is refused alone comes first: it is found fast, and a caller may need no more."""
    yield from _refused_alone(list(_returns(trace, ssh_map, theory, drifts)), drifts, theory)
    if theory.joint > 1:
        yield from _refused_together(
            list(_returns(trace, ssh_map, theory, drifts, of_arrivals=True)), drifts, theory
        )


def _closing(trace: Trace, first: int, last: int) -> Closing:
    """How far off a loop closes if the heading drifts by nothing; that it may drift is part of the uncertainty."""
    odometry = trace.odometry or Odometry()
    filtered = _Filter(trace.prefix(last + 1), odometry, 0.0, odometry.bend)
    off, covariance = filtered.closing(first, last), filtered.covariance(first, last)
    size = float(np.hypot(*off[:2]))
    ahead = off[:2] / size if size else np.array([1.0, 0.0])
    return Closing(
        way=math.fsum(
            math.hypot(*step.displacement[:2])
            for step in trace.steps[first + 1 : last + 1]
            if step.displacement
        ),
        size=size,
        size_sigma=math.sqrt(ahead @ covariance[:2, :2] @ ahead),
        turned=math.degrees(abs(off[2])),
        turned_sigma=math.degrees(math.sqrt(covariance[2, 2])),
    )


class _Filter:
    """Poses by dead reckoning, and the covariance of their errors, of pose (3), scale and drift."""

    def __init__(self, trace: Trace, odometry: Odometry, bend: float, drift: float) -> None:
        size = len(trace)
        self.pose = np.zeros((size, 3))
        self.white = np.zeros((size, 3, 3))  # covariance of the error of the pose by noise alone
        self.repeated = np.zeros(
            (size, 3, 2)
        )  # how the pose moves with the scale, and with the drift
        self.broken = np.zeros(size, dtype=int)  # displacements that are missing so far
        self.sigma = np.array([odometry.scale, drift])
        self.at_ends = (
            2 * np.diag([odometry.offset, odometry.offset, odometry.facing]) ** 2
        )  # where a dstate is taken to be, at both ends of a loop
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
        """F(last, first), m x 3 x 3."""
        return _onward(self.pose[last, :2] - self.pose[first, :2])

    def since(self, first: Any, last: Any) -> Array:
        """The covariance, by noise alone, of what went wrong between two steps."""
        onward = self.onward(first, last)
        covariance: Array = self.white[last] - onward @ self.white[first] @ onward.swapaxes(-1, -2)
        return covariance

    def new_until(self, end: int) -> Array:
        """The covariance, by noise alone, that what went wrong up to each step has at step `end`, m x 9."""
        steps = np.arange(end + 1)
        onward = self.onward(steps, np.full(end + 1, end))
        covariance: Array = (onward @ self.white[: end + 1] @ onward.swapaxes(-1, -2)).reshape(
            -1, 9
        )
        return covariance

    def repeated_since(self, first: Any, last: Any) -> Array:
        """How a loop moves with the scale and the drift, times the standard deviation of these: m x 3 x 2."""
        moved: Array = (
            self.repeated[last] - self.onward(first, last) @ self.repeated[first]
        ) * self.sigma
        return moved

    def covariance(self, first: Any, last: Any) -> Array:
        """The covariance of closings, with what is added as errors of heading are no longer small."""
        white, repeated = self.since(first, last), self.repeated_since(first, last)
        heading = self.lost(first, last)
        moved = self._moved_by_heading(first, last) + (repeated[..., :2, 1] ** 2).sum(-1)
        bent = (SIGMAS / 2) ** 2 * heading * moved + ROUNDED**2
        added = (
            bent[..., None, None] * np.diag([1.0, 1.0, 0.0])
            + ROUNDED**2 * np.diag([0.0, 0.0, 1.0])
            + self.at_ends
        )
        total: Array = white + repeated @ repeated.swapaxes(-1, -2) + added
        return total

    def lost(self, first: Any, last: Any) -> Array:
        """The variance of the heading at the end of loops."""
        variance: Array = (
            self.since(first, last)[..., 2, 2] + self.repeated_since(first, last)[..., 2, 1] ** 2
        )
        return variance

    def _moved_by_heading(self, first: Any, last: Any) -> Array:
        """The variance of the end of loops that comes of the noise of headings: the sum, over the steps of a loop, of that noise times the squared distance to the end."""
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
        """Whether loops have all their displacements, and the heading is not lost along any loop that ends where they do and begins later."""
        known: NDArray[np.bool_] = (self.broken[first] == self.broken[last]) & (
            self.lost(first, last) <= LOST**2
        )
        return known

    def closing(self, first: Any, last: Any) -> Array:
        """How far off loops close, m x 3."""
        off: Array = self.pose[last] - self.pose[first]
        off[..., 2] = (off[..., 2] + math.pi) % math.tau - math.pi
        return off


def _onward(moved: Array) -> Array:
    """What an error of the pose becomes once the robot has moved on by so much, m x 2."""
    onward = np.zeros((*moved.shape[:-1], 3, 3))
    onward[..., range(3), range(3)] = 1.0
    onward[..., 0, 2], onward[..., 1, 2] = -moved[..., 1], moved[..., 0]
    return onward


class _Drifts:
    """The poses for each drift of the heading, and the chi-square of that drift, no drift first. Each is made when it is first asked for."""

    def __init__(self, trace: Trace) -> None:
        self._trace, self._odometry = trace, trace.odometry or Odometry()
        self._made: dict[int, _Filter] = {}

    @property
    def none(self) -> _Filter:
        """The poses without a drift."""
        return self._filter(0)

    def _filter(self, number: int) -> _Filter:
        step = self._odometry.bend / BENDS_A_SIGMA
        if number not in self._made:
            self._made[number] = _Filter(self._trace, self._odometry, number * step, step / 2)
        return self._made[number]

    def __iter__(self) -> Iterator[tuple[_Filter, float]]:
        numbers = (
            range(-MOST_BENDS * BENDS_A_SIGMA, MOST_BENDS * BENDS_A_SIGMA + 1)
            if self._odometry.bend
            else [0]
        )
        for n in sorted(numbers, key=lambda n: (abs(n), n)):
            look_at_clock()
            yield self._filter(n), max(abs(n) - 0.5, 0.0) ** 2 / BENDS_A_SIGMA**2


def _returns(
    trace: Trace, ssh_map: SSHMap, theory: Theory, drifts: _Drifts, of_arrivals: bool = False
) -> Iterator[Return]:
    """The returns of a map about which displacements say something; all of them, or those between the first steps of visits."""
    place = {s.id: s.place for s in ssh_map.dstates}
    size = min(len(trace), len(ssh_map.labels))
    labels = ssh_map.labels[:size]
    arrived = [t for t in range(size) if t == 0 or trace.actions[t - 1].kind != "turn"]
    groups: dict[tuple[int, int], list[int]] = defaultdict(list)
    for t in arrived if of_arrivals else range(size):
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
    """The chi-square above which returns are refused."""
    share = theory.reject / 2 if theory.joint > 1 else theory.reject
    tests = theory.returns * (theory.returns - 1) / 2 if together else theory.returns
    return float(2 * gammainccinv(freedom / 2, share / max(tests, 1)))


def _refused_alone(returns: Sequence[Return], drifts: _Drifts, theory: Theory) -> Iterator[_Found]:
    for freedom in (2, 3) if returns else ():
        rows = np.array([r for r in returns if r[2] == freedom], dtype=int).reshape(-1, 3)
        most, least = _most(theory, freedom, together=False), np.full(len(rows), np.inf)
        for filtered, unlikely in drifts:
            left = np.flatnonzero(least > most)
            if not len(left):
                break
            first, last = rows[left, 0], rows[left, 1]
            square = _square(
                filtered.closing(first, last)[:, :freedom],
                filtered.covariance(first, last)[:, :freedom, :freedom],
            )
            least[left] = np.minimum(
                least[left], np.where(filtered.is_known(first, last), square + unlikely, 0.0)
            )
        if len(rows) and least.max() > most:
            worst = int(least.argmax())
            yield (returns_row(rows[worst]),), float(least[worst]), most


def _refused_together(
    returns: Sequence[Return], drifts: _Drifts, theory: Theory
) -> Iterator[_Found]:
    """The set of two that is refused most clearly. Of more than MOST_SETS sets that the bound does not pass, as many are looked at, evenly spread."""
    if len(returns) < 2:
        return
    rows = np.array(sorted(returns, key=lambda r: r[1]), dtype=int).reshape(-1, 3)
    thresholds = {freedom: _most(theory, freedom, together=True) for freedom in (4, 5, 6)}
    worst: _Found | None = None
    for first, second in _sets(rows, drifts.none, min(thresholds.values())):
        least = np.full(len(first), np.inf)
        most = np.array([thresholds[f] for f in (rows[first, 2] + rows[second, 2]).tolist()])
        for filtered, unlikely in drifts:
            left = np.flatnonzero(least > most)
            if not len(left):
                break
            least[left] = np.minimum(
                least[left], _square_together(filtered, rows, first[left], second[left]) + unlikely
            )
        excess = least - most
        if len(excess) and excess.max() > (worst[1] - worst[2] if worst else 0.0):
            k = int(excess.argmax())
            worst = (
                (returns_row(rows[first[k]]), returns_row(rows[second[k]])),
                float(least[k]),
                float(most[k]),
            )
    if worst:
        yield worst


def _sets(rows: Steps, filtered: _Filter, most: float) -> Iterator[tuple[Steps, Steps]]:
    """The sets of two rows whose loops share displacements and that the bound does not pass, in portions.

    rows  by last step
    most  the least chi-square at which a set may be refused
    """
    alone = _Alone(filtered, rows)
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


class _Alone:
    """Of each row alone: the inverse of its covariance (m x 9), its chi-square, and what errors that repeat contribute to the covariance (m x 9)."""

    def __init__(self, filtered: _Filter, rows: Steps) -> None:
        first, last = rows[:, 0], rows[:, 1]
        places = rows[:, 2] == 2
        off, covariance, repeated = (
            filtered.closing(first, last),
            filtered.covariance(first, last),
            filtered.repeated_since(first, last),
        )
        covariance[places, 2, :] = covariance[places, :, 2] = 0.0
        covariance[places, 2, 2] = 1.0
        inverse = np.linalg.inv(covariance)
        inverse[places, 2, 2] = 0.0  # the heading of a return to a place is not asked for
        self.square = np.einsum("mi,mij,mj->m", off, inverse, off)
        self.inverse, self.repeated = (
            inverse.reshape(-1, 9),
            (repeated @ repeated.swapaxes(1, 2)).reshape(-1, 9),
        )


def _unsafe(
    filtered: _Filter, rows: Steps, alone: _Alone, end: int, most: float
) -> tuple[Steps, Steps]:
    """The sets of a row that ends at a step and another one that ends no later, if the bound does not pass them."""
    later = np.arange(*np.searchsorted(rows[:, 1], [end, end + 1]))
    earlier = np.arange(
        np.searchsorted(rows[:, 1], rows[later, 0].min(), side="right"), later[-1] + 1
    )
    first, stop = rows[later, 0], rows[earlier, 1, None]
    new = filtered.new_until(end)
    table = new @ alone.inverse[later].T
    begin = np.maximum(rows[earlier, 0, None], first)
    trace = (
        table[rows[earlier, 1]]
        - np.take_along_axis(table, begin, axis=0)
        + (alone.inverse[later] * alone.repeated[later]).sum(1)
    )
    squares = alone.square[earlier, None] + alone.square[later]
    others, these = np.nonzero(
        ~_is_safe(trace, squares, most) & (stop > first) & (earlier[:, None] < later)
    )
    share = new[rows[earlier[others], 1]] - new[begin[others, these]] + alone.repeated[later[these]]
    share = alone.inverse[later[these]].reshape(-1, 3, 3) @ share.reshape(-1, 3, 3)
    norm = np.sqrt(np.maximum(np.einsum("mij,mji->m", share, share), 0.0))
    left = ~_is_safe(norm, squares[others, these], most)
    return earlier[others[left]], later[these[left]]


def _is_safe(share: Array, squares: Array, most: float) -> NDArray[np.bool_]:
    """Whether sets are not refused, by a bound on the share that both rows have in common, and the sum of their chi-squares."""
    left = 1 - squares / most
    safe: NDArray[np.bool_] = (left > 0) & (share + MARGIN <= left**2)
    return safe


def _square_together(filtered: _Filter, rows: Steps, here: Steps, others: Steps) -> Array:
    """The chi-square of rows together with other rows; 0 where nothing is known of one of the two."""
    m = len(others)
    begin, end = (
        np.maximum(rows[others, 0], rows[here, 0]),
        np.minimum(rows[others, 1], rows[here, 1]),
    )
    common = filtered.since(begin, end)
    mixed = (
        filtered.onward(end, rows[here, 1])
        @ common
        @ filtered.onward(end, rows[others, 1]).swapaxes(1, 2)
    )
    mixed += filtered.repeated_since(rows[here, 0], rows[here, 1]) @ filtered.repeated_since(
        rows[others, 0], rows[others, 1]
    ).swapaxes(1, 2)
    joint, off = np.zeros((m, 6, 6)), np.zeros((m, 6))
    for k, which in enumerate((here, others)):
        part = slice(3 * k, 3 * k + 3)
        off[:, part] = filtered.closing(rows[which, 0], rows[which, 1])
        joint[:, part, part] = filtered.covariance(rows[which, 0], rows[which, 1])
    joint[:, :3, 3:], joint[:, 3:, :3] = mixed, mixed.swapaxes(1, 2)
    for k, which in enumerate(
        (here, others)
    ):  # the heading of a return to a place is not asked for
        free = rows[which, 2] == 2
        off[free, 3 * k + 2] = 0.0
        joint[free, 3 * k + 2, :] = joint[free, :, 3 * k + 2] = 0.0
        joint[free, 3 * k + 2, 3 * k + 2] = 1.0
    known = filtered.is_known(rows[here, 0], rows[here, 1]) & filtered.is_known(
        rows[others, 0], rows[others, 1]
    )
    square: Array = np.where(known, _square(off, joint), 0.0)
    return square


def _square(off: Array, covariance: Array) -> Array:
    square: Array = np.einsum("mi,mi->m", off, np.linalg.solve(covariance, off[..., None])[..., 0])
    return square


def returns_row(row: Steps) -> Return:
    """A return from its row."""
    first, last, freedom = map(int, row)
    return first, last, freedom
