"""ssh-abduction ladder TRACE: how much each kind of evidence helps."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import TYPE_CHECKING

from ssh_abduction.cli.guard import Guard
from ssh_abduction.cli.options import add_max_maps, add_theory, theory_of, trace_path
from ssh_abduction.cli.outcome import on_ctrl_c
from ssh_abduction.cli.parsing import Verbs
from ssh_abduction.cli.text import table
from ssh_abduction.data.files import json_line
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.program import interrupted_code
from ssh_abduction.solver import Stop

if TYPE_CHECKING:
    from ssh_abduction.evaluation.rungs import Rung

UNKNOWN = "–"
HEAD = ("", "minimal maps", "dstates", "places", "paths", "the true one", "accuracy", "seconds")


def add_parser(verbs: Verbs) -> None:
    parser = verbs.add(
        "ladder",
        run,
        "show how much each kind of evidence helps",
        "Solve a trace several times, to show what each kind of evidence is worth. Begin with "
        "views alone, then add one kind at a time: stars (openings seen), pairs of steps that "
        "displacements distinguish, pairs of returns (two steps at one place or dstate) that "
        "displacements exclude together, planarity (paths cross only at places). Each time (a "
        "rung of the ladder), report the number and the size of the minimal maps; and, if the "
        "trace has truth, which map is true.",
    )
    parser.add("trace", "trace file (JSON Lines), or - for standard input", type=trace_path)
    add_max_maps(parser, "maps on each rung")
    parser.add("--time-limit S", "stop each search after S seconds", type=float)
    parser.add("--json", "print one JSON object for each rung")
    add_theory(parser)


def run(options: argparse.Namespace) -> int:
    from ssh_abduction.evaluation.rungs import UnderWay, ladder  # loads scipy

    trace, theory = Trace.load(options.trace), theory_of(options)
    rungs: list[Rung] = []
    under_way = UnderWay()

    def written() -> str:
        """The table of all rungs; empty with --json, as each rung was printed when it was found."""
        return "" if options.json else f"{table(HEAD, list(map(_row, rungs)))}\n"

    def last_words(_: Stop) -> tuple[str, int]:
        return written(), interrupted_code()

    interrupt = under_way.interrupt
    with on_ctrl_c(interrupt), Guard(interrupt, last_words) as guard:
        for rung in ladder(
            trace,
            theory,
            time_limit=options.time_limit,
            max_maps=options.maps or None,
            under_way=under_way,
        ):
            rungs.append(rung)
            if options.json:
                guard.say(lambda: f"{json_line(rungs[-1].to_dict())}\n")
        code = interrupted_code() if under_way.interrupted else 0
        guard.finish(code, written)
    return code


def _row(rung: Rung) -> list[object]:
    """Make the row of a rung in the table."""
    data, cost = rung.to_dict(), rung.solution.cost
    counts: Iterator[object] = (
        getattr(cost, name) if cost else UNKNOWN for name in ("dstates", "places", "paths")
    )
    more = "" if rung.solution.complete else "+"
    listed = f"{data['count']}{more}" if data["status"] == "optimal" else f"{data['status']}"
    truth = (
        UNKNOWN if rung.evaluation is None else "none" if rung.rank is None else f"map {rung.rank}"
    )
    accuracy = UNKNOWN if data["accuracy"] is None else f"{data['accuracy']:.3f}"
    return [rung.name, listed, *counts, truth, accuracy, f"{data['seconds']:.2f}"]
