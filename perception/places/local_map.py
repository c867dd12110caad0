"""Makes the local perceptual map: a grid of the free space around the robot.

A local map is made from a window of consecutive scans, which `Recent` keeps. Each grid cell counts
how many scans of the window saw through the cell, and how many hit an obstacle in it. The grid is a
torus, so that it is large enough anywhere. There is no global map, so drift matters only within a
window (Beeson, Modayil & Kuipers 2010).
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from perception.places.track import Array
from perception.readers.scans import Scan
from ssh_abduction.data.odometry import Pose

Bools = NDArray[np.bool_]
Cells = NDArray[np.int32]
Cell = tuple[int, int]

# A cell and its eight neighbours.
EIGHT = np.ones((3, 3), np.bool_)
# Side of a cell in metres.
CELL = 0.1
# Beams are ignored beyond this many metres, as gaps between them grow too wide.
SIGHT = 12.0
# Two walls less than NARROW metres apart hide what is between them: a robot cannot pass there. So a
# beam without an echo between them was lost, and saw nothing.
NARROW = 0.3
# A cell is occupied if at least this share of the scans that looked there hit something. So passing
# people soon disappear.
OCCUPIED = 0.25


@dataclass(frozen=True, eq=False)
class Patch:
    """A square section of a local map; masks have the shape (rows, columns).

    Rows count along x and columns along y of the frame of the track.
    """

    free: Bools  # mask of cells that were seen to be free
    # Mask of cells with an obstacle. Cells that are neither free nor occupied are unobserved.
    occupied: Bools
    trail: Bools  # mask of cells that the robot drove over within the window
    corner: Array  # (x, y) centre of cell (0, 0) in metres, in the frame of the track

    def position(self, cell: Array | Cell) -> Array:
        """Compute the centre (x, y) of a cell in metres, in the frame of the track."""
        return np.asarray(cell) * CELL + self.corner


@dataclass(frozen=True, eq=False)
class PackedPatch:
    """The free and the occupied cells of a patch, in a bit each."""

    shape: tuple[int, ...]  # rows and columns
    bits: NDArray[np.uint8]  # (2, …) the packed masks
    corner: Array  # (x, y) centre of cell (0, 0) in metres, in the frame of the track

    @staticmethod
    def of(patch: Patch) -> PackedPatch:
        """Pack the masks of a patch."""
        masks = np.array([patch.free.ravel(), patch.occupied.ravel()])
        return PackedPatch(patch.free.shape, np.packbits(masks, axis=1), patch.corner)

    @property
    def free(self) -> Bools:
        """Mask of cells that were seen to be free."""
        return self._mask(0)

    @property
    def occupied(self) -> Bools:
        """Mask of cells with an obstacle."""
        return self._mask(1)

    def _mask(self, number: int) -> Bools:
        bits = np.unpackbits(self.bits[number], count=math.prod(self.shape))
        return np.asarray(bits.view(np.bool_).reshape(self.shape))


def _repeated(counts: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Each index of `counts` as often as its count says, and the numbers 0, 1, ... of each."""
    which = np.repeat(np.arange(len(counts)), counts)
    return which, np.arange(len(which)) - (np.cumsum(counts) - counts)[which]


def lost(scan: Scan) -> Bools:
    """Find the beams without an echo whose neighbours met walls at most NARROW apart: (beams,)."""
    met = np.isfinite(scan.ranges)
    beams = np.flatnonzero(met)
    nearer = np.minimum(scan.ranges[beams[:-1]], scan.ranges[beams[1:]])
    narrow = np.diff(beams) * abs(scan.laser.step) * nearer <= NARROW
    return ~met & np.pad(narrow, 1)[np.searchsorted(beams, np.arange(len(met)))]


