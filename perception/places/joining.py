"""Joins the logs of several drives through one building to one log.

The scans of the drives are listed one drive after the other. How the frames of two drives relate is
unknown. So the track of each drive begins where the previous track ends, which has no meaning.
Closures between drives say how visits of two drives lie relative to each other.

To find them, each pair of visits is matched in all rotations, and each reliable match says how the
frames relate. Places look alike, so a match counts only if at least VOTES visits of the second
drive agree on one relation, and no other relation has more than half as many.

Relations of three drives form a loop. The two relations on which most visits agree say what the
third one is. If no match of the third relation agrees with them, it is not believed.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, chain, combinations

import numpy as np

from perception.places.closures import KEPT, TURN, VisitMatch, is_reliable
from perception.places.importing import Imported, with_views
from perception.places.matching import Scene, Turned, match
from perception.places.tracing import closure_of
from perception.places.track import Array, Track, points_turned
from perception.places.visits import Visit, patches_of
from perception.readers.scans import RobotLog
from ssh_abduction.data.drives import together
from ssh_abduction.data.trace import Trace

# A match predicts where the visit of another match is. Two matches agree if this is right to within
# NEAR metres, plus DRIFT metres for each metre between the two visits, and if their rotations
# differ by less than TWIST radians.
NEAR, DRIFT, TWIST = 0.7, 0.05, math.radians(10)
VOTES = 3
TURNS = [k * TURN for k in range(round(math.tau / TURN))]


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
    found = [closure_of(closing, arrivals) for closing in _closings(parts, counts)]
    seconds = _total([part.seconds for part in parts])
    seconds["drives"] = round(time.process_time() - begin, 3)
    return log, Imported(
        with_views(replace(trace, closures=(*trace.closures, *found))),
        track,
        parts[0].width,
        visits,
        seconds,
        _named(names, [part.notes for part in parts]),
        tuple(begins[1:]),
    )


def _closings(parts: Sequence[Imported], counts: Sequence[int]) -> Iterator[VisitMatch]:
    """Yield the closures between drives, with visits numbered over all drives."""
    scenes = [scenes_of(part) for part in parts]
    pairs = [*combinations(range(len(parts)), 2)]
    found = {(a, b): _reliable_matches(scenes[a], scenes[b]) for a, b in pairs}
    for (a, b), agreed in agreeing_matches(parts, found).items():
        for closing in _best_of_each_visit(agreed):
            yield replace(closing, first=closing.first + counts[a], last=closing.last + counts[b])


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
        np.concatenate([track.corrected(0, len(track.poses)) for track in tracks]),
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


def _total(seconds: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Add up the times of each stage."""
    return {stage: round(math.fsum(times[stage] for times in seconds), 3) for stage in seconds[0]}


def scenes_of(part: Imported) -> list[Scene]:
    """Prepare the local map of each visit of a drive for matching."""
    patches = patches_of(part.visits)
    return [
        Scene.of(patch, visit.middle) for visit, patch in zip(part.visits, patches, strict=True)
    ]


def _reliable_matches(ours: Sequence[Scene], theirs: Sequence[Scene]) -> list[VisitMatch]:
    """Match each visit of a drive with each visit of an earlier one, in all rotations."""
    found: list[VisitMatch] = []
    for j, scene in enumerate(theirs):
        turned = Turned.of(scene, TURNS)
        for i, other in enumerate(ours):
            matched = match(other, turned)
            if matched is not None and is_reliable(matched):
                found.append(VisitMatch(i, j, matched))
    return found


def _best_of_each_visit(agreed: Sequence[VisitMatch]) -> list[VisitMatch]:
    """Keep the KEPT best matches of each later visit."""
    kept: list[VisitMatch] = []
    for j in sorted({closing.last for closing in agreed}):
        here = [closing for closing in agreed if closing.last == j]
        kept += sorted(here, key=lambda closing: -closing.match.score)[:KEPT]
    return kept


