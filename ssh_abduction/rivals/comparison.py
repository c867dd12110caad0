"""What rival maps share, where they differ, and which steps decide between them.

>>> from ssh_abduction import Trace, solve
>>> from ssh_abduction.rivals.comparison import compare
>>> found = compare(solve(Trace.load("examples/aces3-route.jsonl")))
>>> print(found.sentence)
4 minimal maps: the same dstates; the places of steps 15–18 and 21 differ; the paths of steps 18–22 differ
>>> [len(choice.options) for choice in found.choices]
[2, 2]
>>> print(found.deciding[0])
the place of step 14 and that of steps 17–18 and 21 are one

Maps are told apart by questions whether two steps are one dstate, at one place, along one path, or along one path in one direction. Questions to which all maps
give the same answers, or opposite ones, are one question, and the earliest steps stand for it. Of these, some decide (`rivals/factors.py`): all others
follow from them. They are asked in the order of causes: what is disbelieved, dstates, places, paths, directions. Where they are independent of each other, they are
several *choices*, and the maps are all combinations of their options.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.errors import MapError, printable
from ssh_abduction.data.maps import Fault, SSHMap
from ssh_abduction.rivals.differences import Difference, difference
from ssh_abduction.rivals.factors import deciding, independent, options_of
from ssh_abduction.rivals.listing import Listing, Maps
from ssh_abduction.rivals.table import Bools, Table
from ssh_abduction.solver import SORTS, Backbone, Shared, stretches

Matter: TypeAlias = Literal["faults", "dstates", "places", "paths", "courses"]

MATTERS: tuple[Matter, ...] = ("faults", *SORTS)  # in the order of causes
WORDS: dict[Matter, str] = {
    "dstates": "dstate",
    "places": "place",
    "paths": "path",
    "courses": "path and direction",
}


@dataclass(frozen=True, slots=True)
class Question:
    """A question that tells maps apart: whether two steps are one dstate, at one place, along one path, or along one course; or whether a step is disbelieved.

    sort    what is asked about
    first, later  the earliest two steps that it can be asked about. Of a step with itself: whether it is along a path at all. Of a fault both are its step
    yes     how many maps say yes
    here    the steps that `first` stands for: in all maps they are one with it
    there   the same of `later`
    places  for questions about paths, where all maps have the same places: the places of the steps of `here`, and of `there`, as the maps number them
    fault   what is disbelieved in the maps that say yes, of questions about faults
    """

    sort: Matter
    first: int
    later: int
    yes: int
    here: tuple[int, ...]
    there: tuple[int, ...]
    places: tuple[tuple[int, ...], tuple[int, ...]] | None = None
    fault: Fault | None = None

    def __str__(self) -> str:
        if self.fault:
            return printable(str(self.fault))
        if self.first == self.later:
            return f"{_steps(self.there)} {'is' if len(self.there) == 1 else 'are'} {'at a place' if self.sort == 'places' else 'along a path'}"
        word = WORDS[self.sort]
        here, there = (
            f"{_steps(steps)}{self._at(k)}" for k, steps in enumerate((self.here, self.there))
        )
        return f"the {word} of {here} and that of {there} are one"

    def _at(self, side: int) -> str:
        places = self.places[side] if self.places else ()
        return (
            f" ({'place' if len(places) == 1 else 'places'} {stretches(places)})" if places else ""
        )

    def to_dict(self) -> dict[str, Any]:
        data: dict[str, Any] = {
            "sort": self.sort,
            "first": self.first,
            "later": self.later,
            "yes": self.yes,
        }
        data |= {"here": list(self.here), "there": list(self.there), "sentence": str(self)}
        if self.places:
            data["places"] = [list(places) for places in self.places]
        if self.fault:
            data["fault"] = {k: v for k, v in asdict(self.fault).items() if v is not None}
        return data


@dataclass(frozen=True, slots=True)
class Option:
    """One way to answer the questions of a choice.

    answers  to these questions, in their order
    maps     the numbers of the maps that answer so, counted from 1
    """

    answers: tuple[bool, ...]
    maps: tuple[int, ...] = field(repr=False)

    def to_dict(self) -> dict[str, Any]:
        return {"answers": list(self.answers), "count": len(self.maps), "maps": list(self.maps)}


@dataclass(frozen=True, slots=True)
class Choice:
    """Questions that depend on each other, and on no questions of other choices.

    questions  those that decide, as in `Comparison.deciding`
    options    the ways to answer them, that of map 1 first
    differing  for each sort the steps that depend on this choice alone
    """

    questions: tuple[Question, ...]
    options: tuple[Option, ...]
    differing: dict[Matter, tuple[int, ...]] = field(hash=False)

    def to_dict(self) -> dict[str, Any]:
        return {
            "questions": [question.to_dict() for question in self.questions],
            "options": [option.to_dict() for option in self.options],
            "differing": {sort: list(steps) for sort, steps in self.differing.items()},
        }


@dataclass(frozen=True, slots=True)
class Others:
    """How the maps compare with those of another list.

    count  how many the other list has
    both   the maps that are in both, up to renaming: the number here, and the number there, counted from 1
    here   the numbers of the maps that are only here
    there  the numbers of those that are only there
    best   what tells the first map here and the first one there apart
    source where the other list is from
    """

    count: int
    both: tuple[tuple[int, int], ...]
    here: tuple[int, ...]
    there: tuple[int, ...]
    best: Difference
    source: str = "the other file"

    @property
    def sentence(self) -> str:
        """How many maps are in both lists."""
        if not self.here and not self.there:
            return (
                f"the {self.count} maps are the same in both"
                if self.count > 1
                else "the map is the same in both"
            )
        told = [
            f"{len(self.both)} in both",
            f"{len(self.here)} only in the first",
            f"{len(self.there)} only in {printable(self.source)}",
        ]
        return "of the maps, " + ", ".join(told[:-1]) + " and " + told[-1]

    def to_dict(self) -> dict[str, Any]:
        return {
            "count": self.count,
            "sentence": self.sentence,
            "both": [list(pair) for pair in self.both],
            "only_first": list(self.here),
            "only_other": list(self.there),
            "best": self.best.to_dict(),
        }


@dataclass(frozen=True, slots=True)
class Comparison:
    """What maps of one trace share, and where they differ.

    ids       the ids of the maps, in their order
    steps     how many steps the trace has
    minimal   how many of the maps, from the first one on, are minimal, as was proven; None where nobody says so
    complete  whether these are all minimal maps; None where nobody says so
    stopped   why listing ended, where it was not complete and that is known
    shared    what all minimal maps share: proven where `shared.proven` is true, else as far as the maps listed tell
    listed    what the maps share that are listed
    variants  how many different labelings, placings, … the maps listed have, by sort; of `faults` how many sets of these
    choices   what the maps listed differ in. They are independent of each other: each combination of their options is a map
    together  for each sort the steps that depend on several choices together
    deciding  questions that tell all maps listed apart, in the order in which to ask them; the first ones tell all labelings apart. None can be left out; a smaller set may exist
    sizes     for each number of dstates, places and paths that maps have, how many have it
    fits      the least and the greatest chi-square, where maps have fits
    others    how the maps compare with those of another list
    """

    ids: tuple[str, ...] = field(repr=False)
    steps: int
    minimal: int | None
    complete: bool | None
    stopped: str | None
    shared: Backbone = field(repr=False)
    listed: Backbone = field(repr=False)
    variants: dict[Matter, int] = field(hash=False)
    choices: tuple[Choice, ...]
    together: dict[Matter, tuple[int, ...]] = field(hash=False)
    deciding: tuple[Question, ...]
    sizes: tuple[tuple[tuple[int, int, int], int], ...] = ()
    fits: tuple[float, float] | None = None
    others: Others | None = None

    @property
    def sentence(self) -> str:
        """What the maps share and where they differ, in one sentence."""
        count = len(self.ids) if self.minimal is None else self.minimal
        minimal = "minimal " if self.minimal is not None else ""
        told = f"{'at least ' if self.complete is False else ''}{count} {minimal}map{'' if count == 1 else 's'}"
        if self.complete is False and self.stopped == "no proof":
            told = f"{count} {minimal}map{'' if count == 1 else 's'}, without a proof that there {'is' if count == 1 else 'are'} no other{'' if count == 1 else 's'}"
        elif self.complete is False and self.stopped:
            told += f" (listing was {'' if self.stopped == 'interrupted' else 'stopped by the '}{self.stopped})"
        more = len(self.ids) - count
        if more:
            told += f", and {more} larger ones"
        if count == 1 and not more and (self.complete is not False or self.minimal is None):
            return told
        told += f": {self._differences}"
        if self.complete is False and not self.shared.proven:
            told += ", as far as was found out: others may differ in more"
        return told

    @property
    def _differences(self) -> str:
        faults = self.variants.get("faults", 0) > 1
        return (
            f"what they disbelieve differs ({self.variants['faults']} ways); " if faults else ""
        ) + self.shared.sentence

    @property
    def product(self) -> str:
        """The number of maps as the product of the numbers of options: 780 = 195 x 2 x 2. Empty where there are no two choices."""
        if len(self.choices) < 2:
            return ""
        return (
            f"{len(self.ids)} = {' x '.join(str(len(choice.options)) for choice in self.choices)}"
        )

    @property
    def unlisted(self) -> dict[Matter, tuple[int, ...]]:
        """For each sort the steps in which minimal maps differ, as was proven, and the maps listed do not."""
        found: dict[Matter, tuple[int, ...]] = {}
        for sort, shared in self.shared.sorts.items():
            shown = self.listed.sorts.get(sort)
            more = set(shared.differing) - set(shown.differing if shown else ())
            if more:
                found[sort] = tuple(sorted(more))
        return found

    def to_dict(self) -> dict[str, Any]:
        """As `compare --json` prints it (docs/formats.md)."""
        data: dict[str, Any] = {
            "summary": self.sentence,
            "count": len(self.ids),
            "steps": self.steps,
            "minimal": self.minimal,
            "complete": self.complete,
            "ids": list(self.ids),
            "shared": self.shared.to_dict(),
            "variants": dict(self.variants),
            "choices": [choice.to_dict() for choice in self.choices],
            "together": {sort: list(steps) for sort, steps in self.together.items()},
            "deciding": [question.to_dict() for question in self.deciding],
            "sizes": [
                {"dstates": dstates, "places": places, "paths": paths, "count": count}
                for (dstates, places, paths), count in self.sizes
            ],
        }
        if self.stopped:
            data["stopped"] = self.stopped
        if self.complete is False:
            data["listed"] = self.listed.to_dict()
            data["unlisted"] = {sort: list(steps) for sort, steps in self.unlisted.items()}
        if self.fits:
            data["chi2"] = list(self.fits)
        if self.others:
            data["others"] = self.others.to_dict()
        return data


def compare(maps: Maps, other: Maps | None = None) -> Comparison:
    """What these maps share, where they differ, and which steps decide between them.

    maps   a Solution, a Listing (`Listing.load` reads a file), or maps of one trace
    other  maps of the same trace, to compare them with

    Where a solution lists not all minimal maps, its backbone says what all of them share; that is found out by reasoning, which may take as long as the search
    was allowed to. Raises MapError where there are no maps, or where they are maps of several traces.
    """
    listing = Listing.of(maps)
    listing_there = None if other is None else Listing.of(other)
    if listing_there:
        listing.check_same_trace(listing_there)
    table = Table(listing.maps)
    listed = replace(table.shared(), proven=listing.complete is True)
    shared = listing.backbone if listing.backbone and listing.complete is False else listed
    _check_backbone(shared, listed, listing)
    asked = _questions(
        table, listing.maps, same_places=bool(listed.places and not listed.places.sometimes)
    )
    order = deciding(
        [a.column for a in asked], len(table), [MATTERS.index(a.question.sort) for a in asked]
    )
    choices = [
        [asked[order[k]] for k in choice]
        for choice in independent([asked[i].column for i in order])
    ]
    options = [options_of([a.column for a in choice], len(table)) for choice in choices]
    of_choice, together = _depending(asked, options, table)
    fits = [ssh_map.fit.chi2 for ssh_map in listing.maps if ssh_map.fit]
    return Comparison(
        ids=tuple(ssh_map.id for ssh_map in listing.maps),
        steps=listing.steps,
        minimal=listing.minimal,
        complete=listing.complete,
        stopped=listing.stopped if listing.complete is False else None,
        shared=shared,
        listed=listed,
        variants=_variants(table, listing.maps),
        choices=tuple(_choice(*told) for told in zip(choices, options, of_choice, strict=True)),
        together=together,
        deciding=tuple(asked[i].question for i in order),
        sizes=_sizes(listing.maps),
        fits=(min(fits), max(fits)) if fits else None,
        others=_others(listing, listing_there) if listing_there else None,
    )


@dataclass(frozen=True, slots=True)
class _Asked:
    """A question, what the maps answer, and for each sort the steps about which the same is asked."""

    question: Question
    column: Bools
    steps: dict[Matter, set[int]]


def _questions(table: Table, maps: Sequence[SSHMap], *, same_places: bool) -> list[_Asked]:
    """All questions that tell maps apart, each once: in the order of causes, and the earliest steps first."""
    found: dict[bytes, _Asked] = {}
    faults = {fault for ssh_map in maps for fault in ssh_map.faults}
    for fault in sorted(faults, key=lambda f: (f.step, f.kind, str(f.seen), str(f.expected))):
        column = np.array([fault in ssh_map.faults for ssh_map in maps])
        if not column.all():
            question = Question(
                "faults",
                fault.step,
                fault.step,
                int(column.sum()),
                (fault.step,),
                (fault.step,),
                fault=fault,
            )
            found.setdefault(_key(column), _Asked(question, column, {})).steps.setdefault(
                "faults", set()
            ).add(fault.step)
    places = [maps[0].dstates[label].place for label in maps[0].labels] if same_places else []
    steps_by_class = _members(table.classes.tolist())
    for sort in table.ones:
        heads = table.heads(sort).tolist()
        together = _members(heads)
        for c, d, column in table.questions(sort):
            key = _key(column)
            if key not in found:
                sides = [
                    sorted(t for k in together[heads[side]] for t in steps_by_class[k])
                    for side in (c, d)
                ]
                stand = (
                    [
                        tuple(sorted({p for t in side if (p := places[t]) is not None}))
                        for side in sides
                    ]
                    if places
                    else []
                )
                question = Question(
                    sort,
                    first=int(table.firsts[c]),
                    later=int(table.firsts[d]),
                    yes=int(column.sum()),
                    here=tuple(sides[0]),
                    there=tuple(sides[1]),
                    places=(stand[0], stand[1]) if stand and sort in ("paths", "courses") else None,
                )
                found[key] = _Asked(question, column, {})
            found[key].steps.setdefault(sort, set()).update(steps_by_class[d])
    return sorted(
        found.values(),
        key=lambda a: (MATTERS.index(a.question.sort), a.question.later, a.question.first),
    )


def _key(column: Bools) -> bytes:
    """The same for columns that are equal or opposite: questions with such answers are one question."""
    return np.packbits(column ^ column[0]).tobytes()


def _members(numbers: Sequence[int]) -> dict[int, list[int]]:
    """For each number where it stands."""
    members: dict[int, list[int]] = {}
    for i, number in enumerate(numbers):
        members.setdefault(number, []).append(i)
    return members


def _depending(
    asked: Sequence[_Asked], options: Sequence[NDArray[np.intp]], table: Table
) -> tuple[list[dict[Matter, tuple[int, ...]]], dict[Matter, tuple[int, ...]]]:
    """For each choice, and for several together, the steps that depend on it."""
    of_choice: list[dict[Matter, set[int]]] = [{} for _ in options]
    together: dict[Matter, set[int]] = {}
    sizes = [np.bincount(option) for option in options]
    for question in asked:
        for k, option in enumerate(options):
            yes = np.bincount(option, weights=question.column)
            if ((yes == 0) | (yes == sizes[k])).all():
                whose = of_choice[k]
                break
        else:
            whose = together
        for sort, steps in question.steps.items():
            whose.setdefault(sort, set()).update(steps)
    return [_in_order(steps) for steps in of_choice], _in_order(together)


def _in_order(steps: dict[Matter, set[int]]) -> dict[Matter, tuple[int, ...]]:
    return {sort: tuple(sorted(steps[sort])) for sort in MATTERS if sort in steps}


def _choice(
    asked: Sequence[_Asked], option: NDArray[np.intp], differing: dict[Matter, tuple[int, ...]]
) -> Choice:
    members = _members(option.tolist())
    options = [
        Option(tuple(bool(a.column[maps[0]]) for a in asked), tuple(i + 1 for i in maps))
        for maps in members.values()
    ]
    return Choice(tuple(a.question for a in asked), tuple(options), differing)


def _variants(table: Table, maps: Sequence[SSHMap]) -> dict[Matter, int]:
    """How many different ones there are of each sort."""
    faults: dict[Matter, int] = (
        {"faults": len({m.faults for m in maps})} if any(m.faults for m in maps) else {}
    )
    return faults | {sort: table.variants(sort) for sort in table.ones}


def _sizes(maps: Sequence[SSHMap]) -> tuple[tuple[tuple[int, int, int], int], ...]:
    counts = Counter(
        (len(ssh_map.dstates), len(ssh_map.places), len(ssh_map.paths)) for ssh_map in maps
    )
    return tuple(sorted(counts.items()))


def _others(here: Listing, there: Listing) -> Others:
    number = {ssh_map.renumbered(): i for i, ssh_map in reversed(list(enumerate(there.maps, 1)))}
    both = {i: number.get(ssh_map.renumbered()) for i, ssh_map in enumerate(here.maps, 1)}
    pairs = tuple((i, j) for i, j in both.items() if j)
    shared = {here.maps[i - 1].renumbered() for i, _ in pairs}
    best = difference(here.maps[0], there.maps[0], ("map 1", f"map 1 of {there.source}"))
    only_there = tuple(
        j for j, ssh_map in enumerate(there.maps, 1) if ssh_map.renumbered() not in shared
    )
    return Others(
        len(there.maps),
        pairs,
        tuple(i for i, j in both.items() if not j),
        only_there,
        best,
        there.source,
    )


def _check_backbone(shared: Backbone, listed: Backbone, listing: Listing) -> None:
    """Whether what is said of all minimal maps is true of those listed. Raises MapError."""
    if shared is listed:
        return
    for sort, told in shared.sorts.items():
        seen = listed.sorts.get(sort)
        # Steps of one dstate have one number even where they are along no path, which says nothing of other maps.
        in_one = listed.dstates.always if sort in ("paths", "courses") else range(listing.steps)
        if seen is not None and (wrong := _contradiction(told, seen, in_one)):
            first, later = wrong
            mend = "the file was changed by hand, or its maps are of another search: solve again"
            raise MapError(
                f"{listing.source}: backbone: {sort}: steps {first} and {later} are not as the maps listed have them; {mend}"
            )


def _contradiction(told: Shared, seen: Shared, in_one: Sequence[int]) -> tuple[int, int] | None:
    """Two steps that are one in all maps, as is told, and not in all that are seen; or one in no map, as is told, and in some that are seen.

    in_one  a number for each step; of two steps with the same number the latter is not asked
    """
    first_of: dict[int, int] = {}
    for t, number in enumerate(told.always):
        first = first_of.setdefault(number, t)
        if seen.always[first] != seen.always[t]:
            return first, t
    if told.untold:
        return None
    may_be = {(told.always[i], told.always[j]) for i, j in told.sometimes}
    firsts = ((seen.always.index(number), t) for t, number in enumerate(seen.always))
    one = [*seen.sometimes, *((first, t) for first, t in firsts if in_one[first] != in_one[t])]
    for i, j in one:
        pair = told.always[i], told.always[j]
        if (
            (pair[0] != pair[1] or i == j != seen.always.index(seen.always[i]))
            and pair not in may_be
            and pair[::-1] not in may_be
        ):
            return i, j
    return None


def _steps(steps: Sequence[int]) -> str:
    return f"{'step' if len(steps) == 1 else 'steps'} {stretches(steps)}"
