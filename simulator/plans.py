"""Floor plans of real buildings: rooms, and the doors between them.

Plans are read from XML files, as in M. Luperto's data set of school plans. A file has rooms
(`space`) as polygons in pixels, doors (`portal`), and the size of a pixel. `simulator/rounds.py`
makes the walls of a plan, and drives a robot through them.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from scipy.optimize import linear_sum_assignment

from simulator.errors import SimulatorError
from ssh_abduction.data.checks import a_path, a_text, all_instances
from ssh_abduction.data.errors import brief, named, printable
from ssh_abduction.data.files import read_file

Point = tuple[float, float]
# Largest size of a plan in bytes.
LARGEST = 64 * 2**20
METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}


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
    def load(cls, path: str | os.PathLike[str]) -> Self:
        """Load a plan from an XML file.

        Raises:
            SimulatorError: The plan is wrong. The text names the part that is wrong.
        """
        return cls(*read_plan(path))


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
        try:
            value = float(text or "")
        except ValueError:
            value = math.nan
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
