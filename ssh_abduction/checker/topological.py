"""Checks of the axioms about dstates and links (C1, C2), places, paths and orders (T, TOT, ADJ).

The axioms about stars and headings at places with frames follow. A star is the openings seen at a
step: ahead, right, back and left. Slots are the directions at a place, numbered 0 to 3 clockwise. A
turn right adds 1 to the heading.

With star=gateways a place has any number of gateways. A sight is a dstate and a star seen there. A
map does not list which gateways of two sights are the same. So if no frame, a numbering of the
gateways, fits all sights of a place, the check reports a minimal set of sights that no frame fits.
If a frame would fit this set without an axiom, the set violates this axiom.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

from ssh_abduction.checker.reading import (
    Course,
    Found,
    Reading,
    course_of,
    going,
    heading_of,
    opposite,
)
from ssh_abduction.data.drives import ALONE, drives_of
from ssh_abduction.data.gateways import (
    Sight,
    Turns,
    by_place,
    changes_of,
    frames_that_fit,
    sights_of,
)
from ssh_abduction.data.groups import reached
from ssh_abduction.data.map_parts import course_named
from ssh_abduction.data.maps import DState
from ssh_abduction.data.star import Openings
from ssh_abduction.data.step import QUARTERS
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


def star_pattern(m: Reading) -> Found:
    """Check that all stars seen at a place are rotations of one star.

    If gateways may change between drives, this holds within each drive.
    """
    yield from _one_star(m, "however turned", any_turn=True)


def star_frame(m: Reading) -> Found:
    """Check that the stars seen at a place agree after each star is turned by the heading.

    If gateways may change between drives, this holds within each drive.
    """
    yield from _one_star(m, "turned by their headings", any_turn=False)


def _one_star(m: Reading, how: str, *, any_turn: bool) -> Found:
    """Check that the stars at each place are equal: turned by headings, or by `any_turn`."""
    if m.theory.changed:
        seen = [
            ((p, drive), star, i) for p, drive, sights in gateways_by_drive(m) for star, i in sights
        ]
    else:
        seen = [
            ((s.place, ""), _rotated(star, heading_of(s) or 0), i)
            for s, star, i in stars_of(m)
            if s.place is not None and (any_turn or heading_of(s) is not None)
        ]
    known: dict[tuple[int, str], tuple[Openings, int]] = {}
    for there, framed, i in seen:
        star = min(_rotated(framed, k) for k in range(4)) if any_turn else framed
        first, at = known.setdefault(there, (star, i))
        if star != first:
            why = f"The stars seen at place {there[0]} at steps {at} and {i} differ, {how}."
            yield (at, i), why


def gateways_by_drive(m: Reading) -> Iterator[tuple[int, str, list[tuple[Openings, int]]]]:
    """Yield what each drive saw at each place: the place, the name of the drive, and the sights.

    They are sorted by place, then by time. A sight is a pair: the openings, turned into slots of
    the place, and the step.
    """
    seen: dict[tuple[int, int], list[tuple[Openings, int]]] = {}
    names = [m.trace.drive or m.trace.name or ALONE]
    for i, label, step in zip(m.steps, m.map.dstate_at, m.trace.steps, strict=False):
        s = m.states.get(label)
        if s and s.place is not None and step.openings and (k := heading_of(s)) is not None:
            seen.setdefault((s.place, len(names)), []).append((_rotated(step.openings, k), i))
        if step.action and step.action.kind == "start":
            names.append(step.action.name)
    for (place, drive), found in sorted(seen.items()):
        yield place, names[drive - 1], found


def slot_changes(m: Reading) -> Iterator[tuple[int, int, int, str, str]]:
    """Yield the gateways that differ between a drive and the drive before it at the same place.

    Each has the place, the slot, the first step of the later drive there, and what the earlier
    and the later drive saw, in words.
    """
    last: dict[int, tuple[str, Openings]] = {}
    for p, name, seen in gateways_by_drive(m):
        star, i = seen[0]
        before, known = last.get(p, (name, star))
        for slot in range(4):
            if star[slot] != known[slot]:
                said = [
                    f"{'open' if is_open else 'closed'} on {drive}"
                    for drive, is_open in ((before, known[slot]), (name, star[slot]))
                ]
                yield p, slot, i, said[0], said[1]
        last[p] = name, star


def stars_of(m: Reading) -> Iterator[tuple[DState, Openings, int]]:
    """Yield each dstate with each star seen there, and the first step that sees this star."""
    return ((m.states[s], star, i) for (s, star), i in m.stars.items() if s in m.states)


def _rotated(star: Openings, quarters: int) -> Openings:
    """Rotate a star into the frame of its place, for a robot that faces slot `quarters`."""
    ahead, right, back, left = (star[(slot - quarters) % 4] for slot in range(4))
    return ahead, right, back, left


def one_heading(m: Reading) -> Found:
    """Check that each dstate has one heading: a slot (direction of its place) from 0 to 3."""
    for s, records in m.records.items():
        if len({r.heading for r in records}) > 1:
            yield m.steps_of(s), f"Dstate {s} has several headings."
        for r in records:
            if heading_of(r) is None:
                why = f"Dstate {s} has the heading {r.heading}, which is none of the slots 0 to 3."
                yield m.steps_of(s), why


def turn_rotates(m: Reading) -> Found:
    """Check that a turn right, around or left adds 1, 2 or 3 to the heading, modulo 4."""
    for t in m.turns:
        before, after = heading_of(t.source), heading_of(t.target)
        if (
            before is None
            or after is None
            or t.action.turn is None
            or t.source.place != t.target.place
        ):
            # two places have two frames, and turn_stays reports a turn between places
            continue
        if (before + QUARTERS[t.action.turn]) % 4 != after:
            yield (
                t.steps,
                f"{t} is a turn {t.action.turn}, but leads from heading {before} to heading "
                f"{after}.",
            )


def one_dstate_per_heading(m: Reading) -> Found:
    """Check that at most one dstate faces each slot (direction) of a place."""
    known: dict[tuple[int, int], int] = {}
    for s in m.states.values():
        heading = heading_of(s)
        if s.place is not None and heading is not None:
            first = known.setdefault((s.place, heading), s.id)
            if first != s.id:
                why = f"Dstates {first} and {s.id} both face slot {heading} of place {s.place}."
                yield m.steps_of(first, s.id), why


def path_goes_straight(m: Reading) -> Found:
    """Check that a path leaves a place through opposite slots (directions), each of one path."""
    slots: dict[tuple[int, int], tuple[Course, int]] = {}
    ways: dict[tuple[int, Course], tuple[int, int]] = {}
    for s in m.states.values():
        heading, course, p = heading_of(s), course_of(s), s.place
        if heading is None or course is None or p is None:
            continue
        for slot, way in ((heading, course), ((heading + 2) % 4, opposite(course))):
            other, a = slots.setdefault((p, slot), (way, s.id))
            if other != way:
                yield (
                    m.steps_of(a, s.id),
                    f"By dstates {a} and {s.id}, both {course_named(other)} and "
                    f"{course_named(way)} leave place {p} through slot {slot}.",
                )
            through, b = ways.setdefault((p, way), (slot, s.id))
            if through != slot:
                yield (
                    m.steps_of(b, s.id),
                    f"By dstates {b} and {s.id}, {course_named(way)} leaves place {p} through "
                    f"both slots {through} and {slot}.",
                )


NAMES = (
    "gateway_frame",
    "gateway_heading",
    "gateway_turn",
    "gateway_dstate",
    "gateway_path",
    "gateway_end",
)


@dataclass(frozen=True)
class Clash:
    """A minimal set of sights (dstate and star) of a place that no frame of the place fits.

    Attributes:
        place: The place.
        steps: The first step of each sight.
        axioms: The axioms that forbid the set. Leaving out any one of them lets a frame fit. If
            there is no such axiom, these are all axioms of the theory about gateways.
    """

    place: int
    steps: tuple[int, ...]
    axioms: tuple[str, ...]


def _clashes(m: Reading) -> list[Clash]:
    """List a minimal set of sights for each place where they fit no frame."""
    sights, turns = _sights_of(m)
    hard = [name for name in NAMES if name in m.axioms]

    def clash(axioms: Sequence[str], some: Sequence[Sight]) -> bool:
        return frames_that_fit(some, turns, axioms) is None

    found = []
    for place, seen in by_place(sights).items():
        if not clash(hard, seen):
            continue
        # drop sights, latest first, as long as no frame fits the others
        core = list(seen)
        for sight in reversed(seen):
            rest = [other for other in core if other is not sight]
            core = rest if clash(hard, rest) else core
        to_blame = [name for name in hard if not clash([n for n in hard if n != name], core)]
        steps = tuple(sight.step for sight in core)
        found.append(Clash(place, steps, tuple(to_blame or hard)))
    return found


def _sights_of(m: Reading) -> tuple[list[Sight], Turns]:
    """Return the sights of a map, for each drive if gateways may change; and the turns."""
    return sights_of(m.trace, m.map, m.onward, bool(m.theory.changed))


def bearing_changes(m: Reading) -> Iterator[tuple[int, int, int, str, str]]:
    """Yield the gateways that differ between a drive and the drive before it at the same place.

    Each has the place, the bearing, the first step of the later drive there, and what the earlier
    and the later drive saw, in words.
    """
    names = [drive.name for drive in drives_of(m.trace)]
    for found in changes_of(*_sights_of(m), m.axioms):
        was, now = (names[drive] for drive in found.drives)
        is_open, was_open = (("closed", "open"), ("open", "closed"))[found.is_open]
        seen = f"{was_open} on {was}", f"{is_open} on {now}"
        yield found.place, found.bearing, found.step, *seen


def _gateways(name: str, m: Reading) -> Found:
    """Check the axiom `name` about places with any number of gateways."""
    for clash in m.once(_clashes):
        if name not in clash.axioms:
            continue
        steps = ", ".join(str(m.steps[t]) for t in clash.steps)
        if clash.axioms == ("gateway_end",):
            yield (
                clash.steps,
                f"The path goes on from place {clash.place}, but at steps {steps} no gateway is "
                "seen that leads on.",
            )
        else:
            yield (
                clash.steps,
                f"Steps {steps} cannot all be at place {clash.place}: in no rotation do the "
                "gateways seen there agree.",
            )


gateway_frame = partial(_gateways, "gateway_frame")
gateway_heading = partial(_gateways, "gateway_heading")
gateway_turn = partial(_gateways, "gateway_turn")
gateway_dstate = partial(_gateways, "gateway_dstate")
gateway_path = partial(_gateways, "gateway_path")
gateway_end = partial(_gateways, "gateway_end")
