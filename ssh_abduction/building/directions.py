"""Tell a route as a person does: distances, turns, doors, and counted openings.

Only openings that the map knows are counted, also those that the robot never drove through. What is
not known is not counted.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise

import networkx as nx
import numpy as np

from perception.places.passages import STEP, WIDE, resampled
from ssh_abduction.building.edges import Array, FloorPlan, PlanEdge
from ssh_abduction.building.rooms import LONG, FreeView
from ssh_abduction.building.straight_paths import edges_beside, leaving
from ssh_abduction.data.building import Corridor
from ssh_abduction.data.errors import MapError
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.output.roads import place_of_steps

# A bend of less than AHEAD degrees goes straight on, and one of more than BACK turns around. A bend
# of less than HALF degrees is half a turn, and one of more than SHARP is sharp. A person who comes
# to a door within ASLANT degrees sees it ahead.
AHEAD, ASLANT, HALF, SHARP, BACK = 30, 45, 60, 120, 150
# Slight bends are told only if they lead more than ASIDE metres to the side.
ASIDE = 4.0
# Two bends to one side that are less than CLOSE metres apart are one corner.
CLOSE = 2.0
STRIDE = 2  # points of a course from one possible bend to the next
EACH = 1e6  # metres: what a leg costs, so that ways of fewer legs are shorter
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
        at = [None if p is None else self.plan.name[p] for p in place_of_steps(ssh_map)]
        self._lifts = [
            (at[t], at[t + 1], action.name)
            for t, action in enumerate(trace.actions)
            if action.changes_floor
        ]

    def ends_to(self, start: Collection[int], goal: Collection[int]) -> list[int]:
        """Find the shortest way: the ends at which its edges begin; empty at the goal.

        An end is 2 x the number of an edge, plus 0 or 1; a lift or stairs is -1 minus its number.
        Raises MapError if neither edges nor lifts lead there.
        """
        begin, end = ({self.plan.name[p] for p in some} for some in (start, goal))
        graph: nx.MultiDiGraph[int] = nx.MultiDiGraph()
        for edge in self.plan.edges:
            for ends in (edge.ends, edge.ends[::-1]):
                graph.add_edge(*ends, metres=edge.length)
        for p, q, _ in self._lifts:
            graph.add_edge(p, q, metres=0.0)
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
        way: list[int] = []
        for p, q in pairwise(nodes[nearest[1]] if nearest else ()):
            options = [
                2 * x + k
                for x, edge in enumerate(self.plan.edges)
                for k in (0, 1)
                if (edge.ends[k], edge.ends[1 - k]) == (p, q)
            ]
            lift = next((-1 - k for k, lift in enumerate(self._lifts) if lift[:2] == (p, q)), -1)
            way.append(min(options, key=lambda e: self.plan.edges[e // 2].length, default=lift))
        return way

    def told(self, ends: Sequence[int]) -> Iterator[str]:
        """Tell a way along edges, given by the ends at which they begin.

        A leg goes straight on. It ends where the course bends, not where the robot stopped.
        """
        if not ends:
            yield "there is nothing to do: the start is at the goal"
        for on_floor, some in groupby(ends, key=lambda e: e >= 0):
            if on_floor:
                yield from self._told([*some])
            else:
                yield from (f"take {self._lifts[-1 - e][2]!r}" for e in some)

    def _told(self, ends: Sequence[int]) -> Iterator[str]:
        """Tell a way along edges of one floor."""
        route = self.route(ends)
        beside = _merged(sorted(_beside(self.plan, ends, route), key=lambda b: b.metres))
        for k, (begin, end) in enumerate(pairwise(route.stops)):
            turn = route.turns[k] if k < len(route.turns) else None
            yield self._leg(route, begin, end, beside, turn)
            if turn is not None:
                onward = route.corridor_of(*route.stops[k + 1 : k + 3])
                yield turn + ("" if onward is None else f" into {self._named(onward)}")

    def route(self, ends: Sequence[int]) -> RouteCourse:
        """Lay a way along edges, given by the ends at which they begin."""
        edges = ((self.plan.edges[e // 2], e % 2) for e in ends)
        ways = [edge.turned() if turned else edge for edge, turned in edges]
        return RouteCourse.of(ways, self._map.corridors)

    def _leg(
        self,
        route: RouteCourse,
        begin: int,
        end: int,
        beside: Sequence[SideOpening],
        turn: str | None,
    ) -> str:
        """Say how far to go, past which doors and landmarks, and where to stop."""
        first, last = route.metres[begin], route.end_of(end)
        corridor = route.corridor_of(begin, end)
        where = "on" if corridor is None else f"along {self._named(corridor)}"
        anchor, count, said = first, 0, list[str]()
        for at in (*(route.metres[door] for door in route.doors if begin < door <= end), None):
            if count and (at is None or at - anchor > CLOSE):
                said.append("through the door" if count == 1 else f"through {count} doors")
                count = 0
            if not said or (not count and (last if at is None else at) - anchor > CLOSE):
                far = max(1, round((last if at is None else at) - anchor))
                said.append(f"{far} m on" if said else f"go {far} m {where}")
            anchor, count = (anchor if at is None else at), count + (at is not None)
        side = turn.split()[-1] if turn else None
        passed = [b for b in beside if first + ONE < b.metres < last - ONE]
        seen = list[tuple[float, str]]()  # what the person passes, with its metres
        for one in ("left", "right"):
            doors = [b for b in passed if b.side == one and b.is_door]
            if doors and one != side:
                word = COUNT[len(doors)] if len(doors) < len(COUNT) else str(len(doors))
                text = f"past {word} door{'s' * (len(doors) > 1)} on your {one}"
                seen.append((doors[0].metres, text))
        # A place at a corner belongs to the leg that ends there.
        after, corner = first + CLOSE * (begin > 0), last - CLOSE * bool(turn)
        inside = [(float(route.metres[at]), p) for p, at in route.places[:-1] if p >= 0]
        named = [(at, name) for at, p in inside if (name := self._map.name_of("place", p))]
        seen += [(at, f"past {name}") for at, name in named if after < at < corner]
        turning = [name for at, name in named if turn and abs(at - last) <= CLOSE and at > after]
        said += [text for _, text in sorted(seen)]
        if turn is None:
            goal = route.places[-1][0]
            room = self._map.building.room_of(goal) if self._map.building else None
            within = self._map.name_of("room", room)
            said.append(f"to {self._map.called('place', goal)}{f' in {within}' * bool(within)}")
        elif anchor > first and last - anchor <= CLOSE:
            pass  # The person turns behind the door.
        elif side in ("left", "right") and route.opens(begin, end, ("left", "right").index(side)):
            count = sum(b.side == side and b.metres > anchor + ONE for b in passed)
            nth = f"{NTH[count]} " if count < len(NTH) else f"{count + 1}th "
            if any(b.side == side and abs(b.metres - anchor - ONE) < ONE for b in beside):
                nth = ""  # Does the one at the beginning count?
            said.append(f"to the {nth}opening on the {side}")
        said += [f"at {name}" for name in turning[:1]]
        return ", ".join(said)

    def _named(self, corridor: Corridor) -> str:
        return self._map.name_of("corridor", corridor.id) or f"corridor {corridor.id}"


@dataclass(frozen=True)
class RouteCourse:
    """The course of a route, with the points at which it bends."""

    places: tuple[tuple[int, int], ...]  # each place or corner, with its point of the course
    doors: tuple[int, ...]  # the points at which it passes doors
    metres: Array  # (n,) how far each point is along it, without wobbles
    stops: tuple[int, ...]  # the first point, those at which it bends, and the last one
    turns: tuple[str, ...]  # what to do at each bend
    bearing: float  # of the first leg, in radians
    course: Array  # (n, 2) metres
    widths: Array  # (n, 2) metres to the walls on the left and right
    corridors: Sequence[Corridor] = ()

    @classmethod
    def of(cls, edges: Sequence[PlanEdge], corridors: Sequence[Corridor] = ()) -> RouteCourse:
        """Find the bends along edges.

        The way is straight within a metre of a door, and parallel to the corridor that it is in.
        """
        course = np.concatenate([edge.course for edge in edges])
        ends = [int(n) for n in np.cumsum([len(edge.course) for edge in edges])]
        begins = [0, *ends[:-1]]
        doors = [b + gap.at for b, edge in zip(begins, edges, strict=True) for gap in edge.doors]
        places = (edges[0].ends[0], 0), *zip((e.ends[1] for e in edges), ends, strict=True)
        near = round(BEFORE / STEP)
        last, sides = len(course) - 1, {at + off for at in doors for off in (-near, near)}
        sight, bends = FreeView(edges), [0]
        for begin, end in pairwise([0, *sorted(at for at in sides if 0 < at < last), last]):
            bends += (begin + k for k in _bends(course[begin : end + 1], sight))
        widths = np.concatenate([edge.widths for edge in edges])
        metres = np.zeros(len(course))
        found = cls(places, tuple(doors), metres, (), (), 0.0, course, widths, corridors)
        legs = [found._straight(begin, end) for begin, end in pairwise(bends)]
        for (begin, end), leg in zip(pairwise(bends), legs, strict=True):
            length = float(np.hypot(*leg))
            part = (course[begin : end + 1] - course[begin]) @ leg / max(length, STEP)
            metres[begin : end + 1] = metres[begin] + np.clip(part, 0.0, length)
            metres[end] = metres[begin] + length
        kept = found._bends(bends, near)
        return replace(
            found,
            stops=(0, *kept, last),
            turns=tuple(map(_turn, kept.values())),
            bearing=math.radians(found._bearing(0, next(iter(kept), last))),
        )

    def _bends(self, bends: Sequence[int], near: int) -> dict[int, float]:
        """Leave out the bends that need no words, the least first. Returns those that stay.

        A person comes out of a door straight, and looks from a bend to the next one. Two bends to
        one side that are close together are one.
        """
        out, to = ({door + off for door in self.doors} for off in (near, -near))
        kept = list(bends)
        while True:
            turn, spare = dict[int, float](), dict[int, float]()
            for before, at, after in zip(kept, kept[1:], kept[2:], strict=False):
                door = at - near  # The way is across it.
                came = (max(0, door - 2), door + 2) if at in out else (before, at)
                bend = self._bearing(at, after) - self._bearing(*came)
                bend = (bend + 180) % 360 - 180
                if at in out and AHEAD < abs(bend) < BACK and self.corridor_of(at, after):
                    bend = math.copysign(90, bend)  # The door is in the wall of the corridor.
                turn[at] = bend
                limit = ASLANT if at in to else AHEAD
                aside = math.sin(math.radians(turn[at])) * (self.metres[after] - self.metres[at])
                if abs(turn[at]) < limit and abs(aside) < ASIDE:
                    spare[at] = abs(turn[at]) / limit
            if not spare:
                break
            kept.remove(min(spare, key=lambda at: spare[at]))
        for one, other in pairwise(list(turn)):
            both = turn[one] + turn[other] if one in turn else math.inf
            is_one = turn.get(one, 0.0) * turn[other] > 0 and abs(both) <= SHARP
            is_one = is_one and not any(one < door < other for door in self.doors)
            if is_one and self.metres[other] - self.metres[one] < CLOSE:
                turn[one] = both
                del turn[other]
        return turn

    def _bearing(self, begin: int, end: int) -> float:
        """The bearing from one point to another, in degrees."""
        return math.degrees(math.atan2(*self._straight(begin, end)[::-1]))

    def beside(self, at: int, point: Array) -> float:
        """How far along the route a point is, beside the leg that has the course's point `at`."""
        begin, end = next(leg for leg in pairwise(self.stops) if at <= leg[1])
        ahead = self._straight(begin, end)
        off = (point - self.course[begin]) @ ahead / max(float(np.hypot(*ahead)), STEP)
        return float(self.metres[begin] + max(0.0, off))

    def end_of(self, end: int) -> float:
        """How far along the route a leg ends: at its last point, or beside the door there."""
        door = next((at for at in self.doors if end < at <= end + 2 * round(BEFORE / STEP)), end)
        return max(float(self.metres[end]), self.beside(end, self.course[door]))

    def corridor_of(self, begin: int, end: int) -> Corridor | None:
        """Find the corridor that a leg leads along and not across, if any.

        More than half of the leg is on edges with both ends in the corridor. A leg leads across if
        it is less than AHEAD degrees from straight across.
        """
        leg, least = self.course[end] - self.course[begin], math.sin(math.radians(AHEAD))
        for corridor in self.corridors:
            inside = sum(
                max(0, min(other, end) - max(one, begin))
                for (p, one), (q, other) in pairwise(self.places)
                if {p, q} <= {*corridor.order}
            )
            if inside > (end - begin) / 2:
                ahead = self._ahead(corridor, begin, end)
                if abs(leg @ ahead) >= least * np.hypot(*leg) * np.hypot(*ahead):
                    return corridor
        return None

    def _straight(self, begin: int, end: int) -> Array:
        """The way from one point to another, (2,) metres: as far as it leads along its corridor."""
        leg: Array = self.course[end] - self.course[begin]
        corridor = self.corridor_of(begin, end)
        if corridor is None:
            return leg
        ahead = self._ahead(corridor, begin, end)
        return np.asarray(ahead * (leg @ ahead) / (ahead @ ahead))

    def _ahead(self, corridor: Corridor, begin: int, end: int) -> Array:
        """The direction of a corridor beside a leg, (2,) metres of any length."""
        line = resampled(np.array(corridor.line), STEP)
        some = sorted(int(np.hypot(*(line - p).T).argmin()) for p in self.course[[begin, end]])
        more = round(LONG / 2 / STEP)
        ahead: Array = line[min(some[1] + more, len(line) - 1)] - line[max(some[0] - more, 0)]
        return ahead

    def opens(self, begin: int, end: int, side: int) -> bool:
        """Whether there is an opening on a side where a leg ends, and not one wide hall."""
        leg = self.widths[begin : end + 1, side]
        there = self.widths[max(end - round(BEFORE / STEP), 0) : end + round(BEFORE / STEP), side]
        return not np.median(leg) >= WIDE or not there.max(initial=0.0) >= WIDE


