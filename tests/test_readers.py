"""Readers of robots' logs: each format, round trips through the writers, and damaged logs."""

from __future__ import annotations

import gzip
import io
import math
import os
import sys
import threading
import tracemalloc
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from perception.errors import LogError
from perception.readers.echoes import MEANINGS
from perception.readers.lines import LONGEST_LINE
from perception.readers.logs import FORMATS, live_log, read_log
from perception.readers.scans import Damage, LaserScanner, RobotLog, Scan
from perception.readers.writers import write_bag, write_carmen
from ssh_abduction.cli import import_log
from ssh_abduction.data.errors import TraceError
from ssh_abduction.data.odometry import Pose, displacement_between, moved
from ssh_abduction.data.trace import Trace

LOGS = Path(__file__).parents[2] / "shared" / "data" / "logs"
LASER = LaserScanner(
    first=-math.pi / 2, step=math.pi / 180, beams=181, reach=8.0, mount=(0.2, 0.0, 0.0)
)
SMALL = LaserScanner(first=-math.pi / 2, step=math.pi / 4, beams=5, reach=8.0)
START: Pose = (0.0, 0.0, 0.0)
BAGS = {"drive.bag": "ros1", "drive.mcap": "mcap", "drive": "ros2"}


def drive(count: int = 12, laser: LaserScanner = LASER, noise: float = 0.03) -> list[Scan]:
    """Scans of a robot that drives a bend with noisy odometry."""
    rng = np.random.default_rng(7)
    true: Pose = (1.0, -2.0, 0.3)
    odometry: Pose = (0.5, 0.0, 0.0)
    scans = []
    for i in range(count):
        ranges = np.round(rng.uniform(0.5, 9.0, laser.beams), 3)
        ranges[ranges >= laser.reach] = np.inf
        ranges[3] = np.nan
        scans.append(Scan(ranges, laser, odometry, true, time=100.0 + 0.5 * i))
        step = (0.4, 0.0, 0.2)
        true = moved(true, step)
        dx, dy, turned = (v + noise * rng.normal() for v in step)
        odometry = moved(odometry, (dx, dy, turned))
    return scans


def is_near(a: Pose | None, b: Pose | None, off: float = 1e-4) -> bool:
    return a is b if a is None or b is None else max(map(abs, displacement_between(a, b))) <= off


def agree(read: Scan, written: Scan) -> bool:
    """Whether a scan is as written, up to rounding."""
    laser, other = read.laser, written.laser
    return (
        np.allclose(read.ranges, written.ranges, atol=1e-4, equal_nan=True)
        and is_near(read.odometry, written.odometry)
        and is_near(read.corrected, written.corrected)
        and np.allclose(
            [*laser.mount, laser.first, laser.step, laser.reach],
            [*other.mount, other.first, other.step, other.reach],
            atol=1e-4,
        )
        and read.time == pytest.approx(written.time)
    )


def read_text(path: Path, *lines: str, **options: Any) -> RobotLog:
    path.write_text("\n".join(lines) + "\n")
    return read_log(path, **options)


def pose(value: Pose) -> str:
    return " ".join(f"{v:.6f}" for v in value)


def flaser(first: Pose, second: Pose, time: str = "1.5", ranges: str = "1 2 8 8 8") -> str:
    return f"FLASER {len(ranges.split())} {ranges} {pose(first)} {pose(second)} {time} host {time}"


def robotlaser(first: Pose, second: Pose, time: float = 1.5) -> str:
    return (
        f"ROBOTLASER1 0 -1.5707963 3.1415927 0.7853982 8.0 0.1 0 5 1 2 7.99 8 9 0 {pose(first)} "
        f"{pose(second)} 0 0 0 0 0 {time} host {time}"
    )


def odom(value: Pose, time: str = "1.5") -> str:
    return f"ODOM {pose(value)} 0 0 0 {time} host {time}"


def by_gmapping(scans: int = 8, with_neff: bool = True) -> tuple[list[str], list[Pose], list[Pose]]:
    """Lines of a GMapping log with three ODOM lines between scans.

    Returns:
        The lines, the odometry at each scan, and the corrected poses.
    """
    rng = np.random.default_rng(3)
    lines, odometry, truth, at = [], [START], [], START
    for i in range(scans):
        corrected: Pose = (
            moved(at, (0.2, -0.15, 0.1)) if i else at
        )  # The correction jumps as far as the robot drives.
        truth.append(corrected)
        lines += [flaser(corrected, corrected, f"{i}.5"), odom(corrected, "0")] + [
            "NEFF 30"
        ] * with_neff
        at = corrected
        for part in range(3):
            step = (0.15, float(rng.normal(0, 0.01)), float(rng.normal(0, 0.1)))
            at = moved(at, step)
            odometry[-1:] = [moved(odometry[-1], step)]
            lines.append(odom(at, f"{i + (part + 1) / 3 + 0.5:.1f}"))
        odometry.append(odometry[-1])
    return lines, [START, *odometry[: scans - 1]], truth


# Writers, and back


@pytest.mark.parametrize("noise", [0.03, 0.0])
@pytest.mark.parametrize("name", ["drive.log", "drive.log.gz", *BAGS])
def test_logs_survive_a_round_trip(tmp_path: Path, name: str, noise: float) -> None:
    """True poses have a place of their own, and are kept even without odometry noise."""
    scans = drive(noise=noise)
    (write_bag if name in BAGS else write_carmen)(tmp_path / name, scans)
    log = read_log(tmp_path / name)
    assert log.format == BAGS.get(name, "carmen")
    assert not log.damaged
    assert len(log) == len(scans)
    assert all(map(agree, log.scans, scans))


