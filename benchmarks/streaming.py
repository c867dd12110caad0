"""How long does it take to find the places of a long drive, and how much memory?

    python benchmarks/streaming.py [KILOMETRES ...] [--seed 1] [--file]

A robot drives at random through a grid of corridors, and its scans are given to `import_live` one
at a time. With --file, a CARMEN log of the drive is read and given to `import_log` instead. The
script prints a table in Markdown. The time is the CPU time without the simulation: of the track
with the places, of the trace with its closures, and of the views. The ratio is that of
the time of the drive to the time of the whole import. The robot drives SPEED metres per second.
Memory is the growth of the largest resident set since the imports, so each drive has a process of
its own. The delay is in metres from the end of a visit, by the odometer, until it is final.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import resource
import tempfile
from collections.abc import Iterator
from pathlib import Path
from time import process_time

import numpy as np
from numpy.typing import NDArray

from perception.places.importing import import_log
from perception.places.live import import_live
from perception.readers.logs import read_log
from perception.readers.scans import LaserScanner, Scan
from perception.readers.writers import write_carmen
from simulator.robot import BEARINGS, Odometer, meetings

Array = NDArray[np.float64]

# Metres a second, and metres and radians between scans.
SPEED, STEP, TURN = 0.5, 0.25, math.radians(15)
# The corridors are WIDE metres wide and APART metres apart, with CROSSINGS crossings to each side.
WIDE, APART, CROSSINGS = 2.0, 12.0, 12
# Reach of the laser and standard deviation of its ranges, in metres; scans to simulate at once.
REACH, NOISE, BATCH = 8.0, 0.005, 20


def walls() -> Array:
    """The walls of the blocks between the corridors: (n, 4) metres."""
    found = []
    for column in range(-1, CROSSINGS):
        for row in range(-1, CROSSINGS):
            left, low = column * APART + WIDE / 2, row * APART + WIDE / 2
            right, high = left + APART - WIDE, low + APART - WIDE
            found += [(left, low, right, low), (right, low, right, high)]
            found += [(right, high, left, high), (left, high, left, low)]
    return np.array(found)


def drive(metres: float, rng: np.random.Generator) -> Array:
    """The poses at the scans of a drive from crossing to crossing: (n, 3) metres and radians."""
    at, heading, poses = np.array([CROSSINGS // 2] * 2), 0, []
    ahead = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])
    for _ in range(math.ceil(metres / APART)):
        onward = [
            turn
            for turn in (-1, 0, 1)
            if ((way := at + ahead[(heading + turn) % 4]) >= 0).all() and (way < CROSSINGS).all()
        ]
        turn = int(rng.choice(onward))
        steps = range(1, round(abs(turn) * math.pi / 2 / TURN) + 1)
        poses += [(*(at * APART), heading * math.pi / 2 + turn * k * TURN) for k in steps]
        heading += turn
        way = ahead[heading % 4]
        along = np.arange(0.0, APART, STEP)
        poses += [(*(at * APART + far * way), heading * math.pi / 2) for far in along]
        at = at + way
    return np.array(poses)


class Drive:
    """Simulates the scans of a drive, and counts the time that this takes.

    Attributes:
        seconds: CPU time of the simulation.
        way: Metres driven up to each scan.
        given: Index of the last scan that was given.
    """

    def __init__(self, metres: float, seed: int) -> None:
        """Plan the drive."""
        self._rng = np.random.default_rng(seed)
        self._walls, self._poses = walls(), drive(metres, self._rng)
        self._odometry = Odometer().reading(self._poses, self._rng)
        self.way = np.concatenate(
            [[0.0], np.cumsum(np.hypot(*np.diff(self._poses[:, :2], axis=0).T))]
        )
        self.seconds, self.given = 0.0, 0

    def scans(self) -> Iterator[Scan]:
        """Yield the scans."""
        laser = LaserScanner(float(BEARINGS[0]), math.radians(1), len(BEARINGS), REACH)
        for begin in range(0, len(self._poses), BATCH):
            start = process_time()
            ranges = self._ranges(self._poses[begin : begin + BATCH])
            self.seconds += process_time() - start
            for k, row in enumerate(ranges, begin):
                self.given = k
                x, y, heading = self._odometry[k].tolist()
                yield Scan(row, laser, (x, y, heading))

    def _ranges(self, poses: Array) -> Array:
        low, high = poses[:, :2].min(0) - REACH, poses[:, :2].max(0) + REACH
        ends = self._walls.reshape(-1, 2, 2)
        near = (ends.min(1) <= high).all(1) & (ends.max(1) >= low).all(1)
        found = meetings(self._walls[near], poses, BEARINGS).min(axis=2)
        found += self._rng.normal(0, NOISE, found.shape)
        return np.where(found < REACH, found, np.inf)


def row_of(task: tuple[float, int]) -> str:
    """Measure a drive of some kilometres with a seed, and make a row of the table."""
    kilometres, seed = task
    import_live(Drive(60, seed).scans())  # imports
    planned = Drive(1000 * kilometres, seed)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    late: list[float] = []
    start = process_time()
    _, done = import_live(
        planned.scans(),
        show=lambda visit: late.append(planned.way[planned.given] - planned.way[visit.end]),
    )
    seconds = process_time() - start - planned.seconds
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    driven = planned.way[-1] / SPEED
    places = done.seconds["places"] - planned.seconds
    return (
        f"| {kilometres:g} | {len(planned.way)} | {len(late)} | {len(done.trace.closures)} | "
        f"{places:.0f} + {done.seconds['trace']:.0f} + {done.seconds['views']:.0f} | "
        f"{driven:.0f} | 1/{driven / seconds:.0f} | {np.median(late):.0f}, {max(late):.0f} | "
        f"{grown:.0f} |"
    )


def written(task: tuple[float, int]) -> str:
    """Write the CARMEN log of a drive of some kilometres with a seed, and return its path."""
    kilometres, seed = task
    path = Path(tempfile.gettempdir()) / f"drive-{kilometres:g}-{seed}.log"
    write_carmen(path, Drive(1000 * kilometres, seed).scans())
    return str(path)


def row_of_file(task: tuple[float, str, str]) -> str:
    """Measure the import of a log of some kilometres, after that of a short log."""
    kilometres, short, path = task
    import_log(read_log(short))  # imports
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = process_time()
    log = read_log(path)
    read = process_time() - start
    done = import_log(log)
    seconds = process_time() - start
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    driven = float(np.hypot(*np.diff(log.odometry[:, :2], axis=0).T).sum()) / SPEED
    places = done.seconds["track"] + done.seconds["places"]
    return (
        f"| {kilometres:g} | {len(log)} | {len(done.visits)} | {len(done.trace.closures)} | "
        f"{read:.0f} + {places:.0f} + {done.seconds['trace']:.0f} + {done.seconds['views']:.0f} | "
        f"{driven:.0f} | 1/{driven / seconds:.0f} | {grown:.0f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("kilometres", nargs="*", type=float, default=[1, 10])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--file", action="store_true", help="import the log of each drive")
    args = parser.parse_args()
    tasks = [(kilometres, args.seed) for kilometres in args.kilometres]
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        if args.file:
            print(
                "| km | scans | visits | closures | CPU s: reading, places, trace, views | "
                "driven s | ratio | MiB |\n|---|---|---|---|---|---|---|---|"
            )
            short = pool.apply(written, [(0.06, args.seed)])
            for task in tasks:
                path = pool.apply(written, [task])
                print(pool.apply(row_of_file, [(task[0], short, path)]), flush=True)
                Path(path).unlink()
            Path(short).unlink()
            return
        print(
            "| km | scans | visits | closures | CPU s: places, trace, views | driven s | ratio | "
            "delay in m: median, largest | MiB |\n|---|---|---|---|---|---|---|---|---|"
        )
        for row in pool.imap(row_of, tasks):
            print(row, flush=True)


if __name__ == "__main__":
    main()
