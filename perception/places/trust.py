"""How much an odometer is trusted from one scan to the next."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.readers.scans import Pose


@dataclass(frozen=True)
class Trust:
    """Standard deviations of the errors of an odometer from one scan to the next.

    Attributes:
        way: Error along the motion, as a share of its length; half of that across.
        offset: Additional error of the position, in metres.
        turning: Error of the heading, as a share of the turn.
        drift: Error of the heading for each metre, in radians.
        angle: Additional error of the heading, in radians.
    """

    way: float = 0.1
    offset: float = 0.03
    turning: float = 0.1
    drift: float = 0.02
    angle: float = 0.02

    def covariance(self, onward: Pose) -> NDArray[np.float64]:
        """Compute the covariance of a motion by odometry.

        Args:
            onward: Motion ahead and to the left in metres, and turn in radians.

        Returns:
            (3, 3), in the frame of the robot before the motion.
        """
        way = math.hypot(onward[0], onward[1])
        along, across = self.offset + self.way * way, self.offset + self.way * way / 2
        heading = self.angle + self.turning * abs(onward[2]) + self.drift * way
        return np.diag([along**2, across**2, heading**2])
