"""Find what differs between two maps of one trace.

>>> from ssh_abduction.data.maps import DState, SSHMap
>>> a, b = DState(0, "hall"), DState(1, "hall")
>>> found = difference(SSHMap((0, 0, 1), (a, b), ()), SSHMap((0, 1, 1), (a, b), ()))
>>> print(found)
dstates: the first map groups steps 0–1 | 2; the other one groups steps 0 | 1–2

The steps of one dstate in a map may be at several dstates in the other map. Dstates of the two maps
that share a step are connected. If the two maps group the steps of a connected part differently,
the part is one `Change`. The other parts are the same in both maps. Places, paths and courses are
compared in the same way.

A map with regions also knows on which side of a path a place lies: in all maps, or in some.

>>> from ssh_abduction import Trace, solve
>>> from ssh_abduction.rivals.listing import Listing
>>> found = shared_sides(Listing.of(solve(Trace.load("examples/aces3-route.jsonl"))))
>>> len(found.forced), len(found.possible), found.proven
(5, 11, True)
>>> print(found.forced[0])
the place of step 0 lies right of the path of step 2

Maps number places and paths differently. So a place is named by the first step there, and a path
with a direction by the first step along it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any, Literal, TypeAlias

import networkx as nx

from ssh_abduction.checker.reading import course_of
from ssh_abduction.data.checks import a_list, a_text, all_instances, an_instance
from ssh_abduction.data.drives import Drive, named_steps
from ssh_abduction.data.errors import MapError, brief, printable
from ssh_abduction.data.groups import firsts, gathered, indices_of
from ssh_abduction.data.map_parts import right_of
from ssh_abduction.data.maps import Fault, SSHMap, checked_map
from ssh_abduction.data.schema import PlainData, attributes_of
from ssh_abduction.data.words import counted, noun_of
from ssh_abduction.rivals.listing import Listing
from ssh_abduction.rivals.questions import NONE, Table
from ssh_abduction.solution import Sort, stretches

Steps: TypeAlias = tuple[int, ...]
Link: TypeAlias = tuple[int, str, int]

SORTED_BY = {
    "dstates": "dstates",
    "places": "places",
    "paths": "paths",
    "courses": "directions along paths",
}
# At most this many changes of one sort, and at most this many links, are put into words.
LISTED = 12
SHOWN = 2  # a sentence names at most this many sides
_Side: TypeAlias = Literal["right", "left"]


@dataclass(frozen=True, slots=True)
class Change:
    """Steps that two maps group differently, by dstate, place, path or course."""

    # What the steps are grouped by: "dstates", "places", "paths" or "courses" (a path and the
    # direction along it).
    sort: Sort
    first: tuple[Steps, ...]  # the groups of steps in the first map, sorted by first step
    other: tuple[Steps, ...]  # the groups of the same steps in the other map
    first_none: Steps = ()  # the steps that are at no place, or along no path, in the first map
    other_none: Steps = ()  # the steps that are at no place, or along no path, in the other map

    def in_words(self, names: tuple[str, str]) -> str:
        """Put the change into words, with these names for the two maps."""
        sides = ((self.first, self.first_none), (self.other, self.other_none))
        return "; ".join(
            f"{name} {_groups_in_words(*side)}" for name, side in zip(names, sides, strict=True)
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the change as plain data, as `compare --diff --json` prints it."""
        more = ("first_none", "other_none") if self.first_none or self.other_none else ()
        return attributes_of(self, "sort", "first", "other", *more)


