"""Turns a robot's log into a trace: a step for each distinctive state (position and heading).

The robot need not have stopped at distinctive states. If it passed a junction or turned around,
the local map shows what it would have seen from the middle of the place. Kuipers
& Beeson (2002) planned this: to localise without physical motion to the actual location.

Scan matching estimates covariances by the same constants for every robot. The closures of the log
measure how far the track of this robot is really off. So its covariances are multiplied by the
factor that makes the errors at the closures most probable. A steady drift of the heading is
estimated at the same time and removed from these errors, as the covariances do not include it.

A log may also be imported while it is read or recorded (`LiveLog`). Then the scans are processed
one at a time. The track, the visits with their local maps, and about 600 bytes per scan are kept in
memory, and ranges in temporary files. The first scans wait until the units of the odometry are
recognised. Then the scans get the checks of a whole log, but in stretches of 1,600 scans. Each
stretch is checked four times: when it has 200, 400, 800 and 1,600 scans.

`join_logs` joins the logs of several drives through one building to one log. The scans are listed
one drive after the other. How the frames of two drives relate is unknown. So the track of each
drive begins where the previous track ends, which has no meaning. Closures between drives say how
visits of two drives lie relative to each other.
"""

from __future__ import annotations

import math
import re
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import accumulate, chain

import numpy as np

from perception.appearance import ReciprocalTransformer
from perception.errors import ImageWarning, LogError
from perception.places import closures, following, log_checks, odometers
from perception.places.distinctive import WIDTH, WINDOW, Visit, find_visits, patches_of, visits_of
from perception.places.partings import with_partings
from perception.places.tracing import closure_of, starts_of_drives, to_trace
from perception.places.track import Array, Track
from perception.readers.scans import Damage, RobotLog, Scan, ScanTable
from perception.views import ViewClusterer
from ssh_abduction.data.checks import a_function, a_number
from ssh_abduction.data.drives import together
from ssh_abduction.data.errors import brief, named
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.loggers import log_of

# The number of first scans over which the track is compared with the odometry.
COMPARED = 400
# The first SAID notes on cuts of the track are given at once. The others come at the end.
SAID = 3
# Units are recognised when the robot has moved in MOVES steps and by LEAST_WAY metres, or when MOST
# scans wait.
MOVES, MOST = 100, 2000
# Numbers of scans of a stretch at which it is checked. It is complete at the last number.
LOOKS = (200, 400, 800, 1600)
_log = log_of("ssh_abduction.perception.places")

# Each view is seen at least this many times on average. With few images of many places, most views
# would otherwise be seen once and would carry no information. At most MOST_VIEWS are tried, so that
# the time grows no faster than the log.
SEEN, MOST_VIEWS = 12, 20
# Largest share of scans before which a track may be broken.
MOST_BREAKS = 0.1


Tell = Callable[[str], None]  # a function that takes notes
# A log with checked odometry, its track, and notes on suspicious odometry.
Tracked = tuple[RobotLog, Track, tuple[str, ...]]
Seconds = dict[str, float]  # processor time by stage


def tell_nobody(note: object) -> None:
    """Take a note, and do nothing."""


@dataclass(frozen=True, eq=False)
class Imported:
    """Result of `import_log`."""

    # One step for each distinctive state that the robot passed, with view, image, star (the exits
    # as directions) and displacement from the previous step.
    trace: Trace
    track: Track  # trajectory of the robot
    width: float  # width of the robot in metres
    visits: tuple[Visit, ...]  # stays at distinctive places, in order
    seconds: Mapping[str, float]  # processor time in seconds, by stage: track, places, trace, views
    notes: tuple[str, ...] = ()  # sentences on suspicious features of the odometry and the track
    starts: tuple[int, ...] = ()  # scans, besides the first one, at which a drive starts
    # The poses of the visits, fitted to the closures, as `fitted_poses` returns them.
    poses: Array = field(default_factory=lambda: np.zeros((0, 3)))


