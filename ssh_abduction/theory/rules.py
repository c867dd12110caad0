"""A user's own rules, written over the predicates of the encodings, as part of a theory.

>>> from ssh_abduction.theory.rules import Rules
>>> rules = Rules("own.lp", "% @axiom(brief) No dstate is seen again later.\\n#program step(t).\\nviolation(brief,t) :- same(I,t), t > 9.")
>>> [axiom.sentence for axiom in rules.axioms]
['No dstate is seen again later.']
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from ssh_abduction.errors import TheoryError, brief
from ssh_abduction.files import read_at_most
from ssh_abduction.theory.encodings import Axiom, axioms_in

# Bytes that a file of rules may have: a device that never ends is refused before it fills the memory.
LARGEST = 2**24


@dataclass(frozen=True)
class Rules:
    """A file of rules: its name, for messages, and its text. `ssh_abduction.asp.rules` says whether clingo can read it."""

    name: str
    text: str = field(repr=False)

    @property
    def axioms(self) -> tuple[Axiom, ...]:
        """The axioms that comments `% @axiom(name) sentence` name."""
        return tuple(axioms_in(self.text, self.name))

    @classmethod
    def of(cls, value: Any) -> Rules:
        """Rules, a path of a file, or what `to_dict` made of rules. Raises TheoryError."""
        if isinstance(value, Rules):
            return value
        if isinstance(value, Mapping) and isinstance(value.get("name"), str) and isinstance(value.get("text"), str):
            return cls(value["name"], value["text"])
        if not isinstance(value, str | os.PathLike) or not str(value):
            raise TheoryError(f"rules: expected files of rules, got {brief(value)}; give their paths, as in rules=['own.lp']")
        try:
            return cls(str(value), read_at_most(value, LARGEST).decode("utf-8"))
        except (OSError, ValueError) as error:
            reason = "no text in UTF-8" if isinstance(error, UnicodeError) else getattr(error, "strerror", None) or error
            raise TheoryError(f"rules: {brief(str(value))} cannot be read: {reason}; check the path (--rules)") from None

    @classmethod
    def all_of(cls, value: Any) -> tuple[Rules, ...]:
        """Rules in a list, or a single one; paths as text may have commas between. Raises TheoryError."""
        if isinstance(value, str):
            value = [part.strip() for part in value.split(",") if part.strip()]
        elif isinstance(value, Rules | os.PathLike | Mapping):
            value = [value]
        if not isinstance(value, Iterable):
            raise TheoryError(f"rules: expected a list of files of rules, got {brief(value)}; give their paths, as in rules=['own.lp']")
        return tuple(map(cls.of, value))
