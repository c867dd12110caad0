"""A note names each fault: logs that are shuffled, reversed, of two drives, in other units, or too
sparse."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from coarse import every_second_beam, hall

from perception.errors import LogError
from perception.places import importing, log_checks
from perception.places.following import follow, scans_after_a_carry
from perception.places.importing import import_log, tracked
from perception.places.track import Track, wrapped
from perception.readers.echoes import LaserOptions, interpret_log
from perception.readers.scans import LaserScanner, RobotLog, Scan
from simulator.robot import meetings
from ssh_abduction.cli.mapping import MapQuestion
from ssh_abduction.data.odometry import displacement_between, moved
from ssh_abduction.data.trace import Trace

Scans = Sequence[Scan]


@pytest.fixture(scope="module")
def scans() -> tuple[Scan, ...]:
    """A drive of two tours through a hall, a scan of 90 beams every half metre."""
    return every_second_beam(hall(every=0.5)[:300])


def notes_of(scans: Scans) -> str:
    """All notes on a log, in the order in which a user reads them."""
    said: list[str] = []
    _, _, notes = tracked(RobotLog(tuple(scans), source="drive"), said.append)
    assert tuple(said) == notes
    return "\n".join(notes)


def with_poses(scans: Scans, change: Callable[[float, float, float], tuple[float, ...]]) -> Scans:
    return [replace(scan, odometry=change(*scan.odometry)) for scan in scans]


def backwards(scans: Scans) -> Scans:
    return [replace(scan, time=None) for scan in scans[::-1]]


def in_degrees(scans: Scans) -> Scans:
    return with_poses(scans, lambda x, y, heading: (x, y, math.degrees(heading)))


def sideways(scans: Scans) -> Scans:
    return with_poses(scans, lambda x, y, heading: (x, y, heading + math.pi / 2))


def kidnapped(scans: Scans) -> Scans:
    """The robot is carried while nothing is logged, and the odometer goes on."""
    first, last = scans[:100], scans[170:230]
    poses = [moved(first[-1].odometry, (0.5, 0.0, 0.0))]
    for one, other in pairwise(last):
        poses.append(moved(poses[-1], displacement_between(one.odometry, other.odometry)))
    after = zip(last, poses, strict=True)
    return [
        replace(scan, time=None)
        for scan in [*first, *(replace(scan, odometry=pose) for scan, pose in after)]
    ]


def in_blocks(scans: Scans) -> Scans:
    """Stretches of a drive are in another order."""
    return [scan for i in (160, 80, 120, 40, 0) for scan in scans[i : i + 40]]


def covered(scans: Scans) -> Scans:
    """The laser sees nothing while the robot is carried."""
    dark = np.full(len(scans[0].ranges), np.nan)
    hidden = [replace(scans[100], ranges=dark, time=100 + k) for k in range(50)]
    first, *last = kidnapped(scans)[100:]
    return [*kidnapped(scans)[:100], *hidden, first, *last]


def some_elsewhere(scans: Scans) -> Scans:
    """Each tenth scan is somewhere else in the log."""
    order = [k for k in range(len(scans)) if k % 10]
    for k in range(0, len(scans), 10):
        order.insert(k * 7 % len(order), k)
    return [replace(scans[k], time=float(k)) for k in order]


def of_two_lasers(scans: Scans) -> Scans:
    other = [replace(s, laser=replace(s.laser, mount=(0.1, 0.0, 0.0))) for s in scans[60:120]]
    return [*scans[:60], *other]


def of_two_clocks(scans: Scans) -> Scans:
    return [*scans[:60], *(replace(s, time=(s.time or 0.0) - 1e4) for s in scans[60:120])]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda scans: backwards(scans[:80]), "drives backwards all the way"),
        (lambda scans: in_degrees(scans[:80]), "headings of the odometry are read as degrees"),
        (lambda scans: sideways(scans[:100]), "headings are wrong: write them in radians"),
        (
            lambda scans: with_poses(scans[:100], lambda x, y, h: (x, y, h + math.radians(100))),
            "drives backwards for 18 % of its way",
        ),
        (kidnapped, "do not fit those before them, once: from scan 100 (line or message 171) on"),
        (covered, "The laser sees no wall in 50 scans, from scan 100 "),
        (of_two_lasers, "The laser changes before scan 60"),
        (of_two_clocks, "The clock starts anew before scan 60"),
        (lambda scans: scans[::20], "Take all scans of the drive"),
        (lambda scans: scans[::8], "take all scans of the drive, at least one per metre"),
        (lambda scans: scans[:80], "never comes back to where it was"),
    ],
)
def test_warning_for_each_kind_of_bad_log(
    scans: tuple[Scan, ...], change: Callable[[Scans], Scans], told: str
) -> None:
    assert told in notes_of(change(scans))


@pytest.mark.parametrize(("points", "found"), [(60, [3]), (12, [])])
def test_few_points_do_not_show_that_the_robot_was_carried(points: int, found: list[int]) -> None:
    """The first three scans see free space, and the last three some points in it."""
    laser = LaserScanner(-math.pi / 2, math.pi / 180, 180, 30.0)
    free = np.full(180, 8.0)
    walls = np.where(np.arange(180) < points, 3.0, np.nan)
    scans = [
        Scan(ranges, laser, (0.0, 0.0, 0.0), None, None, k)
        for k, ranges in enumerate([free] * 3 + [walls] * 3)
    ]
    shares = np.array([1.0, 1.0, 1.0, 0.0, 0.9, 0.9])
    track = Track(np.zeros((6, 3)), np.zeros((6, 3, 3)), shares)
    assert scans_after_a_carry(RobotLog(tuple(scans), source="drive"), track) == found


def test_missing_odometry_does_not_turn_wrongly(scans: Scans) -> None:
    notes = notes_of(with_poses(scans[:150:3], lambda x, y, h: (0.0, 0.0, 0.0)))
    assert "Record the odometry" in notes
    assert "turn differently" not in notes


def seen_from(pose: Sequence[float], walls: Sequence[Sequence[float]], line: int) -> Scan:
    """A scan of 180 beams with a reach of 8 m and an odometer that never moves."""
    laser = LaserScanner(-math.pi / 2, math.pi / 180, 180, 8.0)
    met = meetings(np.array(walls), np.array([pose]), laser.bearings).min(axis=2)[0]
    return Scan(np.where(met < 8, met, np.inf), laser, (0.0, 0.0, 0.0), line=line)


def test_scans_far_apart_without_odometry_are_matched() -> None:
    """Their motion is searched, since an odometer that never moves does not show that it stands."""
    chance = np.random.default_rng(1)
    starts = chance.uniform(-9, 9, (40, 2))
    walls = np.column_stack([starts, starts + chance.uniform(-2, 2, (40, 2))])
    poses = [(4 * math.sin(a), -4 * math.cos(a), a) for a in np.arange(0, math.tau, 0.3).tolist()]
    walls = walls[np.abs(np.hypot(*walls.reshape(-1, 2, 2).mean(axis=1).T) - 4) > 1.5]
    track = follow(RobotLog([seen_from(p, walls, line) for line, p in enumerate(poses, 1)]))
    assert math.dist(poses[0][:2], poses[1][:2]) > 1.1
    for k, pair in enumerate(pairwise(poses)):
        step, seen = (
            displacement_between(*pair),
            displacement_between(track.pose(k), track.pose(k + 1)),
        )
        assert math.dist(seen[:2], step[:2]) < 0.2
        assert abs(wrapped(seen[2] - step[2])) < 0.05


def test_end_of_a_seen_wall_does_not_hold_the_robot_back() -> None:
    """In a corridor without features, new points lie beyond the end of the walls seen before."""
    walls = [(-20.0, y, 40.0, y) for y in (-1.0, 1.0)]
    scans = []
    for k in range(40):
        x, y = 0.3 * k, 0.0
        scan = seen_from((x, y, 0.0), walls, k + 1)
        ranges = scan.ranges + np.random.default_rng(k).normal(0, 0.015, len(scan.ranges))
        ranges[np.abs(scan.laser.bearings) < math.radians(65)] = np.nan  # as if they met the floor
        scans.append(replace(scan, ranges=ranges, odometry=(x, y, 0.0)))
    assert follow(RobotLog(scans)).pose(39)[0] == pytest.approx(11.7, abs=0.5)


def one_elsewhere(scans: Scans) -> Scans:
    """One scan of a good drive shows another place."""
    return [*scans[:60], replace(scans[60], ranges=scans[260].ranges), *scans[61:150]]


def hardly_seeing(scans: Scans) -> Scans:
    """In four scans, eight beams meet walls, which no earlier scan shows."""
    beam = np.arange(len(scans[0].ranges))
    usual, few = beam < 45, (beam >= 76) & (beam < 84)
    return [
        replace(s, ranges=np.where(few if 120 <= i < 124 else usual, s.ranges, np.nan))
        for i, s in enumerate(scans[:134])
    ][95:]


@pytest.mark.parametrize("change", [tuple, one_elsewhere, hardly_seeing])
def test_good_log_gets_no_warning_of_a_carry(
    scans: tuple[Scan, ...], change: Callable[[Scans], Scans]
) -> None:
    notes = notes_of(change(scans))
    assert "contradict each other" not in notes
    assert "carried" not in notes


def test_note_says_if_scans_that_contradict_others_are_far_from_them(
    scans: tuple[Scan, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log_checks, "contradicting_scans", lambda log, track: [17])
    _, track, notes = tracked(RobotLog((*scans[:17], *scans[21:80]), source="drive"))
    assert not track.is_reliable
    assert any("m apart: take all scans" in note for note in notes)
    assert "take all scans" not in notes_of(scans[:80])


def test_good_log_gets_no_warning(scans: tuple[Scan, ...]) -> None:
    assert notes_of(scans) == ""


def corridor(niches: Sequence[float]) -> RobotLog:
    """A drive of two rounds, 20 m to and fro, in a corridor without ends that may have niches."""
    walls = [(-60, -1, 80, -1), (-60, 1, 80, 1)]
    for x in niches:
        walls += [(x, 1, x, 0.5), (x, 0.5, x + 1, 0.5), (x + 1, 0.5, x + 1, 1)]
    way, turn = np.arange(0, 20, 0.4), np.arange(0, math.pi, 0.2)
    x = np.concatenate([way, np.full(len(turn), 20), 20 - way, np.zeros(len(turn))])
    heading = np.concatenate([0 * way, turn, 0 * way + math.pi, turn + math.pi])
    poses = np.tile(np.column_stack([x, np.full(len(x), -0.3), heading]), (2, 1))
    laser = LaserScanner(-math.pi / 2, math.pi / 180, 180, 8.0)
    ranges = meetings(np.array(walls, float), poses, laser.bearings).min(axis=2)
    ranges += np.random.default_rng(0).normal(0, 0.01, ranges.shape)
    seen = zip(np.where(ranges < 8, ranges, np.inf), poses.tolist(), strict=True)
    scans = [Scan(r, laser, (a, b, c), None, None, k) for k, (r, (a, b, c)) in enumerate(seen)]
    return RobotLog(tuple(scans), source="corridor")


@pytest.mark.parametrize("niches", [(), (2, 7.5, 11, 19)])
def test_note_says_if_the_robot_comes_back_and_nothing_matches(niches: Sequence[float]) -> None:
    """A bare corridor looks the same everywhere."""
    told = list[str]()
    imported = import_log(corridor(niches), tell=told.append)
    assert bool(imported.trace.closures) == bool(niches)
    assert any("no loop closure is found" in note for note in told) == (not niches)
    assert tuple(told) == imported.notes


@pytest.mark.parametrize("count", [2, 3])
def test_short_log_gets_no_warning_of_going_back_and_forth(
    scans: tuple[Scan, ...], count: int
) -> None:
    assert notes_of(scans[:count]) == ""


def test_odometry_jumps_do_not_make_headings_degrees(scans: tuple[Scan, ...]) -> None:
    notes = notes_of(in_blocks(scans))
    assert "So does a log that is not in the order of the drive" in notes
    assert "headings are wrong" not in notes


@pytest.mark.parametrize(("count", "unit"), [(100, "centimetres"), (1000, "millimetres")])
def test_reader_refuses_ranges_in_other_units(
    scans: tuple[Scan, ...], count: int, unit: str
) -> None:
    longer = [
        replace(s, ranges=count * s.ranges, laser=replace(s.laser, reach=count * s.laser.reach))
        for s in scans
    ]
    with pytest.raises(LogError, match=f"if they are in {unit}, divide the ranges by {count}"):
        tracked(RobotLog(tuple(longer), source="drive"))


def test_reader_refuses_ranges_beyond_the_reach_that_the_log_gives(
    scans: tuple[Scan, ...],
) -> None:
    """The ranges are in centimetres, and the reach is in metres."""
    beyond = [
        replace(s, ranges=np.where(100 * s.ranges < s.laser.reach, 100 * s.ranges, np.inf))
        for s in scans
    ]
    with pytest.raises(LogError, match=r"within the reach of the laser, .* m, got hardly any"):
        tracked(RobotLog(tuple(beyond), source="drive"))


def test_reach_that_the_user_gives_is_told_as_given(scans: tuple[Scan, ...]) -> None:
    log, _ = interpret_log(scans, LaserOptions(no_return=0.7))
    with pytest.raises(LogError, match=r"within the reach of the laser, 0\.7 m"):
        tracked(RobotLog(log, source="drive"))


def test_odometry_of_scans_a_metre_apart_is_converted(scans: Scans) -> None:
    """Scans ten metres apart match nothing, so that they seem to agree with the odometry.

    tests/test_jumps.py has other units.
    """
    notes = notes_of(with_poses(scans[:160:2], lambda x, y, h: (100 * x, 100 * y, h)))
    assert "It is read as centimetres" in notes
    assert "unreliable" not in notes


def test_scans_out_of_order_are_not_taken_for_two_sources(scans: Scans) -> None:
    notes = notes_of(some_elsewhere(scans[:120]))
    assert "not in the order of time, sort it" in notes
    assert "several sources" not in notes


def test_few_scans_far_apart_are_not_converted(scans: Scans) -> None:
    notes = notes_of(scans[::40])
    assert "It is read as" not in notes
    assert "drives backwards" not in notes
    assert "take all scans of the drive" in notes.lower()


def test_headings_in_degrees_are_converted(scans: tuple[Scan, ...]) -> None:
    good, other = (
        tracked(RobotLog(tuple(some), source="drive"))[1]
        for some in (scans[:80], in_degrees(scans[:80]))
    )
    assert other.poses == pytest.approx(good.poses, abs=0.01)


def test_shuffled_log_is_refused_before_matching(
    scans: tuple[Scan, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("perception.places.following.follow", None)
    shuffled = random.Random(1).sample(scans, len(scans))
    with pytest.raises(LogError, match="expected scans in the order of the drive"):
        tracked(RobotLog(tuple(shuffled), source="drive"))


@pytest.mark.slow
def test_log_with_unmatched_scans_is_refused(
    scans: tuple[Scan, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    log = RobotLog(scans[::20], source="drive")
    with pytest.raises(LogError, match="% of them do not; take all scans of the drive"):
        import_log(log)
    # The laser of a robot whose beams are mirrored sees what the odometry contradicts.
    monkeypatch.setattr(log_checks, "SPARSE", 1e9)
    mirrored = [replace(scan, ranges=scan.ranges[::-1].copy()) for scan in scans[:80]]
    assert "contradicts the odometry in" in notes_of(mirrored)
    drives = [RobotLog(tuple(some), source="drive") for some in (scans, mirrored)]
    assert [tracked(drive)[1].is_reliable for drive in drives] == [True, False]


def test_refusal_advises_more_beams_if_scans_have_few(
    scans: Scans, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log_checks, "HOPELESS", -1.0)
    few = every_second_beam(every_second_beam(tuple(scans[:60])))
    assert few[0].laser.beams < log_checks.FEW_BEAMS <= scans[0].laser.beams
    for some, advised in ((few, True), (scans[:60], False)):
        with pytest.raises(LogError, match="got 60, and") as refused:
            import_log(RobotLog(tuple(some), source="drive"))
        assert ("record at least 90 beams per scan" in str(refused.value)) == advised
        assert "; " in str(refused.value)  # there is advice


def test_error_does_not_repeat_the_notes(scans: Scans, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(log_checks, "HOPELESS", -1.0)
    log, told = RobotLog(tuple(backwards(scans[:120])), source="drive"), list[str]()
    with pytest.raises(LogError) as refused:
        import_log(log, tell=told.append)
    assert told == refused.value.__notes__ != []
    assert told[0] not in str(refused.value)
    answer = MapQuestion(None, {}, {}, 0.5, None, 1).failed(0, "drive", refused.value)
    assert answer.warnings == tuple(told)


@pytest.mark.parametrize("missing", [0, 70])
def test_warning_names_missing_scans(scans: Scans, missing: int) -> None:
    notes = notes_of([*scans[:100], *scans[100 + missing : 160 + missing]])
    assert ("The odometry alone connects the parts" in notes) == (missing > 0)
    assert ("before scan 100 " in notes) == (missing > 0)


@pytest.mark.parametrize("most", [3, 20])
def test_long_logs_have_a_limited_number_of_views(
    most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sixty images look like five rooms."""
    monkeypatch.setattr(importing, "MOST_VIEWS", most)
    rng = np.random.default_rng(0)
    rooms = rng.uniform(0.5, 5, (5, 30))
    images = [rooms[i % 5] + rng.normal(0, 0.01, 30) for i in range(60)]
    trace = Trace.from_steps(views=[None] * 60, actions=["travel"] * 59)
    steps = zip(trace.steps, images, strict=True)
    trace = replace(trace, steps=tuple(replace(step, image=image) for step, image in steps))
    found = len(set(importing.with_views(trace).views))
    assert found == 5 if most > 5 else found <= most
