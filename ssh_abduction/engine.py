"""Engines: what asks clingo for maps of a growing prefix of a trace, and the limits that they keep."""

from __future__ import annotations

import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any, Literal, Self, TypeAlias, TypeVar

import clingo

from ssh_abduction import encodings, facts
from ssh_abduction.maps import SSHMap
from ssh_abduction.replay import Log
from ssh_abduction.speedups import Speedups
from ssh_abduction.theory import Theory
from ssh_abduction.trace import Trace

RESERVE = 0.2  # share of the time limit kept for finding any map of the whole trace
GROWTH = 1.25  # a prefix grows at least by this factor, so that there are few
POLL = 0.05  # seconds between looks at the clock and for Ctrl-C
FIRST_PREFIXES = 32  # steps of a prefix that an engine with a chart tries before AT_ONCE
AT_ONCE = 8000  # steps that are compared in pairs; the matrix has the square of that many bytes
TICK = 0.5  # seconds between reports of progress while clingo is busy

Stop: TypeAlias = Literal["time limit", "memory limit", "interrupted", "maps limit"]


@dataclass(frozen=True, slots=True)
class Found:
    """A map of a prefix, and what it costs: the preferred counts, first to last."""

    map: SSHMap
    cost: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Grounding:
    """How large a ground program is."""

    rules: int
    atoms: int


class Stopped(Exception):  # noqa: N818 - not an error
    def __init__(self, reason: Stop) -> None:
        self.reason = reason


class Watch:
    """The limits of a search: `check` raises when one is over. Time that the caller of a stream takes does not count.

    limit    seconds, or None
    memory   MiB that the process may use, or None
    on_tick  called now and then
    beside  the watch of the search that this one is beside: that one ends it, and what cannot be interrupted is not begun where too little time is left
    """

    def __init__(
        self,
        limit: float | None = None,
        memory: int | None = None,
        on_tick: Callable[[], None] = lambda: None,
        *,
        beside: Watch | None = None,
    ) -> None:
        self._beside = beside
        self._on_tick = on_tick
        self._next_tick = TICK
        self._limit = limit
        self._allowed = None if limit is None else limit * (1 - RESERVE)
        self._memory = memory
        self._started: float | None = None
        self._spent = 0.0
        self.interrupted = False

    def start(self) -> None:
        self._started = time.perf_counter()

    @property
    def has_reserve(self) -> bool:
        return self._allowed != self._limit

    @property
    def running(self) -> bool:
        return self._started is not None

    def use_reserve(self) -> None:
        """From now on the whole time limit may be used."""
        self._allowed = self._limit

    def stop(self) -> None:
        self._spent, self._started = self.elapsed(), None

    def elapsed(self) -> float:
        return self._spent + (0 if self._started is None else time.perf_counter() - self._started)

    def check(self, ahead: float = 0.0) -> None:
        """Raise if a limit is over, or would be after so many seconds of what cannot be interrupted."""
        if self.interrupted:
            raise Stopped("interrupted")
        if self.elapsed() > self._next_tick:
            self._next_tick = self.elapsed() + TICK
            self._on_tick()
        if not self.allows(ahead):
            raise Stopped("time limit")
        if self._memory is not None and peak_memory() > self._memory:
            raise Stopped("memory limit")

    def allows(self, seconds: float) -> bool:
        """Whether there is time for so many seconds of what cannot be interrupted."""
        if self._allowed is not None and self.elapsed() + seconds > self._allowed:
            return False
        return not seconds or self._beside is None or self._beside.left() >= seconds

    def left(self) -> float:
        """Seconds until the time limit."""
        return math.inf if self._limit is None else self._limit - self.elapsed()


def peak_memory() -> float:
    """The most memory this process has used, in MiB."""
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


