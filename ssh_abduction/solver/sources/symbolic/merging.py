"""Merge steps, or visits, by evidence: for small causal maps, and for wrong views and stars.

>>> from ssh_abduction.solver.steps.chart import Chart
>>> from ssh_abduction.solver.sources.symbolic.merging import merged
>>> links = ((0, 0, 1), (1, 0, 2), (2, 0, 3))
>>> merged(Chart((0, 1, 0, 1), links, range(4)), [0, 1])
[0, 1, 0, 1]

Two steps are *apart* if they are known to be different dstates. At first, the steps of a clique,
which are pairwise apart, are *known* dstates. All other steps are merged with known dstates.

If two steps are one dstate, then so are the steps that the same action leads to from both, and so
on. All of these are merged. If two of them are apart, nothing is merged. The more steps a merge
affects without a contradiction, the less likely it is wrong. So the *evidence* for a merge is the
number of classes that it merges, plus the number of earlier merges that it confirms. Steps that fit
only one known dstate, with much evidence, are merged first. Then come steps with less evidence.
Steps that fit several known dstates are merged if the evidence for one of these is clearly the
greatest. A step that fits no known dstate becomes one.

This is evidence-driven state merging (Lang, Pearlmutter, Price 1998, "Results of the Abbadingo One
DFA Learning Competition"). It is applied to one trace, and it begins at known dstates all over the
trace instead of at a root.

`Merging` finds wrong views and stars. It merges visits to groups, in which the majority is right. A
star is the openings that are seen at a step. A visit is the steps between two travels. This is
for places with frames: the directions at a place, its slots, are numbered. A group of visits stands
for a place. Each visit of the group is turned by some quarters (right angles), so that its slots
match the slots of the place.

A group costs its dstates, plus the cost of each view and star that differs from the majority of its
steps. Groups are merged while that lowers the total cost, those with the largest gain first. If two
visits of a group end by the same action in the same direction, the next visits are also merged, as
actions are deterministic. Groups that evidence, such as displacements, keeps from being one place
are not merged. This is evidence-driven state merging with votes instead of contradictions.

The groups are a guess, not a map, as they ignore the axioms of paths. Callers replace the outvoted
views and stars in the trace, and solve the mended trace.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.groups import numbered
from ssh_abduction.data.star import Openings
from ssh_abduction.data.step import QUARTERS
from ssh_abduction.data.trace import Trace, View
from ssh_abduction.runtime.clock import SHORT_TURN, each_looking, look_at_clock
from ssh_abduction.solver.steps.apart import Matrix
from ssh_abduction.solver.steps.chart import Chart, Link
from ssh_abduction.theory.pairs import Pairs, pairs_in
from ssh_abduction.theory.theory import Theory

# The demands on the merge of a step with a known dstate, from strict to lenient. The first number
# is by how much its evidence has to exceed that for the next best merge of the step. The second
# number is how many known dstates may fit the step at most. The last demand allows anything.
DEMANDS = ((5, 1), (2, 2), (1, 10), (0, 10**9))
# Compare at most this many pairs of visits. Pairs with the most visits in between are left out.
MOST_PAIRS = 60_000
DSTATE = 10  # cost of a dstate, in tenths

# A visit or a group, and a number of quarters: slot K of the visit or group is slot K + quarters of
# the place.
_Turned = tuple[int, int]


def merged(chart: Chart, clique: Iterable[int] = ()) -> list[int]:
    """Return the dstate of each node of a chart in a small map of the causal theory.

    The nodes of the clique are pairwise distinct. All other nodes are merged by evidence. Dstates
    are numbered in the order of their first nodes.
    """
    classes = Classes(chart.apart(), chart.links)
    classes.known[list(clique)] = True
    classes.settle_all()
    return numbered(classes.root.tolist())


class Classes:
    """Classes of steps that are taken to be one dstate.

    Some classes are *known* dstates. Each other class is later merged with one of these, or becomes
    a known dstate. A merge of two classes also merges the classes that the same actions lead to
    from both, and so on. A merge of steps that are apart is undone.

    Attributes:
        root: For each step, the step that represents its class.
        known: For each root, whether its class is a known dstate.
    """

    def __init__(self, apart: Matrix, links: Iterable[Link]) -> None:
        """Begin with a class for each step.

        `apart` flags the pairs of steps that are different dstates, in a matrix of steps x steps.
        Links are triples (step, action, step).
        """
        steps = len(apart)
        self.root = np.arange(steps)
        self.known = np.zeros(steps, dtype=bool)
        # The row of each root has the steps that are apart from some step of its class.
        self._apart = apart.copy()
        self._members: list[NDArray[np.int_]] = [np.array([t]) for t in range(steps)]
        # For each root, a step that each action leads to.
        self._leads: list[dict[int, int]] = [{} for _ in range(steps)]
        for t, action, u in links:
            self._leads[t][action] = u
        # The values before the last call of `merge`, to undo it.
        self._undo: list[
            tuple[int, int, bool, NDArray[np.bool_], dict[int, int], NDArray[np.int_]]
        ] = []

    def settle_all(self) -> None:
        """Merge classes with known dstates, or make them known, until every class is known."""
        for evidence, rivals in DEMANDS:
            while self._settle(evidence, rivals):
                pass

    def _settle(self, evidence: int, rivals: int) -> bool:
        """Merge each class that is not known with its best known dstate, if that is clear enough.

        A class that fits no known dstate becomes known. The classes that fit the fewest known
        dstates come first. The evidence for the best dstate has to exceed that for the next by
        `evidence`. A class that fits more than `rivals` known dstates is left as it is. Returns
        whether anything changed.
        """
        has_changed = False
        steps = np.flatnonzero(~self.known[self.root])
        fitting = (~self._apart[np.flatnonzero(self.known)][:, steps]).sum(axis=0)
        for t in steps[np.argsort(fitting, kind="stable")].tolist():
            look_at_clock(SHORT_TURN)
            root = int(self.root[t])
            if self.known[root]:
                continue
            fits = self._fitting(root)
            if len(fits) > rivals:
                continue
            ranked = self._ranked(root, fits)
            if not ranked:
                self.known[root] = has_changed = True
            elif ranked[0][0] >= evidence + sum(votes for votes, _ in ranked[1:2]):
                self.merge(ranked[0][1], root, forced=True)
                has_changed = True
        return has_changed

    def _fitting(self, root: int) -> list[int]:
        """List the known dstates that each step of a root's class may be at."""
        known = np.flatnonzero(self.known)
        fits: list[int] = known[
            ~self._apart[np.ix_(known, self._members[root])].any(axis=1)
        ].tolist()
        return fits

    def _ranked(self, root: int, fits: Sequence[int]) -> list[tuple[int, int]]:
        """Rank possible merges of a class with dstates: pairs (evidence, dstate), best first."""
        found = []
        for dstate in fits:
            evidence = self.merge(dstate, root)
            if evidence is not None:
                found.append((evidence, dstate))
                self._take_back()
        return sorted(found, reverse=True)

    def merge(self, a: int, b: int, *, forced: bool = False) -> int | None:
        """Merge the classes of two roots, and all classes that have to be merged with them.

        Returns the evidence. If this would merge steps that are apart, or two known dstates without
        `forced`, it returns None, and nothing has changed.
        """
        self._undo = []
        work = [(a, b)]
        confirmed = 0
        while work:
            a, b = (int(self.root[t]) for t in work.pop())
            if a == b:
                confirmed += 1
                continue
            both_known = self.known[a] and self.known[b]
            if (both_known and not forced) or self._apart[a, self._members[b]].any():
                self._take_back()
                return None
            # Keep the class that is known. If none is, keep the larger one.
            if self.known[b] or (
                not self.known[a] and len(self._members[a]) < len(self._members[b])
            ):
                a, b = b, a
            leads, more = self._leads[a], self._leads[b]
            self._undo.append(
                (a, b, bool(self.known[b]), self._apart[a].copy(), leads, self._members[a])
            )
            self.known[b] = False
            work += [(leads[action], t) for action, t in more.items() if action in leads]
            self._leads[a] = more | leads
            self._apart[a] |= self._apart[b]
            self.root[self._members[b]] = a
            self._members[a] = np.concatenate([self._members[a], self._members[b]])
        return confirmed + len(self._undo)

    def _take_back(self) -> None:
        """Undo the last merge."""
        for a, b, known, apart, leads, members in reversed(self._undo):
            self._apart[a], self._leads[a], self._members[a] = apart, leads, members
            self.known[b] = known
            self.root[self._members[b]] = b
        self._undo = []


