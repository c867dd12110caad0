"""Find the joins of a map that rest on minimality alone: no axiom and no observation forces them.

A join is two steps that a map puts at one place or at one dstate.

>>> from ssh_abduction.data.maps import DState, SSHMap
>>> from ssh_abduction.data.trace import Trace
>>> from ssh_abduction.theory.theory import Theory
>>> trace = Trace.from_steps("abab", ["on", "on", "on"])
>>> one = SSHMap((0, 1, 0, 1), (DState(0, "a"), DState(1, "b")), ((0, "on", 1), (1, "on", 0)))
>>> [(join.first, join.second) for join in joins_by_minimality(trace, one, Theory.causal())]
[(0, 2)]

Steps 1 and 3 are one dstate too. This follows from the join of steps 0 and 2, as the same action
led from both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ssh_abduction.data.drives import drives_of, named_steps
from ssh_abduction.data.groups import NodeClasses
from ssh_abduction.data.maps import SSHMap, check_of_trace, checked_map
from ssh_abduction.data.trace import Action, Trace, checked_trace
from ssh_abduction.data.words import counted
from ssh_abduction.theory.theory import Theory, checked_theory

# Axioms by which the heading decides which dstate of a place the robot is at.
HEADINGS = (
    {"one_heading", "turn_rotates", "one_dstate_per_heading"},
    {"gateway_heading", "gateway_turn", "gateway_dstate"},
)
SHOWN = 5  # a sentence names at most this many joins of a kind


@dataclass(frozen=True, slots=True)
class Join:
    """Two steps that a map puts at one place or at one dstate, though no axiom forces this.

    Attributes:
        first: The earlier step.
        second: The later step.
        at_place: True if the join puts the two steps at one place. False if it only puts them at
            one dstate: they are at one place for another reason, or the map has no places.
    """

    first: int
    second: int
    at_place: bool

    def to_dict(self) -> dict[str, Any]:
        """Return the join as plain data, as `solve --json` prints it."""
        return {"steps": [self.first, self.second], "of": "place" if self.at_place else "dstate"}


def joins_by_minimality(
    trace: Trace, ssh_map: SSHMap, theory: Theory | None = None
) -> tuple[Join, ...]:
    """List the joins of a map that rest on minimality alone and imply all other such joins.

    The trace is read step by step. A step at a known dstate is joined to the last step there. If a
    visit to a known place has only new dstates, the visit is joined to the last step at the place.
    A join is listed unless it follows from the joins of earlier steps by one of these reasons:

    - The same action at the same dstate led there before (`deterministic`).
    - The user says so (`asserted`).
    - Both steps are known to be at one place, and face the same way there by the robot's turns
      (`one_dstate_per_heading`, `gateway_dstate`).
    - Both are known to be at one place, and along one path in one direction by the robot's travels
      and turns around (`one_dstate_per_course`).

    With headings, a join of places also says which way the robot faces there. For each listed join,
    there is a map that satisfies the axioms and has the joins listed before it, but not this one.
    There are exceptions: a join may follow from the user's own rules, or from `next_place`, which
    is off in every preset. With `star=gateways` it is assumed that turns determine the heading. A
    few turns do not, such as a turn right at a place with two gateways on the right and the same
    star in both directions.

    Args:
        trace: The trace that was mapped.
        ssh_map: A minimal map of the trace.
        theory: The theory, with each "auto" replaced; Theory.topological() if None.

    Raises:
        TraceError: `trace` is not a Trace.
        MapError: The map is of another trace.
        TheoryError: `theory` is not a Theory.
    """
    checked_trace(trace)
    check_of_trace([checked_map(ssh_map)], trace, "joins_by_minimality", views=False)
    return _JoinCollector(trace, ssh_map, checked_theory(theory)).joins()


def joins_in_words(joins: Sequence[Join], maps: int = 1, *, minimal: bool = False) -> str:
    """Say which joins of the first map rest on minimality alone; empty if there are none.

    `maps` is the number of maps listed. With `minimal`, say first that the map is minimal.
    """
    kinds = {
        "these places": [join for join in joins if join.at_place],
        "these dstates": [join for join in joins if not join.at_place],
    }
    named = [f"{kind}: {_named(some)}" for kind, some in kinds.items() if some]
    opening = ("minimal; " if minimal else "") + ("in map 1 " if maps > 1 else "")
    return f"{opening}nothing observed separates {'; nor '.join(named)}" if named else ""


def _named(joins: Sequence[Join]) -> str:
    """Name the steps of the first SHOWN joins, and count the others."""
    pairs = ", ".join(f"{join.first} and {join.second}" for join in joins[:SHOWN])
    more = len(joins) - SHOWN
    return f"steps {pairs}" + (f", and {counted(more, 'more joins')}" if more > 0 else "")


class _JoinCollector:
    """Reads a trace step by step, and collects the joins that do not follow from earlier ones.

    Attributes:
        places: Steps of one class are known to be at one place.
        courses: Steps of one class are known to be along one path. The map says in which
            directions.
    """

    def __init__(self, trace: Trace, ssh_map: SSHMap, theory: Theory) -> None:
        self.trace, self.map, self.axioms = trace, ssh_map, set(theory.axioms)
        self.places, self.courses = NodeClasses[int](), NodeClasses[int]()
        self.by_heading = any(headings <= self.axioms for headings in HEADINGS)
        self.by_course = "one_dstate_per_course" in self.axioms
        asserted = [sorted(pair) for pair in theory.same if max(pair) < len(trace)]
        self.asserted = {second for _, second in asserted}
        slipped = {fault.step for fault in ssh_map.faults if fault.kind == "slipped"}
        # The action that led to each step; None if there is none, or if it slipped.
        self.led: list[Action | None] = [
            None,
            *(None if t in slipped else step.action for t, step in enumerate(trace.steps[:-1])),
        ]
        self._link_steps()
        for first, second in asserted:
            self._merge(first, second)

    def _link_steps(self) -> None:
        """Merge the classes of consecutive steps that a turn or a travel links."""
        for t, action in enumerate(self.led):
            if action is None:
                continue
            if self._stays(t):
                self.places.merge(t - 1, t)
            if (action.kind == "travel" and "travel_follows_path" in self.axioms) or (
                action.turn == "around" and "turn_around_reverses" in self.axioms
            ):
                self.courses.merge(t - 1, t)

    def _stays(self, t: int) -> bool:
        """Whether a turn led to step t, so that the robot stayed at its place."""
        action = self.led[t]
        return action is not None and action.kind == "turn" and "turn_stays" in self.axioms

    def _merge(self, first: int, second: int) -> None:
        """Record that two steps are known to be one dstate."""
        self.places.merge(first, second)
        self.courses.merge(first, second)

    def joins(self) -> tuple[Join, ...]:
        """Collect the joins, as `joins_by_minimality` says."""
        labels, found = self.map.dstate_at, list[Join]()
        at = [self.map.dstates[label].place for label in labels]
        last: dict[int, int] = {}  # the last step at each dstate
        last_at: dict[int | None, int] = {}  # the last step of the last visit to each place
        tried = set[tuple[int, str]]()  # the actions done at dstates
        entry = 0  # the first step of this visit
        steps = named_steps(drives_of(self.trace), len(self.trace))
        for t, label in zip(steps, labels, strict=False):
            entry = entry if self._stays(t) else t
            action = self.led[t]
            link = (labels[t - 1], action.name) if action else None
            if label in last:
                forced = link in tried and "deterministic" in self.axioms
                if not (forced or self._is_forced(last[label], t)):
                    elsewhere = not self.places.are_one(last[label], t)
                    found.append(Join(last[label], t, at[t] is not None and elsewhere))
                self._merge(last[label], t)
            if link:
                tried.add(link)
            last[label] = t
            if at[t] is None or (t + 1 < len(labels) and self._stays(t + 1)):
                continue
            # The visit ends. If no dstate joined it to earlier visits, its place does.
            before = last_at.get(at[t], entry)
            if not self.places.are_one(before, entry):
                found.append(Join(before, entry, at_place=True))
                self.places.merge(before, entry)
            last_at[at[t]] = t
        return tuple(sorted(found, key=lambda join: (join.second, join.first)))

    def _is_forced(self, first: int, second: int) -> bool:
        """Whether two steps at one dstate of the map are known to be one dstate."""
        if second in self.asserted:
            return True
        here = self.map.dstates[self.map.dstate_at[second]]
        if here.place is None:
            return False
        # The map has both steps at one dstate, so their headings and courses are equal in it. If
        # headings, or courses, are known relative to each other, they are equal in all maps.
        by_course = self.by_course and here.path is not None
        return self.places.are_one(first, second) and (
            self.by_heading or (by_course and self.courses.are_one(first, second))
        )
