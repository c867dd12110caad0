"""Finds the exits of the free space around a point, and the point where they meet.

An exit is a part of the free space, one radius away by the shortest drivable path, that can be
reached at full width. So an alcove is no exit. A corridor with an obstacle is one.
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
        cells: Mask of the ring's cells that form this exit.
    """

    bearing: float
    cells: Bools


@dataclass(frozen=True, eq=False)
class Outlook:
    """The exits seen from a cell of a patch.

    Attributes:
        middle: The cell.
        exits: Exits, counterclockwise.
        reached: Metres from the middle to each cell, up to the end of the ring.
    """

    middle: Cell
    exits: tuple[Exit, ...]
    reached: Array

    @property
    def bearings(self) -> tuple[float, ...]:
        return tuple(exit.bearing for exit in self.exits)


def nearest(open_cells: Bools, cell: Cell, within: float) -> Cell | None:
    """The open cell nearest to a cell, if it is within this many metres."""
    rows, columns = np.nonzero(open_cells)
    if not len(rows):
        return None
    far = (rows - cell[0]) ** 2 + (columns - cell[1]) ** 2
    k = int(far.argmin())
    return (int(rows[k]), int(columns[k])) if far[k] <= (within / CELL) ** 2 else None


def outlook(open_cells: Bools, middle: Cell, radius: float) -> Outlook:
    """The exits at least `radius` metres from a cell through open cells."""
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
    """The angle between two directions, from 0 to pi."""
    return abs((a - b + math.pi) % (2 * math.pi) - math.pi)


def parting(patch: Patch, open_cells: Bools, seen: Outlook, radius: float) -> Cell:
    """The cell where the paths to all exits meet.

    The sum of the paths to the exits is shortest there. Of nearly equal cells, the one with the
    most room is taken. With two exits, it is the sharpest bend of the path between them.
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
