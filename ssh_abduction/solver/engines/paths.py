"""Questions to paths_framed.lp: what order and sides imply for dstates, and mending of guesses.

This serves the engine with frames. Questions that need a choice of places and paths are in
`engines/framed_paths.py`, under the limits of the engine. The questions here need hardly any
choice: some conflicts are enough as their limit.

*A guess.* Visits are annealed (`guesses/annealing.py`). If the guess cannot be right, its places
become free, and their visits are merged by evidence (`guesses/merging.py`). Meanwhile
paths_framed.lp says which visits cannot be one, which have to be, and which merge leads to no
paths. So a guess becomes a map.

*Taken back.* If no paths fit the merged labels, bisection finds the first wrong merge. The two
classes that it merged stay separate from then on. If the guess itself has no paths, its places are
added in order: places visited once first, then places visited most. A place that leads to no paths
is left out of the guess; this is done for a few places at most. If a guess leads to no map, another
one follows, with more spare names for places: places that are merged for lack of names do not
separate later.

*Separate paths.* To see whether dstates have any paths, places and segments are not merged unless
they have to be. That takes a small part of the time that it takes to ground all ways to merge
them.

*Pinned.* For the fewest paths, pairwise distinct segments are paths of their own. The other
segments choose among these first.
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

# So clasp lists the answers that are minimal in their shown atoms.
SMALLEST = ("--heuristic=Domain", "--dom-mod=5,16", "--enum-mode=domRec")
# If more than twice as many pairs of visits may be one, guess the beginning with this many pairs
# first: annealing takes time for each pair.
FIRST_PAIRS = 200_000
# Continue a guess at the beginning if it leaves at most this share of the visits open. Otherwise it
# helps little.
LOST = 0.05
# After this many conflicts, stop looking for separate paths: this is asked thousands of times, and
# mostly decided without a conflict.
TRYING = 500
# Leave at most this many places out of a guess so that the others have paths. If more are wrong,
# make a new guess.
LEFT_OUT = 3
# Clasp prepares for about these multiples of the time and the memory that grounding took. It cannot
# be stopped meanwhile.
PREPARING = (1.6, 2.1)
# If a guess cannot be right, the places less than this many travels away also become free: a wrong
# place mostly has a wrong neighbour.
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
        """Questions about a trace.

        Args:
            trace: The trace.
            theory: The settled theory.
            pinned: Whether pairwise distinct segments are named as paths beforehand.
            check: Called now and then while clingo grounds; it may raise. It is not sent to
                another process, which has its own.
            forbidden: Sets of equalities of steps that contradict evidence together.
        """
        self._trace = trace
        self._theory = theory
        self._pinned = pinned
        self._forbidden = forbidden
        self._check = check

    def __reduce__(self) -> tuple[Callable[..., Paths], tuple[Trace, Theory]]:
        return partial(Paths, pinned=self._pinned, forbidden=self._forbidden), (
            self._trace,
            self._theory,
        )

    def _under(self, check: Callable[[], None]) -> Paths:
        """The same questions under these limits."""
        return Paths(
            self._trace, self._theory, pinned=self._pinned, check=check, forbidden=self._forbidden
        )

    def control(self, chart: FramedChart, options: Sequence[str] = ()) -> Control:
        """A control with these axioms and the facts of a chart; nothing is grounded yet."""
        control = Control(options, self._check, PREPARING)
        control.load_encodings("paths_framed")
        control.add(
            "base",
            [],
            paths_lp.paths_framed_facts(self._trace, self._theory, chart, self._forbidden),
        )
        return control

    def contrary(self, chart: FramedChart, labels: Sequence[int]) -> clingo.Control:
        """A control that says which single paths these labels contradict."""
        control = self.control(chart)
        control.add("base", [], paths_lp.settled_labels(enumerate(labels)))
        control.ground([("base", []), ("again", []), ("contrary", [])])
        return control

    def clashing(self, chart: FramedChart, labels: Sequence[int]) -> clingo.Control:
        """A control whose answers are minimal sets of nodes whose labels no paths fit.

        It finds only sets that show without a choice of paths.
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
        """A control for the paths that fit labels.

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
        """A control for what holds in each map in which the nodes are at these dstates.

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
        """Which nodes are apart, and which are one, if all labels but the loose ones hold.

        None if these labels cannot hold.
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
        """Whether labels, except the loose ones, may have separate paths."""
        control = self.control(chart)
        control.add("base", [], paths_lp.settled_labels(enumerate(labels)))
        control.ground([("base", [])])
        return not paths_lp.is_violated(control) and self._may_have_separate(chart, labels, loose)

    def has_separate(
        self, chart: FramedChart, labels: Sequence[int], nodes: Iterable[int] | None = None
    ) -> bool | None:
        """Whether labels have separate paths; None if this is not soon known.

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
        return (
            self.has_separate(chart, labels, set(range(len(labels))).difference(loose)) is not False
        )

    def guessed_labels(self, chart: FramedChart, watch: Watch) -> list[int]:
        """Guess labels of a map of the causal axioms, if possible one that has separate paths.

        If no such map is soon found, the labels are those of a map of few dstates. In a long trace
        the labels of the first visits are guessed, and followed along the rest. If that leads to no
        map, twice as many visits are guessed, and so on.
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
        """The same, for visits that are guessed at once."""
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
        """Labels of all visits near those of a beginning, if these locate most visits."""
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
            check: Called now and then; it may raise.
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
        """As `told`; also None if the labels that are not loose have no separate paths."""
        told = self.told(chart, labels, loose)
        return told if told and self._may_have_separate(chart, labels, loose) else None

    def _likely(
        self, chart: FramedChart, apart: Matrix, start: Sequence[int], check: Callable[[], None]
    ) -> list[int] | None:
        """The guess, with -1 at places that leave it no paths; None if they are many."""
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
        pairs: The pairs that are not one. A member that is paired with itself contradicts the
            axioms. clingo will find that out.
    """
    number = {member: i for i, member in enumerate(members)}
    rivals = np.zeros((len(members), len(members)), dtype=bool)
    for g, h in pairs:
        rivals[number[g], number[h]] = g != h
    return [members[i] for i in large_clique(rivals)]


def _apart(
    chart: FramedChart, labels: Sequence[int], elsewhere: Iterable[tuple[int, int]]
) -> Matrix:
    """Which nodes have visits with labels at different places: nodes x nodes.

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
