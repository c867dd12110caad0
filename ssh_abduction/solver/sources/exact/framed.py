"""The engine for the topological theory with frames, if the fewest dstates are preferred first.

A place has a frame if its directions are numbered, and each turn rotates by a known number of right
angles. The engine finds the dstates first, then the places and paths. It lists all minimal maps and
proves its lower bound on the number of dstates.

With frames, the dstates hardly depend on places and paths. It is enough to know which visits are at
one place, and how their frames are turned (`steps/chart.py`). visits.lp decides on that
(`visits.py`). It has the causal axioms and the rotations of turns, but not the axioms
about the order of places on a path and about its sides. paths_framed.lp then finds the fewest paths
and places that fit these dstates (`framed_paths.py`).

*Claim.* Every map of the topological theory determines an answer of visits.lp: the one in which the
same visits are at one place. So the fewest dstates of visits.lp are a lower bound. If paths fit
some answer with that number of dstates, then each minimal map is such an answer, with the fewest
paths that fit.

*If no paths fit an answer*, paths_framed.lp is asked for a path that the answer contradicts.
sides_framed.lp then adds the axioms of order and sides for that path. Perhaps no single path is
contradicted, or there are too many visits. Then paths_framed.lp is asked which labels clash. A
clash is a minimal set of nodes whose labels no paths fit. visits.lp gets a rule that forbids it.
Every map of the topological theory satisfies these rules, so the bounds still hold.

*Why only some paths.* In a half explored world the causal axioms allow fewer dstates than order and
sides do, in too many ways to forbid them one by one. The axioms of order and sides of one path need
a rule for each pair of visits that may be at one place. So they are added only for paths that an
answer contradicts.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Iterator, Sequence
from dataclasses import replace
from itertools import chain, islice

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solver.asp.control import Asker
from ssh_abduction.solver.asp.limits import Watch
from ssh_abduction.solver.sources.exact.engine import (
    Settled,
    Task,
    all_accepted,
    listing,
    next_charted_size,
)
from ssh_abduction.solver.sources.exact.framed_paths import Fitted, FramedPaths, NodeLabels
from ssh_abduction.solver.sources.exact.visit_program import FramedSides
from ssh_abduction.solver.sources.exact.visits import VisitLabels
from ssh_abduction.solver.steps.chart import FramedChart
from ssh_abduction.solver.values import Found
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.speedups import Speedups

# If more pairs of visits than this may be at one place, add no axioms of single paths. They take
# about forty rules for each pair.
MANY_PAIRS = 20_000
# Keep at most this many controls for minimal labels until their maps are listed. A control takes
# some megabytes, and making it again takes seconds.
KEPT = 10


class FramedEngine:
    """The engine for the topological theory with frames. It minimises the dstates first."""

    def __init__(self, task: Task) -> None:
        """Begin with an empty prefix: no steps of the trace yet."""
        self.asker = Asker(task.watch)
        self._task = task
        self._sides = FramedSides(task.theory, self.asker)
        self._fitting = FramedPaths(task, self.asker)
        self._visits = VisitLabels(task, self.asker, self._sides)
        self._unframed_size = 0  # the size of a prefix whose visits fit no frames
        self._framed = True  # whether the visits fit their frames
        # The minimal cost, and all labels with maps of that cost.
        self._best: tuple[tuple[int, ...], list[NodeLabels]] | None = None

    @property
    def size(self) -> int:
        return self._visits.size if self._framed else self._unframed_size

    @property
    def bound(self) -> int | None:
        return self._visits.bound

    @property
    def _chart(self) -> FramedChart:
        return self._visits.chart

    def over(self, task: Task) -> FramedEngine:
        self._task = self._fitting.task = self._visits.task = task
        self.asker.watch = task.watch
        self.asker.ground_seconds = self.asker.solve_seconds = 0.0
        return self

    def next_size(self, failed: int) -> int:
        return next_charted_size(self.size, failed, len(self._task.trace))

    def grow(self, size: int) -> None:
        if size != self.size:
            self._best = None
        self._framed = self._visits.grow(size)
        self._unframed_size = size

    def improving_maps(self, most: tuple[int, ...] = ()) -> Iterator[Found]:
        if not self._framed:
            return
        first = self._first_with_paths()
        if first is None:
            return
        best = first.found
        yield best
        # Other labels with the same number of dstates may have fewer paths or places.
        kept: list[NodeLabels] = []
        others = self._all_with_paths(best.cost[0], besides=first.node_labels.labels)
        for other in chain([first.node_labels], others):
            control = other.control or self._fitting.control(other.chart, other.labels)
            node_labels = replace(other, control=control)
            for found in self._fitting.better(node_labels):
                if found.cost < best.cost:
                    best, kept = found, []
                    yield best
            if found.cost == best.cost:
                kept.append(node_labels if len(kept) < KEPT else replace(node_labels, control=None))
        self._best = best.cost, kept

    def _first_with_paths(self) -> Fitted | None:
        """Find a smallest map of the prefix, and its labels; None if the prefix has no map."""
        while (labels := self._visits.fewest()) is not None:
            if fitted := self._fitting.some(self._chart, labels):
                return fitted
            self._refuse(labels)
        return None

    def maps_of_cost(self, cost: tuple[int, ...], enough: int) -> Iterator[Found]:
        if not self._framed:
            return
        mode = listing(cost)
        found = (
            found
            for node_labels in self._labels_of_cost(cost)
            for found in self._fitting.maps(node_labels, mode)
        )
        yield from islice(found, enough or None)

    def labellings(self, cost: tuple[int, ...]) -> Iterator[Settled]:
        """Yield the maps of this cost, grouped by their dstates."""
        if not self._framed:
            return
        mode = listing(cost)
        yield from (self._fitting.settled(name, mode) for name in self._labels_of_cost(cost))

    def _labels_of_cost(self, cost: tuple[int, ...]) -> Iterator[NodeLabels]:
        """Yield the known labels of maps of this cost; if none are known, search for all."""
        if self._best and self._best[0] == cost:
            return iter(self._best[1])
        return self._all_with_paths(cost[0])

    def _all_with_paths(self, dstates: int, besides: Sequence[int] = ()) -> Iterator[NodeLabels]:
        """Yield all labels with this many dstates for which there are paths, except `besides`."""
        known: set[Hashable] = {tuple(besides)}
        fitted: dict[tuple[int, ...], Fitted] = {}

        def fits(labels: list[int]) -> bool:
            if found := self._fitting.some(self._chart, labels):
                fitted[tuple(labels)] = found
            return found is not None

        every = all_accepted(
            lambda: self._visits.all_of(dstates), fits, self._refuse, key=tuple, known=known
        )
        for labels in every:
            yield fitted.pop(tuple(labels)).node_labels

    def _refuse(self, labels: Sequence[int]) -> None:
        """Give clingo rules that exclude these labels (dstates of steps), as no paths fit them."""
        visits, fitting = self._visits, self._fitting
        visits.take_back(labels)
        passed = (
            self._task.speedups.sides
            and len(visits.program.known.fits) <= MANY_PAIRS
            and self._sides.say_of_path(
                *fitting.contrary(self._chart, labels), visits.program.standing(labels)
            )
        )
        if not passed:
            visits.forbid(labels, fitting.clashing(self._chart, labels))

    def forbid(self, equalities: Collection[Equality]) -> bool:
        """Exclude all maps in which all of these equalities of steps hold, from now on."""
        self._best = None
        self._fitting.forbidden.append(equalities)
        node_of = self._chart.node_of
        nodes = [(node_of[one.first], node_of[one.second], one.of) for one in equalities]
        self._visits.forbid_together(
            [(a, b) for a, b, of in nodes if of == "dstate"],
            [(a, b) for a, b, of in nodes if of == "place"],
        )
        return True


def maps_with_frames(problem: Problem, watch: Watch, speedups: Speedups) -> Iterator[SSHMap]:
    """Yield ever cheaper maps in which places have frames, for a theory with star=pattern.

    In a frame, the directions at a place are multiples of one angle, such as 90 degrees. With
    star=pattern clingo gets all axioms for each step, and only manages a few dozen steps. With
    frames, a good map of thousands of steps takes seconds. Each map of `Theory.with_frames` is also
    a map of the theory with star=pattern. So if the world has frames, this finds the true map or a
    map that is about as small.
    """
    task = Task.of(problem.changed(theory=problem.theory.with_frames()), watch, speedups)
    engine = FramedEngine(task)
    engine.grow(len(problem.trace))
    for found in engine.improving_maps():
        yield found.map.without_headings()
