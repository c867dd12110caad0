"""Tests of the stages of a search: when it changes the engine, and what limits do meanwhile."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from unittest.mock import patch

import pytest
from clingo import Symbol
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import maze
from strategies import theories, traces
from turns import STEPWISE, stepwise

from ssh_abduction import OnlineMapper, SSHMap, Theory, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.runtime.limits import LimitError, StageTimeError, Watch
from ssh_abduction.solver import search
from ssh_abduction.solver.sources.exact import choosing, prefixes
from ssh_abduction.solver.sources.exact.engine import Task
from ssh_abduction.solver.sources.exact.prefixes import Prefixes
from ssh_abduction.solver.sources.symbolic.sketch import sketches_of
from ssh_abduction.theory import Speedups
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.speedups import ALL, SPEEDUPS

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


@pytest.mark.slow
@settings(max_examples=8)
@given(st.data())
def test_change_of_engine_changes_no_answer(data: st.DataObject) -> None:
    """The engine that settles dstates first goes on at once."""
    trace = data.draw(traces(), label="trace")
    theory = data.draw(theories(trace), label="theory")
    first = data.draw(st.sampled_from([1, 3, prefixes.FIRST_PREFIX]), label="first prefix")
    expected = solve(trace, theory, max_maps=None, speedups=Speedups.without(SPEEDUPS))
    with (
        patch.object(choosing, "FEW_STEPS", 0),
        stepwise(-1.0),
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


def test_listing_has_no_stage_limit() -> None:
    """The cost is found before it is time to change the engine."""
    trace = maze(2, 2, steps=30, seed=0).trace
    listed = Prefixes.minimal_maps

    def slowly(self: Prefixes) -> Iterator[SSHMap]:
        self._task.watch._spent += 2 * STEPWISE
        yield from listed(self)

    with patch.object(Prefixes, "minimal_maps", slowly):
        solution = solve(trace, max_maps=None)
    assert solution.complete
    assert set(solution.maps) == set(solve(trace, max_maps=None, speedups=Speedups()).maps)


@pytest.mark.parametrize(
    "theory",
    [Theory.topological(), Theory(next_place=True), Theory(all_on_paths=True)],
    ids=["", "next", "on paths"],
)
def test_sketch_with_frames_is_smaller(theory: Theory) -> None:
    trace = maze(3, 3, steps=400, seed=0).trace
    first, *rest = trace.steps
    sizes = []
    for sketch in sketches_of(first, settle(trace, theory).theory):
        assert all(
            sketch.extend(action, step) for action, step in zip(trace.actions, rest, strict=True)
        )
        assert check(trace, sketch.map(), settle(trace, theory).theory) == ()
        sizes.append(len(sketch.map().dstates))
    framed, homing = sizes[0], sizes[2]
    assert framed < homing / 2


def test_online_mapper_without_time_has_a_small_map() -> None:
    """The sketch is small enough. The robot was in 27 dstates."""
    trace = maze(3, 3, steps=120, seed=0).trace
    mapper = OnlineMapper(trace.steps[0].view or "", time_limit=0.01)
    with stepwise(-1.0), patch.object(search, "OVERTIME", 100.0):
        for action, step in zip(trace.actions, trace.steps[1:], strict=True):
            answer = mapper.observe(action, step.view or "")
    assert answer.cost
    assert answer.cost.dstates <= 1.2 * 27
    assert check(trace, answer.maps[0], answer.theory) == ()


def test_stage_limit_raises_once() -> None:
    watch = started(60)
    watch.stage_ends = -1
    with pytest.raises(StageTimeError):
        watch.check()
    watch.check()


def test_stage_around_another_one_keeps_its_end() -> None:
    watch = started(60)
    with watch.stage(50):
        with pytest.raises(StageTimeError), watch.stage(-1):
            watch.check()
        watch.check()
        assert watch.stage_ends == 50
        with watch.stage(70):
            assert watch.stage_ends == 50
    assert watch.stage_ends == float("inf")


def test_shorten_never_extends_a_limit() -> None:
    watch = started(60)
    watch.shorten(70)
    watch.check()
    watch.shorten(-1)
    with pytest.raises(LimitError):
        watch.check()
    unlimited = started()
    unlimited.shorten(50)
    assert unlimited.left() <= 50


@pytest.mark.parametrize("has_time", [True, False])
def test_single_steps_are_grounded_if_time_is_short(has_time: bool) -> None:
    trace = maze(2, 2, steps=17, seed=0, stars=True).trace
    watch = Watch()
    engine = choosing.step_engine(Task.of(settle(trace, Theory.topological()), watch, ALL))
    parts: list[int] = []
    ground = engine.asker.control.ground

    def noted(given: Sequence[tuple[str, Sequence[Symbol]]]) -> None:
        parts.append(sum(name == "step" for name, _ in given))
        ground(given)

    with (
        patch.object(watch, "allows", return_value=has_time),
        patch.object(watch, "check"),
        patch.object(engine.asker.control, "ground", noted),
    ):
        engine.grow(len(trace))
    assert [steps for steps in parts if steps] == ([8, 8, 2] if has_time else 18 * [1])
