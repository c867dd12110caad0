"""Measure the accuracy of maps by true poses: are visits at one place of a map truly at one place?

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

In this example steps 0 and 2 are half a metre apart, and the minimal map rightly has them at one
dstate. It wrongly has steps 1 and 3 at one dstate. The truth names no places here, because real
places have no clear border. It has the poses at which the robot passed, and two poses that are near
each other count as one place.

*What is counted.* A visit is the steps between two travels. For places, pairs of visits are
counted. For dstates, pairs of steps of different visits are counted. A pair is a true *return* if
both are near each other and the robot was farther away at some visit in between. If the robot only
went on to the next door, it may be near without having returned. It is not clear whether such a
pair is one place, so it is left out and counted as `stayed`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.checks import a_number, an_instance
from ssh_abduction.data.errors import TraceError, named
from ssh_abduction.data.maps import SSHMap, checked_maps
from ssh_abduction.data.odometry import Pose, displacement_between, moved
from ssh_abduction.data.schema import attributes_of
from ssh_abduction.data.trace import Trace, checked_trace
from ssh_abduction.data.words import counted
from ssh_abduction.evaluation.named_truth import map_of_trace
from ssh_abduction.evaluation.trajectory import Relations, checked_pose, checked_time, three_numbers

# By default two poses within this many metres are one place.
NEAR = 2.0
# They are one dstate if their headings also differ by at most this many degrees. Half of a right
# angle distinguishes the directions of a corridor, and still lets a robot swerve.
TURNED = 45.0
# A distance from composed relations may be wrong by DOUBT metres, plus DOUBT_OF_WAY times the
# length of the relations that were composed. For the Freiburg log, relations and corrected poses
# differ by no more at 998 of 1,000 pairs of scans.
DOUBT, DOUBT_OF_WAY = 0.2, 0.01

Array: TypeAlias = NDArray[np.float64]
Steps: TypeAlias = NDArray[np.int_]
Verdicts: TypeAlias = NDArray[np.uint8]
# The truth about a pair: unknown; different places; a return; or near each other, but the robot was
# not away in between.
UNKNOWN, APART, RETURN, STAYED = range(4)
JUDGED = APART, RETURN
UNKNOWN_POSE = (math.nan,) * 3


@dataclass(frozen=True, slots=True)
class JudgedPairs:
    """The numbers of pairs of visits (or steps) that are judged, and that are left out.

    Attributes:
        judged: The number of pairs for which the truth is known: one place (or dstate), or not.
        returns: The number of judged pairs that are truly at one place (or dstate).
        stayed: The number of pairs left out because they are near each other and the robot did not
            leave in between.
        unknown: The number of pairs left out because their distance is not known well enough.
    """

    judged: int
    returns: int
    stayed: int
    unknown: int


@dataclass(frozen=True, slots=True)
class MapPairs:
    """The accuracy of a map for the judged pairs of visits (or steps).

    Attributes:
        things: The number of places (or dstates) of the map.
        joined: The number of judged pairs that the map has at one place (or dstate).
        right: The number of joined pairs that are truly at one place (or dstate).
        returns: The number of judged pairs that are truly at one place (or dstate), joined or not.
    """

    things: int
    joined: int
    right: int
    returns: int

    @property
    def precision(self) -> float | None:
        """The share of joined pairs that are truly at one place; None if no pairs are joined."""
        return self.right / self.joined if self.joined else None

    @property
    def recall(self) -> float | None:
        """The share of pairs truly at one place that the map joins; None if there are none."""
        return self.right / self.returns if self.returns else None

    def to_dict(self) -> dict[str, Any]:
        """Return a dict with counts, precision and recall."""
        return attributes_of(self, "things", "joined", "right", "precision", "recall")


@dataclass(frozen=True, slots=True)
class MapVisits:
    """The accuracy of one map, by pairs.

    Attributes:
        places: The accuracy for pairs of visits; None if the map has no places (causal theories).
        dstates: The accuracy for pairs of steps of different visits.
    """

    places: MapPairs | None
    dstates: MapPairs


@dataclass(frozen=True, slots=True)
class VisitsEvaluation:
    """The accuracy of maps of one trace, judged by poses.

    Attributes:
        judge: The source of the truth: "poses" (of the trace), or "relations".
        near: The greatest distance of two poses at one place in metres.
        turned: The greatest difference of two headings at one dstate in degrees.
        visits: The number of visits of the trace.
        places: The numbers of pairs of visits.
        dstates: The numbers of pairs of steps of different visits.
        maps: The accuracy of each map, in the given order.
        by_both: The number of pairs of visits that both relations and poses judge, and the number
            of these on which they agree. None without relations, or if the trace has no poses.
    """

    judge: str
    near: float
    turned: float
    visits: int
    places: JudgedPairs
    dstates: JudgedPairs
    maps: tuple[MapVisits, ...]
    by_both: tuple[int, int] | None = None

    def __repr__(self) -> str:
        visits, returns = counted(self.visits, "visits"), counted(self.places.returns, "returns")
        maps = counted(len(self.maps), "maps")
        return f"<VisitsEvaluation: {maps} of {visits}, {returns} by {self.judge}>"

    def to_dict(self) -> dict[str, Any]:
        """Return a dict from names to values, as `evaluate --json` prints it."""
        own = attributes_of(self, "near", "turned", "visits")
        own |= {"places": asdict(self.places), "dstates": asdict(self.dstates)}
        if self.by_both is not None:
            own |= {"by_both": self.by_both[0], "alike": self.by_both[1]}
        return {**own, "maps": [attributes_of(one, "places", "dstates") for one in self.maps]}


def evaluate_visits(
    maps: Iterable[SSHMap],
    trace: Trace,
    *,
    near: float = NEAR,
    turned: float = TURNED,
    relations: Relations | None = None,
) -> VisitsEvaluation:
    """Measure the accuracy of maps of a trace by true poses, or by relations.

    Pairs of visits that a map puts at one place, and pairs of steps that it has at one dstate, are
    compared with the truth.

    Args:
        maps: Maps of the trace.
        trace: A trace whose steps have true poses. With relations, steps need times instead.
        near: The greatest distance of two poses at one place in metres.
        turned: The greatest difference of two headings at one dstate in degrees.
        relations: Hand-checked relative poses. If given, they are the truth at the `time` of each
            step, instead of the poses of the trace.

    Returns:
        The accuracy of each map, and the numbers of pairs that are judged.

    Raises:
        TraceError: No step has a pose (or a time near those of relations), or one is malformed.
        MapError: A map is not of the steps of this trace.
    """
    checked_trace(trace)
    for name, value in (("near", near), ("turned", turned)):
        mend = f"say what counts as one {'place' if name == 'near' else 'dstate'}"
        a_number(name, value, TraceError, above=0, mend=mend)
    maps = checked_maps(maps)
    if relations is not None:
        mend = "make them with Relations.load, or leave them out"
        an_instance("relations", relations, Relations, TraceError, mend=mend)
    truth = _by_poses(trace) if relations is None else _by_relations(trace, relations)
    # A travel begins a new visit.
    visit = np.cumsum([0, *(action.kind != "turn" for action in trace.actions)])
    places, dstates = _verdicts(truth, visit, near, turned)
    by_both = None
    if relations is not None and any(told_poses(trace)):
        other, _ = _verdicts(_by_poses(trace), visit, near, turned)
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
            _evaluated(map_of_trace(ssh_map, f"maps[{i}]", trace), visit, places, dstates)
            for i, ssh_map in enumerate(maps)
        ),
        by_both=by_both,
    )


def told_poses(trace: Trace) -> list[Pose | None]:
    """Return the true pose of each step, in metres and radians; None if unknown.

    Raises TraceError if a pose is malformed.
    """
    values = [
        step.truth.get("pose") if isinstance(step.truth, Mapping) else None for step in trace.steps
    ]
    return [
        None if value is None else three_numbers(value, f"{trace.at(t)}: truth.pose")
        for t, value in enumerate(values)
    ]


@dataclass(frozen=True)
class _PoseTruth:
    """The truth about where the robot was."""

    name: str  # "poses" or "relations"
    known: NDArray[np.bool_]  # (n,) flags of the steps whose pose is known
    # Compares all n steps with one step. Returns (n,) distances in metres, differences of headings
    # in degrees, and possible errors of the distances in metres; NaN if a pose is unknown.
    seen_from: Callable[[int], tuple[Array, Array, Array]]


def _by_poses(trace: Trace) -> _PoseTruth:
    """The truth by the poses of a trace. Raises TraceError if it has none."""
    told = told_poses(trace)
    if not any(told):
        raise TraceError(
            f"{named(trace.source or 'trace')}: truth.pose: expected the true pose of some "
            'step, got none; write "truth": {"pose": [x, y, heading]} on the steps, '
            "as import does where a log has corrected poses"
        )
    poses = np.array([pose or UNKNOWN_POSE for pose in told])

    def seen_from(step: int) -> tuple[Array, Array, Array]:
        dx, dy, turned = (poses - poses[step]).T
        return np.hypot(dx, dy), _degrees(turned), np.zeros(len(dx))

    return _PoseTruth("poses", ~np.isnan(poses[:, 0]), seen_from)


def _by_relations(trace: Trace, relations: Relations) -> _PoseTruth:
    """The truth by relative poses. Raises TraceError if no step has a time near those of relations.

    The relations give the pose of the robot. `seen` of a step gives the pose of the dstate as the
    robot saw it.
    """
    steps = [(step.extra, trace.at(t)) for t, step in enumerate(trace.steps)]
    times = [checked_time(extra.get("time"), where) for extra, where in steps]
    sights = [checked_pose(extra.get("seen"), where) for extra, where in steps]
    known = np.array([relations.covers(time) for time in times])
    if not known.any():
        began, ended = relations.times[0], relations.times[-1]
        raise TraceError(
            f"{named(trace.source or 'trace')}: time: expected steps between {began:g} and "
            f"{ended:g} s, as the relations have, got none; import the trace from the log of "
            "the relations"
        )

    def seen_from(step: int) -> tuple[Array, Array, Array]:
        found = [
            (*UNKNOWN_POSE, math.nan)
            if robot is None
            else (*displacement_between(sights[step], moved(robot[0], seen)), robot[1])
            for robot, seen in zip(relations.between(times, step), sights, strict=True)
        ]
        dx, dy, turned, way = np.array(found).T
        return np.hypot(dx, dy), _degrees(turned), DOUBT + DOUBT_OF_WAY * way

    return _PoseTruth("relations", known, seen_from)


def _degrees(radians: Array) -> Array:
    """Convert angles in radians to the sizes of turns in degrees, 0 to 180."""
    return np.abs(np.degrees((radians + math.pi) % math.tau - math.pi))


def _verdicts(
    truth: _PoseTruth, visit: Steps, near: float, turned: float
) -> tuple[Verdicts, Verdicts]:
    """Judge each pair of v visits, and each pair of n steps of different visits.

    The result is two matrices, v x v and n x n. The row is the earlier one of a pair; entries below
    the diagonal are UNKNOWN. Poses at one place are at most `near` metres apart, and headings at
    one dstate at most `turned` degrees.
    """
    steps = np.arange(len(visit))
    # A visit has the pose of the first of its steps whose pose is known.
    at = np.array(
        [min(steps[visit == v], key=lambda t: not truth.known[t]) for v in range(visit[-1] + 1)]
    )
    places = np.full((len(at), len(at)), UNKNOWN, np.uint8)
    dstates = np.full((len(visit), len(visit)), UNKNOWN, np.uint8)

    def judged(step: int, others: Any) -> tuple[Verdicts, Array]:
        """Judge pairs of a step and others: UNKNOWN, APART, or near. Return also the headings."""
        distance, heading, doubt = (values[others] for values in truth.seen_from(step))
        verdicts = np.where(distance > near, APART, STAYED).astype(np.uint8)
        verdicts[~(np.abs(distance - near) >= doubt)] = UNKNOWN
        return verdicts, heading

    for v, first in enumerate(at):
        row = judged(first, at)[0]
        # For each later visit, whether the robot was away at some visit before it.
        left = np.cumsum(row[v:-1] == APART) > 0
        places[v, v + 1 :] = np.where(left & (row[v + 1 :] == STAYED), RETURN, row[v + 1 :])
        later = visit > v
        for step in steps[visit == v]:
            row, heading = judged(step, later)
            returned = np.where(heading <= turned, RETURN, APART)
            is_back = left[visit[later] - v - 1] & (row == STAYED)
            dstates[step, later] = np.where(is_back, returned, row)
    return places, dstates


def _pairs(verdicts: Verdicts, visit: Steps) -> JudgedPairs:
    """Count the verdicts in an n x n matrix on pairs. `visit` has the visit of each row."""
    counts = Counter(verdicts[visit[:, None] < visit].tolist())
    return JudgedPairs(
        counts[APART] + counts[RETURN], counts[RETURN], counts[STAYED], counts[UNKNOWN]
    )


def _evaluated(ssh_map: SSHMap, visit: Steps, places: Verdicts, dstates: Verdicts) -> MapVisits:
    """Measure a map by the verdicts on pairs of visits (`places`) and of steps (`dstates`)."""
    at = [ssh_map.dstates[label] for label in ssh_map.dstate_at]
    one = np.equal.outer(*[[s.id for s in at]] * 2)
    if not ssh_map.places:
        return MapVisits(None, _joined(one, dstates, len(ssh_map.dstates)))
    # A step without a place is NaN, which is not equal to itself. So it shares no place.
    own = np.array([math.nan if s.place is None else s.place for s in at])
    # Two visits are at one place if a step of one and a step of the other are.
    starts = np.flatnonzero(np.diff(visit, prepend=-1))
    together = np.logical_or.reduceat(
        np.logical_or.reduceat(np.equal.outer(own, own), starts, axis=0), starts, axis=1
    )
    return MapVisits(
        _joined(together, places, len(ssh_map.places)), _joined(one, dstates, len(ssh_map.dstates))
    )


def _joined(one: NDArray[np.bool_], verdicts: Verdicts, things: int) -> MapPairs:
    """Count the judged pairs. `one`, an n x n matrix, is true for pairs that the map joins."""
    right, wrong = (int((one & (verdicts == kind)).sum()) for kind in (RETURN, APART))
    return MapPairs(things, right + wrong, right, int((verdicts == RETURN).sum()))
