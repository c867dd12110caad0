"""The search for the minimal maps of a trace: a stream of maps that ends with a `Solution`.

One loop runs the sources of the schedule, one after the other, each for its share of the work. If
maps are counted, `counting.py` has the sources, else `costs/weighing.py`. Then the maps of least
cost are listed. If the search is stopped earlier, it makes some map of the whole trace.
`exact/prefixes.py` proves that it is enough to solve the first steps.
"""

from __future__ import annotations

import math
import time
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from itertools import groupby
from typing import TYPE_CHECKING, Any, get_args

from ssh_abduction.data.checks import one_of
from ssh_abduction.data.drives import Drive, drives_of, with_floors, with_named_faults
from ssh_abduction.data.errors import SolverError, TheoryError, brief
from ssh_abduction.data.maps import SSHMap, checked_maps
from ssh_abduction.data.trace import Trace, checked_trace
from ssh_abduction.data.words import counted
from ssh_abduction.runtime.clock import (
    counting,
    counts_work,
    each_counting,
    each_heeding,
    each_looking,
    heeding,
    now,
)
from ssh_abduction.runtime.limits import EARLY, LimitError, StageTimeError, Stop, Watch
from ssh_abduction.runtime.loggers import log_of
from ssh_abduction.runtime.threads import one_thread
from ssh_abduction.solution.result import Solution
from ssh_abduction.solution.values import Bound, Cost, Grounding, Progress, Status
from ssh_abduction.solver.asp.kept_rules import check_rules
from ssh_abduction.solver.board import projected
from ssh_abduction.solver.candidates import has_quick_map
from ssh_abduction.solver.counting import Counting
from ssh_abduction.solver.geometry.ranking import Ranking
from ssh_abduction.solver.parts import Answer, Limits, Parts, Priced, Start
from ssh_abduction.solver.schedule import Source, turn
from ssh_abduction.solver.sources.exact.choosing import FEW_STEPS
from ssh_abduction.theory.settle import Problem, settle
from ssh_abduction.theory.speedups import ALL, Speedups, checked_speedups
from ssh_abduction.theory.theory import Theory

if TYPE_CHECKING:
    from ssh_abduction.solver.costs.weighing import Weighing

# The time limit of a search for a part of the problem is at least this many seconds.
SHORTEST = 0.05
# Without a time limit, the proof of what all minimal maps share may take this many seconds, or as
# long as the search took if that is more.
REASONING = 5.0
# After a limit, the poses and the cost of the best map may each take at least this many seconds.
LEAST_WEIGHING = 0.2
# After the last map asked for, look for one more for this many seconds, or for this share of the
# time so far if that is more. If clingo proves that there is none, the list is complete.
ONE_MORE = 1.0
ONE_MORE_SHARE = 0.1
# If the time limit stops a search, making and checking a map may take OVERTIME seconds more, plus
# OVERTIME_SHARE of the limit.
OVERTIME, OVERTIME_SHARE = 0.5, 0.05
# After Ctrl-C, or at the memory limit, it may take this many seconds.
INTERRUPTED = 0.6
# If a stopped search has no map, it looks for a clash in stretches of up to VISITS visits to
# places, for at most CLASHING seconds. A short stretch takes a few hundredths of a second.
VISITS, CLASHING = 12, 0.5

COUNTED = (
    "weigh: maps are counted instead of weighed, as no displacements are used whose misfit could "
    "be weighed"
)
_log = log_of(__name__)


