"""The parts of a map: dstates, paths, faults, poses, fits and regions. All are immutable.

A region is a set of places that directed paths bound, or that one place cuts off:

>>> regions = of_members({("beside", 0, 1): {4, 5}, ("between", 4): {4}, ("behind", 3): {4, 5}})
>>> for region in regions:
...     print(region)
region 0: places 4 and 5, right of path 0+, behind place 3
region 1: place 4, right of path 0+, in region 0

A region bounded by directed paths is the set of places that are known to lie right of all of them.
A place on no known side of a path is in no such region. A region behind a place can be left only
through this place, as far as the robot knows.

The last functions read and write the JSON of maps. See docs/reference/formats.md.
"""

from __future__ import annotations

import math
import os
import re
import shlex
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal, TypeAlias

from ssh_abduction.data.building import SIDES, read_building
from ssh_abduction.data.checks import View, a_path, a_whole_number
from ssh_abduction.data.errors import MapError, is_writable
from ssh_abduction.data.files import BadJson, opened_file, parse_json, save_file, source_of
from ssh_abduction.data.schema import FieldReader, Shape, SparseData
from ssh_abduction.data.words import noun_of

# What a person can name.
NAMED = ("place", "path", "region", "corridor", "room", "door")
_NUMBERED = re.compile(rf"(?:(d|dstate|p|{'|'.join(NAMED)}) ?)?([0-9]{{1,9}})", re.IGNORECASE)
_SHORT = {"d": "dstate", "p": "place", "": "dstate"}
FAULTS = ("misread", "misseen", "slipped", "jumped", "changed")
# The slots of the frame of a place, in words: the first dstate there faces slot 0.
SLOTS = ("ahead", "right", "behind", "left")
# What files of solutions and of single maps begin with.
SOLUTION_FORMAT, MAP_FORMAT, VERSION = "ssh-solution", "ssh-map", 1
# The most bytes of a file: some hundred thousand maps. Reading needs ten times more memory.
LARGEST = 2**30


@dataclass(frozen=True, slots=True)
class DState:
    """A distinctive state: a position and a heading that hill-climbing brings the robot to.

    Attributes:
        id: Its number.
        view: The view; None if the view of each step at the dstate is unknown.
        place: The number of its place; None if the theory has no places.
        path: The number of the path that it is along; None if there is none.
        direction: +1 or -1, which way it faces along its path; None without a path.
        heading: With star=frame, the slot that it faces: the directions at its place are numbered
            0 to 3, clockwise. With star=gateways, degrees from 0 to 359, clockwise from the
            heading of the first dstate at its place. Otherwise None.
        floor: The number of its floor; None if the trace has no lifts.
    """

    id: int
    view: View | None
    place: int | None = None
    path: int | None = None
    direction: int | None = None
    heading: int | None = field(default=None, compare=False)
    floor: int | None = field(default=None, compare=False)

    @property
    def shown(self) -> View:
        """The view to show to people; "?" if it is unknown."""
        return "?" if self.view is None else self.view

    @property
    def site(self) -> int:
        """The number of its place; without a place, a negative number of its own."""
        return -1 - self.id if self.place is None else self.place

    @property
    def course(self) -> str:
        """The path with the sign of the direction, such as "2+"; "" without a path."""
        return signed_path(self.path, self.direction)


def signed_path(path: int | None, direction: int | None) -> str:
    """Write a path with the sign of a direction, such as "2+"; "" without a path."""
    return "" if path is None else f"{path}{'+' if direction == 1 else '-'}"


@dataclass(frozen=True, slots=True)
class MapPath(SparseData):
    """A path and the order of its places.

    Attributes:
        id: Its number.
        order: The places, in the order of direction +1. With path_order=partial, several orders
            are consistent with the map, and this is one of them.
        line: Its course as points in metres; empty if the map has no poses.
        length: Metres along the line; None if there is none.
        width: The median width in metres; None if it is unknown.
        sure: For a path that was derived from the finished map of a log: the probability that it is
            right, by the cost of the best other pairing of edges. None for a path of the theory.
        left: The places left of it in direction +1.
        right: The places right of it in direction +1.
        around: The places that ways on both sides of it lead to.
    """

    id: int
    order: tuple[int, ...]
    line: tuple[tuple[float, float], ...] = field(default=(), repr=False)
    length: float | None = field(default=None, repr=False)
    width: float | None = field(default=None, repr=False)
    sure: float | None = field(default=None, repr=False)
    left: tuple[int, ...] = field(default=(), repr=False)
    right: tuple[int, ...] = field(default=(), repr=False)
    around: tuple[int, ...] = field(default=(), repr=False)

    def left_of(self, place: int) -> bool:
        """Whether a place is known to lie left of the path in direction +1."""
        return a_whole_number("place", place, MapError) in self.left

    def right_of(self, place: int) -> bool:
        """Whether a place is known to lie right of the path in direction +1."""
        return a_whole_number("place", place, MapError) in self.right


