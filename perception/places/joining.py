"""Joins the logs of several drives through one building to one log.

The scans of the drives are listed one drive after the other. How the frames of two drives relate is
unknown. So the track of each drive begins where the previous track ends, which has no meaning.
Closures between drives say how visits of two drives lie relative to each other.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate, chain

import numpy as np

from perception.places.closures import closures_between
from perception.places.distinctive import Visit
from perception.places.importing import Imported, with_views
from perception.places.tracing import closure_of
from perception.places.track import Array, Track
from perception.readers.scans import RobotLog
from ssh_abduction.data.drives import together
from ssh_abduction.data.trace import Trace


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
    closings = closures_between([part.visits for part in parts], [part.poses for part in parts])
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
