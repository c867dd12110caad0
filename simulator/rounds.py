"""Simulates rounds through buildings: a robot drives from room to room and logs scans.

A round begins and ends in one room, the robot's home. The robot leaves each room by the door that
it has passed least often, until the round is long enough. Then it goes home through as few doors as
possible. In a room with one door, it drives to the middle and turns back. In other rooms, it takes
the direct route from door to door.

A `Building` is a floor plan with walls. A plan draws each room as a polygon and each door as a
point on its outline. So the walls are the outlines of all rooms. A door is an opening of DOOR
metres in the outlines of both of its rooms. If a corner would narrow the opening, it is moved along
the wall. If the outlines of the two rooms are apart, because the wall is thick, the sides of the
opening (its jambs) are walls, too.
"""

from __future__ import annotations

import cmath
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import networkx as nx
import numpy as np
from numpy.typing import NDArray
from scipy.stats import mode
from skimage.measure import points_in_poly

from simulator.cruise import CELL, FreeSpace, drive_along
from simulator.driver import Driver
from simulator.errors import SimulatorError
from simulator.plans import Door, Plan, Room
from simulator.robot import EVERY, Body, Laser, Odometer, RecordedDrive, Recorder, SimulatedRobot
from simulator.world import Array, World, distances_to
from ssh_abduction.data.checks import a_number, a_whole_number
from ssh_abduction.data.words import counted

# Width of a door, and its smallest distance from the corners of its rooms, in metres.
DOOR, OFF = 1.0, 0.1
# Walls within this many metres before and behind a door are removed, since they would close it.
DEPTH = 0.25
# Walls that are shorter than this, in metres, are points.
TINY = 1e-6
Point = tuple[float, float]
# A room, and the doors by which the robot enters and leaves. None instead of a door means the
# middle of the room.
Within = tuple[int, int | None, int | None]
# Length of a round in metres before the robot goes home.
METRES = 200.0
# Metres from the wall at which a passage through a door begins and ends.
APPROACH = 0.45
# The middle of a room is at least this many metres from walls, if the room is large enough.
MIDDLE = 0.8
# The scanner in buildings, with the reach of those in recorded logs.
LASER = Laser(noise=0.01, reach=30.0)


class Rooms:
    """Plans routes in a building: through free space in each room, and straight through doors.

    The radius of the robot is in metres. Rooms and doors are known by their indices. `graph` has
    rooms as nodes, and as edges the doors that are wide enough for the robot and can be reached in
    both rooms. `middles` has the point (x, y), in metres, that the robot uses as the middle of each
    room.
    """

    def __init__(self, building: Building, radius: float) -> None:
        self.building = building
        self.space = FreeSpace.of(building.segments, radius)  # doors are open
        self._shut = self.space.drawn(
            np.array([opening.threshold for opening in building.openings]).reshape(-1, 4)
        )
        self._sides = [_sides(building, number) for number in range(len(building.openings))]
        self._ways: dict[Within, Array] = {}
        self.middles: dict[int, Point] = {}
        # A door becomes an edge if it is in the main connected region of both of its rooms.
        fits = [number for number in range(len(building.openings)) if self._fits(number)]
        reached: Counter[int] = Counter()
        for room, drawn in enumerate(building.plan.rooms):
            doors = [number for number in fits if room in self._sides[number]]
            if not doors:
                continue
            part = self._part(room)
            regions = part.region(np.array([self._sides[number][room] for number in doors]))
            if regions.any():
                region = int(mode(regions[regions > 0]).mode)
                self.middles[room] = part.nearest(region, drawn.centre, MIDDLE)
                reached.update(np.array(doors)[regions == region].tolist())
        self.graph = nx.MultiGraph()
        self.graph.add_edges_from(
            (*building.plan.doors[number].rooms, number) for number in fits if reached[number] == 2
        )

    def way(self, room: int, start: int | None, goal: int | None) -> Array:
        """Plan the route, (n, 2) metres, within a room from one door to another.

        Room and doors are indices. None is the middle of the room.
        """
        if (room, start, goal) not in self._ways:
            ends = [
                self.middles[room] if door is None else self._sides[door][room]
                for door in (start, goal)
            ]
            way = self._part(room).way(*ends)
            assert way is not None  # Both are in one region.
            self._ways[room, start, goal] = way
        return self._ways[room, start, goal]

    def behind(self, room: int, door: int) -> int:
        """Find the room on the other side of a door of a room."""
        return next(other for other in self._sides[door] if other != room)

    def through(self, door: int, room: int) -> Array:
        """Plan the straight route from a room through the middle of a door: (n, 2), metres."""
        return _line(self._sides[door][room], self._sides[door][self.behind(room, door)])

    def _fits(self, door: int) -> bool:
        """Whether the robot can drive straight through a door."""
        if len(self._sides[door]) < 2:
            return False
        line = _line(*self._sides[door].values())
        return bool((self.space.part(line).off(line) >= self.space.least).all())

    def _part(self, room: int) -> FreeSpace:
        """The part of the building around a room, with all doors shut."""
        sides = [sides[room] for sides in self._sides if room in sides]
        return self.space.part(
            np.vstack([np.array(self.building.plan.rooms[room].polygon), *sides]), self._shut
        )


