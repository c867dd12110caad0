"""The full theory without frames. Dstates are settled before places and paths. Maps are compared
with those of the plain encoding, and mazes are solved."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from unittest.mock import patch

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import maze
from strategies import step_pairs, traces
from turns import stepwise

from ssh_abduction import Theory, Trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.checker.claims import check_bound
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.runtime.limits import LimitError, Watch
from ssh_abduction.solution import Status
from ssh_abduction.solver import Search, Start
from ssh_abduction.solver.asp.facts import most_paths
from ssh_abduction.solver.board import Judging
from ssh_abduction.solver.sources.exact import choosing, names
from ssh_abduction.solver.sources.exact.engine import Task
from ssh_abduction.solver.sources.exact.fitting import Fitting
from ssh_abduction.solver.sources.exact.labels_first import LabelsFirst
from ssh_abduction.solver.sources.exact.readable import StepEngine
from ssh_abduction.theory import Speedups
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.settle import Problem, settle
from ssh_abduction.theory.speedups import SPEEDUPS

EXAMPLES = Path(__file__).parent.parent / "examples"
PLAIN = Speedups.without(SPEEDUPS)


@st.composite
def bare_theories(draw: st.DrawFn) -> Theory:
    """Theories in which places have no frames, and fewest dstates come first."""
    return Theory(
        boundary=draw(st.sampled_from(["none", "strict"])),
        symmetric_sides=draw(st.booleans()),
        path_order=draw(st.sampled_from(["partial", "total"])),
        star="none",
        prefer=draw(
            st.sampled_from(
                [
                    ("dstates",),
                    ("dstates", "paths"),
                    ("dstates", "places", "paths"),
                    ("dstates", "paths", "places"),
                ]
            )
        ),
    )


@settings(max_examples=5)
@given(st.data())
def test_frameless_maps_equal_those_of_the_plain_encoding(data: st.DataObject) -> None:
    """Clingo gets the paths that an answer contradicts, or only incompatible links. It starts with
    few names. A minimal map is known or not."""
    trace = data.draw(traces(max_steps=6), label="trace").without_stars().without_displacements()
    said = {kind: data.draw(step_pairs(len(trace)), label=kind) for kind in ("same", "same_place")}
    theory = data.draw(bare_theories(), label="theory").replace(**said)
    contrary = data.draw(st.sampled_from([0, 1, names.CONTRARY]), label="contrary")
    spares = data.draw(st.sampled_from([0, 2]), label="spare names")
    patience = data.draw(st.sampled_from([0, names.PATIENCE]), label="patience")
    expected = solve(trace, theory, max_maps=None, speedups=PLAIN)
    if not expected.cost:
        return  # the engine is asked only where some map is known
    with (
        patch.multiple(names, SPARES=spares, PATIENCE=patience, CONTRARY=contrary),
    ):
        known = data.draw(st.sampled_from([None, expected.maps[0].labels]), label="known")
        engine = LabelsFirst(Task.of(Problem.of(trace, theory)), known or ())
        engine.grow(len(trace))
        *_, best = engine.improving_maps()
        found = [found.map for found in engine.maps_of_cost(best.cost, 0)]
    assert set(found) == set(expected.maps)
    assert len(found) == len(expected.maps)
    assert best.cost == expected.cost.preferred_by(theory)
    assert engine.bound == best.cost[0]


@settings(max_examples=6)
@given(st.data())
def test_causal_maps_join_steps_that_a_person_joins(data: st.DataObject) -> None:
    """Some pairs of steps contradict the trace."""
    trace = data.draw(traces(max_steps=6), label="trace").without_stars().without_displacements()
    theory = Theory.causal().replace(same=data.draw(step_pairs(len(trace)), label="same"))
    expected = solve(trace, theory, max_maps=None, speedups=PLAIN)
    with patch.object(choosing, "FEW_STEPS", 0):
        solution = solve(trace, theory, max_maps=None)
    assert (solution.status, solution.complete) == (expected.status, expected.complete)
    assert set(solution) == set(expected)


@settings(max_examples=4)
@given(st.data())
def test_forbidden_pairs_of_returns_equal_rules_of_the_plain_encoding(data: st.DataObject) -> None:
    """Forbid two returns of a minimal map, to dstates or to places. The other maps are those of the
    readable encodings with the same rule."""
    trace = data.draw(traces(max_steps=9), label="trace").without_stars()
    task = Task.of(settle(trace, data.draw(bare_theories(), label="theory")))
    plain, engine = (
        StepEngine(task, most_paths(trace, task.theory, len(trace))),
        LabelsFirst(task),
    )
    plain.grow(len(trace))
    engine.grow(len(trace))
    for _ in range(2):
        least = [found.cost for found in plain.improving_maps()][-1:]
        if not least:
            return  # the engine is asked only where some map is known
        *_, best = engine.improving_maps()
        expected = {found.map for found in plain.maps_of_cost(least[0], 0)}
        found = [found.map for found in engine.maps_of_cost(best.cost, 0)]
        assert (set(found), len(found)) == (expected, len(expected))
        minimal = min(expected, key=repr)
        label = minimal.labels
        one_dstate = [
            Equality(i, j) for j in range(len(trace)) for i in range(j) if label[i] == label[j]
        ]
        one_place = [
            Equality(i, j, "place")
            for j in range(len(trace))
            for i in range(j)
            if minimal.place_of(i) == minimal.place_of(j)
        ]
        if not one_place:
            return
        refused = data.draw(
            st.sets(st.sampled_from(one_dstate + one_place), min_size=1, max_size=2),
            label="refused",
        )
        assert plain.forbid(refused)
        assert engine.forbid(refused)


def test_limit_during_listing_of_labels_stops_the_search() -> None:
    """Labels with the fewest dstates are listed after such a map is known. A known map ends the
    search, but not the list."""
    trace = maze(3, 3, steps=30, seed=0).trace
    theory = settle(trace).theory
    known = solve(trace, theory).maps[0].labels
    with patch.object(names, "SPARES", 0):
        engine = LabelsFirst(Task.of(Problem.of(trace, theory)), known)
        engine.grow(len(trace))
        maps = engine.improving_maps()
        next(maps)
        with (
            patch.object(Watch, "allows", lambda _, seconds: not seconds),
            pytest.raises(LimitError, match="time limit"),
        ):
            list(maps)


@cache
def maps_of_a_maze() -> frozenset[SSHMap]:
    """All minimal maps of a maze without stars, by the readable encodings."""
    trace = maze(2, 2, steps=32, seed=1).trace
    return frozenset(solve(trace, max_maps=None, speedups=Speedups.without("ways")).maps)


@pytest.mark.parametrize("off", ["", "clique", "lazy", "core_guided"])
def test_maze_without_stars_has_the_known_maps(off: str) -> None:
    """All minimal maps of 32 steps, with all speed-ups. The bound has a certificate."""
    trace = maze(2, 2, steps=32, seed=1).trace
    with stepwise(-1.0):
        search = Search(trace, max_maps=None, speedups=Speedups.without(off))
        found = search.solution(tuple(search))
    assert isinstance(search.parts.prefixes.engine, LabelsFirst)
    assert set(found.maps) == maps_of_a_maze()
    assert found.complete
    assert found.certificate
    bound = check_bound(trace, found.certificate.to_dict())
    assert bound.faults == ()
    assert found.cost
    assert bound.dstates + len(bound.refuted) == found.cost.dstates


def test_aces3_route_without_stars_has_the_known_maps() -> None:
    """As the table of docs/explanation/theory.md has it: (19, 9, 4), 38 maps."""
    trace = Trace.load(EXAMPLES / "aces3-route.jsonl")
    with patch.object(choosing, "FEW_STEPS", 0), stepwise(-1.0):
        search = Search(trace, Theory(star="none"), max_maps=None)
        found = search.solution(tuple(search))
    assert isinstance(search.parts.prefixes.engine, LabelsFirst)
    assert found.cost
    assert found.cost.to_dict() == {"dstates": 19, "places": 9, "paths": 4}
    assert len(set(found.maps)) == found.count == 38


@cache
def maps_of_the_route() -> tuple[SSHMap, ...]:
    """All minimal maps of the beginning of the route of a robot, without its stars."""
    trace = Trace.load(EXAMPLES / "aces3-route.jsonl")[:18]
    theory = Theory(star="none", prefer=("dstates", "places", "paths"))
    return solve(trace, theory, max_maps=None).maps


@pytest.mark.parametrize("settled", [False, True], ids=["step by step", "dstates first"])
def test_refused_maps_do_not_count_as_listed(settled: bool) -> None:
    """Two steps may not be at one place, though they are in most minimal maps. A few maps are no
    complete list, and all remaining maps are found."""
    trace, theory = (
        Trace.load(EXAMPLES / "aces3-route.jsonl")[:18],
        Theory(star="none", prefer=("dstates", "places", "paths")),
    )
    every = maps_of_the_route()
    pairs = [(i, j) for j in range(len(trace)) for i in range(j)]
    held = {(i, j): sum(m.place_of(i) == m.place_of(j) for m in every) for i, j in pairs}
    first, second = max(
        (pair for pair in pairs if held[pair] < len(every)), key=lambda pair: held[pair]
    )

    def refusal(_: Judging, ssh_map: SSHMap) -> tuple[str, frozenset[Equality]] | None:
        refused = len(ssh_map.labels) > second and ssh_map.place_of(first) == ssh_map.place_of(
            second
        )
        return ("test", frozenset({Equality(first, second, "place")})) if refused else None

    with (
        patch.multiple(Judging, refusal=refusal, may_refuse=True),
        patch.object(choosing, "FEW_STEPS", 0 if settled else 24),
        stepwise(-1.0 if settled else 60.0),
    ):
        few, left = solve(trace, theory, max_maps=1), solve(trace, theory, max_maps=None)
    assert set(left.maps) == {m for m in every if m.place_of(first) != m.place_of(second)}
    assert (left.complete, few.complete, few.count) == (True, False, 1)
    assert left.count == len(left.maps) == len(every) - held[first, second] > 1


@pytest.mark.slow
def test_max_maps_cuts_the_list_of_a_frameless_search() -> None:
    trace = maze(2, 2, steps=120, seed=2).trace
    with stepwise(-1.0):
        few, every = solve(trace, max_maps=3), solve(trace, max_maps=None)
    assert (few.status, few.count, few.complete, few.stopped) == (
        Status.OPTIMAL,
        3,
        False,
        "maps limit",
    )
    assert every.complete
    assert set(few.maps) < set(every.maps)
    assert all(check(trace, ssh_map, every.theory) == () for ssh_map in every.maps)


@pytest.mark.parametrize("name", ["take", "some", "_control"])
def test_interrupt_keeps_the_known_map(name: str) -> None:
    """At any time, the map that was known before is the answer."""
    trace = maze(2, 2, steps=120, seed=1).trace
    with (
        stepwise(-1.0),
        patch.object(Fitting, name, side_effect=KeyboardInterrupt),
    ):
        found = solve(trace)
    assert (found.status, found.stopped, found.count) == (Status.FEASIBLE, "interrupted", 1)
    assert check(trace, found.maps[0], found.theory) == ()


def test_later_search_continues_from_a_frameless_engine() -> None:
    """The first search of a mapper may have many steps. What it proved holds for later steps."""
    trace = maze(2, 2, steps=30, seed=1).trace
    first = trace.prefix(26)
    with stepwise(-1.0):
        search = Search(first, max_maps=None)
        before = search.solution(tuple(search))
        assert isinstance(search.parts.prefixes.engine, LabelsFirst)
        after = Search(trace, max_maps=None, _start=Start(after=search.parts))
        found = after.solution(tuple(after))
    assert before.complete
    assert set(found.maps) == set(
        solve(trace, max_maps=None, speedups=Speedups.without("ways")).maps
    )


def test_known_map_with_refused_places_is_not_returned(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also if the search ends early, as the known map has as few dstates as the bound."""
    actions = [*["travel", "travel", "around"] * 2, "travel", "travel"]
    trace = Trace.from_steps(["end", "hall", "end"] * 3, actions)
    task = Task.of(settle(trace, Theory.topological()))
    named, plain = LabelsFirst(task, (0, 1, 2, 3, 4, 5, 0, 1, 2)), StepEngine(task, 9)
    named.grow(len(trace))
    assert [*named.improving_maps()][-1].cost[0] == 6
    searched, calls = names.NamedLabels._cheapest, [0]

    def late(self: names.NamedLabels, conflicts: int) -> tuple[dict[int, int] | None, bool]:
        calls[0] += 1
        return (None, False) if calls[0] == 1 else searched(self, conflicts)

    monkeypatch.setattr(names.NamedLabels, "_cheapest", late)
    plain.grow(len(trace))
    for engine in (named, plain):
        engine.forbid([Equality(3, 8, "place")])
    assert [*named.improving_maps()][-1].cost == [*plain.improving_maps()][-1].cost == (8, 1, 5)
