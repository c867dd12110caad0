"""Are logs of small robots followed well, whose lasers scan 10 to 40 times a second?

    python benchmarks/dense.py PLAN ... [--seeds 1-2] [--joins]

A robot with the laser of a TurtleBot 3 or 4 (360 beams, reach 3.5 or 12 m) drives 100 m through
each floor plan. Its odometer reports distances that are 6 % too long, and three people walk near
it. The script prints how far the heading of the track is off at most, and the processor time of
the import as a share of the drive. With --joins, the log is mapped, and the pairs of visits that
the map joins are counted as in `courses.py`.
"""

from __future__ import annotations

import argparse
import math
import time
from itertools import product
from pathlib import Path

import numpy as np
from arguments import seeds_from
from courses import counts_of

from perception.places.importing import import_log
from perception.readers.scans import RobotLog, Scan, laser_of
from simulator.plans import Plan
from simulator.robot import Odometer, meetings
from simulator.rounds import Building, record_plan
from simulator.world import Array
from ssh_abduction import map_log

BEAMS, NEAREST = 360, 0.12
BEARINGS = math.tau / BEAMS * np.arange(BEAMS) - math.pi
# Reach of the lasers in metres.
REACHES = {"TurtleBot 3": 3.5, "TurtleBot 4": 12.0}
# Scans a second, and how many times the robot is as fast as usual (0.5 m/s).
RATES = {10: 1.0, 20: 1.0, 40: 1.6}
METRES = 100.0
# Standard deviation of a range: metres, and share of the range.
NOISE, SHARE = 0.01, 0.005
# Number of people, their radius, how far they go away, and how near they come, in metres.
PEOPLE, RADIUS, AWAY, NEAR = 3, 0.2, 8.0, 0.6
# The largest speed of people relative to the robot, in metres a second.
PACE = 1.0


def drive(plan: Path, seed: int, rate: int, reach: float) -> RobotLog:
    """Simulate a drive, and return its log, with the true poses as the corrected ones."""
    building = Building.of(Plan.load(plan))
    coarse = record_plan(building.plan, seed=seed, metres=METRES, every=0.1)
    chance = np.random.default_rng([seed, rate, round(10 * reach)])
    times = np.arange(0.0, coarse.times[-1] / RATES[rate], 1 / rate)
    columns = (*coarse.poses[:, :2].T, np.unwrap(coarse.poses[:, 2]))
    poses = np.stack([np.interp(times * RATES[rate], coarse.times, c) for c in columns], axis=1)
    odometry = Odometer(scale=0.06).reading(poses, chance)
    people = walkers(poses, times, chance)
    laser = laser_of(-math.pi, math.tau / BEAMS, BEAMS, reach, nearest=NEAREST)
    scans = []
    for k, pose in enumerate(poses):
        ranges = np.minimum(walls_seen(building.segments, pose, reach), circles(people[k], pose))
        ranges = ranges + chance.normal(size=BEAMS) * (NOISE + SHARE * np.minimum(ranges, reach))
        ranges = np.where(ranges < reach, np.maximum(ranges, NEAREST), np.inf)
        scans.append(
            Scan(ranges, laser, tuple(odometry[k]), tuple(pose), float(times[k]), line=k + 1)
        )
    name = f"{plan.stem.removesuffix('_updated')}-{seed}-{rate}-{reach:g}"
    return RobotLog(tuple(scans), source=name)


def walkers(poses: Array, times: Array, chance: np.random.Generator) -> Array:
    """The positions of people who walk to and fro on the robot's way: (n, people, 2) metres."""
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
    distinct = np.concatenate([[True], np.diff(way) > 0])
    found = []
    for _ in range(PEOPLE):
        phase, speed, far, side = chance.uniform(
            (0, PACE / 3, AWAY / 2, 0), (math.tau, PACE, AWAY, math.tau)
        )
        at = np.clip(way + far * np.sin(times * speed / far + phase), 0, way[-1])
        beside = NEAR * np.array([math.cos(side), math.sin(side)])
        found.append(
            beside
            + np.stack([np.interp(at, way[distinct], c[distinct]) for c in poses.T[:2]], axis=1)
        )
    return np.stack(found, axis=1)


