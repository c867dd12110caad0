"""Which speed-ups are worth keeping: each is switched off on several families and seeds.

    python benchmarks/pruning.py [--only SWITCHES] [--seeds N] [--resume] [--out RESULTS.json]

A family is one instance with several seeds. Runs with and without a speed-up alternate. The ratio
of a seed is the seconds without the speed-up divided by the seconds with it. In some trials, it
compares the dstates of the best maps at the time limit instead. A speed-up stays if the median
ratio over the seeds is at least GAIN on two families. Seconds are CPU seconds unless TRIALS says
otherwise, so other work on the machine hardly matters. A search that hits its limit counts as if it
had ended at the limit, so the true ratio is at least as far from 1. Each run has its own process,
and only one runs at a time. Results are stored as JSON after each run; --resume continues a stored
run. readme.py writes the table into benchmarks/performance.md.
"""

from __future__ import annotations

import argparse
import datetime
import json
import math
import statistics
import sys
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from arguments import add_number
from bench import machine, packages, run, store
from suite import BARE, INSTANCES
from table import OURS, WITHOUT

ROOT = Path(__file__).parent.parent
GAIN = 1.5  # A speed-up stays if the ratio without to with it is at least this
STAYING = 2  # on this many families of instances.
FAMILIES = 3  # Fewer families are too few to remove a speed-up.
LIMIT = 4.0  # Seconds of a search.
LONGER = 12.0  # Seconds if little gain was expected, or if maps take long.
SHORT = 3.0  # Seconds if the first map matters, before a proof is possible.
MEMORY = 4096  # MiB


@dataclass(frozen=True)
class Trial:
    """A speed-up that is switched off on a family, which is one instance with several seeds.

    Attributes:
        switch: Name of the speed-up.
        family: Name of the instance.
        measure: "seconds" until one minimal map is proven, or "dstates" of the best map at the
            limit.
        limit: Time limit of a search in seconds.
        clock: "cpu" for CPU seconds, or "wall".
    """

    switch: str
    family: str
    measure: str = "seconds"
    limit: float = LIMIT
    clock: str = "cpu"


QUICK_MAZE, CORRIDORS, MACHINE_16 = (
    "maze 3x3 n=1600",
    "maze 5x5 n=1600, corridors followed",
    "moore 16/2 n=1600",
)
BLOCK, SMALL_BLOCK, LARGE_BLOCK = (
    "circuits 60x40, 4 rounds",
    "full circuits 5x3, 50 rounds",
    "full circuits 6x4, 20 rounds",
)
STARS, FEW_SEEN, TAYLOR = (
    "full maze 4x4 n=800",
    "full maze 8x8 n=150",
    "full taylor-hall",
)
BARE_CORRIDORS, PATTERNS = (
    "full maze 4x4 n=40, corridors followed, no stars",
    "full maze 3x3 n=60, stars as patterns",
)


def _timed(switch: str, *families: str, limit: float = LIMIT, clock: str = "cpu") -> list[Trial]:
    return [Trial(switch, family, limit=limit, clock=clock) for family in families]


def _ended(switch: str, *families: str, limit: float = LIMIT, clock: str = "cpu") -> list[Trial]:
    return [Trial(switch, family, "dstates", limit, clock) for family in families]


TRIALS = (
    *_timed("names", QUICK_MAZE, MACHINE_16, STARS),
    *_timed("clique", QUICK_MAZE, MACHINE_16, STARS),
    *_timed("lazy", QUICK_MAZE, MACHINE_16, CORRIDORS, STARS),
    *_timed("lazy", "maze 2x2 n=1600", "moore 8/2 n=3200"),
    *_timed("core_guided", QUICK_MAZE, CORRIDORS, MACHINE_16, STARS),
    *_timed("core_guided", "full maze 5x5 n=1600", limit=LONGER),
    *_timed("sides", STARS, TAYLOR),
    *_timed("sides", FEW_SEEN, "full maze 10x10 n=200", limit=LONGER),
    *_timed("ways", BARE_CORRIDORS, BARE.name, LARGE_BLOCK, limit=2 * LIMIT),
    *_timed("prefixes", SMALL_BLOCK, BLOCK, TAYLOR),
    *_timed("path_names", SMALL_BLOCK, LARGE_BLOCK, BARE_CORRIDORS, PATTERNS),
    *_timed("framing", BARE.name, BARE_CORRIDORS, LARGE_BLOCK, limit=2 * LIMIT),
    *_ended(
        "framing",
        "full maze 4x4 n=800, no stars",
        "full maze 5x5 n=1600, no stars",
        limit=2 * LIMIT,
    ),
    *_timed("greedy", QUICK_MAZE),
    *_ended("greedy", "maze 6x6 n=10000", "full maze 10x10 n=4000", limit=SHORT),
)
SWITCHES = tuple(dict.fromkeys(trial.switch for trial in TRIALS))  # what can be measured


def ratio(measure: str, limit: float, base: dict[str, Any], without: dict[str, Any]) -> float:
    """Divide the seconds, or dstates, without a speed-up by those with it.

    Args:
        measure: "seconds" or "dstates".
        limit: Time limit in seconds.
        base: Result with the speed-up.
        without: Result without it.
    """
    if measure == "dstates":
        here, there = (cell.get("dstates") or math.inf for cell in (base, without))
        return 1.0 if here == there else there / here
    here, there = (
        min(cell["seconds"], limit) if cell["status"] == "ok" else limit for cell in (base, without)
    )
    return there / here


