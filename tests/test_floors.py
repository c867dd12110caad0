"""Lifts and stairs lead to other floors, and each floor has a frame of its own."""

from __future__ import annotations

import json
import math
import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import traces
from test_property import checker_rejects_foreign_maps, solver_agrees

from simulator.errors import SimulatorError
from simulator.tours import record, simulate
from simulator.world import World
from ssh_abduction import SSHMap, Theory, Trace, explain_trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.data import Action, MapError, TheoryError, TraceError, together
from ssh_abduction.online import route
from ssh_abduction.output import to_dot, to_networkx, to_svg
from ssh_abduction.output.export import export_map
from ssh_abduction.output.layout import drawable_poses, layout
from ssh_abduction.solution import Status
from ssh_abduction.solver.asp.facts import program
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.evidence.of_steps import Floors
from ssh_abduction.theory.settle import settle

UP, DOWN = Action("up", "lift"), Action("down", "stairs")


@st.composite
def traces_with_lifts(draw: st.DrawFn) -> Trace:
    """Tiny traces in which one to four actions are lifts."""
    trace = draw(traces().filter(lambda trace: len(trace) > 1))
    last = len(trace) - 1
    lifted = draw(st.sets(st.integers(1, last), min_size=1, max_size=min(4, last)))
    steps = list(trace.steps)
    for t in lifted:
        steps[t - 1] = replace(steps[t - 1], action=draw(st.sampled_from([UP, DOWN])))
        steps[t] = replace(steps[t], displacement=None, covariance=None)
    return replace(trace, steps=tuple(steps))


@settings(max_examples=6)
@given(st.data())
def test_maps_with_floors_equal_the_brute_force(data: st.DataObject) -> None:
    solver_agrees(data, data.draw(traces_with_lifts(), label="trace"))


@settings(max_examples=3)
@given(st.data())
def test_checker_rejects_maps_with_floors_outside_the_brute_force(
    data: st.DataObject,
) -> None:
    checker_rejects_foreign_maps(data, data.draw(traces_with_lifts(), label="trace"))


SHAFT = Trace.from_steps("ababab", ["travel", UP, "travel", DOWN, "travel"])
"""Up from b and down from b: the second floor is never seen again."""


@pytest.mark.parametrize("theory", [Theory.causal(), Theory()])
def test_floors_are_listed_saved_and_read(theory: Theory, tmp_path: Path) -> None:
    (ssh_map, *_) = solve(SHAFT, theory).maps
    assert ssh_map.floors == ((0, 1), (2, 3))
    assert ssh_map.dstate_at == (0, 1, 2, 3, 0, 1)
    ssh_map.save(tmp_path / "map.json")
    read = SSHMap.load(tmp_path / "map.json")
    assert read.floors == ssh_map.floors
    assert read.renumbered().floors == ssh_map.floors
    data = json.loads((tmp_path / "map.json").read_text())
    assert [s["floor"] for s in data["dstates"]] == [0, 0, 1, 1]
    data["dstates"][0]["floor"] = -1
    with pytest.raises(MapError, match=r"dstates\[0\].floor: expected the number of a floor"):
        SSHMap.from_dict(data)
    assert solve(SHAFT[:2], theory).maps[0].floors == ()


def test_lift_is_deterministic_and_on_no_path() -> None:
    """The lift leads from the first b to an a. Later, it leads from this b to this a."""
    trace = Trace.from_steps("ababa", ["travel", UP, DOWN, UP])
    assert [m.dstate_at for m in solve(trace, Theory.causal()).maps] == [(0, 1, 2, 1, 2)]
    (ssh_map, *_) = solve(trace).maps
    assert ssh_map.floors == ((0, 1), (2,))
    assert [s.path for s in ssh_map.dstates] == [0, 0, None]


