"""The simulator: worlds, laser, robot, control laws, tours."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import reported

from simulator.driver import LONG, Driver, Tolerance, act, climb, sight
from simulator.errors import SimulatorError
from simulator.robot import BEARINGS, Body, Laser, SimulatedRobot
from simulator.tours import covariance_of, simulate
from simulator.world import World
from ssh_abduction import Trace
from ssh_abduction.data import Odometry
from ssh_abduction.data.odometry import checked_covariance, displacement_between, moved

RECTANGLE = World.named("notched-rectangle")
HALL = World.named("taylor-hall")
ROOM: dict[str, Any] = {
    "format": "ssh-world",
    "version": 1,
    "polygons": [[[0, 0], [4, 0], [4, 2], [0, 2]]],
    "start": [3.4, 1.4, 0],
    "reach": 0.6,
    "route": ["right", "travel"] * 4,
}


def world_of(folder: Path, **changes: Any) -> World:
    path = folder / "world.json"
    path.write_text(json.dumps({**ROOM, **changes}))
    return World.load(path)


def poses_by_dstate(trace: Trace) -> dict[str, np.ndarray]:
    found: dict[str, list[list[float]]] = {}
    for step in trace.steps:
        found.setdefault(step.truth["dstate"], []).append(step.truth["pose"])
    return {name: np.array(poses) for name, poses in found.items()}


@pytest.fixture(scope="module")
def circuits() -> Trace:
    return simulate(RECTANGLE, tours=6, seed=1000)


@pytest.fixture(scope="module")
def tours() -> Trace:
    return simulate(HALL, tours=1, seed=1000)


# Laser


def by_hand(world: World, pose: tuple[float, float, float], bearing: float, reach: float) -> float:
    """One beam, wall by wall, with the formula for two lines."""
    x, y, heading = pose
    dx, dy = math.cos(heading + bearing), math.sin(heading + bearing)
    nearest = reach
    for x1, y1, x2, y2 in world.segments:
        ex, ey = x2 - x1, y2 - y1
        across = dx * ey - dy * ex
        if abs(across) < 1e-12:
            continue
        r = ((x1 - x) * ey - (y1 - y) * ex) / across
        s = ((x1 - x) * dy - (y1 - y) * dx) / across
        if r > 0 and 0 <= s <= 1:
            nearest = min(nearest, r)
    return nearest


@settings(max_examples=15)
@given(st.floats(0.3, 3.7), st.floats(0.3, 1.7), st.floats(-4, 4))
def test_ranges_equal_those_computed_beam_by_beam(x: float, y: float, heading: float) -> None:
    ranges = Laser().exact(RECTANGLE, np.array([[x, y, heading]]))[0]
    expected = [by_hand(RECTANGLE, (x, y, heading), b, 8.0) for b in BEARINGS]
    np.testing.assert_allclose(ranges, expected, atol=1e-9)


def test_ranges_of_many_poses_equal_those_of_single_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    poses = np.random.default_rng(0).uniform([0.3, 0.3, -3], [3.7, 1.7, 3], (50, 3))
    together = Laser().exact(RECTANGLE, poses)
    monkeypatch.setattr("simulator.robot._BLOCK", 180 * 8 * 7)
    np.testing.assert_array_equal(Laser().exact(RECTANGLE, poses), together)
    np.testing.assert_array_equal(
        np.vstack([Laser().exact(RECTANGLE, pose) for pose in poses]), together
    )


def test_first_beam_is_on_the_right() -> None:
    ranges = Laser().exact(RECTANGLE, np.array([[1.0, 0.5, 0.0]]))[0]
    assert ranges[0] == pytest.approx(0.5, abs=0.01)
    assert ranges[-1] == pytest.approx(1.5, abs=0.01)


def test_laser_has_noise_dropouts_and_reach() -> None:
    laser, rng = Laser(noise=0.01, reach=3.0, dropouts=0.02), np.random.default_rng(0)
    pose = np.array([[1.0, 1.0, 0.0]])
    scans = laser.scan(RECTANGLE, np.repeat(pose, 2000, axis=0), rng)
    exact = laser.exact(RECTANGLE, pose)[0]
    near = exact < 2.5
    assert scans.max() == 3.0
    lost = (scans[:, near] == 3.0).mean()
    assert 0.015 < lost < 0.025
    errors = (scans - exact)[:, near][scans[:, near] < 3.0]
    assert abs(errors.mean()) < 0.001
    assert 0.0095 < errors.std() < 0.0105


# Worlds


def test_shipped_worlds_have_the_documented_sizes() -> None:
    assert len(RECTANGLE.dstates) == 8
    assert (
        len({s.place for s in RECTANGLE.dstates}) == len({s.path for s in RECTANGLE.dstates}) == 4
    )
    assert len(HALL.dstates) == 20
    assert len({s.place for s in HALL.dstates}) == 7
    assert len({s.path for s in HALL.dstates}) == 4
    assert len(HALL.route) == 24


def test_occupancy_map_becomes_a_world(tmp_path: Path) -> None:
    cells = np.full((24, 44), 254, np.uint8)
    cells[[0, 1, -2, -1]] = cells[:, [0, 1, -2, -1]] = 0
    for head, body in (
        (b"P5 44 24 255\n", cells.tobytes()),
        (b"P2\n# drawn by hand\n44 24\n255\n", " ".join(map(str, cells.ravel())).encode()),
    ):
        (tmp_path / "map.pgm").write_bytes(head + body)
        (tmp_path / "map.yaml").write_text(
            "image: map.pgm\nresolution: 0.1\norigin: [-0.2, -0.2, 0.0]\nnegate: "
            "0\noccupied_thresh: 0.65\n"
        )
        world = World.named(str(tmp_path / "map.yaml"))
        assert world.bounds == pytest.approx((-0.2, -0.2, 4.2, 2.2))
        ranges = Laser().exact(world, np.array([[1.0, 0.5, 0.0]]))[0]
        assert ranges[0] == pytest.approx(0.5, abs=0.01)
        assert ranges[-1] == pytest.approx(1.5, abs=0.01)
        driven = simulate(
            world.with_choices(
                "3.4,1.4,0", "right,travel,right,travel,right,travel,right,travel", 0.6
            ),
            tours=2,
        )
        assert len(driven) == 16


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "map"}, "format: expected"),
        ({"version": 2}, "format: expected"),
        ({"polygons": []}, "polygons: expected at least one wall"),
        ({"polygons": [[[0, 0], [1, 1]]]}, r"polygons\[0\]: expected at least three points"),
        (
            {"polygons": [[[0, 0], [1, 1], [0, "a"]]]},
            r"polygons\[0\]\[2\]: expected 2 finite numbers",
        ),
        ({"segments": [[1, 2, 3]]}, r"segments\[0\]: expected 4 finite numbers"),
        ({"route": ["fly"]}, r"route\[0\]: expected travel, right, left or around"),
        ({"reach": 0}, "reach: expected metres above 0"),
        ({"angles": 60}, 'angles: expected "right" or "any"'),
        ({"start": [1]}, "start: expected 3 finite numbers"),
        ({"clutter": [3]}, r"clutter\[0\]: expected an object"),
        (
            {"clutter": [{"polygon": [[0, 0], [1, 0], [1, 1]], "present": 2}]},
            r"clutter\[0\].present: expected a probability",
        ),
        ({"lifts": [{"from": [0, 0]}]}, r"lifts\[0\]: expected an object with name"),
        (
            {"lifts": [{"name": "up", "from": [0, 0], "to": [1]}]},
            r"lifts\[0\].to: expected 2 finite numbers",
        ),
        (
            {"lifts": [{"name": "left", "from": [0, 0], "to": [1, 1]}]},
            r"lifts\[0\].name: expected a name without commas that is no action",
        ),
        ({"dstates": [{"name": "a"}]}, r"dstates\[0\].place: expected a text"),
    ],
)
def test_malformed_world_is_refused_with_its_field(
    changes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(SimulatorError, match=message):
        world_of(tmp_path, **changes)


def test_unknown_world_names_are_refused(tmp_path: Path) -> None:
    with pytest.raises(
        SimulatorError,
        match=(
            "expected one of cluttered, curved, doors, five-ways, notched-rectangle, six-ways, "
            "taylor-hall, three-ways, tower-2, tower-3, triangle, or a file"
        ),
    ):
        World.named("atlantis")
    with pytest.raises(SimulatorError, match="check the path"):
        World.named(str(tmp_path / "no.json"))
    (tmp_path / "broken.json").write_text("{")
    with pytest.raises(SimulatorError, match="expected a world in JSON"):
        World.named(str(tmp_path / "broken.json"))
    for choice in ({"start": "a,b"}, {"start": "1,2"}, {"route": "up"}, {"reach": -1.0}):
        with pytest.raises(SimulatorError):
            RECTANGLE.with_choices(**choice)  # type: ignore[arg-type]


# Sight and control


@settings(max_examples=30)
@given(st.floats(0.45, 0.75), st.floats(0.45, 0.75), st.floats(-12, 12), st.sampled_from(range(4)))
def test_sight_measures_distances_and_tilt_of_a_corner(
    ahead: float, left: float, degrees: float, corner: int
) -> None:
    """Facing each corner of a room: distances and tilt, to a few millimetres and 0.1 degrees.

    A robot turned to the right sees less of the wall on its left than of the wall ahead. If that is
    less than 0.4 m, the wall may be missing.
    """
    quarter = -corner * math.pi / 2
    room = np.array([[0, 0, 4, 0], [4, 0, 4, 2], [4, 2, 0, 2], [0, 2, 0, 0]], float)
    sizes = [(4 - ahead, 2 - left), (4 - left, ahead), (ahead, left), (left, 2 - ahead)]
    pose = (*sizes[corner], quarter + math.radians(degrees))
    image = Laser().scan(
        replace(RECTANGLE, segments=room), np.repeat([pose], 9, axis=0), np.random.default_rng(0)
    )
    seen = sight(np.median(image, axis=0), 0.6, 8.0)
    assert seen.front == pytest.approx(ahead, abs=0.01)
    if seen.left is not None or ahead + left * math.tan(math.radians(degrees)) > LONG + 0.05:
        assert seen.left == pytest.approx(left, abs=0.01)
        assert seen.offset(0.6) == pytest.approx(0.6 - left, abs=0.01)
    assert math.degrees(seen.tilt) == pytest.approx(degrees, abs=0.5)
    assert seen.to_go(0.6) == pytest.approx(ahead - 0.6, abs=0.01)


def test_sight_of_an_empty_image_is_empty() -> None:
    seen = sight(np.full(180, 8.0), 1.0, 8.0)
    assert (seen.front, seen.left, seen.right, seen.to_go(1.0), seen.offset(1.0)) == (
        None,
        None,
        None,
        None,
        None,
    )


@settings(max_examples=13)
@given(st.floats(-0.05, 0.05), st.floats(-0.012, 0.012), st.floats(-10, 10), st.integers(0, 10**6))
def test_hill_climbing_ends_at_the_fixed_point(
    dx: float, dy: float, degrees: float, seed: int
) -> None:
    """From anywhere near x0, the robot reaches the tolerance of the control law."""
    rng = np.random.default_rng(seed)
    robot = SimulatedRobot(Body(), (3.4 + dx, 1.4 + dy, math.radians(degrees)), rng)
    climb(Driver(RECTANGLE, robot, Laser(), rng))
    x, y, heading = robot.pose
    assert abs(x - 3.4) < 0.025
    assert abs(y - 1.4) < 0.04
    assert abs(math.degrees(heading)) < 1.5


def test_control_never_reads_the_true_pose() -> None:
    """The same scans give the same commands, even if the robot claims another pose."""
    commands: list[list[tuple[float, float]]] = []
    for lie in (False, True):
        rng = np.random.default_rng(5)
        robot = SimulatedRobot(Body(), RECTANGLE.start, rng)
        driver = Driver(RECTANGLE, robot, Laser(), rng)
        told: list[tuple[float, float]] = []
        honest = robot.move

        def move(forward: float, turn: float, honest: Any = honest, told: Any = told) -> None:
            told.append((forward, turn))
            honest(forward, turn)

        robot.move = move  # type: ignore[method-assign]
        if lie:
            shift = np.array([100.0, 50.0, 100.0, 50.0])
            driver.world = replace(RECTANGLE, segments=RECTANGLE.segments + shift)
            robot.pose = (robot.pose[0] + 100.0, robot.pose[1] + 50.0, robot.pose[2])
        for action in ("right", "travel", "right", "travel"):
            act(driver, action)
        commands.append(told)
    np.testing.assert_allclose(commands[0], commands[1], atol=1e-6)


# Tours


@pytest.mark.slow
def test_simulated_tour_reaches_dstates_in_order(circuits: Trace) -> None:
    assert [step.truth["dstate"] for step in circuits.steps] == [f"x{i % 8}" for i in range(48)]
    assert [a.name for a in circuits.actions[:8]] == list(RECTANGLE.route)
    reached = [step.truth["dstate"] for step in simulate(HALL, tours=2, seed=1000)]
    once = reached[:24]
    assert reached == once * 2
    assert len(set(once)) == 20


def test_hill_climbing_keeps_errors_bounded(circuits: Trace) -> None:
    """The spread of poses at the dstates is the same in the first and the last six circuits."""
    for poses in poses_by_dstate(circuits).values():
        off = np.abs(poses[:, :2] - poses[:, :2].mean(0)).max(1)
        assert off.max() < 0.025
        assert np.abs(np.unwrap(poses[:, 2]) - np.unwrap(poses[:, 2]).mean()).max() < math.radians(
            2
        )
    first = np.array(
        [np.abs(p[:6, :2] - p[:, :2].mean(0)).mean() for p in poses_by_dstate(circuits).values()]
    )
    last = np.array(
        [np.abs(p[-6:, :2] - p[:, :2].mean(0)).mean() for p in poses_by_dstate(circuits).values()]
    )
    assert last.mean() < 1.5 * first.mean()


def test_errors_grow_without_hill_climbing() -> None:
    """The test above can fail: after two sides by dead reckoning, the corner is lost."""
    rng = np.random.default_rng(0)
    ends = []
    for _ in range(30):
        robot = SimulatedRobot(Body(), (3.4, 1.4, -math.pi / 2), rng)
        for forward, turn in ((0.8, 0.0), (0.0, -math.pi / 2), (2.8, 0.0)):
            robot.move(forward, turn)
        ends.append(robot.pose[:2])
    assert np.std(ends, axis=0).max() > 0.05


def test_odometry_drifts_away_from_the_truth() -> None:
    rng = np.random.default_rng(0)
    robot = SimulatedRobot(Body(), (0.0, 0.0, 0.0), rng)
    for _ in range(200):
        robot.move(0.1, 0.05)
    assert math.dist(robot.pose[:2], robot.odometry[:2]) > 0.001


# Odometry

POSES = st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-3, 3))
SQUARE = 2 * (
    [(0.15, 0.01)] * 20 + [(0.0, -math.pi / 2)]
)  # Two sides of a square, in strides and turns.


def whitened(error: Any, covariance: Any) -> np.ndarray:
    """An error, (3,), in standard deviations: three independent numbers."""
    error = np.array([error[0], error[1], math.remainder(error[2], math.tau)])
    return np.asarray(np.linalg.solve(np.linalg.cholesky(np.array(covariance)), error))


def errors_of(trace: Trace, poses: list[tuple[float, float, float]], kind: str) -> np.ndarray:
    """Errors of displacements of some actions, (n, 3), in standard deviations."""
    found = []
    for before, after, step, action in zip(
        poses, poses[1:], trace.steps[1:], trace.actions, strict=False
    ):
        assert step.displacement is not None
        if action.kind == kind:
            errors = np.subtract(step.displacement, displacement_between(before, after))
            found.append(whitened(errors, step.covariance))
    return np.array(found)


def fixed_points(trace: Trace) -> list[tuple[float, float, float]]:
    """The mean position at the place and the mean heading at the dstate of each step."""
    places: dict[str, list[list[float]]] = {}
    for step in trace.steps:
        places.setdefault(step.truth["place"], []).append(step.truth["pose"][:2])
    middle = {place: np.mean(found, 0) for place, found in places.items()}
    heading = {
        name: math.atan2(np.sin(p[:, 2]).mean(), np.cos(p[:, 2]).mean())
        for name, p in poses_by_dstate(trace).items()
    }
    return [
        (*map(float, middle[step.truth["place"]]), heading[step.truth["dstate"]])
        for step in trace.steps
    ]


@settings(max_examples=25)
@given(POSES, POSES)
def test_displacement_between_poses_inverts_moved(
    start: tuple[float, float, float], end: tuple[float, float, float]
) -> None:
    x, y, heading = moved(start, displacement_between(start, end))
    assert (x, y) == pytest.approx(end[:2], abs=1e-9)
    assert math.remainder(heading - end[2], math.tau) == pytest.approx(0, abs=1e-9)


def test_reported_noise_has_the_stated_covariance() -> None:
    rng, displacement, odometry = (
        np.random.default_rng(0),
        (6.0, -8.0, 0.5),
        Odometry(along=0.05, across=0.01, heading=0.01),
    )
    told = np.array([reported(displacement, odometry, rng) for _ in range(4000)])
    np.testing.assert_allclose(told.mean(0), displacement, atol=0.03)
    np.testing.assert_allclose(np.cov(told.T), odometry.covariance(displacement), atol=0.015)


def test_constant_drift_bends_a_line_into_an_arc() -> None:
    """After ten metres straight ahead, reported 10 % too long, the heading is off by 10 bends."""
    exact, rng = Odometry(0, 0, 0, 0, 0, 0, 0, 0), np.random.default_rng(0)
    pose = (0.0, 0.0, 0.0)
    for _ in range(100):
        pose = moved(pose, reported((0.1, 0.0, 0.0), exact, rng, scale=0.1, bend=0.02))
    at_once = reported((10.0, 0.0, 0.0), exact, rng, scale=0.1, bend=0.02)
    arc = (11.0 * math.sin(0.2) / 0.2, 11.0 * (1 - math.cos(0.2)) / 0.2, 0.2)
    np.testing.assert_allclose(pose, arc, atol=0.1)
    np.testing.assert_allclose(at_once, arc, atol=0.1)


def test_covariance_of_a_report_equals_that_of_its_errors() -> None:
    rng = np.random.default_rng(0)
    errors = []
    for _ in range(600):
        robot = SimulatedRobot(Body(), (1.0, 2.0, 0.7), rng)
        robot.move(0.3, 0.2)
        robot.report()
        start = robot.pose
        for motion in SQUARE:
            robot.move(*motion)
        displacement, covariance = robot.report()
        off = np.subtract(displacement, displacement_between(start, robot.pose))
        errors.append(whitened(off, covariance))
    found = np.array(errors)
    np.testing.assert_allclose(found.mean(0), 0, atol=0.15)
    np.testing.assert_allclose(np.cov(found.T), np.eye(3), atol=0.2)


def test_rounded_covariances_of_steps_are_positive_definite() -> None:
    """After turns on the spot, the error across the way is nearly that of the heading."""
    rng, exact = np.random.default_rng(0), Tolerance(1e-3, 1e-3)
    for _ in range(20):
        robot = SimulatedRobot(Body(), (0.0, 0.0, 0.0), rng)
        for motion in [(0.0, 1.57)] * 4 + [(0.15, 0.0)] * 17:
            robot.move(*motion)
        checked_covariance(covariance_of(*robot.report(), exact))


def test_wheel_errors_scale_distances_and_bend_the_track() -> None:
    robot = SimulatedRobot(
        Body(slip=0, wander=0, odometry=0, scale=0.1, bend=0.02),
        (0.0, 0.0, 0.0),
        np.random.default_rng(0),
    )
    for _ in range(50):
        robot.move(0.2, 0.0)
    assert robot.pose == pytest.approx((10.0, 0.0, 0.0))
    assert robot.driven == pytest.approx(11.0)
    assert robot.report()[0] == pytest.approx(
        (11.0 * math.sin(0.2) / 0.2, 11.0 * (1 - math.cos(0.2)) / 0.2, 0.2), abs=0.01
    )
    for _ in range(50):
        robot.move(-0.2, 0.0)
    assert robot.odometry == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)


@pytest.mark.slow
def test_displacements_equal_motions_between_dstates(circuits: Trace, tours: Trace) -> None:
    """Displacements of wheels lead between true poses; those of a map lead between fixed points."""
    for trace in (circuits, tours):
        assert trace.steps[0].displacement is None
        turns = errors_of(trace, [tuple(step.truth["pose"]) for step in trace.steps], "turn")[:, 2]
        assert abs(turns.mean()) < 0.5
        assert 0.5 < (turns**2).mean() < 1.5
        travels = errors_of(trace, fixed_points(trace), "travel")
        assert np.abs(travels.mean(0)).max() < 0.5
        assert 0.15 < (travels**2).mean() < 1.2


@pytest.mark.slow
def test_trace_declares_scale_and_drift_of_the_body() -> None:
    plain = simulate(RECTANGLE, 5, seed=7)
    trace = simulate(RECTANGLE, 5, seed=7, body=Body(scale=0.1, bend=0.0035))
    assert trace.odometry is not None
    assert (trace.odometry.scale, trace.odometry.bend) == (0.1, 0.0035)
    assert [step.truth["dstate"] for step in trace.steps] == [
        step.truth["dstate"] for step in plain.steps
    ]
    pairs = [
        (a, b)
        for a, b, action in zip(trace.steps, trace.steps[1:], trace.actions, strict=False)
        if action.kind == "travel"
    ]
    told = sum(math.hypot(*b.displacement[:2]) for _, b in pairs if b.displacement)
    true = sum(math.dist(a.truth["pose"][:2], b.truth["pose"][:2]) for a, b in pairs)
    assert told / true == pytest.approx(1.1, abs=0.01)


@pytest.mark.parametrize(
    ("name", "value"), [("scale", 0.6), ("bend", -0.7), ("odometry", -0.1), ("scale", math.nan)]
)
def test_body_refuses_extreme_odometry_errors(name: str, value: float) -> None:
    with pytest.raises(
        SimulatorError,
        match=rf"body\.{name}: expected a number from .* to 0\.5.*, got .*; choose a smaller error",
    ):
        Body(**{name: value})


def test_stars_equal_the_true_openings(tours: Trace) -> None:
    straight = {"P1": "ES", "P2": "EWS", "P3": "EWS", "E": "W", "D1": "N", "D2": "N", "D3": "N"}
    headings = {"north": "NESW", "east": "ESWN", "south": "SWNE", "west": "WNES"}
    for step in tours.steps:
        place, heading = step.truth["dstate"].split()
        assert step.star == tuple(float(side in straight[place]) for side in headings[heading])


def test_equal_seeds_give_equal_traces() -> None:
    assert simulate(RECTANGLE, 2, seed=7) == simulate(RECTANGLE, 2, seed=7)
    assert simulate(RECTANGLE, 2, seed=7) != simulate(RECTANGLE, 2, seed=8)


def test_simulated_traces_survive_a_round_trip(tmp_path: Path) -> None:
    trace = simulate(RECTANGLE, 2, seed=7)
    trace.save(tmp_path / "run.jsonl")
    assert Trace.load(tmp_path / "run.jsonl") == trace
    assert trace.steps[-1].action is None
    assert all(step.view is None for step in trace.steps)


def test_simulate_every_takes_images_at_even_distances() -> None:
    trace = simulate(RECTANGLE, 3, seed=7, every=0.5)
    poses = np.array([step.truth["pose"][:2] for step in trace.steps])
    assert len(trace) == pytest.approx(3 * 7.2 / 0.5, rel=0.15)
    assert np.median(np.hypot(*np.diff(poses, axis=0).T)) == pytest.approx(0.5, abs=0.15)


def test_clutter_moves_between_tours_only() -> None:
    rng = np.random.default_rng(0)
    one, other = HALL.arranged(rng), HALL.arranged(rng)
    assert one.segments.shape[0] - len(HALL.segments) in range(
        4 * (len(HALL.clutter) - 1), 4 * len(HALL.clutter) + 1
    )
    assert not np.array_equal(one.segments[-40:], other.segments[-40:])
    np.testing.assert_array_equal(one.segments[: len(HALL.segments)], HALL.segments)


# What cannot be driven


def test_start_inside_a_wall_is_refused(tmp_path: Path) -> None:
    for start in ([0.1, 1, 0], [4, 1, 0], [9, 9, 0]):
        with pytest.raises(SimulatorError, match=r"start: expected a place 0\.2 m off the walls"):
            simulate(world_of(tmp_path, start=start))


def test_route_into_a_wall_is_refused(tmp_path: Path) -> None:
    with pytest.raises(
        SimulatorError,
        match=r"travel at \(3\.\d\d, 1\.\d\d\): expected a free way ahead, got a wall",
    ):
        simulate(world_of(tmp_path, route=["travel"]), tours=2)


def test_world_with_a_gap_in_its_walls_is_refused(tmp_path: Path) -> None:
    corridor = {
        "polygons": [],
        "segments": [[0, 0, 9, 0], [0, 2, 9, 2], [0, 0, 0, 2]],
        "start": [1, 1, 0],
        "reach": 1.0,
        "route": ["travel"],
    }
    with pytest.raises(
        SimulatorError, match=r"the robot left the world at \(9\.\d+, 1\.\d+\); close the gap"
    ):
        simulate(world_of(tmp_path, **corridor), tours=2)


def test_empty_route_and_zero_tours_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SimulatorError, match="route: expected at least one action"):
        simulate(world_of(tmp_path, route=[]))
    with pytest.raises(SimulatorError, match="tours: expected a whole number from 1 to 100,000"):
        simulate(RECTANGLE, tours=0)
    for every in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(SimulatorError, match="every: expected a number of metres above 0"):
            simulate(RECTANGLE, every=every)
