"""How a verb ends: exit codes, JSON, warnings, progress, Ctrl-C, and limits.

Python runs signal handlers only in the main thread, and only after a call of clingo has returned.
So a second thread watches the clock and the memory. It learns of signals through a socket. If a
limit is exceeded, this thread prints what is known and ends the process: see `Guard`.
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import math
import os
import shutil
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from itertools import zip_longest
from operator import is_not
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Literal, NoReturn, Self, TextIO, TypeAlias, cast

from ssh_abduction.data.errors import MapError, named, printable
from ssh_abduction.data.files import mend_of
from ssh_abduction.data.map_parts import read_json
from ssh_abduction.data.maps import SSHMap, maps_of
from ssh_abduction.explain.axioms import Interrupted
from ssh_abduction.explain.no_map import Explanation, explain
from ssh_abduction.learning.runner_up import second_map
from ssh_abduction.runtime import program
from ssh_abduction.runtime.clock import POLL, STARVED, counting
from ssh_abduction.runtime.limits import WAITING, Watch, processor_clock, resident_memory
from ssh_abduction.runtime.loggers import PACKAGE, PROGRESS
from ssh_abduction.runtime.workers import end_all
from ssh_abduction.solution import Cost, Solution, Status, Stop
from ssh_abduction.solution import ending as written_ending
from ssh_abduction.solver import Search

Given: TypeAlias = tuple[SSHMap, Cost | None]

# It may take this many seconds of processor time to explain a clash, even if a limit is over.
EXPLAINING = 0.5
LEAST_LEFT = 0.2  # seconds that must be left to solve the trace with the runner-up's views

EXIT_ERROR = 1
EXIT_UNPROVEN = 10  # 0 without --strict
EXIT_CODES = {
    Status.OPTIMAL: 0,
    Status.FEASIBLE: EXIT_UNPROVEN,
    Status.UNSATISFIABLE: 20,
    Status.UNKNOWN: 30,
}


def exit_code(solution: Solution) -> int:
    """Find the exit code for a solution."""
    if solution.stopped == "interrupted":
        return program.interrupted_code()
    return EXIT_CODES[solution.status]


def why_no_map(search: Search) -> Explanation | None:
    """Explain why there is no map; None if there is a map, or no time to find out.

    If the time is only enough to find the steps that clash, no axioms are named.
    """
    if search.status is not Status.UNSATISFIABLE or search.theory.jumped:
        return None
    counts = search.limits.work_limit is not None
    watch = Watch(work=EXPLAINING) if counts else Watch(EXPLAINING, clock=time.thread_time)
    watch.start()

    def over() -> bool:
        return search.over() and not watch.allows(0)

    try:
        with counting(counts):
            return explain(search.trace, search.theory, over, search.clash)
    except Interrupted:
        clash = search.clash
        return Explanation(clash.start, clash.stop - 1, ()) if clash else None


def all_given(solution: Solution) -> list[Given]:
    """Pair each map of a solution with its cost; with None if `within` is 0."""
    return list(zip_longest(solution.maps, solution.costs if solution.within else ()))


def answer_ending(
    solution: Solution, explanation: Explanation | None, maps: int, found: Sequence[str]
) -> dict[str, Any]:
    """Make the fields of a solution's JSON that come after its maps.

    `maps` is the number of maps that were written. `found` are all warnings.
    """
    end = written_ending(solution, maps, solution.shared)
    end.pop("warnings", None)
    if found:
        end["warnings"] = found
    if explanation:
        end["explanation"] = explanation.to_dict()
    return end


class Warnings:
    """Finds sentences about reasons to distrust a trace or its views."""

    def __init__(self, search: Search) -> None:
        self._search = search
        self._second: list[str] | None = None  # None until it is found

    def of(self, solution: Solution) -> list[str]:
        """List the warnings about a solution of the search."""
        return [*solution.warnings, *self.second_opinion(solution)]

    def second_opinion(self, solution: Solution) -> list[str]:
        """Warn if the runner-up's views give another map, if there is time to solve it."""
        if self._second is None:
            search, limits = self._search, self._search.limits
            limit, work = limits.time_limit, limits.work_limit
            left = None if limit is None else limit - solution.seconds.total
            rest = None if work is None else work - (solution.effort.work or 0.0)
            is_over = any(x is not None and x < LEAST_LEFT for x in (left, rest))
            if solution.stopped not in (None, "maps limit") or is_over:
                return []
            known = [*solution.maps, *([search.best] if search.best else [])]
            found = second_map(search.trace, known, search.theory, left, limits.memory_limit, rest)
            self._second = [found.sentence] if found else []
        return self._second


