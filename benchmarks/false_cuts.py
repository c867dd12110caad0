"""Is a good drive never cut, and is a robot that was carried noticed?

    python benchmarks/false_cuts.py PLAN ... [--seeds 1-2] [--carried]

Twelve robots drive about 80 m through each floor plan, one robot for each plan and seed, in turn.
Their lasers differ in the number of beams, the field of view, the reach, the rate, the noise, the
mount, and in what they report where nothing comes back. Their odometers differ in noise, scale and
drift. Posts stand beside the way of some, and people walk beside some. The script imports each
drive, without a search, and prints a row with

* the scans before which the track is cut,
* the largest error of the heading in degrees, of the odometer and of the track,
* how many pairs of visits whose fitted middles are within 0.8 m are right (2 m), and how many of
  the true pairs (1 m) are among them,
* the notes that doubt the drive.

With --carried, the middle third of each drive is missing, and the odometry goes on as if nothing
had happened. Then a cut at that point is right.
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise, product
from pathlib import Path

import numpy as np
from arguments import seeds_from
from dense import NEAREST, circles, drift_of, walkers, walls_seen

from perception.errors import LogError
from perception.places.importing import Imported, import_log
from perception.readers.echoes import LaserOptions, interpret_log
from perception.readers.scans import RobotLog, Scan, laser_of
from simulator.plans import Plan
from simulator.robot import SPEED, Odometer
from simulator.rounds import Building, record_plan
from simulator.world import Array
from ssh_abduction.data.odometry import Pose, displacement_between, moved

# The robot goes home after METRES metres. Its true pose is known each COARSE metres.
METRES, COARSE = 60.0, 0.1
# Words of the notes that doubt the drive.
DOUBTS = ("carried", "contradict", "do not fit", "unreliable", "jump", "disagree")
# What a laser reports where nothing comes back, by its reach.
NOTHING = {"inf": lambda _: np.inf, "zero": lambda _: 0.0, "most": lambda reach: reach}
# Posts: one for each METRES_A_POST metres, their radius, and how far they are from the way, in
# metres.
METRES_A_POST, POST, BESIDE = 4.0, (0.03, 0.2), (0.6, 2.5)
# Visits with middles within JOINED metres count as joined. A join is right if the true middles are
# within RIGHT metres, and a pair is true if they are within TRUE metres.
JOINED, RIGHT, TRUE = 0.8, 2.0, 1.0
# A cut is at the carry if it is at most this many scans away.
ABOUT = 3


@dataclass(frozen=True)
class Robot:
    """A laser and an odometer. Lengths are in metres, angles in degrees, noise as by `Odometer`."""

    beams: int
    fov: float
    reach: float
    noise: float  # standard deviation of a range
    rate: float  # scans a second
    speed: float  # metres a second
    nothing: str = "inf"  # what is reported where nothing comes back
    along: float = 0.05  # noise of the odometer
    scale: float = 0.0  # share by which distances of the odometer are too long
    bend: float = 0.0  # radians by which the odometer turns to the left in a metre
    mount: Pose = (0.0, 0.0, 0.0)  # metres and radians
    people: bool = False  # whether people walk beside the robot
    posts: bool = False  # whether posts stand beside its way


ROBOTS = (
    Robot(360, 360, 3.5, 0.01, 10, 0.2, "zero", scale=0.06, people=True),
    Robot(360, 360, 12, 0.01, 10, 0.3, scale=0.06, people=True, posts=True),
    Robot(541, 270, 30, 0.01, 15, 1.0, "most", bend=0.002, mount=(0.2, 0.0, 0.0), posts=True),
    Robot(181, 180, 8, 0.01, 5, 0.4, "most", along=0.08),
    Robot(270, 270, 20, 0.02, 40, 1.2, mount=(0.15, 0.05, 0.1), people=True),
    Robot(720, 360, 16, 0.02, 20, 0.6, "zero", along=0.1, posts=True),
    Robot(360, 180, 10, 0.02, 25, 0.5, scale=-0.04, posts=True),
    Robot(270, 270, 5.6, 0.03, 10, 0.4, "zero", people=True, posts=True),
    Robot(180, 360, 6, 0.03, 5, 1.2, along=0.08, bend=-0.003),
    Robot(541, 270, 25, 0.01, 40, 0.8, "most", people=True, posts=True),
    Robot(400, 360, 8, 0.01, 7, 0.25, "zero", bend=0.004, mount=(-0.2, 0.0, math.pi), posts=True),
    Robot(181, 180, 30, 0.03, 5, 1.0, "most", scale=0.03, people=True),
)


def drive(plan: Path, seed: int, robot: Robot) -> RobotLog:
    """Simulate a drive, and return its log, with the true poses as the corrected ones."""
    building = Building.of(Plan.load(plan))
    coarse = record_plan(building.plan, seed=seed, metres=METRES, every=COARSE)
    chance = np.random.default_rng([seed, robot.beams, round(10 * robot.reach)])
    pace = robot.speed / SPEED
    times = np.arange(0.0, coarse.times[-1] / pace, 1 / robot.rate)
    columns = (*coarse.poses[:, :2].T, np.unwrap(coarse.poses[:, 2]))
    poses = np.stack([np.interp(times * pace, coarse.times, c) for c in columns], axis=1)
    odometer = Odometer(scale=robot.scale, bend=robot.bend).as_noisy_as(robot.along)
    odometry = odometer.reading(poses, chance)
    people = walkers(poses, times, chance)
    posts, radii = posts_beside(poses, chance)
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
    for k, pose in enumerate(poses):
        at = np.array(moved(tuple(pose), robot.mount))
        bearings = laser.first + step * np.arange(robot.beams)
        ranges = walls_seen(building.segments, at, robot.reach, bearings)
        if robot.people:
            ranges = np.minimum(ranges, circles(people[k], at, bearings))
        if robot.posts:
            near = np.hypot(*(posts - at[:2]).T) < robot.reach
            ranges = np.minimum(ranges, circles(posts[near], at, bearings, radii[near], 0.0))
        ranges = ranges + chance.normal(0, robot.noise, robot.beams)
        nothing = NOTHING[robot.nothing](robot.reach)
        ranges = np.where(ranges < robot.reach, np.maximum(ranges, 2 * NEAREST), nothing)
        x, y, heading = odometry[k].tolist()
        true = (float(pose[0]), float(pose[1]), math.remainder(float(pose[2]), math.tau))
        scans.append(Scan(ranges, laser, (x, y, heading), true, float(times[k]), line=k + 1))
    name = f"{plan.stem.removesuffix('_updated')}-{seed}-robot{ROBOTS.index(robot)}"
    meant, notes = interpret_log(scans, LaserOptions())
    return RobotLog(meant, source=name, notes=notes)


def posts_beside(poses: Array, chance: np.random.Generator) -> tuple[Array, Array]:
    """The positions of posts beside a way, (n, 2) metres, and their radii, (n,)."""
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
    count = round(way[-1] / METRES_A_POST)
    at = poses[np.searchsorted(way, chance.uniform(0, way[-1], count)), :2]
    side, far = chance.uniform(0, math.tau, count), chance.uniform(*BESIDE, count)
    posts = at + far[:, None] * np.stack([np.cos(side), np.sin(side)], axis=1)
    away = np.array([np.hypot(*(poses[:, :2] - post).T).min() for post in posts])
    kept = away >= BESIDE[0]
    return posts[kept], chance.uniform(*POST, count)[kept]


def carried(log: RobotLog) -> RobotLog:
    """The log without its middle third. The odometry goes on as if nothing had happened."""
    third = len(log) // 3  # the scan to which the robot is carried
    first, last = log.scans[:third], log.scans[2 * third :]
    poses = [first[-1].odometry]
    for one, other in pairwise(last):
        poses.append(moved(poses[-1], displacement_between(one.odometry, other.odometry)))
    after = (replace(scan, odometry=pose) for scan, pose in zip(last, poses, strict=True))
    return replace(log, scans=(*first, *after))


def joins_of(log: RobotLog, imported: Imported) -> Counter[str]:
    """Count the pairs of visits that are joined, right, true and found."""
    middles, counts = [], Counter[str]()
    for visit in imported.visits:
        true = log.scans[visit.scan].corrected
        seen = displacement_between(imported.track.pose(visit.scan), (*visit.middle, 0.0))
        assert true is not None
        middles.append(moved(true, seen)[:2])
    for i, j in combinations(range(len(middles)), 2):
        away = math.dist(middles[i], middles[j])
        joined = math.dist(imported.poses[i][:2], imported.poses[j][:2]) <= JOINED
        counts["joined"] += joined
        counts["right"] += joined and away <= RIGHT
        counts["true"] += away <= TRUE
        counts["found"] += joined and away <= TRUE
    return counts


def row(log: RobotLog, imported: Imported, notes: Sequence[str], seconds: float) -> str:
    """Make the row of a drive."""
    truth = np.array([scan.corrected for scan in log.scans])
    way = float(np.hypot(*np.diff(truth[:, :2], axis=0).T).sum())
    drifts = (drift_of(way[:, 2], truth[:, 2]) for way in (log.odometry, imported.track.poses))
    pairs = joins_of(log, imported)
    cells = [
        log.source,
        len(log),
        f"{way:.0f}",
        *(f"{drift:.1f}" for drift in drifts),
        ", ".join(map(str, imported.track.cuts)),
        f"{pairs['right']} of {pairs['joined']}",
        f"{pairs['found']} of {pairs['true']}",
        f"{seconds:.0f}",
        " ".join(note[:200] for note in notes if any(word in note for word in DOUBTS)),
    ]
    return "| " + " | ".join(map(str, cells)) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("plans", nargs="+", type=Path, metavar="PLAN")
    parser.add_argument("--seeds", type=seeds_from, default=seeds_from("1-2"), metavar="A-B")
    parser.add_argument("--carried", action="store_true", help="carry the robot in each drive")
    options = parser.parse_args()
    print(
        "| drive | scans | m | drift of odometry | drift | cuts | right of joined | found of true "
        "| CPU s | notes that doubt it |\n" + 10 * "|---" + "|"
    )
    total = Counter[str]()
    for number, (seed, plan) in enumerate(product(options.seeds, options.plans)):
        log = drive(plan, seed, ROBOTS[number % len(ROBOTS)])
        third = len(log) // 3
        log = carried(log) if options.carried else log
        begin, notes = time.process_time(), list[str](log.notes)
        total["drives"] += 1
        try:
            imported = import_log(log, tell=notes.append)
        except LogError as error:
            print(f"| {log.source} | {len(log)} | | | | refused | | | | {error} |", flush=True)
            total["refused"] += 1
            continue
        line = row(log, imported, notes, time.process_time() - begin)
        print(line, flush=True)
        total += joins_of(log, imported)
        there = [abs(cut - third) <= ABOUT for cut in imported.track.cuts]
        total["cut at the carry"] += options.carried and any(there)
        total["cut elsewhere"] += not all(there) if options.carried else bool(there)
        total["doubted"] += not line.endswith("|  |")
    print("\n" + ", ".join(f"{count} {what}" for what, count in total.items()))


if __name__ == "__main__":
    main()
