"""The benchmark of truth recognises true maps, and its traces have displacements that agree with
their poses."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import reject
import truth
from instances import CELL, maze

from ssh_abduction import Theory, Trace, solve
from ssh_abduction.data import Odometry
from ssh_abduction.data.odometry import moved

EXACT = Odometry(0, 0, 0, 0, 0, 0, 0, 0)
NOISE = Odometry(**truth.NOISE)


def reckoned(trace: Trace, start: tuple[float, float, float]) -> list[tuple[float, float, float]]:
    """The pose (x, y, heading) at each step by dead reckoning."""
    poses = [start]
    for step in trace.steps[1:]:
        assert step.displacement is not None
        poses.append(moved(poses[-1], step.displacement))
    return poses


def test_maze_displacements_lead_from_cell_to_cell() -> None:
    walk = maze(4, 4, steps=40, seed=3, odometry=EXACT)
    cells = [state for state in walk.truth if isinstance(state, tuple)]
    start = (CELL * cells[0][0], CELL * cells[0][1], math.pi / 2 * (1 - cells[0][2]))
    for (x, y, heading), pose in zip(cells, reckoned(walk.trace, start), strict=True):
        assert pose[:2] == pytest.approx((CELL * x, CELL * y), abs=0.2)
        assert math.remainder(pose[2] - math.pi / 2 * (1 - heading), math.tau) == pytest.approx(
            0, abs=0.02
        )
    assert walk.trace.without_displacements() == maze(4, 4, steps=40, seed=3).trace


def test_maze_noise_is_along_the_motion() -> None:
    ways = [
        step.displacement
        for seed in range(20)
        for step in maze(4, 4, steps=60, seed=seed, odometry=NOISE, scale=0.1).trace.steps[1:]
    ]
    travels = np.array([way for way in ways if way and abs(way[0]) > 1])
    assert travels[:, 0].mean() == pytest.approx(11.0, abs=0.1)
    assert travels[:, 0].std() == pytest.approx(0.05 * 11, rel=0.15)
    assert travels[:, 2].std() == pytest.approx(0.002 * 11, rel=0.15)


def test_aces3_displacements_fit_its_layout() -> None:
    (known,) = truth.aces3([0], truth.Noise(EXACT))
    assert (len(set(known.dstates)), len(set(known.places))) == (22, 9)
    poses = reckoned(known.trace, (*truth.ACES3["N"], 0.0))
    for place, pose in zip(known.places, poses, strict=True):
        assert pose[:2] == pytest.approx(truth.ACES3[str(place)], abs=0.2)
    assert [
        round(math.hypot(*step.displacement[:2]), 1)
        for step in known.trace.steps[1:3]
        if step.displacement
    ] == [23.5, 0.0]


@pytest.mark.slow
def test_map_is_true_if_its_dstates_and_places_are() -> None:
    (known,) = truth.mazes(2, 20, [1], truth.Noise(NOISE))
    ssh_map = next(
        ssh_map
        for ssh_map in solve(known.trace, Theory.topological()).maps
        if truth.is_true(ssh_map, known)
    )
    for (i, a), (j, b) in combinations(enumerate(ssh_map.labels), 2):
        assert (a == b) == (known.dstates[i] == known.dstates[j])
        assert (ssh_map.dstates[a].place == ssh_map.dstates[b].place) == (
            known.places[i] == known.places[j]
        )
    renamed = replace(known, dstates=tuple(f"here {name}" for name in known.dstates))
    assert truth.is_true(ssh_map, renamed)
    assert not truth.is_true(ssh_map, replace(known, dstates=("elsewhere", *known.dstates[1:])))
    assert not truth.is_true(ssh_map, replace(known, places=("here",) * len(known.places)))


@pytest.mark.slow
def test_truth_benchmark_counts_true_maps(capsys: pytest.CaptureFixture[str]) -> None:
    """On the route of ACES3, 19 dstates explain views and openings alone. None of these maps is
    true."""
    options = truth.arguments().parse_args(["--family", "aces3", "--seeds", "1", "--stars"])
    said = truth.report(
        truth.chosen(options), Theory.topological().replace(displacement="none"), 30
    )
    assert said.startswith("all best maps are true, and proven: 0 of 1; the first map is")
    assert "| ACES3, 0 | 23 | 22, 9 | optimal | 19, 10, 4 | 0 of 4 |" in capsys.readouterr().out
    said = truth.report(truth.chosen(options), Theory.topological(), 4)
    assert said.startswith("all best maps are true, and proven: 0 of 1; the first map is true: 1 ")
    assert "; wrong and sure: 0 of 1; confidence: 0.9: 1 at " in said
    assert "; 6 joins, 0 of them false" in said
    assert "| 22, 9, 6 | 1 of 1 or more |" in capsys.readouterr().out


def test_reliability_compares_probabilities_with_shares() -> None:
    half = [(0.5, True), (0.5, False)]
    assert truth.reliability(half) == (0.0, 0.25)
    assert truth.reliability([(1.0, False)]) == (1.0, 1.0)
    assert (
        truth.diagram([*half, (0.95, True)])
        == "0.5: 2 at 0.500, 0.500 true, 0.9: 1 at 0.950, 1.000 true"
    )
    assert truth.reliability([*half, (0.9, True), (0.9, True)]) == pytest.approx((0.05, 0.13))


def test_reject_benchmark_counts_refused_true_maps() -> None:
    """A true map is hardly ever refused. It is always refused with the displacements of another
    route. Errors that repeat make the scale wrong."""
    white, repeating = reject.walks(3, 30, 7)
    assert (white.trace.odometry or NOISE).bend == 0 < (repeating.trace.odometry or EXACT).bend
    assert reject.true_map(white).labels == reject.true_map(repeating).labels
    assert not reject.is_refused(white, 0.001)
    assert not reject.is_refused(repeating, 0.001)
    wrong = replace(
        white.trace,
        steps=tuple(
            replace(step, displacement=step.displacement and (9.0, 0.0, 0.1))
            for step in white.trace
        ),
    )
    assert reject.is_refused(replace(white, trace=wrong), 0.001)
