"""Engines: what asks clingo for maps of a growing prefix of a trace."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Self

from ssh_abduction.asp.control import Asker, has_processors
from ssh_abduction.asp.limits import Watch
from ssh_abduction.maps import SSHMap
from ssh_abduction.steps.log import Log
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.speedups import Speedups
from ssh_abduction.theory.theory import Theory
from ssh_abduction.trace import Trace

GROWTH = 1.25  # a prefix grows at least by this factor, so that there are few
FIRST_PREFIXES = 32  # steps of a prefix that an engine with a chart tries before AT_ONCE
AT_ONCE = 8000  # steps that are compared in pairs; the matrix has the square of that many bytes


@dataclass(frozen=True, slots=True)
class Cost:
    """How many dstates, places, paths and excused pairs of paths a map has."""

    dstates: int
    places: int
    paths: int
    excuses: int = 0

    @staticmethod
    def of(ssh_map: SSHMap) -> Cost:
        return Cost(len(ssh_map.dstates), len(ssh_map.places), len(ssh_map.paths), len(ssh_map.excused))

    def preferred_by(self, theory: Theory) -> tuple[int, ...]:
        """The counts that a theory prefers, first to last."""
        return tuple(getattr(self, name) for name in theory.priorities)

    def to_dict(self) -> dict[str, int]:
        counts = {"dstates": self.dstates, "places": self.places, "paths": self.paths}
        return {**counts, "excuses": self.excuses} if self.excuses else counts


@dataclass(frozen=True, slots=True)
class Found:
    """A map of a prefix, and what it costs: the preferred counts, first to last."""

    map: SSHMap
    cost: tuple[int, ...]

    @staticmethod
    def of(ssh_map: SSHMap, theory: Theory) -> Found:
        """A map and its counts, which it shows, as no axiom is left out."""
        return Found(ssh_map, Cost.of(ssh_map).preferred_by(theory))


class Engine(Asker):
    """An asker whose control holds the axioms for the first `size` steps of a trace.

    paths   how many names for paths there are
    clique  nodes that are pairwise apart (chart.py), if it needs to know some; in the causal theory they are steps
    intact  False after an error that may have left the control half told
    lists_least  whether maps_of_cost lists maps with the fewest dstates of the prefix alone
    goes_on  whether it can go on with a trace that its own has grown to
    """

    lists_least = False
    goes_on = True

    def __init__(self, trace: Trace, theory: Theory, watch: Watch, paths: int = 0) -> None:
        super().__init__(watch)
        self.intact = True
        self.size = 0
        self.paths = paths
        self.clique: list[int] = []
        self._trace = trace
        self._theory = theory

    def grow(self, size: int) -> None:
        """Let the prefix have `size` steps."""
        raise NotImplementedError

    def next_size(self, failed: int) -> int:
        """The size to grow to when the maps of the prefix do not explain step `failed`."""
        return min(len(self._trace), max(failed + 1, int(self.size * GROWTH)))

    @property
    def size_to_go_on(self) -> int:
        """The size to grow to first when a search was stopped and the trace has grown since."""
        return self.size

    def with_paths(self, paths: int) -> Engine:
        """Another engine, still for the empty prefix, with so many names for paths."""
        raise NotImplementedError

    def over(self, trace: Trace, watch: Watch, log: Log) -> Engine:
        """An engine for a trace that this one's has grown to, under other limits."""
        raise NotImplementedError

    def improving_maps(self, most: tuple[int, ...] = ()) -> Iterator[Found]:
        """Maps of the prefix, each better than the one before; where the iteration ends, the last one is minimal.

        most  what they cost at most, if that is known
        """
        raise NotImplementedError

    def maps_of_cost(self, cost: tuple[int, ...], enough: int) -> Iterator[Found]:
        """All maps of the prefix that cost this and no more; or `enough` of them, unless that is 0."""
        raise NotImplementedError

    def forbid(self, equalities: Collection[Equality]) -> None:
        """From now on no map has all of these equalities, of steps of the prefix."""
        raise NotImplementedError

    def settle(self) -> None:
        """End what is still under way in clingo, when a search is over: a thread left behind would abort Python at its end."""


class ChartedEngine(Engine):
    """An engine that charts a prefix (chart.py)."""

    def __init__(self, trace: Trace, theory: Theory, watch: Watch, log: Log, speedups: Speedups) -> None:
        super().__init__(trace, theory, watch)
        self._log = log
        self._speedups = speedups

    def with_paths(self, paths: int) -> Self:
        return type(self)(self._trace, self._theory, self._watch, self._log, self._speedups)

    def next_size(self, failed: int) -> int:
        steps = len(self._trace)
        if self.size < FIRST_PREFIXES:
            return min(steps, max(failed + 1, FIRST_PREFIXES))
        return steps if steps <= AT_ONCE else min(steps, max(failed + 1, 2 * self.size, AT_ONCE))

    @property
    def size_to_go_on(self) -> int:
        return self.next_size(self.size)

    def _has_processors(self) -> bool:
        return has_processors(self._speedups)
