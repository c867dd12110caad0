"""Which steps cannot be one dstate, whatever the map: a lower bound on dstates that anybody can check.

Two steps are *apart* if some actions, done from both, lead to different views: as a dstate has one view and actions are
deterministic, they are different dstates. On a trace, what was done from a step is how the trace goes on; so the steps are apart if
their continuations show different views before, or when, the actions differ. Steps that are pairwise apart, a *clique*, need as many
dstates as they are, in every theory that holds the axioms functional_view and deterministic. A `Certificate` is such a clique.

*Claim.* The graph of the steps that are apart is a cograph (Corneil, Lerchs, Stewart Burlingham 1981), so a largest clique takes no search.
*Proof.* Write down what was seen and done from each step on, a view and an action by turns, and put steps in groups by how that begins.
Where the steps of a group next differ in views, those of different subgroups are all apart: a largest clique is one of each subgroup,
together. Where they differ in actions, none of them are: it is the largest of those of the subgroups. ∎

Steps are sorted by how the trace goes on from them, as in a suffix array. The groups of the proof are then stretches of that order, so
there is no matrix of all pairs: one row of it takes a pass over the sorted steps.

>>> from ssh_abduction.solver.steps.apart import Continuations
>>> Continuations([0, 1, 0, 2, 0], [0, 0, 0, 0]).clique()
[0, 1, 2, 3]
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Up to this many steps, the pairs that evidence excludes are spread to earlier steps in a matrix of steps x steps, which takes 64 MB then. In a longer trace
# only the pairs that evidence names are excluded.
COMPARED = 8000
# A greedy clique of one view is improved by at most this many swaps, and by an eighth as many as steps show the view, if these are fewer: each swap takes as
# long as growing a clique anew, and the clique has to be there before clingo is asked anything.
SWAPS = 60

Matrix = NDArray[np.bool_]


class Continuations:
    """How a trace goes on from each of its steps.

    Steps are sorted by that, as in a suffix array (Manber, Myers 1993), in n log² n: what two steps have in common is the least that
    any two neighbours from the one to the other have.
    """

    def __init__(
        self,
        seen: Sequence[int],
        actions: Sequence[int],
        excluded: Collection[tuple[int, int]] = (),
    ) -> None:
        """
        seen      what was seen at each step
        actions   what was done after each step but the last, numbered from 0
        excluded  pairs of steps that evidence keeps from being one dstate. Steps from which the same actions lead to such a pair are not one either
        """
        shown, done = np.asarray(seen), np.append(np.asarray(actions, dtype=int), -1) + 1
        steps = len(shown)
        self._seen = seen
        self._excluded = _spread(excluded, done) if excluded and steps <= COMPARED else None
        self._partners: dict[
            int, list[int]
        ] = {}  # the excluded steps of each step, where the trace is too long for a matrix
        for i, j in excluded if self._excluded is None else ():
            self._partners.setdefault(i, []).append(j)
            self._partners.setdefault(j, []).append(i)
        ranks = [
            _ranked(shown * (done.max() + 1) + done)
        ]  # the order of the steps by their first 1, 2, 4, … views and actions
        while ranks[-1].max() < steps - 1:
            then = np.zeros(steps, dtype=int)
            ahead = 1 << (len(ranks) - 1)
            then[:-ahead] = ranks[-1][ahead:] + 1
            ranks.append(_ranked(ranks[-1] * (steps + 1) + then))
        self._place = ranks[-1]  # the position of each step in the sorted order
        self._sorted = np.argsort(self._place)
        here, there = self._sorted[:-1], self._sorted[1:]
        for level in range(
            len(ranks) - 2, -1, -1
        ):  # both neighbours go on, by halving strides, to where they differ
            ahead = (ranks[level][here] == ranks[level][there]) * (1 << level)
            here, there = here + ahead, there + ahead
        self._shared = 2 * (here - self._sorted[:-1]) + (
            shown[here] == shown[there]
        )  # views and actions that neighbours have in common

    def apart_from(self, step: int, actions: int = 0) -> Matrix:
        """Which steps are apart from this one, and show it only after at least this many actions. With 0 it is the step's row of `apart`."""
        place, steps = self._place[step], len(self._place)
        shared = np.empty(steps, dtype=int)
        shared[:place] = np.minimum.accumulate(self._shared[:place][::-1])[::-1]
        shared[place + 1 :] = np.minimum.accumulate(self._shared[place:])
        differ = (shared % 2 == 0) & (shared >= 2 * actions)  # views are the first to differ
        differ[place] = False
        row: Matrix = differ[self._place] | self.excluded_from(step)
        return row

    def excluded_from(self, step: int) -> Matrix:
        """Which steps are apart from this one because evidence says so."""
        if self._excluded is not None:
            row: Matrix = self._excluded[step]
            return row
        row = np.zeros(len(self._place), dtype=bool)
        row[self._partners.get(step, [])] = True
        return row

    def apart(self) -> Matrix:
        """Which pairs of steps are apart: steps x steps."""
        steps = len(self._place)
        apart = np.empty((steps, steps), dtype=bool)
        for step in range(steps):
            apart[step] = self.apart_from(step)
        return apart

    def clique(self) -> list[int]:
        """A largest clique of steps, in order; among the largest, one whose steps are apart from most.

        Evidence leaves no tree of groups: with it, the clique is the larger one of that and of one that is found greedily.
        """
        # The groups that the current step is in, each within the one before: how much its steps have in common, and its largest clique so far.
        begun: list[tuple[int, _Clique]] = []
        for step, shared in zip(self._sorted.tolist(), [*self._shared.tolist(), -1], strict=True):
            so_far = _Clique((step,), 0, 1)
            while begun and begun[-1][0] >= shared:
                common, before = begun.pop()
                so_far = before.joined(so_far, apart=common % 2 == 0)
            begun.append((shared, so_far))
        largest = sorted(begun[0][1].steps)
        if self._excluded is not None:
            return max(largest, clique(self.apart(), self._seen), key=len)
        return largest


