"""The places and paths of given dstates, for the engine with frames, under its limits.

paths_framed.lp finds the fewest places and paths that fit the labels of nodes, or, if there are
none, which labels clash. A long list would spend most time on reading answers. So the reader checks
the atoms of the last answer first, and clingo searches for the next answer while a map is made
from this one.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import clingo

from ssh_abduction.solver.asp.control import Asker, give_threads, mapped
from ssh_abduction.solver.asp.facts import names_lp, path_reader, paths_lp
from ssh_abduction.solver.engines.base import Found, Task
from ssh_abduction.solver.engines.doubts import Settled
from ssh_abduction.solver.engines.paths import Paths
from ssh_abduction.solver.engines.refusing import smaller
from ssh_abduction.solver.steps.chart import FramedChart
from ssh_abduction.theory.evidence import Equality

# Give clingo this many clashes at once: each saves a question, and one control of paths lists them
# all.
CLASHES = 30
# Try labels with more dstates than this with separate paths first, as grounding all ways to merge
# paths takes long.
MANY_DSTATES = 50
# All ways to merge paths take this many times as long to ground as separate paths, about, for each
# dstate.
ALL_PATHS = 0.1
# Clasp prepares to solve for this many times as long as grounding took, and cannot be stopped.
PREPARED = 3.5
# After this many conflicts, stop improving paths one by one; raise the bound from below instead.
BETTERING = 20_000


@dataclass(frozen=True)
class Naming:
    """Labels whose paths are asked for.

    Attributes:
        chart: The nodes.
        labels: The dstate of each node.
        control: It has the paths that fit the labels; None to make a new one.
    """

    chart: FramedChart
    labels: Sequence[int]
    control: clingo.Control | None = None


@dataclass(frozen=True)
class Fitted:
    """Labels that have paths, and a map that has these labels."""

    found: Found
    naming: Naming


class FramedPaths:
    """Questions about the places and paths of labels.

    Attributes:
        task: What the engine works on.
        forbidden: Sets of equalities of steps that contradict evidence together.
    """

    def __init__(self, task: Task, asker: Asker) -> None:
        self.task = task
        self.forbidden: list[Collection[Equality]] = []
        self._asker = asker
        self._seconds = 0.0  # what the last control for paths took

    @property
    def paths(self) -> Paths:
        """The axioms of places and paths for this trace."""
        return Paths(
            self.task.trace,
            self.task.theory,
            pinned=self.task.speedups.clique,
            check=self._asker.watch.check,
            forbidden=tuple(self.forbidden),
        )

    @property
    def preparing(self) -> float:
        """Seconds, about, until clingo can be stopped when it is asked for all paths."""
        return PREPARED * self._seconds

    def forget_time(self) -> None:
        """Forget grounding times: the next labels are of another prefix."""
        self._seconds = 0.0

    def some(self, chart: FramedChart, labels: Sequence[int]) -> Fitted | None:
        """A map with these dstates, if any paths fit them."""
        return self.found_soon(chart, labels) or self.any(chart, labels)

    def found_soon(self, chart: FramedChart, labels: Sequence[int]) -> Fitted | None:
        """A map with separate paths, if there are many dstates and there is such a map."""
        found = self.separate(chart, labels) if len(set(labels)) > MANY_DSTATES else None
        return Fitted(found, Naming(chart, list(labels))) if found else None

    def any(self, chart: FramedChart, labels: Sequence[int]) -> Fitted | None:
        """A map with these dstates, if any paths fit them, and a control for all of them."""
        naming = Naming(chart, list(labels), self.control(chart, labels))
        found = next(self.maps(naming, "ignore"), None)
        return Fitted(found, naming) if found else None

    def separate(self, chart: FramedChart, labels: Sequence[int]) -> Found | None:
        """A map with these dstates and separate paths, if there is one.

        No two places or segments are merged unless they have to be.
        """
        naming = Naming(chart, list(labels), self.control(chart, labels, single=True))
        return next(self.maps(naming, "ignore"), None)

    def better(self, naming: Naming) -> Iterator[Found]:
        """Maps with these dstates, each as good as the one before or better, the last one best.

        There are none if no paths fit. If improving maps does not end soon, the bound is raised
        from below instead.
        """
        if len(self.task.theory.priorities) == 1:
            yield from self.maps(naming, "ignore")
            return
        proven = yield from self.maps(naming, "opt", BETTERING)
        if not proven:
            control = self.control(naming.chart, naming.labels, ["--opt-strategy=usc"])
            yield from self.maps(replace(naming, control=control), "opt")

    def maps(
        self, naming: Naming, mode: str, conflicts: int = -1, *, beside: bool = False
    ) -> Generator[Found, None, bool]:
        """Maps with these dstates.

        Args:
            naming: The dstates.
            mode: Clingo's opt-mode.
            conflicts: The limit; -1 for none.
            beside: Whether another search runs beside this one.

        Returns:
            Whether clingo ended before the limit of conflicts.
        """
        control = naming.control or self.control(naming.chart, naming.labels)
        # Two threads keep all that they list, so they only improve maps.
        many = len(set(naming.labels)) > MANY_DSTATES
        two = mode == "opt" and many and not beside and self.task.has_processors
        give_threads(control, two=two)
        reader = self._reader(naming, control)
        answers = self._asker.answers(
            reader.read,
            mode,
            int(mode == "ignore"),
            control=control,
            conflicts=conflicts,
            ahead=True,
        )
        theory = self.task.theory
        return (yield from mapped(lambda answer: Found.of(reader.map_of(answer), theory), answers))

    def settled(self, naming: Naming, mode: str) -> Settled:
        """The best maps with these dstates, for questions about what they share."""
        control = naming.control or self.control(naming.chart, naming.labels)
        reader = self._reader(naming, control)
        return Settled(self._asker, control, mode, reader, reader.map_of)

    def _reader(self, naming: Naming, control: clingo.Control) -> path_reader.PathReader:
        return path_reader.PathReader(
            control, self.task.trace, self.task.theory, naming.chart, naming.labels
        )

    def control(
        self,
        chart: FramedChart,
        labels: Sequence[int],
        options: Sequence[str] = (),
        nodes: Iterable[int] | None = None,
        *,
        single: bool = False,
    ) -> clingo.Control:
        """A control for the paths that fit labels.

        Args:
            chart: The nodes.
            labels: The dstate of each node.
            options: Of clasp.
            nodes: The nodes whose labels have to fit; all of them by default.
            single: Ask only for separate paths, and merge none of them.
        """
        self._asker.watch.check(0.0 if single else self.preparing)
        # Count the time of this thread, as the other one may make it wait.
        worked = time.thread_time()
        with self._asker.grounding_timed():
            control = self.paths.settled(chart, labels, options, nodes, single=single)
        self._asker.watch.check()
        seconds = time.thread_time() - worked
        if single:  # guess what all paths take, unless that is known
            seconds = self._seconds or ALL_PATHS * len(set(labels)) * seconds
        self._seconds = seconds
        return control

    def clashing(self, chart: FramedChart, labels: Sequence[int]) -> list[list[int]]:
        """Minimal conflicting sets of nodes: no paths fit the labels of any of these sets.

        At most CLASHES of them.
        """
        control = self.paths.clashing(chart, labels)
        clashes = list(
            self._asker.answers(
                lambda model: sorted(names_lp.read_names(model)), "ignore", CLASHES, control=control
            )
        )
        return clashes or [self._clash(chart, labels)]

    def _clash(self, chart: FramedChart, labels: Sequence[int]) -> list[int]:
        """One conflicting set, if only a choice of paths shows it."""

        def clashing(nodes: list[int]) -> list[int] | None:
            control = self.control(chart, labels, nodes=nodes)
            return next(self._asker.answers(lambda _: None, "ignore", 1, control=control), nodes)

        return smaller(list(range(len(labels))), clashing)

    def charted(self, chart: FramedChart, before: FramedChart | None = None) -> FramedChart:
        """The chart, with the nodes that the trace alone shows to be at different places.

        Args:
            chart: The nodes.
            before: The chart of fewer steps. It already has the pairs of its nodes at different
                places.
        """
        if before is not None:
            return chart.with_elsewhere(before.elsewhere)
        nodes = range(len(chart.seen))
        control = self.paths.telling(chart, nodes, nodes)
        self._asker.watch.check()
        _, elsewhere, _ = next(
            self._asker.answers(paths_lp.read_told, "ignore", 1, control=control)
        )
        return chart.with_elsewhere(elsewhere)