@dataclass(frozen=True)
class _SlotVisit:
    """The steps between two travels.

    Attributes:
        steps: Pairs of a step and the slot that it faces. Slots are the four directions, clockwise.
            The robot faces slot 0 when it arrives.
        leaves: The slot that the robot faces at the end of the visit, and the name of the action
            that ends it. None for the last visit of a drive, and if that action slipped.
    """

    steps: tuple[tuple[int, int], ...]
    leaves: tuple[int, str] | None


class _Group:
    """Visits to one place, each turned by some quarters, and the votes of their steps.

    Attributes:
        members: For each visit, the quarters by which it is turned.
        views: For each slot and view, the cost of treating the view as wrong at all steps that show
            it there, in tenths of dstates.
        stars: The same cost for each star, as seen from slot 0.
        cost: The cost of the dstates and of all outvoted views and stars, in tenths of dstates.
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
        """Make the union of groups, each with the quarters by which to turn its visits further."""
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
    """The visits of a trace, in order, in groups, which are merged to places with frames."""

    def __init__(self, trace: Trace, theory: Theory, pairs: Pairs) -> None:
        self._trace, self._theory = trace, theory
        self.visits = list(_visits(trace))
        self._groups = {number: self._of_visit(number) for number in range(len(self.visits))}
        self._group_of = {number: number for number in self._groups}
        self._misfits = self._misfitting(pairs)

    def merge(self) -> None:
        """Merge groups of visits while this lowers the total cost, the largest gain first."""
        while True:
            waiting = [
                (-gain, pair)
                for pair in each_looking(self._candidates())
                if (gain := self._gain(*pair)[0]) > 0
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
                # Merges may have lowered the gain since the pair was put into the queue.
                if waiting and gain < -waiting[0][0]:
                    heapq.heappush(waiting, (-gain, pair))
                    continue
                for parts in joined:
                    self._merge(parts)
                merged = True
                look_at_clock()
            if not merged:
                return

    def mended(self) -> Trace:
        """Return a trace in which each step has the view and star that its group voted for.

        The view is the one with the most votes at the slot that the step faces, and the star the
        one with the most votes at the place. A vote weighs as much as it costs to outvote it.
        """
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

    def _of_visit(self, number: int) -> _Group:
        """Make the group that consists of one visit."""
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
        """Find the visits that cannot be at one place, as an array (4, visits, visits).

        Each visit is a group at first. Element [R, I, J] says that visits I and J cannot be at one
        place such that slot K of I is slot K + R of J. `pairs` of steps are different by evidence.
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
        """List at most MOST_PAIRS pairs (I, J, R): slot K of group I may be slot K + R of J."""
        some = np.array(sorted(self._groups))
        turns, first, second = np.nonzero(
            ~self._misfits[:, some[:, None], some]
            & np.triu(np.ones((len(some),) * 2, dtype=bool), 1)
        )
        if len(turns) > MOST_PAIRS:
            near = np.argsort(second - first, kind="stable")[:MOST_PAIRS]
            turns, first, second = turns[near], first[near], second[near]
        return list(zip(some[first].tolist(), some[second].tolist(), turns.tolist(), strict=True))

    def _gain(self, first: int, second: int, turn: int) -> tuple[int, list[list[_Turned]]]:
        """Compute the gain in tenths of merging two visits' groups, and all groups that follow.

        Slot K of the first visit shall be slot K + turn of the second. For each merge, a list of
        the groups and their quarters is returned, too. Zero and an empty list if the groups cannot
        be one place.
        """
        # For each group, the groups that become one place with it, and how many quarters to turn
        # each of them.
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
                look_at_clock()
        joined = list({id(parts): list(parts.items()) for parts in together.values()}.values())
        before = sum(self._groups[x].cost for parts in joined for x, _ in parts)
        return before - sum(
            _Group.joined((self._groups[x], t) for x, t in parts).cost for parts in joined
        ), joined

    def _follow(
        self, mine: Mapping[int, int], its: Mapping[int, int], shift: int
    ) -> list[tuple[int, int, int]]:
        """List the pairs of visits to merge next: one action leads to both from the same slot.

        A slot is a direction of a place, in quarter turns. `mine` and `its` map groups of visits
        to their rotations. All become one place; those of `its` are rotated by `shift` more.
        Returns triples (visit, visit, turn), as the arguments of `_gain`.
        """
        leads = dict(self._leads(mine, 0))
        return [(leads[key], there, 0) for key, there in self._leads(its, shift) if key in leads]

    def _leads(self, parts: Mapping[int, int], shift: int) -> Iterator[tuple[tuple[int, str], int]]:
        """Yield where actions lead from a place: pairs ((slot, action), next visit).

        `parts` are the groups that become this place, with their quarters. `shift` turns them
        further.
        """
        for x, t in parts.items():
            for visit, turn in self._groups[x].members.items():
                if (leaves := self.visits[visit].leaves) is not None:
                    yield ((leaves[0] + turn + t + shift) % 4, leaves[1]), visit + 1

    def _merge(self, parts: Sequence[_Turned]) -> None:
        """Merge groups, each with the quarters by which to turn it, into the first of them."""
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


def _visits(trace: Trace) -> Iterator[_SlotVisit]:
    """Yield the visits of a trace, in order."""
    steps: list[tuple[int, int]] = [(0, 0)]
    for t, action in enumerate(trace.actions):
        slot = steps[-1][1]
        if action.kind == "turn":
            steps.append((t + 1, (slot + QUARTERS[action.turn]) % 4))
        else:
            yield _SlotVisit(tuple(steps), None if action.unlinked else (slot, action.name))
            steps = [(t + 1, 0)]
    yield _SlotVisit(tuple(steps), None)


def _outvoted(votes: Counter[Any]) -> int:
    """Return the sum of the votes for all options except the winner."""
    return sum(votes.values()) - max(votes.values())


def _winner(votes: Counter[Any]) -> Any:
    """Return the option with the most votes. The first one wins a tie."""
    return max(votes, key=lambda what: votes[what])


def _turned(star: Openings, quarters: int) -> Openings:
    """Turn a star clockwise by some quarters: opening K becomes opening K + quarters."""
    ahead, right, back, left = (star[(k - quarters) % 4] for k in range(4))
    return ahead, right, back, left
