"""Read the truth about where a robot was: its trajectory, or relative poses at pairs of times.

Files are in the format of the TUM RGB-D benchmark, which evo and many SLAM programs write. A line
has the fields `timestamp tx ty tz qx qy qz qw`: seconds, metres, and the orientation as a
quaternion. Lines that begin with # are comments.

>>> from ssh_abduction.evaluation.trajectory import Trajectory
>>> poses = [(0.0, 0.0, 0.0), (1.0, 0.0, 1.0), (5.0, 0.0, 0.0)]
>>> driven = Trajectory(zip([0.0, 0.5, 9.0], poses))
>>> driven.at(0.25), driven.at(8.75), driven.at(5.0)
((0.5, 0.0, 0.5), (5.0, 0.0, 0.0), None)

A *relation* is the pose of the robot at a second time, in the frame of its pose at a first time.
Relations are hand-checked, and an independent truth about whether the robot was at one place at two
times. A file of relations (Kümmerle et al. 2009, "On measuring the accuracy of SLAM algorithms")
has a line for each relation: time1 time2 x y z roll pitch yaw, in seconds, metres and radians.

>>> from ssh_abduction.evaluation.trajectory import Relation, Relations
>>> quarter = 1.5707963
>>> around = Relations([Relation(t, t + 1.0, (4.0, 0.0, quarter)) for t in range(3)])
>>> seen = around.between([0.0, 1.5, 3.0], 0)
>>> [(round(dx, 1), round(dy, 1), round(way)) for (dx, dy, _), way in seen]
[(0.0, 0.0, 0), (4.0, 2.0, 6), (0.0, 4.0, 12)]
"""

from __future__ import annotations

import bisect
import math
import os
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from ssh_abduction.data.checks import a_number, numbers
from ssh_abduction.data.errors import TraceError, brief, named
from ssh_abduction.data.files import read_at_most
from ssh_abduction.data.odometry import Displacement, Pose, displacement_between, moved
from ssh_abduction.data.trace import Trace

# The fields of a line of a trajectory, and of a file of relations.
FIELDS = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
RELATION = ("time1", "time2", "x", "y", "z", "roll", "pitch", "yaw")
# What to do with lines of other numbers of fields.
HINTS = {
    12: "this looks like a file of KITTI, which has no times",
    17: "this looks like a file of EuRoC: evo_traj converts it",
}
# Files of more bytes than this are rejected.
LARGEST = 2**28
# A step may be this many seconds from the nearest pose or related time, as robots that map
# buildings drive at most a metre per second. Between two poses that are more than twice this time
# apart, poses are not interpolated.
NEAREST = 0.5
# The length of a quaternion may differ from 1 by this much, as numbers in files are rounded.
ROUNDED = 0.01
# A trajectory on one floor rises by at most this many metres.
FLAT = 1.0
# The poses of a robot on a floor lean by at most 30 degrees. This is the cosine of that angle.
UPRIGHT = math.cos(math.radians(30))
# Times in nanoseconds since 1970 are above this.
NANOSECONDS = 1e15
# The length of a relation is its distance plus this many metres, as short relations have errors,
# too. So ways along fewer relations are preferred.
EACH = 0.05


class TrajectoryWarning(UserWarning):
    """A warning that a trajectory does not fit well and may not be the intended one."""


