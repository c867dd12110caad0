"""The search for every minimal map of a trace.

Solving for a prefix, replaying to the end
------------------------------------------
Grounding the axioms for a whole trace costs more than the square of its length, but once a map is closed the rest of the trace
only re-traverses it. So `Search` solves for a prefix, replays the maps found over the whole trace (`steps/log.py`), and extends the
prefix, in the same clingo control, while a replay stops early. This is exact.

*Claim.* Let every minimal map of a prefix, of cost c, replay to the end of the trace. Then the replayed maps are exactly the
minimal maps of the trace, and c is their cost.

*Proof.* (1) A map of the trace, cut down to the prefix, is a map of the prefix: every axiom forbids a pattern of links,
observations and names, and a cut takes patterns away; what the axioms ask for (a course, an order, a side, a heading) the map
of the trace has, and a course that only a later travel supports is dropped together with that travel. Cutting takes no
dstate, place, path or excuse in, so no count grows: the prefix's minimum bounds that of the trace from below.
(2) A map that replays to the end has, over the whole trace, the links and observations that it has over the prefix. The axioms
speak of nothing else, so the replayed map satisfies them, at cost c. By (1), c is the minimum.
(3) A minimal map F of the trace has cost c by (2). Cut down to the prefix it costs at most c in every count, and at least c in
the order of preference by (1), so it is one of the prefix's minimal maps, R. As actions are deterministic and replaying R meets
only links of R, F has the labels of the replayed R, the same links, and so the same support for every course: F is
the replayed R. Different R replay to different maps, as they differ on the prefix already. ∎

*Names for paths.* Grounding grows with the square of the number of names for paths, and most traces have far more segments than their
maps have paths. So a control starts with a few names, and what it finds minimal stands if no map with more paths can be as good:
where fewest paths come first, once there is any map; where fewest dstates come first, once there are half as many names as
dstates in the minimal map, as every path holds the two ends of a travel, and a dstate is along one path (with all_on_paths a path may hold one dstate
alone). Else the control is made again with more names, at most one for each segment of the prefix, which is enough for any map.

A map of the prefix that stops early is no answer; what its continuations are, the longer prefix says. The claim needs
determinism, and that a dstate has one place, course and heading; and that axioms survive the cut. `theory/speedups.py` says for which theories
that is known; any other is solved in one go.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import groupby
from typing import get_args

from ssh_abduction.data.checks import a_count_of_maps, a_flag, an_instance, one_of
from ssh_abduction.data.clock import each_heeding, heeding
from ssh_abduction.data.deprecated import renamed_parameters
from ssh_abduction.data.errors import SolverError, TheoryError, brief, is_whole
from ssh_abduction.data.logs import PROGRESS, log_of
from ssh_abduction.data.maps import SSHMap, checked_map, checked_maps
from ssh_abduction.data.trace import Trace, checked_trace
from ssh_abduction.data.words import counted
from ssh_abduction.solver import choosing, prefixes
from ssh_abduction.solver.asp.limits import LimitError, StageTimeError, Stop, Watch, check_limit
from ssh_abduction.solver.asp.rules import check_rules
from ssh_abduction.solver.backbone import Rivals
from ssh_abduction.solver.candidates import FRAMING_SHARE, Candidates
from ssh_abduction.solver.choosing import may_name, new_engine, takes_all
from ssh_abduction.solver.engines.base import Engine, Found, Task
from ssh_abduction.solver.engines.stepwise import StepEngine
from ssh_abduction.solver.judging import Judging
from ssh_abduction.solver.known import Known
from ssh_abduction.solver.near import NearMinimal, counted_first
from ssh_abduction.solver.prefixes import Prefixes
from ssh_abduction.solver.ranking import Ranking, in_order, noise_warning, units_warning
from ssh_abduction.solver.recorded import Support
from ssh_abduction.solver.result import Solution
from ssh_abduction.solver.sharing import Backbone
from ssh_abduction.solver.steps.certificate import Basis
from ssh_abduction.solver.values import (
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
from ssh_abduction.theory.evidence import evidence_of, said_by
from ssh_abduction.theory.speedups import ALL, Speedups, checked_speedups, row
from ssh_abduction.theory.theory import Theory, checked_theory

ONE_MORE = 1.0  # For so many seconds one more map is sought where as many as asked for are known: it says whether the list is complete.
ONE_MORE_SHARE = 0.1  # Or for such a share of the time that these took, if that is more, so that it is never a large part of the search.
SHORTEST = 0.05  # A trace that was mended has so many seconds at least.
# To make some map where a search was stopped without one, or to check it, may take so many seconds beyond the limit, and such a share of it.
OVERTIME, OVERTIME_SHARE = 0.5, 0.05
INTERRUPTED = 0.6  # Or so many seconds after Ctrl-C, or where memory is over.
REASONING = 5.0  # For so many seconds it is sought what all minimal maps share, where the search took less and has no time limit.
_log = log_of(__name__)


class Search:
    """A stream of the minimal maps of a trace, in constant memory. Iterate once; `solution()` says how it ended.

    Parameters as in `solve`, and, to go on when a trace has grown (`online.py`):

    reasons  whether to find out, at the end, what all minimal maps share, where not all are listed. A share of the time limit is kept for that; without a
             limit it takes as long as the search at most, or REASONING seconds, if that is more
    after    a search of this trace's first steps, which has ended: what it grounded and proved is taken over
    minimal  a map of this trace that costs what `after` proved: it is minimal, and only the others remain to be found
    """

    @renamed_parameters("limit", "maps", "memory")
    def __init__(
        self,
        trace: Trace,
        theory: Theory | None = None,
        *,
        time_limit: float | None = None,
        max_maps: int | None = 100,
        within: int = 0,
        memory_limit: int | None = None,
        speedups: Speedups = ALL,
        on_progress: Callable[[Progress], None] | None = None,
        reasons: bool = False,
        after: Search | None = None,
        minimal: SSHMap | None = None,
    ) -> None:
        checked_trace(trace)
        most = a_count_of_maps(max_maps, SolverError) or 0
        if not is_whole(within) or within < 0:
            raise SolverError(
                f"within (--within): expected a whole number, 0 or more, got {brief(within)}; say how much more than the least a map may cost"
            )
        check_limit("time_limit (--time-limit)", "seconds", time_limit)
        check_limit("memory_limit (--memory-limit)", "MiB", memory_limit)
        if on_progress is not None and not callable(on_progress):
            raise SolverError(
                f"on_progress: expected a function of one Progress, got {brief(on_progress)}"
            )
        a_flag("reasons", reasons, SolverError)
        if after is not None:
            an_instance(
                "after",
                after,
                Search,
                SolverError,
                mend="give the search of the steps before, or leave it out",
            )
        if minimal is not None:
            checked_map(minimal, "minimal")
        self.theory = checked_theory(theory).resolve(trace)
        if within and self.theory.has_faults:
            raise TheoryError(
                "within: expected 0 where faults are allowed; leave it out, or see what each number of faults is worth (--front)"
            )
        check_rules(self.theory)
        self.trace = trace
        self._begun = False
        self._first: SSHMap | None = None  # of the maps that were given
        self._basis: Basis | None = (
            None  # of the certificate of the whole trace, where the search was stopped
        )
        self._most = most
        self.within = int(within)
        self._mends = False  # whether maps were sought by mending the trace
        self._mended_maps: tuple[SSHMap, ...] | None = (
            None  # the minimal maps, where these were found by mending the trace
        )
        self._near: NearMinimal | None = (
            None  # what lists maps that cost more than the least, once these are listed
        )
        self._levels: list[Level] = []
        self._reasons = reasons
        self._cost: tuple[int, ...] = ()  # of the map that was found last: the preferred counts
        self._last: tuple[SSHMap, tuple[int, ...]] | None = (
            None  # the map that was given last, and its preferred counts
        )
        self._goes_on = after is not None
        self._asked_speedups = checked_speedups(speedups)
        self._on_progress = on_progress
        self._news: tuple[Cost | None, Bound] = (None, Bound())  # what was known at the last report
        self._watch = Watch(time_limit, memory_limit, self._report)
        self.limit, self.memory = time_limit, memory_limit
        self._watch.start()  # to compare all pairs of steps may take long
        self._task = Task.of(trace, self.theory, self._watch, speedups)
        self._known = Known(self.theory)
        self._judging = Judging(trace, self.theory)
        self._rivals = Rivals(self._task, self._judging)
        self._candidates = Candidates(self._task, self._known, self._judging, self._report)
        engine = self._engine_after(after) if after else new_engine(self._task)
        self._prefixes = Prefixes(
            self._task, self._known, self._judging, engine, most, self._report
        )
        if after:
            self._take_over(after, minimal)
        self._watch.stop()

    def __repr__(self) -> str:
        best = f", best {counted(len(self.best.dstates), 'dstates')}" if self.best else ""
        return f"<Search of {counted(len(self.trace), 'steps')}: {self.status.value}{best}, {counted(self.count, 'maps')} given>"

    def _engine_after(self, after: Search) -> Engine:
        """The engine of a search of the first steps, which goes on; or a new one, where that one cannot, or was left half told."""
        self._watch.use_reserve()
        before = after._prefixes.engine
        outgrown = not before.goes_on or (isinstance(before, StepEngine) and may_name(self._task))
        engine = new_engine(self._task) if outgrown else before.over(self._task)
        half_told = (
            after.stopped == "interrupted" or not engine.intact
        )  # perhaps while a step was grounded
        return engine.with_paths(engine.paths) if half_told else engine

    def _take_over(self, after: Search, minimal: SSHMap | None) -> None:
        """Take what a search of the first steps proved."""
        known, before = self._known, after._known
        if self._task.speedups.prefixes:
            known.bound, known.lower = before.bound, before.lower
            solved = before.status is Status.OPTIMAL
            self._prefixes.start = (
                len(self.trace)
                if solved
                else max(prefixes.FIRST_PREFIX, self._prefixes.engine.size_to_go_on)
            )
        if minimal is not None:
            known.status, known.best, known.cost = Status.OPTIMAL, minimal, before.cost
            known.raise_bound(known.cost[0] if known.cost else None)

    @property
    def status(self) -> Status:
        """What is known of the trace so far."""
        return self._known.status

    @property
    def bound(self) -> Bound:
        """Proven lower bounds so far."""
        return self._known.bound

    @property
    def best(self) -> SSHMap | None:
        """The best map of the whole trace so far."""
        return self._known.best

    @property
    def stopped(self) -> Stop | None:
        """Why the search ended before it was complete, if it did."""
        return self._known.stopped

    @property
    def complete(self) -> bool:
        """Whether no further minimal map exists."""
        return self._known.complete

    @property
    def count(self) -> int:
        """How many maps were given."""
        return self._known.count

    @property
    def cost(self) -> Cost | None:
        """What the map costs that was given last."""
        return None if self._last is None else cost_as_counted(*self._last, self.theory)

    @property
    def backbone(self) -> Backbone | None:
        """What the minimal maps share that are known so far; None where none is."""
        return self._rivals.backbone

    @property
    def prefix(self) -> int:
        """How many steps clingo was given."""
        return self._engine.size

    @property
    def grounding(self) -> Grounding:
        """Rules and atoms of the ground program that clingo solved last."""
        return self._engine.asker.grounding

    @property
    def _engine(self) -> Engine:
        """The engine that was asked last."""
        return self._near.engine if self._near else self._prefixes.engine

    def __iter__(self) -> Iterator[SSHMap]:
        return self._listed(Ranking(self.trace) if self.theory.displacement == "use" else None)

    def unranked(self) -> Iterator[SSHMap]:
        """As by iteration, but in the order in which maps are found, and without how well they close, which takes its time."""
        return self._listed(None)

    def _listed(self, ranking: Ranking | None) -> Iterator[SSHMap]:
        for cost, level in groupby(self._found(), key=lambda _: self._cost):
            for ssh_map in ranking.ranked(level, self.over) if ranking else level:
                self._take_down(ssh_map, cost)
                yield ssh_map

    def _take_down(self, ssh_map: SSHMap, cost: tuple[int, ...]) -> None:
        """Remember the map that is given, and count it at its level."""
        self._first, self._last = self._first or ssh_map, (ssh_map, cost)
        if not self._levels or self._levels[-1].cost.preferred_by(self.theory) != cost:
            self._levels.append(Level(cost_as_counted(ssh_map, cost, self.theory), 0))
        self._levels[-1] = replace(self._levels[-1], count=self._levels[-1].count + 1)

    def _found(self) -> Iterator[SSHMap]:
        """The maps, level by level, in the order in which they are found; or the best one known."""
        if self._begun:
            raise SolverError(
                "search: expected to be iterated once, got a second time; make another Search"
            )
        self._begun = True
        _log.info("search of %r under %r, with %s", self.trace, self.theory, _name(self._engine))
        self._watch.start()
        try:
            with heeding(self._watch.check):
                self._make_first_map()
                self._find_minimum()
            yield from each_heeding(self._watch.check, self._list_maps())
        except StageTimeError:
            self._known.stopped = "maps limit" if self.count == self._most else "time limit"
        except LimitError as limit:
            self._known.stopped = limit.reason
        except KeyboardInterrupt:
            self._known.stopped = "interrupted"
        except Exception:
            self._prefixes.engine.intact = False
            raise
        finally:
            self._end_clingo()
        self._fall_back()
        yield from self._give_best_map()
        if self._reasons:
            self._reason()
        _log.info(
            "ended after %.2f s%s: %s, %s",
            self._watch.elapsed(),
            f" ({self.stopped})" if self.stopped else "",
            self.status.value,
            self._told,
        )

    def _make_first_map(self) -> None:
        """Make a causal map at once, that clingo has to better."""
        if self.status is not Status.OPTIMAL and len(self.trace) > choosing.FEW_STEPS:
            self._candidates.merge()

    def _find_minimum(self) -> None:
        """Find the minimal cost; where that takes long, seek maps with frames first, and go on with an engine that settles dstates first."""
        engine, steps = self._prefixes.engine, len(self.trace)
        if row("mending").holds_for(self.theory) and may_name(self._task) and self._mend():
            return
        if self._mends and len(self.trace) > choosing.READABLE:
            raise LimitError("no proof")
        if self.status is Status.OPTIMAL:  # a map that another search proved
            if not engine.size:
                engine.grow(steps if engine.lists_least else min(steps, prefixes.FIRST_PREFIX))
            return
        may_take_all = (
            isinstance(engine, StepEngine) and not self._goes_on and takes_all(self._task)
        )
        may_frame = may_take_all and self._task.speedups.framing
        may_settle = may_take_all and self._task.speedups.ways and self._asked_speedups.names
        if (
            may_settle
            and not self._find_minimum_soon(min(choosing.SETTLE_AFTER, choosing.FRAME_AFTER))
            and self._candidates.sketch_least()
        ):
            self._settle_dstates_first()
        elif (
            (may_frame or may_settle)
            and self.status is Status.UNKNOWN
            and not self._find_minimum_soon(choosing.FRAME_AFTER)
        ):
            _log.info("no minimum after %.1f s step by step", self._watch.elapsed())
            if may_frame:
                _log.info("maps in which places have frames are sought as candidates")
                self._candidates.frame(self._asked_speedups)
            if may_settle:
                self._settle_dstates_first()
        if self.status is Status.UNKNOWN:
            self._prefixes.find_minimum()

    def _mend(self) -> bool:
        """Where faults are allowed and there are places: find maps by mending the trace, and say whether all minimal ones are known."""
        from ssh_abduction.solver.mending import Mending  # loads numpy

        self._mends = True
        _log.info("maps with faults are sought by mending the trace")
        mending = Mending(self._task, self._solve_mended)
        self._watch.use_reserve()
        try:
            for found in mending.maps():
                self._candidates.offer(found.map)
                self._known.raise_bound(mending.bound)
                self._report()
            self._mended_maps = mending.minimal_maps(self._most and self._most + 1)
        finally:
            self._known.raise_bound(mending.bound)
            mending.settle()
        if self._mended_maps:
            self._known.status = Status.OPTIMAL
            self._known.keep(
                Found.of(self._mended_maps[0], self.theory), self._mended_maps[0].labels
            )
            self._rivals.reasons = False  # its engines know nothing of mended traces
        return bool(self._mended_maps)

    def _solve_mended(
        self, mended: Trace, theory: Theory, most: int, seconds: float
    ) -> tuple[tuple[SSHMap, ...], bool]:
        """The minimal maps of a mended trace, so many at most, and True; or the best one known after so many seconds, and False."""

        def end_with_this_search(_: Progress) -> None:
            self._watch.check()

        search = Search(
            mended,
            theory,
            time_limit=None if seconds == math.inf else max(seconds, SHORTEST),
            max_maps=most or None,
            memory_limit=self.memory,
            speedups=self._asked_speedups,
            on_progress=end_with_this_search,
        )
        maps = tuple(search.unranked())
        if search.stopped == "interrupted":
            self.interrupt()
        return maps, search.status in (Status.OPTIMAL, Status.UNSATISFIABLE)

    def _find_minimum_soon(self, seconds: float) -> bool:
        """Find the minimal cost step by step, if that is done within so many seconds from the start, or a share of the time that is left."""
        self._watch.end_stage_after(
            self._watch.elapsed() + min(seconds, FRAMING_SHARE * self._watch.left())
        )
        try:
            self._prefixes.find_minimum()
        except StageTimeError:
            self._prefixes.start = max(self._prefixes.start, self.prefix)
            return False
        finally:
            self._watch.end_stage_after(math.inf)
        return True

    def _settle_dstates_first(self) -> None:
        """Go on with the engine that settles dstates before places and paths, if the trace is known to have some map."""
        labels = self.best.labels if self.best else ()
        self._candidates.sketch()
        if self.best is not None:
            from ssh_abduction.solver.engines.frameless import FramelessEngine

            _log.info(
                "dstates are settled before places and paths, from a map of %d dstates",
                len(self.best.dstates),
            )
            self._prefixes.go_on_with(FramelessEngine(self._task, labels), len(self.trace))

    def _list_maps(self) -> Iterator[SSHMap]:
        """Give the maps, as many as were asked for, once they have passed the checker. The clock stands still while the caller has one."""
        if self.status is Status.OPTIMAL:
            _log.info("minimal maps cost %s; they are listed", self._told_cost)
            ends = self._watch.reserve_begins if self._reasons else math.inf
            ends = ends if ends > self._watch.elapsed() else math.inf
            self._watch.end_stage_after(ends)
            for ssh_map, cost in self._maps_by_cost():
                if self._most and self.count == self._most:
                    self._known.stopped = "maps limit"
                    return
                self._judging.pass_map(ssh_map, self.prefix, self._watch.elapsed())
                # The first map is the best one: so the cost is its, also in the counts that the theory does not prefer.
                self._known.best = self.best if self.count else ssh_map
                self._known.count += 1
                self._note(ssh_map, cost)
                self._report()
                self._watch.stop()
                yield ssh_map
                self._watch.start()
                if self.count == self._most:
                    spent = self._watch.elapsed()
                    self._watch.end_stage_after(
                        min(ends, spent + max(ONE_MORE, ONE_MORE_SHARE * spent))
                    )
        self._known.complete = True

    def _maps_by_cost(self) -> Iterator[tuple[SSHMap, tuple[int, ...]]]:
        """The minimal maps, and behind them those that cost up to `within` more, each with its preferred counts."""
        minimal = self._mended_maps or self._prefixes.minimal_maps()
        yield from ((ssh_map, self._known.cost) for ssh_map in minimal)
        self._rivals.listed = True  # so no time is kept for reasoning
        if not self._most or self.count < self._most:
            self._watch.end_stage_after(math.inf)
        if self.within and counted_first(self.theory):
            self._prefixes.engine.settle()
            self._near = NearMinimal(
                self._task, self._judging, self._most, self._report, self._prefixes.engine.asker
            )
            yield from self._near.maps(self._known.cost, self.within)

    def _note(self, ssh_map: SSHMap, cost: tuple[int, ...]) -> None:
        """Note what a map costs that is found, and what it shares with the others."""
        self._cost = cost
        if self.status is Status.OPTIMAL and cost == self._known.cost:
            self._rivals.add(ssh_map, cost)

    def _end_clingo(self) -> None:
        """End what is still under way, and take the bound that it leaves."""
        self._watch.end_stage_after(math.inf)
        self._watch.stop()
        self._prefixes.engine.settle()
        self._known.raise_bound(self._prefixes.engine.bound)
        self._rivals.engine = (
            None
            if self._rivals.listed or not self._prefixes.engine.intact
            else self._prefixes.engine
        )

    def _fall_back(self) -> None:
        """Where the search was stopped: some map of the whole trace, if there was none, and a bound that takes no search."""
        if not self.stopped or self.status is Status.OPTIMAL:
            return
        may_salvage = (
            self.best is None
            and self.stopped == "time limit"
            and self._watch.has_reserve
            and not self._mends
        )
        with suppress(KeyboardInterrupt):
            self._candidates.sketch(self._overtime)
        if may_salvage:
            self._salvage()
        self._count_apart()
        if self.best is not None and self.status is Status.UNKNOWN:
            self._known.status = Status.FEASIBLE

    @property
    def _overtime(self) -> float:
        """The seconds that are left for making some map without a search, or for checking one: a little more than the limit allows."""
        if self.stopped != "time limit" or self.limit is None:
            return INTERRUPTED
        return max(self._watch.left(), 0.0) + OVERTIME_SHARE * self.limit + OVERTIME

    def _salvage(self) -> None:
        """In the last part of the time limit, look for any map of the whole trace."""
        _log.info("in the last part of the time limit any map is sought")
        self._watch.use_reserve()
        self._watch.start()
        self._known.lower = None  # a map as cheap as proved is what was not found
        try:
            with heeding(self._watch.check):
                self._prefixes.engine.grow(len(self.trace))
                self._known.status = (
                    Status.OPTIMAL if self._prefixes.minimise() else Status.UNSATISFIABLE
                )
        except LimitError as limit:
            self._known.stopped = limit.reason
        except KeyboardInterrupt:
            self._known.stopped = "interrupted"
        self._end_clingo()

    def _give_best_map(self) -> Iterator[SSHMap]:
        """Where no minimal map was listed, the best one known is the answer, once it has passed the checker."""
        if (
            self.status in (Status.FEASIBLE, Status.OPTIMAL)
            and not self.count
            and self.best is not None
        ):
            with suppress(LimitError), heeding(Watch().part(self._overtime).check):
                self._judging.pass_map(self.best, self.prefix, self._watch.elapsed())
            self._known.count = 1
            self._note(self.best, self._known.cost)
            yield self.best

    def _reason(self) -> None:
        """Find out what all minimal maps share, where not all are listed."""
        self._watch.use_reserve()
        self._watch.start()
        spent = self._watch.elapsed()
        self._watch.end_stage_after(
            spent + max(REASONING, spent) if self._watch.left() == math.inf else math.inf
        )
        with heeding(self._watch.check):
            self._rivals.reason()
        self._watch.end_stage_after(math.inf)
        self._watch.stop()

    def interrupt(self) -> None:
        """End the search soon, with the best answer so far. For signal handlers and other threads."""
        self._watch.interrupted = True

    def over(self) -> bool:
        """Whether the limits are over or the search was interrupted: for what is still to be done with its result. The clock runs on."""
        if not self._watch.running:
            self._watch.use_reserve()
            self._watch.start()
        try:
            self._watch.check()
        except LimitError as limit:
            self._known.stopped = limit.reason
            return True
        return False

    def solution(self, maps: tuple[SSHMap, ...] = ()) -> Solution:
        """How the search ended, with the maps that the caller kept. If these are all that were given, and no minimal map is missing, they are put in an order that is
        the same in each run (`solver/ranking.py`).
        """
        maps = checked_maps(maps)
        if self._known.complete or self._rivals.listed:
            maps = self._in_order(maps)
        return self._solution(maps, self.grounding)

    def _solution(self, maps: tuple[SSHMap, ...], grounding: Grounding) -> Solution:
        asker = self._engine.asker
        # Perhaps the search ended while the prefix was given to clingo: then what shows the bound is sought in all steps.
        ran_out = self.stopped not in (None, "maps limit")
        basis = self._basis or self._basis_of(
            len(self.trace) if ran_out else self._prefixes.engine.size
        )
        levels = tuple(self._levels)
        if self._rivals.listed:
            levels = tuple(replace(level, complete=True) for level in levels)
        odometry_warning = None
        if self._first and self._first.fit:
            odometry_warning = units_warning(self.trace) or noise_warning(
                self._first.fit, self.trace
            )
        return Solution(
            status=self.status,
            maps=maps,
            cost=levels[0].cost if levels else self._known.best_cost,
            bound=self.bound,
            complete=self.complete,
            theory=self.theory,
            steps=len(self.trace),
            effort=Effort(
                self.prefix,
                Seconds(self._watch.elapsed(), asker.ground_seconds, asker.solve_seconds),
                grounding,
                said_by(evidence_of(self.theory), self.trace, self._known.refused),
            ),
            stopped=self.stopped,
            partial=None if self.best else self._known.partial,
            within=self.within,
            levels=levels,
            shared=self._rivals.backbone,
            trace=self.trace,
            support=Support(basis, odometry_warning),
        )

    def _in_order(self, maps: tuple[SSHMap, ...]) -> tuple[SSHMap, ...]:
        """All maps that were given, in their order; each level costs what its first map does."""
        if not maps or len(maps) < sum(level.count for level in self._levels):
            return maps
        ordered = in_order(maps, [level.count for level in self._levels])
        begin = 0
        for i, level in enumerate(self._levels):
            cost = level.cost.preferred_by(self.theory)
            self._levels[i] = replace(
                level, cost=cost_as_counted(ordered[begin], cost, self.theory)
            )
            begin += level.count
        return ordered

    def snapshot(self, stopped: Stop) -> Solution:
        """What is known while the search is still under way in another thread that cannot be stopped. The program ends then: it is of no use any more.

        stopped  why it is to end
        """
        one_of("stopped", stopped, get_args(Stop), SolverError)
        with suppress(
            Exception
        ):  # what the other thread changes meanwhile: a bound is a bound, and a map a map, without that
            if self.status in (Status.UNKNOWN, Status.FEASIBLE):
                self._candidates.sketch(OVERTIME)
        self._known.raise_bound(self._prefixes.engine.bound)
        best = self.best
        if best is not None and self.status is Status.UNKNOWN:
            self._known.status = Status.FEASIBLE
        self._known.stopped = stopped
        # Clingo is not asked how large its program is while another thread is in it.
        return replace(
            self._solution(() if best is None else (best,), Grounding(0, 0)),
            complete=self.status is Status.UNSATISFIABLE,
        )

    def _basis_of(self, size: int) -> Basis | None:
        """What shows that no map has fewer dstates: of the first `size` steps."""
        if not row("clique").holds_for(self.theory):
            return None
        number: dict[object, int] = {}
        views = tuple(
            number.setdefault(step.view, len(number)) for step in self.trace.steps[: max(size, 1)]
        )
        return Basis(
            views, tuple(self._task.log.actions[: len(views) - 1]), self.bound.dstates or 0
        )

    def _count_apart(self) -> None:
        """Where the search was stopped: the steps of the whole trace that are pairwise apart are a bound, too."""
        self._basis = self._basis_of(len(self.trace))
        if self._basis:
            apart = len(self._basis.certificate.clique)
            self._known.bound = replace(self.bound, dstates=max(apart, self.bound.dstates or 0))

    def _report(self) -> None:
        if self._on_progress is None and not PROGRESS.isEnabledFor(logging.INFO):
            return
        progress = Progress(
            self.prefix,
            len(self.trace),
            self._known.best_cost,
            self.bound,
            self.count,
            self._watch.elapsed(),
        )
        news = (progress.cost, progress.bound)
        PROGRESS.log(logging.DEBUG if news == self._news else logging.INFO, "%s", progress.sentence)
        self._news = news
        if self._on_progress is not None:
            self._on_progress(progress)

    @property
    def _told_cost(self) -> str:
        cost = self._known.best_cost
        return (
            "nothing that is counted"
            if cost is None
            else ", ".join(counted(v, k) for k, v in cost.to_dict().items())
        )

    @property
    def _told(self) -> str:
        """How many maps were given, and whether these are all."""
        return f"{counted(self.count, 'maps')}{'' if self.complete else ', perhaps not all'}"


def _name(engine: Engine) -> str:
    return type(engine).__name__
