"""Paths, sides, corridors, doors and rooms that follow from a finished map."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from perception.places.passages import (
    STEP,
    WIDE,
    doors_in,
    has_straight_walls,
    openings_in,
    resampled,
)
from ssh_abduction import SSHMap, Theory, Trace, solve
from ssh_abduction.building.derive import buildings_of, with_building
from ssh_abduction.building.directions import RouteCourse, directions_to
from ssh_abduction.building.edges import LEG, PlanEdge, _corners
from ssh_abduction.building.rooms import GRID, drawn, strips_of
from ssh_abduction.building.straight_paths import PRICE, best_pairings, chains_of, sides_of
from ssh_abduction.building.telling import told
from ssh_abduction.checker.buildings import faults_of_corridors, faults_of_paths
from ssh_abduction.checker.checker import check
from ssh_abduction.cli import main
from ssh_abduction.data.building import Corridor
from ssh_abduction.data.corrections import Corrections, Naming
from ssh_abduction.data.drives import drives_of
from ssh_abduction.data.errors import MapError
from ssh_abduction.data.maps import DState, Fit, MapPath, Name, Pose, Region
from ssh_abduction.data.parts_of_dstates import number_at
from ssh_abduction.data.trace import Action, Step
from ssh_abduction.online.routes import route
from ssh_abduction.robot_logs.log_maps import BARE
from ssh_abduction.solution.values import Cost

Point = tuple[float, float]
TRAVEL = Action.of("travel")


def drive(
    points: Sequence[Point],
    visits: Sequence[int],
    width: float = 2.0,
    doors: Iterable[tuple[int, int]] = (),
    courses: dict[tuple[int, int], list[Point]] | None = None,
) -> tuple[SSHMap, Trace]:
    """A drive along places at points, between walls, with doors halfway of some travels."""
    steps, states, poses, labels = [], [], [], []
    known: dict[tuple[int, int], int] = {}
    doors = {frozenset(door) for door in doors}
    for t, (p, q) in enumerate(itertools.pairwise([*visits, visits[-1]])):
        a, b = points[p], points[q]
        if p == q:
            heading, extra = 0.0, {}
        else:
            way = [a, *((courses or {}).get((p, q)) or (courses or {}).get((q, p), [])[::-1]), b]
            heading = math.atan2(way[1][1] - a[1], way[1][0] - a[0])
            turn = complex(math.cos(heading), -math.sin(heading))
            off = [complex(x - a[0], y - a[1]) * turn for x, y in way[1:]]
            length = float(np.hypot(*np.diff(np.array(way), axis=0).T).sum())
            count = len(resampled(np.array(way), STEP))
            door = {"at": length / 2, "width": 0.9, "side": "through"}
            extra = {
                "course": [[z.real, z.imag] for z in off],
                "widths": [[width / 2, width / 2]] * count,
                "doors": [door] if frozenset((p, q)) in doors else [],
            }
        key = p, round(math.degrees(heading)) % 360
        if key not in known:
            known[key] = len(states)
            states.append(DState(len(states), "v", p))
            poses.append(Pose(*a, heading))
        labels.append(known[key])
        last = t == len(visits) - 1
        steps.append(Step("v", None if last else TRAVEL, extra=extra))
    links = sorted({(a, "travel", b) for a, b in itertools.pairwise(labels)})
    places = tuple(sorted({s.place for s in states if s.place is not None}))
    fit = Fit(0.0, 0, 1.0, poses=tuple(poses))
    ssh_map = SSHMap(tuple(labels), tuple(states), tuple(links), places, fit=fit)
    return ssh_map, Trace(tuple(steps))


def orders(ssh_map: SSHMap) -> set[tuple[int, ...]]:
    """The orders of the paths, each from its smaller end."""
    return {min(p.order, p.order[::-1]) for p in ssh_map.paths}


LINE = [(0.0, 0.0), (5.0, 0.0), (10.0, 0.0), (15.0, 0.0)]
# A corridor with a side corridor to the left at place 1, and one to the right at place 2.
CROSS = [*LINE, (5.0, 6.0), (10.0, -6.0)]
TOUR = [0, 1, 4, 1, 2, 5, 2, 3, 2, 1, 0]


@pytest.mark.parametrize(
    ("points", "visits", "expected"),
    [
        (LINE, [0, 1, 2, 3], {(0, 1, 2, 3)}),
        (LINE, [3, 2, 1, 0], {(0, 1, 2, 3)}),
        (CROSS, TOUR, {(0, 1, 2, 3), (1, 4), (2, 5)}),
        # An L ends a path.
        ([(0, 0), (6, 0), (6, 6)], [0, 1, 2], {(0, 1), (1, 2)}),
        # Of three equal branches of a Y, none are paired.
        (
            [(0, 0), (6, 0), (-3, 5.2), (-3, -5.2)],
            [1, 0, 2, 0, 3, 0, 1],
            {(0, 1), (0, 2), (0, 3)},
        ),
        # A robot that zigzags through a wide hall is on one path.
        ([(4.0 * k, 0.6 * (-1) ** k) for k in range(6)], [*range(6)], {(0, 1, 2, 3, 4, 5)}),
        # A corridor that bends slowly is one path.
        (
            [(20 * math.sin(0.25 * k), 20 * math.cos(0.25 * k)) for k in range(7)],
            [*range(7)],
            {(0, 1, 2, 3, 4, 5, 6)},
        ),
    ],
)
def test_paths_go_straight_on(
    points: list[Point], visits: list[int], expected: set[tuple[int, ...]]
) -> None:
    found = with_building(*drive(points, visits, width=4.0 if len(visits) == 6 else 2.0))
    assert orders(found) == expected
    assert all(0.5 < (path.sure or 0) <= 1 for path in found.paths)


def test_an_offset_crossing_does_not_pair() -> None:
    """Two corridors that meet a third one 3 m apart are two paths."""
    points = [(0.0, 0.0), (6.0, 0.0), (9.0, 0.0), (15.0, 0.0), (6.0, 7.0), (9.0, -7.0)]
    found = with_building(*drive(points, [0, 1, 4, 1, 2, 5, 2, 3]))
    assert orders(found) == {(0, 1, 2, 3), (1, 4), (2, 5)}


def test_a_travel_is_cut_where_it_passes_a_place() -> None:
    found = with_building(*drive(CROSS, [0, 1, 4, 1, 2, 5, 2, 3, 0]))
    assert orders(found) == {(0, 1, 2, 3), (1, 4), (2, 5)}


def test_sides_and_mirror_images() -> None:
    found = with_building(*drive(CROSS, TOUR))
    (street,) = (path for path in found.paths if len(path.order) == 4)
    forward = street.order[0] == 0
    assert street.left == ((4,) if forward else (5,))
    assert street.left_of(4 if forward else 5)
    assert street.right_of(5 if forward else 4)
    mirrored = with_building(*drive([(x, -y) for x, y in CROSS], TOUR))
    (image,) = (path for path in mirrored.paths if len(path.order) == 4)
    assert image.order == street.order
    assert (image.left, image.right) == (street.right, street.left)


def test_a_turned_course_has_the_same_corners() -> None:
    """Its shorter leg is exactly as long as the longest leg without a corner."""
    legs = np.concatenate([np.arange(0, LEG, STEP), LEG + 1j * np.arange(0, 4.1, STEP)])
    for degrees in range(0, 360, 7):
        way = legs * np.exp(1j * math.radians(degrees))
        assert not [*_corners(np.stack([way.real, way.imag], axis=1))]


def test_turned_and_backward_drives_give_the_same_paths() -> None:
    expected = orders(with_building(*drive(CROSS, TOUR)))
    turn = complex(math.cos(1.0), math.sin(1.0))
    turned = [(z.real, z.imag) for x, y in CROSS for z in [complex(x, y) * turn + 3]]
    assert orders(with_building(*drive(turned, TOUR))) == expected
    assert orders(with_building(*drive(CROSS, [5, 2, 3, 2, 1, 4, 1, 0]))) == expected
    renamed = [3, 1, 5, 0, 2, 4]  # the new number of each place
    points = [CROSS[renamed.index(p)] for p in range(6)]
    found = with_building(*drive(points, [renamed[p] for p in TOUR]))
    new = {tuple(renamed[p] for p in order) for order in expected}
    assert orders(found) == {min(order, order[::-1]) for order in new}


def test_places_on_a_loop_lie_around() -> None:
    """Ways left and right of the street 0-1-2 lead to place 3, round its end."""
    points = [
        (0.0, 0.0),
        (5.0, 0.0),
        (10.0, 0.0),
        (5.0, 8.0),
        (5.0, -8.0),
        (16.0, 8.0),
        (16.0, -8.0),
    ]
    found = with_building(*drive(points, [0, 1, 2, 1, 3, 5, 6, 4, 1]))
    (street,) = (path for path in found.paths if path.order in ((0, 1, 2), (2, 1, 0)))
    assert set(street.around) == {3, 4, 5, 6}
    assert not street.left
    assert not street.right


def test_doors_cut_off_rooms_but_do_not_end_a_corridor() -> None:
    doors = [(1, 4), (2, 5), (1, 2)]  # the last one is a fire door across the corridor
    found = with_building(*drive(CROSS, TOUR, doors=doors))
    assert [room.places for room in found.rooms] == [(0, 1), (2, 3), (4,), (5,)]
    assert sorted(door.places for door in found.doors) == [(1, 2), (1, 4), (2, 5)]
    (corridor,) = found.corridors
    assert corridor.order in ((0, 1, 2, 3), (3, 2, 1, 0))
    assert corridor.length == pytest.approx(15.0, abs=0.3)
    assert len(corridor.doors) == 1
    assert {(o.side, o.place) for o in corridor.openings} in (
        {("left", 1), ("right", 2)},
        {("right", 1), ("left", 2)},
    )
    (text,) = (line for line in told(found) if "corridor 0:" in line)
    assert "15 m, 2.0 m wide" in text


@pytest.mark.parametrize("way", [1, -1])
@pytest.mark.parametrize(("width", "expected"), [(2.6, {(0, 1, 2, 3)}), (3.4, {(0, 1), (2, 3)})])
def test_a_door_in_an_end_wall_parts_two_corridors_of_one_path(
    width: float, expected: set[tuple[int, ...]], way: int
) -> None:
    """The door is 0.9 m wide. Its end wall is more than twice as long in a corridor of 3.4 m."""
    found = with_building(*drive(LINE, range(4)[::way], width, doors=[(1, 2)]))
    assert orders(found) == {(0, 1, 2, 3)}
    assert {min(c.order, c.order[::-1]) for c in found.corridors} == expected
    assert sum(len(c.doors) for c in found.corridors) == 2 - len(expected)


def test_a_closet_is_no_corridor_though_it_is_long_and_slim() -> None:
    """Two doors lead from it to one room: the robot goes in by one, and out by the other."""
    points = [*LINE, (0.0, 20.0), (15.0, 20.0)]
    visits = [0, 1, 2, 3, 5, 4, 0]
    found = with_building(*drive(points, visits, doors=[(3, 5), (4, 0)]))
    assert not any(1 in corridor.order for corridor in found.corridors)
    more = [*points, (7.0, -9.0)]  # A third door leads elsewhere.
    found = with_building(*drive(more, [*visits, 1, 6], doors=[(3, 5), (4, 0), (1, 6)]))
    assert any(1 in corridor.order for corridor in found.corridors)


def test_rooms_beside_a_corridor_are_its_wings() -> None:
    found = with_building(*drive(CROSS, TOUR, doors=[(1, 4), (2, 5), (1, 2)]))
    assert found.building
    assert {wing.side: wing.rooms for wing in found.building.wings} in (
        {"left": (2,), "right": (3,)},
        {"right": (2,), "left": (3,)},
    )
    tree = found.building.hierarchy()
    rooms = [room for wing in tree["wings"] for room in wing["rooms"]] + tree["rooms"]
    assert sorted(room["room"] for room in rooms) == [0, 1, 2, 3]
    assert sorted(p for room in rooms for p in room["places"]) == [*range(6)]


def test_each_part_of_a_building_can_be_named_and_reached() -> None:
    """Two corridors, and a way between them whose places are on both."""
    points = [*LINE, *((x, 8.0) for x, _ in LINE)]
    doors = [(1, 5), (2, 3), (6, 7)]
    found = with_building(*drive(points, [0, 1, 2, 3, 2, 1, 5, 4, 5, 6, 7, 6, 5, 1], doors=doors))
    assert orders(found) == {(0, 1, 2, 3), (4, 5, 6, 7), (1, 5)}
    for kind in ("place", "path", "corridor", "room", "door"):
        things = found.things()[kind]
        assert things.keys() == {number_at(found, kind, s.id) for s in found.dstates} - {None}
    between = next(door.id for door in found.doors if door.places == (1, 5))
    way = route(found, "p0", f"door{between}")
    assert [move.place for move in way.moves] == [1]
    rung = next(path.id for path in found.paths if sorted(path.order) == [1, 5])
    assert route(found, "p7", f"path{rung}").moves[-1].place == 5
    with pytest.raises(MapError, match="way around what is avoided"):
        route(found, "p0", "p7", by="actions", avoid=[f"door{between}"])
    with pytest.raises(MapError, match="or a corridor as corridor0, or a room as room0, or a door"):
        route(found, "p0", "door9")


def test_names_stay_when_the_robot_drives_on_and_numbers_change() -> None:
    """It finds a longer corridor, which becomes corridor 0, and places get other numbers."""
    names = (Naming("street", "corridor", "t:1"), Naming("closet", "room", "t:2"))
    said = Corrections(names=(*names, Naming("gate", "door", "t:1")))
    long = [*CROSS, *((5.0 + 8 * k, 9.0) for k in range(4))]
    numbers, doors = set(), [(1, 4), (2, 5), (4, 6)]
    for points, visits in ((CROSS, TOUR), (long, [*TOUR, 1, 4, 6, 7, 8, 9, 8])):
        for shift in (0, 3):
            order = [*range(shift, len(points)), *range(shift)]  # the old numbers
            to = {p: k for k, p in enumerate(order)}
            own = [(to[p], to[q]) for p, q in doors if max(p, q) < len(points)]
            ssh_map, trace = drive([points[p] for p in order], [to[p] for p in visits], doors=own)
            trace = replace(trace, name="t")
            found = said.named(with_building(ssh_map, trace), drives_of(trace))
            at = {n.text: [order[p] for p in found.things()[n.kind][n.id]] for n in found.names}
            assert {text: sorted(places) for text, places in at.items()} == {
                "street": [0, 1, 2, 3],
                "closet": [4],
                "gate": [1, 4],
            }
            numbers.add(tuple(n.id for n in found.names))
    assert len(numbers) == 2


def test_a_slim_room_has_one_way_though_the_robot_drove_from_door_to_door() -> None:
    """A corridor of 24 by 4 m, with a door at each place, and the rooms behind them."""
    sides = [(-1) ** k for k in range(7)]
    points = [(4.0 * k, y * side) for y in (1.0, 6.0) for k, side in enumerate(sides)]
    visits = [p for k in range(7) for p in (k, k + 7, k)]
    found = with_building(*drive(points, visits, 3.0, doors=[(k, k + 7) for k in range(7)]))
    (corridor,) = found.corridors
    assert corridor.order in ((*range(7),), (*range(6, -1, -1),))
    told_sides = [o.side for o in corridor.openings if o.door is not None]
    assert told_sides in (["left", "right"] * 3 + ["left"], ["right", "left"] * 3 + ["right"])
    assert not [*faults_of_paths(found), *faults_of_corridors(found)]


def test_a_corridor_has_walls() -> None:
    """A hall of 60 m, so wide that no wall was seen, is no corridor."""
    points = [(15.0 * k, 0.0) for k in range(5)]
    for width, count in ((7.0, 1), (2 * WIDE, 0)):
        assert len(with_building(*drive(points, [*range(5)], width)).corridors) == count


def test_a_straight_way_through_a_room_is_free() -> None:
    """A corridor of 40 m with an arm of 12 m: the middle of the room around both is a wall."""
    points = [(10.0 * k, 0.0) for k in range(5)] + [(0.0, 6.0), (0.0, 12.0)]
    found = with_building(*drive(points, [6, 5, 0, 1, 2, 3, 4], 3.0))
    assert [c.width for c in found.corridors] == pytest.approx([3.0, 3.0], abs=0.1)
    assert {min(c.order, c.order[::-1]) for c in found.corridors} == {(0, 1, 2, 3, 4), (0, 5, 6)}


def test_parts_that_share_wide_free_space_are_one_room() -> None:
    """The robot leaves a hall by one door, and comes back into it by another one."""
    points = [(0.0, 0.0), (6.0, 0.0), (6.0, 8.0), (0.0, 8.0), (0.0, 2.2), (3.5, 2.2)]
    for width, rooms in ((4.0, {0: 0, 5: 0, 2: 1}), (1.0, {0: 0, 5: 2, 2: 1})):
        found = with_building(*drive(points, [*range(6)], width, doors=[(1, 2), (3, 4)]))
        assert found.building
        assert {p: found.building.room_of(p) for p in rooms} == rooms
        assert not [c for c in found.corridors if 5 in c.order or 0 in c.order] or width == 1.0


def test_what_lies_between_views_around_a_bend_is_not_free() -> None:
    """The robot turns right within 0.5 m. Ahead it saw 4 m far to both sides of the bend."""
    course = np.array([(STEP * k, 0.0) for k in range(9)] + [(2.0, -STEP * k) for k in range(1, 9)])
    edge = PlanEdge((0, 1), course, (0,), np.array([(4.0, 0.5)] * 17))
    free, corner = drawn([*strips_of(edge, 0, 16, 1.45)], np.array([(7.0, 5.0)]))
    seen = {(1.0, 3.0): True, (2.5, 0.3): True, (5.0, -1.5): True, (4.4, 2.4): False}
    for point, is_free in seen.items():
        assert free[tuple(np.rint((point - corner) / GRID).astype(int))] == is_free


def test_outlines_of_rooms_end_at_their_doors() -> None:
    """The corridor from x = 0 to 15 is 2 m wide. The room behind it begins at the door, y = 3."""
    found = with_building(*drive(CROSS, TOUR, doors=[(1, 4)]))
    corridor, room = (np.array(r.outline) for r in found.rooms)
    assert corridor[:, 0].min() == pytest.approx(0, abs=0.2)
    assert corridor[:, 0].max() == pytest.approx(15, abs=0.2)
    assert room.min(axis=0) == pytest.approx((4, 3), abs=0.2)
    assert room.max(axis=0) == pytest.approx((6, 6), abs=0.2)


def test_paths_of_a_theory_get_courses_and_sides() -> None:
    ssh_map, trace = drive(CROSS, TOUR)
    street = MapPath(0, (0, 1, 2, 3))
    regions = (Region(0, (5,), ((0, 1),)), Region(1, (4,), ((0, -1),)))
    found = with_building(replace(ssh_map, paths=(street,), regions=regions), trace)
    (path,) = found.paths
    assert (path.line, path.length) == (tuple(LINE), 15.0)
    assert (path.sure, path.left, path.right) == (None, (4,), (5,))


def test_files_keep_paths_and_buildings() -> None:
    found = with_building(*drive(CROSS, TOUR, doors=[(1, 4)]))
    again = SSHMap.from_dict(found.to_dict())
    assert again.paths == found.paths
    assert [p.line for p in again.paths] == [p.line for p in found.paths]
    assert again.building == found.building
    assert found.theory_paths == ()
    new = found.renumbered()
    assert len(new.paths) == len(found.paths)
    assert [len(c.order) for c in new.corridors] == [len(c.order) for c in found.corridors]


def test_files_keep_paths_and_rooms_without_places() -> None:
    found = with_building(*drive(CROSS, TOUR, doors=[(1, 4)]))
    assert found.building is not None
    path, room = replace(found.paths[0], order=()), replace(found.rooms[0], places=())
    building = replace(found.building, corridors=(), rooms=(room, *found.rooms[1:]))
    bare = replace(found, paths=(path, *found.paths[1:]), building=building)
    again = SSHMap.from_dict(bare.to_dict())
    assert again.paths == bare.paths
    assert again.building == bare.building


def in_frames(parts: Sequence[tuple[SSHMap, Trace]], floors: bool) -> tuple[SSHMap, Trace]:
    """One map of some drives that share no place: on floors joined by lifts, or in pieces."""
    steps: list[Step] = []
    labels: list[int] = []
    states: list[DState] = []
    links: list[tuple[int, str, int]] = []
    for k, (part, trace) in enumerate(parts):
        between = Action("up", "lift") if floors else Action(f"drive {k}", "start")
        if steps:
            steps[-1] = replace(steps[-1], action=between)
            links += [(labels[-1], "up", len(states))] if floors else []
        s, p = len(states), len({state.place for state in states})
        labels += [s + label for label in part.dstate_at]
        links += [(s + a, name, s + b) for a, name, b in part.links]
        steps += trace.steps
        states += [
            replace(x, id=s + x.id, place=p + (x.place or 0), floor=k if floors else None)
            for x in part.dstates
        ]
    places = tuple(sorted({state.place for state in states if state.place is not None}))
    poses = tuple(pose for part, _ in parts if part.fit for pose in part.fit.poses)
    fit = Fit(0.0, 0, 1.0, poses=poses)
    return SSHMap(tuple(labels), tuple(states), tuple(links), places, fit=fit), Trace(tuple(steps))


# A hall that the robot crosses straight, by way of place 2, and once in a lane 1.2 m beside.
HALL = [(0.0, 0.0), (10.0, 0.0), (5.0, 0.0)]
LANE = {(1, 0): [(9.0, 1.2), (1.0, 1.2)]}
# A narrow corridor along the middle between both.
BETWEEN = [(0.0, 0.6), (10.0, 0.6)]


@pytest.mark.parametrize("floors", [False, True])
def test_pieces_and_floors_are_kept_apart(floors: bool) -> None:
    """Places and walls that lie at one point of two frames have nothing to do with each other."""
    one = drive(HALL, [0, 2, 1, 0], width=9.0, courses=LANE)
    other = drive(BETWEEN, [0, 1], width=0.4)
    joint, trace = in_frames([one, other, drive(CROSS, TOUR, doors=[(1, 4)])], floors)
    found = with_building(joint, trace)
    assert len(found.floors if floors else found.pieces) == 3
    alone = orders(with_building(*one))
    assert alone == {(0, 2, 1)}, "the lane is no edge of its own"
    third = {tuple(p + 5 for p in order) for order in orders(with_building(*drive(CROSS, TOUR)))}
    assert orders(found) == alone | {(3, 4)} | third
    assert [room.places for room in found.rooms] == [(0, 1, 2), (3, 4), (5, 6, 7, 8, 10), (9,)]
    street = next(path for path in found.paths if len(path.order) == 4)
    assert {*street.left, *street.right} == {9, 10}
    if floors:
        way = ("go 5 m on, to place 0", "take 'up'", "go 10 m along corridor 1, to place 4")
        assert directions_to(found, trace, [2], [4]) == way
    with pytest.raises(MapError, match="in another part"):
        directions_to(found, trace, [3], [0])  # The robot took no lift back.


def test_drives_that_share_places_have_common_paths() -> None:
    """Each of two drives sees one half of the corridor."""
    ssh_map, trace = drive(LINE, [0, 1, 2, 3, 2])
    labels, steps = ssh_map.dstate_at, list(trace.steps)
    steps[1] = replace(steps[1], action=Action("tuesday", "start"))
    links = tuple((a, "travel", b) for t, (a, b) in enumerate(itertools.pairwise(labels)) if t != 1)
    joint = replace(ssh_map, links=tuple(sorted({*links})))
    found = with_building(joint, Trace(tuple(steps)))
    assert orders(found) == {(0, 1), (2, 3)}, "no travel leads from 1 to 2"
    assert len(found.pieces) == 2
    again, both = drive(LINE, [0, 1, 2, 1, 2, 3])
    steps = list(both.steps)
    steps[3] = replace(steps[3], action=Action("tuesday", "start"))
    assert orders(with_building(again, Trace(tuple(steps)))) == {(0, 1, 2, 3)}


def test_near_places_are_one_junction_only_if_the_robot_drove_between_them() -> None:
    points = [(0.0, 0.0), (5.0, 0.0), (5.6, 0.3), (10.0, 0.0), (15.0, 0.0)]
    joined = with_building(*drive(points, [0, 1, 2, 3, 4]))
    assert joined.building
    assert joined.building.junctions == ((1, 2),)
    apart = with_building(*drive(points, [0, 1, 3, 4, 3, 2, 0]))  # maybe a missed join
    assert apart.building
    assert apart.building.junctions == ()


def test_maps_say_what_they_cannot_have() -> None:
    ssh_map, trace = drive(LINE, [0, 1, 2, 3])
    for kept, why in (((), "no scans"), (("course",), "no widths")):  # courses, as in version 0.1
        extras = [{k: step.extra[k] for k in kept if k in step.extra} for step in trace.steps]
        steps = [replace(s, extra=extra) for s, extra in zip(trace.steps, extras, strict=True)]
        found = with_building(ssh_map, Trace(tuple(steps)))
        assert orders(found) == {(0, 1, 2, 3)}
        assert found.building
        assert why in found.building.notes[0]
        assert not found.corridors
    theory = replace(ssh_map, fit=None, paths=(MapPath(0, (0, 1, 2, 3)),))
    found = with_building(theory, trace)
    assert found.building
    assert "only the order of the places of its paths" in found.building.notes[0]
    for wrong, why in (
        (replace(ssh_map, fit=None), "no poses"),
        (with_one_place(ssh_map), "one place"),
        (replace(with_one_place(ssh_map), fit=None), "one place"),
    ):
        found = with_building(wrong, trace)
        assert found.building
        assert why in found.building.notes[0]
        assert not found.paths


def with_one_place(ssh_map: SSHMap) -> SSHMap:
    """The same map, with all dstates at place 0."""
    dstates = tuple(replace(s, place=0) for s in ssh_map.dstates)
    return replace(ssh_map, dstates=dstates, places=(0,))


def test_doors_are_narrow_with_wider_space_on_both_sides() -> None:
    wide = np.full(40, 3.0)
    wide[18:20] = 0.9
    assert doors_in(wide) == [18]
    assert doors_in(np.full(40, 1.2)) == []  # a narrow corridor is no door
    wedge = [*np.linspace(2.0, 1.3, 18), *np.full(12, 4.0)]  # nor is one that narrows steadily
    assert doors_in(np.array(wedge)) == []
    wide[12:24] = 0.9  # but a short one between two rooms is
    assert doors_in(wide) == [17]
    wide[:8], wide[26:] = 1.0, 1.0  # and a part of a corridor between two openings is none
    assert doors_in(wide) == []
    wide[:18], wide[18:20] = 3.0, 0.9
    wide[20:] = 0.9  # nor is one end of a narrow corridor
    assert doors_in(wide) == []
    wide[8:33] = 1.3  # but both ends can be doors
    wide[[8, 9, 31, 32]] = 1.0
    wide[33:] = 3.0
    assert doors_in(wide) == [8, 31]
    wide[:34], wide[34:] = 3.0, 1.0  # A closet has a door, but a narrow corridor may go on.
    assert doors_in(wide, (True, True)) == [34]
    assert doors_in(wide[::-1], (True, False)) == [5]
    assert doors_in(wide) == []


def test_furniture_at_one_wall_of_a_corridor_makes_no_door() -> None:
    left, right = np.full(40, 1.0), np.full(40, 1.0)
    left[18:22] = 0.4
    off = 0.2 * np.sin(np.arange(40) / 6)  # The course swerves slowly.
    way = np.stack([STEP * np.arange(40), off], axis=1)

    def is_furniture(one: NDArray[np.float64], other: NDArray[np.float64], k: int = 19) -> bool:
        return has_straight_walls(k, way, np.stack([one - off, other + off], axis=1))

    assert is_furniture(left, right)
    assert is_furniture(right, left)
    assert not is_furniture(left, left)  # The walls of a fire door come from both sides.
    left[22:] = 2.0  # A door in the corner of a room has a wider room behind it.
    assert not is_furniture(left, right)
    assert not is_furniture(right, right, 1)  # The course begins here.


def test_openings_on_both_sides_of_a_corridor_make_no_door() -> None:
    way = np.stack([STEP * np.arange(40), np.zeros(40)], axis=1)
    sides = np.full((40, 2), 0.6)
    sides[10:16, 0], sides[20:26, 1] = 3.0, 3.0
    assert has_straight_walls(18, way, sides)
    assert has_straight_walls(18, way, sides[:, ::-1])
    sides[16:20] = 0.3  # but jambs stand out of the walls
    assert not has_straight_walls(18, way, sides)


def test_openings_are_deep_parts_of_a_wall() -> None:
    free = np.full(60, 1.0)
    free[20:24], free[40:55] = 3.0, 3.0  # a doorway, and a hall
    ((at, length),) = openings_in(free)
    assert (at, length) == (21.5, 1.0)


def brute_force(ends: Sequence[Any], costs: dict[tuple[int, int], float]) -> float:
    """The least cost of all pairings in which no path visits a place twice."""
    best = math.inf
    for count in range(len(costs) + 1):
        for chosen in itertools.combinations(costs, count):
            used = [e for pair in chosen for e in pair]
            if len(set(used)) < len(used):
                continue
            pairing = tuple(sorted(chosen))
            chains = chains_of(ends, pairing)
            if sum(map(len, chains)) < len(ends) // 2:
                continue  # a ring
            place = {e: p for e, _, p in ends}
            visits = [[place[c[0]], *(place[e ^ 1] for e in c)] for c in chains]
            if all(len(set(v)) == len(v) for v in visits):
                best = min(best, sum(costs[pair] - PRICE for pair in chosen))
    return best


@pytest.mark.parametrize("seed", range(12))
def test_pairings_agree_with_brute_force(seed: int) -> None:
    random = np.random.default_rng(seed)
    ends: list[tuple[int, int, int]] = []
    for x in range(6):
        p, q = random.choice(4, 2, replace=False).tolist()
        ends += [(2 * x, x, p), (2 * x + 1, x, q)]
    meeting = [
        (e, f)
        for (e, x, p), (f, y, q) in itertools.combinations(ends, 2)
        if p == q and x != y and random.random() < 0.6
    ][:9]
    costs = {pair: round(float(random.uniform(0, 6)), 2) for pair in meeting}
    (best,), gaps = best_pairings(ends, costs, ())
    least = sum(costs[pair] - PRICE for pair in best)
    assert least == pytest.approx(brute_force(ends, costs), abs=0.02)
    assert len(gaps) == len(chains_of(ends, best))
    assert min(gaps) >= 0


def test_all_best_pairings_are_listed() -> None:
    ends = [(0, 0, 7), (1, 0, 8), (2, 1, 8), (3, 1, 9), (4, 2, 8), (5, 2, 10)]
    found, gaps = best_pairings(ends, {(1, 2): 0.5, (1, 4): 0.5, (2, 4): 4.5}, (), most=0)
    assert found == (((1, 2),), ((1, 4),))
    assert gaps == (0.0, 0.0)


def test_all_best_buildings_are_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A way on forks evenly, so either branch may be its path."""
    points = [(-8.0, 0.0), (0.0, 0.0), (8.0, 2.0), (8.0, -2.0)]
    ssh_map, trace = drive(points, [0, 1, 2, 1, 3])
    found = [*buildings_of(ssh_map, trace)]
    assert found[0] == with_building(ssh_map, trace)
    assert [orders(each) for each in found] in (
        [{(0, 1, 2), (1, 3)}, {(0, 1, 3), (1, 2)}],
        [{(0, 1, 3), (1, 2)}, {(0, 1, 2), (1, 3)}],
    )
    assert all(path.sure == 0.5 for each in found for path in each.paths if len(path.order) == 3)
    trace.save(tmp_path / "trace.jsonl")
    ssh_map.save(tmp_path / "map.json")
    arguments = ["show", str(tmp_path / "map.json"), "--paths", "--trace"]
    assert main([*arguments, str(tmp_path / "trace.jsonl")]) == 0
    assert capsys.readouterr().out.count("or, equally good:") == 1


