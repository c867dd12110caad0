"""Find the minimal maps of a growing trace with clingo, without grounding it anew each time."""

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
    """Searches for minimal maps of a growing trace. Each search continues the last one.

    Args:
        options: The time limit and the other options of a step.
        searches: The number to start counting searches from.

    Attributes:
        searches: Number of searches so far.
        search: The last search; None before the first.
        solution: The last solution, without its maps; None before the first search.
    """

    def __init__(self, options: StepOptions, searches: int = 0) -> None:
        self.options = options
        self.searches = searches
        self.search: Search | None = None
        self.solution: Solution | None = None
        self._next_search = 0  # no search before the trace has this many steps

    def is_due(self, trace: Trace) -> bool:
        """Whether the trace has grown enough since a search that ran out of time."""
        return len(trace) >= self._next_search

    def make_due(self) -> None:
        """Make the next search due at once, whatever the last one found."""
        self._next_search = 0

    def maps(self, trace: Trace, theory: Theory, known: SSHMap | None) -> tuple[SSHMap, ...]:
        """Search for the minimal maps of a trace.

        Args:
            trace: The steps so far.
            theory: The theory, in which no field is "auto".
            known: A map that is known to be minimal, so that only the others are searched for; None
                if no minimal map is known.

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
        # The maps are not ranked, as ranking takes longer than a step may.
        found = tuple(search.unranked())
        self.search, self.solution = search, search.solution()
        was_stopped = search.stopped in ("time limit", "interrupted")
        steps = len(trace)
        self._next_search = max(steps + PAUSE, int(RETRY * steps)) if was_stopped else 0
        return found
