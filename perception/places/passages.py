"""Measures the free space beside a robot on its way, and finds the doors there, in local maps.

Each point of a course has two widths: the distances from the course to the nearest wall on the left
and on the right. A door is a narrow part of a course with wider parts before and behind it. The
local maps also show doors and other openings in the walls that the robot passes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from scipy import ndimage

from perception.places.distinctive import Visit
from perception.places.local_map import CELL, LocalMaps, Recent
from perception.places.track import Array, Track
from perception.readers.scans import RobotLog
from ssh_abduction.data.odometry import radians_between

# Widths are measured every STEP metres, in local maps of scans that are EVERY metres apart, within
# REACH metres of the trajectory. A local map serves for a stretch of STRETCH metres.
STEP, EVERY, REACH, STRETCH = 0.25, 0.3, 3.0, 2.0
# Walls farther than WIDE metres count as WIDE metres away. A wall is beside a point if it is within
# ALONG metres of it, measured along the course.
WIDE, ALONG = 4.0, 0.3
# A door is at most DOOR metres wide. The free space before and behind it is wider by WIDER metres.
# A wall is known to half a cell, so two widths of one passage differ by two cells at most. These
# wider parts are at most NEAR metres apart: a longer narrow part is a corridor with openings beside
# it. But if both are longer than NEAR metres, they are rooms, and may be twice as far apart. A door
# has jambs: before and behind it, the way widens by WIDER within JAMB points. A wedge has none.
DOOR, NEAR, WIDER, JAMB = 1.45, 2.0, 2 * CELL, 4
# Walls go on if GO_ON points on each side of a narrow part are on one line.
GO_ON = 3
# A part of a wall is an opening if there the free space reaches DEEP metres farther than beside it,
# over a length from LEAST to MOST metres. Beside it means within BESIDE metres.
DEEP, LEAST, MOST, BESIDE = 0.6, 0.5, 1.8, 2.5
# The robot drove over what is less than DRIVEN metres beside its course, so no wall is there.
DRIVEN = 0.15
_SIDES = (0, 1), (1, 0)  # left and right, and right and left
_TURN = 0.5  # A scan is also used if the robot turned by this angle in radians.


def resampled(way: Array, step: float) -> Array:
    """Place points every `step` metres along a chain, (n, 2) metres, the last one at its end."""
    far = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way, axis=0).T))])
    moving = np.concatenate([[True], np.diff(far) > 1e-6])
    if far[-1] < 1e-6:
        return way[:1]
    at = np.minimum(np.arange(0.0, far[-1] + step / 2, step), far[-1])
    return np.stack([np.interp(at, far[moving], way[moving, k]) for k in (0, 1)], axis=1)


def spaced(track: Track, size: int) -> list[int]:
    """Choose from the first `size` scans those at which the robot drove on, or turned."""
    chosen = [0]
    for i in range(1, size):
        far = track.way[i] - track.way[chosen[-1]]
        turned = radians_between(track.poses[chosen[-1], 2], track.poses[i, 2])
        if i in track.breaks or far >= EVERY or turned > _TURN:
            chosen.append(i)
    return chosen


class Passages:
    """Measures the ways of a robot between places in local maps of its log."""

    def __init__(self, log: RobotLog, track: Track) -> None:
        self._track, self._recent = track, Recent()
        self._maps = LocalMaps(self._recent, REACH)
        chosen = spaced(track, len(log))
        for i in chosen:
            self._recent.append(log.scans[i], track.pose(i))
        self._chosen = np.array(chosen)

    def along(self, chain: Array, first: Visit, last: Visit) -> dict[str, Any]:
        """Measure the widths along a chain from one visit to another, and find the doors.

        The chain, (n, 2) metres, is in the frame of the track.

        Returns:
            `widths`: for each point, STEP metres apart, the distances to the walls on the left and
            on the right, at most WIDE. `doors`: for each door, `at` in metres along the chain, its
            `width`, and its `side`: "through", "left" or "right".
        """
        way = resampled(chain, STEP)
        if len(way) < 2:
            return {}
        # Earlier scans are not needed again, so the local maps may forget them.
        self._recent.drop_before(self._recent.at(self._recent.way(self._near(first.scan)) - REACH))
        walls, free = self._beside(way, first.scan, last.scan)
        back, before = self._beyond(way[::-1], first.scan)
        on, beyond = self._beyond(way, last.scan)
        whole = np.concatenate([back[::-1], way, on])
        # Left of the way back is right of the way on.
        sides = np.concatenate([before[::-1, ::-1], walls, beyond])
        # Clutter shows at one point of a side, and a jamb at two: a course may cross it aslant.
        sides = ndimage.median_filter(sides, (3, 1))
        ends = [len(part) < round(NEAR / STEP) for part in (back, on)]
        through = [
            {"at": round(k * STEP, 2), "width": round(float(walls[k].sum()), 2), "side": "through"}
            for k in (door - len(back) for door in doors_in(sides.sum(axis=1), ends))
            if 0 < k < len(way) - 1 and not has_straight_walls(k + len(back), whole, sides)
        ]
        aside = [
            {"at": round(at * STEP, 2), "width": round(length, 2), "side": side}
            for column, side in enumerate(("left", "right"))
            for at, length in openings_in(free[:, column])
        ]
        return {"widths": np.round(walls, 2).tolist(), "doors": through + aside}

    def _beyond(self, way: Array, scan: int) -> tuple[Array, Array]:
        """Go straight on beyond the end of a way, up to NEAR metres or a wall.

        Returns:
            The points, and how far walls are on the left and right of each, both (n, 2) metres.
        """
        ahead = directions(way)[-1]
        more = way[-1] + np.arange(1, round(NEAR / STEP) + 1)[:, None] * STEP * ahead
        patch = self._maps.around(self._near(scan), way[-1], WIDE + NEAR)
        cells = np.rint((more - patch.corner) / CELL).astype(int)
        open_ = patch.free[cells[:, 0], cells[:, 1]]
        more = more[: len(more) if open_.all() else int(np.argmin(open_))]
        return more, self._beside(np.concatenate([way[-1:], more]), scan, scan)[0][1:]

    def _near(self, scan: int) -> int:
        """The index of the chosen scan that is next to a scan."""
        return int(np.abs(self._chosen - scan).argmin())

    def _beside(self, way: Array, begin: int, end: int) -> tuple[Array, Array]:
        """Measure how far walls, and the free space, reach left and right: (n, 2) each."""
        ahead = directions(way)
        walls, free = np.full((len(way), 2), WIDE), np.zeros((len(way), 2))
        scans = self._chosen[(self._chosen >= begin) & (self._chosen <= end)]
        scans = scans if len(scans) else self._chosen[[self._near(begin)]]
        stretch = round(STRETCH / STEP)
        for first in range(0, len(way), stretch):
            points = way[first : first + stretch]
            middle = points.mean(axis=0)
            far = np.hypot(*(self._track.poses[scans, :2] - middle).T)
            near = int(np.searchsorted(self._chosen, scans[far.argmin()]))
            patch = self._maps.around(near, middle, WIDE + STRETCH / 2 + 0.5)
            blocked = patch.position(np.argwhere(patch.occupied).astype(float)) - points[:, None]
            hidden = np.argwhere(~patch.free & ndimage.binary_dilation(patch.free))
            unseen = patch.position(hidden.astype(float)) - points[:, None]
            part = ahead[first : first + stretch, None]
            for found, ends, half in ((walls, blocked, ALONG), (free, unseen, CELL)):
                along = (ends * part).sum(axis=2)
                off = part[..., 0] * ends[..., 1] - part[..., 1] * ends[..., 0]
                for column, side in enumerate((1, -1)):
                    beside = (np.abs(along) <= half) & (side * off > DRIVEN)
                    nearest = np.where(beside, side * off, WIDE).min(axis=1, initial=WIDE)
                    found[first : first + stretch, column] = nearest
        return walls, free


def to_the_left(way: Array) -> Array:
    """The directions to the left of a course at each point, (n, 2)."""
    ahead = directions(way)
    return np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)


def directions(way: Array) -> Array:
    """The unit vectors, (n, 2), along a way of n points, over four steps each."""
    low, high = np.arange(len(way)) - 2, np.arange(len(way)) + 2
    off = way[np.minimum(high, len(way) - 1)] - way[np.maximum(low, 0)]
    return np.asarray(off / np.maximum(np.hypot(*off.T), 1e-6)[:, None])


def doors_in(wide: Array, ends: Sequence[bool] = (False, False)) -> list[int]:
    """Find the points of a course at which it passes a door.

    `wide` has the free space across the course, (n,) metres, every STEP metres. `ends` says whether
    there are walls across its beginning and its end: a narrow part there is a closet.
    """
    from scipy.signal import find_peaks

    peaks, _ = find_peaks(-wide, height=-DOOR, prominence=WIDER)
    found, near = [], round(NEAR / STEP)
    for k in map(int, peaks):
        wider = wide > wide[k] + WIDER - 1e-6  # as find_peaks rounds
        begin, end = np.flatnonzero(wider[:k])[-1], k + np.flatnonzero(wider[k:])[0]
        parts = wider[max(begin - near, 0) : begin + 1], wider[end : end + near + 1]
        is_between_rooms = min(part.sum() for part in parts) > near
        short = end - begin <= (2 * near if is_between_rooms else near)
        if short and _has_jamb(wide[max(begin - 1, 0) : k + 1]) and _has_jamb(wide[k : end + 2]):
            found.append(k)
    closets = [len(wide) - 1 - k for k in _closet_in(wide[::-1])] * ends[0]
    closets += _closet_in(wide) * ends[1]
    return found + [k for k in closets if all(abs(k - door) * STEP > NEAR for door in found)]


def _has_jamb(wide: Array) -> bool:
    """Whether a part of a course widens by WIDER within JAMB points, or is no longer than that."""
    return len(wide) <= JAMB or float(np.abs(wide[JAMB:] - wide[:-JAMB]).max()) >= WIDER - 1e-6


def _closet_in(wide: Array) -> list[int]:
    """The first point of the narrow part at the end of a course, if it is short."""
    begin = len(wide) - int(np.argmin((wide <= DOOR)[::-1]))
    return [begin] if 0 < (len(wide) - begin) * STEP <= NEAR else []


def has_straight_walls(k: int, way: Array, sides: Array) -> bool:
    """Whether a way is narrow at its point k, but the walls there are no jambs of a door.

    Furniture: both walls go straight on before and behind it, and one of them beside it, too.
    Openings: one wall goes straight on from before it, and the other to behind it. The way is wide
    there as the opposite walls have openings. `way` has the points, and `sides` how far walls are
    on the left and right of each, both (n, 2) metres.
    """
    wide, left = sides.sum(axis=1), to_the_left(way)
    wider = np.flatnonzero(wide >= wide[k] + WIDER)
    before, behind = wider[wider < k][-GO_ON:], wider[wider > k][:GO_ON]
    if min(len(before), len(behind)) < GO_ON:
        return False
    walls = way + sides[:, [0]] * left, way - sides[:, [1]] * left
    clear = wider[wide[wider] >= wide[k] + WIDER + CELL / 2]  # not the edge of furniture
    outer = [*clear[clear < k][-GO_ON:], *clear[clear > k][:GO_ON]]
    beside = [_is_straight(wall[outer[0] : outer[-1] + 1]) for wall in walls if outer]
    go_on_both = len(outer) == 2 * GO_ON and all(_is_straight(wall[outer]) for wall in walls)
    if go_on_both and sum(beside) == 1:
        return True
    begin, end = before[-1] + 1, behind[0]
    parts = (begin - GO_ON, end), (begin, end + GO_ON)
    go_on = [[_is_straight(wall[slice(*part)]) for wall in walls] for part in parts]
    beyond = sides[begin - GO_ON : begin], sides[end : end + GO_ON]
    opens = [np.median(some, axis=0) >= sides[k] + WIDER for some in beyond]
    return any(go_on[0][x] and opens[0][y] and go_on[1][y] and opens[1][x] for x, y in _SIDES)


def _is_straight(points: Array) -> bool:
    """Whether all points, (n, 2) metres, are within a cell of one line."""
    off = points - points.mean(axis=0)
    return float(np.abs(off @ np.linalg.svd(off)[2][1]).max()) <= CELL


def openings_in(free: Array) -> Iterator[tuple[float, float]]:
    """Yield the openings in the wall on one side of a course: their middle, and their length.

    `free` has how far the free space reaches on this side, every STEP metres. The middle is in
    steps, the length in metres.
    """
    usual = ndimage.median_filter(free, 2 * round(BESIDE / STEP) + 1, mode="nearest")
    parts, count = ndimage.label(free >= usual + DEEP)
    for part in range(1, count + 1):
        inside = np.flatnonzero(parts == part)
        length = len(inside) * STEP
        if LEAST <= length <= MOST and inside[0] > 0 and inside[-1] < len(free) - 1:
            yield float(inside.mean()), length
