"""Finds partings: places where two stretches of a drive that ran together diverge.

In a wide corridor a robot changes its lane, or it leaves a hall at one side. The skeleton has no
junction there, but the robot made a choice. Closures say how stretches of the drive lie relative to
each other, so they show where two stretches diverge. If no known place is near, there is a new
place. Each stretch that passes it gets a visit.

Closures also show visits whose middles are nearly the same. Their local maps show one junction at
slightly different points. So they get one middle, and are visits to one place. But a point where
the robot turned around never gets the middle of the visit before or after it. If a visit shares
its middle with no other one, the robot may have come nearer to a middle that others share. Then the
visit gets that middle. Successive visits that now have one middle become one.

The second stretch may come long after the first one. So these visits are found when a drive ends.
"""

from __future__ import annotations

import math
from bisect import bisect
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import cdist, pdist, squareform

from perception.places.closures import VisitMatch
from perception.places.distinctive import RIM, SAME, STAY, Visit, Way, taken
from perception.places.track import Array, Track, points_turned

# A stretch reaches REACH metres of trajectory to both sides of a visit. Partings between them and
# FARTHER metres are found after those, as the trajectories are aligned less well there. The points
# of a stretch are PACE metres apart.
REACH, FARTHER, PACE = 12.0, 24.0, 0.25
# Two stretches run together if they are within BESIDE metres for TOGETHER metres. Then they diverge
# if each is more than APART metres from the other one within AHEAD metres. The parting is BEFORE
# metres before the point where they are BESIDE metres apart.
BESIDE, TOGETHER, APART, AHEAD, BEFORE = 1.0, 2.0, 2.0, 4.0, 0.5
# A parting within NEAR metres of the middle of a visit is at the place of the visit. Partings
# within ONE metres are one. Points within PASS metres of the trajectory belong to one pass.
NEAR, ONE, PASS = 1.5, 2.0, 4.0
# The radius of the disc of a parting in metres. The robot crosses its rim less than BOW metres of
# trajectory away.
RADIUS, BOW = 1.0, 6.0
# Visits whose middles are within AGREED metres of each other are to one place. The robot came
# clearly nearer to a middle than to another if it came nearer by CLEARLY metres, which is twice the
# error of the middle of a visit.
AGREED, CLEARLY = 1.0, 0.4
# Between visits at most MOST metres of trajectory apart, the track is as good as a closure. Two
# stretches are LEAST metres of trajectory apart.
MOST, LEAST = 32.0, 8.0

# A pass of a place: the metres driven, and the middle (x, y) of the place in the frame of the track
# there, in metres.
_Pass = tuple[float, Array]


def with_partings(
    track: Track, visits: Sequence[Visit], closings: Sequence[VisitMatch]
) -> tuple[tuple[Visit, ...], list[VisitMatch]]:
    """Add a visit for each pass of a place where stretches of a drive diverge.

    Visits whose middles are nearly the same get the same middle. Successive ones with one middle
    become one visit. An added visit has the local map of the nearest other one. Return all visits,
    in order, and the closures between their middles.
    """
    drive = _DrivePoints(track, visits)
    relations = [*_closed(drive, closings), *_tracked(drive)]  # no middle of a visit changes them
    for moves_of in (_agreed, _nearer):
        moves = moves_of(_DrivePoints(track, visits), relations)
        visits = [*map(_moved, visits, moves)]
        closings = [
            replace(one, match=replace(one.match, shift=one.match.shift + _change(one, moves)))
            for one in closings
        ]
    visits, closings = _without_returns(track, visits, closings)
    drive = _DrivePoints(track, visits)
    every = [*visits, *(drive.visit(*some) for some in _added(drive, relations))]
    order = sorted(range(len(every)), key=lambda k: every[k].scan)
    number = {k: n for n, k in enumerate(order)}
    return tuple(every[k] for k in order), [
        replace(one, first=number[one.first], last=number[one.last]) for one in closings
    ]


@dataclass(frozen=True, eq=False)
class _Alignment:
    """How the trajectory at a visit lies relative to the trajectory at an earlier one."""

    first: float  # metres driven up to the earlier visit
    last: float  # metres driven up to the later visit
    turn: float  # rotation from the axes at the later visit to those at the earlier one, in radians
    here: Array  # (x, y) of a point by the earlier visit, in metres
    there: Array  # (x, y) of the same point by the later visit

    @property
    def reverse(self) -> _Alignment:
        return _Alignment(self.last, self.first, -self.turn, self.there, self.here)

    def moved(self, points: Array) -> Array:
        """Move points, (..., 2) metres, from the later to the earlier trajectory."""
        return self.here + points_turned(self.turn, points - self.there)


