"""Keeps the ranges of the scans of a log in temporary files, so that a long log needs less memory.

A kept range array looks like any other. The operating system reads it from its file when it is
used. `in_turn` releases the memory of scans that were used.
"""

from __future__ import annotations

import mmap
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from perception.readers.scans import Scan

Array = NDArray[np.float64]

# Numbers of ranges in the first temporary file (128 KiB) and the largest ones (8 MiB).
FIRST, MOST = 2**14, 2**20
# Bytes that are written at once.
BLOCK = 2**16


class RangeStore:
    """Copies the ranges of scans to temporary files, which end with the last of these scans.

    Without room for such a file, the ranges stay in memory.
    """

    def __init__(self) -> None:
        """Start without a file."""
        self._chunk, self._used = np.empty(0), 0

    def kept(self, scan: Scan) -> Scan:
        """Copy a scan, with its ranges in a file."""
        size = len(scan.ranges)
        if self._used + size > len(self._chunk):
            _release(self._chunk)
            self._chunk = _new_chunk(max(size, FIRST, min(2 * len(self._chunk), MOST)))
            self._used = 0
        ranges = self._chunk[self._used : self._used + size]
        ranges[:] = scan.ranges
        self._used += size
        return replace(scan, ranges=ranges)


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