def test_parts_that_a_file_does_not_hold_can_be_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Files of version 0.1 hold maps without paths and rooms, which follow from the trace."""
    ssh_map, trace = drive(CROSS, TOUR, doors=[(1, 4), (2, 5), (1, 2)])
    file, beside = (str(tmp_path / name) for name in ("maps.json", "trace.jsonl"))
    trace.save(beside)
    cost = Cost(len(ssh_map.dstates), len(ssh_map.places), 0)
    found = solve(trace, Theory.causal())
    assert found.bound
    bound = replace(found.bound, dstates=cost.dstates)
    replace(found, maps=(ssh_map,), cost=cost, bound=bound).save(file)
    for thing in ("path0", "corridor0", "room0"):
        assert main(["name", file, thing, f"my {thing}"]) == 0
    capsys.readouterr()
    assert main(["show", file, "--paths", "--trace", beside]) == 0
    said = capsys.readouterr().out
    assert all(f"({name})" in said for name in ("my corridor0", "my room0"))


def test_edges_of_other_directions_are_not_on_one_path() -> None:
    ends = [(0, 0, 7), (1, 0, 8), (2, 1, 8), (3, 1, 9)]
    assert best_pairings(ends, {(1, 2): 0.5}, [(0, 1)])[0] == ((),)


def test_sides_are_disjoint() -> None:
    joined = [(5, 7), (6, 8), (7, 8)]
    beside, around = sides_of([(0, 1), (0, 2)], [(0, 1, "left", 5), (0, 2, "right", 6)], joined)
    assert beside == set()
    assert around == {(0, 5), (0, 6), (0, 7), (0, 8)}


def test_routes_are_told_in_words() -> None:
    doors = [(1, 4), (2, 5)]
    ssh_map, trace = drive(CROSS, TOUR, doors=doors)
    found = with_building(ssh_map, trace)
    named = replace(found, names=(Name("place", 5, "kitchen"), Name("corridor", 0, "main street")))
    assert directions_to(named, trace, [0], [5]) == (
        "go 10 m along main street, past a door on your left, to the first opening on the right",
        "turn right",
        "go 3 m on, through the door, 3 m on, to place 5 (kitchen)",
    )
    assert directions_to(named, trace, [4], [5]) == (
        "go 3 m on, through the door, 3 m on, to the first opening on the left",
        "turn left into main street",
        "go 5 m along main street, to the first opening on the right",
        "turn right",
        "go 3 m on, through the door, 3 m on, to place 5 (kitchen)",
    )
    at_corner = replace(found, names=(Name("place", 2, "fountain"), Name("place", 1, "desk")))
    assert directions_to(at_corner, trace, [0], [5])[0] == (
        "go 10 m along corridor 0, past a door on your left, past desk, "
        "to the first opening on the right, at fountain"
    )
    assert directions_to(named, trace, [0], [0, 3]) == (
        "there is nothing to do: the start is at the goal",
    )
    with pytest.raises(MapError, match="poses"):
        directions_to(replace(named, fit=None), trace, [0], [5])


def test_words_follow_bends_of_the_way_and_not_its_places() -> None:
    """A zigzag through a hall is one leg. Only walls make a bend that is told."""
    points = [(4.0 * k, 0.5 * (-1) ** k) for k in range(5)] + [(20.0, 3.5)]
    ssh_map, trace = drive(points, [*range(6)], width=7.8)
    words = directions_to(with_building(ssh_map, trace), trace, [0], [5])
    assert words == ("go 20 m on, to place 5",), words
    points[-1] = (16.0, 6.5)
    ssh_map, trace = drive(points, [*range(6)], width=2.0)
    *_, turn, last = directions_to(with_building(ssh_map, trace), trace, [0], [5])
    assert (turn, last) == ("turn left into corridor 1", "go 6 m along corridor 1, to place 5")


def test_a_turn_into_a_door_is_told_before_the_door() -> None:
    """The corridor is 2 m wide, so the course is within 1.2 m of the line to the door."""
    points = [(0.0, 0.0), (8.0, 0.0), (8.0, 2.5)]
    doors = [(1, 2)]
    ssh_map, trace = drive(points, [0, 1, 2], doors=doors)
    assert directions_to(with_building(ssh_map, trace), trace, [0], [2]) == (
        "go 8 m along corridor 0, to the first opening on the left",
        "turn left",
        "go 1 m on, through the door, to place 2",
    )


@pytest.mark.parametrize(("along", "metres"), [(0.5, 6.02), (5.0, 5.0)])
def test_a_leg_across_a_corridor_is_as_long_as_it_is(along: float, metres: float) -> None:
    """In a corridor that is 6 m wide, a leg straight across counts, and one aslant goes along."""
    course = np.linspace((1.0, -3.0), (1.0 + along, 3.0), 41)
    edge = PlanEdge((0, 1), course, (0,), np.full((41, 2), 1.0))
    hall = Corridor(0, 0, (0, 1), ((0.0, 0.0), (24.0, 0.0)), 24.0, 6.0)
    assert RouteCourse.of([edge], [hall]).metres[-1] == pytest.approx(metres, abs=0.1)


def test_an_opening_that_was_never_driven_through_is_counted() -> None:
    ssh_map, trace = drive(CROSS, TOUR)
    first = trace.steps[0]
    seen = {**first.extra, "doors": [{"at": 2.5, "width": 0.9, "side": "right"}]}
    trace = Trace((replace(first, extra=seen), *trace.steps[1:]))
    found = with_building(ssh_map, trace)
    corridor = found.corridors[0]
    (opening,) = (o for o in corridor.openings if o.place is None)
    assert opening.metres in (2.5, 12.5)
    first_leg, *_ = directions_to(found, trace, [0], [5])
    assert first_leg.endswith("to the second opening on the right")


def test_checker_accepts_derived_buildings_and_finds_faults() -> None:
    ssh_map, trace = drive(CROSS, TOUR, doors=[(1, 4), (2, 5)])
    found = with_building(ssh_map, trace)
    theory = BARE.replace(displacement="none")

    def rules(wrong: SSHMap) -> set[str]:
        return {v.message for v in check(trace, wrong, theory) if "map_explains" in v.axiom}

    before = rules(ssh_map)
    assert rules(found) == before
    street = next(path for path in found.paths if len(path.order) == 4)
    others = [path for path in found.paths if path != street]
    places, corridor, building = street.order, found.corridors[0], found.building
    assert building
    for path, why in (
        (replace(street, order=(0, 1, 0, 3)), "lists a place twice"),
        (replace(street, left=(0,)), "on it, left, right or around"),
        (replace(street, right=(99,)), "which the map does not have"),
        (replace(street, order=places[2:] + places[:2]), f"place {places[0]} before place"),
        (replace(street, order=places[::-1]), f"place {places[0]} before place {places[1]}"),
    ):
        wrong = replace(found, paths=(path, *others))
        assert any(why in message for message in faults_of_paths(wrong))
        assert any(why in message for message in rules(wrong))
    sides = {"left": corridor.right, "right": corridor.left}
    room, door = building.rooms[0], building.doors[0]
    assert building.rooms[1].places == (4,)
    merged = replace(room, places=(*room.places, 4)), replace(building.rooms[1], places=())
    for faulty, why in (
        ({"corridors": (replace(corridor, order=(0, 2)),)}, f"is no part of path {street.id}"),
        ({"corridors": (replace(corridor, **sides),)}, f"has other sides than path {street.id}"),
        ({"corridors": (with_way_to(corridor, 99),)}, "way to place 99"),
        ({"rooms": (replace(room, doors=(9,)), *building.rooms[1:])}, "has doors [9]"),
        ({"rooms": (replace(room, places=(0,)), *building.rooms[1:])}, "with no door between"),
        ({"rooms": (*merged, *building.rooms[2:])}, "Door 0 is in rooms"),
        ({"doors": (replace(door, rooms=(0, 7)), *building.doors[1:])}, "has rooms [7]"),
        ({"doors": ()}, "no door between"),
        ({"junctions": ((0, 1),)}, "more than 1 m apart"),
    ):
        wrong = replace(found, building=replace(building, **faulty))
        assert any(why in message for message in rules(wrong)), why


def with_way_to(corridor: Corridor, place: int) -> Corridor:
    """The same corridor, whose first way out leads to another place."""
    first, *others = corridor.openings
    return replace(corridor, openings=(replace(first, to=place), *others))
