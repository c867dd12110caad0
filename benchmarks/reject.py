"""How often displacements refuse a true map: routes through mazes with the default odometry noise.

    python benchmarks/reject.py [--routes 1000] [--cells 4] [--steps 40] [--first 0]

The table has a row for each value of `reject`, the highest probability with which a true map is
rejected. It gives the share of routes whose true map is rejected. In the first column of shares,
the noise is white, and the model has no systematic errors. In the second one, there are also an
error of scale and a drift of the heading. They are drawn for each route with the standard
deviations of the model.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from arguments import add_number
from instances import Walk, maze

from ssh_abduction import SSHMap, Theory
from ssh_abduction.checker.displacements import refused_returns
from ssh_abduction.data import DState, Odometry
from ssh_abduction.theory.settle import settle

REJECTS = (0.5, 0.2, 0.05, 0.01, 0.001)
MODEL = Odometry()


def true_map(walk: Walk) -> SSHMap:
    """Make the true map of a walk with dstates and places, which displacements are checked by."""
    number: dict[object, int] = {}
    labels = tuple(number.setdefault(state, len(number)) for state in walk.truth)
    places: dict[object, int] = {}
    at = [places.setdefault(state[:2], len(places)) for state in number if isinstance(state, tuple)]
    return SSHMap(labels, tuple(DState(i, "", place) for i, place in enumerate(at)), ())


def walks(cells: int, steps: int, seed: int) -> Iterator[Walk]:
    """Yield the route of one seed twice: with white noise, and with systematic errors, too."""
    rng = np.random.default_rng(seed)
    scale, bend = rng.normal(0.0, MODEL.scale), rng.normal(0.0, MODEL.bend)
    white = replace(MODEL, scale=0.0, bend=0.0)
    yield maze(cells, cells, steps=steps, seed=seed, follow=True, odometry=white)
    yield maze(
        cells, cells, steps=steps, seed=seed, follow=True, odometry=MODEL, scale=scale, bend=bend
    )


def is_refused(walk: Walk, reject: float) -> bool:
    theory = settle(walk.trace, Theory(displacement="use", reject=reject)).theory
    return any(refused_returns(walk.trace, true_map(walk), theory))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    add_number(parser, "--routes", "N", 1000, "routes")
    add_number(parser, "--first", "SEED", 0, "the first seed")
    add_number(parser, "--cells", "N", 4, "mazes of N x N cells")
    add_number(parser, "--steps", "N", 40, "actions of the robot")
    options = parser.parse_args()
    refused = np.zeros((len(REJECTS), 2), dtype=int)
    for seed in range(options.first, options.first + options.routes):
        for column, walk in enumerate(walks(options.cells, options.steps, seed)):
            for line, reject in enumerate(REJECTS):
                if not is_refused(walk, reject):  # Smaller values of `reject` also accept the map.
                    break
                refused[line, column] += 1
    print(
        f"| `reject` | white noise only | with {100 * MODEL.scale:g} % scale and "
        f"{np.degrees(MODEL.bend):.1g} degrees per metre |\n|---|---|---|"
    )
    for reject, counts in zip(REJECTS, refused / options.routes, strict=True):
        print(f"| {reject:g} | {counts[0]:.3f} | {counts[1]:.3f} |")


if __name__ == "__main__":
    main()
