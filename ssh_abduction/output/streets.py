"""Find positions of spots by a linear program, given the headings of the streets between them.

A spot is a place, or a dstate (a place and a heading) whose place is unknown. A street should be
at least one unit long, and otherwise short. A street that deviates from its heading costs much. If
two streets overlap or cross, the program is solved again with one street on a side of the other.
This drawing is taken if it costs less than the crossing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog
from scipy.sparse import coo_array

Point: TypeAlias = tuple[float, float]
# For each street from one spot to another: its heading in radians, and a factor for its costs.
Streets: TypeAlias = Mapping[tuple[int, int], tuple[float, float]]
# A linear inequality: the factor of each variable, and the least value of the weighted sum.
_Condition: TypeAlias = tuple[dict[int, float], float]
_Points: TypeAlias = NDArray[np.float64]

# Costs. A unit of a street's length costs 1. Each unit by which a street deviates from its heading
# costs ASTRAY, and each unit by which it is too short costs SHORT. Two streets that overlap or
# cross cost CROSSING.
ASTRAY, SHORT, CROSSING = 300.0, 600.0, 60.0
LOOSE = 0.001  # the factor for the costs of a street that the robot never travelled
CROOKED = 0.1  # a street that deviates from its heading by more units than this looks bent
NEAR, APART = 0.5, 1.0  # streets nearer than NEAR are moved to a distance of APART
PARALLEL = 0.1  # the largest sine of the angle between streets that count as parallel
# The program is solved at most WORK / streets times, or FEWEST times if that is more. The limit is
# a count and not a time, so that a map always has the same drawing.
WORK, FEWEST = 6000, 12
BEAM = 3


@dataclass(frozen=True, slots=True)
class _StreetDrawing:
    """A drawing in the search that separates streets.

    `value` is its cost, and `at` has the positions of the spots, of shape (spots, 2). `conditions`
    are the inequalities that were added, `left_alone` the pairs of streets that may stay near or
    cross.
    """

    value: float
    at: _Points
    conditions: tuple[_Condition, ...]
    left_alone: frozenset[tuple[int, int]]


class StreetProgram:
    """The linear program that puts spots along the headings of streets and separates streets.

    Its first variables are x and y of each spot. Then comes for each street the distance by which
    it deviates from its heading, and last for each street the length by which it is too short.
    """

    def __init__(self, spots: Sequence[int], streets: Streets) -> None:
        self.spots = list(spots)
        number = {spot: i for i, spot in enumerate(spots)}
        self.ends = np.array([(number[p], number[q]) for p, q in streets], dtype=int).reshape(-1, 2)
        ways = [(math.cos(way), math.sin(way)) for way, _ in streets.values()]
        self.along = np.round(np.array(ways).reshape(-1, 2), 12)
        self.across = self.along[:, ::-1] * (-1, 1)
        self.share = np.array([share for _, share in streets.values()])
        # Keep pairs of travelled streets apart if they have no common end.
        e, f = np.triu_indices(len(streets), 1)
        common = (self.ends[e][:, :, None] == self.ends[f][:, None, :]).any(axis=(1, 2))
        both = (self.share[e] == 1.0) & (self.share[f] == 1.0)
        self.pairs = np.column_stack((e, f))[both & ~common]
        self.rows: list[_Condition] = []
        self.cost = self._cost()
        self.at, self.value = self._solved([])

    @property
    def bent(self) -> int:
        """The number of travelled streets that deviate from their headings or are too short."""
        way = self.at[self.ends[:, 1]] - self.at[self.ends[:, 0]]
        aside, ahead = np.sum(way * self.across, axis=1), np.sum(way * self.along, axis=1)
        astray = np.maximum(np.abs(aside), 1 - ahead)
        return int(np.sum((astray > CROOKED) & (self.share == 1.0)))

    def put_apart(self) -> dict[int, Point]:
        """Separate streets that are too near each other, and return the position of each spot.

        This is a beam search. For each pair of streets that are too near, it tries to leave the
        pair alone, and to move one street to either side of the other.
        """
        best = _StreetDrawing(self.value, self.at, (), frozenset())
        beam, left = [best], max(FEWEST, WORK // (len(self.ends) + 1))
        while beam and left > 0:
            children = []
            for state in beam:
                near = (pair for pair in self._near(state.at) if pair not in state.left_alone)
                if (pair := next(near, None)) is None:
                    continue
                children.append(replace(state, left_alone=state.left_alone | {pair}))
                for condition in self._ways_apart(*pair):
                    conditions = (*state.conditions, *condition)
                    at, value = self._solved(conditions)
                    children.append(_StreetDrawing(value, at, conditions, state.left_alone))
                    left -= 1
            beam = sorted(children, key=lambda state: state.value)[:BEAM]
            best = min([best, *beam], key=lambda state: state.value)
        return {
            spot: (round(float(x), 9) + 0.0, round(float(y), 9) + 0.0)  # + 0.0 turns -0.0 into 0.0
            for spot, (x, y) in zip(self.spots, best.at, strict=True)
        }

    def _cost(self) -> NDArray[np.float64]:
        """Compute the cost of each variable, and add the inequalities of all streets to `rows`."""
        n, m = len(self.spots), len(self.ends)
        cost = np.concatenate([np.zeros(2 * n), ASTRAY * self.share, SHORT * self.share])
        for e, (p, q) in enumerate(self.ends):
            ahead, aside = _difference(p, q, self.along[e]), _difference(p, q, self.across[e])
            self.rows.append((ahead | {2 * n + m + e: 1.0}, 1.0))
            self.rows.append((aside | {2 * n + e: 1.0}, 0.0))
            self.rows.append(({k: -v for k, v in aside.items()} | {2 * n + e: 1.0}, 0.0))
            for variable, factor in ahead.items():  # the length of the street
                cost[variable] += factor * self.share[e]
        return cost

    def _solved(self, more: Sequence[_Condition]) -> tuple[_Points, float]:
        """Solve the program with more inequalities. Return the positions of the spots and the cost.

        The positions are of shape (spots, 2). The cost is inf if the inequalities contradict each
        other.
        """
        n = len(self.spots)
        if not len(self.ends):
            return np.zeros((n, 2)), 0.0
        rows = [*self.rows, *more]
        entries = [
            (i, variable, -factor)
            for i, (factors, _) in enumerate(rows)
            for variable, factor in factors.items()
        ]
        i, variables, factors = zip(*entries, strict=True)
        fixed, free, positive = (0.0, 0.0), (None, None), (0.0, None)  # the first spot is fixed
        answer = linprog(
            self.cost,
            A_ub=coo_array((factors, (i, variables)), (len(rows), len(self.cost))).tocsr(),
            b_ub=[-least for _, least in rows],
            bounds=[fixed] * 2 + [free] * (2 * n - 2) + [positive] * (len(self.cost) - 2 * n),
            method="highs-ds",
        )
        if answer.x is None:  # conditions that contradict each other
            return np.zeros((n, 2)), math.inf
        at = np.asarray(answer.x[: 2 * n], dtype=float).reshape(n, 2)
        return at, float(answer.fun) + CROSSING * len(self._near(at))

    def _ways_apart(self, e: int, f: int) -> Iterator[list[_Condition]]:
        """Yield inequalities that put one of two streets beside, ahead of or behind the other."""
        parallel = abs(float(self.across[e] @ self.along[f])) < PARALLEL
        for normal in (self.across[e], self.along[e] if parallel else self.across[f]):
            for sign in (1.0, -1.0):
                yield [
                    (_difference(p, q, sign * normal), APART)
                    for p in self.ends[e]
                    for q in self.ends[f]
                ]

    def _near(self, at: _Points) -> list[tuple[int, int]]:
        """List the pairs of streets that cross or are too near, but have no common end."""
        e, f = self.ends[self.pairs[:, 0]], self.ends[self.pairs[:, 1]]
        a, b, c, d = at[e[:, 0]], at[e[:, 1]], at[f[:, 0]], at[f[:, 1]]
        far = np.min(
            (_distance(a, c, d), _distance(b, c, d), _distance(c, a, b), _distance(d, a, b)), axis=0
        )
        crossing = (_side(a, b, c) * _side(a, b, d) < 0) & (_side(c, d, a) * _side(c, d, b) < 0)
        return [(int(i), int(j)) for i, j in self.pairs[(far < NEAR) | crossing]]


def _difference(p: int, q: int, way: NDArray[np.float64]) -> dict[int, float]:
    """Express the distance from spot p to spot q along a direction, as factors of variables.

    The result is a dict from the index of a variable to its factor.
    """
    x, y = float(way[0]), float(way[1])
    return {2 * int(q): x, 2 * int(q) + 1: y, 2 * int(p): -x, 2 * int(p) + 1: -y}


def _side(a: _Points, b: _Points, c: _Points) -> NDArray[np.float64]:
    """For each of n lines from a to b, find the side of point c: positive on the left."""
    (ux, uy), (vx, vy) = (b - a).T, (c - a).T
    side: NDArray[np.float64] = ux * vy - uy * vx
    return side


def _distance(p: _Points, a: _Points, b: _Points) -> NDArray[np.float64]:
    """The distance of each of n points p from the line segment between a and b."""
    way = b - a
    length = np.maximum(np.sum(way * way, axis=1), 1e-12)
    share = np.clip(np.sum((p - a) * way, axis=1) / length, 0, 1)
    far: NDArray[np.float64] = np.linalg.norm(p - a - share[:, None] * way, axis=1)
    return far
