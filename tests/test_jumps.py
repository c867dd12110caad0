"""The track and the trace if an odometer jumps, stands still, counts another unit, or is two
odometers."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from coarse import every_second_beam, hall

from perception.errors import LogError
from perception.places import importing
from perception.places.distinctive import Visit
from perception.places.importing import import_log, in_frame_of, tracked, turned_wrongly
from perception.places.odometers import Doubt, describe_cuts, doubts_of, keep_one_source
from perception.places.tracing import starts_of_drives
from perception.places.track import Track
from perception.readers.scans import RobotLog, Scan
from ssh_abduction.checker.checker import check
from ssh_abduction.data.drives import drives_of, starts_of
from ssh_abduction.data.odometry import Pose, displacement_between, moved
from ssh_abduction.solver import solve

START: Pose = (0.0, 0.0, 0.0)
COUNT = 110


@pytest.fixture(scope="module")
def scans() -> tuple[Scan, ...]:
    """A drive through half of a hall, a scan of 90 beams each metre."""
    return every_second_beam(hall()[:COUNT])


def with_odometry(scans: Sequence[Scan], poses: Sequence[Pose]) -> tuple[Scan, ...]:
    """The scans with these poses as odometry."""
    return tuple(replace(scan, odometry=pose) for scan, pose in zip(scans, poses, strict=True))


def stepwise(scans: Sequence[Scan], step: Callable[[int, Pose], Pose | None]) -> tuple[Scan, ...]:
    """The scans with other odometry: `step` changes each step, or returns None for a restart."""
    poses = [scans[0].odometry]
    for i, (last, scan) in enumerate(pairwise(scans), 1):
        told = step(i, displacement_between(last.odometry, scan.odometry))
        poses.append(START if told is None else moved(poses[-1], told))
    return with_odometry(scans, poses)


def track_and_notes(scans: Iterable[Scan]) -> tuple[Track, str]:
    """The track, and the notes on it."""
    _, track, notes = tracked(RobotLog(tuple(scans), source="drive"))
    return track, " ".join(notes)


@pytest.fixture(scope="module")
def metres(scans: tuple[Scan, ...]) -> float:
    """Measure the length of the way, and check that a good drive has no note."""
    track, notes = track_and_notes(scans)
    assert (track.cuts, track.breaks, notes) == ((), (), "")
    return float(track.way[-1])


@pytest.mark.parametrize(("at", "pause"), [({65}, 0.0), ({65}, 600.0), ({30, 60, 100}, None)])
def test_track_is_cut_where_the_odometer_restarts(
    scans: tuple[Scan, ...], metres: float, at: set[int], pause: float | None
) -> None:
    """In a pause of 600 seconds, the robot could have driven back to its start."""
    broken = stepwise(scans, lambda i, step: None if i in at else step)
    track, notes = track_and_notes(
        replace(
            scan,
            time=None if pause is None or scan.time is None else scan.time + pause * (i >= min(at)),
        )
        for i, scan in enumerate(broken)
    )
    assert (set(track.cuts), track.breaks) == (at, ())
    assert track.way[-1] == pytest.approx(metres, abs=3)
    assert f"The odometry jumps {'once' if len(at) == 1 else '3 times'} in {COUNT} scans" in notes
    assert "starts anew from 0" in notes
    assert "Local maps that match may connect what lies before and after" in notes


@pytest.mark.slow
def test_trace_has_no_displacement_across_a_cut(
    scans: tuple[Scan, ...],
) -> None:
    done = import_log(
        RobotLog(stepwise(scans, lambda i, step: None if i == 65 else step), source="drive")
    )
    (t,) = (t for t, step in enumerate(done.trace.steps) if t and step.displacement is None)
    assert (done.trace.steps[t].extra["cuts"], done.trace.steps[t].covariance) == ([65], None)
    assert [drive.name for drive in drives_of(done.trace)] == ["drive 1", "drive 2"]
    solution = solve(done.trace, max_maps=1, time_limit=0.5)
    assert solution.maps
    assert not check(done.trace, solution.maps[0], solution.theory)


def test_drives_start_where_the_odometer_jumped_or_the_robot_was_carried() -> None:
    """Between visits 2 and 3 the odometer stood still, and at scan 41 the robot was carried."""
    track = Track(np.zeros((60, 3)), np.zeros((60, 3, 3)), np.ones(60), (15, 25, 26, 35, 41), (41,))
    visits = [SimpleNamespace(scan=scan) for scan in (0, 10, 20, 30, 50)]
    assert starts_of_drives(track, cast("list[Visit]", visits)) == {2: 15, 4: 41}


def test_stuck_odometer_is_replaced_by_scan_matching(
    scans: tuple[Scan, ...], metres: float
) -> None:
    track, notes = track_and_notes(stepwise(scans, lambda i, step: START if 60 <= i < 80 else step))
    assert set(track.cuts) == set(range(60, 80))
    assert track.way[-1] == pytest.approx(metres, abs=8)
    assert "The odometry stands still in 19 steps, " in notes


def test_standing_robot_is_not_called_carried(scans: tuple[Scan, ...]) -> None:
    rng = np.random.default_rng(1)
    stands = [
        replace(scans[60], ranges=scans[60].ranges + 0.02 * rng.normal(size=len(scans[60].ranges)))
        for _ in range(10)
    ]
    assert doubts_of(RobotLog((*scans[:60], *stands, *scans[60:]))) == ({}, [])


def test_robot_that_is_carried_without_a_pause_is_not_called_standing(
    scans: tuple[Scan, ...],
) -> None:
    untimed = [replace(scan, time=None) for scan in (*scans[:40], *scans[90:])]
    track, notes = track_and_notes(stepwise(untimed, lambda i, step: START if i == 40 else step))
    assert (track.cuts, track.breaks) == ((40,), (40,))
    assert "The scans do not fit those before them, once: from scan 40" in notes


def test_robot_that_drove_on_without_seeing_walls_is_not_called_carried(
    scans: tuple[Scan, ...],
) -> None:
    """The laser sees nothing in 30 scans. The scans after them show other walls."""
    blind = [replace(scan, ranges=np.full_like(scan.ranges, np.inf)) for scan in scans[30:60]]
    drive = (*scans[:30], *blind, *scans[60:])
    shorter = stepwise(drive, lambda _, step: (0.9 * step[0], *step[1:]))
    assert track_and_notes(shorter)[0].breaks == ()


@pytest.mark.slow
def test_drive_starts_where_the_robot_was_carried(scans: tuple[Scan, ...]) -> None:
    """The laser is off while the robot is carried, and the odometer is where it was."""
    lifted = stepwise((*scans[:60], *scans[85:]), lambda i, step: START if i == 60 else step)
    done = import_log(RobotLog(lifted, source="drive"))
    assert done.track.breaks == (60,)
    assert "The scans do not fit those before them, once" in done.notes[0]
    (t,) = (t for t, step in enumerate(done.trace.steps) if t and step.displacement is None)
    assert (starts_of(done.trace), done.starts) == ((t,), (60,))
    solution = solve(done.trace, max_maps=1, time_limit=0.5)
    assert solution.maps
    assert not check(done.trace, solution.maps[0], solution.theory)


def test_note_says_that_a_second_drive_may_begin_at_a_jump(scans: tuple[Scan, ...]) -> None:
    parts = (*scans[:60], *scans[85:])
    track, notes = track_and_notes(
        stepwise(parts, lambda i, step: (80.0, 30.0, 0.0) if i == 60 else step)
    )
    assert track.cuts == (60,)
    assert "starts anew" not in notes
    assert "If a drive through another building begins there, cut the log there" in notes


def test_restart_after_a_pause_may_be_a_second_drive(scans: tuple[Scan, ...]) -> None:
    parts = stepwise(scans, lambda i, step: None if i == 60 else step)
    late = tuple(replace(scan, time=(scan.time or 0.0) + 600) for scan in parts[60:])
    assert doubts_of(RobotLog((*parts[:60], *late))) == ({60: Doubt.SEAM}, [])


def test_missing_scans_with_good_odometry_are_no_jump(scans: tuple[Scan, ...]) -> None:
    assert doubts_of(RobotLog((*scans[:60], *scans[75:]))) == ({}, [])


def test_odometry_in_another_unit_is_converted(scans: tuple[Scan, ...], metres: float) -> None:
    track, notes = track_and_notes(
        with_odometry(
            scans,
            [(100 * x, 100 * y, heading) for x, y, heading in (scan.odometry for scan in scans)],
        )
    )
    assert track.way[-1] == pytest.approx(metres, abs=3)
    assert "It is read as centimetres" in notes


@pytest.mark.parametrize("share", [None, 0.3])
def test_alternating_odometry_sources_are_reduced_to_one(
    scans: tuple[Scan, ...], metres: float, share: float | None
) -> None:
    draw = random.Random(1)
    other = [i % 2 == 1 if share is None else draw.random() < share for i in range(len(scans))]
    poses = [
        moved((20.0, 14.0, 1.0), scan.odometry) if is_other else scan.odometry
        for scan, is_other in zip(scans, other, strict=True)
    ]
    track, notes = track_and_notes(with_odometry(scans, poses))
    assert track.way[-1] == pytest.approx(metres, abs=8)
    assert "The poses of several sources alternate in the odometry" in notes


@pytest.mark.parametrize(("count", "is_noted"), [(20, False), (40, True)])
def test_few_scans_far_apart_are_of_one_source(
    scans: tuple[Scan, ...], count: int, is_noted: bool
) -> None:
    poses = [(20.0 * (i % 2), 0.1 * i, 0.0) for i in range(count)]
    log = RobotLog(with_odometry(scans[:count], poses))
    assert bool(keep_one_source(log)[1]) is is_noted


def test_near_alternating_odometry_gives_a_note(scans: tuple[Scan, ...]) -> None:
    draw = random.Random(1)
    poses = [
        moved((1.0, 0.8, 0.05), scan.odometry) if draw.random() < 0.5 else scan.odometry
        for scan in scans
    ]
    assert "The odometry goes back and forth" in track_and_notes(with_odometry(scans, poses))[1]


@pytest.mark.parametrize("block", [1, 10])
def test_note_names_a_log_that_is_not_in_order(scans: tuple[Scan, ...], block: int) -> None:
    blocks = [scans[i : i + block] for i in range(0, 40, block)]
    random.Random(1).shuffle(blocks)
    notes = track_and_notes([scan for some in blocks for scan in some])[1]
    assert "The odometry jumps" in notes or "The usual step between two scans is" in notes


def test_log_with_too_many_breaks_is_refused(
    scans: tuple[Scan, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importing, "MOST_BREAKS", -1.0)
    with pytest.raises(
        LogError, match="expected a log of one drive, got 60 scans of which 0 show nothing"
    ):
        import_log(RobotLog(scans[:60], source="drive"))


def test_note_names_scans_that_turn_unlike_the_odometry(
    scans: tuple[Scan, ...], metres: float
) -> None:
    track, notes = track_and_notes(
        stepwise(scans, lambda i, step: (step[0], step[1], step[2] + (1.2 if i == 70 else 0.0)))
    )
    assert "Scans turn differently from the odometry, once: at scan 70" in notes
    assert "by 69 degrees" in notes
    assert track.way[-1] == pytest.approx(metres, abs=3)


def test_scans_metres_apart_are_not_turned_around_against_the_odometry(
    scans: tuple[Scan, ...],
) -> None:
    log = RobotLog(scans[::3], source="drive")
    assert turned_wrongly(log, tracked(log)[1]) == []


@pytest.mark.parametrize(("metres", "jumps"), [(0.5, 0), (5.0, 1)])
def test_only_a_long_step_of_the_odometer_is_called_a_jump(
    scans: tuple[Scan, ...], metres: float, jumps: int
) -> None:
    log = RobotLog(
        stepwise(scans[:30], lambda i, step: (metres, 0.0, 0.0) if i == 20 else step),
        source="drive",
    )
    track = replace(tracked(log)[1], cuts=(20,), breaks=(20,))
    notes = describe_cuts(log, track, [])
    assert sum("The odometry jumps once" in note for note in notes) == jumps
    assert "The scans do not fit those before them, once" in notes[-1]


def test_poses_keep_the_frame_of_the_first_visit() -> None:
    poses = np.array([(1.0, 2.0, 0.5), (4.0, 6.0, 1.0)])
    found = in_frame_of(np.array([0.0, 0.0, 0.5 - math.pi / 2]), poses)
    expected = [(0.0, 0.0, 0.5 - math.pi / 2), (4.0, -3.0, 1.0 - math.pi / 2)]
    np.testing.assert_allclose(found, expected, atol=1e-12)
