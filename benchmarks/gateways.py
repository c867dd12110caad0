"""Stars with any number of gateways: are all minimal maps of tours along any streets right?

    python benchmarks/gateways.py [--seeds 3] [--limit S]

A star is the gateways seen at a place, with their bearings. Streets meet at any angles. A map is
right if its dstates are the true ones. Bearings have errors of up to `noise` degrees. Seconds are
CPU seconds.
"""

from __future__ import annotations

import argparse
import random
import time

import networkx as nx
import planar
from arguments import add_number

from ssh_abduction import solve


def cases(seed: int) -> list[tuple[str, nx.Graph, int, float, set[object]]]:
    """List the worlds.

    Returns:
        For each world: its name, its graph, the number of steps, the noise of bearings in degrees,
        and the places that views reveal.
    """
    rng = random.Random(seed)
    honeycomb = planar.honeycomb(1, 2)
    return [
        ("triangle", planar.triangle(), 13, 8, set()),
        ("hexagon, a landmark", planar.hexagon(), 25, 8, {0}),
        ("honeycomb, three landmarks", honeycomb, 40, 8, set(list(honeycomb)[:3])),
        ("junction of 5", planar.junction(0, 72, 144, 216, 288), 30, 8, set()),
        ("junction of 6", planar.junction(0, 60, 120, 180, 240, 300), 30, 8, set()),
        ("triangles of 2 x 2", planar.triangles(2, 2), 30, 8, set()),
        ("6 places at any angles", planar.scattered(6, rng), 60, 8, set()),
        ("7 places at any angles", planar.scattered(7, rng), 40, 8, set()),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    add_number(parser, "--seeds", "N", 3, "tours of each world")
    add_number(parser, "--limit", "S", 60.0, "seconds for each")
    options = parser.parse_args()
    print(
        "| world | steps | seed | status | dstates, places | truth | right maps | "
        "seconds |\n|---|---|---|---|---|---|---|---|"
    )
    for seed in range(options.seeds):
        for name, graph, steps, noise, landmarks in cases(seed):
            start = next(iter(graph))
            tour = planar.drive(
                graph,
                start,
                next(iter(graph[start])),
                steps,
                random.Random(seed),
                noise=noise,
                landmarks=landmarks,
            )
            began = time.process_time()
            solution = solve(tour.trace, time_limit=options.limit, max_maps=50)
            seconds = time.process_time() - began
            found = f"{solution.cost.dstates}, {solution.cost.places}" if solution.cost else "–"
            right = sum(ssh_map.labels == tour.labels for ssh_map in solution.maps)
            truth = f"{len(set(tour.labels))}, {tour.places}"
            cells = [
                name,
                steps,
                seed,
                solution.status.value,
                found,
                truth,
                f"{right} of {len(solution.maps)}",
                f"{seconds:.1f}",
            ]
            print(f"| {' | '.join(map(str, cells))} |", flush=True)


if __name__ == "__main__":
    main()
