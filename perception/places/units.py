"""Recognises the units of the odometry of a log, and converts it to metres and radians."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from perception.places import jumps
from perception.places.following import follow, share_failing
from perception.places.track import wrapped
from perception.readers.scans import RobotLog, Scan

# Units of odometry, and how many make a metre.
UNITS = {"metres": 1.0, "millimetres": 1000.0, "centimetres": 100.0}
# STRETCH: number of scans over which odometry is compared with scan matching, at least LEAST_SCANS.
# UNLIKE: largest relative difference of the two.
STRETCH, LEAST_SCANS, UNLIKE = 80, 10, 0.25
# Scans do not match if matching fails for more than this share of them. In a wrong unit they may
# agree with the odometry, as it alone decides if nothing matches.
HOPELESS = 0.5
# Scans that are farther apart than SPARSE metres overlap too little, and those farther apart than
# FAR_OFF hardly overlap. Good logs have up to 1 m.
SPARSE, FAR_OFF = 1.5, 5.0
# Share of the way that the robot drives straight ahead by the headings of its odometry: good logs
# have 0.95 or more, reversed logs -0.99, headings in degrees at most 0.1. It is judged from
# LEAST_WAY metres on.
AHEAD, SIDEWAYS, LEAST_WAY = 0.9, 0.5, 10.0


@dataclass(frozen=True)
class Units:
    """The units of odometry."""

    count: float = 1.0  # how many units of length make a metre
    degrees: bool = False  # whether headings are in degrees

    def converted(self, scan: Scan) -> Scan:
        """Copy a scan, with its odometry in metres and radians."""
        if self == Units():
            return scan
        x, y, heading = scan.odometry
        heading = wrapped(math.radians(heading)) if self.degrees else heading
        return replace(scan, odometry=(x / self.count, y / self.count, heading))

    def convert(self, log: RobotLog) -> RobotLog:
        """Copy a log, with its odometry in metres and radians."""
        return log if self == Units() else replace(log, scans=tuple(map(self.converted, log.scans)))


def units_of(log: RobotLog) -> tuple[Units, list[str]]:
    """Recognise the units of a log's odometry. Also return notes on other units than m and rad."""
    count, counted = _length(log)
    log = Units(count).convert(log)
    degrees = way_of(log) >= LEAST_WAY and abs(ahead(log)) <= SIDEWAYS
    # The robot drives ahead by headings in the right unit only.
    degrees = degrees and ahead(Units(degrees=True).convert(log)) >= AHEAD
    turned = [
        "The headings of the odometry are read as degrees: by radians, the robot would drive "
        "sideways. Write them in radians to be sure."
    ]
    return Units(count, degrees), [*counted, *(turned if degrees else [])]


def _length(log: RobotLog) -> tuple[float, list[str]]:
    """Recognise from a stretch of the log how many units make a metre. Also return notes."""
    usual = jumps.usual_step(log)
    if usual <= SPARSE:
        return 1.0, []
    far = np.hypot(*np.diff(log.odometry[:, :2], axis=0).T)
    begin = int(np.argmax(far > usual / 2))
    stretch = replace(log, scans=log.scans[begin : begin + STRETCH])
    if len(stretch) < LEAST_SCANS:
        return 1.0, []

    # Relative difference between odometry in this unit and scan matching.
    def off(unit: str) -> float:
        tried = Units(UNITS[unit]).convert(stretch)
        seen = follow(tried)
        ways = [np.hypot(*np.diff(way[:, :2], axis=0).T) for way in (tried.odometry, seen.poses)]
        if seen.breaks or share_failing(seen) > HOPELESS:
            return math.inf
        return float(np.abs(ways[0] - ways[1]).sum() / max(ways[1].sum(), 1e-9))

    # Matching cannot correct metres that are too large to be true.
    offs = {unit: off(unit) for unit in UNITS if unit != "metres" or usual <= FAR_OFF}
    found = min(offs, key=offs.__getitem__)
    if found == "metres" or offs[found] > UNLIKE:
        return 1.0, []
    count = UNITS[found]
    return count, [
        "The odometry does not count metres: its usual step between two scans would be "
        f"{usual:.0f} m. It is read as {found}, which agrees with scan matching: "
        f"{usual / count:.2f} m per step."
    ]


def ahead(log: RobotLog) -> float:
    """Compute the share of the way that the robot drives ahead, from -1 (backwards) to 1.

    It is 1 for a robot that stands. Jumps of the odometer do not count.
    """
    poses = log.odometry
    steps = np.diff(poses[:, :2], axis=0)
    length = np.hypot(*steps.T)
    length[length > max(jumps.FAR, jumps.UNUSUAL * jumps.usual_step(log))] = 0.0
    if not length.any():
        return 1.0
    turns = (np.diff(poses[:, 2]) + math.pi) % math.tau - math.pi
    off = np.arctan2(steps[:, 1], steps[:, 0]) - poses[:-1, 2] - turns / 2
    return float((length * np.cos(off)).sum() / length.sum())


def way_of(log: RobotLog) -> float:
    """Compute the length of the drive by odometry, in metres."""
    return float(np.hypot(*np.diff(log.odometry[:, :2], axis=0).T).sum())
