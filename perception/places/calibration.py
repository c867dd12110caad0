"""Estimates from the closures of a log how precise its track is.

Scan matching estimates covariances by the same constants for every robot. Closures measure how far
the track of this robot is really off. So the covariances of the track are multiplied by the factor
that makes the errors at the closures most probable. A steady drift of the heading is estimated at
the same time and removed from these errors, because the covariances do not include it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from perception.places.closures import (
    DRIFTS,
    GATE,
    INFLATED,
    Closing,
    errors_of,
    seen_from,
    uncertainty,
    without_drift,
)
from perception.places.tracing import DRIFT
from perception.places.track import Track
from perception.places.visits import Visit

# Standard deviations of the error of a closure, in metres and radians (docs/measurements/logs.md).
ERROR = (0.05, 0.05, math.radians(0.5))
# The factors that are tried, and the standard deviation of the prior of their natural logarithm.
# Because of this prior, a few closures do not change the covariances much.
FACTORS = 2.0 ** np.arange(-7, 5, 0.5)
CHANGE = 0.5
# WRONG is the share of closures that are wrong. The errors of wrong closures are uniformly
# distributed in the ellipsoid that the gate of `closures` allows. VOLUME is the natural logarithm
# of its volume if the covariance is the unit matrix, so that it is a ball.
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
    """Estimate the factor that corrects the covariances of a track; 1 if there is no closure."""
    if not closings:
        return 1.0
    scans = [visit.scan for visit in visits]
    middles = np.array([visit.middle for visit in visits])
    first, last = [c.first for c in closings], [c.last for c in closings]
    matches = np.array([(*c.match.shift, c.match.turn) for c in closings])
    spreads = np.array(
        [uncertainty(track, scans[c.first], scans[c.last], middles[c.last]) for c in closings]
    )
    spread = FACTORS[:, None, None, None] * spreads + np.diag(ERROR) ** 2  # (factors, closures)
    inverse, size = np.linalg.inv(spread), np.linalg.slogdet(math.tau * spread)[1]
    wrong = math.log(WRONG) - VOLUME - np.linalg.slogdet(spreads + np.diag(ERROR) ** 2)[1] / 2
    best = np.full(len(FACTORS), -np.inf)
    for drift in DRIFTS:
        poses = without_drift(middles, track.way[scans], drift)
        off = errors_of(seen_from(poses[first], poses[last]), matches)
        squares = np.einsum("ni,fnij,nj->fn", off, inverse, off)
        right = math.log(1 - WRONG) - (squares + size) / 2
        fits = np.logaddexp(right, wrong).sum(axis=1) - (drift / DRIFT) ** 2 / 2
        best = np.maximum(best, fits)
    best -= (np.log(FACTORS) / CHANGE) ** 2 / 2
    return float(FACTORS[best.argmax()])
