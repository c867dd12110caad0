"""Find the poses of dstates that agree best with displacements, by least squares.

A displacement is how the robot moved from one step to the next, by its odometry. A closure is how
two steps lie relative to each other, by a match of local maps. The unknowns are the position of
each place (of each dstate, if the map has no places), the heading of each dstate, and two errors
that all displacements share: their scale, and a steady drift of heading. These two errors have a
prior. Each displacement and each closure gives three equations (`equations.py`). The best poses
have the least sum of squares (Lu & Milios 1997, "Globally consistent range scan alignment"). If the
map is true and the odometry is as good as it claims, this sum is chi-square distributed. The sum
ranks equally minimal maps, and may cause a warning. It rejects no map.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from copy import copy
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.sparse import csc_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components
from scipy.sparse.linalg import splu
from scipy.special import gammaincc

from ssh_abduction.data.groups import first_index_of
from ssh_abduction.data.maps import Fit, Pose
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import FIT, FIT_OF_ONE, look_at_clock
from ssh_abduction.solver.geometry.equations import Equations
from ssh_abduction.solver.geometry.linear import (
    DENSE_INVERSE,
    dense,
    difference_matrix,
    inverse,
    least_squares,
    matrix,
    raised,
    system_solved,
    weighted,
)
from ssh_abduction.theory.evidence.loops import vectors_turned
from ssh_abduction.theory.prior import Pulls

Array: TypeAlias = NDArray[np.float64]

# With a standard deviation below this, in metres or radians, a displacement counts as exact.
EXACT = 2e-3
# But if the mean square error of such displacements is above NOISELESS variances, they have noise.
NOISELESS = 0.1
# SWEEPS is the number of iterations of the power method. HELD is the weight that keeps a rotation
# at its old value. It is small compared with a metre, which has a weight of some hundreds.
SWEEPS, HELD = 20, 1e-2
# Levenberg-Marquardt: the least and the highest damping, and the most rounds. It ends if a round
# lowers the sum of squares by less than the share STILL, or NEARLY for a hypothesis. HELD_STILL is
# a weight that keeps poses in place if no equation determines them.
LEAST_DAMPING, MOST_DAMPING, ROUNDS, STILL, NEARLY = 1e-12, 1e8, 100, 1e-10, 1e-4
HELD_STILL = 1e-9


class Poses:
    """Least squares over positions and headings that the steps of a trace share.

    The vector of unknowns has x and y of each position in metres, then the heading of each dstate
    in radians, then the motion (x, y, turn) of each alias, then the scale and the drift as
    multiples of their standard deviations. If the robot is off the poses of dstates, its pose at
    each step has a position and a heading of its own.
    """

    def __init__(
        self, said: Trace | Equations, headings: Sequence[int], positions: Sequence[Hashable]
    ) -> None:
        """Collect the equations. Nothing is solved yet.

        `said` is the trace, or the equations of its steps. For each step, `headings` has the number
        of its unknown heading (mostly its dstate), from 0 without gaps. `positions` has, for each
        of these headings, the name of the position that it belongs to (mostly the place of the
        dstate).
        """
        self._dstates = len(positions)
        labels = np.asarray(headings, dtype=int)
        of_steps = said if isinstance(said, Equations) else Equations.of(said)
        said = of_steps.beside(labels, self._dstates)
        if said.spreads.any():
            positions = [*positions, *((t, "robot") for t in range(len(labels)))]
        self._from, self._to = said.first, said.last
        self._moved, self._way, self._sigma = said.moved, said.way, said.sigma
        self._scaled, self._alias = said.scaled, said.alias
        self._whitening = np.linalg.inv(np.linalg.cholesky(said.noise))
        number = {position: i for i, position in enumerate(dict.fromkeys(positions))}
        self._place = np.array([number[position] for position in positions], dtype=int)
        self._positions, self._headings = len(number), len(positions)
        self._known = 2 * self._positions + self._headings
        self._size = self._known + 3 * int(self._alias.max(initial=0)) + 2
        # A group is the headings that displacements connect. A part of the map is the positions
        # that they connect.
        sure = self._alias == 0
        graph = _graph(self._from[sure], self._to[sure], self._headings)
        self._group = connected_components(graph, directed=False)[1]
        # The prior connects the pose of a step without a displacement to that of the last earlier
        # step of its group; or else of one at a place of this group; or else of the step before.
        steps = np.arange(self._dstates, self._headings) if said.spreads.any() else labels
        missing = np.setdiff1d(range(1, len(labels)), of_steps.last[of_steps.scaled == 1])
        group, place, before = self._group[labels], self._place[labels], list[int]()
        for t in missing.tolist():
            own = np.flatnonzero(group[:t] == group[t])
            near = np.flatnonzero(np.isin(place[:t], place[group == group[t]]))
            before.append([t - 1, *near[-1:].tolist(), *own[-1:].tolist()][-1])
        self._missing, self._origin = (steps[before], steps[missing]), int(labels[0])

    @cached_property
    def best(self) -> tuple[Array, float]:
        """The unknowns with the least sum of squares, and this sum."""
        return self.minimum(still=STILL)

    def misfit(self) -> float:
        """Compute the least chi-square."""
        return self.best[1]

    def likelihood(self, wide: Array) -> tuple[float, float]:
        """Compute the least chi-square, and -log of the marginal likelihood of the displacements.

        `wide` has the variances of x, y and heading of the prior (`Prior`).
        """
        unknown, square = self.best
        return square, square / 2 + self._volume(unknown, wide)

    def predicting(
        self, others: Sequence[Poses], rows: NDArray[np.int_], wide: Array, unknown: Array
    ) -> tuple[Array, Array]:
        """Compute how well the best poses predict some equations that they were not fitted to.

        Args:
            others: Poses with the same unknowns, (m,). They have these equations in different ways.
            rows: The numbers of these equations, (n,).
            wide: As in `likelihood`.
            unknown: The best unknowns.

        Returns:
            The chi-squares, and the nats by which the equations are less surely predicted than by
            their own covariance, each (m, n).
        """
        factor = self._factored(unknown, wide)
        squares, nats = np.zeros((2, len(others), len(rows)))
        for i, other in enumerate(others):
            by = other._jacobian(unknown, of_world=True)[: 3 * len(other._moved)]
            off = other._residuals(unknown)[: by.shape[0]].reshape(-1, 3)[rows]
            by = dense(by).reshape(-1, 3, self._size)[rows]
            spread = factor.solve(by.reshape(-1, self._size).T).T.reshape(by.shape)
            whole = np.identity(3) + np.einsum("nij,nkj->nik", by, spread)
            squares[i] = np.einsum("ni,ni->n", off, np.linalg.solve(whole, off[..., None])[..., 0])
            nats[i] = np.linalg.slogdet(whole)[1] / 2
        return squares, nats

    def settled(
        self, start: Array, fixed: Sequence[int], wanted: Sequence[int], wide: Array
    ) -> tuple[float, Array, Array]:
        """Find the unknowns with the least chi-square, and the covariance of the wanted ones.

        `start` has unknowns to begin with. `fixed` and `wanted` are indices of unknowns: those
        whose values are known, and those whose covariance is wanted. The likelihood is returned
        first, as in `likelihood`.
        """
        unknown, square = self.minimum(start)
        nats = square / 2 + self._volume(unknown, wide)
        return nats, unknown, self._covariance(unknown, fixed, wanted)

    def gaussian(self) -> tuple[list[int], Array, Array, Array]:
        """Find the poses of the dstates and their covariance, relative to a dstate of each part.

        Returns, for each dstate, its part of the map; the means, as one vector; the covariance; and
        the chi-square of each part. The vector has x and y of each place, in the order of the first
        dstates there, and then the heading of each dstate.
        """
        part, _, fixed = self._origins()
        facing = 2 * self._positions
        xy = range(2 * int(self._place[: self._dstates].max()) + 2)
        entries = [*xy, *range(facing, facing + self._dstates)]
        unknown, of = self.best[0], self._parts()
        errors = (self._residuals(unknown)[:-2] ** 2).reshape(-1, 3).sum(axis=1)
        squares = np.zeros(int(of.max()) + 1)
        np.add.at(squares, of[self._place[self._from]], errors)
        covariance = self._covariance(unknown, fixed, entries)
        return part, unknown[entries], covariance, squares

    def minimum(self, start: Array | None = None, still: float = NEARLY) -> tuple[Array, float]:
        """Find the unknowns with the least sum of squares, and this sum.

        `start` has unknowns to begin with; None to compute some. They are ignored if they are those
        of other poses. End if a round lowers the sum by less than the share `still`.
        """
        if start is not None and len(start) != self._size:
            return self.best
        unknown = self._begun() if start is None else start
        off = self._residuals(unknown)
        # Levenberg-Marquardt: damp a step more until it lowers the sum of squares.
        damping = LEAST_DAMPING
        for _ in range(ROUNDS if len(self._moved) else 0):
            jacobian = self._jacobian(unknown)
            normal, gradient = jacobian.T @ jacobian, jacobian.T @ off
            scale = normal.diagonal() + HELD_STILL
            while True:
                step = system_solved(normal, damping * scale, -gradient)
                better = self._residuals(unknown + step)
                gain = float(off @ off - better @ better)
                if gain >= 0 or damping > MOST_DAMPING:
                    break
                damping *= 10
            if gain < 0:
                break
            unknown, off, damping = unknown + step, better, max(damping / 10, LEAST_DAMPING)
            if gain <= still * (1 + float(off @ off)):
                break
        return unknown, float(off @ off)

    def fit(self) -> Fit:
        """Find the best poses, and compute how well they agree with the displacements."""
        unknown, square = self.best
        freedom = self._freedom(unknown)
        p = float(gammaincc(freedom / 2, square / 2)) if freedom > 0 else 1.0
        scale, bend = (float(x) for x in unknown[-2:] * self._sigma)
        return Fit(square, freedom, p, scale, bend, self._poses(unknown))

    def _begun(self) -> Array:
        """Compute initial values of the unknowns, as one vector."""
        unknown = np.zeros(self._size)
        # Solve for the headings first: that is linear, except for whole turns. Once the headings
        # are known, solving for the positions is linear, too (Carlone et al. 2014).
        reckoned = self._reckoned()
        off = self._moved[:, 2] + reckoned[self._from] - reckoned[self._to]
        off -= math.tau * np.round(off / math.tau)
        heading = reckoned + least_squares(
            difference_matrix(self._from, self._to, self._headings), off, self._weights(2)
        )
        if self._group.max() > 0:
            onward = vectors_turned(self._moved[:, :2], heading[self._from])
            heading += self._rotations(onward)[self._group]
        onward = vectors_turned(self._moved[:, :2], heading[self._from])
        at, facing, _ = self._split(unknown)
        at[:], facing[:] = least_squares(self._moves(), onward, self._weights(0)), heading
        # Begin the motion of an alias with one of its closures.
        for c in np.flatnonzero(self._alias).tolist():
            turn = heading[self._from[c]] + self._moved[c, 2] - heading[self._to[c]]
            there = vectors_turned(at[self._place[self._to[c]]][None], np.array([turn]))[0]
            gone = at[self._place[self._from[c]]] + onward[c] - there
            x = self._known + 3 * (int(self._alias[c]) - 1)
            unknown[x : x + 3] = *gone, turn
        return unknown

    def _reckoned(self) -> Array:
        """Compute the heading of each dstate in radians, relative to the first one of its group.

        Turns are added up along the fewest displacements. A group is the dstates that displacements
        connect.
        """
        heading = np.zeros(self._headings)
        rotated: dict[tuple[int, int], float] = {}
        sure = self._alias == 0
        first, last, angles = (of[sure] for of in (self._from, self._to, self._moved[:, 2]))
        graph = _graph(first, last, self._headings)
        for s, x, angle in zip(first.tolist(), last.tolist(), angles.tolist(), strict=True):
            rotated[x, s], rotated[s, x] = -angle, angle
        for start in np.unique(self._group, return_index=True)[1].tolist():
            order, before = breadth_first_order(graph, start, directed=False)
            for x, s in zip(order[1:].tolist(), before[order[1:]].tolist(), strict=True):
                heading[x] = heading[s] + rotated[s, x]
        return heading

    def _rotations(self, onward: Array) -> Array:
        """Find how to rotate each group of headings so that positions agree best, in radians.

        The rotations are complex numbers on the unit circle that minimise a quadratic form. The
        power method for its inverse finds them (Boumal 2016, "Nonconvex phase synchronization"). If
        positions do not determine a rotation, it is arbitrary. `onward` has the displacements in
        metres, (n, 2), turned by the present headings.
        """
        size = int(self._group.max()) + 1
        inverse = np.linalg.inv(self._misfit(onward) + HELD * np.identity(size))
        rotation: NDArray[np.complex128] = np.exp(
            1j * np.random.default_rng(0).uniform(-math.pi, math.pi, size)
        )
        for _ in range(SWEEPS):
            look_at_clock()
            rotation = inverse @ rotation
            rotation /= np.maximum(abs(rotation), 1e-300)
        angles: Array = np.angle(rotation)
        return angles

    def _misfit(self, onward: Array) -> NDArray[np.complex128]:
        """Compute the matrix of the quadratic form that says how badly rotations of groups fit.

        For given rotations, the form is the least sum of squares that any positions have. Vectors
        in the plane are complex numbers. `onward` has the displacements in metres, (n, 2), turned
        by the headings before the rotations.
        """
        weights = self._weights(0)
        vectors = weights * (onward[:, 0] + 1j * onward[:, 1])
        size = len(vectors), int(self._group.max()) + 1
        turns = matrix(vectors, np.arange(size[0]), self._group[self._from], size)
        moves = weighted(weights, self._moves())
        mixed = dense(moves.T @ turns)
        square = moves.T @ moves
        held = 1e-9 * max(float(square.diagonal().max()), 1.0)
        best = system_solved(square, np.full(self._positions, held), mixed)
        form: NDArray[np.complex128] = dense(turns.conj().T @ turns) - mixed.conj().T @ best
        return form

    def _moves(self) -> Any:
        """Make the matrix that maps the x (or y) of positions to the x (or y) of displacements."""
        return difference_matrix(self._place[self._from], self._place[self._to], self._positions)

    def _weights(self, axis: int) -> Array:
        """Return about 1 / the standard deviation of displacements in x, y or turn (0, 1, 2).

        Closures that are not believed have weight 0.
        """
        weights: Array = np.sqrt((self._whitening[:, :, axis] ** 2).sum(1)) * (self._alias == 0)
        return weights

    def _split(self, unknown: Array) -> tuple[Array, Array, Array]:
        """Return views of the positions, (n, 2), and headings, and the motion of each equation.

        The motion (x, y, turn) is that of its alias; 0 without one, (equations, 3).
        """
        xy = 2 * self._positions
        motions = np.append(np.zeros(3), unknown[self._known : -2]).reshape(-1, 3)
        return unknown[:xy].reshape(-1, 2), unknown[xy : self._known], motions[self._alias]

    def _predicted(self, unknown: Array) -> tuple[Array, Array, Array]:
        """Predict the displacements from the unknowns, in metres and radians, (n, 3).

        Also return the cosine and sine of the heading halfway through each displacement.
        """
        _, heading, motions = self._split(unknown)
        scale, bend = unknown[-2:] * self._sigma
        gone = self._gone(unknown)
        facing = heading[self._from] - bend * self._way / 2
        cos, sin = np.cos(facing), np.sin(facing)
        ahead, left = cos * gone[:, 0] + sin * gone[:, 1], cos * gone[:, 1] - sin * gone[:, 0]
        rotated = heading[self._to] - heading[self._from] + bend * self._way + motions[:, 2]
        scale = 1 + scale * self._scaled
        return np.stack([scale * ahead, scale * left, rotated], axis=1), cos, sin

    def _residuals(self, unknown: Array) -> Array:
        """Compute predicted minus actual displacements, and the priors, in standard deviations."""
        look_at_clock(FIT + FIT_OF_ONE * len(self._moved))
        predicted = self._predicted(unknown)[0]
        off = predicted - self._moved
        off[:, 2] -= math.tau * np.round(off[:, 2] / math.tau)
        return np.concatenate([np.einsum("nij,nj->ni", self._whitening, off).ravel(), unknown[-2:]])

    def _jacobian(self, unknown: Array, of_world: bool = False) -> Any:
        """Compute the derivative of the residuals with respect to the unknowns.

        If `of_world`, the errors of displacements are in metres of the world, without the scale.
        """
        predicted, cos, sin = self._predicted(unknown)
        # Unknowns are the positions of places (two each), the headings of dstates, scale and drift.
        scale = 1 + unknown[-2] * self._sigma[0] * self._scaled
        if of_world:
            predicted[:, :2] /= scale[:, None]
        m, heading = len(self._moved), 2 * self._positions
        zero, turn = np.zeros(m), np.tile([0.0, 0.0, 1.0], (m, 1))
        ahead, left = predicted[:, 0], predicted[:, 1]
        by_x = np.stack([scale * cos, -scale * sin, zero], 1)
        by_y = np.stack([scale * sin, scale * cos, zero], 1)
        by_facing = np.stack([left, -ahead, zero], 1)
        by_scale = np.stack([ahead, left, zero], 1)
        by_scale *= (self._sigma[0] * self._scaled / scale)[:, None]
        if of_world:
            by_x, by_y = by_x / scale[:, None], by_y / scale[:, None]
        by_bend = (-by_facing / 2 + turn) * self._way[:, None] * self._sigma[1]
        # An alias moves the last step of a closure. So x there moves it along the turned axes.
        c = np.flatnonzero(self._alias)
        motion = self._known + 3 * (self._alias[c] - 1)
        at, _, motions = self._split(unknown)
        angle = motions[:, 2:]
        to_x = np.cos(angle) * by_x + np.sin(angle) * by_y
        to_y = np.cos(angle) * by_y - np.sin(angle) * by_x
        x, y = at[self._place[self._to[c]]].T[..., None]
        columns = [
            (2 * self._place[self._to], to_x),
            (2 * self._place[self._to] + 1, to_y),
            (2 * self._place[self._from], -by_x),
            (2 * self._place[self._from] + 1, -by_y),
            (heading + self._from, by_facing - turn),
            (heading + self._to, turn),
            (np.full(m, self._size - 2), by_scale),
            (np.full(m, self._size - 1), by_bend),
        ]
        values = np.einsum("nij,knj->kni", self._whitening, [by for _, by in columns]).ravel()
        rows = np.tile(np.arange(3 * m), len(columns))
        of = np.repeat(np.concatenate([column for column, _ in columns]), 3)
        if len(c):
            by_motion = [by_x[c], by_y[c], x * to_y[c] - y * to_x[c] + turn[c]]
            more = np.einsum("nij,knj->kni", self._whitening[c], by_motion)
            values = np.append(values, more)
            rows = np.append(rows, np.tile((3 * c[:, None] + np.arange(3)).ravel(), 3))
            of = np.append(of, np.repeat(np.concatenate([motion + k for k in range(3)]), 3))
        # Scale and drift have a prior each: a last row with a single 1.
        rows, of = np.append(rows, [3 * m, 3 * m + 1]), np.append(of, self._size - np.array([2, 1]))
        return matrix(np.append(values, [1.0, 1.0]), rows, of, (3 * m + 2, self._size))

    def _factored(self, unknown: Array, wide: Array) -> Any:
        """Factor the information matrix of the unknowns.

        Where a displacement is missing, the prior connects a step to an earlier one. So the matrix
        is regular. Its determinant does not depend on where groups lie that nothing connects.
        """
        whole, missing = copy(self), self._missing
        none = np.zeros(len(missing[0]))
        whole._from = np.concatenate([self._from, missing[0]])
        whole._to = np.concatenate([self._to, missing[1]])
        whole._way = np.concatenate([self._way, none])
        whole._scaled = np.concatenate([self._scaled, none])
        whole._alias = np.concatenate([self._alias, none.astype(int)])
        roots = np.tile(np.diag(wide**-0.5), (len(none), 1, 1))
        whole._whitening = np.concatenate([self._whitening, roots])
        whole._moved = np.zeros((len(whole._from), 3))
        jacobian = whole._jacobian(unknown, of_world=True)
        first = np.zeros(self._size)
        x = 2 * int(self._place[self._origin])
        first[[x, x + 1, 2 * self._positions + self._origin]] = 1 / wide
        return splu(csc_array(raised(jacobian.T @ jacobian, first)))

    def _volume(self, unknown: Array, wide: Array) -> float:
        """Compute -log of the marginal likelihood without the misfit.

        The result lacks what does not depend on the map (`Prior.base`).
        By Laplace's approximation, the integral over the poses is a Gaussian around the best ones
        (MacKay 2003, chapter 28).
        """
        factor = self._factored(unknown, wide)
        size = float(np.log(np.abs(factor.U.diagonal())).sum()) / 2
        places = len({*self._place[: self._dstates].tolist()})
        robots = self._headings - self._dstates
        size += int(self._alias.max(initial=0)) * float(np.log(wide).sum()) / 2
        each = math.log(wide[0]), math.log(wide[2]) / 2, -1.5 * math.log(math.tau)
        return size + places * each[0] + self._dstates * each[1] + robots * each[2]

    def _parts(self) -> NDArray[np.int_]:
        """For each position, find its part of the map. No displacement connects two parts."""
        sure = self._alias == 0
        graph = _graph(self._place[self._from[sure]], self._place[self._to[sure]], self._positions)
        part: NDArray[np.int_] = connected_components(graph, directed=False)[1]
        return part

    def _freedom(self, unknown: Array) -> int:
        """Count the degrees of freedom: equations minus the unknowns that they determine.

        The equations determine neither where each part of the map is nor how it is turned, nor how
        some groups of headings are turned. A displacement with hardly any noise (EXACT) determines
        as many unknowns as it has equations. So it adds no freedom, unless such displacements have
        the little noise that they claim.
        """
        said = np.union1d(self._from, self._to)
        used = np.unique(self._place[said])
        parts = len(np.unique(self._parts()[used]))
        exact = (1 / np.sqrt((self._whitening**2).sum(1)) < EXACT).ravel()
        errors = self._residuals(unknown)[: len(exact)][exact]
        if exact.any() and (errors**2).mean() > NOISELESS:
            exact[:] = False
        settled = 0
        if exact.any():
            look_at_clock()
            rows = dense(self._jacobian(unknown)[: len(exact)][exact])
            # Turns at one place say nothing about positions. So most rows and columns are zero.
            rows = rows[rows.any(axis=1)][:, rows.any(axis=0)]
            settled = int(np.linalg.matrix_rank(rows)) if rows.size else 0
        open_ones = 2 * parts + self._open_rotations(unknown, said, parts)
        determined = 2 * len(used) + len(said) - open_ones
        motions = int(self._alias.max(initial=0))  # each has three unknowns
        return len(exact) - int(exact.sum()) - (determined + 3 * motions - settled)

    def _open_rotations(self, unknown: Array, said: NDArray[np.int_], parts: int) -> int:
        """Count the independent rotations of groups of headings that displacements leave open."""
        groups = np.unique(self._group[said])
        if len(groups) == parts:
            return parts
        form = self._misfit(self._gone(unknown)).real[np.ix_(groups, groups)]
        return int((np.linalg.eigvalsh(form) < 1e-6 * max(float(form.diagonal().max()), 1.0)).sum())

    def _gone(self, unknown: Array) -> Array:
        """Return how far positions lie from each other along each displacement, (n, 2)."""
        at, _, motions = self._split(unknown)
        there = at[self._place[self._to]]
        if motions.any():
            there = vectors_turned(there, motions[:, 2]) + motions[:, :2]
        gone: Array = there - at[self._place[self._from]]
        return gone

    def _origins(self) -> tuple[list[int], list[int], list[int]]:
        """Return for each dstate its part of the map, and the first dstate of this part.

        Also list the unknowns of the poses of these first dstates.
        """
        part = self._parts()[self._place[: self._dstates]].tolist()
        first = first_index_of(part)
        xs = [2 * int(self._place[s]) for s in first.values()]
        headings = [2 * self._positions + s for s in first.values()]
        return part, [first[of] for of in part], [*xs, *(x + 1 for x in xs), *headings]

    def _poses(self, unknown: Array) -> tuple[Pose, ...]:
        """Compute the pose and covariance of each dstate, relative to the first of its part."""
        _, origin, fixed = self._origins()
        place, heading = self._place[: self._dstates], self._split(unknown)[1]
        at, back = self._split(unknown)[0][place], -heading[origin]
        moved = vectors_turned(at - at[origin], back)
        facing = heading[: self._dstates] + back
        # Turn both the rows and the columns of the covariance of each position.
        whole = self._covariance(unknown, fixed, range(2 * int(place.max()) + 2))
        xy = 2 * place[:, None] + [0, 1]
        spreads = whole[xy[:, :, None], xy[:, None, :]]
        for _ in range(2):
            spreads = vectors_turned(spreads, back[:, None]).transpose(0, 2, 1)
        return tuple(
            Pose(float(x), float(y), math.remainder(float(angle), math.tau), covariance)
            for (x, y), angle, covariance in zip(
                moved, facing, map(tuple, spreads[:, [0, 0, 1], [0, 1, 1]].tolist()), strict=True
            )
        )

    def _covariance(self, unknown: Array, fixed: Sequence[int], wanted: Sequence[int]) -> Array:
        """Compute the covariance of the wanted unknowns, given that the fixed ones are known."""
        look_at_clock()
        jacobian = self._jacobian(unknown)
        free = np.setdiff1d(np.arange(self._size), fixed)
        information = (jacobian.T @ jacobian)[free][:, free]
        held = 1e-12 * max(float(information.diagonal().max()), 1.0) if len(free) else 0.0
        is_free = ~np.isin(wanted, fixed)
        rows = np.searchsorted(free, np.asarray(wanted)[is_free])
        covariance: Array = np.zeros((len(wanted), len(wanted)))
        covariance[np.ix_(is_free, is_free)] = inverse(information, np.full(len(free), held), rows)
        return covariance


def may_be_joined(poses: Poses) -> bool:
    """Whether `conditional` holds for these poses, and is not too slow."""
    return not len(poses._missing[0]) and poses._size <= DENSE_INVERSE


def conditional(
    poses: Poses, entries: Sequence[int], pulls: Pulls | None = None
) -> tuple[Array, Array]:
    """Compute how far some unknowns may be off if all before them in a list are known.

    The pose of the first step is known. `entries` are n entries of the vector of `gaussian`.
    This is for poses without aliases, and no displacement may be missing. Negative pulls make poses
    less sure, but only in the products below.

    Raises:
        numpy.linalg.LinAlgError: Some unknowns are known too exactly, or pulls are too strong.

    Returns:
        The logarithms of the standard deviations, (n,).
        The products of the gradients of n + 1 functions of the unknowns, by their covariance,
        (n + 1, n + 1): half of the logarithm of the determinant of the information matrix, with
        the pulls, and then these n logarithms, less the pulls of their dstates.
    """
    unknown, x = poses.best[0], 2 * int(poses._place[poses._origin])
    free = np.setdiff1d(range(poses._size), [x, x + 1, 2 * poses._positions + poses._origin])
    places = 2 * int(poses._place[: poses._dstates].max()) + 2
    of = np.array(entries, dtype=int)
    of = np.searchsorted(free, of + (of >= places) * (2 * poses._positions - places))
    jacobian = dense(poses._jacobian(unknown, of_world=True))[:, free]
    look_at_clock(poses._size**2 // 4)  # microunits: most of the time goes to filling matrices
    # The columns of this root are a basis of the unknowns, in which they have unit covariance.
    information = jacobian.T @ jacobian
    root = np.linalg.inv(np.linalg.cholesky(information)).T
    lower = np.linalg.cholesky(root[of] @ root[of].T)
    # The derivative of such a logarithm is that of -½ v'Hv, for a fixed vector v (below).
    vectors = np.zeros((poses._size, len(of)))
    vectors[free] = root @ solve_triangular(lower, root[of], lower=True).T
    whole = np.zeros((poses._size, len(free)))
    whole[free] = root
    bent = np.column_stack([_bent(poses, unknown, whole).sum(1), -_bent(poses, unknown, vectors)])
    if pulls is not None and len(pulls.first):
        slope, weaker = _pulled(poses, unknown, pulls)
        bent[:, 0] += slope.sum(axis=1)
        for k, entry in enumerate(entries):
            if entry >= places:
                bent[:, k + 1] -= slope[:, pulls.of == entry - places].sum(axis=1)
        root = np.linalg.inv(np.linalg.cholesky(information - weaker[free][:, free])).T
    slopes = root.T @ bent[free]
    return np.log(lower.diagonal()), slopes.T @ slopes


def _pulled(poses: Poses, unknown: Array, pulls: Pulls) -> tuple[Array, Array]:
    """Compute the gradients of n pulls, (size, n), and the information that they may take."""
    other, n = copy(poses), len(pulls.first)
    other._from, other._to, other._moved = pulls.first, pulls.last, pulls.moved
    other._way, other._scaled, other._alias = np.zeros(n), np.zeros(n), np.zeros(n, dtype=int)
    other._whitening = np.tile(np.identity(3), (n, 1, 1))
    by, off = dense(other._jacobian(unknown))[:-2], other._residuals(unknown)[:-2]
    weight = pulls.weight.ravel()
    taken = np.where(np.repeat(pulls.of < 0, 3), np.maximum(-weight, 0.0), abs(weight))
    slopes = by.T * (weight * off)
    return slopes.reshape(-1, n, 3).sum(axis=2), by.T @ (taken[:, None] * by)


def _bent(poses: Poses, unknown: Array, vectors: Array) -> Array:
    """Compute the gradients of ½ v'Hv for n fixed vectors v, (size, n).

    H is the information matrix, which changes with the unknowns: turned displacements move
    positions elsewhere. `vectors` has the n vectors, (size, n).
    """
    gone, (_, cos, sin) = poses._gone(unknown).T[..., None], poses._predicted(unknown)
    cos, sin = cos[:, None], sin[:, None]
    heading, scale = 2 * poses._positions, poses._sigma[0] * poses._scaled[:, None]
    to, from_ = poses._place[poses._to], poses._place[poses._from]
    drift = poses._sigma[1] * poses._way[:, None]
    # By v, displacements change in the world, and then seen by the robot.
    turned = vectors[heading + poses._from] - drift / 2 * vectors[-1]
    longer = scale * vectors[-2] / (1 + unknown[-2] * scale)
    x = vectors[2 * to] - vectors[2 * from_] + turned * gone[1] + longer * gone[0]
    y = vectors[2 * to + 1] - vectors[2 * from_ + 1] - turned * gone[0] + longer * gone[1]
    angle = vectors[heading + poses._to] - vectors[heading + poses._from] + drift * vectors[-1]
    seen = np.stack([cos * x + sin * y, cos * y - sin * x, angle], 1)
    weight = (poses._whitening.transpose(0, 2, 1) @ poses._whitening @ seen).transpose(1, 0, 2)
    by_x, by_y = cos * weight[0] - sin * weight[1], sin * weight[0] + cos * weight[1]
    by_facing = weight[0] * seen[:, 1] - weight[1] * seen[:, 0]
    into = np.concatenate([heading + poses._from, 2 * to, 2 * to + 1, 2 * from_, 2 * from_ + 1])
    by_to = [longer * by_x - turned * by_y, longer * by_y + turned * by_x]
    of = csr_array((np.ones(len(into)), (into, np.arange(len(into)))), (poses._size, len(into)))
    bent: Array = of @ np.concatenate([by_facing, *by_to, -by_to[0], -by_to[1]])
    along = longer * scale / (1 + unknown[-2] * scale)
    bent[-2] = -(along * (by_x * gone[0] + by_y * gone[1])).sum(0)
    bent[-1] = -(drift / 2 * by_facing).sum(0)
    return bent


def laid_with_motions(poses: Poses) -> tuple[Array, Array, NDArray[np.int_], Array]:
    """Return the best positions, (places, 2), headings and places of dstates, and motions.

    The motions (x, y, turn) are those of aliases, (aliases, 3).
    """
    unknown, place = poses.best[0], poses._place[: poses._dstates]
    at, facing, _ = poses._split(unknown)
    motions = unknown[poses._known : -2].reshape(-1, 3)
    return at[: int(place.max()) + 1], facing[: poses._dstates], place, motions


def framed(poses: Poses) -> tuple[Array, NDArray[np.int_]]:
    """Return the best pose of each dstate, (dstates, 3), and its group of connected headings."""
    at, facing, place, _ = laid_with_motions(poses)
    return np.column_stack([at[place], facing]), poses._group[: len(place)]


def _graph(first: NDArray[np.int_], second: NDArray[np.int_], size: int) -> csr_array:
    """Make a graph of `size` nodes from the ends of its edges, as a sparse matrix."""
    return csr_array((np.ones(len(first)), (first, second)), shape=(size, size))
