"""Tell a route as a person does: distances, turns, doors, and counted openings.

Only openings that the map knows are counted, also those that the robot never drove through. What is
not known is not counted.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise

import networkx as nx

from perception.places.passages import STEP
from perception.places.track import wrapped
from ssh_abduction.building.edges import FloorPlan, PlanEdge
from ssh_abduction.building.straight_paths import leaving, ways_of
from ssh_abduction.data.errors import MapError
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace

# A bend of less than AHEAD degrees goes straight on, and one of more than BACK turns around.
AHEAD, BACK = 30, 150
# Openings of one side that are nearer than this many metres are one opening.
ONE = 1.0
NTH = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth")
COUNT = ("no", "a", "two", "three", "four", "five", "six")


@dataclass(frozen=True)
class SideOpening:
    """An opening beside a leg."""

    metres: float  # from the beginning of the leg
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
        ways = ways_of(self.plan)
        self._way_of = {e // 2: n for n, way in enumerate(ways) for e in way.ends}

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
        """Tell a way along edges, given by the ends at which they begin."""
        if not ends:
            yield "there is nothing to do: the start is at the goal"
        legs = [list(run) for _, run in groupby(ends, key=lambda e: self._way_of[e // 2])]
        for k, leg in enumerate(legs):
            turn = _turn(self.plan, leg[-1], legs[k + 1][0]) if k + 1 < len(legs) else None
            yield _leg(self._map, self.plan, leg, turn)
            if turn is None:
                continue
            into = _corridor(self._map, [self.plan.edges[e // 2] for e in legs[k + 1]])
            yield turn + (f" into {into}" if into and turn.startswith("turn") else "")


def _turn(plan: FloorPlan, last: int, onward: int) -> str:
    """Say how to turn from one end of the route to the next one."""
    bend = leaving(plan, onward).bearing - leaving(plan, last ^ 1).bearing - math.pi
    degrees = math.degrees(wrapped(bend))
    if abs(degrees) < AHEAD:
        return "go straight on"
    if abs(degrees) > BACK:
        return "turn around"
    return "turn left" if degrees > 0 else "turn right"


def _leg(ssh_map: SSHMap, plan: FloorPlan, leg: Sequence[int], turn: str | None) -> str:
    """Say how far to go, past which doors and landmarks, and where to stop."""
    edges = [plan.edges[e // 2].turned() if e % 2 else plan.edges[e // 2] for e in leg]
    metres = sum(edge.length for edge in edges)
    said = [f"go {max(1, round(metres))} m on"]
    if where := _corridor(ssh_map, edges):
        said[0] = f"go {max(1, round(metres))} m along {where}"
    if through := {gap.door if gap.door is not None else gap for e in edges for gap in e.doors}:
        said.append("through the door" if len(through) == 1 else f"through {len(through)} doors")
    beside = _merged(sorted(_beside(plan, leg), key=lambda b: b.metres))
    side = turn.removeprefix("turn ") if turn else None
    for one in ("left", "right"):
        doors = [b for b in beside if b.side == one and b.is_door]
        if doors and one != side:
            word = COUNT[len(doors)] if len(doors) < len(COUNT) else str(len(doors))
            said.append(f"past {word} door{'s' * (len(doors) > 1)} on your {one}")
    names = [ssh_map.name_of("place", e.ends[1]) for e in edges[:-1] if e.ends[1] >= 0]
    said += [f"past {name}" for name in names if name]
    last = edges[-1].ends[1]
    if turn is None:
        room = ssh_map.building.room_of(last) if ssh_map.building else None
        within = ssh_map.name_of("room", room) if room is not None else None
        said.append(f"to {ssh_map.called('place', last)}" + (f" in {within}" if within else ""))
    elif side in ("left", "right"):
        passed = [b for b in beside if b.side == side]
        nth = NTH[len(passed)] if len(passed) < len(NTH) else f"{len(passed) + 1}th"
        said.append(f"to the {nth} opening on the {side}")
    elif last >= 0 and (name := ssh_map.name_of("place", last)):
        said.append(f"to {name}")
    return ", ".join(said)


def _beside(plan: FloorPlan, leg: Sequence[int]) -> Iterator[SideOpening]:
    """Yield the openings beside a leg, without those at its beginning and at its end."""
    far, own = 0.0, {e // 2 for e in leg}
    for e, onward in pairwise([*leg, -1]):
        edge = plan.edges[e // 2].turned() if e % 2 else plan.edges[e // 2]
        for gap in edge.passages:
            if gap.side != "through":
                yield SideOpening(far + gap.at * STEP, gap.side, False)
        far += edge.length
        if onward < 0:
            return
        back, ahead = (leaving(plan, end).bearing for end in (e ^ 1, onward))
        for x, other in enumerate(plan.edges):
            for k in (0, 1):
                if other.ends[k] == edge.ends[1] and x not in own:
                    turn = (leaving(plan, 2 * x + k).bearing - ahead) % math.tau
                    side = "left" if turn < (back - ahead) % math.tau else "right"
                    yield SideOpening(far, side, bool(other.doors))


def _merged(beside: Sequence[SideOpening]) -> list[SideOpening]:
    """Count openings of one side that are close together once."""
    kept: list[SideOpening] = []
    for one in beside:
        if all(k.side != one.side or one.metres - k.metres > ONE for k in kept):
            kept.append(one)
    return kept


def _corridor(ssh_map: SSHMap, edges: Sequence[PlanEdge]) -> str | None:
    """Name the corridor that has both ends of some edge of a leg; None if none has."""
    for corridor in ssh_map.corridors:
        if any(set(edge.ends) <= {*corridor.order} for edge in edges):
            return ssh_map.name_of("corridor", corridor.id) or f"corridor {corridor.id}"
    return None
