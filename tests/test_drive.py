"""Drives as robots log them: scans, an odometer that drifts, and the truth about places."""

from __future__ import annotations

import gzip
import json
import math
from dataclasses import replace
from itertools import groupby, pairwise
from pathlib import Path

import numpy as np
import pytest
from test_plans import SCHOOLS, plan_of, xml

from perception.readers.logs import read_log
from simulator.cruise import FreeSpace, drive_along
from simulator.driver import Driver
from simulator.errors import SimulatorError, SimulatorWarning
from simulator.plans import Plan
from simulator.robot import Body, Laser, Odometer, Recorder, SimulatedRobot
from simulator.rounds import Building, Rooms, Round, holds, record_plan
from simulator.tours import record, simulate
from simulator.world import World
from ssh_abduction.cli import main
from ssh_abduction.data.odometry import displacement_between

RECTANGLE, HALL = World.named("notched-rectangle"), World.named("taylor-hall")
# The two ends of a corridor.
ENDS = np.array([(1.0, 1.5), (11.0, 1.5)])


@pytest.fixture
def ring(tmp_path: Path) -> Building:
    """Four rooms in a ring, and a closet, each 9.8 m wide."""
    return Building.of(plan_of(tmp_path, xml()))


def steps_of(poses: np.ndarray) -> list[tuple[float, float, float]]:
    return [displacement_between(tuple(a), tuple(b)) for a, b in pairwise(poses)]


def test_odometer_errors_equal_its_stated_noise() -> None:
    """Noise grows with the square root of a motion, and the mean shows the systematic errors.

    Measured over many drives of 9 m straight ahead, and of two radians on the spot.
    """
    odometer, rng = (
        Odometer(along=0.04, across=0.03, heading=0.0, turning=0.05, scale=0.1, bend=0.01),
        np.random.default_rng(0),
    )
    line = np.column_stack([1 + 3 * np.linspace(0, 3, 31), np.full(31, 2.0), np.zeros(31)])
    ends = np.array(
        [
            Odometer(along=0.04, across=0.03, heading=0.0, scale=0.1).reading(line, rng)[-1]
            for _ in range(2000)
        ]
    )
    np.testing.assert_allclose(ends.mean(0), (9.9, 0.0, 0.0), atol=0.02)
    np.testing.assert_allclose(ends.std(0), (0.04 * 3, 0.03 * 3, 0.0), rtol=0.07)
    spin = np.column_stack([np.zeros((31, 2)), np.linspace(0, 2, 31)])
    ends = np.array([odometer.reading(spin, rng)[-1] for _ in range(2000)])
    np.testing.assert_allclose(ends.mean(0), (0.0, 0.0, 2.0), atol=0.01)
    np.testing.assert_allclose(ends.std(0), (0.0, 0.0, 0.05 * math.sqrt(2)), rtol=0.07)
    assert odometer.reading(line, rng)[-1, 2] == pytest.approx(
        0.09, abs=1e-9
    )  # The bend, in each metre.


def test_exact_odometer_reports_true_motions() -> None:
    rng = np.random.default_rng(0)
    poses = np.cumsum(rng.normal(size=(50, 3)), axis=0)
    read = Odometer(0, 0, 0, 0).reading(poses, rng)
    np.testing.assert_allclose(steps_of(read), steps_of(poses), atol=1e-9)


@pytest.mark.parametrize("field", ["along", "across", "heading", "turning", "scale", "bend"])
def test_a_wrong_odometer_names_its_field(field: str) -> None:
    for value in (float("nan"), 3.0, "much", -2.0):
        with pytest.raises(SimulatorError, match=rf"odometer\.{field}: expected a number"):
            Odometer(**{field: value})  # type: ignore[arg-type]


