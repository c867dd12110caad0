"""Simulates tours: a robot drives a route repeatedly and logs images, actions and odometry."""

from __future__ import annotations

import math
import warnings
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np

from simulator.cruise import FreeSpace, drive_along
from simulator.driver import STILL, TURNS, Corridors, Driver, Tolerance
from simulator.errors import SimulatorError, SimulatorWarning
from simulator.junctions import ACTIONS, Pilot
from simulator.robot import (
    DIGITS,
    EVERY,
    Body,
    Laser,
    Odometer,
    RecordedDrive,
    Recorder,
    SimulatedRobot,
    meetings,
)
from simulator.world import Array, World, are_square
from ssh_abduction.data.checks import a_flag, a_number, a_whole_number, an_instance
from ssh_abduction.data.odometry import (
    Covariance,
    Displacement,
    Odometry,
    Pose,
    displacement_between,
    radians_between,
)
from ssh_abduction.data.trace import Action, Step, Trace
from ssh_abduction.data.words import counted

# More tours than this would take days, and all steps are kept in memory.
MOST_TOURS = 100_000
# Largest error, in metres and radians, of a pose that is the same at both ends of a displacement.
SAME = math.sqrt(3) / 1000
# Largest distance from the expected place in metres (`reach` if that is larger), and largest
# difference of heading in radians.
NEAR, FACING = 0.5, math.radians(45)
# The next place on a path is at most this far to the side, as a share of its distance ahead.
STRAIGHT = 0.2
# With larger errors, the control laws may fail: relative errors of motions and odometry, and errors
# of ranges in metres.
NOISY, BLURRED = 0.1, 0.03


@runtime_checkable
class Camera(Protocol):
    """A camera whose images are logged instead of ranges; benchmarks/panorama_camera.py has one."""

    shape: tuple[int, ...]  # rows, columns and colours of an image

    def hour(self, share: float) -> float:
        """Return the hour of the day when a share of the drive, from 0 to 1, is over."""

    def shot(
        self, world: World, pose: Pose, rng: np.random.Generator, hour: float, walls: int | None
    ) -> Array:
        """Take an image in a world whose first `walls` segments are no clutter."""


def simulate(
    world: World,
    tours: int = 1,
    seed: int = 0,
    *,
    laser: Laser | None = None,
    body: Body | None = None,
    tolerance: Tolerance | None = None,
    stars: bool = True,
    every: float | None = None,
    camera: Camera | None = None,
) -> Trace:
    """Drive tours of a world, and log an image at each dstate (a place and a heading there).

    The displacement of a step is the odometry of all motions since the last step, including those
    of hill-climbing.

    Args:
        world: The world, with walls and a route.
        tours: Number of tours.
        seed: Seed of all noise.
        laser: The scanner; None for `Laser()`.
        body: Size and errors of the robot; None for `Body()`.
        tolerance: Precision of hill-climbing; None for `Tolerance()`.
        stars: Whether to log a star at each step: the openings seen at the place since arrival.
        every: Log images at this distance by odometry, in metres, instead of at dstates. Then all
            actions of the trace are travels. None logs at dstates.
        camera: A camera whose panoramas are logged instead of ranges, row by row, as whole numbers;
            `panorama` in the header is their shape. The robot still drives by its laser, so with
            the same seed the drive is the same.

    Returns:
        A trace with tours x actions steps at dstates; its last step has no action. Each
        displacement has a covariance of its own. The truth of each step has dstate, place, path
        and pose, for evaluation only.

    Raises:
        SimulatorError: The route cannot be driven.
    """
    if every is not None:
        mend, what = "leave it out for images at dstates", "a number of metres"
        a_number("every", every, SimulatorError, above=0, what=what, mend=mend)
    a_flag("stars", stars, SimulatorError)
    given = {"laser": laser, "body": body, "tolerance": tolerance, "camera": camera}
    for (name, value), kind in zip(given.items(), (Laser, Body, Tolerance, Camera), strict=True):
        if value is not None:
            mend = f"make one with {kind.__name__}(), or leave it out"
            an_instance(name, value, kind, SimulatorError, mend=mend)
    driver = _driver(world, tours, seed, laser, body, tolerance)
    _refuse(
        world,
        (
            every is not None and bool(world.lifts),
            "every: expected no distance, as evenly spaced images would join the floors at its "
            "lifts; leave it out",
        ),
        (
            world.by_places,
            "route: expected actions, got places, and a robot that drives to places writes a log "
            "of scans; write --format carmen, or give a route of actions",
        ),
    )
    # The camera has its own noise, so that it does not change the drive.
    noise = np.random.default_rng([seed, 1])
    log = StepLog(driver, camera, noise, len(world.segments), tours * len(world.route))
    if every is None:
        steps = list(_at_dstates(log, world, tours, stars))
    else:
        steps = _evenly(log, world, tours, every)
    steps[-1] = replace(steps[-1], action=None)
    return Trace(
        tuple(steps),
        name=f"{world.name}, {tours} tours, seed {seed}",
        # Each displacement has its own covariance, so only systematic errors are left.
        odometry=Odometry(scale=abs(driver.robot.body.scale), bend=abs(driver.robot.body.bend)),
        extra={} if camera is None else {"panorama": list(camera.shape)},
    )


