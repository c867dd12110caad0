"""What all engines have in common: what they are given, what they find, and the protocol that the search knows them by."""

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

# An engine with a chart tries a prefix of so many steps before one of AT_ONCE steps: most traces are settled by then.
FIRST_PREFIXES = 32
# So many steps, at most, are compared in pairs: the matrix of the pairs has the square of that many bytes.
AT_ONCE = 8000


@dataclass(frozen=True, slots=True)
class Found:
    """A map of a prefix, and what it costs: the preferred counts, first to last."""

    map: SSHMap
    cost: tuple[int, ...]

    @staticmethod
    def of(ssh_map: SSHMap, theory: Theory) -> Found:
        """A map and its counts, which it shows, as no axiom is left out."""
        return Found(ssh_map, Cost.of(ssh_map).preferred_by(theory))


@dataclass(frozen=True)
class Task:
    """What an engine works on.

    trace     the whole trace
    theory    with star settled
    log       the trace as integers
    watch     the limits of the search
    speedups  those that hold for the theory
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
        """A task for all speed-ups that hold for a theory, or for these of them."""
        speedups = (speedups or Speedups()).that_hold_for(problem.theory)
        if speedups.sides and any(
            action.slipped for action in problem.trace.actions
        ):  # `sides` takes all that links two visits for a travel
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
    """What the search may tell an engine, and ask it. An engine holds the axioms for the first `size` steps of a trace.

    asker     what it asks clingo with
    size      how many steps it was given
    paths     how many names for paths it has
    intact    False after an error that may have left its control half told
    lists_least  whether it can list only maps with the fewest dstates of the prefix alone
    goes_on   whether it can go on with a trace that its own has grown to
    """

    asker: Asker
    intact: bool
    lists_least: bool
    goes_on: bool

    @property
    def size(self) -> int: ...

    @property
    def paths(self) -> int: ...

    @property
    def bound(self) -> int | None:
        """Lower bound, proven, on the count that is preferred first; None where nothing is known before a search ends."""
        ...

    def grow(self, size: int) -> None:
        """Let the prefix have `size` steps."""
        ...

    def next_size(self, failed: int) -> int:
        """The size to grow to when the maps of the prefix do not explain step `failed`."""
        ...

    @property
    def size_to_go_on(self) -> int:
        """The size to grow to first when a search was stopped and the trace has grown since."""
        ...

    def with_paths(self, paths: int) -> Engine:
        """Another engine, still for the empty prefix, with so many names for paths."""
        ...

    def over(self, task: Task) -> Engine:
        """An engine for a trace that this one's has grown to, under other limits."""
        ...

    def improving_maps(self, most: tuple[int, ...] = ()) -> Iterator[Found]:
        """Maps of the prefix, each better than the one before; where the iteration ends, the last one is minimal.

        most  what they cost at most, if that is known
        """
        ...

    def maps_of_cost(self, cost: tuple[int, ...], enough: int) -> Iterator[Found]:
        """All maps of the prefix that cost this and no more; or `enough` of them, unless that is 0."""
        ...

    def labellings(self, cost: tuple[int, ...]) -> Iterator[Settled] | None:
        """All labels that maps of the prefix have which cost this and no more, each once; None where dstates are not settled before places and paths."""
        ...

    def forbid(self, equalities: Collection[Equality]) -> bool:
        """From now on no map has all of these equalities, of steps of the prefix. False where the engine cannot be told of such ones."""
        ...

    def settle(self) -> None:
        """End what is still under way in clingo, when a search is over: a thread left behind would abort Python at its end."""
        ...


def next_charted_size(size: int, failed: int, steps: int) -> int:
    """The size to grow to, of an engine that charts a prefix: to chart all steps takes little, unless they are too many to be compared in pairs."""
    if size < FIRST_PREFIXES:
        return min(steps, max(failed + 1, FIRST_PREFIXES))
    return steps if steps <= AT_ONCE else min(steps, max(failed + 1, 2 * size, AT_ONCE))