class _DrivePoints:
    """A drive as points along its trajectory, with its visits in order."""

    def __init__(self, track: Track, visits: Sequence[Visit]) -> None:
        self._way = track.way
        at = np.arange(0.0, self._way[-1], PACE)
        # (n, 2) positions in metres, PACE metres apart.
        self.points = np.stack([np.interp(at, self._way, track.poses[:, k]) for k in (0, 1)], 1)
        self.visits = visits
        # The (v,) metres driven up to each visit, and the (v, 2) middles of their places in metres.
        self.ways = self._way[[visit.scan for visit in visits]]
        self.middles = np.array([visit.middle for visit in visits]).reshape(-1, 2)
        self._cuts = [0.0, *(float(self._way[cut]) for cut in track.cuts), float(self._way[-1])]

    def stretch(self, way: float, reach: float = REACH) -> range:
        """The indices of the points within `reach` metres of driving, up to cuts of the track."""
        k = min(max(bisect(self._cuts, way), 1), len(self._cuts) - 1)
        begin, end = max(self._cuts[k - 1], way - reach), min(self._cuts[k], way + reach)
        return range(math.ceil(begin / PACE), min(math.floor(end / PACE) + 1, len(self.points)))

    def partings(self, one: _Alignment, reach: float) -> Iterator[tuple[_Pass, _Pass]]:
        """Yield the earlier and the later pass of each parting of two stretches."""
        ours, theirs = self.stretch(one.first, reach), self.stretch(one.last, reach)
        if ours.stop > theirs.start:  # Stretches share no points.
            middle, gap = round((one.first + one.last) / 2 / PACE), round(LEAST / 2 / PACE)
            ours = range(ours.start, max(ours.start, middle - gap))
            theirs = range(min(theirs.stop, middle + gap), theirs.stop)
        if not ours or not theirs:
            return
        here = self.points[ours.start : ours.stop]
        there = one.moved(self.points[theirs.start : theirs.stop])
        for a, b in lead_apart(cdist(here, there)):
            middle = (here[a] + there[b]) / 2
            yield (ours[a] * PACE, middle), (theirs[b] * PACE, one.reverse.moved(middle))

    def is_near(self, some: _Pass) -> bool:
        """Whether a visit is so near to a pass that it is at the same place."""
        soon = np.abs(self.ways - some[0]) <= PASS
        return bool((soon & (np.hypot(*(self.middles - some[1]).T) <= NEAR)).any())

    def visit(self, way: float, middle: Array) -> Visit:
        """Make the visit of a pass."""
        scan = int(np.abs(self._way - way).argmin())
        part, here = self.stretch(way, BOW), round(way / PACE)
        ways: list[Way] = []
        sides = (range(here - 1, part.start - 1, -1), range(here, part.stop))
        arrived, left = (self._crossed(side, middle, ways) for side in sides)
        far = np.hypot(*(self.middles - middle).T) + np.abs(self.ways - way)
        patch = self.visits[int(far.argmin())].patch
        visit = Visit(scan, middle, scan, scan, RADIUS, tuple(ways), arrived, left, patch=patch)
        return visit.in_order()

    def _crossed(self, side: range, middle: Array, ways: list[Way]) -> int | None:
        """The index in `ways` of the way by which points leave a disc; None if they stay in it."""
        for k in side:
            x, y = self.points[k] - middle
            if math.hypot(x, y) >= RADIUS + RIM:
                return taken(ways, math.atan2(y, x))
        return None


def _closed(drive: _DrivePoints, closings: Sequence[VisitMatch]) -> Iterator[_Alignment]:
    """Yield the relative poses of trajectories that closures give."""
    for one in closings:
        first, last = drive.visits[one.first], drive.visits[one.last]
        first_way, last_way = float(drive.ways[one.first]), float(drive.ways[one.last])
        here = first.middle + one.match.shift
        yield _Alignment(first_way, last_way, one.match.turn, here, last.middle)