def _bends(course: Array, sight: FreeView) -> Iterator[int]:
    """Yield the points after the first one at which the way has corners, and the last one.

    It has the fewest straight legs that are free, and of those ways it is the shortest.
    """
    chosen = np.unique([*range(0, len(course), STRIDE), len(course) - 1])
    points = course[chosen]
    legs: nx.DiGraph[int] = nx.DiGraph()
    for k, point in enumerate(points[:-1]):
        seen = sight.from_point(point, points[k + 1 :])
        seen[0] = True  # The robot drove there.
        for j in k + 1 + np.flatnonzero(seen):
            legs.add_edge(k, int(j), cost=EACH + math.dist(point, points[j]))
    if legs:
        way = nx.dijkstra_path(legs, 0, len(points) - 1, weight="cost")
        yield from (int(chosen[k]) for k in way[1:])


def _turn(degrees: float) -> str:
    """Say how to turn by some degrees to the left."""
    if abs(degrees) > BACK:
        return "turn around"
    slight = "slightly " if abs(degrees) < AHEAD else "half "
    how = slight if abs(degrees) < HALF else "sharp " if abs(degrees) > SHARP else ""
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
        for side, out in edges_beside(plan, place, own, ahead, back):
            door = out.course[out.doors[0].at] if out.doors else out.course[0]
            metres = route.beside(min(end, len(route.course) - 1), door)
            yield SideOpening(metres, side, bool(out.doors))


def _merged(beside: Sequence[SideOpening]) -> list[SideOpening]:
    """Count openings of one side that are close together once."""
    kept: list[SideOpening] = []
    for one in beside:
        if all(k.side != one.side or one.metres - k.metres > ONE for k in kept):
            kept.append(one)
    return kept
