"""The parts of one search: its limits and its begin, what its sources share, and its answer."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

from ssh_abduction.data.checks import a_count_of_maps, a_flag, check_limit
from ssh_abduction.data.errors import SolverError, brief, is_whole
from ssh_abduction.data.groups import numbered
from ssh_abduction.data.maps import SSHMap, checked_map, checked_maps
from ssh_abduction.runtime.limits import Stop, Watch
from ssh_abduction.runtime.loggers import PROGRESS, log_progress
from ssh_abduction.solution.recorded import Support
from ssh_abduction.solution.result import Solution
from ssh_abduction.solution.values import (
    Bound,
    Cost,
    Effort,
    Grounding,
    Level,
    Progress,
    Seconds,
    Status,
    cost_as_counted,
)
from ssh_abduction.solver.asp.kept_rules import never_true
from ssh_abduction.solver.board import Judging, Known
from ssh_abduction.solver.candidates import Candidates
from ssh_abduction.solver.geometry.ranking import in_order, noise_warning, units_warning
from ssh_abduction.solver.sources.exact import prefixes
from ssh_abduction.solver.sources.exact.choosing import NearMinimal, may_name, new_engine
from ssh_abduction.solver.sources.exact.engine import Engine, GrowingEngine, Task
from ssh_abduction.solver.sources.exact.prefixes import Prefixes, Rivals
from ssh_abduction.solver.sources.exact.readable import StepEngine
from ssh_abduction.solver.steps.clique_basis import CliqueBasis
from ssh_abduction.theory.evidence import said_by
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.speedups import Speedups, row

Priced: TypeAlias = tuple[SSHMap, tuple[int, ...]]
"""A map and its preferred counts, the most important one first; equal in all maps of a level."""


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits of a search.

    Attributes:
        time_limit: Seconds of wall-clock time; None for no limit.
        memory_limit: MiB that the process may use at its peak; None for no limit.
        max_maps: The number of maps to list at most; None for all.
        work_limit: Units of work, each about a second of a quiet core; None for no limit.
        within: The number of dstates above the minimum that a listed map may have.

    Raises:
        SolverError: A value is out of range.
    """

    time_limit: float | None = None
    memory_limit: int | None = None
    max_maps: int | None = None
    within: int = 0
    work_limit: float | None = None

    def __post_init__(self) -> None:
        a_count_of_maps(self.max_maps, SolverError)
        if not is_whole(self.within) or self.within < 0:
            raise SolverError(
                "within (--set within=K): expected a whole number, 0 or more, got "
                f"{brief(self.within)}; give how much more than a minimal map others may cost"
            )
        check_limit("time_limit (--time-limit)", "seconds", self.time_limit)
        check_limit("work_limit (--work-limit)", "units of work", self.work_limit)
        check_limit("memory_limit (--memory-limit)", "MiB", self.memory_limit)

    @property
    def most(self) -> int:
        """The number of maps to list at most; 0 for all."""
        return self.max_maps or 0

    def of_part(self, most: float) -> dict[str, float | int | None]:
        """Return the limits of a search inside this one that may take this much, as arguments.

        `most` is in units of work if there is a work limit, else in seconds.
        """
        limit = "time_limit" if self.work_limit is None else "work_limit"
        return {limit: None if most == math.inf else most, "memory_limit": self.memory_limit}


@dataclass(frozen=True, slots=True)
class Start:
    """The starting point of a search, and whether it proves the backbone at its end.

    Other modules need this class. Users of the package do not.

    Attributes:
        reasons: Whether to prove at the end what all minimal maps share, if not all are listed. A
            share of the time limit is kept for that.
        after: The parts of an ended search for the first steps of the trace, to take over its
            grounding and its proofs; None to begin anew.
        minimal: A map of the trace that costs what `after` proved to be minimal; None if there is
            none. With such a map, the search only lists maps.
        known: Maps of the trace that an earlier search found. The search begins with those that
            the checker accepts, so that its best map costs no more than they do.
        around: The watch of a search that this search is a part of. Its limits hold here, too.
    """

    reasons: bool = False
    after: Parts | None = None
    minimal: SSHMap | None = None
    known: tuple[SSHMap, ...] = ()
    around: Watch | None = None

    def __post_init__(self) -> None:
        a_flag("reasons", self.reasons, SolverError)
        if self.minimal is not None:
            checked_map(self.minimal, "minimal")
        checked_maps(self.known)


