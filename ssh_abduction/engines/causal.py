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
answer soon, what is missing is rather more knowledge than less, and all links are given at once. With the steps clingo is told which pairs
of them are apart, where more than one action shows it: no two of these are at one name. The links say so, too, but only once it is
chosen where they lead.

clasp raises the bound core by core: a core is a set of spare names that cannot all be left unused. Cores are small at first, as the names
of a view are its own: what different corners of the world need adds up. Raising the bound by cores stalls when what is missing can be
spread over many views: every core is then about all of them. After CORES conflicts the numbers of dstates are asked for one by one instead,
from the bound up: is there an answer that costs no more? If there is none, the bound is one higher. The first answer without a rest is a
minimal map, as it costs what the bound is; the same search then goes on with the other maps.

Of a long trace, whose steps are too many to be compared in pairs, as many are taken as it takes for the clique to be as large as that of all; and what
conflicts ask for is given a thousand links at a time.

Beside all that small maps are sought in a thread of its own. First steps are merged by evidence (`guesses/merging.py`), so that a limit
leaves a map that is not bad; then a map is guessed, of places with frames where the trace lets itself be taken for one of these
(`guesses/annealing.py`), and smaller ones are sought near it (`engines/nearby.py`). Of a long trace the beginning is guessed, and what
comes of that followed along the rest (`guesses/continuing.py`). Whatever bound meets these maps ends the search. Where there is but one
processor, steps are merged at once, and the guess waits until raising the bound by cores has stalled. Where there is no such search, clasp
has the second processor: two threads, which tell each other what they learn. Which minimal maps come first may then differ from run to run;
all of them are the same.

To read an answer takes Python longer than clingo takes to find it. So an answer is asked only for the atoms that it may hold: where actions
lead, from which the step after each step follows. While a map is made of one answer, clingo searches for the next.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from itertools import chain, islice
from typing import Any, TypeAlias

import clingo
import numpy as np

from ssh_abduction.asp import facts
from ssh_abduction.asp.control import give_threads, new_control
from ssh_abduction.asp.limits import POLL, Stopped, Watch
from ssh_abduction.engines.base import AT_ONCE, ChartedEngine, Found
from ssh_abduction.engines.nearby import AT_A_TIME, SECONDS_A_CHARACTER, Beside, NearbySearch, mended
from ssh_abduction.guesses.annealing import annealed, annealed_steps
from ssh_abduction.guesses.continuing import followed
from ssh_abduction.guesses.merging import merged, merged_near, thinned
from ssh_abduction.steps.apart import Continuations, Matrix
from ssh_abduction.steps.chart import Chart, Link, NoFrame, numbered
from ssh_abduction.steps.log import Log
from ssh_abduction.theory.speedups import Speedups
from ssh_abduction.theory.theory import Theory
from ssh_abduction.trace import Trace

HELD_BACK = 100  # maps that are kept until all links are given; then they stream
PREPARING = 0.6  # of the time that grounding took, clingo takes before it begins to solve, and can be stopped
SPARES = 2  # spare names of a view, to begin with
PATIENCE = 2000  # conflicts after which more links are given
MORE_LINKS = 1000  # of a long trace, that clingo is given then; of others all
CORES = 10_000  # conflicts after which, with all links, numbers of dstates are asked for one by one
GUESSES = 10  # that are waited for until one is a map, where the robot does not turn
GUESSED = 24_000  # steps that are guessed in one go, at most
WHOLE = 100_000  # steps that are taken at once, at most, if more of them are apart then
TRIES = 3  # how often a map near a guess is sought with more conflicts, where nothing goes on beside that


_Trail: TypeAlias = "tuple[Link, _Trail] | None"


class Settled(Exception):  # noqa: N818 - not an error
    """A map is known that has as few dstates as the bound."""


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


