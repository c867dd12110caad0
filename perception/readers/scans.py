"""The content of a robot's log in any format: laser scans with the pose of the odometer.

>>> import math
>>> from perception.readers.scans import LaserScanner
>>> laser = LaserScanner(first=-math.pi / 2, step=math.pi / 2, beams=3, reach=8.0)
>>> [round(math.degrees(bearing)) for bearing in laser.bearings]
[-90, 0, 90]

Angles are radians counterclockwise and lengths metres. A pose is (x, y, heading). In the frame of
the robot, x is ahead and y to the left.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.odometry import Pose
from ssh_abduction.data.words import counted


@dataclass(frozen=True)
class LaserScanner:
    """A laser scanner.

    Attributes:
        first: Bearing of the first beam, in radians counterclockwise from straight ahead.
        step: Angle from each beam to the next, in radians.
        beams: Number of beams of a scan.
        reach: A range of at least this many metres means that nothing came back.
        mount: Pose of the scanner in the frame of the robot.
        nearest: A range of at most this many metres is too short to be a measurement.
    """

    first: float
    step: float
    beams: int
    reach: float
    mount: Pose = (0.0, 0.0, 0.0)
    nearest: float = 0.0

    @property
    def steps(self) -> int:
        """The number of angular steps in the field of view.

        If the number of beams is even, the field of view is taken to end one step after the last
        beam. This holds for a SICK and for scanners of a full circle.
        """
        return max(1, self.beams - self.beams % 2)

    @cached_property
    def bearings(self) -> NDArray[np.float64]:
        """The bearing of each beam in the frame of the scanner: (beams,), radians."""
        return self.first + self.step * np.arange(self.beams, dtype=np.float64)


# All scans of a log share the few lasers that it has.
laser_of = lru_cache(maxsize=64)(LaserScanner)


@lru_cache(maxsize=64)
def shared(laser: LaserScanner) -> LaserScanner:
    """Return the object that stands for all equal lasers. Its bearings are computed once."""
    return laser


@dataclass(frozen=True, eq=False, slots=True)
class Scan:
    """One scan, with the pose of the robot.

    Attributes:
        ranges: (beams,) metres. Infinite if nothing came back from within the reach; NaN if the
            range is no measurement.
        laser: The scanner that measured the ranges.
        odometry: Pose by the odometer, which starts anywhere and drifts. Only its increments
            matter.
        corrected: Pose by a later correction, or the true one; None if unknown. It is for pictures
            and evaluation, and no inference reads it.
        time: Seconds by the clock of the log; None if missing. The clock may be rounded, or start
            again.
        line: Line of the scan in the log, or number of its message in a bag, from 1.
    """

    ranges: NDArray[np.float64]
    laser: LaserScanner
    odometry: Pose
    corrected: Pose | None = None
    time: float | None = None
    line: int = 0


@dataclass(frozen=True)
class Damage:
    """A part of a log that cannot be read and was skipped.

    Attributes:
        line: Line in the log, or number of the message in a bag, from 1.
        what: Text that says what was expected there, and what was found.
    """

    line: int
    what: str


@dataclass(frozen=True, eq=False)
class RobotLog:
    """The content of a log.

    Attributes:
        scans: Scans in the order of the file.
        damaged: Skipped parts in the order of the file.
        format: Name of the format.
        source: Path of the file or folder.
        notes: Sentences about the log that a user should know, for example that its odometry was
            reconstructed.
        sources: Sentences that say which parts of a bag the scans and poses come from.
    """

    scans: Sequence[Scan]
    damaged: tuple[Damage, ...] = ()
    format: str = ""
    source: str = ""
    notes: tuple[str, ...] = ()
    sources: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.scans)

    @cached_property
    def odometry(self) -> NDArray[np.float64]:
        """The poses by the odometer: (n, 3), metres and radians."""
        numbers = chain.from_iterable(scan.odometry for scan in self.scans)
        return np.fromiter(numbers, np.float64).reshape(-1, 3)

    @property
    def warnings(self) -> tuple[str, ...]:
        """The notes and, if parts were skipped, a sentence on them."""
        if not self.damaged:
            return self.notes
        first, were = self.damaged[0], "was" if len(self.damaged) == 1 else "were"
        skipped = (
            f"{counted(len(self.damaged), 'damaged parts')} of the log {were} skipped; the "
            f"first is {first.line}: {first.what}; mend them, or go on without them"
        )
        return (*self.notes, skipped)


@dataclass(frozen=True, eq=False)
class SurveyedLog:
    """A log that was surveyed. Its scans can be read once."""

    format: str  # name of the format
    notes: tuple[str, ...]  # sentences about the log that a user should know
    # Iterator over scans, with ranges as the driver wrote them, and skipped parts, in the order of
    # the file.
    items: Iterator[Scan | Damage]
    # Notes on what the reader assumed. The key of a note is the field of
    # `perception.readers.echoes.LaserOptions` by which a user can say otherwise.
    assumed: Mapping[str, str] = field(default_factory=dict)
    sources: tuple[str, ...] = ()  # as in `RobotLog`
