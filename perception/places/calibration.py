"""Estimates from the closures of a log how precise its track is.

The covariances of matched scans hold for no robot in particular. Closures measure where the track
went wrong. So the covariances of the track are multiplied by the factor that makes the errors at
the closures most probable. A steady drift of the heading is estimated with it, and taken out: it is
an unknown of the map, and no part of the covariances.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from perception.places.closures import GATE, INFLATED, Closing, drifted, uncertainty
from perception.places.track import Array, Track
from perception.places.visits import Visit

# Standard deviations of the error of a closure, in metres and radians (docs/measurements/logs.md).
ERROR = (0.05, 0.05, math.radians(0.5))
# The factors that are tried, and the standard deviation of their natural logarithm. So a few
# closures do not change the covariances much.
FACTORS = 2.0 ** np.arange(-7, 5, 0.5)
CHANGE = 0.5
# The drifts that are tried, in radians a metre, and their standard deviation.
DRIFTS = np.linspace(-0.002, 0.002, 21)
DRIFT = 0.001
# The share of closures that are wrong, and the logarithm of the volume of their errors: those that
# closures may have at all, if the covariance is 1. It is that of a ball.
WRONG = 0.02
VOLUME = math.log(4 / 3 * math.pi * (INFLATED * GATE) ** 1.5)


def calibrated(track: Track, visits: Sequence[Visit], closings: Sequence[Closing]) -> Track:
    """Return a track with covariances that agree with the closures.

    Args:
        track: Trajectory of the robot.
        visits: The visits, in order.
        closings: The closures between them; with none, the track stays as it is.
    """
    return replace(track, covariances=track.covariances * factor_of(track, visits, closings))


def factor_of(track: Track, visits: Sequence[Visit], closings: Sequence[Closing]) -> float:
    """Estimate by what the covariances of a track have to be multiplied. See `calibrated`."""
    if not closings:
        return 1.0
    scans = [visit.scan for visit in visits]
    middles = np.array([visit.middle for visit in visits])
    spreads = np.array(
        [uncertainty(track, scans[c.first], scans[c.last], middles[c.last]) for c in closings]
    )
    spread = FACTORS[:, None, None, None] * spreads + np.diag(ERROR) ** 2  # (factors, closures)
    inverse, size = np.linalg.inv(spread), np.linalg.slogdet(math.tau * spread)[1]
    wrong = math.log(WRONG) - VOLUME - np.linalg.slogdet(spreads + np.diag(ERROR) ** 2)[1] / 2
    best = np.full(len(FACTORS), -np.inf)
    for drift in DRIFTS:
        off = _errors(drifted(middles, track.way[scans], drift), closings)
        squares = np.einsum("ni,fnij,nj->fn", off, inverse, off)
        right = math.log(1 - WRONG) - (squares + size) / 2
        fits = np.logaddexp(right, wrong).sum(axis=1) - (drift / DRIFT) ** 2 / 2
        best = np.maximum(best, fits)
    best -= (np.log(FACTORS) / CHANGE) ** 2 / 2
    return float(FACTORS[best.argmax()])


def _errors(poses: Array, closings: Sequence[Closing]) -> Array:
    """Compute how far the later visit of each closure is off: (n, 3) metres and radians."""
    first, last = poses[[c.first for c in closings]], poses[[c.last for c in closings]]
    cos, sin = np.cos(first[:, 2]), np.sin(first[:, 2])
    x, y = (last - first)[:, :2].T
    there = np.stack([cos * x + sin * y, cos * y - sin * x, (last - first)[:, 2]], axis=1)
    off = there - np.array([(*c.match.shift, c.match.turn) for c in closings])
    off[:, 2] = (off[:, 2] + math.pi) % math.tau - math.pi
    return np.asarray(off)
