"""How long is a unit of work? The processor time of searches, divided by their work.

    python benchmarks/work.py [--limit W] [--seeds N] [trace.jsonl …]

Prints a table in Markdown with a row for each family of mazes and machines, and for each trace that
is given, which is solved by the theory of `map`. At 1, a unit is a second of this processor. The
weights in `ssh_abduction/runtime/clock.py` were chosen by this table.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from instances import maze, moore
from truth import NOISE

from ssh_abduction import Theory, Trace, solve
from ssh_abduction.data import Odometry
from ssh_abduction.robot_logs.log_maps import BARE

ODOMETRY = Odometry(**NOISE)
FAULTS = Theory.causal().replace(misread=1.5, slipped=3)
FAMILIES: dict[str, tuple[Theory | None, Callable[[int], Trace]]] = {
    "mazes 5 x 5, 120 steps": (None, lambda s: maze(5, 5, steps=120, seed=s).trace),
    "the same, stars, 200 steps": (None, lambda s: maze(5, 5, steps=200, seed=s, stars=True).trace),
    "machines of 40 states, causal": (
        Theory.causal(),
        lambda s: moore(40, 3, steps=400, seed=s).trace,
    ),
    "mazes 3 x 3 with faults": (FAULTS, lambda s: maze(3, 3, steps=60, seed=s).trace),
    "mazes 4 x 4, displacements": (
        None,
        lambda s: maze(4, 4, steps=60, seed=s, odometry=ODOMETRY).trace,
    ),
    "mazes 6 x 6, displacements": (
        None,
        lambda s: maze(6, 6, steps=150, seed=s, odometry=ODOMETRY).trace,
    ),
}


def row(name: str, traces: Sequence[Trace], theory: Theory | None, limit: float) -> str:
    """Solve traces, and return a row of the table."""
    ratios, work = [], 0.0
    for trace in traces:
        began = time.process_time()
        done = solve(trace, theory, work_limit=limit).effort.work or 0.0
        ratios.append((time.process_time() - began) / max(done, 1e-6))
        work += done
    least, middle, most = min(ratios), statistics.median(ratios), max(ratios)
    return f"| {name} | {len(traces)} | {work:.2f} | {least:.2f} | {middle:.2f} | {most:.2f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("traces", nargs="*", type=Path, help="traces of logs")
    parser.add_argument("--limit", type=float, default=3.0, help="units of work (default: 3)")
    parser.add_argument("--seeds", type=int, default=4, help="traces a family (default: 4)")
    options = parser.parse_args()
    print(
        "| traces | number | work | least CPU s a unit | median | most |\n|---|---|---|---|---|---|"
    )
    for name, (theory, make) in FAMILIES.items():
        traces = [make(seed) for seed in range(5000, 5000 + options.seeds)]
        print(row(name, traces, theory, options.limit), flush=True)
    for path in options.traces:
        theory = BARE.replace(weigh="cost")
        print(row(path.stem, [Trace.load(path)], theory, options.limit), flush=True)


if __name__ == "__main__":
    main()
