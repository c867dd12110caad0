"""Distinctive places: junctions of skeletons, turning points, and the ways out of a place."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from perception.places.distinctive import Visit, Way, find_visits
from perception.places.local_map import CELL, LocalMaps, Patch, Recent
from perception.places.passages import Passages
from perception.places.skeleton import junctions
from perception.places.track import Track
from perception.readers.scans import LaserScanner, RobotLog, Scan
from simulator.robot import meetings
from ssh_abduction.data.odometry import radians_between

ROOM = 0.25  # half of the robot's width in metres
BEARINGS = np.radians(np.arange(-180.0, 180.0, 2.0))
Segments = list[tuple[float, float, float, float]]
Box = tuple[float, float, float, float]


def patch_of(*boxes: Box, solid: tuple[Box, ...] = ()) -> Patch:
    """A local map of 16 x 16 m whose free space is boxes, each (x, y, x, y) in metres.

    The robot drove along the middle of the first box.
    """
    at = np.arange(-80, 81) * CELL
    x, y = np.meshgrid(at, at, indexing="ij")

    def inside(box: Box) -> np.ndarray:
        return (x >= box[0]) & (x <= box[2]) & (y >= box[1]) & (y <= box[3])

    free = np.any([inside(box) for box in boxes], axis=0)
    for box in solid:
        free &= ~inside(box)
    left, low, right, high = boxes[0]
    middle = (low + high) / 2
    trail = (np.abs(y - middle) < CELL / 2) & (x >= left) & (x <= right)
    return Patch(free, ~free, trail & free, np.array([-8.0, -8.0]))


CORRIDOR = (-8.0, -1.0, 8.0, 1.0)


@pytest.mark.parametrize(
    ("patch", "bearings"),
    [
        pytest.param(patch_of(CORRIDOR), [], id="corridor"),
        pytest.param(patch_of(CORRIDOR, (-1, -8, 1, 8)), [-180, -90, 0, 90], id="crossing"),
        pytest.param(patch_of(CORRIDOR, (-1, 0, 1, 8)), [-180, 0, 90], id="fork"),
        pytest.param(patch_of(CORRIDOR, (-0.5, 0, 0.5, 1.5)), [], id="niche"),
        pytest.param(
            patch_of((-8, -2, 8, 2), solid=((0.0, -0.4, 0.8, 0.4),)), [], id="free-standing desk"
        ),
        pytest.param(patch_of(CORRIDOR, (-0.2, 0, 0.2, 8)), [], id="gap too narrow for the robot"),
        pytest.param(
            patch_of(CORRIDOR, (-1.5, 0, 0.5, 8), (-0.5, -8, 1.5, 0)),
            [-180, -90, 0, 90],
            id="two forks in one space",
        ),
    ],
)
def test_junctions_are_found_where_ways_meet(patch: Patch, bearings: list[float]) -> None:
    found = junctions(patch, ROOM)
    assert len(found) == bool(bearings)
    for junction in found:
        assert math.hypot(*junction.middle) < 1.0
        assert 0.5 < junction.radius < 2.0
        ways = [np.arctan2(*(branch[-1] - junction.middle)[::-1]) for branch in junction.branches]
        assert len(ways) == len(bearings)
        for bearing in np.radians(bearings):
            assert min(radians_between(way, bearing) for way in ways) < math.radians(20)


@pytest.mark.parametrize(("length", "count"), [(0.8, 0), (3.0, 2)], ids=["desk", "wall"])
def test_long_obstacle_that_stands_free_is_a_wall(length: float, count: int) -> None:
    """Doors at both ends of a wall leave it alone in free space. Ways part at these ends."""
    rooms = patch_of((-8, 0.2, 8, 2), (-8, -2, 8, 2), solid=((-length / 2, -0.1, length / 2, 0.1),))
    found = junctions(rooms, ROOM)
    assert len(found) == count
    for junction in found:
        assert length / 2 < abs(junction.middle[0]) < length / 2 + 2.5
        assert len(junction.branches) == 3


def test_robot_wider_than_the_map_finds_no_junctions() -> None:
    """A mask as wide as this robot needs more memory than there is."""
    assert not junctions(patch_of(CORRIDOR, (-1, -8, 1, 8)), 25.0)


HALL = (-6.0, -6.0, 6.0, 6.0)
DOOR = (-4.5, 5.0, -3.5, 8.0)  # in the upper wall of the hall, at x = -4
OPPOSITE = (3.5, -8.0, 4.5, -5.0)
MOUTH, MOUTH_OPPOSITE = (-4.0, 4.5), (4.0, -4.5)


@pytest.mark.parametrize(
    ("patch", "mouths"),
    [
        pytest.param(patch_of(HALL), [], id="hall without a door"),
        pytest.param(patch_of(HALL, DOOR), [MOUTH], id="hall with a door"),
        pytest.param(patch_of(HALL, DOOR, OPPOSITE), [MOUTH, MOUTH_OPPOSITE], id="two doors"),
        pytest.param(
            patch_of(HALL, DOOR, OPPOSITE, solid=((-1.0, -1.0, 0.0, 0.0),)),
            [MOUTH, MOUTH_OPPOSITE],
            id="a pillar in the middle",
        ),
        pytest.param(
            patch_of((-8, -8, 8, 6), DOOR), [MOUTH], id="hall that is larger than the local map"
        ),
        pytest.param(
            patch_of((-8, -2, 8, 2), (-0.5, 0, 0.5, 8)), [(0.0, 0.0)], id="corridor, not open"
        ),
        pytest.param(
            patch_of((-8, -3, 8, 3), (-0.5, 0, 0.5, 8)),
            [(0.0, 1.5), (0.0, 0.0)],
            id="corridor as wide as a hall",
        ),
    ],
)
def test_open_space_has_a_junction_at_each_door(
    patch: Patch, mouths: list[tuple[float, float]]
) -> None:
    found = [junction.middle for junction in junctions(patch, ROOM)]
    assert len(found) == len(mouths)
    for mouth in mouths:
        assert min(math.dist(middle, mouth) for middle in found) < 0.4


def test_junction_in_a_hall_has_a_disc_of_limited_radius() -> None:
    """Ways from four sides also meet in the middle of a hall."""
    hall = patch_of((-4, -4, 4, 4), (-8, -1, 8, 1), (-1, -8, 1, 8))
    found = sorted(junctions(hall, ROOM), key=lambda junction: math.hypot(*junction.middle))
    assert len(found) == 5
    assert math.hypot(*found[0].middle) < 0.3
    assert found[0].radius == pytest.approx(1.5)
    for mouth in found[1:]:
        assert 2 < math.hypot(*mouth.middle) < 3.5


def bent(degrees: float) -> Patch:
    """A corridor from the west, 2 m wide, that turns left at (0, 0) by some degrees."""
    straight = patch_of((-8, -1, 0, 1))
    at = np.arange(-80, 81) * CELL
    x, y = np.meshgrid(at, at, indexing="ij")
    turn = math.radians(degrees)
    along, across = x * math.cos(turn) + y * math.sin(turn), y * math.cos(turn) - x * math.sin(turn)
    free = straight.free | ((along >= 0) & (np.abs(across) <= 1)) | (np.hypot(x, y) <= 1)
    return replace(straight, free=free, occupied=~free)


@pytest.mark.parametrize(("degrees", "ways"), [(0, None), (20, None), (60, 60), (90, 90)])
def test_a_corner_of_a_corridor_is_a_junction_of_two_ways(degrees: int, ways: int | None) -> None:
    found = junctions(bent(degrees), ROOM)
    assert len(found) == (ways is not None)
    for corner in found:
        assert math.hypot(*corner.middle) < 0.6
        back, ahead = sorted(
            (np.arctan2(*(branch[-1] - corner.middle)[::-1]) for branch in corner.branches),
            key=lambda way: -abs(way),
        )
        assert radians_between(back, math.pi) < math.radians(15)
        assert radians_between(ahead, math.radians(degrees)) < math.radians(15)


def log_of(walls: Segments, way: list[tuple[float, float]]) -> tuple[RobotLog, Track]:
    """The log of a robot with an exact odometer that drives along a way between walls."""
    laser = LaserScanner(float(BEARINGS[0]), math.radians(2), len(BEARINGS), 20.0)
    poses = []
    for here, there in pairwise(way):
        dx, dy = np.subtract(there, here)
        parts = np.arange(0, 1, 0.2 / math.hypot(dx, dy))
        poses += [(here[0] + k * dx, here[1] + k * dy, math.atan2(dy, dx)) for k in parts]
    ranges = meetings(np.array(walls, float), np.array(poses), BEARINGS).min(axis=2)
    scans = tuple(
        Scan(found, laser, (float(x), float(y), float(heading)))
        for found, (x, y, heading) in zip(ranges, poses, strict=True)
    )
    return RobotLog(scans, source="x"), Track(np.array(poses), np.zeros((len(poses), 3, 3)))


# A corridor along x, 2 m wide, with a side corridor to the left at x = 10.
FORK: Segments = [
    (0, -1, 20, -1),
    (0, -1, 0, 1),
    (20, -1, 20, 1),
    (0, 1, 9, 1),
    (11, 1, 20, 1),
    (9, 1, 9, 10),
    (11, 1, 11, 10),
    (9, 10, 11, 10),
]


def test_openings_on_two_sides_stay_apart_beyond_the_start_of_a_course() -> None:
    """Each shows at one point of its side, like clutter. On one side, they would be wide space."""
    walls: Segments = [(-6, 0.6, -0.65, 0.6), (0.15, 0.6, 8, 0.6), (-6, -0.6, -0.4, -0.6)]
    walls += [(0.4, -0.6, 1.5, -0.6), (1.5, -0.6, 1.5, -3), (1.5, -3, 8, -3), (8, -3, 8, 0.6)]
    log, track = log_of(walls, [(-6, 0), (7, 0)])
    first, last = (
        Visit(scan, np.array([x, 0.0]), scan, scan) for scan, x in ((30, 0.0), (60, 6.0))
    )
    found = Passages(log, track).along(np.array([[0.0, 0.0], [6.0, 0.0]]), first, last)
    assert np.array(found["widths"])[[1, 5]] == pytest.approx(0.6, abs=0.1)
    assert not [door for door in found["doors"] if door["side"] == "through"]


def test_find_visits_at_a_fork_and_at_a_turn_in_a_dead_end() -> None:
    log, track = log_of(FORK, [(1, 0), (18, 0), (10, 0), (10, 8)])
    _, fork, end, again, _ = find_visits(log, track)
    assert math.dist(fork.middle, (10, 0)) < 0.5
    assert math.dist(end.middle, (18, 0)) < 0.5
    assert math.dist(again.middle, (10, 0)) < 0.5
    assert (end.arrived, end.support) == (end.left, 0.0)

    def degrees(visit: object, way: int | None) -> float:
        return math.degrees(visit.ways[way].bearing)  # type: ignore[attr-defined, index]

    for visit in (fork, again):
        assert [round(math.degrees(way.bearing) / 90) % 4 for way in visit.ways] in (
            [0, 1, 2],
            [2, 0, 1],
        )
    assert abs(degrees(fork, fork.left)) < 15
    assert abs(abs(degrees(fork, fork.arrived)) - 180) < 15
    assert abs(degrees(again, again.arrived)) < 15
    assert abs(degrees(again, again.left) - 90) < 15


def test_turning_in_a_bow_is_one_visit() -> None:
    bow = [(17.5, -0.6), (18, -0.2), (18, 0.2), (17.5, 0.6)]
    log, track = log_of(FORK, [(1, -0.6), *bow, (10, 0.6), (10, 8)])
    middles = [visit.middle for visit in find_visits(log, track)]
    assert len(middles) == 5
    assert math.dist(middles[2], (18, 0)) < 0.5


def test_turning_inside_a_disc_is_one_visit() -> None:
    log, track = log_of(FORK, [(1, 0), (10.8, 0), (10, 0), (10, 8)])
    _, *visits, _ = find_visits(log, track)
    assert [round(float(visit.middle[0])) for visit in visits] == [10]


def test_turning_outside_a_disc_is_a_visit_of_its_own() -> None:
    """The robot passes the fork, comes back from the east, and leaves to the north."""
    log, track = log_of(FORK, [(1, 0), (11.4, 0), (10, 0), (10, 8)])
    _, fork, end, again, _ = find_visits(log, track)
    assert fork.scan < end.scan < again.scan
    assert math.dist(end.middle, (11.4, 0)) < 0.3
    ways = [fork.arrived, fork.left], [end.arrived, end.left], [again.arrived, again.left]
    quarters = [
        [round(2 * visit.ways[way].bearing / math.pi) % 4 for way in both]
        for visit, both in zip((fork, end, again), ways, strict=True)
    ]
    assert quarters == [[2, 0], [2, 2], [0, 1]]


def test_successive_visits_to_one_place_are_joined() -> None:
    """The robot leaves the disc to the east, and comes back and leaves to the north."""
    west, east, north = Way(-math.pi), Way(0.0), Way(math.pi / 2)
    middle = np.zeros(2)
    first = Visit(5, middle, 3, 7, 1.0, (west, east), arrived=0, left=1)
    stay = first.joined(Visit(12, middle + 0.2, 10, 14, 1.0, (east, north), arrived=0, left=1))
    assert (stay.begin, stay.end) == (3, 14)
    assert [way.bearing for way in stay.ways] == [-math.pi, 0.0, math.pi / 2]
    assert (stay.arrived, stay.left) == (0, 2)


def test_track_may_leap_far_beside_a_place() -> None:
    """The odometer may restart unnoticed, for example."""
    log, track = log_of(FORK, [(1, 0), (18, 0)])
    leap = np.where(track.poses[:, :1] > 11, [100.0, 0.0, 0.0], 0.0)
    middles = [
        visit.middle[0] for visit in find_visits(log, replace(track, poses=track.poses + leap))
    ]
    assert any(abs(x - 10) < 1 for x in middles)


def test_wide_robot_has_fewer_ways() -> None:
    log, track = log_of(FORK, [(1, 0), (18, 0)])
    assert len(find_visits(log, track, 0.5)) == 3
    assert len(find_visits(log, track, 2.4)) == 2


@pytest.mark.parametrize(
    ("begin", "end", "middles"),
    [
        pytest.param(1, 18, [1, 10, 18], id="in dead ends"),
        pytest.param(9, 12.5, [10, 12.5], id="in the disc of the fork"),
        pytest.param(1, 2, [], id="near each other"),
    ],
)
def test_drive_begins_and_ends_with_a_visit(begin: float, end: float, middles: list[float]) -> None:
    log, track = log_of(FORK, [(begin, 0), (end, 0)])
    visits = find_visits(log, track)
    assert [float(visit.middle[0]) for visit in visits] == pytest.approx(middles, abs=0.5)
    for visit, way in zip(visits[:: max(1, len(visits) - 1)], ("arrived", "left"), strict=False):
        assert getattr(visit, way) is None


@pytest.mark.parametrize(
    ("beams", "is_open"),
    [
        pytest.param(1, False, id="one beam"),
        pytest.param(3, False, id="three beams"),
        pytest.param(20, True, id="a door"),
    ],
)
def test_few_lost_beams_show_no_free_space_behind_a_wall(beams: int, is_open: bool) -> None:
    laser = LaserScanner(-math.pi / 4, math.radians(1), 91, 30.0)
    ranges = 3 / np.cos(laser.bearings)  # a wall 3 m ahead
    ranges[45 : 45 + beams] = np.inf
    recent = Recent()
    recent.append(Scan(ranges, laser, (0.0, 0.0, 0.0)), (0.0, 0.0, 0.0))
    patch = LocalMaps(recent, 5.0).around(0, (5.0, 0.0), 1.5)
    assert patch.free.any() == is_open
