"""Labels with the fewest dstates where places have frames, without naming any dstate.

This serves the framed engine. Clingo is asked which visits are at one place (visits.lp). It finds
labels of all nodes with the fewest dstates, proves that none have fewer, and lists all that have
as few. `engines/framed.py` checks whether order and sides allow them.

Names help little if many dstates have few visits. What clingo learns about one spare name it has
to learn again about the next, and nodes all over the world may choose each name. An equality of
visits is only about these two. A node is *alone* if no node before it, in an order of choice, is
at its dstate; there are as many dstates as lone nodes.

*Order.* A clique of nodes comes first, then the nodes that fit few others. New nodes of a trace
that grows come last, so the rules that clingo has, and what it learned, still hold. If the number
of nodes has grown by a tenth, a new control begins with a new clique.

*Transitive.* If I is J and J is K, then I is K. Clingo gets this rule only for visits at which an
answer violates it (`engines/transitive.py`). Until no answer does, clingo solves a relaxation, so
its bounds hold.

*Lazily.* Of a long trace clingo is given the visits of the clique and the first visits, until many
of them may be one. An answer mostly says where the other visits are (`steps/localising.py`). If it
does not, clingo is given these visits, and as many before them as needed. Fewer visits are a
relaxation, and an answer that locates all visits is an answer for all of them.

*From below.* Cores raise the bound (`Cores`). Clasp has that built in, but begins anew with each
call, and an answer that fails to be transitive is a call.

*Near a guess.* If the search takes long, clingo is asked for answers that keep the equalities of a
guessed map. These answers need not have the fewest dstates, unless they have as few as the bound.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from enum import Enum
from functools import partial
from itertools import combinations, islice
from typing import Final

import clingo

from ssh_abduction.solver.asp.control import Asker
from ssh_abduction.solver.asp.facts import visits_lp
from ssh_abduction.solver.engines.base import Task
from ssh_abduction.solver.engines.refusing import first_accepted, smaller
from ssh_abduction.solver.engines.visit_program import (
    Answer,
    Refusal,
    Sides,
    VisitProgram,
    fits_in_time,
)
from ssh_abduction.solver.steps.apart import clique
from ssh_abduction.solver.steps.chart import FramedChart, numbered
from ssh_abduction.solver.steps.localising import Located, states_of

# Give clingo the first visits with this many pairs that may be one, and others as answers need
# them.
FIRST_PAIRS = 10_000
# After this many conflicts, stop asking whether fewer places still clash.
TRY_CONFLICTS = 100
# After this many failed tries, stop shrinking a set of places that clash.
FAILED_TRIES = 20
# If the number of nodes has grown by this factor, take a new control: the order of choice was made
# for the first nodes.
GROWN = 1.1
# After this many answers found one by one, look for the next ones near the last. That pays if there
# are many.
MANY = 5
# After this many intransitive answers nearby, ask for one anew.
FAR = 200


class Open(Enum):
    """Stands for an answer that is unknown because the search was interrupted."""

    OPEN = "open"


OPEN: Final = Open.OPEN


class VisitLabels:
    """Finds labels with the fewest dstates for the first steps of a trace.

    Attributes:
        size: The number of these steps.
        bound: A lower bound on the dstates.
        clique: Nodes that are pairwise distinct.
        known: Labels of the best known map, or None. The engine sets them.
        has_forbidden: Whether evidence has rejected equalities of a map.
    """

    def __init__(
        self,
        task: Task,
        asker: Asker,
        charted: Callable[[int, FramedChart | None], FramedChart | None],
        sides: Sides,
    ) -> None:
        """Labels of no steps yet.

        Args:
            task: The trace and the speed-ups that are on.
            asker: It asks clingo.
            charted: Makes the chart of the first steps, from one of fewer steps if there is one;
                None if they fit no frame.
            sides: Called for new controls and batches.
        """
        self.bound: int | None = None
        self.clique: list[int] = []
        self.known: tuple[int, ...] | None = None
        self.has_forbidden = False
        self.size = 0
        self._task, self._asker, self._charted, self._sides = task, asker, charted, sides
        self._program: VisitProgram | None = None
        self._first_nodes = 0  # how many nodes there were when the control was new
        self._found: list[tuple[int, ...]] = []  # labels with the fewest dstates
        self._excluded = 0  # the number of these that clingo will not find again

    @property
    def program(self) -> VisitProgram:
        """The control that knows visits."""
        assert self._program is not None  # `grow` comes first
        return self._program

    @property
    def chart(self) -> FramedChart:
        """The visits and nodes of the first steps."""
        return self.program.chart

    def work_on(self, task: Task) -> None:
        """Go on with a trace that the one before has grown to."""
        self._task = task

    def grow(self, size: int) -> bool:
        """Chart the first steps, and give clingo their new visits.

        If there are many, take a new control.

        Returns:
            Whether visits fit a frame.
        """
        if size == self.size:
            return True
        with self._asker.grounding_timed():
            grown = self._charted(size, self.chart) if self.size else None
            if grown is not None and len(grown.seen) <= GROWN * self._first_nodes:
                program = self.program
                new = range(len(self.chart.stars), len(grown.stars)) if program.knows_all else ()
                self._give(grown, {*program.visits, *new}, range(len(grown.seen)))
            else:
                chart = self._charted(size, None)
                if chart is None:
                    return False
                # The order finds the clique, whose visits are among the first.
                order = self._order_of_choice(chart)
                self._give(chart, self._first_visits(chart), order, anew=True)
            self.size = size
            self._found = []
            self.known = None
            return True

    def _order_of_choice(self, chart: FramedChart) -> list[int]:
        """The nodes, those first that are pairwise distinct, then those that fit few others."""
        apart = chart.apart()
        self._asker.watch.check()
        self.clique = clique(apart, chart.seen) if self._task.speedups.clique else []
        others = set(range(len(apart))) - set(self.clique)
        return [
            *self.clique,
            *sorted(others, key=lambda node: (-int(apart[node].sum()), node)),
        ]

    def _first_visits(self, chart: FramedChart) -> set[int]:
        """The visits that clingo is given first: all, unless too many may be one."""
        first = chart.visits_with(FIRST_PAIRS) if self._task.speedups.lazy else len(chart.stars)
        return {*range(first), *(chart.facing[node][0] for node in self.clique)}

    def _give(
        self, chart: FramedChart, visits: set[int], order: Iterable[int], *, anew: bool = False
    ) -> None:
        """Give clingo what it lacks about these visits of a chart."""
        known = 0 if anew else len(self.program.fits)
        fits = fits_in_time(self._asker.watch, chart, visits, known)
        size, self.size = self.size, 0  # until clingo was told all of it
        if anew:
            self._program = VisitProgram(self._task, self._asker, chart, self._sides)
            self._first_nodes = len(chart.seen)
        self.program.give(chart, visits, order, fits)
        self._raise_bound()
        self._excluded = 0
        self.size = size

    def _give_more(self, visits: Iterable[int]) -> None:
        """Also give clingo these visits."""
        more = {*self.program.visits, *visits}
        assert more != self.program.visits  # else the search would never end
        with self._asker.grounding_timed():
            self._give(self.chart, more, range(len(self.chart.seen)))

    def _raise_bound(self) -> None:
        self.bound = max(self.bound or 0, self.program.cores.least)

    def fewest(self, until: Callable[[], bool] = lambda: False) -> list[int] | Open | None:
        """Labels of all nodes with the fewest dstates.

        Returns:
            The labels; None if no labels satisfy all constraints; OPEN if `until` held before
            they were found.
        """
        while not self._found:
            if self.known and self.bound == len(set(self.known)):
                self._found.append(self.known)
                break
            answer = first_accepted(
                partial(self._best_answer, until), self.program.why_not, self._tell_why
            )
            if answer is None:
                return None
            if answer.is_open:
                return OPEN
            self._found.append(self.program.labels(answer.located))
        return list(self._found[0])

    def _tell_why(self, reason: Refusal) -> None:
        """Tell clingo why an answer was rejected."""
        if reason.threes:
            self.program.close(reason.threes)
        else:
            self._give_more(reason.missed)

    def _best_answer(self, until: Callable[[], bool]) -> Answer | None:
        """An answer with the fewest lone nodes; None if there is none."""
        program = self.program
        if not self._task.speedups.core_guided:
            read = program.read
            better = list(self._asker.answers(lambda model: (read(model), model.cost[0]), "opt", 0))
            if not better:
                return None
            pairs, program.cores.least = better[-1]
            self._raise_bound()
            return Answer(pairs)
        while True:
            if until():
                return Answer(is_open=True)
            avoided = list(program.cores.avoided)
            pairs_found, core = self._asker.verdict(program.read, avoided, until=until)
            if core is None:
                return Answer(pairs_found or (), is_open=pairs_found is None)
            if not core:
                return None
            program.cores.relax(core)
            self._raise_bound()

    def near(self, guess: Sequence[int]) -> Iterator[tuple[int, ...] | None]:
        """The guess itself, then improved labels of all nodes.

        Yields None between queries, so that the caller can do other work.

        At first clingo is asked for labels that put visits at one place exactly if the guess does,
        if possible. If some places of the guess contradict each other, their visits become free.
        Once the caller sets `known` to such labels, clingo is asked for no lone nodes. If a core
        shows that some node has to be alone, one of the core may be.
        """
        program = self.program
        yield tuple(numbered(guess))
        states = states_of(self.chart, guess)
        place_of: dict[int, int] = {}  # by the literal that two of its visits are one
        freed: set[int] = set()
        avoided: set[int] = set()
        patient, pairs, batch = False, 0, -1
        while True:
            if batch < program.batch:
                batch = program.batch
                literals = program.read_literals()
                for (i, j, r), literal in islice(literals.items(), pairs, None):
                    if states[i] // 4 != states[j] // 4 or (states[i] - states[j]) % 4 != r:
                        avoided |= set() if patient else {-literal}
                    elif states[i] // 4 not in freed:
                        place_of[literal] = states[i] // 4
                pairs = len(literals)
                patient = False
            if self.known and not patient:
                patient, avoided = True, set(program.cores.avoided)
            yield None
            pairs_found, core = self._asker.verdict(program.read, [*place_of, *avoided])
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
            elif (reason := self.program.why_not(answer := Answer(pairs_found or []))) is not None:
                self._tell_why(reason)
            else:
                yield program.labels(answer.located)

    def _together_impossible(self, places: list[int], place_of: Mapping[int, int]) -> list[int]:
        """A small subset of places that cannot all be as guessed."""

        def impossible(some: list[int]) -> list[int] | None:
            core = self._asker.verdict(
                lambda _: None,
                [literal for literal, place in place_of.items() if place in some],
                TRY_CONFLICTS,
            )[1]
            return None if core is None else sorted({place_of[literal] for literal in core})

        return smaller(places, impossible, FAILED_TRIES)

    def all_of(self, dstates: int) -> Generator[list[int], None, None]:
        """All labels with this many dstates, each once.

        Clingo is forbidden to find labels twice, and asked as for the fewest dstates. So it soon
        shows that there are no others. If there are many, the next ones are near the last, and a
        propagator keeps answers transitive (`_nearby`).
        """
        program = self.program
        if self.fewest() is None or program.cores.least > dstates:
            return
        yield from map(list, self._found)
        asked = 0
        while True:
            known = [
                program.spanning(found, program.nodes) for found in self._found[self._excluded :]
            ]
            batch = program.batch
            program.tell(
                "\n".join(visits_lp.forbidden_pairs(pairs, listed=batch) for pairs in known)
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
        """Labels that clingo finds near the ones before.

        Returns:
            Whether these are all labels left.
        """
        program = self.program
        transitive = program.transitive

        def read(model: clingo.Model) -> Located:
            transitive.failed = 0
            return program.located(program.read(model))

        excluded = set(self._found[self._excluded :])
        program.read_literals()
        transitive.asked, transitive.failed = True, 0
        mode, assumed = self._asking_for(dstates)
        answers = self._asker.answers(
            read, mode, 0, assumptions=assumed, until=lambda: transitive.failed > FAR
        )
        try:
            while True:
                try:
                    everywhere = next(answers)
                except StopIteration as end:
                    return bool(end.value)
                if everywhere.missed:
                    break
                labels = program.labels(everywhere)
                if labels not in excluded:
                    self._found.append(labels)
                    yield list(labels)
        finally:
            answers.close()
            transitive.asked = False
        self._give_more(everywhere.missed)
        return False

    def _other(self, dstates: int) -> tuple[int, ...] | None:
        """Labels with this many dstates that were not excluded; None if there are none."""

        def ask() -> Answer | None:
            mode, assumed = self._asking_for(dstates)
            found, _ = self._asker.verdict(self.program.read, assumed, mode=mode)
            return None if found is None else Answer(found)

        answer = first_accepted(ask, self.program.why_not, self._tell_why)
        return None if answer is None else self.program.labels(answer.located)

    def _asking_for(self, dstates: int) -> tuple[str, list[int]]:
        """The opt-mode and the assumptions that allow at most this many dstates."""
        cores = self.program.cores
        if self._task.speedups.core_guided and cores.least == dstates:
            return "ignore", list(cores.avoided)
        return f"enum,{dstates}", []

    def take_back(self, labels: Sequence[int]) -> None:
        """Forget labels that were yielded and turned out to be no answer."""
        if (refused := tuple(labels)) in self._found:
            self._excluded -= self._found.index(refused) < self._excluded
            self._found.remove(refused)

    def forbid(self, labels: Sequence[int], clashes: Collection[Collection[int]]) -> None:
        """Forbid that the nodes of a set are one dstate exactly if they have one label.

        Args:
            labels: Those of all nodes.
            clashes: The sets of nodes.
        """
        program = self.program
        clashing = {self.chart.facing[node][0] for clash in clashes for node in clash}
        if unknown := clashing - program.visits:
            self._give_more(unknown)
        rules = []
        for clash in clashes:
            first = {labels[node]: node for node in clash}
            different = [
                pair
                for a, b in combinations(first.values(), 2)
                if (pair := program.pair(a, b)) in program.fits
            ]
            together = program.spanning(labels, clash)
            if program.fits.issuperset(together):  # else clingo knows by now
                rules.append(visits_lp.forbidden_pairs(together, different))
        program.tell("\n".join(rules))

    def forbid_together(
        self, pairs: Collection[tuple[int, int]], places: Collection[tuple[int, int]] = ()
    ) -> None:
        """Forbid that all `pairs` are one dstate while all `places` are at one place.

        Labels alone do not show which nodes are at one place. So if places are given, known labels
        stay; the search for their paths rejects them.

        Args:
            pairs: Pairs of nodes that are one dstate.
            places: Pairs of nodes that are at one place.
        """
        self.has_forbidden = True
        program, facing = self.program, self.chart.facing
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
        if len(choices) == len(apart) + len(away):  # else they are apart by now
            program.tell(visits_lp.forbidden_places(choices))
        if away:
            return

        def is_left(labels: Sequence[int]) -> bool:
            return any(labels[a] != labels[b] for a, b in apart)

        self._excluded = sum(map(is_left, self._found[: self._excluded]))
        self._found = [labels for labels in self._found if is_left(labels)]
        self.known = self.known if self.known and is_left(self.known) else None
