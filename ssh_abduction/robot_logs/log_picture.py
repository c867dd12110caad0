"""Draw the first map of a log over the walls that the laser saw.

Edges follow the course of the robot. Travels between the same two places whose courses lie close
together are one edge. Where edges run together, there is one line. Places show their disc and their
gateways. Places that the robot only passed, always between the same two neighbours, are drawn as
dots. Each of several drives has its colour.

The first dstate faces right, as in all drawings of a map. Each drive of a joint map has a frame of
its own. It is moved and turned to where the map has its steps.

A course is the way of the robot from the middle of one place to the middle of the next. The map
says where these middles are.
"""

from __future__ import annotations

import cmath
import math
from bisect import bisect
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from perception.places.importing import Imported
from perception.places.passages import STEP, resampled
from perception.readers.scans import RobotLog, Scan
from ssh_abduction.building.travels import edges_of
from ssh_abduction.data.drives import Drive, drives_of
from ssh_abduction.data.groups import firsts
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.odometry import Pose, moved
from ssh_abduction.data.star import Star
from ssh_abduction.output.drawing import svg_of
from ssh_abduction.output.layout import drawable_poses, fitted_motion
from ssh_abduction.output.roads import place_of_steps, undecided_places
from ssh_abduction.output.scene import (
    ALARM,
    Disc,
    Label,
    Line,
    Mark,
    Point,
    Scene,
    Titled,
    band,
    banded,
    colour_of,
    escaped,
)
from ssh_abduction.rivals.listing import trusted
from ssh_abduction.solver import Solution

Array = NDArray[np.float64]

# The picture has at most one point of a wall in each square with sides of this many metres.
GRAIN = 0.1
# The ends of the beams of this many scans are counted at once.
AT_ONCE = 300
# A metre has this many units of the page, or fewer, so that the picture is at most LARGEST wide.
METRE, LARGEST = 24.0, 1500.0
# Beams longer than this many metres are not drawn: their ends are too far apart to show a wall.
DRAWN = 12.0
# Nearer than this many metres to the middle of a place, an edge leads straight to it.
MIDDLE = 1.0
# An edge is not drawn where it is within BESIDE metres of a shorter one.
BESIDE = 0.75
# The innermost bands of regions are this many metres wide.
BROAD = 2.0
# The colour of edges that belong to no meaningful path, of walls, of the robot's way, and of doors.
EDGE, WALL, WAY, DOOR = "#0072b2", "#8a8a8a", "#c9d4df", "#8b4513"
INDOORS = "Broad pale lines are corridors, C0, C1 and so on, and brown dots are doors. "
CORRIDOR = 14.0  # width of the line of a corridor, in units of the page
ASIDE = 5.0  # metres between drives that no map joins


def figure(log: RobotLog, imported: Imported, solution: Solution) -> str:
    """Draw the first map over the scans, with a caption; without a map, draw the visits."""
    drives = drives_of(imported.trace)
    sheet = _Sheet.of(log, imported, solution.maps[0] if solution.maps else None)
    marks = [*sheet.walls_and_way()]
    if solution.maps:
        marks += _map_marks(sheet, imported, solution)
    else:
        marks += [Titled("visit", (Disc(p, (4, 4), "#d55e00"),)) for p in sheet.spots]
    picture = svg_of(Scene(tuple(marks), sheet.unit))
    poses = (
        "corrected poses of the log, which were not read for the map"
        if sheet.is_corrected
        else "the poses of the track, which drifts"
    )
    if len(drives) > 1 and solution.maps and drawable_poses(solution.maps[0]):
        poses += ". Drives lie over each other where the map joins them"
    if not solution.maps:
        caption = f"The visits over the scans, at {poses}."
    else:
        colours = "Colours are paths. " if solution.maps[0].theory_paths else ""
        if len(drives) > 1:
            colours = f"Colours are drives: {legend(drives)}. "
        caption = (
            f"The first map over the scans, at {poses}. Numbers are places, ticks their gateways, "
            "and lines the edges along the robot's course, drawn once where several run together. "
            f"{colours}North, in corrections, is up. Dots are places at which the robot only "
            "passed through; point at one to see its number. Bands are regions that, as far as "
            "known, have only one entrance. "
            f"{INDOORS if solution.maps[0].building else ''}"
            + (
                "Red shows the probability of a doubtful join."
                if trusted(solution.weighed) or not solution.weighed
                else "Which joins are doubtful is unknown."
            )
        )
    return f"<figure>{picture}<figcaption>{caption}</figcaption></figure>"


def legend(drives: Sequence[Drive]) -> str:
    """Write the names of drives in HTML, each with a dot in its colour."""
    return ", ".join(
        f'<span style="color:{colour_of(k)}">●</span> {escaped(drive.name)}'
        for k, drive in enumerate(drives)
    )


