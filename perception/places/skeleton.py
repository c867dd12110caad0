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

References:
    Thrun 1998, "Learning metric-topological maps for indoor mobile robot navigation".
    Shaked & Bruckstein 1998, "Pruning medial axes".
    Beeson, Jong & Kuipers 2005, "Towards autonomous topological place detection using the extended
    Voronoi graph".
    Beeson, Modayil & Kuipers 2010, "Factoring the mapping problem".
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from perception.places.local_map import CELL, EIGHT, Bools, Patch
from perception.places.thinning import Edge, Graph, Node, graph_of, thinned
from perception.places.track import Array

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

# A junction or a bend of a skeleton with its branches: (n, 2) rows and columns each.
Fork = tuple[Node, list[Array]]

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
    distance = ndimage.distance_transform_edt(np.pad(mask, 1))[1:-1, 1:-1] + room / CELL
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
    parts, count = ndimage.label(distance > far, EIGHT)
    is_open = np.zeros(count + 1, np.bool_)
    is_open[parts[distance >= WIDE * far]] = True
    return np.asarray(is_open[parts])


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
    trail = ndimage.binary_dilation(patch.trail, EIGHT)
    fits = trail | patch.free
    if patch.occupied.any():
        distance = ndimage.distance_transform_edt(~patch.occupied) * CELL
        fits = trail | (patch.free & (distance >= room))
    fits = ndimage.binary_opening(fits, EIGHT) | trail
    parts, count = ndimage.label(fits, EIGHT)
    is_reached = np.zeros(count + 1, np.bool_)
    is_reached[parts[trail]] = True
    reached = is_reached[parts]
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
        yield from _bends_of(edge, first, last, distance, out)


def _bends_of(edge: Edge, first: float, last: float, distance: Array, out: float) -> Iterator[Fork]:
    """Find the bends of one line outside the discs of its ends, the sharpest first."""
    cells = edge.cells
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(cells, axis=0).T))])
    rows, columns = np.rint(cells).astype(int).T
    radii = distance[rows, columns]
    fits = np.minimum(along - first, along[-1] - last - along) >= radii + out
    if not fits.any():
        return
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
