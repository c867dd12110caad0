"""Control laws: from laser images to motions. They do not know the true pose.

Trajectory-following leads the robot along the midline between two walls, or along one wall at a
fixed distance. Hill-climbing leads it to a fixed point. Along its path, this is half a corridor's
width before the wall ahead, or the middle of a street that opens to a side. Across its path, it is
midway between the walls, or half a corridor's width from the only wall. The heading is along the
walls. The robot corrects only what the image shows.

Reference:
    Kuipers & Beeson 2002, section on distinctive states; Kuipers 2000, the control level.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulator.drive import Recorder
from simulator.errors import SimulatorError
from simulator.laser import Laser
from simulator.robot import Robot
from simulator.sight import Sight, sight
from simulator.world import World

Array = NDArray[np.float64]
# Quarter turns clockwise from the heading before an action to after.
QUARTERS = {"travel": 0, "right": 1, "around": 2, "left": 3}
TURNS = {"left": math.pi / 2, "right": -math.pi / 2, "around": math.pi}
# Metres between two images while the robot travels.
STRIDE = 0.15
# Images at rest, whose median, beam by beam, reduces noise and ignores lost beams.
STILL = 9
# Largest number of corrections while hill-climbing, since noise may keep the robot out of
# tolerance.
TRIES = 12
# Metres after which a travel has failed, since walls in a circle would never end it.
LONGEST_TRAVEL = 300.0


@dataclass(frozen=True)
class Tolerance:
    """Distance from the fixed point at which hill-climbing ends.

    The defaults are the best precision of such a robot.

    Attributes:
        close: Metres along the path.
        straight: Radians of heading.
        aside: Metres across the path. If the robot is farther off, it backs off and approaches
            again.
    """

    close: float = 0.015
    straight: float = math.radians(0.75)
    aside: float = 0.015


@dataclass
class Driver:
    """A robot in a world, with its laser, as control laws use it.

    Attributes:
        world: World with this tour's clutter.
        robot: The robot.
        laser: Its laser.
        rng: Source of noise.
        tolerance: Errors at which hill-climbing ends, in metres and radians.
        on_travel: Called with the driver after each motion in `travel`.
        recorder: Records the pose after each motion, for a log.
    """

    world: World
    robot: Robot
    laser: Laser
    rng: np.random.Generator
    tolerance: Tolerance = Tolerance()
    on_travel: Callable[[Driver], None] | None = None
    recorder: Recorder | None = None

    def look(self, images: int = 1) -> Array:
        """An image, (180,) metres: the median of this many scans, beam by beam."""
        scans = self.laser.scan(self.world, np.repeat([self.robot.pose], images, axis=0), self.rng)
        return np.median(scans, axis=0) if images > 1 else scans[0]

    def see(self, images: int = 1) -> Sight:
        """The walls in the median of this many scans."""
        return sight(self.look(images), self.world.reach, self.laser.reach)

    def go(self, forward: float, turn: float = 0.0) -> None:
        """Move the robot. Raises SimulatorError if it leaves the world or hits a wall."""
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
    """Do an action of a route, then climb to the dstate where it ends."""
    if action == "travel":
        travel(driver)
        climb(driver)
    else:
        driver.go(0.0, TURNS[action])
        climb(driver, turned=True)


def travel(driver: Driver) -> None:
    """Follow the midline or the wall to the next distinctive place."""
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
                f"{LONGEST_TRAVEL:.0f} m, got none"
            )
        stride = STRIDE if to_go is None else min(STRIDE, max(0.5 * to_go, 0.01))
        driver.go(stride, _steer(seen, reach, stride))
        if driver.on_travel is not None:
            driver.on_travel(driver)


def _steer(seen: Sight, reach: float, stride: float) -> float:
    """Radians to turn on the next stride, to reach the line and then follow it."""
    offset = seen.offset(reach)
    wanted = 0.0 if offset is None else -math.atan(1.5 * float(np.clip(offset, -0.5, 0.5)))
    return (wanted - seen.tilt) * min(1.0, abs(stride) / 0.12)


def climb(driver: Driver, turned: bool = False) -> None:
    """Hill-climb to the fixed point: along the path, across it, and in heading.

    Args:
        driver: The robot.
        turned: Whether the action was a turn; then the robot does not back off to correct its
            distance from the line.
    """
    reach, tolerance = driver.world.reach, driver.tolerance
    for attempt in range(TRIES):
        seen = driver.see(STILL)
        to_go, offset = seen.to_go(reach), seen.offset(reach)
        # Turning cannot correct a distance from the line: back off and approach again.
        aside = abs(offset) if offset is not None else 0.0
        if (
            aside > tolerance.aside
            and to_go is not None
            and abs(to_go) < 0.1
            and not turned
            and attempt < TRIES // 2
        ):
            _come_again(driver)
            continue
        if abs(seen.tilt) > tolerance.straight:
            driver.go(0.0, -seen.tilt)
        if to_go is not None and tolerance.close < abs(to_go) < 0.5 * reach:
            driver.go(to_go)
        elif abs(seen.tilt) <= tolerance.straight:
            return


def _come_again(driver: Driver) -> None:
    """Back off a little, and approach the fixed point again along the line."""
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


class Corridors:
    """Does the actions of a route with the control laws for right angles.

    It collects the openings of the current place, numbered by quarter turns (slots) clockwise from
    the direction of arrival.

    Args:
        driver: The robot.
        looks_behind: Whether to look behind at the start, as no path led there.
    """

    def __init__(self, driver: Driver, looks_behind: bool = False) -> None:
        self.driver, self.looks_behind = driver, looks_behind
        self._openings: dict[int, bool] = {}
        self._facing = 0

    def begin(self) -> None:
        """Climb to the dstate near the start."""
        climb(self.driver)
        if self.looks_behind:
            self.driver.go(0.0, math.pi)
            self._facing = 2
            self.star(self.driver.look(STILL))
            self.driver.go(0.0, math.pi)
            self._facing = 0
            climb(self.driver)

    def act(self, action: str) -> None:
        """Do an action of a route."""
        act(self.driver, action)
        self._facing = (self._facing + QUARTERS[action]) % 4
        if action == "travel":
            # The robot came through the opening behind it.
            self._openings, self._facing = {2: True}, 0

    def star(self, image: Array) -> tuple[float, ...]:
        """The star: openings ahead, right, behind and left, if known.

        A direction is open if its wall is far. The image does not show what is behind the robot.
        """
        for slot, beams in ((0, image[82:98]), (1, image[:10]), (3, image[-10:])):
            is_far = bool(np.median(beams) > 1.8 * self.driver.world.reach)
            self._openings[(self._facing + slot) % 4] = is_far
        return tuple(float(self._openings.get((self._facing + k) % 4, False)) for k in range(4))
