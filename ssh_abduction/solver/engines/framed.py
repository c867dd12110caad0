"""The engine for the topological theory where places have frames and fewest dstates come first.

It finds dstates first, then places and paths. It finds all minimal maps, and its bound on the
dstates is proven.

Frames almost determine the dstates without places and paths. A turn rotates by known quarters, so
whole visits are the same or not (`steps/chart.py`). visits.lp decides which are
(`engines/visit_labels.py`). It has the causal axioms and the rotations of turns, but not the order
of places on a path, or its sides. For the dstates found, paths_framed.lp finds the fewest paths and
places (`engines/framed_paths.py`).

*Claim.* Cut to which visits are at one place, a map of the topological theory is an answer of
visits.lp. So the fewest dstates of visits.lp are a lower bound. If some answer of that cost has
paths, all minimal maps are among the answers of that cost with their fewest paths.
*If no answer has paths*, paths_framed.lp is asked which path shows it. sides_framed.lp then adds
the axioms of order and sides for that path. If no single path shows it, or there are too many
visits, paths_framed.lp is asked which labels clash: minimal sets of nodes whose labels no paths
fit. visits.lp gets a rule that forbids them. Every map of the topological theory keeps these
rules, so bounds still hold.

*Beside.* If that takes long, a map is guessed. Another thread proves from the guess outwards how
many dstates the causal axioms need (`engines/framed_guess.py`). The names of that proof then list
all labels with that number of dstates. Some of them fit no frame or have no paths, which
paths_framed.lp detects. But each map of the topological theory is among them.

*Which path.* In a half explored world the causal axioms allow fewer dstates than order and sides
do, in too many ways to forbid them one by one. The axioms of order and sides of a path take a rule
for each two visits that may be one. So they are added only for paths that an answer contradicts.
"""

from __future__ import annotations

from collections.abc import Collection, Generator, Hashable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, islice

from ssh_abduction.solver.asp.control import Asker
from ssh_abduction.solver.engines.base import Found, Task, next_charted_size
from ssh_abduction.solver.engines.doubts import Settled
from ssh_abduction.solver.engines.framed_guess import GuessBeside, SoonMaps
from ssh_abduction.solver.engines.framed_paths import Fitted, FramedPaths, Naming
from ssh_abduction.solver.engines.refusing import all_accepted, first_accepted_of
from ssh_abduction.solver.engines.sides import FramedSides
from ssh_abduction.solver.engines.visit_labels import OPEN, VisitLabels
from ssh_abduction.solver.guesses.merging import kept
from ssh_abduction.solver.steps.chart import Chart, FramedChart
from ssh_abduction.theory.evidence import Equality

# With more pairs of visits that may be one, add no axioms of single paths: they take some forty
# rules for each pair.
MANY_PAIRS = 20_000
# Keep this many controls of minimal labels until their maps are listed. Each takes some megabytes,
# and seconds to make again.
KEPT = 10
# After this many seconds without the fewest dstates, also look for a map near a guess. Most traces
# are solved by then.
SOON = 3.0