def _spread(excluded: Collection[tuple[int, int]], done: NDArray[np.int_]) -> Matrix:
    """Pairs of steps that are not one dstate, and those from which the same actions lead to such a pair: steps x steps."""
    found = np.zeros((len(done), len(done)), dtype=bool)
    first, second = np.array(list(excluded)).T
    found[first, second] = found[second, first] = True
    for step in range(len(done) - 2, -1, -1):
        found[step, :-1] |= (done[:-1] == done[step]) & found[step + 1, 1:]
    return found


@dataclass(frozen=True, slots=True)
class _Clique:
    """A largest clique of some group of steps.

    apart  the sum, over the steps of the clique, of how many steps of the group each is apart from
    group  the number of steps in the group
    """

    steps: tuple[int, ...]
    apart: int
    group: int

    def joined(self, other: _Clique, *, apart: bool) -> _Clique:
        """A largest clique of two groups together. Either all steps of one group are apart from all of the other (`apart`), or none are."""
        group = self.group + other.group
        if apart:
            more = len(self.steps) * other.group + len(other.steps) * self.group
            return _Clique(self.steps + other.steps, self.apart + other.apart + more, group)
        best = max(
            self, other, key=lambda clique: (len(clique.steps), clique.apart, -clique.steps[0])
        )
        return _Clique(best.steps, best.apart, group)


def _ranked(keys: NDArray[np.int_]) -> NDArray[np.int_]:
    """The rank of each key: keys are numbered by size, and equal keys share a number."""
    return np.unique(keys, return_inverse=True)[1]


def clique(apart: Matrix, seen: Sequence[int]) -> list[int]:
    """A large clique of nodes, in order. Nodes with different views are always apart, so it is put together from one clique for each view."""
    shown = np.asarray(seen)
    found: list[int] = []
    for view in range(int(shown.max()) + 1):
        steps = np.flatnonzero(shown == view)
        found += [int(steps[i]) for i in _greedy_clique(apart[np.ix_(steps, steps)])]
    return sorted(found)


def large_clique(apart: Matrix) -> list[int]:
    """A large clique of few nodes: from each node a clique is grown greedily, and the largest of these is returned."""
    random = np.random.default_rng(0)
    found = [_grown(apart, [node], random) for node in range(len(apart))]
    largest: list[int] = max(found, key=len, default=[])
    return sorted(largest)


def _greedy_clique(apart: Matrix) -> list[int]:
    """A clique grown greedily, then improved by swaps: some of its nodes are taken out, it is grown again, and kept unless it is smaller."""
    random = np.random.default_rng(0)
    best = _grown(apart, [], random)
    for _ in range(min(SWAPS, len(apart) // 8) if 1 < len(best) < len(apart) else 0):
        kept = random.permutation(best)[random.integers(1, len(best)) :]
        other = _grown(apart, kept.tolist(), random)
        best = other if len(other) >= len(best) else best
    return best


def _grown(apart: Matrix, kept: list[int], random: np.random.Generator) -> list[int]:
    """A clique grown from these nodes, until no node can be added. The next node is always one that is apart from most of those left."""
    left = np.flatnonzero(apart[kept].all(axis=0)) if kept else np.arange(len(apart))
    found = list(kept)
    inner = apart[np.ix_(left, left)]
    degree = inner.sum(axis=0)
    free = np.arange(len(left))  # the nodes that are apart from all nodes found so far
    while len(free):
        best = free[int((degree[free] + random.random(len(free))).argmax())]
        found.append(int(left[best]))
        stay = inner[best, free]
        degree -= inner[free[~stay]].sum(
            axis=0
        )  # each node drops out once, so a clique takes no longer than reading the matrix
        free = free[stay]
    return found
