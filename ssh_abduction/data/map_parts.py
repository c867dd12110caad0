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
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, TypeAlias

from ssh_abduction.data.checks import View
from ssh_abduction.data.schema import PlainData, SparseData
from ssh_abduction.data.words import noun_of

# What a person can name.
NAMED = ("place", "path", "region")
_NUMBERED = re.compile(r"(?:(p|place|path|region) ?)?([0-9]{1,9})")
FAULTS = ("misread", "misseen", "slipped", "jumped", "changed")
# The slots of the frame of a place, in words: the first dstate there faces slot 0.
SLOTS = ("ahead", "right", "behind", "left")


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
class MapPath(PlainData):
    """A path and the order of its places.

    Attributes:
        id: Its number.
        order: The places, in the order of direction +1. With path_order=partial, several orders
            are consistent with the map, and this is one of them.
    """

    id: int
    order: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Name:
    """A name that a person gave.

    Attributes:
        kind: What has the name: "place", "path" or "region".
        id: The number of the place, path or region.
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

    The text is the number of a dstate, such as "7"; a place, path or region by its number, such as
    "p4", "place 4" or "region2"; or one of the names that a person gave.

    >>> thing_named("p4"), thing_named("kitchen", [Name("place", 4, "kitchen")])
    (('place', 4), ('place', 4))
    """
    if found := _NUMBERED.fullmatch(text):
        kind = found[1] or "dstate"
        return "place" if kind == "p" else kind, int(found[2])
    return next(((n.kind, n.id) for n in names if n.text == text), None)


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
        bounds: The directed paths that are known to have all its places on their right, as pairs
            of a path and a direction (+1 or -1).
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
    *first, last = map(str, parts)
    return f"{', '.join(first)} and {last}" if first else last