class FramedEngine:
    """The topological theory with frames, fewest dstates first."""

    lists_least = True
    goes_on = True

    def __init__(
        self,
        task: Task,
        around: Mapping[int, Sequence[int]] | None = None,
        soon: float | None = None,
    ) -> None:
        """An engine for no steps yet.

        Args:
            task: The problem, the limits and the speed-ups.
            around: As in `Chart.framed`, if steps have no stars.
            soon: Seconds without the fewest dstates after which to guess, at most; SOON by default.
        """
        self.asker = Asker(task.watch)
        self.intact = True
        self.paths = len(task.trace)  # names for paths are never short
        self._task, self._around = task, around
        self._soon = SOON if soon is None else soon
        self._sides = FramedSides(task.theory, self.asker)
        self._fitting = FramedPaths(task, self.asker)
        self._visits = VisitLabels(task, self.asker, self._charted, self._sides)
        self._unframed_size = 0  # how many steps there are if they fit no frames
        self._framed = True  # whether the visits fit their frames
        # The minimal cost, and all namings that have it.
        self._best: tuple[tuple[int, ...], list[Naming]] | None = None
        self._beside, self._soon_maps = self._helpers()

    def _helpers(self) -> tuple[GuessBeside, SoonMaps]:
        """A guess and the maps near it, for a new prefix."""
        beside = GuessBeside(self._fitting, self._visits, self.asker)
        soon_maps = SoonMaps(
            self._fitting,
            self._visits,
            beside,
            self.asker,
            soon=self._soon,
            refuse=self._refuse,
        )
        return beside, soon_maps

    @property
    def size(self) -> int:
        """How many steps the engine was given."""
        return self._visits.size if self._framed else self._unframed_size

    @property
    def bound(self) -> int | None:
        """A lower bound on the dstates of the prefix."""
        return self._visits.bound

    @property
    def _chart(self) -> FramedChart:
        return self._visits.chart

    def with_paths(self, paths: int) -> FramedEngine:
        """Another engine; names for paths are never short here."""
        return FramedEngine(self._task, self._around, self._soon)

    def over(self, task: Task) -> FramedEngine:
        """This engine, which goes on with the grown trace."""
        self._task = self._fitting.task = task
        self.asker.watch = task.watch
        self._visits.work_on(task)
        self.asker.ground_seconds = self.asker.solve_seconds = 0.0
        return self

    def next_size(self, failed: int) -> int:
        """The size to grow to when the maps of the prefix do not explain step `failed`."""
        return next_charted_size(self.size, failed, len(self._task.trace))

    @property
    def size_to_go_on(self) -> int:
        """The size to grow to first when the trace has grown."""
        return self.next_size(self.size)

    def grow(self, size: int) -> None:
        """Let the prefix have this many steps."""
        if size != self.size:
            self._beside.end()
            self._best = None
            self._fitting.forget_time()
            self._beside, self._soon_maps = self._helpers()
        self._framed = self._visits.grow(size)
        self._unframed_size = size

    def improving_maps(self, most: tuple[int, ...] = ()) -> Iterator[Found]:
        """Maps of the prefix, each better than the one before; the last one is minimal."""
        if not self._framed:
            return
        first = yield from self._first_with_paths()
        self._beside.end()
        if first is None:
            return
        best = first.found
        yield best
        # Other labels with as few dstates may have better paths.
        namings: list[Naming] = []
        others = self._all_with_paths(best.cost[0], besides=first.naming.labels)
        for other in chain([first.naming], others):
            control = other.control or self._fitting.control(other.chart, other.labels)
            naming = replace(other, control=control)
            for found in self._fitting.better(naming):
                if found.cost < best.cost:
                    best, namings = found, []
                    yield best
            if found.cost == best.cost:
                namings.append(naming if len(namings) < KEPT else replace(naming, control=None))
        self._best = best.cost, namings

    def _first_with_paths(self) -> Generator[Found, None, Fitted | None]:
        """The first labels with the fewest dstates that have paths.

        If they take long, yield maps that are found soon.
        """
        fitted: list[Fitted] = []

        def ask() -> Generator[Found, None, list[int] | None]:
            soon = self._soon_maps
            while (labels := self._visits.fewest(soon.should_interrupt)) is OPEN:
                yield from soon.found()
            return labels

        def why_not(labels: list[int]) -> list[int] | None:
            found = self._fitting.some(self._chart, labels)
            fitted.extend([found] if found else [])
            return None if found else labels

        yield from first_accepted_of(ask, why_not, self._refuse)
        return fitted[0] if fitted else None

    def map_of_guess(self) -> Found | None:
        """A map of the whole trace made of a guess, without a search.

        None if none is found soon.
        """
        chart = self._charted(len(self._task.trace), None)
        if chart is None:
            return None
        labels = self._fitting.paths.guessed_labels(chart, self.asker.watch)
        return self._fitting.separate(chart, labels)

    def map_mended_from(self, known: Sequence[int]) -> Found | None:
        """A map of the whole trace whose first steps keep known dstates, as far as can be.

        All other steps get new dstates. None if no paths fit.

        Args:
            known: The dstates of the first steps.
        """
        chart = Chart.framed(self._task.trace, self._task.log, around=self._around)
        if chart is None:
            return None
        guess = [-1] * len(chart.seen)
        for node, label in zip(chart.node_of, known, strict=False):
            guess[node] = label
        return self._fitting.separate(chart, kept(chart.apart(), chart.links, guess))

    def settle(self) -> None:
        """End the search in the other thread."""
        self._beside.end()

    def maps_of_cost(self, cost: tuple[int, ...], enough: int) -> Iterator[Found]:
        """All maps of the prefix that cost this; or `enough` of them, unless that is 0."""
        if not self._framed:
            return
        mode = _listing(cost)
        found = (
            found
            for naming in self._namings_of_cost(cost)
            for found in self._fitting.maps(naming, mode)
        )
        yield from islice(found, enough or None)

    def labellings(self, cost: tuple[int, ...]) -> Iterator[Settled]:
        """All labels of maps that cost this, each once."""
        if not self._framed:
            return
        mode = _listing(cost)
        for naming in self._namings_of_cost(cost):
            settled = self._fitting.settled(naming, mode)
            if settled.has_map():
                yield settled

    def _namings_of_cost(self, cost: tuple[int, ...]) -> Iterator[Naming]:
        if self._best and self._best[0] == cost:
            return iter(self._best[1])
        return self._all_with_paths(cost[0])

    def _all_with_paths(self, dstates: int, besides: Sequence[int] = ()) -> Iterator[Naming]:
        """All labels with this many dstates that have paths, each once, except `besides`."""
        known: set[Hashable] = {tuple(besides)}
        if search := self._beside.proved(dstates):
            # This search does not learn why labels have no paths; it lists each anyway.
            for labels in search.listed(self.asker.watch):
                if tuple(labels) not in known:
                    found = self._fitting.some(self._chart, labels)
                    if found is not None:
                        yield found.naming
                known.add(tuple(labels))
            return
        fitted: dict[tuple[int, ...], Fitted] = {}

        def why_not(labels: list[int]) -> list[int] | None:
            if (found := self._fitting.some(self._chart, labels)) is None:
                return labels
            fitted[tuple(labels)] = found
            return None

        every = all_accepted(
            lambda: self._visits.all_of(dstates), why_not, self._refuse, key=tuple, known=known
        )
        for labels in every:
            yield fitted.pop(tuple(labels)).naming

    def _refuse(self, labels: Sequence[int]) -> None:
        """Tell clingo why there are no paths for these labels."""
        visits, fitting = self._visits, self._fitting
        visits.take_back(labels)
        told = (
            self._task.speedups.sides
            and len(visits.program.fits) <= MANY_PAIRS
            and self._sides.say_of_path(
                fitting.paths, self._chart, labels, visits.program.standing(labels)
            )
        )
        if not told:
            visits.forbid(labels, fitting.clashing(self._chart, labels))

    def forbid(self, equalities: Collection[Equality]) -> bool:
        """From now on no map has all of these equalities of steps."""
        self._beside.forget()
        self._best = None
        self._fitting.forbidden.append(equalities)
        node_of = self._chart.node_of
        nodes = [(node_of[one.first], node_of[one.second], one.of) for one in equalities]
        self._visits.forbid_together(
            [(a, b) for a, b, of in nodes if of == "dstate"],
            [(a, b) for a, b, of in nodes if of == "place"],
        )
        return True

    def _charted(self, size: int, before: FramedChart | None) -> FramedChart | None:
        """The nodes of the first steps, and which of them are at different places.

        This uses only what the trace alone implies by order and sides. None if steps fit no frame.

        Args:
            size: How many steps.
            before: The chart of fewer steps, if there is one.
        """
        chart = Chart.framed(self._task.trace, self._task.log, size, self._around)
        return None if chart is None else self._fitting.charted(chart, before)


def _listing(cost: tuple[int, ...]) -> str:
    """Clingo's opt-mode for listing maps of this cost, whose dstates are known."""
    return f"enum,{','.join(map(str, (0, *cost[1:])))}"
