"""Stars of any number of gateways: as values, within tolerance, under the axioms of gateways.lp,
and in worlds with streets at any angles."""

from __future__ import annotations

import json
import math
import random
from pathlib import Path
from typing import Any
from unittest.mock import patch

import networkx as nx
import planar
import pytest
from brute_force import key, minimal_maps
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from planar import drive

from ssh_abduction import OnlineMapper, Theory, Trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.cli import main
from ssh_abduction.data import TraceError
from ssh_abduction.data import gateways as judge
from ssh_abduction.data.map_parts import read_json
from ssh_abduction.data.maps import maps_of
from ssh_abduction.data.star import Frame, Gateway, Star
from ssh_abduction.data.trace import Action, Step
from ssh_abduction.solution import Status
from ssh_abduction.solver.sources.exact import prefixes
from ssh_abduction.solver.steps import frames
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.speedups import Speedups

GATEWAYS = Theory(star="gateways")


# --- values and files


def test_a_star_survives_a_round_trip(tmp_path: Path) -> None:
    lines = [
        '{"format": "ssh-trace", "version": 1}',
        '{"view": "a", "action": {"name": "r2", "kind": "turn", "turn": "right", "gateway": 2}, '
        '"star": [1, null, 0, 1]}',
        '{"view": "b", "action": {"name": "veer", "kind": "turn", "turn": "left", "bearing": -60}, '
        '"star": [30, {"bearing": 120.0, "spread": 5.0, "opposite": 2}, {"bearing": 270.0, '
        '"spread": 10.0}]}',
        '{"view": "c", "star": [0, {"bearing": 180.0, "spread": 90.0, "open": null}]}',
    ]
    (tmp_path / "t.jsonl").write_text("\n".join(lines) + "\n")
    trace = Trace.load(tmp_path / "t.jsonl")
    again = [json.loads(line) for line in trace.to_lines()]
    expected = [json.loads(line) for line in lines]
    expected[2]["star"][2] = 270.0  # an object with only a bearing
    assert again == expected
    assert trace.steps[2].star == (0, Gateway(180, 90, None, None))
    trace.save(tmp_path / "again.jsonl")
    assert Trace.load(tmp_path / "again.jsonl") == trace


def test_stars_and_turns_that_fit_right_angles() -> None:
    fits = [
        (1, 0, 1, 1),
        (0, 90),
        (-90, 170, 20),
        (),
        ({"bearing": 0, "opposite": 1}, {"bearing": 180}),
    ]
    does_not = [
        (0, 120),
        (1, None, 0, 0),
        (0, 30),
        ({"bearing": 0, "opposite": 1}, {"bearing": 90}),
        ({"bearing": 0, "open": None},),
    ]
    for star in fits:
        assert Trace.from_steps("a", [], stars=[star]).in_quarters
    for star in does_not:
        assert not Trace.from_steps("a", [], stars=[star]).in_quarters
    for action in (
        {"name": "r", "kind": "turn", "bearing": 60},
        {"name": "r", "kind": "turn", "turn": "right", "gateway": 1},
    ):
        assert not Trace.from_steps("aa", [action], stars=[(0, 90)] * 2).in_quarters
    assert Trace.from_steps(
        "aa", [{"name": "r", "kind": "turn", "bearing": 95}], stars=[(0, 90)] * 2
    ).in_quarters


def test_trace_decides_between_star_frame_and_gateways() -> None:
    square, bend = (Trace.from_steps("a", [], stars=[star]) for star in ((0, 90), (0, 120)))
    for star in ("auto", "frame"):
        assert settle(square, Theory(star=star)).theory.star == "frame"
        assert settle(bend, Theory(star=star)).theory.star == "gateways"
    assert settle(square, Theory(star="gateways")).theory.star == "gateways"
    with pytest.raises(
        TraceError,
        match=(
            r"step 0: star: expected bearings that fall into different quarters.*take "
            r"star=gateways"
        ),
    ):
        settle(bend, Theory(star="pattern"))


