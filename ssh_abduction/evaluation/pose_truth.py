"""The accuracy of maps by true poses: are visits at one place of the map truly at one?

>>> from dataclasses import replace
>>> from ssh_abduction import Theory, Trace, solve
>>> from ssh_abduction.evaluation import evaluate_visits
>>> seen = Trace.from_steps("abab", [{"name": "go", "kind": "travel"}] * 3)
>>> poses = [0, 0, 0], [9, 0, 0], [0.5, 0, 0], [0, 9, 0]
>>> steps = [replace(step, truth={"pose": pose}) for step, pose in zip(seen.steps, poses)]
>>> trace = replace(seen, steps=tuple(steps))
>>> found = evaluate_visits(solve(trace, Theory.causal()).maps, trace)
>>> found.dstates.judged, found.dstates.returns, found.maps[0].dstates
(6, 1, MapPairs(things=2, joined=2, right=1, returns=1))

The minimal map rightly has steps 0 and 2 at one dstate, half a metre apart, and wrongly steps 1 and
3. The truth has no names here, as nobody can say where a place ends. It has the poses at which the
robot passed, and two poses are taken for one place if they are near each other.

*What is counted.* A visit is the steps between two travels, which turns join. Pairs of visits are
counted for places, and pairs of steps of different visits for dstates. A pair is a true *return* if
both are near each other and the robot was farther away at some visit in between. If it merely went
on to the next door, it did not return, but both may be near each other. Nobody can say whether
such a pair is one place, so it is left out and counted as `stayed`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from simulator.motion import Pose, between, moved
from ssh_abduction.data.checks import an_instance
from ssh_abduction.data.errors import TraceError, brief, is_finite, named
from ssh_abduction.data.maps import SSHMap, checked_maps
from ssh_abduction.data.trace import Trace, checked_trace
from ssh_abduction.data.words import counted
from ssh_abduction.evaluation.named_truth import checked_map
from ssh_abduction.evaluation.relations import Relations
from ssh_abduction.evaluation.trajectory import checked_pose, checked_time

# By default two poses within this many metres are one place.
NEAR = 2.0
# They are one dstate if their headings also differ by at most this many degrees: half of a right
# angle distinguishes the directions of a corridor, and lets a robot swerve.
TURNED = 45.0
# A distance by composed relations is in doubt by this many metres, and by this share of the way
# along which they were composed. Relations and corrected poses of Freiburg differ by at most that
# at 998 of 1,000 pairs of scans.
DOUBT, DOUBT_OF_WAY = 0.2, 0.01

Array: TypeAlias = NDArray[np.float64]
Steps: TypeAlias = NDArray[np.int_]
Verdicts: TypeAlias = NDArray[np.uint8]
# The truth about a pair: unknown; distinct places; a return; or near each other, but the robot was
# not away in between.
UNKNOWN, APART, RETURN, STAYED = range(4)
JUDGED = APART, RETURN


@dataclass(frozen=True, slots=True)
class Pairs:
    """How many pairs are judged, and how many are left out.

    Attributes:
        judged: Pairs that are known to be one place (or dstate), or not.
        returns: The judged pairs that are one.
        stayed: Pairs left out because they are near each other, but the robot was not farther away
            in between.
        unknown: Pairs left out because the truth does not say how far apart they are.
    """

    judged: int
    returns: int
    stayed: int
    unknown: int


@dataclass(frozen=True, slots=True)
class MapPairs:
    """What a map says of the judged pairs.

    Attributes:
        things: How many places (or dstates) the map has at the steps of the trace.
        joined: How many of the judged pairs it has at one place (or dstate).
        right: How many of the joined pairs truly are at one.
        returns: How many of the judged pairs truly are at one, joined or not.
    """

    things: int
    joined: int
    right: int
    returns: int

    @property
    def precision(self) -> float | None:
        """Of the pairs that the map joins, the share that truly is one; None if it joins none."""
        return self.right / self.joined if self.joined else None

    @property
    def recall(self) -> float | None:
        """Of the pairs that truly are one, the share that the map joins; None if there are none."""
        return self.right / self.returns if self.returns else None

    def to_dict(self) -> dict[str, Any]:
        """The counts, precision and recall under their names."""
        return {
            "things": self.things,
            "joined": self.joined,
            "right": self.right,
            "precision": self.precision,
            "recall": self.recall,
        }


@dataclass(frozen=True, slots=True)
class MapVisits:
    """The accuracy of one map, by pairs.

    Attributes:
        places: Pairs of visits; None for a map without places, as of a causal theory.
        dstates: Pairs of steps of different visits.
    """

    places: MapPairs | None
    dstates: MapPairs


@dataclass(frozen=True, slots=True)
class VisitsEvaluation:
    """The accuracy of maps of one trace, judged by poses.

    Attributes:
        judge: Where the truth is from: "poses" of the trace, or "relations".
        near: Metres within which two poses are one place.
        turned: Degrees by which the headings of one dstate differ at most.
        visits: Number of visits of the trace.
        places: Pairs of visits.
        dstates: Pairs of steps of different visits.
        maps: Each map, in the order given.
        by_both: The number of pairs of visits that relations and poses both judge, and the number
            that they judge alike. None if only poses judge.
    """

    judge: str
    near: float
    turned: float
    visits: int
    places: Pairs
    dstates: Pairs
    maps: tuple[MapVisits, ...]
    by_both: tuple[int, int] | None = None

    def __repr__(self) -> str:
        visits, returns = counted(self.visits, "visits"), counted(self.places.returns, "returns")
        maps = counted(len(self.maps), "maps")
        return f"<VisitsEvaluation: {maps} of {visits}, {returns} by {self.judge}>"

    def to_dict(self) -> dict[str, Any]:
        """The values under their names, as `evaluate --json` prints them, with shares."""
        own: dict[str, Any] = {
            "near": self.near,
            "turned": self.turned,
            "visits": self.visits,
            "places": asdict(self.places),
            "dstates": asdict(self.dstates),
        }
        maps = [
            {"places": found.places and found.places.to_dict(), "dstates": found.dstates.to_dict()}
            for found in self.maps
        ]
        if self.by_both is not None:
            own |= {"by_both": self.by_both[0], "alike": self.by_both[1]}
        return {**own, "maps": maps}


def evaluate_visits(
    maps: Iterable[SSHMap],
    trace: Trace,
    *,
    near: float = NEAR,
    turned: float = TURNED,
    relations: Relations | None = None,
) -> VisitsEvaluation:
    """The accuracy of maps of a trace, by the pairs that they have at one place, and at one dstate.

    Args:
        maps: Maps of the trace.
        trace: A trace whose steps have true poses; with relations, times.
        near: Metres within which two poses are one place.
        turned: Degrees by which the headings of one dstate differ at most.
        relations: Judge by them, at the `time` of the steps, in place of the poses of the trace.

    Raises:
        TraceError: No step has a pose (with relations: a time), or one is malformed.
        MapError: A map is of other steps.
    """
    checked_trace(trace)
    for name, value in (("near", near), ("turned", turned)):
        if not is_finite(value) or value <= 0:
            thing = "place" if name == "near" else "dstate"
            raise TraceError(
                f"{name}: expected a number above 0, got {brief(value)}; "
                f"say what counts as one {thing}"
            )
    maps = checked_maps(maps)
    if relations is not None:
        an_instance(
            "relations",
            relations,
            Relations,
            TraceError,
            mend="make them with Relations.load, or leave them out",
        )
    truth: _Poses | _Related = _Poses(trace) if relations is None else _Related(trace, relations)
    # A travel begins a new visit.
    visit = np.cumsum([0, *(action.kind != "turn" for action in trace.actions)])
    places, dstates = _verdicts(truth, visit, near, turned)
    by_both = None
    if relations is not None and any(told_poses(trace)):
        other, _ = _verdicts(_Poses(trace), visit, near, turned)
        judged = np.isin(places, JUDGED) & np.isin(other, JUDGED)
        by_both = int(judged.sum()), int((judged & (places == other)).sum())
    return VisitsEvaluation(
        judge=truth.name,
        near=float(near),
        turned=float(turned),
        visits=len(places),
        places=_pairs(places, np.arange(len(places))),
        dstates=_pairs(dstates, visit),
        maps=tuple(
            _evaluated(checked_map(ssh_map, f"maps[{i}]", trace), visit, places, dstates)
            for i, ssh_map in enumerate(maps)
        ),
        by_both=by_both,
    )


def told_poses(trace: Trace) -> list[Pose | None]:
    """The true pose of each step, (x, y, heading) in metres and radians; None if unknown.

    Raises TraceError for one that is malformed.
    """
    told = [
        step.truth.get("pose") if isinstance(step.truth, Mapping) else None for step in trace.steps
    ]
    return [_pose(value, f"{trace.at(t)}: truth.pose") for t, value in enumerate(told)]


def _pose(value: Any, where: str) -> Pose | None:
    """A pose from JSON; None if there is none. Raises TraceError for anything else."""
    if value is None:
        return None
    if (
        isinstance(value, Sequence)
        and not isinstance(value, str)
        and len(value) == 3
        and all(is_finite(number) for number in value)
    ):
        return float(value[0]), float(value[1]), float(value[2])
    raise TraceError(
        f"{where}: expected [x, y, heading] in metres and radians, got {brief(value)}; mend it"
    )


class _Poses:
    """Judges by the poses of a trace."""

    name = "poses"

    def __init__(self, trace: Trace) -> None:
        poses = told_poses(trace)
        self.told = np.array([pose is not None for pose in poses])
        if not self.told.any():
            raise TraceError(
                f"{named(trace.source or 'trace')}: truth.pose: expected the true pose of some "
                'step, got none; write "truth": {"pose": [x, y, heading]} on the steps, '
                "as import does where a log has corrected poses"
            )
        self._poses = np.array([(math.nan,) * 3 if pose is None else pose for pose in poses])

    def seen_from(self, step: int) -> tuple[Array, Array, Array]:
        """Each step as seen from one.

        Returns:
            Distances in metres, (n,), differences of headings in degrees, (n,), and the doubt of
            the distances in metres, (n,). NaN if a pose is unknown.
        """
        dx, dy, turned = (self._poses - self._poses[step]).T
        return np.hypot(dx, dy), _degrees(turned), np.zeros(len(dx))


class _Related:
    """Judges by relations, at the times of a trace."""

    name = "relations"

    def __init__(self, trace: Trace, relations: Relations) -> None:
        self._relations = relations
        self._times = [
            checked_time(step.extra.get("time"), trace.at(t)) for t, step in enumerate(trace.steps)
        ]
        self._seen = [
            checked_pose(step.extra.get("seen"), trace.at(t)) for t, step in enumerate(trace.steps)
        ]
        self.told = np.array([relations.covers(time) for time in self._times])
        if not self.told.any():
            began, ended = relations.times[0], relations.times[-1]
            raise TraceError(
                f"{named(trace.source or 'trace')}: time: expected steps at times that are "
                f"related, from {began:g} to {ended:g} s, got none; "
                "import the trace from the log that the relations are of"
            )

    def seen_from(self, step: int) -> tuple[Array, Array, Array]:
        """As `_Poses.seen_from`, by the robot's relative poses and its sightings of dstates."""
        robots = self._relations.between(self._times, step)
        origin = self._seen[step]
        dx, dy, turned, way = np.array(
            [
                (math.nan,) * 4
                if robot is None
                else (*between(origin, moved(robot[0], seen)), robot[1])
                for robot, seen in zip(robots, self._seen, strict=True)
            ]
        ).T
        return np.hypot(dx, dy), _degrees(turned), DOUBT + DOUBT_OF_WAY * way


