"""Check a map against a trace and a theory, axiom by axiom, in plain Python.

>>> from ssh_abduction import Trace
>>> from ssh_abduction.checker.checker import check
>>> from ssh_abduction.data.maps import DState, SSHMap
>>> from ssh_abduction.theory.theory import Theory
>>> trace = Trace.from_steps(["a", "b"], ["travel"])
>>> merged = SSHMap((0, 0), (DState(0, "a"),), ((0, "travel", 0),))
>>> (violation,) = check(trace, merged, Theory.causal())
>>> violation.axiom, violation.steps
('functional_view', (0, 1))
>>> violation.message
"Dstate 0 looks like 'a' at step 0 and like 'b' at step 1."

The checker shares nothing with the encodings or the solver, so it catches their mistakes. The
axioms are those of docs/explanation/theory.md, after Kuipers & Beeson (AAAI 2002) and Remolina &
Kuipers (AIJ 2004). The check of an axiom is a function with its name, in `topological`, `sides`
or `evidence`. This module checks that a map fits its trace, and `sides` the regions that it
lists.

A map lists one place, one course (path and direction) and one heading for each dstate, even if the
theory leaves out the axiom that forbids several. The other axioms are checked on the listed ones.
A map also lists the order of the places along each path. It lists no sides of paths, and no travels
that lead around a ring of places. The module `sides` describes how the axioms about sides are
checked, and `reading.Order` how those about orders are.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from ssh_abduction.checker import evidence, sides, topological
from ssh_abduction.checker.buildings import building_follows_from_map
from ssh_abduction.checker.evidence import floors_are_listed
from ssh_abduction.checker.reading import Check, Found, Reading, course_of, heading_of
from ssh_abduction.checker.sides import is_pair
from ssh_abduction.checker.topological import bearing_changes, slot_changes
from ssh_abduction.data.groups import firsts
from ssh_abduction.data.maps import FAULTS, Fault, SSHMap, checked_map
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import SHORT_TURN, look_at_clock
from ssh_abduction.theory import encodings
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.theory import Theory

COHERENCE = "map_explains_trace"

# The check of an axiom is the function with the name of the axiom in one of these modules.
_MODULES = (topological, sides, evidence)
AXIOMS: dict[str, Check] = {
    axiom.name: getattr(module, axiom.name)
    for axiom in encodings.axioms()
    for module in _MODULES
    if hasattr(module, axiom.name)
}


@dataclass(frozen=True)
class Violation:
    """An axiom that a map breaks.

    Attributes:
        axiom: The name of the axiom; `map_explains_trace` if the map does not fit the trace.
        steps: The steps of the trace that show the violation, ascending. An action is shown by both
            the step at which it is done and the next one. Empty if no step is to blame.
        message: A sentence that describes the violation by the dstates, places and paths of the
            map.
    """

    axiom: str
    steps: tuple[int, ...]
    message: str


def check(trace: Trace, ssh_map: SSHMap, theory: Theory | None = None) -> tuple[Violation, ...]:
    """Find all violations of axioms by a map of a trace.

    Args:
        trace: What the robot saw and did, with views.
        ssh_map: Any map, even a malformed one.
        theory: The theory; Theory.topological() if None. Axioms in its `without` are not checked.

    Returns:
        The violations; empty if the map is right. Violations of `map_explains_trace` come first:
        the map does not fit the trace, or its numbers do not fit each other. Violations of the
        axioms follow in the order of the theory. Violations of axioms about regions come last.
        Axioms of the user's own rules are skipped (`ssh_abduction.checker.checker.unchecked`).

    Raises:
        TraceError, TheoryError: The trace lacks something that the theory needs.
        MapError: `ssh_map` is not an SSHMap.

    Reference:
        Kuipers & Beeson, AAAI 2002; Remolina & Kuipers, AIJ 2004; the axioms are in
        docs/explanation/theory.md.
    """
    theory = settle(trace, theory).theory
    return tuple(violations(trace, checked_map(ssh_map), theory))


def violations(
    trace: Trace, ssh_map: SSHMap, theory: Theory, since: int = 0
) -> Iterator[Violation]:
    """Find violations one by one, so that a caller can stop at the first one.

    The map may be malformed. In the theory no field is "auto". An earlier check found that the map
    agrees with the displacements of the first `since` steps.
    """
    reading = Reading(trace, ssh_map, theory, since)
    checks = [(COHERENCE, test) for test in COHERENT] + [
        (name, AXIOMS[name]) for name in theory.axioms if name in AXIOMS
    ]
    # Regions follow from a map and decide nothing. They are checked if the map lists them.
    checks += [*sides.REGIONS.items()] if ssh_map.regions is not None else []
    for name, test in checks:
        look_at_clock(SHORT_TURN)
        for steps, message in test(reading):
            yield Violation(name, tuple(map(reading.named, sorted(set(steps)))), message)


def unchecked(theory: Theory) -> tuple[str, ...]:
    """List what `check` skips: axioms of the user's rules, and files of rules without axioms."""
    named = tuple(name for name in theory.axioms if name not in AXIOMS)
    return named + tuple(f"the rules of {rules.name}" for rules in theory.rules if not rules.axioms)


