"""Checks of the axioms about dstates and links (C1, C2), places, paths and orders (T, TOT, ADJ)."""

from __future__ import annotations

from collections import defaultdict

from ssh_abduction.checker.reading import Course, Found, Reading, course_of, going, opposite
from ssh_abduction.data.groups import reached
from ssh_abduction.data.map_parts import course_named
from ssh_abduction.data.trace import View


def functional_view(m: Reading) -> Found:
    """Check that each dstate has one view (C1)."""
    known: dict[int, tuple[View | None, int]] = {}
    for (s, view), i in m.views.items():
        first, at = known.setdefault(s, (view, i))
        if view != first:
            why = f"Dstate {s} looks like {first!r} at step {at} and like {view!r} at step {i}."
            yield (at, i), why


def deterministic(m: Reading) -> Found:
    """Check that an action done at a dstate always leads to the same dstate (C2)."""
    known: dict[tuple[int, str], tuple[int, int]] = {}
    for (source, action, target), i in m.links.items():
        first, at = known.setdefault((source, action), (target, i))
        if target != first:
            yield (
                (at, at + 1, i, i + 1),
                f"{action!r} in dstate {source} leads to dstate {first} at step {at}, and to "
                f"dstate {target} at step {i}.",
            )


def one_place(m: Reading) -> Found:
    """Check that each dstate is at one place (T1, T10)."""
    for s, records in m.records.items():
        places = {r.place for r in records}
        if None in places:
            yield m.steps_of(s), f"Dstate {s} is at no place."
        if len(places - {None}) > 1:
            yield m.steps_of(s), f"Dstate {s} is at several places."


def turn_stays(m: Reading) -> Found:
    """Check that a turn stays at its place (T2)."""
    for t in m.turns:
        if t.source.place != t.target.place:
            why = f"{t} is a turn, but leads from place {t.source.place} to place {t.target.place}."
            yield t.steps, why


def travel_leaves(m: Reading) -> Found:
    """Check that a travel leads to another place (T3)."""
    for t in m.travels:
        if t.source.place == t.target.place and t.source.place is not None:
            yield t.steps, f"{t} is a travel, but stays at place {t.source.place}."


def travel_follows_path(m: Reading) -> Found:
    """Check that a travel starts and ends along the same path in the same direction (T4)."""
    for t in m.travels:
        if course_of(t.source) is None or course_of(t.source) != course_of(t.target):
            yield (
                t.steps,
                f"{t} is a travel, but starts along {going(t.source)} and ends along "
                f"{going(t.target)}.",
            )


def one_course(m: Reading) -> Found:
    """Check that each dstate is along at most one path, in one direction (T5, T10)."""
    for s, records in m.records.items():
        if len({(r.path, r.direction) for r in records}) > 1:
            yield m.steps_of(s), f"Dstate {s} is along several paths or directions."
        for r in records:
            if (r.path, r.direction) != (None, None) and course_of(r) is None:
                yield (
                    m.steps_of(s),
                    f"Dstate {s} has path {r.path} and direction {r.direction}, which is not one "
                    "path in one direction.",
                )


def turn_around_reverses(m: Reading) -> Found:
    """Check that a turn around keeps the path and reverses the direction (T6)."""
    for t in m.turns:
        course, other = course_of(t.source), course_of(t.target)
        if t.action.turn == "around" and other != (course and opposite(course)):
            why = f"{t} is a turn around, but leads from {going(t.source)} to {going(t.target)}."
            yield t.steps, why


def turn_changes_path(m: Reading) -> Found:
    """Check that a turn right or left leads from one path to another (T7)."""
    for t in m.turns:
        course, other = course_of(t.source), course_of(t.target)
        if t.action.turn in ("right", "left") and course and other and course[0] == other[0]:
            why = f"{t} is a turn {t.action.turn}, but both dstates are along path {course[0]}."
            yield t.steps, why


def one_dstate_per_course(m: Reading) -> Found:
    """Check that at most one dstate of a place is along a path in a given direction (T8)."""
    known: dict[tuple[int, Course], int] = {}
    for s in m.states.values():
        if s.place is not None and (course := course_of(s)):
            first = known.setdefault((s.place, course), s.id)
            if first != s.id:
                yield (
                    m.steps_of(first, s.id),
                    f"Dstates {first} and {s.id} are both at place {s.place} along "
                    f"{course_named(course)}.",
                )