def import_log(
    log: RobotLog, width: float = WIDTH, name: str | None = None, tell: Tell = tell_nobody
) -> Imported:
    """Import a log as a trace.

    Corrected poses become the truth for evaluation; nothing else reads them. The width of the
    robot is in metres. It cannot pass narrower parts of the free space. `tell` takes each note
    on suspicious odometry as soon as it is known. Raises LogError if the robot passed no
    distinctive place or hardly moved, the scans do not match, or the width is no positive number.
    """
    a_number("width", width, LogError, above=0, what="metres", mend="give the width of the robot")
    seconds: Seconds = {}
    if not any(((scan.ranges > 0) & (scan.ranges < scan.laser.reach)).any() for scan in log.scans):
        raise LogError(
            f"{named(log.source)}: expected scans that meet walls, got {len(log)} in which no "
            "beam meets anything; look at the laser"
        )
    # Each stage is timed.
    with _timed(seconds, "track"):
        log, track, notes = tracked(log, tell)
    _refuse_bad(log, track, notes)
    with _timed(seconds, "places"):
        visits = find_visits(log, track, width)
    return _imported((log, track, notes), visits, width, name, seconds)


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
    are kept in temporary files. If the odometry is good, the trace is that of `import_log`. They
    can differ because each step of the odometer is judged by earlier steps only.

    Args:
        items: The scans with odometry, in order, for example those of `stream_log` or `live_log`.
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
    seconds: Seconds = {}
    live = LiveLog(items, width, tell, source)
    visits: list[Visit] = []
    with _timed(seconds, "places"):
        for visit in live.visits():
            visits.append(visit)
            show(visit)
        log, track, notes = live.result()
    del live  # It has a copy of the track.
    _refuse_bad(log, track, notes)
    return log, _imported((log, track, notes), tuple(visits), width, name, seconds)


def _refuse_bad(
    log: RobotLog, track: Track, notes: Sequence[str], visits: Sequence[Visit] | None = None
) -> None:
    """Raise a LogError if a track, or its visits, show no drive.

    The error carries the notes on the log. They are not in its text, as they were already printed.
    """
    failing, way = following.share_failing(track), track.way[-1]
    if len(track.breaks) > MOST_BREAKS * len(log):
        said = (
            f"expected a log of one drive, got {len(log)} scans of which {len(track.breaks)} show "
            "nothing that the previous scan shows; sort it by time, or cut it into drives"
        )
    elif failing > log_checks.HOPELESS:
        said = (
            f"expected scans that show what the scans before them showed, got {len(log)}, and "
            f"{100 * failing:.0f} % of them do not; {log_checks.advice(log)}"
        )
    elif way < 1.0:
        said = f"expected a robot that drives, got a drive of {way:.1f} m; take a longer log"
    elif visits == ():
        said = (
            f"expected a way past junctions or turning points, got {way:.0f} m without any; take "
            "a longer log"
        )
    else:
        return
    error = LogError(f"{named(log.source)}: {said}")
    for note in notes:
        error.add_note(note)
    raise error


def _imported(
    found: Tracked, visits: tuple[Visit, ...], width: float, name: str | None, seconds: Seconds
) -> Imported:
    """Make the trace of the visits, and gather the result of an import. Raises LogError."""
    log, track, notes = found
    _refuse_bad(log, track, notes, visits)
    with _timed(seconds, "trace"):
        closings = closures.find_closures(track, visits, patches_of(visits), 2 * WINDOW)
        closings = closures.agreeing(track, visits, closings)
        track = replace(track, factor=closures.factor_of(track, visits, closings))
        visits, closings = with_partings(track, visits, closings)
        poses = closures.fitted_poses(track, visits, closings)
        closings += closures.closures_across_cuts(track, visits, poses)
        trace = to_trace(log, track, visits, closings, name)
    with _timed(seconds, "views"):
        trace = with_views(trace)
    starts = tuple(starts_of_drives(track, visits).values())
    return Imported(trace, track, width, visits, seconds, notes, starts, poses)


def stream_visits(
    scans: Iterable[Scan | Damage], width: float = WIDTH, tell: Tell = tell_nobody
) -> Iterator[Visit]:
    """Find the distinctive places that a robot passes, while it drives.

    A visit is final, and yielded, when the robot is at most 125 m of trajectory beyond the last
    scan of the stay, if scans are at most 0.5 m apart. Usually this is after 30 to 40 m. At the end
    of the scans, the other visits follow. No visit is yielded before the units of the odometry are
    recognised, which takes about 100 scans of a moving robot.

    If the odometry is good, the visits are those of `import_log` before `partings` moves, joins and
    adds visits. A jump of the odometer is judged by earlier steps only.

    Args:
        scans: The scans with odometry, in order, for example those of `stream_log`. Damaged parts
            are skipped.
        width: Width of the robot in metres. It cannot pass narrower parts of the free space.
        tell: A function that gets each note on suspicious scans and odometry, at once.

    Yields:
        Each visit with its local map. Scans are counted from 0.

    Raises:
        LogError: The width is no positive number, an item is no scan, the scans are in random
            order, or the odometry has several sources.

    Example:
        >>> [visit.scan for visit in stream_visits([])]
        []
    """
    return LiveLog(scans, width, tell).visits()


