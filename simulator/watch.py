"""Checks that each action ends at the expected place, and each tour at its start.

The control laws see only images, so they do not notice when they confuse places. This module
compares the true pose with the true dstates (places with headings) of the world, if the world has
any. Errors name the action and the likely cause.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from simulator.driver import TURNS, Driver
from simulator.errors import SimulatorError, SimulatorWarning
from simulator.robot import meetings
from simulator.world import ACTIONS, World, are_square
from ssh_abduction.data.odometry import Pose, displacement_between

# Largest distance from the expected place in metres (`reach` if that is larger), and largest
# difference of heading in radians.
NEAR, FACING = 0.5, math.radians(45)
# The next place on a path is at most this far to the side, as a share of its distance ahead.
STRAIGHT = 0.2
# With larger errors, the control laws may fail: relative errors of motions and odometry, and errors
# of ranges in metres.
NOISY, BLURRED = 0.1, 0.03


@dataclass
class DriveWatch:
    """Checks the drive of a robot. Its methods are used as `with` blocks around motions."""

    world: World  # the world as in its file
    driver: Driver  # of the robot that is watched
    tours: int  # number of tours that are driven
    _home: Pose | None = field(default=None, init=False)

    @contextmanager
    def start(self) -> Iterator[None]:
        """Watch the robot on its way to its first dstate. Errors then name likely causes.

        Raises SimulatorError if the robot does not reach a dstate.
        """
        try:
            yield
        except SimulatorError as error:
            raise SimulatorError(f"{error}{self._because()}") from None

    @contextmanager
    def action(self, number: int, name: str) -> Iterator[None]:
        """Watch one action, by its number in all tours, and check its end.

        Raises SimulatorError if it ends at a wrong place, or a tour does not end at its start.
        """
        before = self.driver.robot.pose
        self._home = self._home or before
        tour, place = divmod(number, len(self.world.route))
        where = f"action {place + 1} of tour {tour + 1}, {name}"
        try:
            yield
        except SimulatorError as error:
            raise SimulatorError(f"{error} ({where}){self._because(before)}") from None
        after = self.driver.robot.pose
        expected = self._expected(name, before)
        # The robot may not be where the control law assumes.
        if expected and self._is_elsewhere(expected, after):
            at = self.world.places[expected]
            raise SimulatorError(
                f"{self.world.name}: {where}: expected the robot to come to {_at(expected, at)}, "
                f"got it {_at('', after)}, {math.dist(at, after[:2]):.1f} m off; so it drives "
                f"another route{self._because(before)}"
            )
        if place == len(self.world.route) - 1:
            self._ended(tour, after)

    def _ended(self, tour: int, pose: Pose) -> None:
        """Warn if the tour did not end where it began. With several tours, raise an error."""
        assert self._home is not None
        if self._are_alike(self._home, pose):
            return
        text = (
            f"{self.world.name}: tour {tour + 1}: expected it to end where it began, "
            f"{_at('', self._home)}, got its end {_at('', pose)}, {_off(self._home, pose)}"
        )
        # Further tours would start from a wrong pose.
        if self.tours == 1:
            warnings.warn(
                f"{text}; it cannot be driven again from there", SimulatorWarning, stacklevel=2
            )
        else:
            raise SimulatorError(f"{text}; mend the route, or drive one tour{self._because()}")

    @property
    def _near(self) -> float:
        return max(NEAR, self.world.reach)

    def _are_alike(self, one: Pose, other: Pose) -> bool:
        """Whether two poses are about the same."""
        turned = abs(math.remainder(one[2] - other[2], math.tau))
        return math.dist(one[:2], other[:2]) <= self._near and turned <= FACING

    def _is_elsewhere(self, place: str, pose: Pose) -> bool:
        """Whether a pose is not at a place: it is nearer to another place, or far from this one."""
        far = {name: math.dist(at, pose[:2]) for name, at in self.world.places.items()}
        return far[place] > min(2 * self._near, *far.values())

    def _expected(self, action: str, pose: Pose) -> str | None:
        """The name of the place where an action from a pose should end; None if unknown."""
        here = self.world.nearest(pose)
        if here is None or not self._are_alike(here.pose, pose):
            return None
        if action in TURNS:
            return here.place
        if action not in ACTIONS:
            lift = self.world.lift_at(action, *pose[:2])
            at = self.world.places
            return min(at, key=lambda place: math.dist(at[place], lift.end)) if lift else None
        # The next place straight ahead on the same path.
        ahead = []
        for state in self.world.dstates:
            x, y, _ = displacement_between(here.pose, state.pose)
            is_on_path = (state.path, state.direction) == (here.path, here.direction)
            if is_on_path and x > NEAR and abs(y) <= STRAIGHT * x:
                ahead.append((x, state.place))
        return min(ahead)[1] if ahead else None

    def _because(self, before: Pose | None = None) -> str:
        """The likely causes of an error since a pose, to end a message; empty if there are none."""
        found = list(self._causes(before or self.driver.robot.pose))
        return f". Likely cause: {'; or '.join(found)}" if found else ""

    def _causes(self, before: Pose) -> Iterator[str]:
        """Yield a clause for each likely cause of an error, with advice in brackets."""
        world, body = self.world, self.driver.robot.body
        if world.own_reach is not None and world.own_reach != world.reach:
            yield (
                f"reach is {world.reach:g} m, and the world's own is {world.own_reach:g} m (leave "
                "--set reach out)"
            )
        elif (half := self._half_width(before)) and not (
            0.6 * half if world.angles == "any" else 0.0
        ) <= world.reach <= 1.25 * half:
            yield (
                f"reach is {world.reach:g} m, and half the width of the street there is "
                f"{half:.2f} m (give that as reach)"
            )
        if world.angles == "right" and not are_square(world.segments):
            yield (
                'walls meet at other than right angles, and the world says "right" (write '
                '"angles": "any")'
            )
        for what, value, mend in (
            ("the odometry errs", body.odometry, "give less --set odometry_noise"),
            ("a motion errs", body.slip, "give the body less slip"),
        ):
            if value > NOISY:
                yield f"{what} by {100 * value:.0f} % ({mend})"
        if abs(body.bend) > math.radians(2):
            yield (
                f"the odometry bends by {math.degrees(body.bend):.1f} degrees in each metre (give "
                "less --set bend_error)"
            )
        if self.driver.laser.noise > BLURRED:
            noise = 100 * self.driver.laser.noise
            yield f"ranges err by {noise:.0f} cm (give the laser less noise)"
        # Causes that lie in the start pose.
        start = world.nearest(world.start)
        if start and (away := math.dist(start.pose[:2], world.start[:2])) > self._near:
            yield (
                f"the start is {away:.1f} m off the nearest dstate of the world, {start.name} "
                "(move the start)"
            )
        if world.angles == "right" and (off := _off_axis(world)) > FACING / 2:
            yield f"the start heads {math.degrees(off):.0f} degrees off the walls (turn the start)"

    def _half_width(self, before: Pose) -> float | None:
        """Half the width of the street in metres, without clutter; None without walls.

        It is measured halfway between a previous pose and the current one, in the narrowest
        direction.
        """
        angles = np.radians(np.arange(360.0))
        middle = np.append((np.array(before[:2]) + self.driver.robot.pose[:2]) / 2, 0.0)
        ranges = meetings(self.world.segments, middle[None], angles).min(2)[0]
        narrowest = float((ranges[:180] + ranges[180:]).min())
        return narrowest / 2 if math.isfinite(narrowest) else None


def _off_axis(world: World) -> float:
    """The smallest angle between the start heading and right-angled walls, in radians."""
    ways = world.segments[:, 2:] - world.segments[:, :2]
    longest = ways[int(np.hypot(*ways.T).argmax())]
    return abs(math.remainder(world.start[2] - math.atan2(longest[1], longest[0]), math.pi / 2))


def _at(what: str, pose: Sequence[float]) -> str:
    return f"{what} at ({pose[0]:.2f}, {pose[1]:.2f})".lstrip()


def _off(one: Pose, other: Pose) -> str:
    turned = math.degrees(abs(math.remainder(one[2] - other[2], math.tau)))
    return f"{math.dist(one[:2], other[:2]):.1f} m and {turned:.0f} degrees off"
