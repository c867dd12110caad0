"""At which scale a building is to be looked at: the log itself suggests it, by the passages that the robot drove through."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from perception.places.local_map import LocalMaps
from perception.places.track import Track
from perception.readers.scans import Scan

# Passages are measured once in so many metres.
EVERY = 0.5
# And no farther to either side than this, in metres.
ASIDE = 6.0
# The narrow passages of the way are those at this percentile, and its corridors those at this one.
NARROW, CORRIDOR = 5, 20
# Most of the way is at least as wide as this percentile.
MOST = 30
# A gateway is at least such a share of a narrow passage wide: walls look thicker in a grid than they are, and the robot needs less room than it had.
SHARE = 0.75
# A place is looked at from its middle to so many corridor widths away: beyond the mouths of its gateways, and not as far as the next place.
RADII = 3.2
# That is so many metres at least and at most. It is also no farther than the laser reaches: whether a way leads on there, nothing tells.
RADIUS = (3.0, 8.0)


@dataclass(frozen=True)
class Scale:
    """What the distinctive places of a building are measured by, in metres.

    gateway   the least width of a way out that counts as a gateway
    radius    how far a way out must lead from the middle of a place
    most      most of the robot's way is at least so wide
    doors     whether the places of the building are the doors between its rooms; if not, they are where ways part or bend
    """

    gateway: float
    radius: float
    most: float = 0.0
    doors: bool = False

    @property
    def doubtful(self) -> float:
        """Ways out that are narrower than a gateway, but at least this wide, may be gateways."""
        return 0.6 * self.gateway

    @property
    def window(self) -> float:
        """Metres of the way before and after a scan from which its local map is made."""
        return 2 * self.radius

    @property
    def half(self) -> float:
        """Half the side of a local map around a place."""
        return 2 * self.radius + 2


def suggested(scans: Sequence[Scan], track: Track) -> Scale:
    """The scale that the robot's own way suggests: gateways nearly as narrow as the narrowest passages, places a few corridor widths large."""
    maps = LocalMaps(scans, track, ASIDE)
    widths = []
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
    """Scans that are at least so many metres of the way apart."""
    kept = [0]
    for i, way in enumerate(track.way):
        if way - track.way[kept[-1]] >= every:
            kept.append(i)
    return kept
