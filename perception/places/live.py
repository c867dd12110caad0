"""Imports a log while it is read or recorded, one scan at a time.

A `LiveLog` takes scans. It keeps the track, the visits with their local maps, and about 600 bytes
per scan in memory, and ranges in temporary files. At the end, `import_log` gets what was computed,
and computes again only what the whole log shows to be wrong. So the result is that of `import_log`.

The scans of a stream get the checks of a whole log, but in stretches of 1,600 scans. Each stretch
is checked four times: when it has 200, 400, 800 and 1,600 scans. The first scans wait until the
units of the odometry are recognised. A `LiveLog` alone takes metres and radians, and waits for
nothing.
"""

from __future__ import annotations

import math
import os
import re
from bisect import bisect
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np

from perception.errors import LogError
from perception.places import log_checks, odometers
from perception.places.closures import ClosureFinder, fitted_poses
from perception.places.distinctive import WIDTH, WINDOW, Visit, VisitFinder
from perception.places.following import Followed, Follower, GrowingTrack
from perception.places.importing import (
    Grown,
    Imported,
    Tell,
    import_log,
    placed,
    tell_nobody,
    with_poses,
)
from perception.places.local_map import Patch
from perception.places.relations import Relocation
from perception.places.saved import Folder
from perception.places.track import Array
from perception.readers.scans import Damage, RobotLog, Scan, ScanTable
from ssh_abduction.data.checks import a_function, a_number
from ssh_abduction.data.errors import brief, named
from ssh_abduction.data.words import counted

# The number of first scans over which the track is compared with the odometry.
COMPARED = 400
# The first SAID notes on cuts of the track are given at once. The others come at the end.
SAID = 3
# Units are recognised when the robot has moved in MOVES steps and by LEAST_WAY metres, or when MOST
# scans wait.
MOVES, MOST = 100, 2000
# Numbers of scans of a stretch at which it is checked. It is complete at the last number.
LOOKS = (200, 400, 800, 1600)
# Visits whose fitted middles are at most this many metres apart are to one place.
NEAR = 0.8
# The attributes of a `LiveLog` that are saved.
SAVED = ("width", "source", "damaged", "visits", "_follower", "_finder", "_closures")


def import_live(
    items: Iterable[Scan | Damage],
    width: float = WIDTH,
    name: str | None = None,
    tell: Tell = tell_nobody,
    show: Callable[[Visit], None] = tell_nobody,
    source: str = "",
) -> tuple[RobotLog, Imported]:
    """Import a log as a trace while it is read or recorded.

    Memory hardly grows: each scan leaves about 600 bytes, and each visit its local map. The ranges
    are kept in temporary files. The trace is that of `import_log`. If the whole log shows jumps of
    the odometry that its first scans did not show, the track is computed again at the end.

    Args:
        items: The scans with odometry, in order, for example those of `live_log`.
        width: Width of the robot in metres.
        name: Name of the trace; None for a trace without a name.
        tell: A function that gets each note on suspicious scans and odometry, at once.
        show: A function that gets each visit when it is final, before `partings` moves, joins and
            adds visits.
        source: Name of the log, for errors.

    Returns:
        The log, and the result of the import, with the trace.

    Raises:
        LogError: As `import_log`, or an item is no scan.
    """
    live = LiveLog(width, tell, source)
    if not isinstance(items, Iterable) or isinstance(items, str | bytes):
        raise LogError(f"scans: expected scans, got {brief(items)}; pass the scans of live_log")

    def scans() -> Iterator[Scan]:
        for number, item in enumerate(items):
            if isinstance(item, Scan):
                yield item
            elif isinstance(item, Damage):
                live.damaged.append(item)
            else:
                raise LogError(
                    f"scans: expected scans, got {brief(item)} as item {number}"
                    "; take the scans of live_log"
                )

    for scan in watched(scans(), live.tell, source):
        for visit in live.add(scan)[1]:
            show(visit)
    for visit in live.expected():
        show(visit)
    return live.log, live.finish(name)


@dataclass(frozen=True, eq=False)
class LivePlace:
    """A place that the robot passed so far.

    Attributes:
        visits: The scans of the visits to the place, in order.
        middle: The (x, y) middle of the place in metres, fitted to all closures so far. It is the
            mean over the visits.
        final: Whether its first visit is final. Later scans may still change the others.
    """

    visits: tuple[int, ...]
    middle: tuple[float, float]
    final: bool


