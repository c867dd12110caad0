"""Where the axioms are: finds the `.lp` files, and reads from their comments what each axiom says and when it holds."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from ssh_abduction.data.files import shipped

# Each needs those before it; files that are added come after them, by name.
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

    name        as in `violation(name,…)`
    sentence    what it says
    source      where it is from
    level       the name of its encoding
    subject     the choices of a theory without which there is nothing that the axiom speaks of (`% @when`)
    conditions  all choices that switch it on: those, and the ones after `if`
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
        """Whether a theory with these fields speaks of what the axiom is about."""
        return all(_holds(condition, choices) for condition in self.subject)


def _holds(condition: str, choices: Mapping[str, object]) -> bool:
    """Whether a condition holds:

    `field=value|value`, `field`, `field|field` (any of these fields), or `not field`.
    """
    if "=" in condition:
        field, values = condition.split("=")
        return choices[field] in values.split("|")
    if condition.startswith("not "):
        return not choices[condition.removeprefix("not ")]
    return any(choices[field] for field in condition.split("|"))


def folder() -> Path:
    """The folder of the encodings: inside the installed package, or beside it in a checkout."""
    return shipped("encodings")


def path(name: str) -> str:
    """The path of the encoding `name`, for clingo to load: one of the readable ones, or of the fast ones."""
    readable = folder() / f"{name}.lp"
    return str(readable if readable.exists() else folder() / "fast" / f"{name}.lp")


@cache
def levels() -> tuple[str, ...]:
    """The encodings that hold axioms, in the order to load them.

    They are found in the folder, so a file that is put there is one of them.
    """
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
    """Every axiom of every level, in the order of the files."""
    return tuple(
        axiom
        for level in levels()
        for axiom in axioms_in((folder() / f"{level}.lp").read_text(encoding="utf-8"), level)
    )


def axioms_in(text: str, level: str) -> list[Axiom]:
    """The axioms that the comments of an encoding name."""
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
    """The encodings that a theory with these fields needs, in the order to load them: those of its axioms, axioms that it leaves out (`without`) among them."""
    return tuple(
        level
        for level in levels()
        if any(axiom.holds_in(choices) for axiom in axioms() if axiom.level == level)
    )


@cache
def paths(name: str) -> tuple[str, ...]:
    """The paths of all files that make the encoding `name`: its own, and before it those that it shares with another one, as `% @with` says at its head.

    Clingo's `#include` is not used for that, as it prefers a file of the working directory which
    happens to have the same name.
    """
    own = path(name)
    return (*(path(shared) for shared in _said(own, _WITH)), own)


@cache
def keeps(*names: str) -> frozenset[str]:
    """The axioms that these fast encodings say at their heads that they keep, together and with the files that they share."""
    return frozenset(
        axiom for name in names for file in paths(name) for axiom in _said(file, _KEEPS)
    )


def _said(file: str, head: re.Pattern[str]) -> list[str]:
    """The names in all lines of a file that have such a head."""
    lines = Path(file).read_text(encoding="utf-8").splitlines()
    return [
        name for line in lines if (match := head.match(line)) for name in match["names"].split()
    ]
