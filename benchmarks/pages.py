"""Helpers for benchmarks that write the rows of a table into a page of the documentation."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path


def seeds_from(text: str) -> list[int]:
    """Parse a range of seeds such as 300-309, or a single seed.

    >>> seeds_from("300-302"), seeds_from("7")
    ([300, 301, 302], [7])
    """
    first, _, last = text.partition("-")
    return list(range(int(first), int(last or first) + 1))


def print_rows(rows: Iterable[str], page: Path | None, begin: str) -> None:
    """Print rows as they are made. If a page is given, replace its rows by them.

    Args:
        rows: The lines of the table.
        page: The page; None to print only.
        begin: Regular expression for the beginning of the first row to replace. The rows of the
            page end before the next empty line.
    """
    lines = []
    for line in rows:
        print(line, flush=True)
        lines.append(line)
    if page:
        table = re.compile(rf"{begin}.*?(?=\n\n)", re.DOTALL)
        page.write_text(table.sub(lambda _: "\n".join(lines), page.read_text()))
