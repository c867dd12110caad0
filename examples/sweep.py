"""Map many drives under many theories, and collect the results in one table.

    python examples/sweep.py out --worlds doors curved --seeds 2
    python examples/sweep.py out --worlds plans/*.xml --seeds 5 --scheduler tcp://host:8786

The sweep maps several drives through each world or floor plan, under each theory. Each drive is
simulated once, as a log. For each theory, one call of `ssh-abduction map` maps all logs. The call
can use the workers of a Dask cluster, and it does not repeat finished runs. So a sweep that was
stopped can be started again.

The file rows.jsonl gets a line for each run. Then a table is printed. It counts the drives that
have a map, and those that have a single minimal map. It gives precision and recall of the pairs of
visits that the first map has at one place.

*A hundred machines* can share a sweep. Nobody has done this yet, so this is an estimate. 17 floor
plans, 5 drives through each and 9 theories are 765 runs.
Mapping a drive of 200 m through a plan took 28 s of CPU time, nearly all of it for perception (8
runs, two plans; a log has 1.0 to 1.7 MB). It takes two minutes if all solves use their time limit.
So the sweep takes 6 to 25 hours on one processor, and two to eight minutes on a hundred machines
with two processors each. A run returns 130 kB on average (31 runs of six worlds and plans; 370 kB
at most), so all runs return 100 MB.

One machine runs the scheduler (`dask scheduler`). Each other machine runs `dask worker
tcp://host:8786 --nworkers 2 --nthreads 1 --memory-limit 8GiB`. Logs are sent to the workers, and
folders are sent back, so the machines need no common disk. If a worker is killed, another one does
its run. A run that kills two workers becomes an error on its line.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from ssh_abduction import Trace
from ssh_abduction.cli import main as shell
from ssh_abduction.evaluation import evaluate_visits
from ssh_abduction.solution import Solution

Row = dict[str, Any]

INTERRUPTED = 130  # the exit code after Ctrl-C
# The options of each theory. Without --theory they change the default theory of the verb `map`.
THEORIES = {
    "as it suits": [],
    "stars and sides": ["--theory", "topological"],
    "no stars": ["--theory", "topological", "--set", "star=none"],
    "no sides": ["--theory", "topological", "--set", "boundary=none"],
    "no stars, no sides": ["--set", "star=none", "--set", "boundary=none"],
    "planar": ["--set", "planar=true"],
    "next place": ["--set", "next_place=true"],
    "one return at a time": ["--set", "joint=1"],
    "paths first": ["--set", "prefer=dstates,paths,places"],
}


def main() -> None:
    parser = argparse.ArgumentParser(description="Map many drives under many theories.")
    parser.add_argument("folder", type=Path)
    parser.add_argument(
        "--worlds",
        nargs="+",
        required=True,
        help="names of built-in worlds, world files, or floor plans",
    )
    parser.add_argument("--seeds", type=int, default=5, help="number of drives through each world")
    parser.add_argument("--theories", nargs="+", choices=THEORIES, default=list(THEORIES))
    parser.add_argument(
        "--time-limit", default="30", help="seconds for the maps of a log (default: 30)"
    )
    parser.add_argument(
        "--scheduler", help="address of a Dask scheduler; without it, one process a core"
    )
    options = parser.parse_args()
    names = [Path(world).name.partition(".")[0] for world in options.worlds]
    if len(set(names)) < len(names):
        parser.error(
            "--worlds: expected worlds with different names, as logs and folders are "
            "named after them"
        )
    tours = [
        drive(world, seed, options.folder)
        for world in options.worlds
        for seed in range(options.seeds)
    ]
    logs = [log for log in tours if log.exists()]
    if not logs:
        parser.exit(1, "no drive was made, as said above\n")
    where = ["--scheduler", options.scheduler] if options.scheduler else ["--jobs", "-1"]
    rows = []
    for theory in options.theories:
        runs = options.folder / theory.replace(", ", "-").replace(" ", "-")
        folder = (
            runs if len(logs) > 1 else runs / logs[0].stem
        )  # a single log is mapped into the named folder itself
        code = shell(
            [
                "map",
                *map(str, logs),
                "-o",
                str(folder),
                "--time-limit",
                options.time_limit,
                *where,
                *THEORIES[theory],
                "-q",
            ]
        )
        if code == INTERRUPTED:
            parser.exit(code, "stopped; the same command goes on from here\n")
        rows += [row_of(theory, runs / log.stem) for log in logs]
    text = "".join(json.dumps(row) + "\n" for row in rows)
    (options.folder / "rows.jsonl").write_text(text, encoding="utf-8")
    failed = (
        f"; {len(tours) - len(logs)} of {len(tours)} drives were not made"
        if len(logs) < len(tours)
        else ""
    )
    print(f"{len(rows)} runs in {options.folder / 'rows.jsonl'}{failed}")
    print("\n".join(table(rows)))


def drive(world: str, seed: int, folder: Path) -> Path:
    """Simulate a drive, unless its log exists.

    Args:
        world: Name or file of a world, or file of a floor plan.
        seed: Seed of the drive.
        folder: Folder of the sweep.

    Returns:
        The path of the log. The file does not exist if the robot cannot drive in this world.
    """
    log = folder / "logs" / f"{Path(world).name.partition('.')[0]}-{seed}.log"
    if not log.exists():
        log.parent.mkdir(parents=True, exist_ok=True)
        shell(["simulate", world, "--format", "carmen", "--seed", str(seed), "-o", str(log), "-q"])
    return log


def row_of(theory: str, run: Path) -> Row:
    """Make the row of a run.

    Args:
        theory: Name of the theory.
        run: Folder of the run of a log.

    Returns:
        A row with log, theory and results. A run that failed has the status "error".
    """
    row = {"log": run.name, "theory": theory}
    if not (run / "run.json").exists():
        return {**row, "status": "error"}
    told = json.loads((run / "run.json").read_text(encoding="utf-8"))
    results = {name: told[name] for name in ("status", "complete", "count", "cost")}
    return {**row, **results, "pairs": pairs_of(run)}


def pairs_of(run: Path) -> dict[str, int] | None:
    """Count pairs of visits at one place in the first map of a run.

    Returns:
        Dict with the number of pairs in the map ("joined"), of those that are right ("right"), and
        of all true pairs ("returns"). None if the run has no map.
    """
    maps = Solution.load(run / "maps.json").maps[:1]
    places = evaluate_visits(maps, Trace.load(run / "trace.jsonl")).maps[0].places if maps else None
    return (
        {name: getattr(places, name) for name in ("joined", "right", "returns")} if places else None
    )


def table(rows: Sequence[Row]) -> Iterator[str]:
    """Make the lines of the table: a head, and a line for each theory."""
    yield (
        f"{'theory':<22}{'drives':>7}{'mapped':>8}{'unique':>8}{'places':>8}{'precision':>11}{'recall':>8}"
    )
    for theory in dict.fromkeys(row["theory"] for row in rows):
        some = [row for row in rows if row["theory"] == theory]
        costs = [row["cost"] for row in some if row.get("cost")]
        unique = sum(
            row.get("status") == "optimal" and row.get("complete") and row.get("count") == 1
            for row in some
        )
        places = f"{median(cost['places'] for cost in costs):g}" if costs else ""
        pairs = [row["pairs"] for row in some if row.get("pairs")]
        joined, right, returns = (
            sum(found[name] for found in pairs) for name in ("joined", "right", "returns")
        )
        precision, recall = (f"{right / n:.2f}" if n else "" for n in (joined, returns))
        yield (
            f"{theory!s:<22}{len(some):>7}{len(costs):>8}{unique:>8}"
            f"{places:>8}{precision:>11}{recall:>8}"
        )


if __name__ == "__main__":
    main()
