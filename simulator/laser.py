"""A laser range finder with 180 beams, one for each degree of the half circle ahead.

The first beam is on the right, the last on the left.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simulator.world import Array, World

BEAMS = 180
# Radians, counterclockwise from straight ahead.
BEARINGS: Array = np.radians(np.arange(BEAMS) - 89.5)
# Largest number of intersections of beams and walls that are computed at once: 32 MB. A single
# image may need more.
_BLOCK = 4_000_000


@dataclass(frozen=True)
class Laser:
    """A laser range finder with the noise and range of a common scanner of the paper's time.

    Attributes:
        noise: Standard deviation of a range in metres.
        reach: Largest range in metres. A beam that meets nothing nearer reads this range.
        dropouts: Probability that a beam is lost and reads the largest range.
    """

    noise: float = 0.005
    reach: float = 8.0
    dropouts: float = 0.001

    def exact(self, world: World, poses: Array) -> Array:
        """Compute the ranges without noise, (m, 180) metres from right to left, at some poses.

        Poses are (m, 3) x and y in metres, heading in radians. One call for many poses is
        faster than many calls.
        """
        poses = np.atleast_2d(poses)
        rows = max(1, _BLOCK // (BEAMS * len(world.segments)))
        return np.vstack(
            [self._cast(world.segments, poses[i : i + rows]) for i in range(0, len(poses), rows)]
        )

    def scan(self, world: World, poses: Array, rng: np.random.Generator) -> Array:
        """Compute the ranges with noise at some poses, as `exact`."""
        ranges = self.exact(world, poses)
        ranges = ranges + rng.normal(0, self.noise, ranges.shape) * (ranges < self.reach)
        ranges[rng.random(ranges.shape) < self.dropouts] = self.reach
        return np.clip(ranges, 0.01, self.reach)

    def _cast(self, segments: Array, poses: Array) -> Array:
        """The distance from each pose to the nearest wall along each beam: (m, 180), metres."""
        near = _near(segments, poses, self.reach)
        return np.asarray(meetings(near, poses, BEARINGS).min(axis=2, initial=self.reach))


def _near(segments: Array, poses: Array, reach: float) -> Array:
    """The walls whose bounding box is within `reach` of the bounding box of the poses."""
    low, high = poses[:, :2].min(0) - reach, poses[:, :2].max(0) + reach
    ends, others = segments[:, :2], segments[:, 2:]
    is_near = (np.minimum(ends, others) <= high) & (np.maximum(ends, others) >= low)
    return np.asarray(segments[is_near.all(1)])


def meetings(segments: Array, poses: Array, bearings: Array) -> Array:
    """Compute the distances in metres, (m, b, w), from poses to walls along rays.

    Walls are (w, 4) metres, poses (m, 3) x and y in metres and heading in radians, and bearings
    (b,) radians from the heading. A distance is infinite if the ray misses the wall.
    """
    angles = poses[:, 2, None] + bearings
    dx, dy = np.cos(angles)[:, :, None], np.sin(angles)[:, :, None]
    ax = segments[:, 0] - poses[:, 0, None]
    ay = segments[:, 1] - poses[:, 1, None]
    ex, ey = segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1]
    # The ray r (dx, dy) meets the wall a + s e, 0 <= s <= 1, where both are equal. Cross products
    # with e and with (dx, dy) give r and s.
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / (dx * ey - dy * ex)
        r = (ax * ey - ay * ex)[:, None, :] * inverse
        s = (ax[:, None, :] * dy - ay[:, None, :] * dx) * inverse
        hit = (r > 0) & (s >= 0) & (s <= 1)
    return np.where(hit, r, np.inf)
