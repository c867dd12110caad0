"""A robot that drives forward and turns (a unicycle), neither of them exactly, and whose odometry reports neither of them exactly."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulator.errors import SimulatorError
from simulator.motion import Pose, between
from ssh_abduction.data.errors import brief, is_finite
from ssh_abduction.data.odometry import Displacement

# The systematic errors of an odometry are at most this, as a share and in radians a metre: with more the robot could not tell when it has left a place.
WORST = 0.5
# The options of the verb that set these errors.
OPTIONS = {"odometry": "odometry-noise", "scale": "scale-error", "bend": "bend-error"}


@dataclass(frozen=True)
class Body:
    """How well a robot drives. The motion that it does differs from the command by a share of it, and its heading wanders with the distance.

    radius    metres; a wall nearer than this is a collision
    slip      standard deviation of the motion done, as a share of the motion commanded
    wander    standard deviation of the heading, radians for a metre driven
    odometry  standard deviation of the motion reported, as a share of the motion done
    scale     share by which all ways are reported longer than they are, as with wheels that have worn
    bend      radians by which the heading reported turns to the left in each metre forward, as with wheels of unequal size

    Raises SimulatorError where an error of the odometry is not a number, or is too great to drive with.
    """

    radius: float = 0.2
    slip: float = 0.05
    wander: float = 0.02
    odometry: float = 0.02
    scale: float = 0.0
    bend: float = 0.0

    def __post_init__(self) -> None:
        for name, least in (("odometry", 0.0), ("scale", -WORST), ("bend", -WORST)):
            value = getattr(self, name)
            if not is_finite(value) or not least <= value <= WORST:
                unit = (
                    f" radians a metre, which are {math.degrees(WORST):.1f} degrees"
                    if name == "bend"
                    else ""
                )
                raise SimulatorError(
                    f"body.{name}: expected a number from {least} to {WORST}{unit}, got {brief(value)}; choose a smaller error (--{OPTIONS[name]})"
                )


@dataclass(frozen=True)
class Report:
    """What the odometry says of the motion since its last report.

    displacement  (dx, dy, dtheta) in the frame of the robot at the last report, in metres and radians
    covariance    of the displacement, (3, 3): of its noise, without the errors that repeat
    """

    displacement: Displacement
    covariance: NDArray[np.float64]


class Robot:
    """The true pose of a robot, which only the simulator knows, and the motion that its odometry has reported."""

    def __init__(self, body: Body, pose: Pose, rng: np.random.Generator) -> None:
        self.body = body
        self.pose = pose
        self.driven = 0.0  # metres driven, as odometry reports them
        self.odometry: Pose = (
            0.0,
            0.0,
            0.0,
        )  # the pose against that at the start, as odometry reports it
        self._rng = rng
        self._reported = self.odometry  # as it was at the last report
        self._covariance = np.zeros(
            (3, 3)
        )  # of the odometry, in its own frame, since the last report

    def move(self, forward: float, turn: float) -> None:
        """Command a motion: so many metres forward (back if negative), and so many radians of turn on the way."""
        e = self._rng.normal(size=5)
        body = self.body
        forward_done = forward * (1 + body.slip * e[0])
        turn_done = turn * (1 + body.slip * e[1]) + body.wander * abs(forward) * e[2]
        self.pose = _moved(self.pose, forward_done, turn_done)
        forward_told = forward_done * (1 + body.scale) * (1 + body.odometry * e[3])
        turn_told = turn_done * (1 + body.odometry * e[4]) + body.bend * forward_done
        self._spread(forward_told, turn_told)
        self.odometry = _moved(self.odometry, forward_told, turn_told)
        self.driven += abs(forward_told)

    def report(self) -> Report:
        """The motion since the last report, or since the start, as odometry has it."""
        cos, sin = math.cos(self._reported[2]), math.sin(self._reported[2])
        into = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        said = Report(between(self._reported, self.odometry), into @ self._covariance @ into.T)
        self._reported, self._covariance = self.odometry, np.zeros((3, 3))
        return said

    def _spread(self, forward: float, turn: float) -> None:
        """Let the covariance grow by that of a motion, to first order."""
        middle = self.odometry[2] + turn / 2
        cos, sin = math.cos(middle), math.sin(middle)
        by_pose = np.array([[1.0, 0.0, -forward * sin], [0.0, 1.0, forward * cos], [0.0, 0.0, 1.0]])
        by_motion = np.array([[cos, -forward * sin / 2], [sin, forward * cos / 2], [0.0, 1.0]]) * (
            self.body.odometry * np.array([forward, turn])
        )
        self._covariance = by_pose @ self._covariance @ by_pose.T + by_motion @ by_motion.T


def _moved(pose: Pose, forward: float, turn: float) -> Pose:
    x, y, heading = pose
    middle = heading + turn / 2
    return (
        x + forward * math.cos(middle),
        y + forward * math.sin(middle),
        math.remainder(heading + turn, math.tau),
    )
