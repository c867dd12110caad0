"""Guesses by annealing which visits are at one place: close to the truth where the robot was at most places often, and without a proof.

>>> from ssh_abduction import Theory, Trace
>>> from ssh_abduction.solver.guesses.annealing import annealed
>>> from ssh_abduction.solver.steps.chart import Chart
>>> from ssh_abduction.solver.steps.log import Log
>>> views, stars = ["wall", "hall"] * 3, [[0, 0, 1, 0], [1, 0, 0, 0]] * 3
>>> trace = Trace.from_steps(views, ["around", "travel", "around", "travel", "around"], stars=stars)
>>> guess = annealed(Chart.framed(trace, Log(trace, Theory(star="frame"))))
>>> guess.sure.tolist()
[True, True, True]

A map is a hidden Markov model. Its states are the ways in which a robot can stand at a place (`Placing` in the glossary), and an action done there leads to one
state, so each row of the matrix of transitions has one entry of 1. At first the rows are uncertain (a Dirichlet prior of small weight) and count for little;
as the temperature falls they count more. A sweep goes over stretches of visits and draws their states anew, given the visits before and after the stretch and
the transitions that the last draw made: forward filtering, backward sampling (Scott 2002, "Bayesian methods for hidden Markov models"). Stars, and which
visits are apart from pinned ones, rule out states from the start. That a travel can be made back is not an axiom, but each travel counts as if its way back had
been seen, too.

Places have names as dstates have in `engines/causal.py`: visits that are pairwise apart are pinned to places of their own, and each kind of place has spare
names. There have to be many spare names, as places that fall together where names are short do not come apart later.

A causal trace of other actions than turns and travels is annealed in the same way. Each step is then a visit to a place at which the robot can stand in one way
only.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, cycle, pairwise, repeat
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.solver.steps.apart import clique
from ssh_abduction.solver.steps.chart import Chart, FramedChart, numbered

# Each kind of place has this many spare names at least: with four, places of mazes fell together that are different.
SPARES = 6
# A kind of place that was visited often has more spare names, so that its names have about this many visits each.
VISITS = 12
# Successive attempts have 1, 2 and 4 times SPARES as the least number of spare names, and then 1 again: the fewer visits a place has, the more names it takes to find it.
MORE = 1, 2, 4
# The Dirichlet prior gives each state this weight as the end of an action, as if it had been seen so often. It is small, so that one visit outweighs all of it.
WEIGHT = 0.002
# For the prior, an action may lead to this many states; the true number would make rows of small and large maps count differently.
STATES = 60
# An attempt at a careful guess, as pairs: probabilities are taken to this power in the first sweep (a high temperature), and there are so many sweeps. All of
# nine guesses at mazes of 10 x 10 cells could be made maps after 1,500 sweeps; after 300 only two of them could, and after 700 six.
ANNEALED = ((0.5, 1500),)
# An attempt at a rough guess, as above: after each pair the guess is looked at, and taken if it is good enough.
ROUGH = (0.6, 300), *10 * ((0.75, 150),)
# A name has up to this many visits in a rough guess: fewer names take fewer sweeps.
ROUGH_VISITS = 40
# A rough guess is good enough if at most one of this many travels leads elsewhere than most such travels: the guess is mended afterwards anyway.
FEW = 200
# An attempt at a guess in which each step is a visit, as above; the last pair is repeated until whoever asks is content.
STEPS = (0.75, 1500), (0.75, 500)
# There is no guess at steps where looking up the transitions of all steps takes more entries than this, of 12 bytes each: 720 MB.
ENTRIES = 60_000_000
# Nor where the table of transitions (states x actions x states) is larger than this. It is made anew for each sweep, and takes some 20 bytes an entry: 40 MB.
TABLE = 2_000_000
# After this many seconds there is no other attempt, once each number of spare names in MORE was tried.
SECONDS = 10.0
# Probabilities are taken to this power in the last sweep of an attempt, just below the model's own, 1.
COLD = 0.95
# Then there are LAST sweeps more with the power QUENCHED, so that hardly anything in the result is left to chance.
LAST, QUENCHED = 50, 4.0
# A sweep draws this many consecutive visits in one go. All stretches are drawn side by side, given the visits at their ends.
STRETCH = 20
# A visit is drawn from this many states, likely ones; with 8 of them, chosen twice as often, twice as many sweeps are needed.
LIKELY = 16
# They are chosen anew after this many sweeps.
ROUND = 50

States = NDArray[np.int_]
_Kind = TypeVar("_Kind")


@dataclass(frozen=True)
class Guess:
    """A guess that annealing came to.

    states  for each visit, 4 times the number of its place plus the slot of the place that slot 0 of the visit is
    sure    for each visit, whether the travels to it and from it lead where most such travels do
    """

    states: States
    sure: NDArray[np.bool_]

    def labels(self, chart: FramedChart) -> list[int]:
        """A number for the dstate of each node of the chart; -1 where the guess is not sure."""
        states, sure = self.states.tolist(), self.sure.tolist()
        return [
            states[visit] - states[visit] % 4 + (states[visit] + slot) % 4 if sure[visit] else -1
            for visit, slot in chart.facing
        ]

    def loosened(self, chart: FramedChart, travels: int) -> Guess:
        """The same guess, sure of fewer visits: of none to a place from which the same travel leads to several places, to one of these places, or to a
        place that is at most so many travels away from them.
        """
        states = self.states.tolist()
        leads: dict[tuple[int, int, int], set[int]] = {}
        for visit, (slot, action) in chart.leaves.items():
            here = states[visit]
            leads.setdefault((here // 4, (here + slot) % 4, action), set()).add(states[visit + 1])
        loose = {
            place
            for (here, *_), there in leads.items()
            if len(there) > 1
            for place in (here, *(state // 4 for state in there))
        }
        joined = [(here // 4, there // 4) for here, there in pairwise(states)]
        for _ in range(travels):
            loose |= {place for pair in joined if loose.intersection(pair) for place in pair}
        return Guess(self.states, self.sure & ~np.isin(self.states // 4, list(loose)))


def annealed(chart: FramedChart, check: Callable[[], None] = lambda: None) -> Guess:
    """A rough guess at the states of all visits: the first that is good enough, or the best after SECONDS.

    check  called now and then, and may raise
    """
    found: dict[int, Guess] = {}
    began = time.perf_counter()
    for failed, guess in attempts(chart, check, rough=True):
        found.setdefault(failed, guess)
        if failed <= len(chart.travels) // FEW or time.perf_counter() - began > SECONDS:
            return found[min(found)]
    raise AssertionError


def attempts(
    chart: FramedChart, check: Callable[[], None] = lambda: None, *, rough: bool = False
) -> Iterator[tuple[int, Guess]]:
    """Guesses without end, each with how many travels do not lead where most such travels do.

    check  called now and then, and may raise
    rough  use fewer names and fewer sweeps, which will do where places were visited often
    """
    leaves = list(chart.leaves.values())
    for attempt, more in enumerate(cycle(MORE), 1):
        options = _options(chart, SPARES * more, ROUGH_VISITS if rough else VISITS)
        drawn = _Drawn(options, leaves, 4, np.random.default_rng(attempt))
        for first, sweeps in ROUGH if rough else ANNEALED:
            drawn.anneal(first, sweeps, check)
            yield drawn.failed(), Guess(drawn.labels, drawn.sure())


def annealed_steps(
    chart: Chart,
    clique: Sequence[int],
    may_be: Sequence[Sequence[int]],
    check: Callable[[], None] = lambda: None,
) -> Iterator[list[int]]:
    """Guesses at the dstates of all steps, as labels, -1 where they are not sure. They become better, and there is no end to them; where they would take too much
    memory, there are none.

    clique  steps that are pairwise apart
    may_be  for each step, the numbers of the steps of the clique that it may be one dstate with
    check   called now and then, and may raise
    """
    options = _step_options(chart, clique, may_be)
    leaves = [(0, action) for _, action, _ in chart.links]
    actions = len(set(leaves))
    if options.size * options.shape[1] > ENTRIES or (int(options.max()) + 1) ** 2 * actions > TABLE:
        return
    drawn = _Drawn(options, leaves, 1, np.random.default_rng(0))
    for first, sweeps in chain(STEPS, repeat(STEPS[-1])):
        drawn.anneal(first, sweeps, check)
        yield np.where(drawn.sure(), drawn.labels, -1).tolist()


class _Drawn:
    """The states of all visits, which are drawn again and again."""

    def __init__(
        self,
        options: States,
        leaves: Sequence[tuple[int, int]],
        ways: int,
        random: np.random.Generator,
    ) -> None:
        """
        options  visits x the states that are possible for each; padded with -1
        leaves   the slot that each visit but the last ends at, and the action there
        ways     how many states a place has, as ways to stand there: one, or four, of which states 2 and 3 face the other way than 0 and 1
        """
        self._random = random
        self._options = options
        self._visits = np.arange(len(options))
        actions = {
            action: number
            for number, action in enumerate(dict.fromkeys(action for _, action in leaves))
        }
        self._actions = max(1, len(actions))
        self._slot = np.array([slot for slot, _ in leaves], dtype=int)
        self._action = np.array([actions[action] for _, action in leaves], dtype=int)
        self._ways = ways
        self._states = ways * (int(options.max()) // ways + 1)
        self._back = np.arange(self._states) ^ 2  # for each state, the one that faces the other way
        counts = (options >= 0).sum(axis=1)
        self.labels = options[self._visits, (random.random(len(counts)) * counts).astype(int)]
        self._count()

    def anneal(self, first: float, sweeps: int, check: Callable[[], None]) -> None:
        """Do so many sweeps, while the power that probabilities are taken to rises from `first` to COLD; and then LAST sweeps more with the power QUENCHED."""
        for sweep in range(sweeps + LAST):
            check()
            power = first + (COLD - first) * sweep / sweeps if sweep < sweeps else QUENCHED
            if sweep % ROUND == 0:
                self._choose(power)
            self._sweep(power)

    def sure(self) -> NDArray[np.bool_]:
        """For each visit, whether in the last draw the actions to it and from it lead where such actions mostly lead."""
        rows = self._rows(self.labels[:-1], self._visits[:-1])
        odd = self._counts[rows, self.labels[1:]] < self._counts[rows].max(axis=1)
        sure = np.ones(len(self._visits), dtype=bool)
        sure[:-1] &= ~odd
        sure[1:] &= ~odd
        return sure

    def failed(self) -> int:
        """How many travels do not lead where most travels with the same state and action lead."""
        return int((self._totals - self._counts.max(axis=1)).sum())

    def _rows(self, states: States, visits: States) -> States:
        """The rows of the table of transitions, numbered by state and action, for visits that are in these states and end as these visits end."""
        turned = (states + self._slot[visits]) % self._ways
        rows: States = (states - states % self._ways + turned) * self._actions + self._action[
            visits
        ]
        return rows

    def _count(self) -> None:
        """Count the transitions of the last draw, and the ways back of its travels."""
        here, there = self.labels[:-1], self.labels[1:]
        rows = self._rows(here, self._visits[:-1])
        entries = rows * self._states + there
        if self._ways > 1:
            back = self._back[there] * self._actions + self._action
            entries = np.concatenate(
                [entries, back * self._states + self._back[rows // self._actions]]
            )
        self._counted = entries
        shape = self._states * self._actions, self._states
        self._counts = (
            np.bincount(entries, minlength=shape[0] * shape[1]).reshape(shape).astype(np.float32)
        )
        self._totals = self._counts.sum(axis=1)

    def _entries(self, states: States) -> States:
        """The entries of the table of transitions, for all visits but the last x states of a visit x states of the next one. The padding, -1, has the last
        row and the last column of the table, where nothing is likely.
        """
        rows = self._rows(states[:-1], self._visits[:-1, None])
        rows[states[:-1] < 0] = self._states * self._actions
        there = np.where(states[1:] < 0, self._states, states[1:])
        entries: States = rows[:, :, None] * (self._states + 1) + there[:, None, :]
        return entries

    def _transitions(self, entries: States, power: float) -> NDArray[np.float32]:
        """For each of these entries, how likely its action leads from its first state to the other, to this power."""
        shape = self._states * self._actions + 1, self._states + 1
        totals = self._totals + np.float32(STATES * WEIGHT)
        table = np.zeros(shape, dtype=np.float32)
        table[:-1, :-1] = np.power(np.float32(WEIGHT) / totals, np.float32(power))[:, None]
        row, column = np.divmod(self._counted, self._states)
        table[row, column] = np.power(
            (self._counts[row, column] + np.float32(WEIGHT)) / totals[row], np.float32(power)
        )
        return table.ravel()[entries]

    def _choose(self, power: float) -> None:
        """Choose the LIKELY states that each visit is drawn from until the next choice: at random, likely ones sooner, and always the one drawn last."""
        likely = self._transitions(self._entries(self._options), power)
        place = (self._options == self.labels[:, None]).argmax(axis=1)
        starts, lengths = self._stretches(0)
        ahead = self._filtered(self._options, likely, place, starts, lengths)
        behind = np.ones_like(ahead)
        for i in range(int(lengths.max()) - 1, -1, -1):
            visits = starts[lengths > i] + i
            visits = visits[visits < self._visits[-1]]
            last = lengths[lengths > i][: len(visits)] == i + 1
            within, ends = visits[~last], visits[last]
            behind[within] = (likely[within] @ behind[within + 1, :, None])[:, :, 0]
            behind[ends] = likely[ends, :, place[ends + 1]]
            behind[visits] /= behind[visits].max(axis=1, keepdims=True)
        rank = np.log(np.maximum(ahead * behind, 1e-30)) + self._random.gumbel(size=ahead.shape)
        rank[self._options < 0] = -np.inf
        rank[self._visits, place] = np.inf
        few = min(LIKELY, rank.shape[1])
        chosen = np.argpartition(-rank, few - 1, axis=1)[:, :few]
        self._chosen = np.take_along_axis(self._options, chosen, axis=1)
        self._place = (self._chosen == self.labels[:, None]).argmax(axis=1)
        self._chosen_entries = self._entries(self._chosen)

    def _sweep(self, power: float) -> None:
        """Draw the states of all visits, stretch by stretch."""
        likely = self._transitions(self._chosen_entries, power)
        starts, lengths = self._stretches(int(self._random.integers(STRETCH)))
        ahead = self._filtered(self._chosen, likely, self._place, starts, lengths)
        place = self._place.copy()
        for i in range(int(lengths.max()) - 1, -1, -1):
            visits = starts[lengths > i] + i
            weights = ahead[visits]
            before = visits < self._visits[-1]
            goes_on = visits[before]
            weights[before] *= likely[goes_on, :, place[goes_on + 1]]
            sums = weights.cumsum(axis=1)
            drawn = (sums < self._random.random((len(visits), 1)) * sums[:, -1:]).sum(axis=1)
            place[visits] = np.minimum(drawn, sums.shape[1] - 1)
        self._place = place
        self.labels = self._chosen[self._visits, place]
        self._count()

    def _stretches(self, first: int) -> tuple[States, States]:
        """Where the stretches of visits start, if the second one starts at visit `first`, and how long they are."""
        starts = np.unique(np.append(0, np.arange(first, len(self._visits), STRETCH)))
        return starts, np.diff(np.append(starts, len(self._visits)))

    def _filtered(
        self,
        states: States,
        likely: NDArray[np.float32],
        place: States,
        starts: States,
        lengths: States,
    ) -> NDArray[np.float32]:
        """Visits x states: how likely a visit is in a state, given the visits before it in its stretch, and the last draw of the visit before the stretch."""
        ahead = (states >= 0).astype(np.float32)
        for i in range(int(lengths.max())):
            visits = starts[lengths > i] + i
            if i:
                ahead[visits] = (ahead[visits - 1, None, :] @ likely[visits - 1])[:, 0]
            else:
                ahead[visits[1:]] = likely[visits[1:] - 1, place[visits[1:] - 1]]
            ahead[visits] /= ahead[visits].sum(axis=1, keepdims=True)
        return ahead


def _options(chart: FramedChart, spares: int, visits_each: int) -> States:
    """The states that each visit may be in: visits x states, padded with -1."""
    misfits = chart.misfits
    # The star of each visit in a frame whose slot r is slot 0 of the visit; and its kind, which is the least of these four stars.
    turned = [
        [tuple(star[(slot - r) % 4] for slot in range(4)) for r in range(4)] for star in chart.stars
    ]
    kinds = [min(stars) for stars in turned]
    pinned = clique(np.logical_and.reduce(misfits), numbered(kinds))
    spare = _spare(kinds, pinned, spares, visits_each)
    known = ~misfits[:, :, pinned].transpose(1, 2, 0).reshape(
        len(kinds), -1
    )  # visits x states of pinned places
    known[pinned] = False
    known[pinned, 4 * np.arange(len(pinned))] = True
    options: list[list[int]] = [np.flatnonzero(row).tolist() for row in known]
    for visit in set(range(len(kinds))).difference(pinned):
        options[visit] += [
            4 * place + r
            for place in spare[kinds[visit]]
            for r in range(4)
            if turned[visit][r] == kinds[visit]
        ]
    return _padded(options)


def _step_options(chart: Chart, clique: Sequence[int], may_be: Sequence[Sequence[int]]) -> States:
    """The states that each step may be in: those of the clique, and the spare ones of its view. Steps x states, padded with -1."""
    pinned = set(clique)
    spare = _spare(chart.seen, clique, SPARES, ROUGH_VISITS)
    return _padded(
        [
            [*options, *(() if step in pinned else spare[chart.seen[step]])]
            for step, options in enumerate(may_be)
        ]
    )


def _spare(
    kinds: Sequence[_Kind], pinned: Sequence[int], spares: int, visits_each: int
) -> dict[_Kind, range]:
    """Spare names for each kind of place. The first names, which come before them, are those of the pinned visits."""
    named = Counter(kinds[visit] for visit in pinned)
    spare: dict[_Kind, range] = {}
    names = len(pinned)
    for kind, visits in Counter(kinds).items():
        spare[kind] = range(names, names + spares + max(0, visits // visits_each - named[kind]))
        names = spare[kind].stop
    return spare


def _padded(options: Sequence[Sequence[int]]) -> States:
    """Rows of different length as an array, padded with -1."""
    padded = np.full((len(options), max(map(len, options))), -1)
    for visit, states in enumerate(options):
        padded[visit, : len(states)] = states
    return padded
