"""Planarity: against networkx, a tree of maps, and the brute force."""

from __future__ import annotations

import random
from dataclasses import replace
from itertools import combinations
from typing import Literal
from unittest.mock import patch

import networkx as nx
import pytest
from brute_force import consistent_maps, key, minimal_maps
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import maze
from map_trees import DIRECTIONS, Cells, Joined, lattice, levels, passes_no_place_twice, stars_on
from worlds import ACTIONS, HEADINGS, QUARTERS, drive, streets

from ssh_abduction import OnlineMapper, Solution, SSHMap, Theory, Trace, solve
from ssh_abduction.checker import check
from ssh_abduction.checker.evidence import Edges
from ssh_abduction.data.maps import DState
from ssh_abduction.solution import Status
from ssh_abduction.solver.sources.exact import choosing, prefixes
from ssh_abduction.solver.sources.symbolic.sketch import first_contradiction, sketches_of
from ssh_abduction.theory.evidence import Equality, Planar
from ssh_abduction.theory.planarity import can_be_drawn, is_planar
from ssh_abduction.theory.settle import settle

# Drawings, against networkx

NAMED = {
    "K4": nx.complete_graph(4),
    "K5": nx.complete_graph(5),
    "K5 without an edge": nx.complete_graph([0, 1, 2, 3, 4]),
    "K3,3": nx.complete_bipartite_graph(3, 3),
    "grid": nx.grid_2d_graph(3, 3),
    "wheel": nx.wheel_graph(7),
    "two parts": nx.disjoint_union(nx.cycle_graph(4), nx.complete_graph(4)),
    "Petersen": nx.petersen_graph(),
}
NAMED["K5 without an edge"].remove_edge(0, 1)


def scrambled(graph: nx.Graph, rng: random.Random) -> dict[object, list[object]]:
    """A rotation system: the neighbours of each vertex, in any order."""
    return {v: rng.sample(list(graph[v]), len(graph[v])) for v in graph}


def ends_of(rotation: dict[object, list[object]]) -> dict[object, tuple[int, ...]]:
    """A rotation system of the ends of edges."""
    number = {
        edge: i
        for i, edge in enumerate(
            {frozenset((v, w)) for v, around in rotation.items() for w in around}
        )
    }
    first = {edge: min(edge, key=repr) for edge in number}
    return {
        v: tuple(2 * number[e] + (first[e] != v) for w in around for e in [frozenset((v, w))])
        for v, around in rotation.items()
    }


def networkx_says(rotation: dict[object, list[object]]) -> bool:
    embedding = nx.PlanarEmbedding()
    embedding.set_data(rotation)
    try:
        embedding.check_structure()
    except nx.NetworkXException:
        return False
    return True


@pytest.mark.parametrize("name", NAMED)
def test_planarity_test_agrees_with_networkx_on_known_graphs(name: str) -> None:
    graph, rng = NAMED[name], random.Random(name)
    planar, embedding = nx.check_planarity(graph)
    if planar:
        assert is_planar(ends_of(embedding.get_data()))
    answers = []
    for _ in range(50):
        rotation = scrambled(graph, rng)
        answers.append(is_planar(ends_of(rotation)))
        assert answers[-1] == networkx_says(rotation)
    assert planar or not any(answers)


