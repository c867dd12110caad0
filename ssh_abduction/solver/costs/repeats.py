"""A lower bound on the cost of all maps from what the robot does again and again.

If two steps are at one dstate and the same action follows, the robot moves to one dstate from both.
So both displacements measure the same relative pose. Each map pays for the scatter of these
displacements, however it joins steps. No join needs to be forced for this.

*Shares.* A dstate costs its price, and half of the squared differences of the displacements from
their mean, in standard deviations. So dstates are facilities that steps share (`facilities.py`): no
map costs less than the sum of the shares of all steps, if the steps of no dstate have shares of
more than it costs. The displacements of different actions have means of their own. In turns on the
spot only the heading counts here, as each map pays for the rest of their misfit.

*Cliques.* Steps at one dstate are pairwise not apart (`forced.py`). So all steps of a dstate are in
one maximal clique of the graph of pairs that are not apart. In each clique, those steps that save
most with a certain mean are found. If a part of the graph has too many maximal cliques, the steps
whose neighbours differ most get no share.

*Valid shares* need a proof for all means. The means of a clique are divided into boxes. If the
steps of a clique may save more than the price, all of its shares are divided by this excess.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.solver.costs.facilities import Program
from ssh_abduction.solver.geometry.equations import Equations, spreads_of
from ssh_abduction.theory.settle import Problem

Array = NDArray[np.float64]
Ints = NDArray[np.int_]
Flags = NDArray[np.bool_]

# A part of the graph has at most CLIQUES maximal cliques. While it has more, drop the share DROPPED
# of its steps.
CLIQUES, DROPPED = 250, 0.04
# In each pass over all parts, the shares of a part are improved at most this many times, until
# they could grow by the share ENOUGH. New shares lie at the share INWARD of the way from shares
# that hold to shares that may not.
ROUNDS, ENOUGH, INWARD = (10, 40), 0.01, 0.3
# Each clique is searched from the best STARTS means of each action, in STEPS steps.
STARTS, STEPS = 3, 8
# Boxes of means are halved until what may be saved is known to TOLERANCE nats. For an action, at
# most about MOST moves are looked at, and AT_ONCE at once.
TOLERANCE, MOST, AT_ONCE = 0.02, 30_000_000, 200_000
TINY = 1e-9


def has_independent_errors(problem: Problem) -> bool:
    """Whether the bound holds for a trace and its theory: only if all errors are independent."""
    trace = problem.trace
    drifts = trace.odometry is None or trace.odometry.bend
    return not (drifts or trace.closures or problem.theory.jumped or spreads_of(trace).any())


@dataclass(frozen=True, eq=False)
class RepeatedMoves:
    """What the robot does after each of n steps, by its odometry.

    Attributes:
        kind: The action, as a number; -1 if there is no displacement, (n,).
        moved: The displacement in metres and radians, (n, 3).
        weights: The inverse variances of its coordinates; 0 for those that say nothing, (n, 3).
    """

    kind: Ints
    moved: Array
    weights: Array

    @staticmethod
    def of(trace: Trace, visit: Sequence[int], price: float) -> RepeatedMoves:
        """Collect the displacements of a trace. `visit` has the first step of each step's visit."""
        said, number = Equations.of(trace), dict[str, int]()
        kind, (moved, weights) = np.full(len(trace), -1), np.zeros((2, len(trace), 3))
        for t, after, move, noise in zip(
            said.first.tolist(), said.last.tolist(), said.moved, said.noise, strict=True
        ):
            deviation = np.sqrt(noise.diagonal())
            # Independent errors with these variances are at least as large as those with `noise`.
            variances = abs(noise / deviation).sum(1) * deviation
            heading = move[2]
            if visit[t] == visit[after]:
                slope = np.linalg.solve(noise[:2, :2], noise[:2, 2])
                heading -= move[:2] @ slope
                variances = np.array([math.inf, math.inf, noise[2, 2] - noise[2, :2] @ slope])
            if variances[2] * price > 1:  # then steps whose headings are opposite may share
                variances[2] = math.inf
            kind[t] = number.setdefault(trace.actions[t].name, len(number))
            moved[t], weights[t] = (*move[:2], heading), 1 / variances
        return RepeatedMoves(kind, np.where(weights > 0, moved, 0.0), weights)

    def only(self, some: Ints) -> RepeatedMoves:
        """Return the moves after some steps."""
        return RepeatedMoves(self.kind[some], self.moved[some], self.weights[some])

    def compared(self) -> RepeatedMoves:
        """Return moves of one kind relative to one of them, so that headings are about 0.

        If their headings differ by more than half a turn, the headings do not count.
        """
        moved, weights = self.moved - self.moved[0], self.weights.copy()
        heading = np.sort(moved[:, 2] % math.tau)
        gaps = np.diff(heading, append=heading[0] + math.tau)
        middle = heading[gaps.argmax()] + gaps.max() / 2 + math.pi
        moved[:, 2] -= middle
        moved[:, 2] -= math.tau * np.round(moved[:, 2] / math.tau)
        if gaps.max() < math.pi:
            weights[:, 2] = 0.0
        return RepeatedMoves(self.kind, moved * (weights > 0), weights)

    def pays(self, means: Array) -> Array:
        """Return what each of n moves pays for each of m means, (m, n)."""
        pulls = self.weights * self.moved
        fixed = (pulls * self.moved).sum(1)
        pays: Array = (means**2 @ self.weights.T + fixed) / 2 - means @ pulls.T
        return pays

    def means(self, members: Flags) -> Array:
        """Return the means of the members of m clusters, (m, n), as (m, 3)."""
        members = members.astype(float)
        weights = members @ self.weights
        means: Array = members @ (self.weights * self.moved) / np.maximum(weights, TINY)
        return means

    def most_saved(self, shares: Array, masks: Array, floor: Array) -> Array:
        """Bound what the members of each of k clusters save, wherever the mean is, (k,).

        `masks` is 1 for members, (n, k). At least `floor`, (k,), is known to be saved, or bounds
        below it are of no use. So the bounds are at least this plus TOLERANCE.
        """
        # Each coordinate of the mean of some moves is between theirs. Begin with one box for all.
        least, most = self.moved.min(0), self.moved.max(0)
        centres, half = (least + most)[None] / 2, (most - least) / 2
        box, cluster = np.zeros(masks.shape[1], dtype=int), np.arange(masks.shape[1])
        looked, bounds = 0, floor + TOLERANCE
        while True:
            looked += len(box) * len(shares)
            pieces = np.array_split(np.arange(len(box)), 1 + len(box) * len(shares) // AT_ONCE)
            found = [
                self._saved_in(shares, centres, half, box[some], masks.T[cluster[some]])
                for some in pieces
            ]
            upper, lower = np.concatenate(found, axis=1)
            np.maximum.at(bounds, cluster, lower + TOLERANCE)
            is_open = upper > bounds[cluster]
            if looked > MOST or not is_open.any():
                break
            axis = int(np.argmax(half**2 * self.weights.mean(0)))
            kept, box = np.unique(box[is_open], return_inverse=True)
            cluster, half = np.tile(cluster[is_open], 2), half.copy()
            half[axis] /= 2
            shift = half * (np.arange(3) == axis)
            centres = np.concatenate([centres[kept] - shift, centres[kept] + shift])
            box = np.concatenate([box, box + len(kept)])
        np.maximum.at(bounds, cluster, upper)
        return bounds

    def _saved_in(
        self, shares: Array, centres: Array, half: Array, box: Ints, members: Array
    ) -> Array:
        """Bound what p clusters with these members, (p, n), save in p boxes, which are sorted.

        Returns a bound for all means in the box, and what is saved at its centre, (2, p).

        A member saves max(q, 0), where q is a concave quadratic function of the mean. If q is
        between -a and b in the box, this is at most (q + a) b / (a + b). The maximum of the sum of
        these functions is known.
        """
        look_at_clock()
        centres, box = centres[box[0] : box[-1] + 1], box - box[0]
        off = self.moved - centres[:, None]
        at_best, at_worst, saved = (
            shares - (away**2 * self.weights).sum(-1) / 2
            for away in (np.maximum(abs(off) - half, 0.0), abs(off) + half, off)
        )
        short = np.maximum(-at_worst, 0.0)
        part = np.maximum(at_best, 0.0) / np.maximum(at_best + short, TINY)
        weights = np.moveaxis(part[:, :, None] * self.weights, 2, 0)
        slopes = weights * np.moveaxis(off, 2, 0)
        terms = np.stack([part * (saved + short), saved.clip(0.0), *weights, *slopes], 1)
        sums = np.einsum("pin,pn->pi", terms[box], members)
        weight, slope = sums[:, 2:5], sums[:, 5:]
        step = np.clip(slope / np.maximum(weight, TINY), -half, half)
        upper = sums[:, 0] + (slope * step - weight * step**2 / 2).sum(1)
        return np.stack([upper, sums[:, 1]])


class SharedPart:
    """A group of steps that is connected by pairs that are not apart, and the shares of the steps.

    Attributes:
        cliques: Which steps are in each maximal clique, (n, k). A step in none gets no share.
    """

    def __init__(self, moves: RepeatedMoves, together: Flags, price: float) -> None:
        """Find the cliques. `together` flags the pairs that are not apart, (n, n)."""
        self._price = price
        self.cliques = _cliques(together).astype(float)
        kinds = [np.flatnonzero(moves.kind == kind) for kind in np.unique(moves.kind)]
        self._kinds = [(some, moves.only(some).compared()) for some in kinds]

    def shares(self, labels: Ints, rounds: int) -> Array:
        """Compute shares of the steps, (n,), in at most this many rounds.

        `labels` are their dstates in a known map.
        """
        in_some = self.cliques.any(1)
        program = Program(self._price, np.where(in_some, self._price, 0.0))
        known = (labels == np.unique(labels[in_some])[:, None]) & in_some
        self._add(program, known)
        # Begin with equal shares of the steps of each dstate of the map.
        shares = (self._price + self._paid(known)) / known.sum(1) @ known
        best = np.zeros(len(shares))
        for _ in range(rounds):
            look_at_clock()
            saved, members = self._saved(shares)
            scaled = self._scaled(shares, saved.sum(0))
            best = max(best, scaled, key=np.sum)
            is_new = self._add(program, members[saved.sum(0) > self._price + TINY])
            most = program.solved()
            if best.sum() >= most.sum() * (1 - ENOUGH):
                break
            shares = INWARD * most + (1 - INWARD) * best if is_new else most
        return self._proven(best)

    def _add(self, program: Program, members: Flags) -> bool:
        """Add clusters, (m, n), to the linear program. Return if one is new."""
        return program.add(members, self._paid(members), np.zeros((len(members), 0)))

    def _scaled(self, shares: Array, saved: Array) -> Array:
        """Divide shares by the excess of what the members of their cliques save, (k,)."""
        excess = np.maximum(saved / self._price, 1.0)
        scaled: Array = shares / np.maximum((self.cliques * excess).max(1), 1.0)
        return scaled

    def _proven(self, shares: Array) -> Array:
        """Make shares valid for all means."""
        saved = self._saved(shares)[0]
        # Where little is saved, a rough bound is enough.
        floor = saved + np.maximum(self._price - saved.sum(0), 0.0) / len(self._kinds)
        bounds = [
            moves.most_saved(shares[some], self.cliques[some], low)
            if moves.weights.any()
            else shares[some] @ self.cliques[some]
            for (some, moves), low in zip(self._kinds, floor, strict=True)
        ]
        return self._scaled(shares, np.sum(bounds, axis=0))

    def _paid(self, members: Flags) -> Array:
        """Compute what the members of m clusters pay, (m, n), with the best means, (m,)."""
        paid = np.zeros(len(members))
        for some, moves in self._kinds:
            inside = members[:, some]
            paid += np.where(inside, moves.pays(moves.means(inside)), 0.0).sum(1)
        return paid

    def _saved(self, shares: Array) -> tuple[Array, Flags]:
        """Search the means with which the members of each clique save most.

        Returns what is saved for each kind of moves, (kinds, k), and by which steps, (k, n).
        """
        saved = np.zeros((len(self._kinds), self.cliques.shape[1]))
        found = np.zeros(self.cliques.T.shape, dtype=bool)
        for row, (some, moves) in enumerate(self._kinds):
            saved[row], found[:, some] = self._saved_of(moves, shares[some], self.cliques[some])
        return saved, found

    def _saved_of(self, moves: RepeatedMoves, shares: Array, cliques: Array) -> tuple[Array, Flags]:
        """Do the same for moves of one kind: return arrays (k,) and (k, n)."""
        first = np.maximum(shares - moves.pays(moves.moved), 0.0) @ cliques
        means = moves.moved[np.argsort(-first, axis=0)[:STARTS]].reshape(-1, 3)
        inside = np.tile(cliques.T > 0, (len(means) // cliques.shape[1], 1))
        for _ in range(STEPS):
            means = moves.means(inside & (moves.pays(means) < shares))
        pays = moves.pays(means)
        members = inside & (pays < shares - TINY)
        saved = np.where(members, shares - pays, 0.0).sum(1).reshape(-1, cliques.shape[1])
        best = saved.argmax(0), np.arange(cliques.shape[1])
        return saved[best], members.reshape(*saved.shape, -1)[best]


def shares_of(
    trace: Trace, visit: Sequence[int], apart: Flags, labels: Ints, price: float
) -> Iterator[tuple[Ints, Array]]:
    """Yield the steps of each part and their shares of the prices of dstates, small parts first.

    Then yield the same again with greater shares.

    Args:
        trace: The trace.
        visit: The first step of the visit of each step.
        apart: Which pairs of steps are not at one dstate, (n, n).
        labels: The dstate of each step in a known map.
        price: The price of a dstate.
    """
    moves = RepeatedMoves.of(trace, visit, price)
    part = connected_components(csr_array(~apart), directed=False)[1]
    order = np.argsort(np.bincount(part), kind="stable")
    parts = [np.flatnonzero(part == number) for number in order]
    for rounds in ROUNDS:
        for some in parts:
            found = SharedPart(moves.only(some), ~apart[np.ix_(some, some)], price)
            yield some, found.shares(labels[some], rounds)


def _cliques(together: Flags) -> Flags:
    """List the maximal cliques of a graph, (n, k), without some nodes if there are too many."""
    import networkx as nx  # slow to load, and only this bound needs it

    kept = np.arange(len(together))
    while True:
        look_at_clock()
        graph = together[np.ix_(kept, kept)]
        graph[np.diag_indices(len(kept))] = True
        # Nodes with the same neighbours are in the same cliques.
        _, first, alike = np.unique(graph, axis=0, return_index=True, return_inverse=True)
        one_of_each = nx.from_numpy_array(graph[np.ix_(first, first)])
        found = list(islice(nx.find_cliques(one_of_each), CLIQUES + 1))
        if len(found) <= CLIQUES:
            break
        # Drop the nodes that have the most pairs of neighbours that are apart.
        near = graph.astype(float)
        differ = near.sum(1) ** 2 - ((near @ near) * near).sum(1)
        kept = np.sort(kept[np.argsort(differ, kind="stable")[: int((1 - DROPPED) * len(kept))]])
    cliques = np.zeros((len(together), len(found)), dtype=bool)
    members = np.array([np.isin(range(len(first)), clique) for clique in found])
    cliques[kept] = members[:, alike.ravel()].T
    return cliques
