"""The engine that finds dstates first, then places and paths. It minimises the dstates first.

The engine is for three kinds of theories. In the causal theory there are no places. In the
topological theory, places have one slot, or four slots if they have frames: then their directions
are numbered, and each turn rotates by a known number of right angles. The engine lists all minimal
maps, and proves its lower bound on the number of dstates.

With the axioms of places and paths for each step, clingo only manages a few dozen steps of
exploring. But these axioms are about dstates: the place of a dstate, and the path that it is along.
So labels are found first: the dstate of each step.

*Without frames*, dstates get names (`names.py`). *With frames*, it is enough to know which visits
are at one place, and how their frames are turned (`visit_labels.py`). Both search with the causal
axioms. If no places and paths fit the labels (`fitting.py`), clingo gets the axioms of order and
sides for some paths that the labels contradict (sides_frameless.lp, sides_framed.lp). Mostly a
dozen paths are enough. If no single path is contradicted, clingo gets a rule against a *clash*, a
minimal set of links that no places and paths fit.

*Claim.* Each map of the topological theory is an answer of the search for labels, with the number
of dstates as its cost.
*Proof.* Let the atoms about links and visits hold that are true of the map. Let each other atom of
the sides hold if its comment is true of the map. The rules then follow from the axioms for two or
three dstates: a travel stays on its path and leads further along it, the order is transitive, and a
turn stays at its place. The rules say nothing about the one name of all dstates that have no name
of their own. ∎

So the bounds hold. If places and paths fit some answer of least cost, then all minimal maps are
among the answers of that cost, with the fewest places and paths. To find them, all labels with the
fewest dstates are listed. If there are hundreds, this takes most of the time.

*Why only some paths.* In a half explored world the causal axioms allow fewer dstates than order and
sides do, in too many ways to forbid them one by one. The axioms of order and sides of one path need
many rules. So they are added only for paths that an answer contradicts.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import closing
from itertools import chain, islice

from ssh_abduction.data.groups import numbered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.runtime.limits import Watch
from ssh_abduction.solution.values import Found
from ssh_abduction.solver.asp import facts
from ssh_abduction.solver.asp.control import Asker
from ssh_abduction.solver.sources.exact.engine import AT_ONCE, Task, in_fixed_order
from ssh_abduction.solver.sources.exact.fitting import Fitting
from ssh_abduction.solver.sources.exact.names import NamedLabels
from ssh_abduction.solver.sources.exact.visit_labels import VisitLabels
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.speedups import Speedups

# First try a prefix of this many steps, then a prefix of AT_ONCE steps. For most traces the first
# prefix is enough.
FIRST_PREFIXES = 32


class LabelsFirst:
    """The engine that finds labels (the dstates of steps) first."""

    def __init__(self, task: Task, known: Sequence[int] = ()) -> None:
        """Begin with an empty prefix. `known` has each step's dstate in a small map, or nothing."""
        self.asker = Asker(task.watch)
        self.grows = task.theory.star == "frame"
        self._task = task
        self._labels = (
            VisitLabels(task, self.asker) if self.grows else NamedLabels(task, self.asker, known)
        )
        self._fitting = Fitting(task, self.asker) if task.theory.level == "topological" else None
        self._contradicted = 0  # the size of a prefix whose visits fit no frames

    @property
    def size(self) -> int:
        return self._contradicted or self._labels.size

    @property
    def bound(self) -> int | None:
        return self._labels.bound

    def over(self, task: Task) -> LabelsFirst:
        self._task = self._labels.task = task
        if self._fitting:
            self._fitting.task = task
        self.asker.watch = task.watch
        self.asker.ground_seconds = self.asker.solve_seconds = 0.0
        return self

    def next_size(self, failed: int) -> int:
        steps = len(self._task.trace)
        if self.size < FIRST_PREFIXES:
            return min(steps, max(failed + 1, FIRST_PREFIXES))
        return steps if steps <= AT_ONCE else min(steps, max(failed + 1, 2 * self.size, AT_ONCE))

    def grow(self, size: int) -> None:
        if size == self.size:
            return
        self._contradicted = 0 if self._labels.grow(size) else size
        if self._fitting and not self._contradicted:
            self._fitting.take(self._labels.chart)

    def improving_maps(self, most: tuple[int, ...] = ()) -> Iterator[Found]:
        if self._contradicted:
            return
        if self._fitting is None:
            yield from map(self._causal, self._labels.improving())
            return
        # 1. Find the fewest dstates that any places and paths fit.
        first = self._first_that_fits()
        if first is None:
            return
        labels, best = first
        yield best
        if len(self._task.theory.priorities) == 1:
            return
        # 2. Other labels with the same number of dstates may have fewer paths or places.
        for other in chain([labels], self._all_that_fit(len(set(labels)), besides=labels)):
            for found in self._fitting.improving(other):
                if found.cost < best.cost:
                    best = found
                    yield best

    def _first_that_fits(self) -> tuple[list[int], Found] | None:
        """Find labels with the fewest dstates that have a map, with this map; None if none have."""
        assert self._fitting is not None
        while labels := [*self._labels.improving()][-1:]:
            if found := self._fitting.some(labels[0]):
                return labels[0], found
            self._refuse(labels[0])
        return None

    def maps_of_cost(self, cost: tuple[int, ...], enough: int) -> Iterator[Found]:
        if self._contradicted:
            return
        if self._fitting is None:
            yield from map(self._causal, self._labels.all_of(cost[0], enough))
            return
        # Given the dstates, list the maps with the fewest other counts.
        mode = f"enum,{','.join(map(str, (0, *cost[1:])))}"
        maps = (self._fitting.maps(labels, mode) for labels in self._all_that_fit(cost[0]))
        yield from islice(chain.from_iterable(maps), enough or None)

    def _all_that_fit(self, dstates: int, besides: Sequence[int] = ()) -> Iterator[list[int]]:
        """Yield all labels with this many dstates that places and paths fit, except `besides`.

        If some do not fit, forbid them and ask again. No map is forbidden along with them.
        """
        assert self._fitting is not None
        known = {tuple(numbered(besides))}
        while True:
            refused = None
            with closing(self._labels.all_of(dstates, 0)) as every:
                for labels in every:
                    key = tuple(numbered(labels))
                    if key in known:
                        continue
                    if self._fitting.some(labels) is None:
                        refused = labels
                        break
                    known.add(key)
                    yield labels
            if refused is None:
                return
            self._refuse(refused)

    def _refuse(self, labels: Sequence[int]) -> None:
        """Give clingo rules that exclude these labels, as no places and paths fit them."""
        assert self._fitting is not None
        if self._labels.take_back(labels) and not self._labels.give_sides(
            labels, self._fitting.contrary(labels)
        ):
            self._labels.forbid(labels, self._fitting.clash(labels))

    def forbid(self, equalities: Collection[Equality]) -> bool:
        equalities = in_fixed_order(equalities)
        if self._fitting:
            self._fitting.forbid(equalities)
        self._labels.forbid_together(equalities)
        return True

    def _causal(self, labels: Sequence[int]) -> Found:
        """Make the causal map of labels."""
        return Found.of(facts.causal_map(labels, self._task.trace), self._task.theory)


def maps_with_frames(problem: Problem, watch: Watch, speedups: Speedups) -> Iterator[SSHMap]:
    """Yield ever cheaper maps in which places have frames, for a theory with star=pattern.

    In a frame, the directions at a place are multiples of one angle, such as 90 degrees. With
    star=pattern clingo gets all axioms for each step, and only manages a few dozen steps. With
    frames, a good map of thousands of steps takes seconds. Each map of `Theory.with_frames` is also
    a map of the theory with star=pattern. So if the world has frames, this finds the true map or a
    map that is about as small.
    """
    task = Task.of(problem.changed(theory=problem.theory.with_frames()), watch, speedups)
    engine = LabelsFirst(task)
    engine.grow(len(problem.trace))
    for found in engine.improving_maps():
        yield found.map.without_headings()
