"""The control of clingo that decides which visits are at one place (visits.lp).

The engine with frames uses it. Clingo gets some visits at first, and others if an answer needs
them. Fewer visits are a relaxation, so a bound proven for them holds for the trace.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import clingo

from ssh_abduction.data.groups import numbered
from ssh_abduction.solver.asp.control import Asker, new_control
from ssh_abduction.solver.asp.facts import sides_lp, visits_lp
from ssh_abduction.solver.asp.facts.atoms import number_symbols
from ssh_abduction.solver.asp.limits import Watch
from ssh_abduction.solver.engines.base import Task
from ssh_abduction.solver.engines.framed_sides import FramedSides
from ssh_abduction.solver.engines.transitive import Pair, Three
from ssh_abduction.solver.steps.chart import FramedChart
from ssh_abduction.solver.steps.localising import Located, State, faced, located
from ssh_abduction.theory.pairs import pairs_in

# Clingo takes about this many seconds to ground one pair of visits that may be at one place. It
# cannot be stopped meanwhile.
SECONDS_A_PAIR = 3e-5


@dataclass
class GivenVisits:
    """A record of everything about the chart that the control was given.

    Attributes:
        visits: The visits that clingo has.
        place_of: For each node, its number in the order in which clingo decides nodes (see
            `visit_labels.py`).
        ends: The visits that end in the steps given to the control so far.
        turns: The turns, as (node, direction, node).
        fits: The pairs of visits that may be at one place.
        joined: The pairs of visits that are at one place, as the user says.
        together: The same, where the user does not say how their frames are turned.
    """

    visits: set[int] = field(default_factory=set)
    place_of: dict[int, int] = field(default_factory=dict)
    ends: set[int] = field(default_factory=set)
    turns: set[tuple[int, str, int]] = field(default_factory=set)
    fits: frozenset[Pair] = frozenset()
    joined: frozenset[Pair] = frozenset()
    together: frozenset[tuple[int, int]] = frozenset()


class VisitProgram:
    """The control of visits.lp, and a record of what it was given.

    Attributes:
        batch: The number of the last batch of visits; -1 before the first.
        known: What clingo was given.
        least: A lower bound on the number of dstates: how many nodes are the first at their dstate
            in every answer.
    """

    def __init__(self, task: Task, asker: Asker, chart: FramedChart, sides: FramedSides) -> None:
        """Make a control without visits. `sides` adds axioms to it and to each batch of visits."""
        self.chart = chart
        self.batch = -1
        self._asker, self._trace, self._sides = asker, task.trace, sides
        self._one, self._together = pairs_in(task.log.pairs.one), task.theory.same_place
        cores = ["--opt-strategy=usc"] if task.speedups.core_guided else []
        asker.control = new_control("visits", "", ["--heuristic=Domain", *cores])
        self.least = 0
        self.known = GivenVisits()
        self._closed = 0  # how often rules of transitivity were given
        sides.begin()

    def give(
        self, chart: FramedChart, visits: set[int], order: Iterable[int], fits: frozenset[Pair]
    ) -> None:
        """Give clingo a new batch: everything about these visits that it does not have yet.

        The visits include those that it has already. `order` has nodes in the order of choice;
        those new to clingo come after all others. `fits` are the pairs of these visits that may be
        at one place.
        """
        control, known = self._asker.control, self.known
        if self.batch >= 0:
            # Answers are now listed up to the new batch.
            control.release_external(visits_lp.listing_atom(self.batch))
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
        # More of the trace may separate visits that fitted before.
        new, unfit = sorted(fits - known.fits), sorted(known.fits - fits)
        known.fits = fits
        joined = sorted(self._joined() - known.joined)
        known.joined |= frozenset(joined)
        part = f"visits_{self.batch}"
        together = sorted(self._at_one_place() - known.together)
        known.together |= frozenset(together)
        facts = visits_lp.visit_facts(self.batch, nodes, leaves, new, unfit, joined, together)
        control.add(part, [], facts)
        control.add(part, [], sides_lp.turn_facts(self.batch, chart, added, turns))
        control.ground([(part, []), ("more", number_symbols(self.batch))])
        control.assign_external(visits_lp.listing_atom(self.batch), True)
        atoms = control.symbolic_atoms
        self.least += sum(
            atom.is_fact for place, *_ in nodes if (atom := atoms[visits_lp.first(place)])
        )
        self._sides.extend(self.batch)

    def _joined(self) -> set[Pair]:
        """List the pairs of visits with steps that the user says are one dstate."""
        chart, found = self.chart, set()
        for i, t in self._one:
            if t < len(chart.node_of):
                (first, slot), (last, other) = (chart.facing[chart.node_of[x]] for x in (i, t))
                # Two slots of one visit cannot be one dstate. Such a pair makes the program
                # inconsistent.
                if first != last or slot != other:
                    earlier = (first, last, (other - slot) % 4)
                    found.add(earlier if first <= last else (last, first, (slot - other) % 4))
        return found

    def _at_one_place(self) -> set[tuple[int, int]]:
        """List the pairs of visits with steps that the user says are at one place."""
        node_of, facing = self.chart.node_of, self.chart.facing
        pairs = [pair for pair in self._together if max(pair) < len(node_of)]
        visits = {tuple(sorted(facing[node_of[t]][0] for t in pair)) for pair in pairs}
        return {(i, j) for i, j in visits if i != j}

    def read(self, model: clingo.Model) -> list[Pair]:
        """Read the pairs of visits that are at one place in an answer."""
        return list(map(visits_lp.read_same, model.symbols(shown=True)))

    def add_rules(self, rules: str, part: str | None = None, number: int = 0) -> None:
        """Give clingo more rules. Then ground the program part `part(number)`, if given.

        This does not check the limits of time and memory. If it were stopped halfway, clingo might
        have relaxed an unsat core, but lack the rule that limits how many members are violated.
        """
        with self._asker.grounding_timed():
            self._asker.control.tell(rules)
            if part is not None:
                self._asker.control.ground([(part, number_symbols(number))])

    def close(self, threes: Iterable[Three]) -> None:
        """Give clingo the rules of transitivity for these triples of visits."""
        self._closed += 1
        self.add_rules(visits_lp.three_facts(self._closed, threes), "closed", self._closed)

    def located(self, pairs: Iterable[Pair]) -> Located:
        """Locate all visits by the pairs in a transitive answer; else return the missed visits."""
        first: dict[int, tuple[int, int]] = {}
        for i, j, r in sorted(pairs):
            first.setdefault(j, (i, r))
        number: dict[int, int] = {}
        states: dict[int, State] = {}
        for visit in sorted(self.known.visits):
            i, r = first.get(visit, (visit, 0))
            states[visit] = 4 * number.setdefault(i, len(number)) + -r % 4
        return located(self.chart, states)

    def labels(self, everywhere: Located) -> tuple[int, ...]:
        """Return the dstate of each node, numbered in the order of their first nodes."""
        return tuple(
            numbered(faced(everywhere.states[visit], slot) for visit, slot in self.chart.facing)
        )

    def standing(self, labels: Sequence[int]) -> dict[int, tuple[int, int]]:
        """Return a visit and its slot (direction) for each dstate that has a node in clingo."""
        return {labels[node]: self.chart.facing[node] for node in self.known.place_of}

    def spanning(self, labels: Sequence[int], nodes: Iterable[int]) -> list[Pair]:
        """List the pairs of visits that must be at one place if nodes have these dstates."""
        first: dict[int, int] = {}
        return [
            self.pair(other, node)
            for node in nodes
            if (other := first.setdefault(labels[node], node)) != node
        ]

    def pair(self, a: int, b: int) -> Pair:
        """Return the pair of visits that is at one place if two nodes are at one dstate."""
        (i, s), (j, t) = sorted((self.chart.facing[a], self.chart.facing[b]))
        return i, j, (t - s) % 4


def fits_in_time(watch: Watch, chart: FramedChart, visits: set[int], known: int) -> frozenset[Pair]:
    """Return the pairs of some visits that may be at one place, as `FramedChart.fits` does.

    `known` pairs have been grounded already, and their time is not counted. Raises LimitError if
    grounding the others would take longer than the time that is left.
    """
    numbers = sorted(visits)
    if len(numbers) == len(chart.stars):  # the number of pairs is known before they are listed
        watch.check(SECONDS_A_PAIR * (int(chart.fitting[-1]) - known))
    else:
        watch.check()
    fits = frozenset(chart.fits(numbers))
    watch.check(SECONDS_A_PAIR * (len(fits) - known))
    return fits
