"""Keep the minimal maps of a trace up to date, step by step, while the robot drives.

>>> from ssh_abduction import OnlineMapper, Theory
>>> mapper = OnlineMapper("end", Theory.topological(), time_limit=None)
>>> walk = [("travel", "hall"), ("travel", "end"), ("around", "end"), ("travel", "hall")]
>>> for action, view in walk:
...     solution = mapper.observe(action, view)
>>> solution.status.value, solution.count, solution.cost.dstates, solution.complete
('optimal', 2, 5, True)

Most steps are replayed, without asking clingo
----------------------------------------------
A dstate (distinctive state) is a place and the direction that the robot faces there. Let M be the
set of all minimal maps of the steps so far, and c their cost. Consider the link of a map for the
new action at the robot's dstate. The map *predicts* the new step if the dstate at the end of this
link shows what is seen. If that dstate shows something else, the map *contradicts* the step. If
there is no such link, the step is *unknown* to the map.

*Claim.* Suppose that some map of M predicts the step, and that the step is unknown to no map of M.
Then the maps of M that predict the step are exactly the minimal maps of the longer trace.

*Proof.* By (1) of the claim in `solver/prefixes.py`, no map of the longer trace costs less than c.
A map that predicts the step costs c, by (2). Conversely let F be a minimal map of the longer trace.
It costs c and, cut by the last step, is a map R of M, by (3). R does not contradict the step:
actions are deterministic, and a dstate has one observation, by functional_view and the axioms of
the stars (openings seen). (`observation` reads a star as these axioms do: a rotated pattern is no
contradiction.) So R predicts the step, and F is the replayed R, by (3). ∎

In all other cases clingo searches, in one control that is kept from step to step. If some map of M
predicts the step, clingo searches for all maps of cost c. Otherwise it searches for the minimal
cost, which is at least the last proven bound. If prefixes are not exact for a theory
(`theory/speedups.py`), the trace is solved again at each step.

*Evidence* may also contradict a map that predicts the step: by the displacements, the new step is
not where the map says, or cannot be there together with other returns. The proof stays the same,
because evidence that rejects a map of fewer steps also rejects it for more steps. So evidence has
to test only returns to the new step.

A theory that depends on the trace
----------------------------------
Two parts of a theory depend on the whole trace, and may change as it grows. First, displacements
are used as soon as there is one; from then on, places are minimised before paths. Second, the
probability of rejecting a true map is shared among all returns that may be true. Their number is
rounded up to a power of two, so that it changes only when it doubles. When one of these two parts
of the theory changes, the minimal maps so far may not be minimal any more, so clingo searches
again. If the number of returns has grown, fewer maps are rejected, so the maps so far serve as
drafts.

When time is short
------------------
A map that predicts the step is minimal even if there is no time to look for others. When no map
predicts the step and time is short, the answer is *feasible*: it has a consistent map, and the last
bound, which holds for the longer trace by (1). The map is a draft or a sketch. clingo searches
again when the trace has grown (`keeper.py`). It continues from the state in which it stopped, and
may prove a map minimal again.

If faults are allowed
---------------------
Faults are steps that a map treats as wrong. If the theory allows them, `recovery.py` keeps the
maps. When a step contradicts all maps, it says what broke, lists what may be true with
probabilities, and restores the map when the evidence decides. `standing` says how sure it is.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from ssh_abduction.data.checks import check_limit
from ssh_abduction.data.errors import TheoryError, TraceError
from ssh_abduction.data.odometry import Odometry
from ssh_abduction.data.trace import Action, Step, Trace, View
from ssh_abduction.data.words import counted
from ssh_abduction.online.keeper import MapKeeper, StepOptions
from ssh_abduction.solution import Solution
from ssh_abduction.solver import preload_engine
from ssh_abduction.theory.evidence import evidence_of
from ssh_abduction.theory.fields import choice
from ssh_abduction.theory.settle import Problem, count_returns, settle
from ssh_abduction.theory.speedups import ALL, Speedups, checked_speedups
from ssh_abduction.theory.theory import Theory, checked_theory

if TYPE_CHECKING:
    from ssh_abduction.online.recovery import Recovery, Standing


class OnlineMapper:
    """Keeps the minimal maps of a trace up to date while a robot drives.

    Args:
        view: The view at the first step.
        theory: The axioms, and what to minimise; Theory.topological() by default. If it allows
            faults (misread, slipped), `standing` says how sure the map is. `star="auto"` uses stars
            if the first step has one. `displacement="auto"` uses displacements from the first one
            on.
        star: The star of the first step: the openings seen, as in Step. None if there is none.
        confidence: Probability that the first view and star are right, as in Step. Only theories
            with faults use it.
        odometry: The noise model of displacements without a covariance, as in Trace; None takes
            the default one.
        time_limit: Seconds for each step. A step may take a little longer, as clingo cannot be
            stopped while it grounds. None waits for the exact answer.
        work_limit: Units of work for each step, each about a second of a quiet core; None for no
            limit. With a work limit and without a time limit, equal steps give equal answers on
            each machine and under each load.
        max_maps: Keep at most this many maps; None keeps all.
        speedups: Flags that say which speed-ups to use. None of them changes the answer.

    Attributes:
        trace: The steps so far.
        theory: The theory, in which no field is "auto".
        solution: The minimal maps of the steps so far, or the best map found in time.
    """

    def __init__(
        self,
        view: View,
        theory: Theory | None = None,
        *,
        star: Sequence[float] | None = None,
        confidence: float | None = None,
        odometry: Odometry | Mapping[str, Any] | None = None,
        time_limit: float | None = 0.5,
        work_limit: float | None = None,
        max_maps: int | None = 100,
        speedups: Speedups = ALL,
    ) -> None:
        first = replace(Step.of(_known(view, 0), star, "step 0"), confidence=confidence)
        theory = checked_theory(theory)
        if theory.jumped:
            raise TheoryError(
                "jumped: expected 0, as no displacement is treated as wrong while a robot drives, "
                f"got {theory.jumped:g}; leave it out, and give no displacement at a step where "
                "the odometry is lost"
            )
        check_limit("time_limit", "seconds", time_limit)
        check_limit("work_limit", "units of work", work_limit)
        checked_speedups(speedups)
        self._odometry = None if odometry is None else Odometry.of(odometry)
        self.trace = Trace((first,), odometry=self._odometry)
        self._settler = TheorySettler(theory, self.trace)
        self._problem = self._settler.settled(self.trace)
        options = StepOptions(time_limit, work_limit, max_maps, speedups)
        self._keeper: MapKeeper | Recovery
        if theory.has_faults:
            from ssh_abduction.online.recovery import Recovery  # loads numpy

            began = time.perf_counter()
            self._keeper = Recovery(self._problem, options)
        else:
            preload_engine(self.theory)
            began = time.perf_counter()
            self._keeper = MapKeeper(self._problem, options)
        self.solution = self._keeper.answer(began)

    @property
    def theory(self) -> Theory:
        """The theory of the mapper. Each field "auto" has its value for the steps so far."""
        return self._problem.theory

    @property
    def searches(self) -> int:
        """The number of searches by clingo so far."""
        return self._keeper.searches

    @property
    def standing(self) -> Standing:
        """How sure the map is, which steps contradicted it, and what may be true.

        Raises:
            TheoryError: The theory allows no faults, so there is no standing; see `solution`.
        """
        if self._keeper.standing is None:
            raise TheoryError(
                "theory: expected a theory that allows faults, as `standing` is about faults, got "
                "one without; set misread or slipped, or read `solution`"
            )
        return self._keeper.standing

    def __repr__(self) -> str:
        cost = self.solution.cost
        steps = counted(len(self.trace), "steps")
        dstates = counted(cost.dstates, "dstates") if cost else "no map"
        status = self.solution.status.value
        return f"<OnlineMapper: {steps}, {status}, {dstates}>"

    def observe(
        self,
        action: Action | str | Mapping[str, Any],
        view: View,
        *,
        star: Sequence[float] | None = None,
        displacement: Sequence[float] | None = None,
        covariance: Sequence[Sequence[float]] | None = None,
        confidence: float | None = None,
    ) -> Solution:
        """Add an action and the step after it, and return the new solution.

        Args:
            action: The action that the robot did: an Action, its name, or a dict of its fields.
            view: The view now.
            star: The star now: the openings seen, as in Step. None if there is none.
            displacement: [dx, dy, dtheta] of the action, in metres and radians, as in Step; None
                if it is unknown.
            covariance: The covariance of the displacement, (3, 3); None takes it from the odometry.
            confidence: Probability that the view and the star are right, as in Step. The lower it
                is, the less it costs to treat them as wrong.

        Raises:
            TraceError: The step does not fit the theory or the trace. The mapper is unchanged then.
        """
        began = time.perf_counter()
        done, number = Action.of(action), len(self.trace)
        step = Step.of(
            _known(view, number),
            star,
            f"step {number}",
            displacement=displacement,
            covariance=covariance,
        )
        self._append(done, replace(step, confidence=confidence))
        # A longer trace may change the theory; then search for the maps again.
        if self._settler.is_settled(self._problem, self.trace):
            self._problem = self._problem.changed(self.trace)
            self._keeper.take(self._problem)
        else:
            self._problem = self._settler.settled(self.trace, self._problem)
            self._keeper = self._keeper.restarted(self._problem)
        self.solution = self._keeper.answer(began)
        return self.solution

    def _append(self, action: Action, step: Step) -> None:
        """Append a step to the trace. Raises TraceError if it does not fit."""
        last, number = replace(self.trace.steps[-1], action=action), len(self.trace)
        if action.starts:
            raise TraceError(
                f"step {number - 1}: action: expected an action of the robot, got the start "
                "of a drive; a mapper takes one drive, so solve the traces of all drives together"
            )
        trace = Trace((*self.trace.steps[:-1], last, step), odometry=self._odometry)
        for t, checked in ((number - 1, last), (number, step)):
            if lack := self.theory.lack_of(checked):
                raise TraceError(f"step {t}: {lack}")
        self._settler.check_star(step, number)
        self.trace = trace


def _known(view: View, step: int) -> View:
    """Return the view of a step. Raise TraceError if it is None, which only `solve` allows."""
    if view is None:
        raise TraceError(
            f"step {step}: view: expected one while a robot drives, got none; "
            "log the trace, and solve it as a whole"
        )
    return view


class TheorySettler:
    """Replaces each "auto" in a theory's fields by the value that fits the steps so far.

    The first step decides how to use stars (the openings seen at a step). All steps so far decide
    whether displacements are used, and how many returns of the robot are counted.

    `theory` is as the user gave it, and `first` a trace with only the first step. Raises
    TheoryError if the theory needs stars, but the first step has none, or if it compares maps by
    their cost in nats. Raises TraceError if the first step lacks something else.
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
        """Choose a value for each "auto", for the steps so far. Reuse results for fewer steps."""
        theory = self._theory
        if theory.displacement == "auto":
            theory = theory.replace(displacement="use" if trace.has_displacements else "none")
        if theory.displacement == "use" and not theory.returns:
            theory = theory.replace(returns=self._count(trace, theory, known))
        return settle(trace.prefix(1), theory, known).changed(trace)

    def is_settled(self, problem: Problem, trace: Trace) -> bool:
        """Whether the theory of `problem`, chosen for fewer steps, is still the right choice."""
        theory = problem.theory
        if theory.displacement == "none":
            return self._theory.displacement == "none" or trace.steps[-1].displacement is None
        return bool(self._theory.returns) or theory.returns == self._count(trace, theory, problem)

    def _count(self, trace: Trace, theory: Theory, known: Problem | None) -> int:
        """Count the returns of the robot that may be true. Arguments are as for `settled`."""
        evidence = evidence_of(theory, known.evidence if known else ())
        return count_returns(Problem(trace, theory, evidence))

    def check_star(self, step: Step, number: int) -> None:
        """Raise TraceError if star="auto" and this step has a star but the first step has none."""
        if self._refuses_stars and step.star is not None:
            raise TraceError(
                f"step {number}: star: expected none, as the first step has none; "
                "give all steps stars, or take star=none"
            )
