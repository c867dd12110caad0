"""A name means one thing: no two modules share a name, no two classes, and no two public functions.
Names of tests are short."""

from __future__ import annotations

import ast
import re
from collections import Counter
from pathlib import Path

from modules import parsed

ROOT = Path(__file__).parent.parent


# Modules of one kind have these: processes, readers of logs, and workers.
IN_EACH = {"run", "read", "serve"}


def names(kind: type[ast.ClassDef | ast.FunctionDef]) -> list[str]:
    """The names of all classes, or functions, at the top of a module."""
    return [
        node.name
        for folder in ("ssh_abduction", "perception", "simulator")
        for path in sorted((ROOT / folder).rglob("*.py"))
        for node in parsed(path).body
        if isinstance(node, kind)
    ]


def test_no_two_modules_share_a_name() -> None:
    found = Counter(
        path.stem
        for folder in ("ssh_abduction", "perception", "simulator")
        for path in (ROOT / folder).rglob("*.py")
        if not path.stem.startswith("__")
    )
    assert len(found) > 150
    assert {name: count for name, count in found.items() if count > 1} == {"errors": 3}


def test_no_two_classes_share_a_name() -> None:
    found = Counter(name.lstrip("_") for name in names(ast.ClassDef))
    assert len(found) > 400
    assert {name: count for name, count in found.items() if count > 1} == {}


def test_no_two_public_functions_share_a_name() -> None:
    found = Counter(name for name in names(ast.FunctionDef) if not name.startswith("_"))
    assert len(found) > 400
    shared = {name: count for name, count in found.items() if count > 1 and name not in IN_EACH}
    assert shared == {}


def test_names_of_tests_have_at_most_80_characters() -> None:
    found = [
        name
        for path in sorted((ROOT / "tests").glob("test_*.py"))
        for name in re.findall(r"^def (test_\w+)", path.read_text(encoding="utf-8"), re.MULTILINE)
    ]
    assert len(found) > 1000
    assert [name for name in found if len(name) > 80] == []
