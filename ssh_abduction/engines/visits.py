"""An engine that finds the fewest dstates without naming any: clingo is asked which visits are one (visits.lp).

Names are poor knowledge where many dstates are known from few visits: what is learned of one spare name has to be learned again of
the next, and each is a choice for nodes all over the world. That two visits are the same is only about these two. A node is
*alone* if no node before it, in an order of choice, is at its dstate; there are as many dstates as lone nodes.

*Order.* A clique of nodes that are apart comes first, then what fits few others; what is new when the trace grows comes last, so what
clingo was told and what it learned still holds. As a clique first is the better order, a new control is taken when nodes are a tenth more.

*Transitive.* That I is J and J is K, so I is K, is said only of visits where an answer fails to hold it: there are some millions of
threes. Until no answer fails, what clingo solves is a relaxation, so its bounds hold.

*Lazily.* Of a long trace clingo is told of the first visits, until many of them may be one, and of the visits of the clique. An answer says
where the others are, too (`steps/localising.py`); where it does not, clingo is told of these visits, and of as many before them as it
takes. Fewer visits are a relaxation, and an answer that says where all visits are is one of them all: so more of the same costs no more.

*From below.* clingo is asked for an answer without lone nodes but those that are alone for sure. A core, nodes that cannot all be
avoided, raises the bound by one; from then on it is asked that at most one of them is alone, then two, and so on (OLL: Andres,
Kaufmann, Matheis, Schaub 2012, "Unsatisfiability-based optimization in clasp"). Each optimum of the whole holds what is asked for
in the end, so these answers are all minimal ones. clasp has that built in, but begins anew with each call, and an answer that
fails to be transitive is a call. Cores are made small as long as that is cheap: small ones are about one part of the world.

*Near a guess.* Where that takes long, some map is known soon: clingo is asked for answers in which visits are one that are one in the map made
of a guess. They need not have the fewest dstates. But where they have as few as the bound, they do.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import Self, TypeAlias, TypeVar

import clingo
import numpy as np

from ssh_abduction.asp import facts
from ssh_abduction.asp.control import new_control
from ssh_abduction.asp.limits import Watch
from ssh_abduction.engines.base import ChartedEngine
from ssh_abduction.steps.apart import clique
from ssh_abduction.steps.chart import Chart, FramedChart, numbered
from ssh_abduction.steps.localising import Located, State, faced, located, states_of
from ssh_abduction.steps.log import Log
from ssh_abduction.theory.speedups import Speedups
from ssh_abduction.theory.theory import Theory
from ssh_abduction.trace import Trace

SECONDS_A_PAIR = 3e-5  # what clingo takes, about, to ground two visits that may be one: it cannot be stopped meanwhile
FIRST_PAIRS = 10_000  # visits that may be one, of which clingo is told at first
AT_A_TIME = 20_000  # threes of visits that clingo is told of in one go
TRY_CONFLICTS = 100  # conflicts after which it is left open whether a core can be smaller
FAILED_TRIES = 20  # tries after which a core is kept as it is
GROWN = 1.1  # how many times as many nodes as at first a control may have, before a new one is taken with a better order
MANY = 5  # answers found one by one, after which they are looked for nearby
FAR = 200  # failures to be transitive after which an answer is not nearby

Pair: TypeAlias = tuple[int, int, int]  # visits I < J, R: slot 0 of I is slot R of J
Three: TypeAlias = tuple[int, int, int, int, int]  # visits I < J < K, and how I is turned to J, and J to K
Member = TypeVar("Member")
_Turned: TypeAlias = dict[int, dict[int, int]]  # of visits that are the same: which slot of the other slot 0 is


class TakesLong(Exception):  # noqa: N818 - not an error
    """Clingo has not found the fewest dstates yet, and something else is to be done first."""


class SameEngine(ChartedEngine):
    """Which visits are one, so that dstates are fewest.

    around  as in Chart.framed, where steps have no stars
    """

    _chart: FramedChart
    _known: tuple[int, ...] | None  # labels of a map; set by who finds one near a guess

    def __init__(
        self, trace: Trace, theory: Theory, watch: Watch, log: Log, speedups: Speedups, around: Mapping[int, Sequence[int]] | None = None
    ) -> None:
        super().__init__(trace, theory, watch, log, speedups)
        self._around = around

    def over(self, trace: Trace, watch: Watch, log: Log) -> Self:
        self._trace, self._watch, self._log = trace, watch, log
        self.ground_seconds = self.solve_seconds = 0.0
        return self

    def _charted(self, size: int) -> FramedChart:
        """The nodes and visits of the first steps."""
        raise NotImplementedError

    def grow(self, size: int) -> None:
        """Chart the first steps, and tell clingo what is new of their visits; in a new control if that is much."""
        if size == self.size:
            return
        began = time.perf_counter()
        grown = self.size > 0
        if grown:
            chart = Chart.framed(self._trace, self._log, size, self._around).with_elsewhere(self._chart.elsewhere)
            grown = len(chart.seen) <= GROWN * self._first_nodes
        if grown:
            new = range(len(self._chart.stars), len(chart.stars)) if self._knows_all else ()
            self._give(chart, {*self._visits, *new}, range(len(chart.seen)))
        else:
            chart = self._charted(size)
            apart = chart.apart()
            self._watch.check()
            self.clique = clique(apart, chart.seen) if self._speedups.clique else []
            order = [*self.clique, *sorted(set(range(len(apart))) - set(self.clique), key=lambda node: (-int(apart[node].sum()), node))]
            self._give(chart, self._first_visits(chart), order, anew=True)
        self.size = size
        self._found: list[tuple[int, ...]] = []  # labels with the fewest dstates
        self._known = None
        self.ground_seconds += time.perf_counter() - began

    def _first_visits(self, chart: FramedChart) -> set[int]:
        """The visits that clingo is told of first: all, unless too many may be one."""
        first = chart.visits_with(FIRST_PAIRS) if self._speedups.lazy else len(chart.stars)
        return {*range(first), *(chart.facing[node][0] for node in self.clique)}

    @property
    def _knows_all(self) -> bool:
        """Whether clingo was told of all visits."""
        return len(self._visits) == len(self._chart.stars)

    def _begin(self, chart: FramedChart) -> None:
        """Take a control that knows nothing, for visits of a chart."""
        self._first_nodes = len(chart.seen)
        self._control = new_control("visits", "", ["--heuristic=Domain"], self._speedups)
        self._batch = -1
        self._visits: set[int] = set()  # that clingo knows, and of these
        self._place_of: dict[int, int] = {}  # where nodes are in the order of choice
        self._ends: set[int] = set()  # visits of which it knows how they end
        self._turns: set[tuple[int, str, int]] = set()
        self._fits: frozenset[Pair] = frozenset()
        self._least = 0
        self._avoided: dict[int, clingo.Symbol] = {}  # what is assumed not to be there, by the literal of that
        self._pair_of = _PairOf()
        self._unread: list[Pair] = []  # whose literals were not asked for yet
        self._transitive = _Transitive()
        self._control.register_propagator(self._transitive)
        self._core_sizes: list[int] = []
        self._parts = 0

    def _give(self, chart: FramedChart, visits: set[int], order: Iterable[int], *, anew: bool = False) -> None:
        """Tell clingo what it does not know yet of these visits of a chart. New nodes come after the others in the order of choice."""
        told = sorted(visits)
        known = 0 if anew else len(self._fits)
        self._watch.check(SECONDS_A_PAIR * (int(chart.fitting[-1]) - known) if len(told) == len(chart.stars) else 0.0)
        fits = frozenset(chart.fits(told))
        self._watch.check(SECONDS_A_PAIR * (len(fits) - known))
        size, self.size = self.size, 0  # until clingo was told all of it
        if anew:
            self._begin(chart)
        else:
            self._control.release_external(facts.listed(self._batch))
        self._chart = chart
        self._batch += 1
        added = sorted(visits - self._visits)
        self._visits |= visits
        nodes = []
        for node in order:
            if node not in self._place_of and chart.facing[node][0] in visits:
                self._place_of[node] = len(self._place_of)
                nodes.append((self._place_of[node], *chart.facing[node]))
        leaves = [
            (visit, *how) for visit, how in chart.leaves.items() if visit in visits and visit + 1 in visits and visit not in self._ends
        ]
        self._ends.update(visit for visit, *_ in leaves)
        turns = [turn for turn in chart.turns(self._trace) if turn not in self._turns and chart.facing[turn[0]][0] in visits]
        self._turns.update(turns)
        new, unfit = sorted(fits - self._fits), sorted(self._fits - fits)
        self._fits = fits
        part = f"visits_{self._batch}"
        self._control.add(part, [], facts.visit_facts(self._batch, nodes, leaves, new, unfit))
        self._control.add(part, [], facts.turn_facts(self._batch, chart, added, turns))
        self._control.ground([(part, []), ("more", facts.numbers(self._batch))])
        self._control.assign_external(facts.listed(self._batch), True)
        atoms = self._control.symbolic_atoms
        for place, *_ in nodes:
            atom = atoms[facts.alone(place)]
            if atom and (atom.is_fact or not self._speedups.core_guided):
                self._least += atom.is_fact
            elif atom:
                self._avoided[-atom.literal] = atom.symbol
        self._raise_bound()
        self._unread += new
        self._excluded = 0  # so many of the labels found clingo will not find again
        self.size = size

    def _give_more(self, visits: Iterable[int]) -> None:
        """Tell clingo of these visits, too."""
        began = time.perf_counter()
        more = {*self._visits, *visits}
        assert more != self._visits  # else that would go on without end
        self._give(self._chart, more, range(len(self._chart.seen)))
        self.ground_seconds += time.perf_counter() - began

    def _raise_bound(self) -> None:
        self.bound = max(self.bound or 0, self._least)

    def _minimal_labels(self, until: Callable[[], bool] = lambda: False) -> list[int] | None:
        """Dstates of all nodes, as few as can be; None where clingo was told more than any can satisfy. Raises TakesLong where `until` holds."""
        while not self._found:
            if self._known and self.bound == len(set(self._known)):
                self._found.append(self._known)
                break
            pairs = self._fewest(until)
            if pairs is None:
                return None
            if labels := self._settled(pairs):
                self._found.append(labels)
        return list(self._found[0])

    def _settled(self, pairs: Sequence[Pair]) -> tuple[int, ...] | None:
        """The dstate of each node in an answer; None if that is not transitive, or does not say where all visits are, and clingo is told so."""
        if threes := self._intransitive(pairs):
            self._close(threes)
            return None
        everywhere = self._located(pairs)
        if everywhere.missed:
            self._give_more(everywhere.missed)
            return None
        return self._labels(everywhere)

    def _fewest(self, until: Callable[[], bool]) -> list[Pair] | None:
        """An answer with the fewest lone nodes."""
        if not self._speedups.core_guided:
            better = list(self._answers(lambda model: (self._pairs(model), model.cost[0]), "opt", 0))
            if not better:
                return None
            pairs, self._least = better[-1]
            self._raise_bound()
            return pairs
        while True:
            if until():
                raise TakesLong
            answer, core = self._verdict(self._pairs, list(self._avoided), until=until)
            if core is None:
                if answer is None:
                    raise TakesLong
                return answer
            if not core:
                return None
            self._relax(self._smaller(core) if self._speedups.small_cores else core)

    def _pairs(self, model: clingo.Model) -> list[Pair]:
        return [self._pair_of[symbol] for symbol in model.symbols(shown=True)]

    def _read_literals(self) -> None:
        """Look up the literals that two visits are one: that takes seconds where there are many, and is seldom needed."""
        atoms = self._control.symbolic_atoms
        for pair in self._unread:
            if atom := atoms[facts.same(pair)]:
                self._transitive.literals[pair] = atom.literal
        self._unread = []

    def _smaller(self, core: list[int]) -> list[int]:
        """A core of fewer members, as long as that is cheap."""
        return smaller(core, lambda part: self._verdict(lambda _: None, part, TRY_CONFLICTS)[1], FAILED_TRIES)

    def _relax(self, core: Sequence[int]) -> None:
        """As not all members of a core can be avoided, ask only that no two of them are there."""
        members = [self._avoided.pop(literal) for literal in core]
        self._least += 1
        self._raise_bound()
        for member in members:
            if (over := facts.read_over(member)) is not None:
                self._limit(over[0], over[1] + 1)
        if len(members) > 1:
            number = len(self._core_sizes)
            self._core_sizes.append(len(members))
            self._tell(facts.core_facts(number, members), "core", number)
            self._limit(number, 2)

    def _limit(self, core: int, count: int) -> None:
        """Ask that fewer than so many members of a core are there."""
        if count <= self._core_sizes[core]:
            self._control.ground([("over", facts.numbers(core, count))])
            if atom := self._control.symbolic_atoms[facts.over(core, count)]:
                self._avoided[-atom.literal] = atom.symbol

    def _tell(self, told: str, part: str | None = None, number: int = 0) -> None:
        """Tell clingo more. No limit stops this: a core whose members are no longer avoided has to get its limit."""
        began = time.perf_counter()
        name = f"told_{self._parts}"
        self._parts += 1
        self._control.add(name, [], told)
        self._control.ground([(name, [])])
        if part is not None:
            self._control.ground([(part, facts.numbers(number))])
        self.ground_seconds += time.perf_counter() - began

    def _close(self, threes: Iterable[Three]) -> None:
        """Tell clingo that to be the same is transitive, of these visits."""
        self._tell(facts.three_facts(self._parts, threes), "closed", self._parts)

    def _labels_near(self, guess: Sequence[int]) -> Iterator[tuple[int, ...] | None]:
        """Labels of all nodes near those of a map: that first, then others, where visits of a place of its are one. None now and then.

        First no others are one where that can be, until these are labels of a map that is taken for `known`. Then clingo is asked for no
        lone nodes; of those that a core shows to be too many, one is left alone. Visits of places that cannot all be as guessed are let free.
        """
        yield tuple(numbered(guess))
        states = states_of(self._chart, guess)
        place_of: dict[int, int] = {}  # by the literal that two of its visits are one
        freed: set[int] = set()
        avoided: set[int] = set()
        patient, pairs, batch = False, 0, -1
        while True:
            if batch < self._batch:
                batch = self._batch
                self._read_literals()
                for (i, j, r), literal in islice(self._transitive.literals.items(), pairs, None):
                    if states[i] // 4 != states[j] // 4 or (states[i] - states[j]) % 4 != r:
                        avoided |= set() if patient else {-literal}
                    elif states[i] // 4 not in freed:
                        place_of[literal] = states[i] // 4
                pairs = len(self._transitive.literals)
                patient = False
            if self._known and not patient:
                patient, avoided = True, set(self._avoided)
            yield None
            answer, core = self._verdict(self._pairs, [*place_of, *avoided])
            if core is not None:
                if fewer := [literal for literal in core if literal in avoided]:
                    avoided.difference_update(fewer[-1:] if patient else fewer)
                elif core:
                    freed.update(self._together_impossible(sorted({place_of[literal] for literal in core}), place_of))
                    place_of = {literal: place for literal, place in place_of.items() if place not in freed}
                else:
                    return
            elif labels := self._settled(answer or ()):
                yield labels

    def _together_impossible(self, places: list[int], place_of: Mapping[int, int]) -> list[int]:
        """Of places that cannot all be as guessed, few that cannot."""

        def impossible(some: list[int]) -> list[int] | None:
            core = self._verdict(lambda _: None, [literal for literal, place in place_of.items() if place in some], TRY_CONFLICTS)[1]
            return None if core is None else sorted({place_of[literal] for literal in core})

        return smaller(places, impossible, FAILED_TRIES)

    def _labels_of(self, dstates: int) -> Generator[list[int], None, None]:
        """All ways to be at so many dstates, each once.

        Each is asked for as the fewest dstates were, once clingo is told not to find again what was found: so it is soon seen that there
        is no other. Where there are many, the next one is near, and a propagator keeps answers transitive (`_nearby`).
        """
        if self._minimal_labels() is None or self._least > dstates:
            return
        yield from map(list, self._found)
        asked = 0
        while True:
            known = [self._spanning(found, self._place_of) for found in self._found[self._excluded :]]
            self._tell("\n".join(facts.forbidden_pairs(pairs, listed=self._batch) for pairs in known))
            self._excluded = len(self._found)
            labels = self._other(dstates)
            if labels is None:
                return
            self._found.append(labels)
            yield list(labels)
            asked += 1
            if asked == MANY:
                asked = 0
                if (yield from self._nearby(dstates)):
                    return

    def _nearby(self, dstates: int) -> Generator[list[int], None, bool]:
        """Answers, each from the one before. Returns whether these are all that was not excluded."""

        def read(model: clingo.Model) -> Located:
            self._transitive.failed = 0
            return self._located(self._pairs(model))

        excluded = set(self._found[self._excluded :])
        self._read_literals()
        self._transitive.asked, self._transitive.failed = True, 0
        mode, assumed = self._asking_for(dstates)
        answers = self._answers(read, mode, 0, assumptions=assumed, until=lambda: self._transitive.failed > FAR)
        try:
            while True:
                try:
                    everywhere = next(answers)
                except StopIteration as end:
                    return bool(end.value)
                if everywhere.missed:
                    break
                labels = self._labels(everywhere)
                if labels not in excluded:
                    self._found.append(labels)
                    yield list(labels)
        finally:
            answers.close()
            self._transitive.asked = False
        self._give_more(everywhere.missed)
        return False

    def _other(self, dstates: int) -> tuple[int, ...] | None:
        """An answer of so many dstates that was not excluded."""
        while True:
            mode, assumed = self._asking_for(dstates)
            pairs, _ = self._verdict(self._pairs, assumed, mode=mode)
            if pairs is None:
                return None
            if labels := self._settled(pairs):
                return labels

    def _asking_for(self, dstates: int) -> tuple[str, list[int]]:
        """How clingo is asked for so many dstates, at most, and what is assumed."""
        if self._speedups.core_guided and self._least == dstates:
            return "ignore", list(self._avoided)
        return f"enum,{dstates}", []

    def _refuse(self, labels: Sequence[int]) -> None:
        """Take back labels that turned out to be no answer."""
        if (refused := tuple(labels)) in self._found:
            self._excluded -= self._found.index(refused) < self._excluded
            self._found.remove(refused)

    def _spanning(self, labels: Sequence[int], nodes: Iterable[int]) -> list[Pair]:
        """Pairs that are the same if these nodes are at the dstates that they are labelled with."""
        first: dict[int, int] = {}
        return [self._pair(other, node) for node in nodes if (other := first.setdefault(labels[node], node)) != node]

    def _pair(self, a: int, b: int) -> Pair:
        """How the visits of two nodes are turned where these are at one dstate."""
        (i, s), (j, t) = sorted((self._chart.facing[a], self._chart.facing[b]))
        return i, j, (t - s) % 4

    def _intransitive(self, pairs: Sequence[Pair]) -> list[Three]:
        """Visits of which an answer, with what follows from it, does not hold that to be the same is transitive."""
        found: dict[Three, None] = {}
        turned: _Turned = {}
        leaves = self._chart.leaves
        work = _scattered(pairs, len(self._chart.stars))
        if not work:
            return []
        for pair in pairs:
            _take(turned, pair)
        for i, j, r in work:
            follows = [(i + 1, j + 1, 0)] if i in leaves and leaves.get(j) == ((leaves[i][0] + r) % 4, leaves[i][1]) else []
            for first, (middle, half), (last, turn) in _apart_yet_joined((i, j, r), turned):
                found[_in_order((first, 0), (middle, half), (last, turn))] = None
                follows.append(_pair(first, last, turn))
            for pair in follows:
                if pair in self._fits and pair[1] not in turned.get(pair[0], ()):
                    _take(turned, pair)
                    work.append(pair)
            if len(found) >= AT_A_TIME:
                break
        return list(found)

    def _located(self, pairs: Iterable[Pair]) -> Located:
        """Where all visits are in an answer that is transitive."""
        first: dict[int, tuple[int, int]] = {}
        for i, j, r in sorted(pairs):
            first.setdefault(j, (i, r))
        number: dict[int, int] = {}
        states: dict[int, State] = {}
        for visit in sorted(self._visits):
            i, r = first.get(visit, (visit, 0))
            states[visit] = 4 * number.setdefault(i, len(number)) + -r % 4
        return located(self._chart, states)

    def _labels(self, everywhere: Located) -> tuple[int, ...]:
        """The dstate of each node, numbered by the first node there."""
        return tuple(numbered(faced(everywhere.states[visit], slot) for visit, slot in self._chart.facing))


def smaller(members: list[Member], shrunk: Callable[[list[Member]], list[Member] | None], tries: int | None = None) -> list[Member]:
    """Fewer members that still have what all of them have: parts are left out, half of them first, single members last.

    shrunk  of some members those that have it, if they do
    tries   after so many in vain, what is left is returned
    """
    size, failed = len(members), 0
    while size := size // 2:
        start = 0
        while start < len(members) and len(members) > 1:
            fewer = shrunk(members[:start] + members[start + size :])
            if fewer is not None:
                members = fewer
                continue
            start += size
            failed += 1
            if failed == tries:
                return members
    return members


class _PairOf(dict[clingo.Symbol, Pair]):
    """The visits that atoms say are one, each atom read once."""

    def __missing__(self, symbol: clingo.Symbol) -> Pair:
        pair = self[symbol] = facts.read_same(symbol)
        return pair


class _Transitive(clingo.Propagator):
    """A propagator for when all answers are wanted: few conflicts, and each answer has to be transitive."""

    def __init__(self) -> None:
        self.asked = False
        self.failed = 0  # how often not, since this was set to 0
        self.literals: dict[Pair, int] = {}  # of the program
        self._watched: dict[int, list[Pair]] = {}
        self._literals: dict[Pair, int] = {}
        self._turned: _Turned = {}

    def init(self, init: clingo.PropagateInit) -> None:
        for literal in self._watched:
            init.remove_watch(literal)
        self._watched, self._turned = {}, {}
        if not self.asked:
            return
        for pair, program_literal in self.literals.items():
            literal = self._literals[pair] = init.solver_literal(program_literal)
            self._watched.setdefault(literal, []).append(pair)
            if init.assignment.is_true(literal):
                _take(self._turned, pair)
        for literal in self._watched:
            init.add_watch(literal)

    def propagate(self, control: clingo.PropagateControl, changes: Sequence[int]) -> None:
        pairs = [pair for literal in changes for pair in self._watched.get(literal, ())]
        for pair in pairs:
            _take(self._turned, pair)
        for pair in pairs:
            for first, (middle, half), (last, turn) in _apart_yet_joined(pair, self._turned):
                self.failed += 1
                clause = [-self._literals[pair], -self._literals[_pair(middle, last, (turn - half) % 4)]]
                if (third := self._literals.get(_pair(first, last, turn))) is not None:
                    clause.append(third)
                if not control.add_clause(clause, lock=True) or not control.propagate():
                    return

    def undo(self, thread: int, assignment: clingo.Assignment, changes: Sequence[int]) -> None:
        for literal in changes:
            for i, j, _ in self._watched.get(literal, ()):
                self._turned.get(i, {}).pop(j, None)
                self._turned.get(j, {}).pop(i, None)


def _scattered(pairs: Sequence[Pair], visits: int) -> list[Pair]:
    """The pairs of an answer but those of visits each of which is one with all others that any is one with, turned as these say."""
    first, second, turns = np.array(pairs, dtype=int).reshape(-1, 3).T
    group = np.arange(visits)  # the first visit that each is one with
    np.minimum.at(group, second, first)
    turned = np.zeros(visits, dtype=int)  # the slot that slot 0 of that visit is
    at_first = group[second] == first
    turned[second[at_first]] = turns[at_first]
    members, joined = np.bincount(group, minlength=visits), np.bincount(group[first], minlength=visits)
    wrong = (group[first] != group[second]) | ((turned[second] - turned[first]) % 4 != turns)
    scattered = joined != members * (members - 1) // 2
    scattered[group[first[wrong]]] = scattered[group[second[wrong]]] = True
    return [pair for pair, bad in zip(pairs, scattered[group[first]] | scattered[group[second]], strict=True) if bad]


def _take(turned: _Turned, pair: Pair) -> None:
    i, j, r = pair
    turned.setdefault(i, {})[j] = r
    turned.setdefault(j, {})[i] = -r % 4


def _apart_yet_joined(pair: Pair, turned: _Turned) -> list[tuple[int, tuple[int, int], tuple[int, int]]]:
    """Visits that are not the same though each is the same as a third, by this pair and another: the first one, the third
    and the last, these two with the slot that slot 0 of the first one would be."""
    i, j, r = pair
    of_i, of_j = turned[i], turned[j]
    joined = [(i, (j, r), (k, (r + q) % 4)) for k, q in of_j.items() if k != i and of_i.get(k) != (r + q) % 4]
    return joined + [(j, (i, -r % 4), (k, (q - r) % 4)) for k, q in of_i.items() if k != j and of_j.get(k) != (q - r) % 4]


def _pair(i: int, j: int, r: int) -> Pair:
    """Two visits in order, where slot 0 of the one is slot R of the other."""
    return (i, j, r) if i < j else (j, i, -r % 4)


def _in_order(*visits: tuple[int, int]) -> Three:
    """Three visits at one place, each with the slot of it that slot 0 of the first one is."""
    (i, a), (j, b), (k, c) = sorted(visits)
    return i, j, k, (b - a) % 4, (c - b) % 4
