"""The limits of a search: time, memory, and interruption."""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Literal, TypeAlias, TypeVar

from ssh_abduction.runtime.clock import counting, counts_work, now, work_done

# A search that has found no map of the whole trace ends when this share of the time limit is left.
# The rest of the time is for making a map without a search.
RESERVE = 0.1
# Seconds between two reports of progress. A person cannot read them faster.
TICK = 0.5
# Work that is limited by processor time may wait for the processor, or for another thread, until
# WAITING times as many seconds are over.
WAITING = 4.0
# More conflicts of clasp than this count as no limit: they take days.
MOST_CONFLICTS = 2**31 - 1

Result = TypeVar("Result")
# Why a search ended before it had done all that it could.
Stop: TypeAlias = Literal[
    "work limit", "time limit", "memory limit", "interrupted", "maps limit", "no proof"
]
# Reasons that end a search before it has done what it could. More of the same may give more.
EARLY: tuple[Stop, ...] = ("work limit", "time limit", "interrupted")


def processor_clock(
    processor: Callable[[], float] = time.thread_time, waiting: float = WAITING
) -> Callable[[], float]:
    """Make a clock of processor time, at least 1 / `waiting` of the wall-clock time.

    In a search that counts work, the clock counts work. `processor` returns the processor time, in
    seconds: of this thread, or of the whole process.
    """
    if counts_work():
        done = work_done()
        return lambda: work_done() - done
    used, began = processor(), now()

    def clock() -> float:
        return max(processor() - used, (now() - began) / waiting)

    return clock


def _seconds() -> float:
    """Return the seconds on the wall clock."""
    return time.perf_counter()


class LimitError(Exception):
    """A search reached a limit or was interrupted. Its best map so far is the answer."""

    def __init__(self, reason: Stop) -> None:
        self.reason = reason


class StageTimeError(Exception):
    """The time of a stage of a search is over. The search goes on with its next stage."""


class Watch:
    """The clock and the limits of a search. `check` raises when a limit is reached.

    The clock counts units of work if there is a work limit, else seconds. It counts only between
    `start` and `stop`. So the time that a caller spends with a map does not count.
    """

    def __init__(
        self,
        limit: float | None = None,
        memory: float | None = None,
        on_tick: Callable[[], None] = lambda: None,
        clock: Callable[[], float] | None = None,
        *,
        work: float | None = None,
        around: Watch | None = None,
    ) -> None:
        """Set the limits. The clock does not run until `start`.

        Args:
            limit: The time limit in seconds; None for no limit. If there is a work limit, this is
                only a cap, which decides nothing else.
            memory: The largest memory of the process in MiB; None for no limit.
            on_tick: `check` calls this every TICK seconds, to report progress.
            clock: Another clock for `limit`; None for that of the surrounding search.
            work: The work limit in units; None for no limit.
            around: A watch whose limits also end this one; None for no such watch.
        """
        self._on_tick, self._around = on_tick, around
        counts = work is not None or (clock is None and counts_work())
        self._clock = work_done if counts else clock or _seconds
        self._next_tick = time.perf_counter() + TICK
        self._limit = limit if work is None else work
        self._cap = limit if work is not None else None
        self._memory = memory
        self._started: float | None = None
        self._began = self._seconds = 0.0
        self._spent = 0.0
        # `check` raises StageTimeError once, when the clock shows more than this.
        self.stage_ends = math.inf
        self.interrupted = False
        # Whether the last part of the limit is reserved for making a map without a search.
        self.lacks_map: Callable[[], bool] = lambda: False

    @property
    def counts_work(self) -> bool:
        """Whether the clock counts units of work."""
        return self._clock is work_done

    def start(self, since: float | None = None) -> None:
        """Let the clock run, from `since` if it is given. If it runs already, do nothing."""
        if self._started is None:
            self._began = time.perf_counter()
            self._started = self._clock() if since is None else since

    @property
    def running(self) -> bool:
        """Whether the clock runs."""
        return self._started is not None

    def stop(self) -> None:
        """Stop the clock. `start` lets it go on."""
        self._seconds = self.seconds()
        self._spent, self._started = self.elapsed(), None

    def part(self, limit: float, clock: Callable[[], float] | None = None) -> Watch:
        """Start a new watch with this limit on its clock. Limits of this watch also end it."""
        part = Watch(limit, self._memory, clock=clock or self._clock, around=self)
        part.start()
        return part

    @contextmanager
    def stage(self, ends: float) -> Iterator[None]:
        """End the work in this context by StageTimeError when the clock shows more than `ends`.

        The end of a stage around this one remains as it was.
        """
        around = self.stage_ends
        self.stage_ends = min(ends, around)
        try:
            yield
        finally:
            self.stage_ends = around

    def shorten(self, seconds: float) -> None:
        """Lower the limit to this much on the clock since the start."""
        self._limit = seconds if self._limit is None else min(seconds, self._limit)

    def elapsed(self) -> float:
        """Return what the clock shows: units of work or seconds."""
        return self._spent + (0 if self._started is None else self._clock() - self._started)

    def seconds(self) -> float:
        """Return the wall-clock seconds for which the clock has run."""
        running = 0.0 if self._started is None else time.perf_counter() - self._began
        return self._seconds + running

    def check(self, ahead: float = 0.0, mebibytes: float = 0.0) -> None:
        """Raise LimitError if a limit is reached, or would be reached during the next work.

        That work takes `ahead` on the clock and some memory, and cannot be interrupted. Raises
        StageTimeError if the time of the present stage is over.
        """
        if self.interrupted:
            raise LimitError("interrupted")
        if self._around is not None:
            self._around.check()
        at = time.perf_counter()
        if at > self._next_tick:
            self._next_tick = at + TICK
            self._on_tick()
        if not self.allows(ahead):
            raise LimitError("work limit" if self.counts_work else "time limit")
        if self._cap is not None and self.seconds() > self._cap:
            raise LimitError("time limit")
        if self._memory is not None and peak_memory() + mebibytes > self._memory:
            raise LimitError("memory limit")
        if self.elapsed() > self.stage_ends:
            self.stage_ends = math.inf
            raise StageTimeError

    def later(self, seconds: float) -> Callable[[], None]:
        """Make a `check` that ignores the time limit for some seconds of processor time."""
        with counting(self.counts_work):
            used = processor_clock()

        def check() -> None:
            try:
                self.check()
            except LimitError as limit:
                if limit.reason not in ("time limit", "work limit") or used() > seconds:
                    raise

        return check

    def allows(self, ahead: float) -> bool:
        """Whether the limit allows work that takes this much and cannot be interrupted."""
        reserved = RESERVE * self._limit if self._limit and self.lacks_map() else 0.0
        return ahead + reserved <= self.left()

    def memory_left(self) -> float | None:
        """Return the MiB that are left until the memory limit; None for no limit."""
        if self._memory is None:
            return None
        return self._memory - peak_memory()

    def left(self) -> float:
        """Return what is left until the limit, on the clock; infinity for no limit."""
        return math.inf if self._limit is None else self._limit - self.elapsed()

    def seconds_left(self) -> float:
        """Return the seconds that are left until the time limit; infinity for no limit."""
        if not self.counts_work:
            return self.left()
        return math.inf if self._cap is None else self._cap - self.seconds()

    def conflicts_left(self, weight: float) -> int:
        """Return after how many conflicts of clasp a limit is reached; -1 if work is not counted.

        `weight` is the work of a conflict, in units.

        Seconds are checked while clasp runs. Work is counted when it has ended, so that it always
        ends at the same conflict.
        """
        if not self.counts_work:
            return -1
        left = self.left()
        if self._limit and left < math.inf and self.lacks_map():
            left -= RESERVE * self._limit
        conflicts = min(left, self.stage_ends - self.elapsed()) / weight
        least = -1 if conflicts > MOST_CONFLICTS else max(int(conflicts) + 1, 1)
        around = self._around.conflicts_left(weight) if self._around is not None else -1
        return min((n for n in (least, around) if n >= 0), default=-1)


