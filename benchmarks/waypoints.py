"""Maps of logs beside two graphs of the metric map: its skeleton, and a graph of waypoints.

    python benchmarks/waypoints.py LOG [LOG ...] --runs FOLDER

The script prints a table in Markdown. The two graphs are made from an occupancy grid of the scans
at their corrected poses, which the robot did not have. They cover the free space where the robot
fits, and are judged as the first map of `ssh-abduction map` is (`courses.py`). FOLDER has a folder
of results for each log, or gets it.

The graph of waypoints is of the kind that SWAGGER makes (https://github.com/nvidia-isaac/SWAGGER,
docs/algorithm.md), by the lengths of its default configuration. It has nodes along the skeleton,
along the walls, and in free space. Edges are those of a triangulation of the nodes that no wall
crosses.
"""

from __future__ import annotations

import argparse
import math
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
from courses import counted, counts_of, course_of
from logs import known_truth, mapped, name_of
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial import Delaunay, cKDTree
from skeleton import CELL, RADIUS, REACH, Array, Skeleton, _chains, _pixels, grid_of, skeleton_of
from skimage.measure import find_contours
from skimage.morphology import skeletonize

from perception.readers.logs import read_log
from perception.readers.scans import RobotLog
from ssh_abduction import SSHMap, Trace
from ssh_abduction.building.edges import grouped
from ssh_abduction.data.odometry import Pose

# Metres between nodes along the skeleton, along walls, and in free space.
ALONG, BESIDE, FREE = 1.5, 2.5, 1.5
# Nodes along walls are at this distance from them, in metres.
SHORE = 1.5 * RADIUS
# Nodes within this many metres are one. A piece with edges of a smaller total length is left out.
MERGED = 0.25
HEAD = (
    "| log | graph | nodes | pieces | passed | partings with a node | "
    "travel pairs: right of joined | found of true |",
    "|---|---|---|---|---|---|---|---|",
)


def waypoints_of(log: RobotLog, poses: list[Pose]) -> Skeleton:
    """Make the graph of waypoints of a log.

    Args:
        log: The log.
        poses: The pose of each scan.
    """
    grid = grid_of(log, poses)
    clear = distance_transform_edt(grid.cells == 1.0) * CELL
    free = clear >= RADIUS
    cells = _along_skeleton(free)
    for contour in find_contours(clear, SHORE):
        cells += [(round(r), round(c)) for r, c in _every(contour, BESIDE)]
    cells = _merged([cell for cell in dict.fromkeys(cells) if free[cell]])
    cells += _in_free_space(free, cells)
    graph = _triangulated(free, cells)
    for piece in list(nx.connected_components(graph)):
        if graph.subgraph(piece).size("metres") < MERGED:
            graph.remove_nodes_from(piece)
    for cell, data in graph.nodes(data=True):
        data["at"], data["clear"] = grid.points(np.array([cell]))[0], 0.0
    return Skeleton(grid, free, nx.convert_node_labels_to_integers(graph, ordering="sorted"))


def _along_skeleton(free: NDArray[np.bool_]) -> list[tuple[int, int]]:
    found = []
    for *_, data in _chains(_pixels(skeletonize(free))).edges(data=True):
        found += [data["cells"][round(k)] for k in _spaced(len(data["cells"]) - 1, ALONG)]
    return found


def _spaced(last: int, metres: float) -> Array:
    """Evenly spaced numbers from 0 to `last`, as many as cells fit into the metres."""
    return np.linspace(0, last, max(2, round(last * CELL / metres) + 1))


def _every(contour: Array, metres: float) -> Array:
    """The points of a contour at regular distances in metres."""
    far = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(contour, axis=0).T))]) * CELL
    return contour[np.searchsorted(far, np.arange(0, far[-1] + 1e-9, metres))]


