"""The Gaussian distribution of poses in a hypothesis about dstates and places (`beam.py`).

The equations are linear only near the means. So the chi-square of a hypothesis is close to that of
its map, but not equal to it.

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

from ssh_abduction.data.drives import frames_of
from ssh_abduction.data.groups import gathered
from ssh_abduction.data.odometry import Closure, Displacement, Odometry
from ssh_abduction.data.star import Star
from ssh_abduction.data.trace import Trace
from ssh_abduction.solver.geometry.equations import noises, spreads_of
from ssh_abduction.solver.geometry.fit import Poses
from ssh_abduction.solver.guesses.pieces import Pieces, closed

Array: TypeAlias = NDArray[np.float64]

# This is added to variances, in square metres and square radians, so that no matrix is singular.
BLUR = 1e-6
# The standard deviations, in metres and radians, of a move without a displacement.
UNKNOWN = (1e3, 1e3, 3.0)
# If the standard deviation of the sum of all turns exceeds this, in radians, linear equations are
# too rough: if the robot drives on for 10 m, they miss its position by about 0.5 m.
ROUGH = 0.3
# Displacements of at most this many next steps are compared with the links of a hypothesis.
AHEAD = 16
# The indices of the first entries of the means: the errors of the scale and of the drift of the
# odometry, in standard deviations.
SCALE, BEND = 0, 1


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A hypothesis about the dstate and place of each step so far, with its poses and its cost.

    Attributes:
        labels: The dstate of each step so far.
        places: The place of each dstate.
        seen: For each dstate, the observations there, each with the cost in nats of treating it as
            misread at all its steps.
        links: For each (dstate, action) with a link, the dstate that it leads to.
        sights: For each place, what the first step there shows of it, as `Sights.shown`. If
            gateways may change between drives, that is the first step of the last drive there.
        drives: For each place, the drive of the step in `sights`.
        position: For each place, the index of its x in the means; y is the next one.
        heading: For each dstate, the index of its heading in the means.
        mean: The means, in metres, radians and standard deviations. First the errors of scale and
            drift, then positions and headings, and last the pose of the robot (x, y, heading).
        changes: The part of `nats` that is the price of gateways that changed between drives.
        faults: Pairs (step, kind): the steps at which an action "slipped" or a displacement
            "jumped".
        pieces: Which poses are in one frame.
    """

    labels: list[int]
    places: list[int]
    seen: list[dict[int, float]]
    links: dict[tuple[int, int], int]
    sights: list[Star | tuple[bool, ...] | None]
    drives: list[int]
    position: list[int]
    heading: list[int]
    mean: Array
    covariance: Array
    nats: float
    changes: float = 0.0
    faults: tuple[tuple[int, str], ...] = ()
    pieces: Pieces = field(default_factory=Pieces)

    def slips(self, t: int) -> bool:
        """Whether the action to step t, the newest step, slipped."""
        return self.faults[-1:] == ((t - 1, "slipped"),)


