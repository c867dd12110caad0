"""The online mapper is as exact as solving anew after each step, quick, and always has a map."""

from __future__ import annotations

import math
import random
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import maze
from strategies import theories, traces
from worlds import TOURS, drive, rectangle

from ssh_abduction import OnlineMapper, Solution, Theory, Trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.data import Action, Odometry, Step, TheoryError, TraceError
from ssh_abduction.online.keeper import MapKeeper
from ssh_abduction.solution import Status
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.speedups import Speedups

NO_TIME = 1e-9  # seconds: every search is stopped before it begins


def followed(
    trace: Trace,
    theory: Theory,
    limit: float | None = None,
    maps: int = 0,
    speedups: Speedups | None = None,
) -> Iterator[tuple[OnlineMapper, Solution]]:
    """The mapper after each step of a trace, and its answer."""
    first, *rest = trace.steps
    mapper = OnlineMapper(
        first.view or "",
        theory,
        star=first.star,
        confidence=first.confidence,
        odometry=trace.odometry,
        time_limit=limit,
        max_maps=maps or None,
        speedups=speedups or Speedups(),
    )
    yield mapper, mapper.solution
    for action, step in zip(trace.actions, rest, strict=True):
        yield mapper, observed(mapper, action, step)


def follow(trace: Trace, theory: Theory, **options: Any) -> tuple[OnlineMapper, list[Solution]]:
    """The mapper at the end of a trace, and its answers after each step."""
    mappers, answers = zip(*followed(trace, theory, **options), strict=True)
    return mappers[-1], list(answers)


def observed(mapper: OnlineMapper, action: Action, step: Step) -> Solution:
    return mapper.observe(
        action,
        step.view or "",
        star=step.star,
        displacement=step.displacement,
        covariance=step.covariance,
        confidence=step.confidence,
    )


def limit_steps(mapper: OnlineMapper, limit: float | None) -> None:
    """Give each further step this many seconds."""
    keeper = mapper._keeper
    assert isinstance(keeper, MapKeeper)
    keeper._options = replace(keeper._options, time_limit=limit)


def agree(trace: Trace, theory: Theory) -> None:
    """After every step the answer is that of solving the prefix anew."""
    theory = settle(trace, theory).theory
    _, answers = follow(trace, theory)
    for i, answer in enumerate(answers):
        anew = solve(trace.prefix(i + 1), theory.of_steps(0, i + 1), max_maps=None)
        assert (answer.status, answer.complete, answer.steps) == (anew.status, True, i + 1)
        assert answer.bound == anew.bound or not anew.maps
        assert set(answer.maps) == set(anew.maps)
        assert answer.count == anew.count
        for name in theory.priorities if anew.cost else ():
            assert getattr(answer.cost, name) == getattr(anew.cost, name)


@settings(max_examples=5)
@given(st.data())
def test_online_maps_equal_those_of_solve_after_every_step(data: st.DataObject) -> None:
    trace = data.draw(traces(max_steps=7), label="trace")
    agree(trace, data.draw(theories(trace), label="theory"))


@pytest.mark.parametrize("name", ["deterministic", "one_place", "travel_leaves"])
def test_online_mapper_solves_anew_without_an_axiom(name: str) -> None:
    agree(
        Trace.from_steps("abaabb", ["travel", "around", "travel", "right", "travel"]),
        Theory(without=(name,)),
    )


@pytest.mark.slow
@settings(max_examples=5)
@given(st.data())
def test_online_mapper_keeps_at_most_max_maps(data: st.DataObject) -> None:
    trace = data.draw(traces(max_steps=6), label="trace")
    theory = settle(trace, data.draw(theories(trace), label="theory")).theory
    _, answers = follow(
        trace,
        theory,
        maps=2,
        speedups=Speedups(prefixes=data.draw(st.booleans(), label="prefixes")),
    )
    for i, answer in enumerate(answers):
        anew = solve(trace.prefix(i + 1), theory.of_steps(0, i + 1), max_maps=None)
        assert answer.status is anew.status
        assert answer.bound == anew.bound or answer.status is Status.UNSATISFIABLE
        assert answer.count == min(2, anew.count)
        assert set(answer.maps) <= set(anew.maps)
        assert not answer.complete or answer.count == anew.count


