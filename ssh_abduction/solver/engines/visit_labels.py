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
fails to be transitive is a call.

*Near a guess.* Where that takes long, some map is known soon: clingo is asked for answers in which visits are one that are one in the map made
of a guess. They need not have the fewest dstates. But where they have as few as the bound, they do.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import partial
from itertools import combinations, islice
from typing import Final, Protocol, TypeAlias, TypeVar

import clingo
import numpy as np

from ssh_abduction.solver.asp.control import Asker, new_control
from ssh_abduction.solver.asp.facts import sides_lp, visits_lp
from ssh_abduction.solver.asp.facts.atoms import numbers
from ssh_abduction.solver.engines.base import Task
from ssh_abduction.solver.engines.refusing import first_accepted
from ssh_abduction.solver.steps.apart import clique
from ssh_abduction.solver.steps.chart import FramedChart, numbered
from ssh_abduction.solver.steps.localising import Located, State, faced, located, states_of

# Clingo takes so many seconds, about, to ground two visits that may be one. It cannot be stopped meanwhile.
SECONDS_A_PAIR = 3e-5
# Clingo is told of the first visits with so many pairs that may be one, and of others as answers need them.
FIRST_PAIRS = 10_000
# Clingo is told of so many threes of visits in one go, at most: they are found faster than they are grounded.
AT_A_TIME = 20_000
# After so many conflicts it is left open whether fewer places still clash.
TRY_CONFLICTS = 100
# After so many tries in vain a set of places that clash is kept as it is.
FAILED_TRIES = 20
# With so many times as many nodes as at first a new control is taken, as the order of choice, made for the first nodes, no longer suits.
GROWN = 1.1
# After so many answers found one by one the next ones are looked for nearby, which pays where there are many.
MANY = 5
# After so many failures to be transitive an answer is not nearby, and is asked for anew.
FAR = 200

Pair: TypeAlias = tuple[int, int, int]  # visits I < J, R: slot 0 of I is slot R of J
Three: TypeAlias = tuple[
    int, int, int, int, int
]  # visits I < J < K, and how I is turned to J, and J to K
Member = TypeVar("Member")
_Turned: TypeAlias = dict[
    int, dict[int, int]
]  # of visits that are the same: which slot of the other slot 0 is


class Open(Enum):
    """Stands for an answer that is not known yet, as something else is to be done first."""

    OPEN = "open"


OPEN: Final = Open.OPEN


@dataclass
class _Answer:
    """The pairs of visits that are one, and, once they are known to be transitive, where all visits are; or that the answer is not known yet."""

    pairs: Sequence[Pair] = ()
    everywhere: Located | None = None
    is_open: bool = False


@dataclass(frozen=True)
class _Reason:
    """Why an answer is none: threes of visits that it is not transitive on, or else visits that it does not say the places of."""

    threes: Sequence[Three]
    missed: Collection[int]


class Sides(Protocol):
    """What tells clingo of order and sides, along with visits (`engines/sides.py`)."""

    def begin(self) -> None:
        """The control is a new one, which knows nothing."""
        ...

    def extend(self, batch: int) -> None:
        """Clingo was told of more visits, in this batch."""
        ...


