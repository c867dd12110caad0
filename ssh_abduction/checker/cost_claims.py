"""Compute the cost of maps in nats anew, and compare it with what an answer claims.

The solver looks for poses of dstates. This module looks for errors of the displacements instead, so
the two share no method. The unknowns z are the errors of all displacements and closures, the scale
and the drift, each in standard deviations. A map demands that its loops close, and that the two
steps of each closure lie as the closure says: c(z) = 0. The misfit is the least sum of z² with c(z)
= 0. It is found by Gauss-Newton: the next z is the smallest solution w of J w = J z - c(z), where J
holds the derivatives of c. This is the update of an iterated Kalman filter for all loops at once.

A displacement is missing where a drive starts, or where it was not logged. Between two gaps lies a
*stretch* of steps, whose poses by dead reckoning have a frame of their own. If two stretches have a
dstate or two places in common, or if a closure connects them, this determines how their frames lie
relative to each other. Such guesses of missing displacements are only a starting point: the misfit
does not depend on them.
"""

from __future__ import annotations

import cmath
import math
from collections import Counter, defaultdict
from collections.abc import Collection, Hashable, Iterator, Mapping, Sequence
from itertools import accumulate, combinations, pairwise
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from ssh_abduction.data.errors import brief
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.odometry import Closure, Odometry
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.theory.theory import Theory

Array: TypeAlias = NDArray[np.float64]
Faults: TypeAlias = Sequence[tuple[str, int]]

ROUNDS = 50
# Stop when no unknown moves by more than this many standard deviations. Near its least value, the
# sum of squares then changes by less than rounding to the digits of an answer does.
STILL = 1e-4
# The standard deviation of a missing displacement, in metres and radians. It is so large that any
# displacement is possible.
MISSING = 1e4
# Claimed costs may be wrong by this many nats, plus this share of the misfit.
EXACT, SHARE = 1e-3, 1e-3
# If the robot may be off its dstates, the standard deviation is at least this, in metres and
# radians.
SMALLEST = 1e-3
# The costs of traces with more steps are not checked, as the derivatives are a dense matrix.
LONGEST = 400
# The time for the cost of a map grows with the third power of the steps. Costs of rivals are
# checked for at most the time of five in the longest trace.
WORK = 5 * LONGEST**3
# Two places are at one position if they are nearer than CROWDED times the shortest travel. A move
# is a travel if it is longer than TRAVEL of the longest one.
CROWDED, TRAVEL = 0.4, 0.1
# The direction from one place to another is too uncertain to use if they are closer than this many
# metres.
NEAR = 1.0

_Frame = tuple[complex, float]  # the position and the heading of the origin of a stretch


def misfit(trace: Trace, dstates: Sequence[int], places: Sequence[int]) -> float:
    """Compute the misfit (the least chi-square) if each step is at a given dstate and place."""
    return _least(trace, dstates, places, ())[0]


def _least(
    trace: Trace, dstates: Sequence[int], places: Sequence[int], faults: Faults
) -> tuple[float, Array]:
    """Compute the misfit, and the position of the dstate of each step, in metres, (n, 2).

    Faults have a kind and a step. A displacement that jumped is ignored.
    """
    wrong = [step for kind, step in faults if kind == "jumped"]
    errors = _Errors(trace.without_displacements_at(wrong), dstates, places)
    with threadpool_limits(1, user_api="blas"):  # more threads only wait for each other
        return errors.least(), errors.position


