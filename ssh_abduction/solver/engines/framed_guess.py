"""Maps near a guess, which come before the fewest dstates are found, for the engine with frames.

If the search for the fewest dstates takes long, it pauses. A map is guessed, and clingo looks for
smaller maps near the guess. Then the search for the fewest dstates goes on.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence

from ssh_abduction.solver.asp.control import Asker
from ssh_abduction.solver.engines.base import Found
from ssh_abduction.solver.engines.framed_paths import FramedPaths, Naming
from ssh_abduction.solver.engines.visit_labels import VisitLabels
from ssh_abduction.solver.steps.chart import numbered

# Look for a map near a guess after this many seconds at least, as clingo waits meanwhile.
GUESS_FIRST = 5.0
# Wait this many times as long if clingo lacks some visits: it is soon given more.
LATER = 4
# Or this share of the time limit, if that is less.
LATER_SHARE = 0.25
# Try at most this many labels near a guess until some have paths.
GUESSES = 20
# After this many conflicts better paths for a map near a guess are no longer looked for: fewer
# dstates matter more.
GUESSING = 1000


class SoonMaps:
    """Maps near a guess, and when it is time for one."""

    def __init__(
        self,
        fitting: FramedPaths,
        visits: VisitLabels,
        asker: Asker,
        *,
        soon: float,
        refuse: Callable[[Sequence[int]], None],
    ) -> None:
        """No map was made yet.

        Args:
            fitting: Finds the paths of labels.
            visits: Finds labels near a guess.
            asker: Its limits hold.
            soon: Seconds without the fewest dstates after which to guess, at most.
            refuse: Called with labels that have no paths.
        """
        self._fitting, self._visits = fitting, visits
        self._asker, self._soon, self._refuse = asker, soon, refuse
        self._guessed = False  # whether maps near the guess were looked for
        self._known_cost: tuple[int, ...] = ()  # the cost of the known map

    def should_interrupt(self) -> bool:
        """Whether the search for the fewest dstates should pause for a guess. It does once."""
        visits, task = self._visits, self._fitting.task
        if self._guessed or not task.speedups.annealed or visits.has_forbidden:
            return False
        waited = self._asker.watch.elapsed()
        limit = waited + self._asker.watch.left()
        knows_all = visits.program.knows_all
        later = self._soon if knows_all else min(LATER * self._soon, LATER_SHARE * limit)
        return waited > max(later, GUESS_FIRST)

    def found(self) -> Iterator[Found]:
        """Yield maps near a guess, each with fewer dstates or better paths than the one before."""
        self._guessed = True
        guess = self._fitting.paths.guessed_labels(self._visits.chart, self._asker.watch)
        failed = 0
        for labels in self._visits.near(guess):
            if self._visits.known and len(set(labels)) >= len(set(self._visits.known)):
                break
            if fits := (yield from self.known_if_it_has_paths(labels)):
                yield from self._improve_known_map()
                continue
            failed += 1
            if fits is None or failed == GUESSES:
                break
            self._refuse(labels)

    def _improve_known_map(self) -> Iterator[Found]:
        """The known map with better paths, if there is time for that."""
        known, fitting = self._visits.known, self._fitting
        if (
            known
            and len(fitting.task.theory.priorities) > 1
            and self._asker.watch.allows(fitting.preparing)
        ):
            naming = Naming(self._visits.chart, list(known))
            maps = fitting.maps(naming, "opt", GUESSING)
            yield from (found for found in maps if found.cost < self._known_cost)

    def known_if_it_has_paths(self, labels: Sequence[int]) -> Generator[Found, None, bool | None]:
        """Yield the map of these labels, if paths fit them. It becomes the known map.

        Returns:
            Whether paths fit them; None if time is short.
        """
        fitting, chart = self._fitting, self._visits.chart
        fitted = fitting.found_soon(chart, labels)
        if fitted is None:
            if not self._asker.watch.allows(fitting.preparing):
                return None
            fitted = fitting.any(chart, labels)
        if fitted is None:
            return False
        self._visits.known, self._known_cost = tuple(numbered(labels)), fitted.found.cost
        yield fitted.found
        return True
