"""Keep the minimal maps of a growing trace up to date, for a theory that allows no faults.

A fault is a step that a map treats as wrong. A minimal map is kept by replaying it: following its
links along the steps of the trace, as long as it predicts what the robot sees.

A *sketch* (`solver/sources/symbolic/sketch.py`) is made without a search: a step gets a new dstate
(a place and a heading) unless the axioms imply at which known dstate it is. A *draft* is a sketch
that begins with a good map of the first steps. It is used if finding a minimal map takes too long.
A sketch that begins at the first step is mostly larger. It is used if there is no draft.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from ssh_abduction.checker.checker import check, unchecked
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Action, Step, Trace
from ssh_abduction.online.hypotheses import ExtendedMap
from ssh_abduction.solver import (
    Cost,
    Effort,
    Judging,
    Search,
    Seconds,
    Sketch,
    Solution,
    Status,
    Stop,
    observation,
    sketch_beyond,
    sketches_of,
)
from ssh_abduction.theory.evidence import said_by
from ssh_abduction.theory.pairs import Pairs
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.speedups import Speedups, row
from ssh_abduction.theory.theory import Theory

# After a search that was stopped, the trace grows by this factor before the next one, so that few
# steps are slow.
RETRY = 1.01
# It grows by at least this many steps.
PAUSE = 2
# Keep at most this many drafts, as each takes time at every step. Mostly at least one of the best
# drafts remains consistent for long.
DRAFTS = 3


@dataclass(frozen=True, slots=True)
class StepOptions:
    """The limits and speed-ups for solving at each step."""

    # Seconds for each step. A step may take a little longer. None waits for the exact answer.
    time_limit: float | None
    work_limit: float | None  # units of work for each step; None for no limit
    max_maps: int | None  # keep at most this many minimal maps; None keeps all
    speedups: Speedups  # flags that say which speed-ups of the solver to use


class Keeper(ABC):
    """Keeps the maps of a growing trace up to date, by a search at some steps.

    `problem` has the steps so far, and the theory, in which no field is "auto". `before` is the
    keeper of fewer steps that this one replaces; None for the first.
    """

    retry = RETRY  # after a search that was stopped, the trace grows by this factor

    def __init__(self, problem: Problem, options: StepOptions, before: Keeper | None) -> None:
        self._problem, self._options = problem, options
        self._judging = Judging(problem)
        self.searches: int = before.searches if before else 0  # by clingo, so far
        self._next_search = 0  # no search before the trace has this many steps
        self._spent = 0.0  # seconds that all steps took

    def take(self, problem: Problem) -> None:
        """Add the last step: keep the maps that predict it, and drop those that it contradicts."""
        self._problem = problem
        if self._follow():
            self._next_search = 0

    def answer(self, began: float) -> Solution:
        """Search the steps so far if that is due, and return what is known.

        `began` is when the step began, by `time.perf_counter`.
        """
        steps = len(self._problem.trace)
        if not self._is_settled and steps >= self._next_search:
            self.searches += 1
            was_stopped = self._ask() in ("work limit", "time limit", "interrupted")
            self._next_search = max(steps + PAUSE, int(self.retry * steps)) if was_stopped else 0
        return self._solution(began)

    @abstractmethod
    def _follow(self) -> bool:
        """Follow all maps along the last step. Return whether the maps are proven no longer."""

    @property
    @abstractmethod
    def _is_settled(self) -> bool:
        """Whether another search would find nothing new."""

    @abstractmethod
    def _ask(self) -> Stop | None:
        """Search for minimal maps, keep them, and return why the search ended early."""

    @abstractmethod
    def _solution(self, began: float) -> Solution:
        """The solution so far: the minimal maps, else the best map known, else none."""

    def _judge(self, maps: Sequence[SSHMap], began: float) -> None:
        """Let the checker check the first map, unless that takes too long."""
        trace = self._problem.trace
        self._spent += time.perf_counter() - began
        if maps and self._judging.has_time_for(len(trace), self._spent):
            self._judging.pass_grown_map(trace, maps[0])


class MapKeeper(Keeper):
    """Keeps the minimal maps up to date, or the best map that is found in time.

    The theory of `problem` allows no faults.
    """

    standing = None  # only `Recovery`, for theories with faults, has a standing

    def __init__(
        self, problem: Problem, options: StepOptions, before: MapKeeper | None = None
    ) -> None:
        super().__init__(problem, options, before)
        self.minimal = MinimalMaps(problem.trace, problem.theory, self._judging)
        self.drafts = Drafts(problem, self._judging)  # maps that were made without a search
        # The last search, which the next one continues; None before the first.
        self.search: Search | None = None
        self._found: Solution | None = None  # the solution of this search, without its maps

    def restarted(self, problem: Problem) -> MapKeeper:
        """Make a keeper for the theory of `problem`, which changed with the last step.

        The minimal maps so far need not be minimal by the new theory. They become drafts
        (maps to be extended step by step) if the old theory already used displacements.
        """
        keeper = MapKeeper(problem, self._options, before=self)
        if self._problem.theory.displacement == "use":
            for ssh_map in [m.explained() for m in self.minimal.maps[:DRAFTS]] + self.drafts.maps():
                keeper.drafts.add(ssh_map, problem.trace)
        return keeper

    def _follow(self) -> bool:
        problem, trace = self._problem, self._problem.trace
        action = trace.steps[-2].action
        assert action
        if self.minimal.is_impossible:
            return False
        was_proven = self.minimal.status is Status.OPTIMAL
        untried = self.minimal.follow(action, trace, problem.pairs)
        self.drafts.follow(action, trace.steps[-1])
        for rival in untried[:DRAFTS]:
            self.drafts.add(rival.explained(), trace)
        return was_proven and self.minimal.status is Status.UNKNOWN

    @property
    def _is_settled(self) -> bool:
        minimal = self.minimal
        is_complete = minimal.complete or len(minimal.maps) == self._options.max_maps
        return minimal.is_impossible or (minimal.status is Status.OPTIMAL and is_complete)

    def _ask(self) -> Stop | None:
        """Search for minimal maps with clingo and keep them.

        If a minimal map is known, only the others are searched for.
        If maps are replayed, maps without a proof do not replace the known ones. The best of them
        becomes a draft, which later steps extend.
        """
        trace, options = self._problem.trace, self._options
        is_proven = self.minimal.status is Status.OPTIMAL
        search = Search.continuing(
            self.search,
            trace,
            self._problem.theory,
            time_limit=options.time_limit,
            work_limit=options.work_limit,
            max_maps=options.max_maps,
            speedups=options.speedups,
            minimal=self.minimal.maps[0].explained() if is_proven else None,
        )
        # The maps are not ranked, as ranking takes longer than a step may.
        found = tuple(search.unranked())
        said = search.solution()
        self.search, self._found = search, said
        proves = said.status in (Status.OPTIMAL, Status.UNSATISFIABLE)
        if proves or not self.minimal.replays:
            self.minimal.replace(found, said.status, said.complete, said.cost)
            self.drafts.clear()
        elif found:
            self.drafts.add(found[0], trace)
        return search.stopped

    def _solution(self, began: float) -> Solution:
        asked = self._found
        assert asked is not None
        minimal, trace, steps = self.minimal, self._problem.trace, len(self._problem.trace)
        status, cost = minimal.status, minimal.cost
        maps = tuple(m.explained() for m in minimal.maps)
        if status is Status.UNKNOWN and (best := self.drafts.best(trace, self._problem.pairs)):
            maps, status, cost = (best,), Status.FEASIBLE, Cost.of(best)
        self._judge(maps, began)
        was_asked = asked.steps == steps  # at this step
        return Solution(
            status=status,
            maps=maps,
            cost=cost if maps else None,
            bound=asked.bound,
            complete=minimal.complete,
            theory=self._problem.theory,
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
                    trace,
                    self._problem.theory,
                    {name: said["refused"] for name, said in asked.effort.evidence.items()},
                ),
            ),
            stopped=None if minimal.complete else asked.stopped,
            support=asked.support,
        )


@dataclass(slots=True)
class Draft:
    """A sketch (a map made without a search), and how far the evidence has tested it."""

    sketch: Sketch
    passed: int = 0  # the number of first steps for which no evidence rejected it


class Drafts:
    """Keeps drafts and sketches: maps of the steps so far that were made without a search."""

    def __init__(self, problem: Problem, judging: Judging) -> None:
        trace, theory, evidence = problem.trace, problem.theory, problem.evidence
        self._theory, self._judging = theory, judging
        self._has_evidence = bool(evidence)
        # Evidence judges a sketch as it grows. The other axioms hold by construction, or the
        # checker judges them.
        self._other_axioms = theory.replace(
            without=(*theory.without, *(kind.axiom for kind in evidence))
        )
        self._may_sketch = row("prefixes").holds_for(theory) and not unchecked(theory)
        self._trusts_sketches = row("certain sketches").holds_for(self._other_axioms)
        self._drafts: list[Draft] = []  # the best first
        self._sketches = [Draft(sketch) for sketch in sketches_of(trace.steps[0], theory)]
        for before, step in pairwise(trace.steps):
            assert before.action
            self._sketches = [
                draft for draft in self._sketches if draft.sketch.extend(before.action, step)
            ]

    def maps(self) -> list[SSHMap]:
        """Return the maps of all drafts, the best first. These maps need not be consistent."""
        return [draft.sketch.map() for draft in self._drafts]

    def follow(self, action: Action, step: Step) -> None:
        """Extend drafts and sketches by a step, and drop those that the step contradicts."""
        self._drafts = [draft for draft in self._drafts if draft.sketch.extend(action, step)]
        self._sketches = [draft for draft in self._sketches if draft.sketch.extend(action, step)]

    def add(self, ssh_map: SSHMap, trace: Trace) -> None:
        """Extend a map of the first steps to a draft of all steps, unless a step contradicts it."""
        if not self._may_sketch:
            return
        known = len(ssh_map.dstate_at)
        sketch = sketch_beyond(ssh_map, trace.prefix(known), self._theory)
        later = zip(trace.actions[known - 1 :], trace.steps[known:], strict=True)
        if all(sketch.extend(action, step) for action, step in later):
            self._drafts = sorted([*self._drafts, Draft(sketch)], key=self._cost)[:DRAFTS]

    def clear(self) -> None:
        """Drop all drafts. The sketches stay."""
        self._drafts = []

    def best(self, trace: Trace, pairs: Pairs) -> SSHMap | None:
        """Return the map of the best consistent draft, else of a consistent sketch, else None.

        `pairs` is what the evidence says about pairs of these steps. Drafts that turn out
        to be inconsistent are dropped.
        """
        while self._drafts:
            if self._is_consistent(self._drafts[0], trace, pairs):
                return self._drafts[0].sketch.map()
            del self._drafts[0]
        if self._may_sketch:
            for draft in self._sketches:
                if self._is_consistent(draft, trace, pairs):
                    return draft.sketch.map()
        return None

    def _cost(self, draft: Draft) -> tuple[int, ...]:
        """Return the counts that the theory minimises, for the map of a draft."""
        return Cost.of(draft.sketch.map()).preferred_by(self._theory)

    def _is_consistent(self, draft: Draft, trace: Trace, pairs: Pairs) -> bool:
        """Whether the map of a draft satisfies the evidence and all other axioms."""
        sketch, steps = draft.sketch, len(trace)
        if self._has_evidence and draft.passed < steps:
            ssh_map = sketch.map()
            place_of = [s.place for s in ssh_map.dstates]
            new = range(draft.passed, steps)
            if not all(pairs.allow(t, sketch.labels, place_of) for t in new):
                return False
            if not self._judging.allows_grown(trace, ssh_map, draft.passed):
                return False
            draft.passed = steps
        if not sketch.certain or not self._trusts_sketches:
            sketch.certain = not check(trace, sketch.map(), self._other_axioms)
        return sketch.certain


class MinimalMaps:
    """The minimal maps of the steps so far, with how much is proven about them."""

    def __init__(self, trace: Trace, theory: Theory, judging: Judging) -> None:
        # The minimal maps. If `replays` is false, the maps that clingo found last, which may not be
        # proven minimal.
        self.maps: list[ExtendedMap] = []
        self.status = Status.UNKNOWN  # UNKNOWN until clingo has proven which maps are minimal
        self.complete = False  # whether `maps` are all minimal maps
        self.cost: Cost | None = None  # the counts of a minimal map; None if they are unknown
        # Whether the claim in `mapper.py` holds for the theory, so that maps are replayed.
        self.replays = row("prefixes").holds_for(theory)
        self._trace, self._theory, self._judging = trace, theory, judging

    def follow(self, action: Action, trace: Trace, pairs: Pairs) -> list[ExtendedMap]:
        """Keep the maps that predict the last step. If none does, reset the status to UNKNOWN.

        `trace` has this step, and `action` led to it. If no map is kept, return the maps
        that have no link for the action, else an empty list.
        """
        self._trace, seen = trace, observation(trace.steps[-1], self._theory)
        untried = [m for m in self.maps if m.is_unknown(action.name)]
        longer = (m.predicting(action.name, seen) for m in self.maps)
        self.maps = [m for m in longer if m and m.is_allowed(trace, pairs, self._judging)]
        # A map without a link for the action may be extended to further minimal maps.
        self.complete = self.complete and not untried
        if not self.replays:
            self.maps = []
        if self.maps:
            return []
        self.status, self.complete = Status.UNKNOWN, False
        return untried

    def replace(
        self, found: Iterable[SSHMap], status: Status, complete: bool, cost: Cost | None
    ) -> None:
        """Take the result of a search. Keep the known minimal maps if the search listed fewer.

        `complete` says whether these are all minimal maps. `cost` has the counts of a minimal map,
        if there is one.
        """
        maps, was_proven = list(found), self.status is Status.OPTIMAL
        self.status, self.complete, self.cost = status, complete, cost
        if len(maps) >= len(self.maps) or not was_proven:
            self.maps = [ExtendedMap.of(m, self._trace, self._theory) for m in maps]

    @property
    def is_impossible(self) -> bool:
        """Whether it is proven that these steps have no map, however the trace goes on."""
        return self.status is Status.UNSATISFIABLE and self.replays
