"""The protocol of all engines, and the values that go in (`Task`) and come out (`Found`)."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.limits import Watch
from ssh_abduction.solution.values import Found
from ssh_abduction.solver.asp.control import Asker
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.speedups import Speedups
from ssh_abduction.theory.theory import Theory

# Compare at most this many steps in pairs: n steps need a matrix of n x n bytes.
AT_ONCE = 8000


@dataclass(frozen=True)
class Task:
    """The problem that an engine solves, with the limits and the speed-ups that may be used."""

    problem: Problem
    log: Log
    watch: Watch
    speedups: Speedups

    @property
    def trace(self) -> Trace:
        """The whole trace."""
        return self.problem.trace

    @property
    def theory(self) -> Theory:
        """The theory of the problem, with all its defaults filled in."""
        return self.problem.theory

    @staticmethod
    def of(problem: Problem, watch: Watch | None = None, speedups: Speedups | None = None) -> Task:
        """Make a task without the speed-ups that the theory rules out; no watch means no limits."""
        speedups = (speedups or Speedups()).that_hold_for(problem.theory)
        # `sides` treats each link between visits as a travel.
        if speedups.sides and any(action.leaves_paths for action in problem.trace.actions):
            speedups = replace(speedups, sides=False)
        return Task(
            problem,
            Log(problem.trace, problem.theory, evidence=problem.evidence),
            watch or Watch(),
            speedups,
        )


class Engine(Protocol):
    """The protocol of an engine, which asks clingo for maps of a prefix.

    The prefix is the first `size` steps of the trace. The engine grounds the axioms for them.
    """

    asker: Asker

    @property
    def size(self) -> int:
        """The number of steps in the prefix."""
        ...

    @property
    def bound(self) -> int | None:
        """A proven lower bound on the first count of the cost; None if none is known."""
        ...

    def grow(self, size: int) -> None:
        """Make the first `size` steps the prefix."""
        ...

    def next_size(self, failed: int) -> int:
        """Return the size to grow to when no map of the prefix explains step `failed`."""
        ...

    def improving_maps(self, most: tuple[int, ...] = ()) -> Iterator[Found]:
        """Yield maps of the prefix, each cheaper than the one before.

        When the iteration ends, the last map is minimal. If there was none, the prefix has no map
        (within `most`). `most` is an upper bound on the cost of the maps; empty if none is known.
        """
        ...

    def maps_of_cost(self, cost: tuple[int, ...], enough: int) -> Iterator[Found]:
        """Yield `enough` maps of the prefix with this cost, or all of them if `enough` is 0."""
        ...

    def forbid(self, equalities: Collection[Equality]) -> bool:
        """Exclude all maps in which all of these equalities of steps hold, from now on.

        Returns False, and changes nothing, if the engine cannot forbid such equalities.
        """
        ...


@runtime_checkable
class GrowingEngine(Protocol):
    """The protocol of an engine that can take more steps when the trace has grown.

    Attributes:
        grows: Whether it can in its theory.
    """

    grows: bool

    def over(self, task: Task) -> Engine:
        """Go on with a longer trace, with new limits, and return this engine itself."""
        ...


def in_fixed_order(equalities: Iterable[Equality]) -> list[Equality]:
    """Sort equalities, as the order of a set depends on the hashes of texts."""
    return sorted(equalities, key=lambda one: (one.first, one.second, one.of, one.holds))
