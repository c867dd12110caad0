"""Matches two local maps: finds the relative pose at which the surroundings of two places agree.

The score of a rotation and a shift is the mean, over the wall points of each map that the other map
observed, of exp(-d² / (2 σ²)). Here d is the distance to the nearest wall of the other map. A wall
point in free space of the other map, far from its walls, counts negatively. Coarse grids are
correlated for all shifts at once by fast Fourier transforms. The best shift is then refined.

Reference:
    Olson 2009, "Real-time correlative scan matching".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from perception.places.local_map import CELL, PackedPatch, Patch
from perception.places.track import Array, points_turned

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
        far = ndimage.distance_transform_edt(~walls) if walls.any() else np.sqrt(FAR)
        squares = np.minimum(np.rint(np.square(far)), FAR).astype(np.uint16)
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


def match(first: LocalScene, second: Turned) -> Match | None:
    """Find the rotation and shift with which the maps of two places agree best.

    Returns None if the maps agree nowhere, or agree equally well at very different shifts. The
    second place is given in the rotations to try.
    """
    scene = second.scene
    least = OVERLAP * (len(first.walls) + len(scene.walls))
    if not least:
        return None
    scores = _scores(first.spectra, second.spectra, least)
    best = np.unravel_index(int(scores.argmax()), scores.shape)
    if scores[best] < HOPELESS or (spread := _spread(scores - scores[best])) >= SPREAD:
        return None
    coarse = np.array([_X[best[1:]], _Y[best[1:]]])
    score, turn, shift = _refined(first, scene, float(second.turns[int(best[0])]), coarse)
    if math.dist(shift, coarse) > SLID:
        return None
    return Match(score, turn, shift, first.mutual(scene, turn, shift), spread)


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


def _refined(
    first: LocalScene, second: LocalScene, turn: float, shift: Array
) -> tuple[float, float, Array]:
    """Improve a rotation and a shift step by step; return the score and both of them."""
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
    return score, float(pose[2]), pose[:2]
