"""The sources of a search that counts maps, and the maps that it lists.

Fast methods come first: faults are found by mending the trace, and short turns of the search by
prefixes solve most traces. Then a map is known, and the exact search proves the minimum.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.runtime.clock import each_looking
from ssh_abduction.runtime.limits import LimitError, StageTimeError
from ssh_abduction.runtime.loggers import log_of
from ssh_abduction.solution.values import Found, Status
from ssh_abduction.solver.parts import Parts, Priced
from ssh_abduction.solver.schedule import Source, turn
from ssh_abduction.solver.sources.exact import prefixes
from ssh_abduction.solver.sources.exact.choosing import (
    READABLE,
    NearMinimal,
    counted_first,
    may_name,
    takes_all,
)
from ssh_abduction.solver.sources.exact.readable import StepEngine
from ssh_abduction.theory.speedups import row

TYPE_CHECKING = False
if TYPE_CHECKING:
    from ssh_abduction.solver.mending import Solver

_log = log_of(__name__)

# Without own rules, list at most this many minimal maps if all are wanted.
RELAXED = 1000


class Counting:
    """Finds the minimal counts of maps in one search, and lists the maps that have them."""

    def __init__(self, parts: Parts, solve_part: Solver, *, goes_on: bool) -> None:
        """Prepare the search. The results are added to `parts.known`.

        If `goes_on`, the search goes on from an earlier search for the first steps.
        """
        self._parts, self._solve_part, self._goes_on = parts, solve_part, goes_on
        # The minimal maps of a mended trace or of fewer rules, and whether they are all.
        self._minimal: tuple[tuple[SSHMap, ...], bool] | None = None

    def sources(self) -> Iterator[Source]:
        """Yield the sources in the order of the schedule, until the minimal cost is known.

        Raises LimitError with the reason "no proof" if mending the trace found no proof, and the
        trace is too long for the readable encodings.
        """
        parts, task = self._parts, self._parts.task
        engine, steps = parts.prefixes.engine, len(task.trace)
        # 1. Faults of maps with places: mend the trace. Without names, only the readable encodings
        #    find such faults.
        mends = row("mending").holds_for(task.theory) and may_name(task)
        if mends:
            yield Source(turn("mending"), lambda: True, self._mend)
            if self._minimal:
                return
        finds = task.theory.has_faults and task.theory.level == "topological"
        if (mends or finds) and steps > READABLE:
            raise LimitError("no proof")
        # 2. Rules of the user only exclude maps, but no fast method knows them.
        if task.theory.rules and parts.judging.can_accept and not self._goes_on:
            # Without rules, maps show no paths if no axiom is about them.
            shows_all = task.theory.has_paths == task.theory.replace(rules=()).has_paths
            may_relax = shows_all and not (task.theory.has_faults or parts.limits.within)
            yield Source(turn("maps without own rules"), lambda: may_relax, self._relax)
            if self._minimal:
                return
        # 3. An earlier search may have proved a map minimal.
        if parts.known.status is Status.OPTIMAL:
            if not engine.size:
                lists = task.theory.level == "topological" and not isinstance(engine, StepEngine)
                engine.grow(steps if lists else min(steps, prefixes.FIRST_PREFIX))
            return
        # 4. Go on by prefixes for a short time, then with the dstates of some map.
        may_change = isinstance(engine, StepEngine) and not self._goes_on and takes_all(task)
        may_frame = may_change and task.speedups.framing
        may_settle = may_change and task.speedups.ways and parts.speedups.names
        if may_frame or may_settle:
            yield Source(turn("prefixes"), self._is_open, self._find)
            if self._is_open() and may_frame:
                _log.info("looking for maps in which places have frames, as candidates")
                parts.candidates.frame(parts.speedups)
            if self._is_open() and may_settle:
                self._settle_dstates_first()
        # 5. The proof.
        yield Source(turn("exact search"), self._is_open, self._find)

    def maps(self) -> Generator[Priced, None, None]:
        """Yield the minimal maps with their counts, then those with up to `within` dstates more."""
        parts, known, limits = self._parts, self._parts.known, self._parts.limits
        minimal, is_all = self._minimal or (parts.prefixes.minimal_maps(), True)
        yield from ((ssh_map, known.cost) for ssh_map in minimal)
        if not is_all:
            raise StageTimeError
        parts.rivals.listed = True  # so the backbone needs no further search
        if not limits.most or known.count < limits.most:
            parts.watch.stage_ends = math.inf
        if limits.within and counted_first(parts.task.theory):
            asker = parts.prefixes.engine.asker
            parts.near = NearMinimal(parts.task, parts.judging, limits.most, parts.report, asker)
            yield from parts.near.maps(known.cost, limits.within)

    def _is_open(self) -> bool:
        """Whether the minimal cost is still unknown."""
        return self._parts.known.status is Status.UNKNOWN

    def _find(self) -> None:
        """Find the minimal cost by growing prefixes. A later turn goes on where this one ends."""
        search = self._parts.prefixes
        try:
            search.find_minimum()
        finally:
            search.start = max(search.start, search.engine.size)

    def _mend(self) -> None:
        """Look for maps by mending the trace, and prove that they are minimal if possible."""
        from ssh_abduction.solver.mending import Mending  # loads numpy

        parts, known, most = self._parts, self._parts.known, self._parts.limits.most
        mending = Mending(parts.task, self._solve_part)
        try:
            for found in mending.maps():
                parts.candidates.offer(found.map)
                known.raise_bound(mending.bound)
                parts.report()
            # Ask for one map more than wanted, to know whether the list is complete.
            self._minimal = mending.minimal_maps(most and most + 1)
        finally:
            known.raise_bound(mending.bound)
        if self._minimal:
            self._keep_minimal(self._minimal)
            parts.rivals.reasons = False  # engines do not know mended traces

    def _keep_minimal(self, found: tuple[tuple[SSHMap, ...], bool]) -> None:
        """Keep minimal maps that were proven minimal for another trace or theory."""
        self._minimal, known, first = found, self._parts.known, found[0][0]
        known.status = Status.OPTIMAL
        known.keep(Found.of(first, self._parts.task.theory), first.dstate_at)

    def _relax(self) -> None:
        """Solve the trace without the rules of the user. Minimal maps that obey them stay minimal.

        If no minimal map obeys the rules, the least count is still a lower bound.
        """
        parts, known, task = self._parts, self._parts.known, self._parts.task
        most, theory = parts.limits.most or RELAXED, task.theory.replace(rules=())
        maps, proven = self._solve_part(task.trace, theory, most + 1, parts.watch.left())
        obeying = [ssh_map for ssh_map in each_looking(maps) if parts.judging.accepts(ssh_map)]
        if proven and maps:
            first = Found.of(maps[0], task.theory)
            known.raise_bound(first.cost[0] if first.cost else None)
        if proven and obeying and len(maps) <= most:
            self._keep_minimal((tuple(obeying), True))
        elif obeying:
            parts.candidates.offer(obeying[0])

    def _settle_dstates_first(self) -> None:
        """If a map is known, continue from it with an engine that finds dstates first."""
        parts, best = self._parts, self._parts.known.best
        labels = best.dstate_at if best else ()
        parts.candidates.sketch()
        if parts.known.best is not None:
            from ssh_abduction.solver.sources.exact.labels_first import LabelsFirst

            _log.info("finding dstates before places and paths")
            parts.prefixes.engine = LabelsFirst(parts.task, labels)
            parts.prefixes.start = len(parts.task.trace)
