"""The table of hostile and contradictory inputs: each row names tests that exist."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
TABLE = re.compile(r"^\| (?!kind of input|-)(.+) \|$", re.MULTILINE)
ROWS = [row.split(" | ") for row in TABLE.findall((ROOT / "benchmarks/robustness.md").read_text())]


@cache
def names_in(file: str) -> set[str]:
    """The tests that a file defines."""
    return set(re.findall(r"^def (test_\w+)", (ROOT / file).read_text(), re.MULTILINE))


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0][:60])
def test_each_row_names_existing_tests(row: list[str]) -> None:
    assert len(row) == 4
    assert all(cell.strip() for cell in row)
    tests = re.findall(r"(?:(\w+)::)?(\w+)", row[3])
    file = ""
    for named, test in tests:
        file = named or file
        assert f"test_{test}" in names_in(f"tests/test_{file}.py")


def test_each_kind_of_input_has_one_row() -> None:
    kinds = [row[0] for row in ROWS]
    assert len(kinds) > 40
    assert sorted(set(kinds)) == sorted(kinds)
