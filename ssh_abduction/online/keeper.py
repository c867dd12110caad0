"""Keep the minimal maps of a growing trace up to date, for a theory that allows no faults.

A fault is a step that a map treats as wrong.
"""

from __future__ import annotations

import time

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.online.drafts import DRAFTS, Drafts
from ssh_abduction.online.incremental import IncrementalSolver
from ssh_abduction.online.mender import Mender
from ssh_abduction.online.options import StepOptions
from ssh_abduction.online.replay import MinimalMaps
from ssh_abduction.solver import Cost, Effort, Judging, Seconds, Solution, Status
from ssh_abduction.theory.evidence import said_by
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.theory import Theory


class MapKeeper:
    """Keeps the minimal maps up to date, or the best map that is found in time.

    Args:
        problem: The steps so far, and the theory: it allows no faults, and no field is "auto".
        options: The time limit and the other options of a step.
        before: The keeper of fewer steps that this one replaces; None for the first.
    """

    standing = None  # only `Recovery`, for theories with faults, has a standing

    def __init__(
        self, problem: Problem, options: StepOptions, before: MapKeeper | None = None
    ) -> None:
        trace, theory = problem.trace, problem.theory
        self._problem, self._options = problem, options
        self._judging = Judging(problem)
        self.minimal = MinimalMaps(trace, theory, self._judging)
        self.drafts = Drafts(problem, self._judging)
        self.solver: IncrementalSolver = IncrementalSolver(
            options, before.solver.searches if before else 0
        )
        self.mender: Mender = before.mender if before else Mender(options)
        self._previous: SSHMap | None = None  # the best map of the steps before the last
        self._spent = 0.0  # seconds that all steps took

    @property
    def trace(self) -> Trace:
        """The steps so far."""
        return self._problem.trace

    @property
    def theory(self) -> Theory:
        """The theory, in which no field is "auto"."""
        return self._problem.theory

    @property
    def searches(self) -> int:
        """The number of searches by clingo so far."""
        return self.solver.searches

    def restarted(self, problem: Problem) -> MapKeeper:
        """Make a keeper for a theory that changed with the last step.

        The minimal maps so far need not be minimal by the new theory. They become drafts (maps to
        be extended step by step) if the old theory already used displacements.

        Args:
            problem: The steps so far, with one more, and the new theory.
        """
        trace = problem.trace
        keeper = MapKeeper(problem, self._options, before=self)
        keeper._previous = self._best_known()
        if self.theory.displacement == "use":
            for ssh_map in [m.map() for m in self.minimal.maps[:DRAFTS]] + self.drafts.maps():
                keeper.drafts.add(ssh_map, trace)
        else:
            keeper.mender.mending = None
        return keeper

    def take(self, problem: Problem) -> None:
        """Add the last step: keep the maps that predict it, and drop those that it contradicts.

        Args:
            problem: The steps so far, with one more, and the theory.
        """
        self._previous = self._best_known()
        self._problem, trace = problem, problem.trace
        action = trace.steps[-2].action
        assert action
        if self.minimal.is_impossible:
            return
        was_proven = self.minimal.status is Status.OPTIMAL
        untried = self.minimal.follow(action, trace, problem.pairs)
        self.drafts.follow(action, trace.steps[-1])
        if was_proven and self.minimal.status is Status.UNKNOWN:
            self.solver.make_due()
        for replayed in untried[:DRAFTS]:
            self.drafts.add(replayed.map(), trace)

    def answer(self, began: float) -> Solution:
        """Search for minimal maps of the steps so far if needed, and return what is known.

        Args:
            began: When the step began, by `time.perf_counter`.
        """
        if not self.minimal.is_impossible:
            self._find(began)
        return self._solution(began)

    def _best_known(self) -> SSHMap | None:
        """Return the first minimal map, else the map of the best draft, else None."""
        if self.minimal.maps:
            return self.minimal.maps[0].map()
        return self.drafts.first()

    def _find(self, began: float) -> None:
        """Search for minimal maps with clingo. If it runs out of time, mend a map."""
        if not self.minimal.is_settled(self._options.max_maps) and self.solver.is_due(self.trace):
            self._ask()
        finished = self.mender.finished()
        if self.minimal.status is not Status.UNKNOWN:
            return
        if finished:
            self.drafts.add(finished, self.trace)
        if self._previous and not self.drafts and self.mender.suits(self.trace, self.theory):
            mended = self.mender.mended(self.trace, self.theory, self._previous, began)
            if mended:
                self.drafts.add(mended, self.trace)

    def _ask(self) -> None:
        """Search for minimal maps with clingo, and keep them, or the best map as a draft."""
        known = self.minimal.maps[0].map() if self.minimal.status is Status.OPTIMAL else None
        found = self.solver.maps(self.trace, self.theory, known)
        said = self.solver.solution
        assert said is not None
        proves = said.status in (Status.OPTIMAL, Status.UNSATISFIABLE)
        if proves or not self.minimal.replays:
            self.minimal.replace(found, said.status, said.complete, said.cost)
            self.drafts.clear()
        elif found:
            self.drafts.add(found[0], self.trace)

    def _solution(self, began: float) -> Solution:
        """Make the solution for the steps so far.

        It has the minimal maps, else one consistent map, else no map.

        Args:
            began: When the step began, by `time.perf_counter`.
        """
        asked = self.solver.solution
        assert asked is not None
        minimal, steps = self.minimal, len(self.trace)
        status, cost = minimal.status, minimal.cost
        maps = tuple(m.map() for m in minimal.maps)
        if status is Status.UNKNOWN and (best := self.drafts.best(self.trace, self._problem.pairs)):
            maps, status, cost = (best,), Status.FEASIBLE, Cost.of(best)
        self._spent += time.perf_counter() - began
        if maps and self._judging.has_time_for(steps, self._spent):
            self._judging.pass_grown_map(self.trace, maps[0])
        was_asked = asked.steps == steps  # at this step
        return Solution(
            status=status,
            maps=maps,
            cost=cost if maps else None,
            bound=asked.bound,
            complete=minimal.complete,
            theory=self.theory,
            steps=steps,
            effort=Effort(
                prefix=asked.effort.prefix,
                seconds=Seconds(
                    time.perf_counter() - began,
                    asked.seconds.ground if was_asked else 0.0,
                    asked.seconds.solve if was_asked else 0.0,
                ),
                evidence=said_by(
                    self._problem.evidence,
                    self.trace,
                    {name: said["refused"] for name, said in asked.effort.evidence.items()},
                ),
            ),
            stopped=None if minimal.complete else asked.stopped,
            support=asked.support,
        )
