"""The content of a robot's log in any format: laser scans with the pose of the odometer.

>>> import math
>>> from perception.readers.scans import LaserScanner
>>> laser = LaserScanner(first=-math.pi / 2, step=math.pi / 2, beams=3, reach=8.0)
>>> [round(math.degrees(bearing)) for bearing in laser.bearings]
[-90, 0, 90]

Angles are radians counterclockwise and lengths metres. A pose is (x, y, heading). In the frame of
the robot, x is ahead and y to the left.

A `ScanTable` keeps the scans of a long log in a table and temporary files, so that it needs less
memory. A kept range array looks like any other. The operating system reads it from its file when it
is used. `in_turn` releases the memory of scans that were used.
"""

from __future__ import annotations

import math
import mmap
import tempfile
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import chain
from typing import overload

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.odometry import Pose
from ssh_abduction.data.words import counted

Array = NDArray[np.float64]

# Numbers of ranges in the first temporary file (128 KiB) and the largest ones (8 MiB).
FIRST, MOST = 2**14, 2**20
# Bytes that are written at once.
BLOCK = 2**16
# Numbers in a row of the table: odometry, corrected pose, time, number of the laser, line, and the
# place of the ranges. NaN is a missing pose or time.
ROW = 3 + 3 + 1 + 1 + 1 + 2


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


class ScanTable(Sequence[Scan]):
    """The scans of a log, in about 90 bytes each. Their ranges are in temporary files.

    The files end with the last use of their ranges. Without room for a file, its ranges stay in
    memory. Ranges that are unknown (`without_ranges`) are not kept.
    """

    def __init__(self, scans: Iterable[Scan] = ()) -> None:
        self._rows = array("d")  # ROW numbers for each scan
        self._lasers: list[LaserScanner] = []
        self._numbers: dict[LaserScanner, int] = {}  # of the lasers
        self._chunks: list[Array] = []
        self._used = 0  # numbers in the last chunk
        for scan in scans:
            self.append(scan)

    def __len__(self) -> int:
        return len(self._rows) // ROW

    @overload
    def __getitem__(self, index: int) -> Scan: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Scan, ...]: ...
    def __getitem__(self, index: int | slice) -> Scan | tuple[Scan, ...]:
        numbers = range(len(self))[index]
        if isinstance(numbers, range):
            return tuple(map(self.__getitem__, numbers))
        row = self._rows[ROW * numbers : ROW * (numbers + 1)].tolist()
        laser, line, chunk, begin = map(int, row[7:])
        scanner = self._lasers[laser]
        end = begin + scanner.beams
        return Scan(
            _unknown(scanner.beams) if chunk < 0 else self._chunks[chunk][begin:end],
            scanner,
            (row[0], row[1], row[2]),
            None if math.isnan(row[3]) else (row[3], row[4], row[5]),
            None if math.isnan(row[6]) else row[6],
            line,
        )

    def __setitem__(self, index: int, scan: Scan) -> None:
        begin = ROW * range(len(self))[index]
        self._rows[begin : begin + ROW] = array("d", self._row(scan))

    def append(self, scan: Scan) -> None:
        """Add a scan at the end."""
        self._rows.extend(self._row(scan))

    def _row(self, scan: Scan) -> tuple[float, ...]:
        """Store the ranges of a scan in a chunk. Return its other numbers, as a row for `_rows`."""
        size, chunk, begin = len(scan.ranges), -1, 0
        if scan.ranges is not _unknown(size):
            if not self._chunks or self._used + size > len(self._chunks[-1]):
                full = self._chunks[-1] if self._chunks else np.empty(0)
                _release(full)
                self._chunks.append(_new_chunk(max(size, FIRST, min(2 * len(full), MOST))))
                self._used = 0
            chunk, begin = len(self._chunks) - 1, self._used
            self._chunks[-1][begin : begin + size] = scan.ranges
            self._used += size
        number = self._numbers.setdefault(scan.laser, len(self._lasers))
        self._lasers += [scan.laser] if number == len(self._lasers) else []
        corrected = scan.corrected or (math.nan,) * 3
        time = math.nan if scan.time is None else scan.time
        return (*scan.odometry, *corrected, time, number, scan.line, chunk, begin)


@lru_cache
def _unknown(beams: int) -> Array:
    return np.full(beams, np.nan)


def without_ranges(scan: Scan) -> Scan:
    """Copy a scan, with unknown ranges that need no memory."""
    return replace(scan, ranges=_unknown(len(scan.ranges)))


def in_memory(scan: Scan) -> Scan:
    """Copy a scan, with its ranges in memory."""
    return replace(scan, ranges=scan.ranges.copy())


def in_turn(scans: Iterable[Scan]) -> Iterator[Scan]:
    """Yield scans, and release the memory of the ranges of earlier ones.

    Their ranges can still be used. They are read from their file again.
    """
    chunk: Array | None = None
    for scan in scans:
        base = scan.ranges.base
        if base is not chunk:
            _release(chunk)
            chunk = base if isinstance(base, np.ndarray) else None
        yield scan
    _release(chunk)


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


def _release(chunk: Array | None) -> None:
    """Release the memory of a chunk that is in a file. Its content stays in the file."""
    memory = None if chunk is None else chunk.base
    mapped = memory.obj if isinstance(memory, memoryview) else None
    if isinstance(mapped, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
        mapped.madvise(mmap.MADV_DONTNEED)
