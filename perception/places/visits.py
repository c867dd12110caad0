"""A stay of a robot at a distinctive place, and the ways out of the place."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from perception.places.local_map import PackedPatch
from perception.places.track import Array
from ssh_abduction.data.odometry import radians_between

# Two ways out whose bearings differ by less than this, in radians, are one.
MERGED = math.radians(45)
# Junctions are one place within SAME metres, or within this share of the smaller radius.
SAME, SHARE = 0.6, 0.5


@dataclass(frozen=True, slots=True)
class Way:
    """A way out of a place.

    Attributes:
        bearing: Direction in radians, counterclockwise in the frame of the track.
        sure: Whether the way certainly is a gateway. Few local maps show an uncertain one.
    """

    bearing: float
    sure: bool = True


@dataclass(frozen=True, eq=False)
class Visit:
    """A stay at a distinctive place.

    Attributes:
        scan: Index of the scan nearest to the middle.
        middle: (x, y) middle of the place in metres, in the frame of the track.
        begin: Index of the first scan of the stay.
        end: Index of the last scan of the stay.
        radius: Radius of the disc of the place in metres.
        ways: Ways out, counterclockwise.
        arrived: Index in `ways` of the way by which the robot came; None at the beginning of the
            log.
        left: Index in `ways` of the way by which the robot left; None at the end of the log.
        support: Share of the local maps nearby that show the place, from 0 to 1.
        patch: Local map around the middle, or around that of a visit near it; None while the visit
            is not final.
    """

    scan: int
    middle: Array
    begin: int
    end: int
    radius: float = 0.5
    ways: tuple[Way, ...] = ()
    arrived: int | None = None
    left: int | None = None
    support: float = 1.0
    patch: PackedPatch | None = None

    def later(self, scans: int) -> Visit:
        """Copy the visit, with its indices of scans increased by `scans`."""
        return replace(self, scan=self.scan + scans, begin=self.begin + scans, end=self.end + scans)

    def is_near(self, other: Visit) -> bool:
        """Whether the middles of two visits are so near that they may be one place."""
        near = max(SAME, SHARE * max(self.radius, other.radius))
        return math.dist(self.middle, other.middle) < near

    def joined(self, last: Visit) -> Visit:
        """Make one visit of two successive visits to the same place."""
        ways = list(self.ways)
        left = None if last.left is None else taken(ways, last.ways[last.left].bearing)
        return replace(self, end=last.end, ways=tuple(ways), left=left).in_order()

    def in_order(self) -> Visit:
        """The visit with its ways in counterclockwise order."""
        order = sorted(range(len(self.ways)), key=lambda k: self.ways[k].bearing)
        arrived, left = (None if k is None else order.index(k) for k in (self.arrived, self.left))
        return replace(self, ways=tuple(self.ways[k] for k in order), arrived=arrived, left=left)


def patches_of(visits: Sequence[Visit]) -> list[PackedPatch]:
    """Return the local map of each visit. Raises ValueError if one has none."""
    found = [visit.patch for visit in visits if visit.patch is not None]
    if len(found) < len(visits):
        number = next(i for i, visit in enumerate(visits) if visit.patch is None)
        raise ValueError(
            f"visits: expected visits with their local maps, got none for visit {number}; take "
            "those of find_visits or stream_visits"
        )
    return found


def taken(ways: list[Way], bearing: float) -> int:
    """Find the way out that the robot took, by its bearing in radians, as an index of `ways`.

    The way with nearly this bearing becomes sure. If there is none, a new way is added.
    """
    near = [k for k in range(len(ways)) if radians_between(ways[k].bearing, bearing) < MERGED]
    if not near:
        ways.append(Way(bearing))
        return len(ways) - 1
    k = min(near, key=lambda k: radians_between(ways[k].bearing, bearing))
    ways[k] = replace(ways[k], sure=True)
    return k
