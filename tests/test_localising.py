"""Visits localised in a map of some of them (steps/chart.py)."""

from __future__ import annotations

import random
from collections.abc import Sequence
from unittest.mock import patch

import pytest

from benchmarks.instances import Walk, maze
from ssh_abduction import Theory, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.data.groups import numbered
from ssh_abduction.solver import Search
from ssh_abduction.solver.sources.exact import visit_labels as same
from ssh_abduction.solver.sources.exact.labels_first import LabelsFirst
from ssh_abduction.solver.steps.chart import Chart, FramedChart, State, faced, located
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


def labels(chart: FramedChart, found: Sequence[State]) -> list[int]:
    return [faced(found[visit], slot) for visit, slot in chart.facing]


@pytest.mark.parametrize("seed", range(8))
def test_map_of_some_visits_locates_all_visits(seed: int) -> None:
    """The map asks for more visits until all states are known. It does not need all visits."""
    walk = maze(3, 3, steps=1000, seed=seed, stars=True)
    chart = charted(walk)
    states = true_states(walk, chart)
    chance = random.Random(seed)
    told = {0, *chance.sample(range(len(states)), 5)}
    while missed := located(chart, {visit: states[visit] for visit in told})[1]:
        assert set(missed) - told
        assert max(missed) < len(states)
        told.update(missed)
    assert list(located(chart, {visit: states[visit] for visit in told})[0]) == states
    assert len(told) < 0.8 * len(states)


@pytest.mark.parametrize("seed", range(2))
def test_map_of_a_prefix_locates_all_visits_or_names_missing_ones(seed: int) -> None:
    """If the map implies all states, they make a map. Otherwise it names missing visits."""
    walk = maze(3, 3, steps=200, seed=seed, stars=True)
    chart = charted(walk)
    for steps in (40, 100):
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
        found, missed = located(chart, at)
        if missed:
            assert set(missed) - set(at)
        else:
            assert chart.is_map(labels(chart, found))
            assert {visit: found[visit] for visit in at} == at


@pytest.mark.slow
def test_long_trace_is_solved_from_some_of_its_visits() -> None:
    """It has the same minimal maps as when clingo is given all visits."""
    trace = maze(3, 3, steps=500, seed=1, stars=True).trace
    search = Search(trace, max_maps=None)
    with patch.object(same, "FIRST_PAIRS", 500):
        maps = tuple(search)
    engine = search.parts.prefixes.engine
    assert isinstance(engine, LabelsFirst)
    assert len(engine._labels.program.visits) < 0.8 * len(engine._labels.chart.stars)
    expected = solve(trace, max_maps=None, speedups=Speedups.without("lazy"))
    assert search.complete
    assert set(maps) == set(expected.maps)
    assert search.bound == expected.bound
    assert check(trace, maps[0], search.theory) == ()
