"""Turn the result of a search into JSON, an exit code, warnings, and why there is no map.

Add the options -q and -v, and print lines of progress on stderr.
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import zip_longest
from pathlib import Path
from types import FrameType
from typing import Any, TypeAlias

from ssh_abduction.data.errors import MapError, named, printable
from ssh_abduction.data.files import mend_of
from ssh_abduction.data.map_parts import read_json
from ssh_abduction.data.maps import SSHMap, maps_of
from ssh_abduction.explain.axioms import Interrupted
from ssh_abduction.explain.no_map import Explanation, explain
from ssh_abduction.learning.runner_up import second_map
from ssh_abduction.runtime import program
from ssh_abduction.runtime.clock import counting
from ssh_abduction.runtime.loggers import PACKAGE, PROGRESS
from ssh_abduction.solver import Cost, Search, Solution, Status, Watch
from ssh_abduction.solver import ending as written_ending

# After Ctrl-C, only traces of at most this many steps get warnings. 40,000 steps would take 2 s.
SOON = 10_000

Given: TypeAlias = tuple[SSHMap, Cost | None]

# It may take this many seconds of processor time to explain a clash, even if a limit is over.
EXPLAINING = 0.5
LEAST_LEFT = 0.2  # seconds that must be left to solve the trace with the runner-up's views

EXIT_ERROR = 1
EXIT_CODES = {Status.OPTIMAL: 0, Status.FEASIBLE: 10, Status.UNSATISFIABLE: 20, Status.UNKNOWN: 30}


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
        return [*self.at_once(solution), *self.second_opinion(solution)]

    def at_once(self, solution: Solution) -> list[str]:
        """List the warnings that need no further search."""
        if solution.stopped == "interrupted" and len(self._search.trace) > SOON:
            return []
        return [*solution.warnings]

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


# Seconds before the first line of progress, and between lines. Most commands end earlier.
EVERY = 10.0
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
    elif sys.stderr.isatty() or (for_programs and _is_one_file()):
        yield
    else:
        with _handled(PROGRESS, _NowAndThen(), logging.DEBUG):
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
        _say(f"{seconds:.2f} s: {source}: {record.getMessage()}")


class _NowAndThen(logging.Handler):
    """A log handler that prints a record if it has printed none for EVERY seconds."""

    def __init__(self) -> None:
        super().__init__()
        self._last = time.monotonic()

    def emit(self, record: logging.LogRecord) -> None:
        now = time.monotonic()
        if now - self._last >= EVERY:
            self._last = now
            _say(record.getMessage())


def _say(text: str) -> None:
    # If the reader of stderr quits, the command goes on.
    with contextlib.suppress(OSError, ValueError):
        print(f"ssh-abduction: {printable(text)}", file=sys.stderr, flush=True)
