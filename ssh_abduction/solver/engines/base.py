"""What all engines have in common: their task, what they find, and their protocol."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from typing import Protocol

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.solver.asp.control import Asker, has_processors
from ssh_abduction.solver.asp.limits import Watch
from ssh_abduction.solver.engines.doubts import Settled
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.solver.values import Cost
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.speedups import Speedups
from ssh_abduction.theory.theory import Theory

# An engine with a chart tries a prefix of this many steps before one of AT_ONCE steps: most traces
# are solved by then.
FIRST_PREFIXES = 32
# Compare at most this many steps in pairs: the matrix has the square of this number of bytes.
AT_ONCE = 8000


@dataclass(frozen=True, slots=True)
class Found:
    """A map of a prefix.

    Attributes:
        map: The map.
        cost: The preferred counts, first to last.
    """

    map: SSHMap
    cost: tuple[int, ...]

    @staticmethod
    def of(ssh_map: SSHMap, theory: Theory) -> Found:
        """A map with the counts that it shows."""
        return Found(ssh_map, Cost.of(ssh_map).preferred_by(theory))


@dataclass(frozen=True)
class Task:
    """What an engine works on.

    Attributes:
        problem: The whole trace, the settled theory and its evidence.
        log: The trace as integers.
        watch: The limits of the search.
        speedups: The speed-ups that are on and hold for the theory.
    """

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
        """The settled theory."""
        return self.problem.theory

    @staticmethod
    def of(problem: Problem, watch: Watch | None = None, speedups: Speedups | None = None) -> Task:
        """A task for all speed-ups that hold for the theory, or for these of them."""
        speedups = (speedups or Speedups()).that_hold_for(problem.theory)
        # `sides` treats each link between visits as a travel, so no action may have slipped.
        if speedups.sides and any(action.slipped for action in problem.trace.actions):
            speedups = replace(speedups, sides=False)
        return Task(
            problem,
            Log(problem.trace, problem.theory, problem.pairs),
            watch or Watch(),
            speedups,
        )

    @property
    def has_processors(self) -> bool:
        """Whether a search may use two threads."""
        return has_processors(self.speedups)


class Engine(Protocol):
    """What the search may call on an engine.

    An engine holds the axioms for the first `size` steps of a trace, the prefix.

    Attributes:
        asker: Asks clingo.
        intact: False after an error during which clingo may have missed rules.
        lists_least: Whether it can list only maps with the fewest dstates of the prefix.
        goes_on: Whether it can go on when its trace has grown.
    """

    asker: Asker
    intact: bool
    lists_least: bool
    goes_on: bool

    @property
    def size(self) -> int:
        """How many steps it was given."""
        ...

    @property
    def paths(self) -> int:
        """How many names for paths it has."""
        ...

    @property
    def bound(self) -> int | None:
        """A proven lower bound on the count that is preferred first; None if none is known."""
        ...

    def grow(self, size: int) -> None:
        """Let the prefix have `size` steps."""
        ...

    def next_size(self, failed: int) -> int:
        """The size to grow to when the maps of the prefix do not explain step `failed`."""
        ...

    @property
    def size_to_go_on(self) -> int:
        """The first size to grow to after a stop, when the trace has grown since."""
        ...

    def with_paths(self, paths: int) -> Engine:
        """Another engine, still for the empty prefix, with this many names for paths."""
        ...

    def over(self, task: Task) -> Engine:
        """An engine for the grown trace of this one, under other limits."""
        ...

    def improving_maps(self, most: tuple[int, ...] = ()) -> Iterator[Found]:
        """Maps of the prefix, each better than the one before.

        When the iteration ends, the last one is minimal.

        Args:
            most: An upper bound on their cost, if one is known.
        """
        ...

    def maps_of_cost(self, cost: tuple[int, ...], enough: int) -> Iterator[Found]:
        """All maps of the prefix of this cost; or `enough` of them, if not 0."""
        ...

    def labellings(self, cost: tuple[int, ...]) -> Iterator[Settled] | None:
        """All labels of maps of the prefix of this cost, each once.

        None if the engine does not find dstates before places and paths.
        """
        ...

    def forbid(self, equalities: Collection[Equality]) -> bool:
        """From now on no map has all of these equalities of steps of the prefix.

        Returns:
            Whether the engine can forbid such equalities.
        """
        ...

    def settle(self) -> None:
        """End what clingo still does, when a search is over.

        A running thread would abort Python at its exit.
        """
        ...


def next_charted_size(size: int, failed: int, steps: int) -> int:
    """The size to grow to, for an engine that charts a prefix.

    Charting all steps is cheap, unless they are too many to be compared in pairs.

    Args:
        size: How many steps the engine has.
        failed: The step that the maps of the prefix do not explain.
        steps: How many steps the trace has.
    """
    if size < FIRST_PREFIXES:
        return min(steps, max(failed + 1, FIRST_PREFIXES))
    return steps if steps <= AT_ONCE else min(steps, max(failed + 1, 2 * size, AT_ONCE))
