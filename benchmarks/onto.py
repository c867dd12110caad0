"""What does it cost to add a drive to an existing map?

    python benchmarks/onto.py [--cells 5] [--steps 100] [--drives 20] [--seeds 3] [--looks 8]
    python benchmarks/onto.py --displacements [--cells 6] [--steps 100] [--drives 20] [--seeds 3]

Robots walk at random through a maze, each from an unknown start. The first drive is solved alone.
Each later one is added to the existing map. The script prints a row for each maze: the CPU
seconds of the second and the last drive, their ratio, and whether the last map is the true one.

Without displacements, each cell has one of some looks. With them, the stars alone are seen.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from truth import NOISE, Known, Noise, partition, random_walk

from ssh_abduction import SSHMap, Theory, solve
from ssh_abduction.data import Odometry
from ssh_abduction.data.errors import SolverError


def walks(
    cells: int, steps: int, drives: int, seed: int, looks: int | None = None
) -> Iterator[Known]:
    """Yield random walks through one maze.

    Args:
        cells: Width and height of the maze.
        steps: Steps of a drive.
        drives: The number of drives.
        seed: Seed of the maze and of all walks.
        looks: Each cell has one of this many looks, and there are no displacements. If None, there
            are displacements.
    """
    noise = Noise(Odometry(**NOISE))
    rng = np.random.default_rng(seed)
    look = rng.integers(looks or 1, size=(cells, cells))
    for drive in range(drives):
        walk = random_walk(cells, steps, seed, noise, drive)
        trace = walk.trace
        if looks is not None:
            views = [
                f"{step.view} {look[place]}"
                for step, place in zip(trace.steps, walk.places, strict=True)
            ]
            trace = trace.without_displacements().with_views(views)
        trace = replace(trace, name=f"drive {drive + 1}")
        yield Known(walk.name, trace, walk.dstates, walk.places)


def costs(known: list[Known], theory: Theory, limit: float) -> tuple[list[float], SSHMap]:
    """Add drives one by one to the map of the first one.

    Returns:
        The CPU seconds of each drive, and the last map.

    Raises:
        SolverError: A drive contradicts the map of those before.
    """
    seconds = []
    solution = None
    for walk in known:
        start = time.process_time()
        solution = solve(walk.trace, theory, onto=solution, max_maps=1, time_limit=limit)
        seconds.append(time.process_time() - start)
    assert solution is not None
    return seconds, solution.maps[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    numbers = {"cells": 5, "steps": 100, "drives": 20, "seeds": 3, "first": 0, "looks": 8}
    for name, default in numbers.items():
        parser.add_argument(f"--{name}", type=int, default=default, metavar="N")
    parser.add_argument("--displacements", action="store_true", help="give displacements, no looks")
    parser.add_argument("--limit", type=float, default=60, metavar="S", help="seconds per drive")
    options = parser.parse_args()
    print("| maze | dstates | second drive, s | last drive, s | ratio | true |")
    print("|---|--:|--:|--:|--:|---|")
    for seed in range(options.first, options.first + options.seeds):
        looks = None if options.displacements else options.looks
        known = list(walks(options.cells, options.steps, options.drives, seed, looks))
        try:
            seconds, ssh_map = costs(known, Theory(), options.limit)
        except SolverError as error:
            print(f"| {known[0].name} | – | – | – | – | {error} |", flush=True)
            continue
        truth = [state for walk in known for state in walk.dstates]
        right = partition(truth) == partition(ssh_map.dstate_at)
        print(
            f"| {known[0].name} | {len(ssh_map.dstates)} | {seconds[1]:.2f} | {seconds[-1]:.2f} | "
            f"{seconds[-1] / seconds[1]:.1f} | {'yes' if right else 'no'} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
