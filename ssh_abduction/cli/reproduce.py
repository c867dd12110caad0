"""ssh-abduction reproduce EXPERIMENT: the paper's two experiments, end to end."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from ssh_abduction.cli.options import Verbs
from ssh_abduction.cli.text import table
from ssh_abduction.errors import SSHError


def add_parser(verbs: Verbs) -> None:
    text = "Reproduce an experiment of Kuipers & Beeson (2002): simulate, cluster, abduce, learn. Writes figures, data and a page into a folder."
    parser = verbs.add_parser("reproduce", help="the paper's experiments, end to end", description=text)
    parser.add_argument("experiment", choices=("notched-rectangle", "taylor-hall"))
    parser.add_argument("--seeds", default="0-19", help="seeds, as 0-19 or 1,5,7 (default: 0-19)")
    parser.add_argument("--json", action="store_true", help="print each claim, the paper's figure and ours by seed, as JSON")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="processes (default: 2)")
    parser.add_argument("--outcomes", action=argparse.BooleanOptionalAction, default=True, help="map outcomes over notch and spread")
    parser.add_argument("-o", "--output", metavar="FOLDER", help="folder to write (default: out/EXPERIMENT)")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from ssh_abduction.reproduce.report import reproduce, spread_of, steps

    seeds = _seeds(options.seeds)
    if options.jobs == 0:
        raise SSHError("--jobs: expected how many processes, or -1 for one a core, got 0; leave it out for 2")
    folder = Path(options.output or f"out/{options.experiment}")
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty()) as progress:
        task = progress.add_task(options.experiment, total=steps(options.experiment, seeds, options.outcomes))
        rows = reproduce(
            options.experiment,
            seeds,
            folder,
            options.jobs,
            options.outcomes,
            on_done=lambda what: progress.update(task, advance=1, description=f"{options.experiment}: {what}"),
        )
    if options.json:
        print(json.dumps({"experiment": options.experiment, "claims": rows}, ensure_ascii=False, indent=1))
    else:
        print(
            table(
                ["claim", "paper", "here", "holds"], [[r["claim"], r["paper"], spread_of(r), f"{r['holds']} of {r['seeds']}"] for r in rows]
            )
        )
        print(f"\nThe page with the figures is {folder / 'report.html'}")
    return 0


def _seeds(text: str) -> list[int]:
    """0-19 or 1,5,7. Raises SSHError."""
    try:
        found: list[int] = []
        for part in text.split(","):
            first, _, last = part.partition("-")
            found += range(int(first), int(last or first) + 1)
    except ValueError:
        raise SSHError(f"--seeds: expected numbers as 0-19 or 1,5,7, got {text!r}") from None
    return found
