"""Find where a displacement leads in a map whose dstates have poses.

A dstate (distinctive state) is a place and the direction that the robot faces there. A displacement
is (dx, dy, dtheta), in metres and radians, in the frame of the robot before it moved. The robot is
not exactly at the pose of a dstate, so displacements from the dstate are as uncertain as this.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from ssh_abduction.data.groups import gathered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.odometry import Covariance, Displacement, Odometry, moved

Array: TypeAlias = NDArray[np.float64]

# Dstates at more than FAR standard deviations from the end of a displacement have the density 0.
FAR = 5.0
# Pieces and floors have no relative pose. They are put this many metres apart.
APART = 1e7
# Dstates that the robot left with a smaller probability are not followed.
LEAST = 1e-9
# The margin of a map around its dstates, in metres.
MARGIN = 1.0


@dataclass(frozen=True, eq=False)
class Motion:
    """A displacement with its error."""

    displacement: Displacement  # (dx, dy, dtheta), in metres and radians
    noise: Array  # its covariance, (3, 3)

    @classmethod
    def of(cls, displacement: Displacement, covariance: Covariance, odometry: Odometry) -> Motion:
        """Make a motion, with the systematic errors of the odometry added to its covariance."""
        dx, dy, _ = displacement
        way = math.hypot(dx, dy)
        long = odometry.scale * np.array([dx, dy, 0.0])
        # A steady drift turns the robot by half of its sum when it is in the middle of the way.
        drift = odometry.bend * way * np.array([-dy / 2, dx / 2, 1.0])
        noise = np.array(covariance) + np.outer(long, long) + np.outer(drift, drift)
        return cls(displacement, noise)

    def then(self, other: Motion) -> Motion:
        """Return this motion followed by another one."""
        turned = _turned(self.displacement[2])
        noise = _carried(self.noise, turned @ other.displacement)
        end = moved(self.displacement, other.displacement)
        return Motion(end, noise + turned @ other.noise @ turned.T)

    def error(self, odometry: Odometry) -> Array:
        """The covariance of the end relative to a dstate, (3, 3), if the start is at a dstate.

        The robot is off its dstate at both ends. The pose of the map has an error like the motion.
        """
        off = np.diag([odometry.offset**2, odometry.offset**2, odometry.facing**2])
        return 2 * self.noise + off + _carried(off, np.array(self.displacement))


@dataclass(frozen=True, eq=False, slots=True)
class Away:
    """The robot left a dstate some steps ago, and was at no dstate of the map since."""

    probabilities: Array  # the probability of this for each dstate that it left, (N,)
    motion: Motion  # the motion since then

    @property
    def total(self) -> float:
        """The probability of all dstates that the robot may have left."""
        return float(self.probabilities.sum())

    def after(self, motion: Motion, probability: float) -> Away:
        """Return this part after another motion, if it goes on with this probability."""
        return Away(probability * self.probabilities, self.motion.then(motion))


class DeadReckoning:
    """Where displacements lead in a map of N dstates with poses, (N, 3).

    `frame` has the number of the frame of each dstate, (N,). Pieces and floors have frames of their
    own. `odometry` says how far off a dstate the robot is at each visit.
    """

    def __init__(self, poses: Array, frame: NDArray[np.intp], odometry: Odometry) -> None:
        self._poses, self._odometry = poses, odometry
        self._spots = np.column_stack([poses[:, :2], APART * frame])
        self._tree = cKDTree(self._spots)
        sizes = np.ones(len(poses))
        for number in set(frame.tolist()):
            width, length = np.ptp(poses[frame == number, :2], axis=0) + 2 * MARGIN
            sizes[frame == number] = width * length
        self._uniform = 1 / (sizes * math.tau)

    @classmethod
    def of(cls, ssh_map: SSHMap, odometry: Odometry) -> DeadReckoning | None:
        """Return the poses of a map; None if it has none."""
        if ssh_map.fit is None or len(ssh_map.fit.poses) != len(ssh_map.dstates):
            return None
        frame = np.zeros(len(ssh_map.dstates), np.intp)
        for number, piece in enumerate(ssh_map.pieces):
            frame[list(piece)] = number
        found = gathered(((frame[s.id], s.floor), s.id) for s in ssh_map.dstates)
        for number, some in enumerate(found.values()):
            frame[some] = number
        poses = np.array([(pose.x, pose.y, pose.heading) for pose in ssh_map.fit.poses])
        return cls(poses, frame, odometry)

    def along(self, links: sparse.csr_array, motion: Motion) -> sparse.csr_array:
        """Compute p(x'|x,a) p(d|x,a,x') / q(d) for the links of an action a and a motion d, (N, N).

        q is the density at an unknown place: as from one of the links, or as broad as all of them
        together. Each of these cases is equally likely. `links` is p(x'|x,a), (N, N): row x' is the
        end, column x the start.
        """
        targets, starts = links.nonzero()
        ways = self._ways(starts, targets)
        error = motion.error(self._odometry)
        near = _gaussian(_off(ways, motion), error)
        # Turn the ways about their mean heading, so that their headings have a variance.
        mean = math.atan2(np.sin(ways[:, 2]).mean(), np.cos(ways[:, 2]).mean())
        centre = (*ways[:, :2].mean(axis=0), mean)
        off = _off(ways, Motion(centre, error))
        broad = np.diag((off**2).mean(axis=0)) + error
        off = _off(np.array([motion.displacement]), Motion(centre, error))
        usual = near.sum() + _gaussian(off, broad)[0]
        weighed = links[targets, starts] * near * ((len(near) + 1) / usual)
        return sparse.csr_array((weighed, (targets, starts)), shape=links.shape)

    def arrivals(self, away: Away, unmapped: float) -> tuple[Array, Away]:
        """Compute where a robot may be that went away from a dstate by no link of the map.

        `unmapped` is the prior probability that the end is at no dstate of the map. Return the
        probability of each dstate, (N,), and the part for which it is at none.
        """
        starts = np.flatnonzero(away.probabilities > LEAST)
        p, motion = away.probabilities[starts], away.motion
        error = motion.error(self._odometry)
        ends = self._moved(starts, motion)
        radius = FAR * math.sqrt(np.linalg.eigvalsh(error[:2, :2])[-1])
        near = self._tree.query_ball_point(ends, radius)
        which = np.repeat(np.arange(len(near)), [len(some) for some in near])
        targets = np.array([target for some in near for target in some], np.intp)
        prior = (1 - unmapped) / len(self._poses)
        known = prior * _gaussian(_off(self._ways(starts[which], targets), motion), error)
        none = unmapped * self._uniform[starts]
        total = np.bincount(which, known, len(starts)) + none
        share = np.divide(p, total, out=np.zeros_like(p), where=total > 0)
        stays = away.probabilities.copy()
        stays[starts] = np.where(total > 0, none * share, p)
        arrived = np.bincount(targets, known * share[which], len(self._poses))
        return np.asarray(arrived, np.float64), Away(stays, motion)

    def _moved(self, starts: NDArray[np.intp], motion: Motion) -> Array:
        """Where a motion leads from some dstates, as points of the tree, (n, 3)."""
        cos, sin = np.cos(self._poses[starts, 2]), np.sin(self._poses[starts, 2])
        dx, dy, _ = motion.displacement
        moves = np.column_stack([cos * dx - sin * dy, sin * dx + cos * dy, np.zeros(len(starts))])
        return np.asarray(self._spots[starts] + moves)

    def _ways(self, starts: NDArray[np.intp], targets: NDArray[np.intp]) -> Array:
        """The displacements between n pairs of dstates, in the frame of the first one, (n, 3)."""
        x, y, turned = (self._poses[targets] - self._poses[starts]).T
        cos, sin = np.cos(self._poses[starts, 2]), np.sin(self._poses[starts, 2])
        return np.column_stack([cos * x + sin * y, cos * y - sin * x, turned])


def _turned(angle: float) -> Array:
    """Return the matrix that turns a displacement, (3, 3)."""
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _carried(covariance: Array, arm: Array) -> Array:
    """Return the covariance of a pose after the robot moved by `arm`, in the same frame, (3, 3)."""
    lever = np.array([[1.0, 0.0, -arm[1]], [0.0, 1.0, arm[0]], [0.0, 0.0, 1.0]])
    return np.asarray(lever @ covariance @ lever.T)


def _off(ways: Array, motion: Motion) -> Array:
    """Subtract a motion from n displacements, (n, 3)."""
    off = ways - np.array(motion.displacement)
    off[:, 2] = (off[:, 2] + math.pi) % math.tau - math.pi
    return np.asarray(off, np.float64)


def _gaussian(off: Array, covariance: Array) -> Array:
    """Compute the densities of n errors, (n, 3), by a normal distribution."""
    squares = np.einsum("ni,ij,nj->n", off, np.linalg.inv(covariance), off)
    scale = math.sqrt(np.linalg.det(math.tau * covariance))
    return np.asarray(np.exp(-squares / 2) / scale)
