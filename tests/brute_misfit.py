"""Compute the misfit of a map to displacements and closures, by plain least squares from several
starts. This is slow, and independent of the package.

The unknowns are the position of each place, the heading of each dstate, how far the robot is off at
each step, the scale and the drift. In maps without places, each dstate has a position.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from functools import cache

import numpy as np
from scipy.optimize import least_squares

from ssh_abduction.data.odometry import Odometry
from ssh_abduction.data.trace import Trace

STARTS = 4


class LeastSquares:
    """The misfits of the maps of one tiny trace."""

    def __init__(self, trace: Trace) -> None:
        self.trace = trace
        self.odometry = trace.odometry or Odometry()
        self.closures = [
            (closure, np.linalg.inv(np.array(closure.covariance))) for closure in trace.closures
        ]
        # How far the robot may be off the pose of its dstate at each step. The steps of one visit,
        # between which it only turns, are off together: so each weighs less.
        self.off = np.zeros((len(trace), 3))
        if self.odometry.offset or self.odometry.facing:
            visits: list[list[int]] = [[0]]
            for t, action in enumerate(trace.actions, 1):
                if action.kind == "turn":
                    visits[-1].append(t)
                else:
                    visits.append([t])
            for visit in visits:
                for t in visit:
                    wide = max(self.odometry.offset, 1e-3) * math.sqrt(len(visit))
                    self.off[t] = wide, wide, max(self.odometry.facing, 1e-3)
        self.moved = [
            (
                t,
                step.displacement,
                np.linalg.inv(np.array(trace.covariance(t))),
            )
            for t, step in enumerate(trace.steps)
            if t and step.displacement is not None
        ]

    @cache  # noqa: B019 - it is as short-lived as the test
    def misfit(self, headings: tuple[int, ...], positions: tuple[Hashable, ...]) -> float:
        """The least chi-square.

        Args:
            headings: The heading of each step, numbered by first use.
            positions: The position of each heading.
        """
        at = {position: i for i, position in enumerate(dict.fromkeys(positions))}
        where = [at[positions[heading]] for heading in headings]
        fixed = 2 * len(at) + len(positions)
        size = fixed + (self.off.size if self.off.any() else 0) + 2
        roots = [np.linalg.cholesky(weight).T for _, _, weight in self.moved]
        seen = [np.linalg.cholesky(weight).T for _, weight in self.closures]

        def off(unknown: np.ndarray) -> np.ndarray:
            xy, facing = unknown[: 2 * len(at)].reshape(-1, 2), unknown[2 * len(at) : fixed]
            scale, bend = unknown[-2] * self.odometry.scale, unknown[-1] * self.odometry.bend
            robot = np.column_stack([xy[where], facing[list(headings)]])
            if self.off.any():
                robot = robot + self.off * unknown[fixed:-2].reshape(-1, 3)
            rows = [unknown[fixed:]]
            for (t, (dx, dy, turned), _), root in zip(self.moved, roots, strict=True):
                way = math.hypot(dx, dy)
                start, end = robot[t - 1, 2], robot[t, 2]
                gone = robot[t, :2] - robot[t - 1, :2]
                angle = start - bend * way / 2
                ahead = math.cos(angle) * gone[0] + math.sin(angle) * gone[1]
                left = math.cos(angle) * gone[1] - math.sin(angle) * gone[0]
                turn = math.remainder(end - start + bend * way - turned, math.tau)
                rows.append(root @ [(1 + scale) * ahead - dx, (1 + scale) * left - dy, turn])
            for (closure, _), root in zip(self.closures, seen, strict=True):
                x, y, turned = closure.displacement
                here, there = robot[closure.first], robot[closure.last]
                gone = there[:2] - here[:2]
                cos, sin = math.cos(here[2]), math.sin(here[2])
                ahead, left = cos * gone[0] + sin * gone[1], cos * gone[1] - sin * gone[0]
                turn = math.remainder(there[2] - here[2] - turned, math.tau)
                rows.append(root @ [ahead - x, left - y, turn])
            return np.concatenate(rows)

        random = np.random.default_rng(0)
        starts = [self._reckoned(headings, where, len(at), size)]
        starts += [starts[0] + random.normal(0, 1.5, size) for _ in range(STARTS)]
        found = [
            least_squares(off, start, x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12)
            for start in starts
        ]
        best = min(found, key=lambda one: one.cost)
        return float(2 * best.cost)

    def _reckoned(
        self, headings: Sequence[int], where: Sequence[int], places: int, size: int
    ) -> np.ndarray:
        """The initial value of each unknown: dead reckoning at its first visit."""
        unknown = np.zeros(size)
        x = y = facing = 0.0
        seen_places: set[int] = set()
        seen_headings: set[int] = set()
        for t, step in enumerate(self.trace.steps):
            if t and step.displacement is not None:
                dx, dy, turned = step.displacement
                x += math.cos(facing) * dx - math.sin(facing) * dy
                y += math.sin(facing) * dx + math.cos(facing) * dy
                facing += turned
            if where[t] not in seen_places:
                seen_places.add(where[t])
                unknown[2 * where[t] : 2 * where[t] + 2] = x, y
            if headings[t] not in seen_headings:
                seen_headings.add(headings[t])
                unknown[2 * places + headings[t]] = facing
        return unknown
