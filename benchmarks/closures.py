"""What closures are worth on logs, and whether the covariances of the track are right.

    python benchmarks/closures.py LOG ... [--drift 0.0003]

The first table compares the best hypotheses of the beam for the trace of each log, with and without
its closures. The beam has no time limit, so the machine does not matter. The second table has
normalised innovations of the track: the square of its error over a stretch, divided by its
covariance and by 3. If covariances are right, their mean is 1. The errors of the true or corrected
poses count with `--sigma`.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from courses import counts_of
from logs import name_of, sidecar
from threadpoolctl import threadpool_limits
from visited import truth_of

from perception.places.closures import uncertainty
from perception.places.importing import Imported, import_log
from perception.places.track import Track
from perception.readers.logs import read_log
from ssh_abduction import SSHMap, Trace
from ssh_abduction.data.odometry import Odometry, Pose, displacement_between
from ssh_abduction.robot_logs.log_maps import BARE
from ssh_abduction.solver.sources.metric.beam import Beam
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.settle import settle

# The width of the beam, and the lengths of the stretches in metres.
WIDTH, LENGTHS = 16, (3, 10, 30, 100)
HEAD = (
    "| log | closures | without: right of joined | found of true | with: right of joined | "
    "found of true |",
    "|---|---|---|---|---|---|",
)
HEAD_OF_TRACKS = (
    f"| track | {' | '.join(f'{length} m: mean, median' for length in LENGTHS)} |",
    f"|---|{'---|' * len(LENGTHS)}",
)


def best_of(trace: Trace) -> SSHMap | None:
    """Return the first map of the beam; None if it has none."""
    problem = settle(trace, BARE)
    beam = Beam(problem, Log(trace, problem.theory, problem.pairs), WIDTH)
    with threadpool_limits(1, user_api="blas"):  # more threads only wait for each other
        return next(beam.maps(), None)


def pairs_of(log: Path, trace: Trace, drift: float | None) -> Iterator[dict[str, int]]:
    """Count the pairs of visits without closures, and with them.

    Args:
        log: The log.
        trace: Its trace.
        drift: Standard deviation of the drift without closures; None for that of the trace.
    """
    poses, odometry = truth_of(log, sidecar(log)).poses, trace.odometry or Odometry()
    before = odometry if drift is None else replace(odometry, bend=drift)
    for tried in (replace(trace, closures=(), odometry=before), trace):
        yield counts_of(tried, best_of(tried), poses)["visit_pairs"]


def innovations(track: Track, poses: list[Pose], length: float, sigma: float) -> list[float]:
    """Compute the normalised innovations of stretches of a track that begin every half length."""
    noise = np.diag([sigma, sigma, sigma / 5]) ** 2 * 2 + np.diag([0.02, 0.02, 0.002]) ** 2
    found, way, begin = [], track.way, 0
    while (end := int(np.searchsorted(way, way[begin] + length))) < len(poses):
        x, y, heading = track.poses[begin]
        off = np.subtract(
            displacement_between((x, y, heading), tuple(track.poses[end])),
            displacement_between(poses[begin], poses[end]),
        )
        off[2] = math.remainder(off[2], math.tau)
        cos, sin = math.cos(heading), math.sin(heading)
        back = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
        spread = back @ uncertainty(track, begin, end, track.poses[end, :2]) @ back.T + noise
        if not track.cuts_between(begin, end):
            found.append(float(off @ np.linalg.solve(spread, off)) / 3)
        begin = int(np.searchsorted(way, way[begin] + max(length / 2, 1.5)))
    return found


def track_line(name: str, imported: Imported, poses: list[Pose], sigma: float) -> str:
    cells = [name]
    for length in LENGTHS:
        found = innovations(imported.track, poses, length, sigma)
        known = len(found) > 1
        cells.append(f"{np.mean(found):.2f}, {np.median(found):.2f}" if known else "–")
    return f"| {' | '.join(cells)} |"


def pairs_line(name: str, closures: int, sides: list[dict[str, int]]) -> str:
    cells: list[Any] = [name, closures]
    for side in sides:
        cells += [f"{side['right']} of {side['joined']}", f"{side['found']} of {side['true']}"]
    return f"| {' | '.join(map(str, cells))} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("logs", nargs="+", type=Path, help="logs with corrected or true poses")
    parser.add_argument("--drift", type=float, help="drift in radians per metre without closures")
    parser.add_argument(
        "--sigma", type=float, default=0.03, help="error of corrected poses in metres"
    )
    options = parser.parse_args()
    rows, tracks, whole, closures = [*HEAD], [*HEAD_OF_TRACKS], [{}, {}], 0
    for log in options.logs:
        imported, name = import_log(read_log(str(log))), name_of(log)
        poses = [tuple(pose) for pose in truth_of(log, sidecar(log)).poses.tolist()]
        sigma = 0.0 if sidecar(log) else options.sigma
        tracks.append(track_line(name, imported, poses, sigma))
        sides = list(pairs_of(log, imported.trace, options.drift))
        for total, side in zip(whole, sides, strict=True):
            total.update({key: total.get(key, 0) + number for key, number in side.items()})
        closures += len(imported.trace.closures)
        rows.append(pairs_line(name, len(imported.trace.closures), sides))
    rows.append(pairs_line("**all**", closures, whole))
    print(*rows, "", *tracks, sep="\n")


if __name__ == "__main__":
    main()
