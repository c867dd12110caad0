"""Worlds: walls as segments in metres, clutter that may move between tours, and, where it is known, the truth about dstates.

A world is a JSON file that a user can write (docs/worlds.md), or an occupancy map as ROS has it (PGM + YAML).

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
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from simulator.errors import SimulatorError
from simulator.occupancy import FARTHEST, read_occupancy
from ssh_abduction.errors import brief, is_finite, named, printable
from ssh_abduction.files import parse_json, read_at_most

Array = NDArray[np.float64]
Angles: TypeAlias = Literal["right", "any"]
FORMAT, VERSION = "ssh-world", 1
# Radians that a wall may be off a right angle; and of all walls at most this share may be off by more. So a column, or a corner that is cut off, leaves a world right-angled.
SQUARE, OBLIQUE = math.radians(5), 0.1
# The smallest `reach` of a world, in metres: a laser reports no range that is smaller.
NEAREST = 0.01
# Bytes that a world file may have.
LARGEST = 64 * 2**20


@dataclass(frozen=True)
class TrueDState:
    """Where a dstate really is, for evaluation only. Its pose is (x, y, heading) in metres and radians."""

    name: str
    place: str
    path: str
    direction: int
    pose: tuple[float, float, float]


@dataclass(frozen=True)
class Clutter:
    """A closed polygon. For each tour it is moved from where it stands in the file, by up to `moves` metres in x and y, and it is there with probability `present`."""

    segments: Array = field(repr=False)
    moves: tuple[float, float] = (0.0, 0.0)
    present: float = 1.0


@dataclass(frozen=True)
class World:
    """Walls and clutter.

    segments  the walls, (n, 4): x1, y1, x2, y2 in metres
    start     the pose (x, y, heading) in which the robot starts, in metres and radians
    route     the actions of one tour, which ends where it began
    reach     the distance at which the robot follows a wall, in metres: half the width of a corridor
    dstates   the truth, for evaluation only
    angles    the angles at which streets meet, which choose the control laws: right, or any
    """

    name: str
    segments: Array = field(repr=False)
    clutter: tuple[Clutter, ...] = field(default=(), repr=False)
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)
    route: tuple[str, ...] = ()
    reach: float = 1.0
    dstates: tuple[TrueDState, ...] = field(default=(), repr=False)
    angles: Angles = "right"

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Smallest x, smallest y, largest x, largest y of the walls."""
        xs, ys = self.segments[:, ::2], self.segments[:, 1::2]
        return float(xs.min()), float(ys.min()), float(xs.max()), float(ys.max())

    def holds(self, x: float, y: float) -> bool:
        """Whether a point is within the bounds of the walls."""
        left, bottom, right, top = self.bounds
        return left < x < right and bottom < y < top

    def arranged(self, rng: np.random.Generator) -> World:
        """This world as it is on one tour: the clutter has been moved at random, and is part of the walls."""
        parts = [self.segments]
        for item in self.clutter:
            shift = rng.uniform(-1, 1, 2) * np.array(item.moves)
            if rng.random() < item.present:
                parts.append(item.segments + np.tile(shift, 2))
        return replace(self, segments=np.vstack(parts), clutter=())

    def clearance(self, x: float, y: float) -> float:
        """Metres from a point to the nearest wall."""
        a, b = self.segments[:, :2], self.segments[:, 2:]
        along = b - a
        length = np.maximum((along**2).sum(1), 1e-12)
        t = np.clip(((np.array([x, y]) - a) * along).sum(1) / length, 0, 1)
        return float(np.hypot(*(a + t[:, None] * along - np.array([x, y])).T).min())

    def nearest(self, pose: Sequence[float]) -> TrueDState | None:
        """The true dstate that is nearest to a pose, where a radian counts like a metre; None if the world knows no true dstates."""
        if not self.dstates:
            return None
        x, y, heading = pose

        def far(s: TrueDState) -> float:
            return math.hypot(s.pose[0] - x, s.pose[1] - y) + abs(math.remainder(s.pose[2] - heading, math.tau))

        return min(self.dstates, key=far)

    def with_choices(self, start: str | None = None, route: str | None = None, reach: float | None = None) -> World:
        """This world with another start ("x,y,degrees"), route ("travel,right,…") or reach (metres). Raises SimulatorError."""
        reader = _Reader(self.name)
        world = self
        if start is not None:
            try:
                pose = [float(x) for x in start.split(",")]
            except (ValueError, AttributeError):
                raise reader.wrong("start", "x,y,degrees", start) from None
            world = replace(world, start=reader.pose(pose, "start"))
        if route is not None:
            if not isinstance(route, str):
                raise reader.wrong("route", "actions with commas between", route)
            world = replace(world, route=reader.route(route.split(",")))
        return world if reach is None else replace(world, reach=reader.reach(reach))

    @classmethod
    def named(cls, name: str) -> World:
        """A world that comes with the package (as notched-rectangle or triangle), or the one in a file: .json, or .yaml for an occupancy map."""
        shipped = {path.stem: path for path in (Path(str(files("simulator"))) / "worlds").glob("*.json")}
        if name in shipped:
            return cls.load(shipped[name])
        if not isinstance(name, str) or not Path(name).suffix:
            raise SimulatorError(
                f"world: expected one of {', '.join(sorted(shipped))}, or a file, got {brief(name)}; a file ends in .json or .yaml"
            )
        return cls.from_occupancy(name) if Path(name).suffix in (".yaml", ".yml") else cls.load(name)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> World:
        """The world in a JSON file. Raises SimulatorError that names the field."""
        try:
            data = parse_json(read_at_most(path, LARGEST).decode("utf-8"))
        except OSError as error:
            raise SimulatorError(f"{named(path)}: expected a readable world: {error.strerror or error}; check the path") from None
        except ValueError as error:
            raise SimulatorError(f"{named(path)}: expected a world in JSON, got something else ({brief(str(error))}); mend it") from None
        return _Reader(str(path)).world(data)

    @classmethod
    def from_occupancy(cls, path: str | os.PathLike[str]) -> World:
        """The world whose walls are those of an occupancy map, as ROS stores it: a YAML file with image, resolution, origin and occupied_thresh, and its PGM."""
        name, segments = read_occupancy(Path(path))
        middle = segments.reshape(-1, 2).mean(0)
        return cls(printable(name), segments, start=(float(middle[0]), float(middle[1]), 0.0))


