"""Which visits are one place, by annealing: a guess, close to the truth where the robot was at most places often, and without a proof.

>>> from ssh_abduction import Theory, Trace
>>> from ssh_abduction.guesses.annealing import annealed
>>> from ssh_abduction.steps.chart import Chart
>>> from ssh_abduction.steps.log import Log
>>> views, stars = ["wall", "hall"] * 3, [[0, 0, 1, 0], [1, 0, 0, 0]] * 3
>>> trace = Trace.from_steps(views, ["around", "travel", "around", "travel", "around"], stars=stars)
>>> guess = annealed(Chart.framed(trace, Log(trace, Theory(star="frame"))))
>>> guess.sure.tolist()
[True, True, True]

A map is a hidden Markov model. Its states are the ways that a robot can stand at a place, and an action done there leads to one state:
of each row of the matrix of transitions one entry is 1. To begin with rows are uncertain (a Dirichlet prior of small weight), and count
for little; as the temperature falls they count more. A sweep draws the states of stretches of visits anew, given the rows that
the last draw counts, and the visits before and after the stretch: forward filtering, backward sampling (Scott 2002, "Bayesian methods
for hidden Markov models"). Stars, and which visits are apart from pinned ones, rule states out from the start. That a travel can be
made back is not an axiom, but counts as if it had been seen.

Names of places are as in `engines/causal.py`: visits that are pairwise apart are places of their own, and each kind of place has spare
names. There have to be many: places that fall together where names are short do not come apart later.

A causal trace of other actions than turns and travels is annealed in the same way: each step is a visit, to a place at which the robot stands in one way.
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

from ssh_abduction.steps.apart import clique
from ssh_abduction.steps.chart import Chart, FramedChart, numbered

SPARES = 6  # spare names for places of a kind, and more where names would have more than so many
VISITS = 12  # visits each
MORE = 1, 2, 4  # times as many spare names in attempts that follow each other: the fewer visits, the more it takes
WEIGHT = 0.002  # of the prior: for each of so many states
STATES = 60  # that an action may lead to
# An attempt ends where all travels lead where most such travels do. To what power probabilities are taken in the first of so many sweeps:
ANNEALED = ((0.5, 1500),)
# The same, and how many visits each name has, where a rough guess will do: one of so many travels may lead elsewhere.
FEW = 200
ROUGH, ROUGH_VISITS = ((0.6, 300), *10 * ((0.75, 150),)), 40
# And where each step is a visit; the last again and again, until whoever asks is content.
STEPS = (0.75, 1500), (0.75, 500)
ENTRIES = 60_000_000  # of the table of transitions, that are looked up for all steps in one go: 12 bytes each
TABLE = 2_000_000  # of the table of transitions itself, states x actions x states, which is made anew for each sweep: some 20 bytes each
SECONDS = 10.0  # after which there is no other attempt, where each number of names was tried
COLD = 0.95  # to what power in the last of them
LAST, QUENCHED = 50, 4.0  # sweeps at the end, so that little is left to chance, and to what power then
STRETCH = 20  # visits that are drawn in one go
LIKELY = 16  # states that a visit is drawn from: likely ones, chosen anew
ROUND = 50  # after so many sweeps

States = NDArray[np.int_]
_Kind = TypeVar("_Kind")


@dataclass(frozen=True)
class Guess:
    """What annealing came to.

    states  of each visit 4 times the number of a place, and the slot of the place that slot 0 of the visit is
    sure    of each visit, whether the travels to it and from it lead where most such travels do
    """

    states: States
    sure: NDArray[np.bool_]

    def labels(self, chart: FramedChart) -> list[int]:
        """A number for the dstate of each node of the chart; -1 where the guess is not sure."""
        states, sure = self.states.tolist(), self.sure.tolist()
        return [states[visit] - states[visit] % 4 + (states[visit] + slot) % 4 if sure[visit] else -1 for visit, slot in chart.facing]

    def loosened(self, chart: FramedChart, travels: int) -> Guess:
        """The guess, not sure of visits to places at which the same travel leads to several, to those it leads to, or so many travels further."""
        states = self.states.tolist()
        leads: dict[tuple[int, int, int], set[int]] = {}
        for visit, (slot, action) in chart.leaves.items():
            here = states[visit]
            leads.setdefault((here // 4, (here + slot) % 4, action), set()).add(states[visit + 1])
        loose = {place for (here, *_), there in leads.items() if len(there) > 1 for place in (here, *(state // 4 for state in there))}
        joined = [(here // 4, there // 4) for here, there in pairwise(states)]
        for _ in range(travels):
            loose |= {place for pair in joined if loose.intersection(pair) for place in pair}
        return Guess(self.states, self.sure & ~np.isin(self.states // 4, list(loose)))


def annealed(chart: FramedChart, check: Callable[[], None] = lambda: None) -> Guess:
    """A rough guess at the states of all visits. `check` is called now and then, and may raise."""
    found: dict[int, Guess] = {}
    began = time.perf_counter()
    for failed, guess in attempts(chart, check, rough=True):
        found.setdefault(failed, guess)
        if failed <= len(chart.travels) // FEW or time.perf_counter() - began > SECONDS:
            return found[min(found)]
    raise AssertionError


def attempts(chart: FramedChart, check: Callable[[], None] = lambda: None, *, rough: bool = False) -> Iterator[tuple[int, Guess]]:
    """Guesses without end, each with how many travels do not lead where most such travels do.

    check  called now and then, and may raise
    rough  be content with fewer names, as does where places were visited often, and with fewer sweeps
    """
    leaves = list(chart.leaves.values())
    for attempt, more in enumerate(cycle(MORE), 1):
        options = _options(chart, SPARES * more, ROUGH_VISITS if rough else VISITS)
        drawn = _Drawn(options, leaves, 4, np.random.default_rng(attempt))
        for first, sweeps in ROUGH if rough else ANNEALED:
            drawn.anneal(first, sweeps, check)
            yield drawn.failed(), Guess(drawn.labels, drawn.sure())


def annealed_steps(
    chart: Chart, clique: Sequence[int], may_be: Sequence[Sequence[int]], check: Callable[[], None] = lambda: None
) -> Iterator[list[int]]:
    """Guesses at the dstates of all steps, as labels, -1 where they are not sure; ever better ones, without end. There are none where that takes too much memory.

    clique  steps that are pairwise apart
    may_be  of each step, the numbers of those of the clique that it may be one with
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
    """States of all visits, drawn again and again."""

    def __init__(self, options: States, leaves: Sequence[tuple[int, int]], ways: int, random: np.random.Generator) -> None:
        """
        options  visits x states that are possible; -1 where there are fewer
        leaves   the slot that each visit but the last ends at, and the action there
        ways     to stand at a place, each a state: one, or four, of which the last two face back where the first two face ahead
        """
        self._random = random
        self._options = options
        self._visits = np.arange(len(options))
        actions = {action: number for number, action in enumerate(dict.fromkeys(action for _, action in leaves))}
        self._actions = max(1, len(actions))
        self._slot = np.array([slot for slot, _ in leaves], dtype=int)
        self._action = np.array([actions[action] for _, action in leaves], dtype=int)
        self._ways = ways
        self._states = ways * (int(options.max()) // ways + 1)
        self._back = np.arange(self._states) ^ 2  # of each state, the one that faces the other way
        counts = (options >= 0).sum(axis=1)
        self.labels = options[self._visits, (random.random(len(counts)) * counts).astype(int)]
        self._count()

    def anneal(self, first: float, sweeps: int, check: Callable[[], None]) -> None:
        """So many sweeps, while probabilities are taken to higher powers from this one on; and a few more in the end."""
        for sweep in range(sweeps + LAST):
            check()
            power = first + (COLD - first) * sweep / sweeps if sweep < sweeps else QUENCHED
            if sweep % ROUND == 0:
                self._choose(power)
            self._sweep(power)

    def sure(self) -> NDArray[np.bool_]:
        """Of each visit, whether it was drawn last where the actions to it and from it mostly led."""
        rows = self._rows(self.labels[:-1], self._visits[:-1])
        odd = self._counts[rows, self.labels[1:]] < self._counts[rows].max(axis=1)
        sure = np.ones(len(self._visits), dtype=bool)
        sure[:-1] &= ~odd
        sure[1:] &= ~odd
        return sure

    def failed(self) -> int:
        """How many travels do not lead where most travels of the same state and action do."""
        return int((self._totals - self._counts.max(axis=1)).sum())

    def _rows(self, states: States, visits: States) -> States:
        """The number of what is done in these states, by state and action, at the end of these visits."""
        turned = (states + self._slot[visits]) % self._ways
        rows: States = (states - states % self._ways + turned) * self._actions + self._action[visits]
        return rows

    def _count(self) -> None:
        here, there = self.labels[:-1], self.labels[1:]
        rows = self._rows(here, self._visits[:-1])
        entries = rows * self._states + there
        if self._ways > 1:
            back = self._back[there] * self._actions + self._action
            entries = np.concatenate([entries, back * self._states + self._back[rows // self._actions]])
        self._counted = entries
        shape = self._states * self._actions, self._states
        self._counts = np.bincount(entries, minlength=shape[0] * shape[1]).reshape(shape).astype(np.float32)
        self._totals = self._counts.sum(axis=1)

    def _entries(self, states: States) -> States:
        """visits but the last x states x states of the next: the entry of the table of transitions. States below 0 are the last one of the table."""
        rows = self._rows(states[:-1], self._visits[:-1, None])
        rows[states[:-1] < 0] = self._states * self._actions
        there = np.where(states[1:] < 0, self._states, states[1:])
        entries: States = rows[:, :, None] * (self._states + 1) + there[:, None, :]
        return entries

    def _transitions(self, entries: States, power: float) -> NDArray[np.float32]:
        """How likely an action leads from one state to the other, for each of these entries."""
        shape = self._states * self._actions + 1, self._states + 1
        totals = self._totals + np.float32(STATES * WEIGHT)
        table = np.zeros(shape, dtype=np.float32)
        table[:-1, :-1] = np.power(np.float32(WEIGHT) / totals, np.float32(power))[:, None]
        row, column = np.divmod(self._counted, self._states)
        table[row, column] = np.power((self._counts[row, column] + np.float32(WEIGHT)) / totals[row], np.float32(power))
        return table.ravel()[entries]

    def _choose(self, power: float) -> None:
        """Choose the states that visits are drawn from: at random, the likely ones sooner, and the last one drawn for sure."""
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
        """Where stretches of visits start, and how long they are."""
        starts = np.unique(np.append(0, np.arange(first, len(self._visits), STRETCH)))
        return starts, np.diff(np.append(starts, len(self._visits)))

    def _filtered(self, states: States, likely: NDArray[np.float32], place: States, starts: States, lengths: States) -> NDArray[np.float32]:
        """visits x states: how likely a visit is in a state, given what comes before it in its stretch and the visit before that."""
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
    """The states that each visit may be in."""
    misfits = chart.misfits
    # The star of each visit in a frame whose slot r is slot 0 of the visit, and its kind: the least of them.
    turned = [[tuple(star[(slot - r) % 4] for slot in range(4)) for r in range(4)] for star in chart.stars]
    kinds = [min(stars) for stars in turned]
    pinned = clique(np.logical_and.reduce(misfits), numbered(kinds))
    spare = _spare(kinds, pinned, spares, visits_each)
    known = ~misfits[:, :, pinned].transpose(1, 2, 0).reshape(len(kinds), -1)  # visits x states of pinned places
    known[pinned] = False
    known[pinned, 4 * np.arange(len(pinned))] = True
    options: list[list[int]] = [np.flatnonzero(row).tolist() for row in known]
    for visit in set(range(len(kinds))).difference(pinned):
        options[visit] += [4 * place + r for place in spare[kinds[visit]] for r in range(4) if turned[visit][r] == kinds[visit]]
    return _padded(options)


def _step_options(chart: Chart, clique: Sequence[int], may_be: Sequence[Sequence[int]]) -> States:
    """The states that each step may be in: those of the clique, and spare ones for each view."""
    pinned = set(clique)
    spare = _spare(chart.seen, clique, SPARES, ROUGH_VISITS)
    return _padded([[*options, *(() if step in pinned else spare[chart.seen[step]])] for step, options in enumerate(may_be)])


def _spare(kinds: Sequence[_Kind], pinned: Sequence[int], spares: int, visits_each: int) -> dict[_Kind, range]:
    """Spare names for each kind of place, beyond those of the pinned visits."""
    named = Counter(kinds[visit] for visit in pinned)
    spare: dict[_Kind, range] = {}
    names = len(pinned)
    for kind, visits in Counter(kinds).items():
        spare[kind] = range(names, names + spares + max(0, visits // visits_each - named[kind]))
        names = spare[kind].stop
    return spare


def _padded(options: Sequence[Sequence[int]]) -> States:
    padded = np.full((len(options), max(map(len, options))), -1)
    for visit, states in enumerate(options):
        padded[visit, : len(states)] = states
    return padded