@dataclass(frozen=True)
class _Sheet:
    """What is drawn under the map, in metres."""

    poses: Sequence[Pose]  # the pose of each scan
    headings: Sequence[float]  # the heading of each step, in radians
    spots: Sequence[Point]  # the middle of the place of each visit, by its own pose
    walls: Array  # (n, 2) points of walls
    unit: float  # units of the page in a metre
    is_corrected: bool  # whether the poses are corrected ones
    bounds: Sequence[int]  # the first scan of each drive, and the number of scans

    @classmethod
    def of(cls, log: RobotLog, imported: Imported, ssh_map: SSHMap | None) -> _Sheet:
        track: list[Pose] = [(x, y, heading) for x, y, heading in imported.track.poses.tolist()]
        corrected = [scan.corrected for scan in log.scans if scan.corrected is not None]
        is_corrected = len(corrected) == len(log)
        poses = laid_over(corrected if is_corrected else track, imported, ssh_map)
        walls = _walls(log, poses)
        seen = _spots(poses, imported)
        first = firsts((visit, t) for t, visit in enumerate(_visit_of(imported)))
        spots = [seen[first[visit]][:2] for visit in range(len(imported.visits))]
        headings = [heading for _, _, heading in seen]
        extent = np.ptp(np.concatenate([walls, [pose[:2] for pose in poses]]), axis=0).max()
        unit = min(METRE, LARGEST / max(float(extent), 1.0))
        bounds = (0, *imported.starts, len(log))
        return cls(poses, headings, spots, walls, unit, is_corrected, bounds)

    def drive_of(self, scan: int) -> int:
        """The index of the drive of a scan."""
        return bisect(self.bounds, scan) - 1

    def walls_and_way(self) -> Iterator[Mark]:
        """Draw the walls as dots, and the way of the robot as lines, one for each drive."""
        dots = tuple(((x, y),) for x, y in self.walls.tolist())
        yield Line(dots, WALL, max(GRAIN * self.unit, 1.0))
        for k, (begin, stop) in enumerate(pairwise(self.bounds)):
            colour = WAY if len(self.bounds) == 2 else colour_of(k)
            way = tuple((x, y) for x, y, _ in self.poses[begin:stop])
            yield Line((way,), colour, 1.0, 0.6)


def _map_marks(sheet: _Sheet, imported: Imported, solution: Solution) -> Iterator[Mark]:
    """Draw the edges and places of the first map."""
    ssh_map = solution.maps[0]
    places = place_of_steps(ssh_map)
    visit_of = _visit_of(imported)
    visits: dict[int, list[int]] = defaultdict(list)
    for place, visit in zip(places, visit_of, strict=True):
        if place is not None and visit not in visits[place]:
            visits[place].append(visit)
    # A place is drawn at the mean of its visits.
    middles = {p: np.mean([sheet.spots[v] for v in seen], axis=0) for p, seen in visits.items()}
    doubtful = solution.weighed.doubtful if solution.weighed else None
    doubts = firsts((places[second], share) for _, second, share in doubtful or ())
    hidden = undecided_places(ssh_map) - doubts.keys()
    shown = {place: middle for place, middle in middles.items() if place not in hidden}
    edges = list(_edges(sheet, imported, ssh_map, visit_of, middles))
    yield from _bands(sheet, ssh_map, middles, [(places[t], places[t + 1], c) for t, c in edges])
    if drawable_poses(ssh_map):
        yield from _corridors(sheet, ssh_map)
    lines: dict[str, list[Array]] = defaultdict(list)
    for step, course in edges:
        path = ssh_map.dstates[ssh_map.dstate_at[step]].path
        colour = EDGE if path is None else colour_of(path)
        if len(sheet.bounds) > 2:
            colour = colour_of(sheet.drive_of(imported.visits[visit_of[step]].scan))
        lines[colour].append(course)
    for colour, courses in lines.items():
        for part in drawn_once(courses):
            yield Line((_points(part),), colour, 4.0, 0.8)
    for door in ssh_map.doors if drawable_poses(ssh_map) else ():
        yield Titled(ssh_map.called("door", door.id), (Disc(door.at, (4, 4), DOOR),))
    at: dict[int, Point] = {p: (float(x), float(y)) for p, (x, y) in middles.items()}
    for place in visits:
        if place in hidden:
            yield Titled(ssh_map.called("place", place), (Disc(at[place], (4, 4), EDGE),))
    for place in shown:
        step = visit_of.index(visits[place][-1])
        yield from _place(sheet, imported, at[place], step)
    # Numbers and names come last, so that nothing covers them.
    for place in shown:
        yield from _number(at[place], str(place), doubts.get(place), 1 / sheet.unit)
    for place in visits:
        if name := ssh_map.name_of("place", place):
            x, y = at[place]
            yield Label((x, y - 18 / sheet.unit), name, size=11, is_bold=True)


