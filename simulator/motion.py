"""Motions in the plane: poses, the displacements between them, and what odometry makes of these.

>>> from simulator.motion import between, moved
>>> moved((1.0, 2.0, math.pi / 2), (3.0, 0.0, 0.0))[:2]
(1.0, 5.0)
>>> [round(v, 6) for v in between((1.0, 2.0, math.pi / 2), (1.0, 5.0, math.pi))]
[3.0, 0.0, 1.570796]
"""

from __future__ import annotations

import math

import numpy as np

from ssh_abduction.data.odometry import Displacement, Odometry, Pose, between, moved

__all__ = ["DIGITS", "Pose", "between", "moved", "reported"]

# What is reported is rounded to so many digits after the point, as in a log.
DIGITS = 5


def reported(
    displacement: Displacement,
    odometry: Odometry,
    rng: np.random.Generator,
    *,
    scale: float = 0.0,
    bend: float = 0.0,
) -> Displacement:
    """What odometry reports of a displacement: noise is drawn from the covariance, and added to what the errors that repeat make of it.

    scale  by this share all ways are reported longer than they are
    bend   by so many radians a metre the heading that is reported drifts to the left, steadily along the way
    """
    dx, dy, turned = displacement
    drift = bend * math.hypot(dx, dy)
    cos, sin = (
        (1 + scale) * math.cos(drift / 2),
        (1 + scale) * math.sin(drift / 2),
    )  # on the average the way is half of the drift off
    noise = np.linalg.cholesky(np.array(odometry.covariance(displacement))) @ rng.normal(size=3)
    x, y, heading = np.array([cos * dx - sin * dy, sin * dx + cos * dy, turned + drift]) + noise
    return round(float(x), DIGITS), round(float(y), DIGITS), round(float(heading), DIGITS)
