"""Returns that displacements refuse: in growing and whole traces, with and without bounds."""

from __future__ import annotations

import math
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import maze
from strategies import traces

from ssh_abduction import SSHMap, Theory, Trace
from ssh_abduction.checker import displacements
from ssh_abduction.checker.displacements import refused_returns
from ssh_abduction.data import DState, Odometry, together
from ssh_abduction.theory.evidence.displacement import Displacement, Returns
from ssh_abduction.theory.evidence.loops import Loops, Reckoning, chi_squares
from ssh_abduction.theory.evidence.protocol import Equality
from ssh_abduction.theory.evidence.together import Together, joint_squares


def seen(trace: Trace, truth: tuple[object, ...], dstates: int = 1000) -> SSHMap:
    """The true map of a walk in a maze, or a map with at most this many dstates.

    In such a map each further dstate is merged into an earlier one.
    """
    number: dict[object, int] = {}
    labels = tuple(number.setdefault(state, len(number)) % dstates for state in truth[: len(trace)])
    places: dict[object, int] = {}
    of_dstate = [places.setdefault(state[:2], len(places)) for state in number]  # type: ignore[index]
    return SSHMap(
        labels, tuple(DState(i, "", place) for i, place in enumerate(of_dstate[:dstates])), ()
    )


def evidence_of(trace: Trace, **choices: object) -> Displacement:
    return Displacement.of(Theory(displacement="use", returns=64, star="none").replace(**choices))


@settings(max_examples=8)
@given(st.data())
def test_pairs_and_counts_of_growing_traces_agree(data: st.DataObject) -> None:
    """Pairs and counts are the same in growing traces.

    Some steps lack a displacement, and traces go on from one prefix in two ways.
    """
    trace = data.draw(traces(max_steps=10), label="trace")
    level = data.draw(st.sampled_from(["topological", "causal"]), label="level")
    theory = Theory.causal() if level == "causal" else Theory(star="none")
    evidence = Displacement.of(theory.replace(displacement="use", returns=2, reject=0.3))
    sizes = data.draw(st.lists(st.integers(1, len(trace)), min_size=1, max_size=6), label="sizes")
    for size in [*sizes, len(trace)]:
        prefix = trace.prefix(size)
        grown, anew = evidence.returns_of(prefix), Returns(evidence, prefix)
        assert (grown.pairs, grown.count()) == (anew.pairs, anew.count())


def test_dead_reckoning_of_a_growing_maze_agrees() -> None:
    trace = maze(4, 4, steps=60, seed=2, odometry=Odometry()).trace
    trace = replace(
        trace,
        steps=tuple(
            replace(step, displacement=None) if t in (20, 21) else step
            for t, step in enumerate(trace)
        ),
    )
    reckoning = Reckoning(trace.prefix(1))
    for size in range(2, len(trace) + 1):
        before, reckoning = reckoning, Reckoning(trace.prefix(size), reckoning)
    other = replace(
        trace, steps=(*trace.steps[:-1], replace(trace.steps[-1], displacement=(3.0, 2.0, 1.0)))
    )
    assert not np.array_equal(
        Reckoning(other, before).loops(0).poses, reckoning.loops(0).poses
    )  # and what the first one has stays
    whole = Reckoning(trace)
    assert whole.begins[-1] > 20
    assert np.array_equal(reckoning.begins, whole.begins)
    for number, bend in enumerate(whole.bends):
        here, there, anew = reckoning.loops(number), whole.loops(number), Loops.of(trace, bend)
        for name in ("poses", "part", "twists", "levers", "bent"):
            assert np.allclose(getattr(here, name), getattr(there, name), rtol=1e-12, atol=1e-12)
            assert np.allclose(getattr(here, name), getattr(anew, name), rtol=1e-12, atol=1e-12)


def joint_excess(returns: Returns, rows: np.ndarray, thresholds: dict[int, float]) -> np.ndarray:
    """The excess of the chi-square of each pair of rows over the threshold, m x m.

    All pairs and all drifts are tried; 0 or less if a pair is not refused.
    """
    reckoning, excess = returns.reckoning, np.zeros((len(rows), len(rows)))
    i, j = np.triu_indices(len(rows), 1)
    shared = np.maximum(rows[i, 0], rows[j, 0]) < np.minimum(rows[i, 1], rows[j, 1])
    i, j = i[shared], j[shared]
    most = np.array([thresholds.get(freedom, 0.0) for freedom in range(7)])[
        4 + rows[i, 2] + rows[j, 2]
    ]
    least = np.full(len(i), np.inf)
    for number, unlikely in enumerate(reckoning.unlikely):
        left = np.flatnonzero(least > 0)  # a pair that one drift explains is not refused
        squares = joint_squares(reckoning.loops(number), rows[i[left]], rows[j[left]]) + unlikely
        least[left] = np.minimum(least[left], squares - most[left])
    excess[i, j] = excess[j, i] = least
    return excess


