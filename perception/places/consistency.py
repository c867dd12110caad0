"""Drops closures that contradict other closures of the same drive.

Rooms look alike, and the track is uncertain after a long way. So a closure may pass the test of the
track although it is false. Two closures between nearby visits make a loop: along one closure, along
the track, back along the other closure, and back along the track. The loop ends where it began if
both closures are right.

Reference:
    Mangelson et al. 2018, "Pairwise consistent measurement set maximization for robust multi-robot
    map merging". Here the closure with the most contradictions is dropped first.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence

import numpy as np

from perception.places.closures import GATE, INFLATED, NOISE, VisitMatch, at_end, uncertainty
from perception.places.track import Array, Track, covariance_turned, points_turned, wrapped
from perception.places.visits import Visit

# Two closures are compared if their loop has less than this many metres of the track.
LOOP = 30.0


def agreeing(
    track: Track, visits: Sequence[Visit], found: Sequence[VisitMatch]
) -> list[VisitMatch]:
    """Drop closures until no two contradict each other.

    The closure that is dropped first contradicts most others, less those that it agrees with. Of
    equals it is the one with the lowest score. `found` is sorted by later visits.
    """
    loops = _ClosureLoops(track, visits)
    votes = np.zeros((len(found), len(found)), np.int8)  # small, as it grows with the square
    ends = [float(track.way[visits[closure.last].scan]) for closure in found]
    for i, one in enumerate(found):
        for k in range(bisect_left(ends, ends[i] - LOOP), i):
            other = found[k]
            if loops.way(other.first, one.first) + loops.way(other.last, one.last) < LOOP:
                votes[i, k] = votes[k, i] = 1 if loops.square(one, other) < GATE else -1
    scores = np.array([closure.match.score for closure in found])
    kept = np.ones(len(found), bool)
    while (contradicted := np.flatnonzero(kept & (votes[:, kept] < 0).any(axis=1))).size:
        order = np.lexsort((scores[contradicted], votes[contradicted][:, kept].sum(axis=1)))
        kept[contradicted[order[0]]] = False
    return [closure for closure, keep in zip(found, kept, strict=True) if keep]


class _ClosureLoops:
    """Judges loops of two closures and the two stretches of the track between their visits."""

    def __init__(self, track: Track, visits: Sequence[Visit]) -> None:
        self._track = track
        self._scans = [visit.scan for visit in visits]
        self._middles = np.array([visit.middle for visit in visits]).reshape(-1, 2)

    def way(self, first: int, last: int) -> float:
        """Return how many metres the robot drove between two visits; inf if the track is cut."""
        i, j = sorted((self._scans[first], self._scans[last]))
        cut = self._track.cuts_between(i, j)
        return math.inf if cut else float(self._track.way[j] - self._track.way[i])

    def square(self, one: VisitMatch, other: VisitMatch) -> float:
        """Compute the chi-square of a loop, with INFLATED times the covariance of the track."""
        at, turn = self._middles, one.match.turn
        here = at[one.first] - at[other.first] + one.match.shift
        onward = points_turned(turn, at[other.last] - at[one.last])
        off = np.array([*(here + onward - other.match.shift), wrapped(turn - other.match.turn)])
        first = self._spread(other.first, one.first, at[other.first] + here + onward)
        last = self._spread(one.last, other.last, at[other.last])
        # The error of the rotation of the first match moves the end of the second stretch.
        noise = np.diag(NOISE) ** 2
        spread = first + covariance_turned(turn, last) + noise + at_end(onward, noise)
        return float(off @ np.linalg.solve(spread, off))

    def _spread(self, first: int, last: int, end: Array) -> Array:
        """Compute the covariance of a point near one visit relative to another: (3, 3)."""
        return INFLATED * uncertainty(self._track, self._scans[first], self._scans[last], end)