def _sides(building: Building, number: int) -> dict[int, Point]:
    """Where the robot begins and ends to drive through a door, by room; empty if unclear."""
    opening, door = building.openings[number], building.plan.doors[number]
    sides = [opening.point(0.0, side * (opening.depth / 2 + APPROACH)) for side in (-1, 1)]
    here, there = (building.plan.rooms[room].polygon for room in door.rooms)
    for one, other in (sides, sides[::-1]):
        if holds(here, one) > holds(here, other) or holds(there, other) > holds(there, one):
            return {door.rooms[0]: one, door.rooms[1]: other}
    return {}


def holds(polygon: Sequence[Point], point: Point) -> bool:
    """Check whether a polygon contains a point."""
    return bool(points_in_poly([point], polygon)[0])


def _line(start: Point, goal: Point) -> Array:
    """A straight route from start to goal: (n, 2), metres."""
    return np.linspace(start, goal, 1 + math.ceil(math.dist(start, goal) / CELL))


@dataclass(frozen=True, eq=False)
class Round:
    """A round through rooms, which ends where it began."""

    way: Array = field(repr=False)  # (n, 2) points of the route in metres
    rooms: NDArray[np.intp] = field(repr=False)  # (n,) index of the room of each point of the route
    # For each passage through a door, in order: the index in `way` of the point in the door, and
    # the index of the door.
    doors: tuple[tuple[int, int], ...]

    @classmethod
    def drawn(cls, rooms: Rooms, metres: float, chance: np.random.Generator) -> Round:
        """Draw a round at random. After this many metres the robot goes home.

        Raises SimulatorError if no two rooms are connected by doors that fit the robot.
        """
        parts = sorted(
            nx.connected_components(rooms.graph), key=lambda part: (-len(part), min(part))
        )
        if not parts:
            plan = rooms.building.plan
            raise SimulatorError(
                f"{plan.name}: expected rooms with doors between them through which the robot "
                "fits, got none; take another plan, or a smaller robot"
            )
        home = int(chance.choice(sorted(parts[0])))
        ways: list[Array] = []
        labels: list[int] = []
        doors: list[tuple[int, int]] = []
        for room, start, goal in _legs(rooms, home, metres, chance):
            within = rooms.way(room, start, goal)
            ways.append(within)
            labels += [room] * len(within)
            if goal is not None:
                # Half of the points of a passage are before the door, half behind it.
                through = rooms.through(goal, room)
                middle = len(through) // 2
                doors.append((len(labels) + middle, goal))
                ways.append(through)
                labels += [room] * middle + [rooms.behind(room, goal)] * (len(through) - middle)
        return cls(np.vstack(ways), np.array(labels), tuple(doors))


def _legs(rooms: Rooms, home: int, metres: float, chance: np.random.Generator) -> Iterator[Within]:
    """Draw the legs of a round: a room, and the doors in and out (None: the middle of the room)."""
    passed: Counter[int] = Counter()
    room, came, done = home, None, 0.0
    while True:
        doors = sorted(number for _, _, number in rooms.graph.edges(room, keys=True))
        onward = [door for door in doors if door != came]
        if came is not None and not onward:
            yield room, came, None
            done += _length(rooms.way(room, came, None))
            came = None
        if done >= metres:
            break
        least = min(passed[door] for door in onward or doors)
        goal = int(chance.choice([door for door in onward or doors if passed[door] == least]))
        yield room, came, goal
        done += _length(rooms.way(room, came, goal)) + _length(rooms.through(goal, room))
        passed[goal] += 1
        room, came = rooms.behind(room, goal), goal
    # Go home through as few doors as possible.
    for here, there in pairwise(nx.shortest_path(rooms.graph, room, home)):
        goal = min(rooms.graph[here][there])
        yield here, came, goal
        came = goal
    yield home, came, None


def _length(way: Array) -> float:
    return float(np.hypot(*np.diff(way, axis=0).T).sum())


