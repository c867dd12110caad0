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
of all other visits (`steps/localising.py`). If not, clingo gets further visits. Fewer visits are a
relaxation, and an answer that locates all visits is an answer for all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Sequence
from itertools import combinations

from ssh_abduction.solver.asp.control import Asker
from ssh_abduction.solver.sources.exact.engine import Task
from ssh_abduction.solver.sources.exact.fitting import Member
from ssh_abduction.solver.sources.exact.visit_program import (
    FramedSides,
    Pair,
    VisitProgram,
    fits_in_time,
    forbidden_pairs,
    forbidden_places,
    intransitive,
)
from ssh_abduction.solver.steps.apart import clique
from ssh_abduction.solver.steps.chart import Chart, FramedChart
from ssh_abduction.theory.evidence import Equality

# At first, give clingo only the first visits: those with at most this many pairs that may be at one
# place. It gets other visits if answers need them.
FIRST_PAIRS = 10_000
# If more pairs of visits than this may be at one place, add no axioms of single paths. They take
# about forty rules for each pair.
MANY_PAIRS = 20_000
# If the number of nodes has grown by this factor, make a new control, as the order of choice only
# suits the nodes that it was made for.
GROWN = 1.1


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
        self._sides = FramedSides(task.theory, asker)
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
                has_all = len(program.known.visits) == len(self.chart.stars)
                new = range(len(self.chart.stars), len(chart.stars)) if has_all else ()
                self._give(chart, {*program.known.visits, *new}, range(len(chart.seen)))
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
        known = 0 if anew else len(self.program.known.fits)
        fits = fits_in_time(self._asker.watch, chart, visits, known)
        size, self.size = self.size, 0  # an error may leave this prefix incomplete
        if anew:
            self._program = VisitProgram(self.task, self._asker, chart, self._sides)
            self._nodes_at_start = len(chart.seen)
        self.program.give(chart, visits, order, fits)
        self._raise_bound(self.program.least)
        self._excluded = 0
        self.size = size

    def _give_more(self, visits: Iterable[int]) -> None:
        """Give clingo these visits in addition to those that it has."""
        more = {*self.program.known.visits, *visits}
        assert more != self.program.known.visits  # else the search would never end
        with self._asker.grounding_timed():
            self._give(self.chart, more, range(len(self.chart.seen)))

    def _raise_bound(self, bound: int) -> None:
        """Take over a lower bound if it is higher."""
        self.bound = max(self.bound or 0, bound)

    def large_enough(self, size: int) -> int:
        """Return how many steps of the trace to take: `size`."""
        return size

    def improving(self) -> Iterator[list[int]]:
        """Yield the dstates of all nodes, as few as possible; nothing if the rules allow none."""
        if (labels := self.fewest()) is not None:
            yield labels

    def fewest(self) -> list[int] | None:
        """Find the dstates of all nodes, as few as possible; None if the rules allow none."""
        if not self._found:
            labels = self._first_labels(self._best_answer)
            if labels is None:
                return None
            self._found.append(labels)
        return list(self._found[0])

    def _first_labels(self, ask: Callable[[], list[Pair] | None]) -> tuple[int, ...] | None:
        """Return the labels of all nodes from the first answer that is a map of the chart.

        After any other answer, clingo gets what it lacked: rules, or visits. `ask` returns the
        pairs of visits that are at one place in the next answer.
        """
        while (pairs := ask()) is not None:
            program = self.program
            if threes := intransitive(pairs, program.known.fits, program.chart):
                program.close(threes)
            elif (located := program.located(pairs)).missed:
                self._give_more(located.missed)
            else:
                return program.labels(located)
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
        if self.fewest() is None or (self.bound or 0) > dstates:
            return
        yield from map(list, self._found)
        while True:
            known = [
                program.spanning(found, program.known.place_of)
                for found in self._found[self._excluded :]
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

    def give_sides(
        self, labels: Sequence[int], contrary: Sequence[int], twice: Sequence[int]
    ) -> bool:
        """Give clingo the axioms of a path that labels contradict. Return whether they are new."""
        return (
            self.task.speedups.sides
            and len(self.program.known.fits) <= MANY_PAIRS
            and self._sides.say_of_path(contrary, twice, self.program.standing(labels))
        )

    def forbid(self, labels: Sequence[int], found: Iterable[Iterable[Member]]) -> None:
        """Exclude all labels that agree with the given ones on the steps of some clash.

        To agree means that two nodes of the clash share a dstate exactly if they have one label.
        """
        program, node_of = self.program, self.chart.node_of
        clashes = [
            list(dict.fromkeys(node_of[step] for member in clash for step in member.steps))
            for clash in found
        ]
        clashing = {self.chart.facing[node][0] for clash in clashes for node in clash}
        if unknown := clashing - program.known.visits:
            self._give_more(unknown)
        rules = []
        for clash in clashes:
            first = {labels[node]: node for node in clash}
            different = [
                pair
                for a, b in combinations(first.values(), 2)
                if (pair := program.pair(a, b)) in program.known.fits
            ]
            together = program.spanning(labels, clash)
            # If some do not fit, clingo cannot find such labels anyway.
            if program.known.fits.issuperset(together):
                rules.append(forbidden_pairs(together, different))
        program.add_rules("\n".join(rules))

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
        if unknown := visits - program.known.visits:
            self._give_more(unknown)
        fits = program.known.fits
        choices = [[pair] for a, b in apart if (pair := program.pair(a, b)) in fits]
        for a, b in away:
            (i, _), (j, _) = sorted((facing[a], facing[b]))
            choices.append([(i, j, turned) for turned in range(4) if (i, j, turned) in fits])
        # If a pair has no choice, it is known to be distinct. Then nothing has to be forbidden.
        if len(choices) == len(apart) + len(away):
            program.add_rules(forbidden_places(choices))
        if away:
            return

        def is_left(labels: Sequence[int]) -> bool:
            return any(labels[a] != labels[b] for a, b in apart)

        self._excluded = sum(map(is_left, self._found[: self._excluded]))
        self._found = [labels for labels in self._found if is_left(labels)]
