"""Streets that meet at any angles: what the robot sees, the control laws, and the maps."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
import planar
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from streets import drawn

from simulator.driver import Driver
from simulator.errors import SimulatorError
from simulator.junctions import Pilot, Place, compass, panorama
from simulator.robot import BEARINGS, Body, Laser, SimulatedRobot
from simulator.tours import simulate
from simulator.world import World
from ssh_abduction import Theory, Trace, solve
from ssh_abduction.checker.checker import check
from ssh_abduction.cli import main
from ssh_abduction.data.odometry import displacement_between
from ssh_abduction.evaluation import evaluate
from ssh_abduction.solution import Status

SHIPPED = {
    "triangle": (12, 3, 3),
    "three-ways": (16, 5, 4),
    "five-ways": (20, 6, 5),
    "six-ways": (18, 7, 3),
}
FIVE = World.named("five-ways")
REACH = 0.8


def streets(*directions: float, length: float = 6.0) -> nx.Graph:
    """A hub with a dead end in each of these directions in degrees, each farther than the last."""
    graph = planar.junction(*directions)
    for k in range(len(directions)):
        graph.nodes[k]["at"] *= length + 0.7 * k
    return graph


def bend(degrees: float) -> nx.Graph:
    """Two streets that meet. To go on, turn left by this many degrees."""
    return streets(180, degrees)


def world_of(folder: Path, graph: nx.Graph, first: tuple[object, object], **changes: Any) -> World:
    (folder / "w.json").write_text(json.dumps({**drawn(graph, REACH, first), **changes}))
    return World.load(folder / "w.json")


def exact_panorama(world: World, pose: tuple[float, float, float]) -> np.ndarray:
    """Ranges all around without noise, one a degree, counterclockwise from ahead."""
    x, y, heading = pose
    poses = [(x, y, heading + math.radians(k) - BEARINGS[90]) for k in range(360)]
    return Laser(reach=8.0).exact(world, np.array(poses))[:, 90]


# --- what a panorama shows


@settings(max_examples=5)
@given(st.integers(0, 8), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-3, 3))
def test_panorama_gives_the_streets_and_their_junction(
    shape: int, dx: float, dy: float, heading: float
) -> None:
    """Near the fixed point: streets to a degree, the fixed point to two centimetres."""
    shapes: tuple[tuple[float, ...], ...] = (
        *((0, 60), (0, 120), (0, 90, 180), (0, 120, 240), (0, 60, 180)),
        *((0, 90, 180, 270), (0, 72, 144, 216, 288), (0, 60, 120, 180, 240, 300), (0, 135)),
    )
    world = World(
        "w",
        np.vstack(
            [_segments(p) for p in drawn(streets(*shapes[shape]), REACH, ("hub", 0))["polygons"]]
        ),
    )
    place = Place.of(exact_panorama(world, (dx, dy, heading)), REACH, 8.0)
    seen = sorted(math.degrees(street.bearing + heading) % 360 for street in place.streets)
    assert len(seen) == len(shapes[shape])
    assert (
        max(
            abs(math.remainder(a - b, 360))
            for a, b in zip(
                sorted((s + 10) % 360 for s in seen), np.add(shapes[shape], 10), strict=True
            )
        )
        < 1
    )
    assert place.fixed is not None
    assert abs(complex(dx, dy) + place.fixed * np.exp(1j * heading)) < 0.02


def _segments(polygon: list[list[float]]) -> np.ndarray:
    return np.hstack([polygon, np.roll(polygon, -1, axis=0)])


def test_straight_street_is_no_place() -> None:
    world = World(
        "w",
        np.vstack([_segments(p) for p in drawn(streets(0, 175), REACH, ("hub", 0))["polygons"]]),
    )
    assert Place.of(exact_panorama(world, (0.1, 0.1, 0.3)), REACH, 8.0).fixed is None
    nothing = Place.of(np.full(360, 8.0), REACH, 8.0)
    assert (nothing.streets, nothing.fixed) == ((), None)


@settings(max_examples=5)
@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-0.03, 0.03), st.integers(0, 10**6))
def test_compass_measures_a_turn_to_half_a_degree(
    heading: float, turn: float, error: float, seed: int
) -> None:
    """Odometry is off by up to 3 % of the turn. Images measure the turn to half a degree."""
    around = exact_panorama(FIVE, (0.1, 0.2, heading))
    image = Laser().scan(FIVE, np.array([[0.1, 0.2, heading + turn]]), np.random.default_rng(seed))[
        0
    ]
    assert compass(around, image, turn * (1 + error), turn) == pytest.approx(
        turn, abs=math.radians(0.5)
    )


def test_panorama_of_noisy_images_equals_exact_ranges() -> None:
    """Images of a turning robot, with noise, and with turns that are off by 3 %."""
    rng, pose = np.random.default_rng(0), (0.1, 0.2, 0.5)
    images = []
    for k in range(25):
        image = Laser().scan(FIVE, np.array([(*pose[:2], pose[2] + math.radians(15 * k))]), rng)[0]
        images.append((math.radians(15.45), image))
    ranges, heading = panorama(images)
    assert heading == pytest.approx(math.tau, abs=math.radians(0.5))
    assert np.median(np.abs(ranges - exact_panorama(FIVE, pose))) < 0.01


# --- control laws


@pytest.mark.slow
@pytest.mark.parametrize(
    ("graph", "start"),
    [
        (bend(60), (0, "hub")),
        (bend(120), (0, "hub")),
        (bend(30), (0, "hub")),
        (streets(0, 45, 180, length=7), (0, "hub")),
        (streets(0, 90, 180), (0, "hub")),
        (streets(0, 50, 135, 180, 270), (0, "hub")),
    ],
)
def test_simulated_robot_reaches_every_dstate(
    tmp_path: Path, graph: nx.Graph, start: tuple[object, object]
) -> None:
    """Along all streets in both directions, each step is near a true dstate, with the true star."""
    world = world_of(tmp_path, graph, start, angles="any")
    trace = simulate(world, seed=3)
    true = {dstate.name: dstate.pose for dstate in world.dstates}
    assert {dstate.name.partition(" ")[0] for dstate in world.dstates} == {
        step.truth["dstate"].partition(" ")[0] for step in trace.steps
    }
    for step in trace.steps:
        x, y, heading = displacement_between(true[step.truth["dstate"]], step.truth["pose"])
        assert math.hypot(x, y) < 0.025
        assert abs(heading) < math.radians(1.5)
        here, facing = step.truth["place"], math.degrees(true[step.truth["dstate"]][2])
        ways = [
            math.degrees(d.pose[2]) for d in world.dstates if d.place == here and " to " in d.name
        ]
        expected = sorted((facing - way + 5) % 360 for way in ways)
        assert step.star is not None
        assert sorted((float(b) + 5) % 360 for b in step.star) == pytest.approx(expected, abs=2)  # type: ignore[arg-type]


@pytest.mark.slow
def test_displacement_errors_fit_their_covariances() -> None:
    """Relative to fixed points, 40 steps have a chi-square near its degrees of freedom."""
    trace = simulate(FIVE, tours=2, seed=5)
    true = {dstate.name: dstate.pose for dstate in FIVE.dstates}
    squares = []
    for before, after in zip(trace.steps, trace.steps[1:], strict=False):
        assert after.displacement is not None
        error = np.subtract(
            after.displacement,
            displacement_between(true[before.truth["dstate"]], true[after.truth["dstate"]]),
        )
        error[2] = math.remainder(error[2], math.tau)
        if before.action and before.action.kind == "travel":
            squares.append(error @ np.linalg.solve(np.array(after.covariance), error) / 3)
        else:
            squares.append(error[2] ** 2 / np.array(after.covariance)[2, 2])
    assert 0.5 < np.mean(squares) < 1.3


def test_control_never_reads_the_true_pose() -> None:
    """A robot that claims to be elsewhere, in a world shifted with it, acts the same."""
    commands: list[list[tuple[float, float]]] = []
    for shift in (0.0, 100.0):
        rng = np.random.default_rng(5)
        x, y, heading = FIVE.start
        robot = SimulatedRobot(Body(), (x + shift, y + shift, heading), rng)
        world = World("w", FIVE.segments + shift, reach=FIVE.reach)
        told: list[tuple[float, float]] = []
        honest = robot.move

        def move(forward: float, turn: float, honest: Any = honest, told: Any = told) -> None:
            told.append((forward, turn))
            honest(forward, turn)

        robot.move = move  # type: ignore[method-assign]
        pilot = Pilot(Driver(world, robot, Laser(), rng))
        pilot.begin()
        for action in ("travel", "around", "travel", "right"):
            pilot.act(action)
        commands.append(told)
    np.testing.assert_allclose(commands[0], commands[1], atol=1e-6)


@pytest.mark.parametrize(
    ("route", "message"),
    [
        (
            ["travel", "travel"],
            r"travel at \(.*\): expected a free way ahead, got a wall; change the route",
        ),
        (["travel", "right"], r"right at \(.*\): expected a street to the right, got none"),
    ],
)
def test_simulator_refuses_routes_that_cannot_be_driven(
    tmp_path: Path, route: list[str], message: str
) -> None:
    with pytest.raises(SimulatorError, match=message):
        simulate(world_of(tmp_path, streets(0, 60), ("hub", 0), route=[*route, "around"]))


def test_simulator_refuses_a_start_that_is_no_place(tmp_path: Path) -> None:
    with pytest.raises(
        SimulatorError,
        match=(
            r"start at .*: expected a place, where streets meet or end, got a street that goes "
            r"straight on"
        ),
    ):
        simulate(world_of(tmp_path, streets(0, 60, length=8), ("hub", 0), start=[4, 0, 0]))
    with pytest.raises(
        SimulatorError, match=r"expected a street, about 0\.8 m wide, got none; give another reach"
    ):
        simulate(world_of(tmp_path, streets(0, 60), ("hub", 0), reach=0.4))


def test_walls_decide_between_right_and_any_angles(tmp_path: Path) -> None:
    assert World.named("notched-rectangle").angles == World.named("taylor-hall").angles == "right"
    assert all(World.named(name).angles == "any" for name in SHIPPED)
    assert (
        world_of(tmp_path, streets(20, 110, 200), ("hub", 0)).angles == "right"
    )  # Turned as a whole.
    column = [[1, 0], [1.1, 0.1], [1, 0.2], [0.9, 0.1]]
    assert (
        world_of(
            tmp_path,
            streets(0, 90),
            ("hub", 0),
            polygons=[[[0, 0], [9, 0], [9, 9], [0, 9]], column],
        ).angles
        == "right"
    )
    assert world_of(tmp_path, streets(0, 90), ("hub", 0), angles="any").angles == "any"


def test_simulator_takes_images_at_even_distances() -> None:
    trace = simulate(FIVE, seed=7, every=1.0)
    assert len(trace) == pytest.approx(2 * 32 / 1.0, rel=0.25)
    assert all(step.action is None or step.action.name == "travel" for step in trace.steps)


# --- maps


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "tours", "seed"),
    [
        ("triangle", 2, 1),
        ("three-ways", 1, 3),
        pytest.param("five-ways", 1, 4, marks=pytest.mark.slow),
        pytest.param("six-ways", 1, 5, marks=pytest.mark.slow),
    ],
)
def test_simulated_images_give_one_true_map(
    name: str, tours: int, seed: int, tmp_path: Path
) -> None:
    """simulate, cluster and solve, as a user would: one minimal map, which is the true one."""
    run, views = str(tmp_path / "run.jsonl"), str(tmp_path / "views.jsonl")
    assert main(["simulate", name, "--tours", str(tours), "--seed", str(seed), "-o", run]) == 0
    assert main(["cluster", run, "-o", views]) == 0
    trace = Trace.load(views)
    solution = solve(trace, Theory(weigh="count"))
    assert (solution.status, solution.complete, len(solution.maps)) == (Status.OPTIMAL, True, 1)
    ssh_map = solution.maps[0]
    assert (len(ssh_map.dstates), len(ssh_map.places), len(ssh_map.paths)) == SHIPPED[name]
    assert check(trace, ssh_map) == ()
    (found,) = evaluate(solution.maps, trace).maps
    assert found.isomorphic
