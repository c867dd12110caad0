"""Checks of the axioms about regions: sets of places beside paths, or behind one place.

The check derives all regions from the trace and the labels, and compares them with the listed ones.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from itertools import combinations
from typing import TypeAlias

from ssh_abduction.checker.moves import Course, course_of, opposite
from ssh_abduction.checker.reading import Check, Found, Reading
from ssh_abduction.checker.side_axioms import RightBranch, branches_right_of
from ssh_abduction.data.groups import reached
from ssh_abduction.data.map_parts import Region, course_named, list_in_words

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

    ordered = {path.id for path in m.map.paths if is_ordered(path.id)}
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
        others = {other: ends - {node} for other, ends in links.items()}
        behind = {_places(reached([start], others.__getitem__)) for start in links[node]}
        whole = 1 + len(frozenset().union(*behind))
        parts |= {part: node[1] for part in behind if part and 2 * len(part) < whole}
    return {
        part: door
        for part, door in parts.items()
        if all(2 * len(part) <= len(around) for around in parts if part < around)
    }


def _links(m: Reading) -> dict[_Node, set[_Node]]:
    """Link places with their paths, and with places reached by lifts or travels along no path."""
    links: dict[_Node, set[_Node]] = defaultdict(set)
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
    for one, other in pairs:
        links[one].add(other)
        links[other].add(one)
    return links


def _places(nodes: Iterable[_Node]) -> _Places:
    """Return the places among some nodes."""
    return frozenset(node[1] for node in nodes if node[0] == "place")


def _missing(m: Reading, expected: Mapping[_Places, str]) -> Found:
    """Yield the regions that an axiom derives and the map does not list."""
    there = {frozenset(region.places) for region in m.map.regions or ()}
    for places, why in expected.items():
        if places not in there:
            yield _steps(m, places), f"The map lists no region of {_listed(places)}. {why}"


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


def _listed(places: _Places) -> str:
    """Name places in words."""
    return f"place{'' if len(places) == 1 else 's'} {list_in_words(sorted(places))}"


AXIOMS: dict[str, Check] = {
    check.__name__: check for check in (region_beside, region_between, region_behind)
}