@dataclass(frozen=True, slots=True)
class Name:
    """A name that a person gave.

    Attributes:
        kind: What has the name: "place", "path", "region", "corridor", "room" or "door".
        id: Its number.
        text: The name.
    """

    kind: str
    id: int
    text: str

    def to_dict(self) -> dict[str, Any]:
        """Return the name as a file of maps has it."""
        return {self.kind: self.id, "name": self.text}


def thing_named(text: str, names: Iterable[Name] = ()) -> tuple[str, int] | None:
    """Return the kind and the number of what a text names; None if it names nothing.

    The text is a dstate, place, path or region by its number, such as "d7", "p4", "place 4" or
    "region2"; or one of the names that a person gave. A number alone is that of a dstate.

    >>> thing_named("p4"), thing_named("kitchen", [Name("place", 4, "kitchen")])
    (('place', 4), ('place', 4))
    """
    if found := _NUMBERED.fullmatch(text):
        kind = (found[1] or "").lower()
        return _SHORT.get(kind, kind), int(found[2])
    return next(((n.kind, n.id) for n in names if n.text == text), None)


def check_says_what(text: str, drive: str | None = None) -> None:
    """Raise MapError if a text is a number alone, as places, dstates and steps have numbers.

    `drive` is the name of a drive; None if the map does not name its drives.
    """
    if text.strip().isdecimal():
        n = text.strip()
        step = f"{drive}:{n}" if shlex.quote(drive or "") == drive else f"step{n}"
        ways = f"p{n} or d{n}" if drive is None else f"p{n}, d{n} or {step}"
        raise MapError(
            f"{n}: expected a place, a dstate or a step, got a number that may be any of these; "
            f"write {ways}"
        )


@dataclass(frozen=True, slots=True)
class Fault(SparseData):
    """A part of the trace that a map treats as wrong.

    Attributes:
        step: The step.
        kind: "misread": the view of the step differs from the view of its dstate. "misseen": the
            star (the gateways seen) of the step differs from the star of its dstate. "slipped": the
            action did not do what its name says, so no link leads from this step to the next one.
            "jumped": the displacement from the step before is wrong. "changed": a gateway was open
            on one drive and closed on another. The step is the first of the later drive at the
            place.
        seen: The view, the name of the action, or the displacement in words; None for a star. For a
            change, such as "closed on tuesday".
        expected: The view of the dstate if the view is misread. For a change, what an earlier drive
            saw, such as "open on monday".
        cost: The cost of the fault, in dstates.
        place: For a change, the number of the place.
        gateway: For a change of one of four openings, the slot of the gateway at the place. Slots
            are numbered 0 to 3, clockwise from the heading of the first dstate there.
        bearing: For a change of a gateway at a bearing, its direction in degrees, clockwise from
            the heading of the first dstate at the place.
        towards: For a change in a map with poses, the direction of the gateway in pictures, such as
            "north" for up.
    """

    step: int
    kind: Literal["misread", "misseen", "slipped", "jumped", "changed"]
    seen: View | None = None
    expected: View | None = None
    cost: float = field(default=0.0, compare=False)
    place: int | None = None
    gateway: int | None = None
    towards: str | None = field(default=None, compare=False)
    bearing: int | None = None

    def __str__(self) -> str:
        if self.kind == "changed":
            way = f"{self.towards or SLOTS[self.gateway or 0]}"
            way += " of" if self.towards else " at the first dstate of"
            way = way if self.bearing is None else f"at {self.bearing} degrees of"
            return f"the gateway {way} place {self.place} was {self.expected} and {self.seen}"
        return {
            "misread": f"the view at step {self.step} is misread: {self.seen}, expected "
            f"{self.expected}",
            "misseen": f"the star at step {self.step} is misread",
            "jumped": f"the displacement that leads to step {self.step} is wrong: {self.seen}",
            "slipped": f"the action at step {self.step} slipped: {self.seen}",
        }[self.kind]


