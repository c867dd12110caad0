"""Finds the points of a scan that lie on walls, and the pose at which they lie on known walls.

Points are matched with lines (Chen & Medioni 1992; Censi 2008).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from perception.places.track import Array, points_moved, points_turned, wrapped
from perception.readers.scans import Scan
from ssh_abduction.data.odometry import Pose

# Longer beams are not matched, in metres, since neighbouring beams are too far apart to show a
# wall.
FARTHEST = 25.0
# Standard deviation in metres of the distance from a point to its wall: noise of the laser and
# unevenness of walls.
ROUGHNESS = 0.05
# Fewer points of a scan do not show whether the robot is where it seems to be.
FEW_POINTS = 20
# Errors of neighbouring points are correlated: this many points count as one independent point.
TOGETHER = 3
# Largest distance in metres from a point to a wall: BEGIN in the first round, then SHRINK times as
# large in each round, but at least END. ROUNDS is the largest number of rounds.
BEGIN, END, SHRINK, ROUNDS = 1.0, 0.25, 0.75, 12


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Points on smooth surfaces."""

    points: Array  # (m, 2) metres
    normals: Array  # (m, 2) unit normals

    def __len__(self) -> int:
        """The number of points."""
        return len(self.points)

    def moved(self, pose: Pose | Array) -> Surfaces:
        """Transform to the frame that a pose is given in, from the frame of the pose."""
        return Surfaces(points_moved(pose, self.points), points_turned(pose[2], self.normals))

    def some(self, most: int) -> Surfaces:
        """Take at most this many points, evenly spread."""
        kept = np.unique(np.linspace(0, len(self) - 1, min(len(self), most)).astype(int))
        return Surfaces(self.points[kept], self.normals[kept])

    @staticmethod
    def joined(several: Iterable[Surfaces]) -> Surfaces:
        """Make one of several."""
        parts = [(one.points, one.normals) for one in several]
        points, normals = map(np.concatenate, zip(*parts, strict=True))
        return Surfaces(points, normals)


def surfaces_in(scan: Scan) -> Surfaces:
    """Find the smooth surfaces that a scan shows, in the frame of the robot."""
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
    return Surfaces(points[on_surface], normals[on_surface]).moved(laser.mount)


def in_sight(scan: Scan) -> NDArray[np.bool_]:
    """Mask of the beams that meet something near enough to be matched, (beams,)."""
    return np.asarray(np.isfinite(scan.ranges) & (scan.ranges < min(FARTHEST, scan.laser.reach)))


def products(first: Array, second: Array) -> Array:
    """The scalar products of vectors, (n, 2) each: (n,). A sum over an axis is slower."""
    return np.asarray(first[:, 0] * second[:, 0] + first[:, 1] * second[:, 1])


@dataclass(frozen=True, eq=False)
class ScanFit:
    """Moves a scan until its points lie on walls.

    The scan is in the frame of the robot, and the walls are in the frame of the track.
    """

    scan: Surfaces
    walls: Surfaces

    @cached_property
    def tree(self) -> cKDTree:
        """The walls. These settings build the tree faster, and queries take no longer."""
        return cKDTree(self.walls.points, compact_nodes=False, balanced_tree=False)

    def improved(self, guess: Array, weight: Array) -> tuple[float, Array, Array]:
        """Move a pose until the points lie on the walls, by Gauss-Newton steps.

        `weight` is the (3, 3) inverse covariance of the guess. Returns the share of the points on
        walls, the pose, and its inverse covariance.
        """
        information, pose, share = weight, guess, 0.0
        for count in range(ROUNDS):
            placed = points_moved(pose, self.scan.points)
            distance, nearest = self.tree.query(
                placed, distance_upper_bound=max(END, BEGIN * SHRINK**count)
            )
            met = np.flatnonzero(np.isfinite(distance))
            facing = points_turned(pose[2], self.scan.normals[met])
            alike = products(facing, self.walls.normals[nearest[met]])
            met = met[np.abs(alike) > 0.8]
            share = float((distance[met] < END).sum() / len(placed))
            if len(met) < 5:
                break
            normal = self.walls.normals[nearest[met]]
            off = products(placed[met] - self.walls.points[nearest[met]], normal)
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
