"""ssh-abduction ladder TRACE: what is each kind of evidence worth?"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import TYPE_CHECKING

from ssh_abduction.cli.options import Verbs, add_theory, theory_of
from ssh_abduction.cli.text import table
from ssh_abduction.files import json_line
from ssh_abduction.trace import Trace

if TYPE_CHECKING:
    from ssh_abduction.rungs import Rung

UNKNOWN = "–"


def add_parser(verbs: Verbs) -> None:
    text = (
        "Solve a trace by its views alone, and then with one kind of evidence more on each rung: stars, pairs of steps that displacements tell apart, "
        "sets of two returns, planarity. Says how many minimal maps there are, how large they are, and which of them is the true one, where the trace has truth."
    )
    parser = verbs.add_parser("ladder", help="what is each kind of evidence worth?", description=text)
    parser.add_argument("trace", help="trace file (JSON Lines), or - for standard input")
    parser.add_argument(
        "-n", "--maps", type=int, default=100, metavar="N", help="list at most N maps on each rung, 0 for all (default 100)"
    )
    parser.add_argument("--time-limit", type=float, metavar="SECONDS", help="for each rung")
    parser.add_argument("--json", action="store_true", help="print a JSON object a rung")
    add_theory(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    from ssh_abduction.rungs import ladder  # loads scipy

    trace = Trace.load(options.trace)
    rungs: list[Rung] = []
    for rung in ladder(trace, theory_of(options), limit=options.time_limit, maps=options.maps):
        rungs.append(rung)
        if options.json:
            print(json_line(rung.to_dict()), flush=True)
    if not options.json:
        print(table(("", "minimal maps", "dstates", "places", "paths", "the true one", "accuracy", "seconds"), list(map(_row, rungs))))
    return 0


def _row(rung: Rung) -> list[object]:
    data, cost = rung.to_dict(), rung.solution.cost
    counts: Iterator[object] = (getattr(cost, name) if cost else UNKNOWN for name in ("dstates", "places", "paths"))
    more = "" if rung.solution.complete else "+"
    listed = f"{data['count']}{more}" if data["status"] == "optimal" else f"{data['status']}"
    truth = UNKNOWN if rung.evaluation is None else "none" if rung.rank is None else f"map {rung.rank}"
    accuracy = UNKNOWN if data["accuracy"] is None else f"{data['accuracy']:.3f}"
    return [rung.name, listed, *counts, truth, accuracy, f"{data['seconds']:.2f}"]