class Trajectory:
    """The true poses of a robot over time.

    Attributes:
        source: The name of the trajectory, for messages.
        times: The times in seconds, sorted.
        poses: The pose (x, y, heading) at each time, in metres and radians.
    """

    def __init__(self, poses: Iterable[tuple[float, Pose]], source: str = "trajectory") -> None:
        """Take poses (x, y, heading) in metres and radians, each with a time in seconds.

        Raises TraceError, which names the source, if there are no poses, or two different
        poses at one time.
        """
        self.source = source
        found = sorted(dict.fromkeys(poses))
        if not found:
            raise TraceError(
                f"{named(source)}: expected lines of {' '.join(FIELDS)}, got none; "
                "give a trajectory in TUM format"
            )
        self.times, self.poses = [time for time, _ in found], [pose for _, pose in found]
        for before, after in zip(self.times[:-1], self.times[1:], strict=True):
            if before == after:
                raise TraceError(
                    f"{named(source)}: expected one pose at a time, got different ones at "
                    f"{before:.10g} s; keep one of them"
                )

    @staticmethod
    def load(path: str | os.PathLike[str]) -> Trajectory:
        """Read a trajectory in TUM format. Raises OSError, or TraceError, which names the line."""
        source = os.fspath(path)
        lines, table = _rows(source, FIELDS, "a trajectory in TUM format")
        lengths = np.linalg.norm(table[:, 4:], axis=1)
        for i in np.flatnonzero(np.abs(lengths - 1) > ROUNDED):
            raise TraceError(
                f"{named(source)}:{lines[i]}: qx qy qz qw: expected a quaternion of length 1, got "
                f"one of {lengths[i]:.3g}; mend the line"
            )
        # The yaw is the heading. The z axis of the rotation matrix has the cosine of the lean.
        qx, qy, qz, qw = (table[:, 4:] / lengths[:, None]).T
        headings = np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))
        leaning = int((1 - 2 * (qx * qx + qy * qy) < UPRIGHT).sum())
        poses = np.column_stack([table[:, 1:3], headings]).tolist()
        trajectory = Trajectory(zip(table[:, 0].tolist(), map(tuple, poses), strict=True), source)
        rise = float(np.ptp(table[:, 3]))
        if rise > FLAT or 2 * leaning > len(table):
            warnings.warn(
                f"{named(source)}: expected a trajectory on a floor, x and y in metres, got one "
                f"that rises by {rise:.1f} m, and {leaning} of {len(table)} poses that lean by "
                "more than 30 degrees: tz and the lean are not read; give the poses of the robot, "
                "not of a camera",
                TrajectoryWarning,
                stacklevel=2,
            )
        return trajectory

    def at(self, time: float | None) -> Pose | None:
        """Return the pose of the robot at a time in seconds; None if none is within half a second.

        The pose is interpolated between the poses before and after if these are at most a
        second apart in time. Otherwise it is the pose nearest in time.
        """
        if time is None:
            return None
        nearest, *_ = around = indices_around(self.times, time)
        first, last = min(around), max(around)
        if abs(self.times[nearest] - time) > NEAREST:
            return None
        if first == last or self.times[last] - self.times[first] > 2 * NEAREST:
            return self.poses[nearest]
        share = (time - self.times[first]) / (self.times[last] - self.times[first])
        return _interpolated(self.poses[first], self.poses[last], share)

    def told_to(self, trace: Trace) -> Trace:
        """Copy a trace, with the poses of this trajectory as the truth of its steps.

        These poses replace any other true poses. The rest of the truth is kept. As in imported
        logs, `time` of a step is the time in seconds at which the robot passed, and `seen` is the
        pose of the dstate in the frame of the robot.

        Raises:
            TraceError: No step has a time, or no step is near in time to this trajectory.
        """
        times = [
            checked_time(step.extra.get("time"), trace.at(t)) for t, step in enumerate(trace.steps)
        ]
        robots = [self.at(time) for time in times]
        placed = sum(robot is not None for robot in robots)
        if not placed:
            raise TraceError(self._no_match(trace, [time for time in times if time is not None]))
        if placed < len(times):
            warnings.warn(
                f"{named(self.source)}: {len(times) - placed} of {len(times)} steps have no pose "
                f"within {NEAREST:g} s of their time, and no truth: "
                "expected poses for the whole log",
                TrajectoryWarning,
                stacklevel=2,
            )
        # The pose of the dstate is given in the frame of the robot.
        steps = []
        for t, (step, robot) in enumerate(zip(trace.steps, robots, strict=True)):
            truth = step.truth if isinstance(step.truth, Mapping) else {"dstate": step.truth}
            pose = robot and moved(robot, checked_pose(step.extra.get("seen"), trace.at(t)))
            told = {**truth, "pose": pose and list(pose)}
            told = {name: value for name, value in told.items() if value is not None}
            steps.append(replace(step, truth=told or None))
        return replace(trace, steps=tuple(steps))

    def _no_match(self, trace: Trace, times: Sequence[float]) -> str:
        """Write why no step of a trace gets a pose, and what to do."""
        where = named(trace.source or "trace")
        if not times:
            return (
                f"{where}: time: expected the time of some step, in seconds, got none; "
                'import the trace from its log, or write "time" on its steps'
            )
        spans = [f"{min(span):.10g} to {max(span):.10g} s" for span in (self.times, times)]
        mend = (
            "take the trajectory of the log that the trace was imported from, "
            "or shift its times to those of the log"
        )
        if self.times[-1] > NANOSECONDS > max(times):
            mend = "the trajectory seems to have nanoseconds: divide its times by 1e9"
        return (
            f"{where}: time: expected steps within {NEAREST:g} s of poses of {named(self.source)}, "
            f"which are from {spans[0]}, got none: steps are from {spans[1]}; {mend}"
        )


