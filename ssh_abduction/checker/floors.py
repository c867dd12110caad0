"""Check that lifts lead to other floors, and that a map lists its floors correctly."""

from __future__ import annotations

from ssh_abduction.checker.reading import Found, Reading
from ssh_abduction.data.groups import parts

_LIFTS = ("lift", "stairs")


def floors_of(m: Reading) -> dict[int, int]:
    """For each dstate, find the first dstate on its floor.

    The dstates of a floor are connected by common places, and by links that are not lifts.
    """
    beside: dict[int, set[int]] = {s: set() for s in m.states}
    pairs = [(t.source.id, t.target.id) for t in m.moves if t.action.kind not in _LIFTS]
    for s in m.states.values():
        pairs += [
            (s.id, x.id) for x in m.states.values() if s.place is not None and s.place == x.place
        ]
    for one, other in pairs:
        beside[one].add(other)
        beside[other].add(one)
    in_order = sorted(beside, key=lambda label: m.first.get(label, len(m.trace)))
    floors = parts(in_order, beside.__getitem__)
    return {label: next(iter(floor)) for floor in floors for label in floor}


def other_floor(m: Reading) -> Found:
    """Check that the two ends of a lift are on different floors."""
    floor = m.once(floors_of)
    for t in m.moves:
        if t.action.kind in _LIFTS and floor[t.source.id] == floor[t.target.id]:
            yield (
                t.steps,
                f"{t} leads to another floor, but other links or places join both dstates.",
            )


def path_on_one_floor(m: Reading) -> Found:
    """Check that each path is on one floor."""
    floor = m.once(floors_of)
    for h, there in m.along.items():
        first, *others = there.values()
        for s in others:
            if floor[s] != floor[first]:
                yield (
                    m.steps_of(first, s),
                    f"Dstates {first} and {s} are along path {h}, but on different floors.",
                )
                break


def floors_are_listed(m: Reading) -> Found:
    """Check that a map lists the floors of all dstates, numbered by first visit, or of none."""
    listed = {s.id: s.floor for s in m.map.dstates}
    if not m.theory.lifts:
        if any(floor is not None for floor in listed.values()):
            yield [], "The map lists floors, but the trace has no lifts."
        return
    if all(floor is None for floor in listed.values()):
        return
    number: dict[int, int] = {}
    for i, s in m.visited:
        floor = number.setdefault(m.once(floors_of)[s.id], len(number))
        if listed.get(s.id) != floor:
            yield (
                [i],
                f"Dstate {s.id} is on floor {listed.get(s.id)} in the map, but its links and "
                f"places say floor {floor}.",
            )
