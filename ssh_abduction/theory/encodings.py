"""Where the axioms are: finds the `.lp` files, and reads from their comments what each axiom says and when it holds."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path

LEVELS = ("causal", "topological", "boundary", "star")
_AXIOM = re.compile(r"^% @axiom\((?P<name>\w+)\) (?P<sentence>.+?) \[(?P<source>[^\]]+)\](?: if (?P<when>.+))?$")
_WHEN = re.compile(r"^% @when (?P<when>.+)$")


@dataclass(frozen=True)
class Axiom:
    """One axiom: its name, what it says, where it is from, its encoding's level, and the choices of a theory that switch it on."""

    name: str
    sentence: str
    source: str
    level: str
    conditions: tuple[str, ...]

    def holds_in(self, choices: Mapping[str, object]) -> bool:
        """Whether a theory with these fields has the axiom."""
        return all(_holds(condition, choices) for condition in self.conditions)


def _holds(condition: str, choices: Mapping[str, object]) -> bool:
    """`field=value|value`, `field`, or `not field`."""
    if "=" in condition:
        field, values = condition.split("=")
        return choices[field] in values.split("|")
    if condition.startswith("not "):
        return not choices[condition.removeprefix("not ")]
    return bool(choices[condition])


@cache
def folder() -> Path:
    """The folder of the encodings: inside the installed package, or beside it in a checkout."""
    packaged = Path(str(files("ssh_abduction"))) / "encodings"
    return packaged if packaged.is_dir() else Path(__file__).resolve().parents[2] / "encodings"


def path(name: str) -> str:
    """The path of the encoding `name`, for clingo to load."""
    at = folder() / f"{name}.lp"
    return str(at if at.is_file() else folder() / "fast" / f"{name}.lp")


@cache
def axioms() -> tuple[Axiom, ...]:
    """Every axiom of every level, in the order of the files."""
    found = []
    for level in LEVELS:
        conditions: tuple[str, ...] = ()
        for line in (folder() / f"{level}.lp").read_text(encoding="utf-8").splitlines():
            if match := _WHEN.match(line):
                conditions += tuple(match["when"].split(" and "))
            elif match := _AXIOM.match(line):
                own = tuple(match["when"].split(" and ")) if match["when"] else ()
                found.append(Axiom(match["name"], match["sentence"], match["source"], level, conditions + own))
    return tuple(found)
