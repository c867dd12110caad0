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
S1^-1 F. A first bound on this eigenvalue is the trace of the matrix. The matrix trace is a sum over
displacements, so two look-ups in a table give it. Pairs that the first bound does not accept are
few. For these, there is a sharper bound (Wolkowicz & Styan 1980, "Bounds for eigenvalues using
traces").
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.theory.evidence.loops import Array, Loops, Reckoning, Steps
from ssh_abduction.theory.evidence.protocol import Equality

Mask: TypeAlias = NDArray[np.bool_]

# A bound accepts a pair only with this margin, because sums are rounded.
MARGIN = 1e-3
# How many pairs are computed at once.
AT_A_TIME = 1_000_000


@dataclass(frozen=True)
class _ReturnsAlone:
    """What is known about each of m returns alone, for one drift of heading.

    Attributes:
        inverse: The inverse covariance of each closing (the error at the end of the loop), m x 9.
            Its entries for the heading are 0 for a return to a place.
        square: The chi-square of each closing, an array of length m.
        repeated: The covariance of each closing from errors that repeat, m x 9.
    """

    inverse: Array
    square: Array
    repeated: Array

    def followed_by(self, other: _ReturnsAlone) -> _ReturnsAlone:
        """Append what is known about other returns."""
        pairs = (
            (self.inverse, other.inverse),
            (self.square, other.square),
            (self.repeated, other.repeated),
        )
        return _ReturnsAlone(*(np.concatenate(pair) for pair in pairs))


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
        self._alone: dict[int, _ReturnsAlone] = dict(before._alone) if before else {}

    def worst(self, new: Mask) -> frozenset[Equality] | None:
        """Return the pair of returns that is rejected most clearly; None if there is none.

        Only pairs with a return that is `new` count.
        """
        rows = self.rows
        worst: frozenset[Equality] | None = None
        most = 0.0
        if not new.any():
            return None
        ends, starts = np.unique(rows[:, 1], return_index=True)
        for end, start, stop in zip(
            ends.tolist(), starts.tolist(), [*starts[1:].tolist(), len(rows)], strict=True
        ):
            look_at_clock()
            if not new[:stop].any():
                continue
            later = np.arange(start, stop)
            for earlier in self._overlapping(later, new):
                look_at_clock()
                pairs = self._unsafe(end, later, earlier, new)
                excess = self._least_excess(end, *pairs)
                if len(excess) and excess.max() > most:
                    best = int(excess.argmax())
                    most = float(excess[best])
                    worst = frozenset(
                        Equality(int(i), int(j), "dstate" if one_dstate else "place")
                        for i, j, one_dstate in (rows[some[best]] for some in pairs)
                    )
        return worst

    def _overlapping(self, later: Steps, new: Mask) -> Sequence[Steps]:
        """List rows that may share displacements with `later` rows, in parts that fit in memory."""
        stop = int(later[-1]) + 1
        begin = int(np.searchsorted(self.rows[:stop, 1], self.rows[later, 0].min(), side="right"))
        earlier = np.arange(begin, stop)
        if not new[later].any():
            earlier = earlier[new[begin:stop]]
        size = max(AT_A_TIME // len(later), 1)
        return [earlier[at : at + size] for at in range(0, len(earlier), size)]

    def _unsafe(self, end: int, later: Steps, earlier: Steps, new: Mask) -> tuple[Steps, Steps]:
        """Find the pairs that the first bound does not accept, without a drift of heading.

        Rows `later` end at step `end`. Returns the index of the later and of the earlier row of
        each pair.
        """
        alone, rows = self._of_each(0), self.rows
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
        unsafe = ~self._is_safe(share, alone.square[earlier, None] + alone.square[later], 0)
        unsafe &= rows[earlier, 1, None] > first
        unsafe &= (earlier[:, None] < later) & (new[earlier, None] | new[later])
        others, these = np.nonzero(unsafe)
        return later[these], earlier[others]

    def _is_safe(self, share: Array, squares: Array, number: int) -> Mask:
        """Mark the pairs of returns that a bound shows not to be rejected, for the drift `number`.

        `share` bounds s squared (see the head of this module). `squares` are sums of two
        chi-squares.
        """
        allowed = min(self._thresholds.values()) - self._reckoning.unlikely[number]
        left = 1 - squares / allowed if allowed > 0 else np.full_like(squares, -1.0)
        safe: Mask = (left > 0) & (share + MARGIN <= left**2)
        return safe

    def _least_excess(self, end: int, later: Steps, earlier: Steps) -> Array:
        """Return the least `_excess` of each pair of returns over all drifts of heading."""
        excess = np.full(len(later), np.inf)
        for number in range(len(self._reckoning.bends)):
            left = np.flatnonzero(excess > 0)
            if not len(left):
                break
            excess[left] = np.minimum(
                excess[left], self._excess(number, end, later[left], earlier[left])
            )
        return excess

    def _excess(self, number: int, end: int, later: Steps, earlier: Steps) -> Array:
        """Return chi-square minus threshold of each pair of returns, at least 0, for one drift."""
        alone, rows, loops = self._of_each(number), self.rows, self._reckoning.loops(number)
        squares = alone.square[later] + alone.square[earlier]
        # The stretch that both loops share.
        begin, stop = (np.maximum(rows[earlier, 0], rows[later, 0]), rows[earlier, 1])
        gathered = loops.of_ends(end)
        ends = np.outer(_common_ends(rows[earlier], rows[later]), loops.at_end)
        share = self._largest_share(alone, later, gathered[stop] - gathered[begin] + ends)
        excess = np.zeros(len(later))
        left = np.flatnonzero(~self._is_safe(share, squares, number))
        if not len(left):
            return excess
        noise = loops.noise(begin[left], stop[left]).reshape(-1, 9) + ends[left]
        share = np.minimum(share[left], 1.0) * np.minimum(
            self._largest_share(alone, earlier[left], noise), 1.0
        )
        left = left[~self._is_safe(share, squares[left], number)]
        if not len(left):
            return excess
        joint = (
            joint_squares(loops, rows[later[left]], rows[earlier[left]])
            + self._reckoning.unlikely[number]
        )
        most = np.array(
            [
                self._thresholds[f]
                for f in (4 + rows[later[left], 2] + rows[earlier[left], 2]).tolist()
            ]
        )
        excess[left] = np.maximum(joint - most, 0.0)
        return excess

    def _largest_share(self, alone: _ReturnsAlone, returns: Steps, noise: Array) -> Array:
        """Return an upper bound on the largest eigenvalue of S^-1 F for some returns.

        S is the covariance of a return, and F the part of it that `noise`, m x 9, and repeated
        errors cause.
        """
        product = alone.inverse[returns].reshape(-1, 3, 3) @ (
            noise + alone.repeated[returns]
        ).reshape(-1, 3, 3)
        trace, square, freedom = (
            np.einsum("mii->m", product),
            np.einsum("mij,mji->m", product, product),
            2 + self.rows[returns, 2],
        )
        bound: Array = trace / freedom + np.sqrt(
            np.maximum((freedom - 1) / freedom * (square - trace**2 / freedom), 0.0)
        )
        return bound

    def _of_each(self, number: int) -> _ReturnsAlone:
        """Return what is known about each return alone, for the drift with this index."""
        known = self._alone.get(number)
        if known is None or len(known.square) < len(self.rows):
            loops, rows = (
                self._reckoning.loops(number),
                self.rows[0 if known is None else len(known.square) :],
            )
            new = _alone(
                *loops.closings(rows[:, 0], rows[:, 1]),
                loops.repeated(rows[:, 0], rows[:, 1]),
                rows[:, 2],
            )
            known = self._alone[number] = known.followed_by(new) if known else new
        return known


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