def _rows(source: str, names: Sequence[str], what: str) -> tuple[list[int], NDArray[np.float64]]:
    """Read a text of lines of numbers, one for each name. Return line numbers, (n,), and numbers.

    Numbers are separated by spaces, tabs, commas or semicolons. Names of columns before the first
    numbers are skipped. Raises OSError, or TraceError, which names the line; `what` is expected.
    """
    try:
        text = read_at_most(source, LARGEST).decode("utf-8-sig")
    except ValueError as error:  # also for bytes that are no text
        raise TraceError(
            f"{named(source)}: expected {what}, got another file ({error}); give a text of "
            f"lines: {' '.join(names)}"
        ) from None
    lines: list[int] = []
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), 1):
        fields = re.split(r"[,;\s]+", line.partition("#")[0].strip(" \t,;"))
        values = [_number(field) for field in fields]
        if fields == [""] or (not rows and not np.isfinite(values).any()):
            continue  # an empty line, or the names of the columns
        if len(fields) != len(names) or not np.isfinite(values).all():
            mend = HINTS.get(len(fields), "mend the line")
            raise TraceError(
                f"{named(source)}:{number}: expected the numbers {' '.join(names)}, got "
                f"{brief(' '.join(fields))}; {mend}"
            )
        lines.append(number)
        rows.append(values)
    if not rows:
        raise TraceError(
            f"{named(source)}: expected lines of {' '.join(names)}, got none; give {what}"
        )
    return lines, np.array(rows)


def _number(field: str) -> float:
    """Convert a text to a number; NaN for anything else."""
    try:
        return float(field)
    except ValueError:
        return math.nan


def indices_around(times: Sequence[float], time: float) -> list[int]:
    """Find the last of the sorted times before a moment, and the first after; the nearer first.

    There is only one index if the moment is before or after all times.
    """
    after = bisect.bisect_left(times, time)
    around = [i for i in (after - 1, after) if 0 <= i < len(times)]
    return sorted(around, key=lambda i: abs(times[i] - time))


def _interpolated(first: Pose, second: Pose, share: float) -> Pose:
    """Return the pose at a share of the way from one pose to another. Turn the shorter way."""
    (x, y, heading), (u, v, other) = first, second
    turned = share * math.remainder(other - heading, math.tau)
    heading = math.remainder(heading + turned, math.tau)
    return x + share * (u - x), y + share * (v - y), heading


def checked_time(value: Any, where: str) -> float | None:
    """Return the time of a step in seconds, or None. Raise TraceError for anything else."""
    mend = "mend it, or leave it out"
    return (
        None
        if value is None
        else a_number(f"{where}: time", value, TraceError, what="seconds", mend=mend)
    )


def checked_pose(value: Any, where: str) -> Pose:
    """Read from JSON the pose of a dstate in the frame of the robot that saw it.

    None says that the dstate is at the pose of the robot. Raises TraceError, which names the step.
    """
    return (0.0, 0.0, 0.0) if value is None else three_numbers(value, f"{where}: seen")


def three_numbers(value: Any, where: str) -> Pose:
    """Read a pose from JSON. Raise TraceError if it is malformed."""
    what = "[x, y, heading] in metres and radians"
    x, y, heading = numbers(where, value, TraceError, 3, what, "mend it")
    return x, y, heading


@dataclass(frozen=True, slots=True)
class Relation:
    """The pose of the robot at a second time, in the frame of its pose at a first time.

    Attributes:
        first: The first time in seconds.
        second: The second time in seconds.
        displacement: Metres ahead, metres to the left, and the turn counterclockwise in radians.
    """

    first: float
    second: float
    displacement: Displacement


