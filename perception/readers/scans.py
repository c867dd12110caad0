"""The content of a robot's log in any format: laser scans with the pose of the odometer.

>>> import math
>>> from perception.readers.scans import Laser
>>> laser = Laser(first=-math.pi / 2, step=math.pi / 2, beams=3, reach=8.0)
>>> [round(math.degrees(bearing)) for bearing in laser.bearings]
[-90, 0, 90]

Angles are radians counterclockwise and lengths metres. A pose is (x, y, heading). In the frame of
the robot, x is ahead and y to the left.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.odometry import Pose
from ssh_abduction.data.words import counted

__all__ = ["Damage", "Laser", "Pose", "Reading", "RobotLog", "Scan"]


@dataclass(frozen=True)
class Laser:
    """A laser scanner.

    Attributes:
        first: Bearing of the first beam, in radians counterclockwise from straight ahead.
        step: Angle from each beam to the next, in radians.
        beams: Number of beams of a scan.
        reach: Metres from which a range only means that nothing is nearer.
        mount: Pose of the scanner in the frame of the robot.
        nearest: Metres up to which a range is no measurement.
    """

    first: float
    step: float
    beams: int
    reach: float
    mount: Pose = (0.0, 0.0, 0.0)
    nearest: float = 0.0

    @property
    def steps(self) -> int:
        """Number of steps between beams in the field of view.

        If the number of beams is even, the last beam is missing, as for a SICK and for scanners of
        a full circle.
        """
        return max(1, self.beams - self.beams % 2)

    @cached_property
    def bearings(self) -> NDArray[np.float64]:
        """(beams,) bearing of each beam in the frame of the scanner, in radians."""
        return self.first + self.step * np.arange(self.beams, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Scan:
    """One scan, with the pose of the robot.

    Attributes:
        ranges: (beams,) metres. Infinite if nothing came back from within the reach; NaN if the
            range is no measurement.
        laser: The scanner.
        odometry: Pose by the odometer, which starts anywhere and drifts. Only its increments
            matter.
        corrected: Pose by later correction, for pictures and evaluation. No inference reads it.
        time: Seconds by the clock of the log, which may be cut, wrapped or missing.
        line: Line of the scan in the log, or number of its message, from 1.
    """

    ranges: NDArray[np.float64]
    laser: Laser
    odometry: Pose
    corrected: Pose | None = None
    time: float | None = None
    line: int = 0


@dataclass(frozen=True)
class Damage:
    """A part of a log that cannot be read and was skipped.

    Attributes:
        line: Its line, or the number of its message, from 1.
        what: What was expected there, and what came.
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
        source: The file.
        notes: Sentences about the log that a user should know, such as that its odometry was
            reconstructed.
    """

    scans: tuple[Scan, ...]
    damaged: tuple[Damage, ...] = ()
    format: str = ""
    source: str = ""
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.scans)

    @property
    def warnings(self) -> tuple[str, ...]:
        """The notes, and a sentence on the skipped parts."""
        if not self.damaged:
            return self.notes
        first, were = self.damaged[0], "was" if len(self.damaged) == 1 else "were"
        return (
            *self.notes,
            (
                f"{counted(len(self.damaged), 'damaged parts')} of the log {were} skipped; the "
                f"first is {first.line}: {first.what}"
            ),
        )


@dataclass(frozen=True, eq=False)
class Reading:
    """A log whose format and meaning are known; its scans can be read once.

    Attributes:
        format: Name of the format.
        notes: Sentences about the log.
        items: Scans with ranges as the driver wrote them, and skipped parts, in the order of the
            file.
        assumed: Notes on what the reader assumed, by the field of `perception.readers.echoes.Told`
            that replaces it.
    """

    format: str
    notes: tuple[str, ...]
    items: Iterator[Scan | Damage]
    assumed: Mapping[str, str] = field(default_factory=dict)
