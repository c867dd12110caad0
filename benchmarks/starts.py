"""Does a robot that is switched on in a known building soon know where it is?

    python benchmarks/starts.py PLAN|LOG ... [--seed 1] [--starts 10] [--metres 40] [--other PLAN]

A robot drives 300 m through a floor plan, which gives the known map. Then it is switched on at
random points of a second drive of 200 m, with new odometry. Of a log with corrected poses, the
first half is the known map, and the second half is the second drive. All starts are at most 1 m
from the known drive, and the next 15 m at most 2 m. The script counts the starts after which the
robot was located within 15 m, within METRES, and wrongly: by more than 1 m or 10 degrees, relative
to the nearest known visit. With `--other`, the second drive is through another building, so each
start that was located is wrong.
"""

from __future__ import annotations

import argparse
import copy
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from perception.readers.logs import read_log
from perception.readers.scans import Scan
from simulator.plans import Plan
from simulator.rounds import record_plan
from ssh_abduction.cli.simulate import scans_of
from ssh_abduction.data.odometry import Pose, displacement_between, moved
from ssh_abduction.robot_logs.log_mapper import FoundMap, OnlineLogMapper, solved

KNOWN, SECOND, NEAR, BESIDE, SOON = 300.0, 200.0, 1.0, 2.0, 15.0
FAR, TURNED = 1.0, 10.0
WORK = 2.0  # units for the known map
ELSEWHERE = (3.0, -5.0, 2.0)  # where the odometry of a start begins


def drives_of(path: Path, seed: int) -> tuple[list[Scan], list[Scan]]:
    """The scans of the known drive and of the second one, with true poses."""
    if path.suffix == ".xml":
        plan = Plan.load(path)
        drives = [
            record_plan(plan, seed=seed, metres=KNOWN),
            record_plan(plan, seed=1000 + seed, metres=SECOND),
        ]
        known, second = (
            [
                replace(scan, corrected=tuple(pose))
                for scan, pose in zip(scans_of(drive), drive.poses.tolist(), strict=True)
            ]
            for drive in drives
        )
        return known, second
    scans = list(read_log(str(path)).scans)
    return scans[: len(scans) // 2], scans[len(scans) // 2 :]


def nearest(of: Sequence[Scan], pose: Pose) -> int:
    """The index of the scan whose true position is nearest."""
    return min(range(len(of)), key=lambda k: math.dist(of[k].corrected[:2], pose[:2]))


def expected(pose: Pose, known: Sequence[Scan], found: FoundMap, track: Sequence[Pose]) -> Pose:
    """Where the map has a true pose, by the nearest visit of the known drive."""
    visit = nearest([known[scan] for scan in found.scans], pose)
    scan, (x, y, turn) = found.scans[visit], found.poses[visit].tolist()
    beside = displacement_between((*found.middles[visit].tolist(), 0.0), track[scan])
    at = moved((x, y, turn), beside)
    return moved(at, displacement_between(known[scan].corrected, pose))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("drives", nargs="+", type=Path, metavar="PLAN|LOG")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--starts", type=int, default=10, metavar="N")
    parser.add_argument("--metres", type=float, default=40.0)
    parser.add_argument("--other", type=Path, metavar="PLAN")
    options = parser.parse_args()
    print("| drive | starts | within 15 m | within all | wrong | metres, median | CPU s |")
    print("|---|---|---|---|---|---|---|")
    for path in options.drives:
        known, second = drives_of(path, options.seed)
        if options.other:
            second = drives_of(options.other, options.seed)[1]
        mapper = OnlineLogMapper()
        track = [mapper.observe(scan).pose for scan in known]
        found = solved(mapper.task(WORK))
        assert found is not None
        mapper.accept(found)
        ways = np.cumsum(
            [0.0, *(math.dist(a.corrected[:2], b.corrected[:2]) for a, b in pairwise(second))]
        )
        seen = cKDTree([scan.corrected[:2] for scan in known])
        aside = seen.query([scan.corrected[:2] for scan in second])[0]
        near = [
            k
            for k in range(len(second))
            if ways[-1] - ways[k] > options.metres
            and (options.other or aside[k] < NEAR)
            and (options.other or max(aside[k : np.searchsorted(ways, ways[k] + SOON)]) < BESIDE)
        ]
        chance, begin = np.random.default_rng(options.seed), time.process_time()
        starts = chance.choice(near, min(options.starts, len(near)), replace=False).tolist()
        located, wrong = list[float](), 0
        for start in starts:
            one = copy.deepcopy(mapper)
            one.lift()
            for k in range(start, len(second)):
                if (way := float(ways[k] - ways[start])) > options.metres:
                    break
                onward = displacement_between(second[start].odometry, second[k].odometry)
                seen = one.observe(replace(second[k], odometry=moved(ELSEWHERE, onward)))
                if seen.on_map is not None:
                    right = expected(second[k].corrected, known, found, track)
                    off = math.dist(seen.on_map[:2], right[:2])
                    turned = math.degrees(math.remainder(seen.on_map[2] - right[2], math.tau))
                    located.append(way)
                    if options.other or off > FAR or abs(turned) > TURNED:
                        wrong += 1
                        print(f"{path.stem}, scan {k}: off {off:.1f} m, {turned:.0f} degrees")
                    break
        print(
            f"| {path.stem} | {len(starts)} | {sum(way <= SOON for way in located)} "
            f"| {len(located)} | {wrong} | {np.median(located) if located else math.nan:.0f} "
            f"| {time.process_time() - begin:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
