"""Beliefs from displacements and stars: against a filter with one state for each way to be away."""

from __future__ import annotations

import math
import random
from collections import defaultdict
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from ssh_abduction import Localiser, SSHMap, Trace
from ssh_abduction.data import Odometry, TraceError
from ssh_abduction.data.map_parts import DState, Fit, Pose
from ssh_abduction.data.odometry import displacement_between
from ssh_abduction.online import Belief, Chances

Array = np.ndarray[Any, Any]
ODOMETRY = Odometry(offset=0.3, facing=0.1)


def map_at(poses: list[tuple[float, float, float]], links: list[tuple[int, str, int]]) -> SSHMap:
    """A map of dstates that look alike, at these poses."""
    fit = Fit(0.0, 1, 1.0, poses=tuple(Pose(*pose) for pose in poses))
    dstates = tuple(DState(i, "v", place=i) for i in range(len(poses)))
    # A link without a name of the trace ties all dstates into one piece.
    ties = [(i, "tie", i + 1) for i in range(len(poses) - 1)]
    return SSHMap((0,), dstates, (*links, *ties), fit=fit)


def drive_of(ways: list[tuple[float, float, float]], views: str | None = None) -> Trace:
    trace = Trace.from_steps(views or "v" * (len(ways) + 1), ["on"] * len(ways), displacements=ways)
    return replace(trace, odometry=ODOMETRY)


# a filter written out from the equations


def matrix(pose: Any) -> Array:
    x, y, angle = pose
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin, x], [sin, cos, y], [0, 0, 1]])


def jacobian(move: Any, of: Any, pose: Any) -> Array:
    """The derivative of a pose after a move, by finite differences."""
    step = 1e-6
    columns = []
    for k in range(3):
        ends = [move(of, pose, sign * step * np.eye(3)[k]) for sign in (1, -1)]
        columns.append((ends[0] - ends[1]) / (2 * step))
    return np.array(columns).T


def composed(first: Any, then: Any) -> Array:
    end = matrix(first) @ matrix(then)
    return np.array([end[0, 2], end[1, 2], first[2] + then[2]])


def error(way: Any, noise: Array) -> Array:
    """The covariance of the end of a way between two dstates of a map."""
    off = np.diag([0.3**2, 0.3**2, 0.1**2])
    start = jacobian(lambda _, way, off: composed(off, way), None, way)
    return 2 * noise + off + start @ off @ start.T


def density(way: Any, noise: Array, start: Pose, end: Pose) -> float:
    between = displacement_between((start.x, start.y, start.heading), (end.x, end.y, end.heading))
    gap = np.array(between) - way
    gap[2] = math.remainder(gap[2], math.tau)
    return float(multivariate_normal.pdf(gap, cov=error(way, noise)))


