"""Solving time with and without knowledge of which pairs of steps are at different places.

    python benchmarks/exclusions.py [--cells 6] [--steps 400] [--apart 3] [--seeds 5] [--limit S]

Each maze with stars is solved twice in one run: without and with exclusions. An exclusion is a pair
of steps that cannot be at one place. Here, all pairs are excluded whose true cells are more than
--apart cells from each other. The last column is the time without exclusions divided by the time
with them.
"""

from __future__ import annotations

import argparse
import statistics
import time
from itertools import combinations

from instances import Walk, maze

from ssh_abduction import Solution, Theory, solve


def far(walk: Walk, apart: int) -> list[tuple[int, int]]:
    """List the pairs of steps whose cells are more than `apart` cells from each other.

    The distance is the Manhattan distance.
    """
    cells = [(state[0], state[1]) for state in walk.truth if isinstance(state, tuple)]
    pairs = combinations(range(len(cells)), 2)
    return [
        (i, j)
        for i, j in pairs
        if abs(cells[i][0] - cells[j][0]) + abs(cells[i][1] - cells[j][1]) > apart
    ]


def timed(walk: Walk, theory: Theory, limit: float) -> tuple[float, Solution]:
    """Find one minimal map; return the seconds that it took, and the solution."""
    began = time.perf_counter()
    solution = solve(walk.trace, theory, max_maps=1, time_limit=limit)
    return time.perf_counter() - began, solution


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--cells", type=int, default=6, metavar="N", help="mazes of N x N cells (default 6)"
    )
    parser.add_argument(
        "--steps", type=int, default=400, metavar="N", help="actions of the robot (default 400)"
    )
    parser.add_argument(
        "--apart",
        type=int,
        default=3,
        metavar="N",
        help="exclude pairs of steps that are more than N cells apart (default 3)",
    )
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="mazes (default 5)")
    parser.add_argument(
        "--limit", type=float, default=60, metavar="S", help="seconds for each (default 60)"
    )
    options = parser.parse_args()
    print(
        "| seed | excluded pairs | without: dstates, s | with: dstates, s | truth | "
        "without / with |\n|---|---|---|---|---|---|"
    )
    ratios = []
    for seed in range(options.seeds):
        walk = maze(options.cells, options.cells, steps=options.steps, seed=seed, stars=True)
        pairs = far(walk, options.apart)
        plain, without = timed(walk, Theory.topological(), options.limit)
        excluding, found = timed(walk, Theory.topological().replace(elsewhere=pairs), options.limit)
        ratios.append(plain / excluding)
        cells = [
            f"{s.cost.dstates if s.cost else '–'} ({s.status.value}), {t:.2f}"
            for s, t in ((without, plain), (found, excluding))
        ]
        print(
            f"| {seed} | {len(pairs):,} | {cells[0]} | {cells[1]} | "
            f"{len(set(walk.truth))} | {plain / excluding:.2f} |",
            flush=True,
        )
    print(f"\nmedian: {statistics.median(ratios):.2f}")


if __name__ == "__main__":
    main()
