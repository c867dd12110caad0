"""A pose graph of g2o or TORO: vertices with corrected poses, and edges with relative motions.

>>> from perception.readers.graphs import Graph
>>> graph = Graph()
>>> graph.vertices += [(0, (0.0, 0.0, 0.0)), (1, (1.1, 0.0, 0.0)), (2, (2.2, 0.0, 0.0))]
>>> graph.edges |= {(0, 1): (1.0, 0.0, 0.0), (1, 2): (1.0, 0.0, 0.0), (0, 2): (2.2, 0.0, 0.0)}
>>> graph.chain.poses
((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (2.0, 0.0, 0.0))
>>> graph.index_at((2.2, 0.0, 0.0))
2
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.odometry import Pose, between, moved

# Equal poses differ by at most this, in metres and radians, since numbers in a log are rounded.
ROUNDED = 2e-3
# Between two vertices that follow each other in the file, at most this many may be missing because
# their lines are damaged.
MOST_BETWEEN = 100


@dataclass(frozen=True)
class Chain:
    """Poses by odometry at the vertices, computed by adding up the motions along the edges.

    Attributes:
        poses: Pose at each vertex, in the order of the file. The first is (0, 0, 0).
        gaps: Numbers of the vertices to which no edge leads from the vertex before. There, the
            robot is taken to have stood still.
    """

    poses: tuple[Pose, ...]
    gaps: tuple[int, ...]


@dataclass
class Graph:
    """A pose graph: vertices with poses, and edges with motions.

    Add all vertices and edges before using the methods, which cache their results.

    Attributes:
        vertices: Number and pose of each vertex, in the order of the file.
        edges: Dict from the numbers of two vertices to the motion from the first to the second.
    """

    vertices: list[tuple[int, Pose]] = field(default_factory=list)
    edges: dict[tuple[int, int], Pose] = field(default_factory=dict)

    @cached_property
    def chain(self) -> Chain:
        """Pose by odometry at each vertex, computed by adding up the motions along the edges."""
        poses: list[Pose] = [(0.0, 0.0, 0.0)]
        gaps: list[int] = []
        for (start, _), (end, _) in zip(self.vertices, self.vertices[1:], strict=False):
            motion = self._motion(start, end)
            if motion is None:
                gaps.append(end)
            poses.append(moved(poses[-1], motion or (0.0, 0.0, 0.0)))
        return Chain(tuple(poses), tuple(gaps))

    def _motion(self, start: int, end: int) -> Pose | None:
        """Find the motion from one vertex to another; None if it is unknown.

        It is that of the edge between the two. If there is none, the motions along the vertices
        whose numbers lie between theirs are added up.
        """
        if (motion := self.edges.get((start, end))) is not None:
            return motion
        if (back := self.edges.get((end, start))) is not None:
            return between(back, (0.0, 0.0, 0.0))
        if not start < end <= start + MOST_BETWEEN:
            return None
        motion = (0.0, 0.0, 0.0)
        for vertex in range(start, end):
            if (step := self.edges.get((vertex, vertex + 1))) is None:
                return None
            motion = moved(motion, step)
        return motion

    def is_corrected(self, farthest: float) -> bool:
        """Check whether the poses of vertices were corrected.

        Args:
            farthest: Poses were corrected if one is farther than this from its pose by odometry, in
                metres.
        """
        first = self.vertices[0][1]
        return any(
            math.dist(between(first, pose)[:2], odometry[:2]) > farthest
            for (_, pose), odometry in zip(self.vertices, self.chain.poses, strict=True)
        )

    def index_at(self, pose: Pose, guess: int | None = None) -> int | None:
        """Find the index in `vertices` of a vertex with this pose; None if there is none.

        Args:
            pose: The pose, up to rounding.
            guess: Index of a vertex to try first.
        """
        if guess is not None and same_pose(self.vertices[guess][1], pose):
            return guess
        near: list[int] = self._tree.query_ball_point(pose[:2], 2 * ROUNDED)
        return next((i for i in sorted(near) if same_pose(self.vertices[i][1], pose)), None)

    def share_at_vertices(self, poses: Sequence[float]) -> float:
        """Compute the share of poses that equal the pose of a vertex, up to rounding.

        Args:
            poses: Flat list of poses: x, y, heading, x, …

        Returns:
            A number from 0 to 1.
        """
        table: NDArray[np.float64] = np.reshape(poses, (-1, 3))
        last = len(self.vertices) - 1
        at = sum(
            self.index_at((x, y, heading), min(i, last)) is not None
            for i, (x, y, heading) in enumerate(table.tolist())
        )
        return at / max(1, len(table))

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(np.array([pose[:2] for _, pose in self.vertices]))


def same_pose(a: Pose, b: Pose) -> bool:
    return all(abs(v) <= ROUNDED for v in between(a, b))
