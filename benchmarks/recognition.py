"""Measure how well a recogniser trained on the map of one drive recognises places on another drive.

    python benchmarks/recognition.py FIRST SECOND [--halves] [--time-limit S]

The first log is mapped, and a recogniser learns its dstates from parts of its images. Images of the
second log at dstates of the map are recognised. Then the localiser follows the robot through the
second log. True or corrected poses decide what is right. With --halves, FIRST is cut in two, and
SECOND is left out.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from logs import sidecar
from numpy.typing import NDArray
from visited import truth_of

from perception.places.importing import import_log
from perception.readers.logs import read_log
from perception.readers.scans import RobotLog
from perception.recognition import recogniser
from ssh_abduction import Localiser
from ssh_abduction.data.trace import Trace
from ssh_abduction.online.localiser import BeliefVerdict
from ssh_abduction.robot_logs.log_maps import FLOOR, LogMap, map_log, recogniser_of

# A dstate is within NEAR metres and TURNED radians of an image that shows it.
NEAR, TURNED = 2.0, math.radians(45)
SHARES = (0.25, 0.5, 0.75, 1.0)


def poses_of(trace: Trace) -> NDArray[np.float64]:
    """The corrected pose of each step, (n, 3)."""
    return np.array([step.truth["pose"] for step in trace.steps if step.truth])


def is_near(pose: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Mask of the poses that are at one dstate with a pose."""
    turned = (others[:, 2] - pose[2] + math.pi) % math.tau - math.pi
    return (np.hypot(*(others[:, :2] - pose[:2]).T) <= NEAR) & (np.abs(turned) <= TURNED)


def recognised(
    learnt: Trace, labels: NDArray[np.intp], asked: Trace, chance: np.random.Generator
) -> list[tuple[int, int, int]]:
    """Count for each share of the learnt images: learnt images, asked images, recognised ones."""
    poses, others = poses_of(learnt), poses_of(asked)
    images = np.array([step.image for step in learnt.steps])
    new = np.array([step.image for step in asked.steps])
    counts = []
    for share in SHARES:
        some = np.sort(chance.permutation(len(images))[: max(2, round(share * len(images)))])
        found = recogniser(FLOOR).fit(images[some], labels[some]).predict(new)
        known = [is_near(pose, poses).any() for pose in others]
        right = [
            is_near(pose, poses[labels == label]).any()
            for pose, label in zip(others, found, strict=True)
        ]
        counts.append((len(some), sum(known), sum(np.array(known) & np.array(right))))
    return counts


def localised(done: LogMap, asked: Trace) -> dict[str, int]:
    """Count the steps of another drive where a localiser is sure, and where it is right."""
    ssh_map, trace = done.solution.maps[0], done.imported.trace
    labels, poses, others = np.array(ssh_map.dstate_at), poses_of(trace), poses_of(asked)
    localiser = Localiser(ssh_map, recogniser_of(trace, ssh_map), trace=trace)
    counts = dict.fromkeys(("steps", "at learnt dstates", "located", "located and right"), 0)
    for belief, pose in zip(localiser.beliefs(asked), others, strict=True):
        located = belief.verdict is BeliefVerdict.LOCATED
        counts["steps"] += 1
        counts["at learnt dstates"] += bool(is_near(pose, poses).any())
        counts["located"] += located
        counts["located and right"] += located and bool(
            is_near(pose, poses[labels == belief.likeliest]).any()
        )
    return counts


def read(log: Path) -> RobotLog:
    """Read a log. Its poses by the simulator become the corrected ones."""
    found, truth = read_log(log), sidecar(log)
    if truth is None:
        return found
    poses = truth_of(log, truth).poses.tolist()
    scans = [replace(s, corrected=tuple(p)) for s, p in zip(found.scans, poses, strict=True)]
    return replace(found, scans=tuple(scans))


def halves(log: RobotLog) -> tuple[RobotLog, RobotLog]:
    middle = len(log) // 2
    return replace(log, scans=log.scans[:middle]), replace(log, scans=log.scans[middle:])


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("first", type=Path)
    parser.add_argument("second", type=Path, nargs="?")
    parser.add_argument("--halves", action="store_true")
    parser.add_argument("--time-limit", type=float, default=30.0)
    options: Any = parser.parse_args()
    first = read(options.first)
    if options.halves:
        first, second = halves(first)
    else:
        second = read(options.second)
    done = map_log(first, time_limit=options.time_limit)
    labels = np.array(done.solution.maps[0].dstate_at)
    cost = done.solution.cost
    print(f"{cost.places} places, {cost.dstates} dstates; {done.solution.status.value}")
    print("| learnt images | images at learnt dstates | recognised |\n|---|---|---|")
    asked = import_log(second).trace
    for learnt, known, right in recognised(
        done.imported.trace, labels, asked, np.random.default_rng(0)
    ):
        print(f"| {learnt} | {known} of {len(asked)} | {right} ({right / max(known, 1):.2f}) |")
    print(", ".join(f"{count} {what}" for what, count in localised(done, asked).items()))


if __name__ == "__main__":
    main()
