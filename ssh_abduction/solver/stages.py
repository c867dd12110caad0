"""Find the minimal cost of a trace: fast stages first, and a proof by prefixes at the end."""

from __future__ import annotations

import math

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.runtime.logs import log_of
from ssh_abduction.solver import choosing, prefixes
from ssh_abduction.solver.asp.limits import LimitError, StageTimeError
from ssh_abduction.solver.choosing import may_name, takes_all
from ssh_abduction.solver.engines.base import Found
from ssh_abduction.solver.engines.stepwise import StepEngine
from ssh_abduction.solver.parts import Parts
from ssh_abduction.solver.values import Status
from ssh_abduction.theory.speedups import row

TYPE_CHECKING = False
if TYPE_CHECKING:
    from ssh_abduction.solver.mending import Solver

_log = log_of(__name__)


class Stages:
    """The stages in which one search finds the minimal cost.

    Attributes:
        mends: Whether mending the trace was tried.
        mended_maps: The minimal maps, if mending the trace found them.
    """

    def __init__(self, parts: Parts, solve_mended: Solver, *, goes_on: bool) -> None:
        """No stage has begun.

        Args:
            parts: The parts of the search.
            solve_mended: Solves a mended trace.
            goes_on: Whether the search goes on from one for the first steps.
        """
        self.mends = False
        self.mended_maps: tuple[SSHMap, ...] | None = None
        self._parts, self._solve_mended, self._goes_on = parts, solve_mended, goes_on

    def make_first_map(self) -> None:
        """Make a causal map at once. clingo then has to find a better one."""
        parts = self._parts
        if parts.known.status is not Status.OPTIMAL and (
            len(parts.task.trace) > choosing.FEW_STEPS
        ):
            parts.candidates.merge()

    def find_minimum(self) -> None:
        """Find the minimal cost.

        If this takes long, change to an engine that finds dstates before places and paths.
        """
        parts, task = self._parts, self._parts.task
        engine, steps = parts.prefixes.engine, len(task.trace)
        if row("mending").holds_for(task.theory) and may_name(task) and self._mend():
            return
        if self.mends and steps > choosing.READABLE:
            raise LimitError("no proof")
        if parts.known.status is Status.OPTIMAL:  # another search proved a map minimal
            if not engine.size:
                engine.grow(steps if engine.lists_least else min(steps, prefixes.FIRST_PREFIX))
            return
        may_change = isinstance(engine, StepEngine) and not self._goes_on and takes_all(task)
        may_frame = may_change and task.speedups.framing
        may_settle = may_change and task.speedups.ways and parts.speedups.names
        if (
            may_settle
            and not self._find_minimum_soon(min(choosing.SETTLE_AFTER, choosing.STEPWISE))
            and parts.candidates.sketch_least()
        ):
            self._settle_dstates_first()
        elif (
            (may_frame or may_settle)
            and parts.known.status is Status.UNKNOWN
            and not self._find_minimum_soon(choosing.STEPWISE)
        ):
            _log.info("no minimum after %.1f s step by step", parts.watch.elapsed())
            if may_frame:
                _log.info("maps in which places have frames are sought as candidates")
                parts.candidates.frame(parts.speedups)
            if may_settle:
                self._settle_dstates_first()
        if parts.known.status is Status.UNKNOWN:
            parts.prefixes.find_minimum()

    def _mend(self) -> bool:
        """Look for maps with faults by mending the trace.

        Returns:
            Whether all minimal maps are known.
        """
        from ssh_abduction.solver.mending import Mending  # loads numpy

        parts, known, most = self._parts, self._parts.known, self._parts.limits.most
        self.mends = True
        _log.info("maps with faults are sought by mending the trace")
        mending = Mending(parts.task, self._solve_mended)
        parts.watch.use_reserve()
        try:
            for found in mending.maps():
                parts.candidates.offer(found.map)
                known.raise_bound(mending.bound)
                parts.report()
            # One map more shows whether the list is complete.
            self.mended_maps = mending.minimal_maps(most and most + 1)
        finally:
            known.raise_bound(mending.bound)
            mending.settle()
        if self.mended_maps:
            first = self.mended_maps[0]
            known.status = Status.OPTIMAL
            known.keep(Found.of(first, parts.task.theory), first.labels)
            parts.rivals.reasons = False  # its engines know nothing of mended traces
        return bool(self.mended_maps)

    def _find_minimum_soon(self, seconds: float) -> bool:
        """Try to find the minimal cost step by step within a time.

        Args:
            seconds: The time limit, from the start of the search. The limit is a share of the
                time left if that is less.
        """
        parts, watch = self._parts, self._parts.watch
        watch.end_stage_after(
            watch.elapsed() + min(seconds, choosing.STEPWISE_SHARE * watch.left())
        )
        try:
            parts.prefixes.find_minimum()
        except StageTimeError:
            parts.prefixes.start = max(parts.prefixes.start, parts.engine.size)
            return False
        finally:
            watch.end_stage_after(math.inf)
        return True

    def _settle_dstates_first(self) -> None:
        """If some map is known, go on with an engine that finds dstates first."""
        parts, best = self._parts, self._parts.known.best
        labels = best.labels if best else ()
        parts.candidates.sketch()
        if parts.known.best is not None:
            from ssh_abduction.solver.engines.frameless import FramelessEngine

            _log.info(
                "dstates are settled before places and paths, from a map of %d dstates",
                len(parts.known.best.dstates),
            )
            parts.prefixes.go_on_with(FramelessEngine(parts.task, labels), len(parts.task.trace))
