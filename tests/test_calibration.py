"""The covariances of a track are multiplied by a factor that follows from closures."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from perception.places.closures import VisitMatch, factor_of
from perception.places.distinctive import Visit
from perception.places.local_map import Match
from perception.places.track import Array, Track, points_turned

# The stated standard deviations of a motion, in metres and radians.
STATED = np.array([0.02, 0.02, 0.01])
LAPS, SIDE = 8, 20  # a square of SIDE motions of 0.5 m per side


def poses_of(errors: Array, drift: float) -> Array:
    """The poses of a track around a square, whose motions have errors: (n, 3)."""
    poses = [np.zeros(3)]
    for k, error in enumerate(errors, 1):
        x, y, heading = poses[-1]
        turn = math.pi / 2 if k % SIDE == 0 else 0.0
        onward = points_turned(heading, np.array([[0.5 + error[0], error[1]]]))[0]
        poses.append(np.array([x + onward[0], y + onward[1], heading + turn + error[2] + drift]))
    return np.array(poses)


def driven(
    factor: float, seed: int, drift: float = 0.0, wrong: int = 0
) -> tuple[Track, list[Visit], list[VisitMatch]]:
    """A track whose errors have `factor` times the stated covariances, and its closures."""
    chance, count = np.random.default_rng(seed), LAPS * 4 * SIDE
    true = poses_of(np.zeros((count, 3)), 0.0)
    poses = poses_of(chance.normal(size=(count, 3)) * STATED * math.sqrt(factor), drift)
    covariances = np.tile(np.diag(STATED**2), (count + 1, 1, 1))
    scans = range(0, count, 4 * SIDE)
    visits = [
        Visit(k, poses[k, :2], 1.0, (), arrived=None, left=None, patch=None)  # type: ignore[arg-type]
        for k in scans
    ]
    closings = []
    for last in range(1, len(visits)):
        for first in range(max(0, last - 3), last):
            a, b = scans[first], scans[last]
            # The axes of both visits are those of the track, so the true turn is that of its error.
            turn = (true[b, 2] - poses[b, 2]) - (true[a, 2] - poses[a, 2])
            shift = points_turned(poses[a, 2] - true[a, 2], true[b : b + 1, :2] - true[a, :2])[0]
            shift = shift + chance.normal(size=2) * 0.05 + (3.0 if len(closings) < wrong else 0.0)
            turn += chance.normal() * math.radians(0.5)
            closings.append(VisitMatch(first, last, Match(0.9, turn, shift, 0.9, 0.2)))
    return Track(poses, covariances), visits, closings


@pytest.mark.parametrize("factor", [0.1, 1.0, 6.0])
def test_calibration_estimates_the_precision_of_a_track(factor: float) -> None:
    found = [factor_of(*driven(factor, seed)) for seed in range(10)]
    assert factor / 2 <= np.median(found) <= factor * 2
    assert factor / 4 < min(found) <= max(found) < factor * 4


def test_calibration_ignores_a_steady_drift() -> None:
    found = [factor_of(*driven(1.0, seed, drift=0.0005)) for seed in range(10)]
    assert np.median(found) == pytest.approx(1.0, rel=0.5)


def test_one_wrong_closure_hardly_changes_the_calibration() -> None:
    right, one_wrong = (factor_of(*driven(0.1, seed=3, wrong=wrong)) for wrong in (0, 1))
    assert one_wrong <= 2 * right


def test_track_without_closures_keeps_its_covariances() -> None:
    track, visits, closings = driven(4.0, seed=0)
    assert factor_of(track, visits, []) == 1
    factor = factor_of(track, visits, closings)
    assert replace(track, factor=factor).corrected[1:2][0, 0, 0] > STATED[0] ** 2