def test_planarity_test_agrees_with_networkx_on_random_graphs() -> None:
    rng = random.Random(0)
    answers = []
    for _ in range(600):
        size = rng.randint(2, 7)
        graph = nx.gnm_random_graph(
            size,
            rng.randint(size - 1, min(size * (size - 1) // 2, 2 * size)),
            seed=rng.randrange(10**6),
        )
        rotation = scrambled(graph, rng)
        answers.append(is_planar(ends_of(rotation)))
        assert answers[-1] == networkx_says(rotation)
    assert 100 < sum(answers) < 500


@pytest.mark.slow
def test_drawings_with_free_orders_equal_planar_graphs() -> None:
    rng = random.Random(1)
    graphs = [
        NAMED[name]
        for name in ("K4", "K5", "K5 without an edge", "K3,3", "grid", "wheel", "two parts")
    ]
    graphs += [nx.gnm_random_graph(6, rng.randint(6, 12), seed=seed) for seed in range(60)]
    answers = [can_be_drawn(list(graph.edges), lambda place, ends: True) for graph in graphs]
    assert answers == [nx.is_planar(graph) for graph in graphs]
    assert {True, False} <= set(answers[7:])


def test_drawings_with_given_orders_equal_rotation_systems() -> None:
    rng = random.Random(2)
    answers = []
    for _ in range(200):
        graph = nx.gnm_random_graph(5, rng.randint(4, 8), seed=rng.randrange(10**6))
        edges = list(graph.edges)
        ends = [(v, 2 * i + side) for i, edge in enumerate(edges) for side, v in enumerate(edge)]
        around = {
            v: rng.sample(there, len(there))
            for v in graph
            if (there := [end for w, end in ends if w == v])
        }

        def allows(
            place: object, some: tuple[int, ...], around: dict[object, list[int]] = around
        ) -> bool:
            positions = [around[place].index(end) for end in some]
            return sum(positions[i - 1] > positions[i] for i in range(len(positions))) <= 1

        answers.append(can_be_drawn(edges, allows))
        assert answers[-1] == is_planar({v: tuple(order) for v, order in around.items()})
    assert 20 < sum(answers) < 180


def test_planarity_of_loops_and_parallel_streets() -> None:
    assert is_planar({})
    assert is_planar({"a": (0, 1)})
    assert not is_planar({"a": (0, 2, 1, 3)})
    assert is_planar({"a": (0, 2), "b": (1, 3)})
    assert is_planar({"a": (0, 2, 4), "b": (5, 3, 1)})
    assert not is_planar({"a": (0, 2, 4), "b": (1, 3, 5)})


# Numbers of maps, against a tree of maps that knows nothing of encodings


def drawn(joined: Joined) -> bool:
    """Whether a map of the tree can be drawn."""
    number: dict[frozenset[object], int] = {}
    around: dict[int, tuple[int, ...]] = {}
    for gateway, other in sorted(joined.items()):
        end = 2 * number.setdefault(frozenset((gateway, other)), len(number)) + (gateway > other)
        around[gateway[0]] = (*around.get(gateway[0], ()), end)
    return is_planar(around)


# Route, walls, and numbers of maps after the last move: all, those whose streets pass no place
# twice, planar ones, and both
TREES: list[tuple[str, Cells | None, tuple[int, int, int, int]]] = [
    ("ESWN", None, (41, 19, 20, 16)),
    ("ESWNESWN", None, (5677, 1623, 631, 444)),
    ("EESWWN", None, (380, 95, 174, 72)),
    ("EESSWWNNSEENWSS", lattice(3, 3), (87, 79, 69, 61)),
    ("EESWWSEENNWSSWNN", lattice(3, 3), (129, 88, 97, 62)),
    ("ESWNESWN", lattice(2, 2), (8, 8, 8, 8)),
]


@pytest.mark.parametrize(("route", "walls", "counts"), TREES)
def test_numbers_of_planar_maps_equal_the_table(
    route: str, walls: Cells | None, counts: tuple[int, ...]
) -> None:
    choices = ([], [passes_no_place_twice], [drawn], [passes_no_place_twice, drawn])
    assert tuple(len(list(levels(route, walls, allows))[-1]) for allows in choices) == counts


def route_trace(route: str) -> Trace:
    """A robot that starts facing east, sees only open gateways, and turns before it travels."""
    seen, heading, actions = stars_on(route, None), 1, []
    for way in route:
        quarters, heading = (DIRECTIONS.index(way) - heading) % 4, DIRECTIONS.index(way)
        actions += [ACTIONS["?RAL"[quarters]]] if quarters else []
        actions.append("travel")
    return Trace.from_steps("a" * (len(actions) + 1), actions, stars=[seen[0]] * (len(actions) + 1))


def equalities(joined: Joined, route: str) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Which steps are one dstate, and which are at one place, in a map of the tree."""
    heading, faced = 1, (0, 1)
    steps = [faced]
    for way in route:
        quarters, heading = (DIRECTIONS.index(way) - heading) % 4, DIRECTIONS.index(way)
        if quarters:
            faced = (faced[0], (faced[1] + quarters) % 4)
            steps.append(faced)
        place, slot = joined[faced]
        faced = (place, (slot + 2) % 4)
        steps.append(faced)
    dstates: dict[object, int] = {}
    places: dict[int, int] = {}
    return tuple(dstates.setdefault(s, len(dstates)) for s in steps), tuple(
        places.setdefault(s[0], len(places)) for s in steps
    )


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("route", ["EESS", "EWE", "EESWN"])
def test_maps_of_the_solver_equal_the_search_tree(route: str, planar: bool) -> None:
    """The checker accepts the planar maps of the tree, minimal or not.

    Two maps of the tree that differ only in headings are one map, planar if one of them is.
    """
    allows = [passes_no_place_twice, *([drawn] if planar else [])]
    expected = {equalities(joined, route) for joined in list(levels(route, None, allows))[-1]}
    theory = Theory(star="frame", boundary="none", next_place=True, planar=planar, prefer=())
    found = solve(route_trace(route), theory, max_maps=None).maps
    assert {
        (m.labels, tuple(m.dstates[label].place for label in m.labels)) for m in found
    } == expected


# Minimal maps, against the brute force


@st.composite
def winding(draw: st.DrawFn, steps: int = 6) -> Trace:
    """A trace that sees nearly the same everywhere, so that small maps have crossing streets."""
    letters = draw(st.lists(st.sampled_from("TTTRRLA"), min_size=steps - 1, max_size=steps - 1))
    views = draw(st.lists(st.sampled_from("aaaab"), min_size=steps, max_size=steps))
    stars = [(1, 1, 1, 1)] * steps if draw(st.booleans()) else None
    return Trace.from_steps(views, [ACTIONS[letter] for letter in letters], stars=stars)


def loose(data: st.DataObject, trace: Trace) -> Theory:
    """A theory with planarity and few other axioms."""
    return Theory(
        planar=True,
        star="frame" if trace.has_stars else "none",
        boundary=data.draw(st.sampled_from(["none", "strict"]), label="boundary"),
        path_order=data.draw(st.sampled_from(["partial", "total"]), label="order"),
        symmetric_sides=data.draw(st.booleans(), label="symmetric"),
        prefer=data.draw(
            st.sampled_from([("dstates", "paths", "places"), ("places", "dstates"), ()]),
            label="prefer",
        ),
    )


@settings(max_examples=6)
@given(data=st.data())
def test_minimal_planar_maps_equal_the_brute_force(data: st.DataObject) -> None:
    trace = data.draw(winding(), label="trace")
    theory = loose(data, trace)
    counts, expected = minimal_maps(trace, theory)
    first_prefix = data.draw(st.sampled_from([1, 8]), label="first prefix")
    with (
        patch.object(prefixes, "FIRST_PREFIX", first_prefix),
        patch.object(choosing, "FEW_STEPS", data.draw(st.sampled_from([0, 24]))),
    ):
        solution = solve(trace, theory, max_maps=None)
    assert solution.status is (Status.OPTIMAL if counts else Status.UNSATISFIABLE)
    assert {key(ssh_map) for ssh_map in solution.maps} == expected
    for ssh_map in solution.maps:
        assert check(trace, ssh_map, theory) == ()


def holds(equality: Equality, ssh_map: SSHMap) -> bool:
    """Whether an equality holds in a map."""
    here, there = (
        ssh_map.dstates[ssh_map.labels[step]] for step in (equality.first, equality.second)
    )
    same = here.id == there.id if equality.of == "dstate" else here.place == there.place
    return same == equality.holds


def test_refusals_hold_in_no_planar_map() -> None:
    """Evidence accepts exactly the maps that the brute force calls planar.

    No planar map has all equalities for which another one is refused.
    """
    rng = random.Random(3)
    refused = accepted = 0
    for _ in range(8):
        letters = [rng.choice("TTTTRLA") for _ in range(6)]
        trace = Trace.from_steps(
            "a" * 7,
            [ACTIONS[letter] for letter in letters],
            stars=[(1, 1, 1, 1)] * 7 if rng.random() < 0.5 else None,
        )
        theory = settle(trace, Theory(boundary="none", path_order="partial", prefer=())).theory
        planar = theory.replace(planar=True)
        drawable = {found for found, _ in consistent_maps(trace, planar)}
        maps = solve(trace, theory, max_maps=None).maps
        reasons = {ssh_map: Planar.of(planar).refuse(trace, ssh_map) for ssh_map in maps}
        assert {key(ssh_map) for ssh_map, reason in reasons.items() if not reason} == drawable
        for ssh_map, reason in reasons.items():
            refused, accepted = refused + bool(reason), accepted + (not reason)
            assert [v.axiom for v in check(trace, ssh_map, planar)] == (
                ["planar"] if reason else []
            )
            if reason:
                assert all(holds(equality, ssh_map) for equality in reason)
                assert not any(
                    all(holds(equality, other) for equality in reason)
                    for other in maps
                    if not reasons[other]
                )
    assert min(refused, accepted) > 10


def test_planar_map_cut_to_a_prefix_stays_planar() -> None:
    rng = random.Random(4)
    for _ in range(8):
        letters = [rng.choice("TTRRLA") for _ in range(9)]
        stars = [(1, 1, 1, 1)] * 10 if rng.random() < 0.5 else None
        trace = Trace.from_steps("a" * 10, [ACTIONS[letter] for letter in letters], stars=stars)
        theory = settle(trace, Theory(boundary="none", planar=True)).theory
        for ssh_map in solve(trace, theory, max_maps=20).maps:
            for steps in range(1, len(trace)):
                labels = ssh_map.labels[:steps]
                assert Planar.of(theory).refuse(trace, SSHMap(labels, ssh_map.dstates, ())) is None


@pytest.mark.parametrize("stars", [None, [(0, 0, 0, 1), (0, 0, 1, 0), (1, 0, 0, 0), (0, 1, 0, 0)]])
def test_maps_made_without_a_search_are_planar(stars: list[object] | None) -> None:
    """The way back through one gateway must lead to the place from which the robot came."""
    trace = Trace.from_steps("abcd", ["travel", "around", "travel"], stars=stars)
    theory = settle(trace, Theory(planar=True)).theory
    for sketch in sketches_of(trace.steps[0], theory):
        assert first_contradiction(sketch, trace) is None
        assert check(trace, sketch.map(), theory) == ()


@settings(max_examples=5)
@given(data=st.data())
def test_online_planar_maps_equal_those_of_solve(data: st.DataObject) -> None:
    trace = data.draw(winding(), label="trace")
    theory = loose(data, trace)
    first = trace.steps[0]
    assert first.view is not None
    mapper = OnlineMapper(first.view, theory, star=first.star, time_limit=None, max_maps=None)
    for before, step in zip(trace.steps, trace.steps[1:], strict=False):
        assert before.action is not None
        assert step.view is not None
        online = mapper.observe(before.action, step.view, star=step.star)
    assert {key(m) for m in online.maps} == {
        key(m) for m in solve(trace, theory, max_maps=None).maps
    }


# Worlds

# A grid of 3 x 3 places, without the street between the last two of the bottom row.
GRID = streets(
    *((f"{x}{y}", "E", f"{x + 1}{y}") for x in range(2) for y in range(3) if (x, y) != (1, 2)),
    *((f"{x}{y}", "S", f"{x}{y + 1}") for x in range(3) for y in range(2)),
)
TOUR = "12", "E", "LTLTRTRTRTRTLTLTLTT"


@pytest.fixture(scope="module")
def tour() -> Trace:
    """The trace of the tour if places look alike except for their stars, with the true dstates."""
    place, heading, actions = TOUR
    seen = drive(GRID, place, heading, actions, stars=True)
    facing = HEADINGS.index(heading)
    states = [(place, facing)]
    for action in actions:
        if action == "T":
            place = GRID[place][HEADINGS[facing]]
        else:
            facing = (facing + QUARTERS[action]) % 4
        states.append((place, facing))
    steps = tuple(
        replace(step, view="a", truth=f"{p}{f}")
        for step, (p, f) in zip(seen.steps, states, strict=True)
    )
    return replace(seen, steps=steps)


@pytest.fixture(scope="module")
def nonplanar(tour: Trace) -> Solution:
    """The minimal maps of the tour without planarity, even if no travel passes a place unseen."""
    return solve(tour, Theory(next_place=True), max_maps=None)


def true_labels(trace: Trace) -> tuple[int, ...]:
    number: dict[object, int] = {}
    return tuple(number.setdefault(step.truth, len(number)) for step in trace.steps)


@pytest.mark.slow
def test_planarity_excludes_smaller_maps_and_finds_the_true_one(
    tour: Trace, nonplanar: Solution
) -> None:
    """Four smaller maps explain the tour; their streets cross."""
    assert nonplanar.cost
    assert (nonplanar.cost.dstates, nonplanar.count) == (14, 4)
    assert true_labels(tour) not in {ssh_map.labels for ssh_map in nonplanar.maps}
    for ssh_map in nonplanar.maps:
        assert "planar" in {
            violation.axiom for violation in check(tour, ssh_map, Theory(planar=True))
        }
    solution = solve(tour, Theory(planar=True), max_maps=None)
    assert solution.status is Status.OPTIMAL
    assert [ssh_map.labels for ssh_map in solution.maps] == [true_labels(tour)]


def test_checker_names_streets_that_cross(tour: Trace, nonplanar: Solution) -> None:
    ssh_map = nonplanar.maps[0]
    (violation,) = (v for v in check(tour, ssh_map, Theory(planar=True)) if v.axiom == "planar")
    assert "paths cross" in violation.message
    moved = {t for t, action in enumerate(tour.actions) if action.kind == "travel"}
    assert set(violation.steps) == {
        step
        for t in moved & set(violation.steps)
        if t + 1 in violation.steps
        for step in (t, t + 1)
    }


def test_refusal_by_planarity_names_few_steps(tour: Trace, nonplanar: Solution) -> None:
    """A place that the map keeps apart from another one may be where streets meet.

    Without this, a refusal would forbid planar maps.
    """
    ssh_map = nonplanar.maps[0]
    reason = Planar.of(settle(tour, Theory(planar=True)).theory).refuse(tour, ssh_map)
    assert reason
    place = {
        step: ssh_map.dstates[ssh_map.labels[step]].place
        for e in reason
        for step in (e.first, e.second)
    }
    assert len(place) < len(tour)
    apart = {frozenset((place[e.first], place[e.second])) for e in reason if not e.holds}
    assert apart == {
        frozenset(pair) for pair in combinations(sorted(set(place.values()), key=str), 2)
    }


@pytest.mark.parametrize("star", ["frame", "none"])
@pytest.mark.parametrize("follow", [True, False])
@pytest.mark.parametrize(("cells", "steps"), [(4, 60), (8, 300)])
def test_planarity_accepts_the_true_map_of_a_maze(
    cells: int, steps: int, follow: bool, star: Literal["frame", "none"]
) -> None:
    """The true map is drawn, although places without frames leave the order of gateways open."""
    walk = maze(cells, cells, steps=steps, seed=101, stars=True, follow=follow)
    number: dict[tuple[int, ...], int] = {}
    places: dict[tuple[int, ...], int] = {}
    labels = tuple(number.setdefault(state, len(number)) for state in walk.truth)
    dstates = tuple(
        DState(i, "", places.setdefault(state[:2], len(places))) for state, i in number.items()
    )
    assert len(places) > cells
    assert (
        Planar.of(Theory(planar=True, star=star)).refuse(walk.trace, SSHMap(labels, dstates, ()))
        is None
    )


@pytest.mark.parametrize(("planar", "expected"), [(False, {0, 1}), (True, {1})])
def test_planarity_forbids_passing_a_place_unseen(planar: bool, expected: set[int]) -> None:
    """After two travels and a turn around, a travel leads back to the second place.

    A gateway leads to one gateway; without that, the travel may pass the place.
    """
    trace = Trace.from_steps("aabca", ["travel", "travel", "around", "travel"])
    maps = solve(trace, Theory(planar=planar, prefer=("places",)), max_maps=None).maps
    assert {ssh_map.dstates[ssh_map.labels[4]].place for ssh_map in maps} == expected


@pytest.mark.parametrize(("slot", "expected"), [(3, True), (2, False)])
def test_headings_decide_whether_three_streets_cross(slot: int, expected: bool) -> None:
    """Three streets between two places do not cross if their orders around them are mirrored."""
    joined = Edges([(0, 1), (2, 3), (4, 5)], [], {0: 0, 1: 1, 2: 1, 3: 0, 4: 0, 5: 1})
    headings = {0: 1, 1: 1, 2: 0 if expected else 2, 3: 2, 4: 3, 5: slot}
    assert joined.can_be_drawn_by(headings) == expected


def test_streets_without_an_order_are_free() -> None:
    """Without frames, three streets between two places can be drawn: sides say less than slots.

    A turn right and back right cannot.
    """
    free = Edges(
        [(0, 1), (2, 3), (4, 5)],
        [(1, "right", 2), (3, "right", 4)],
        {0: 0, 1: 1, 2: 1, 3: 0, 4: 0, 5: 1},
    )
    assert free.can_be_drawn(crossing=True)
    both_right = Edges(
        [(0, 1), (2, 3)], [(1, "right", 2), (2, "right", 1)], {0: 0, 1: 1, 2: 1, 3: 2}
    )
    assert not both_right.can_be_drawn(crossing=True)
