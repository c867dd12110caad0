"""Add the options -q and -v, and print lines of progress on stderr."""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import sys
import time
from collections.abc import Iterator
from typing import Any

from ssh_abduction.data.errors import printable
from ssh_abduction.runtime.loggers import PACKAGE, PROGRESS

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
