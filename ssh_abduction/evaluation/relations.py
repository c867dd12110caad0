"""Hand-checked relative poses between the scans of a log.

A relation is the pose of the robot at a second time, in the frame of its pose at a first time.
Relations are an independent truth about whether the robot was at one place at two times. A file of
relations (Kümmerle et al. 2009, "On measuring the accuracy of SLAM algorithms") has a line for each
relation: time1 time2 x y z roll pitch yaw, in seconds, metres and radians.

>>> from ssh_abduction.evaluation.relations import Relation, Relations
>>> quarter = 1.5707963
>>> around = Relations([Relation(t, t + 1.0, (4.0, 0.0, quarter)) for t in range(3)])
>>> seen = around.between([0.0, 1.5, 3.0], 0)
>>> [(round(dx, 1), round(dy, 1), round(way)) for (dx, dy, _), way in seen]
[(0.0, 0.0, 0), (4.0, 2.0, 6), (0.0, 4.0, 12)]

The relations are the edges of a graph whose nodes are times. An edge can be followed in both
directions. The pose at a moment between two related times is interpolated. To find the pose at one
moment relative to another, relations are composed along the shortest way in the graph. The longer
this way is, the larger is the error of the result.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from ssh_abduction.data.errors import TraceError, brief, named
from ssh_abduction.data.odometry import Displacement, Pose, displacement_between, moved
from ssh_abduction.evaluation.trajectory import indices_around, is_trajectory, text_of

FIELDS = ("time1", "time2", "x", "y", "z", "roll", "pitch", "yaw")
# A moment that is not between two related times may be this many seconds from the nearest time.
# Robots that map buildings drive at most one metre per second.
NEAREST = 0.5
# The length of a relation is its distance plus this many metres, as short relations have errors,
# too. So ways along fewer relations are preferred.
EACH = 0.05


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
        text = text_of(path, "a text of relations", "give one of numbers")
        lines = [
            (number, fields)
            for number, line in enumerate(text.splitlines(), 1)
            if (fields := line.partition("#")[0].split())
        ]
        if is_trajectory(fields for _, fields in lines):
            raise TraceError(
                f"{named(path)}: expected relations, {' '.join(FIELDS)}, got a trajectory: "
                "each line ends in a quaternion; give it as the truth of the steps (--truth)"
            )
        found = [_relation(fields, f"{named(path)}:{number}") for number, fields in lines]
        if not found:
            raise TraceError(
                f"{named(path)}: expected lines of {' '.join(FIELDS)}, got none; "
                "give a file of relations"
            )
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
            dx, dy, turned = whole
            return node, (share * dx, share * dy, share * math.remainder(turned, math.tau))
        return (node, (0.0, 0.0, 0.0)) if abs(self.times[node] - time) <= NEAREST else None


def _relation(fields: Sequence[str], where: str) -> Relation:
    """Read a relation from the fields of its line. Raise TraceError if it is malformed."""
    try:
        first, second, x, y, _, _, _, yaw = (float(field) for field in fields)
    except ValueError:
        raise TraceError(
            f"{where}: expected the numbers {' '.join(FIELDS)}, got {brief(' '.join(fields))}; "
            "mend the line"
        ) from None
    if not all(math.isfinite(value) for value in (first, second, x, y, yaw)):
        raise TraceError(
            f"{where}: expected finite numbers, got {brief(' '.join(fields))}; mend the line"
        )
    if first == second:
        raise TraceError(
            f"{where}: time2: expected another time than time1, got {fields[1]} twice; "
            "mend the line"
        )
    return Relation(first, second, (x, y, yaw))