def agreeing_matches(
    parts: Sequence[Imported], found: Mapping[tuple[int, int], Sequence[VisitMatch]]
) -> dict[tuple[int, int], list[VisitMatch]]:
    """Return, for each pair of drives, the matches that agree on the relation of their frames.

    If two better supported relations lead from one drive of a pair over a third drive to the other
    one, some matches must agree with them. Otherwise those that do are kept, if they are enough.
    """
    agreed = {
        (a, b): _largest(some, _relations(some, parts[a], parts[b]))
        for (a, b), some in found.items()
    }
    frames: dict[tuple[int, int], _FrameMatches] = {}  # of the relations that are believed
    for a, b in sorted(agreed, key=lambda pair: -_votes(agreed[pair])):
        here = _relations(found[a, b], parts[a], parts[b])
        ways = [
            (frames[c, b], frames[a, c])
            for c in range(len(parts))
            if (c, b) in frames and (a, c) in frames
        ]
        if ways:
            over, back = max(ways, key=lambda way: min(len(way[0].turns), len(way[1].turns)))
            fits = here.fitting(over, back)
            fitting = [one for one, fit in zip(found[a, b], fits, strict=True) if fit]
            if not any(one in fitting for one in agreed[a, b]):
                agreed[a, b] = fitting if _votes(fitting) >= VOTES else []
        if agreed[a, b]:
            frames[a, b] = _relations(agreed[a, b], parts[a], parts[b])
            frames[b, a] = frames[a, b].inverse()
    return agreed


def _votes(matches: Sequence[VisitMatch]) -> int:
    return len({one.last for one in matches})


@dataclass(frozen=True, eq=False)
class _FrameMatches:
    """What n matches say about how two frames relate.

    `turns` are rotations of the later frame, in radians. The middle of the later visit is `here` in
    the earlier frame and `there` in its own, (n, 2) metres.
    """

    turns: Array
    here: Array
    there: Array

    def agreeing(self, k: int) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Mask of the matches that agree with match k."""
        onward = self.there - self.there[k]
        expected = self.here[k] + points_turned(self.turns[k], onward)
        far = np.hypot(*(self.here - expected).T)
        twist = np.abs((self.turns - self.turns[k] + math.pi) % math.tau - math.pi)
        return np.asarray((far < NEAR + DRIFT * np.hypot(*onward.T)) & (twist < TWIST))

    def inverse(self) -> _FrameMatches:
        """Return what the matches say if the two drives change places."""
        return _FrameMatches(-self.turns, self.there, self.here)

    def fitting(self, over: _FrameMatches, back: _FrameMatches) -> list[bool]:
        """Whether each match agrees with two relations that lead over a third drive.

        `over` leads from the later frame to the frame of the third drive, and `back` from there to
        the earlier frame. Each is taken at its match that is nearest.
        """
        found = []
        for turn, here, at in zip(self.turns, self.here, self.there, strict=True):
            point, reach, twist = at, 2 * NEAR, turn
            for relation in (over, back):
                onward = point - relation.there
                k = int(np.argmin(np.hypot(*onward.T)))
                reach += DRIFT * np.hypot(*onward[k])
                twist -= relation.turns[k]
                point = relation.here[k] + points_turned(relation.turns[k], onward[k : k + 1])[0]
            twist = abs((twist + math.pi) % math.tau - math.pi)
            found.append(bool(math.dist(point, here) < reach and twist < 2 * TWIST))
        return found


def _relations(found: Sequence[VisitMatch], first: Imported, last: Imported) -> _FrameMatches:
    """Collect what matches between the visits of two drives say about their frames."""
    here = [first.visits[one.first].middle + one.match.shift for one in found]
    there = [last.visits[one.last].middle for one in found]
    return _FrameMatches(
        np.array([one.match.turn for one in found]),
        np.array(here).reshape(-1, 2),
        np.array(there).reshape(-1, 2),
    )


def _largest(found: Sequence[VisitMatch], relations: _FrameMatches) -> list[VisitMatch]:
    """Find the relation of the frames on which most matches agree, and list these matches.

    The list is empty if too few visits agree, or if another relation has more than half as many.
    """
    sets = [relations.agreeing(k) for k in range(len(found))]
    visits = np.array([one.last for one in found], int)

    def votes(mask: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> int:
        return len(set(visits[mask].tolist()))

    if not sets:
        return []
    best = max(sets, key=votes)
    rivals = [votes(sets[k]) for k in np.flatnonzero(~best)]
    if votes(best) < VOTES or max(rivals, default=0) > votes(best) / 2:
        return []
    return [found[k] for k in np.flatnonzero(best).tolist()]