@pytest.mark.parametrize(
    ("star", "message"),
    [
        ([0, None], r"star\[1\]: expected a finite number"),
        ([{"bearing": "n"}], r"star\[0\]\.bearing: expected a number of degrees"),
        (
            [{"bearing": 0, "width": 2}],
            r"star\[0\]: expected fields out of bearing, spread, opposite, open, got 'width'",
        ),
        ([{"bearing": 0, "spread": 50}], r"star\[0\]\.spread: expected degrees from 0 to 45"),
        ([{"bearing": 0, "spread": -1}], r"star\[0\]\.spread: expected"),
        ([{"bearing": 0, "open": False}], r"star\[0\]\.open: expected true, or null"),
        (
            [{"bearing": 0, "opposite": 1}],
            r"star\[0\]\.opposite: expected the index of a gateway, 0 to 0",
        ),
        ([{"bearing": 0, "opposite": 0}], r"star\[0\]\.opposite: expected another gateway"),
        (
            [{"bearing": 0, "opposite": 1}, {"bearing": 90, "opposite": 2}, 200],
            r"star\[0\]\.opposite: expected another gateway",
        ),
        (
            [{"bearing": 10 * k, "open": None} for k in range(7)],
            "star: expected at most 6 gateways that were not observed",
        ),
        ("1000", "star: expected a list"),
    ],
)
def test_malformed_star_is_an_error(star: Any, message: str) -> None:
    with pytest.raises(TraceError, match=message):
        Trace.from_steps("a", [], stars=[star])


@pytest.mark.parametrize(
    ("action", "message"),
    [
        ({"gateway": 0, "turn": "right"}, "action.gateway: expected 1 or more"),
        (
            {"gateway": 1, "turn": "around"},
            "action.gateway: expected 1 or more, for a turn right or left",
        ),
        ({"bearing": 5}, "action.bearing: expected degrees of a turn , got 5, which is no turn"),
        (
            {"bearing": 60, "turn": "left"},
            "action.bearing: expected degrees of a turn left, got 60, which is right",
        ),
        (
            {"bearing": 60, "kind": "travel"},
            "action.bearing: expected degrees clockwise, and only for a turn",
        ),
        ({"bearing": "x"}, "action.bearing: expected degrees clockwise"),
    ],
)
def test_malformed_turn_is_an_error(action: dict[str, Any], message: str) -> None:
    with pytest.raises(TraceError, match=message):
        Action.of({"name": "x", "kind": "turn", **action})


def test_gateways_within_their_spreads_are_an_error() -> None:
    with pytest.raises(
        TraceError,
        match="step 0: star: expected gateways that their spreads tell apart, got 0 and 15 degrees",
    ):
        solve(Trace.from_steps("a", [], stars=[(0, 15)]))


@pytest.mark.parametrize(
    ("bearing", "turn"), [(60, "right"), (-60, "left"), (175, "around"), (300, "left")]
)
def test_bearing_decides_between_turn_right_and_left(bearing: float, turn: str) -> None:
    assert Action("x", "turn", bearing=bearing).turn == turn


def test_a_frame_numbers_gateways_clockwise_from_ahead() -> None:
    (frame,) = Star.of((240, 355, 120)).frames
    assert frame.bearings == (355, 120, 240)
    assert [frame.nth("right", n) for n in (1, 2, 3)] == [1, 2, None]
    assert [frame.nth("left", n) for n in (1, 2, 3)] == [2, 1, None]


# --- how stars may be turned to each other: numbers with a bit a degree against a plain search


gateways = st.builds(
    lambda bearings, spreads, opposite: Frame(
        tuple(sorted(bearings)),
        tuple(spreads[: len(bearings)]),
        tuple(range(len(bearings)))[1::-1] + (None,) * (len(bearings) - 2)
        if opposite and len(bearings) > 1
        else (None,) * len(bearings),
    ),
    st.lists(st.integers(0, 71).map(lambda k: 5.2 * k % 360), max_size=4, unique=True),
    st.lists(st.sampled_from([0, 0.8, 10, 25, 90]), min_size=4, max_size=4),
    st.booleans(),
)


@settings(max_examples=20)
@given(gateways, gateways, st.integers(0, 3))
def test_rotations_equal_a_plain_search(first: Frame, then: Frame, shift: int) -> None:
    if first.slots != then.slots:
        assert not judge.rotations(first, then, shift)
        return
    shift %= max(first.slots, 1)
    found = frames.members(frames.rotation_bits(first, then, shift))
    assert set(found) == judge.rotations(first, then, shift)
    may = frames.may_face(first, then, shift)
    assert ("alike" in may, "opposite" in may) == judge.ways(first, then, shift, frozenset(found))
    assert not found or frames.heading(first, then, shift) in found or len(found) == 360


