"""Finds the walls around the robot in one laser image, without knowing the true pose.

Walls are assumed to meet at right angles. The points of the image are rotated until the walls are
parallel to the axes. The wall ahead, the walls alongside, and the far walls of side streets are
then the lines with the most points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulator.laser import BEARINGS

Array = NDArray[np.float64]
# Points of a wall differ by at most this many metres across it: ten times the noise of the laser.
THICK = 0.05
# Smallest length of a wall in metres; anything shorter is clutter, or the end of a wall.
LONG = 0.4
# The direction of each beam as a vector, (180, 2).
AHEAD_AND_LEFT = np.stack([np.cos(BEARINGS), np.sin(BEARINGS)], axis=1)


@dataclass(frozen=True)
class WallPositions:
    """Positions of the walls in metres and radians. None means that no such wall is visible."""

    tilt: float  # heading of the robot relative to the axis of the walls, counterclockwise
    front: float | None  # distance to the wall ahead
    left: float | None  # distance to the wall on the left
    right: float | None  # distance to the wall on the right
    left_street: float | None  # distance ahead to the far wall of a street that opens to the left
    right_street: float | None  # distance ahead to the far wall of a street that opens to the right

    def to_go(self, reach: float, streets: bool = True) -> float | None:
        """Measure how far ahead the fixed point of the next place is, in metres.

        The fixed point is half the width of a corridor (`reach`) before the wall ahead. If
        `streets` is true, the middle of a side street counts, too, if it is nearer. The
        result is negative if the robot is beyond the point, and None if neither a wall nor a
        side street is near.
        """
        seen = [self.front, *((self.left_street, self.right_street) if streets else ())]
        marks = [x for x in seen if x is not None and x < 2.5 * reach]
        return min(marks) - reach if marks else None

    def offset(self, reach: float) -> float | None:
        """Measure how many metres the robot is to the left of the line that it should follow.

        The line is the midline between two walls, or is `reach`, half the width of a corridor, away
        from the only wall. Negative to the right. None without a wall on either side.
        """
        near = 1.5 * reach
        left = self.left if self.left is not None and self.left < near else None
        right = self.right if self.right is not None and self.right < near else None
        if left is not None and right is not None:
            return (right - left) / 2
        if left is not None:
            return reach - left
        return None if right is None else right - reach


def sight(image: Array, reach: float, farthest: float) -> WallPositions:
    """Find the walls in an image: 180 ranges in metres, from right to left.

    `reach` is half the width of a corridor. The range `farthest` means that nothing was seen.
    """
    seen = image < farthest - 0.02
    met = image[seen, None] * AHEAD_AND_LEFT[seen]
    if len(met) < 20:
        return WallPositions(0.0, None, None, None, None, None)
    axis = _axis(met)
    axis += _finer(_turned(met, -axis), reach)
    points = _turned(met, -axis)
    x, y = points[:, 0], points[:, 1]
    across, along = _spacing(y), _spacing(x)
    # If the axis is turned to the left of the robot, the robot is turned to the right of the axis.
    return WallPositions(
        tilt=-axis,
        front=_line(x, across, (x > 0.05) & (np.abs(y) < 0.5 * reach)),
        left=_line(y, along, (y > 0.05) & (y < 2 * reach) & (np.abs(x) < 6 * reach)),
        right=_line(-y, along, (y < -0.05) & (y > -2 * reach) & (np.abs(x) < 6 * reach)),
        left_street=_line(x, across, (y > reach + 0.35) & (y < 5 * reach) & (x > -0.5 * reach)),
        right_street=_line(x, across, (y < -reach - 0.35) & (y > -5 * reach) & (x > -0.5 * reach)),
    )


def _turned(points: Array, angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.asarray(points @ np.array([[c, s], [-s, c]]))


def _axis(points: Array) -> float:
    """The mean direction of the walls between -45 and 45 degrees, in radians."""
    chords = points[8:] - points[:-8]
    length = np.hypot(chords[:, 0], chords[:, 1])
    good = (length > 0.08) & (length < 1.5)
    if not good.any():
        return 0.0
    directions, weights = np.arctan2(chords[good, 1], chords[good, 0]), length[good]
    axis = float(np.angle((weights * np.exp(4j * directions)).sum())) / 4
    for tolerance in (0.2, 0.1):
        off = np.angle(np.exp(4j * (directions - axis))) / 4
        close = np.abs(off) < tolerance
        if close.sum() > 5:
            axis += float(np.average(off[close], weights=weights[close]))
    return axis


def _finer(points: Array, reach: float) -> float:
    """The remaining angle between walls and axes in radians, weighted by the walls' lengths."""
    slopes, weights = [], []
    for u, v in ((0, 1), (1, 0)):
        values, spacing = points[:, v], _spacing(points[:, u])
        inside = np.abs(values) < 3 * reach
        for side in (1, -1):
            chosen = inside & (side * values > 0.05)
            line = _line(values, spacing, chosen)
            if line is None:
                continue
            # Fit a slope to the points on the line. The sign must mean the same rotation for both
            # axes.
            on = chosen & (np.abs(values - line) < THICK)
            a, b = points[on, u], values[on]
            off = a - a.mean()
            spread = float((off**2).sum())
            if len(off) > 8 and spread > 0.2:
                slope = float((off * (b - b.mean())).sum()) / spread
                slopes.append(slope if v == 1 else -slope)
                weights.append(spread)
    return float(np.average(slopes, weights=weights)) if slopes else 0.0


def _spacing(values: Array) -> Array:
    """How many metres of wall along this axis each point represents, (n,)."""
    return np.minimum(np.abs(np.gradient(values)), 0.3)


def _line(values: Array, weights: Array, chosen: NDArray[np.bool_]) -> float | None:
    """The coordinate of the longest wall across an axis; None if no wall is LONG enough."""
    picked, length = values[chosen], weights[chosen]
    if len(picked) < 5:
        return None
    order = np.argsort(picked)
    picked, length = picked[order], length[order]
    total = np.concatenate([[0.0], np.cumsum(length)])
    ends = np.searchsorted(picked, picked + THICK, side="right")
    support = total[ends] - total[: len(picked)]
    first = int(support.argmax())
    if support[first] < LONG or ends[first] - first < 5:
        return None
    picked, length = picked[first : ends[first]], length[first : ends[first]]
    return float(np.average(picked, weights=length + 1e-6))
