"""A table keeps the scans of a log: the same values, and hardly any memory."""

from __future__ import annotations

import math
import tempfile
import tracemalloc
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from perception.readers.logs import read_log
from perception.readers.scans import LaserScanner, Scan, ScanTable
from perception.readers.writers import write_carmen

BEAMS = 360
LASER = LaserScanner(-math.pi / 2, math.pi / BEAMS, BEAMS, 8.0)
LASER_OF_9 = LaserScanner(-math.pi / 2, math.pi / 9, 9, 8.0)


def scans_of(count: int) -> list[Scan]:
    rows = np.random.default_rng(0).uniform(1.0, 7.0, (count, BEAMS)).round(3)
    return [Scan(row, LASER, (0.01 * k, 0.0, 0.0)) for k, row in enumerate(rows)]


def test_kept_ranges_survive_the_release_of_their_memory() -> None:
    scans = scans_of(200)
    kept = ScanTable(scans)
    for _ in range(2):
        assert all((a.ranges == b.ranges).all() for a, b in zip(kept, scans, strict=True))
    # The ranges lie in several files, one behind the other.
    assert len({id(scan.ranges.base) for scan in kept}) == 3


def no_file() -> None:
    raise OSError("No space left on device")


def test_ranges_stay_in_memory_on_a_full_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "TemporaryFile", no_file)
    scans = scans_of(3)
    for kept, scan in zip(ScanTable(scans), scans, strict=True):
        assert (kept.ranges == scan.ranges).all()


def test_table_returns_the_scans_that_were_put_in() -> None:
    other = LaserScanner(0.0, 0.1, 3, 4.0, (0.1, 0.2, 0.3))
    full = Scan(
        np.array([1.0, math.inf, math.nan]), other, (1.0, 2.0, 3.0), (4.0, 5.0, 6.0), 7.5, 8
    )
    scans = [*scans_of(2), full]
    table = ScanTable(scans)
    assert [vars_of(scan) for scan in table[1:]] == [vars_of(scan) for scan in scans[1:]]
    assert vars_of(table[-1]) == vars_of(full)
    with pytest.raises(IndexError):
        table[3]


def vars_of(scan: Scan) -> list[str]:
    return [repr(getattr(scan, field.name)) for field in fields(scan)]


def test_table_needs_little_memory_for_each_scan() -> None:
    count = 2000
    tracemalloc.start()
    try:
        table = ScanTable(
            Scan(np.full(9, 0.1 * k), LASER_OF_9, (0.1 * k,) * 3, (0.2 * k,) * 3, 0.3 * k, k)
            for k in range(count)
        )
        size = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert len(table) == count
    assert size < 700 * count


@pytest.mark.slow
def test_read_log_keeps_ranges_out_of_memory(tmp_path: Path) -> None:
    count = 2000
    write_carmen(tmp_path / "drive.log", scans_of(count))
    tracemalloc.start()
    try:
        log = read_log(tmp_path / "drive.log")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert len(log) == count
    assert peak < 8 * BEAMS * count / 2


def test_scans_of_a_log_share_one_laser(tmp_path: Path) -> None:
    """The bearings of a laser need as much memory as the ranges of a scan."""
    write_carmen(tmp_path / "drive.log", scans_of(20))
    for choice in (None, 3.0):
        log = read_log(tmp_path / "drive.log", no_return=choice, mount=choice and (0.1, 0, 0))
        assert len({id(scan.laser) for scan in log.scans}) == 1