class Parts:
    """The objects that all stages of one search share.

    Attributes:
        speedups: The speed-ups that the caller has switched on. `task.speedups` has only those
            of them that hold for the theory.
        watch: The clock of the search, with its limits.
        task: The trace and theory, as engines see them.
        known: What is known about the maps of the trace so far.
        rivals: The minimal maps found so far.
        candidates: Makes maps without a proof that they are minimal.
        prefixes: Finds and lists minimal maps.
        near: Lists maps that cost more than the minimum; None before that stage.
    """

    def __init__(
        self,
        problem: Problem,
        limits: Limits,
        speedups: Speedups,
        on_progress: Callable[[Progress], None] | None,
        start: Start,
        began: float,
    ) -> None:
        self.limits, self.speedups = limits, speedups
        self.watch = Watch(
            limits.time_limit,
            limits.memory_limit,
            self.report,
            work=limits.work_limit,
            around=start.around,
        )
        self._on_progress = on_progress
        # The search around this one reports for both, so that no number goes back.
        self._is_part = start.around is not None
        self._news: tuple[Cost | None, Bound] = (None, Bound())  # what the last report said
        self.watch.start(began)  # settling the theory compares pairs of steps, which may take long
        self.task = Task.of(problem, self.watch, speedups)
        self.known = Known(problem.theory)
        self.watch.lacks_map = lambda: self.known.best is None
        self.judging = Judging(problem)
        self.rivals = Rivals(self.task, self.judging)
        self.candidates = Candidates(self.task, self.known, self.judging, self.report)
        self.near: NearMinimal | None = None
        engine = self._engine_after(start.after) if start.after else new_engine(self.task)
        self.prefixes = Prefixes(
            self.task, self.known, self.judging, engine, limits.most, self.report
        )
        if start.after:
            self._take_over(start.after, start)
        self.watch.stop()

    @cached_property
    def silent(self) -> tuple[str, ...]:
        """Warnings of rules of the user that have no effect."""
        return tuple(never_true(self.task.problem))

    def _engine_after(self, after: Parts) -> Engine:
        """Return the engine of an earlier search if it can take more steps, else a new engine."""
        before = after.prefixes.engine
        # A search that was interrupted may have stopped while clingo grounded a step.
        is_whole = after.known.stopped != "interrupted" and before.asker.intact
        is_outgrown = isinstance(before, StepEngine) and may_name(self.task)
        if is_whole and not is_outgrown and isinstance(before, GrowingEngine) and before.grows:
            return before.over(self.task)
        return new_engine(self.task)

    def _take_over(self, after: Parts, start: Start) -> None:
        """Take over the bounds that a search for the first steps proved, and `start.minimal`."""
        known, before = self.known, after.known
        if self.task.speedups.prefixes:
            known.bound, known.lower = before.bound, before.lower
            engine = self.prefixes.engine
            first = engine.size if isinstance(engine, StepEngine) else engine.next_size(engine.size)
            is_solved = before.status is Status.OPTIMAL
            least = len(self.task.trace) if is_solved else prefixes.FIRST_PREFIX
            self.prefixes.start = least if is_solved else max(least, first)
        if start.minimal is not None:
            known.status, known.best, known.cost = Status.OPTIMAL, start.minimal, before.cost
            known.raise_bound(known.cost[0] if known.cost else None)

    @property
    def limit_reached(self) -> Stop:
        """Which limit ends a search whose time is over."""
        return "work limit" if self.watch.counts_work else "time limit"

    @property
    def engine(self) -> Engine:
        """The engine that was used last."""
        return self.near.engine if self.near else self.prefixes.engine

    def end_clingo(self) -> None:
        """Stop clingo and the clock, and take over the bound that clingo proved."""
        self.watch.stage_ends = math.inf
        self.watch.stop()
        engine = self.prefixes.engine
        self.known.raise_bound(engine.bound)
        self.rivals.engine = None if self.rivals.listed or not engine.asker.intact else engine

    def report(self) -> None:
        """Log how far the search is, and call the caller's `on_progress`."""
        is_read = self._on_progress is not None or PROGRESS.isEnabledFor(logging.INFO)
        if self._is_part or not is_read:
            return
        known, watch, left = self.known, self.watch, self.watch.left()
        progress = Progress(
            self.engine.size,
            len(self.task.trace),
            known.best_cost,
            known.bound,
            known.count,
            watch.seconds(),
            (watch.elapsed(), left) if watch.counts_work and left < math.inf else None,
        )
        news = (progress.cost, progress.bound)
        log_progress(progress.sentence, logging.DEBUG if news == self._news else logging.INFO)
        self._news = news
        if self._on_progress is not None:
            self._on_progress(progress)


