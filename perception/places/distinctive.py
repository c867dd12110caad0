"""Finds the distinctive places that a robot passes: junctions, and points where it turned around.

Milestones are scans a metre apart on the trajectory. The local map of each milestone has a
skeleton with junctions. Junctions near each other at successive milestones are one chain. If the
robot drives through the disc of a chain, and half of the local maps nearby show its junction, then
this is a visit. The robot comes and leaves where its trajectory crosses the disc.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from perception.places.local_map import LocalMaps
from perception.places.skeleton import Junction, junctions
from perception.places.track import Array, Track
from perception.places.visits import Visit, Way, apart
from perception.readers.scans import RobotLog

# The usual width of a robot in metres. It has to fit through the doors that the robot uses.
WIDTH = 0.5
# Milestones are EVERY metres apart. Their local maps have the scans of WINDOW metres before and
# after them, and reach HALF metres to each side.
EVERY, WINDOW, HALF = 1.0, 8.0, 8.0
# Junctions farther than this from the robot, in metres, are too uncertain.
SEEN = 5.0
# Junctions are one place within SAME metres, or within this share of the smaller radius.
SAME, SHARE = 0.6, 0.5
# A chain ends if so many milestones in a row do not show it. Its middle is the median of so many.
GAP, RECENT = 4, 9
# The robot visits a place within this distance in metres, even if its disc is smaller. It has left
# at LEFT metres outside of the disc.
PASSING, LEFT = 0.75, 0.5
# Milestones within BESIDE metres along the trajectory are asked about a place. At least a share of
# AGREED has to show it.
BESIDE, AGREED = 3.0, 0.5
# The robot turned around if its directions of motion over some stride in metres, before and after,
# differ by more than REVERSED radians. It turns on the spot or in a bow, so there are several
# strides. Other visits are more than a stride and ALONE metres away along the trajectory.
STRIDES, REVERSED, ALONE = (1.0, 2.0, 4.0), math.radians(135), 1.5
# Two ways out whose bearings differ by less than this, in radians, are one.
MERGED = math.radians(45)
# The bearing of a way is taken at so many metres outside of the disc, whose radius is at least
# SMALL metres.
RIM, SMALL = 0.5, 0.5


@dataclass(frozen=True, eq=False)
class _Sighting:
    """A junction in the local map of a milestone, which is counted from 0."""

    milestone: int
    junction: Junction


@dataclass(eq=False)
class _Chain:
    """Sightings of one junction at successive milestones."""

    sightings: list[_Sighting] = field(default_factory=list)

    @property
    def first(self) -> int:
        return self.sightings[0].milestone

    @property
    def last(self) -> int:
        return self.sightings[-1].milestone

    def middle(self, recent: int = 0) -> Array:
        """The median of the middles: (2,) metres; of the most recent ones only, if not 0."""
        return _middle(self.sightings[-recent:])

    def radius(self, recent: int = 0) -> float:
        """The median of the radii in metres; of the most recent ones only, if not 0."""
        radii = [sighting.junction.radius for sighting in self.sightings[-recent:]]
        return float(np.median(radii))


def _middle(sightings: Sequence[_Sighting]) -> Array:
    return np.asarray(np.median([one.junction.middle for one in sightings], axis=0))


def find_visits(log: RobotLog, track: Track, width: float = WIDTH) -> tuple[Visit, ...]:
    """Find the visits to distinctive places in a log, in order.

    Each unbroken part of the track is searched separately. Corrected poses are not read.

    Args:
        log: The scans.
        track: Their poses.
        width: Width of the robot in metres.
    """
    return tuple(
        visit.later(begin)
        for begin, end in track.spans
        for visit in _visits_of_span(
            replace(log, scans=log.scans[begin:end]), track.part(begin, end), width
        )
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


def _visits_of_span(log: RobotLog, track: Track, width: float) -> list[Visit]:
    """Find the visits in a log whose track is unbroken."""
    asked = np.array(milestones(track, EVERY))
    maps = LocalMaps(log.scans, track, WINDOW)
    chains = _chains(_seen_at(maps, track, int(i), width) for i in asked)
    found = [
        visit
        for chain in chains
        if len(chain.sightings) > 1
        for visit in _passes(chain, track, asked)
    ]
    found = _one_for_each_pass(sorted(found, key=lambda visit: visit.scan))
    return _one_for_each_stay(
        [_with_gateways(visit, track) for visit in _with_turnings(found, track)]
    )


def _seen_at(maps: LocalMaps, track: Track, scan: int, width: float) -> list[Junction]:
    """The junctions near the robot in the local map of a scan, the largest first."""
    here = track.poses[scan, :2]
    found = junctions(maps.around(scan, here, HALF), width / 2)
    near = [junction for junction in found if math.dist(junction.middle, here) <= SEEN]
    return sorted(near, key=lambda junction: -junction.radius)


def _chains(seen: Iterator[list[Junction]]) -> list[_Chain]:
    """Chain the junctions that successive milestones see.

    Args:
        seen: The junctions of each milestone, the largest first.
    """
    chains: list[_Chain] = []
    for milestone, found in enumerate(seen):
        open_chains = [chain for chain in chains if milestone - chain.last <= GAP]
        for junction in found:
            near = [
                (far, number)
                for number, chain in enumerate(open_chains)
                if chain.last < milestone and (far := _distance(chain, junction)) is not None
            ]
            if near:
                chain = open_chains[min(near)[1]]
            else:
                chain = _Chain()
                chains.append(chain)
            chain.sightings.append(_Sighting(milestone, junction))
    return chains


def _distance(chain: _Chain, junction: Junction) -> float | None:
    """The distance of a junction from a chain in metres; None if it is too far for one place."""
    far = math.dist(chain.middle(RECENT), junction.middle)
    near = max(SAME, SHARE * min(chain.radius(RECENT), junction.radius))
    return far if far < near else None


def _passes(chain: _Chain, track: Track, asked: Array) -> Iterator[Visit]:
    """Make a visit of each time that the robot drives through the disc of a chain.

    Args:
        chain: The sightings.
        track: Trajectory of the robot.
        asked: (n,) the scans of the milestones.
    """
    way, positions = track.way, track.poses[:, :2]
    first = max(int(np.searchsorted(way, way[asked[chain.first]] - GAP * EVERY)), 0)
    last = int(np.searchsorted(way, way[asked[chain.last]] + GAP * EVERY, side="right"))
    middle, radius = chain.middle(), chain.radius()
    far = np.hypot(*(positions[first:last] - middle).T)
    for begin, end in _stays(far, max(PASSING, radius)):
        scan = first + begin + int(far[begin : end + 1].argmin())
        near = {
            number
            for number in np.flatnonzero(np.abs(way[asked] - way[scan]) <= BESIDE)
            if math.dist(positions[asked[number]], middle) < SEEN - 0.5
        }
        mine = [sighting for sighting in chain.sightings if sighting.milestone in near]
        if mine and len(mine) >= AGREED * len(near):
            yield Visit(
                scan,
                _middle(mine),
                first + begin,
                first + end,
                radius,
                _ways(mine, radius),
                support=len(mine) / len(near),
            )


def _stays(far: Array, radius: float) -> Iterator[tuple[int, int]]:
    """Find the parts of a trajectory that are in a disc.

    Args:
        far: (n,) distance from the middle of the disc in metres.
        radius: Radius of the disc in metres.

    Yields:
        The first and the last index of each part. The robot stays until it is LEFT metres outside.
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
    """The ways out of a place that its sightings show; sure if half of the sightings show them."""
    groups: list[list[float]] = []
    for sighting in sightings:
        for bearing in _bearings(sighting.junction, radius):
            near = [group for group in groups if apart(_mean(group), bearing) < MERGED]
            if near:
                min(near, key=lambda group: apart(_mean(group), bearing)).append(bearing)
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


