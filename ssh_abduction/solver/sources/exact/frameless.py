"""The engine for the topological theory without frames, if fewest dstates are preferred first.

This engine is for traces for which some map is known. It finds the dstates first, then the places
and paths. It lists all minimal maps, and proves its lower bound on the number of dstates.

With the axioms of places and paths for each step, clingo only manages a few dozen steps of
exploring. But these axioms are about dstates: the place of a dstate, and the path that it is along.
So the dstates get names, as in the causal theory (`names.py`). sides_frameless.lp
has the axioms of order and sides, which exclude some links between dstates
(`frameless_paths.py`). The number of its rules depends on the number of dstates, not on the
number of steps.

*Claim.* Each map of the topological theory is an answer of names.lp and sides_frameless.lp, with
the number of dstates as its cost.
*Proof.* Let `goes` hold for the links of the map only. Let each other atom of sides_frameless.lp
hold if its comment is true of the map. The rules of sides_frameless.lp then follow from the axioms
for two or three dstates: a travel stays on its path and leads further along it, the order is
transitive, and a turn stays at its place. The rules say nothing about the rest, the one name of all
dstates that have no name of their own (`names.py`). ∎

So the bounds hold. If places and paths fit some answer of least cost, then all minimal maps are
among the answers of that cost, with the fewest places and paths. To find them, all labels with the
fewest dstates are listed. If there are hundreds, this takes most of the time.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from itertools import chain, islice

from ssh_abduction.data.groups import numbered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solver.asp.control import Asker
from ssh_abduction.solver.sources.exact.engine import (
    Settled,
    Task,
    all_accepted,
    listing,
    next_charted_size,
)
from ssh_abduction.solver.sources.exact.frameless_paths import PARTS, PlacesAndPaths
from ssh_abduction.solver.values import Found
from ssh_abduction.theory.evidence import Equality

# First list about this many maps whose dstates or places differ. They are kept in memory until all
# other maps are listed.
SOONER = 1000


class FramelessEngine:
    """The engine for theories without frames, if a map of the trace is known already."""

    def __init__(self, task: Task, known: Sequence[int] = ()) -> None:
        """Begin with an empty prefix. `known` has each step's dstate in a small map, or nothing."""
        self.asker = Asker(task.watch)
        self._task = task
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

    def next_size(self, failed: int) -> int:
        return next_charted_size(self.size, failed, len(self._task.trace))

    def grow(self, size: int) -> None:
        if size != self.size:
            self._best = None
            self._fitting.forget()
            self._named.grow(size)

    def improving_maps(self, most: tuple[int, ...] = ()) -> Iterator[Found]:
        improving = [*self._named.improving()]
        if not improving:  # the maps excluded so far leave none
            return
        fewest = improving[-1]
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
        yield from islice(self._listed(self._labels_of(cost), listing(cost)), enough or None)

    def _listed(self, every: Iterable[list[int]], mode: str) -> Iterator[Found]:
        """Yield the maps with each of these labels.

        With displacements, first yield one map for each choice of places, for a few labels.
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
        mode = listing(cost)
        yield from (self._fitting.settled(labels, mode) for labels in self._labels_of(cost))

    def _labels_of(self, cost: tuple[int, ...]) -> Iterable[list[int]]:
        """Return the known labels of maps of this cost; if none are known, search for all."""
        if self._best and self._best[0] == cost:
            return self._best[1]
        return self._all_that_fit(cost[0])

    def _all_that_fit(self, dstates: int, besides: Sequence[int] = ()) -> Iterator[list[int]]:
        """Yield all labels with this many dstates, except `besides`, that places and paths fit."""
        return all_accepted(
            ask=lambda: self._named.all_of(dstates, 0),
            fits=self._fitting.fits,
            forbid=self._fitting.forbid,
            key=lambda labels: tuple(numbered(labels)),
            known={tuple(numbered(besides))},
        )

    def forbid(self, equalities: Collection[Equality]) -> bool:
        self._fitting.forbid_together(equalities)
        # Steps at one dstate are also at one place. So labels that put each of these pairs of steps
        # at one dstate are forbidden, too.
        self._named.forbid_together([(one.first, one.second) for one in equalities])
        if self._best:  # the remaining maps of that cost have some of these labels
            self._best = (
                self._best[0],
                [labels for labels in self._best[1] if self._named.program.is_allowed(labels)],
            )
        return True
