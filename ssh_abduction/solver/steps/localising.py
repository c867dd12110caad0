"""Localise all visits of a trace in a map that was made from some of them.

A *visit* is the steps between two travels, in a chart for places with frames. For a long trace in a
small world, clingo does not need every visit: a map of some visits locates the others. This is
Markov localisation in which a belief is the set of possible *states* of a visit. A state is a
placing as a number: the place, and the slot there that is slot 0 of the visit. The map says where
the action of a visit leads from each possible state. That gives the possible states of the next
visit. A visit is *missed* in each of these cases: none of its possible states fits what it shows,
the map has no link for the action that leads to it, or it faces a slot that no visit of the map
faced. Then the map needs this visit, and enough visits before it to localise it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.groups import gathered
from ssh_abduction.solver.steps.chart import FramedChart

# After finding this many stretches of missed visits, let clingo solve again with them. Its next map
# may explain later stretches, and each further visit makes the problem larger.
STRETCHES = 10

# The state of a visit: 4 times the number of its place, plus the slot of the place that is slot 0
# of the visit. Places are numbered from 0 without gaps.
State: TypeAlias = int


@dataclass(frozen=True)
class Located:
    """The result of localising all visits.

    Attributes:
        states: The state of each visit; empty if the map does not locate all of them.
        missed: The visits to add to the map so that it locates more visits; empty if it locates
            all.
    """

    states: tuple[State, ...]
    missed: tuple[int, ...] = ()


def located(chart: FramedChart, states: Mapping[int, State]) -> Located:
    """Find the state of every visit of a chart from the given states of some visits.

    The first visit must have a state. The states must make a map: visits at one place do not
    contradict each other, and an action leads from a state to one state.
    """
    if len(states) == len(chart.stars):
        return Located(tuple(states[visit] for visit in range(len(states))))
    return _VisitLocaliser(chart, states).located()


class _VisitLocaliser:
    """Localises visits in the map that the known states of some visits make."""

    def __init__(self, chart: FramedChart, states: Mapping[int, State]) -> None:
        self._leaves = chart.leaves
        self._slots: list[list[int]] = [[] for _ in chart.stars]  # the slots that each visit faces
        for visit, slot in chart.facing:
            self._slots[visit].append(slot)
        self._faced = {
            faced(state, slot) for visit, state in states.items() for slot in self._slots[visit]
        }
        self._leads = {
            (faced(state, slot), action): states[visit + 1]
            for visit, state in states.items()
            if visit + 1 in states
            for slot, action in [self._leaves[visit]]
        }
        self._fits = _fitting(chart, states)

    def located(self) -> Located:
        """Find the states of all visits, or the visits that are missed."""
        possible = self._anywhere(0)
        found = [possible]
        missed: set[int] = set()
        stretches = 0
        for visit in range(1, len(self._slots)):
            before, possible = possible, self._after(possible, visit - 1)
            # The visit is missed: no state fits, its action is unknown, or it faces a new slot.
            if not possible or self._is_unknown(before, visit - 1) or self._is_new(possible, visit):
                missed.update(self._stretch_up_to(visit))
                stretches += 1
                if stretches == STRETCHES:
                    break
                possible = possible or self._anywhere(visit)
            found.append(possible)
        return (
            Located((), tuple(sorted(missed)))
            if missed
            else Located(tuple(state for (state,) in found))
        )

    def _stretch_up_to(self, visit: int) -> Iterable[int]:
        """Find a short stretch of visits, up to this one, that the map cannot explain.

        The map explains a stretch if its links lead from some state of the first visit to states
        that fit all other visits. Stretches of 2, 3, 5, 9, … visits are tried, the shortest first.
        """
        back = 1
        while True:
            start = max(visit - back, 0)
            possible = self._anywhere(start)
            for here in range(start, visit):
                before, possible = possible, self._after(possible, here)
                if not possible:
                    return range(start, here + 2)
            if not start or self._is_unknown(before, visit - 1) or self._is_new(possible, visit):
                return range(start, visit + 1)
            back *= 2

    def _anywhere(self, visit: int) -> set[State]:
        """Return the states (place and slot) that fit a visit by itself, whatever came before."""
        return set(np.flatnonzero(self._fits[visit]).tolist())

    def _after(self, possible: set[State], visit: int) -> set[State]:
        """Return the possible states of the next visit: all that fit, if a link is unknown."""
        slot, action = self._leaves[visit]
        there = {self._leads.get((faced(state, slot), action)) for state in possible}
        if not there or None in there:
            return self._anywhere(visit + 1)
        return {state for state in there if state is not None and self._fits[visit + 1, state]}

    def _is_unknown(self, possible: set[State], visit: int) -> bool:
        """Whether a visit has one possible state, and the map has no link for its action there."""
        slot, action = self._leaves[visit]
        return len(possible) == 1 and not any(
            (faced(state, slot), action) in self._leads for state in possible
        )

    def _is_new(self, possible: set[State], visit: int) -> bool:
        """Whether a visit has one possible state and faces a direction that is new to the map."""
        return len(possible) == 1 and any(
            faced(state, slot) not in self._faced
            for state in possible
            for slot in self._slots[visit]
        )


def faced(state: State, slot: int) -> State:
    """Convert a direction of a visit into one of its place: 4 times the place plus the slot."""
    return state - state % 4 + (state + slot) % 4


def _fitting(chart: FramedChart, states: Mapping[int, State]) -> NDArray[np.bool_]:
    """Find which visits may have which states, as a matrix of flags, visits x states.

    A visit cannot have a state if that contradicts a visit known to be at the same place. A visit
    of known state has only this state.
    """
    fits = np.empty((len(chart.stars), 4 * (max(states.values()) // 4 + 1)), dtype=bool)
    for place, visits in gathered((state // 4, visit) for visit, state in states.items()).items():
        turned = np.array([states[visit] % 4 for visit in visits])
        for slot in range(4):
            fits[:, 4 * place + slot] = ~chart.misfits[(slot - turned) % 4, :, visits].any(axis=0)
    for visit, state in states.items():
        fits[visit] = False
        fits[visit, state] = True
    return fits
