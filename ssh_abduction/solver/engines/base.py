"""The protocol of all engines, and the values that go in (`Task`) and come out (`Found`)."""

from __future__ import annotations

from collections.abc import Collection, Generator, Iterator
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.solver.asp.control import Asker, mapped
from ssh_abduction.solver.asp.facts.path_reader import PathReader
from ssh_abduction.solver.asp.limits import Watch
from ssh_abduction.solver.engines.doubts import Settled
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.solver.values import Cost
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.speedups import Speedups
from ssh_abduction.theory.theory import Theory

# An engine with a chart first tries a prefix of this many steps, then a prefix of AT_ONCE steps.
# For most traces the first prefix is enough.
FIRST_PREFIXES = 32
# Compare at most this many steps in pairs: n steps need a matrix of n x n bytes.
AT_ONCE = 8000
# After this many conflicts, stop improving paths one by one; raise the bound from below instead.
BETTERING = 20_000


@dataclass(frozen=True, slots=True)
class Found:
    """A map of a prefix, with the counts that the theory minimises, the most important first."""

    map: SSHMap
    cost: tuple[int, ...]

    @staticmethod
    def of(ssh_map: SSHMap, theory: Theory) -> Found:
        """Return a map with its cost: the counts that the theory minimises."""
        return Found(ssh_map, Cost.of(ssh_map).preferred_by(theory))


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
    """The protocol of an engine that can take more steps when the trace has grown."""

    def over(self, task: Task) -> Engine:
        """Go on with a longer trace, with new limits, and return this engine itself."""
        ...


@runtime_checkable
class LabellingEngine(Protocol):
    """The protocol of an engine that finds dstates first. It lists maps with the fewest dstates."""

    def labellings(self, cost: tuple[int, ...]) -> Iterator[Settled]:
        """Yield the maps of this cost, grouped by their labelling.

        A labelling is the dstate of each step of the prefix. Each item stands for the best maps
        with one labelling.
        """
        ...


def maps_of_labels(
    asker: Asker, reader: PathReader, theory: Theory, mode: str, conflicts: int = -1
) -> Generator[Found, None, bool]:
    """Yield maps with given dstates, and return whether clingo ended before the limit of conflicts.

    The reader reads the places and paths that fit the dstates. The theory says what a map costs.
    `mode` is clingo's opt-mode; "ignore" for a single map. -1 conflicts mean no limit.
    """
    answers = asker.answers(
        reader.read,
        mode,
        int(mode == "ignore"),
        control=reader.control,
        conflicts=conflicts,
        ahead=True,
    )
    return (yield from mapped(lambda answer: Found.of(reader.map_of(answer), theory), answers))


def listing(cost: tuple[int, ...]) -> str:
    """Return clingo's opt-mode for listing the maps of this cost, with given dstates."""
    return f"enum,{','.join(map(str, (0, *cost[1:])))}"


def next_charted_size(size: int, failed: int, steps: int) -> int:
    """Return the next prefix size, for an engine that compares all pairs of steps beforehand.

    `size` is the size so far, and `steps` the length of the trace. No map explains step `failed`.
    """
    if size < FIRST_PREFIXES:
        return min(steps, max(failed + 1, FIRST_PREFIXES))
    return steps if steps <= AT_ONCE else min(steps, max(failed + 1, 2 * size, AT_ONCE))
