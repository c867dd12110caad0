"""CPU time that displacements cost and save: mazes solved with and without them.

    python benchmarks/geometry.py [--cells 4 6] [--steps 40 150] [--seeds 10] [--first 200]
                                  [--limit 60] [--views]

Geometry is the work of three parts: the evidence `displacement`, which rejects single returns and
sets of returns; the checker's own geometry; and the fit of the maps.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

from instances import maze
from truth import NOISE

import ssh_abduction.checker.displacements
import ssh_abduction.solver.geometry.fit
from ssh_abduction import Theory, Trace, solve
from ssh_abduction.data import Odometry
from ssh_abduction.solution import Status
from ssh_abduction.theory.evidence import displacement

# The functions of geometry that other parts call.
BEGINS = (
    (displacement.Displacement, "pairs"),
    (displacement.Displacement, "refuse"),
    (displacement.Displacement, "count_returns"),
    (ssh_abduction.checker.displacements, "refused_returns"),
    (ssh_abduction.solver.geometry.fit, "fit"),
)


@contextmanager
def timed() -> Iterator[list[float]]:
    """Measure the CPU seconds spent in geometry during a `with` block.

    Yields:
        A list of one number, to which the seconds are added.
    """
    spent, inside = [0.0], [False]

    def wrapped(function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **named: Any) -> Any:
            if inside[0]:
                return function(*arguments, **named)
            inside[0], began = True, time.thread_time()
            try:
                found = function(*arguments, **named)
                return (
                    list(found) if hasattr(found, "__next__") else found
                )  # run generators now, as they would otherwise do their work outside the timer
            finally:
                spent[0] += time.thread_time() - began
                inside[0] = False

        return call

    with ExitStack() as patches:
        for owner, name in BEGINS:
            patches.enter_context(patch.object(owner, name, wrapped(getattr(owner, name))))
        yield spent


def measured(trace: Trace, theory: Theory, limit: float) -> tuple[float, float, bool]:
    """Solve a trace.

    Returns:
        CPU seconds, the part of them that was spent in geometry, and whether the answer is proven.
    """
    with timed() as spent:
        began = time.process_time()
        solution = solve(trace, theory, time_limit=limit)
        return time.process_time() - began, spent[0], solution.status is Status.OPTIMAL


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--cells", type=int, nargs="+", default=[4, 6], metavar="N")
    parser.add_argument(
        "--steps", type=int, nargs="+", default=[40, 150], metavar="N", help="for each of --cells"
    )
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=200)
    parser.add_argument("--limit", type=float, default=60)
    parser.add_argument("--views", action="store_true", help="without stars")
    options = parser.parse_args()
    theory = Theory(star="none") if options.views else Theory.topological()
    # Load all modules and programs before the first measurement.
    measured(
        maze(2, 2, steps=8, seed=0, stars=True, follow=True, odometry=Odometry(**NOISE)).trace,
        theory,
        options.limit,
    )
    print(
        f"| mazes, {'views' if options.views else 'stars'} | proven with, without | CPU "
        "s with, without (median) | without / with (median of ratios) | share of "
        "geometry: median, most |\n|---|---|---|---|---|"
    )
    for cells, steps in zip(options.cells, options.steps, strict=True):
        rows = []
        for seed in range(options.first, options.first + options.seeds):
            trace = maze(
                cells,
                cells,
                steps=steps,
                seed=seed,
                stars=True,
                follow=True,
                odometry=Odometry(**NOISE),
            ).trace
            rows.append(
                (
                    measured(trace, theory, options.limit),
                    measured(trace, theory.replace(displacement="none"), options.limit),
                )
            )
        used, plain = zip(*rows, strict=True)
        shares = [inside / seconds for seconds, inside, _ in used]
        print(
            f"| {cells} x {cells}, {steps} steps, {options.seeds} seeds | "
            f"{sum(r[2] for r in used)}, {sum(r[2] for r in plain)} | "
            f"{statistics.median(r[0] for r in used):.2f}, "
            f"{statistics.median(r[0] for r in plain):.2f} | "
            f"{statistics.median(b[0] / a[0] for a, b in rows):.2f} | "
            f"{statistics.median(shares):.2f}, {max(shares):.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
