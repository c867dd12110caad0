"""The last scans of a drive with their poses: all that a place detector remembers of the way."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from perception.places.track import Array
from perception.readers.scans import Pose, Scan

# Rows of the table of poses at the beginning.
ROWS = 64


class Recent:
    """The last scans of an unbroken drive, with their poses and the metres driven.

    Scans are counted from the beginning of the drive. Older scans are dropped, and the others keep
    their indices.

    Attributes:
        begin: Index of the first scan that is kept.
    """

    def __init__(self) -> None:
        """Start before the first scan."""
        self.begin = self._base = 0
        self._scans: list[Scan] = []
        self._rows = np.empty((ROWS, 4))  # x, y, heading, way; the first row is scan _base

    @property
    def end(self) -> int:
        """The index after that of the last scan."""
        return self._base + len(self._scans)

    def append(self, scan: Scan, pose: Pose | Sequence[float] | Array) -> None:
        """Add the next scan and its pose: x, y in metres and heading in radians."""
        count = len(self._scans)
        if count == len(self._rows):
            self._compact()
            count = len(self._scans)
        onward = self._rows[count - 1, :2] - pose[:2] if count else np.zeros(2)
        before = self._rows[count - 1, 3] if count else 0.0
        self._rows[count] = (*pose, before + np.hypot(*onward))
        self._scans.append(scan)

    def drop_before(self, index: int) -> None:
        """Drop the scans before an index. The last scan stays."""
        self.begin = max(self.begin, min(index, self.end - 1))

    def scan(self, index: int) -> Scan:
        """Return a scan."""
        return self._scans[index - self._base]

    def poses(self, begin: int, end: int) -> Array:
        """Return the poses of scans begin … end - 1: (n, 3) metres and radians."""
        return self._rows[begin - self._base : end - self._base, :3]

    def way(self, index: int) -> float:
        """Return the metres driven up to a scan, or up to the first one that is kept."""
        return float(self._rows[max(index, self.begin) - self._base, 3])

    def at(self, way: float, side: Literal["left", "right"] = "left") -> int:
        """Find the first kept scan at which the robot has driven `way` metres.

        "left" finds the first scan at which it has driven at least `way`, "right" the first at
        which it has driven farther. If there is none, the result is the index after the last scan.
        """
        ways = self._rows[self.begin - self._base : len(self._scans), 3]
        return self.begin + int(np.searchsorted(ways, way, side=side))

    def _compact(self) -> None:
        """Free the memory of dropped scans, and double the table if few were dropped."""
        gone = self.begin - self._base
        self._scans = self._scans[gone:]
        kept, self._base = self._rows[gone:], self.begin
        self._rows = np.empty((max(ROWS, 2 * len(kept)), 4))
        self._rows[: len(kept)] = kept