def test_scans_are_taken_at_even_distances() -> None:
    """Also within a long motion, the next scan is at most a fifth too late."""
    recorder = Recorder(every=0.3)
    for pose in (
        (1.0, 1.0, 0.0),
        (3.0, 1.0, 0.0),
        (3.0, 1.0, 3.0),
        (3.1, 1.0, 3.0),
        (3.15, 1.0, 3.0),
    ):
        recorder.note(RECTANGLE, pose)
    drive = recorder.drive(
        "by hand", Laser(noise=0.0, dropouts=0.0, reach=2.5), Odometer(0, 0, 0, 0), 0
    )
    for dx, dy, turned in steps_of(drive.poses):
        assert math.hypot(dx, dy) < 0.3 * 1.2
        assert abs(turned) < math.radians(10) * 1.2
    assert drive.metres == pytest.approx(2.15)
    np.testing.assert_allclose(drive.poses[[0, -1]], [(1.0, 1.0, 0.0), (3.0, 1.0, 3.0)], atol=0.2)
    seen = Laser(noise=0.0, dropouts=0.0, reach=2.5).exact(RECTANGLE, drive.poses)
    np.testing.assert_array_equal(drive.ranges, np.where(seen < 2.5, seen, np.inf))
    assert np.isinf(drive.ranges[0]).any()
    assert (np.diff(drive.times) > 0).all()
    with pytest.raises(SimulatorError, match=r"every: expected metres, 0\.01 or more, got 0"):
        Recorder(every=0.0)


def test_truth_of_a_drive_lists_visits_and_dstates() -> None:
    drive = record(RECTANGLE, tours=2, seed=1)
    assert [visit["place"] for visit in drive.truth["visits"]] == ["A", "B", "C", "D"] * 2 + ["A"]
    for visit in drive.truth["visits"]:
        x, y = drive.truth["places"][visit["place"]]
        near = [
            math.dist(pose[:2], (x, y)) for pose in drive.poses[visit["first"] : visit["last"] + 1]
        ]
        assert max(near) <= RECTANGLE.reach
        assert min(near) < 0.2
    assert [step["dstate"] for step in drive.truth["steps"]] == [f"x{i % 8}" for i in range(16)]
    again = record(RECTANGLE, tours=2, seed=1, odometer=Odometer(along=0.2))
    np.testing.assert_array_equal(
        drive.poses, again.poses
    )  # Noise of the odometer changes only the log.
    assert not np.array_equal(drive.odometry, again.odometry)


def test_covariance_of_the_odometer_equals_that_of_its_errors() -> None:
    """The errors of many drives, in the odometer's own standard deviations, are independent.

    Each drive is along two sides of a square; the errors are those at its end.
    """
    rng, odometer = np.random.default_rng(0), Odometer()
    side = np.column_stack([np.linspace(0, 4, 41), np.zeros((41, 2))])
    turn = np.column_stack([np.full(11, 4.0), np.zeros(11), np.linspace(0, math.pi / 2, 11)])
    poses = np.vstack(
        [
            side,
            turn,
            np.column_stack([np.full(41, 4.0), np.linspace(0, 4, 41), np.full(41, math.pi / 2)]),
        ]
    )
    errors = []
    for _ in range(300):
        read = odometer.reading(poses, rng)
        covariance = odometer.covariances(read)[-1]
        errors.append(np.linalg.solve(np.linalg.cholesky(covariance), read[-1] - poses[-1]))
    np.testing.assert_allclose(np.mean(errors, axis=0), 0, atol=0.15)
    np.testing.assert_allclose(np.cov(np.transpose(errors)), np.eye(3), atol=0.3)


# Floor plans


def test_doors_are_openings_in_the_walls_of_both_rooms(ring: Building) -> None:
    """A laser in a room sees through its door, and wall beside it. Rooms are 0.2 m apart."""
    opening = ring.openings[0]
    assert (*opening.middle, opening.width, opening.depth) == pytest.approx((10.0, -5.0, 1.0, 0.2))
    assert abs(math.sin(opening.along)) == pytest.approx(1.0)
    ranges = Laser(reach=30.0).exact(ring.world(), np.array([[5.0, -5.0, 0.0]]))[0]
    assert ranges[89] > 14  # Through the door, and the closet's.
    assert ranges[[80, 99]] == pytest.approx(4.9, abs=0.1)
    assert holds(ring.plan.rooms[0].polygon, (5.0, -5.0))
    assert not holds(ring.plan.rooms[0].polygon, (10.0, -5.0))


