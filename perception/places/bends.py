"""Finds the bends in the lines of a skeleton: corners of a corridor without a branch.

A bend is a place, although the robot has no choice there. A robot that turns at a corner knows well
how far it is along the corridor.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from perception.places.thinning import Edge, Graph, Node
from perception.places.track import Array

Bend = tuple[Node, list[Array]]

# A line bends at a cell if it turns there by at least this many radians. Ways out that differ by
# less are merged (`visits.MERGED`).
TURN = math.radians(45)


def bends(graph: Graph, distance: Array, out: float) -> Iterator[Bend]:
    """Find the bends of a skeleton.

    Args:
        graph: The skeleton.
        distance: (rows, columns) distance of each cell to the nearest obstacle, in cells.
        out: The direction of a line before and after a cell is measured at points that lie this far
            outside the disc of the cell, in cells. A line that ends nearer than that has no bend.

    Yields:
        The node of each bend and its two branches: (n, 2) rows and columns each.
    """
    degrees = graph.degrees
    for edge in graph.edges:
        # A line begins where it leaves the disc of its junction. A dead end has no such disc.
        first, last = (graph.nodes[node].radius if degrees[node] > 1 else 0.0 for node in edge.ends)
        yield from _bends_of(edge, first, last, distance, out)


def _bends_of(edge: Edge, first: float, last: float, distance: Array, out: float) -> Iterator[Bend]:
    """Find the bends of one line, the sharpest first. See `bends`.

    Args:
        first: Length of the line in the disc of its first node, in cells.
        last: Length of the line in the disc of its last node, in cells.
        distance: (rows, columns) distance of each cell to the nearest obstacle, in cells.
        out: How far outside the disc of a cell directions are measured, in cells.
    """
    cells = edge.cells
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(cells, axis=0).T))])
    rows, columns = np.rint(cells).astype(int).T
    radii = distance[rows, columns]
    fits = np.minimum(along - first, along[-1] - last - along) >= radii + out
    turns = np.where(fits, _turns(cells, along, radii, out), 0.0)
    while turns.max() >= TURN:
        k = int(turns.argmax())
        yield Node(cells[k], float(radii[k])), [cells[k::-1], cells[k:]]
        turns[np.abs(along - along[k]) < 2 * radii[k]] = 0.0


def _turns(cells: Array, along: Array, radii: Array, out: float) -> Array:
    """Compute by how many radians a line turns at each cell, (n,).

    Args:
        cells: (n, 2) rows and columns.
        along: (n,) length of the line up to each cell.
        radii: (n,) radius of the disc of each cell, in cells.
        out: How far outside the disc of a cell directions are measured, in cells.
    """

    def at(where: Array) -> Array:
        return np.stack([np.interp(where, along, cells[:, k]) for k in (0, 1)], axis=1)

    came, goes = cells - at(along - radii - out), at(along + radii + out) - cells
    cross = came[:, 0] * goes[:, 1] - came[:, 1] * goes[:, 0]
    return np.asarray(np.abs(np.arctan2(cross, (came * goes).sum(axis=1))))
