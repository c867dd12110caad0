"""Robust pose graphs: which closures of a trace are right, and what its poses are, by gtsam.

Each function gets a trace. Its displacements are right up to their noise, and any of its closures
may be false. The errors of scale and drift (`scale` and `bend`) are not modelled.

References:
    Yang et al. 2020, "Graduated non-convexity for robust spatial perception" (`graduated`).
    Jiang et al. 2021, "iMHS: an incremental multi-hypothesis smoother" (`hybrid`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np
from scipy.stats import chi2

from ssh_abduction import Trace
from ssh_abduction.data.odometry import Pose, moved

# The misfit of a closure that is right is below the threshold with this probability.
INLIERS = 0.99
# The hybrid smoother: the probability that a closure is right, and the standard deviations of the
# displacement of a false one, in metres and radians.
RIGHT, ANYWHERE = 0.5, (30.0, 30.0, math.pi)
# The hybrid smoother keeps this many hypotheses. After each step with closures, it is linearised
# again this often.
LEAVES, ROUNDS = 10, 2


@dataclass(frozen=True)
class Fitted:
    """What a pose graph says.

    Attributes:
        poses: Pose of each step, in metres and radians.
        weights: How far each closure is believed, from 0 to 1.
        confidence: Probability that just the believed closures are right; None if not known.
        p: Probability of a larger misfit of the displacements and the believed closures.
    """

    poses: tuple[Pose, ...]
    weights: tuple[float, ...]
    confidence: float | None
    p: float


def installed() -> bool:
    return find_spec("gtsam") is not None


def graduated(trace: Trace) -> Fitted:
    """Fit poses by graduated non-convexity, with gtsam's parameters for all but the threshold.

    The displacements are known to be right (`setKnownInliers`). The fit begins at dead reckoning.
    """
    import gtsam

    graph = gtsam.NonlinearFactorGraph()
    for factor in [*_way(trace), *_closures(trace)]:
        graph.add(factor)
    params = gtsam.GncLMParams(gtsam.LevenbergMarquardtParams())
    params.setKnownInliers(list(range(len(trace))))
    optimizer = gtsam.GncLMOptimizer(graph, _dead_reckoning(trace), params)
    optimizer.setInlierCostThresholdsAtProbability(INLIERS)
    values = optimizer.optimize()
    weights = tuple(float(w) for w in optimizer.getWeights()[len(trace) :])
    return _fitted(trace, values, weights, None)


def hybrid(trace: Trace) -> Fitted:
    """Fit poses by the hybrid smoother, with a mode for each closure: right, or false.

    The closures come in the order of their later steps, as the robot drives. All but the LEAVES
    most probable hypotheses are dropped after each of these steps. A smoother linearises a factor
    once, at the poses that were known then; its `relinearize` keeps all 2^n hypotheses. So after
    each step with closures, another smoother gets all factors again, ROUNDS times, at the poses of
    the most probable hypothesis.
    """
    import gtsam

    values, reached = gtsam.Values(), -1
    for end in sorted({*(closure.last for closure in trace.closures), len(trace) - 1}):
        pose = values.atPose2(reached) if values.size() else gtsam.Pose2()
        for t in range(reached + 1, end + 1):
            pose = pose.compose(gtsam.Pose2(*(trace.steps[t].displacement or (0.0, 0.0, 0.0))))
            values.insert(t, pose)
        for _ in range(ROUNDS):
            smoother = _smoothed(trace, values, end)
            values = values.retract(smoother.optimize().continuous())
        reached = end
    net = smoother.hybridBayesNet()
    chosen = net.mpe()
    weights = tuple(float(chosen[gtsam.symbol("m", i)]) for i in range(len(trace.closures)))
    return _fitted(trace, values, weights, float(net.discreteMarginal().evaluate(chosen)))


def _smoothed(trace: Trace, values: Any, end: int) -> Any:
    """Give a hybrid smoother the factors of the steps up to `end`, linearised at `values`."""
    import gtsam

    anywhere = gtsam.noiseModel.Diagonal.Sigmas(np.array(ANYWHERE))
    smoother, way, closures = gtsam.HybridSmoother(), _way(trace), _closures(trace)
    graph = gtsam.HybridNonlinearFactorGraph()
    for t in range(end + 1):
        graph.push_back(way[t])
        last = [i for i, closure in enumerate(trace.closures) if closure.last == t]
        for i in last:
            moved = gtsam.Pose2(*trace.closures[i].displacement)
            false = gtsam.BetweenFactorPose2(trace.closures[i].first, t, moved, anywhere)
            kinds = [(false, -math.log(1 - RIGHT)), (closures[i], -math.log(RIGHT))]
            graph.push_back(gtsam.HybridNonlinearFactor((gtsam.symbol("m", i), 2), kinds))
        if last or t == end:
            smoother.update(graph, values, LEAVES)
            graph = gtsam.HybridNonlinearFactorGraph()
    return smoother


def _way(trace: Trace) -> list[Any]:
    """Make the factors of the displacements, after one that fixes the first pose."""
    import gtsam

    exact = gtsam.noiseModel.Diagonal.Sigmas(np.full(3, 1e-6))
    factors: list[Any] = [gtsam.PriorFactorPose2(0, gtsam.Pose2(), exact)]
    for t, step in enumerate(trace.steps[1:], 1):
        noise = gtsam.noiseModel.Gaussian.Covariance(np.array(trace.covariance(t)))
        factors.append(gtsam.BetweenFactorPose2(t - 1, t, gtsam.Pose2(*step.displacement), noise))
    return factors


def _closures(trace: Trace) -> list[Any]:
    import gtsam

    return [
        gtsam.BetweenFactorPose2(
            closure.first,
            closure.last,
            gtsam.Pose2(*closure.displacement),
            gtsam.noiseModel.Gaussian.Covariance(np.array(closure.covariance)),
        )
        for closure in trace.closures
    ]


def _dead_reckoning(trace: Trace) -> Any:
    import gtsam

    values, pose = gtsam.Values(), (0.0, 0.0, 0.0)
    for t, step in enumerate(trace.steps):
        pose = moved(pose, step.displacement or (0.0, 0.0, 0.0))
        values.insert(t, gtsam.Pose2(*pose))
    return values


def _fitted(trace: Trace, values: Any, weights: tuple[float, ...], sure: float | None) -> Fitted:
    poses = [values.atPose2(t) for t in range(len(trace))]
    believed = [f for f, w in zip(_closures(trace), weights, strict=True) if w > 0.5]
    misfit = 2 * sum(factor.error(values) for factor in [*_way(trace), *believed])
    p = float(chi2.sf(misfit, 3 * len(believed))) if believed else 1.0
    return Fitted(tuple((q.x(), q.y(), q.theta()) for q in poses), weights, sure, p)