def test_a_robot_drives_through_doors_from_room_to_room(ring: Building) -> None:
    drive = record_plan(ring.plan, tours=2, seed=3, metres=45.0, body=Body(radius=0.3))
    world = ring.world()
    assert min(world.clearance(x, y) for x, y, _ in drive.poses) >= 0.3
    assert len(drive.truth["scans"]) == len(drive)
    for pose, room in zip(
        drive.poses, drive.truth["scans"], strict=True
    ):  # In the room of the truth, or in the wall between two rooms.
        outline = np.array(ring.plan.rooms[int(room.removeprefix("room "))].polygon)
        assert (outline.min(0) - 0.6 < pose[:2]).all()
        assert (pose[:2] < outline.max(0) + 0.6).all()
    visits = [visit["place"] for visit in drive.truth["visits"]]
    for before, after, crossing in zip(visits, visits[1:], drive.truth["crossings"], strict=False):
        door = drive.truth["doors"][crossing["door"]]
        assert sorted(door["rooms"]) == sorted([before, after])
        assert math.dist(drive.poses[crossing["scan"]][:2], door["at"]) < 0.8
    half = len(visits) // 2
    assert visits[: half + 1] == visits[half:]  # The same round twice, which ends where it began.
    assert len(set(visits)) >= 3
    rooms = Rooms(ring, 0.3)
    rounds = [Round.drawn(rooms, 45.0, np.random.default_rng(seed)).doors for seed in range(5)]
    assert len(set(rounds)) > 2


def test_rounds_that_cannot_be_driven_are_refused(ring: Building, tmp_path: Path) -> None:
    with pytest.raises(SimulatorError, match="through which the robot fits, got none"):
        record_plan(ring.plan, body=Body(radius=0.6))
    with pytest.raises(SimulatorError, match="tours: expected a whole number, 1 or more"):
        record_plan(ring.plan, tours=0)
    with pytest.raises(SimulatorError, match="through which the robot fits, got none"):
        record_plan(replace(ring.plan, doors=()))
    with pytest.raises(
        SimulatorError,
        match=(
            r"walls: expected an area of at most 200,000 square metres, .*, got 2,784 x 1,984 m; "
            r"check the scale"
        ),
    ):
        record_plan(plan_of(tmp_path, xml(unit="m")))
    with pytest.raises(SimulatorError, match="metres: expected a length above 0"):
        record_plan(ring.plan, metres=0.0)
    with pytest.raises(SimulatorError, match="room 4: expected a bounding_polygon"):
        Building.of(
            replace(
                ring.plan, rooms=(*ring.plan.rooms[:4], replace(ring.plan.rooms[4], polygon=()))
            )
        )


@pytest.mark.skipif(not SCHOOLS, reason="the school plans are not here")
def test_plan_of_a_school_can_be_driven() -> None:
    """The robot drives through 30 doors of a school, hits nothing, and returns home."""
    drive = record_plan(
        Plan.load(next(path for path in SCHOOLS if "Sabadell" in path.name)), seed=0, metres=100.0
    )
    assert len(drive.truth["crossings"]) > 10
    assert drive.truth["scans"][0] == drive.truth["scans"][-1]
    assert math.dist(drive.poses[0][:2], drive.poses[-1][:2]) < 1.0


# Worlds with a route of places


@pytest.mark.slow
@pytest.mark.parametrize(("name", "tours"), [("curved", 1), ("cluttered", 1), ("doors", 1)])
def test_robot_visits_all_places_of_shipped_worlds_and_touches_nothing(
    name: str, tours: int
) -> None:
    """Each place is visited as often as the route says, also when the furniture has moved.

    The robot touches nothing.
    """
    world = World.named(name)
    drive = record(world, tours, seed=4, every=1.0)
    asked = [
        stop for stop, _ in groupby(stop for stop in world.route * tours if stop in world.places)
    ]
    assert [visit["place"] for visit in drive.truth["visits"]] == asked
    assert all((world.route * 2).count(place) >= 2 for place in world.places)
    assert min(world.clearance(x, y) for x, y, _ in drive.poses) > 0.2
    assert [step["action"] for step in drive.truth["steps"]] == [*world.route] * tours


