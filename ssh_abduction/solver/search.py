"""Every minimal map of a trace.

>>> from ssh_abduction import Theory, Trace, solve
>>> trace = Trace.from_steps(views=["end", "end", "end"], actions=["travel", "around"])
>>> solution = solve(trace, Theory.topological())
>>> solution.status.value, solution.cost.dstates, solution.complete
('optimal', 3, True)

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

*Names for paths.* Grounding grows with the square of the number of names for paths, and most traces have far more legs than their
maps have paths. So a control starts with a few names, and what it finds minimal stands if no map with more paths can be as good:
where fewest paths come first, once there is any map; where fewest dstates come first, once there are half as many names as
dstates in the minimal map, as every path holds the two ends of a travel, and a dstate is along one path (with all_on_paths a path may hold one dstate
alone). Else the control is made again with more names, at most one for each leg of the prefix, which is enough for any map.

*From below.* By (1) the minimum does not fall from prefix to prefix. So a prefix of more than FEW_STEPS is first asked for a map that costs what was
proved for a shorter one: that is quick where it exists, and then minimal without another proof.

A map of the prefix that stops early is no answer; what its continuations are, the longer prefix says. The claim needs
determinism, and that a dstate has one place, course and heading; and that axioms survive the cut. `theory/speedups.py` says for which theories
that is known; any other is solved in one go.
"""

from __future__ import annotations

import itertools
import math
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Any

from ssh_abduction.asp import facts
from ssh_abduction.asp.control import Grounding
from ssh_abduction.asp.limits import Paused, Stop, Stopped, Watch, check_limit
from ssh_abduction.asp.rules import check_rules
from ssh_abduction.engines.base import AT_ONCE, Cost, Engine, Found
from ssh_abduction.engines.stepwise import StepEngine
from ssh_abduction.errors import SolverError, brief
from ssh_abduction.guesses.tree import Sketch
from ssh_abduction.judge.checker import check, unchecked
from ssh_abduction.maps import SSHMap
from ssh_abduction.solver.judging import Judging
from ssh_abduction.solver.result import Bound, Progress, Seconds, Solution, Status
from ssh_abduction.steps.certificate import Evidence
from ssh_abduction.steps.log import Log, Outcome, Replay
from ssh_abduction.theory.evidence import Equality, evidence_of
from ssh_abduction.theory.speedups import Speedups, checked_speedups, row
from ssh_abduction.theory.theory import Theory, checked_theory
from ssh_abduction.trace import Trace, checked_trace

FIRST_PREFIX = 8  # steps; short enough that solving it costs next to nothing
HELD_BACK = 1000  # maps kept until a prefix proves long enough; from there on they stream
FIRST_PATHS = 8  # names for paths to begin with
FEW_STEPS = 24  # of a trace or a prefix; so many are solved sooner without names, a map made greedily, or a question from below
ONE_MORE = 1.0  # seconds for which one more map is sought, where as many as asked for are known,
ONE_MORE_SHARE = 0.1  # or so much of the time they took, if that is more
FRAME_AFTER = 1.0  # seconds after which a map with frames is sought, where the theory does not ask for one
FRAMING = 30.0  # seconds that this may take, at most
FRAMING_SHARE = 0.4  # of the time that is left, for either, if that is less
UNMAPPED = 2.0  # times as long that may take until there is any map
ALL = Speedups()


def solve(
    trace: Trace,
    theory: Theory | None = None,
    *,
    limit: float | None = None,
    maps: int = 100,
    memory: int | None = None,
    speedups: Speedups = ALL,
    on_progress: Callable[[Progress], None] | None = None,
    **choices: Any,
) -> Solution:
    """Find the minimal maps of a trace.

    theory       which axioms and which preference; Theory.topological() by default
    limit        seconds of wall-clock time; when they are over, the best answer so far is returned
    maps         list at most so many maps; 0 lists all (take `Search` to stream them). Where there are so many, one more is sought for a second,
                 or a tenth of the time so far: only if that ends the answer is complete
    memory       MiB of memory that the process may use at its peak before the search stops
    speedups     which speed-ups are on; none changes the answer
    on_progress  is told now and then how far the search is
    choices      fields of Theory, laid over it: rules=["own.lp"], same=[(3, 12)], different=[(0, 4)], …

    Ctrl-C ends the search like a limit does. Raises TraceError or TheoryError where the trace lacks what the theory needs.
    Source: Kuipers & Beeson 2002, "Bootstrap Learning for Place Recognition", step 2.
    """
    theory = checked_theory(theory).replace(**choices)
    theory.check_steps(checked_trace(trace))
    search = Search(trace, theory, limit=limit, maps=maps, memory=memory, speedups=speedups, on_progress=on_progress)
    return search.solution(tuple(search))


