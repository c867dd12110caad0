"""The protocol of all engines, and the values that go in (`Task`) and come out (`Found`).

A *doubt* is something on which all known maps agree, but perhaps not all maps. Two steps may share
a dstate, place, path or course (a path in one direction) in all known maps, but not in some unknown
map, or the other way round. Clingo is asked for an answer in which at least one doubt of a set
holds.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Generator, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Protocol, TypeAlias, TypeVar, runtime_checkable

import clingo

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.solver.asp import facts
from ssh_abduction.solver.asp.control import Asker, Control, mapped
from ssh_abduction.solver.asp.limits import Watch
from ssh_abduction.solver.solution.sharing import Sort
from ssh_abduction.solver.sources.exact.path_reader import PathReader
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.solver.values import Found
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


@runtime_checkable
class LabellingEngine(Protocol):
    """The protocol of an engine that finds dstates first. It lists maps with the fewest dstates.

    Attributes:
        lists_labels: Whether `labellings` lists maps in its theory.
    """

    lists_labels: bool

    def labellings(self, cost: tuple[int, ...]) -> Iterator[Settled]:
        """Yield the maps of this cost, grouped by their labelling.

        A labelling is the dstate of each step of the prefix. Each item stands for the best maps
        with one labelling.
        """
        ...


def in_fixed_order(equalities: Iterable[Equality]) -> list[Equality]:
    """Sort equalities, as the order of a set depends on the hashes of texts."""
    return sorted(equalities, key=lambda one: (one.first, one.second, one.of, one.holds))


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


Answer = TypeVar("Answer")
# A sort of thing (such as "places"), two steps or dstates, and a claim: they share a thing of this
# sort (True), or they do not (False).
Doubt: TypeAlias = tuple[Sort, int, int, bool]


class Doubts:
    """Asks one control of clingo whether a map contradicts what all known maps share."""

    def __init__(
        self, asker: Asker, control: Control, condition: Callable[[Sort, int, int], str | None]
    ) -> None:
        """Begin without any doubt.

        `condition` takes a sort (such as dstate or place) and two steps or dstates. It returns the
        body of a rule that is true if both are at one thing of this sort; None if they never are.
        """
        self._asker, self._control, self._condition = asker, control, condition
        # The number of each pair of things that clingo has, and the number of questions so far.
        self._number_of: dict[tuple[Sort, int, int], int] = {}
        self._questions = 0

    def answer(
        self, doubts: Collection[Doubt], read: Callable[[clingo.Model], Answer], mode: str
    ) -> Answer | None:
        """Return what `read` makes of an answer that confirms a doubt; None if none does."""
        if not doubts:
            return None
        rules: list[str] = []
        for sort, i, j, _ in doubts:
            if (sort, i, j) not in self._number_of:
                number = self._number_of[sort, i, j] = len(self._number_of)
                rules.append(facts.one_in_doubt(number, self._condition(sort, i, j)))
        numbers = [(self._number_of[sort, i, j], one) for sort, i, j, one in doubts]
        rules.append(facts.some_doubt(self._questions, numbers))
        asked = facts.asked(self._questions)
        self._questions += 1
        with self._asker.grounding_timed():
            self._control.tell("\n".join(rules))
        self._control.assign_external(asked, True)
        try:
            with closing(self._asker.answers(read, mode, 1, control=self._control)) as answers:
                return next(answers, None)
        finally:
            self._control.release_external(asked)


class Settled:
    """Answers questions about the best maps with given dstates, after the dstates are found."""

    def __init__(self, asker: Asker, reader: PathReader, mode: str) -> None:
        """Prepare the questions for a reader of places and paths. `mode` is clingo's opt-mode."""
        self._asker, self._reader, self._mode = asker, reader, mode
        self._doubts = Doubts(asker, reader.control, reader.condition)
        self._any: SSHMap | None = None

    def any_map(self) -> SSHMap | None:
        """Return some map, always the same one; None if there is none."""
        if self._any is None:
            reader = self._reader
            answers = self._asker.answers(reader.read, self._mode, 1, control=reader.control)
            with closing(answers):
                self._any = next(map(reader.map_of, answers), None)
        return self._any

    def map_with(self, doubts: Collection[Doubt]) -> SSHMap | None:
        """Find a map in which at least one of these doubts about dstates holds; else None."""
        answer = self._doubts.answer(doubts, self._reader.read, self._mode)
        return None if answer is None else self._reader.map_of(answer)
