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

from perception.places.passages import STEP, directions, resampled
from ssh_abduction.building.edges import FloorPlan, Gap, PlanEdge, Spot
from ssh_abduction.building.free_space import GRID, RoomSpace
from ssh_abduction.building.rooms import BESIDE, LONG, SLIM
from ssh_abduction.building.straight_paths import PairedWay
from ssh_abduction.building.travels import Array

ONWARD = math.radians(45)  # An edge that leaves within this angle goes on straight.


@dataclass(frozen=True, eq=False)
class Box:
    """The rectangle around a room, along its longer axis."""

    middle: Array
    ahead: Array  # the unit vector along it
    length: float
    width: float

    @classmethod
    def of(cls, space: RoomSpace) -> Box:
        """Find the rectangle around the free cells of a room."""
        cells = space.corner + GRID * np.argwhere(space.free)
        frame = np.linalg.eigh(np.cov(cells.T))[1].T[::-1]
        least, most = (cells @ frame.T).min(axis=0), (cells @ frame.T).max(axis=0)
        length, width = most - least
        return cls((least + most) / 2 @ frame, frame[0], float(length), float(width))

    def along(self, point: Array) -> float:
        """How far a point is along the box, from its middle."""
        return float((point - self.middle) @ self.ahead)


def straightened(
    plan: FloorPlan,
    room: Mapping[int, int],
    spaces: Mapping[int, RoomSpace],
) -> FloorPlan:
    """Return the plan with one straight way through each room that is long and slim."""
    spots, edges, corners = dict(plan.spots), list(plan.edges), plan.corners
    for number, space in spaces.items():
        inner = [e for e in edges if not e.doors and {room.get(p) for p in e.ends} == {number}]
        box = Box.of(space) if inner and space.free.any() else None
        if box is None or box.length < max(LONG, SLIM * box.width):
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
        edges = [*others, *_chain(box, space, ends, at, inner)]
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
            same = directions(edge.course)[gap.at] @ box.ahead > 0
            side = gap.side if same else {"left": "right", "right": "left"}[gap.side]
            metres = box.along(edge.course[gap.at])
            if all(g.side != side or abs(m - metres) > BESIDE for m, g in seen):
                seen.append((metres, replace(gap, side=side)))
    travels = tuple(sorted({t for edge in inner for t in edge.travels}))
    for (p, begin), (q, end) in pairwise(zip(ends, at, strict=True)):
        line = box.middle + np.array([[begin], [end]]) * box.ahead
        course = resampled(line, STEP)
        passages = tuple(
            replace(gap, at=min(round((m - begin) / STEP), len(course) - 1))
            for m, gap in sorted(seen, key=lambda pair: pair[0])
            if begin < m <= end
        )
        yield PlanEdge((p, q), course, travels, space.beside(course), passages)
