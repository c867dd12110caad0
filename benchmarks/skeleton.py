"""The usual topological map of a metric one: the pruned skeleton of the free space, as a graph.

    python benchmarks/skeleton.py LOG [LOG ...] -o FOLDER [--poses corrected|odometry] [--doors]

The script draws for each log the occupancy grid, the graph and the way of the robot. All scans are
drawn into the grid at the corrected poses, which the robot did not have, or at the poses of the
odometry.

The skeleton of the cells where a robot fits (Zhang & Suen 1984, scikit-image) has branches to every
niche. As is usual, a branch is cut off if it ends inside or near the circle around its junction
that touches the nearest wall (Thrun 1998, "Learning metric-topological maps"; Shaked & Bruckstein
1998, "Pruning medial axes"). Junctions in one open space, which are nearer to each other than to
the walls, are one node. Nodes are junctions and dead ends, and with --doors also doors. All lengths
are in metres, and the settings are the same for all logs.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_opening, distance_transform_edt, label

from perception.readers.scans import RobotLog
from ssh_abduction.data.odometry import Pose, moved

Array = NDArray[np.float64]
CELL = 0.1  # side of a cell
FARTHEST = 12.0  # Ignore beams beyond this, as they are so far apart that they skip cells.
WALL = 0.2  # A cell is a wall if at least this share of its beams end there.
LEAST = 2  # A free cell was passed by at least this many beams.
RADIUS = 0.25  # Radius of the robot.
SPECK = 0.3  # Smaller obstacles, and smaller holes in the seen space, are noise; square metres.
SPUR = 1.0  # Keep a dead end that is this much longer than its junction's distance from the walls.
# A door is a narrowest point within 2 m along the way, with walls nearer than DOOR on both sides.
# Within 2 m in both directions the walls are at least WIDER times as far away.
DOOR = 0.75
WIDER = 1.4
REACH = 1.5  # The robot passes a node within this, or within the node's distance from the walls.


@dataclass(frozen=True, eq=False)
class Grid:
    """An occupancy grid.

    Attributes:
        cells: (rows, columns), 1 if free, 0 for a wall, NaN if not seen. Row 0 has the least y.
        origin: x and y of the lower left corner in metres.
    """

    cells: Array
    origin: tuple[float, float]

    def at(self, points: Array) -> NDArray[np.int_]:
        """Return the row and column of each point, (n, 2), from x and y, (n, 2) in metres."""
        return np.floor((points[:, ::-1] - self.origin[::-1]) / CELL).astype(int)

    def points(self, cells: NDArray[Any]) -> Array:
        """Return the middle x and y of each cell, (n, 2) in metres, from row and column, (n, 2)."""
        return (np.asarray(cells, dtype=float)[:, ::-1] + 0.5) * CELL + self.origin


def poses_of(log: RobotLog, kind: str) -> list[Pose]:
    """Return the poses of all scans.

    Args:
        log: The log.
        kind: "corrected" or "odometry".

    Raises:
        ValueError: A scan has no corrected pose.
    """
    if kind == "odometry":
        return [scan.odometry for scan in log.scans]
    poses = [scan.corrected for scan in log.scans if scan.corrected is not None]
    if len(poses) < len(log):
        raise ValueError(
            f"{log.source}: expected corrected poses, got {len(poses)} for {len(log)} scans; "
            "take --poses odometry"
        )
    return poses


def grid_of(log: RobotLog, poses: Sequence[Pose]) -> Grid:
    """Make the occupancy grid of all scans, with a pose for each."""
    along = np.arange(0, FARTHEST, CELL / 2)
    low = np.floor((np.min([pose[:2] for pose in poses], axis=0) - FARTHEST) / CELL).astype(int) - 2
    columns, rows = (
        np.ceil((np.max([pose[:2] for pose in poses], axis=0) + FARTHEST) / CELL).astype(int)
        + 2
        - low
    )
    wall, clear = np.zeros(rows * columns), np.zeros(rows * columns)

    def number(points: Array) -> NDArray[np.int_]:
        column, row = (np.floor(points / CELL).astype(int) - low).T
        return np.asarray(row * columns + column)

    for scan, pose in zip(log.scans, poses, strict=True):
        x, y, heading = moved(pose, scan.laser.mount)
        measured = np.isfinite(scan.ranges)
        bearings, ranges = heading + scan.laser.bearings[measured], scan.ranges[measured]
        rays = np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
        near = (ranges <= FARTHEST) & (ranges < scan.laser.reach)
        np.add.at(wall, number((x, y) + ranges[near, None] * rays[near]), 1)
        before = along[None, :] < np.minimum(ranges, FARTHEST)[:, None] - CELL
        points = (x, y) + along[None, :, None] * rays[:, None, :]
        clear[np.unique(number(points[before]))] += 1  # a scan counts once for each free cell
    cells = np.full(rows * columns, np.nan)
    cells[clear >= LEAST] = 1.0
    cells[wall > WALL / (1 - WALL) * clear] = 0.0
    cells = cells.reshape(rows, columns)
    used = [np.flatnonzero(~np.isnan(cells).all(axis=axis)) for axis in (1, 0)]
    (bottom, top), (left, right) = ((found[0] - 1, found[-1] + 2) for found in used)
    return Grid(
        cells[bottom:top, left:right], (float(low[0] + left) * CELL, float(low[1] + bottom) * CELL)
    )


def free_space(grid: Grid, poses: Sequence[Pose]) -> tuple[NDArray[np.bool_], Array]:
    """Find the cells where the robot fits, in the part of the grid that it drove through.

    Args:
        grid: The grid.
        poses: Poses of the robot.

    Returns:
        (rows, columns) mask of these cells; and (rows, columns) distance in metres from each cell
        to the nearest cell that was not seen to be free, ignoring specks.
    """
    seen = _without_specks(~_without_specks(grid.cells != 1.0))
    clear = distance_transform_edt(seen) * CELL
    parts, _ = label(binary_opening(clear >= RADIUS))
    rows, columns = grid.at(np.array(poses)[:, :2]).T
    at = np.bincount(parts[rows, columns], minlength=2)
    at[0] = 0  # the robot may have stood in cells that are drawn as a wall
    return np.asarray(parts == at.argmax()), clear


def _without_specks(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Copy a mask without its connected parts that are smaller than SPECK."""
    parts, _ = label(mask)
    large = np.bincount(parts.ravel()) * CELL**2 >= SPECK
    large[0] = False
    return np.asarray(large[parts])


