"""A user's own rules, written with the predicates of the encodings.

>>> from ssh_abduction.theory.rules import Rules
>>> text = "% @axiom(brief) No dstate is seen again after step 9.\\n#program step(t)."
>>> rules = Rules("own.lp", text + "\\nviolation(brief,t) :- same(I,t), t > 9.")
>>> [axiom.sentence for axiom in rules.axioms]
['No dstate is seen again after step 9.']
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

# The most bytes of a file of rules. This rejects devices that never end.
LARGEST = 2**24
# Outside of block comments, match strings, line comments and the start of a block comment: these
# may contain any character. The group matches what rules must not contain: a character that is not
# ASCII, or `#script`, because % starts no comment in a script.
_OUTSIDE = re.compile(r'"(?:\\["\\n]|[^"\\\n])*"|%\*|%[^\n]*|([^\x01-\x7f]|#script\b)')
# Inside of block comments, which nest, match their start and end, and line comments: a start or end
# in a line comment does not count.
_INSIDE = re.compile(r"%\*|\*%|%[^\n]*")


@dataclass(frozen=True)
class Rules:
    """A file of rules.

    Line ends of the text are converted to line feeds, and a byte order mark is removed.
    `ssh_abduction.solver.asp.own_rules` checks that clingo can read the text.

    Attributes:
        name: The name of the file, for messages.
        text: Its content.
    """

    name: str
    text: str = field(repr=False)

    def __post_init__(self) -> None:
        """Convert the line ends. Raise TheoryError for a text that would stop clingo's lexer."""
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
        # Clingo stops at characters outside of ASCII, and at NUL, without naming the line.
        stray = text.find("\0")
        if stray < 0:
            stray = _stray(text)
        if stray >= 0:
            line, column = text.count("\n", 0, stray) + 1, stray - text.rfind("\n", 0, stray)
            if text.startswith("#script", stray):
                raise TheoryError(
                    f"{self.name}:{line}: expected rules, got #script; write rules instead, as "
                    "scripts are not run"
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
        """The axioms that the text declares in comments `% @axiom(name) sentence`."""
        return tuple(axioms_in(self.text, self.name))

    @classmethod
    def of(cls, value: Any) -> Rules:
        """Make Rules from the path of a file, or from a dict with `name` and `text`.

        Rules are returned as they are. Raises TheoryError if the file cannot be read, or
        has wrong characters.
        """
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
                f"rules: {brief(str(value))} cannot be read: {reason}; {mend} (--set rules=FILE)"
            ) from None
        return cls(str(value), text)

    @classmethod
    def all_of(cls, value: Any) -> tuple[Rules, ...]:
        """Make a tuple of Rules from one value, as for `of`, or a list. Raises TheoryError.

        A text may contain several paths, separated by commas.
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
    """Return the position of the first character or script that is not allowed; -1 without one."""
    depth = at = 0
    while found := (_INSIDE if depth else _OUTSIDE).search(text, at):
        if found.re is _OUTSIDE and found[1]:
            return found.start()
        depth += (found[0] == "%*") - (found[0] == "*%")
        at = found.end()
    return -1
