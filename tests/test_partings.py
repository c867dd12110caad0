"""Where stretches of a drive that ran together diverge, each pass has a visit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from perception.places.closures import VisitMatch
from perception.places.distinctive import Visit
from perception.places.local_map import Match
from perception.places.partings import PACE, lead_apart, with_partings
from perception.places.track import Array, Track, points_moved

Points = Sequence[tuple[float, float]]

STRAIGHT = [(0, 0), (20, 0)]
LANE = [(0, 0), (10, 0), (13, 3), (20, 3)]


def walked(corners: Points, pace: float = PACE) -> Array:
    """Points along a polygonal chain: (n, 2) metres."""
    ends = np.array(corners, float)
    far = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(ends, axis=0).T))])
    at = np.arange(0.0, far[-1] + pace / 2, pace)
    return np.stack([np.interp(at, far, ends[:, k]) for k in (0, 1)], axis=1)


@pytest.mark.parametrize(
    ("first", "last", "where"),
    [
        (STRAIGHT, LANE, [(10.5, 0)]),
        (STRAIGHT, LANE[::-1], [(10.5, 0)]),
        (STRAIGHT[::-1], LANE, [(10.5, 0)]),
        (STRAIGHT, [(0, 3), (7, 3), (10, 0), (20, 0)], [(9.5, 0)]),
        (STRAIGHT, [(0, 3), (4, 3), (7, 0), (13, 0), (16, 3), (20, 3)], [(6.5, 0), (13.5, 0)]),
        (STRAIGHT, STRAIGHT, []),
        (STRAIGHT, [(0, 0.8), (20, 0.8)], []),
        (STRAIGHT, [(0, 3), (20, 3)], []),
        (STRAIGHT, [(10, -8), (10, 8)], []),  # a crossing
        (STRAIGHT, [(0, 0), (10, 0), (0, 0)], []),  # the robot turned around
        (STRAIGHT, [(0, 0), (10, 0)], []),  # the log ended
        (STRAIGHT, [(0, 0), (8, 0), (10, 1.5), (12, 0), (20, 0)], []),  # around somebody
    ],
)
def test_lead_apart_finds_where_two_stretches_diverge(
    first: Points, last: Points, where: Points
) -> None:
    ours, theirs = walked(first), walked(last)
    found = [(ours[a] + theirs[b]) / 2 for a, b in lead_apart(cdist(ours, theirs))]
    assert len(found) >= len(where)
    assert all(min(math.dist(p, q) for q in where) < 0.5 for p in found)
    assert all(min(math.dist(p, q) for p in found) < 0.5 for q in where)


def drive(
    passes: Sequence[Points], pose: tuple[float, float, float], others: Points = ()
) -> tuple[Track, list[Visit], list[VisitMatch]]:
    """A drive with several passes. Each later one is moved by a pose, as if the track had drifted.

    Each pass has a visit 2 m after its beginning, and visits at other points of the first pass.
    Closures relate the first pass to each other one.

    Args:
        passes: The corners of each pass in metres.
        pose: How the track of a later pass is off: x and y in metres, and radians.
        others: (x, y) of further visits on the first pass.
    """
    parts = [walked(corners, 0.2) for corners in passes]
    moved = [parts[0], *(points_moved(pose, part) for part in parts[1:])]
    gap = [(1000.0, 0.0), (0.0, 1000.0)]  # between passes, the robot drives far
    points = np.concatenate([part for one in moved for part in (one, gap)][:-1])
    begins = np.cumsum([0, *(len(part) + len(gap) for part in parts[:-1])])
    track = Track(np.column_stack([points, np.zeros(len(points))]), np.zeros((len(points), 3, 3)))
    scans = [int(begin) + 10 for begin in begins]
    closings = [
        VisitMatch(0, len(others) + k, Match(0.9, -pose[2], turned, 0.9, 0.1))
        for k, turned in enumerate([np.zeros(2)] * (len(passes) - 1), 1)
    ]
    more = [int(np.hypot(*(parts[0] - other).T).argmin()) for other in others]
    visits = [Visit(scan, points[scan], scan, scan) for scan in (scans[0], *more, *scans[1:])]
    return track, visits, closings


def added(visits: Sequence[Visit], every: Sequence[Visit]) -> list[Visit]:
    return [visit for visit in every if visit.scan not in {old.scan for old in visits}]


@pytest.mark.parametrize("pose", [(0.0, 0.0, 0.0), (5.0, -3.0, 0.4), (0.0, 50.0, -2.0)])
@pytest.mark.parametrize(("first", "last"), [(STRAIGHT, LANE), (LANE, STRAIGHT)])
def test_each_pass_of_a_parting_gets_a_visit(
    first: Points, last: Points, pose: tuple[float, float, float]
) -> None:
    # The third pass does not leave the first one, but it passes, too.
    track, visits, closings = drive([first, last, first], pose)
    every, closed = with_partings(track, visits, closings)
    new = added(visits, every)
    assert [visit.scan for visit in every] == sorted(visit.scan for visit in every)
    assert len(new) == 3
    middles = [new[0].middle, *points_moved(pose, new[:1][0].middle[None])] * 2
    for visit, middle in zip(new, [*middles[:2], middles[1]], strict=True):
        assert math.dist(visit.middle, middle) < 1e-6
    assert math.dist(new[0].middle, (10.5, 0)) < 0.5
    for visit in new:
        here = track.poses[visit.scan, :2]
        assert math.dist(here, visit.middle) <= 1.0
        assert visit.arrived is not None
        assert visit.left is not None
    # Ways that part have other directions, and the ways of equal passes are equal.
    bearings = [visit.ways[visit.left].bearing for visit in new]  # type: ignore[index]
    assert abs(bearings[1] - pose[2] - bearings[0]) % math.tau > math.radians(20)
    assert math.remainder(bearings[2] - pose[2] - bearings[0], math.tau) == pytest.approx(
        0, abs=0.2
    )
    # Closures are between the same visits as before.
    assert [(every[one.first].scan, every[one.last].scan) for one in closed] == [
        (visits[one.first].scan, visits[one.last].scan) for one in closings
    ]


@pytest.mark.parametrize(("along", "count"), [(20.0, 2), (40.0, 0)])
def test_parting_is_found_up_to_24_m_from_a_closure(along: float, count: int) -> None:
    straight = [(0, 0), (along + 10, 0)]
    lane = [(0, 0), (along, 0), (along + 3, 3), (along + 10, 3)]
    track, visits, closings = drive([straight, lane], (5.0, -3.0, 0.4))
    new = added(visits, with_partings(track, visits, closings)[0])
    assert len(new) == count
    assert all(math.dist(visit.middle, (along + 0.5, 0)) < 0.5 for visit in new[:1])


def test_nearby_visit_serves_as_the_parting() -> None:
    for x, count in ((11.0, 0), (8.0, 2)):
        track, visits, closings = drive([STRAIGHT, LANE], (0.0, 50.0, 0.0), [(x, 0.0)])
        for radius in (0.5, 4.0):  # even if the parting is in its disc
            wide = [replace(visit, radius=radius) for visit in visits]
            assert len(added(wide, with_partings(track, wide, closings)[0])) == count


@pytest.mark.parametrize(("off", "one"), [(0.8, True), (1.3, False)])
def test_visits_with_near_middles_get_one_middle(off: float, one: bool) -> None:
    pose = (5.0, -3.0, 0.4)
    track, visits, closings = drive([STRAIGHT, STRAIGHT], pose, [(9.0, 0.0)])
    middle = points_moved(pose, visits[1].middle[None] + (off, 0.0))[0]
    scan = int(np.hypot(*(track.poses[:, :2] - middle).T).argmin())
    visits.append(Visit(scan, middle, scan, scan))
    every, closed = with_partings(track, visits, closings)
    assert [visit.scan for visit in every] == [visit.scan for visit in visits]
    here, there = every[1].middle, every[3].middle
    assert (math.dist(points_moved(pose, here[None])[0], there) < 1e-6) == one
    assert math.dist(here, visits[1].middle) == pytest.approx(off / 2 if one else 0.0)
    # The closure is between the first visits, which had the same middle already.
    assert [tuple(found.match.shift) for found in closed] == [pytest.approx((0.0, 0.0))]


def test_successive_visits_with_one_middle_are_joined() -> None:
    pose = (5.0, -3.0, 0.4)
    track, visits, closings = drive([STRAIGHT, STRAIGHT], pose, [(9.0, 0.0)])
    for middle in points_moved(pose, np.array([(8.6, 0.0), (9.4, 0.0)])):
        scan = int(np.hypot(*(track.poses[:, :2] - middle).T).argmin())
        visits.append(Visit(scan, middle, scan, scan))
    closings.append(VisitMatch(1, 4, Match(0.9, -pose[2], np.array([0.4, 0.0]), 0.9, 0.1)))
    every, closed = with_partings(track, visits, closings)
    assert [visit.scan for visit in every] == [visit.scan for visit in visits[:4]]
    assert every[3].end == visits[4].end
    assert math.dist(every[3].middle, points_moved(pose, every[1].middle[None])[0]) < 1e-6
    assert [(one.first, one.last) for one in closed] == [(0, 2), (1, 3)]
    assert closed[1].match.shift == pytest.approx((0.0, 0.0))
    # A robot that turned around is not at the place before.
    turned = [*visits[:4], replace(visits[4], support=0.0)]
    every, _ = with_partings(track, turned, closings[:1])
    assert [visit.scan for visit in every] == [visit.scan for visit in visits]
    assert math.dist(every[3].middle, every[4].middle) >= 0.6
    # Across a cut nobody knows whether the robot left the place.
    cut = replace(track, cuts=(visits[4].scan,))
    assert len(with_partings(cut, visits, closings)[0]) == len(visits)


@pytest.mark.parametrize(
    ("course", "radius", "moves"),
    [
        ([(9, -8), (9, 0), (0, 0)], 1.5, True),
        ([(9, -8), (9, 0), (0, 0)], 1.1, False),  # the other middle is not in its disc
        ([(10.2, -8), (10.2, 0), (0, 0)], 1.5, False),  # the robot came near to both
    ],
)
def test_visit_gets_a_nearer_middle_of_other_visits(
    course: Points, radius: float, moves: bool
) -> None:
    middles = np.array([(9.0, 0.0), (9.0, 0.0), (10.2, 0.0)])
    track, begins, _ = drive([STRAIGHT, STRAIGHT, course], (0.0, 0.0, 0.0))
    visits = []
    for begin, middle in zip(begins, middles, strict=True):
        far = np.hypot(*(track.poses[begin.scan :, :2] - middle).T)
        scan = begin.scan + int(far[:80].argmin())
        visits.append(Visit(scan, middle, scan, scan, radius))
    shifts = middles - middles[0]
    closings = [VisitMatch(0, k, Match(0.9, 0.0, shifts[k], 0.9, 0.1)) for k in (1, 2)]
    every, closed = with_partings(track, visits, closings)
    assert tuple(every[-1].middle) == pytest.approx((9.0 if moves else 10.2, 0.0))
    assert closed[1].match.shift == pytest.approx((0.0 if moves else 1.2, 0.0))
    # Between cuts less than PACE metres apart, nothing shows which middle is nearer.
    scan = visits[-1].scan - 1  # no point lies between this scan and the next one
    visits[-1] = replace(visits[-1], scan=scan)
    every, _ = with_partings(replace(track, cuts=(scan, scan + 1)), visits, closings)
    assert tuple(every[-1].middle) == pytest.approx((10.2, 0.0))


def test_stretches_are_compared_after_a_closure_or_short_way() -> None:
    track, visits, closings = drive([STRAIGHT, LANE], (0.0, 0.0, 0.0))
    assert with_partings(track, visits, [])[0] == tuple(visits)
    assert len(with_partings(track, visits, closings)[0]) == 4
    # The robot comes back on another lane after 10 m.
    corners = [(0, 0), (20, 0), (20, 3), (13, 3), (10, 0), (0, 0)]
    points = walked(corners, 0.2)
    track = Track(np.column_stack([points, np.zeros(len(points))]), np.zeros((len(points), 3, 3)))
    visits = [Visit(scan, points[scan], scan, scan) for scan in (30, 190)]
    every, _ = with_partings(track, visits, [])
    assert len(every) == 4
    assert all(math.dist(visit.middle, (11, 0.5)) < 1.0 for visit in added(visits, every))


def test_stretches_do_not_cross_a_cut() -> None:
    track, visits, closings = drive([STRAIGHT, LANE], (0.0, 0.0, 0.0))
    cut = Track(track.poses, track.covariances, cuts=(30,))
    assert with_partings(cut, visits, closings)[0] == tuple(visits)
