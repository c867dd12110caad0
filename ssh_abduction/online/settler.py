"""Chooses the `auto` options for a growing trace."""

from __future__ import annotations

from ssh_abduction.data.errors import TraceError
from ssh_abduction.data.trace import Step, Trace
from ssh_abduction.theory.evidence import evidence_of
from ssh_abduction.theory.settle import Problem, count_returns, settle
from ssh_abduction.theory.theory import Theory


class TheorySettler:
    """Chooses `star` by the first step, and `displacement` and `returns` by the steps so far.

    Args:
        theory: The theory as the user gave it.
        first: A trace of the first step.

    Raises:
        TheoryError: The theory needs stars, but the first step has none.
        TraceError: The first step lacks something else that the theory needs.
    """

    def __init__(self, theory: Theory, first: Trace) -> None:
        # The first step has no displacement, so `star` is chosen without displacements.
        settled = settle(first, theory.replace(displacement="none")).theory
        self._refuses_stars = theory.star == "auto" and settled.star == "none"
        self._theory = theory.replace(star=settled.star)

    def settled(self, trace: Trace, known: Problem | None = None) -> Problem:
        """The theory for the steps so far, with what is known about fewer steps."""
        theory = self._theory
        if theory.displacement == "auto":
            theory = theory.replace(displacement="use" if trace.has_displacements else "none")
        if theory.displacement == "use" and not theory.returns:
            theory = theory.replace(returns=self._count(trace, theory, known))
        return settle(trace.prefix(1), theory, known).changed(trace)

    def is_settled(self, problem: Problem, trace: Trace) -> bool:
        """Whether the theory for the steps before the last also fits all steps."""
        theory = problem.theory
        if theory.displacement == "none":
            return self._theory.displacement == "none" or trace.steps[-1].displacement is None
        return bool(self._theory.returns) or theory.returns == self._count(trace, theory, problem)

    def _count(self, trace: Trace, theory: Theory, known: Problem | None) -> int:
        evidence = evidence_of(theory, known.evidence if known else ())
        return count_returns(Problem(trace, theory, evidence))

    def check_star(self, step: Step, number: int) -> None:
        """Raise TraceError for a star after a first step that had none."""
        if self._refuses_stars and step.star is not None:
            raise TraceError(
                f"step {number}: star: expected none, as the first step has none; "
                "give all steps stars, or take star=none"
            )