def _tracked(drive: _DrivePoints) -> Iterator[_Alignment]:
    """Yield the relative poses of trajectories that the track gives, for successive visits."""
    for way in drive.ways.tolist():
        first, last = np.searchsorted(drive.ways, (way, way + MOST))
        for other in drive.ways[first:last].tolist():
            yield _Alignment(way, other, 0.0, np.zeros(2), np.zeros(2))


def _added(drive: _DrivePoints, relations: Sequence[_Alignment]) -> list[_Pass]:
    """List the passes of partings that are not near a known visit."""
    found: list[_Pass] = []
    for reach, one in product((REACH, FARTHER), relations):
        for pair in drive.partings(one, reach):
            if not any(drive.is_near(some) or _is_known(some, found) for some in pair):
                place = _passes(drive, pair, relations)
                found += [] if any(map(drive.is_near, place)) else place
    return found


def _agreed(drive: _DrivePoints, relations: Sequence[_Alignment]) -> Array:
    """Compute how to move the middles of visits, (v, 2) metres, so that near middles coincide."""
    links = _links(drive, relations)
    moves, done = np.zeros_like(drive.middles), set[int]()
    for root in range(len(drive.middles)):
        if root in done:
            continue
        # For each visit, the rotation from its axes to those of the root, and its middle there.
        group = {root: (0.0, np.zeros(2))}
        for k in (queue := [root]):  # The list grows.
            turn, at = group[k]
            for n, more, off in links[k]:
                if n not in group:
                    group[n] = turn + more, at + points_turned(turn, off)
                    queue.append(n)
        done |= group.keys()
        if len(group) < 2:
            continue
        at = np.array([point for _, point in group.values()])
        far = squareform(pdist(at))
        far[_turned_between(drive.visits, [*group])] += AGREED
        parts = fcluster(linkage(squareform(far), "complete"), AGREED, "distance")
        for n, part in zip(group, parts, strict=True):
            turn, point = group[n]
            moves[n] = points_turned(-turn, at[parts == part].mean(axis=0) - point)
    return moves


def _turned_between(visits: Sequence[Visit], some: Sequence[int]) -> NDArray[np.bool_]:
    """Whether two of some visits are successive, and the robot turned around at one: (n, n)."""
    turns = np.array([visits[k].support == 0 for k in some])
    successive = np.abs(np.subtract.outer(some, some)) == 1
    return np.asarray(successive & (turns[:, None] | turns))


def _nearer(drive: _DrivePoints, relations: Sequence[_Alignment]) -> Array:
    """Compute how to move middles, (v, 2) metres, to middles that the robot came nearer to.

    A local map may show one junction where others show two. So a visit that shares its middle with
    no other visit moves to a middle in its disc that several visits have, if the robot came clearly
    nearer to it.
    """
    moves = np.zeros_like(drive.middles)
    widest = max((visit.radius for visit in drive.visits), default=0.0)
    links = _links(drive, relations, widest)
    shared = {
        k
        for k, near in links.items()
        if any(n != k and math.hypot(*off) < SAME for n, _, off in near)
    }
    for k in links.keys() - shared:
        part = drive.stretch(float(drive.ways[k]), PASS)
        ours = drive.points[part.start : part.stop] - drive.middles[k]
        others = [off for n, _, off in links[k] if n in shared]
        inside = [off for off in others if math.hypot(*off) <= drive.visits[k].radius]
        far = [np.hypot(*(ours - off).T).min(initial=np.inf) for off in (np.zeros(2), *inside)]
        if min(far) < far[0] - CLEARLY:
            moves[k] = inside[int(np.argmin(far)) - 1]
    return moves


def _links(
    drive: _DrivePoints, relations: Sequence[_Alignment], most: float = AGREED
) -> dict[int, list[tuple[int, float, Array]]]:
    """For each visit, list the visits with middles at most `most` metres away.

    Each has a pose relative to this visit. It is a rotation from its axes to those of this visit,
    in radians, and the offset of its middle from that of this visit, in metres.
    """
    links: dict[int, list[tuple[int, float, Array]]] = defaultdict(list)
    for one in relations:
        first, last = (
            np.flatnonzero(np.abs(drive.ways - way) <= REACH) for way in (one.first, one.last)
        )
        theirs = one.moved(drive.middles[last])
        for i, j in zip(*np.nonzero(cdist(drive.middles[first], theirs) <= most), strict=True):
            off = theirs[j] - drive.middles[first[i]]
            links[int(first[i])].append((int(last[j]), one.turn, off))
            links[int(last[j])].append((int(first[i]), -one.turn, points_turned(-one.turn, -off)))
    return links


