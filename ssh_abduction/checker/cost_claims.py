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
from itertools import accumulate, combinations, pairwise, product
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from ssh_abduction.data.errors import brief
from ssh_abduction.data.groups import firsts
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

# The tiny imaginary part of an unknown, and how many unknowns get one at once.
TINY, AT_ONCE = 1e-30, 200

_Numbers: TypeAlias = NDArray[Any]  # real, or complex while derivatives are computed
_Frame: TypeAlias = tuple[complex, float]  # a position, and a heading in radians


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
        self._moved = np.zeros((len(trace), 3))
        self._root = np.tile(MISSING * np.identity(3), (len(trace), 1, 1))
        self._root[0] = 0.0
        missing = []
        for t, step in enumerate(trace.steps[1:], 1):
            if step.displacement is None:
                missing.append(t)
            else:
                self._moved[t] = step.displacement
                self._root[t] = np.linalg.cholesky(np.array(trace.covariance(t)))
        self._way = np.hypot(self._moved[:, 0], self._moved[:, 1])
        # If a heading after a gap is too far off, Gauss-Newton fails. So begin near the solution.
        for t, likely in _likely_moves(self._moved, missing, dstates, places, trace.closures):
            self._moved[t] = likely
        self._sigma = np.array([odometry.scale, odometry.bend])
        self._off = _off_dstates(trace)
        covariances = np.array([c.covariance for c in trace.closures]).reshape(-1, 3, 3)
        self._doubt = np.linalg.cholesky(covariances)
        self._told = np.array([c.displacement for c in trace.closures]).reshape(-1, 3)
        # A loop leads from the last earlier step at the dstate or place of a step to this step.
        # At one place, only the position has to be the same.
        ends: list[tuple[int, int]] = []
        counts: list[tuple[bool, bool, bool]] = []
        last: dict[tuple[str, int], int] = {}
        for t, (dstate, place) in enumerate(zip(dstates, places, strict=True)):
            here = ("dstate", dstate), ("place", place)
            if key := next((key for key in here if key in last), None):
                ends.append((last[key], t))
                counts.append((True, True, key[0] == "dstate"))
            last |= dict.fromkeys(here, t)
        self._loops = np.array(ends, dtype=int).reshape(-1, 2).T
        self._counts = np.array(counts, dtype=bool).reshape(-1, 3)
        self._closures = np.array([(c.first, c.last) for c in trace.closures], int).reshape(-1, 2).T
        self.position: Array = np.zeros((len(trace), 2))

    def least(self) -> float:
        """Compute the least sum of squares of the errors, in standard deviations."""
        z: Array = np.zeros(3 * (len(self._moved) + len(self._doubt) + len(self._off)) + 2)
        for _ in range(ROUNDS if self._loops.size + self._closures.size else 0):
            look_at_clock()
            jacobian = self._derivatives(z)
            wanted = jacobian @ z - self._closing(z)
            new = np.asarray(np.linalg.lstsq(jacobian, wanted, rcond=1e-14)[0], dtype=float)
            moved, z = float(abs(new - z).max()), new
            if moved < STILL:
                break
        self.position = self._poses(z)[1][:, :2]
        return float(z @ z)

    def _derivatives(self, z: Array) -> Array:
        """Compute the derivatives J of c(z), of shape (numbers in c, unknowns).

        If an unknown has a tiny imaginary part, the imaginary part of c is the derivative (Squire &
        Trapp 1998, "Using complex variables to estimate derivatives of real functions").
        """
        changes = np.array_split(TINY * 1j * np.identity(len(z)), 1 + len(z) // AT_ONCE)
        return np.concatenate([self._closing(z + some).imag / TINY for some in changes]).T

    def _closing(self, z: _Numbers) -> _Numbers:
        """Compute c(z), by how much loops and closures are off, for each row of unknowns."""
        pose, at = self._poses(z)
        doubt = self._parts(z)[1]
        off = _seen_from(at, *self._loops)[..., self._counts]
        closed = _seen_from(pose, *self._closures) - self._told
        closed = closed - np.einsum("cij,...cj->...ci", self._doubt, doubt)
        closed[..., 2] = _remainder(closed[..., 2])
        return np.concatenate([off, closed.reshape(*z.shape[:-1], -1)], axis=-1)

    def _poses(self, z: _Numbers) -> tuple[_Numbers, _Numbers]:
        """Compute the poses of the robot, by dead reckoning, and of the dstates: (…, steps, 3)."""
        noise, _, off = self._parts(z)
        scale, bend = (self._sigma[k] * z[..., k - 2, None] for k in (0, 1))
        moved = self._moved + np.einsum("tij,...tj->...ti", self._root, noise)
        turned = moved[..., 2] - bend * self._way
        heading = np.cumsum(turned, axis=-1)
        middle = heading - turned - bend * self._way / 2
        way = np.cumsum(_turned(moved, middle) / (1 + scale[..., None]), axis=-2)
        pose = np.concatenate([way, heading[..., None]], axis=-1)
        if not len(self._off):
            return pose, pose
        off = off * self._off
        aside = np.concatenate([_turned(off, heading), off[..., 2:]], axis=-1)
        return pose, pose - aside

    def _parts(self, z: _Numbers) -> list[_Numbers]:
        """Split unknowns, (…, unknowns), into errors, (…, n, 3).

        They are those of the displacements, and of the closures, and how far the robot is off its
        dstate at each step: metres ahead and left, and radians.
        """
        ends = 3 * np.cumsum([len(self._moved), len(self._doubt), len(self._off)])
        parts = np.split(z, ends, axis=-1)[:3]
        return [part.reshape(*z.shape[:-1], -1, 3) for part in parts]


def _turned(vectors: _Numbers, angle: _Numbers) -> _Numbers:
    """Turn vectors, whose last axis begins with x and y, counterclockwise by angles in radians."""
    x, y, cos, sin = vectors[..., 0], vectors[..., 1], np.cos(angle), np.sin(angle)
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def _seen_from(pose: _Numbers, first: NDArray[np.int_], last: NDArray[np.int_]) -> _Numbers:
    """Compute the poses of the last steps in the frames of the first ones."""
    gap = pose[..., last, :] - pose[..., first, :]
    there = _turned(gap, -pose[..., first, 2])
    return np.concatenate([there, _remainder(gap[..., 2:])], axis=-1)


def _remainder(angle: _Numbers) -> _Numbers:
    """Return angles in radians between -pi and pi."""
    return angle - math.tau * np.round(angle.real / math.tau)


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


def _likely_moves(
    moved: Array,
    missing: Sequence[int],
    dstates: Sequence[int],
    places: Sequence[int],
    closures: Sequence[Closure],
) -> Iterator[tuple[int, tuple[float, float, float]]]:
    """Guess the displacements that lead to the `missing` steps.

    `moved`, of shape (n, 3), has the displacement that leads to each step, in metres and radians.
    `dstates` and `places` have the dstate and the place of each step.
    """
    begins = [0, *missing]
    stretches = [range(a, b) for a, b in pairwise([*begins, len(moved)])]
    pose: list[_Frame] = []
    for t, (dx, dy, turned) in enumerate(moved.tolist()):
        pose.append((0j, 0.0) if t in begins else _beyond(pose[-1], (complex(dx, dy), turned)))
    framed: dict[int, None] = {}  # the steps of stretches that have a frame
    while stretches:
        found = (
            (stretch, frame)
            for stretch in stretches
            for frame in _frames(stretch, pose, dstates, places, closures, framed)
        )
        stretch, frame = next(found, (stretches[0], (0j, 0.0)))
        stretches.remove(stretch)
        framed |= dict.fromkeys(stretch)
        for t in stretch:
            pose[t] = _beyond(frame, pose[t])
    for t in missing:
        (at, heading), (after, facing) = pose[t - 1], pose[t]
        gone = (after - at) * cmath.rect(1, -heading)
        yield t, (gone.real, gone.imag, math.remainder(facing - heading, math.tau))


def _frames(
    stretch: range,
    pose: Sequence[_Frame],
    dstates: Sequence[int],
    places: Sequence[int],
    closures: Sequence[Closure],
    framed: Collection[int],
) -> Iterator[_Frame]:
    """Yield likely origins of a stretch, the best first.

    They follow from a dstate, from two places, or from a closure, with a step that has a frame.
    """
    known = firsts((dstates[t], pose[t]) for t in framed)
    position = firsts((places[t], pose[t][0]) for t in framed)
    for t in stretch:
        if dstates[t] in known:
            yield _origin(known[dstates[t]], pose[t])
    there = [t for t in stretch if places[t] in position]
    for t, u in product(there, there):
        way, mine = position[places[u]] - position[places[t]], pose[u][0] - pose[t][0]
        if min(abs(way), abs(mine)) > NEAR:
            here = position[places[t]], cmath.phase(way)
            yield _origin(here, (pose[t][0], cmath.phase(mine)))
    for closure in closures:
        x, y, turned = closure.displacement
        beyond = _beyond(pose[closure.first], (complex(x, y), turned))
        if closure.last in stretch and closure.first in framed:
            yield _origin(beyond, pose[closure.last])
        if closure.first in stretch and closure.last in framed:
            yield _origin(pose[closure.last], beyond)


def _beyond(frame: _Frame, pose: _Frame) -> _Frame:
    """Return a pose that is given relative to a frame."""
    return frame[0] + cmath.rect(1, frame[1]) * pose[0], frame[1] + pose[1]


def _origin(known: _Frame, pose: _Frame) -> _Frame:
    """Return the frame in which a known pose is `pose`."""
    turn = known[1] - pose[1]
    return known[0] - cmath.rect(1, turn) * pose[0], turn