@given(
    st.lists(st.floats(0, 359), min_size=1, max_size=8, unique_by=round),
    st.data(),
    st.floats(0, 2),
    st.floats(0, 359),
)
def test_headings_four_spreads_apart_never_match(
    bearings: list[float], data: st.DataObject, spread: float, turn: float
) -> None:
    bearings = sorted(bearings)
    gaps = [(b - a) % 360 for a, b in zip(bearings, bearings[1:] + bearings[:1], strict=True)]
    assume(len(gaps) == 1 or min(gaps) > 2 * spread)
    spreads, opposite = (spread,) * len(bearings), (None,) * len(bearings)
    off = st.lists(st.floats(-spread, spread), min_size=len(gaps), max_size=len(gaps))
    first, then = (
        Frame(
            tuple((b + e - r) % 360 for b, e in zip(bearings, data.draw(off), strict=True)),
            spreads,
            opposite,
        )
        for r in (0.0, turn)
    )
    found = judge.rotations(first, then, 0)
    assert {math.floor(turn), math.ceil(turn)} & found
    away = min(turn, 360 - turn)
    for alike in (judge.ways(first, then, 0, found)[0], "alike" in frames.may_face(first, then, 0)):
        assert alike or away > 0
        assert not alike or away <= 4 * spread + 1e-3


# --- the axioms on tiny traces: clingo, the checker and a brute force


SHAPES: tuple[tuple[Any, ...], ...] = (
    (0, 120),
    (0, 120, 240),
    (0, 60),
    (0,),
    (),
    (0, 180, 240),
    (0, 72, 144, 216, 288),
    ({"bearing": 0}, {"bearing": 120, "opposite": 0}),
    ({"bearing": 0}, {"bearing": 180, "spread": 90, "open": None}),
    ({"bearing": 0}, {"bearing": 120}, {"bearing": 240, "open": None}),
)
TURNS: tuple[Any, ...] = (
    *("right", "left", "around"),
    {"name": "by 60", "kind": "turn", "bearing": 60},
    {"name": "by 120", "kind": "turn", "bearing": 120},
    {"name": "first", "kind": "turn", "turn": "right", "gateway": 1},
    {"name": "second", "kind": "turn", "turn": "left", "gateway": 2},
)
# The axioms that may be left out. Without gateway_heading a dstate could have several headings.
LEFT_OUT = (
    "gateway_frame",
    "gateway_turn",
    "gateway_dstate",
    "gateway_path",
    "gateway_end",
    "turn_stays",
    "travel_leaves",
)


@st.composite
def traces(draw: st.DrawFn) -> Trace:
    """Two to five observations at places of one or two shapes.

    Mostly the stars after a turn are those seen before it, turned as the action says.
    """
    shapes = draw(st.lists(st.sampled_from(SHAPES), min_size=1, max_size=2))
    noise = draw(st.sampled_from([0, 0, 7, 10.4]))
    steps = draw(st.integers(2, 5))
    actions = draw(
        st.lists(st.sampled_from(("travel", *TURNS)), min_size=steps - 1, max_size=steps - 1)
    )
    shape, heading, stars = draw(st.sampled_from(shapes)), 0, []
    for action in ("travel", *actions):
        if action == "travel":
            shape = draw(st.sampled_from(shapes))
            heading = draw(st.sampled_from([0, 60, 120, 180]))
        else:
            known = {"right": 60, "left": 300, "around": 180}
            heading += (
                action["bearing"]
                if isinstance(action, dict) and "bearing" in action
                else known.get(str(action), 120)
            )
        seen = []
        for gateway in shape:
            given_ = dict(gateway) if isinstance(gateway, dict) else {"bearing": gateway}
            seen.append(
                {
                    **given_,
                    "bearing": (
                        given_["bearing"] - heading + draw(st.sampled_from([-noise, 0, noise]))
                    )
                    % 360,
                }
            )
        stars.append(seen)
    views = draw(st.lists(st.sampled_from("aab"), min_size=steps, max_size=steps))
    return Trace.from_steps(views, actions, stars=stars)


@settings(max_examples=8)
@given(traces(), st.data())
def test_maps_with_gateways_equal_the_brute_force(trace: Trace, data: st.DataObject) -> None:
    theory = GATEWAYS.replace(
        boundary=data.draw(st.sampled_from(["none", "strict"])),
        path_order=data.draw(st.sampled_from(["partial", "total"])),
        all_on_paths=data.draw(st.booleans()),
        prefer=data.draw(st.sampled_from([("dstates", "paths", "places"), (), ("places",)])),
        without=data.draw(st.just(()) | st.sampled_from(LEFT_OUT).map(lambda name: (name,))),
    )
    counts, expected = minimal_maps(trace, theory)
    with patch.object(prefixes, "FIRST_PREFIX", data.draw(st.sampled_from([1, 2, 8]))):
        solution = solve(trace, theory, max_maps=None, time_limit=100)
    assert solution.complete
    assert len(solution.maps) == len(expected)
    assert {key(ssh_map) for ssh_map in solution.maps} == expected
    assert (solution.cost is None) == (counts is None)
    assert all(check(trace, ssh_map, theory) == () for ssh_map in solution.maps)


