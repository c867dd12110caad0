"""Finds the points of a scan that lie on walls, and the pose at which they lie on known walls.

Points are matched with lines (Chen & Medioni 1992; Censi 2008).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from perception.places.track import Array, points_moved, points_turned, wrapped
from perception.readers.scans import Scan

# Longer beams are not matched, in metres, since neighbouring beams are too far apart to show a
# wall.
FARTHEST = 25.0
# Standard deviation in metres of the distance from a point to its wall: noise of the laser and
# unevenness of walls.
ROUGHNESS = 0.05
# Errors of neighbouring points are correlated: this many points count as one independent point.
TOGETHER = 3
# Largest distance in metres from a point to a wall: BEGIN in the first round, then SHRINK times as
# large in each round, but at least END. ROUNDS is the largest number of rounds.
BEGIN, END, SHRINK, ROUNDS = 1.0, 0.25, 0.75, 12
# Walls more than MARGIN metres outside of the box around the points of a scan are far away. A match
# needs them only if it moves a point by more than MOVED metres.
MARGIN, MOVED = 3.0, 2.0


def surfaces(scan: Scan) -> tuple[Array, Array]:
    """Find points on smooth surfaces, (m, 2) metres, and unit normals, in the robot's frame."""
    laser, ranges, good = scan.laser, scan.ranges, in_sight(scan)
    r = np.where(good, ranges, 0.0)
    points = np.stack([r * np.cos(laser.bearings), r * np.sin(laser.bearings)], axis=1)
    normals = np.full(points.shape, np.nan)
    # The farthest neighbours that still lie on one line with the point give the best normal.
    for k in (1, 2, 3):
        if len(points) <= 2 * k:
            break
        middle = slice(k, len(points) - k)
        line = points[2 * k :] - points[: -2 * k]
        length = np.hypot(*line.T)
        normal = np.stack([-line[:, 1], line[:, 0]], axis=1) / np.maximum(length, 1e-9)[:, None]
        off = np.abs(products(points[middle] - points[: -2 * k], normal))
        smooth = (
            good[2 * k :]
            & good[: -2 * k]
            & good[middle]
            & (length > 1e-6)
            & (length < 0.25 + 0.1 * r[middle])
            & (off < ROUGHNESS)
        )
        normals[middle][smooth] = normal[smooth]
    on_surface = good & np.isfinite(normals[:, 0])
    return points_moved(laser.mount, points[on_surface]), points_turned(
        laser.mount[2], normals[on_surface]
    )


def in_sight(scan: Scan) -> NDArray[np.bool_]:
    """Mask of the beams that meet something near enough to be matched, (beams,)."""
    return np.asarray(np.isfinite(scan.ranges) & (scan.ranges < min(FARTHEST, scan.laser.reach)))


def products(first: Array, second: Array) -> Array:
    """The scalar products of vectors, (n, 2) each: (n,). A sum over an axis is slower."""
    return np.asarray(first[:, 0] * second[:, 0] + first[:, 1] * second[:, 1])


@dataclass(frozen=True, eq=False)
class ScanFit:
    """Moves a scan until its points lie on walls.

    Points are in the frame of the robot, walls in the frame of the track.
    """

    points: Array
    normals: Array
    walls: Array
    wall_normals: Array

    @cached_property
    def tree(self) -> cKDTree:
        """The walls. These settings build the tree faster, and queries take no longer."""
        return cKDTree(self.walls, compact_nodes=False, balanced_tree=False)

    def near(self, pose: Array) -> ScanFit:
        """Leave out the walls that are far from the points at a pose. The tree is built faster."""
        (left, low), (right, high) = (
            edge(points_moved(pose, self.points), axis=0) for edge in (np.min, np.max)
        )
        x, y = self.walls.T
        inside = (x > left - MARGIN) & (x < right + MARGIN)
        inside &= (y > low - MARGIN) & (y < high + MARGIN)
        kept = np.flatnonzero(inside)
        walls, normals = (part.take(kept, axis=0) for part in (self.walls, self.wall_normals))
        return replace(self, walls=walls, wall_normals=normals)

    def improved(self, guess: Array, weight: Array) -> tuple[float, Array, Array]:
        """Move a pose until the points lie on the walls, by Gauss-Newton steps.

        `weight` is the (3, 3) inverse covariance of the guess. Returns the share of the points on
        walls, the pose, and its inverse covariance.
        """
        information, pose, share = weight, guess, 0.0
        for count in range(ROUNDS):
            placed = points_moved(pose, self.points)
            distance, nearest = self.tree.query(
                placed, distance_upper_bound=max(END, BEGIN * SHRINK**count)
            )
            met = np.flatnonzero(np.isfinite(distance))
            alike = products(
                points_turned(pose[2], self.normals[met]), self.wall_normals[nearest[met]]
            )
            met = met[np.abs(alike) > 0.8]
            share = float((distance[met] < END).sum() / len(placed))
            if len(met) < 5:
                break
            normal = self.wall_normals[nearest[met]]
            off = products(placed[met] - self.walls[nearest[met]], normal)
            arm = placed[met] - pose[:2]
            jacobian = np.column_stack(
                [normal, arm[:, 0] * normal[:, 1] - arm[:, 1] * normal[:, 0]]
            )
            # Cauchy weights give little influence to points that are far off.
            weights = 1 / (TOGETHER * ROUGHNESS**2 * (1 + (off / (2 * ROUGHNESS)) ** 2))
            astray = pose - guess
            astray[2] = wrapped(astray[2])
            information = jacobian.T @ (jacobian * weights[:, None]) + weight
            step = np.linalg.solve(information, jacobian.T @ (weights * off) + weight @ astray)
            pose = pose - step
            if np.abs(step).max() < 1e-4:
                break
        return share, pose, information
