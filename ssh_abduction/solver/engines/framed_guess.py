"""Maps near a guess, which come before the fewest dstates are found, for the engine with frames.

If the search for the fewest dstates takes long, a map is guessed in another process
(`GuessBeside`). Near the guess, maps are made here (`SoonMaps`), while a thread proves with names,
from the guess outwards, how many dstates the causal axioms need (`engines/nearby.py`). If a map has
as few, it has the fewest.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence

from ssh_abduction.solver.asp.control import Asker
from ssh_abduction.solver.asp.limits import Watch
from ssh_abduction.solver.engines.base import Found
from ssh_abduction.solver.engines.beside import Beside
from ssh_abduction.solver.engines.framed_paths import FramedPaths, Naming
from ssh_abduction.solver.engines.nearby import NearbySearch
from ssh_abduction.solver.engines.pinned import Pinned
from ssh_abduction.solver.engines.visit_labels import VisitLabels
from ssh_abduction.solver.steps.chart import FramedChart, numbered

# Begin to guess after this share of the time limit, if that is less than the seconds that the
# engine waits, so that the guess comes in time.
SOON_SHARE = 0.05
# With one processor, look for a map near a guess after this many seconds, as clingo waits
# meanwhile.
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


class GuessBeside:
    """A guess, and the search near it in another thread.

    Attributes:
        guess: Labels of a map of the causal axioms, once they are guessed.
        search: The search near the guess, also when its thread has ended.
    """

    def __init__(self, fitting: FramedPaths, visits: VisitLabels, asker: Asker) -> None:
        """Nothing is guessed yet.

        Args:
            fitting: Makes the guess.
            visits: Gets the bound that the search proves.
            asker: Its limits also hold for the search.
        """
        self.guess: list[int] | None = None
        self.search: NearbySearch | None = None
        self._fitting, self._visits, self._asker = fitting, visits, asker
        self._thread: Beside | None = None
        self._tried: list[int] | None = None  # the last labels of the thread that were tried

    @property
    def running(self) -> bool:
        """Whether a thread was started and not ended."""
        return self._thread is not None

    def begin(self, chart: FramedChart) -> None:
        """Guess, and prove from the guess how many dstates the causal axioms need."""
        watch = Watch(beside=self._asker.watch)
        pinned = Pinned.framed(chart, self._visits.clique or [0])
        self.search = NearbySearch(watch, self._fitting.task.speedups, pinned, far=None)
        self._thread = Beside(self.search, watch, self._fewer_labels(self.search, chart, watch))

    def _fewer_labels(
        self, search: NearbySearch, chart: FramedChart, watch: Watch
    ) -> Iterator[list[int]]:
        """Labels, each time fewer, of maps of the causal axioms near a guess."""
        guessed_labels = self._fitting.paths.guessed_labels
        self.guess = guessed_labels(chart, watch)
        yield from search.fewer(self.guess)

    def absorb(self) -> None:
        """Take the bound that the thread has proven."""
        if self._thread:
            self._thread.check()
            self._visits.bound = max(self._visits.bound or 0, self._thread.bound)

    def end(self) -> None:
        """End the thread, and take the bound that it has proven."""
        if self._thread:
            self._thread.end()
            self.absorb()
            self._thread = None

    def forget(self) -> None:
        """End the thread, and drop its search, which lacks what was forbidden."""
        self.end()
        self.search = self._tried = None

    def new_labels(self) -> list[int] | None:
        """The labels last found, if they are untried and fewer than those of the known map."""
        labels, known = self._thread.labels if self._thread else None, self._visits.known
        if labels is self._tried or not labels or (known and len(set(labels)) >= len(set(known))):
            return None
        return labels

    def take_labels(self) -> list[int] | None:
        """Return `new_labels`. From now on these labels count as tried."""
        if labels := self.new_labels():
            self._tried = labels
        return labels

    def proved(self, dstates: int) -> NearbySearch | None:
        """The search near the guess, if it has proven that there are no fewer dstates."""
        search, least = self.search, self._visits.program.cores.least
        return search if search and search.bound == dstates > least else None


class SoonMaps:
    """Maps near a guess, and when it is time for one."""

    def __init__(
        self,
        fitting: FramedPaths,
        visits: VisitLabels,
        beside: GuessBeside,
        asker: Asker,
        *,
        soon: float,
        refuse: Callable[[Sequence[int]], None],
    ) -> None:
        """No map was made yet.

        Args:
            fitting: Finds the paths of labels.
            visits: Finds labels near a guess.
            beside: The guess, and the search near it.
            asker: Its limits hold.
            soon: Seconds without the fewest dstates after which to guess, at most.
            refuse: Called with labels that have no paths.
        """
        self._fitting, self._visits, self._beside = fitting, visits, beside
        self._asker, self._soon, self._refuse = asker, soon, refuse
        self._guessed = False  # whether maps near the guess were looked for
        # The cost of the known map, until better paths were sought.
        self._known_cost: tuple[int, ...] = ()

    def should_interrupt(self) -> bool:
        """Whether the search for the fewest dstates should pause for a guess.

        First, if there is a guess, or it is time for one. Later, if the search beside found new
        labels, or shows that the known map has the fewest dstates.
        """
        beside, visits, task = self._beside, self._visits, self._fitting.task
        beside.absorb()
        if self._guessed:
            known = visits.known
            return beside.new_labels() is not None or (
                known is not None and visits.bound == len(set(known))
            )
        if not task.speedups.annealed or visits.has_forbidden:
            return False
        waited = self._asker.watch.elapsed()
        limit = waited + self._asker.watch.left()
        soon = min(self._soon, SOON_SHARE * limit) if limit > self._soon else self._soon
        if not beside.running and waited > soon and task.has_processors:
            beside.begin(visits.chart)
        # Without a thread, the guess is made here.
        knows_all = visits.program.knows_all
        later = self._soon if knows_all else min(LATER * self._soon, LATER_SHARE * limit)
        return beside.guess is not None or (not beside.running and waited > max(later, GUESS_FIRST))

    def found(self) -> Iterator[Found]:
        """Yield maps near a guess, once; after that, the maps that the search beside found."""
        if not self._guessed:
            self._guessed = True
            yield from self._near_guess(
                self._beside.guess
                or self._fitting.paths.guessed_labels(self._visits.chart, self._asker.watch)
            )
        else:
            yield from self._found_beside()
            yield from self._improve_known_map()

    def _near_guess(self, guess: Sequence[int]) -> Iterator[Found]:
        """Maps near a guess, each with fewer dstates than the one before, and better paths."""
        failed = 0
        for labels in self._visits.near(guess):
            yield from self._improve_known_map()
            if labels is None:
                yield from self._found_beside()
            elif self._visits.known and len(set(labels)) >= len(set(self._visits.known)):
                break
            elif not (fits := (yield from self.known_if_it_has_paths(labels))):
                failed += 1
                if fits is None or failed == GUESSES:
                    break
                self._refuse(labels)
        yield from self._improve_known_map()

    def _improve_known_map(self) -> Iterator[Found]:
        """The known map with better paths, once, if there is time for that."""
        known, fitting = self._visits.known, self._fitting
        if (
            known
            and self._known_cost
            and len(fitting.task.theory.priorities) > 1
            and self._asker.watch.allows(fitting.preparing)
        ):
            cost, self._known_cost = self._known_cost, ()
            naming = Naming(self._visits.chart, list(known))
            maps = fitting.maps(naming, "opt", GUESSING, beside=self._beside.running)
            yield from (found for found in maps if found.cost < cost)

    def _found_beside(self) -> Iterator[Found]:
        """A map of the labels last found beside, if they are new and have paths."""
        if labels := self._beside.take_labels():
            yield from self.known_if_it_has_paths(labels)

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
