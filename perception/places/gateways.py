"""Finds the exits of the free space around a point, and the point where they meet.

An exit is a connected part of the free space at a distance of one radius from the point, measured
along the shortest drivable path. A path is drivable if a gateway's width is free along it. So an
alcove is no exit, but a corridor with an obstacle is one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from perception.places.local_map import CELL, STRIDE, Bools, Cell, Patch, distances
from perception.places.track import Array

# Exits whose directions differ by less than this, in radians, are one.
MERGED = math.radians(35)
# Smallest number of cells of an exit.
LEAST = 3
# Width of the ring outside the radius in which exits are searched, in metres.
RING = 0.6
# A middle is as good as the best if the paths to the exits are at most this much longer, in metres.
AS_GOOD = 0.35

_EIGHT = np.ones((3, 3), bool)


@dataclass(frozen=True, eq=False)
class Exit:
    """An exit of a place.

    Attributes:
        bearing: Direction from the middle, in radians counterclockwise in the frame of the track.
        cells: Mask of the cells of the patch that form this exit, just outside the radius.
    """

    bearing: float
    cells: Bools


@dataclass(frozen=True, eq=False)
class Outlook:
    """The exits seen from a cell of a patch.

    Attributes:
        middle: The cell (row, column) from which the exits are seen.
        exits: Exits, counterclockwise.
        reached: (rows, columns) metres from the middle to each cell along drivable cells; infinite
            beyond the exits.
    """

    middle: Cell
    exits: tuple[Exit, ...]
    reached: Array

    @property
    def bearings(self) -> tuple[float, ...]:
        return tuple(exit.bearing for exit in self.exits)


def nearest(open_cells: Bools, cell: Cell, within: float) -> Cell | None:
    """Find the open cell nearest to a cell.

    Args:
        open_cells: Mask of the open cells.
        cell: Row and column.
        within: Largest distance in metres.

    Returns:
        Row and column; None if no open cell is near enough.
    """
    rows, columns = np.nonzero(open_cells)
    if not len(rows):
        return None
    far = (rows - cell[0]) ** 2 + (columns - cell[1]) ** 2
    k = int(far.argmin())
    return (int(rows[k]), int(columns[k])) if far[k] <= (within / CELL) ** 2 else None


def outlook(open_cells: Bools, middle: Cell, radius: float) -> Outlook:
    """Find the exits around a cell, at a distance of `radius` through open cells.

    Args:
        open_cells: Mask of the drivable cells.
        middle: The cell.
        radius: Metres.
    """
    seed = np.zeros(open_cells.shape, bool)
    seed[middle] = True
    reached = distances(open_cells, seed, radius + RING)
    parts, count = ndimage.label(np.isfinite(reached) & (reached >= radius), _EIGHT)
    found: list[Exit] = []
    for cells in (parts == k for k in range(1, count + 1)):
        if cells.sum() >= LEAST:
            row, column = np.argwhere(cells).mean(axis=0) - middle
            found.append(Exit(math.atan2(column, row), cells))
    return Outlook(
        middle, tuple(sorted(_merged(found, middle), key=lambda exit: exit.bearing)), reached
    )


def _merged(exits: list[Exit], middle: Cell) -> list[Exit]:
    """Merge exits in nearly the same direction, since an obstacle may split an exit."""
    kept: list[Exit] = []
    for exit in sorted(exits, key=lambda exit: -int(exit.cells.sum())):
        for i, other in enumerate(kept):
            if apart(exit.bearing, other.bearing) < MERGED:
                kept[i] = Exit(other.bearing, other.cells | exit.cells)
                break
        else:
            kept.append(exit)
    return kept


def apart(a: float, b: float) -> float:
    """Compute the angle between two directions in radians, from 0 to pi."""
    return abs((a - b + math.pi) % (2 * math.pi) - math.pi)


def parting(patch: Patch, open_cells: Bools, seen: Outlook, radius: float) -> Cell:
    """Find the cell where the paths to all exits meet.

    That is the cell with the smallest sum of distances to the exits. Of nearly equal cells, the one
    farthest from obstacles is taken. If there are two exits, only cells at the bend of the path
    between them are considered: those farthest from the straight line between the exits.

    Args:
        patch: Local map.
        open_cells: Mask of the drivable cells.
        seen: The exits.
        radius: Distance in metres of the exits from the cell that they are seen from.
    """
    inside = open_cells & np.isfinite(seen.reached)
    total = sum(
        (distances(inside, exit.cells, 2 * radius + 2) for exit in seen.exits),
        np.zeros(inside.shape),
    )
    good = total <= total.min() + (AS_GOOD if len(seen.exits) > 2 else 2 * AS_GOOD)
    cells = np.argwhere(good)
    if len(seen.exits) == 2:
        one, other = (np.argwhere(exit.cells).mean(axis=0) for exit in seen.exits)
        along = (other - one) / max(math.dist(one, other), 1e-9)
        off = np.abs((cells - one) @ np.array([-along[1], along[0]]))
        cells = cells[off >= off.max() - 4 * STRIDE]
    row, column = cells[patch.room[cells[:, 0], cells[:, 1]].argmax()]
    return int(row), int(column)
