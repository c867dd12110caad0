"""A lower bound on the cost of clustering points: the dual of facility location.

Each cluster has a *facility*, which has a price and may be at any point of space. Each point pays
half of its squared distance to its facility, in standard deviations. The *shares* of the points are
numbers with one property: wherever a facility is, the points that pay less than their share there
together save at most its price. So no clustering costs less than the sum of all shares. Linear
programming finds the greatest shares (Cornuejols, Nemhauser & Wolsey 1990, "The uncapacitated
facility location problem").
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from ssh_abduction.runtime.clock import LONG_TURN, look_at_clock

Array: TypeAlias = NDArray[np.float64]

# The linear program gets further clusters at most ROUNDS times. It ends if the shares could grow
# by less than the share ENOUGH. Finding more clusters by boxes is done at most RETRIES times.
ROUNDS, ENOUGH, RETRIES = 40, 0.003, 3
# Boxes first have half sides of these lengths, in metres, metres and radians. They are halved until
# no facility in one saves more than TOLERANCE beyond its price, and at most BOXES are looked at.
HALF, TOLERANCE, BOXES = (0.25, 0.25, 0.1), 0.003, 300_000
AT_ONCE = 2000
TINY = 1e-9
# A facility moves at most STEPS times, until it moves by less than STILL.
STEPS, STILL = 50, 1e-5
# Of starts that are within a standard deviation divided by GRID, one is enough.
GRID = 2.0


@dataclass(frozen=True, eq=False)
class Facilities:
    """Points that share facilities.

    Attributes:
        points: x and y in metres, or x, y and a heading in radians, (n, 2) or (n, 3).
        variances: The variance of each coordinate of each point, (n, 2) or (n, 3).
        kinds: The kind of each point, (n,). Each facility is of one kind, too.
        fees: What each point pays in addition at a facility of another kind, (n,); inf if it cannot
            use one.
        price: The price of a facility.
    """

    points: Array
    variances: Array
    kinds: NDArray[np.int_]
    fees: Array
    price: float

    def shares(self, most: Array) -> Array:
        """Compute the shares of the points, (n,). The share of each is at most its `most`, (n,)."""
        starts, kinds = self._starts()
        program = Program(self.price, most)
        for _ in range(RETRIES):
            shares = self._approximate(program, starts, kinds)
            saved, found, of_kind = self._most_saved(shares)
            if saved <= self.price * (1 + 2 * TOLERANCE) or not len(found):
                break
            starts, kinds = np.concatenate([starts, found]), np.concatenate([kinds, of_kind])
        return shares * self.price / saved

    def first_shares(self) -> tuple[Array, Array]:
        """Compute approximate shares, (n,), from those facilities that a short search finds.

        Also return what each point pays for each of its coordinates in the cheapest clustering, (n,
        d). This clustering may use fractions of clusters.
        """
        program, pays = Program(self.price, np.full(len(self.points), self.price)), 0 * self.points
        shares = self._approximate(program, *self._starts())
        for members, centre, part in program.clustering():
            off = self.offsets(centre[None])[0, members]
            pays[members] += part * off**2 / 2 / self.variances[members]
        return shares, pays

    def _approximate(self, program: Program, starts: Array, kinds: NDArray[np.int_]) -> Array:
        """Compute shares that hold for all facilities that a search from some starts finds."""
        best = np.zeros(len(self.points))
        for _ in range(ROUNDS):
            look_at_clock(LONG_TURN)
            shares = program.solved()
            saved, members, paid, centres = self.climbed(shares, starts, kinds)
            scaled = shares * self.price / max(self.price, float(saved.max()))
            if scaled.sum() > best.sum():
                best = scaled
            is_more = saved > self.price + 1e-6
            added = program.add(members[is_more], paid[is_more], centres[is_more])
            if not added or best.sum() >= shares.sum() * (1 - ENOUGH):
                break
        return best

    def offsets(self, centres: Array) -> Array:
        """Subtract each of m centres from each point, (m, n, d). Headings differ by -pi to pi."""
        off: Array = self.points[None] - centres[:, None]
        off[..., 2:] -= math.tau * np.round(off[..., 2:] / math.tau)
        return off

    def _starts(self) -> tuple[Array, NDArray[np.int_]]:
        """Return where searches begin: at all points, and midway between points that are near."""
        off = self.offsets(self.points)
        both = self.variances[None] + self.variances[:, None]
        more = self._more(self.kinds)
        is_near = (off**2 / both).sum(-1) / 2 + more < 2 * self.price
        is_other = self.kinds[:, None] != self.kinds
        first, second = np.nonzero(np.triu(is_near, 1) | (is_near & is_other))
        middles = self.points[first] + off[first, second] / 2
        starts = np.concatenate([self.points, middles])
        kinds = np.concatenate([self.kinds, self.kinds[first]])
        cells = np.column_stack([starts / np.sqrt(self.variances.mean(0)) * GRID, kinds]).round()
        kept = np.unique(cells, axis=0, return_index=True)[1]
        return starts[kept], kinds[kept]

    def climbed(
        self, shares: Array, centres: Array, kinds: NDArray[np.int_]
    ) -> tuple[Array, NDArray[np.bool_], Array, Array]:
        """Move each of m facilities to the mean of the points that pay less there than their share.

        Returns what the points save there, (m,), which points these are, (m, n), what they pay,
        (m,), and where the facility is, (m, d).
        """
        centres, moving = centres.copy(), np.arange(len(centres))
        for _ in range(STEPS):
            look_at_clock()
            off, members, _ = self._members(shares, centres[moving], kinds[moving])
            weights = members[:, :, None] / self.variances
            step = (weights * off).sum(1) / np.maximum(weights.sum(1), TINY)
            centres[moving] += step
            moving = moving[abs(step).max(1) > STILL]
            if not len(moving):
                break
        _, members, pays = self._members(shares, centres, kinds)
        saved = np.where(members, shares - pays, 0.0).sum(1)
        return saved, members, np.where(members, pays, 0.0).sum(1), centres

    def _members(
        self, shares: Array, centres: Array, kinds: NDArray[np.int_]
    ) -> tuple[Array, NDArray[np.bool_], Array]:
        """For each of m facilities, find the points that pay less there than their share.

        Returns:
            The offsets of the n points from each facility, (m, n, d), whether a point pays less
            than its share, (m, n), and what it pays, (m, n).
        """
        off = self.offsets(centres)
        pays = np.einsum("mnd,nd->mn", off**2, 0.5 / self.variances) + self._more(kinds)
        return off, pays < shares - TINY, pays

    def _more(self, kinds: NDArray[np.int_]) -> Array:
        """Return what n points pay in addition at m facilities of another kind, (m, n)."""
        return np.where(kinds[:, None] == self.kinds, 0.0, self.fees)

    def _most_saved(self, shares: Array) -> tuple[float, Array, NDArray[np.int_]]:
        """Bound what the points save at any facility, by dividing space into boxes.

        The bound is at least the price. Also return facilities where more than the price is saved,
        with their kinds.
        """
        most, found, kinds = self.price, [np.zeros((0, self.points.shape[1]))], []
        for kind in np.unique(self.kinds):
            left = shares - np.where(self.kinds == kind, 0.0, self.fees)
            chosen = np.flatnonzero(left > TINY)
            if len(chosen):
                boxes = _Boxes(self, chosen, left)
                most = max(most, boxes.most_saved())
                found.append(boxes.found)
                kinds += [kind] * len(boxes.found)
        return most, np.concatenate(found), np.array(kinds, dtype=int)


class Program:
    """The linear program whose variables are the shares. It has one constraint for each cluster."""

    def __init__(self, price: float, most: Array) -> None:
        self._price, self._bounds = price, np.stack([np.zeros(len(most)), most], 1)
        self._clusters: list[tuple[int, ...]] = [(i,) for i in range(len(most))]
        self._costs = [price] * len(most)
        self._centres: list[Array] = []  # of all clusters with several members
        self._parts = np.zeros(0)  # the fraction of each cluster in the cheapest clustering
        self._known: set[tuple[int, ...]] = set(self._clusters)

    def add(self, members: NDArray[np.bool_], paid: Array, centres: Array) -> bool:
        """Add clusters: their members, what these pay, and the facility. Return if one is new."""
        before = len(self._clusters)
        for row, pays, centre in zip(members, paid.tolist(), centres, strict=True):
            cluster = tuple(np.flatnonzero(row).tolist())
            if cluster not in self._known:
                self._known.add(cluster)
                self._clusters.append(cluster)
                self._costs.append(self._price + pays)
                self._centres.append(centre)
        return len(self._clusters) > before

    def clustering(self) -> Iterator[tuple[list[int], Array, float]]:
        """Yield the added clusters in the cheapest clustering: members, facility, and fraction."""
        alone = len(self._bounds)
        for cluster, centre, part in zip(
            self._clusters[alone:], self._centres, self._parts[alone:], strict=False
        ):
            if part > TINY:
                yield list(cluster), centre, float(part)

    def solved(self) -> Array:
        """Find the shares with the greatest sum."""
        from scipy.optimize import linprog  # slow to load, and only logs need it

        rows = np.repeat(np.arange(len(self._clusters)), [len(c) for c in self._clusters])
        columns = np.concatenate([np.array(cluster) for cluster in self._clusters])
        shape = len(self._clusters), len(self._bounds)
        result: Any = linprog(
            -np.ones(len(self._bounds)),
            A_ub=csr_array((np.ones(len(rows)), (rows, columns)), shape=shape),
            b_ub=self._costs,
            bounds=self._bounds,
            method="highs",
        )
        self._parts = -result.ineqlin.marginals
        shares: Array = np.maximum(result.x, 0.0)
        return shares


class _Boxes:
    """Branch and bound over the positions of a facility.

    Attributes:
        found: Facilities where the points save more than the price, (m, d).
    """

    def __init__(self, facilities: Facilities, chosen: NDArray[np.int_], shares: Array) -> None:
        points, variances = facilities.points[chosen], facilities.variances[chosen]
        kinds, fees = np.zeros(len(chosen), dtype=int), np.zeros(len(chosen))
        self._all = Facilities(points, variances, kinds, fees, facilities.price)
        self._shares = shares[chosen]
        self._saved = facilities.price  # the most that is known to be saved
        self.found = np.zeros((0, points.shape[1]))

    def most_saved(self) -> float:
        """Bound what the points save at any facility."""
        half = np.array(HALF[: self._all.points.shape[1]])
        centres, bound, looked = self._first(half), self._saved, 0
        while len(centres):
            parts = [
                self._bounds(c, half) for c in np.array_split(centres, -(-len(centres) // AT_ONCE))
            ]
            upper, looked = np.concatenate(parts), looked + len(centres)
            self._keep(centres[int(upper.argmax())])
            is_open = upper > self._saved * (1 + TOLERANCE)
            bound = max(bound, float(upper[~is_open].max(initial=0.0)))
            if looked > BOXES:
                return max(bound, float(upper.max()))
            centres, half = _halved(centres[is_open], half, self._all.variances.mean(0))
        return bound

    def _first(self, half: Array) -> Array:
        """Return the centres of boxes that cover all positions where some point may save."""
        reach = np.sqrt(2 * self._shares[:, None] * self._all.variances)
        cells: set[tuple[int, ...]] = set()
        for point, away in zip(self._all.points, reach, strict=True):
            low, high = (np.floor((point + s * away) / (2 * half)).astype(int) for s in (-1, 1))
            cells.update(product(*(range(a, b + 1) for a, b in zip(low, high, strict=True))))
        centres: Array = (np.array(sorted(cells)) + 0.5) * 2 * half
        return centres

    def _keep(self, centre: Array) -> None:
        """Search for a facility near the most promising box."""
        kinds = np.zeros(1, dtype=int)
        saved, _, _, centres = self._all.climbed(self._shares, centre[None], kinds)
        if saved[0] > self._saved + 1e-6:
            self._saved = float(saved[0])
            self.found = np.concatenate([self.found, centres])

    def _bounds(self, centres: Array, half: Array) -> Array:
        """Bound what is saved in each box.

        Some points save something everywhere in a box. The sum of their savings is a concave
        quadratic function, whose maximum is known. Any other point saves at most what it saves at
        the nearest position in the box.
        """
        look_at_clock()
        variances, off = self._all.variances, self._all.offsets(centres)
        near, far = np.maximum(abs(off) - half, 0.0), abs(off) + half
        at_best = self._shares - (near**2 / variances).sum(-1) / 2
        always = self._shares > (far**2 / variances).sum(-1) / 2
        weights = always[:, :, None] / variances
        mean = (weights * off).sum(1) / np.maximum(weights.sum(1), TINY)
        left = off - np.clip(mean, -half, half)[:, None]
        together = np.where(always, self._shares, 0.0).sum(1) - (weights * left**2).sum((1, 2)) / 2
        bounds: Array = together + np.where(always, 0.0, np.maximum(at_best, 0.0)).sum(1)
        return bounds


def _halved(centres: Array, half: Array, variances: Array) -> tuple[Array, Array]:
    """Halve boxes across their longest side, in standard deviations."""
    axis = int(np.argmax(half**2 / variances))
    half = half.copy()
    half[axis] /= 2
    step = np.zeros(len(half))
    step[axis] = half[axis]
    return np.concatenate([centres - step, centres + step]), half
