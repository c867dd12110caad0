"""Maps without a search of traces with faults, and clashes found where a sketch is contradicted."""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import replace
from unittest.mock import patch

import pytest
from fault_cases import left_out
from instances import maze

from ssh_abduction import Theory, Trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.data import Odometry
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Action
from ssh_abduction.explain.no_map import explain
from ssh_abduction.solution import Status
from ssh_abduction.solver import Search
from ssh_abduction.solver.mending import Mending
from ssh_abduction.solver.search import clash_in, late_clash
from ssh_abduction.solver.sources.symbolic.sketch import mended_sketch
from ssh_abduction.theory.settle import settle

NOISE = Odometry(along=0.05, across=0.02, heading=0.01)


def flawed(kind: str, seed: int) -> tuple[Trace, Theory]:
    """A drive through a maze with three faults of a kind, and a theory that allows them."""
    odometry = NOISE if kind == "jumped" else None
    trace = maze(4, 4, steps=40, seed=seed, stars=True, follow=True, odometry=odometry).trace
    steps, chance = list(trace.steps), random.Random(seed)
    for t in chance.sample(range(1, len(steps) - 1), 3):
        if kind == "misread":
            other = steps[chance.randrange(len(steps))]
            steps[t] = replace(steps[t], view=other.view, star=other.star)
        elif kind == "slipped":
            steps[t] = replace(steps[t], action=Action.of(chance.choice(["travel", "around"])))
        else:
            x, y, turned = steps[t].displacement or (0.0, 0.0, 0.0)
            steps[t] = replace(steps[t], displacement=(x + 9.0, y - 9.0, turned))
    return replace(trace, steps=tuple(steps)), Theory(**{kind: 1.5})


@pytest.mark.parametrize("kind", ["misread", "slipped", "jumped"])
def test_mended_sketch_is_a_map_with_faults(kind: str) -> None:
    needed = 0
    for seed in range(1):
        trace, theory = flawed(kind, seed)
        guess = mended_sketch(trace, settle(trace, theory).theory)
        assert guess is not None
        ssh_map = guess.map
        assert check(trace, ssh_map, theory) == ()
        needed += len(ssh_map.faults)
        short = solve(trace, theory, time_limit=0.001, max_maps=1)
        assert short.maps
    assert needed


def test_mended_sketch_uses_only_allowed_faults() -> None:
    trace, theory = flawed("misread", 0)
    assert mended_sketch(trace, settle(trace, theory.replace(misread=0)).theory) is None


def test_slip_that_only_places_show_is_mended() -> None:
    """A step is missing, and the causal theory explains the trace without a fault."""
    walk = maze(2, 2, steps=70, seed=25, stars=True)
    trace = left_out(walk, random.Random(25))[0].trace
    theory = Theory(slipped=1.5)
    with patch.object(Mending, "_by_sketch", return_value=iter(())):
        before = solve(trace, theory, max_maps=1)
    found = solve(trace, theory, max_maps=1)
    assert before.cost
    assert found.cost
    assert found.cost.dstates <= len(set(walk.truth)) < before.cost.dstates
    assert check(trace, found.maps[0], theory) == ()


def test_steps_that_contradict_a_sketch_are_checked_for_a_clash() -> None:
    """Out along a corridor, and around twice: the robot faces on, but sees something else."""
    views = [*range(12), "around", "wrong", "later"]
    trace = Trace.from_steps(views, [*["travel"] * 11, "around", "around", "travel"])
    search = Search(trace)
    search.parts.candidates.sketch()
    assert next(iter(search.parts.candidates.contradicting)) == 13

    def maps_of(trace: Trace, theory: Theory) -> tuple[tuple[SSHMap, ...], bool]:
        solution = solve(trace, theory, max_maps=1)
        return solution.maps, solution.status in (Status.OPTIMAL, Status.UNSATISFIABLE)

    assert late_clash(search.parts, maps_of) is None  # the search was not stopped
    search.parts.known.stopped = "time limit"
    clash = late_clash(search.parts, maps_of)
    assert clash == range(10, 14)
    assert search.status is Status.UNSATISFIABLE
    found = explain(trace, near=clash)
    assert found is not None
    assert (found.first, found.last) == (10, 13)
    faulty = Theory(misread=1.0)
    assert clash_in(trace, settle(trace, faulty).theory, [clash], maps_of) is None


def test_contradicting_assertion_is_unsatisfiable_at_once() -> None:
    around = Trace.from_steps("abcd" * 24, ["right", "travel"] * 47 + ["right"])
    solution = solve(around, Theory(same_place=((0, 4),)), time_limit=0.5)
    assert (solution.status, len(solution.maps)) == (Status.UNSATISFIABLE, 0)


def test_unproven_maps_of_a_mended_trace_are_not_minimal() -> None:
    """When minimal maps of a mended trace are listed, the time may be over before they are found
    again."""
    trace = maze(2, 2, steps=30, seed=2).trace
    steps = list(trace.steps)
    steps[12] = replace(steps[12], action=Action.of("around"))
    search = Search(replace(trace, steps=tuple(steps)), Theory(slipped=1.5))

    def too_late(
        mended: Trace, theory: Theory, most: int, seconds: float
    ) -> tuple[tuple[SSHMap, ...], bool]:
        maps, _ = search._solve_part(mended, theory, 1, seconds)
        return (maps, True) if most == 1 else ((), False)

    for solver, is_listed in ((search._solve_part, True), (too_late, False)):
        mending = Mending(search.parts.task, solver)
        (*_, best) = mending.maps()
        assert mending.minimal_maps(0) == ((best.map,), is_listed)


@pytest.mark.parametrize("status", [Status.OPTIMAL, Status.UNSATISFIABLE])
def test_piece_that_ran_out_of_time_is_no_clash(status: Status) -> None:
    """The least cost may be proven before a map is found. Then the piece has a map."""

    def ended(search: Search) -> Iterator[SSHMap]:
        search.parts.known.status = status
        return iter(())

    trace = Trace.from_steps("abc", ["travel", "travel"])
    with patch.object(Search, "unranked", ended):
        found = Search(trace)._solve_part(trace, settle(trace, Theory()).theory, 1, 1.0)
    assert found == ((), status is Status.UNSATISFIABLE)