def tracked(log: RobotLog, tell: Tell = tell_nobody) -> Tracked:
    """Compute the trajectory of a robot from its log.

    Return the log with the odometry of a single source, in metres and radians; its track; and
    notes on suspicious odometry, which `tell` takes as soon as they are known. Raises LogError
    if the scans are in random order.
    """
    notes: list[str] = []

    def say(more: Sequence[str]) -> None:
        notes.extend(more)
        for note in more:
            _log.warning("%s: %s", named(log.source), note)
            tell(note)

    logged = log
    log, corrected, whole = log_checks.checked(log)
    say([*corrected, *whole])
    track = following.follow(log)
    if lag := odometers.lag_of(log, track):
        log, *_ = log_checks.checked(odometers.with_lag(logged, lag))
        track = following.follow(log)
        say([odometers.describe_lag(lag)])
    say(odometers.describe_cuts(log, track, following.turned_wrongly(log, track)))
    # If the odometry is wrong throughout, that explains all differences between the trajectories.
    doubt = None if whole else odometers.disagreement(log, track)
    say([doubt] if doubt else [])
    explained = bool(whole or doubt or track.cuts)
    track, doubts = log_checks.judged(log, track, explained)
    say(doubts)
    return log, replace(track, is_reliable=track.is_reliable and not doubt), tuple(notes)