def record_plan(
    plan: Plan,
    tours: int = 1,
    seed: int = 0,
    *,
    metres: float = METRES,
    body: Body | None = None,
    odometer: Odometer | None = None,
    every: float = EVERY,
) -> RecordedDrive:
    """Drive rounds through a building, and return the scans with odometry and truth.

    Args:
        plan: The floor plan, with walls, doors and rooms.
        tours: Number of times that the same round is driven.
        seed: Seed of the round and of the noise.
        metres: Length of the round after which the robot goes home.
        body: Size and errors of the robot; None for `Body()`.
        odometer: Noise of the odometry in the log.
        every: Metres between scans. In turns there is a scan every ten degrees.

    Raises:
        SimulatorError: No two rooms are connected, or a number is out of range.
    """
    a_whole_number("tours", tours, SimulatorError, 1)
    a_number("metres", metres, SimulatorError, above=0, what="a length", mend="200 is usual")
    body = body or Body()
    rooms = Rooms(Building.of(plan), body.radius)
    chance, motion = (np.random.default_rng([seed, k]) for k in (0, 1))
    tour = Round.drawn(rooms, metres, chance)
    world = rooms.building.world()
    x, y = tour.way[0].tolist()
    recorder = Recorder(every)
    robot = SimulatedRobot(body, (x, y, float(chance.uniform(-math.pi, math.pi))), motion)
    driver = Driver(world, robot, LASER, motion, recorder=recorder)
    recorder.note(world, robot.pose)
    # For each scan, the point of the round that was reached. Points are counted on from one round
    # to the next.
    come = [0]
    for number in range(tours):
        for at in drive_along(driver, rooms.space, tour.way):
            come += [number * len(tour.way) + at] * (recorder.taken - len(come))
    drive = recorder.drive(
        f"{plan.name}, {counted(tours, 'tours')}, seed {seed}", LASER, odometer or Odometer(), seed
    )
    come += come[-1:] * (len(drive) - len(come))
    # The truth about each scan, each passage and each door.
    size = len(tour.way)
    return drive.judged(
        {_name(room): middle for room, middle in rooms.middles.items()},
        [_name(int(tour.rooms[at % size])) for at in come],
        crossings=[
            {"door": f"door {door}", "scan": int(np.searchsorted(come, begin + at))}
            for begin in range(0, tours * size, size)
            for at, door in tour.doors
        ],
        doors={
            f"door {number}": {
                "rooms": [_name(one), _name(other)],
                "at": [round(v, 4) for v in rooms.building.openings[number].middle],
            }
            for one, other, number in sorted(rooms.graph.edges(keys=True), key=lambda edge: edge[2])
        },
    )


def _name(room: int) -> str:
    """The name of a room in the truth."""
    return f"room {room}"


@dataclass(frozen=True)
class Opening:
    """A door as an opening in a wall."""

    middle: tuple[float, float]  # (x, y) in metres
    along: float  # direction of the wall in radians
    width: float  # width of the opening in metres
    depth: float  # thickness of the wall: metres from the outline of one room to that of the other

    def frame(self, points: Array) -> Array:
        """Convert points, (n, 2) in metres, to metres along and across the wall, from the middle.

        Across counts to the left.
        """
        turned = ((points - np.array(self.middle)) @ (1, 1j)) * np.exp(-1j * self.along)
        return np.column_stack([turned.real, turned.imag])

    def point(self, along: float, across: float) -> tuple[float, float]:
        """Compute the point (x, y) at a distance in metres along the wall, and across it.

        Along counts from the middle, and across to the left of the direction of the wall.
        """
        point = complex(*self.middle) + complex(along, across) * cmath.rect(1, self.along)
        return point.real, point.imag

    @property
    def threshold(self) -> Array:
        """The segment across the opening, from side to side: (1, 4), metres."""
        return np.array([[*self.point(-self.width / 2, 0.0), *self.point(self.width / 2, 0.0)]])


@dataclass(frozen=True)
class Building:
    """A plan with walls and openings."""

    plan: Plan
    segments: Array = field(repr=False)  # (n, 4) walls in metres
    # The opening of each door, in the order of the plan.
    openings: tuple[Opening, ...] = field(repr=False)

    @classmethod
    def of(cls, plan: Plan) -> Building:
        """Make the building of a plan. Raises SimulatorError if a room has no outline."""
        for number, room in enumerate(plan.rooms):
            if (corners := len(set(room.polygon))) < 3:
                raise SimulatorError(
                    f"{plan.name}: room {number}: expected a bounding_polygon of three points "
                    f"or more, got {corners}; draw its outline"
                )
        walls = np.vstack([_outline(room) for room in plan.rooms])
        openings = tuple(_opening(plan, door) for door in plan.doors)
        for opening in openings:
            walls = _cut(walls, opening)
        return cls(plan, np.vstack([walls, *[_jambs(opening) for opening in openings]]), openings)

    def world(self) -> World:
        """Make a world with the walls of the building."""
        return World(self.plan.name, self.segments, angles="any")