def warn(warnings: Iterable[str]) -> None:
    """Print warnings on stderr."""
    for warning in warnings:
        print(f"ssh-abduction: warning: {warning}", file=sys.stderr)


def unwritten(error: OSError, output: object) -> str:
    """Say that a file cannot be written: the one that the error names, or else `output`."""
    what = named(error.filename or output)
    return f"{what}: cannot be written: {error.strerror or error}; {mend_of(error)}"


def save_solution(solution: Solution, file: str | None) -> None:
    """Write a solution to a file, if one is named. Raises MapError.

    A solution without a map does not replace a file of maps. A warning says so.
    """
    if file is not None and solution.cost is None and _has_maps(file):
        keeps = f"{named(file)}: keeps the maps that it had, as this search found none"
        warn([f"{keeps}; delete it first to write the new answer, or name another file"])
    elif file is not None:
        solution.save(file)
        keep_folder_whole(file, "maps")


def keep_folder_whole(file: str | Path, change: Literal["names", "corrections", "maps"]) -> None:
    """Rewrite the pages beside a file of maps, if it is in a folder that map wrote."""
    if (Path(file).parent / "run.json").is_file():
        from ssh_abduction.robot_logs.run_folder import bring_up_to_date  # loads scikit-learn

        bring_up_to_date(Path(file), change)


def _has_maps(file: str) -> bool:
    with contextlib.suppress(MapError):
        return Path(file).is_file() and bool(maps_of(read_json(Path(file).absolute()), file))
    return False


class StopFlag:
    """A flag that asks all work to stop. Unlike a `threading.Event`, signal handlers may set it."""

    def __init__(self) -> None:
        self.since = math.inf  # when it was set first

    def set(self) -> None:
        self.since = min(self.since, time.monotonic())

    def ask(self) -> None:
        """Set the flag at Ctrl-C. A second Ctrl-C, some time later, raises KeyboardInterrupt."""
        if program.is_again(self.since):
            raise KeyboardInterrupt
        self.set()

    def is_set(self) -> bool:
        return self.since < math.inf


@contextlib.contextmanager
def on_ctrl_c(action: Callable[[], None]) -> Iterator[None]:
    """While the block runs, call `action` at Ctrl-C and SIGTERM instead of ending the program.

    `action` may raise KeyboardInterrupt. While the block runs, the Guard of the whole program
    receives no signals. So code that may ignore `action` needs its own Guard. A signal that was
    ignored before is ignored still, as shells want it for programs in the background.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # Python lets only the main thread handle signals
        return

    def hear(number: int, frame: FrameType | None) -> None:
        program.hear(number)
        try:
            action()
        except KeyboardInterrupt:
            if program.is_loading(frame):
                os._exit(program.interrupted_code())
            raise

    before = {
        number: signal.signal(number, hear)
        for number in (signal.SIGINT, signal.SIGTERM)
        if signal.getsignal(number) is not signal.SIG_IGN
    }
    descriptor = signal.set_wakeup_fd(-1)
    try:
        yield
    finally:
        signal.set_wakeup_fd(descriptor, warn_on_full_buffer=False)
        for number, handler in before.items():
            signal.signal(number, handler)


# Seconds before the first line of progress, between lines, and between changes on a terminal.
FIRST, EVERY, REWRITTEN = 1.0, 10.0, 0.2
LEVELS = {1: logging.INFO, 2: logging.DEBUG}


def add_verbosity(parser: argparse.ArgumentParser) -> None:
    """Add -q and -v to a parser, so that they may come before or behind the verb."""
    group = parser.add_argument_group("messages").add_mutually_exclusive_group()
    none = argparse.SUPPRESS  # a default of the verb would overwrite a flag before the verb
    said = "print only errors on stderr, no warnings and no progress"
    group.add_argument("-q", "--quiet", action="store_true", default=none, help=said)
    said = "log on stderr what is tried, found and proven; -vv: also what clingo is given"
    group.add_argument("-v", "--verbose", action="count", default=none, help=said)


@contextlib.contextmanager
def telling(options: argparse.Namespace, for_programs: bool) -> Iterator[None]:
    """While the block runs, log on stderr as much as the options ask for.

    If other programs read the output, and stdout and stderr are one file, no progress is shown.
    """
    verbose = getattr(options, "verbose", 0)
    if getattr(options, "quiet", False):
        nowhere = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 - closed below
        with nowhere, contextlib.redirect_stderr(nowhere):
            yield
    elif verbose:
        with _handled(logging.getLogger(PACKAGE), _StderrHandler(), LEVELS[min(verbose, 2)]):
            yield
    elif for_programs and _is_one_file():
        yield
    else:
        line = _ProgressLine()
        with _handled(PROGRESS, line, logging.DEBUG), line.shown():
            yield


def progress_bar() -> Any:
    """Make a progress bar on stderr with rich. It shows nothing if stderr is no terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=Console(stderr=True),
        redirect_stdout=False,
        transient=True,
        disable=not sys.stderr.isatty(),
    )


