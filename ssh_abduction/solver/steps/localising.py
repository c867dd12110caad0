"""Finds the visits that clingo was not told of in a map of those that it was told of.

Of a long trace in a small world clingo need not be told of each visit: a map of some of them says where the others are. That is Markov
localisation with beliefs that are all or nothing. From all states where the last visit may be, the map says where its action leads, and there is the
next visit. The map has to know a visit better in three cases: no such state fits the visit, the map does not know the action, or the visit faces a slot that
no other visit to its place faced. Then it is *missed*, with as many visits before it as it takes to know where it is.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.solver.steps.chart import FramedChart

# At most this many stretches of missed visits are found before clingo is told of them and asked again. The answer to that may explain the stretches after these,
# and each visit that clingo is told of makes its next question larger.
STRETCHES = 10

State: TypeAlias = int  # 4 times the number of a place, 0 and up without gaps, and the slot of the place that slot 0 of a visit is


@dataclass(frozen=True)
class Located:
    """The state of each visit. Where the map does not tell all of them there are no states, and `missed` are visits that it has to know first."""

    states: tuple[State, ...]
    missed: tuple[int, ...] = ()


def located(chart: FramedChart, states: Mapping[int, State]) -> Located:
    """Where all visits are, by the states of some.

    states  of some visits, the first one among them. Visits at one state are not apart, and the same action there leads to one state
    """
    if len(states) == len(chart.stars):
        return Located(tuple(states[visit] for visit in range(len(states))))
    return _Localiser(chart, states).located()


def tracked(chart: FramedChart, states: Mapping[int, State]) -> list[State]:
    """The state of each visit, as far as the map of these states tells: -1 where it is not known where a visit is."""
    return _Localiser(chart, states).tracked()


def states_of(chart: FramedChart, labels: Sequence[int]) -> list[State]:
    """The state of each visit. Visits that share a label are at one place."""
    at: dict[int, list[tuple[int, int]]] = {}  # the visits and slots that have each label
    labelled: dict[int, list[tuple[int, int]]] = {}  # the slots of each visit and their labels
    for (visit, slot), label in zip(chart.facing, labels, strict=True):
        at.setdefault(label, []).append((visit, slot))
        labelled.setdefault(visit, []).append((slot, label))
    states: dict[int, State] = {}
    places = 0
    for first in labelled:
        if first in states:
            continue
        states[first] = 4 * places
        places += 1
        work = [first]
        for visit in work:
            for slot, label in labelled[visit]:
                for other, turned in at.pop(label, ()):
                    if other not in states:
                        states[other] = faced(states[visit], slot - turned)
                        work.append(other)
    return [states[visit] for visit in range(len(states))]


class _Localiser:
    """Localises visits in the map that the states of some visits make: where actions lead from these states, and which states fit other visits."""

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

    def tracked(self) -> list[State]:
        possible = self._anywhere(0)
        found = [possible]
        for visit in range(1, len(self._slots)):
            possible = self._after(possible, visit - 1) or self._anywhere(visit)
            found.append(possible)
        return [next(iter(states)) if len(states) == 1 else -1 for states in found]

    def located(self) -> Located:
        possible = self._anywhere(0)
        found = [possible]
        missed: set[int] = set()
        stretches = 0
        for visit in range(1, len(self._slots)):
            before, possible = possible, self._after(possible, visit - 1)
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
        """A stretch of visits, up to this one, that is long enough to show that the map does not explain it, whatever came before."""
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
        """The states that a visit may be at, if nothing is known of the visits before it."""
        return set(np.flatnonzero(self._fits[visit]).tolist())

    def _after(self, possible: set[State], visit: int) -> set[State]:
        """The states that the next visit may be at, if this one is at one of these. Any that fits, where the map does not know the action everywhere."""
        slot, action = self._leaves[visit]
        there = {self._leads.get((faced(state, slot), action)) for state in possible}
        if not there or None in there:
            return self._anywhere(visit + 1)
        return {state for state in there if state is not None and self._fits[visit + 1, state]}

    def _is_unknown(self, possible: set[State], visit: int) -> bool:
        """Whether it is known where a visit is, but not where its action leads."""
        slot, action = self._leaves[visit]
        return len(possible) == 1 and not any(
            (faced(state, slot), action) in self._leads for state in possible
        )

    def _is_new(self, possible: set[State], visit: int) -> bool:
        """Whether it is known where a visit is, and it faces a slot there that no visit of the map faced."""
        return len(possible) == 1 and any(
            faced(state, slot) not in self._faced
            for state in possible
            for slot in self._slots[visit]
        )


def faced(state: State, slot: int) -> State:
    """The slot of its place that a visit at this state faces when it faces `slot` of its own: as 4 times the place's number plus the slot."""
    return state - state % 4 + (state + slot) % 4


def _fitting(chart: FramedChart, states: Mapping[int, State]) -> NDArray[np.bool_]:
    """Visits x states: whether a visit may be at a state, as it is apart from no visit that is known to be at that place."""
    fits = np.empty((len(chart.stars), 4 * (max(states.values()) // 4 + 1)), dtype=bool)
    at: dict[int, list[int]] = {}
    for visit, state in states.items():
        at.setdefault(state // 4, []).append(visit)
    for place, visits in at.items():
        turned = np.array([states[visit] % 4 for visit in visits])
        for slot in range(4):
            fits[:, 4 * place + slot] = ~chart.misfits[(slot - turned) % 4, :, visits].any(axis=0)
    for visit, state in states.items():
        fits[visit] = False
        fits[visit, state] = True
    return fits
