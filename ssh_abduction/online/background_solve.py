"""Solves a trace with faults in the time of a step, or in another process."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.online.background import BackgroundTask
from ssh_abduction.online.options import StepOptions
from ssh_abduction.solver import Bound, Status, Stop, Watch, has_processors, in_process, solve
from ssh_abduction.theory.speedups import Speedups
from ssh_abduction.theory.theory import Theory

# A trace is solved in the background for this many seconds. Then the longer trace is worth more.
MEANWHILE = 60.0
# After a search that proved nothing, or did not list all, the trace grows by this factor, and by
# this many steps at least, before the next one.
RETRY = 1.05
PAUSE = 2
# A search was slow if it took this many times the time limit.
OVERRUN = 2


@dataclass(frozen=True, slots=True)
class Solved:
    """What solving a trace of `steps` steps found, as in Solution. It can be sent to a process."""

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
    """What `solve` finds for the steps so far."""
    found = solve(
        trace, theory.of_steps(0, len(trace)), time_limit=limit, max_maps=maps, speedups=speedups
    )
    return Solved(len(trace), found.status, found.maps, found.bound, found.complete, found.stopped)


class BackgroundSolve(BackgroundTask[Solved]):
    """Solves the steps so far in another process."""

    def __init__(self, trace: Trace, theory: Theory, maps: int | None, speedups: Speedups) -> None:
        super().__init__(partial(_solve, trace, theory, maps, speedups))

    @staticmethod
    def begun(
        trace: Trace, theory: Theory, maps: int | None, speedups: Speedups
    ) -> BackgroundSolve | None:
        """Begin to solve; None without a second processor, or if processes are switched off."""
        can_begin = speedups.processes and has_processors(speedups)
        return BackgroundSolve(trace, theory, maps, speedups) if can_begin else None


def _solve(
    trace: Trace, theory: Theory, maps: int | None, speedups: Speedups, watch: Watch
) -> Solved:
    return in_process(solved, trace, theory, MEANWHILE, maps, speedups, watch=watch)


class FaultSolver:
    """Solves a growing trace with faults again when that is due.

    Args:
        options: What a step may use.
        searches: Number of earlier searches.

    Attributes:
        searches: Number of steps that solved the trace.
        background: The search in the background, if one is under way.
    """

    def __init__(self, options: StepOptions, searches: int = 0) -> None:
        self.searches = searches
        self.background: BackgroundSolve | None = None
        self._options = options
        self._next_search = 0  # no search before the trace has this many steps
        # clingo cannot be stopped while it grounds a step. If that took too long once, later
        # searches run in the background.
        self._is_slow = False

    def is_due(self, trace: Trace) -> bool:
        """Whether the trace has grown enough since the last search."""
        return len(trace) >= self._next_search

    def make_due(self) -> None:
        """Search at the next step: the last search proved the cost."""
        self._next_search = 0

    def solve(self, trace: Trace, theory: Theory, has_map: bool) -> Solved | None:
        """Solve the trace in the time of a step.

        Args:
            trace: The steps so far.
            theory: The theory without `auto`.
            has_map: Whether some map is known. Then a slow search may run in the background.

        Returns:
            What was found; None if the search goes on in the background.
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
        """Solve the trace in another process, if none does; False if that is impossible."""
        self.background = self.background or BackgroundSolve.begun(
            trace, theory, self._options.max_maps, self._options.speedups
        )
        return self.background is not None

    def finished(self) -> Solved | None:
        """What the background search found, if it is done. Its trace may lack the last steps."""
        if self.background and self.background.done():
            background, self.background = self.background, None
            return background.result()
        return None
