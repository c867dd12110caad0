"""Judge maps by displacements, with matrices written out in full. This is slow, plain, and
independent of the package.

Each displacement has an error with three components. The scale and the drift of the heading are two
more variables. Small changes of each variable give the derivatives J of the closing of a loop. The
covariance of several closings is J C J'.
"""

from __future__ import annotations

import math
from functools import cache
from itertools import combinations

import numpy as np
from scipy.special import chdtri

from ssh_abduction.data.odometry import Odometry
from ssh_abduction.data.trace import Trace
from ssh_abduction.theory.theory import Theory

LITTLE = 1e-6


class Geometry:
    """The displacements of a tiny trace, under a resolved theory."""

    def __init__(self, trace: Trace, theory: Theory) -> None:
        self.trace, self.theory = trace, theory
        self.odometry = trace.odometry or Odometry()
        self.arrivals = [
            0,
            *(t for t, action in enumerate(trace.actions, 1) if action.kind != "turn"),
        ]
        grid = range(-12, 13) if self.odometry.bend else [0]
        self.bends = [(n * self.odometry.bend / 2, (max(abs(n) - 0.5, 0.0) / 2) ** 2) for n in grid]
        self.drift = self.odometry.bend / 4
        self.judged: dict[tuple[tuple[int, int, int], ...], bool] = {}

    def end(self, i: int, j: int, bend: float, errors: np.ndarray) -> np.ndarray:
        """The pose at step j by dead reckoning from the first step, if the displacements after step
        i, the scale and the drift have these errors."""
        x = y = heading = 0.0
        for t in range(1, j + 1):
            displacement = self.trace.steps[t].displacement
            if displacement is None:
                continue
            dx, dy, turned = displacement
            way = math.hypot(dx, dy)
            wrong = errors[3 * t : 3 * t + 3] if t > i else np.zeros(3)
            scale, drift = errors[-2:] if t > i else (0.0, 0.0)
            start = heading
            half = (-bend + drift) * way / 2
            ahead, left = (1 + scale) * dx, (1 + scale) * dy
            x += (
                math.cos(start + half) * ahead
                - math.sin(start + half) * left
                + math.cos(start) * wrong[0]
                - math.sin(start) * wrong[1]
            )
            y += (
                math.sin(start + half) * ahead
                + math.cos(start + half) * left
                + math.sin(start) * wrong[0]
                + math.cos(start) * wrong[1]
            )
            heading = start + turned + 2 * half + wrong[2]
        return np.array([x, y, heading])

    @cache  # noqa: B019 - it is as short-lived as the test
    def derivatives(self, i: int, j: int, bend: float) -> np.ndarray:
        size = 3 * len(self.trace) + 2
        rows = []
        for k in range(size):
            errors = np.zeros(size)
            errors[k] = LITTLE
            rows.append(
                (self.end(i, j, bend, errors) - self.end(i, j, bend, -errors)) / (2 * LITTLE)
            )
        return np.array(rows).T

    @cache  # noqa: B019
    def noise(self) -> np.ndarray:
        size = 3 * len(self.trace) + 2
        noise = np.zeros((size, size))
        for t in range(1, len(self.trace)):
            if (covariance := self.trace.covariance(t)) is not None:
                noise[3 * t : 3 * t + 3, 3 * t : 3 * t + 3] = covariance
        noise[-2, -2], noise[-1, -1] = self.odometry.scale**2, self.drift**2
        return noise

    @cache  # noqa: B019
    def loop(self, i: int, j: int, bend: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, bool]:
        """The closing error of a loop, its derivatives, what is added to its covariance, and
        whether it is known."""
        off = self.end(i, j, bend, np.zeros(3 * len(self.trace) + 2)) - self.end(
            i, i, bend, np.zeros(3 * len(self.trace) + 2)
        )
        off[2] = math.remainder(off[2], math.tau)
        moves, noise = self.derivatives(i, j, bend), self.noise()
        variance = (moves @ noise @ moves.T)[2, 2]
        by_heading = 0.0
        end = self.end(i, j, bend, np.zeros(3 * len(self.trace) + 2))
        for t in range(i + 1, j + 1):
            at = self.end(i, t, bend, np.zeros(3 * len(self.trace) + 2))
            by_heading += noise[3 * t + 2, 3 * t + 2] * ((end - at)[:2] ** 2).sum()
        by_heading += noise[-1, -1] * (moves[:2, -1] ** 2).sum()
        bent = 9.0 * variance * by_heading + 1e-6
        missing = any(self.trace.steps[t].displacement is None for t in range(i + 1, j + 1))
        offset, facing = 2 * self.odometry.offset**2, 2 * self.odometry.facing**2
        return (
            off,
            moves,
            np.diag([bent + offset, bent + offset, 1e-6 + facing]),
            variance <= 1.0 and not missing,
        )

    def refuses(self, returns: tuple[tuple[int, int, int], ...]) -> bool:
        """Whether these returns (two steps, degrees of freedom) are refused together."""
        if returns not in self.judged:
            self.judged[returns] = self._refuses(returns)
        return self.judged[returns]

    def _refuses(self, returns: tuple[tuple[int, int, int], ...]) -> bool:
        if not all(self.loop(i, j, 0.0)[3] for i, j, _ in returns):
            return False
        if len(returns) == 2 and max(i for i, _, _ in returns) >= min(j for _, j, _ in returns):
            return False
        share = self.theory.reject / 2 if self.theory.joint > 1 else self.theory.reject
        tests = math.comb(self.theory.returns, len(returns))
        freedom = sum(f for *_, f in returns)
        most = chdtri(freedom, share / max(tests, 1))
        least = math.inf
        for bend, unlikely in self.bends:
            loops = [self.loop(i, j, bend) for i, j, _ in returns]
            off = np.concatenate(
                [loop[0][:f] for loop, (*_, f) in zip(loops, returns, strict=True)]
            )
            moves = np.concatenate(
                [loop[1][:f] for loop, (*_, f) in zip(loops, returns, strict=True)]
            )
            covariance = moves @ self.noise() @ moves.T
            at = 0
            for loop, (*_, f) in zip(loops, returns, strict=True):
                covariance[at : at + f, at : at + f] += loop[2][:f, :f]
                at += f
            if len(returns) == 2:
                # At a step where both loops begin or end, the robot is off its dstate once.
                (i, j, f), (k, m, g) = returns
                spreads = [self.odometry.offset, self.odometry.offset, self.odometry.facing]
                ends = np.diag(np.square(spreads)) * ((i == k) + (j == m))
                covariance[:f, f:] += ends[:f, :g]
                covariance[f:, :f] += ends[:g, :f]
            least = min(least, float(off @ np.linalg.solve(covariance, off)) + unlikely)
        return bool(least > most)

    def allows(self, labels: tuple[int, ...], places: tuple[int | None, ...] | None) -> bool:
        """Whether no set of at most `joint` returns of a map is refused."""
        returns = [
            (i, j, 3) for i, j in combinations(range(len(labels)), 2) if labels[i] == labels[j]
        ]
        if places is not None:
            returns += [
                (i, j, 2)
                for i, j in combinations(self.arrivals, 2)
                if places[labels[i]] == places[labels[j]]
            ]
        alone = [(one,) for one in returns]
        arrived = sorted(
            one for one in returns if one[0] in self.arrivals and one[1] in self.arrivals
        )
        together = list(combinations(arrived, 2)) if self.theory.joint > 1 else []
        return not any(map(self.refuses, [*alone, *together]))
