"""Scans are paired with odometry by time, and a ROS 2 node maps them (if ROS 2 is installed)."""

from __future__ import annotations

import contextlib
import math
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from array import array
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from coarse import every_second_beam, hall

from perception.readers.bag_geometry import Mount
from perception.readers.scans import Damaged
from perception.readers.writers import write_carmen
from ssh_abduction.cli import main
from ssh_abduction.robot_logs import stamps
from ssh_abduction.robot_logs.log_mapper import OnlineLogMapper, solved
from ssh_abduction.robot_logs.ros_node import LaserFrames, scan_of
from ssh_abduction.robot_logs.stamps import StampPairing

TURNED = 0.5  # radians: that of ros_player.py
TESTS = Path(__file__).parent
needs_ros = pytest.mark.skipif(find_spec("rclpy") is None, reason="ROS 2 is not installed")


def fed(items: str) -> tuple[list[float], dict[str, int]]:
    """The times of the scans that are paired, and what was lost.

    An item is a scan such as "s9.5", or a pose such as "p9", at a time. The heading of a pose is
    its time.
    """
    one, found = StampPairing(), list[float]()
    for kind, at in ((item[0], float(item[1:])) for item in items.split()):
        if kind == "s":
            one.add_scan(at, None)
        else:
            one.add_pose(at, (0.0, 0.0, math.remainder(at, math.tau)))
        for when, _, pose in one.ready():
            assert math.remainder(pose[2] - when, math.tau) == pytest.approx(0, abs=1e-9)
            found.append(when)
    return found, dict(one.lost)


@pytest.mark.parametrize(
    ("items", "found", "lost"),
    [
        ("p0 s0.5 p1", [0.5], {}),
        ("s0.5 p0.5", [0.5], {}),
        ("p0 s0.2 s0.4 p1", [0.2, 0.4], {}),
        ("p3 s3.2 p3.4", [3.2], {}),  # the heading passes half a turn
        ("s0.5 p1 s1", [1], {"no odometry": 1}),
        ("p0 s1 s1 p1", [1], {"doubled": 1}),
        ("p0 s1 s0.5 p1", [1], {"out of order": 1}),
        # The clock starts anew.
        ("p9 s9.5 p0 s0.5 p1", [0.5], {"no odometry": 1}),
        ("p9 p0 s0.5 p1", [0.5], {}),
        # A scan by the clock before comes after the first pose by the new one.
        ("p9 s9 p0 s9.5 s0.5 p1", [9, 0.5], {"no odometry": 1}),
        # Scans by the new clock come before its first pose, and before the last one by the old.
        ("s9 s9.5 s0.5 p9 s0.7 s0.7 p0 p1", [9, 0.5, 0.7], {"doubled": 1, "no odometry": 1}),
        # Late scans are no new clock, not even if several come.
        ("p5 s9 s7 s8.5 s9.5 p9 p9.5", [9, 9.5], {"out of order": 2}),
        # Poses are missing.
        ("p0 s0 s1 p2 s2", [0, 2], {"no odometry": 1}),
    ],
)
def test_scans_get_the_pose_of_their_time(
    items: str, found: list[float], lost: dict[str, int]
) -> None:
    assert fed(items) == (found, lost)


def test_queue_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stamps, "MOST_SCANS", 5)
    monkeypatch.setattr(stamps, "MOST_POSES", 10)
    numbers = [kind + str(k / 10) for kind, n in (("s", 8), ("p", 30)) for k in range(n)]
    found, lost = fed(" ".join(numbers))
    assert (len(found), lost) == (5, {"too many": 3})


@pytest.mark.skipif(find_spec("rclpy") is not None, reason="ROS 2 is installed")
def test_node_without_ros_says_what_to_install(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["live"]) == 1
    assert "expected ROS 2, got none; pip install" in capsys.readouterr().err


@dataclass
class Message:
    """A LaserScan as rclpy gives it: ranges are an array of floats."""

    ranges: Any
    header: Any
    angle_min: float = -1.0
    angle_max: float = 1.0
    angle_increment: float = 0.5
    range_min: float = 0.1
    range_max: float = 10.0


