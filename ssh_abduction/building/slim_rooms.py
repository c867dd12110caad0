"""Lay one straight way through each room that is long and slim.

In a wide corridor a robot drives from door to door, or in lanes. So its ways there bend at each
place, and go on straight nowhere. The walls on both sides say how the corridor lies.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from perception.places.passages import STEP, resampled
from ssh_abduction.building.edges import FloorPlan, Gap, PlanEdge, Spot
from ssh_abduction.building.free_space import RoomSpace
from ssh_abduction.building.rooms import BESIDE, LONG, SLIM
from ssh_abduction.building.straight_paths import PairedWay
from ssh_abduction.building.travels import Array
from ssh_abduction.data.building import Point

ONWARD = math.radians(45)  # An edge that leaves within this angle goes on straight.


@dataclass(frozen=True, eq=False)
class Box:
    """The least rectangle around a room."""

    middle: Array
    ahead: Array  # the unit vector along its longer side
    length: float
    width: float

    @classmethod
    def of(cls, outline: Sequence[Point]) -> Box:
        """Find the rectangle of least area around a polygon."""
        from scipy.spatial import ConvexHull

        points = np.array(outline)
        hull = points[ConvexHull(points).vertices]
        boxes = []
        for x, y in np.roll(hull, -1, axis=0) - hull:
            ahead = np.array([x, y]) / math.hypot(x, y)
            frame = np.stack([ahead, [-ahead[1], ahead[0]]])
            least, most = (hull @ frame.T).min(axis=0), (hull @ frame.T).max(axis=0)
            k = int((most - least).argmax())
            sizes = sorted(most - least, reverse=True)
            boxes.append(
                cls((least + most) / 2 @ frame, frame[k], float(sizes[0]), float(sizes[1]))
            )
        return min(boxes, key=lambda box: box.length * box.width)

    def along(self, point: Array) -> float:
        """How far a point is along the box, from its middle."""
        return float((point - self.middle) @ self.ahead)

    def left_of(self, off: Array) -> bool:
        """Whether a vector points to the left of the box."""
        return bool(self.ahead[0] * off[1] - self.ahead[1] * off[0] > 0)


def straightened(
    plan: FloorPlan,
    room: Mapping[int, int],
    spaces: Mapping[int, RoomSpace],
    outlines: Mapping[int, Sequence[Point]],
) -> FloorPlan:
    """Return the plan with one straight way through each room that is long and slim."""
    spots, edges, corners = dict(plan.spots), list(plan.edges), plan.corners
    for number, outline in outlines.items():
        inner = [e for e in edges if not e.doors and {room.get(p) for p in e.ends} == {number}]
        box = Box.of(outline)
        if not inner or box.length < max(LONG, SLIM * box.width):
            continue
        others = [edge for edge in edges if all(edge is not e for e in inner)]
        far = sorted((box.along(spots[p].at), p) for p in spots if room.get(p) == number)
        frame = spots[far[0][1]].frame
        for end, sign in ((far[0], -1), (far[-1], 1)):
            more = box.length / 2 - sign * end[0]
            if more > LONG / 4 and not _onward(others, end[1], sign * box.ahead):
                corners += 1
                far.append((end[0] + sign * more, -corners))
                spots[-corners] = Spot(box.middle, STEP, frame)
        far.sort()
        at: list[float] = []
        for metres, _ in far:  # Places beside each other are two places, too.
            at.append(max(metres, at[-1] + 2 * STEP) if at else metres)
        for metres, (_, p) in zip(at, far, strict=True):
            spots[p] = replace(spots[p], at=box.middle + metres * box.ahead)
        ends = [p for _, p in far]
        edges = [*others, *_chain(box, spaces[number], ends, at, inner)]
    edges.sort(key=lambda e: (min(e.travels), e.ends))
    return FloorPlan(spots, edges, plan.name, plan.measured, corners)


def widened(
    ways: Sequence[PairedWay], room: Mapping[int, int], spaces: Mapping[int, RoomSpace]
) -> list[PairedWay]:
    """Return the ways, each as wide in a room as the free space of all ways there."""

    def wide(edge: PlanEdge) -> PlanEdge:
        p, q = edge.ends
        if room.get(p) != room.get(q) or edge.doors or room.get(p) not in spaces:
            return edge
        beside = spaces[room[p]].beside(edge.course)
        return replace(edge, widths=np.maximum(edge.widths, beside))

    return [replace(way, edges=tuple(map(wide, way.edges))) for way in ways]


def _onward(edges: Sequence[PlanEdge], place: int, ahead: Array) -> bool:
    """Whether one of the edges leaves a place in a direction."""
    for edge in edges:
        if place in edge.ends:
            way = edge.course if edge.ends[0] == place else edge.course[::-1]
            off = way[min(round(LONG / 4 / STEP), len(way) - 1)] - way[0]
            if off @ ahead > math.cos(ONWARD) * math.hypot(*off):
                return True
    return False


def _chain(
    box: Box,
    space: RoomSpace,
    ends: Sequence[int],
    at: Sequence[float],
    inner: Sequence[PlanEdge],
) -> Iterator[PlanEdge]:
    """Yield the edges of a straight way along a box, with the widths and openings of its room."""
    seen: list[tuple[float, Gap]] = []
    for edge in inner:
        for gap in (p for p in edge.passages if p.side != "through"):
            k = max(1, min(gap.at, len(edge.course) - 2))
            same = (edge.course[k + 1] - edge.course[k - 1]) @ box.ahead > 0
            side = gap.side if same else {"left": "right", "right": "left"}[gap.side]
            metres = box.along(edge.course[gap.at])
            if all(g.side != side or abs(m - metres) > BESIDE for m, g in seen):
                seen.append((metres, replace(gap, side=side)))
    travels = tuple(sorted({t for edge in inner for t in edge.travels}))
    for (p, begin), (q, end) in pairwise(zip(ends, at, strict=True)):
        line = box.middle + np.array([[begin], [end]]) * box.ahead
        course = resampled(line, STEP)
        gaps = (replace(g, at=round((m - begin) / STEP)) for m, g in seen if begin < m <= end)
        passages = tuple(sorted(gaps, key=lambda g: g.at))
        passages = tuple(replace(g, at=min(g.at, len(course) - 1)) for g in passages)
        yield PlanEdge((p, q), course, travels, space.beside(course), passages)