def _degrees(radians: Array) -> Array:
    """The sizes of turns, from 0 to 180 degrees."""
    return np.abs(np.degrees((radians + math.pi) % math.tau - math.pi))


def _verdicts(
    truth: _Poses | _Related, visit: Steps, near: float, turned: float
) -> tuple[Verdicts, Verdicts]:
    """The verdict on each pair of visits, (v, v), and on each pair of steps, (n, n).

    The earlier one of a pair comes first. Other entries are UNKNOWN.

    Args:
        truth: Has the distances.
        visit: The visit of each step, (n,), counted from 0.
        near: Metres within which two poses are one place.
        turned: Degrees by which the headings of one dstate differ at most.
    """
    steps = np.arange(len(visit))
    # A visit has the pose of the first of its steps whose pose is known.
    at = np.array(
        [min(steps[visit == v], key=lambda t: not truth.told[t]) for v in range(visit[-1] + 1)]
    )
    places = np.full((len(at), len(at)), UNKNOWN, np.uint8)
    dstates = np.full((len(visit), len(visit)), UNKNOWN, np.uint8)
    for v, first in enumerate(at):
        distance, _, doubt = truth.seen_from(first)
        far, unknown = distance[at] > near, ~(np.abs(distance[at] - near) >= doubt[at])
        # For each later visit, whether the robot was away at one before.
        left = np.cumsum((far & ~unknown)[v:-1]) > 0
        places[v, v + 1 :] = np.where(unknown, UNKNOWN, np.where(far, APART, STAYED))[v + 1 :]
        places[v, v + 1 :][left & (places[v, v + 1 :] == STAYED)] = RETURN
        later = visit > v
        for step in steps[visit == v]:
            distance, heading, doubt = (told[later] for told in truth.seen_from(step))
            far, unknown = distance > near, ~(np.abs(distance - near) >= doubt)
            returned = np.where(
                left[visit[later] - v - 1], np.where(heading <= turned, RETURN, APART), STAYED
            )
            dstates[step, later] = np.where(unknown, UNKNOWN, np.where(far, APART, returned))
    return places, dstates


