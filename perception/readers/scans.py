"""What a robot's log holds, whatever its format: laser scans in the order in which they were taken, and where the odometer was at each.

>>> import math
>>> from perception.readers.scans import Laser
>>> laser = Laser(first=-math.pi / 2, step=math.pi / 2, beams=3, reach=8.0)
>>> [round(math.degrees(bearing)) for bearing in laser.bearings]
[-90, 0, 90]

Angles are radians counterclockwise, lengths metres; a pose is (x, y, heading). In the frame of the robot x is ahead and y to its left.
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
    """A laser scanner: where its beams go.

    first, step  bearing of the first beam, and from each beam to the next, in radians counterclockwise from straight ahead
    beams        how many beams a scan has
    reach        metres beyond which a range says only that nothing was nearer
    mount        the pose of the scanner in the frame of the robot
    nearest      metres up to which a range is no measurement
    """

    first: float
    step: float
    beams: int
    reach: float
    mount: Pose = (0.0, 0.0, 0.0)
    nearest: float = 0.0

    @property
    def steps(self) -> int:
        """How many steps from beam to beam the field of view has.

        A laser whose beams are even in number is taken to leave out the last one, as a SICK does and as scanners all around do.
        """
        return max(1, self.beams - self.beams % 2)

    @cached_property
    def bearings(self) -> NDArray[np.float64]:
        """The bearing of each beam in the frame of the scanner, (beams,), radians."""
        return self.first + self.step * np.arange(self.beams, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Scan:
    """One scan, and where the robot was when it was taken.

    ranges     (beams,), metres; infinite where nothing came back, or only from beyond the laser's reach; NaN where a range is no measurement
    odometry   pose by the odometer, which starts anywhere and drifts; only its increments mean anything
    corrected  pose by whoever corrected the log, for pictures and evaluation only: nothing that infers reads it
    time       seconds, by the clock of the log, which may be cut, wrapped or missing
    line       where the scan is in the log: its line, or the number of its message, counted from 1
    """

    ranges: NDArray[np.float64]
    laser: Laser
    odometry: Pose
    corrected: Pose | None = None
    time: float | None = None
    line: int = 0


@dataclass(frozen=True)
class Damage:
    """A part of a log that cannot be read, and was skipped.

    line  its line, or the number of its message, counted from 1
    what  what was expected there, and what came
    """

    line: int
    what: str


@dataclass(frozen=True, eq=False)
class RobotLog:
    """All that was read of a log.

    scans    in the order of the file
    damaged  what was skipped, in the order of the file
    format   the name of the format, as the readers call it
    source   the file
    notes    what a reader has to know of this log, in sentences, such as that its odometry was pieced together
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
        """The notes, and a sentence on the parts that were skipped."""
        if not self.damaged:
            return self.notes
        first, were = self.damaged[0], "was" if len(self.damaged) == 1 else "were"
        return (
            *self.notes,
            f"{counted(len(self.damaged), 'damaged parts')} of the log {were} skipped; the first is {first.line}: {first.what}",
        )


@dataclass(frozen=True, eq=False)
class Reading:
    """A log whose format and meaning are known, and whose scans can now be read, once.

    items    scans with ranges as the driver wrote them, and what was skipped, in the order of the file
    assumed  notes on what the log does not say and the reader assumed, by the field of `perception.readers.echoes.Told` that says it
    """

    format: str
    notes: tuple[str, ...]
    items: Iterator[Scan | Damage]
    assumed: Mapping[str, str] = field(default_factory=dict)
