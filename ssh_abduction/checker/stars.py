"""Checks of the axioms about stars and headings at places with frames.

A star is the openings seen at a step: ahead, right, back and left. Slots are the directions at a
place, numbered 0 to 3 clockwise. A turn right adds 1 to the heading.

With star=gateways a place has any number of gateways. A sight is a dstate and a star seen there. A
map does not list which gateways of two sights are the same. So if no frame, a numbering of the
gateways, fits all sights of a place, the check reports a minimal set of sights that no frame fits.
If a frame would fit this set without an axiom, the set violates this axiom.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

from ssh_abduction.checker.reading import Course, Found, Reading, course_of, heading_of, opposite
from ssh_abduction.data.drives import ALONE, drives_of
from ssh_abduction.data.gateways import (
    Sight,
    Turns,
    by_place,
    changes_of,
    frames_that_fit,
    sights_of,
)
from ssh_abduction.data.map_parts import course_named
from ssh_abduction.data.maps import DState
from ssh_abduction.data.star import Openings
from ssh_abduction.data.step import QUARTERS


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


def clashes(sights: Sequence[Sight], turns: Turns, axioms: Collection[str]) -> Iterator[Clash]:
    """Yield a minimal set of sights (dstate and star) for each place where they fit no frame.

    The sights are those of a map, sorted by first step. `turns` has the turns between sights of one
    place. `axioms` has the names of the theory's axioms.
    """
    hard = [name for name in NAMES if name in axioms]
    for place, seen in by_place(sights).items():
        if frames_that_fit(seen, turns, hard) is not None:
            continue
        # drop sights, latest first, as long as no frame fits the others
        core = list(seen)
        for sight in reversed(seen):
            rest = [other for other in core if other is not sight]
            core = core if frames_that_fit(rest, turns, hard) is not None else rest
        to_blame = [
            name
            for name in hard
            if frames_that_fit(core, turns, [other for other in hard if other != name]) is not None
        ]
        yield Clash(place, tuple(sight.step for sight in core), tuple(to_blame or hard))


def _clashes_of(m: Reading) -> list[Clash]:
    """List the clashes of a map: sights of a place that fit no frame."""
    return list(clashes(*_sights_of(m), m.axioms))


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
    for clash in m.once(_clashes_of):
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
