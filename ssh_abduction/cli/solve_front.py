"""ssh-abduction solve TRACE --front K: the fewest dstates for 0, 1, … K faults.

A fault is an observation or action that the map treats as wrong.
"""

from __future__ import annotations

import argparse

from ssh_abduction.cli.options import theory_of
from ssh_abduction.cli.text import counted, table
from ssh_abduction.data.errors import AbductionError
from ssh_abduction.data.files import json_line
from ssh_abduction.data.schema import attributes_of
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime import program
from ssh_abduction.solver import Front, fault_front
from ssh_abduction.theory.theory import Theory


def run(options: argparse.Namespace) -> int:
    """Print the front: the fewest dstates for each number of faults.

    The exit code is 0 if the search was completed, 20 if no map has so few faults, and 10 if
    the search was stopped.
    """
    several = len(options.traces) > 1 or options.together
    if several or options.jobs is not None or options.scheduler is not None:
        raise AbductionError(
            "--front: expected one trace, got several, or --together, --jobs or --scheduler; ask "
            "for each trace by itself"
        )
    front = fault_front(
        Trace.load(options.traces[0]),
        theory_of(options, Theory.causal()),
        options.front,
        options.time_limit,
    )
    if options.json:
        points = [attributes_of(p, "faults", "dstates", "proven", "map") for p in front.points]
        print(json_line(attributes_of(front, "knee", "prices") | {"front": points}))
    else:
        print(_as_text(front, options.front))
    return 10 if front.stopped else 0 if front.points else 20


def _as_text(front: Front, most: int) -> str:
    """Write a front of at most `most` faults as a table, with sentences below it."""
    if not front.points:
        return (
            f"no map has at most {counted(most, 'faults')}: the asserted pairs of steps (--same, "
            "--different, --elsewhere) contradict what was seen and done; "
            "allow more faults (--front), or assert less"
        )
    rows = []
    for point in front.points:
        faults = "; ".join(map(str, point.map.faults)) if point.map else "–"
        shown = str(point.dstates) if point.proven else f"at least {point.dstates}"
        knee = "knee" if point.faults == front.knee else ""
        rows.append([point.faults, shown, knee, faults or "none"])
    lines = [table(["faults", "dstates", "", "of the map found"], rows)]
    if front.prices:
        lines.append(
            f"if a fault costs more than {front.prices[0]:g} and less than {front.prices[1]:g} "
            "dstates, the map at the knee costs least of these"
        )
    elif not front.stopped and len({point.dstates for point in front.points}) == 1:
        lines.append("no fault saves a dstate")
    elif not front.stopped:
        lines.append("no knee: each further fault saves about as many dstates")
    if front.stopped:
        why = "interrupted" if program.raised else "stopped by the time limit"
        lines.append(f"{why} at {counted(front.points[-1].faults, 'faults')}")
    if first := front.points[0].faults:
        fewest = counted(first, "faults")
        lines.append(f"no map with the asserted pairs of steps has fewer than {fewest}")
    return "\n".join(lines)
