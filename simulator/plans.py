"""Floor plans of real buildings as graphs of rooms, whose gateways are doors.

A place is a room, and the robot stands in its middle. A gateway is a door as seen from there.

The robot leaves a room through the door that it faces, and enters the next room with that door
behind it. If another door is then straight ahead, to within STRAIGHT degrees, the two doors are
opposite. The robot faces that door, and the path goes on through both. Otherwise the robot faces no
door, and the path ends. So a distinctive state (dstate) is a room with a door that the robot faces,
or with a door behind it.

Plans are read from XML files, as in M. Luperto's data set of school plans. A file has rooms
(`space`) as polygons in pixels, doors (`portal`), and the size of a pixel.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import networkx as nx
import numpy as np
from scipy.optimize import linear_sum_assignment

from simulator.errors import SimulatorError
from ssh_abduction.data.checks import a_number, a_path, a_text, all_instances
from ssh_abduction.data.errors import brief, named, printable
from ssh_abduction.data.files import read_file

Point = tuple[float, float]
# Largest size of a plan in bytes.
LARGEST = 64 * 2**20
METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
Leg = tuple[int, int]  # A room that the robot leaves, and the door that it goes through.
# Two doors of a room are opposite if the path through its middle bends by at most this many
# degrees.
STRAIGHT = 20.0
# The robot cannot distinguish doors within this many degrees. On a tour, only one of them is open.
APART = 3.0


@dataclass(frozen=True)
class RoomGateway:
    """A door as seen from the middle of a room."""

    door: int  # index of the door in the plan
    to: int  # index of the room behind the door
    bearing: float  # direction from the middle of the room, in degrees clockwise from north (+y)
    # Index of the opposite gateway among those of the same room; None without one.
    opposite: int | None = None


@dataclass(frozen=True)
class Plan:
    """A floor plan: rooms, and the doors between them. North (+y) is up in the drawing.

    Attributes:
        name: Name of the plan.
        rooms: The rooms, which are the places.
        doors: The doors, which refer to rooms by their indices.
    """

    name: str
    rooms: tuple[Room, ...]
    doors: tuple[Door, ...]

    def __post_init__(self) -> None:
        a_text("plan.name", self.name, SimulatorError)
        for name, some, kind in (("rooms", self.rooms, Room), ("doors", self.doors, Door)):
            members = all_instances(f"plan.{name}", some, kind, SimulatorError, mend=f"give {name}")
            object.__setattr__(self, name, members)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Plan:
        """Load a plan from an XML file.

        Raises:
            SimulatorError: The plan is wrong. The text names the part that is wrong.
        """
        return cls(*read_plan(path))

    @cached_property
    def gateways(self) -> tuple[tuple[RoomGateway, ...], ...]:
        """The gateways of each room, clockwise from north."""
        seen: list[list[RoomGateway]] = [[] for _ in self.rooms]
        for number, door in enumerate(self.doors):
            for here, there in (door.rooms, door.rooms[::-1]):
                x, y = self.rooms[here].centre
                bearing = math.degrees(math.atan2(door.position[0] - x, door.position[1] - y)) % 360
                seen[here].append(RoomGateway(number, there, bearing))
        return tuple(_with_opposites(sorted(found, key=lambda g: g.bearing)) for found in seen)

    @property
    def graph(self) -> nx.MultiGraph:
        """A graph of rooms as nodes and doors as edges, both by index."""
        graph = nx.MultiGraph()
        graph.add_nodes_from(range(len(self.rooms)))
        graph.add_edges_from((*door.rooms, number) for number, door in enumerate(self.doors))
        return graph

    @cached_property
    def connected(self) -> tuple[int, ...]:
        """The indices of the rooms in the largest part of the plan that doors connect."""
        parts: list[list[int]] = sorted(
            (sorted(part) for part in nx.connected_components(self.graph)),
            key=lambda part: (-len(part), part),
        )
        return tuple(parts[0])

    @cached_property
    def paths(self) -> tuple[tuple[Leg, ...], ...]:
        """The paths of the plan. A path goes straight on through opposite doors of a room.

        A path is its legs from end to end: pairs of a room that the robot leaves, and the door that
        it leaves by.
        """
        found: list[tuple[Leg, ...]] = []
        taken: set[int] = set()
        for number, door in enumerate(self.doors):
            if number not in taken:
                to_the_start = self._straight_on((door.rooms[1], number))
                room, first = to_the_start[-1]
                path = self._straight_on((self._behind(room, first), first))
                taken |= {door for _, door in path}
                found.append(path)
        return tuple(found)

    def _behind(self, room: int, door: int) -> int:
        """The room on the other side of a door of a room."""
        one, other = self.doors[door].rooms
        return other if room == one else one

    def _straight_on(self, leg: Leg) -> tuple[Leg, ...]:
        """A leg (a room and the door out of it), and all legs straight ahead of it.

        A path that is a circle is followed once.
        """
        legs = [leg]
        while True:
            room = self._behind(*legs[-1])
            came = next(gateway for gateway in self.gateways[room] if gateway.door == legs[-1][1])
            if came.opposite is None or self.gateways[room][came.opposite].door == leg[1]:
                return tuple(legs)
            legs.append((room, self.gateways[room][came.opposite].door))

    @cached_property
    def courses(self) -> dict[Leg, tuple[int, int]]:
        """The path and direction of a robot that leaves a room through a door.

        The result is a dict. A key has the indices of the room and of the door. A value has the
        index of the path in `paths`, and 1 if the robot goes along the path or -1 if against it.
        """
        return {
            leg: (number, direction)
            for number, path in enumerate(self.paths)
            for room, door in path
            for leg, direction in (((room, door), 1), ((self._behind(room, door), door), -1))
        }

    def told_apart(self, degrees: float = APART) -> Plan:
        """Copy the plan without doors that look too close together from the middle of a room.

        The doors nearest to the middles of their rooms are kept.

        Args:
            degrees: Smallest angle between two doors of a room.
        """
        a_number("degrees", degrees, SimulatorError, 0, 180, what="degrees")

        def far(number: int) -> float:
            door = self.doors[number]
            return sum(math.dist(door.position, self.rooms[room].centre) for room in door.rooms)

        bearing = {
            (g.door, room): g.bearing for room, found in enumerate(self.gateways) for g in found
        }
        kept: list[int] = []
        taken: list[list[float]] = [[] for _ in self.rooms]
        # Keep a door if it is far enough from the kept doors of both rooms.
        for number in sorted(range(len(self.doors)), key=far):
            rooms = self.doors[number].rooms
            gaps = (_apart(bearing[number, room], other) for room in rooms for other in taken[room])
            if min(gaps, default=180.0) >= degrees:
                kept.append(number)
                for room in rooms:
                    taken[room].append(bearing[number, room])
        return replace(self, doors=tuple(self.doors[number] for number in sorted(kept)))


def _apart(one: float, other: float) -> float:
    """The angle between two directions in degrees, from 0 to 180."""
    return abs(math.remainder(one - other, 360))


def _with_opposites(found: Sequence[RoomGateway]) -> tuple[RoomGateway, ...]:
    """Set `opposite` for two gateways of a room if each is the best opposite of the other.

    They may differ from exactly opposite by at most STRAIGHT degrees. Two doors to one other room
    are never opposite: no path comes back to a room.
    """

    def nearest(k: int) -> int:
        return min(
            range(len(found)),
            key=lambda other: _apart(found[other].bearing, found[k].bearing + 180),
        )

    pairs = {
        k: other
        for k in range(len(found))
        if k == nearest(other := nearest(k))
        and _apart(found[k].bearing, found[other].bearing + 180) <= STRAIGHT
        and found[k].to != found[other].to
    }
    return tuple(replace(gateway, opposite=pairs.get(k)) for k, gateway in enumerate(found))


@dataclass(frozen=True)
class Room:
    """A room."""

    name: str  # name in the file, which no other room has
    use: str  # purpose of the room; empty if the file does not say it
    centre: Point  # (x, y) of the middle in metres
    # (x, y) of each corner in metres; empty if unknown.
    polygon: tuple[Point, ...] = field(default=(), repr=False)


@dataclass(frozen=True)
class Door:
    """A door between two rooms."""

    rooms: tuple[int, int]  # indices of the two rooms in the plan
    position: Point  # (x, y) of the middle in metres


def read_plan(path: str | os.PathLike[str]) -> tuple[str, tuple[Room, ...], tuple[Door, ...]]:
    """Read the name of a plan (the name of the XML file), its rooms, and its doors.

    Raises SimulatorError if the file cannot be read, or a part of the plan is wrong.
    """
    path = a_path("path", path, SimulatorError)
    data = read_file(path, LARGEST, "a readable plan", SimulatorError)
    # Entities can expand to gigabytes.
    if b"<!ENTITY" in data:
        raise SimulatorError(
            f"{named(path)}: expected a plan without entities of its own, got some; replace each "
            "by its text"
        )
    try:
        building = ElementTree.fromstring(data)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise SimulatorError(
            f"{named(path)}: expected a plan in XML, got something else "
            f"({brief(str(error))}); mend it"
        ) from None
    name = printable(Path(path).stem.removesuffix("_updated"))
    return name, *_PlanReader(named(path)).plan(building)


class _PlanReader:
    """Reads the XML of a plan. All methods raise SimulatorError for wrong parts."""

    def __init__(self, where: str) -> None:
        self.where = where

    def plan(self, building: Element) -> tuple[tuple[Room, ...], tuple[Door, ...]]:
        """Read the rooms and doors of a plan."""
        scale = self.scale(building)
        spaces = building.findall("floor/spaces/space")
        self.need(spaces, "floor/spaces", "at least one space", None)
        rooms = tuple(self.room(space, f"space[{i}]", scale) for i, space in enumerate(spaces))
        numbers = {room.name: i for i, room in enumerate(rooms)}
        self.need(len(numbers) == len(rooms), "space", "a unique id for each space", None)
        # Collect the positions of each door from both of its rooms.
        sides: dict[tuple[int, int], dict[int, list[Point]]] = {}
        for here, space in enumerate(spaces):
            middles = {
                line.get("id"): self.middle(line, scale)
                for line in space.findall("space_representation/linesegment")
            }
            for i, portal in enumerate(space.findall("portals/portal")):
                pair = self.pair(portal, numbers, here, f"space[{here}].portal[{i}]")
                if (middle := middles.get(portal.findtext("linesegment"))) is not None:
                    sides.setdefault(pair, {}).setdefault(here, []).append(middle)
        doors = tuple(
            Door(pair, position)
            for pair in sorted(sides)
            for position in _matched(*(sides[pair].get(room, []) for room in pair))
        )
        return rooms, doors

    def need(self, is_good: object, name: str, expected: str, value: object) -> None:
        """Raise SimulatorError if a part of the plan is not what is expected."""
        if not is_good:
            got = "none" if value is None else brief(value)
            raise SimulatorError(f"{self.where}: {name}: expected {expected}, got {got}; mend it")

    def scale(self, building: Element) -> float:
        """Read the size of a pixel in metres."""
        pixels = self.number(
            building.findtext("scale/represented_distance/value"), "scale/represented_distance"
        )
        length = self.number(building.findtext("scale/real_distance/value"), "scale/real_distance")
        unit = building.findtext("scale/real_distance/um")
        self.need(unit in METRES, "scale/real_distance/um", " or ".join(METRES), unit)
        self.need(pixels > 0 and length > 0, "scale", "distances above 0", [pixels, length])
        return METRES[str(unit)] * length / pixels

    def room(self, space: Element, where: str, scale: float) -> Room:
        """Read a room."""
        name = space.get("id", "")
        self.need(name, f"{where}.id", "a text", space.get("id"))
        corners = tuple(
            self.point(point, where, scale) for point in space.findall("bounding_polygon/point")
        )
        centre = self.point(space.find("centroid/point"), f"{where}.centroid", scale)
        return Room(name, (space.findtext("labels/label") or "").strip(), centre, corners)

    def pair(
        self, portal: Element, numbers: Mapping[str, int], here: int, where: str
    ) -> tuple[int, int]:
        """Read the indices of the two rooms of a door, in ascending order."""
        names = [target.text or "" for target in portal.findall("target/id")]
        rooms = sorted({numbers[name] for name in names if name in numbers})
        is_pair = len(names) == len(rooms) == 2 and here in rooms
        self.need(is_pair, f"{where}.target", "the ids of this space and of another one", names)
        return rooms[0], rooms[1]

    def middle(self, line: Element, scale: float) -> Point:
        """Read a line, and return its middle in metres."""
        ends = [self.point(point, "linesegment", scale) for point in line.findall("point")]
        self.need(ends, "linesegment", "points", None)
        return _mean(ends)

    def point(self, point: Element | None, where: str, scale: float) -> Point:
        """Read a point, and convert it to metres. In drawings y points down; here it points up."""
        self.need(point is not None, f"{where}.point", "x and y", None)
        assert point is not None
        x, y = (self.number(point.get(name), f"{where}.{name}") for name in "xy")
        return scale * x, -scale * y

    def number(self, text: str | None, where: str) -> float:
        """Read a number of at most a million."""
        value: float | None = None
        with suppress(ValueError):
            value = float(text or "")
        self.need(value is not None, where, "a number", text)
        assert value is not None
        self.need(abs(value) <= 1e6, where, "a number of at most 1,000,000", text)
        return value


def _matched(here: Sequence[Point], there: Sequence[Point]) -> Iterator[Point]:
    """Match the doors that two rooms list: yield the mean of both positions, or the only one."""
    distances = np.reshape([math.dist(a, b) for a in here for b in there], (len(here), len(there)))
    first, second = linear_sum_assignment(distances)
    yield from (_mean([here[i], there[j]]) for i, j in zip(first, second, strict=True))
    yield from (point for i, point in enumerate(here) if i not in first)
    yield from (point for j, point in enumerate(there) if j not in second)


def _mean(points: Sequence[Point]) -> Point:
    x, y = (math.fsum(values) / len(points) for values in zip(*points, strict=True))
    return x, y
