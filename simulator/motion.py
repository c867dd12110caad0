"""Poses in the plane, the displacements between them, and the errors of odometry.

>>> from simulator.motion import displacement_between, moved
>>> [round(v, 6) for v in moved((1.0, 2.0, math.pi / 2), (3.0, 0.0, 0.0))[:2]]
[1.0, 5.0]
>>> [round(v, 6) for v in displacement_between((1.0, 2.0, math.pi / 2), (1.0, 5.0, math.pi))]
[3.0, 0.0, 1.570796]
"""

from __future__ import annotations

import math

import numpy as np

from ssh_abduction.data.odometry import Displacement, Odometry, Pose, displacement_between, moved

__all__ = ["DIGITS", "Pose", "displacement_between", "moved", "reported"]

# Reported numbers are rounded to this many decimals, as in a log.
DIGITS = 5


def reported(
    displacement: Displacement,
    odometry: Odometry,
    rng: np.random.Generator,
    *,
    scale: float = 0.0,
    bend: float = 0.0,
) -> Displacement:
    """Add systematic errors and random noise to a displacement, as odometry reports it, rounded.

    A displacement is metres ahead and to the left, and radians turned. The noise is drawn with
    the covariance of the odometry. Reported distances are too long by the share `scale`. The
    reported heading drifts to the left by `bend` radians per metre.
    """
    dx, dy, turned = displacement
    drift = bend * math.hypot(dx, dy)
    # On average, the direction of motion is off by half of the drift.
    cos, sin = ((1 + scale) * math.cos(drift / 2), (1 + scale) * math.sin(drift / 2))
    noise = np.linalg.cholesky(np.array(odometry.covariance(displacement))) @ rng.normal(size=3)
    x, y, heading = np.array([cos * dx - sin * dy, sin * dx + cos * dy, turned + drift]) + noise
    return round(float(x), DIGITS), round(float(y), DIGITS), round(float(heading), DIGITS)
