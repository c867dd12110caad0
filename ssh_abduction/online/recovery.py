"""Recovers from faults while the robot drives.

If a step contradicts all minimal maps, the mapper falls back to a belief, until evidence restores
the map.

>>> from ssh_abduction import OnlineMapper, Theory
>>> mapper = OnlineMapper("v0", Theory.causal().replace(misread=1.5, slipped=3))
>>> for t in range(1, 20):
...     _ = mapper.observe(("right", "travel")[(t - 1) % 2], f"v{t % 4}" if t != 17 else "v3")
...     if t >= 16:
...         print(t, mapper.standing)  # doctest: +NORMALIZE_WHITESPACE
16 certain: nothing else is disbelieved; the robot is at dstate 0 of 4
17 uncertain, most likely: the view at step 17 is misread: v3, expected v1; the robot is at
   dstate 1 of 4; step 17: seen v3, expected v1 at dstate 1: misread, slipped, or the map is wrong
18 certain: the view at step 17 is misread: v3, expected v1; the robot is at dstate 2 of 4
19 certain: nothing else is disbelieved; the robot is at dstate 3 of 4

The paper's own future work is "robust error-recovery during exploration, by falling back from
logical inference to Markov localisation when low-probability events violate the abstraction, until
the logical representation can be restored" (Kuipers & Beeson 2002). Here these are three things:

* **Minimal maps**, proven, with their faults. While some of them predict what is seen they stay
  minimal, by the claim in `mapper.py`, which also holds with faults: a minimal map of the longer
  trace that ignores the last step would, without that step, cost less than the minimum. By the
  causal theory no minimal map is lost if an action was never tried, because only a link to a
  dstate that looks right costs nothing. If no minimal map goes on, solve the trace again: in the
  time of a step, and else in another process while the robot drives (`background_solve.py`).
* **Rivals** (`rival_maps.py`): besides the minimal maps, all explanations that cost a little more,
  each with its probability (`hypotheses.py`).
* **Where the robot is** (`standing.py`), by Markov localisation in the best map, from the dstate
  before the one at which the map broke. The robot may be nowhere that this map knows.

The mapper is certain if one map is minimal, proven, and has the probability CERTAIN among its
rivals. After something broke, localisation must also have the robot located there.
"""

from __future__ import annotations

import time

from ssh_abduction.online.background_solve import FaultSolver
from ssh_abduction.online.options import StepOptions
from ssh_abduction.online.rival_maps import RivalMaps
from ssh_abduction.online.standing import Confidence, Standing
from ssh_abduction.solver import Effort, Judging, Seconds, Solution, Status, cost_as_counted
from ssh_abduction.theory.settle import Problem


class Recovery:
    """Keeps the maps with faults current, and says how sure they are.

    Args:
        problem: The steps so far, and the theory without `auto`, with faults.
        options: What a step may use.
        before: The keeper that this one follows. It has fewer steps.

    Attributes:
        standing: How sure the maps are; None before the first answer.
    """

    def __init__(
        self,
        problem: Problem,
        options: StepOptions,
        before: Recovery | None = None,
    ) -> None:
        self._trace, self._theory, self._options = problem.trace, problem.theory, options
        self._judging = Judging(problem)
        self._maps = RivalMaps(problem, options.max_maps, self._judging)
        self.solver: FaultSolver = FaultSolver(options, before.solver.searches if before else 0)
        self._confidence: Confidence = before._confidence if before else Confidence(problem.theory)
        self._spent = 0.0  # seconds that all steps took
        self.standing: Standing | None = None

    @property
    def searches(self) -> int:
        """The number of steps that solved the trace."""
        return self.solver.searches

    def restarted(self, problem: Problem) -> Recovery:
        """A keeper for the theory with one more step, with nothing proven."""
        return Recovery(problem, self._options, before=self)

    def take(self, problem: Problem) -> None:
        """Take in the last step of a trace: let the rivals go on with it."""
        trace = problem.trace
        self._trace, lead = trace, self._maps.lead
        if lead and self._confidence.known is None:
            self._confidence.known = lead.explained()
        change = self._maps.follow(problem)
        if change.lost_proof:
            self.solver.make_due()
        self._confidence.note(len(trace) - 1, change.broke)

    def answer(self, began: float) -> Solution:
        """Solve the trace again if that is due, and return what is known.

        Args:
            began: When the step began, by `time.perf_counter`.
        """
        if not self._maps.is_settled and self.solver.is_due(self._trace):
            self._solve()
        found = self.solver.finished()
        if found and not self._maps.is_settled and not self._maps.is_outgrown(found):
            self._maps.absorb(found)
        solution = self._solution(began)
        self.standing = self._confidence.standing(self._maps, self._trace, solution.maps)
        return solution

    def _solve(self) -> None:
        """Solve the trace in the time of a step, and go on in the background if that is short."""
        found = self.solver.solve(self._trace, self._theory, has_map=bool(self._maps.rivals))
        if found is None:
            return
        self._maps.absorb(found)
        if not self._maps.is_settled and found.stopped == "time limit":
            self.solver.begin_in_background(self._trace, self._theory)

    def _solution(self, began: float) -> Solution:
        """The answer for the steps so far: the minimal maps, or else the best rival."""
        maps, steps = self._maps, len(self._trace)
        maps.drop_inconsistent()
        lead, solved = maps.lead, maps.solved
        assert solved is not None
        # Without a proof the best rival is the answer.
        listed = tuple(rival.explained() for rival in maps.minimal)
        if lead and not listed:
            listed = (lead.explained(),)
        self._spent += time.perf_counter() - began
        if listed and self._judging.has_time_for(steps, self._spent):
            self._judging.pass_grown_map(self._trace, listed[0])
        status = self._status()
        return Solution(
            status=status,
            maps=listed,
            cost=cost_as_counted(listed[0], lead.cost, self._theory) if lead else None,
            bound=maps.bound,
            complete=maps.is_complete or status is Status.UNSATISFIABLE,
            theory=self._theory,
            steps=steps,
            effort=Effort(solved.steps, Seconds(time.perf_counter() - began, 0.0, 0.0)),
            stopped=None if maps.is_complete or maps.is_impossible else solved.stopped,
            partial=None if listed else self._confidence.known,
        )

    def _status(self) -> Status:
        """How much is proven of the maps."""
        if self._maps.is_proven:
            return Status.OPTIMAL
        if self._maps.rivals:
            return Status.FEASIBLE
        return Status.UNSATISFIABLE if self._maps.is_impossible else Status.UNKNOWN
