"""Imports a log while it is read or recorded.

The scans are processed one at a time. Only the track, the visits with their local maps, and about
90 bytes per scan for the checks at the end are kept.

The first scans wait until the units of the odometry are recognised. Then the scans get the checks
of a whole log, but in stretches of 1,600 scans. Each stretch is checked four times: when it has
200, 400, 800 and 1,600 scans.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import chain

from perception.errors import LogError
from perception.places import contradictions, jumps, log_checks
from perception.places.agreement import disagreement
from perception.places.distinctive import WIDTH, visits_of
from perception.places.following import Followed, GrowingTrack, poses_of_scans, turned_wrongly
from perception.places.track import Track
from perception.places.units import LEAST_WAY, Units, units_of
from perception.places.visits import Visit
from perception.readers.scans import Damage, RobotLog, Scan
from perception.readers.stored import ScanTable, without_ranges
from ssh_abduction.data.checks import a_function, a_number
from ssh_abduction.data.errors import brief, named

# The number of first scans over which the track is compared with the odometry.
COMPARED = 400
# The checks at the end need the ranges of the scans before and after a poor match. They are kept
# for at most this many poor matches.
MOST_POOR = 200
# The first SAID notes on cuts of the track are given at once. The others come at the end.
SAID = 3
# Units are recognised when the robot has moved in MOVES steps and by LEAST_WAY metres, or when MOST
# scans wait.
MOVES, MOST = 100, 2000
# Numbers of scans of a stretch at which it is checked. It is complete at the last number.
LOOKS = (200, 400, 800, 1600)


class LiveLog:
    """The track and the visits of a drive, found while its scans come.

    The arguments are those of `importing.import_live`. Raises LogError if one is invalid.
    """

    def __init__(
        self,
        items: Iterable[Scan | Damage],
        width: float = WIDTH,
        tell: Callable[[str], None] = lambda note: None,
        source: str = "",
    ) -> None:
        mend = "give the width of the robot"
        a_number("width", width, LogError, above=0, what="metres", mend=mend)
        if not isinstance(items, Iterable) or isinstance(items, str | bytes):
            raise LogError(
                f"scans: expected scans, got {brief(items)}; pass the scans of stream_log"
            )
        a_function("tell", tell, LogError, what="a function that takes a text")
        self._items, self._width, self._source = items, width, source
        self._tell = Teller(tell)
        self._damaged: list[Damage] = []
        self._scans = ScanTable()
        self._begun: list[Scan] = []  # the first COMPARED scans, with their ranges
        self._latest: deque[Scan] = deque(maxlen=contradictions.BESIDE + 1)
        self._poor = self._wanted = 0  # poor matches so far, and scans to keep after the last one
        self._done = GrowingTrack()

    def visits(self) -> Iterator[Visit]:
        """Yield each visit with its local map, in order, when it is final."""
        return visits_of(self._followed(), self._width)

    def result(self) -> tuple[RobotLog, Track, tuple[str, ...]]:
        """Return the log, its track and notes. Call this after `visits` has yielded all visits.

        Hardly any scan has ranges. Raises LogError if there is no scan.
        """
        log, track = self._log, self._done.track
        if not len(log):
            raise LogError(f"{named(self._source)}: expected scans, got none; record the laser")
        explained = bool(self._tell.notes)
        self._tell(jumps.describe_cuts(log, track, turned_wrongly(log, track)))
        track, doubts = log_checks.judged(log, track, explained)
        self._tell(doubts)
        return log, track, tuple(self._tell.notes)

    def _followed(self) -> Iterator[Followed]:
        """Follow the robot, and keep what is needed of each scan."""
        scans = watched(self._scans_of(), self._tell, self._source)
        for one in poses_of_scans(scans, jumps.LiveJumps()):
            self._keep(one)
            if len(self._scans) == COMPARED:
                self._compare()
            yield one
        if len(self._scans) < COMPARED:
            self._compare()

    def _scans_of(self) -> Iterator[Scan]:
        """Yield the scans among the items, and note the damaged parts. Raises LogError."""
        for number, item in enumerate(self._items):
            if isinstance(item, Scan):
                yield item
            elif isinstance(item, Damage):
                self._damaged.append(item)
            else:
                raise LogError(
                    f"scans: expected scans, got {brief(item)} as item {number}"
                    "; take the scans of stream_log"
                )

    def _keep(self, one: Followed) -> None:
        """Keep a scan with its pose, and its ranges only if a check needs them."""
        number = len(self._scans)
        self._scans.append(without_ranges(one.scan))
        self._done.add(one)
        if number < COMPARED:
            self._begun.append(one.scan)
        self._latest.append(one.scan)
        if one.share < contradictions.POORLY and self._poor < MOST_POOR:
            self._poor, self._wanted = self._poor + 1, contradictions.BESIDE
            for back, scan in enumerate(reversed(self._latest), 1):
                self._scans[-back] = scan
        elif self._wanted:
            self._scans[-1], self._wanted = one.scan, self._wanted - 1
        if one.cut and len(self._done.cuts) <= SAID:
            self._tell(jumps.describe_cuts(self._log, self._done.track, []))

    def _compare(self) -> None:
        """Compare the track with the odometry over the first scans, and forget their ranges."""
        if len(self._begun) > 1 and not self._tell.notes:
            begun = RobotLog(tuple(self._begun), source=self._source)
            note = disagreement(begun, self._done.track)
            self._tell([note] if note else [])
        self._begun.clear()

    @property
    def _log(self) -> RobotLog:
        return RobotLog(self._scans, tuple(self._damaged), source=self._source)


class Teller:
    """Tells each kind of note once to a function `tell`, as soon as it is known."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell
        self.notes: list[str] = []  # the notes so far
        self._kinds: set[str] = set()

    def __call__(self, notes: Iterable[str]) -> None:
        """Tell each note, unless an earlier note begins with the same words up to a number."""
        for note in notes:
            kind = re.split(r"\d", note)[0]
            if kind not in self._kinds:
                self._kinds.add(kind)
                self.notes.append(note)
                self._tell(note)


