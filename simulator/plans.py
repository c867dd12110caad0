"""Floor plans of real buildings as graphs of rooms, whose gateways are doors, and simulated drives from room to room.

A plan is an XML file of the kind that M. Luperto's data set of school plans has: rooms as polygons in pixels, doors as `portal`, and how many pixels are how many metres.
A place is a room, and the robot stands in its middle. A gateway is a door, in the direction in which it is from there.

The robot leaves a room through the door that it faces, and comes into the next room with that door behind it. If another door is straight ahead then, to within
STRAIGHT, it faces that one: the two are opposite, and the path goes on through both. Otherwise it faces no door, and the path ends there. So
a distinctive state is a room and a door that the robot faces, or a room and a door that it has behind it.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import networkx as nx
import numpy as np
from scipy.optimize import linear_sum_assignment

from simulator.errors import SimulatorError
from simulator.motion import Pose, between, reported
from ssh_abduction.data.checks import (
    a_number,
    a_path,
    a_text,
    a_whole_number,
    all_instances,
    an_instance,
)
from ssh_abduction.data.errors import brief, named, printable
from ssh_abduction.data.files import read_at_most
from ssh_abduction.data.odometry import Odometry
from ssh_abduction.data.star import Gateway as Sighted
from ssh_abduction.data.trace import Action, Step, Trace

Point = tuple[float, float]
Leg = tuple[int, int]  # a room that the robot leaves, and the door that it goes through

# Bytes that a plan may have.
LARGEST = 64 * 2**20
METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
# Two doors of a room are opposite if the way from one to the other through its middle bends by at most so many degrees.
STRAIGHT = 20.0
# Doors that are in one direction, to within so many degrees, are one door for the robot. Of such doors one is open on a tour.
APART = 3.0
# A view tells the directions of doors to so many degrees.
COARSE = 45
# A tour has so many actions at most: a trace of them fits into memory.
MOST_STEPS = 10_000_000


@dataclass(frozen=True)
class Room:
    """A room: what it is called in the file, what it is for, its middle in metres, and its corners."""

    name: str
    use: str
    centre: Point
    polygon: tuple[Point, ...] = field(default=(), repr=False)


@dataclass(frozen=True)
class Door:
    """A door between two rooms, which are numbered as in the plan, and where it is, in metres."""

    rooms: tuple[int, int]
    position: Point


@dataclass(frozen=True)
class Gateway:
    """A door as it is seen from the middle of a room.

    door      its number in the plan
    to        the room behind it
    bearing   its direction, in degrees clockwise from north, which is +y
    opposite  the gateway of the same room that is straight opposite; None where there is none
    """

    door: int
    to: int
    bearing: float
    opposite: int | None = None


@dataclass(frozen=True)
class Plan:
    """Rooms, and the doors between them. North is up in the drawing that the plan was read from."""

    name: str
    rooms: tuple[Room, ...]
    doors: tuple[Door, ...]

    def __post_init__(self) -> None:
        a_text("plan.name", self.name, SimulatorError)
        object.__setattr__(
            self,
            "rooms",
            all_instances("plan.rooms", self.rooms, Room, SimulatorError, mend="give rooms"),
        )
        object.__setattr__(
            self,
            "doors",
            all_instances("plan.doors", self.doors, Door, SimulatorError, mend="give doors"),
        )

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Plan:
        """The plan in an XML file. Raises SimulatorError that says where."""
        path = a_path("path", path, SimulatorError)
        try:
            data = read_at_most(path, LARGEST)
        except OSError as error:
            raise SimulatorError(
                f"{named(path)}: expected a readable plan: {error.strerror or error}; check the path"
            ) from None
        except ValueError as error:
            raise SimulatorError(
                f"{named(path)}: expected a plan: {error}; check the path"
            ) from None
        if b"<!ENTITY" in data:
            raise SimulatorError(
                f"{named(path)}: expected a plan without entities of its own, got some; write them out"
            )
        try:
            building = ElementTree.fromstring(data)
        except (ElementTree.ParseError, ValueError, LookupError) as error:
            raise SimulatorError(
                f"{named(path)}: expected a plan in XML, got something else ({brief(str(error))}); mend it"
            ) from None
        return _Reader(named(path)).plan(
            printable(Path(path).stem.removesuffix("_updated")), building
        )

    @cached_property
    def gateways(self) -> tuple[tuple[Gateway, ...], ...]:
        """For each room its gateways, clockwise from north."""
        seen: list[list[Gateway]] = [[] for _ in self.rooms]
        for number, door in enumerate(self.doors):
            for here, there in (door.rooms, door.rooms[::-1]):
                x, y = self.rooms[here].centre
                bearing = math.degrees(math.atan2(door.position[0] - x, door.position[1] - y)) % 360
                seen[here].append(Gateway(number, there, bearing))
        return tuple(_with_opposites(sorted(found, key=lambda g: g.bearing)) for found in seen)

    @property
    def graph(self) -> nx.MultiGraph:
        """The rooms as nodes and the doors as edges, both by their numbers."""
        graph = nx.MultiGraph()
        graph.add_nodes_from(range(len(self.rooms)))
        graph.add_edges_from((*door.rooms, number) for number, door in enumerate(self.doors))
        return graph

    @cached_property
    def connected(self) -> tuple[int, ...]:
        """The most rooms that can be reached from each other."""
        parts: list[list[int]] = sorted(
            (sorted(part) for part in nx.connected_components(self.graph)),
            key=lambda part: (-len(part), part),
        )
        return tuple(parts[0])

    @cached_property
    def paths(self) -> tuple[tuple[Leg, ...], ...]:
        """The paths as the robot would drive them from end to end. They go on where doors are opposite."""
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
        """The room to which a door leads from a room."""
        one, other = self.doors[door].rooms
        return other if room == one else one

    def _straight_on(self, leg: Leg) -> tuple[Leg, ...]:
        """A leg, and those that lead straight on from it; once round, if they lead back to it."""
        legs = [leg]
        while True:
            room = self._behind(*legs[-1])
            came = next(gateway for gateway in self.gateways[room] if gateway.door == legs[-1][1])
            if came.opposite is None or self.gateways[room][came.opposite].door == leg[1]:
                return tuple(legs)
            legs.append((room, self.gateways[room][came.opposite].door))

    @cached_property
    def courses(self) -> dict[Leg, tuple[int, int]]:
        """For each way out of a room its path, and whether it goes along it (1) or back (-1)."""
        return {
            leg: (number, direction)
            for number, path in enumerate(self.paths)
            for room, door in path
            for leg, direction in (((room, door), 1), ((self._behind(room, door), door), -1))
        }

    def told_apart(self, degrees: float = APART) -> Plan:
        """This plan with fewer doors, so that those of a room are at least so many degrees apart. Of several the nearest to the middles of its rooms is kept."""

        a_number("degrees", degrees, SimulatorError, 0, 180, what="degrees")

        def far(number: int) -> float:
            door = self.doors[number]
            return sum(math.dist(door.position, self.rooms[room].centre) for room in door.rooms)

        bearing = {
            (g.door, room): g.bearing for room, found in enumerate(self.gateways) for g in found
        }
        kept: list[int] = []
        taken: list[list[float]] = [[] for _ in self.rooms]
        for number in sorted(range(len(self.doors)), key=far):
            rooms = self.doors[number].rooms
            if all(
                _apart(bearing[number, room], other) >= degrees
                for room in rooms
                for other in taken[room]
            ):
                kept.append(number)
                for room in rooms:
                    taken[room].append(bearing[number, room])
        return replace(self, doors=tuple(self.doors[number] for number in sorted(kept)))


@dataclass(frozen=True)
class Stand:
    """Where the robot is on a tour: a room, and the gateway that it faces, or has behind it."""

    room: int
    gateway: int
    faces: bool = True


def tour(
    plan: Plan,
    steps: int,
    seed: int = 0,
    odometry: Odometry | None = None,
    *,
    scale: float = 0.0,
    bend: float = 0.0,
    apart: float = APART,
) -> Trace:
    """A drive from room to room, of so many actions, with views, stars and displacements.

    The robot turns to the door of the room that it has passed least often, by chance where several are, and not back to the one that it came through unless there is no other; then it travels
    through it. A turn is named by the side that it goes to, and by how many gateways it goes on to that side; one that ends where the robot came from, or
    that goes from a door to the opposite one, is a turn around. A view tells the number of doors and their rough directions, so that many rooms look alike.

    odometry     the noise that is drawn for the displacements, and that the trace says they have; without it they are exact
    scale, bend  errors that repeat, as in simulator.motion.reported
    apart        degrees by which the doors of a room are told apart, as in Plan.told_apart. A bearing is off by a quarter of that at most, so that no two doors look like one
    The truth has dstate, place, path and pose. Raises SimulatorError where no two rooms are connected.
    """
    an_instance("plan", plan, Plan, SimulatorError, mend="take Plan.load")
    a_whole_number("steps", steps, SimulatorError, 0, MOST_STEPS, what="a number of actions")
    a_whole_number("seed", seed, SimulatorError)
    if odometry is not None:
        an_instance(
            "odometry",
            odometry,
            Odometry,
            SimulatorError,
            mend="make one with Odometry(), or leave it out",
        )
    a_number("scale", scale, SimulatorError, -1, 1, what="a share")
    a_number("bend", bend, SimulatorError, -1, 1, what="radians a metre")
    plan = plan.told_apart(apart)
    if len(plan.connected) < 2:
        raise SimulatorError(
            f"{plan.name}: expected rooms with doors between them, got none that are connected; take another plan"
        )
    # Each has numbers of its own, so that the noise does not change where the robot goes.
    walk, drawn, sighted = (np.random.default_rng([seed, k]) for k in range(3))
    logged: list[Step] = []
    before: Pose | None = None
    for stand, action in _drive(plan, steps, walk):
        pose = _pose(plan, stand)
        moved = None if before is None else between(before, pose)
        if moved is not None and odometry is not None:
            moved = reported(moved, odometry, drawn, scale=scale, bend=bend)
        bearings = _bearings(plan, stand)
        star = _sighted(plan, stand, apart / 4, sighted)
        logged.append(Step(_view(bearings), action, star, moved, truth=_truth(plan, stand, pose)))
        before = pose
    return Trace(tuple(logged), name=f"{plan.name}, {steps} steps, seed {seed}", odometry=odometry)


@dataclass(frozen=True)
class Floor:
    """A plan as a world of its own that a robot can be driven in, action by action: where it may stand, what it sees there, and what it can do.

    >>> from simulator.plans import Door, Floor, Plan, Room
    >>> floor = Floor(Plan("two", (Room("a", "", (0, 0)), Room("b", "", (0, 9))), (Door((0, 1), (0, 5)),)))
    >>> floor.sight(floor.start).view, [action.name for action in floor.ends(floor.start)]
    ('1 door: 0', ['travel'])

    plan    whose doors are told apart already, as by Plan.told_apart
    spread  degrees that the bearings in a star may be off, as the star says; they are exact
    """

    plan: Plan
    spread: float = APART / 4

    @property
    def start(self) -> Stand:
        """At the first gateway of the first room from which the most others can be reached."""
        return Stand(self.plan.connected[0], 0)

    def sight(self, stand: Stand) -> Step:
        """What the robot sees there. It has a view and a star, but no truth."""
        bearings = _bearings(self.plan, stand)
        return Step(_view(bearings), star=_star(self.plan, stand, bearings, self.spread))

    def ends(self, stand: Stand) -> dict[Action, Stand]:
        """What the robot can do there, and where that ends: a turn to each other gateway, and a travel where it faces one."""
        return dict(
            next(self.way_through(stand, goal))
            for goal in range(len(self.plan.gateways[stand.room]))
        )

    def way_through(self, stand: Stand, goal: int) -> Iterator[tuple[Action, Stand]]:
        """The actions that lead through a gateway of the room, and where each of them ends."""
        return _way_through(self.plan, stand, goal)


def _drive(
    plan: Plan, steps: int, chance: np.random.Generator
) -> Iterator[tuple[Stand, Action | None]]:
    """Where the robot is at each step, and what it does next; nothing at the last step."""
    room = int(chance.choice(plan.connected))
    stand = Stand(room, int(chance.integers(len(plan.gateways[room]))))
    came_by: int | None = None
    passed: Counter[int] = Counter()
    while True:
        found = plan.gateways[stand.room]
        choices = [k for k, g in enumerate(found) if g.door != came_by] or list(range(len(found)))
        least = min(passed[found[k].door] for k in choices)
        goal = int(chance.choice([k for k in choices if passed[found[k].door] == least]))
        for action, after in _way_through(plan, stand, goal):
            if steps == 0:
                yield stand, None
                return
            yield stand, action
            stand, steps = after, steps - 1
        came_by = found[goal].door
        passed[came_by] += 1


def _way_through(plan: Plan, stand: Stand, goal: int) -> Iterator[tuple[Action, Stand]]:
    """The actions that lead through a gateway of a room, and where each of them ends."""
    if stand != (turned := Stand(stand.room, goal)):
        yield _turn(plan, stand, goal), turned
    gateway = plan.gateways[stand.room][goal]
    back = next(k for k, g in enumerate(plan.gateways[gateway.to]) if g.door == gateway.door)
    ahead = plan.gateways[gateway.to][back].opposite
    yield (
        Action.of("travel"),
        Stand(gateway.to, back, False) if ahead is None else Stand(gateway.to, ahead),
    )


def _turn(plan: Plan, stand: Stand, goal: int) -> Action:
    """The turn to a gateway. It is counted to the side that the robot turns to, without the one that it faces."""
    found = plan.gateways[stand.room]
    if goal == (found[stand.gateway].opposite if stand.faces else stand.gateway):
        return Action.of("around")
    bearings = _bearings(plan, stand)
    clockwise = sorted(bearing for bearing in bearings if bearing > 0)
    side, order = ("right", clockwise) if bearings[goal] < 180 else ("left", clockwise[::-1])
    number = order.index(bearings[goal]) + 1
    return Action.of(
        {"name": f"{side} to gateway {number}", "kind": "turn", "turn": side, "gateway": number}
    )


def _heading(plan: Plan, stand: Stand) -> float:
    """In degrees clockwise from north."""
    return plan.gateways[stand.room][stand.gateway].bearing + (0 if stand.faces else 180)


def _bearings(plan: Plan, stand: Stand) -> tuple[float, ...]:
    """For each gateway of the room its bearing, in degrees clockwise from ahead. Whoever sees the order of the gateways could tell headings apart by it, so stars are sorted."""
    heading = _heading(plan, stand)
    return tuple(
        round((gateway.bearing - heading) % 360, 3) % 360 for gateway in plan.gateways[stand.room]
    )


def _sighted(
    plan: Plan, stand: Stand, spread: float, chance: np.random.Generator
) -> tuple[Sighted, ...]:
    """The star as the robot sees it: each bearing is off by at most `spread` degrees."""
    found = plan.gateways[stand.room]
    off = chance.uniform(-spread, spread, len(found)).tolist()
    bearings = [
        round(bearing + wrong, 3) % 360
        for bearing, wrong in zip(_bearings(plan, stand), off, strict=True)
    ]
    return _star(plan, stand, bearings, spread)


def _view(bearings: Sequence[float]) -> str:
    """The number of doors and their rough directions."""
    rough = sorted({round(bearing / COARSE) * COARSE % 360 for bearing in bearings})
    return f"{len(bearings)} door{'s' * (len(bearings) > 1)}: {' '.join(map(str, rough))}"


def _star(
    plan: Plan, stand: Stand, bearings: Sequence[float], spread: float
) -> tuple[Sighted, ...]:
    """The star of gateways that are seen at these bearings, in their order. Doors through which one path goes on are told to be opposite."""
    found = plan.gateways[stand.room]
    order = sorted(range(len(found)), key=lambda k: bearings[k])
    opposite = [found[k].opposite for k in order]
    return tuple(
        Sighted(bearings[k], spread, None if other is None else order.index(other))
        for k, other in zip(order, opposite, strict=True)
    )


def _pose(plan: Plan, stand: Stand) -> Pose:
    return (
        *plan.rooms[stand.room].centre,
        math.remainder(math.radians(90 - _heading(plan, stand)), math.tau),
    )


def _truth(plan: Plan, stand: Stand, pose: Pose) -> dict[str, object]:
    door = plan.gateways[stand.room][stand.gateway].door
    path, direction = plan.courses[stand.room, door]
    place = f"room {stand.room}"
    return {
        "dstate": f"{place}, {'at' if stand.faces else 'from'} door {door}",
        "place": place,
        "path": f"path {path}",
        "direction": direction if stand.faces else -direction,
        "pose": [round(v, 5) for v in pose],
    }


def _apart(one: float, other: float) -> float:
    """Degrees between two directions."""
    return abs(math.remainder(one - other, 360))


def _with_opposites(found: Sequence[Gateway]) -> tuple[Gateway, ...]:
    """The gateways of a room, those paired that are nearest to being opposite to each other."""

    def nearest(k: int) -> int:
        return min(
            range(len(found)),
            key=lambda other: _apart(found[other].bearing, found[k].bearing + 180),
        )

    pairs = {
        k: other
        for k in range(len(found))
        if k == nearest(other := nearest(k)) and _bend(found, k, other) <= STRAIGHT
    }
    return tuple(replace(gateway, opposite=pairs.get(k)) for k, gateway in enumerate(found))


def _bend(found: Sequence[Gateway], one: int, other: int) -> float:
    return _apart(found[one].bearing, found[other].bearing + 180)


class _Reader:
    """Reads the XML of a plan, and says what is wrong with it."""

    def __init__(self, where: str) -> None:
        self.where = where

    def plan(self, name: str, building: Element) -> Plan:
        scale = self.scale(building)
        spaces = building.findall("floor/spaces/space")
        if not spaces:
            raise self.wrong("floor/spaces", "at least one space", None)
        rooms = tuple(self.room(space, f"space[{i}]", scale) for i, space in enumerate(spaces))
        numbers = {room.name: i for i, room in enumerate(rooms)}
        if len(numbers) < len(rooms):
            raise self.wrong("space", "an id for each space that no other has", None)
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
        return Plan(name, rooms, doors)

    def wrong(self, name: str, expected: str, value: object) -> SimulatorError:
        return SimulatorError(
            f"{self.where}: {name}: expected {expected}, got {'none' if value is None else brief(value)}; mend it"
        )

    def scale(self, building: Element) -> float:
        """Metres that a pixel is long."""
        pixels = self.number(
            building.findtext("scale/represented_distance/value"), "scale/represented_distance"
        )
        length = self.number(building.findtext("scale/real_distance/value"), "scale/real_distance")
        unit = building.findtext("scale/real_distance/um")
        if unit not in METRES:
            raise self.wrong("scale/real_distance/um", " or ".join(METRES), unit)
        if not (pixels > 0 and length > 0):
            raise self.wrong("scale", "distances above 0", [pixels, length])
        return METRES[unit] * length / pixels

    def room(self, space: Element, where: str, scale: float) -> Room:
        if not (name := space.get("id")):
            raise self.wrong(f"{where}.id", "a text", name)
        corners = tuple(
            self.point(point, where, scale) for point in space.findall("bounding_polygon/point")
        )
        centre = self.point(space.find("centroid/point"), f"{where}.centroid", scale)
        return Room(name, (space.findtext("labels/label") or "").strip(), centre, corners)

    def pair(
        self, portal: Element, numbers: Mapping[str, int], here: int, where: str
    ) -> tuple[int, int]:
        names = [target.text or "" for target in portal.findall("target/id")]
        rooms = sorted({numbers[name] for name in names if name in numbers})
        if len(names) != 2 or len(rooms) != 2 or here not in rooms:
            raise self.wrong(f"{where}.target", "the ids of this space and of another one", names)
        return rooms[0], rooms[1]

    def middle(self, line: Element, scale: float) -> Point:
        ends = [self.point(point, "linesegment", scale) for point in line.findall("point")]
        if not ends:
            raise self.wrong("linesegment", "points", None)
        return _mean(ends)

    def point(self, point: Element | None, where: str, scale: float) -> Point:
        """A point in metres. In drawings y grows downwards, and here it grows to the north."""
        if point is None:
            raise self.wrong(f"{where}.point", "x and y", None)
        return scale * self.number(point.get("x"), f"{where}.x"), -scale * self.number(
            point.get("y"), f"{where}.y"
        )

    def number(self, text: str | None, where: str) -> float:
        try:
            value = float(text or "")
        except ValueError:
            raise self.wrong(where, "a number", text) from None
        if not abs(value) <= 1e6:
            raise self.wrong(where, "a number of at most 1,000,000", text)
        return value


def _matched(here: Sequence[Point], there: Sequence[Point]) -> Iterator[Point]:
    """The doors between two rooms, each of which is drawn on both sides of the wall. A door that is drawn on one side only is there, too."""
    distances = np.array([[math.dist(a, b) for b in there] for a in here]).reshape(
        len(here), len(there)
    )
    first, second = linear_sum_assignment(distances)
    yield from (_mean([here[i], there[j]]) for i, j in zip(first, second, strict=True))
    yield from (point for i, point in enumerate(here) if i not in first)
    yield from (point for j, point in enumerate(there) if j not in second)


def _mean(points: Sequence[Point]) -> Point:
    return math.fsum(x for x, _ in points) / len(points), math.fsum(y for _, y in points) / len(
        points
    )
