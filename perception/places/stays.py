"""Completes the visits that were found: one for each stay, with turning points and gateways.

A drive begins and ends in dead ends of its trajectory. So both are turning points, too.

Visits are completed in order while the robot drives. Each visit is final after a bounded number of
metres.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from perception.places.local_map import LocalMaps, PackedPatch
from perception.places.recent import Recent
from perception.places.visits import MERGED, Visit, Way
from ssh_abduction.data.odometry import radians_between

# Junctions are one place within SAME metres, or within this share of the smaller radius.
SAME, SHARE = 0.6, 0.5
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
        self._done = 0  # all visits before this scan are complete
        self._staying: Visit | None = None
        self._left = 0.0  # metres driven at the end of the stay

    @property
    def oldest(self) -> int:
        """The first scan that may still become a visit."""
        return self._done

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
                self._staying = joined(self._staying, visit)
            else:
                yield from [self._staying] if self._staying else []
                patch = self._maps.around(visit.scan, visit.middle, self._half)
                self._staying = replace(visit, patch=PackedPatch.of(patch))
            self._left = self._recent.way(visit.end)
        if self._staying and (horizon is None or self._recent.way(self._done) > self._left + STAY):
            yield self._staying
            self._staying = None

    def _pass(self, visit: Visit) -> None:
        """Keep one of successive visits that overlap and are too close for two places.

        The visit with the largest product of support (number of scans) and radius is kept.
        """
        last = self._passing
        near = last is not None and are_near(last, visit)
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
        first, here, last = (recent.poses(i, i + 1)[0, :2] for i in (before, scan, after))
        there, back = here - first, last - here
        if min(math.hypot(*there), math.hypot(*back)) <= stride / 3:
            return 0.0
        return radians_between(math.atan2(there[1], there[0]), math.atan2(back[1], back[0]))

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
        return max(self._done, self._before_turns(limit))

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
        done = [visit for _, visit in self._found if self._done <= visit.scan < limit]
        done.sort(key=lambda visit: visit.scan)
        completed = [self._with_gateways(visit) for visit in done]
        # Visits are remembered until turns near them are decided.
        least = self._recent.way(min(limit, self._recent.end - 1)) - NEARBY
        self._found = [(way, visit) for way, visit in self._found if way >= least]
        self._turns = [turn for turn in self._turns if turn.scan >= limit]
        self._done = limit
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
        return with_ways_in_order(
            replace(visit, ways=tuple(ways), arrived=numbers[0], left=numbers[1])
        )

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
        return last is not None and soon and are_near(last, visit)


def are_near(first: Visit, second: Visit) -> bool:
    """Whether the middles of two visits are so near that they may be one place."""
    near = max(SAME, SHARE * max(first.radius, second.radius))
    return math.dist(first.middle, second.middle) < near


def joined(first: Visit, last: Visit) -> Visit:
    """Make one visit of two successive visits to the same place."""
    ways = list(first.ways)
    left = None if last.left is None else taken(ways, last.ways[last.left].bearing)
    return with_ways_in_order(replace(first, end=last.end, ways=tuple(ways), left=left))


def with_ways_in_order(visit: Visit) -> Visit:
    """The visit with its ways in counterclockwise order."""
    order = sorted(range(len(visit.ways)), key=lambda k: visit.ways[k].bearing)
    arrived, left = (None if k is None else order.index(k) for k in (visit.arrived, visit.left))
    return replace(visit, ways=tuple(visit.ways[k] for k in order), arrived=arrived, left=left)


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
