"""Greedy maps for gateways at any angles (sources/metric/beam.py), and for rules of users."""

from __future__ import annotations

import random
from unittest.mock import patch

import networkx as nx
import planar
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_gateways import traces

from benchmarks.instances import maze
from ssh_abduction import Theory, Trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solution import Status
from ssh_abduction.solver import search
from ssh_abduction.solver.asp.kept_rules import can_be_asked, keeps_own_rules
from ssh_abduction.solver.sources.metric.beam import Beam
from ssh_abduction.solver.sources.symbolic.sketch import sketch_beyond, sketches_of
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.encodings import Rules
from ssh_abduction.theory.settle import Problem, settle

WORLDS: dict[str, nx.Graph] = {
    "triangle": planar.triangle(),
    "hexagon": planar.hexagon(),
    "junction of 5": planar.junction(0, 72, 144, 216, 288),
    "junction of 6": planar.junction(0, 60, 120, 180, 240, 300),
    "dead ends": planar.junction(0, 140),
    "triangles": planar.triangles(2, 2),
    "any angles": planar.scattered(6, random.Random(0)),
}


def greedy(problem: Problem) -> SSHMap | None:
    """The map of a beam of one hypothesis."""
    log = Log(problem.trace, problem.theory, problem.pairs)
    return next(iter(Beam(problem, log, 1).maps()), None)


def drive(world: str, seed: int, steps: int = 24) -> Trace:
    graph = WORLDS[world]
    start = next(iter(graph))
    trace: Trace = planar.drive(
        graph, start, next(iter(graph[start])), steps, random.Random(seed), noise=8
    ).trace
    return trace


@pytest.mark.slow
@pytest.mark.parametrize("world", WORLDS)
def test_greedy_map_satisfies_all_axioms(world: str) -> None:
    for seed in range(2):
        trace = drive(world, seed)
        problem = settle(trace)
        assert problem.theory.star == "gateways"
        ssh_map = greedy(problem)
        assert ssh_map is not None
        assert check(trace, ssh_map, problem.theory) == ()


@pytest.mark.parametrize("world", ["junction of 5", "any angles"])
def test_greedy_map_is_returned_at_the_time_limit(world: str) -> None:
    trace = drive(world, 0, 30)
    with patch.multiple(search, OVERTIME=100.0):
        solution = solve(trace, time_limit=1e-6)
    assert solution.status is Status.FEASIBLE
    assert check(trace, solution.maps[0], solution.theory) == ()
    assert len(solution.maps[0].dstates) < len(trace)  # known places are tried, too


def test_greedy_map_obeys_evidence() -> None:
    back = Trace.from_steps(
        "abaa", ["travel", "around", "travel"], stars=[[0, 120], [180, 300], [0, 120], [180, 300]]
    )
    there = greedy(settle(back))
    assert there is not None
    assert there.dstates[there.labels[3]].place == there.dstates[there.labels[0]].place
    away = greedy(settle(back, Theory(elsewhere=[(0, 3)])))
    assert away is None or away.dstates[away.labels[3]].place != away.dstates[away.labels[0]].place


KEPT = {
    "brief": "% @axiom(brief) No dstate is seen again much later.\n"
    "#program step(t).\nviolation(brief,t) :- same(I,t), t-I > 60.",
    "a constraint": "#program step(t).\n:- same_place(0,t), t > 90.",
    "at the end": "% @axiom(few) Few paths.\n"
    "#program check(t).\nviolation(few,t) :- query(t), along(_,900,_).",
    "a choice": "{ lit }.\n#program step(t).\n:- not lit, same(_,t).",
    "order": "% @axiom(order) x\n#program step(t).\nviolation(order,t) :- before(H,P,P), at(t,P).",
}
BROKEN = {
    "all steps": "% @axiom(never) x\n#program step(t).\nviolation(never,t) :- view(t,_).",
    "at the end": "% @axiom(many) x\n"
    "#program check(t).\nviolation(many,t) :- query(t), along(_,1,pos).",
    "a place": "#program step(t).\n:- at(t,P), P > 0.",
    "a course": "#program step(t).\n:- same_course(_,t).",
}


def ruled(text: str, theory: Theory) -> Theory:
    return theory.replace(rules=[Rules("own.lp", text)])


@pytest.mark.parametrize(
    ("name", "fault"),
    [*((name, {}) for name in KEPT), ("order", {"misread": 1.5}), ("brief", {"slipped": 3.0})],
)
def test_map_that_satisfies_own_rules_is_returned_at_the_limit(
    name: str, fault: dict[str, float]
) -> None:
    trace = maze(3, 3, steps=60, seed=0).trace
    theory = ruled(KEPT[name], Theory.topological().replace(**fault))
    with patch.multiple(search, OVERTIME=100.0):
        solution = solve(trace, theory, time_limit=1e-6)
    assert solution.status is Status.FEASIBLE
    assert check(trace, solution.maps[0], Theory.topological()) == ()


@pytest.mark.parametrize("name", BROKEN)
def test_map_that_breaks_own_rules_is_not_returned(name: str) -> None:
    trace = maze(3, 3, steps=60, seed=0).trace
    with patch.multiple(search, OVERTIME=100.0):
        assert solve(trace, ruled(BROKEN[name], Theory.topological()), time_limit=1e-6).maps == ()


SMALL = Trace.from_steps("abab", ["travel", "around", "travel"])
READ = [
    "same(I,t), t-I > 1",
    "same_place(I,t), not same(I,t)",
    "along(t,1,neg)",
    "at(t,0), t > 1",
    "on(1,P), at(t,P), view(t,b)",
    "before(1,P,Q), at(t,Q), P > Q",
    "travel(t-1), same_course(t-1,t), t > 2",
    "on_some_path(t), turn(t-1,around)",
]