def _are_square(walls: Array) -> bool:
    """Whether nearly all walls, by their length, are along two directions that are at right angles."""
    ways = (walls[:, 2] - walls[:, 0]) + 1j * (walls[:, 3] - walls[:, 1])
    lengths = np.abs(ways)
    directions = np.angle(ways) * 4  # walls along the axes, either way, have one direction
    axis = directions[lengths.argmax()]
    off = np.abs(np.angle(np.exp(1j * (directions - axis)))) / 4
    return bool(lengths[off > SQUARE].sum() <= OBLIQUE * lengths.sum())


class _Reader:
    """Checks the fields of a world, and says which one is wrong."""

    def __init__(self, where: str) -> None:
        self.where = where

    def world(self, data: Any) -> World:
        if not isinstance(data, Mapping) or data.get("format") != FORMAT or data.get("version") != VERSION:
            raise self.wrong("format", f'an object with "format": "{FORMAT}", "version": {VERSION}', data)
        walls = [self.loop(p, f"polygons[{i}]") for i, p in enumerate(self.list(data, "polygons"))]
        walls += [self.numbers(s, 4, f"segments[{i}]").reshape(1, 4) for i, s in enumerate(self.list(data, "segments"))]
        if not walls:
            raise self.wrong("polygons", "at least one wall in polygons or segments", [])
        segments = np.vstack(walls)
        return World(
            name=self.name(data.get("name", printable(Path(self.where).stem))),
            segments=segments,
            angles=self.angles(data.get("angles"), segments),
            clutter=tuple(self.clutter(c, f"clutter[{i}]") for i, c in enumerate(self.list(data, "clutter"))),
            start=self.pose(data.get("start", [0, 0, 0]), "start"),
            route=self.route(self.list(data, "route")),
            reach=self.reach(data.get("reach", 1.0)),
            dstates=tuple(self.dstate(s, f"dstates[{i}]") for i, s in enumerate(self.list(data, "dstates"))),
        )

    def name(self, value: Any) -> str:
        if not isinstance(value, str):
            raise self.wrong("name", "a text", value)
        return value

    def wrong(self, name: str, expected: str, value: Any) -> SimulatorError:
        return SimulatorError(f"{self.where}: {name}: expected {expected}, got {brief(value)}; mend it (docs/worlds.md)")

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
        """A closed polygon as segments."""
        if not isinstance(value, list) or len(value) < 3:
            raise self.wrong(name, "at least three points [x, y]", value)
        points = np.array([self.numbers(p, 2, f"{name}[{i}]") for i, p in enumerate(value)])
        return np.hstack([points, np.roll(points, -1, axis=0)])

    def route(self, value: Sequence[Any]) -> tuple[str, ...]:
        for i, action in enumerate(value):
            if action not in ("travel", "right", "left", "around"):
                raise self.wrong(f"route[{i}]", "travel, right, left or around", action)
        return tuple(value)

    def reach(self, value: Any) -> float:
        if not is_finite(value) or not NEAREST <= value <= FARTHEST:
            raise self.wrong("reach", f"metres above 0, {NEAREST} to {FARTHEST:,.0f}", value)
        return float(value)

    def angles(self, value: Any, walls: Array) -> Angles:
        if value not in (None, "right", "any"):
            raise self.wrong("angles", '"right" or "any"', value)
        chosen: Angles = value or ("right" if _are_square(walls) else "any")
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
        return Clutter(self.loop(value.get("polygon"), f"{name}.polygon"), (float(moves[0]), float(moves[1])), float(present))

    def dstate(self, value: Any, name: str) -> TrueDState:
        if not isinstance(value, Mapping) or value.get("direction") not in (1, -1):
            raise self.wrong(name, "an object with name, place, path, direction 1 or -1, pose", value)
        texts = [value.get(key) for key in ("name", "place", "path")]
        if not all(isinstance(text, str) for text in texts):
            raise self.wrong(name, "texts for name, place and path", value)
        label, place, path = map(str, texts)
        return TrueDState(label, place, path, int(value["direction"]), self.pose(value.get("pose"), f"{name}.pose"))
