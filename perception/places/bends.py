"""Finds the bends of the lines of a skeleton: corners of a corridor, where no other way begins.

A bend is a place, although nothing is decided there. A robot that turns at a corner knows well
where it is along its way.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from perception.places.thinning import Edge, Graph, Node
from perception.places.track import Array

Bend = tuple[Node, list[Array]]

# A line bends if the directions from a cell to the points before and after it differ by at least
# TURN radians from straight on. A gateway is merged with another one up to this angle, too.
TURN = math.radians(45)


def bends(graph: Graph, distance: Array, out: float) -> Iterator[Bend]:
    """Find the bends of a skeleton.

    Args:
        graph: The skeleton.
        distance: (rows, columns) distance of each cell to the nearest obstacle, in cells.
        out: The directions are those of points so many cells out of the disc of a cell. A line
            that ends before does not show whether it bends.

    Yields:
        The node of each bend and its two branches: (n, 2) rows and columns each.
    """
    degrees = graph.degrees
    for edge in graph.edges:
        # A line begins where it leaves the disc of its junction. A dead end has no such disc.
        first, last = (graph.nodes[node].radius if degrees[node] > 1 else 0.0 for node in edge.ends)
        yield from _bends_of(edge, first, last, distance, out)


def _bends_of(edge: Edge, first: float, last: float, distance: Array, out: float) -> Iterator[Bend]:
    """The bends of one line, the sharpest first.

    Args:
        edge: The line.
        first: Length of the line in the disc of its first node, in cells.
        last: Length of the line in the disc of its last node, in cells.
        distance: (rows, columns) distance of each cell to the nearest obstacle, in cells.
        out: How far out of the disc directions are measured, in cells.
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
    """By how many radians a line turns at each cell, (n,).

    Args:
        cells: (n, 2) rows and columns.
        along: (n,) length of the line up to each cell.
        radii: (n,) radius of the disc of each cell, in cells.
        out: How far out of the disc directions are measured, in cells.
    """

    def at(where: Array) -> Array:
        return np.stack([np.interp(where, along, cells[:, k]) for k in (0, 1)], axis=1)

    came, goes = cells - at(along - radii - out), at(along + radii + out) - cells
    cross = came[:, 0] * goes[:, 1] - came[:, 1] * goes[:, 0]
    return np.asarray(np.abs(np.arctan2(cross, (came * goes).sum(axis=1))))
