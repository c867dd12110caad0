"""Is a good drive never cut, and is a robot that was carried noticed?

    python benchmarks/false_cuts.py PLAN ... [--seeds 1-2] [--carried]

Twelve robots drive 100 m through each floor plan, one robot for each plan and seed, in turn. Their
lasers differ in the number of beams, the field of view, the reach, the noise and the mount, and
their odometers in noise and scale. They scan every 5 to 50 cm. The script prints a row for each
drive with the scans before which the track is cut, and the notes that doubt the drive. With
--carried, the middle third of each drive is missing, and the odometry goes on as if nothing had
happened. Then a cut at that point is right.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from pathlib import Path

import numpy as np
from arguments import seeds_from
from dense import NEAREST, circles, walkers, walls_seen

from perception.places.importing import tracked
from perception.readers.scans import RobotLog, Scan, laser_of
from simulator.plans import Plan
from simulator.robot import Odometer
from simulator.rounds import Building, record_plan
from ssh_abduction.data.odometry import Pose, displacement_between, moved

METRES = 100.0
# Words of the notes that doubt the drive.
DOUBTS = ("carried", "contradict", "do not fit", "unreliable", "jump")


@dataclass(frozen=True)
class Robot:
    """A laser and an odometer. Lengths are in metres, angles in degrees, noise as by `Odometer`."""

    beams: int
    fov: float
    reach: float
    noise: float  # standard deviation of a range
    every: float  # way between two scans
    along: float = 0.05  # noise of the odometer
    scale: float = 0.0  # share by which distances of the odometer are too long
    mount: Pose = (0.0, 0.0, 0.0)  # metres and radians
    people: bool = False  # whether people walk beside the robot


ROBOTS = (
    Robot(360, 360, 3.5, 0.01, 0.05, scale=0.06, people=True),
    Robot(360, 360, 12, 0.01, 0.05, scale=0.06, people=True),
    Robot(181, 180, 8, 0.01, 0.2),
    Robot(181, 180, 30, 0.03, 0.5, mount=(0.2, 0.0, 0.0)),
    Robot(241, 240, 5.6, 0.03, 0.1, people=True),
    Robot(541, 270, 30, 0.01, 0.1, mount=(0.15, 0.05, 0.1)),
    Robot(720, 360, 16, 0.02, 0.25, along=0.1, people=True),
    Robot(120, 360, 6, 0.03, 0.2, along=0.08),
    Robot(90, 180, 10, 0.02, 0.25, scale=-0.04),
    Robot(360, 360, 8, 0.01, 0.3, mount=(-0.2, 0.0, math.pi), people=True),
    Robot(682, 240, 4, 0.02, 0.1, along=0.03),
    Robot(270, 135, 20, 0.01, 0.15, scale=0.03, people=True),
)


def drive(plan: Path, seed: int, robot: Robot) -> RobotLog:
    """Simulate a drive, and return its log, with the true poses as the corrected ones."""
    building = Building.of(Plan.load(plan))
    found = record_plan(building.plan, seed=seed, metres=METRES, every=robot.every)
    chance = np.random.default_rng([seed, robot.beams, round(10 * robot.reach)])
    odometer = Odometer(scale=robot.scale).as_noisy_as(robot.along)
    odometry = odometer.reading(found.poses, chance)
    people = walkers(found.poses, found.times, chance)
    step = math.radians(robot.fov) / robot.beams
    laser = laser_of(
        -math.radians(robot.fov) / 2,
        step,
        robot.beams,
        robot.reach,
        nearest=NEAREST,
        mount=robot.mount,
    )
    scans = []
    for k, pose in enumerate(found.poses):
        at = np.array(moved(tuple(pose), robot.mount))
        bearings = laser.first + step * np.arange(robot.beams)
        ranges = walls_seen(building.segments, at, robot.reach, bearings)
        if robot.people:
            ranges = np.minimum(ranges, circles(people[k], at, bearings))
        ranges = ranges + chance.normal(0, robot.noise, robot.beams)
        ranges = np.where(ranges < robot.reach, np.maximum(ranges, NEAREST), np.inf)
        x, y, heading = odometry[k].tolist()
        time = float(found.times[k])
        scans.append(Scan(ranges, laser, (x, y, heading), tuple(pose), time, line=k + 1))
    name = f"{plan.stem.removesuffix('_updated')}-{seed}-robot{ROBOTS.index(robot)}"
    return RobotLog(tuple(scans), source=name)


def carried(log: RobotLog) -> RobotLog:
    """The log without its middle third. The odometry goes on as if nothing had happened."""
    third = len(log) // 3
    first, last = log.scans[:third], log.scans[2 * third :]
    poses = [first[-1].odometry]
    for one, other in pairwise(last):
        poses.append(moved(poses[-1], displacement_between(one.odometry, other.odometry)))
    after = (replace(scan, odometry=pose) for scan, pose in zip(last, poses, strict=True))
    return replace(log, scans=(*first, *after))


def row(log: RobotLog, notes: Sequence[str], cuts: Sequence[int]) -> str:
    """Make the row of a drive."""
    said = " ".join(note[:100] for note in notes if any(word in note for word in DOUBTS))
    return f"| {log.source} | {len(log)} | {', '.join(map(str, cuts))} | {said} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("plans", nargs="+", type=Path, metavar="PLAN")
    parser.add_argument("--seeds", type=seeds_from, default=seeds_from("1-2"), metavar="A-B")
    parser.add_argument("--carried", action="store_true", help="carry the robot in each drive")
    options = parser.parse_args()
    print("| drive | scans | cuts | notes that doubt it |\n|---|---|---|---|")
    whole = cut = doubted = 0
    for number, (seed, plan) in enumerate(product(options.seeds, options.plans)):
        log = drive(plan, seed, ROBOTS[number % len(ROBOTS)])
        log = carried(log) if options.carried else log
        _, track, notes = tracked(log)
        print(line := row(log, notes, track.cuts), flush=True)
        whole, cut = whole + 1, cut + bool(track.cuts)
        doubted += not line.endswith("|  |")
    print(f"\n{whole} drives: {cut} are cut, {doubted} have a note that doubts them")


if __name__ == "__main__":
    main()