class Relations:
    """Relations as a graph whose nodes are times.

    An edge can be followed in both directions. The pose at a moment between two related times is
    interpolated. To find the pose at one moment relative to another, relations are composed along
    the shortest way in the graph. The longer this way is, the larger is the error of the result.

    Args:
        relations: One or more relations.

    Raises:
        TraceError: There are no relations.

    Attributes:
        times: The related times in seconds, sorted.
    """

    def __init__(self, relations: Iterable[Relation]) -> None:
        self._to: dict[tuple[int, int], Displacement] = {}
        relations = tuple(relations)
        if not relations:
            raise TraceError(
                "relations: expected one or more, got none; give a file of relative poses"
            )
        self.times = sorted(
            {time for relation in relations for time in (relation.first, relation.second)}
        )
        number = {time: i for i, time in enumerate(self.times)}
        for relation in relations:
            a, b = number[relation.first], number[relation.second]
            self._to[a, b] = relation.displacement
            self._to[b, a] = displacement_between(relation.displacement, (0.0, 0.0, 0.0))
        # The length of an edge is the distance of its relation in metres, plus EACH.
        ends = np.array(list(self._to)).T
        metres = [math.hypot(x, y) + EACH for x, y, _ in self._to.values()]
        self._graph = coo_array(
            (metres, (ends[0], ends[1])), shape=(len(self.times), len(self.times))
        ).tocsr()

    @staticmethod
    def load(path: str | os.PathLike[str]) -> Relations:
        """Read a file of relations. Raises OSError, or TraceError, which names the line."""
        source = os.fspath(path)
        lines, table = _rows(source, RELATION, "a text of relations")
        # In a trajectory, the last four numbers are a quaternion of length 1. In relations on a
        # floor, all but the last of them are 0, and each yaw may be about 1 radian. Then it is a
        # trajectory only if it is exactly 1 or -1.
        tails = table[:, 4:]
        is_unit = (np.abs(np.linalg.norm(tails, axis=1) - 1) <= ROUNDED).all()
        if is_unit and (tails[:, :3].any() or (np.abs(tails[:, 3]) == 1).all()):
            raise TraceError(
                f"{named(source)}: expected relations, {' '.join(RELATION)}, got a trajectory: "
                "each line ends in a quaternion; give it as the truth of the steps (--truth)"
            )
        found = []
        for line, (first, second, x, y, _, _, _, yaw) in zip(lines, table.tolist(), strict=True):
            if first == second:
                raise TraceError(
                    f"{named(source)}:{line}: time2: expected another time than time1, got "
                    f"{first:.10g} twice; mend the line"
                )
            found.append(Relation(first, second, (x, y, yaw)))
        return Relations(found)

    def covers(self, time: float | None) -> bool:
        """Tell whether a moment, in seconds, is between two related times or near one."""
        return self._near(time) is not None

    def between(
        self, times: Sequence[float | None], origin: int
    ) -> list[tuple[Pose, float] | None]:
        """Return the pose at each moment, in seconds, in the frame of the moment `origin`.

        Each pose comes with the length, in metres, of the way along which relations were composed.
        None if relations do not lead to a moment, or the moment is not near related times.
        """
        moments = [self._near(time) for time in times]
        start = moments[origin]
        if start is None:
            return [None] * len(times)
        # Find the shortest ways from the node nearest to the origin, and compose along each.
        node, offset = start
        metres, before = dijkstra(self._graph, indices=node, return_predecessors=True)
        poses: dict[int, Pose] = {node: displacement_between(offset, (0.0, 0.0, 0.0))}
        found: list[tuple[Pose, float] | None] = []
        for i, moment in enumerate(moments):
            if moment is None or not math.isfinite(metres[moment[0]]):
                found.append(None)
            elif i == origin:
                found.append(((0.0, 0.0, 0.0), 0.0))
            else:
                pose = moved(self._composed(moment[0], before, poses), moment[1])
                way = float(metres[moment[0]]) + math.hypot(*offset[:2])
                found.append((pose, way + math.hypot(*moment[1][:2])))
        return found

    def _composed(self, node: int, before: Sequence[int], poses: dict[int, Pose]) -> Pose:
        """Compose a node's pose along the shortest way. `before` is each node's predecessor."""
        way = []
        while node not in poses:
            way.append(node)
            node = int(before[node])
        for after in reversed(way):
            poses[after] = moved(poses[node], self._to[node, after])
            node = after
        return poses[node]

    def _near(self, time: float | None) -> tuple[int, Displacement] | None:
        """Find the node nearest to a moment, and the displacement from the node to the moment.

        The displacement is interpolated between the nodes before and after the moment. It is zero
        if their relation is unknown but the node is near in time. None if no node is near.
        """
        if time is None:
            return None
        node, *others = indices_around(self.times, time)
        other = others[0] if others else node
        if (whole := self._to.get((node, other))) is not None:
            share = (time - self.times[node]) / (self.times[other] - self.times[node])
            return node, _interpolated((0.0, 0.0, 0.0), whole, share)
        return (node, (0.0, 0.0, 0.0)) if abs(self.times[node] - time) <= NEAREST else None
