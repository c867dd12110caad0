"""How long a robot waits for its map at each step of a walk that explores a maze with stars.

    python benchmarks/online.py [--steps 1000] [--limit 0.5] [--size 10] [--seed 0]
                                [--drive 0.05] [--odometry tight|usual]

At an optimal step, the answer was proven minimal. At other steps, the answer was a consistent map
and a lower bound. `visited` is the number of true dstates that the robot has been at. Between two
steps, the robot drives for --drive seconds, in which the mapper guesses maps. At the checkpoints,
the trace is also solved from scratch, in at most ANEW seconds (`--anew 0` turns that off).

With --odometry, each action has a displacement, and cells are 10 m apart. The noise `tight` is 5 %
along the way, 0.5 % across it and 0.002 rad per metre, without systematic errors, as in
benchmarks/truth.py. The noise `usual` is the default of traces. `true` in the output is the share
of steps at which the first map has the true labels.
"""

from __future__ import annotations

import argparse
import time

from instances import maze

from ssh_abduction import OnlineMapper, solve
from ssh_abduction.data import Odometry
from ssh_abduction.solution import Status

CHECKPOINTS = (10, 20, 30, 40, 60, 100, 300, 1000, 4000)
ANEW = 20.0  # seconds
NOISE = {
    "tight": Odometry(
        along=0.05,
        across=0.005,
        heading=0.002,
        turning=0.0,
        position=0.0,
        angle=0.0,
        scale=0.0,
        bend=0.0,
    ),
    "usual": Odometry(),
}


def percentile(seconds: list[float], share: float) -> float:
    return sorted(seconds)[min(len(seconds) - 1, int(share * len(seconds)))]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--steps", type=int, default=1000, help="actions of the robot")
    parser.add_argument("--size", type=int, default=10, help="cells on a side of the maze")
    parser.add_argument("--limit", type=float, default=0.5, help="seconds that a step may take")
    parser.add_argument("--seed", type=int, default=0, help="seed of the maze and the walk")
    parser.add_argument("--drive", type=float, default=0.05, help="seconds between two steps")
    parser.add_argument("--odometry", choices=NOISE, help="noise of displacements")
    parser.add_argument("--anew", type=float, default=ANEW, help="seconds to solve from scratch")
    options = parser.parse_args()
    odometry = NOISE.get(options.odometry)
    walk = maze(
        options.size,
        options.size,
        steps=options.steps,
        seed=options.seed,
        stars=True,
        odometry=odometry,
    )
    trace = walk.trace
    first, *rest = trace.steps
    mapper = OnlineMapper(
        first.view or "", star=first.star, odometry=odometry, time_limit=options.limit
    )
    number: dict[object, int] = {}
    truth = tuple(number.setdefault(state, len(number)) for state in walk.truth)
    seconds: list[float] = []
    optimal = complete = true = 0
    sizes: list[float] = []
    print(
        f"{'steps':>6} {'status':10} {'dstates':>8} {'bound':>6} {'visited':>8} {'maps':>5} "
        f"{'step, ms':>9} {'so far, s':>10} {'anew, s':>8} {'ratio':>7}"
    )
    # The sleep is the drive of the robot; only `observe` is timed.
    for action, step in zip(trace.actions, rest, strict=True):
        time.sleep(options.drive)
        began = time.perf_counter()
        solution = mapper.observe(
            action, step.view or "", star=step.star, displacement=step.displacement
        )
        seconds.append(time.perf_counter() - began)
        optimal += solution.status is Status.OPTIMAL
        complete += solution.complete
        true += bool(solution.maps) and solution.maps[0].labels == truth[: solution.steps]
        visited = len(set(walk.truth[: solution.steps]))
        sizes.append(solution.cost.dstates / visited if solution.cost else 0.0)
        if solution.steps in CHECKPOINTS:
            anew = (
                solve(trace.prefix(solution.steps), time_limit=options.anew).seconds.total
                if options.anew
                else 0.0
            )
            dstates = solution.cost.dstates if solution.cost else 0
            print(
                f"{solution.steps:6} {solution.status.value:10} {dstates:8} "
                f"{solution.bound.dstates or 0:6} {visited:8} {solution.count:5} "
                f"{1000 * seconds[-1]:9.2f} {sum(seconds):10.2f} {anew:8.2f} "
                f"{anew / seconds[-1]:7.0f}",
                flush=True,
            )
    print(
        f"{len(seconds)} steps, {mapper.searches} searches: median "
        f"{1000 * percentile(seconds, 0.5):.2f} ms, 99th percentile "
        f"{1000 * percentile(seconds, 0.99):.0f} ms, most {1000 * max(seconds):.0f} ms; optimal "
        f"{optimal / len(seconds):.1%}, all minimal maps {complete / len(seconds):.1%}, true "
        f"{true / len(seconds):.1%}; dstates by visited: median {percentile(sizes, 0.5):.2f}, "
        f"most {max(sizes):.2f}"
    )


if __name__ == "__main__":
    main()
