"""Worlds: walls, clutter that may move between tours, and the true dstates if known.

A world is a JSON file that a user can write (docs/worlds.md), or an occupancy map of ROS (a YAML
file and an image).

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
from ssh_abduction.data.files import parse_json, read_at_most

Array = NDArray[np.float64]
Angles: TypeAlias = Literal["right", "any"]
Point: TypeAlias = tuple[float, float]
FORMAT, VERSION = "ssh-world", 1
ACTIONS = ("travel", "right", "left", "around")
# Largest length of the straight pieces of an arc in degrees, and of a ragged wall in metres.
ARC, RAGGED = 5.0, 0.3
# Largest total length of ragged walls, in metres.
LONGEST = 20_000
# A wall is square if it is within SQUARE radians of a right angle to the others. A right-angled
# world has at most OBLIQUE of its walls, by length, that are not: a column or a cut corner.
SQUARE, OBLIQUE = math.radians(5), 0.1
# Smallest `reach` of a world in metres: a laser reports no smaller range.
NEAREST = 0.01
# Largest size of a world file in bytes.
LARGEST = 64 * 2**20


def checked_segments(name: str, value: object) -> Array:
    """Check an array of segments, (n, 4), in metres. Raises SimulatorError."""
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
    """Check a pose (x, y, heading) in metres and radians. Raises SimulatorError."""
    x, y, heading = numbers(
        name, value, SimulatorError, 3, "x, y and heading, in metres and radians"
    )
    return x, y, heading


@dataclass(frozen=True)
class TrueDState:
    """The true pose of a dstate, for evaluation only.

    Attributes:
        name: Name of the dstate.
        place: Name of its place.
        path: Name of its path.
        direction: 1 along the path, or -1.
        pose: (x, y, heading) in metres and radians.
    """

    name: str
    place: str
    path: str
    direction: int
    pose: tuple[float, float, float]


@dataclass(frozen=True)
class Clutter:
    """A closed polygon that may be elsewhere, or absent, on each tour.

    Attributes:
        segments: (n, 4) walls in metres, as in the file.
        moves: Largest shift in x and y for a tour, in metres.
        present: Probability that it is there on a tour.
    """

    segments: Array = field(repr=False)
    moves: tuple[float, float] = (0.0, 0.0)
    present: float = 1.0


@dataclass(frozen=True)
class World:
    """Walls and clutter, and what a robot is to do in them.

    Attributes:
        name: Name of the world.
        segments: (n, 4) walls: x1, y1, x2, y2 in metres.
        clutter: Polygons that may move between tours.
        start: Start pose (x, y, heading) in metres and radians.
        route: Actions of one tour, which ends where it began; or the places to drive to.
        reach: Distance in metres at which the robot follows a wall: half the width of a corridor.
        dstates: The truth, for evaluation only.
        angles: Angles at which streets meet, which choose the control laws: right, or any.
        places: (x, y) of places in metres by name: those of the dstates, or of a route of places.
        via: (x, y) by name of points that are no places, through which a route of places may lead.
        own_reach: The reach of the file, if another one was chosen.
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
        for name, kind in (("clutter", Clutter), ("route", str), ("dstates", TrueDState)):
            members = all_instances(
                f"world.{name}",
                getattr(self, name),
                kind,
                SimulatorError,
                mend="read a world with World.load",
            )
            object.__setattr__(self, name, members)
        for name in ("places", "via"):
            for place, point in an_object(
                f"world.{name}", getattr(self, name), SimulatorError
            ).items():
                numbers(
                    f"world.{name}[{brief(place)}]", point, SimulatorError, 2, "x and y in metres"
                )

    @property
    def by_places(self) -> bool:
        """Whether the route consists of places."""
        return bool(self.route) and not set(self.route) <= set(ACTIONS)

    @property
    def stops(self) -> dict[str, Point]:
        """All points that a route of places may lead to."""
        return {**self.via, **self.places}

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Smallest x, smallest y, largest x, largest y of the walls."""
        xs, ys = self.segments[:, ::2], self.segments[:, 1::2]
        return float(xs.min()), float(ys.min()), float(xs.max()), float(ys.max())

    def holds(self, x: float, y: float) -> bool:
        """Whether a point is within the bounds of the walls."""
        a_number("x", x, SimulatorError, -FARTHEST, FARTHEST, what="metres")
        a_number("y", y, SimulatorError, -FARTHEST, FARTHEST, what="metres")
        left, bottom, right, top = self.bounds
        return left < x < right and bottom < y < top

    def arranged(self, rng: np.random.Generator) -> World:
        """Make the world of one tour: move the clutter at random, and add it to the walls."""
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
        """Metres from a point to the nearest wall."""
        a_number("x", x, SimulatorError, -FARTHEST, FARTHEST, what="metres")
        a_number("y", y, SimulatorError, -FARTHEST, FARTHEST, what="metres")
        a, b = self.segments[:, :2], self.segments[:, 2:]
        along = b - a
        length = np.maximum((along**2).sum(1), 1e-12)
        t = np.clip(((np.array([x, y]) - a) * along).sum(1) / length, 0, 1)
        return float(np.hypot(*(a + t[:, None] * along - np.array([x, y])).T).min())

    def nearest(self, pose: Sequence[float]) -> TrueDState | None:
        """The true dstate nearest to a pose, where a radian counts as a metre.

        None if the world has no true dstates.
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
        """Change the start, route or reach.

        Args:
            start: "x,y,degrees" in metres and degrees.
            route: "travel,right,…", or names of places.
            reach: Metres.

        Raises:
            SimulatorError: An argument has no such form.
        """
        reader = _Reader(self.name)
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
            world = replace(world, route=reader.route(route.split(","), world.stops))
        return (
            world
            if reach is None
            else replace(world, reach=reader.reach(reach), own_reach=world.own_reach or world.reach)
        )

    @classmethod
    def named(cls, name: str) -> World:
        """Load a world by name, such as notched-rectangle or triangle, or from a file.

        Args:
            name: Name of a world of the package, or a file: .json, or .yaml for an occupancy map.

        Raises:
            SimulatorError: There is no such world.
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
        """Load a world from a JSON file. Raises SimulatorError that names the field."""
        path = a_path("path", path, SimulatorError)
        try:
            data = parse_json(read_at_most(path, LARGEST).decode("utf-8"))
        except OSError as error:
            raise SimulatorError(
                f"{named(path)}: expected a readable world: {error.strerror or error}; check "
                "the path"
            ) from None
        except ValueError as error:
            raise SimulatorError(
                f"{named(path)}: expected a world in JSON, got something else "
                f"({brief(str(error))}); mend it"
            ) from None
        return _Reader(str(path)).world(data)

    @classmethod
    def from_occupancy(cls, path: str | os.PathLike[str]) -> World:
        """Make a world from an occupancy map of ROS, a YAML file and its image (docs/worlds.md).

        The robot starts in the mean of the ends of all walls.
        """
        name, segments = read_occupancy(Path(a_path("path", path, SimulatorError)))
        middle = segments.reshape(-1, 2).mean(0)
        return cls(printable(name), segments, start=(float(middle[0]), float(middle[1]), 0.0))


def are_square(walls: Array) -> bool:
    """Whether nearly all walls, by length, have one of two perpendicular directions."""
    ways = (walls[:, 2] - walls[:, 0]) + 1j * (walls[:, 3] - walls[:, 1])
    lengths = np.abs(ways)
    directions = np.angle(ways) * 4  # Directions a quarter turn apart become equal.
    axis = directions[lengths.argmax()]
    off = np.abs(np.angle(np.exp(1j * (directions - axis)))) / 4
    return bool(lengths[off > SQUARE].sum() <= OBLIQUE * lengths.sum())


class _Reader:
    """Checks the fields of a world, and names the wrong one.

    Args:
        where: Name of the file, for errors.
    """

    def __init__(self, where: str) -> None:
        self.where = where

    def world(self, data: Any) -> World:
        """Make the world of a JSON object."""
        if (
            not isinstance(data, Mapping)
            or data.get("format") != FORMAT
            or data.get("version") != VERSION
        ):
            raise self.wrong(
                "format", f'an object with "format": "{FORMAT}", "version": {VERSION}', data
            )
        walls = [self.loop(p, f"polygons[{i}]") for i, p in enumerate(self.list(data, "polygons"))]
        walls += [
            self.numbers(s, 4, f"segments[{i}]").reshape(1, 4)
            for i, s in enumerate(self.list(data, "segments"))
        ]
        walls += [self.arc(a, f"arcs[{i}]") for i, a in enumerate(self.list(data, "arcs"))]
        if "occupancy" in data:
            walls.append(self.occupancy(data["occupancy"]))
        if not walls:
            raise self.wrong(
                "polygons", "at least one wall in polygons, segments, arcs or occupancy", []
            )
        segments = np.vstack(walls)
        dstates = tuple(
            self.dstate(s, f"dstates[{i}]") for i, s in enumerate(self.list(data, "dstates"))
        )
        places = {state.place: state.pose[:2] for state in dstates} | self.points(
            data.get("places", {}), "places"
        )
        via = self.points(data.get("via", {}), "via")
        stops = {**via, **places}
        route = self.route(self.list(data, "route"), stops)
        start = [*stops[route[0]], 0.0] if set(route) & set(stops) else [0, 0, 0]
        return World(
            name=self.name(data.get("name", printable(Path(self.where).stem))),
            segments=self.ragged(segments, data.get("ragged", 0.0)),
            angles=self.angles(data.get("angles"), segments),
            clutter=tuple(
                self.clutter(c, f"clutter[{i}]") for i, c in enumerate(self.list(data, "clutter"))
            ),
            start=self.pose(data.get("start", start), "start"),
            route=route,
            reach=self.reach(data.get("reach", 1.0)),
            dstates=dstates,
            places=places,
            via=via,
        )

    def name(self, value: Any) -> str:
        if not isinstance(value, str):
            raise self.wrong("name", "a text", value)
        return value

    def wrong(self, name: str, expected: str, value: Any) -> SimulatorError:
        return SimulatorError(
            f"{self.where}: {name}: expected {expected}, got {brief(value)}; mend it "
            "(docs/worlds.md)"
        )

    def list(self, data: Mapping[str, Any], name: str) -> list[Any]:
        value = data.get(name, [])
        if not isinstance(value, list):
            raise self.wrong(name, "a list", value)
        return value

    def numbers(self, value: Any, count: int, name: str) -> Array:
        good = isinstance(value, list) and len(value) == count
        if not good or not all(is_finite(x) and abs(x) <= FARTHEST for x in value):
            raise self.wrong(name, f"{count} finite numbers, of at most {FARTHEST:,.0f}", value)
        return np.array(value, dtype=float)

    def loop(self, value: Any, name: str) -> Array:
        """Segments of a closed polygon."""
        if not isinstance(value, list) or len(value) < 3:
            raise self.wrong(name, "at least three points [x, y]", value)
        points = np.array([self.numbers(p, 2, f"{name}[{i}]") for i, p in enumerate(value)])
        return np.hstack([points, np.roll(points, -1, axis=0)])

    def arc(self, value: Any, name: str) -> Array:
        """Segments of an arc: x and y of the centre, radius, first and last direction.

        Directions are degrees, counterclockwise.
        """
        x, y, radius, first, last = self.numbers(value, 5, name)
        if not radius > 0 or not 0 < last - first <= 360:
            raise self.wrong(
                name,
                "[x, y, radius above 0, from, to], where `to` is up to 360 degrees above `from`",
                value,
            )
        angles = np.radians(np.linspace(first, last, 1 + math.ceil((last - first) / ARC)))
        points = np.column_stack([x + radius * np.cos(angles), y + radius * np.sin(angles)])
        return np.hstack([points[:-1], points[1:]])

    def occupancy(self, value: Any) -> Array:
        """Walls of an occupancy map, named relative to the folder of the world."""
        if not isinstance(value, str):
            raise self.wrong("occupancy", "the name of a YAML file", value)
        return read_occupancy(Path(self.where).parent / value)[1]

    def ragged(self, walls: Array, value: Any) -> Array:
        """Cut walls into pieces, and shift their ends by Gaussian noise in metres.

        The noise is always the same, so that a world looks the same on each drive.
        """
        if not is_finite(value) or not 0 <= value <= 1:
            raise self.wrong("ragged", "metres by which walls are uneven, 0 to 1", value)
        if not value:
            return walls
        if np.hypot(*(walls[:, 2:] - walls[:, :2]).T).sum() > LONGEST:
            raise self.wrong(
                "ragged",
                f"walls of at most {LONGEST:,} m together, as uneven walls have many pieces",
                value,
            )
        pieces = []
        for x1, y1, x2, y2 in walls:
            line = np.linspace(
                (x1, y1), (x2, y2), 1 + math.ceil(math.hypot(x2 - x1, y2 - y1) / RAGGED)
            )
            pieces.append(np.hstack([line[:-1], line[1:]]))
        # Walls that meet still meet.
        ends, which = np.unique(
            np.vstack(pieces).reshape(-1, 2).round(6), axis=0, return_inverse=True
        )
        moved: Array = (ends + np.random.default_rng(0).normal(0, value, ends.shape))[
            which.ravel()
        ].reshape(-1, 4)
        return moved

    def points(self, value: Any, name: str) -> dict[str, Point]:
        if not isinstance(value, Mapping):
            raise self.wrong(name, "an object of names and points [x, y]", value)
        if clash := next((text for text in value if text in ACTIONS or "," in text), None):
            raise self.wrong(name, "names without commas that are no actions", clash)
        found = {
            text: self.numbers(point, 2, f"{name}.{text}").tolist() for text, point in value.items()
        }
        return {text: (x, y) for text, (x, y) in found.items()}

    def route(self, value: Sequence[Any], stops: Mapping[str, Point]) -> tuple[str, ...]:
        """Check a route of actions or of places."""
        by_places = any(isinstance(stop, str) and stop in stops for stop in value)
        for i, stop in enumerate(value):
            if by_places and not (isinstance(stop, str) and stop in stops):
                raise self.wrong(
                    f"route[{i}]",
                    f"a place ({', '.join(stops)}), as there are others in the route",
                    stop,
                )
            if not by_places and stop not in ACTIONS:
                raise self.wrong(
                    f"route[{i}]",
                    "travel, right, left or around" + (", or the name of a place" if stops else ""),
                    stop,
                )
        return tuple(value)

    def reach(self, value: Any) -> float:
        if not is_finite(value) or not NEAREST <= value <= FARTHEST:
            raise self.wrong("reach", f"metres above 0, {NEAREST} to {FARTHEST:,.0f}", value)
        return float(value)

    def angles(self, value: Any, walls: Array) -> Angles:
        if value not in (None, "right", "any"):
            raise self.wrong("angles", '"right" or "any"', value)
        chosen: Angles = value or ("right" if are_square(walls) else "any")
        return chosen

    def pose(self, value: Any, name: str) -> tuple[float, float, float]:
        x, y, degrees = self.numbers(value, 3, name)
        return float(x), float(y), math.radians(degrees)

    def clutter(self, value: Any, name: str) -> Clutter:
        if not isinstance(value, Mapping):
            raise self.wrong(name, "an object with a polygon", value)
        moves = self.numbers(value.get("moves", [0, 0]), 2, f"{name}.moves")
        present = value.get("present", 1.0)
        if not is_finite(present) or not 0 <= present <= 1:
            raise self.wrong(f"{name}.present", "a probability", present)
        return Clutter(
            self.loop(value.get("polygon"), f"{name}.polygon"),
            (float(moves[0]), float(moves[1])),
            float(present),
        )

    def dstate(self, value: Any, name: str) -> TrueDState:
        if not isinstance(value, Mapping) or value.get("direction") not in (1, -1):
            raise self.wrong(
                name, "an object with name, place, path, direction 1 or -1, pose", value
            )
        texts = [value.get(key) for key in ("name", "place", "path")]
        if not all(isinstance(text, str) for text in texts):
            raise self.wrong(name, "texts for name, place and path", value)
        label, place, path = map(str, texts)
        return TrueDState(
            label,
            place,
            path,
            int(value["direction"]),
            self.pose(value.get("pose"), f"{name}.pose"),
        )