class HypothesisPoses:
    """Updates the poses of hypotheses by the displacements and closures of a trace.

    Attributes:
        is_rough: Whether poses must be fitted anew now and then (`settled`), as the equations are
            linear only near the means. In a single frame, this is so if the robot may be off the
            poses of its dstates (`spreads_of`). In several frames, it is so if the robot may not be
            off them, and headings may err by ROUGH.
    """

    def __init__(self, trace: Trace) -> None:
        self._trace, self._frames = trace, frames_of(trace)
        odometry = trace.odometry or Odometry()
        self._sigma = odometry.scale, odometry.bend
        steps = [t for t in range(1, len(trace)) if trace.steps[t].displacement is not None]
        self._noise = dict(zip(steps, noises(trace, steps), strict=True))
        self._closures = gathered((closure.last, closure) for closure in trace.closures)
        spreads = spreads_of(trace)
        self._is_off = bool(spreads.any())
        turns = np.array([noise[2, 2] for noise in self._noise.values()])
        self.is_rough = self._is_off
        if self._frames:
            self.is_rough = not self._is_off and math.sqrt(turns.sum()) > ROUGH
        self._spreads = spreads + BLUR

    def moved(self, found: Hypothesis, t: int, believes: bool = True) -> Hypothesis:
        """Move the robot of a hypothesis to step t, and use the closures that end there.

        If `believes` is False, the displacement to the step is not used: the move is unknown. The
        last three entries of the new means are the pose at step t.
        """
        displacement = self._trace.steps[t].displacement if believes else None
        mean, n = found.mean, len(found.mean)
        dx, dy, turn = displacement or (0.0, 0.0, 0.0)
        way = math.hypot(dx, dy)
        scale = 1 + mean[SCALE] * self._sigma[SCALE]
        drift = mean[BEND] * self._sigma[BEND] * way
        facing = mean[-1] - drift / 2
        cos, sin = math.cos(facing), math.sin(facing)
        gone = np.array([cos * dx - sin * dy, sin * dx + cos * dy]) / scale
        aside = np.array([-gone[1], gone[0]])
        by = np.zeros((3, n))
        by[:, -3:] = np.identity(3)
        by[:2, -1] = aside
        by[:2, SCALE] = -gone * self._sigma[SCALE] / scale
        by[:2, BEND] = aside * (-way / 2 * self._sigma[BEND])
        by[2, BEND] = -way * self._sigma[BEND]
        rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, scale]]) / scale
        noise = np.diag(UNKNOWN) ** 2 if displacement is None else self._noise[t]
        covariance, across = found.covariance.copy(), by @ found.covariance
        covariance[-3:], covariance[:, -3:] = across, across.T
        covariance[-3:, -3:] = across @ by.T + rotation @ noise @ rotation.T
        pose = mean[-3:] + np.array([*gone, turn - drift])
        piece = t if t in self._frames else found.pieces.of_heading[found.labels[-1]]
        moved = replace(
            found,
            mean=np.concatenate([mean[:-3], pose]),
            covariance=covariance,
            pieces=replace(found.pieces, here=piece),
        )
        for closure in self._closures.get(t, ()):
            if closure.first >= len(moved.labels):  # only in `square_ahead`
                continue
            turned = closed(moved, moved.labels[closure.first], closure.displacement[2])
            moved = self._closed(turned, closure)
        return moved

    def _closed(self, moved: Hypothesis, closure: Closure) -> Hypothesis:
        """Update a hypothesis by a closure between an earlier step and the present one.

        The pose of the robot at the earlier step is not kept, so the pose of its dstate stands for
        it. The cost includes the misfit of the closure.
        """
        noise = np.array(closure.covariance) + np.diag(self._spreads[closure.first])
        n, there = len(moved.mean) - 3, moved.labels[closure.first]
        first = moved.position[moved.places[there]], moved.heading[there]
        by, off = closure_equations(moved.mean, first, (n, n + 2), closure.displacement)
        mean, covariance, square = updated(moved.mean, moved.covariance, by, off, noise)
        return replace(moved, mean=mean, covariance=covariance, nats=moved.nats + square / 2)

    def settled(self, found: Hypothesis, trace: Trace) -> tuple[float, Hypothesis]:
        """Fit all poses of a hypothesis anew, as the equations are linear only near the means.

        The trace lacks the displacements that the hypothesis treats as wrong. Returns the
        chi-square, too.
        """
        poses = Poses(trace, found.labels, found.places)
        dstates, places = len(found.places), len(found.position)
        position, labels = np.array(found.position), np.array(found.labels)
        at, facing = found.mean[np.stack([position, position + 1], 1)], found.mean[found.heading]
        place_at, dstate_at = np.array(found.places)[labels], labels
        if self._is_off:  # each step has a pose of its own, after those of places and dstates
            at = np.concatenate([at, at[place_at]])
            facing = np.concatenate([facing, facing[labels]])
            place_at, dstate_at = places + np.arange(len(labels)), dstates + np.arange(len(labels))
        start = np.concatenate([at.ravel(), facing, found.mean[[SCALE, BEND]]])
        pose_at = np.stack([2 * place_at, 2 * place_at + 1, 2 * len(at) + dstate_at], 1)
        order = np.empty(len(found.mean), dtype=int)
        order[[SCALE, BEND]] = len(start) - 2, len(start) - 1
        order[position], order[position + 1] = 2 * np.arange(places), 2 * np.arange(places) + 1
        order[found.heading] = 2 * len(at) + np.arange(dstates)
        order[-3:] = pose_at[-1]
        # Without poses of their own, the last step and its dstate share entries.
        wanted, entry = np.unique(order, return_inverse=True)
        squares, unknown, covariance = poses.settled(start, pose_at[0].tolist(), wanted.tolist())
        return squares, replace(
            found, mean=unknown[order], covariance=covariance[np.ix_(entry, entry)]
        )

    def squares(
        self, moved: Hypothesis, t: int, places: Sequence[int], dstate: int | None = None
    ) -> Array:
        """Compute the chi-square of the robot being at each of some places at step t.

        `moved` is a hypothesis after the move to step t. If a dstate at these places is given, the
        heading of the robot has to fit, too.
        """
        at = np.array([moved.position[p] for p in places])
        rows, last = np.stack([at, at + 1], 1), np.arange(-3, -1)
        if dstate is not None:
            rows, last = np.concatenate([rows, [[moved.heading[dstate]]]], 1), np.arange(-3, 0)
        off = moved.mean[last] - moved.mean[rows]
        off[:, 2:] -= math.tau * np.round(off[:, 2:] / math.tau)
        c = moved.covariance
        crossed = c[rows[:, :, None], last[None, None, :]]
        spread = (
            c[np.ix_(last, last)][None]
            + c[rows[:, :, None], rows[:, None, :]]
            - crossed
            - crossed.transpose(0, 2, 1)
            + np.diag(self._spreads[t, : len(last)])
        )
        squares: Array = np.einsum("ni,ni->n", off, np.linalg.solve(spread, off[..., None])[..., 0])
        return squares

    def square_ahead(self, moved: Hypothesis, t: int, dstate: int, actions: Sequence[int]) -> float:
        """Compute the largest chi-square of the next steps if step t is at a known dstate.

        An action at a dstate always leads to the same dstate. So links say where the next steps
        are, until a link is not known. `moved` is a hypothesis after the move to step t.
        `actions` has a number for each action of the trace.
        """
        largest = 0.0
        for k in range(t + 1, min(t + 1 + AHEAD, len(self._trace))):
            there = moved.links.get((dstate, actions[k - 1]))
            if there is None or self._trace.steps[k].displacement is None:
                break
            moved, dstate = self.moved(moved, k), there
            largest = max(largest, float(self.squares(moved, k, [moved.places[dstate]])[0]))
        return largest

    def met(
        self, moved: Hypothesis, t: int, position: int | None, heading: int | None
    ) -> tuple[Array, Array]:
        """Condition the poses on the robot being at a place, and perhaps a dstate, at step t.

        A new place or dstate gets the position or heading of the robot. `position` is the index in
        the means of the x of a known place, and `heading` that of a known dstate; None for new
        ones. New entries, x and y before the heading, come just before the pose of the robot.
        """
        n = len(moved.mean) - 3
        old = [] if position is None else [position, position + 1]
        old += [] if position is None or heading is None else [heading]
        mean, covariance = moved.mean, moved.covariance
        if old:
            mean, covariance, _ = conditioned(
                mean, covariance, [*range(n, n + len(old))], old, self._spreads[t]
            )
        new = [*range(n + len(old), n + 3)]  # entries of the robot that become known
        order = [*range(n), *new, *range(n, n + 3)]
        covariance = covariance[np.ix_(order, order)]
        added = range(n, n + len(new))
        covariance[added, added] += self._spreads[t, len(old) :]
        return mean[order], covariance


