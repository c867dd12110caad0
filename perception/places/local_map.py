"""The local perceptual map: free space around the robot, from the scans of a short stretch of its way.

A window of scans moves along the log. Each cell of a grid counts how many scans of the window saw through it, and how many saw something in it. What leaves the window is taken
back, and the grid is a torus that scrolls with the robot, so nothing global is ever made, and drift matters only within a window (Beeson, Modayil & Kuipers 2010).
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from perception.places.track import Array, Track
from perception.readers.scans import Scan

Bools = NDArray[np.bool_]
Cell = tuple[int, int]

# The side of a cell, in metres.
CELL = 0.1
# Beams say nothing beyond so many metres: farther away they are too far from each other to show what is between.
SIGHT = 12.0
# Something is in a cell if at least such a share of the scans that looked there met something: who walks by is soon overruled.
OCCUPIED = 0.25
# One step of a wave that alternates between four and eight neighbours leads so many cells on, in the mean over all directions.
STRIDE = 1.08

_EIGHT = np.ones((3, 3), bool)


@dataclass(frozen=True, eq=False)
class Patch:
    """A square piece of a local map.

    free      what was seen to be free
    occupied  where something is; what is neither was not observed
    trail     where the robot itself went within the window
    corner    the position of the middle of cell (0, 0), in metres, in the frame of the track
    """

    free: Bools
    occupied: Bools
    trail: Bools
    corner: Array

    @cached_property
    def clearance(self) -> Array:
        """Metres from each cell to the nearest one that is not free."""
        return np.asarray(ndimage.distance_transform_edt(np.pad(self.free, 1))[1:-1, 1:-1]) * CELL

    @cached_property
    def room(self) -> Array:
        """Metres from each cell to the nearest one that something is in."""
        return np.asarray(ndimage.distance_transform_edt(~self.occupied)) * CELL

    @cached_property
    def _met(self) -> Bools:
        """Where a look that passes through a cell meets something: in the cell itself, or in one of the next ones."""
        return np.asarray(ndimage.binary_dilation(self.occupied, np.ones((2, 2), bool)))

    def free_along(self, begin: Array, directions: Array, most: float) -> Array:
        """Metres that one can look from a position before something is met, and no more than `most`: one number for each direction, of unit vectors (..., 2)."""
        far = np.arange(0.0, most, CELL / 2)
        cells = np.rint(
            (begin + far[:, None] * directions[..., None, :] - self.corner) / CELL
        ).astype(int)
        met = self._met[cells[..., 0], cells[..., 1]]
        return np.where(met.any(axis=-1), far[met.argmax(axis=-1)], most)

    def drivable(self, width: float) -> Bools:
        """Where something of this width in metres can go. Where the robot went is always one of these cells."""
        return np.asarray(
            (self.clearance >= width / 2)
            | ndimage.binary_dilation(self.trail, _EIGHT, iterations=2)
        )

    def cell(self, position: Array | Sequence[float]) -> Cell:
        """The cell of a position; it may be outside of the patch."""
        row, column = np.rint((np.asarray(position) - self.corner) / CELL).astype(int)
        return int(row), int(column)

    def position(self, cell: Array | Cell) -> Array:
        """The middle of a cell, in the frame of the track."""
        return np.asarray(cell) * CELL + self.corner


class LocalMaps:
    """Local maps of a track, made as the window moves along."""

    def __init__(self, scans: Sequence[Scan], track: Track, reach: float) -> None:
        """reach: how many metres of the way before and after a scan its window has."""
        self._scans, self._track, self._reach = scans, track, reach
        # The torus is wide enough for all that the scans of one window can see, and for a patch around any of them.
        self._side = int(2 * (reach + SIGHT + 2) / CELL)
        self._passed = np.zeros(self._side**2, np.int32)
        self._met = np.zeros(self._side**2, np.int32)
        self._window: deque[tuple[NDArray[np.int64], NDArray[np.int64]]] = deque()
        self._begin = self._end = 0

    def around(self, scan: int, middle: Array | Sequence[float], half: float) -> Patch:
        """The square patch of 2 x half metres around a position near a scan, as the scans of its window saw it."""
        way = self._track.way
        first_scan, last_scan = self._track.span_of(
            scan
        )  # what was seen elsewhere says nothing here
        begin = max(int(np.searchsorted(way, way[scan] - self._reach)), first_scan)
        end = min(int(np.searchsorted(way, way[scan] + self._reach, side="right")), last_scan)
        self._move(begin, end)
        first = np.rint(np.asarray(middle) / CELL).astype(int) - round(half / CELL)
        rows, columns = (np.arange(n, n + 2 * round(half / CELL) + 1) % self._side for n in first)
        cells = rows[:, None] * self._side + columns
        passed, met = self._passed[cells], self._met[cells]
        occupied = (met > 0) & (met >= OCCUPIED * (met + passed))
        trail = self._trail(begin, end, first, passed.shape)
        free = ((passed > 0) & ~occupied) | ndimage.binary_dilation(trail, _EIGHT, iterations=2)
        # Between two beams a cell may have been missed: gaps of up to two cells are closed, but not through what was met.
        closed = ndimage.binary_closing(np.pad(free, 3), _EIGHT)[3:-3, 3:-3]
        return Patch((free | closed) & ~(occupied & ~free), occupied & ~trail, trail, first * CELL)

    def _trail(
        self, begin: int, end: int, first: NDArray[np.int64], shape: tuple[int, ...]
    ) -> Bools:
        path = self._track.poses[begin:end, :2]
        legs = [
            np.linspace(a, b, 2 + int(math.dist(a, b) / CELL)) for a, b in itertools.pairwise(path)
        ]
        cells = np.rint(np.concatenate([path, *legs]) / CELL).astype(int) - first
        cells = cells[((cells >= 0) & (cells < shape)).all(axis=1)]
        trail = np.zeros(shape, bool)
        trail[cells[:, 0], cells[:, 1]] = True
        return trail

    def _move(self, begin: int, end: int) -> None:
        """Moves the window to the scans from begin up to end, end excluded."""
        if begin < self._begin or begin >= self._end:
            self._passed[:], self._met[:] = 0, 0
            self._window.clear()
            self._begin = self._end = begin
        for i in range(self._end, end):
            passed, met = self._cells(i)
            self._passed[passed] += 1
            self._met[met] += 1
            self._window.append((passed, met))
        self._end = max(self._end, end)
        while self._begin < begin:
            passed, met = self._window.popleft()
            self._passed[passed] -= 1
            self._met[met] -= 1
            self._begin += 1
        while self._end > end:
            passed, met = self._window.pop()
            self._passed[passed] -= 1
            self._met[met] -= 1
            self._end -= 1

    def _cells(self, i: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """The cells that a scan looked through, and those in which it met something, each once."""
        scan, pose = self._scans[i], self._track.poses[i]
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        x = pose[0] + cos * scan.laser.mount[0] - sin * scan.laser.mount[1]
        y = pose[1] + sin * scan.laser.mount[0] + cos * scan.laser.mount[1]
        angles = pose[2] + scan.laser.mount[2] + scan.laser.bearings
        told = ~np.isnan(scan.ranges)
        ranges = np.minimum(np.where(told, scan.ranges, 0.0), SIGHT)
        met = told & (scan.ranges < min(SIGHT, scan.laser.reach))
        along = np.arange(0.0, SIGHT, 0.8 * CELL)
        through = along < (ranges - CELL)[:, None]
        rays = np.broadcast_to(along, through.shape)[through]
        which = np.nonzero(through)[0]
        passed = self._numbers(x + np.cos(angles)[which] * rays, y + np.sin(angles)[which] * rays)
        ends = self._numbers(
            x + ranges[met] * np.cos(angles[met]), y + ranges[met] * np.sin(angles[met])
        )
        return np.setdiff1d(passed, ends, assume_unique=True), ends

    def _numbers(self, x: Array, y: Array) -> NDArray[np.int64]:
        rows, columns = (np.rint(values / CELL).astype(np.int64) % self._side for values in (x, y))
        return np.unique(rows * self._side + columns)


def distances(open_cells: Bools, seeds: Bools, limit: float) -> Array:
    """Metres from the seeds to each cell through open cells, up to a limit; infinite beyond. Waves are octagons: off by 4 % at most."""
    padded = np.pad(open_cells, 1)
    width = padded.shape[1]
    unreached = padded.reshape(-1)
    wave = np.flatnonzero(np.pad(seeds, 1).reshape(-1) & unreached)
    found = np.full(unreached.shape, np.inf)
    found[wave], unreached[wave] = 0.0, False
    last = np.empty(unreached.shape, np.int64)
    four = np.array([-width, -1, 1, width])
    eight = np.array([-width - 1, -width, -width + 1, -1, 1, width - 1, width, width + 1])
    for count in range(math.ceil(limit / (STRIDE * CELL))):
        cells = (wave[:, None] + (eight if count % 2 else four)).reshape(-1)
        cells = cells[unreached[cells]]
        unreached[cells] = False
        numbers = np.arange(len(cells))
        last[cells] = numbers
        wave = cells[last[cells] == numbers]  # each cell once, and faster than by sorting
        if not len(wave):
            break
        found[wave] = (count + 1) * STRIDE * CELL
    return found.reshape(padded.shape)[1:-1, 1:-1]
