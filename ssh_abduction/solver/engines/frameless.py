"""The engine for the topological theory without frames where fewest dstates come first.

It serves traces with some known map. It finds dstates first, then places and paths. It finds all
minimal maps, and its bound on the dstates is proven.

The axioms of places and paths for each step are too much for clingo after some dozen steps of
exploring. But they are about dstates: the place that a dstate is at, and the path that it is along.
So the dstates have names, as in the causal theory (`engines/naming.py`). sides_frameless.lp limits
by order and sides where actions may lead (`engines/frameless_paths.py`). Its size depends
on the number of dstates, not of steps.

*Claim.* Each map of the topological theory is an answer of names.lp and sides_frameless.lp, at the
cost that it has in the causal theory.
*Proof.* Let `goes` hold of the links of the map, and of no others; let each atom of
sides_frameless.lp hold if what its comment says is so in the map. Then its rules are what the
axioms say of two or three dstates: a travel keeps the path, and leads on along it, as the order is
transitive; a turn keeps the place. The rest (`engines/naming.py`) is no dstate of theirs. ∎

So the bounds hold. If some answer of that cost has places and paths, all minimal maps are among the
answers of that cost with the fewest of these. To find them, all labels with the fewest dstates are
listed. If there are hundreds, this takes most of the time.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from itertools import chain, islice

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solver.asp.control import Asker
from ssh_abduction.solver.engines.base import Found, Task, next_charted_size
from ssh_abduction.solver.engines.doubts import Settled
from ssh_abduction.solver.engines.frameless_paths import PARTS, PlacesAndPaths
from ssh_abduction.solver.engines.refusing import all_accepted
from ssh_abduction.solver.steps.chart import numbered
from ssh_abduction.theory.evidence import Equality

# List about this many maps whose places differ first: they are remembered while the others are
# listed.
SOONER = 1000


class FramelessEngine:
    """The topological theory without frames, fewest dstates first, for a trace that has a map."""

    lists_least = True
    goes_on = False  # no map of the longer trace is known

    def __init__(self, task: Task, known: Sequence[int] = ()) -> None:
        """An engine for no steps yet.

        Args:
            task: The problem, the limits and the speed-ups.
            known: The labels of all steps of a map with few dstates, if one is known.
        """
        self.asker = Asker(task.watch)
        self.intact = True
        self.paths = len(task.trace)  # names for paths are never short
        self._task = task
        self._given_map = known
        self._fitting = PlacesAndPaths(task, self.asker, known)
        self._named = self._fitting.named
        # The minimal cost, and all labels with this cost.
        self._best: tuple[tuple[int, ...], list[list[int]]] | None = None

    @property
    def size(self) -> int:
        return self._named.size

    @property
    def bound(self) -> int | None:
        return self._named.bound

    def with_paths(self, paths: int) -> FramelessEngine:
        return FramelessEngine(self._task, self._given_map)

    def over(self, task: Task) -> FramelessEngine:
        return FramelessEngine(task)

    def next_size(self, failed: int) -> int:
        return next_charted_size(self.size, failed, len(self._task.trace))

    @property
    def size_to_go_on(self) -> int:
        return self.next_size(self.size)

    def grow(self, size: int) -> None:
        if size != self.size:
            self._best = None
            self._fitting.forget()
            self._named.grow(size)

    def improving_maps(self, most: tuple[int, ...] = ()) -> Iterator[Found]:
        *_, fewest = self._named.improving()
        if len(self._task.theory.priorities) == 1:
            yield from self._fitting.maps(fewest, "ignore")
            return
        best: Found | None = None
        as_good: list[list[int]] = []
        for labels in chain([fewest], self._all_that_fit(len(set(fewest)), besides=fewest)):
            for found in self._fitting.improving_maps(labels):
                if best is None or found.cost < best.cost:
                    best, as_good = found, []
                    yield best
            if best is not None and found.cost == best.cost:
                as_good.append(labels)
        assert best is not None
        self._best = best.cost, as_good

    def maps_of_cost(self, cost: tuple[int, ...], enough: int) -> Iterator[Found]:
        every = (
            self._best[1] if self._best and self._best[0] == cost else self._all_that_fit(cost[0])
        )
        mode = f"enum,{','.join(map(str, (0, *cost[1:])))}"
        yield from islice(self._listed(every, mode), enough or None)

    def _listed(self, every: Iterable[list[int]], mode: str) -> Iterator[Found]:
        """The maps with these labels.

        If displacements are used, maps whose places differ come first, as the fit depends only on
        dstates and places.
        """
        left, sooner, first = iter(every), list[list[int]](), set[SSHMap]()
        while (
            self._task.theory.displacement == "use"
            and len(first) < SOONER
            and (labels := next(left, None))
        ):
            sooner.append(labels)
            for found in self._fitting.maps(labels, mode, parts=PARTS):
                first.add(found.map)
                yield found
        yield from (
            found
            for labels in chain(sooner, left)
            for found in self._fitting.maps(labels, mode)
            if found.map not in first
        )

    def labellings(self, cost: tuple[int, ...]) -> Iterator[Settled]:
        mode = f"enum,{','.join(map(str, (0, *cost[1:])))}"
        for labels in (
            self._best[1] if self._best and self._best[0] == cost else self._all_that_fit(cost[0])
        ):
            settled = self._fitting.settled(labels, mode)
            if settled.has_map():
                yield settled

    def _all_that_fit(self, dstates: int, besides: Sequence[int] = ()) -> Iterator[list[int]]:
        """All labels with this many dstates that fit, each once, except `besides`."""
        return all_accepted(
            ask=lambda: self._named.all_of(dstates, 0),
            refuse=self._fitting.why_not,
            forbid=self._fitting.forbid,
            key=lambda labels: tuple(numbered(labels)),
            known={tuple(numbered(besides))},
        )

    def forbid(self, equalities: Collection[Equality]) -> bool:
        self._fitting.forbid_together(equalities)
        # One dstate is at one place, so dstates that are one make all of these equalities hold.
        self._named.forbid_together([(one.first, one.second) for one in equalities])
        if self._best:  # maps of that cost that are left have some of these labels
            self._best = (
                self._best[0],
                [labels for labels in self._best[1] if self._named.is_allowed(labels)],
            )
        return True

    def settle(self) -> None:
        self._named.settle()