def watched(scans: Iterable[Scan], tell: Teller, source: str = "") -> Iterator[Scan]:
    """Check scans while they come, and yield them with odometry in metres and radians.

    Raises LogError if the scans are in random order, their ranges are not in metres, or the
    odometry has several sources.
    """
    coming = iter(scans)
    first = _first_of(coming)
    if not first:
        return
    units = _units_of(RobotLog(tuple(first), source=source), tell)
    stretch: list[Scan] = []
    last, begin, standing = first[-1:], 0, jumps.StandstillCheck()
    laser = log_checks.StuckLaser()
    for number, scan in enumerate(map(units.converted, chain(first, coming))):
        # Checks look at a stretch of scans several times as it grows. Then a new one begins.
        if len(stretch) == LOOKS[-1]:
            stretch, begin, standing = last, number - 1, jumps.StandstillCheck()
        stretch.append(without_ranges(scan))
        standing.add(scan)
        laser.add(number, scan)
        tell(laser.notes)
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
            f"{named(log.source)}: expected odometry of one source, got poses of several sources "
            "in turn; let only one source publish odometry, or import the log from a file"
        )
    units, notes = units_of(log)
    tell([*notes, *log_checks.describe_feet(log)])
    return units


def _checked(scans: Sequence[Scan], begin: int, unseen: bool, source: str) -> list[str]:
    """Check a stretch of scans, but not their ranges. Raises LogError for a random order.

    `unseen` says whether the robot moves while its odometer stands still.
    """
    log = RobotLog(tuple(scans), source=source)
    log_checks.refuse_shuffled(log)
    return log_checks.describe_drive(log, begin, unseen)
