"""A lower bound on the cost of all maps if the robot may be off the poses of dstates, as in logs.

A visit lies some decimetres beside its place. Each map pays for this scatter, and for bending the
track so that visits come nearer to each other.

*A track that cannot bend.* Then a map is a clustering of known poses, and dstates and places are
facilities with prices (`facilities.py`). There are two clustering problems. In the first, the
points are the visits, a facility has the price of a place, and only the share PLACES of the error
of position counts. In the second, the points are the steps, a facility has the price of a dstate,
and the rest of the error counts. The sum of both bounds is a bound on the cost.

*A track that bends.* Let z be the most important errors of the track, as independent standard
normal variables. Bending costs |z|^2 / 2. It moves each point by some b against the other points of
its cluster. For each c > 0, |a + b|^2 >= c / (1 + c) |a|^2 - c |b|^2. So multiply the variances of
each point by 1 + 1 / c. Then the bound holds except for a loss of at most c |b|^2 / 2. If two
points are too far apart to share a facility, but z brings them together, one of them loses at most
its share, and the other one nothing. All these losses are at most quadratic forms of z. The
numbers c are chosen so small that the sum of the forms is at most |z|^2 / 2. So bending costs more
than it saves. A point whose losses are greater than its share is left out.

*Pieces.* Displacements and closures connect some steps. Steps that are not connected, such as the
steps of two drives, may have any relative pose. A facility that serves several such pieces saves in
each piece at most what the best facility of this piece saves. So for each kind of points only those
of one piece get shares.

The poses are linearised at the best track without returns. All other axioms can only raise the
cost. The bound uses two kinds of them. Steps with different views are different dstates; if a view
may be wrong, the step pays for this at a dstate with another view. And evidence keeps pairs of
steps apart, mostly the displacements between them. Such pairs share no facility, however the track
bends.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ssh_abduction.data.odometry import Odometry
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.solver.costs.facilities import Array, Facilities
from ssh_abduction.solver.geometry.equations import Equations, spreads_of
from ssh_abduction.solver.geometry.fit import Poses
from ssh_abduction.solver.steps.apart import apart_matrix, large_clique
from ssh_abduction.theory.settle import Problem

# The share of the error of position that is counted in the problem of places.
PLACES = 0.5
# The number of errors of the track that are treated one by one. The rest adds to the scatter.
MODES = 25
# Points are far if they are this many standard deviations too far apart to share a facility.
GAPS = (2.5, 4.0, 6.0, 10.0)
# Shares are first computed with variances multiplied by FIRST. Later, no share may be more than
# GROWTH times the first one plus SLACK.
FIRST, GROWTH, SLACK = 1.3, 1.15, 0.2
# The bound alone does not prove a map to be the best one, as poses are linearised.
UNPROVEN = 0.01
# At most LARGEST other points are treated one by one for each point.
LARGEST = 40
# The prices of bending are found in 2 * SUBGRADIENTS steps. Each c is SMALLEST to MOST. A point is
# assumed to pay this share ALONE more than in the cheapest clustering: with a small c, other
# clusterings would be cheaper.
SUBGRADIENTS, SMALLEST, MOST, ALONE = 150, 0.03, 1e4, 0.2
TINY = 1e-12


def is_for(problem: Problem) -> bool:
    """Whether the bound holds for a trace and its theory, and may be above 0."""
    trace = problem.trace
    return len(trace) > 2 and bool(spreads_of(trace).any()) and not problem.theory.jumped


def least_cost(problem: Problem, visit: Sequence[int], most: float) -> float:
    """Compute a lower bound on the cost of every map, in nats.

    `visit` has, for each step, the first step of its visit. `most` is the cost of some map, in
    nats. The bound is at most `most` minus UNPROVEN. If no points get shares, it is what the misfit
    of the track costs.
    """
    track = _LinearTrack.of(problem)
    every = _parts(problem, track, np.array(visit))
    # A map pays for these points, so for a cost below `most` the track bends by less than `within`.
    paid = track.nats + sum(part.price * len(large_clique(part.apart)) for part in every)
    within, parts = math.sqrt(2 * max(most - paid, 0.0)), [part.of_best_pieces() for part in every]
    shares, pays = (np.concatenate([part[k] for part in parts]) for k in (1, 2))
    best: tuple[float, Array, list[_Losses]] = (0.0, np.zeros(0), [])
    for gap in GAPS:
        losses = [_Losses.of(part, first, gap, within) for part, first, _ in parts]
        near, far = (np.concatenate([getattr(x, name) for x in losses]) for name in ("near", "far"))
        estimate, numbers = _best_numbers(shares, pays, near, far)
        best = max(best, (estimate, numbers, losses), key=lambda found: found[0])
    _, numbers, losses = best
    ends = np.cumsum([len(x.most) for x in losses])
    bounds = (x.bound(c) for x, c in zip(losses, np.split(numbers, ends), strict=False))
    return min(track.nats + sum(bounds), most - UNPROVEN)


@dataclass(frozen=True, eq=False)
class _LinearTrack:
    """The best track without returns, linearised.

    Attributes:
        nats: What its misfit to the displacements and closures costs.
        piece: The piece of each step: displacements and closures tie the steps of a piece, (n,).
        poses: x, y and heading of each step, in metres and radians, (n, 3).
        moves: How far each of the most important errors of the track moves each pose, (n, 3, k).
        scatter: The variances of the pose of each step about its dstate, with all other errors of
            the track, (n, 3).
    """

    nats: float
    piece: NDArray[np.int_]
    poses: Array
    moves: Array
    scatter: Array

    @classmethod
    def of(cls, problem: Problem) -> _LinearTrack:
        """Fit the track of a trace."""
        trace, n = problem.trace, len(problem.trace)
        odometry = replace(trace.odometry or Odometry(), offset=0.0, facing=0.0)
        at_steps = Poses(replace(trace, odometry=odometry), range(n), range(n))
        steps, piece = np.arange(n), _pieces(trace)
        columns = np.column_stack([2 * steps, 2 * steps + 1, 2 * n + steps])
        fixed = columns[np.unique(piece, return_index=True)[1]].ravel().tolist()
        squares, unknown, covariance = at_steps.settled(None, fixed, range(3 * n))
        look_at_clock()  # in traces of 800 steps, this step and the next take seconds each
        poses, order = unknown[columns], columns.ravel()
        turned = _without_rigid_motions(poses, piece)
        scatter = spreads_of(trace)
        deviation = np.sqrt(scatter).ravel()
        relative = (turned @ covariance @ turned.T)[np.ix_(order, order)]
        values, vectors = np.linalg.eigh(relative / np.outer(deviation, deviation))
        look_at_clock()
        values, vectors = values[::-1].clip(0.0), vectors[:, ::-1]
        moves = vectors[:, :MODES] * np.sqrt(values[:MODES]) * deviation[:, None]
        others = float(values[MODES]) if len(values) > MODES else 0.0
        return cls(squares / 2, piece, poses, moves.reshape(n, 3, -1), scatter * (1 + others))


def _pieces(trace: Trace) -> NDArray[np.int_]:
    """Return the piece of each step, (n,): displacements and closures connect its steps."""
    said, n = Equations.of(trace), len(trace)
    ties = coo_array((np.ones(len(said.first)), (said.first, said.last)), shape=(n, n))
    piece: NDArray[np.int_] = connected_components(ties, directed=False)[1]
    return piece


def _without_rigid_motions(poses: Array, piece: NDArray[np.int_]) -> Array:
    """Return the matrix that removes translations and rotations of all pieces from errors."""
    n = len(poses)
    matrix = np.identity(3 * n)
    for number in np.unique(piece):
        is_in = piece == number
        middle = poses[is_in].mean(0)
        motions = np.zeros((3 * n, 3))
        motions[: 2 * n : 2, 0] = motions[1 : 2 * n : 2, 1] = motions[2 * n :, 2] = is_in
        motions[: 2 * n : 2, 2] = is_in * (middle[1] - poses[:, 1])
        motions[1 : 2 * n : 2, 2] = is_in * (poses[:, 0] - middle[0])
        matrix[:, : 2 * n] -= motions @ np.linalg.pinv(motions[: 2 * n])
    return matrix


def _parts(problem: Problem, track: _LinearTrack, visit: NDArray[np.int_]) -> list[_MovedPoints]:
    """Return the points of the two clustering problems: of dstates, and of places if any."""
    theory, steps = problem.theory, problem.trace.steps
    dstate, place, _ = theory.prices
    has_places = theory.level != "causal" and place > 0
    number = {view: i for i, view in enumerate(dict.fromkeys(step.view for step in steps))}
    kinds, fees = np.zeros(len(steps), dtype=int), np.full(len(steps), math.inf)
    if "functional_view" in theory.axioms:
        kinds = np.array([number[step.view] for step in steps])
        tenths = [theory.fault_tenths("misread", step) if theory.misread else 0 for step in steps]
        fees = np.array([dstate * price / 10 or math.inf for price in tenths])
        fees[[step.view is None for step in steps]] = 0.0
    # Dstates and places share the scatter of positions, so that nothing is paid twice.
    weights = np.array([1 - PLACES * has_places] * 2 + [1.0])
    scatter = track.scatter / weights
    apart, away = (
        apart_matrix(pairs, len(steps)) for pairs in (problem.pairs.apart, problem.pairs.elsewhere)
    )
    own = track.piece, track.moves, apart
    parts = [_MovedPoints(track.poses, scatter, kinds, fees, dstate, *own)]
    if has_places:
        # The point of a visit is the mean of its steps.
        together = np.column_stack([visit, track.piece])
        _, first, at, count = np.unique(
            together, axis=0, return_index=True, return_inverse=True, return_counts=True
        )
        mean = np.zeros((len(first), len(at)))
        mean[at, np.arange(len(at))] = 1 / count[at]
        moves = np.einsum("vt,tak->vak", mean, track.moves[:, :2])
        scatter = track.scatter[first, :2] / count[:, None] / PLACES
        points, alike = mean @ track.poses[:, :2], np.zeros(len(first), dtype=int)
        free = np.zeros(len(first))
        is_in = (mean > 0).astype(int)
        own = track.piece[first], moves, is_in @ away @ is_in.T > 0
        parts.append(_MovedPoints(points, scatter, alike, free, place, *own))
    return parts


@dataclass(frozen=True, eq=False)
class _MovedPoints(Facilities):
    """Points that share facilities, and how errors of the track move them.

    Attributes:
        piece: The piece of the track of each point, (n,).
        moves: How far each error of the track moves each point, (n, d, k).
        apart: The flag [i, j] says that two points share no facility by evidence, (n, n).
    """

    piece: NDArray[np.int_]
    moves: Array
    apart: NDArray[np.bool_]

    def only(self, chosen: NDArray[np.bool_]) -> _MovedPoints:
        """Return the chosen points."""
        of_points = ("points", "variances", "kinds", "fees", "piece", "moves")
        kept = {name: getattr(self, name)[chosen] for name in of_points}
        return replace(self, **kept, apart=self.apart[chosen][:, chosen])

    def of_best_pieces(self) -> tuple[_MovedPoints, Array, Array]:
        """Return the points of one piece for each kind: the piece with the greatest shares.

        If points pay fees, it is one piece for all kinds. Also return approximate shares of the
        points, and what each point pays for its position and for its heading.
        """
        shares, pays = np.zeros(len(self.points)), np.zeros((len(self.points), 2))
        for piece in np.unique(self.piece):
            inside = self.piece == piece
            part = self.only(inside)
            shares[inside], paid = part.stretched(np.full((1, 2), FIRST)).first_shares()
            pays[inside] = np.stack([paid[:, :2].sum(1), paid[:, 2:].sum(1)], 1)
        group = np.where(np.isfinite(self.fees).any(), 0, self.kinds)
        kept = np.zeros(len(shares), dtype=bool)
        for kind in np.unique(group):
            sums = np.bincount(self.piece, shares * (group == kind))
            kept |= (group == kind) & (self.piece == sums.argmax())
        return self.only(kept), shares[kept], pays[kept]

    def near_loss(self, i: int, others: NDArray[np.bool_]) -> Array:
        """Return twice what the position and the heading of a point lose if c is 1, (2, k, k).

        The facility moves by a mean of the moves of its points, weighted by c over the variance. So
        the loss of a cluster is half of the sum, over its points, of the mean loss of a point
        against the others. The mean is at most the greatest loss against any other point. Position
        and heading have numbers c and means of their own.
        """
        moved = (self.moves[i] - self.moves[others]) / np.sqrt(2 * self.variances[i])[:, None]
        return np.stack([_dominating(moved[:, :2]), _dominating(moved[:, 2:])])

    def stretched(self, factors: Array) -> _MovedPoints:
        """Multiply the variances of position and heading of each point, by factors (n, 2)."""
        return replace(
            self, variances=self.variances * factors[:, [0, 0, 1][: self.points.shape[1]]]
        )


@dataclass(frozen=True, eq=False)
class _Losses:
    """What points of a part may lose if the track bends, as quadratic forms of its errors z.

    Attributes:
        part: The points of one clustering problem: dstates or places.
        most: No share of a point may be more than this, (n,).
        near: Twice what the position and the heading of each point lose against points that it may
            share a facility with, if c is 1, (n, 2, k, k).
        far: Twice what each point loses against the other points, (n, k, k).
    """

    part: _MovedPoints
    most: Array
    near: Array
    far: Array

    @classmethod
    def of(cls, part: _MovedPoints, first: Array, gap: float, within: float) -> _Losses:
        """Bound the losses of points with these approximate shares, (n,).

        Two points are far if they are `gap` standard deviations too far apart to share a facility.
        `within` is the greatest |z|. A map that bends the track more costs more than the known one.
        """
        most = np.minimum(part.price, GROWTH * first + SLACK)
        unit = np.sqrt(part.variances.max(0))
        reach = np.sqrt(2 * most)
        apart = np.linalg.norm(part.offsets(part.points) / unit, axis=-1) - reach - reach[:, None]
        may_pay = part.fees < most
        may_share = (part.kinds[:, None] == part.kinds) | may_pay | may_pay[:, None]
        may_share &= ~part.apart

        def far(i: int, others: NDArray[np.bool_]) -> Array:
            moved, gaps = (part.moves[i] - part.moves[others]) / unit[:, None], apart[i, others]
            is_cheap = gaps < within * np.linalg.norm(moved, 2, axis=(1, 2))
            return _dominating(
                moved[is_cheap] * (math.sqrt(2 * most[i]) / gaps[is_cheap])[:, None, None]
            )

        is_near, is_far = may_share & (apart < gap), may_share & (apart >= gap)
        near = [part.near_loss(i, others) for i, others in enumerate(is_near)]
        # If two far points share a facility, the point that loses more gives up its share.
        sizes = [_largest(far(i, others)) for i, others in enumerate(is_far)]
        rank = np.argsort(np.argsort(sizes))
        is_far &= rank < rank[:, None]
        return cls(part, most, np.array(near), np.array([far(i, o) for i, o in enumerate(is_far)]))

    def bound(self, c: Array) -> float:
        """Return the sum of the shares for numbers c, (n, 2). Points with c = 0 have no share."""
        kept = c.min(1) > 0
        part = self.part.only(kept).stretched(1 + 1 / c[kept])
        return float(part.shares(self.most[kept]).sum()) if kept.any() else 0.0


def _best_numbers(shares: Array, pays: Array, near: Array, far: Array) -> tuple[float, Array]:
    """Find numbers c, (n, 2), with which the losses are at most what bending costs.

    With numbers c, the share of a point falls by about `pays / (1 + c)`. The sum of the shares is
    maximised by Lagrangian duality: a matrix Z is the price of bending, and is found by subgradient
    steps. A point whose losses exceed its share is left out: its c is 0. `pays` has what each point
    pays for its position and heading in the cheapest clustering, (n, 2). `near` and `far` are as in
    `_Losses`. The estimated sum of the shares is returned first.
    """
    size = near.shape[2]
    pays = FIRST * pays + ALONE * shares[:, None]
    least = np.maximum(shares - pays.sum(1) / FIRST, 0.0)
    unit = float(pays.sum()) / size / 2
    price, sums, times = unit * np.identity(size), 0 * pays, 0 * shares
    for step in range(2 * SUBGRADIENTS):
        look_at_clock()
        of_near, of_far = (np.einsum("...ij,ij->...", form, price) for form in (near, far))
        c = np.clip(np.sqrt(pays / np.maximum(of_near, TINY)) - 1, SMALLEST, MOST)
        kept = least + (pays * c / (1 + c) - c * of_near).sum(1) > of_far
        slope = np.identity(size) - far[kept].sum(0) - np.tensordot(c[kept], near[kept], 2)
        size_of_slope = max(1.0, float(np.linalg.norm(slope)))
        price = _positive(price - 2 * unit / math.sqrt(1 + step) / size_of_slope * slope)
        # Average the numbers of the second half, as subgradient steps go back and forth.
        if step >= SUBGRADIENTS:
            sums, times = sums + kept[:, None] * c, times + kept
    kept = times > SUBGRADIENTS / 2
    c = np.where(kept[:, None], sums / np.maximum(times, 1)[:, None], 0.0)
    left = 1.0 - _largest(far[kept].sum(0))
    if left <= 0:
        return 0.0, np.zeros(c.shape)
    c *= left / _largest(np.tensordot(c, near, 2))
    return float((least + (pays * c / (1 + c)).sum(1))[kept].sum()), c


def _positive(form: Array) -> Array:
    """Return a quadratic form without its negative part."""
    values, vectors = np.linalg.eigh(form)
    positive: Array = (vectors * values.clip(0.0)) @ vectors.T
    return positive


def _dominating(moves: Array) -> Array:
    """Find a quadratic form that is at least |a z|^2 for each of m matrices a, (m, d, k)."""
    form = np.zeros((moves.shape[2], moves.shape[2]))
    sizes = (moves**2).sum((1, 2))
    order = np.argsort(-sizes)
    for a in moves[order[:LARGEST]]:
        form += _positive(a.T @ a - form)
    if len(order) > LARGEST:
        form += sizes[order[LARGEST]] * np.identity(len(form))
    return form


def _largest(form: Array) -> float:
    """Return the largest eigenvalue of a quadratic form, at least a tiny number."""
    return max(float(np.linalg.eigvalsh(form)[-1]), 1e-9)