def filtered(ssh_map: SSHMap, trace: Trace, chances: Chances) -> list[tuple[Array, float, float]]:
    """After each step: the probabilities of the dstates and of nowhere, and the normaliser."""
    assert ssh_map.fit is not None
    poses, n = ssh_map.fit.poses, len(ssh_map.dstates)
    ends = {x: y for x, action, y in ssh_map.links if action == "on"}
    xs, ys = ([getattr(pose, k) for pose in poses] for k in "xy")
    area = (max(xs) - min(xs) + 2) * (max(ys) - min(ys) + 2)
    usual_ways = np.array(
        [
            displacement_between(
                (poses[x].x, poses[x].y, poses[x].heading),
                (poses[y].x, poses[y].y, poses[y].heading),
            )
            for x, y in ends.items()
        ]
    )
    u, s, r = chances.unmapped, chances.slipped, chances.reentered
    # All dstates show the first view. One more unknown appearance is as probable as each of them.
    total = (1 - u) * (n + 1) / n + u
    states: dict[Any, float] = {("at", x): (1 - u) * (n + 1) / n**2 / total for x in range(n)}
    states["out"] = u / total
    found = [(np.array([states["at", x] for x in range(n)]), states["out"], total)]
    for t in range(1, len(trace)):
        way = np.array(trace.steps[t].displacement)
        length = math.hypot(way[0], way[1])
        scale = ODOMETRY.scale * np.array([way[0], way[1], 0])
        bend = ODOMETRY.bend * length * np.array([-way[1] / 2, way[0] / 2, 1])
        noise = np.array(trace.covariance(t)) + np.outer(scale, scale) + np.outer(bend, bend)
        after: dict[Any, float] = defaultdict(float)
        q = 1.0
        if ends:
            turns = usual_ways[:, 2]
            mean = math.atan2(np.mean(np.sin(turns)), np.mean(np.cos(turns)))
            centre = np.array([*usual_ways[:, :2].mean(axis=0), mean])
            gaps = usual_ways - centre
            gaps[:, 2] = [math.remainder(gap, math.tau) for gap in gaps[:, 2]]
            broad = np.diag((gaps**2).mean(axis=0)) + error(way, noise)
            gap = way - centre
            gap[2] = math.remainder(gap[2], math.tau)
            near = [density(way, noise, poses[x], poses[y]) for x, y in ends.items()]
            q = (sum(near) + multivariate_normal.pdf(gap, cov=broad)) / (len(ends) + 1)

        def anywhere(p: float, after: dict[Any, float] = after) -> None:
            for x in range(n):
                after["at", x] += p * (1 - u) / n
            after["out"] += p * u

        def away(
            p: float, x: int, way: Array, noise: Array, k: int, after: dict[Any, float] = after
        ) -> None:
            here = [(1 - u) / n * density(way, noise, poses[x], poses[y]) for y in range(n)]
            none = u / (area * math.tau)
            total = sum(here) + none
            for y in range(n):
                after["at", y] += p * here[y] / total
            after["away", x, k, tuple(way), tuple(map(tuple, noise))] += p * none / total

        for state, p in states.items():
            if state == "out":
                for x in range(n):
                    after["at", x] += p * r / n
                after["out"] += p * (1 - r)
            elif state[0] == "at" and state[1] in ends:
                x, y = state[1], ends[state[1]]
                after["at", y] += (1 - s) * p * density(way, noise, poses[x], poses[y]) / q
                away(s / 2 * p, x, way, noise, t)
                anywhere(s / 2 * p)
            elif state[0] == "at":
                away((1 - s) * p, state[1], way, noise, t)
                anywhere(s * p)
            else:
                _, x, k, before, spread = state
                one = jacobian(lambda way, pose, off: composed(pose + off, way), way, before)
                two = jacobian(lambda pose, way, off: composed(pose, way + off), before, way)
                carried = one @ np.array(spread) @ one.T + two @ noise @ two.T
                away((1 - s) * p, x, composed(before, way), carried, k)
                anywhere(s * p)
        total = sum(after.values())
        states = {state: p / total for state, p in after.items()}
        at = np.array([states.get(("at", x), 0.0) for x in range(n)])
        found.append((at, 1 - at.sum(), total))
    return found


@pytest.mark.parametrize("seed", range(20))
def test_beliefs_equal_a_filter_written_from_the_equations(seed: int) -> None:
    chance = random.Random(seed)
    n = chance.randint(2, 4)
    poses = [
        (chance.uniform(-4, 4), chance.uniform(-4, 4), chance.uniform(-3, 3)) for _ in range(n)
    ]
    starts = chance.sample(range(n), chance.randint(1, n))
    ssh_map = map_at(poses, [(x, "on", chance.randrange(n)) for x in starts])
    here, ways = chance.randrange(n), []
    for _ in range(3):
        there = chance.randrange(n)
        ways.append(displacement_between(poses[here], poses[there]))
        here = there
    ways.insert(chance.randrange(3), (chance.uniform(1, 3), chance.uniform(-1, 1), 0.3))
    trace = drive_of(ways)
    # Without views, only displacements count.
    blind = replace(trace, steps=tuple(replace(step, view=None) for step in trace.steps[1:]))
    blind = replace(trace, steps=(trace.steps[0], *blind.steps))
    chances = Chances(0.0, *(chance.uniform(0.05, 0.4) for _ in range(3)))
    mapped = replace(Trace.from_steps("v", []), odometry=ODOMETRY)
    beliefs = list(Localiser(ssh_map, trace=mapped, chances=chances).beliefs(blind))
    expected = filtered(ssh_map, blind, chances)
    for belief, (at, nowhere, normaliser) in zip(beliefs, expected, strict=True):
        assert belief.probabilities == pytest.approx(at, rel=2e-3, abs=1e-4)
        assert belief.nowhere == pytest.approx(nowhere, rel=2e-3, abs=1e-4)
        assert belief.normaliser == pytest.approx(normaliser, rel=2e-3)


