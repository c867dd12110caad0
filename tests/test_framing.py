"""Theories that ask for no frames: maps in which places have frames all the same, so that a small map is known where clingo takes its time."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from unittest.mock import patch

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import maze
from strategies import theories, traces

from ssh_abduction import OnlineMapper, SSHMap, Theory, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.solver import Search, Status, candidates, choosing, prefixes
from ssh_abduction.solver.asp.limits import LimitError, StageTimeError, Watch
from ssh_abduction.solver.engines import framing
from ssh_abduction.solver.engines.framing import maps_with_frames
from ssh_abduction.solver.guesses.tree import Sketch
from ssh_abduction.solver.prefixes import Prefixes
from ssh_abduction.theory import Speedups
from ssh_abduction.theory.settle import Problem, settle
from ssh_abduction.theory.speedups import SPEEDUPS, row

THEORIES = {
    "dstates": Theory.topological(),
    "paths": Theory.circumscriptive(),
    "no sides": Theory(boundary="none"),
    "excuses": Theory(boundary="defeasible"),
    "partial order": Theory(path_order="partial"),
}


def started(limit: float | None = None) -> Watch:
    watch = Watch(limit)
    watch.start()
    return watch


@settings(max_examples=12)
@given(st.data())
def test_maps_with_frames_are_maps_of_the_theory(data: st.DataObject) -> None:
    trace = data.draw(traces(max_steps=10), label="trace")
    theory = settle(trace, data.draw(theories(trace), label="theory")).theory
    if not row("framing").holds_for(theory):
        return
    costs = []
    for ssh_map in maps_with_frames(Problem.of(trace, theory), started(), Speedups()):
        assert check(trace, ssh_map, theory) == ()
        costs.append(len(ssh_map.dstates))
    assert costs == sorted(costs, reverse=True)
    if not costs or theory.prefer[:1] != ("dstates",):
        return
    assert costs[-1] >= len(solve(trace, theory, max_maps=1).maps[0].dstates)


@settings(max_examples=8)
@given(st.data())
def test_a_map_with_frames_changes_no_answer(data: st.DataObject) -> None:
    """Sought before anything else, so that it is known whenever a prefix has as cheap a map."""
    trace = data.draw(traces(), label="trace")
    theory = data.draw(theories(trace), label="theory")
    first = data.draw(st.sampled_from([1, 3, prefixes.FIRST_PREFIX]), label="first prefix")
    expected = solve(trace, theory, max_maps=None, speedups=Speedups.without(SPEEDUPS))
    with (
        patch.multiple(choosing, FRAME_AFTER=-1.0, FEW_STEPS=0),
        patch.object(prefixes, "FIRST_PREFIX", first),
    ):
        found = solve(trace, theory, max_maps=None, speedups=Speedups.without("names"))
    assert found.status is expected.status
    assert found.complete
    assert set(found.maps) == set(expected.maps)
    assert found.count == len(set(found.maps))
    if found.cost and expected.cost:
        priorities = found.theory.priorities
        assert [getattr(found.cost, name) for name in priorities] == [
            getattr(expected.cost, name) for name in priorities
        ]


@pytest.mark.parametrize("theory", THEORIES.values(), ids=THEORIES)
def test_a_maze_without_stars_has_a_small_map_before_the_proof(theory: Theory) -> None:
    """In the second part of its search it is interrupted at once; the robot was in 32 dstates."""
    walk = maze(3, 3, steps=400, seed=0)
    stages = 2 if row("ways").holds_for(settle(walk.trace, theory).theory) else 1
    with patch.object(
        Prefixes, "find_minimum", side_effect=[*[StageTimeError] * stages, KeyboardInterrupt]
    ):
        solution = solve(walk.trace, theory)
    assert (solution.status, solution.stopped, solution.count) == (
        Status.FEASIBLE,
        "interrupted",
        1,
    )
    assert solution.cost
    assert solution.cost.dstates <= len(set(walk.truth)) == 32
    assert check(walk.trace, solution.maps[0], solution.theory) == ()


def test_a_maze_of_loops_has_a_map_smaller_than_a_sketch() -> None:
    trace = maze(3, 3, steps=400, seed=1, loops=0.5).trace
    sketched = solve(trace, time_limit=1e-9)
    with patch.object(
        Prefixes, "find_minimum", side_effect=[StageTimeError, StageTimeError, KeyboardInterrupt]
    ):
        found = solve(trace)
    assert found.cost
    assert sketched.cost
    assert found.cost.dstates <= 36 < sketched.cost.dstates


def test_listing_is_not_paused() -> None:
    """Where the cost is found before it is time for frames."""
    trace = maze(2, 2, steps=30, seed=0).trace
    listed = Prefixes.minimal_maps

    def slowly(self: Prefixes) -> Iterator[SSHMap]:
        self._task.watch._spent += 2 * choosing.FRAME_AFTER
        yield from listed(self)

    with patch.object(Prefixes, "minimal_maps", slowly):
        solution = solve(trace, max_maps=None)
    assert solution.complete
    assert set(solution.maps) == set(
        solve(trace, max_maps=None, speedups=Speedups.without("framing")).maps
    )


@pytest.mark.parametrize(
    "theory",
    [Theory.topological(), Theory(next_place=True), Theory(all_on_paths=True)],
    ids=["", "next", "on paths"],
)
def test_a_sketch_with_frames_is_smaller(theory: Theory) -> None:
    trace = maze(3, 3, steps=400, seed=0).trace
    first, *rest = trace.steps
    sizes = []
    for sketch in Sketch.all_of(first, settle(trace, theory).theory):
        assert all(
            sketch.extend(action, step) for action, step in zip(trace.actions, rest, strict=True)
        )
        assert check(trace, sketch.map(), settle(trace, theory).theory) == ()
        sizes.append(len(sketch.map().dstates))
    framed, homing = sizes[0], sizes[2]
    assert framed < homing / 2


def test_while_a_robot_drives_the_time_is_clingos() -> None:
    """The sketch is small enough. The robot was in 27 dstates."""
    trace = maze(3, 3, steps=120, seed=0).trace
    mapper = OnlineMapper(trace.steps[0].view or "", time_limit=0.01)
    with (
        patch.object(framing, "maps_with_frames", side_effect=AssertionError),
        patch.object(choosing, "FRAME_AFTER", -1.0),
    ):
        for action, step in zip(trace.actions, trace.steps[1:], strict=True):
            answer = mapper.observe(action, step.view or "")
    assert answer.cost
    assert answer.cost.dstates <= 1.2 * 27
    assert check(trace, answer.maps[0], answer.theory) == ()


@pytest.mark.parametrize(
    "stop",
    [KeyboardInterrupt(), LimitError("time limit"), LimitError("interrupted")],
    ids=["ctrl-c", "limit", "interrupt"],
)
def test_what_ends_it_leaves_its_last_map_and_no_thread(stop: BaseException) -> None:
    """Its own limit ends it alone; Ctrl-C the whole search."""
    walk = maze(3, 3, steps=120, seed=0)
    before = set(threading.enumerate())
    search = Search(walk.trace, time_limit=60)
    found = framing.maps_with_frames

    def stopped(problem: Problem, watch: Watch, speedups: Speedups) -> Iterator[SSHMap]:
        yield next(found(problem, watch, speedups))
        if str(stop) == "interrupted":
            search.interrupt()
        raise stop

    with (
        patch.object(framing, "maps_with_frames", stopped),
        patch.object(
            Prefixes,
            "find_minimum",
            side_effect=[StageTimeError, StageTimeError, LimitError("memory limit")],
        ),
    ):
        maps = tuple(search)
    assert search.stopped == ("memory limit" if str(stop) == "time limit" else "interrupted")
    assert [len(ssh_map.dstates) for ssh_map in maps] == [27]
    assert set(threading.enumerate()) <= before


def test_a_pause_comes_once() -> None:
    watch = started(60)
    watch.end_stage_after(-1)
    with pytest.raises(StageTimeError):
        watch.check()
    watch.check()


def test_until_there_is_a_map_it_may_take_twice_as_long() -> None:
    walk = maze(3, 3, steps=120, seed=0)
    found = framing.maps_with_frames
    left: list[float] = []

    def timed(problem: Problem, watch: Watch, speedups: Speedups) -> Iterator[SSHMap]:
        left.append(watch.left())
        yield next(found(problem, watch, speedups))
        left.append(watch.left())
        raise KeyboardInterrupt

    with (
        patch.object(framing, "maps_with_frames", timed),
        patch.object(Prefixes, "find_minimum", side_effect=StageTimeError),
    ):
        solve(walk.trace, time_limit=1000)
    assert left[1] <= candidates.FRAMING < left[0] <= 2 * candidates.FRAMING


def test_a_limit_gets_only_shorter() -> None:
    watch = started(60)
    watch.shorten(70)
    watch.check()
    watch.shorten(-1)
    with pytest.raises(LimitError):
        watch.check()
    unlimited = started()
    unlimited.shorten(50)
    assert unlimited.left() <= 50
