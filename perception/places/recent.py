"""The last scans of a drive with their poses: all that a place detector remembers of the way."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from typing import Literal

import numpy as np

from perception.places.track import Array
from perception.readers.scans import Scan
from ssh_abduction.data.odometry import Pose


class Recent:
    """The last scans of an unbroken drive, with their poses and the metres driven.

    Scans are counted from the beginning of the drive. Older scans are dropped, and the others keep
    their indices.
    """

    def __init__(self) -> None:
        self.begin = 0  # index of the first scan that is kept
        self._scans: list[Scan] = []
        self._poses: list[Pose] = []
        self._ways: list[float] = []

    @property
    def end(self) -> int:
        """The index after that of the last scan."""
        return self.begin + len(self._scans)

    def append(self, scan: Scan, pose: Pose) -> None:
        """Add the next scan and its pose: x, y in metres and heading in radians."""
        last, way = (self._poses[-1], self._ways[-1]) if self._poses else (pose, 0.0)
        self._ways.append(way + float(np.hypot(last[0] - pose[0], last[1] - pose[1])))
        self._scans.append(scan)
        self._poses.append(pose)

    def drop_before(self, index: int) -> None:
        """Drop the scans before an index. The last scan stays."""
        dropped = max(min(index, self.end - 1) - self.begin, 0)
        for kept in (self._scans, self._poses, self._ways):
            del kept[:dropped]
        self.begin += dropped

    def scan(self, index: int) -> Scan:
        """Return a scan."""
        return self._scans[index - self.begin]

    def poses(self, begin: int, end: int) -> Array:
        """Return the poses of scans begin … end - 1: (n, 3) metres and radians."""
        return np.array(self._poses[begin - self.begin : end - self.begin]).reshape(-1, 3)

    def way(self, index: int) -> float:
        """Return the metres driven up to a scan, or up to the first one that is kept; 0 if none."""
        return self._ways[max(index - self.begin, 0)] if self._ways else 0.0

    def at(self, way: float, side: Literal["left", "right"] = "left") -> int:
        """Find the first kept scan at which the robot has driven `way` metres.

        "left" finds the first scan at which it has driven at least `way`, "right" the first at
        which it has driven farther. If there is none, the result is the index after the last scan.
        """
        find = bisect_left if side == "left" else bisect_right
        return self.begin + find(self._ways, way)
