"""What a search knows of a trace so far: it only ever gets better."""

from __future__ import annotations

from dataclasses import replace

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solver.asp.limits import Stop
from ssh_abduction.solver.engines.base import Found
from ssh_abduction.solver.values import Bound, Cost, Status, cost_as_counted
from ssh_abduction.theory.theory import Theory


class Known:
    """What is known of the maps of a trace.

    status    what is known in all
    best      the best map of the whole trace, if there is any
    cost      what that costs: the preferred counts, first to last
    bound     proven lower bounds
    lower     what every map of the trace costs at least, as a prefix showed; None where none has yet
    partial   the best map of a prefix that was found last
    stopped   why the search ended before it was complete, if it did
    complete  whether no further minimal map exists
    count     how many minimal maps were given
    refused   how many sets of equalities each kind of evidence refused
    """

    def __init__(self, theory: Theory) -> None:
        self.status = Status.UNKNOWN
        self.best: SSHMap | None = None
        self.cost: tuple[int, ...] = ()
        self.bound = Bound()
        self.lower: tuple[int, ...] | None = None
        self.partial: SSHMap | None = None
        self.stopped: Stop | None = None
        self.complete = False
        self.count = 0
        self.refused: dict[str, int] = {}
        self._theory = theory

    def is_better(self, found: Found) -> bool:
        """Whether a map of the trace, or of a prefix, costs less than the best."""
        return self.best is None or found.cost < self.cost

    def keep(self, found: Found, labels: tuple[int, ...]) -> None:
        """Take a map for the best; with these labels it is one of the whole trace."""
        self.best, self.cost = replace(found.map, labels=labels), found.cost

    def raise_bound(self, proven: int | None) -> None:
        """No map has fewer than this of what is preferred first."""
        first = self._theory.priorities[0] if self._theory.priorities else None
        if first and proven is not None and proven > (getattr(self.bound, first) or 0):
            self.bound = replace(self.bound, **{first: proven})

    def raise_lower(self, cost: tuple[int, ...]) -> None:
        """No map costs less than this, as a minimal map of a prefix does."""
        self.raise_bound(cost[0] if cost else None)
        if self.lower is None or cost > self.lower:
            self.lower = cost

    @property
    def best_cost(self) -> Cost | None:
        """The counts of the best map."""
        return None if self.best is None else cost_as_counted(self.best, self.cost, self._theory)
