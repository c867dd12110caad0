"""Markov localisation over all poses of an occupancy grid, by a histogram filter or by particles.

grid_localisation.py compares these filters with `Localiser`. They are written from the literature:

Thrun, Burgard & Fox 2005, Probabilistic Robotics: the beam model (6.3), the histogram filter (8.2),
Monte Carlo localisation with random particles (8.3), KLD sampling (8.3.7).

Fox, Burgard & Thrun 1999, Markov localization for mobile robots in dynamic environments: a table
of expected ranges that is made beforehand (4.1).

A pose is a free cell and a heading. The belief is p(pose | all ranges and displacements so far). A
displacement moves the belief, and blurs it by the covariance of the displacement and the size of
the cells. An image weighs the belief by the beam model. With a small probability, the robot was
kidnapped (carried without notice) and is anywhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage
from scipy.special import log_ndtr, ndtr

from simulator.robot import BEARINGS
from simulator.world import World

Array = NDArray[np.float64]
Pose = tuple[float, float, float]
# Expected ranges are stored as centimetres in two bytes. The laser's noise is half a centimetre.
STEP = 0.01
# The least blur of a displacement, in cells, as a grid cannot represent a narrower Gaussian.
LEAST_BLUR = 0.3
# Selective updating (Fox, Burgard & Thrun 1999, 4.2): headings at which all poses are less probable
# than this share of the uniform probability are not moved.
IDLE = 0.1


@dataclass(frozen=True)
class BeamModel:
    """The likelihood of a range, given the expected one: a mixture of four parts.

    Probabilistic Robotics, table 6.1. The defaults are those of ROS's AMCL, scaled to sum to one.

    Attributes:
        hit: Weight of the expected wall, with Gaussian noise.
        short: Weight of nearer things such as persons, with an exponential density up to the
            expected range.
        lost: Weight of a beam that does not return; its range is `reach`.
        any: Weight of a range that is uniform between 0 and `reach`.
        sigma: Standard deviation of `hit`, in metres.
        rate: Rate of the exponential density of `short`, per metre.
        reach: The longest range, in metres. Anything farther away has this range.
        beams: Degrees from each beam that is used to the next. The model assumes independent
            beams, but neighbouring beams err together.
    """

    hit: float = 0.95
    short: float = 0.1
    lost: float = 0.05
    any: float = 0.05
    sigma: float = 0.2
    rate: float = 0.1
    reach: float = 8.0
    beams: int = 10

    def log_likelihood(self, measured: float | Array, expected: Array) -> Array:
        """Compute the log likelihood of ranges.

        Args:
            measured: Measured ranges in metres.
            expected: Expected ranges in metres, in a shape that broadcasts with `measured`.

        Returns:
            The log density for a range below `reach`, and the log probability for `reach` itself.
        """
        z, e = np.broadcast_arrays(np.asarray(measured, float), np.asarray(expected, float))
        total = self.hit + self.short + self.lost + self.any
        nearer = np.maximum(e, STEP)
        # Gaussian noise makes no range below 0, so the Gaussian is cut off there.
        scale = np.exp(log_ndtr(e / self.sigma))
        bell = (
            np.exp(-(((z - e) / self.sigma) ** 2) / 2)
            / (self.sigma * math.sqrt(2 * math.pi))
            / scale
        )
        decay = self.rate * np.exp(-self.rate * z) / -np.expm1(-self.rate * nearer) * (z <= nearer)
        inside = self.hit * bell + self.short * decay + self.any / self.reach
        beyond = self.hit * ndtr((e - self.reach) / self.sigma) / scale + self.lost
        logs: Array = np.log(np.where(z < self.reach, inside, beyond) / total)
        return logs


@dataclass(frozen=True, eq=False)
class Grid:
    """An occupancy grid, and the ranges that a laser would measure in it.

    Attributes:
        resolution: Side of a cell, in metres.
        headings: Number of evenly spaced headings.
        origin: x and y of the corner of cell (0, 0), in metres.
        occupied: (rows, columns) mask of the cells with walls.
        free: (rows, columns) mask of the cells where the robot may be, which are connected with its
            start.
        ranges: (free cells, headings) expected range from the middle of each free cell in the
            direction of each heading, in units of STEP. Directions are turned by half a degree,
            like the beams of the laser.
    """

    resolution: float
    headings: int
    origin: tuple[float, float]
    occupied: NDArray[np.bool_] = field(repr=False)
    free: NDArray[np.bool_] = field(repr=False)
    ranges: NDArray[np.uint16] = field(repr=False)

    @classmethod
    def of(
        cls, world: World, resolution: float = 0.1, headings: int = 72, reach: float = 8.0
    ) -> Grid:
        """Make the grid of a world's walls. Clutter is where the world's file has it.

        Args:
            world: The world.
            resolution: Side of a cell in metres.
            headings: Number of headings, a multiple of 72.
            reach: Largest expected range in metres.

        Raises:
            ValueError: The number of headings is no multiple of 72.
        """
        if headings % 72:
            raise ValueError(
                f"headings: expected a multiple of 72, so that beams point along headings, "
                f"got {headings}"
            )
        segments = np.vstack([world.segments, *(item.segments for item in world.clutter)])
        points = np.vstack([_along(s, resolution / 4) for s in segments])
        low = points.min(0) - 1.5 * resolution
        cells = np.floor((points - low) / resolution).astype(int)
        columns, rows = cells.max(0) + 2
        occupied = np.zeros((rows, columns), bool)
        occupied[cells[:, 1], cells[:, 0]] = True
        parts, _ = ndimage.label(~occupied)
        column, row = np.floor((np.array(world.start[:2]) - low) / resolution).astype(int)
        free = parts == parts[row, column]
        return cls(
            resolution,
            headings,
            (float(low[0]), float(low[1])),
            occupied,
            free,
            _cast(occupied, free, resolution, headings, reach),
        )

    @cached_property
    def centres(self) -> Array:
        """The middles of the free cells: (free cells, 2), metres."""
        rows, columns = np.nonzero(self.free)
        return np.asarray(
            (np.column_stack([columns, rows]) + 0.5) * self.resolution + np.array(self.origin),
            np.float64,
        )

    @cached_property
    def number(self) -> NDArray[np.int32]:
        """The number of each free cell, and -1 for other cells: (rows, columns)."""
        found = np.full(self.free.shape, -1, np.int32)
        found[self.free] = np.arange(self.free.sum())
        return found

    @cached_property
    def angles(self) -> Array:
        """The headings: (headings,), radians."""
        return np.asarray(np.arange(self.headings) * (math.tau / self.headings), np.float64)

    def likelihoods(
        self, image: Array, model: BeamModel
    ) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
        """Make tables by which poses are weighed, for the b beams of an image that are used.

        Args:
            image: (180,) ranges in metres.
            model: The beam model.

        Returns:
            (b,) direction of each beam relative to the heading of the robot, as a number of
            headings; and (b, units) log p(range | expected range) for each beam and each expected
            range in units of STEP.
        """
        every = model.beams
        used = np.arange(every // 2, len(image), every)
        offsets = np.rint((BEARINGS[used] - math.radians(0.5)) / (math.tau / self.headings)).astype(
            int
        )
        expected = np.linspace(0.0, model.reach, round(model.reach / STEP) + 1)
        return offsets, model.log_likelihood(image[used, None], expected).astype(np.float32)


def _along(segment: Array, step: float) -> Array:
    """Points on a segment, (n, 2), at most `step` metres apart."""
    start, end = segment[:2], segment[2:]
    count = max(2, math.ceil(float(np.hypot(*(end - start))) / step) + 1)
    return np.asarray(start + np.linspace(0, 1, count)[:, None] * (end - start))


def _cast(
    occupied: NDArray[np.bool_],
    free: NDArray[np.bool_],
    resolution: float,
    headings: int,
    reach: float,
) -> NDArray[np.uint16]:
    """The expected ranges of a grid: (free cells, headings), in units of STEP.

    For each direction, the rays from all cells grow at once, by half a cell at a time, until they
    meet an occupied cell.
    """
    rows, columns = np.nonzero(free)
    ranges = np.full((len(rows), headings), round(reach / STEP), np.uint16)
    for h in range(headings):
        angle = h * math.tau / headings + math.radians(0.5)
        left = np.arange(len(rows))
        for stride in range(1, math.ceil(2 * reach / resolution)):
            way = stride / 2
            row = (
                np.floor(rows[left] + 0.5 + way * math.sin(angle))
                .astype(int)
                .clip(0, occupied.shape[0] - 1)
            )
            column = (
                np.floor(columns[left] + 0.5 + way * math.cos(angle))
                .astype(int)
                .clip(0, occupied.shape[1] - 1)
            )
            hit = occupied[row, column]
            ranges[left[hit], h] = round(way * resolution / STEP)
            left = left[~hit]
            if not len(left):
                break
    return ranges


class Filter(Protocol):
    """A belief over poses."""

    def moved(self, displacement: Sequence[float], covariance: Array) -> None:
        """Update the belief with a displacement.

        Args:
            displacement: Metres ahead, metres to the left, and radians turned.
            covariance: (3, 3) covariance of the displacement.
        """

    def seen(self, image: Array) -> None:
        """Update the belief with an image: 180 ranges in metres."""

    def best(self) -> Pose:
        """Return the most probable pose: x and y in metres, heading in radians."""
        ...

    def mass(self, pose: Sequence[float], near: float, turned: float) -> float:
        """Compute the probability that the robot is within `near` m and `turned` rad of a pose."""
        ...

    @property
    def bytes(self) -> int:
        """The size of the belief in bytes."""
        ...


class Histogram:
    """A probability for each pose of a grid (Probabilistic Robotics, table 8.1).

    Attributes:
        slipped: Probability at each step that the robot is anywhere, whatever its odometry says.
        probability: (headings, rows, columns) probability of each pose.
    """

    def __init__(self, grid: Grid, model: BeamModel | None = None, slipped: float = 0.01) -> None:
        self.grid, self.model, self.slipped = grid, model or BeamModel(), slipped
        self.anywhere = 1 / (float(grid.free.sum()) * grid.headings)
        self.probability = np.where(grid.free, np.float32(self.anywhere), np.float32(0)) * np.ones(
            (grid.headings, 1, 1), np.float32
        )

    @property
    def bytes(self) -> int:
        return self.probability.nbytes

    def moved(self, displacement: Sequence[float], covariance: Array) -> None:
        """Move the belief and blur it with a Gaussian, separately for each heading.

        In the frequency domain, both are a single product, even if the motion is no multiple of a
        cell. A heading represents all directions of its bin, so the belief spreads sideways with
        the distance. The correlation of errors of heading and position within a step is neglected.

        Args:
            displacement: Metres ahead, metres to the left, and radians turned.
            covariance: (3, 3) covariance of the displacement.
        """
        grid = self.grid
        dx, dy, turned = displacement
        way, size, bin_ = math.hypot(dx, dy), grid.resolution, math.tau / grid.headings
        rows, columns = grid.free.shape
        margin = math.ceil(way / size) + 8
        shape = fft.next_fast_len(rows + margin), fft.next_fast_len(columns + margin, real=True)
        ky, kx = math.tau * fft.fftfreq(shape[0])[:, None], math.tau * fft.rfftfreq(shape[1])
        aside = np.array([-dy, dx]) * (bin_ / math.sqrt(12))
        spread = np.asarray(covariance)[:2, :2] + np.outer(aside, aside)
        for h in np.flatnonzero(self.probability.max(axis=(1, 2)) > IDLE * self.anywhere):
            angle = grid.angles[h]
            cos, sin = math.cos(angle), math.sin(angle)
            turn = np.array([[cos, -sin], [sin, cos]])
            x, y = turn @ (dx, dy) / size
            (xx, xy), (_, yy) = turn @ spread @ turn.T / size**2 + LEAST_BLUR**2 * np.eye(2)
            kernel = np.exp(
                -1j * (kx * x + ky * y) - (xx * kx**2 + 2 * xy * kx * ky + yy * ky**2) / 2
            )
            layer = fft.irfft2(fft.rfft2(self.probability[h].astype(float), shape) * kernel, shape)
            self.probability[h] = np.maximum(layer[:rows, :columns], 0)
        k = math.tau * fft.rfftfreq(grid.headings)
        variance = max(float(covariance[2][2]) / bin_**2, LEAST_BLUR**2)
        kernel = np.exp(-1j * k * (turned / bin_) - variance * k**2 / 2)
        spectrum = fft.rfft(self.probability, axis=0) * kernel[:, None, None].astype(np.complex64)
        self.probability = (
            np.maximum(fft.irfft(spectrum, grid.headings, axis=0), 0).astype(np.float32) * grid.free
        )
        total = float(self.probability.sum(dtype=float))
        self.probability *= np.float32((1 - self.slipped) / total if total > 0 else 0.0)
        self.probability += np.where(
            grid.free,
            np.float32((self.slipped if total > 0 else 1.0) * self.anywhere),
            np.float32(0),
        )

    def seen(self, image: Array) -> None:
        grid = self.grid
        offsets, logs = grid.likelihoods(image, self.model)
        likely = np.zeros((grid.headings, len(grid.ranges)), np.float32)
        for h in range(grid.headings):
            for offset, log in zip(offsets, logs, strict=True):
                likely[h] += log[grid.ranges[:, (h + offset) % grid.headings]]
        weighed = self.probability[:, grid.free] * np.exp(likely - likely.max())
        self.probability[:, grid.free] = weighed / weighed.sum(dtype=float)

    def best(self) -> Pose:
        h, row, column = np.unravel_index(int(self.probability.argmax()), self.probability.shape)
        x, y = (
            np.array([column, row]) * self.grid.resolution
            + self.grid.resolution / 2
            + np.array(self.grid.origin)
        )
        return float(x), float(y), float(self.grid.angles[h])

    def mass(self, pose: Sequence[float], near: float, turned: float) -> float:
        here = np.hypot(*(self.grid.centres - pose[:2]).T) <= near
        facing = _apart(self.grid.angles, pose[2]) <= turned + 1e-9
        return float(self.probability[facing][:, self.grid.free][:, here].sum(dtype=float))


class Particles:
    """Poses drawn from the belief: Monte Carlo localisation (Probabilistic Robotics, 8.2 and 8.4).

    The expected ranges are the same as for `Histogram`.

    Attributes:
        dense: Number of particles per square metre of free cells if the robot may be anywhere.
        error: KLD sampling draws enough particles to be within this distance (Kullback-Leibler
            divergence) of the belief with a probability of 99 %. The default is that of AMCL.
        least: The smallest number of particles. The default is twenty times that of AMCL, as fewer
            particles lose poses that look alike.
        slipped: Probability at each step that the robot is anywhere. At each step, particles that
            are drawn from anywhere get this weight. If they explain an image better than the
            others, all particles are drawn from anywhere and weighed by that image (sensor
            resetting, Lenser & Veloso 2000).
    """

    BIN = np.array(
        [0.5, 0.5, math.radians(10)]
    )  # AMCL's bins for KLD sampling: metres, metres, radians

    def __init__(
        self,
        grid: Grid,
        model: BeamModel | None = None,
        slipped: float = 0.01,
        *,
        dense: float = 4000.0,
        error: float = 0.01,
        least: int = 2000,
        seed: int = 0,
    ) -> None:
        self.grid, self.model, self.slipped = grid, model or BeamModel(), slipped
        self.error, self.least, self.rng = error, least, np.random.default_rng(seed)
        self.most = max(least, round(dense * float(grid.free.sum()) * grid.resolution**2))
        self._begin()

    def _begin(self) -> None:
        self.poses, self.weights = self._drawn(self.most), np.full(self.most, 1 / self.most)
        self.fresh = 0  # number of particles, at the end, drawn from anywhere for this step

    @property
    def bytes(self) -> int:
        return self.poses.nbytes + self.weights.nbytes

    def _drawn(self, count: int) -> Array:
        """Draw poses uniformly: (count, 3)."""
        cells = self.grid.centres[self.rng.integers(len(self.grid.centres), size=count)]
        return np.column_stack(
            [
                cells + self.rng.uniform(-0.5, 0.5, (count, 2)) * self.grid.resolution,
                self.rng.uniform(0, math.tau, count),
            ]
        )

    def moved(self, displacement: Sequence[float], covariance: Array) -> None:
        self._resample()
        dx, dy, turned = self.rng.multivariate_normal(
            displacement, covariance, size=len(self.poses), method="cholesky"
        ).T
        cos, sin = np.cos(self.poses[:, 2]), np.sin(self.poses[:, 2])
        self.poses += np.column_stack([cos * dx - sin * dy, sin * dx + cos * dy, turned])
        self.poses[:, 2] %= math.tau
        self.fresh = math.ceil(self.slipped * self.most)
        if self.fresh:
            self.poses = np.vstack([self.poses, self._drawn(self.fresh)])
            self.weights = np.append(
                self.weights * (1 - self.slipped), np.full(self.fresh, self.slipped / self.fresh)
            )

    def seen(self, image: Array) -> None:
        if self._weigh(image):
            return
        self._begin()
        self._weigh(image)

    def _weigh(self, image: Array) -> bool:
        """Weigh the particles by an image.

        Returns:
            Whether the particles that followed the robot explain the image at least as well as
            those that were drawn from anywhere.
        """
        grid = self.grid
        offsets, logs = grid.likelihoods(image, self.model)
        columns, rows = np.floor((self.poses[:, :2] - grid.origin) / grid.resolution).astype(int).T
        inside = (
            (rows >= 0)
            & (columns >= 0)
            & (rows < grid.free.shape[0])
            & (columns < grid.free.shape[1])
        )
        cells = np.where(inside, grid.number[rows * inside, columns * inside], -1)
        h = np.rint(self.poses[:, 2] / (math.tau / grid.headings)).astype(int)
        weights = np.where(cells < 0, -np.inf, np.log(np.maximum(self.weights, 1e-300)))
        for offset, log in zip(offsets, logs, strict=True):
            weights += log[grid.ranges[cells, (h + offset) % grid.headings]]
        if not np.isfinite(weights.max()):
            return False
        weights = np.exp(weights - weights.max())
        self.weights = weights / weights.sum()
        return float(self.weights[len(weights) - self.fresh :].sum()) <= 0.5

    def _resample(self) -> None:
        """Draw the number of particles that KLD sampling needs, in proportion to their weights.

        Probabilistic Robotics, tables 4.4 and 8.4.
        """
        bins = len(np.unique(self._bins(self.poses[np.unique(self._chosen(self.most))])))
        self.poses = self.poses[
            self._chosen(min(self.most, max(self.least, _kld(bins, self.error))))
        ]
        self.weights = np.full(len(self.poses), 1 / len(self.poses))

    def _bins(self, poses: Array) -> NDArray[np.intp]:
        """The number of the bin of each pose, (n,)."""
        indices = np.floor(poses / self.BIN).astype(np.intp)
        return np.asarray(indices @ (1, 1 << 20, 1 << 40))

    def _chosen(self, count: int) -> NDArray[np.intp]:
        places = (np.arange(count) + self.rng.random()) / count
        return np.minimum(np.searchsorted(np.cumsum(self.weights), places), len(self.weights) - 1)

    def best(self) -> Pose:
        """Compute the mean pose of the particles in the bin with the most weight."""
        _, of = np.unique(self._bins(self.poses), return_inverse=True)
        heaviest = of == np.bincount(of, self.weights).argmax()
        x, y, heading = np.average(self.poses[heaviest], axis=0, weights=self.weights[heaviest])
        return float(x), float(y), float(heading)

    def mass(self, pose: Sequence[float], near: float, turned: float) -> float:
        here = np.hypot(*(self.poses[:, :2] - pose[:2]).T) <= near
        return float(self.weights[here & (_apart(self.poses[:, 2], pose[2]) <= turned)].sum())


def _kld(bins: int, error: float) -> int:
    """The number of particles that KLD sampling needs for a number of occupied bins.

    Probabilistic Robotics, equation 8.12, with Wilson and Hilferty's approximation of chi-square.
    2.326 is the normal quantile of 99 %.
    """
    if bins < 2:
        return 0
    part = 2 / (9 * (bins - 1))
    return math.ceil((bins - 1) / (2 * error) * (1 - part + math.sqrt(part) * 2.326) ** 3)


def _apart(angles: Array, angle: float) -> Array:
    return np.abs((angles - angle + math.pi) % math.tau - math.pi)
