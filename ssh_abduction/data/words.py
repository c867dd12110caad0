"""Values in a few words, for messages and reprs.

>>> counted(8, "dstates"), counted(1, "dstates")
('8 dstates', '1 dstate')
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence, Sized
from dataclasses import MISSING, fields
from typing import Any

from ssh_abduction.data.errors import brief


def counted(number: float, things: str) -> str:
    """Return a number with its noun: "8 dstates", "1 dstate"."""
    return f"{number} {things.removesuffix('s') if number == 1 else things}"


def noun_of(noun: str, things: Sized) -> str:
    """Return a noun in the plural, unless there is one thing: "steps"."""
    return noun if len(things) == 1 else f"{noun}s"


def first_few(things: Sequence[object], most: int) -> str:
    """List the first `most` things: "3, 4", or "3, 4, …" if there are more."""
    return ", ".join([*map(str, things[:most]), *(["…"] if len(things) > most else [])])


def meant(word: object, names: Iterable[str], most: int = 1) -> str:
    """Make a hint such as "; did you mean star?" if names are similar to a word; else "".

    `most` is the largest number of names in the hint.
    """
    by_text = {name.casefold(): name for name in names}
    near = difflib.get_close_matches(str(word).casefold(), by_text, n=most)
    return f"; did you mean {' or '.join(by_text[name] for name in near)}?" if near else ""


def that_differ(value: Any) -> dict[str, str]:
    """Return the fields of a dataclass that differ from their defaults.

    The result is a dict from names of fields to short reprs.
    """
    texts = {}
    for field in fields(value):
        usual = field.default_factory() if field.default_factory is not MISSING else field.default
        if field.repr and (here := getattr(value, field.name)) != usual:
            texts[field.name] = brief(here)
    return texts


def shortly(value: Any) -> str:
    """Return a repr of a dataclass with only those fields that differ from their defaults."""
    fields_told = ", ".join(f"{name}={text}" for name, text in that_differ(value).items())
    return f"{type(value).__name__}({fields_told})"
