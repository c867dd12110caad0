"""Questions that distinguish maps of one trace.

A question asks whether two steps are one dstate, at one place, along one path, or along one path in
one direction. It can also ask whether a step is treated as wrong. If two questions get the same
answers from all maps, or opposite answers from all maps, only the one about the earliest steps is
kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from ssh_abduction.data.errors import printable
from ssh_abduction.data.groups import indices_of
from ssh_abduction.data.maps import Fault, SSHMap
from ssh_abduction.data.schema import attributes_of
from ssh_abduction.data.words import noun_of
from ssh_abduction.rivals.table import Bools, Table
from ssh_abduction.solver import SORTS, stretches

Matter: TypeAlias = Literal["faults", "dstates", "places", "paths", "courses"]

MATTERS: tuple[Matter, ...] = ("faults", *SORTS)  # in the order of causes


@dataclass(frozen=True, slots=True)
class Question:
    """A question that distinguishes maps.

    It asks whether two steps are one dstate, at one place, along one path, or along one path in one
    direction; or whether a map has a fault (treats a step as wrong).
    """

    sort: Matter  # the subject: "faults", "dstates", "places", "paths" or "courses"
    # The earlier of the two steps. If `first` and `later` are equal, the question asks whether the
    # step is at a place, or along a path, at all. For a fault, both are its step.
    first: int
    later: int  # the later of the two steps
    yes: int  # the number of maps that answer yes
    here: tuple[int, ...]  # the steps that all maps group with `first`, by this sort
    there: tuple[int, ...]  # the steps that all maps group with `later`, by this sort
    # The places of the steps in `here`, and of the steps in `there`. Only for questions about paths
    # or courses, if all maps have the same places; otherwise None.
    places: tuple[tuple[int, ...], tuple[int, ...]] | None = None
    # The fault of the maps that answer yes; None if the question is not about faults.
    fault: Fault | None = None

    def __str__(self) -> str:
        if self.fault:
            return printable(str(self.fault))
        verb = "is" if len(self.there) == 1 else "are"
        if self.first == self.later:
            what = "at a place" if self.sort == "places" else "along a path"
            return f"{_steps(self.there)} {verb} {what}"
        here, there = (
            f"{_steps(steps)}{self._at(k)}" for k, steps in enumerate((self.here, self.there))
        )
        same = {
            "dstates": f"at the dstate of {here}",
            "places": f"at the place of {here}",
            "paths": f"along the path of {here}",
            "courses": f"along the path of {here} in the same direction",
        }[self.sort]
        return f"{there} {verb} {same}"

    def _at(self, side: int) -> str:
        """Put the places of one side (0 for `here`, 1 for `there`) into words, in brackets."""
        places = self.places[side] if self.places else ()
        return f" ({noun_of('place', places)} {stretches(places)})" if places else ""

    def to_dict(self) -> dict[str, Any]:
        """Return the question as plain data, as `compare --json` prints it."""
        data = attributes_of(self, "sort", "first", "later", "yes", "here", "there") | {
            "sentence": str(self)
        }
        data |= attributes_of(self, "places") if self.places else {}
        if self.fault:
            data["fault"] = self.fault.to_dict()
        return data


@dataclass(frozen=True, slots=True)
class AnsweredQuestion:
    """A question with its answers."""

    question: Question
    column: Bools  # the answer of each map
    # For each sort of question, the later steps of the equivalent questions of this sort. A
    # question is equivalent if all maps give it the same answers as this one, or all give it the
    # opposite answers.
    steps: dict[Matter, set[int]]


def questions_of(
    table: Table, maps: Sequence[SSHMap], *, same_places: bool
) -> list[AnsweredQuestion]:
    """List all questions that distinguish maps, each once, with their answers.

    They are in the order of causes (faults, dstates, places, paths, courses), and then of
    steps. `same_places` says whether all maps have the same places.
    """
    found = _about_faults(maps)
    places = [maps[0].dstates[label].place for label in maps[0].dstate_at] if same_places else []
    steps_by_class = {
        number: [table.steps[t] for t in steps]
        for number, steps in indices_of(table.classes.tolist()).items()
    }
    for sort in table.ones:
        heads = table.heads(sort).tolist()
        together = indices_of(heads)
        for c, d, column in table.questions(sort):
            key = _key(column)
            # of questions with equal or opposite answers, keep the one about the earliest steps
            if key not in found:
                sides = [
                    sorted(t for k in together[heads[side]] for t in steps_by_class[k])
                    for side in (c, d)
                ]
                stand = [
                    tuple(sorted({p for t in side if (p := places[t]) is not None}))
                    for side in (sides if places else ())
                ]
                question = Question(
                    sort,
                    first=int(table.firsts[c]),
                    later=int(table.firsts[d]),
                    yes=int(column.sum()),
                    here=tuple(sides[0]),
                    there=tuple(sides[1]),
                    places=(stand[0], stand[1]) if stand and sort in ("paths", "courses") else None,
                )
                found[key] = AnsweredQuestion(question, column, {})
            found[key].steps.setdefault(sort, set()).update(steps_by_class[d])
    return sorted(
        found.values(),
        key=lambda a: (MATTERS.index(a.question.sort), a.question.later, a.question.first),
    )


def _about_faults(maps: Sequence[SSHMap]) -> dict[bytes, AnsweredQuestion]:
    """Find the questions about faults that distinguish maps, by the keys of their answers."""
    found: dict[bytes, AnsweredQuestion] = {}
    faults = {fault for ssh_map in maps for fault in ssh_map.faults}
    for fault in sorted(faults, key=lambda f: (f.step, f.kind, str(f.seen), str(f.expected))):
        column = np.array([fault in ssh_map.faults for ssh_map in maps])
        if not column.all():
            at, yes = (fault.step,), int(column.sum())
            question = Question("faults", fault.step, fault.step, yes, at, at, fault=fault)
            asked = found.setdefault(_key(column), AnsweredQuestion(question, column, {}))
            asked.steps.setdefault("faults", set()).add(fault.step)
    return found


def _key(column: Bools) -> bytes:
    """Return a key for the answer of each map. The opposite answers have the same key."""
    return np.packbits(column ^ column[0]).tobytes()


def _steps(steps: Sequence[int]) -> str:
    """Put the numbers of steps into words: "step 1", or "steps 1–3 and 7"."""
    return f"{noun_of('step', steps)} {stretches(steps)}"
