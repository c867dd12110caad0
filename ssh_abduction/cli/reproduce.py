"""ssh-abduction reproduce EXPERIMENT: repeat one of the paper's two experiments, end to end."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from ssh_abduction.cli.options import check_jobs, output
from ssh_abduction.cli.parsing import Verbs
from ssh_abduction.cli.text import table
from ssh_abduction.cli.verbosity import progress_bar
from ssh_abduction.data.errors import AbductionError, brief, named

# Each seed takes seconds. More than this many seeds are a typing error, and would fill the memory.
MOST_SEEDS = 10_000


def add_parser(verbs: Verbs) -> None:
    parser = verbs.add(
        "reproduce",
        run,
        "run the paper's experiments",
        "Reproduce an experiment of Kuipers & Beeson (2002): simulate, cluster, abduce, learn. "
        "Writes figures, data and a page into a folder.",
    )
    said = "which experiment of the paper to repeat"
    parser.add("experiment", said, choices=("notched-rectangle", "taylor-hall"))
    parser.add("--seeds", "random seeds, such as 0-19 or 1,5,7 (default: 0-19)", default="0-19")
    parser.add("--json", "print each claim, with the paper's value and ours for each seed, as JSON")
    parser.add(
        "--jobs N", "the number of processes; -1 for one per core (default: 2)", type=int, default=2
    )
    parser.add_setting(
        "outcomes",
        "for notched-rectangle, whether to try other depths of the notch and other spreads of the "
        "robot's poses, too (default: true)",
        True,
    )
    parser.add("-o --output FOLDER", "folder to write (default: out/EXPERIMENT)", type=output)


def run(options: argparse.Namespace) -> int:
    from ssh_abduction.evaluation.paper_report import reproduce, steps

    seeds, name = _seeds(options.seeds), options.experiment
    check_jobs(options.jobs, "processes", default=2)
    folder = Path(options.output or f"out/{name}")
    with progress_bar() as progress:
        task = progress.add_task(name, total=steps(name, seeds, options.outcomes))

        def done(what: str) -> None:
            progress.update(task, advance=1, description=f"{name}: {what}")

        def show(rows: list[dict[str, Any]]) -> None:
            progress.stop()  # or the bar would be drawn into the table
            _print(options, rows)
            progress.start()

        shown: dict[str, Any] = {"on_done": done, "on_table": show}
        reproduce(name, seeds, folder, options.jobs, options.outcomes, **shown)
    if not options.json:
        print(f"\nThe page with the figures is {named(folder / 'report.html')}")
    return 0


def _print(options: argparse.Namespace, rows: list[dict[str, Any]]) -> None:
    from ssh_abduction.evaluation.paper_report import claimed, spread_of

    if options.json:
        record = {"experiment": options.experiment, "claims": rows}
        print(json.dumps(record, ensure_ascii=False, indent=1), flush=True)
        return
    cells = [[claimed(r), r["paper"], spread_of(r), f"{r['holds']} of {r['seeds']}"] for r in rows]
    print(table(["claim", "paper", "here", "holds"], cells), flush=True)


def _seeds(text: str) -> list[int]:
    """List the seeds in a text such as "0-19" or "1,5,7". Raise AbductionError for others."""
    try:
        found: list[int] = []
        for part in text.split(","):
            first, _, last = part.partition("-")
            numbers = range(int(first), int(last or first) + 1)
            if not numbers or numbers[-1] >= 2**32 or len(found) + len(numbers) > MOST_SEEDS:
                raise ValueError
            found += numbers
    except (ValueError, OverflowError):
        raise AbductionError(
            f"--seeds: expected numbers as 0-19 or 1,5,7, at most {MOST_SEEDS:,} and below "
            f"{2**32:,}, got {brief(text)}; write fewer"
        ) from None
    return found
