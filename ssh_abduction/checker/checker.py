"""Checks a map against a trace and a theory, axiom by axiom, in plain Python that shares nothing with the solver.

>>> from ssh_abduction import Trace
>>> from ssh_abduction.checker.checker import check
>>> from ssh_abduction.data.maps import DState, SSHMap
>>> from ssh_abduction.theory.theory import Theory
>>> trace = Trace.from_steps(["a", "b"], ["travel"])
>>> check(trace, SSHMap((0, 0), (DState(0, "a"),), ((0, "travel", 0),)), Theory.causal())
(Violation(axiom='functional_view', steps=(0, 1), message="Dstate 0 looks like 'a' at step 0 and like 'b' at step 1."),)

The axioms are those of docs/theory.md, after Kuipers & Beeson (AAAI 2002) and Remolina & Kuipers (AIJ 2004). A map shows
places, courses (path and direction), headings and orders, so an axiom about these is judged by what the map shows.
A dstate of a map shows one place, one course and one heading, even where a theory leaves out the axiom that forbids several of them;
all other axioms are judged by the ones shown. The map does not show the sides of paths. So a place that the axioms put on a side where it
cannot be is reported under each axiom that takes part in putting it there, as dropping any one of them would mend it. A ring of
travels, which no order can show, is reported in the same way.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from graphlib import CycleError, TopologicalSorter
from typing import TypeAlias

from ssh_abduction.checker.planarity import Edges
from ssh_abduction.data.clock import look_at_clock
from ssh_abduction.data.errors import MapError, brief
from ssh_abduction.data.gateways import Clash, Sight, clashes, headings, may_show_the_same
from ssh_abduction.data.maps import DState, SSHMap
from ssh_abduction.data.star import Openings, Star
from ssh_abduction.data.trace import Action, Trace, View, checked_trace
from ssh_abduction.theory.theory import Theory, checked_theory

COHERENCE = "map_explains_trace"
QUARTERS = {"right": 1, "around": 2, "left": 3}

Course: TypeAlias = tuple[int, int]
Found: TypeAlias = Iterator[tuple[Iterable[int], str]]
Check: TypeAlias = Callable[["_Reading"], Found]


@dataclass(frozen=True)
class Violation:
    """An axiom that a map breaks: its name, the steps of the trace that show it, and a sentence in the terms of the map.

    `steps` is ascending; an action that starts at step i shows as i and i + 1. It is empty where no step is to blame.
    """

    axiom: str
    steps: tuple[int, ...]
    message: str


def check(trace: Trace, ssh_map: SSHMap, theory: Theory | None = None) -> tuple[Violation, ...]:
    """What is wrong with a map as an explanation of a trace: nothing, if it satisfies every axiom of the theory.

    Parameters
    ----------
    trace    what the robot saw and did, with views
    ssh_map  any map, also a mutilated one
    theory   Theory.topological() by default; the axioms in its `without` are not checked

    Returns
    -------
    The violations of all axioms but those that `unchecked` names. Those of `map_explains_trace` come first (the map fits the trace, and its numbers fit each
    other), then those of the axioms in the order of the theory.

    Raises
    ------
    TraceError and TheoryError where the trace lacks what the theory asks for; MapError for what is no SSHMap. Nothing else in the map makes it raise.

    References
    ----------
    Kuipers & Beeson, AAAI 2002; Remolina & Kuipers, AIJ 2004; docs/theory.md has the axioms one by one.
    """
    theory = checked_theory(theory).resolve(checked_trace(trace))
    if not isinstance(ssh_map, SSHMap):
        raise MapError(
            f"map: expected an SSHMap, got {brief(ssh_map)}; take one of a solution, or SSHMap.load"
        )
    return tuple(violations(trace, ssh_map, theory))


def violations(trace: Trace, ssh_map: SSHMap, theory: Theory) -> Iterator[Violation]:
    """The same violations one by one, so that the caller who needs only the first one does not wait for the others.

    Args:
        trace: What the robot saw and did, with views.
        ssh_map: Any map.
        theory: The theory, resolved for this trace.

    Yields:
        Each violation, in the order of `check`.
    """
    reading = _Reading(trace, ssh_map, theory)
    checks = [(COHERENCE, test) for test in _COHERENCE] + [
        (name, AXIOMS[name]) for name in theory.axioms if name in AXIOMS
    ]
    for name, test in checks:
        look_at_clock()
        for steps, message in test(reading):
            yield Violation(name, tuple(sorted(set(steps))), message)


def turned(trace: Trace, ssh_map: SSHMap, theory: Theory) -> SSHMap | None:
    """A map with headings that all stars of a trace allow (star=gateways), None where they allow none. A map of fewer steps may show other headings."""
    reading = _Reading(trace, ssh_map, theory)
    found = headings(*reading.sights, reading.axioms)
    if any(s.place is not None and s.id not in found for s in ssh_map.dstates):
        return None
    return replace(
        ssh_map, dstates=tuple(replace(s, heading=found.get(s.id)) for s in ssh_map.dstates)
    )


def unchecked(theory: Theory) -> tuple[str, ...]:
    """What a theory asks for and the checker cannot judge: axioms of the user's own rules, and files of rules that name no axiom."""
    named = tuple(name for name in theory.axioms if name not in AXIOMS)
    return named + tuple(f"the rules of {rules.name}" for rules in theory.rules if not rules.axioms)


# What the axioms speak of: the distinct observations and moves of the trace, as the map labels them.


@dataclass(frozen=True)
class _Move:
    """An action that leads from one dstate of the map to another, and the first step at which it was done."""

    step: int
    source: DState
    action: Action
    target: DState

    @property
    def steps(self) -> tuple[int, int]:
        return self.step, self.step + 1

    def __str__(self) -> str:
        return f"{self.action.name!r} at step {self.step} from dstate {self.source.id} to dstate {self.target.id}"


