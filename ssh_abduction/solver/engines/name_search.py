"""Searches for names with the fewest dstates, for the engines without frames.

Clasp raises the lower bound by one for each core. A core is a set of spare names, and at least one
of them is needed. Cores are small at first, as views share no names.

If that takes long, the search also looks for small maps in other ways (`engines/small_maps.py`):
first it merges steps, and later it guesses a map. The search ends as soon as some map has as few
dstates as the bound.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator

from ssh_abduction.solver.asp.control import Asker
from ssh_abduction.solver.asp.facts import names_lp
from ssh_abduction.solver.asp.limits import LimitError
from ssh_abduction.solver.engines.base import Task
from ssh_abduction.solver.engines.name_program import Fitting, NameProgram
from ssh_abduction.solver.engines.small_maps import SmallMaps

# If clingo has not ended after this many conflicts, give it more links. If it lacks links that
# matter, this mostly shows sooner.
PATIENCE = 2000
# After this many conflicts with all links, guess a map. Then clingo continues without a limit.
CORES = 10_000


class Incumbent:
    """The best known labels of all steps, and a lower bound on the number of dstates.

    Both are None while unknown.
    """

    def __init__(self) -> None:
        """Begin with no known labels (dstates of steps) and no bound."""
        self.bound: int | None = None
        self.labels: list[int] | None = None

    def raise_bound(self, bound: int) -> None:
        """Take over a bound if it is higher than the known one."""
        self.bound = max(self.bound or 0, bound)

    def is_settled(self) -> bool:
        """Whether the known labels have as few dstates as the lower bound."""
        return self.labels is not None and len(set(self.labels)) <= (self.bound or 0)


class NameSearch:
    """The search for labels of the nodes of one chart with the fewest dstates."""

    def __init__(
        self,
        task: Task,
        asker: Asker,
        program: NameProgram,
        incumbent: Incumbent,
        fitting: Fitting | None,
    ) -> None:
        """Prepare a search that improves the incumbent. `fitting` is None in the causal theory."""
        self._task, self._asker, self._program = task, asker, program
        self._incumbent, self._fitting = incumbent, fitting
        self._small = SmallMaps(task, program.pinned)
        self._hard = False  # whether clingo once did not end after few conflicts
        self._had_all_help = False  # whether maps near a guess were sought already

    def improving(self) -> Iterator[list[int]]:
        """Yield labels of all steps, with ever fewer dstates. The last have the fewest."""
        known = self._incumbent
        if not self._program.chart.links:
            yield [0]
            return
        try:
            for labels in self._searched():
                if self._program.is_allowed(labels):
                    known.labels = labels
                    yield labels
        except (LimitError, KeyboardInterrupt) as end:
            if known.labels:
                yield known.labels
            if isinstance(end, KeyboardInterrupt) or not known.is_settled():
                raise

    def _searched(self) -> Iterator[list[int]]:
        """Yield labels as `improving` does. End early if a known map has the fewest dstates."""
        labels = None
        while labels is None and (names := (yield from self._cheapest_answer())) is not None:
            labels = self._labels_by(names)
        if best := labels or self._incumbent.labels:
            yield best

    def _cheapest_answer(self) -> Generator[list[int], None, dict[int, int] | None]:
        """Find the cheapest answer for the links that clingo has; None if a known map is as good.

        If the search takes long, labels that were found in other ways are yielded.
        """
        while True:
            names, proven = self._cheapest(self._patience)
            if proven:
                return names  # None if what the user says contradicts the trace
            yield from self._helped()
            if self._incumbent.is_settled():
                return None
            self._program.add(self._program.more_links())

    def _cheapest(self, conflicts: int) -> tuple[dict[int, int] | None, bool]:
        """Find the best answer within a number of conflicts, and whether it is proven the best."""
        pinned = len(self._program.pinned.clique)
        answer = None
        answers = self._asker.answers(
            names_lp.read_names,
            "opt",
            0,
            conflicts=conflicts,
            on_bound=lambda costs: self._incumbent.raise_bound(pinned + costs[0]),
            until=self._incumbent.is_settled,
        )
        while True:
            try:
                answer = next(answers)
            except StopIteration as end:
                return answer, bool(end.value)

    def _labels_by(self, names: dict[int, int]) -> list[int] | None:
        """Return labels from an answer. If they are no map, give clingo the missing links."""
        program = self._program
        if views := program.rests(names):
            program.name_more(views)
            return None
        pinned = len(program.pinned.clique)
        spares = sum(name >= pinned for name in set(names.values()))
        self._incumbent.raise_bound(pinned + spares)
        labels, failed = program.follow(names)
        if failed:
            program.add(failed)
        elif self._fitting is None or self._fitting.fits(labels):
            return labels
        else:
            self._fitting.forbid(labels)
        return None

    @property
    def _patience(self) -> int:
        """The number of conflicts after which to interrupt clingo; -1 for never."""
        if not self._program.has_all_links:
            return PATIENCE
        return -1 if self._had_all_help or not self._may_help else CORES

    @property
    def _may_help(self) -> bool:
        """Whether to look for small maps in other ways. These obey the causal axioms only."""
        return self._fitting is None and (self._task.speedups.greedy or self._task.speedups.guessed)

    def _helped(self) -> Iterator[list[int]]:
        """Look for small maps in other ways, as clingo takes long. Yield the dstates of steps."""
        if self._may_help and not self._hard and not self._program.pinned.is_long:
            yield from self._small.merged()
        self._hard = True
        # It takes long until clingo has all links of a long trace, so guess before.
        is_time = self._program.has_all_links or self._program.pinned.is_long
        if is_time and self._may_help and not self._had_all_help:
            self._had_all_help = True
            yield from self._near_a_guess()

    def _near_a_guess(self) -> Iterator[list[int]]:
        """Guess maps. Yield the labels of each with fewer dstates than all maps before."""
        known = self._incumbent.labels
        for labels in self._small.guessed():
            if known is None or len(set(labels)) < len(set(known)):
                known = labels
                yield labels
            if self._incumbent.is_settled():
                return
