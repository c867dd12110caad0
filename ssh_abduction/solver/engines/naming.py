"""An engine for the causal theory on long traces: the dstates have names before clingo is asked.

As many steps as are pairwise apart (`steps/apart.py`) are pinned to names of their own. That bounds the number of dstates from below,
leaves no two ways to name these dstates, and lets every other step choose only among the names that it is not apart from. A view has a few
spare names, at the cost of one dstate each, and a *rest*, which stands for all dstates of the view beyond them. There may be several
largest cliques; the one that is pinned has steps that are apart from most others, so that the other steps have the fewest names left.

*Claim.* A map of minimal cost that uses no rest is a minimal map, and its cost is the minimum.
*Proof.* Name the dstates of any map: those of the pinned steps as pinned, the others by spare names of their view as far as these
reach, then by the rest. This keeps every rule of names.lp, as a rest asks nothing of the steps at it, and costs at most as many spare
names as the map has dstates beyond the clique. So the cost found is a lower bound; a map without a rest is a map of the trace, and
reaches it. ∎ A minimal answer that does use a rest is asked for again, with one more spare name for its view.

Not every step is needed. The control starts with the links of the pinned steps; an answer is followed along the trace, and the links
at which it fails are added, until one holds everywhere. That is a relaxation until then, so its bounds hold. Where clingo does not
answer soon, what is missing is rather more knowledge than less, and all links are given at once.

clasp raises the bound core by core: a core is a set of spare names that cannot all be left unused. Cores are small at first, as the names
of a view are its own: what different corners of the world need adds up.

Of a long trace, whose steps are too many to be compared in pairs, as many are taken as it takes for the clique to be as large as that of all; and what
conflicts ask for is given a thousand links at a time.

Beside all that small maps are sought in a thread of its own. First steps are merged by evidence (`guesses/merging.py`), so that a limit
leaves a map that is not bad; then a map is guessed, of places with frames where the trace lets itself be taken for one of these
(`guesses/annealing.py`), and smaller ones are sought near it (`engines/nearby.py`). Of a long trace the beginning is guessed, and what
comes of that followed along the rest (`guesses/continuing.py`). Whatever bound meets these maps ends the search. Where there is but one
processor, steps are merged at once, and the guess waits until raising the bound by cores takes long. Where there is no such search, clasp
has the second processor: two threads, which tell each other what they learn. Which minimal maps come first may then differ from run to run;
all of them are the same.

To read an answer takes Python longer than clingo takes to find it. So an answer is asked only for the atoms that it may hold: where actions
lead, from which the step after each step follows. While a map is made of one answer, clingo searches for the next.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain, islice
from typing import Protocol, TypeAlias

import clingo
import numpy as np

from ssh_abduction.solver.asp.control import Asker, give_threads, new_control
from ssh_abduction.solver.asp.facts import names_lp
from ssh_abduction.solver.asp.facts.atoms import numbers
from ssh_abduction.solver.asp.limits import POLL, LimitError, Watch
from ssh_abduction.solver.engines.base import AT_ONCE, Task
from ssh_abduction.solver.engines.nearby import (
    AT_A_TIME,
    SECONDS_A_CHARACTER,
    Beside,
    NearbySearch,
    mended,
)
from ssh_abduction.solver.engines.refusing import first_accepted_of
from ssh_abduction.solver.guesses.annealing import annealed, annealed_steps
from ssh_abduction.solver.guesses.continuing import followed
from ssh_abduction.solver.guesses.merging import merged, merged_near, thinned
from ssh_abduction.solver.steps.apart import Continuations
from ssh_abduction.solver.steps.chart import Chart, Link, numbered

# So many maps are kept until clingo was given all links; then they stream. Until then each answer may turn out to need a link that clingo does not know.
HELD_BACK = 100
# Clingo takes so much of the time that grounding took before it begins to solve, and can be stopped.
PREPARING = 0.6
# So many spare names a view has to begin with: one that is used, and one that shows that no more are needed.
SPARES = 2
# After so many conflicts clingo is given more links: that few do not decide much by themselves shows soon.
PATIENCE = 2000
# So many links of a long trace clingo is given then; of others it is given all, as few are left.
MORE_LINKS = 1000
# After so many conflicts with all links a map near a guess is sought, if none is sought beside; then clingo goes on for as long as it takes.
CORES = 10_000
# So many guesses are made until one is a map, where the robot does not turn: each costs as much as the first, and few are better.
GUESSES = 10
# So many steps of a long trace are taken at once, at most, if more of them are apart then: the clique of more takes minutes.
WHOLE = 100_000
# So many steps of a long trace are guessed in one go, at most: more take minutes.
GUESSED = 24_000
# So often a map near a guess is sought with more conflicts where nothing goes on beside that: later tries rarely find a smaller one.
TRIES = 3


_Trail: TypeAlias = "tuple[Link, _Trail] | None"


class Fitting(Protocol):
    """What asks more of labels than the causal theory does (`engines/frameless.py`)."""

    def fits(self, labels: Sequence[int]) -> bool:
        """Whether labels by which each action leads to one dstate are those of a map."""
        ...

    def forbid(self, labels: Sequence[int]) -> None:
        """Tell clingo why these labels are not those of a map."""
        ...

    def tell_again(self) -> None:
        """The control is a new one: tell it what the one before was told."""
        ...


def _ever_fewer(found: Iterable[list[int]], known: list[int] | None = None) -> Iterator[list[int]]:
    """Those labels that are fewer than all before them."""
    for labels in found:
        if known is None or len(set(labels)) < len(set(known)):
            known = labels
            yield labels


def _may_be(chart: Chart, clique: Sequence[int]) -> list[list[int]]:
    """Of each step, those of the clique, by number, that it is not apart from."""
    apart = np.stack([chart.continuations.apart_from(step) for step in clique], axis=1)
    return [(~row).nonzero()[0].tolist() for row in apart]


@dataclass
class _Answer:
    """The names of the steps that clingo was told of, and, once they were followed, the labels of all steps."""

    names: dict[int, int]
    labels: list[int] = field(default_factory=list)


@dataclass(frozen=True)
class _Lacking:
    """What clingo has to be told, one of these: views that need another name, links that were not kept, or labels that do not fit."""

    views: Collection[int] = ()
    links: Collection[Link] = ()
    labels: Sequence[int] = ()


class NamedLabels:
    """Labels of the first steps of a trace with the fewest dstates, which have names.

    bound    no labels have fewer dstates
    clique   nodes that are pairwise apart, which have names of their own
    known    labels of a map, if one is known
    fitting  what asks more of labels; None in the causal theory
    """

    def __init__(
        self,
        task: Task,
        asker: Asker,
        given_map: Sequence[int] = (),
        fitting: Fitting | None = None,
    ) -> None:
        """Labels of no steps yet.

        given_map  labels of all steps of a map with few dstates, if one is known
        """
        self.bound: int | None = None
        self.clique: list[int] = []
        self.known: list[int] | None = None
        self.size = 0
        self._task, self._asker, self._given_map, self._fitting = task, asker, given_map, fitting
        self._hard = False  # whether few conflicts were not enough
        self._had_all_help = (
            False  # whether all links were given, and small maps were sought by other means, too
        )
        self._seeking = False  # whether the fewest dstates are being sought
        self._beside: Beside | None = None  # a search for a map near a guess, in another thread
        self._forbidden: list[
            list[tuple[int, int]]
        ] = []  # sets of pairs of steps, of each of which some pair is not one dstate

    def large_enough(self, size: int) -> int:
        """Of a long trace, so many steps that more of them would not have a larger clique; at least these."""
        most = min(len(self._task.trace), WHOLE)
        if AT_ONCE <= size < most and self._task.speedups.clique:
            largest = self._clique_size(most)
            while size < most and self._clique_size(size) < largest:
                size = min(2 * size, most)
        return size

    def _clique_size(self, steps: int) -> int:
        log = self._task.log
        return len(Continuations(log.seen[:steps], log.actions[: steps - 1]).clique())

    def grow(self, size: int) -> None:
        """Let there be so many steps."""
        if size == self.size:
            return
        try:
            self._take(size)
        except BaseException:
            self.size = 0  # nothing of this prefix is to be taken for granted
            raise

    def _take(self, size: int) -> None:
        """Chart the first steps, pin a clique of their nodes, and take a control for them."""
        self.size = size
        with self._asker.grounding_timed():
            self._chart_steps(size)
        self._restart()

    def _chart_steps(self, size: int) -> None:
        """Chart the first steps, and choose what clingo is given of them first."""
        self.chart = Chart.of_steps(self._task.log, size)
        self.clique = self.chart.continuations.clique() if self._task.speedups.clique else [0]
        self._asker.watch.check()
        self._may_be = _may_be(self.chart, self.clique)
        self._hard = self._had_all_help = False
        self.known = numbered(self._given_map[:size]) or None
        self._spares = self._first_spares()
        self._links = dict.fromkeys(self.chart.links)
        if self._task.speedups.lazy:
            first = {0, *self.clique}
            self._links = dict.fromkeys(link for link in self.chart.links if link[0] in first)
        self.bound = max(self.bound or 0, len(self.clique))

    def _first_spares(self) -> dict[int, int]:
        """How many spare names each view has, to begin with: as many as the given map needs, or a few."""
        seen = self.chart.seen
        found = Counter(dict(zip(self._given_map, seen, strict=False)).values())
        pinned = Counter(seen[node] for node in self.clique)
        return {
            view: max(SPARES, found[view] - pinned[view] + 1) if self._given_map else SPARES
            for view in dict.fromkeys(seen)
        }

    def improving(self) -> Iterator[list[int]]:
        """Labels of all nodes, the last ones with the fewest dstates; before, if that takes its time, some that have few."""
        if not self.chart.links:
            yield [0]
            return
        self._seeking = True
        try:
            for labels in self._searched():
                if self.is_allowed(labels):
                    self.known = labels
                    yield labels
        except (LimitError, KeyboardInterrupt) as end:
            self._end_beside()
            if self.known:
                yield self.known
            if isinstance(end, KeyboardInterrupt) or not self._is_settled():
                raise
        finally:
            self._seeking = False
            self._end_beside()

    def _searched(self) -> Iterator[list[int]]:
        """The same, by the search here; it ends early where the one beside it has the fewest dstates."""
        found = yield from first_accepted_of(self._cheapest_answer, self._why_not, self._tell_why)
        if found is None:
            self._end_beside()
        yield found.labels if found else self.known or []

    def _cheapest_answer(self) -> Generator[list[int], None, _Answer | None]:
        """The cheapest answer by what clingo was told; before, if that takes its time, labels that are found otherwise. None where these are as good as the bound."""
        while True:
            names, proven = self._cheapest(self._patience)
            if proven and names is not None:
                return _Answer(names)
            yield from self._helped()
            if self._is_settled():
                return None
            self.add(self._more_links())
            self._configure()

    def _why_not(self, answer: _Answer) -> _Lacking | None:
        """What clingo has to be told, as an answer shows; None where it says which dstates a map has."""
        if views := self._rests(answer.names):
            return _Lacking(views=views)
        self._raise_bound([sum(name >= len(self.clique) for name in set(answer.names.values()))])
        answer.labels, failed = self._follow(answer.names)
        if failed:
            return _Lacking(links=failed)
        return (
            None
            if self._fitting is None or self._fitting.fits(answer.labels)
            else _Lacking(labels=answer.labels)
        )

    def _tell_why(self, lacking: _Lacking) -> None:
        if lacking.views:
            self._name_more(lacking.views)
        elif lacking.links:
            self.add(lacking.links)
        elif self._fitting:
            self._fitting.forbid(lacking.labels)

    @property
    def _patience(self) -> int:
        """After how many conflicts something else is done; -1 for never."""
        if not self.has_all_links:
            return PATIENCE
        return -1 if self._had_all_help or not self._may_search_nearby else CORES

    def _helped(self) -> Iterator[list[int]]:
        """Labels of small maps, by other means than clingo's search for the fewest dstates, which takes long."""
        if self._may_search_nearby and not self._hard:
            yield from self._search_nearby()
        self._hard = True
        if self.has_all_links and self._may_search_nearby and not self._had_all_help:
            self._had_all_help = True
            if not self._task.has_processors:
                yield from self._search_alone()

    def _cheapest(self, conflicts: int) -> tuple[dict[int, int] | None, bool]:
        """The best answer that clingo finds with so many conflicts, and whether it is proven to be the best."""
        answer = None
        answers = self._asker.answers(
            names_lp.read_names,
            "opt",
            0,
            conflicts=conflicts,
            on_bound=self._raise_bound,
            until=self._may_end,
        )
        while True:
            try:
                answer = next(answers)
            except StopIteration as end:
                return answer, bool(end.value)

    def _may_end(self) -> bool:
        """Whether a map with as few dstates as the bound is known already, while one is sought. What lists all of them goes on."""
        return self._seeking and self._is_settled()

    def is_allowed(self, labels: Sequence[int]) -> bool:
        """Whether labels keep what evidence says of pairs of steps. That each action leads to one dstate by them is known."""
        if any(all(labels[i] == labels[j] for i, j in pairs) for pairs in self._forbidden):
            return False
        return not self.chart.excluded or self.chart.is_map(labels)

    def forbid_together(self, pairs: Collection[tuple[int, int]]) -> None:
        """From now on these pairs of steps are not all one dstate."""
        self._forbidden.append(list(pairs))
        if self.known and not self.is_allowed(self.known):
            self.known = None
        self._tell_forbidden(len(self._forbidden) - 1)

    def _tell_forbidden(self, number: int) -> None:
        """Tell clingo that these pairs are not all one dstate; and of their steps, if it does not know them."""
        pairs = self._forbidden[number]
        steps = {step for pair in pairs for step in pair}
        self.add_links_at(steps)
        self.tell(f"not_together_{number}", names_lp.not_together(number, pairs))

    def add_links_at(self, steps: Collection[int]) -> None:
        """Give clingo the links to and from these steps, and so the steps, where it does not know them."""
        self.add(
            link
            for link in self.chart.links
            if link not in self._links and not {link[0], link[2]}.isdisjoint(steps)
        )

    def tell(self, part: str, rules: str) -> None:
        """Give clingo rules in a program part of this name."""
        self._asker.control.add(part, [], rules)
        self._asker.control.ground([(part, [])])

    @property
    def _may_search_nearby(self) -> bool:
        """Whether small maps may be sought by other means than clingo: what fits the causal theory need not fit one that asks for more."""
        return self._fitting is None and (
            self._task.speedups.greedy or self._task.speedups.annealed
        )

    def _search_nearby(self) -> Iterator[list[int]]:
        """Begin to search for small maps in another thread; where there is but one processor, give a map merged by evidence."""
        if self._task.has_processors:
            watch = Watch(beside=self._asker.watch)
            search = self._nearby(watch)
            near = chain(self._merged(watch.check), self._near_guess(search, watch.check))
            self._beside = Beside(
                search,
                watch,
                _ever_fewer(self._from_beginning(watch.check) if self._is_long else near),
            )
        elif not self._is_long:
            yield from self._merged(self._asker.watch.check)

    def _search_alone(self) -> Iterator[list[int]]:
        """Search for small maps near a guess for a while, with nothing beside it."""
        if self._is_long:
            yield from _ever_fewer(self._from_beginning(self._asker.watch.check), self.known)
            return
        search = self._nearby(self._asker.watch)
        yield from _ever_fewer(self._near_guess(search, self._asker.watch.check, TRIES), self.known)
        self._absorb(None, search.bound or 0)

    def _nearby(self, watch: Watch) -> NearbySearch:
        return NearbySearch(
            watch,
            self._task.speedups,
            chart=self.chart,
            clique=self.clique,
            may_be=self._may_be,
            far=self.chart.continuations.excluded_from if self.chart.excluded else None,
            configuration="tweety",
        )

    def _merged(self, check: Callable[[], None]) -> Iterator[list[int]]:
        """Labels of a map merged by evidence."""
        if self._task.speedups.greedy:
            yield merged(self.chart.apart(), self.chart.links, self.clique, check)

    @property
    def _is_long(self) -> bool:
        """Whether there are too many nodes to compare them in pairs."""
        return len(self.chart.seen) > AT_ONCE

    def _from_beginning(self, check: Callable[[], None]) -> Iterator[list[int]]:
        """Labels of maps of a long trace that guesses at its beginning lead to, ever longer ones, until one needs no dstates beyond those that the guess has."""
        steps, most = (
            AT_ONCE,
            len(self.chart.seen) if len(self.chart.seen) <= GUESSED else 2 * AT_ONCE,
        )
        while self._task.speedups.annealed:
            beginning = Chart.of_steps(self._task.log, steps)
            clique = beginning.continuations.clique()
            near = self._map_of_guess(beginning, clique, _may_be(beginning, clique), check)
            for known in () if near is None else (thinned(beginning, near, check), near):
                if labels := followed(self._task.log, known, check):
                    yield labels[: self.size]
                    yield (labels := thinned(self.chart, labels[: self.size], check))
                    if len(set(labels)) <= len(set(known)):
                        return
            if steps == most:
                return
            steps = min(2 * steps, most)

    def _near_guess(
        self, search: NearbySearch, check: Callable[[], None], tries: int | None = None
    ) -> Iterator[list[int]]:
        """Labels of a map that is guessed, and of those near that."""
        near = (
            self._map_of_guess(self.chart, self.clique, self._may_be, check)
            if self._task.speedups.annealed
            else None
        )
        if near is not None:
            yield from search.fewer(thinned(self.chart, near, check), tries)

    def _map_of_guess(
        self,
        steps: Chart,
        clique: Sequence[int],
        may_be: Sequence[Sequence[int]],
        check: Callable[[], None],
    ) -> list[int] | None:
        """Labels of a map of these first steps near a guess; None where none is made."""
        guess = self._guessed(steps, clique, may_be, check)
        return None if guess is None else merged_near(steps.apart(), steps.links, guess, check)

    def _guessed(
        self,
        steps: Chart,
        clique: Sequence[int],
        may_be: Sequence[Sequence[int]],
        check: Callable[[], None],
    ) -> list[int] | None:
        """A guess at the dstates of these first steps, -1 where it is not sure; None where that would take too much memory."""
        chart = Chart.turned(self._task.trace, self._task.log, len(steps.seen))
        if chart is None:
            guesses: Iterable[list[int]] = islice(
                annealed_steps(steps, clique, may_be, check), GUESSES
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

    def _is_settled(self) -> bool:
        """Whether a map is known that has as few dstates as the bound, also by the search beside this one."""
        if self._beside is not None:
            self._beside.check()
            self._absorb(self._beside.labels, self._beside.bound)
        return self.known is not None and len(set(self.known)) <= (self.bound or 0)

    def _check_ahead(self, seconds: float) -> None:
        """Raise LimitError where no time is left for so many seconds of what cannot be interrupted; but first let the search beside this one use it."""
        if not self._asker.watch.allows(seconds):
            while self._beside is not None and self._beside.running and not self._is_settled():
                self._asker.watch.check()
                time.sleep(POLL)
        self._asker.watch.check(seconds)

    def _end_beside(self) -> None:
        if self._beside is not None:
            self._beside.end()
            self._absorb(self._beside.labels, self._beside.bound)
            self._beside = None

    def _absorb(self, labels: list[int] | None, bound: int) -> None:
        """Take what a search near a guess knows, which knows nothing of pairs of steps that evidence speaks of."""
        fewer = labels is not None and (
            self.known is None or len(set(labels)) < len(set(self.known))
        )
        if labels is not None and fewer and self.is_allowed(labels):
            self.known = labels
        self.bound = max(self.bound or 0, bound)

    def names(self) -> dict[tuple[int, int], int]:
        """The names of dstates, but for rests, by what stays the same when there are more spare names: the view, and a number."""
        pinned = {(-1, name): name for name in range(len(self.clique))}
        return pinned | {
            (view, i): name
            for view, spare in self._spare.items()
            for i, name in enumerate(spare[:-1])
        }

    def _configure(self) -> None:
        """Let clasp search as suits what is asked, and how hard it turned out to be."""
        if self._hard and not (self._beside and self._beside.running) and self._task.has_processors:
            give_threads(self._asker.control, two=True)

    def _answers_of(self, spares: int) -> Iterator[dict[int, int]]:
        """All answers that cost so many spare names and use no rest."""
        read = self._reader().read if self.has_all_links else names_lp.read_names
        return self._asker.answers(
            read, f"enum,{spares},0", 0, assumptions=[self._resting(False)], ahead=True
        )

    def _reader(self) -> names_lp.NameReader:
        return names_lp.NameReader(self._task.log.actions[: self.size - 1], self._choices)

    @property
    def has_all_links(self) -> bool:
        """Whether clingo was given all links."""
        return len(self._links) == len(self.chart.links)

    def settle(self) -> None:
        """End the search beside this one."""
        self._end_beside()

    def all_of(self, dstates: int, enough: int) -> Generator[list[int], None, None]:
        """All ways to name the nodes with so many dstates; or `enough` of them, unless that is 0. One that is known comes first."""
        known = self.known if self.known and len(set(self.known)) == dstates else None
        if known:
            yield known
        if not known or enough != 1:
            first = numbered(known or ())
            yield from (
                labels for labels in self._listed(dstates, enough) if numbered(labels) != first
            )

    def _listed(self, dstates: int, enough: int) -> Iterator[list[int]]:
        """The same, as clingo lists them."""
        spares = dstates - len(self.clique)
        if spares < 0:
            return
        if not self.chart.links:
            yield [0]
            return
        while True:
            while not enough and self._needs_rest(
                spares
            ):  # asked again when nodes were added, as these may be at a rest
                pass
            held: list[list[int]] = []
            failed: Iterable[Link] = ()
            lazy = not self.has_all_links
            try:
                for answer in self._answers_of(spares):
                    labels, failed = self._follow(answer)
                    if failed:
                        break
                    held.append(labels)
                    if enough:
                        if len(held) == enough:
                            yield from held
                            return
                    elif not lazy:
                        yield held.pop()
                    elif len(held) == HELD_BACK:
                        failed = self.chart.links
                        break
            except LimitError:
                yield from held  # they cost what the bound is, and fit all links
                raise
            if failed:
                self.add(failed)
            elif not enough or not self._needs_rest(spares):
                yield from held
                return

    def _needs_rest(self, spares: int) -> bool:
        """Take more spare names, if some answer of this cost uses a rest. Says whether it was so."""
        answer = next(
            self._asker.answers(
                names_lp.read_names, f"enum,{spares},{spares}", 1, assumptions=[self._resting(True)]
            ),
            None,
        )
        views = self._rests(answer) if answer else set()
        if views:
            self._name_more(views)
        return bool(views)

    def _resting(self, value: bool) -> tuple[clingo.Symbol, bool]:
        """The assumption that some node is at a rest, or that none is."""
        return names_lp.resting(self._batches - 1), value

    def _raise_bound(self, costs: Sequence[int]) -> None:
        self.bound = max(self.bound or 0, len(self.clique) + costs[0])

    def _restart(self) -> None:
        """Take a new control, for other names."""
        self._asker.watch.check()
        with self._asker.grounding_timed():
            self._take_control()
        links, self._links = self._links, {}
        self.add(links)
        for number in range(len(self._forbidden)):
            self._tell_forbidden(number)
        if self._fitting:
            self._fitting.tell_again()

    def _take_control(self) -> None:
        """Take a control that knows the names, and no step yet."""
        seen = self.chart.seen
        names = [(name, seen[node]) for name, node in enumerate(self.clique)]
        spares = self._spare = dict[int, list[int]]()
        for view, count in self._spares.items():
            spares[view] = list(range(len(names), len(names) + count + 1))
            names += [(name, view) for name in spares[view]]
        self._rest = {found[-1]: view for view, found in spares.items()}
        self._choices = [
            options
            if len(options) == 1 and t == self.clique[options[0]]
            else options + spares[seen[t]]
            for t, options in enumerate(self._may_be)
        ]
        cores = ["--opt-strategy=usc"] if self._task.speedups.core_guided else []
        base = names_lp.name_facts(names, spares.values(), self.chart.links, self._choices)
        self._check_ahead(SECONDS_A_CHARACTER * len(base))
        self._asker.control = new_control("names", base, ["--eq=1", *cores])
        self._configure()
        self._given: set[int] = set()  # nodes
        self._open = np.zeros(
            len(seen), dtype=bool
        )  # whether a node is one of them, and not pinned
        self._last: dict[int, int] = {}  # by view, the step given last
        self._batches = 0

    def add(self, links: Iterable[Link]) -> None:
        """Give clingo more links, and the nodes at their ends: some at a time, as it cannot be stopped meanwhile."""
        added, before = list(links), self._asker.ground_seconds
        for start in range(0, len(added), AT_A_TIME):
            self._asker.watch.check()
            with self._asker.grounding_timed():
                self._give(added[start : start + AT_A_TIME])
        self._check_ahead(PREPARING * (self._asker.ground_seconds - before))

    def _more_links(self) -> list[Link]:
        """Links that clingo does not know yet: all of them, or of a long trace those whose ends have the fewest names to choose from."""
        left = [link for link in self.chart.links if link not in self._links]
        if not self._is_long:
            return left
        return sorted(
            left, key=lambda link: len(self._choices[link[0]]) * len(self._choices[link[2]])
        )[:MORE_LINKS]

    def _give(self, links: Iterable[Link]) -> None:
        added = [link for link in links if link not in self._links]
        given: list[tuple[int, int, Sequence[int], int | None]] = []
        far: list[tuple[int, int]] = []
        for t in (end for s, _, x in added for end in (s, x)):
            if t not in self._given:
                self._given.add(t)
                view = self.chart.seen[t]
                given.append((t, view, self._choices[t], self._last.get(view)))
                if len(self._choices[t]) > 1:
                    self._last[view] = t
                    if self.chart.excluded:
                        far += [
                            (t, int(u))
                            for u in np.flatnonzero(
                                self.chart.continuations.excluded_from(t) & self._open
                            )
                        ]
                    self._open[t] = True
        self._links.update(dict.fromkeys(added))
        part, batch = f"batch_{self._batches}", self._batches
        self._asker.control.add(part, [], names_lp.batch_facts(batch, given, added, far))
        self._asker.control.ground([(part, [])])
        self._asker.control.ground([("more", numbers(batch))])
        self._batches += 1

    def _name_more(self, views: Collection[int]) -> None:
        """Take one more spare name for each of these views."""
        for view in views:
            self._spares[view] += 1
        self._restart()

    def _rests(self, answer: dict[int, int]) -> set[int]:
        """The views of which the answer uses the rest."""
        return {self._rest[name] for name in answer.values() if name in self._rest}

    def _follow(self, answer: dict[int, int]) -> tuple[list[int], list[Link]]:
        """The name of every node, following the answer's links from node to node, and the links that it does not explain."""
        if self.has_all_links and not self._rests(answer):
            return [answer[node] for node in range(len(answer))], []
        goes: dict[tuple[int, int], int] = {
            (answer[t], action): answer[u] for t, action, u in self._links
        }
        labels = [-1] * len(self.chart.seen)  # -1: not known
        followed: list[_Trail] = [None] * len(labels)  # links since the last node that clingo named
        failed: dict[Link, None] = {}
        asked: set[tuple[int, int]] = set()  # one such link is asked for, not all
        labels[0] = answer[0]
        for link in self.chart.links:
            t, action, u = link
            here, key = labels[t], (labels[t], action)
            there = None
            if t < u and labels[u] < 0:
                if here >= 0 and key not in asked:
                    trail = (link, followed[t])
                    if key not in goes:
                        failed[link] = None
                        asked.add(key)
                    elif goes[key] not in self._choices[u] or answer.get(u, goes[key]) != goes[key]:
                        failed.update(self._not_given(trail))
                    else:
                        there = goes[key]
                        followed[u] = None if u in answer else trail
                labels[u] = answer.get(u, -1) if there is None else there
            elif here >= 0 and labels[u] >= 0 and goes.setdefault(key, labels[u]) != labels[u]:
                failed.update(self._not_given((link, followed[t])))
                failed.update(self._not_given(followed[u]))
        excluded = {
            node
            for pair in self.chart.excluded
            if labels[pair[0]] == labels[pair[1]] >= 0
            for node in pair
        }
        if excluded:
            failed.update(
                (link, None)
                for link in self.chart.links
                if link not in self._links and not excluded.isdisjoint(link[::2])
            )
        return labels, list(failed)

    def _not_given(self, trail: _Trail) -> Iterator[tuple[Link, None]]:
        """The links on a trail that clingo does not know."""
        while trail is not None:
            link, trail = trail
            if link not in self._links:
                yield link, None
