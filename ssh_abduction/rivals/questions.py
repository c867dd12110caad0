"""Questions that distinguish maps of one trace, and the few of them that decide.

A question asks whether two steps are one dstate, at one place, along one path, or along one path in
one direction. It can also ask whether a step is treated as wrong. If two questions get the same
answers from all maps, or opposite answers from all maps, only the one about the earliest steps is
kept. A question is a column of truth values: the answer of each map.

Maps are compared as arrays, so that thousands of them are compared in seconds. Steps that are one
dstate in all maps are a *class*. Classes are numbered from 0 by their first steps. Two classes are
*one* in a map if they are at one dstate of it (or at one place, along one path, or along one
course, for these sorts). For each sort, map and class, the table has the first class that is one
with this class. So the numbers that maps give to their dstates, places and paths do not matter.

>>> from ssh_abduction.data.maps import DState, SSHMap
>>> a, b = DState(0, "hall"), DState(1, "hall")
>>> table = Table([SSHMap((0, 0, 1), (a, b), ()), SSHMap((0, 1, 1), (a, b), ())])
>>> table.ones["dstates"].tolist()
[[0, 0, 2], [0, 1, 1]]
>>> [(first, later, column.tolist()) for first, later, column in table.questions("dstates")]
[(0, 1, [True, False]), (1, 2, [False, True])]

A set of questions *decides* if no two maps give the same answers to all of them. Questions are
chosen greedily: the next one distinguishes the most pairs of maps that are not distinguished yet,
and ties go to the earliest. Then superfluous questions are dropped. A smaller set may exist, but
finding the smallest one is NP-hard (minimum test set, Garey & Johnson 1979, SP6).

A *choice* is a set of questions, and its *options* are the different answers that maps give to
them. Choices are *independent* if each combination of their options is a map. Then the number of
maps is the product of the numbers of options. There is exactly one finest division of questions
into independent choices.

The finest division is found by merging. Start with small choices. If they are not all independent,
find a minimal set of dependent choices, merge its members, and repeat. The merged members belong to
one choice of the finest division. Otherwise two independent choices would split the set into two
parts. Each part is independent, as the set is minimal, so the whole set would be independent.

>>> rows = np.array([[0, 0, 0], [0, 1, 1], [1, 0, 0], [1, 1, 1]], dtype=bool)
>>> deciding(rows.T, 4)
[0, 1]
>>> independent(rows.T)
[[0], [1, 2]]
"""

from __future__ import annotations

import heapq
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass
from math import prod
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from ssh_abduction.data.drives import Drive, named_steps
from ssh_abduction.data.errors import printable
from ssh_abduction.data.groups import indices_of, minimal_part
from ssh_abduction.data.maps import Fault, SSHMap
from ssh_abduction.data.schema import attributes_of
from ssh_abduction.data.words import noun_of
from ssh_abduction.solution import SORTS, Sort, key_of, sorts_of, steps_in_words, stretches

Matter: TypeAlias = Literal["faults", "dstates", "places", "paths", "courses"]