def on_path(m: Reading) -> Found:
    """Check that a path lists exactly the places with a dstate along the path (T11)."""
    for h, order in m.orders.items():
        there = m.along.get(h, {})
        for p in set(order.listed) - there.keys():
            yield m.steps_at(p), f"Path {h} lists place {p}, but no dstate there is along the path."
        for p in there.keys() - set(order.listed):
            yield (
                m.steps_of(there[p]),
                f"Dstate {there[p]} at place {p} is along path {h}, but the path does not list "
                "the place.",
            )


def travel_orders(m: Reading) -> Found:
    """Check that each path lists the place that a travel leaves before the place it reaches (T9).

    "Before" is in the direction of the travel.
    """
    for h, order in m.orders.items():
        for p, q in order.backward if order.can_be_listed else ():
            if {p, q} <= order.position.keys():
                t = order.travels[p, q]
                yield (
                    t.steps,
                    f"Path {h} lists place {q} before place {p}, but {t} along {going(t.source)} "
                    "says the reverse.",
                )


def order_asymmetric(m: Reading) -> Found:
    """Check that no two places of a path come before each other (T9)."""
    for h, order in m.orders.items():
        for ring in order.rings:
            if not order.allows(ring):
                yield (
                    order.ring_steps(ring),
                    f"On path {h} the travels make places {ring[0]} and {ring[-1]} come before "
                    "each other.",
                )


def order_transitive(m: Reading) -> Found:
    """Check that p comes before r on a path if p comes before q and q before r (T9)."""
    for h, order in m.orders.items():
        for ring in order.rings:
            if not order.allows(ring) and len(ring) > 2:
                way = ", ".join(map(str, ring))
                yield (
                    order.ring_steps(ring),
                    f"On path {h} the travels lead through places {way}, but the last comes "
                    "before the first.",
                )


def path_order_total(m: Reading) -> Found:
    """Check that of any two places on a path, one comes before the other (TOT)."""
    for h, order in m.orders.items():
        places = m.on(h)
        for p in sorted(places - order.position.keys(), key=str):
            if apart := places - {p, *order.after(p, 1), *order.after(p, -1)}:
                q = min(apart, key=str)
                why = f"Places {p} and {q} are on path {h}, but neither comes before the other."
                yield [*m.steps_at(p), *m.steps_at(q)], why
                break


def next_place(m: Reading) -> Found:
    """Check that a travel leads to the next place of the path: none lies between (ADJ)."""
    for t, (h, direction), p, q in m.along_travels:
        if h in m.orders and (between := m.orders[h].between(p, q, direction)):
            r = min(between, key=str)
            yield (
                [*t.steps, *m.steps_at(r)],
                f"{t} leads from place {p} to place {q}, but place {r} lies between them on path "
                f"{h}.",
            )


def all_on_paths(m: Reading) -> Found:
    """Check that every dstate is along a path (T5tot)."""
    for s in m.states.values():
        if course_of(s) is None:
            yield m.steps_of(s.id), f"Dstate {s.id} is along no path."


def course_needs_travel(m: Reading) -> Found:
    """Check that each dstate along a path is at an end of a travel (T5).

    It may instead be linked by turns around to such a dstate.
    """
    linked: dict[int, list[int]] = defaultdict(list)
    for t in m.turns:
        if t.action.turn == "around":
            linked[t.source.id].append(t.target.id)
            linked[t.target.id].append(t.source.id)
    ends = (s.id for t in m.travels for s in (t.source, t.target))
    supported = reached(ends, linked.__getitem__)
    for s in m.states.values():
        if course_of(s) and s.id not in supported:
            yield (
                m.steps_of(s.id),
                f"Dstate {s.id} is along {going(s)}, but no travel starts or ends at it, nor at "
                "the dstate after a turn around.",
            )


def path_places(m: Reading) -> Found:
    """Check that no path has more places than the field path_places allows."""
    most = m.theory.declared["path_places"]
    for h in m.orders:
        if len(places := m.on(h)) > most:
            steps = [step for p in places for step in m.steps_at(p)]
            yield steps, f"Path {h} has {len(places)} places, but {most} are allowed."
