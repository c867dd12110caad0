"""A trace read with the labels of a map. The checks of axioms work on this."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from functools import cached_property
from typing import Any, TypeAlias, TypeVar

from ssh_abduction.checker.moves import Course, Move, course_of
from ssh_abduction.checker.order import Order
from ssh_abduction.data.drives import drives_of, named_steps
from ssh_abduction.data.maps import DState, SSHMap
from ssh_abduction.data.star import Openings
from ssh_abduction.data.trace import Trace, View
from ssh_abduction.theory.theory import Theory

# What a check yields: the steps that show the violation, and a sentence.
Found: TypeAlias = Iterator[tuple[Iterable[int], str]]
Check: TypeAlias = Callable[["Reading"], Found]
_T = TypeVar("_T")


class Reading:
    """A trace read with the labels of a map: what was seen and done at each dstate.

    Each distinct observation and link is kept once, with the first step that shows it. A label
    without a dstate in the map is reported under `map_explains_trace`. The axioms skip it.

    Attributes:
        trace: The trace.
        map: The map.
        theory: The theory.
        steps: The numbers of all steps. In words, those of several drives have names of drives.
        axioms: Names of the axioms that hold.
        records: For each id, the dstates of the map with this id. A malformed map may have several.
        first: The first step of each label.
        views: The first step of each pair (label, view). Views that the map ignores are left out.
        stars: The first step of each pair (label, openings). Stars that the map ignores are left
            out.
        links: The first step of each link (label, name of the action, next label). Actions that the
            map ignores are left out.
    """

    def __init__(self, trace: Trace, ssh_map: SSHMap, theory: Theory) -> None:
        self.trace, self.map, self.theory = trace, ssh_map, theory
        self.steps = named_steps(drives_of(trace), len(trace))
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
        """Read all steps, and fill the dicts."""
        labels, with_stars = self.map.dstate_at, self.theory.star in ("pattern", "frame")
        # whether the theory allows these faults is checked elsewhere
        doubted = {(fault.kind, fault.step) for fault in self.map.faults}
        for i, label, step in zip(self.steps, labels, self.trace.steps, strict=False):
            self.first.setdefault(label, i)
            if ("misread", i) not in doubted and step.view is not None:
                self.views.setdefault((label, step.view), i)
            if with_stars and ("misseen", i) not in doubted and step.openings is not None:
                self.stars.setdefault((label, step.openings), i)
            if (
                step.action is not None
                and step.action.kind != "start"  # the next step is of another drive
                and i + 1 < len(labels)
                and ("slipped", i) not in doubted
            ):
                self.links.setdefault((label, step.action.name, labels[i + 1]), i)

    def named(self, step: int) -> int:
        """Return a step that in words has the name of its drive; unchanged if not in the trace."""
        return self.steps[step] if 0 <= step < len(self.steps) else step

    def once(self, compute: Callable[[Reading], _T]) -> _T:
        """Return `compute(self)`. Later calls with the same function return the stored value."""
        if compute not in self._computed:
            self._computed[compute] = compute(self)
        value: _T = self._computed[compute]
        return value

    @cached_property
    def states(self) -> dict[int, DState]:
        """A dict from each id to its dstate, or to the first one if several have the id."""
        return {i: records[0] for i, records in self.records.items()}

    @cached_property
    def moves(self) -> list[Move]:
        """The links between dstates of the map, each once."""
        actions = {action.name: action for action in self.trace.actions}
        return [
            Move(i, self.states[source], actions[name], self.states[target])
            for (source, name, target), i in self.links.items()
            if {source, target} <= self.states.keys()
        ]

    @cached_property
    def travels(self) -> list[Move]:
        """The links of `moves` whose action is a travel."""
        return [m for m in self.moves if m.action.kind == "travel"]

    @cached_property
    def turns(self) -> list[Move]:
        """The links of `moves` whose action is a turn."""
        return [m for m in self.moves if m.action.kind == "turn"]

    @cached_property
    def visited(self) -> list[tuple[int, DState]]:
        """Pairs of the first step at a dstate and the dstate, sorted by step."""
        return [(i, self.states[label]) for label, i in self.first.items() if label in self.states]

    def steps_of(self, *dstates: int) -> list[int]:
        """List the first step at each of these dstates. Dstates that no step is at are skipped."""
        return [self.first[s] for s in dstates if s in self.first]

    @cached_property
    def place_seen(self) -> dict[int, int]:
        """A dict from each place to the first step there."""
        return {s.place: i for i, s in reversed(self.visited) if s.place is not None}

    def steps_at(self, place: int) -> list[int]:
        """List the first step at a place, alone; empty if no step is there."""
        return [self.place_seen[place]] if place in self.place_seen else []

    @cached_property
    def along(self) -> dict[int, dict[int, int]]:
        """For each path, a dict from places to the id of a dstate there that is along the path."""
        found: dict[int, dict[int, int]] = defaultdict(dict)
        for s in self.states.values():
            if (course := course_of(s)) and s.place is not None:
                found[course[0]].setdefault(s.place, s.id)
        return found

    @cached_property
    def orders(self) -> dict[int, Order]:
        """A dict from each path that the map lists, or that a dstate is along, to its order."""
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
        """The travels that keep their course and change the place.

        Each is a tuple of the travel, its course, the place it leaves and the place it reaches.
        """
        found = []
        for m in self.travels:
            course, p, q = course_of(m.source), m.source.place, m.target.place
            if not course or course != course_of(m.target):
                continue
            if p is not None and q is not None and p != q:
                found.append((m, course, p, q))
        return found

    def on(self, path: int) -> set[int]:
        """Find the places on a path: those that the map lists, and those with a dstate along it.

        Empty if the axiom on_path is left out.
        """
        if "on_path" not in self.axioms or path not in self.orders:
            return set()
        return {*self.orders[path].listed, *self.along.get(path, ())}

    def onward(self, s: DState) -> tuple[int, ...]:
        """Find the bearings at which the path of a dstate continues, in degrees.

        Returns:
            0 (ahead) if a place comes after that of the dstate on its path, and 180 (behind) if one
            comes before it.
        """
        course = course_of(s)
        if course is None or s.place is None or course[0] not in self.orders:
            return ()
        path, direction = course
        return tuple(
            towards
            for towards, way in ((0, direction), (180, -direction))
            if self.orders[path].after(s.place, way)
        )
