"""Keeps the scans of a log in a table and temporary files, so that a long log needs less memory.

A kept range array looks like any other. The operating system reads it from its file when it is
used. `in_turn` releases the memory of scans that were used.
"""

from __future__ import annotations

import math
import mmap
import tempfile
from array import array
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import overload

import numpy as np
from numpy.typing import NDArray

from perception.readers.scans import LaserScanner, Scan

Array = NDArray[np.float64]

# Numbers of ranges in the first temporary file (128 KiB) and the largest ones (8 MiB).
FIRST, MOST = 2**14, 2**20
# Bytes that are written at once.
BLOCK = 2**16
# Numbers in a row of the table: odometry, corrected pose, time, number of the laser, line, and the
# place of the ranges. NaN is a missing pose or time.
ROW = 3 + 3 + 1 + 1 + 1 + 2


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
