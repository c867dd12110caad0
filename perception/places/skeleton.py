"""Finds the junctions of the skeleton of a local map.

The skeleton is the set of the points that are as far as possible from all obstacles around them. It
has a junction where ways part. A junction has a disc, which reaches to the nearest obstacle, and a
branch for each way. A way into a niche has a branch, too. So a branch that ends soon after it
leaves the disc is removed. Two junctions are merged if one is in the disc of the other, and the
space between them is not narrow.

In a hall, ways part in front of its doors, and not only in its middle. So the skeleton gets a shore
around each open space: a line that follows the walls at a fixed distance. Each way into the open
space has a junction with the shore, called a mouth. A bend of a line counts as a junction of two
ways.

The mask of the free cells is thinned to lines one cell wide. They are read as a graph, which has a
node at each junction and at each end of a line, and an edge for each line between two nodes.

References:
    Zhang & Suen 1984, "A fast parallel algorithm for thinning digital patterns".
    Thrun 1998, "Learning metric-topological maps for indoor mobile robot navigation".
    Shaked & Bruckstein 1998, "Pruning medial axes".
    Beeson, Jong & Kuipers 2005, "Towards autonomous topological place detection using the extended
    Voronoi graph".
    Beeson, Modayil & Kuipers 2010, "Factoring the mapping problem".
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain, product

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from perception.places.local_map import CELL, Bools, Patch, any_beside, squares_to_false
from perception.places.track import Array

# A cell and its eight neighbours.
EIGHT = np.ones((3, 3), np.bool_)
# Steps to the eight neighbours of a cell, those with a common side first.
_STEPS = sorted(
    set(product((-1, 0, 1), repeat=2)) - {(0, 0)},
    key=lambda step: (abs(step[0]) + abs(step[1]), step),
)
# Obstacles that stand free are furniture if they cover less than FURNITURE square metres, and the
# diagonal of the rectangle around them is shorter than LONG metres. Longer ones may be walls. Both
# include the margin that the middle of the robot cannot enter.
FURNITURE, LONG = 4.0, 3.0
# A branch counts if it leads at least OUT metres out of the disc of its junction, and at least
# SHARE times the radius of the disc.
OUT, SHARE = 0.75, 0.5
# Junctions within ONE metres of each other are merged, even if their discs are smaller. The free
# space between merged junctions is nowhere narrower than NARROW times the smaller disc.
ONE, NARROW = 0.6, 0.75
# A shore is SHORE widths of the robot away from obstacles. A space is open if its middle is at
# least WIDE times as far from obstacles as the shore. Then the shores on both sides of the space
# are farther apart than SHORE widths, and count as two ways. The directions of a bend are measured
# SHORE widths outside its disc.
SHORE, WIDE = 3.0, 1.5

# A line bends at a cell if it turns there by at least this many radians. Ways out that differ by
# less are merged (`visits.MERGED`).
TURN = math.radians(45)


@dataclass(frozen=True, eq=False)
class Junction:
    """A point of a local map where ways part, or where the only way bends."""

    middle: Array  # (x, y) in metres, in the frame of the track
    radius: float  # distance from the middle to the nearest obstacle, in metres
    branches: tuple[Array, ...]  # (n, 2) x and y of points along each way, beginning in the disc


def junctions(patch: Patch, room: float) -> list[Junction]:
    """Find the junctions and the bends of the skeleton of a local map.

    `room` is half the width of the robot in metres.
    """
    mask = passable(patch, room)
    # The middle of the robot is `room` away from obstacles, so the disc of a cell is larger.
    distance = np.sqrt(squares_to_false(np.pad(mask, 1)))[1:-1, 1:-1] + room / CELL
    far = SHORE * 2 * room / CELL
    lines, inner = thinned(mask), open_space(distance, far)
    graph = pruned(graph_of(lines, distance))
    found = junctions_merged(graph, distance)
    if inner.any():
        shores = pruned(graph_of(with_shores(lines, inner), distance))
        found = _with_mouths(found, junctions_merged(shores, distance), far)
    corners = [
        (node, branches)
        for node, branches in bends(graph, distance, far)
        if not inner[node.cell]
        and all(math.dist(node.at, o.at) > max(node.radius, o.radius) for o, _ in found)
    ]
    at = patch.position
    return [
        Junction(at(node.at), node.radius * CELL, tuple(map(at, branches)))
        for node, branches in found + corners
    ]


def _with_mouths(found: list[Fork], mouths: list[Fork], far: float) -> list[Fork]:
    """Combine two lists of junctions: `found` without shores, and `mouths` with shores.

    Shores are lines around open spaces. All mouths are kept. A junction of `found` is kept if it is
    amid an open space, and no mouth is near.
    """
    # The disc of a junction amid an open space is as large as those of the mouths around it.
    amid = [
        (replace(node, radius=far), branches)
        for node, branches in found
        if node.radius > far and all(math.dist(node.at, mouth.at) > far for mouth, _ in mouths)
    ]
    return mouths + amid


def open_space(distance: Array, far: float) -> Bools:
    """Find the cells inside the shores of open spaces. Shores are `far` cells from obstacles.

    `distance` is from each cell to the nearest obstacle, in cells, (rows, columns).
    """
    if distance.max() < WIDE * far:
        return np.zeros(distance.shape, np.bool_)
    return _parts_with(distance > far, distance >= WIDE * far)


def _parts_with(mask: Bools, some: Bools) -> Bools:
    """Find the connected parts of a mask in which some cells, which it includes, lie."""
    parts, count = ndimage.label(mask, EIGHT)
    is_found = np.zeros(count + 1, np.bool_)
    is_found[parts[some]] = True
    return np.asarray(is_found[parts])


def with_shores(lines: Bools, inner: Bools) -> Bools:
    """Replace the lines of a skeleton in open spaces by shores, which run around the spaces.

    `lines` and `inner` are masks, (rows, columns). `inner` has the cells inside shores.
    """
    # A space that leads on beyond the border of the map has no shore there.
    shore = inner & ~ndimage.binary_erosion(inner, border_value=1)
    return thinned((lines & ~inner) | shore)


def passable(patch: Patch, room: float) -> Bools:
    """Find the cells that the middle of a robot of `room` metres radius can reach.

    Furniture does not count as an obstacle.
    """
    trail = any_beside(np.pad(patch.trail, 1))
    fits = trail | patch.free
    if patch.occupied.any():
        distance = np.sqrt(squares_to_false(~patch.occupied)) * CELL
        fits = trail | (patch.free & (distance >= room))
    narrow = any_beside(np.pad(~fits, 1, constant_values=True))
    fits = any_beside(np.pad(~narrow, 1)) | trail
    reached = _parts_with(fits, trail)
    # Small holes within the reached space are furniture, unless they touch the border.
    holes, count = ndimage.label(~reached)
    sizes = np.bincount(holes.ravel(), minlength=count + 1) * CELL**2
    small = sizes < FURNITURE
    small[0] = False
    for hole, (rows, columns) in enumerate(ndimage.find_objects(holes), start=1):
        sides = rows.stop - rows.start, columns.stop - columns.start
        small[hole] &= math.hypot(*sides) * CELL < LONG
    for side in (holes[0], holes[-1], holes[:, 0], holes[:, -1]):
        small[side] = False
    return np.asarray(reached | small[holes])


def pruned(graph: Graph) -> Graph:
    """Remove branches that end soon after they leave the disc of their junction, shortest first."""
    while True:
        degrees = graph.degrees
        short = [
            (out, number)
            for number, edge in enumerate(graph.edges)
            if (out := _out(edge, graph.nodes, degrees)) is not None
        ]
        if not short:
            return graph
        graph = graph.without(graph.edges[min(short)[1]])


def _out(edge: Edge, nodes: Mapping[int, Node], degrees: Mapping[int, int]) -> float | None:
    """Compute how many metres a dead end leads out of its junction's disc; None if it stays."""
    tip, root = sorted(edge.ends, key=degrees.__getitem__)
    if degrees[tip] > 1 or degrees[root] < 3 or nodes[tip].cut:
        return None
    out = (edge.length + nodes[tip].radius - nodes[root].radius) * CELL
    return out if out < max(OUT, SHARE * nodes[root].radius * CELL) else None