@dataclass(frozen=True, eq=False)
class Skeleton:
    """A graph in metric space.

    Attributes:
        grid: The occupancy grid.
        free: (rows, columns) mask of the cells where the robot fits.
        graph: A node has `at`, its (x, y), and `clear`, its distance from the walls in metres. An
            edge has `way`, its points, (n, 2), and `metres`, its length.
    """

    grid: Grid
    free: NDArray[np.bool_]
    graph: nx.MultiGraph

    def events(self, poses: Sequence[Pose]) -> list[tuple[int, int]]:
        """List the nodes that the robot passed, in order.

        If several nodes are within reach, the robot passes the nearest one.

        Args:
            poses: Pose of each scan.

        Returns:
            For each pass, the index of the scan nearest to the node, and the node.
        """
        nodes = sorted(self.graph)
        at = np.array([self.graph.nodes[n]["at"] for n in nodes])
        reach = np.maximum(REACH, [self.graph.nodes[n]["clear"] for n in nodes])
        distance = np.linalg.norm(np.array(poses)[:, None, :2] - at, axis=2)
        nearest = distance.argmin(axis=1)
        within = distance.min(axis=1) <= reach[nearest]
        passed: list[tuple[int, int]] = []
        last = -1  # the latest scan within reach of the last node
        for scan in np.flatnonzero(within):
            number = int(nearest[scan])
            if (
                passed
                and passed[-1][1] == number
                and distance[last : scan + 1, number].max() <= 2 * reach[number]
            ):
                if distance[scan, number] < distance[passed[-1][0], number]:
                    passed[-1] = (int(scan), number)
            else:
                passed.append((int(scan), number))
            last = int(scan)
        return [(scan, nodes[number]) for scan, number in passed]