def test_scan_of_a_laser_that_hangs_upside_down() -> None:
    header = SimpleNamespace(stamp=SimpleNamespace(sec=2, nanosec=0))
    message = Message(array("f", [1.0, math.nan, 0.05, 10.0, math.inf]), header)
    scan = scan_of(message, Mount((0.2, 0.0, 0.0), is_flipped=True), (1.0, 2.0, 3.0), 7)
    assert scan.laser.mount == (0.2, 0.0, 0.0)
    assert (scan.laser.first, scan.laser.step) == (1.0, -0.5)
    assert scan.odometry == (1.0, 2.0, 3.0)
    assert scan.time == 2.0
    assert np.isnan(scan.ranges).tolist() == [False, True, True, False, False]
    assert scan.ranges[[0, 3, 4]].tolist() == [1.0, math.inf, math.inf]
    with pytest.raises(Damaged, match="expected beams over at most 360 degrees"):
        scan_of(replace(message, angle_increment=7.0, angle_max=7.0), Mount(), (0.0, 0.0, 0.0), 0)


def test_scans_wait_until_the_first_one_may_go() -> None:
    one, known = StampPairing(), set[str]()
    for at in (0.0, 1.0):
        one.add_pose(at, (at, 0.0, 0.0))
    one.add_scan(0.5, "laser")
    assert not list(one.ready(known.__contains__))
    known.add("laser")
    assert [at for at, *_ in one.ready(known.__contains__)] == [0.5]


DDS = {"ROS_DOMAIN_ID": str(os.getpid() % 100), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}


def over_dds(house: Path, log: Path, *more: str, by_frames: bool = False) -> str:
    """What the node prints while a log is played. It ends when nothing comes any more."""
    given = {**os.environ, **DDS}
    call = [sys.executable, "-m", "ssh_abduction", "live", "--save", str(house), "--set", "idle=20"]
    with subprocess.Popen([*call, *more], env=given, stdout=subprocess.PIPE, text=True) as node:
        play = [sys.executable, str(TESTS / "ros_player.py"), str(log), "20"]
        subprocess.run(play + ["tf"] * by_frames, env=given, check=True, timeout=120)
        out, _ = node.communicate(timeout=120)
    return out


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("logs") / "a.log"
    scans = every_second_beam(hall(every=0.5)[:60])
    write_carmen(path, [replace(scan, corrected=None) for scan in scans])
    return path


@needs_ros
def test_node_maps_a_drive_over_dds(log: Path, tmp_path: Path) -> None:
    out = over_dds(tmp_path / "house", log, "--ros-args", "-p", "use_sim_time:=true")
    assert "listening to /scan, reliable" in out
    assert "place 0 is new" in out
    assert len(OnlineLogMapper.load(tmp_path / "house")) == 60
    # A robot that drives on does not stop because an old state cannot be read.
    state = tmp_path / "house" / "drive.state"
    state.write_bytes(b'{"format": "ssh-live", "version": 0}\n')
    assert "place 0 is new" in over_dds(tmp_path / "house", log)
    assert state.read_bytes() == b'{"format": "ssh-live", "version": 0}\n'


