"""The control of clingo that decides which visits are at one place (visits.lp).

`visits.py` uses it. Clingo gets some visits at first, and others if an answer needs
them. Fewer visits are a relaxation, so a bound proven for them holds for the trace.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import product
from typing import TypeAlias

import clingo
from clingo import Function, Symbol

from ssh_abduction.data.groups import numbered
from ssh_abduction.solver.asp.control import Asker, new_control
from ssh_abduction.solver.asp.facts import number_symbols, sides
from ssh_abduction.solver.asp.limits import Watch
from ssh_abduction.solver.sources.exact.engine import Task
from ssh_abduction.solver.steps.chart import FramedChart
from ssh_abduction.solver.steps.localising import Located, State, faced, located
from ssh_abduction.theory import encodings
from ssh_abduction.theory.pairs import pairs_in
from ssh_abduction.theory.theory import Theory

# After finding this many triples of visits, stop looking for more, and give them to clingo.
# Grounding them takes longer than finding them.
AT_A_TIME = 20_000

# (I, J, R): visits I < J are at one place, and slot (direction) 0 of I is slot R of J.
Pair: TypeAlias = tuple[int, int, int]
# (I, J, K, R, Q): visits I < J < K are at one place, slot 0 of I is slot R of J, and slot 0 of J is
# slot Q of K.
Three: TypeAlias = tuple[int, int, int, int, int]
# For each visit, the other visits at its place, each with the slot there that is its own slot 0.
Turned: TypeAlias = dict[int, dict[int, int]]


def intransitive(pairs: Sequence[Pair], fits: Set[Pair], chart: FramedChart) -> list[Three]:
    """Find the triples of visits at which an answer is not transitive.

    `pairs` of visits are at one place in the answer, and `fits` are those that clingo may put at
    one place. Pairs that follow from the answer by the axioms are also checked. The chart has the
    action that ends each visit.
    """
    found: dict[Three, None] = {}
    turned: Turned = {}
    leaves = chart.leaves
    work = list(pairs)
    for pair in pairs:
        take(turned, pair)
    for i, j, r in work:
        # If two visits are at one place and end by the same action in the same direction, then the
        # next visits are also at one place.
        follows = (
            [(i + 1, j + 1, 0)]
            if i in leaves and leaves.get(j) == ((leaves[i][0] + r) % 4, leaves[i][1])
            else []
        )
        for first, (middle, half), (last, turn) in apart_yet_joined((i, j, r), turned):
            found[_in_order((first, 0), (middle, half), (last, turn))] = None
            follows.append((first, last, turn) if first < last else (last, first, -turn % 4))
        for pair in follows:
            if pair in fits and pair[1] not in turned.get(pair[0], ()):
                take(turned, pair)
                work.append(pair)
        if len(found) >= AT_A_TIME:
            break
    return list(found)


def take(turned: Turned, pair: Pair) -> None:
    """Record in `turned` that two visits are at one place, with the rotation between them."""
    i, j, r = pair
    turned.setdefault(i, {})[j] = r
    turned.setdefault(j, {})[i] = -r % 4


def apart_yet_joined(
    pair: Pair, turned: Turned
) -> list[tuple[int, tuple[int, int], tuple[int, int]]]:
    """Find triples of visits in which two pairs are at one place, but not the third pair.

    The two visits of `pair` are in each triple, and have just been put at one place. A triple is
    (first, (middle, slot), (last, slot)). The answer puts the middle visit at one place with each
    of the others. But it lacks the pair of the first and the last visit, or turns it differently.
    Each slot of a visit is the same direction at the place as slot 0 of the first visit.
    """
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


def _in_order(*visits: tuple[int, int]) -> Three:
    """Sort three visits at one place, each with a slot. All slots are one direction there."""
    (i, a), (j, b), (k, c) = sorted(visits)
    return i, j, k, (b - a) % 4, (c - b) % 4


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
            control.release_external(listing_atom(self.batch))
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
        facts = visit_facts(self.batch, nodes, leaves, new, unfit, joined, together)
        control.add(part, [], facts)
        control.add(part, [], turn_facts(self.batch, chart, added, turns))
        control.ground([(part, []), ("more", number_symbols(self.batch))])
        control.assign_external(listing_atom(self.batch), True)
        atoms = control.symbolic_atoms
        self.least += sum(atom.is_fact for place, *_ in nodes if (atom := atoms[first_node(place)]))
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
        return list(map(read_same, model.symbols(shown=True)))

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
        self.add_rules(three_facts(self._closed, threes), "closed", self._closed)

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


class FramedSides:
    """Adds the axioms of order and sides, path by path, to the control that decides on visits."""

    def __init__(self, theory: Theory, asker: Asker) -> None:
        self._theory, self._asker = theory, asker
        # The grounded program parts of sides_framed.lp, with their arguments.
        self._said: dict[tuple[str, tuple[int, ...]], None] = {}
        self._batch = -1

    def begin(self) -> None:
        """Forget which axioms were added, as there is a new control."""
        self._said = {}
        self._batch = -1

    def extend(self, batch: int) -> None:
        """Ground the axioms of all paths added so far for a new batch: the visits of one call."""
        self._batch = batch
        if self._said:
            paths = [
                (part, number_symbols(*arguments, batch))
                for part, arguments in self._said
                if part == "path"
            ]
            self._asker.control.ground([("paths", number_symbols(batch)), *paths])

    def say_of_path(
        self, contrary: Iterable[int], twice: Iterable[int], standing: Mapping[int, tuple[int, int]]
    ) -> bool:
        """Add the axioms of a path that labels contradict, and return whether there was one.

        `contrary` has a dstate of each path that contradicts the axioms. `twice` has the dstates
        where two paths cross that meet again. `standing` has, for each dstate that has a node in
        clingo, the visit and the slot (direction) of such a node.
        """
        if any(self._say_once("path", *standing[dstate]) for dstate in contrary):
            return True
        for visit in (standing[dstate][0] for dstate in twice):
            said = [
                self._say_once("path", visit, 0),
                self._say_once("path", visit, 1),
                self._say_once("crossing", visit, self._batch),
            ]
            if any(said):
                return True
        return False

    def _say_once(self, part: str, *arguments: int) -> bool:
        """Ground a part of sides_framed.lp for these arguments once. Return whether it was new."""
        if (part, arguments) in self._said:
            return False
        control, batches = self._asker.control, range(self._batch + 1)
        with self._asker.grounding_timed():
            if not self._said:
                control.load(encodings.path("sides_framed"))
                control.add("sides", [], "\n".join(sides(self._theory)))
                control.ground(
                    [("sides", []), *(("paths", number_symbols(batch)) for batch in batches)]
                )
            self._said[part, arguments] = None
            if part == "path":
                control.ground([(part, number_symbols(*arguments, batch)) for batch in batches])
            else:
                control.ground([(part, number_symbols(*arguments))])
        return True


def visit_facts(
    batch: int,
    nodes: Iterable[tuple[int, int, int]],
    leaves: Iterable[tuple[int, int, int]],
    fits: Iterable[tuple[int, int, int]],
    unfit: Iterable[tuple[int, int, int]] = (),
    joined: Iterable[tuple[int, int, int]] = (),
    together: Iterable[tuple[int, int]] = (),
) -> str:
    """Return the facts for one batch.

    Each node (the steps of a visit that face one slot) has its number, visit and slot. `leaves` has
    each visit that ends, with the slot that it leaves through, and the action. Triples (I, J, R)
    stand for pairs of visits: `fits` may be at one place, `unfit` of earlier batches are now known
    not to be, and `joined` are at one place, as the user says. So are the pairs (I, J) of
    `together`, with any rotation.
    """
    new: dict[str, Iterable[tuple[int, ...]]] = {
        "node": nodes,
        "leaves": leaves,
        "fits": fits,
        "unfit": unfit,
        "joined": joined,
        "together": together,
    }
    return "\n".join(
        f"{name}({batch},{','.join(map(str, args))})."
        for name, rows in new.items()
        for args in rows
    )


@lru_cache(maxsize=2**16)
def read_same(atom: Symbol) -> tuple[int, int, int]:
    """Read the pair of visits (I, J, R) from an atom of `same`. Answers share most atoms."""
    first, second, turned = (argument.number for argument in atom.arguments)
    return first, second, turned


def listing_atom(batch: int) -> Symbol:
    """Return the external atom that is true while answers up to this batch are listed."""
    return Function("listed", number_symbols(batch))


def first_node(place: int) -> Symbol:
    """Return the atom: the node at index `place` of the order is the first one at its dstate."""
    return Function("first", number_symbols(place))


def three_facts(batch: int, threes: Iterable[tuple[int, ...]]) -> str:
    """Return the facts for triples of visits for which "is at one place" has to be transitive.

    Each call has a new `batch`. In a triple (I, J, J2, R, Q), the pairs (I, J, R) and (J, J2, Q)
    imply that I and J2 are at one place.
    """
    return "\n".join(f"via({batch},{','.join(map(str, three))})." for three in threes)


def forbidden_pairs(
    pairs: Iterable[tuple[int, int, int]],
    different: Iterable[tuple[int, int, int]] = (),
    listed: int | None = None,
) -> str:
    """Return the rule against answers with all of `pairs` and none of `different` at one place.

    Triples (I, J, R) stand for pairs of visits. The rule applies only while answers up to the batch
    `listed` are listed; None for always.
    """
    body = [
        *(f"same({i},{j},{r})" for i, j, r in pairs),
        *(f"not same({i},{j},{r})" for i, j, r in different),
    ]
    return f":- {', '.join(['#true', *body] if listed is None else [f'listed({listed})', *body])}."


def forbidden_places(equalities: Sequence[Sequence[tuple[int, int, int]]]) -> str:
    """Return the rules that some equalities do not all hold.

    Each equality has pairs of visits (I, J, R), and holds if one of them is at one place.
    """
    return "\n".join(forbidden_pairs(pairs) for pairs in product(*equalities))


def turn_facts(
    batch: int, chart: FramedChart, visits: Iterable[int], turns: Iterable[tuple[int, str, int]]
) -> str:
    """Return the facts about a batch: its new visits, and its turns (node, direction, node)."""
    facts = [f"visit({batch},{visit})." for visit in visits]
    for s, turn, x in turns:
        (visit, slot), (_, faced) = chart.facing[s], chart.facing[x]
        facts.append(f"{'about' if turn == 'around' else 'turns'}({batch},{visit},{slot},{faced}).")
    return "\n".join(facts)
