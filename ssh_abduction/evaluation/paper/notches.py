"""Run the method in the notched rectangle with other notches and other spreads of poses.

This shows how large the notch must be, and how small the spread of poses, for the method to work.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perception.errors import ImageWarning
from perception.quality import uncertainty_coefficient
from perception.reciprocal import ReciprocalTransformer
from perception.views import ViewClusterer
from simulator.control import STILL
from simulator.laser import Laser
from simulator.tours import simulate
from simulator.world import World
from ssh_abduction.data.trace import Trace
from ssh_abduction.evaluation.paper.experiments import (
    EXPERIMENTS,
    VIEWS_ALONE,
    one_to_one,
    rate,
    true_dstates,
)
from ssh_abduction.solver import solve


@dataclass(frozen=True)
class Outcome:
    """The result of the method for one notch and one spread of poses.

    The offset of a pose is its difference from the mean pose at its dstate.

    Attributes:
        notch: The depth of the notch in metres.
        scale: The factor by which the offsets that the robot left are multiplied.
        spread: The root mean square of the multiplied offsets of positions in metres.
        k: The chosen number of views.
        uncertainty: U at that number of views (1 if all images of a dstate have one view).
        right: Whether there is only one minimal map, and its labels are the true dstates, one to
            one.
        rate: The rate, 0 to 1, at which the true dstate is recognised after learning true labels.
    """

    notch: float
    scale: float
    spread: float
    k: int
    uncertainty: float
    right: bool
    rate: float


def outcome(notch: float, scale: float, seed: int = 0) -> Outcome:
    """Take images in the notched rectangle with another notch, and run the method on them.

    Args:
        notch: The depth of the notch in metres.
        scale: The factor for the offsets of the robot's poses from the mean pose at their dstate.
        seed: The seed of all noise.
    """
    warnings.simplefilter("ignore", ImageWarning)
    # Scan at the poses that the robot drove to, with their offsets scaled.
    world = notched(notch)
    means, offsets, truth = _driven(notch, seed)
    rng, laser = np.random.default_rng(seed), Laser()
    scans = [laser.scan(world, means + scale * offsets, rng) for _ in range(STILL)]
    ranges = np.median(scans, axis=0)
    images = ReciprocalTransformer().fit_transform(ranges)
    clusterer = ViewClusterer(k_max=10, n_init=4, random_state=seed).fit(images)
    actions = [world.route[i % len(world.route)] for i in range(len(means) - 1)]
    solution = solve(
        Trace.from_steps(clusterer.labels_.tolist(), actions), VIEWS_ALONE, time_limit=5
    )
    is_only = solution.complete and solution.count == 1
    return Outcome(
        notch=notch,
        scale=scale,
        spread=scale * float(np.sqrt((offsets[:, :2] ** 2).sum(1).mean())),
        k=clusterer.k_,
        uncertainty=uncertainty_coefficient(clusterer.labels_, truth),
        right=is_only and one_to_one(np.array(solution.maps[0].dstate_at), truth),
        rate=rate(ranges, np.unique(truth, return_inverse=True)[1], truth, seed),
    )


def notched(depth: float) -> World:
    """Make the notched rectangle with a notch of this depth in metres."""
    world = World.named("notched-rectangle")
    segments = world.segments.copy()
    segments[:, 1::2] = np.where(segments[:, 1::2] < 0, -depth, segments[:, 1::2])
    return replace(world, segments=segments)


@cache
def _driven(
    notch: float, seed: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[Any]]:
    """Drive all tours. Return each pose's mean at its dstate and its offset, (n, 3), and dstate."""
    trace = simulate(notched(notch), EXPERIMENTS["notched-rectangle"].tours, seed)
    truth = true_dstates(trace)
    poses = np.array([step.truth["pose"] for step in trace.steps])
    means = np.empty_like(poses)
    for name in set(truth):
        here = truth == name
        poses[here, 2] = np.unwrap(poses[here, 2])
        means[here] = poses[here].mean(0)
    return means, poses - means, truth
