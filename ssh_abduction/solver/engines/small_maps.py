"""Small maps of the causal theory that are made without clingo.

They are for long traces. If the search has to stop, there is at least a good map. And if a map has
as few dstates as the lower bound, the search can end.

First, steps are merged by evidence (`guesses/merging.py`). Then, if actions are neither travels nor
turns, dstates are guessed by EM (`guesses/robust.py`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import islice

from ssh_abduction.solver.engines.base import Task
from ssh_abduction.solver.engines.pinned import Pinned
from ssh_abduction.solver.guesses.merging import dstates_merged, merged
from ssh_abduction.solver.guesses.robust import machine_labels
from ssh_abduction.solver.steps.chart import Chart

# Stop after this many guesses, even if none of them is a map. Guesses are slow, and later ones are
# rarely better.
GUESSES = 10


class SmallMaps:
    """Finds small maps of first steps by merging and guessing, in case a search stops early."""

    def __init__(self, task: Task, pinned: Pinned) -> None:
        """Prepare for a chart in which each of the first steps is a node."""
        self._task, self._pinned = task, pinned

    def merged(self) -> Iterator[list[int]]:
        """Merge nodes by evidence, and yield the labels of the map, if speed-up `greedy` is on."""
        if self._task.speedups.greedy:
            yield merged(self._pinned.chart, self._pinned.clique)

    def guessed(self) -> Iterator[list[int]]:
        """Yield the labels of a map near each guess at the dstates, if speed-up `guessed` is on.

        The first guess that is itself a map is the last one. There is no guess if that takes too
        much memory, of a long trace, and where a robot travels and turns: there merging does as
        well in less time.
        """
        steps, speedups = self._pinned.chart, self._task.speedups
        drives = all(action.kind for action in self._task.trace.actions)
        if not speedups.guessed or drives or self._pinned.is_long:
            return
        actions = [action for _, action, _ in steps.links]
        for labels in islice(machine_labels(steps.seen, actions), GUESSES):
            guess = mended(labels, steps)
            yield dstates_merged(steps, merged(steps, guess=guess))
            if steps.is_map(guess):
                return


def mended(guess: Sequence[int], chart: Chart) -> list[int]:
    """Correct a guess: let each action at a dstate lead to the dstate that it mostly leads to.

    Take the dstate of a node in the guess, and the action after the node. The next node gets the
    dstate to which this action mostly leads from there, unless its view contradicts this. If only a
    few dstates were wrong, all dstates after a right one become right. In the guess, -1 is an
    unknown dstate.
    """
    keys = [
        None if label < 0 else (view, label) for view, label in zip(chart.seen, guess, strict=True)
    ]
    leads: dict[tuple[tuple[int, int], int], Counter[tuple[int, int]]] = {}
    for t, action, u in chart.links:
        if (here := keys[t]) is not None and (there := keys[u]) is not None:
            leads.setdefault((here, action), Counter())[there] += 1
    most = {key: counts.most_common(1)[0][0] for key, counts in leads.items()}
    for t, action, u in chart.links:
        if (
            (here := keys[t]) is not None
            and (likely := most.get((here, action))) is not None
            and likely[0] == chart.seen[u]
        ):
            keys[u] = likely
    return [-1 if key is None else key[1] for key in keys]
