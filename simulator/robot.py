"""A robot that drives and turns (a unicycle). Motions and odometry have errors."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulator.errors import SimulatorError
from ssh_abduction.data.checks import a_number
from ssh_abduction.data.odometry import Displacement, Pose, displacement_between

# Largest errors of odometry, as a share and in radians per metre. With larger ones, the robot does
# not notice that it left a place.
WORST = 0.5
# Options of `simulate` for these errors.
OPTIONS = {"odometry": "odometry-noise", "scale": "scale-error", "bend": "bend-error"}


@dataclass(frozen=True)
class Body:
    """The size of a robot, and the errors of its motions and its odometry.

    Attributes:
        radius: Radius in metres. The robot collides with a wall that is nearer to its middle.
        slip: Standard deviation of the actual motion, as a share of the commanded motion.
        wander: Standard deviation of the heading, in radians for each metre of a motion.
        odometry: Standard deviation of the reported motion, as a share of the actual motion.
        scale: Share by which reported distances are too long, as with worn wheels.
        bend: Radians a metre by which the reported heading drifts to the left, as with wheels of
            unequal size.

    Raises:
        SimulatorError: An error of the odometry is no number, or too large to drive with.
    """

    radius: float = 0.2
    slip: float = 0.05
    wander: float = 0.02
    odometry: float = 0.02
    scale: float = 0.0
    bend: float = 0.0

    def __post_init__(self) -> None:
        for name, least in (("odometry", 0.0), ("scale", -WORST), ("bend", -WORST)):
            mend = f"choose a smaller error (--{OPTIONS[name]})"
            if name == "bend":
                mend += f"; {WORST} radians per metre are {math.degrees(WORST):.1f} degrees"
            a_number(f"body.{name}", getattr(self, name), SimulatorError, least, WORST, mend=mend)


@dataclass(frozen=True)
class Report:
    """The motion of a robot by odometry since the last report."""

    displacement: Displacement  # in the frame of the robot at the last report
    covariance: NDArray[np.float64]  # (3, 3), of its noise, without systematic errors


class SimulatedRobot:
    """A robot with its true pose, which only the simulator knows, and its odometry.

    `pose` is where it starts: x and y in metres, heading in radians. `rng` is the source of errors.
    """

    def __init__(self, body: Body, pose: Pose, rng: np.random.Generator) -> None:
        self.body = body  # errors of its motions and its odometry
        self.pose = pose  # the true one
        self.driven = 0.0  # metres driven, forward or back, by odometry
        self.odometry: Pose = (0.0, 0.0, 0.0)  # pose by odometry, which starts at (0, 0, 0)
        self._rng = rng
        self._reported = self.odometry  # The odometry at the last report.
        # Covariance of odometry since the last report, in the start frame.
        self._covariance = np.zeros((3, 3))

    def move(self, forward: float, turn: float) -> None:
        """Drive metres forward or back, and turn radians counterclockwise at once."""
        e = self._rng.normal(size=5)
        body = self.body
        forward_done = forward * (1 + body.slip * e[0])
        turn_done = turn * (1 + body.slip * e[1]) + body.wander * abs(forward) * e[2]
        self.pose = _moved(self.pose, forward_done, turn_done)
        forward_told = forward_done * (1 + body.scale) * (1 + body.odometry * e[3])
        turn_told = turn_done * (1 + body.odometry * e[4]) + body.bend * forward_done
        self._add_covariance(forward_told, turn_told)
        self.odometry = _moved(self.odometry, forward_told, turn_told)
        self.driven += abs(forward_told)

    def report(self) -> Report:
        """Return the motion by odometry since the last call, or since the start."""
        cos, sin = math.cos(self._reported[2]), math.sin(self._reported[2])
        into = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        said = Report(
            displacement_between(self._reported, self.odometry), into @ self._covariance @ into.T
        )
        self._reported, self._covariance = self.odometry, np.zeros((3, 3))
        return said

    def _add_covariance(self, forward: float, turn: float) -> None:
        """Add the covariance of a reported motion (metres, radians), to first order."""
        middle = self.odometry[2] + turn / 2
        cos, sin = math.cos(middle), math.sin(middle)
        by_pose = np.array([[1.0, 0.0, -forward * sin], [0.0, 1.0, forward * cos], [0.0, 0.0, 1.0]])
        by_motion = np.array([[cos, -forward * sin / 2], [sin, forward * cos / 2], [0.0, 1.0]]) * (
            self.body.odometry * np.array([forward, turn])
        )
        self._covariance = by_pose @ self._covariance @ by_pose.T + by_motion @ by_motion.T


def _moved(pose: Pose, forward: float, turn: float) -> Pose:
    """Move a pose forward by metres, while it turns by radians counterclockwise."""
    x, y, heading = pose
    middle, heading = heading + turn / 2, math.remainder(heading + turn, math.tau)
    return x + forward * math.cos(middle), y + forward * math.sin(middle), heading