class VisitLabels:
    """Labels of the nodes of the first steps with the fewest dstates, by which visits are at one place.

    bound   no labels have fewer dstates
    clique  nodes that are pairwise apart
    known   labels of a map, if one is known; set by who finds one near a guess
    chart   of the first `size` steps
    has_forbidden  whether evidence forbade something that was found out of a map
    least   how many dstates clingo itself has shown to be needed
    batch   the number of the last visits that clingo was told of in one go
    """

    chart: FramedChart

    def __init__(
        self,
        task: Task,
        asker: Asker,
        charted: Callable[[int, FramedChart | None], FramedChart | None],
        sides: Sides,
    ) -> None:
        """Labels of no steps yet.

        charted  makes the chart of so many first steps, from one of fewer steps if there is one; None where they fit no frame
        sides    is told of new controls and of batches
        """
        self.bound: int | None = None
        self.clique: list[int] = []
        self.known: tuple[int, ...] | None = None
        self.has_forbidden = False
        self.size = 0
        self.batch = -1
        self.least = 0
        self._task, self._asker, self._charted, self._sides = task, asker, charted, sides

    def work_on(self, task: Task) -> None:
        """Go on with a trace that the one before has grown to."""
        self._task = task

    def grow(self, size: int) -> bool:
        """Chart the first steps, and tell clingo what is new of their visits; in a new control if that is much. False where visits fit no frame."""
        if size == self.size:
            return True
        with self._asker.grounding_timed():
            grown = self._charted(size, self.chart) if self.size else None
            if grown is not None and len(grown.seen) <= GROWN * self._first_nodes:
                new = range(len(self.chart.stars), len(grown.stars)) if self.knows_all else ()
                self._give(grown, {*self._visits, *new}, range(len(grown.seen)))
            else:
                chart = self._charted(size, None)
                if chart is None:
                    return False
                order = self._order_of_choice(
                    chart
                )  # which finds the clique, whose visits are among the first
                self._give(chart, self._first_visits(chart), order, anew=True)
            self.size = size
            self._found: list[tuple[int, ...]] = []  # labels with the fewest dstates
            self.known = None
            return True

    def _order_of_choice(self, chart: FramedChart) -> list[int]:
        """The nodes, those first that are pairwise apart, then those that fit few others."""
        apart = chart.apart()
        self._asker.watch.check()
        self.clique = clique(apart, chart.seen) if self._task.speedups.clique else []
        return [
            *self.clique,
            *sorted(
                set(range(len(apart))) - set(self.clique),
                key=lambda node: (-int(apart[node].sum()), node),
            ),
        ]

    def _first_visits(self, chart: FramedChart) -> set[int]:
        """The visits that clingo is told of first: all, unless too many may be one."""
        first = chart.visits_with(FIRST_PAIRS) if self._task.speedups.lazy else len(chart.stars)
        return {*range(first), *(chart.facing[node][0] for node in self.clique)}

    @property
    def knows_all(self) -> bool:
        """Whether clingo was told of all visits."""
        return len(self._visits) == len(self.chart.stars)

    @property
    def pairs(self) -> int:
        """How many pairs of visits may be one, of those that clingo knows."""
        return len(self._fits)

    def _begin(self, chart: FramedChart) -> None:
        """Take a control that knows nothing, for visits of a chart."""
        self._first_nodes = len(chart.seen)
        self._asker.control = new_control("visits", "", ["--heuristic=Domain"])
        self.batch = -1
        self._visits: set[int] = set()  # that clingo knows, and of these
        self._place_of: dict[int, int] = {}  # where nodes are in the order of choice
        self._ends: set[int] = set()  # visits of which it knows how they end
        self._turns: set[tuple[int, str, int]] = set()
        self._fits: frozenset[Pair] = frozenset()
        self.least = 0
        self._avoided: dict[
            int, clingo.Symbol
        ] = {}  # what is assumed not to be there, by the literal of that
        self._pair_of = _PairOf()
        self._unread: list[Pair] = []  # whose literals were not asked for yet
        self._transitive = _Transitive()
        self._asker.control.register_propagator(self._transitive)
        self._core_sizes: list[int] = []
        self._parts = 0
        self._sides.begin()

    def _give(
        self, chart: FramedChart, visits: set[int], order: Iterable[int], *, anew: bool = False
    ) -> None:
        """Tell clingo what it does not know yet of these visits of a chart. New nodes come after the others in the order of choice."""
        told = sorted(visits)
        known = 0 if anew else len(self._fits)
        self._asker.watch.check(
            SECONDS_A_PAIR * (int(chart.fitting[-1]) - known)
            if len(told) == len(chart.stars)
            else 0.0
        )
        fits = frozenset(chart.fits(told))
        self._asker.watch.check(SECONDS_A_PAIR * (len(fits) - known))
        size, self.size = self.size, 0  # until clingo was told all of it
        if anew:
            self._begin(chart)
        else:
            self._asker.control.release_external(visits_lp.listed(self.batch))
        self.chart = chart
        self.batch += 1
        added = sorted(visits - self._visits)
        self._visits |= visits
        nodes = []
        for node in order:
            if node not in self._place_of and chart.facing[node][0] in visits:
                self._place_of[node] = len(self._place_of)
                nodes.append((self._place_of[node], *chart.facing[node]))
        leaves = [
            (visit, *how)
            for visit, how in chart.leaves.items()
            if visit in visits and visit + 1 in visits and visit not in self._ends
        ]
        self._ends.update(visit for visit, *_ in leaves)
        turns = [
            turn
            for turn in chart.turns(self._task.trace)
            if turn not in self._turns and chart.facing[turn[0]][0] in visits
        ]
        self._turns.update(turns)
        new, unfit = sorted(fits - self._fits), sorted(self._fits - fits)
        self._fits = fits
        part = f"visits_{self.batch}"
        self._asker.control.add(
            part, [], visits_lp.visit_facts(self.batch, nodes, leaves, new, unfit)
        )
        self._asker.control.add(part, [], sides_lp.turn_facts(self.batch, chart, added, turns))
        self._asker.control.ground([(part, []), ("more", numbers(self.batch))])
        self._asker.control.assign_external(visits_lp.listed(self.batch), True)
        atoms = self._asker.control.symbolic_atoms
        for place, *_ in nodes:
            atom = atoms[visits_lp.first(place)]
            if atom and (atom.is_fact or not self._task.speedups.core_guided):
                self.least += atom.is_fact
            elif atom:
                self._avoided[-atom.literal] = atom.symbol
        self._raise_bound()
        self._unread += new
        self._excluded = 0  # so many of the labels found clingo will not find again
        self._sides.extend(self.batch)
        self.size = size

    def _give_more(self, visits: Iterable[int]) -> None:
        """Tell clingo of these visits, too."""
        more = {*self._visits, *visits}
        assert more != self._visits  # else that would go on without end
        with self._asker.grounding_timed():
            self._give(self.chart, more, range(len(self.chart.seen)))

    def _raise_bound(self) -> None:
        self.bound = max(self.bound or 0, self.least)

    def fewest(self, until: Callable[[], bool] = lambda: False) -> list[int] | Open | None:
        """Labels of all nodes with the fewest dstates; None where clingo was told more than any can satisfy; OPEN where `until` holds before that is known."""
        while not self._found:
            if self.known and self.bound == len(set(self.known)):
                self._found.append(self.known)
                break
            answer = first_accepted(
                partial(self._best_answer, until), self._why_not, self._tell_why
            )
            if answer is None:
                return None
            if answer.is_open:
                return OPEN
            self._found.append(self._labels_by(answer))
        return list(self._found[0])

    def _why_not(self, answer: _Answer) -> _Reason | None:
        """Why an answer is none: it is not transitive, or does not say where all visits are."""
        if answer.is_open:
            return None
        threes = self._intransitive(answer.pairs)
        if not threes:
            answer.everywhere = self._located(answer.pairs)
        missed = answer.everywhere.missed if answer.everywhere else ()
        return _Reason(threes, missed) if threes or missed else None

    def _tell_why(self, reason: _Reason) -> None:
        """Tell clingo what an answer did not hold."""
        if reason.threes:
            self._close(reason.threes)
        else:
            self._give_more(reason.missed)

    def _labels_by(self, answer: _Answer) -> tuple[int, ...]:
        """The labels by an answer that nothing speaks against."""
        assert answer.everywhere is not None
        return self._labels(answer.everywhere)

    def _best_answer(self, until: Callable[[], bool]) -> _Answer | None:
        """An answer with the fewest lone nodes."""
        if not self._task.speedups.core_guided:
            better = list(
                self._asker.answers(lambda model: (self._pairs(model), model.cost[0]), "opt", 0)
            )
            if not better:
                return None
            pairs, self.least = better[-1]
            self._raise_bound()
            return _Answer(pairs)
        while True:
            if until():
                return _Answer(is_open=True)
            pairs_found, core = self._asker.verdict(self._pairs, list(self._avoided), until=until)
            if core is None:
                return _Answer(pairs_found or (), is_open=pairs_found is None)
            if not core:
                return None
            self._relax(core)

    def _pairs(self, model: clingo.Model) -> list[Pair]:
        return [self._pair_of[symbol] for symbol in model.symbols(shown=True)]

    def _read_literals(self) -> None:
        """Look up the literals that two visits are one: that takes seconds where there are many, and is seldom needed."""
        atoms = self._asker.control.symbolic_atoms
        for pair in self._unread:
            if atom := atoms[visits_lp.same(pair)]:
                self._transitive.literals[pair] = atom.literal
        self._unread = []

    def _relax(self, core: Sequence[int]) -> None:
        """As not all members of a core can be avoided, ask only that no two of them are there."""
        members = [self._avoided.pop(literal) for literal in core]
        self.least += 1
        self._raise_bound()
        for member in members:
            if (over := visits_lp.read_over(member)) is not None:
                self._limit(over[0], over[1] + 1)
        if len(members) > 1:
            number = len(self._core_sizes)
            self._core_sizes.append(len(members))
            self._tell(visits_lp.core_facts(number, members), "core", number)
            self._limit(number, 2)

    def _limit(self, core: int, count: int) -> None:
        """Ask that fewer than so many members of a core are there."""
        if count <= self._core_sizes[core]:
            self._asker.control.ground([("over", numbers(core, count))])
            if atom := self._asker.control.symbolic_atoms[visits_lp.over(core, count)]:
                self._avoided[-atom.literal] = atom.symbol

    def _tell(self, told: str, part: str | None = None, number: int = 0) -> None:
        """Tell clingo more. No limit stops this: a core whose members are no longer avoided has to get its limit."""
        with self._asker.grounding_timed():
            name = f"told_{self._parts}"
            self._parts += 1
            self._asker.control.add(name, [], told)
            self._asker.control.ground([(name, [])])
            if part is not None:
                self._asker.control.ground([(part, numbers(number))])

    def _close(self, threes: Iterable[Three]) -> None:
        """Tell clingo that to be the same is transitive, of these visits."""
        self._tell(visits_lp.three_facts(self._parts, threes), "closed", self._parts)

    def near(self, guess: Sequence[int]) -> Iterator[tuple[int, ...] | None]:
        """First the guess itself, then improved labels of all nodes; yields None between queries so that the caller can do other work.

        Clingo is asked for labels in which visits that the guess has at one place are at one place. At first no other visits are, as far as
        that can be, until the caller takes such labels for `known`. Then it is asked for no lone nodes; of those that a core shows to be too
        many, one is left alone. Visits of places that cannot all be as guessed are let free.
        """
        yield tuple(numbered(guess))
        states = states_of(self.chart, guess)
        place_of: dict[int, int] = {}  # by the literal that two of its visits are one
        freed: set[int] = set()
        avoided: set[int] = set()
        patient, pairs, batch = False, 0, -1
        while True:
            if batch < self.batch:
                batch = self.batch
                self._read_literals()
                for (i, j, r), literal in islice(self._transitive.literals.items(), pairs, None):
                    if states[i] // 4 != states[j] // 4 or (states[i] - states[j]) % 4 != r:
                        avoided |= set() if patient else {-literal}
                    elif states[i] // 4 not in freed:
                        place_of[literal] = states[i] // 4
                pairs = len(self._transitive.literals)
                patient = False
            if self.known and not patient:
                patient, avoided = True, set(self._avoided)
            yield None
            pairs_found, core = self._asker.verdict(self._pairs, [*place_of, *avoided])
            if core is not None:
                if fewer := [literal for literal in core if literal in avoided]:
                    avoided.difference_update(fewer[-1:] if patient else fewer)
                elif core:
                    freed.update(
                        self._together_impossible(
                            sorted({place_of[literal] for literal in core}), place_of
                        )
                    )
                    place_of = {
                        literal: place for literal, place in place_of.items() if place not in freed
                    }
                else:
                    return
            elif (reason := self._why_not(answer := _Answer(pairs_found or []))) is not None:
                self._tell_why(reason)
            else:
                yield self._labels_by(answer)

    def _together_impossible(self, places: list[int], place_of: Mapping[int, int]) -> list[int]:
        """Of places that cannot all be as guessed, few that cannot."""

        def impossible(some: list[int]) -> list[int] | None:
            core = self._asker.verdict(
                lambda _: None,
                [literal for literal, place in place_of.items() if place in some],
                TRY_CONFLICTS,
            )[1]
            return None if core is None else sorted({place_of[literal] for literal in core})

        return smaller(places, impossible, FAILED_TRIES)

    def all_of(self, dstates: int) -> Generator[list[int], None, None]:
        """All ways to be at so many dstates, each once.

        Each is asked for as the fewest dstates were, once clingo is told not to find again what was found: so it is soon seen that there
        is no other. Where there are many, the next one is near, and a propagator keeps answers transitive (`_nearby`).
        """
        if self.fewest() is None or self.least > dstates:
            return
        yield from map(list, self._found)
        asked = 0
        while True:
            known = [
                self._spanning(found, self._place_of) for found in self._found[self._excluded :]
            ]
            self._tell(
                "\n".join(visits_lp.forbidden_pairs(pairs, listed=self.batch) for pairs in known)
            )
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
        answers = self._asker.answers(
            read, mode, 0, assumptions=assumed, until=lambda: self._transitive.failed > FAR
        )
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
        """Labels with so many dstates that were not excluded."""

        def ask() -> _Answer | None:
            mode, assumed = self._asking_for(dstates)
            found, _ = self._asker.verdict(self._pairs, assumed, mode=mode)
            return None if found is None else _Answer(found)

        answer = first_accepted(ask, self._why_not, self._tell_why)
        return None if answer is None else self._labels_by(answer)

    def _asking_for(self, dstates: int) -> tuple[str, list[int]]:
        """How clingo is asked for so many dstates, at most, and what is assumed."""
        if self._task.speedups.core_guided and self.least == dstates:
            return "ignore", list(self._avoided)
        return f"enum,{dstates}", []

    def take_back(self, labels: Sequence[int]) -> None:
        """Labels that were given turned out to be no answer."""
        if (refused := tuple(labels)) in self._found:
            self._excluded -= self._found.index(refused) < self._excluded
            self._found.remove(refused)

    def forbid(self, labels: Sequence[int], clashes: Collection[Collection[int]]) -> None:
        """From now on the nodes of none of these sets are at the dstates that these labels give them, those of one label at one and the others not."""
        if (
            unknown := {self.chart.facing[node][0] for clash in clashes for node in clash}
            - self._visits
        ):
            self._give_more(unknown)
        rules = []
        for clash in clashes:
            first = {labels[node]: node for node in clash}
            different = [
                pair
                for a, b in combinations(first.values(), 2)
                if (pair := self._pair(a, b)) in self._fits
            ]
            if self._fits.issuperset(
                together := self._spanning(labels, clash)
            ):  # else clingo knows by now
                rules.append(visits_lp.forbidden_pairs(together, different))
        self._tell("\n".join(rules))

    def forbid_together(
        self, pairs: Collection[tuple[int, int]], places: Collection[tuple[int, int]] = ()
    ) -> None:
        """From now on these pairs of nodes are not all one dstate, while those are at one place.

        Labels alone do not tell which nodes are at one place. So where places are given, labels that were found stay, and whoever seeks their paths finds out.
        """
        self.has_forbidden = True
        facing = self.chart.facing
        apart = [(a, b) for a, b in pairs if a != b]
        away = [(a, b) for a, b in places if facing[a][0] != facing[b][0]]
        if unknown := {facing[node][0] for pair in (*apart, *away) for node in pair} - self._visits:
            self._give_more(unknown)
        choices = [[pair] for a, b in apart if (pair := self._pair(a, b)) in self._fits]
        for a, b in away:
            (i, _), (j, _) = sorted((facing[a], facing[b]))
            choices.append([(i, j, turned) for turned in range(4) if (i, j, turned) in self._fits])
        if len(choices) == len(apart) + len(away):  # else they are apart by now
            self._tell(visits_lp.forbidden_places(choices))
        if away:
            return

        def is_left(labels: Sequence[int]) -> bool:
            return any(labels[a] != labels[b] for a, b in apart)

        self._excluded = sum(map(is_left, self._found[: self._excluded]))
        self._found = [labels for labels in self._found if is_left(labels)]
        self.known = self.known if self.known and is_left(self.known) else None

    def standing(self, labels: Sequence[int]) -> dict[int, tuple[int, int]]:
        """The visit and slot of some node at each dstate, as far as clingo knows of any."""
        return {labels[node]: self.chart.facing[node] for node in self._place_of}

    def _spanning(self, labels: Sequence[int], nodes: Iterable[int]) -> list[Pair]:
        """Pairs that are the same if these nodes are at the dstates that they are labelled with."""
        first: dict[int, int] = {}
        return [
            self._pair(other, node)
            for node in nodes
            if (other := first.setdefault(labels[node], node)) != node
        ]

    def _pair(self, a: int, b: int) -> Pair:
        """How the visits of two nodes are turned where these are at one dstate."""
        (i, s), (j, t) = sorted((self.chart.facing[a], self.chart.facing[b]))
        return i, j, (t - s) % 4

    def _intransitive(self, pairs: Sequence[Pair]) -> list[Three]:
        """Visits of which an answer, with what follows from it, does not hold that to be the same is transitive."""
        found: dict[Three, None] = {}
        turned: _Turned = {}
        leaves = self.chart.leaves
        work = _scattered(pairs, len(self.chart.stars))
        if not work:
            return []
        for pair in pairs:
            _take(turned, pair)
        for i, j, r in work:
            follows = (
                [(i + 1, j + 1, 0)]
                if i in leaves and leaves.get(j) == ((leaves[i][0] + r) % 4, leaves[i][1])
                else []
            )
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
        return located(self.chart, states)

    def _labels(self, everywhere: Located) -> tuple[int, ...]:
        """The dstate of each node, numbered by the first node there."""
        return tuple(
            numbered(faced(everywhere.states[visit], slot) for visit, slot in self.chart.facing)
        )