@settings(max_examples=8)
@given(traces(), st.data())
def test_causal_maps_with_stars_equal_the_brute_force(trace: Trace, data: st.DataObject) -> None:
    """star=alike: solver and checker against the brute force, which tries all ways to pair
    gateways. The maps of the plain causal theory are judged, too."""
    theory = Theory.causal().replace(
        star="alike", prefer=data.draw(st.sampled_from([("dstates",), ()]))
    )
    _, expected = minimal_maps(trace, theory)
    solution = solve(trace, theory, max_maps=None, time_limit=100)
    assert solution.complete
    assert {key(ssh_map) for ssh_map in solution.maps} == expected
    assert all(check(trace, ssh_map, theory) == () for ssh_map in solution.maps)
    _, allowed = minimal_maps(trace, theory.replace(prefer=()))
    for ssh_map in solve(
        trace, Theory.causal().replace(prefer=()), max_maps=20, time_limit=100
    ).maps:
        assert (check(trace, ssh_map, theory) == ()) == (key(ssh_map) in allowed)


@settings(max_examples=8)
@given(traces(), st.sampled_from(LEFT_OUT[:5]))
def test_checker_rejects_maps_with_gateways_outside_the_brute_force(
    trace: Trace, left_out: str
) -> None:
    """Judge the maps of a theory that lacks an axiom by all axioms."""
    _, allowed = minimal_maps(trace, GATEWAYS.replace(prefer=()))
    for ssh_map in solve(
        trace, GATEWAYS.replace(prefer=(), without=(left_out,)), max_maps=20, time_limit=100
    ).maps:
        if key(ssh_map) not in allowed:
            assert check(trace, ssh_map, GATEWAYS)


def test_unobserved_opening_matches_open_and_closed() -> None:
    """Out and back. At first it is unknown whether a gateway is behind the robot."""
    for back in (0, 1):
        trace = Trace.from_steps(
            "abca",
            ["travel", "around", "travel"],
            stars=[(1, 0, None, 0), (0, 0, 1, 0), (1, 0, 0, 0), (back, 0, 1, 0)],
        )
        cost = solve(trace).cost
        assert cost is not None
        assert cost.places == 2
    contradicted = Trace.from_steps("ab", ["around"], stars=[(1, None, 0, 0), (0, 1, 1, 0)])
    assert solve(contradicted).status is Status.UNSATISFIABLE
    assert (
        solve(Trace.from_steps("ab", ["around"], stars=[(1, None, 0, 0), (0, 0, 1, 1)])).status
        is Status.OPTIMAL
    )


def test_gateways_at_right_angles_equal_frames_of_four_slots() -> None:
    """If bearings name turns, four gateways at right angles are a frame of four slots."""
    from worlds import TOURS
    from worlds import drive as drive_streets

    for name in ("square", "tee", "plus"):
        trace = drive_streets(*TOURS[name], stars=True)
        framed, general = solve(trace, Theory(star="frame")), solve(trace, Theory(star="gateways"))
        assert framed.cost == general.cost
        assert {key(m) for m in framed.maps} == {key(m) for m in general.maps}


def test_general_stars_switch_off_speedups_for_right_angles() -> None:
    on = Speedups().that_hold_for(GATEWAYS)
    assert not any((on.names, on.ways, on.sides))
    assert on.prefixes
    assert on.path_names


# --- worlds


WORLDS: dict[str, tuple[nx.Graph, int, set[object]]] = {
    "corners of 60 degrees": (planar.triangle(), 13, set()),
    "three gateways, and a hub": (planar.wheel(3), 30, {0}),
    "three gateways, and dead ends": (planar.junction(0, 120, 240), 16, set()),
    "five gateways at odd angles": (planar.junction(0, 50, 135, 180, 270), 22, set()),
    "six gateways": (planar.junction(0, 60, 120, 180, 240, 300), 30, set()),
}


@pytest.mark.parametrize("name", WORLDS)
def test_worlds_with_any_gateways_have_true_maps(name: str) -> None:
    graph, steps, landmarks = WORLDS[name]
    start = next(iter(graph))
    tour = drive(
        graph, start, next(iter(graph[start])), steps, random.Random(0), landmarks=landmarks
    )
    solution = solve(tour.trace, time_limit=100)
    assert solution.theory.star == "gateways"
    assert solution.status is Status.OPTIMAL
    assert solution.complete
    assert solution.cost is not None
    assert solution.cost.places == tour.places
    for ssh_map in solution.maps:
        assert ssh_map.labels == tour.labels
        assert check(tour.trace, ssh_map) == ()


