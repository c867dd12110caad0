"""Draw the states of visits by annealing: a blocked Gibbs sampler of a hidden Markov model.

A state is a number for the placing of a visit: 4 times its place, plus the slot of the place that
is slot 0 of the visit. `guesses/annealing.py` says which states are possible for each visit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.groups import numbered
from ssh_abduction.runtime.clock import look_at_clock

# The weight of each state in the Dirichlet prior, in visits. One visit outweighs the whole prior.
WEIGHT = 0.002
# The number of states in the prior. The true number would give small and large maps different
# weights.
STATES = 60
# Probabilities are raised to this power in the last sweep of a stage. The model itself has power 1.
COLD = 0.95
# Then come LAST sweeps with the power QUENCHED. They make the result nearly deterministic.
LAST, QUENCHED = 50, 4.0
# The number of visits in a stretch. They are drawn together. All stretches are drawn at the same
# time, given the visits at their ends.
STRETCH = 20
# Each visit is drawn from this many likely states. With 8 states that were chosen twice as often,
# twice as many sweeps were needed.
LIKELY = 16
# The likely states are chosen again after this many sweeps.
ROUND = 50

States: TypeAlias = NDArray[np.int_]


class _Transitions:
    """Counts how often actions led from state to state in the last draw.

    The table of transitions has a row for each state and action, and a column for each state.

    Attributes:
        counts: The table: how often the action of the row led to the state of the column.
    """

    def __init__(self, leaves: Sequence[tuple[int, int]], states: int, labels: States) -> None:
        """Count the transitions of a draw, in which each visit has a state.

        `leaves` has the slot and action at which each visit but the last ends.
        """
        self._slot = np.array([slot for slot, _ in leaves], dtype=int)
        self._action = np.array(numbered(action for _, action in leaves), dtype=int)
        self._actions = 1 + int(self._action.max(initial=0))
        self._states = states
        self._back = np.arange(states) ^ 2  # for each state, the one that faces the other way
        self._visits = np.arange(len(leaves))
        self._counted, self.counts, self.totals = self._tallied(labels)

    def count(self, labels: States) -> None:
        """Replace the counts by those of a new draw."""
        self._counted, self.counts, self.totals = self._tallied(labels)

    def rows(self, states: States, visits: States) -> States:
        """Return the row of the table for the action that ends each visit, given its state."""
        turned = states - states % 4 + (states + self._slot[visits]) % 4
        rows: States = turned * self._actions + self._action[visits]
        return rows

    def entries(self, states: States) -> States:
        """Find where the table has the transitions from each visit to the next one.

        `states` has the possible states of each visit, an array of visits x states, padded with -1.
        Padding gets an extra last row or column of the table, where all probabilities are 0.
        Returns an index array into `likely`, of shape (visits - 1, states, states of the next
        visit).
        """
        rows = self.rows(states[:-1], self._visits[:, None])
        rows[states[:-1] < 0] = self._states * self._actions
        there = np.where(states[1:] < 0, self._states, states[1:])
        entries: States = rows[:, :, None] * (self._states + 1) + there[:, None, :]
        return entries

    def likely(self, entries: States, power: float) -> NDArray[np.float32]:
        """Compute the probabilities, to a power, of `entries` from the counts and the prior."""
        shape = self._states * self._actions + 1, self._states + 1
        totals = self.totals + np.float32(STATES * WEIGHT)
        table = np.zeros(shape, dtype=np.float32)
        table[:-1, :-1] = np.power(np.float32(WEIGHT) / totals, np.float32(power))[:, None]
        row, column = np.divmod(self._counted, self._states)
        table[row, column] = np.power(
            (self.counts[row, column] + np.float32(WEIGHT)) / totals[row], np.float32(power)
        )
        return table.ravel()[entries]

    def _tallied(self, labels: States) -> tuple[States, NDArray[np.float32], NDArray[np.float32]]:
        """Count the transitions of a draw, forwards and backwards.

        Returns each transition as an index into the flat table, the table, and the sums of its
        rows.
        """
        here, there = labels[:-1], labels[1:]
        rows = self.rows(here, self._visits)
        entries = rows * self._states + there
        back = self._back[there] * self._actions + self._action
        entries = np.concatenate([entries, back * self._states + self._back[rows // self._actions]])
        shape = self._states * self._actions, self._states
        counts = np.bincount(entries, minlength=shape[0] * shape[1])
        table = counts.reshape(shape).astype(np.float32)
        return entries, table, table.sum(axis=1)


@dataclass
class _DrawnStates:
    """The states that visits are drawn from during a round of sweeps.

    Attributes:
        states: The states that each visit is drawn from: visits x states, padded with -1.
        entries: The entries of the table of transitions for these states (`_Transitions.entries`).
        drawn: For each visit, the column of `states` with its last drawn state.
    """

    states: States
    entries: States
    drawn: States


class Sampler:
    """Draws the states of all visits again and again, given each other.

    Attributes:
        labels: The last drawn state of each visit.
    """

    def __init__(
        self, options: States, leaves: Sequence[tuple[int, int]], random: np.random.Generator
    ) -> None:
        """Draw a state (a number for a placing) at random for each visit.

        `options` has the possible states of each visit in a row, padded with -1. `leaves` is as for
        `_Transitions`.
        """
        self._random = random
        self._options = options
        self._visits = np.arange(len(options))
        counts = (options >= 0).sum(axis=1)
        self.labels = options[self._visits, (random.random(len(counts)) * counts).astype(int)]
        states = 4 * (int(options.max()) // 4 + 1)
        self._transitions = _Transitions(leaves, states, self.labels)

    def anneal(self, first: float, sweeps: int) -> None:
        """Draw the states again and again, from probabilities raised to a rising power.

        The power rises from `first` to COLD in this many sweeps. LAST more sweeps have the power
        QUENCHED.
        """
        for sweep in range(sweeps + LAST):
            look_at_clock()
            power = first + (COLD - first) * sweep / sweeps if sweep < sweeps else QUENCHED
            if sweep % ROUND == 0:
                choice = self._choose(power)
            self._sweep(choice, power)

    def sure(self) -> NDArray[np.bool_]:
        """For each visit, return whether the actions to and from it lead where they mostly lead."""
        counts = self._transitions.counts
        rows = self._transitions.rows(self.labels[:-1], self._visits[:-1])
        odd = counts[rows, self.labels[1:]] < counts[rows].max(axis=1)
        sure = np.ones(len(self._visits), dtype=bool)
        sure[:-1] &= ~odd
        sure[1:] &= ~odd
        return sure

    def failed(self) -> int:
        """Count the travels that lead elsewhere than most with the same state and action."""
        return int((self._transitions.totals - self._transitions.counts.max(axis=1)).sum())

    def _choose(self, power: float) -> _DrawnStates:
        """Choose LIKELY states for each visit at random, weighted by probability."""
        likely = self._transitions.likely(self._transitions.entries(self._options), power)
        drawn = (self._options == self.labels[:, None]).argmax(axis=1)
        starts, lengths = self._stretches(0)
        ahead = self._filtered(self._options, likely, drawn, starts, lengths)
        behind = np.ones_like(ahead)
        # Backward messages of all stretches side by side, from their last visits to their first.
        for i in range(int(lengths.max()) - 1, -1, -1):
            visits = starts[lengths > i] + i
            visits = visits[visits < self._visits[-1]]
            last = lengths[lengths > i][: len(visits)] == i + 1
            within, ends = visits[~last], visits[last]
            behind[within] = (likely[within] @ behind[within + 1, :, None])[:, :, 0]
            behind[ends] = likely[ends, :, drawn[ends + 1]]
            behind[visits] /= behind[visits].max(axis=1, keepdims=True)
        # The Gumbel trick samples states without replacement by their probabilities.
        rank = np.log(np.maximum(ahead * behind, 1e-30)) + self._random.gumbel(size=ahead.shape)
        rank[self._options < 0] = -np.inf
        rank[self._visits, drawn] = np.inf
        few = min(LIKELY, rank.shape[1])
        chosen = np.argpartition(-rank, few - 1, axis=1)[:, :few]
        states = np.take_along_axis(self._options, chosen, axis=1)
        drawn = (states == self.labels[:, None]).argmax(axis=1)
        return _DrawnStates(states, self._transitions.entries(states), drawn)

    def _sweep(self, choice: _DrawnStates, power: float) -> None:
        """Draw all states from a choice, and update its field `drawn`. Do all stretches at once."""
        likely = self._transitions.likely(choice.entries, power)
        starts, lengths = self._stretches(int(self._random.integers(STRETCH)))
        ahead = self._filtered(choice.states, likely, choice.drawn, starts, lengths)
        place = choice.drawn.copy()
        # Backward sampling: draw each visit given the visit after it.
        for i in range(int(lengths.max()) - 1, -1, -1):
            visits = starts[lengths > i] + i
            weights = ahead[visits]
            before = visits < self._visits[-1]
            goes_on = visits[before]
            weights[before] *= likely[goes_on, :, place[goes_on + 1]]
            sums = weights.cumsum(axis=1)
            drawn = (sums < self._random.random((len(visits), 1)) * sums[:, -1:]).sum(axis=1)
            place[visits] = np.minimum(drawn, sums.shape[1] - 1)
        choice.drawn = place
        self.labels = choice.states[self._visits, place]
        self._transitions.count(self.labels)

    def _stretches(self, first: int) -> tuple[States, States]:
        """Divide the visits into stretches of STRETCH visits. Return their starts and lengths."""
        starts = np.unique(np.append(0, np.arange(first, len(self._visits), STRETCH)))
        return starts, np.diff(np.append(starts, len(self._visits)))

    def _filtered(
        self,
        states: States,
        likely: NDArray[np.float32],
        drawn: States,
        starts: States,
        lengths: States,
    ) -> NDArray[np.float32]:
        """Compute the forward messages: the probability of each state of each visit.

        These probabilities are conditional on the earlier visits of the stretch, and on the last
        draw of the visit before the stretch. The states have the shape visits x states, padded with
        -1, and so have the messages, whose rows add up to 1. `likely` has the probabilities of
        transitions between these states. `drawn` has, for each visit, the column of its last drawn
        state. `starts` has the first visit of each stretch, and `lengths` its number of visits.
        """
        ahead = (states >= 0).astype(np.float32)
        for i in range(int(lengths.max())):
            visits = starts[lengths > i] + i
            if i:
                ahead[visits] = (ahead[visits - 1, None, :] @ likely[visits - 1])[:, 0]
            else:
                ahead[visits[1:]] = likely[visits[1:] - 1, drawn[visits[1:] - 1]]
            ahead[visits] /= ahead[visits].sum(axis=1, keepdims=True)
        return ahead
