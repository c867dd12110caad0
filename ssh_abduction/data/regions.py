"""Regions of a map: sets of places that directed paths bound, or that one place cuts off.

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

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import TypeAlias

from ssh_abduction.data.map_parts import signed_path
from ssh_abduction.data.schema import SparseData
from ssh_abduction.data.words import noun_of

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
