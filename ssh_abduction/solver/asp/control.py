"""Runs clingo under limits, for all engines and searches."""

from __future__ import annotations

import atexit
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from typing import Any, TypeVar

import clingo

from ssh_abduction.runtime.logs import log_of
from ssh_abduction.solver.asp.limits import POLL, LimitError, Watch, peak_memory
from ssh_abduction.solver.values import Grounding
from ssh_abduction.theory import encodings
from ssh_abduction.theory.speedups import Speedups

# After grounding, clasp prepares the program and cannot be stopped. It takes about this share of
# the time and memory of grounding. So no search begins if a limit would be reached meanwhile.
PREPARING = 0.6, 1.0

SLOW = 0.05  # the log mentions grounding that takes more seconds
_log = log_of(__name__)
_ONE = clingo.Number(1)
_grounding = threading.Lock()
_under_way: set[clingo.SolveHandle] = set()  # the running searches of clingo, each in a thread


@atexit.register
def _end_all() -> None:
    """End the searches of unfinished streams when Python exits.

    Their threads would abort Python.
    """
    for handle in list(_under_way):
        handle.cancel()


@contextmanager
def _held_back_interrupts() -> Iterator[None]:
    """Hold back Ctrl-C and SIGTERM until this context ends.

    If they came while clingo starts a thread, the thread would have no owner.
    """
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    held = {number: handler for number, handler in handlers.items() if callable(handler)}
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may handle signals
        return
    caught: list[int] = []
    for number in held:
        signal.signal(number, lambda caught_number, _: caught.append(caught_number))
    try:
        yield
    finally:
        for number, handler in held.items():
            signal.signal(number, handler)
    for caught_number in caught[:1]:
        held[signal.Signals(caught_number)](caught_number, None)


Answer = TypeVar("Answer")
Made = TypeVar("Made")