@dataclass(frozen=True, slots=True)
class Pose:
    """The pose of a dstate relative to the dstate of the first step.

    Attributes:
        x: Metres ahead of the first dstate.
        y: Metres to its left.
        heading: Radians, counterclockwise.
        spread: The covariance of x and y, as (xx, xy, yy), in square metres.
    """

    x: float
    y: float
    heading: float
    spread: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Fit:
    """How well a map agrees with the displacements of its trace.

    Attributes:
        chi2: The sum of the squared normalised residuals.
        dof: The degrees of freedom. If the map and the noise model are right, chi2 is near dof.
        p: The probability that chi2 has this value or a larger one.
        scale: The share by which displacements are too long.
        bend: The drift of the heading, in radians per metre.
        poses: The poses of the dstates. The index is the id of the dstate.
    """

    chi2: float
    dof: int
    p: float
    scale: float = 0.0
    bend: float = 0.0
    poses: tuple[Pose, ...] = field(default=(), repr=False)

    def to_dict(self) -> dict[str, float]:
        """Return chi2, dof, p, scale and bend as a dict, rounded to six digits behind the point."""
        names = ("chi2", "dof", "p", "scale", "bend")
        return {name: round(getattr(self, name), 6) for name in names}


# What makes places a region: ("beside", path, direction), ("between", place) or ("behind", place).
Reason: TypeAlias = tuple[str, int] | tuple[str, int, int]


@dataclass(frozen=True, slots=True)
class Region(SparseData):
    """A set of places of a map.

    Attributes:
        id: Its number. A region comes after all regions that contain it.
        places: The ids of its places, ascending.
        bounds: Directed paths, as pairs of a path and a direction (+1 or -1). All places of the
            region are known to lie right of each.
        door: The place through which all known ways lead to the region; None if there is none. The
            door is not in the region.
        inside: The ids of the smallest regions that contain all its places and more.
    """

    id: int
    places: tuple[int, ...]
    bounds: tuple[tuple[int, int], ...] = ()
    door: int | None = None
    inside: tuple[int, ...] = ()

    def __str__(self) -> str:
        return described(self, named_by_number)


def described(region: Region, called: Callable[[str, int], str]) -> str:
    """Say what the region is. `called` puts a kind and a number into words, as `SSHMap.called`."""
    places = f"{noun_of('place', region.places)} {list_in_words(region.places)}"
    parts = [f"{called('region', region.id)}: {places}"]
    if region.bounds:
        parts.append(f"right of {list_in_words(map(course_named, region.bounds))}")
    if region.door is not None:
        parts.append(f"behind {called('place', region.door)}")
    if region.inside:
        parts.append(f"in {noun_of('region', region.inside)} {list_in_words(region.inside)}")
    return ", ".join(parts)


def of_members(members: Mapping[Reason, Collection[int]]) -> tuple[Region, ...]:
    """Make a region from each different set of places, and find which regions contain which.

    The largest comes first. `members` has, for each reason to make a region, the places of the
    region. An empty set makes no region. All directed paths that bound a set are its bounds.
    """
    right: dict[tuple[int, int], set[int]] = {}
    doors: dict[frozenset[int], int] = {}
    for reason, places in members.items():
        if reason[0] == "beside" and len(reason) == 3 and places:
            right[reason[1], reason[2]] = set(places)
        elif reason[0] == "behind" and places:
            doors[frozenset(places)] = reason[1]
    sets = {frozenset(places) for places in members.values() if places}
    ordered = sorted(sets, key=lambda places: (-len(places), sorted(places)))
    return tuple(
        Region(
            i,
            tuple(sorted(places)),
            tuple(sorted(course for course, beside in right.items() if places <= beside)),
            doors.get(places),
            _smallest_around(places, ordered[:i]),
        )
        for i, places in enumerate(ordered)
    )


def _smallest_around(places: frozenset[int], before: Iterable[frozenset[int]]) -> tuple[int, ...]:
    """The indices of the smallest earlier sets that contain these places and more."""
    around = {i: other for i, other in enumerate(before) if places < other}
    return tuple(
        i for i, other in around.items() if not any(within < other for within in around.values())
    )


def right_of(regions: Iterable[Region], path: int, direction: int) -> tuple[int, ...]:
    """Return the ids of the places that are known to lie right of a path in a direction, +1 or -1.

    The places left of the path in direction +1 are right of it in -1.
    """
    return tuple(sorted({q for r in regions if (path, direction) in r.bounds for q in r.places}))


