"""The trace in the terms of a map: what the axioms are checked on."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from functools import cached_property
from typing import Any, TypeAlias, TypeVar

from ssh_abduction.checker.moves import Course, Move, course_of
from ssh_abduction.checker.order import Order
from ssh_abduction.data.maps import DState, SSHMap
from ssh_abduction.data.star import Openings
from ssh_abduction.data.trace import Trace, View
from ssh_abduction.theory.theory import Theory

# What a check yields: the steps that show the violation, and a sentence.
Found: TypeAlias = Iterator[tuple[Iterable[int], str]]
Check: TypeAlias = Callable[["Reading"], Found]
_T = TypeVar("_T")


class Reading:
    """A trace in the terms of a map.

    Each distinct observation and link is kept once, with the first step that shows it. A label that
    is no dstate of the map is reported under `map_explains_trace`; the axioms skip it.

    Attributes:
        trace: The trace.
        map: The map.
        theory: The theory.
        axioms: Names of the axioms that hold.
        records: The dstates of each id. A map that is wrong may have several.
        first: The first step of each label.
        views: The first step of each pair of label and view, without ignored views.
        stars: The first step of each pair of label and openings, without ignored stars.
        links: The first step of each link, without ignored actions.
    """

    def __init__(self, trace: Trace, ssh_map: SSHMap, theory: Theory) -> None:
        self.trace, self.map, self.theory = trace, ssh_map, theory
        self.axioms = frozenset(theory.axioms)
        self.records: dict[int, list[DState]] = defaultdict(list)
        for s in ssh_map.dstates:
            self.records[s.id].append(s)
        self.first: dict[int, int] = {}
        self.views: dict[tuple[int, View | None], int] = {}
        self.stars: dict[tuple[int, Openings], int] = {}
        self.links: dict[tuple[int, str, int], int] = {}
        self._computed: dict[Callable[[Reading], Any], Any] = {}
        self._read()

    def _read(self) -> None:
        labels, with_stars = self.map.labels, self.theory.star in ("pattern", "frame")
        # whether the theory allows these faults is checked elsewhere
        doubted = {(fault.kind, fault.step) for fault in self.map.faults}
        for i, (label, step) in enumerate(zip(labels, self.trace.steps, strict=False)):
            self.first.setdefault(label, i)
            if ("misread", i) not in doubted and step.view is not None:
                self.views.setdefault((label, step.view), i)
            if with_stars and ("misseen", i) not in doubted and step.openings is not None:
                self.stars.setdefault((label, step.openings), i)
            if step.action is not None and i + 1 < len(labels) and ("slipped", i) not in doubted:
                self.links.setdefault((label, step.action.name, labels[i + 1]), i)

    def once(self, compute: Callable[[Reading], _T]) -> _T:
        """The value of a function of this reading, which is computed once."""
        if compute not in self._computed:
            self._computed[compute] = compute(self)
        value: _T = self._computed[compute]
        return value

    @cached_property
    def states(self) -> dict[int, DState]:
        """The dstates by id; the first one if several have an id."""
        return {i: records[0] for i, records in self.records.items()}

    @cached_property
    def moves(self) -> list[Move]:
        """The distinct moves between dstates of the map."""
        actions = {action.name: action for action in self.trace.actions}
        return [
            Move(i, self.states[source], actions[name], self.states[target])
            for (source, name, target), i in self.links.items()
            if {source, target} <= self.states.keys()
        ]

    @cached_property
    def travels(self) -> list[Move]:
        """The moves that are travels."""
        return [m for m in self.moves if m.action.kind == "travel"]

    @cached_property
    def turns(self) -> list[Move]:
        """The moves that are turns."""
        return [m for m in self.moves if m.action.kind == "turn"]

    @cached_property
    def visited(self) -> list[tuple[int, DState]]:
        """The dstates by first visit, with the step."""
        return [(i, self.states[label]) for label, i in self.first.items() if label in self.states]

    def steps_of(self, *dstates: int) -> list[int]:
        """The first steps at which these dstates were visited."""
        return [self.first[s] for s in dstates if s in self.first]

    @cached_property
    def place_seen(self) -> dict[int, int]:
        """The first step at each place."""
        return {s.place: i for i, s in reversed(self.visited) if s.place is not None}

    def steps_at(self, place: int) -> list[int]:
        """The first step at a place; empty if no step is there."""
        return [self.place_seen[place]] if place in self.place_seen else []

    @cached_property
    def along(self) -> dict[int, dict[int, int]]:
        """For each path, the places at which a dstate is along it, and the id of that dstate."""
        found: dict[int, dict[int, int]] = defaultdict(dict)
        for s in self.states.values():
            if (course := course_of(s)) and s.place is not None:
                found[course[0]].setdefault(s.place, s.id)
        return found

    @cached_property
    def orders(self) -> dict[int, Order]:
        """The order of each path that the map lists or that a dstate is along."""
        edges: dict[int, dict[tuple[int, int], Move]] = defaultdict(dict)
        for move, (path, direction), p, q in (
            self.along_travels if "travel_orders" in self.axioms else ()
        ):
            edges[path].setdefault((p, q) if direction == 1 else (q, p), move)
        listed: dict[int, tuple[int, ...]] = {}
        for h in self.map.paths:
            listed.setdefault(h.id, h.order)
        return {h: Order(listed.get(h, ()), edges[h], self.axioms) for h in listed | self.along}

    @cached_property
    def along_travels(self) -> list[tuple[Move, Course, int, int]]:
        """The travels along one course from one place to another, with the course and places."""
        found = []
        for m in self.travels:
            course, p, q = course_of(m.source), m.source.place, m.target.place
            if not course or course != course_of(m.target):
                continue
            if p is not None and q is not None and p != q:
                found.append((m, course, p, q))
        return found

    def on(self, path: int) -> set[int]:
        """The places on a path: those that the map lists, and those that on_path puts there.

        Without the axiom on_path no place has to be on a path.
        """
        if "on_path" not in self.axioms or path not in self.orders:
            return set()
        return {*self.orders[path].listed, *self.along.get(path, ())}

    def onward(self, s: DState) -> tuple[int, ...]:
        """Bearings at which the path of a dstate continues: 0 (ahead), 180 (behind)."""
        course = course_of(s)
        if course is None or s.place is None or course[0] not in self.orders:
            return ()
        path, direction = course
        return tuple(
            towards
            for towards, way in ((0, direction), (180, -direction))
            if self.orders[path].after(s.place, way)
        )
