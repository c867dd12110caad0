"""Small maps of the causal theory that are made without clingo.

They are for long traces. If the search has to stop, there is at least a good map. And if a map has
as few dstates as the lower bound, the search can end.

First, steps are merged by evidence (`guesses/merging.py`). Then a map is guessed: by annealing
(`guesses/annealing.py`) the places, if turns may be rotations by right angles, or otherwise by EM
(`guesses/robust.py`) the dstates. Of a long trace, only the first steps are guessed. The guess is
then followed along the other steps (`guesses/continuing.py`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from itertools import islice

from ssh_abduction.solver.engines.base import AT_ONCE, Task
from ssh_abduction.solver.engines.pinned import Pinned
from ssh_abduction.solver.guesses.annealing import annealed
from ssh_abduction.solver.guesses.continuing import labels_continued
from ssh_abduction.solver.guesses.merging import dstates_merged, merged
from ssh_abduction.solver.guesses.robust import machine_labels
from ssh_abduction.solver.steps.chart import Chart

# If turns cannot be rotations, stop after this many guesses, even if none of them is a map. Guesses
# are slow, and later ones are rarely better.
GUESSES = 10
# Guess at most this many steps of a long trace at once. More steps take minutes.
GUESSED = 24_000


class SmallMaps:
    """Finds small maps of first steps by merging and guessing, in case a search stops early."""

    def __init__(self, task: Task, pinned: Pinned) -> None:
        """Prepare for a chart in which each of the first steps is a node."""
        self._task, self._pinned = task, pinned

    def merged(self) -> Iterator[list[int]]:
        """Merge nodes by evidence, and yield the labels of the map, if speed-up `greedy` is on."""
        if self._task.speedups.greedy:
            yield merged(self._pinned.chart, self._pinned.clique)

    def from_beginning(self) -> Iterator[list[int]]:
        """Guess a map of the first steps of a long trace, extend it, and yield labels of all steps.

        Guess ever longer prefixes, until the map of the whole trace needs no more dstates than the
        map of the prefix.
        """
        chart = self._pinned.chart
        size, steps = len(chart.seen), AT_ONCE
        most = size if size <= GUESSED else 2 * AT_ONCE
        while self._task.speedups.annealed:
            beginning = Pinned.of_steps(self._task.log, steps)
            near = min(self._maps_of_guesses(beginning), key=_dstates, default=None)
            tried = () if near is None else (dstates_merged(beginning.chart, near), near)
            for known in tried:
                if labels := labels_continued(self._task.log, known):
                    yield labels[:size]
                    yield (labels := dstates_merged(chart, labels[:size]))
                    if _dstates(labels) <= _dstates(known):
                        return
            if steps == most:
                return
            steps = min(2 * steps, most)

    def guessed(self) -> Iterator[list[int]]:
        """Yield the labels of guessed maps, if speed-up `annealed` is on."""
        if self._task.speedups.annealed:
            for near in self._maps_of_guesses(self._pinned):
                yield dstates_merged(self._pinned.chart, near)

    def _maps_of_guesses(self, pinned: Pinned) -> Iterator[list[int]]:
        """Guess dstates, and yield the labels of a map near each guess.

        The first guess that is itself a map is the last one. There is no guess if that takes too
        much memory.
        """
        steps = pinned.chart
        chart = Chart.turned(self._task.trace, self._task.log, len(steps.seen))
        if chart is None:  # turns cannot be rotations by right angles
            actions = [action for _, action, _ in steps.links]
            guesses: Iterable[list[int]] = islice(machine_labels(steps.seen, actions), GUESSES)
        else:
            labels = annealed(chart).labels(chart)
            guesses = [[labels[node] for node in chart.node_of]]
        for labels in guesses:
            guess = mended(labels, steps)
            yield merged(steps, guess=guess)
            if steps.is_map(guess):
                return


def _dstates(labels: Sequence[int]) -> int:
    """Count the dstates of labels."""
    return len(set(labels))


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