def _corridors(sheet: _Sheet, ssh_map: SSHMap) -> Iterator[Mark]:
    """Draw corridors as broad lines with their names."""
    for corridor in ssh_map.corridors:
        name = ssh_map.name_of("corridor", corridor.id) or f"C{corridor.id}"
        line = Line((corridor.line,), colour_of(corridor.path), CORRIDOR, 0.3)
        yield Titled(ssh_map.called("corridor", corridor.id), (line,))
        x, y = corridor.line[len(corridor.line) // 2]
        yield Label((x, y + 18 / sheet.unit), name, size=12, is_bold=True)


def _bands(
    sheet: _Sheet,
    ssh_map: SSHMap,
    middles: Mapping[int, Array],
    edges: Sequence[tuple[int | None, int | None, Array]],
) -> Iterator[Mark]:
    """Draw a band for each region behind one place, along the courses between its places."""
    for region, width in banded(ssh_map, BROAD * sheet.unit):
        ways = [_points(middles[p][None]) for p in region.places if p in middles]
        ways += [
            _points(course) for first, last, course in edges if {first, last} <= {*region.places}
        ]
        yield band(region, ways, width)


def _edges(
    sheet: _Sheet,
    imported: Imported,
    ssh_map: SSHMap,
    visit_of: Sequence[int],
    middles: Mapping[int, Array],
) -> Iterator[tuple[int, Array]]:
    """Yield the edges: the step at which the robot first set out, and the course, (n, 2) metres.

    An edge that several drives took comes once for each drive. Edges lead to the `middles` of
    places.
    """
    places, drawn = place_of_steps(ssh_map), set[tuple[int, int]]()
    for t, edge in edges_of(imported.trace, ssh_map).items():
        ends = [p for p in places[t : t + 2] if p is not None]
        begin, end = (imported.visits[visit_of[k]] for k in (t, t + 1))
        if (key := (sheet.drive_of(begin.scan), edge)) in drawn:
            continue
        way = np.array([pose[:2] for pose in sheet.poses[begin.scan : end.scan + 1]])
        way = way.reshape(-1, 2)
        # Near the places, the course leads straight to their middles.
        first, last = ([middles[p]] if p in middles else [] for p in ends)
        for middle in (*first, *last):
            way = way[np.hypot(*(way - middle).T) >= MIDDLE]
        course = np.array([*first, *way, *last])
        if len(course) > 1:
            drawn.add(key)
            yield t, course


def drawn_once(courses: Sequence[Array]) -> Iterator[Array]:
    """Yield courses, (n, 2) metres, without the parts that run beside a shorter course.

    If a local map does not show a place that the robot passes, its travel is an edge that runs
    along two shorter ones. A part that is left begins and ends on the lines that it leaves.
    """
    drawn = np.empty((0, 2))
    for course in sorted((resampled(course, STEP) for course in courses), key=len):
        far, nearest = cKDTree(drawn).query(course)
        bounds = np.flatnonzero(np.diff(far > BESIDE, prepend=False, append=False))
        parts = []
        for begin, stop in bounds.reshape(-1, 2).tolist():
            before = drawn[nearest[begin - 1 : begin]] if begin else []
            parts.append(np.array([*before, *course[begin:stop], *drawn[nearest[stop : stop + 1]]]))
        yield from parts
        drawn = np.concatenate([drawn, *parts])


def _place(sheet: _Sheet, imported: Imported, at: Point, step: int) -> Iterator[Mark]:
    """Draw the disc of a place, and a tick for each open gateway, both by the visit of a step."""
    seen = imported.trace.steps[step]
    radius = max(imported.visits[int(seen.extra["visit"])].radius * sheet.unit, 11.0)
    yield Disc(at, (radius, radius), EDGE, EDGE, 1.0, fill_opacity=0.12)
    for way in Star.of(seen.star or ()).gateways:
        if way.open:
            angle = sheet.headings[step] - math.radians(way.bearing)
            far = [(radius + more) / sheet.unit for more in (-3, 4)]
            ends = [(at[0] + r * math.cos(angle), at[1] + r * math.sin(angle)) for r in far]
            yield Line((tuple(ends),), "#222", 2.5)


def _number(at: Point, name: str, doubt: float | None, unit: float) -> Iterator[Mark]:
    """Draw the number of a place, and the probability of its most doubtful join.

    `unit` is a unit of the page in metres.
    """
    yield Disc(at, (8, 8), "white", "#222", 1.0)
    yield Label(at, name, size=10, is_bold=True)
    if doubt is not None:
        ring = Disc(at, (13, 13), "none", ALARM, 2.0, dashes="4 3")
        beside = at[0] + 26 * unit, at[1] + 12 * unit
        told = Label(beside, f"{doubt:.2f}", ALARM, 11, is_bold=True)
        yield Titled(f"a join at place {name} has probability {doubt:.2f}", (ring, told))


def _points(course: Array) -> tuple[Point, ...]:
    """Convert an array (n, 2) to points."""
    return tuple((float(x), float(y)) for x, y in course)


def _walls(log: RobotLog, poses: Sequence[Pose]) -> Array:
    """Find the walls: one point, in metres, for each square in which a laser beam ended, (n, 2).

    The squares have sides of GRAIN metres. In a log of more than 100 scans, at least two beams must
    have ended in a square, so that few stray beams are drawn.
    """
    squares = np.zeros((0, 2), int)
    counts: Array = np.zeros(0)
    # The ends of all beams of a long log would need much memory.
    for begin in range(0, len(log), AT_ONCE):
        some = slice(begin, begin + AT_ONCE)
        ends = map(_ends, log.scans[some], poses[some])
        cells = np.rint(np.concatenate(list(ends)) / GRAIN).astype(int)
        every, weights = np.concatenate([squares, cells]), np.append(counts, np.ones(len(cells)))
        squares, numbers = np.unique(every, axis=0, return_inverse=True)
        counts = np.bincount(numbers.ravel(), weights).astype(float)
    return np.asarray(squares[counts > (1 if len(log) > 100 else 0)] * GRAIN)


def _ends(scan: Scan, pose: Pose) -> Array:
    """The points, in metres, at which the beams of a scan ended: (n, 2)."""
    x, y, heading = moved(pose, scan.laser.mount)
    near = np.isfinite(scan.ranges) & (scan.ranges < min(DRAWN, scan.laser.reach))
    far, angles = scan.ranges[near], heading + scan.laser.bearings[near]
    return np.stack([x + far * np.cos(angles), y + far * np.sin(angles)], axis=1)


def laid_over(poses: Sequence[Pose], imported: Imported, ssh_map: SSHMap | None) -> list[Pose]:
    """Move the poses of each drive to where the map has its steps.

    Without a map with poses, a drive faces along x at its first step, and each drive is beside the
    one before.
    """
    at = drawable_poses(ssh_map) if ssh_map else None
    spots, right, lowest = _spots(poses, imported), -ASIDE, 0.0
    laid: list[Pose] = []
    bounds = pairwise([0, *imported.starts, len(poses)])
    for drive, (begin, stop) in zip(drives_of(imported.trace), bounds, strict=True):
        steps = range(drive.first, drive.stop)
        if at and ssh_map:
            there = [at[ssh_map.dstate_at[t]] for t in steps]
            by = _fitted([spots[t] for t in steps], [(p.x, p.y, p.heading) for p in there])
            part = [moved(by, pose) for pose in poses[begin:stop]]
        else:
            part = [moved((0.0, 0.0, -spots[drive.first][2]), pose) for pose in poses[begin:stop]]
            xs, ys = [x for x, _, _ in part], [y for _, y, _ in part]
            if laid:
                by = right + ASIDE - min(xs), lowest - min(ys), 0.0
                part = [moved(by, pose) for pose in part]
            right, lowest = max(x for x, _, _ in part), min(y for _, y, _ in part)
        laid += part
    return laid


def _fitted(here: Sequence[Pose], there: Sequence[Pose]) -> Pose:
    """Fit the rigid motion that moves poses to other poses, by least squares.

    Besides the positions, it fits the points a metre ahead of them.
    """
    ends = [
        [complex(x, y) + ahead for x, y, heading in some for ahead in (0, cmath.rect(1.0, heading))]
        for some in (here, there)
    ]
    turn, shift = fitted_motion(*ends)
    return shift.real, shift.imag, cmath.phase(turn)


def _visit_of(imported: Imported) -> list[int]:
    """The visit of each step."""
    return [int(step.extra["visit"]) for step in imported.trace.steps]


def _spots(poses: Sequence[Pose], imported: Imported) -> list[Pose]:
    """The pose of each step: the middle of its place, and the heading of the robot."""
    spots = []
    for step in imported.trace.steps:
        visit = imported.visits[int(step.extra["visit"])]
        x, y, heading = step.extra["seen"]
        spots.append(moved(poses[visit.scan], (float(x), float(y), float(heading))))
    return spots
