"""Asking clingo, under limits: what all engines and searches have in common."""

from __future__ import annotations

import atexit
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, TypeVar

import clingo

from ssh_abduction.asp import facts
from ssh_abduction.theory import encodings
from ssh_abduction.theory.speedups import Speedups

RESERVE = 0.2  # share of the time limit kept for finding any map of the whole trace
POLL = 0.05  # seconds between looks at the clock and for Ctrl-C
TICK = 0.5  # seconds between reports of progress while clingo is busy

_grounding = threading.Lock()
_under_way: set[clingo.SolveHandle] = set()  # searches of clingo's, each in a thread

Stop: TypeAlias = Literal["time limit", "memory limit", "interrupted", "maps limit"]


@dataclass(frozen=True, slots=True)
class Grounding:
    """How large a ground program is."""

    rules: int
    atoms: int


class Stopped(Exception):  # noqa: N818 - not an error
    def __init__(self, reason: Stop) -> None:
        self.reason = reason


class Paused(Exception):  # noqa: N818 - not an error
    """Something else is to be done first."""


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
        memory: float | None = None,
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
        self._pause_at = math.inf
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

    def part(self, seconds: float) -> Watch:
        """A watch, started, for so many seconds of this one's time, which is looked at now and then."""
        part = Watch(seconds, self._memory, self.check)
        part.use_reserve()
        part.start()
        return part

    def shorten(self, seconds: float) -> None:
        """From now on the time limit is this, if that is less."""
        self._limit = self._allowed = seconds if self._limit is None else min(seconds, self._limit)

    def pause_after(self, seconds: float) -> None:
        """Let `check` raise Paused, once, when so much time was spent."""
        self._pause_at = seconds

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
        if self.elapsed() > self._pause_at:
            self._pause_at = math.inf
            raise Paused

    def allows(self, seconds: float) -> bool:
        """Whether there is time for so many seconds of what cannot be interrupted."""
        if self._allowed is not None and self.elapsed() + seconds > self._allowed:
            return False
        return not seconds or self._beside is None or self._beside.left() >= seconds

    def memory_left(self) -> float | None:
        """MiB until the memory limit, of which other processes may use as much."""
        if self._memory is None:
            return self._beside.memory_left() if self._beside else None
        return self._memory - peak_memory()

    def left(self) -> float:
        """Seconds until the time limit."""
        return math.inf if self._limit is None else self._limit - self.elapsed()


def peak_memory() -> float:
    """The most memory this process has used, in MiB. On Linux getrusage begins with what the process that began this one used."""
    with suppress(OSError, StopIteration), open("/proc/self/status", "rb") as status:
        return next(int(line.split()[1]) for line in status if line.startswith(b"VmHWM:")) / 2**10
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


@atexit.register
def _end_all() -> None:
    """At Python's end, end the searches of streams that somebody still holds: their threads would abort it."""
    for handle in list(_under_way):
        handle.cancel()


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
Made = TypeVar("Made")


class Control(clingo.Control):
    """A control without warnings. One at a time reads and grounds: side by side, threads wait for each other at each symbol, which takes three times as long."""

    def __init__(self, options: Sequence[str] = ()) -> None:
        super().__init__(["--warn=none", *options])

    def load(self, path: str) -> None:
        with _grounding:
            super().load(path)

    def add(self, *program: Any) -> None:
        with _grounding:
            super().add(*program)

    def ground(self, parts: Sequence[tuple[str, Sequence[clingo.Symbol]]] = (("base", ()),), context: Any = None) -> None:
        with _grounding:
            super().ground(parts, context)


class Asker:
    """One clingo control, and the questions to it.

    bound   lower bound, proven, on the count that is preferred first; None where nothing is known before a search ends
    """

    def __init__(self, watch: Watch) -> None:
        self.bound: int | None = None
        self.ground_seconds = 0.0
        self.solve_seconds = 0.0
        self._watch = watch
        self._control = Control()

    @property
    def grounding(self) -> Grounding:
        """The size of the program of clingo's last call that came to an end. Takes a millisecond, as clingo tells all it counts."""
        try:
            program = self._control.statistics["problem"]["lp"]
        except (RuntimeError, KeyError):  # no call came to an end
            return Grounding(0, 0)
        return Grounding(int(program["rules"]), int(program["atoms"]))

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
        ahead: bool = False,
    ) -> Generator[Answer, None, bool]:
        """What clingo answers, read at once. Returns whether it came to an end, and not to the limit of conflicts, or to where `until` holds.

        ahead  let clingo search for the next answer while something is made of this one
        """
        project = "project" if not mode.startswith("opt") else "no"
        with self._solving(control or self._control, assumptions, mode, models, project, conflicts, on_bound) as handle:
            handle.resume()
            while True:
                if not self._has_come(handle, until):
                    return False
                model = handle.model()
                if model is None:
                    return bool(_result(handle, conflicts).exhausted)
                answer = read(model)
                if ahead:
                    handle.resume()
                yield answer
                if not ahead:
                    handle.resume()

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
            _under_way.add(handle)
            try:
                yield handle
            finally:
                _under_way.discard(handle)
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


def mapped(function: Callable[[Answer], Made], answers: Generator[Answer, None, bool]) -> Generator[Made, None, bool]:
    """What a function makes of each answer. Returns what these return."""
    with closing(answers):
        while True:
            try:
                answer = next(answers)
            except StopIteration as end:
                return bool(end.value)
            yield function(answer)


def _result(handle: clingo.SolveHandle, conflicts: int) -> clingo.SolveResult:
    """How a search ended. Raises Stopped if something else than the limit of conflicts ended it."""
    result = handle.get()
    if result.interrupted and conflicts < 0:
        raise Stopped("interrupted")
    return result


def new_control(encoding: str, base: str, options: Sequence[str], speedups: Speedups) -> Control:
    """A control with an encoding, and these facts in its base."""
    control = Control(options)
    control.load(encodings.path(encoding))
    control.add("base", [], base if speedups.watched else f"{base}\n{facts.watched()}.")
    control.ground([("base", [])])
    return control


def give_threads(control: clingo.Control, *, two: bool) -> None:
    """Let clasp search with two threads, which tell each other what they learn, or with one."""
    configuration: Any = control.configuration.solve
    configuration.parallel_mode = "2,compete" if two else "1"


def has_processors(speedups: Speedups) -> bool:
    """Whether a search may have two threads."""
    if not speedups.threads:
        return False
    from joblib import cpu_count  # takes its time to load

    return bool(cpu_count() > 1)
