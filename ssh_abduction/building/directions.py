"""Tell a route as a person does: distances, turns, doors, and counted openings.

Only openings that the map knows are counted, also those that the robot never drove through. What is
not known is not counted.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import networkx as nx
import numpy as np

from perception.places.passages import STEP, WIDE
from ssh_abduction.building.edges import FloorPlan, PlanEdge
from ssh_abduction.building.straight_paths import leaving
from ssh_abduction.building.travels import Array
from ssh_abduction.data.errors import MapError
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace

# A bend of less than AHEAD degrees goes straight on, and one of more than BACK turns around. A bend
# of less than HALF degrees is half a turn, and one of more than SHARP is sharp.
AHEAD, HALF, SHARP, BACK = 30, 60, 120, 150
# A course is straight while it stays within WOBBLE metres of a line. Two bends to one side that are
# less than CLOSE metres apart are one corner.
WOBBLE, CLOSE = 1.2, 2.0
BEFORE = 1.0  # metres before and behind a door within which a course does not bend
# Openings of one side that are nearer than this many metres are one opening.
ONE = 1.0
NTH = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth")
COUNT = ("no", "a", "two", "three", "four", "five", "six")


@dataclass(frozen=True)
class SideOpening:
    """An opening beside a leg."""

    metres: float  # from the beginning of the route
    side: str  # "left" or "right"
    is_door: bool


def directions_to(
    ssh_map: SSHMap, trace: Trace, start: Collection[int], goal: Collection[int]
) -> tuple[str, ...]:
    """Tell the shortest way from some places to others, in sentences without a full stop.

    Args:
        ssh_map: A map of the trace, with its building (`with_building`).
        trace: The trace that was mapped.
        start: The places where the route may begin.
        goal: The places where it may end.

    Raises:
        MapError: The map has no poses, or no edges lead there.
    """
    guide = Guide(ssh_map, trace)
    return tuple(guide.told(guide.ends_to(start, goal)))


class Guide:
    """Finds and tells ways through the plan of one map."""

    def __init__(self, ssh_map: SSHMap, trace: Trace) -> None:
        if not ssh_map.fit or not ssh_map.fit.poses or not ssh_map.places:
            raise MapError(
                "words: expected a map with places and poses, got one without; solve a trace with "
                "displacements, or leave out --words"
            )
        self._map, self.plan = ssh_map, FloorPlan.of(ssh_map, trace)

    def ends_to(self, start: Collection[int], goal: Collection[int]) -> list[int]:
        """Find the shortest way: the ends at which its edges begin; empty at the goal.

        An end is 2 x the number of an edge, plus 0 or 1. Raises MapError if no edges lead there.
        """
        begin, end = ({self.plan.name[p] for p in some} for some in (start, goal))
        graph: nx.MultiGraph[int] = nx.MultiGraph()
        for x, edge in enumerate(self.plan.edges):
            graph.add_edge(*edge.ends, key=x, metres=edge.length)
        found = begin & set(graph)
        reached, nodes = (
            nx.multi_source_dijkstra(graph, found, weight="metres") if found else ({}, {})
        )
        nearest = min(((reached[p], p) for p in end if p in reached), default=None)
        if nearest is None and not begin & end:
            raise MapError(
                "to: expected a goal to which travels of the robot lead, got one in another part "
                "of the map; drive on"
            )
        ends = []
        for p, q in pairwise(nodes[nearest[1]] if nearest else ()):
            options = [
                2 * x + k
                for x, edge in enumerate(self.plan.edges)
                for k in (0, 1)
                if (edge.ends[k], edge.ends[1 - k]) == (p, q)
            ]
            ends.append(min(options, key=lambda e: self.plan.edges[e // 2].length))
        return ends

    def told(self, ends: Sequence[int]) -> Iterator[str]:
        """Tell a way along edges, given by the ends at which they begin.

        A leg goes straight on. It ends where the course bends, not where the robot stopped.
        """
        if not ends:
            yield "there is nothing to do: the start is at the goal"
            return
        route = self.route(ends)
        beside = _merged(sorted(_beside(self.plan, ends, route), key=lambda b: b.metres))
        for k, (begin, end) in enumerate(pairwise(route.stops)):
            turn = route.turns[k] if k < len(route.turns) else None
            yield self._leg(route, begin, end, beside, turn)
            if turn is not None:
                onward = self._corridor(route, *route.stops[k + 1 : k + 3])
                yield turn + (f" into {onward}" if onward else "")

    def route(self, ends: Sequence[int]) -> RouteCourse:
        """Lay a way along edges, given by the ends at which they begin."""
        edges = ((self.plan.edges[e // 2], e % 2) for e in ends)
        return RouteCourse.of([edge.turned() if turned else edge for edge, turned in edges])

    def _leg(
        self,
        route: RouteCourse,
        begin: int,
        end: int,
        beside: Sequence[SideOpening],
        turn: str | None,
    ) -> str:
        """Say how far to go, past which doors and landmarks, and where to stop."""
        first, last = route.metres[begin], route.metres[end]
        where = self._corridor(route, begin, end)
        said = [f"go {max(1, round(last - first))} m {f'along {where}' if where else 'on'}"]
        if through := sum(begin < door <= end for door in route.doors):
            said.append("through the door" if through == 1 else f"through {through} doors")
        side = turn.split()[-1] if turn else None
        passed = [b for b in beside if first + ONE < b.metres < last - ONE]
        for one in ("left", "right"):
            doors = [b for b in passed if b.side == one and b.is_door]
            if doors and one != side:
                word = COUNT[len(doors)] if len(doors) < len(COUNT) else str(len(doors))
                said.append(f"past {word} door{'s' * (len(doors) > 1)} on your {one}")
        inside = [p for p, at in route.places if begin < at < end]
        names = [self._map.name_of("place", p) for p in inside if p >= 0]
        said += [f"past {name}" for name in names if name]
        if turn is None:
            goal = route.places[-1][0]
            room = self._map.building.room_of(goal) if self._map.building else None
            within = self._map.name_of("room", room)
            said.append(f"to {self._map.called('place', goal)}{f' in {within}' * bool(within)}")
        elif side in ("left", "right") and route.opens(begin, end, ("left", "right").index(side)):
            count = sum(b.side == side for b in passed)
            nth = NTH[count] if count < len(NTH) else f"{count + 1}th"
            said.append(f"to the {nth} opening on the {side}")
        return ", ".join(said)

    def _corridor(self, route: RouteCourse, begin: int, end: int) -> str | None:
        """Name the corridor that has both ends of an edge with its middle in a leg, if any."""
        for corridor in self._map.corridors:
            for (p, one), (q, other) in pairwise(route.places):
                if begin < (one + other) / 2 < end and {p, q} <= {*corridor.order}:
                    return self._map.name_of("corridor", corridor.id) or f"corridor {corridor.id}"
        return None


@dataclass(frozen=True)
class RouteCourse:
    """The course of a route, with the points at which it bends."""

    places: tuple[tuple[int, int], ...]  # each place or corner, with its point of the course
    doors: tuple[int, ...]  # the points at which it passes doors
    metres: Array  # (n,) how far each point is along it, without wobbles
    stops: tuple[int, ...]  # the first point, those at which it bends, and the last one
    turns: tuple[str, ...]  # what to do at each bend
    bearing: float  # of the first leg, in radians
    widths: Array  # (n, 2) metres to the walls on the left and right

    @classmethod
    def of(cls, edges: Sequence[PlanEdge]) -> RouteCourse:
        """Find the bends along edges. The course is straight within a metre of a door."""
        course = np.concatenate([edge.course for edge in edges])
        ends = [int(n) for n in np.cumsum([len(edge.course) for edge in edges])]
        begins = [0, *ends[:-1]]
        doors = [b + gap.at for b, edge in zip(begins, edges, strict=True) for gap in edge.doors]
        near = round(BEFORE / STEP)
        last, sides = len(course) - 1, {at + off for at in doors for off in (-near, near)}
        parts = pairwise([0, *sorted(at for at in sides if 0 < at < last), last])
        bends = [0, *(begin + k for begin, end in parts for k in _bends(course[begin : end + 1]))]
        legs = np.diff(course[bends], axis=0)
        metres = np.interp(np.arange(len(course)), bends, np.cumsum([0.0, *np.hypot(*legs.T)]))
        bearing = np.degrees(np.arctan2(legs[:, 1], legs[:, 0]))
        turn = (np.diff(bearing) + 180) % 360 - 180
        kept: list[tuple[int, float]] = []
        for at, degrees in zip(bends[1:-1], turn, strict=True):
            before = kept[-1] if kept else (0, 0.0)
            is_one = before[1] * degrees > 0 and abs(before[1] + degrees) <= SHARP
            is_one = is_one and not any(before[0] < door < at for door in doors)
            if is_one and metres[at] - metres[before[0]] < CLOSE:
                kept[-1] = before[0], before[1] + degrees  # two halves of one corner
            else:
                kept.append((at, degrees))
        kept = [(at, degrees) for at, degrees in kept if abs(degrees) >= AHEAD]
        places = (edges[0].ends[0], 0), *zip((e.ends[1] for e in edges), ends, strict=True)
        stops = 0, *(at for at, _ in kept), len(course) - 1
        turns = tuple(_turn(degrees) for _, degrees in kept)
        widths = np.concatenate([edge.widths for edge in edges])
        return cls(places, tuple(doors), metres, stops, turns, math.radians(bearing[0]), widths)

    def opens(self, begin: int, end: int, side: int) -> bool:
        """Whether there is an opening on a side where a leg ends, and not one wide hall."""
        leg = self.widths[begin : end + 1, side]
        there = self.widths[max(end - round(BEFORE / STEP), 0) : end + round(BEFORE / STEP), side]
        return not np.median(leg) >= WIDE or not there.max(initial=0.0) >= WIDE


def _bends(course: Array) -> Iterator[int]:
    """Yield the points after the first one at which a simplified course has corners."""
    from skimage.measure import approximate_polygon

    at = 0
    for corner in approximate_polygon(course, WOBBLE)[1:] if len(course) > 2 else course[1:]:
        at += 1 + int(np.hypot(*(course[at + 1 :] - corner).T).argmin())
        yield at


def _turn(degrees: float) -> str:
    """Say how to turn by some degrees to the left."""
    if abs(degrees) > BACK:
        return "turn around"
    how = "half " if abs(degrees) < HALF else "sharp " if abs(degrees) > SHARP else ""
    return f"turn {how}{'left' if degrees > 0 else 'right'}"


def _beside(plan: FloorPlan, ends: Sequence[int], route: RouteCourse) -> Iterator[SideOpening]:
    """Yield the openings beside a route."""
    own = {e // 2 for e in ends}
    for (_, begin), (place, end), e, onward in zip(
        route.places, route.places[1:], ends, [*ends[1:], None], strict=False
    ):
        edge = plan.edges[e // 2].turned() if e % 2 else plan.edges[e // 2]
        for gap in edge.passages:
            if gap.side != "through":
                yield SideOpening(float(route.metres[begin + gap.at]), gap.side, False)
        if onward is None:
            return
        back, ahead = (leaving(plan, at).bearing for at in (e ^ 1, onward))
        for x, other in enumerate(plan.edges):
            for k in (0, 1):
                if other.ends[k] == place and x not in own:
                    turn = (leaving(plan, 2 * x + k).bearing - ahead) % math.tau
                    side = "left" if turn < (back - ahead) % math.tau else "right"
                    yield SideOpening(float(route.metres[end]), side, bool(other.doors))


def _merged(beside: Sequence[SideOpening]) -> list[SideOpening]:
    """Count openings of one side that are close together once."""
    kept: list[SideOpening] = []
    for one in beside:
        if all(k.side != one.side or one.metres - k.metres > ONE for k in kept):
            kept.append(one)
    return kept
