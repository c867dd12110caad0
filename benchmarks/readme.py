"""Write the tables of a stored run into benchmarks/performance.md.

    python benchmarks/readme.py RESULTS.json             # of bench.py
    python benchmarks/readme.py RESULTS.json pruning     # of pruning.py

Each table is between two comments that name the table. The text around the comments is kept.
"""

from __future__ import annotations

import argparse
import json
import os
import re
from pathlib import Path
from typing import Any

import pruning
from table import times

ROOT = Path(__file__).parent.parent
PAGES = {
    "peers": ROOT / "benchmarks" / "performance.md",
    "pruning": ROOT / "benchmarks" / "performance.md",
}


def block(name: str, results: dict[str, Any], path: Path) -> str:
    """Make the text for a table: the table, the machine, and where the results are stored.

    Args:
        name: Name of the table, a key of PAGES.
        results: The stored run.
        path: File of the stored run.
    """
    machine, versions = (
        results["machine"],
        ", ".join(f"{package} {number}" for package, number in results["packages"].items()),
    )
    measured = f"{results['date']}, {machine['cpu']}, {machine['cores']} cores"
    source = os.path.relpath(path, PAGES[name].parent).replace(os.sep, "/")
    stored = f"From [`{path.relative_to(ROOT).as_posix()}`]({source}).\n"
    if name == "pruning":
        seeds = f"{results['seeds']} seeds where no other number is named"
        return f"{pruning.table(results)}\n\n{measured}, {seeds}. {stored}"
    limits = f"{results['limit']:g} s and {results['memory']:,} MiB per cell"
    seeds = (
        "one trace of each kind"
        if results["seeds"] == 1
        else f"medians over {results['seeds']} traces of each random kind"
    )
    return (
        f"{_narrow(times(results))}\n\n"
        f"{measured}, Python {machine['python']}, {versions}; {limits}, {seeds}. {stored}"
    )


def _narrow(table: str) -> str:
    """Remove the spaces that align columns, and the memory of other programs."""
    table = re.sub(r"( m?s|memory¹), [\d,]+ MB", r"\1", table)
    return re.sub(" {2,}", " ", re.sub("-{3,}", "--", table))


def rewritten(page: str, name: str, results: dict[str, Any], path: Path) -> str:
    """Return the text of a page, in which a table is replaced by that of a stored run."""
    marked = re.compile(
        rf"(<!-- bench:begin {name} -->\n).*?(<!-- bench:end {name} -->)", re.DOTALL
    )
    return marked.sub(lambda found: found[1] + block(name, results, path) + found[2], page)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("results", type=Path, metavar="RESULTS.json", help="a stored run")
    parser.add_argument(
        "tables", nargs="*", default=["peers"], metavar="TABLE", help="peers (default) or pruning"
    )
    options = parser.parse_args()
    path = options.results.resolve()
    results = json.loads(path.read_text(encoding="utf-8"))
    for name in options.tables:
        page = PAGES[name]
        page.write_text(
            rewritten(page.read_text(encoding="utf-8"), name, results, path), encoding="utf-8"
        )


if __name__ == "__main__":
    main()
