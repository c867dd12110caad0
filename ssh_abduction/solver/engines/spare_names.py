"""The names that clingo may give to dstates near a guess, and the pace at which it gets them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from ssh_abduction.solver.steps.chart import Chart

# Give clingo this many links at once. It cannot be stopped while it grounds them.
AT_A_TIME = 100
# Clingo cannot be stopped while it reads and grounds the facts about names. That takes at most
# about this many seconds for each character of the facts.
SECONDS_A_CHARACTER = 1e-6

Key: TypeAlias = tuple[int, int]  # the observation at a node, and the label of the node


@dataclass(frozen=True)
class SpareNames:
    """The names that the control knows.

    A literal is a number by which clingo is asked about an atom.

    Attributes:
        spare: The spare names of each view. The last one is the rest, which any number of dstates
            without a name of their own share.
        rests: The rests of all views.
        choices: For each node, the names that it may have.
        used: For each spare name, the literal that some node has it.
        ordered: The literal that the spare names of each view first occur in their order.
    """

    spare: Mapping[int, range]
    rests: frozenset[int]
    choices: Sequence[Sequence[int]]
    used: Mapping[int, int]
    ordered: int


def seen_labels(guess: Sequence[int], chart: Chart) -> list[Key | None]:
    """Return the pair of observation and label for each node; None if the label is unknown.

    Args:
        guess: The label of each node, -1 if it is unknown.
        chart: The chart of the nodes.
    """
    return [
        None if label < 0 else (view, label) for view, label in zip(chart.seen, guess, strict=True)
    ]
