"""Simulates tours: a robot drives a route repeatedly and logs images and actions."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from simulator.control import STILL, Driver, Tolerance, act, climb
from simulator.cruise import follow
from simulator.drive import EVERY, Drive, Recorder
from simulator.errors import SimulatorError
from simulator.freespace import FreeSpace
from simulator.junctions import ACTIONS, Pilot
from simulator.laser import Laser
from simulator.motion import DIGITS
from simulator.odometer import Odometer
from simulator.panorama import Camera
from simulator.robot import Body, Report, Robot
from simulator.watch import Watch
from simulator.world import World
from ssh_abduction.data.checks import a_flag, a_number, a_whole_number, an_instance
from ssh_abduction.data.odometry import Covariance, Displacement
from ssh_abduction.data.odometry import Odometry as Noise
from ssh_abduction.data.trace import Action, Step, Trace
from ssh_abduction.data.words import counted

Array = NDArray[np.float64]
# More tours than this are a mistake: they take days, and all steps are kept in memory.
MOST_TOURS = 100_000
QUARTERS = {"travel": 0, "right": 1, "around": 2, "left": 3}


@dataclass
class Star:
    """The openings of the place where the robot is, as seen since it arrived.

    Attributes:
        reach: Half the width of a corridor in metres.
        slots: Whether there is an opening, by slot. Slot 0 is the direction of arrival.
        facing: The slot that the robot faces.
    """

    reach: float
    slots: dict[int, bool] = field(default_factory=dict)
    facing: int = 0

    def act(self, action: str) -> None:
        """Update the slots after an action."""
        if action == "travel":
            # The robot came through the opening behind it.
            self.slots, self.facing = (
                {2: True},
                0,
            )
        else:
            self.facing = (self.facing + QUARTERS[action]) % 4

    def look(self, image: Array) -> None:
        """Mark the directions ahead, right and left as openings if their walls are far.

        The image does not show what is behind the robot.
        """
        for slot, beams in ((0, image[82:98]), (1, image[:10]), (3, image[-10:])):
            self.slots[(self.facing + slot) % 4] = bool(np.median(beams) > 1.8 * self.reach)

    def seen(self) -> tuple[float, ...]:
        """The openings ahead, right, behind and left, as far as known."""
        return tuple(float(self.slots.get((self.facing + k) % 4, False)) for k in range(4))


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
    """Drive tours of a world, and log an image at each dstate.

    A trace has tours x actions steps, and its last step has no action. The displacement of a step
    is the odometry of all motions since the last step, also those of hill-climbing; the odometry of
    the trace is the noise that fits them. `truth` has dstate, place, path and pose, for evaluation
    only.

    Args:
        world: The world.
        tours: Number of tours.
        seed: Seed of all noise.
        laser: The scanner.
        body: Errors of the robot.
        tolerance: Precision of hill-climbing.
        stars: Whether to log the openings at each place, as seen since the robot arrived there.
        every: Metres of odometry between images, wherever the robot is; the trace then has travels
            only. None logs at dstates.
        camera: A camera whose panoramas are logged instead of ranges, row by row, as whole numbers;
            `panorama` in the header is their shape. The robot still drives by its laser, so with
            the same seed both drives are the same.

    Raises:
        SimulatorError: The route cannot be driven.
    """
    if every is not None:
        a_number(
            "every",
            every,
            SimulatorError,
            above=0,
            what="a number of metres",
            mend="leave it out for images at dstates",
        )
    a_flag("stars", stars, SimulatorError)
    if camera is not None:
        an_instance(
            "camera",
            camera,
            Camera,
            SimulatorError,
            mend="make one with Camera(), or leave it out for ranges",
        )
    an_instance("world", world, World, SimulatorError, mend="take World.named or World.load")
    if world.by_places:
        raise SimulatorError(
            f"{world.name}: route: expected actions, got places, to which a robot drives that "
            "logs scans all along; write --as carmen, or give a route of actions"
        )
    driver = _driver(world, tours, seed, laser, body, tolerance)
    body, tolerance = driver.robot.body, driver.tolerance
    log = Log(driver.robot)
    eye = Eye(
        camera, len(world.segments), np.random.default_rng([seed, 1]), tours * len(world.route)
    )
    steps = (
        list(_at_dstates(driver, log, world, tours, stars, eye))
        if every is None
        else _evenly(driver, log, world, tours, every, eye)
    )
    steps[-1] = replace(steps[-1], action=None)
    odometry = _noise(log, world, body, tolerance if every is None else None)
    extra = {} if camera is None else {"panorama": list(camera.shape)}
    return Trace(
        tuple(steps),
        name=f"{world.name}, {tours} tours, seed {seed}",
        odometry=odometry,
        extra=extra,
    )


def record(
    world: World,
    tours: int = 1,
    seed: int = 0,
    *,
    laser: Laser | None = None,
    body: Body | None = None,
    odometer: Odometer | None = None,
    every: float = EVERY,
) -> Drive:
    """Drive tours as `simulate` does, and log scans.

    The odometer of the log is not the one for control: it has the noise of robots in recorded logs.

    Args:
        world: The world.
        tours: Number of tours.
        seed: Seed of all noise.
        laser: The scanner.
        body: Errors of the robot.
        odometer: Noise of the odometry in the log.
        every: Metres between scans. In turns there is a scan every ten degrees.

    Raises:
        SimulatorError: The route cannot be driven.
    """
    driver = _driver(world, tours, seed, laser, body, None)
    recorder = driver.recorder = Recorder(every)
    recorder.note(driver.world, driver.robot.pose)
    steps = []
    for _, action in (
        _stops(driver, world, tours) if world.by_places else _legs(driver, world, tours)
    ):
        steps.append(
            {"scan": recorder.taken - 1, **_truth(world, driver.robot.pose), "action": action}
        )
    name = f"{world.name}, {counted(tours, 'tours')}, seed {seed}"
    drive = recorder.drive(name, driver.laser, odometer or Odometer(), seed)
    return drive.judged(world.places, [_place(world, pose) for pose in drive.poses], steps=steps)


def _place(world: World, pose: Array) -> str | None:
    """The nearest place of a robot if it is within `reach`; None between places."""
    far = {name: math.dist(at, pose[:2]) for name, at in world.places.items()}
    nearest = min(far, key=far.__getitem__, default=None)
    return nearest if nearest is not None and far[nearest] <= world.reach else None


def _stops(driver: Driver, world: World, tours: int) -> Iterator[tuple[int, str]]:
    """Drive to the places of the route on all tours; yield number and name before each."""
    for tour in range(tours):
        if tour:
            driver.world = world.arranged(driver.rng)
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
                deque(follow(driver, space, way), maxlen=0)
            except SimulatorError as error:
                raise SimulatorError(
                    f"{error} (on the way to {stop}, on tour {tour + 1})"
                ) from None


def _driver(
    world: World,
    tours: int,
    seed: int,
    laser: Laser | None,
    body: Body | None,
    tolerance: Tolerance | None,
) -> Driver:
    """A robot at the start of a world. Raises SimulatorError if no tour can begin."""
    an_instance("world", world, World, SimulatorError, mend="take World.named or World.load")
    a_whole_number("tours", tours, SimulatorError, 1, MOST_TOURS)
    a_whole_number("seed", seed, SimulatorError)
    for name, given, kind in (
        ("laser", laser, Laser),
        ("body", body, Body),
        ("tolerance", tolerance, Tolerance),
    ):
        if given is not None:
            an_instance(
                name,
                given,
                kind,
                SimulatorError,
                mend=f"make one with {kind.__name__}(), or leave it out",
            )
    if not world.route:
        raise SimulatorError(
            f"{world.name}: route: expected at least one action, got none; add it to the "
            "world, or give one"
        )
    body = body or Body()
    x, y, _ = world.start
    if not world.holds(x, y) or world.clearance(x, y) < body.radius:
        raise SimulatorError(
            f"{world.name}: start: expected a place {body.radius} m off the walls, got ({x}, "
            f"{y}); move it"
        )
    rng = np.random.default_rng(seed)
    return Driver(
        world.arranged(rng),
        Robot(body, world.start, rng),
        laser or Laser(),
        rng,
        tolerance or Tolerance(),
    )


def _noise(log: Log, world: World, body: Body, tolerance: Tolerance | None) -> Noise:
    """The noise of the displacements. If each has a covariance, only systematic errors remain."""
    if world.angles == "any" and tolerance is not None:
        return Noise(scale=abs(body.scale), bend=abs(body.bend))
    return noise_model(log.reports, body, tolerance)


@dataclass
class Eye:
    """Makes the logged image of a step: ranges of the laser, or a panorama.

    Attributes:
        camera: The camera, or None for ranges.
        walls: Number of segments of the world without clutter.
        rng: Source of noise of the camera.
        actions: Number of actions of the run, which tells the hour.
    """

    camera: Camera | None
    walls: int
    rng: np.random.Generator
    actions: int

    def image(self, driver: Driver, ranges: Array, done: int) -> tuple[float, ...]:
        """The image after this many actions."""
        if self.camera is None:
            return tuple(round(float(r), 4) for r in ranges)
        hour = self.camera.hour(done / max(self.actions - 1, 1))
        return tuple(
            self.camera.shot(driver.world, driver.robot.pose, self.rng, hour, self.walls)
            .ravel()
            .tolist()
        )


@dataclass
class Log:
    """Odometry between the logged steps.

    Attributes:
        robot: The robot.
        reports: Reports of its odometry between steps.
        begun: Whether a step was logged already.
    """

    robot: Robot
    reports: list[Report] = field(default_factory=list)
    begun: bool = False

    def displacement(self) -> Displacement | None:
        """Displacement from the last step, rounded; None for the first step."""
        report = self.robot.report()
        if not self.begun:
            self.begun = True
            return None
        self.reports.append(report)
        dx, dy, turned = (round(v, DIGITS) for v in report.displacement)
        return dx, dy, turned


def noise_model(reports: Sequence[Report], body: Body, tolerance: Tolerance | None = None) -> Noise:
    """The noise of the displacements between dstates, from odometry and hill-climbing.

    Each reported motion has an error proportional to it, so the relative error of many motions
    together is smaller. The shares here reproduce the mean covariance of the reports.

    A map describes fixed points. Hill-climbing ends within its tolerance of them at both ends of a
    step; the model assumes a uniform distribution. A wrong heading at the beginning also moves the
    end sideways.

    Args:
        reports: Reports between steps.
        body: Errors of the robot.
        tolerance: Precision of hill-climbing; None for displacements between poses themselves.
    """
    ways = math.fsum(math.hypot(*r.displacement[:2]) ** 2 for r in reports)
    turns = math.fsum(r.displacement[2] ** 2 for r in reports)
    along, across, heading = (
        np.sum([np.diag(r.covariance) for r in reports], axis=0) if reports else np.zeros(3)
    )
    share = 1 / ways if ways else 0.0
    offset, tilt = (
        (tolerance.close / math.sqrt(3), tolerance.straight / math.sqrt(3))
        if tolerance
        else (0.0, 0.0)
    )
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


def _at_dstates(
    driver: Driver, log: Log, world: World, tours: int, stars: bool, eye: Eye
) -> Iterator[Step]:
    """Drive all tours, and make a step at each dstate."""
    if world.angles == "any":
        yield from _at_junctions(driver, log, world, tours, stars, eye)
        return
    star, watch = Star(world.reach), Watch(world, driver, tours)
    with watch.start():
        climb(driver)
        if stars:  # The image shows half a circle, so look behind, too.
            driver.go(0.0, math.pi)
            star.facing = 2
            star.look(driver.look(STILL))
            driver.go(0.0, math.pi)
            star.facing = 0
            climb(driver)
    for tour in range(tours):
        if tour:
            driver.world = world.arranged(driver.rng)
        for number, action in enumerate(world.route, tour * len(world.route)):
            image = driver.look(STILL)
            star.look(image)
            yield Step(
                image=eye.image(driver, image, number),
                action=Action.of(action),
                star=star.seen() if stars else None,
                displacement=log.displacement(),
                truth=_truth(world, driver.robot.pose),
            )
            with watch.action(number, action):
                act(driver, action)
            star.act(action)


def _at_junctions(
    driver: Driver, log: Log, world: World, tours: int, stars: bool, eye: Eye
) -> Iterator[Step]:
    """The same as `_at_dstates`, for streets that meet at any angles.

    The robot turns by different amounts to look around, so each displacement has its own
    covariance.
    """
    pilot, watch = Pilot(driver), Watch(world, driver, tours)
    with watch.start():
        pilot.begin()
    done = ""
    for tour in range(tours):
        if tour:
            driver.world = world.arranged(driver.rng)
        for number, action in enumerate(world.route, tour * len(world.route)):
            displacement = log.displacement()
            yield Step(
                image=eye.image(driver, driver.look(STILL), number),
                action=ACTIONS[action],
                star=pilot.star() if stars else None,
                displacement=displacement,
                covariance=None
                if displacement is None
                else _covariance(log.reports[-1], driver.tolerance, done),
                truth=_truth(world, driver.robot.pose),
            )
            with watch.action(number, action):
                pilot.act(action)
            done = action


def _covariance(report: Report, tolerance: Tolerance, action: str) -> Covariance:
    """Covariance of a displacement between fixed points, from odometry and hill-climbing.

    Hill-climbing ends anywhere within its tolerance. A turn stays at one point, to a millimetre.
    """
    dx, dy, _ = report.displacement
    near = tolerance.close / math.sqrt(3) if action == "travel" else 0.001
    left = np.diag([near**2, near**2, tolerance.straight**2 / 3])
    # A wrong heading moves the end sideways.
    by_start = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    whole = report.covariance + by_start @ left @ by_start.T + left
    a, b, c = (tuple(float(f"{v:.4g}") for v in row) for row in (whole + whole.T) / 2)
    return a, b, c  # type: ignore[return-value]


def _evenly(
    driver: Driver, log: Log, world: World, tours: int, every: float, eye: Eye
) -> list[Step]:
    """Log images every `every` metres of odometry.

    Points within that distance along the route count as one spot on all tours.
    """
    logged: list[Step] = []
    leg_began = due = 0.0
    leg = 0

    def look(driver: Driver) -> None:
        nonlocal due
        if driver.robot.driven >= due:
            spot = (
                f"leg {leg % len(world.route)}, {round((driver.robot.driven - leg_began) / every)}"
            )
            truth = {"dstate": spot, "pose": [round(v, 4) for v in driver.robot.pose]}
            image = eye.image(driver, driver.look(STILL), leg)
            logged.append(
                Step(
                    image=image,
                    action=Action.of("travel"),
                    displacement=log.displacement(),
                    truth=truth,
                )
            )
            due += every

    driver.on_travel = look
    for leg, _ in _legs(driver, world, tours):  # noqa: B007 - `look` reads the number of the leg
        leg_began = driver.robot.driven
    return logged


def _legs(driver: Driver, world: World, tours: int) -> Iterator[tuple[int, str]]:
    """Drive all tours; yield the number and name of each action before it."""
    pilot, watch = Pilot(driver) if world.angles == "any" else None, Watch(world, driver, tours)
    with watch.start():
        pilot.begin() if pilot else climb(driver)
    for tour in range(tours):
        if tour:
            driver.world = world.arranged(driver.rng)
        for number, action in enumerate(world.route, tour * len(world.route)):
            yield number, action
            with watch.action(number, action):
                pilot.act(action) if pilot else act(driver, action)


def _truth(world: World, pose: Sequence[float]) -> dict[str, object]:
    """The truth about a pose: the nearest true dstate, if the world has any."""
    found = world.nearest(pose)
    where = {"pose": [round(float(v), 5) for v in pose]}
    return (
        {
            "dstate": found.name,
            "place": found.place,
            "path": found.path,
            "direction": found.direction,
            **where,
        }
        if found
        else dict(where)
    )