MATTERS: tuple[Matter, ...] = ("faults", *SORTS)  # in the order of causes
Ints: TypeAlias = NDArray[np.int32]
Bools: TypeAlias = NDArray[np.bool_]
NONE = -1  # no place, path or course


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
    places: tuple[tuple[int, ...], ...] | None = None
    # The fault of the maps that answer yes; None if the question is not about faults.
    fault: Fault | None = None

    def __str__(self) -> str:
        if self.fault:
            return printable(str(self.fault))
        verb = "is" if len(self.there) == 1 else "are"
        if self.first == self.later:
            what = "at a place" if self.sort == "places" else "along a path"
            return f"{steps_in_words(self.there)} {verb} {what}"
        here, there = (
            f"{steps_in_words(steps)}{self._at(k)}"
            for k, steps in enumerate((self.here, self.there))
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
    for sort in table.ones:
        heads = table.heads(sort).tolist()
        together = indices_of(heads)
        for c, d, column in table.questions(sort):
            # of questions with equal or opposite answers, keep the one about the earliest steps
            if (key := _key(column)) not in found:
                here, there = (table.steps_of(together[heads[side]]) for side in (c, d))
                at = None
                if places and sort in ("paths", "courses"):
                    at = tuple(
                        tuple(sorted({p for t in side if (p := places[t]) is not None}))
                        for side in (here, there)
                    )
                first, later = int(table.firsts[c]), int(table.firsts[d])
                question = Question(sort, first, later, int(column.sum()), here, there, at)
                found[key] = AnsweredQuestion(question, column, {})
            found[key].steps.setdefault(sort, set()).update(table.steps_of([d]))
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


class Table:
    """Maps of one trace as arrays."""

    def __init__(self, maps: Sequence[SSHMap], drives: Sequence[Drive] = ()) -> None:
        labelings = dict.fromkeys(ssh_map.dstate_at for ssh_map in maps)
        by_labels = {labels: np.array(labels, dtype=np.int32) for labels in labelings}
        # The class of each step, shape (steps,), and the first step of each class, (classes,).
        self.classes = _common_classes(list(by_labels.values()))
        _, self.firsts = np.unique(self.classes, return_index=True)
        # The numbers of all steps. With several drives, a step prints with its drive's name.
        self.steps = named_steps(drives, len(self.classes))
        label_of = {labels: numbers[self.firsts].tolist() for labels, numbers in by_labels.items()}
        # For each sort that all maps have, an array of shape (maps, classes): the first class that
        # is one with each class in each map; NONE if the class has no place, path or course.
        self.ones: dict[Sort, Ints] = {}
        for sort in sorts_of(maps):
            known: dict[tuple[Hashable, ...], Ints] = {}
            rows = []
            for ssh_map in maps:
                of_dstate = [key_of(s, sort) for s in ssh_map.dstates]
                names = tuple(of_dstate[label] for label in label_of[ssh_map.dstate_at])
                if names not in known:
                    known[names] = _firsts_of(names)
                rows.append(known[names])
            self.ones[sort] = np.array(rows, dtype=np.int32)

    def __len__(self) -> int:
        """Return the number of maps."""
        return len(self.ones["dstates"])

    def steps_of(self, classes: Sequence[int]) -> tuple[int, ...]:
        """List the steps of some classes, ascending."""
        found = np.flatnonzero(np.isin(self.classes, classes)).tolist()
        return tuple(map(self.steps.__getitem__, found))

    def variants(self, sort: Sort) -> int:
        """Count the different ways in which maps group classes by this sort."""
        return len(np.unique(self.ones[sort], axis=0))

    def heads(self, sort: Sort) -> Ints:
        """For each class, return the first class that all maps treat in the same way.

        Two classes are treated in the same way if in each map they are one, or both have no
        place, path or course. The result has the shape (classes,).
        """
        _, first, inverse = np.unique(
            self.ones[sort], axis=1, return_index=True, return_inverse=True
        )
        return first[inverse.reshape(-1)].astype(np.int32)

    def questions(self, sort: Sort) -> Iterator[tuple[int, int, Bools]]:
        """Yield questions that distinguish maps: two classes, and the answer of each map.

        The answer says whether the two classes are one in the map. The earlier class comes
        first. Each class is paired only with the first class of its group in each map. Two maps
        that agree on these pairs group all classes in the same way. If a class is paired with
        itself, the answer says whether it has a place, path or course at all.
        """
        ones = self.ones[sort]
        for c in np.flatnonzero((ones != ones[0]).any(axis=0)).tolist():
            for h in np.unique(ones[:, c]).tolist():
                if h == NONE:
                    yield c, c, ones[:, c] != NONE
                elif h != c and not (same := ones[:, h] == ones[:, c]).all():
                    yield h, c, same


def _common_classes(labelings: Sequence[Ints]) -> Ints:
    """Return the class of each step, of shape (steps,): steps of a class have equal labels."""
    classes = labelings[0].astype(np.int64)
    for labels in labelings[1:]:
        _, classes = np.unique(classes * (int(labels.max()) + 1) + labels, return_inverse=True)
    return columns_numbered(classes[None]).astype(np.int32)


def columns_numbered(table: NDArray[np.generic]) -> NDArray[np.intp]:
    """Number the different columns of a table (m, n) as they first occur. Return the shape (n,)."""
    _, first, inverse = np.unique(table, axis=1, return_index=True, return_inverse=True)
    rank: NDArray[np.intp] = np.empty(len(first), dtype=np.intp)
    rank[np.argsort(first)] = np.arange(len(first))
    numbers: NDArray[np.intp] = rank[inverse.reshape(-1)]
    return numbers


def _firsts_of(names: Sequence[Hashable]) -> Ints:
    """For each name, find the index of its first occurrence; NONE if the name is None."""
    first: dict[Hashable, int] = {}
    return np.array(
        [NONE if name is None else first.setdefault(name, i) for i, name in enumerate(names)],
        dtype=np.int32,
    )


def deciding(columns: Sequence[Bools] | Bools, maps: int, tiers: Sequence[int] = ()) -> list[int]:
    """Choose questions that distinguish all maps that can be distinguished; none is superfluous.

    `columns` has, for each question, the answers of all maps. Earlier questions win ties. `tiers`
    ranks the questions; by default all have one rank. A question is chosen only when those of lower
    ranks distinguish no further maps. Return the indices of the questions, in the order of choice.
    """
    groups = np.zeros(maps, dtype=np.intp)
    # A question distinguishes ever fewer new pairs as others are chosen. So its pairs are counted
    # again only when it is at the top of the heap.
    waiting = [
        (tier, -_split(column, groups), i)
        for i, (column, tier) in enumerate(zip(columns, tiers or [0] * len(columns), strict=True))
    ]
    heapq.heapify(waiting)
    chosen: list[int] = []
    while waiting:
        tier, _, i = heapq.heappop(waiting)
        now = (tier, -_split(columns[i], groups), i)
        if not now[1]:
            continue
        if waiting and now > waiting[0]:
            heapq.heappush(waiting, now)
            continue
        chosen.append(i)
        _, groups = np.unique(groups * 2 + columns[i], return_inverse=True)
    for i in reversed(chosen):
        others = [j for j in chosen if j != i]
        if options_of([columns[j] for j in others], maps).max(initial=0) == groups.max(initial=0):
            chosen = others
    return chosen


def independent(columns: Sequence[Bools] | Bools) -> list[list[int]]:
    """Divide questions into the finest independent choices.

    `columns` has the answers of all maps for each question. Maps with equal answers count once.
    A choice is a list of indices of questions. Choices are sorted by their first question.
    """
    if not len(columns):
        return []
    table = np.unique(np.asarray(columns, dtype=bool), axis=1)
    choices = _linked(table)
    while (
        dependent := _dependent([options_of(table[choice], table.shape[1]) for choice in choices])
    ) is not None:
        merged = sorted(i for k in dependent for i in choices[k])
        choices = sorted(
            [choice for k, choice in enumerate(choices) if k not in dependent] + [merged]
        )
    return choices


def options_of(columns: Sequence[Bools] | Bools, maps: int) -> NDArray[np.intp]:
    """Return the number of each map's option, of shape (maps,).

    An option is a combination of answers. `columns` has the answers of all maps for each question.
    Options are numbered from 0 in the order of the maps.
    """
    if not len(columns):
        return np.zeros(maps, dtype=np.intp)
    return columns_numbered(np.packbits(np.asarray(columns, dtype=bool), axis=0))


def _split(column: Bools, groups: NDArray[np.intp]) -> int:
    """Count the pairs of maps that are in one group but answer a question differently."""
    sizes = np.bincount(groups)
    yes = np.bincount(groups, weights=column).astype(np.int64)
    return int((yes * (sizes - yes)).sum())


def _linked(table: Bools) -> list[list[int]]:
    """Group questions that depend on each other, directly or through others.

    Two questions are independent if the share of maps that answer yes to both is the product of the
    shares that answer yes to each.
    """
    counts = table.astype(np.int64)
    yes = counts.sum(axis=1)
    depends = (counts @ counts.T) * table.shape[1] != np.outer(yes, yes)
    return [*indices_of(connected_components(depends)[1].tolist()).values()]


def _dependent(options: Sequence[NDArray[np.intp]]) -> list[int] | None:
    """Find a minimal set of dependent choices, as indices; None if all are independent."""

    def are_dependent(which: list[int]) -> bool:
        together = np.unique(np.stack([options[k] for k in which]), axis=1).shape[1]
        return bool(together != prod(int(options[k].max()) + 1 for k in which))

    everything = list(range(len(options)))
    return minimal_part(are_dependent, everything) if are_dependent(everything) else None
