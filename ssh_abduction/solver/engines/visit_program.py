"""Asks clingo which visits are at one place (visits.lp), for the engine with frames.

Clingo is given some visits at first, and others as answers need them. Fewer visits are a
relaxation, so a bound proven for them holds for the trace.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field
from typing import Protocol

import clingo

from ssh_abduction.solver.asp.control import Asker, new_control
from ssh_abduction.solver.asp.facts import sides_lp, visits_lp
from ssh_abduction.solver.asp.facts.atoms import numbers
from ssh_abduction.solver.asp.limits import Watch
from ssh_abduction.solver.engines.base import Task
from ssh_abduction.solver.engines.transitive import Pair, PairOf, Three, Transitive, intransitive
from ssh_abduction.solver.steps.chart import FramedChart, numbered
from ssh_abduction.solver.steps.localising import Located, State, faced, located

# Seconds, about, that clingo takes to ground two visits that may be one. It cannot be stopped
# meanwhile.
SECONDS_A_PAIR = 3e-5


class Sides(Protocol):
    """Adds axioms of order and sides to those of visits (`engines/sides.py`)."""

    def begin(self) -> None:
        """Start over with a new control."""
        ...

    def extend(self, batch: int) -> None:
        """Take note of a batch of new visits."""
        ...


class Cores:
    """Raises a lower bound on how many nodes are alone, core by core (OLL).

    Clingo is asked for an answer without lone nodes. A core, nodes that cannot all be avoided,
    raises the bound by one. From then on at most one of them may be alone, then two, and so on.

    Attributes:
        least: A lower bound on the number of lone nodes.
        avoided: The atoms that are assumed to be false, by the literal of that assumption.

    Reference:
        Andres, Kaufmann, Matheis, Schaub 2012, "Unsatisfiability-based optimization in clasp".
    """

    def __init__(self, asker: Asker, tell: Callable[[str, str, int], None]) -> None:
        """Know no core yet.

        Args:
            asker: Its control has the atoms.
            tell: Gives clingo rules, and grounds a program part for a number.
        """
        self.least = 0
        self.avoided: dict[int, clingo.Symbol] = {}
        self._asker, self._tell = asker, tell
        self._sizes: list[int] = []  # sizes of cores

    def avoid(self, symbol: clingo.Symbol) -> None:
        """Assume that this atom is false, if it exists."""
        if atom := self._asker.control.symbolic_atoms[symbol]:
            self.avoided[-atom.literal] = atom.symbol

    def relax(self, core: Sequence[int]) -> None:
        """Raise the bound: from now on only two members of the core are not both true."""
        members = [self.avoided.pop(literal) for literal in core]
        self.least += 1
        for member in members:
            # A limit of an earlier core that cannot hold becomes looser.
            if (over := visits_lp.read_over(member)) is not None:
                self._limit(over[0], over[1] + 1)
        if len(members) > 1:
            number = len(self._sizes)
            self._sizes.append(len(members))
            self._tell(visits_lp.core_facts(number, members), "core", number)
            self._limit(number, 2)

    def _limit(self, core: int, count: int) -> None:
        """Assume that fewer than `count` members of a core are true."""
        if count <= self._sizes[core]:
            self._asker.control.ground([("over", numbers(core, count))])
            self.avoid(visits_lp.over(core, count))


@dataclass
class Answer:
    """An answer of clingo.

    Attributes:
        pairs: The visits that are at one place.
        everywhere: Where all visits are, once the pairs are known to be transitive.
        is_open: Whether the answer is still unknown.
    """

    pairs: Sequence[Pair] = ()
    everywhere: Located | None = None
    is_open: bool = False

    @property
    def located(self) -> Located:
        """Where all visits are, in an answer that was not rejected."""
        assert self.everywhere is not None
        return self.everywhere


@dataclass(frozen=True)
class Refusal:
    """Why an answer is rejected.

    Attributes:
        threes: Threes of visits at which the answer is not transitive.
        missed: Visits whose places a transitive answer leaves open.
    """

    threes: Sequence[Three]
    missed: Collection[int]


@dataclass
class _Known:
    """What the control has of a chart.

    Attributes:
        visits: The visits that it was given.
        place_of: For each node, its position in the order of choice.
        ends: The visits whose end it has.
        turns: The turns that it has.
        fits: The pairs of visits that may be at one place.
    """

    visits: set[int] = field(default_factory=set)
    place_of: dict[int, int] = field(default_factory=dict)
    ends: set[int] = field(default_factory=set)
    turns: set[tuple[int, str, int]] = field(default_factory=set)
    fits: frozenset[Pair] = frozenset()


class VisitProgram:
    """The control of visits.lp, and what it was given.

    Attributes:
        chart: The chart of the first steps.
        batch: The number of the last batch of visits.
        cores: The lower bound, and its assumptions.
        transitive: The propagator, with the literals that were read.
    """

    def __init__(self, task: Task, asker: Asker, chart: FramedChart, sides: Sides) -> None:
        """Make a control without visits.

        Args:
            task: The trace and the speed-ups that are on.
            asker: It asks the control.
            chart: The first chart.
            sides: Called for new controls and batches.
        """
        self.chart = chart
        self.batch = -1
        self._asker, self._trace, self._sides = asker, task.trace, sides
        self._core_guided = task.speedups.core_guided
        asker.control = new_control("visits", "", ["--heuristic=Domain"])
        self.cores = Cores(asker, self.tell)
        self.transitive = Transitive()
        asker.control.register_propagator(self.transitive)
        self._known = _Known()
        self._pair_of = PairOf()
        self._unread: list[Pair] = []  # pairs whose literals are not yet looked up
        self._parts = 0
        sides.begin()

    @property
    def visits(self) -> Set[int]:
        """The visits that clingo was given."""
        return self._known.visits

    @property
    def knows_all(self) -> bool:
        """Whether clingo was given all visits."""
        return len(self._known.visits) == len(self.chart.stars)

    @property
    def fits(self) -> frozenset[Pair]:
        """The pairs of clingo's visits that may be at one place."""
        return self._known.fits

    @property
    def nodes(self) -> Iterable[int]:
        """The nodes that clingo has, in the order of choice."""
        return self._known.place_of

    def give(
        self, chart: FramedChart, visits: set[int], order: Iterable[int], fits: frozenset[Pair]
    ) -> None:
        """Give clingo what it lacks about these visits.

        Args:
            chart: The visits and nodes.
            visits: All visits that clingo is to have.
            order: Nodes in the order of choice. New ones come after those that clingo has.
            fits: The pairs of these visits that may be at one place.
        """
        control, known = self._asker.control, self._known
        if self.batch >= 0:
            control.release_external(visits_lp.listed(self.batch))
        self.chart = chart
        self.batch += 1
        added = sorted(visits - known.visits)
        known.visits |= visits
        nodes = []
        for node in order:
            if node not in known.place_of and chart.facing[node][0] in visits:
                known.place_of[node] = len(known.place_of)
                nodes.append((known.place_of[node], *chart.facing[node]))
        leaves = [
            (visit, *how)
            for visit, how in chart.leaves.items()
            if visit in visits and visit + 1 in visits and visit not in known.ends
        ]
        known.ends.update(visit for visit, *_ in leaves)
        turns = [
            turn
            for turn in chart.turns(self._trace)
            if turn not in known.turns and chart.facing[turn[0]][0] in visits
        ]
        known.turns.update(turns)
        new, unfit = sorted(fits - known.fits), sorted(known.fits - fits)
        known.fits = fits
        part = f"visits_{self.batch}"
        control.add(part, [], visits_lp.visit_facts(self.batch, nodes, leaves, new, unfit))
        control.add(part, [], sides_lp.turn_facts(self.batch, chart, added, turns))
        control.ground([(part, []), ("more", numbers(self.batch))])
        control.assign_external(visits_lp.listed(self.batch), True)
        self._avoid_lone(place for place, *_ in nodes)
        self._unread += new
        self._sides.extend(self.batch)

    def _avoid_lone(self, places: Iterable[int]) -> None:
        """Assume that none of these new nodes is alone, or count those that have to be."""
        atoms = self._asker.control.symbolic_atoms
        for place in places:
            atom = atoms[visits_lp.first(place)]
            if atom and (atom.is_fact or not self._core_guided):
                self.cores.least += atom.is_fact
            elif atom:
                self.cores.avoided[-atom.literal] = atom.symbol

    def read(self, model: clingo.Model) -> list[Pair]:
        """The pairs of visits that are at one place in an answer."""
        return [self._pair_of[symbol] for symbol in model.symbols(shown=True)]

    def read_literals(self) -> Mapping[Pair, int]:
        """The literals that two visits are at one place, in the order in which they came.

        Looking up many literals takes seconds, so call this only if needed.
        """
        atoms = self._asker.control.symbolic_atoms
        for pair in self._unread:
            if atom := atoms[visits_lp.same(pair)]:
                self.transitive.literals[pair] = atom.literal
        self._unread = []
        return self.transitive.literals

    def tell(self, told: str, part: str | None = None, number: int = 0) -> None:
        """Give clingo more rules, and ground a program part for a number if one is given.

        No limit stops this: a relaxed core must get the limit on its members.
        """
        with self._asker.grounding_timed():
            name = f"told_{self._parts}"
            self._parts += 1
            self._asker.control.add(name, [], told)
            self._asker.control.ground([(name, [])])
            if part is not None:
                self._asker.control.ground([(part, numbers(number))])

    def close(self, threes: Iterable[Three]) -> None:
        """Give clingo the rules of transitivity for these visits."""
        self.tell(visits_lp.three_facts(self._parts, threes), "closed", self._parts)

    def intransitive(self, pairs: Sequence[Pair]) -> list[Three]:
        """Threes of visits at which an answer is not transitive."""
        return intransitive(pairs, self._known.fits, self.chart)

    def located(self, pairs: Iterable[Pair]) -> Located:
        """Where all visits are in an answer that is transitive."""
        first: dict[int, tuple[int, int]] = {}
        for i, j, r in sorted(pairs):
            first.setdefault(j, (i, r))
        number: dict[int, int] = {}
        states: dict[int, State] = {}
        for visit in sorted(self._known.visits):
            i, r = first.get(visit, (visit, 0))
            states[visit] = 4 * number.setdefault(i, len(number)) + -r % 4
        return located(self.chart, states)

    def labels(self, everywhere: Located) -> tuple[int, ...]:
        """The dstate of each node, numbered by the first node there."""
        return tuple(
            numbered(faced(everywhere.states[visit], slot) for visit, slot in self.chart.facing)
        )

    def why_not(self, answer: Answer) -> Refusal | None:
        """Why an answer is rejected; None if it is not."""
        if answer.is_open:
            return None
        threes = self.intransitive(answer.pairs)
        if not threes:
            answer.everywhere = self.located(answer.pairs)
        missed = answer.everywhere.missed if answer.everywhere else ()
        return Refusal(threes, missed) if threes or missed else None

    def standing(self, labels: Sequence[int]) -> dict[int, tuple[int, int]]:
        """The visit and slot of some node at each dstate, if clingo has one."""
        return {labels[node]: self.chart.facing[node] for node in self._known.place_of}

    def spanning(self, labels: Sequence[int], nodes: Iterable[int]) -> list[Pair]:
        """Pairs that are at one place if these nodes are at the dstates of their labels."""
        first: dict[int, int] = {}
        return [
            self.pair(other, node)
            for node in nodes
            if (other := first.setdefault(labels[node], node)) != node
        ]

    def pair(self, a: int, b: int) -> Pair:
        """How the visits of two nodes are turned if these are at one dstate."""
        (i, s), (j, t) = sorted((self.chart.facing[a], self.chart.facing[b]))
        return i, j, (t - s) % 4


def fits_in_time(watch: Watch, chart: FramedChart, visits: set[int], known: int) -> frozenset[Pair]:
    """The pairs of these visits that may be at one place.

    Raises LimitError if there is no time to ground them.

    Args:
        watch: The limits.
        chart: The visits.
        visits: The visits that clingo is to have.
        known: The number of pairs that it has already.
    """
    told = sorted(visits)
    if len(told) == len(chart.stars):  # count the pairs before they are listed
        watch.check(SECONDS_A_PAIR * (int(chart.fitting[-1]) - known))
    else:
        watch.check()
    fits = frozenset(chart.fits(told))
    watch.check(SECONDS_A_PAIR * (len(fits) - known))
    return fits
