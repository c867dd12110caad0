"""Compare rival maps: what they share, where they differ, and which steps decide between them.

>>> from ssh_abduction import Trace, solve
>>> from ssh_abduction.rivals.comparison import compare
>>> found = compare(solve(Trace.load("examples/aces3-route.jsonl")))
>>> for part in found.sentence.split("; "):
...     print(part)
4 minimal maps: the same dstates
the places of steps 15–18 and 21 differ
the paths of steps 18–22 differ
>>> [len(choice.options) for choice in found.choices]
[2, 2]
>>> print(found.deciding[0])
steps 17–18 and 21 are at the place of step 14

Questions distinguish maps, for example: are steps 3 and 7 one dstate? (`rivals/questions.py`). A
few questions decide: their answers fix the answers to all others (`rivals/questions.py`). Deciding
questions are asked so that causes come first: faults, dstates, places, paths, directions. A choice
is a set of deciding questions that depend on each other. Its options are the ways to answer them.
Each combination of one option per choice is a map.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.errors import MapError, printable
from ssh_abduction.data.groups import first_index_of, indices_of
from ssh_abduction.data.schema import PlainData, attributes_of
from ssh_abduction.data.words import counted
from ssh_abduction.rivals.differences import Difference, difference
from ssh_abduction.rivals.listing import Listing, Maps
from ssh_abduction.rivals.questions import (
    MATTERS,
    AnsweredQuestion,
    Matter,
    Question,
    Table,
    deciding,
    independent,
    options_of,
    questions_of,
)
from ssh_abduction.solution import Backbone, Shared, Sharing


@dataclass(frozen=True, slots=True)
class Option:
    """One way to answer the questions of a choice."""

    answers: tuple[bool, ...]  # the answers, in the order of the questions of the choice
    # The numbers of the maps with these answers, counted from 1.
    maps: tuple[int, ...] = field(repr=False)

    def to_dict(self) -> dict[str, Any]:
        """Return the option as plain data, as `compare --json` prints it."""
        return {"answers": list(self.answers), "count": len(self.maps), "maps": list(self.maps)}


@dataclass(frozen=True, slots=True)
class Choice(PlainData):
    """Questions that depend on each other, but on no question of another choice."""

    questions: tuple[Question, ...]  # some of the questions in `Comparison.deciding`
    # The ways in which maps answer these questions, the way of map 1 first.
    options: tuple[Option, ...]
    # For each sort (faults, dstates, places, paths, courses), the steps whose grouping depends on
    # this choice and on no other. A course is a path with a direction.
    differing: dict[Matter, tuple[int, ...]] = field(hash=False)


@dataclass(frozen=True, slots=True)
class Others:
    """A comparison of one list of maps with another list. Maps are numbered from 1."""

    count: int  # the number of maps in the other list
    # The maps that both lists have, up to renaming: pairs of the number in this list and the number
    # in the other list.
    both: tuple[tuple[int, int], ...]
    here: tuple[int, ...]  # the numbers of the maps that only this list has
    there: tuple[int, ...]  # the numbers of the maps that only the other list has
    best: Difference  # the difference between the first maps of both lists
    source: str = "the other file"  # the name of the other list, for messages

    @property
    def sentence(self) -> str:
        """A sentence: the number of maps in both lists, and in only one of them."""
        if not self.here and not self.there:
            maps = f"the {self.count} maps are" if self.count > 1 else "the map is"
            return f"{maps} the same in both"
        return (
            f"of the maps, {len(self.both)} in both, {len(self.here)} only in the first and "
            f"{len(self.there)} only in {printable(self.source)}"
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison as plain data, as `compare --json` prints it."""
        return {
            **attributes_of(self, "count", "sentence", "both"),
            "only_first": list(self.here),
            "only_other": list(self.there),
            "best": self.best.to_dict(),
        }


