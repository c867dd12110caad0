"""Simulates tours: a robot drives a route repeatedly and logs images, actions and odometry."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from simulator.cruise import FreeSpace, drive_along
from simulator.driver import STILL, Corridors, Driver, Tolerance
from simulator.errors import SimulatorError
from simulator.junctions import ACTIONS, Pilot
from simulator.panorama import Camera
from simulator.robot import (
    DIGITS,
    EVERY,
    Body,
    Laser,
    Odometer,
    RecordedDrive,
    Recorder,
    Report,
    SimulatedRobot,
)
from simulator.watch import DriveWatch
from simulator.world import Array, World
from ssh_abduction.data.checks import a_flag, a_number, a_whole_number, an_instance
from ssh_abduction.data.odometry import Covariance, Displacement, Odometry
from ssh_abduction.data.trace import Action, Step, Trace
from ssh_abduction.data.words import counted

# More tours than this would take days, and all steps are kept in memory.
MOST_TOURS = 100_000


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
        A trace with tours x actions steps at dstates; its last step has no action. Its `odometry`
        is the noise model of the displacements. The truth of each step has dstate, place, path and
        pose, for evaluation only.

    Raises:
        SimulatorError: The route cannot be driven.
    """
    _check(world, stars, every, camera)
    driver = _driver(world, tours, seed, laser, body, tolerance)
    body, tolerance = driver.robot.body, driver.tolerance
    log = OdometryLog(driver.robot)
    # The camera has its own noise, so that it does not change the drive.
    noise = np.random.default_rng([seed, 1])
    eye = Eye(camera, len(world.segments), noise, tours * len(world.route))
    if every is None:
        steps = list(_at_dstates(driver, log, world, tours, stars, eye))
    else:
        steps = _evenly(driver, log, world, tours, every, eye)
    steps[-1] = replace(steps[-1], action=None)
    if every is None and world.angles == "any":
        # Each displacement has a covariance of its own, so only systematic errors are left.
        odometry = Odometry(scale=abs(body.scale), bend=abs(body.bend))
    else:
        odometry = noise_model(log.reports, body, tolerance if every is None else None)
    extra = {} if camera is None else {"panorama": list(camera.shape)}
    return Trace(
        tuple(steps),
        name=f"{world.name}, {tours} tours, seed {seed}",
        odometry=odometry,
        extra=extra,
    )


