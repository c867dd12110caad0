"""The gain of each speed-up: the time without it divided by the time with all, in one run.

    python benchmarks/ablation.py [--limit S] [--memory MIB] [--only PATTERN]
                                  [--out benchmarks/results/ablation.json]

The table has the form of that of bench.py, but its columns are solvers without one speed-up instead
of other programs. The column "without all" is the plain encoding of the axioms, which gets the
whole trace at once.
"""

from __future__ import annotations

import argparse
import datetime
import re
import sys
from pathlib import Path
from typing import Any

from bench import machine, packages, run, store
from suite import BARE, INSTANCES, SMALL, Instance
from table import OURS, WITHOUT, times

from ssh_abduction.theory.speedups import SPEEDUPS

CAUSAL = [
    "rectangle n=400",
    "rectangle n=40000",
    "moore 8/2 n=800",
    "moore 30/10 n=200",
    "moore 100/10 n=3200",
]
CAUSAL += ["maze 2x2 n=1600", "maze 3x3 n=1600", "maze 4x4 n=1600"]
FULL = ["full rectangle n=400", "full aces3", BARE.name]
FRAMED = ["full taylor-hall", SMALL.name, "full maze 5x5 n=1600", "full maze 10x10 n=200"]
USED = {
    "causal": {
        "prefixes",
        "names",
        "clique",
        "lazy",
        "core_guided",
        "annealed",
        "greedy",
    },
    "full": {"prefixes", "path_names", "framing", "ways"},
    "framed": {
        "prefixes",
        "names",
        "clique",
        "lazy",
        "core_guided",
        "sides",
        "annealed",
        "processes",
    },
}


def variants(instance: Instance) -> list[str]:
    """List the runs of an instance: each without some speed-ups.

    Returns:
        First each speed-up that the theory of the instance uses; last all, separated by commas.
    """
    theory = "causal" if instance.causal else "framed" if instance.name in FRAMED else "full"
    return [*(name for name in SPEEDUPS if name in USED[theory]), ",".join(SPEEDUPS)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--limit", type=float, default=10, metavar="S", help="seconds a cell has (default 10)"
    )
    parser.add_argument(
        "--memory",
        type=int,
        default=4096,
        metavar="MIB",
        help="address space a cell has, in MiB (default 4096)",
    )
    parser.add_argument(
        "--only",
        default="",
        metavar="PATTERN",
        help="measure only instances that match this regular expression",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path(__file__).parent / "results" / "ablation.json",
        metavar="RESULTS.json",
    )
    options = parser.parse_args()
    results: dict[str, Any] = {
        "date": datetime.date.today().isoformat(),
        "limit": options.limit,
        "memory": options.memory,
        "seeds": 1,
    }
    results |= {
        "machine": machine(),
        "packages": {k: v for k, v in packages().items() if k in (OURS, "clingo")},
        "cells": [],
    }
    for name in CAUSAL + FULL + FRAMED:
        if re.search(options.only, name):
            for off in ["", *variants(INSTANCES[name])]:
                tool = OURS + (WITHOUT + off if off else "")
                cell = run(tool, INSTANCES[name], 0, options.limit, options.memory)
                cell["tool"] = OURS if not off else f"−{off}" if "," not in off else "−all"
                print(
                    f"{name:24} {cell['tool']:14} {cell['status']:14} "
                    f"{cell.get('seconds', 0):8.2f} s",
                    file=sys.stderr,
                )
                results["cells"].append(cell)
                store(results, options.out)
    print(times(results))


if __name__ == "__main__":
    main()
