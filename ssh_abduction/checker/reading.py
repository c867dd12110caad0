"""A trace read with the labels of a map. The checks of axioms work on this."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from graphlib import CycleError, TopologicalSorter
from typing import Any, TypeAlias, TypeVar

from ssh_abduction.data.drives import drives_of, named_steps
from ssh_abduction.data.groups import firsts, reached, way
from ssh_abduction.data.map_parts import course_named
from ssh_abduction.data.maps import DState, SSHMap
from ssh_abduction.data.star import Openings
from ssh_abduction.data.trace import Action, Trace, View
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
        since: The displacements up to this step agree with the map, as an earlier check found.
        steps: The numbers of all steps. With several drives, a step prints with its drive's name.
        axioms: Names of the theory's axioms.
        records: For each id, the dstates of the map with this id. A malformed map may have several.
        first: The first step of each label.
        views: The first step of each pair (label, view). Views that the map ignores are left out.
        stars: The first step of each pair (label, openings). Stars that the map ignores are left
            out.
        links: The first step of each link (label, name of the action, next label). Actions that the
            map ignores are left out.
    """

    def __init__(self, trace: Trace, ssh_map: SSHMap, theory: Theory, since: int = 0) -> None:
        self.trace, self.map, self.theory, self.since = trace, ssh_map, theory, since
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
        """Return a step as a number that prints with its drive, if there are several drives.

        A step outside the trace is returned unchanged.
        """
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
    def moves(self) -> list[MapLink]:
        """The links between dstates of the map, each once."""
        actions = {action.name: action for action in self.trace.actions}
        return [
            MapLink(i, self.states[source], actions[name], self.states[target])
            for (source, name, target), i in self.links.items()
            if {source, target} <= self.states.keys()
        ]

    @cached_property
    def travels(self) -> list[MapLink]:
        """The links of `moves` whose action is a travel."""
        return [m for m in self.moves if m.action.kind == "travel"]

    @cached_property
    def turns(self) -> list[MapLink]:
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
        """Return a list with the first step at a place; empty if no step is there."""
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
        edges: dict[int, dict[tuple[int, int], MapLink]] = defaultdict(dict)
        for move, (path, direction), p, q in (
            self.along_travels if "travel_orders" in self.axioms else ()
        ):
            edges[path].setdefault((p, q) if direction == 1 else (q, p), move)
        listed = firsts((h.id, h.order) for h in self.map.theory_paths)
        return {h: Order(listed.get(h, ()), edges[h], self.axioms) for h in listed | self.along}

    @cached_property
    def along_travels(self) -> list[tuple[MapLink, Course, int, int]]:
        """The travels that keep their course: travel, course, place, next place."""
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
        """Find the bearings at which the path of a dstate continues: 0 (ahead) and 180 (behind).

        It continues ahead if a place on the path comes after the dstate's place, and behind if one
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


class Order:
    """The order of the places along one path, in directions +1 and -1.

    If the axioms demand a total order, this is the order that the map lists. Otherwise it has only
    the pairs that travels imply. A list always shows an order that is asymmetric and transitive. So
    if one of these two axioms is left out and a travel contradicts the list, the travel decides.
    Without the axiom on_path no place is known to be on the path, so the list is not used.

    Args:
        listed: The places as the map lists them, in direction +1.
        travels: For pairs (p, q) of places, a travel that shows that p comes before q in
            direction +1.
        axioms: Names of the theory's axioms.

    Attributes:
        listed: The argument `listed`.
        travels: The argument `travels`.
        position: The position of each listed place in the list, from 0.
        backward: The pairs of `travels` that the list has the other way round, or does not have.
        rings: Lists of places. Travels lead from each place to the next, and from the last to the
            first.
        can_be_listed: Whether the axioms demand an order that a list can show.
    """

    def __init__(
        self,
        listed: Sequence[int],
        travels: Mapping[tuple[int, int], MapLink],
        axioms: frozenset[str],
    ) -> None:
        self.listed, self.travels = listed, travels
        self.position = {p: i for i, p in reversed(list(enumerate(listed)))}
        self._total = {"path_order_total", "on_path"} <= axioms
        self._asymmetric = "order_asymmetric" in axioms
        self._transitive = "order_transitive" in axioms
        self._next: dict[int, defaultdict[int, dict[int, None]]] = {
            1: defaultdict(dict),
            -1: defaultdict(dict),
        }
        for p, q in travels:
            self._next[1][p][q] = self._next[-1][q][p] = None
        # travels whose places the list does not have in this order
        self.backward = [
            (p, q)
            for p, q in travels
            if self.position.get(p, len(listed)) >= self.position.get(q, -1)
        ]
        self.rings = self._rings()
        self.can_be_listed = self._asymmetric and self._transitive
        self._is_listed = self._total and (self.can_be_listed or not self.backward)

    def _rings(self) -> list[list[int]]:
        """Find the rings. Each has a travel that contradicts the list, so only these are tried."""
        try:
            TopologicalSorter(self._next[1]).prepare()
        except CycleError:
            # Shortest ways along travels back from q to p; empty if there is none.
            back = [way(q, p, lambda r: self._next[1].get(r, ())) for p, q in self.backward]
            return list({frozenset(ring): ring for ring in reversed(back) if ring}.values())[::-1]
        return []

    def allows(self, ring: Sequence[int]) -> bool:
        """Whether the axioms allow that each of these places comes before the next, all round."""
        return not self._asymmetric or (not self._transitive and len(ring) > 2)

    def after(self, p: int, direction: int) -> Iterable[int]:
        """Find the places after p on the path, in this direction (+1 or -1)."""
        if self._is_listed:
            return self._later(p, direction)
        follows = self._follows(p, direction)
        if not self._transitive:
            return follows
        return reached(follows, lambda q: self._follows(q, direction))

    def between(self, p: int, q: int, direction: int) -> set[int]:
        """Find the places after p and before q on the path, in this direction (+1 or -1)."""
        i, j = self.position.get(p), self.position.get(q)
        agrees = self._is_listed or not self.backward
        if agrees and i is not None and j is not None and abs(i - j) <= 1:
            return set()  # neighbours in the list: no need to walk along the path
        return set(self.after(p, direction)) & set(self.after(q, -direction)) - {p, q}

    def ring_steps(self, ring: Sequence[int]) -> list[int]:
        """List the steps of the travels that lead around a ring of places in this order."""
        edges = zip(ring, [*ring[1:], ring[0]], strict=True)
        return [step for edge in edges for step in self.travels[edge].steps]

    def _later(self, p: int, direction: int) -> Sequence[int]:
        """Find the places after p in the list, or before it if the direction is -1."""
        i = self.position.get(p)
        if i is None:
            return ()
        return self.listed[i + 1 :] if direction == 1 else self.listed[:i]

    def _follows(self, p: int, direction: int) -> list[int]:
        """Find the places after p: by travels, and in a total order also by the list.

        If a travel contradicts the list, the travel decides.
        """
        travelled = self._next[direction].get(p, {})
        later = self._later(p, direction) if self._total else ()
        return [
            *travelled,
            *(q for q in later if q not in travelled and p not in self._next[direction].get(q, ())),
        ]


# A path and a direction, +1 or -1.
Course: TypeAlias = tuple[int, int]


@dataclass(frozen=True)
class MapLink:
    """A link of a map with its dstates.

    Attributes:
        step: The first step at which the action was done at the source.
        source: The dstate at which the action starts.
        action: The action.
        target: The dstate that the action leads to.
    """

    step: int
    source: DState
    action: Action
    target: DState

    @property
    def steps(self) -> tuple[int, int]:
        """The step at which the action starts, and the next one, at which it ends."""
        return self.step, self.step + 1

    def __str__(self) -> str:
        ends = f"from dstate {self.source.id} to dstate {self.target.id}"
        return f"{self.action.name!r} at step {self.step} {ends}"


def course_of(s: DState) -> Course | None:
    """Return the path of a dstate and its direction (+1 or -1); None if it lacks one of them."""
    return (s.path, s.direction) if s.path is not None and s.direction in (1, -1) else None


def opposite(course: Course) -> Course:
    """Return the same path in the other direction."""
    return course[0], -course[1]


def going(s: DState) -> str:
    """Describe the course of a dstate in words; "no path" if it has none."""
    course = course_of(s)
    return course_named(course) if course else "no path"


def heading_of(s: DState) -> int | None:
    """Return the heading of a dstate if it is a slot, 0 to 3; otherwise None."""
    return s.heading if s.heading in (0, 1, 2, 3) else None
