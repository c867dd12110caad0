"""The search for the minimal maps of a trace: a stream of maps that ends with a `Solution`.

A search makes a first map at once. Then it finds the minimal cost in stages (`stages.py`), and
lists the maps of that cost (`map_list.py`). If it is stopped earlier, it makes some map of the
whole trace (`fallback.py`). `exact/prefixes.py` proves that it is enough to solve the first
steps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from itertools import groupby
from typing import TYPE_CHECKING, get_args

from ssh_abduction.data.checks import an_instance, one_of
from ssh_abduction.data.drives import Drive, drives_of, with_floors, with_named_faults
from ssh_abduction.data.errors import SolverError, TheoryError, brief
from ssh_abduction.data.maps import SSHMap, checked_maps
from ssh_abduction.data.trace import Trace, checked_trace
from ssh_abduction.data.words import counted
from ssh_abduction.runtime.clock import counting, each_counting, each_heeding, heeding, now
from ssh_abduction.runtime.loggers import log_of
from ssh_abduction.runtime.threads import one_thread
from ssh_abduction.solver.answer import Answer
from ssh_abduction.solver.asp.limits import EARLY, LimitError, StageTimeError, Stop, Watch
from ssh_abduction.solver.asp.own_rules import check_rules
from ssh_abduction.solver.fallback import (
    CLASHING,
    OVERTIME,
    best_map,
    clash_in,
    fall_back,
    late_clash,
    overtime,
)
from ssh_abduction.solver.geometry.ranking import Ranking
from ssh_abduction.solver.map_list import Priced, by_count, listed
from ssh_abduction.solver.parts import Parts
from ssh_abduction.solver.schedule import Source, turn
from ssh_abduction.solver.solution.result import Solution
from ssh_abduction.solver.solution.sharing import Backbone
from ssh_abduction.solver.stages import Stages
from ssh_abduction.solver.start import ANEW, Limits, Start
from ssh_abduction.solver.values import Bound, Cost, Grounding, Progress, Status
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.speedups import ALL, Speedups, checked_speedups
from ssh_abduction.theory.theory import Theory

# The time limit of a search for the maps of a mended trace is at least this many seconds.
SHORTEST = 0.05
# Without a time limit, the proof of what all minimal maps share may take this many seconds, or as
# long as the search took if that is more.
REASONING = 5.0
# After a limit, the poses and the cost of the best map may each take at least this many seconds.
LEAST_WEIGHING = 0.2
if TYPE_CHECKING:
    from ssh_abduction.solver.costs.weighing import Weighing

COUNTED = (
    "weigh: maps are counted instead of weighed, as no displacements are used whose misfit could "
    "be weighed"
)
_log = log_of(__name__)


class Search:
    """A stream of the minimal maps of a trace, in constant memory.

    Iterate over the search once to get the maps. Then `solution()` says how the search ended.

    Args:
        trace: The views and actions to explain.
        theory: The axioms and the preference; Theory.topological() by default.
        time_limit, max_maps, within, memory_limit, work_limit, speedups, on_progress: As in
            `solve`.

    Attributes:
        trace: The trace.
        theory: The theory. Each "auto" in it is replaced by the value that is used.
        limits: The limits of the search.
        clash: Consecutive steps that have no map by themselves; None if none are known.
    """

    def __init__(
        self,
        trace: Trace,
        theory: Theory | None = None,
        *,
        time_limit: float | None = None,
        max_maps: int | None = 100,
        within: int = 0,
        memory_limit: int | None = None,
        work_limit: float | None = None,
        speedups: Speedups = ALL,
        on_progress: Callable[[Progress], None] | None = None,
        _start: Start = ANEW,
    ) -> None:
        checked_trace(trace)
        self.limits = Limits(time_limit, memory_limit, max_maps, within, work_limit)
        self._counts_work = work_limit is not None
        with counting(self._counts_work):
            began = now()
            if on_progress is not None and not callable(on_progress):
                raise SolverError(
                    f"on_progress: expected a function of one Progress, got {brief(on_progress)}"
                    "; give one, or None"
                )
            before = _start.after.task.problem if _start.after else None
            problem = settle(trace, theory, before)
            self.theory = problem.theory
            self._asked_weigh = theory.weigh if theory else "auto"
            if within and self.theory.has_faults:
                raise TheoryError(
                    f"within: expected 0 where faults are allowed, got {within}; leave within "
                    "out, or compare the numbers of faults (--front)"
                )
            check_rules(self.theory)
            self.trace = trace
            self.clash: range | None = None
            self._begun = False
            self._reasons, self._known_maps = _start.reasons, _start.known
            self._parts = Parts(
                problem, self.limits, checked_speedups(speedups), on_progress, _start, began
            )
            self._stages = Stages(self._parts, self._solve_mended, goes_on=_start.after is not None)
            self._answer = Answer(self._parts)
            self._weighing: Weighing | None = None
            if self.theory.weigh == "cost":
                from ssh_abduction.solver.costs.weighing import Weighing  # loads numpy

                self._weighing = Weighing(self._parts)
                self._reasons = False  # what clingo proves about minimal maps is about counts
                self._parts.rivals.reasons = False

    @classmethod
    def continuing(
        cls,
        after: Search | None,
        trace: Trace,
        theory: Theory,
        *,
        time_limit: float | None,
        max_maps: int | None,
        work_limit: float | None = None,
        speedups: Speedups = ALL,
        minimal: SSHMap | None = None,
    ) -> Search:
        """Make a search for a trace that has grown, which goes on from an earlier search.

        Args:
            after: The search for the first steps of the trace, which has ended; None to begin anew.
            trace: The trace that has grown.
            theory: The axioms and the preference, as in the search `after`.
            time_limit: Seconds of wall-clock time; None for no limit.
            work_limit: Units of work, as in `solve`; None for no limit.
            max_maps: List at most this many maps; None lists all.
            speedups: The speed-ups that are on.
            minimal: A map of the trace that costs what `after` proved to be minimal, if there is
                one. Then the minimal cost is known, and the search only lists maps.
        """
        if after is not None:
            mend = "give the search of the steps before, or leave it out"
            an_instance("after", after, Search, SolverError, mend=mend)
        return cls(
            trace,
            theory,
            time_limit=time_limit,
            work_limit=work_limit,
            max_maps=max_maps,
            speedups=speedups,
            _start=Start(after=after._parts if after else None, minimal=minimal),
        )

    def __repr__(self) -> str:
        best = f", best {counted(len(self.best.dstates), 'dstates')}" if self.best else ""
        steps, given = counted(len(self.trace), "steps"), counted(self.count, "maps")
        return f"<Search of {steps}: {self.status.value}{best}, {given} given>"

    @property
    def status(self) -> Status:
        """What is proven so far, such as that `best` is minimal."""
        return self._parts.known.status

    @property
    def bound(self) -> Bound:
        """The proven lower bounds so far on the counts of any map."""
        return self._parts.known.bound

    @property
    def best(self) -> SSHMap | None:
        """The best map of the whole trace so far; None before there is one."""
        return self._parts.known.best

    @property
    def stopped(self) -> Stop | None:
        """Why the search ended before it was complete; None if it did not."""
        return self._parts.known.stopped

    @property
    def complete(self) -> bool:
        """Whether all maps were given: all minimal ones and, with `within`, all others."""
        return self._parts.known.complete

    @property
    def count(self) -> int:
        """The number of maps given to the caller so far."""
        return self._parts.known.count

    @property
    def cost(self) -> Cost | None:
        """The cost of the last map given to the caller; None before the first one."""
        return self._answer.cost

    @property
    def nats(self) -> float | None:
        """The least cost in nats that is known; None if maps are counted, or none is known."""
        best = self._weighing.best if self._weighing else None
        return best.nats if best else None

    @property
    def backbone(self) -> Backbone | None:
        """The backbone: what the minimal maps known so far share; None if none is known."""
        return self._parts.rivals.backbone

    @property
    def prefix(self) -> int:
        """The number of first steps of the trace that were given to clingo."""
        return self._parts.engine.size

    @property
    def grounding(self) -> Grounding:
        """The numbers of rules and atoms of the ground program that clingo solved last."""
        return self._parts.engine.asker.grounding

    def __iter__(self) -> Iterator[SSHMap]:
        from ssh_abduction.solver.derived_regions import (
            Deriving,  # after the search, which needs none
        )

        ranking = Ranking(self.trace) if self.theory.displacement == "use" else None
        maps = map(Deriving(self.trace, self.theory).mapped, self._given(ranking))
        return each_counting(self._counts_work, maps)

    def unranked(self) -> Iterator[SSHMap]:
        """Iterate over the maps in the order in which they are found, instead of over the search.

        This is faster if the trace has displacements: the maps are not ranked by them and have no
        poses.
        """
        return each_counting(self._counts_work, self._given(None))

    def _given(self, ranking: Ranking | None) -> Iterator[SSHMap]:
        """Yield the maps. `ranking` sorts maps of one cost; None keeps their order."""
        drives, late = drives_of(self.trace), partial(_late, self._parts)
        for cost, level in groupby(self._found(), key=lambda priced: priced[1]):
            maps = (ssh_map for ssh_map, _ in level)
            for ssh_map in ranking.ranked(maps, self.over, late) if ranking else maps:
                complete = _with_names(ssh_map, self.trace, drives)
                self._answer.take_down(complete, cost)
                yield complete

    def _found(self) -> Iterator[Priced]:
        """Run the search, and yield each map with its preferred counts as it is found."""
        if self._begun:
            raise SolverError(
                "search: expected to be iterated once, got a second time; make another Search"
            )
        self._begun = True
        parts, known, watch = self._parts, self._parts.known, self._parts.watch
        engine = type(parts.engine).__name__
        _log.info("search of %r under %r, with %s", self.trace, self.theory, engine)
        watch.start()
        yield from self._searched()
        fall_back(parts, self._answer)
        self.clash = self.clash or late_clash(
            parts, lambda trace, theory: self._solve_mended(trace, theory, 1, CLASHING, late=True)
        )
        if self._weighing is not None:
            # If this takes too long after a limit, the map has no cost in nats.
            ended = known.stopped in EARLY
            seconds = _late(parts) if ended else math.inf
            with suppress(LimitError), heeding(Watch().part(seconds).check):
                self._weighing.keep_best()
        yield from best_map(parts)
        if self._reasons:
            _reason(parts)
        _log.info(
            "ended after %.2f s%s: %s, %s%s",
            watch.seconds(),
            f" ({self.stopped})" if self.stopped else "",
            self.status.value,
            counted(self.count, "maps"),
            "" if self.complete else ", perhaps not all",
        )

    def _searched(self) -> Iterator[Priced]:
        """Yield the maps of the search until it is complete. Store why it stops earlier, if so."""
        parts, known, watch = self._parts, self._parts.known, self._parts.watch
        try:
            _begin_with(self._known_maps, parts, self._weighing)
            with heeding(watch.check):
                self._stages.make_first_map()
                if self._weighing is None:
                    self._stages.find_minimum()
                else:
                    self._weigh(self._weighing)
            with closing(
                self._weighing.maps()
                if self._weighing
                else by_count(parts, self._stages.mended_maps)
            ) as found:  # clingo has to stop before it is asked again
                maps = listed(parts, found, keeps_time=self._reasons)
                yield from each_heeding(watch.check, maps)
        except StageTimeError:
            is_listed = known.count == self.limits.most
            known.stopped = "maps limit" if is_listed else parts.limit_reached
        except LimitError as limit:
            known.stopped = limit.reason
        except KeyboardInterrupt:
            known.stopped = "interrupted"
        except Exception:
            parts.prefixes.engine.asker.intact = False
            raise
        finally:
            parts.end_clingo()

    def _weigh(self, weighing: Weighing) -> None:
        """Find the maps of least cost: guess some, find one with the fewest dstates, then prove."""
        watch = self._parts.watch

        def maps_of(trace: Trace, theory: Theory) -> tuple[tuple[SSHMap, ...], bool]:
            return self._solve_mended(trace, theory, 1, watch.left())

        def clashes() -> bool:
            twos = (range(t, t + 2) for t in range(len(self.trace) - 1))
            self.clash = clash_in(self.trace, self.theory, twos, maps_of)
            return self.clash is not None

        # The matrices are small: threads of BLAS would mostly wait for each other.
        with one_thread("blas"):
            # 1. Some map, so that there always is one.
            if watch.left() > 0:
                self._parts.candidates.sketch(turn("sketch").work(watch))
                weighing.keep_best()
            # 2. Maps of little cost, by guesses.
            self._run(weighing.guesses(clashes), weighing)
            # 3. The least number of dstates.
            is_enough = weighing.best is not None and not self.theory.has_faults
            fewest = turn("fewest dstates, map known" if is_enough else "fewest dstates")
            self._run([Source(fewest, lambda: True, self._stages.find_fewest)], weighing)
            if self._parts.known.status is Status.UNSATISFIABLE:
                return
            # 4. The proof. One map more than wanted shows that not all are listed.
            most = self.limits.most and self.limits.most + 1
            weighing.of_labels = lambda trace, theory, s: self._solve_mended(trace, theory, most, s)
            weighing.begin_proof()
            self._run(weighing.proofs(), weighing)

    def _run(self, sources: Iterable[Source], weighing: Weighing) -> None:
        """Run sources one after the other, each within its turn, while a map may be found."""
        parts, watch = self._parts, self._parts.watch
        for source in sources:
            if self.status is Status.UNSATISFIABLE or not source.suits():
                continue
            _log.debug("%s", source.turn.name)
            with suppress(StageTimeError), watch.stage(source.turn.ends(watch)):
                source.run()
            if parts.known.status is not Status.UNSATISFIABLE:
                weighing.keep_best()
            parts.report()

    def _solve_mended(
        self, mended: Trace, theory: Theory, most: int, seconds: float, *, late: bool = False
    ) -> tuple[tuple[SSHMap, ...], bool]:
        """Solve a mended trace (its faults are corrected) within the limits of this search.

        The theory has no faults. At most `most` maps are listed; 0 for all. Returns the minimal
        maps (none if the trace has no map) and True; or the best map known after that time and
        False. If `late`, the limits of this search are over, and hold no more.
        """
        limit = max(seconds, SHORTEST)
        search = Search(
            mended,
            theory,
            time_limit=None if self._counts_work or limit == math.inf else limit,
            work_limit=limit if self._counts_work else None,
            max_maps=most or None,
            memory_limit=self.limits.memory_limit,
            speedups=self._parts.speedups,
            _start=Start(around=None if late else self._parts.watch),
        )
        maps = tuple(search.unranked())
        if search.stopped == "interrupted":
            self.interrupt()
        is_listed = most == 1 or search.complete or search.stopped == "maps limit"
        # A limit may come after the proof of the least cost, and before the first map.
        is_optimal = search.status is Status.OPTIMAL and bool(maps)
        return maps, is_listed and (is_optimal or search.status is Status.UNSATISFIABLE)

    def interrupt(self) -> None:
        """End the search soon, with the best answer so far.

        Signal handlers and other threads may call this method.
        """
        self._parts.watch.interrupted = True

    def over(self) -> bool:
        """Whether a limit is reached or the search was interrupted.

        If the clock stands still, restart it, as further work with the maps is under the same time
        limit.
        """
        watch = self._parts.watch
        if not watch.running:
            watch.start()
        try:
            watch.check()
        except LimitError as limit:
            self._parts.known.stopped = limit.reason
            return True
        return False

    def solution(self, maps: tuple[SSHMap, ...] = ()) -> Solution:
        """Make the answer from what the search has proven and from the maps that the caller kept.

        Args:
            maps: The maps that the answer will hold. If they include all maps that the search gave,
                and no minimal map is missing, they are sorted into an order that is the same in
                each run.
        """
        solution = self._answer.solution(self._answer.in_order(checked_maps(maps)))
        if self._weighing is not None:
            with one_thread("blas"), counting(self._counts_work):
                weighed = self._weighing.weighed()
            return replace(solution, support=replace(solution.support, weighed=weighed))
        if self._asked_weigh != "cost":
            return solution
        return replace(solution, support=replace(solution.support, weigh_warning=COUNTED))

    def snapshot(self, stopped: Stop) -> Solution:
        """Make an answer while another thread still searches and cannot be stopped.

        Call this only before the program ends: the search cannot be used any more.

        Args:
            stopped: The reason to name in the answer, such as "time limit".
        """
        one_of("stopped", stopped, get_args(Stop), SolverError)
        parts, known = self._parts, self._parts.known
        # The other thread may change data that the sketch (a map without a search) reads. If this
        # raises an exception, the answer has no sketch.
        with suppress(Exception):
            if known.status in (Status.UNKNOWN, Status.FEASIBLE):
                parts.candidates.sketch(OVERTIME)
        known.raise_bound(parts.prefixes.engine.bound)
        known.stopped = stopped
        return self.so_far(stopped)

    def so_far(self, stopped: Stop) -> Solution:
        """Make an answer with the best map so far, while another thread goes on with the search.

        Args:
            stopped: The reason to name in the answer, if the search ends now.
        """
        one_of("stopped", stopped, get_args(Stop), SolverError)
        known = self._parts.known
        best, status = known.best, known.status
        if best is not None and status is Status.UNKNOWN:
            status = Status.FEASIBLE
        # Clingo cannot say how large its program is while another thread uses it.
        maps = () if best is None else (_with_names(best, self.trace, drives_of(self.trace)),)
        solution = self._answer.solution(maps, Grounding(0, 0))
        is_complete = status is Status.UNSATISFIABLE
        return replace(solution, status=status, complete=is_complete, stopped=stopped)


def _begin_with(maps: Sequence[SSHMap], parts: Parts, weighing: Weighing | None) -> None:
    """Keep the known maps that the checker accepts, even if the time limit is over."""
    for ssh_map in maps:
        if weighing is None:
            parts.candidates.offer(ssh_map)
        elif parts.judging.accepts(ssh_map):
            weighing.add(ssh_map)
    if weighing is not None and maps:
        weighing.keep_best()


def _reason(parts: Parts) -> None:
    """Prove what all minimal maps share, if not all of them are listed."""
    watch = parts.watch
    watch.start()
    spent = watch.elapsed()
    ends = spent + max(REASONING, spent) if watch.left() == math.inf else math.inf
    with heeding(watch.check), watch.stage(ends):
        parts.rivals.reason()
    watch.stop()


def _with_names(ssh_map: SSHMap, trace: Trace, drives: Sequence[Drive]) -> SSHMap:
    """Return a map with its floors, the starts of drives, and faults that name their drives."""
    complete = with_named_faults(with_floors(ssh_map, trace), drives)
    return replace(complete, starts=tuple(drive.first for drive in drives[1:]))


def _late(parts: Parts) -> float:
    """Return the seconds left to fit and weigh a map after a limit, on a busy machine too."""
    return max(overtime(parts), LEAST_WEIGHING)