def with_views(trace: Trace) -> Trace:
    """Cluster the images of a trace into views, and add its view to each step.

    There are few views, so that a place keeps its view even if objects move (Kuipers & Beeson 2002,
    section 3).
    """
    images = ReciprocalTransformer(floor=0.3).fit_transform(
        np.array([step.image for step in trace.steps])
    )
    most = min(max(2, len(images) // SEEN), MOST_VIEWS)
    if len(images) <= most or (images == images[0]).all():
        views, sure = np.zeros(len(images), int), np.ones(len(images))
    else:
        # A warning about images would not help a user who gave a log.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ImageWarning)
            clusterer = ViewClusterer(k_max=most, by="trimmed", random_state=0).fit(images)
        views, sure = clusterer.labels_, clusterer.confidence_
    seen = zip(trace.steps, views, sure, strict=True)
    steps = (replace(step, view=int(view), confidence=round(float(c), 4)) for step, view, c in seen)
    return replace(trace, steps=tuple(steps))


@contextmanager
def _timed(seconds: Seconds, stage: str) -> Iterator[None]:
    begin = time.process_time()
    yield
    seconds[stage] = round(time.process_time() - begin, 3)


class LiveLog:
    """The track and the visits of a drive, found while its scans come.

    The arguments are those of `importing.import_live`. Raises LogError if one is invalid.
    """

    def __init__(
        self,
        items: Iterable[Scan | Damage],
        width: float = WIDTH,
        tell: Tell = tell_nobody,
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
        self._done = following.GrowingTrack()

    def visits(self) -> Iterator[Visit]:
        """Yield each visit with its local map, in order, when it is final."""
        return visits_of(self._followed(), self._width)

    def result(self) -> Tracked:
        """Return the log, its track and notes. Call this after `visits` has yielded all visits.

        Raises LogError if there is no scan.
        """
        log, track = self._log, self._done.track
        if not len(log):
            raise LogError(f"{named(self._source)}: expected scans, got none; record the laser")
        explained = bool(self._tell.notes)
        self._tell(odometers.describe_cuts(log, track, following.turned_wrongly(log, track)))
        track, doubts = log_checks.judged(log, track, explained)
        self._tell(doubts)
        return log, track, tuple(self._tell.notes)

    def _followed(self) -> Iterator[following.Followed]:
        """Follow the robot, and keep its scans and its track."""
        scans = watched(self._scans_of(), self._tell, self._source)
        for one in following.poses_of_scans(scans, odometers.LiveJumps()):
            self._scans.append(one.scan)
            self._done.add(one)
            if one.cut and len(self._done.cuts) <= SAID:
                self._tell(odometers.describe_cuts(self._log, self._done.track, []))
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

    def _compare(self) -> None:
        """Compare the track with the odometry over the first scans."""
        if len(self._scans) > 1 and not self._tell.notes:
            begun = replace(self._log, scans=self._scans[:COMPARED])
            note = odometers.disagreement(begun, self._done.track)
            self._tell([note] if note else [])

    @property
    def _log(self) -> RobotLog:
        return RobotLog(self._scans, tuple(self._damaged), source=self._source)


class Teller:
    """Tells each kind of note once to a function `tell`, as soon as it is known."""

    def __init__(self, tell: Tell) -> None:
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
    first: list[Scan] = []
    moves, way = 0, 0.0
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


def join_logs(logs: Sequence[RobotLog], parts: Sequence[Imported]) -> tuple[RobotLog, Imported]:
    """Join the results of `import_log` for several logs, one per drive, to one trace.

    The views are made of the images of all drives. Visits and scans are numbered over all
    drives. In the steps of the trace, `visit` counts over all drives, and `scan` within the
    drive. The names of the traces name the drives. Raises TraceError if two have one name, or
    the traces differ in what they record.
    """
    if len(logs) == 1:
        return logs[0], parts[0]
    names = [part.trace.name for part in parts]
    log = RobotLog(
        tuple(chain.from_iterable(log.scans for log in logs)),
        tuple(chain.from_iterable(log.damaged for log in logs)),
        ", ".join(dict.fromkeys(log.format for log in logs)),
        ", ".join(log.source for log in logs),
        _named(names, [log.notes for log in logs]),
        _named(names, [log.sources for log in logs]),
    )
    begins = [0, *accumulate(len(part.track.poses) for part in parts)][: len(parts)]
    track, shifts = _joint_track([part.track for part in parts], begins)
    visits = tuple(
        replace(visit, middle=visit.middle + shift, patch=None).later(begin)
        for part, shift, begin in zip(parts, shifts, begins, strict=True)
        for visit in part.visits
    )
    counts = [0, *accumulate(len(part.visits) for part in parts)]
    traces = [_counted_from(n, part.trace) for n, part in zip(counts, parts, strict=False)]
    with warnings.catch_warnings():
        # The name of a turn has its angle, so drives have different names for turns.
        warnings.filterwarnings("ignore", "action: traces .* different names", UserWarning)
        trace = together(traces)
    begin = time.process_time()
    arrivals = _arrivals(trace, track, visits)
    drives = [part.visits for part in parts], [part.poses for part in parts]
    closings = closures.closures_between(*drives)
    found = [closure_of(closing, arrivals) for closing in closings]
    seconds = {
        stage: round(math.fsum(part.seconds[stage] for part in parts), 3)
        for stage in parts[0].seconds
    }
    seconds["drives"] = round(time.process_time() - begin, 3)
    trace = with_views(replace(trace, closures=(*trace.closures, *found)))
    _, *starts = (
        begin + start
        for begin, part in zip(begins, parts, strict=True)
        for start in (0, *part.starts)
    )
    moves = (np.array([*shift, 0.0]) for shift in shifts)
    poses = [part.poses + move for part, move in zip(parts, moves, strict=True)]
    return log, Imported(
        trace,
        track,
        parts[0].width,
        visits,
        seconds,
        _named(names, [part.notes for part in parts]),
        tuple(starts),
        np.concatenate(poses),
    )


def _arrivals(trace: Trace, track: Track, visits: Sequence[Visit]) -> list[tuple[int, float]]:
    """List the first step of each visit, and its heading in the frame of the track, in radians."""
    first = {int(step.extra["visit"]): t for t, step in reversed([*enumerate(trace.steps)])}
    return [
        (first[k], float(track.poses[visit.scan, 2] + trace[first[k]].extra["seen"][2]))
        for k, visit in enumerate(visits)
    ]


def _named(names: Sequence[str | None], notes: Sequence[Sequence[str]]) -> tuple[str, ...]:
    """Begin each note with the name of its drive."""
    return tuple(
        f"{name}: {note}" for name, some in zip(names, notes, strict=True) for note in some
    )


def _joint_track(tracks: Sequence[Track], begins: Sequence[int]) -> tuple[Track, list[Array]]:
    """Join tracks to one track, broken where each drive starts. Also return each shift, (2,) m."""
    poses = [tracks[0].poses]
    shifts = [np.zeros(2)]
    for track in tracks[1:]:
        shifts.append(poses[-1][-1, :2] - track.poses[0, :2])
        poses.append(track.poses + np.array([*shifts[-1], 0.0]))
    starts = frozenset(begins[1:])

    def joint(found: Sequence[Sequence[int]]) -> tuple[int, ...]:
        pairs = zip(begins, found, strict=True)
        return tuple(sorted(starts.union(cut + begin for begin, some in pairs for cut in some)))

    return Track(
        np.concatenate(poses),
        np.concatenate([track.corrected for track in tracks]),
        np.concatenate([track.shares for track in tracks]),
        joint([track.cuts for track in tracks]),
        joint([track.breaks for track in tracks]),
        is_reliable=all(track.is_reliable for track in tracks),
    ), shifts


def _counted_from(first: int, trace: Trace) -> Trace:
    """Copy a trace, with its visits numbered from `first`."""
    steps = (
        replace(step, extra={**step.extra, "visit": int(step.extra["visit"]) + first})
        for step in trace.steps
    )
    return replace(trace, steps=tuple(steps))