class Answer:
    """Collects what a `Solution` says about the maps that a search gave: levels, cost, bound."""

    def __init__(self, parts: Parts) -> None:
        self._parts = parts
        self._levels: list[Level] = []
        self._first: SSHMap | None = None
        self._last: tuple[SSHMap, tuple[int, ...]] | None = None
        # The data for a certificate of the whole trace, if the search was stopped.
        self._basis: CliqueBasis | None = None

    @property
    def cost(self) -> Cost | None:
        """The cost of the last map given; None before the first one."""
        return None if self._last is None else cost_as_counted(*self._last, self._parts.task.theory)

    def take_down(self, ssh_map: SSHMap, cost: tuple[int, ...]) -> None:
        """Add a map that the caller got to its level (the maps of one cost, in counts)."""
        if self._last is None or self._last[1] != cost:
            self._levels.append(Level(cost_as_counted(ssh_map, cost, self._parts.task.theory), 0))
        self._first, self._last = self._first or ssh_map, (ssh_map, cost)
        self._levels[-1] = replace(self._levels[-1], count=self._levels[-1].count + 1)

    def count_apart(self) -> None:
        """Raise the lower bound on dstates to the size of a set of pairwise distinct steps."""
        known = self._parts.known
        self._basis = self._basis_of(len(self._parts.task.trace))
        if self._basis:
            apart = len(self._basis.certificate.clique)
            known.bound = replace(known.bound, dstates=max(apart, known.bound.dstates or 0))

    def solution(self, maps: tuple[SSHMap, ...], grounding: Grounding | None = None) -> Solution:
        """Make the solution that lists these maps, which the caller kept, in this order.

        `grounding` is the size of the ground program; None to ask clingo for it.
        """
        parts, known, task = self._parts, self._parts.known, self._parts.task
        levels = tuple(replace(level, complete=parts.rivals.listed) for level in self._levels)
        asker = parts.engine.asker
        seconds = Seconds(parts.watch.seconds(), asker.ground_seconds, asker.solve_seconds)
        # If a limit came before the pairs of steps were compared, the evidence said nothing yet.
        is_said = task.log.has_pairs or known.stopped is None
        kinds = task.problem.evidence if is_said else ()
        return Solution(
            status=known.status,
            maps=maps,
            cost=levels[0].cost if levels else known.best_cost,
            bound=known.bound,
            complete=known.complete,
            theory=task.theory,
            steps=len(task.trace),
            effort=Effort(
                parts.engine.size,
                seconds,
                asker.grounding if grounding is None else grounding,
                said_by(kinds, task.trace, task.theory, known.refused),
                parts.watch.elapsed() if parts.watch.counts_work else None,
            ),
            stopped=known.stopped,
            partial=None if known.best else known.partial,
            within=parts.limits.within,
            levels=levels,
            shared=parts.rivals.backbone,
            trace=task.trace,
            support=self._support(),
        )

    def _support(self) -> Support:
        """Collect the data for the certificate, and the warning about the odometry."""
        parts, trace = self._parts, self._parts.task.trace
        # A search that reached a limit may have ended while clingo grounded the prefix. Then prove
        # the bound from all steps.
        ran_out = parts.known.stopped not in (None, "maps limit")
        size = len(trace) if ran_out else parts.prefixes.engine.size
        warning = None
        if self._first and self._first.fit:
            warning = units_warning(trace) or noise_warning(self._first, trace)
        return Support(self._basis or self._basis_of(size)).warning_of(warning, *parts.silent)

    def in_order(self, maps: tuple[SSHMap, ...]) -> tuple[SSHMap, ...]:
        """Sort the maps of each level into an order that is the same in each run.

        Return the maps unsorted if the caller did not keep all of them, or if the list of minimal
        maps is incomplete. Maps of a level may differ in counts that the theory does not minimise.
        So each level then gets the cost of its new first map.
        """
        parts, theory = self._parts, self._parts.task.theory
        is_all = parts.known.complete or parts.rivals.listed
        if not is_all or not maps or len(maps) < sum(level.count for level in self._levels):
            return maps
        ordered = in_order(maps, [level.count for level in self._levels])
        begin = 0
        for i, level in enumerate(self._levels):
            cost = level.cost.preferred_by(theory)
            self._levels[i] = replace(level, cost=cost_as_counted(ordered[begin], cost, theory))
            begin += level.count
        return ordered

    def _basis_of(self, size: int) -> CliqueBasis | None:
        """Collect the data for a certificate; None if the theory lacks an axiom that it needs."""
        task = self._parts.task
        if not row("clique").holds_for(task.theory):
            return None
        views = tuple(numbered(task.trace.views[: max(size, 1)]))
        actions = tuple(task.log.actions[: len(views) - 1])
        return CliqueBasis(views, actions, self._parts.known.bound.dstates or 0)
