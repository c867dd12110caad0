"""Turns a robot's log into a trace: a step for each distinctive state (position and heading).

The robot need not have stopped at distinctive states. If it passed a junction or turned around,
the local map shows what it would have seen from the middle of the place. Kuipers
& Beeson (2002) planned this: to localise without physical motion to the actual location.

Scan matching estimates covariances by the same constants for every robot. The closures of the log
measure how far the track of this robot is really off. So its covariances are multiplied by the
factor that makes the errors at the closures most probable. A steady drift of the heading is
estimated at the same time and removed from these errors, as the covariances do not include it.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from perception.errors import ImageWarning, LogError
from perception.places import jumps, log_checks
from perception.places.agreement import disagreement
from perception.places.closures import (
    DRIFTS,
    GATE,
    INFLATED,
    VisitMatch,
    errors_of,
    find_closures,
    seen_from,
    uncertainty,
    without_drift,
)
from perception.places.consistency import agreeing, fitted_poses
from perception.places.distinctive import WIDTH, WINDOW, find_visits
from perception.places.following import follow, share_failing, turned_wrongly
from perception.places.live import LiveLog
from perception.places.partings import with_partings
from perception.places.tracing import DRIFT, starts_of_drives, to_trace
from perception.places.track import Array, Track
from perception.places.units import HOPELESS
from perception.places.unrelated import closures_across_cuts
from perception.places.visits import Visit, patches_of
from perception.readers.scans import Damage, RobotLog, Scan
from perception.reciprocal import ReciprocalTransformer
from perception.views import ViewClusterer
from ssh_abduction.data.checks import a_number
from ssh_abduction.data.errors import named
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.loggers import log_of

_log = log_of("ssh_abduction.perception.places")

# Each view is seen at least this many times on average. With few images of many places, most views
# would otherwise be seen once and would carry no information. At most MOST_VIEWS are tried, so that
# the time grows no faster than the log.
SEEN, MOST_VIEWS = 12, 20
# Largest share of scans before which a track may be broken.
MOST_BREAKS = 0.1
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
    log: RobotLog,
    width: float = WIDTH,
    name: str | None = None,
    tell: Callable[[str], None] = lambda note: None,
) -> Imported:
    """Import a log as a trace.

    Corrected poses become the truth for evaluation; nothing else reads them. The width of the
    robot is in metres. It cannot pass narrower parts of the free space. `tell` takes each note
    on suspicious odometry as soon as it is known. Raises LogError if the robot passed no
    distinctive place or hardly moved, the scans do not match, or the width is no positive number.
    """
    a_number("width", width, LogError, above=0, what="metres", mend="give the width of the robot")
    seconds: dict[str, float] = {}
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
    return _imported(log, track, visits, width, name, notes, seconds)


def import_live(
    items: Iterable[Scan | Damage],
    width: float = WIDTH,
    name: str | None = None,
    tell: Callable[[str], None] = lambda note: None,
    show: Callable[[Visit], None] = lambda visit: None,
    source: str = "",
) -> tuple[RobotLog, Imported]:
    """Import a log as a trace while it is read or recorded.

    Memory hardly grows: each scan leaves about 200 bytes, and each visit its local map. If the
    odometry is good, the trace is that of `import_log`. They can differ because each step of the
    odometer is judged by earlier steps only.

    Args:
        items: The scans with odometry, in order, for example those of `stream_log` or `live_log`.
        width: Width of the robot in metres.
        name: Name of the trace; None for a trace without a name.
        tell: A function that gets each note on suspicious scans and odometry, at once.
        show: A function that gets each visit when it is final, before `partings` moves, joins and
            adds visits.
        source: Name of the log, for errors.

    Returns:
        The log, in which hardly any scan has ranges, and the result of the import, with the trace.

    Raises:
        LogError: As `import_log`, or an item is no scan.
    """
    seconds: dict[str, float] = {}
    live = LiveLog(items, width, tell, source)
    visits: list[Visit] = []
    with _timed(seconds, "places"):
        for visit in live.visits():
            visits.append(visit)
            show(visit)
        log, track, notes = live.result()
    del live  # It has a copy of the track.
    _refuse_bad(log, track, notes)
    return log, _imported(log, track, tuple(visits), width, name, notes, seconds)


def _refuse_bad(log: RobotLog, track: Track, notes: Sequence[str]) -> None:
    """Raise a LogError if the track shows no drive. The error carries the notes on the log."""
    if len(track.breaks) > MOST_BREAKS * len(log):
        raise _noted(
            f"{named(log.source)}: expected a log of one drive, got {len(log)} scans of which "
            f"{len(track.breaks)} show nothing that the previous scan shows; sort it by "
            "time, or cut it into drives",
            notes,
        )
    if (failing := share_failing(track)) > HOPELESS:
        raise _noted(
            f"{named(log.source)}: expected scans that show what the scans before them showed, got "
            f"{len(log)}, and {100 * failing:.0f} % of them do not; {log_checks.advice(log)}",
            notes,
        )
    if track.way[-1] < 1.0:
        raise _noted(
            f"{named(log.source)}: expected a robot that drives, got a drive of "
            f"{track.way[-1]:.1f} m; take a longer log",
            notes,
        )


def _imported(
    log: RobotLog,
    track: Track,
    visits: tuple[Visit, ...],
    width: float,
    name: str | None,
    notes: tuple[str, ...],
    seconds: dict[str, float],
) -> Imported:
    """Make the trace of the visits, and gather the result of an import. Raises LogError."""
    if not visits:
        raise _noted(
            f"{named(log.source)}: expected a way past junctions or turning points, got "
            f"{track.way[-1]:.0f} m without any; take a longer log",
            notes,
        )
    with _timed(seconds, "trace"):
        closings = find_closures(track, visits, patches_of(visits), 2 * WINDOW)
        closings = agreeing(track, visits, closings)
        track = replace(track, factor=factor_of(track, visits, closings))
        visits, closings = with_partings(track, visits, closings)
        poses = fitted_poses(track, visits, closings)
        closings += closures_across_cuts(track, visits, poses)
        trace = to_trace(log, track, visits, closings, name)
    with _timed(seconds, "views"):
        trace = with_views(trace)
    starts = tuple(starts_of_drives(track, visits).values())
    return Imported(trace, track, width, visits, seconds, notes, starts, poses)


def stream_visits(
    scans: Iterable[Scan | Damage],
    width: float = WIDTH,
    tell: Callable[[str], None] = lambda note: None,
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


def tracked(
    log: RobotLog, tell: Callable[[str], None] = lambda note: None
) -> tuple[RobotLog, Track, tuple[str, ...]]:
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

    log, corrected, whole = log_checks.checked(log)
    stuck = log_checks.describe_stuck_laser(log)
    say([*corrected, *whole, *stuck])
    track = follow(log)
    say(jumps.describe_cuts(log, track, turned_wrongly(log, track)))
    # If the odometry is wrong throughout, that explains all differences between the trajectories.
    doubt = None if whole or stuck else disagreement(log, track)
    say([doubt] if doubt else [])
    explained = bool(whole or stuck or doubt or track.cuts)
    track, doubts = log_checks.judged(log, track, explained)
    say(doubts)
    return log, replace(track, is_reliable=track.is_reliable and not (stuck or doubt)), tuple(notes)


def _noted(message: str, notes: Sequence[str]) -> LogError:
    """Make an error that carries notes. They are not in its text, as they were already printed."""
    error = LogError(message)
    for note in notes:
        error.add_note(note)
    return error


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
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    begin = time.process_time()
    yield
    seconds[stage] = round(time.process_time() - begin, 3)


def factor_of(track: Track, visits: Sequence[Visit], closings: Sequence[VisitMatch]) -> float:
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
