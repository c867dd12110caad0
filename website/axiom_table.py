"""Write the table of axioms of docs/explanation/theory.md from the comments of the encodings.

Run `python website/axiom_table.py` after a change of an axiom. A test compares the page with the
table.
"""

from __future__ import annotations

import re
from pathlib import Path

from ssh_abduction.theory import encodings

PAGE = Path(__file__).parent.parent / "docs" / "explanation" / "theory.md"
BEGIN, END = (
    "<!-- the next table is made by website/axiom_table.py -->\n",
    "\n\n`prefer` lists counts",
)


def table() -> str:
    """Return a row for each axiom: its code, its name, its sentence, and when a theory has it."""
    rows = ["| code | axiom | says | holds if |", "|---|---|---|---|"]
    for axiom in encodings.axioms():
        *_, code = ["–", *axiom.source.split("; ")[1:]]
        ways = [_ways(one) for one in axiom.conditions if one != "level=topological"]
        # A condition that follows from another one says nothing.
        ways = [one for one in ways if not any(set(other) < set(one) for other in ways)]
        said = ", and ".join(dict.fromkeys(" or ".join(one) for one in ways))
        rows.append(f"| {code} | `{axiom.name}` | {axiom.sentence.rstrip('.')} | {said} |")
    return "\n".join(rows)


def _ways(condition: str) -> list[str]:
    """Return the ways to satisfy a condition of an axiom, in Markdown."""
    bare = condition.removeprefix("not ")
    field, _, values = bare.rpartition("=")
    if field and "|" not in field:
        return [f"`{field}={value}`" for value in values.split("|")]
    negated = "not " if bare != condition else ""
    return [f"{negated}`{part}`" for part in bare.split("|")]


def page(text: str) -> str:
    """Return the text of the page with the table."""
    before, rest = text.split(BEGIN)
    return f"{before}{BEGIN}\n{table()}{END}{re.split(re.escape(END), rest, maxsplit=1)[1]}"


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