def test_world_walls_may_be_curved_or_from_an_occupancy_map(tmp_path: Path) -> None:
    cells = np.full((24, 44), 254, np.uint8)
    cells[[0, 1, -2, -1]] = cells[:, [0, 1, -2, -1]] = 0
    (tmp_path / "map.pgm").write_bytes(b"P5 44 24 255\n" + cells.tobytes())
    (tmp_path / "map.yaml").write_text(
        "image: map.pgm\nresolution: 0.1\norigin: [-0.2, -0.2, 0.0]\noccupied_thresh: 0.65\n"
    )
    fields = {
        "format": "ssh-world",
        "version": 1,
        "places": {"a": [1, 1], "b": [3, 1]},
        "route": ["a", "b", "a"],
        "reach": 0.5,
    }
    (tmp_path / "room.json").write_text(json.dumps({**fields, "occupancy": "map.yaml"}))
    room = World.load(tmp_path / "room.json")
    assert room.start == (1.0, 1.0, 0.0)
    visits = record(room, tours=2, every=1.0).truth["visits"]
    assert [visit["place"] for visit in visits] == [*"ababa"]
    (tmp_path / "round.json").write_text(
        json.dumps({**fields, "arcs": [[2, 1, 3, 0, 360]], "ragged": 0.02})
    )
    walls = World.load(tmp_path / "round.json").segments
    np.testing.assert_array_equal(walls[:, 2:], np.roll(walls[:, :2], -1, axis=0))  # still closed
    off = np.hypot(walls[:, 0] - 2, walls[:, 1] - 1) - 3
    assert 0.01 < off.std() < 0.03
    np.testing.assert_array_equal(World.load(tmp_path / "round.json").segments, walls)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"arcs": [[0, 0, 1, 90, 0]]}, r"arcs\[0\]: expected \[x, y, radius above 0, from, to\]"),
        ({"arcs": [[0, 0, 1]]}, r"arcs\[0\]: expected 5 finite numbers"),
        ({"ragged": 2}, "ragged: expected metres by which walls are uneven"),
        (
            {"ragged": 0.1, "arcs": [[0, 0, 1e5, 0, 360]]},
            "ragged: expected walls of at most 20,000 m together",
        ),
        ({"occupancy": 3}, "occupancy: expected the name of a YAML file"),
        ({"places": [1]}, "places: expected an object of names and points"),
        ({"places": {"a": [1]}}, r"places\.a: expected 2 finite numbers"),
        (
            {"places": {"left": [1, 1]}},
            "places: expected names without commas that are no actions, got 'left'",
        ),
        (
            {"route": ["a", "travel"]},
            (
                r"route\[1\]: expected a place \(b, a\), as there are others in the route, got "
                r"'travel'"
            ),
        ),
        (
            {"route": ["c"]},
            r"route\[0\]: expected travel, right, left or around, or the name of a place, got 'c'",
        ),
        ({"route": ["a", ["b"]]}, r"route\[1\]: expected a place"),
    ],
)
def test_errors_of_worlds_with_places_name_the_field(
    changes: dict[str, object], message: str, tmp_path: Path
) -> None:
    fields = {
        "format": "ssh-world",
        "version": 1,
        "polygons": [[[0, 0], [4, 0], [4, 2], [0, 2]]],
        "places": {"a": [1, 1]},
        "via": {"b": [3, 1]},
    }
    (tmp_path / "world.json").write_text(json.dumps({**fields, **changes}))
    with pytest.raises(SimulatorError, match=message):
        World.load(tmp_path / "world.json")


def test_blocked_route_of_places_is_refused(tmp_path: Path) -> None:
    fields = {
        "format": "ssh-world",
        "version": 1,
        "polygons": [[[0, 0], [4, 0], [4, 2], [0, 2]]],
        "places": {"a": [1, 1], "b": [3, 1]},
    }
    (tmp_path / "world.json").write_text(
        json.dumps({**fields, "segments": [[2, 0, 2, 2]], "route": ["a", "b"]})
    )
    with pytest.raises(
        SimulatorError,
        match=(
            r"route: expected a way from \(1\.00, 1\.00\) to b, got none; open the walls, or move "
            r"b, which is 1\.00 m off"
        ),
    ):
        record(World.load(tmp_path / "world.json"))
    with pytest.raises(
        SimulatorError, match=r"route: expected actions, got places, .*; write --format carmen"
    ):
        simulate(World.load(tmp_path / "world.json"))


