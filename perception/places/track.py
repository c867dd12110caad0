"""The trajectory of a robot, and the frames of poses on it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.odometry import Pose

Array = NDArray[np.float64]

# Standard deviations of the errors of a typical odometer from one scan to the next. The error along
# the motion is WAY times its length plus OFFSET metres. The error across has half of that share.
# The error of the heading, in radians, is TURNING times the turn, DRIFT for each metre, and ANGLE.
WAY, OFFSET = 0.1, 0.03
TURNING, DRIFT, ANGLE = 0.1, 0.02, 0.02

# Scans at poses that differ by less than STEP metres and TURN radians show nearly the same.
STEP, TURN = 0.2, math.radians(10)


@dataclass(frozen=True, eq=False)
class Track:
    """The trajectory of the robot, by odometry and scan matching."""

    poses: Array  # (n, 3) x, y in metres and heading in radians, in the frame of the first scan
    # (n, 3, 3) covariance of the motion from the previous scan to each scan, in the frame of the
    # robot at the previous scan, by scan matching; zeros for the first scan.
    covariances: Array
    # (n,) share of the points of each scan that lie on known walls; 1 for the first scan, NaN for a
    # later scan whose beams meet nothing. Empty if nothing was matched.
    shares: Array = field(default_factory=lambda: np.ones(0))
    # Indices of scans before which the motion is unknown because the odometer jumped. No
    # displacement crosses a cut.
    cuts: tuple[int, ...] = ()
    # The scans in `cuts` after which the robot may be anywhere, because the scan shows nothing that
    # was seen before. Neither a path nor a place crosses a break.
    breaks: tuple[int, ...] = ()
    factor: float = 1.0  # number by which the covariances have to be multiplied
    # Whether scans match, and agree with the odometry, as in good logs. True if nothing was judged.
    is_reliable: bool = True

    def pose(self, scan: int) -> Pose:
        """The pose of the robot at a scan: x, y in metres and heading in radians."""
        x, y, heading = self.poses[scan].tolist()
        return x, y, heading

    @cached_property
    def way(self) -> Array:
        """The distance travelled up to each scan: (n,), metres."""
        return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(self.poses[:, :2], axis=0).T))])

    @property
    def corrected(self) -> Array:
        """The corrected covariances of the motions to each scan: (n, 3, 3)."""
        return self.covariances * self.factor

    @cached_property
    def spreads(self) -> Array:
        """The sum of the corrected covariances of all increments up to each scan: (n, 3, 3).

        The covariance of each increment is first expressed as an error at the origin of the frame.
        """
        x, y, _ = self.poses[1:].T
        heading = self.poses[:-1, 2]
        cos, sin = np.cos(heading), np.sin(heading)
        arms = np.zeros((len(x), 3, 3))
        arms[:, 0] = np.stack([cos, -sin, y], axis=1)
        arms[:, 1] = np.stack([sin, cos, -x], axis=1)
        arms[:, 2, 2] = 1.0
        steps = arms @ self.corrected[1:] @ arms.transpose(0, 2, 1)
        return np.concatenate([np.zeros((1, 3, 3)), np.cumsum(steps, axis=0)])

    def cuts_between(self, first: int, last: int) -> list[int]:
        """List the cuts after scan `first` and up to scan `last`."""
        return [cut for cut in self.cuts if first < cut <= last]


def is_near(motion: Pose | Array) -> bool:
    """Whether scans before and after a motion, in metres and radians, show nearly the same."""
    return bool(math.hypot(motion[0], motion[1]) < STEP and abs(motion[2]) < TURN)


def wrapped(angle: float) -> float:
    """Convert an angle in radians to the equal angle in [-pi, pi)."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def rotation(angle: float) -> Array:
    """The matrix, (2, 2), of a rotation counterclockwise by an angle in radians."""
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin], [sin, cos]])


def pose_rotation(angle: float) -> Array:
    """The matrix, (3, 3), that rotates x and y counterclockwise by an angle in radians."""
    turned = np.eye(3)
    turned[:2, :2] = rotation(angle)
    return turned


def covariance_turned(angle: float, covariance: Array) -> Array:
    """Rotate the covariance, (3, 3), of x, y and a heading counterclockwise by an angle."""
    turned = pose_rotation(angle)
    return np.asarray(turned @ covariance @ turned.T)


def points_turned(angle: float, points: Array) -> Array:
    """Rotate points or directions, (n, 2), counterclockwise by an angle in radians."""
    return np.asarray(points @ rotation(angle).T)


def points_moved(pose: Pose | Array, points: Array) -> Array:
    """Transform points, (n, 2), from the frame of a pose to the frame that the pose is given in."""
    return np.asarray(points_turned(pose[2], points) + np.asarray(pose[:2]))


def odometer_covariance(onward: Pose) -> Array:
    """Compute the covariance, (3, 3), of a motion in metres and radians, for a typical odometer."""
    way = math.hypot(onward[0], onward[1])
    along, across = OFFSET + WAY * way, OFFSET + WAY * way / 2
    heading = ANGLE + TURNING * abs(onward[2]) + DRIFT * way
    return np.diag([along**2, across**2, heading**2])


def seen_from(first: Array, last: Array) -> Array:
    """Compute the poses `last` in the frames of the poses `first`.

    All poses are (..., 3): x, y in metres and rotation of the axes in radians.
    """
    cos, sin = np.cos(first[..., 2]), np.sin(first[..., 2])
    x, y, turned = np.moveaxis(last - first, -1, 0)
    return np.stack([cos * x + sin * y, cos * y - sin * x, turned], axis=-1)


def errors_of(poses: Array, matches: Array) -> Array:
    """Subtract poses, (..., 3): metres and radians. Headings differ by at most half a turn."""
    off = poses - matches
    off[..., 2] = (off[..., 2] + math.pi) % math.tau - math.pi
    return off


def at_end(end: Array, covariance: Array) -> Array:
    """Compute the covariance, (3, 3), of the end of an arm from that of its beginning.

    The rotation at the beginning moves the end, which is at (x, y) metres from there.
    """
    arm = np.array([[1.0, 0.0, -end[1]], [0.0, 1.0, end[0]], [0.0, 0.0, 1.0]])
    return np.asarray(arm @ covariance @ arm.T)
