"""Obey the names and corrections of a person (`data/corrections.py`)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace

from ssh_abduction.data.corrections import Corrections, Passage, checked_corrections
from ssh_abduction.data.drives import (
    SEEN,
    Drive,
    drives_of,
    fingerprints_of,
    joined_drives,
    step_name,
    step_of,
)
from ssh_abduction.data.errors import named
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.star import parse_star, with_gateway
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

    def named(maps: Iterable[SSHMap]) -> tuple[SSHMap, ...]:
        return tuple(corrections.named(ssh_map, drives) for ssh_map in maps)

    return replace(solution, maps=named(solution.maps))


def with_kept_apart(
    corrections: Corrections,
    solution: Solution,
    limit: float | None,
    find: Callable[[Trace, Theory, float], Solution],
) -> Solution:
    """Add warnings about drives that share no place with others as a gateway was corrected.

    A correction changes only the stars of the steps that it names. If another drive saw the gateway
    as it was before, its steps cannot be at the place any more.

    Args:
        corrections: The corrections that the solution obeys.
        solution: The solution, with its trace.
        limit: The time limit of the search in seconds; None for none.
        find: Finds a map of a trace and a theory in some seconds. It is called once, without
            corrections of gateways, if some drive is apart.
    """
    uses_stars = corrections.gateways and solution.theory.star != "none"
    if not uses_stars or solution.stopped == "interrupted":
        return solution
    left = DOUBTING if limit is None else min(limit - solution.seconds.total, DOUBTING)
    said = _drives_kept_apart(
        corrections, solution, lambda trace, theory: find(trace, theory, max(left, SHORTEST))
    )
    return replace(solution, support=replace(solution.support, kept_apart=tuple(said)))


def _drives_kept_apart(
    corrections: Corrections, solution: Solution, find: Callable[[Trace, Theory], Solution]
) -> Iterator[str]:
    """Yield the warnings that `with_kept_apart` adds."""
    trace = solution.trace
    if trace is None or not solution.maps:
        return
    drives = drives_of(trace)
    said = corrections.known_in(drives)
    apart = [(p, d) for p in said.gateways for d in _apart(p, drives, solution.maps[0])]
    if not apart:
        return
    seen = _as_seen(trace)
    found = find(*obeyed(replace(said, gateways=()), seen, solution.theory))
    for passage, drive in apart:
        sentence = f"{named(said.source or 'corrections')}: {passage}: "
        if found.maps and drive not in _apart(passage, drives, found.maps[0]):
            if step := _seen_otherwise(passage, drive, seen, found.maps[0]):
                yield (
                    f"{sentence}it contradicts what {drive.name} saw at step {step}: without it, "
                    f"{drive.name} would share places with the other drives; say the same of "
                    f"{step} (correct), or remove it"
                )
        elif found.status is not Status.OPTIMAL:
            yield (
                f"{sentence}{drive.name} shares no place with the drives that it is about; if "
                f"{drive.name} saw this gateway otherwise, say the same of its steps (correct)"
            )


def _apart(passage: Passage, drives: Sequence[Drive], ssh_map: SSHMap) -> list[Drive]:
    """List the drives that a map does not join with the drives of a corrected gateway."""
    about = {step.rpartition(":")[0] for step, _ in passage.seen}
    joined = {
        name for names in joined_drives(drives, ssh_map) if about & {*names} for name in names
    }
    return [drive for drive in drives if drive.name not in joined]


def _as_seen(trace: Trace) -> Trace:
    """Return a trace with the stars that the robot saw, before they were corrected."""
    steps = [
        replace(
            step,
            star=parse_star(step.extra[SEEN], SEEN),
            extra={name: value for name, value in step.extra.items() if name != SEEN},
        )
        if SEEN in step.extra
        else step
        for step in trace.steps
    ]
    return replace(trace, steps=tuple(steps))


def _seen_otherwise(passage: Passage, drive: Drive, trace: Trace, ssh_map: SSHMap) -> str | None:
    """Find the first step of a drive, at a corrected dstate, that saw the gateway otherwise."""
    drives = drives_of(trace)
    way_at = {ssh_map.dstate_at[step_of(drives, step)]: way for step, way in passage.seen}
    for t in range(drive.first, drive.stop):
        way, star = way_at.get(ssh_map.dstate_at[t]), trace.steps[t].star
        if way is None or star is None:
            continue
        if with_gateway(star, way, is_open=passage.is_open) != star:
            return step_name(drives, t)
    return None
