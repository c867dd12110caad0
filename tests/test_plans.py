"""Floor plans: rooms and doors read from XML, and simulated drives from room to room."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import networkx as nx
import numpy as np
import pytest
from plan_tours import APART, STRAIGHT, RoomPlan, tour

from simulator.errors import SimulatorError
from ssh_abduction import Theory, Trace, evaluate, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.data import Odometry
from ssh_abduction.data.gateways import with_allowed_headings
from ssh_abduction.data.maps import DState, MapPath, SSHMap
from ssh_abduction.data.odometry import moved
from ssh_abduction.data.trace import Step

PLANS = Path(__file__).parent.parent.parent / "shared" / "data" / "plans"
SCHOOLS = sorted(PLANS.glob("*.xml"))
NOISE = Odometry(along=0.05, across=0.02, heading=0.002)

# Four rooms in a ring, 10 m apart, and a closet beside the second; y points down. A pixel is 0.1 m,
# and each door is drawn on both sides of a wall of 0.2 m.
MIDDLES = {"a": (50, 50), "b": (150, 50), "c": (150, 150), "d": (50, 150), "closet": (230, 50)}
DOORS = [
    ("a", "b", (99, 50), (101, 50)),
    ("b", "c", (150, 99), (150, 101)),
    ("c", "d", (101, 150), (99, 150)),
]
DOORS += [("d", "a", (50, 101), (50, 99)), ("b", "closet", (199, 50), (201, 50))]


def line(name: str, point: tuple[int, int]) -> str:
    x, y = point
    return (
        f'<linesegment id="{name}"><point x="{x}" y="{y}"/><point x="{x}" '
        f'y="{y}"/><class>PORTAL</class></linesegment>'
    )


def xml(
    doors: list[tuple[str, str, tuple[int, int], tuple[int, int]]] = DOORS,
    unit: str = "cm",
    middles: dict[str, tuple[int, int]] = MIDDLES,
) -> str:
    """A plan in the format of the school plans."""
    spaces = []
    for room, (x, y) in middles.items():
        here = [(i, door) for i, door in enumerate(doors) if room in door[:2]]
        walls = "".join(line(f"{i}{room}", door[2 + (room == door[1])]) for i, door in here)
        portals = "".join(
            f"<portal><linesegment>{i}{room}</linesegment><target><id>{door[0]}</id><id>{door[1]}</id></target></portal>"
            for i, door in here
        )
        corners = "".join(
            f'<point x="{x + dx}" y="{y + dy}"/>'
            for dx, dy in ((-49, -49), (49, -49), (49, 49), (-49, 49))
        )
        spaces.append(
            f'<space id="{room}"><labels><label>CLASSROOM</label></labels><centroid><point x="{x}" '
            f'y="{y}"/></centroid>'
            f"<bounding_polygon>{corners}</bounding_polygon><space_representation>{walls}</space_representation><portals>{portals}</portals></space>"
        )
    return (
        f"<building><scale><represented_distance><value>10</value><um>pixel</um></represented_distance><real_distance><value>100</value>"
        f"<um>{unit}</um></real_distance></scale><floor><spaces>{''.join(spaces)}</spaces></floor></building>"
    )


def plan_of(folder: Path, text: str) -> RoomPlan:
    (folder / "school_updated.xml").write_text(text)
    return RoomPlan.load(folder / "school_updated.xml")


def hub(folder: Path, bearings: Sequence[float]) -> RoomPlan:
    """A room with a door to a room of its own in each of these directions."""
    out = {
        f"r{b}": (
            round(1000 + 400 * math.sin(math.radians(b))),
            round(1000 - 400 * math.cos(math.radians(b))),
        )
        for b in bearings
    }
    half = {name: ((1000 + x) // 2, (1000 + y) // 2) for name, (x, y) in out.items()}
    doors = [("hub", name, p, p) for name, p in half.items()]
    return plan_of(folder, xml(doors, middles={"hub": (1000, 1000), **out}))


@pytest.fixture
def ring(tmp_path: Path) -> RoomPlan:
    return plan_of(tmp_path, xml())


def true_map(plan: RoomPlan, trace: Trace) -> SSHMap:
    """The map that the truth of a tour describes."""
    numbers: dict[str, dict[str, int]] = {"dstate": {}, "place": {}, "path": {}}
    dstates = []
    for step in trace.steps:
        name, place, path = (
            numbers[kind].setdefault(step.truth[kind], len(numbers[kind])) for kind in numbers
        )
        if name == len(dstates):
            assert step.view is not None
            dstates.append(DState(name, step.view, place, path, step.truth["direction"]))
    labels = tuple(numbers["dstate"][step.truth["dstate"]] for step in trace.steps)
    links = {
        (here, action.name, there)
        for here, action, there in zip(labels, trace.actions, labels[1:], strict=False)
    }
    courses = []
    for text, number in numbers["path"].items():
        legs = plan.paths[int(text.removeprefix("path "))]
        last = set(plan.doors[legs[-1][1]].rooms) - {legs[-1][0]}
        rooms = [
            numbers["place"].get(f"room {room}") for room in (*(room for room, _ in legs), *last)
        ]
        seen = {dstate.place for dstate in dstates if dstate.path == number}
        courses.append(
            MapPath(number, tuple(place for place in rooms if place is not None and place in seen))
        )
    return SSHMap(
        labels, tuple(dstates), tuple(links), tuple(numbers["place"].values()), tuple(courses)
    ).renumbered()


def test_plan_is_read_in_metres_with_north_up(ring: RoomPlan) -> None:
    assert ring.name == "school"
    assert [room.centre for room in ring.rooms] == [
        (5, -5),
        (15, -5),
        (15, -15),
        (5, -15),
        (23, -5),
    ]
    assert ring.rooms[0].polygon[0] == pytest.approx((0.1, -0.1))
    assert sorted(door.rooms for door in ring.doors) == [(0, 1), (0, 3), (1, 2), (1, 4), (2, 3)]
    assert next(door.position for door in ring.doors if door.rooms == (0, 1)) == pytest.approx(
        (10, -5)
    )
    assert [[(g.to, round(g.bearing)) for g in found] for found in ring.gateways[:2]] == [
        [(1, 90), (3, 180)],
        [(4, 90), (2, 180), (0, 270)],
    ]
    assert [g.opposite for g in ring.gateways[1]] == [2, None, 0]
    assert ring.connected == (0, 1, 2, 3, 4)
    assert sorted(map(len, ring.paths)) == [
        1,
        1,
        1,
        2,
    ]  # From a through b into the closet is one path.


def test_two_doors_between_two_rooms_are_kept(tmp_path: Path) -> None:
    again = [*DOORS, ("a", "b", (99, 20), (101, 20)), ("a", "b", (99, 80), (101, 80))]
    plan = plan_of(tmp_path, xml(again))
    positions = sorted(door.position for door in plan.doors if door.rooms == (0, 1))
    np.testing.assert_allclose(positions, [(10, -8), (10, -5), (10, -2)])
    near = plan.told_apart(40)  # Seen from a, two of them are 31 degrees from the third.
    assert len([door for door in near.doors if door.rooms == (0, 1)]) == 1
    assert len(plan.told_apart(20).doors) == len(plan.doors)


def test_paths_do_not_return_to_a_room(tmp_path: Path) -> None:
    """From the middle of the inner room, its two doors to the outer room are opposite."""
    doors = [("in", "out", (60, 100), (58, 100)), ("in", "out", (140, 100), (142, 100))]
    plan = plan_of(tmp_path, xml(doors, middles={"in": (100, 100), "out": (100, 400)}))
    inner = next(i for i, room in enumerate(plan.rooms) if room.centre == (10, -10))
    assert [round(g.bearing) for g in plan.gateways[inner]] == [90, 270]
    assert [g.opposite for g in plan.gateways[inner]] == [None, None]
    assert [len(path) for path in plan.paths] == [1, 1]


def test_each_step_of_a_tour_is_at_a_room_and_a_door(ring: RoomPlan) -> None:
    trace = tour(ring, 60, seed=3)
    assert len(trace) == 61
    assert trace == tour(ring, 60, seed=3) != tour(ring, 60, seed=4)
    assert {step.truth["place"] for step in trace.steps} == {f"room {i}" for i in range(5)}
    for before, after, action in zip(trace.steps, trace.steps[1:], trace.actions, strict=False):
        if action.kind == "travel":
            assert sees(before, 0)
            assert sees(after, 180)
            assert before.truth["place"] != after.truth["place"]
            assert before.truth["path"] == after.truth["path"]
        else:
            assert sees(after, 0)
            assert before.truth["place"] == after.truth["place"]
    closet = next(
        step for step in trace.steps[1:] if step.truth["dstate"].startswith("room 4, from")
    )
    assert sees(closet, 180)
    assert (closet.view, closet.action and closet.action.name) == ("1 door: 180", "around")


def sees(step: Step, bearing: float) -> bool:
    """Whether a step sees this gateway, and gateways marked as opposite nearly are."""
    seen = step.gateways.gateways if step.gateways else ()
    for gateway in seen:
        if gateway.opposite is not None:
            assert (
                abs((gateway.bearing - seen[gateway.opposite].bearing) % 360 - 180)
                <= STRAIGHT + APART / 2
            )
    return any(
        abs((gateway.bearing - bearing + 180) % 360 - 180) <= gateway.spread == APART / 4
        for gateway in seen
    )


def test_turns_of_a_tour_count_gateways_to_their_side(tmp_path: Path) -> None:
    """In a hub with doors at 0, 60, 120, 195 and 300 degrees, the name of a turn tells its end."""
    bearings = (0, 60, 120, 195, 300)
    plan = hub(tmp_path, bearings)
    turns: dict[str, set[tuple[int, int]]] = {}
    trace = tour(plan, 400, seed=0)
    for before, after, action in zip(trace.steps, trace.steps[1:], trace.actions, strict=False):
        if action.kind == "turn" and before.truth["place"] == "room 0":
            degrees = [
                round(90 - math.degrees(step.truth["pose"][2])) % 360 for step in (before, after)
            ]
            turns.setdefault(action.name, set()).add((degrees[0], (degrees[1] - degrees[0]) % 360))
    # Entering by the door at 120, the robot faces the one at 300; by that at 195, the one at 0,
    # which is nearly opposite.
    for name, found in turns.items():
        side, number = name.split(" to gateway ")
        for here, by in found:
            star = sorted((bearing - here) % 360 for bearing in bearings)
            beside = [bearing for bearing in star if min(bearing, 360 - bearing) > 1]
            expected = beside[int(number) - 1] if side == "right" else beside[-int(number)]
            assert abs(by - expected) <= 1, (name, here)
            assert (by < 180) == (side == "right")
    assert {name.split()[0] for name in turns} == {"right", "left"}
    headings = {here for found in turns.values() for here, _ in found}
    assert headings == {
        0,
        120,
        195,
        240,
        300,
    }  # At 240 it faces no door, since it enters by the one at 60.


def test_exact_displacements_connect_true_poses(ring: RoomPlan) -> None:
    trace = tour(ring, 80, seed=1)
    pose = tuple(trace.steps[0].truth["pose"])
    for step in trace.steps[1:]:
        assert step.displacement is not None
        pose = moved(pose, step.displacement)
        assert pose[:2] == pytest.approx(step.truth["pose"][:2], abs=1e-3)
        assert math.remainder(pose[2] - step.truth["pose"][2], math.tau) == pytest.approx(
            0, abs=1e-3
        )


def test_noise_does_not_change_the_route(ring: RoomPlan) -> None:
    exact, noisy = tour(ring, 40, seed=1), tour(ring, 40, seed=1, odometry=NOISE, scale=0.1)
    assert noisy.odometry == NOISE
    assert noisy.without_displacements().steps == exact.without_displacements().steps
    ways = [
        [math.hypot(*step.displacement[:2]) for step in trace.steps if step.displacement]
        for trace in (exact, noisy)
    ]
    assert sum(ways[1]) / sum(ways[0]) == pytest.approx(1.1, abs=0.03)


def test_truth_of_a_tour_is_a_consistent_map(ring: RoomPlan, tmp_path: Path) -> None:
    trace = tour(ring, 60, seed=3)
    assert (
        check(
            trace,
            true_map(ring, trace),
            Theory.topological().replace(star="none", displacement="none"),
        )
        == ()
    )
    trace.save(tmp_path / "tour.jsonl")
    again = Trace.load(tmp_path / "tour.jsonl")
    assert [step.truth for step in again.steps] == [step.truth for step in trace.steps]
    assert again.actions == trace.actions


def test_stars_tell_doors_with_near_directions_apart(tmp_path: Path) -> None:
    """Of four doors, two have nearly one direction: odometry confuses them, the star does not."""
    plan = hub(tmp_path, (0, 7, 120, 240))
    trace = tour(plan, 60, seed=0, odometry=Odometry(along=0.1, heading=0.05))
    counted = Theory.causal().replace(weigh="count")
    for theory, right in ((counted, False), (counted.replace(star="alike"), True)):
        maps = solve(trace, theory, max_maps=None).maps
        assert all(evaluation.isomorphic for evaluation in evaluate(maps, trace).maps) == right


@pytest.mark.parametrize("seed", range(3))
def test_true_map_with_close_doors_satisfies_the_axioms(tmp_path: Path, seed: int) -> None:
    """Errors of bearings and rounding may bring two doors 1.5 degrees close to each other."""
    plan = hub(tmp_path, (0, 3.3, 7, 10.2, 120, 240))
    trace = tour(plan, 60, seed)
    while trace.actions[-1].kind == "turn":
        trace = trace.prefix(len(trace) - 1)  # no travel starts where the last turn ends
    theory = Theory.topological().replace(star="gateways", boundary="none", displacement="none")
    ssh_map = with_allowed_headings(trace, true_map(plan.told_apart(), trace), theory.axioms)
    assert ssh_map is not None
    assert check(trace, ssh_map, theory) == ()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected a plan in XML, got something else"),
        (
            "<building/>",
            "scale/represented_distance: expected a number of at most 1,000,000, got none; mend it",
        ),
        (xml(unit="ell"), "scale/real_distance/um: expected m or cm or mm, got 'ell'; mend it"),
        (
            xml().replace('x="50" y="50"', 'x="left" y="50"'),
            r"space\[0\]\.centroid\.x: expected a number of at most 1,000,000, got 'left'; mend it",
        ),
        (
            xml().replace("<id>a</id>", "<id>z</id>", 1),
            r"space\[0\]\.portal\[0\]\.target: expected the ids of this space and of another one",
        ),
        (
            xml().replace('<space id="b">', '<space id="a">'),
            "space: expected a unique id for each space",
        ),
        ('<!DOCTYPE b [<!ENTITY e "e">]>' + xml(), "expected a plan without entities of its own"),
    ],
)
def test_malformed_plan_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(SimulatorError, match=message):
        plan_of(tmp_path, text)


def test_plans_that_cannot_be_driven_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SimulatorError, match="expected a readable plan: No such file"):
        RoomPlan.load(tmp_path / "none.xml")
    with pytest.raises(SimulatorError, match="school: expected rooms with doors between them"):
        tour(plan_of(tmp_path, xml([])), 5)


@pytest.mark.skipif(not SCHOOLS, reason="the school plans are not part of the repository")
def test_all_school_plans_can_be_driven() -> None:
    assert len(SCHOOLS) == 17
    found = {}
    for path in SCHOOLS:
        plan = RoomPlan.load(path)
        assert len(plan.connected) >= len(plan.rooms) - 1, plan.name
        assert nx.is_connected(
            plan.told_apart(APART).graph.subgraph(plan.told_apart(APART).connected)
        )
        trace = tour(plan, 120, seed=0, odometry=NOISE)
        if trace.actions[-1].kind == "turn":
            trace = trace.prefix(
                len(trace) - 1
            )  # No travel starts where the last turn ends, so that state is on no path of a map.
        theory = Theory.topological().replace(star="none", displacement="none", boundary="none")
        assert check(trace, true_map(plan.told_apart(), trace), theory) == (), plan.name
        found[plan.name] = (len(plan.rooms), len(plan.doors))
        assert len({step.view for step in trace.steps}) < len(
            {step.truth["dstate"] for step in trace.steps}
        ), plan.name
    assert (found["Borchen4"], found["hendersonhighschool"], found["southmountainschool_2"]) == (
        (10, 9),
        (62, 73),
        (25, 32),
    )
