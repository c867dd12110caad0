"""Fits the poses of the visits of a drive to all its closures, and drops those that contradict it.

Rooms look alike, and the track is uncertain after a long way. So a closure may pass the test of the
track although it is false. It then pulls the track away from where the other closures put it. All
closures are fitted to the track together. A closure is dropped if the fit is much better without
it.

Reference:
    Latif et al. 2013, "Robust loop closing over time for pose graph SLAM" (closures that do not fit
    are found by a fit of the pose graph). Here the leave-one-out chi-square finds them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu

from perception.places.closures import (
    BEND,
    BENDS,
    GATE,
    INFLATED,
    NOISE,
    VisitMatch,
    errors_of,
    seen_from,
    uncertainty,
)
from perception.places.track import Array, Track
from perception.places.visits import Visit

# Of closures that fit nearly as badly as the worst one, the one with the lowest score is dropped.
# Nearly is this share of the chi-square of the worst one.
NEARLY = 0.9
# After a closure is dropped, only closures above this share of GATE are judged again.
DOUBTFUL = 0.5
# The fit ends after ROUNDS steps, or if a step lowers the chi-square by less than the share STILL.
# A step that raises the chi-square is halved, at most HALVINGS times.
ROUNDS, STILL, HALVINGS = 50, 1e-4, 8
# The inverse of the standard deviation of the drift. Its largest value, where closures are found,
# is two standard deviations.
SURE = 2 / (BENDS * BEND)
# The least variance of a motion, and a small number that makes the normal equations regular.
LEAST, REGULAR = 1e-8, 1e-9
# The gains of this many closures are computed at once.
TOGETHER = 256


def agreeing(
    track: Track, visits: Sequence[Visit], found: Sequence[VisitMatch]
) -> list[VisitMatch]:
    """Drop closures, the worst first, until each one agrees with the track and the others.

    A closure agrees if the chi-square of the best fit is at most GATE lower without it. The
    covariances of the track are multiplied by INFLATED, and the heading may drift steadily.
    """
    graph, kept = _ClosureGraph(track, visits, found), np.ones(len(found), bool)
    scores = np.array([closure.match.score for closure in found])
    doubtful = np.arange(len(found))  # a closure that fits well still does so without others
    while len(doubtful) and (gains := graph.gains(kept, doubtful)).max() > GATE:
        bad = doubtful[gains >= max(NEARLY * gains.max(), GATE)]
        kept[bad[np.argmin(scores[bad])]] = False
        doubtful = doubtful[(gains > DOUBTFUL * GATE) & kept[doubtful]]
    return [closure for closure, keep in zip(found, kept, strict=True) if keep]


def fitted_poses(track: Track, visits: Sequence[Visit], found: Sequence[VisitMatch]) -> Array:
    """Fit the poses of visits to the track and the closures: (n, 3).

    The pose of a visit is the middle of its place, in metres, and by how many radians the track is
    turned there.
    """
    graph = _ClosureGraph(track, visits, found)
    if found:
        graph.fit(np.ones(len(found), bool))
    return graph.poses


class _ClosureGraph:
    """Least squares over the poses of the visits of a drive and the drift of its heading.

    Edges are the motions between successive visits, and the closures.
    """

    def __init__(self, track: Track, visits: Sequence[Visit], found: Sequence[VisitMatch]) -> None:
        middles = np.array([visit.middle for visit in visits]).reshape(-1, 2)
        scans = [visit.scan for visit in visits]
        cuts = [track.cuts_between(*sorted(pair)) for pair in pairwise(scans)]
        moves = [k for k, between in enumerate(cuts, 1) if not between]
        self._first = np.array([*(k - 1 for k in moves), *(c.first for c in found)], int)
        self._last = np.array([*moves, *(c.last for c in found)], int)
        onward = [np.array([*(middles[k] - middles[k - 1]), 0.0]) for k in moves]
        self._measured = np.array([*onward, *((*c.match.shift, c.match.turn) for c in found)])
        spreads = [
            INFLATED * uncertainty(track, scans[k - 1], scans[k], middles[k]) + LEAST * np.eye(3)
            for k in moves
        ]
        noise = np.array([*spreads, *[np.diag(NOISE) ** 2] * len(found)]).reshape(-1, 3, 3)
        self._whitening = np.linalg.inv(np.linalg.cholesky(noise))
        # Closures have no way, as no drift turns a match.
        way = np.abs(np.diff(track.way[scans])) if len(visits) > 1 else np.zeros(0)
        self._way = np.array([*(way[k - 1] for k in moves), *[0.0] * len(found)])
        self._moves = len(moves)
        self._unknown = np.append(np.column_stack([middles, np.zeros(len(visits))]).ravel(), 0.0)

    @property
    def poses(self) -> Array:
        """The poses of the visits, (n, 3), by the last fit. Without a fit, those of the track."""
        return self._unknown[:-1].reshape(-1, 3)

    def gains(self, kept: NDArray[np.bool_], asked: NDArray[np.int_]) -> Array:
        """Fit the poses to the closures kept. Return how much the chi-square falls without some.

        `asked` has the closures to leave out, each by itself.
        """
        off, jacobian, solver = self.fit(kept)
        rows = self._moves + np.searchsorted(np.flatnonzero(kept), asked)
        return np.concatenate([*self._gains(off[rows], jacobian, rows, solver)])

    def fit(self, kept: NDArray[np.bool_]) -> tuple[Array, Any, Any]:
        """Fit the poses to the closures kept. The fit begins with the result of the last one.

        Returns the errors of the edges in standard deviations, (k, 3), their derivative, and the
        factors of the normal equations.
        """
        some = np.append(np.ones(self._moves, bool), kept)
        squares = self._squares(some, self._unknown)
        for _ in range(ROUNDS):
            off, jacobian = self._linear(some, self._unknown)
            normal = (jacobian.T @ jacobian).tocsc()
            normal.setdiag(normal.diagonal() + REGULAR)
            normal[-1, -1] += SURE**2
            solver = splu(normal, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
            pull = jacobian.T @ off.ravel()
            pull[-1] += SURE**2 * self._unknown[-1]
            step = solver.solve(-pull)
            # Far from the best fit, a whole step may go too far.
            tried = [(self._squares(some, better := self._unknown + step), better)]
            while tried[-1][0] > squares and len(tried) < HALVINGS:
                step /= 2
                tried.append((self._squares(some, better := self._unknown + step), better))
            if tried[-1][0] >= squares * (1 - STILL):
                break
            squares, self._unknown = tried[-1]
        return off, jacobian, solver

    def _gains(
        self, off: Array, jacobian: Any, rows: NDArray[np.int_], solver: Any
    ) -> Iterator[Array]:
        """Compute the leave-one-out chi-square of some edges, TOGETHER of them at a time."""
        for begin in range(0, len(off), TOGETHER):
            some = off[begin : begin + TOGETHER]
            own = (3 * rows[begin : begin + TOGETHER, None] + np.arange(3)).ravel()
            dense = jacobian[own].toarray()
            found = solver.solve(dense.T).T.reshape(len(some), 3, -1)
            # How much of its own error each edge takes away by moving the poses.
            taken = dense.reshape(len(some), 3, -1) @ found.transpose(0, 2, 1)
            left = (1 + REGULAR) * np.eye(3) - taken
            yield np.einsum("ki,ki->k", some, np.linalg.solve(left, some[..., None])[..., 0])

    def _squares(self, some: NDArray[np.bool_], unknown: Array) -> float:
        """Compute the chi-square of some edges and of the drift."""
        return float((self._linear(some, unknown)[0] ** 2).sum() + (SURE * unknown[-1]) ** 2)

    def _linear(self, some: NDArray[np.bool_], unknown: Array) -> tuple[Array, Any]:
        """Compute the errors of edges in standard deviations, (k, 3), and their derivative."""
        first, last, way = self._first[some], self._last[some], self._way[some]
        poses, drift = unknown[:-1].reshape(-1, 3), unknown[-1]
        bent = np.column_stack([0 * way, 0 * way, drift * way / 2])
        facing = poses[first] + bent  # halfway along each motion
        seen = seen_from(facing, poses[last]) - bent
        off, (ahead, left, _) = errors_of(seen, self._measured[some]), seen.T
        cos, sin = np.cos(facing[:, 2]), np.sin(facing[:, 2])
        zero, one = 0 * way, 1 + 0 * way
        by_last = np.stack([cos, sin, zero, -sin, cos, zero, zero, zero, one], axis=1)
        by_first = np.stack([-cos, -sin, left, sin, -cos, -ahead, zero, zero, -one], axis=1)
        by_drift = np.stack([left * way / 2, -ahead * way / 2, -way], axis=1)
        derivative = np.concatenate(
            [by_first.reshape(-1, 3, 3), by_last.reshape(-1, 3, 3), by_drift[..., None]], axis=2
        )
        whitening = self._whitening[some]
        own = np.stack([3 * node + k for node in (first, last) for k in range(3)], axis=1)
        columns = np.column_stack([own, np.full(len(first), len(unknown) - 1)])
        rows = np.arange(3 * len(first)).reshape(-1, 3, 1)
        entries = np.broadcast_arrays(whitening @ derivative, rows, columns[:, None])
        values, of, by = (entry.ravel() for entry in entries)
        jacobian = coo_array((values, (of, by)), shape=(3 * len(first), len(unknown))).tocsr()
        return (whitening @ off[..., None])[..., 0], jacobian