def skeleton_of(log: RobotLog, poses: Sequence[Pose], *, doors: bool = False) -> Skeleton:
    """Make the pruned skeleton of the free space of a log.

    Args:
        log: The log.
        poses: Pose of each scan.
        doors: Whether to add nodes at doors.
    """
    from skimage.morphology import skeletonize

    grid = grid_of(log, poses)
    free, clear = free_space(grid, poses)
    graph = _chains(_pixels(skeletonize(free)))
    for node, data in graph.nodes(data=True):
        data["clear"] = float(clear[node])
    _prune(graph)
    graph = _merged(graph)
    if doors:
        graph = _with_doors(graph, clear)
    for _, data in graph.nodes(data=True):
        data["at"] = grid.points(np.array([data["cell"]]))[0]
    for *_, data in graph.edges(data=True):
        data["way"] = grid.points(np.array(data["cells"]))
    return Skeleton(grid, free, nx.convert_node_labels_to_integers(graph, ordering="sorted"))


def _pixels(thin: NDArray[np.bool_]) -> nx.Graph:
    """The graph of the cells of a skeleton. Cells that touch are joined.

    Two cells that touch at a corner are not joined if both touch a third cell along a side.
    """
    graph = nx.Graph()
    cells = {(int(r), int(c)) for r, c in np.argwhere(thin)}
    graph.add_nodes_from(cells)
    for r, c in cells:
        graph.add_edges_from(
            ((r, c), other) for other in ((r + 1, c), (r, c + 1)) if other in cells
        )
    for r, c in cells:
        for side in (-1, 1):
            if (
                (r + 1, c + side) in cells
                and (r + 1, c) not in cells
                and (r, c + side) not in cells
            ):
                graph.add_edge((r, c), (r + 1, c + side))
    return graph


def _chains(pixels: nx.Graph) -> nx.MultiGraph:
    """The graph of junctions and dead ends. An edge is a chain of cells between two of them.

    A ring without a junction gets a node at one of its cells.
    """
    ends = [cell for cell, degree in pixels.degree if degree != 2]
    ends += [
        min(ring)
        for ring in nx.connected_components(pixels)
        if all(pixels.degree(cell) == 2 for cell in ring)
    ]
    graph = nx.MultiGraph()
    graph.add_nodes_from(ends)
    known = set(ends)
    for end in ends:
        for first in pixels[end]:
            way = [end, first]
            while way[-1] not in known:
                way.append(next(cell for cell in pixels[way[-1]] if cell != way[-2]))
            if (way[0], way[1]) <= (way[-1], way[-2]):  # keep one of the two directions
                _join(graph, way)
    return graph


def _join(graph: nx.MultiGraph, cells: Sequence[tuple[int, int]]) -> None:
    graph.add_edge(
        cells[0],
        cells[-1],
        cells=list(cells),
        metres=CELL * sum(math.dist(a, b) for a, b in pairwise(cells)),
    )


def _prune(graph: nx.MultiGraph) -> None:
    """Cut off branches that hardly leave the circle of their junction, the shortest first.

    The circle touches the nearest wall. If a node is no longer a junction, its two edges are
    joined.
    """
    while True:
        branches = []
        for end in graph:
            if graph.degree(end) == 1:
                ((_, junction, data),) = graph.edges(end, data=True)
                beyond = data["metres"] - graph.nodes[junction]["clear"]
                if graph.degree(junction) > 2 and beyond < SPUR:
                    branches.append((beyond, end, junction))
        if not branches:
            return
        _, end, junction = min(branches)
        graph.remove_node(end)
        _straighten(graph, junction)


def _straighten(graph: nx.MultiGraph, node: Any) -> None:
    """Remove a node at which exactly two different edges end, and join these edges."""
    if graph.degree(node) == 2 and graph.number_of_edges(node, node) == 0:
        (_, _, one), (_, _, other) = graph.edges(node, data=True)
        to = one["cells"] if one["cells"][-1] == node else one["cells"][::-1]
        onward = other["cells"] if other["cells"][0] == node else other["cells"][::-1]
        graph.remove_node(node)
        _join(graph, [*to, *onward[1:]])


def _merged(graph: nx.MultiGraph) -> nx.MultiGraph:
    """Merge junctions that are joined by an edge within the circle of one of them.

    The circle of a junction touches the nearest wall. A merged node is at the junction farthest
    from the walls.
    """
    near = nx.Graph()
    near.add_nodes_from(graph)
    for a, b, data in graph.edges(data=True):
        if (
            a != b
            and graph.degree(a) > 2
            and graph.degree(b) > 2
            and data["metres"] <= max(graph.nodes[a]["clear"], graph.nodes[b]["clear"])
        ):
            near.add_edge(a, b)
    home = {}
    for group in nx.connected_components(near):
        middle = max(group, key=lambda n: (graph.nodes[n]["clear"], n))
        home.update(dict.fromkeys(group, middle))
    merged = nx.MultiGraph()
    for node, middle in home.items():
        if node == middle:
            merged.add_node(node, cell=node, clear=graph.nodes[node]["clear"])
    for a, b, data in graph.edges(data=True):
        if home[a] != home[b] or not near.has_edge(a, b):
            cells = data["cells"] if data["cells"][0] == a else data["cells"][::-1]
            _join(merged, [home[a], *cells, home[b]])
    return merged


