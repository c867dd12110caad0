"""A robot that drives and turns (a unicycle), its odometer and laser, and the drive it records.

>>> from simulator.robot import Odometer
>>> exact = Odometer(along=0, across=0, heading=0, turning=0)
>>> exact.reading(np.array([[1.0, 2.0, 0.0], [3.0, 2.0, 0.5]]), np.random.default_rng(0)).tolist()
[[0.0, 0.0, 0.0], [2.0, 0.0, 0.5]]

Motions and odometry have errors. Those of an odometer are systematic, or random and growing with
the distance. The laser range finder has 180 beams, one for each degree of the half circle ahead.
The first beam is on the right, the last on the left.

While the robot drives, a Recorder records its pose after each motion. After the drive, all scans
are computed at once, and the odometry is computed from the poses.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import groupby
from operator import itemgetter
from typing import Any

import numpy as np

from simulator.errors import SimulatorError
from simulator.world import Array, World
from ssh_abduction.data.checks import a_number
from ssh_abduction.data.odometry import Displacement, Pose, displacement_between, moved

# Largest errors of the odometry that the robot drives by, as a share and in radians per metre. With
# larger ones, the robot does not notice that it left a place.
DRIVABLE = 0.5
# Settings of `simulate` for these errors.
OPTIONS = {"odometry": "odometry_noise", "scale": "scale_error", "bend": "bend_error"}
# Largest value of a field; a worse odometer would be useless.
WORST = 1.0
# Reported displacements are rounded to this many decimals, as in a log.
DIGITS = 5
BEAMS = 180
# Radians, counterclockwise from straight ahead.
BEARINGS: Array = np.radians(np.arange(BEAMS) - 89.5)
# Largest number of intersections of beams and walls that are computed at once: 32 MB. A single
# image may need more.
_BLOCK = 4_000_000
# Speed of driving in metres per second, and of turning in radians per second.
SPEED, SPIN = 0.5, 1.0
# Default and smallest distance between scans in metres.
EVERY, CLOSEST = 0.25, 0.01
# A motion is recorded in parts, so that scans are evenly spaced. There are about this many parts
# from one scan to the next.
FINE = 5
TINY = 1e-9


@dataclass(frozen=True)
class Body:
    """The size of a robot, and the errors of its motions and its odometry.

    Attributes:
        radius: Radius in metres. The robot collides with a wall that is nearer to its middle.
        slip: Standard deviation of the actual motion, as a share of the commanded motion.
        wander: Standard deviation of the heading, in radians for each metre of a motion.
        odometry: Standard deviation of the reported motion, as a share of the actual motion.
        scale: Share by which reported distances are too long, as with worn wheels.
        bend: Radians a metre by which the reported heading drifts to the left, as with wheels of
            unequal size.

    Raises:
        SimulatorError: An error of the odometry is no number, or too large to drive with.
    """

    radius: float = 0.2
    slip: float = 0.05
    wander: float = 0.02
    odometry: float = 0.02
    scale: float = 0.0
    bend: float = 0.0

    def __post_init__(self) -> None:
        for name, least in (("odometry", 0.0), ("scale", -DRIVABLE), ("bend", -DRIVABLE)):
            mend = f"choose a smaller error (--set {OPTIONS[name]})"
            if name == "bend":
                mend += f"; {DRIVABLE} radians per metre are {math.degrees(DRIVABLE):.1f} degrees"
            a_number(
                f"body.{name}", getattr(self, name), SimulatorError, least, DRIVABLE, mend=mend
            )


class SimulatedRobot:
    """A robot with its true pose, which only the simulator knows, and its odometry.

    `pose` is where it starts: x and y in metres, heading in radians. `rng` is the source of errors.
    """

    def __init__(self, body: Body, pose: Pose, rng: np.random.Generator) -> None:
        self.body = body  # errors of its motions and its odometry
        self.pose = pose  # the true one
        self.driven = 0.0  # metres driven, forward or back, by odometry
        self.odometry: Pose = (0.0, 0.0, 0.0)  # pose by odometry, which starts at (0, 0, 0)
        self._rng = rng
        self._reported = self.odometry  # The odometry at the last report.
        # Covariance of odometry since the last report, in the start frame.
        self._covariance = np.zeros((3, 3))

    def move(self, forward: float, turn: float) -> None:
        """Drive metres forward or back, and turn radians counterclockwise at once."""
        e = self._rng.normal(size=5)
        body = self.body
        forward_done = forward * (1 + body.slip * e[0])
        turn_done = turn * (1 + body.slip * e[1]) + body.wander * abs(forward) * e[2]
        self.pose = _moved(self.pose, forward_done, turn_done)
        forward_told = forward_done * (1 + body.scale) * (1 + body.odometry * e[3])
        turn_told = turn_done * (1 + body.odometry * e[4]) + body.bend * forward_done
        self._add_covariance(forward_told, turn_told)
        self.odometry = _moved(self.odometry, forward_told, turn_told)
        self.driven += abs(forward_told)

    def report(self) -> tuple[Displacement, Array]:
        """Return the motion by odometry since the last call, or since the start.

        It is relative to the pose at the last call, and comes with the covariance, (3, 3), of its
        noise, without systematic errors.
        """
        cos, sin = math.cos(self._reported[2]), math.sin(self._reported[2])
        into = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        displacement = displacement_between(self._reported, self.odometry)
        covariance = into @ self._covariance @ into.T
        self._reported, self._covariance = self.odometry, np.zeros((3, 3))
        return displacement, covariance

    def _add_covariance(self, forward: float, turn: float) -> None:
        """Add the covariance of a reported motion (metres, radians), to first order."""
        middle = self.odometry[2] + turn / 2
        cos, sin = math.cos(middle), math.sin(middle)
        by_pose = np.array([[1.0, 0.0, -forward * sin], [0.0, 1.0, forward * cos], [0.0, 0.0, 1.0]])
        by_motion = np.array([[cos, -forward * sin / 2], [sin, forward * cos / 2], [0.0, 1.0]]) * (
            self.body.odometry * np.array([forward, turn])
        )
        self._covariance = by_pose @ self._covariance @ by_pose.T + by_motion @ by_motion.T


def _moved(pose: Pose, forward: float, turn: float) -> Pose:
    """Move a pose forward by metres, while it turns by radians counterclockwise."""
    x, y, heading = pose
    middle, heading = heading + turn / 2, math.remainder(heading + turn, math.tau)
    return x + forward * math.cos(middle), y + forward * math.sin(middle), heading


@dataclass(frozen=True)
class Odometer:
    """Noise and systematic errors of an odometer.

    The errors of two motions are independent, so the standard deviation of the noise grows with the
    square root of the distance. The defaults are near the values of recorded logs (ACES,
    Belgioioso, CSAIL and Seattle), in which the motion between two scans was compared with the
    corrected poses:
    `along` 0.02 to 0.08, `across` 0.015 to 0.05, `heading` 0.008 to 0.07, `turning` 0.1.

    Attributes:
        along: Standard deviation along the motion after one metre, in metres.
        across: Standard deviation across the motion after one metre, in metres.
        heading: Standard deviation of the heading after one metre, in radians.
        turning: Standard deviation of the heading after a turn of one radian, in radians.
        scale: Share by which reported distances are too long, as with worn wheels.
        bend: Radians a metre by which the reported heading drifts to the left, as with wheels of
            unequal size.

    Raises:
        SimulatorError: A field is no number, or too large.
    """

    along: float = 0.05
    across: float = 0.02
    heading: float = 0.015
    turning: float = 0.05
    scale: float = 0.0
    bend: float = 0.0

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            least = -WORST if name in ("scale", "bend") else 0.0
            option = f" (--set {OPTIONS[name]})" if name in OPTIONS else ""
            mend = f"choose a smaller error{option}"
            a_number(f"odometer.{name}", value, SimulatorError, least, WORST, mend=mend)

    def as_noisy_as(self, along: float) -> Odometer:
        """Copy the odometer, with noise of the default proportions, scaled to a value of `along`.

        That is the standard deviation along the motion after one metre, in metres. Raises
        SimulatorError if it is not from 0 to 1.
        """
        mend = "with 1 the robot is a metre off after one metre"
        a_number("odometry_noise", along, SimulatorError, 0, WORST, mend=mend)
        usual = Odometer()
        share = along / usual.along
        scaled = {kind: getattr(usual, kind) * share for kind in ("across", "heading", "turning")}
        return replace(self, along=along, **scaled)

    def reading(self, poses: Array, rng: np.random.Generator) -> Array:
        """Compute what the odometer reads along true poses, (n, 3) in metres and radians.

        The readings, (n, 3), begin at (0, 0, 0).
        """
        ahead, left, turned = _motions(poses)
        way = np.hypot(ahead, left)
        noise = rng.normal(size=(4, len(way)))
        # Noise grows with the square root of the distance or turn.
        told_ahead = (1 + self.scale) * ahead + self.along * np.sqrt(way) * noise[0]
        told_left = (1 + self.scale) * left + self.across * np.sqrt(way) * noise[1]
        told_turn = (
            turned
            + self.bend * ahead
            + self.heading * np.sqrt(way) * noise[2]
            + self.turning * np.sqrt(np.abs(turned)) * noise[3]
        )
        heading = np.concatenate([[0.0], np.cumsum(told_turn)])
        cos, sin = np.cos(heading[:-1]), np.sin(heading[:-1])
        x = np.concatenate([[0.0], np.cumsum(cos * told_ahead - sin * told_left)])
        y = np.concatenate([[0.0], np.cumsum(sin * told_ahead + cos * told_left)])
        return np.column_stack([x, y, np.remainder(heading + np.pi, 2 * np.pi) - np.pi])

    def covariances(self, readings: Array) -> Array:
        """Estimate the covariances, (n, 3, 3), of readings, (n, 3), relative to the first one.

        The estimate is of first order. It does not include systematic errors, which a robot
        cannot know.
        """
        found = np.zeros((len(readings), 3, 3))
        for number, (start, ahead, left, turned) in enumerate(
            zip(readings, *_motions(readings), strict=False)
        ):
            way, cos, sin = np.hypot(ahead, left), np.cos(start[2]), np.sin(start[2])
            # Jacobians of the next pose by this pose and by the motion.
            by_pose = np.eye(3)
            by_pose[:2, 2] = -sin * ahead - cos * left, cos * ahead - sin * left
            by_motion = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
            heading = self.heading**2 * way + self.turning**2 * abs(turned)
            noise = np.diag([self.along**2 * way, self.across**2 * way, heading])
            found[number + 1] = (
                by_pose @ found[number] @ by_pose.T + by_motion @ noise @ by_motion.T
            )
        return found


def _motions(poses: Array) -> tuple[Array, Array, Array]:
    """The motion from each pose to the next: metres ahead and left, radians, (n - 1,)."""
    steps = np.diff(poses, axis=0)
    cos, sin = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    turned = np.remainder(steps[:, 2] + np.pi, 2 * np.pi) - np.pi
    return cos * steps[:, 0] + sin * steps[:, 1], cos * steps[:, 1] - sin * steps[:, 0], turned


@dataclass(frozen=True)
class Laser:
    """A laser range finder with the noise and range of a common scanner of the paper's time.

    Attributes:
        noise: Standard deviation of a range in metres.
        reach: Largest range in metres. A beam that meets nothing nearer reads this range.
        dropouts: Probability that a beam is lost and reads the largest range.
    """

    noise: float = 0.005
    reach: float = 8.0
    dropouts: float = 0.001

    def exact(self, world: World, poses: Array) -> Array:
        """Compute the ranges without noise, (m, 180) metres from right to left, at some poses.

        Poses are (m, 3) x and y in metres, heading in radians. One call for many poses is
        faster than many calls.
        """
        poses = np.atleast_2d(poses)
        rows = max(1, _BLOCK // (BEAMS * len(world.segments)))
        found = []
        for part in np.split(poses, range(rows, len(poses), rows)):
            near = _near(world.segments, part, self.reach)
            found.append(meetings(near, part, BEARINGS).min(axis=2, initial=self.reach))
        return np.vstack(found)

    def scan(self, world: World, poses: Array, rng: np.random.Generator) -> Array:
        """Compute the ranges with noise at some poses, as `exact`."""
        ranges = self.exact(world, poses)
        ranges = ranges + rng.normal(0, self.noise, ranges.shape) * (ranges < self.reach)
        ranges[rng.random(ranges.shape) < self.dropouts] = self.reach
        return np.clip(ranges, 0.01, self.reach)


def _near(segments: Array, poses: Array, reach: float) -> Array:
    """The walls whose bounding box is within `reach` of the bounding box of the poses."""
    low, high = poses[:, :2].min(0) - reach, poses[:, :2].max(0) + reach
    ends, others = segments[:, :2], segments[:, 2:]
    is_near = (np.minimum(ends, others) <= high) & (np.maximum(ends, others) >= low)
    return np.asarray(segments[is_near.all(1)])


def meetings(segments: Array, poses: Array, bearings: Array) -> Array:
    """Compute the distances in metres, (m, b, w), from poses to walls along rays.

    Walls are (w, 4) metres, poses (m, 3) x and y in metres and heading in radians, and bearings
    (b,) radians from the heading. A distance is infinite if the ray misses the wall.
    """
    angles = poses[:, 2, None] + bearings
    dx, dy = np.cos(angles)[:, :, None], np.sin(angles)[:, :, None]
    ax = segments[:, 0] - poses[:, 0, None]
    ay = segments[:, 1] - poses[:, 1, None]
    ex, ey = segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1]
    # The ray r (dx, dy) meets the wall a + s e, 0 <= s <= 1, where both are equal. Cross products
    # with e and with (dx, dy) give r and s.
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / (dx * ey - dy * ex)
        r = (ax * ey - ay * ex)[:, None, :] * inverse
        s = (ax[:, None, :] * dy - ay[:, None, :] * dx) * inverse
        hit = (r > 0) & (s >= 0) & (s <= 1)
    return np.where(hit, r, np.inf)


@dataclass(frozen=True, eq=False)
class RecordedDrive:
    """A completed drive of a simulated robot: its scans, its odometry and its true poses."""

    name: str  # name of the drive
    # (n, beams) metres; infinite if the laser saw nothing within its reach.
    ranges: Array = field(repr=False)
    # (n, 3) pose by the odometer at each scan: x and y in metres, heading in radians. It begins at
    # (0, 0, 0).
    odometry: Array = field(repr=False)
    poses: Array = field(repr=False)  # (n, 3) true pose at each scan
    times: Array = field(repr=False)  # (n,) seconds since the beginning
    metres: float  # length of the drive
    odometer: Odometer  # noise of the odometry
    laser: Laser  # the scanner that took the scans
    # True places and poses, as JSON-like data for evaluation only; empty until `judged` adds it.
    truth: Mapping[str, Any] = field(default_factory=dict, repr=False)

    def __len__(self) -> int:
        return len(self.ranges)

    def judged(
        self, places: Mapping[str, Sequence[float]], scans: Sequence[str | None], **more: object
    ) -> RecordedDrive:
        """Copy the drive, with the truth by which its maps are evaluated.

        `places` has (x, y) in metres of each place, by name, and `scans` the name of the
        place of each scan; None between places.
        """
        # Consecutive scans at a place form a visit.
        at = [(number, place) for number, place in enumerate(scans) if place is not None]
        stays = [(place, list(found)) for place, found in groupby(at, itemgetter(1))]
        visits = [
            {"place": place, "first": stay[0][0], "last": stay[-1][0]} for place, stay in stays
        ]
        truth = {
            "format": "ssh-drive",
            "version": 1,
            "name": self.name,
            "metres": round(self.metres, 2),
            "odometer": asdict(self.odometer),
            "places": {name: [round(x, 4), round(y, 4)] for name, (x, y) in places.items()},
            "visits": visits,
            **more,
            "scans": list(scans),
            "poses": self.poses.round(4).tolist(),
        }
        return replace(self, truth=truth)


@dataclass
class Recorder:
    """Records the pose of a robot after each motion, and when a scan is due."""

    every: float = EVERY  # metres between scans
    turn: float = math.radians(10)  # radians between scans if the robot turns
    # Pose after each motion, or after each part of a long motion.
    poses: list[Pose] = field(default_factory=list)
    # For each scan, the world (as the clutter is arranged then), and the index of its pose.
    scans: list[tuple[World, int]] = field(default_factory=list)
    metres: float = 0.0  # distance driven so far
    _seconds: list[float] = field(default_factory=list)  # Time of each pose.
    _way: float = 0.0  # Metres since the last scan.
    _turned: float = 0.0
    _world: World = field(init=False)  # The world of the last motion.

    def __post_init__(self) -> None:
        mend = f"a scan each {EVERY} m is usual"
        a_number("every", self.every, SimulatorError, CLOSEST, what="metres", mend=mend)

    @property
    def taken(self) -> int:
        """The number of scans so far."""
        return len(self.scans)

    def note(self, world: World, pose: Pose) -> None:
        """Record the pose after a motion in this world.

        A long motion is divided into parts, so that scans are also taken during the motion.
        """
        if not self.poses:
            self._add(world, pose, 0.0, 0.0)
            return
        start = self.poses[-1]
        dx, dy, turned = displacement_between(start, pose)
        way = math.hypot(dx, dy)
        parts = max(math.ceil(FINE * max(way / self.every, abs(turned) / self.turn)), 1)
        for part in range(1, parts):
            there = moved(start, (dx * part / parts, dy * part / parts, turned * part / parts))
            self._add(world, there, way / parts, abs(turned) / parts)
        self._add(world, pose, way / parts, abs(turned) / parts)

    def _add(self, world: World, pose: Pose, way: float, turned: float) -> None:
        """Record a pose after a motion of `way` metres and `turned` radians; scan if one is due."""
        self.metres += way
        before = self._seconds[-1] if self._seconds else 0.0
        self._seconds.append(before + way / SPEED + turned / SPIN)
        self._way, self._turned = self._way + way, self._turned + turned
        self.poses.append(pose)
        self._world = world
        is_due = self._way >= self.every - TINY or self._turned >= self.turn - TINY
        if is_due or len(self.poses) == 1:
            self.scans.append((world, len(self.poses) - 1))
            self._way = self._turned = 0.0

    def drive(self, name: str, laser: Laser, odometer: Odometer, seed: int) -> RecordedDrive:
        """Make the drive from the recorded poses. A last scan is taken at its end.

        Scans and odometry have random generators of their own, with this seed, so their
        noise does not change the trajectory.
        """
        if self.scans[-1][1] != len(self.poses) - 1:
            self.scans.append((self._world, len(self.poses) - 1))
        # Use generators 2 and 3 of this seed. The drive itself uses others.
        sight, wheels = (np.random.default_rng([seed, k]) for k in (2, 3))
        poses = np.array(self.poses)
        numbers = [number for _, number in self.scans]
        parts = groupby(self.scans, key=lambda scan: id(scan[0]))
        found = [
            (part[0][0], [number for _, number in part]) for part in (list(p) for _, p in parts)
        ]
        ranges = np.vstack([laser.scan(world, poses[part], sight) for world, part in found])
        return RecordedDrive(
            name=name,
            ranges=np.where(ranges < laser.reach, ranges, np.inf),
            odometry=odometer.reading(poses, wheels)[numbers],
            poses=poses[numbers],
            times=np.array(self._seconds)[numbers],
            metres=self.metres,
            odometer=odometer,
            laser=laser,
        )