class Search:
    """A stream of the minimal maps of a trace. It keeps at most a hash of each.

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
        parts: What the sources of the search share. A search for more steps may begin after it.
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
        _start: Start | None = None,
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
            begin = _start or Start()
            before = begin.after.task.problem if begin.after else None
            problem = settle(trace, theory, before)
            self.theory = problem.theory
            self._asked_weigh = theory.weigh if theory else "auto"
            if within and self.theory.has_faults:
                raise TheoryError(
                    f"within: expected 0 where faults are allowed, got {within}; leave within out"
                )
            check_rules(self.theory)
            self.trace = trace
            self.clash: range | None = None
            self._begun = False
            self._reasons, self._known_maps = begin.reasons, begin.known
            self.parts = Parts(
                problem, self.limits, checked_speedups(speedups), on_progress, begin, began
            )
            goes_on = begin.after is not None
            self._counting = Counting(self.parts, self._solve_part, goes_on=goes_on)
            self._answer = Answer(self.parts)
            self._weighing: Weighing | None = None
            if self.theory.weigh == "cost":
                from ssh_abduction.solver.costs.weighing import Weighing  # loads numpy

                self._weighing = Weighing(self.parts)
                self._reasons = False  # what clingo proves about minimal maps is about counts
                self.parts.rivals.reasons = False

    def __repr__(self) -> str:
        best = f", best {counted(len(self.best.dstates), 'dstates')}" if self.best else ""
        steps, given = counted(len(self.trace), "steps"), counted(self.count, "maps")
        return f"<Search of {steps}: {self.status.value}{best}, {given} given>"

    @property
    def status(self) -> Status:
        """What is proven so far, such as that `best` is minimal."""
        return self.parts.known.status

    @property
    def bound(self) -> Bound:
        """The proven lower bounds so far on the counts of any map."""
        return self.parts.known.bound

    @property
    def best(self) -> SSHMap | None:
        """The best map of the whole trace so far; None before there is one."""
        return self.parts.known.best

    @property
    def stopped(self) -> Stop | None:
        """Why the search ended before it was complete; None if it did not."""
        return self.parts.known.stopped

    @property
    def complete(self) -> bool:
        """Whether all maps were given: all minimal ones and, with `within`, all others."""
        return self.parts.known.complete

    @property
    def count(self) -> int:
        """The number of maps given to the caller so far."""
        return self.parts.known.count

    @property
    def cost(self) -> Cost | None:
        """The cost of the last map given to the caller; None before the first one."""
        return self._answer.cost

    @property
    def nats(self) -> float | None:
        """The least cost in nats that is known; None if maps are counted, or none is known."""
        best = self._weighing.best if self._weighing else None
        return best.nats if best else None

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
        drives, late = drives_of(self.trace), partial(_late, self.parts)
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
        parts, known, watch = self.parts, self.parts.known, self.parts.watch
        engine = type(parts.engine).__name__
        _log.info("search of %r under %r, with %s", self.trace, self.theory, engine)
        watch.start()
        yield from self._searched()
        fall_back(parts, self._answer)
        self.clash = self.clash or late_clash(
            parts, lambda trace, theory: self._solve_part(trace, theory, 1, CLASHING, late=True)
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
        parts, known, watch = self.parts, self.parts.known, self.parts.watch
        try:
            _begin_with(self._known_maps, parts, self._weighing)
            with heeding(watch.check):
                self._find_least()
            maps = (self._weighing or self._counting).maps()
            with closing(maps):  # clingo has to stop before it is asked again
                yield from each_heeding(watch.check, listed(parts, maps, keeps_time=self._reasons))
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

    def _find_least(self) -> None:
        """Find the least counts, or cost, of the maps."""
        parts = self.parts
        self.clash = _refuted(parts.task.problem)
        if self.clash:
            parts.known.status = Status.UNSATISFIABLE
            return
        # Some map by greedy merging: clingo then has to find a better one.
        if self.status is not Status.OPTIMAL and len(self.trace) > FEW_STEPS:
            parts.candidates.merge()
        if self._weighing is None:
            self._run(self._counting.sources())
            return
        # The matrices are small: threads of BLAS would mostly wait for each other.
        with one_thread("blas"):
            self._run(self._weighed_sources(self._weighing), self._weighing)

    def _weighed_sources(self, weighing: Weighing) -> Iterator[Source]:
        """Yield the sources of a search that weighs maps: guesses, the fewest dstates, proofs."""
        parts, watch = self.parts, self.parts.watch

        def clashes() -> bool:
            twos = (range(t, t + 2) for t in range(len(self.trace) - 1))
            self.clash = clash_in(
                self.trace,
                self.theory,
                twos,
                lambda trace, theory: self._solve_part(trace, theory, 1, watch.left()),
            )
            return self.clash is not None

        def find_fewest() -> None:
            try:
                self._run(self._counting.sources())
            except LimitError as limit:
                if limit.reason != "no proof":
                    raise

        # 1. Some map, so that there always is one.
        if watch.left() > 0:
            parts.candidates.sketch(turn("sketch").work(watch))
            weighing.keep_best()
        # 2. Maps of little cost, by guesses.
        yield from weighing.beams.sources(clashes)
        yield Source(turn("moved visits"), weighing.may_move, weighing.move_visits)
        yield Source(turn("wrong displacements"), weighing.may_jump, weighing.search_jumps)
        # 3. The least number of dstates.
        is_enough = weighing.best is not None and not self.theory.has_faults
        fewest = turn("fewest dstates, map known" if is_enough else "fewest dstates")
        yield Source(fewest, lambda: True, find_fewest)
        # 4. The proof. One map more than wanted shows that not all are listed.
        most = self.limits.most and self.limits.most + 1
        weighing.of_labels = lambda trace, theory, s: self._solve_part(trace, theory, most, s)
        yield from weighing.proofs()

    def _run(self, sources: Iterable[Source], weighing: Weighing | None = None) -> None:
        """Run sources one after the other, each within its turn, while a map may be found."""
        parts, watch = self.parts, self.parts.watch
        for source in sources:
            if source.suits():
                _log.debug("%s", source.turn.name)
                with suppress(StageTimeError), watch.stage(source.turn.ends(watch)):
                    source.run()
                if weighing is not None and self.status is not Status.UNSATISFIABLE:
                    weighing.keep_best()
                parts.report()
            if self.status is Status.UNSATISFIABLE:
                return

    def _solve_part(
        self, trace: Trace, theory: Theory, most: int, seconds: float, *, late: bool = False
    ) -> tuple[tuple[SSHMap, ...], bool]:
        """Solve a problem that is a part of this one, within the limits of this search.

        It may be a mended trace (its faults are corrected), a stretch of the trace, or a stricter
        or weaker theory. The theory has no faults. At most `most` maps are listed; 0 for all.
        Returns the minimal maps (none if the trace has no map) and True; or the best map known
        after that time and False. If `late`, the limits of this search are over, and hold no more.
        """
        limits: dict[str, Any] = self.limits.of_part(max(seconds, SHORTEST))
        search = Search(
            trace,
            theory,
            max_maps=most or None,
            speedups=self.parts.speedups,
            _start=Start(around=None if late else self.parts.watch),
            **limits,
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
        self.parts.watch.interrupted = True

    def over(self) -> bool:
        """Whether a limit is reached or the search was interrupted.

        If the clock stands still, restart it, as further work with the maps is under the same time
        limit.
        """
        watch = self.parts.watch
        if not watch.running:
            watch.start()
        try:
            watch.check()
        except LimitError as limit:
            self.parts.known.stopped = limit.reason
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
        return replace(solution, support=solution.support.warning_of(COUNTED))

    def snapshot(self, stopped: Stop) -> Solution:
        """Make an answer while another thread still searches and cannot be stopped.

        Call this only before the program ends: the search cannot be used any more.

        Args:
            stopped: The reason to name in the answer, such as "time limit".
        """
        one_of("stopped", stopped, get_args(Stop), SolverError)
        parts, known = self.parts, self.parts.known
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
        known = self.parts.known
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


def listed(parts: Parts, found: Iterator[Priced], *, keeps_time: bool) -> Iterator[Priced]:
    """Yield the maps asked for, each with its preferred counts, after a check.

    The clock of the search stops while the caller works with a map. `found` has the minimal maps,
    and then maps that cost more. If `keeps_time`, some time is kept for finding the backbone later.
    """
    known, watch, most = parts.known, parts.watch, parts.limits.most
    if known.status is Status.OPTIMAL:
        _log.info("minimal maps cost %s; they are listed", _cost_in_words(parts))
        kept = turn("backbone").share if keeps_time else 0.0
        ends = (1 - kept) * (watch.elapsed() + watch.left()) if kept else math.inf
        ends = ends if ends > watch.elapsed() else math.inf
        watch.stage_ends = ends
        for ssh_map, cost in _without_repeats(found, parts.task.theory):
            if most and known.count == most:
                known.stopped = "maps limit"
                return
            parts.judging.pass_map(ssh_map, watch.elapsed())
            # Take the first map as the best one. The answer gives its counts as the cost.
            known.best = known.best if known.count else ssh_map
            known.count += 1
            note(parts, ssh_map, cost)
            parts.report()
            watch.stop()
            yield ssh_map, cost
            watch.start()
            # Clasp ends its search for one more map by its limit of conflicts if work is counted.
            if known.count == most and not watch.counts_work:
                spent = watch.elapsed()
                watch.stage_ends = min(ends, spent + max(ONE_MORE, ONE_MORE_SHARE * spent))
    known.complete = True


def _without_repeats(found: Iterator[Priced], theory: Theory) -> Iterator[Priced]:
    """Yield each map once, reduced to what the theory speaks of."""
    given: set[SSHMap] = set()
    for ssh_map, cost in found:
        if theory.has_paths:
            yield ssh_map, cost
        elif (shown := projected(ssh_map, theory)) not in given:
            given.add(shown)
            yield shown, cost


def note(parts: Parts, ssh_map: SSHMap, cost: tuple[int, ...]) -> None:
    """Add a map to the known minimal maps (`parts.rivals`), if it is minimal."""
    if parts.known.status is Status.OPTIMAL and cost == parts.known.cost:
        parts.rivals.add(ssh_map, cost)


def _cost_in_words(parts: Parts) -> str:
    """Return the cost of minimal maps in words."""
    cost = parts.known.best_cost
    if cost is None:
        return "nothing that is counted"
    return ", ".join(counted(v, k) for k, v in cost.to_dict().items())


def fall_back(parts: Parts, answer: Answer) -> None:
    """Make some map of the whole trace if none is known, and prove a bound from distinct steps.

    If the search was not stopped, or has proven its minimum, do nothing. The map, the bound and the
    status go to `parts.known`.
    """
    known = parts.known
    if not known.stopped or known.status is Status.OPTIMAL:
        return
    parts.watch.start()  # what is done after the limit counts, too
    with suppress(KeyboardInterrupt):
        parts.candidates.sketch(overtime(parts))
    answer.count_apart()
    if known.best is not None and known.status is Status.UNKNOWN:
        known.status = Status.FEASIBLE


def _refuted(problem: Problem) -> range | None:
    """Return the steps of an asserted pair that the evidence excludes, from one to the other."""
    theory, pairs = problem.theory, problem.pairs
    for said, apart in ((theory.same, pairs.apart), (theory.same_place, pairs.elsewhere)):
        for first, last in map(sorted, said):
            if first in apart.get(last, ()):
                return range(first, last + 1)
    return None


def clash_in(
    trace: Trace,
    theory: Theory,
    stretches: Iterable[range],
    maps_of: Callable[[Trace, Theory], tuple[Sequence[SSHMap], bool]],
) -> range | None:
    """Find a stretch of consecutive steps that has no map by itself. Then the trace has no map.

    `maps_of` solves a trace, and returns some maps and whether the answer is proven. Returns None
    if there is no such stretch, or if the theory allows faults. Also None if it has rules of the
    user, which may hold only for the whole trace.
    """
    if theory.has_faults or theory.rules:
        return None
    counting = theory.replace(weigh="count")
    bare = counting.replace(displacement="none")
    for found in each_looking(stretches):
        *steps, last = trace.steps[found.start : found.stop]
        if any(step.action and step.action.starts for step in steps):
            continue
        piece = Trace((*steps, replace(last, action=None)), odometry=trace.odometry)
        # The axiom one_pose compares the first steps of visits. So a stretch of several visits
        # must begin with a whole one.
        is_one_visit = not any(_begins_visit(trace, t) for t in found[1:])
        axioms = counting if is_one_visit or _begins_visit(trace, found.start) else bare
        part = axioms.of_steps(found.start, len(found))
        if has_quick_map(piece, part):
            continue
        maps, proven = maps_of(piece, part)
        if proven and not maps:
            return found
    return None


def _begins_visit(trace: Trace, step: int) -> bool:
    """Whether a visit to a place begins at a step."""
    return step == 0 or trace.actions[step - 1].kind != "turn"


def _stretches(trace: Trace, ends: Sequence[int]) -> list[range]:
    """List stretches that may clash, the shortest first. Each ends at one of `ends`.

    Each has two steps, or whole visits but for later steps of the last visit.
    """
    begins = [t for t in range(len(trace)) if _begins_visit(trace, t)]
    pairs = (range(max(t - 1, 0), t + 1) for t in ends)
    visits = (
        range(begins[max(bisect_right(begins, t) - number, 0)], t + 1)
        for number in range(1, VISITS + 1)
        for t in ends
    )
    found = dict.fromkeys((*pairs, *visits))
    # The whole trace is no stretch: its search would look for the same clash again, without end.
    return [stretch for stretch in found if len(stretch) < len(trace)]


def late_clash(
    parts: Parts, maps_of: Callable[[Trace, Theory], tuple[Sequence[SSHMap], bool]]
) -> range | None:
    """Look for a short clash if a stopped search has no map.

    A clash is consecutive steps that have no map by themselves. It may end at a step that
    contradicted a sketch. `maps_of` is as in `clash_in`. `parts.known` gets the status if there is
    a clash.
    """
    known, task, clash = parts.known, parts.task, None
    if known.best is not None or not known.stopped or known.status is not Status.UNKNOWN:
        return None
    stretches = _stretches(task.trace, [*parts.candidates.contradicting])
    part = Watch().part(CLASHING, None if counts_work() else time.thread_time)
    with suppress(LimitError, KeyboardInterrupt), heeding(part.check):
        clash = clash_in(task.trace, task.theory, stretches, maps_of)
    if clash is not None:
        known.status, known.complete, known.stopped = Status.UNSATISFIABLE, True, None
    return clash


def best_map(parts: Parts) -> Iterator[Priced]:
    """If no map was yielded yet, check the best known map and yield it with its cost."""
    known, watch = parts.known, parts.watch
    watch.start()
    if known.status in (Status.FEASIBLE, Status.OPTIMAL) and not known.count and known.best:
        with suppress(LimitError), heeding(Watch().part(overtime(parts)).check):
            parts.judging.pass_map(known.best, watch.elapsed())
        watch.stop()
        known.count = 1
        note(parts, known.best, known.cost)
        yield known.best, known.cost
    watch.stop()


def overtime(parts: Parts) -> float:
    """Return the seconds that are left to make a map without a search, or to check one."""
    limits = parts.limits
    limit = limits.time_limit if limits.work_limit is None else limits.work_limit
    if parts.known.stopped != parts.limit_reached or limit is None:
        return INTERRUPTED
    return max(parts.watch.left() + OVERTIME_SHARE * limit + OVERTIME, 0.0)
