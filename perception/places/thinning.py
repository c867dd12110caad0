"""Thins a mask of cells to lines one cell wide, and reads the lines as a graph.

The graph has a node at each junction and at each end of a line, and an edge for each line between
two nodes.

Reference:
    Zhang & Suen 1984, "A fast parallel algorithm for thinning digital patterns".
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, product

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from perception.places.local_map import EIGHT, Bools
from perception.places.track import Array

# Steps to the eight neighbours of a cell, those with a common side first.
_STEPS = sorted(
    set(product((-1, 0, 1), repeat=2)) - {(0, 0)},
    key=lambda step: (abs(step[0]) + abs(step[1]), step),
)


@dataclass(frozen=True, eq=False)
class Node:
    """A junction or an end of the lines of a skeleton."""

    at: Array  # row and column: (2,) cells
    radius: float  # distance to the nearest cell outside of the mask, in cells
    cut: bool = False  # whether the line ends because the map ends there, so that it may lead on

    @property
    def cell(self) -> tuple[int, int]:
        """The cell at or nearest to the node."""
        row, column = np.rint(self.at).astype(int)
        return int(row), int(column)


@dataclass(frozen=True, eq=False)
class Edge:
    """A line between two nodes."""

    ends: tuple[int, int]  # the numbers of the two nodes; equal for a loop
    cells: Array  # (n, 2) rows and columns along the line, from the first node to the second

    @cached_property
    def length(self) -> float:
        """The length in cells."""
        steps = self.cells[1:] - self.cells[:-1]
        return float(np.hypot(steps[:, 0], steps[:, 1]).sum())

    @cached_property
    def reverse(self) -> Edge:
        return Edge((self.ends[1], self.ends[0]), self.cells[::-1])

    def begun_at(self, node: int) -> Edge:
        """The edge, in the direction that begins at a node."""
        return self if self.ends[0] == node else self.reverse


@dataclass(frozen=True, eq=False)
class Graph:
    """The lines of a skeleton."""

    nodes: dict[int, Node]  # a dict from numbers to nodes
    edges: list[Edge]  # edges in any order

    @property
    def degrees(self) -> Counter[int]:
        """The number of ends of edges at each node."""
        return Counter(chain.from_iterable(edge.ends for edge in self.edges))

    def without(self, edge: Edge) -> Graph:
        """Remove an edge. If two edges are left at one of its ends, they become one edge."""
        kept = Graph(self.nodes, [other for other in self.edges if other is not edge])
        for node in edge.ends:
            kept = kept.joined_at(node)
        return kept

    def joined_at(self, node: int) -> Graph:
        """Make one edge of the two edges at a node, if there are two."""
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

    return np.asarray(skeletonize(mask))


def graph_of(lines: Bools, distance: Array) -> Graph:
    """Read lines one cell wide, (rows, columns), as a graph.

    `distance` is from each cell to the nearest cell outside of the mask that was thinned, in cells.
    """
    # The cells are numbered row by row, with a margin, so that neighbours have fixed offsets.
    lines = np.pad(lines, 1)
    steps = [row * lines.shape[1] + column for row, column in _STEPS]
    at = np.indices(lines.shape).reshape(2, -1).T
    forks, single = np.zeros_like(lines), lines.copy()
    forks.ravel()[_with_neighbours(lines, steps, range(3, 9))] = True
    single[forks] = False
    ends = set(_with_neighbours(single, steps, range(2)).tolist())
    known: dict[int, int] = {}
    nodes: dict[int, Node] = {}
    for number, part in enumerate(_parts(forks), 1):
        known |= dict.fromkeys(part, number)
        cells = at[part] - 1
        nodes[number] = Node(cells.mean(axis=0), float(distance[cells[:, 0], cells[:, 1]].max()))
    graph = Graph(nodes, [])
    for part in _parts(single):
        line = _in_order(part, ends, steps)
        beside = [
            sorted({known[cell + step] for step in steps if cell + step in known})
            for cell in (line[0], line[-1])
        ]
        _add_line(graph, at[line] - 1, beside, distance)
    for node, degree in graph.degrees.items():
        graph = graph.joined_at(node) if degree == 2 else graph
    return graph


def _with_neighbours(lines: Bools, steps: Sequence[int], counts: range) -> NDArray[np.intp]:
    """The numbers of the cells of lines whose number of neighbours is one of `counts`."""
    cells, flat = np.flatnonzero(lines), lines.ravel().view(np.uint8)
    neighbours = sum(flat[cells + step] for step in steps)
    return cells[np.isin(neighbours, counts)]


def _parts(mask: Bools) -> list[list[int]]:
    """The connected parts of a mask, each as the numbers of its cells, ascending."""
    labels, count = ndimage.label(mask, EIGHT)
    parts: list[list[int]] = [[] for _ in range(count)]
    cells = np.flatnonzero(mask)
    for cell, label in zip(cells.tolist(), labels.ravel()[cells].tolist(), strict=True):
        parts[label - 1].append(cell)
    return parts


def _in_order(cells: Sequence[int], ends: Set[int], steps: Sequence[int]) -> list[int]:
    """The cells of a line from one end to the other.

    `steps` has the differences between the numbers of neighbouring cells, those to try first first.
    """
    left = set(cells)
    cell: int | None = next((cell for cell in cells if cell in ends), cells[0])
    line = []
    while cell is not None:
        line.append(cell)
        left.discard(cell)
        cell = next((cell + step for step in steps if cell + step in left), None)
    return line


def _add_line(
    graph: Graph, line: NDArray[np.int64], touched: Sequence[list[int]], distance: Array
) -> None:
    """Add a line, (n, 2), with a node at each end that touches no junction (`touched`)."""
    if len(line) == 1:  # Both ends are at one cell.
        touched = [touched[0][:1], touched[0][1:2]]
    ends = []
    for cell, beside in zip((line[0], line[-1]), touched, strict=True):
        if beside:
            ends.append(beside[0])
        else:
            ends.append(max(graph.nodes, default=0) + 1)
            graph.nodes[ends[-1]] = _end(cell, distance)
    cells = np.concatenate([graph.nodes[ends[0]].at[None], line, graph.nodes[ends[1]].at[None]])
    graph.edges.append(Edge((ends[0], ends[1]), cells))


def _end(cell: NDArray[np.int64], distance: Array) -> Node:
    """Make the node at the end of a line. It counts as cut if its disc reaches the map's border."""
    rows, columns = distance.shape
    row, column = int(cell[0]), int(cell[1])
    border = min(row, column, rows - 1 - row, columns - 1 - column)
    radius = float(distance[row, column])
    return Node(cell.astype(float), radius, border <= math.ceil(radius) + 5)
