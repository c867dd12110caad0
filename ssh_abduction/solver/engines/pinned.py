"""A chart with a clique: nodes that are pairwise distinct, so each gets a name of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ssh_abduction.solver.engines.base import AT_ONCE
from ssh_abduction.solver.steps.chart import Chart
from ssh_abduction.solver.steps.log import Log


@dataclass(frozen=True)
class Pinned:
    """A chart, and a clique of its nodes: pairwise distinct nodes, which get the names 0, 1, ….

    Attributes:
        clique: Nodes that are pairwise distinct.
        may_be: For each node, the names of those clique nodes with which it may share a dstate.
    """

    chart: Chart
    clique: Sequence[int]
    may_be: Sequence[Sequence[int]]

    @classmethod
    def of_steps(cls, log: Log, steps: int, *, largest: bool = True) -> Pinned:
        """Chart the first steps, and name a largest clique of them, or else only the first step."""
        chart = Chart.of_steps(log, steps)
        clique = chart.continuations.clique() if largest else [0]
        apart = np.stack([chart.continuations.apart_from(step) for step in clique], axis=1)
        return cls(chart, clique, [(~row).nonzero()[0].tolist() for row in apart])

    @property
    def is_long(self) -> bool:
        """Whether there are too many nodes to compare them in pairs."""
        return len(self.chart.seen) > AT_ONCE
