"""Where the visits are that clingo was not told of, in a map of those that it was told of.

Of a long trace in a small world clingo need not be told of each visit: a map of some of them says where the others are. That is Markov
localisation with beliefs that are all or nothing: where the visit before may be, and where the map says that leads, this visit is. Where no
such state fits it, where the map does not know what was done, or where the visit faces what no other at its place did, the map has to know this
visit, and as many before it as it takes to know where it is.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.steps.chart import FramedChart

STRETCHES = 10  # of visits that are missed in one go

State: TypeAlias = int  # 4 times the number of a place, 0 and up without gaps, and the slot of the place that slot 0 of a visit is


@dataclass(frozen=True)
class Located:
    """The state of each visit; where the map does not say, `missed` are visits that it has to know."""

    states: tuple[State, ...]
    missed: tuple[int, ...] = ()


def located(chart: FramedChart, states: Mapping[int, State]) -> Located:
    """Where all visits are, by the states of some, the first visit among them. Visits at one state are not apart, and what was done there led to one state."""
    if len(states) == len(chart.stars):
        return Located(tuple(states[visit] for visit in range(len(states))))
    return _Localiser(chart, states).located()


def tracked(chart: FramedChart, states: Mapping[int, State]) -> list[State]:
    """The same, as far as the map says: -1 where it is not known where a visit is."""
    return _Localiser(chart, states).tracked()


def states_of(chart: FramedChart, labels: Sequence[int]) -> list[State]:
    """The state of each visit. Visits that share a label are at one place."""
    at: dict[int, list[tuple[int, int]]] = {}  # visits and slots, by label
    labelled: dict[int, list[tuple[int, int]]] = {}  # slots and labels, by visit
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
    """A map: the states of some visits, where what was done there leads, and which states fit the others."""

    def __init__(self, chart: FramedChart, states: Mapping[int, State]) -> None:
        self._leaves = chart.leaves
        self._slots: list[list[int]] = [[] for _ in chart.stars]  # that a visit faces
        for visit, slot in chart.facing:
            self._slots[visit].append(slot)
        self._faced = {faced(state, slot) for visit, state in states.items() for slot in self._slots[visit]}
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
                missed.update(self._stretch(visit))
                stretches += 1
                if stretches == STRETCHES:
                    break
                possible = possible or self._anywhere(visit)
            found.append(possible)
        return Located((), tuple(sorted(missed))) if missed else Located(tuple(state for (state,) in found))

    def _stretch(self, visit: int) -> Iterable[int]:
        """As many visits, up to this one, as it takes to see that the map does not explain them, whatever came before."""
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
        """The states that fit a visit."""
        return set(np.flatnonzero(self._fits[visit]).tolist())

    def _after(self, possible: set[State], visit: int) -> set[State]:
        """The states that the next visit may be at, if this one is at one of these."""
        slot, action = self._leaves[visit]
        there = {self._leads.get((faced(state, slot), action)) for state in possible}
        if not there or None in there:
            return self._anywhere(visit + 1)
        return {state for state in there if state is not None and self._fits[visit + 1, state]}

    def _is_unknown(self, possible: set[State], visit: int) -> bool:
        """Whether it is known where a visit is, but not where it leads."""
        slot, action = self._leaves[visit]
        return len(possible) == 1 and not any((faced(state, slot), action) in self._leads for state in possible)

    def _is_new(self, possible: set[State], visit: int) -> bool:
        """Whether it is known where a visit is, and that it faces there what no other did."""
        return len(possible) == 1 and any(faced(state, slot) not in self._faced for state in possible for slot in self._slots[visit])


def faced(state: State, slot: int) -> State:
    """What slot of its place a visit at a state faces in a slot of its own, as 4 times the place's number and that slot."""
    return state - state % 4 + (state + slot) % 4


def _fitting(chart: FramedChart, states: Mapping[int, State]) -> NDArray[np.bool_]:
    """Visits x states: which states a visit may be at, as it is apart from no visit there."""
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