# Errors are noticed


@pytest.mark.parametrize(
    ("world", "body", "laser", "message"),
    [
        (
            HALL.with_choices(reach=0.6),
            None,
            None,
            (
                r"action 5 of tour 1, travel: expected the robot to come to D2 at \(13\.00, "
                r"-10\.00\), got it at \(13\.4.*; so it drives another route"
            ),
        ),
        (
            replace(HALL, reach=1.3),
            None,
            None,
            (
                r"expected the robot to come to P3 .*reach is 1\.3 m, and half the width of the "
                r"street there is 1\.00 m"
            ),
        ),
        (
            HALL.with_choices(route="travel,right"),
            None,
            None,
            (
                r"tour 1: expected it to end where it began, at \(0\.00, -15\.00\), got its end "
                r"at .* "
                r"15\.0 m and 90 degrees off"
            ),
        ),
        (
            replace(World.named("three-ways"), angles="right"),
            None,
            None,
            'walls meet at other than right angles, and the world says "right"',
        ),
        (
            replace(World.named("triangle"), start=(-2.0, 1.2, -2.1)),
            None,
            None,
            r"the start is 4\.3 m off the nearest dstate",
        ),
        (World.named("triangle"), None, Laser(noise=0.1), r"ranges err by 10 cm"),
        (
            HALL,
            Body(slip=0.4),
            None,
            r"expected a free way ahead, got a wall; .*a motion errs by 40 %",
        ),
        (
            replace(RECTANGLE, start=(3.4, 1.4, 0.7), route=("travel",)),
            None,
            None,
            r"the start heads 40 degrees off the walls",
        ),
    ],
)
def test_failed_simulation_names_its_cause(
    world: World, body: Body | None, laser: Laser | None, message: str
) -> None:
    with pytest.raises(SimulatorError, match=message):
        simulate(world, tours=2, seed=0, body=body, laser=laser)


def test_single_tour_that_does_not_return_gives_a_warning() -> None:
    with pytest.warns(
        SimulatorWarning,
        match=r"expected it to end where it began, .*; it cannot be driven again from there",
    ):
        assert len(simulate(RECTANGLE.with_choices(route="right"))) == 1


# Driving around things


def test_driver_goes_around_an_unknown_obstacle() -> None:
    """The robot drives around an unknown box on the midline of a corridor, and continues."""
    walls = np.array([[0, 0, 12, 0], [12, 0, 12, 3], [12, 3, 0, 3], [0, 3, 0, 0.0]])
    box = np.array([[5, 1, 6, 1], [6, 1, 6, 2], [6, 2, 5, 2], [5, 2, 5, 1.0]])
    space = FreeSpace.of(walls, 0.2)
    way = space.part(ENDS).way((1.0, 1.5), (11.0, 1.5))
    assert way is not None
    rng = np.random.default_rng(0)
    driver = Driver(
        World("box", np.vstack([walls, box])),
        SimulatedRobot(Body(), (1.0, 1.5, 0.0), rng),
        Laser(),
        rng,
    )
    track = []
    come = []
    for at in drive_along(driver, space, way):
        come.append(at)
        track.append(driver.robot.pose[:2])
    assert math.dist(track[-1], (11.0, 1.5)) < 0.3
    assert come == sorted(come)
    beside = [abs(y - 1.5) for x, y in track if 5 < x < 6]
    assert min(beside) > 0.7
    assert max(abs(y - 1.5) for x, y in track if x < 3 or x > 8) < 0.3


