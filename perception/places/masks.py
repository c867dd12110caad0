"""Grows and shrinks masks of cells."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
from numpy.typing import NDArray

Bools = NDArray[np.bool_]
Box = tuple[slice, slice]


def grown(mask: Bools) -> Bools:
    """Add the eight neighbours of each cell of a mask, (rows, columns)."""
    return ~shrunk(~mask, outside=True)


def shrunk(mask: Bools, outside: bool = False) -> Bools:
    """Remove the cells of a mask, (rows, columns), that have a neighbour outside of it.

    `outside` says whether the cells beyond the border count as cells of the mask.
    """
    padded = np.pad(mask, 1, constant_values=outside)
    rows = padded[:-2] & padded[1:-1] & padded[2:]
    return np.asarray(rows[:, :-2] & rows[:, 1:-1] & rows[:, 2:])


def near(mask: Bools, far: float, cell: float) -> Bools:
    """Find the cells within `far` metres of a cell of a mask. Cells are `cell` metres wide."""
    most, (rows, columns) = int(far / cell), mask.shape
    padded, found = np.pad(mask, most), np.zeros_like(mask)
    for row, column in product(range(-most, most + 1), repeat=2):
        if math.hypot(row, column) * cell < far:
            begin, left = most + row, most + column
            found |= padded[begin : begin + rows, left : left + columns]
    return found


def box_of(mask: Bools) -> Box:
    """Find the smallest box that holds all cells of a mask, with a margin of one cell.

    At the border of the mask the box has no margin. Thinning the mask, or computing distances
    within it, needs the cells of this box only.
    """
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return slice(0, 0), slice(0, 0)
    return (
        slice(max(int(rows[0]) - 1, 0), int(rows[-1]) + 2),
        slice(max(int(columns[0]) - 1, 0), int(columns[-1]) + 2),
    )
