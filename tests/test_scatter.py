"""Lower bounds on clusterings (facilities.py) and on costs of logs (scatter.py)."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from brute_force import divisions
from hypothesis import given, settings
from hypothesis import strategies as st
from threadpoolctl import threadpool_info, threadpool_limits

from ssh_abduction import Theory, Trace, solve
from ssh_abduction.data.drives import together
from ssh_abduction.data.odometry import Odometry
from ssh_abduction.runtime.clock import heeding
from ssh_abduction.solver.costs import weighing
from ssh_abduction.solver.costs.facilities import Facilities
from ssh_abduction.solver.costs.misfit import Misfit
from ssh_abduction.solver.costs.scatter import is_for, least_cost
from ssh_abduction.solver.geometry.fit import Poses
from ssh_abduction.solver.sources.exact.choosing import READABLE
from ssh_abduction.theory.pairs import NO_PAIRS
from ssh_abduction.theory.settle import Problem, settle

PRICE = 8.0
OFF = Odometry(0.05, 0.02, 0.005, 0.02, 0.1, 0.02, 0.01, 0.001, offset=0.2, facing=0.1)
EXACT = Odometry(0.01, 0.005, 0.001, 0.001, 0.01, 0.001, 0.001, 0.0001, offset=0.2, facing=0.1)
QUARTER = math.pi / 2


def least_by_trying(facilities: Facilities) -> float:
    """Compute the least cost of all clusterings. Headings are near 0."""
    points, weights = facilities.points, 1 / facilities.variances

    def cost(cluster: list[int]) -> float:
        w, p, kinds = weights[cluster], points[cluster], facilities.kinds[cluster]
        mean = (w * p).sum(0) / w.sum(0)
        fees = min(facilities.fees[cluster][kinds != kind].sum() for kind in kinds)
        return facilities.price + float((w * (p - mean) ** 2).sum()) / 2 + float(fees)

    return min(sum(map(cost, parts)) for parts in divisions(len(points)))


@settings(max_examples=15)
@given(st.integers(1, 6), st.sampled_from([2, 3]), st.integers(0, 10**6))
def test_scatter_shares_bound_all_clusterings_from_below(n: int, size: int, seed: int) -> None:
    draw = np.random.default_rng(seed)
    points = draw.uniform(0, 2.5, (n, size)) * [1, 1, 0.3][:size]
    variances = draw.uniform(0.05, 0.15, (n, size)) * [1, 1, 0.1][:size]
    fees = draw.choice([0.0, 1.0, 5.0, math.inf], n)
    facilities = Facilities(points, variances, draw.integers(0, 2, n), fees, PRICE)
    shares = facilities.shares(np.full(n, PRICE))
    least = least_by_trying(facilities)
    assert 0.7 * least <= shares.sum() <= least + 1e-6


def test_scatter_shares_of_far_clusters_equal_their_cost() -> None:
    points = np.array([[0.0, 0, 3.1], [0.2, 0, -3.1], [9, 9, 0], [9, 9, 0.1], [9, 9, 2]])
    variances, kinds = np.full((5, 3), 0.04), np.zeros(5, dtype=int)
    facilities = Facilities(points, variances, kinds, np.zeros(5), PRICE)
    shares = facilities.shares(np.full(5, PRICE))
    turned = 2 * math.pi - 6.2
    costs = [(0.2**2 + turned**2) / 4 / 0.04, 0.1**2 / 4 / 0.04, 0]
    assert shares.sum() == pytest.approx(3 * PRICE + sum(costs), rel=0.02)
    assert shares.sum() <= 3 * PRICE + sum(costs)


def off_its_places(seed: int) -> Trace:
    """A random walk among crossings of streets. The robot is some decimetres off the crossings."""
    draw = random.Random(seed)
    steps = draw.randint(3, 6)
    views = "".join(draw.choice("ab") for _ in range(steps))
    turns = [draw.random() < 0.5 for _ in range(steps - 1)]
    moves = [
        (0.0, 0.0, QUARTER + draw.gauss(0, 0.05))
        if turn
        else (draw.choice([1, 2, 3]) + draw.gauss(0, 0.2), draw.gauss(0, 0.2), draw.gauss(0, 0.05))
        for turn in turns
    ]
    actions = ["left" if turn else "travel" for turn in turns]
    return replace(Trace.from_steps(views, actions, displacements=moves), odometry=OFF)


def bound_of(problem: Problem, most: float) -> float:
    return least_cost(problem, Misfit(problem).visit, most)


def in_pieces(seed: int) -> Trace:
    """A trace that falls into two pieces: two short drives, or a drive with a gap."""
    if seed % 3 == 0:
        return off_its_places(seed).without_displacements_at((2,))
    drives = [off_its_places(1000 * seed + k) for k in range(2)]
    return together([drive.prefix(3) for drive in drives], ["monday", "tuesday"])


def unsure(seed: int) -> Trace:
    """A trace with some steps of low and of high confidence."""
    trace, draw = off_its_places(seed).prefix(4), random.Random(seed)
    return replace(
        trace,
        steps=tuple(
            replace(step, confidence=draw.choice([None, 0.6, 0.999])) for step in trace.steps
        ),
    )


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))]
)
@pytest.mark.parametrize(
    ("drawn", "misread"), [(off_its_places, 0.0), (in_pieces, 0.0), (unsure, 0.4), (unsure, 1.5)]
)
def test_scatter_bound_is_below_the_least_cost(
    drawn: Callable[[int], Trace], misread: float, seed: int
) -> None:
    trace = drawn(seed)
    theory = Theory.causal() if seed % 3 == 0 else Theory.topological().replace(boundary="none")
    theory = theory.replace(weigh="cost", prices=((8, 8, 0), (3, 5, 0))[seed % 2], misread=misread)
    solution = solve(trace, theory)
    assert solution.status.value == "optimal"
    assert solution.weighed is not None
    problem = settle(trace, theory)
    assert is_for(problem)
    least = solution.weighed.nats
    assert 0 < bound_of(problem, 2 * least) <= least + 1e-6


def rounds(count: int) -> Trace:
    """A robot that drives around a square with sides of 4 m, and turns left at each corner."""
    draw = random.Random(7)
    moves = [(4 + draw.gauss(0, 0.1), draw.gauss(0, 0.1), 0.0), (0.0, 0.0, QUARTER)] * (4 * count)
    views, actions = "a" * (8 * count + 1), ["travel", "left"] * (4 * count)
    return replace(Trace.from_steps(views, actions, displacements=moves), odometry=OFF)


def test_scatter_bound_is_near_the_cost_for_far_places() -> None:
    trace = rounds(1)
    theory = Theory.topological().replace(boundary="none", star="none", weigh="cost")
    solution = solve(trace, theory)
    assert solution.status.value == "optimal"
    assert solution.weighed is not None
    least = solution.weighed.nats
    assert 0.55 * least <= bound_of(settle(trace, theory), least) < least


def test_scatter_bound_of_exact_rounds_is_near_the_cost() -> None:
    trace = replace(rounds(6), odometry=EXACT)
    problem = settle(trace, Theory.topological().replace(boundary="none", star="none"))
    dstates = [t % 8 for t in range(len(trace))]
    places = [(t + 1) // 2 % 4 for t in range(len(trace))]
    cost = 12 * PRICE + Misfit(problem).of_course(dstates, places) / 2
    assert 0.85 * cost <= bound_of(problem, cost) < cost


def test_pairs_kept_apart_raise_the_scatter_bound() -> None:
    """A bent track would bring steps together that the displacements say are at two places."""
    theory = Theory.topological().replace(boundary="none", star="none", weigh="cost")
    with patch.object(Problem, "pairs", NO_PAIRS):
        low = bound_of(settle(rounds(2), theory), 1000)
    assert bound_of(settle(rounds(2), theory), 1000) > 3 * low > 0


def test_short_second_drive_hardly_lowers_the_scatter_bound() -> None:
    theory = Theory.topological().replace(boundary="none", star="none", weigh="cost")
    both = together([rounds(1), rounds(1).prefix(5)], ["monday", "tuesday"])
    assert bound_of(settle(both, theory), 1000) > 0.95 * bound_of(settle(rounds(1), theory), 1000)


@pytest.mark.slow
def test_long_trace_with_faults_gets_a_scatter_bound() -> None:
    trace = replace(rounds(8), odometry=EXACT)
    solution = solve(trace, Theory(misread=2.0, boundary="none", star="none"), time_limit=5)
    assert len(trace) > READABLE
    assert solution.weighed is not None
    assert 0.4 * solution.weighed.nats <= solution.weighed.bound <= solution.weighed.nats


def test_scatter_bound_is_off_for_other_traces_and_theories() -> None:
    trace = rounds(1)
    assert is_for(settle(trace))
    assert not is_for(settle(trace, Theory(jumped=2.0)))
    assert not is_for(settle(replace(trace, odometry=replace(OFF, offset=0.0, facing=0.0))))


def test_costs_are_computed_in_one_thread() -> None:
    threads: set[int] = set()

    def counted(work: Callable[..., object]) -> Callable[..., object]:
        def call(*args: object) -> object:
            threads.update(x["num_threads"] for x in threadpool_info() if x["user_api"] == "blas")
            return work(*args)

        return call

    with (
        threadpool_limits(2),
        patch.object(weighing.scatter, "least_cost", counted(least_cost)),
        patch.object(weighing, "rivals_of", counted(weighing.rivals_of)),
    ):
        solve(off_its_places(0), Theory(boundary="none"), time_limit=60)
    assert threads == {1}


def test_bound_heeds_the_clock_after_each_long_step() -> None:
    settled, ended = Poses.settled, list[str]()

    def end(*args: Any) -> Any:
        ended.append("settled")
        return settled(*args)

    def over() -> None:
        if ended:
            raise TimeoutError

    trace = off_its_places(0)
    problem = settle(trace, Theory(boundary="none"))
    with (
        patch.object(Poses, "settled", end),
        patch.object(np.linalg, "eigh", side_effect=AssertionError),
        heeding(over),
        pytest.raises(TimeoutError),
    ):
        bound_of(problem, 1000.0)
