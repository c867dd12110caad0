"""Obey the names and corrections of a person (`data/corrections.py`)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from statistics import median

from ssh_abduction.data.corrections import (
    Corrections,
    Passage,
    checked_corrections,
    direction_in_words,
    number_at,
)
from ssh_abduction.data.drives import (
    Drive,
    drives_of,
    fingerprints_of,
    joined_drives,
    step_name,
    step_of,
    travels_of,
)
from ssh_abduction.data.errors import brief, named
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.star import with_gateway
from ssh_abduction.data.step import Step
from ssh_abduction.data.trace import Trace, checked_trace
from ssh_abduction.solver.solution.result import Solution
from ssh_abduction.solver.values import Status
from ssh_abduction.theory.theory import Theory, checked_theory

# A search for a map without corrections of gateways may take this many seconds.
SHORTEST, DOUBTING = 0.05, 10.0


def obeyed(corrections: Corrections, trace: Trace, theory: Theory) -> tuple[Trace, Theory]:
    """Return the trace and the theory that obey the corrections of a person.

    Pairs of steps are added to the fields same, different, elsewhere and same_place of the theory.
    Sentences about gateways that are open or closed change the stars of their steps.

    Args:
        corrections: The corrections. Sentences about drives that the trace lacks have no effect.
        trace: The trace of the drives that the corrections are about.
        theory: The theory to which the pairs of steps are added.

    Raises:
        MapError: The corrections are of other drives, or contradict the trace.
    """
    checked_corrections(corrections).check_drives(dict(fingerprints_of(checked_trace(trace))))
    said = corrections.assertions(trace)
    pairs = {
        kind: tuple(dict.fromkeys((*getattr(checked_theory(theory), kind), *found)))
        for kind, found in said.items()
    }
    return corrections.corrected(trace), theory.replace(**pairs)


def with_names(corrections: Corrections, solution: Solution, trace: Trace) -> Solution:
    """Return a solution whose maps have the names that a person gave."""
    drives = drives_of(trace)
    maps = tuple(corrections.named(ssh_map, drives) for ssh_map in solution.maps)
    return replace(solution, maps=maps)


def with_correction_warnings(
    corrections: Corrections,
    solution: Solution,
    left: float,
    find: Callable[[Trace, Theory, float], Solution],
) -> Solution:
    """Add warnings about drives that contradict a corrected gateway, and about unused names.

    A correction changes only the stars of the steps that it names. If another drive saw the gateway
    as it was before, its steps cannot be at the place any more. Without stars, they can be there.

    Args:
        corrections: The corrections that the solution obeys.
        solution: The solution, with its trace.
        left: The seconds, or units of work, that are left; infinity without a limit.
        find: Finds a map of a trace and a theory in that much time. It is called once, without
            corrections of gateways, if the correction may keep a drive from the place.
    """
    said = [*_unused_names(corrections, solution)]
    if corrections.gateways and solution.stopped != "interrupted":
        most = max(min(left, DOUBTING), SHORTEST)
        said += _contradictions(
            corrections, solution, lambda trace, theory: find(trace, theory, most)
        )
    return replace(solution, support=replace(solution.support, correction_warnings=tuple(said)))


def _unused_names(corrections: Corrections, solution: Solution) -> Iterator[str]:
    """Yield a warning for each name that the first map does not have."""
    if not solution.maps or solution.trace is None:
        return
    drives = drives_of(solution.trace)
    ssh_map = corrections.named(solution.maps[0], drives)
    for naming in corrections.known_in(drives).names:
        label = ssh_map.dstate_at[step_of(drives, naming.step)]
        used = ssh_map.name_of(naming.kind, number_at(ssh_map, naming.kind, label))
        if used != naming.name:
            why = (
                f"this step has no {naming.kind}; name another step"
                if used is None
                else f"this {naming.kind} is also {brief(used)}; rename or remove one of them"
            )
            yield (
                f"{named(corrections.source or 'corrections')}: {naming}: it is not shown: in the "
                f"first map, {why}"
            )


def _contradictions(
    corrections: Corrections, solution: Solution, find: Callable[[Trace, Theory], Solution]
) -> Iterator[str]:
    """Yield the warnings that `with_correction_warnings` adds."""
    trace = solution.trace
    if trace is None or not solution.maps:
        return
    drives, ssh_map = drives_of(trace), solution.maps[0]
    said, found = corrections.known_in(drives), solution
    unit = 90 if solution.theory.star == "frame" else 1
    doubted = [(p, d) for p in said.gateways for d in drives]
    # With stars, solve again without the corrections of gateways, to see what they prevent.
    if solution.theory.star != "none":
        seen = replace(trace, steps=tuple(step.as_seen() for step in trace.steps))
        doubted = [(p, d) for p, d in doubted if _may_keep_out(p, d, seen, ssh_map)]
        if not doubted:
            return
        found = find(*obeyed(replace(said, gateways=()), seen, solution.theory))
    for passage, drive in doubted:
        apart = drive in _apart(passage, drives, ssh_map)
        sentence = f"{named(said.source or 'corrections')}: {passage}: "
        steps = _seen_otherwise(passage, drive, trace, found, unit)
        if steps:
            shared = "places" if apart else "this place"
            without = f": without it, {drive.name} would share {shared} with the other drives"
            yield (
                f"{sentence}it contradicts what {drive.name} saw at "
                f"{'step' if len(steps) == 1 else 'steps'} {', '.join(steps)}"
                f"{without if found is not solution else ''}; {_how_to_agree(passage, steps)}"
            )
        elif apart and _is_in_doubt(found, solution, passage, drive):
            yield (
                f"{sentence}{drive.name} shares no place with the drives that it is about; if "
                f"{drive.name} saw this gateway otherwise, say the same of its steps (correct)"
            )


def _is_in_doubt(found: Solution, solution: Solution, passage: Passage, drive: Drive) -> bool:
    """Whether an unproven map without a correction leaves a drive apart, as the solution does."""
    if found is solution or found.status is Status.OPTIMAL:
        return False
    return not found.maps or drive in _apart(passage, found.drives, found.maps[0])


def _how_to_agree(passage: Passage, steps: Mapping[str, float]) -> str:
    """Say what to do about steps that saw a gateway otherwise, each with its direction."""
    step, way = next(iter(steps.items()))
    option = "--open" if passage.is_open else "--closed"
    return (
        f"say the same of {step} (correct {option} '{step} {direction_in_words(way)}'), or "
        "remove it"
    )


def _apart(passage: Passage, drives: Sequence[Drive], ssh_map: SSHMap) -> list[Drive]:
    """List the drives that a map does not join with the drives of a corrected gateway."""
    about = {step.rpartition(":")[0] for step, _ in passage.seen}
    joined = {
        name for names in joined_drives(drives, ssh_map) if about & {*names} for name in names
    }
    return [drive for drive in drives if drive.name not in joined]


def _may_keep_out(passage: Passage, drive: Drive, seen: Trace, ssh_map: SSHMap) -> bool:
    """Whether a corrected gateway may keep a drive out of its place.

    The drive shares no place with the drives of the correction; or it was not at the place, but saw
    nearby as many gateways as the robot saw there before the correction. `seen` is the trace as it
    was before.
    """
    drives = drives_of(seen)
    if drive in _apart(passage, drives, ssh_map):
        return True
    there = [step_of(drives, step) for step, _ in passage.seen]
    places = {ssh_map.place_of(t) for t in there}
    steps = range(drive.first, drive.stop)
    if any(ssh_map.place_of(t) in places for t in steps):
        return False
    poses = ssh_map.fit.poses if ssh_map.fit else ()
    near = median(travels_of(seen) or [0.0]) / 2
    counts = [step.gateways and len(step.gateways.gateways) for step in seen.steps]

    def is_near(t: int, u: int) -> bool:
        here, other = (poses[ssh_map.dstate_at[step]] for step in (t, u))
        return math.hypot(here.x - other.x, here.y - other.y) < near

    return any(
        counts[t] == counts[u] and (not poses or is_near(t, u)) for t in steps for u in there
    )


def _seen_otherwise(
    passage: Passage, drive: Drive, trace: Trace, found: Solution, unit: int
) -> dict[str, float]:
    """Find the steps of a drive that saw a corrected gateway otherwise, by the best map found.

    Each has the direction of the gateway. `unit` is the unit of the map's headings, in degrees.
    """
    if not found.maps:
        return {}
    drives, ssh_map = drives_of(trace), found.maps[0]
    ways = {ssh_map.dstate_at[step_of(drives, step)]: way for step, way in passage.seen}
    for label, way in [*ways.items()]:
        here = ssh_map.dstates[label]
        for s in ssh_map.dstates:
            if s.place == here.place and s.heading is not None and here.heading is not None:
                ways.setdefault(s.id, (way + unit * (here.heading - s.heading)) % 360)
    return {
        step_name(drives, t): ways[label]
        for t, label in enumerate(ssh_map.dstate_at[: drive.stop])
        if t >= drive.first and label in ways and _contradicts(passage, trace.steps[t], ways[label])
    }


def _contradicts(passage: Passage, step: Step, way: float) -> bool:
    """Whether a step saw a gateway, in a direction, otherwise than a person says."""
    star = step.star
    return star is not None and with_gateway(star, way, is_open=passage.is_open) != star