class Control(clingo.Control):
    """A clingo control without warnings.

    Only one control at a time reads or grounds. Two threads at once would wait for each other at
    each symbol and take three times as long.

    Attributes:
        preparing: As PREPARING.
        seconds: How long clingo has grounded since it last began to solve.
        mebibytes: How much memory that grounding added.
    """

    def __init__(
        self,
        options: Sequence[str] = (),
        check: Callable[[], None] = lambda: None,
        preparing: tuple[float, float] = PREPARING,
    ) -> None:
        """A control without a program.

        Args:
            options: Of clingo.
            check: Called now and then while clingo grounds, if an encoding has `@go_on`. An
                exception ends the grounding and makes the control unusable.
            preparing: As PREPARING.
        """
        super().__init__(["--warn=none", *options])
        self.preparing = preparing
        self.seconds = self.mebibytes = 0.0
        self._check = check

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Be the only control that reads or grounds; wait for others, under the limits."""
        while not _grounding.acquire(timeout=POLL):
            self._check()
        try:
            yield
        finally:
            _grounding.release()

    def load(self, path: str) -> None:
        with self._alone():
            super().load(path)

    def load_encodings(self, *names: str) -> None:
        """Load these encodings, and the files that they include."""
        for name in names:
            for path in encodings.paths(name):
                self.load(path)

    def add(self, *program: Any) -> None:
        with self._alone():
            super().add(*program)

    def ground(
        self,
        parts: Sequence[tuple[str, Sequence[clingo.Symbol]]] = (("base", ()),),
        context: Any = None,
    ) -> None:
        asked = _Asked(self._check)
        with self._alone():
            self._ground_alone(parts, context, asked)

    def _ground_alone(
        self, parts: Sequence[tuple[str, Sequence[clingo.Symbol]]], context: Any, asked: _Asked
    ) -> None:
        began, before = time.perf_counter(), peak_memory()
        try:
            super().ground(parts, context or asked)
        except BaseException:
            if asked.raised is not None:
                # Clingo raises a copy of this exception, which lacks its attributes.
                raise asked.raised from None
            raise
        finally:
            seconds, mebibytes = time.perf_counter() - began, peak_memory() - before
            self.seconds += seconds
            self.mebibytes += mebibytes
            if seconds > SLOW:
                _log.debug(
                    "clingo grounded %s in %.2f s, %.0f MiB",
                    ", ".join(dict.fromkeys(name for name, _ in parts)),
                    seconds,
                    mebibytes,
                )


class _Asked:
    """Answers `@go_on`: clingo asks while it grounds whether to go on."""

    def __init__(self, check: Callable[[], None]) -> None:
        self.raised: BaseException | None = None
        self._check = check
        self._next = time.perf_counter() + POLL

    def go_on(self, *_: clingo.Symbol) -> clingo.Symbol:
        """Return 1, unless `check` raises.

        `check` is called only now and then, as clingo may ask this millions of times.
        """
        try:
            if time.perf_counter() > self._next:
                self._check()
                self._next = time.perf_counter() + POLL
        except BaseException as error:
            self.raised = error
            raise
        return _ONE


class Asker:
    """One clingo control, and the questions to it under limits.

    Attributes:
        control: The control that is asked; it may be replaced.
        watch: The limits; they may be replaced.
        ground_seconds: How long clingo has grounded so far.
        solve_seconds: How long clingo has solved so far.
    """

    def __init__(self, watch: Watch) -> None:
        self.control = Control()
        self.watch = watch
        self.ground_seconds = 0.0
        self.solve_seconds = 0.0

    @contextmanager
    def grounding_timed(self) -> Iterator[None]:
        """Count the time in this context as grounding."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self.ground_seconds += time.perf_counter() - began

    @property
    def grounding(self) -> Grounding:
        """The size of the program in the last call of clingo that ended.

        This takes a millisecond, as clingo returns all its statistics.
        """
        try:
            program = self.control.statistics["problem"]["lp"]
        except (RuntimeError, KeyError):  # no call came to an end
            return Grounding(0, 0)
        return Grounding(int(program["rules"]), int(program["atoms"]))

    def answers(
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
        """Yield the answers of clingo, each read as soon as it comes.

        Args:
            read: Reads a value from an answer, which clingo may change afterwards.
            mode: Clingo's opt-mode.
            models: How many answers to ask for; 0 for all.
            assumptions: These hold in each answer.
            conflicts: The limit; -1 for none.
            on_bound: Called with each bound that clingo proves.
            control: Another control than this one's own.
            until: Called now and then; the search ends once it is true.
            ahead: Let clingo search for the next answer while the caller uses this one.

        Returns:
            Whether the answers are complete: neither `conflicts` nor `until` ended the search.
        """
        project = "no" if mode.partition(",")[0] == "opt" else "project"
        with self._solving(
            control or self.control, assumptions, mode, models, project, conflicts, on_bound
        ) as handle:
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

    def verdict(
        self,
        read: Callable[[clingo.Model], Answer],
        assumed: Sequence[int],
        conflicts: int = -1,
        mode: str = "ignore",
        until: Callable[[], bool] = lambda: False,
    ) -> tuple[Answer | None, list[int] | None]:
        """An answer in which these literals are true, or an unsat core of them.

        Both are None if the limit of conflicts or `until` ended the search.

        Args:
            read: Makes a value of an answer.
            assumed: The literals.
            conflicts: The limit; -1 for none.
            mode: Clingo's opt-mode.
            until: Asked now and then; the search ends once it is true.
        """
        with self._solving(self.control, assumed, mode, 1, "no", conflicts) as handle:
            if not self._has_come(handle, until):
                return None, None
            model = handle.model()
            if model is not None:
                return read(model), None
            if not _result(handle, conflicts).unsatisfiable:
                return None, None
            known = set(assumed)
            # A core may also have external atoms, which clingo assumes.
            return None, [literal for literal in handle.core() if literal in known]

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
        """A search of clingo in a thread of its own, which ends with this context."""
        configuration: Any = control.configuration.solve
        configuration.opt_mode, configuration.models, configuration.project = mode, models, project
        configuration.solve_limit = f"{conflicts},-1"
        if isinstance(control, Control):
            self.watch.check(
                control.preparing[0] * control.seconds, control.preparing[1] * control.mebibytes
            )
            control.seconds = control.mebibytes = 0.0
        began = time.perf_counter()
        with ExitStack() as stack:
            with _held_back_interrupts():
                handle = stack.enter_context(
                    control.solve(assumptions, yield_=True, async_=True, on_unsat=on_bound)
                )
            self.solve_seconds += time.perf_counter() - began
            _under_way.add(handle)
            try:
                yield handle
            finally:
                _under_way.discard(handle)
                handle.cancel()

    def _has_come(self, handle: clingo.SolveHandle, until: Callable[[], bool]) -> bool:
        """Wait until clingo has an answer or ends, or until `until` holds.

        Returns:
            Whether clingo has an answer or ended.
        """
        began = time.perf_counter()
        try:
            while not handle.wait(POLL):
                self.watch.check()
                if until():
                    return False
            self.watch.check()
            return True
        finally:
            self.solve_seconds += time.perf_counter() - began


def mapped(
    function: Callable[[Answer], Made], answers: Generator[Answer, None, bool]
) -> Generator[Made, None, bool]:
    """The results of a function for each answer.

    Returns:
        What the generator of the answers returns.
    """
    with closing(answers):
        while True:
            try:
                answer = next(answers)
            except StopIteration as end:
                return bool(end.value)
            yield function(answer)


def _result(handle: clingo.SolveHandle, conflicts: int) -> clingo.SolveResult:
    """How a search ended.

    Raises:
        LimitError: It was interrupted from outside, not ended by the limit of conflicts.
    """
    result = handle.get()
    if result.interrupted and conflicts < 0:
        raise LimitError("interrupted")
    return result


def new_control(encoding: str, base: str, options: Sequence[str]) -> Control:
    """A control with an encoding, and these facts in its base."""
    control = Control(options)
    control.load_encodings(encoding)
    control.add("base", [], base)
    control.ground([("base", [])])
    return control


def give_threads(control: clingo.Control, *, two: bool) -> None:
    """Let clasp search with two threads, which exchange what they learn, or with one."""
    configuration: Any = control.configuration.solve
    configuration.parallel_mode = "2,compete" if two else "1"


def has_processors(speedups: Speedups) -> bool:
    """Whether a search may have two threads."""
    if not speedups.threads:
        return False
    from joblib import cpu_count  # loads slowly

    return bool(cpu_count() > 1)
