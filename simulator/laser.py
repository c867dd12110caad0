"""A laser range finder: 180 ranges at one degree over the half circle ahead, the first at the right."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulator.world import World

Array = NDArray[np.float64]
BEAMS = 180
BEARINGS: Array = np.radians(
    np.arange(BEAMS) - 89.5
)  # radians, counter-clockwise from straight ahead
# At most this many intersections of beams and walls are computed at once, unless a single image takes more: an array of them has 32 MB.
_BLOCK = 4_000_000


@dataclass(frozen=True)
class Laser:
    """A laser range finder. The defaults are those of the usual scanner of the time: 5 mm of noise, 8 m of range.

    noise      standard deviation of a range, in metres
    reach      the largest range, in metres; what is farther reads as this
    dropouts   probability that a beam is lost, which reads as the largest range
    """

    noise: float = 0.005
    reach: float = 8.0
    dropouts: float = 0.001

    def exact(self, world: World, poses: Array) -> Array:
        """Ranges without noise, (m, 180) metres, from m poses (x, y, heading). One call for many poses is faster than many calls."""
        poses = np.atleast_2d(poses)
        rows = max(1, _BLOCK // (BEAMS * len(world.segments)))
        return np.vstack(
            [self._cast(world.segments, poses[i : i + rows]) for i in range(0, len(poses), rows)]
        )

    def scan(self, world: World, poses: Array, rng: np.random.Generator) -> Array:
        """Ranges as the scanner reports them, (m, 180) metres."""
        ranges = self.exact(world, poses)
        ranges = ranges + rng.normal(0, self.noise, ranges.shape) * (ranges < self.reach)
        ranges[rng.random(ranges.shape) < self.dropouts] = self.reach
        return np.clip(ranges, 0.01, self.reach)

    def _cast(self, segments: Array, poses: Array) -> Array:
        """The distance from each pose to the nearest wall along each beam, (m, 180) metres."""
        near = _near(segments, poses, self.reach)
        nearest: Array = np.minimum(
            meetings(near, poses, BEARINGS).min(axis=2, initial=np.inf), self.reach
        )
        return nearest


def _near(segments: Array, poses: Array, reach: float) -> Array:
    """The walls that a laser may see from poses: those whose boxes are at most `reach` off the box of the poses."""
    low, high = poses[:, :2].min(0) - reach, poses[:, :2].max(0) + reach
    ends, others = segments[:, :2], segments[:, 2:]
    near: Array = segments[
        (np.minimum(ends, others) <= high).all(1) & (np.maximum(ends, others) >= low).all(1)
    ]
    return near


def meetings(segments: Array, poses: Array, bearings: Array) -> Array:
    """The distance from each of m poses, along each of b bearings, to each of w walls, (m, b, w) metres; infinity where the ray does not meet the wall."""
    angles = poses[:, 2, None] + bearings
    dx, dy = np.cos(angles)[:, :, None], np.sin(angles)[:, :, None]
    ax = segments[:, 0] - poses[:, 0, None]
    ay = segments[:, 1] - poses[:, 1, None]
    ex, ey = segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1]
    # The ray r (dx, dy) meets the wall a + s e, 0 <= s <= 1, where r (dx, dy) = a + s e. Cross products with e and with (dx, dy) yield r and s.
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / (dx * ey - dy * ex)
        r = (ax * ey - ay * ex)[:, None, :] * inverse
        s = (ax[:, None, :] * dy - ay[:, None, :] * dx) * inverse
        hit = (r > 0) & (s >= 0) & (s <= 1)
    return np.where(hit, r, np.inf)