def closure_equations(
    mean: Array, first: tuple[int, int], last: tuple[int, int], displacement: Displacement
) -> tuple[Array, Array]:
    """Find how the last pose of a closure, relative to the first one, depends on the means.

    A pose is given by the index of x, before that of y, and the index of the heading.

    Returns:
        The derivatives of the relative pose, (3, n), and by how much it is off the displacement.
    """
    (at, heading), (to, after) = first, last
    cos, sin = math.cos(mean[heading]), math.sin(mean[heading])
    back = np.array([[cos, sin], [-sin, cos]])
    gone = back @ (mean[to : to + 2] - mean[at : at + 2])
    by = np.zeros((3, len(mean)))
    by[:2, to : to + 2], by[:2, at : at + 2] = back, -back
    by[:2, heading] = gone[1], -gone[0]
    by[2, after], by[2, heading] = 1.0, -1.0
    off = np.array([*gone, mean[after] - mean[heading]]) - displacement
    off[2] = math.remainder(off[2], math.tau)
    return by, off


def updated(
    mean: Array, covariance: Array, by: Array, off: Array, noise: Array
) -> tuple[Array, Array, float]:
    """Update a Gaussian by k measurements (a Kalman filter).

    `by` has their derivatives, (k, n), `off` how much too large they are by the means, (k,), and
    `noise` their covariance, (k, k). The chi-square comes last in the result.
    """
    across = covariance @ by.T
    solved = np.linalg.solve(by @ across + noise, np.column_stack([off, across.T]))
    covariance = covariance - across @ solved[:, 1:]
    mean = mean - across @ solved[:, 0]
    return mean, (covariance + covariance.T) / 2, float(off @ solved[:, 0])


def conditioned(
    mean: Array, covariance: Array, first: Sequence[int], second: Sequence[int], spreads: Array
) -> tuple[Array, Array, float]:
    """Condition a Gaussian on the equality of some entries with others, up to some variance.

    `first` and `second` have the indices of entries that should be equal: of x and y, of a heading,
    or of all three. `spreads` has the variance of each difference, in square metres and square
    radians. The chi-square of the differences comes last in the result.
    """
    off = mean[first] - mean[second]
    if len(off) % 2:
        off[-1] = math.remainder(off[-1], math.tau)
    across = covariance[:, first] - covariance[:, second]
    spread = across[first] - across[second] + np.diag(spreads[: len(off)])
    try:
        root = np.linalg.cholesky(spread)
    except np.linalg.LinAlgError:  # large variances were rounded, as after travels of 500 m
        variances, axes = np.linalg.eigh(spread)
        root = axes * np.sqrt(np.maximum(variances, BLUR))
    white = np.linalg.solve(root, across.T)
    misfit = np.linalg.solve(root, off)
    less = white.T @ white  # symmetric
    return mean - misfit @ white, np.subtract(covariance, less, out=less), float(misfit @ misfit)


def first_pose() -> tuple[Array, Array]:
    """Return the means and the covariance before the first step, with the robot at the origin."""
    mean, covariance = np.zeros(5), np.zeros((5, 5))
    covariance[[SCALE, BEND], [SCALE, BEND]] = 1.0
    return mean, covariance
