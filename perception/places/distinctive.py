"""Finds the distinctive places that a robot passes: junctions, corners, dead ends, turning points.

Milestones are scans about half a metre apart on the trajectory. At each of them, the local map
gives the exits and the point where they meet. If three or more exits meet there, or if the corridor
bends, the milestone votes for a place with its middle at that point. If at least half of the nearby
milestones vote for a point, it is a place. Each time that the robot passes it is a visit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from perception.places.gateways import MERGED, Outlook, apart, nearest, outlook, parting
from perception.places.local_map import CELL, Bools, Cell, LocalMaps, Patch
from perception.places.scale import EVERY, Scale, milestones
from perception.places.track import Array, Track, surfaces
from perception.readers.scans import RobotLog

# Two exits that are opposite to within this, in radians, are one corridor and no place.
BEND = math.radians(40)
# Largest distance in metres from the robot to a drivable cell of the local map.
ASTRAY = 1.5
# Shares of the radius. SAME: largest distance between votes for one middle. PASSING: largest
# distance at which the robot passes a place. ASKED: milestones this near are counted for the
# support.
SAME, PASSING, ASKED = 0.5, 0.6, 0.8
# Smallest number of votes for a place, and smallest share of the nearby milestones that vote for
# it.
VOTES, AGREED = 3, 0.5
# The robot turned around if its direction of motion changed by more than this, in radians.
REVERSED = math.radians(135)
# The robot left a path if its direction between two places changed by more than this, in radians.
BENT = math.radians(65)


@dataclass(frozen=True, slots=True)
class Way:
    """An exit of a place.

    Attributes:
        bearing: Direction in radians, counterclockwise in the frame of the track.
        sure: Whether the exit certainly is a gateway. An uncertain exit is narrow, or leads into
            unknown space.
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
        ways: Exits, counterclockwise.
        arrived: Index in `ways` of the exit by which the robot came; None at the beginning of the
            log.
        left: Index in `ways` of the exit by which the robot left; None at the end of the log.
        axis: Main direction of the walls, in radians modulo a quarter turn.
        straight: How well the walls agree with the axis, from 0 to 1.
        support: Share of the nearby milestones that vote for the place, from 0 to 1.
    """

    scan: int
    middle: Array
    begin: int
    end: int
    ways: tuple[Way, ...] = ()
    arrived: int | None = None
    left: int | None = None
    axis: float = 0.0
    straight: float = 0.0
    support: float = 1.0

    def later(self, scans: int) -> Visit:
        """Copy the visit, with its indices of scans increased by `scans`."""
        return replace(self, scan=self.scan + scans, begin=self.begin + scans, end=self.end + scans)


@dataclass(frozen=True, eq=False)
class _Vote:
    """The vote of a milestone for a place with this middle."""

    scan: int
    middle: Array


def find_visits(log: RobotLog, track: Track, scale: Scale) -> tuple[Visit, ...]:
    """Find the visits to distinctive places in a log, in order.

    Each unbroken part of the track is searched separately. Corrected poses are not read.

    Args:
        log: The scans.
        track: Their poses.
        scale: Width of gateways, and radius of places.
    """
    return tuple(
        visit.later(begin)
        for begin, end in track.spans
        for visit in _visits_of_span(
            replace(log, scans=log.scans[begin:end]), track.part(begin, end), scale
        )
    )


def _visits_of_span(log: RobotLog, track: Track, scale: Scale) -> tuple[Visit, ...]:
    """Find the visits in a log whose track is unbroken."""
    maps = LocalMaps(log.scans, track, scale.window)
    asked = milestones(track, EVERY)
    votes = [vote for i in asked if (vote := _vote(maps, track, scale, i)) is not None]
    found = _supported(votes, asked, track, scale)
    found = _one_for_each_pass(_with_turnings(found, track, scale), scale)
    found = _with_bends(found, track, scale)
    return tuple(_described(visit, log, track, scale, maps) for visit in found)


def _vote(maps: LocalMaps, track: Track, scale: Scale, i: int) -> _Vote | None:
    """The vote of milestone i (the index of a scan); None if it sees no place."""
    patch = maps.around(i, track.poses[i, :2], scale.half)
    open_cells, here = _start(patch, track.poses[i, :2], scale.gateway)
    if here is None:
        return None
    seen = outlook(open_cells, here, scale.radius)
    if len(seen.exits) < 2:
        return None
    middle = parting(patch, open_cells, seen, scale.radius)
    if not is_decisive(outlook(open_cells, middle, scale.radius)):
        return None
    return _Vote(i, patch.position(middle))


def is_decisive(seen: Outlook) -> bool:
    """Check whether the exits show a place: at least three exits, or two that are not opposite."""
    bearings = seen.bearings
    return len(bearings) > 2 or (len(bearings) == 2 and math.pi - apart(*bearings) > BEND)


def _supported(votes: list[_Vote], asked: list[int], track: Track, scale: Scale) -> list[Visit]:
    """Group votes for about the same middle, and make a visit of each group with enough support.

    Votes from different passes of the robot are in different groups.
    """
    groups: list[list[_Vote]] = []
    for vote in votes:
        # Only recent groups are candidates: an earlier group is another pass of the place.
        for group in groups[:-4:-1]:
            last = track.way[vote.scan] - track.way[group[-1].scan]
            if last < scale.radius and math.dist(vote.middle, _middle(group)) < SAME * scale.radius:
                group.append(vote)
                break
        else:
            groups.append([vote])
    found = []
    for group in groups:
        middle = _middle(group)
        begin, end = _stay(track, middle, group[len(group) // 2].scan, scale.radius)
        near = [
            i
            for i in asked
            if begin <= i <= end and math.dist(track.poses[i, :2], middle) < ASKED * scale.radius
        ]
        support = sum(vote.scan in near for vote in group) / max(len(near), 1)
        scan = begin + int(np.hypot(*(track.poses[begin : end + 1, :2] - middle).T).argmin())
        if (
            len(group) >= VOTES
            and support >= AGREED
            and math.dist(track.poses[scan, :2], middle) < PASSING * scale.radius
        ):
            found.append(Visit(scan, middle, begin, end, support=support))
    return sorted(found, key=lambda visit: visit.scan)


def _middle(group: list[_Vote]) -> Array:
    return np.asarray(np.median([vote.middle for vote in group], axis=0))


def _stay(track: Track, middle: Array, scan: int, radius: float) -> tuple[int, int]:
    """The first and last scan of a stay at a place, around a scan at that place.

    The stay extends from the given scan to both sides, as long as the next scan is within the
    radius of the middle or nearer to the middle than the scan before.
    """
    near = np.hypot(*(track.poses[:, :2] - middle).T)
    begin = end = scan
    while begin > 0 and (near[begin - 1] < radius or near[begin - 1] < near[begin]):
        begin -= 1
    while end < len(near) - 1 and (near[end + 1] < radius or near[end + 1] < near[end]):
        end += 1
    return begin, end


def _one_for_each_pass(found: list[Visit], scale: Scale) -> list[Visit]:
    """Merge consecutive visits whose middles are too close for two places.

    The visit with the largest support times length is kept, and covers the stays of all.
    """
    kept: list[Visit] = []
    for visit in found:
        if kept and math.dist(kept[-1].middle, visit.middle) < PASSING * scale.radius:
            last = kept[-1]
            best = max((last, visit), key=lambda one: (one.end - one.begin) * one.support)
            kept[-1] = replace(
                best, begin=min(last.begin, visit.begin), end=max(last.end, visit.end)
            )
        else:
            kept.append(visit)
    return kept


def _with_turnings(found: list[Visit], track: Track, scale: Scale) -> list[Visit]:
    """Add a visit at each point far from other visits where the robot turned around."""
    positions, way = track.poses[:, :2], track.way
    # Compare the direction of motion before and after each scan, over a third of the radius.
    stride = scale.radius / 3
    turned: list[tuple[float, int]] = []
    for i in range(len(way)):
        before, after = np.searchsorted(way, way[i] - stride), np.searchsorted(way, way[i] + stride)
        if before > 0 or way[i] >= stride:
            if after >= len(way):
                break
            there, back = positions[i] - positions[before], positions[after] - positions[i]
            if min(math.hypot(*there), math.hypot(*back)) > stride / 2:
                angle = apart(math.atan2(there[1], there[0]), math.atan2(back[1], back[0]))
                if angle > REVERSED:
                    turned.append((angle, i))
    visits = list(found)
    # Begin with the sharpest turn. Other turns near it belong to the same turning point.
    for _, i in sorted(turned, reverse=True):
        if all(
            math.dist(visit.middle, positions[i]) > scale.radius
            for visit in visits
            if abs(way[visit.scan] - way[i]) < 3 * scale.radius
        ):
            begin, end = _stay(track, positions[i], i, scale.radius / 2)
            visits.append(Visit(i, positions[i], begin, end, support=0.0))
    return sorted(visits, key=lambda visit: visit.scan)


def _with_bends(found: list[Visit], track: Track, scale: Scale) -> list[Visit]:
    """Add a visit between two visits if the robot turned back or changed direction between them.

    Then a path between two neighbouring places leads straight on.
    """
    positions = track.poses[:, :2]
    visits: list[Visit] = []
    for visit in found:
        if visits:
            last = visits[-1]
            went, came = (
                _crossing(track, last, scale.radius, 1),
                _crossing(track, visit, scale.radius, -1),
            )
            if went is not None and came is not None and visit.begin > last.end:
                directions = went - last.middle, visit.middle - came
                turned = apart(*(math.atan2(y, x) for x, y in directions))
                between = positions[last.end : visit.begin + 1]
                # The robot turned where it was farthest from the straight line between the two
                # places. If it came back, it turned where it was farthest from both places.
                line = visit.middle - last.middle
                length = math.hypot(*line)
                off = np.hypot(*(between - last.middle).T) + np.hypot(*(between - visit.middle).T)
                if turned < REVERSED and length > 0:
                    off = np.abs((between - last.middle) @ np.array([-line[1], line[0]])) / length
                i = last.end + int(off.argmax())
                far = min(math.dist(positions[i], one.middle) for one in (last, visit))
                if turned > BENT and far > scale.radius:
                    begin, end = _stay(track, positions[i], i, scale.radius / 2)
                    visits.append(
                        Visit(
                            i,
                            positions[i],
                            max(begin, last.end + 1),
                            min(end, visit.begin - 1),
                            support=0.0,
                        )
                    )
        visits.append(visit)
    return visits


def _described(visit: Visit, log: RobotLog, track: Track, scale: Scale, maps: LocalMaps) -> Visit:
    """Complete a visit: its exits, the exits that the robot took, and the direction of walls."""
    patch = maps.around(visit.scan, visit.middle, scale.half)
    ways = _ways(patch, visit.middle, scale)
    ways, arrived = _taken(ways, _crossing(track, visit, scale.radius, -1), visit.middle)
    ways, left = _taken(ways, _crossing(track, visit, scale.radius, 1), visit.middle)
    order = sorted(range(len(ways)), key=lambda k: ways[k].bearing)
    axis, straight = _walls(log, track, visit)
    return replace(
        visit,
        ways=tuple(ways[k] for k in order),
        arrived=None if arrived is None else order.index(arrived),
        left=None if left is None else order.index(left),
        axis=axis,
        straight=straight,
    )


def _ways(patch: Patch, middle: Array, scale: Scale) -> list[Way]:
    """The exits seen from the middle of a place: first certain, then uncertain gateways."""
    sure = _outlook(patch, middle, scale.gateway, scale.radius)
    ways = [Way(bearing) for bearing in (sure.bearings if sure else ())]
    doubtful = _outlook(patch, middle, scale.doubtful, scale.radius)
    if doubtful is None:
        return ways
    for bearing in (*doubtful.bearings, *_unseen(patch, doubtful, scale)):
        if all(apart(bearing, way.bearing) > MERGED for way in ways):
            ways.append(Way(bearing, sure=False))
    return ways


def _start(patch: Patch, position: Array, width: float) -> tuple[Bools, Cell | None]:
    """The mask of drivable cells for a width, and the drivable cell nearest to a position.

    The cell is None if it is more than ASTRAY metres away.
    """
    open_cells = patch.drivable(width)
    return open_cells, nearest(open_cells, patch.cell(position), ASTRAY)


def _outlook(patch: Patch, middle: Array, width: float, radius: float) -> Outlook | None:
    """The exits of at least this width, seen from a middle; None if no drivable cell is near."""
    open_cells, here = _start(patch, middle, width)
    return None if here is None else outlook(open_cells, here, radius)


def _unseen(patch: Patch, seen: Outlook, scale: Scale) -> list[float]:
    """Bearings, in radians, at which drivable space borders on unobserved space.

    A border counts if it is at least a gateway wide.
    """
    unknown = ~patch.free & ~patch.occupied
    # Cells next to a wall also border on the unknown space behind the wall. So only cells away from
    # walls count.
    border = (
        ndimage.binary_dilation(unknown, iterations=2)
        & patch.free
        & (patch.room > scale.doubtful / 2)
    )
    border &= ndimage.binary_dilation(
        np.isfinite(seen.reached), iterations=round(scale.doubtful / CELL)
    )
    parts, count = ndimage.label(border, np.ones((3, 3), bool))
    found = []
    for k in range(1, count + 1):
        cells = np.argwhere(parts == k)
        if np.ptp(cells, axis=0).max() * CELL >= scale.gateway:
            row, column = cells.mean(axis=0) - seen.middle
            if math.hypot(row, column) * CELL > scale.gateway:
                found.append(math.atan2(column, row))
    return found


def _crossing(track: Track, visit: Visit, radius: float, side: int) -> Array | None:
    """The point (x, y) at which the robot crosses the radius of a place.

    Args:
        track: Trajectory of the robot.
        visit: Visit to the place.
        radius: Metres.
        side: -1 for entering the place, 1 for leaving it.

    Returns:
        Metres, in the frame of the track; None if the log begins or ends before that point.
    """
    positions = track.poses[:, :2]
    i = visit.begin if side < 0 else visit.end
    near = math.dist(positions[i], visit.middle)
    last = 0 if side < 0 else len(positions) - 1
    while near < 0.9 * radius:
        if i == last:
            return positions[i] if near > 0.5 * radius else None
        i += side
        near = math.dist(positions[i], visit.middle)
    return np.asarray(positions[i])


def _taken(ways: list[Way], crossing: Array | None, middle: Array) -> tuple[list[Way], int | None]:
    """Mark the exit that the robot took as certain. Add one if none was seen in its direction.

    Returns:
        The exits, and the index of the exit that the robot took. The index is None if `crossing`,
        the point where the robot crossed the radius, is None.
    """
    if crossing is None:
        return ways, None
    bearing = math.atan2(*(crossing - middle)[::-1])
    k = min(range(len(ways)), key=lambda k: apart(ways[k].bearing, bearing), default=None)
    if k is None or apart(ways[k].bearing, bearing) > 2 * MERGED:
        return [*ways, Way(bearing)], len(ways)
    return [replace(way, sure=True) if i == k else way for i, way in enumerate(ways)], k


def _walls(log: RobotLog, track: Track, visit: Visit) -> tuple[float, float]:
    """The main direction of the walls around a visit, and how well the walls agree with it.

    Returns:
        Radians modulo a quarter turn, and the agreement from 0 to 1.
    """
    # Angles that differ by quarter turns are equal after multiplication by four. So they can be
    # averaged.
    total, count = 0j, 0
    for i in range(visit.begin, visit.end + 1):
        _, normals = surfaces(log.scans[i])
        angles = np.arctan2(normals[:, 1], normals[:, 0]) + track.poses[i, 2]
        total += np.exp(4j * angles).sum()
        count += len(angles)
    return float(np.angle(total)) / 4, abs(total) / max(count, 1)
