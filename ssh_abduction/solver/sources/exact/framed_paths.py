"""Finds places and paths for given dstates. The engine with frames uses it.

The input is a label, the number of a dstate, for each node. A node is the steps of a visit that
face one direction. paths_framed.lp finds the fewest places and paths that fit the labels. If none
fit, it finds clashes: minimal sets of nodes whose labels no paths fit.

*Pinned segments.* To find the fewest paths, pairwise distinct segments get paths of their own. Then
other segments are assigned to these paths, or to new ones.

Reading answers would take most of the time of a long list. So the reader starts from the atoms of
the previous answer. And clingo searches for the next answer while a map is made from this one.
"""

from __future__ import annotations

from collections.abc import Collection, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from ssh_abduction.data.groups import minimal_part
from ssh_abduction.solver.asp.control import Asker, Control
from ssh_abduction.solver.sources.exact.engine import BETTERING, Settled, Task, maps_of_labels
from ssh_abduction.solver.sources.exact.name_program import read_names
from ssh_abduction.solver.sources.exact.path_facts import (
    open_labels,
    paths_framed_facts,
    pinned_facts,
    read_contrary,
    read_distinct,
    settled_facts,
    settled_labels,
    stretch_facts,
)
from ssh_abduction.solver.sources.exact.path_reader import PathReader
from ssh_abduction.solver.steps.apart import pairwise_distinct
from ssh_abduction.solver.steps.chart import FramedChart
from ssh_abduction.solver.values import Found
from ssh_abduction.theory.evidence import Equality

# Give clingo up to this many clashes at once. Each of them saves a question, and one control lists
# them all.
CLASHES = 30
# With these options, clasp lists the answers with minimal sets of shown atoms.
SMALLEST = ("--heuristic=Domain", "--dom-mod=5,16", "--enum-mode=domRec")
# Clasp prepares to solve for about these multiples of the time and the memory that grounding took.
# It cannot be stopped meanwhile.
PREPARING = (1.6, 2.1)


@dataclass(frozen=True)
class NodeLabels:
    """The dstate of each node of a chart, and a control for the paths to reuse, if there is one."""

    chart: FramedChart
    labels: Sequence[int]
    control: Control | None = None


@dataclass(frozen=True)
class Fitted:
    """A map (`found`), and the dstate of each step (`node_labels`)."""

    found: Found
    node_labels: NodeLabels


class FramedPaths:
    """Asks clingo for the places and paths that fit labels (the dstate of each step).

    Attributes:
        forbidden: Sets of equalities of steps. In no map do all equalities of one set hold.
    """

    def __init__(self, task: Task, asker: Asker) -> None:
        self.task = task
        self.forbidden: list[Collection[Equality]] = []
        self._asker = asker

    def some(self, chart: FramedChart, labels: Sequence[int]) -> Fitted | None:
        """Find a map with these dstates, as `Fitted`; None if no paths fit them."""
        node_labels = NodeLabels(chart, list(labels), self.control(chart, labels))
        found = next(self.maps(node_labels, "ignore"), None)
        return Fitted(found, node_labels) if found else None

    def better(self, node_labels: NodeLabels) -> Iterator[Found]:
        """Yield maps with these dstates, none more expensive than the one before.

        The last map is the best one. There is none if no paths fit. If improving the maps takes
        many conflicts, clingo raises the lower bound instead (`usc`).
        """
        if len(self.task.theory.priorities) == 1:
            yield from self.maps(node_labels, "ignore")
            return
        proven = yield from self.maps(node_labels, "opt", BETTERING)
        if not proven:
            control = self.control(node_labels.chart, node_labels.labels, ["--opt-strategy=usc"])
            yield from self.maps(replace(node_labels, control=control), "opt")

    def maps(
        self, node_labels: NodeLabels, mode: str, conflicts: int = -1
    ) -> Generator[Found, None, bool]:
        """Yield maps with these dstates, as `maps_of_labels` does."""
        reader, theory = self._reader(node_labels), self.task.theory
        return (yield from maps_of_labels(self._asker, reader, theory, mode, conflicts))

    def settled(self, node_labels: NodeLabels, mode: str) -> Settled:
        """Prepare questions about the best maps with these dstates. `mode` is clingo's opt-mode."""
        return Settled(self._asker, self._reader(node_labels), mode)

    def _reader(self, node_labels: NodeLabels) -> PathReader:
        """Make a reader of the places and paths that fit these dstates."""
        chart, labels = node_labels.chart, node_labels.labels
        control = node_labels.control or self.control(chart, labels)
        return PathReader(control, self.task.trace, self.task.theory, chart, labels)

    def control(
        self,
        chart: FramedChart,
        labels: Sequence[int],
        options: Sequence[str] = (),
        nodes: Iterable[int] | None = None,
    ) -> Control:
        """Make a control whose answers are the places and paths that fit the labels of some nodes.

        `options` are those of clasp. If `nodes` is None, the paths have to fit the labels of all
        nodes.
        """
        self._asker.watch.check()
        with self._asker.grounding_timed():
            theory, nodes = self.task.theory, range(len(labels)) if nodes is None else nodes
            facts = settled_facts(theory, chart, labels, nodes)
            where = [labels[node] for node in chart.node_of]
            stretches = stretch_facts(self.task.trace, theory, where)
            control = self._control(chart, f"{facts}\n{stretches}", options)
            control.load_encodings("preference")
            control.ground([("base", []), ("segments", []), ("least", [])])
            if self.task.speedups.clique:
                pinned = pairwise_distinct(*read_distinct(control))
                control.add("pinned", [], pinned_facts(pinned))
            control.ground([("pinned", []), ("paths", []), ("each", [])])
        self._asker.watch.check()
        return control

    def _control(self, chart: FramedChart, facts: str, options: Sequence[str] = ()) -> Control:
        """Make a clingo control with the axioms and facts of a chart. Nothing is grounded yet."""
        control = Control(options, self.task.watch.check, PREPARING)
        control.load_encodings("paths_framed")
        trace, theory = self.task.trace, self.task.theory
        known = paths_framed_facts(trace, theory, chart, self.forbidden)
        control.add("base", [], f"{known}\n{facts}")
        return control

    def contrary(self, chart: FramedChart, labels: Sequence[int]) -> tuple[list[int], list[int]]:
        """Find the paths that contradict the axioms on their own (see `read_contrary`)."""
        control = self._control(chart, settled_labels(enumerate(labels)))
        control.ground([("base", []), ("again", []), ("contrary", [])])
        return next(self._asker.answers(read_contrary, "ignore", 1, control=control))

    def clashing(self, chart: FramedChart, labels: Sequence[int]) -> list[list[int]]:
        """Find up to `CLASHES` clashes: minimal sets of nodes whose labels no paths fit."""
        # Clingo finds only sets that clash however segments are merged to paths.
        control = self._control(chart, open_labels(labels), SMALLEST)
        control.ground([("base", [])])
        clashes = list(
            self._asker.answers(
                lambda model: sorted(read_names(model)), "ignore", CLASHES, control=control
            )
        )
        return clashes or [self._clash(chart, labels)]

    def _clash(self, chart: FramedChart, labels: Sequence[int]) -> list[int]:
        """Find a minimal clash: nodes whose labels no paths fit."""

        def clashes(nodes: list[int]) -> bool:
            control = self.control(chart, labels, nodes=nodes)
            return next(self._asker.answers(lambda _: False, "ignore", 1, control=control), True)

        return minimal_part(clashes, list(range(len(labels))))
