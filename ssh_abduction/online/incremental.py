"""Asks clingo for the minimal maps of a trace that grows, in one control that is kept."""

from __future__ import annotations

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.online.options import StepOptions
from ssh_abduction.solver import Search, Solution
from ssh_abduction.theory.theory import Theory

# After a search that was stopped, the trace grows by this factor before the next one, so that few
# steps are slow.
RETRY = 1.01
# It grows by at least this many steps.
PAUSE = 2


class IncrementalSolver:
    """Searches again, going on from the last search.

    Args:
        options: What a step may use.
        searches: Number of earlier searches.

    Attributes:
        searches: Number of searches.
        search: The last search, None before the first.
        solution: The last answer, without its maps.
    """

    def __init__(self, options: StepOptions, searches: int = 0) -> None:
        self.options = options
        self.searches = searches
        self.search: Search | None = None
        self.solution: Solution | None = None
        self._next_search = 0  # no search before the trace has this many steps

    def is_due(self, trace: Trace) -> bool:
        """Whether the trace has grown enough for the next search."""
        return len(trace) >= self._next_search

    def make_due(self) -> None:
        """Search at the next step: the last search proved the cost."""
        self._next_search = 0

    def maps(self, trace: Trace, theory: Theory, known: SSHMap | None) -> tuple[SSHMap, ...]:
        """Search for the minimal maps of a trace.

        Args:
            trace: The steps so far.
            theory: The theory without `auto`.
            known: A map that is known to be minimal; only the others remain to be found.

        Returns:
            The minimal maps, or the best map found in time. `solution.status` says which.
        """
        self.searches += 1
        search = Search.continuing(
            self.search,
            trace,
            theory,
            time_limit=self.options.time_limit,
            max_maps=self.options.max_maps,
            speedups=self.options.speedups,
            minimal=known,
        )
        # Unranked, as ranking takes longer than a step may.
        found = tuple(search.unranked())
        self.search, self.solution = search, search.solution()
        was_stopped = search.stopped in ("time limit", "interrupted")
        steps = len(trace)
        self._next_search = max(steps + PAUSE, int(RETRY * steps)) if was_stopped else 0
        return found
