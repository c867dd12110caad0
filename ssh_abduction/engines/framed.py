"""An engine for the full theory where places have frames and fewest dstates come first: dstates first, then places and paths.

Frames tell so much that the dstates are all but settled before any place or path is: a turn rotates by known quarters, so whole visits are
the same or not (`steps/chart.py`). Which ones are is asked of visits.lp (`engines/visits.py`), which knows the causal axioms and how turns
rotate, but not the order of places on a path, or its sides. For what that leaves of the dstates, paths_framed.lp finds the fewest paths and
places.

*Claim.* Cut to which visits are at one place, a map of the full theory is an answer of visits.lp. So the fewest dstates of the latter are
a lower bound, and if some answer of that cost has streets, all minimal maps are among the answers of that cost with their least streets.
*If none has*, paths_framed.lp is asked which street shows it, and sides_framed.lp says for that street what order and sides demand of the visits
that are one. If no single street does, or visits are too many for that, paths_framed.lp is asked which labels clash: smallest sets of nodes at
dstates that no streets fit; visits.lp is told that these do not go together. As every map of the full theory keeps that, bounds still hold.

*Beside.* What takes long is guessed in another process, and the guess made a map (`engines/streets.py`). Near it, maps are made here, while
there it is proven with names, from the guess outwards, how many dstates the causal axioms need (`engines/nearby.py`). Where a map has so
few, it has the fewest; and the same names then list all ways to be at so few. Some of them fit no frame, which paths_framed.lp sees, or have no
streets; but each map of the full theory is among them.

*Which street.* In a world half explored the causal axioms allow fewer dstates than order and sides do, in thousands of ways: to forbid
these one by one does not end. What sides_framed.lp says of a single street takes a rule for each two visits that may be one, so it is said only of
streets that an answer contradicts.

*Listing.* Most of the time of a long list would go into reading answers. So an answer is asked for the atoms that it may hold, those of the
last answer first, and clingo searches for the next one while a map is made of it.
"""

from __future__ import annotations

import time
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import chain, combinations, islice

import clingo

from ssh_abduction.asp import facts
from ssh_abduction.asp.control import give_threads, mapped
from ssh_abduction.asp.limits import Watch
from ssh_abduction.asp.process import in_process
from ssh_abduction.engines.base import Found
from ssh_abduction.engines.nearby import Beside, NearbySearch
from ssh_abduction.engines.streets import Streets
from ssh_abduction.engines.visits import SameEngine, TakesLong, smaller
from ssh_abduction.guesses.merging import kept
from ssh_abduction.steps.chart import Chart, FramedChart, NoFrame, numbered
from ssh_abduction.steps.log import Log
from ssh_abduction.theory import encodings
from ssh_abduction.theory.speedups import Speedups
from ssh_abduction.theory.theory import Theory
from ssh_abduction.trace import Trace

CLASHES = 30  # that clingo is told of in one go
MANY_DSTATES = 50  # above which it is asked for single streets first
ALL_STREETS = 0.1  # times as long as single ones, about, for each dstate, all take to ground
PREPARED = 3.5  # times as long, until clasp has prepared to solve and can be stopped
MANY_PAIRS = 20_000  # visits that may be one, above which a street is too much to say: some forty rules for each of them
# clasp's way to list answers in which no atom that is shown can be spared:
SMALLEST = ("--heuristic=Domain", "--dom-mod=5,16", "--enum-mode=domRec")
KEPT = 10  # controls of minimal namings that are kept until their maps are listed: each is some megabytes
SOON = 3.0  # seconds without the fewest dstates after which a map near a guess is sought beside,
SOON_SHARE = 0.05  # or so much of a longer time limit, if that is less
GUESS_FIRST = 5.0  # the same, where that has to be done first
LATER = 4  # times as long, where clingo was not told of all visits,
LATER_SHARE = 0.25  # or so much of the time limit, if that is less
GUESSES = 20  # labels that are tried, near what annealing guesses
GUESSING = 1000  # conflicts after which better streets of these are no longer sought
BETTERING = 20_000  # conflicts after which better streets are no longer sought one after another


@dataclass(frozen=True)
class _Naming:
    """The dstate of each node, and a control for its streets, unless one is to be taken anew."""

    labels: list[int]
    control: clingo.Control | None


