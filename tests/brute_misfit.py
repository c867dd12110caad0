"""The misfit of a map to displacements and closures, by plain least squares from several starts:
slow, and independent of the package.

The unknowns are the position of each place (of each dstate where there are no places), the heading
of each dstate, the scale and the drift.
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
        # The robot is off the pose of a dstate when it arrives, and when it leaves.
        ends = 2 * np.diag([self.odometry.offset] * 2 + [self.odometry.facing]) ** 2
        self.closures = [
            (closure, np.linalg.inv(np.array(closure.covariance) + ends))
            for closure in trace.closures
        ]
        travels = [None, *(action.kind != "turn" for action in trace.actions)]
        self.moved = [
            (
                t,
                step.displacement,
                np.linalg.inv(np.array(trace.covariance(t)) + (ends if travels[t] else 0)),
            )
            for t, step in enumerate(trace.steps)
            if t and step.displacement is not None
        ]

    @cache  # noqa: B019 - it is as short-lived as the test
    def misfit(self, headings: tuple[int, ...], positions: tuple[Hashable, ...]) -> float:
        """The least chi-square.

        headings   the heading of each step, numbered by first use
        positions  the position of each heading
        """
        at = {position: i for i, position in enumerate(dict.fromkeys(positions))}
        where = [at[positions[heading]] for heading in headings]
        size = 2 * len(at) + len(positions) + 2
        roots = [np.linalg.cholesky(weight).T for _, _, weight in self.moved]
        seen = [np.linalg.cholesky(weight).T for _, weight in self.closures]

        def off(unknown: np.ndarray) -> np.ndarray:
            xy, facing = unknown[: 2 * len(at)].reshape(-1, 2), unknown[2 * len(at) : -2]
            scale, bend = unknown[-2] * self.odometry.scale, unknown[-1] * self.odometry.bend
            rows = [unknown[-2:]]
            for (t, (dx, dy, turned), _), root in zip(self.moved, roots, strict=True):
                way = math.hypot(dx, dy)
                start, end = facing[headings[t - 1]], facing[headings[t]]
                gone = xy[where[t]] - xy[where[t - 1]]
                angle = start - bend * way / 2
                ahead = math.cos(angle) * gone[0] + math.sin(angle) * gone[1]
                left = math.cos(angle) * gone[1] - math.sin(angle) * gone[0]
                turn = math.remainder(end - start + bend * way - turned, math.tau)
                rows.append(root @ [(1 + scale) * ahead - dx, (1 + scale) * left - dy, turn])
            for (closure, _), root in zip(self.closures, seen, strict=True):
                x, y, turned = closure.displacement
                here, there = headings[closure.first], headings[closure.last]
                gone = xy[where[closure.last]] - xy[where[closure.first]]
                cos, sin = math.cos(facing[here]), math.sin(facing[here])
                ahead, left = cos * gone[0] + sin * gone[1], cos * gone[1] - sin * gone[0]
                turn = math.remainder(facing[there] - facing[here] - turned, math.tau)
                rows.append(root @ [ahead - x, left - y, turn])
            return np.concatenate(rows)

        random = np.random.default_rng(0)
        starts = [self._reckoned(headings, where, len(at), len(positions), size)]
        starts += [starts[0] + random.normal(0, 1.5, size) for _ in range(STARTS)]
        found = [
            least_squares(off, start, x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12)
            for start in starts
        ]
        return float(min(2 * one.cost for one in found))

    def _reckoned(
        self, headings: Sequence[int], where: Sequence[int], places: int, dstates: int, size: int
    ) -> np.ndarray:
        """Each unknown as dead reckoning has it at its first visit."""
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
