"""The displacements and closures of a trace, as equations for the poses of its steps.

A displacement relates a step to the step before, and a closure relates any two steps. Each gives
three equations, with a covariance. If the robot may be off the pose of its dstate, each step gives
three more. All displacements share two errors: their scale, and a steady drift of heading. Closures
have neither error, as they do not depend on how the robot drove.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.odometry import Odometry
from ssh_abduction.data.trace import Trace
from ssh_abduction.theory.prior import spreads_of
from ssh_abduction.theory.theory import Theory

Array: TypeAlias = NDArray[np.float64]


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
    """

    first: NDArray[np.int_]
    last: NDArray[np.int_]
    moved: Array
    noise: Array
    scaled: Array
    way: Array
    sigma: Array
    spreads: Array

    @staticmethod
    def of(trace: Trace) -> Equations:
        """Collect the equations of a trace."""
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
