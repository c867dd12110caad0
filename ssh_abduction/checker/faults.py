"""Check the faults of a map: steps whose view, star, action or displacement it treats as wrong."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from ssh_abduction.checker import clashes
from ssh_abduction.checker.reading import Found, Reading
from ssh_abduction.checker.stars import changes
from ssh_abduction.data.maps import Fault


def faults_are_allowed(m: Reading) -> Found:
    """Check that the theory allows each fault of the map, and that the map lists it correctly.

    A fault must be listed once, with the view or action that the trace has at its step, and with
    the cost that the theory sets. If gateways may change, all changes must be listed.
    """
    steps, named = m.trace.steps, set[tuple[object, ...]]()
    for fault in m.map.faults:
        i, kind = m.named(fault.step), fault.kind
        if what := _what_is_wrong(m, fault):
            yield [i] if 0 <= i < len(steps) else [], what
        elif (kind, i, fault.gateway, fault.bearing) in named:
            yield [i], f"The map names the fault of step {i} ({kind}) twice."
        if _is_allowed(m, kind) and 0 <= i < len(steps):
            price = m.theory.fault_tenths(kind, steps[i])
            if round(10 * fault.cost) != price:
                yield (
                    [i],
                    f"The fault of step {i} ({kind}) costs {fault.cost:g} dstates in the map, and "
                    f"{price / 10:g} by the theory.",
                )
        named.add((kind, i, fault.gateway, fault.bearing))
    if m.theory.changed:
        listed = {_key(f) for f in m.map.faults}
        for change in _changes(m):
            if change not in listed:
                p, slot, i, was, now = change
                way = f"{slot} degrees" if m.theory.star == "gateways" else f"slot {slot}"
                said = f"The gateway at {way} of place {p} was {was} and {now}: the map hides it."
                yield [i], said


def _changes(m: Reading) -> Iterator[tuple[int, int, int, str, str]]:
    """Yield the gateways that differ between drives."""
    return clashes.changes(m) if m.theory.star == "gateways" else changes(m)


def _key(fault: Fault) -> tuple[object, ...]:
    """Return the values of a change that a map lists."""
    where = fault.gateway if fault.bearing is None else fault.bearing
    return fault.place, where, fault.step, fault.expected, fault.seen


def _is_allowed(m: Reading, kind: str) -> bool:
    """Tell whether the theory has a price for faults of this kind."""
    prices = {
        "misread": m.theory.misread,
        "misseen": m.theory.misread,
        "slipped": m.theory.slipped,
        "jumped": m.theory.jumped,
        "changed": m.theory.changed,
    }
    return bool(prices.get(kind))


def _what_is_wrong(m: Reading, fault: Fault) -> str | None:
    """Describe in a sentence why a fault is not allowed or contradicts the trace or the map.

    Returns:
        The sentence; None if nothing is wrong.
    """
    fault = replace(fault, step=m.named(fault.step))
    i, kind = fault.step, fault.kind
    without_stars = kind == "misseen" and m.theory.star not in ("pattern", "frame")
    if not _is_allowed(m, kind) or without_stars:
        return f"The map disbelieves step {i} ({kind}), which the theory does not allow."
    step = m.trace.steps[i] if 0 <= i < min(len(m.trace), len(m.map.dstate_at)) else None
    if (
        step is None
        or (kind == "misread" and step.view is None)
        or (kind == "slipped" and (step.action is None or step.action.kind == "start"))
        or (kind == "jumped" and step.displacement is None)
    ):
        return f"The map disbelieves step {i} ({kind}), where there is nothing to disbelieve."
    if kind == "misread":
        s, seen = m.states.get(m.map.dstate_at[i]), step.view
        if fault.seen != seen or (s and fault.expected != s.view) or seen == fault.expected:
            return (
                f"The map says that {fault}, but the trace has {seen!r} there, and the dstate "
                f"{s.view if s else None!r}."
            )
    if kind == "changed":
        return (
            None
            if _key(fault) in list(_changes(m))
            else f"The map says that {fault}, but no drives show it."
        )
    if kind == "slipped" and step.action and fault.seen != step.action.name:
        return f"The map says that {fault}, but the trace has another action there."
    return None