def _pairs(verdicts: Verdicts, visit: Steps) -> Pairs:
    """The number of pairs of different visits with each verdict.

    Args:
        verdicts: What is true of each pair.
        visit: The visit of each row.
    """
    told = Counter(verdicts[visit[:, None] < visit].tolist())
    return Pairs(told[APART] + told[RETURN], told[RETURN], told[STAYED], told[UNKNOWN])


def _evaluated(ssh_map: SSHMap, visit: Steps, places: Verdicts, dstates: Verdicts) -> MapVisits:
    """What a map says of the judged pairs."""
    at = [ssh_map.dstates[label] for label in ssh_map.labels]
    one = np.equal.outer(*[[s.id for s in at]] * 2)
    if not ssh_map.places:
        return MapVisits(None, _joined(one, dstates, len(ssh_map.dstates)))
    # A step without a place is at no place with any other: NaN is not equal to itself.
    own = np.array([math.nan if s.place is None else s.place for s in at])
    # Two visits are at one place if some steps of them are.
    starts = np.flatnonzero(np.diff(visit, prepend=-1))
    together = np.logical_or.reduceat(
        np.logical_or.reduceat(np.equal.outer(own, own), starts, axis=0), starts, axis=1
    )
    return MapVisits(
        _joined(together, places, len(ssh_map.places)), _joined(one, dstates, len(ssh_map.dstates))
    )


def _joined(one: NDArray[np.bool_], verdicts: Verdicts, things: int) -> MapPairs:
    """What a map says of the judged pairs.

    Args:
        one: Whether the map has each pair as one.
        verdicts: What is true of each pair; UNKNOWN for what is no pair, so that it does not count.
        things: How many places (or dstates) the map has.
    """
    right = int((one & (verdicts == RETURN)).sum())
    return MapPairs(
        things,
        right + int((one & (verdicts == APART)).sum()),
        right,
        int((verdicts == RETURN).sum()),
    )
