"""Plans routes through free space, and drives along them and around unknown obstacles.

>>> from simulator.cruise import FreeSpace
>>> walls = np.array([[0, 0, 4, 0], [4, 0, 4, 3], [4, 3, 0, 3], [0, 3, 0, 0.0]])
>>> room = FreeSpace.of(walls, radius=0.2)
>>> way = room.part(walls.reshape(-1, 2)).way((0.5, 1.5), (3.5, 1.5))
>>> [(round(float(x), 1), round(float(y), 1)) for x, y in way[[0, -1]]]
[(0.5, 1.5), (3.5, 1.5)]

Free space is a grid, and routes stay away from walls and seen obstacles. The walls of the building
are known. The robot aims at a point AIM metres ahead on its route. If the laser shows an obstacle
on the route that is no known wall, the robot plans a route around it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter1d, label
from scipy.spatial.distance import cdist
from skimage.graph import MCP_Geometric

from simulator.driver import Driver
from simulator.errors import SimulatorError
from simulator.robot import BEARINGS
from simulator.world import Array

Mask = NDArray[np.bool_]
Cells = NDArray[np.intp]
Point = tuple[float, float]
# Side of a cell in metres.
CELL = 0.1
# The share of a cell by which rounding may move a point.
TINY = 1e-6
# Largest area to plan on, in square metres.
LARGEST = 200_000
# The grid reaches this many metres beyond the walls. A part of it reaches this far beyond the
# points around which it is cut out.
MARGIN = 2.0
# A route prefers to stay ROOM metres from walls; more is not better. A metre at a wall costs as
# much as NARROW metres in the open.
ROOM, NARROW = 1.0, 4.0
# Cells around start and goal in which a route may be nearer to walls than elsewhere.
LEEWAY = 2
# Width in metres of the Gaussian filter that rounds corners.
SMOOTH = 0.3
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
    ahead = way[at : at + round(WATCH / CELL)]
    # Points of the route ahead that are too close to the cells of new obstacles.
    cells, others = (space.middles(np.column_stack(space.cells(p))) for p in (ahead, seen))
    blocked = np.flatnonzero((cdist(cells, others) < space.least).any(axis=1))
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
    new = (space.clearance[cells] > KNOWN) & ~space.occupied[cells]
    space.occupied[cells] |= new
    return points[new]


def _error(driver: Driver, expected: str, got: str) -> SimulatorError:
    x, y, _ = driver.robot.pose
    return SimulatorError(
        f"{driver.world.name}: drive at ({x:.2f}, {y:.2f}): expected {expected}, got {got}; "
        "make room there"
    )


@dataclass
class FreeSpace:
    """A grid of cells with walls and obstacles. Row 0 is at the bottom."""

    corner: Point  # (x, y) of the lower left corner in metres
    occupied: Mask = field(repr=False)  # (rows, columns) mask of the cells with walls or obstacles
    radius: float  # radius of the robot in metres
    # (rows, columns) distance in metres to the nearest cell that is occupied or outside. Obstacles
    # that are marked later do not count.
    clearance: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        free = np.pad(~self.occupied, 1)
        self.clearance = distance_transform_edt(free)[1:-1, 1:-1] * CELL

    @classmethod
    def of(cls, segments: Array, radius: float) -> FreeSpace:
        """Make the free space between walls, (n, 4), for a robot of this radius, in metres.

        Raises SimulatorError if the area is too large.
        """
        ends = segments.reshape(-1, 2)
        corner = ends.min(0) - MARGIN
        width, height = ends.max(0) + MARGIN - corner
        if width * height > LARGEST:
            raise SimulatorError(
                f"walls: expected an area of at most {LARGEST:,} square metres, in which ways "
                f"can be planned, got {width:,.0f} x {height:,.0f} m; check the scale"
            )
        columns, rows = math.ceil(width / CELL), math.ceil(height / CELL)
        space = cls((float(corner[0]), float(corner[1])), np.zeros((rows, columns), bool), radius)
        return cls(space.corner, space.drawn(segments), radius)

    @property
    def least(self) -> float:
        """Smallest distance of the robot's middle from occupied cells, in metres."""
        return self.radius + CELL

    def drawn(self, segments: Array) -> Mask:
        """Make the mask, (rows, columns), of the cells that segments, (n, 4), cross."""
        cells = np.zeros_like(self.occupied)
        for x1, y1, x2, y2 in segments:
            count = 2 + math.ceil(math.hypot(x2 - x1, y2 - y1) / (CELL / 2))
            cells[self.cells(np.linspace((x1, y1), (x2, y2), count))] = True
        return cells

    def cells(self, points: Array) -> tuple[Cells, Cells]:
        """Find the rows, (n,), and columns, (n,), of points, (n, 2) metres.

        A point outside the grid has the nearest cell.
        """
        cells = np.floor((points - np.array(self.corner)) / CELL + TINY).astype(np.intp)
        columns, rows = cells.clip(0, np.array(self.occupied.shape[::-1]) - 1).T
        return rows, columns

    def middles(self, cells: Cells) -> Array:
        """Compute the centres, (n, 2) metres, of cells, (n, 2) rows and columns."""
        return np.asarray((cells[:, ::-1] + 0.5) * CELL + np.array(self.corner))

    def off(self, points: Array) -> Array:
        """Measure how far points, (n, 2), are from occupied cells: (n,), metres."""
        return np.asarray(self.clearance[self.cells(points)])

    def part(self, points: Array, closed: Mask | None = None) -> FreeSpace:
        """Cut out a rectangle of the grid around some points, (n, 2) metres.

        Obstacles that were marked before count. `closed` is a mask, (rows, columns), of further
        cells that count as occupied.
        """
        rows, columns = self.cells(np.vstack([points.min(0) - MARGIN, points.max(0) + MARGIN]))
        window = slice(rows[0], rows[1] + 1), slice(columns[0], columns[1] + 1)
        occupied = self.occupied if closed is None else self.occupied | closed
        corner = self.corner[0] + CELL * int(columns[0]), self.corner[1] + CELL * int(rows[0])
        return FreeSpace(corner, occupied[window], self.radius)

    def way(self, start: Point, goal: Point) -> Array | None:
        """Find a route between points (x, y): short, and ROOM metres from walls if possible.

        It is (n, 2) metres, with a point in each cell; None if there is no route.
        """
        ends = np.column_stack(self.cells(np.array([start, goal])))
        cells = _shortest(self.clearance, self.least, *map(tuple, ends.tolist()))
        if cells is None:
            return None
        way = self.middles(cells)
        way[0], way[-1] = start, goal
        # Use a smoothed point only if it is far enough from obstacles.
        smooth = gaussian_filter1d(way, SMOOTH / CELL, axis=0, mode="nearest")
        smooth[0], smooth[-1] = start, goal
        return np.where((self.off(smooth) >= self.least)[:, None], smooth, way)

    @cached_property
    def regions(self) -> Cells:
        """The number of the connected region of each cell; 0 if the robot cannot be there."""
        return np.asarray(label(self.clearance >= self.least, structure=np.ones((3, 3)))[0])

    def region(self, points: Array) -> Cells:
        """Look up the number of the region of each point, (n, 2) metres; see `regions`."""
        return np.asarray(self.regions[self.cells(points)])

    def nearest(self, region: int, goal: Point, room: float) -> Point:
        """Find the point (x, y) of a region, by its number, that is nearest to a goal.

        It is at least `room` metres from walls, if the region has such points. Otherwise, it is
        as far from walls as possible.
        """
        cells = np.argwhere(self.regions == region)
        clearance = self.clearance[tuple(cells.T)]
        middles = self.middles(cells[clearance >= min(room, float(clearance.max()))])
        x, y = middles[int(np.hypot(*(middles - np.array(goal)).T).argmin())]
        return float(x), float(y)


def _shortest(
    clearance: Array, least: float, start: tuple[int, int], goal: tuple[int, int]
) -> Cells | None:
    """The cells, (n, 2) rows and columns, of the cheapest route between two cells, or None.

    `clearance` is the distance to the nearest occupied cell in metres, (rows, columns). A route
    needs at least `least`. Near start and goal, where the robot may be closer to obstacles than
    planned, it need only not touch an occupied cell.
    """
    free = clearance >= least
    for cell in (start, goal):
        beside = tuple(slice(max(k - LEEWAY, 0), k + LEEWAY + 1) for k in cell)
        free[beside] |= clearance[beside] > 1.5 * CELL
        free[cell] = True
    price = 1 + (NARROW - 1) * (1 - np.minimum(clearance / ROOM, 1.0)) ** 2
    ways = MCP_Geometric(np.where(free, price, -1.0))  # -1 is closed
    costs, _ = ways.find_costs([start], [goal])
    return np.array(ways.traceback(goal)) if np.isfinite(costs[goal]) else None