class LiveLog:
    """The scans, the track, the visits and the closures of a drive, while its scans come.

    Args:
        width: The width of the robot in metres. It cannot pass narrower parts of the free space.
        tell: A function that gets each note on suspicious odometry, at once.
        source: The name of the log, for errors.

    Raises:
        LogError: An argument is invalid.
    """

    def __init__(self, width: float = WIDTH, tell: Tell = tell_nobody, source: str = "") -> None:
        mend = "give the width of the robot"
        a_number("width", width, LogError, above=0, what="metres", mend=mend)
        a_function("tell", tell, LogError, what="a function that takes a text")
        self.width, self.source, self.tell = width, source, Teller(tell)
        self.damaged: list[Damage] = []
        self.visits: list[Visit] = []  # the visits that are final, before `partings` changes them
        self._scans, self._done = ScanTable(), GrowingTrack()
        self._follower = Follower(odometers.LiveJumps())
        self._finder, self._closures = VisitFinder(width), ClosureFinder(2 * WINDOW)
        self._compared = 0  # the scans over which the track was compared with the odometry
        self._folder: Folder | None = None  # where the state was saved last

    def __len__(self) -> int:
        """The number of scans."""
        return len(self._scans)

    def add(self, scan: Scan) -> tuple[Followed, list[Visit]]:
        """Add the next scan, with odometry in metres and radians, in bounded time.

        Returns the scan with its pose on the track, and the visits that are final now. A visit is
        final when the robot is at most 125 m of trajectory beyond its end; usually after 30 to 40.
        Raises LogError if the scan has not a range for each beam, or no finite odometry.
        """
        if scan.ranges.shape != (scan.laser.beams,) or not np.isfinite(scan.odometry).all():
            raise LogError(
                f"scan: expected {counted(scan.laser.beams, 'ranges')} and a finite odometry, got "
                f"{scan.ranges.shape} and {scan.odometry}; leave this scan out"
            )
        self._scans.append(scan)
        one = self._follower.add(self._scans[-1])
        self._done.add(one)
        if one.cut and len(self._done.cuts) <= SAID:
            self.tell(odometers.describe_cuts(self.log, self._done.track, []))
        if len(self._scans) == COMPARED:
            self.compare()
        found = self._finder.add(one)
        self.visits += found
        return one, found

    def lift(self) -> None:
        """Say that the robot may be anywhere at the next scan. A new trajectory begins there."""
        self._follower.lifted = len(self) > 0

    @property
    def begun(self) -> int:
        """The first scan of the trajectory that goes on: before it, the robot was elsewhere."""
        return len(self) if self._follower.lifted else max(self._done.breaks, default=0)

    @property
    def log(self) -> RobotLog:
        """The log so far."""
        return RobotLog(self._scans, tuple(self.damaged), source=self.source)

    def expected(self) -> list[Visit]:
        """The visits that would follow those that are final if the drive ended now."""
        return self._finder.expected()

    def grown(self) -> Grown:
        """What is known of the drive, as if it ended now. The log may go on to grow afterwards."""
        track = self._done.track
        track = replace(
            track,
            poses=track.poses.copy(),
            covariances=track.covariances.copy(),
            shares=track.shares.copy(),
        )
        for visit in self.visits[len(self._closures) :]:
            self._closures.add(track, visit)
        expected, closures = self.expected(), self._closures.copy()
        for visit in expected:
            closures.add(track, visit)
        visits = (*self.visits, *expected)
        return Grown(dict(self._follower.doubts), track, visits, closures.found)

    def places(self) -> list[LivePlace]:
        """The places that the robot passed, in the order of their first visits.

        Visits whose fitted middles are at most NEAR metres apart are to one place. There is no
        search. A place is seen 1 to 3 m after the robot passed it.
        """
        grown = self.grown()
        if not grown.visits:
            return []
        last = self.visits[-1].scan if self.visits else -1
        track, visits, closings = placed(grown.track, grown.visits, grown.closings)
        poses = fitted_poses(track, visits, closings)
        return [
            LivePlace(
                tuple(visits[k].scan for k in some),
                tuple(poses[some, :2].mean(axis=0).tolist()),
                visits[some[0]].scan <= last,
            )
            for some in near_groups(poses[:, :2])
        ]

    def relocation(self) -> Relocation | None:
        """What finds the robot among the visits of earlier trajectories; None if there are none.

        These are the largest part of the map that closures connect: only they have one frame.
        """
        import networkx as nx

        grown = self.grown()
        track, visits, closings, poses = with_poses(grown.track, grown.visits, grown.closings)
        linked = nx.Graph()
        linked.add_nodes_from(part_of := [bisect(track.breaks, visit.scan) for visit in visits])
        linked.add_edges_from((part_of[one.first], part_of[one.last]) for one in closings)
        parts = [
            [k for k, part in enumerate(part_of) if part in some and visits[k].scan < self.begun]
            for some in nx.connected_components(linked)
        ]
        known = max(parts, key=len, default=[])
        return Relocation([visits[k] for k in known], poses[known]) if known else None

    def around(self, behind: float) -> tuple[Patch, Array] | None:
        """As `VisitFinder.around`."""
        return self._finder.around(behind)

    def finish(self, name: str | None = None) -> Imported:
        """Import the log so far. The result equals that of `import_log`.

        The log may go on to grow afterwards. Raises LogError as `import_log`.
        """
        if not len(self):
            raise LogError(f"{named(self.source)}: expected scans, got none; record the laser")
        self.compare()
        return import_log(self.log, self.width, name, lambda note: self.tell([note]), self.grown())

    def save(self, folder: str | os.PathLike[str]) -> None:
        """Save the state in a folder. To save there again only adds what is new. Raises OSError."""
        if self._folder is None or self._folder.path != Path(folder):
            self._folder = Folder(folder)
        state = {name: getattr(self, name) for name in SAVED}
        notes = [self.tell.notes, self.tell.kinds]
        self._folder.save(self._scans, self._done, [state, notes])

    @staticmethod
    def load(folder: str | os.PathLike[str], tell: Tell = tell_nobody) -> LiveLog:
        """Restore the state from a folder, to go on. Raises LogError."""
        live = LiveLog(tell=tell)
        live._folder = Folder(folder)
        live._scans, live._done, (state, notes) = live._folder.load()
        for name in SAVED:
            setattr(live, name, state[name])
        live.tell.notes, live.tell.kinds = notes
        return live

    def compare(self) -> None:
        """Compare the track with the odometry over the first scans, but not twice over the same."""
        count = len(self._scans)
        if 1 < count <= COMPARED and count != self._compared and not self.tell.notes:
            self._compared = count
            begun = replace(self.log, scans=self._scans[:COMPARED])
            note = odometers.disagreement(begun, self._done.track)
            self.tell([note] if note else [])


