"""ssh-abduction repair: find the wrong edges of a graph that somebody else made."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from ssh_abduction.cli.outcome import EXIT_UNPROVEN, Guard, on_ctrl_c
from ssh_abduction.cli.parsing import verb
from ssh_abduction.cli.text import counted
from ssh_abduction.data.errors import MapError, printable
from ssh_abduction.data.files import json_line
from ssh_abduction.runtime.program import interrupted_code

# The limits of the search, and their units.
LIMITS = {"time": "seconds", "work": "units of work", "memory": "MiB"}


@verb({"without": {"default": ""}})
def run_repair(options: argparse.Namespace) -> int:
    """Find the wrong edges of a graph that contradicts itself.

    A language model, a person or a program made a graph of places and of the moves between them.
    Find every smallest set of edges to drop, or to turn into another action, after which the axioms
    hold: one action leads to one place, the opposite action leads back and only there, and a way
    that only goes north never ends where it began. If the graph has no more wrong edges than a
    smallest repair, then the edges that all smallest repairs blame are wrong.

    Exit codes: 0 done; 10 with --strict, if a limit ended the search.
    """
    from ssh_abduction.data.checks import check_limit
    from ssh_abduction.explain.graph_repair import Repairs, read_moves, repair  # loads clingo
    from ssh_abduction.runtime.limits import Watch

    if options.most < 1:
        raise MapError(f"most: expected 1 or more, got {options.most}; leave it out for 20")

    for name, unit in LIMITS.items():
        check_limit(f"--{name}-limit", unit, getattr(options, f"{name}_limit"))

    def lines(found: Repairs) -> Iterator[str]:
        all_edges = f"{counted(len(found.moves), 'edges')}"
        if not found.fewest:
            yield f"{all_edges}: no contradiction"
            return
        many = counted(len(found.repairs), "smallest repairs")
        many += "" if found.complete else " or more"
        if found.least < found.fewest:
            many = f"the smallest repair found drops {found.fewest}, and smaller ones may exist"
        why = f" (search stopped: {found.stopped})" if found.stopped else ""
        yield f"{all_edges}: at least {found.least} wrong; {many}{why}"
        for edges, axioms in found.clashes:
            yield f"  these clash ({', '.join(axioms)}): {'; '.join(map(said, edges))}"
        if found.clashes:
            proved = f"; clingo proved that no {found.least - 1} suffice"
            yield (
                f"  no edge is in two of these, so at least {len(found.clashes)} are wrong"
                f"{proved if len(found.clashes) < found.least else ''}"
            )
        blamed = "; ".join(map(said, found.blamed or ())) or "none"
        yield (
            "blamed in every smallest repair: "
            f"{'unknown, as the search was stopped' if found.blamed is None else blamed}"
        )
        for number, (wrong, turns) in enumerate(zip(found.repairs, found.turns, strict=True), 1):
            yield f"repair {number}"
            for i, edge in enumerate(wrong):
                actions = turns[i] if turns else ()
                turned = f", or turn it to {' or '.join(actions)}" if actions else ""
                yield f"  drop {said(edge)}{turned}"
            if turns is None:
                yield "  whether another action mends an edge is unknown, as the search was stopped"

    moves = read_moves(options.graph)
    without = [name.strip() for name in options.without.split(",") if name.strip()]
    watch = Watch(options.time_limit, options.memory_limit, work=options.work_limit)

    def interrupt() -> None:
        watch.interrupted = True

    with on_ctrl_c(interrupt), Guard(interrupt):
        found = repair(moves, without=without, most=options.most, watch=watch)

    def said(edge: int) -> str:
        return f"edge {edge + 1} ({found.moves[edge]})"

    print(json_line(found.to_dict()) if options.json else printable_lines(lines(found)))
    if found.stopped == "interrupted":
        return interrupted_code()
    return EXIT_UNPROVEN if found.stopped else 0


def printable_lines(lines: Iterator[str]) -> str:
    """Join lines, with control characters escaped."""
    return "\n".join(map(printable, lines))
