"""Grid filters obey Bayes' rule, the beam model is a distribution, and drives have truth."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from itertools import product

import grid_localisation
import numpy as np
import pytest
from grid_filter import LEAST_BLUR, BeamModel, Filter, Grid, Histogram, Particles
from grid_localisation import Case, Judged
from grid_worlds import Scene, boxes, comb, maze, rectangle, ring, taylor_hall

from simulator.robot import Laser
from simulator.world import World

pytestmark = pytest.mark.slow

WORLD = World.named("notched-rectangle")
SURE = np.diag([1e-4, 1e-4, 1e-4])


@cache
def grid() -> Grid:
    return Grid.of(WORLD, 0.1)


@pytest.mark.parametrize("expected", [0.05, 0.5, 3.0, 7.9, 8.0])
def test_the_beam_model_sums_to_one(expected: float) -> None:
    model = BeamModel()
    z = (np.arange(100_000) + 0.5) * (model.reach / 100_000)
    below = np.exp(model.log_likelihood(z, np.full(1, expected))).mean() * model.reach
    assert below + math.exp(model.log_likelihood(model.reach, np.array(expected))) == pytest.approx(
        1, abs=1e-3
    )


def test_beam_model_prefers_the_wall_then_people_before_it() -> None:
    log = BeamModel().log_likelihood(np.array([3.0, 1.0, 5.0]), np.array(3.0))
    assert log[0] > log[1] > log[2]


def test_ranges_of_a_grid_equal_those_of_the_world() -> None:
    """They agree to two cells away from walls. A beam along a wall meets a cell of it too early."""
    chosen = np.array([i for i, at in enumerate(grid().centres) if WORLD.clearance(*at) > 0.3])
    exact = Laser().exact(WORLD, np.column_stack([grid().centres[chosen], np.zeros(len(chosen))]))[
        :, 5::10
    ]  # -84.5°, -74.5°, …
    expected = grid().ranges[chosen][:, np.arange(-17, 18, 2) % 72] / 100
    assert np.mean(np.abs(exact - expected) <= 0.2) > 0.98
    assert abs(np.median(exact - expected)) < 0.1
    assert grid().free.sum() == pytest.approx(4 * 2 / 0.1**2, rel=0.1)


def test_histogram_filter_equals_brute_force_bayes() -> None:
    """A tiny grid. Its belief is computed again by a sum over all pairs of poses, each with a
    Gaussian of the displacement."""
    tiny = Grid.of(WORLD, 0.5)
    model, slipped = BeamModel(beams=30), 0.05
    belief = Histogram(tiny, model, slipped)
    poses = [(x, y, heading) for heading in tiny.angles for x, y in tiny.centres]
    p = np.full(len(poses), 1 / len(poses))
    laser, rng = Laser(), np.random.default_rng(0)
    at = (1.0, 0.8, 0.1)
    moves = [(0.5, 0.1, 0.2), (0.7, -0.1, -0.3)]
    covariance = np.diag([0.15, 0.1, 0.02])
    for displacement in (None, *moves):
        if displacement is not None:
            belief.moved(displacement, covariance)
            p = _brute_moved(tiny, poses, p, displacement, covariance, slipped)
            at = (at[0] + displacement[0], at[1] + displacement[1], at[2] + displacement[2])
        image = laser.scan(WORLD, np.array(at), rng)[0]
        belief.seen(image)
        p *= [_brute_likelihood(tiny, model, i, image) for i in range(len(poses))]
        p /= p.sum()
        assert np.allclose(belief.probability[:, tiny.free].ravel(), p, rtol=0.02, atol=2e-4)


def _brute_moved(
    tiny: Grid,
    poses: list[tuple[float, float, float]],
    p: np.ndarray,
    move: tuple[float, ...],
    covariance: np.ndarray,
    slipped: float,
) -> np.ndarray:
    """p(x') as a sum of Gaussians, one for each x, about the pose that x leads to.

    Their covariance is the sum of that of the displacement, of the heading's bin, and of the least
    blur.
    """
    dx, dy, turned = move
    xs, ys, headings = np.array(poses).T
    bin_ = math.tau / tiny.headings
    found = np.zeros(len(poses))
    aside = np.array([-dy, dx]) * bin_ / math.sqrt(12)
    for (x, y, heading), mass in zip(poses, p, strict=True):
        turn = np.array(
            [[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]]
        )
        spread = turn @ (covariance[:2, :2] + np.outer(aside, aside)) @ turn.T + (
            LEAST_BLUR * tiny.resolution
        ) ** 2 * np.eye(2)
        off = np.array([xs, ys]).T - (np.array([x, y]) + turn @ (dx, dy))
        place = np.exp(-np.einsum("ni,ij,nj->n", off, np.linalg.inv(spread), off) / 2) / (
            math.tau * math.sqrt(np.linalg.det(spread))
        )
        apart = [
            np.remainder(headings - heading - turned + math.pi, math.tau) - math.pi + k * math.tau
            for k in (-1, 0, 1)
        ]
        variance = max(covariance[2, 2], (LEAST_BLUR * bin_) ** 2)
        facing = sum(np.exp(-(a**2) / variance / 2) for a in apart) / math.sqrt(math.tau * variance)
        found += mass * place * tiny.resolution**2 * facing * bin_
    return (1 - slipped) * found / found.sum() + slipped / len(poses)


def _brute_likelihood(tiny: Grid, model: BeamModel, pose: int, image: np.ndarray) -> float:
    h, cell = divmod(pose, len(tiny.centres))
    found = 1.0
    for beam in range(15, 180, 30):
        expected = tiny.ranges[cell, (h + round((beam - 90) / 5)) % 72] / 100
        found *= math.exp(model.log_likelihood(image[beam], np.array(expected)))
    return found


@pytest.mark.parametrize("kind", [Histogram, Particles])
def test_filters_track_a_robot_and_find_a_kidnapped_one(kind: type) -> None:
    """The robot drives along a square in an asymmetric room, and then starts somewhere else."""
    world = replace(
        WORLD,
        segments=np.vstack(
            [WORLD.segments, [[1.2, 2.0, 1.2, 1.5], [1.2, 1.5, 1.6, 1.5], [1.6, 1.5, 1.6, 2.0]]]
        ),
    )
    belief: Filter = kind(Grid.of(world))
    rng = np.random.default_rng(1)
    for start in ((2.0, 0.6, 0.0), (3.2, 1.0, math.pi)):
        at, masses = start, []
        for k in range(8):
            if k:
                belief.moved((0.4, 0.0, math.pi / 2), SURE)
                at = (
                    at[0] + 0.4 * math.cos(at[2]),
                    at[1] + 0.4 * math.sin(at[2]),
                    at[2] + math.pi / 2,
                )
            belief.seen(Laser().scan(world, np.array(at), rng)[0])
            masses.append(belief.mass(at, 0.3, math.radians(15)))
        assert min(masses[-5:]) > 0.95, masses
        best = belief.best()
        assert math.hypot(best[0] - at[0], best[1] - at[1]) < 0.2
        assert belief.mass((0.3, 0.3, 0.0), 0.2, 0.1) < 0.05


def test_histogram_keeps_both_ends_of_a_symmetric_room() -> None:
    """In a plain rectangle each end keeps half of the belief, however long the robot drives."""
    world = rectangle(0.0).world
    belief = Histogram(Grid.of(world))
    rng = np.random.default_rng(2)
    for _ in range(4):
        belief.moved((0.0, 0.0, 0.0), SURE)
        belief.seen(Laser().scan(world, np.array([0.7, 0.7, 0.2]), rng)[0])
    masses = [belief.mass(pose, 0.3, 0.3) for pose in ((0.7, 0.7, 0.2), (3.3, 1.3, 0.2 + math.pi))]
    assert sum(masses) > 0.95
    assert min(masses) > 0.2


@pytest.mark.parametrize(
    "make",
    [lambda: rectangle(0.03), taylor_hall, lambda: comb(3), lambda: ring(True), lambda: maze(3, 1)],
)
def test_scene_route_tries_all_moves_and_returns_to_its_start(make: object) -> None:
    scene: Scene = make()  # type: ignore[operator]
    start, route = scene.explore
    here, tried = start, set()
    for action in route:
        tried.add((here, action))
        here = scene.moves[here][action]
    assert here == start
    assert tried == {(a, action) for a, ways in scene.moves.items() for action in ways}
    assert set(scene.moves) == {s.name for s in scene.world.dstates}
    trace = scene.driven(8, 3, boxes(1) if len(scene.moves) == 20 else None)
    at = [str(step.truth["dstate"]) for step in trace]
    assert [
        scene.moves[a][step.action.name] for a, step in zip(at, trace, strict=False) if step.action
    ] == at[1:]


def test_localised_means_five_sure_and_right_steps() -> None:
    def judged(good: str) -> Judged:
        return Judged(
            "", tuple(c in "ra" for c in good), tuple(c in "sa" for c in good), 0, 0, 0.0, 0.0
        )

    assert judged("aaaaa").localised(0, 5) == 0
    assert judged("saaaaraaaaa").localised(0, 11) == 6
    assert judged("aaaa").localised(0, 4) is None
    assert judged("ssssssaaaaa").localised(6, 11) == 0
    assert judged("rrrrrrr").localised(0, 7) is None


@pytest.mark.slow
def test_grid_benchmark_compares_all_methods_and_is_saved(
    monkeypatch: pytest.MonkeyPatch, tmp_path: object, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(grid_localisation, "STEPS", 4)
    monkeypatch.setattr(
        grid_localisation,
        "PARTS",
        {"aliasing": [Case("maze", lambda seed: maze(2, seed), people=0.5)]},
    )
    path = f"{tmp_path}/found.json"
    found = grid_localisation.measured(["aliasing"], range(1), path)
    assert grid_localisation.loaded(path) == found
    methods = found["aliasing"]["maze"][0]
    assert [judged.method for judged in methods] == [
        "dstates by image",
        "dstates by image, never nowhere",
        "dstates by view",
        "grid of 10 cm, 5°",
        "particles, grid of 10 cm, 5°",
    ]
    assert all(len(judged.right) == 8 for judged in methods)
    for ours, theirs in product(methods[:3], methods[3:]):
        assert ours.belief_bytes < theirs.belief_bytes
    assert capsys.readouterr().out.count("| maze |") == 5
