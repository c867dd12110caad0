"""Values in a few words, as messages and the reprs of values say them.

>>> counted(8, "dstates"), counted(1, "dstates")
('8 dstates', '1 dstate')
"""

from __future__ import annotations

from dataclasses import MISSING, fields
from typing import Any

from ssh_abduction.data.errors import brief


def counted(number: float, things: str) -> str:
    """8 dstates, 1 dstate."""
    return f"{number} {things.removesuffix('s') if number == 1 else things}"


def that_differ(value: Any) -> dict[str, str]:
    """The fields of a dataclass that are shown and are not what they are unless somebody says so, each with its repr, cut where it is long."""
    told = {}
    for field in fields(value):
        usual = field.default_factory() if field.default_factory is not MISSING else field.default
        if field.repr and (here := getattr(value, field.name)) != usual:
            told[field.name] = brief(here)
    return told


def shortly(value: Any) -> str:
    """A dataclass as a call that makes it, with the fields alone that are not what they are unless somebody says so."""
    return f"{type(value).__name__}({', '.join(f'{name}={text}' for name, text in that_differ(value).items())})"
