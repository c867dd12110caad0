"""The judges of benchmarks/: which places a robot truly visited, and what the skeleton of its map
says."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import courses
import networkx as nx
import numpy as np
import pytest
import rooms
import waypoints
from skeleton import CELL, _chains, _pixels, _prune, _with_doors, poses_of, skeleton_of
from visited import (
    ACES_COLUMNS,
    ACES_NAMES,
    ACES_ROUTE,
    ACES_ROWS,
    Events,
    Truth,
    Visit,
    judged,
    passes,
    truth_of,
    visits_of,
    with_names,
)

from perception.readers.scans import LaserScanner, RobotLog, Scan
from simulator.robot import BEAMS, BEARINGS, meetings
from ssh_abduction import SSHMap, Trace, evaluate, solve
from ssh_abduction.data import Action, DState, Step

ROOT = Path(__file__).parent.parent
LOGS = ROOT.parent / "shared" / "data" / "logs"


def aces_poses(spacing: float = 1.0) -> np.ndarray:
    """A drive through the crossings of ACES3 in the true order, in straight lines."""
    at = {
        name: (x, y)
        for y, names in zip(ACES_ROWS, ACES_NAMES, strict=True)
        for x, name in zip(ACES_COLUMNS, names, strict=True)
    }
    poses = []
    for here, there in pairwise(ACES_ROUTE):
        (x, y), (dx, dy) = at[here], np.subtract(at[there], at[here])
        parts = round(math.hypot(dx, dy) / spacing)
        poses += [
            (x + dx * k / parts, y + dy * k / parts, math.atan2(dy, dx)) for k in range(parts)
        ]
    return np.array([*poses, (*at[ACES_ROUTE[-1]], 0.0)])


def test_aces_route_is_recognised_and_another_refused() -> None:
    poses = aces_poses()
    truth = Truth.of_aces(poses)
    assert [visit.place for visit in truth.visits] == ACES_ROUTE
    with pytest.raises(ValueError, match=r"^expected the route N NE .* C E, got E C"):
        Truth.of_aces(poses[::-1])


def test_trace_with_true_place_names_has_the_true_map() -> None:
    """The route of aces3-route.jsonl on scans has the same names and the same evaluation."""
    shipped = Trace.load(ROOT / "examples" / "aces3-route.jsonl")
    poses = aces_poses()
    truth = Truth.of_aces(poses)
    steps, visit = [], -1
    for t, step in enumerate(shipped.steps):
        visit += t == 0 or shipped.actions[t - 1].kind != "turn"
        there = truth.visits[visit]
        scan = (there.first + there.last) // 2
        pose = [
            *poses[scan][:2],
            {"E": 0, "N": math.pi / 2, "W": math.pi, "S": -math.pi / 2}[step.truth["heading"]],
        ]
        steps.append(replace(step, truth={"pose": pose}, extra={"scan": scan}))
    named = with_names(replace(shipped, steps=tuple(steps)), truth)
    for step, told in zip(shipped.steps, named.steps, strict=True):
        assert (told.truth["place"], told.truth["heading"]) == (
            step.truth["place"],
            step.truth["heading"],
        )
    found = evaluate([], named)
    assert (found.true_dstates, found.true_places, found.true_paths) == (22, 9, 6)
    maps = solve(shipped, max_maps=None).maps
    assert [one.accuracy for one in evaluate(maps, named).maps] == [
        one.accuracy for one in evaluate(maps, shipped).maps
    ]

    figures = judged(Events.of(named, maps[0]), truth)
    assert (figures.precision, figures.recall, figures.isomorphic) == (1, 1, False)
    assert (
        figures.named.maps[0].place_precision
        == evaluate([maps[0]], shipped).maps[0].place_precision
        or figures.nodes == 10
    )


def test_events_are_matched_to_visits_one_to_one() -> None:
    poses = np.array([(float(x), 0.0, 0.0) for x in range(40)])
    truth = Truth(poses, visits_of({"A": (5, 0), "B": (20, 0)}, poses))
    assert truth.visits == (Visit("A", 2, 8), Visit("B", 17, 23))
    assert truth.matched([1, 3, 5, 30]) == [None, None, 0, None]
    assert truth.names([1, 3, 5, 30, 31]) == ["elsewhere 1", "A", "A", "elsewhere 2", "elsewhere 2"]
    figures = judged(Events((3, 5, 18, 30), ("a", "a", "b", "c")), truth)
    assert (figures.nodes, figures.precision, figures.recall, figures.isomorphic) == (
        3,
        1 / 2,
        1,
        False,
    )
    assert judged(Events((5, 18), ("a", "b")), truth).isomorphic
    assert not judged(Events((5, 18), ("a", "a")), truth).isomorphic


def test_passes_without_an_event_are_counted() -> None:
    way = [*range(14), *range(13, -1, -1), *range(14)]
    truth = Truth(np.array([(float(x), 0.0, 0.0) for x in way]))
    # The robot came back to 6 m twice, with an event once, as seen from either event there. It came
    # back to 13 m once, without an event.
    assert passes(Events((6, 13, 34), ("a", "b", "a")), truth) == (5, 2)


def test_events_in_plans_are_at_doors_or_in_rooms(tmp_path: Path) -> None:
    told = {
        "poses": [[x, 0.0, 0.0] for x in (0, 1.2, 2, 2.6, 5, 5.5, 9)],
        "scans": ["room 0", "room 0", "room 1", "room 1", "room 1", "room 1", "room 1"],
        "doors": {"door 0": {"rooms": ["room 0", "room 1"], "at": [1.7, 0]}},
        "crossings": [{"door": "door 0", "scan": 2}, {"door": "door 0", "scan": 2}],
    }
    (tmp_path / "truth.json").write_text(json.dumps(told))
    truth = Truth.load(tmp_path / "truth.json")
    assert truth.names(range(7)) == [
        "room 0 1",
        "door 0",
        "door 0",
        "door 0",
        "room 1 1",
        "room 1 1",
        "room 1 2",
    ]
    told_apart = judged(Events((1, 2, 4, 5, 6), ("a", "a", "b", "b", "c")), truth)
    assert (told_apart.precision, told_apart.recall, told_apart.isomorphic) == (None, 1, True)
    assert not judged(
        Events((1, 2, 4, 5, 6), ("a", "b", "c", "c", "d")), truth
    ).isomorphic  # one door, both ways
    late = judged(Events((4, 6), ("b", "c")), truth)
    assert (late.recall, late.named.maps[0].places_right, late.isomorphic) == (0, True, False)
    assert truth.doorways == (Visit("door 0", 1, 3),)  # in and out by one door counts once


def test_short_branches_of_a_skeleton_are_removed() -> None:
    drawn = """
        .....#.......
        .....#.......
        ############.
        .........#...
        .........#...
        .........#...
    """
    thin = np.array([[c == "#" for c in line] for line in drawn.split()])
    graph = _chains(_pixels(thin))
    assert sorted(degree for _, degree in graph.degree) == [1, 1, 1, 1, 3, 3]
    assert sum(data["metres"] for *_, data in graph.edges(data=True)) == pytest.approx(CELL * 16)
    for _, data in graph.nodes(data=True):
        data["clear"] = 0.1
    _prune(graph)
    assert sorted(graph) == [
        (2, 0),
        (5, 9),
    ]  # no branch is a metre longer than its junction is from a wall


def test_skeleton_of_a_ring_has_one_node() -> None:
    thin = np.zeros((6, 8), dtype=bool)
    thin[1:5, 1:7] = True
    thin[2:4, 2:6] = False
    graph = _chains(_pixels(thin))
    assert (len(graph), [round(data["metres"], 6) for *_, data in graph.edges(data=True)]) == (
        1,
        [1.6],
    )


def test_narrow_part_of_an_edge_is_a_door() -> None:
    width = np.full(100, 1.0)
    width[40:43], width[60:100] = (
        (0.6, 0.5, 0.6),
        0.7,
    )  # a door, and from there on a corridor that is narrow and stays so
    graph = nx.MultiGraph()
    graph.add_nodes_from([(0, 0), (0, 99)])
    graph.add_edge((0, 0), (0, 99), cells=[(0, k) for k in range(100)], metres=9.9)
    opened = _with_doors(graph, width[None, :])
    assert sorted(opened) == [(0, 0), (0, 41), (0, 99)]
    assert sum(data["metres"] for *_, data in opened.edges(data=True)) == pytest.approx(9.9)


def crossing() -> RobotLog:
    """A robot drives along two corridors that cross, 3 m wide and 20 m long: there, back to the
    crossing, and along the other."""
    ways = [(float(x), 0.0, 0.0) for x in np.arange(-8, 8.5, 0.5)]
    ways += [(float(x), 0.0, math.pi) for x in np.arange(8, -0.5, -0.5)]
    ways += [(0.0, float(y), math.pi / 2) for y in np.arange(0.5, 8.5, 0.5)]
    ways += [(0.0, float(y), -math.pi / 2) for y in np.arange(8, -8.5, -0.5)]
    corners = [(-10, -1.5), (-1.5, -1.5), (-1.5, -10), (1.5, -10), (1.5, -1.5), (10, -1.5)]
    outline = np.array([*corners, *((-x, -y) for x, y in corners)], dtype=float)
    ranges = meetings(
        np.hstack([outline, np.roll(outline, -1, axis=0)]), np.array(ways), BEARINGS
    ).min(axis=2)
    laser = LaserScanner(float(BEARINGS[0]), math.radians(1), BEAMS, 30.0)
    return RobotLog(
        tuple(Scan(scan, laser, pose, pose) for scan, pose in zip(ranges, ways, strict=True))
    )


def test_skeleton_of_a_crossing_has_five_nodes() -> None:
    pytest.importorskip("skimage")
    log = crossing()
    poses = poses_of(log, "corrected")
    skeleton = skeleton_of(log, poses)
    degrees = sorted(degree for _, degree in skeleton.graph.degree)
    assert degrees == [1, 1, 1, 1, 4]
    (middle,) = [node for node, degree in skeleton.graph.degree if degree == 4]
    assert math.hypot(*skeleton.graph.nodes[middle]["at"]) < 0.5
    passed = [node for _, node in skeleton.events(poses)]
    assert [node == middle for node in passed] == [
        True,
        False,
        True,
        False,
        True,
        False,
    ]  # the end behind the start is farther away
    assert len(set(passed)) == 4


@pytest.mark.skipif(not LOGS.exists(), reason="needs ../shared/data")
def test_corrected_poses_of_aces_pass_its_places_in_order() -> None:
    assert len(truth_of(LOGS / "aces-corrected.log.gz").visits) == 15


def line(*corners: tuple[float, float], spacing: float = 0.25) -> np.ndarray:
    """Points on the straight lines between corners."""
    return courses.resampled(np.array(corners, float), spacing)


@pytest.mark.parametrize(
    ("first", "second", "one"),
    [
        pytest.param([(0, 0), (8, 0)], [(0, 0.5), (8, 0.5)], True, id="beside each other"),
        pytest.param([(0, 0), (8, 0)], [(8, 0.5), (0, 0.5)], True, id="in opposite directions"),
        pytest.param([(0, 0), (8, 0)], [(0, 0), (4, 3), (8, 0)], False, id="around something"),
        pytest.param([(0, 0), (8, 0)], [(0, 0), (4, 0)], False, id="only half of the way"),
    ],
)
def test_courses_are_one_if_near_everywhere(
    first: list[tuple[float, float]], second: list[tuple[float, float]], one: bool
) -> None:
    assert courses.is_one(line(*first), line(*second)) is one


@pytest.mark.parametrize(
    ("way", "parted"),
    [
        pytest.param([(0, 0), (20, 0), (20, 20), (10, 20), (10, -20)], [], id="a crossing"),
        pytest.param(
            [(0, 0), (20, 0), (20, 10), (0, 10), (0, 0), (12, 0), (12, -10)], [(12, 0)], id="a fork"
        ),
        pytest.param([(0, 0), (20, 0), (0, 0)], [], id="there and back"),
    ],
)
def test_partings_are_found_where_a_second_pass_leaves_the_first(
    way: list[tuple[float, float]], parted: list[tuple[float, float]]
) -> None:
    found = courses.partings(line(*way))
    assert len(found) == len(parted)
    assert all(math.dist(a, b) < 1.0 for a, b in zip(found, parted, strict=True))


def test_pairs_of_visits_and_travels_are_counted() -> None:
    """A robot drives twice around a square. The map joins the visits of the first corner only."""
    corners = [(0, 0), (10, 0), (10, 10), (0, 10)] * 2 + [(0, 0)]
    poses = np.array([(x, y, 0.0) for x, y in corners])
    steps = [
        Step(view, Action.of("travel"), truth={"pose": pose}, extra={"scan": t})
        for t, (view, pose) in enumerate(zip("abcdefgha", poses.tolist(), strict=True))
    ]
    trace = Trace((*steps[:-1], replace(steps[-1], action=None)))
    labels = (0, 1, 2, 3, 0, 4, 5, 6, 0)
    dstates = tuple(DState(i, view, i, None, None) for i, view in enumerate("abcdfgh"))
    counts = courses.counts_of(trace, SSHMap(labels, dstates, (), tuple(range(7))), poses)
    assert counts["visit_pairs"] == {"joined": 3, "right": 3, "true": 6, "found": 3}
    assert counts["travel_pairs"] == {"joined": 0, "right": 0, "true": 4}
    assert courses.counts_of(trace, None, poses)["visit_pairs"]["joined"] == 0


def corridor_map(places: str, paths: str, drive: str) -> tuple[Trace, SSHMap, list[str | None]]:
    """A drive with three scans for each letter: a visit in a room, or a room that it passes.

    Args:
        places: The place of each visit.
        paths: The path of each travel.
        drive: The rooms in order; a visit is in a room in capitals.
    """
    scans = [3 * k + 1 for k, room in enumerate(drive) if room.isupper()]
    steps = [Step("v", action=Action.of("travel"), extra={"scan": scan}) for scan in scans]
    names = sorted(set(zip(places, [*paths, ""], strict=True)))
    labels = tuple(names.index(pair) for pair in zip(places, [*paths, ""], strict=True))
    ways = sorted({*paths})
    dstates = tuple(
        DState(i, "v", ord(place), ways.index(way) if way else None, 1 if way else None)
        for i, (place, way) in enumerate(names)
    )
    trace = Trace((*steps[:-1], replace(steps[-1], action=None)))
    return trace, SSHMap(labels, dstates, (), ()), [room.upper() for room in drive for _ in "abc"]


@pytest.mark.parametrize(
    ("places", "paths", "drive", "doors", "missing", "confused"),
    [
        # Into two rooms by doors 1 and 2, with a place in each.
        ("haji", "pqr", "HAHB", {3: "1", 6: "1", 9: "2"}, [], []),
        # No visit in room B: the robot turned around there and came back to the hall.
        ("hahh", "ppr", "HAHbH", {3: "1", 6: "1", 9: "2", 12: "2"}, [], []),
        # The same, but another travel on this edge went to no room: B is not told apart.
        ("hhh", "rr", "HbHH", {3: "2", 6: "2"}, ["B"], []),
        # Into rooms B and C on one edge: the map tells neither, and confuses doors 2 and 3.
        ("hhh", "rr", "HbHcH", {3: "2", 6: "2", 9: "3", 12: "3"}, ["B", "C"], ["2 and 3"]),
        # One place for rooms A and B. The map does not say that travels there have two courses.
        ("haha", "pqr", "HAHB", {3: "1", 6: "1", 9: "2"}, ["B"], ["1 and 2"]),
    ],
)
def test_rooms_and_doors_need_their_own_places_or_edges(
    places: str,
    paths: str,
    drive: str,
    doors: dict[int, str],
    missing: list[str],
    confused: list[str],
) -> None:
    told = rooms.untold(*corridor_map(places, paths, drive), doors)
    assert told == {"rooms": missing, "doors": confused}


def test_drives_without_rooms_are_counted_among_those_with_a_map() -> None:
    right = {"joined": 1, "right": 1}
    rows = [
        {"simulated": True, "places": 4, "visit_pairs": right},
        {
            "simulated": True,
            "places": 5,
            "visit_pairs": right,
            "untold": {"rooms": [], "doors": []},
        },
        {"simulated": True, "failed": "no map"},
        {"simulated": False, "places": 6, "visit_pairs": right},
    ]
    told = "3 simulated drives: 2 have a map. Floor plans: 1 of 1 maps have only right joins"
    assert rooms.told_line(rows).startswith(told)


def test_waypoints_fill_rooms_and_edges_cross_no_wall() -> None:
    """Two rooms of 4 x 4 m with a wall between them, and no door."""
    free = np.zeros((45, 95), bool)
    free[2:42, 2:42] = free[2:42, 52:92] = True
    cells = [(10, 10)]
    cells += waypoints._in_free_space(free, cells)
    graph = waypoints._triangulated(free, cells)
    rows, columns = np.nonzero(free)
    far = np.hypot(rows[:, None] - [r for r, _ in cells], columns[:, None] - [c for _, c in cells])
    assert far.min(axis=1).max() * CELL < waypoints.FREE
    assert sorted(len(piece) for piece in nx.connected_components(graph)) == sorted(
        sum(side(c) for _, c in cells) for side in (lambda c: c < 45, lambda c: c > 45)
    )
    merged = waypoints._merged([(0, 0), (0, 1), (0, 2), (0, 4)])
    assert merged == [(0, 0), (0, 4)]
