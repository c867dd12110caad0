"""Worlds in which simulated robots drive: walls, clutter that may move between tours, and a route.

A world may also state its true dstates (distinctive states: places, each with a heading).

A world is a JSON file that a user can write (docs/reference/worlds.md), or an occupancy map of ROS
(YAML file and image). `WorldReader` reads the fields of world files.

>>> from simulator.world import World
>>> World.named("notched-rectangle").segments.shape[1]
4
"""

from __future__ import annotations

import math
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from simulator.errors import SimulatorError
from simulator.occupancy import FARTHEST, read_occupancy
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
from ssh_abduction.data.errors import brief, is_finite, named, printable
from ssh_abduction.data.files import parse_json, read_file
from ssh_abduction.data.odometry import radians_between
from ssh_abduction.data.schema import FieldReader

Array = NDArray[np.float64]
Angles: TypeAlias = Literal["right", "any"]
Point: TypeAlias = tuple[float, float]
FORMAT, VERSION = "ssh-world", 1
ACTIONS = ("travel", "right", "left", "around")
# Largest length of the straight pieces of an arc in degrees, and of a ragged wall in metres.
ARC, RAGGED = 5.0, 0.3
# Largest total length of ragged walls, in metres.
LONGEST = 20_000
# A wall is oblique if it is more than SQUARE radians off the two main directions. In a world with
# right angles, at most the share OBLIQUE of the walls, by length, is oblique, such as a column or a
# cut corner.
SQUARE, OBLIQUE = math.radians(5), 0.1
# Smallest `reach` of a world in metres: a laser reports no smaller range.
NEAREST = 0.01
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


def _check_point(x: object, y: object) -> None:
    """Raise SimulatorError unless two coordinates are metres that a world may have."""
    for name, value in (("x", x), ("y", y)):
        a_number(name, value, SimulatorError, -FARTHEST, FARTHEST, what="metres")


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

    def __post_init__(self) -> None:
        a_text("world.name", self.name, SimulatorError)
        checked_segments("world.segments", self.segments)
        object.__setattr__(self, "start", pose_of("world.start", self.start))
        a_number("world.reach", self.reach, SimulatorError, NEAREST, FARTHEST, what="metres")
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
        _check_point(x, y)
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
        _check_point(x, y)
        return float(distances_to(self.segments, (x, y)).min())

    def lift_at(self, name: str, x: float, y: float) -> Lift | None:
        """Find the lift of a name that starts within `reach` of a point; None if none does.

        Args:
            name: Name of the lift.
            x: x of the point in metres.
            y: y of the point in metres.
        """
        a_text("name", name, SimulatorError)
        _check_point(x, y)
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
        return min(
            self.dstates,
            key=lambda s: math.dist(s.pose[:2], (x, y)) + radians_between(s.pose[2], heading),
        )

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
        changes: dict[str, Any] = {}
        # The reader names the argument in its errors.
        if start is not None:
            try:
                pose = [float(x) for x in a_text("start", start, SimulatorError).split(",")]
            except ValueError:
                raise reader.wrong("start", "x,y,degrees", start) from None
            changes["start"] = reader.pose(pose, "start")
        if route is not None:
            listed = a_text("route", route, SimulatorError).split(",")
            changes["route"] = reader.route(listed, self.stops, self.lifts)
        if reach is not None:
            changes["reach"] = reader.reach(reach)
        return replace(self, **changes)

    @classmethod
    def named(cls, name: str) -> World:
        """Load a world of the package by name, or a world from a file.

        Args:
            name: Name of a world of the package, such as notched-rectangle; or the path of a file:
                .json, or .yaml for an occupancy map.

        Raises:
            SimulatorError: There is no such world, or the file is wrong.
        """
        folder = Path(str(files("simulator"))) / "worlds"
        shipped = {path.stem: path for path in folder.glob("*.json")}
        if isinstance(name, str) and name in shipped:
            return cls.load(shipped[name])
        if not isinstance(name, str) or not Path(name).suffix:
            raise SimulatorError(
                f"world: expected one of {', '.join(sorted(shipped))}, or a file, got "
                f"{brief(name)}; a file ends in .json or .yaml"
            )
        is_map = Path(name).suffix in (".yaml", ".yml")
        return cls.from_occupancy(name) if is_map else cls.load(name)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> World:
        """Load a world from a JSON file.

        Raises:
            SimulatorError: The file cannot be read, or a field is wrong. The text names the field.
        """
        path = a_path("path", path, SimulatorError)
        text = read_file(path, LARGEST, "a readable world", SimulatorError)
        try:
            data = parse_json(text)
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


