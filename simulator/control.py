"""Control laws. Each of them sees laser images and commands motions, and none knows the true pose.

Trajectory-following leads the robot along the midline between two walls, or along one wall at a fixed distance. Hill-climbing leads it to
a fixed point. Along its way, that point is half a corridor's width before the wall ahead, or in the middle of a street that opens to a side;
across its way, it is midway between the walls, or half a corridor's width from the only wall; and the heading is along the walls. Where the image
does not show one of these, the robot does not correct it.
Source: Kuipers & Beeson 2002, section on distinctive states; Kuipers 2000, the control level of the hierarchy.
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
TURNS = {"left": math.pi / 2, "right": -math.pi / 2, "around": math.pi}
# Metres that the robot drives between two images while it travels.
STRIDE = 0.15
# At rest the robot takes the median of this many images, beam by beam, so that noise is small and a lost beam does not count.
STILL = 9
# Hill-climbing looks and moves at most this many times: noise may keep it from ever being within its tolerance.
TRIES = 12
# A travel of more metres than this has failed: where walls lead round in a circle, it would never end.
LONGEST_TRAVEL = 300.0


@dataclass(frozen=True)
class Tolerance:
    """How near to the fixed point hill-climbing ends. The defaults are as near as such a robot can be steered.

    close     metres along the way
    straight  radians of heading
    aside     metres off the line; if it is farther off, the robot backs off and approaches once more
    """

    close: float = 0.015
    straight: float = math.radians(0.75)
    aside: float = 0.015


@dataclass
class Driver:
    """A robot in a world, with its laser: what control laws may use.

    on_travel  is called with the driver after each stride of a travel
    recorder   notes where the robot is after each motion, for a log
    """

    world: World
    robot: Robot
    laser: Laser
    rng: np.random.Generator
    tolerance: Tolerance = Tolerance()
    on_travel: Callable[[Driver], None] | None = None
    recorder: Recorder | None = None

    def look(self, images: int = 1) -> Array:
        """An image, (180,) metres: the median of so many images, beam by beam."""
        scans = self.laser.scan(self.world, np.repeat([self.robot.pose], images, axis=0), self.rng)
        return np.median(scans, axis=0) if images > 1 else scans[0]

    def see(self, images: int = 1) -> Sight:
        return sight(self.look(images), self.world.reach, self.laser.reach)

    def go(self, forward: float, turn: float = 0.0) -> None:
        """Move the robot. Raises SimulatorError where it leaves the world or hits a wall."""
        self.robot.move(forward, turn)
        x, y, _ = self.robot.pose
        if not self.world.holds(x, y):
            raise SimulatorError(
                f"{self.world.name}: the robot left the world at ({x:.2f}, {y:.2f}); close the gap in the walls"
            )
        if forward and self.world.clearance(x, y) < self.robot.body.radius:
            raise SimulatorError(
                f"{self.world.name}: the robot hit a wall at ({x:.2f}, {y:.2f}); give it {self.robot.body.radius} m of room"
            )
        if self.recorder:
            self.recorder.note(self.world, self.robot.pose)


def act(driver: Driver, action: str) -> None:
    """Do an action of a route: follow a trajectory or turn, and then climb to the dstate where the action ends."""
    if action == "travel":
        travel(driver)
        climb(driver)
    else:
        driver.go(0.0, TURNS[action])
        climb(driver, turned=True)


def travel(driver: Driver) -> None:
    """Follow the midline or the wall to the next distinctive place."""
    reach = driver.world.reach
    began = driver.robot.driven
    while True:
        seen = driver.see()
        done = driver.robot.driven - began
        to_go = seen.to_go(reach, streets=done > 1.6 * reach)
        if to_go is not None and to_go < 0.02:
            if done < 0.1:
                x, y, _ = driver.robot.pose
                raise SimulatorError(
                    f"{driver.world.name}: travel at ({x:.2f}, {y:.2f}): expected a free way ahead, got a wall; change the route"
                )
            return
        if done > LONGEST_TRAVEL:
            raise SimulatorError(
                f"{driver.world.name}: travel: expected a distinctive place within {LONGEST_TRAVEL:.0f} m, got none"
            )
        stride = STRIDE if to_go is None else min(STRIDE, max(0.5 * to_go, 0.01))
        driver.go(stride, _steer(seen, reach, stride))
        if driver.on_travel is not None:
            driver.on_travel(driver)


def _steer(seen: Sight, reach: float, stride: float) -> float:
    """Radians to turn on the next stride, so that the robot comes to the line and then goes along it."""
    offset = seen.offset(reach)
    wanted = 0.0 if offset is None else -math.atan(1.5 * float(np.clip(offset, -0.5, 0.5)))
    return (wanted - seen.tilt) * min(1.0, abs(stride) / 0.12)


def climb(driver: Driver, turned: bool = False) -> None:
    """Hill-climb to the fixed point: along the way, across it, and in heading.

    turned  the action was a turn, after which the robot does not back off to come nearer to the line
    """
    reach, tolerance = driver.world.reach, driver.tolerance
    for attempt in range(TRIES):
        seen = driver.see(STILL)
        to_go, offset = seen.to_go(reach), seen.offset(reach)
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
    """Back off a little, and approach the fixed point once more, along the line."""
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
