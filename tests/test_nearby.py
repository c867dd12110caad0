"""Maps near a guess. Each is a map with fewer dstates than the one before. For any guess, the last
one is minimal if the search says so."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from unittest.mock import patch

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import maze, moore
from test_speedups import PLAIN, machines

from ssh_abduction import Theory, Trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.data.action import Action
from ssh_abduction.solver import Search, Status
from ssh_abduction.solver.asp.limits import Watch
from ssh_abduction.solver.sources.exact import choosing, engine, labels_first, name_program, names
from ssh_abduction.solver.sources.exact.labels_first import LabelsFirst
from ssh_abduction.solver.steps.chart import Chart
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory import Speedups
from ssh_abduction.theory.settle import Problem

CAUSAL = Theory.causal()


def without_kinds(trace: Trace) -> Trace:
    """The same views and closures, with actions that are neither travels nor turns."""
    steps = [
        replace(step, action=step.action and Action(f"do {step.action.name}"))
        for step in trace.steps
    ]
    return replace(trace, steps=tuple(steps))


@settings(max_examples=8)
@given(machines(), st.integers(0, 10_000), st.data())
def test_search_near_a_guess_changes_no_answer(
    trace: Trace, cores: int, data: st.DataObject
) -> None:
    """This holds for right and for wrong guesses. Only steps of bare actions are guessed."""
    trace = without_kinds(trace)
    expected = solve(trace, CAUSAL, max_maps=None, speedups=PLAIN)
    guess = data.draw(
        st.lists(st.integers(-1, 3), min_size=len(trace), max_size=len(trace)), label="guess"
    )
    most = data.draw(st.sampled_from([0, 1, 3]), label="most")
    with (
        patch.object(choosing, "FEW_STEPS", 0),
        patch.object(labels_first, "FIRST_PREFIXES", len(trace)),
        patch.multiple(names, PATIENCE=0, CORES=cores),
        patch.object(names, "machine_labels", lambda *_: iter([guess])),
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
    known = names.Incumbent()
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
        patch.object(names, "PATIENCE", 1),
        patch.object(names, "GUESSES", 1),
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


def test_limit_leaves_the_small_map_found_near_a_guess() -> None:
    """The guess has no more dstates than the robot visited. A map by greedy merging has more than
    twice as many."""
    walk = maze(4, 4, steps=600, seed=1)
    trace = without_kinds(walk.trace)
    more_links = name_program.NameProgram.more_links

    def stop(program: name_program.NameProgram) -> list[tuple[int, int, int]]:
        """The time is over when there is a small map."""
        if program.has_all_links:
            raise KeyboardInterrupt
        return more_links(program)

    limited = Search(trace, CAUSAL, speedups=Speedups.without("prefixes"))
    truth = {state: number for number, state in enumerate(dict.fromkeys(walk.truth))}
    guess = [truth[state] for state in walk.truth]
    with (
        patch.object(names, "machine_labels", lambda *_: iter([guess])),
        patch.object(name_program.NameProgram, "more_links", stop),
        patch.multiple(names, PATIENCE=1, CORES=1),
    ):
        solution = limited.solution(tuple(limited))
    assert solution.stopped == "interrupted"
    assert solution.cost
    merged = len(set(Log(trace, CAUSAL).merged()))
    assert solution.cost.dstates <= len(truth) < merged / 2
    assert check(trace, solution.maps[0], CAUSAL) == ()


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
        patch.object(names, "AT_ONCE", 500),
        patch.object(name_program, "AT_ONCE", 500),
        patch.object(names, "PATIENCE", 10),
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
    long = LabelsFirst(engine.Task.of(Problem.of(trace, CAUSAL), Watch(100.0)))
    long._labels.size = 32
    with patch.object(labels_first, "AT_ONCE", 50), patch.object(names, "AT_ONCE", 50):
        size = long.next_size(32)
        assert long.next_size(10) == size
        long._labels.size = size
        assert long.next_size(size) == min(2 * size, 3001)
    sizes = [
        len(Chart.of_steps(log, steps).continuations.clique()) for steps in (size // 2, size, 3001)
    ]
    assert sizes[0] < sizes[1] == sizes[2]
    assert size < 3001
