"""Worlds in which simulated robots drive: walls, clutter that may move between tours, and a route.

A world may also state its true dstates (distinctive states: places, each with a heading).

A world is a JSON file that a user can write (docs/reference/worlds.md), or an occupancy map of ROS
(YAML file and image).

>>> from simulator.world import World
>>> World.named("notched-rectangle").segments.shape[1]
4
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.resources import files
from pathlib import Path
from typing import get_args

import numpy as np

from simulator.errors import SimulatorError
from simulator.occupancy import FARTHEST, read_occupancy
from simulator.world_files import (
    ACTIONS,
    NEAREST,
    Angles,
    Array,
    Clutter,
    Lift,
    Point,
    TrueDState,
    WorldReader,
)
from ssh_abduction.data.checks import (
    a_number,
    a_path,
    a_text,
    all_instances,
    an_instance,
    an_object,
    numbers,
    one_of,
)
from ssh_abduction.data.errors import brief, named, printable
from ssh_abduction.data.files import parse_json, read_file

__all__ = ["Clutter", "Lift", "TrueDState", "World", "checked_segments", "distances_to", "pose_of"]

# Largest size of a world file in bytes.
LARGEST = 64 * 2**20


def checked_segments(name: str, value: object) -> Array:
    """Return a value if it is an array of segments, of shape (n, 4), finite and not empty.

    Raises SimulatorError, which names the value.
    """
    if (
        isinstance(value, np.ndarray)
        and value.dtype.kind in "fiu"
        and value.shape[1:] == (4,)
        and len(value)
        and np.isfinite(value).all()
    ):
        return value
    raise SimulatorError(
        f"{name}: expected an array of segments, (n, 4) in metres, got {brief(value)}; make "
        "one with numpy.array"
    )


def pose_of(name: str, value: object) -> tuple[float, float, float]:
    """Return a value if it is a pose (x, y, heading), in metres and radians.

    Raises SimulatorError, which names the value.
    """
    x, y, heading = numbers(
        name, value, SimulatorError, 3, "x, y and heading, in metres and radians"
    )
    return x, y, heading


def distances_to(walls: Array, point: Point) -> Array:
    """Measure the distance from a point to each of n walls: (n,), metres."""
    starts, along = walls[:, :2], walls[:, 2:] - walls[:, :2]
    squares = np.maximum((along**2).sum(1), 1e-12)
    share = np.clip(((np.array(point) - starts) * along).sum(1) / squares, 0, 1)
    return np.asarray(np.hypot(*(starts + share[:, None] * along - np.array(point)).T))


@dataclass(frozen=True)
class World:
    """A world: walls and clutter, and the start and route of a robot.

    Attributes:
        name: Name of the world.
        segments: (n, 4) walls: x1, y1, x2, y2 in metres.
        clutter: Polygons that may move between tours.
        start: Start pose (x, y, heading) in metres and radians.
        route: Actions of one tour, or places to drive to. A tour ends at its start.
        reach: Distance in metres at which the robot follows a wall: half the width of a corridor.
        dstates: The true dstates, for evaluation only; empty if unknown.
        angles: How streets meet: "right" for right angles, or "any". It selects the control laws.
        places: Dict from the name of each place to its (x, y) in metres. They are the places of the
            dstates, and those that a route may lead to.
        via: Dict from a name to (x, y) in metres, for points that are no places but that a route of
            places may lead through.
        lifts: Lifts. Each lift is an action of a route.
        own_reach: The reach of the world's file in metres, if `reach` replaces it; otherwise None.
    """

    name: str
    segments: Array = field(repr=False)
    clutter: tuple[Clutter, ...] = field(default=(), repr=False)
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)
    route: tuple[str, ...] = ()
    reach: float = 1.0
    dstates: tuple[TrueDState, ...] = field(default=(), repr=False)
    angles: Angles = "right"
    places: Mapping[str, Point] = field(default_factory=dict, repr=False)
    via: Mapping[str, Point] = field(default_factory=dict, repr=False)
    lifts: tuple[Lift, ...] = ()
    own_reach: float | None = None

    def __post_init__(self) -> None:
        a_text("world.name", self.name, SimulatorError)
        checked_segments("world.segments", self.segments)
        object.__setattr__(self, "start", pose_of("world.start", self.start))
        a_number("world.reach", self.reach, SimulatorError, NEAREST, FARTHEST, what="metres")
        if self.own_reach is not None:
            a_number(
                "world.own_reach", self.own_reach, SimulatorError, NEAREST, FARTHEST, what="metres"
            )
        one_of("world.angles", self.angles, get_args(Angles), SimulatorError)
        # The class is frozen; lists become tuples.
        for name, kind in (
            ("clutter", Clutter),
            ("route", str),
            ("dstates", TrueDState),
            ("lifts", Lift),
        ):
            mend, some = "read a world with World.load", getattr(self, name)
            members = all_instances(f"world.{name}", some, kind, SimulatorError, mend=mend)
            object.__setattr__(self, name, members)
        for name in ("places", "via"):
            points = an_object(f"world.{name}", getattr(self, name), SimulatorError)
            for place, point in points.items():
                where = f"world.{name}[{brief(place)}]"
                numbers(where, point, SimulatorError, 2, "x and y in metres")

    @property
    def by_places(self) -> bool:
        """Whether the route consists of places, instead of actions."""
        actions = {*ACTIONS, *(lift.name for lift in self.lifts)}
        return bool(self.route) and not set(self.route) <= actions

    @property
    def stops(self) -> dict[str, Point]:
        """All points that a route of places may lead to: `places` and `via`."""
        return {**self.via, **self.places}

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """The smallest x, smallest y, largest x and largest y of the walls, in metres."""
        xs, ys = self.segments[:, ::2], self.segments[:, 1::2]
        return float(xs.min()), float(ys.min()), float(xs.max()), float(ys.max())

    def holds(self, x: float, y: float) -> bool:
        """Check whether a point, in metres, is within the bounds of the walls."""
        a_number("x", x, SimulatorError, -FARTHEST, FARTHEST, what="metres")
        a_number("y", y, SimulatorError, -FARTHEST, FARTHEST, what="metres")
        left, bottom, right, top = self.bounds
        return left < x < right and bottom < y < top

    def arranged(self, rng: np.random.Generator) -> World:
        """Make the world of one tour: move the clutter at random, and turn it into walls."""
        an_instance(
            "rng", rng, np.random.Generator, SimulatorError, mend="take numpy.random.default_rng(0)"
        )
        parts = [self.segments]
        for item in self.clutter:
            shift = rng.uniform(-1, 1, 2) * np.array(item.moves)
            if rng.random() < item.present:
                parts.append(item.segments + np.tile(shift, 2))
        return replace(self, segments=np.vstack(parts), clutter=())

    def clearance(self, x: float, y: float) -> float:
        """Measure the distance from a point to the nearest wall, in metres."""
        a_number("x", x, SimulatorError, -FARTHEST, FARTHEST, what="metres")
        a_number("y", y, SimulatorError, -FARTHEST, FARTHEST, what="metres")
        return float(distances_to(self.segments, (x, y)).min())

    def lift_at(self, name: str, x: float, y: float) -> Lift | None:
        """Find the lift of a name that starts within `reach` of a point; None if none does.

        Args:
            name: Name of the lift.
            x: x of the point in metres.
            y: y of the point in metres.
        """
        a_text("name", name, SimulatorError)
        a_number("x", x, SimulatorError, -FARTHEST, FARTHEST, what="metres")
        a_number("y", y, SimulatorError, -FARTHEST, FARTHEST, what="metres")
        near = (lift for lift in self.lifts if math.dist(lift.start, (x, y)) <= self.reach)
        return next((lift for lift in near if lift.name == name), None)

    def nearest(self, pose: Sequence[float]) -> TrueDState | None:
        """Find the true dstate nearest to a pose; None if the world states no dstates.

        Args:
            pose: x and y in metres, heading in radians. A radian of difference counts as a metre.
        """
        x, y, heading = pose_of("pose", pose)
        if not self.dstates:
            return None

        def far(s: TrueDState) -> float:
            return math.hypot(s.pose[0] - x, s.pose[1] - y) + abs(
                math.remainder(s.pose[2] - heading, math.tau)
            )

        return min(self.dstates, key=far)

    def with_choices(
        self, start: str | None = None, route: str | None = None, reach: float | None = None
    ) -> World:
        """Copy the world with another start, route or reach. None keeps what the world has.

        Args:
            start: Text "x,y,degrees", with x and y in metres.
            route: Actions, or names of places, separated by commas, such as "travel,right".
            reach: Half the width of a corridor in metres.

        Raises:
            SimulatorError: An argument is malformed.
        """
        reader = WorldReader(self.name)
        # The reader names the argument in its errors.
        world = self
        if start is not None:
            try:
                pose = [float(x) for x in a_text("start", start, SimulatorError).split(",")]
            except ValueError:
                raise reader.wrong("start", "x,y,degrees", start) from None
            world = replace(world, start=reader.pose(pose, "start"))
        if route is not None:
            if not isinstance(route, str):
                raise reader.wrong("route", "actions with commas between", route)
            world = replace(world, route=reader.route(route.split(","), world.stops, world.lifts))
        if reach is not None:
            own = world.own_reach or world.reach
            world = replace(world, reach=reader.reach(reach), own_reach=own)
        return world

    @classmethod
    def named(cls, name: str) -> World:
        """Load a world of the package by name, or a world from a file.

        Args:
            name: Name of a world of the package, such as notched-rectangle; or the path of a file:
                .json, or .yaml for an occupancy map.

        Raises:
            SimulatorError: There is no such world, or the file is wrong.
        """
        shipped = {
            path.stem: path for path in (Path(str(files("simulator"))) / "worlds").glob("*.json")
        }
        if isinstance(name, str) and name in shipped:
            return cls.load(shipped[name])
        if not isinstance(name, str) or not Path(name).suffix:
            raise SimulatorError(
                f"world: expected one of {', '.join(sorted(shipped))}, or a file, got "
                f"{brief(name)}; a file ends in .json or .yaml"
            )
        return (
            cls.from_occupancy(name) if Path(name).suffix in (".yaml", ".yml") else cls.load(name)
        )

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> World:
        """Load a world from a JSON file.

        Raises:
            SimulatorError: The file cannot be read, or a field is wrong. The text names the field.
        """
        path = a_path("path", path, SimulatorError)
        text = read_file(path, LARGEST, "a readable world", SimulatorError)
        try:
            data = parse_json(text.decode("utf-8"))
        except ValueError as error:
            raise SimulatorError(
                f"{named(path)}: expected a world in JSON, got something else "
                f"({brief(str(error))}); mend it"
            ) from None
        return cls(**WorldReader(str(path)).fields(data))

    @classmethod
    def from_occupancy(cls, path: str | os.PathLike[str]) -> World:
        """Make a world from an occupancy map of ROS (docs/reference/worlds.md).

        The world has no route. The robot starts at the mean of the ends of all walls.

        Args:
            path: The YAML file of the map, which names the image.

        Raises:
            SimulatorError: The map cannot be read, or has no walls.
        """
        name, segments = read_occupancy(Path(a_path("path", path, SimulatorError)))
        middle = segments.reshape(-1, 2).mean(0)
        return cls(printable(name), segments, start=(float(middle[0]), float(middle[1]), 0.0))