@pytest.mark.parametrize("name", ["drive.log", *BAGS])
def test_log_without_corrected_poses_has_none(tmp_path: Path, name: str) -> None:
    scans = [Scan(s.ranges, s.laser, s.odometry) for s in drive(4)]
    (write_bag if name in BAGS else write_carmen)(tmp_path / name, scans)
    log = read_log(tmp_path / name)
    assert "times of recording" not in " ".join(log.notes)  # though the first time is 0
    assert [scan.corrected for scan in log.scans] == [None] * 4
    assert [scan.time for scan in log.scans] == [0, 1, 2, 3]


def test_writers_refuse_bad_input(tmp_path: Path) -> None:
    scans = drive(2)
    with pytest.raises(LogError, match="at least one to write"):
        write_carmen(tmp_path / "a.log", [])
    with pytest.raises(LogError, match="No such file"):
        write_carmen(tmp_path / "nowhere" / "a.log", scans)
    with pytest.raises(LogError, match="No such file"):
        write_bag(tmp_path / "nowhere" / "a.bag", scans)
    write_bag(tmp_path / "a", scans)
    with pytest.raises(LogError, match="existing folder"):
        write_bag(tmp_path / "a", scans)
    with pytest.raises(LogError, match="time from 0 on"):
        write_bag(tmp_path / "b.mcap", [Scan(scans[0].ranges, LASER, START, time=-1.0)])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a"]  # nothing in part


# Lines


@pytest.mark.parametrize("with_neff", [True, False])
def test_odometry_of_gmapping_logs_excludes_corrections(tmp_path: Path, with_neff: bool) -> None:
    lines, odometry, truth = by_gmapping(with_neff=with_neff)
    log = read_text(tmp_path / "a.log", *lines)
    assert all(is_near(scan.odometry, at) for scan, at in zip(log.scans, odometry, strict=True))
    assert all(is_near(scan.corrected, at) for scan, at in zip(log.scans, truth, strict=True))
    assert "pieced together" in log.notes[0]


@pytest.mark.parametrize("with_neff", [True, False])
@pytest.mark.parametrize(
    "damage",
    [
        "FLASER 5 1 2 3",
        "FLASER 5 1 2 8 8 8 nan 0 0 nan 0 0 1 h 1",
        "\x01\x07\ufffd",
        "FLXSER 5 1 2",
        None,
    ],
)
def test_lost_scan_leaves_no_correction_in_odometry(
    tmp_path: Path, damage: str | None, with_neff: bool
) -> None:
    lines, odometry, _ = by_gmapping(with_neff=with_neff)
    at = next(i for i, line in enumerate(lines) if line.startswith("FLASER 5") and i > 15)
    lines[at : at + 1] = [damage] * (damage is not None)
    if damage is None and not with_neff:
        return  # A missing line leaves no sign in the log.
    log = read_text(tmp_path / "a.log", *lines)
    assert [d.line for d in log.damaged] == ([] if damage in (None, "FLXSER 5 1 2") else [at + 1])
    kept = odometry[:3] + odometry[4:] if with_neff else odometry[:4] + odometry[5:]
    assert all(is_near(scan.odometry, at) for scan, at in zip(log.scans, kept, strict=True))


def test_lost_odometer_line_loses_only_its_motion(
    tmp_path: Path,
) -> None:
    lines, odometry, _ = by_gmapping()
    restarts = [
        i
        for i, line in enumerate(lines)
        if line.startswith("ODOM") and lines[i - 1].startswith("FLASER")
    ]
    log = read_text(
        tmp_path / "a.log",
        *("ODOM 1 2 x" if i == restarts[3] else line for i, line in enumerate(lines)),
    )
    off = [
        displacement_between(moved(a, displacement_between(b, c)), d)
        for a, b, c, d in zip(
            odometry,
            [s.odometry for s in log.scans],
            [s.odometry for s in log.scans[1:]],
            odometry[1:],
            strict=False,
        )
    ]
    assert max(max(map(abs, v)) for v in off) < 0.3
    assert sum(max(map(abs, v)) > 1e-4 for v in off) == 1


def test_poses_of_a_raw_log_are_odometry(tmp_path: Path) -> None:
    """Each scan was logged before the ODOM line of its time, which then repeats its pose."""
    poses: list[Pose] = [(0.1 * i, 0.0, 0.02 * i) for i in range(6)]
    lines = [
        line
        for i, at in enumerate(poses)
        for line in (flaser(moved(at, (0.15, 0, 0)), at, f"{i}.0"), odom(at, f"{i}.0"))
    ]
    log = read_text(tmp_path / "a.log", "PARAM robot_frontlaser_offset 0.3 host 1", *lines)
    assert [is_near(scan.odometry, at) for scan, at in zip(log.scans, poses, strict=True)] == [
        True
    ] * 6
    assert {scan.corrected for scan in log.scans} == {None}
    assert is_near(log.scans[0].laser.mount, (0.15, 0, 0))


def test_drifting_first_pose_is_read_as_corrected(tmp_path: Path) -> None:
    poses: list[Pose] = [(0.5 * i, 0.0, 0.0) for i in range(20)]
    lines = [flaser(moved((0, 0, 0.1 * i), at), at) for i, at in enumerate(poses)]
    log = read_text(tmp_path / "a.log", "PARAM robot_frontlaser_offset 0.3 host 1", *lines)
    assert is_near(log.scans[9].odometry, poses[9])
    assert is_near(log.scans[9].corrected, moved((0, 0, 0.9), poses[9]))
    assert log.scans[0].laser.mount == (0.3, 0, 0)


