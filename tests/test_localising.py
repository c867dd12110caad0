"""Visits localised in a map of some of them (steps/localising.py)."""

from __future__ import annotations

import random
from collections.abc import Callable
from itertools import pairwise
from unittest.mock import patch

import pytest

from benchmarks.instances import Walk, maze
from ssh_abduction import Theory, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.solver import Search
from ssh_abduction.solver.asp.limits import Watch
from ssh_abduction.solver.engines import paths as paths_module
from ssh_abduction.solver.engines import visit_labels as same
from ssh_abduction.solver.engines.framed import FramedEngine
from ssh_abduction.solver.engines.paths import Paths
from ssh_abduction.solver.guesses import annealing
from ssh_abduction.solver.steps.chart import Chart, FramedChart, numbered
from ssh_abduction.solver.steps.localising import Located, State, faced, located, states_of, tracked
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.speedups import Speedups

FRAMED = Theory(star="frame")


def charted(walk: Walk) -> FramedChart:
    return Chart.framed(walk.trace, Log(walk.trace, FRAMED))


def true_states(walk: Walk, chart: FramedChart) -> list[State]:
    """The cell of each visit, and the heading in which the robot arrived."""
    at: dict[int, tuple[int, int, int]] = {}
    for node, (x, y, heading) in zip(chart.node_of, walk.truth, strict=True):  # type: ignore[misc]
        visit, slot = chart.facing[node]
        at.setdefault(visit, (x, y, (heading - slot) % 4))
    cells = numbered((x, y) for x, y, _ in at.values())
    return [4 * cell + heading for cell, (_, _, heading) in zip(cells, at.values(), strict=True)]


def labels(chart: FramedChart, found: Located) -> list[int]:
    return [faced(found.states[visit], slot) for visit, slot in chart.facing]


@pytest.mark.parametrize("seed", range(8))
def test_a_true_map_of_some_visits_tells_the_states_of_all(seed: int) -> None:
    """The map asks for more visits until it tells all states. It does not need all visits."""
    walk = maze(3, 3, steps=1000, seed=seed, stars=True)
    chart = charted(walk)
    states = true_states(walk, chart)
    chance = random.Random(seed)
    told = {0, *chance.sample(range(len(states)), 5)}
    while missed := located(chart, {visit: states[visit] for visit in told}).missed:
        assert set(missed) - told
        assert max(missed) < len(states)
        told.update(missed)
    assert list(located(chart, {visit: states[visit] for visit in told}).states) == states
    assert len(told) < 0.8 * len(states)


@pytest.mark.parametrize("seed", range(2))
def test_a_map_of_a_beginning_explains_all_visits_or_misses_some(seed: int) -> None:
    """If the map tells all states, they make a map; else it misses visits that it does not have."""
    walk = maze(3, 3, steps=400, seed=seed, stars=True)
    chart = charted(walk)
    for steps in (40, 100, 200):
        beginning = Chart.framed(walk.trace, Log(walk.trace, FRAMED), steps)
        ssh_map = solve(walk.trace.prefix(steps), max_maps=1).maps[0]
        at = {}
        for node, label in zip(beginning.node_of, ssh_map.labels, strict=True):
            visit, slot = beginning.facing[node]
            dstate = ssh_map.dstates[label]
            assert dstate.place is not None
            assert dstate.heading is not None
            at.setdefault(visit, 4 * dstate.place + (dstate.heading - slot) % 4)
        if any(
            chart.misfits[(at[i] - at[j]) % 4, i, j]
            for i in at
            for j in at
            if at[i] // 4 == at[j] // 4
        ):
            continue  # later steps show that the map is wrong
        found = located(chart, at)
        if found.missed:
            assert set(found.missed) - set(at)
        else:
            assert chart.is_map(labels(chart, found))
            assert {visit: found.states[visit] for visit in at} == at


