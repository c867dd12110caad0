"""Which steps cannot be one dstate, whatever the map: a lower bound on dstates that anybody can check.

Two steps are *apart* if some actions, done from both, lead to different views: as a dstate has one view and actions are
deterministic, they are different dstates. On a trace, what was done from a step is how the trace goes on; so the steps are apart if
their continuations show different views before, or when, the actions differ. Steps that are pairwise apart, a *clique*, need as many
dstates as they are, in every theory that holds the axioms functional_view and deterministic. A `Certificate` is such a clique.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

SWAPS = 60  # attempts to better the clique of a view, at most; fewer where it has few steps

Matrix = NDArray[np.bool_]


def apartness(seen: Sequence[int], actions: Sequence[int]) -> Matrix:
    """Which pairs of steps are apart: a symmetric matrix, steps x steps, from what was seen at each and done after each.

    Computed from the end of the trace to its start: two steps are apart if they show different things, or if the same action leads
    to steps that are apart.
    """
    shown, done = np.asarray(seen), np.asarray(actions)
    steps = len(shown)
    apart = np.empty((steps, steps), dtype=bool)
    for i in range(steps - 1, -1, -1):
        np.not_equal(shown, shown[i], out=apart[i])
        if i < steps - 1:
            apart[i, :-1] |= (done == done[i]) & apart[i + 1, 1:]
    return apart


def far_apart(apart: Matrix, seen: Sequence[int], actions: Sequence[int]) -> Matrix:
    """The matrix, changed in place, of the pairs that are apart though they show the same view, and no other after one action."""
    shown, done = np.asarray(seen), np.asarray(actions)
    for t in range(len(shown)):
        apart[t] &= shown == shown[t]
        if t < len(done):
            apart[t, :-1] &= (done != done[t]) | (shown[1:] == shown[t + 1])
    return apart


def apart_from(seen: Sequence[int], actions: Sequence[int], step: int) -> Matrix:
    """Which steps are apart from this one: a column of the matrix without the matrix, for traces too long for that."""
    shown, done = np.asarray(seen), np.asarray(actions)
    apart = np.zeros(len(shown), dtype=bool)
    left = np.delete(np.arange(len(shown)), step)  # steps that went on as this one, so far
    for ahead in range(len(shown) - step):
        left = left[left + ahead < len(shown)]
        differs = shown[left + ahead] != shown[step + ahead]
        apart[left[differs]] = True
        left = left[~differs & (left + ahead < len(done))]
        if not len(left) or step + ahead == len(done):
            break
        left = left[done[left + ahead] == done[step + ahead]]
    return apart


def clique(apart: Matrix, seen: Sequence[int]) -> list[int]:
    """A large clique of steps, in order. As steps with different views are always apart, each view has a clique of its own."""
    shown = np.asarray(seen)
    found: list[int] = []
    for view in range(int(shown.max()) + 1):
        steps = np.flatnonzero(shown == view)
        found += [int(steps[i]) for i in _clique(apart[np.ix_(steps, steps)])]
    return sorted(found)


def _clique(apart: Matrix) -> list[int]:
    """Greedily the step that is apart from most of those left, then swaps: take some out, fill up again, keep what is no smaller."""
    random = np.random.default_rng(0)
    best = _filled(apart, [], random)
    for _ in range(min(SWAPS, len(apart) // 8) if 1 < len(best) < len(apart) else 0):
        kept = random.permutation(best)[random.integers(1, len(best)) :]
        other = _filled(apart, kept.tolist(), random)
        best = other if len(other) >= len(best) else best
    return best


def _filled(apart: Matrix, kept: list[int], random: np.random.Generator) -> list[int]:
    """A clique that no step can be added to."""
    left = np.flatnonzero(apart[kept].all(axis=0)) if kept else np.arange(len(apart))
    found = list(kept)
    inner = apart[np.ix_(left, left)]
    degree = inner.sum(axis=0)
    free = np.arange(len(left))  # of those left, the ones that are apart from all found
    while len(free):
        best = free[int((degree[free] + random.random(len(free))).argmax())]
        found.append(int(left[best]))
        stay = inner[best, free]
        degree -= inner[free[~stay]].sum(axis=0)  # each is left out once, so a whole clique costs no more than the matrix is large
        free = free[stay]
    return found
