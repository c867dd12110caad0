"""The Gaussian distribution of poses in a hypothesis about dstates and places (`beam.py`).

The equations are linear in the neighbourhood of the means. So the chi-square of a hypothesis is
close to that of its map, and not equal to it.

Reference:
    Smith, Self & Cheeseman 1990, "Estimating uncertain spatial relationships in robotics".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.closure import Closure
from ssh_abduction.data.drives import starts_of
from ssh_abduction.data.odometry import Odometry
from ssh_abduction.data.star import Star
from ssh_abduction.data.trace import Trace
from ssh_abduction.solver.equations import noise_of, noises
from ssh_abduction.solver.guesses.pieces import Pieces

Array: TypeAlias = NDArray[np.float64]

# Added to variances, in square metres and square radians, so that no matrix is singular.
BLUR = 1e-6
# The standard deviations, in metres and radians, of a move without a displacement.
UNKNOWN = (1e3, 1e3, 3.0)
# The first entries of the means: how wrong the scale and the drift are, in standard deviations.
SCALE, BEND = 0, 1


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """What a robot may have visited.

    Attributes:
        labels: The dstate of each step so far.
        places: The place of each dstate.
        seen: For each dstate, what it costs to treat each observation there as misread.
        links: For each dstate and action, the dstate that it leads to.
        sights: For each place, what its first step shows of it.
        position: For each place, the index of its x in the means; y is the next one.
        heading: For each dstate, the index of its heading in the means.
        mean: The means in metres, radians and standard deviations.
        covariance: Their covariance.
        nats: The cost.
        faults: The steps at which an action slipped or a displacement is wrong, and which.
        pieces: Which poses are in one frame.
    """

    labels: list[int]
    places: list[int]
    seen: list[dict[int, float]]
    links: dict[tuple[int, int], int]
    sights: list[Star | tuple[bool, ...] | None]
    position: list[int]
    heading: list[int]
    mean: Array
    covariance: Array
    nats: float
    faults: tuple[tuple[int, str], ...] = ()
    pieces: Pieces = field(default_factory=Pieces)


class Reckoning:
    """The moves of a trace, and how they change the poses of a hypothesis."""

    def __init__(self, trace: Trace) -> None:
        self._trace, self._starts = trace, starts_of(trace)
        odometry = trace.odometry or Odometry()
        self._sigma = odometry.scale, odometry.bend
        steps = [t for t in range(1, len(trace)) if trace.steps[t].displacement is not None]
        self._noise = dict(zip(steps, noises(trace, steps), strict=True))
        # The closures of each step, and their covariances.
        self._closures: dict[int, list[tuple[Closure, Array]]] = {}
        for closure in trace.closures:
            told = closure, noise_of(closure, odometry)
            self._closures.setdefault(closure.last, []).append(told)

    def moved(self, found: Hypothesis, t: int, believes: bool = True) -> Hypothesis:
        """Append the pose after the move to step t to the means of a hypothesis.

        Args:
            found: The hypothesis of the steps before.
            t: The step.
            believes: Whether the displacement of the step is used.
        """
        displacement = self._trace.steps[t].displacement if believes else None
        here = found.labels[-1]
        at, heading = found.position[found.places[here]], found.heading[here]
        mean, n = found.mean, len(found.mean)
        dx, dy, turn = displacement or (0.0, 0.0, 0.0)
        way = math.hypot(dx, dy)
        scale = 1 + mean[SCALE] * self._sigma[SCALE]
        drift = mean[BEND] * self._sigma[BEND] * way
        facing = mean[heading] - drift / 2
        cos, sin = math.cos(facing), math.sin(facing)
        gone = np.array([cos * dx - sin * dy, sin * dx + cos * dy]) / scale
        aside = np.array([-gone[1], gone[0]])
        by = np.zeros((3, n))
        by[0, at] = by[1, at + 1] = by[2, heading] = 1.0
        by[:2, heading] = aside
        by[:2, SCALE] = -gone * self._sigma[SCALE] / scale
        by[:2, BEND] = aside * (-way / 2 * self._sigma[BEND])
        by[2, BEND] = -way * self._sigma[BEND]
        rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, scale]]) / scale
        noise = np.diag(UNKNOWN) ** 2 if displacement is None else self._noise[t]
        covariance = np.empty((n + 3, n + 3))
        covariance[:n, :n] = found.covariance
        covariance[n:, :n] = by @ found.covariance
        covariance[:n, n:] = covariance[n:, :n].T
        covariance[n:, n:] = covariance[n:, :n] @ by.T + rotation @ noise @ rotation.T
        pose = [*(mean[at : at + 2] + gone), mean[heading] + turn - drift]
        piece = t if t in self._starts else found.pieces.of_heading[here]
        moved = replace(
            found,
            mean=np.concatenate([mean, pose]),
            covariance=covariance,
            pieces=replace(found.pieces, here=piece),
        )
        for closure, spread in self._closures.get(t, ()):
            moved = self._closed(moved, closure, spread)
        return moved

    def _closed(self, moved: Hypothesis, closure: Closure, noise: Array) -> Hypothesis:
        """Update a hypothesis by a closure that leads to the last pose of its means.

        Args:
            moved: The hypothesis.
            closure: The closure.
            noise: The covariance of the closure, 3 x 3, with the errors of both ends.
        """
        mean, n = moved.mean, len(moved.mean) - 3
        there = moved.labels[closure.first]
        at, heading = moved.position[moved.places[there]], moved.heading[there]
        cos, sin = math.cos(mean[heading]), math.sin(mean[heading])
        back = np.array([[cos, sin], [-sin, cos]])
        gone = back @ (mean[n : n + 2] - mean[at : at + 2])
        # How the pose, relative to the earlier step, depends on the means.
        by = np.zeros((3, n + 3))
        by[:2, n : n + 2], by[:2, at : at + 2] = back, -back
        by[:2, heading] = gone[1], -gone[0]
        by[2, n + 2], by[2, heading] = 1.0, -1.0
        off = np.array([*gone, mean[n + 2] - mean[heading]]) - closure.displacement
        off[2] = math.remainder(off[2], math.tau)
        across = moved.covariance @ by.T
        solved = np.linalg.solve(by @ across + noise, np.column_stack([off, across.T]))
        covariance = moved.covariance - across @ solved[:, 1:]
        return replace(
            moved,
            mean=mean - across @ solved[:, 0],
            covariance=(covariance + covariance.T) / 2,
            nats=moved.nats + float(off @ solved[:, 0]) / 2,
        )


def squares_of(moved: Hypothesis, places: Sequence[int], dstate: int | None = None) -> Array:
    """The chi-square if the last pose is at each of some places, or at a dstate of one."""
    n = len(moved.mean) - 3
    at = np.array([moved.position[p] for p in places])
    rows = np.stack([at, at + 1], 1)
    last = np.array([n, n + 1])
    if dstate is not None:
        rows = np.concatenate([rows, [[moved.heading[dstate]]]], 1)
        last = np.array([n, n + 1, n + 2])
    off = moved.mean[last] - moved.mean[rows]
    if dstate is not None:
        off[:, 2] -= math.tau * np.round(off[:, 2] / math.tau)
    c = moved.covariance
    crossed = c[rows[:, :, None], last[None, None, :]]
    spread = (
        c[np.ix_(last, last)][None]
        + c[rows[:, :, None], rows[:, None, :]]
        - crossed
        - crossed.transpose(0, 2, 1)
        + BLUR * np.identity(len(last))
    )
    squares: Array = np.einsum("ni,ni->n", off, np.linalg.solve(spread, off[..., None])[..., 0])
    return squares


def conditioned(
    mean: Array, covariance: Array, first: Sequence[int], second: Sequence[int]
) -> tuple[Array, Array]:
    """Condition a Gaussian on equalities of entries. The third entry is an angle."""
    off = mean[first] - mean[second]
    off[2:] -= math.tau * np.round(off[2:] / math.tau)
    across = covariance[:, first] - covariance[:, second]
    spread = across[first] - across[second] + BLUR * np.identity(len(off))
    gain = np.linalg.solve(spread, across.T).T
    conditioned = covariance - gain @ across.T
    return mean - gain @ off, (conditioned + conditioned.T) / 2


def first_pose() -> tuple[Array, Array]:
    """The means and the covariance at the first step, which is the origin."""
    mean, covariance = np.zeros(5), np.zeros((5, 5))
    covariance[[SCALE, BEND], [SCALE, BEND]] = 1.0
    return mean, covariance