def junctions_merged(graph: Graph, distance: Array) -> list[Fork]:
    """Merge junctions in one open space, and give each its branches: (n, 2) rows and columns.

    The radius of a merged junction is the radius of its largest disc. `distance` is from each cell
    to the nearest obstacle, in cells, (rows, columns).
    """
    degrees = graph.degrees
    head = {node: node for node in graph.nodes if degrees[node] > 2}
    for edge in sorted(graph.edges, key=lambda edge: edge.length):
        if all(node in head for node in edge.ends):
            first, second = (head[node] for node in edge.ends)
            if first != second and _are_one(edge, (first, second), graph.nodes, distance):
                large = max(first, second, key=lambda node: graph.nodes[node].radius)
                for node in [node for node in head if head[node] in (first, second)]:
                    head[node] = large
    found = []
    for large in sorted(set(head.values())):
        group = [node for node in head if head[node] == large]
        at = np.mean([graph.nodes[node].at for node in group], axis=0)
        radius = graph.nodes[large].radius
        found.append((Node(at, radius), _branches(graph, set(group), radius)))
    return found


def _are_one(
    edge: Edge, heads: tuple[int, int], nodes: Mapping[int, Node], distance: Array
) -> bool:
    """Whether the junctions at the ends of an edge, merged into `heads`, are in one open space."""
    first, second = (nodes[node] for node in heads)
    rows, columns = np.rint(edge.cells).astype(int).T
    narrowest = distance[rows, columns].min()
    far = max(edge.length, math.dist(first.at, second.at))
    return bool(
        far <= max(first.radius, second.radius, ONE / CELL)
        and narrowest >= NARROW * min(nodes[node].radius for node in edge.ends)
    )


