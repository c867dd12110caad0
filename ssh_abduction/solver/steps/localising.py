"""Localise the visits of a trace in a map of some of them.

For a long trace in a small world, clingo does not need every visit: a map of some visits locates
the others. This is Markov localisation with beliefs that are sets of states. From all possible
states of a visit, the map says where its action leads. These are the possible states of the next.
A visit is *missed* if no such state fits it, if the map does not know the action, or if the visit
faces a slot that no visit of the map faced. The map then needs to know this visit, and as many
visits before it as it takes to localise it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.solver.steps.chart import FramedChart

# The most stretches of missed visits to find before clingo is given them and solves again. Its
# answer may explain later stretches, and each further visit makes the problem larger.
STRETCHES = 10

# 4 times the number of a place, plus the slot of the place that is slot 0 of the visit. Places are
# numbered from 0 without gaps.
State: TypeAlias = int


@dataclass(frozen=True)
class Located:
    """The result of localising.

    Attributes:
        states: The state of each visit; empty if the map does not locate all of them.
        missed: If so, the visits that the map needs first.
    """

    states: tuple[State, ...]
    missed: tuple[int, ...] = ()


def located(chart: FramedChart, states: Mapping[int, State]) -> Located:
    """Localise all visits by the states of some.

    Args:
        chart: The visits.
        states: The states of some visits, the first visit among them. Visits at one state are not
            apart, and an action leads from it to one state.
    """
    if len(states) == len(chart.stars):
        return Located(tuple(states[visit] for visit in range(len(states))))
    return _Localiser(chart, states).located()


def tracked(chart: FramedChart, states: Mapping[int, State]) -> list[State]:
    """The state of each visit; -1 if the map leaves it open."""
    return _Localiser(chart, states).tracked()


def states_of(chart: FramedChart, labels: Sequence[int]) -> list[State]:
    """The state of each visit, if visits that share a label are at one place."""
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
    """Localises visits in the map that the states of some visits make."""

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
        """The state of each visit; -1 where it is ambiguous."""
        possible = self._anywhere(0)
        found = [possible]
        for visit in range(1, len(self._slots)):
            possible = self._after(possible, visit - 1) or self._anywhere(visit)
            found.append(possible)
        return [next(iter(states)) if len(states) == 1 else -1 for states in found]

    def located(self) -> Located:
        """The states of all visits, or the visits that are missed."""
        possible = self._anywhere(0)
        found = [possible]
        missed: set[int] = set()
        stretches = 0
        for visit in range(1, len(self._slots)):
            before, possible = possible, self._after(possible, visit - 1)
            # The three cases in which a visit is missed.
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
        """The shortest tried stretch of visits up to this one that the map cannot explain.

        The map cannot explain it from any state of its first visit.
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
        """The states that a visit may be at if the visits before it are unknown."""
        return set(np.flatnonzero(self._fits[visit]).tolist())

    def _after(self, possible: set[State], visit: int) -> set[State]:
        """The states that the next visit may be at, if this one is at one of `possible`.

        These are all states that fit, if the map does not know the action from each possible state.
        """
        slot, action = self._leaves[visit]
        there = {self._leads.get((faced(state, slot), action)) for state in possible}
        if not there or None in there:
            return self._anywhere(visit + 1)
        return {state for state in there if state is not None and self._fits[visit + 1, state]}

    def _is_unknown(self, possible: set[State], visit: int) -> bool:
        """Whether the state of a visit is known, but not where its action leads."""
        slot, action = self._leaves[visit]
        return len(possible) == 1 and not any(
            (faced(state, slot), action) in self._leads for state in possible
        )

    def _is_new(self, possible: set[State], visit: int) -> bool:
        """Whether the state of a visit is known, and no visit of the map faced one of its slots."""
        return len(possible) == 1 and any(
            faced(state, slot) not in self._faced
            for state in possible
            for slot in self._slots[visit]
        )


def faced(state: State, slot: int) -> State:
    """The slot of its place that a visit faces.

    Args:
        state: The state of the visit.
        slot: The slot of the visit that it faces.

    Returns:
        4 times the number of the place, plus the slot.
    """
    return state - state % 4 + (state + slot) % 4


def _fitting(chart: FramedChart, states: Mapping[int, State]) -> NDArray[np.bool_]:
    """Whether each visit may be at each state, as a matrix of visits x states.

    A visit may not be at a place if it is apart from a visit known to be there.
    """
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
