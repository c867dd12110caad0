"""Code that takes long checks the time limit, whoever calls it, and ends when time is up."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import replace
from unittest.mock import patch

import pytest
from turns import turn_with

from benchmarks.instances import maze, rectangle
from ssh_abduction import Theory, Trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.runtime.clock import each_heeding, heeding, look_at_clock
from ssh_abduction.solution import Status
from ssh_abduction.solver import candidates, search
from ssh_abduction.solver.board import Judging
from ssh_abduction.solver.geometry import ranking
from ssh_abduction.solver.geometry.fit import fit
from ssh_abduction.solver.sources.symbolic.merging import Merging
from ssh_abduction.solver.sources.symbolic.sketch import Sketch, sketches_of
from ssh_abduction.theory.evidence import Planar
from ssh_abduction.theory.settle import Problem, settle

TURNED = {"right": -math.pi / 2, "left": math.pi / 2, "around": math.pi}


class OverError(Exception):
    """A stand-in for the error of a limit that is over."""


def over() -> None:
    raise OverError


def driven(trace: Trace, wrong: int = 0) -> Trace:
    """The trace with displacements. Some of them are wrong by metres."""
    steps, chance = list(trace.steps), random.Random(0)
    for t, action in enumerate(trace.actions, 1):
        travels = action.kind == "travel"
        steps[t] = replace(
            steps[t],
            displacement=(5.0, 0.0, 0.0) if travels else (0.0, 0.0, TURNED[str(action.turn)]),
        )
    for t in chance.sample(
        [t for t, action in enumerate(trace.actions, 1) if action.kind == "travel"], wrong
    ):
        steps[t] = replace(
            steps[t], displacement=(chance.uniform(15, 30), chance.uniform(15, 30), 0.0)
        )
    return replace(trace, steps=tuple(steps))


def sketched(trace: Trace, theory: Theory, homing: bool = True, framed: bool = True) -> SSHMap:
    sketch = Sketch(trace.steps[0], theory, homing, framed)
    assert all(
        sketch.extend(action, step)
        for action, step in zip(trace.actions, trace.steps[1:], strict=True)
    )
    return sketch.map()


DRIVEN = driven(maze(3, 3, steps=80, seed=0).trace)
USED = settle(DRIVEN).theory
RING = rectangle(2).trace
PLANAR = settle(RING, Theory.topological().replace(planar=True)).theory
GATEWAYS = Trace.from_steps(
    "abab", ["travel", "around", "travel"], stars=[[0, 120], [60, 180], [0, 120], [60, 180]]
)
IN_TOLERANCE = settle(GATEWAYS).theory
MAP = sketched(DRIVEN, USED)
UNLIKE = Trace.from_steps("abc", ["travel"] * 2, stars=[[1, 0, 0, 0], [1, 0, 1, 0], [0, 0, 1, 0]])
SEEN = settle(UNLIKE, Theory(misread=1.5)).theory

LONG: dict[str, Callable[[], object]] = {
    "checker": lambda: check(DRIVEN, MAP, USED),
    "gateways": lambda: check(
        GATEWAYS, sketched(GATEWAYS, IN_TOLERANCE, framed=False), IN_TOLERANCE
    ),
    "displacements of two returns": lambda: Judging(
        Problem.of(driven(maze(3, 3, steps=80, seed=0).trace), USED)
    ).refusal(MAP),
    "crossings": lambda: Planar.of(PLANAR).refuse(RING, solve(RING, max_maps=1).maps[0]),
    "fit": lambda: fit(DRIVEN, MAP),
    "merging": lambda: Merging(UNLIKE, SEEN, Problem.of(UNLIKE, SEEN).pairs).merge(),
}


@pytest.mark.parametrize("name", LONG)
def test_long_computations_check_the_limits(name: str) -> None:
    looks = []
    with heeding(lambda: looks.append(None)):
        LONG[name]()
    assert looks
    with heeding(over), pytest.raises(OverError):
        LONG[name]()


def test_nested_limits_are_all_checked() -> None:
    calls: list[str] = []
    with heeding(lambda: calls.append("outer")), heeding(lambda: calls.append("inner")):
        look_at_clock()
    assert calls == ["outer", "inner"]
    look_at_clock()  # after that, no limit is checked
    assert len(calls) == 2


def test_limit_of_a_generator_does_not_reach_its_caller() -> None:
    def made() -> object:
        look_at_clock()
        yield 1

    with pytest.raises(OverError):
        list(each_heeding(over, iter(made())))  # type: ignore[call-overload]
    for _ in each_heeding(over, iter([1])):
        look_at_clock()


@pytest.mark.parametrize(
    ("steps", "wrong", "stars"), [(60, 0, False), (60, 6, False), (100, 13, False), (60, 6, True)]
)
def test_solve_returns_a_consistent_map_at_the_time_limit(
    steps: int, wrong: int, stars: bool
) -> None:
    """The checker refuses sketches with wrong returns, as displacements contradict them."""
    trace = driven(maze(4, 4, steps=steps, seed=steps, stars=stars).trace, wrong)
    with patch.multiple(search, OVERTIME=100.0):
        solution = solve(trace, time_limit=1e-6)
    assert (solution.status, solution.stopped) == (Status.FEASIBLE, "time limit")
    assert check(trace, solution.maps[0], solution.theory) == ()


@pytest.mark.parametrize(("seconds", "fits"), [(100.0, [True, False]), (0.0, [False, False])])
def test_only_the_first_map_gets_poses_after_the_time_limit(
    seconds: float, fits: list[bool]
) -> None:
    found = ranking.Ranking(DRIVEN).ranked(iter([MAP, MAP]), lambda: True, lambda: seconds)
    assert [bool(ssh_map.fit) for ssh_map in found] == fits


def test_solve_tries_another_sketch_if_the_checker_refuses_one() -> None:
    trace = driven(maze(3, 3, steps=60, seed=1).trace, 4)
    theory = settle(trace).theory
    assert check(trace, sketched(trace, theory), theory)
    with patch.multiple(search, OVERTIME=100.0), turn_with("sketch", share=1.0):
        assert solve(trace, time_limit=1e-6).maps


def test_each_sketch_gets_a_share_of_the_time() -> None:
    """The first sketch uses all of its time. The others still get their share."""
    trace = driven(maze(3, 3, steps=60, seed=1).trace, 4)
    tried = []

    def deaf(self: object, sketch: Sketch) -> None:
        tried.append(sketch)
        over_time = candidates.LimitError("time limit")
        raise over_time

    with (
        patch.multiple(search, OVERTIME=100.0),
        patch.object(candidates.Candidates, "_go_on_to_end", deaf),
        patch.object(candidates.Candidates, "beam", lambda *_: None),
    ):
        assert solve(trace, time_limit=1e-6).status is Status.UNKNOWN
    assert len(tried) == len(sketches_of(trace.steps[0], settle(trace).theory))