def _outline(room: Room) -> Array:
    """The walls of a room: (n, 4), metres."""
    corners = np.array(room.polygon)
    walls = np.hstack([corners, np.roll(corners, -1, axis=0)])
    return np.asarray(walls[np.hypot(*(walls[:, 2:] - walls[:, :2]).T) > TINY])


def _opening(plan: Plan, door: Door) -> Opening:
    """Make the opening of a door in the nearest walls of its two rooms."""
    outlines = [_outline(plan.rooms[room]) for room in door.rooms]
    walls = [walls[int(distances_to(walls, door.position).argmin())] for walls in outlines]
    longest = max(walls, key=lambda wall: float(np.hypot(*(wall[2:] - wall[:2]))))
    way = longest[2:] - longest[:2]
    flat = Opening(door.position, math.atan2(way[1], way[0]), DOOR, 0.0)
    # Shift the door along the wall into the span that both rooms share, and narrow it if necessary.
    spans = [_span(flat, walls) for walls in outlines]
    low, high = max(low for low, _ in spans) + OFF, min(high for _, high in spans) - OFF
    width = min(DOOR, high - low) if high > low else DOOR
    shift = float(np.clip(0.0, low + width / 2, high - width / 2)) if high > low else 0.0
    one, other = (_across(flat, wall, shift) for wall in walls)
    return Opening(flat.point(shift, (one + other) / 2), flat.along, width, abs(one - other))


def _span(flat: Opening, walls: Array) -> tuple[float, float]:
    """Find where a straight wall with a door begins and ends, in metres from the door."""
    # (n, 2 ends, along and across)
    ends = np.stack([flat.frame(walls[:, :2]), flat.frame(walls[:, 2:])], axis=1)
    way = ends[:, 1] - ends[:, 0]
    level = (np.abs(ends[:, :, 1]) < DEPTH).all(1) & (np.abs(way[:, 1]) < np.abs(way[:, 0]))
    stretches: list[tuple[float, float]] = []
    for wall in sorted((float(min(wall)), float(max(wall))) for wall in ends[level, :, 0]):
        if stretches and wall[0] <= stretches[-1][1] + OFF:
            stretches[-1] = stretches[-1][0], max(stretches[-1][1], wall[1])
        else:
            stretches.append(wall)
    return min(stretches, key=lambda stretch: max(stretch[0], -stretch[1]), default=(0.0, 0.0))


def _across(flat: Opening, wall: Array, along: float) -> float:
    """Measure how far left of a door's axis a wall is, `along` metres from the door's middle."""
    ends = flat.frame(wall.reshape(2, 2))
    return float(np.interp(along, *ends[np.argsort(ends[:, 0])].T))


def _cut(walls: Array, opening: Opening) -> Array:
    """Remove the parts of walls within the rectangle of an opening (Liang and Barsky)."""
    starts, ends = opening.frame(walls[:, :2]), opening.frame(walls[:, 2:])
    half = np.array([opening.width / 2, opening.depth / 2 + DEPTH])
    way = ends - starts
    # For each axis: the shares of a wall's length at which it enters and leaves the rectangle.
    way = np.where(np.abs(way) < TINY, TINY, way)
    shares = np.sort([(-half - starts) / way, (half - starts) / way], axis=0)
    enter, leave = shares[0].max(1).clip(0, 1), shares[1].min(1).clip(0, 1)
    hit = enter < leave
    way = walls[:, 2:] - walls[:, :2]
    before = np.hstack([walls[:, :2], walls[:, :2] + enter[:, None] * way])[hit & (enter > 0)]
    after = np.hstack([walls[:, :2] + leave[:, None] * way, walls[:, 2:]])[hit & (leave < 1)]
    return np.vstack([walls[~hit], before, after])


def _jambs(opening: Opening) -> Array:
    """The two sides of an opening in a thick wall, (2, 4); none, (0, 4), in a thin wall."""
    if opening.depth < 0.02:
        return np.empty((0, 4))
    half, deep = opening.width / 2, opening.depth / 2
    return np.array(
        [[*opening.point(side, -deep), *opening.point(side, deep)] for side in (-half, half)]
    )