class FramedEngine(SameEngine):
    """The full theory with frames, fewest dstates first.

    soon  seconds without the fewest dstates after which a map near a guess is sought beside, at most; SOON if not given
    """

    lists_least = True

    def __init__(
        self,
        trace: Trace,
        theory: Theory,
        watch: Watch,
        log: Log,
        speedups: Speedups,
        around: Mapping[int, Sequence[int]] | None = None,
        soon: float | None = None,
    ) -> None:
        super().__init__(trace, theory, watch, log, speedups, around)
        self._soon = SOON if soon is None else soon
        self.paths = len(trace)  # names for paths are never short
        self._guess: list[int] | None = None  # labels of a map of the causal axioms
        self._guessed = False  # whether maps near the guess were sought
        self._known_cost: tuple[int, ...] = ()  # of the known map, until better streets were looked for
        self._beside: Beside | None = None  # a search that begins with the guess
        self._tried: list[int] | None = None  # labels found there, the last of which it is known whether they have streets
        self._named: NearbySearch | None = None  # what searches there
        self._street_seconds = 0.0  # what the last control for streets took, which cannot be stopped meanwhile
        self._framed = True  # whether the visits fit their frames
        self._best: tuple[tuple[int, ...], list[_Naming]] | None = None  # the minimal cost, and all namings that have it

    @property
    def _streets(self) -> Streets:
        return Streets(self._trace, self._theory, pinned=self._speedups.clique, check=self._watch.check)

    def grow(self, size: int) -> None:
        if size != self.size:
            self._best = None
            self._end_beside()
            self._guess, self._guessed, self._named, self._tried = None, False, None, None
            self._street_seconds = 0.0
        try:
            super().grow(size)
        except NoFrame:
            self._framed = False
            self.size = size

    def improving_maps(self, most: tuple[int, ...] = ()) -> Iterator[Found]:
        if not self._framed:
            return
        best: Found | None = None
        labels = yield from self._fewest_dstates()
        while labels is not None:
            best, named = self._some_streets(labels)
            if best is not None:
                yield best
                break
            self._forbid(labels)
            labels = yield from self._fewest_dstates()
        self._end_beside()
        if best is None or labels is None:
            return
        namings: list[_Naming] = []
        for other in chain([named], self._fitting(best.cost[0], besides=labels)):
            naming = other if other.control else replace(other, control=self._street_control(other.labels))
            for found in self._better_streets(naming):
                if found.cost < best.cost:
                    best, namings = found, []
                    yield best
            if found.cost == best.cost:
                namings.append(naming if len(namings) < KEPT else replace(naming, control=None))
        self._best = best.cost, namings

    def _fewest_dstates(self) -> Generator[Found, None, list[int] | None]:
        """The labels of `_minimal_labels`. Where they take long, maps that are soon found come before."""
        while True:
            try:
                return self._minimal_labels(self._has_news)
            except TakesLong:
                if not self._guessed:
                    self._guessed = True
                    yield from self._guesses(self._guess or self._streets.guessed_labels(self._chart, self._watch))
                else:
                    yield from self._news_beside()
                    yield from self._bettered()

    def _has_news(self) -> bool:
        """Whether there is a guess, or it is time for one; or what the search beside found is to be tried, or shows that the known map has fewest dstates."""
        if self._beside:
            self._heed(self._beside)
        if self._guessed:
            return self._labels_beside() is not None or (self._known is not None and self.bound == len(set(self._known)))
        if not self._speedups.annealed:
            return False
        waited = self._watch.elapsed()
        limit = waited + self._watch.left()
        soon = min(self._soon, SOON_SHARE * limit) if limit > self._soon else self._soon
        if not self._beside and waited > soon and self._has_processors():
            self._search_beside(self._chart)
        later = self._soon if self._knows_all else min(LATER * self._soon, LATER_SHARE * limit)
        return self._guess is not None or (not self._beside and waited > max(later, GUESS_FIRST))

    def _search_beside(self, chart: FramedChart) -> None:
        """Begin to guess beside this, and to prove from there that the causal axioms need so many dstates."""
        watch, pinned = Watch(beside=self._watch), self.clique or [0]
        apart = chart.apart(others=pinned)
        self._named = NearbySearch(
            watch,
            self._speedups,
            chart=chart,
            clique=pinned,
            may_be=[(~row).nonzero()[0].tolist() for row in apart],
            far=None,
        )

        self._beside = Beside(self._named, watch, self._fewer_labels(self._named, chart, watch))

    def _fewer_labels(self, named: NearbySearch, chart: FramedChart, watch: Watch) -> Iterator[list[int]]:
        """Labels, each time fewer, of maps of the causal axioms near a guess."""
        guessed_labels = self._streets.guessed_labels
        self._guess = in_process(guessed_labels, chart, watch=watch) if self._speedups.processes else guessed_labels(chart, watch)
        yield from named.fewer(self._guess)

    def map_of_guess(self) -> Found | None:
        """A map of the whole trace made of a guess, without a search: None where none is found soon."""
        try:
            self._chart = self._charted(len(self._trace))
        except NoFrame:
            return None
        return self._single_streets(self._streets.guessed_labels(self._chart, self._watch))

    def map_mended_from(self, known: Sequence[int]) -> Found | None:
        """A map of the whole trace in which the first steps keep these dstates, as far as can be, and all else is new, if that has streets."""
        chart = self._chart = Chart.framed(self._trace, self._log, around=self._around)
        guess = [-1] * len(chart.seen)
        for node, label in zip(chart.node_of, known, strict=False):
            guess[node] = label
        return self._single_streets(kept(chart.apart(), chart.links, guess))

    def _end_beside(self) -> None:
        if self._beside:
            self._beside.end()
            self._heed(self._beside)
            self._beside = None

    def _heed(self, beside: Beside) -> None:
        """Take what the search beside knows."""
        beside.check()
        self.bound = max(self.bound or 0, beside.bound)

    def settle(self) -> None:
        self._end_beside()

    def _labels_of(self, dstates: int) -> Generator[list[int], None, None]:
        named = self._named_at(dstates)
        yield from named.listed(self._watch) if named else super()._labels_of(dstates)

    def _named_at(self, dstates: int) -> NearbySearch | None:
        """What searched beside, if that alone showed that there are no fewer dstates."""
        return self._named if self._named and self._named.bound == dstates > self._least else None

    def _guesses(self, guess: Sequence[int]) -> Iterator[Found]:
        """Maps near a guess, if it leads to any, each with fewer dstates than the one before; and better streets for each."""
        failed = 0
        for labels in self._labels_near(guess):
            yield from self._bettered()
            if labels is None:
                yield from self._news_beside()
            elif self._known and len(set(labels)) >= len(set(self._known)):
                break
            elif not (fits := (yield from self._known_if_it_has_streets(labels))):
                failed += 1
                if fits is None or failed == GUESSES:
                    break
                self._forbid(labels)
        yield from self._bettered()

    def _bettered(self) -> Iterator[Found]:
        """The known map with better streets, unless these were looked for already, or there is no time for that."""
        if self._known and self._known_cost and len(self._theory.priorities) > 1 and self._watch.allows(self._preparing):
            cost, self._known_cost = self._known_cost, ()
            yield from (found for found in self._maps(_Naming(list(self._known), None), "opt", GUESSING) if found.cost < cost)

    def _news_beside(self) -> Iterator[Found]:
        """A map of the labels last found beside, if they are new and have streets."""
        if labels := self._labels_beside():
            self._tried = labels
            yield from self._known_if_it_has_streets(labels)

    def _labels_beside(self) -> list[int] | None:
        """The labels last found beside, if they were not tried yet, and have fewer dstates than the known map."""
        labels = self._beside.labels if self._beside else None
        if labels is self._tried or not labels or (self._known and len(set(labels)) >= len(set(self._known))):
            return None
        return labels

    def _known_if_it_has_streets(self, labels: Sequence[int]) -> Generator[Found, None, bool | None]:
        """The map of these labels, from now on the known one, if any streets fit them. Returns whether they do; None if there is no time to see that."""
        found = self._soon_streets(labels)
        if found is None:
            if not self._watch.allows(self._preparing):
                return None
            found, _ = self._all_streets(labels)
        if found is None:
            return False
        self._known, self._known_cost = tuple(numbered(labels)), found.cost
        yield found
        return True

    def maps_of_cost(self, cost: tuple[int, ...], enough: int) -> Iterator[Found]:
        if not self._framed:
            return
        namings = self._best[1] if self._best and self._best[0] == cost else self._fitting(cost[0])
        mode = f"enum,{','.join(map(str, (0, *cost[1:])))}"
        yield from islice((found for naming in namings for found in self._maps(naming, mode)), enough or None)

    def _fitting(self, dstates: int, besides: Sequence[int] = ()) -> Iterator[_Naming]:
        """All ways to be at so many dstates that have streets, each once, and not that one."""
        known = {tuple(besides)}
        while True:
            refused: list[int] | None = None
            with closing(self._labels_of(dstates)) as all_labels:
                for labels in all_labels:
                    if tuple(labels) in known:
                        continue
                    found, naming = self._some_streets(labels)
                    known.add(tuple(labels))
                    if found is not None:
                        yield naming
                    elif not self._named_at(dstates):
                        refused = labels
                        break
            if refused is None:
                return
            self._forbid(refused)

    def _some_streets(self, labels: Sequence[int]) -> tuple[Found | None, _Naming]:
        """A map with these dstates, if any streets fit them."""
        found = self._soon_streets(labels)
        return (found, _Naming(list(labels), None)) if found else self._all_streets(labels)

    def _soon_streets(self, labels: Sequence[int]) -> Found | None:
        """A map with these dstates, where they are many and there is one in which no two places or stretches are taken for one."""
        return self._single_streets(labels) if len(set(labels)) > MANY_DSTATES else None

    def _all_streets(self, labels: Sequence[int]) -> tuple[Found | None, _Naming]:
        """A map with these dstates, if any streets fit them, and a control for all of them."""
        naming = _Naming(list(labels), self._street_control(labels))
        return next(self._maps(naming, "ignore"), None), naming

    def _single_streets(self, labels: Sequence[int]) -> Found | None:
        """A map with these dstates in which no two places or stretches are taken for one, unless they have to be; if there is one."""
        naming = _Naming(list(labels), self._street_control(labels, single=True))
        return next(self._maps(naming, "ignore"), None)

    def _better_streets(self, naming: _Naming) -> Iterator[Found]:
        """Maps with these dstates, each as good as the one before or better, the last one best; none if no streets fit them.

        Where bettering maps does not end soon, the bound is raised from below instead.
        """
        if len(self._theory.priorities) == 1:
            yield from self._maps(naming, "ignore")
            return
        proven = yield from self._maps(naming, "opt", BETTERING)
        if not proven:
            control = self._street_control(naming.labels, ["--opt-strategy=usc"])
            yield from self._maps(replace(naming, control=control), "opt")

    def _maps(self, naming: _Naming, mode: str, conflicts: int = -1) -> Generator[Found, None, bool]:
        """Maps with these dstates. Returns whether clingo came to an end, and not to the limit of conflicts."""
        control = naming.control or self._street_control(naming.labels)
        alone = mode == "opt" and len(set(naming.labels)) > MANY_DSTATES and not self._beside and self._has_processors()
        give_threads(control, two=alone)  # which keep all that they list
        reader = facts.StreetReader(control, self._trace, self._theory, self._chart, naming.labels)
        answers = self._answers(reader.read, mode, int(mode == "ignore"), control=control, conflicts=conflicts, ahead=True)
        return (yield from mapped(lambda answer: Found.of(reader.map_of(answer), self._theory), answers))

    @property
    def _preparing(self) -> float:
        """Seconds, about, until clingo can be stopped that is asked for all streets."""
        return PREPARED * self._street_seconds

    def _street_control(
        self, labels: Sequence[int], options: Sequence[str] = (), nodes: Iterable[int] | None = None, *, single: bool = False
    ) -> clingo.Control:
        """A control for the streets that fit the labels of all nodes, or of these; or only for single ones, none of which is taken for another."""
        self._watch.check(0.0 if single else self._preparing)
        began, worked = time.perf_counter(), time.thread_time()
        control = self._streets.settled(self._chart, labels, options, nodes, single=single)
        self._watch.check()
        seconds = time.thread_time() - worked  # of this thread: the one beside may have made it wait
        self._street_seconds = (self._street_seconds or ALL_STREETS * len(set(labels)) * seconds) if single else seconds
        self.ground_seconds += time.perf_counter() - began
        return control

    def _forbid(self, labels: Sequence[int]) -> None:
        """Tell clingo why there are no streets for these labels."""
        self._refuse(labels)
        if self._speedups.sides and len(self._fits) <= MANY_PAIRS and self._say_street(labels):
            return
        rules = []
        clashes = self._clashing(labels)
        if unknown := {self._chart.facing[node][0] for clash in clashes for node in clash} - self._visits:
            self._give_more(unknown)
        for clash in clashes:
            first = {labels[node]: node for node in clash}
            different = [pair for a, b in combinations(first.values(), 2) if (pair := self._pair(a, b)) in self._fits]
            if self._fits.issuperset(together := self._spanning(labels, clash)):  # else clingo knows by now
                rules.append(facts.forbidden_pairs(together, different))
        self._tell("\n".join(rules))

    def _say_street(self, labels: Sequence[int]) -> bool:
        """Say what order and sides demand of a street that these labels contradict. False if all such streets have been told of."""
        control = self._streets.control(self._chart)
        control.add("base", [], facts.settled_labels(enumerate(labels)))
        control.ground([("base", []), ("again", []), ("contrary", [])])
        contrary, twice = next(self._answers(facts.read_contrary, "ignore", 1, control=control))
        stand = {labels[node]: self._chart.facing[node] for node in self._place_of}
        if any(self._say_once("street", *stand[dstate]) for dstate in contrary):
            return True
        for visit in (stand[dstate][0] for dstate in twice):
            said = [self._say_once("street", visit, 0), self._say_once("street", visit, 1), self._say_once("crossing", visit, self._batch)]
            if any(said):
                return True
        return False

    def _say_once(self, part: str, *arguments: int) -> bool:
        """Ground a part of sides_framed.lp, unless it was before. Returns whether it was not."""
        if (part, arguments) in self._said:
            return False
        began = time.perf_counter()
        batches = range(self._batch + 1)
        if not self._said:
            self._control.load(encodings.path("sides_framed"))
            self._control.add("sides", [], facts.side_facts(self._theory))
            self._control.ground([("sides", []), *(("streets", facts.numbers(batch)) for batch in batches)])
        self._said[part, arguments] = None
        if part == "street":
            self._control.ground([(part, facts.numbers(*arguments, batch)) for batch in batches])
        else:
            self._control.ground([(part, facts.numbers(*arguments))])
        self.ground_seconds += time.perf_counter() - began
        return True

    def _begin(self, chart: FramedChart) -> None:
        super()._begin(chart)
        self._said: dict[tuple[str, tuple[int, ...]], None] = {}  # parts of sides_framed.lp

    def _give(self, chart: FramedChart, visits: set[int], order: Iterable[int], *, anew: bool = False) -> None:
        super()._give(chart, visits, order, anew=anew)
        if self._said:
            streets = [(part, facts.numbers(*arguments, self._batch)) for part, arguments in self._said if part == "street"]
            self._control.ground([("streets", facts.numbers(self._batch)), *streets])

    def _clashing(self, labels: Sequence[int]) -> list[list[int]]:
        """Sets of nodes whose labels no streets fit, of none of which a node can be spared: CLASHES of them at most."""
        control = self._streets.control(self._chart, SMALLEST)
        control.add("base", [], facts.open_labels(labels))
        control.ground([("base", [])])
        clashes = list(self._answers(lambda model: sorted(facts.read_names(model)), "ignore", CLASHES, control=control))
        return clashes or [self._clash(labels)]

    def _clash(self, labels: Sequence[int]) -> list[int]:
        """One such set, where it takes the choices of paths_framed.lp to see that there are no streets: nodes are left out while there are none."""

        def clashing(nodes: list[int]) -> list[int] | None:
            control = self._street_control(labels, nodes=nodes)
            return next(self._answers(lambda _: None, "ignore", 1, control=control), nodes)

        return smaller(list(range(len(labels))), clashing)

    def _charted(self, size: int) -> FramedChart:
        """The nodes, and which of them are at different places because of what the trace alone says of order and sides."""
        chart = Chart.framed(self._trace, self._log, size, self._around)
        nodes = range(len(chart.seen))
        control = self._streets.telling(chart, nodes, nodes)
        self._watch.check()
        _, elsewhere, _ = next(self._answers(facts.read_told, "ignore", 1, control=control))
        return chart.with_elsewhere(elsewhere)
