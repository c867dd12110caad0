"""Driving along a way, off what stands there: as someone drives a robot who knows the building, and sees what the laser sees.

The robot aims at a point that is AIM metres ahead on its way. Where its laser shows what is no wall and would be in its way, the way is planned anew, around it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from simulator.control import Driver
from simulator.errors import SimulatorError
from simulator.freespace import CELL, Cells, FreeSpace
from simulator.laser import BEARINGS

Array = NDArray[np.float64]
# Metres that the robot drives from image to image.
STRIDE = 0.1
# Metres along the way to where the robot aims; it aims CLOSE where something is not farther off than WIDE, so that it cuts no corner there.
AIM, CLOSE, WIDE = 0.5, 0.2, 0.6
# Radians that the robot turns in a stride, and from which on it turns on the spot.
BEND, SHARP = math.radians(20), math.radians(50)
# Metres within which obstacles are heeded, and how far off the known walls a point has to be to be one.
WATCH, KNOWN = 3.0, 0.25
# Where the robot has not come on along its way in so many motions, it is stuck.
PATIENCE = 100


def follow(driver: Driver, space: FreeSpace, way: Array) -> Iterator[int]:
    """Drive along a way, (n, 2) metres. Yields after each motion the number of the way's point that the robot has come to.

    space  what is known of the walls; obstacles that are seen are marked in it
    Raises SimulatorError where an obstacle closes the way, or the robot hits a wall.
    """
    numbers = np.arange(
        len(way)
    )  # which point of the way that was given each point of the way stands for
    watch = replace(driver.laser, reach=WATCH)
    at = waited = 0
    while at < len(way) - 1:
        image = watch.scan(driver.world, np.array([driver.robot.pose]), driver.rng)[0]
        way, numbers = _around_obstacles(driver, space, image, way, numbers, at)
        _stride(driver, way[at:], AIM if image.min() > WIDE else CLOSE)
        before, at = at, _come_to(way, at, driver)
        waited = 0 if at > before else waited + 1
        if waited > PATIENCE:
            raise _error(
                driver, "a way on", f"none that the robot can drive within {PATIENCE} motions"
            )
        yield int(numbers[at])


def _come_to(way: Array, at: int, driver: Driver) -> int:
    """The point of the way that is nearest to the robot, of those that come next; the last one where several are, so that a way that leads back is no trap."""
    off = np.hypot(*(way[at : at + round(1.5 * AIM / CELL)] - np.array(driver.robot.pose[:2])).T)
    nearest = len(off) - 1 - int((off[::-1]).argmin())
    return len(way) - 1 if at + len(off) == len(way) and off[-1] < 2 * STRIDE else at + nearest


def _stride(driver: Driver, way: Array, aim: float) -> None:
    """Turn to the point of the way at which the robot aims, and drive on where it is about ahead."""
    x, y, heading = driver.robot.pose
    goal = way[: 2 + round(aim / CELL)][-1]
    turn = math.remainder(math.atan2(goal[1] - y, goal[0] - x) - heading, math.tau)
    if abs(turn) > SHARP:
        driver.go(0.0, math.copysign(min(abs(turn), BEND), turn))
    else:
        driver.go(
            min(STRIDE, max(math.dist(goal, (x, y)), CELL / 2)),
            math.copysign(min(0.5 * abs(turn), BEND), turn),
        )


def _around_obstacles(
    driver: Driver, space: FreeSpace, image: Array, way: Array, numbers: Cells, at: int
) -> tuple[Array, Cells]:
    """The way, planned anew where the laser shows something new in it."""
    seen = _obstacles(driver, space, image)
    ahead = slice(at, at + round(WATCH / CELL))
    if (
        not len(seen)
        or not (
            blocked := np.flatnonzero(
                _apart(space.middles(way[ahead]), space.middles(seen)) < space.least
            )
        ).size
    ):
        return way, numbers
    here = driver.robot.pose[:2]
    farther = way[at : at + round(2 * WATCH / CELL)]
    part = space.part(np.vstack([farther, [here]]))
    behind = np.flatnonzero(part.off(farther) >= space.least)
    for goal in behind[behind > blocked[-1]][:: round(AIM / CELL)]:
        around = part.way(here, (float(farther[goal][0]), float(farther[goal][1])))
        if around is not None:
            between = at + np.round(np.linspace(0, goal, len(around))).astype(np.intp)
            way = np.vstack([way[:at], around, way[at + goal + 1 :]])
            return way, np.concatenate([numbers[:at], numbers[between], numbers[at + goal + 1 :]])
    raise _error(driver, "a way around what stands there", "none that is wide enough for the robot")


def _obstacles(driver: Driver, space: FreeSpace, image: Array) -> Array:
    """The points where the laser shows something that is neither a known wall nor marked already, (n, 2) metres. They are marked in the space."""
    x, y, heading = driver.robot.pose
    near = image < WATCH
    angles = heading + BEARINGS[near]
    points = np.column_stack([x + image[near] * np.cos(angles), y + image[near] * np.sin(angles)])
    cells = space.cells(points)
    new = (space.off[cells] > KNOWN) & ~space.occupied[cells]
    space.occupied[cells[0][new], cells[1][new]] = True
    return points[new]


def _apart(points: Array, others: Array) -> Array:
    """For each point, (n, 2), how far the nearest one of others, (m, 2), is; (n,) metres."""
    off: Array = np.hypot(*(points[:, None] - others).transpose(2, 0, 1)).min(1)
    return off


def _error(driver: Driver, expected: str, got: str) -> SimulatorError:
    x, y, _ = driver.robot.pose
    return SimulatorError(
        f"{driver.world.name}: drive at ({x:.2f}, {y:.2f}): expected {expected}, got {got}; make room there"
    )