@pytest.mark.parametrize(
    ("level", "body"), [("causal", READ[0]), *(("topological", body) for body in READ)]
)
def test_own_rules_select_the_same_maps_as_clingo(body: str, level: str) -> None:
    """The maps without the rule that satisfy it are those that clingo finds with the rule."""
    plain = getattr(Theory, level)().replace(prefer=())
    theory = ruled(f"#program step(t).\n:- {body}.", plain)

    def maps_of(asked: Theory) -> set[SSHMap]:
        return set(solve(SMALL, asked, max_maps=None).maps)

    resolved = settle(SMALL, theory).theory
    assert can_be_asked(resolved)
    assert {
        ssh_map
        for ssh_map in maps_of(plain)
        if keeps_own_rules(Problem.of(SMALL, resolved), ssh_map)
    } == maps_of(theory)


@pytest.mark.parametrize("body", ["founded(S,t)", "used(H,t)", "violation(deterministic,t)"])
def test_rules_about_atoms_without_facts_cannot_be_checked(body: str) -> None:
    assert not can_be_asked(
        settle(SMALL, ruled(f"#program step(t).\n:- {body}.", Theory.topological())).theory
    )


@pytest.mark.parametrize(
    ("kind", "body"), [(("misread", "slipped")[i % 2], body) for i, body in enumerate(READ)]
)
def test_own_rules_select_the_same_maps_with_faults_as_clingo(body: str, kind: str) -> None:
    plain = Theory.topological().replace(**{kind: 0.5})
    theory = ruled(f"#program step(t).\n:- {body}.", plain)
    problem = Problem.of(SMALL, settle(SMALL, theory).theory)
    found, free = (solve(SMALL, asked, max_maps=None) for asked in (theory, plain))
    assert can_be_asked(problem.theory)
    assert all(keeps_own_rules(problem, ssh_map) for ssh_map in found.maps)
    if found.cost == free.cost:
        kept = {ssh_map for ssh_map in free.maps if keeps_own_rules(problem, ssh_map)}
        assert kept == {*found.maps}


def sketched(trace: Trace, theory: Theory) -> list[SSHMap]:
    """The maps of the sketches of a trace that reach its end."""
    return [
        sketch.map()
        for sketch in sketches_of(trace.steps[0], theory)
        if all(
            sketch.extend(action, step)
            for action, step in zip(trace.actions, trace.steps[1:], strict=True)
        )
    ]


@pytest.mark.parametrize("world", WORLDS)
def test_sketches_of_worlds_satisfy_all_axioms(world: str) -> None:
    for seed in range(1):
        trace = drive(world, seed, 60)
        theory = settle(trace).theory
        small, large = sketched(trace, theory)
        assert check(trace, small, theory) == check(trace, large, theory) == ()
        assert len(small.places) <= len(large.places)


@settings(max_examples=15)
@given(traces(), st.booleans())
def test_sketch_exists_if_a_map_exists(trace: Trace, all_on_paths: bool) -> None:
    theory = settle(trace, Theory(star="gateways", all_on_paths=all_on_paths)).theory
    exists = any(check(trace, ssh_map, theory) == () for ssh_map in sketched(trace, theory))
    assert exists == bool(solve(trace, theory, max_maps=1, time_limit=100).maps)


def test_sketch_puts_dstates_that_face_opposite_ways_on_one_path() -> None:
    stars = [(0, 1, 0, 1), (1, 0, 1, 0)] * 2
    trace = Trace.from_steps("abab", ["right"] * 3, stars=stars)
    theory = settle(trace, Theory(star="gateways", all_on_paths=True)).theory
    found = sketched(trace, theory)
    assert [check(trace, ssh_map, theory) for ssh_map in found] == [(), ()]


@pytest.mark.parametrize(("first", "places"), [([0], 2), ([0, 180], 3)])
def test_sketch_ends_paths_at_dead_ends_only(first: list[int], places: int) -> None:
    """The robot drives to and fro between a place and a dead end.

    Both dead ends are one. The other place is one only if it is a dead end, too.
    """
    trace = Trace.from_steps(
        "abcdab",
        ["travel", "around", "travel", "around", "travel"],
        stars=[first, [180], [0], [(180 + bearing) % 360 for bearing in first], first, [180]],
    )
    theory = settle(trace, Theory.topological().replace(star="gateways")).theory
    small, large = sketched(trace, theory)
    assert len(small.places) == 2
    assert len(large.places) == places
    assert check(trace, small, theory) == check(trace, large, theory) == ()


def test_sketch_reads_the_end_of_a_path_from_all_steps_at_a_place() -> None:
    """The second step does not see what is behind it, but the first step saw no gateway there."""
    stars = [(0, 1, 1, 0), (1, 1, None, 0), (0, 0, 1, 0), (1, 0, 0, 0), (0, 0, 1, 1)]
    trace = Trace.from_steps("abcde", ["right", "travel", "around", "travel"], stars=stars)
    theory = settle(trace).theory
    small, large = sketched(trace, theory)
    assert check(trace, small, theory) == check(trace, large, theory) == ()


def test_sketch_extends_a_known_map() -> None:
    trace = drive("junction of 5", 0, 40)
    theory = settle(trace).theory
    known = solve(trace.prefix(20), theory, max_maps=1).maps[0]
    sketch = sketch_beyond(known, trace.prefix(20), theory, homing=False)
    assert sketch.map() == known
    for action, step in zip(trace.actions[19:], trace.steps[20:], strict=True):
        assert sketch.extend(action, step)
    assert check(trace, sketch.map(), theory) == ()
