"""The engine for the causal theory on long traces.

This engine finds a map with the fewest dstates, proves that no map has fewer, and lists all such
maps. The search for the dstate of each step is in `names.py`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

from ssh_abduction.solver.asp import facts
from ssh_abduction.solver.asp.control import Asker
from ssh_abduction.solver.sources.exact.engine import Task, next_charted_size
from ssh_abduction.solver.sources.exact.names import NamedLabels
from ssh_abduction.solver.values import Found
from ssh_abduction.theory.evidence import Equality


class CausalEngine:
    """The engine for the causal theory: it minimises the number of dstates."""

    def __init__(self, task: Task) -> None:
        self.asker = Asker(task.watch)
        self._task = task
        self._named = NamedLabels(task, self.asker)

    @property
    def size(self) -> int:
        return self._named.size

    @property
    def bound(self) -> int | None:
        return self._named.bound

    def next_size(self, failed: int) -> int:
        return self._named.large_enough(next_charted_size(self.size, failed, len(self._task.trace)))

    def grow(self, size: int) -> None:
        self._named.grow(size)

    def improving_maps(self, most: tuple[int, ...] = ()) -> Iterator[Found]:
        return map(self._found, self._named.improving())

    def maps_of_cost(self, cost: tuple[int, ...], enough: int) -> Iterator[Found]:
        return map(self._found, self._named.all_of(cost[0], enough))

    def forbid(self, equalities: Collection[Equality]) -> bool:
        self._named.forbid_together([(equality.first, equality.second) for equality in equalities])
        return True

    def _found(self, labels: Sequence[int]) -> Found:
        return Found.of(facts.causal_map(labels, self._task.trace), self._task.theory)