def _one_for_each_pass(found: Sequence[Visit]) -> list[Visit]:
    """Keep one of successive visits that overlap and are too close for two places.

    The visit with the largest support times radius is kept.
    """
    kept: list[Visit] = []
    for visit in found:
        last = kept[-1] if kept else None
        if last is None or not _overlap(last, visit):
            kept.append(visit)
        elif visit.support * visit.radius > last.support * last.radius:
            kept[-1] = replace(visit, begin=min(visit.begin, last.begin))
    return kept


def _overlap(first: Visit, second: Visit) -> bool:
    """Check whether two successive visits are to one place."""
    return _are_near(first, second) and second.begin <= first.end + 2


def _are_near(first: Visit, second: Visit) -> bool:
    near = max(SAME, SHARE * max(first.radius, second.radius))
    return math.dist(first.middle, second.middle) < near


def _one_for_each_stay(found: Sequence[Visit]) -> list[Visit]:
    """Join successive visits to one place: the robot left its disc, but went to no other place."""
    kept: list[Visit] = []
    for visit in found:
        last = kept[-1] if kept else None
        if last is None or not _are_near(last, visit):
            kept.append(visit)
        else:
            ways = list(last.ways)
            left = None if visit.left is None else _taken(ways, visit.ways[visit.left].bearing)
            kept[-1] = _in_order(replace(last, end=visit.end, ways=tuple(ways), left=left))
    return kept