def test_stretches_with_a_common_place_are_one_floor() -> None:
    """Steps 0 and 2 are on one floor as step 3 is at the place of step 1, so 0 and 3 are apart."""
    trace = Trace.from_steps("abab", [UP, DOWN, UP])
    problem = settle(trace, Theory.causal())
    (floors,) = (evidence for evidence in problem.evidence if isinstance(evidence, Floors))
    wrong = solve(trace, Theory.causal().replace(without=("other_floor",))).maps[0]
    joined = replace(wrong, dstate_at=(0, 1, 1, 0))
    assert floors.refuse(trace, joined) == {Equality(1, 2)}
    assert floors.refuse(trace, wrong) is None
    pairs = floors.pairs(trace)
    assert pairs.elsewhere == {1: frozenset({0}), 2: frozenset({1}), 3: frozenset({2})}


def test_explain_trace_suggests_no_lift_before_a_displacement() -> None:
    stars = [(1, 0, 0, 0)] * 3
    moved = [None, (0.0, 0.0, -1.57)]
    trace = Trace.from_steps("aaa", [UP, "right"], stars=stars, displacements=moved)
    explained = explain_trace(trace)
    assert explained.clash is not None
    assert {mend.instead for mend in explained.mends if mend.kind == "action"} == {"'travel'"}


def test_checker_judges_the_floors_of_a_map() -> None:
    theory = Theory.causal()
    (ssh_map, *_) = solve(SHAFT, theory).maps
    assert check(SHAFT, ssh_map, theory) == ()
    wrong = replace(ssh_map, dstates=tuple(replace(s, floor=0) for s in ssh_map.dstates))
    (violation, *_) = check(SHAFT, wrong, theory)
    assert violation.axiom == "map_explains_trace"
    assert "its links and places say floor 1" in violation.message
    flat = SHAFT[:2]
    listed = replace(solve(flat, theory).maps[0], dstates=wrong.dstates[:2])
    assert any("no lifts" in v.message for v in check(flat, listed, theory))


def test_checker_rejects_a_lift_that_stays_on_its_floor() -> None:
    trace = Trace.from_steps("aa", [UP])
    stays = solve(trace, Theory.causal().replace(without=("other_floor",))).maps[0]
    assert stays.dstate_at == (0, 0)
    assert "other_floor" in {v.axiom for v in check(trace, stays, Theory.causal())}


def test_each_floor_has_its_own_coordinates() -> None:
    with pytest.raises(TraceError, match="step 1: displacement: expected none on the first step"):
        Trace.from_steps("ab", [UP], displacements=[(1, 0, 0)])
    # Two floors, one above the other: at no distance, and still two places.
    moved = [(5.0, 0.0, 0.0), None, (-5.0, 0.0, 0.0), None, (5.0, 0.0, 0.0)]
    trace = Trace.from_steps(
        "ababab", ["travel", UP, "travel", DOWN, "travel"], displacements=moved
    )
    (ssh_map, *_) = solve(trace).maps
    assert ssh_map.floors == ((0, 1), (2, 3))
    assert ssh_map.dstate_at == (0, 1, 2, 3, 0, 1)


def test_slipped_actions_are_refused_with_lifts() -> None:
    with pytest.raises(TheoryError, match="slipped: expected no actions that slip"):
        solve(SHAFT, Theory.causal().replace(slipped=1.0))


@pytest.mark.parametrize("theory", [Theory.causal(), Theory.topological()])
def test_ends_of_lifts_are_drawn_one_below_the_other(theory: Theory) -> None:
    """The robot faces the other way on the second floor, 10 m along and 1 m aside."""
    trace = Trace.from_steps(
        "abcda",
        ["travel", UP, "travel", DOWN],
        displacements=[(10, 1, 0), None, (10.0, 1.0, 0.0), None],
    )
    ssh_map = solve(trace, theory.replace(same=((0, 4),))).maps[0]
    drawn = drawable_poses(ssh_map)
    assert drawn is not None
    a, b, c, d = (complex(drawn[s].x, drawn[s].y) for s in ssh_map.dstate_at[:4])
    assert c - b == pytest.approx(d - a)
    assert (c - b).imag < -1
    assert abs(d - c) == pytest.approx(abs(complex(10, 1)))
    turned = drawn[ssh_map.dstate_at[2]].heading - drawn[ssh_map.dstate_at[0]].heading
    assert math.cos(turned) == pytest.approx(-1)
    spread, was = drawn[ssh_map.dstate_at[3]].spread, ssh_map.fit.poses[ssh_map.dstate_at[3]].spread
    assert spread == pytest.approx(was)  # half a turn