def in_process(work: Callable[..., Result], *arguments: object, watch: Watch) -> Result:
    """Call `work` in another process, or in this one if no other process can be started.

    Args:
        work: The function to call, with `arguments` and then a watch. The function, its arguments,
            its result and its errors must be picklable.
        arguments: The first arguments of `work`.
        watch: The limits. At a limit the other process is killed. There, `work` gets a new watch
            that has only the memory limit. In this process, it gets `watch` itself.

    Returns:
        The result of `work`.

    Raises:
        LimitError: A limit is reached, or the process ended without an answer.
    """

    def stopped() -> bool:
        watch.check()
        return False

    from ssh_abduction.runtime import workers  # loads subprocess

    # A program that embeds Python cannot be run as Python.
    if "python" not in os.path.basename(sys.executable or "").lower():
        return work(*arguments, watch)
    tasks = [(0, work, arguments, watch.memory_left())]
    try:
        (answer,) = workers.answers(_attempted, tasks, 1, stopped, None, 0.0)
    except OSError:
        return work(*arguments, watch)
    if isinstance(answer, workers.Lost):  # most likely the system is short of memory
        raise LimitError("memory limit")
    attempted: tuple[Result, Exception | None] = answer
    result, error = attempted
    if error is not None:
        raise error
    return result


def _attempted(
    _: int,
    work: Callable[..., object],
    arguments: tuple[object, ...],
    memory: float | None,
    __: Callable[[], bool],
) -> tuple[object, Exception | None]:
    """Call `work` in the other process. Return its result, or the exception that it raised."""
    try:
        return work(*arguments, Watch(memory=memory)), None
    except Exception as error:
        return None, error


def resident_memory() -> float:
    """Return the memory in MiB that this process uses now; its peak if the system has no /proc."""
    with suppress(OSError, StopIteration), open("/proc/self/status", "rb") as status:
        return next(int(line.split()[1]) for line in status if line.startswith(b"VmRSS:")) / 2**10
    return peak_memory()


def peak_memory() -> float:
    """Return the largest memory in MiB that this process, without its parent, has used."""
    with suppress(OSError, StopIteration), open("/proc/self/status", "rb") as status:
        return next(int(line.split()[1]) for line in status if line.startswith(b"VmHWM:")) / 2**10
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10
