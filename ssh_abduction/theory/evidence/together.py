"""Which returns of a map are refused two together, though none of them is refused alone.

Two returns, whose loops close off by o1 and o2 with covariances S1 and S2, and C between them, have
the joint chi-square

    (o1, o2)' (S1, C; C', S2)^-1 (o1, o2)        where that of each alone is z = o' S^-1 o.

A map of a thousand steps has some thousand returns, and some ten million sets of two. To solve as
many systems of six equations takes minutes, so most sets are passed by a bound. Let s be the
largest singular value of S1^-1/2 C S2^-1/2. The eigenvalues of the matrix, once it is whitened, are
1 - s at least, so that the joint chi-square is at most (z1 + z2) / (1 - s). And C comes of what
both loops share: some displacements, and the errors that repeat. If that contributes F to S1, then
s squared is at most the largest eigenvalue of S1^-1 F. It is at most the trace, which is a sum over
displacements, so that two look-ups in a table tell it; and for the few sets that the trace does not
pass there is a sharper bound (Wolkowicz & Styan 1980, "Bounds for eigenvalues using traces").
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.theory.evidence.loops import Array, Loops, Reckoning, Steps

Mask: TypeAlias = NDArray[np.bool_]

# A bound passes a set only if it is this far from letting it fail, as sums are rounded.
MARGIN = 1e-3
# So many sets are worked on in one go.
AT_A_TIME = 1_000_000
# So many returns, at most, tell which drift of heading is tried first.
SAMPLE = 300


@dataclass(frozen=True)
class _Alone:
    """What is known of each return alone, for one drift of heading.

    inverse   of the covariance of its closing, m x 9; zeros for the heading of a return to a place, which says nothing
    square    its chi-square, m
    repeated  what errors that repeat contribute to the covariance, m x 9
    """

    inverse: Array
    square: Array
    repeated: Array

    def followed_by(self, other: _Alone) -> _Alone:
        pairs = (
            (self.inverse, other.inverse),
            (self.square, other.square),
            (self.repeated, other.repeated),
        )
        return _Alone(*(np.concatenate(pair) for pair in pairs))


class Together:
    """Returns of one map, whose sets of two are tested.

    rows  one row for each return, by last step: its first step, its last step, and whether it is
    one dstate rather than one place
    """

    def __init__(
        self,
        reckoning: Reckoning,
        thresholds: Mapping[int, float],
        rows: Steps,
        before: Together | None = None,
    ) -> None:
        """Nothing is tested yet.

        thresholds  the chi-square above which a set is refused, by its degrees of freedom
        before      the first of these rows, made for the first steps of the trace: what is known of them is taken over
        """
        self.rows = rows
        self._reckoning, self._thresholds = reckoning, thresholds
        self._alone: dict[int, _Alone] = dict(before._alone) if before else {}
        self._number: int  # of the drift that is tried first
        self._chosen_among: int  # returns
        if before and len(rows) <= 2 * before._chosen_among:
            self._number, self._chosen_among = before._number, before._chosen_among
        else:
            self._number, self._chosen_among = self._likeliest(), len(rows)

    def worst(self, new: Mask) -> tuple[Steps, Steps] | None:
        """Of the sets with a new return in it, the one that is refused most clearly; None where none is refused.

        new  whether each return is new
        """
        rows = self.rows
        worst, most = None, 0.0
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
                    worst, most = (rows[pairs[0][best]], rows[pairs[1][best]]), float(excess[best])
        return worst

    def _overlapping(self, later: Steps, new: Mask) -> Sequence[Steps]:
        """The rows that end no later than these, and whose loops share displacements with some of them; in parts."""
        stop = int(later[-1]) + 1
        begin = int(np.searchsorted(self.rows[:stop, 1], self.rows[later, 0].min(), side="right"))
        earlier = np.arange(begin, stop)
        if not new[later].any():
            earlier = earlier[new[begin:stop]]
        size = max(AT_A_TIME // len(later), 1)
        return [earlier[at : at + size] for at in range(0, len(earlier), size)]

    def _unsafe(self, end: int, later: Steps, earlier: Steps, new: Mask) -> tuple[Steps, Steps]:
        """The sets of a row that ends at a step and another one which the bound by the trace does not pass for the drift that is tried first."""
        alone, rows = self._of_each(self._number), self.rows
        first = rows[later, 0]
        inverse = alone.inverse[later]
        gathered = self._loops(self._number).of_ends(end) @ inverse.T
        before = np.arange(end + 1)[:, None] < first
        # What comes before a loop is no part of it.
        gathered = np.where(before, gathered[first, np.arange(len(later))], gathered)
        share = (
            gathered[rows[earlier, 1]]
            - gathered[rows[earlier, 0]]
            + (inverse * alone.repeated[later]).sum(1)
        )
        unsafe = ~self._is_safe(
            share, alone.square[earlier, None] + alone.square[later], self._number
        )
        unsafe &= rows[earlier, 1, None] > first
        unsafe &= (earlier[:, None] < later) & (new[earlier, None] | new[later])
        others, these = np.nonzero(unsafe)
        return later[these], earlier[others]

    def _is_safe(self, share: Array, squares: Array, number: int) -> Mask:
        """Whether sets are not refused, by a bound on the largest eigenvalue of what both returns share, and the sums of their chi-squares."""
        allowed = min(self._thresholds.values()) - self._reckoning.unlikely[number]
        left = 1 - squares / allowed if allowed > 0 else np.full_like(squares, -1.0)
        safe: Mask = (left > 0) & (share + MARGIN <= left**2)
        return safe

    def _least_excess(self, end: int, later: Steps, earlier: Steps) -> Array:
        """By how much the chi-square of each set is above the threshold, for the drift for which that is least; 0 where it is not, for some drift."""
        excess = np.full(len(later), np.inf)
        others = (number for number in range(len(self._reckoning.bends)) if number != self._number)
        for number in (self._number, *others):
            left = np.flatnonzero(excess > 0)
            if not len(left):
                break
            excess[left] = np.minimum(
                excess[left], self._excess(number, end, later[left], earlier[left])
            )
        return excess

    def _excess(self, number: int, end: int, later: Steps, earlier: Steps) -> Array:
        """By how much the chi-square of each set is above the threshold, for one drift; 0 where it is not."""
        alone, rows, loops = self._of_each(number), self.rows, self._loops(number)
        squares = alone.square[later] + alone.square[earlier]
        # Of what both loops share.
        begin, stop = (
            np.maximum(rows[earlier, 0], rows[later, 0]),
            rows[earlier, 1],
        )
        gathered = loops.of_ends(end)
        share = self._largest_share(alone, later, gathered[stop] - gathered[begin])
        excess = np.zeros(len(later))
        left = np.flatnonzero(~self._is_safe(share, squares, number))
        if not len(left):
            return excess
        noise = loops.noise(begin[left], stop[left]).reshape(-1, 9)
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

    def _largest_share(self, alone: _Alone, returns: Steps, noise: Array) -> Array:
        """A bound on the largest share that some noise, m x 9, and the errors that repeat have in the covariance of returns, in any direction."""
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

    def _likeliest(self) -> int:
        """The drift with which some of the loops close best."""
        if not len(self.rows):
            return 0
        rows = self.rows[:: max(len(self.rows) // SAMPLE, 1)]
        numbers = np.arange(len(self._reckoning.bends))
        closing, covariance = self._reckoning.closings(
            np.repeat(numbers, len(rows)), *np.tile(rows[:, :2], (len(numbers), 1)).T
        )
        squares = _alone(
            closing, covariance, np.zeros_like(covariance), np.tile(rows[:, 2], len(numbers))
        ).square
        return int((squares.reshape(len(numbers), -1).sum(1) + self._reckoning.unlikely).argmin())

    def _of_each(self, number: int) -> _Alone:
        """What is known of each return alone, for one drift."""
        known = self._alone.get(number)
        if known is None or len(known.square) < len(self.rows):
            loops, rows = (
                self._loops(number),
                self.rows[0 if known is None else len(known.square) :],
            )
            new = _alone(
                *loops.closings(rows[:, 0], rows[:, 1]),
                loops.repeated(rows[:, 0], rows[:, 1]),
                rows[:, 2],
            )
            known = self._alone[number] = known.followed_by(new) if known else new
        return known

    def _loops(self, number: int) -> Loops:
        return self._reckoning.loops(number)


def joint_squares(loops: Loops, these: Steps, others: Steps) -> Array:
    """The joint chi-square of each of these rows, as in Together, with the other one at its side."""
    joint, off = np.empty((len(these), 6, 6)), np.empty((len(these), 6))
    for rows, at in ((these, slice(3)), (others, slice(3, 6))):
        closing, covariance = loops.closings(rows[:, 0], rows[:, 1])
        _cut_off_headings(closing, covariance, rows[:, 2])
        off[:, at], joint[:, at, at] = closing, covariance
    shared = loops.shared((these[:, 0], these[:, 1]), (others[:, 0], others[:, 1]))
    shared[these[:, 2] == 0, 2, :] = 0.0
    shared[others[:, 2] == 0, :, 2] = 0.0
    joint[:, :3, 3:], joint[:, 3:, :3] = shared, shared.transpose(0, 2, 1)
    squares: Array = np.einsum("mi,mi->m", off, np.linalg.solve(joint, off[:, :, None])[:, :, 0])
    return squares


def _alone(closing: Array, covariance: Array, repeated: Array, one_dstate: Steps) -> _Alone:
    """What is known of each return alone, from how far off its loop closes and the covariance of that."""
    _cut_off_headings(closing, covariance, one_dstate)
    inverse: Array = np.asarray(np.linalg.inv(covariance), dtype=float)
    inverse[one_dstate == 0, 2, 2] = 0.0
    square = np.einsum("mi,mij,mj->m", closing, inverse, closing)
    return _Alone(inverse.reshape(-1, 9), square, repeated.reshape(-1, 9))


def _cut_off_headings(closing: Array, covariance: Array, one_dstate: Steps) -> None:
    """Let the heading of a return to a place say nothing: it closes, and depends on nothing else."""
    places = one_dstate == 0
    closing[places, 2] = 0.0
    covariance[places, 2, :] = covariance[places, :, 2] = 0.0
    covariance[places, 2, 2] = 1.0
