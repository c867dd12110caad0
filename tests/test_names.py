"""A name means one thing: no two classes of the packages share a name."""

from __future__ import annotations

import ast
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parent.parent


def classes() -> list[str]:
    """The names of all classes at the top of a module, without leading underscores."""
    return [
        node.name.lstrip("_")
        for folder in ("ssh_abduction", "perception", "simulator")
        for path in sorted((ROOT / folder).rglob("*.py"))
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef)
    ]


def test_no_two_classes_share_a_name() -> None:
    found = Counter(classes())
    assert len(found) > 400
    assert {name: count for name, count in found.items() if count > 1} == {}