def test_online_mapper_knows_the_bound_if_it_lists_more_maps() -> None:
    """This also holds if clingo gets the whole trace at each step."""
    actions = "RRRRRVTRRVRRCRCRTRTVRV"
    named = {
        "R": "right",
        "T": "travel",
        "V": Action("veer", "turn", "right"),
        "C": Action("creep", "travel"),
    }
    trace = Trace.from_steps("00110010110010101010110", [named[action] for action in actions])
    mapper, answers = follow(trace, Theory.causal(), speedups=Speedups.without("prefixes"))
    assert [answer.bound.dstates for answer in answers] == [
        answer.cost.dstates for answer in answers if answer.cost
    ]
    assert mapper.searches > 1


@pytest.mark.parametrize(
    "theory",
    [Theory.causal(), Theory.topological(), Theory.circumscriptive()],
    ids=["causal", "dstates", "paths"],
)
def test_online_mapper_replays_circuits(theory: Theory) -> None:
    mapper, answers = follow(rectangle(200), theory)
    assert answers[-1].maps == solve(rectangle(200), theory).maps
    assert all(a.status is Status.OPTIMAL and a.complete for a in answers)
    assert mapper.searches < 12
    assert mapper.solution.effort.prefix < 16


def test_rotated_star_pattern_is_no_contradiction() -> None:
    """The robot turns where all looks alike. One dstate shows its pattern in every rotation."""
    stars = [(1, 0, 0, 0), (0, 0, 0, 1), (0, 0, 1, 0), (0, 1, 0, 0)]
    trace = Trace.from_steps("a" * 20, ["right"] * 19, stars=stars * 5)
    mapper, answers = follow(trace, Theory(star="pattern"))
    assert {(a.cost.dstates if a.cost else 0, a.count) for a in answers} == {(1, 1)}
    assert mapper.searches == 2


def test_repr_of_a_mapper_shows_its_progress() -> None:
    mapper = OnlineMapper("a", time_limit=None)
    mapper.observe("travel", "b")
    assert repr(mapper) == "<OnlineMapper: 2 steps, optimal, 2 dstates>"


@pytest.mark.parametrize("steps", [3, 4])
def test_online_mapper_without_time_obeys_pairs_of_later_steps(steps: int) -> None:
    """Before the later step of a pair is reached, a search for clashes ignores the pair."""
    trace = Trace.from_steps("aaba", ["right", "left", "travel"], stars=[(1, 1, 1, 1)] * 4)
    theory = Theory(same_place=((0, steps),))
    _, answers = follow(trace, theory, limit=NO_TIME)
    for i, answer in enumerate(answers):
        anew = solve(trace.prefix(i + 1), theory.of_steps(0, i + 1))
        assert answer.status is not Status.UNSATISFIABLE or not anew.maps


@settings(max_examples=5)
@given(st.data())
def test_online_mapper_without_time_has_a_map_and_proves_it_later(data: st.DataObject) -> None:
    trace = data.draw(traces(max_steps=9), label="trace")
    theory = settle(trace, data.draw(theories(trace), label="theory")).theory
    mapper, answers = follow(trace, theory, limit=NO_TIME)
    for i, answer in enumerate(answers):
        if answer.status is Status.UNSATISFIABLE:  # a short clash is found in no time
            assert (answer.complete, answer.stopped, answer.count) == (True, None, 0)
            part = theory.of_steps(0, i + 1)
            assert solve(trace.prefix(i + 1), part).status is Status.UNSATISFIABLE
            continue
        assert answer.status in (Status.FEASIBLE, Status.UNKNOWN)
        assert (answer.complete, answer.stopped, answer.count) == (
            False,
            "time limit",
            answer.status is Status.FEASIBLE,
        )
        for ssh_map in answer.maps:
            assert check(trace.prefix(i + 1), ssh_map, theory) == ()
    limit_steps(mapper, None)
    mapper._keeper._next_search = 0
    action = trace.actions[0] if len(trace) > 1 else Action("travel", "travel")
    star = trace.steps[-1].star
    answer = mapper.observe(action, "a", star=star)
    anew = solve(mapper.trace, theory, max_maps=None)
    assert (answer.status, answer.complete, set(answer.maps)) == (anew.status, True, set(anew.maps))


