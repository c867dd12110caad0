"""Write docs/reference/schedule.md from the schedule of the solver.

python website/schedule_table.py
"""

from __future__ import annotations

import math
from pathlib import Path

from ssh_abduction.solver.schedule import TABLE, SourceTurn

PAGE = Path(__file__).parent.parent / "docs" / "reference" / "schedule.md"
HEAD = (
    "# The schedule of a search\n\n"
    "A search runs *sources*. Each source makes maps, or proves a lower bound on the cost of all "
    "maps. The sources run in the order of these tables until a map costs no more than the bound, "
    "or no work is left. The tables are made from `ssh_abduction/solver/schedule.py`, which is the "
    "only place for these numbers.\n\n"
    "* **Share** is the share of the work left when the source begins. *By the share* means that "
    "the source ends when this share of the whole limit is used up.\n"
    "* A unit of work is about a second of a quiet core. Without a work limit, seconds count "
    "instead.\n"
)
COLUMNS = "| source | for which problems | share | why |"


def share_of(turn: SourceTurn) -> str:
    """Return the share of a turn in words."""
    parts = [f"{turn.share:.0%}"] if turn.share < 1 else []
    parts += [f"by the share {turn.until:.0%}"] if turn.until < 1 else []
    parts += [f"at most {turn.most:g} units"] if turn.most < math.inf else []
    return ", ".join(parts) or "the rest"


def page() -> str:
    """Return the text of the page."""
    lines = [HEAD]
    for title, turns in TABLE.items():
        lines += [
            f"## {title}\n",
            "| source | for which problems | share | why |",
            "|---|---|---|---|",
        ]
        lines += [
            f"| {turn.name} | {turn.problems} | {share_of(turn)} | {turn.why} |" for turn in turns
        ]
        lines.append("")
    return "\n".join(lines)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