@needs_ros
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of packages of ROS
def test_node_obeys_and_ends_over_dds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import rclpy
    from rclpy.parameter import Parameter
    from rclpy.parameter_client import AsyncParameterClient
    from sensor_msgs.msg import LaserScan
    from std_srvs.srv import Trigger

    mapper = OnlineLogMapper()
    for scan in every_second_beam(hall(every=0.5)[:120]):
        mapper.observe(scan)
    mapper.accept(solved(mapper.task()))
    mapper.save(tmp_path)
    places = mapper.to_dict()["places"]
    [first, second] = next(place["scans"] for place in places if len(place["scans"]) > 1)
    for name, value in DDS.items():
        monkeypatch.setenv(name, value)
    command = [sys.executable, "-m", "ssh_abduction", "live", "--save", str(tmp_path)]
    said = queue.SimpleQueue[str]()

    def wait_for(part: str) -> None:
        while part not in said.get(timeout=60):
            pass

    with contextlib.ExitStack() as last:
        node = last.enter_context(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
        last.callback(node.kill)
        threading.Thread(target=lambda: [said.put(line) for line in node.stdout or ()]).start()
        rclpy.init()
        last.callback(rclpy.shutdown)
        person = rclpy.create_node("person")

        def call(name: str, **values: Any) -> Any:
            client = person.create_client(Trigger, f"/ssh_abduction/{name}")
            assert client.wait_for_service(timeout_sec=60)
            parameters = AsyncParameterClient(person, "ssh_abduction")
            made = [Parameter(key, value=value) for key, value in values.items()]
            set_all = parameters.set_parameters(made)
            rclpy.spin_until_future_complete(person, set_all, timeout_sec=60)
            answer = client.call_async(Trigger.Request())
            rclpy.spin_until_future_complete(person, answer, timeout_sec=60)
            return answer.result()

        laser, _ = (person.create_publisher(LaserScan, "/scan", 10) for _ in range(2))
        wait_for("/scan: expected one publisher, got 2; stop all but one")
        wait_for("listening to /scan, reliable")
        while not laser.get_subscription_count():
            time.sleep(0.05)
        laser.publish(LaserScan())
        wait_for("a scan has no ranges")
        assert call("route", place=0, to=1).message == "0 1"
        assert "places: expected two of 0, 1" in call("route", to=99).message
        assert not call("correct", text="elsewhere", first=first, second=first).success
        assert call("correct", second=second).success
        wait_for(f"place {len(places)} is new")
        assert call("reset").success
        assert '"scans": 0' in call("save").message
        node.send_signal(signal.SIGTERM)
        wait_for("interrupted: the drive ends here")
        wait_for("0 places after 0 scans")
        assert node.wait(60) == 0


@needs_ros
# The folder of this name beside this test is no package.
@pytest.mark.skipif(
    getattr(find_spec("tf2_msgs"), "origin", None) is None, reason="tf2_msgs is not installed"
)
def test_node_takes_poses_and_the_mount_from_frames(log: Path, tmp_path: Path) -> None:
    assert "place 0 is new" in over_dds(tmp_path / "a", log, "--odom", "/tf", by_frames=True)
    live = OnlineLogMapper.load(tmp_path / "a").live.log
    assert len(live) == 60
    assert live.scans[0].laser.mount == pytest.approx((0.0, 0.0, TURNED))


def link(parent: str, child: str, x: float, turn: float) -> Any:
    """A transform, as rclpy gives it."""
    turned = SimpleNamespace(x=0.0, y=0.0, z=math.sin(turn / 2), w=math.cos(turn / 2))
    move = SimpleNamespace(x=x, y=0.0, z=0.0)
    header = SimpleNamespace(frame_id=parent)
    pose = SimpleNamespace(translation=move, rotation=turned)
    return SimpleNamespace(header=header, child_frame_id=child, transform=pose)


def test_transforms_say_where_the_robot_and_its_laser_are() -> None:
    frames, said = LaserFrames("odom", ()), list[str]()
    message = SimpleNamespace(header=SimpleNamespace(frame_id="/laser"), ranges=[])
    assert frames.mount(message, True, said.append) is None
    assert frames.mount(message, False, said.append) == Mount()
    assert "No transform leads from the robot" in said.pop()
    assert frames.add(link("base", "mast", 1.0, math.pi / 2), True) is None
    assert frames.add(link("mast", "laser", 1.0, 0.0), True) is None
    assert frames.add(link("odom", "base", 3.0, 0.5), False) == pytest.approx((3.0, 0.0, 0.5))
    assert frames.add(link("map", "odom", 3.0, 0.5), False) is None
    mount = frames.mount(message, True, said.append)
    assert mount is not None
    assert mount.pose == pytest.approx((1.0, 1.0, math.pi / 2), abs=1e-5)
    assert not said
    told = LaserFrames("odom", (1.0, 2.0, 90.0)).mount(message, True, said.append)
    assert told == Mount((1.0, 2.0, math.pi / 2))
