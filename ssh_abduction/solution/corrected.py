"""Obey the names and corrections of a person: in the trace, in the theory and in the answer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

from ssh_abduction.data.corrections import Corrections, checked_corrections, direction_in_words
from ssh_abduction.data.drives import Drive, drives_of, fingerprints_of, step_name, step_of
from ssh_abduction.data.errors import brief, named
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.parts_of_dstates import number_at
from ssh_abduction.data.star import with_gateway
from ssh_abduction.data.step import Step
from ssh_abduction.data.trace import Trace, checked_trace
from ssh_abduction.data.words import noun_of
from ssh_abduction.solution.result import Solution
from ssh_abduction.theory.evidence.of_steps import are_alike
from ssh_abduction.theory.theory import Theory, checked_theory


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


def with_correction_warnings(corrections: Corrections, solution: Solution) -> Solution:
    """Add warnings about drives that contradict a corrected gateway, and about unused names.

    A correction changes only the stars of the steps that it names. If another drive saw the gateway
    as it was before, its steps cannot be at the place any more. Without stars, they can be there.

    Args:
        corrections: The corrections that the solution obeys.
        solution: The solution, with its trace.
    """
    if not solution.maps or solution.trace is None:
        return solution
    drives = drives_of(solution.trace)
    known = corrections.known_in(drives)
    named_maps = corrections.named(solution.maps[0], drives)
    said = (
        *_unused_names(known, named_maps, drives),
        *_contradictions(known, solution.trace, drives),
    )
    return replace(solution, support=solution.support.warning_of(*said))


def _unused_names(said: Corrections, ssh_map: SSHMap, drives: Sequence[Drive]) -> Iterator[str]:
    """Yield a warning for each name that a map does not have."""
    for naming in said.names:
        label = ssh_map.dstate_at[step_of(drives, naming.step)]
        used = ssh_map.name_of(naming.kind, number_at(ssh_map, naming.kind, label))
        if used != naming.name:
            why = (
                f"this step has no {naming.kind}; name another step"
                if used is None
                else f"this {naming.kind} is also {brief(used)}; rename or remove one of them"
            )
            yield (
                f"{named(said.source or 'corrections')}: {naming}: it is not shown: in the "
                f"first map, {why}"
            )


def _contradictions(said: Corrections, trace: Trace, drives: Sequence[Drive]) -> Iterator[str]:
    """Yield a warning for each other drive that saw what a corrected step saw before."""
    for passage in said.gateways:
        about = {step.rpartition(":")[0] for step, _ in passage.seen}
        before = [(trace.steps[step_of(drives, step)].as_seen(), way) for step, way in passage.seen]
        for drive in drives:
            ways = {
                step_name(drives, t): way
                for t in range(drive.first, drive.stop if drive.name not in about else 0)
                for seen, way in before
                if _looks_like(trace.steps[t], seen)
                and seen.star
                and with_gateway(seen.star, way, is_open=passage.is_open) != seen.star
            }
            if ways:
                step, way = next(iter(ways.items()))
                option = "--open" if passage.is_open else "--closed"
                yield (
                    f"{named(said.source or 'corrections')}: {passage}: it contradicts what "
                    f"{drive.name} saw at {noun_of('step', ways)} {', '.join(ways)}; say the same "
                    f"of {step} (correct {option} '{step} {direction_in_words(way)}'), or remove it"
                )


def _looks_like(step: Step, seen: Step) -> bool:
    """Whether two steps have one view, and stars that may show the same gateways."""
    if step.view is None or step.view != seen.view or not (step.gateways and seen.gateways):
        return False
    return are_alike(step.gateways, seen.gateways)
