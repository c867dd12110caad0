"""Where visits are in a map of some of them."""

from __future__ import annotations

import random
from unittest.mock import patch

import pytest

from benchmarks.instances import Walk, maze
from ssh_abduction import Search, Theory, same, solve
from ssh_abduction.chart import Chart, FramedChart, numbered
from ssh_abduction.checker import check
from ssh_abduction.framed import FramedEngine
from ssh_abduction.localising import Located, State, faced, located
from ssh_abduction.replay import Log
from ssh_abduction.speedups import Speedups

FRAMED = Theory(star="frame")


def charted(walk: Walk) -> FramedChart:
    return Chart.framed(walk.trace, Log(walk.trace, FRAMED))


def true_states(walk: Walk, chart: FramedChart) -> list[State]:
    """Of each visit the cell, and how the robot faced as it arrived."""
    at: dict[int, tuple[int, int, int]] = {}
    for node, (x, y, heading) in zip(chart.node_of, walk.truth, strict=True):  # type: ignore[misc]
        visit, slot = chart.facing[node]
        at.setdefault(visit, (x, y, (heading - slot) % 4))
    cells = numbered((x, y) for x, y, _ in at.values())
    return [4 * cell + heading for cell, (_, _, heading) in zip(cells, at.values(), strict=True)]


def labels(chart: FramedChart, found: Located) -> list[int]:
    return [faced(found.states[visit], slot) for visit, slot in chart.facing]


@pytest.mark.parametrize("seed", range(8))
def test_what_a_true_map_of_some_visits_says_of_the_others_is_true(seed: int) -> None:
    """As long as it says nothing, it has to know more of them; and few are enough."""
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


@pytest.mark.parametrize("seed", range(8))
def test_a_map_of_a_beginning_explains_all_visits_or_misses_some(seed: int) -> None:
    """What it takes for the states of all visits is a map; and what it misses, with what led there, no state of it explains."""
    walk = maze(3, 3, steps=400, seed=seed, stars=True)
    chart = charted(walk)
    for steps in (40, 100, 200):
        beginning = Chart.framed(walk.trace, Log(walk.trace, FRAMED), steps)
        ssh_map = solve(walk.trace.prefix(steps), maps=1).maps[0]
        at = {}
        for node, label in zip(beginning.node_of, ssh_map.labels, strict=True):
            visit, slot = beginning.facing[node]
            dstate = ssh_map.dstates[label]
            assert dstate.place is not None
            assert dstate.heading is not None
            at.setdefault(visit, 4 * dstate.place + (dstate.heading - slot) % 4)
        if any(chart.misfits[(at[i] - at[j]) % 4, i, j] for i in at for j in at if at[i] // 4 == at[j] // 4):
            continue  # what came later tells them apart
        found = located(chart, at)
        if found.missed:
            assert set(found.missed) - set(at)
        else:
            assert chart.is_map(labels(chart, found))
            assert {visit: found.states[visit] for visit in at} == at


@pytest.mark.parametrize("seed", range(3))
def test_a_long_trace_is_solved_from_few_of_its_visits(seed: int) -> None:
    """All its minimal maps, as when clingo is told of all visits."""
    trace = maze(3, 3, steps=800, seed=seed, stars=True).trace
    search = Search(trace, maps=0)
    with patch.object(same, "FIRST_PAIRS", 500):
        maps = tuple(search)
    engine = search._engine
    assert isinstance(engine, FramedEngine)
    assert len(engine._visits) < 0.8 * len(engine._chart.stars)
    expected = solve(trace, maps=0, speedups=Speedups.without("lazy"))
    assert search.complete
    assert set(maps) == set(expected.maps)
    assert search.bound == expected.bound
    assert check(trace, maps[0], search.theory) == ()
