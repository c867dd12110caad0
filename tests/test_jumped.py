"""Wrong displacements, against all sets of steps without their displacements, the checker, and
walks with known jumps."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from functools import cache
from itertools import chain, combinations
from unittest.mock import patch

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import maze

from ssh_abduction import OnlineMapper, Solution, SSHMap, Theory, Trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.data import Odometry
from ssh_abduction.data.errors import TheoryError
from ssh_abduction.data.maps import Fault
from ssh_abduction.data.odometry import in_words
from ssh_abduction.explain.no_map import explain
from ssh_abduction.solver import Misfit, Search
from ssh_abduction.solver.costs import weighing
from ssh_abduction.solver.sources.metric.wrong_displacements import search_jumps
from ssh_abduction.theory import Speedups
from ssh_abduction.theory.evidence.displacement import jumped
from ssh_abduction.theory.fields import FAULT
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.speedups import SPEEDUPS

AHEAD, LEFT, AWAY = (10.0, 0.0, 0.0), (0.0, 0.0, math.pi / 2), (25.0, 7.0, 0.9)
NOISE = Odometry(along=0.05, across=0.005, heading=0.002)


def circuit(steps: int, jumps: tuple[int, ...] = ()) -> Trace:
    """Several rounds of a square with equal corners. The displacements to some steps are wrong."""
    moves = [AWAY if t in jumps else (AHEAD, LEFT)[(t - 1) % 2] for t in range(1, steps)]
    return Trace.from_steps(
        ["pq"[t % 2] for t in range(steps)],
        [("travel", "left")[t % 2] for t in range(steps - 1)],
        displacements=moves,
    )


@cache
def carried() -> Solution:
    """A circuit during which the robot was carried away once."""
    return solve(circuit(18, (9,)), Theory(jumped=2, weigh="count"), max_maps=None)


@st.composite
def small_traces(draw: st.DrawFn) -> Trace:
    steps = draw(st.integers(3, 7))
    done = draw(
        st.lists(st.sampled_from(["travel", "left"]), min_size=steps - 1, max_size=steps - 1)
    )
    right = {"travel": AHEAD, "left": LEFT}
    moves = [draw(st.sampled_from([right[action], right[action], AWAY, None])) for action in done]
    return Trace.from_steps(
        draw(st.lists(st.sampled_from("aab"), min_size=steps, max_size=steps)),
        done,
        displacements=moves,
    )


@pytest.mark.slow
@settings(max_examples=5)
@given(small_traces(), st.booleans(), st.sampled_from([0.4, 1.0, 1.7]))
def test_maps_with_jumps_equal_the_best_subset_of_displacements(
    trace: Trace, causal: bool, price: float
) -> None:
    if not trace.has_displacements:
        return
    theory = (Theory.causal() if causal else Theory(boundary="none")).replace(
        displacement="use", jumped=price, prefer=("dstates",)
    )
    theory = settle(trace, theory).theory
    moved = [t for t, step in enumerate(trace.steps) if step.displacement is not None]
    expected: dict[float, set[tuple[tuple[int, ...], tuple[int, ...]]]] = {}
    for jumps in chain.from_iterable(combinations(moved, size) for size in range(len(moved) + 1)):
        found = solve(trace.without_displacements_at(jumps), theory.without_faults(), max_maps=None)
        if found.cost:
            cost = round(found.cost.dstates + price * len(jumps), 1)
            expected.setdefault(cost, set()).update(
                (ssh_map.labels, jumps) for ssh_map in found.maps
            )
    solution = solve(trace, theory, max_maps=None)
    assert solution.complete
    assert solution.cost is not None
    least = min(expected)
    assert solution.cost.dstates + solution.cost.faults == pytest.approx(least)
    assert {(m.labels, tuple(fault.step for fault in m.faults)) for m in solution.maps} == expected[
        least
    ]
    assert all(check(trace, ssh_map, theory) == () for ssh_map in solution.maps)


@pytest.mark.slow
def test_carried_robot_finds_its_circuit_again() -> None:
    trace, solution = circuit(18, (9,)), carried()
    without = solve(trace, Theory(weigh="count")).cost
    assert without is not None
    assert without.dstates == 17
    assert [(len(m.dstates), len(m.places)) for m in solution.maps] == [(8, 4)]
    (fault,) = solution.maps[0].faults
    assert fault == Fault(9, "jumped", "25.0 m ahead, 7.0 m left, turned 52 degrees left")
    assert str(fault) == (
        "the displacement that leads to step 9 is wrong: 25.0 m ahead, 7.0 m left, turned 52 "
        "degrees left"
    )
    assert SSHMap.from_dict(solution.maps[0].to_dict()).faults == (fault,)
    assert check(trace, solution.maps[0], solution.theory) == ()


def test_displacements_that_may_be_wrong_exclude_no_pair() -> None:
    """The best map joins steps that the wrong displacement takes far apart."""
    solution = solve(circuit(7, (5,)), Theory(jumped=0.5, weigh="count"))
    assert solution.maps[0].faults
    assert solution.effort.evidence["displacement"]["pairs"] == 0


@pytest.mark.slow
def test_speedups_do_not_change_maps_with_jumps() -> None:
    trace, solution = circuit(18, (9,)), carried()
    plain = solve(trace, solution.theory, speedups=Speedups.without(SPEEDUPS), max_maps=None)
    assert plain.maps == solution.maps


@pytest.mark.slow
def test_checker_judges_maps_by_their_assumed_jumps() -> None:
    trace, solution = circuit(18, (9,)), carried()
    best = solution.maps[0]

    def broken(ssh_map: SSHMap) -> set[str]:
        return {violation.axiom for violation in check(trace, ssh_map, solution.theory)}

    (fault,) = best.faults
    assert "one_pose" in broken(replace(best, faults=()))
    assert "one_pose" in broken(replace(best, faults=(replace(fault, step=16),)))
    assert broken(replace(best, faults=(fault, replace(fault, step=0))))
    assert broken(replace(best, faults=(replace(fault, cost=1.0),)))
    assert check(trace, best, solution.theory.without_faults())


@pytest.mark.slow
def test_map_of_a_maze_with_jumps_costs_at_most_the_true_cost() -> None:
    seed, jumps = 12, 2
    chance = random.Random(seed)
    walk = maze(3, 3, steps=60, seed=seed, stars=True, follow=True, odometry=NOISE)
    wrong = sorted(chance.sample(range(20, 45), jumps))
    steps = list(walk.trace.steps)
    for t in wrong:
        steps[t] = replace(
            steps[t],
            displacement=(
                chance.choice((-15, 15)),
                chance.choice((-15, 15)),
                chance.uniform(-3, 3),
            ),
            covariance=None,
        )
    trace = replace(walk.trace, steps=tuple(steps))
    true = len(set(walk.truth))
    with patch.multiple(weighing, PATIENCE=0.0, MORE=0.0):  # the proof would take minutes
        solution = solve(trace, Theory(jumped=3))
    assert solution.cost is not None
    assert solution.cost.dstates + solution.cost.faults <= true + 3 * jumps
    assert check(trace, solution.maps[0], solution.theory) == ()
    assert solution.weighed is not None
    assert solution.weighed.proven or not solution.weighed.searched
    assert solution.weighed.finished == (solution.confidence is not None)


@pytest.mark.slow
def test_search_for_a_jump_costs_at_most_the_true_cost() -> None:
    """It begins with a map that believes all displacements, and changes one guess at a time."""
    walk, jump = maze(3, 3, steps=16, seed=12, stars=True, follow=True, odometry=NOISE), 6
    steps = list(walk.trace.steps)
    steps[jump] = replace(steps[jump], displacement=AWAY, covariance=None)
    search = Search(replace(walk.trace, steps=tuple(steps)), Theory(jumped=0.5))
    parts, found = search.parts, dict[tuple[int, ...], float]()
    misfit = Misfit(parts.task.problem)

    def add(ssh_map: SSHMap) -> float:
        assert not check(search.trace, ssh_map, search.theory)
        return found.setdefault(jumped(ssh_map), misfit.nats_of(ssh_map))

    beams = weighing.Weighing(parts).beams
    believing, *_ = beams.maps_without(())
    search_jumps(search.trace, beams.maps_without, beams.refitted, believing, add)
    dstates, places = walk.truth, [state[:2] for state in walk.truth]
    number = [[*dict.fromkeys(names)].index for names in (dstates, places)]
    course = [*map(number[0], dstates)], [*map(number[1], places)]
    true = misfit.nats_of_course(*course, [jump]) + FAULT * search.theory.jumped
    assert min(found.values()) <= true + 1e-6 < found[()]


def test_jumps_are_refused_where_unsupported() -> None:
    theory = Theory(jumped=2)
    for ask in (
        lambda: OnlineMapper("a", theory),
        lambda: explain(circuit(4), theory),
    ):
        with pytest.raises(TheoryError, match="jumped"):
            ask()
    with pytest.raises(TheoryError, match="jumped: expected displacements to be used"):
        Theory(jumped=2, displacement="none")
    with pytest.raises(TheoryError, match="jumped: expected a number"):
        Theory(jumped=-1)


def test_displacement_has_a_sentence() -> None:
    assert in_words((0.0, 0.0, 0.0)) == "no move"
    assert in_words((-3.0, 0.04, -math.pi / 2)) == "3.0 m back, turned 90 degrees right"