def test_a_long_trace_is_solved_from_few_of_its_visits() -> None:
    """It has the same minimal maps as when clingo is given all visits."""
    trace = maze(3, 3, steps=800, seed=1, stars=True).trace
    search = Search(trace, max_maps=None)
    with patch.object(same, "FIRST_PAIRS", 500):
        maps = tuple(search)
    engine = search._parts.prefixes.engine
    assert isinstance(engine, FramedEngine)
    assert len(engine._visits.program.visits) < 0.8 * len(engine._visits.chart.stars)
    expected = solve(trace, max_maps=None, speedups=Speedups.without("lazy"))
    assert search.complete
    assert set(maps) == set(expected.maps)
    assert search.bound == expected.bound
    assert check(trace, maps[0], search.theory) == ()


@pytest.mark.parametrize(("seed", "steps", "guesses"), [(1, 700, 1), (3, 500, 2)])
def test_the_beginning_of_a_long_trace_is_guessed(seed: int, steps: int, guesses: int) -> None:
    """The number of guessed visits doubles until the rest follows. The result has paths."""
    walk = maze(3, 3, steps=steps, seed=seed, stars=True)
    chart = charted(walk)
    guessed: list[int] = []
    begun = Paths._guessed

    def counted(self: Paths, part: FramedChart, check: Callable[[], None]) -> list[int]:
        guessed.append(len(part.stars))
        return begun(self, part, check)

    asked = Paths(walk.trace, FRAMED)
    fewer_sweeps = patch.object(annealing, "ANNEALED", ((0.5, 700),))
    with (
        fewer_sweeps,
        patch.object(paths_module, "FIRST_PAIRS", 300),
        patch.object(Paths, "_guessed", counted),
    ):
        found = asked.guessed_labels(chart, Watch())
    assert guessed[0] < len(chart.stars) / 2
    assert len(guessed) == guesses
    assert all(later in {2 * earlier, len(chart.stars)} for earlier, later in pairwise(guessed))
    assert chart.is_map(found)
    assert asked.has_separate(chart, found)
    assert len(set(found)) <= 1.05 * len(set(walk.truth))


def test_a_beginning_is_the_chart_of_a_prefix() -> None:
    walk = maze(3, 3, steps=200, seed=1, stars=True)
    chart = charted(walk)
    steps = next(t for t, node in enumerate(chart.node_of) if chart.facing[node][0] == 20)
    part, expected = chart.beginning(20), Chart.framed(walk.trace, Log(walk.trace, FRAMED), steps)
    assert part == expected
    assert chart.beginning(len(chart.stars)) == chart


def test_tracked_states_are_true() -> None:
    """The map is a true one of the first visits. States at other places are unknown."""
    walk = maze(5, 5, steps=1000, seed=1, stars=True)
    chart = charted(walk)
    states = true_states(walk, chart)
    assert max(states) > max(states[:60])
    found = tracked(chart, dict(enumerate(states[:60])))
    assert found[:60] == states[:60]
    elsewhere = [
        i
        for i, state in enumerate(states)
        if state // 4 not in {known // 4 for known in states[:60]}
    ]
    assert sum(a == b for a, b in zip(found, states, strict=True)) > 0.8 * (
        len(states) - len(elsewhere)
    )
    assert any(found[i] == -1 for i in elsewhere)


def test_places_of_labels_are_numbered_without_gaps() -> None:
    """A state without visits would fit any visit."""
    walk = maze(3, 3, steps=300, seed=1, stars=True)
    chart = charted(walk)
    truth = dict(zip(chart.node_of, walk.truth, strict=True))
    states = states_of(chart, numbered(truth[node] for node in range(len(chart.seen))))
    assert {state // 4 for state in states} == set(range(max(states) // 4 + 1))
    turned: dict[int, int] = {}  # the rotation of the frame of each place
    for state, true in zip(states, true_states(walk, chart), strict=True):
        assert turned.setdefault(state // 4, (true - state) % 4) == (true - state) % 4
