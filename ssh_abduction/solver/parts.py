"""Holds the parts of one search: what it knows, its engine, and its progress reports."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable

from ssh_abduction.runtime.loggers import PROGRESS
from ssh_abduction.solver.asp.limits import Stop, Watch
from ssh_abduction.solver.candidates import Candidates
from ssh_abduction.solver.judging import Judging
from ssh_abduction.solver.known import Known
from ssh_abduction.solver.sources.exact import prefixes
from ssh_abduction.solver.sources.exact.backbone import Rivals
from ssh_abduction.solver.sources.exact.choosing import may_name, new_engine
from ssh_abduction.solver.sources.exact.engine import Engine, GrowingEngine, Task
from ssh_abduction.solver.sources.exact.near import NearMinimal
from ssh_abduction.solver.sources.exact.prefixes import Prefixes
from ssh_abduction.solver.sources.exact.readable import StepEngine
from ssh_abduction.solver.start import Limits, Start
from ssh_abduction.solver.values import Bound, Cost, Progress, Status
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.speedups import Speedups


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

    def _engine_after(self, after: Parts) -> Engine:
        """Return the engine of an earlier search if it can take more steps, else a new engine."""
        before = after.prefixes.engine
        is_outgrown = isinstance(before, StepEngine) and may_name(self.task)
        # A search that was interrupted may have stopped while clingo grounded a step.
        is_partial = after.known.stopped == "interrupted" or not before.asker.intact
        if (
            isinstance(before, GrowingEngine)
            and before.grows
            and not is_outgrown
            and not is_partial
        ):
            return before.over(self.task)
        return new_engine(self.task)

    def _take_over(self, after: Parts, start: Start) -> None:
        """Take over the bounds that a search for the first steps proved, and `start.minimal`."""
        known, before = self.known, after.known
        if self.task.speedups.prefixes:
            known.bound, known.lower = before.bound, before.lower
            solved, engine = before.status is Status.OPTIMAL, self.prefixes.engine
            first = engine.size if isinstance(engine, StepEngine) else engine.next_size(engine.size)
            self.prefixes.start = (
                len(self.task.trace) if solved else max(prefixes.FIRST_PREFIX, first)
            )
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
        if self._on_progress is None and not PROGRESS.isEnabledFor(logging.INFO):
            return
        known = self.known
        progress = Progress(
            self.engine.size,
            len(self.task.trace),
            known.best_cost,
            known.bound,
            known.count,
            self.watch.seconds(),
        )
        news = (progress.cost, progress.bound)
        PROGRESS.log(logging.DEBUG if news == self._news else logging.INFO, "%s", progress.sentence)
        self._news = news
        if self._on_progress is not None:
            self._on_progress(progress)
