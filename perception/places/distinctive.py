"""Finds the distinctive places that a robot passes: junctions, turning points, and the two ends.

Milestones are scans a metre apart on the trajectory. The local map of each milestone has a
skeleton with junctions. Junctions near each other at successive milestones form a chain. A junction
has a disc, which reaches to the nearest obstacle. The disc of a chain has the median middle and the
median radius of its junctions. If the robot drives through this disc, and half of the local maps
nearby show the junction, this is a visit. The robot comes and leaves where its trajectory crosses
the disc.

`Stays` completes these visits: one for each stay, with turning points and gateways. A drive begins
and ends in dead ends of its trajectory. So both are turning points, too.

Visits are found while the robot drives. A visit is final when the robot is at most DELAY metres
beyond its last scan. Only the last scans, the open chains and the visits that are not final yet are
kept.
"""

from __future__ import annotations

import copy
import math
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from perception.places.following import Followed
from perception.places.local_map import LocalMaps, PackedPatch, Patch, Recent
from perception.places.skeleton import Junction, junctions
from perception.places.track import Array, Track
from perception.readers.scans import RobotLog, Scan
from ssh_abduction.data.odometry import Pose, radians_between

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
            "those of find_visits"
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


# The robot turned around if its directions of motion over some stride in metres, before and after,
# differ by more than REVERSED radians. It turns on the spot or in a curve, so there are several
# strides. Other visits are farther away along the trajectory than a stride and than their radius.
STRIDES, REVERSED = (1.0, 2.0, 4.0), math.radians(135)
# The beginning and the end of a drive are turning points, too, if the robot visits no place within
# END metres of trajectory.
END = 2.0
# A turn waits for visits up to NEARBY metres of trajectory away. No stride is longer, and discs are
# assumed to be no larger. Turns near each other wait for each other up to TURNING metres.
NEARBY, TURNING = 4.0, 8.0
# A robot that comes back within STAY metres after it left a disc, and visited no other place, did
# not leave the place.
STAY = 16.0
# The robot crosses a disc within AROUND metres before and after the scan nearest to the middle.
AROUND = 16.0
# The bearing of a way out is measured RIM metres outside of the disc. A radius of the disc below
# SMALL metres counts as SMALL.
RIM, SMALL = 0.5, 0.5
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
    breaks, finder = set(track.breaks), VisitFinder(width)
    posed = (Followed(scan, track.pose(i), broken=i in breaks) for i, scan in enumerate(log.scans))
    return tuple(visit for one in (*posed, None) for visit in finder.add(one))


class VisitFinder:
    """Finds the visits to distinctive places while a robot drives.

    Each unbroken part of the track is searched separately. The scans of a visit are counted from 0
    over all that were added. The width of the robot is in metres.
    """

    def __init__(self, width: float = WIDTH) -> None:
        self._width, self._detector = width, _Detector(width)
        self._begin = self._count = 0  # the first scan of this part, and the number of all

    def add(self, one: Followed | None) -> list[Visit]:
        """Add the next scan, and return the visits that are final now. None ends the drive."""
        found: list[Visit] = []
        if one is None or one.broken:
            found += (visit.later(self._begin) for visit in self._detector.finish())
            self._detector, self._begin = _Detector(self._width), self._count
        if one is not None:
            found += (visit.later(self._begin) for visit in self._detector.add(one.scan, one.pose))
            self._count += 1
        return found

    def around(self, behind: float) -> tuple[Patch, Array] | None:
        """The local map around the robot's position this many metres ago, and that position.

        The position is (x, y) in metres on the track. None if this part of the track is shorter.
        """
        return self._detector.around(behind)

    def expected(self) -> list[Visit]:
        """The visits that would follow if the drive ended now. Nothing is changed."""
        return copy.deepcopy(self).add(None)