# what a user sees

CORRIDOR = [(0.0, 0.0, 0.0), (4.0, 0.0, 0.0), (10.0, 0.0, 0.0), (13.0, 0.0, 0.0)]
LINKS = [(0, "on", 1), (1, "on", 2), (2, "on", 3)]


def test_displacements_tell_dstates_apart_that_look_alike() -> None:
    localiser = Localiser(map_at(CORRIDOR, LINKS))
    *_, last = localiser.beliefs(drive_of([(6.0, 0.0, 0.0), (3.0, 0.0, 0.0)]))
    assert last.dstate == 3
    assert last.probability > 0.9
    *_, last = localiser.beliefs(
        drive_of([(6.0, 0.0, 0.0), (3.0, 0.0, 0.0)]).without_displacements()
    )
    assert last.probability < 0.6


def test_robot_that_leaves_the_map_is_found_where_it_returns() -> None:
    """From dstate 3 no link leads on. The robot stops beside the map, and returns to dstate 1."""
    localiser = Localiser(map_at(CORRIDOR, LINKS))
    ways = [(6.0, 0.0, 0.0), (3.0, 0.0, 0.0), (2.0, 5.0, math.pi), (11.0, 5.0, math.pi)]
    beliefs = list(localiser.beliefs(drive_of(ways)))
    assert [belief.dstate for belief in beliefs[2:]] == [3, None, 1]
    assert beliefs[-1].probability > 0.8


def test_update_takes_a_displacement() -> None:
    localiser = Localiser(map_at(CORRIDOR, LINKS), chances=Chances.none())
    here = Belief(np.array([0.5, 0.5, 0.0, 0.0]), 0.0)
    assert localiser.update(here, "on").probabilities.tolist() == [0, 0.5, 0.5, 0]
    moved = localiser.update(here, "on", displacement=(6.0, 0.0, 0.0))
    assert moved.probabilities[2] > 0.99
    with pytest.raises(TraceError, match=r"displacement: expected \[dx, dy, dtheta\]"):
        localiser.update(here, "on", displacement=(6.0, 0.0))  # type: ignore[arg-type]


def test_pieces_of_a_map_have_no_relative_pose() -> None:
    """Dstate 1 is where the displacement leads from dstate 0, but in the frame of another piece."""
    ssh_map = map_at(CORRIDOR, [])
    apart = replace(ssh_map, links=tuple(link for link in ssh_map.links if link[0] != 0))
    here = Belief(np.array([1.0, 0.0, 0.0, 0.0]), 0.0)
    one, two = (
        Localiser(m).update(here, "on", displacement=(4.0, 0.0, 0.0)) for m in (ssh_map, apart)
    )
    assert one.dstate == 1
    assert two.dstate is None


def test_stars_tell_dstates_apart_that_look_alike() -> None:
    views, stars = "vvv", [(1, 0, 1, 0), (1, 1, 1, 0), (0, 0, 1, 0)]
    mapped = Trace.from_steps(views, ["on", "on"], stars=stars)
    ssh_map = SSHMap(
        (0, 1, 2), tuple(DState(i, "v") for i in range(3)), ((0, "on", 1), (1, "on", 2))
    )
    localiser = Localiser(ssh_map, trace=mapped)
    beliefs = list(localiser.beliefs(Trace.from_steps("vv", ["on"], stars=stars[1:])))
    assert [belief.dstate for belief in beliefs] == [1, 2]
    # After a turn the robot sees the same gateways, so they do not count again.
    turns = Trace.from_steps("vv", ["right"], stars=[(1, 1, 1, 0), (1, 1, 0, 1)])
    first, second = localiser.beliefs(turns)
    unseen = localiser.update(first, "right", "v")
    assert second.probabilities.tolist() == unseen.probabilities.tolist()
    by_hand = localiser.update(localiser.start("v", star=stars[1]), "on", "v", star=stars[2])
    assert by_hand.probabilities.tolist() == beliefs[1].probabilities.tolist()
    with pytest.raises(TraceError, match="star"):
        localiser.start("v", star=["ahead"])