def test_driver_refuses_a_blocked_way() -> None:
    walls = np.array([[0, 0, 12, 0], [12, 0, 12, 3], [12, 3, 0, 3], [0, 3, 0, 0.0]])
    space = FreeSpace.of(walls, 0.2)
    way = space.part(ENDS).way((1.0, 1.5), (11.0, 1.5))
    assert way is not None
    rng = np.random.default_rng(0)
    driver = Driver(
        World("shut", np.vstack([walls, [[6, 0, 6, 3]]])),
        SimulatedRobot(Body(), (1.0, 1.5, 0.0), rng),
        Laser(),
        rng,
    )
    with pytest.raises(
        SimulatorError,
        match=(
            r"shut: drive at \(\d\.\d+, 1\.\d+\): expected a way around what stands there, got "
            r"none"
        ),
    ):
        for _ in drive_along(driver, space, way):
            pass
    part = space.part(ENDS, space.drawn(np.array([[6.0, 0, 6, 3]])))
    assert part.way((1.0, 1.5), (11.0, 1.5)) is None
    one, other = part.region(np.array([(1.0, 1.5), (11.0, 1.5)]))
    assert one != other
    assert part.nearest(int(one), (11.0, 1.5), 1.0)[0] < 6


# The verb


@pytest.mark.slow
def test_simulate_writes_readable_logs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "school.xml").write_text(xml())
    assert (
        main(
            (
                f"simulate {tmp_path / 'school.xml'} --format carmen --set scale_error=0.1 "
                f"--set every=2 -o {tmp_path / 'run.log.gz'}"
            ).split()
        )
        == 0
    )
    said = capsys.readouterr().out
    log = read_log(tmp_path / "run.log.gz")
    truth = json.loads((tmp_path / "run.truth.json").read_text())
    assert f"{len(log):,} scans along {truth['metres']:.0f} m of school" in said
    assert len(log) == len(truth["scans"]) == len(truth["poses"])
    assert log.scans[-1].corrected == pytest.approx(truth["poses"][-1], abs=1e-3)
    assert log.scans[-1].odometry != pytest.approx(truth["poses"][-1], abs=0.1)
    assert b"PARAM simulator_odometry_scale 0.1 " in gzip.decompress(
        (tmp_path / "run.log.gz").read_bytes()
    )


def test_a_bag_has_the_covariance_of_its_odometry(tmp_path: Path) -> None:
    """The covariance of the pose grows from zero, as the odometer states."""
    rosbags = pytest.importorskip("rosbags.highlevel")
    bag = tmp_path / "run.bag"
    assert main(["simulate", "triangle", "--route", "A,B", "--format", "bag", "-o", str(bag)]) == 0
    log = read_log(bag)
    with rosbags.AnyReader([bag], default_typestore=None) as reader:
        messages = [
            reader.deserialize(raw, c.msgtype)
            for c, _, raw in reader.messages([c for c in reader.connections if c.topic == "/odom"])
        ]
    told = np.array([message.pose.covariance for message in messages]).reshape(-1, 6, 6)[
        :, [[0], [1], [5]], [0, 1, 5]
    ]
    np.testing.assert_allclose(
        told, Odometer().covariances(np.array([scan.odometry for scan in log.scans])), atol=1e-6
    )
    assert not told[0].any()
    assert told[-1, 2, 2] > 0.001


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["school.xml", "--format", "carmen", "--set", "reach=1"],
            "--reach: expected no such option with a floor plan",
        ),
        (
            ["triangle", "--format", "carmen", "--set", "stars=false"],
            "stars=false: expected no such option with --format",
        ),
        (
            ["triangle", "--format", "carmen", "--set", "every=0"],
            "every: expected metres, 0.01 or more, got 0",
        ),
        (
            ["triangle", "--format", "carmen", "--set", "odometry_noise=nan"],
            "odometry_noise: expected a number from 0 to 1, got nan",
        ),
    ],
)
def test_simulate_refuses_wrong_options_for_logs(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["simulate", *arguments, "-o", "run.log"]) == 1
    assert message in capsys.readouterr().err


def test_simulate_refuses_a_plan_without_a_log(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "school.xml", "-o", "run.jsonl"]) == 1
    assert "expected --format carmen or --format bag with a floor plan" in capsys.readouterr().err
