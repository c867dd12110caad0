"""ssh-abduction repair: find the wrong edges of a graph that somebody else made."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from ssh_abduction.cli import shared
from ssh_abduction.cli.parsing import verb
from ssh_abduction.cli.text import counted
from ssh_abduction.data.errors import MapError, printable
from ssh_abduction.data.files import json_line


@verb(
    {
        "graph": (
            "graph of places and moves: GraphML, node-link JSON, or a JSON list of edges such as "
            '{"source": "hall", "action": "east", "target": "kitchen"}'
        ),
        "--set most K=20": "list at most K smallest repairs",
        "--set without NAMES": (
            "axioms to leave out, separated by commas, such as ordered for a maze in which going "
            "north leads around to where you began",
            {"default": ""},
        ),
        **shared.JSON,
    }
)
def run_repair(options: argparse.Namespace) -> int:
    """Find the wrong edges of a graph that contradicts itself.

    A language model, a person or a program made a graph of places and of the moves between them.
    Find every smallest set of edges to drop, or to turn into another action, after which the axioms
    hold: one action leads to one place, the opposite action leads back, and going north only never
    leads around. The edges that all smallest repairs blame are wrong, if any so small set is.
    """
    from ssh_abduction.explain.graph_repair import Repairs, read_moves, repair  # loads clingo

    if options.most < 1:
        raise MapError(f"most: expected 1 or more, got {options.most}; leave it out for 20")

    def lines(found: Repairs) -> Iterator[str]:
        all_edges = f"{counted(len(found.moves), 'edges')}"
        if not found.fewest:
            yield f"{all_edges}: no contradiction"
            return
        some = "" if found.complete else " or more"
        yield (
            f"{all_edges}: at least {found.fewest} wrong; "
            f"{counted(len(found.repairs), 'smallest repairs')}{some}"
        )
        for edges, axioms in found.clashes:
            yield f"  these clash ({', '.join(axioms)}): {'; '.join(map(said, edges))}"
        if len(found.clashes) < found.fewest:
            yield (
                f"  no edge is in two of these, so at least {len(found.clashes)} are wrong; clingo "
                f"proved that no {found.fewest - 1} suffice"
            )
        else:
            yield f"  no edge is in two of these, so at least {found.fewest} are wrong"
        blamed = "; ".join(map(said, found.blamed)) or "none"
        yield f"blamed in every smallest repair: {blamed}"
        for number, (wrong, turns) in enumerate(zip(found.repairs, found.turns, strict=True), 1):
            yield f"repair {number}"
            for edge, actions in zip(wrong, turns, strict=True):
                turned = f", or turn it to {' or '.join(actions)}" if actions else ""
                yield f"  drop {said(edge)}{turned}"

    moves = read_moves(options.graph)
    without = [name.strip() for name in options.without.split(",") if name.strip()]
    found = repair(moves, without=without, most=options.most)

    def said(edge: int) -> str:
        return f"edge {edge + 1} ({found.moves[edge]})"

    print(json_line(found.to_dict()) if options.json else printable_lines(lines(found)))
    return 0


def printable_lines(lines: Iterator[str]) -> str:
    """Join lines, with control characters escaped."""
    return "\n".join(map(printable, lines))
