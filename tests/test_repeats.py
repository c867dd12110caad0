"""A lower bound from what the robot does again and again (solver/costs/repeats.py)."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import numpy as np
import pytest
import together
import truth
from brute_force import divisions
from hypothesis import given, settings
from hypothesis import strategies as st
from test_forced import EQUAL, STRAIGHT, THEORIES, case_of, forcing_of, true_map

from ssh_abduction import Trace
from ssh_abduction.data import Odometry
from ssh_abduction.solver.costs.misfit import Misfit
from ssh_abduction.solver.costs.repeats import RepeatedMoves, SharedPart, has_independent_errors
from ssh_abduction.theory.settle import settle

PRICE = 3.0


def least_by_trying(moves: RepeatedMoves, together: np.ndarray) -> float:
    """Compute the least cost of all clusterings into cliques. Headings are near whole turns."""
    moved, weights = moves.moved.copy(), moves.weights
    moved[:, 2] -= math.tau * np.round(moved[:, 2] / math.tau)

    def cost(cluster: list[int]) -> float:
        if not together[np.ix_(cluster, cluster)].all():
            return math.inf
        nats = PRICE
        for kind in {*moves.kind[cluster]}:
            some = [i for i in cluster if moves.kind[i] == kind]
            total = np.maximum(weights[some].sum(0), 1e-12)
            off = moved[some] - (weights[some] * moved[some]).sum(0) / total
            nats += float((weights[some] * off**2).sum()) / 2
        return nats

    return min(sum(map(cost, parts)) for parts in divisions(len(moved)))


@settings(max_examples=25)
@given(st.integers(1, 6), st.integers(0, 10**6))
def test_shares_bound_all_clusterings_into_cliques_from_below(n: int, seed: int) -> None:
    draw = np.random.default_rng(seed)
    together = np.triu(draw.random((n, n)) < 0.8, 1)
    together |= together.T | np.identity(n, dtype=bool)
    moved = draw.normal(0, 1, (n, 3)) * [1, 1, 0.1]
    moved[:, 2] += math.tau * draw.integers(0, 2, n)
    weights = draw.choice([1.0, 2.0, 0.0], (n, 3)) * [1, 1, 100]
    moves = RepeatedMoves(draw.choice([-1, 0, 1], n), moved, weights)
    weights[moves.kind < 0] = 0.0
    shares = SharedPart(moves, together, PRICE).shares(np.arange(n), 40)
    least = least_by_trying(moves, together)
    assert 0.6 * least <= shares.sum() <= least + EQUAL


@pytest.mark.filterwarnings("ignore:views")
@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))]
)
@pytest.mark.parametrize("kind", THEORIES)
def test_bound_from_repeats_is_at_most_the_least_cost(kind: str, seed: int) -> None:
    trace, theory, solution, weighed = case_of(kind, seed, [STRAIGHT])
    assert has_independent_errors(settle(trace, theory))
    for ssh_map in {solution.maps[0], solution.maps[-1]}:
        forcing = forcing_of(trace, theory, ssh_map)
        for _ in range(2):
            bounds = [*forcing.repeated(settle(trace, theory), ssh_map.dstate_at)]
            assert bounds == sorted(bounds)
            assert max(bounds, default=0.0) <= weighed.nats + EQUAL
            forcing.force(weighed.nats + 1e-3)


def test_scatter_of_repeated_moves_raises_the_bound_of_long_drives() -> None:
    (known,) = together.of_mazes(3, 45, [7], truth.Noise(Odometry(**truth.NOISE)), 3)
    ssh_map, problem = true_map(known), settle(known.trace)
    cost = Misfit(problem).nats_of(ssh_map)
    first, *_, last = forcing_of(known.trace, problem.theory, ssh_map).repeated(
        problem, ssh_map.dstate_at
    )
    assert first + 0.1 * cost < last <= cost
    assert last > 0.85 * cost


def test_bound_from_repeats_needs_independent_errors() -> None:
    trace = truth.random_walk(3, 8, 0, truth.Noise(Odometry(**truth.NOISE))).trace
    assert has_independent_errors(settle(trace))
    for odometry in (Odometry(), Odometry(bend=0.0, offset=0.1)):
        assert not has_independent_errors(settle(replace(trace, odometry=odometry)))


def test_moves_that_turn_on_the_spot_count_their_heading_only() -> None:
    displacements = [(1.0, 0.0, 0.0), (0.01, 0.0, random.Random(0).gauss(1.57, 0.01))]
    odometry = Odometry(bend=0.0)
    trace = Trace.from_steps("aba", ["travel", "left"], displacements=displacements)
    moves = RepeatedMoves.of(replace(trace, odometry=odometry), [0, 1, 1], PRICE)
    assert moves.kind.tolist() == [0, 1, -1]
    assert (moves.weights > 0).tolist() == [[True] * 3, [False, False, True], [False] * 3]