def _with_doors(graph: nx.MultiGraph, clear: Array) -> nx.MultiGraph:
    """Add a node at each door, which is a narrowest point along an edge.

    Critical points of Voronoi graphs are defined in the same way.
    """
    within = round(2.0 / CELL)
    opened = nx.MultiGraph()
    opened.add_nodes_from(graph.nodes(data=True))
    for *_, data in graph.edges(data=True):
        cells = data["cells"]
        width = np.array([clear[cell] for cell in cells])
        cut = [0]
        for k in range(1, len(cells) - 1):
            before, after = width[max(0, k - within) : k], width[k + 1 : k + 1 + within]
            narrow = (
                width[k] <= DOOR and width[k] < before.min() + CELL / 10 and width[k] <= after.min()
            )
            if (
                narrow
                and width[k] * WIDER <= min(before.max(), after.max())
                and (k - cut[-1] > within / 2 or cut[-1] == 0)
            ):
                cut.append(k)
                opened.add_node(cells[k], cell=cells[k], clear=float(width[k]), door=True)
        for start, end in pairwise([*cut, len(cells) - 1]):
            _join(opened, cells[start : end + 1])
    return opened


def lay(axes: Any, skeleton: Skeleton, poses: Sequence[Pose]) -> None:
    """Draw grid, way of the robot and graph into axes. Nodes that the robot passed are filled."""
    grid = skeleton.grid
    rows, columns = grid.cells.shape
    shown = np.where(
        np.isnan(grid.cells),
        0.8,
        np.where(skeleton.free, 1.0, np.where(grid.cells == 1.0, 0.94, 0.0)),
    )
    x, y = grid.origin
    axes.imshow(
        shown,
        cmap="gray",
        vmin=0,
        vmax=1,
        origin="lower",
        extent=(x, x + columns * CELL, y, y + rows * CELL),
    )
    axes.plot(*np.array(poses)[:, :2].T, color="0.45", linewidth=0.8)
    for *_, data in skeleton.graph.edges(data=True):
        axes.plot(*data["way"].T, color="tab:blue", linewidth=1)
    passed = {node for _, node in skeleton.events(poses)}
    for node, data in skeleton.graph.nodes(data=True):
        axes.plot(
            *data["at"],
            "s",
            color="tab:blue",
            markerfacecolor="tab:blue" if node in passed else "white",
            markersize=4,
        )
    axes.set_aspect("equal")


def draw(path: Path, skeleton: Skeleton, poses: Sequence[Pose], title: str) -> None:
    """Draw the grid, the way of the robot, and the graph with numbered nodes into a file."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    rows, columns = skeleton.grid.cells.shape
    figure, axes = plt.subplots(figsize=(14, 14 * max(0.4, min(1.4, rows / columns))))
    lay(axes, skeleton, poses)
    for node, data in skeleton.graph.nodes(data=True):
        axes.annotate(str(node), data["at"], fontsize=7, xytext=(3, 3), textcoords="offset points")
    axes.set_title(title)
    figure.savefig(path, dpi=80, bbox_inches="tight")
    plt.close(figure)


def main() -> None:
    from perception.readers.logs import read_log

    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("logs", nargs="+", metavar="LOG")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--poses", choices=("corrected", "odometry"), default="corrected")
    parser.add_argument("--doors", action="store_true", help="add nodes at doors")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    for name in options.logs:
        log = read_log(name)
        poses = poses_of(log, options.poses)
        skeleton = skeleton_of(log, poses, doors=options.doors)
        events = skeleton.events(poses)
        stem, passed = Path(name).name.partition(".")[0], len({node for _, node in events})
        nodes = len(skeleton.graph)
        text = f"{stem}: {nodes} nodes, {passed} of them passed, {len(events)} times"
        draw(options.output / f"{stem}.png", skeleton, poses, text)
        print(text)


if __name__ == "__main__":
    main()
