"""Small maps of the causal theory that are made without clingo, or near a guess.

They are for long traces: a search that has to stop then has a good map, and a map with as few
dstates as the lower bound ends the search. `engines/nearby.py` proves maps minimal; this module
does not.

First, steps are merged by evidence (`guesses/merging.py`). Then a map is guessed. If the trace
could be one of a world whose places have frames, the guess is annealed as such
(`guesses/annealing.py`). `NearbySearch` looks for smaller maps near the guess. Of a long trace,
only the beginning is guessed; the guess is then followed along the rest
(`guesses/continuing.py`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice

from ssh_abduction.solver.asp.limits import Watch
from ssh_abduction.solver.engines.base import AT_ONCE, Task
from ssh_abduction.solver.engines.nearby import NearbySearch
from ssh_abduction.solver.engines.pinned import Pinned
from ssh_abduction.solver.engines.spare_names import Key, seen_labels
from ssh_abduction.solver.guesses.annealing import annealed, annealed_steps
from ssh_abduction.solver.guesses.continuing import followed
from ssh_abduction.solver.guesses.merging import merged, merged_near, thinned
from ssh_abduction.solver.steps.chart import Chart

# If the robot does not turn, guess at most this often until a guess is a map: guesses are slow, and
# later ones are rarely better.
GUESSES = 10
# Guess at most this many steps of a long trace at once: more take minutes.
GUESSED = 24_000


class SmallMaps:
    """Finds small maps of first steps by merging and guessing, for a search that stops early."""

    def __init__(self, task: Task, pinned: Pinned) -> None:
        """Prepare for a chart.

        Args:
            task: The trace and the speed-ups that are on.
            pinned: The chart of the first steps, each of them a node.
        """
        self._task, self._pinned = task, pinned

    def search(self, watch: Watch) -> NearbySearch:
        """A search near a guess, under these limits.

        Clasp's configuration `tweety` proves several times as soon as its default.
        """
        chart = self._pinned.chart
        return NearbySearch(
            watch,
            self._pinned,
            far=chart.continuations.excluded_from if chart.excluded else None,
            configuration="tweety",
        )

    def merged(self, check: Callable[[], None]) -> Iterator[list[int]]:
        """Yield labels of a map whose nodes were merged by evidence; none without that speed-up."""
        if self._task.speedups.greedy:
            chart = self._pinned.chart
            yield merged(chart.apart(), chart.links, self._pinned.clique, check)

    def from_beginning(self, check: Callable[[], None]) -> Iterator[list[int]]:
        """Yield labels of maps that guesses for the first steps of a long trace lead to.

        Guess ever longer prefixes, until the map of the whole trace needs no more dstates than that
        of the prefix.
        """
        chart = self._pinned.chart
        size, steps = len(chart.seen), AT_ONCE
        most = size if size <= GUESSED else 2 * AT_ONCE
        while self._task.speedups.annealed:
            beginning = Pinned.of_steps(self._task.log, steps)
            near = self._map_of_guess(beginning, check)
            tried = () if near is None else (thinned(beginning.chart, near, check), near)
            for known in tried:
                if labels := followed(self._task.log, known, check):
                    yield labels[:size]
                    yield (labels := thinned(chart, labels[:size], check))
                    if len(set(labels)) <= len(set(known)):
                        return
            if steps == most:
                return
            steps = min(2 * steps, most)

    def near_guess(
        self, search: NearbySearch, check: Callable[[], None], tries: int | None = None
    ) -> Iterator[list[int]]:
        """Yield labels of a map that is guessed, and of smaller ones near it."""
        if not self._task.speedups.annealed:
            return
        near = self._map_of_guess(self._pinned, check)
        if near is not None:
            yield from search.fewer(thinned(self._pinned.chart, near, check), tries)

    def _map_of_guess(self, pinned: Pinned, check: Callable[[], None]) -> list[int] | None:
        """Labels of a map of these steps near a guess; None if there is no guess."""
        guess = self._guessed(pinned, check)
        if guess is None:
            return None
        return merged_near(pinned.chart.apart(), pinned.chart.links, guess, check)

    def _guessed(self, pinned: Pinned, check: Callable[[], None]) -> list[int] | None:
        """Guess the dstates of these steps, -1 where the guess is unsure.

        None if a guess would take too much memory.
        """
        steps = pinned.chart
        chart = Chart.turned(self._task.trace, self._task.log, len(steps.seen))
        if chart is None:  # the robot does not turn, or turns do not rotate
            guesses: Iterable[list[int]] = islice(
                annealed_steps(steps, pinned.clique, pinned.may_be, check), GUESSES
            )
        else:
            labels = annealed(chart, check).labels(chart)
            guesses = [[labels[node] for node in chart.node_of]]
        guess = None
        for labels in guesses:
            guess = mended(labels, steps)
            if steps.is_map(guess):
                break
        return guess


def mended(guess: Sequence[int], chart: Chart) -> list[int]:
    """Correct a guess: put each node where the same action from the same dstate mostly leads.

    This corrects a few wrong labels: after a right one, all that follow become right.

    Args:
        guess: A label of each node, -1 if it is unknown.
        chart: The chart of the nodes and links.

    Returns:
        The new labels. A label stays if the view at the node contradicts the new one.
    """
    keys = seen_labels(guess, chart)
    leads: dict[tuple[Key, int], Counter[Key]] = {}
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
