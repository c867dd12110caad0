"""Turns a robot's log into a trace: a step for each distinctive state (position and heading).

The robot need not have stopped at distinctive states. If it passed a junction or turned around,
the local map shows what it would have seen from the middle of the place. Kuipers
& Beeson (2002) planned this: to localise without physical motion to the actual location.

Scan matching estimates covariances by the same constants for every robot. The closures of the log
measure how far the track of this robot is really off. So its covariances are multiplied by the
factor that makes the errors at the closures most probable. A steady drift of the heading is
estimated at the same time and removed from these errors, as the covariances do not include it.

`join_logs` joins the logs of several drives through one building to one log. The scans are listed
one drive after the other. How the frames of two drives relate is unknown. So the track of each
drive begins where the previous track ends, which has no meaning. Closures between drives say how
visits of two drives lie relative to each other.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import accumulate, chain

import numpy as np

from perception.errors import ImageWarning, LogError
from perception.places import closures, following, log_checks, odometers, relations
from perception.places.distinctive import WIDTH, WINDOW, Visit, find_visits
from perception.places.partings import with_partings
from perception.places.tracing import closure_of, starts_of_drives, to_trace
from perception.places.track import Array, Track, points_turned, wrapped
from perception.readers.scans import RobotLog
from ssh_abduction.data.checks import a_number
from ssh_abduction.data.drives import together
from ssh_abduction.data.errors import named
from ssh_abduction.data.odometry import displacement_between
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.loggers import begin_stage, log_of

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


@dataclass(frozen=True, eq=False)
class Grown:
    """What was computed of a drive while its scans came: see `live.LiveLog`."""

    doubts: Mapping[int, odometers.Doubt]  # the scans whose odometry was doubted
    track: Track
    visits: tuple[Visit, ...]  # all visits, before `partings` changes them
    closings: list[closures.VisitMatch]  # their closures, before `agreeing` drops some


def import_log(
    log: RobotLog,
    width: float = WIDTH,
    name: str | None = None,
    tell: Tell = tell_nobody,
    known: Grown | None = None,
) -> Imported:
    """Import a log as a trace.

    Corrected poses become the truth for evaluation; nothing else reads them. The width of the
    robot is in metres. It cannot pass narrower parts of the free space. `tell` takes each note
    on suspicious odometry as soon as it is known. `known` was computed while the scans came. It is
    used where the whole log leads to the same, so it only saves time. Raises LogError if the robot
    passed no distinctive place or hardly moved, the scans do not match, or the width is no positive
    number.
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
        log, track, notes = tracked(log, tell, known)
    _refuse_bad(log, track, notes)
    is_known = known is not None and track.poses is known.track.poses
    with _timed(seconds, "places"):
        visits = known.visits if known and is_known else find_visits(log, track, width)
    found = known.closings if known and is_known else None
    imported = assembled((log, track, notes), visits, found, width, name, seconds)
    said = () if imported.trace.closures else log_checks.describe_missing_closures(track)
    _say(log, said, tell)
    return replace(imported, notes=(*notes, *said))


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


def assembled(
    tracked: Tracked,
    visits: tuple[Visit, ...],
    closings: list[closures.VisitMatch] | None,
    width: float,
    name: str | None,
    seconds: Seconds,
) -> Imported:
    """Make the trace of the visits, and gather the result of an import. Raises LogError.

    `closings` are the closures of the visits; None if they are not known yet. The ranges of the log
    are not read.
    """
    log, track, notes = tracked
    _refuse_bad(log, track, notes, visits)
    with _timed(seconds, "trace"):
        if closings is None:
            closings = closures.find_closures(track, visits, 2 * WINDOW)
        track, visits, closings, poses = with_poses(track, visits, closings)
        trace = to_trace(log, track, visits, closings, name)
    with _timed(seconds, "views"):
        trace = with_views(trace)
    starts = tuple(starts_of_drives(track, visits).values())
    return Imported(trace, track, width, visits, seconds, notes, starts, poses)


