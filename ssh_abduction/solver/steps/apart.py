"""Find steps that are different dstates in every map, and a clique of them as a lower bound.

Two steps are *apart* if the same actions, done from both, lead to different views. As a dstate has
one view and actions are deterministic, such steps are different dstates. The *continuation* of a
step is the sequence of views and actions of the trace from this step on. So two steps are apart if
their continuations differ first in a view, not in an action. A *clique* is a set of steps that are
pairwise apart. A map has at least one dstate for each step of a clique, in every theory with the
axioms functional_view and deterministic. A `Certificate` contains such a clique.

*Claim.* The graph of steps that are apart is a cograph (Corneil, Lerchs, Stewart Burlingham 1981),
so a largest clique is found without search.
*Proof.* Group the steps by common prefixes of their continuations. If the continuations of a group
next differ in views, all steps of different subgroups are apart. Then the union of largest cliques
of the subgroups is a largest clique. If the continuations of a group next differ in actions, no
steps of different subgroups are apart. Then the largest among the cliques of the subgroups is a
largest clique. ∎

The steps are sorted by their continuations, as in a suffix array. The groups of the proof are then
intervals of the sorted order. So no matrix of all pairs is needed: one pass over the sorted steps
finds all steps that are apart from a given step.

>>> from ssh_abduction.solver.steps.apart import Continuations
>>> Continuations([0, 1, 0, 2, 0], [0, 0, 0, 0]).clique()
[0, 1, 2, 3]
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.groups import gathered
from ssh_abduction.theory.pairs import Earlier

# If the same actions lead from two steps to an excluded pair, these two are excluded, too. This is
# computed in a matrix of steps x steps (64 MB at most) for at most this many steps. In longer
# traces, only the pairs that evidence names are excluded.
COMPARED = 8000

Matrix = NDArray[np.bool_]


class Continuations:
    """Compares the continuations of steps: the views and actions of the trace from each step on.

    The steps are sorted by their continuations, as in a suffix array (Manber, Myers 1993). For n
    steps this takes time proportional to n log² n. The common prefix of two steps is as long as the
    shortest common prefix of neighbours between them in this order.
    """

    def __init__(
        self,
        seen: Sequence[int],
        actions: Sequence[int],
        excluded: Collection[tuple[int, int]] = (),
    ) -> None:
        """Sort the steps of a trace.

        `seen` has the view at each step, and `actions` the action after each but the last, as
        numbers from 0. `excluded` are pairs of steps that evidence says are different dstates. If
        the same actions lead from two steps to such a pair, these two are different dstates, too.
        """
        shown, done = np.asarray(seen), np.append(np.asarray(actions, dtype=int), -1) + 1
        steps = len(shown)
        self._seen = seen
        self._excluded = _spread(excluded, done) if excluded and steps <= COMPARED else None
        # For each step the steps that evidence excludes, if the trace is too long for a matrix.
        far = excluded if self._excluded is None else ()
        self._partners = gathered(pair for i, j in far for pair in ((i, j), (j, i)))
        # Rank the steps by the first 1, 2, 4, … views and actions of their continuations.
        ranks = [_ranked(shown * (done.max() + 1) + done)]
        while ranks[-1].max() < steps - 1:
            then = np.zeros(steps, dtype=int)
            ahead = 1 << (len(ranks) - 1)
            then[:-ahead] = ranks[-1][ahead:] + 1
            ranks.append(_ranked(ranks[-1] * (steps + 1) + then))
        self._place = ranks[-1]  # the position of each step in the sorted order
        self._sorted = np.argsort(self._place)
        here, there = self._sorted[:-1], self._sorted[1:]
        # Follow the continuations of both neighbours, by halving strides, to where they differ.
        for level in range(len(ranks) - 2, -1, -1):
            ahead = (ranks[level][here] == ranks[level][there]) * (1 << level)
            here, there = here + ahead, there + ahead
        # The length of the common prefix of neighbours, in views and actions.
        self._shared = 2 * (here - self._sorted[:-1]) + (shown[here] == shown[there])

    def apart_from(self, step: int) -> Matrix:
        """Flag the steps that are apart from (not one dstate with) a step: a row of `apart`."""
        place, steps = self._place[step], len(self._place)
        shared = np.empty(steps, dtype=int)
        shared[:place] = np.minimum.accumulate(self._shared[:place][::-1])[::-1]
        shared[place + 1 :] = np.minimum.accumulate(self._shared[place:])
        # After an even number of common views and actions, the next to differ is a view.
        differ = shared % 2 == 0
        differ[place] = False
        row: Matrix = differ[self._place] | self.excluded_from(step)
        return row

    def excluded_from(self, step: int) -> Matrix:
        """Find the steps that by evidence are not one dstate with a step: a flag for each step."""
        if self._excluded is not None:
            row: Matrix = self._excluded[step]
            return row
        row = np.zeros(len(self._place), dtype=bool)
        row[self._partners.get(step, [])] = True
        return row

    def apart(self) -> Matrix:
        """Flag the pairs of steps that are different dstates, in a matrix of steps x steps."""
        steps = len(self._place)
        apart = np.empty((steps, steps), dtype=bool)
        for step in range(steps):
            apart[step] = self.apart_from(step)
        return apart

    def clique(self) -> list[int]:
        """Find a largest clique: a sorted list of steps that are pairwise apart.

        With evidence, the graph is no longer a cograph. Then also grow a clique greedily, and
        return the larger of both. It need not be a largest one.
        """
        # The nested groups that the current step is in. Each pair is the length of the prefix that
        # the steps of the group share, and a largest clique of its steps so far.
        begun: list[tuple[int, tuple[int, ...]]] = []
        for step, shared in zip(self._sorted.tolist(), [*self._shared.tolist(), -1], strict=True):
            so_far = (step,)
            while begun and begun[-1][0] >= shared:
                common, before = begun.pop()
                # After an even number of common views and actions, the next to differ is a view.
                larger = max(before, so_far, key=lambda some: (len(some), -some[0]))
                so_far = before + so_far if common % 2 == 0 else larger
            begun.append((shared, so_far))
        largest = sorted(begun[0][1])
        if self._excluded is not None:
            return max(largest, clique(self.apart(), self._seen), key=len)
        return largest


def _spread(excluded: Collection[tuple[int, int]], done: NDArray[np.int_]) -> Matrix:
    """Find all pairs of steps that are different dstates by evidence, as a matrix, steps x steps.

    A pair is different if it is excluded, or if the same actions at both steps lead to an excluded
    pair. `done` has the action after each step, numbered from 1; 0 for the last step.
    """
    found = np.zeros((len(done), len(done)), dtype=bool)
    first, second = np.array(list(excluded)).T
    found[first, second] = found[second, first] = True
    for step in range(len(done) - 2, -1, -1):
        found[step, :-1] |= (done[:-1] == done[step]) & found[step + 1, 1:]
    return found


def _ranked(keys: NDArray[np.int_]) -> NDArray[np.int_]:
    """Return the rank of each key, from 0. Equal keys have the same rank."""
    return np.unique(keys, return_inverse=True)[1]


def clique(apart: Matrix, seen: Sequence[int]) -> list[int]:
    """Grow a clique among the nodes of each view, greedily. Return their union, sorted."""
    shown, random = np.asarray(seen), np.random.default_rng(0)
    found: list[int] = []
    for view in range(int(shown.max()) + 1):
        steps = np.flatnonzero(shown == view)
        found += [int(steps[i]) for i in grown_clique(apart[np.ix_(steps, steps)], [], random)]
    return sorted(found)


def apart_matrix(pairs: Earlier, steps: int) -> Matrix:
    """Flag pairs of steps in a symmetric matrix, (steps, steps)."""
    flags = np.zeros((steps, steps), dtype=bool)
    for j, others in pairs.items():
        flags[j, list(others)] = flags[list(others), j] = True
    return flags


def large_clique(apart: Matrix) -> list[int]:
    """Grow a clique greedily from each node of a small graph, and return the largest, sorted."""
    random = np.random.default_rng(0)
    found = [grown_clique(apart, [node], random) for node in range(len(apart))]
    largest: list[int] = max(found, key=len, default=[])
    return sorted(largest)


def pairwise_distinct(members: Sequence[int], pairs: Iterable[tuple[int, int]]) -> list[int]:
    """Find a large clique: a list of segments, places or steps that are pairwise distinct.

    `pairs` has the pairs that are distinct. A pair of a member with itself means that the labels
    contradict the axioms, and is ignored.
    """
    number = {member: i for i, member in enumerate(members)}
    rivals = np.zeros((len(members), len(members)), dtype=bool)
    for g, h in pairs:
        rivals[number[g], number[h]] = rivals[number[h], number[g]] = g != h
    return [members[i] for i in large_clique(rivals)]


def grown_clique(apart: Matrix, kept: list[int], random: np.random.Generator) -> list[int]:
    """Grow a clique from the nodes `kept`, which are pairwise apart, until no node can be added.

    Each time add the candidate that is apart from the most other candidates. Chance breaks ties.
    """
    left = np.flatnonzero(apart[kept].all(axis=0)) if kept else np.arange(len(apart))
    found = list(kept)
    inner = apart[np.ix_(left, left)]
    degree = inner.sum(axis=0)
    free = np.arange(len(left))  # candidates: nodes that are apart from all nodes of the clique
    while len(free):
        best = free[int((degree[free] + random.random(len(free))).argmax())]
        found.append(int(left[best]))
        stay = inner[best, free]
        # Each candidate drops out only once. So all updates together read the matrix once.
        degree -= inner[free[~stay]].sum(axis=0)
        free = free[stay]
    return found


def apart_classes(apart: NDArray[np.bool_], of: NDArray[np.int_]) -> NDArray[np.bool_]:
    """Flag two classes as apart if a member of one is apart from a member of the other.

    `apart` flags pairs of members for several turns, (turns, n, n). `of` has their classes, (n,).
    """
    order = np.argsort(of, kind="stable")
    starts = np.flatnonzero(np.diff(of[order], prepend=-1))
    rows = np.logical_or.reduceat(apart[:, order][:, :, order], starts, axis=1)
    found: NDArray[np.bool_] = np.logical_or.reduceat(rows, starts, axis=2)
    return found
