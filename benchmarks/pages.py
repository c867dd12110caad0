"""Helpers for benchmarks that write the rows of a table into a page of the documentation."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path


def seeds_from(text: str) -> list[int]:
    """The seeds of a range such as 300-309, or the one seed.

    >>> seeds_from("300-302"), seeds_from("7")
    ([300, 301, 302], [7])
    """
    first, _, last = text.partition("-")
    return list(range(int(first), int(last or first) + 1))


def print_rows(rows: Iterable[str], page: Path | None, begin: str) -> None:
    """Print the rows as they come, and replace those of a page if one is given.

    Args:
        rows: The lines of the table.
        page: The page, or None.
        begin: Regular expression for the beginning of the first row to replace. The last one is
            followed by an empty line.
    """
    lines = []
    for line in rows:
        print(line, flush=True)
        lines.append(line)
    if page:
        table = re.compile(rf"{begin}.*?(?=\n\n)", re.DOTALL)
        page.write_text(table.sub(lambda _: "\n".join(lines), page.read_text()))