@dataclass(frozen=True)
class TrueDState:
    """The true pose of a dstate, for evaluation only.

    Attributes:
        name: Name of the dstate.
        place: Name of its place.
        path: Name of its path.
        direction: 1 if the heading is along the path, -1 if it is against it.
        pose: (x, y, heading) in metres and radians.
    """

    name: str
    place: str
    path: str
    direction: int
    pose: tuple[float, float, float]


@dataclass(frozen=True)
class Lift:
    """A lift from one point to another. The floors of a world lie beside each other in one plane.

    Attributes:
        name: Name of the action that takes it. Lifts from different points may share a name.
        start: (x, y) in metres where the robot gets in.
        end: (x, y) in metres where it gets out, with the same heading.
    """

    name: str
    start: Point
    end: Point


@dataclass(frozen=True)
class Clutter:
    """A closed polygon that may be moved or absent on each tour, such as a piece of furniture.

    Attributes:
        segments: (n, 4) sides of the polygon in metres, as in the file.
        moves: Largest shift in x and in y on a tour, in metres.
        present: Probability that the polygon is there on a tour.
    """

    segments: Array = field(repr=False)
    moves: tuple[float, float] = (0.0, 0.0)
    present: float = 1.0


def are_square(walls: Array) -> bool:
    """Check whether nearly all walls, (n, 4), by length, are parallel or perpendicular."""
    ways = (walls[:, 2] - walls[:, 0]) + 1j * (walls[:, 3] - walls[:, 1])
    lengths = np.abs(ways)
    directions = np.angle(ways) * 4  # Makes perpendicular directions equal.
    axis = directions[lengths.argmax()]
    off = np.abs(np.angle(np.exp(1j * (directions - axis)))) / 4
    return bool(lengths[off > SQUARE].sum() <= OBLIQUE * lengths.sum())