def near_groups(middles: Array) -> list[list[int]]:
    """Group visits by the nearest earlier one, if it is within NEAR metres.

    `middles` are (n, 2) metres. Each group lists indices in order.
    """
    groups, group_of = list[list[int]](), list[list[int]]()
    for k, middle in enumerate(middles):
        far = np.hypot(*(middles[:k] - middle).T)
        if k and far.min() < NEAR:
            group_of.append(group_of[int(far.argmin())])
        else:
            groups.append([])
            group_of.append(groups[-1])
        group_of[-1].append(k)
    return groups


class Teller:
    """Tells each kind of note once to a function `tell`, as soon as it is known."""

    def __init__(self, tell: Tell) -> None:
        self.to = tell  # where the notes go
        self.notes: list[str] = []  # the notes so far
        self.kinds: set[str] = set()

    def __call__(self, notes: Iterable[str]) -> None:
        """Tell each note, unless an earlier note begins with the same words up to a number."""
        for note in notes:
            kind = re.split(r"\d", note)[0]
            if kind not in self.kinds:
                self.kinds.add(kind)
                self.notes.append(note)
                self.to(note)


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
    begin = 0
    for number, scan in enumerate(map(units.converted, chain(first, coming))):
        # Checks look at a stretch of scans several times as it grows. Then a new one begins.
        if len(stretch) == LOOKS[-1]:
            stretch, begin = stretch[-1:], number - 1
        stretch.append(scan)
        if len(stretch) in LOOKS:
            tell(_checked(stretch, begin, source))
        yield scan
    if len(stretch) > 1 and len(stretch) not in LOOKS:
        tell(_checked(stretch, begin, source))


def _first_of(coming: Iterator[Scan]) -> list[Scan]:
    """Take the first scans of a drive, until they show the units of the odometry."""
    first, moves, way = list[Scan](), 0, 0.0
    for scan in coming:
        if first:
            far = math.dist(first[-1].odometry[:2], scan.odometry[:2])
            moves, way = moves + (far > 0), way + far
        first.append(scan)
        if (moves >= MOVES and way >= log_checks.LEAST_WAY) or len(first) == MOST:
            break
    return first


def _units_of(log: RobotLog, tell: Teller) -> log_checks.Units:
    """Recognise the units of the odometry of the first scans of a drive. Raises LogError."""
    log_checks.refuse_lengths(log)
    log_checks.refuse_shuffled(log)
    log_checks.refuse_mixed(log)
    if odometers.keep_one_source(log)[1]:
        raise LogError(
            f"{named(log.source)}: expected odometry of one source, got poses of several sources "
            "in turn; let only one source publish odometry, or import the log from a file"
        )
    units, notes = log_checks.units_of(log)
    tell(notes)
    return units


def _checked(scans: Sequence[Scan], begin: int, source: str) -> list[str]:
    """Check a stretch of scans. Raises LogError for a random order."""
    log = RobotLog(tuple(scans), source=source)
    log_checks.refuse_shuffled(log)
    return log_checks.describe_drive(log, begin)