def regions_at(regions: Iterable[Region], place: int) -> tuple[Region, ...]:
    """Find the regions that contain a place, the largest first."""
    return tuple(region for region in regions if place in region.places)


def ids_at(regions: Iterable[Region] | None, place: int | None) -> tuple[int, ...]:
    """Find the ids of the regions that contain a place."""
    return tuple(region.id for region in regions or () if place in region.places)


def region_of(regions: Iterable[Region] | None, place: int | None) -> int | None:
    """Find the region that a person means by naming a place in it.

    It is the smallest region with the place and a door, or else the smallest with the place. None
    if no region has the place.
    """
    around = [region for region in regions or () if place in region.places]
    behind = [region for region in around if region.door is not None]
    return (behind or around)[-1].id if around else None


def renumbered(
    regions: Iterable[Region],
    place: Mapping[int | None, int],
    path: Mapping[int | None, int],
    flipped: Collection[int | None],
) -> tuple[tuple[Region, ...], dict[int | None, int]]:
    """Return regions with new numbers of places and paths, and the new numbers of the regions.

    `flipped` has the old numbers of the paths whose directions are exchanged.
    """
    new = [
        replace(
            region,
            places=tuple(sorted(place[p] for p in region.places)),
            bounds=tuple(sorted((path[h], -d if h in flipped else d) for h, d in region.bounds)),
            door=None if region.door is None else place[region.door],
        )
        for region in regions
    ]
    new.sort(key=lambda region: (-len(region.places), region.places))
    number: dict[int | None, int] = {region.id: i for i, region in enumerate(new)}
    found = tuple(
        replace(region, id=i, inside=tuple(sorted(number[k] for k in region.inside)))
        for i, region in enumerate(new)
    )
    return found, number


def named_by_number(kind: str, number: int) -> str:
    """Name a thing by its number: "place 4"."""
    return f"{kind} {number}"


def course_named(course: tuple[int, int]) -> str:
    """Name a directed path: "path 2+" is path 2 in direction +1."""
    return f"path {signed_path(*course)}"


def list_in_words(parts: Iterable[object]) -> str:
    """List things in words: "1, 2 and 3"."""
    words = [*map(str, parts)]
    return " and ".join([", ".join(words[:-1]), *words[-1:]] if words[1:] else words)


def write_map(path: str | os.PathLike[str], text: str, what: str = "map") -> None:
    """Write a map, or a picture of one, into a file, with a line end. Raises MapError."""
    save_file(a_path("path", path, MapError), f"{text}\n".encode(), what, MapError)


def read_json(path: str | os.PathLike[str], what: str = "file of maps") -> Any:
    """Read the JSON value in a file of maps, or of what `what` says; "-" means standard input.

    Raises:
        MapError: If the file cannot be read or does not hold exactly one JSON value. The error
            names the file and, if JSON is broken, the line.
    """
    path = a_path("path", path, MapError)
    source = source_of(path)
    with opened_file(path, f"a readable {what}", MapError) as file:
        text = file.read(LARGEST + 1)
    fewer = "list fewer (solve --maps)"
    mend = FieldReader.mend if what == "file of maps" else "write JSON"
    if len(text) > LARGEST:
        raise MapError(f"{source}: expected at most {LARGEST // 2**20} MiB, got more; {fewer}")
    if not text.strip():
        raise MapError(f"{source}: expected JSON, got an empty file; {mend}")
    try:
        return parse_json(text)
    except MemoryError:
        raise MapError(
            f"{source}: expected maps that fit into memory, got a larger file; {fewer}"
        ) from None
    except BadJson as error:
        if text.startswith(b'{"format": "ssh-trace"'):
            raise MapError(
                f"{source}: expected maps, got a trace; swap the two files, or solve it first"
            ) from None
        where = source if error.line is None else f"{source}:{error.line}"
        if "Extra data" in str(error):
            raise MapError(
                f"{where}: expected one JSON value, got more after it; "
                "solve prints a line for each of several traces: take one of them"
            ) from None
        where += f": {error.field}" if error.field else ""
        said = f"expected {error.expected}, got {error}; {error.mend or mend}"
        raise MapError(f"{where}: {said}") from None


