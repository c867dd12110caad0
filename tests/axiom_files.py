"""The files in tests/axioms. The file of an axiom has its name, and in it:

CASE     a trace whose answer changes if the axiom is left out, as in `CASES` of test_axioms
BROKEN   a map that breaks the axiom, as the arguments of `case` in test_checker, with its trace as
         a text. The map has no `also`
NAME     a function with the name of the axiom: whether a map of the brute force satisfies it
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

NAMES = sorted(path.stem for path in (Path(__file__).parent / "axioms").glob("*.py"))


def of_each(attribute: str) -> dict[str, Any]:
    """Return this attribute of each file, by the name of its axiom."""
    return {name: getattr(import_module(f"axioms.{name}"), attribute) for name in NAMES}


def predicates() -> dict[str, Callable[..., bool]]:
    """Return the predicate of each file, by the name of its axiom."""
    return {name: getattr(import_module(f"axioms.{name}"), name) for name in NAMES}
