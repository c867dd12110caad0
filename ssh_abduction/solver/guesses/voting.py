"""Find wrong views and stars (openings seen): merge visits, so that right observations win.

If places have frames, the steps between two travels are a visit. A place is a group of visits,
each turned by some quarters. The cost of a group is the cost of its dstates, plus the cost of
ignoring each view and star that differs from what most of its steps show. Groups are merged
while that lowers the total cost, those with the largest gain first. If two visits of a group leave
by the same action, the next visits are also merged, as actions are deterministic. This is
evidence-driven state merging (Lang, Pearlmutter & Price 1998) with votes instead of contradictions.
Evidence such as displacements is obeyed.

The groups are a guess, not a map: they ignore the axioms of paths. Outvoted views and stars are
replaced in the trace, and the mended trace is solved.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ssh_abduction.data.star import Openings
from ssh_abduction.data.trace import Trace, View
from ssh_abduction.solver.steps.chart import QUARTERS
from ssh_abduction.theory.pairs import Pairs, pairs_in
from ssh_abduction.theory.theory import Theory

# The most pairs of visits to compare; those furthest apart in the trace are left out first.
MOST_PAIRS = 60_000
DSTATE = 10  # cost of a dstate, in tenths

# A visit or group, and a number of quarters: slot K of the visit is slot K + quarters of the place.
_Turned = tuple[int, int]


@dataclass(frozen=True)
class _Visit:
    """The steps between two travels.

    Attributes:
        steps: The steps, each with the slot that it faces. The robot faces slot 0 as it arrives.
        leaves: The slot and the name of the action that ends the visit; None for the last visit,
            and if that action slipped.
    """

    steps: tuple[tuple[int, int], ...]
    leaves: tuple[int, str] | None


class _Group:
    """Visits that are one place, each turned by some quarters, and the votes of their steps.

    Attributes:
        members: For each visit, the quarters by which it is turned.
        views: For each slot and view, the cost of ignoring all steps that show it.
        stars: For each star as seen from slot 0, the cost of ignoring all steps that show it.
    """

    def __init__(
        self,
        members: Mapping[int, int],
        views: Mapping[int, Counter[View]],
        stars: Counter[Openings],
    ) -> None:
        self.members, self.views, self.stars = members, views, stars
        self.cost = sum(DSTATE + _outvoted(votes) for votes in views.values()) + _outvoted(stars)

    @staticmethod
    def joined(parts: Iterable[tuple[_Group, int]]) -> _Group:
        """The union of groups, each turned by some more quarters."""
        members: dict[int, int] = {}
        views: dict[int, Counter[View]] = {}
        stars: Counter[Openings] = Counter()
        for group, more in parts:
            members |= {visit: (turn + more) % 4 for visit, turn in group.members.items()}
            for slot, votes in group.views.items():
                views.setdefault((slot + more) % 4, Counter()).update(votes)
            for star, votes_of_star in group.stars.items():
                stars[_turned(star, more)] += votes_of_star
        return _Group(members, views, stars)


class Merging:
    """The visits of a trace, as groups that are merged.

    Args:
        trace: The trace; its theory has frames.
        theory: The theory.
        pairs: Evidence about pairs of steps.
        check: Called now and then; may raise.
    """

    def __init__(
        self, trace: Trace, theory: Theory, pairs: Pairs, check: Callable[[], None]
    ) -> None:
        self._trace, self._theory, self._check = trace, theory, check
        self.visits = list(_visits(trace))
        self._groups = {number: self._of_visit(number) for number in range(len(self.visits))}
        self._group_of = {number: number for number in self._groups}
        self._misfits = self._misfitting(pairs)

    def start_from(self, places: Sequence[tuple[int, int] | None]) -> None:
        """Merge the visits that a map has at one place.

        Args:
            places: The place of each step and the slot of the place that it faces; None if unknown.
        """
        first: dict[int, _Turned] = {}
        for number, visit in enumerate(self.visits):
            step, _ = visit.steps[0]
            here = places[step]
            if here is None:
                continue
            place, faced = here
            other, turn = first.setdefault(place, (number, faced))
            if other != number:
                self._merge(
                    [(self._group_of[other], 0), *self._beside(other, number, (turn - faced) % 4)]
                )

    def merge(self) -> None:
        """Merge groups while that lowers the total cost, those with the largest gain first."""
        while True:
            waiting = [
                (-gain, pair) for pair in self._candidates() if (gain := self._gain(*pair)[0]) > 0
            ]
            heapq.heapify(waiting)
            if not waiting:
                return
            merged = False
            while waiting:
                _, pair = heapq.heappop(waiting)
                gain, joined = self._gain(*pair)
                if gain <= 0:
                    continue
                # The gain may have dropped since the pair was queued.
                if waiting and gain < -waiting[0][0]:
                    heapq.heappush(waiting, (-gain, pair))
                    continue
                for parts in joined:
                    self._merge(parts)
                merged = True
                self._check()
            if not merged:
                return

    def mended(self) -> Trace:
        """The trace with outvoted views and stars replaced by those of the majority."""
        steps = list(self._trace.steps)
        for group in self._groups.values():
            star = _winner(group.stars)
            for visit, turn in group.members.items():
                for t, slot in self.visits[visit].steps:
                    at = (slot + turn) % 4
                    steps[t] = replace(steps[t], view=_winner(group.views[at]))
                    if steps[t].openings != (openings := _turned(star, -at)):
                        steps[t] = replace(steps[t], star=tuple(map(int, openings)))
        return replace(self._trace, steps=tuple(steps))

    def labels(self) -> list[int]:
        """The place and slot that each step faces, as one number."""
        return [
            4 * self._group_of[number] + (slot + self._turn(number)) % 4
            for number, visit in enumerate(self.visits)
            for _, slot in visit.steps
        ]

    def places(self) -> list[int]:
        """The place of each step, as a number."""
        return [label // 4 for label in self.labels()]

    def _turn(self, visit: int) -> int:
        """The quarters by which a visit is turned in its group."""
        return self._groups[self._group_of[visit]].members[visit]

    def _of_visit(self, number: int) -> _Group:
        views: dict[int, Counter[View]] = {}
        stars: Counter[Openings] = Counter()
        for t, slot in self.visits[number].steps:
            step = self._trace.steps[t]
            price = self._theory.fault_tenths("misread", step) or 10**6
            assert step.view is not None
            assert step.openings is not None
            views.setdefault(slot, Counter())[step.view] += price
            stars[_turned(step.openings, slot)] += price
        return _Group({number: 0}, views, stars)

    def _misfitting(self, pairs: Pairs) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Which groups cannot be one place, as an array of R x I x J.

        True if groups I and J cannot be one place with slot K of I at slot K + R of J.
        """
        count = len(self.visits)
        misfits = np.zeros((4, count, count), dtype=bool)
        at = {
            t: (number, slot) for number, visit in enumerate(self.visits) for t, slot in visit.steps
        }
        for number in range(count):
            misfits[1:, number, number] = True
            if self.visits[number].leaves is not None:
                # A travel leads to another place.
                misfits[:, number, number + 1] = misfits[:, number + 1, number] = True
        for i, t in pairs_in(pairs.elsewhere):
            a, b = at[i][0], at[t][0]
            misfits[:, a, b] = misfits[:, b, a] = True
        for i, t in pairs_in(pairs.apart):
            (a, slot), (b, other) = at[i], at[t]
            misfits[(other - slot) % 4, a, b] = misfits[(slot - other) % 4, b, a] = True
        return misfits

    def _candidates(self) -> list[tuple[int, int, int]]:
        """Pairs of groups that may be one place, as triples (I, J, R)."""
        some = np.array(sorted(self._groups))
        turns, first, second = np.nonzero(
            ~self._misfits[:, some[:, None], some]
            & np.triu(np.ones((len(some),) * 2, dtype=bool), 1)
        )
        if len(turns) > MOST_PAIRS:
            near = np.argsort(second - first, kind="stable")[:MOST_PAIRS]
            turns, first, second = turns[near], first[near], second[near]
        return list(zip(some[first].tolist(), some[second].tolist(), turns.tolist(), strict=True))

    def _beside(self, visit: int, other: int, turn: int) -> list[_Turned]:
        """The group of another visit, and the quarters to turn it to join the group of this visit.

        Args:
            visit: This visit.
            other: The other visit.
            turn: Slot K of this visit is to be slot K + turn of the other.

        Returns:
            A list with the group, or an empty one if the two are in one group.
        """
        mine, its = self._group_of[visit], self._group_of[other]
        if mine == its:
            return []
        # Slot K of the visit is slot K + here of its group. It is slot K + turn of the other visit,
        # and so slot K + turn + there of the other group.
        here, there = self._groups[mine].members[visit], self._groups[its].members[other]
        return [(its, (here - turn - there) % 4)]

    def _gain(self, first: int, second: int, turn: int) -> tuple[int, list[list[_Turned]]]:
        """The gain of merging the groups of two visits, and all groups that follow from it.

        Args:
            first: A visit.
            second: Another visit.
            turn: Slot K of the first visit is to be slot K + turn of the second.

        Returns:
            The gain in tenths of dstates, and the groups to merge. Zero and none if they cannot be
            one.
        """
        # For each group, all groups that become one place with it, and their turns.
        together: dict[int, dict[int, int]] = {}
        work = [(first, second, turn)]
        while work:
            i, j, r = work.pop()
            a, b = self._group_of[i], self._group_of[j]
            here, there = self._groups[a].members[i], self._groups[b].members[j]
            mine, its = together.get(a, {a: 0}), together.get(b, {b: 0})
            shift = (here + mine[a] - r - there - its[b]) % 4
            if mine is its or a == b:
                if shift:
                    return 0, []
                continue
            for x, t in mine.items():
                for y, u in its.items():
                    # Slot K of x is slot K + t of the place, and slot K of y is slot K + u + shift.
                    if self._misfits[(t - u - shift) % 4, x, y]:
                        return 0, []
            work += self._follow(mine, its, shift)
            mine = {**mine, **{y: (u + shift) % 4 for y, u in its.items()}}
            for x in mine:
                together[x] = mine
            if len(work) > len(self.visits):
                self._check()
        joined = list({id(parts): list(parts.items()) for parts in together.values()}.values())
        before = sum(self._groups[x].cost for parts in joined for x, _ in parts)
        return before - sum(
            _Group.joined((self._groups[x], t) for x, t in parts).cost for parts in joined
        ), joined

    def _follow(
        self, mine: Mapping[int, int], its: Mapping[int, int], shift: int
    ) -> list[tuple[int, int, int]]:
        """The visits to merge next: those that the same action leads to from the same slot."""
        leads = dict(self._leads(mine, 0))
        return [(leads[key], there, 0) for key, there in self._leads(its, shift) if key in leads]

    def _leads(self, parts: Mapping[int, int], shift: int) -> Iterator[tuple[tuple[int, str], int]]:
        for x, t in parts.items():
            for visit, turn in self._groups[x].members.items():
                if (leaves := self.visits[visit].leaves) is not None:
                    yield ((leaves[0] + turn + t + shift) % 4, leaves[1]), visit + 1

    def _merge(self, parts: Sequence[_Turned]) -> None:
        """Merge these groups into the first."""
        (kept, by), *others = parts
        whole = _Group.joined([(self._groups[x], (t - by) % 4) for x, t in parts])
        for x, t in others:
            r = (by - t) % 4  # slot K of the kept group is slot K + r of the other
            rows = self._misfits[:, x].copy()
            self._misfits[:, kept] |= np.roll(rows, r, axis=0)
            self._misfits[:, :, kept] |= np.roll(self._misfits[:, :, x].copy(), -r, axis=0)
            del self._groups[x]
        self._groups[kept] = whole
        for visit in whole.members:
            self._group_of[visit] = kept


def _visits(trace: Trace) -> Iterator[_Visit]:
    """The visits of a trace, in order."""
    steps: list[tuple[int, int]] = [(0, 0)]
    for t, action in enumerate(trace.actions):
        slot = steps[-1][1]
        if action.kind == "turn":
            steps.append((t + 1, (slot + QUARTERS[action.turn]) % 4))
        else:
            yield _Visit(tuple(steps), None if action.slipped else (slot, action.name))
            steps = [(t + 1, 0)]
    yield _Visit(tuple(steps), None)


def _outvoted(votes: Counter[Any]) -> int:
    """The votes against the majority."""
    return sum(votes.values()) - max(votes.values())


def _winner(votes: Counter[Any]) -> Any:
    """The option with the most votes; of several, the first."""
    return max(votes, key=lambda what: votes[what])


def _turned(star: Openings, quarters: int) -> Openings:
    """The star as seen from a heading some quarters to the left."""
    ahead, right, back, left = (star[(k - quarters) % 4] for k in range(4))
    return ahead, right, back, left
