"""A stay of a robot at a distinctive place, and the ways out of the place."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from perception.places.local_map import PackedPatch
from perception.places.track import Array

# Two ways out whose bearings differ by less than this, in radians, are one.
MERGED = math.radians(45)


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
