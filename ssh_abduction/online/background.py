"""Run work in another process while the robot drives, to solve a trace with faults.

Faults are steps that a map treats as wrong: a misread view, or an action that slipped.
"""

from __future__ import annotations

import threading
import time
import weakref
from concurrent.futures import Future
from dataclasses import dataclass

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.solver import (
    Bound,
    LimitError,
    Status,
    Stop,
    Watch,
    has_processors,
    in_process,
    solve,
)
from ssh_abduction.theory.speedups import Speedups
from ssh_abduction.theory.theory import Theory

# A search in the background stops after this many seconds. By then the trace is much longer, and it
# is better to search for a map of the longer trace.
MEANWHILE = 60.0
# After each search with a time limit the trace has to grow by this factor, and by at least this
# many steps, before the next search.
RETRY = 1.05
PAUSE = 2
# A search was slow if it took this many times the time limit.
OVERRUN = 2


@dataclass(frozen=True, slots=True)
class StepOptions:
    """The limits and speed-ups for solving at each step.

    Attributes:
        time_limit: Seconds for each step. A step may take a little longer. None waits for the exact
            answer.
        max_maps: Keep at most this many minimal maps; None keeps all.
        speedups: Flags that say which speed-ups of the solver to use.
    """

    time_limit: float | None
    max_maps: int | None
    speedups: Speedups


@dataclass(frozen=True, slots=True)
class Solved:
    """The parts of a Solution that are needed here. Unlike a Solution, it can be pickled.

    Attributes:
        steps: The number of steps of the trace that was solved.
        status: How much is proven.
        maps: The minimal maps, or the best map found in time.
        bound: The proven lower bound of the cost.
        complete: Whether `maps` are all minimal maps.
        stopped: The limit that ended the search; None if no limit did.
    """

    steps: int
    status: Status
    maps: tuple[SSHMap, ...]
    bound: Bound
    complete: bool
    stopped: Stop | None


def solved(
    trace: Trace,
    theory: Theory,
    limit: float | None,
    maps: int | None,
    speedups: Speedups,
    watch: Watch | None = None,
) -> Solved:
    """Run `solve` on a trace, and return the needed parts of the solution.

    In the theory no field is "auto". `limit` is in seconds. `watch` is not used. It is a parameter
    because `in_process` passes a watch to each function that it runs.
    """
    found = solve(
        trace, theory.of_steps(0, len(trace)), time_limit=limit, max_maps=maps, speedups=speedups
    )
    return Solved(len(trace), found.status, found.maps, found.bound, found.complete, found.stopped)


class BackgroundSearch:
    """A call of `solved` in another process. The process ends when this object is deleted.

    Args:
        arguments: The arguments of `solved`, without the watch.
    """

    def __init__(self, *arguments: object) -> None:
        self._found: Future[Solved | None] = Future()
        watch = Watch()
        thread = threading.Thread(target=_do, args=(arguments, watch, self._found), daemon=True)
        weakref.finalize(self, _end, watch, thread)
        thread.start()

    def done(self) -> bool:
        """Whether the search has ended."""
        return self._found.done()

    def result(self) -> Solved | None:
        """Wait for the result, and return it; None if a limit stopped the search."""
        return self._found.result()


def _do(arguments: tuple[object, ...], watch: Watch, found: Future[Solved | None]) -> None:
    """Run the search, and store its result or its exception in `found`."""
    try:
        found.set_result(in_process(solved, *arguments, watch=watch))
    except LimitError:
        found.set_result(None)
    except BaseException as error:
        found.set_exception(error)


def _end(watch: Watch, thread: threading.Thread) -> None:
    """Interrupt the search of a thread, and wait until it has ended."""
    watch.interrupted = True
    thread.join()


class FaultSolver:
    """Solves a growing trace with faults, again and again, each time after enough new steps.

    Args:
        options: The time limit and the other options of a step.
        searches: The number from which to count searches.

    Attributes:
        searches: Number of searches so far, except those in the background.
    """

    def __init__(self, options: StepOptions, searches: int = 0) -> None:
        self.searches = searches
        self._background: BackgroundSearch | None = None  # its result was not taken yet
        self._options = options
        self._next_search = 0  # no search before the trace has this many steps
        # clingo cannot be stopped while it grounds a step. If the last search took far too long,
        # the next one runs in the background.
        self._is_slow = False

    def is_due(self, trace: Trace) -> bool:
        """Whether enough steps are new since the last search to solve the trace again."""
        return len(trace) >= self._next_search

    def make_due(self) -> None:
        """Make the next search due at once, whatever the last search found."""
        self._next_search = 0

    def solve(self, trace: Trace, theory: Theory, has_map: bool) -> Solved | None:
        """Solve the trace within the time limit of a step, or in the background.

        In the theory no field is "auto". If `has_map`, and the last search was slow, the search
        runs in the background.
        """
        steps, options = len(trace), self._options
        limit = options.time_limit
        self._next_search = 0 if limit is None else max(steps + PAUSE, int(RETRY * steps))
        if self._is_slow and has_map and self.begin_in_background(trace, theory):
            return None
        self.searches += 1
        began = time.perf_counter()
        found = solved(trace, theory, limit, options.max_maps, options.speedups)
        if limit is not None and found.stopped == "time limit":
            self._is_slow = time.perf_counter() - began > OVERRUN * limit
        return found

    def begin_in_background(self, trace: Trace, theory: Theory) -> bool:
        """Start a search in another process, and return whether one is running.

        False if the speed-up `processes` is off, or if there is only one processor.
        """
        maps, speedups = self._options.max_maps, self._options.speedups
        if not self._background and speedups.processes and has_processors():
            self._background = BackgroundSearch(trace, theory, MEANWHILE, maps, speedups)
        return self._background is not None

    def finished(self) -> Solved | None:
        """Take the result of the search in the background; None if it is not done or has none.

        The result is about the trace as it was when the search began.
        """
        if self._background and self._background.done():
            search, self._background = self._background, None
            return search.result()
        return None