def _moved(visit: Visit, move: Array) -> Visit:
    """Move the middle of the place of a visit, and keep the points where its ways cross the rim."""
    if not move.any():
        return visit
    rim = visit.radius + RIM
    ways = []
    for way in visit.ways:
        x, y = rim * math.cos(way.bearing) - move[0], rim * math.sin(way.bearing) - move[1]
        ways.append(replace(way, bearing=math.atan2(y, x)))
    return replace(visit, middle=visit.middle + move, ways=tuple(ways)).in_order()


def _change(one: VisitMatch, moves: Array) -> Array:
    """Compute how the shift of a closure changes if the middles of its visits move by `moves`."""
    return np.asarray(points_turned(one.match.turn, moves[one.last]) - moves[one.first])


def _without_returns(
    track: Track, visits: Sequence[Visit], closings: Sequence[VisitMatch]
) -> tuple[list[Visit], list[VisitMatch]]:
    """Make one visit of successive visits to one place, as `Stays` does before middles move.

    Return the visits, and the closures between them.
    """
    kept: list[Visit] = []
    number: list[int] = []  # for each visit, the index in `kept` of the visit that it belongs to
    for visit in visits:
        last = kept[-1] if kept else None
        if last and last.is_near(visit) and _is_soon(track, last, visit):
            kept[-1] = last.joined(visit)
        else:
            kept.append(visit)
        number.append(len(kept) - 1)
    pairs = {(number[one.first], number[one.last]): one for one in closings}
    return kept, [replace(one, first=i, last=j) for (i, j), one in pairs.items() if i != j]


def _is_soon(track: Track, last: Visit, visit: Visit) -> bool:
    """Whether a visit begins within STAY metres of the end of the last one, without a cut."""
    soon = track.way[visit.scan] <= track.way[last.end] + STAY
    return bool(soon) and not track.cuts_between(last.scan, visit.scan)


def _passes(
    drive: _DrivePoints, pair: tuple[_Pass, _Pass], relations: Sequence[_Alignment]
) -> list[_Pass]:
    """List all passes of a parting: the given pair, and those of stretches that relations align."""
    place = list(pair)
    for way, middle in place:  # The list grows.
        for one in (some for relation in relations for some in (relation, relation.reverse)):
            if abs(one.last - way) > REACH:
                continue
            here, part = one.moved(middle), drive.stretch(one.first)
            far = np.hypot(*(drive.points[part.start : part.stop] - here).T)
            if len(far) and far.min() <= BESIDE:
                there = part[int(far.argmin())] * PACE
                if all(abs(there - known) > PASS for known, _ in place):
                    place.append((there, here))
    return place


def _is_known(some: _Pass, known: Sequence[_Pass]) -> bool:
    """Whether a pass of a parting is already known."""
    return any(abs(some[0] - way) <= PASS and math.dist(some[1], at) <= ONE for way, at in known)


def lead_apart(far: Array) -> Iterator[tuple[int, int]]:
    """Yield where two stretches that ran together diverge: the index of the point in each.

    `far` has the distance of each point of one from each of the other, (n, m) metres.
    """
    yield from _ahead(far)
    yield from sorted((len(far) - 1 - a, b) for a, b in _ahead(far[::-1]))


def _ahead(far: Array) -> Iterator[tuple[int, int]]:
    """Yield where two stretches diverge for a robot that follows the first one forwards."""
    back, ahead = round(TOGETHER / PACE), round(AHEAD / PACE)
    ours, theirs = far.min(axis=1), far.min(axis=0)
    ends = np.flatnonzero((ours[:-1] <= BESIDE) & (ours[1:] > BESIDE))
    for a in ends[ends >= back].tolist():
        if ours[a - back : a].max() > BESIDE or ours[a + 1 : a + 1 + ahead].max() <= APART:
            continue
        # The other stretch is driven in the same or in the opposite direction.
        before, b = (int(k) for k in far[[a - back, a]].argmin(axis=1))
        onward = theirs[b + 1 : b + 1 + ahead] if b > before else theirs[max(b - ahead, 0) : b]
        # It runs along, too, and does not turn around.
        if abs(b - before) >= back // 2 and len(onward) and onward.max() > APART:
            begin = a - round(BEFORE / PACE)
            yield begin, int(far[begin].argmin())