def record(
    world: World,
    tours: int = 1,
    seed: int = 0,
    *,
    odometer: Odometer | None = None,
    every: float = EVERY,
) -> RecordedDrive:
    """Drive tours as `simulate` does, or to the places of a route, and return the scans.

    The odometry in the log, with the noise of `odometer`, is not the odometry that the robot drives
    by. It is as noisy as the odometry of recorded logs. There is a scan each `every` metres, and in
    turns every ten degrees. Raises SimulatorError if the route cannot be driven.
    """
    driver = _driver(world, tours, seed)
    said = "lifts: expected none in the log of a robot, as a log does not show that the floor "
    _refuse(world, (bool(world.lifts), f"{said}changes; leave out --format"))
    recorder = driver.recorder = Recorder(every)
    recorder.note(driver.world, driver.robot.pose)
    steps = []
    legs = _stops(driver, world, tours) if world.by_places else _legs(driver, world, tours)
    for _, action in legs:
        truth = _truth(world, driver.robot.pose)
        steps.append({"scan": recorder.taken - 1, **truth, "action": action})
    name = f"{world.name}, {counted(tours, 'tours')}, seed {seed}"
    drive = recorder.drive(name, driver.laser, odometer or Odometer(), seed)
    return drive.judged(world.places, [_place(world, pose) for pose in drive.poses], steps=steps)


def _place(world: World, pose: Array) -> str | None:
    """The name of the nearest place of a robot, if it is within `reach`; None between places."""
    far = {name: math.dist(at, pose[:2]) for name, at in world.places.items()}
    nearest = min(far, key=far.__getitem__, default=None)
    return nearest if nearest is not None and far[nearest] <= world.reach else None


def _stops(driver: Driver, world: World, tours: int) -> Iterator[tuple[int, str]]:
    """Drive to each stop of all tours. Before, yield its number over all tours, and its name."""
    for tour in range(tours):
        if tour:
            driver.world = world.arranged(driver.rng)
        # The driver knows the walls, but not the furniture of this tour.
        space = FreeSpace.of(world.segments, driver.robot.body.radius)
        for number, stop in enumerate(world.route, tour * len(world.route)):
            yield number, stop
            x, y, _ = driver.robot.pose
            way = space.part(world.segments.reshape(-1, 2)).way((x, y), world.stops[stop])
            off = world.clearance(*world.stops[stop])
            said = (
                f"route: expected a way from ({x:.2f}, {y:.2f}) to {stop}, got none; open the "
                f"walls, or move {stop}, which is {off:.2f} m off the nearest one"
            )
            _refuse(world, (way is None, said))
            assert way is not None
            try:
                deque(drive_along(driver, space, way), maxlen=0)
            except SimulatorError as error:
                raise SimulatorError(
                    f"{error} (on the way to {stop}, on tour {tour + 1})"
                ) from None


