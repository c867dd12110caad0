"""Closures that contradict the track and other closures are dropped."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from perception.places.closures import VisitMatch, agreeing, fitted_poses
from perception.places.distinctive import Visit
from perception.places.local_map import Match
from perception.places.track import Array, Track, points_turned

# The robot drives 12 m and comes back on the other side of a long loop.
OUT = np.column_stack([np.arange(0.0, 12.1, 0.5), np.zeros(25), np.zeros(25)])
BACK = OUT[::-1] + np.array([0.0, 0.0, math.pi])
LOOP = np.column_stack([np.full(100, 12.0), np.linspace(0, 100, 100), np.zeros(100)])
VISITS = range(0, 25, 4)  # scans of the first pass; each place is passed again later


def drive(variance: float, bent: float = 0.0) -> tuple[Track, list[Visit]]:
    """A drive over places and back over the same places. The track is bent before the way back."""
    back = BACK.copy()
    back[:, :2] = points_turned(bent, back[:, :2] - 6.0) + 6.0
    back[:, 2] += bent
    poses = np.concatenate([OUT, LOOP, LOOP[::-1], back])
    covariances = np.full((len(poses), 1, 1), variance) * np.diag([1.0, 1.0, 0.01])
    track = Track(poses, covariances)
    last = len(poses) - 1
    scans = [*VISITS, *(last - scan for scan in reversed(VISITS))]
    return track, [Visit(scan, poses[scan, :2], scan, scan) for scan in scans]


def closures(visits: Sequence[Visit], bent: float, wrong: dict[int, Array]) -> list[VisitMatch]:
    """True closures between the two visits of each place; some are shifted."""
    n = len(visits)
    found = []
    for k in reversed(range(n // 2)):
        shift = wrong.get(k, np.zeros(2))
        match = Match(0.9 - 0.01 * k, -bent, shift, 0.9, 0.1)
        found.append(VisitMatch(k, n - 1 - k, match))
    return found


@pytest.mark.parametrize("bent", [0.0, 0.4, -0.4])
@pytest.mark.parametrize("shift", [(2.0, 0.0), (0.0, -3.0)])
def test_closure_that_contradicts_most_others_is_dropped(
    bent: float, shift: tuple[float, float]
) -> None:
    track, visits = drive(5e-4, bent)
    found = closures(visits, bent, {2: np.array(shift)})
    assert [closure.first for closure in agreeing(track, visits, found)] == [6, 5, 4, 3, 1, 0]
    right = closures(visits, bent, {})
    assert agreeing(track, visits, right) == right


@pytest.mark.parametrize("bent", [0.0, 0.4, -0.4])
def test_fitted_poses_straighten_a_bent_track(bent: float) -> None:
    track, visits = drive(5e-4, bent)
    out, back = np.split(fitted_poses(track, visits, closures(visits, bent, {})), 2)
    assert back[::-1] == pytest.approx(out - np.array([0.0, 0.0, bent]), abs=0.05)
    unfitted = fitted_poses(track, visits, [])
    assert unfitted[:, :2].tolist() == [visit.middle.tolist() for visit in visits]
    assert not unfitted[:, 2].any()


def test_closures_are_kept_if_the_track_is_unsure() -> None:
    unsure, visits = drive(1.0, 0.4)
    wrong = closures(visits, 0.4, {2: np.array([2.0, 0.0])})
    assert agreeing(unsure, visits, wrong) == wrong


def test_of_two_closures_the_one_with_the_lower_score_is_dropped() -> None:
    track, visits = drive(1e-5)
    *_, two, one, _ = closures(visits, 0.0, {1: np.array([3.0, 0.0])})
    assert agreeing(track, visits, [two, one]) == [one]
    better = replace(two, match=replace(two.match, score=0.95))
    assert agreeing(track, visits, [better, one]) == [better]


def test_closure_is_dropped_that_contradicts_only_distant_ones() -> None:
    track, visits = drive(5e-4, 0.4)
    far = [visits[0], *visits[5:9], visits[-1]]
    first, *near = (
        VisitMatch(k, 5 - k, closure.match)
        for k, closure in enumerate(reversed(closures(visits, 0.4, {0: np.array([0.0, 6.0])})[-3:]))
    )
    assert agreeing(track, far, [*near, first]) == near


def test_closures_across_a_cut_are_not_compared() -> None:
    track, visits = drive(1e-5)
    two, one = closures(visits, 0.0, {1: np.array([3.0, 0.0])})[-3:-1]
    cut = replace(track, cuts=(visits[one.last].scan,))
    assert agreeing(cut, visits, [two, one]) == [two, one]