def test_online_limit_leaves_feasible_maps_and_sound_bounds() -> None:
    """The first half of the tour is solved. After that there is no time."""
    trace = drive(*TOURS["tee"])
    theory = settle(trace).theory
    half = len(trace) // 2
    mapper, _ = follow(trace.prefix(half), theory)
    limit_steps(mapper, NO_TIME)
    bound = 0
    for i in range(half, len(trace)):
        answer = mapper.observe(
            trace.actions[i - 1], trace.steps[i].view or "", star=trace.steps[i].star
        )
        best = solve(trace.prefix(i + 1), theory).cost
        assert best is not None
        assert answer.cost is not None
        assert answer.bound.dstates is not None
        assert bound <= answer.bound.dstates <= best.dstates <= answer.cost.dstates
        assert check(trace.prefix(i + 1), answer.maps[0], theory) == ()
        assert answer.status is Status.FEASIBLE or (
            answer.status is Status.OPTIMAL and best == answer.cost
        )
        bound = answer.bound.dstates
    assert mapper.solution.status is Status.FEASIBLE
    assert mapper.searches <= half + (len(trace) - half) // 2 + 1  # fewer than one per step


def explore(trace: Trace, mapper: OnlineMapper) -> list[Solution]:
    rest = trace.steps[len(mapper.trace) :]
    return [
        observed(mapper, action, step)
        for action, step in zip(trace.actions[len(mapper.trace) - 1 :], rest, strict=True)
    ]


def test_contradicting_step_leaves_no_maps() -> None:
    mapper = OnlineMapper("a", star=[1, 0, 0, 0], time_limit=None)
    assert mapper.observe("around", "b", star=[0, 0, 1, 0]).status is Status.OPTIMAL
    for view in ("a", "c", "a"):
        solution = mapper.observe("around", view, star=[1, 0, 0, 0])
    assert (solution.status, solution.maps, solution.cost, solution.complete) == (
        Status.UNSATISFIABLE,
        (),
        None,
        True,
    )
    assert solution.steps == 5


@pytest.mark.parametrize(
    ("action", "view", "star", "message"),
    [
        ("jump", "a", [1, 0, 0, 0], r"step 1: action\.kind: expected"),
        (
            {"name": "travel", "kind": "turn", "turn": "left"},
            "a",
            [1, 0, 0, 0],
            "step 1: action: 'travel' has kind turn",
        ),
        ({"name": "travel", "kind": "walk"}, "a", [1, 0, 0, 0], r"action\.kind: expected"),
        ("travel", "a", None, "step 2: star: expected one"),
        ("travel", "a", [0, 10], "step 2: star: expected bearings"),
        ("travel", "a", "1000", "step 2: star"),
        ("travel", None, [1, 0, 0, 0], "step 2: view: expected"),
    ],
)
def test_refused_step_leaves_the_mapper_unchanged(
    action: object, view: object, star: object, message: str
) -> None:
    mapper, other = (
        follow(Trace.from_steps("ab", ["travel"], stars=[(1, 0, 0, 0)] * 2), Theory())[0]
        for _ in range(2)
    )
    before, searches = mapper.solution, mapper.searches
    with pytest.raises(TraceError, match=message):
        mapper.observe(action, view, star=star)  # type: ignore[arg-type]
    assert (mapper.solution, mapper.trace, mapper.searches) == (before, other.trace, searches)
    again, expected = (m.observe("around", "b", star=[0, 0, 1, 0]) for m in (mapper, other))
    assert (again.maps, again.status, again.bound) == (
        expected.maps,
        expected.status,
        expected.bound,
    )


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"displacement": (1.0, 2.0)}, "step 2: displacement: expected"),
        (
            {"displacement": (1.0, math.nan, 0.0)},
            r"step 2: displacement\[1\]: expected a finite number",
        ),
        ({"displacement": (10_000.0, 0.0, 0.0)}, "step 2: displacement: expected metres"),
        (
            {"covariance": np.eye(3)},
            "step 2: covariance: expected a displacement at the same step",
        ),
        (
            {"displacement": (1.0, 0.0, 0.0), "covariance": np.diag([1.0, 1.0, -1.0])},
            "step 2: covariance: expected a positive definite matrix",
        ),
    ],
)
def test_malformed_displacement_leaves_the_mapper_unchanged(
    given: dict[str, Any], message: str
) -> None:
    trace = Trace.from_steps("ab", ["travel"], displacements=[(1.0, 0.0, 0.0)])
    mapper, other = (follow(trace, Theory())[0] for _ in range(2))
    before = mapper.solution
    with pytest.raises(TraceError, match=message):
        mapper.observe("travel", "a", **given)
    assert (mapper.solution, mapper.trace, mapper.theory) == (before, other.trace, other.theory)
    again, expected = (
        m.observe("travel", "a", displacement=(1.0, 0.0, 0.0), covariance=np.eye(3))
        for m in (mapper, other)
    )
    assert (again.maps, again.status, again.theory) == (
        expected.maps,
        expected.status,
        expected.theory,
    )
    with pytest.raises(TraceError, match=r"odometry\.along: expected a number"):
        OnlineMapper("a", odometry={"along": -1})


