"""The topological level of a real building: its corridors, doors, rooms and junctions.

They follow from the finished map of a robot's log, as `ssh_abduction.building` derives them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from ssh_abduction.data.schema import FieldReader, Shape, SparseData

Point = tuple[float, float]  # x and y in metres, in the frame of the map


@dataclass(frozen=True, slots=True)
class WayOut(SparseData):
    """A door or another way out beside a corridor.

    Attributes:
        side: "left" or "right" of the corridor.
        metres: How far it is along the corridor, from its beginning.
        place: The place at which it leaves; None if the robot never drove through it.
        door: The id of the door; None for a way without a door.
        to: The place to which the way leads; None if it is unknown.
    """

    side: str
    metres: float
    place: int | None = None
    door: int | None = None
    to: int | None = None


@dataclass(frozen=True, slots=True)
class Corridor(SparseData):
    """A long and slim part of a path.

    Attributes:
        id: Its number. The longest corridor comes first.
        path: The id of its path.
        order: Its places, in the order of the path.
        line: Its course, from the first place on.
        length: Metres.
        width: The median width in metres.
        doors: The ids of the doors across it, such as fire doors.
        openings: The doors and other openings beside it, from its beginning on.
        left: The places left of it, its left wing.
        right: The places right of it, its right wing.
        around: The places that ways on both sides lead to.
    """

    id: int
    path: int
    order: tuple[int, ...]
    line: tuple[Point, ...]
    length: float
    width: float
    doors: tuple[int, ...] = ()
    openings: tuple[WayOut, ...] = ()
    left: tuple[int, ...] = ()
    right: tuple[int, ...] = ()
    around: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class MapRoom(SparseData):
    """The places that no door parts.

    Attributes:
        id: Its number.
        places: Its places, ascending.
        doors: The ids of its doors.
        corridors: The ids of the corridors that have places in it.
        outline: The polygon of its free space between the walls that were seen; empty if none were.
            A line without width leads to each block of walls in it, around it, and back.
    """

    id: int
    places: tuple[int, ...]
    doors: tuple[int, ...] = ()
    corridors: tuple[int, ...] = ()
    outline: tuple[Point, ...] = ()


@dataclass(frozen=True, slots=True)
class MapDoor(SparseData):
    """A door through which the robot drove.

    Attributes:
        id: Its number.
        at: Its position in metres.
        width: Metres.
        places: The places before and behind it. One that is missing is a corner without a place.
        rooms: The ids of the rooms before and behind it.
        dstates: The dstates from which travels through it begin.
    """

    id: int
    at: Point
    width: float
    places: tuple[int, ...] = ()
    rooms: tuple[int, ...] = ()
    dstates: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Wing:
    """The rooms on one side of a corridor.

    Attributes:
        corridor: The id of the corridor.
        side: "left" or "right" of it.
        rooms: The ids of the rooms, ascending.
    """

    corridor: int
    side: str
    rooms: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Indoors(SparseData):
    """What follows from the finished map of a building.

    Attributes:
        corridors: The corridors. The index is the id.
        rooms: The rooms. The index is the id.
        doors: The doors. The index is the id.
        junctions: Sets of places that are near each other and count as one junction.
        notes: What the map has no corridors, rooms or doors for, in sentences.
    """

    corridors: tuple[Corridor, ...] = ()
    rooms: tuple[MapRoom, ...] = ()
    doors: tuple[MapDoor, ...] = ()
    junctions: tuple[tuple[int, ...], ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def wings(self) -> tuple[Wing, ...]:
        """The sides of corridors on which whole rooms lie. A room is in one wing at most.

        If it lies beside several corridors, a corridor with a door or way to it counts, then the
        longest one.
        """
        found: dict[tuple[int, str], list[int]] = {}
        for room in self.rooms:
            beside = [
                (not any(o.side == side and o.to in room.places for o in c.openings), c.id, side)
                for c in self.corridors
                for side, places in (("left", c.left), ("right", c.right))
                if room.places and set(room.places) <= set(places)
            ]
            if beside:
                found.setdefault(min(beside)[1:], []).append(room.id)
        return tuple(Wing(*key, tuple(found[key])) for key in sorted(found))

    def hierarchy(self) -> dict[str, Any]:
        """Return the building as nested plain data: wings, rooms, junctions and places.

        Rooms that are in no wing, such as that of a corridor, come behind the wings.
        """
        wings = self.wings

        def room(number: int) -> dict[str, Any]:
            places = self.rooms[number].places
            junctions = [list(some) for some in self.junctions if set(some) <= set(places)]
            joined = {p for some in junctions for p in some}
            single = [p for p in places if p not in joined]
            return {"room": number, "junctions": junctions, "places": single}

        inside = {number for wing in wings for number in wing.rooms}
        return {
            "wings": [
                {"corridor": w.corridor, "side": w.side, "rooms": [*map(room, w.rooms)]}
                for w in wings
            ],
            "rooms": [room(r.id) for r in self.rooms if r.id not in inside],
        }

    def wing_of(self, room: int | None) -> Wing | None:
        """The wing of a room; None if it has none."""
        return next((wing for wing in self.wings if room in wing.rooms), None)

    def room_of(self, place: int | None) -> int | None:
        """The id of the room of a place; None if it has none."""
        return next((room.id for room in self.rooms if place in room.places), None)

    def corridor_of(self, place: int | None) -> int | None:
        """The id of the longest corridor through a place; None if there is none."""
        return next((c.id for c in self.corridors if place in c.order), None)

    def renumbered(
        self,
        place: Mapping[int | None, int],
        path: Mapping[int | None, int],
        dstate: Mapping[int, int],
    ) -> Indoors:
        """Return the same building with new numbers of places, paths and dstates."""

        def places(old: tuple[int, ...]) -> tuple[int, ...]:
            return tuple(place[p] for p in old)

        def one(old: int | None) -> int | None:
            return None if old is None else place[old]

        def corridor(c: Corridor) -> Corridor:
            openings = tuple(replace(o, place=one(o.place), to=one(o.to)) for o in c.openings)
            new: dict[str, Any] = {name: places(getattr(c, name)) for name in ("order", *SIDES)}
            return replace(c, path=path[c.path], openings=openings, **new)

        def door(d: MapDoor) -> MapDoor:
            dstates = tuple(sorted(dstate[s] for s in d.dstates))
            return replace(d, places=places(d.places), dstates=dstates)

        return Indoors(
            tuple(map(corridor, self.corridors)),
            tuple(replace(room, places=tuple(sorted(places(room.places)))) for room in self.rooms),
            tuple(map(door, self.doors)),
            tuple(tuple(sorted(places(some))) for some in self.junctions),
            self.notes,
        )


SIDES = ("left", "right", "around")


def read_building(read: FieldReader, value: Any, name: str) -> Indoors:
    """Read a building from the plain data of `Indoors.to_dict`. Raises MapError."""
    number, integer, integers = read.number, read.integer, read.integers
    point: Shape[Any] = read.several(number, "two numbers", 2)
    line: Shape[Any] = read.several(point, "a list of points")
    shapes: dict[str, Shape[Any]] = {
        **dict.fromkeys(("id", "path"), integer),
        **dict.fromkeys(("place", "door", "to"), read.maybe(integer)),
        **dict.fromkeys(("length", "width", "metres"), number),
        **dict.fromkeys(("line", "outline"), line),
        **{"at": point, "side": read.one_of(SIDES[:2])},
    }

    def each(kind: type[Any], **more: Shape[Any]) -> Callable[[Any, str], Any]:
        every = {f.name: (shapes | more).get(f.name, integers) for f in fields(kind)}
        return read.several(lambda value, name: read.record(kind, value, name, **every), "a list")

    own = {"corridors": each(Corridor, openings=each(WayOut)), "rooms": each(MapRoom)}
    own |= {"doors": each(MapDoor), "junctions": read.several(integers, "a list")}
    found = read.record(Indoors, value, name, notes=read.several(read.text, "a list"), **own)
    for kind in ("corridors", "rooms", "doors"):
        ids = [thing.id for thing in getattr(found, kind)]
        if ids != list(range(len(ids))):
            raise read.wrong(f"{name}.{kind}", "the ids 0, 1, 2, … in this order", ids)
    return found