def _driver(
    world: World,
    tours: int,
    seed: int,
    laser: Laser | None = None,
    body: Body | None = None,
    tolerance: Tolerance | None = None,
) -> Driver:
    """Make a robot at the start of a world."""
    an_instance("world", world, World, SimulatorError, mend="take World.named or World.load")
    a_whole_number("tours", tours, SimulatorError, 1, MOST_TOURS)
    a_whole_number("seed", seed, SimulatorError)
    body = body or Body()
    x, y, _ = world.start
    _refuse(
        world,
        (
            bool(world.lifts) and world.angles == "any",
            "lifts: expected a world whose streets meet at right angles, got one of any angles; "
            'write "angles": "right", or leave out the lifts',
        ),
        (
            not world.route,
            "route: expected at least one action, got none; add it to the world, or give one",
        ),
        # The robot must fit where it starts.
        (
            not world.holds(x, y) or world.clearance(x, y) < body.radius,
            f"start: expected a place {body.radius} m off the walls, got ({x}, {y}); move it",
        ),
    )
    rng = np.random.default_rng(seed)
    arranged, robot = world.arranged(rng), SimulatedRobot(body, world.start, rng)
    return Driver(arranged, robot, laser or Laser(), rng, tolerance or Tolerance())


def _refuse(world: World, *cases: tuple[bool, str]) -> None:
    """Raise SimulatorError with the text of the first case that is true."""
    for is_wrong, said in cases:
        if is_wrong:
            raise SimulatorError(f"{world.name}: {said}")


def _at_dstates(log: StepLog, world: World, tours: int, stars: bool) -> Iterator[Step]:
    """Drive all tours, and make a step at each dstate."""
    driver, is_square = log.driver, world.angles == "right"
    pilot = Corridors(driver, looks_behind=stars) if is_square else Pilot(driver)
    # Where streets meet at any angles, the robot does not climb after a turn.
    at_turns = driver.tolerance if is_square else replace(driver.tolerance, close=SAME)
    lifts = {lift.name for lift in world.lifts}
    done = ""
    for number, action in _legs(driver, world, tours, pilot):
        if done in lifts:
            log.begun = False  # Each floor has a frame of its own.
        ranges = driver.look(STILL)
        does = Action.of(action) if is_square else ACTIONS[action]
        yield log.step(
            ranges,
            number,
            driver.tolerance if done == "travel" else at_turns,
            action=Action(action, "lift") if action in lifts else does,
            star=pilot.star(ranges) if stars else None,
            truth=_truth(world, driver.robot.pose),
        )
        done = action


def _evenly(log: StepLog, world: World, tours: int, every: float) -> list[Step]:
    """Drive all tours, and make a step every `every` metres of odometry.

    In the truth, the route is divided into pieces of this length. Steps in one piece have one
    dstate on all tours.
    """
    logged: list[Step] = []
    leg_began = due = 0.0
    leg = 0

    # Called after each stride of a travel.
    def look(driver: Driver) -> None:
        """Log an image if one is due."""
        nonlocal due
        if driver.robot.driven >= due:
            piece = round((driver.robot.driven - leg_began) / every)
            spot = f"leg {leg % len(world.route)}, {piece}"
            truth = {"dstate": spot, "pose": [round(v, 4) for v in driver.robot.pose]}
            ranges, travel = driver.look(STILL), Action.of("travel")
            logged.append(log.step(ranges, leg, Tolerance(SAME, SAME), action=travel, truth=truth))
            due += every

    log.driver.on_travel = look
    for leg, _ in _legs(log.driver, world, tours):  # noqa: B007 - `look` reads the number
        leg_began = log.driver.robot.driven
    return logged


def _legs(
    driver: Driver, world: World, tours: int, pilot: Corridors | Pilot | None = None
) -> Iterator[tuple[int, str]]:
    """Drive all tours. Before each action, yield its number over all tours, and its name."""
    pilot = pilot or (Pilot(driver) if world.angles == "any" else Corridors(driver))
    watch = DriveWatch(world, driver, tours)
    try:
        pilot.begin()
    except SimulatorError as error:
        raise SimulatorError(f"{error}{watch.because(driver.robot.pose)}") from None
    for tour in range(tours):
        if tour:
            driver.world = world.arranged(driver.rng)
        for number, action in enumerate(world.route, tour * len(world.route)):
            yield number, action
            with watch.action(number, action):
                pilot.act(action)


def _truth(world: World, pose: Sequence[float]) -> dict[str, object]:
    """The truth about a pose: the pose, and the nearest true dstate if the world has any."""
    found = world.nearest(pose)
    fields = ("place", "path", "direction") if found else ()
    names = {"dstate": found.name} if found else {}
    pose = [round(float(v), 5) for v in pose]
    return {**names, **{name: getattr(found, name) for name in fields}, "pose": pose}


