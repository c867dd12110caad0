"""Makes and matches local perceptual maps: grids of the free space around the robot.

A local map is made from a window of consecutive scans, which `Recent` keeps. Each grid cell counts
how many scans of the window saw through the cell, and how many hit an obstacle in it. The grid is a
torus, so that it is large enough anywhere. There is no global map, so drift matters only within a
window (Beeson, Modayil & Kuipers 2010).

Two local maps match if the surroundings of two places agree at some relative pose. The score of a
rotation and a shift is the mean, over the wall points of each map that the other map observed, of
exp(-d² / (2 σ²)). Here d is the distance to the nearest wall of the other map. A wall point in free
space of the other map, far from its walls, counts negatively. Coarse grids are correlated for all
shifts at once by fast Fourier transforms. The best shift is then refined.

Reference:
    Olson 2009, "Real-time correlative scan matching".
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from perception.places.track import Array, is_near, points_turned
from perception.readers.scans import Scan
from ssh_abduction.data.odometry import Pose, displacement_between

Bools = NDArray[np.bool_]
Cells = NDArray[np.int32]
Cell = tuple[int, int]

NO_CELLS = np.zeros(0, np.int32)
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


def any_beside(mask: Bools) -> Bools:
    """Whether each cell but those at the border, or one of its neighbours, is in a mask."""
    rows = mask[:-2] | mask[1:-1] | mask[2:]
    return np.asarray(rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:])


def squares_to_false(mask: Bools) -> NDArray[np.int64]:
    """The squared distance in cells from each cell to the nearest one that is not in a mask."""
    near = ndimage.distance_transform_edt(mask, return_distances=False, return_indices=True)
    rows, columns = np.ogrid[: len(mask), : mask.shape[1]]
    return np.asarray((near[0] - rows) ** 2 + (near[1] - columns) ** 2)


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
        self._sums: dict[frozenset[int], Cells] = {}  # what `_counted` returned last

    def around(self, scan: int, middle: Array | Sequence[float], half: float) -> Patch:
        """Make the square patch around a position near a scan.

        The middle, (x, y), and half the side are in metres, in the frame of the track.
        """
        way = self._recent.way(scan)
        begin, end = self._recent.at(way - self._reach), self._recent.at(way + self._reach, "right")
        first = np.rint(np.asarray(middle) / CELL).astype(int) - round(half / CELL)
        rows, columns = (np.arange(n, n + 2 * round(half / CELL) + 1) % self._side for n in first)
        cells = rows[:, None] * self._side + columns
        passed, met = (count[cells] for count in self._counted(self._recent.keyframes(begin, end)))
        occupied = (met > 0) & (met >= OCCUPIED * (met + passed))
        trail = self._trail(begin, end, first, passed.shape)
        free = ((passed > 0) & ~occupied) | any_beside(any_beside(np.pad(trail, 2)))
        # A cell between two beams may have been missed. So close gaps of up to two cells, but do
        # not free cells with an obstacle.
        closed = ~any_beside(~any_beside(np.pad(free, 2)))
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

    def _counted(self, keys: Sequence[int]) -> Cells:
        """For each cell of the torus, in how many scans it was seen through, and hit: (2, cells).

        A window has most scans in common with the last one.
        """
        window = frozenset(keys)
        last, counts = self._sums.popitem() if self._sums else (frozenset[int](), NO_CELLS)
        lost = not last - window <= self._known.keys()
        if not last or lost or 4 * len(window ^ last) > len(window):
            seen = [(NO_CELLS, NO_CELLS), *map(self._cells_of, keys)]
            joined = (np.concatenate(some) for some in zip(*seen, strict=True))
            sums = [np.bincount(some, minlength=self._side**2) for some in joined]
            counts = np.array(sums, np.int32)
        else:
            for one, i in [(-1, i) for i in last - window] + [(1, i) for i in window - last]:
                for count, cells in zip(counts, self._cells_of(i), strict=True):
                    count[cells] += one
        self._sums[window] = counts
        return counts

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
        self._keys: list[int] = []

    @property
    def end(self) -> int:
        """The index after that of the last scan."""
        return self.begin + len(self._scans)

    def append(self, scan: Scan, pose: Pose) -> None:
        """Add the next scan and its pose: x, y in metres and heading in radians."""
        last, way = (self._poses[-1], self._ways[-1]) if self._poses else (pose, 0.0)
        self._ways.append(way + float(np.hypot(last[0] - pose[0], last[1] - pose[1])))
        if not self._keys or not is_near(
            displacement_between(self._poses[self._keys[-1] - self.begin], pose)
        ):
            self._keys.append(self.end)
        self._scans.append(scan)
        self._poses.append(pose)

    def drop_before(self, index: int) -> None:
        """Drop the scans before an index. The last scan stays."""
        dropped = max(min(index, self.end - 1) - self.begin, 0)
        for kept in (self._scans, self._poses, self._ways):
            del kept[:dropped]
        self.begin += dropped
        del self._keys[: bisect_left(self._keys, self.begin)]

    def scan(self, index: int) -> Scan:
        """Return a scan."""
        return self._scans[index - self.begin]

    def keyframes(self, begin: int, end: int) -> list[int]:
        """Return those of scans begin … end - 1 that show something new."""
        return self._keys[bisect_left(self._keys, begin) : bisect_left(self._keys, end)]

    def poses(self, begin: int, end: int) -> Array:
        """Return the poses of scans begin … end - 1: (n, 3) metres and radians."""
        return np.array(self._poses[begin - self.begin : end - self.begin]).reshape(-1, 3)

    def pose(self, index: int) -> Pose:
        """Return the pose of a scan."""
        return self._poses[index - self.begin]

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


# The map within REACH metres of the middle of a place is matched, with shifts of up to MOST metres.
REACH, MOST = 7.0, 5.0
# Side of a coarse cell in metres, cells a side, and the size of the transforms. It is at least the
# number of cells plus that of the largest shift.
COARSE, SIDE, SIZE = 0.4, 40, 54
# Standard deviations in metres of the distance from a wall point to its wall: in the coarse search,
# and in the refinement.
BLURRED, SHARP = 0.3, 0.15
# A wall point counts -CLASH in free space at least CLEAR metres from all walls.
CLASH, CLEAR = 0.5, 0.3
# A score is divided by the number of wall points that the other map observed, but at least by this
# share of all wall points. So maps that hardly overlap do not match.
OVERLAP = 0.3
# Fewer wall points than this, where the other map observed anything, say nothing about a clash.
FEW = 20
# A match is refined only if its coarse score is at least HOPELESS, and if the standard deviation of
# its shift is less than SPREAD metres. A larger deviation means that very different shifts match
# equally well.
HOPELESS, SPREAD = 0.7, 0.85
# Scores differ by 1 / SHARPNESS where a shift is e times as probable.
SHARPNESS = 25.0
# A match that the refinement moves by more than SLID metres slides along a corridor.
SLID = 2 * COARSE
# Steps of the refinement, in radians and metres; each is repeated at most TRIES times.
STEPS = tuple(
    (math.radians(degrees), metres)
    for degrees, metres in ((4, 0.2), (2, 0.1), (1, 0.05), (0.5, 0.025))
)
TRIES = 6

_MOST = int(MOST / COARSE)
_SHIFTS = np.arange(-_MOST, _MOST + 1)
_X, _Y = (grid * COARSE for grid in np.meshgrid(_SHIFTS, _SHIFTS, indexing="ij"))
_WITHIN = np.hypot(_X, _Y) <= MOST
_AXIS = (np.arange(SIDE) - SIDE // 2) * COARSE
_CENTRES = np.stack([grid.ravel() for grid in np.meshgrid(_AXIS, _AXIS, indexing="ij")], axis=1)
# Steps of the refinement in x, y and rotation. Walls across both axes need the diagonal shifts.
_MOVES = np.array(
    [(x, y, 0) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y] + [(0, 0, -1), (0, 0, 1)]
)

_Spectra = NDArray[np.complex64]
_Floats = NDArray[np.float32]

# Agreement of a wall point in a cell, for each code of a cell (`LocalScene`). Beyond FAR, in
# squared cells, it no longer changes.
FAR = 4000
_far = np.repeat(np.sqrt(np.arange(FAR + 1)) * CELL, 2)
_observed = np.arange(len(_far)) % 2 > 0
_SHARP, _BLURRED = (
    (
        np.where(seen, np.exp(-(_far**2) / (2 * sigma**2)), 0)
        - CLASH * (_observed & (_far > CLEAR))
    ).astype(np.float32)
    for seen, sigma in ((_observed, SHARP), (_observed | (_far <= CLEAR), BLURRED))
)


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """How the second of two places lies relative to the first."""

    score: float  # mean agreement of the walls, at most 1
    turn: float  # rotation from the axes of the second map to those of the first, in radians
    # (x, y) of the second middle relative to the first, in metres, by the axes of the first map.
    shift: Array
    mutual: float  # area that both maps observed, as a share of the smaller one
    spread: float  # standard deviation of the shift over all shifts and turns, in metres


@dataclass(frozen=True, eq=False)
class LocalScene:
    """The local map around the middle of a place, prepared for matching."""

    walls: Array  # (m, 2) wall points in metres, relative to the middle
    # For each cell, twice the squared distance to the nearest wall in cells, plus 1 if the cell was
    # observed. A scene with only these small numbers needs little memory.
    codes: NDArray[np.uint16]
    shift: Array  # the middle in metres, relative to the middle of the cells

    @staticmethod
    def of(patch: Patch | PackedPatch, middle: Array) -> LocalScene:
        """Prepare a patch that is centred on a middle (x, y), in metres."""
        occupied = patch.occupied
        size = len(occupied)
        axis = (np.arange(size) - size // 2) * CELL
        near = np.hypot(*np.meshgrid(axis, axis, indexing="ij")) <= REACH
        walls, free = occupied & near, patch.free & near
        far = squares_to_false(~walls) if walls.any() else FAR
        squares = np.minimum(far, FAR).astype(np.uint16)
        shift = np.asarray(middle) - (patch.corner + size // 2 * CELL)
        points = (np.argwhere(walls) - size // 2) * CELL - shift
        return LocalScene(points, 2 * squares + (free | walls), shift)

    @cached_property
    def spectra(self) -> _Spectra:
        """The complex conjugates of the transforms without rotation, as in `Turned`."""
        return np.asarray(Turned.of(self, [0.0]).spectra[:, 0].conj())

    def agreement(self, points: Array) -> tuple[Array, Array]:
        """Compute how well points, relative to the middle, agree with the walls of this scene.

        They are (n, 2, m) x and y in metres of m points in n poses. For each pose, return the sum
        of the agreements, (n,), and the number of points whose cells this scene observed, (n,).
        """
        codes = self.codes.ravel()[self.cells(points)]
        return _SHARP[codes].sum(axis=1), (codes & 1).sum(axis=1)

    def clash(self, other: LocalScene, turn: float, shift: Array) -> float | None:
        """The share of the wall points of each scene that lie in free space of the other one.

        The other one is rotated by `turn` radians, and its middle is shifted by `shift` metres.
        None if fewer than FEW wall points lie where the other scene observed anything.
        """
        codes = np.concatenate(
            [
                self.codes.ravel()[self.cells(points_turned(turn, other.walls).T + shift[:, None])],
                other.codes.ravel()[other.cells(points_turned(-turn, self.walls - shift).T)],
            ]
        )
        seen = codes[codes & 1 > 0]
        return float((_far[seen] > CLEAR).mean()) if len(seen) >= FEW else None

    def mutual(self, other: LocalScene, turn: float, shift: Array) -> float:
        """The area that both scenes observed, as a share of the smaller one.

        The other one is rotated by `turn` radians, and its middle is shifted by `shift` metres.
        """
        observed = self.codes & 1
        here = (np.argwhere(observed) - len(observed) // 2) * CELL - self.shift
        there = points_turned(-turn, here - shift)
        seen = (other.codes.ravel()[other.cells(there.T)] & 1).sum()
        return float(seen / max(min(observed.sum(), (other.codes & 1).sum()), 1))

    def cells(self, points: Array) -> NDArray[np.int32]:
        """Number the cells in which points, (..., 2, m), lie.

        A point outside gets a border cell. Border cells are farther than REACH from the middle, so
        nothing was observed there.
        """
        size = len(self.codes)
        middle = size // 2 + 0.5
        rows, columns = (
            np.clip(
                ((points[..., k, :] + self.shift[k]) / CELL + middle).astype(np.int32), 0, size - 1
            )
            for k in (0, 1)
        )
        return np.asarray(rows * size + columns)

    def sampled(self, points: Array) -> _Floats:
        """Look up the blurred walls and the observed flags, (2, ...), at points, (..., 2, m)."""
        codes = self.codes.ravel()[self.cells(points)]
        return np.stack([_BLURRED[codes], codes & 1])


@dataclass(frozen=True, eq=False)
class Turned:
    """A scene in several rotations."""

    scene: LocalScene  # without rotation
    turns: Sequence[float]  # the rotations in radians, n
    # The transforms of the wall points, the blurred walls and the observed cells: (3, n, SIZE, SIZE
    # // 2 + 1).
    spectra: _Spectra

    @staticmethod
    def of(scene: LocalScene, turns: Sequence[float]) -> Turned:
        """Rotate a scene."""
        grids = np.zeros((3, len(turns), SIDE, SIDE), np.float32)
        turned = _rotations(np.asarray(turns))
        grids[0] = _spread_out(turned @ scene.walls.T / COARSE + SIDE // 2)
        seen = scene.sampled(turned.transpose(0, 2, 1) @ _CENTRES.T)
        grids[1:] = seen.reshape(2, -1, SIDE, SIDE)
        return Turned(scene, turns, np.asarray(fft.rfft2(grids, (SIZE, SIZE))))

    def part(self, begin: int, end: int) -> Turned:
        """The scene in the rotations begin … end - 1 only."""
        return Turned(self.scene, self.turns[begin:end], self.spectra[:, begin:end])


def _rotations(turns: Array) -> Array:
    """The matrices, (n, 2, 2), of rotations counterclockwise by angles in radians, (n,)."""
    cos, sin = np.cos(turns), np.sin(turns)
    return np.moveaxis(np.array([[cos, -sin], [sin, cos]]), 2, 0)


def _spread_out(at: Array) -> Array:
    """The weight of points, (n, 2, m), in each cell, (n, SIDE, SIDE).

    Each point is spread over four cells.
    """
    corner = np.floor(at)
    rest, cells = at - corner, corner.astype(np.intp)
    begin = np.arange(len(at))[:, None] * SIDE
    found = np.zeros(len(at) * SIDE**2)
    for x, y in ((0, 0), (0, 1), (1, 0), (1, 1)):
        rows, columns = (np.clip(cells[:, k] + step, 0, SIDE - 1) for k, step in ((0, x), (1, y)))
        share = np.abs(1 - x - rest[:, 0]) * np.abs(1 - y - rest[:, 1])
        numbers = (begin + rows) * SIDE + columns
        found += np.bincount(numbers.ravel(), share.ravel(), len(found))
    return found.reshape(-1, SIDE, SIDE)


def match(first: LocalScene, second: Turned, mutual: float = 0.0) -> Match | None:
    """Find the rotation and shift with which the maps of two places agree best.

    Returns None if the maps agree nowhere, or agree equally well at very different shifts. The
    second place is given in the rotations to try. Only shifts at which both maps observed at least
    the share `mutual` of the area of the smaller one are tried. Without this, the two sides of a
    wall agree best.
    """
    scene = second.scene
    least = OVERLAP * (len(first.walls) + len(scene.walls))
    if not least:
        return None
    scores = _scores(first.spectra, second.spectra, least)
    if mutual:
        area = min((one.codes & 1).sum() for one in (first, scene)) * (CELL / COARSE) ** 2
        both = _correlated(first.spectra[2] * second.spectra[2])
        scores = np.where(both >= mutual * area, scores, -np.inf)
    best = np.unravel_index(int(scores.argmax()), scores.shape)
    if scores[best] < HOPELESS or (spread := _spread(scores - scores[best])) >= SPREAD:
        return None
    coarse = np.array([_X[best[1:]], _Y[best[1:]]])
    found = refined(first, scene, float(second.turns[int(best[0])]), coarse, spread)
    return None if math.dist(found.shift, coarse) > SLID else found


def _scores(first: _Spectra, second: _Spectra, least: float) -> Array:
    """Score each rotation and shift, (n, shifts, shifts), divided by at least `least` points."""
    walls, blurred, observed = first
    points, soft, seen = second
    agree, count = (
        _correlated(points * field + turned * walls)
        for field, turned in ((blurred, soft), (observed, seen))
    )
    return np.where(_WITHIN, agree / np.maximum(count, least), -np.inf)


def _correlated(products: _Spectra) -> _Floats:
    """Transform products of spectra back, for the shifts of `_SHIFTS` only."""
    rows = fft.ifft(products, axis=-2)[..., -_SHIFTS % SIZE, :]
    return np.asarray(fft.irfft(rows, SIZE, axis=-1)[..., -_SHIFTS % SIZE])


def _spread(less: Array) -> float:
    """The standard deviation of the shift in metres. `less` has scores minus the best score."""
    weights = np.exp(SHARPNESS * less).sum(axis=0)
    weights /= weights.sum()
    x, y = (float((weights * grid).sum()) for grid in (_X, _Y))
    return math.sqrt(float((weights * ((_X - x) ** 2 + (_Y - y) ** 2)).sum()))


def refined(
    first: LocalScene, second: LocalScene, turn: float, shift: Array, spread: float = 0.0
) -> Match:
    """Improve a rotation and a shift step by step."""
    least = OVERLAP * (len(first.walls) + len(second.walls))

    def scores_of(poses: Array) -> Array:
        turned, shifts = _rotations(poses[:, 2]), poses[:, :2, None]
        # The points of each place are moved to the map of the other place.
        there, seen = first.agreement(turned @ second.walls.T + shifts)
        back, seen_back = second.agreement(turned.transpose(0, 2, 1) @ (first.walls.T - shifts))
        return np.asarray((there + back) / np.maximum(seen + seen_back, least))

    pose = np.array([*shift, turn])
    score = float(scores_of(pose[None])[0])
    for angle, metres in STEPS:
        steps = _MOVES * (metres, metres, angle)
        for _ in range(TRIES):
            tried = pose + steps
            found = scores_of(tried)
            if found.max() <= score:
                break
            score, pose = float(found.max()), tried[found.argmax()]
    turn, shift = float(pose[2]), pose[:2]
    return Match(score, turn, shift, first.mutual(second, turn, shift), spread)