def labels_are_dstates(m: Reading) -> Found:
    """Check that each step has a label, and that each label is the id of a dstate."""
    steps, labels = len(m.trace), len(m.map.dstate_at)
    if steps != labels:
        why = f"The map labels {labels} steps, but the trace has {steps}."
        yield [min(steps, labels)] if labels < steps else [], why
    for label, i in m.first.items():
        if label not in m.records:
            yield [i], f"Step {i} is labelled {label}, but the map has no dstate {label}."


def numbered_by_first_visit(m: Reading) -> Found:
    """Check that dstates, places and paths are numbered 0, 1, 2, … by first visit.

    Each of them must be visited. When the robot first faced along a path, it faced direction +1.
    """
    yield from _numbered(
        "dstates", [s.id for s in m.map.dstates], [(i, s.id) for i, s in m.visited]
    )
    if m.theory.level == "causal":
        return
    yield from _numbered("places", m.map.places, [(i, s.place) for i, s in m.visited])
    yield from _numbered(
        "paths", [h.id for h in m.map.theory_paths], [(i, s.path) for i, s in m.visited]
    )
    faced: set[int] = set()
    for i, s in m.visited:
        if (course := course_of(s)) and course[0] not in faced:
            faced.add(course[0])
            if course[1] != 1:
                why = f"Path {course[0]} is first faced at step {i}, in direction -1 instead of +1."
                yield [i], why


def _numbered(what: str, ids: Sequence[int], visits: Iterable[tuple[int, int | None]]) -> Found:
    """Check that ids are 0, 1, 2, … by first visit. `visits` has the id, or None, by step."""
    if list(ids) != list(range(len(ids))):
        yield [], f"The ids of the {what} are not 0, 1, 2, … in this order."
    used = {x: i for i, x in reversed(list(visits)) if x is not None}
    known = set(ids)
    for x, i in used.items():
        if x not in known:
            yield [i], f"The map uses {x} at step {i}, but does not list it among its {what}."
    for x in known - used.keys():
        yield [], f"The map lists {x} among its {what}, but no step is there."
    for number, (i, x) in enumerate(sorted((i, x) for x, i in used.items())):
        if x != number:
            yield (
                [i],
                f"The {what} are not numbered by first visit: {x} is number {number} to be "
                f"visited, at step {i}.",
            )
            return


def dstates_look_as_seen(m: Reading) -> Found:
    """Check that the view of each dstate is the first view seen there.

    Unknown views, and views that the map treats as wrong, do not count. The axiom functional_view
    covers the views of later steps.
    """
    shown = firsts((label, (view, i)) for (label, view), i in m.views.items())
    for first, s in m.visited:
        view, i = shown.get(s.id, (None, first))
        if s.view != view:
            said = (
                f"looks like {view!r} at step {i}"
                if s.id in shown
                else "is unknown or misread wherever it is visited"
            )
            yield [i], f"Dstate {s.id} has the view {s.view!r} in the map, but {said}."