@pytest.mark.parametrize(
    ("beams", "lines", "step", "reach"),
    [
        (180, ["PARAM robot_front_laser_max 5.5 host 1"], 180 / 180, 5.5),
        (181, [], 180 / 180, 9.0),
        (361, [], 180 / 360, 9.0),
        (361, ["PARAM laser_front_laser_fov 1.5707963 host 1"], 90 / 360, 9.0),
        (361, ["PARAM laser_front_laser_fov 90 host 1"], 90 / 360, 9.0),
    ],
)
def test_beam_angles_and_reach_of_carmen_lines(
    tmp_path: Path, beams: int, lines: list[str], step: float, reach: float
) -> None:
    log = read_text(
        tmp_path / "a.log",
        *lines,
        flaser(START, START, ranges=" ".join(["0 6 9 9 9 -1 nan", *["1.5"] * (beams - 7)])),
    )
    scan = log.scans[0]
    assert math.degrees(scan.laser.step) == pytest.approx(step, abs=1e-5)
    assert math.degrees(scan.laser.first) == pytest.approx(
        -step * (beams // 2), abs=1e-4
    )  # at the right
    assert scan.laser.reach == reach
    assert np.isnan(scan.ranges[[0, 5, 6]]).all()
    assert np.isinf(scan.ranges[2:5]).all()
    assert np.isinf(scan.ranges[1]) == (reach < 6)


@pytest.mark.parametrize(
    ("ranges", "note"),
    [
        ("81.91 40 3 2 1", "81.91 m, a code of SICK lasers for no echo. So the laser is taken to"),
        ("39.5 30 3 2 1", "39.5 m, which occurs 1 time. So the laser is taken to reach 40 m."),
    ],
)
def test_note_says_why_a_laser_is_taken_to_reach_so_far(
    tmp_path: Path, ranges: str, note: str
) -> None:
    log = read_text(tmp_path / "a.log", flaser(START, START, ranges=ranges))
    assert note in " ".join(log.notes)


@pytest.mark.parametrize("lines", [[], ["PARAM robot_front_laser_max 81.92 host 1"]])
def test_error_codes_of_a_sick_laser_mean_no_return(tmp_path: Path, lines: list[str]) -> None:
    scan = read_text(
        tmp_path / "a.log", *lines, flaser(START, START, ranges="81.91 81.87 40 2 1")
    ).scans[0]
    assert scan.ranges.tolist() == [math.inf, math.inf, 40, 2, 1]


def test_scans_without_poses_are_placed_between_odometer_lines(tmp_path: Path) -> None:
    raw = "RAWLASER1 0 -1.57 3.14 0.785 8.0 0.1 0 5 1 2 3 4 5 0 {} host {}"
    lines = [
        raw.format(0.5, 0.5),
        odom((0, 0, 0), "1"),
        raw.format(1.25, 1.25),
        raw.format(9e9, 9e9),
        odom((1, 0, 0.4), "2"),
        raw.format(2.5, 2.5),
    ]
    log = read_text(tmp_path / "a.log", *lines)
    expected: list[Pose] = [(0, 0, 0), (0.25, 0, 0.1), (0, 0, 0), (1, 0, 0.4)]
    assert all(is_near(scan.odometry, at) for scan, at in zip(log.scans, expected, strict=True))


def test_scans_logged_twice_are_read_once(tmp_path: Path) -> None:
    log = read_text(
        tmp_path / "a.log", *[flaser(START, START), robotlaser(START, START)] * 4, "RLASER 1 2"
    )
    assert len(log) == 4
    assert log.scans[0].ranges.tolist() == [1, 2, 7.99, math.inf, math.inf]
    assert "not from FLASER, RLASER" in log.notes[0]


def test_true_poses_of_carmens_simulator_are_kept(tmp_path: Path) -> None:
    true = "TRUEPOS 5 5 1.5707963 0 0 0 1 host 1"
    log = read_text(tmp_path / "a.log", flaser(START, START), true, flaser((1, 0, 0), (1, 0, 0)))
    assert log.scans[0].corrected is None
    assert is_near(log.scans[1].corrected, (5, 6, math.pi / 2))


# Graphs


def graph(
    vertices: list[Pose],
    motions: list[Pose],
    names: tuple[str, str] = ("VERTEX2", "EDGE2"),
    scans: list[Pose] | None = None,
) -> list[str]:
    lines = []
    for i, (vertex, scan) in enumerate(zip(vertices, scans or vertices, strict=True)):
        lines += [f"{names[0]} {i} {pose(vertex)}", robotlaser(moved(scan, (-0.04, 0, 0)), scan, i)]
    return lines + [f"{names[1]} {i} {i + 1} {pose(m)} 1 0 1 1 0 0" for i, m in enumerate(motions)]


VERTICES: list[Pose] = [(0, 0, 0), (1.2, 0, 0.5), (2, 1, 1), (2, 2, 1.5), (1, 3, 2)]
MOTIONS: list[Pose] = [(1, 0, 0.4), (1, 0.1, 0.5), (0.9, 0, 0.5), (1, -0.1, 0.5)]


def chained(motions: Iterable[Pose]) -> list[Pose]:
    poses = [START]
    for motion in motions:
        poses.append(moved(poses[-1], motion))
    return poses


@pytest.mark.parametrize("names", [("VERTEX2", "EDGE2"), ("VERTEX_SE2", "EDGE_SE2")])
@pytest.mark.parametrize("order", ["as they are", "edges first", "vertices first"])
def test_odometry_of_a_g2o_graph_chains_its_edges(
    tmp_path: Path, names: tuple[str, str], order: str
) -> None:
    lines = graph(VERTICES, MOTIONS, names)
    if order != "as they are":
        first = "EDGE" if order == "edges first" else "VERTEX"
        lines.sort(key=lambda line: not line.startswith(first))
    log = read_text(tmp_path / "a.graph", *lines)
    assert log.format == "g2o"
    assert not log.damaged
    assert [scan.time for scan in log.scans] == [
        0,
        1,
        2,
        3,
        4,
    ]  # as relations name scans by their times
    assert all(
        is_near(scan.odometry, at) for scan, at in zip(log.scans, chained(MOTIONS), strict=True)
    )
    assert all(is_near(scan.corrected, at) for scan, at in zip(log.scans, VERTICES, strict=True))
    assert is_near(log.scans[0].laser.mount, (-0.04, 0, 0))


def test_g2o_graph_with_own_odometry_keeps_it(tmp_path: Path) -> None:
    odometry = chained(MOTIONS)
    log = read_text(tmp_path / "a.graph", *graph(VERTICES, [], scans=odometry))
    assert all(is_near(scan.odometry, at) for scan, at in zip(log.scans, odometry, strict=True))
    assert all(is_near(scan.corrected, at) for scan, at in zip(log.scans, VERTICES, strict=True))


def test_uncorrected_g2o_graph_has_no_corrected_poses(tmp_path: Path) -> None:
    log = read_text(tmp_path / "a.graph", *graph(chained(MOTIONS), MOTIONS))
    assert {scan.corrected for scan in log.scans} == {None}


def test_damaged_vertex_loses_only_its_scan(tmp_path: Path) -> None:
    vertices = [*VERTICES, *[(float(i), 9.0, 0.0) for i in range(10)]]
    motions = [*MOTIONS, *[(1.0, 0.0, 0.0)] * 10]
    lines = graph(vertices, motions)
    lines[4] = "VERTEX2 2 2 1"
    log = read_text(tmp_path / "a.graph", *lines)
    assert [damage.line for damage in log.damaged] == [5, 6]
    assert is_near(log.scans[2].odometry, chained(motions)[3])


def test_edges_may_lead_backwards(tmp_path: Path) -> None:
    lines = graph(VERTICES, MOTIONS)
    # This edge is as good as the one from 2 to 3.
    lines[-2] = f"EDGE2 3 2 {pose(displacement_between(MOTIONS[2], START))} 1 0 1 1 0 0"
    assert is_near(read_text(tmp_path / "a.graph", *lines).scans[-1].odometry, chained(MOTIONS)[-1])
    with pytest.raises(LogError, match="corrected poses alone"):
        read_text(tmp_path / "a.graph", *lines[:10])


# Bags


def bag(path: Path, messages: Callable[[Any], list[tuple[str, float, Any]]]) -> Path:
    """A bag of ROS 2 with messages: topic, seconds of recording, and message."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics: dict[str, Any] = {}
        for topic, time, message in messages(Messages(store.types)):
            if isinstance(message, bytes):  # A damaged one.
                writer.write(topics[topic], round(time * 1e9), message)
                continue
            kind = message.__msgtype__
            topics[topic] = topics.get(topic) or writer.add_connection(topic, kind, typestore=store)
            writer.write(topics[topic], round(time * 1e9), store.serialize_cdr(message, kind))
    return path


class Messages:
    """Makes messages. Times are seconds; 0 means that the header has none."""

    def __init__(self, types: Any) -> None:
        self.types = types

    def header(self, frame: str, time: float) -> Any:
        nano = round(time * 1e9)
        stamp = self.types["builtin_interfaces/msg/Time"](sec=nano // 10**9, nanosec=nano % 10**9)
        return self.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)

    def quaternion(self, yaw: float, upside_down: bool = False) -> Any:
        cos, sin = math.cos(yaw / 2), math.sin(yaw / 2)
        x, y, z, w = (cos, sin, 0.0, 0.0) if upside_down else (0.0, 0.0, sin, cos)
        return self.types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)

    def scan(self, time: float, frame: str = "laser") -> Any:
        ranges = np.array([0.05, 1, 2, np.inf, 9], dtype=np.float32)
        return self.types["sensor_msgs/msg/LaserScan"](
            header=self.header(frame, time),
            angle_min=-1.0,
            angle_max=1.0,
            angle_increment=0.5,
            time_increment=0.0,
            scan_time=0.1,
            range_min=0.1,
            range_max=8.0,
            ranges=ranges,
            intensities=np.zeros(0, dtype=np.float32),
        )

    def odometry(self, time: float, at: Pose, base: str = "base_link") -> Any:
        geometry, zero = (
            "geometry_msgs/msg/",
            self.types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0),
        )
        where = self.types[geometry + "Pose"](
            position=self.types[geometry + "Point"](x=at[0], y=at[1], z=0.0),
            orientation=self.quaternion(at[2]),
        )
        return self.types["nav_msgs/msg/Odometry"](
            header=self.header("odom", time),
            child_frame_id=base,
            pose=self.types[geometry + "PoseWithCovariance"](pose=where, covariance=np.zeros(36)),
            twist=self.types[geometry + "TwistWithCovariance"](
                twist=self.types[geometry + "Twist"](linear=zero, angular=zero),
                covariance=np.zeros(36),
            ),
        )

    def transform(
        self, parent: str, child: str, at: Pose, time: float = 0.0, upside_down: bool = False
    ) -> Any:
        geometry = "geometry_msgs/msg/"
        move = self.types[geometry + "Vector3"](x=at[0], y=at[1], z=0.3)
        transform = self.types[geometry + "Transform"](
            translation=move, rotation=self.quaternion(at[2], upside_down)
        )
        stamped = self.types[geometry + "TransformStamped"](
            header=self.header(parent, time), child_frame_id=child, transform=transform
        )
        return self.types["tf2_msgs/msg/TFMessage"](transforms=[stamped])


def test_odometry_of_a_bag_is_interpolated_at_scan_times(tmp_path: Path) -> None:
    """Headings wrap between two messages. A scan long after the last message has no odometry."""
    path = bag(
        tmp_path / "bag",
        lambda m: (
            [
                ("/odom", t, m.odometry(t, (0.5 * t, 1.0, math.remainder(2.9 + 0.2 * t, math.tau))))
                for t in range(1, 5)
            ]
            + [("/front", t + 0.1, m.scan(t)) for t in (1.0, 1.5, 2.25, 9.0)]
        ),
    )
    log = read_log(path)
    expected: list[Pose] = [(0.5 * t, 1.0, 2.9 + 0.2 * t) for t in (1.0, 1.5, 2.25)]
    assert all(is_near(scan.odometry, at) for scan, at in zip(log.scans, expected, strict=True))
    assert [damage.line for damage in log.damaged] == [4]
    assert "expected odometry at the time of the scan" in log.damaged[0].what
    scan = log.scans[0]
    assert np.isnan(scan.ranges[0])
    assert scan.ranges[1:].tolist() == [1, 2, math.inf, math.inf]
    assert scan.laser == LaserScanner(-1.0, 0.5, 5, 8.0, START, float(np.float32(0.1)))
    assert "No transform leads" in " ".join(log.notes)


def test_bag_with_transforms_and_a_laser_upside_down_is_read(tmp_path: Path) -> None:
    """Without Odometry messages, the transforms lead from odom to the laser.

    The chain is odom, base_footprint, base_link, mast, laser; some names have the slash of ROS 1.
    """
    path = bag(
        tmp_path / "bag",
        lambda m: [
            ("/tf_static", 0.5, m.transform("/base_link", "mast", (0.1, 0.2, math.pi / 2))),
            ("/tf_static", 0.5, m.transform("mast", "laser", (0.3, 0.0, 0.0), upside_down=True)),
            ("/tf", 0.6, m.transform("wheel_link", "wheel", (0.0, 0.0, 1.0), 0.6)),
            *[
                ("/tf", t, m.transform("odom", "base_footprint", (t, 0.0, 0.0), t))
                for t in (1.0, 2.0, 3.0)
            ],
            *[
                ("/tf", t, m.transform("base_footprint", "/base_link", (0.0, 0.0, 0.0), t))
                for t in (1.0, 2.0, 3.0)
            ],
            *[("/tf", t, m.transform("map", "odom", (5.0, t, math.pi / 2), t)) for t in (1.0, 3.0)],
            *[("/scan", t, m.scan(t)) for t in (1.5, 2.0)],
        ],
    )
    log = read_log(path)
    assert is_near(log.scans[0].odometry, (1.5, 0, 0))
    assert is_near(log.scans[0].corrected, (5, 3, math.pi / 2))
    laser = log.scans[0].laser
    assert is_near(laser.mount, (0.1, 0.5, math.pi / 2))
    assert (laser.first, laser.step) == (1.0, -0.5)


@pytest.mark.parametrize("stamp", [0.0, 500.0])
def test_recording_times_replace_missing_or_foreign_header_times(
    tmp_path: Path, stamp: float
) -> None:
    path = bag(
        tmp_path / "bag",
        lambda m: (
            [("/odom", t, m.odometry(t, (t, 0.0, 0.0))) for t in (1.0, 2.0, 3.0)]
            + [("/scan", t, m.scan(stamp)) for t in (1.5, 2.5)]
        ),
    )
    log = read_log(path)
    assert [scan.odometry[0] for scan in log.scans] == [1.5, 2.5]
    assert "times of recording" in " ".join(log.notes)


def test_damaged_message_is_skipped_and_reported(tmp_path: Path) -> None:
    def messages(m: Messages) -> list[tuple[str, float, Any]]:
        no_step, no_ranges, nowhere = (
            m.scan(1.0),
            m.scan(1.0),
            m.odometry(1.5, (math.nan, 0.0, 0.0)),
        )
        no_step.angle_min = no_step.angle_increment = math.nan
        no_ranges.ranges = np.zeros(0, dtype=np.float32)
        cut = b"\0\1\0\0" + bytes(9)
        odometry = [
            m.odometry(1.0, (1.0, 0.0, 0.0)),
            cut,
            nowhere,
            m.odometry(2.0, (2.0, 0.0, 0.0)),
        ]
        scans = [m.scan(1.0), cut, no_step, no_ranges, m.scan(2.0)]
        return [("/odom", 1.0 + i / 3, message) for i, message in enumerate(odometry)] + [
            ("/scan", 1.0 + i / 4, s) for i, s in enumerate(scans)
        ]

    log = read_log(bag(tmp_path / "bag", messages))
    assert [scan.odometry[0] for scan in log.scans] == [1, 2]
    assert [(damage.what.split(":")[0], damage.line) for damage in log.damaged] == [
        ("/odom", 2),
        ("/odom", 3),
        ("/scan", 2),
        ("/scan", 3),
        ("/scan", 4),
    ]
    assert all("expected" in damage.what for damage in log.damaged)


def test_error_lists_several_scan_topics(tmp_path: Path) -> None:
    path = bag(
        tmp_path / "bag",
        lambda m: (
            [(f"/{side}", 1.0, m.scan(1.0)) for side in ("front", "rear", "rear")]
            + [
                (topic, 1.0, m.odometry(1.0, (x, 0.0, 0.0)))
                for topic, x in (("/odom", 1.0), ("/truth", 2.0))
            ]
        ),
    )
    with pytest.raises(
        LogError,
        match=r"/front \(1 messages\), /rear \(2 messages\); name one with --set scan_topic=TOPIC",
    ):
        read_log(path)
    with pytest.raises(LogError, match=r"/odom .*/truth .*--set odom_topic"):
        read_log(path, scan_topic="rear")
    with pytest.raises(LogError, match=r"odom_topic: expected a topic of Odometry, got '/front'"):
        read_log(path, scan_topic="rear", odom_topic="/front")
    log = read_log(path, scan_topic="rear", odom_topic="/truth")
    assert [scan.odometry[0] for scan in log.scans] == [2, 2]


def test_bags_without_scans_or_odometry_are_refused(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"expected scans .* got none; topics: /odom \(Odometry\)"):
        read_log(bag(tmp_path / "a", lambda m: [("/odom", 1.0, m.odometry(1.0, START))]))
    with pytest.raises(LogError, match=r"expected odometry .* got none; topics: /scan"):
        read_log(bag(tmp_path / "b", lambda m: [("/scan", 1.0, m.scan(1.0))]))
    (tmp_path / "c").mkdir()
    with pytest.raises(LogError, match="metadata"):
        read_log(tmp_path / "c")


def test_format_of_a_bag_is_found_from_its_content(tmp_path: Path) -> None:
    for name, format in BAGS.items():
        write_bag(tmp_path / name, drive(2))
        file = tmp_path / name if name != "drive" else next((tmp_path / name).glob("*.db3"))
        file.rename(tmp_path / "log.data")
        assert read_log(tmp_path / "log.data").format == format


def test_missing_rosbags_is_named_with_the_install_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_bag(tmp_path / "a.bag", drive(2))
    monkeypatch.setitem(sys.modules, "rosbags", None)
    for act in (
        lambda: read_log(tmp_path / "a.bag"),
        lambda: write_bag(tmp_path / "b.bag", drive(2)),
    ):
        with pytest.raises(LogError, match=r"pip install '\.\[ros\]'"):
            act()


# Damage


DAMAGED = {
    "a line that was cut": b"FLASER 5 1 2 3",
    "no number": b"FLASER 5 1 2 x 4 5 0 0 0 0 0 0 1 h 1",
    "a wrong count": b"FLASER 4 1 2 3 4 5 0 0 0 0 0 0 1 h 1",
    "a count that is none": b"FLASER many 1 2 3",
    "a huge count": b"FLASER 999999999999 1 2 3",
    "no beams": b"FLASER 0 0 0 0 0 0 0 1 h 1",
    "a pose that is none": b"FLASER 5 1 2 3 4 5 nan 0 0 0 0 inf 1 h 1",
    "a pose out of this world": b"FLASER 5 1 2 3 4 5 0 0 0 1e300 0 0 1 h 1",
    "binary": bytes(range(1, 10)) + bytes(range(14, 200)),
    "the end of a line": b"2.5 0 0 0 0 0 0 1 h 1",
    "a line without an end": b"FLASER 5 " + b"1 " * LONGEST_LINE,
    "odometry without a number": b"ODOM 1 2",
    "a laser without a step": b"ROBOTLASER1 0 -1.5 3 0 8 0 0 2 1 1 0 0 0 0 0 0 0 0 0 0 0 0 1 h 1",
    "a parameter that is no number": b"PARAM robot_front_laser_max far host 1",
}


@pytest.mark.parametrize("what", DAMAGED)
def test_damaged_line_is_skipped_and_reported(tmp_path: Path, what: str) -> None:
    """If a ROBOTLASER1 line is the damaged one, ROBOTLASER1 is still the kind that is read."""
    good = robotlaser if DAMAGED[what].startswith(b"ROBOT") else flaser
    lines = [good((0.1 * i, 0, 0), (0.1 * i, 0, 0)).encode() for i in range(5)]
    lines.insert(2, DAMAGED[what])
    (tmp_path / "a.log").write_bytes(b"\n".join(lines))
    log = read_log(tmp_path / "a.log")
    assert [damage.line for damage in log.damaged] == [3]
    assert log.damaged[0].what.startswith("expected ")
    assert len(log.damaged[0].what) < 200
    assert [scan.line for scan in log.scans] == [1, 2, 4, 5, 6]
    streamed = list(live_log(io.BytesIO(b"\n".join(lines))))
    assert [type(item) for item in streamed] == [Scan, Scan, Damage, Scan, Scan, Scan]


@pytest.mark.parametrize("tag", ["ODOM", "FLASER", "TRUEPOS"])
def test_cut_line_is_damaged_wherever_it_was_cut(tmp_path: Path, tag: str) -> None:
    """A cut heading still is a number, and so is a cut time."""
    lines = [
        line
        for i in range(30)
        for line in (
            f"TRUEPOS {pose((0.1 * i, 0, 1.57))} {pose((0.1 * i, 0, 1.57))} {i}.25 host {i}.25",
            odom((0.1 * i, 0, 1.57), f"{i}.25"),
            flaser((0.1 * i, 0, 1.57), (0.1 * i, 0, 1.57), f"{i}.25"),
        )
    ]
    at = next(i for i in range(45, 90) if lines[i].startswith(tag))
    for end in range(len(tag) + 1, lines[at].rindex(" ")):
        cut = [*lines[:at], lines[at][:end], *lines[at + 1 :]]
        assert [d.line for d in read_text(tmp_path / "a.log", *cut).damaged] == [at + 1], end


def test_edge_that_was_cut_gives_no_motion(tmp_path: Path) -> None:
    """Half a number still is a number."""
    lines = [
        line
        for i in range(30)
        for line in (
            f"VERTEX2 {i} {pose((0.55 * i, 0, 0))}",
            flaser((0.55 * i, 0, 0), (0.55 * i, 0, 0)),
            *([f"EDGE2 {i - 1} {i} 0.500000 0.000000 0.000000 1 0 1 1 0 0"] if i else []),
        )
    ]
    at = lines.index(next(line for line in lines if line.startswith("EDGE2 14")))
    lines[at] = lines[at][: lines[at].index("0000 1")]
    log = read_text(tmp_path / "a.log", *lines)
    assert [damage.line for damage in log.damaged] == [at + 1]
    assert is_near(log.scans[15].odometry, log.scans[14].odometry)


def test_lines_may_begin_with_spaces(tmp_path: Path) -> None:
    assert len(read_text(tmp_path / "a.log", *[f"  {flaser(START, START)}"] * 3)) == 3


def test_byte_order_mark_loses_no_scan(tmp_path: Path) -> None:
    (tmp_path / "a.log").write_text(flaser(START, START), encoding="utf-8-sig")
    log = read_log(tmp_path / "a.log")
    assert (len(log), log.damaged) == (1, ())


def test_unknown_lines_are_skipped_silently(tmp_path: Path) -> None:
    log = read_text(
        tmp_path / "a.log",
        "# a comment",
        "",
        "SYNC 1",
        "MARKER here",
        flaser(START, START).replace(" ", "\t"),
        "WIFI -70\r",
    )
    assert len(log) == 1
    assert not log.damaged


def broken(tmp_path: Path) -> dict[str, bytes]:
    scan = flaser(START, START).encode() + b"\n"
    return {
        "empty": b"",
        "blank": b"\n \n",
        "a trace": b'{"format": "ssh-trace", "version": 1}\n',
        "binary": bytes(range(256)) * 10,
        "gzip of nothing": gzip.compress(b""),
        "cut gzip": gzip.compress(scan * 1000)[:-20],
        "damaged gzip": gzip.compress(scan * 1000)[:40] + b"\xff" * 40,
        "no scan": b"ODOM 0 0 0 0 0 0 1 h 1\n",
        "only damaged scans": b"FLASER 5 1 2\n" * 3,
        "corrected poses alone": (scan + b"NEFF 3\n") * 3,
        "no odometry": b"RAWLASER1 0 -1.57 3.14 0.785 8.0 0.1 0 5 1 2 3 4 5 0 1 h 1\n",
        "a bag of nothing": b"#ROSBAG V2.0\n",
        "mcap of nothing": b"\x89MCAP0\r\n",
        "sqlite of nothing": b"SQLite format 3\0" + bytes(100),
        "a gzipped bag": gzip.compress(b"#ROSBAG V2.0\n"),
    }


def test_import_takes_all_formats_of_logs() -> None:
    assert f"--format {{{','.join(FORMATS)}}}" in import_log.READING
    assert f"--set zero_is {{{','.join(MEANINGS)}}}" in import_log.READING


@pytest.mark.parametrize("what", broken(Path()))
def test_file_that_is_no_log_is_one_clear_error(tmp_path: Path, what: str) -> None:
    (tmp_path / "a.log").write_bytes(broken(tmp_path)[what])
    with pytest.raises(LogError, match=r"a\.log: .*expected .*") as caught:
        read_log(tmp_path / "a.log")
    assert "\n" not in str(caught.value)
    if what in ("empty", "blank", "binary", "gzip of nothing"):
        assert all(name in str(caught.value) for name in FORMATS)
    assert ("got a trace; give it to solve" in str(caught.value)) == (what == "a trace")


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"path": 3}, "path: expected the path of a file, .* got 3"),
        ({"scan_topic": 4}, "scan_topic: expected topics, got 4; name topics of the bag"),
        ({"scan_topic": ["scan", 4]}, r"scan_topic\[1\]: expected a text, got 4"),
        ({"odom_topic": 4}, "odom_topic: expected a text, got 4"),
    ],
)
def test_read_log_refuses_arguments_of_wrong_types(wrong: dict[str, Any], said: str) -> None:
    arguments = {"path": "drive.mcap", **wrong}
    with pytest.raises(LogError, match=said):
        read_log(**arguments)


def test_live_log_refuses_a_text_stream() -> None:
    with pytest.raises(LogError, match="stream: expected a stream of bytes"):
        next(live_log(io.StringIO("FLASER 1 2\n")))  # type: ignore[arg-type]


def test_wrong_paths_and_formats_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.log").write_text(flaser(START, START))
    for path, options, text in (
        (tmp_path / "none.log", {}, "No such file"),
        ("a\0b", {}, "expected a readable log: embedded null byte"),
        (tmp_path / "a.log", {"format": "ros3"}, "expected one of carmen, g2o, ros1, ros2, mcap"),
        (tmp_path / "a.log", {"format": "g2o"}, "expected vertices"),
        (tmp_path / "a.log", {"format": "ros1"}, "cannot be opened"),
        (tmp_path / "a.log", {"format": "mcap"}, "cannot be opened"),
        (tmp_path / "a.log", {"scan_topic": "/scan"}, "expected a bag, because topics are given"),
        (tmp_path, {"format": "carmen"}, "got a folder"),
    ):
        with pytest.raises(LogError, match=text):
            read_log(path, **options)
    assert (
        read_text(tmp_path / "g", *graph(VERTICES, MOTIONS), format="carmen").scans[1].odometry
        == VERTICES[1]
    )


@pytest.mark.parametrize("name", ["drive.log", "drive.log.gz", "gmapping.log", "graph.log", *BAGS])
def test_damaged_logs_never_crash_the_reader(tmp_path: Path, name: str) -> None:
    """Bytes are changed, left out, or repeated."""
    file = tmp_path / name
    if name in BAGS:
        write_bag(file, drive(4, SMALL))
    elif name.startswith("drive"):
        write_carmen(file, drive(6, SMALL))
    else:
        file.write_text(
            "\n".join(by_gmapping(5)[0] if name == "gmapping.log" else graph(VERTICES, MOTIONS))
        )
    if file.is_dir():
        file = next(file.glob("*.db3"))
    whole = file.read_bytes()
    rng = np.random.default_rng(1)
    read = 0
    for _ in range(12 if name in BAGS else 40):
        data = bytearray(whole)
        for _ in range(rng.integers(1, 6)):
            at, size = int(rng.integers(len(data))), int(rng.integers(1, 30))
            data[at : at + size] = [rng.bytes(size), b"", data[at : at + size] * 2][rng.integers(3)]
        file.write_bytes(data)
        try:
            log = read_log(file)
        except LogError:
            continue
        read += 1
        for scan in log.scans:
            assert len(scan.ranges) == scan.laser.beams
            assert np.isfinite([*scan.odometry, *(scan.corrected or START)]).all()
    assert (
        read > 5 or name in BAGS or name.endswith(".gz")
    )  # the check sum of gzipped data is wrong


def test_memory_does_not_grow_with_skipped_lines(tmp_path: Path) -> None:
    scan = flaser(START, START) + "\n"
    with gzip.open(tmp_path / "a.log", "wt", compresslevel=1) as file:
        file.write(scan)
        for _ in range(40):
            file.write("VISION " + "7 " * 100_000 + "\n")
        file.write("X" * 4_000_000 + "\n" + scan)
    tracemalloc.start()
    try:
        log = read_log(tmp_path / "a.log")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert len(log) == 2
    assert [damage.line for damage in log.damaged] == [42]
    assert peak < 14e6  # of 12 MB of lines, one of 4 MB


def test_log_is_read_from_a_named_pipe(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    text = "\n".join(flaser(START, START) for _ in range(3))
    writer = threading.Thread(target=(tmp_path / "pipe").write_text, args=[text])
    writer.start()
    assert len(read_log(tmp_path / "pipe")) == 3
    writer.join()


def test_trace_reader_recognises_a_log(tmp_path: Path) -> None:
    write_carmen(tmp_path / "a.log", drive(2))
    write_carmen(tmp_path / "a.log.gz", drive(2))
    write_bag(tmp_path / "a.bag", drive(2))
    (tmp_path / "b.log").write_text("\n".join(graph(VERTICES, MOTIONS)))
    for name in ("a.log", "a.log.gz", "a.bag", "b.log"):
        with pytest.raises(
            TraceError,
            match=(
                r"got a robot's log; make a trace of it with ssh-abduction import LOG -o "
                r"trace\.jsonl"
            ),
        ):
            Trace.load(tmp_path / name)


# Logs of real robots


REAL = {
    # Scans, beams, reach, metres by odometry and by corrected poses, and differences of increments:
    # median and 95th percentile, in metres and degrees.
    "aces-corrected.log.gz": (440, 180, 50, 322, 323, (0.06, 1), (0.15, 6)),
    "seattle-corrected.log.gz": (241, 361, 81.83, 190, 190, (0.03, 0.2), (0.06, 1)),
    "csail-corrected.log.gz": (406, 361, 50, 370, 380, (0.1, 5), (0.25, 16)),
    "belgioioso-corrected.log.gz": (395, 361, 80.99, 222, 219, (0.06, 2), (0.15, 10)),
    "fr079.log": (1464, 360, 50, 391, 391, (0.01, 0.1), (0.05, 0.5)),
}


@pytest.mark.parametrize("name", REAL)
def test_logs_of_real_robots_are_read(name: str) -> None:
    if not (LOGS / name).exists():
        pytest.skip("needs the logs of shared/data")
    count, beams, reach, driven, truly, median, most = REAL[name]
    log = read_log(LOGS / name)
    assert (len(log), len(log.damaged)) == (count, 0)
    assert {(scan.laser.beams, scan.laser.reach) for scan in log.scans} == {(beams, reach)}
    assert 0.001 < np.mean([np.isinf(scan.ranges).mean() for scan in log.scans]) < 0.03
    steps = list(zip(log.scans, log.scans[1:], strict=False))
    by_odometry = [displacement_between(a.odometry, b.odometry) for a, b in steps]
    by_truth = [
        displacement_between(a.corrected, b.corrected)
        for a, b in steps
        if a.corrected is not None and b.corrected is not None
    ]
    assert [
        sum(math.hypot(*step[:2]) for step in way) for way in (by_odometry, by_truth)
    ] == pytest.approx([driven, truly], abs=1)
    off = np.abs([displacement_between(a, b) for a, b in zip(by_odometry, by_truth, strict=True)])
    off = np.column_stack([np.hypot(off[:, 0], off[:, 1]), np.degrees(off[:, 2])])
    assert (np.median(off, axis=0) < median).all()
    assert (np.quantile(off, 0.95, axis=0) < most).all()
    assert (off.max(axis=0) > 0).all()  # Odometry is no copy of the corrected poses.
    end = displacement_between(
        displacement_between(log.scans[0].odometry, log.scans[-1].odometry),
        displacement_between(log.scans[0].corrected or START, log.scans[-1].corrected or START),
    )
    assert math.hypot(*end[:2]) > 0.5  # And it drifts.
