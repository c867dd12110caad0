"""Find the places that rival maps know to lie right or left of a path: in all maps, or in some.

>>> from ssh_abduction import Trace, solve
>>> found = shared_sides(Listing.of(solve(Trace.load("examples/aces3-route.jsonl"))))
>>> len(found.forced), len(found.possible), found.proven
(5, 11, True)
>>> print(found.forced[0])
the place of step 0 lies right of the path of step 2

Maps number places and paths differently. So a place is named by the first step there, and a path
with a direction by the first step along it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

from ssh_abduction.checker.moves import course_of
from ssh_abduction.data.checks import an_instance
from ssh_abduction.data.drives import named_steps
from ssh_abduction.data.errors import MapError
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.regions import right_of
from ssh_abduction.data.schema import PlainData
from ssh_abduction.data.words import counted
from ssh_abduction.rivals.listing import Listing

SHOWN = 2  # a sentence names at most this many sides

_Side: TypeAlias = Literal["right", "left"]


@dataclass(frozen=True, slots=True)
class Beside(PlainData):
    """A place that lies right or left of a path.

    Right and left are as seen by the robot at the step `along`.
    """

    step: int  # the first step at the place
    along: int  # the first step along the path
    side: _Side  # the side of the path on which the place lies
    share: float = 1.0  # the share of the compared maps in which this is known, 0 to 1

    def __str__(self) -> str:
        where = f"the place of step {self.step} lies {self.side} of the path of step {self.along}"
        return where if self.share == 1 else f"{where} ({self.share:.0%})"


@dataclass(frozen=True, slots=True)
class SharedSides(PlainData):
    """The places known to lie beside paths in minimal maps.

    Attributes:
        forced: The places known to lie beside a path in all of these maps.
        possible: The places known to lie beside a path in some of these maps, but not in all.
        proven: Whether all minimal maps were compared, and all of them list regions.
    """

    forced: tuple[Beside, ...]
    possible: tuple[Beside, ...]
    proven: bool

    def __str__(self) -> str:
        maps = "maps" if self.proven else "maps that were found"
        forced = (
            f"all {maps} know in {counted(len(self.forced), 'cases')} on which side of a path a "
            "place lies"
        )
        if not self.possible:
            return forced
        more = len(self.possible) - SHOWN
        some = [*map(str, self.possible[:SHOWN]), *([f"and {more} more"] if more > 0 else [])]
        return f"{forced}, and some maps in {len(self.possible)} more: {'; '.join(some)}"


def shared_sides(listing: Listing) -> SharedSides | None:
    """Find the places known to lie beside a path in all minimal maps, or in some of them.

    Args:
        listing: The maps.

    Returns:
        The places beside paths; None if no map lists regions.
    """
    an_instance("listing", listing, Listing, MapError, mend="make one with Listing.of")
    minimal = listing.maps[: listing.minimal]
    with_regions = [m for m in minimal if m.regions is not None]
    if not with_regions:
        return None
    found = _sides(with_regions, named_steps(listing.drives, listing.steps))
    count = len(with_regions)
    named = [
        Beside(i, j, side, sides.count(side) / count)
        for (i, j), sides in found.items()
        for side in ("right", "left")
        if side in sides
    ]
    proven = listing.complete is True and count == len(minimal)
    return SharedSides(
        tuple(side for side in named if side.share == 1),
        tuple(sorted((s for s in named if s.share < 1), key=lambda s: (-s.share, s.step))),
        proven,
    )


def only_in(
    first: SSHMap, other: SSHMap, steps: Sequence[int]
) -> tuple[tuple[Beside, ...], tuple[Beside, ...]]:
    """Find places beside paths that only the first map has, and those that only the other has.

    Both are empty if a map has no regions. `steps` are the numbers of all steps.
    """
    if first.regions is None or other.regions is None:
        return (), ()
    here, there = (
        tuple(
            Beside(i, j, side)
            for (i, j), sides in _sides([first, other], steps).items()
            if (side := sides[k]) is not None and sides[1 - k] != side
        )
        for k in (0, 1)
    )
    return here, there


def _sides(
    maps: Sequence[SSHMap], steps: Sequence[int]
) -> dict[tuple[int, int], list[_Side | None]]:
    """Find the side of a path on which a place lies, in each map; None if unknown.

    A key is the first step at the place and the first step along the path.
    """
    courses_of = [[(path.id, d) for path in m.paths for d in (1, -1)] for m in maps]
    beside = [
        {course: {*right_of(m.regions or (), *course)} for course in listed}
        for m, listed in zip(maps, courses_of, strict=True)
    ]
    states = [[m.dstates[label] for label in m.dstate_at] for m in maps]
    # Places and courses that coincide in all maps are asked about once, by their first steps.
    places: dict[tuple[int | None, ...], int] = {}
    courses: dict[tuple[tuple[int, int] | None, ...], int] = {}
    for t in steps:
        places.setdefault(tuple(of[t].place for of in states), t)
        here = tuple(course_of(of[t]) for of in states)
        back = tuple(course and (course[0], -course[1]) for course in here)
        if back not in courses:
            courses.setdefault(here, t)
    found: dict[tuple[int, int], list[_Side | None]] = {}
    for at, i in places.items():
        for along, j in courses.items():
            sides = [
                _side(right, place, course)
                for right, place, course in zip(beside, at, along, strict=True)
            ]
            if any(sides):
                found[i, j] = sides
    return found


def _side(
    right: dict[tuple[int, int], set[int]], place: int | None, course: tuple[int, int] | None
) -> _Side | None:
    """The side of a course on which a place lies; None if unknown.

    `right` has the places to the right of each course (path and direction).
    """
    if course is None:
        return None
    if place in right[course]:
        return "right"
    return "left" if place in right[course[0], -course[1]] else None
