"""Checks of the axioms about stars and headings at places with four slots.

A star is the openings seen at a step: ahead, right, back and left. Slots are the directions at a
place, numbered 0 to 3 clockwise. A turn right adds 1 to the heading.
"""

from __future__ import annotations

from collections.abc import Iterator

from ssh_abduction.checker.moves import Course, course_of, heading_of, opposite
from ssh_abduction.checker.reading import Found, Reading
from ssh_abduction.data.action import QUARTERS
from ssh_abduction.data.drives import ALONE
from ssh_abduction.data.map_parts import course_named
from ssh_abduction.data.maps import DState
from ssh_abduction.data.star import Openings


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