def test_bend_ends_two_paths() -> None:
    """Once around six bends of 120 degrees. There are six paths, although three pairs are parallel.

    Without the axiom some become one path.
    """
    tour = drive(planar.hexagon(), 0, 1, 12, random.Random(0))
    trace = tour.trace
    different = [(i, j) for j in range(12) for i in range(j)]
    theory = Theory(
        different=different,
        elsewhere=[(i, j) for i, j in different if tour.truth[i][0] != tour.truth[j][0]],
    )
    for without, counts in (((), (12, 6, 6)), (("gateway_end",), (12, 7, 4))):
        solution = solve(trace, theory.replace(without=without), time_limit=100)
        assert solution.cost is not None
        assert (solution.cost.dstates, solution.cost.places, solution.cost.paths) == counts


@pytest.mark.parametrize(("noise", "unseen"), [(0, False), (8, True)])
def test_streets_at_any_angles_have_true_maps(noise: float, unseen: bool) -> None:
    graph = planar.scattered(6, random.Random(3))
    tour = drive(graph, 0, next(iter(graph[0])), 24, random.Random(3), noise=noise, unseen=unseen)
    solution = solve(tour.trace, time_limit=100)
    assert solution.status is Status.OPTIMAL
    assert all(ssh_map.labels == tour.labels for ssh_map in solution.maps)
    assert solution.cost is not None
    assert solution.cost.places == tour.places


def test_true_map_with_noisy_bearings_satisfies_the_axioms() -> None:
    """Hubs with a ring road. Bearings may be off by less than their spread, and gateways behind the
    robot may be unobserved."""
    tour = drive(planar.wheel(5), "hub", 0, 18, random.Random(5), noise=9, unseen=True)
    pairs = [(i, j) for j in range(18) for i in range(j)]
    same = [(i, j) for i, j in pairs if tour.truth[i] == tour.truth[j]]
    elsewhere = [(i, j) for i, j in pairs if tour.truth[i][0] != tour.truth[j][0]]
    different = [pair for pair in pairs if pair not in same]
    asserted = Theory(
        same=same, different=different, elsewhere=elsewhere, prefer=("dstates", "places", "paths")
    )
    solution = solve(tour.trace, asserted, time_limit=100)
    assert solution.status is Status.OPTIMAL
    assert solution.maps[0].labels == tour.labels
    assert solution.cost is not None
    assert solution.cost.places == tour.places


def test_online_mapper_maps_general_stars() -> None:
    tour = drive(planar.triangle(), 0, 1, 9, random.Random(0))
    first = tour.trace.steps[0]
    mapper = OnlineMapper(first.view or "", star=first.star, time_limit=None)
    assert mapper.theory.star == "gateways"
    for t, action in enumerate(tour.trace.actions, 1):
        step = tour.trace.steps[t]
        online, whole = (
            mapper.observe(action, step.view or "", star=step.star),
            solve(tour.trace.prefix(t + 1)),
        )
        assert (online.status, online.cost) == (whole.status, whole.cost)
        assert set(online.maps) == set(whole.maps)


def test_maps_with_headings_in_degrees_survive_a_round_trip(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`check` and `show` read the output of `solve` for a triangle."""
    tour = drive(planar.triangle(), 0, 1, 9, random.Random(0))
    tour.trace.save(tmp_path / "t.jsonl")
    assert main(["solve", str(tmp_path / "t.jsonl"), "--json"]) == 0
    (tmp_path / "maps.json").write_text(capsys.readouterr().out)
    assert main(["check", str(tmp_path / "maps.json"), str(tmp_path / "t.jsonl")]) == 0
    drawn = ["export", str(tmp_path / "maps.json"), "--to", "svg", "-o", str(tmp_path / "map.svg")]
    assert main(drawn) == 0
    (ssh_map,) = maps_of(read_json(tmp_path / "maps.json"), "maps.json")
    assert {s.heading for s in ssh_map.dstates} == {0, 120, 240}


def test_star_of_quarters_is_read_as_in_version_0_1_0() -> None:
    assert Step(view="a", star=(1, 0, 0, 1)).openings == (True, False, False, True)
    with pytest.raises(TraceError, match="star=gateways"):
        _ = Step(view="a", star=(0, 120)).openings