@dataclass(frozen=True, slots=True)
class Difference:
    """The difference between two maps of one trace.

    Each pair has a value for the first map and a value for the other map.

    Attributes:
        ids: The ids of both maps.
        names: The names of both maps in words.
        sizes: For each map, the numbers of dstates, places, paths and links.
        changes: The steps that the maps group differently.
        links: For each map, the links that the other map lacks, between dstates that have the same
            steps in both maps. A dstate is named by its first step.
        faults: For each map, the faults that the other map lacks.
        chi2: The chi-square of each map; None if one of them has no fit.
        has_places: For each map, whether it has places.
        sides: For each map, its statements "this place lies right (left) of this path" that the
            other map does not make; empty if a map has no regions.
    """

    ids: tuple[str, str]
    names: tuple[str, str]
    sizes: tuple[tuple[int, int, int, int], tuple[int, int, int, int]]
    changes: tuple[Change, ...]
    links: tuple[tuple[Link, ...], tuple[Link, ...]]
    faults: tuple[tuple[Fault, ...], tuple[Fault, ...]]
    chi2: tuple[float, float] | None = None
    has_places: tuple[bool, bool] = (True, True)
    sides: tuple[tuple[Beside, ...], tuple[Beside, ...]] = ((), ())

    @property
    def same(self) -> bool:
        """Whether the maps are the same up to renaming."""
        return self.ids[0] == self.ids[1]

    @property
    def lines(self) -> tuple[str, ...]:
        """The difference in words, line by line; causes come before effects."""
        lines = []
        counts = zip(("dstates", "places", "paths", "links"), *self.sizes, strict=True)
        if unequal := [f"{counted(a, name)} against {b}" for name, a, b in counts if a != b]:
            lines.append(f"size: {self.names[0]} has {', '.join(unequal)} of {self.names[1]}")
        for name, faults in zip(self.names, self.faults, strict=True):
            lines += [f"faults: only in {name} {printable(str(fault))}" for fault in faults]
        for sort, word in SORTED_BY.items():
            changes = [change for change in self.changes if change.sort == sort]
            lines += [f"{word}: {change.in_words(self.names)}" for change in changes[:LISTED]]
            if len(changes) > LISTED:
                lines.append(f"{word}: {counted(len(changes) - LISTED, 'more changes')}")
        for name, links in zip(self.names, self.links, strict=True):
            some = [
                f"{printable(action)} from the dstate of step {s} to that of step {x}"
                for s, action, x in links
            ]
            lines += [f"links: only in {name} {_listed(some)}"] if some else []
        for name, sides in zip(self.names, self.sides, strict=True):
            lines += [f"sides: only {name} knows that {_listed(sides)}"] if sides else []
        if any(self.has_places) and not all(self.has_places):
            lines.append(f"places and paths: only in {self.names[self.has_places.index(True)]}")
        if self.chi2 and self.chi2[0] != self.chi2[1]:
            lines.append(
                f"fit: a chi-square of {self.chi2[0]:.1f} for {self.names[0]}, {self.chi2[1]:.1f} "
                f"for {self.names[1]}"
            )
        return tuple(lines)

    def __str__(self) -> str:
        return "\n".join(self.lines) or "the maps are the same"

    def to_dict(self) -> dict[str, Any]:
        """Return plain data, as `compare --diff --json` prints it (docs/reference/formats.md)."""
        sizes = [
            dict(zip(("dstates", "places", "paths", "links"), size, strict=True))
            for size in self.sizes
        ]
        data = attributes_of(self, "ids", "same") | {"sizes": sizes}
        data |= attributes_of(self, "changes", "links", "has_places", "sides", "faults")
        data["words"] = list(self.lines)
        return data | (attributes_of(self, "chi2") if self.chi2 else {})


def difference(
    first: SSHMap,
    other: SSHMap,
    names: tuple[str, str] = ("the first map", "the other one"),
    *,
    drives: Sequence[Drive] = (),
) -> Difference:
    """Find what differs between two maps of one trace.

    Args:
        first: A map.
        other: Another map.
        names: What to call the two maps in words.
        drives: The drives of the trace, to call a step "monday:12"; empty if they are unknown.

    Returns:
        The difference. Its `same` is True if the maps are the same up to renaming.

    Raises:
        MapError: The maps have different numbers of steps.
    """
    checked_map(first, "first")
    checked_map(other, "other")
    called = tuple(
        a_text(f"names[{i}]", name, MapError)
        for i, name in enumerate(a_list("names", names, MapError))
    )
    if len(called) != 2:
        raise MapError(f"names: expected two, one for each map, got {brief(names)}; name both")
    named = all_instances("drives", drives, Drive, MapError, mend="take those of a solution")
    _check_steps(first, other, named)
    first, other = first.renumbered(), other.renumbered()
    table = Table([first, other], named)
    faults = [
        tuple(f for f in mine.faults if f not in theirs.faults)
        for mine, theirs in ((first, other), (other, first))
    ]
    return Difference(
        ids=(first.id, other.id),
        names=(called[0], called[1]),
        sizes=(_size(first), _size(other)),
        changes=tuple(_all_changes(table)),
        links=_links_only_in(first, other, table.steps),
        faults=(faults[0], faults[1]),
        chi2=(first.fit.chi2, other.fit.chi2) if first.fit and other.fit else None,
        has_places=(bool(first.places), bool(other.places)),
        sides=only_in(first, other, table.steps),
    )


def _check_steps(first: SSHMap, other: SSHMap, drives: Sequence[Drive]) -> None:
    """Raise MapError unless two maps, and the drives if there are any, have as many steps."""
    if len(first.dstate_at) != len(other.dstate_at):
        raise MapError(
            f"maps: expected two of one trace, got one of {len(first.dstate_at)} steps and one of "
            f"{len(other.dstate_at)}; take maps of the same trace"
        )
    if drives and drives[-1].stop != len(first.dstate_at):
        raise MapError(
            f"drives: expected drives of {len(first.dstate_at)} steps in all, as the maps have, "
            f"got {drives[-1].stop}; use the drives of the solution"
        )


