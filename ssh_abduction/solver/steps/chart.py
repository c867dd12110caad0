"""Chart a trace: make its graph of nodes and links, and find which nodes are apart.

Engines that find dstates before places work on a chart. In the causal theory each step is a node,
and each action is a link to the next node. With frames (star=frame), a turn rotates the robot by a
known number of quarters (right angles). A *visit* is the steps between two travels, which are all
at one place. The steps of a visit that face the same way are one node. Rotations link the nodes of
a visit in both directions. Two nodes are *apart* if the views and actions of the trace show that
they are different dstates, as in `steps/apart.py`.

For a long trace in a small world, clingo does not need every visit: a map of some visits locates
the others. This is Markov localisation in which a belief is the set of possible *states* of a
visit. A state is a placing as a number: the place, and the slot there that is slot 0 of the visit.
The map says where the action of a visit leads from each possible state. That gives the possible
states of the next visit. A visit is *missed* in each of these cases: none of its possible states
fits what it shows, the map has no link for the action that leads to it, or it faces a slot that no
visit of the map faced. Then the map needs this visit, and enough visits before it to localise it.

>>> from ssh_abduction import Theory, Trace
>>> from ssh_abduction.solver.steps.chart import Chart
>>> from ssh_abduction.solver.steps.log import Log
>>> star = [0, 0, 1, 0], [1, 0, 0, 0]
>>> stars = [star[0], star[1], star[0]]
>>> trace = Trace.from_steps(["a", "b", "a"], ["around", "around"], stars=stars)
>>> chart = Chart.framed(trace, Log(trace, Theory(star="frame")))
>>> chart.node_of, chart.links
((0, 1, 0), ((0, -2, 1), (1, -2, 0)))
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.groups import gathered
from ssh_abduction.data.step import QUARTERS
from ssh_abduction.data.trace import Trace
from ssh_abduction.solver.steps.apart import Continuations
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.pairs import Earlier

Link: TypeAlias = tuple[int, int, int]  # node, action, node

# After finding this many stretches of missed visits, let clingo solve again with them. Its next map
# may explain later stretches, and each further visit makes the problem larger.
STRETCHES = 10

# The state of a visit: 4 times the number of its place, plus the slot of the place that is slot 0
# of the visit. Places are numbered from 0 without gaps.
State: TypeAlias = int


@dataclass(frozen=True)
class Chart:
    """Nodes and the links between them. Nodes are numbered in the order of their first steps.

    Attributes:
        seen: The observation (view, and perhaps star) at each node, as a number.
        links: Triples (node, action, node), with actions as numbers from 0. A rotation by J
            quarters is the action -J.
        node_of: The node of each step.
        excluded: Pairs of nodes that are different dstates by evidence.
    """

    seen: tuple[int, ...]
    links: tuple[Link, ...]
    node_of: Sequence[int]
    excluded: frozenset[tuple[int, int]] = field(default=frozenset(), kw_only=True)

    @staticmethod
    def of_steps(log: Log, size: int) -> Chart:
        """Make the chart of the first `size` steps, with a node for each step."""
        links = tuple((t, log.actions[t], t + 1) for t in range(size - 1))
        return Chart(
            tuple(log.seen[:size]),
            links,
            range(size),
            excluded=frozenset(_pairs_within(log.pairs.apart, size)),
        )

    def apart(self) -> NDArray[np.bool_]:
        """Flag the pairs of nodes that are different dstates, in a matrix of nodes x nodes."""
        return self.continuations.apart()

    @cached_property
    def continuations(self) -> Continuations:
        """The views and actions after each node. Only for a chart whose nodes are steps."""
        return Continuations(self.seen, [action for _, action, _ in self.links], self.excluded)

    def is_map(self, labels: Sequence[int]) -> bool:
        """Whether labels make a causal map; False if one is unknown, that is, negative.

        Each dstate must have one observation, each action at a dstate must lead to one dstate, and
        the nodes of an excluded pair must have different labels.
        """
        view: dict[int, int] = {}
        leads: dict[tuple[int, int], int] = {}
        return (
            min(labels) >= 0
            and all(
                view.setdefault(label, seen) == seen
                for label, seen in zip(labels, self.seen, strict=True)
            )
            and all(
                leads.setdefault((labels[t], action), labels[u]) == labels[u]
                for t, action, u in self.links
            )
            and all(labels[i] != labels[j] for i, j in self.excluded)
        )

    @staticmethod
    def framed(trace: Trace, log: Log, size: int | None = None) -> FramedChart | None:
        """Make the chart of the first steps, or of all, for places with frames.

        Returns None if some visit contradicts itself, so that there is no map with frames.
        """
        size = len(trace) if size is None else size
        node: dict[tuple[int, int], int] = {}
        seen: list[int] = []
        node_of: list[int] = []
        stars: list[tuple[int, ...]] = []  # the star of each visit, beginning ahead at arrival
        travels: list[tuple[int, int, int]] = []
        visit = slot = 0
        for t in range(size):
            if t and (action := trace.actions[t - 1]).kind != "turn":
                # A travel, or an action that may have led anywhere.
                visit, slot = visit + 1, 0
            elif t:
                slot = (slot + QUARTERS[action.turn]) % 4
            openings = trace.steps[t].openings or ()
            star = tuple(int(openings[(k - slot) % 4]) for k in range(4))
            if visit == len(stars):
                stars.append(star)
            if (here := node.setdefault((visit, slot), len(seen))) == len(seen):
                seen.append(log.seen[t])
            if seen[here] != log.seen[t] or stars[visit] != star:
                return None
            node_of.append(here)
            if t and action.kind != "turn":
                travels.append((node_of[-2], log.actions[t - 1], here))
        links = sorted([*travels, *_rotations(node)], key=lambda link: max(link[0], link[2]))
        facing = tuple(node)
        away = {(node_of[i], node_of[j]) for i, j in _pairs_within(log.pairs.elsewhere, size)}
        excluded = {
            (node_of[i], node_of[j]) for i, j in _pairs_within(log.pairs.apart, size)
        } - away
        if any(i == j for i, j in excluded) or any(facing[i][0] == facing[j][0] for i, j in away):
            return None
        return FramedChart(
            tuple(seen),
            tuple(links),
            tuple(node_of),
            facing,
            tuple(stars),
            tuple(travels),
            frozenset(away),
            excluded=frozenset(excluded),
        )


@dataclass(frozen=True)
class FramedChart(Chart):
    """A chart of visits to places with frames. A visit is the steps between two travels.

    Attributes:
        facing: The visit and the slot of each node. Slot K of a visit is K quarters clockwise of
            the heading in which the robot arrived.
        stars: For each visit, which of the four slots are open (1 or 0). Without stars: the
            observation at each slot.
        travels: The links that are travels, in order: travel V leads from visit V to visit V + 1.
            An action that slipped counts as a travel by an action that occurs only once.
        away: Pairs of nodes that are at different places by evidence.
    """

    facing: tuple[tuple[int, int], ...]
    stars: tuple[tuple[int, ...], ...]
    travels: tuple[Link, ...]
    away: frozenset[tuple[int, int]] = frozenset()

    def apart(self) -> NDArray[np.bool_]:
        """Flag the pairs of nodes that are different dstates, in a matrix of nodes x nodes."""
        visits, slots = np.asarray(self.facing).T
        turned = (slots - slots[:, None]) % 4
        apart: NDArray[np.bool_] = self.misfits[turned, visits[:, None], visits]
        apart |= (visits[:, None] == visits) & (turned != 0)
        return apart

    @cached_property
    def leaves(self) -> dict[int, tuple[int, int]]:
        """For each visit but the last, the slot (direction) in which it ends, and the action."""
        return {
            visit: (self.facing[node][1], action)
            for visit, (node, action, _) in enumerate(self.travels)
        }

    def turns(self, trace: Trace) -> list[tuple[str, int, int, int]]:
        """List the distinct turns of the trace: (kind, visit, slot before, slot after).

        The kind is "about" for a turn around, and "turns" for a turn right or left.
        """
        found = dict[tuple[str, int, int, int], None]()
        for (s, x), action in zip(pairwise(self.node_of), trace.actions, strict=False):
            if action.turn:
                kind = "about" if action.turn == "around" else "turns"
                found[kind, *self.facing[s], self.facing[x][1]] = None
        return list(found)

    def visits_with(self, pairs: int) -> int:
        """Return the greatest n such that `fits` lists at most `pairs` for the first n visits."""
        return int(np.searchsorted(self.fitting, pairs, side="right")) - 1

    @cached_property
    def fitting(self) -> NDArray[np.int_]:
        """For each n from 0: how many triples `fits` would list for the first n visits."""
        return np.cumsum([0, *np.count_nonzero(np.triu(~self.misfits, 1), axis=(0, 1))])

    def fits(self, visits: Sequence[int]) -> list[tuple[int, int, int]]:
        """List the pairs of some visits, given in order, that may be at one place.

        A triple (I, J, R) with I < J means: visits I and J may be at one place, and then slot 0 of
        I is slot R of J.
        """
        some = np.asarray(visits)
        turns, first, second = np.nonzero(np.triu(~self.misfits[:, some[:, None], some], 1))
        return list(zip(some[first].tolist(), some[second].tolist(), turns.tolist(), strict=True))

    @cached_property
    def misfits(self) -> NDArray[np.bool_]:
        """Which pairs of visits misfit, as an array of flags, 4 x visits x visits.

        The flag [R, I, J] is True if visits I and J cannot be at one place such that slot 0 of I is
        slot R of J. There are three reasons: they show different things; evidence says so; or both
        end by the same action in the same direction, and the next visits misfit. Because of the
        third reason, the visits are compared from the last to the first.
        """
        visits = len(self.stars)
        views = np.full((visits, 4), -1)
        for (visit, slot), seen in zip(self.facing, self.seen, strict=True):
            views[visit, slot] = seen
        number: dict[tuple[int, ...], int] = {}
        # stars[r] has, for each visit, a number for its star as seen when facing slot r.
        stars = [
            np.array([number.setdefault(star[r:] + star[:r], len(number)) for star in self.stars])
            for r in range(4)
        ]
        leaves = np.full(visits, -1)  # the slot at which a visit ends; -1 for the last
        action = np.full(visits, -1)
        for visit, (slot, done) in self.leaves.items():
            leaves[visit], action[visit] = slot, done
        misfits = np.zeros((4, visits, visits), dtype=bool)
        for s, x in self.away:
            misfits[:, self.facing[s][0], self.facing[x][0]] = misfits[
                :, self.facing[x][0], self.facing[s][0]
            ] = True
        for s, x in self.excluded:
            (i, faced), (j, other) = self.facing[s], self.facing[x]
            if i != j:
                misfits[(other - faced) % 4, i, j] = misfits[(faced - other) % 4, j, i] = True
        for i in range(visits - 1, -1, -1):
            for r in range(4):
                row = misfits[r, i]
                row |= stars[r] != stars[0][i]
                for slot in np.flatnonzero(views[i] >= 0).tolist():
                    there = views[:, (slot + r) % 4]
                    row |= (there >= 0) & (there != views[i, slot])
                if i < visits - 1:
                    alike = ((leaves[i] + r) % 4 == leaves) & (action == action[i])
                    row[:-1] |= alike[:-1] & misfits[0, i + 1, 1:]
        return misfits


def located(
    chart: FramedChart, states: Mapping[int, State]
) -> tuple[tuple[State, ...], tuple[int, ...]]:
    """Find the state of every visit of a chart from the given states of some visits.

    The first visit must have a state. The states must make a map: visits at one place do not
    contradict each other, and an action leads from a state to one state.

    Returns:
        The states of all visits; empty if the map does not locate all of them. And the visits to
        add to the map so that it locates more visits; empty if it locates all.
    """
    if len(states) == len(chart.stars):
        return tuple(states[visit] for visit in range(len(states))), ()
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

    def located(self) -> tuple[tuple[State, ...], tuple[int, ...]]:
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
        if missed:
            return (), tuple(sorted(missed))
        return tuple(state for (state,) in found), ()

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


def _rotations(node: Mapping[tuple[int, int], int]) -> Iterator[Link]:
    """Yield the links between the nodes of each visit. Their actions are minus the quarters."""
    for (visit, slot), s in node.items():
        for k in range(4):
            if k != slot and (x := node.get((visit, k))) is not None:
                yield s, -((k - slot) % 4), x


def _pairs_within(earlier: Earlier, size: int) -> list[tuple[int, int]]:
    """List the pairs of steps that are both among the first `size`, the earlier step first."""
    return [(i, t) for t, others in earlier.items() if t < size for i in others]
