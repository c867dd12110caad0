"""Makes what a robot logs on a tour: images, and displacements with their noise."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from simulator.driver import Driver, Tolerance
from simulator.odometer import DIGITS
from simulator.panorama import Camera
from simulator.robot import Body, Report, SimulatedRobot
from ssh_abduction.data.odometry import Covariance, Displacement
from ssh_abduction.data.odometry import Odometry as Noise

Array = NDArray[np.float64]


@dataclass
class Eye:
    """Makes the logged image of a step: ranges of the laser, or a panorama."""

    camera: Camera | None  # the camera; None to log ranges
    walls: int  # number of segments of the world without clutter
    rng: np.random.Generator  # source of noise of the camera
    # Number of actions of the whole drive. The hour of the day follows from the share that is done.
    actions: int

    def image(self, driver: Driver, ranges: Array, done: int) -> tuple[float, ...]:
        """Make the image of a step, after `done` actions.

        It has ranges of the laser in metres, or the pixels of a panorama, row by row.
        """
        if self.camera is None:
            return tuple(round(float(r), 4) for r in ranges)
        hour = self.camera.hour(done / max(self.actions - 1, 1))
        shot = self.camera.shot(driver.world, driver.robot.pose, self.rng, hour, self.walls)
        return tuple(shot.ravel().tolist())


@dataclass
class OdometryLog:
    """Collects the odometry between the logged steps."""

    robot: SimulatedRobot  # whose odometry is collected
    # Motion by odometry from each step to the next.
    reports: list[Report] = field(default_factory=list)
    begun: bool = False  # whether a step was logged already on this floor

    def displacement(self) -> Displacement | None:
        """Return metres ahead and to the left and radians turned since the last step by odometry.

        They are rounded. None at a floor's first step.
        """
        report = self.robot.report()
        if not self.begun:
            self.begun = True
            return None
        self.reports.append(report)
        dx, dy, turned = (round(v, DIGITS) for v in report.displacement)
        return dx, dy, turned


def noise_model(reports: Sequence[Report], body: Body, tolerance: Tolerance | None = None) -> Noise:
    """Make a noise model of displacements between dstates, from reports of odometry and climbing.

    The error of each small motion is proportional to the motion, so the relative error of many
    motions together is smaller. The relative errors of the model are chosen so that they
    reproduce the mean covariance of the reports. A map describes fixed points. Hill-climbing
    ends only within its tolerance of the fixed points at both ends of a displacement. The model
    assumes a uniform distribution of this error. A wrong heading at the beginning also moves
    the end sideways. The tolerance is None if displacements are not between fixed points.
    """
    ways = math.fsum(math.hypot(*r.displacement[:2]) ** 2 for r in reports)
    turns = math.fsum(r.displacement[2] ** 2 for r in reports)
    along, across, heading = (
        np.sum([np.diag(r.covariance) for r in reports], axis=0) if reports else np.zeros(3)
    )
    # Choose relative errors that reproduce the total variance of all reports.
    share = 1 / ways if ways else 0.0
    offset = tolerance.close / math.sqrt(3) if tolerance else 0.0
    tilt = tolerance.straight / math.sqrt(3) if tolerance else 0.0
    errors = {
        "along": math.sqrt(along * share),
        "across": math.sqrt(across * share + tilt**2),
        "heading": math.sqrt(max(heading - body.odometry**2 * turns, 0.0) * share),
        "turning": body.odometry,
        "position": math.sqrt(2) * offset,
        "angle": math.sqrt(2) * tilt,
        "scale": abs(body.scale),
        "bend": abs(body.bend),
    }
    return Noise.of({name: round(error, 6) for name, error in errors.items()})


def covariance_of(report: Report, tolerance: Tolerance, action: str) -> Covariance:
    """Compute the covariance of a displacement between fixed points, reported by odometry.

    It includes the errors of odometry and of hill-climbing, which ends anywhere within its
    tolerance. At both ends of a turn, the fixed point is the same, to a millimetre.
    """
    dx, dy, _ = report.displacement
    near = tolerance.close / math.sqrt(3) if action == "travel" else 0.001
    left = np.diag([near**2, near**2, tolerance.straight**2 / 3])
    # A wrong heading moves the end sideways.
    by_start = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    whole = report.covariance + by_start @ left @ by_start.T + left
    a, b, c = (tuple(float(f"{v:.4g}") for v in row) for row in (whole + whole.T) / 2)
    return a, b, c  # type: ignore[return-value]