class NamedEngine(ChartedEngine):
    """The causal theory, fewest dstates, with names given beforehand."""

    def __init__(self, trace: Trace, theory: Theory, watch: Watch, log: Log, speedups: Speedups) -> None:
        super().__init__(trace, theory, watch, log, speedups)
        self._hard = self._one_by_one = False  # whether few conflicts were not enough, and whether raising the bound by cores stalled
        self._beside: Beside | None = None  # a search for a map near a guess
        self._known: list[int] | None = None  # labels of a map from there
        self._begun: Generator[dict[int, int], None, bool] | None = None  # goes on after the answer that showed the bound to be the minimum

    def over(self, trace: Trace, watch: Watch, log: Log) -> NamedEngine:
        return NamedEngine(trace, self._theory, watch, log, self._speedups)

    def next_size(self, failed: int) -> int:
        """Of a long trace, so many steps that more of them would not have a larger clique."""
        size, most = super().next_size(failed), min(len(self._trace), WHOLE)
        if AT_ONCE <= size < most and self._speedups.clique:
            largest = self._clique_size(most)
            while size < most and self._clique_size(size) < largest:
                size = min(2 * size, most)
        return size

    def _clique_size(self, steps: int) -> int:
        return len(Continuations(self._log.seen[:steps], self._log.actions[: steps - 1]).clique())

    def grow(self, size: int) -> None:
        if size == self.size:
            return
        try:
            self._take(size)
        except BaseException:
            self.size = 0  # nothing of this prefix is to be taken for granted
            raise

    def _take(self, size: int) -> None:
        """Chart the first steps, pin a clique of their nodes, and take a control for them."""
        began = time.perf_counter()
        self.size = size
        self._chart = Chart.of_steps(self._log, size)
        self.clique = self._chart.continuations.clique() if self._speedups.clique else [0]
        self._watch.check()
        self._may_be = _may_be(self._chart, self.clique)
        self._one_by_one = self._hard = False
        self._known = None
        self._spares = self._first_spares()
        self._links = dict.fromkeys(self._chart.links)
        if self._speedups.lazy:
            first = {0, *self.clique}
            self._links = dict.fromkeys(link for link in self._chart.links if link[0] in first)
        self.bound = max(self.bound or 0, len(self.clique))
        self.ground_seconds += time.perf_counter() - began
        self._restart()

    def _first_spares(self) -> dict[int, int]:
        """How many spare names each view has, to begin with."""
        return dict.fromkeys(self._chart.seen, SPARES)

    def _far(self, node: int) -> Matrix:
        """Which nodes are apart from this one, as more than one action shows, or as evidence says."""
        continuations = self._chart.continuations
        return continuations.apart_from(node, actions=2) if self._speedups.apart else continuations.excluded_from(node)

    @property
    def _tells_far(self) -> bool:
        """Whether clingo is told which nodes are apart."""
        return self._speedups.apart or bool(self._chart.excluded)

    def improving_maps(self, most: tuple[int, ...] = ()) -> Iterator[Found]:
        for labels in self._better_labels():
            yield self._found(labels)

    def maps_of_cost(self, cost: tuple[int, ...], enough: int) -> Iterator[Found]:
        for labels in self._labels_of(cost[0], enough):
            yield self._found(labels)

    def _better_labels(self) -> Iterator[list[int]]:
        """Names for all nodes, the last ones such that they need the fewest dstates; before, if that takes its time, some that need few."""
        if not self._chart.links:
            yield [0]
            return
        try:
            for labels in self._searched():
                if not self._chart.excluded or self._chart.is_map(labels):
                    self._known = labels
                    yield labels
        except Settled:
            self._end_beside()
            yield self._known or []
        except (Stopped, KeyboardInterrupt):
            self._end_beside()
            if self._known:
                yield self._known
            raise
        finally:
            self._end_beside()

    def _searched(self) -> Iterator[list[int]]:
        """The same, from this search alone. Raises Settled where the one beside it has fewest dstates."""
        while not self._one_by_one:
            lazy = not self._all_given
            answer = None
            most = PATIENCE if lazy else CORES if self._speedups.one_by_one else -1
            answers = self._answers(facts.read_names, "opt", 0, conflicts=most, on_bound=self._raise_bound, until=self._settled)
            while True:
                try:
                    answer = next(answers)
                except StopIteration as end:
                    proven = end.value
                    break
            if not proven or answer is None:
                if not self._hard:
                    self._hard = True
                    yield from self._search_nearby()
                if not lazy:
                    if not self._has_processors():
                        yield from self._search_alone()
                    self._ask_one_by_one()
                    continue
                self._add(self._more_links())
                self._configure()
            elif not self._named_more(answer):
                self._raise_bound([sum(name >= len(self.clique) for name in set(answer.values()))])
                labels, failed = self._follow(answer)
                if failed:
                    self._add(failed)
                elif self._fits(labels):
                    yield labels
                    return
                else:
                    self._forbid(labels)
        while not self._fits(labels := self._follow(self._first_of_bound())[0]):
            self._forbid(labels)
        yield labels

    def _fits(self, labels: Sequence[int]) -> bool:
        """Whether these labels, which all links hold of, are those of a map. For theories that ask for more than the causal one."""
        return True

    def _forbid(self, labels: Sequence[int]) -> None:
        """Tell clingo why these labels, which do not fit, are not those of a map."""
        raise NotImplementedError

    def _search_nearby(self) -> Iterator[list[int]]:
        """Begin to search for small maps in another thread; where there is but one processor, give a map merged by evidence."""
        if not (self._speedups.greedy or self._speedups.annealed):
            return
        if self._has_processors():
            watch = Watch(beside=self._watch)
            search = self._nearby(watch)
            near = chain(self._merged(watch.check), self._near_guess(search, watch.check))
            self._beside = Beside(search, watch, _ever_fewer(self._from_beginning(watch.check) if self._is_long else near))
        elif not self._is_long:
            yield from self._merged(self._watch.check)

    def _search_alone(self) -> Iterator[list[int]]:
        """Search for small maps near a guess for a while, with nothing beside it. Raises Settled where one has fewest dstates."""
        if self._is_long:
            yield from _ever_fewer(self._from_beginning(self._watch.check), self._known)
            return
        search = self._nearby(self._watch)
        yield from _ever_fewer(self._near_guess(search, self._watch.check, TRIES), self._known)
        if search.bound:
            self._heed(self._known, search.bound)
            raise Settled

    def _nearby(self, watch: Watch) -> NearbySearch:
        return NearbySearch(
            watch,
            self._speedups,
            chart=self._chart,
            clique=self.clique,
            may_be=self._may_be,
            far=self._far if self._tells_far else None,
            configuration="tweety",
        )

    def _merged(self, check: Callable[[], None]) -> Iterator[list[int]]:
        """Labels of a map merged by evidence."""
        if self._speedups.greedy:
            yield merged(self._chart.apart(), self._chart.links, self.clique, check)

    @property
    def _is_long(self) -> bool:
        """Whether there are too many nodes to compare them in pairs."""
        return len(self._chart.seen) > AT_ONCE

    def _from_beginning(self, check: Callable[[], None]) -> Iterator[list[int]]:
        """Labels of maps of a long trace that guesses at its beginning lead to, ever longer ones, until one needs no dstates beyond those that the guess has."""
        steps, most = AT_ONCE, len(self._chart.seen) if len(self._chart.seen) <= GUESSED else 2 * AT_ONCE
        while self._speedups.annealed:
            beginning = Chart.of_steps(self._log, steps)
            clique = beginning.continuations.clique()
            near = self._map_of_guess(beginning, clique, _may_be(beginning, clique), check)
            for known in () if near is None else (thinned(beginning, near, check), near):
                if labels := followed(self._log, known, check):
                    yield labels[: self.size]
                    yield (labels := thinned(self._chart, labels[: self.size], check))
                    if len(set(labels)) <= len(set(known)):
                        return
            if steps == most:
                return
            steps = min(2 * steps, most)

    def _near_guess(self, search: NearbySearch, check: Callable[[], None], tries: int | None = None) -> Iterator[list[int]]:
        """Labels of a map that is guessed, and of those near that."""
        near = self._map_of_guess(self._chart, self.clique, self._may_be, check) if self._speedups.annealed else None
        if near is not None:
            yield from search.fewer(thinned(self._chart, near, check), tries)

    def _map_of_guess(
        self, steps: Chart, clique: Sequence[int], may_be: Sequence[Sequence[int]], check: Callable[[], None]
    ) -> list[int] | None:
        """Labels of a map of these first steps near a guess; None where none is made."""
        guess = self._guessed(steps, clique, may_be, check)
        return None if guess is None else merged_near(steps.apart(), steps.links, guess, check)

    def _guessed(self, steps: Chart, clique: Sequence[int], may_be: Sequence[Sequence[int]], check: Callable[[], None]) -> list[int] | None:
        """A guess at the dstates of these first steps, -1 where it is not sure; None where that would take too much memory."""
        try:
            chart = Chart.turned(self._trace, self._log, len(steps.seen))
        except NoFrame:
            guesses: Iterable[list[int]] = islice(annealed_steps(steps, clique, may_be, check), GUESSES)
        else:
            labels = annealed(chart, check).labels(chart)
            guesses = [[labels[node] for node in chart.node_of]]
        guess = None
        for labels in guesses:
            guess = mended(labels, steps)
            if steps.is_map(guess):
                break
        return guess

    def _settled(self) -> bool:
        """Never. Raises Settled where the search beside this one has as few dstates as the bound."""
        if self._beside is not None:
            self._beside.check()
            self._heed(self._beside.labels, self._beside.bound)
            if self._known and len(set(self._known)) <= (self.bound or 0):
                raise Settled
        return False

    def _check_ahead(self, seconds: float) -> None:
        """Raise Stopped where no time is left for so many seconds of what cannot be interrupted; but first let the search beside this one use it."""
        if not self._watch.allows(seconds):
            while self._beside is not None and self._beside.running:
                self._watch.check()
                self._settled()
                time.sleep(POLL)
            self._settled()
        self._watch.check(seconds)

    def _end_beside(self) -> None:
        if self._beside is not None:
            self._beside.end()
            self._heed(self._beside.labels, self._beside.bound)
            self._beside = None

    def _heed(self, labels: list[int] | None, bound: int) -> None:
        """Take what the search near a guess knows. What it merged need not heed what evidence excludes."""
        if labels is None or not self._chart.excluded or self._chart.is_map(labels):
            self._known = labels
        self.bound = max(self.bound or 0, bound)

    def _ask_one_by_one(self) -> None:
        self._one_by_one = True
        self._configure()

    def _configure(self) -> None:
        """Let clasp search as suits what is asked, and how hard it turned out to be."""
        configuration: Any = self._control.configuration
        if self._one_by_one:
            configuration.configuration, configuration.sat_prepro = "crafty", "no"
        if self._hard and not (self._beside and self._beside.running) and self._has_processors():
            give_threads(self._control, two=True)

    def _first_of_bound(self) -> dict[int, int]:
        """Raise the bound until there is a map that costs no more. All links are given."""
        self._end_begun()
        while True:
            spares = (self.bound or 0) - len(self.clique)
            answers = self._answers(self._reader().read, f"enum,{spares},{spares}", 0, until=self._settled, ahead=True)
            answer = next(answers, None)
            if answer is None:
                self._raise_bound([spares + 1])
            elif self._rests(answer):
                answers.close()
                self._named_more(answer)
            else:
                self._begun = answers
                self._first = answer
                return answer

    def _all_of_bound(self, spares: int) -> Iterator[dict[int, int]]:
        """All answers of this cost that use no rest, where a search for them has begun from there on."""
        if self._begun is None:
            read = self._reader().read if self._all_given else facts.read_names
            yield from self._answers(read, f"enum,{spares},0", 0, assumptions=[self._resting(False)], ahead=True)
            return
        begun, self._begun = self._begun, None
        yield self._first
        yield from (answer for answer in begun if not self._rests(answer))

    def _reader(self) -> facts.NameReader:
        return facts.NameReader(self._log.actions[: self.size - 1], self._choices, self._rest)

    @property
    def _all_given(self) -> bool:
        """Whether clingo was given all links."""
        return len(self._links) == len(self._chart.links)

    def settle(self) -> None:
        self._end_begun()
        self._end_beside()

    def _end_begun(self) -> None:
        if self._begun is not None:
            self._begun.close()
            self._begun = None

    def _labels_of(self, dstates: int, enough: int) -> Generator[list[int], None, None]:
        """All ways to name the nodes with so many dstates; or `enough` of them, unless that is 0. One that is known comes first."""
        known = self._known if self._known and len(set(self._known)) == dstates else None
        if known:
            yield known
        if not known or enough != 1:
            first = numbered(known or ())
            yield from (labels for labels in self._listed(dstates, enough) if numbered(labels) != first)

    def _listed(self, dstates: int, enough: int) -> Iterator[list[int]]:
        """The same, as clingo lists them."""
        spares = dstates - len(self.clique)
        if spares < 0:
            return
        if not self._chart.links:
            yield [0]
            return
        if not enough or self.bound != dstates:
            self._end_begun()
        while True:
            while not enough and self._needs_rest(spares):  # asked again when nodes were added, as these may be at a rest
                pass
            held: list[list[int]] = []
            failed: Iterable[Link] = ()
            lazy = not self._all_given
            try:
                for answer in self._all_of_bound(spares):
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
                        failed = self._chart.links
                        break
            except Stopped:
                yield from held  # they cost what the bound is, and fit all links
                raise
            if failed:
                self._add(failed)
            elif not enough or not self._needs_rest(spares):
                yield from held
                return

    def _needs_rest(self, spares: int) -> bool:
        """Take more spare names, if some answer of this cost uses a rest. Says whether it was so."""
        answer = next(self._answers(facts.read_names, f"enum,{spares},{spares}", 1, assumptions=[self._resting(True)]), None)
        return answer is not None and self._named_more(answer)

    def _resting(self, value: bool) -> tuple[clingo.Symbol, bool]:
        """The assumption that some node is at a rest, or that none is."""
        return facts.resting(self._batches - 1), value

    def _raise_bound(self, costs: Sequence[int]) -> None:
        self.bound = max(self.bound or 0, len(self.clique) + costs[0])

    def _found(self, labels: Sequence[int]) -> Found:
        return Found.of(facts.causal_map(labels, self._trace), self._theory)

    def _restart(self) -> None:
        """Take a new control, for other names."""
        self._watch.check()
        began = time.perf_counter()
        self._end_begun()
        seen = self._chart.seen
        names = [(name, seen[node]) for name, node in enumerate(self.clique)]
        spares = self._spare = dict[int, list[int]]()
        for view, count in self._spares.items():
            spares[view] = list(range(len(names), len(names) + count + 1))
            names += [(name, view) for name in spares[view]]
        self._rest = {found[-1]: view for view, found in spares.items()}
        self._choices = [
            options if len(options) == 1 and t == self.clique[options[0]] else options + spares[seen[t]]
            for t, options in enumerate(self._may_be)
        ]
        cores = ["--opt-strategy=usc"] if self._speedups.core_guided else []
        base = facts.name_facts(names, spares.values(), self._chart.links, self._choices)
        self._check_ahead(SECONDS_A_CHARACTER * len(base))
        self._control = new_control("names", base, ["--eq=1", *cores], self._speedups)
        self._configure()
        self._given: set[int] = set()  # nodes
        self._open = np.zeros(len(seen), dtype=bool)  # whether a node is one of them, and not pinned
        self._last: dict[int, int] = {}  # by view, the step given last
        self._batches = 0
        self.ground_seconds += time.perf_counter() - began
        links, self._links = self._links, {}
        self._add(links)

    def _add(self, links: Iterable[Link]) -> None:
        """Give clingo more links, and the nodes at their ends: some at a time, as it cannot be stopped meanwhile."""
        added, before = list(links), self.ground_seconds
        for start in range(0, len(added), AT_A_TIME):
            self._watch.check()
            self._give(added[start : start + AT_A_TIME])
        self._check_ahead(PREPARING * (self.ground_seconds - before))

    def _more_links(self) -> list[Link]:
        """Links that clingo does not know yet: all of them, or of a long trace those whose ends have the fewest names to choose from."""
        left = [link for link in self._chart.links if link not in self._links]
        if not self._is_long:
            return left
        return sorted(left, key=lambda link: len(self._choices[link[0]]) * len(self._choices[link[2]]))[:MORE_LINKS]

    def _give(self, links: Iterable[Link]) -> None:
        began = time.perf_counter()
        added = [link for link in links if link not in self._links]
        given: list[tuple[int, int, Sequence[int], int | None]] = []
        far: list[tuple[int, int]] = []
        for t in (end for s, _, x in added for end in (s, x)):
            if t not in self._given:
                self._given.add(t)
                view = self._chart.seen[t]
                given.append((t, view, self._choices[t], self._last.get(view)))
                if len(self._choices[t]) > 1:
                    self._last[view] = t
                    far += [(t, int(u)) for u in np.flatnonzero(self._far(t) & self._open)] if self._tells_far else []
                    self._open[t] = True
        self._links.update(dict.fromkeys(added))
        part, batch = f"batch_{self._batches}", self._batches
        self._control.add(part, [], facts.batch_facts(batch, given, added, far))
        self._control.ground([(part, [])])
        self._control.ground([("more", facts.numbers(batch))])
        self._batches += 1
        self.ground_seconds += time.perf_counter() - began

    def _named_more(self, answer: dict[int, int]) -> bool:
        """Take more spare names for the views of which the answer uses the rest. Says whether there were any."""
        used = self._rests(answer)
        for view in used:
            self._spares[view] += 1
        if used:
            self._restart()
        return bool(used)

    def _rests(self, answer: dict[int, int]) -> set[int]:
        """The views of which the answer uses the rest."""
        return {self._rest[name] for name in answer.values() if name in self._rest}

    def _follow(self, answer: dict[int, int]) -> tuple[list[int], list[Link]]:
        """The name of every node, following the answer's links from node to node, and the links that it does not explain."""
        if self._all_given and not self._rests(answer):
            return [answer[node] for node in range(len(answer))], []
        goes: dict[tuple[int, int], int] = {(answer[t], action): answer[u] for t, action, u in self._links}
        labels = [-1] * len(self._chart.seen)  # -1: not known
        followed: list[_Trail] = [None] * len(labels)  # links since the last node that clingo named
        failed: dict[Link, None] = {}
        asked: set[tuple[int, int]] = set()  # one such link is asked for, not all
        labels[0] = answer[0]
        for link in self._chart.links:
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
        excluded = {node for pair in self._chart.excluded if labels[pair[0]] == labels[pair[1]] >= 0 for node in pair}
        if excluded:
            failed.update((link, None) for link in self._chart.links if link not in self._links and not excluded.isdisjoint(link[::2]))
        return labels, list(failed)

    def _not_given(self, trail: _Trail) -> Iterator[tuple[Link, None]]:
        """The links on a trail that clingo does not know."""
        while trail is not None:
            link, trail = trail
            if link not in self._links:
                yield link, None
