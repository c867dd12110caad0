"""Guess maps of little cost: by poses that fit all closures, by joining drives, and by beams.

Places are first merged at poses that fit all closures (`sources/metric/overlay.py`). After a long
way this is better than a beam of hypotheses, which goes through the trace once. Then come beams,
narrow ones first. The places of the best map of a broad beam are merged in the same way.

Closures may be false. Places are merged under several explanations of the closures
(`geometry/fit.py`), before any beam. A beam believes the closures that the best map believes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Set
from contextlib import suppress
from dataclasses import replace

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.runtime.limits import StageTimeError
from ssh_abduction.solution.values import Status
from ssh_abduction.solution.weighed import EQUAL
from ssh_abduction.solver.costs.estimating import dstates_and_places
from ssh_abduction.solver.costs.misfit import Misfit
from ssh_abduction.solver.parts import Parts
from ssh_abduction.solver.schedule import Source, turn
from ssh_abduction.solver.sources.metric.beam import Beam
from ssh_abduction.solver.sources.metric.joint_drives import Joining
from ssh_abduction.solver.sources.metric.overlay import smoothed_map
from ssh_abduction.solver.steps.faults import faults_of, with_more_faults
from ssh_abduction.theory.prior import spreads_of

# The numbers of hypotheses of the beams, in their order.
WIDTHS = (1, 4, 16)
# Places are merged, and closures explained better, in maps that cost at most this many nats more
# than the best one.
TRIED = 20.0
# A beam of this width or more nearly always ends with the map of least cost.
BROAD = 4


class Beams:
    """The guesses of one search, and what they say about the best map.

    Attributes:
        broken: How many nats the best map that breaks axioms costs less than the best map, as in
            `Weighed`; 0 if it does not cost less, -inf if no such map was sought.
    """

    def __init__(
        self,
        parts: Parts,
        misfit: Misfit,
        add: Callable[[SSHMap], float],
        best: Callable[[], float],
        believed: Callable[[], Set[int]],
    ) -> None:
        """Prepare the guesses.

        `add` returns the cost of a map in nats, and keeps the map if this cost is small. `best`
        returns the cost of the best map, and `believed` which closures it believes.
        """
        self._parts, self._misfit, self._add = parts, misfit, add
        self._nats, self._believed = best, believed
        self._is_log = bool(spreads_of(parts.task.trace).any())
        # The cost of the best map of smoothing or a broad beam, and the estimate of it by a beam.
        self._best = math.inf, math.inf
        self.broken = -math.inf
        self._ended: Beam | None = None  # the widest beam that ended
        self._whole: Set[int] | None = None  # the closures of a beam that dropped nothing
        self._first = math.inf  # the time of the first beam
        self._joining: Joining | None = None  # the joint drives, once they are joined
        self._has_joined = False  # whether the maps of single drives gave a map of one piece

    def found(self, nats: float) -> bool:
        """Whether a broad beam ended with a map of this cost, and `broken` is known.

        Joining the maps of drives, which broad beams find, counts as a broad beam.
        If displacements may be wrong, this is False: after a wrong one the pose is unknown, so the
        beam often drops the map of least cost.
        """
        is_sound = math.isfinite(self.broken) and not self._parts.task.theory.jumped
        return is_sound and self._best[0] <= nats + EQUAL

    def sources(self, clashes: Callable[[], bool]) -> list[Source]:
        """List the guesses as sources, in the order of the schedule.

        If the first beam finds no map, `clashes` returns whether a short proof shows that the trace
        has none.
        """
        theory = self._parts.task.theory
        most = 1.0
        if theory.jumped:
            most = turn("beams with wrong displacements").until
        elif self._is_log:
            most = turn("beams of logs").until
        # With several drives or floors, a broad beam keeps as many hypotheses as a wider one.
        several = bool(theory.several_drives or theory.lifts)
        widths = [width for width in WIDTHS if width <= BROAD or not several]

        def beam(width: int) -> Source:
            own = turn(f"beam of {width}")
            limited = replace(own, until=min(own.until, most))
            return Source(
                limited,
                lambda: (
                    not self._has_joined
                    and self._is_time_for(width, widths[-1], limited.work(self._parts.watch))
                ),
                lambda: self._search(width, clashes),
            )

        return [
            Source(turn("smoothing"), lambda: True, self._smooth),
            Source(turn("false closures"), self._doubts_closures, self._sort_closures),
            Source(turn("joint drives"), lambda: several, self._join),
            Source(turn("other joint maps"), lambda: several, self._join_otherwise),
            *map(beam, widths),
            Source(
                turn("beam without axioms"),
                lambda: self._best[1] < math.inf and math.isinf(self.broken),
                self._break_axioms,
            ),
        ]

    def maps_without(self, wrong: Collection[int]) -> Iterator[SSHMap]:
        """Find maps by a narrow beam if only the displacements to `wrong` steps are wrong.

        Yield the first map that the checker accepts, and this map with its places merged further.
        """
        task, accepts = self._parts.task, self._parts.candidates.accepts
        mended = task.trace.without_displacements_at(wrong)
        problem = task.problem.changed(mended, task.theory.replace(jumped=0.0))
        for ssh_map in Beam(problem, task.log, 1).maps():
            if accepts(whole := self._with_jumps(ssh_map, wrong)):
                yield whole
                merged = smoothed_map(problem, task.log, Misfit(problem).beginning(ssh_map))
                if merged and accepts(whole := self._with_jumps(merged, wrong)):
                    yield whole
                return

    def refitted(self, ssh_map: SSHMap, wrong: Collection[int]) -> float:
        """Compute the cost of a map in nats if the displacements to `wrong` steps are wrong."""
        return self._misfit.nats_of(self._with_jumps(ssh_map, wrong))

    def _with_jumps(self, ssh_map: SSHMap, wrong: Collection[int]) -> SSHMap:
        """Return a map in which only the displacements to `wrong` steps are wrong."""
        task = self._parts.task
        jumps = faults_of(((t, "jumped") for t in wrong), {}, {}, task.trace, task.theory)
        others = tuple(fault for fault in ssh_map.faults if fault.kind != "jumped")
        return with_more_faults(replace(ssh_map, faults=others), jumps)

    def _smooth(self) -> None:
        """Merge places at poses that fit all closures."""
        if (smoothed := self._parts.candidates.smoothed()) is not None:
            self._parts.candidates.offer(smoothed)  # its cost may take longer than this source may
            self._best = self._add(smoothed), math.inf

    def _join(self) -> None:
        """Join the maps of single drives."""
        if (joining := self._parts.candidates.joining()) is not None:
            maps = self._all_of(joining.maps())
            nats = min(maps, default=math.inf)
            self._take(nats, -math.inf, joining.broken)
            self._has_joined = bool(maps) and len(maps[nats].pieces) == 1
            self._joining = joining

    def _join_otherwise(self) -> None:
        """Join drives in other ways, and merge the places of the best maps."""
        if (joining := self._joining) is None:
            return
        for found in self._parts.candidates.accepted(joining.others()):
            nats = self._add(found)
            if nats < self._nats() + TRIED:
                nats = min((nats, *self._merge(found)))
            self._take(nats, -math.inf, joining.broken)

    def _sort_closures(self) -> None:
        """Merge places under several explanations of the closures."""
        candidates, misfit = self._parts.candidates, self._misfit
        for aliases, begin in misfit.explained():
            look_at_clock()
            found = candidates.smoothed(begin)
            if found is None:
                continue
            course = dstates_and_places(found)
            if misfit.nats_of_course(*course, aliases=aliases) < self._nats() + TRIED:
                self._add(found)
                self._merge(found)

    def _doubts_closures(self) -> bool:
        """Whether closures may be false. Those of a log are trusted until its map does not fit."""
        closures = self._parts.task.trace.closures
        trusts = self._is_log and len(self._believed()) == len(closures)
        return bool(closures) and not trusts

    def _is_time_for(self, width: int, last: int, left: float) -> bool:
        """Whether to search with this beam. If only one of both has time, the last one goes first.

        A beam that dropped nothing has all hypotheses, so no wider one is needed. A beam of width n
        takes about n times as long as the first one.
        """
        if self._whole == self._believed():
            return False
        slack = left - last * self._first
        return width == last or not 0 < slack < width * self._first

    def _search(self, width: int, clashes: Callable[[], bool]) -> None:
        """Search with one beam. If no beam has ended in time, extend what this one has."""
        parts, began, believed = self._parts, self._parts.watch.elapsed(), self._believed()
        if (beam := parts.candidates.beam(width, believed)) is None:
            return
        try:
            self._finish(beam, width)
            self._whole = believed if beam.hypotheses and not beam.drops else None
        except StageTimeError:
            if not self._ended:
                parts.candidates.go_on(beam)
        if self._first == math.inf:
            if self._nats() == math.inf and not parts.known.best and clashes():
                parts.known.status = Status.UNSATISFIABLE
            self._first = parts.watch.elapsed() - began

    def _finish(self, beam: Beam, width: int) -> None:
        """Keep the maps that a beam ends with. Raises StageTimeError if it does not end in time."""
        nats = min(self._all_of(beam.maps()), default=math.inf)
        self._ended = beam
        if width < BROAD and beam.drops:
            return
        # A beam without axioms would be the same if the checker refused nothing.
        broken = -math.inf if beam.refuses else 0.0
        estimate = beam.hypotheses[0].nats if beam.hypotheses else math.inf
        self._take(nats, estimate, broken)

    def _all_of(self, maps: Iterable[SSHMap]) -> dict[float, SSHMap]:
        """Keep maps, and merge the places of the best ones. Return all by cost.

        Raises StageTimeError if the maps are not all found in time.
        """
        found = {self._add(one): one for one in self._parts.candidates.accepted(maps)}
        with suppress(StageTimeError):
            for nats in [nats for nats in sorted(found) if nats < min(found) + TRIED]:
                found |= self._merge(found[nats])
        return found

    def _merge(self, ssh_map: SSHMap) -> dict[float, SSHMap]:
        """Merge the places of a map further. Keep the new map, and return it by its cost."""
        merged = self._parts.candidates.smoothed(self._misfit.beginning(ssh_map))
        return {} if merged is None else {self._add(merged): merged}

    def _break_axioms(self) -> None:
        """Find `broken` with the widest beam that ended."""
        if self._ended:
            self.broken = self._best[1] - self._ended.nats_without_axioms()

    def _take(self, nats: float, estimate: float, broken: float) -> None:
        """Keep what a broad beam, or joining the maps of drives, says about its best map."""
        if (nats, estimate) <= self._best:
            self._best, self.broken = (nats, estimate), broken
        elif nats < math.inf == self._best[1]:  # the smoothed map costs less
            saved = nats - self._best[0]
            self._best, self.broken = (self._best[0], estimate - saved), broken
