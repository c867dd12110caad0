"""Map many drives under many theories, and collect what came out: worlds or floor plans x tours x theories x rungs of the ladder.

    python examples/sweep.py out --worlds doors curved --seeds 2
    python examples/sweep.py out --worlds plans/*.xml --seeds 5 --scheduler tcp://host:8786

Each drive is simulated once, as a log. Each theory maps all logs with one call of `ssh-abduction map`, which can use the workers of a Dask cluster, and which does not do again what is done: so a sweep that was stopped is
begun once more. One line for each solve goes to rows.jsonl: the maps themselves, and each rung of the ladder.

*On a hundred machines,* as a plan that nobody has run yet: 17 floor plans x 5 tours x 9 theories x 5 rungs are 3,825 solves in 765 runs, which their limits keep to about two minutes each: half a day for two
processors, and ten minutes for a hundred machines of two. A scheduler runs on one of them
(`dask scheduler`), and on each of the others `dask worker tcp://host:8786 --nworkers 2 --nthreads 1 --memory-limit 8GiB`. Logs travel to the workers, and folders come back, so no disk is shared. A worker that is killed loses the run
that it was at, which another one does; a run that kills its worker twice is an error on its line. What comes back is some 200 kB a run, as of ACES3, so 150 MB in all.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from ssh_abduction.cli import main as shell

# What each theory is asked with. Where none is named, it is the one that suits the walls of the building, with what is said laid over it.
THEORIES = {
    "as it suits": [],
    "stars and sides": ["--theory", "topological"],
    "no stars": ["--theory", "topological", "--star", "none"],
    "no sides": ["--theory", "topological", "--boundary", "none"],
    "no stars, no sides": ["--star", "none", "--boundary", "none"],
    "planar": ["--planar"],
    "next place": ["--next-place"],
    "one return at a time": ["--joint", "1"],
    "paths first": ["--prefer", "dstates,paths,places"],
}


def main() -> None:
    parser = argparse.ArgumentParser(description="Map many drives under many theories.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--worlds", nargs="+", required=True, help="worlds that ship, world files, or floor plans")
    parser.add_argument("--seeds", type=int, default=5, help="so many drives through each")
    parser.add_argument("--theories", nargs="+", choices=THEORIES, default=list(THEORIES))
    parser.add_argument("--time-limit", default="30", help="seconds for the maps of a log (default: 30)")
    parser.add_argument("--scheduler", help="address of a Dask scheduler; without it, one process a core")
    options = parser.parse_args()
    logs = [drive(world, seed, options.folder) for world in options.worlds for seed in range(options.seeds)]
    where = ["--scheduler", options.scheduler] if options.scheduler else ["--jobs", "-1"]
    rows = []
    for theory in options.theories:
        runs = options.folder / theory.replace(", ", "-").replace(" ", "-")
        folder = runs if len(logs) > 1 else runs / logs[0].stem  # a log that stands alone has the folder that is named
        shell(["map", *map(str, logs), "-o", str(folder), "--time-limit", options.time_limit, *where, *THEORIES[theory], "-q"])
        rows += [row for log in logs for row in rows_of(theory, runs / log.stem)]
    text = "".join(json.dumps(row) + "\n" for row in rows)
    (options.folder / "rows.jsonl").write_text(text, encoding="utf-8")
    print(f"{len(rows)} solves in {options.folder / 'rows.jsonl'}")


def drive(world: str, seed: int, folder: Path) -> Path:
    """The log of a drive, made unless it is there."""
    log = folder / "logs" / f"{Path(world).stem}-{seed}.log"
    if not log.exists():
        log.parent.mkdir(parents=True, exist_ok=True)
        shell(["simulate", world, "--as", "carmen", "--seed", str(seed), "-o", str(log), "-q"])
    return log


def rows_of(theory: str, run: Path) -> list[dict[str, object]]:
    """A row for the maps of a run, and one for each rung of its ladder."""
    if not (run / "run.json").exists():
        return [{"log": run.name, "theory": theory, "rung": None, "status": "error"}]
    told = json.loads((run / "run.json").read_text(encoding="utf-8"))
    whole = {"name": "maps", **{name: told[name] for name in ("status", "count", "cost")}}
    return [
        {
            "log": run.name,
            "theory": theory,
            "rung": solve["name"],
            "status": solve["status"],
            "count": solve["count"],
            "cost": solve["cost"],
        }
        for solve in (whole, *told["ladder"])
    ]


if __name__ == "__main__":
    main()