def check_format(data: Mapping[str, Any], expected: str, where: str) -> None:
    """Raise MapError if the field `format` or `version` of a file has another value."""
    read = FieldReader(where)
    if data.get("format", expected) != expected:
        raise read.wrong("format", f'"{expected}"', data["format"])
    version = data.get("version", VERSION)
    if version != VERSION or isinstance(version, bool):
        read.mend = "read it with the ssh-abduction that wrote it, or solve again"
        raise read.wrong("version", str(VERSION), version)


def map_fields(data: Any, where: str) -> dict[str, Any]:
    """Convert the JSON of a map, as `SSHMap.to_dict` makes it, to the arguments of SSHMap by name.

    Raises MapError, which names the field.
    """
    return _MapReader(where).fields(data)


class _MapReader(FieldReader):
    """Reads and checks the fields of a map."""

    @property
    def pair(self) -> Shape[Any]:
        """The shape of two integers."""
        return self.several(self.integer, "a list of two numbers", 2)

    def fields(self, data: Any) -> dict[str, Any]:
        """Return the arguments of SSHMap by name."""
        record = self.mapping(data, "")
        each, may_have = partial(self.each, record), partial(self.each, record, optional=True)
        dstates = each("dstates", self._dstate)
        places, paths = may_have("places", self.integer), may_have("paths", self._path)
        names = may_have("names", self._name)
        # Fields refer to dstates, places and paths by their ids, so check these first.
        self._check_numbered("dstates", dstates)
        self._check_listed("places", places, {s.place for s in dstates})
        self._check_listed("places", places, {q for path in paths for q in path.order})
        self._check_listed("paths", [path.id for path in paths], {s.path for s in dstates})
        label = self.within(0, len(dstates) - 1, f"the id of one of {len(dstates)} dstates")
        if not (labels := each("labels", label)):
            raise self.wrong("labels", "the dstate of each step", [])
        last = len(labels) - 1
        starts = may_have("starts", self.within(1, last, f"a step from 1 to {last}"))
        if list(starts) != sorted({*starts}):
            raise self.wrong("starts", "steps in order", list(starts))
        self._check_once("names", [name.text for name in names])
        region = partial(self._region, {*places}, {path.id for path in paths})
        regions = None if record.get("regions") is None else each("regions", region)
        self._check_numbered("regions", regions or ())
        return {
            "dstate_at": labels,
            "starts": starts,
            "dstates": dstates,
            "links": each("links", partial(self._link, len(dstates))),
            "places": places,
            "paths": paths,
            "excused": may_have("excused", self.pair),
            "faults": may_have("faults", partial(self._fault, len(labels))),
            "fit": self._fit(record, len(dstates)),
            "regions": regions,
            "names": names,
            "building": None
            if record.get("building") is None
            else read_building(self, record["building"], "building"),
        }

    def _check_numbered(self, name: str, things: Sequence[DState | Region]) -> None:
        """Check that the ids are the indices."""
        ids = [thing.id for thing in things]
        if ids != list(range(len(ids))):
            raise self.wrong(name, "the ids 0, 1, 2, … in this order", ids)

    def _check_listed(self, name: str, ids: Sequence[int], used: Set[int | None]) -> None:
        """Check that all ids that are used are listed, each once."""
        if missing := used - {None, *ids}:
            expected = f"every id that is used, also {min(missing, key=str)}"
            raise self.wrong(name, expected, list(ids))
        self._check_once(name, ids)

    def _check_once(self, name: str, values: Sequence[object]) -> None:
        if len(set(values)) < len(values):
            raise self.wrong(name, "each once", list(values))

    def _dstate(self, value: Any, name: str) -> DState:
        """Read a dstate. The caller checks that its place and path exist."""
        expected = "a text or an integer, or null where it is unknown"
        if "view" not in self.mapping(value, name):
            raise self.wrong(f"{name}.view", expected, None)
        number = self.maybe(self.integer)
        dstate = self.record(
            DState,
            value,
            name,
            id=self.integer,
            view=self.view(expected),
            place=number,
            path=number,
            direction=number,
            heading=self.maybe(self.within(0, 359, "a slot, 0 to 3, or degrees, 0 to 359")),
            floor=self.maybe(self.within(0, math.inf, "the number of a floor, from 0")),
        )
        way = dstate.direction
        if way not in (None, 1, -1) or (way is None) != (dstate.path is None):
            raise self.wrong(
                f"{name}.direction", "1 or -1 where there is a path, null elsewhere", way
            )
        return dstate

    def _path(self, value: Any, name: str) -> MapPath:
        line: Shape[Any] = self.several(self.several(self.number, "two numbers", 2), "points")
        path = self.record(
            MapPath,
            value,
            name,
            id=self.integer,
            order=self.integers,
            line=line,
            **dict.fromkeys(("length", "width", "sure"), self.number),
            **dict.fromkeys(SIDES, self.integers),
        )
        if len(set(path.order)) < len(path.order):
            raise self.wrong(f"{name}.order", "each place once", list(path.order))
        return path

    def _link(self, dstates: int, value: Any, name: str) -> tuple[int, str, int]:
        """Read a link. Its two dstates have ids below `dstates`."""
        good = (
            isinstance(value, list)
            and len(value) == 3
            and type(value[0]) is type(value[2]) is int
            and isinstance(value[1], str)
        )
        if not good or not is_writable(value[1]) or not all(0 <= s < dstates for s in value[::2]):
            raise self.wrong(name, "[dstate, action name, dstate]", value)
        return value[0], value[1], value[2]

    def _fault(self, steps: int, value: Any, name: str) -> Fault:
        """Read a fault. Its step must be less than `steps`."""
        number, view = self.maybe(self.integer), self.view("a text or an integer")
        fault = self.record(
            Fault,
            value,
            name,
            kind=self.one_of(FAULTS),
            step=self.within(0, steps - 1, f"a step from 0 to {steps - 1}"),
            seen=view,
            expected=view,
            cost=self.number,
            place=number,
            gateway=number,
            towards=self.maybe(self.text),
            bearing=number,
        )
        if fault.kind == "changed":
            placed, bearing = fault.place is not None, fault.bearing
            if bearing is None and not (placed and fault.gateway in range(4)):
                what = "a slot, 0 to 3, and a place, for a change"
                raise self.wrong(f"{name}.gateway", what, fault.gateway)
            if bearing is not None and not (placed and 0 <= bearing < 360):
                what = "degrees, 0 to 359, and a place, for a change"
                raise self.wrong(f"{name}.bearing", what, bearing)
        return fault

    def _region(self, places: Set[int], paths: Set[int], value: Any, name: str) -> Region:
        """Read a region. Its places and paths must be those of the map."""
        region = self.record(
            Region,
            value,
            name,
            id=self.integer,
            places=self.integers,
            bounds=self.several(self.pair, "a list"),
            door=self.maybe(self.integer),
            inside=self.integers,
        )
        spots = [*region.places, *(() if region.door is None else (region.door,))]
        if not region.places or not {*spots} <= places:
            raise self.wrong(f"{name}.places", "some places of the map", spots)
        if any(h not in paths or d not in (1, -1) for h, d in region.bounds):
            expected = "pairs of a path of the map and 1 or -1"
            raise self.wrong(f"{name}.bounds", expected, [*region.bounds])
        if any(not 0 <= i < region.id for i in region.inside):
            raise self.wrong(f"{name}.inside", "numbers of earlier regions", [*region.inside])
        return region

    def _name(self, value: Any, name: str) -> Name:
        """Read the name of a place, path or region."""
        record = self.mapping(value, name)
        kind = next((kind for kind in NAMED if kind in record), None)
        if kind is None or not isinstance(record.get("name"), str):
            raise self.wrong(name, f"a name, and one of {', '.join(NAMED)}", value)
        return Name(kind, self.integer(record[kind], f"{name}.{kind}"), record["name"])

    def _fit(self, record: Mapping[str, Any], dstates: int) -> Fit | None:
        """Read the fit, with the poses of the dstates; None if there is none."""
        if record.get("fit") is None:
            return None
        numbers = dict.fromkeys(("chi2", "dof", "p", "scale", "bend"), self.number)
        fit = self.record(Fit, record["fit"], "fit", **numbers)
        three: Shape[Any] = self.several(self.number, "three numbers", 3)
        rows, spreads = (
            self.each(record, name, three, optional=True) for name in ("poses", "spreads")
        )
        for name, listed in (("poses", rows), ("spreads", spreads)):
            if listed and len(listed) != dstates:
                raise self.wrong(name, f"{dstates}, one per dstate", len(listed))
        spreads = spreads or ((0.0, 0.0, 0.0),) * len(rows)
        poses = tuple(
            Pose(x, y, way, spread) for (x, y, way), spread in zip(rows, spreads, strict=True)
        )
        return replace(fit, dof=int(fit.dof), poses=poses)
