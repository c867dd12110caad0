"""Find the regions of a small map by trying all sets of places. This is slow, plain, and
independent of the encoding and the checker."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from itertools import chain, combinations
from typing import TypeAlias

from ssh_abduction.data import SSHMap, Trace

Course: TypeAlias = tuple[int, int]
Found: TypeAlias = tuple[frozenset[int], frozenset[Course], int | None]


def regions(ssh_map: SSHMap, trace: Trace, axioms: Collection[str]) -> set[Found]:
    """Each region as its places, the courses that all of them lie right of, and its door."""
    right = sides(ssh_map, trace, axioms)
    courses = {course for _, course in right}
    beside = {c: frozenset(q for q, course in right if course == c) for c in courses}
    doors = parts(ssh_map, trace, axioms) if "region_behind" in axioms else {}
    found = set(doors)
    for places in subsets(ssh_map.places):
        over = [c for c in courses if places <= beside[c]]
        if "region_beside" in axioms and places in beside.values():
            found.add(places)
        for p in places if "region_between" in axioms else ():
            mine = [c for c in courses if p in beside[c]]
            if mine and all(q in places for q in ssh_map.places if covers(beside, mine, q)):
                found |= {places} if set(mine) == set(over) else set()
    return {
        (places, frozenset(c for c in courses if places <= beside[c]), doors.get(places))
        for places in found
    }


def covers(beside: dict[Course, frozenset[int]], courses: list[Course], place: int) -> bool:
    return all(place in beside[c] for c in courses)


def subsets(places: Collection[int]) -> Iterator[frozenset[int]]:
    sizes = range(1, len(places) + 1)
    return map(frozenset, chain.from_iterable(combinations(sorted(places), k) for k in sizes))


def sides(ssh_map: SSHMap, trace: Trace, axioms: Collection[str]) -> set[tuple[int, Course]]:
    """The pairs of a place and a course that it is known to lie right of, by repeating rules."""
    place = {s.id: s.place for s in ssh_map.dstates}
    course = {s.id: (s.path, s.direction) for s in ssh_map.dstates if s.path is not None}
    before: set[tuple[Course, int, int]] = set()
    branches: set[tuple[int, Course, Course]] = set()
    for s, action, x in moves(ssh_map, trace):
        if s not in course or x not in course:
            continue
        h, d = course[s]
        if action.kind == "travel" and course[s] == course[x] and "travel_orders" in axioms:
            before |= {((h, d), place[s], place[x]), ((h, -d), place[x], place[s])}
        side = {"right": 1, "left": -1}.get(action.turn or "", 0)
        if side and course[x][0] != h and "branch_side" in axioms:
            branches.add((place[s], (h, d * side), course[x]))
    for _ in range(4 if "symmetric_sides" in axioms else 0):
        branches |= {(p, b, (c[0], -c[1])) for p, c, b in branches}
    while "order_transitive" in axioms:
        more = {(c, p, r) for c, p, q in before for e, o, r in before if c == e and q == o != r}
        more = {(c, p, r) for c, p, r in more if p != r}
        if more <= before:
            break
        before |= more
    excused = {frozenset(pair) for pair in ssh_map.excused}
    on = {(place[s], course[s][0]) for s in course}
    loose = {
        h
        for p, h in on
        for q, g in on
        if h == g and p != q and not any(c[0] == h and {a, b} == {p, q} for c, a, b in before)
    }
    return {
        (q, c)
        for p, c, b in branches
        for e, o, q in before
        if "side_of_branch" in axioms
        and not ("sides_need_order" in axioms and c[0] in loose)
        and e == b
        and o == p
        and frozenset((c[0], b[0])) not in excused
    }


def moves(ssh_map: SSHMap, trace: Trace) -> Iterator[tuple]:
    slipped = {fault.step for fault in ssh_map.faults if fault.kind == "slipped"}
    for t, action in enumerate(trace.actions):
        if t not in slipped and not action.starts:
            yield ssh_map.dstate_at[t], action, ssh_map.dstate_at[t + 1]


def parts(ssh_map: SSHMap, trace: Trace, axioms: Collection[str]) -> dict[frozenset[int], int]:
    """The sets of places that one place cuts off, each with this place."""
    place = {s.id: s.place for s in ssh_map.dstates}
    on = {(s.place, (s.path, s.floor)) for s in ssh_map.dstates if s.path is not None}
    pathless = {s.id for s in ssh_map.dstates if s.path is None}
    near = {(p, q) for p, h in on for q, g in on if h == g and "path_holds_together" in axioms}
    for s, action, x in moves(ssh_map, trace):
        leads = (action.kind == "travel" and s in pathless) or action.kind in ("lift", "stairs")
        if leads and place[s] != place[x] and "travel_links" in axioms:
            near |= {(place[s], place[x]), (place[x], place[s])}

    def hold(places: frozenset[int]) -> bool:
        """Whether no split of the places leaves two halves without a link."""
        return all(
            any((p, q) in near for p in half for q in places - half)
            for half in subsets(places)
            if half != places
        )

    wholes = [w for w in subsets(ssh_map.places) if closed(w, w, near) and hold(w)]
    whole_of = {p: w for w in wholes for p in w}
    found = {
        places: p
        for p in ssh_map.places
        for places in subsets(whole_of[p] - {p})
        if 2 * len(places) < len(whole_of[p])
        and closed(places, places | {p}, near)
        and hold(places)
        and any((p, q) in near for q in places)
    }
    return {
        a: door
        for a, door in found.items()
        if all(len(a) <= len(around) / 2 for around in found if a < around)
    }


def closed(places: frozenset[int], allowed: frozenset[int], near: set[tuple[int, int]]) -> bool:
    return all(q in allowed for p, q in near if p in places)
