"""Run clingo under limits of time and memory, for all engines and searches."""

from __future__ import annotations

import atexit
import signal
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from typing import Any, TypeVar

import clingo

from ssh_abduction.runtime import program
from ssh_abduction.runtime.clock import (
    ANSWER,
    ASKED,
    ATOM,
    CONFLICT,
    CONFLICT_OF_SQUARE,
    MICRO,
    POLL,
    count_work,
    counts_work,
    now,
)
from ssh_abduction.runtime.limits import LimitError, Watch, peak_memory
from ssh_abduction.runtime.loggers import log_of
from ssh_abduction.solution.values import Grounding
from ssh_abduction.theory import encodings

# After grounding, clasp prepares the program and cannot be stopped. This takes about these
# multiples of the time and of the memory that grounding took. So do not begin a search if it would
# reach a limit while it prepares.
PREPARING = 0.6, 1.0

# While clingo grounds for a search that counts work, check its limits after each of so many calls.
CALLS = 1000
SLOW = 0.05  # log the grounding if it takes more seconds than this
_log = log_of(__name__)
_ONE = clingo.Number(1)
# Reentrant: a KeyboardInterrupt between taking and using it must not block this thread forever.
_grounding = threading.RLock()
_under_way: set[clingo.SolveHandle] = set()  # the running searches of clingo, each in a thread


@atexit.register
def _end_all() -> None:
    """End all running searches of clingo when Python exits, as their threads would abort it."""
    for handle in list(_under_way):
        handle.cancel()


@contextmanager
def _held_back_interrupts() -> Iterator[None]:
    """Hold back Ctrl-C and SIGTERM until this context ends. Then handle the first that came.

    If a signal is handled while clingo starts a thread, nothing ends this thread.
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
    """A clingo control without warnings, which grounds under limits.

    Only one control in this process reads or grounds at a time. Two threads that ground at once
    would wait for each other at each symbol and take three times as long.

    Attributes:
        preparing: The time and the memory that clasp needs to prepare the program, as multiples of
            what grounding took. The default is PREPARING.
        seconds: The time of grounding since clingo last solved, on the clock of the search.
        mebibytes: The memory in MiB that this grounding added.
    """

    def __init__(
        self,
        options: Sequence[str] = (),
        check: Callable[[], None] = lambda: None,
        preparing: tuple[float, float] = PREPARING,
        logger: Callable[[clingo.MessageCode, str], None] | None = None,
    ) -> None:
        """Make a control without a program, with command-line options of clingo.

        `check` is called now and then while clingo grounds an encoding with `@go_on`. If it raises
        an exception, the grounding ends and the control is unusable. `logger` gets the messages of
        clingo; None prints them.
        """
        super().__init__(["--warn=none", *options], logger)
        self.preparing = preparing
        self.seconds = self.mebibytes = 0.0
        self._check = check
        self._told = 0  # how often `tell` was called

    def __del__(self) -> None:
        try:
            super().__del__()  # type: ignore[no-untyped-call]
        except KeyboardInterrupt:
            # Python only prints what is raised here. So let Ctrl-C come again a bit later.
            program.forget()
            threading.Timer(POLL, signal.raise_signal, [signal.SIGINT]).start()

    @contextmanager
    def searching(self, **options: Any) -> Iterator[clingo.SolveHandle]:
        """Run a search of clingo in a thread, as `solve` does. Leaving the context stops it."""
        with ExitStack() as stack:
            with _held_back_interrupts():
                handle = stack.enter_context(self.solve(async_=True, **options))
            _under_way.add(handle)
            try:
                yield handle
            finally:
                _under_way.discard(handle)
                handle.cancel()

    def models(
        self, assumptions: Sequence[tuple[clingo.Symbol, bool]] = ()
    ) -> Iterator[clingo.Model]:
        """Yield each model when it is found. Ctrl-C ends the search."""
        with self.searching(assumptions=assumptions, yield_=True) as handle:
            while True:
                handle.resume()
                while not handle.wait(POLL):
                    pass
                if (model := handle.model()) is None:
                    return
                yield model

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Let only this control read or ground in this context. First wait for other controls."""
        if counts_work():
            self._check()  # a limit that is reached must not depend on whether this waits
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
        """Load encodings by their names, each with the files that it needs."""
        for name in names:
            for path in encodings.paths(name):
                self.load(path)

    def add(self, *program: Any) -> None:
        with self._alone():
            super().add(*program)

    @property
    def conflict(self) -> float:
        """The work of a conflict of clasp, in units: more if the program is large."""
        return CONFLICT + CONFLICT_OF_SQUARE * len(self.symbolic_atoms) ** 2

    def tell(self, rules: str) -> None:
        """Ground further rules, in a program part of their own."""
        self._told += 1
        self.add(f"told_{self._told}", [], rules)
        self.ground([(f"told_{self._told}", [])])

    def ground(
        self,
        parts: Sequence[tuple[str, Sequence[clingo.Symbol]]] = (("base", ()),),
        context: Any = None,
    ) -> None:
        """Ground program parts, and add up the time and the memory that this takes."""
        asked = _GroundingCheck(self._check)
        with self._alone():
            began, before = now(), peak_memory()
            atoms = len(self.symbolic_atoms)
            try:
                super().ground(parts, context or asked)
                count_work(ATOM * (len(self.symbolic_atoms) - atoms))
            except BaseException:
                if asked.raised is not None:
                    # Clingo raises a copy of the exception that lacks its attributes. Raise the
                    # exception itself.
                    raise asked.raised from None
                raise
            finally:
                seconds, mebibytes = now() - began, peak_memory() - before
                self.seconds += seconds
                self.mebibytes += mebibytes
                if seconds > SLOW:
                    names = ", ".join(dict.fromkeys(name for name, _ in parts))
                    _log.debug("clingo grounded %s in %.2f s, %.0f MiB", names, seconds, mebibytes)


