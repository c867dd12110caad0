"""Drives from room to room of a floor plan, with views, stars and displacements.

A place is a room, and the robot stands in its middle. A gateway is a door as seen from there.
`tour` simulates a drive.

The robot leaves a room through the door that it faces, and enters the next room with that door
behind it. If another door is then straight ahead, to within STRAIGHT degrees, the two doors are
opposite. The robot faces that door, and the path goes on through both. Otherwise the robot faces no
door, and the path ends. So a distinctive state (dstate) is a room with a door that the robot faces,
or with a door behind it.

On tours of 300 steps, the true maps of 8 of the 17 school plans break the boundary axioms (about
right and left), which are made for straight streets. The true map of each tour satisfies all other
axioms.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import networkx as nx
import numpy as np
from instances import reported

from simulator.errors import SimulatorError
from simulator.plans import Plan
from ssh_abduction.data.odometry import Odometry, Pose, displacement_between
from ssh_abduction.data.star import Gateway as Sighted
from ssh_abduction.data.trace import Action, Step, Trace

Leg = tuple[int, int]  # A room that the robot leaves, and the door that it goes through.
# Two doors of a room are opposite if the path through its middle bends by at most this many
# degrees.
STRAIGHT = 20.0
# The robot cannot distinguish doors within this many degrees. On a tour, only one of them is open.
APART = 3.0
# Views round the directions of doors to this many degrees.
COARSE = 45
# Bearings are rounded to this many digits, twice. Rounding may move a bearing by ROUNDED degrees.
DECIMALS, ROUNDED = 3, 0.001


@dataclass(frozen=True)
class RoomGateway:
    """A door as seen from the middle of a room."""

    door: int  # index of the door in the plan
    to: int  # index of the room behind the door
    bearing: float  # direction from the middle of the room, in degrees clockwise from north (+y)
    # Index of the opposite gateway among those of the same room; None without one.
    opposite: int | None = None


@dataclass(frozen=True)
class RoomPlan(Plan):
    """A floor plan with the gateways of its rooms, and the paths through them."""

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
        parts: list[list[int]] = [sorted(part) for part in nx.connected_components(self.graph)]
        parts.sort(key=lambda part: (-len(part), part))
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

    def told_apart(self, degrees: float = APART) -> RoomPlan:
        """Copy the plan without doors that look too close together from the middle of a room.

        The doors nearest to the middles of their rooms are kept.

        Args:
            degrees: Smallest angle between two doors of a room.
        """

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

    bearings = np.array([gateway.bearing for gateway in found])
    # Degrees by which two gateways, (n, n), are not opposite.
    off = np.abs(np.remainder(bearings[:, None] - bearings, 360) - 180)
    pairs = {
        k: other
        for k, other in enumerate(off.argmin(axis=1).tolist() if len(found) else [])
        if off[other].argmin() == k and off[k, other] <= STRAIGHT
        if found[k].to != found[other].to
    }
    return tuple(replace(gateway, opposite=pairs.get(k)) for k, gateway in enumerate(found))


@dataclass(frozen=True)
class Stand:
    """The distinctive state of the robot: a room and a heading."""

    room: int  # index of the room
    gateway: int  # index of the gateway of the room that the robot faces or has behind it
    # Whether the robot faces the gateway. Otherwise, the gateway is behind it.
    faces: bool = True


def tour(
    plan: RoomPlan,
    steps: int,
    seed: int = 0,
    odometry: Odometry | None = None,
    *,
    scale: float = 0.0,
    bend: float = 0.0,
    apart: float = APART,
) -> Trace:
    """Simulate a drive from room to room, with views, stars and displacements.

    In each room, the robot turns to the door that it has passed least often, and travels through
    it. Ties are broken at random. It goes back through the same door only in a dead end. A view is
    the number of doors and their rough directions. Many rooms have the same view. A star is the
    bearings of all doors. A turn has a side and a number: "left to gateway 2" ends at the second
    gateway on the left. A turn to the door by which the robot came, or to the door opposite the one
    that it faces, is "around".

    Args:
        plan: The floor plan.
        steps: Number of actions.
        seed: Seed of the drive and of the noise.
        odometry: Noise of the displacements, which the trace also states; None for exact
            displacements.
        scale: Share by which reported distances are too long.
        bend: Radians a metre by which the reported heading drifts to the left.
        apart: Smallest angle between two doors of a room in degrees. Doors that are closer together
            are removed (`Plan.told_apart`). Bearings of doors are off by at most a quarter of this
            angle, so that two doors never look like one.

    Returns:
        A trace. The truth of each step has dstate, place, path, direction and pose.

    Raises:
        SimulatorError: No two rooms are connected.
    """
    plan = plan.told_apart(apart)
    if len(plan.connected) < 2:
        raise SimulatorError(
            f"{plan.name}: expected rooms with doors between them, got none that are "
            "connected; take another plan"
        )
    # Separate generators, so that the noise does not change where the robot goes.
    walk, drawn, sighted = (np.random.default_rng([seed, k]) for k in range(3))
    logged: list[Step] = []
    before: Pose | None = None
    floor = Floor(plan, apart / 4)
    for stand, action in floor.drive(steps, walk):
        pose = floor.pose(stand)
        moved = None if before is None else displacement_between(before, pose)
        if moved is not None and odometry is not None:
            moved = reported(moved, odometry, drawn, scale=scale, bend=bend)
        view, star = _view(floor.bearings(stand)), floor.sighted(stand, sighted)
        logged.append(Step(view, action, star, moved, truth=floor.truth(stand, pose)))
        before = pose
    return Trace(tuple(logged), name=f"{plan.name}, {steps} steps, seed {seed}", odometry=odometry)


@dataclass(frozen=True)
class Floor:
    """A plan as a world in which a program can drive a robot action by action.

    >>> from plan_tours import Floor, RoomPlan
    >>> from simulator.plans import Door, Room
    >>> rooms = Room("a", "", (0, 0)), Room("b", "", (0, 9))
    >>> floor = Floor(RoomPlan("two", rooms, (Door((0, 1), (0, 5)),)))
    >>> floor.sight(floor.start).view, [action.name for action in floor.ends(floor.start)]
    ('1 door: 0', ['travel'])
    """

    # The plan. It should come from `Plan.told_apart`, so that doors can be distinguished.
    plan: RoomPlan
    # Error of bearings that stars state, in degrees. The bearings themselves are exact.
    spread: float = APART / 4

    @property
    def start(self) -> Stand:
        """The state in which the robot begins: it faces the first gateway of a connected room."""
        return Stand(self.plan.connected[0], 0)

    def sight(self, stand: Stand) -> Step:
        """Make a step with what the robot sees in a state: view and star, without truth."""
        bearings = self.bearings(stand)
        return Step(_view(bearings), star=self._star(stand, bearings))

    def ends(self, stand: Stand) -> dict[Action, Stand]:
        """List what the robot can do in a state, and the state that each action leads to.

        An action is a turn to another gateway, or a travel through the gateway ahead.
        """
        return dict(
            next(self.way_through(stand, goal))
            for goal in range(len(self.plan.gateways[stand.room]))
        )

    def way_through(self, stand: Stand, goal: int) -> Iterator[tuple[Action, Stand]]:
        """Yield the actions that lead through the gateway `goal` of the room.

        They are a turn, unless the gateway is ahead, and a travel. Each comes with the state
        after it.
        """
        if stand != (turned := Stand(stand.room, goal)):
            yield self._turn(stand, goal), turned
        gateway = self.plan.gateways[stand.room][goal]
        back = next(
            k for k, g in enumerate(self.plan.gateways[gateway.to]) if g.door == gateway.door
        )
        ahead = self.plan.gateways[gateway.to][back].opposite
        after = Stand(gateway.to, back, False) if ahead is None else Stand(gateway.to, ahead)
        yield Action.of("travel"), after

    def drive(
        self, steps: int, chance: np.random.Generator
    ) -> Iterator[tuple[Stand, Action | None]]:
        """Drive at random. Yield each state and the next action, which is None for the last one."""
        room = int(chance.choice(self.plan.connected))
        stand = Stand(room, int(chance.integers(len(self.plan.gateways[room]))))
        came_by: int | None = None
        passed: Counter[int] = Counter()
        while True:
            found = self.plan.gateways[stand.room]
            # Go back only in a dead end.
            choices = [k for k, g in enumerate(found) if g.door != came_by or len(found) == 1]
            least = min(passed[found[k].door] for k in choices)
            goal = int(chance.choice([k for k in choices if passed[found[k].door] == least]))
            for action, after in self.way_through(stand, goal):
                if steps == 0:
                    yield stand, None
                    return
                yield stand, action
                stand, steps = after, steps - 1
            came_by = found[goal].door
            passed[came_by] += 1

    def _turn(self, stand: Stand, goal: int) -> Action:
        """Make the action of a turn to a gateway of the room.

        The number in the action counts the gateways on the side of the turn, up to the one where
        the turn ends. The gateway that the robot faces is not counted.
        """
        found = self.plan.gateways[stand.room]
        if goal == (found[stand.gateway].opposite if stand.faces else stand.gateway):
            return Action.of("around")
        bearings = self.bearings(stand)
        clockwise = sorted(bearing for bearing in bearings if bearing > 0)
        side, order = ("right", clockwise) if bearings[goal] < 180 else ("left", clockwise[::-1])
        number = order.index(bearings[goal]) + 1
        return Action.of(
            {"name": f"{side} to gateway {number}", "kind": "turn", "turn": side, "gateway": number}
        )

    def heading(self, stand: Stand) -> float:
        """The heading of the robot in degrees clockwise from north."""
        return self.plan.gateways[stand.room][stand.gateway].bearing + (0 if stand.faces else 180)

    def bearings(self, stand: Stand) -> tuple[float, ...]:
        """The bearings of the room's gateways, in its order, in degrees clockwise from ahead."""
        heading = self.heading(stand)
        return tuple(
            round((gateway.bearing - heading) % 360, DECIMALS) % 360
            for gateway in self.plan.gateways[stand.room]
        )

    def sighted(self, stand: Stand, chance: np.random.Generator) -> tuple[Sighted, ...]:
        """The star with random errors: each bearing is off by at most `spread` degrees, rounded."""
        found, most = self.plan.gateways[stand.room], max(self.spread - ROUNDED, 0)
        off = chance.uniform(-most, most, len(found)).tolist()
        bearings = [
            round(bearing + wrong, DECIMALS) % 360
            for bearing, wrong in zip(self.bearings(stand), off, strict=True)
        ]
        return self._star(stand, bearings)

    def _star(self, stand: Stand, bearings: Sequence[float]) -> tuple[Sighted, ...]:
        """The star of a room: its gateways, sorted by bearing, each with its opposite gateway."""
        found = self.plan.gateways[stand.room]
        order = sorted(range(len(found)), key=lambda k: bearings[k])
        opposite = [found[k].opposite for k in order]
        return tuple(
            Sighted(bearings[k], self.spread, None if other is None else order.index(other))
            for k, other in zip(order, opposite, strict=True)
        )

    def pose(self, stand: Stand) -> Pose:
        """The true pose, in metres and radians."""
        heading = math.remainder(math.radians(90 - self.heading(stand)), math.tau)
        return (*self.plan.rooms[stand.room].centre, heading)

    def truth(self, stand: Stand, pose: Pose) -> dict[str, object]:
        """The truth about a step: dstate, place, path, direction and pose."""
        door = self.plan.gateways[stand.room][stand.gateway].door
        path, direction = self.plan.courses[stand.room, door]
        place = f"room {stand.room}"
        return {
            "dstate": f"{place}, {'at' if stand.faces else 'from'} door {door}",
            "place": place,
            "path": f"path {path}",
            "direction": direction if stand.faces else -direction,
            "pose": [round(v, 5) for v in pose],
        }


def _view(bearings: Sequence[float]) -> str:
    """The view: a text with the number of doors and their rough directions."""
    rough = sorted({round(bearing / COARSE) * COARSE % 360 for bearing in bearings})
    return f"{len(bearings)} door{'s' * (len(bearings) > 1)}: {' '.join(map(str, rough))}"