class Search:
    """A stream of the minimal maps of a trace, in constant memory. Iterate once; `solution()` says how it ended.

    Parameters as in `solve`, and, to go on when a trace has grown (`online.py`):

    after    a search of this trace's first steps, which has ended: what it grounded and proved is taken over
    minimal  a map of this trace that costs what `after` proved: it is minimal, and only the others remain to be found
    """

    def __init__(
        self,
        trace: Trace,
        theory: Theory | None = None,
        *,
        limit: float | None = None,
        maps: int = 100,
        memory: int | None = None,
        speedups: Speedups = ALL,
        on_progress: Callable[[Progress], None] | None = None,
        after: Search | None = None,
        minimal: SSHMap | None = None,
    ) -> None:
        checked_trace(trace)
        if isinstance(maps, bool) or not hasattr(maps, "__index__"):
            raise SolverError(f"maps (--maps): expected a whole number, 0 for all, got {brief(maps)}")
        if maps < 0:
            raise SolverError(f"maps (--maps): expected 0 (all) or more, got {maps}")
        check_limit("limit (--time-limit)", "seconds", limit)
        check_limit("memory (--memory-limit)", "MiB", memory)
        if on_progress is not None and not callable(on_progress):
            raise SolverError(f"on_progress: expected a function of one Progress, got {brief(on_progress)}")
        self.theory = checked_theory(theory).resolve(trace)
        check_rules(self.theory)
        self.trace = trace
        self.status = Status.UNKNOWN
        self.bound = Bound()
        self.best: SSHMap | None = None
        self.partial: SSHMap | None = None
        self.stopped: Stop | None = None
        self.complete = False
        self.count = 0
        self._cost: tuple[int, ...] = ()
        self._begun = False
        self._sketching = (
            threading.Lock()
        )  # so that whoever asks for a snapshot waits for a sketch that is nearly done, rather than make another one
        self._apart: Evidence | None = None  # of the whole trace, where the search was stopped
        self._most = maps
        self._goes_on = after is not None
        self._log = Log(trace, self.theory)
        self._asked_speedups = checked_speedups(speedups)
        self._speedups = speedups.that_hold_for(self.theory)
        self._whole = not self._speedups.prefixes
        self._refusing = evidence_of(self.theory)
        self._judging = Judging(trace, self.theory)
        self._on_progress = on_progress
        self._watch = Watch(limit, memory, self._report)
        self._lower: tuple[int, ...] | None = None  # no map of the trace costs less
        self._start = len(trace) if self._whole else FIRST_PREFIX
        if after is None:
            self._engine = self._new_engine()
            return
        self._watch.use_reserve()
        outgrown = not after._engine.goes_on or (isinstance(after._engine, StepEngine) and self._names_pay())
        self._engine = self._new_engine() if outgrown else after._engine.over(trace, self._watch, self._log)
        if after.stopped == "interrupted" or not self._engine.intact:  # perhaps while a step was grounded
            self._engine = self._engine.with_paths(self._engine.paths)
        if not self._whole:
            self.bound, self._lower = after.bound, after._lower
            self._start = len(trace) if after.status is Status.OPTIMAL else max(FIRST_PREFIX, self._engine.size_to_go_on)
        if minimal is not None:
            self.status, self.best, self._cost = Status.OPTIMAL, minimal, after._cost
            self._raise_bound(self._cost[0] if self._cost else None)

    def _names_pay(self) -> bool:
        """Whether the theory lets dstates have names beforehand, and the trace is long enough for that to pay."""
        return self._speedups.names and len(self.trace) > FEW_STEPS

    def _new_engine(self) -> Engine:
        theory = self.theory
        if self._names_pay():  # loads numpy, which takes longer than to solve a short trace
            from ssh_abduction.engines.causal import NamedEngine
            from ssh_abduction.engines.framed import FramedEngine

            engine = NamedEngine if theory.level == "causal" else FramedEngine
            return engine(self.trace, theory, self._watch, self._log, self._speedups)
        most = facts.most_paths(self.trace, theory, len(self.trace))
        return StepEngine(self.trace, theory, self._watch, min(FIRST_PATHS, most) if self._speedups.path_names else most)

    @property
    def prefix(self) -> int:
        """How many steps clingo was given."""
        return self._engine.size

    @property
    def grounding(self) -> Grounding:
        """Rules and atoms of the ground program that clingo solved last."""
        return self._engine.grounding

    def __iter__(self) -> Iterator[SSHMap]:
        if self._begun:
            raise SolverError("search: expected to be iterated once, got a second time; make another Search")
        self._begun = True
        self._watch.start()
        try:
            if self.status is not Status.OPTIMAL:
                if len(self.trace) > FEW_STEPS:
                    self._merge()
            elif not self.prefix:
                self._engine.grow(len(self.trace) if self._engine.lists_least else min(len(self.trace), FIRST_PREFIX))
            if self.status is Status.OPTIMAL or self._find_cost_or_pause():
                for ssh_map in self._minimal_maps():
                    if self._most and self.count == self._most:
                        self.stopped = "maps limit"
                        return
                    self._judging.pass_map(ssh_map, self.prefix, self._watch.elapsed())
                    # The first map is the best one: so the cost is its, also in the counts that the theory does not prefer.
                    self.count, self.best = self.count + 1, self.best if self.count else ssh_map
                    self._report()
                    self._watch.stop()
                    yield ssh_map
                    self._watch.start()
                    if self.count == self._most:
                        self._watch.pause_after(self._watch.elapsed() + max(ONE_MORE, ONE_MORE_SHARE * self._watch.elapsed()))
                self.complete = True
            elif self.status is Status.UNSATISFIABLE:
                self.complete = True
        except Paused:
            self.stopped = "maps limit"
        except Stopped as stop:
            self.stopped = stop.reason
        except KeyboardInterrupt:
            self.stopped = "interrupted"
        except Exception:
            self._engine.intact = False
            raise
        finally:
            self._watch.pause_after(math.inf)
            self._watch.stop()
            self._engine.settle()
        self._raise_bound(self._engine.bound)
        self._fall_back()
        if self.status in (Status.FEASIBLE, Status.OPTIMAL) and not self.count and self.best is not None:
            self._judging.pass_map(self.best, self.prefix, self._watch.elapsed())
            self.count = 1
            yield self.best

    def _fall_back(self) -> None:
        """Where the search was stopped: some map of the whole trace, if there was none, and a bound that takes no search."""
        if self.stopped and self.status is not Status.OPTIMAL:
            if self.best is None and self.stopped == "time limit" and self._watch.has_reserve:
                self._salvage()
            self._sketch()
            self._count_apart()
            if self.best is not None and self.status is Status.UNKNOWN:
                self.status = Status.FEASIBLE

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
        except Stopped as stop:
            self.stopped = stop.reason
            return True
        return False

    def solution(self, maps: tuple[SSHMap, ...] = ()) -> Solution:
        """How the search ended, with the maps that the caller kept."""
        ran_out = self.stopped not in (
            None,
            "maps limit",
        )  # perhaps while the prefix was given to clingo: then what shows the bound is sought in all steps
        evidence = self._apart or self._evidence(len(self.trace) if ran_out else self.prefix)
        return Solution(
            status=self.status,
            maps=maps,
            cost=self._best_cost(),
            bound=self.bound,
            complete=self.complete,
            theory=self.theory,
            steps=len(self.trace),
            prefix=self.prefix,
            evidence=evidence,
            seconds=Seconds(self._watch.elapsed(), self._engine.ground_seconds, self._engine.solve_seconds),
            stopped=self.stopped,
            partial=None if self.best else self.partial,
        )

    def snapshot(self, stopped: Stop) -> Solution:
        """What is known while the search is still under way in another thread that cannot be stopped. The program ends then: it is of no use any more.

        stopped  why it is to end
        """
        with suppress(Exception):  # what the other thread changes meanwhile: a bound is a bound, and a map a map, without that
            if self.status in (Status.UNKNOWN, Status.FEASIBLE):
                self._sketch()
        self._raise_bound(self._engine.bound)
        best = self.best
        known = () if best is None else (best,)
        if best is not None and self.status is Status.UNKNOWN:
            self.status = Status.FEASIBLE
        self.stopped = stopped
        return replace(self.solution(known), complete=self.status is Status.UNSATISFIABLE)

    def _evidence(self, size: int) -> Evidence | None:
        """What shows that no map has fewer dstates: of the first `size` steps."""
        if not row("clique").holds_for(self.theory):
            return None
        number: dict[object, int] = {}
        views = tuple(number.setdefault(step.view, len(number)) for step in self.trace.steps[: max(size, 1)])
        return Evidence(views, tuple(self._log.actions[: len(views) - 1]), self.bound.dstates or 0)

    def _count_apart(self) -> None:
        """Where the search was stopped: the steps of the whole trace that are pairwise apart are a bound, too."""
        self._apart = self._evidence(len(self.trace))
        if self._apart:
            self.bound = replace(self.bound, dstates=max(len(self._apart.certificate.clique), self.bound.dstates or 0))

    def _find_cost_or_pause(self) -> bool:
        """The same as _find_cost; where that takes long, seek a map with frames first, and go on from there, with names for dstates."""
        may_frame, may_name = self._may_frame(), self._may_name()
        if may_frame or may_name:
            self._watch.pause_after(min(FRAME_AFTER, FRAMING_SHARE * self._watch.left()))
            try:
                return self._find_cost()
            except Paused:
                pass
            finally:
                self._watch.pause_after(math.inf)
            self._start = max(self._start, self.prefix)
            if may_frame:
                self._frame()
            if may_name:
                self._name_dstates()
        return self._find_cost()

    def _may_frame(self) -> bool:
        """Whether a map in which places have frames is worth seeking. While a robot drives there are sketches."""
        return self._speedups.framing and self._may_take_all()

    def _may_name(self) -> bool:
        """Whether dstates can be settled first, with names, though places have no frames."""
        return self._speedups.ways and self._asked_speedups.names and self._may_take_all()

    def _may_take_all(self) -> bool:
        """Whether something else than step by step is worth it, and the trace not too long for all of it at once."""
        return isinstance(self._engine, StepEngine) and not self._goes_on and FEW_STEPS < len(self.trace) <= AT_ONCE

    def _frame(self) -> None:
        """Seek maps in which places have frames."""
        from ssh_abduction.engines.framing import maps_with_frames  # loads numpy

        seconds = min(FRAMING, FRAMING_SHARE * self._watch.left())
        watch = self._watch.part(UNMAPPED * seconds)
        try:
            for ssh_map in maps_with_frames(self.trace, self.theory, watch, self._asked_speedups):
                watch.shorten(seconds)
                found = Found.of(ssh_map, self.theory)
                if (self.best is None or found.cost < self._cost) and self._satisfies(ssh_map):
                    self._keep(found, ssh_map.labels)
                    self._report()
        except Stopped:
            self._watch.check()

    def _name_dstates(self) -> None:
        """Go on with the engine that settles dstates first, if the trace is known to have some map."""
        known = self.best.labels if self.best else None
        self._sketch()
        if self.best is not None:
            from ssh_abduction.engines.frameless import WaysEngine

            self._engine = WaysEngine(self.trace, self.theory, self._watch, self._log, self._speedups, known)
            self._start = len(self.trace)

    def _find_cost(self) -> bool:
        """Extend the prefix until a minimal map of it replays to the end. False where the prefix has no map."""
        size = min(len(self.trace), self._start)
        while True:
            if size == len(self.trace):
                self._watch.use_reserve()  # which is for a search like this one
            self._engine.grow(size)
            minimal = self._minimise()
            if minimal is None:
                self.status = Status.UNSATISFIABLE
                return False
            self._raise_bound(minimal.cost[0] if minimal.cost else None)
            if self._lower is None or minimal.cost > self._lower:
                self._lower = minimal.cost
            replayed = self._replay(minimal.map)
            if replayed.outcome is Outcome.PREDICTED and not self._refused(replace(minimal.map, labels=replayed.labels)):
                self._keep(minimal, replayed.labels)
                self.status = Status.OPTIMAL
                return True
            if self.best is not None and self._cost <= minimal.cost:  # a map of the whole trace, as cheap as any of the prefix
                self.status = Status.OPTIMAL
                return True
            size = self._engine.next_size(len(replayed.labels))

    def _raise_bound(self, proven: int | None) -> None:
        first = self.theory.priorities[0] if self.theory.priorities else None
        if first and proven is not None and proven > (getattr(self.bound, first) or 0):
            self.bound = replace(self.bound, **{first: proven})

    def _merge(self) -> None:
        """A causal map at once, that clingo has to better."""
        if self._speedups.greedy and self.theory.level == "causal":
            found = facts.causal_map(self._log.merged(), self.trace)
            if self._satisfies(found):
                self._keep(Found.of(found, self.theory), found.labels)

    def _sketch(self) -> None:
        """Where there is no map of the whole trace yet: some map, made without a search; what goes on beyond that of a prefix, if it is better."""
        with self._sketching:
            if self.best is None and self._speedups.greedy and not unchecked(self.theory):
                self._sketch_anew()

    def _sketch_anew(self) -> None:
        self._merge()
        if self.best is not None:
            return
        trace, first = self.trace, self.trace.steps[0]
        beyond = [Sketch.beyond(self.partial, trace.prefix(len(self.partial.labels)), self.theory)] if self.partial else []
        for sketch in (*beyond, *Sketch.all_of(first, self.theory)):
            later = zip(trace.actions[len(sketch.labels) - 1 :], trace.steps[len(sketch.labels) :], strict=True)
            if all(sketch.extend(action, step) for action, step in later):
                found = Found.of(sketch.map(), self.theory)
                if (self.best is None or found.cost < self._cost) and self._satisfies(found.map):
                    self._keep(found, found.map.labels)
                if sketch not in beyond:
                    return

    def _satisfies(self, ssh_map: SSHMap) -> bool:
        """Whether a map of the whole trace that nothing proves yet is known to satisfy all axioms."""
        return not unchecked(self.theory) and not check(self.trace, ssh_map, self.theory) and not self._refused(ssh_map)

    def _refused(self, ssh_map: SSHMap) -> frozenset[Equality] | None:
        """Equalities of a map that some evidence finds out cannot all hold; None where it refuses none."""
        return next((found for evidence in self._refusing if (found := evidence.refuse(self.trace, ssh_map))), None)

    def _replay(self, ssh_map: SSHMap, known: int | None = None) -> Replay:
        """The trace replayed over a map of a prefix, of which so many steps make links."""
        return self._log.replay(ssh_map.labels, known, [s.place for s in ssh_map.dstates] if self._log.pairs else None)

    def _minimise(self) -> Found | None:
        """A minimal map of the prefix that no evidence refuses, or None where it has no map.

        What is refused of a map that clingo finds is forbidden, and clingo is asked again: the bounds of what it knew before still hold.
        """
        while True:
            minimal = self._minimise_as_known()
            refused = self._refused(minimal.map) if minimal else None
            if not refused:
                return minimal
            self._engine.forbid(refused)

    def _minimise_as_known(self) -> Found | None:
        """A minimal map of the prefix by what clingo knows, or None. Better maps of the whole trace are kept on the way."""
        while True:
            minimal = None
            for found in self._candidates():
                minimal = found
                self.partial = found.map
                replayed = self._replay(found.map)
                better = self.best is None or found.cost < self._cost
                if better and replayed.outcome is Outcome.PREDICTED and not self._refused(replace(found.map, labels=replayed.labels)):
                    self._keep(found, replayed.labels)
                self._report()
                if not self._whole and self._lower is not None and found.cost <= self._lower:
                    break
            if not self._name_paths(minimal.cost if minimal else None):
                return minimal

    def _candidates(self) -> Iterator[Found]:
        """Maps of the prefix that end with a minimal one: one as cheap as was proved before, or else ever better ones."""
        below = self._speedups.from_below and not self._whole and self.prefix > FEW_STEPS and isinstance(self._engine, StepEngine)
        if self._lower is not None and below:
            yield from itertools.islice(self._engine.maps_of_cost(self._lower, 1), 1)
        yield from self._engine.improving_maps(self._cost if self.best and not self._whole else ())

    def _name_paths(self, cost: tuple[int, ...] | None) -> bool:
        """Take a control with more names for paths, if the minimal cost found needs them. Says whether it was so."""
        needed = self._paths_needed(cost)
        if needed <= self._engine.paths:
            return False
        size = self.prefix
        self._engine = self._engine.with_paths(needed)
        self._engine.grow(size)
        return True

    def _paths_needed(self, cost: tuple[int, ...] | None) -> int:
        """How many names for paths it takes to be sure that no map of the prefix has another cost, or is missed at this one."""
        legs = facts.most_paths(self.trace, self.theory, self.prefix)
        first = self.theory.priorities[0] if self.theory.priorities else None
        if self.theory.level == "causal":
            return 0
        if cost is None or not self._speedups.path_names or first not in ("paths", "dstates"):
            return legs
        if first == "paths":
            return cost[0]
        return min(legs, cost[0] // (1 if "course_needs_travel" in self.theory.given_up else 2))

    def _keep(self, found: Found, labels: tuple[int, ...]) -> None:
        self.best = replace(found.map, labels=labels)
        self._cost = found.cost
        self._watch.use_reserve()

    def _minimal_maps(self) -> Iterator[SSHMap]:
        """Every map of minimal cost, once, after those of the longest prefix that is needed have been seen to replay."""
        streamed: list[int] = []  # prefixes whose completely replayed maps went out already
        enough = min(HELD_BACK, self._most + 1) if self._most else HELD_BACK
        while True:
            held: list[SSHMap] = []
            stuck = 0
            streaming = self.prefix == len(self.trace)
            try:
                for found in self._engine.maps_of_cost(self._cost, self._most and self._most + 1):
                    replayed = self._replay(found.map)
                    if replayed.outcome is not Outcome.PREDICTED:
                        stuck = max(stuck, len(replayed.labels))
                        if streaming:
                            continue
                        break
                    if any(self._replay(found.map, size).outcome is Outcome.PREDICTED for size in streamed):
                        continue
                    whole = replace(found.map, labels=replayed.labels)
                    if self._refused(whole):
                        continue
                    if streaming:
                        yield whole
                        continue
                    held.append(whole)
                    if len(held) == enough:
                        streaming = True
                        yield from held
                        held = []
            except Stopped:
                yield from held  # they replay at the proven cost: they are minimal
                raise
            if not stuck:
                yield from held
                return
            if streaming:
                streamed.append(self.prefix)
            try:
                self._engine.grow(self._engine.next_size(stuck))
                self._name_paths(self._cost)
            except Stopped:
                yield from held
                raise

    def _salvage(self) -> None:
        """In the last part of the time limit, look for any map of the whole trace."""
        self._watch.use_reserve()
        self._watch.start()
        self._lower = None  # a map as cheap as proved is what was not found
        try:
            self._engine.grow(len(self.trace))
            self.status = Status.OPTIMAL if self._minimise() else Status.UNSATISFIABLE
        except Stopped as stop:
            self.stopped = stop.reason
        except KeyboardInterrupt:
            self.stopped = "interrupted"
        self._raise_bound(self._engine.bound)
        self._engine.settle()
        self._watch.stop()

    def _best_cost(self) -> Cost | None:
        """The counts of the best map; where axioms are left out, clingo may count more places or paths than the map can show."""
        return replace(Cost.of(self.best), **dict(zip(self.theory.priorities, self._cost, strict=True))) if self.best else None

    def _report(self) -> None:
        if self._on_progress is not None:
            self._on_progress(Progress(self.prefix, len(self.trace), self._best_cost(), self.bound, self.count, self._watch.elapsed()))
