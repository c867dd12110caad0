"""Pieces of a trace: some of its steps, as a trace of their own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from ssh_abduction.data.trace import Action, Step, Trace
from ssh_abduction.theory.evidence import Displacement, evidence_of
from ssh_abduction.theory.theory import ASSERTIONS, Theory


@dataclass(frozen=True)
class Piece:
    """Some steps of a trace as a trace of their own.

    A map of the whole trace, restricted to these steps, satisfies the axioms there. So if the piece
    has no map, the trace has none.

    Attributes:
        trace: The steps, numbered from 0. Across a gap the action and displacement are unknown.
        theory: The theory, with asserted pairs in the numbers of the piece.
        steps: The steps of the whole trace, ascending.
        facts: Clingo facts: what displacements say about pairs of steps across gaps.
    """

    trace: Trace
    theory: Theory
    steps: tuple[int, ...]
    facts: str = ""

    @staticmethod
    def of(trace: Trace, theory: Theory, steps: Sequence[int]) -> Piece:
        """The piece with these steps of a trace, ascending, under a resolved theory."""
        kept: list[Step] = []
        for k, t in enumerate(steps):
            step = trace.steps[t]
            # nothing is known about the action and the displacement across a gap
            if k + 1 == len(steps):
                step = replace(step, action=None)
            elif steps[k + 1] != t + 1:
                step = replace(step, action=Action.that_slipped(t))
            if k and steps[k - 1] != t - 1 and step.displacement is not None:
                step = replace(step, displacement=None, covariance=None)
            kept.append(step)
        number = {t: k for k, t in enumerate(steps)}
        pairs = {
            name: tuple(
                (number[i], number[j])
                for i, j in getattr(theory, name)
                if i in number and j in number
            )
            for name in ASSERTIONS
        }
        gap = steps[-1] - steps[0] + 1 > len(steps)
        facts_across = _said_across(trace, theory, number) if gap else ""
        return Piece(
            replace(trace, steps=tuple(kept)), theory.replace(**pairs), tuple(steps), facts_across
        )


def _said_across(trace: Trace, theory: Theory, number: Mapping[int, int]) -> str:
    """What displacements say about pairs of these steps, as facts.

    They are computed from the whole trace: the piece lacks the displacements across its gaps.
    """
    displacement = displacement_of(theory)
    if displacement is None:
        return ""
    pairs = displacement.pairs(trace)
    told = []
    for name, earlier in (
        ("excluded", pairs.apart),
        ("elsewhere", pairs.elsewhere if theory.level == "topological" else {}),
    ):
        told += [
            f"{name}({displacement.axiom},{number[i]},{number[t]})."
            for t, others in earlier.items()
            if t in number
            for i in others
            if i in number
        ]
    return "\n".join(told)


def displacement_of(theory: Theory) -> Displacement | None:
    """The evidence of displacements, if the theory uses it."""
    return next(
        (evidence for evidence in evidence_of(theory) if isinstance(evidence, Displacement)), None
    )
