"""No speed-up changes an answer. One, all or none are off, and the answers are compared with each
other and with the plain encoding."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from functools import cache
from itertools import islice, pairwise, product
from pathlib import Path
from unittest.mock import patch

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import maze, moore
from strategies import traces
from turns import stepwise

from ssh_abduction import Theory, Trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.data import SolverError
from ssh_abduction.runtime.limits import LimitError
from ssh_abduction.solution import Status
from ssh_abduction.solver import Search
from ssh_abduction.solver.asp import facts
from ssh_abduction.solver.sources.exact import choosing, labels_first, names
from ssh_abduction.solver.sources.exact import names as named
from ssh_abduction.solver.sources.symbolic.merging import merged
from ssh_abduction.solver.steps.apart import Continuations, clique
from ssh_abduction.solver.steps.chart import Chart
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory import Speedups, encodings
from ssh_abduction.theory.settle import settle

NAMES = [f.name for f in fields(Speedups)]
PLAIN = Speedups.without(NAMES)


@st.composite
def machines(draw: st.DrawFn, most_steps: int = 14) -> Trace:
    """A walk in a random machine of few states, or any random trace. So some maps close, and others
    do not."""
    if draw(st.booleans()):
        return draw(traces(max_steps=8, closures=True))
    states = draw(st.integers(1, 6))
    views = draw(st.lists(st.sampled_from("ab"), min_size=states, max_size=states))
    follow = draw(
        st.lists(
            st.lists(st.integers(0, states - 1), min_size=2, max_size=2),
            min_size=states,
            max_size=states,
        )
    )
    done = draw(st.lists(st.integers(0, 1), min_size=1, max_size=most_steps))
    state, seen = 0, [views[0]]
    for action in done:
        state = follow[state][action]
        seen.append(views[state])
    return Trace.from_steps(seen, [("travel", "right")[action] for action in done])


@settings(max_examples=8)
@given(machines(), st.sets(st.sampled_from(NAMES)), st.data())
def test_any_speedups_give_the_maps_of_the_plain_encoding(
    trace: Trace, off: set[str], data: st.DataObject
) -> None:
    """Prefixes, waiting times and buffers are so small that short traces use them all."""
    expected = solve(trace, Theory.causal(), max_maps=None, speedups=PLAIN)
    first = data.draw(st.sampled_from([2, 5, 32]), label="first prefixes")
    at_once = data.draw(st.sampled_from([4, 8000]), label="at once")
    patience = data.draw(st.sampled_from([0, 1, 2000]), label="patience")
    held = data.draw(st.sampled_from([1, 100]), label="held back")
    spares = data.draw(st.sampled_from([0, 1, 2]), label="spare names")
    with (
        patch.multiple(labels_first, FIRST_PREFIXES=first, AT_ONCE=at_once),
        patch.multiple(named, AT_ONCE=at_once, HELD_BACK=held, SPARES=spares),
        patch.multiple(names, PATIENCE=patience, MORE_LINKS=2),
        patch.object(choosing, "FEW_STEPS", 0),
    ):
        found = solve(trace, Theory.causal(), max_maps=None, speedups=Speedups.without(off))
    assert found.status is expected.status is Status.OPTIMAL
    assert found.cost == expected.cost
    assert set(found.maps) == set(expected.maps)
    assert found.count == len(set(found.maps))
    assert found.complete


@contextmanager
def noted_reads() -> Iterator[set[str]]:
    """The speed-ups that the search looks up in the table meanwhile."""
    read: set[str] = set()
    get = Speedups.__getattribute__

    def noted(self: Speedups, name: str) -> object:
        if name in NAMES and Path(sys._getframe(1).f_code.co_filename).name not in (
            "speedups.py",
            "dataclasses.py",
        ):
            read.add(name)
        return get(self, name)

    with patch.object(Speedups, "__getattribute__", noted):
        yield read


CIRCUITS = Trace.from_steps(
    [f"v{i % 4}" for i in range(24)], [("right", "travel")[i % 2] for i in range(23)]
)
CASES = {
    "causal": (moore(6, 2, steps=32, seed=1).trace, Theory.causal()),
    "topological": (CIRCUITS, Theory.topological()),
    "circumscriptive": (CIRCUITS, Theory.circumscriptive()),
    "framed": (maze(3, 3, steps=22, seed=0, stars=True).trace, Theory.topological()),
    "frameless": (maze(2, 2, steps=18, seed=1).trace, Theory.topological()),
    "pattern": (maze(2, 2, steps=13, seed=0, stars=True).trace, Theory(star="pattern")),
}


@contextmanager
def hurried() -> Iterator[None]:
    """Steps that need a slow search are done at once."""
    with (
        patch.object(choosing, "FEW_STEPS", 0),
        stepwise(-1.0),
        patch.object(names, "PATIENCE", 0),
    ):
        yield


@cache
def reads_of(case: str) -> list[str]:
    """The speed-ups that a search of this case asks for."""
    trace, theory = CASES[case]
    with noted_reads() as read, hurried():
        solve(trace, theory, max_maps=None)
    return [name for name in NAMES if name in read]


def test_each_speedup_is_used_in_some_case() -> None:
    """If no case used a speed-up, the tests below would not test it."""
    read = {name for case in CASES for name in reads_of(case)}
    assert read == set(NAMES) - {"digest"}  # tests/test_onto.py tests `digest`


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_switching_off_each_speedup_changes_no_answer(case: str) -> None:
    trace, theory = CASES[case]
    with hurried():
        expected = solve(trace, theory, max_maps=None)
        for off in reads_of(case):
            found = solve(trace, theory, max_maps=None, speedups=Speedups.without(off))
            assert set(found.maps) == set(expected.maps), off
            assert found.cost == expected.cost, off


@pytest.mark.parametrize("most", [1, 2, 5])
def test_lazy_search_lists_as_many_maps_as_requested(most: int) -> None:
    """Equal spurs off a ring. With lazy links and buffers, the search lists as many maps as asked
    for, and no map twice."""
    trace = Trace.from_steps(
        "abacabadabacab",
        ["travel", "right", "travel", "left", "right", "right", "travel"] + ["travel", "left"] * 3,
    )
    every = solve(trace, Theory.causal(), max_maps=None, speedups=PLAIN)
    with patch.object(choosing, "FEW_STEPS", 0):
        found = solve(trace, Theory.causal(), max_maps=most or None)
    assert found.count == min(most, every.count)
    assert set(found.maps) <= set(every.maps)
    assert found.complete == (every.count <= most)


@settings(max_examples=12)
@given(machines(most_steps=40))
def test_greedy_merging_gives_a_map(trace: Trace) -> None:
    theory = Theory.causal()
    with (
        patch.object(named.NamedLabels, "grow", side_effect=KeyboardInterrupt),
        patch.object(choosing, "FEW_STEPS", 0),
    ):
        found = solve(trace, theory)
    assert found.status is Status.FEASIBLE
    assert check(trace, found.maps[0], theory) == ()


@settings(max_examples=25)
@given(machines(most_steps=30))
def test_apart_matrix_and_clique_equal_their_definitions(trace: Trace) -> None:
    """The matrix equals its definition, step by step. The cliques are compared with all cliques, by
    networkx."""
    log = Log(trace, Theory.causal())
    continuations = Continuations(log.seen, log.actions)
    apart, graph = continuations.apart(), nx.empty_graph(len(trace))
    for i, j in product(range(len(trace)), repeat=2):
        k = 0
        while (
            log.seen[i + k] == log.seen[j + k]
            and log.actions[i + k : i + k + 1] == log.actions[j + k : j + k + 1] != []
        ):
            k += 1
        differ = log.seen[i + k] != log.seen[j + k]
        assert apart[i, j] == differ
        assert continuations.apart_from(i)[j] == differ
        graph.add_edges_from([(i, j)] if differ else [])
    cliques = list(nx.find_cliques(graph))
    steps = continuations.clique()
    assert sorted(steps) in map(sorted, cliques)
    assert len(steps) == max(map(len, cliques))
    assert sorted(clique(apart, log.seen)) in map(sorted, cliques)


@pytest.mark.parametrize("period", [1, 2, 7])
def test_continuations_of_circuits_are_equal(period: int) -> None:
    """The steps have nearly the whole trace in common, so it takes many doublings to distinguish
    them."""
    seen = [step % period for step in range(1000)]
    continuations = Continuations(seen, [0] * 999)
    assert len(continuations.clique()) == period
    assert continuations.apart().tolist() == (np.subtract.outer(seen, seen) != 0).tolist()


def test_clique_is_the_bound_of_an_interrupted_search() -> None:
    """The clique is a bound before clingo has any answer."""
    trace = Trace.from_steps("abcabd", ["travel"] * 5)
    with patch.object(choosing, "FEW_STEPS", 0):
        search = Search(trace, Theory.causal(), speedups=Speedups.without("greedy"))
    with patch.object(named.NamedLabels, "improving", side_effect=KeyboardInterrupt):
        assert list(search) == []
    assert (
        search.bound.dstates == 4 + 2
    )  # a, b, c, d, and the first a and b, which lead to another c and d


def test_unknown_speedups_are_an_error() -> None:
    with pytest.raises(
        SolverError, match=r"speedups: expected names out of prefixes, .*, got 'magic'"
    ):
        Speedups.without("magic")


@settings(max_examples=8)
@given(traces(max_steps=12))
def test_steps_merged_by_evidence_make_a_map(trace: Trace) -> None:
    theory = settle(
        trace, Theory.causal().replace(joint=1, weigh="count")
    ).theory  # merging knows only pairs
    log = Log(trace, theory)
    chart = Chart.of_steps(log, len(trace))
    fewest = solve(trace, theory).cost
    assert fewest
    found = facts.causal_map(merged(chart, chart.continuations.clique()), trace)
    assert check(trace, found, theory) == ()
    assert fewest.dstates <= len(found.dstates) <= len(trace)


def test_interrupted_search_returns_a_map_of_merged_steps() -> None:
    """If clingo is slow, the map is smaller than a greedy one."""
    walk = maze(5, 5, steps=1600, seed=0)
    with (
        patch.object(names, "PATIENCE", 1),
        patch.object(names.NameProgram, "more_links", side_effect=[[], KeyboardInterrupt]),
    ):
        speedups = Speedups.without("prefixes")
        solution = solve(walk.trace, Theory.causal(), speedups=speedups)
    assert solution.status is Status.FEASIBLE
    assert solution.cost
    assert (
        solution.cost.dstates
        < 2 * len(set(walk.truth))
        < len(set(Log(walk.trace, Theory.causal()).merged()))
    )
    assert check(walk.trace, solution.maps[0], Theory.causal()) == ()


@pytest.mark.parametrize("off", ["", "lazy"])
def test_maps_found_before_a_limit_are_returned(off: str) -> None:
    """Maps are held back until clingo's links are known to be enough, also the map that showed the
    minimum."""
    found = named.NamedLabels._answers_of

    def stopped(self: named.NamedLabels, spares: int) -> Iterator[dict[int, int]]:
        yield from islice(found(self, spares), 3)
        raise LimitError("time limit")

    walk = maze(3, 3, steps=200, seed=0)
    with patch.object(named.NamedLabels, "_answers_of", stopped):
        solution = solve(walk.trace, Theory.causal(), max_maps=100, speedups=Speedups.without(off))
    assert (solution.status, solution.stopped) == (Status.OPTIMAL, "time limit")
    assert solution.count == len(set(solution.maps)) >= 3
    for ssh_map in solution.maps:
        assert check(walk.trace, ssh_map, Theory.causal()) == ()


def test_program_of_names_is_not_loaded_if_time_is_short() -> None:
    """Clingo does not get the rules for names if the limit would end before it can be stopped.

    The clique is a bound by then.
    """
    walk = moore(8, 2, steps=100, seed=0)
    with (
        patch.object(names, "SECONDS_A_CHARACTER", 1.0),
        patch.object(names, "new_control", side_effect=AssertionError),
    ):
        solution = solve(
            walk.trace, Theory.causal(), time_limit=30, speedups=Speedups.without("prefixes")
        )
    assert (solution.status, solution.stopped) == (Status.FEASIBLE, "time limit")
    assert solution.certificate
    assert solution.bound.dstates == len(solution.certificate.clique) > 2
    assert check(walk.trace, solution.maps[0], Theory.causal()) == ()


@pytest.mark.slow
def test_clingo_gets_links_of_a_long_trace_in_parts() -> None:
    """The simplest links come first, and the search may end before clingo has all."""
    walk = maze(3, 3, steps=500, seed=1, loops=0.3)
    given: list[int] = []
    add = names.NameProgram.add

    def counted(self: names.NameProgram, links: list[tuple[int, int, int]]) -> None:
        add(self, links)
        given.append(len(self._links))

    expected = solve(walk.trace, Theory.causal())
    with (
        patch.object(names, "AT_ONCE", 500),
        patch.object(names, "PATIENCE", 10),
        patch.object(names, "MORE_LINKS", 50),
        patch.object(names.NameProgram, "add", counted),
    ):
        found = solve(walk.trace, Theory.causal())
    assert found.status is expected.status is Status.OPTIMAL
    assert found.cost == expected.cost
    assert check(walk.trace, found.maps[0], Theory.causal()) == ()
    assert given[0] < 100 <= max(given)
    assert all(after - before <= 500 for before, after in pairwise(given))


def test_core_encodings_have_the_axioms_that_speedups_were_made_for() -> None:
    """A further axiom needs a file of its own. Otherwise speed-ups would be taken to keep it."""
    known = (
        "functional_view deterministic one_place turn_stays travel_leaves travel_follows_path "
        "one_course turn_around_reverses turn_changes_path one_dstate_per_course on_path "
        "travel_orders order_asymmetric order_transitive path_order_total next_place all_on_paths "
        "course_needs_travel branch_side symmetric_sides side_of_branch sides_disjoint "
        "path_between_sides star_pattern star_frame one_heading turn_rotates "
        "one_dstate_per_heading path_goes_straight gateway_frame gateway_heading gateway_turn "
        "gateway_dstate gateway_path gateway_end"
    )
    assert encodings.names_in(*encodings.FIRST) == set(known.split())
