"""Writes the table of a stored run into the README, or into another page.

    python benchmarks/readme.py RESULTS.json [PAGE]

It stands between two comments that mark it; what is around them stays.
"""

from __future__ import annotations

import json
import os
import re
import sys
from pathlib import Path
from typing import Any

from table import times

ROOT = Path(__file__).parent.parent
BLOCK = re.compile(r"(<!-- bench:begin -->\n).*(<!-- bench:end -->)", re.DOTALL)


def block(results: dict[str, Any], source: str) -> str:
    """What stands between the markers: the table, and what it was measured on."""
    machine, versions = results["machine"], ", ".join(f"{name} {number}" for name, number in results["packages"].items())
    seeds = "one trace of each kind" if results["seeds"] == 1 else f"medians over {results['seeds']} traces of each random kind"
    return (
        f"{times(results)}\n\n"
        f"{results['date']}, {machine['cpu']}, {machine['cores']} cores, Python {machine['python']}, {versions}; "
        f"{results['limit']:g} s and {results['memory']:,} MiB a cell, {seeds}. From [`{source}`]({source}).\n"
    )


def rewritten(readme: str, results: dict[str, Any], source: str) -> str:
    """The README with the table of these results."""
    return BLOCK.sub(lambda found: found[1] + block(results, source) + found[2], readme)


def main() -> None:
    path = Path(sys.argv[1]).resolve()
    page = Path(sys.argv[2]).resolve() if len(sys.argv) > 2 else ROOT / "README.md"
    results = json.loads(path.read_text(encoding="utf-8"))
    source = os.path.relpath(path, page.parent).replace(os.sep, "/")
    page.write_text(rewritten(page.read_text(encoding="utf-8"), results, source), encoding="utf-8")


if __name__ == "__main__":
    main()
