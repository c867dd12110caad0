"""Find pairs of returns of a map that are rejected together, though neither is rejected alone.

A return is two steps that the map has at one place or dstate. Its loop is the way between the two
steps. Let the loops of two returns be off by o1 and o2, with covariances S1 and S2, and C between
them. Their joint chi-square is

    (o1, o2)' (S1, C; C', S2)^-1 (o1, o2)

and that of each alone is z = o' S^-1 o.

A map of a thousand steps has several thousand returns and some ten million pairs. Solving a system
of six equations for each pair takes minutes. So most pairs are accepted by an upper bound on their
joint chi-square. Let s be the largest singular value of S1^-1/2 C S2^-1/2. The eigenvalues of the
whitened matrix are at least 1 - s, so the joint chi-square is at most (z1 + z2) / (1 - s).

C comes from the errors that both loops share: errors of common displacements, and errors that
repeat. If these errors contribute F to S1, then s squared is at most the largest eigenvalue of
S1^-1 F, and so at most the trace of this matrix. The trace is a sum over displacements, so two
look-ups in a table give it. Pairs that this bound does not accept are few.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.theory.evidence.loops import Array, Loops, Reckoning, Steps
from ssh_abduction.theory.evidence.protocol import Equality

# A bound accepts a pair only with this margin, because sums are rounded.
MARGIN = 1e-3
# How many pairs are computed at once.
AT_A_TIME = 1_000_000


class _ReturnsAlone(NamedTuple):
    """What is known about each of m returns alone, if the heading does not drift."""

    # The inverse covariance of each closing (the error at the end of the loop), m x 9. Its entries
    # for the heading are 0 for a return to a place.
    inverse: Array
    square: Array  # the chi-square of each closing, an array of length m
    repeated: Array  # the covariance of each closing from errors that repeat, m x 9


class Together:
    """The returns of one map, and tests of pairs of them.

    Attributes:
        rows: One row for each return, sorted by last step: its first step, its last step, and 1
            for a return to a dstate or 0 for one to a place.
    """

    def __init__(
        self,
        reckoning: Reckoning,
        thresholds: Mapping[int, float],
        rows: Steps,
        before: Together | None = None,
    ) -> None:
        """Keep what pairs are tested with. No pair is tested yet.

        `thresholds` has the chi-square above which a pair is rejected, by its degrees of
        freedom. The results of `before`, for the first of these rows and steps, are reused.
        """
        self.rows = rows
        self._reckoning, self._thresholds = reckoning, thresholds
        new, loops = rows[len(before.rows) if before else 0 :], reckoning.loops(0)
        closings = loops.closings(new[:, 0], new[:, 1])
        alone = _alone(*closings, loops.repeated(new[:, 0], new[:, 1]), new[:, 2])
        pairs = zip(before._alone, alone, strict=True) if before else ()
        self._alone: _ReturnsAlone = _ReturnsAlone(*map(np.concatenate, pairs)) if before else alone

    def worst(self, since: int = 0) -> frozenset[Equality] | None:
        """Return the pair of returns that is rejected most clearly; None if there is none.

        Only pairs count in which the later return ends at step `since` or later.
        """
        rows = self.rows
        worst: frozenset[Equality] | None = None
        most = 0.0
        ends, starts = np.unique(rows[:, 1], return_index=True)
        for end, later in zip(
            ends.tolist(), np.split(np.arange(len(rows)), starts[1:]), strict=False
        ):
            if end < since:
                continue
            for earlier in self._overlapping(later):
                look_at_clock()
                pairs = self._unsafe(end, later, earlier)
                excess = self._least_excess(*pairs)
                if len(excess) and excess.max() > most:
                    best = int(excess.argmax())
                    most = float(excess[best])
                    worst = frozenset(
                        Equality(int(i), int(j), "dstate" if one_dstate else "place")
                        for i, j, one_dstate in (rows[some[best]] for some in pairs)
                    )
        return worst

    def _overlapping(self, later: Steps) -> Sequence[Steps]:
        """List rows that may share displacements with `later` rows, in parts that fit in memory."""
        stop = int(later[-1]) + 1
        begin = int(np.searchsorted(self.rows[:stop, 1], self.rows[later, 0].min(), side="right"))
        earlier = np.arange(begin, stop)
        size = max(AT_A_TIME // len(later), 1)
        return [earlier[at : at + size] for at in range(0, len(earlier), size)]

    def _unsafe(self, end: int, later: Steps, earlier: Steps) -> tuple[Steps, Steps]:
        """Find the pairs that the bound does not accept, without a drift of heading.

        Rows `later` end at step `end`. Returns the index of the later and of the earlier row of
        each pair.
        """
        alone, rows = self._alone, self.rows
        first = rows[later, 0]
        inverse = alone.inverse[later]
        loops = self._reckoning.loops(0)
        gathered = loops.of_ends(end) @ inverse.T
        before = np.arange(end + 1)[:, None] < first
        # Steps before the beginning of a loop do not count.
        gathered = np.where(before, gathered[first, np.arange(len(later))], gathered)
        share = (
            gathered[rows[earlier, 1]]
            - gathered[rows[earlier, 0]]
            + (inverse * alone.repeated[later]).sum(1)
            + _common_ends(rows[earlier, None], rows[later]) * (inverse @ loops.at_end.ravel())
        )
        squares = alone.square[earlier, None] + alone.square[later]
        left = 1 - squares / min(self._thresholds.values())
        unsafe = (left <= 0) | (share + MARGIN > left**2)
        unsafe &= rows[earlier, 1, None] > first
        unsafe &= earlier[:, None] < later
        others, these = np.nonzero(unsafe)
        return later[these], earlier[others]

    def _least_excess(self, later: Steps, earlier: Steps) -> Array:
        """Return chi-square minus threshold of each pair, the least over all drifts of heading.

        It is 0 for a pair that is not rejected.
        """
        freedom = 4 + self.rows[later, 2] + self.rows[earlier, 2]
        most = np.array([self._thresholds[f] for f in freedom.tolist()])
        excess = np.full(len(later), np.inf)
        for number, unlikely in enumerate(self._reckoning.unlikely):
            left = np.flatnonzero(excess > 0)
            if not len(left):
                break
            pairs = (self.rows[some[left]] for some in (later, earlier))
            squares = joint_squares(self._reckoning.loops(number), *pairs)
            off = np.maximum(squares + unlikely - most[left], 0.0)
            excess[left] = np.minimum(excess[left], off)
        return excess


def joint_squares(loops: Loops, these: Steps, others: Steps) -> Array:
    """Return the joint chi-square of each pair of returns (rows of `Together.rows`)."""
    joint, off = np.empty((len(these), 6, 6)), np.empty((len(these), 6))
    for rows, at in ((these, slice(3)), (others, slice(3, 6))):
        closing, covariance = loops.closings(rows[:, 0], rows[:, 1])
        _cut_off_headings(closing, covariance, rows[:, 2])
        off[:, at], joint[:, at, at] = closing, covariance
    shared = loops.shared((these[:, 0], these[:, 1]), (others[:, 0], others[:, 1]))
    shared += _common_ends(these, others)[:, None, None] * loops.at_end
    shared[these[:, 2] == 0, 2, :] = 0.0
    shared[others[:, 2] == 0, :, 2] = 0.0
    joint[:, :3, 3:], joint[:, 3:, :3] = shared, shared.transpose(0, 2, 1)
    squares: Array = np.einsum("mi,mi->m", off, np.linalg.solve(joint, off[:, :, None])[:, :, 0])
    return squares


def _common_ends(these: Steps, others: Steps) -> Steps:
    """Count the ends, with their common errors, that the loops of two returns share."""
    return np.asarray((these[..., :2] == others[..., :2]).sum(-1))


def _alone(closing: Array, covariance: Array, repeated: Array, one_dstate: Steps) -> _ReturnsAlone:
    """Compute what is known about each of m returns alone, from closing errors, m x 3."""
    _cut_off_headings(closing, covariance, one_dstate)
    inverse: Array = np.asarray(np.linalg.inv(covariance), dtype=float)
    inverse[one_dstate == 0, 2, 2] = 0.0
    square = np.einsum("mi,mij,mj->m", closing, inverse, closing)
    return _ReturnsAlone(inverse.reshape(-1, 9), square, repeated.reshape(-1, 9))


def _cut_off_headings(closing: Array, covariance: Array, one_dstate: Steps) -> None:
    """For returns to places, set the heading's error and covariances to 0, its variance to 1."""
    places = one_dstate == 0
    closing[places, 2] = 0.0
    covariance[places, 2, :] = covariance[places, :, 2] = 0.0
    covariance[places, 2, 2] = 1.0
