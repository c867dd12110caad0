"""Drives as robots log them: scans all along, an odometer that drifts, and the truth about places."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from simulator.drive import Recorder
from simulator.errors import SimulatorError
from simulator.laser import Laser
from simulator.motion import between
from simulator.odometer import Odometer
from simulator.tours import record
from simulator.world import World

RECTANGLE = World.named("notched-rectangle")


def steps_of(poses: np.ndarray) -> list[tuple[float, float, float]]:
    return [between(tuple(a), tuple(b)) for a, b in pairwise(poses)]


def test_an_odometer_errs_as_it_says() -> None:
    """Over many drives of 9 m straight ahead, and of two radians on the spot: the spread of what is read is the noise times the root of the motion, and the mean shows what repeats."""
    odometer, rng = Odometer(along=0.04, across=0.03, heading=0.0, turning=0.05, scale=0.1, bend=0.01), np.random.default_rng(0)
    line = np.column_stack([1 + 3 * np.linspace(0, 3, 31), np.full(31, 2.0), np.zeros(31)])
    ends = np.array([Odometer(along=0.04, across=0.03, heading=0.0, scale=0.1).reading(line, rng)[-1] for _ in range(2000)])
    np.testing.assert_allclose(ends.mean(0), (9.9, 0.0, 0.0), atol=0.02)
    np.testing.assert_allclose(ends.std(0), (0.04 * 3, 0.03 * 3, 0.0), rtol=0.07)
    spin = np.column_stack([np.zeros((31, 2)), np.linspace(0, 2, 31)])
    ends = np.array([odometer.reading(spin, rng)[-1] for _ in range(2000)])
    np.testing.assert_allclose(ends.mean(0), (0.0, 0.0, 2.0), atol=0.01)
    np.testing.assert_allclose(ends.std(0), (0.0, 0.0, 0.05 * math.sqrt(2)), rtol=0.07)
    assert odometer.reading(line, rng)[-1, 2] == pytest.approx(0.09, abs=1e-9)  # the bend, in each metre


def test_an_exact_odometer_reads_the_way_itself() -> None:
    rng = np.random.default_rng(0)
    poses = np.cumsum(rng.normal(size=(50, 3)), axis=0)
    read = Odometer(0, 0, 0, 0).reading(poses, rng)
    np.testing.assert_allclose(steps_of(read), steps_of(poses), atol=1e-9)


@pytest.mark.parametrize("field", ["along", "across", "heading", "turning", "scale", "bend"])
def test_a_wrong_odometer_names_its_field(field: str) -> None:
    for value in (float("nan"), 3.0, "much", -2.0):
        with pytest.raises(SimulatorError, match=rf"odometer\.{field}: expected a number"):
            Odometer(**{field: value})  # type: ignore[arg-type]


def test_scans_are_taken_all_along() -> None:
    """Also within a long motion: the next scan is at most a fifth farther than was asked for, in metres and degrees."""
    recorder = Recorder(every=0.3)
    for pose in ((1.0, 1.0, 0.0), (3.0, 1.0, 0.0), (3.0, 1.0, 3.0), (3.1, 1.0, 3.0), (3.15, 1.0, 3.0)):
        recorder.note(RECTANGLE, pose)
    drive = recorder.drive("by hand", Laser(noise=0.0, dropouts=0.0, reach=2.5), Odometer(0, 0, 0, 0), 0)
    for dx, dy, turned in steps_of(drive.poses):
        assert math.hypot(dx, dy) < 0.3 * 1.2
        assert abs(turned) < math.radians(10) * 1.2
    assert drive.metres == pytest.approx(2.15)
    np.testing.assert_allclose(drive.poses[[0, -1]], [(1.0, 1.0, 0.0), (3.0, 1.0, 3.0)], atol=0.2)
    seen = Laser(noise=0.0, dropouts=0.0, reach=2.5).exact(RECTANGLE, drive.poses)
    np.testing.assert_array_equal(drive.ranges, np.where(seen < 2.5, seen, np.inf))
    assert np.isinf(drive.ranges[0]).any()
    assert (np.diff(drive.times) > 0).all()
    with pytest.raises(SimulatorError, match="every: expected a number of metres above 0"):
        Recorder(every=0.0)


def test_a_drive_of_a_world_says_where_the_robot_was() -> None:
    drive = record(RECTANGLE, tours=2, seed=1)
    assert [visit["place"] for visit in drive.truth["visits"]] == ["A", "B", "C", "D"] * 2 + ["A"]
    for visit in drive.truth["visits"]:
        x, y = drive.truth["places"][visit["place"]]
        near = [math.dist(pose[:2], (x, y)) for pose in drive.poses[visit["first"] : visit["last"] + 1]]
        assert max(near) <= RECTANGLE.reach
        assert min(near) < 0.2
    assert [step["dstate"] for step in drive.truth["steps"]] == [f"x{i % 8}" for i in range(16)]
    again = record(RECTANGLE, tours=2, seed=1, odometer=Odometer(along=0.2))
    np.testing.assert_array_equal(drive.poses, again.poses)  # noise of the odometer changes the log alone
    assert not np.array_equal(drive.odometry, again.odometry)