def _check(world: World, stars: bool, every: float | None, camera: Camera | None) -> None:
    """Check the arguments of `simulate` that other functions do not check."""
    if every is not None:
        mend, what = "leave it out for images at dstates", "a number of metres"
        a_number("every", every, SimulatorError, above=0, what=what, mend=mend)
    a_flag("stars", stars, SimulatorError)
    if camera is not None:
        mend = "make one with Camera(), or leave it out for ranges"
        an_instance("camera", camera, Camera, SimulatorError, mend=mend)
    an_instance("world", world, World, SimulatorError, mend="take World.named or World.load")
    if every is not None and world.lifts:
        raise SimulatorError(
            f"every: expected no distance in {world.name}, as evenly spaced images would join "
            "the floors at its lifts; leave it out"
        )
    if world.by_places:
        raise SimulatorError(
            f"{world.name}: route: expected actions, got places, and a robot that drives to places "
            "writes a log of scans; write --format carmen, or give a route of actions"
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
    if world.lifts:
        raise SimulatorError(
            f"{world.name}: lifts: expected none in the log of a robot, as a log does not show "
            "that the floor changes; leave out --format"
        )
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
            if way is None:
                off = world.clearance(*world.stops[stop])
                mend = f"open the walls, or move {stop}, which is {off:.2f} m off the nearest one"
                raise SimulatorError(
                    f"{world.name}: route: expected a way from ({x:.2f}, {y:.2f}) to {stop}, "
                    f"got none; {mend}"
                )
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
    for name, given, kind in (
        ("laser", laser, Laser),
        ("body", body, Body),
        ("tolerance", tolerance, Tolerance),
    ):
        if given is not None:
            mend = f"make one with {kind.__name__}(), or leave it out"
            an_instance(name, given, kind, SimulatorError, mend=mend)
    body = body or Body()
    _check_world(world, body)
    rng = np.random.default_rng(seed)
    arranged, robot = world.arranged(rng), SimulatedRobot(body, world.start, rng)
    return Driver(arranged, robot, laser or Laser(), rng, tolerance or Tolerance())


def _check_world(world: World, body: Body) -> None:
    """Check that a robot can drive in a world. Raises SimulatorError."""
    if world.lifts and world.angles == "any":
        raise SimulatorError(
            f"{world.name}: lifts: expected a world whose streets meet at right angles, got one "
            'of any angles; write "angles": "right", or leave out the lifts'
        )
    if not world.route:
        raise SimulatorError(
            f"{world.name}: route: expected at least one action, got none; add it to the "
            "world, or give one"
        )
    x, y, _ = world.start
    # The robot must fit where it starts.
    if not world.holds(x, y) or world.clearance(x, y) < body.radius:
        raise SimulatorError(
            f"{world.name}: start: expected a place {body.radius} m off the walls, got ({x}, "
            f"{y}); move it"
        )


def _at_dstates(
    driver: Driver, log: OdometryLog, world: World, tours: int, stars: bool, eye: Eye
) -> Iterator[Step]:
    """Drive all tours, and make a step at each dstate."""
    is_square = world.angles == "right"
    pilot = Corridors(driver, looks_behind=stars) if is_square else Pilot(driver)
    done = ""
    lifts = {lift.name for lift in world.lifts}
    for number, action in _legs(driver, world, tours, pilot):
        if done in lifts:
            log.begun = False  # Each floor has a frame of its own.
        image, displacement = driver.look(STILL), log.displacement()
        # If streets meet at any angles, turns to look around differ. So each displacement has its
        # own covariance.
        covariance = None
        if displacement is not None and not is_square:
            covariance = covariance_of(log.reports[-1], driver.tolerance, done)
        does = Action.of(action) if is_square else ACTIONS[action]
        yield Step(
            image=eye.image(driver, image, number),
            action=Action(action, "lift") if action in lifts else does,
            star=pilot.star(image) if stars else None,
            displacement=displacement,
            covariance=covariance,
            truth=_truth(world, driver.robot.pose),
        )
        done = action


def _evenly(
    driver: Driver, log: OdometryLog, world: World, tours: int, every: float, eye: Eye
) -> list[Step]:
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
            image = eye.image(driver, driver.look(STILL), leg)
            travel, onward = Action.of("travel"), log.displacement()
            logged.append(Step(image=image, action=travel, displacement=onward, truth=truth))
            due += every

    driver.on_travel = look
    for leg, _ in _legs(driver, world, tours):  # noqa: B007 - `look` reads the number of the leg
        leg_began = driver.robot.driven
    return logged


def _legs(
    driver: Driver, world: World, tours: int, pilot: Corridors | Pilot | None = None
) -> Iterator[tuple[int, str]]:
    """Drive all tours. Before each action, yield its number over all tours, and its name."""
    pilot = pilot or (Pilot(driver) if world.angles == "any" else Corridors(driver))
    watch = DriveWatch(world, driver, tours)
    with watch.start():
        pilot.begin()
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
    where = {"pose": [round(float(v), 5) for v in pose]}
    if not found:
        return dict(where)
    named = {"dstate": found.name, "place": found.place, "path": found.path}
    return {**named, "direction": found.direction, **where}


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


def noise_model(
    reports: Sequence[Report], body: Body, tolerance: Tolerance | None = None
) -> Odometry:
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
    return Odometry.of({name: round(error, 6) for name, error in errors.items()})


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
