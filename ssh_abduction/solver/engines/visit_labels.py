"""Labels with the fewest dstates where places have frames, without naming any dstate.

This serves the framed engine. Clingo is asked which visits are at one place (visits.lp). It finds
labels of all nodes with the fewest dstates, proves that there are none with fewer, and lists all
that have as few. That order and sides allow them is checked by `engines/framed.py`.

Names are poor knowledge if many dstates are known from few visits. What is learned of one spare
name has to be learned again of the next, and each is a choice for nodes all over the world. That
two visits are the same is only about these two. A node is *alone* if no node before it, in an order
of choice, is at its dstate; there are as many dstates as lone nodes.

*Order.* A clique of nodes that are apart comes first, then the nodes that fit few others. What is
new when the trace grows comes last, so what clingo was told and what it learned still holds. When
nodes are a tenth more, a new control is taken, as a clique first is the better order.

*Transitive.* If I is J and J is K, then I is K. Clingo is told so only of visits at which an answer
fails to be transitive (`engines/transitive.py`). Until no answer fails, what clingo solves is a
relaxation, so its bounds hold.

*Lazily.* Of a long trace clingo is told of the first visits, until many of them may be one, and of
the visits of the clique. An answer says where the others are, too (`steps/localising.py`). If it
does not, clingo is told of these visits, and of as many before them as it takes. Fewer visits are a
relaxation, and an answer that says where all visits are is an answer for all of them.

*From below.* Cores raise the bound (`Cores`). Clasp has that built in, but begins anew with each
call, and an answer that fails to be transitive is a call.

*Near a guess.* If that takes long, clingo is asked for answers in which visits are one that are one
in the map made of a guess. They need not have the fewest dstates. But if they have as few as the
bound, they do.
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

# Tell clingo of the first visits with this many pairs that may be one, and of others as answers
# need them.
FIRST_PAIRS = 10_000
# After this many conflicts it is left open whether fewer places still clash.
TRY_CONFLICTS = 100
# After this many tries in vain a set of places that clash is kept as it is.
FAILED_TRIES = 20
# If there are this many times as many nodes as at first, take a new control: the order of choice
# was made for the first nodes.
GROWN = 1.1
# After this many answers found one by one look for the next ones nearby, which pays if there are
# many.
MANY = 5
# After this many failures to be transitive no answer is nearby, and one is asked for anew.
FAR = 200


class Open(Enum):
    """Stands for an answer that is not known yet, as something else is to be done first."""

    OPEN = "open"


OPEN: Final = Open.OPEN


class VisitLabels:
    """Labels of the nodes of the first steps with the fewest dstates.

    Attributes:
        size: How many steps these are.
        bound: No labels have fewer dstates.
        clique: Nodes that are pairwise apart.
        known: Labels of a map, if one is known; set by the engine that finds one near a guess.
        has_forbidden: Whether evidence forbade something that was found out of a map.
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
            sides: It is told of new controls and of batches.
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
        self._excluded = 0  # clingo will not find this many of them again

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
        """Chart the first steps, and tell clingo what is new of their visits.

        If that is much, take a new control.

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
        """The nodes, those first that are pairwise apart, then those that fit few others."""
        apart = chart.apart()
        self._asker.watch.check()
        self.clique = clique(apart, chart.seen) if self._task.speedups.clique else []
        others = set(range(len(apart))) - set(self.clique)
        return [
            *self.clique,
            *sorted(others, key=lambda node: (-int(apart[node].sum()), node)),
        ]

    def _first_visits(self, chart: FramedChart) -> set[int]:
        """The visits that clingo is told of first: all, unless too many may be one."""
        first = chart.visits_with(FIRST_PAIRS) if self._task.speedups.lazy else len(chart.stars)
        return {*range(first), *(chart.facing[node][0] for node in self.clique)}

    def _give(
        self, chart: FramedChart, visits: set[int], order: Iterable[int], *, anew: bool = False
    ) -> None:
        """Tell clingo what it does not know yet of these visits of a chart."""
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
        """Tell clingo of these visits, too."""
        more = {*self.program.visits, *visits}
        assert more != self.program.visits  # else that would go on without end
        with self._asker.grounding_timed():
            self._give(self.chart, more, range(len(self.chart.seen)))

    def _raise_bound(self) -> None:
        self.bound = max(self.bound or 0, self.program.cores.least)

    def fewest(self, until: Callable[[], bool] = lambda: False) -> list[int] | Open | None:
        """Labels of all nodes with the fewest dstates.

        Returns:
            The labels; None if clingo was told more than any labels can satisfy; OPEN if `until`
            holds before that is known.
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
        """Tell clingo why an answer was refused."""
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

        At first clingo is asked for labels in which visits are at one place exactly if they are so
        in the guess, as far as that can be. Visits of places that cannot all be as guessed become
        free. Once the caller takes such labels for `known`, clingo is asked for no lone nodes. If
        a core shows that these are too many, one of them may be alone.
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

        Clingo is told not to find again what was found, and asked as for the fewest dstates. So it
        soon shows that there are no others. If there are many, the next one is near, and a
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
        """Labels that clingo finds one from another.

        Returns:
            Whether these are all that were not excluded.
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
        """How clingo is asked for at most this many dstates: its opt-mode, and assumptions."""
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
        """Forbid that these pairs of nodes are all one dstate while those are at one place.

        Labels alone do not tell which nodes are at one place. So if places are given, labels that
        were found stay; the search for their paths refuses them.

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
