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
Kuipers (AIJ 2004). `AXIOMS` maps the name of each axiom to its check. The checks are in
`topological`, `side_axioms`, `stars`, `clashes` and `evidence`; `coherence` checks that the map
fits the trace. `region_axioms` checks the regions of a map that lists them.

A map lists one place, one course (path and direction) and one heading for each dstate, even if the
theory leaves out the axiom that forbids several. The other axioms are checked on the listed ones.
A map also lists the order of the places along each path. It lists no sides of paths, and no travels
that lead around a ring of places. The module `side_axioms` describes how the axioms about sides are
checked, and `reading.Order` how those about orders are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from ssh_abduction.checker import (
    clashes,
    coherence,
    evidence,
    region_axioms,
    side_axioms,
    stars,
    topological,
)
from ssh_abduction.checker.reading import Check, Reading
from ssh_abduction.data.maps import SSHMap, checked_map
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import SHORT_TURN, look_at_clock
from ssh_abduction.theory import encodings
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.theory import Theory

COHERENCE = "map_explains_trace"

# The check of an axiom is the function with the name of the axiom in one of these modules.
_MODULES = (topological, side_axioms, stars, clashes, evidence)
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
    checks = [(COHERENCE, test) for test in coherence.CHECKS] + [
        (name, AXIOMS[name]) for name in theory.axioms if name in AXIOMS
    ]
    # Regions follow from a map and decide nothing. They are checked if the map lists them.
    checks += [*region_axioms.AXIOMS.items()] if ssh_map.regions is not None else []
    for name, test in checks:
        look_at_clock(SHORT_TURN)
        for steps, message in test(reading):
            yield Violation(name, tuple(map(reading.named, sorted(set(steps)))), message)


def unchecked(theory: Theory) -> tuple[str, ...]:
    """List what `check` skips: axioms of the user's rules, and files of rules without axioms."""
    named = tuple(name for name in theory.axioms if name not in AXIOMS)
    return named + tuple(f"the rules of {rules.name}" for rules in theory.rules if not rules.axioms)