def walls_seen(segments: Array, pose: Array, reach: float, bearings: Array = BEARINGS) -> Array:
    """The distances in metres to walls along beams, which are at `bearings` radians."""
    low, high = (np.minimum, np.maximum)
    ends, others = segments[:, :2], segments[:, 2:]
    near = (low(ends, others) <= pose[:2] + reach) & (high(ends, others) >= pose[:2] - reach)
    found = meetings(segments[near.all(axis=1)], pose[None], bearings)
    return np.asarray(found.min(axis=2, initial=np.inf)[0])


def circles(
    people: Array,
    pose: Array,
    bearings: Array = BEARINGS,
    radii: Array | float = RADIUS,
    nearest: float = NEAR,
) -> Array:
    """The distances in metres to people along beams. They step aside for the robot."""
    off = people - pose[:2]
    off *= np.maximum(1.0, nearest / np.maximum(np.hypot(*off.T), 1e-9))[:, None]
    beams = np.stack([np.cos(bearings + pose[2]), np.sin(bearings + pose[2])])
    along = off @ beams
    square = (np.square(radii) - (off**2).sum(axis=1))[:, None] + along**2
    hit = (square > 0) & (along > 0)
    ranges = np.where(hit, along - np.sqrt(np.maximum(square, 0)), np.inf)
    return np.asarray(ranges.min(axis=0, initial=np.inf))


def drift_of(headings: Array, truth: Array) -> float:
    """The largest error of a heading relative to the first one, in degrees."""
    off = np.unwrap(headings - truth)
    return math.degrees(np.abs(off - off[0]).max())


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("plans", nargs="+", type=Path, metavar="PLAN")
    parser.add_argument("--seeds", type=seeds_from, default=seeds_from("1-2"), metavar="A-B")
    parser.add_argument("--joins", action="store_true", help="map the logs, and count joins")
    options = parser.parse_args()
    print(
        "| drive | scans | m | drift of odometry | drift | cuts | import | visits | closures "
        "| pairs: right of joined | found of true | notes |\n" + 12 * "|---" + "|"
    )
    for plan, seed, rate, reach in product(options.plans, options.seeds, RATES, REACHES.values()):
        print(row(drive(plan, seed, rate, reach), options.joins), flush=True)


def row(log: RobotLog, joins: bool) -> str:
    """Import a log, and make its row of the table."""
    begin, notes = time.process_time(), list[str]()
    imported = import_log(log, tell=notes.append)
    share = (time.process_time() - begin) / log.scans[-1].time
    truth = np.array([scan.corrected for scan in log.scans])
    way = float(np.hypot(*np.diff(truth[:, :2], axis=0).T).sum())
    drift = drift_of(imported.track.poses[:, 2], truth[:, 2])
    wheels = drift_of(log.odometry[:, 2], truth[:, 2])
    pairs = {"joined": 0, "right": 0, "true": 0, "found": 0}
    if joins:
        maps = map_log(log, time_limit=30).solution.maps
        pairs = counts_of(imported.trace, maps[0] if maps else None, truth)["visit_pairs"]
    cells = [
        log.source,
        len(log),
        f"{way:.0f}",
        f"{wheels:.1f}",
        f"{drift:.1f}",
        len(imported.track.cuts),
        f"1/{1 / share:.0f}",
        len(imported.visits),
        len(imported.trace.closures),
        f"{pairs['right']} of {pairs['joined']}",
        f"{pairs['found']} of {pairs['true']}",
        " ".join(notes)[:200],
    ]
    return "| " + " | ".join(map(str, cells)) + " |"


if __name__ == "__main__":
    main()
