"""Checks of the axioms about the sides of paths (B1 to B4).

A turn puts a branch on one side of a path. The places ahead on the branch are on that side. No
place is on both sides. A map does not list sides, so the check derives them. If the axioms put a
place on a side that contradicts another axiom, this is a violation of each axiom that takes part:
without any one of them there is no contradiction.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial

from ssh_abduction.checker.moves import Course, MapLink, course_of, opposite
from ssh_abduction.checker.reading import Found, Reading
from ssh_abduction.data.map_parts import course_named


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


@dataclass(frozen=True)
class Conflict:
    """A contradiction between the sides on which a place lies and another axiom.

    Attributes:
        axiom: The name of the contradicted axiom.
        branches: The branches that put the place on its sides.
        steps: The steps that show the contradiction.
        message: A sentence that describes it.
    """

    axiom: str
    branches: tuple[RightBranch, ...]
    steps: tuple[int, ...]
    message: str

    @property
    def axioms(self) -> set[str]:
        """Names of the axioms that take part in the contradiction."""
        mirrored = {"symmetric_sides"} if any(b.mirrored for b in self.branches) else set()
        return {self.axiom, "branch_side", "side_of_branch"} | mirrored


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


def _conflicts(m: Reading) -> list[Conflict]:
    """Find the places whose sides contradict another axiom."""
    right = branches_right_of(m, partial(_ahead, m))
    disjoint = _both_sides(m, right) if "sides_disjoint" in m.axioms else ()
    return [*disjoint, *(_on_and_beside(m, right) if "path_between_sides" in m.axioms else ())]


def _both_sides(m: Reading, right: _Right) -> Iterator[Conflict]:
    """Find the places both to the right and to the left of a path."""
    for (h, direction), places in right.items():
        other = right.get((h, -direction), {}) if direction == 1 else {}
        for q in places.keys() & other.keys():
            b, c = places[q], other[q]
            steps = (*b.turn.steps, *c.turn.steps, *m.steps_at(q))
            message = f"Place {q} would lie both right and left of path {h}: it is {b}, and {c}."
            yield Conflict("sides_disjoint", (b, c), steps, message)


def _on_and_beside(m: Reading, right: _Right) -> Iterator[Conflict]:
    """Find the places both on a path and beside it."""
    for (h, _direction), places in right.items():
        for q in places.keys() & m.on(h):
            b = places[q]
            there = [m.along[h][q]] if q in m.along.get(h, ()) else []
            steps = (*b.turn.steps, *m.steps_at(q), *m.steps_of(*there))
            message = f"Place {q} is on path {h} and would lie beside it: it is {b}."
            yield Conflict("path_between_sides", (b,), steps, message)


def is_pair(pair: object) -> bool:
    """Tell whether a value is a tuple of two."""
    return isinstance(pair, tuple) and len(pair) == 2


def _sides(name: str, m: Reading) -> Found:
    """Check the axiom `name` about sides: yield the conflicts in which it takes part."""
    for conflict in m.once(_conflicts):
        if name in conflict.axioms:
            yield conflict.steps, conflict.message


branch_side = partial(_sides, "branch_side")
symmetric_sides = partial(_sides, "symmetric_sides")
side_of_branch = partial(_sides, "side_of_branch")
sides_disjoint = partial(_sides, "sides_disjoint")
path_between_sides = partial(_sides, "path_between_sides")