def _with_turnings(found: Sequence[Visit], track: Track) -> list[Visit]:
    """Add a visit at each point far from other visits where the robot turned around."""
    visits = list(found)
    for stride in STRIDES:
        # Begin with the sharpest turn. Other turns near it belong to the same turning point.
        for _, i in sorted(_turns(track, stride), reverse=True):
            far = max(ALONE, stride)
            if all(
                abs(track.way[visit.scan] - track.way[i]) > max(far, visit.radius)
                for visit in visits
            ):
                visits.append(Visit(i, track.poses[i, :2].copy(), i, i, support=0.0))
    return sorted(visits, key=lambda visit: visit.scan)


def _turns(track: Track, stride: float) -> Iterator[tuple[float, int]]:
    """The scans at which the robot turned around, each after the angle in radians.

    Args:
        track: Trajectory of the robot.
        stride: The directions of motion are taken over so many metres.
    """
    positions, way = track.poses[:, :2], track.way
    for i in range(int(np.searchsorted(way, stride)), len(way)):
        before, after = np.searchsorted(way, way[i] - stride), np.searchsorted(way, way[i] + stride)
        if after >= len(way):
            return
        there, back = positions[i] - positions[before], positions[after] - positions[i]
        if min(math.hypot(*there), math.hypot(*back)) > stride / 3:
            angle = apart(math.atan2(there[1], there[0]), math.atan2(back[1], back[0]))
            if angle > REVERSED:
                yield angle, i


def _with_gateways(visit: Visit, track: Track) -> Visit:
    """Complete a visit by the ways that the robot took: those by which it crossed the disc."""
    ways, numbers = list(visit.ways), []
    for side in (-1, 1):
        bearing = _crossing(track, visit, side)
        numbers.append(None if bearing is None else _taken(ways, bearing))
    return _in_order(replace(visit, ways=tuple(ways), arrived=numbers[0], left=numbers[1]))


def _in_order(visit: Visit) -> Visit:
    """The visit with its ways in counterclockwise order."""
    order = sorted(range(len(visit.ways)), key=lambda k: visit.ways[k].bearing)
    arrived, left = (None if k is None else order.index(k) for k in (visit.arrived, visit.left))
    ways = tuple(visit.ways[k] for k in order)
    return replace(visit, ways=ways, arrived=arrived, left=left)


def _taken(ways: list[Way], bearing: float) -> int:
    """Mark the way that the robot took as sure, or add it, and return its index."""
    near = [k for k in range(len(ways)) if apart(ways[k].bearing, bearing) < MERGED]
    if not near:
        ways.append(Way(bearing))
        return len(ways) - 1
    k = min(near, key=lambda k: apart(ways[k].bearing, bearing))
    ways[k] = replace(ways[k], sure=True)
    return k


def _crossing(track: Track, visit: Visit, side: int) -> float | None:
    """The direction in radians in which the robot crosses the disc of a place.

    Args:
        track: Trajectory of the robot.
        visit: Visit to the place.
        side: -1 for entering the disc, 1 for leaving it.

    Returns:
        None if the log begins or ends in the disc.
    """
    i = visit.scan
    while 0 <= i < len(track.poses):
        x, y = track.poses[i, :2] - visit.middle
        if math.hypot(x, y) >= max(visit.radius, SMALL) + RIM:
            return math.atan2(y, x)
        i += side
    return None
