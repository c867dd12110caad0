"""What navigation programs want of a map: stops with positions, and directed roads between them."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

from ssh_abduction.data.errors import MapError
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace, View
from ssh_abduction.output.layout import layout, travelled
from ssh_abduction.output.turns import Turns

# What an edge costs at least, in metres. A turn on the spot costs as much as half a metre: a robot that drives 0.5 m/s turns by 90° in a second or two.
LEAST, TURN = 0.01, 0.5


@dataclass(frozen=True, slots=True)
class Stop:
    """Where a robot can be sent.

    id        the number of the place or of the dstate
    x, y      metres, or units of the layout
    heading   radians counterclockwise from x; of a place that of its first dstate, 0 where none is known
    views     what is seen there, in the order of the dstates
    """

    id: int
    x: float
    y: float
    heading: float
    views: tuple[View, ...]


@dataclass(frozen=True, slots=True)
class Road:
    """A directed edge between two stops.

    length     in a straight line, in metres or units of the layout; of a turn on the spot 0
    action     what the robot did there; None where it only drove the other way
    path, direction  along which path, and which way; None where it is along none
    turns      whether it is a turn on the spot: it stays at a place, or where places are unknown at a point
    """

    start: int
    end: int
    length: float
    action: str | None
    path: int | None
    direction: int | None
    turns: bool = False

    @property
    def cost(self) -> float:
        """What a planner is to take for the length: above 0, as Nav2's planner refuses edges that cost nothing, and more for a turn on the spot."""
        return self.length + TURN if self.turns else max(self.length, LEAST)


@dataclass(frozen=True, slots=True)
class Roads:
    """A map as stops and directed roads.

    level   what stops are: places or dstates
    metric  whether positions are metres, of displacements; elsewhere they are of a layout
    """

    level: str
    metric: bool
    stops: tuple[Stop, ...]
    roads: tuple[Road, ...]

    @classmethod
    def of(cls, ssh_map: SSHMap, level: str, turns: Trace | Turns | None = None) -> Roads:
        """The stops and roads of a map. Raises MapError where there are none.

        level  places: a place a stop, and a road each way along each street that was travelled, as a path leads both ways; dstates: a link a road
        """
        drawn = layout(ssh_map, turns)
        if level == "places":
            if not ssh_map.places:
                raise MapError(
                    "level: expected dstates, got places: the map has no places; export its dstates"
                )
            members = {p: [s for s in ssh_map.dstates if s.place == p] for p in ssh_map.places}
            stops = tuple(
                Stop(
                    p,
                    *drawn.places[p],
                    next((h for s in ds if (h := drawn.dstates[s.id][2]) is not None), 0.0),
                    tuple(s.view for s in ds if s.view is not None),
                )
                for p, ds in members.items()
            )
            ends = _streets(ssh_map)
        else:
            stops = tuple(
                Stop(s.id, x, y, heading or 0.0, () if s.view is None else (s.view,))
                for s, (x, y, heading) in zip(ssh_map.dstates, drawn.dstates, strict=True)
            )
            ends = {
                (s, x): (
                    action,
                    here.path if here.path == there.path else None,
                    here.direction if here.path == there.path else None,
                )
                for s, action, x in sorted(ssh_map.links, reverse=True)
                if s != x
                for here, there in [(ssh_map.dstates[s], ssh_map.dstates[x])]
            }
        at = {stop.id: (stop.x, stop.y) for stop in stops}
        place = {s.id: s.place for s in ssh_map.dstates} if level == "dstates" else {}
        roads = tuple(
            Road(
                a,
                b,
                length := math.dist(at[a], at[b]),
                *what,
                turns=_is_turn(place.get(a), place.get(b), length),
            )
            for (a, b), what in sorted(ends.items())
        )
        if not roads:
            raise MapError(
                f"map: expected roads between its {level}, got none; log a trace that moves on"
            )
        return cls(level, drawn.metric, stops, roads)

    @property
    def together(self) -> int:
        """How many stops are where another stop is, too."""
        counts = Counter((round(stop.x, 2), round(stop.y, 2)) for stop in self.stops)
        return sum(count for count in counts.values() if count > 1)


def _is_turn(here: int | None, there: int | None, length: float) -> bool:
    """Whether a road between dstates of these places is a turn on the spot."""
    return length < LEAST if here is None or there is None else here == there


def _streets(ssh_map: SSHMap) -> dict[tuple[int, int], tuple[str | None, int | None, int | None]]:
    """From one place to another: the action that was done there, or None, and along which path that is, and which way."""
    ends: dict[tuple[int, int], tuple[str | None, int | None, int | None]] = {}
    for path in ssh_map.paths:
        index = {place: i for i, place in enumerate(path.order)}
        for p, q in travelled(ssh_map, path):
            way = 1 if index.get(p, 0) < index.get(q, 0) else -1
            ends.setdefault((p, q), (None, path.id, way))
            ends.setdefault((q, p), (None, path.id, -way))
    for s, action, x in sorted(ssh_map.links, reverse=True):
        here, there = ssh_map.dstates[s], ssh_map.dstates[x]
        if here.place is not None and there.place is not None and here.place != there.place:
            ends[here.place, there.place] = (
                action,
                here.path if here.path == there.path else None,
                here.direction if here.path == there.path else None,
            )
    return ends
