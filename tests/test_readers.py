"""Logs of robots: what each reader makes of them, round trips through the writers, and logs that are damaged."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from perception.readers.logs import read_log
from perception.readers.scans import Laser, Pose, Scan
from perception.readers.writers import write_carmen
from ssh_abduction.odometry import between, moved

LOGS = Path(__file__).parents[2] / "shared" / "data" / "logs"
LASER = Laser(first=-math.pi / 2, step=math.pi / 180, beams=181, reach=8.0, mount=(0.2, 0.0, 0.0))


def drive(count: int = 12, laser: Laser = LASER, noise: float = 0.03) -> list[Scan]:
    """Scans of a robot that drives a bend, whose odometer is off by some noise."""
    rng = np.random.default_rng(7)
    true: Pose = (1.0, -2.0, 0.3)
    odometry: Pose = (0.0, 0.0, 0.0)
    scans = []
    for i in range(count):
        ranges = np.round(rng.uniform(0.5, 9.0, laser.beams), 3)
        ranges[ranges >= laser.reach] = np.inf
        ranges[3] = np.nan
        scans.append(Scan(ranges, laser, odometry, true, time=100.0 + 0.5 * i))
        step = (0.4, 0.0, 0.2)
        true = moved(true, step)
        odometry = moved(odometry, tuple(v + noise * rng.normal() for v in step))  # type: ignore[arg-type]
    return scans


def agree(read: Scan, written: Scan) -> bool:
    """Whether a scan is as it was written, but for rounding."""
    laser, other = read.laser, written.laser
    assert read.corrected is not None
    assert written.corrected is not None
    return (
        np.allclose(read.ranges, written.ranges, atol=1e-4, equal_nan=True)
        and np.allclose(between(read.odometry, written.odometry), 0, atol=1e-5)
        and np.allclose(between(read.corrected, written.corrected), 0, atol=1e-5)
        and np.allclose(
            [*laser.mount, laser.first, laser.step, laser.reach], [*other.mount, other.first, other.step, other.reach], atol=1e-4
        )
        and read.time == pytest.approx(written.time)
    )


@pytest.mark.parametrize("name", ["drive.log", "drive.log.gz"])
@pytest.mark.parametrize("noise", [0.03, 0.0])
def test_a_log_of_carmen_is_read_as_it_was_written(tmp_path: Path, name: str, noise: float) -> None:
    """Odometry without noise, too, keeps its true poses: they stand in a line of their own."""
    scans = drive(noise=noise)
    write_carmen(tmp_path / name, scans)
    log = read_log(tmp_path / name)
    assert log.format == "carmen"
    assert not log.damaged
    assert len(log) == len(scans)
    assert all(map(agree, log.scans, scans))
