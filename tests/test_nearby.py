"""Maps near a guess. Each is a map with fewer dstates than the one before. For any guess, the last
one is minimal if the search says so."""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from unittest.mock import Mock, patch

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import maze, moore
from test_speedups import PLAIN, machines

from ssh_abduction import Theory, Trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.solver import Search, Status, choosing
from ssh_abduction.solver.asp.facts import answer_maps
from ssh_abduction.solver.asp.limits import Watch
from ssh_abduction.solver.engines import base as engine
from ssh_abduction.solver.engines import (
    name_program,
    name_search,
    named_labels,
    pinned,
    small_maps,
)
from ssh_abduction.solver.engines.causal import CausalEngine
from ssh_abduction.solver.engines.pinned import Pinned
from ssh_abduction.solver.guesses.annealing import annealed
from ssh_abduction.solver.steps.chart import Chart
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory import Speedups
from ssh_abduction.theory.settle import Problem

CAUSAL = Theory.causal()


@settings(max_examples=8)
@given(machines(), st.integers(0, 10_000), st.data())
def test_search_near_a_guess_changes_no_answer(
    trace: Trace, cores: int, data: st.DataObject
) -> None:
    """This holds for right and for wrong guesses."""
    expected = solve(trace, CAUSAL, max_maps=None, speedups=PLAIN)
    guess = data.draw(
        st.lists(st.integers(-1, 3), min_size=len(trace), max_size=len(trace)), label="guess"
    )
    most = data.draw(st.sampled_from([0, 1, 3]), label="most")
    turned = Mock(side_effect=lambda _, __, size: Mock(node_of=range(size)))
    with (
        patch.object(choosing, "FEW_STEPS", 0),
        patch.object(engine, "FIRST_PREFIXES", len(trace)),
        patch.multiple(name_search, PATIENCE=0, CORES=cores),
        patch.object(small_maps, "annealed", lambda *_, **__: Mock(labels=lambda _: guess)),
        patch.object(small_maps.Chart, "turned", turned),
    ):
        found = solve(trace, CAUSAL, max_maps=most or None)
    assert found.status is Status.OPTIMAL
    assert found.bound == expected.bound
    assert set(found.maps) <= set(expected.maps)
    assert (
        found.count
        == len(set(found.maps))
        == (min(most, expected.count) if most else expected.count)
    )
    assert found.complete == (not most or expected.count <= most)


def test_known_labels_end_a_search_only_if_they_reach_the_bound() -> None:
    known = name_search.Incumbent()
    known.raise_bound(2)
    assert not known.is_settled()
    known.labels = [0, 1, 2, 0]
    assert not known.is_settled()
    known.raise_bound(3)
    assert known.is_settled()


@pytest.mark.parametrize("seed", range(5))
def test_first_map_near_a_guess_equals_a_listed_map(seed: int) -> None:
    """There may be fewer names than dstates. An answer with a step at a rest is no map."""
    trace = moore(7, 2, steps=60, seed=seed).trace
    with (
        patch.object(name_search, "PATIENCE", 1),
        patch.object(small_maps, "GUESSES", 1),
    ):
        some, every = (
            solve(
                trace,
                CAUSAL,
                max_maps=most or None,
                time_limit=60,
                speedups=Speedups.without("clique,prefixes"),
            )
            for most in (5, 100)
        )
    assert some.count == min(5, every.count)
    assert set(some.maps) <= set(every.maps) or every.count == 100
    for ssh_map in (*some.maps, *every.maps):
        assert check(trace, ssh_map, CAUSAL) == ()
        assert len(ssh_map.dstates) == every.bound.dstates


def test_annealing_guesses_a_maze_from_views_and_turns() -> None:
    """Annealing finds a good guess from views and turns alone."""
    walk = maze(3, 3, steps=400, seed=1)
    log = Log(walk.trace, CAUSAL)
    chart = Chart.turned(walk.trace, log, len(log.seen))
    labels = annealed(chart).labels(chart)
    guess = [labels[node] for node in chart.node_of]
    same = sum(guess[t] >= 0 for t in range(len(guess)))
    assert same > 0.9 * len(guess)


