"""Finds labels with the fewest dstates, for theories with frames, without names for dstates.

A label is the number of the dstate of a node; a node is the steps of a visit that face one
direction. Clingo is asked which visits are at one place (visits.lp). The module finds labels of all
nodes with the fewest dstates, proves that none have fewer, and lists all labels with that number of
dstates. `labels_first.py` checks them by the axioms of order and sides.

Names, as in `names.py`, help little if there are many dstates with few visits. What clingo learns
about one spare name, it has to learn again about the next one. And each node of a view may have
each of its names. An equality of two visits, in contrast, is only about these two. A node is
*first* if no node before it, in an order of choice, is at its dstate. So the number of dstates is
the number of first nodes.

*Order of choice.* A clique of nodes comes first, then the nodes that can share a dstate with few
others. When the trace grows, new nodes are put last. So the rules that clingo has, and the clauses
that it learned, still hold. When the number of nodes has grown by a tenth, a new control begins
with a new clique.

*Transitivity.* Clingo gets the rules of transitivity only for visits at which an answer violates
them (`intransitive`). Without them clingo solves a relaxation, so its bounds hold.

*Few visits.* Of a long trace, clingo first gets the visits of the clique, and some of the first
visits, such that few pairs of them may be at one place. Mostly an answer also determines the places
of all other visits (`steps/chart.py`). If not, clingo gets further visits. Fewer visits are a
relaxation, and an answer that locates all visits is an answer for all of them.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import (
    Callable,
    Collection,
    Generator,
    Iterable,
    Iterator,
    Mapping,
    Sequence,
    Set,
)
from functools import lru_cache
from itertools import combinations, product
from typing import TypeAlias

import clingo
from clingo import Function, Symbol

from ssh_abduction.data.groups import gathered, numbered
from ssh_abduction.solver.asp.control import Asker, new_control
from ssh_abduction.solver.asp.facts import number_symbols, sides
from ssh_abduction.solver.sources.exact.engine import Task
from ssh_abduction.solver.sources.exact.fitting import Member
from ssh_abduction.solver.steps.apart import clique
from ssh_abduction.solver.steps.chart import Chart, FramedChart, State, faced, located
from ssh_abduction.theory import encodings
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.pairs import pairs_in

# At first, give clingo only the first visits: those with at most this many pairs that may be at one
# place. It gets other visits if answers need them.
FIRST_PAIRS = 10_000
# If more pairs of visits than this may be at one place, add no axioms of single paths. They take
# about forty rules for each pair.
MANY_PAIRS = 20_000
# If the number of nodes has grown by this factor, make a new control, as the order of choice only
# suits the nodes that it was made for.
GROWN = 1.1
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
# Clingo takes about this many seconds to ground one pair of visits that may be at one place. It
# cannot be stopped meanwhile.
SECONDS_A_PAIR = 3e-5


class VisitLabels:
    """Finds labels with the fewest dstates for the first `size` steps of a trace.

    Attributes:
        task: The problem. Its trace may be replaced by a longer one.
        bound: A proven lower bound on the number of dstates; None if none is known.
        clique: Nodes that are pairwise distinct.
    """

    def __init__(self, task: Task, asker: Asker) -> None:
        """Begin without any steps."""
        self.bound: int | None = None
        self.clique: list[int] = []
        self.size = 0
        self.task, self._asker = task, asker
        self._program: VisitProgram | None = None
        self._nodes_at_start = 0  # the number of nodes when the control was made
        self._found: list[tuple[int, ...]] = []  # labels with the fewest dstates
        self._excluded = 0  # how many of these, from the first on, clingo has a rule against

    @property
    def program(self) -> VisitProgram:
        """The control that decides which visits are at one place."""
        assert self._program is not None  # `grow` comes first
        return self._program

    @property
    def chart(self) -> FramedChart:
        """The visits and nodes of the first steps."""
        return self.program.chart

    def grow(self, size: int) -> bool:
        """Chart the first `size` steps, and give clingo their new visits.

        If many nodes are new, make a new clingo control. Returns False, and changes nothing, if the
        steps fit no frames.
        """
        if size == self.size:
            return True
        with self._asker.grounding_timed():
            chart = Chart.framed(self.task.trace, self.task.log, size)
            if chart is None:
                return False
            if self.size and len(chart.seen) <= GROWN * self._nodes_at_start:
                program = self.program
                has_all = len(program.visits) == len(self.chart.stars)
                new = range(len(self.chart.stars), len(chart.stars)) if has_all else ()
                self._give(chart, {*program.visits, *new}, range(len(chart.seen)))
            else:
                # `_order_of_choice` also finds the clique, and `_first_visits` needs it.
                order = self._order_of_choice(chart)
                self._give(chart, self._first_visits(chart), order, anew=True)
            self.size = size
            self._found = []
            return True

    def _order_of_choice(self, chart: FramedChart) -> list[int]:
        """Find the clique. Return its nodes, then the others: first those apart from most nodes."""
        apart = chart.apart()
        self._asker.watch.check()
        self.clique = clique(apart, chart.seen) if self.task.speedups.clique else []
        others = set(range(len(apart))) - set(self.clique)
        return [*self.clique, *sorted(others, key=lambda node: (-int(apart[node].sum()), node))]

    def _first_visits(self, chart: FramedChart) -> set[int]:
        """Return the visits that clingo gets first: all, or those of the clique and early ones."""
        # Clingo has to know all visits that the user says are at one place.
        said = self.task.log.pairs.one or self.task.theory.same_place
        is_lazy = self.task.speedups.lazy and not said
        first = chart.visits_with(FIRST_PAIRS) if is_lazy else len(chart.stars)
        return {*range(first), *(chart.facing[node][0] for node in self.clique)}

    def _give(
        self, chart: FramedChart, visits: set[int], order: Iterable[int], *, anew: bool = False
    ) -> None:
        """Give clingo (if `anew`, a new control) all that it lacks about these visits."""
        # Check that time is left to ground the pairs of visits that clingo lacks. If all visits are
        # given, the number of pairs is known before they are listed.
        known = 0 if anew else len(self.program.fits)
        is_all = len(visits) == len(chart.stars)
        self._asker.watch.check(SECONDS_A_PAIR * (int(chart.fitting[-1]) - known) if is_all else 0)
        fits = frozenset(chart.fits(sorted(visits)))
        self._asker.watch.check(SECONDS_A_PAIR * (len(fits) - known))
        size, self.size = self.size, 0  # an error may leave this prefix incomplete
        if anew:
            self._program = VisitProgram(self.task, self._asker, chart)
            self._nodes_at_start = len(chart.seen)
        self.program.give(chart, visits, order, fits)
        self._raise_bound(self.program.least)
        self._excluded = 0
        self.size = size

    def _give_more(self, visits: Iterable[int]) -> None:
        """Give clingo these visits in addition to those that it has."""
        more = {*self.program.visits, *visits}
        assert more != self.program.visits  # else the search would never end
        with self._asker.grounding_timed():
            self._give(self.chart, more, range(len(self.chart.seen)))

    def _raise_bound(self, bound: int) -> None:
        """Take over a lower bound if it is higher."""
        self.bound = max(self.bound or 0, bound)

    def improving(self) -> Iterator[list[int]]:
        """Yield the dstates of all nodes, as few as possible; nothing if the rules allow none."""
        if not self._found:
            labels = self._first_labels(self._best_answer)
            if labels is None:
                return
            self._found.append(labels)
        yield list(self._found[0])

    def _first_labels(self, ask: Callable[[], list[Pair] | None]) -> tuple[int, ...] | None:
        """Return the labels of all nodes from the first answer that is a map of the chart.

        After any other answer, clingo gets what it lacked: rules, or visits. `ask` returns the
        pairs of visits that are at one place in the next answer.
        """
        while (pairs := ask()) is not None:
            program = self.program
            if threes := intransitive(pairs, program.fits, program.chart):
                program.close(threes)
                continue
            labels, missed = program.labels(pairs)
            if not missed:
                return labels
            self._give_more(missed)
        return None

    def _best_answer(self) -> list[Pair] | None:
        """Find an answer with the fewest dstates; None if there is no answer."""
        read = self.program.read
        better = list(
            self._asker.answers(
                lambda model: (read(model), model.cost[0]),
                "opt",
                0,
                on_bound=lambda costs: self._raise_bound(costs[0]),
            )
        )
        if not better:
            return None
        pairs, fewest = better[-1]
        self._raise_bound(fewest)
        return pairs

    def all_of(self, dstates: int, enough: int) -> Generator[list[int], None, None]:
        """Yield all labels with the fewest possible number of dstates, each once.

        Clingo gets a rule against each labelling that was found, and the same question as for the
        fewest dstates. So it soon proves that there are no others.
        """
        program = self.program
        if not any(self.improving()) or (self.bound or 0) > dstates:
            return
        yield from map(list, self._found)
        while True:
            known = [
                program.spanning(found, program.place_of) for found in self._found[self._excluded :]
            ]
            batch = program.batch
            program.add_rules("\n".join(forbidden_pairs(pairs, listed=batch) for pairs in known))
            self._excluded = len(self._found)
            labels = self._first_labels(
                lambda: next(self._asker.answers(self.program.read, f"enum,{dstates}", 1), None)
            )
            if labels is None:
                return
            self._found.append(labels)
            yield list(labels)

    def take_back(self, labels: Sequence[int]) -> bool:
        """Forget labels that turned out to have no map. Return True, as they came from clingo."""
        if (refused := tuple(labels)) in self._found:
            self._excluded -= self._found.index(refused) < self._excluded
            self._found.remove(refused)
        return True

    def give_sides(self, labels: Sequence[int], contrary: Sequence[int]) -> bool:
        """Give clingo the axioms of a path that labels contradict. Return whether they are new."""
        return (
            self.task.speedups.sides
            and len(self.program.fits) <= MANY_PAIRS
            and self.program.give_sides(labels, contrary)
        )

    def forbid(self, labels: Sequence[int], clash: Iterable[Member]) -> None:
        """Exclude all labels that agree with the given ones on the steps of a clash.

        To agree means that two nodes of the clash share a dstate exactly if they have one label.
        """
        program, node_of = self.program, self.chart.node_of
        nodes = list(dict.fromkeys(node_of[step] for member in clash for step in member.steps))
        if unknown := {self.chart.facing[node][0] for node in nodes} - program.visits:
            self._give_more(unknown)
        first = {labels[node]: node for node in nodes}
        different = [
            pair
            for a, b in combinations(first.values(), 2)
            if (pair := program.pair(a, b)) in program.fits
        ]
        together = program.spanning(labels, nodes)
        # If some do not fit, clingo cannot find such labels anyway.
        if program.fits.issuperset(together):
            program.add_rules(forbidden_pairs(together, different))

    def forbid_together(self, equalities: Collection[Equality]) -> None:
        """Exclude labels in which all of these equalities of steps hold.

        If one is about places, labels found before are not removed, as labels do not show which
        nodes are at one place. The search for their paths rejects them later.
        """
        program, facing, node_of = self.program, self.chart.facing, self.chart.node_of
        nodes = [(node_of[one.first], node_of[one.second], one.of) for one in equalities]
        pairs = [(a, b) for a, b, of in nodes if of == "dstate"]
        places = [(a, b) for a, b, of in nodes if of == "place"]
        apart = [(a, b) for a, b in pairs if a != b]
        away = [(a, b) for a, b in places if facing[a][0] != facing[b][0]]
        visits = {facing[node][0] for pair in (*apart, *away) for node in pair}
        if unknown := visits - program.visits:
            self._give_more(unknown)
        fits = program.fits
        choices = [[pair] for a, b in apart if (pair := program.pair(a, b)) in fits]
        for a, b in away:
            (i, _), (j, _) = sorted((facing[a], facing[b]))
            choices.append([(i, j, turned) for turned in range(4) if (i, j, turned) in fits])
        # If a pair has no choice, it is known to be distinct. Then nothing has to be forbidden.
        if len(choices) == len(apart) + len(away):
            rules = (forbidden_pairs(pairs) for pairs in product(*choices))
            program.add_rules("\n".join(rules))
        if away:
            return

        def is_left(labels: Sequence[int]) -> bool:
            return any(labels[a] != labels[b] for a, b in apart)

        self._excluded = sum(map(is_left, self._found[: self._excluded]))
        self._found = [labels for labels in self._found if is_left(labels)]


class VisitProgram:
    """The control of visits.lp, and a record of what it was given.

    Attributes:
        chart: The visits and nodes of the first steps.
        batch: The number of the last batch of visits; -1 before the first.
        visits: The visits that clingo has.
        place_of: For each node, its number in the order in which clingo decides nodes.
        fits: The pairs of visits that may be at one place.
        least: A lower bound on the number of dstates: how many nodes are the first at their dstate
            in every answer.
    """

    def __init__(self, task: Task, asker: Asker, chart: FramedChart) -> None:
        """Make a control without visits."""
        self.chart = chart
        self.batch = -1
        self._asker, self._trace, self._theory = asker, task.trace, task.theory
        self._one, self._together = pairs_in(task.log.pairs.one), task.theory.same_place
        cores = ["--opt-strategy=usc"] if task.speedups.core_guided else []
        asker.control = new_control("visits", "", ["--heuristic=Domain", *cores])
        self.least = 0
        self.visits: set[int] = set()
        self.place_of: dict[int, int] = {}
        self.fits: frozenset[Pair] = frozenset()
        # The facts that clingo has: for each predicate, its arguments without the batch.
        self._given: dict[str, set[tuple[int, ...]]] = defaultdict(set)
        self._closed = 0  # how often rules of transitivity were given
        # The paths for which sides_framed.lp is grounded, each by a visit and a slot.
        self._paths: dict[tuple[int, int], None] = {}

    def give(
        self, chart: FramedChart, visits: set[int], order: Iterable[int], fits: frozenset[Pair]
    ) -> None:
        """Give clingo a new batch: everything about these visits that it does not have yet.

        The visits include those that it has already. `order` has nodes in the order of choice;
        those new to clingo come after all others. `fits` are the pairs of these visits that may be
        at one place.
        """
        control = self._asker.control
        if self.batch >= 0:
            # Answers are now listed up to the new batch.
            control.release_external(Function("listed", number_symbols(self.batch)))
        self.chart = chart
        self.batch += 1
        self.visits |= visits
        nodes = []
        for node in order:
            if node not in self.place_of and chart.facing[node][0] in visits:
                self.place_of[node] = len(self.place_of)
                nodes.append((self.place_of[node], *chart.facing[node]))
        turns = (turn for turn in chart.turns(self._trace) if turn[1] in visits)
        rows: dict[str, Iterable[tuple[int, ...]]] = {
            "visit": ((visit,) for visit in visits),
            "node": nodes,
            "leaves": (
                (visit, *how) for visit, how in chart.leaves.items() if visits >= {visit, visit + 1}
            ),
            "fits": fits,
            "unfit": self.fits - fits,  # more of the trace may separate visits that fitted before
            "joined": self._joined(),
            "together": self._at_one_place(),
            **gathered((kind, tuple(slots)) for kind, *slots in turns),
        }
        self.fits = fits
        news = {name: sorted({*some} - self._given[name]) for name, some in rows.items()}
        for name, some in news.items():
            self._given[name].update(some)
        part = f"visits_{self.batch}"
        control.add(part, [], batch_facts(self.batch, news))
        control.ground([(part, []), ("more", number_symbols(self.batch))])
        control.assign_external(Function("listed", number_symbols(self.batch)), True)
        first = (Function("first", number_symbols(place)) for place, *_ in nodes)
        atoms = control.symbolic_atoms
        self.least += sum(atom.is_fact for one in first if (atom := atoms[one]))
        if self._paths:  # the axioms of paths also hold for the new visits
            paths = [("path", number_symbols(*path, self.batch)) for path in self._paths]
            control.ground([("paths", number_symbols(self.batch)), *paths])

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
        rules = (f"via({self._closed},{','.join(map(str, three))})." for three in threes)
        self.add_rules("\n".join(rules), "closed", self._closed)

    def labels(self, pairs: Iterable[Pair]) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return the dstate of each node by the pairs in a transitive answer, and missed visits.

        Dstates are numbered in the order of their first nodes. If visits are missed, so that the
        answer does not locate all of them, no dstates are returned.
        """
        first: dict[int, tuple[int, int]] = {}
        for i, j, r in sorted(pairs):
            first.setdefault(j, (i, r))
        number: dict[int, int] = {}
        states: dict[int, State] = {}
        for visit in sorted(self.visits):
            i, r = first.get(visit, (visit, 0))
            states[visit] = 4 * number.setdefault(i, len(number)) + -r % 4
        everywhere, missed = located(self.chart, states)
        facing = () if missed else self.chart.facing
        return tuple(numbered(faced(everywhere[visit], slot) for visit, slot in facing)), missed

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

    def give_sides(self, labels: Sequence[int], contrary: Iterable[int]) -> bool:
        """Add the axioms of a path that labels contradict, and return whether there was a new one.

        `contrary` has a dstate of each path that contradicts the axioms.
        """
        # For each dstate that has a node in clingo: the visit and the slot of such a node.
        standing = {labels[node]: self.chart.facing[node] for node in self.place_of}
        paths = (standing[dstate] for dstate in contrary)
        path = next((path for path in paths if path not in self._paths), None)
        if path is None:
            return False
        control, batches = self._asker.control, range(self.batch + 1)
        with self._asker.grounding_timed():
            if not self._paths:
                control.load(encodings.path("sides_framed"))
                control.add("sides", [], "\n".join(sides(self._theory)))
                control.ground(
                    [("sides", []), *(("paths", number_symbols(batch)) for batch in batches)]
                )
            self._paths[path] = None
            control.ground([("path", number_symbols(*path, batch)) for batch in batches])
        return True


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


def batch_facts(batch: int, news: Mapping[str, Iterable[tuple[int, ...]]]) -> str:
    """Return the facts for one batch: for each predicate of visits.lp, its other arguments."""
    return "\n".join(
        f"{name}({batch},{','.join(map(str, arguments))})."
        for name, rows in news.items()
        for arguments in rows
    )


@lru_cache(maxsize=2**16)
def read_same(atom: Symbol) -> tuple[int, int, int]:
    """Read the pair of visits (I, J, R) from an atom of `same`. Answers share most atoms."""
    first, second, turned = (argument.number for argument in atom.arguments)
    return first, second, turned


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
