"""Obey the names and corrections of a person (`data/corrections.py`)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from ssh_abduction.data.corrections import Corrections, checked_corrections
from ssh_abduction.data.drives import drives_of, fingerprints_of
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace, checked_trace
from ssh_abduction.solver.result import Solution
from ssh_abduction.theory.theory import Theory, checked_theory


def obeyed(corrections: Corrections, trace: Trace, theory: Theory) -> tuple[Trace, Theory]:
    """Return the trace and the theory that obey the corrections of a person.

    Pairs of steps are added to the fields same, different, elsewhere and same_place of the theory.
    Sentences about gateways that are open or closed change the stars of their steps.

    Args:
        corrections: The corrections. Sentences about drives that the trace lacks have no effect.
        trace: The trace.
        theory: The theory.

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
