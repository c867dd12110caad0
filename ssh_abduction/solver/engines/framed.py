"""An engine for the topological theory where places have frames and fewest dstates come first: dstates first, then places and paths.

Frames tell so much that the dstates are all but settled before any place or path is: a turn rotates by known quarters, so whole visits are
the same or not (`steps/chart.py`). Which ones are is asked of visits.lp (`engines/visit_labels.py`), which knows the causal axioms and how turns
rotate, but not the order of places on a path, or its sides. For what that leaves of the dstates, paths_framed.lp finds the fewest paths and
places.

*Claim.* Cut to which visits are at one place, a map of the topological theory is an answer of visits.lp. So the fewest dstates of the latter are
a lower bound, and if some answer of that cost has paths, all minimal maps are among the answers of that cost with their least paths.
*If none has*, paths_framed.lp is asked which path shows it, and sides_framed.lp says for that path what order and sides demand of the visits
that are one. If no single path does, or visits are too many for that, paths_framed.lp is asked which labels clash: smallest sets of nodes at
dstates that no paths fit; visits.lp is told that these do not go together. As every map of the topological theory keeps that, bounds still hold.

*Beside.* What takes long is guessed in another process, and the guess made a map (`engines/paths.py`). Near it, maps are made here, while
there it is proven with names, from the guess outwards, how many dstates the causal axioms need (`engines/nearby.py`). Where a map has so
few, it has the fewest; and the same names then list all ways to be at so few. Some of them fit no frame, which paths_framed.lp sees, or have no
paths; but each map of the topological theory is among them.

*Which path.* In a world half explored the causal axioms allow fewer dstates than order and sides do, in thousands of ways: to forbid
these one by one does not end. What sides_framed.lp says of a single path takes a rule for each two visits that may be one, so it is said only of
paths that an answer contradicts.

*Listing.* Most of the time of a long list would go into reading answers. So an answer is asked for the atoms that it may hold, those of the
last answer first, and clingo searches for the next one while a map is made of it.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice

import clingo

from ssh_abduction.solver.asp.control import Asker, give_threads, mapped
from ssh_abduction.solver.asp.facts import names_lp, path_reader, paths_lp
from ssh_abduction.solver.asp.limits import Watch
from ssh_abduction.solver.asp.process import in_process
from ssh_abduction.solver.engines.base import Found, Task, next_charted_size
from ssh_abduction.solver.engines.doubts import Settled
from ssh_abduction.solver.engines.nearby import Beside, NearbySearch
from ssh_abduction.solver.engines.paths import Paths
from ssh_abduction.solver.engines.pinned import Pinned
from ssh_abduction.solver.engines.refusing import all_accepted, first_accepted_of, smaller
from ssh_abduction.solver.engines.sides import FramedSides
from ssh_abduction.solver.engines.visit_labels import OPEN, VisitLabels
from ssh_abduction.solver.guesses.merging import kept
from ssh_abduction.solver.steps.chart import Chart, FramedChart, numbered
from ssh_abduction.theory.evidence import Equality

# Clingo is told of so many clashes in one go: each spares a question, and one control of paths lists them all.
CLASHES = 30
# Labels with more dstates than this are tried with separate paths first, as to ground all ways to merge paths takes long.
MANY_DSTATES = 50
# All ways to merge paths take so many times as long to ground as separate paths, about, for each dstate.
ALL_PATHS = 0.1
# So many times as long as grounding took it is until clasp has prepared to solve, and can be stopped.
PREPARED = 3.5
# With more pairs of visits that may be one, nothing is said of single paths: that takes some forty rules for each pair.
MANY_PAIRS = 20_000
# So many controls of minimal labels are kept until their maps are listed: each is some megabytes, and is made again in seconds.
KEPT = 10
# After so many seconds without the fewest dstates a map near a guess is sought beside: most traces are solved by then.
SOON = 3.0
# Or after such a share of the time limit, if that is less, so that the guess has time to be of use.
SOON_SHARE = 0.05
# Without a second processor a map near a guess is sought after so many seconds, as clingo waits meanwhile.
GUESS_FIRST = 5.0
# That is after so many times as long where clingo was not told of all visits: it is soon told of more.
LATER = 4
# Or after such a share of the time limit, if that is less.
LATER_SHARE = 0.25
# So many labels near a guess are tried, at most, until some have paths.
GUESSES = 20
# After so many conflicts better paths for a map near a guess are no longer sought: fewer dstates matter more.
GUESSING = 1000
# After so many conflicts better paths are no longer sought one after another; the bound is raised from below instead.
BETTERING = 20_000


@dataclass(frozen=True)
class _Naming:
    """The dstate of each node, and a control for its paths, unless one is to be taken anew."""

    labels: list[int]
    control: clingo.Control | None


@dataclass(frozen=True)
class _Fitted:
    """Labels that have paths, and a map that has these labels."""

    found: Found
    naming: _Naming


class FramedEngine:
    """The topological theory with frames, fewest dstates first."""

    lists_least = True
    goes_on = True

    def __init__(
        self, task: Task, around: Mapping[int, Sequence[int]] | None = None, soon: float = SOON
    ) -> None:
        """An engine for no steps yet.

        around  as in `Chart.framed`, where steps have no stars
        soon    seconds without the fewest dstates after which a map near a guess is sought beside, at most
        """
        self.asker = Asker(task.watch)
        self.intact = True
        self.paths = len(task.trace)  # names for paths are never short
        self._task, self._around, self._soon = task, around, soon
        self._sides = FramedSides(task.theory, self.asker)
        self._visits = VisitLabels(task, self.asker, self._charted, self._sides)
        self._unframed_size = 0  # how many steps there are where they fit no frames
        self._framed = True  # whether the visits fit their frames
        self._forbidden: list[Collection[Equality]] = []  # what evidence found out cannot all hold
        self._forget()

    def _forget(self) -> None:
        """Nothing is known of maps of this prefix yet."""
        self._guess: list[int] | None = None  # labels of a map of the causal axioms
        self._guessed = False  # whether maps near the guess were sought
        self._known_cost: tuple[
            int, ...
        ] = ()  # of the known map, until better paths were looked for
        self._beside: Beside | None = None  # a search that begins with the guess, in another thread
        self._tried: list[int] | None = (
            None  # labels found there, the last of which it is known whether they have paths
        )
        self._named: NearbySearch | None = None  # what searches there
        self._path_seconds = (
            0.0  # what the last control for paths took, which cannot be stopped meanwhile
        )
        self._best: tuple[tuple[int, ...], list[_Naming]] | None = (
            None  # the minimal cost, and all namings that have it
        )

    @property
    def size(self) -> int:
        return self._visits.size if self._framed else self._unframed_size

    @property
    def bound(self) -> int | None:
        return self._visits.bound

    @property
    def _paths(self) -> Paths:
        pinned, check = self._task.speedups.clique, self.asker.watch.check
        return Paths(
            self._task.trace,
            self._task.theory,
            pinned=pinned,
            check=check,
            forbidden=tuple(self._forbidden),
        )

    def with_paths(self, paths: int) -> FramedEngine:
        return FramedEngine(self._task, self._around, self._soon)

    def over(self, task: Task) -> FramedEngine:
        self._task, self.asker.watch = task, task.watch
        self._visits.work_on(task)
        self.asker.ground_seconds = self.asker.solve_seconds = 0.0
        return self

    def next_size(self, failed: int) -> int:
        return next_charted_size(self.size, failed, len(self._task.trace))

    @property
    def size_to_go_on(self) -> int:
        return self.next_size(self.size)

    def grow(self, size: int) -> None:
        if size != self.size:
            self._end_beside()
            self._forget()
        self._framed = self._visits.grow(size)
        self._unframed_size = size

    def improving_maps(self, most: tuple[int, ...] = ()) -> Iterator[Found]:
        if not self._framed:
            return
        first = yield from self._first_with_paths()
        self._end_beside()
        if first is None:
            return
        best = first.found
        yield best
        namings: list[_Naming] = []
        for other in chain(
            [first.naming], self._all_with_paths(best.cost[0], besides=first.naming.labels)
        ):
            naming = (
                other if other.control else replace(other, control=self._path_control(other.labels))
            )
            for found in self._better_paths(naming):
                if found.cost < best.cost:
                    best, namings = found, []
                    yield best
            if found.cost == best.cost:
                namings.append(naming if len(namings) < KEPT else replace(naming, control=None))
        self._best = best.cost, namings

    def _first_with_paths(self) -> Generator[Found, None, _Fitted | None]:
        """The first labels with the fewest dstates that have paths; where they take long, maps that are soon found come before."""
        fitted: list[_Fitted] = []

        def ask() -> Generator[Found, None, list[int] | None]:
            while (labels := self._visits.fewest(self._should_interrupt)) is OPEN:
                yield from self._maps_found_soon()
            return labels

        def why_not(labels: list[int]) -> list[int] | None:
            found = self._some_paths(labels)
            fitted.extend([found] if found else [])
            return None if found else labels

        yield from first_accepted_of(ask, why_not, self._forbid)
        return fitted[0] if fitted else None

    def _maps_found_soon(self) -> Iterator[Found]:
        """Maps near a guess, once; and then what came of the search beside this one."""
        if not self._guessed:
            self._guessed = True
            yield from self._near_guess(
                self._guess or self._paths.guessed_labels(self._chart, self.asker.watch)
            )
        else:
            yield from self._maps_found_beside()
            yield from self._improve_known_map()

    def _should_interrupt(self) -> bool:
        """Whether there is a guess, or it is time for one; or what the search beside found is to be tried, or shows that the known map has fewest dstates."""
        if self._beside:
            self._absorb(self._beside)
        if self._guessed:
            known = self._visits.known
            return self._labels_beside() is not None or (
                known is not None and self.bound == len(set(known))
            )
        if not self._task.speedups.annealed or self._visits.has_forbidden:
            return False
        waited = self.asker.watch.elapsed()
        limit = waited + self.asker.watch.left()
        soon = min(self._soon, SOON_SHARE * limit) if limit > self._soon else self._soon
        if not self._beside and waited > soon and self._task.has_processors:
            self._search_beside(self._chart)
        later = (
            self._soon
            if self._visits.program.knows_all
            else min(LATER * self._soon, LATER_SHARE * limit)
        )
        return self._guess is not None or (not self._beside and waited > max(later, GUESS_FIRST))

    def _search_beside(self, chart: FramedChart) -> None:
        """Begin to guess beside this, and to prove from there that the causal axioms need so many dstates."""
        watch = Watch(beside=self.asker.watch)
        pinned = Pinned.framed(chart, self._visits.clique or [0])
        self._named = NearbySearch(watch, self._task.speedups, pinned, far=None)
        self._beside = Beside(self._named, watch, self._fewer_labels(self._named, chart, watch))

    def _fewer_labels(
        self, named: NearbySearch, chart: FramedChart, watch: Watch
    ) -> Iterator[list[int]]:
        """Labels, each time fewer, of maps of the causal axioms near a guess."""
        guessed_labels = self._paths.guessed_labels
        self._guess = (
            in_process(guessed_labels, chart, watch=watch)
            if self._task.speedups.processes
            else guessed_labels(chart, watch)
        )
        yield from named.fewer(self._guess)

    def map_of_guess(self) -> Found | None:
        """A map of the whole trace made of a guess, without a search: None where none is found soon."""
        chart = self._charted(len(self._task.trace), None)
        return (
            None
            if chart is None
            else self._separate_paths(self._paths.guessed_labels(chart, self.asker.watch), chart)
        )

    def map_mended_from(self, known: Sequence[int]) -> Found | None:
        """A map of the whole trace in which the first steps keep these dstates, as far as can be, and all else is new, if that has paths."""
        chart = Chart.framed(self._task.trace, self._task.log, around=self._around)
        if chart is None:
            return None
        guess = [-1] * len(chart.seen)
        for node, label in zip(chart.node_of, known, strict=False):
            guess[node] = label
        return self._separate_paths(kept(chart.apart(), chart.links, guess), chart)

    def _end_beside(self) -> None:
        if self._beside:
            self._beside.end()
            self._absorb(self._beside)
            self._beside = None

    def _absorb(self, beside: Beside) -> None:
        """Take what the search beside knows."""
        beside.check()
        self._visits.bound = max(self._visits.bound or 0, beside.bound)

    def settle(self) -> None:
        self._end_beside()

    def _all_labels(self, dstates: int) -> Generator[list[int], None, None]:
        """All labels with so many dstates."""
        named = self._named_at(dstates)
        yield from named.listed(self.asker.watch) if named else self._visits.all_of(dstates)

    def _named_at(self, dstates: int) -> NearbySearch | None:
        """What searched beside, if that alone showed that there are no fewer dstates."""
        return (
            self._named
            if self._named and self._named.bound == dstates > self._visits.program.cores.least
            else None
        )

    def _near_guess(self, guess: Sequence[int]) -> Iterator[Found]:
        """Maps near a guess, if it leads to any, each with fewer dstates than the one before; and better paths for each."""
        failed = 0
        for labels in self._visits.near(guess):
            yield from self._improve_known_map()
            if labels is None:
                yield from self._maps_found_beside()
            elif self._visits.known and len(set(labels)) >= len(set(self._visits.known)):
                break
            elif not (fits := (yield from self._known_if_it_has_paths(labels))):
                failed += 1
                if fits is None or failed == GUESSES:
                    break
                self._forbid(labels)
        yield from self._improve_known_map()

    def _improve_known_map(self) -> Iterator[Found]:
        """The known map with better paths, unless these were looked for already, or there is no time for that."""
        known = self._visits.known
        if (
            known
            and self._known_cost
            and len(self._task.theory.priorities) > 1
            and self.asker.watch.allows(self._preparing)
        ):
            cost, self._known_cost = self._known_cost, ()
            yield from (
                found
                for found in self._maps(_Naming(list(known), None), "opt", GUESSING)
                if found.cost < cost
            )

    def _maps_found_beside(self) -> Iterator[Found]:
        """A map of the labels last found beside, if they are new and have paths."""
        if labels := self._labels_beside():
            self._tried = labels
            yield from self._known_if_it_has_paths(labels)

    def _labels_beside(self) -> list[int] | None:
        """The labels last found beside, if they were not tried yet, and have fewer dstates than the known map."""
        labels, known = self._beside.labels if self._beside else None, self._visits.known
        if labels is self._tried or not labels or (known and len(set(labels)) >= len(set(known))):
            return None
        return labels

    def _known_if_it_has_paths(self, labels: Sequence[int]) -> Generator[Found, None, bool | None]:
        """The map of these labels, from now on the known one, if any paths fit them. Returns whether they do; None if there is no time to see that."""
        fitted = self._paths_found_soon(labels)
        if fitted is None:
            if not self.asker.watch.allows(self._preparing):
                return None
            fitted = self._any_paths(labels)
        if fitted is None:
            return False
        self._visits.known, self._known_cost = tuple(numbered(labels)), fitted.found.cost
        yield fitted.found
        return True

    def maps_of_cost(self, cost: tuple[int, ...], enough: int) -> Iterator[Found]:
        if not self._framed:
            return
        namings = (
            self._best[1] if self._best and self._best[0] == cost else self._all_with_paths(cost[0])
        )
        mode = f"enum,{','.join(map(str, (0, *cost[1:])))}"
        yield from islice(
            (found for naming in namings for found in self._maps(naming, mode)), enough or None
        )

    def labellings(self, cost: tuple[int, ...]) -> Iterator[Settled]:
        if not self._framed:
            return
        mode = f"enum,{','.join(map(str, (0, *cost[1:])))}"
        for naming in (
            self._best[1] if self._best and self._best[0] == cost else self._all_with_paths(cost[0])
        ):
            control = naming.control or self._path_control(naming.labels)
            reader = path_reader.PathReader(
                control, self._task.trace, self._task.theory, self._chart, naming.labels
            )
            settled = Settled(self.asker, control, mode, reader, reader.map_of)
            if settled.has_map():
                yield settled

    def _all_with_paths(self, dstates: int, besides: Sequence[int] = ()) -> Iterator[_Naming]:
        """All labels with so many dstates that have paths, each once, and not those."""
        fitted: dict[tuple[int, ...], _Fitted] = {}

        def why_not(labels: list[int]) -> list[int] | None:
            if (found := self._some_paths(labels)) is None:
                return labels
            fitted[tuple(labels)] = found
            return None

        if self._named_at(
            dstates
        ):  # what searches beside is not told why labels have no paths; it lists each anyway
            known = {tuple(besides)}
            for labels in self._all_labels(dstates):
                if tuple(labels) not in known and (found := self._some_paths(labels)) is not None:
                    yield found.naming
                known.add(tuple(labels))
            return
        for labels in all_accepted(
            lambda: self._all_labels(dstates),
            why_not,
            self._forbid,
            key=tuple,
            known={tuple(besides)},
        ):
            yield fitted.pop(tuple(labels)).naming

    def _some_paths(self, labels: Sequence[int]) -> _Fitted | None:
        """A map with these dstates, if any paths fit them."""
        return self._paths_found_soon(labels) or self._any_paths(labels)

    def _paths_found_soon(self, labels: Sequence[int]) -> _Fitted | None:
        """A map with these dstates, where they are many and there is one in which no two places or segments are taken for one."""
        found = (
            self._separate_paths(labels, self._chart) if len(set(labels)) > MANY_DSTATES else None
        )
        return _Fitted(found, _Naming(list(labels), None)) if found else None

    def _any_paths(self, labels: Sequence[int]) -> _Fitted | None:
        """A map with these dstates, if any paths fit them, and a control for all of them."""
        naming = _Naming(list(labels), self._path_control(labels))
        found = next(self._maps(naming, "ignore"), None)
        return _Fitted(found, naming) if found else None

    def _separate_paths(self, labels: Sequence[int], chart: FramedChart) -> Found | None:
        """A map with these dstates in which no two places or segments are taken for one, unless they have to be; if there is one."""
        naming = _Naming(list(labels), self._path_control(labels, single=True, chart=chart))
        return next(self._maps(naming, "ignore", chart=chart), None)

    def _better_paths(self, naming: _Naming) -> Iterator[Found]:
        """Maps with these dstates, each as good as the one before or better, the last one best; none if no paths fit them.

        Where bettering maps does not end soon, the bound is raised from below instead.
        """
        if len(self._task.theory.priorities) == 1:
            yield from self._maps(naming, "ignore")
            return
        proven = yield from self._maps(naming, "opt", BETTERING)
        if not proven:
            control = self._path_control(naming.labels, ["--opt-strategy=usc"])
            yield from self._maps(replace(naming, control=control), "opt")

    def _maps(
        self, naming: _Naming, mode: str, conflicts: int = -1, chart: FramedChart | None = None
    ) -> Generator[Found, None, bool]:
        """Maps with these dstates. Returns whether clingo came to an end, and not to the limit of conflicts."""
        control = naming.control or self._path_control(naming.labels)
        alone = (
            mode == "opt"
            and len(set(naming.labels)) > MANY_DSTATES
            and not self._beside
            and self._task.has_processors
        )
        give_threads(control, two=alone)  # which keep all that they list
        reader = path_reader.PathReader(
            control, self._task.trace, self._task.theory, chart or self._chart, naming.labels
        )
        answers = self.asker.answers(
            reader.read,
            mode,
            int(mode == "ignore"),
            control=control,
            conflicts=conflicts,
            ahead=True,
        )
        return (
            yield from mapped(
                lambda answer: Found.of(reader.map_of(answer), self._task.theory), answers
            )
        )

    @property
    def _preparing(self) -> float:
        """Seconds, about, until clingo can be stopped that is asked for all paths."""
        return PREPARED * self._path_seconds

    def _path_control(
        self,
        labels: Sequence[int],
        options: Sequence[str] = (),
        nodes: Iterable[int] | None = None,
        *,
        single: bool = False,
        chart: FramedChart | None = None,
    ) -> clingo.Control:
        """A control for the paths that fit the labels of all nodes, or of these; or only for separate ones, none of which is taken for another."""
        self.asker.watch.check(0.0 if single else self._preparing)
        worked = time.thread_time()
        with self.asker.grounding_timed():
            control = self._paths.settled(
                chart or self._chart, labels, options, nodes, single=single
            )
        self.asker.watch.check()
        seconds = (
            time.thread_time() - worked
        )  # of this thread: the one beside may have made it wait
        self._path_seconds = (
            (self._path_seconds or ALL_PATHS * len(set(labels)) * seconds) if single else seconds
        )
        return control

    def _forbid(self, labels: Sequence[int]) -> None:
        """Tell clingo why there are no paths for these labels."""
        self._visits.take_back(labels)
        told = (
            self._task.speedups.sides
            and len(self._visits.program.fits) <= MANY_PAIRS
            and self._sides.say_of_path(
                self._paths, self._chart, labels, self._visits.program.standing(labels)
            )
        )
        if not told:
            self._visits.forbid(labels, self._clashing(labels))

    def forbid(self, equalities: Collection[Equality]) -> bool:
        self._end_beside()
        self._best, self._named, self._tried = None, None, None
        self._forbidden.append(equalities)
        nodes = [
            (self._chart.node_of[equality.first], self._chart.node_of[equality.second], equality.of)
            for equality in equalities
        ]
        self._visits.forbid_together(
            [(a, b) for a, b, of in nodes if of == "dstate"],
            [(a, b) for a, b, of in nodes if of == "place"],
        )
        return True

    def _clashing(self, labels: Sequence[int]) -> list[list[int]]:
        """Minimal conflicting sets of nodes: no paths fit the labels of any of these sets. At most CLASHES of them."""
        control = self._paths.clashing(self._chart, labels)
        clashes = list(
            self.asker.answers(
                lambda model: sorted(names_lp.read_names(model)), "ignore", CLASHES, control=control
            )
        )
        return clashes or [self._clash(labels)]

    def _clash(self, labels: Sequence[int]) -> list[int]:
        """One such set, where it takes the choices of paths_framed.lp to see that there are no paths: nodes are left out while there are none."""

        def clashing(nodes: list[int]) -> list[int] | None:
            control = self._path_control(labels, nodes=nodes)
            return next(self.asker.answers(lambda _: None, "ignore", 1, control=control), nodes)

        return smaller(list(range(len(labels))), clashing)

    @property
    def _chart(self) -> FramedChart:
        return self._visits.chart

    def _charted(self, size: int, before: FramedChart | None) -> FramedChart | None:
        """The nodes of the first steps, and which of them are at different places because of what the trace alone says of order and sides.

        before  the chart of fewer steps: it says of its nodes which are at different places, and nothing more is asked
        """
        chart = Chart.framed(self._task.trace, self._task.log, size, self._around)
        if chart is None or before is not None:
            return chart and before and chart.with_elsewhere(before.elsewhere)
        nodes = range(len(chart.seen))
        control = self._paths.telling(chart, nodes, nodes)
        self.asker.watch.check()
        _, elsewhere, _ = next(self.asker.answers(paths_lp.read_told, "ignore", 1, control=control))
        return chart.with_elsewhere(elsewhere)