def count_checked_rivals(steps: int, rivals: int, theory: Theory) -> int:
    """Count the rivals whose costs `false_costs` checks: the first ones, as far as time permits.

    It is 0 if paths have a price, as the paths of rivals are not listed.
    """
    return 0 if steps > LONGEST or theory.prices[2] else min(rivals, WORK // steps**3)


def false_costs(
    trace: Trace, answer: Mapping[str, Any], maps: Sequence[SSHMap], theory: Theory
) -> Iterator[str]:
    """Check the costs in nats that an answer claims for its maps, by a theory without "auto"."""
    weighed = answer.get("weighed")
    if not isinstance(weighed, Mapping) or not maps:
        return
    nats, bound, rivals = (weighed.get(name) for name in ("nats", "bound", "rivals"))
    is_optimal = answer.get("status") == "optimal"
    if is_optimal and bound != nats:
        yield (
            f"weighed.bound: expected {nats}, the cost of map 1, as the status is optimal, got "
            f"{brief(bound)}"
        )
    if not isinstance(bound, int | float) or not isinstance(nats, int | float) or bound > nats:
        yield f"weighed.bound: expected a number up to {brief(nats)}, got {brief(bound)}"
        return
    if not is_optimal and (within := weighed.get("within")):
        yield (
            f"weighed.within: expected 0, as it is not proven which map is the best, got "
            f"{brief(within)}"
        )
    if len(trace) > LONGEST:
        return
    # The cost of map 1, and of the rivals that can be checked in time. If a map has no places, its
    # dstates stand for them.
    places = [maps[0].dstates[label].place for label in maps[0].dstate_at]
    here = [p if p is not None else s for p, s in zip(places, maps[0].dstate_at, strict=True)]
    of_map: Faults = [(fault.kind, fault.step) for fault in maps[0].faults]
    courses = [("weighed.nats", nats, maps[0].dstate_at, here, len(maps[0].places), of_map)]
    rivals = rivals if isinstance(rivals, list) else []
    for i in range(count_checked_rivals(len(trace), len(rivals), theory)):
        rival = rivals[i]
        at = rival.get("places") or rival.get("dstates")
        there = len(set(at)) if rival.get("places") else 0
        of_rival = rival.get("faults", [])
        name = f"weighed.rivals[{i}]"
        courses.append((name, rival.get("nats"), rival["dstates"], at, there, of_rival))
    paths = theory.prices[2] * len(maps[0].paths)
    for name, claimed, dstates, at, count, faults in courses:
        true, square = _nats(trace, theory, dstates, at, count, faults)
        true += paths if name == "weighed.nats" else 0.0
        if abs(true - claimed) > EXACT + SHARE * square:
            yield f"{name}: expected {true:.3f} nats, by the displacements, got {claimed}"


def _nats(
    trace: Trace,
    theory: Theory,
    dstates: Sequence[int],
    at: Sequence[int],
    places: int,
    faults: Faults,
) -> tuple[float, float]:
    """Compute the cost of a map without its paths, in nats, and its misfit.

    Each step is at a given dstate and place (`at`). The map has this number of places.
    """
    square, position = _least(trace, dstates, at, faults)
    nats = theory.prices[0] * len(set(dstates)) + theory.prices[1] * places + square / 2
    tenths = [theory.fault_tenths(kind, trace.steps[step]) for kind, step in faults]
    nats += theory.prices[0] * sum(tenths) / 10
    factor = _laying_factor(trace) if theory.star == "none" else 1.0
    nats += theory.price_of_laying * factor * _layings(trace, at)
    if theory.level == "topological" and not theory.lifts and not theory.jumped:
        nats += theory.price_of_laying * _crowding(trace, dstates, at, position)
    return nats, square


def _layings(trace: Trace, places: Sequence[int]) -> int:
    """Count how often common places connect drives that no closures connect.

    This is the number of groups of drives connected by closures, minus the number of groups
    connected by closures or places.
    """
    drive = _drives(trace)
    tied = [{drive[closure.first], drive[closure.last]} for closure in trace.closures]
    shared = [{drive[t] for t, p in enumerate(places) if p == place} for place in set(places)]
    return len(_groups(drive, tied)) - len(_groups(drive, tied + shared))


def _laying_factor(trace: Trace) -> float:
    """Compute how many times as much laying drives costs if only views tell places apart.

    Of the pairs of steps of different drives, and of 400 further pairs that differ, a share q has
    equal views. The factor is 3 / log(1/q), at least 1.
    """
    views: dict[int, Counter[Hashable]] = defaultdict(Counter)
    for drive, view in zip(_drives(trace), trace.views, strict=True):
        views[drive][view] += 1
    alike = pairs = 0
    for one, other in combinations(views.values(), 2):
        pairs += one.total() * other.total()
        alike += sum(one[view] * other[view] for view in one)
    return max(3 / -math.log(alike / (pairs + 400)), 1.0) if alike else 1.0


def _crowding(
    trace: Trace, dstates: Sequence[int], places: Sequence[int], position: Array
) -> float:
    """Count the pairs of places at one position that no group of drives saw both.

    Closures connect the drives of a group. A pair counts less the farther the two are apart. It
    counts if common places or a common dstate fix how the drives lie.
    """
    drive = _drives(trace)
    moves = [
        step.displacement
        for t, step in enumerate(trace.steps)
        if t and not trace.actions[t - 1].starts
    ]
    if any(move is None for move in moves):
        return 0.0
    ways = [math.hypot(*move[:2]) for move in moves if move is not None]
    near = CROWDED * min((way for way in ways if way > TRAVEL * max(ways)), default=0.0)
    tied = [{drive[closure.first], drive[closure.last]} for closure in trace.closures]
    groups = _groups(drive, tied)
    group = [next(i for i, members in enumerate(groups) if number in members) for number in drive]
    saw = {p: {group[t] for t, q in enumerate(places) if p == q} for p in places}
    faced = [{group[t] for t, x in enumerate(dstates) if s == x} for s in set(dstates)]
    twice = [one & other for one, other in combinations(saw.values(), 2) if len(one & other) > 1]
    frames = _groups(group, [*faced, *twice])
    count = 0.0
    for p, q in combinations(saw, 2):
        is_fixed = any(frame & saw[p] and frame & saw[q] for frame in frames)
        if near and is_fixed and not saw[p] & saw[q]:
            away = position[places.index(p)] - position[places.index(q)]
            count += max(0.0, 1 - float(np.hypot(*away)) / near)
    return count


def _drives(trace: Trace) -> list[int]:
    """Return the number of the drive of each step."""
    return [0, *accumulate(int(action.starts) for action in trace.actions)]


def _groups(members: Collection[int], ties: Sequence[set[int]]) -> list[set[int]]:
    """Merge members that are in one set of `ties`, directly or by others."""
    groups = [{member} for member in set(members)]
    for some in ties:
        apart = [group for group in groups if not group & some]
        groups = [*apart, some.union(*(group for group in groups if group & some))]
    return groups


class _Errors:
    """The errors of the displacements and closures that make the loops of a map close.

    Attributes:
        position: The position of the dstate of each step, after `least`.
    """

    def __init__(self, trace: Trace, dstates: Sequence[int], places: Sequence[int]) -> None:
        odometry = trace.odometry or Odometry()
        size = len(trace)
        self._moved = np.zeros((size, 3))
        self._root = np.zeros((size, 3, 3))
        for t in range(1, size):
            displacement, covariance = trace.steps[t].displacement, trace.covariance(t)
            if displacement is None or covariance is None:
                self._root[t] = MISSING * np.identity(3)
                continue
            self._moved[t] = displacement
            self._root[t] = np.linalg.cholesky(np.array(covariance))
        self._way = np.hypot(self._moved[:, 0], self._moved[:, 1])
        # If a heading after a gap is too far off, Gauss-Newton fails. So begin near the solution.
        self._is_missing = np.array([step.displacement is None for step in trace.steps])
        missing = [t for t in range(1, size) if self._is_missing[t]]
        for t, likely in likely_moves(self._moved, missing, dstates, places, trace.closures):
            self._moved[t] = likely
        self._sigma = np.array([odometry.scale, odometry.bend])
        # The closures, each with the root of its covariance.
        self._closures = [
            (closure, np.linalg.cholesky(np.array(closure.covariance)))
            for closure in trace.closures
        ]
        self._off = _off_dstates(trace)
        # The number of unknowns: errors of displacements and closures, then how far the robot is
        # off its dstate at each step, scale and drift.
        self._begin = 3 * (size + len(self._closures))
        self._size = self._begin + self._off.size + 2
        self.position: Array = np.zeros((size, 2))
        # A loop: the last earlier step at the dstate or place of a step, the step, and whether both
        # are at one dstate.
        self._loops: list[tuple[int, int, bool]] = []
        at_place: dict[int, int] = {}
        at_dstate: dict[int, int] = {}
        for t, (dstate, place) in enumerate(zip(dstates, places, strict=True)):
            if at_dstate.get(dstate, -1) >= 0:
                self._loops.append((at_dstate[dstate], t, True))
            elif place in at_place:
                self._loops.append((at_place[place], t, False))
            at_dstate[dstate], at_place[place] = t, t

    def least(self) -> float:
        """Compute the least sum of squares of the errors, in standard deviations."""
        z: Array = np.zeros(self._size)
        for _ in range(ROUNDS):
            look_at_clock()
            closing, jacobian = self._closings(z)
            if not len(closing):
                return 0.0
            new = np.asarray(
                np.linalg.lstsq(jacobian, jacobian @ z - closing, rcond=1e-14)[0], dtype=float
            )
            moved, z = float(abs(new - z).max()), new
            if moved < STILL:
                break
        return float(z @ z)

    def _closings(self, z: Array) -> tuple[Array, Array]:
        """Compute c(z), by how much loops and closures are off, and its derivatives J."""
        pose, own = self._reckoned(z)
        found = [self._loop_gap(z, pose, own, *loop) for loop in self._loops]
        found += [self._closure_gap(z, pose, own, k) for k in range(len(self._closures))]
        if not found:
            return np.zeros(0), np.zeros((0, self._size))
        gaps, rows = zip(*found, strict=True)
        return np.concatenate(gaps), np.concatenate(rows)

    def _reckoned(self, z: Array) -> tuple[Array, Array]:
        """Compute the pose at each step by dead reckoning, and the `_own_errors` of movements."""
        size = len(self._moved)
        scale, bend = self._sigma * z[-2:]
        noise = np.einsum("tij,tj->ti", self._root, z[: 3 * size].reshape(size, 3))
        turned = self._moved[:, 2] + noise[:, 2] - bend * self._way
        turned[0] = 0.0
        heading = np.cumsum(turned)
        before = np.concatenate([[0.0], heading[:-1]])
        angle = before - bend * self._way / 2
        cos, sin = np.cos(angle), np.sin(angle)
        gone = (self._moved[:, :2] + noise[:, :2]) / (1 + scale)
        gone[0] = 0.0
        onward = np.stack(
            [cos * gone[:, 0] - sin * gone[:, 1], sin * gone[:, 0] + cos * gone[:, 1]], axis=1
        )
        pose = np.column_stack([np.cumsum(onward, axis=0), heading])
        off_dstate = z[self._begin : self._begin + self._off.size].reshape(-1, 3) * self._off
        self.position = pose[:, :2] - (off_dstate[:, :2] if len(self._off) else 0.0)
        return pose, self._own_errors(cos, sin, onward, 1 + scale)

    def _loop_gap(
        self, z: Array, pose: Array, own: Array, first: int, last: int, is_dstate: bool
    ) -> tuple[Array, Array]:
        """Compute by how much a loop is off, and the derivatives."""
        gap = pose[last] - pose[first]
        row = self._row(pose, own, first, last)
        if len(self._off):
            away = np.zeros(3)  # how much farther the robot is off its dstate at the last step
            for t, sign in ((last, 1.0), (first, -1.0)):
                mine = slice(self._begin + 3 * t, self._begin + 3 * t + 3)
                away += sign * self._off[t] * z[mine]
                row[range(3), range(mine.start, mine.stop)] -= sign * self._off[t]
            gap -= away
            # Once the loop closes, the two poses are `away` from each other. Earlier turns turn
            # that. Turns at gaps are left out: they are too uncertain for Gauss-Newton.
            turns = np.where(self._is_missing[: first + 1, None], 0.0, own[: first + 1, 2])
            turned = np.outer([-away[1], away[0]], turns).reshape(2, first + 1, 5)
            row[:2, : 3 * first + 3] += turned[:, :, :3].reshape(2, -1)
            row[:2, -2:] += turned[:, :, 3:].sum(axis=1)
        gap[2] = math.remainder(gap[2], math.tau)
        kept = 3 if is_dstate else 2
        return gap[:kept], row[:kept]

    def _closure_gap(self, z: Array, pose: Array, own: Array, k: int) -> tuple[Array, Array]:
        """Compute by how much closure k is off, and the derivatives.

        It gives the pose at the later step in the frame of the earlier one. Errors up to the
        earlier step move both poses alike.
        """
        (closure, root), size = self._closures[k], len(self._moved)
        first, last = closure.first, closure.last
        cos, sin = math.cos(pose[first, 2]), math.sin(pose[first, 2])
        back = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        mine = slice(3 * (size + k), 3 * (size + k) + 3)
        row = back @ self._row(pose, own, first, last)
        row[:, mine] = -root
        gap = back @ (pose[last] - pose[first]) - closure.displacement - root @ z[mine]
        gap[2] = math.remainder(gap[2], math.tau)
        return gap, row

    def _own_errors(self, cos: Array, sin: Array, onward: Array, scale: float) -> Array:
        """Compute derivatives, (n, 3, 5), of movements by their three errors, scale and drift."""
        own = np.zeros((len(onward), 3, 5))
        own[:, 0, 0], own[:, 0, 1] = cos / scale, -sin / scale
        own[:, 1, 0], own[:, 1, 1] = sin / scale, cos / scale
        own[:, 2, 2] = 1.0
        own[:, :2, 3] = -onward / scale * self._sigma[0]
        own[:, 0, 4] = onward[:, 1] * self._way / 2 * self._sigma[1]
        own[:, 1, 4] = -onward[:, 0] * self._way / 2 * self._sigma[1]
        own[:, 2, 4] = -self._way * self._sigma[1]
        own[:, :, :3] = own[:, :, :3] @ self._root
        own[0] = 0.0
        return own

    def _row(self, pose: Array, own: Array, first: int, last: int) -> Array:
        """Compute the derivatives of the pose at `last` minus that at `first`.

        They are by all unknowns. Errors up to `first`, which turn the difference, do not count.
        """
        along = slice(first + 1, last + 1)
        rest = pose[last, :2] - pose[along, :2]
        # An error of the heading turns the rest of the way.
        carried = own[along].copy()
        carried[:, 0] -= rest[:, 1, None] * own[along, 2]
        carried[:, 1] += rest[:, 0, None] * own[along, 2]
        row = np.zeros((3, self._size))
        row[:, 3 * first + 3 : 3 * last + 3] = carried[:, :, :3].transpose(1, 0, 2).reshape(3, -1)
        row[:, -2:] = carried[:, :, 3:].sum(axis=0)
        return row


def _off_dstates(trace: Trace) -> Array:
    """The standard deviations of the robot's pose relative to its dstate, of shape (steps, 3).

    They are in metres and radians. Turns do not move the robot, so the k steps of a visit share one
    error of position. To count this error once, each of the steps gets k times its variance. Empty
    if the odometry declares no such errors.
    """
    odometry = trace.odometry or Odometry()
    if not odometry.offset and not odometry.facing:
        return np.zeros((0, 3))
    found: list[list[float]] = []
    steps = 0
    for t in range(len(trace)):
        steps += 1
        if t + 1 == len(trace) or trace.actions[t].kind != "turn":
            far = max(odometry.offset, SMALLEST) * math.sqrt(steps)
            found += [[far, far, max(odometry.facing, SMALLEST)]] * steps
            steps = 0
    return np.array(found)


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
