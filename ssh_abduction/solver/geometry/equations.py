"""The displacements and closures of a trace, as equations for the poses of its steps.

A displacement relates a step to the step before, and a closure relates any two steps. Each gives
three equations, with a covariance. If the robot may be off the pose of its dstate, each step gives
three more. All displacements share two errors: their scale, and a steady drift of heading. Closures
have neither error, as they do not depend on how the robot drove.

A closure may be false: a part of the building looks like another one. Then it does not say where
its last step is, but where this step would be if one part were laid on the other (`Aliases`).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.odometry import Odometry
from ssh_abduction.data.trace import Trace
from ssh_abduction.theory.prior import spreads_of
from ssh_abduction.theory.theory import Theory

Array: TypeAlias = NDArray[np.float64]
# For each closure of a trace, 0 if it is believed, else the number of the alias that it is of. The
# closures of one alias lay one part of the building on another part, by one unknown motion.
Aliases: TypeAlias = tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Equations:
    """The n displacements and closures of a trace. The displacements come first.

    Attributes:
        first: The step from which each displacement or closure leads, (n,).
        last: The step to which each displacement or closure leads, (n,).
        moved: The displacements in metres and radians, (n, 3).
        noise: Their covariances, (n, 3, 3).
        scaled: 1 if the shared error of scale applies, 0 if not, (n,).
        way: The metres over which the shared drift of heading applies, (n,).
        sigma: The standard deviations of scale and drift, (2,).
        spreads: The variances of the pose at each step, relative to its dstate (`spreads_of`).
        alias: The alias of each closure, and 0 for each displacement (`Aliases`), (n,).
    """

    first: NDArray[np.int_]
    last: NDArray[np.int_]
    moved: Array
    noise: Array
    scaled: Array
    way: Array
    sigma: Array
    spreads: Array
    alias: NDArray[np.int_]

    @staticmethod
    def of(trace: Trace) -> Equations:
        """Collect the equations of a trace. All its closures are believed."""
        odometry = trace.odometry or Odometry()
        steps = [t for t in range(1, len(trace)) if trace.steps[t].displacement is not None]
        matched = trace.closures
        moved = np.array(
            [
                *(trace.steps[t].displacement for t in steps),
                *(closure.displacement for closure in matched),
            ],
            dtype=float,
        ).reshape(-1, 3)
        scaled = np.repeat([1.0, 0.0], [len(steps), len(matched)])
        return Equations(
            first=np.array([*(t - 1 for t in steps), *(c.first for c in matched)], dtype=int),
            last=np.array([*steps, *(c.last for c in matched)], dtype=int),
            moved=moved,
            noise=np.concatenate(
                [noises(trace, steps), *(np.array(c.covariance)[None] for c in matched)]
            ),
            scaled=scaled,
            way=scaled * np.hypot(moved[:, 0], moved[:, 1]),
            sigma=np.array([odometry.scale, odometry.bend]),
            spreads=spreads_of(trace),
            alias=np.zeros(len(moved), dtype=int),
        )

    def doubting(self, aliases: Aliases, kept: Collection[int]) -> Equations:
        """Return the equations with these aliases of closures, and without closures not in `kept`.

        If the alias is negative, it moves the first step of the closure instead of the last one.
        Then the equation is that of the inverse displacement.
        """
        moves = len(self.first) - len(aliases)
        alias = np.array([0] * moves + [*aliases], dtype=int)
        back = alias < 0
        x, y, turned = self.moved.T
        cos, sin = np.cos(turned), np.sin(turned)
        inverse = np.stack([-cos * x - sin * y, sin * x - cos * y, -turned], 1)
        # How an error of a displacement, in its own axes, moves the inverse one.
        zero, one = np.zeros_like(x), np.ones_like(x)
        by = -np.array([[cos, sin, -inverse[:, 1]], [-sin, cos, inverse[:, 0]], [zero, zero, one]])
        by = by.transpose(2, 0, 1)
        noise = np.where(back[:, None, None], by @ self.noise @ by.transpose(0, 2, 1), self.noise)
        there = np.array([*range(moves), *(moves + i for i in sorted(kept))], dtype=int)
        return replace(
            self,
            first=np.where(back, self.last, self.first)[there],
            last=np.where(back, self.first, self.last)[there],
            moved=np.where(back[:, None], inverse, self.moved)[there],
            noise=noise[there],
            scaled=self.scaled[there],
            way=self.way[there],
            alias=abs(alias)[there],
        )

    def beside(self, labels: NDArray[np.int_], size: int) -> Equations:
        """Return the same equations for the poses of dstates instead of those of steps.

        If the robot may be off the poses of dstates, its pose at step t is an unknown with the
        number size + t. Then there are also equations between these poses and those of dstates.
        """
        if not self.spreads.any():
            return replace(self, first=labels[self.first], last=labels[self.last])
        n = len(labels)
        return replace(
            self,
            first=np.concatenate([size + self.first, labels]),
            last=np.concatenate([size + self.last, size + np.arange(n)]),
            moved=np.concatenate([self.moved, np.zeros((n, 3))]),
            noise=np.concatenate([self.noise, self.spreads[:, :, None] * np.identity(3)]),
            scaled=np.concatenate([self.scaled, np.zeros(n)]),
            way=np.concatenate([self.way, np.zeros(n)]),
            alias=np.concatenate([self.alias, np.zeros(n, dtype=int)]),
        )


def noises(trace: Trace, steps: Sequence[int]) -> Array:
    """Return the covariances of the displacements that lead to n steps, (n, 3, 3)."""
    return np.array([trace.covariance(t) for t in steps], dtype=float).reshape(-1, 3, 3)


def visits_by_turns(trace: Trace, theory: Theory) -> list[int]:
    """Return, for each step, the first step of its visit: where the robot turns, it stays.

    Without places, each step is a visit. So it is if displacements may be wrong.
    """
    stays = theory.level == "topological" and "turn_stays" in theory.hard and not theory.jumped
    visits = [0]
    for t, action in enumerate(trace.actions, 1):
        visits.append(visits[-1] if stays and action.kind == "turn" else t)
    return visits
