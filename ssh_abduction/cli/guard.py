"""End the process with what is known so far, as a last resort to keep its limits.

Python runs signal handlers only in the main thread, and only after a call of clingo has returned.
So a second thread watches the clock and the memory. It learns of signals through a socket. If a
limit is exceeded, this thread prints what is known and ends the process.
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
from functools import partial
from operator import is_not
from types import TracebackType
from typing import NoReturn, Self

from ssh_abduction.runtime import program
from ssh_abduction.solver import (
    POLL,
    STARVED,
    WAITING,
    Stop,
    end_all,
    processor_clock,
    resident_memory,
)

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
        os._exit(code)


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