@dataclass(frozen=True)
class _Branch:
    """At a place, `branch` leaves to the right of `course`. A turn shows that; if `mirrored`, it follows from what the turn shows by symmetric_sides."""

    place: int
    course: Course
    branch: Course
    turn: _Move
    mirrored: bool

    def __str__(self) -> str:
        return f"ahead on {_along(self.branch)}, which leaves to the right of {_along(self.course)} at place {self.place} by {self.turn}"


@dataclass(frozen=True)
class _Conflict:
    """A place that the axioms of the sides put where another axiom says it is not."""

    axiom: str
    branches: tuple[_Branch, ...]
    steps: tuple[int, ...]
    message: str

    @property
    def axioms(self) -> set[str]:
        mirrored = {"symmetric_sides"} if any(b.mirrored for b in self.branches) else set()
        return {self.axiom, "branch_side", "side_of_branch"} | mirrored


class _Order:
    """The order of the places of one path: the order that the map lists if it has to be total, else the least order that the travels ask for.

    Directions are +1 and -1. No list can show an order that is not asymmetric or not transitive. So where one of these axioms is
    left out, what the travels say outweighs the list. Without the axiom on_path no place is known to be on the path, so a total order orders none.
    """

    def __init__(
        self,
        listed: Sequence[int],
        travels: Mapping[tuple[int, int], _Move],
        axioms: frozenset[str],
    ) -> None:
        self.listed, self.travels = listed, travels
        self.total = {"path_order_total", "on_path"} <= axioms
        self.asymmetric, self.transitive = (
            "order_asymmetric" in axioms,
            "order_transitive" in axioms,
        )
        self.position = {p: i for i, p in reversed(list(enumerate(listed)))}
        self.next: dict[int, defaultdict[int, dict[int, None]]] = {
            1: defaultdict(dict),
            -1: defaultdict(dict),
        }
        for p, q in travels:
            self.next[1][p][q] = self.next[-1][q][p] = None
        self.backward = [
            (p, q)
            for p, q in travels
            if self.position.get(p, len(listed)) >= self.position.get(q, -1)
        ]
        self.rings = self._rings()
        self.can_be_listed = self.asymmetric and self.transitive
        self.is_listed = self.total and (self.can_be_listed or not self.backward)

    def _rings(self) -> list[list[int]]:
        """Rings of places that travels lead round. Each ring has a travel that goes against the list, so rings are sought from these travels on."""
        try:
            TopologicalSorter(self.next[1]).prepare()
        except CycleError:
            rings = [ring for p, q in self.backward if (ring := self.way_back(p, q))]
            return list({frozenset(ring): ring for ring in reversed(rings)}.values())[::-1]
        return []

    def allows(self, ring: Sequence[int]) -> bool:
        """Whether the axioms that are on let these places follow each other in a ring."""
        return not self.asymmetric or (not self.transitive and len(ring) > 2)

    def after(self, p: int, direction: int) -> Iterable[int]:
        """The places after p, for somebody who goes in this direction."""
        if self.is_listed:
            return self._later(p, direction)
        follows = self._follows(p, direction)
        if not self.transitive:
            return follows
        reached = dict.fromkeys(follows)
        queue = deque(reached)
        while queue:
            new = [q for q in self._follows(queue.popleft(), direction) if q not in reached]
            reached.update(dict.fromkeys(new))
            queue.extend(new)
        return reached

    def between(self, p: int, q: int, direction: int) -> set[int]:
        """The places after p and before q, for somebody who goes in this direction."""
        i, j = self.position.get(p), self.position.get(q)
        if (
            (self.is_listed or not self.backward)
            and i is not None
            and j is not None
            and abs(i - j) <= 1
        ):
            return set()  # neighbours in the list have nothing between them, and to see that here spares a walk along the path
        return set(self.after(p, direction)) & set(self.after(q, -direction)) - {p, q}

    def way_back(self, p: int, q: int) -> list[int]:
        """The places on a shortest way along travels from q to p, both included; empty if there is none."""
        came: dict[int, int | None] = {q: None}
        queue = deque([q])
        while queue and p not in came:
            here = queue.popleft()
            new = [r for r in self.next[1].get(here, ()) if r not in came]
            came.update(dict.fromkeys(new, here))
            queue.extend(new)
        way: list[int] = []
        place: int | None = p if p in came else None
        while place is not None:
            way.append(place)
            place = came[place]
        return way[::-1]

    def ring_steps(self, ring: Sequence[int]) -> list[int]:
        """The steps of the travels round a ring of places."""
        return [
            step
            for edge in zip(ring, [*ring[1:], ring[0]], strict=True)
            for step in self.travels[edge].steps
        ]

    def _later(self, p: int, direction: int) -> Sequence[int]:
        """The places after p in the list."""
        i = self.position.get(p)
        if i is None:
            return ()
        return self.listed[i + 1 :] if direction == 1 else self.listed[:i]

    def _follows(self, p: int, direction: int) -> list[int]:
        """The places that a travel or, if the order is total, the list puts after p; where they disagree, the travel counts."""
        travelled = self.next[direction].get(p, {})
        later = self._later(p, direction) if self.total else ()
        return [
            *travelled,
            *(q for q in later if q not in travelled and p not in self.next[direction].get(q, ())),
        ]


