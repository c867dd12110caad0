"""A user's own rules, written over the predicates of the encodings, as part of a theory.

>>> from ssh_abduction.theory.rules import Rules >>> rules = Rules("own.lp", "% @axiom(brief) No
dstate is seen again later.\\n#program step(t).\\nviolation(brief,t) :- same(I,t), t > 9.") >>>
[axiom.sentence for axiom in rules.axioms] ['No dstate is seen again later.']
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from ssh_abduction.data.errors import TheoryError, brief, is_writable
from ssh_abduction.data.files import read_at_most
from ssh_abduction.theory.encodings import Axiom, axioms_in

# Bytes that a file of rules may have: a device that never ends is refused before it fills the
# memory.
LARGEST = 2**24
# What may hold any character outside of a block comment, or opens one; the group is what rules
# cannot have: other characters than ASCII, and scripts, in which % is no comment.
_OUTSIDE = re.compile(r'"(?:\\["\\n]|[^"\\\n])*"|%\*|%[^\n]*|([^\x01-\x7f]|#script\b)')
# What opens and closes block comments, which nest, and hides both.
_INSIDE = re.compile(r"%\*|\*%|%[^\n]*")


@dataclass(frozen=True)
class Rules:
    """A file of rules: its name, for messages, and its text.

    `ssh_abduction.solver.asp.rules` says whether clingo can read it.

    A byte order mark is dropped, and each line ends in a line feed.
    """

    name: str
    text: str = field(repr=False)

    def __post_init__(self) -> None:
        """Raises TheoryError for a text that clingo's lexer cannot take: it aborts the process, or ends without a word where a null character is."""
        if not isinstance(self.name, str) or not isinstance(self.text, str):
            raise TheoryError(
                f"rules: expected a name and a text, got {brief(self.name)} and "
                f"{brief(self.text)}; read them from a file"
            )
        if not is_writable(self.text):
            raise TheoryError(
                f"{self.name}: expected a text, got one with half a character (a surrogate); save "
                "it as UTF-8"
            )
        text = self.text.removeprefix("\ufeff").replace("\r\n", "\n").replace("\r", "\n")
        object.__setattr__(self, "text", text)
        stray = text.find("\0")
        if stray < 0:
            stray = _stray(text)
        if stray >= 0:
            line, column = text.count("\n", 0, stray) + 1, stray - text.rfind("\n", 0, stray)
            if text.startswith("#script", stray):
                raise TheoryError(
                    f"{self.name}:{line}: expected rules, got #script; say it in rules, as no "
                    "program runs in them"
                )
            mend = (
                "save it as UTF-8"
                if text[stray] == "\0"
                else 'put it in quotes, as in "é", or write it in ASCII'
            )
            raise TheoryError(
                f"{self.name}:{line}:{column}: expected ASCII outside of quotes and comments, got "
                f"{text[stray]!r} (U+{ord(text[stray]):04X}); {mend}"
            )

    @property
    def axioms(self) -> tuple[Axiom, ...]:
        """The axioms that comments `% @axiom(name) sentence` name."""
        return tuple(axioms_in(self.text, self.name))

    @classmethod
    def of(cls, value: Any) -> Rules:
        """Rules, a path of a file, or what `to_dict` made of rules. Raises TheoryError."""
        if isinstance(value, Rules):
            return value
        if (
            isinstance(value, Mapping)
            and isinstance(value.get("name"), str)
            and isinstance(value.get("text"), str)
        ):
            return cls(value["name"], value["text"])
        if not isinstance(value, str | os.PathLike) or not str(value):
            raise TheoryError(
                f"rules: expected files of rules, got {brief(value)}; give their paths, as in "
                "rules=['own.lp']"
            )
        try:
            text = read_at_most(value, LARGEST).decode("utf-8")
        except (OSError, ValueError) as error:
            is_text = not isinstance(error, UnicodeError)
            reason = (getattr(error, "strerror", None) or error) if is_text else "no text in UTF-8"
            mend = "check the path" if is_text else "save it as UTF-8"
            raise TheoryError(
                f"rules: {brief(str(value))} cannot be read: {reason}; {mend} (--rules)"
            ) from None
        return cls(str(value), text)

    @classmethod
    def all_of(cls, value: Any) -> tuple[Rules, ...]:
        """Rules in a list, or a single one; paths as text may have commas between.

        Raises TheoryError.
        """
        if isinstance(value, str):
            value = [part.strip() for part in value.split(",") if part.strip()]
        elif isinstance(value, Rules | os.PathLike | Mapping):
            value = [value]
        if not isinstance(value, Iterable):
            raise TheoryError(
                f"rules: expected a list of files of rules, got {brief(value)}; give their paths, "
                "as in rules=['own.lp']"
            )
        return tuple(map(cls.of, value))


def _stray(text: str) -> int:
    """Where the first character that is not ASCII is outside of quotes and comments, or the first script; -1 where there is none."""
    depth = at = 0
    while found := (_INSIDE if depth else _OUTSIDE).search(text, at):
        if found.re is _OUTSIDE and found[1]:
            return found.start()
        depth += (found[0] == "%*") - (found[0] == "*%")
        at = found.end()
    return -1