@dataclass
class StepLog:
    """Makes the steps of a trace: images, and the odometry since the last step."""

    driver: Driver
    camera: Camera | None  # the camera; None to log ranges
    rng: np.random.Generator  # source of noise of the camera
    walls: int  # number of segments of the world without clutter
    # Number of actions of the whole drive. The hour of the day follows from the share that is done.
    actions: int
    begun: bool = False  # whether a step was logged already on this floor

    def step(self, ranges: Array, done: int, tolerance: Tolerance, **more: Any) -> Step:
        """Make a step after `done` actions, where the laser sees these ranges, (180,) metres.

        The image has the ranges, or the pixels of a panorama, row by row. The tolerance is that of
        the poses at both ends of the displacement. `more` has further fields of the step.
        """
        driver, (moved, covariance) = self.driver, self.driver.robot.report()
        if self.camera is None:
            image = tuple(round(float(r), 4) for r in ranges)
        else:
            hour = self.camera.hour(done / max(self.actions - 1, 1))
            shot = self.camera.shot(driver.world, driver.robot.pose, self.rng, hour, self.walls)
            image = tuple(shot.ravel().tolist())
        if self.begun:
            more["displacement"] = tuple(round(v, DIGITS) for v in moved)
            more["covariance"] = covariance_of(moved, covariance, tolerance)
        self.begun = True
        return Step(image=image, **more)


def covariance_of(moved: Displacement, covariance: Array, tolerance: Tolerance) -> Covariance:
    """Compute the covariance of a displacement between fixed points, reported by odometry.

    It includes the errors of odometry, whose covariance is given, (3, 3), and of hill-climbing,
    which ends anywhere within its tolerance.
    """
    dx, dy, _ = moved
    left = np.diag([tolerance.close**2, tolerance.close**2, tolerance.straight**2]) / 3
    # A wrong heading moves the end sideways.
    by_start = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    whole = covariance + by_start @ left @ by_start.T + left
    a, b, c = (tuple(float(f"{v:.8g}") for v in row) for row in (whole + whole.T) / 2)
    return a, b, c  # type: ignore[return-value]


