"""The content of a robot's log in any format: laser scans with the pose of the odometer.

>>> import math
>>> from perception.readers.scans import LaserScanner
>>> laser = LaserScanner(first=-math.pi / 2, step=math.pi / 2, beams=3, reach=8.0)
>>> [round(math.degrees(bearing)) for bearing in laser.bearings]
[-90, 0, 90]

Angles are radians counterclockwise and lengths metres. A pose is (x, y, heading). In the frame of
the robot, x is ahead and y to the left.

A `ScanTable` keeps the ranges of a long log in temporary files, so that it needs less memory. Kept
ranges look like any others. The operating system reads them from their file when they are used.
"""

from __future__ import annotations

import mmap
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import chain
from typing import overload

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.odometry import Pose, moved
from ssh_abduction.data.words import counted

Array = NDArray[np.float64]

# Numbers of ranges in the first temporary file (128 KiB) and the largest ones (8 MiB).
FIRST, MOST = 2**14, 2**20
# Bytes that are written at once.
BLOCK = 2**16


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

    def __deepcopy__(self, memo: object) -> Scan:
        """Return the scan itself, as it never changes."""
        return self

    def ends(self, pose: Pose, far: float) -> NDArray[np.float64]:
        """The points, (n, 2) metres, where beams ended at most `far` metres from the laser.

        The robot is at `pose`: x, y in metres and heading in radians.
        """
        x, y, heading = moved(pose, self.laser.mount)
        near = np.isfinite(self.ranges) & (self.ranges < min(far, self.laser.reach))
        ranges, angles = self.ranges[near], heading + self.laser.bearings[near]
        return np.stack([x + ranges * np.cos(angles), y + ranges * np.sin(angles)], axis=1)


class Damaged(Exception):  # noqa: N818 - becomes a Damage
    """A line or message of a known kind that cannot be read."""


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
        odometer: Times in seconds, (n,), and poses at them, (n, 3), of an odometer with messages
            of its own; None if poses come with the scans.
    """

    scans: Sequence[Scan]
    damaged: tuple[Damage, ...] = ()
    format: str = ""
    source: str = ""
    notes: tuple[str, ...] = ()
    sources: tuple[str, ...] = ()
    odometer: tuple[Array, Array] | None = None

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
    odometer: tuple[Array, Array] | None = None  # as in `RobotLog`


class ScanTable(Sequence[Scan]):
    """The scans of a log. Their ranges are in temporary files.

    The files end with the last use of their ranges. Without room for a file, its ranges stay in
    memory.
    """

    def __init__(self, scans: Iterable[Scan] = ()) -> None:
        self._scans: list[Scan] = []
        self._chunk, self._used = np.empty(0), 0  # the last file, and how many numbers it has
        for scan in scans:
            self.append(scan)

    def __len__(self) -> int:
        return len(self._scans)

    @overload
    def __getitem__(self, index: int) -> Scan: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Scan, ...]: ...
    def __getitem__(self, index: int | slice) -> Scan | tuple[Scan, ...]:
        return tuple(self._scans[index]) if isinstance(index, slice) else self._scans[index]

    def __iter__(self) -> Iterator[Scan]:
        """Yield the scans, and release the memory of the ranges of earlier ones.

        Their ranges can still be used. They are read from their file again.
        """
        chunk = self._chunk
        for scan in self._scans:
            if scan.ranges.base is not chunk:
                _release(chunk)
                chunk = np.asarray(scan.ranges.base)
            yield scan
        _release(chunk)

    def append(self, scan: Scan) -> None:
        """Add a scan at the end."""
        size = len(scan.ranges)
        if self._used + size > len(self._chunk):
            _release(self._chunk)
            self._chunk = _new_chunk(max(size, FIRST, min(2 * len(self._chunk), MOST)))
            self._used = 0
        ranges = self._chunk[self._used : self._used + size]
        ranges[:] = scan.ranges
        self._used += size
        self._scans.append(replace(scan, ranges=ranges))


def _new_chunk(size: int) -> Array:
    try:
        with tempfile.TemporaryFile() as file:
            # Bytes are written, as a full disk would else end the program later.
            for begin in range(0, 8 * size, BLOCK):
                file.write(bytes(min(BLOCK, 8 * size - begin)))
            file.flush()
            return np.frombuffer(mmap.mmap(file.fileno(), 8 * size), np.float64)
    except OSError:
        return np.empty(size)


def _release(chunk: Array) -> None:
    """Release the memory of a chunk that is in a file. Its content stays in the file."""
    mapped = chunk.base.obj if isinstance(chunk.base, memoryview) else None
    if isinstance(mapped, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
        mapped.madvise(mmap.MADV_DONTNEED)
