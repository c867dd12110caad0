"""The tables of a stored run, in Markdown.

    python benchmarks/table.py RESULTS.json

The first table has time and memory of all tools, the second one the size of our ground program.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
from collections.abc import Iterable, Sequence
from itertools import permutations
from pathlib import Path
from typing import Any, TypeAlias

OURS = "ssh-abduction"
WITHOUT = " without "  # between the name of our tool and the disabled speed-ups
MARKS = "¹²³⁴⁵⁶⁷⁸⁹"

Cells: TypeAlias = Sequence[dict[str, Any]]


def times(results: dict[str, Any]) -> str:
    """Make the table of time and memory of each tool on each instance."""
    tools = list(dict.fromkeys(cell["tool"] for cell in results["cells"] if cell["tool"] != OURS))
    reasons: list[str] = []
    rows = []
    for name, by_tool in instances(results).items():
        ours = by_tool.get(OURS, [])
        images = next(
            (cell["images"] for cells in by_tool.values() for cell in cells if cell.get("images")),
            0,
        )
        here = (
            [_time(ours, results["limit"]) + _mark(ours, reasons), _memory(ours)]
            if ours
            else ["–", "–"]
        )
        peers = [_peer(by_tool.get(tool, []), results["limit"], reasons) for tool in tools]
        rows.append(
            [
                name,
                f"{images:,}",
                dstates([cell for cells in by_tool.values() for cell in cells]),
                *here,
                *peers,
            ]
        )
    notes = [f"{mark} {reason}" for mark, reason in zip(MARKS, reasons, strict=False)]
    return "\n".join(
        [
            _markdown(["instance", "steps", "dstates", "time", "MB", *tools], rows),
            *(["", "; ".join(notes)] if notes else []),
        ]
    )


def grounding(results: dict[str, Any]) -> str:
    """Make the table of the size of our ground program, and of our times to ground and solve."""
    rows = []
    for name, by_tool in instances(results).items():
        cells = [cell for cell in by_tool.get(OURS, []) if cell.get("rules") is not None]
        if cells:
            rules, atoms, ground, solve, seconds, prefix = (
                statistics.median(cell[key] for cell in cells)
                for key in ("rules", "atoms", "ground", "solve", "seconds", "prefix")
            )
            counts = [f"{count:,.0f}" for count in (prefix, rules, atoms)]
            rows.append(
                [
                    name,
                    *counts,
                    *(f"{s:.3f}" for s in (ground, solve, seconds)),
                    f"{solve / seconds:.0%}",
                ]
            )
    return _markdown(
        [
            "instance",
            "steps given",
            "rules",
            "atoms",
            "ground, s",
            "solve, s",
            "in all, s",
            "solving",
        ],
        rows,
    )


def contradictions(results: dict[str, Any]) -> list[str]:
    """Describe wrong answers: failed checks, and fewer states than another tool proved possible.

    Returns:
        A line for each; none if there are no wrong answers.
    """
    found = [
        f"{c['instance']}, seed {c['seed']}: {c['tool']}: {c['reason']}"
        for c in results["cells"]
        if c["status"] == "wrong"
    ]
    for name, by_tool in instances(results).items():
        for low, high in permutations([cell for cells in by_tool.values() for cell in cells], 2):
            proven = low["dstates"] if low.get("proven") else low.get("bound") or 0
            if high["seed"] == low["seed"] and (high.get("dstates") or math.inf) < proven:
                found += [
                    f"{name}, seed {low['seed']}: {low['tool']} proved {proven} states, "
                    f"{high['tool']} found {high['dstates']}"
                ]
    return found


def instances(results: dict[str, Any]) -> dict[str, dict[str, list[dict[str, Any]]]]:
    """Group the cells of a stored run: a dict from instance to tool to a cell for each seed."""
    found: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for cell in results["cells"]:
        found.setdefault(cell["instance"], {}).setdefault(cell["tool"], []).append(cell)
    return found


def median_seconds(cells: Cells) -> float:
    """Compute the median seconds over the seeds. A seed without an answer counts as infinite."""
    return statistics.median(
        cell["seconds"] if cell["status"] == "ok" else math.inf for cell in cells
    )


def dstates(cells: Cells) -> str:
    """Format the median, over the seeds, of the fewest dstates.

    It is a number if it is proven by a tool, and otherwise the range from the lower bound to the
    best map.
    """
    known = {cell["seed"]: cell["dstates"] for cell in cells if cell.get("proven")}
    if known:
        return f"{statistics.median(known.values()):,g}"
    seeds = {cell["seed"] for cell in cells}
    bounds = [
        max(counts)
        for seed in seeds
        if (counts := [c["bound"] for c in cells if c["seed"] == seed and c.get("bound")])
    ]
    found = [
        min(counts)
        for seed in seeds
        if (counts := [c["dstates"] for c in cells if c["seed"] == seed and c.get("dstates")])
    ]
    low, high = (f"{statistics.median(counts):,g}" if counts else "" for counts in (bounds, found))
    return (
        f"{low} – {high}" if low and high else f"≥ {low}" if low else f"≤ {high}" if high else "–"
    )


def _peer(cells: Cells, limit: float, reasons: list[str]) -> str:
    """The cell of another program: time and memory.

    If its machine is not proven minimal, the cell also has the number of states.
    """
    if not any("seconds" in cell for cell in cells):
        return "–" + _mark(cells, reasons)
    unproven = [cell["dstates"] for cell in cells if cell["status"] == "ok" and not cell["proven"]]
    states = [f"{statistics.median(unproven):,g} states"] if unproven else []
    return ", ".join([_time(cells, limit) + _mark(cells, reasons), f"{_memory(cells)} MB", *states])


def _time(cells: Cells, limit: float) -> str:
    """The median time over the seeds as text, or the reason why there is none."""
    seconds = median_seconds(cells)
    failed = {cell["status"] for cell in cells} - {"ok", "timeout"}
    text = (
        _duration(seconds) if seconds < math.inf else " / ".join(sorted(failed)) or f"> {limit:g} s"
    )
    return text + (
        f" ({sum(cell['status'] == 'ok' for cell in cells)} of {len(cells)})"
        if len(cells) > 1
        else ""
    )


def _memory(cells: Cells) -> str:
    peaks = [cell["memory"] for cell in cells if "memory" in cell]
    return f"{statistics.median(peaks):,.0f}" if peaks else "–"


def _mark(cells: Cells, reasons: list[str]) -> str:
    """The mark of the note that says why there is no answer; empty if there is one.

    A new note is added to `reasons`.
    """
    reason = next((cell["reason"] for cell in cells if cell.get("reason")), "").removesuffix(
        ": "
    )  # an error may have no message
    if reason and reason not in reasons:
        reasons.append(reason)
    return MARKS[reasons.index(reason) % len(MARKS)] if reason else ""


def _duration(seconds: float) -> str:
    return f"{_figures(1000 * seconds)} ms" if seconds < 0.1 else f"{_figures(seconds)} s"


def _figures(number: float) -> str:
    """Format a number with two significant figures; from ten on, as a whole number."""
    return (
        f"{number:,.0f}"
        if number >= 9.95
        else f"{number:.1f}"
        if number >= 0.995
        else f"{number:.2g}"
    )


def _markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [header, *rows]
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    rule = ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]
    aligned = [
        [
            line[0].ljust(widths[0]),
            *(text.rjust(w) for text, w in zip(line[1:], widths[1:], strict=True)),
        ]
        for line in lines
    ]
    return "\n".join("| " + " | ".join(line) + " |" for line in (aligned[0], rule, *aligned[1:]))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("results", type=Path, metavar="RESULTS.json", help="a stored run")
    results = json.loads(parser.parse_args().results.read_text(encoding="utf-8"))
    print(f"{times(results)}\n\n{grounding(results)}")


if __name__ == "__main__":
    main()
