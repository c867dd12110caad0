"""Control laws, which compute the motions of the robot from laser images alone.

They do not know the true pose. Trajectory-following leads the robot along the midline between two
walls, or along one wall at a fixed distance. Hill-climbing then leads it to a dstate (distinctive
state), a fixed position and heading at a place. Along the path, the fixed point is half a
corridor's width before the wall ahead, or in the middle of a street that opens to a side. Across
the path, it is midway between the walls, or half a corridor's width from the only wall. The heading
is along the walls. The robot corrects only the errors that the image shows.

Walls are assumed to meet at right angles. The points of an image are rotated until the walls are
parallel to the axes. The wall ahead, the walls alongside, and the far walls of side streets are
then the lines with the most points (`sight`).

Reference:
    Kuipers & Beeson 2002, section on distinctive states; Kuipers 2000, the control level.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from simulator.errors import SimulatorError
from simulator.robot import BEARINGS, Laser, Recorder, SimulatedRobot
from simulator.world import Array, World

# Points of a wall differ by at most this many metres across it: ten times the noise of the laser.
THICK = 0.05
# Smallest length of a wall in metres; anything shorter is clutter, or the end of a wall.
LONG = 0.4
# The direction of each beam as a vector, (180, 2).
AHEAD_AND_LEFT = np.stack([np.cos(BEARINGS), np.sin(BEARINGS)], axis=1)
# Number of quarter turns clockwise that an action turns the robot by.
QUARTERS = {"travel": 0, "right": 1, "around": 2, "left": 3}
TURNS = {"left": math.pi / 2, "right": -math.pi / 2, "around": math.pi}
# Metres between two images while the robot travels.
STRIDE = 0.15
# Number of images that a standing robot takes. Their median, beam by beam, reduces noise and
# ignores lost beams.
STILL = 9
# Largest number of corrections while hill-climbing, since noise may keep the robot out of
# tolerance.
TRIES = 12
# A travel has failed after this many metres, since it would never end between walls in a circle.
LONGEST_TRAVEL = 300.0


@dataclass(frozen=True)
class Tolerance:
    """Largest errors with which hill-climbing ends.

    The defaults are the best precision that such a robot reaches.

    Attributes:
        close: Distance from the fixed point along the path, in metres.
        straight: Error of the heading, in radians.
        aside: Distance from the fixed point across the path, in metres. If it is larger, the robot
            drives back and approaches again.
    """

    close: float = 0.015
    straight: float = math.radians(0.75)
    aside: float = 0.015


@dataclass
class Driver:
    """A robot in a world, with its laser, as control laws use it."""

    world: World  # the world, with the clutter as it is on this tour
    robot: SimulatedRobot  # the robot, with its true pose and its odometry
    laser: Laser
    rng: np.random.Generator  # source of the noise of the laser
    tolerance: Tolerance = Tolerance()  # largest errors with which hill-climbing ends
    # Function that is called with the driver after each motion of a travel.
    on_travel: Callable[[Driver], None] | None = None
    # Records the pose after each motion, for a log; None without a log.
    recorder: Recorder | None = None

    def look(self, images: int = 1) -> Array:
        """Take an image, (180,) metres from right to left: the median of `images` scans."""
        scans = self.laser.scan(self.world, np.repeat([self.robot.pose], images, axis=0), self.rng)
        return np.median(scans, axis=0) if images > 1 else scans[0]

    def see(self, images: int = 1) -> WallPositions:
        """Find the walls in the median of `images` scans."""
        return sight(self.look(images), self.world.reach, self.laser.reach)

    def ride(self, name: str) -> None:
        """Take a lift by its name to its other end. The heading stays. Raises SimulatorError."""
        x, y, heading = self.robot.pose
        lift = self.world.lift_at(name, x, y)
        if lift is None:
            raise SimulatorError(
                f"{self.world.name}: {name}: expected a lift of this name at ({x:.2f}, {y:.2f}), "
                "got none; change the route, or add it to the world"
            )
        self.robot.pose = x + lift.end[0] - lift.start[0], y + lift.end[1] - lift.start[1], heading

    def go(self, forward: float, turn: float = 0.0) -> None:
        """Move the robot by metres forward or back, and turn it by radians counterclockwise.

        Raises SimulatorError if the robot leaves the world or hits a wall.
        """
        self.robot.move(forward, turn)
        x, y, _ = self.robot.pose
        if not self.world.holds(x, y):
            raise SimulatorError(
                f"{self.world.name}: the robot left the world at ({x:.2f}, {y:.2f}); close "
                "the gap in the walls"
            )
        if forward and self.world.clearance(x, y) < self.robot.body.radius:
            raise SimulatorError(
                f"{self.world.name}: the robot hit a wall at ({x:.2f}, {y:.2f}); give it "
                f"{self.robot.body.radius} m of room"
            )
        if self.recorder:
            self.recorder.note(self.world, self.robot.pose)


def act(driver: Driver, action: str) -> None:
    """Do "travel", "left", "right" or "around", and climb to the dstate at its end."""
    if action == "travel":
        travel(driver)
        climb(driver)
    else:
        driver.go(0.0, TURNS[action])
        climb(driver, turned=True)


def travel(driver: Driver) -> None:
    """Follow the midline or the wall to the next distinctive place.

    Raises SimulatorError if a wall is ahead, there is no place within LONGEST_TRAVEL metres, or
    the robot hits a wall.
    """
    reach = driver.world.reach
    # A side street counts only after leaving the place where the robot started.
    began = driver.robot.driven
    while True:
        seen = driver.see()
        done = driver.robot.driven - began
        to_go = seen.to_go(reach, streets=done > 1.6 * reach)
        if to_go is not None and to_go < 0.02:
            if done < 0.1:
                x, y, _ = driver.robot.pose
                raise SimulatorError(
                    f"{driver.world.name}: travel at ({x:.2f}, {y:.2f}): expected a free way "
                    "ahead, got a wall; change the route"
                )
            return
        if done > LONGEST_TRAVEL:
            raise SimulatorError(
                f"{driver.world.name}: travel: expected a distinctive place within "
                f"{LONGEST_TRAVEL:.0f} m, got none; change the route"
            )
        stride = STRIDE if to_go is None else min(STRIDE, max(0.5 * to_go, 0.01))
        driver.go(stride, _steer(seen, reach, stride))
        if driver.on_travel is not None:
            driver.on_travel(driver)


def _steer(seen: WallPositions, reach: float, stride: float) -> float:
    """Compute the turn during the next stride, in radians, that leads to the line and along it."""
    offset = seen.offset(reach)
    wanted = 0.0 if offset is None else -math.atan(1.5 * float(np.clip(offset, -0.5, 0.5)))
    return (wanted - seen.tilt) * min(1.0, abs(stride) / 0.12)


def climb(driver: Driver, turned: bool = False) -> None:
    """Climb to the fixed point: correct the position along and across the path, and the heading.

    After a turn, the position across the path is not corrected, as the robot would have to
    drive back and approach again.
    """
    reach, tolerance = driver.world.reach, driver.tolerance
    for attempt in range(TRIES):
        seen = driver.see(STILL)
        to_go, offset = seen.to_go(reach), seen.offset(reach)
        # Turning on the spot cannot correct a distance from the line: drive back, and come again.
        aside = abs(offset) if offset is not None else 0.0
        is_near = to_go is not None and abs(to_go) < 0.1
        if aside > tolerance.aside and is_near and not turned and attempt < TRIES // 2:
            _come_again(driver)
            continue
        if abs(seen.tilt) > tolerance.straight:
            driver.go(0.0, -seen.tilt)
        if to_go is not None and tolerance.close < abs(to_go) < 0.5 * reach:
            driver.go(to_go)
        elif abs(seen.tilt) <= tolerance.straight:
            return


def _come_again(driver: Driver) -> None:
    """Drive back a little, and approach the fixed point again along the line."""
    reach = driver.world.reach
    back = 0.0
    while back < 0.5 * reach:
        driver.go(-0.1)
        back += 0.1
    while True:
        seen = driver.see(3)
        to_go = seen.to_go(reach)
        if to_go is None or to_go < 0.01:
            return
        stride = min(0.08, max(0.5 * to_go, 0.01))
        driver.go(stride, _steer(seen, reach, stride))


@dataclass
class Corridors:
    """Does the actions of a route in a world whose streets meet at right angles.

    It also collects the openings of the current place, for stars. If it `looks_behind`, the robot
    looks behind itself at the start and after a lift. Elsewhere, it knows that the path by which it
    came is behind.
    """

    driver: Driver
    looks_behind: bool = False
    _openings: dict[int, bool] = field(default_factory=dict, init=False)
    _facing: int = field(default=0, init=False)

    def begin(self) -> None:
        """Climb to the dstate near the robot, and look behind if required."""
        climb(self.driver)
        if self.looks_behind:
            self.driver.go(0.0, math.pi)
            self._facing = 2
            self.star(self.driver.look(STILL))
            self.driver.go(0.0, math.pi)
            self._facing = 0
            climb(self.driver)

    def act(self, action: str) -> None:
        """Do an action of a route: "travel", "left", "right", "around", or the name of a lift."""
        if action not in QUARTERS:
            self.driver.ride(action)
            self._openings, self._facing = {}, 0
            self.begin()
            return
        act(self.driver, action)
        self._facing = (self._facing + QUARTERS[action]) % 4
        if action == "travel":
            # The robot is at a new place, where only the opening behind it is known.
            self._openings, self._facing = {2: True}, 0

    def star(self, image: Array) -> tuple[float, ...]:
        """Find which directions (ahead, right, behind and left) are open here: 1 or 0.

        A direction is open if its wall is far in an image, (180,) metres. The image does
        not show what is behind; an earlier image may. What is unknown counts as closed.
        """
        for slot, beams in ((0, image[82:98]), (1, image[:10]), (3, image[-10:])):
            is_far = bool(np.median(beams) > 1.8 * self.driver.world.reach)
            self._openings[(self._facing + slot) % 4] = is_far
        return tuple(float(self._openings.get((self._facing + k) % 4, False)) for k in range(4))


@dataclass(frozen=True)
class WallPositions:
    """Positions of the walls in metres and radians. None means that no such wall is visible."""

    tilt: float  # heading of the robot relative to the axis of the walls, counterclockwise
    front: float | None  # distance to the wall ahead
    left: float | None  # distance to the wall on the left
    right: float | None  # distance to the wall on the right
    left_street: float | None  # distance ahead to the far wall of a street that opens to the left
    right_street: float | None  # distance ahead to the far wall of a street that opens to the right

    def to_go(self, reach: float, streets: bool = True) -> float | None:
        """Measure how far ahead the fixed point of the next place is, in metres.

        The fixed point is half the width of a corridor (`reach`) before the wall ahead. If
        `streets` is true, the middle of a side street counts, too, if it is nearer. The
        result is negative if the robot is beyond the point, and None if neither a wall nor a
        side street is near.
        """
        seen = [self.front, *((self.left_street, self.right_street) if streets else ())]
        marks = [x for x in seen if x is not None and x < 2.5 * reach]
        return min(marks) - reach if marks else None

    def offset(self, reach: float) -> float | None:
        """Measure how many metres the robot is to the left of the line that it should follow.

        The line is the midline between two walls, or is `reach`, half the width of a corridor, away
        from the only wall. Negative to the right. None without a wall on either side.
        """
        near = 1.5 * reach
        left = self.left if self.left is not None and self.left < near else None
        right = self.right if self.right is not None and self.right < near else None
        if left is not None and right is not None:
            return (right - left) / 2
        if left is not None:
            return reach - left
        return None if right is None else right - reach


def sight(image: Array, reach: float, farthest: float) -> WallPositions:
    """Find the walls in an image: 180 ranges in metres, from right to left.

    `reach` is half the width of a corridor. The range `farthest` means that nothing was seen.
    """
    seen = image < farthest - 0.02
    met = image[seen, None] * AHEAD_AND_LEFT[seen]
    if len(met) < 20:
        return WallPositions(0.0, None, None, None, None, None)
    axis = _axis(met)
    axis += _finer(_turned(met, -axis), reach)
    points = _turned(met, -axis)
    x, y = points[:, 0], points[:, 1]
    across, along = _spacing(y), _spacing(x)
    # If the axis is turned to the left of the robot, the robot is turned to the right of the axis.
    return WallPositions(
        tilt=-axis,
        front=_line(x, across, (x > 0.05) & (np.abs(y) < 0.5 * reach)),
        left=_line(y, along, (y > 0.05) & (y < 2 * reach) & (np.abs(x) < 6 * reach)),
        right=_line(-y, along, (y < -0.05) & (y > -2 * reach) & (np.abs(x) < 6 * reach)),
        left_street=_line(x, across, (y > reach + 0.35) & (y < 5 * reach) & (x > -0.5 * reach)),
        right_street=_line(x, across, (y < -reach - 0.35) & (y > -5 * reach) & (x > -0.5 * reach)),
    )


def _turned(points: Array, angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.asarray(points @ np.array([[c, s], [-s, c]]))


def _axis(points: Array) -> float:
    """The mean direction of the walls between -45 and 45 degrees, in radians."""
    chords = points[8:] - points[:-8]
    length = np.hypot(chords[:, 0], chords[:, 1])
    good = (length > 0.08) & (length < 1.5)
    if not good.any():
        return 0.0
    directions, weights = np.arctan2(chords[good, 1], chords[good, 0]), length[good]
    axis = float(np.angle((weights * np.exp(4j * directions)).sum())) / 4
    for tolerance in (0.2, 0.1):
        off = np.angle(np.exp(4j * (directions - axis))) / 4
        close = np.abs(off) < tolerance
        if close.sum() > 5:
            axis += float(np.average(off[close], weights=weights[close]))
    return axis


def _finer(points: Array, reach: float) -> float:
    """The remaining angle between walls and axes in radians, weighted by the walls' lengths."""
    slopes, weights = [], []
    for u, v in ((0, 1), (1, 0)):
        values, spacing = points[:, v], _spacing(points[:, u])
        inside = np.abs(values) < 3 * reach
        for side in (1, -1):
            chosen = inside & (side * values > 0.05)
            line = _line(values, spacing, chosen)
            if line is None:
                continue
            # Fit a slope to the points on the line. The sign must mean the same rotation for both
            # axes.
            on = chosen & (np.abs(values - line) < THICK)
            a, b = points[on, u], values[on]
            off = a - a.mean()
            spread = float((off**2).sum())
            if len(off) > 8 and spread > 0.2:
                slope = float((off * (b - b.mean())).sum()) / spread
                slopes.append(slope if v == 1 else -slope)
                weights.append(spread)
    return float(np.average(slopes, weights=weights)) if slopes else 0.0


def _spacing(values: Array) -> Array:
    """How many metres of wall along this axis each point represents, (n,)."""
    return np.minimum(np.abs(np.gradient(values)), 0.3)


def _line(values: Array, weights: Array, chosen: NDArray[np.bool_]) -> float | None:
    """The coordinate of the longest wall across an axis; None if no wall is LONG enough."""
    picked, length = values[chosen], weights[chosen]
    if len(picked) < 5:
        return None
    order = np.argsort(picked)
    picked, length = picked[order], length[order]
    total = np.concatenate([[0.0], np.cumsum(length)])
    ends = np.searchsorted(picked, picked + THICK, side="right")
    support = total[ends] - total[: len(picked)]
    first = int(support.argmax())
    if support[first] < LONG or ends[first] - first < 5:
        return None
    picked, length = picked[first : ends[first]], length[first : ends[first]]
    return float(np.average(picked, weights=length + 1e-6))
