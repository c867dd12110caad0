"""Checks the scans of a drive while they come, by the same checks as for a whole log.

The first scans wait until the units of the odometry are recognised. Later scans are passed on at
once. The scans are checked in stretches of 1,600: when a stretch has 200, 400, 800 and 1,600 scans.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from perception.errors import LogError
from perception.places import jumps, log_checks
from perception.places.units import LEAST_WAY, Units, units_of
from perception.readers.scans import RobotLog, Scan
from ssh_abduction.data.errors import named

# Units are recognised when the robot has moved in MOVES steps and by LEAST_WAY metres, or when MOST
# scans wait.
MOVES, MOST = 100, 2000
# Numbers of scans of a stretch at which it is checked. It is complete at the last number.
LOOKS = (200, 400, 800, 1600)


@lru_cache
def _unknown(beams: int) -> NDArray[np.float64]:
    return np.full(beams, np.nan)


def without_ranges(scan: Scan) -> Scan:
    """Copy a scan, with unknown ranges that need no memory."""
    return replace(scan, ranges=_unknown(len(scan.ranges)))


class Teller:
    """Tells each kind of note once, as soon as it is known.

    Args:
        tell: Takes the notes.

    Attributes:
        notes: The notes so far.
    """

    def __init__(self, tell: Callable[[str], None]) -> None:
        """Start without any note."""
        self._tell = tell
        self.notes: list[str] = []
        self._kinds: set[str] = set()

    def __call__(self, notes: Iterable[str]) -> None:
        """Tell the notes that differ from those before in more than numbers."""
        for note in notes:
            kind = re.split(r"\d", note)[0]
            if kind not in self._kinds:
                self._kinds.add(kind)
                self.notes.append(note)
                self._tell(note)


def watched(scans: Iterable[Scan], tell: Teller, source: str = "") -> Iterator[Scan]:
    """Check scans while they come.

    Args:
        scans: The scans, in order.
        tell: Takes the notes.
        source: Name of the log, for errors.

    Yields:
        The scans, with odometry in metres and radians.

    Raises:
        LogError: The scans are in random order, their ranges are not in metres, or the odometry has
            several sources.
    """
    coming = iter(scans)
    first = _first_of(coming)
    if not first:
        return
    units = _units_of(RobotLog(tuple(first), source=source), tell)
    stretch: list[Scan] = []
    last, begin, standing = first[-1:], 0, jumps.Standing()
    for number, scan in enumerate(map(units.converted, chain(first, coming))):
        if len(stretch) == LOOKS[-1]:
            stretch, begin, standing = last, number - 1, jumps.Standing()
        stretch.append(without_ranges(scan))
        standing.add(scan)
        if len(stretch) in LOOKS:
            tell(_checked(stretch, begin, standing.moved, source))
        last = [scan]
        yield scan
    if len(stretch) > 1 and len(stretch) not in LOOKS:
        tell(_checked(stretch, begin, standing.moved, source))


def _first_of(coming: Iterator[Scan]) -> list[Scan]:
    """Take the first scans of a drive, until they show the units of the odometry."""
    first: list[Scan] = []
    moves, way = 0, 0.0
    for scan in coming:
        if first:
            far = math.dist(first[-1].odometry[:2], scan.odometry[:2])
            moves, way = moves + (far > 0), way + far
        first.append(scan)
        if (moves >= MOVES and way >= LEAST_WAY) or len(first) == MOST:
            break
    return first


def _units_of(log: RobotLog, tell: Teller) -> Units:
    """Recognise the units of the odometry of the first scans of a drive. Raises LogError."""
    log_checks.refuse_lengths(log)
    log_checks.refuse_shuffled(log)
    if jumps.keep_one_source(log)[1]:
        raise LogError(
            f"{named(log.source)}: expected odometry of one source, got poses of several that "
            "alternate; stop the other source, or import the log from a file"
        )
    units, notes = units_of(log)
    tell(notes)
    return units


def _checked(scans: Sequence[Scan], begin: int, unseen: bool, source: str) -> list[str]:
    """Check a stretch of scans.

    Args:
        scans: The scans. Their ranges are not looked at.
        unseen: Whether the robot moves while its odometer stands still.

    Raises:
        LogError: The scans are in random order.
    """
    log = RobotLog(tuple(scans), source=source)
    log_checks.refuse_shuffled(log)
    return log_checks.describe_drive(log, begin, unseen)
