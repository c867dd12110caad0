"""Matches two local maps: how the surroundings of one place lie relative to those of another.

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
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from perception.places.local_map import CELL, Bools, Patch
from perception.places.track import Array, points_turned

# The map within REACH metres of the middle of a place is matched, with shifts of up to MOST metres.
REACH, MOST = 7.0, 5.0
# Side of a coarse cell in metres, cells a side, and the size of the transforms. It is at least the
# number of cells plus that of the largest shift.
COARSE, SIDE, SIZE = 0.2, 80, 108
# Standard deviations in metres of the distance from a wall point to its wall: in the coarse search,
# and in the refinement.
BLURRED, SHARP = 0.25, 0.15
# A wall point counts -CLASH in free space at least CLEAR metres from all walls.
CLASH, CLEAR = 0.5, 0.3
# A score is divided by the number of wall points that the other map observed, but at least by this
# share of all wall points. So maps that hardly overlap do not match.
OVERLAP = 0.3
# If the best coarse score is less than this, the match is not refined.
HOPELESS = 0.45
# Scores differ by 1 / SHARPNESS where a shift is e times as probable.
SHARPNESS = 20.0
# Steps of the refinement, in radians and metres; each is repeated at most TRIES times.
STEPS = tuple(
    (math.radians(degrees), metres) for degrees, metres in ((2, 0.1), (1, 0.05), (0.5, 0.025))
)
TRIES = 6

_Spectra = tuple[NDArray[np.complex64], NDArray[np.complex64], NDArray[np.complex64]]
_MOST = int(MOST / COARSE)
_SHIFTS = np.arange(-_MOST, _MOST + 1)
_X, _Y = (grid * COARSE for grid in np.meshgrid(_SHIFTS, _SHIFTS, indexing="ij"))
_WITHIN = np.hypot(_X, _Y) <= MOST
_AXIS = (np.arange(SIDE) - SIDE // 2) * COARSE
_CENTRES = np.stack([grid.ravel() for grid in np.meshgrid(_AXIS, _AXIS, indexing="ij")], axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class Match:
    """How the second of two places lies relative to the first.

    Attributes:
        score: Mean agreement of the walls, at most 1.
        turn: Rotation from the axes of the second map to those of the first, in radians.
        shift: (x, y) of the second middle relative to the first, in metres, by the axes of the
            first map.
        mutual: Area that both maps observed, as a share of the smaller one.
        spread: Standard deviation of the shift over all shifts and turns, in metres.
    """

    score: float
    turn: float
    shift: Array
    mutual: float
    spread: float


@dataclass(eq=False)
class Scene:
    """The local map around the middle of a place, prepared for matching.

    Attributes:
        walls: (m, 2) wall points in metres, relative to the middle.
    """

    walls: Array
    _observed: Bools
    _sharp: Array
    _blurred: Array
    _shift: Array
    _known: dict[int, _Spectra] = field(default_factory=dict)

    @staticmethod
    def of(patch: Patch, middle: Array) -> Scene:
        """Prepare a patch that is centred on a middle (x, y), in metres."""
        size = patch.occupied.shape[0]
        axis = (np.arange(size) - size // 2) * CELL
        near = np.hypot(*np.meshgrid(axis, axis, indexing="ij")) <= REACH
        walls, free = patch.occupied & near, patch.free & near
        far = (
            np.asarray(ndimage.distance_transform_edt(~walls)) * CELL if walls.any() else near * 9.0
        )
        clash = CLASH * (free & (far > CLEAR))
        sharp = np.where(free | walls, np.exp(-(far**2) / (2 * SHARP**2)), 0.0) - clash
        blurred = (
            np.where(free | walls | (far <= CLEAR), np.exp(-(far**2) / (2 * BLURRED**2)), 0.0)
            - clash
        )
        shift = np.asarray(middle) - (patch.corner + size // 2 * CELL)
        points = (np.argwhere(walls) - size // 2) * CELL - shift
        return Scene(points, free | walls, sharp, blurred, shift)

    def spectra(self, turn: float) -> _Spectra:
        """The transforms of the wall points, the blurred walls, and the observed cells.

        Args:
            turn: Rotation of the map in radians, rounded to thousandths.
        """
        key = round(turn * 1000)
        if key not in self._known:
            cells = np.rint(points_turned(turn, self.walls) / COARSE).astype(int) + SIDE // 2
            cells = cells[((cells >= 0) & (cells < SIDE)).all(axis=1)]
            points = np.zeros((SIDE, SIDE), np.float32)
            np.add.at(points, (cells[:, 0], cells[:, 1]), 1.0)
            centres = points_turned(-turn, _CENTRES)
            grids = [points] + [
                self._at(values, centres).reshape(SIDE, SIDE).astype(np.float32)
                for values in (self._blurred, self._observed)
            ]
            one, other, third = (fft.rfft2(grid, (SIZE, SIZE)) for grid in grids)
            self._known[key] = one, other, third
        return self._known[key]

    def forget(self) -> None:
        """Forget the transforms of all rotations but 0, which saves memory."""
        self._known = {key: known for key, known in self._known.items() if key == 0}

    def agreement(self, points: Array) -> tuple[float, int]:
        """The sum of the agreements of points with the walls, and how many were observed here.

        Args:
            points: (m, 2) metres, relative to the middle.
        """
        return float(self._at(self._sharp, points).sum()), int(
            self._at(self._observed, points).sum()
        )

    def mutual(self, other: Scene, turn: float, shift: Array) -> float:
        """The area that both scenes observed, as a share of the smaller one.

        Args:
            other: The other scene.
            turn: Its rotation in radians.
            shift: (x, y) of its middle in metres.
        """
        here = (np.argwhere(self._observed) - len(self._observed) // 2) * CELL - self._shift
        seen = other._at(other._observed, points_turned(-turn, here - shift)).sum()
        return float(seen / max(min(self._observed.sum(), other._observed.sum()), 1))

    def _at(self, values: NDArray[np.generic], points: Array) -> NDArray[np.generic]:
        """The values of the cells of points, 0 outside of the map."""
        cells = np.rint((points + self._shift) / CELL).astype(int) + len(values) // 2
        inside = ((cells >= 0) & (cells < len(values))).all(axis=1)
        cells = np.clip(cells, 0, len(values) - 1)
        return np.where(inside, values[cells[:, 0], cells[:, 1]], 0)


def match(first: Scene, second: Scene, turns: Sequence[float]) -> Match | None:
    """Find the rotation and shift with which the maps of two places agree best.

    Args:
        first: The first place.
        second: The second place.
        turns: Rotations to try, in radians.

    Returns:
        None if the maps agree nowhere.
    """
    least = OVERLAP * (len(first.walls) + len(second.walls))
    if not least:
        return None
    walls, blurred, observed = first.spectra(0.0)
    scores = np.empty((len(turns), len(_SHIFTS), len(_SHIFTS)), np.float32)
    for k, turn in enumerate(turns):
        points, soft, seen = (spectrum.conj() for spectrum in second.spectra(turn))
        agree = fft.irfft2(points * blurred + soft * walls, (SIZE, SIZE))
        count = fft.irfft2(points * observed + seen * walls, (SIZE, SIZE))
        inside = np.ix_(_SHIFTS % SIZE, _SHIFTS % SIZE)
        scores[k] = np.where(_WITHIN, agree[inside] / np.maximum(count[inside], least), -np.inf)
    best = np.unravel_index(int(scores.argmax()), scores.shape)
    if scores[best] < HOPELESS:
        return None
    shift = np.array([_X[best[1:]], _Y[best[1:]]])
    score, turn, shift = _refined(first, second, float(turns[int(best[0])]), shift)
    weights = np.exp(SHARPNESS * (scores - scores[best]))
    weights /= weights.sum()
    x, y = (float((weights * grid).sum()) for grid in (_X, _Y))
    spread = math.sqrt(float((weights * ((_X - x) ** 2 + (_Y - y) ** 2)).sum()))
    return Match(score, turn, shift, first.mutual(second, turn, shift), spread)


def _refined(first: Scene, second: Scene, turn: float, shift: Array) -> tuple[float, float, Array]:
    """Improve a rotation and a shift step by step; return the score, too."""

    def score_of(turn: float, shift: Array) -> float:
        there, seen = first.agreement(points_turned(turn, second.walls) + shift)
        back, seen_back = second.agreement(points_turned(-turn, first.walls - shift))
        return (there + back) / max(
            seen + seen_back, OVERLAP * (len(first.walls) + len(second.walls))
        )

    score = score_of(turn, shift)
    for angle, metres in STEPS:
        moves = [(sign * angle, 0.0, 0.0) for sign in (1, -1)]
        moves += [(0.0, sign * metres, 0.0) for sign in (1, -1)]
        moves += [(0.0, 0.0, sign * metres) for sign in (1, -1)]
        for _ in range(TRIES):
            found = [(turn + a, shift + np.array([x, y])) for a, x, y in moves]
            better = max(
                ((score_of(*there), k) for k, there in enumerate(found)), default=(score, 0)
            )
            if better[0] <= score:
                break
            score, (turn, shift) = better[0], found[better[1]]
    return score, turn, shift
