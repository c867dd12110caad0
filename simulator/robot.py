"""A robot that drives forward and turns (a unicycle), neither of them exactly, and whose odometry reports neither of them exactly."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

Pose = tuple[float, float, float]


@dataclass(frozen=True)
class Body:
    """How well a robot drives. The motion that it does differs from the command by a share of it, and its heading wanders with the distance.

    radius    metres; a wall nearer than this is a collision
    slip      standard deviation of the motion done, as a share of the motion commanded
    wander    standard deviation of the heading, radians for a metre driven
    odometry  standard deviation of the motion reported, as a share of the motion done
    """

    radius: float = 0.2
    slip: float = 0.05
    wander: float = 0.02
    odometry: float = 0.02


class Robot:
    """The true pose of a robot, which only the simulator knows, and the motion that its odometry has reported."""

    def __init__(self, body: Body, pose: Pose, rng: np.random.Generator) -> None:
        self.body = body
        self.pose = pose
        self.driven = 0.0  # metres driven, as odometry reports them
        self.odometry: Pose = (0.0, 0.0, 0.0)  # the pose against that at the start, as odometry reports it
        self._rng = rng

    def move(self, forward: float, turn: float) -> None:
        """Command a motion: so many metres forward (back if negative), and so many radians of turn on the way."""
        e = self._rng.normal(size=5)
        body = self.body
        forward_done = forward * (1 + body.slip * e[0])
        turn_done = turn * (1 + body.slip * e[1]) + body.wander * abs(forward) * e[2]
        self.pose = _moved(self.pose, forward_done, turn_done)
        forward_told, turn_told = forward_done * (1 + body.odometry * e[3]), turn_done * (1 + body.odometry * e[4])
        self.odometry = _moved(self.odometry, forward_told, turn_told)
        self.driven += abs(forward_told)


def _moved(pose: Pose, forward: float, turn: float) -> Pose:
    x, y, heading = pose
    middle = heading + turn / 2
    return x + forward * math.cos(middle), y + forward * math.sin(middle), math.remainder(heading + turn, math.tau)
