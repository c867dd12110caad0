"""Turn a map into stops with positions and directed roads, for navigation programs.

Places that the robot only passed, such as corners of a corridor, can be left out.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import groupby, pairwise, product
from typing import Any, TypeAlias

from ssh_abduction.data.building import Indoors, Wing
from ssh_abduction.data.errors import MapError
from ssh_abduction.data.groups import gathered
from ssh_abduction.data.map_parts import ids_at
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.schema import only_known
from ssh_abduction.data.trace import Trace, View
from ssh_abduction.output.layout import Layout, Turns, layout, travelled

# Costs in metres: the least cost of a road, and the cost of a turn on the spot. A robot that drives
# 0.5 m/s turns by 90 degrees in about a second.
LEAST, TURN = 0.01, 0.5
DIGITS = 4  # of coordinates in files, in metres
NO_PLACES = "level: expected dstates, got places: the map has no places; export its dstates"
# The action of a road, the path that the road is along, and the direction along this path.
Way: TypeAlias = tuple[str | None, int | None, int | None]


@dataclass(frozen=True, slots=True)
class Stop:
    """A destination for a robot: a place, or a dstate (a place and a heading).

    Attributes:
        id: The number of the place or dstate.
        x: Position in metres, or in units of the layout.
        y: Position in metres, or in units of the layout.
        heading: Radians counterclockwise from x; 0 if it is unknown. A place has the heading of its
            first dstate with a known heading.
        views: The views of its dstates, in their order.
        floor: The number of its floor; None if the map has no floors.
        name: The name that a person gave to its place; None if it has none.
        regions: The ids of the regions that contain it.
        region_names: The names that a person gave to these regions.
        room: The name or number of its room, such as "room 3"; None if it has none.
        wing: The wing of its room, such as "left of corridor 2"; None if it has none.
        corridor: The name or number of its corridor; None if it has none.
    """

    id: int
    x: float
    y: float
    heading: float
    views: tuple[View, ...]
    floor: int | None = None
    name: str | None = None
    regions: tuple[int, ...] = ()
    region_names: tuple[str, ...] = ()
    room: str | None = None
    wing: str | None = None
    corridor: str | None = None

    @property
    def properties(self) -> dict[str, str]:
        """The views of the stop, and its regions if there are any, as texts for files."""
        regions = {"regions": " ".join(map(str, self.regions))} if self.regions else {}
        names = {"region_names": ", ".join(self.region_names)} if self.region_names else {}
        indoors = only_known(room=self.room, wing=self.wing, corridor=self.corridor)
        return {"views": " ".join(map(str, self.views)), **regions, **names, **indoors}


@dataclass(frozen=True, slots=True)
class Road:
    """A directed edge between two stops.

    Attributes:
        start: The id of the stop where it begins.
        end: The id of the stop where it ends.
        length: The straight distance in metres, or in units of the layout. If hidden stops lie
            between, the way leads through them.
        action: The name of the robot's action; None if the robot travelled only the other way.
        path: The path that the road is along; None if there is none.
        direction: The direction along this path, +1 or -1; None if there is none.
        turns: Whether the road is a turn on the spot: both stops are dstates of one place or, if a
            place is unknown, at one point.
        name: The name that a person gave to its path; None if it has none.
        indoors: The `corridor` along which it leads, the `door` through which it leads, and the
            `width` of the narrower one in metres, as far as they are known.
    """

    start: int
    end: int
    length: float
    action: str | None
    path: int | None
    direction: int | None
    turns: bool = False
    name: str | None = None
    indoors: Mapping[str, str | float] = field(default_factory=dict, hash=False)

    @property
    def cost(self) -> float:
        """The cost for a planner: the length, plus 0.5 for a turn; at least 0.01."""
        return self.length + TURN if self.turns else max(self.length, LEAST)


@dataclass(frozen=True, slots=True)
class Roads:
    """A map as stops and directed roads.

    Attributes:
        level: What a stop is: "places" or "dstates".
        metric: Whether positions are metres. Otherwise they are computed by a layout.
        stops: The stops.
        roads: The roads.
    """

    level: str
    metric: bool
    stops: tuple[Stop, ...]
    roads: tuple[Road, ...]

    @classmethod
    def of(cls, ssh_map: SSHMap, level: str, turns: Trace | Turns | None = None) -> Roads:
        """Make the stops and roads of a map.

        Args:
            ssh_map: The map.
            level: What a stop is. With "dstates", each link is a road. With "places", the robot's
                travels between two places, in either direction, make a road in each direction.
            turns: How actions turn, as in `to_svg`.

        Raises:
            MapError: `level` is "places" and the map has none, or there are no roads.
        """
        drawn = layout(ssh_map, turns)
        if level == "places" and not ssh_map.places:
            raise MapError(NO_PLACES)
        stops = tuple(_stops(ssh_map, drawn, level))
        # If several actions lead from one dstate to another, the first by name counts.
        links = sorted(ssh_map.links, reverse=True)
        ends = {(s, x): _way(ssh_map, s, action, x) for s, action, x in links if s != x}
        ends = _streets(ssh_map) if level == "places" else ends
        at = {stop.id: (stop.x, stop.y) for stop in stops}
        floor = {stop.id: stop.floor for stop in stops}
        dstates = ssh_map.dstates if level == "dstates" else ()
        place = {s.id: s.place for s in dstates if s.place is not None}
        roads = tuple(
            Road(
                a,
                b,
                # Floors are drawn apart, so the distance along a lift means nothing.
                length := math.dist(at[a], at[b]) if floor[a] == floor[b] else LEAST,
                *what,
                turns=floor[a] == floor[b]
                and (length < LEAST if {a, b} - place.keys() else place[a] == place[b]),
                name=ssh_map.name_of("path", what[1]),
                indoors=_indoors(ssh_map, a, b) if level == "places" else {},
            )
            for (a, b), what in sorted(ends.items())
        )
        if not roads:
            raise MapError(
                f"map: expected roads between its {level}, got none; log a trace in which the "
                "robot travels"
            )
        return cls(level, drawn.metric, stops, roads)

    def without(self, hidden: Collection[int]) -> Roads:
        """Hide stops, and join the roads that lead through them.

        A stop stays if its roads do not lead to exactly two others, or if there is another road
        between these two.
        """
        stops, roads = {stop.id: stop for stop in self.stops}, list(self.roads)
        for stop in sorted(hidden):
            here = [road for road in roads if stop in (road.start, road.end)]
            beside = {end for road in here for end in (road.start, road.end)} - {stop}
            if len(beside) == 2 and not any({r.start, r.end} == beside for r in roads):
                del stops[stop]
                roads = [road for road in roads if road not in here] + [
                    _joined(before, after)
                    for before, after in product(here, here)
                    if before.end == after.start == stop and before.start != after.end
                ]
        order = sorted(roads, key=lambda road: (road.start, road.end))
        return replace(self, stops=tuple(stops.values()), roads=tuple(order))

    @property
    def together(self) -> int:
        """The number of stops that share their position (to 1 cm) with another stop."""
        counts = Counter((round(stop.x, 2), round(stop.y, 2)) for stop in self.stops)
        return sum(count for count in counts.values() if count > 1)


def _joined(before: Road, after: Road) -> Road:
    """Join a road and the next one, without the stop between them."""
    path, name = (before.path, before.name) if before.path == after.path else (None, None)
    return Road(
        before.start,
        after.end,
        before.length + after.length,
        None if after.action is None else before.action,
        path,
        before.direction if before.direction == after.direction and path is not None else None,
        name=name,
    )


def _stops(ssh_map: SSHMap, drawn: Layout, level: str) -> Iterator[Stop]:
    """Make a stop for each place, or for each dstate."""
    building = ssh_map.building or Indoors()
    members = gathered((s.place if level == "places" else s.id, s) for s in ssh_map.dstates)
    for number in ssh_map.places if level == "places" else range(len(ssh_map.dstates)):
        here = members.get(number, [])
        x, y = drawn.places[number] if level == "places" else drawn.dstates[number][:2]
        headings = (drawn.dstates[s.id][2] for s in here)
        place = here[0].place if here else number
        regions = ids_at(ssh_map.regions, place)
        names = (ssh_map.name_of("region", region) for region in regions)
        yield Stop(
            number,
            x,
            y,
            next((heading for heading in headings if heading is not None), 0.0),
            tuple(s.view for s in here if s.view is not None),
            here[0].floor if here else None,
            ssh_map.name_of("place", place),
            regions,
            tuple(name for name in names if name is not None),
            short_name(ssh_map, "room", room := building.room_of(place)),
            wing_name(ssh_map, building.wing_of(room)),
            short_name(ssh_map, "corridor", building.corridor_of(place)),
        )


def short_name(ssh_map: SSHMap, kind: str, number: Any) -> str | None:
    """The name of a room, corridor or door, or its kind and number; None without a number."""
    if number is None:
        return None
    return ssh_map.name_of(kind, number) or f"{kind} {number}"


def wing_name(ssh_map: SSHMap, wing: Wing | None) -> str | None:
    """Name a wing by its corridor, such as "left of corridor 2"; None without a wing."""
    if wing is None:
        return None
    return f"{wing.side} of {short_name(ssh_map, 'corridor', wing.corridor)}"


def _indoors(ssh_map: SSHMap, a: int, b: int) -> dict[str, str | float]:
    """Find the corridor and the door on the way between two places, and the least width."""
    corridor = next((c for c in ssh_map.corridors if {a, b} <= {*c.order}), None)
    door = next((d for d in ssh_map.doors if {a, b} == {*d.places}), None)
    widths = [thing.width for thing in (corridor, door) if thing is not None]
    return only_known(
        corridor=short_name(ssh_map, "corridor", corridor and corridor.id),
        door=short_name(ssh_map, "door", door and door.id),
        width=min(widths, default=None),
    )


def _streets(ssh_map: SSHMap) -> dict[tuple[int, int], Way]:
    """Find the action, path and direction from each place to each place that a travel connects.

    Both directions are included. The action is None if the robot only travelled the other way.
    """
    ends: dict[tuple[int, int], Way] = {}
    for path in ssh_map.theory_paths:
        index = {place: i for i, place in enumerate(path.order)}
        for p, q in travelled(ssh_map, path):
            direction = 1 if index.get(p, 0) < index.get(q, 0) else -1
            ends.setdefault((p, q), (None, path.id, direction))
            ends.setdefault((q, p), (None, path.id, -direction))
    for s, action, x in sorted(ssh_map.links, reverse=True):
        one, other = ssh_map.dstates[s], ssh_map.dstates[x]
        here, there = one.place, other.place
        if here is not None and there is not None and here != there:
            ends[here, there] = _way(ssh_map, s, action, x)
            if not ssh_map.theory_paths and one.floor == other.floor:
                ends.setdefault((there, here), (None, None, None))
    return ends


def _way(ssh_map: SSHMap, source: int, action: str, target: int) -> Way:
    """The action, path and direction of a link. Path and direction are None if the path changes."""
    here, there = ssh_map.dstates[source], ssh_map.dstates[target]
    return (action, here.path, here.direction) if here.path == there.path else (action, None, None)


def place_of_steps(ssh_map: SSHMap) -> list[int | None]:
    """Return the place of each step of a map."""
    return [ssh_map.dstates[label].place for label in ssh_map.dstate_at]


def undecided_places(ssh_map: SSHMap) -> frozenset[int]:
    """Find the places that the robot only passed.

    At every visit, the robot came from one of two neighbours and went on to the other. It never
    turned around at such a place, and never began or ended a drive there.
    """
    places, labels = place_of_steps(ssh_map), ssh_map.dstate_at
    # A drive starts where no action leads from the step before.
    linked = {(s, x) for s, _, x in ssh_map.links}
    starts = [t for t, pair in enumerate(pairwise(labels), 1) if pair not in linked]
    through = defaultdict[int, set[frozenset[int]]](set)
    ends: set[int] = set()
    for first, stop in pairwise([0, *starts, len(places)]):
        drive = [place for place in places[first:stop] if place is not None]
        stays = [place for place, _ in groupby(drive)]
        for before, place, after in zip(stays, stays[1:], stays[2:], strict=False):
            through[place].add(frozenset((before, after)))
        ends.update(stays[:1], stays[-1:])
    return frozenset(
        place
        for place, pairs in through.items()
        if place not in ends and len(pairs) == 1 and len(next(iter(pairs))) == 2
    )
