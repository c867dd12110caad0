"""Estimates the scale of a building from the passages that the robot drove through."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from perception.places.local_map import LocalMaps
from perception.places.track import Track
from perception.readers.scans import Scan

# Passages are measured once every this many metres.
EVERY = 0.5
# Largest measured distance to either side, in metres.
ASIDE = 6.0
# Percentiles of the width along the trajectory for narrow passages and for corridors.
NARROW, CORRIDOR = 5, 20
# Percentile of the width along the trajectory for `Scale.most`.
MOST = 30
# A gateway is at least this share of a narrow passage wide. Walls look thicker in a grid than they
# are, and the robot needs less room than it had.
SHARE = 0.75
# The radius of a place in corridor widths: beyond the mouths of its gateways, but not as far as the
# next place.
RADII = 3.2
# Limits of the radius in metres. It is also limited by the range of the laser.
RADIUS = (3.0, 8.0)


@dataclass(frozen=True)
class Scale:
    """The scale of a building: lengths in metres that the search for distinctive places uses.

    Attributes:
        gateway: Smallest width of a gateway.
        radius: Distance that an exit must lead from the middle of a place.
        most: Width of the free space that most of the trajectory exceeds.
        doors: Whether places are the doors between rooms, instead of forks and bends of corridors.
    """

    gateway: float
    radius: float
    most: float = 0.0
    doors: bool = False

    @property
    def doubtful(self) -> float:
        """The smallest width of an uncertain gateway in metres; it is less than `gateway`."""
        return 0.6 * self.gateway

    @property
    def window(self) -> float:
        """Metres of trajectory before and after a scan that its local map is made from."""
        return 2 * self.radius

    @property
    def half(self) -> float:
        """Half the side of the square local map around a place, in metres."""
        return 2 * self.radius + 2


def suggested(scans: Sequence[Scan], track: Track) -> Scale:
    """Estimate the scale of a building from the free width along the robot's trajectory.

    The gateway is set a little below the width of the narrowest passages, and the radius to a few
    corridor widths.

    Args:
        scans: Scans of the log.
        track: Their poses.
    """
    maps = LocalMaps(scans, track, ASIDE)
    widths = []
    # Measure the free width across the trajectory at each milestone.
    for i in milestones(track, EVERY)[1:-1]:
        ahead = track.poses[min(i + 1, len(track.poses) - 1), :2] - track.poses[i - 1, :2]
        if (length := math.hypot(*ahead)) > 0.2:
            patch = maps.around(i, track.poses[i, :2], ASIDE + 1)
            left = np.array([-ahead[1], ahead[0]]) / length
            widths.append(
                float(patch.free_along(track.poses[i, :2], np.stack([left, -left]), ASIDE).sum())
            )
    reach = float(np.median([scan.laser.reach for scan in scans]))
    narrow, corridor, most = (
        np.percentile(widths, [NARROW, CORRIDOR, MOST]) if widths else (1.2, 1.7, 1.7)
    )
    return Scale(
        gateway=round(float(np.clip(SHARE * narrow, 0.5, 2.0)), 2),
        radius=round(float(np.clip(RADII * corridor, RADIUS[0], np.clip(reach, *RADIUS))), 2),
        most=round(float(most), 2),
    )


def milestones(track: Track, every: float) -> list[int]:
    """Choose scans along the trajectory, one after each `every` metres or more.

    Returns:
        Indices of scans, ascending; the first is 0.
    """
    kept = [0]
    for i, way in enumerate(track.way):
        if way - track.way[kept[-1]] >= every:
            kept.append(i)
    return kept
