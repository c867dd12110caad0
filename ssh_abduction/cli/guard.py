"""The last net under the limits: what is known is printed in time, even while the main thread sits in a call of clingo's that nothing can stop.

Python runs handlers of signals in the main thread alone, and not before a call of clingo's has
returned. So a thread of its own looks at the clock and at the memory, and the system tells it of
signals through a socket. Where a promise is about to be broken, this thread prints what is known,
and ends the process.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import Any, NoReturn, Self

from ssh_abduction.runtime import program
from ssh_abduction.solver import POLL, Stop, end_all, resident_memory

LATE = (
    1.1,
    0.8,
)  # times the time limit, and seconds beyond that, after which a search is over, whatever it is at
LARGE = 1.1, 100.0  # times the memory limit, and MiB beyond that
DEAF = 1.5  # seconds that a search may take to end after Ctrl-C
PIECE = 2**16  # characters that are printed at a time


class Guard:
    """Ends the process in time. Lasts as long as the `with` block around what is watched.

    interrupt   makes the search end soon, if it can
    last_words  tells what is known, given why it is to end: what is still to be printed, and the exit code
    limit       seconds, or None
    memory      MiB, or None
    given_up    whether the answer is no longer wanted
    print_last  prints the last words; standard output, if not given
    """

    def __init__(
        self,
        interrupt: Callable[[], None],
        last_words: Callable[[Stop], tuple[Any, int]],
        limit: float | None,
        memory: float | None,
        *,
        given_up: Callable[[], bool] = lambda: False,
        print_last: Callable[[Any], None] | None = None,
    ) -> None:
        self._interrupt, self._last_words, self._given_up = interrupt, last_words, given_up
        self._limit, self._memory = limit, memory
        self._print_last = print_last or _print
        self._speaking = (
            threading.RLock()
        )  # one thread prints at a time; once the last words are said, no other does
        self._over = threading.Event()
        self._deaf_at: float | None = None  # when the search should have ended after Ctrl-C
        self._waited = 0.0  # seconds that whoever reads the output took, which do not count
        self._writes_since: float | None = (
            None  # when the piece of text that is being printed was begun
        )
        self._began = time.monotonic()
        self._hears: socket.socket | None = None
        self._before = -1

    def __enter__(self) -> Self:
        if (
            threading.current_thread() is threading.main_thread()
        ):  # only the main thread hears of signals
            self._hears, self._told = socket.socketpair()
            for end in (self._hears, self._told):
                end.setblocking(False)
            self._before = signal.set_wakeup_fd(self._told.fileno(), warn_on_full_buffer=False)
        self._thread = threading.Thread(target=self._watch, daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._over.set()
        self._thread.join()  # for ever, if it is about to end the process
        if self._hears is not None:
            signal.set_wakeup_fd(self._before)
            self._hears.close()
            self._told.close()

    def say(self, text: Callable[[], str]) -> None:
        """Print a text, which is made here, so that the last words know whether it was printed."""
        with self._speaking:
            made = text()
            for start in range(0, len(made), PIECE):
                self._writes_since = time.monotonic()
                sys.stdout.write(made[start : start + PIECE])
                self._waited += time.monotonic() - self._writes_since
                self._writes_since = None

    def _watch(self) -> None:
        while not self._over.wait(POLL):
            if self._is_called() and self._deaf_at is None:
                self._deaf_at = time.monotonic() + DEAF
                self._interrupt()
            why = self._why()
            if why is not None and self._speaking.acquire(blocking=False):
                try:
                    if not self._over.is_set():
                        self._end(why)
                finally:
                    self._speaking.release()
            elif self._is_unread():
                self._leave(program.interrupted_code())

    def _is_called(self) -> bool:
        """Whether somebody asks for an end."""
        if self._hears is not None:
            with suppress(BlockingIOError):
                heard = [
                    number
                    for number in self._hears.recv(64)
                    if number in (signal.SIGINT, signal.SIGTERM)
                ]
                program.heard.extend(
                    heard
                )  # as the handler of the main thread has perhaps not run, and will not
                return bool(heard) or self._given_up()
        return self._given_up()

    def _why(self) -> Stop | None:
        now = time.monotonic()
        if self._deaf_at is not None and now > self._deaf_at:
            return "interrupted"
        if (
            self._limit is not None
            and now - self._began - self._waited > LATE[0] * self._limit + LATE[1]
        ):
            return "time limit"
        if self._memory is not None and resident_memory() > LARGE[0] * self._memory + LARGE[1]:
            return "memory limit"
        return None

    def _is_unread(self) -> bool:
        """Whether the program is to end, and prints what nobody reads."""
        since, now = self._writes_since, time.monotonic()
        return (
            self._deaf_at is not None
            and now > self._deaf_at
            and since is not None
            and now > since + DEAF
        )

    def _end(self, why: Stop) -> None:
        """Print the last words, and end the process with its helpers.

        What Python and clingo hold is left to the system.
        """
        self._interrupt()
        code = 1
        try:
            words, code = self._last_words(why)
            self._print_last(words)
        except BaseException as error:
            with suppress(OSError, ValueError):
                print(
                    f"ssh-abduction: {why}: expected to print what is known, got "
                    f"{type(error).__name__}: {error}",
                    file=sys.stderr,
                    flush=True,
                )
        finally:
            self._leave(code)

    def _leave(self, code: int) -> NoReturn:
        end_all()
        os._exit(code)


def _print(words: str) -> None:
    sys.stdout.write(words)
    sys.stdout.flush()
