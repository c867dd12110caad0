"""Ways through free space: on a grid of cells, from where a robot is to where it is to go, off the walls and off what its laser has shown.

>>> from simulator.freespace import FreeSpace
>>> room = FreeSpace.of(np.array([[0, 0, 4, 0], [4, 0, 4, 3], [4, 3, 0, 3], [0, 3, 0, 0.0]]), radius=0.2)
>>> way = room.way((0.5, 1.5), (3.5, 1.5))
>>> [(round(float(x), 1), round(float(y), 1)) for x, y in way[[0, -1]]]
[(0.5, 1.5), (3.5, 1.5)]
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter1d, label
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from simulator.errors import SimulatorError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Cells = NDArray[np.intp]
Point = tuple[float, float]
# Metres, the side of a cell.
CELL = 0.1
# Square metres that are planned on at most.
LARGEST = 200_000
# Metres around start and goal, and around the part of the plane that is searched.
MARGIN = 2.0
# Metres off a wall from which on more room is not better, and how many times as long a metre counts that leads along a wall.
ROOM, NARROW = 1.0, 4.0
# Cells around start and goal within which a way may be nearer to walls than elsewhere.
LEEWAY = 2
# Metres, the spread of the filter that rounds the corners of ways.
SMOOTH = 0.3


@dataclass
class FreeSpace:
    """The cells that walls go through, and those where obstacles were seen. Row 0 is at the bottom.

    corner    x and y of the lower left corner, metres
    occupied  (rows, columns)
    radius    of the robot, metres: the middle of the robot stays so far off, and a cell more
    off       (rows, columns): metres to the nearest wall, obstacles not counted
    """

    corner: Point
    occupied: Mask = field(repr=False)
    radius: float
    off: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.off = _clearance(self.occupied)

    @classmethod
    def of(cls, segments: Array, radius: float) -> FreeSpace:
        """The free space between walls, (n, 4) metres. Raises SimulatorError where it is too large for a grid."""
        ends = segments.reshape(-1, 2)
        corner = ends.min(0) - MARGIN
        width, height = ends.max(0) + MARGIN - corner
        if width * height > LARGEST:
            raise SimulatorError(
                f"walls: expected them on at most {LARGEST:,} square metres, on which ways can be planned, got {width:,.0f} x {height:,.0f} m; check the scale"
            )
        columns, rows = math.ceil(width / CELL), math.ceil(height / CELL)
        space = cls((float(corner[0]), float(corner[1])), np.zeros((rows, columns), bool), radius)
        return cls(space.corner, space.drawn(segments), radius)

    @property
    def least(self) -> float:
        """Metres that the middle of the robot stays off what is occupied."""
        return self.radius + CELL

    def drawn(self, segments: Array) -> Mask:
        """The cells that segments go through."""
        cells = np.zeros_like(self.occupied)
        for x1, y1, x2, y2 in segments:
            count = 2 + math.ceil(math.hypot(x2 - x1, y2 - y1) / (CELL / 2))
            rows, columns = self.cells(
                np.column_stack([np.linspace(x1, x2, count), np.linspace(y1, y2, count)])
            )
            cells[rows, columns] = True
        return cells

    def cells(self, points: Array) -> tuple[Cells, Cells]:
        """The rows and the columns of the cells in which points, (n, 2), are; of points that are outside the nearest ones."""
        columns, rows = np.floor((points - np.array(self.corner)) / CELL).astype(np.intp).T
        return rows.clip(0, self.occupied.shape[0] - 1), columns.clip(0, self.occupied.shape[1] - 1)

    def middles(self, points: Array) -> Array:
        """The middles of the cells in which points are, (n, 2)."""
        found: Array = (np.column_stack(self.cells(points)[::-1]) + 0.5) * CELL + np.array(
            self.corner
        )
        return found

    def part(self, points: Array, closed: Mask | None = None) -> Part:
        """The part of the space around points, (n, 2), in which some cells are closed besides the occupied ones."""
        rows, columns = self.cells(np.vstack([points.min(0) - MARGIN, points.max(0) + MARGIN]))
        window = slice(rows[0], rows[1] + 1), slice(columns[0], columns[1] + 1)
        occupied = (
            self.occupied[window] if closed is None else self.occupied[window] | closed[window]
        )
        corner = self.corner[0] + CELL * int(columns[0]), self.corner[1] + CELL * int(rows[0])
        return Part(corner, _clearance(occupied), self.least)

    def way(self, start: Point, goal: Point, closed: Mask | None = None) -> Array | None:
        """The best way from one point to another that does not leave the part around both; see Part.way."""
        return self.part(np.array([start, goal]), closed).way(start, goal)


@dataclass(frozen=True)
class Part:
    """A part of free space: for each cell, (rows, columns), how far it is off what is occupied, and how far the robot has to be off, in metres."""

    corner: Point
    clearance: Array = field(repr=False)
    least: float

    def way(self, start: Point, goal: Point) -> Array | None:
        """The best way from one point to another, (n, 2) metres, a cell's side or its diagonal from point to point; None where there is none.

        It is short, and keeps ROOM off the walls where there is room.
        """
        (row, other_row), (column, other_column) = self._cells(np.array([start, goal]))
        cells = _shortest(
            self.clearance, self.least, (int(row), int(column)), (int(other_row), int(other_column))
        )
        if cells is None:
            return None
        way = self._middles(cells)
        way[0], way[-1] = start, goal
        smooth = gaussian_filter1d(way, SMOOTH / CELL, axis=0, mode="nearest")
        smooth[0], smooth[-1] = start, goal
        safe = self.clearance[self._cells(smooth)] >= self.least
        return np.where(safe[:, None], smooth, way)

    def off(self, points: Array) -> Array:
        """How far points, (n, 2), are off what is occupied, in metres."""
        found: Array = self.clearance[self._cells(points)]
        return found

    @cached_property
    def regions(self) -> Cells:
        """For each cell the number of the region that the robot can drive in without leaving it; 0 where it cannot be."""
        numbered: Cells = label(self.clearance >= self.least, structure=np.ones((3, 3)))[0]
        return numbered

    def region(self, points: Array) -> Cells:
        """The regions in which points, (n, 2), are."""
        found: Cells = self.regions[self._cells(points)]
        return found

    def nearest(self, region: int, goal: Point, room: float) -> Point:
        """Of all points of a region the nearest one to a goal that is `room` metres off the walls, or as far as any."""
        cells = np.argwhere(self.regions == region)
        clearance = self.clearance[tuple(cells.T)]
        cells = cells[clearance >= min(room, float(clearance.max()))]
        middles = self._middles(cells)
        x, y = middles[int(np.hypot(*(middles - np.array(goal)).T).argmin())]
        return float(x), float(y)

    def _cells(self, points: Array) -> tuple[Cells, Cells]:
        columns, rows = np.floor((points - np.array(self.corner)) / CELL + 1e-6).astype(np.intp).T
        return rows.clip(0, self.clearance.shape[0] - 1), columns.clip(
            0, self.clearance.shape[1] - 1
        )

    def _middles(self, cells: Cells) -> Array:
        middles: Array = (cells[:, ::-1] + 0.5) * CELL + np.array(self.corner)
        return middles


def _clearance(occupied: Mask) -> Array:
    """For each cell the metres to the nearest occupied one; what is outside is occupied."""
    clearance: Array = (
        distance_transform_edt(np.pad(~occupied, 1, constant_values=False))[1:-1, 1:-1] * CELL
    )
    return clearance


def _shortest(
    clearance: Array, least: float, start: tuple[int, int], goal: tuple[int, int]
) -> Cells | None:
    """The cells of the cheapest way, (n, 2) rows and columns, through cells that are at least so far off the walls.

    Around start and goal, where a robot may have come nearer to something than it would plan to, all cells are free that are not beside an occupied one.
    """
    rows, columns = clearance.shape
    free = clearance >= least
    for row, column in (start, goal):
        beside = (
            slice(max(row - LEEWAY, 0), row + LEEWAY + 1),
            slice(max(column - LEEWAY, 0), column + LEEWAY + 1),
        )
        free[beside] |= clearance[beside] > 1.5 * CELL
        free[row, column] = True
    price = 1 + (NARROW - 1) * (1 - np.minimum(clearance / ROOM, 1.0)) ** 2
    numbers = np.arange(rows * columns).reshape(rows, columns)
    ends: list[Cells] = []
    others: list[Cells] = []
    costs: list[Array] = []
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here = slice(0, rows - down), slice(max(-right, 0), columns - max(right, 0))
        there = slice(down, rows), slice(max(right, 0), columns + min(right, 0))
        open_ = free[here] & free[there]
        ends.append(numbers[here][open_])
        others.append(numbers[there][open_])
        costs.append((math.hypot(down, right) * (price[here] + price[there]) / 2)[open_])
    graph = coo_array(
        (np.concatenate(costs), (np.concatenate(ends), np.concatenate(others))),
        shape=(rows * columns, rows * columns),
    ).tocsr()
    _, before = dijkstra(
        graph, directed=False, indices=int(numbers[start]), return_predecessors=True
    )
    cell = int(numbers[goal])
    path = [cell]
    while cell != int(numbers[start]):
        cell = int(before[cell])
        if cell < 0:
            return None
        path.append(cell)
    return np.column_stack(np.unravel_index(path[::-1], clearance.shape))
