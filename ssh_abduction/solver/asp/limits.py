"""The limits of a search: time, memory, and interruption."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Literal, TypeAlias

from ssh_abduction.data.errors import SolverError, brief, is_finite

# The search for minimal maps of prefixes ends when this share of the time limit is left. That
# share is for finding any map of the whole trace, minimal or not.
RESERVE = 0.2
# A search of the whole trace that has found no map ends when this share of the time limit is left.
# That share is for making a map without a search.
LAST = 0.05
# Seconds between two checks of the clock and of Ctrl-C while clingo is busy. A limit may be overrun
# by a second, and a check takes far less than this.
POLL = 0.05
# Seconds between two reports of progress: as often as a person can read them.
TICK = 0.5

Stop: TypeAlias = Literal["time limit", "memory limit", "interrupted", "maps limit", "no proof"]


def check_limit(name: str, unit: str, limit: object) -> None:
    """Raise SolverError if a limit of a caller is neither None nor a number above 0."""
    if (
        limit is not None
        and not (is_finite(limit) and limit > 0)
        and not (isinstance(limit, float) and limit == math.inf)
    ):
        raise SolverError(
            f"{name}: expected a number of {unit} above 0, got {brief(limit)}; "
            "leave it out for none"
        )


class LimitError(Exception):
    """A search reached a limit or was interrupted. The incumbent is the answer."""

    def __init__(self, reason: Stop) -> None:
        self.reason = reason


class StageTimeError(Exception):
    """The time of a stage is over. The next stage begins."""


class Watch:
    """The limits of a search: `check` raises when one is reached.

    Time that the caller of a stream spends between two maps does not count.
    """

    def __init__(
        self,
        limit: float | None = None,
        memory: float | None = None,
        on_tick: Callable[[], None] = lambda: None,
        *,
        beside: Watch | None = None,
    ) -> None:
        """Set the limits. `start` begins to count time.

        Args:
            limit: Seconds; None for no limit.
            memory: MiB that the process may use; None for no limit.
            on_tick: Called now and then, to report progress.
            beside: The watch of the main search, if this is one beside it. The main search ends
                this one. Its time limit only rejects work that would outlast it.
        """
        self._beside = beside
        self._on_tick = on_tick
        self._next_tick = TICK
        self._limit = limit
        self._allowed = None if limit is None else limit * (1 - RESERVE)
        self._memory = memory
        self._started: float | None = None
        self._spent = 0.0
        self._stage_ends = math.inf
        self.interrupted = False

    def start(self) -> None:
        self._started = time.perf_counter()

    def begin_anew(self) -> None:
        """Restart the clock at 0, with the whole time limit."""
        self._spent, self._next_tick, self._stage_ends, self.interrupted = (
            0.0,
            TICK,
            math.inf,
            False,
        )
        self.use_reserve()
        self.start()

    @property
    def has_reserve(self) -> bool:
        """Whether the last share of the time limit is still reserved for any map."""
        return self._allowed is not None and self._allowed <= self.reserve_begins

    @property
    def running(self) -> bool:
        return self._started is not None

    def use_reserve(self, last: float = 0.0) -> None:
        """Allow the search to use the whole time limit.

        Args:
            last: A share of the limit to keep reserved, unless it is in use already.
        """
        if self._limit is not None and self._allowed is not None:
            self._allowed = max(self._allowed, self._limit * (1 - last))

    def stop(self) -> None:
        self._spent, self._started = self.elapsed(), None

    @property
    def reserve_begins(self) -> float:
        """Seconds after which only the share for finding any map is left."""
        return math.inf if self._limit is None else self._limit * (1 - RESERVE)

    def part(self, seconds: float) -> Watch:
        """A watch that ends after this many seconds, or when this one does."""
        part = Watch(seconds, self._memory, self.check)
        part.use_reserve()
        part.start()
        return part

    def shorten(self, seconds: float) -> None:
        """Lower the time limit to this many seconds."""
        self._limit = self._allowed = seconds if self._limit is None else min(seconds, self._limit)

    def end_stage_after(self, seconds: float) -> None:
        """Let `check` raise StageTimeError once, after this many seconds of search."""
        self._stage_ends = seconds

    def elapsed(self) -> float:
        return self._spent + (0 if self._started is None else time.perf_counter() - self._started)

    def check(self, ahead: float = 0.0, mebibytes: float = 0.0) -> None:
        """Raise if a limit is reached, or coming work that cannot be interrupted would reach it.

        Args:
            ahead: Seconds that the work takes.
            mebibytes: Memory that the work takes.

        Raises:
            LimitError: A limit is reached, or the search was interrupted.
            StageTimeError: The time of the present stage is over.
        """
        if self.interrupted:
            raise LimitError("interrupted")
        if self.elapsed() > self._next_tick:
            self._next_tick = self.elapsed() + TICK
            self._on_tick()
        if not self.allows(ahead):
            raise LimitError("time limit")
        if self._memory is not None and peak_memory() + mebibytes > self._memory:
            raise LimitError("memory limit")
        if self.elapsed() > self._stage_ends:
            self._stage_ends = math.inf
            raise StageTimeError

    def allows(self, seconds: float) -> bool:
        """Whether there is time for work of this length that cannot be interrupted."""
        if self._allowed is not None and self.elapsed() + seconds > self._allowed:
            return False
        return not seconds or self._beside is None or self._beside.left() >= seconds

    def memory_left(self) -> float | None:
        """MiB until the memory limit, for other processes to use; None for no limit."""
        if self._memory is None:
            return self._beside.memory_left() if self._beside else None
        return self._memory - peak_memory()

    def left(self) -> float:
        """Seconds until the time limit."""
        return math.inf if self._limit is None else self._limit - self.elapsed()


def resident_memory() -> float:
    """The memory that this process uses now, in MiB; its peak if the system lacks that number."""
    with suppress(OSError, StopIteration), open("/proc/self/status", "rb") as status:
        return next(int(line.split()[1]) for line in status if line.startswith(b"VmRSS:")) / 2**10
    return peak_memory()


def peak_memory() -> float:
    """The most memory that this process has used, in MiB.

    On Linux getrusage counts what the parent process used, so /proc is read there.
    """
    with suppress(OSError, StopIteration), open("/proc/self/status", "rb") as status:
        return next(int(line.split()[1]) for line in status if line.startswith(b"VmHWM:")) / 2**10
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10
