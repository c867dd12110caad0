"""A robot that drives and turns (a unicycle), and its odometer. Motions and odometry have errors.

>>> from simulator.robot import Odometer
>>> exact = Odometer(along=0, across=0, heading=0, turning=0)
>>> exact.reading(np.array([[1.0, 2.0, 0.0], [3.0, 2.0, 0.5]]), np.random.default_rng(0)).tolist()
[[0.0, 0.0, 0.0], [2.0, 0.0, 0.5]]

Errors of an odometer are systematic, or random and growing with the distance.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from simulator.errors import SimulatorError
from ssh_abduction.data.checks import a_number
from ssh_abduction.data.odometry import Displacement, Odometry, Pose, displacement_between

# Largest errors of the odometry that the robot drives by, as a share and in radians per metre. With
# larger ones, the robot does not notice that it left a place.
DRIVABLE = 0.5
# Options of `simulate` for these errors.
OPTIONS = {"odometry": "odometry-noise", "scale": "scale-error", "bend": "bend-error"}
Array = NDArray[np.float64]
# Largest value of a field; a worse odometer would be useless.
WORST = 1.0
# Reported displacements are rounded to this many decimals, as in a log.
DIGITS = 5


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
        for name, least in (("odometry", 0.0), ("scale", -DRIVABLE), ("bend", -DRIVABLE)):
            mend = f"choose a smaller error (--{OPTIONS[name]})"
            if name == "bend":
                mend += f"; {DRIVABLE} radians per metre are {math.degrees(DRIVABLE):.1f} degrees"
            a_number(
                f"body.{name}", getattr(self, name), SimulatorError, least, DRIVABLE, mend=mend
            )


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


@dataclass(frozen=True)
class Odometer:
    """Noise and systematic errors of an odometer.

    The errors of two motions are independent, so the standard deviation of the noise grows with the
    square root of the distance. The defaults are near the values of recorded logs (ACES,
    Belgioioso, CSAIL and Seattle), in which the motion between two scans was compared with the
    corrected poses:
    `along` 0.02 to 0.08, `across` 0.015 to 0.05, `heading` 0.008 to 0.07, `turning` 0.1.

    Attributes:
        along: Standard deviation along the motion after one metre, in metres.
        across: Standard deviation across the motion after one metre, in metres.
        heading: Standard deviation of the heading after one metre, in radians.
        turning: Standard deviation of the heading after a turn of one radian, in radians.
        scale: Share by which reported distances are too long, as with worn wheels.
        bend: Radians a metre by which the reported heading drifts to the left, as with wheels of
            unequal size.

    Raises:
        SimulatorError: A field is no number, or too large.
    """

    along: float = 0.05
    across: float = 0.02
    heading: float = 0.015
    turning: float = 0.05
    scale: float = 0.0
    bend: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            name, value = f"odometer.{field.name}", getattr(self, field.name)
            least = -WORST if field.name in ("scale", "bend") else 0.0
            option = f" (--{OPTIONS[field.name]})" if field.name in OPTIONS else ""
            mend = f"choose a smaller error{option}"
            a_number(name, value, SimulatorError, least, WORST, mend=mend)

    def as_noisy_as(self, along: float) -> Odometer:
        """Copy the odometer, with noise of the default proportions, scaled to a value of `along`.

        That is the standard deviation along the motion after one metre, in metres. Raises
        SimulatorError if it is not from 0 to 1.
        """
        mend = "with 1 the robot is a metre off after one metre"
        a_number("odometry_noise", along, SimulatorError, 0, WORST, mend=mend)
        usual = Odometer()
        share = along / usual.along
        scaled = {kind: getattr(usual, kind) * share for kind in ("across", "heading", "turning")}
        return replace(self, along=along, **scaled)

    def parameters(self) -> dict[str, float]:
        """Return all attributes as a dict from name to value, for logs."""
        return asdict(self)

    def reading(self, poses: Array, rng: np.random.Generator) -> Array:
        """Compute what the odometer reads along true poses, (n, 3) in metres and radians.

        The readings, (n, 3), begin at (0, 0, 0).
        """
        ahead, left, turned = _motions(poses)
        way = np.hypot(ahead, left)
        noise = rng.normal(size=(4, len(way)))
        # Noise grows with the square root of the distance or turn.
        told_ahead = (1 + self.scale) * ahead + self.along * np.sqrt(way) * noise[0]
        told_left = (1 + self.scale) * left + self.across * np.sqrt(way) * noise[1]
        told_turn = (
            turned
            + self.bend * ahead
            + self.heading * np.sqrt(way) * noise[2]
            + self.turning * np.sqrt(np.abs(turned)) * noise[3]
        )
        heading = np.concatenate([[0.0], np.cumsum(told_turn)])
        cos, sin = np.cos(heading[:-1]), np.sin(heading[:-1])
        x = np.concatenate([[0.0], np.cumsum(cos * told_ahead - sin * told_left)])
        y = np.concatenate([[0.0], np.cumsum(sin * told_ahead + cos * told_left)])
        return np.column_stack([x, y, np.remainder(heading + np.pi, 2 * np.pi) - np.pi])

    def covariances(self, readings: Array) -> Array:
        """Estimate the covariances, (n, 3, 3), of readings, (n, 3), relative to the first one.

        The estimate is of first order. It does not include systematic errors, which a robot
        cannot know.
        """
        found = np.zeros((len(readings), 3, 3))
        for number, (start, ahead, left, turned) in enumerate(
            zip(readings, *_motions(readings), strict=False)
        ):
            way, cos, sin = np.hypot(ahead, left), np.cos(start[2]), np.sin(start[2])
            # Jacobians of the next pose by this pose and by the motion.
            by_pose = np.eye(3)
            by_pose[:2, 2] = -sin * ahead - cos * left, cos * ahead - sin * left
            by_motion = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
            heading = self.heading**2 * way + self.turning**2 * abs(turned)
            noise = np.diag([self.along**2 * way, self.across**2 * way, heading])
            found[number + 1] = (
                by_pose @ found[number] @ by_pose.T + by_motion @ noise @ by_motion.T
            )
        return found


def _motions(poses: Array) -> tuple[Array, Array, Array]:
    """The motion from each pose to the next: metres ahead and left, radians, (n - 1,)."""
    steps = np.diff(poses, axis=0)
    cos, sin = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    turned = np.remainder(steps[:, 2] + np.pi, 2 * np.pi) - np.pi
    return cos * steps[:, 0] + sin * steps[:, 1], cos * steps[:, 1] - sin * steps[:, 0], turned


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
