"""Finds scans that contradict the scans before them: walls of one lie in free space of the other.

This happens where the robot was carried while nothing was logged, or where a file holds two drives.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from perception.places.track import Array, Track
from perception.places.walls import FEW_POINTS
from perception.readers.scans import RobotLog
from ssh_abduction.data.odometry import displacement_between, moved

# Points of a scan intrude if they lie in the free space of the other scans, at least MARGIN metres
# from walls. A scan contradicts the scans before it if two things hold: less than the share POORLY
# of its points matches, and more than the share INTRUDING of either side intrudes. BESIDE scans on
# each side are compared. In good logs, at most 27 % of the points of scans that match so badly
# intrude. The share INTRUDING_RARELY suffices if the share that matches is more than WORSE below
# the RARELY-th percentile of the log.
INTRUDING, MARGIN, POORLY, BESIDE = 0.3, 0.4, 0.6, 3
INTRUDING_RARELY, WORSE, RARELY = 0.15, 0.25, 1.0


def contradicting_scans(log: RobotLog, track: Track) -> list[int]:
    """Find the scans that match badly and contradict the scans before them."""
    rare = float(np.nanpercentile(track.shares, RARELY)) - WORSE
    return [
        i
        for i, share in _intruding_shares(log, track).items()
        if share > (INTRUDING_RARELY if track.shares[i] < rare else INTRUDING)
    ]


def scans_after_a_carry(log: RobotLog, track: Track) -> list[int]:
    """Find the scans to which the robot was carried, although the odometer does not jump.

    Of contradicting scans near each other, the one that contradicts most is listed.
    """
    shares = _intruding_shares(log, track)
    return [
        i
        for i, share in shares.items()
        if share > INTRUDING
        and (share, -i) == max((shares.get(k, 0.0), -k) for k in range(i - BESIDE, i + BESIDE + 1))
    ]


def _intruding_shares(log: RobotLog, track: Track) -> dict[int, float]:
    """For each scan that matches badly, the share of points that intrude on either side."""
    found: dict[int, float] = {}
    # A scan without a share meets no wall, or the laser is covered.
    seeing = ~np.isnan(track.shares)
    for i in np.flatnonzero(track.shares < POORLY).tolist():
        before = [k for k in range(max(0, i - BESIDE), i) if seeing[k]]
        after = [k for k in range(i, min(len(log), i + BESIDE)) if seeing[k]]
        if before and not track.cuts_between(i - BESIDE, i + BESIDE - 1):
            # If the next scans do not contradict, this scan alone was matched wrongly.
            found[i] = min(
                _intruding_share(log, track, before, some) for some in (after, after[1:]) if some
            )
    return found


def _intruding_share(
    log: RobotLog, track: Track, before: Sequence[int], after: Sequence[int]
) -> float:
    """The share of the points of either scans that intrude on the others; 0 for few points."""
    pairs = [pair for k in before for n in after for pair in ((k, n), (n, k))]
    inside, seen = np.sum([_intruding(log, track, *pair) for pair in pairs], axis=0)
    return float(inside / seen) if seen >= FEW_POINTS * len(pairs) else 0.0


def _intruding(log: RobotLog, track: Track, one: int, other: int) -> tuple[int, int]:
    """Count the points of scan `one` in the free space of `other`, and those in its view."""
    pose = moved(track.pose(one), log.scans[one].laser.mount)
    scan, laser = log.scans[other], log.scans[other].laser
    x, y, heading = displacement_between(moved(track.pose(other), laser.mount), pose)
    met = np.isfinite(log.scans[one].ranges) & (log.scans[one].ranges > 0)
    angles = log.scans[one].laser.bearings[met] + heading
    points = log.scans[one].ranges[met] * np.exp(1j * angles) + complex(x, y)
    onward = math.copysign(1.0, laser.step)
    beam = np.rint(onward * (np.angle(points) - laser.first) % math.tau / abs(laser.step))
    beam = beam.astype(int)
    in_view = (beam >= 1) & (beam < len(scan.ranges) - 1)
    beam, far = beam[in_view], np.abs(points[in_view])
    ranges = np.nan_to_num(scan.ranges, nan=0.0, posinf=laser.reach)
    free, wall = (_neighbours(ranges, beam, best) for best in (np.min, np.max))
    margin = MARGIN + MARGIN / 8 * far
    return int((far < free - margin).sum()), int((far < wall + MARGIN).sum())


def _neighbours(ranges: Array, beam: Array, best: Callable[..., Array]) -> Array:
    """For each of k beams, the `best` (np.min or np.max) of its range and its neighbours', (k,)."""
    return best([ranges[beam - 1], ranges[beam], ranges[beam + 1]], axis=0)
