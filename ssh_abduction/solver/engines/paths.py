"""Asks paths_framed.lp what order and sides imply for dstates.

The engine with frames uses it. `engines/framed_paths.py` asks the questions that need a search for
places and paths, under the limits of the engine.

*Separate paths.* To find out whether labels have any paths, places and segments are only merged if
they must be. That takes a small part of the time for grounding all ways to merge them.

*Pinned segments.* To find the fewest paths, pairwise distinct segments get paths of their own. Then
other segments are assigned to these paths, or to new ones.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

import clingo
import numpy as np

from ssh_abduction.solver.asp.control import Control
from ssh_abduction.solver.asp.facts import paths_lp
from ssh_abduction.solver.engines.base import Task
from ssh_abduction.solver.steps.apart import large_clique
from ssh_abduction.solver.steps.chart import FramedChart
from ssh_abduction.theory.evidence import Equality

# With these options, clasp lists the answers with minimal sets of shown atoms.
SMALLEST = ("--heuristic=Domain", "--dom-mod=5,16", "--enum-mode=domRec")
# Clasp prepares to solve for about these multiples of the time and the memory that grounding took.
# It cannot be stopped meanwhile.
PREPARING = (1.6, 2.1)


class Paths:
    """The axioms of places and paths, for charts of one trace."""

    def __init__(self, task: Task, forbidden: Sequence[Collection[Equality]]) -> None:
        """Prepare questions. In no map do all equalities of steps of one `forbidden` set hold."""
        self._task, self._trace, self._theory = task, task.trace, task.theory
        self._forbidden = forbidden

    def control(self, chart: FramedChart, options: Sequence[str] = ()) -> Control:
        """Make a control with the axioms and the facts of a chart. Nothing is grounded yet."""
        control = Control(options, self._task.watch.check, PREPARING)
        control.load_encodings("paths_framed")
        control.add(
            "base",
            [],
            paths_lp.paths_framed_facts(self._trace, self._theory, chart, self._forbidden),
        )
        return control

    def contrary(self, chart: FramedChart, labels: Sequence[int]) -> clingo.Control:
        """Make a control whose answer says which single paths contradict the axioms."""
        control = self.control(chart)
        control.add("base", [], paths_lp.settled_labels(enumerate(labels)))
        control.ground([("base", []), ("again", []), ("contrary", [])])
        return control

    def clashing(self, chart: FramedChart, labels: Sequence[int]) -> clingo.Control:
        """Make a control whose answers are minimal sets of nodes whose labels no paths fit.

        It finds only sets that clash however segments are merged to paths.
        """
        control = self.control(chart, SMALLEST)
        control.add("base", [], paths_lp.open_labels(labels))
        control.ground([("base", [])])
        return control

    def settled(
        self,
        chart: FramedChart,
        labels: Sequence[int],
        options: Sequence[str] = (),
        nodes: Iterable[int] | None = None,
        *,
        single: bool,
    ) -> clingo.Control:
        """Make a control for the places and paths of labels, as `FramedPaths.control` does."""
        control = self.control(chart, options)
        control.load_encodings("preference")
        nodes = range(len(labels)) if nodes is None else nodes
        control.add(
            "base", [], paths_lp.settled_facts(self._theory, chart, labels, nodes, single=single)
        )
        where = [labels[node] for node in chart.node_of]
        control.add("base", [], paths_lp.stretch_facts(self._trace, self._theory, where))
        control.ground(
            [("base", []), *([("again", [])] if single else []), ("segments", []), ("least", [])]
        )
        if self._task.speedups.clique and not single:
            control.add(
                "pinned",
                [],
                paths_lp.pinned_facts(pairwise_distinct(*paths_lp.read_distinct(control))),
            )
        control.ground([("pinned", []), ("paths", []), ("each", [])])
        return control

    def apart(self, chart: FramedChart) -> clingo.Control:
        """Make a control for the pairs of nodes that the trace alone puts at different places."""
        control = self.control(chart)
        control.add("base", [], paths_lp.settled_labels(enumerate(range(len(chart.seen)))))
        control.ground([("base", []), ("apart", [])])
        return control


def pairwise_distinct(members: Sequence[int], pairs: Iterable[tuple[int, int]]) -> list[int]:
    """Find a large clique: a list of segments, or places, that are pairwise distinct.

    `pairs` are distinct. A pair of a member with itself means that the labels contradict the
    axioms, and is ignored.
    """
    number = {member: i for i, member in enumerate(members)}
    rivals = np.zeros((len(members), len(members)), dtype=bool)
    for g, h in pairs:
        rivals[number[g], number[h]] = g != h
    return [members[i] for i in large_clique(rivals)]
