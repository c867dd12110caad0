"""Checks of the axioms about the sides of paths (B1 to B4), and about regions.

A turn puts a branch on one side of a path. The places ahead on the branch are on that side. No
place is on both sides. A map does not list sides, so the check derives them. If the axioms put a
place on a side that contradicts another axiom, this is a violation of each axiom that takes part:
without any one of them there is no contradiction.

Regions are sets of places beside paths, or behind one place. The check derives all regions from the
trace and the labels, and compares them with those that a map lists.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import TypeAlias

from ssh_abduction.checker.reading import (
    Check,
    Course,
    Found,
    MapLink,
    Reading,
    course_of,
    opposite,
)
from ssh_abduction.data.groups import linked, reached
from ssh_abduction.data.map_parts import Region, course_named, list_in_words
from ssh_abduction.data.words import noun_of


@dataclass(frozen=True)
class RightBranch:
    """A course (path and direction) that leaves to the right of another course at a place.

    Attributes:
        place: The place.
        course: The course that the branch leaves to the right.
        branch: The course that leaves.
        turn: The turn that shows the branch.
        mirrored: Whether the axiom symmetric_sides is needed to derive the branch from the turn.
    """

    place: int
    course: Course
    branch: Course
    turn: MapLink
    mirrored: bool

    def __str__(self) -> str:
        where = f"leaves to the right of {course_named(self.course)} at place {self.place}"
        return f"ahead on {course_named(self.branch)}, which {where} by {self.turn}"


# A contradiction between the sides on which a place lies and another axiom: the names of all axioms
# that take part, the steps that show it, and a sentence.
_Conflict: TypeAlias = tuple[set[str], tuple[int, ...], str]
# For each course, the places to its right, each with the branch that leads to it. Places to the
# left of a course are to the right of the opposite course.
_Right = Mapping[Course, Mapping[int, RightBranch]]


def branches_of(m: Reading) -> list[RightBranch]:
    """List the branches that turns show, then those that the axiom symmetric_sides adds."""
    if "branch_side" not in m.axioms:
        return []
    found: dict[tuple[int, Course, Course], RightBranch] = {}
    for move in m.turns:
        p, here, there = move.source.place, course_of(move.source), course_of(move.target)
        if p is None or not here or not there or here[0] == there[0]:
            continue
        if move.action.turn in ("right", "left"):
            course = here if move.action.turn == "right" else opposite(here)
            found.setdefault(
                (p, course, there), RightBranch(p, course, there, move, mirrored=False)
            )
    if "symmetric_sides" in m.axioms:
        for b in list(found.values()):
            back, away = opposite(b.course), opposite(b.branch)
            for course, branch in ((back, away), (b.branch, back), (away, b.course)):
                mirrored = RightBranch(b.place, course, branch, b.turn, mirrored=True)
                found.setdefault((b.place, course, branch), mirrored)
    return list(found.values())


def branches_right_of(
    m: Reading, after: Callable[[int, Course], Iterable[int]]
) -> dict[Course, dict[int, RightBranch]]:
    """Find the places to the right of each course, each with the branch that leads to it.

    `after` returns the places after a place on a course.
    """
    excused = {frozenset(pair) for pair in m.map.excused if is_pair(pair)}
    if m.theory.boundary != "defeasible":
        excused = set()
    found: dict[Course, dict[int, RightBranch]] = defaultdict(dict)
    for b in branches_of(m) if "side_of_branch" in m.axioms else ():
        if frozenset((b.course[0], b.branch[0])) not in excused:
            for q in after(b.place, b.branch):
                found[b.course].setdefault(q, b)
    return found


def _ahead(m: Reading, place: int, course: Course) -> Iterable[int]:
    """Find the places after a place on a course, by the order that the map lists."""
    path, direction = course
    return m.orders[path].after(place, direction) if path in m.orders else ()


def _conflicts(m: Reading) -> list[_Conflict]:
    """Find the places whose sides contradict another axiom."""
    right = branches_right_of(m, partial(_ahead, m))
    disjoint = _both_sides(m, right) if "sides_disjoint" in m.axioms else ()
    return [*disjoint, *(_on_and_beside(m, right) if "path_between_sides" in m.axioms else ())]


def _both_sides(m: Reading, right: _Right) -> Iterator[_Conflict]:
    """Find the places both to the right and to the left of a path."""
    for (h, direction), places in right.items():
        other = right.get((h, -direction), {}) if direction == 1 else {}
        for q in places.keys() & other.keys():
            b, c = places[q], other[q]
            steps = (*b.turn.steps, *c.turn.steps, *m.steps_at(q))
            message = f"Place {q} would lie both right and left of path {h}: it is {b}, and {c}."
            yield _axioms("sides_disjoint", b, c), steps, message


def _on_and_beside(m: Reading, right: _Right) -> Iterator[_Conflict]:
    """Find the places both on a path and beside it."""
    for (h, _direction), places in right.items():
        for q in places.keys() & m.on(h):
            b = places[q]
            there = [m.along[h][q]] if q in m.along.get(h, ()) else []
            steps = (*b.turn.steps, *m.steps_at(q), *m.steps_of(*there))
            message = f"Place {q} is on path {h} and would lie beside it: it is {b}."
            yield _axioms("path_between_sides", b), steps, message


def _axioms(contradicted: str, *branches: RightBranch) -> set[str]:
    """Name the axioms that take part in a contradiction."""
    mirrored = {"symmetric_sides"} if any(b.mirrored for b in branches) else set()
    return {contradicted, "branch_side", "side_of_branch"} | mirrored


def is_pair(pair: object) -> bool:
    """Tell whether a value is a tuple of two."""
    return isinstance(pair, tuple) and len(pair) == 2


def _sides(name: str, m: Reading) -> Found:
    """Check the axiom `name` about sides: yield the conflicts in which it takes part."""
    for axioms, steps, message in m.once(_conflicts):
        if name in axioms:
            yield steps, message


branch_side = partial(_sides, "branch_side")
symmetric_sides = partial(_sides, "symmetric_sides")
side_of_branch = partial(_sides, "side_of_branch")
sides_disjoint = partial(_sides, "sides_disjoint")
path_between_sides = partial(_sides, "path_between_sides")


_Places: TypeAlias = frozenset[int]
# ("place", its id), or ("path", its id, its floor); paths are links on one floor only.
_Node: TypeAlias = tuple[str, int] | tuple[str, int, int | None]


def known_sides(m: Reading) -> Mapping[Course, Mapping[int, RightBranch]]:
    """Find the places known to lie right of each course, each with the branch that leads to it.

    A course is a path in one direction.

    Here the order of places comes from travels alone. If a map lists places in an order that
    travels do not imply, another order may be just as right. Nothing is known to lie beside a path
    if travels do not order all its places: it may be two corridors.
    """
    follows: dict[Course, dict[int, set[int]]] = defaultdict(lambda: defaultdict(set))
    for _, course, p, q in m.along_travels if "travel_orders" in m.axioms else ():
        follows[course][p].add(q)
        follows[opposite(course)][q].add(p)

    def after(place: int, course: Course) -> set[int]:
        next_of = follows[course]
        later = set(next_of[place])
        if "order_transitive" in m.axioms:
            later = set(reached(later, next_of.__getitem__))
        return later - {place}

    def is_ordered(path: int) -> bool:
        pairs = combinations(m.along.get(path, ()), 2)
        return all(q in after(p, (path, 1)) or p in after(q, (path, 1)) for p, q in pairs)

    ordered = {path.id for path in m.map.theory_paths if is_ordered(path.id)}
    found = branches_right_of(m, after)
    return {course: places for course, places in found.items() if course[0] in ordered}


def _beside(m: Reading) -> dict[_Places, str]:
    """For each course, find the region on its right, and a sentence that describes the region."""
    sides = m.once(known_sides)
    return {
        frozenset(places): f"They are what is known to lie right of {course_named(course)}."
        for course, places in sides.items()
        if places
    }


def _between(m: Reading) -> dict[_Places, str]:
    """For each place right of some courses, find its region: the places right of all of these."""
    sides = m.once(known_sides)
    found = {}
    for p in {p for places in sides.values() for p in places}:
        bounds = [set(places) for places in sides.values() if p in places]
        places = frozenset(set.intersection(*bounds))
        found[places] = f"They lie right of all the directed paths that place {p} lies right of."
    return found


def _behind(m: Reading) -> dict[_Places, int]:
    """Find the regions that one place cuts off. Return this place for each region."""
    links = _links(m)
    parts: dict[_Places, int] = {}
    for node in [node for node in links if node[0] == "place"]:
        others = {other: ends.keys() - {node} for other, ends in links.items()}
        behind = {_places(reached([start], others.__getitem__)) for start in links[node]}
        whole = 1 + len(frozenset().union(*behind))
        parts |= {part: node[1] for part in behind if part and 2 * len(part) < whole}
    return {
        part: door
        for part, door in parts.items()
        if all(2 * len(part) <= len(around) for around in parts if part < around)
    }


def _links(m: Reading) -> dict[_Node, dict[_Node, None]]:
    """Link places with their paths, and with places reached by lifts or travels along no path."""
    pairs: list[tuple[_Node, _Node]] = [
        (("place", s.place), ("path", course[0], s.floor))
        for s in m.states.values()
        if s.place is not None and (course := course_of(s))
    ]
    leading = [move for move in m.travels if course_of(move.source) is None]
    leading += [move for move in m.moves if move.action.kind in ("lift", "stairs")]
    for move in leading:
        p, q = move.source.place, move.target.place
        if p is not None and q is not None and p != q:
            pairs.append((("place", p), ("place", q)))
    return linked(pairs)


def _places(nodes: Iterable[_Node]) -> _Places:
    """Return the places among some nodes."""
    return frozenset(node[1] for node in nodes if node[0] == "place")


def _missing(m: Reading, expected: Mapping[_Places, str]) -> Found:
    """Yield the regions that an axiom derives and the map does not list."""
    there = {frozenset(region.places) for region in m.map.regions or ()}
    for places, why in expected.items():
        if places not in there:
            named = f"{noun_of('place', places)} {list_in_words(sorted(places))}"
            yield _steps(m, places), f"The map lists no region of {named}. {why}"


def _wrong(m: Reading, region: Region) -> Iterator[str]:
    """Yield a sentence for each field of a region that is wrong."""
    places = frozenset(region.places)
    sides = m.once(known_sides).items()
    if {*region.bounds} != {course for course, beside in sides if places <= beside.keys()}:
        yield "is not right of exactly the directed paths that it lists"
    if not {places} & {*m.once(_beside), *m.once(_between), *m.once(_behind)}:
        yield "follows from no axiom"
    regions = m.map.regions or ()
    around = [r for r in regions if places < set(r.places)]
    smallest = [r.id for r in around if not any(set(o.places) < set(r.places) for o in around)]
    if sorted(region.inside) != sorted(smallest):
        yield "is not inside exactly the regions that it lists"


def region_beside(m: Reading) -> Found:
    """Check that the places known to lie right of each directed path are a region."""
    yield from _missing(m, m.once(_beside))
    for region in m.map.regions or ():
        for wrong in _wrong(m, region):
            yield _steps(m, region.places), f"Region {region.id} {wrong}."


def region_between(m: Reading) -> Found:
    """Check the regions between courses (a course is a path and a direction).

    Take all courses that a place is right of. The places right of all of these are a region.
    """
    yield from _missing(m, m.once(_between))


def region_behind(m: Reading) -> Found:
    """Check that the places which one place cuts off are a region."""
    doors = m.once(_behind)
    yield from _missing(m, {p: f"All links to them lead through place {doors[p]}." for p in doors})
    for region in m.map.regions or ():
        if region.door not in (None, doors.get(frozenset(region.places))):
            why = f"Region {region.id} is not cut off by place {region.door}."
            yield _steps(m, region.places), why
        elif region.door is None and frozenset(region.places) in doors:
            yield _steps(m, region.places), f"Region {region.id} lists no door."


def _steps(m: Reading, places: Iterable[int]) -> list[int]:
    """List the first step at each of these places."""
    return [step for place in places for step in m.steps_at(place)]


REGIONS: dict[str, Check] = {
    check.__name__: check for check in (region_beside, region_between, region_behind)
}
