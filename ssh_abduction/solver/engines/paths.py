"""Asks paths_framed.lp what order and sides imply for dstates, and makes guesses into maps.

The engine with frames uses it. `engines/framed_paths.py` asks the questions that need a search for
places and paths, under the limits of the engine. The questions here need hardly any search. So a
small number of conflicts is enough as their limit.

*Guesses.* Annealing guesses which visits are at one place (`guesses/annealing.py`). Where the guess
cannot be right, the labels are dropped, and the visits are merged by evidence instead
(`guesses/merging.py`). Meanwhile paths_framed.lp says which visits cannot be at one place, which
have to be, and which merge allows no paths. So a guess becomes a map.

*Undone merges.* If no paths fit the merged labels, bisection finds the first wrong merge. The two
classes that it merged stay separate from then on. If no paths fit the guess itself, its places are
added in order: first the places visited once, then the places visited most. A place that allows no
paths is left out of the guess. At most a few places are left out. If a guess leads to no map,
another guess follows, with more spare names for places. With too few names, different places are
merged and do not separate again.

*Separate paths.* To find out whether labels have any paths, places and segments are only merged if
they must be. That takes a small part of the time for grounding all ways to merge them.

*Pinned segments.* To find the fewest paths, pairwise distinct segments get paths of their own. Then
other segments are assigned to these paths, or to new ones.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import replace
from functools import partial

import clingo
import numpy as np

from ssh_abduction.data.trace import Trace
from ssh_abduction.solver.asp.control import Control
from ssh_abduction.solver.asp.facts import paths_lp
from ssh_abduction.solver.asp.limits import Watch
from ssh_abduction.solver.guesses.annealing import MORE, SECONDS, attempts
from ssh_abduction.solver.guesses.merging import (
    Told,
    first_failing,
    kept,
    merged_as_told,
    merged_near,
)
from ssh_abduction.solver.steps.apart import Matrix, large_clique
from ssh_abduction.solver.steps.chart import FramedChart
from ssh_abduction.solver.steps.localising import faced, states_of, tracked
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.theory import Theory

# With these options, clasp lists the answers with minimal sets of shown atoms.
SMALLEST = ("--heuristic=Domain", "--dom-mod=5,16", "--enum-mode=domRec")
# Annealing takes time for each pair of visits that may be at one place. If there are more than
# twice as many pairs, first guess only the first visits, with this many pairs.
FIRST_PAIRS = 200_000
# Continue a guess of the first visits if at most this share of all visits cannot be located by it.
# Otherwise it helps little.
LOST = 0.05
# After this many conflicts, stop looking for separate paths. There are thousands of such questions,
# and most of them are answered without a conflict.
TRYING = 500
# Leave at most this many places out of a guess so that the others have paths. If more are wrong,
# make a new guess.
LEFT_OUT = 3
# Clasp prepares to solve for about these multiples of the time and the memory that grounding took.
# It cannot be stopped meanwhile.
PREPARING = (1.6, 2.1)
# Around a contradiction in a guess, drop the labels of places up to 0, 1, … travels away: this many
# variants. A wrong place mostly has a wrong neighbour.
LOOSENED = 2


class Paths:
    """The axioms of places and paths, for charts of one trace."""

    def __init__(
        self,
        trace: Trace,
        theory: Theory,
        *,
        pinned: bool = True,
        check: Callable[[], None] = lambda: None,
        forbidden: Sequence[Collection[Equality]] = (),
    ) -> None:
        """Prepare questions about a trace.

        Args:
            trace: The trace.
            theory: The theory, with all defaults filled in.
            pinned: Whether pairwise distinct segments get paths of their own beforehand.
            check: Called now and then while clingo grounds; may raise to stop. It is not sent to
                other processes.
            forbidden: Sets of equalities of steps. In no map do all equalities of one set hold.
        """
        self._trace = trace
        self._theory = theory
        self._pinned = pinned
        self._forbidden = forbidden
        self._check = check

    def __reduce__(self) -> tuple[Callable[..., Paths], tuple[Trace, Theory]]:
        """Leave out `check` when this object is sent to another process."""
        return partial(Paths, pinned=self._pinned, forbidden=self._forbidden), (
            self._trace,
            self._theory,
        )

    def _under(self, check: Callable[[], None]) -> Paths:
        """Make the same questions, with another `check`."""
        return Paths(
            self._trace, self._theory, pinned=self._pinned, check=check, forbidden=self._forbidden
        )

    def control(self, chart: FramedChart, options: Sequence[str] = ()) -> Control:
        """Make a control with the axioms and the facts of a chart. Nothing is grounded yet."""
        control = Control(options, self._check, PREPARING)
        control.load_encodings("paths_framed")
        control.add(
            "base",
            [],
            paths_lp.paths_framed_facts(self._trace, self._theory, chart, self._forbidden),
        )
        return control

    def contrary(self, chart: FramedChart, labels: Sequence[int]) -> clingo.Control:
        """Make a control whose answer says which single paths contradict the axioms."""
        control = self.control(chart)
        control.add("base", [], paths_lp.settled_labels(enumerate(labels)))
        control.ground([("base", []), ("again", []), ("contrary", [])])
        return control

    def clashing(self, chart: FramedChart, labels: Sequence[int]) -> clingo.Control:
        """Make a control whose answers are minimal sets of nodes whose labels no paths fit.

        It finds only sets that clash however segments are merged to paths.
        """
        control = self.control(chart, SMALLEST)
        control.add("base", [], paths_lp.open_labels(labels))
        control.ground([("base", [])])
        return control

    def settled(
        self,
        chart: FramedChart,
        labels: Sequence[int],
        options: Sequence[str] = (),
        nodes: Iterable[int] | None = None,
        *,
        single: bool,
    ) -> clingo.Control:
        """Make a control whose answers are the places and paths that fit labels.

        Args:
            chart: The chart of the nodes.
            labels: The dstate of each node.
            options: Options of clasp.
            nodes: The nodes whose labels have to fit; all of them by default.
            single: Whether to merge places and segments only if they must be one.
        """
        control = self.control(chart, options)
        control.load_encodings("preference")
        nodes = range(len(labels)) if nodes is None else nodes
        control.add(
            "base", [], paths_lp.settled_facts(self._theory, chart, labels, nodes, single=single)
        )
        where = [labels[node] for node in chart.node_of]
        control.add("base", [], paths_lp.stretch_facts(self._trace, self._theory, where))
        control.ground(
            [("base", []), *([("again", [])] if single else []), ("segments", []), ("least", [])]
        )
        if self._pinned and not single:
            control.add(
                "pinned",
                [],
                paths_lp.pinned_facts(pairwise_distinct(*paths_lp.read_distinct(control))),
            )
        control.ground([("pinned", []), ("paths", []), ("each", [])])
        return control

    def telling(
        self, chart: FramedChart, labels: Sequence[int], loose: Iterable[int]
    ) -> clingo.Control:
        """Make a control whose answer is what holds in each map with these labels.

        Args:
            chart: The chart of the nodes.
            labels: The dstate of each node.
            loose: Dstates whose labels may be wrong.
        """
        control = self.control(chart)
        control.add(
            "base", [], f"{paths_lp.settled_labels(enumerate(labels))}\n{paths_lp.loose(loose)}"
        )
        control.ground([("base", []), ("again", []), ("apart", [])])
        return control

    def told(self, chart: FramedChart, labels: Sequence[int], loose: Sequence[int]) -> Told | None:
        """Find out what follows from the labels that are not loose, by the axioms.

        Args:
            chart: The chart of the nodes.
            labels: The label of each node.
            loose: The nodes whose labels may be wrong.

        Returns:
            Which nodes are apart (a matrix), and which are one dstate (pairs); None if the labels
            contradict the axioms.
        """
        control = self.telling(chart, labels, {labels[node] for node in loose})
        with control.solve(yield_=True) as handle:
            model = handle.model()
            assert model
            violated, elsewhere, one = paths_lp.read_told(model)
        if violated:
            return None
        first = {label: node for node, label in reversed(list(enumerate(labels)))}
        return _apart(chart, labels, elsewhere), [(first[a], first[b]) for a, b in one]

    def may_fit(self, chart: FramedChart, labels: Sequence[int], loose: Collection[int]) -> bool:
        """Whether the labels, except those of the loose nodes, may have separate paths."""
        control = self.control(chart)
        control.add("base", [], paths_lp.settled_labels(enumerate(labels)))
        control.ground([("base", [])])
        return not paths_lp.is_violated(control) and self._may_have_separate(chart, labels, loose)

    def has_separate(
        self, chart: FramedChart, labels: Sequence[int], nodes: Iterable[int] | None = None
    ) -> bool | None:
        """Whether separate paths fit labels; None if clingo does not know this soon.

        Args:
            chart: The chart of the nodes.
            labels: The dstate of each node.
            nodes: The nodes whose labels have to fit; None for all.
        """
        options = [f"--solve-limit={TRYING}"]
        return self.settled(chart, labels, options, nodes, single=True).solve().satisfiable

    def _may_have_separate(
        self, chart: FramedChart, labels: Sequence[int], loose: Collection[int]
    ) -> bool:
        """Whether separate paths fit the labels of all but loose nodes; True if it is unknown."""
        return (
            self.has_separate(chart, labels, set(range(len(labels))).difference(loose)) is not False
        )

    def guessed_labels(self, chart: FramedChart, watch: Watch) -> list[int]:
        """Guess labels that satisfy the causal axioms, if possible with separate paths that fit.

        If no such labels are found soon, return the guess with the fewest dstates. In a long trace
        guess the labels of the first visits, and locate the other visits by them. If that leads to
        no map, guess twice as many visits, and so on.

        Returns:
            The dstate of each node.
        """
        asked = self._under(watch.check)
        visits = chart.visits_with(FIRST_PAIRS)
        while visits < len(chart.stars) and chart.fitting[-1] > 2 * chart.fitting[visits]:
            part = chart.beginning(visits)
            if labels := asked._continued(
                chart, part, asked._guessed(part, watch.check), watch.check
            ):
                return labels
            visits *= 2
        return asked._guessed(chart, watch.check)

    def _guessed(self, chart: FramedChart, check: Callable[[], None]) -> list[int]:
        """Do the same as `guessed_labels`, but guess all visits at once."""
        began = time.thread_time()  # a thread may be made to wait
        apart = chart.apart()
        found: list[list[int]] = []
        for _, guess in attempts(replace(chart, elsewhere=chart.away), check):
            starts = [guess.loosened(chart, travels).labels(chart) for travels in range(LOOSENED)]
            maps = [(merged_near(apart, chart.links, start, check), start) for start in starts]
            ranked = sorted(maps, key=lambda pair: len(set(pair[0])))
            for _, start in ranked:
                if labels := self.labels_near(chart, apart, start, check):
                    return labels
            found.append(ranked[0][0])
            if len(found) >= len(MORE) and time.thread_time() - began > SECONDS:
                return min(found, key=lambda labels: len(set(labels)))
        raise AssertionError

    def _continued(
        self, chart: FramedChart, part: FramedChart, known: Sequence[int], check: Callable[[], None]
    ) -> list[int] | None:
        """Locate all visits by a guess of the first ones, and find labels of a map near that.

        Args:
            chart: The chart of all visits.
            part: The chart of the first visits.
            known: The label of each node of `part`.
            check: Called now and then; may raise to stop.

        Returns:
            The dstate of each node of `chart`; None if the guess does not locate most visits, or no
            map is found soon.
        """
        states = tracked(chart, dict(enumerate(states_of(part, known))))
        if states.count(-1) > LOST * len(states):
            return None
        start = [
            faced(states[visit], slot) if states[visit] >= 0 else -1 for visit, slot in chart.facing
        ]
        return self.labels_near(chart, chart.apart(), start, check)

    def labels_near(
        self,
        chart: FramedChart,
        apart: Matrix,
        start: Sequence[int],
        check: Callable[[], None] = lambda: None,
    ) -> list[int] | None:
        """Find labels near a guess, of a map that has separate paths; None if none is soon found.

        Args:
            chart: The chart of the nodes.
            apart: Which nodes are apart, nodes x nodes.
            start: The guess: a label for each node, -1 if it is unknown.
            check: Called now and then; may raise to stop.
        """
        tell = partial(self._told_if_separate, chart)
        likely = self._likely(chart, apart, start, check)
        labels = (
            merged_as_told(apart, chart.links, likely, tell, partial(self.may_fit, chart), check)
            if likely
            else None
        )
        return labels if labels and self.has_separate(chart, labels) else None

    def _told_if_separate(
        self, chart: FramedChart, labels: Sequence[int], loose: Sequence[int]
    ) -> Told | None:
        """Return the result of `told`; also None if no separate paths fit the labels.

        Labels of loose nodes need not fit.
        """
        told = self.told(chart, labels, loose)
        return told if told and self._may_have_separate(chart, labels, loose) else None

    def _likely(
        self, chart: FramedChart, apart: Matrix, start: Sequence[int], check: Callable[[], None]
    ) -> list[int] | None:
        """Replace the labels at places that allow no paths by -1; None if they are too many."""
        states = states_of(chart, kept(apart, chart.links, start))
        visits = Counter(state // 4 for state in states)
        # A place visited once cannot be wrong by itself. One visited often hardly is.
        places = sorted(visits, key=lambda place: (visits[place] > 1, -visits[place]))
        left_out: set[int] = set()

        def of_first(number: int) -> list[int]:
            some = set(places[:number]) - left_out
            return [
                label if states[visit] // 4 in some else -1
                for label, (visit, _) in zip(start, chart.facing, strict=True)
            ]

        def agrees(number: int) -> bool:
            check()
            labels = of_first(number)
            loose = [node for node, label in enumerate(labels) if label < 0]
            return self.may_fit(chart, kept(apart, chart.links, labels), loose)

        right = 0
        while not agrees(len(places)):
            if right == len(places) or len(left_out) == LEFT_OUT:
                return None
            right = first_failing(agrees, right + 1, len(places))
            left_out.add(places[right - 1])
        return of_first(len(places))


def pairwise_distinct(members: Sequence[int], pairs: Iterable[tuple[int, int]]) -> list[int]:
    """Find a large clique: a list of segments, or places, that are pairwise distinct.

    Args:
        members: All segments or places.
        pairs: The pairs that are not one. A pair of a member with itself, which means that the
            labels contradict the axioms, is ignored.
    """
    number = {member: i for i, member in enumerate(members)}
    rivals = np.zeros((len(members), len(members)), dtype=bool)
    for g, h in pairs:
        rivals[number[g], number[h]] = g != h
    return [members[i] for i in large_clique(rivals)]


def _apart(
    chart: FramedChart, labels: Sequence[int], elsewhere: Iterable[tuple[int, int]]
) -> Matrix:
    """Find the pairs of nodes that are at different places, as a matrix, nodes x nodes.

    Two visits are at different places if some dstate of one is elsewhere than some dstate of the
    other.

    Args:
        chart: The chart of the nodes.
        labels: The dstate of each node.
        elsewhere: Pairs of dstates that are at different places.
    """
    pairs = np.array(list(elsewhere), dtype=int).reshape(-1, 2)
    different = np.zeros((max(labels) + 1,) * 2, dtype=bool)
    different[pairs[:, 0], pairs[:, 1]] = different[pairs[:, 1], pairs[:, 0]] = True
    # The visits are in order, as nodes are numbered by the first step at them.
    visits = np.array([visit for visit, _ in chart.facing])
    starts = np.flatnonzero(np.diff(visits, prepend=-1))
    rows = np.logical_or.reduceat(different[list(labels)], starts, axis=0)
    apart = np.logical_or.reduceat(rows[:, list(labels)], starts, axis=1)
    nodes: Matrix = apart[np.ix_(visits, visits)]
    return nodes