@contextmanager
def _held_back_interrupts() -> Iterator[None]:
    """Ctrl-C waits until this is over: raised while clingo starts its thread, it would leave the thread without an owner."""
    before = signal.getsignal(signal.SIGINT)
    if before is None or threading.current_thread() is not threading.main_thread():  # only the main thread may handle signals
        yield
        return
    caught: list[int] = []
    signal.signal(signal.SIGINT, lambda number, _: caught.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if caught and callable(before):
        before(signal.SIGINT, None)


Answer = TypeVar("Answer")


class Engine:
    """One clingo control that holds the axioms for the first `size` steps of a trace.

    bound   lower bound, proven, on the count that is preferred first; None where nothing is known before a search ends
    paths   how many names for paths there are
    clique  nodes that are pairwise apart (chart.py), if it needs to know some; in the causal theory they are steps
    intact  False after an error that may have left the control half told
    lists_least  whether maps_of_cost lists maps with the fewest dstates of the prefix alone
    """

    lists_least = False

    def __init__(self, trace: Trace, theory: Theory, watch: Watch, paths: int = 0) -> None:
        self.intact = True
        self.size = 0
        self.paths = paths
        self.bound: int | None = None
        self.clique: list[int] = []
        self.ground_seconds = 0.0
        self.solve_seconds = 0.0
        self._trace = trace
        self._theory = theory
        self._watch = watch
        self._control = clingo.Control(["--warn=none"])

    @property
    def grounding(self) -> Grounding:
        """The size of the program of clingo's last call that came to an end. Takes a millisecond, as clingo tells all it counts."""
        try:
            program = self._control.statistics["problem"]["lp"]
        except (RuntimeError, KeyError):  # no call came to an end
            return Grounding(0, 0)
        return Grounding(int(program["rules"]), int(program["atoms"]))

    def grow(self, size: int) -> None:
        """Let the prefix have `size` steps."""
        raise NotImplementedError

    def next_size(self, failed: int) -> int:
        """The size to grow to when the maps of the prefix do not explain step `failed`."""
        return min(len(self._trace), max(failed + 1, int(self.size * GROWTH)))

    @property
    def size_to_go_on(self) -> int:
        """The size to grow to first when a search was stopped and the trace has grown since."""
        return self.size

    def with_paths(self, paths: int) -> Engine:
        """Another engine, still for the empty prefix, with so many names for paths."""
        raise NotImplementedError

    def over(self, trace: Trace, watch: Watch, log: Log) -> Engine:
        """An engine for a trace that this one's has grown to, under other limits."""
        raise NotImplementedError

    def improving_maps(self) -> Iterator[Found]:
        """Maps of the prefix, each better than the one before; where the iteration ends, the last one is minimal."""
        raise NotImplementedError

    def maps_of_cost(self, cost: tuple[int, ...], enough: int) -> Iterator[Found]:
        """All maps of the prefix that cost this and no more; or `enough` of them, unless that is 0."""
        raise NotImplementedError

    def settle(self) -> None:
        """End what is still under way in clingo, when a search is over: a thread left behind would abort Python at its end."""

    def _answers(
        self,
        read: Callable[[clingo.Model], Answer],
        mode: str,
        models: int,
        *,
        assumptions: Sequence[tuple[clingo.Symbol, bool] | int] = (),
        conflicts: int = -1,
        on_bound: Callable[[Sequence[int]], None] | None = None,
        control: clingo.Control | None = None,
        until: Callable[[], bool] = lambda: False,
    ) -> Generator[Answer, None, bool]:
        """What clingo answers, read at once. Returns whether it came to an end, and not to the limit of conflicts, or to where `until` holds."""
        project = "project" if not mode.startswith("opt") else "no"
        with self._solving(control or self._control, assumptions, mode, models, project, conflicts, on_bound) as handle:
            while True:
                handle.resume()
                if not self._has_come(handle, until):
                    return False
                model = handle.model()
                if model is None:
                    return bool(_result(handle, conflicts).exhausted)
                yield read(model)

    def _verdict(
        self,
        read: Callable[[clingo.Model], Answer],
        assumed: Sequence[int],
        conflicts: int = -1,
        mode: str = "ignore",
        until: Callable[[], bool] = lambda: False,
    ) -> tuple[Answer | None, list[int] | None]:
        """An answer that these literals are true in, or else a core of them; neither where the limit of conflicts was reached, or `until` holds."""
        with self._solving(self._control, assumed, mode, 1, "no", conflicts) as handle:
            if not self._has_come(handle, until):
                return None, None
            model = handle.model()
            if model is not None:
                return read(model), None
            if not _result(handle, conflicts).unsatisfiable:
                return None, None
            known = set(assumed)
            return None, [literal for literal in handle.core() if literal in known]  # external atoms are assumed, too

    @contextmanager
    def _solving(
        self,
        control: clingo.Control,
        assumptions: Sequence[tuple[clingo.Symbol, bool] | int],
        mode: str,
        models: int,
        project: str,
        conflicts: int,
        on_bound: Callable[[Sequence[int]], None] | None = None,
    ) -> Iterator[clingo.SolveHandle]:
        """A search of clingo's in its own thread. It ends with this."""
        configuration: Any = control.configuration.solve
        configuration.opt_mode, configuration.models, configuration.project = mode, models, project
        configuration.solve_limit = f"{conflicts},-1"
        began = time.perf_counter()
        with ExitStack() as stack:
            with _held_back_interrupts():
                handle = stack.enter_context(control.solve(assumptions, yield_=True, async_=True, on_unsat=on_bound))
            self.solve_seconds += time.perf_counter() - began
            try:
                yield handle
            finally:
                handle.cancel()

    def _has_come(self, handle: clingo.SolveHandle, until: Callable[[], bool]) -> bool:
        """Wait until clingo has come to an answer or an end; or until `until` holds, and then False."""
        began = time.perf_counter()
        try:
            while not handle.wait(POLL):
                self._watch.check()
                if until():
                    return False
            self._watch.check()
            return True
        finally:
            self.solve_seconds += time.perf_counter() - began


def _result(handle: clingo.SolveHandle, conflicts: int) -> clingo.SolveResult:
    """How a search ended. Raises Stopped if something else than the limit of conflicts ended it."""
    result = handle.get()
    if result.interrupted and conflicts < 0:
        raise Stopped("interrupted")
    return result


class StepEngine(Engine):
    """The encodings of all levels: a dstate is named by the first step at it."""

    def __init__(self, trace: Trace, theory: Theory, watch: Watch, paths: int) -> None:
        super().__init__(trace, theory, watch, paths)
        self._asked: int | None = None  # the step that is the last one, as far as clingo knows
        for name in facts.encoding_names(theory):
            self._control.load(encodings.path(name))
        self._control.add("base", [], facts.theory_facts(theory, paths))

    def with_paths(self, paths: int) -> StepEngine:
        engine = StepEngine(self._trace, self._theory, self._watch, paths)
        engine.ground_seconds, engine.solve_seconds = self.ground_seconds, self.solve_seconds
        return engine

    def over(self, trace: Trace, watch: Watch, log: Log) -> StepEngine:
        self._trace, self._watch = trace, watch
        self.ground_seconds = self.solve_seconds = 0.0
        return self

    def grow(self, size: int) -> None:
        began = time.perf_counter()
        control = self._control
        try:
            base: list[tuple[str, list[clingo.Symbol]]] = [] if self.size else [("base", [])]
            while self.size < size:
                self._watch.check()
                part = f"steps_from_{self.size}"
                stop = min(size, self.size + (8 if self.size < 32 else 1))
                control.add(part, [], facts.trace_facts(self._trace, self._theory, self.size, stop))
                control.ground([*base, (part, []), *(("step", facts.numbers(t)) for t in range(self.size, stop))])
                self.size, base = stop, []
            if self._asked != size - 1:
                control.ground([("check", facts.numbers(size - 1))])
                if self._asked is not None:
                    control.release_external(facts.query(self._asked))
                control.assign_external(facts.query(size - 1), True)
                self._asked = size - 1
        finally:
            self.ground_seconds += time.perf_counter() - began

    def improving_maps(self) -> Iterator[Found]:
        return self._answers(self._read, *(("opt", 0) if self._theory.priorities else ("ignore", 1)))

    def maps_of_cost(self, cost: tuple[int, ...], enough: int) -> Iterator[Found]:
        bound = ",".join(map(str, cost))
        return self._answers(self._read, f"enum,{bound}" if bound else "ignore", 0)

    def _read(self, model: clingo.Model) -> Found:
        return Found(facts.read_map(model, self._trace, self._theory), tuple(model.cost))


class ChartedEngine(Engine):
    """An engine that charts a prefix (chart.py)."""

    def __init__(self, trace: Trace, theory: Theory, watch: Watch, log: Log, speedups: Speedups) -> None:
        super().__init__(trace, theory, watch)
        self._log = log
        self._speedups = speedups

    def with_paths(self, paths: int) -> Self:
        return type(self)(self._trace, self._theory, self._watch, self._log, self._speedups)

    def next_size(self, failed: int) -> int:
        steps = len(self._trace)
        if self.size < FIRST_PREFIXES:
            return min(steps, max(failed + 1, FIRST_PREFIXES))
        return steps if steps <= AT_ONCE else min(steps, max(failed + 1, 2 * self.size, AT_ONCE))

    @property
    def size_to_go_on(self) -> int:
        return self.next_size(self.size)

    def _has_processors(self) -> bool:
        return has_processors(self._speedups)

    def _new_control(self, encoding: str, base: str, options: Sequence[str]) -> clingo.Control:
        """A control with an encoding, and these facts in its base."""
        control = clingo.Control(["--warn=none", *options])
        control.load(encodings.path(encoding))
        control.add("base", [], base if self._speedups.watched else f"{base}\n{facts.watched()}.")
        control.ground([("base", [])])
        return control


def has_processors(speedups: Speedups) -> bool:
    """Whether a search may have two threads."""
    if not speedups.threads:
        return False
    from joblib import cpu_count  # takes its time to load

    return bool(cpu_count() > 1)
