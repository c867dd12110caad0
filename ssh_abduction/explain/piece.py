"""Pieces of a trace: some of its steps, made into a trace of their own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from ssh_abduction.data.closure import closures_among
from ssh_abduction.data.corrections import ASSERTIONS
from ssh_abduction.data.drives import drives_of, named_steps
from ssh_abduction.data.trace import Action, Step, Trace
from ssh_abduction.theory.settle import Problem, displacement_of
from ssh_abduction.theory.theory import Theory


@dataclass(frozen=True)
class Piece:
    """Some steps of a trace, made into a trace of their own.

    A map of the whole trace, restricted to these steps, satisfies the axioms at these steps. So if
    the piece has no map, the whole trace has none.
    """

    # A trace of these steps, numbered from 0, and the theory. Where steps are left out, the action
    # and the displacement are unknown. The pairs of steps that a user asserted to be the same or
    # different are renumbered in the theory.
    problem: Problem
    # The steps by their numbers in the whole trace, ascending. In sentences, steps of several
    # drives have the names of their drives.
    steps: tuple[int, ...]
    # Clingo facts for the pairs of steps that displacements exclude from being at one dstate, or at
    # one place. Empty if no steps are left out between the first and the last.
    facts: str = ""

    @property
    def trace(self) -> Trace:
        """The trace of the piece, with steps numbered from 0."""
        return self.problem.trace

    @property
    def theory(self) -> Theory:
        """The theory. Pairs of steps that a user asserted have the step numbers of the piece."""
        return self.problem.theory

    @staticmethod
    def of(problem: Problem, steps: Sequence[int]) -> Piece:
        """Make the piece that has these steps, ascending, of the trace of a problem."""
        trace, theory = problem.trace, problem.theory
        kept: list[Step] = []
        for k, t in enumerate(steps):
            step = trace.steps[t]
            # where steps are left out, the action and the displacement are unknown
            if k + 1 == len(steps):
                step = replace(step, action=None)
            elif steps[k + 1] != t + 1:
                step = replace(step, action=Action.that_slipped(t))
            if k and steps[k - 1] != t - 1 and step.displacement is not None:
                step = replace(step, displacement=None, covariance=None)
            kept.append(step)
        names = named_steps(drives_of(trace), len(trace))
        number = {t: k for k, t in enumerate(steps)}
        pairs = {
            name: tuple(
                (number[i], number[j])
                for i, j in getattr(theory, name)
                if i in number and j in number
            )
            for name in ASSERTIONS
        }
        closures = closures_among(trace.closures, steps)
        alone = replace(trace, steps=tuple(kept), closures=closures)
        gap = steps[-1] - steps[0] + 1 > len(steps)
        return Piece(
            problem.changed(alone, theory.replace(**pairs)),
            tuple(names[t] for t in steps),
            _said_across(problem, number) if gap else "",
        )


def _said_across(problem: Problem, number: Mapping[int, int]) -> str:
    """Write clingo facts about the pairs of steps that displacements rule out.

    The facts are computed from the whole trace, as the piece lacks the displacements of the steps
    that are left out.
    """
    displacement = displacement_of(problem)
    if displacement is None:
        return ""
    pairs = displacement.pairs(problem.trace)
    rules = []
    for name, earlier in (
        ("excluded", pairs.apart),
        ("elsewhere", pairs.elsewhere if problem.theory.level == "topological" else {}),
    ):
        rules += [
            f"{name}({displacement.axiom},{number[i]},{number[t]})."
            for t, others in earlier.items()
            if t in number
            for i in others
            if i in number
        ]
    return "\n".join(rules)