def links_are_those_of_the_trace(m: Reading) -> Found:
    """Check that the map has exactly the links that its labels and the actions imply."""
    shown = set(m.map.links)
    if len(shown) < len(m.map.links):
        yield [], "The map lists a link twice."
    for link, i in m.links.items():
        if link not in shown:
            yield (i, i + 1), f"The map has no link {link}, though this is done at step {i}."
    for link in shown - m.links.keys():
        yield [], f"The map has the link {link}, but the trace never does this."


def has_what_the_theory_has(m: Reading) -> Found:
    """Check that the map has no parts that the theory does not use.

    A map may have places and paths only at the topological level, headings only with frames, and
    excuses only with boundary=defeasible.
    """
    causal = m.theory.level == "causal"
    if causal and (m.map.places or m.map.theory_paths):
        yield [], "The map has places or paths, but the theory is causal."
    for s in m.map.dstates:
        if causal and (s.place, s.path, s.direction) != (None, None, None):
            why = f"Dstate {s.id} has a place, path or direction, but the theory is causal."
            yield m.steps_of(s.id), why
        if m.theory.star not in ("frame", "gateways") and s.heading is not None:
            why = f"Dstate {s.id} has a heading, but the places of the theory have no frames."
            yield m.steps_of(s.id), why
    if m.map.excused and m.theory.boundary != "defeasible":
        yield [], "The map excuses pairs of paths, but the theory excuses none."


def excused_are_pairs_of_paths(m: Reading) -> Found:
    """Check that each excuse of the map (an exception to side_of_branch) is a pair of its paths."""
    paths = {h.id for h in m.map.theory_paths}
    for pair in m.map.excused:
        if not is_pair(pair) or not set(pair) <= paths:
            yield [], f"The map excuses {pair}, which is not a pair of its paths."


def orders_list_places_once(m: Reading) -> Found:
    """Check that the order of each path lists places of the map, each at most once.

    The axiom on_path covers whether these are the right places.
    """
    places = set(m.map.places)
    for h in m.map.theory_paths:
        if len(set(h.order)) < len(h.order):
            yield [], f"The order of path {h.id} lists a place twice."
        for p in set(h.order) - places:
            yield [], f"The order of path {h.id} lists place {p}, which the map does not have."


def frames_start_at_first_visit(m: Reading) -> Found:
    """Check that the dstate at which a place is first visited has heading 0."""
    if not {"one_heading", "gateway_heading"} & m.axioms:
        return
    for p, i in m.place_seen.items():
        s = m.states[m.map.dstate_at[i]]
        if heading := s.heading if m.theory.star == "gateways" else heading_of(s):
            why = f"Place {p} is first visited at step {i} with heading {heading} instead of 0."
            yield [i], why


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
    return bearing_changes(m) if m.theory.star == "gateways" else slot_changes(m)


def _key(fault: Fault) -> tuple[object, ...]:
    """Return a change that a map lists, in the form in which `_changes` yields it."""
    where = fault.gateway if fault.bearing is None else fault.bearing
    return fault.place, where, fault.step, fault.expected, fault.seen


def _is_allowed(m: Reading, kind: str) -> bool:
    """Tell whether the theory has a price for faults of this kind."""
    return kind in FAULTS and bool(getattr(m.theory, "misread" if kind == "misseen" else kind))


def _what_is_wrong(m: Reading, fault: Fault) -> str | None:
    """Say why a fault is not allowed or contradicts trace or map; None if nothing is wrong."""
    fault = replace(fault, step=m.named(fault.step))
    i, kind = fault.step, fault.kind
    without_stars = kind == "misseen" and m.theory.star not in ("pattern", "frame")
    if not _is_allowed(m, kind) or without_stars:
        return f"The map disbelieves step {i} ({kind}), which the theory does not allow."
    # There must be a step, and something at it that may be wrong.
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


# What a map must satisfy to fit its trace.
COHERENT: tuple[Check, ...] = (
    labels_are_dstates,
    numbered_by_first_visit,
    dstates_look_as_seen,
    faults_are_allowed,
    links_are_those_of_the_trace,
    has_what_the_theory_has,
    excused_are_pairs_of_paths,
    orders_list_places_once,
    building_follows_from_map,
    frames_start_at_first_visit,
    floors_are_listed,
)