def test_misread_view_does_not_move_a_place_to_another_floor() -> None:
    """A view can be misread, but the robot stays on its floor."""
    trace = Trace.from_steps("abab", ["travel", UP, DOWN])
    (ssh_map, *_) = solve(trace, Theory.causal().replace(misread=0.5)).maps
    assert len(ssh_map.floors) == 2
    assert check(trace, ssh_map, Theory.causal().replace(misread=0.5)) == ()


def test_readable_program_contains_facts_about_lifts() -> None:
    text = program(settle(SHAFT, Theory()))
    assert 'kind("up",lift).' in text
    assert "stretch(3,2)." in text
    assert "lifted(2)." in text


def test_floors_are_drawn_below_each_other() -> None:
    moved = [(5.0, 0.0, 0.0), None, (5.0, 0.0, 0.0), (5.0, 0.0, 0.0)]
    trace = Trace.from_steps("abcde", ["travel", UP, "travel", "travel"], displacements=moved)
    for ssh_map in (*solve(trace).maps[:1], *solve(trace.without_displacements()).maps[:1]):
        found = layout(ssh_map)
        assert found.metric == (ssh_map.fit is not None)
        heights = [y for _, y, _ in found.dstates]
        assert max(heights[2:]) < min(heights[:2]) - 1
        drawing = to_svg(ssh_map)
        assert "floor 0" in drawing
        assert "floor 1" in drawing
        assert "floor 2" not in drawing
        graph = to_networkx(ssh_map)
        assert [graph.nodes[s]["floor"] for s in graph] == [0, 0, 1, 1, 1]
        assert [node["floor"] for _, node in to_networkx(ssh_map, "places").nodes(data=True)] == [
            0, 0, 1, 1, 1,
        ]  # fmt: skip
        nodes = json.loads(export_map(ssh_map, "nav2", level="dstates"))["features"][:5]
        assert [n["properties"]["metadata"]["floor"] for n in nodes] == [0, 0, 1, 1, 1]
        stops = yaml.safe_load(export_map(ssh_map, "tmap2", level="dstates"))["nodes"]
        assert [stop["node"]["properties"]["floor"] for stop in stops] == [0, 0, 1, 1, 1]
        assert [to_dot(ssh_map).count(f"floor {i}") for i in range(3)] == [2, 3, 0]
    assert "floor" not in to_svg(solve(trace[:2]).maps[0])


@cache
def driven(floors: int) -> Trace:
    """A drive through a tower."""
    return simulate(World.named(f"tower-{floors}"), seed=3)


@pytest.mark.parametrize(
    ("floors", "dstates"), [(2, 42), pytest.param(3, 60, marks=pytest.mark.slow)]
)
def test_simulated_robot_changes_floors_by_lifts_only(floors: int, dstates: int) -> None:
    trace = driven(floors)
    found = [step.truth["dstate"] for step in trace.steps]
    assert len(set(found)) == dstates
    for t, action in enumerate(trace.actions):
        before, after = found[t : t + 2]
        assert (before[0] != after[0]) == action.changes_floor
        assert (trace.steps[t + 1].displacement is None) == action.changes_floor
        if action.changes_floor:
            assert before[1:] == after[1:]


