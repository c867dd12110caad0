"""Control laws for streets that meet at any angles, by laser images and odometry.

The robot follows the midline of a street until a wall is ahead or a side is open. There it looks
around and climbs to the fixed point of the place, where the midlines of its streets meet. It keeps
the panorama at that point as its model of the place. The gateways of the place are the streets that
lead away. A turn to the left or right ends at the next gateway on that side. A turn around ends at
the opposite heading. The robot finds its heading by comparing images with the panorama. It does not
know its true pose.

A wall is a straight stretch of points in an image. A street lies between two walls that face each
other, about twice `reach` apart. At a dead end, the fixed point is `reach` before the wall.

An image shows half a circle. If a robot turns on the spot, consecutive images overlap, and show the
same walls rotated. The rotation with the best agreement is the turn of the robot; this is a visual
compass. So the images of a turning robot can be joined to a panorama of the whole circle.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from simulator.driver import LONGEST_TRAVEL, STILL, STRIDE, TRIES, Driver
from simulator.errors import SimulatorError
from simulator.robot import BEARINGS
from simulator.world import Array
from ssh_abduction.data.odometry import radians_between
from ssh_abduction.data.trace import Action

# Largest distance in metres of points from the line of their wall: six times the noise of the
# laser.
THICK = 0.03
# Smallest length of a wall in metres; anything shorter is clutter.
LONG = 0.4
# Number of missing beams that ends a wall.
GAP = 3
# Largest relative error of a turn by odometry.
OFF = 0.15
# Bearings of a panorama in radians.
AROUND: Array = np.radians(np.arange(360.0))
# Largest angle in radians between two walls of a street.
PARALLEL = math.radians(8)
# In multiples of the reach: smallest and largest width of a street, and distance from the robot to
# which its walls reach at least. Something shorter is a recess of the place.
WIDTHS = (1.2, 3.0)
FAR = 2.0
# Directions within this many radians are the same: a street that bends by less goes straight on.
STRAIGHT = math.radians(20)
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
                course = robot.odometry[2] + street.bearing
                # This turn leads to the midline and along it.
                turn = street.bearing - math.atan(1.5 * float(np.clip(street.offset, -0.5, 0.5)))
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
        images = [(0.0, self.driver.look())]
        turns = range(round(math.tau / TURN))
        images += [(self._turn(TURN), self.driver.look()) for _ in turns]
        ranges, heading = panorama(images)
        return Here(ranges, Place.of(ranges, self.reach, self.driver.laser.reach), heading)

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


@dataclass(frozen=True)
class Wall:
    """A straight wall. The robot is on its left, looking from start to end.

    Points and directions are complex numbers: metres ahead of the robot (real part), and metres to
    its left (imaginary part).
    """

    start: complex  # the end that the robot sees first, counterclockwise
    end: complex  # the other end

    @property
    def way(self) -> complex:
        """The vector from the start to the end."""
        return self.end - self.start


@dataclass(frozen=True)
class Street:
    """A street that leads away from the robot."""

    bearing: float  # direction in radians, counterclockwise from straight ahead
    # Point of the street's midline that is nearest to the robot, as a complex number in metres.
    middle: complex
    length: float  # metres for which walls are visible on both sides

    @property
    def offset(self) -> float:
        """How far the robot is to the left of the midline, looking along the street, in metres."""
        return -(self.middle * cmath.rect(1, -self.bearing)).imag


def points_of(
    ranges: Array, bearings: Array, farthest: float
) -> tuple[NDArray[np.complex128], NDArray[np.intp]]:
    """Compute the points that beams, (b,) metres and radians, hit, and the indices of these beams.

    Points are (n,) complex numbers in metres. The range `farthest` means that nothing was seen.
    """
    seen = np.flatnonzero(ranges < farthest - 0.02)
    return ranges[seen] * np.exp(1j * bearings[seen]), seen


def walls_of(points: NDArray[np.complex128], beams: NDArray[np.intp]) -> list[Wall]:
    """Find the walls in (n,) points, complex and counterclockwise. Missing beams end a wall."""
    breaks = np.flatnonzero(np.diff(beams) > GAP) + 1
    return [wall for stretch in np.split(points, breaks) for wall in _straight(stretch)]


def streets_of(
    walls: Sequence[Wall], points: NDArray[np.complex128], reach: float, farther: float
) -> list[Street]:
    """Find the streets between walls, clockwise from straight behind, in different directions.

    Of streets in about the same direction, the longest is taken. A street has no points near
    its midline. `reach` is half the width of a street. A street reaches at least to a distance
    of `farther` metres from the robot.
    """
    found: list[Street] = []
    streets = _between(walls, points, reach, farther)
    for street in sorted(streets, key=lambda street: -street.length):
        if all(radians_between(street.bearing, other.bearing) > STRAIGHT for other in found):
            found.append(street)
    return sorted(found, key=lambda street: -street.bearing)


def _straight(points: NDArray[np.complex128]) -> Iterator[Wall]:
    """Split points into walls by the algorithm of Douglas and Peucker."""
    if len(points) < 5:
        return
    way = points[-1] - points[0]
    off = np.abs(((points - points[0]) * np.conj(way)).imag) / max(abs(way), 1e-9)
    worst = int(off.argmax())
    if off[worst] > THICK and 0 < worst < len(points) - 1:
        yield from _straight(points[: worst + 1])
        yield from _straight(points[worst:])
    elif abs(way) >= LONG:
        yield _fitted(points)


def _fitted(points: NDArray[np.complex128]) -> Wall:
    """The wall on the least-squares line through points."""
    middle = points.mean()
    direction = np.sqrt(((points - middle) ** 2).sum())
    direction /= abs(direction)
    along = ((points - middle) * np.conj(direction)).real
    ends = middle + along[0] * direction, middle + along[-1] * direction
    return Wall(complex(ends[0]), complex(ends[1]))


def _between(
    walls: Sequence[Wall], points: NDArray[np.complex128], reach: float, farther: float
) -> Iterator[Street]:
    """The streets between any two walls, one on the right of the street and one on the left."""
    # Rotate both walls so that the street points along the real axis.
    for right, left in permutations(walls, 2):
        if radians_between(cmath.phase(right.way), cmath.phase(-left.way)) > PARALLEL:
            continue
        along = right.way - left.way
        along /= abs(along)
        (a, b), (c, d) = ((wall.start / along, wall.end / along) for wall in (right, left))
        width = (c.imag + d.imag - a.imag - b.imag) / 2
        near, far = max(a.real, d.real), min(b.real, c.real)
        is_wide = WIDTHS[0] * reach < width < WIDTHS[1] * reach
        if not is_wide or far < farther or far - max(near, 0.0) < LONG:
            continue
        lateral = (a.imag + b.imag + c.imag + d.imag) / 4
        seen = points / along
        inside = np.abs(seen.imag - lateral) < width / 4
        inside &= (seen.real > max(near, 0.0)) & (seen.real < farther)
        if inside.sum() < 3:
            yield Street(cmath.phase(along), 1j * lateral * along, far - near)


@dataclass(frozen=True)
class Place:
    """A place as a panorama shows it."""

    streets: tuple[Street, ...]  # streets that lead away, clockwise from straight behind the robot
    # Where hill-climbing would stop, as a complex number: metres ahead, and metres to the left.
    # None where the robot just passes: a street goes straight on, or no wall ends it.
    fixed: complex | None

    @classmethod
    def of(cls, ranges: Array, reach: float, farthest: float) -> Place:
        """Find the place in a panorama, (360,) metres at each degree, or NaN.

        `reach` is half the width of a street. The range `farthest` means that nothing was seen.
        """
        points, beams = points_of(np.nan_to_num(ranges, nan=farthest), AROUND, farthest)
        if not len(points):
            return cls((), None)
        # Start where a wall ends, so that no wall is cut in two.
        first = int(np.abs(points - np.roll(points, 1)).argmax())
        points, beams = np.roll(points, -first), (np.roll(beams, -first) - beams[first]) % 360
        streets = streets_of(walls_of(points, beams), points, reach, FAR * reach)
        return cls(
            tuple(streets), _meeting(streets) if len(streets) > 1 else _end(streets, points, reach)
        )

    @property
    def headings(self) -> list[float]:
        """The headings of the dstates of this place, in radians.

        There is one along each street, and one opposite to each street, unless another street is
        there.
        """
        out = [street.bearing for street in self.streets]
        return out + [
            bearing + math.pi
            for bearing in out
            if all(radians_between(bearing + math.pi, other) > STRAIGHT for other in out)
        ]

    def heading(self, about: float) -> float:
        """Find, among the headings of dstates here, the one nearest to `about`, in radians."""
        return min(self.headings, key=lambda heading: radians_between(heading, about))

    def beside(self, heading: float, side: int) -> float | None:
        """Measure the radians to turn to the next street on the left (side 1) or right (-1).

        They are negative to the right. None if no street is on that side. The heading is in
        radians.
        """
        turns = [side * (street.bearing - heading) % math.tau for street in self.streets]
        beside = [side * turn for turn in turns if STRAIGHT < turn < math.pi - STRAIGHT]
        return min(beside, key=abs, default=None)

    def faces(self, heading: float) -> bool:
        """Check whether a street is straight ahead, with a heading in radians."""
        return any(radians_between(street.bearing, heading) <= STRAIGHT for street in self.streets)


def _meeting(streets: Sequence[Street]) -> complex | None:
    """The point nearest to all midlines; None if two streets are one that goes straight on."""
    bearings = [street.bearing for street in streets]
    if len(bearings) == 2 and radians_between(bearings[0], bearings[1] + math.pi) <= STRAIGHT:
        return None
    across = np.array([1j * cmath.rect(1, bearing) for bearing in bearings])
    offsets = np.array([street.middle for street in streets])
    rows = np.stack([across.real, across.imag], axis=1)
    x, y = np.linalg.lstsq(rows, (across.conj() * offsets).real, rcond=None)[0]
    return complex(x, y)


def _end(streets: Sequence[Street], points: NDArray[np.complex128], reach: float) -> complex | None:
    """The point of a dead end: on the midline, `reach` before the wall; None without a wall."""
    for street in streets:
        along = cmath.rect(1, street.bearing)
        seen = (points - street.middle) / along
        wall = seen.real[(seen.real < 0) & (np.abs(seen.imag) < reach / 2)]
        if len(wall):
            return street.middle + along * (float(np.median(wall)) + reach)
    return None


def panorama(images: Iterable[tuple[float, Array]]) -> tuple[Array, float]:
    """Join the images of a robot that turns on the spot to ranges in all directions.

    Args:
        images: Images, (180,) metres, each with the turn in radians since the image before, by
            odometry.

    Returns:
        The range at each degree, counterclockwise from the first heading: (360,) metres; NaN if
        unknown. It is the median over all images, so that a beam that is lost in one image does not
        matter. And the heading at the last image, in radians.
    """
    heading, rows = 0.0, list[Array]()
    first = np.full(360, np.nan)  # For each degree, the first range that was seen.
    for turned, image in images:
        if rows:
            heading = compass(first, image, heading + turned, turned)
        bearings = np.angle(np.exp(1j * (AROUND - heading)))
        rows.append(np.interp(bearings, BEARINGS, image, left=np.nan, right=np.nan))
        first = np.where(np.isnan(first), rows[-1], first)
    shown = ~np.isnan(first)
    ranges = np.full(360, np.nan)
    ranges[shown] = np.nanmedian(np.array(rows)[:, shown], axis=0)
    return ranges, heading


def compass(ranges: Array, image: Array, about: float, turned: float) -> float:
    """Find the heading at which an image agrees best with known ranges.

    `ranges` has (360,) metres or NaN, and the image (180,) metres. Angles are radians. `about`
    is the expected heading, and `turned` the turn by odometry since the last known heading. The
    error of odometry is relative, so more headings are tried after a larger turn.
    """
    best = about
    for window, step in ((2 + OFF * math.degrees(abs(turned)), 0.5), (0.5, 0.05)):
        tried = best + np.radians(np.arange(-window, window + step / 2, step))
        known = np.interp(np.degrees(tried[:, None] + BEARINGS), np.arange(360), ranges, period=360)
        # Compare the same beams for all headings; otherwise unknown ranges would look like
        # agreement.
        shown = ~np.isnan(known).any(axis=0)
        off = np.minimum(np.abs(known[:, shown] - image[shown]), 0.3)
        best = float(tried[int(off.mean(axis=1).argmin())])
    return best