@dataclass(frozen=True, slots=True)
class Comparison:
    """The result of `compare`: what maps of one trace share, and where they differ.

    A sort is one of faults, dstates, places, paths and courses (paths with a direction).

    Attributes:
        ids: The ids of the maps.
        steps: The number of steps of the trace.
        minimal: The number of maps at the start of the list that are proven minimal; None if
            unknown.
        complete: Whether these are all minimal maps; None if unknown.
        stopped: Why listing ended early; None if it was complete or the reason is unknown.
        shared: What all minimal maps share. If `shared.proven` is False, this is known only of the
            listed maps.
        listed: What the listed maps share.
        variants: For each sort, the number of different groupings of the steps by listed maps.
        choices: The independent choices. Each combination of their options is one listed map.
        together: For each sort, the steps whose grouping depends on several choices together.
        deciding: Questions that distinguish all listed maps, in the order in which to ask them. The
            first ones distinguish all labelings (the dstates of all steps). None is superfluous,
            but a smaller set may exist.
        sizes: Pairs of a size (numbers of dstates, places and paths) and the number of maps with
            this size.
        fits: The least and the greatest chi-square of the maps; None if they were not fitted to
            displacements.
        others: The comparison with another list; None if there is no other list.
        by_cost: Whether the maps were compared by their cost in nats, and not by counts.
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
    by_cost: bool = False

    @property
    def sentence(self) -> str:
        """A sentence: the number of maps, what they share, and where they differ."""
        count = len(self.ids) if self.minimal is None else self.minimal
        is_partial = self.complete is False
        text = counted(count, "maps")
        if self.minimal is not None:
            text = f"{text} of least cost" if self.by_cost else counted(count, "minimal maps")
        if is_partial and self.stopped == "no proof":
            text += f", not proven to be the only one{'s' * (count != 1)}"
        elif is_partial and self.stopped:
            by = "" if self.stopped == "interrupted" else "stopped by the "
            text = f"at least {text} (listing was {by}{self.stopped})"
        elif is_partial:
            text = f"at least {text}"
        more = len(self.ids) - count
        if more:
            text += f", and {more} larger ones"
        if count == 1 and not more and (not is_partial or self.minimal is None):
            return text
        faults = self.variants.get("faults", 0)
        text += f": their faults differ ({faults} ways); " if faults > 1 else ": "
        text += self.shared.sentence
        if is_partial and not self.shared.proven:
            text += ", as far as is known: other maps may differ in more"
        return text

    @property
    def product(self) -> str:
        """The number of maps as a product of the numbers of options, as "780 = 195 x 2 x 2".

        An empty text if there are fewer than two choices.
        """
        if len(self.choices) < 2:
            return ""
        options = " x ".join(str(len(choice.options)) for choice in self.choices)
        return f"{len(self.ids)} = {options}"

    @property
    def unlisted(self) -> dict[Matter, tuple[int, ...]]:
        """For each sort, the steps in which listed maps agree but other minimal maps differ."""
        found: dict[Matter, tuple[int, ...]] = {}
        for sort, shared in self.shared.sorts.items():
            shown = self.listed.sorts.get(sort)
            more = set(shared.differing) - set(shown.differing if shown else ())
            if more:
                found[sort] = tuple(sorted(more))
        return found

    def to_dict(self) -> dict[str, Any]:
        """Return plain data, as `compare --json` prints it (docs/reference/formats.md)."""
        data: dict[str, Any] = {
            "summary": self.sentence,
            "count": len(self.ids),
            **attributes_of(self, "steps", "minimal", "complete", "ids", "shared"),
            **attributes_of(self, "variants", "choices", "together", "deciding"),
            "sizes": [
                {"dstates": dstates, "places": places, "paths": paths, "count": count}
                for (dstates, places, paths), count in self.sizes
            ],
        }
        if self.stopped:
            data["stopped"] = self.stopped
        if self.complete is False:
            data |= attributes_of(self, "listed", "unlisted")
        if self.fits:
            data["chi2"] = list(self.fits)
        return data | (attributes_of(self, "others") if self.others else {})


def compare(maps: Maps, other: Maps | None = None) -> Comparison:
    """Compare maps of one trace: what they share, where they differ, and which steps decide.

    If a solution does not list all minimal maps, its backbone tells what all of them share. The
    listed maps may share more.

    Args:
        maps: A Solution, a Listing (`Listing.load` reads a file), or maps of one trace.
        other: Other maps of the same trace, for `Comparison.others`; None for no such comparison.

    Returns:
        The comparison of `maps` with each other, and with `other`.

    Raises:
        MapError: There are no maps, or they are maps of several traces.
    """
    listing = Listing.of(maps)
    listing_there = None if other is None else Listing.of(other)
    if listing_there:
        listing.check_same_trace(listing_there)
    table = Table(listing.maps, listing.drives)
    shared, listed = _backbones(listing)
    # Ask which steps the maps group differently, and how the answers depend on each other.
    asked = questions_of(
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
    *of_choice, together = _depending(asked, options)
    # Count what the maps have.
    fits = [ssh_map.fit.chi2 for ssh_map in listing.maps if ssh_map.fit]
    sizes = Counter((len(m.dstates), len(m.places), len(m.theory_paths)) for m in listing.maps)
    faults = {m.faults for m in listing.maps}
    variants: dict[Matter, int] = {"faults": len(faults)} if any(faults) else {}
    return Comparison(
        ids=tuple(ssh_map.id for ssh_map in listing.maps),
        steps=listing.steps,
        minimal=listing.minimal,
        complete=listing.complete,
        stopped=listing.stopped if listing.complete is False else None,
        shared=shared,
        listed=listed,
        variants=variants | {sort: table.variants(sort) for sort in table.ones},
        choices=tuple(_choice(*parts) for parts in zip(choices, options, of_choice, strict=True)),
        together=together,
        deciding=tuple(asked[i].question for i in order),
        sizes=tuple(sorted(sizes.items())),
        fits=(min(fits), max(fits)) if fits else None,
        others=_others(listing, listing_there) if listing_there else None,
        by_cost=listing.weighed is not None,
    )


def _backbones(listing: Listing) -> tuple[Backbone, Backbone]:
    """Find what all minimal maps share, as far as it is known, and what the listed maps share.

    They differ only if the list is not complete. Raises MapError if they contradict each other.
    """
    # If some maps have no places, only dstates are compared. The first map decides about that.
    sharing = Sharing(sorted(listing.maps, key=lambda ssh_map: bool(ssh_map.places)))
    listed = replace(sharing.backbone(proven=listing.complete is True), drives=listing.drives)
    if not listing.backbone or listing.complete is not False:
        return listed, listed
    shared = replace(listing.backbone, drives=listing.drives)
    _check_backbone(shared, listed, listing)
    return shared, listed


def _depending(
    asked: Sequence[AnsweredQuestion], options: Sequence[NDArray[np.intp]]
) -> list[dict[Matter, tuple[int, ...]]]:
    """Find the steps whose grouping depends on each choice alone and, last, on several choices."""
    found: list[dict[Matter, set[int]]] = [{} for _ in range(len(options) + 1)]
    for question in asked:
        whose = next((k for k, one in enumerate(options) if _settles(one, question.column)), -1)
        for sort, steps in question.steps.items():
            found[whose].setdefault(sort, set()).update(steps)
    return [{sort: tuple(sorted(of[sort])) for sort in MATTERS if sort in of} for of in found]


def _settles(option: NDArray[np.intp], column: NDArray[np.bool_]) -> bool:
    """Tell whether maps with the same option give the same answer."""
    yes = np.bincount(option, weights=column)
    return bool(((yes == 0) | (yes == np.bincount(option))).all())


def _choice(
    asked: Sequence[AnsweredQuestion],
    option: NDArray[np.intp],
    differing: dict[Matter, tuple[int, ...]],
) -> Choice:
    """Make a choice from the questions `asked`. `option` numbers the option of each map."""
    options = [
        Option(tuple(bool(a.column[maps[0]]) for a in asked), tuple(i + 1 for i in maps))
        for maps in indices_of(option.tolist()).values()
    ]
    return Choice(tuple(a.question for a in asked), tuple(options), differing)


def _others(here: Listing, there: Listing) -> Others:
    """Compare two lists of maps of one trace."""
    ours, theirs = ([ssh_map.renumbered() for ssh_map in some.maps] for some in (here, there))
    number, known = first_index_of(theirs), {*ours}
    names = "map 1", f"map 1 of {there.source}"
    return Others(
        count=len(theirs),
        both=tuple((i, number[m] + 1) for i, m in enumerate(ours, 1) if m in number),
        here=tuple(i for i, m in enumerate(ours, 1) if m not in number),
        there=tuple(j for j, m in enumerate(theirs, 1) if m not in known),
        best=difference(here.maps[0], there.maps[0], names, drives=here.drives),
        source=there.source,
    )


def _check_backbone(shared: Backbone, listed: Backbone, listing: Listing) -> None:
    """Raise MapError if the backbone contradicts the listed maps."""
    for sort, claimed in shared.sorts.items():
        seen = listed.sorts.get(sort)
        # Steps of one dstate share a number even if they are along no path in these maps.
        in_one = listed.dstates.always if sort in ("paths", "courses") else range(listing.steps)
        if seen is not None and (wrong := _contradiction(claimed, seen, in_one)):
            first, later = wrong
            mend = "the file was changed by hand, or its maps are of another search: solve again"
            raise MapError(
                f"{listing.source}: backbone: {sort}: it contradicts the listed maps about "
                f"steps {first} and {later}; {mend}"
            )


def _contradiction(claimed: Shared, seen: Shared, in_one: Sequence[int]) -> tuple[int, int] | None:
    """Find two steps that the backbone joins but a listed map does not, or vice versa."""
    first_of: dict[int, int] = {}
    for t, number in enumerate(claimed.always):
        first = first_of.setdefault(number, t)
        if seen.always[first] != seen.always[t]:
            return first, t
    if claimed.untold:
        return None
    may_be = {(claimed.always[i], claimed.always[j]) for i, j in claimed.sometimes}
    firsts = ((seen.always.index(number), t) for t, number in enumerate(seen.always))
    one = [*seen.sometimes, *((first, t) for first, t in firsts if in_one[first] != in_one[t])]
    for i, j in one:
        pair = claimed.always[i], claimed.always[j]
        if (
            (pair[0] != pair[1] or i == j != seen.always.index(seen.always[i]))
            and pair not in may_be
            and pair[::-1] not in may_be
        ):
            return i, j
    return None