def _branches(graph: Graph, group: set[int], radius: float) -> list[Array]:
    """List the lines that lead away from a group of merged junctions.

    Lines within the group that are shorter than its diameter are left out.
    """
    found = []
    for edge in graph.edges:
        inside = [node in group for node in edge.ends]
        if not all(inside) or edge.length >= 2 * radius + 1 / CELL:
            found += [edge.cells] * inside[0] + [edge.cells[::-1]] * inside[1]
    return found


def bends(graph: Graph, distance: Array, out: float) -> Iterator[Fork]:
    """Yield the node of each bend of a skeleton and its two branches: (n, 2) rows and columns.

    `distance` is as in `junctions_merged`. The direction of a line before and after a cell is
    measured at points that lie `out` cells outside the disc of the cell. A line that ends
    nearer has no bend.
    """
    degrees = graph.degrees
    for edge in graph.edges:
        # A line begins where it leaves the disc of its junction. A dead end has no such disc.
        first, last = (graph.nodes[node].radius if degrees[node] > 1 else 0.0 for node in edge.ends)
        cells = edge.cells
        along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(cells, axis=0).T))])
        rows, columns = np.rint(cells).astype(int).T
        radii = distance[rows, columns]
        fits = np.minimum(along - first, along[-1] - last - along) >= radii + out
        if not fits.any():
            continue
        # The sharpest bend comes first.
        turns = np.where(fits, _turns(cells, along, radii, out), 0.0)
        while turns.max() >= TURN:
            k = int(turns.argmax())
            yield Node(cells[k], float(radii[k])), [cells[k::-1], cells[k:]]
            turns[np.abs(along - along[k]) < 2 * radii[k]] = 0.0


def _turns(cells: Array, along: Array, radii: Array, out: float) -> Array:
    """Compute by how many radians a line of cells, (n, 2), turns at each of them, (n,).

    `along` is the length up to each cell, and `radii` has the radius of the disc of each cell.
    Directions are measured `out` cells outside the disc.
    """

    def at(where: Array) -> Array:
        return np.stack([np.interp(where, along, cells[:, k]) for k in (0, 1)], axis=1)

    came, goes = cells - at(along - radii - out), at(along + radii + out) - cells
    cross = came[:, 0] * goes[:, 1] - came[:, 1] * goes[:, 0]
    return np.asarray(np.abs(np.arctan2(cross, (came * goes).sum(axis=1))))


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


# A junction or a bend of a skeleton with its branches: (n, 2) rows and columns each.
Fork = tuple[Node, list[Array]]


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
    found = ndimage.value_indices(ndimage.label(mask, EIGHT)[0], ignore_value=0)
    return [np.ravel_multi_index(at, mask.shape).tolist() for at in found.values()]


def _in_order(cells: Sequence[int], ends: Set[int], steps: Sequence[int]) -> list[int]:
    """The cells of a line from one end to the other.

    `steps` has the differences between the numbers of neighbouring cells, those to try first first.
    """
    left = set(cells)
    line = [next((cell for cell in cells if cell in ends), cells[0])]
    for cell in line:  # The line grows.
        left.discard(cell)
        for step in steps:
            if cell + step in left:
                line.append(cell + step)
                break
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