class WorldReader(FieldReader):
    """Reads and checks the fields of a world file.

    All methods but `wrong` return the checked value, or raise SimulatorError if it is invalid.
    The error has `name`, the name of the field, and `where`, the name of the file.
    """

    error, mend = SimulatorError, "mend it (docs/reference/worlds.md)"

    def need(self, is_good: bool, name: str, expected: str, value: Any) -> None:
        """Raise SimulatorError if a value is not what is expected."""
        if not is_good:
            raise self.wrong(name, expected, value)

    def fields(self, data: Any) -> dict[str, Any]:
        """Read the arguments of `World`, by name, from a JSON object."""
        head = {"format": FORMAT, "version": VERSION}
        is_world = isinstance(data, Mapping) and all(data.get(k) == v for k, v in head.items())
        expected = f'an object with "format": "{FORMAT}", "version": {VERSION}'
        self.need(is_world, "format", expected, data)
        segments, each = self.walls(data), partial(self.each, data, optional=True)
        # Places are those of dstates and those listed; routes may also lead through other points.
        dstates = each("dstates", self.dstate)
        places = {state.place: state.pose[:2] for state in dstates} | self.points(
            data.get("places", {}), "places"
        )
        via = self.points(data.get("via", {}), "via")
        stops = {**via, **places}
        lifts = each("lifts", self.lift)
        route = self.route(self.list(data, "route", optional=True), stops, lifts)
        start = [*stops[route[0]], 0.0] if set(route) & set(stops) else [0, 0, 0]
        name = data.get("name", printable(Path(self.where).stem))
        return {
            "name": a_text(f"{self.where}: name", name, SimulatorError),
            "segments": self.ragged(segments, data.get("ragged", 0.0)),
            "angles": self.angles(data.get("angles"), segments),
            "clutter": each("clutter", self.clutter),
            "start": self.pose(data.get("start", start), "start"),
            "route": route,
            "reach": self.reach(data.get("reach", 1.0)),
            "dstates": dstates,
            "places": places,
            "via": via,
            "lifts": lifts,
        }

    def walls(self, data: Mapping[str, Any]) -> Array:
        """Read all walls, as segments: (n, 4), metres."""
        each = partial(self.each, data, optional=True)
        walls = [
            *each("polygons", self.loop),
            *each("segments", self.segment),
            *each("arcs", self.arc),
        ]
        if "occupancy" in data:
            walls.append(self.occupancy(data["occupancy"], "occupancy"))
        expected = "at least one wall in polygons, segments, arcs or occupancy"
        self.need(bool(walls), "polygons", expected, [])
        return np.vstack(walls)

    def row(self, value: Any, count: int, name: str) -> tuple[float, ...]:
        """Read a list of `count` finite numbers."""
        is_row = isinstance(value, list) and len(value) == count
        is_good = is_row and all(is_finite(x) and abs(x) <= FARTHEST for x in value)
        self.need(is_good, name, f"{count} finite numbers, of at most {FARTHEST:,.0f}", value)
        return tuple(map(float, value))

    def point(self, value: Any, name: str) -> Point:
        """Read a point [x, y] in metres."""
        x, y = self.row(value, 2, name)
        return x, y

    def segment(self, value: Any, name: str) -> Array:
        """Read a wall: (1, 4), metres."""
        return np.array([self.row(value, 4, name)])

    def loop(self, value: Any, name: str) -> Array:
        """Read a list of points, and make the sides of the closed polygon: (n, 4), metres."""
        is_loop = isinstance(value, list) and len(value) >= 3
        self.need(is_loop, name, "at least three points [x, y]", value)
        points = np.array([self.point(p, f"{name}[{i}]") for i, p in enumerate(value)])
        return np.hstack([points, np.roll(points, -1, axis=0)])

    def arc(self, value: Any, name: str) -> Array:
        """Read an arc, and approximate it by segments: (n, 4), metres.

        It lists x and y of the centre, radius, and first and last direction in degrees
        counterclockwise.
        """
        x, y, radius, first, last = self.row(value, 5, name)
        expected = "[x, y, radius above 0, from, to], where `to` is up to 360 degrees above `from`"
        self.need(radius > 0 and 0 < last - first <= 360, name, expected, value)
        angles = np.radians(np.linspace(first, last, 1 + math.ceil((last - first) / ARC)))
        points = np.column_stack([x + radius * np.cos(angles), y + radius * np.sin(angles)])
        return np.hstack([points[:-1], points[1:]])

    def occupancy(self, value: Any, name: str) -> Array:
        """Read the walls, (n, 4) metres, of an occupancy map in a file beside this one."""
        self.need(isinstance(value, str), name, "the name of a YAML file", value)
        return read_occupancy(Path(self.where).parent / value)[1]

    def ragged(self, walls: Array, value: Any) -> Array:
        """Divide walls, (n, 4) metres, into pieces, and shift the ends of the pieces at random.

        The shifts are always the same, so that a world looks the same on each drive.
        `value` is the standard deviation of the shifts in metres; 0 changes nothing.
        """
        is_share = is_finite(value) and 0 <= value <= 1
        self.need(is_share, "ragged", "metres by which walls are uneven, 0 to 1", value)
        if not value:
            return walls
        is_short = np.hypot(*(walls[:, 2:] - walls[:, :2]).T).sum() <= LONGEST
        expected = f"walls of at most {LONGEST:,} m together, as uneven walls have many pieces"
        self.need(is_short, "ragged", expected, value)
        pieces = []
        for start, end in walls.reshape(-1, 2, 2):
            line = np.linspace(start, end, 1 + math.ceil(math.dist(start, end) / RAGGED))
            pieces.append(np.hstack([line[:-1], line[1:]]))
        # Shift equal ends equally, so that walls that meet still meet.
        ends, which = np.unique(
            np.vstack(pieces).reshape(-1, 2).round(6), axis=0, return_inverse=True
        )
        ends += np.random.default_rng(0).normal(0, value, ends.shape)
        return np.asarray(ends[which.ravel()].reshape(-1, 4))

    def points(self, value: Any, name: str) -> dict[str, Point]:
        """Read an object of points: a dict from name to (x, y) in metres."""
        self.need(isinstance(value, Mapping), name, "an object of names and points [x, y]", value)
        clash = next((text for text in value if text in ACTIONS or "," in text), None)
        self.need(not clash, name, "names without commas that are no actions", clash)
        return {text: self.point(point, f"{name}.{text}") for text, point in value.items()}

    def lift(self, value: Any, name: str) -> Lift:
        """Read a lift: an object with name, from and to."""
        is_named = isinstance(value, Mapping) and isinstance(value.get("name"), str)
        self.need(is_named, name, "an object with name, from and to", value)
        action = value["name"]
        is_new = action and action not in ACTIONS and "," not in action
        self.need(is_new, f"{name}.name", "a name without commas that is no action", action)
        return Lift(action, *(self.point(value.get(k), f"{name}.{k}") for k in ("from", "to")))

    def route(
        self, value: Sequence[Any], stops: Mapping[str, Point], lifts: Sequence[Lift] = ()
    ) -> tuple[str, ...]:
        """Check a route, which consists of actions only or of the names of `stops` only."""
        actions = [*ACTIONS, *dict.fromkeys(lift.name for lift in lifts)]
        if any(isinstance(stop, str) and stop in stops for stop in value):
            allowed: Collection[str] = stops
            expected = f"a place ({', '.join(stops)}), as there are others in the route"
        else:
            allowed = actions
            expected = f"{', '.join(actions[:-1])} or {actions[-1]}"
            expected += ", or the name of a place" if stops else ""
        for i, stop in enumerate(value):
            is_good = isinstance(stop, str) and stop in allowed
            self.need(is_good, f"route[{i}]", expected, stop)
        return tuple(value)

    def reach(self, value: Any) -> float:
        """Check the reach, in metres."""
        is_good = is_finite(value) and NEAREST <= value <= FARTHEST
        self.need(is_good, "reach", f"metres above 0, {NEAREST} to {FARTHEST:,.0f}", value)
        return float(value)

    def angles(self, value: Any, walls: Array) -> Angles:
        """Return how streets meet: at right angles ("right") or at any angles ("any").

        If the file says nothing (None), it is "right" if nearly all walls have one of two
        perpendicular directions, else "any". Raises SimulatorError for another value.
        """
        self.need(value in (None, "right", "any"), "angles", '"right" or "any"', value)
        chosen: Angles = value or ("right" if are_square(walls) else "any")
        return chosen

    def pose(self, value: Any, name: str) -> tuple[float, float, float]:
        """Read a pose. Its heading is in degrees in the file, and in radians in the result."""
        x, y, degrees = self.row(value, 3, name)
        return x, y, math.radians(degrees)

    def clutter(self, value: Any, name: str) -> Clutter:
        """Read a polygon that may move."""
        self.need(isinstance(value, Mapping), name, "an object with a polygon", value)
        moves = self.point(value.get("moves", [0, 0]), f"{name}.moves")
        present = value.get("present", 1.0)
        is_share = is_finite(present) and 0 <= present <= 1
        self.need(is_share, f"{name}.present", "a probability", present)
        return Clutter(self.loop(value.get("polygon"), f"{name}.polygon"), moves, float(present))

    def dstate(self, value: Any, name: str) -> TrueDState:
        """Read a true dstate."""
        texts = dict.fromkeys(("name", "place", "path"), self.text)
        return self.record(
            TrueDState, value, name, **texts, direction=self.direction, pose=self.pose
        )

    def direction(self, value: Any, name: str) -> int:
        """Read a direction along a path."""
        self.need(value in (1, -1), name, "1 or -1", value)
        return int(value)