def test_limit_leaves_the_small_map_found_near_a_guess() -> None:
    """The guess has no more dstates than the robot visited. A map by greedy merging has more than
    twice as many."""
    walk = maze(4, 4, steps=600, seed=1)
    more_links = name_program.NameProgram.more_links

    def stop(program: name_program.NameProgram) -> list[tuple[int, int, int]]:
        """The time is over when there is a small map."""
        if program.has_all_links:
            raise KeyboardInterrupt
        return more_links(program)

    limited = Search(walk.trace, CAUSAL, speedups=Speedups.without("prefixes"))
    truth = {state: number for number, state in enumerate(dict.fromkeys(walk.truth))}
    with (
        patch.object(
            small_maps,
            "annealed",
            lambda *_, **__: Mock(labels=lambda chart: _labels_of(chart, walk.truth, truth)),
        ),
        patch.object(name_program.NameProgram, "more_links", stop),
        patch.multiple(name_search, PATIENCE=1, CORES=1),
    ):
        solution = limited.solution(tuple(limited))
    assert solution.stopped == "interrupted"
    assert solution.cost
    merged = len(set(Log(walk.trace, CAUSAL).merged()))
    assert solution.cost.dstates <= len(truth) < merged / 2
    assert check(walk.trace, solution.maps[0], CAUSAL) == ()


def test_long_trace_is_guessed_before_clingo_has_all_links() -> None:
    walk = maze(4, 4, steps=600, seed=1)
    truth = {state: number for number, state in enumerate(dict.fromkeys(walk.truth))}
    chart = Chart.of_steps(Log(walk.trace, CAUSAL), len(walk.trace))
    guess = _labels_of(chart, walk.truth, truth)
    with (
        patch.object(pinned, "AT_ONCE", 500),
        patch.object(small_maps.SmallMaps, "from_beginning", lambda _: iter([guess])),
        patch.object(name_program.NameProgram, "more_links", side_effect=KeyboardInterrupt),
        patch.object(name_search, "PATIENCE", 1),
    ):
        limited = Search(walk.trace, CAUSAL, speedups=Speedups.without("prefixes"))
        solution = limited.solution(tuple(limited))
    assert solution.stopped == "interrupted"
    assert solution.cost
    assert solution.cost.dstates <= len(truth)


def _labels_of(chart: Chart, states: tuple[object, ...], number: dict[object, int]) -> list[int]:
    labels = [-1] * len(chart.seen)
    for node, state in zip(chart.node_of, states, strict=True):
        labels[node] = number[state]
    return labels


@pytest.mark.parametrize(
    ("views", "actions"),
    [
        ("abc", [{"name": "travel", "kind": "travel"}, {"name": "go"}]),  # neither turn nor travel
        ("ababc", ["right", "travel", "right", "right"]),  # to the right of b are a and c
        ("abc", ["right", "right"]),  # not seen what is to the right of c
        ("abcab", ["right", "right", "right", "right"]),  # turned by three quarters
    ],
)
def test_inconsistent_turns_give_no_chart(views: str, actions: list[object]) -> None:
    trace = Trace.from_steps(views, actions)
    assert Chart.turned(trace, Log(trace, CAUSAL), len(trace)) is None


def test_turned_chart_has_a_star_for_each_visit() -> None:
    trace = Trace.from_steps("abab", ["right", "travel", "left"])
    chart = Chart.turned(trace, Log(trace, CAUSAL), 4)
    assert chart.stars == ((0, 1, 0, 1), (0, 1, 0, 1))
    assert chart.node_of == (0, 1, 2, 3)


def test_turned_chart_combines_all_turns_of_a_visit() -> None:
    """No turn led right from the slot behind, nor left to it."""
    trace = Trace.from_steps("abadaca", ["right", "left", "left", "right", "travel", "around"])
    chart = Chart.turned(trace, Log(trace, CAUSAL), 7)
    a, b, d, c = range(4)  # by first step
    assert chart.stars == ((a, b, c, d), (c, d, a, b))


