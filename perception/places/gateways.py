"""Which ways lead out of the free space around a point, and from where they part.

A way out is a part of the free space that lies as far from the point as places are large, by the way that one would drive, and that is wide enough all along. So an alcove is none, and a corridor
is one, whatever stands in it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from perception.places.local_map import CELL, STRIDE, Bools, Cell, Patch, distances
from perception.places.track import Array

# Ways out that are seen in directions that differ by less than this are one, in radians.
MERGED = math.radians(35)
# A way out has at least so many cells.
LEAST = 3
# How much farther than the radius the ring reaches in which ways out are looked for, in metres.
RING = 0.6
# A point is as good a middle as the best one if the ways to it are longer by no more than this, in metres.
AS_GOOD = 0.35

_EIGHT = np.ones((3, 3), bool)


@dataclass(frozen=True, eq=False)
class Exit:
    """A way out of a place.

    bearing  its direction from the middle of the place, in radians counterclockwise in the frame of the track
    cells    where the ring crosses it
    """

    bearing: float
    cells: Bools


@dataclass(frozen=True, eq=False)
class Outlook:
    """The ways out that are seen from a cell of a patch.

    middle    the cell
    exits     counterclockwise
    reached   metres from the middle to each cell, as far as ways out were looked for
    """

    middle: Cell
    exits: tuple[Exit, ...]
    reached: Array

    @property
    def bearings(self) -> tuple[float, ...]:
        return tuple(exit.bearing for exit in self.exits)


def nearest(open_cells: Bools, cell: Cell, within: float) -> Cell | None:
    """The open cell nearest to a cell, if it is not farther away than so many metres."""
    rows, columns = np.nonzero(open_cells)
    if not len(rows):
        return None
    far = (rows - cell[0]) ** 2 + (columns - cell[1]) ** 2
    k = int(far.argmin())
    return (int(rows[k]), int(columns[k])) if far[k] <= (within / CELL) ** 2 else None


def outlook(open_cells: Bools, middle: Cell, radius: float) -> Outlook:
    """The ways out that lead at least `radius` metres from a cell through open cells."""
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
    """Ways out in nearly one direction are one: something stands in the middle of it."""
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
    """Where the ways to all exits part: the cell from which they are shortest together; of those that are nearly as good, the one with most room.

    Of two ways out it is where the way from one to the other bends most.
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
