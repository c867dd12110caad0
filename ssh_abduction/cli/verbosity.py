"""How much a command tells on stderr: -q, -v, and now and then a line of progress where stderr is no terminal."""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import sys
import time
from collections.abc import Iterator

from ssh_abduction.data.errors import printable
from ssh_abduction.runtime.logs import PACKAGE, PROGRESS

# Seconds between two lines of progress, and before the first one: a log is to be read, and most
# commands are done by then.
EVERY = 10.0
LEVELS = {1: logging.INFO, 2: logging.DEBUG}


def add_verbosity(parser: argparse.ArgumentParser) -> None:
    """Add -q and -v to a parser, before or behind the verb."""
    told = parser.add_argument_group("messages").add_mutually_exclusive_group()
    none = argparse.SUPPRESS  # else the verb's own would replace what stands before the verb
    told.add_argument(
        "-q",
        "--quiet",
        action="store_true",
        default=none,
        help="no warnings and no progress on stderr, only errors",
    )
    told.add_argument(
        "-v",
        "--verbose",
        action="count",
        default=none,
        help="log on stderr what is tried, found and proven; -vv: also what clingo is given",
    )


@contextlib.contextmanager
def telling(options: argparse.Namespace, for_programs: bool) -> Iterator[None]:
    """Tell as much as the options ask for, while a command runs.

    for_programs  whether what it prints is read by programs: then nothing is told now and then
    where stdout and stderr go to one file
    """
    verbose = getattr(options, "verbose", 0)
    if getattr(options, "quiet", False):
        with (
            open(os.devnull, "w", encoding="utf-8") as nowhere,
            contextlib.redirect_stderr(nowhere),
        ):
            yield
    elif verbose:
        with _handled(logging.getLogger(PACKAGE), _Told(), LEVELS[min(verbose, 2)]):
            yield
    elif sys.stderr.isatty() or (for_programs and _is_one_file()):
        yield
    else:
        with _handled(PROGRESS, _NowAndThen(), logging.DEBUG):
            yield


@contextlib.contextmanager
def _handled(log: logging.Logger, handler: logging.Handler, level: int) -> Iterator[None]:
    before = log.level
    log.addHandler(handler)
    log.setLevel(level)
    try:
        yield
    finally:
        log.setLevel(before)
        log.removeHandler(handler)


def _is_one_file() -> bool:
    """Whether stdout and stderr go to one file or pipe, so that lines of progress would come between the lines of an answer."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        return os.path.samestat(os.fstat(sys.stdout.fileno()), os.fstat(sys.stderr.fileno()))
    return False


class _Told(logging.Handler):
    """Prints each record with the seconds since the command began, and the module that it comes from."""

    def __init__(self) -> None:
        super().__init__()
        self._began = time.monotonic()

    def emit(self, record: logging.LogRecord) -> None:
        seconds, source = time.monotonic() - self._began, record.name.removeprefix(f"{PACKAGE}.")
        _say(f"{seconds:.2f} s: {source}: {record.getMessage()}")


class _NowAndThen(logging.Handler):
    """Prints a record if none was printed in the last EVERY seconds."""

    def __init__(self) -> None:
        super().__init__()
        self._last = time.monotonic()

    def emit(self, record: logging.LogRecord) -> None:
        now = time.monotonic()
        if now - self._last >= EVERY:
            self._last = now
            _say(record.getMessage())


def _say(text: str) -> None:
    with contextlib.suppress(
        OSError, ValueError
    ):  # whoever reads the log may leave: the command goes on
        print(f"ssh-abduction: {printable(text)}", file=sys.stderr, flush=True)
