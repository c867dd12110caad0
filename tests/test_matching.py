"""Matches of local maps, and closures between visits that the track allows."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from test_distinctive import log_of

from perception.places import closures, local_map
from perception.places.closures import VisitMatch, find_closures, uncertainty
from perception.places.distinctive import WINDOW, Visit, Way, find_visits
from perception.places.following import Followed, ScanMotion, Surfaces
from perception.places.local_map import CELL, LocalScene, Match, PackedPatch, Patch, Turned, match
from perception.places.tracing import closure_of, to_trace
from perception.places.track import Track, odometer_covariance, points_turned
from perception.readers.scans import LaserScanner, RobotLog, Scan
from ssh_abduction.data.odometry import displacement_between

# Corners of a room that looks different from all sides, in metres, counterclockwise.
ROOM = [(-3, -2), (4, -2), (4, 0.5), (2, 0.5), (2, 3), (-1, 3), (-1, 1.5), (-3, 1.5)]
ALL_TURNS = np.arange(-60, 60) * math.radians(3)


def patch_of(turn: float = 0.0, x: float = 0.0, y: float = 0.0, corners: object = ROOM) -> Patch:
    """The local map of a room that is turned by radians and then shifted by metres."""
    points = points_turned(turn, np.array(corners, float)) + np.array([x, y])
    at = np.arange(-80, 81) * CELL
    here = np.stack(np.meshgrid(at, at, indexing="ij"), axis=2)
    inside = np.zeros(here.shape[:2], bool)
    for (ax, ay), (bx, by) in zip(points, np.roll(points, -1, axis=0), strict=True):
        if ay != by:
            crosses = (ay > here[..., 1]) != (by > here[..., 1])
            inside ^= crosses & (here[..., 0] < ax + (here[..., 1] - ay) / (by - ay) * (bx - ax))
    walls = np.zeros_like(inside)
    for axis in (0, 1):
        walls |= inside != np.roll(inside, 1, axis=axis)
    return Patch(inside & ~walls, walls, np.zeros_like(inside), np.array([-8.0, -8.0]))


def scene(patch: Patch) -> LocalScene:
    return LocalScene.of(patch, np.zeros(2))


@pytest.mark.parametrize(
    ("turn", "x", "y"), [(0.0, 0.0, 0.0), (0.3, 0.62, -0.4), (-2.0, -1.0, 0.5), (3.1, 0.0, 2.0)]
)
def test_match_finds_turn_and_shift_of_a_room(turn: float, x: float, y: float) -> None:
    found = match(scene(patch_of(turn, x, y)), Turned.of(scene(patch_of()), ALL_TURNS.tolist()))
    assert found is not None
    assert found.score > 0.75
    assert found.mutual > 0.9
    assert found.spread < 0.5
    assert math.dist(found.shift, (x, y)) < 0.12
    assert abs(math.remainder(found.turn - turn, math.tau)) < math.radians(1.5)


def test_match_that_slides_is_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    shifted, room = scene(patch_of(0.3, 0.6, -0.4)), Turned.of(scene(patch_of()), [0.3])
    assert match(shifted, room) is not None
    monkeypatch.setattr(local_map, "SLID", 0.1)  # the coarse shift is 0.2 m off
    assert match(shifted, room) is None


def test_only_shifts_with_enough_common_area_are_tried() -> None:
    aside = Turned.of(scene(patch_of(0.0, 4.5, 0.0)), [0.0])  # its right part is out of reach
    found = match(scene(patch_of()), aside)
    assert found is not None
    again = match(scene(patch_of()), aside, 0.5)
    assert again is not None
    assert again.shift.tolist() == found.shift.tolist()
    assert match(scene(patch_of()), aside, 1.1) is None


def test_match_of_another_room_scores_low() -> None:
    other = [(-5, -1), (5, -1), (5, 1), (-5, 1)]
    found = match(scene(patch_of()), Turned.of(scene(patch_of(corners=other)), ALL_TURNS.tolist()))
    assert found is None or found.score < 0.6 or found.mutual < 0.2


def test_wall_in_free_space_lowers_the_score() -> None:
    room = patch_of()
    split = room.occupied.copy()
    split[80, 70:95] = True
    halved = replace(room, occupied=split, free=room.free & ~split)
    whole, parted = (match(scene(room), Turned.of(scene(other), [0.0])) for other in (room, halved))
    assert whole is not None
    assert parted is not None
    assert whole.score > parted.score + 0.05


@cache
def rounds() -> tuple[RobotLog, Track, tuple[Visit, ...], list[PackedPatch]]:
    """A robot drives twice to the end of a side corridor and back."""
    walls = [(-9, -1, 2, -1), (3, -1, 7, -1), (8.5, -1, 19, -1), (-9, 1, 4, 1), (6, 1, 19, 1)]
    walls += [(2, -2.5, 3, -2.5), (2, -2.5, 2, -1), (3, -2.5, 3, -1)]  # two niches
    walls += [(7, -1.8, 8.5, -1.8), (7, -1.8, 7, -1), (8.5, -1.8, 8.5, -1)]
    walls += [(4, 1, 4, 9), (6, 1, 6, 9), (4, 9, 6, 9), (-9, -1, -9, 1), (19, -1, 19, 1)]
    log, track = log_of(walls, [(-7, 0), (5, 0), (5, 7), (5, 0), (17, 0), (5, 0), (5, 7)])
    visits = find_visits(log, track)
    return log, track, visits, [visit.patch for visit in visits if visit.patch is not None]


def test_visits_to_one_fork_have_a_closure() -> None:
    _, track, visits, _ = rounds()
    found = find_closures(track, visits, 2 * WINDOW)
    assert found
    for closing in found:
        first, last = visits[closing.first], visits[closing.last]
        assert track.way[last.scan] - track.way[first.scan] > 2 * WINDOW
        assert math.dist(closing.match.shift, last.middle - first.middle) < 0.1
        assert abs(closing.match.turn) < math.radians(1)


def test_closure_that_contradicts_the_track_is_dropped() -> None:
    """The later visits are 4 m aside by a track that is sure of itself."""
    _, track, visits, patches = rounds()
    late = find_closures(track, visits, 2 * WINDOW)[0].last
    aside = np.array([0.0, 4.0])
    shifted = [replace(patch, corner=patch.corner + aside) for patch in patches]
    moved = [
        replace(visit, middle=visit.middle + aside, patch=patch) if k >= late else visit
        for k, (visit, patch) in enumerate(zip(visits, shifted, strict=True))
    ]
    sure = replace(track, covariances=track.covariances / 100)
    found = find_closures(sure, moved, 2 * WINDOW)
    assert all(not closing.first < late <= closing.last for closing in found)


def test_closures_do_not_cross_a_cut() -> None:
    _, track, visits, _patches = rounds()
    (closing, *_) = find_closures(track, visits, 2 * WINDOW)
    cut = replace(track, cuts=(visits[closing.last].scan,))
    found = find_closures(cut, visits, 2 * WINDOW)
    assert all(not c.first < closing.last <= c.last for c in found)


def test_trace_has_the_closures_of_its_visits() -> None:
    log, track, visits, _patches = rounds()
    expected = find_closures(track, visits, 2 * WINDOW)
    trace = to_trace(log, track, visits, expected)
    assert len(trace.closures) == len(expected) > 0
    for closure, closing in zip(trace.closures, expected, strict=True):
        steps = [trace.steps[step] for step in (closure.first, closure.last)]
        assert [step.extra["visit"] for step in steps] == [closing.first, closing.last]
        # The truth is unknown here, but the odometer is exact.
        poses = []
        for step in steps:
            scan = track.poses[step.extra["scan"]]
            x, y, turn = step.extra["seen"]
            ahead, left = points_turned(scan[2], np.array([[x, y]]))[0]
            poses.append((scan[0] + ahead, scan[1] + left, scan[2] + turn))
        assert closure.displacement == pytest.approx(displacement_between(*poses), abs=0.1)


def test_trace_describes_the_ways_out_of_a_place() -> None:
    """A corridor of 2 m ends 4 m ahead at a wall. Behind, the local map ends before it does."""
    free = np.zeros((161, 161), np.bool_)
    free[:120, 71:90] = True  # x from -8 to 3.9 m, y from -0.9 to 0.9 m
    walls = np.zeros_like(free)
    walls[120, 70:91] = walls[:121, 70] = walls[:121, 90] = True
    patch = PackedPatch.of(Patch(free, walls, free & False, np.array([-8.0, -8.0])))
    ways = (Way(0.0), Way(math.pi))
    visit = Visit(0, np.zeros(2), 0, 0, radius=1.0, ways=ways, patch=patch)
    laser = LaserScanner(-math.pi / 2, math.radians(1), 181, 8.0)
    log = RobotLog((Scan(np.full(181, 8.0), laser, (0.0, 0.0, 0.0)),), source="corridor")
    track = Track(np.zeros((1, 3)), np.zeros((1, 3, 3)), np.ones(1))
    (step,) = to_trace(log, track, [visit]).steps
    assert step.star is not None
    for gateway, branch in zip(step.star, step.extra["branches"], strict=True):
        ahead = abs(gateway.bearing) < 1
        assert branch["width"] == pytest.approx(1.9, abs=0.15)
        assert branch["length"] == pytest.approx(4.0 if ahead else 8.0, abs=0.15)
        assert branch["end_seen"] is ahead


def test_closure_is_relative_to_the_heading_of_the_earlier_step() -> None:
    shift = Match(1.0, 0.1, np.array([1.0, 0.0]), 1.0, 0.1)
    closure = closure_of(VisitMatch(0, 1, shift), [(0, math.pi / 2), (1, math.pi)])
    assert closure.displacement == pytest.approx((0.0, -1.0, math.pi / 2 + 0.1), abs=1e-4)


@pytest.mark.parametrize(("share", "is_wide"), [(1.0, False), (0.7, True)])
def test_match_against_the_odometer_gets_a_large_covariance(share: float, is_wide: bool) -> None:
    """The odometer turned by 0.5 radians, and the walls say that the robot did not turn."""
    along = np.linspace(-3, 3, 61)
    sides = [(along, np.full(61, 2.0)), (along, np.full(61, -2.0)), (np.full(61, 3.5), along)]
    walls = np.concatenate([np.stack(side, axis=1) for side in sides])
    normals = np.repeat([[0.0, 1.0], [0.0, -1.0], [1.0, 0.0]], 61, axis=0)
    seen = walls.copy()
    astray = np.arange(len(walls)) % 100 >= 100 * share
    seen[astray] *= 0.4  # people in the room
    still, turned = (0.0, 0.0, 0.0), (0.0, 0.0, 0.5)
    scan = Scan(np.zeros(1), LaserScanner(0.0, 0.1, 1, 8.0), turned)
    lengths = np.full(len(walls), 0.3)
    recent = [Surfaces(walls, normals, lengths)]
    motion = ScanMotion(scan, Surfaces(seen, normals, lengths), recent, still, turned, still)
    pose, covariance, found = motion.matched(turned, odometer_covariance(still))
    assert abs(pose[2]) < 0.05
    assert found == pytest.approx(share, abs=0.1)
    assert bool(covariance[2, 2] > 0.4**2) is is_wide


def test_covariance_of_a_point_sums_all_increments() -> None:
    """Each increment is an arm that ends at the point; the sum is computed one by one."""
    rng = np.random.default_rng(1)
    poses = np.column_stack([np.cumsum(rng.normal(0, 1, (9, 2)), axis=0), rng.normal(0, 1, 9)])
    halves = rng.normal(0, 0.1, (9, 3, 3))
    track = Track(poses, halves @ halves.transpose(0, 2, 1))
    end, expected = np.array([4.0, -2.0]), np.zeros((3, 3))
    for i in range(3, 8):
        x, y = end - poses[i, :2]
        cos, sin = math.cos(poses[i - 1, 2]), math.sin(poses[i - 1, 2])
        arm = np.array([[cos, -sin, -y], [sin, cos, x], [0.0, 0.0, 1.0]])
        expected += arm @ track.covariances[i] @ arm.T
    assert uncertainty(track, 2, 7, end) == pytest.approx(expected)
    assert uncertainty(replace(track, factor=2.0), 7, 2, end) == pytest.approx(2 * expected)


def test_visit_is_matched_with_a_limited_number_of_earlier_ones(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """If each visit is matched once, then with the nearest one: another pass of the same fork."""
    _, track, visits, _patches = rounds()
    every = find_closures(track, visits, 2 * WINDOW)
    asked: list[LocalScene] = []

    def counted(first: LocalScene, second: Turned) -> Match | None:
        asked.append(second.scene)
        return match(first, second)

    monkeypatch.setattr(closures, "match", counted)
    monkeypatch.setattr(closures, "MATCHES", 1)
    found = find_closures(track, visits, 2 * WINDOW)
    assert len(asked) == len(set(map(id, asked))) <= len(visits)
    assert {closing.last for closing in found} == {closing.last for closing in every}


@pytest.mark.parametrize(
    ("points", "free", "turned"), [(20, 3.0, 0.0), (300, 3.0, -45.0), (300, 8.0, 0.0)]
)
def test_neither_few_points_nor_points_in_free_space_outweigh_the_odometer(
    points: int, free: float, turned: float
) -> None:
    """The scan shows a wall 45 degrees to the left of one that looks the same.

    The last keyframe saw `free` metres of free space.
    """

    def wall(bearing: float) -> Surfaces:
        ahead = Surfaces(
            np.stack([np.full(points, 3.0), np.linspace(-1, 1, points)], 1),
            np.tile([-1.0, 0.0], (points, 1)),
            np.full(points, 0.3),
        )
        return ahead.moved((0.0, 0.0, bearing))

    onward = (0.2, 0.0, 0.0)
    begin, laser = (0.0, 0.0, 0.0), LaserScanner(-math.pi, math.radians(2), 180, 10.0)
    scan, last = Scan(np.full(180, 3.0), laser, onward), Scan(np.full(180, free), laser, begin)
    keys = [Followed(last, begin)]
    motion = ScanMotion(scan, wall(math.pi / 4), [wall(0.0)], begin, onward, onward, keys)
    pose, _, _ = motion.matched(onward, odometer_covariance(onward))
    assert math.degrees(pose[2]) == pytest.approx(turned, abs=6)