class LocalMaps:
    """Makes local maps along a trajectory from its `recent` scans.

    The window of a scan reaches `reach` metres of trajectory before and after it.
    """

    def __init__(self, recent: Recent, reach: float) -> None:
        self._recent, self._reach = recent, reach
        # The torus covers all that the scans of one window can see, and a patch around any of them.
        self._side = int(2 * (reach + SIGHT + 2) / CELL)
        self._known: dict[int, tuple[Cells, Cells]] = {}  # the cells of each scan

    def around(self, scan: int, middle: Array | Sequence[float], half: float) -> Patch:
        """Make the square patch around a position near a scan.

        The middle, (x, y), and half the side are in metres, in the frame of the track.
        """
        way = self._recent.way(scan)
        begin, end = self._recent.at(way - self._reach), self._recent.at(way + self._reach, "right")
        first = np.rint(np.asarray(middle) / CELL).astype(int) - round(half / CELL)
        rows, columns = (np.arange(n, n + 2 * round(half / CELL) + 1) % self._side for n in first)
        cells = rows[:, None] * self._side + columns
        counts = np.zeros((2, self._side**2), np.int32)
        for i in range(begin, end):
            for count, seen in zip(counts, self._cells_of(i), strict=True):
                count[seen] += 1
        passed, met = counts[:, cells]
        occupied = (met > 0) & (met >= OCCUPIED * (met + passed))
        trail = self._trail(begin, end, first, passed.shape)
        free = ((passed > 0) & ~occupied) | ndimage.binary_dilation(trail, EIGHT, 2)
        # A cell between two beams may have been missed. So close gaps of up to two cells, but do
        # not free cells with an obstacle.
        closed = ndimage.binary_closing(np.pad(free, 1), EIGHT)[1:-1, 1:-1]
        return Patch((free | closed) & ~(occupied & ~free), occupied & ~trail, trail, first * CELL)

    def _trail(
        self, begin: int, end: int, first: NDArray[np.int64], shape: tuple[int, ...]
    ) -> Bools:
        """Mask of the cells, from the cell `first` on, of the trajectory of the window."""
        path = self._recent.poses(begin, end)[:, :2]
        steps = np.diff(path, axis=0)
        counts = 1 + (np.hypot(*steps.T) / CELL).astype(int)
        leg, number = _repeated(counts)
        points = path[leg] + number[:, None] * (steps / counts[:, None])[leg]
        cells = np.rint(np.concatenate([path, points]) / CELL).astype(int) - first
        cells = cells[((cells >= 0) & (cells < shape)).all(axis=1)]
        trail = np.zeros(shape, bool)
        trail[cells[:, 0], cells[:, 1]] = True
        return trail

    def _cells_of(self, i: int) -> tuple[Cells, Cells]:
        """Find the cells that scan i looked through, and the cells in which it hit something.

        Both are indices in the torus.
        """
        if i not in self._known:
            for old in [old for old in self._known if old < self._recent.begin]:
                del self._known[old]
            self._known[i] = self._cells(i)
        return self._known[i]

    def _cells(self, i: int) -> tuple[Cells, Cells]:
        """Compute what `_cells_of` returns for a scan."""
        scan, pose = self._recent.scan(i), self._recent.poses(i, i + 1)[0]
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        x = pose[0] + cos * scan.laser.mount[0] - sin * scan.laser.mount[1]
        y = pose[1] + sin * scan.laser.mount[0] + cos * scan.laser.mount[1]
        angles = pose[2] + scan.laser.mount[2] + scan.laser.bearings
        ahead, aside = np.cos(angles), np.sin(angles)
        valid = ~(np.isnan(scan.ranges) | lost(scan))
        ranges = np.minimum(np.where(valid, scan.ranges, 0.0), SIGHT)
        met = valid & (scan.ranges < min(SIGHT, scan.laser.reach))
        # Sample each beam along its free part.
        along = np.arange(0.0, SIGHT, 0.8 * CELL)
        beam, number = _repeated(np.searchsorted(along, ranges - CELL))
        far = along[number]
        cells = np.zeros(self._side**2, np.bool_)
        cells[self._numbers(x + ahead[beam] * far, y + aside[beam] * far)] = True
        far = ranges[met]
        ends = np.unique(self._numbers(x + ahead[met] * far, y + aside[met] * far))
        cells[ends] = False
        return np.flatnonzero(cells).astype(np.int32), ends

    def _numbers(self, x: Array, y: Array) -> Cells:
        """Number the cells in the torus at positions: x and y in metres, in the frame of the track.

        Equal numbers may stand for cells far apart, as the torus repeats.
        """
        rows, columns = (np.rint(values / CELL).astype(np.int32) % self._side for values in (x, y))
        return np.asarray(rows * self._side + columns)


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
