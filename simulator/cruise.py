"""Drives along a planned route and around unknown obstacles.

The walls of the building are known. The robot aims at a point AIM metres ahead on its route. If the
laser shows an obstacle on the route that is no known wall, the robot plans a route around it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from simulator.driver import Driver
from simulator.errors import SimulatorError
from simulator.freespace import CELL, Cells, FreeSpace
from simulator.laser import BEARINGS

Array = NDArray[np.float64]
# Metres between two images.
STRIDE = 0.1
# Distance in metres along the route to the aim: CLOSE if something is nearer than WIDE, so that the
# robot cuts no corner, otherwise AIM.
AIM, CLOSE, WIDE = 0.5, 0.2, 0.6
# Largest turn in a stride, and the turn from which the robot turns on the spot, in radians.
BEND, SHARP = math.radians(20), math.radians(50)
# Obstacles within WATCH metres of the robot matter. A point is an obstacle if it is more than KNOWN
# metres from known walls.
WATCH, KNOWN = 3.0, 0.25
# The robot is stuck after this many motions without progress.
PATIENCE = 100


def drive_along(driver: Driver, space: FreeSpace, way: Array) -> Iterator[int]:
    """Drive along a route, (n, 2) metres; yield the index of the point that each motion reached.

    `space` is the free space between known walls. Obstacles that the laser sees are marked in
    it. Raises SimulatorError if one blocks the route, or the robot is stuck or hits a wall.
    """
    # Index in the given route of each point of the current route, which changes around obstacles.
    numbers = np.arange(len(way))
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
    """Find the index of the nearest upcoming point of the route, (n, 2) metres, from `at` on.

    If several points are equally near, it is the last of them, so that a route may turn back.
    """
    off = np.hypot(*(way[at : at + round(1.5 * AIM / CELL)] - np.array(driver.robot.pose[:2])).T)
    nearest = len(off) - 1 - int((off[::-1]).argmin())
    return len(way) - 1 if at + len(off) == len(way) and off[-1] < 2 * STRIDE else at + nearest


def _stride(driver: Driver, way: Array, aim: float) -> None:
    """Turn to the point `aim` metres ahead on the route. Drive if the robot roughly faces it."""
    x, y, heading = driver.robot.pose
    goal = way[: 2 + round(aim / CELL)][-1]
    turn = math.remainder(math.atan2(goal[1] - y, goal[0] - x) - heading, math.tau)
    if abs(turn) > SHARP:
        driver.go(0.0, math.copysign(min(abs(turn), BEND), turn))
    else:
        metres = min(STRIDE, max(math.dist(goal, (x, y)), CELL / 2))
        driver.go(metres, math.copysign(min(0.5 * abs(turn), BEND), turn))


def _around_obstacles(
    driver: Driver, space: FreeSpace, image: Array, way: Array, numbers: Cells, at: int
) -> tuple[Array, Cells]:
    """Plan the route again if the laser shows a new obstacle on it, or raise SimulatorError.

    `numbers` has the index in the given route of each point of the current route, and changes with
    it.
    """
    seen = _obstacles(driver, space, image)
    ahead = slice(at, at + round(WATCH / CELL))
    if not len(seen):
        return way, numbers
    apart = _apart(space.middles(way[ahead]), space.middles(seen))
    blocked = np.flatnonzero(apart < space.least)
    if not len(blocked):
        return way, numbers
    # Rejoin the route at the first free point behind the obstacle that can be reached.
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
    """Find new obstacles in an image, (n, 2) metres, and mark them in the free space."""
    x, y, heading = driver.robot.pose
    near = image < WATCH
    angles = heading + BEARINGS[near]
    points = np.column_stack([x + image[near] * np.cos(angles), y + image[near] * np.sin(angles)])
    cells = space.cells(points)
    new = (space.off[cells] > KNOWN) & ~space.occupied[cells]
    space.occupied[cells[0][new], cells[1][new]] = True
    return points[new]


def _apart(points: Array, others: Array) -> Array:
    """The distance from each point to the nearest of other points, (n,)."""
    return np.asarray(np.hypot(*(points[:, None] - others).transpose(2, 0, 1)).min(1))


def _error(driver: Driver, expected: str, got: str) -> SimulatorError:
    x, y, _ = driver.robot.pose
    return SimulatorError(
        f"{driver.world.name}: drive at ({x:.2f}, {y:.2f}): expected {expected}, got {got}; "
        "make room there"
    )