@pytest.mark.parametrize(
    ("noise", "bend"),
    [
        pytest.param("usual", 0.0, marks=pytest.mark.slow),
        ("steady drift", 0.006),
        ("white", 0.0),
    ],
)
def test_bounds_on_returns_change_no_refusal(noise: str, bend: float) -> None:
    """The later return of a pair ends at each step in turn, or later.

    The thresholds are so low that many pairs are refused though their single returns are not, and
    the map is true.
    """
    refused = only_together = 0
    for seed in (1,) if noise == "steady drift" else (1, 3):
        model = Odometry(
            along=0.04, across=0.005, heading=0.003, position=0.02, angle=0.003, turning=0.0
        )
        model = replace(model, bend=0.0, scale=0.0) if noise == "white" else model
        walk = maze(
            3, 3, steps=20 if noise == "steady drift" else 26, seed=seed, odometry=model, bend=bend
        )
        trace = walk.trace
        returns, ssh_map = Returns(evidence_of(trace), trace), seen(trace, walk.truth)
        places = [ssh_map.dstates[label].place for label in ssh_map.labels]
        rows = returns._returns_among(ssh_map.labels, places)
        thresholds = {4: 3.0, 5: 4.0, 6: 5.0}
        expected, together = (
            joint_excess(returns, rows, thresholds),
            Together(returns.reckoning, thresholds, rows),
        )
        for since in np.unique(rows[:, 1]).tolist():
            is_later = np.triu(np.ones_like(expected, dtype=bool), 1) & (rows[:, 1] >= since)
            excess = np.where(is_later, expected, -np.inf)
            worst, pair = together.worst(since), np.unravel_index(excess.argmax(), excess.shape)
            assert (worst is None) == (excess[pair] <= 0)
            if worst is not None:
                best = [rows[k] for k in pair]
                assert worst == {
                    Equality(int(i), int(j), "dstate" if one_dstate else "place")
                    for i, j, one_dstate in best
                }
                refused += 1
                only_together += all(square_alone(returns, row) < 2.5 for row in best)
    assert refused > only_together
    assert only_together or noise != "white"


def square_alone(returns: Returns, row: np.ndarray) -> float:
    """The chi-square of a single return, for the drift with the least one."""
    closings = (
        returns.reckoning.loops(number).closings(row[:1], row[1:2])
        for number in range(len(returns.reckoning.bends))
    )
    squares = [chi_squares(*found)[int(row[2])][0] for found in closings]
    return float(
        min(
            square + unlikely
            for square, unlikely in zip(squares, returns.reckoning.unlikely, strict=True)
        )
    )


def test_accepted_prefix_is_not_checked_again() -> None:
    walk = maze(3, 3, steps=60, seed=6, odometry=Odometry(along=0.02))
    trace = walk.trace
    evidence = evidence_of(trace, reject=0.3)
    wrong = seen(trace, walk.truth, 14)
    size = next(
        n
        for n in range(2, len(trace))
        if evidence.refuse(trace.prefix(n + 1), replace(wrong, dstate_at=wrong.labels[: n + 1]))
    )
    for n in range(2, size + 2):
        prefix, ssh_map = trace.prefix(n), replace(wrong, dstate_at=wrong.labels[:n])
        grown = evidence.refuse(prefix, ssh_map, since=n - 1)
        assert grown == Returns(evidence, prefix).refused_together(ssh_map)
        assert (grown is None) == (n <= size)
    assert size > 10


@pytest.mark.parametrize("noise", ["usual", "white"])
def test_bounds_change_no_verdict_of_the_checker(noise: str) -> None:
    """The checker refuses the same pairs with its bound as without.

    The shares are so large that true maps are refused, too.
    """
    said = []
    for seed in range(3):
        model = replace(
            Odometry(along=0.02), **({"bend": 0.0, "scale": 0.0} if noise == "white" else {})
        )
        walk = maze(3, 3, steps=30, seed=seed, odometry=model)
        theory = Theory(displacement="use", returns=3, reject=0.97, star="none")
        for dstates in (1000, 9):
            ssh_map = seen(walk.trace, walk.truth, dstates)
            bounded = list(refused_returns(walk.trace, ssh_map, theory))
            with patch.object(displacements, "MARGIN", math.inf):  # no bound is small enough
                assert list(refused_returns(walk.trace, ssh_map, theory)) == bounded
            said += [len(refused.returns) for refused in bounded]
    assert said.count(2) > 2


@pytest.mark.parametrize("wrong", [0, 1])
def test_checker_skips_returns_of_drives_that_were_accepted(wrong: int) -> None:
    """In one of two drives the map has too few dstates. The first drive was accepted."""
    walks = [maze(3, 3, steps=30, seed=seed, odometry=Odometry(along=0.02)) for seed in (6, 7)]
    trace = together([replace(walk.trace, name=f"{i}") for i, walk in enumerate(walks)])
    drives = [
        seen(walk.trace, walk.truth, 9 if i == wrong else 1000) for i, walk in enumerate(walks)
    ]
    shift = len(drives[0].dstates)
    labels = (*drives[0].labels, *(label + shift for label in drives[1].labels))
    dstates = [*drives[0].dstates, *(replace(s, id=s.id + shift) for s in drives[1].dstates)]
    both = SSHMap(labels, tuple(replace(s, place=None) for s in dstates), ())
    theory = Theory(displacement="use", returns=64, reject=0.3, star="none")
    found = list(refused_returns(trace, both, theory))
    assert found
    since = len(walks[0].trace)
    assert list(refused_returns(trace, both, theory, since)) == (found if wrong else [])