def smaller(
    members: list[Member],
    shrunk: Callable[[list[Member]], list[Member] | None],
    tries: int | None = None,
) -> list[Member]:
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
        pair = self[symbol] = visits_lp.read_same(symbol)
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
                clause = [
                    -self._literals[pair],
                    -self._literals[_pair(middle, last, (turn - half) % 4)],
                ]
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
    members, joined = (
        np.bincount(group, minlength=visits),
        np.bincount(group[first], minlength=visits),
    )
    wrong = (group[first] != group[second]) | ((turned[second] - turned[first]) % 4 != turns)
    scattered = joined != members * (members - 1) // 2
    scattered[group[first[wrong]]] = scattered[group[second[wrong]]] = True
    return [
        pair
        for pair, bad in zip(pairs, scattered[group[first]] | scattered[group[second]], strict=True)
        if bad
    ]


def _take(turned: _Turned, pair: Pair) -> None:
    i, j, r = pair
    turned.setdefault(i, {})[j] = r
    turned.setdefault(j, {})[i] = -r % 4


def _apart_yet_joined(
    pair: Pair, turned: _Turned
) -> list[tuple[int, tuple[int, int], tuple[int, int]]]:
    """Visits that are not the same though each is the same as a third, by this pair and another: the first one, the third
    and the last, these two with the slot that slot 0 of the first one would be."""
    i, j, r = pair
    of_i, of_j = turned[i], turned[j]
    joined = [
        (i, (j, r), (k, (r + q) % 4))
        for k, q in of_j.items()
        if k != i and of_i.get(k) != (r + q) % 4
    ]
    return joined + [
        (j, (i, -r % 4), (k, (q - r) % 4))
        for k, q in of_i.items()
        if k != j and of_j.get(k) != (q - r) % 4
    ]


def _pair(i: int, j: int, r: int) -> Pair:
    """Two visits in order, where slot 0 of the one is slot R of the other."""
    return (i, j, r) if i < j else (j, i, -r % 4)


def _in_order(*visits: tuple[int, int]) -> Three:
    """Three visits at one place, each with the slot of it that slot 0 of the first one is."""
    (i, a), (j, b), (k, c) = sorted(visits)
    return i, j, k, (b - a) % 4, (c - b) % 4
