"""A drive as a robot logs it: scans and odometry, and the true poses for evaluation.

While the robot drives, a Recorder records its pose after each motion. After the drive, all scans
are computed at once, and the odometry is computed from the poses.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from simulator.errors import SimulatorError
from simulator.laser import Laser
from simulator.robot import Odometer
from simulator.world import Array, World
from ssh_abduction.data.checks import a_number
from ssh_abduction.data.odometry import Pose, displacement_between, moved

# Speed of driving in metres per second, and of turning in radians per second.
SPEED, SPIN = 0.5, 1.0
# Default and smallest distance between scans in metres.
EVERY, CLOSEST = 0.25, 0.01
# A motion is recorded in parts, so that scans are evenly spaced. There are about this many parts
# from one scan to the next.
FINE = 5
TINY = 1e-9


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
        visits: list[dict[str, Any]] = []
        # Consecutive scans at a place form a visit.
        for number, place in enumerate(scans):
            if place is not None:
                if not visits or visits[-1]["place"] != place:
                    visits.append({"place": place, "first": number, "last": number})
                visits[-1]["last"] = number
        truth = {
            "format": "ssh-drive",
            "version": 1,
            "name": self.name,
            "metres": round(self.metres, 2),
            "odometer": self.odometer.parameters(),
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
    # For each world (each arrangement of the clutter), the indices of poses at which a scan is
    # taken.
    scans: list[tuple[World, list[int]]] = field(default_factory=list)
    metres: float = 0.0  # distance driven so far
    _seconds: list[float] = field(default_factory=list)  # Time of each pose.
    _way: float = 0.0  # Metres since the last scan.
    _turned: float = 0.0

    def __post_init__(self) -> None:
        mend = f"a scan each {EVERY} m is usual"
        a_number("every", self.every, SimulatorError, CLOSEST, what="metres", mend=mend)

    @property
    def taken(self) -> int:
        """The number of scans so far."""
        return sum(len(numbers) for _, numbers in self.scans)

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
        if not self.scans or self.scans[-1][0] is not world:
            self.scans.append((world, []))
        is_due = self._way >= self.every - TINY or self._turned >= self.turn - TINY
        if is_due or len(self.poses) == 1:
            self.scans[-1][1].append(len(self.poses) - 1)
            self._way = self._turned = 0.0

    def drive(self, name: str, laser: Laser, odometer: Odometer, seed: int) -> RecordedDrive:
        """Make the drive from the recorded poses. A last scan is taken at its end.

        Scans and odometry have random generators of their own, with this seed, so their
        noise does not change the trajectory.
        """
        if self.scans[-1][1][-1:] != [len(self.poses) - 1]:
            self.scans[-1][1].append(len(self.poses) - 1)
        # Use generators 2 and 3 of this seed. The drive itself uses others.
        sight, wheels = (np.random.default_rng([seed, k]) for k in (2, 3))
        poses = np.array(self.poses)
        numbers = [number for _, part in self.scans for number in part]
        ranges = np.vstack(
            [laser.scan(world, poses[part], sight) for world, part in self.scans if part]
        )
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
