"""The limits of a search: time, memory, and interruption."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Literal, TypeAlias

from ssh_abduction.errors import SolverError, brief, is_finite

RESERVE = 0.2  # share of the time limit kept for finding any map of the whole trace
POLL = 0.05  # seconds between looks at the clock and for Ctrl-C
TICK = 0.5  # seconds between reports of progress while clingo is busy

Stop: TypeAlias = Literal["time limit", "memory limit", "interrupted", "maps limit"]


def check_limit(name: str, unit: str, limit: object) -> None:
    """Raises SolverError where a limit that a caller gives is neither None nor a number above 0."""
    if limit is not None and not (is_finite(limit) and limit > 0) and not (isinstance(limit, float) and limit == math.inf):
        raise SolverError(f"{name}: expected a number of {unit} above 0, got {brief(limit)}; leave it out for none")


class Stopped(Exception):  # noqa: N818 - not an error
    def __init__(self, reason: Stop) -> None:
        self.reason = reason


class Paused(Exception):  # noqa: N818 - not an error
    """Something else is to be done first."""


class Watch:
    """The limits of a search: `check` raises when one is over. Time that the caller of a stream takes does not count.

    limit    seconds, or None
    memory   MiB that the process may use, or None
    on_tick  called now and then
    beside  the watch of the search that this one is beside: that one ends it, and what cannot be interrupted is not begun where too little time is left
    """

    def __init__(
        self,
        limit: float | None = None,
        memory: float | None = None,
        on_tick: Callable[[], None] = lambda: None,
        *,
        beside: Watch | None = None,
    ) -> None:
        self._beside = beside
        self._on_tick = on_tick
        self._next_tick = TICK
        self._limit = limit
        self._allowed = None if limit is None else limit * (1 - RESERVE)
        self._memory = memory
        self._started: float | None = None
        self._spent = 0.0
        self._pause_at = math.inf
        self.interrupted = False

    def start(self) -> None:
        self._started = time.perf_counter()

    @property
    def has_reserve(self) -> bool:
        return self._allowed != self._limit

    @property
    def running(self) -> bool:
        return self._started is not None

    def use_reserve(self) -> None:
        """From now on the whole time limit may be used."""
        self._allowed = self._limit

    def stop(self) -> None:
        self._spent, self._started = self.elapsed(), None

    def part(self, seconds: float) -> Watch:
        """A watch, started, for so many seconds of this one's time, which is looked at now and then."""
        part = Watch(seconds, self._memory, self.check)
        part.use_reserve()
        part.start()
        return part

    def shorten(self, seconds: float) -> None:
        """From now on the time limit is this, if that is less."""
        self._limit = self._allowed = seconds if self._limit is None else min(seconds, self._limit)

    def pause_after(self, seconds: float) -> None:
        """Let `check` raise Paused, once, when so much time was spent."""
        self._pause_at = seconds

    def elapsed(self) -> float:
        return self._spent + (0 if self._started is None else time.perf_counter() - self._started)

    def check(self, ahead: float = 0.0, mebibytes: float = 0.0) -> None:
        """Raise if a limit is over, or would be after what cannot be interrupted and takes so many seconds, and so much memory."""
        if self.interrupted:
            raise Stopped("interrupted")
        if self.elapsed() > self._next_tick:
            self._next_tick = self.elapsed() + TICK
            self._on_tick()
        if not self.allows(ahead):
            raise Stopped("time limit")
        if self._memory is not None and peak_memory() + mebibytes > self._memory:
            raise Stopped("memory limit")
        if self.elapsed() > self._pause_at:
            self._pause_at = math.inf
            raise Paused

    def allows(self, seconds: float) -> bool:
        """Whether there is time for so many seconds of what cannot be interrupted."""
        if self._allowed is not None and self.elapsed() + seconds > self._allowed:
            return False
        return not seconds or self._beside is None or self._beside.left() >= seconds

    def memory_left(self) -> float | None:
        """MiB until the memory limit, of which other processes may use as much."""
        if self._memory is None:
            return self._beside.memory_left() if self._beside else None
        return self._memory - peak_memory()

    def left(self) -> float:
        """Seconds until the time limit."""
        return math.inf if self._limit is None else self._limit - self.elapsed()


def resident_memory() -> float:
    """The memory that this process uses now, in MiB; the most that it has used, where the system does not tell."""
    with suppress(OSError, StopIteration), open("/proc/self/status", "rb") as status:
        return next(int(line.split()[1]) for line in status if line.startswith(b"VmRSS:")) / 2**10
    return peak_memory()


def peak_memory() -> float:
    """The most memory this process has used, in MiB. On Linux getrusage begins with what the process that began this one used."""
    with suppress(OSError, StopIteration), open("/proc/self/status", "rb") as status:
        return next(int(line.split()[1]) for line in status if line.startswith(b"VmHWM:")) / 2**10
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10