def _all_changes(table: Table) -> list[Change]:
    """List the changes of each sort between the two maps of a table."""
    changes: list[Change] = []
    for sort in table.ones:
        found = list(_changes(table, sort))
        if sort == "courses":  # a step along another path is along another course
            moved = {t for change in changes if change.sort == "paths" for t in _steps_of(change)}
            found = [change for change in found if moved.isdisjoint(_steps_of(change))]
        changes += found
    return changes


def _steps_of(change: Change) -> Iterable[int]:
    return chain(*change.first, *change.other)


def _changes(table: Table, sort: Sort) -> Iterable[Change]:
    """Yield the changes of one sort between the two maps of a table, sorted by first step."""
    ones = table.ones[sort]
    linked: nx.Graph[int] = nx.Graph()
    linked.add_nodes_from(range(ones.shape[1]))
    for row in ones.tolist():
        linked.add_edges_from((c, one) for c, one in enumerate(row) if one != NONE)
    for classes in sorted(map(sorted, nx.connected_components(linked))):
        if (ones[0, classes] != ones[1, classes]).any():
            first, other = (
                tuple(
                    table.steps_of(group)
                    for group in gathered((row[c], c) for c in classes if row[c] != NONE).values()
                )
                for row in ones
            )
            nowhere = [table.steps_of([c for c in classes if row[c] == NONE]) for row in ones]
            yield Change(sort, first, other, nowhere[0], nowhere[1])


def _links_only_in(
    first: SSHMap, other: SSHMap, steps: Sequence[int]
) -> tuple[tuple[Link, ...], tuple[Link, ...]]:
    """Find the links that only one map has, between dstates that have the same steps in both.

    Each dstate is named by its first step.
    """
    maps = (first, other)
    groups = [{s: tuple(at) for s, at in indices_of(m.dstate_at).items()} for m in maps]
    unmoved = {*groups[0].values()} & {*groups[1].values()}
    named = [{s: steps[at[0]] for s, at in of.items() if at in unmoved} for of in groups]
    here, there = (
        {(name[s], action, name[x]) for s, action, x in m.links if s in name and x in name}
        for m, name in zip(maps, named, strict=True)
    )
    return tuple(sorted(here - there)), tuple(sorted(there - here))


def _size(ssh_map: SSHMap) -> tuple[int, int, int, int]:
    """Return the numbers of dstates, places, paths and links of a map."""
    return len(ssh_map.dstates), len(ssh_map.places), len(ssh_map.theory_paths), len(ssh_map.links)


def _groups_in_words(groups: Sequence[Steps], none: Steps) -> str:
    """Put into words how one map groups steps: "groups steps 0–1 | 2 and leaves out step 5"."""
    steps = [step for group in groups for step in group]
    grouped = f"groups {noun_of('step', steps)} {' | '.join(map(stretches, groups))}"
    left = f"leaves out {noun_of('step', none)} {stretches(none)}"
    return " and ".join(([grouped] if groups else []) + ([left] if none else []))


def _listed(parts: Sequence[object]) -> str:
    """Join the first LISTED parts by commas, and say how many more there are."""
    more = [f"and {len(parts) - LISTED} more"] if len(parts) > LISTED else []
    return ", ".join([*map(str, parts[:LISTED]), *more])


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
    right = [
        {
            (path.id, way): {*right_of(m.regions or (), path.id, way)}
            for path in m.theory_paths
            for way in (1, -1)
        }
        for m in maps
    ]
    states = [[m.dstates[label] for label in m.dstate_at] for m in maps]
    # Places and courses that coincide in all maps are asked about once, by their first steps.
    places = firsts((tuple(of[t].place for of in states), t) for t in steps)
    courses: dict[tuple[tuple[int, int] | None, ...], int] = {}
    for t in steps:
        here = tuple(course_of(of[t]) for of in states)
        back = tuple(course and (course[0], -course[1]) for course in here)
        if back not in courses:
            courses.setdefault(here, t)

    def side(k: int, place: int | None, course: tuple[int, int] | None) -> _Side | None:
        if course is None:
            return None
        if place in right[k][course]:
            return "right"
        return "left" if place in right[k][course[0], -course[1]] else None

    found = {
        (i, j): [side(k, *both) for k, both in enumerate(zip(at, along, strict=True))]
        for at, i in places.items()
        for along, j in courses.items()
    }
    return {steps: sides for steps, sides in found.items() if any(sides)}
