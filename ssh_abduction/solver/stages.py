"""Find the minimal cost of a trace: try fast methods first, then prove it by prefixes."""

from __future__ import annotations

from contextlib import suppress

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.runtime.loggers import log_of
from ssh_abduction.solver.asp.limits import LimitError, StageTimeError
from ssh_abduction.solver.parts import Parts
from ssh_abduction.solver.schedule import turn
from ssh_abduction.solver.sources.exact import choosing, prefixes
from ssh_abduction.solver.sources.exact.choosing import may_name, takes_all
from ssh_abduction.solver.sources.exact.engine import LabellingEngine
from ssh_abduction.solver.sources.exact.readable import StepEngine
from ssh_abduction.solver.values import Found, Status
from ssh_abduction.theory.speedups import row

TYPE_CHECKING = False
if TYPE_CHECKING:
    from ssh_abduction.solver.mending import Solver

_log = log_of(__name__)


class Stages:
    """Runs the stages in which one search finds the minimal cost.

    Attributes:
        mended_maps: Minimal maps that mending the trace found, and whether they are all; else None.
    """

    def __init__(self, parts: Parts, solve_mended: Solver, *, goes_on: bool) -> None:
        """Prepare the stages, but begin none. The results are added to `parts.known`.

        If `goes_on`, the search goes on from an earlier search for the first steps.
        """
        self.mended_maps: tuple[tuple[SSHMap, ...], bool] | None = None
        self._parts, self._solve_mended, self._goes_on = parts, solve_mended, goes_on

    def make_first_map(self) -> None:
        """Make a map quickly if the theory is causal. Clingo then has to find a better one."""
        parts = self._parts
        if parts.known.status is not Status.OPTIMAL and (
            len(parts.task.trace) > choosing.FEW_STEPS
        ):
            parts.candidates.merge()

    def find_minimum(self) -> None:
        """Find the minimal cost, and set the status in `parts.known`.

        If this takes long, change to an engine that finds dstates before places and paths. Raises
        LimitError at a limit. Its reason is "no proof" if mending the trace found no proof and the
        trace is too long for the readable encodings.
        """
        parts, task = self._parts, self._parts.task
        engine, steps = parts.prefixes.engine, len(task.trace)
        mends = row("mending").holds_for(task.theory) and may_name(task)
        if mends and self._mend():
            return
        # Otherwise only the readable encodings find faults of maps with places.
        finds = task.theory.has_faults and task.theory.level == "topological"
        if (mends or finds) and steps > choosing.READABLE:
            raise LimitError("no proof")
        if parts.known.status is Status.OPTIMAL:  # an earlier search proved a map minimal
            if not engine.size:
                engine.grow(
                    steps
                    if isinstance(engine, LabellingEngine) and engine.lists_labels
                    else min(steps, prefixes.FIRST_PREFIX)
                )
            return
        may_change = isinstance(engine, StepEngine) and not self._goes_on and takes_all(task)
        may_frame = may_change and task.speedups.framing
        may_settle = may_change and task.speedups.ways and parts.speedups.names
        if (
            may_settle
            and not self._find_minimum_soon("prefixes, first try")
            and parts.candidates.sketch_least()
        ):
            self._settle_dstates_first()
        elif (
            (may_frame or may_settle)
            and parts.known.status is Status.UNKNOWN
            and not self._find_minimum_soon("prefixes, second try")
        ):
            _log.info("no minimal map after %.1f s step by step", parts.watch.seconds())
            if may_frame:
                _log.info("looking for maps in which places have frames, as candidates")
                parts.candidates.frame(parts.speedups)
            if may_settle:
                self._settle_dstates_first()
        if parts.known.status is Status.UNKNOWN:
            parts.prefixes.find_minimum()

    def find_fewest(self) -> None:
        """Find the minimal counts as `find_minimum` does, if a proof is possible."""
        try:
            self.find_minimum()
        except LimitError as limit:
            if limit.reason != "no proof":
                raise

    def _mend(self) -> bool:
        """Look for maps by mending the trace. Return whether minimal ones were found and proven."""
        from ssh_abduction.solver.mending import Mending  # loads numpy

        parts, known, most = self._parts, self._parts.known, self._parts.limits.most
        _log.info("looking for maps with faults by mending the trace")
        mending = Mending(parts.task, self._solve_mended)
        try:
            for found in mending.maps():
                parts.candidates.offer(found.map)
                known.raise_bound(mending.bound)
                parts.report()
            # Ask for one map more than wanted, to know whether the list is complete.
            self.mended_maps = mending.minimal_maps(most and most + 1)
        finally:
            known.raise_bound(mending.bound)
        if self.mended_maps:
            first = self.mended_maps[0][0]
            known.status = Status.OPTIMAL
            known.keep(Found.of(first, parts.task.theory), first.dstate_at)
            parts.rivals.reasons = False  # engines do not know mended traces
        return bool(self.mended_maps)

    def _find_minimum_soon(self, name: str) -> bool:
        """Find the minimal cost by growing prefixes in a turn. Return False if it takes longer."""
        parts, watch = self._parts, self._parts.watch
        with suppress(StageTimeError), watch.stage(turn(name).ends(watch)):
            parts.prefixes.find_minimum()
            return True
        parts.prefixes.start = max(parts.prefixes.start, parts.engine.size)
        return False

    def _settle_dstates_first(self) -> None:
        """If a map is known, continue from it with an engine that finds dstates first."""
        parts, best = self._parts, self._parts.known.best
        labels = best.dstate_at if best else ()
        parts.candidates.sketch()
        if parts.known.best is not None:
            from ssh_abduction.solver.sources.exact.labels_first import LabelsFirst

            _log.info(
                "finding dstates before places and paths, from a map of %d dstates",
                len(parts.known.best.dstates),
            )
            parts.prefixes.engine = LabelsFirst(parts.task, labels)
            parts.prefixes.start = len(parts.task.trace)
