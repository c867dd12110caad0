"""Finds the doors that a robot drives through, for buildings whose places are doors.

In a building of rooms, the robot crosses wide spaces freely, and no corridor bends or forks. But it
must drive through doors, which are narrow parts of the free space on its trajectory. So a place is
a door, and a path crosses a room from one door to the next.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from perception.places.distinctive import Visit, Way
from perception.places.local_map import LocalMaps, Patch
from perception.places.scale import Scale
from perception.places.track import Array, Track
from perception.readers.scans import RobotLog

# The width is measured once every STRIDE metres, since a door may be as thin as a wall. One local
# map serves this many measurements.
STRIDE, LOOKS = 0.1, 5
# Widths are measured at angles of up to 50 degrees to either side of the perpendicular, since the
# robot may drive through a door at an angle.
ASKEW = np.radians(np.arange(-50.0, 51.0, 10.0))
# Largest measured width to either side, in metres.
ASIDE = 3.0
# A door is at most DOOR metres wide. Within BESIDE metres before and after it, the free space is at
# least WIDER times as wide.
DOOR, WIDER, BESIDE = 1.6, 1.33, 2.0
# Two doors are at least this many metres apart along the trajectory, and the space between is at
# least WIDER times as wide as either.
DEEP = 0.5
# A building has rooms if most of the trajectory is wider than WIDE metres and the robot drives
# through at least one door in OFTEN metres.
WIDE, OFTEN = 2.2, 30.0
# Two consecutive doors are the same if their middles are nearer than SAME metres. A narrow part
# within WITHIN metres of a door belongs to that door if the robot returned through the door right
# after it.
SAME, WITHIN = 0.6, 1.0


@dataclass(frozen=True, eq=False)
class Door:
    """A door that the robot drove through.

    Attributes:
        scan: Index of the first scan behind the door.
        middle: (x, y) in metres, in the frame of the track.
        width: Width of the free space in the door, in metres.
        way: Metres driven from the beginning of the track to the door.
    """

    scan: int
    middle: Array
    width: float
    way: float


def find_doors(log: RobotLog, track: Track) -> tuple[Door, ...]:
    """Find the doors that the robot drove through.

    Each unbroken part of the track is searched separately.

    Returns:
        The doors in the order of the drive, one entry for each time that the robot drove through a
        door.
    """
    return tuple(
        replace(
            door,
            scan=min(door.scan + begin, end - (end < len(log))),
            way=door.way + float(track.way[begin]),
        )
        for begin, end in track.spans
        for door in _doors_of_span(replace(log, scans=log.scans[begin:end]), track.part(begin, end))
    )


def _doors_of_span(log: RobotLog, track: Track) -> tuple[Door, ...]:
    """Find the doors of a log whose track is unbroken."""
    maps = LocalMaps(log.scans, track, 2 * ASIDE)
    ways = np.arange(0.0, track.way[-1], STRIDE)
    # Interpolation needs distances that grow. While the robot stands, only its first scan is used.
    moving = np.concatenate([[True], np.diff(track.way) > 0])
    positions = np.stack(
        [np.interp(ways, track.way[moving], track.poses[moving, k]) for k in (0, 1)], axis=1
    )
    scans = np.searchsorted(track.way, ways, side="right") - 1
    ahead = (
        positions[np.minimum(np.arange(len(ways)) + 3, len(ways) - 1)]
        - positions[np.maximum(np.arange(len(ways)) - 3, 0)]
    )
    across = np.arctan2(ahead[:, 1], ahead[:, 0]) + math.pi / 2
    gaps: list[tuple[float, Array]] = []
    # Measure the width across the trajectory, a few positions for each local map.
    for begin in range(0, len(ways), LOOKS):
        some = slice(begin, begin + LOOKS)
        middle = begin + len(positions[some]) // 2
        patch = maps.around(int(scans[middle]), positions[middle], ASIDE + 1)
        gaps += [
            _gap(patch, at, angle) for at, angle in zip(positions[some], across[some], strict=True)
        ]
    widths = np.array([width for width, _ in gaps])
    found: list[Door] = []
    # Start with the narrowest position, the middle of a door. Narrow positions near a door that was
    # found belong to that door.
    for k in np.argsort(widths, kind="stable"):
        if widths[k] > DOOR:
            break
        before, after = (
            widths[(ways < ways[k]) & (ways >= ways[k] - BESIDE)],
            widths[(ways > ways[k]) & (ways <= ways[k] + BESIDE)],
        )
        if not len(before) or not len(after) or min(before.max(), after.max()) < WIDER * widths[k]:
            continue
        apart = [
            widths[(ways >= min(door.way, ways[k])) & (ways <= max(door.way, ways[k]))].max()
            >= WIDER * widths[k]
            for door in found
        ]
        if all(apart) and all(abs(door.way - ways[k]) > DEEP for door in found):
            found.append(
                Door(
                    int(np.searchsorted(track.way, ways[k], side="right")),
                    gaps[k][1],
                    float(widths[k]),
                    float(ways[k]),
                )
            )
    return tuple(sorted(found, key=lambda door: door.way))


def _gap(patch: Patch, at: Array, across: float) -> tuple[float, Array]:
    """The smallest width of the free space across the trajectory, in metres, and its middle.

    Args:
        patch: Local map.
        at: (x, y) of the robot in metres.
        across: Direction perpendicular to the trajectory, in radians.
    """
    directions = np.stack([np.cos(across + ASKEW), np.sin(across + ASKEW)], axis=1)
    free = patch.free_along(at, np.stack([directions, -directions], axis=1), ASIDE)
    k = int(free.sum(axis=1).argmin())
    return float(free[k].sum()), at + (free[k, 0] - free[k, 1]) / 2 * directions[k]


def is_wide(scale: Scale) -> bool:
    """Check whether most of the trajectory is wider than corridors, as in a building of rooms."""
    return scale.most > WIDE


def are_frequent(doors: Sequence[Door], track: Track) -> bool:
    """Check whether the robot drives through doors often, as in a building of rooms.

    Args:
        doors: The doors that the robot drove through, once for each pass.
        track: Trajectory of the robot.
    """
    return bool(len(doors) * OFTEN > track.way[-1])


def visits_of(track: Track, doors: Sequence[Door]) -> tuple[Visit, ...]:
    """Make the visits to doors, in order.

    If the robot enters and leaves a room by one door, this is a single visit. Corrected poses are
    not read.

    Args:
        track: Trajectory of the robot.
        doors: Doors that it drove through, in order.
    """
    spans = [
        [door for door in doors if begin <= min(door.scan, len(track.poses) - 1) < end]
        for begin, end in track.spans
    ]
    return tuple(visit for some in spans for visit in _visits_of_span(track, some))


def _visits_of_span(track: Track, doors: Sequence[Door]) -> tuple[Visit, ...]:
    """Make the visits to the doors of one unbroken part of a track, in order."""
    # Join consecutive passes of one door. If the robot drove through a door, a narrow part close
    # behind it, and back through the door, that is also one visit.
    passes: list[list[Door]] = []
    for door in doors:
        if passes and math.dist(door.middle, passes[-1][-1].middle) < SAME:
            passes[-1].append(door)
        elif (
            len(passes) > 1
            and math.dist(door.middle, passes[-2][-1].middle) < SAME
            and math.dist(door.middle, passes[-1][-1].middle) < WITHIN
        ):
            part = passes.pop()
            passes[-1] += [*part, door]
        else:
            passes.append([door])
    # The middle of a door is where it is narrowest.
    middles = [min(same, key=lambda door: door.width).middle for same in passes]
    return tuple(_visit(track, passes, middles, number) for number in range(len(passes)))


def _visit(
    track: Track, passes: Sequence[Sequence[Door]], middles: Sequence[Array], number: int
) -> Visit:
    """The visit to a door, whose exits point straight to the doors before and after it."""
    same, middle = passes[number], middles[number]
    came = _bearing(middle, middles[number - 1]) if number > 0 else None
    went = _bearing(middle, middles[number + 1]) if number < len(passes) - 1 else None
    # If the next door is the previous one, the robot leaves by the exit of arrival.
    if (
        came is not None
        and went is not None
        and math.dist(middles[number - 1], middles[number + 1]) < SAME
    ):
        went = came
    ways = sorted({bearing for bearing in (came, went) if bearing is not None})
    arrived, left = (None if bearing is None else ways.index(bearing) for bearing in (came, went))
    end = min(same[-1].scan, len(track.poses) - 1)
    return Visit(
        min(same[0].scan, end),
        middle,
        max(same[0].scan - 1, 0),
        end,
        tuple(map(Way, ways)),
        arrived,
        left,
    )


def _bearing(start: Array, end: Array) -> float:
    return math.atan2(end[1] - start[1], end[0] - start[0])
