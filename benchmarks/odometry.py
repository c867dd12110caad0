"""Does the noise that a simulated trace gives for its odometry fit the errors of displacements?

    python benchmarks/odometry.py [--seeds 4] [--tours 10] [--worlds notched-rectangle taylor-hall]

The script prints a table in Markdown. Errors are in standard deviations of the trace's odometry, so
their mean should be near 0 and their mean square near 1. Displacements are compared with the motion
between true poses, and with the motion between fixed points. A fixed point is the mean of all
positions at a place, with the mean of all headings at a dstate.
"""

from __future__ import annotations

import argparse
import math
from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from simulator.motion import Pose, between
from simulator.tours import simulate
from simulator.world import World
from ssh_abduction import Trace


def true_poses(trace: Trace) -> list[Pose]:
    return [tuple(step.truth["pose"]) for step in trace.steps]


def fixed_points(trace: Trace) -> list[Pose]:
    """Compute for each step the mean position at its place, and the mean heading at its dstate."""
    positions: dict[str, list[Sequence[float]]] = defaultdict(list)
    headings: dict[str, list[float]] = defaultdict(list)
    for step in trace.steps:
        positions[step.truth["place"]].append(step.truth["pose"][:2])
        headings[step.truth["dstate"]].append(step.truth["pose"][2])
    middle = {place: np.mean(found, axis=0) for place, found in positions.items()}
    ahead = {
        dstate: math.atan2(np.mean(np.sin(found)), np.mean(np.cos(found)))
        for dstate, found in headings.items()
    }
    return [
        (*map(float, middle[step.truth["place"]]), ahead[step.truth["dstate"]])
        for step in trace.steps
    ]


def errors(trace: Trace, poses: Sequence[Pose], kind: str) -> list[NDArray[np.float64]]:
    """Compute the errors of the displacements of one kind of action.

    Args:
        trace: The trace.
        poses: Pose of each step.
        kind: "travel" or "turn".

    Returns:
        For each displacement the error ahead, to the left and in heading, in standard deviations,
        (3,).
    """
    found = []
    for i, action in enumerate(trace.actions):
        displacement = trace.steps[i + 1].displacement
        if action.kind == kind and displacement is not None:
            dx, dy, turned = np.subtract(displacement, between(poses[i], poses[i + 1]))
            root = np.linalg.cholesky(np.array(trace.covariance(i + 1)))
            found.append(np.linalg.solve(root, [dx, dy, math.remainder(turned, math.tau)]))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--seeds", type=int, default=4, metavar="N", help="drives through each world (default 4)"
    )
    parser.add_argument(
        "--tours", type=int, default=10, metavar="N", help="tours of each drive (default 10)"
    )
    parser.add_argument(
        "--worlds",
        nargs="+",
        default=["notched-rectangle", "taylor-hall"],
        metavar="NAME",
        help="which worlds",
    )
    options = parser.parse_args()
    print(
        "| world | action | against | displacements | mean: ahead, left, heading | "
        "mean square: ahead, left, heading |\n|---|---|---|---|---|---|"
    )
    for world in options.worlds:
        traces = [
            simulate(World.named(world), options.tours, seed) for seed in range(options.seeds)
        ]
        for kind in ("travel", "turn"):
            for name, poses in (("true poses", true_poses), ("fixed points", fixed_points)):
                found = np.array(
                    [error for trace in traces for error in errors(trace, poses(trace), kind)]
                )
                mean, square = (
                    ", ".join(f"{v:.2f}" for v in values)
                    for values in (found.mean(0), (found**2).mean(0))
                )
                print(
                    f"| {world} | {kind} | {name} | {len(found)} | {mean} | {square} |", flush=True
                )


if __name__ == "__main__":
    main()