@cache
def fewest_dstates(trace: Trace) -> int:
    cost = solve(trace, CAUSAL).cost
    assert cost
    return cost.dstates


@cache
def pinned_in_a_maze() -> tuple[Trace, Pinned]:
    """A long trace in a maze of 6 cells, and the pinned clique of all of it."""
    trace = maze(2, 3, steps=500, seed=0).trace
    watch = Watch(100.0)
    watch.start()
    long = CausalEngine(engine.Task.of(Problem.of(trace, CAUSAL), watch))._named
    long.grow(len(trace))
    return trace, long.program.pinned


@pytest.mark.parametrize(
    ("first", "guessed", "goes_on"),
    [
        (460, 0, True),
        (20, 0, False),
        pytest.param(20, 501, True, marks=pytest.mark.slow),
    ],
)
def test_guess_for_a_prefix_is_extended_if_possible(
    first: int, guessed: int, goes_on: bool
) -> None:
    """The map of 460 steps in a maze of 6 cells fits all later steps. The map of 20 or 40 steps
    does not help. Then the whole trace is guessed if it is not too long."""
    trace, pinned_nodes = pinned_in_a_maze()
    watch = Watch(100.0)
    watch.start()
    small = small_maps.SmallMaps(engine.Task.of(Problem.of(trace, CAUSAL), watch), pinned_nodes)
    with patch.multiple(small_maps, AT_ONCE=first, GUESSED=guessed):
        found = list(small.from_beginning())
    assert bool(found) == goes_on
    fewest = fewest_dstates(trace)
    for labels in found:
        assert check(trace, answer_maps.causal_map(labels, trace), CAUSAL) == ()
    assert min(len(set(labels)) for labels in found or [range(fewest)]) == fewest


@pytest.mark.slow
def test_clingo_gets_links_of_a_long_trace_in_parts() -> None:
    """The simplest links come first, and the search may end before clingo has all. The map is a
    guess, or from clingo."""
    walk = maze(3, 3, steps=500, seed=1, loops=0.3)
    given: list[int] = []
    add = name_program.NameProgram.add

    def counted(self: name_program.NameProgram, links: list[tuple[int, int, int]]) -> None:
        add(self, links)
        given.append(len(self._known.links))

    expected = solve(walk.trace, CAUSAL)
    with (
        patch.object(named_labels, "AT_ONCE", 500),
        patch.object(pinned, "AT_ONCE", 500),
        patch.object(small_maps, "AT_ONCE", 500),
        patch.object(name_search, "PATIENCE", 10),
        patch.object(name_program, "MORE_LINKS", 50),
        patch.object(name_program.NameProgram, "add", counted),
    ):
        found = solve(walk.trace, CAUSAL)
    assert found.status is expected.status is Status.OPTIMAL
    assert found.cost == expected.cost
    assert check(walk.trace, found.maps[0], CAUSAL) == ()
    assert given[0] < 100 <= max(given)
    assert all(after - before <= 500 for before, after in pairwise(given))


def test_next_prefix_grows_until_the_clique_grows() -> None:
    trace = maze(3, 3, steps=3000, seed=0).trace
    log = Log(trace, CAUSAL)
    long = CausalEngine(engine.Task.of(Problem.of(trace, CAUSAL), Watch(100.0)))
    long._named.size = 32
    with patch.object(engine, "AT_ONCE", 50), patch.object(named_labels, "AT_ONCE", 50):
        size = long.next_size(32)
        assert long.next_size(10) == size
        long._named.size = size
        assert long.next_size(size) == min(2 * size, 3001)
    sizes = [
        len(Chart.of_steps(log, steps).continuations.clique()) for steps in (size // 2, size, 3001)
    ]
    assert sizes[0] < sizes[1] == sizes[2]
    assert size < 3001