def _merged(cells: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Drop each cell that is near an earlier one."""
    tree, kept = cKDTree(cells), np.ones(len(cells), bool)
    for i, j in sorted(tree.query_pairs(MERGED / CELL)):
        kept[j] &= not kept[i]
    return [cell for cell, keep in zip(cells, kept, strict=True) if keep]


def _in_free_space(free: NDArray[np.bool_], cells: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Add the free cell that is farthest from all nodes, until none is far."""
    empty = np.ones(free.shape, bool)
    empty[tuple(np.array(cells).T)] = False
    far = np.where(free, distance_transform_edt(empty) * CELL, 0.0)
    rows, columns = np.indices(free.shape)
    added = []
    while far.max() >= FREE:
        r, c = (int(k) for k in np.unravel_index(far.argmax(), far.shape))
        added.append((r, c))
        far = np.minimum(far, np.hypot(rows - r, columns - c) * CELL)
    return added


def _triangulated(free: NDArray[np.bool_], cells: list[tuple[int, int]]) -> nx.Graph:
    graph = nx.Graph()
    graph.add_nodes_from(cells)
    for corners in Delaunay(np.array(cells)).simplices:
        for i, j in combinations(corners.tolist(), 2):
            far = math.dist(cells[i], cells[j])
            line = np.linspace(cells[i], cells[j], math.ceil(2 * far) + 1).round().astype(int)
            if free[tuple(line.T)].all():
                graph.add_edge(cells[i], cells[j], metres=far * CELL)
    return graph


def row_of_graph(log: Path, name: str, skeleton: Skeleton, poses: Array) -> str:
    """Make the row of a graph of the metric map.

    Args:
        log: The log.
        name: The name of the graph.
        skeleton: The graph.
        poses: (n, 3) corrected pose of each scan.
    """
    graph = skeleton.graph
    scans, nodes = zip(*skeleton.events(poses.tolist()), strict=True)
    middles = np.array([graph.nodes[node]["at"] for node in nodes])
    radii = [max(REACH, graph.nodes[node]["clear"]) for node in nodes]
    courses = [
        course_of(poses[begin : end + 1, :2], middles[k : k + 2], radii[k : k + 2])
        for k, (begin, end) in enumerate(pairwise(scans))
    ]
    edges = grouped(zip(nodes, nodes[1:], courses, strict=False))
    counts = counted(poses, middles, scans, radii, nodes, edges)
    return _line(
        log, name, len(graph), nx.number_connected_components(graph), len(set(nodes)), counts
    )


def row_of_map(log: Path, trace: Trace, ssh_map: SSHMap, poses: Array) -> str:
    """Make the row of a map."""
    links = nx.Graph()
    places = [ssh_map.dstates[label].place for label in ssh_map.dstate_at]
    links.add_nodes_from(places)
    links.add_edges_from(pairwise(places))
    number = len(links)
    counts = counts_of(trace, ssh_map, poses)
    return _line(
        log, "ssh-abduction", number, nx.number_connected_components(links), number, counts
    )


def _line(
    log: Path, name: str, nodes: int, pieces: int, passed: int, counts: dict[str, Any]
) -> str:
    travels, parted = counts["travel_pairs"], counts["partings"]
    cells = [
        name_of(log),
        name,
        nodes,
        pieces,
        passed,
        f"{parted['noticed']} of {parted['all']}",
        f"{travels['right']} of {travels['joined']}",
        f"{travels['right']} of {travels['true']}",
    ]
    return f"| {' | '.join(map(str, cells))} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG")
    parser.add_argument("--runs", type=Path, required=True, metavar="FOLDER")
    options = parser.parse_args()
    print(*HEAD, sep="\n", flush=True)
    for path in options.logs:
        truth = known_truth(path)
        if truth is None:
            raise SystemExit(f"{path}: expected corrected poses or a truth, got none")
        log, poses = read_log(str(path)), [(x, y, a) for x, y, a in truth.poses.tolist()]
        trace, ssh_map = mapped(path, options.runs)
        if ssh_map is not None:
            print(row_of_map(path, trace, ssh_map, truth.poses), flush=True)
        for name, made in (
            ("skeleton", skeleton_of(log, poses)),
            ("skeleton with doors", skeleton_of(log, poses, doors=True)),
            ("waypoints", waypoints_of(log, poses)),
        ):
            print(row_of_graph(path, name, made, truth.poses), flush=True)


if __name__ == "__main__":
    main()
