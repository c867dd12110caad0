"""Finds the `.lp` files, and reads from their comments what each axiom says and when it holds."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from ssh_abduction.data.files import shipped

# Each file needs those before it. Files that users add come after them, sorted by name.
FIRST = (
    "causal",
    "topological",
    "boundary",
    "star",
    "gateways",
)
_AXIOM = re.compile(
    r"^% @axiom\((?P<name>\w+)\) (?:(?P<sentence>.+?) \[(?P<source>[^\]]+)\](?: if "
    r"(?P<when>.+))?|(?P<alone>.+))$"
)
_WHEN = re.compile(r"^% @when (?P<when>.+)$")
_KEEPS = re.compile(r"^% @keeps (?P<names>.+)$")
_WITH = re.compile(r"^% @with (?P<names>.+)$")


@dataclass(frozen=True)
class Axiom:
    """One axiom.

    Attributes:
        name: The name, as in `violation(name,…)`.
        sentence: What it says.
        source: Where it comes from.
        level: The name of its encoding.
        subject: Conditions on a theory without which the axiom has no subject (`% @when`).
        conditions: All conditions that switch it on: those, and the ones behind `if`.
    """

    name: str
    sentence: str
    source: str
    level: str
    subject: tuple[str, ...]
    conditions: tuple[str, ...]

    def holds_in(self, choices: Mapping[str, object]) -> bool:
        """Whether a theory with these fields has the axiom."""
        return all(_holds(condition, choices) for condition in self.conditions)

    def has_subject_in(self, choices: Mapping[str, object]) -> bool:
        """Whether a theory with these fields has the subject of the axiom."""
        return all(_holds(condition, choices) for condition in self.subject)


def _holds(condition: str, choices: Mapping[str, object]) -> bool:
    """Whether a condition holds.

    Its form is `field=value|value`, `field`, `field|field` (any of these), or `not field`.
    """
    if "=" in condition:
        field, values = condition.split("=")
        return choices[field] in values.split("|")
    if condition.startswith("not "):
        return not choices[condition.removeprefix("not ")]
    return any(choices[field] for field in condition.split("|"))


def folder() -> Path:
    """The folder of the encodings, in the installed package or beside it in a checkout."""
    return shipped("encodings")


def path(name: str) -> str:
    """The path of an encoding, readable or fast."""
    readable = folder() / f"{name}.lp"
    return str(readable if readable.exists() else folder() / "fast" / f"{name}.lp")


@cache
def levels() -> tuple[str, ...]:
    """The encodings with axioms, in the order to load them, also those that users add."""
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
    """All axioms, in the order of the files."""
    return tuple(
        axiom
        for level in levels()
        for axiom in axioms_in((folder() / f"{level}.lp").read_text(encoding="utf-8"), level)
    )


def axioms_in(text: str, level: str) -> list[Axiom]:
    """The axioms in the comments of an encoding."""
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
    """The lines of an encoding, with each `% @axiom` comment joined to its continuation lines.

    A continuation line starts with `%` and at least three spaces.
    """
    lines: list[str] = []
    for line in text.splitlines():
        if lines and lines[-1].startswith("% @axiom(") and line.startswith("%   "):
            lines[-1] += f" {line.removeprefix('%').strip()}"
        else:
            lines.append(line)
    return lines


def needed_by(choices: Mapping[str, object]) -> tuple[str, ...]:
    """The encodings that a theory with these fields needs, in the order to load them.

    An axiom that is left out (`without`) still needs its encoding.
    """
    return tuple(
        level
        for level in levels()
        if any(axiom.holds_in(choices) for axiom in axioms() if axiom.level == level)
    )


@cache
def paths(name: str) -> tuple[str, ...]:
    """The files of an encoding: those that it shares (`% @with` at its head), then its own.

    Clingo's `#include` is not used, because it prefers a file of that name in the working
    directory.
    """
    own = path(name)
    return (*(path(shared) for shared in _said(own, _WITH)), own)


@cache
def keeps(*names: str) -> frozenset[str]:
    """The axioms that these fast encodings keep, as they and the files they share say."""
    return frozenset(
        axiom for name in names for file in paths(name) for axiom in _said(file, _KEEPS)
    )


def _said(file: str, head: re.Pattern[str]) -> list[str]:
    """The names in all lines of a file that begin with `head`."""
    lines = Path(file).read_text(encoding="utf-8").splitlines()
    return [
        name for line in lines if (match := head.match(line)) for name in match["names"].split()
    ]
