"""Find the encodings (`.lp` files), and read in their comments what each axiom says.

The comments also say for which theories an axiom holds, and declare the fields of `Theory` that
switch it on. `Rules` are a user's own encoding.

>>> text = "% @axiom(brief) No dstate is seen again after step 9.\\n#program step(t)."
>>> rules = Rules("own.lp", text + "\\nviolation(brief,t) :- same(I,t), t > 9.")
>>> [axiom.sentence for axiom in rules.axioms]
['No dstate is seen again after step 9.']
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from ssh_abduction.data.checks import a_list
from ssh_abduction.data.errors import TheoryError, brief, is_writable
from ssh_abduction.data.files import read_at_most, shipped

# Each of these files needs the ones before it. Files that users add follow, sorted by name.
FIRST = ("causal", "topological", "boundary", "star", "gateways")
_AXIOM = re.compile(
    r"^% @axiom\((?P<name>\w+)\) (?:(?P<sentence>.+?) \[(?P<source>[^\]]+)\](?: if "
    r"(?P<when>.+))?|(?P<alone>.+))$"
)
_FIELD = re.compile(r"^% @field\((?P<name>\w+), (?P<default>false|true|\d+), (?P<help>.+\.)\)$")
_WHEN = re.compile(r"^% @when (?P<when>.+)$")
_KEEPS = re.compile(r"^% @keeps (?P<names>.+)$")
_WITH = re.compile(r"^% @with (?P<names>.+)$")
_T = TypeVar("_T")
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
class Axiom:
    """An axiom, as the comments of its encoding describe it.

    A condition is a text about the fields of a theory, such as "star=frame".

    Attributes:
        name: The name, as in `violation(name,…)`.
        sentence: What the axiom says.
        source: The publication that it is from; may be empty.
        level: The name of its encoding.
        subject: Conditions for a theory to have what the axiom is about, such as stars (`% @when`).
        conditions: All conditions for a theory to have the axiom: `subject`, and those after `if`
            in the comment of the axiom.
    """

    name: str
    sentence: str
    source: str
    level: str
    subject: tuple[str, ...]
    conditions: tuple[str, ...]

    def holds_in(self, choices: Mapping[str, object]) -> bool:
        """Whether a theory with these values of its fields has the axiom."""
        return all(_holds(condition, choices) for condition in self.conditions)

    def has_subject_in(self, choices: Mapping[str, object]) -> bool:
        """Whether a theory with these values of fields has what the axiom is about."""
        return all(_holds(condition, choices) for condition in self.subject)


@dataclass(frozen=True)
class Field:
    """A field of `Theory` that an encoding declares, as `% @field(NAME, DEFAULT, Help.)`.

    Attributes:
        name: The name.
        default: True or False for a choice, or a whole number, 0 or more.
        help: A sentence that says what the value means.
    """

    name: str
    default: bool | int
    help: str


def _holds(condition: str, choices: Mapping[str, object]) -> bool:
    """Whether a condition holds in a theory with these fields.

    The condition is `field=value|value` (the field has one of these values), `field` or
    `field|field` (one of these fields is true), `field|field=value` (one of both), or `not field`.
    """
    if condition.startswith("not "):
        return not choices[condition.removeprefix("not ")]
    before, _, values = condition.partition("=")
    *fields, last = before.split("|")
    holds = choices[last] in values.split("|") if values else choices[last]
    return bool(holds) or any(choices[field] for field in fields)


def folder() -> Path:
    """Return the folder of the encodings, in the installed package or beside it in a checkout."""
    return shipped("encodings")


def path(name: str) -> str:
    """Return the path of an encoding by its name, in the folder of axioms or a subfolder."""
    files = [folder() / part / f"{name}.lp" for part in ("", "fast", "derived", "graphs")]
    return str(next((file for file in files if file.exists()), files[-1]))


@cache
def levels() -> tuple[str, ...]:
    """Return the names of all encodings with axioms, also of users, in the order to load them."""
    found = [
        file.stem
        for file in folder().glob("*.lp")
        if "\n% @axiom(" in file.read_text(encoding="utf-8")
    ]
    return tuple(
        sorted(found, key=lambda name: (FIRST.index(name) if name in FIRST else len(FIRST), name))
    )


@cache
def axioms() -> tuple[Axiom, ...]:
    """Return all axioms, in the order of the files."""
    return tuple(
        axiom
        for level in levels()
        for axiom in axioms_in((folder() / f"{level}.lp").read_text(encoding="utf-8"), level)
    )


def names_in(*found: str) -> frozenset[str]:
    """Return the names of the axioms in these encodings."""
    return frozenset(axiom.name for axiom in axioms() if axiom.level in found)


@cache
def declared() -> tuple[Field, ...]:
    """Return the fields of `Theory` that encodings declare, in the order of the files."""
    found = []
    for level in levels():
        for line in _unwrapped((folder() / f"{level}.lp").read_text(encoding="utf-8")):
            if match := _FIELD.match(line):
                text = match["default"]
                default = text == "true" if text in ("true", "false") else int(text)
                found.append(Field(match["name"], default, match["help"]))
    return tuple(found)


def with_declared_fields(cls: type[_T]) -> type[_T]:
    """Add the fields that encodings declare to a class, with their help, before it is a dataclass.

    The class keeps the fields of its own text, which type checkers and editors know.
    """
    for new in declared():
        cls.__annotations__[new.name] = type(new.default).__name__
        setattr(cls, new.name, new.default)
        if cls.__doc__:
            cls.__doc__ = f"{cls.__doc__.rstrip()}\n        {new.name}: {new.help}\n    "
    return cls


@cache
def region_axioms() -> tuple[Axiom, ...]:
    """Return the axioms by which regions follow from a map. Searches for maps do not use them."""
    return tuple(axioms_in(Path(path("regions")).read_text(encoding="utf-8"), "regions"))


def axioms_in(text: str, level: str) -> list[Axiom]:
    """Read the axioms in the comments of an encoding."""
    found: list[Axiom] = []
    subject: tuple[str, ...] = ()
    for line in _unwrapped(text):
        if match := _WHEN.match(line):
            subject += tuple(match["when"].split(" and "))
        elif match := _AXIOM.match(line):
            own = tuple(match["when"].split(" and ")) if match["when"] else ()
            found.append(
                Axiom(
                    match["name"],
                    match["sentence"] or match["alone"],
                    match["source"] or "",
                    level,
                    subject,
                    subject + own,
                )
            )
    return found


def _unwrapped(text: str) -> list[str]:
    """Return the lines of an encoding, with each `% @axiom` or `% @field` on one line."""
    lines: list[str] = []
    for line in text.splitlines():
        if lines and lines[-1].startswith(("% @axiom(", "% @field(")) and line.startswith("%   "):
            lines[-1] += f" {line.removeprefix('%').strip()}"
        else:
            lines.append(line)
    return lines


def needed_by(choices: Mapping[str, object]) -> tuple[str, ...]:
    """Return the names of the encodings that a theory needs, in the order to load them.

    An axiom that is left out (`without`) still needs its encoding.
    """
    return tuple(
        level
        for level in levels()
        if any(axiom.holds_in(choices) for axiom in axioms() if axiom.level == level)
    )


@cache
def paths(name: str) -> tuple[str, ...]:
    """Return the paths of the files of an encoding: files that it shares, then its own.

    A line `% @with` names the shared files. Clingo's `#include` is not used, because it prefers a
    file of that name in the working directory.
    """
    own = path(name)
    return (*(path(shared) for shared in _said(own, _WITH)), own)


@cache
def keeps(*names: str) -> frozenset[str]:
    """Return the names of the axioms for which these fast encodings are exact.

    The lines `% @keeps` of the encodings, and of the files that they share, list them.
    """
    return frozenset(
        axiom for name in names for file in paths(name) for axiom in _said(file, _KEEPS)
    )


def _said(file: str, head: re.Pattern[str]) -> list[str]:
    """Return the names in all lines of a file that match `head`."""
    lines = Path(file).read_text(encoding="utf-8").splitlines()
    return [
        name for line in lines if (match := head.match(line)) for name in match["names"].split()
    ]


@dataclass(frozen=True)
class Rules:
    """A file of rules.

    Line ends of the text are converted to line feeds, and a byte order mark is removed.
    `ssh_abduction.theory.own_rules` checks that clingo can read the text.

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
        what, mend = "a list of files of rules", "give their paths, as in rules=['own.lp']"
        return tuple(map(cls.of, a_list("rules", value, TheoryError, what=what, mend=mend)))


def _stray(text: str) -> int:
    """Return the position of the first character or script that is not allowed; -1 without one."""
    depth = at = 0
    while found := (_INSIDE if depth else _OUTSIDE).search(text, at):
        if found.re is _OUTSIDE and found[1]:
            return found.start()
        depth += (found[0] == "%*") - (found[0] == "*%")
        at = found.end()
    return -1