@pytest.mark.parametrize(
    ("theory", "stars", "steps"),
    [
        (Theory(joint=1), True, 12),
        (Theory.causal(), False, 12),
    ],
)
def test_growing_trace_settles_the_use_of_displacements(
    theory: Theory, stars: bool, steps: int
) -> None:
    """The first displacement comes late, and one is missing.

    The number of returns that may be true doubles several times.
    """
    trace = maze(2, 2, steps=steps, seed=3, stars=stars, odometry=Odometry(along=0.02)).trace
    missing = {1, 2, 3, steps // 2}
    trace = replace(
        trace,
        steps=tuple(
            replace(step, displacement=None) if t in missing else step
            for t, step in enumerate(trace)
        ),
    )
    theory = theory.replace(weigh="count")  # maps are not weighed while the robot drives
    _, answers = follow(trace, theory)
    for i in (0, 3, 4, *range(5, steps + 1, 4)):
        answer, anew = answers[i], solve(trace.prefix(i + 1), theory, max_maps=None)
        assert (answer.theory, answer.status, answer.complete, answer.bound) == (
            anew.theory,
            anew.status,
            True,
            anew.bound,
        )
        assert set(answer.maps) == set(anew.maps)
        assert {name: said["pairs"] for name, said in answer.effort.evidence.items()} == {
            name: said["pairs"] for name, said in anew.effort.evidence.items()
        }
    assert [answer.theory.displacement for answer in answers[:6]] == ["none"] * 4 + ["use"] * 2
    assert answers[3].theory.prefer[-1] == ("dstates" if theory.level == "causal" else "places")
    assert answers[4].theory.prefer[-1] == ("dstates" if theory.level == "causal" else "paths")
    assert len({answer.theory.returns for answer in answers}) > 2


def test_displacements_can_be_required_before_the_first_one() -> None:
    trace = maze(2, 2, steps=12, seed=0, odometry=Odometry()).trace
    theory = Theory(displacement="use", star="none", weigh="count")
    mapper, answers = follow(trace, theory)
    assert answers[0].theory == settle(trace.prefix(1), theory.replace(returns=1)).theory
    assert set(answers[-1].maps) == set(solve(trace, theory, max_maps=None).maps)
    assert mapper.theory == settle(trace, theory).theory
    assert follow(trace, Theory(displacement="none"))[0].theory.displacement == "none"


def test_first_step_settles_the_stars() -> None:
    assert OnlineMapper("a", star=[1, 0, 0, 0]).theory.star == "frame"
    plain = OnlineMapper("a")
    assert plain.theory.star == "none"
    with pytest.raises(TraceError, match="step 1: star: expected none, as the first step has none"):
        plain.observe("travel", "b", star=[1, 0, 0, 0])
    with pytest.raises(TheoryError, match="star: expected a trace with stars"):
        OnlineMapper("a", Theory(star="pattern"))
    assert (
        OnlineMapper("a", Theory(star="none"), time_limit=None)
        .observe("travel", "b", star=[1, 0, 0, 0])
        .count
        == 1
    )


def test_equal_steps_give_equal_answers() -> None:
    trace = drive(*TOURS["tee"], stars=False)
    first, second = (
        [(a.maps, a.cost, a.effort.prefix) for a in follow(trace, Theory())[1]] for _ in range(2)
    )
    assert first == second


@pytest.mark.parametrize("theory", [Theory(), Theory.causal().replace(misread=1.5)], ids=str)
def test_one_work_limit_of_steps_gives_one_answer(
    theory: Theory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The clock of seconds runs at random, and some searches are too long for their work."""
    trace = drive(*TOURS["plus"], stars=False)

    def answers(seed: int) -> list[object]:
        jumps, shown = random.Random(seed), [0.0]

        def seconds() -> float:
            shown[0] += jumps.expovariate(1.0)
            return shown[0]

        with monkeypatch.context() as patch:
            patch.setattr(time, "perf_counter", seconds)
            mapper = OnlineMapper(
                trace.steps[0].view or "", theory, time_limit=None, work_limit=0.002
            )
            found = [mapper.solution, *explore(trace, mapper)]
        return [(a.maps, a.status, a.bound, a.complete, a.stopped) for a in found]

    first, *others = (answers(seed) for seed in range(3))
    assert others == [first, first]
    assert any(answer[4] == "work limit" for answer in first)  # type: ignore[index]