class _Detector:
    """Finds the visits in an unbroken part of a drive."""

    def __init__(self, width: float) -> None:
        self._room = width / 2
        self._recent = Recent()
        self._maps = LocalMaps(self._recent, WINDOW)
        self._stays = Stays(self._recent, self._maps, HALF)
        self._milestones: list[int] = []  # scans
        self._seen = 0  # the number of the next milestone, which has no local map yet
        self._open: list[_Chain] = []
        self._chains = 0  # how many chains there were
        self._found: list[tuple[int, int, int, Visit]] = []  # by scan, chain and pass

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
            # Forget scans that are too old for any further visit.
            oldest = recent.way(min(self._horizon, self._stays.done))
            recent.drop_before(recent.at(oldest - AROUND))

    def finish(self) -> Iterator[Visit]:
        """End the drive, and yield all visits that are left."""
        while (at := self._next) is not None:
            self._look(at)
        for chain in list(self._open):
            self._end(chain)
        yield from self._stays.add(self._released(self._recent.end), None)

    def around(self, behind: float) -> tuple[Patch, Array] | None:
        """As `VisitFinder.around`."""
        recent = self._recent
        way = recent.way(recent.end - 1) - behind
        if way < 0:
            return None
        return self._map_at(recent.at(way))

    def _map_at(self, scan: int) -> tuple[Patch, Array]:
        """The local map around the position of the robot at a scan, and this position."""
        here = self._recent.poses(scan, scan + 1)[0, :2]
        return self._maps.around(scan, here, HALF), here

    @property
    def _next(self) -> int | None:
        """The scan of the next milestone; None if the robot has not reached it."""
        return self._milestones[self._seen] if self._seen < len(self._milestones) else None

    @property
    def _horizon(self) -> int:
        """The earliest scan at which a visit that is not found yet can begin."""
        last = self._recent.way(self._milestones[self._seen - 1])
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
                self._open_chain([sighting])
        # A chain ends when its junction is out of sight, or when it is too long to wait for.
        for chain in list(self._open):
            if milestone - chain.last >= GAP:
                self._end(chain)
            elif way - chain.sightings[0].way >= LIFE:
                self._end(chain)
                late = [one for one in chain.sightings if one.way >= way - 2 * BESIDE]
                if late:
                    self._open_chain(late)

    def _open_chain(self, sightings: list[_Sighting]) -> None:
        self._open.append(_Chain(self._chains, sightings))
        self._chains += 1

    def _junctions_at(self, scan: int) -> list[Junction]:
        """The junctions near the robot in the local map of a scan, the largest first."""
        patch, here = self._map_at(scan)
        found = junctions(patch, self._room)
        near = [junction for junction in found if math.dist(junction.middle, here) <= SEEN]
        return sorted(near, key=lambda junction: -junction.radius)

    def _end(self, chain: _Chain) -> None:
        """Close a chain, and find its visits."""
        self._open.remove(chain)
        if len(chain.sightings) > 1:
            for k, visit in enumerate(self._passes(chain)):
                self._found.append((visit.scan, chain.number, k, visit))

    def _released(self, horizon: int) -> list[Visit]:
        """Remove and return the visits before a scan, in order."""
        self._found.sort(key=lambda found: found[:3])
        count = bisect_left(self._found, horizon, key=lambda found: found[0])
        released, self._found = self._found[:count], self._found[count:]
        return [visit for *_, visit in released]

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
        way, first = self._recent.way(scan), bisect_left(self._milestones, self._recent.begin)
        return {
            number
            for number, at in enumerate(self._milestones[first:], first)
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


@dataclass(frozen=True)
class _TurningPoint:
    """A scan at which the robot turned around, or at which the drive begins or ends.

    `way` is in metres. Over `stride` metres before and after the scan, directions differ by
    `angle`.
    """

    way: float
    stride: float
    angle: float
    scan: int


class Stays:
    """Turns the visits that chains of junctions show into final visits.

    The local map of a visit reaches `half` metres to each side.
    """

    def __init__(self, recent: Recent, maps: LocalMaps, half: float) -> None:
        self._recent, self._maps, self._half = recent, maps, half
        self._passing: Visit | None = None  # the last visit, which the next one may replace
        self._found: list[tuple[float, Visit]] = []  # the metres driven up to each visit
        self._turns = [_TurningPoint(0.0, END, math.pi, 0)]
        self._asked = dict.fromkeys(STRIDES, 0)  # the next scan that may be a turn
        self.done = 0  # all visits before this scan are complete
        self._staying: Visit | None = None
        self._left = 0.0  # metres driven at the end of the stay

    def add(self, visits: Sequence[Visit], horizon: int | None) -> Iterator[Visit]:
        """Add the next visits, in the order of their scans, and yield those that are final.

        No visit will come that begins before the scan `horizon`; None at the end of the drive.
        """
        for visit in visits:
            self._pass(visit)
        if self._passing and (horizon is None or not self._may_overlap(self._passing, horizon)):
            self._settle()
        self._find_turns()
        if horizon is None and (last := self._recent.end - 1) >= 0:
            self._turns.append(_TurningPoint(self._recent.way(last), END, math.pi, last))
        for visit in self._complete(self._limit(horizon)):
            if self._staying and self._comes_back(visit):
                self._staying = self._staying.joined(visit)
            else:
                yield from [self._staying] if self._staying else []
                patch = self._maps.around(visit.scan, visit.middle, self._half)
                self._staying = replace(visit, patch=PackedPatch.of(patch))
            self._left = self._recent.way(visit.end)
        if self._staying and (horizon is None or self._recent.way(self.done) > self._left + STAY):
            yield self._staying
            self._staying = None

    def _pass(self, visit: Visit) -> None:
        """Keep one of successive visits that overlap and are too close for two places.

        The visit with the largest product of support (number of scans) and radius is kept.
        """
        last = self._passing
        near = last is not None and last.is_near(visit)
        if last is None or not near or not self._may_overlap(last, visit.scan, visit.begin):
            self._settle()
            self._passing = visit
        elif visit.support * visit.radius > last.support * last.radius:
            self._passing = replace(visit, begin=min(visit.begin, last.begin))

    def _may_overlap(self, last: Visit, scan: int, begin: int | None = None) -> bool:
        """Whether a visit may overlap with `last`, the visit before it.

        `scan` is the scan of the visit nearest to its middle, and `begin` its first scan. If the
        visit is not known yet, `scan` is the earliest possible first scan, and `begin` is None.
        """
        soon = self._recent.way(scan) <= self._recent.way(last.scan) + STAY
        return soon and (scan if begin is None else begin) <= last.end + 2

    def _settle(self) -> None:
        """Add the last visit to those that were found: the next visit will not replace it."""
        if self._passing:
            self._found.append((self._recent.way(self._passing.scan), self._passing))
        self._passing = None

    def _find_turns(self) -> None:
        """Find the next scans at which the robot turned around."""
        recent, here = self._recent, self._recent.end - 1
        for stride in STRIDES:
            while recent.way(here) >= (way := recent.way(self._asked[stride])) + stride:
                angle = self._angle(self._asked[stride], stride) if way >= stride else 0.0
                if angle > REVERSED:
                    self._turns.append(_TurningPoint(way, stride, angle, self._asked[stride]))
                self._asked[stride] += 1
        self._turns.sort(key=lambda turn: turn.scan)

    def _angle(self, scan: int, stride: float) -> float:
        """Compute by how many radians the robot turned at a scan.

        The result is 0 if the robot hardly moved in the stride before or after the scan.
        """
        recent, way = self._recent, self._recent.way(scan)
        before, after = recent.at(way - stride), recent.at(way + stride)
        (x, y, _), (x0, y0, _), (x1, y1, _) = (recent.pose(i) for i in (scan, before, after))
        if min(math.hypot(x - x0, y - y0), math.hypot(x1 - x, y1 - y)) <= stride / 3:
            return 0.0
        return radians_between(math.atan2(y - y0, x - x0), math.atan2(y1 - y, x1 - x))

    def _limit(self, horizon: int | None) -> int:
        """Find the scan before which all visits and turns can be completed now."""
        recent = self._recent
        if horizon is None:
            return recent.end
        known = self._passing.scan if self._passing else horizon
        limit = min(
            recent.at(recent.way(known) - NEARBY),
            recent.at(recent.way(min(self._asked.values())) - NEARBY),
            recent.at(recent.way(recent.end - 1) - AROUND),
        )
        return max(self.done, self._before_turns(limit))

    def _before_turns(self, limit: int) -> int:
        """Find the last scan up to a limit that does not separate turns near each other."""
        first: _TurningPoint | None = None  # of the turns near each other
        last = -math.inf
        for turn in self._turns:
            if first is None or turn.way - last > NEARBY or turn.way - first.way > TURNING:
                first = turn
            if turn.scan >= limit:
                return min(limit, first.scan)
            last = turn.way
        return limit

    def _complete(self, limit: int) -> list[Visit]:
        """Complete the next visits before a scan, in order. Add turning points far from visits."""
        # Begin with the shortest stride and the sharpest turn. Other turns near it belong to the
        # same turning point.
        for turn in sorted(self._turns, key=lambda turn: (turn.stride, -turn.angle, -turn.scan)):
            if turn.scan < limit and self._is_apart(turn):
                self._add_turn(turn.scan)
        done = [visit for _, visit in self._found if self.done <= visit.scan < limit]
        done.sort(key=lambda visit: visit.scan)
        completed = [self._with_gateways(visit) for visit in done]
        # Visits are remembered until turns near them are decided.
        least = self._recent.way(min(limit, self._recent.end - 1)) - NEARBY
        self._found = [(way, visit) for way, visit in self._found if way >= least]
        self._turns = [turn for turn in self._turns if turn.scan >= limit]
        self.done = limit
        return completed

    def _is_apart(self, turn: _TurningPoint) -> bool:
        """Whether a turn is neither in the disc of a place nor close to a visit along the way."""
        here = self._recent.poses(turn.scan, turn.scan + 1)[0, :2]
        for at, visit in self._found:
            far = abs(at - turn.way)
            inside = math.dist(here, visit.middle) <= visit.radius + RIM
            if far <= turn.stride or (inside and far <= visit.radius):
                return False
        return self._recent.way(self._recent.end - 1) > turn.stride

    def _add_turn(self, scan: int) -> None:
        """Add a visit where the robot turned around. It splits a stay that it is part of."""
        parts = [part for _, visit in self._found for part in self._split(visit, scan)]
        position = self._recent.poses(scan, scan + 1)[0, :2].copy()
        parts.append(Visit(scan, position, scan, scan, support=0.0))
        self._found = [(self._recent.way(visit.scan), visit) for visit in parts]

    def _split(self, visit: Visit, scan: int) -> Iterator[Visit]:
        """Split a visit at a turn, and yield the parts that pass through the disc of the place."""
        begin = max(visit.begin, self._recent.begin)
        if not begin < scan < visit.end:
            yield visit
            return
        for first, last in ((begin, scan), (scan, visit.end)):
            far = np.hypot(*(self._recent.poses(first, last + 1)[:, :2] - visit.middle).T)
            if far.min() <= visit.radius:
                nearest = first + int(far.argmin())
                yield replace(visit, scan=nearest, begin=first, end=last)

    def _with_gateways(self, visit: Visit) -> Visit:
        """Complete a visit with the ways by which the robot entered and left the disc."""
        ways, numbers = list(visit.ways), []
        for side in (-1, 1):
            bearing = self._crossing(visit, side)
            numbers.append(None if bearing is None else taken(ways, bearing))
        return replace(visit, ways=tuple(ways), arrived=numbers[0], left=numbers[1]).in_order()

    def _crossing(self, visit: Visit, side: int) -> float | None:
        """The direction in radians in which the robot enters (-1) or leaves (1) a place's disc.

        None if the log begins or ends in the disc.
        """
        way = self._recent.way(visit.scan)
        turns = [one.scan for _, one in self._found if not one.support]
        begin = max([self._recent.at(way - AROUND), *(i for i in turns if i < visit.scan)])
        end = min(
            [self._recent.at(way + AROUND, "right"), *(i + 1 for i in turns if i > visit.scan)]
        )
        part = (begin, visit.scan + 1) if side < 0 else (visit.scan, end)
        onward = (self._recent.poses(*part)[:, :2] - visit.middle)[::side]
        outside = np.flatnonzero(np.hypot(*onward.T) >= max(visit.radius, SMALL) + RIM)
        if not len(outside) and (begin == 0 if side < 0 else end == self._recent.end):
            return None
        x, y = onward[outside[0] if len(outside) else -1]
        return math.atan2(y, x)

    def _comes_back(self, visit: Visit) -> bool:
        """Whether a visit continues the last one: the robot left the disc, and soon came back."""
        last = self._staying
        soon = self._recent.way(visit.scan) <= self._left + STAY
        return last is not None and soon and last.is_near(visit)