def ratios(results: dict[str, Any]) -> dict[str, dict[Trial, list[float]]]:
    """Compute the ratios of stored results.

    Returns:
        Dict from the name of each speed-up to its trials, each with a ratio for each seed.
    """
    pairs: dict[tuple[Trial, int], dict[bool, dict[str, Any]]] = {}
    for cell in results["cells"]:
        trial = Trial(
            cell["switch"], cell["instance"], cell["measure"], cell["limit"], cell["clock"]
        )
        pairs.setdefault((trial, cell["seed"]), {})[cell["tool"] == OURS] = cell
    found: dict[str, dict[Trial, list[float]]] = {}
    for (trial, _), pair in pairs.items():
        if len(pair) == 2:
            found.setdefault(trial.switch, {}).setdefault(trial, []).append(
                ratio(trial.measure, trial.limit, pair[True], pair[False])
            )
    return found


def verdict(of_switch: Collection[list[float]]) -> str:
    """Decide from the ratios of a speed-up, a list for each family, whether it stays.

    Returns:
        Text for the table: "stays", "**goes**" or "not measured yet".
    """
    if sum(statistics.median(of_family) >= GAIN for of_family in of_switch) >= STAYING:
        return "stays"
    return "**goes**" if len(of_switch) >= FAMILIES else "not measured yet"


def table(results: dict[str, Any]) -> str:
    """Make a table in Markdown, with a row for each speed-up."""
    rows = [
        "| speed-up | families with a gain: median ratio (least to most) | other families: "
        "medians | verdict |",
        "| -- | -- | -- | -- |",
    ]
    for switch, trials in ratios(results).items():
        gains, others = [], []
        for trial, found in trials.items():
            median = statistics.median(found)
            if median < GAIN:
                others.append(median)
            else:
                seeds = "" if len(found) == results["seeds"] else f", {len(found)} seeds"
                gains.append(f"{trial.family}{_meant(trial)}{seeds}: {_spread(found)}")
        rest = f"{len(others)}: {min(others):.2f} to {max(others):.2f}" if others else "–"
        verdict_of = verdict(trials.values())
        rows.append(f"| {switch} | {'<br>'.join(gains) or '–'} | {rest} | {verdict_of} |")
    rows += [
        f"| {switch} | – | – | not measured yet |"
        for switch in SWITCHES
        if switch not in ratios(results)
    ]
    return "\n".join(rows)


def _meant(trial: Trial) -> str:
    """A text that says what a trial compares; empty for CPU seconds."""
    return (
        f", dstates after {trial.limit:g} s"
        if trial.measure == "dstates"
        else ", wall-clock"
        if trial.clock == "wall"
        else ""
    )


def _spread(found: list[float]) -> str:
    shown = [
        f"{number:.2f}" if number < math.inf else "∞"
        for number in (statistics.median(found), min(found), max(found))
    ]
    return f"{shown[0]} ({shown[1]} to {shown[2]})"


def measure(results: dict[str, Any], trials: Iterable[Trial], seeds: int, out: Path) -> None:
    """Run the trials that are not stored yet, and store each result.

    Args:
        results: The stored results; receives the new ones.
        trials: The trials.
        seeds: Number of seeds.
        out: File for the results.
    """
    done = {
        (c["switch"], c["instance"], c["measure"], c["limit"], c["seed"], c["tool"])
        for c in results["cells"]
    }
    for trial in trials:
        for seed in range(seeds):
            tools = [OURS, f"{OURS}{WITHOUT}{trial.switch}"]
            for tool in tools if seed % 2 else tools[::-1]:
                if (trial.switch, trial.family, trial.measure, trial.limit, seed, tool) not in done:
                    cell = run(
                        tool, INSTANCES[trial.family], seed, trial.limit, MEMORY, trial.clock
                    )
                    results["cells"].append(
                        {
                            **cell,
                            "switch": trial.switch,
                            "measure": trial.measure,
                            "limit": trial.limit,
                            "clock": trial.clock,
                        }
                    )
                    store(results, out)
                    came = (
                        f"{cell['status']:8} {cell.get('seconds', 0):6.2f} s "
                        f"{cell.get('dstates')} dstates"
                    )
                    print(f"{trial.family:50} {seed} {tool:34} {came}", file=sys.stderr, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--only",
        default=",".join(SWITCHES),
        metavar="SWITCHES",
        help="speed-ups, separated by commas (default all)",
    )
    add_number(parser, "--seeds", "N", 5, "traces of each family")
    parser.add_argument(
        "--resume", action="store_true", help="keep stored runs, and run only the others"
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=ROOT / "benchmarks" / "results" / "pruning.json",
        metavar="RESULTS.json",
    )
    options = parser.parse_args()
    results: dict[str, Any] = {
        "date": datetime.date.today().isoformat(),
        "limit": LIMIT,
        "memory": MEMORY,
        "seeds": options.seeds,
    }
    results |= {
        "machine": machine(),
        "packages": {k: v for k, v in packages().items() if k in (OURS, "clingo")},
        "cells": [],
    }
    out = options.out.resolve()
    if options.resume and out.exists():
        results["cells"] = json.loads(out.read_text(encoding="utf-8"))["cells"]
    only = options.only.split(",")
    measure(results, [trial for trial in TRIALS if trial.switch in only], options.seeds, out)
    print(table(results))


if __name__ == "__main__":
    main()