class _Reading:
    """The trace in the terms of the map. Each distinct observation and link is kept once, with the first step that shows it.

    Steps labelled with dstates that the map does not have are reported by `map_explains_trace`, and the axioms pass over them.
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
        self.actions: dict[str, Action] = {a.name: a for a in trace.actions}
        self._read()

    def _read(self) -> None:
        labels, with_stars = self.map.labels, self.theory.star in ("pattern", "frame")
        doubted = {
            (fault.kind, fault.step) for fault in self.map.faults
        }  # whether the theory allows these faults is judged apart
        for i, (label, step) in enumerate(zip(labels, self.trace.steps, strict=False)):
            self.first.setdefault(label, i)
            if ("misread", i) not in doubted and step.view is not None:
                self.views.setdefault((label, step.view), i)
            if (
                with_stars
                and ("misseen", i) not in doubted
                and (openings := step.openings) is not None
            ):
                self.stars.setdefault((label, openings), i)
            if step.action is not None and i + 1 < len(labels) and ("slipped", i) not in doubted:
                self.links.setdefault((label, step.action.name, labels[i + 1]), i)

    @cached_property
    def states(self) -> dict[int, DState]:
        """The dstates by id; of two with one id, the first."""
        return {i: records[0] for i, records in self.records.items()}

    @cached_property
    def moves(self) -> list[_Move]:
        known = [
            (i, source, name, target)
            for (source, name, target), i in self.links.items()
            if {source, target} <= self.states.keys()
        ]
        return [
            _Move(i, self.states[source], self.actions[name], self.states[target])
            for i, source, name, target in known
        ]

    @cached_property
    def travels(self) -> list[_Move]:
        return [m for m in self.moves if m.action.kind == "travel"]

    @cached_property
    def turns(self) -> list[_Move]:
        return [m for m in self.moves if m.action.kind == "turn"]

    @cached_property
    def visited(self) -> list[tuple[int, DState]]:
        """The dstates in the order of their first visits, with the step."""
        return [(i, self.states[label]) for label, i in self.first.items() if label in self.states]

    def steps_of(self, *dstates: int) -> list[int]:
        """The first steps at which these dstates were visited."""
        return [self.first[s] for s in dstates if s in self.first]

    @cached_property
    def place_seen(self) -> dict[int, int]:
        """The first step at each place."""
        return {s.place: i for i, s in reversed(self.visited) if s.place is not None}

    @cached_property
    def along(self) -> dict[int, dict[int, int]]:
        """For each path, the places at which a dstate is along it, and the id of that dstate."""
        found: dict[int, dict[int, int]] = defaultdict(dict)
        for s in self.states.values():
            if (course := _course(s)) and s.place is not None:
                found[course[0]].setdefault(s.place, s.id)
        return found

    @cached_property
    def orders(self) -> dict[int, _Order]:
        """The order of each path that the map has, or that one of its dstates is along."""
        edges: dict[int, dict[tuple[int, int], _Move]] = defaultdict(dict)
        for move, (path, direction), p, q in (
            self.along_travels if "travel_orders" in self.axioms else ()
        ):
            edges[path].setdefault((p, q) if direction == 1 else (q, p), move)
        listed: dict[int, tuple[int, ...]] = {}
        for h in self.map.paths:
            listed.setdefault(h.id, h.order)
        return {h: _Order(listed.get(h, ()), edges[h], self.axioms) for h in listed | self.along}

    @cached_property
    def along_travels(self) -> list[tuple[_Move, Course, int, int]]:
        """The travels along one course from one place to another."""
        found = []
        for m in self.travels:
            course, p, q = _course(m.source), m.source.place, m.target.place
            if (
                course
                and course == _course(m.target)
                and p is not None
                and q is not None
                and p != q
            ):
                found.append((m, course, p, q))
        return found

    def on(self, path: int) -> set[int]:
        """The places on a path: those that the map lists, and those that on_path puts there. Without on_path no place has to be on a path."""
        if "on_path" not in self.axioms or path not in self.orders:
            return set()
        return {*self.orders[path].listed, *self.along.get(path, ())}

    @cached_property
    def branches(self) -> list[_Branch]:
        """Which course leaves to the right of which other one, at which place. What turns show comes before what symmetry adds."""
        if "branch_side" not in self.axioms:
            return []
        found: dict[tuple[int, Course, Course], _Branch] = {}
        for m in self.turns:
            (p, here, there) = m.source.place, _course(m.source), _course(m.target)
            if (
                p is not None
                and here
                and there
                and here[0] != there[0]
                and m.action.turn in ("right", "left")
            ):
                course = here if m.action.turn == "right" else _opposite(here)
                found.setdefault((p, course, there), _Branch(p, course, there, m, mirrored=False))
        if "symmetric_sides" in self.axioms:
            for b in list(found.values()):
                back, away = _opposite(b.course), _opposite(b.branch)
                for course, branch in ((back, away), (b.branch, back), (away, b.course)):
                    found.setdefault(
                        (b.place, course, branch),
                        _Branch(b.place, course, branch, b.turn, mirrored=True),
                    )
        return list(found.values())

    @cached_property
    def right(self) -> dict[Course, dict[int, _Branch]]:
        """For each course, the places right of it, and the branch that each lies ahead on. Left is right of the opposite course."""
        found: dict[Course, dict[int, _Branch]] = defaultdict(dict)
        for b in self.branches if "side_of_branch" in self.axioms else ():
            if frozenset((b.course[0], b.branch[0])) not in self.excused:
                for q in (
                    self.orders[b.branch[0]].after(b.place, b.branch[1])
                    if b.branch[0] in self.orders
                    else ()
                ):
                    found[b.course].setdefault(q, b)
        return found

    @cached_property
    def excused(self) -> set[frozenset[int]]:
        return (
            {frozenset(pair) for pair in self.map.excused if _is_pair(pair)}
            if self.theory.boundary == "defeasible"
            else set()
        )

    @cached_property
    def sights(self) -> tuple[list[Sight], dict[tuple[Sight, Sight], set[Action]]]:
        """The dstates with the stars seen there, by the steps that first have them, and the turns at places that lead from one to another."""
        sights: dict[tuple[int, Star], Sight] = {}
        seen: list[Sight | None] = []
        shown: set[int] = set()
        places: set[int | None] = set()
        for i, (label, step) in enumerate(zip(self.map.labels, self.trace.steps, strict=False)):
            s, star = self.states.get(label), step.gateways or Star(())
            if s and (label, star) not in sights:
                sights[label, star] = Sight(
                    s, star, i, label not in shown, s.place not in places, self._onward(s)
                )
                shown.add(label)
                places.add(s.place)
            seen.append(sights.get((label, star)))
        turns: dict[tuple[Sight, Sight], set[Action]] = defaultdict(set)
        for a, b, action in zip(seen, seen[1:], self.trace.actions, strict=False):
            if a and b and action.kind == "turn" and a.dstate.place == b.dstate.place:
                turns[a, b].add(action)
        return list(sights.values()), turns

    def _onward(self, s: DState) -> tuple[int, ...]:
        """Where the path of a dstate goes on to another place: ahead (0), behind (180)."""
        course = _course(s)
        if course is None or s.place is None or course[0] not in self.orders:
            return ()
        path, direction = course
        return tuple(
            towards
            for towards, way in ((0, direction), (180, -direction))
            if self.orders[path].after(s.place, way)
        )

    @cached_property
    def clashes(self) -> list[Clash]:
        """The places at which the stars seen cannot be one star in tolerance."""
        return list(clashes(*self.sights, self.axioms))

    @cached_property
    def conflicts(self) -> list[_Conflict]:
        """The places that the axioms of the sides put where they cannot be."""
        disjoint = _both_sides(self) if "sides_disjoint" in self.axioms else ()
        between = _on_and_beside(self) if "path_between_sides" in self.axioms else ()
        return [*disjoint, *between]


def _both_sides(m: _Reading) -> Iterator[_Conflict]:
    for (h, direction), places in list(m.right.items()):
        other = m.right.get((h, -direction), {}) if direction == 1 else {}
        for q in places.keys() & other.keys():
            b, c = places[q], other[q]
            steps = (*b.turn.steps, *c.turn.steps, *_seen(m, q))
            yield _Conflict(
                "sides_disjoint",
                (b, c),
                steps,
                f"Place {q} would lie both right and left of path {h}: it is {b}, and {c}.",
            )


def _on_and_beside(m: _Reading) -> Iterator[_Conflict]:
    for (h, _direction), places in list(m.right.items()):
        for q in places.keys() & m.on(h):
            b = places[q]
            steps = (
                *b.turn.steps,
                *_seen(m, q),
                *m.steps_of(*([m.along[h][q]] if q in m.along.get(h, ()) else [])),
            )
            yield _Conflict(
                "path_between_sides",
                (b,),
                steps,
                f"Place {q} is on path {h} and would lie beside it: it is {b}.",
            )


def _seen(m: _Reading, place: int) -> list[int]:
    return [m.place_seen[place]] if place in m.place_seen else []


def _course(s: DState) -> Course | None:
    """The path and direction of a dstate that has both."""
    return (s.path, s.direction) if s.path is not None and s.direction in (1, -1) else None


def _opposite(course: Course) -> Course:
    return course[0], -course[1]


def _along(course: Course) -> str:
    return f"path {course[0]}{'+' if course[1] == 1 else '-'}"


def _going(s: DState) -> str:
    course = _course(s)
    return _along(course) if course else "no path"


def _heading(s: DState) -> int | None:
    return s.heading if s.heading in (0, 1, 2, 3) else None


def _turned(star: Openings, quarters: int) -> Openings:
    """The star of a frame, from the one seen by somebody turned `quarters` clockwise in it."""
    ahead, right, back, left = (star[(slot - quarters) % 4] for slot in range(4))
    return ahead, right, back, left


def _is_pair(pair: object) -> bool:
    return isinstance(pair, tuple) and len(pair) == 2


# The map fits the trace, and its numbers fit each other.


def _labels_are_dstates(m: _Reading) -> Found:
    """Each step has a label, and each label is the id of a dstate."""
    steps, labels = len(m.trace), len(m.map.labels)
    if steps != labels:
        yield (
            [min(steps, labels)] if labels < steps else [],
            f"The map labels {labels} steps, but the trace has {steps}.",
        )
    for label, i in m.first.items():
        if label not in m.records:
            yield [i], f"Step {i} is labelled {label}, but the map has no dstate {label}."


def _numbered_by_first_visit(m: _Reading) -> Found:
    """All dstates, places and paths are visited, are numbered 0, 1, 2, … by first visit, and each path is first faced in direction +1."""
    yield from _numbered(
        "dstates", [s.id for s in m.map.dstates], [(i, s.id) for i, s in m.visited]
    )
    if m.theory.level == "causal":
        return
    yield from _numbered("places", m.map.places, [(i, s.place) for i, s in m.visited])
    yield from _numbered("paths", [h.id for h in m.map.paths], [(i, s.path) for i, s in m.visited])
    faced: set[int] = set()
    for i, s in m.visited:
        if (course := _course(s)) and course[0] not in faced:
            faced.add(course[0])
            if course[1] != 1:
                yield (
                    [i],
                    f"Path {course[0]} is first faced at step {i}, in direction -1 instead of +1.",
                )


def _numbered(what: str, ids: Sequence[int], visits: Iterable[tuple[int, int | None]]) -> Found:
    if list(ids) != list(range(len(ids))):
        yield [], f"The ids of the {what} are not 0, 1, 2, … in this order."
    used = {x: i for i, x in reversed(list(visits)) if x is not None}
    known = set(ids)
    for x, i in used.items():
        if x not in known:
            yield [i], f"The map uses {x} at step {i}, but lists no such one of its {what}."
    for x in known - used.keys():
        yield [], f"The map lists {x} among its {what}, but no step is there."
    for number, (i, x) in enumerate(sorted((i, x) for x, i in used.items())):
        if x != number:
            yield (
                [i],
                f"The {what} are not numbered by first visit: {x} is number {number} to be visited, at step {i}.",
            )
            return


def _dstates_look_as_seen(m: _Reading) -> Found:
    """A dstate has the view of the first step there at which it is known and not misread. The views of its other steps are judged under functional_view."""
    shown: dict[int, tuple[View | None, int]] = {}
    for (label, view), i in m.views.items():
        shown.setdefault(label, (view, i))
    for first, s in m.visited:
        view, i = shown.get(s.id, (None, first))
        if s.view != view:
            said = (
                f"looks like {view!r} at step {i}"
                if s.id in shown
                else "is unknown or misread wherever it is visited"
            )
            yield [i], f"Dstate {s.id} has the view {s.view!r} in the map, but {said}."


def _faults_are_allowed(m: _Reading) -> Found:
    """Each fault is one that the theory allows, is named once, and is what the trace and the map show."""
    named: set[tuple[str, int]] = set()
    for fault in m.map.faults:
        i, kind = fault.step, fault.kind
        prices = {
            "misread": m.theory.misread,
            "misseen": m.theory.misread,
            "slipped": m.theory.slipped,
            "jumped": m.theory.jumped,
        }
        allowed = prices.get(kind, 0)
        steps = m.trace.steps
        if not allowed or (kind == "misseen" and m.theory.star not in ("pattern", "frame")):
            yield [], f"The map disbelieves step {i} ({kind}), which the theory does not allow."
        elif (
            not 0 <= i < min(len(m.trace), len(m.map.labels))
            or (kind == "misread" and m.trace.steps[i].view is None)
            or (kind == "slipped" and m.trace.steps[i].action is None)
            or (kind == "jumped" and m.trace.steps[i].displacement is None)
        ):
            yield (
                [],
                f"The map disbelieves step {i} ({kind}), where there is nothing to disbelieve.",
            )
        elif (kind, i) in named:
            yield [i], f"The map names the fault of step {i} ({kind}) twice."
        elif kind == "misread":
            s, seen = m.states.get(m.map.labels[i]), m.trace.steps[i].view
            if fault.seen != seen or (s and fault.expected != s.view) or seen == fault.expected:
                yield (
                    [i],
                    f"The map says that {fault}, but the trace has {seen!r} there, and the dstate {s.view if s else None!r}.",
                )
        elif kind == "slipped" and fault.seen != (m.trace.steps[i].action or Action("")).name:
            yield [i], f"The map says that {fault}, but the trace has another action there."
        if (
            allowed
            and 0 <= i < len(steps)
            and round(10 * fault.cost) != (price := m.theory.fault_tenths(kind, steps[i]))
        ):
            yield (
                [i],
                f"The fault of step {i} ({kind}) costs {fault.cost:g} dstates in the map, and {price / 10:g} by the theory.",
            )
        named.add((kind, i))


def _links_are_those_of_the_trace(m: _Reading) -> Found:
    shown = set(m.map.links)
    if len(shown) < len(m.map.links):
        yield [], "The map lists a link twice."
    for link, i in m.links.items():
        if link not in shown:
            yield (i, i + 1), f"The map has no link {link}, though this is done at step {i}."
    for link in shown - m.links.keys():
        yield [], f"The map has the link {link}, but the trace never does this."


def _has_what_the_theory_has(m: _Reading) -> Found:
    """The map has no places and paths at the causal level, no headings without frames, and no excuses unless boundary=defeasible."""
    causal = m.theory.level == "causal"
    if causal and (m.map.places or m.map.paths):
        yield [], "The map has places or paths, but the theory is causal."
    for s in m.map.dstates:
        if causal and (s.place, s.path, s.direction) != (None, None, None):
            yield (
                m.steps_of(s.id),
                f"Dstate {s.id} has a place, path or direction, but the theory is causal.",
            )
        if m.theory.star not in ("frame", "gateways") and s.heading is not None:
            yield (
                m.steps_of(s.id),
                f"Dstate {s.id} has a heading, but the places of the theory have no frames.",
            )
    if m.map.excused and m.theory.boundary != "defeasible":
        yield [], "The map excuses pairs of paths, but the theory excuses none."


def _excused_are_pairs_of_paths(m: _Reading) -> Found:
    paths = {h.id for h in m.map.paths}
    for pair in m.map.excused:
        if not _is_pair(pair) or not set(pair) <= paths:
            yield [], f"The map excuses {pair}, which is not a pair of its paths."


def _orders_list_places_once(m: _Reading) -> Found:
    """The order of a path lists places of the map, none twice. Whether they are the right places is judged under on_path."""
    places = set(m.map.places)
    for h in m.map.paths:
        if len(set(h.order)) < len(h.order):
            yield [], f"The order of path {h.id} lists a place twice."
        for p in set(h.order) - places:
            yield [], f"The order of path {h.id} lists place {p}, which the map does not have."


def _frames_start_at_first_visit(m: _Reading) -> Found:
    """The dstate at which a place is first visited has heading 0."""
    if not {"one_heading", "gateway_heading"} & m.axioms:
        return
    for p, i in m.place_seen.items():
        s = m.states[m.map.labels[i]]
        if heading := s.heading if m.theory.star == "gateways" else _heading(s):
            yield (
                [i],
                f"Place {p} is first visited at step {i} with heading {heading} instead of 0.",
            )


_COHERENCE: tuple[Check, ...] = (
    _labels_are_dstates,
    _numbered_by_first_visit,
    _dstates_look_as_seen,
    _faults_are_allowed,
    _links_are_those_of_the_trace,
    _has_what_the_theory_has,
    _excused_are_pairs_of_paths,
    _orders_list_places_once,
    _frames_start_at_first_visit,
)


# Causal level


def _functional_view(m: _Reading) -> Found:
    """A dstate has one view (C1)."""
    known: dict[int, tuple[View | None, int]] = {}
    for (s, view), i in m.views.items():
        first, at = known.setdefault(s, (view, i))
        if view != first:
            yield (
                (at, i),
                f"Dstate {s} looks like {first!r} at step {at} and like {view!r} at step {i}.",
            )


def _deterministic(m: _Reading) -> Found:
    """An action done in a dstate always leads to the same dstate (C2)."""
    known: dict[tuple[int, str], tuple[int, int]] = {}
    for (source, action, target), i in m.links.items():
        first, at = known.setdefault((source, action), (target, i))
        if target != first:
            yield (
                (at, at + 1, i, i + 1),
                f"{action!r} in dstate {source} leads to dstate {first} at step {at}, and to dstate {target} at step {i}.",
            )


# Topological level


def _one_place(m: _Reading) -> Found:
    """A dstate is at one place (T1, T10)."""
    for s, records in m.records.items():
        places = {r.place for r in records}
        if None in places:
            yield m.steps_of(s), f"Dstate {s} is at no place."
        if len(places - {None}) > 1:
            yield m.steps_of(s), f"Dstate {s} is at several places."


def _turn_stays(m: _Reading) -> Found:
    """A turn stays at its place (T2)."""
    for t in m.turns:
        if t.source.place != t.target.place:
            yield (
                t.steps,
                f"{t} is a turn, but leads from place {t.source.place} to place {t.target.place}.",
            )


def _travel_leaves(m: _Reading) -> Found:
    """A travel leads to another place (T3)."""
    for t in m.travels:
        if t.source.place == t.target.place and t.source.place is not None:
            yield t.steps, f"{t} is a travel, but stays at place {t.source.place}."


def _travel_follows_path(m: _Reading) -> Found:
    """A travel starts and ends along the same path in the same direction (T4)."""
    for t in m.travels:
        if _course(t.source) is None or _course(t.source) != _course(t.target):
            yield (
                t.steps,
                f"{t} is a travel, but starts along {_going(t.source)} and ends along {_going(t.target)}.",
            )


def _one_course(m: _Reading) -> Found:
    """A dstate is along at most one path, in one direction (T5, T10)."""
    for s, records in m.records.items():
        if len({(r.path, r.direction) for r in records}) > 1:
            yield m.steps_of(s), f"Dstate {s} is along several paths or directions."
        for r in records:
            if (r.path, r.direction) != (None, None) and _course(r) is None:
                yield (
                    m.steps_of(s),
                    f"Dstate {s} has path {r.path} and direction {r.direction}, which is not one path in one direction.",
                )


def _turn_around_reverses(m: _Reading) -> Found:
    """A turn around keeps the path and reverses the direction (T6)."""
    for t in m.turns:
        course, other = _course(t.source), _course(t.target)
        if t.action.turn == "around" and other != (course and _opposite(course)):
            yield (
                t.steps,
                f"{t} is a turn around, but leads from {_going(t.source)} to {_going(t.target)}.",
            )


def _turn_changes_path(m: _Reading) -> Found:
    """A turn right or left leads from one path to another (T7)."""
    for t in m.turns:
        course, other = _course(t.source), _course(t.target)
        if t.action.turn in ("right", "left") and course and other and course[0] == other[0]:
            yield (
                t.steps,
                f"{t} is a turn {t.action.turn}, but both dstates are along path {course[0]}.",
            )


def _one_dstate_per_course(m: _Reading) -> Found:
    """At a place, at most one dstate is along a path in a direction (T8)."""
    known: dict[tuple[int, Course], int] = {}
    for s in m.states.values():
        if s.place is not None and (course := _course(s)):
            first = known.setdefault((s.place, course), s.id)
            if first != s.id:
                yield (
                    m.steps_of(first, s.id),
                    f"Dstates {first} and {s.id} are both at place {s.place} along {_along(course)}.",
                )


def _on_path(m: _Reading) -> Found:
    """A place is on a path when a dstate at it is along the path (T11)."""
    for h, order in m.orders.items():
        there = m.along.get(h, {})
        for p in set(order.listed) - there.keys():
            yield _seen(m, p), f"Path {h} lists place {p}, but no dstate there is along the path."
        for p in there.keys() - set(order.listed):
            yield (
                m.steps_of(there[p]),
                f"Dstate {there[p]} at place {p} is along path {h}, but the path does not list the place.",
            )


def _travel_orders(m: _Reading) -> Found:
    """A travel puts the place it leaves before the place it reaches (T9)."""
    for h, order in m.orders.items():
        for p, q in order.backward if order.can_be_listed else ():
            if {p, q} <= order.position.keys():
                t = order.travels[p, q]
                yield (
                    t.steps,
                    f"Path {h} lists place {q} before place {p}, but {t} along {_going(t.source)} says the reverse.",
                )


def _order_asymmetric(m: _Reading) -> Found:
    """No two places of a path come before each other (T9)."""
    for h, order in m.orders.items():
        for ring in order.rings:
            if not order.allows(ring):
                yield (
                    order.ring_steps(ring),
                    f"On path {h} the travels make places {ring[0]} and {ring[-1]} come before each other.",
                )


def _order_transitive(m: _Reading) -> Found:
    """What comes before a place comes before all that follow it (T9)."""
    for h, order in m.orders.items():
        for ring in order.rings:
            if not order.allows(ring) and len(ring) > 2:
                way = ", ".join(map(str, ring))
                yield (
                    order.ring_steps(ring),
                    f"On path {h} the travels lead through places {way}, but the last comes before the first.",
                )


def _path_order_total(m: _Reading) -> Found:
    """Of two places on a path, one comes before the other (TOT)."""
    for h, order in m.orders.items():
        places = m.on(h)
        for p in sorted(places - order.position.keys(), key=str):
            if apart := places - {p, *order.after(p, 1), *order.after(p, -1)}:
                q = min(apart, key=str)
                yield (
                    [*_seen(m, p), *_seen(m, q)],
                    f"Places {p} and {q} are on path {h}, but neither comes before the other.",
                )
                break


def _next_place(m: _Reading) -> Found:
    """A travel leads to the next place of the path: none lies between (ADJ)."""
    for t, (h, direction), p, q in m.along_travels:
        if h in m.orders and (between := m.orders[h].between(p, q, direction)):
            r = min(between, key=str)
            yield (
                [*t.steps, *_seen(m, r)],
                f"{t} leads from place {p} to place {q}, but place {r} lies between them on path {h}.",
            )


def _all_on_paths(m: _Reading) -> Found:
    """Every dstate is along a path (T5tot)."""
    for s in m.states.values():
        if _course(s) is None:
            yield m.steps_of(s.id), f"Dstate {s.id} is along no path."


def _course_needs_travel(m: _Reading) -> Found:
    """A dstate is along a path only if a travel starts or ends at it, or a turn around links it to one that is (T5)."""
    linked: dict[int, list[int]] = defaultdict(list)
    for t in m.turns:
        if t.action.turn == "around":
            linked[t.source.id].append(t.target.id)
            linked[t.target.id].append(t.source.id)
    queue = [s.id for t in m.travels for s in (t.source, t.target)]
    supported = set(queue)
    while queue:
        new = set(linked[queue.pop()]) - supported
        supported |= new
        queue.extend(new)
    for s in m.states.values():
        if _course(s) and s.id not in supported:
            yield (
                m.steps_of(s.id),
                f"Dstate {s.id} is along {_going(s)}, but no travel starts or ends at it, nor where turning around leads.",
            )


# Boundary regions


def _sides(name: str, m: _Reading) -> Found:
    """The axioms of right and left (B1 to B4): a turn puts a branch on a side, the places ahead on the branch are on that side, and sides exclude each other."""
    for conflict in m.conflicts:
        if name in conflict.axioms:
            yield conflict.steps, conflict.message


# Local topology


def _star_pattern(m: _Reading) -> Found:
    """All stars seen at a place are one star, turned."""
    yield from _one_star(
        ((s, min(_turned(star, k) for k in range(4)), i) for s, star, i in _stars(m)),
        "however turned",
    )


def _star_frame(m: _Reading) -> Found:
    """The stars seen at a place agree when each is turned by its heading."""
    framed = (
        (s, _turned(star, heading), i)
        for s, star, i in _stars(m)
        if (heading := _heading(s)) is not None
    )
    yield from _one_star(framed, "turned by their headings")


def _stars(m: _Reading) -> Iterator[tuple[DState, Openings, int]]:
    return ((m.states[s], star, i) for (s, star), i in m.stars.items() if s in m.states)


def _one_star(seen: Iterable[tuple[DState, Openings, int]], how: str) -> Found:
    known: dict[int, tuple[Openings, int]] = {}
    for s, star, i in seen:
        if s.place is not None:
            first, at = known.setdefault(s.place, (star, i))
            if star != first:
                yield (
                    (at, i),
                    f"The stars seen at place {s.place} at steps {at} and {i} differ, {how}.",
                )


def _one_heading(m: _Reading) -> Found:
    """A dstate has one heading."""
    for s, records in m.records.items():
        if len({r.heading for r in records}) > 1:
            yield m.steps_of(s), f"Dstate {s} has several headings."
        for r in records:
            if _heading(r) is None:
                yield (
                    m.steps_of(s),
                    f"Dstate {s} has the heading {r.heading}, which is none of the slots 0 to 3.",
                )


def _turn_rotates(m: _Reading) -> Found:
    """A turn right, around or left adds one, two or three quarters to the heading."""
    for t in m.turns:
        before, after = _heading(t.source), _heading(t.target)
        if (
            before is None
            or after is None
            or t.action.turn is None
            or t.source.place != t.target.place
        ):
            continue  # headings at two places are in two frames; a turn between places is reported under turn_stays
        if (before + QUARTERS[t.action.turn]) % 4 != after:
            yield (
                t.steps,
                f"{t} is a turn {t.action.turn}, but leads from heading {before} to heading {after}.",
            )


def _one_dstate_per_heading(m: _Reading) -> Found:
    """At a place, at most one dstate faces a slot."""
    known: dict[tuple[int, int], int] = {}
    for s in m.states.values():
        heading = _heading(s)
        if s.place is not None and heading is not None:
            first = known.setdefault((s.place, heading), s.id)
            if first != s.id:
                yield (
                    m.steps_of(first, s.id),
                    f"Dstates {first} and {s.id} both face slot {heading} of place {s.place}.",
                )


def _path_goes_straight(m: _Reading) -> Found:
    """A path leaves a place through opposite slots, and a slot belongs to one path."""
    slots: dict[tuple[int, int], tuple[Course, int]] = {}
    ways: dict[tuple[int, Course], tuple[int, int]] = {}
    for s in m.states.values():
        heading, course, p = _heading(s), _course(s), s.place
        if heading is None or course is None or p is None:
            continue
        for slot, way in ((heading, course), ((heading + 2) % 4, _opposite(course))):
            other, a = slots.setdefault((p, slot), (way, s.id))
            if other != way:
                yield (
                    m.steps_of(a, s.id),
                    f"By dstates {a} and {s.id}, both {_along(other)} and {_along(way)} leave place {p} through slot {slot}.",
                )
            through, b = ways.setdefault((p, way), (slot, s.id))
            if through != slot:
                yield (
                    m.steps_of(b, s.id),
                    f"By dstates {b} and {s.id}, {_along(way)} leaves place {p} through both slots {through} and {slot}.",
                )


def _gateways(name: str, m: _Reading) -> Found:
    """The axioms of places with any number of gateways. A map does not show which gateway is which, so a clash is told under each axiom that takes part."""
    for clash in m.clashes:
        if name in clash.axioms:
            steps = ", ".join(map(str, clash.steps))
            if name == "gateway_end" and len(clash.axioms) == 1:
                yield (
                    clash.steps,
                    f"The path goes on from place {clash.place}, but at steps {steps} no gateway is seen that leads on.",
                )
                continue
            yield (
                clash.steps,
                f"What is seen at steps {steps} cannot be one place, {clash.place}: the gateways do not agree, however turned.",
            )


# Planarity


def _planar(m: _Reading) -> Found:
    """Paths meet at places only: the map can be drawn in the plane, with turns right to the right, without a crossing."""
    place_of = {s.id: s.place for s in m.states.values() if s.place is not None}
    headings = {s: heading for s in place_of if (heading := _heading(m.states[s])) is not None}
    turns = [
        (t.source.id, t.action.turn, t.target.id)
        for t in m.turns
        if t.action.turn and {t.source.id, t.target.id} <= place_of.keys()
    ]
    stars = (
        {s: [star for state, star, _ in _stars(m) if state.id == s] for s in place_of}
        if "star_frame" in m.axioms
        else {}
    )

    def cross(travels: Sequence[_Move]) -> bool:
        edges = Edges([(t.source.id, t.target.id) for t in travels], turns, place_of)
        if m.theory.star != "frame":
            return not edges.can_be_drawn(crossing=m.theory.symmetric_sides)
        if headings.keys() == place_of.keys() and edges.can_be_drawn_by(headings):
            return False
        turned, distinct = (
            {"turn_rotates", "one_heading"} <= m.axioms,
            "one_dstate_per_heading" in m.axioms,
        )
        return not edges.can_be_drawn_in_frames(stars, turned=turned, distinct=distinct)

    kept = [t for t in m.travels if {t.source.id, t.target.id} <= place_of.keys()]
    if not cross(kept):
        return
    for t in list(kept):
        if cross(fewer := [other for other in kept if other is not t]):
            kept = fewer
    ways = ", ".join(f"{t.source.place} to {t.target.place} (step {t.step})" for t in kept)
    yield (
        [step for t in kept for step in t.steps],
        f"However it is drawn, paths cross where there is no place; travels lead along them from place {ways}.",
    )


# What somebody says


def _asserted(m: _Reading) -> Found:
    """What somebody asserts of pairs of steps holds in the map."""
    labels, theory = m.map.labels, m.theory
    told = [
        ("one dstate", theory.same),
        ("different dstates", theory.different),
        ("at different places", theory.elsewhere),
    ]
    for said, (i, j) in (
        (said, pair) for said, pairs in told for pair in pairs if max(pair) < len(labels)
    ):
        here, there = labels[i], labels[j]
        places = {m.states[label].place for label in (here, there) if label in m.states}
        if said == "one dstate" and here != there:
            yield (
                [i, j],
                f"Steps {i} and {j} are dstates {here} and {there}, but are said to be one dstate.",
            )
        elif said != "one dstate" and here == there:
            yield [i, j], f"Steps {i} and {j} are one dstate, {here}, but are said to be {said}."
        elif said == "at different places" and len(places) == 1 and None not in places:
            yield (
                [i, j],
                f"Steps {i} and {j} are at one place, {min(places, key=str)}, but are said to be {said}.",
            )


def _star_of_dstate(m: _Reading) -> Found:
    """The stars seen at a dstate show the same gateways, each in its direction."""
    seen: dict[int, dict[Star, int]] = {}
    for t, (label, step) in enumerate(zip(m.map.labels, m.trace.steps, strict=False)):
        stars, star = seen.setdefault(label, {}), step.gateways or Star(())
        for other, i in stars.items() if star not in stars else ():
            if not may_show_the_same(other, star):
                yield (
                    [i, t],
                    f"Steps {i} and {t} are one dstate, {label}, but the gateways seen there are not in the same directions.",
                )
        stars.setdefault(star, t)


def _one_pose(m: _Reading) -> Found:
    """A dstate has one pose, a place one position, with which the displacements agree within their covariance."""
    from ssh_abduction.checker.geometry import refused_returns  # loads numpy

    trusted = m.trace.without_displacements_at(
        [fault.step for fault in m.map.faults if fault.kind == "jumped"]
    )
    for refused in refused_returns(trusted, m.map, m.theory):
        said = " and ".join(
            f"steps {i} and {j} are at one {'place' if freedom == 2 else 'dstate'}"
            for i, j, freedom in refused.returns
        )
        steps = [t for i, j, _ in refused.returns for t in (i, j)]
        yield (
            steps,
            f"By the displacements it cannot be that {said}: {refused} (chi-square {refused.square:.0f}, and at most {refused.most:.0f} is allowed).",
        )


AXIOMS: dict[str, Check] = {
    "functional_view": _functional_view,
    "deterministic": _deterministic,
    "one_place": _one_place,
    "turn_stays": _turn_stays,
    "travel_leaves": _travel_leaves,
    "travel_follows_path": _travel_follows_path,
    "one_course": _one_course,
    "turn_around_reverses": _turn_around_reverses,
    "turn_changes_path": _turn_changes_path,
    "one_dstate_per_course": _one_dstate_per_course,
    "on_path": _on_path,
    "travel_orders": _travel_orders,
    "order_asymmetric": _order_asymmetric,
    "order_transitive": _order_transitive,
    "path_order_total": _path_order_total,
    "next_place": _next_place,
    "all_on_paths": _all_on_paths,
    "course_needs_travel": _course_needs_travel,
    "branch_side": partial(_sides, "branch_side"),
    "symmetric_sides": partial(_sides, "symmetric_sides"),
    "side_of_branch": partial(_sides, "side_of_branch"),
    "sides_disjoint": partial(_sides, "sides_disjoint"),
    "path_between_sides": partial(_sides, "path_between_sides"),
    "star_pattern": _star_pattern,
    "star_frame": _star_frame,
    "one_heading": _one_heading,
    "turn_rotates": _turn_rotates,
    "one_dstate_per_heading": _one_dstate_per_heading,
    "path_goes_straight": _path_goes_straight,
    "gateway_frame": partial(_gateways, "gateway_frame"),
    "gateway_heading": partial(_gateways, "gateway_heading"),
    "gateway_turn": partial(_gateways, "gateway_turn"),
    "gateway_dstate": partial(_gateways, "gateway_dstate"),
    "gateway_path": partial(_gateways, "gateway_path"),
    "gateway_end": partial(_gateways, "gateway_end"),
    "one_star": _star_of_dstate,
    "asserted": _asserted,
    "one_pose": _one_pose,
    "planar": _planar,
}
