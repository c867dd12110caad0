"""Simulates drives from room to room of a floor plan.

Rooms are places, and their doors are gateways.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from simulator.errors import SimulatorError
from simulator.plans import APART, Plan
from simulator.robot import reported
from ssh_abduction.data.checks import a_number, a_whole_number, an_instance
from ssh_abduction.data.odometry import Odometry, Pose, displacement_between
from ssh_abduction.data.star import Gateway as Sighted
from ssh_abduction.data.trace import Action, Step, Trace

# Views round the directions of doors to this many degrees.
COARSE = 45
# Bearings are rounded to this many digits, twice. Rounding may move a bearing by ROUNDED degrees.
DIGITS, ROUNDED = 3, 0.001
# Largest number of actions of a tour, so that its trace fits into memory.
MOST_STEPS = 10_000_000


@dataclass(frozen=True)
class Stand:
    """The distinctive state of the robot: a room and a heading."""

    room: int  # index of the room
    gateway: int  # index of the gateway of the room that the robot faces or has behind it
    # Whether the robot faces the gateway. Otherwise, the gateway is behind it.
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
    an_instance("plan", plan, Plan, SimulatorError, mend="take Plan.load")
    a_whole_number("steps", steps, SimulatorError, 0, MOST_STEPS, what="a number of actions")
    a_whole_number("seed", seed, SimulatorError)
    if odometry is not None:
        mend = "make one with Odometry(), or leave it out"
        an_instance("odometry", odometry, Odometry, SimulatorError, mend=mend)
    a_number("scale", scale, SimulatorError, -1, 1, what="a share")
    a_number("bend", bend, SimulatorError, -1, 1, what="radians per metre")
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

    >>> from simulator.plans import Door, Plan, Room
    >>> from simulator.plan_tours import Floor
    >>> rooms = Room("a", "", (0, 0)), Room("b", "", (0, 9))
    >>> floor = Floor(Plan("two", rooms, (Door((0, 1), (0, 5)),)))
    >>> floor.sight(floor.start).view, [action.name for action in floor.ends(floor.start)]
    ('1 door: 0', ['travel'])
    """

    # The plan. It should come from `Plan.told_apart`, so that doors can be distinguished.
    plan: Plan
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
            round((gateway.bearing - heading) % 360, DIGITS) % 360
            for gateway in self.plan.gateways[stand.room]
        )

    def sighted(self, stand: Stand, chance: np.random.Generator) -> tuple[Sighted, ...]:
        """The star with random errors: each bearing is off by at most `spread` degrees, rounded."""
        found, most = self.plan.gateways[stand.room], max(self.spread - ROUNDED, 0)
        off = chance.uniform(-most, most, len(found)).tolist()
        bearings = [
            round(bearing + wrong, DIGITS) % 360
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
