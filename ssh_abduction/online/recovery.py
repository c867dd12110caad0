"""Recover from faults while the robot drives.

A fault is a step that a map treats as wrong: a misread view, or an action that slipped. If a step
contradicts all minimal maps, the mapper keeps several explanations with probabilities, until later
steps decide which map is right. A dstate (distinctive state) is a place and a heading.

>>> from ssh_abduction import OnlineMapper, Theory
>>> mapper = OnlineMapper("v0", Theory.causal().replace(misread=1.5, slipped=3), time_limit=10)
>>> for t in range(1, 20):
...     _ = mapper.observe(("right", "travel")[(t - 1) % 2], f"v{t % 4}" if t != 17 else "v3")
...     if t >= 16:
...         print(t, mapper.standing)  # doctest: +NORMALIZE_WHITESPACE
16 certain: nothing new is taken as wrong; the robot is at dstate 0 of 4
17 uncertain, most likely: the view at step 17 is misread: v3, expected v1; the robot is at
   dstate 1 of 4; step 17: seen v3, expected v1 at dstate 1: misread, slipped, or the map is wrong
18 certain: the view at step 17 is misread: v3, expected v1; the robot is at dstate 2 of 4
19 certain: nothing new is taken as wrong; the robot is at dstate 3 of 4

The paper's own future work is "robust error-recovery during exploration, by falling back from
logical inference to Markov localisation when low-probability events violate the abstraction, until
the logical representation can be restored" (Kuipers & Beeson 2002). This module keeps three things:

* **Minimal maps**, proven, with their faults. As long as some of them predict what is seen, these
  stay minimal by the claim in `mapper.py`. The claim also holds with faults: suppose that a minimal
  map of the longer trace treats the last step as wrong. Without that step it would cost less than
  the minimum, which is impossible. In the causal theory, the same holds for an action that was
  never tried: each map is extended by a link to each dstate that looks right. These extensions
  cost nothing, and all others cost more. If no minimal map predicts the step, the trace
  is solved again, within the time of a step.
* **Rivals** (`rival_maps.py`): besides the minimal maps, explanations that cost a little more,
  each with its probability (`hypotheses.py`).
* **Where the robot is** (`standing.py`), by Markov localisation in the best map. It begins just
  before the first step that contradicted the map. The robot may be at no dstate of the map.

The mapper is certain if one map is proven minimal and has a probability of at least CERTAIN (0.99)
among its rivals. After a contradiction, two more things are needed: a later step was predicted,
and localisation finds the robot where this map has it.
"""

from __future__ import annotations

import time

from ssh_abduction.online.keeper import StepOptions
from ssh_abduction.online.rival_maps import RivalMaps
from ssh_abduction.online.standing import Confidence, Standing
from ssh_abduction.solver import Effort, Judging, Seconds, Solution, Status, cost_as_counted, solve
from ssh_abduction.theory.settle import Problem

# After each search with a time limit the trace has to grow by this factor, and by at least this
# many steps, before the next search.
RETRY = 1.05
PAUSE = 2


class Recovery:
    """Keeps the maps up to date for a theory that allows faults, and says how sure they are.

    `problem` has the steps so far, and the theory, in which no field is "auto". `before` is the
    Recovery of fewer steps that this one replaces; None for the first.
    """

    def __init__(
        self, problem: Problem, options: StepOptions, before: Recovery | None = None
    ) -> None:
        self._trace, self._theory, self._options = problem.trace, problem.theory, options
        self._judging = Judging(problem)
        self._maps = RivalMaps(problem, options.max_maps, self._judging)
        self.searches: int = before.searches if before else 0  # by clingo, so far
        self._next_search = 0  # no search before the trace has this many steps
        self._confidence: Confidence = before._confidence if before else Confidence(problem.theory)
        self._spent = 0.0  # seconds that all steps took
        self.standing: Standing | None = None  # before the first answer

    def restarted(self, problem: Problem) -> Recovery:
        """Make a Recovery for a theory that changed with the last step. It has no proofs yet."""
        return Recovery(problem, self._options, before=self)

    def take(self, problem: Problem) -> None:
        """Add the last step to all rivals, and record whether the step contradicts the best map."""
        trace = problem.trace
        self._trace, lead = trace, self._maps.lead
        if lead and self._confidence.known is None:
            self._confidence.known = lead.explained()
        change = self._maps.follow(problem)
        if change.lost_proof:
            self._next_search = 0
        self._confidence.note(len(trace) - 1, change.broke)

    def answer(self, began: float) -> Solution:
        """Solve the trace again if that is due, and return what is known.

        `began` is when the step began, by `time.perf_counter`.
        """
        if not self._maps.is_settled and len(self._trace) >= self._next_search:
            self._solve()
        solution = self._solution(began)
        self.standing = self._confidence.standing(self._maps, self._trace, solution.maps)
        return solution

    def _solve(self) -> None:
        """Solve the trace within the time of a step."""
        steps, options = len(self._trace), self._options
        self._next_search = 0
        if options.time_limit is not None:
            self._next_search = max(steps + PAUSE, int(RETRY * steps))
        self.searches += 1
        found = solve(
            self._trace,
            self._theory.of_steps(0, steps),
            time_limit=options.time_limit,
            max_maps=options.max_maps,
            speedups=options.speedups,
        )
        self._maps.absorb(found)

    def _solution(self, began: float) -> Solution:
        """The solution so far: the minimal maps, else the best rival, else none."""
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
        """Return the status of the solution: how much is proven about its maps."""
        if self._maps.is_proven:
            return Status.OPTIMAL
        if self._maps.rivals:
            return Status.FEASIBLE
        return Status.UNSATISFIABLE if self._maps.is_impossible else Status.UNKNOWN
