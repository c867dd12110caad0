"""Finds places and paths for given dstates. The engine with frames uses it.

The input is a label, the number of a dstate, for each node. A node is the steps of a visit that
face one direction. paths_framed.lp finds the fewest places and paths that fit the labels. If none
fit, it finds clashes: minimal sets of nodes whose labels no paths fit. Paths are *separate* if they
are only merged when they must be one.

Reading answers would take most of the time of a long list. So the reader starts from the atoms of
the previous answer. And clingo searches for the next answer while a map is made from this one.
"""

from __future__ import annotations

from collections.abc import Collection, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import clingo

from ssh_abduction.solver.asp.control import Asker
from ssh_abduction.solver.asp.facts import names_lp, path_reader, paths_lp
from ssh_abduction.solver.engines.base import BETTERING, Found, Task, maps_of_labels
from ssh_abduction.solver.engines.doubts import Settled
from ssh_abduction.solver.engines.paths import Paths
from ssh_abduction.solver.engines.refusing import minimal_part
from ssh_abduction.solver.steps.chart import FramedChart
from ssh_abduction.theory.evidence import Equality

# Give clingo up to this many clashes at once. Each of them saves a question, and one control lists
# them all.
CLASHES = 30


@dataclass(frozen=True)
class NodeLabels:
    """The dstates of the nodes of a chart, and a control for their paths; None to make one."""

    chart: FramedChart
    labels: Sequence[int]
    control: clingo.Control | None = None


@dataclass(frozen=True)
class Fitted:
    """A map (`found`), and its labels (`naming`)."""

    found: Found
    naming: NodeLabels


class FramedPaths:
    """Asks clingo for the places and paths that fit labels.

    Attributes:
        forbidden: Sets of equalities of steps. In no map do all equalities of one set hold.
    """

    def __init__(self, task: Task, asker: Asker) -> None:
        self.task = task
        self.forbidden: list[Collection[Equality]] = []
        self._asker = asker

    @property
    def paths(self) -> Paths:
        """The program with the axioms of places and paths for this trace."""
        return Paths(self.task, tuple(self.forbidden))

    def some(self, chart: FramedChart, labels: Sequence[int]) -> Fitted | None:
        """Find a map with these dstates, as `Fitted`; None if no paths fit them."""
        naming = NodeLabels(chart, list(labels), self.control(chart, labels))
        found = next(self.maps(naming, "ignore"), None)
        return Fitted(found, naming) if found else None

    def separate(self, chart: FramedChart, labels: Sequence[int]) -> Found | None:
        """Find a map with these dstates in which places and segments merge only if they must."""
        naming = NodeLabels(chart, list(labels), self.control(chart, labels, single=True))
        return next(self.maps(naming, "ignore"), None)

    def better(self, naming: NodeLabels) -> Iterator[Found]:
        """Yield maps with these dstates, none more expensive than the one before.

        The last map is the best one. There is none if no paths fit. If improving the maps takes
        many conflicts, clingo raises the lower bound instead (`usc`).
        """
        if len(self.task.theory.priorities) == 1:
            yield from self.maps(naming, "ignore")
            return
        proven = yield from self.maps(naming, "opt", BETTERING)
        if not proven:
            control = self.control(naming.chart, naming.labels, ["--opt-strategy=usc"])
            yield from self.maps(replace(naming, control=control), "opt")

    def maps(
        self, naming: NodeLabels, mode: str, conflicts: int = -1
    ) -> Generator[Found, None, bool]:
        """Yield maps with these dstates, as `maps_of_labels` does."""
        control = naming.control or self.control(naming.chart, naming.labels)
        reader = self._reader(naming, control)
        return (
            yield from maps_of_labels(
                self._asker, control, reader, self.task.theory, mode, conflicts
            )
        )

    def settled(self, naming: NodeLabels, mode: str) -> Settled:
        """Prepare questions on what the best maps share, by clingo's opt-mode `mode`."""
        control = naming.control or self.control(naming.chart, naming.labels)
        reader = self._reader(naming, control)
        return Settled(self._asker, control, mode, reader)

    def _reader(self, naming: NodeLabels, control: clingo.Control) -> path_reader.PathReader:
        """Make a reader of the places and paths in answers of a control."""
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
        """Make a control whose answers are the places and paths that fit the labels of some nodes.

        `options` are those of clasp. If `nodes` is None, the paths have to fit the labels of all
        nodes. If `single`, places and segments are merged only if they must be one.
        """
        self._asker.watch.check()
        with self._asker.grounding_timed():
            control = self.paths.settled(chart, labels, options, nodes, single=single)
        self._asker.watch.check()
        return control

    def clashing(self, chart: FramedChart, labels: Sequence[int]) -> list[list[int]]:
        """Find up to `CLASHES` clashes: minimal sets of nodes whose labels no paths fit."""
        control = self.paths.clashing(chart, labels)
        clashes = list(
            self._asker.answers(
                lambda model: sorted(names_lp.read_names(model)), "ignore", CLASHES, control=control
            )
        )
        return clashes or [self._clash(chart, labels)]

    def _clash(self, chart: FramedChart, labels: Sequence[int]) -> list[int]:
        """Find one small clash by trial: leave out nodes while no paths fit the others."""

        def clashes(nodes: list[int]) -> bool:
            control = self.control(chart, labels, nodes=nodes)
            return next(self._asker.answers(lambda _: False, "ignore", 1, control=control), True)

        return minimal_part(clashes, list(range(len(labels))))

    def charted(self, chart: FramedChart, before: FramedChart | None = None) -> FramedChart:
        """Return the chart with pairs of nodes added that cannot be at one place.

        The pairs follow from the trace alone, by the axioms of order and sides. If `before`, the
        chart of fewer steps, is given, only its pairs are added.
        """
        if before is not None:
            return chart.with_elsewhere(before.elsewhere)
        control = self.paths.apart(chart)
        self._asker.watch.check()
        elsewhere = next(self._asker.answers(paths_lp.read_elsewhere, "ignore", 1, control=control))
        return chart.with_elsewhere(elsewhere)
