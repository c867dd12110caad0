"""Choose values for the fields of a theory that are "auto", while the trace grows."""

from __future__ import annotations

from ssh_abduction.data.errors import TheoryError, TraceError
from ssh_abduction.data.trace import Step, Trace
from ssh_abduction.theory.evidence import evidence_of
from ssh_abduction.theory.fields import choice
from ssh_abduction.theory.settle import Problem, count_returns, settle
from ssh_abduction.theory.theory import Theory


class TheorySettler:
    """Replaces each "auto" in a theory's fields by the value that fits the steps so far.

    The first step decides how to use stars (the openings seen at a step). All steps so far decide
    whether displacements are used, and how many returns of the robot are counted.

    Args:
        theory: The theory as the user gave it.
        first: A trace with only the first step.

    Raises:
        TheoryError: The theory needs stars, but the first step has none; or it weighs maps.
        TraceError: The first step lacks something else that the theory needs.
    """

    def __init__(self, theory: Theory, first: Trace) -> None:
        # The first step has no displacement, so `star` is chosen without displacements.
        if theory.weigh == "cost":
            raise TheoryError(
                "weigh: expected count while a robot drives, as weighing needs the whole trace, "
                f"got cost; take {choice('weigh', 'count')}, and solve the trace at the end"
            )
        theory = theory.replace(weigh="count")
        settled = settle(first, theory.replace(displacement="none")).theory
        self._refuses_stars = theory.star == "auto" and settled.star == "none"
        self._theory = theory.replace(star=settled.star)

    def settled(self, trace: Trace, known: Problem | None = None) -> Problem:
        """Choose the value of each field that is "auto", for the steps so far.

        Args:
            trace: The steps so far.
            known: The result for fewer steps, to reuse the pairs of steps that its evidence found;
                None without one.

        Returns:
            The trace and its theory, in which no field is "auto".
        """
        theory = self._theory
        if theory.displacement == "auto":
            theory = theory.replace(displacement="use" if trace.has_displacements else "none")
        if theory.displacement == "use" and not theory.returns:
            theory = theory.replace(returns=self._count(trace, theory, known))
        return settle(trace.prefix(1), theory, known).changed(trace)

    def is_settled(self, problem: Problem, trace: Trace) -> bool:
        """Whether a theory chosen for fewer steps is still the right choice.

        Args:
            problem: The steps before the last, and the theory that was chosen for them.
            trace: All steps so far.
        """
        theory = problem.theory
        if theory.displacement == "none":
            return self._theory.displacement == "none" or trace.steps[-1].displacement is None
        return bool(self._theory.returns) or theory.returns == self._count(trace, theory, problem)

    def _count(self, trace: Trace, theory: Theory, known: Problem | None) -> int:
        """Count the returns of the robot that may be true. Arguments are as for `settled`."""
        evidence = evidence_of(theory, known.evidence if known else ())
        return count_returns(Problem(trace, theory, evidence))

    def check_star(self, step: Step, number: int) -> None:
        """Raise TraceError if this step has a star but the first step had none.

        This holds for `star="auto"`.

        Args:
            step: The step.
            number: The number of the step, for the message.
        """
        if self._refuses_stars and step.star is not None:
            raise TraceError(
                f"step {number}: star: expected none, as the first step has none; "
                "give all steps stars, or take star=none"
            )
