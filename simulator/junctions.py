"""Control laws for streets that meet at any angles, by laser images and odometry.

The robot follows the midline of a street until a wall is ahead or a side is open. There it looks
around and climbs to the fixed point of the place, where the midlines of its streets meet. It keeps
the panorama at that point as its model of the place. The gateways of the place are the streets that
lead away. A turn to the left or right ends at the next gateway on that side. A turn around ends at
the opposite heading. The robot finds its heading by comparing images with the panorama. It does not
know its true pose.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass

import numpy as np

from simulator.driver import LONGEST_TRAVEL, STILL, STRIDE, TRIES, Driver
from simulator.errors import SimulatorError
from simulator.laser import BEARINGS
from simulator.surroundings import (
    STRAIGHT,
    Array,
    Panorama,
    Place,
    Street,
    compass,
    points_of,
    streets_of,
    walls_of,
)
from ssh_abduction.data.odometry import radians_between
from ssh_abduction.data.trace import Action

# Radians between two images of a turn.
TURN = math.radians(15)
# Distances in multiples of the reach. LEAVE: a place is expected only after driving this far.
# AHEAD: a wall ahead within this distance stops the robot. OPEN: a side is open if its wall is
# farther.
LEAVE, AHEAD, OPEN = 2.2, 1.6, 1.35
SIDES = {"left": 1, "right": -1}
ACTIONS = {
    "travel": Action.of("travel"),
    "around": Action.of("around"),
    **{
        side: Action.of({"name": side, "kind": "turn", "turn": side, "gateway": 1})
        for side in SIDES
    },
}


@dataclass
class Here:
    """The place where the robot is."""

    ranges: Array  # (360,) panorama: the range at each degree, in metres
    place: Place  # streets and fixed point that the panorama shows
    # Heading of the robot relative to the panorama, in radians counterclockwise.
    heading: float = 0.0


class Pilot:
    """Does the actions of a route in a world whose streets meet at any angles."""

    here: Here  # the place where the robot is; set by `begin`

    def __init__(self, driver: Driver) -> None:
        self.driver = driver
        self.reach = driver.world.reach

    def begin(self) -> None:
        """Climb to the dstate (fixed position and heading) near the start.

        Raises SimulatorError if there is no place near the start.
        """
        if not self._climb():
            raise self._error(
                "start",
                "expected a place, where streets meet or end, got a street that goes straight on; "
                "move the start",
            )

    def act(self, action: str) -> None:
        """Do "travel", "left", "right" or "around" of a route. Raises SimulatorError."""
        if action == "travel":
            self._travel()
        elif action == "around":
            self._face(self.here.place.heading(self.here.heading + math.pi))
        else:
            turn = self.here.place.beside(self.here.heading, SIDES[action])
            if turn is None:
                raise self._error(
                    action,
                    f"expected a street to the {action}, got none before straight behind; take "
                    "around, or another turn",
                )
            self._face(self.here.heading + turn)

    def star(self, image: Array | None = None) -> tuple[float, ...]:
        """Find the bearings of the gateways of this place, ascending degrees clockwise from ahead.

        The panorama shows the gateways. The image is not read.
        """
        bearings = (
            round(math.degrees(self.here.heading - street.bearing) % 360, 1) % 360
            for street in self.here.place.streets
        )
        return tuple(sorted(bearings))

    def _travel(self) -> None:
        """Follow the street to the next place, and climb to its dstate."""
        if not self.here.place.faces(self.here.heading):
            raise self._error("travel", "expected a free way ahead, got a wall; change the route")
        began = self.driver.robot.driven
        heed = began + LEAVE * self.reach
        while True:
            width = self._follow(began, heed)
            # A street at an acute angle is not visible from everywhere, so look from several
            # points.
            for way in (-width / 2, -width / 4, width / 2) if width else (0.0,):
                self._straight(way)
                if self._climb():
                    return
            heed = self.driver.robot.driven + self.reach

    def _follow(self, began: float, heed: float) -> float:
        """Follow the midline until a wall is ahead, or until a side was open and is closed again.

        Up to the distance `heed`, walls ahead and open sides are ignored. Returns the metres for
        which a side was open; 0 if a wall is ahead.
        """
        robot, reach = self.driver.robot, self.reach
        course = robot.odometry[2]  # Direction of the street by odometry.
        # Whether both sides were closed after `heed`, and the distance driven when one opened.
        closed, opened = False, None
        while robot.driven - began <= LONGEST_TRAVEL:
            image = self.driver.look()
            points, beams = points_of(image, BEARINGS, self.driver.laser.reach)
            if robot.driven > heed:
                ahead = points.real[np.abs(points.imag) < 0.3 * reach]
                if len(ahead) and np.median(ahead) < AHEAD * reach:
                    return 0.0
                if not any(_is_open(image, side, reach) for side in SIDES.values()):
                    if opened is not None:
                        return robot.driven - opened
                    closed = True
                elif closed and opened is None:
                    opened = robot.driven
            streets = streets_of(walls_of(points, beams), points, reach, 0.0)
            course_off = course - robot.odometry[2]
            off = [radians_between(street.bearing, course_off) for street in streets]
            turn = 0.0
            if min(off, default=math.pi) <= STRAIGHT:
                street = streets[off.index(min(off))]
                course, turn = robot.odometry[2] + street.bearing, _steer(street)
            self.driver.go(STRIDE, turn)
            if self.driver.on_travel is not None:
                self.driver.on_travel(self.driver)
        said = f"expected a place within {LONGEST_TRAVEL:.0f} m, got none; close the street"
        raise self._error("travel", said)

    def _straight(self, way: float) -> None:
        """Drive straight ahead, in metres; back if negative."""
        strides = math.ceil(abs(way) / STRIDE)
        for _ in range(strides):
            self.driver.go(way / strides)

    def _climb(self) -> bool:
        """Climb to the place's fixed point, if any. Turn to the nearest heading of its dstates."""
        came = self.driver.robot.odometry[2]
        for _ in range(TRIES):
            straight_on = came - self.driver.robot.odometry[2]
            self.here = self._look_around()
            place = self.here.place
            if not place.streets:
                width = 2 * self.reach
                said = f"expected a street, about {width:g} m wide, got none; give another reach"
                raise self._error("place", said)
            # Done at the fixed point, or if there is none.
            if place.fixed is None or abs(place.fixed) <= self.driver.tolerance.close:
                break
            self._go(place.fixed)
        self._face(place.heading(straight_on))
        return place.fixed is not None

    def _go(self, goal: complex) -> None:
        """Drive towards a point of the panorama (metres ahead + left i), at most `reach` metres."""
        forward = cmath.phase(goal) if abs(cmath.phase(goal)) <= math.pi / 2 else cmath.phase(-goal)
        self._face(forward)
        self._straight(min(abs(goal), self.reach) * (1 if forward == cmath.phase(goal) else -1))

    def _look_around(self) -> Here:
        """Turn once around, and find the place in the panorama."""
        driver = self.driver
        panorama = Panorama(driver.look())
        for _ in range(round(math.tau / TURN)):
            turned = self._turn(TURN)
            panorama.add(driver.look(), turned)
        ranges = panorama.ranges
        return Here(ranges, Place.of(ranges, self.reach, driver.laser.reach), panorama.headings[-1])

    def _face(self, heading: float) -> None:
        """Turn on the spot to a heading, in radians relative to the panorama."""
        for _ in range(TRIES):
            turn = math.remainder(heading - self.here.heading, math.tau)
            if abs(turn) <= self.driver.tolerance.straight:
                return
            strides = math.ceil(abs(turn) / TURN)
            turned = sum(self._turn(turn / strides) for _ in range(strides))
            self.here.heading = compass(
                self.here.ranges, self.driver.look(STILL), self.here.heading + turned, turned
            )

    def _turn(self, turn: float) -> float:
        """Turn on the spot by an angle in radians; return the angle by odometry."""
        before = self.driver.robot.odometry[2]
        self.driver.go(0.0, turn)
        return math.remainder(self.driver.robot.odometry[2] - before, math.tau)

    def _error(self, what: str, said: str) -> SimulatorError:
        x, y, _ = self.driver.robot.pose
        return SimulatorError(f"{self.driver.world.name}: {what} at ({x:.2f}, {y:.2f}): {said}")


def _is_open(image: Array, side: int, reach: float) -> bool:
    """Whether a side, 1 for left or -1, is open: no near wall between 75 and 90 degrees."""
    beams = (
        image[-15:] * np.sin(BEARINGS[-15:]) if side > 0 else image[:15] * np.sin(-BEARINGS[:15])
    )
    return bool(np.median(beams) > OPEN * reach)


def _steer(street: Street) -> float:
    """Compute the turn in the next stride, in radians, that leads to the midline and along it."""
    return street.bearing - math.atan(1.5 * float(np.clip(street.offset, -0.5, 0.5)))
