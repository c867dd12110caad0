"""Logs of other people's robots, with a mistake that the reader corrects and names."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from coarse import hall
from scipy.spatial.transform import Rotation
from test_bags import notes, two_lasers, written
from test_readers import LASER, SMALL, Messages, bag, drive

from perception.errors import LogError
from perception.places.following import follow
from perception.places.log_checks import refuse_mixed
from perception.places.odometers import is_missing, lag_of, unmeasured, with_lag
from perception.readers.bag_frames import RecordedTrack, flat_pose
from perception.readers.bag_geometry import Mount, believed
from perception.readers.echoes import LaserOptions, interpret_log
from perception.readers.lines import zstd_module
from perception.readers.logs import read_log
from perception.readers.scans import RobotLog
from perception.readers.writers import write_carmen
from simulator.errors import SimulatorWarning
from simulator.world import World

Listed = list[tuple[str, float, Any]]


def ahead(m: Messages, change: Callable[[Any, int], None] = lambda scan, i: None) -> Listed:
    """A robot that drives ahead, whose scans are changed."""
    found: Listed = []
    for i in range(60):
        scan = m.scan(1.0 + i)
        scan.ranges = np.array([1, 2, 3, 4 + i / 100, 5], dtype=np.float32)
        change(scan, i)
        found += [
            ("/odom", 1.0 + i, m.odometry(1.0 + i, (0.5 * i, 0.0, 0.1 * math.sin(i)))),
            ("/scan", 1.0 + i, scan),
        ]
    return found


def angles(first: float, last: float, step: float) -> Callable[[Any, int], None]:
    def change(scan: Any, _: int) -> None:
        scan.angle_min, scan.angle_max, scan.angle_increment = first, last, step

    return change


@pytest.mark.parametrize(
    ("given", "step", "said"),
    [
        ((-90.0, 90.0, 45.0), math.pi / 4, "(read so: angle_min, angle_max, angle_increment)"),
        ((-1.5708, 1.5708, 45.0), math.pi / 4, "(read so: angle_increment)"),
        ((-90.0, 1.5708, math.pi / 4), math.pi / 4, "(read so: angle_min)"),
        ((-1.5708, 90.0, math.pi / 4), math.pi / 4, "(read so: angle_max)"),
        ((-1.0, 1.0, -0.5), 0.5, "leads from angle_min away from angle_max"),
        ((1.0, -1.0, 0.5), 0.5, "say --set fov=-115"),
        ((1.0, -1.0, -0.5), -0.5, ""),
        ((-1.0, 3.0, 0.5), 0.5, "By the angle_increment, the beams are taken to cover 115"),
        ((-2.0, 2.0, 0.4), 1.0, "By angle_max, the beams are taken to cover 229"),
        ((-1.0, 1.0, 0.0), 0.5, "lack angle_increment"),
        ((math.nan, 1.0, 0.5), 0.5, "lack angle_min"),
        (
            (-math.pi, math.pi, math.pi),
            math.pi / 2,
            "By angle_max, the beams are taken to cover 360",
        ),
        ((-1.0, 1.0, 0.5), 0.5, ""),
    ],
)
def test_angles_that_make_no_sense_are_named(
    tmp_path: Path, given: tuple[float, float, float], step: float, said: str
) -> None:
    log = read_log(bag(tmp_path / "bag", lambda m: ahead(m, angles(*given))))
    assert log.scans[0].laser.step == pytest.approx(step, rel=1e-3)
    assert log.scans[0].laser.first == pytest.approx(-2 * step, rel=1e-3)
    assert said in notes(log)
    assert ("The angles of the scans" in notes(log)) == bool(said)


def test_beams_over_more_than_a_turn_are_refused_unless_told(tmp_path: Path) -> None:
    path = bag(tmp_path / "bag", lambda m: ahead(m, angles(-6.5, 6.5, 3.25)))
    with pytest.raises(LogError, match=r"at most 360 degrees, got 5 ranges .* cover 745 degrees"):
        read_log(path)
    assert read_log(path, fov=180).scans[0].laser.step == pytest.approx(math.pi / 4)
    path = bag(tmp_path / "none", lambda m: ahead(m, angles(0.0, 0.0, 0.0)))
    with pytest.raises(
        LogError, match=r"the angle_increment cover nan .*; say what the beams cover: --set"
    ):
        read_log(path)
    assert read_log(path, fov=180).scans[0].laser.step == pytest.approx(math.pi / 4)


@pytest.mark.parametrize(
    ("degrees", "height", "said"),
    [(10, 0.3, "projected to the floor plane"), (30, 0.3, "not believed"), (1, 0.3, "")],
)
def test_tilted_laser_is_levelled_or_not_believed(
    tmp_path: Path, degrees: float, height: float, said: str
) -> None:
    floor = height / math.sin(math.radians(10))

    def change(scan: Any, i: int) -> None:
        scan.header.frame_id = "laser"
        middle = floor if degrees == 10 else 2 + i / 20
        ranges = np.array([1, 1.5, middle, 1.5, 1])
        scan.ranges = (ranges + (0 if degrees == 10 else i / 30)).astype(np.float32)

    path = bag(tmp_path / "bag", lambda m: tilted(m, degrees, change))
    log = read_log(path, no_return=7)
    assert said in notes(log)
    if degrees == 10:
        assert math.isnan(log.scans[0].ranges[2])
        assert 1.4 < log.scans[0].ranges[1] < 1.5
    else:
        assert log.scans[0].ranges[1] == 1.5
    assert "tilted" not in notes(read_log(path, mount=(0, 0, 0)))


def tilted(m: Messages, degrees: float, change: Callable[[Any, int], None]) -> Listed:
    """A laser that looks down by some degrees."""
    transform = m.transform("base_link", "laser", (0.0, 0.0, 0.0))
    half = math.radians(degrees) / 2
    turn = m.types["geometry_msgs/msg/Quaternion"](x=0.0, y=math.sin(half), z=0.0, w=math.cos(half))
    transform.transforms[0].transform.rotation = turn
    return [("/tf_static", 0.5, transform), *ahead(m, change)]


@pytest.mark.parametrize("turns", [(0, 0, 30), (0, 30, 0), (90, 20, 15), (10, 0, 150)])
def test_walls_that_a_tilted_laser_sees_stay_straight(turns: tuple[int, int, int]) -> None:
    """The laser turns by yaw, pitch and roll between walls a metre to the left and the right."""
    rotation = Rotation.from_euler("ZYX", turns, degrees=True).as_matrix()
    heading = math.atan2(rotation[1, 0], rotation[0, 0])
    rows = tuple(map(tuple, rotation.tolist()))
    mount = Mount((0.0, 0.0, heading), bool(rotation[2, 2] < 0), rows, 0.5)
    first, step, beams = -math.pi + 1e-3, math.tau / 360, 360
    _, across, up = mount.rays(first, step, beams)
    ends = np.minimum(1 / np.abs(across), np.where(up < 0, -0.5 / up, np.inf))
    ranges = mount.levelled(ends, first, step, 12.0)
    bearings = (-1 if mount.is_flipped else 1) * (first + step * np.arange(beams)) + heading
    seen = np.isfinite(ranges)
    assert seen.sum() > 150
    off = np.abs(np.abs(ranges * np.sin(bearings))[seen] - 1)
    assert (off < 1e-6).mean() > 0.95
    assert off.max() < 0.15  # the nearest beam counts alone at the edge of the floor


@pytest.mark.parametrize(("rooms", "ceiling"), [((1, 5), 2.5), ((1, 1), math.inf)])
def test_ceiling_that_a_tilted_laser_sees_is_unknown(
    rooms: tuple[int, int], ceiling: float
) -> None:
    """A laser that looks up is in rooms between two sizes, below a ceiling at 2.5 m."""
    rotation = Rotation.from_euler("Y", -30, degrees=True).as_matrix()
    mount = Mount((0.0, 0.0, 0.0), False, tuple(map(tuple, rotation.tolist())), 0.5)
    beams = 180
    first, step = -math.pi / 2, math.pi / beams
    _, _, up = mount.rays(first, step, beams)
    flat = np.linspace(*rooms, 20)[:, None] / np.sqrt(1 - up**2)
    ends = np.where(up > 0, np.minimum(flat, 2 / np.abs(up)), flat)
    scans = [
        SimpleNamespace(
            angle_min=first, angle_max=math.pi / 2, angle_increment=step, range_max=9.0, ranges=r
        )
        for r in ends
    ]
    said: list[str] = []
    found = believed(mount, scans, "laser", "log", False, said)
    assert found.ceiling == pytest.approx(ceiling, abs=0.01)
    assert ("ceiling 2.5 m above" in said[0]) == math.isfinite(ceiling)
    unknown = found.levelled(ends[-1], first, step, 9.0) == -math.inf
    assert unknown[beams // 2] == math.isfinite(ceiling)
    assert not unknown[2]


def test_steep_laser_is_refused(tmp_path: Path) -> None:
    path = bag(tmp_path / "bag", lambda m: tilted(m, 60, lambda scan, i: None))
    with pytest.raises(LogError, match=r"tilted by at most 45 degrees, got 60 degrees"):
        read_log(path)


def test_beams_on_the_robot_itself_are_unknown() -> None:
    scans = [replace(scan, ranges=scan.ranges.copy()) for scan in drive(60, LASER)]
    for scan in scans:
        scan.ranges[40:50] = 0.24
    meant, said = interpret_log(scans, LaserOptions())
    assert all(np.isnan(scan.ranges[40:50]).all() for scan in meant)
    assert "10 beams return one short range, 0.24 to 0.24 m" in " ".join(said)
    meant, said = interpret_log(scans, LaserOptions(nearest=0.0))
    assert (meant[0].ranges[40:50] == 0.24).all()
    meant, _ = interpret_log(scans, LaserOptions(nearest=0.35, blind=(-90.0, -80.0)))
    assert np.isnan(meant[0].ranges[40:50]).all()
    assert np.isnan(meant[0].ranges[:11]).all()


def test_robot_shows_to_a_cheap_laser_whose_beams_are_lost_now_and_then() -> None:
    chance = np.random.default_rng(5)
    scans = [replace(scan, ranges=scan.ranges.copy()) for scan in drive(60, LASER)]
    for scan in scans:
        near = chance.normal(0.24, 0.015, 10)
        scan.ranges[40:50] = np.where(chance.random(10) < 0.3, np.inf, near)
    meant, said = interpret_log(scans, LaserOptions())
    assert not any((scan.ranges[40:50] < 0.3).any() for scan in meant)
    assert "10 beams return one short range" in " ".join(said)


@pytest.mark.parametrize("late", [(0.0,), (0.002,), (0.004, 0.008), (100.0,)])
def test_repeated_scans_are_left_out(tmp_path: Path, late: tuple[float, ...]) -> None:
    def many(scan: Any, i: int) -> None:
        scan.ranges = np.linspace(1, 2 + i / 100, 41, dtype=np.float32)
        scan.angle_increment = 0.05

    def repeated(m: Messages) -> Listed:
        found = ahead(m, many)
        for by in late:
            again = [(topic, t + by, one) for topic, t, one in ahead(m, many)]
            for _, t, one in again:
                one.header.stamp = m.scan(t).header.stamp
            found += again if by > 1 else again[1::2]
        return found

    log = read_log(bag(tmp_path / "bag", repeated))
    assert len(log) == 60
    assert f"of {60 + 60 * len(late)} scans repeat the ranges of an earlier one" in notes(log)


@pytest.mark.parametrize("robots", ["r", "rs"])
def test_prefixed_frames_are_found(tmp_path: Path, robots: str) -> None:
    mount = (0.1, 0.0, math.pi)

    def messages(m: Messages) -> Listed:
        names = [(f"{name}/base_link", f"{name}/laser") for name in robots]
        # The first of two robots is the one that the odometry names.
        found = [("/tf_static", 0.5, m.transform(*pair, mount)) for pair in names[:1]]
        found += [("/tf_static", 0.5, m.transform(*pair, (0.0, 0.0, 0.0))) for pair in names[1:]]
        for topic, t, one in ahead(m):
            if topic == "/odom" and robots == "rs":
                one.child_frame_id = "r/base_link"
            found.append((topic, t, one))
        return found

    log = read_log(bag(tmp_path / "bag", messages))
    assert log.scans[0].laser.mount == pytest.approx(mount, abs=1e-5)
    assert "laser is r/laser" in notes(log)


def bend(i: int) -> tuple[float, float, float, float]:
    """Time, x, y and heading of a robot that drives to and fro in bends, and ahead."""
    return 1.0 + i, 0.5 * i, 2 * math.sin(i / 5), math.atan(0.8 * math.cos(i / 5))


@pytest.mark.parametrize("kind", ["inverted", "exchanged", "about x", "about -x", "w first"])
def test_odometry_with_swapped_frames_or_axes_is_read(tmp_path: Path, kind: str) -> None:
    def messages(m: Messages) -> Listed:
        found: Listed = []
        for i in range(60):
            t, x, y, turn = bend(i)
            one = m.odometry(t, (x, y, turn), base="laser")
            pose = one.pose.pose
            turned = pose.orientation
            if "about" in kind:
                turned.x, turned.z = turned.z * (-1 if "-" in kind else 1), 0.0
            elif kind == "w first":
                turned.x, turned.w, turned.z = turned.w, turned.z, 0.0
            else:
                one.header.frame_id, one.child_frame_id = "laser", "odom"
            if kind == "inverted":
                cos, sin = math.cos(turn), math.sin(turn)
                pose.position.x, pose.position.y = -cos * x - sin * y, sin * x - cos * y
                pose.orientation.z *= -1
            found += [("/odom", t, one), ("/scan", t, m.scan(t))]
        return found

    log = read_log(bag(tmp_path / "bag", messages))
    assert log.scans[20].odometry == pytest.approx(bend(20)[1:])
    assert (kind if kind in ("inverted", "exchanged") else "turn about x") in notes(log)


def test_turns_about_y_by_more_than_a_quarter_are_read() -> None:
    track, said = RecordedTrack(), list[str]()
    for i in range(60):
        half = 0.05 * i
        turn = SimpleNamespace(x=0.0, y=math.sin(half), z=0.0, w=math.cos(half))
        place = SimpleNamespace(x=math.sin(0.1 * i), y=1 - math.cos(0.1 * i), z=0.0)
        track.add(i, i, flat_pose(place, turn), turn)
    assert track.upright("/odom", said).table()[:, 4] == pytest.approx(0.1 * np.arange(60))
    assert "turn about y" in said[0]


def test_laser_without_a_transform_is_left_out_if_others_have_one(tmp_path: Path) -> None:
    path = bag(tmp_path / "bag", lambda m: [one for one in two_lasers(m, "/scan") if one[1] != 0.5])
    assert "(rear, front): the laser is taken to sit" in notes(read_log(path))
    path = bag(tmp_path / "one", lambda m: two_lasers(m, "/scan")[1:])
    log = read_log(path)
    assert [scan.laser.mount[0] for scan in log.scans] == [-0.2] * 4
    assert "to front: 4 scans from there are left out" in notes(log)


@pytest.mark.parametrize(("beams", "every"), [(180, 1), (121, 1), (180, 4)])
def test_scans_of_two_lasers_with_one_mount_are_refused(beams: int, every: int) -> None:
    scans = hall(every=0.5)[:120]
    refuse_mixed(RobotLog(scans))
    back = [
        replace(scan, ranges=scan.ranges[:beams] / 2, laser=replace(scan.laser, beams=beams))
        for scan in scans[::every]
    ]
    mixed = [
        one for i, scan in enumerate(scans) for one in (scan, *back[i // every :][: i % every == 0])
    ]
    with pytest.raises(LogError, match="expected the scans of one laser, got those of several"):
        refuse_mixed(RobotLog(tuple(mixed)))


def test_gap_in_the_odometry_is_named(tmp_path: Path) -> None:
    path = bag(
        tmp_path / "bag",
        lambda m: [one for one in ahead(m) if one[0] == "/scan" or not 20 < one[1] < 40],
    )
    assert "The odometry has 1 gap: for 20.0 s from 20.0 s on" in notes(read_log(path))


def test_track_follows_the_scans_in_a_gap_of_the_odometry() -> None:
    scans = hall(every=0.5)[:120]
    times = np.array([scan.time for scan in scans])
    poses = np.array([scan.odometry for scan in scans])
    poses[:, 2] = np.unwrap(poses[:, 2])
    turning = int(np.abs(np.diff(poses[:, 2])).argmax())
    kept = np.abs(np.arange(len(scans)) - turning) > 8
    gap = with_lag(RobotLog(scans, odometer=(times[kept], poses[kept])), 0.0)
    assert len(unmeasured(gap)) == 18
    off = follow(gap).poses - follow(RobotLog(scans)).poses
    assert np.hypot(*off[:, :2].T).max() < 0.3


def test_late_scans_are_found_by_their_turns() -> None:
    scans = hall(every=0.5)[:120]
    times = np.array([scan.time for scan in scans])
    poses = np.array([scan.odometry for scan in scans])
    poses[:, 2] = np.unwrap(poses[:, 2])
    log = RobotLog(scans, odometer=(times, poses))
    assert lag_of(log, follow(log)) == 0
    late = replace(log, odometer=(times - 0.7, poses))
    assert lag_of(late, follow(log)) == pytest.approx(0.7, abs=0.11)
    assert with_lag(late, 0.7).scans[50].odometry == pytest.approx(scans[50].odometry, abs=1e-6)


def test_odometry_is_not_missing_if_two_lasers_scan_at_one_time() -> None:
    scans = hall()[:20]
    back = [replace(s, laser=replace(s.laser, mount=(-0.3, 0.0, math.pi))) for s in scans]
    both = [one for pair in zip(scans, back, strict=True) for one in pair]
    assert not is_missing(RobotLog(tuple(both)))
    assert is_missing(RobotLog(tuple(replace(s, odometry=(0.0, 0.0, 0.0)) for s in both)))


def test_first_scan_of_a_second_laser_follows_the_odometry() -> None:
    one, other = hall()[:2]
    back = replace(other, laser=replace(other.laser, mount=(-0.3, 0.0, math.pi)))
    assert follow(RobotLog((one, back))).poses[1] == pytest.approx(
        follow(RobotLog((one, replace(back, ranges=np.full_like(back.ranges, np.inf))))).poses[1]
    )


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "cr", "cr later", "utf-16-le later"])
def test_logs_in_other_encodings_are_read(tmp_path: Path, encoding: str) -> None:
    path, scans = tmp_path / "a.log", drive(40, SMALL)
    write_carmen(path, scans)
    head, text = "", path.read_text()
    if encoding.endswith("later"):
        head, text = text[:500], text[500:]
    name = encoding.removesuffix(" later")
    text = text.replace("\n", "\r") if name == "cr" else text
    path.write_bytes(head.encode() + text.encode("ascii" if name == "cr" else name))
    assert len(read_log(path)) == len(scans)


def test_packed_messages_in_a_file_alone_are_unpacked(tmp_path: Path) -> None:
    path = written(tmp_path, "ros2")
    with sqlite3.connect(path) as database:
        for number, data in database.execute("SELECT id, data FROM messages").fetchall():
            packed = zstd_module().compress(data)
            database.execute("UPDATE messages SET data = ? WHERE id = ?", (packed, number))
    log = read_log(path)
    assert len(log) == 40
    assert "are packed with zstd" in notes(log)


def test_yaw_in_degrees_of_an_occupancy_map_is_named(tmp_path: Path) -> None:
    from PIL import Image

    pixels = np.full((60, 60), 255, np.uint8)
    pixels[[0, -1]] = pixels[:, [0, -1]] = 0
    Image.fromarray(pixels).save(tmp_path / "map.pgm")
    (tmp_path / "map.yaml").write_text("image: map.pgm\nresolution: 0.1\norigin: [0, 0, 90]\n")
    with pytest.warns(SimulatorWarning, match="got 90, which is read as degrees"):
        World.from_occupancy(tmp_path / "map.yaml")