def with_poses(
    track: Track, visits: Sequence[Visit], closings: Sequence[closures.VisitMatch]
) -> tuple[Track, tuple[Visit, ...], list[closures.VisitMatch], Array]:
    """As `placed`, with the closures across cuts of the track and the poses of the visits."""
    track, visits, closings = placed(track, visits, closings)
    poses = closures.fitted_poses(track, visits, closings)
    if across := relations.closures_across_cuts(track, visits, poses):
        closings += across
        poses = in_frame_of(poses[0], closures.fitted_poses(track, visits, closings))
    return track, visits, closings, poses


def in_frame_of(first: Array, poses: Array) -> Array:
    """Turn and shift poses, (n, 3) metres and radians, so that the first one is `first`.

    Closures fix only how poses lie to each other.
    """
    turn = first[2] - poses[0, 2]
    at = points_turned(turn, poses[:, :2] - poses[0, :2]) + first[:2]
    return np.column_stack([at, poses[:, 2] + turn])


def placed(
    track: Track, visits: Sequence[Visit], closings: Sequence[closures.VisitMatch]
) -> tuple[Track, tuple[Visit, ...], list[closures.VisitMatch]]:
    """Drop closures that do not agree, correct the track's covariances, and add the partings."""
    closings = closures.agreeing(track, visits, closings)
    track = replace(track, factor=closures.factor_of(track, visits, closings))
    return track, *with_partings(track, visits, closings)


def _say(log: RobotLog, notes: Sequence[str], tell: Tell) -> None:
    """Log and tell notes on a robot's log."""
    for note in notes:
        _log.warning("%s: %s", named(log.source), note)
        tell(note)


def tracked(log: RobotLog, tell: Tell = tell_nobody, known: Grown | None = None) -> Tracked:
    """Compute the trajectory of a robot from its log.

    Return the log with the odometry of a single source, in metres and radians; its track; and
    notes on suspicious odometry, which `tell` takes as soon as they are known. `known` is as in
    `import_log`. Raises LogError if the scans are in random order.
    """
    notes: list[str] = []

    def say(more: Sequence[str]) -> None:
        notes.extend(more)
        _say(log, more, tell)

    logged = log
    log, corrected, whole = log_checks.checked(log)
    say([*corrected, *whole])
    track = following.follow(log, (known.doubts, known.track) if known and log is logged else None)
    if lag := odometers.lag_of(log, track):
        log, *_ = log_checks.checked(odometers.with_lag(logged, lag))
        track = following.follow(log)
        say([odometers.describe_lag(lag)])
    say(odometers.describe_cuts(log, track, turned_wrongly(log, track)))
    # If the odometry is wrong throughout, that explains all differences between the trajectories.
    doubt = None if whole else odometers.disagreement(log, track)
    say([doubt] if doubt else [])
    explained = bool(whole or doubt or track.cuts)
    track, doubts = log_checks.judged(log, track, explained)
    say(doubts)
    return log, replace(track, is_reliable=track.is_reliable and not doubt), tuple(notes)


def turned_wrongly(log: RobotLog, track: Track) -> list[tuple[int, float]]:
    """List scans that match well but turned differently from the odometry, by how many radians.

    Without odometry, there is none.
    """
    found: list[tuple[int, float]] = []
    unknown = odometers.unmeasured(log).union(track.cuts)
    for i in range(1, len(log)) if not odometers.is_missing(log) else ():
        measured = displacement_between(log.scans[i - 1].odometry, log.scans[i].odometry)[2]
        off = wrapped(float(track.poses[i, 2] - track.poses[i - 1, 2]) - measured)
        is_matched = track.shares[i] >= following.POOR and i not in unknown
        if abs(off) > following.TURNED and is_matched:
            found.append((i, off))
    return found


def with_views(trace: Trace) -> Trace:
    """Cluster the images of a trace into views, and add its view to each step.

    There are few views, so that a place keeps its view even if objects move (Kuipers & Beeson 2002,
    section 3).
    """
    # They load scikit-learn, and a robot that starts again should not wait for that.
    from perception.appearance import ReciprocalTransformer
    from perception.views import ViewClusterer

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
    begin_stage(stage)
    begin = time.process_time()
    yield
    seconds[stage] = round(time.process_time() - begin, 3)


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
    closings = relations.closures_between(*drives)
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
