"""From a robot's log to a trace, one line a stage.

The robot did not stop at distinctive states. Where its way leads past a junction, a corner or a dead end, or where it turned around, the local map tells what it would have seen from
the middle of the place: the plan of Kuipers & Beeson (2002) to do without physical motion to the actual location.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from perception.errors import ImageWarning, LogError
from perception.places.doors import are_frequent, find_doors, is_wide, visits_of
from perception.places.scale import Scale, suggested
from perception.places.tracing import to_trace
from perception.places.track import Track, follow
from perception.places.visits import Visit, find_visits
from perception.readers.scans import RobotLog
from perception.reciprocal import ReciprocalTransformer
from perception.views import ViewClusterer
from ssh_abduction.errors import named
from ssh_abduction.trace import Trace

# A view is to be seen so many times in the mean, at least: of few images of many places most views would be seen once, and tell nothing.
SEEN = 12


@dataclass(frozen=True, eq=False)
class Imported:
    """What became of a log.

    trace    a step for each dstate that was visited, with view, image, star and displacement
    track    the way of the robot
    scale    what the building was measured by
    visits   the distinctive places that the robot passed
    seconds  processor time of each stage
    """

    trace: Trace
    track: Track
    scale: Scale
    visits: tuple[Visit, ...]
    seconds: Mapping[str, float]


def import_log(
    log: RobotLog, gateway: float | None = None, radius: float | None = None, name: str | None = None, doors: bool | None = None
) -> Imported:
    """The trace of a log. Corrected poses are truth for evaluation, and nothing here reads them for anything else.

    gateway, radius  metres, as in Scale; what the log itself suggests, where they are None
    name             of the trace
    doors            whether the doors that the robot drives through are the places, rather than where ways part or bend. Where it is None, the log itself suggests it;
                     but no doors are asked for where gateway or radius is given, as these are about ways that part

    Raises LogError where the robot passed no distinctive place, or hardly moved.
    """
    seconds: dict[str, float] = {}
    if doors is None and (gateway is not None or radius is not None):
        doors = False
    if not any(((scan.ranges > 0) & (scan.ranges < scan.laser.reach)).any() for scan in log.scans):
        raise LogError(
            f"{named(log.source)}: expected scans that meet walls, got {len(log)} in which no beam meets anything; look at the laser"
        )
    with _timed(seconds, "track"):
        track = follow(log)
    if track.way[-1] < 1.0:
        raise LogError(f"{named(log.source)}: expected a robot that drives, got a way of {track.way[-1]:.1f} m; take a longer log")
    with _timed(seconds, "scale"):
        found = suggested(log.scans, track)
        scale = replace(found, gateway=found.gateway if gateway is None else gateway, radius=found.radius if radius is None else radius)
    with _timed(seconds, "places"):
        passed = find_doors(log, track) if doors or (doors is None and is_wide(scale)) else ()
        scale = replace(scale, doors=are_frequent(passed, track) if doors is None else doors)
        visits = visits_of(track, passed) if scale.doors else find_visits(log, track, scale)
    if not visits and scale.doors:
        raise LogError(
            f"{named(log.source)}: expected a way through doors, got {track.way[-1]:.0f} m without any; look for junctions instead (--places junctions)"
        )
    if not visits:
        raise LogError(
            f"{named(log.source)}: expected a way past junctions, corners or dead ends, got {track.way[-1]:.0f} m without any at a radius of "
            f"{scale.radius:g} m; take a longer log, or a smaller radius (--radius)"
        )
    with _timed(seconds, "trace"):
        trace = to_trace(log, track, scale, visits, name)
    with _timed(seconds, "views"):
        trace = with_views(trace)
    return Imported(trace, track, scale, visits, seconds)


def with_views(trace: Trace) -> Trace:
    """The trace with views of its images: few, so that one place has one view, whatever stood around (Kuipers & Beeson 2002, section 3)."""
    images = ReciprocalTransformer(floor=0.3).fit_transform(np.array([step.image for step in trace.steps]))
    most = max(2, len(images) // SEEN)
    if len(images) <= most or (images == images[0]).all():
        views, sure = np.zeros(len(images), int), np.ones(len(images))
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ImageWarning)
            clusterer = ViewClusterer(k_max=most, by="trimmed", random_state=0).fit(images)
        views, sure = clusterer.labels_, clusterer.confidence_
    seen = zip(trace.steps, views, sure, strict=True)
    return replace(trace, steps=tuple(replace(step, view=int(view), confidence=round(float(c), 4)) for step, view, c in seen))


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    begin = time.process_time()
    yield
    seconds[stage] = round(time.process_time() - begin, 3)
