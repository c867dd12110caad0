"""Finds the distinctive places that a robot passes: junctions, turning points, and the two ends.

Milestones are scans a metre apart on the trajectory. The local map of each milestone has a
skeleton with junctions. Junctions near each other at successive milestones form a chain. A junction
has a disc, which reaches to the nearest obstacle. The disc of a chain has the median middle and the
median radius of its junctions. If the robot drives through this disc, and half of the local maps
nearby show the junction, this is a visit. The robot comes and leaves where its trajectory crosses
the disc.

Visits are found while the robot drives. A visit is final when the robot is at most DELAY metres
beyond its last scan. Only the last scans, the open chains and the visits that are not final yet are
kept.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np

from perception.places.following import Followed
from perception.places.local_map import LocalMaps
from perception.places.recent import Recent
from perception.places.skeleton import Junction, junctions
from perception.places.stays import AROUND, RIM, SAME, SHARE, SMALL, Stays
from perception.places.track import Array, Track
from perception.places.visits import MERGED, Visit, Way
from perception.readers.scans import RobotLog, Scan
from perception.readers.stored import in_turn
from ssh_abduction.data.odometry import Pose, radians_between

# The usual width of a robot in metres. It has to fit through the doors that the robot uses.
WIDTH = 0.5
# Milestones are EVERY metres apart. Their local maps have the scans of WINDOW metres before and
# after them, and reach HALF metres to each side.
EVERY, WINDOW, HALF = 1.0, 8.0, 8.0
# Junctions farther than this from the robot, in metres, are too uncertain.
SEEN = 5.0
# A chain ends if GAP milestones in a row do not show it. While it is open, its middle is the median
# of its last RECENT sightings.
GAP, RECENT = 4, 9
# A chain that is LIFE metres long ends, too. Another one begins with its last sightings.
LIFE = 60.0
# The robot visits a place within this distance in metres, even if its disc is smaller. It has left
# at LEFT metres outside of the disc.
PASSING, LEFT = 0.75, 0.5
# Milestones within BESIDE metres along the trajectory are asked about a place. At least a share of
# AGREED has to show it.
BESIDE, AGREED = 3.0, 0.5
# A visit is final at most this many metres after its end, if scans are at most 0.5 m apart. This is
# the sum of WINDOW (its local map is complete), LIFE and GAP (its chain ends), and twice STAY and
# TURNING (no visit or turn nearby can change it). The spacing of scans and milestones adds 5 m.
DELAY = 125.0


def find_visits(log: RobotLog, track: Track, width: float = WIDTH) -> tuple[Visit, ...]:
    """Find the visits to distinctive places in a log, in order. Corrected poses are not read.

    The width of the robot is in metres.
    """
    breaks = set(track.breaks)
    posed = (
        Followed(scan, track.pose(i), broken=i in breaks)
        for i, scan in enumerate(in_turn(log.scans))
    )
    return tuple(visits_of(posed, width))


def visits_of(posed: Iterable[Followed], width: float = WIDTH) -> Iterator[Visit]:
    """Find the visits to distinctive places while a robot drives. Yield each when it is final.

    Each unbroken part of the track is searched separately. The scans of a visit are counted
    from 0 over all of `posed`. The width of the robot is in metres.
    """
    detector, begin = _Detector(width), 0
    for number, one in enumerate(posed):
        if one.broken:
            yield from (visit.later(begin) for visit in detector.finish())
            detector, begin = _Detector(width), number
        yield from (visit.later(begin) for visit in detector.add(one.scan, one.pose))
    yield from (visit.later(begin) for visit in detector.finish())


class _Detector:
    """Finds the visits in an unbroken part of a drive."""

    def __init__(self, width: float) -> None:
        self._room = width / 2
        self._recent = Recent()
        self._maps = LocalMaps(self._recent, WINDOW)
        self._stays = Stays(self._recent, self._maps, HALF)
        self._milestones: list[int] = []  # scans; those after the first _seen have no local map yet
        self._first = self._seen = 0  # numbers of the first milestone that is kept, and of the next
        self._open: list[_Chain] = []
        self._numbers = count()
        self._found: list[tuple[int, int, int, Visit]] = []  # a heap by scan, chain and pass

    def add(self, scan: Scan, pose: Pose) -> Iterator[Visit]:
        """Add the next scan, and yield the visits that are final now."""
        recent = self._recent
        recent.append(scan, pose)
        here = recent.end - 1
        if not self._milestones or (recent.way(here) - recent.way(self._milestones[-1]) >= EVERY):
            self._milestones.append(here)
        # The local map of a milestone needs the scans up to WINDOW metres after it.
        while (at := self._next) is not None and recent.way(here) > recent.way(at) + WINDOW:
            self._look(at)
            yield from self._stays.add(self._released(self._horizon), self._horizon)
            self._forget()

    def finish(self) -> Iterator[Visit]:
        """End the drive, and yield all visits that are left."""
        while (at := self._next) is not None:
            self._look(at)
        for chain in list(self._open):
            self._end(chain)
        yield from self._stays.add(self._released(self._recent.end), None)

    @property
    def _next(self) -> int | None:
        """The scan of the next milestone; None if the robot has not reached it."""
        k = self._seen - self._first
        return self._milestones[k] if k < len(self._milestones) else None

    @property
    def _horizon(self) -> int:
        """The earliest scan at which a visit that is not found yet can begin."""
        last = self._recent.way(self._milestones[self._seen - self._first - 1])
        first = min([last, *(chain.sightings[0].way for chain in self._open)])
        return self._recent.at(first - GAP * EVERY)

    def _look(self, at: int) -> None:
        """Chain the junctions in the local map of the next milestone, and end old chains."""
        milestone, way = self._seen, self._recent.way(at)
        self._seen += 1
        continued = [(chain, chain.middle(RECENT), chain.radius(RECENT)) for chain in self._open]
        for junction in self._junctions_at(at):
            near = [
                (far, number)
                for number, (chain, middle, radius) in enumerate(continued)
                if chain.last < milestone
                and (far := _distance(middle, radius, junction)) is not None
            ]
            sighting = _Sighting(milestone, way, junction)
            if near:
                continued[min(near)[1]][0].sightings.append(sighting)
            else:
                self._open.append(_Chain(next(self._numbers), [sighting]))
        # A chain ends when its junction is out of sight, or when it is too long to wait for.
        for chain in list(self._open):
            if milestone - chain.last >= GAP:
                self._end(chain)
            elif way - chain.sightings[0].way >= LIFE:
                self._end(chain)
                late = [one for one in chain.sightings if one.way >= way - 2 * BESIDE]
                if late:
                    self._open.append(_Chain(next(self._numbers), late))

    def _junctions_at(self, scan: int) -> list[Junction]:
        """The junctions near the robot in the local map of a scan, the largest first."""
        here = self._recent.poses(scan, scan + 1)[0, :2]
        found = junctions(self._maps.around(scan, here, HALF), self._room)
        near = [junction for junction in found if math.dist(junction.middle, here) <= SEEN]
        return sorted(near, key=lambda junction: -junction.radius)

    def _end(self, chain: _Chain) -> None:
        """Close a chain, and find its visits."""
        self._open.remove(chain)
        if len(chain.sightings) > 1:
            for k, visit in enumerate(self._passes(chain)):
                heapq.heappush(self._found, (visit.scan, chain.number, k, visit))

    def _released(self, horizon: int) -> list[Visit]:
        """Remove and return the visits before a scan, in order."""
        released = []
        while self._found and self._found[0][0] < horizon:
            released.append(heapq.heappop(self._found)[-1])
        return released

    def _forget(self) -> None:
        """Forget scans and milestones that are too old for any further visit."""
        oldest = self._recent.way(min(self._horizon, self._stays.oldest))
        self._recent.drop_before(self._recent.at(oldest - AROUND))
        while self._milestones[0] < self._recent.begin:
            del self._milestones[0]
            self._first += 1

    def _passes(self, chain: _Chain) -> Iterator[Visit]:
        """Yield a visit for each time that the robot drives through the disc of a junction."""
        recent, sightings = self._recent, chain.sightings
        first = recent.at(sightings[0].way - GAP * EVERY)
        last = recent.at(sightings[-1].way + GAP * EVERY, "right")
        middle, radius = chain.middle(), chain.radius()
        far = np.hypot(*(recent.poses(first, last)[:, :2] - middle).T)
        for begin, end in _stays(far, max(PASSING, radius)):
            scan = first + begin + int(far[begin : end + 1].argmin())
            near = self._near(scan, middle)
            mine = [sighting for sighting in sightings if sighting.milestone in near]
            if mine and len(mine) >= AGREED * len(near):
                stay, ways = (first + begin, first + end), _ways(mine, radius)
                support = len(mine) / len(near)
                yield Visit(scan, _middle(mine), *stay, radius, ways, support=support)

    def _near(self, scan: int, middle: Array) -> set[int]:
        """The numbers of the milestones near a scan at which the middle of a place can be seen."""
        way = self._recent.way(scan)
        return {
            number
            for number, at in enumerate(self._milestones, self._first)
            if abs(self._recent.way(at) - way) <= BESIDE
            and math.dist(self._recent.poses(at, at + 1)[0, :2], middle) < SEEN - 0.5
        }


@dataclass(frozen=True, eq=False)
class _Sighting:
    """A junction in the local map of a numbered milestone, after `way` metres."""

    milestone: int
    way: float
    junction: Junction


@dataclass(eq=False)
class _Chain:
    """Sightings of one junction at successive milestones. Chains are numbered in order of start."""

    number: int
    sightings: list[_Sighting]

    @property
    def last(self) -> int:
        return self.sightings[-1].milestone

    def middle(self, recent: int = 0) -> Array:
        """The median of the middles, (2,) in metres: of all, or of the last `recent` ones."""
        return _middle(self.sightings[-recent:])

    def radius(self, recent: int = 0) -> float:
        """The median of the radii in metres: of all, or of the last `recent` ones."""
        radii = [sighting.junction.radius for sighting in self.sightings[-recent:]]
        return float(np.median(radii))


def _middle(sightings: Sequence[_Sighting]) -> Array:
    return np.asarray(np.median([one.junction.middle for one in sightings], axis=0))


def _distance(middle: Array, radius: float, junction: Junction) -> float | None:
    """The metres from a junction to the middle of a chain; None if they are two places."""
    far = math.dist(middle, junction.middle)
    return far if far < max(SAME, SHARE * min(radius, junction.radius)) else None


def _stays(far: Array, radius: float) -> Iterator[tuple[int, int]]:
    """Yield the first and last index of each stay in the disc of a place.

    A stay ends where the robot is more than `LEFT` metres outside of the disc. `far` has the
    distance of the robot from its middle at each scan, (n,) metres.
    """
    begin = None
    for i, distance in enumerate(far.tolist()):
        if begin is None and distance <= radius:
            begin = i
        elif begin is not None and distance > radius + LEFT:
            yield begin, i
            begin = None
    if begin is not None:
        yield begin, len(far) - 1


def _ways(sightings: Sequence[_Sighting], radius: float) -> tuple[Way, ...]:
    """Find the ways out of a place. A way is sure if at least half of the sightings show it."""
    groups: list[list[float]] = []
    for sighting in sightings:
        for bearing in _bearings(sighting.junction, radius):
            near = [group for group in groups if radians_between(_mean(group), bearing) < MERGED]
            if near:
                min(near, key=lambda group: radians_between(_mean(group), bearing)).append(bearing)
            else:
                groups.append([bearing])
    ways = [Way(_mean(group), len(group) >= AGREED * len(sightings)) for group in groups]
    return tuple(sorted(ways, key=lambda way: way.bearing))


def _mean(bearings: Sequence[float]) -> float:
    """The mean direction of bearings, in radians."""
    return float(np.angle(np.exp(1j * np.asarray(bearings)).sum()))


def _bearings(junction: Junction, radius: float) -> Iterator[float]:
    """The directions, in radians, in which the branches of a junction cross its disc."""
    for branch in junction.branches:
        far = np.hypot(*(branch - junction.middle).T)
        outside = np.flatnonzero(far >= max(radius, SMALL) + RIM)
        x, y = branch[outside[0] if len(outside) else -1] - junction.middle
        yield math.atan2(y, x)
