"""Thins a mask of cells to lines one cell wide, and reads the lines as a graph.

The graph has a node at each junction and at each end of a line, and an edge for each line between
two nodes.

Reference:
    Zhang & Suen 1984, "A fast parallel algorithm for thinning digital patterns".
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from perception.places.local_map import Bools, Cell
from perception.places.track import Array

_EIGHT = np.ones((3, 3), bool)
# Steps to the eight neighbours of a cell, those with a common side first.
_STEPS = sorted(
    set(product((-1, 0, 1), repeat=2)) - {(0, 0)},
    key=lambda step: (abs(step[0]) + abs(step[1]), step),
)


@dataclass(frozen=True, eq=False)
class Node:
    """A junction or an end of the lines of a skeleton.

    Attributes:
        at: Row and column: (2,) cells.
        radius: Distance to the nearest cell outside of the mask, in cells.
        cut: Whether the line ends because the map ends there, so that it may lead on.
    """

    at: Array
    radius: float
    cut: bool = False

    @property
    def cell(self) -> Cell:
        """The cell at or nearest to the node."""
        row, column = np.rint(self.at).astype(int)
        return int(row), int(column)


@dataclass(frozen=True, eq=False)
class Edge:
    """A line between two nodes.

    Attributes:
        ends: The numbers of the two nodes; equal for a loop.
        cells: (n, 2) rows and columns along the line, from the first node to the second.
    """

    ends: tuple[int, int]
    cells: Array

    @property
    def length(self) -> float:
        """The length in cells."""
        return float(np.hypot(*np.diff(self.cells, axis=0).T).sum())

    @property
    def reverse(self) -> Edge:
        return Edge((self.ends[1], self.ends[0]), self.cells[::-1])

    def begun_at(self, node: int) -> Edge:
        """The edge, in the direction that begins at a node."""
        return self if self.ends[0] == node else self.reverse


@dataclass(frozen=True, eq=False)
class Graph:
    """The lines of a skeleton.

    Attributes:
        nodes: Nodes by number.
        edges: Edges in any order.
    """

    nodes: dict[int, Node]
    edges: list[Edge]

    @property
    def degrees(self) -> Counter[int]:
        """The number of ends of edges at each node."""
        return Counter(node for edge in self.edges for node in edge.ends)

    def without(self, edge: Edge) -> Graph:
        """The graph without an edge, whose nodes with two edges become parts of one edge."""
        kept = Graph(self.nodes, [other for other in self.edges if other is not edge])
        for node in edge.ends:
            kept = kept.joined_at(node)
        return kept

    def joined_at(self, node: int) -> Graph:
        """The graph whose two edges at a node are one edge, if there are two."""
        here = [edge for edge in self.edges if node in edge.ends]
        if len(here) != 2 or any(edge.ends == (node, node) for edge in here):
            return self
        first, second = here[0].begun_at(node).reverse, here[1].begun_at(node)
        both = Edge(
            (first.ends[0], second.ends[1]), np.concatenate([first.cells, second.cells[1:]])
        )
        return replace(self, edges=[edge for edge in self.edges if edge not in here] + [both])


def thinned(mask: Bools) -> Bools:
    """Thin a mask of cells, (rows, columns), to lines one cell wide."""
    # The import takes a while, and only logs need it.
    from skimage.morphology import skeletonize

    return np.asarray(skeletonize(mask), dtype=np.bool_)


def graph_of(lines: Bools, distance: Array) -> Graph:
    """Read lines as a graph.

    Args:
        lines: (rows, columns) lines one cell wide.
        distance: (rows, columns) distance of each cell to the nearest one outside of the mask that
            was thinned, in cells.
    """
    neighbours = ndimage.convolve(lines.astype(int), _EIGHT.astype(int), mode="constant") - 1
    forks, count = ndimage.label(lines & (neighbours > 2), _EIGHT)
    nodes = {k: _junction(np.argwhere(forks == k), distance) for k in range(1, count + 1)}
    graph = Graph(nodes, [])
    for cells in _parts(lines & (forks == 0)):
        _add_line(graph, _in_order(cells), forks, distance)
    for node in [*graph.nodes]:
        graph = graph.joined_at(node)
    return graph


def _junction(cells: NDArray[np.int64], distance: Array) -> Node:
    return Node(cells.mean(axis=0), float(distance[cells[:, 0], cells[:, 1]].max()))


def _parts(mask: Bools) -> Iterator[NDArray[np.int64]]:
    """The connected parts of a mask, each as its cells: (n, 2) rows and columns."""
    labels, _ = ndimage.label(mask, _EIGHT)
    for number, box in enumerate(ndimage.find_objects(labels), 1):
        corner = np.array([box[0].start, box[1].start])
        yield np.argwhere(labels[box] == number) + corner


def _in_order(cells: NDArray[np.int64]) -> list[Cell]:
    """The cells of a line from one end to the other."""
    left = {(int(row), int(column)) for row, column in cells}

    def next_to(cell: Cell) -> list[Cell]:
        around = ((cell[0] + row, cell[1] + column) for row, column in _STEPS)
        return [other for other in around if other in left]

    line = [next((cell for cell in sorted(left) if len(next_to(cell)) < 2), min(left))]
    left.discard(line[0])
    while onward := next_to(line[-1]):
        line.append(onward[0])
        left.discard(onward[0])
    return line


def _add_line(graph: Graph, line: list[Cell], forks: NDArray[np.int32], distance: Array) -> None:
    """Add a line to a graph, with a node at each of its ends that is at no junction."""
    touched = [_forks_beside(forks, line[0]), _forks_beside(forks, line[-1])]
    if len(line) == 1:  # Both ends are at one cell.
        touched = [touched[0][:1], touched[0][1:2]]
    ends = []
    for cell, beside in zip((line[0], line[-1]), touched, strict=True):
        if beside:
            ends.append(beside[0])
        else:
            ends.append(max(graph.nodes, default=0) + 1)
            graph.nodes[ends[-1]] = _end(cell, distance)
    cells = np.array([graph.nodes[ends[0]].at, *line, graph.nodes[ends[1]].at], float)
    graph.edges.append(Edge((ends[0], ends[1]), cells))


def _forks_beside(forks: NDArray[np.int32], cell: Cell) -> list[int]:
    """The numbers of the junctions that touch a cell."""
    row, column = cell
    around = forks[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
    return [int(number) for number in np.unique(around) if number]


def _end(cell: Cell, distance: Array) -> Node:
    """The node at the end of a line. It is cut if its disc reaches the border of the map."""
    rows, columns = distance.shape
    border = min(cell[0], cell[1], rows - 1 - cell[0], columns - 1 - cell[1])
    radius = float(distance[cell])
    return Node(np.array(cell, float), radius, border <= math.ceil(radius) + 5)
