"""What a search knows about the maps of a trace so far."""

from __future__ import annotations

from dataclasses import replace

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solver.asp.limits import Stop
from ssh_abduction.solver.values import Bound, Cost, Found, Status, cost_as_counted
from ssh_abduction.theory.theory import Theory


class Known:
    """What is known about the maps of a trace.

    Attributes:
        best: The best map of the whole trace; None if there is none.
        cost: The preferred counts of the best map, the most important one first; () without one.
        bound: Proven lower bounds on the counts of any map.
        lower: A lower bound on the preferred counts of every map, proven on a prefix; None if there
            is none.
        partial: The map of a prefix that was found last; None before that.
        complete: Whether all maps were given: all minimal ones and, with `within`, all others that
            it asks for.
        count: The number of maps given to the caller.
        refused: For each kind of evidence, by name, how many sets of equalities it rejected.
    """

    def __init__(self, theory: Theory) -> None:
        self.status = Status.UNKNOWN
        self.best: SSHMap | None = None
        self.cost: tuple[int, ...] = ()
        self.bound = Bound()
        self.lower: tuple[int, ...] | None = None
        self.partial: SSHMap | None = None
        self.complete = False
        self.count = 0
        self.refused: dict[str, int] = {}
        self._stopped: Stop | None = None
        self._theory = theory

    @property
    def stopped(self) -> Stop | None:
        """Why the search ended before all maps were given; None if they were."""
        return None if self.complete else self._stopped

    @stopped.setter
    def stopped(self, why: Stop | None) -> None:
        self._stopped = why

    def is_better(self, found: Found) -> bool:
        """Whether a map of the trace, or of a prefix, costs less than the best map so far."""
        return self.best is None or found.cost < self.cost

    def keep(self, found: Found, labels: tuple[int, ...]) -> None:
        """Make a map, perhaps of the first steps, the best one. `labels` is for the whole trace."""
        self.best, self.cost = replace(found.map, dstate_at=labels), found.cost

    def raise_bound(self, proven: int | None) -> None:
        """Raise the lower bound on the count that is minimised first, if `proven` is larger."""
        first = self._theory.priorities[0] if self._theory.priorities else None
        if first and proven is not None and proven > (getattr(self.bound, first) or 0):
            self.bound = replace(self.bound, **{first: proven})

    def raise_lower(self, cost: tuple[int, ...]) -> None:
        """Raise the lower bound on the cost of all maps to the least cost for the first steps."""
        self.raise_bound(cost[0] if cost else None)
        if self.lower is None or cost > self.lower:
            self.lower = cost

    @property
    def best_cost(self) -> Cost | None:
        """The counts of the best map; None if there is no map."""
        return None if self.best is None else cost_as_counted(self.best, self.cost, self._theory)
