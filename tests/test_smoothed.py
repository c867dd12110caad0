"""Guessing a map at poses that fit all closures at once."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, pairwise
from unittest.mock import patch

import pytest
from turns import guessed

from ssh_abduction import SSHMap, Theory, Trace
from ssh_abduction.data import Closure, Odometry
from ssh_abduction.data.drives import together
from ssh_abduction.data.odometry import Pose, displacement_between, moved
from ssh_abduction.robot_logs import log_maps
from ssh_abduction.runtime.limits import StageTimeError
from ssh_abduction.solver import Search
from ssh_abduction.solver.candidates import Candidates
from ssh_abduction.solver.costs import beams
from ssh_abduction.solver.costs.weighing import Weighing
from ssh_abduction.solver.parts import Limits, Parts, Start
from ssh_abduction.solver.sources.metric.completing import completed
from ssh_abduction.solver.sources.metric.overlay import Overlay, smoothed_map
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.speedups import Speedups

ODOMETRY = Odometry(
    along=0.02, across=0.02, heading=0.003, turning=0.03, position=0.1, angle=0.03, scale=0.01,
    bend=0.0005,
)  # fmt: skip
TIGHT = ((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.0003))
BARE = Theory(star="none", boundary="none")


def driven(
    way: Sequence[tuple[float, float]], chance: random.Random
) -> tuple[Trace, list[int], list[Pose]]:
    """A drive along places on a grid of 10 m that look the same. Turns are off by 0.03 radians.

    Returns the trace, the number of the place of each step along the way, and the true poses.
    """
    heading = [math.atan2(q[1] - p[1], q[0] - p[0]) for p, q in pairwise(way)]
    pose: Pose = (10.0 * way[0][0], 10.0 * way[0][1], heading[0])
    poses, at, actions, displacements = [pose], [0], list[str](), list[Pose]()
    for i, facing in enumerate(heading):
        turn = math.remainder(facing - pose[2], math.tau)
        for action in (["left" if turn > 0 else "right"] if abs(turn) > 0.1 else []) + ["travel"]:
            ahead = 10.0 * math.dist(way[i], way[i + 1])
            onward = (ahead, 0.0, 0.0) if action == "travel" else (0.0, 0.0, turn)
            off = (0.1, 0.1, 0.03) if action == "travel" else (0.0, 0.0, 0.03)
            x, y, angle = (a + chance.gauss(0, sigma) for a, sigma in zip(onward, off, strict=True))
            displacements.append((x, y, angle))
            pose = moved(pose, onward)
            poses.append(pose)
            actions.append(action)
            at.append(i + (action == "travel"))
    trace = Trace.from_steps(
        ["v"] * len(at), actions, displacements=displacements, odometry=ODOMETRY
    )
    return trace, at, poses


def rounds(columns: int, rows: int, seed: int) -> tuple[Trace, list[tuple[int, int]]]:
    """Two rounds through a grid of places, and the place of each step.

    Closures begin in the second third of the second round. Until then, the robot may be at several
    places.
    """
    tour = [
        (column, row)
        for column in range(columns)
        for row in (range(1, rows) if column % 2 == 0 else range(rows - 1, 0, -1))
    ]
    tour += [(column, 0) for column in reversed(range(columns))]
    way = [*tour, *tour, tour[0]]
    trace, at, poses = driven(way, random.Random(seed))
    first = dict[tuple[int, int], int]()
    closures = []
    for t, i in enumerate(at):
        if i < len(tour):
            first.setdefault(way[i], t)
        elif i >= len(tour) * 4 // 3:
            onward = displacement_between(poses[first[way[i]]], poses[t])
            closures.append(Closure(first[way[i]], t, onward, TIGHT))
    return replace(trace, closures=tuple(closures)), [way[i] for i in at]


def rounds_that_differ(seed: int, more: Sequence[int]) -> tuple[Trace, list[tuple[float, float]]]:
    """Rounds through places, and the place of each step. Some rounds have one place `more`."""
    way: list[tuple[float, float]] = []
    for one in more:
        way += [(0, 0), (1, 0), *[(2.75, 0)] * one, (3, 0), (3, 2), (0, 2)]
    way += [(0, 0), (1, 0)]
    trace, at, _ = driven(way, random.Random(seed))
    return trace, [way[i] for i in at]


def is_true(ssh_map: SSHMap, places: Sequence[object]) -> bool:
    found = [ssh_map.dstates[label].place for label in ssh_map.dstate_at]
    return all(
        (found[i] == found[j]) == (places[i] == places[j])
        for i, j in combinations(range(len(places)), 2)
    )


@pytest.mark.parametrize("seed", range(3))
def test_late_closures_correct_the_poses_of_earlier_steps(seed: int) -> None:
    trace, places = rounds(6, 4, seed)
    problem = settle(trace, BARE)
    ssh_map = smoothed_map(problem, Log(trace, problem.theory, problem.pairs))
    assert ssh_map is not None
    assert is_true(ssh_map, places)


@pytest.mark.parametrize("seed", range(3))
def test_closures_between_two_drives_make_one_map(seed: int) -> None:
    trace, places = rounds(6, 4, seed)
    half = next(c.first for c in trace.closures) + len(trace) // 2
    drives = [replace(part, closures=()) for part in (trace[:half], trace[half:])]
    both = replace(together(drives), closures=trace.closures)
    problem = settle(both, BARE)
    ssh_map = smoothed_map(problem, Log(both, problem.theory, problem.pairs))
    assert ssh_map is not None
    assert len(ssh_map.pieces) == 1
    assert is_true(ssh_map, places)


@pytest.mark.parametrize("seed", range(3))
def test_places_are_merged_before_dstates(seed: int) -> None:
    """The same action led to another place in the last round, as the robot saw one more."""
    trace, places = rounds_that_differ(seed, [0, 0, 1])
    problem = settle(trace, log_maps.BARE)
    ssh_map = smoothed_map(problem, Log(trace, problem.theory, problem.pairs))
    assert ssh_map is not None
    assert is_true(ssh_map, places)


def test_dstates_at_one_place_are_merged_only_if_that_lowers_the_cost() -> None:
    trace, _ = rounds_that_differ(1, [0, 1, 0])
    problem = settle(trace, log_maps.BARE)
    saved: list[float] = []
    merge = Overlay._merge_coinciding

    def watched(overlay: Overlay, places: set[int]) -> None:
        before = overlay._state.nats
        merge(overlay, places)
        saved.append(before - overlay._state.nats)

    with patch.object(Overlay, "_merge_coinciding", watched):
        assert smoothed_map(problem, Log(trace, problem.theory, problem.pairs)) is not None
    assert min(saved) >= 0 < max(saved)


def test_smoothing_treats_a_view_of_a_log_as_misread() -> None:
    """One view of the second round is wrong. A view of little confidence costs little."""
    trace, places = rounds(6, 4, 0)
    steps, wrong = list(trace.steps), len(trace) - 8
    steps[wrong] = replace(steps[wrong], view="w", confidence=0.9)
    trace = replace(trace, steps=tuple(steps))
    problem = settle(trace, log_maps.BARE)
    ssh_map = smoothed_map(problem, Log(trace, problem.theory, problem.pairs))
    assert ssh_map is not None
    assert is_true(ssh_map, places)
    assert [(fault.kind, fault.step, fault.cost) for fault in ssh_map.faults] == [
        ("misread", wrong, 0.4)
    ]


@pytest.mark.parametrize("seed", range(3))
def test_each_part_of_a_trace_is_smoothed(seed: int) -> None:
    """No displacement or closure leads to the last five steps, but a known link does."""
    trace, places = rounds(6, 4, seed)
    first = len(trace) - 5
    closures = tuple(c for c in trace.closures if c.last < first)
    cut = replace(trace.without_displacements_at([first]), closures=closures)
    problem = settle(cut, BARE)
    ssh_map = smoothed_map(problem, Log(cut, problem.theory, problem.pairs))
    assert ssh_map is not None
    assert is_true(ssh_map, places)


def test_search_takes_the_smoothed_map() -> None:
    trace, places = rounds(6, 4, 0)
    with patch.object(beams, "WIDTHS", ()):
        weighing = guessed(Search(trace, BARE))
    assert weighing.best is not None
    assert is_true(weighing.best.map, places)


def test_smoothed_map_is_kept_if_the_time_ends_before_its_cost_is_known() -> None:
    trace = Trace.from_steps(
        "abab", ["travel"] * 3, displacements=[(5.0, 0.0, math.pi)] * 3, odometry=Odometry()
    )
    parts = Parts(settle(trace, log_maps.BARE), Limits(), Speedups(), None, Start(), 0.0)
    weighing = Weighing(parts)
    late = patch.object(weighing.beams, "_add", side_effect=StageTimeError)
    with late, pytest.raises(StageTimeError):
        weighing.beams._smooth()
    assert parts.known.best
    assert len(parts.known.best.dstates) == 2


def test_places_of_the_best_map_of_a_broad_beam_are_merged() -> None:
    """A corridor is driven twice, with a stop halfway at the second time."""
    actions = ["travel", "around", "travel", "around", "travel", "travel"]
    moves = [(far, 0.0, 0.0 if far else math.pi) for far in (10.0, 0.0, 10.0, 0.0, 5.0, 5.0)]
    noise = Odometry(offset=0.2, facing=0.1)
    trace = Trace.from_steps([0] * 7, actions, displacements=moves, odometry=noise)
    problem = settle(trace, log_maps.BARE)
    split = completed(trace, problem.theory, range(7), [0, 1, 1, 2, 2, 3, 4], [0.0] * 7)
    parts = Parts(problem, Limits(), Speedups(), None, Start(), 0.0)
    weighing, beam = Weighing(parts), parts.candidates.beam(4)
    assert beam
    with patch.object(Candidates, "accepted", return_value=[split]):
        weighing.beams._finish(beam, 4)
    assert weighing.best
    assert [weighing.best.map.place_of(t) for t in range(7)] == [0, 1, 1, 0, 0, 2, 1]
    assert weighing.beams.found(weighing.best.nats)