def test_map_of_a_simulated_tower_is_true() -> None:
    trace = driven(2).prefix(40)
    trace = trace.with_views([str(step.star) for step in trace.steps])
    solution = solve(trace, Theory(displacement="none"), max_maps=1)
    assert solution.status is Status.OPTIMAL
    ssh_map = solution.maps[0]
    states = {step.truth["dstate"] for step in trace.steps}
    assert len(ssh_map.dstates) == len(states)
    pairs = {(s.truth["dstate"], k) for s, k in zip(trace.steps, ssh_map.dstate_at, strict=True)}
    assert len(pairs) == len(states)
    assert len(ssh_map.floors) == 2


@pytest.mark.slow
def test_signs_at_lifts_tell_three_floors_apart() -> None:
    """Without signs, the third floor may be the first one, if the robot came by the second."""
    tower = World.named("tower-3")
    trace = driven(3)
    truth = [(step.truth["dstate"], step.truth["place"]) for step in trace.steps]
    starts = {lift.start for lift in tower.lifts}
    lifts = {place for place, at in tower.places.items() if tuple(at) in starts}
    stars = [str(step.star) for step in trace.steps]
    signs = [
        f"{place[0]} {star}" if place in lifts else star
        for star, (_, place) in zip(stars, truth, strict=True)
    ]
    for views, floors in ((stars, 2), (signs, 3)):
        solution = solve(trace.with_views(views), Theory.causal().replace(weigh="count"))
        assert solution.status is Status.OPTIMAL
        (ssh_map,) = solution.maps
        assert len(ssh_map.floors) == floors
    labels = {(dstate, k) for (dstate, _), k in zip(truth, ssh_map.dstate_at, strict=True)}
    assert len(labels) == len(ssh_map.dstates) == 60


def test_simulator_refuses_wrong_lifts() -> None:
    tower = World.named("tower-2")
    with pytest.raises(SimulatorError, match="lift to 1: expected a lift of this name at"):
        simulate(tower.with_choices(route="lift to 1"))
    with pytest.raises(SimulatorError, match="lifts: expected none in the log of a robot"):
        record(tower)
    with pytest.raises(SimulatorError, match="every: expected no distance"):
        simulate(tower, every=0.5)
    with pytest.raises(SimulatorError, match="whose streets meet at right angles"):
        simulate(replace(tower, angles="any"))


@pytest.mark.parametrize("without", [(), ("path_in_one_piece",)])
def test_route_changes_floors_by_the_lift_only(without: tuple[str, ...]) -> None:
    """If a path may lead on at the other floor, nobody can travel along it."""
    ssh_map = solve(SHAFT, Theory(without=without)).maps[0]
    assert len(ssh_map.paths) == (1 if without else 2)
    found = route(ssh_map, 0, 3, by="places")
    assert found is not None
    assert found.actions == ("travel", "up", "travel")


@pytest.mark.parametrize(("kind", "warned"), [("lift", 0), ("travel", 1)])
def test_drives_by_different_lifts_give_no_false_warning(kind: str, warned: int) -> None:
    """Lifts to different floors have different names."""
    drives = [
        Trace.from_steps("ab", [{"name": name, "kind": kind}], name=f"{name}-drive")
        for name in ("one", "other")
    ]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        together(drives)
    assert len(caught) == warned


def test_map_at_the_time_limit_has_the_end_of_a_lift_on_a_path() -> None:
    stars = [(1, 0, 0, 0), (0, 0, 1, 0), (1, 0, 0, 0)]
    trace = Trace.from_steps("abc", ["travel", UP], stars=stars)
    theory = Theory(all_on_paths=True)
    (ssh_map,) = solve(trace, theory, time_limit=1e-9).maps
    assert check(trace, ssh_map, theory) == ()


def test_return_by_a_lift_to_one_known_place_is_not_sure() -> None:
    moved = [(9.0, 0.0, 0.0), None, (9.0, 0.0, 0.0), None]
    trace = Trace.from_steps("abcda", ["travel", UP, "travel", DOWN], displacements=moved)
    assert 0.05 < solve(trace).probability(0, 4) < 0.95