class _GroundingCheck:
    """Evaluates `@go_on(...)` of encodings, by which clingo asks whether to go on grounding."""

    def __init__(self, check: Callable[[], None]) -> None:
        self.raised: BaseException | None = None
        self._check, self._calls = check, 0
        self._next = time.perf_counter() + POLL

    def go_on(self, *_: clingo.Symbol) -> clingo.Symbol:
        """Return 1, unless `check` raises. To save time, call `check` only now and then."""
        count_work(ASKED)
        self._calls += 1
        try:
            if counts_work():
                if self._calls % CALLS == 0:
                    self._check()
            elif time.perf_counter() > self._next:
                self._check()
                self._next = time.perf_counter() + POLL
        except BaseException as error:
            self.raised = error
            raise
        return _ONE


class Asker:
    """Lets a clingo control search for answers, under limits.

    Attributes:
        intact: False after an error during which clingo may have missed rules.
        ground_seconds: The seconds that clingo has grounded so far.
        solve_seconds: The seconds that clingo has solved so far.
    """

    def __init__(self, watch: Watch) -> None:
        self.control = Control()
        self.watch = watch
        self.intact = True
        self.ground_seconds = 0.0
        self.solve_seconds = 0.0

    @contextmanager
    def grounding_timed(self) -> Iterator[None]:
        """Count the time in this `with` block as time for grounding."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self.ground_seconds += time.perf_counter() - began

    @property
    def grounding(self) -> Grounding:
        """The numbers of rules and atoms in the last search; 0 before. This takes a millisecond."""
        try:
            program = self.control.statistics["problem"]["lp"]
        except (RuntimeError, KeyError):  # no search has ended
            return Grounding(0, 0)
        return Grounding(int(program["rules"]), int(program["atoms"]))

    def answers(
        self,
        read: Callable[[clingo.Model], Answer],
        mode: str,
        models: int,
        *,
        assumptions: Sequence[tuple[clingo.Symbol, bool]] = (),
        conflicts: int = -1,
        on_bound: Callable[[Sequence[int]], None] | None = None,
        control: Control | None = None,
        until: Callable[[], bool] = lambda: False,
        ahead: bool = False,
    ) -> Generator[Answer, None, bool]:
        """Let clingo search, and yield each answer as soon as it comes, as a value of `read`.

        Args:
            read: Makes a value from an answer. It is called at once, as clingo changes the answer
                afterwards.
            mode: The value of clingo's option --opt-mode, such as "opt" or "optN".
            models: The number of answers to ask for; 0 for all.
            assumptions: Literals that hold in each answer.
            conflicts: The number of conflicts after which the search ends; -1 for no limit.
            on_bound: Called with each lower bound that clingo proves.
            control: The control to use; None for `self.control`.
            until: Called now and then; the search ends once it returns True.
            ahead: Whether clingo searches for the next answer while the caller uses this one.

        Returns:
            Whether the search was exhaustive: neither `conflicts` nor `until` ended it, and there
            is no further answer.

        Raises:
            LimitError: A limit is reached.
        """
        control = control or self.control
        configuration: Any = control.configuration.solve
        configuration.opt_mode, configuration.models = mode, models
        configuration.project = "no" if mode.partition(",")[0] == "opt" else "project"
        allowed = self.watch.conflicts_left(control.conflict)
        most = min((n for n in (conflicts, allowed) if n >= 0), default=-1)
        configuration.solve_limit = f"{most},-1"
        # Nothing can stop clasp while it prepares the program. So check first that time is left.
        self.watch.check(
            control.preparing[0] * control.seconds, control.preparing[1] * control.mebibytes
        )
        control.seconds = control.mebibytes = 0.0
        began = time.perf_counter()
        with (
            self._counted(control),
            control.searching(assumptions=assumptions, yield_=True, on_unsat=on_bound) as handle,
        ):
            self.solve_seconds += time.perf_counter() - began
            handle.resume()
            came = 0
            while True:
                if not self._has_come(handle, until):
                    return False
                model = handle.model()
                if model is None:
                    result = handle.get()
                    break
                came += 1
                count_work(round(MICRO * ANSWER))
                answer = read(model)
                # Where work is counted, clasp must stand still at an answer when a caller stops.
                if ahead and not counts_work():
                    handle.resume()
                yield answer
                if not ahead or counts_work():
                    self.watch.check()  # a limit of work must not stop clasp while it searches
                    handle.resume()
        # A limit of conflicts ends a search without `interrupted`.
        is_cut = result.interrupted or not (result.exhausted or came == models > 0)
        if is_cut and most == allowed >= 0:
            self.watch.check()
        if is_cut and conflicts < 0:
            raise LimitError("interrupted")
        return bool(result.exhausted)

    @contextmanager
    def _counted(self, control: Control) -> Iterator[None]:
        """Count what clasp does in this context as work."""
        try:
            yield
        finally:
            if counts_work():
                with suppress(RuntimeError, KeyError):  # clingo did not begin
                    solved = control.statistics["solving"]["solvers"]
                    count_work(round(MICRO * control.conflict * solved["conflicts"]))

    def _has_come(self, handle: clingo.SolveHandle, until: Callable[[], bool]) -> bool:
        """Wait for an answer or the end; False if `until` ended the wait. May raise LimitError."""
        began = time.perf_counter()
        try:
            while not handle.wait(POLL):
                self.watch.check()
                if not counts_work() and until():
                    return False
            self.watch.check()
            return True
        finally:
            self.solve_seconds += time.perf_counter() - began


def mapped(
    function: Callable[[Answer], Made], answers: Generator[Answer, None, bool]
) -> Generator[Made, None, bool]:
    """Yield the result for each answer. Return whether the search was exhaustive."""
    with closing(answers):
        while True:
            try:
                answer = next(answers)
            except StopIteration as end:
                return bool(end.value)
            yield function(answer)


def new_control(
    encoding: str, base: str, options: Sequence[str] = (), check: Callable[[], None] = lambda: None
) -> Control:
    """Make a control as `Control` does, and ground an encoding with facts `base`."""
    control = Control(options, check)
    control.load_encodings(encoding)
    control.add("base", [], base)
    control.ground([("base", [])])
    return control