@contextlib.contextmanager
def _handled(log: logging.Logger, handler: logging.Handler, level: int) -> Iterator[None]:
    """While the block runs, pass the records of a log to a handler, from this level upwards."""
    before = log.level
    log.addHandler(handler)
    log.setLevel(level)
    try:
        yield
    finally:
        log.setLevel(before)
        log.removeHandler(handler)


def _is_one_file() -> bool:
    """Whether stdout and stderr are the same file, so that progress would mix with the output."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        return os.path.samestat(os.fstat(sys.stdout.fileno()), os.fstat(sys.stderr.fileno()))
    return False


class _StderrHandler(logging.Handler):
    """A log handler that prints each record with its module and the seconds since the start."""

    def __init__(self) -> None:
        super().__init__()
        self._began = time.monotonic()

    def emit(self, record: logging.LogRecord) -> None:
        seconds, source = time.monotonic() - self._began, record.name.removeprefix(f"{PACKAGE}.")
        text = printable(f"{seconds:.2f} s: {source}: {record.getMessage()}")
        with contextlib.suppress(OSError, ValueError):  # if its reader quits, the command goes on
            print(f"ssh-abduction: {text}", file=sys.stderr, flush=True)


class _ProgressLine(logging.Handler):
    """Shows the last record after a second, and then now and then, with the time since the start.

    On a terminal the line is rewritten, and wiped away before anything else is printed.
    """

    def __init__(self) -> None:
        super().__init__()
        self._stream, self._began = sys.stderr, time.monotonic()
        self.rewrites = self._stream.isatty()
        self._record, self._is_shown, self._over = "", False, threading.Event()

    def emit(self, record: logging.LogRecord) -> None:
        self._record = record.getMessage()

    @contextlib.contextmanager
    def shown(self) -> Iterator[None]:
        """Until the block ends, show the line, and wipe it away before other output."""
        thread = threading.Thread(target=self._run, daemon=True)
        thread.start()
        try:
            if self.rewrites:
                out, err = (cast("TextIO", _Wiping(s, self.wipe)) for s in (sys.stdout, sys.stderr))
                with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
                    yield
            else:
                yield
        finally:
            self._over.set()
            thread.join()
            self.wipe()

    def _run(self) -> None:
        wait = FIRST
        while not self._over.wait(min(wait, threading.TIMEOUT_MAX)):
            self.show()
            wait = REWRITTEN if self.rewrites else EVERY

    def show(self) -> None:
        """Print the line, if there is a record."""
        if not self._record:
            return
        seconds = time.monotonic() - self._began
        text = printable(f"ssh-abduction: {self._record} ({seconds:.0f} s)")
        with contextlib.suppress(OSError, ValueError):
            if self.rewrites:
                text = f"\r\x1b[2K{text[: shutil.get_terminal_size().columns - 1]}"
            print(text, end="" if self.rewrites else "\n", file=self._stream, flush=True)
            self._is_shown = self.rewrites

    def wipe(self) -> None:
        """Wipe the line away, if it is shown."""
        if self._is_shown:
            self._is_shown = False
            with contextlib.suppress(OSError, ValueError):
                print("\r\x1b[2K", end="", file=self._stream, flush=True)


class _Wiping:
    """A stream that wipes the line of progress away before each use."""

    def __init__(self, stream: TextIO, wipe: Callable[[], None]) -> None:
        self._stream, self._wipe = stream, wipe

    def __getattr__(self, name: str) -> Any:
        self._wipe()
        return getattr(self._stream, name)


# A search is ended after the first number times its time limit, plus the second in seconds.
LATE = 1.1, 0.8
# To hand over what is known may take one of this many seconds.
HANDING = 10.0
# A search is ended at the first number times its memory limit, plus the second in MiB.
LARGE = 1.1, 100.0
# A search must end within this many seconds after Ctrl-C.
DEAF = 1.5
# Files must be written within this many seconds after Ctrl-C: a pipe may have no reader.
SAVING = 10.0
# Text is printed in pieces of this many characters.
PIECE = 2**16


class Guard:
    """A context manager that ends the process if the code inside exceeds a limit.

    It also ends the process if the code does not stop soon after Ctrl-C or SIGTERM.

    Args:
        interrupt: Asks the search to end soon.
        last_words: Takes the reason for the end. Returns what remains to be printed, the exit code,
            and perhaps a function that saves the answer. None prints nothing. The code then has
            more time on a busy machine, as only itself can print its answer.
        limit: The time limit in seconds; None for no limit.
        memory: The memory limit in MiB; None for no limit.
        given_up: Returns whether the answer is not needed any more.
        known: Returns the best map so far, and other objects that improve; None without a map.
        hand_over: Is called soon after `known` returns another object. It may raise exceptions.
    """

    def __init__(
        self,
        interrupt: Callable[[], None],
        last_words: Callable[[Stop], tuple[str, int] | tuple[str, int, Callable[[], None]]]
        | None = None,
        limit: float | None = None,
        memory: float | None = None,
        *,
        given_up: Callable[[], bool] = lambda: False,
        known: Callable[[], tuple[object, ...] | None] = tuple,
        hand_over: Callable[[], None] = lambda: None,
    ) -> None:
        self._interrupt, self._last_words, self._given_up = interrupt, last_words, given_up
        self._known, self._hand_over = known, hand_over
        self._handed: tuple[object, ...] | None = None  # what was known then
        self._hands_at = 0.0  # when the next map may be handed over
        self._limit, self._memory = limit, memory
        self._signals, self._printer = _Signals(), _Printer()
        self._finished: int | None = None  # the exit code, once the whole answer is printed
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._over = threading.Event()
        self._began = time.monotonic()
        self._used = processor_clock(time.process_time, STARVED)
        self._since_call: Callable[[], float] | None = None  # the seconds since Ctrl-C

    def __enter__(self) -> Self:
        # Python lets only the main thread listen to signals.
        if threading.current_thread() is threading.main_thread():
            self._signals.open()
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._over.set()
        self._thread.join()  # does not return if the thread is about to end the process
        self._signals.close()

    def say(self, text: Callable[[], str]) -> None:
        """Make a text and print it. The last words on Ctrl-C come after it, never inside it."""
        self._printer.say(text)

    def finish(
        self, code: int, text: Callable[[], str] = str, save: Callable[[], None] = lambda: None
    ) -> None:
        """Make and print the rest of the answer, and save it. No last words come afterwards.

        `code` is the exit code if a limit then ends the process.
        """
        with self._printer.speaking:
            self._printer.say(text)
            self._finished = code
            self._printer.wait_for(save, SAVING)

    def _watch(self) -> None:
        """Watch the limits and signals, in the second thread, until the `with` block ends."""
        speaking = self._printer.speaking
        while not self._over.wait(POLL):
            self._hand_over_news()
            if self._is_called():
                self._interrupt()
            why = self._why()
            if why is not None and speaking.acquire(blocking=False):
                try:
                    if not self._over.is_set():
                        self._end(why)
                finally:
                    speaking.release()
            elif self._is_deaf() and self._printer.is_unread():
                self._leave(program.interrupted_code())

    def _hand_over_news(self) -> None:
        """Hand over what is known if it is new, in at most a tenth of the time."""
        known, begun = self._known(), time.monotonic()
        if known is None or begun < self._hands_at:
            return
        if self._handed is None or any(map(is_not, known, self._handed)):
            # The other thread changes data that are read here. If this fails, try again later.
            with suppress(Exception):
                self._hand_over()
                self._handed = known
            self._hands_at = begun + HANDING * (time.monotonic() - begun)

    def _is_called(self) -> bool:
        """Whether the search has to end: a signal arrived, or nobody needs the answer any more."""
        numbers = self._signals.received()
        # The handler in the main thread may not have run yet, and may never run.
        program.heard.extend(numbers)
        is_called = bool(numbers) or self._given_up()
        if is_called and self._since_call is None:
            waiting = 1.0 if self._last_words else WAITING
            self._since_call = processor_clock(time.process_time, waiting)
        return is_called

    def _why(self) -> Stop | None:
        """The reason to end the process now; None if there is none."""
        if self._is_deaf():
            return "interrupted"
        if self._limit is not None and self._is_late(LATE[0] * self._limit + LATE[1]):
            return "time limit"
        if self._memory is not None and resident_memory() > LARGE[0] * self._memory + LARGE[1]:
            return "memory limit"
        return None

    def _is_late(self, most: float) -> bool:
        """Whether the search took more than `most` seconds; longer if it starves without a map."""
        seconds = time.monotonic() - self._began - self._printer.waited
        return seconds > most and (self._known() is not None or self._used() > most)

    def _is_deaf(self) -> bool:
        """Whether the search still runs although it was asked to end more than DEAF seconds ago."""
        return self._since_call is not None and self._since_call() > DEAF

    def _end(self, why: Stop) -> None:
        """Print the last words, and end the process and its helper processes without clean-up."""
        if self._finished is not None:
            self._leave(self._finished)
        if self._last_words is None:
            self._leave(program.interrupted_code())
        self._interrupt()
        code = 1
        threading.Thread(target=self._leave_if_stuck, daemon=True).start()
        try:
            words, code, *saves = self._last_words(why)
            self._printer.say(lambda: words)
            for save in saves:
                self._printer.wait_for(save, SAVING)
        except BaseException as error:
            with suppress(OSError, ValueError):
                found = f"expected to print what is known, got {type(error).__name__}: {error}"
                print(f"ssh-abduction: {why}: {found}", file=sys.stderr, flush=True)
        finally:
            self._leave(code)

    def _leave_if_stuck(self) -> NoReturn:
        """End the process at Ctrl-C if nobody reads the last words, or if they take long to make.

        This runs in a third thread while the second one prints the last words.
        """
        begun = time.monotonic()
        while not (self._is_deaf() and self._printer.is_unread()):
            time.sleep(POLL)
            if self._is_called() and time.monotonic() > begun + SAVING:
                break
        self._leave(program.interrupted_code())

    def _leave(self, code: int) -> NoReturn:
        end_all()
        os._exit(program.shown.get(code, code))


class _Signals:
    """Receives SIGINT and SIGTERM in a second thread, while the main thread is busy."""

    def __init__(self) -> None:
        self._ends: tuple[socket.socket, socket.socket] | None = None
        self._before = -1  # the file that received signals before

    def open(self) -> None:
        """Begin to listen. Only the main thread may call this."""
        self._ends = socket.socketpair()
        for end in self._ends:
            end.setblocking(False)
        self._before = signal.set_wakeup_fd(self._ends[1].fileno(), warn_on_full_buffer=False)

    def close(self) -> None:
        """Stop listening."""
        if self._ends is not None:
            signal.set_wakeup_fd(self._before)
            for end in self._ends:
                end.close()

    def received(self) -> list[int]:
        """Return the numbers of the signals since the last call."""
        if self._ends is not None:
            with suppress(BlockingIOError):
                return [n for n in self._ends[0].recv(64) if n in (signal.SIGINT, signal.SIGTERM)]
        return []


class _Printer:
    """Prints to standard output, and measures how long the reader of the output takes."""

    def __init__(self) -> None:
        self.speaking = threading.RLock()  # of the thread that prints
        self.waited = 0.0  # seconds that the reader took, which do not count as search time
        self._begun: float | None = None  # when the current piece of text was begun
        self._patience = DEAF  # how many seconds it may take

    def say(self, text: Callable[[], str]) -> None:
        """Make a text while holding the lock, and print it in pieces."""
        with self.speaking:
            made = text()
            for start in range(0, len(made), PIECE):
                self.wait_for(partial(sys.stdout.write, made[start : start + PIECE]))
            if made:
                self.wait_for(sys.stdout.flush)

    def wait_for(self, write: Callable[[], object], patience: float = DEAF) -> None:
        """Call a function that may wait for a reader or a disk, and should take few seconds."""
        self._patience, self._begun = patience, time.monotonic()
        try:
            write()
        finally:
            self.waited += time.monotonic() - self._begun
            self._begun = None

    def is_unread(self) -> bool:
        """Whether the current piece has waited longer than it should."""
        begun = self._begun
        return begun is not None and time.monotonic() > begun + self._patience