@dataclass
class DriveWatch:
    """Checks that each action of a drive ends at the expected place, and each tour at its start.

    The control laws see only images, so they do not notice when they confuse places. The watch
    compares the true pose with the true dstates (places with headings) of the world, if the world
    has any. `action` is used as a `with` block around each action. Errors name the action and the
    likely cause.
    """

    world: World  # the world as in its file
    driver: Driver  # of the robot that is watched
    tours: int  # number of tours that are driven
    _home: Pose | None = field(default=None, init=False)

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
            raise SimulatorError(f"{error} ({where}){self.because(before)}") from None
        after = self.driver.robot.pose
        # The robot may not be where the control law assumes: nearer to another place, or far away.
        far = {name: math.dist(at, after[:2]) for name, at in self.world.places.items()}
        expected = self._expected(name, before)
        if expected and far[expected] > min(2 * self._near, *far.values()):
            raise SimulatorError(
                f"{self.world.name}: {where}: expected the robot to come to "
                f"{_at(expected, self.world.places[expected])}, got it {_at('', after)}, "
                f"{far[expected]:.1f} m off; so it drives another route{self.because(before)}"
            )
        if place == len(self.world.route) - 1 and not self._are_alike(self._home, after):
            self._ended_elsewhere(tour, self._home, after)

    def _ended_elsewhere(self, tour: int, home: Pose, pose: Pose) -> None:
        """Warn that the tour did not end where it began. With several tours, raise an error."""
        turned = math.degrees(abs(math.remainder(home[2] - pose[2], math.tau)))
        text = (
            f"{self.world.name}: tour {tour + 1}: expected it to end where it began, "
            f"{_at('', home)}, got its end {_at('', pose)}, {math.dist(home[:2], pose[:2]):.1f} m "
            f"and {turned:.0f} degrees off"
        )
        # Further tours would start from a wrong pose.
        if self.tours > 1:
            raise SimulatorError(f"{text}; mend the route, or drive one tour{self.because(pose)}")
        warnings.warn(
            f"{text}; it cannot be driven again from there", SimulatorWarning, stacklevel=2
        )

    @property
    def _near(self) -> float:
        return max(NEAR, self.world.reach)

    def _are_alike(self, one: Pose, other: Pose) -> bool:
        """Whether two poses are about the same."""
        is_near = math.dist(one[:2], other[:2]) <= self._near
        return is_near and radians_between(one[2], other[2]) <= FACING

    def _expected(self, action: str, pose: Pose) -> str | None:
        """The name of the place where an action from a pose should end; None if unknown."""
        here = self.world.nearest(pose)
        if here is None or not self._are_alike(here.pose, pose):
            return None
        if action in TURNS:
            return here.place
        if lift := self.world.lift_at(action, *pose[:2]):
            at = self.world.places
            return min(at, key=lambda place: math.dist(at[place], lift.end))
        # The next place straight ahead on the same path.
        ahead = []
        for state in self.world.dstates if action == "travel" else ():
            x, y, _ = displacement_between(here.pose, state.pose)
            is_on_path = (state.path, state.direction) == (here.path, here.direction)
            if is_on_path and x > NEAR and abs(y) <= STRAIGHT * x:
                ahead.append((x, state.place))
        return min(ahead)[1] if ahead else None

    def because(self, before: Pose) -> str:
        """The likely causes of an error since a pose, to end a message; empty if there are none."""
        found = "; or ".join(self._causes(before))
        return f". Likely cause: {found}" if found else ""

    def _causes(self, before: Pose) -> Iterator[str]:
        """Yield the likely causes of an error since a pose, each with what to do."""
        world, body, noise = self.world, self.driver.robot.body, self.driver.laser.noise
        is_square, half = world.angles == "right", self._half_width(before)
        fits = (0.0 if is_square else 0.6 * half) <= world.reach <= 1.25 * half
        if half < math.inf and not fits:
            widths = f"{world.reach:g} m, and half the width of the street there is {half:.2f} m"
            yield f"reach is {widths} (give that as reach)"
        if is_square and not are_square(world.segments):
            said = 'walls meet at other than right angles, and the world says "right"'
            yield f'{said} (write "angles": "any")'
        if body.odometry > NOISY:
            share = f"{100 * body.odometry:.0f} %"
            yield f"the odometry errs by {share} (give less --set odometry_noise)"
        if body.slip > NOISY:
            yield f"a motion errs by {100 * body.slip:.0f} % (give the body less slip)"
        if abs(body.bend) > math.radians(2):
            bend = f"{math.degrees(body.bend):.1f} degrees in each metre"
            yield f"the odometry bends by {bend} (give less --set bend_error)"
        if noise > BLURRED:
            yield f"ranges err by {100 * noise:.0f} cm (give the laser less noise)"
        start = world.nearest(world.start)
        if start and (away := math.dist(start.pose[:2], world.start[:2])) > self._near:
            off = f"{away:.1f} m off the nearest dstate of the world, {start.name}"
            yield f"the start is {off} (move the start)"
        # The smallest angle between the start and the longest wall, or a wall at a right angle.
        ways = world.segments[:, 2:] - world.segments[:, :2]
        x, y = ways[int(np.hypot(*ways.T).argmax())]
        off_axis = abs(math.remainder(world.start[2] - math.atan2(y, x), math.pi / 2))
        if is_square and off_axis > FACING / 2:
            turned = f"{math.degrees(off_axis):.0f} degrees off the walls"
            yield f"the start heads {turned} (turn the start)"

    def _half_width(self, before: Pose) -> float:
        """Half the width of the street in metres, without clutter; infinite without walls.

        It is measured halfway between a previous pose and the current one, in the narrowest
        direction.
        """
        angles = np.radians(np.arange(360.0))
        middle = np.append((np.array(before[:2]) + self.driver.robot.pose[:2]) / 2, 0.0)
        ranges = meetings(self.world.segments, middle[None], angles).min(2)[0]
        return float((ranges[:180] + ranges[180:]).min()) / 2


def _at(what: str, pose: Sequence[float]) -> str:
    return f"{what} at ({pose[0]:.2f}, {pose[1]:.2f})".lstrip()
