"""A list of maps of one trace, from a solution, a file or Python, and whether it is complete.

>>> from ssh_abduction.data.maps import DState, SSHMap
>>> one = SSHMap((0, 0), (DState(0, "hall"),), ())
>>> Listing.of([one]).steps
2
>>> Listing.of([one, SSHMap((0,), (DState(0, "hall"),), ())])  # doctest: +ELLIPSIS
Traceback (most recent call last):
ssh_abduction.data.errors.MapError: maps[1]: expected 2 steps, as maps[0] has, got 1; ...

In the maps of a joint trace, two drives share places: in all maps, in some, or in none.

>>> from ssh_abduction import Theory, Trace, solve
>>> monday = Trace.from_steps("abc", ["travel", "travel"], name="monday")
>>> tuesday = Trace.from_steps("cd", ["travel"], name="tuesday")
>>> solution = solve([monday, tuesday], Theory.causal())
>>> print(*joins_of_drives(Listing.of(solution)))  # doctest: +NORMALIZE_WHITESPACE
monday and tuesday: 1 dstate in common in all maps (monday:2 = tuesday:0);
5 pairs of dstates joined in no map
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, product
from typing import Any, TypeAlias

from ssh_abduction.data.checks import a_path, a_text, an_instance
from ssh_abduction.data.corrections import named_beside
from ssh_abduction.data.drives import Drive, pieces_in_words
from ssh_abduction.data.errors import MapError, brief, named
from ssh_abduction.data.groups import firsts, gathered
from ssh_abduction.data.map_parts import Fault, read_json
from ssh_abduction.data.maps import ID_LENGTH, SSHMap, checked_maps, maps_of
from ssh_abduction.data.schema import PlainData
from ssh_abduction.data.trace import View
from ssh_abduction.data.words import counted
from ssh_abduction.solution import (
    Backbone,
    Solution,
    Status,
    Weighed,
    probability_in_words,
    verdict_of,
)
from ssh_abduction.theory.joins import Join, joins_in_words

# The fields by which the file of a solution is known. Other files have only maps.
OF_SOLUTION = {"maps", "theory", "steps", "status", "complete"}
# How to mend maps that show different views at a step.
ONE_TRACE = "compare maps of one trace (if it has unknown views, give solutions, not their maps)"
ALMOST = 1 - 1e-9  # the largest share of a join that some map lacks
SHOWN = 6  # a sentence names at most this many joins of a kind
_Placing: TypeAlias = Sequence[int]  # the place of each step by one map; without places, the dstate


@dataclass(frozen=True, slots=True)
class Listing:
    """A list of maps of one trace, with what is known about the maps that are not listed.

    Attributes:
        maps: The maps.
        minimal: The number of maps at the start of the list that are proven minimal; None if
            unknown.
        complete: Whether all minimal maps are listed; None if unknown.
        stopped: Why listing ended before it was complete; None if it did not, or if this is
            unknown.
        backbone: What all minimal maps share, listed or not; None if unknown.
        source: The name of the list, for messages.
        weighed: The costs of the maps in nats, if they were compared by cost; else None.
        by_minimality: The joins of the first map that no axiom and no observation forces, if known.
        drives: The drives of a joint trace; empty if there is one drive.
        warnings: Sentences about what is suspicious in the trace, if known.
        one_view: Whether each dstate has one view, and the views of all steps are known. Then a map
            shows what was seen at each step.
    """

    maps: tuple[SSHMap, ...]
    minimal: int | None = None
    complete: bool | None = None
    stopped: str | None = None
    backbone: Backbone | None = field(default=None, repr=False)
    source: str = "maps"
    weighed: Weighed | None = None
    by_minimality: tuple[Join, ...] = ()
    drives: tuple[Drive, ...] = ()
    warnings: tuple[str, ...] = ()
    one_view: bool = True

    @property
    def steps(self) -> int:
        """The number of steps of the trace."""
        return len(self.maps[0].dstate_at)

    @property
    def faults(self) -> tuple[Fault, ...]:
        """The faults that all listed maps have, such as gateways that changed between drives."""
        first, *others = self.maps
        return tuple(f for f in first.faults if all(f in ssh_map.faults for ssh_map in others))

    @property
    def joined(self) -> str:
        """Which drives the first map joins, in words; empty for a single drive."""
        return pieces_in_words(self.drives, self.maps[0])

    @property
    def verdict(self) -> str:
        """What was found and how sure it is, in a few words."""
        best = self.maps[0]
        unproven = 0 if self.complete is False else None
        return verdict_of(
            len(best.places or best.dstates),
            bool(best.places),
            self.weighed,
            unproven if self.minimal is None else self.minimal,
            listed=self.complete,
            unforced=len(self.by_minimality),
        )

    @property
    def sureness(self) -> str:
        """How sure the first map is, in words; an empty text if this is unknown."""
        if self.weighed is not None:
            return self.weighed.sentence
        return joins_in_words(self.by_minimality, len(self.maps), minimal=self.minimal is not None)

    @classmethod
    def of(cls, source: Maps) -> Listing:
        """Make a listing from a solution, a map or several maps.

        Args:
            source: A Solution, an SSHMap, or maps. A Listing is returned as it is.

        Raises:
            MapError: There are no maps, or they are maps of several traces.
        """
        if isinstance(source, Listing):
            return source
        if isinstance(source, Solution):
            return cls._of(source)
        if isinstance(source, SSHMap):
            source = [source]
        if isinstance(source, str | os.PathLike | Mapping) or not isinstance(source, Iterable):
            raise MapError(
                f"maps: expected a solution or maps, got {brief(source)}; read a file with "
                "Listing.load"
            )
        return cls(checked_maps(source)).checked()

    @classmethod
    def _of(cls, solution: Solution, where: str = "maps") -> Listing:
        """Make a listing from a solution. `where` is its name in messages."""
        minimal, theory = len(solution.minimal_maps), solution.theory
        listing = cls(
            solution.maps,
            minimal if solution.status is Status.OPTIMAL else None,
            solution.minimal_listed,
            solution.stopped,
            solution.backbone if solution.maps else None,
            where,
            solution.weighed,
            solution.by_minimality,
            solution.support.drives or solution.drives,  # those of a file have fingerprints
            solution.warnings,
            "functional_view" not in theory.without and not theory.unknown_views,
        )
        return listing.checked()

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Listing:
        """Read what `solve --json` printed, or the one map that `SSHMap.save` wrote.

        Args:
            path: The file, or "-" for standard input.

        Raises:
            MapError: The file cannot be read, or does not hold maps of one trace.
        """
        where = "standard input" if str(path) == "-" else named(path)
        return cls.from_dict(read_json(path), where).named_beside(path)

    def named_beside(self, path: str | os.PathLike[str]) -> Listing:
        """Return this listing with the names that a person gave.

        They are in the file of corrections beside the file of maps.

        Args:
            path: The file of the maps, or "-".

        Raises:
            MapError: The file of corrections is malformed.
        """
        a_path("path", path, MapError)
        return replace(self, maps=named_beside(self.maps, self.drives, path))

    @classmethod
    def from_dict(cls, data: Any, where: str = "maps") -> Listing:
        """Make a listing from what `solve --json` printed (docs/reference/formats.md).

        Args:
            data: The value that was read from JSON.
            where: The name of the data, for messages.

        Raises:
            MapError: A field is wrong. The message names the field.
        """
        a_text("where", where, MapError)
        if not (isinstance(data, Mapping) and data.keys() >= OF_SOLUTION):
            maps = tuple(ssh_map.renumbered() for ssh_map in maps_of(data, where))
            return cls(maps, source=where).checked()
        solution = Solution.from_dict(data, where)
        maps = tuple(ssh_map.renumbered() for ssh_map in solution.maps)
        for i, (record, ssh_map) in enumerate(zip(data["maps"], maps, strict=True)):
            if "id" in record and record["id"] != ssh_map.id:
                mend = "the map was changed by hand: solve again, or leave the id out"
                raise MapError(
                    f"{where}: maps[{i}]: id: expected {ssh_map.id}, as such a map has, got "
                    f"{brief(record['id'])}; {mend}"
                )
        return cls._of(replace(solution, maps=maps), where)

    def checked(self) -> Listing:
        """Return the listing if its maps can be those of one trace.

        Raises:
            MapError: There are no maps, or they are maps of several traces.
        """
        if not self.maps:
            raise MapError(
                f"{self.source}: expected maps, got none; see the status that solve gave"
            )
        first = None
        for i, ssh_map in enumerate(self.maps):
            if len(ssh_map.dstate_at) != self.steps:
                raise MapError(
                    f"{self._name(i)}: expected {self.steps} steps, as {self._name(0)} has, got "
                    f"{len(ssh_map.dstate_at)}; compare maps of one trace"
                )
            if not self.one_view:
                continue
            seen = _seen(ssh_map)
            first = first or seen
            _check_views(first, seen, self._name(i), f"{self._name(0)} has")
        return self

    def check_same_trace(self, other: Listing) -> None:
        """Raise MapError if the maps of another listing cannot be of the same trace."""
        an_instance(
            "other", other, Listing, MapError, mend="make one with Listing.of or Listing.load"
        )
        ours = "the first maps" if self.source == "maps" else f"the maps of {self.source}"
        if other.steps != self.steps:
            raise MapError(
                f"{other.source}: expected {self.steps} steps, as {ours} have, got {other.steps}; "
                "compare maps of one trace"
            )
        if self.one_view and other.one_view:
            _check_views(_seen(self.maps[0]), _seen(other.maps[0]), other.source, f"{ours} have")

    def number(self, name: str) -> int:
        """Find the index of a map, counted from 0.

        Args:
            name: The number of the map, counted from 1, or its id.

        Raises:
            MapError: There is no such map.
        """
        text = str(name)
        is_number = len(text) < ID_LENGTH and text.isdecimal() and text.isascii()
        if is_number and 1 <= int(text) <= len(self.maps):
            return int(text) - 1
        found = [i for i, ssh_map in enumerate(self.maps) if ssh_map.id == text]
        if not found:
            raise MapError(
                f"{self.source}: expected the number of a map, 1 to {len(self.maps)}, or its id, "
                f"got {brief(text)}; see the file"
            )
        return found[0]

    def _name(self, i: int) -> str:
        """Name the map with index i, for messages."""
        return f"maps[{i}]" if self.source == "maps" else f"{self.source}: maps[{i}]"


Maps: TypeAlias = Solution | Listing | SSHMap | Iterable[SSHMap]


def _check_views(
    ours: tuple[View | None, ...], theirs: tuple[View | None, ...], name: str, we_have: str
) -> None:
    """Raise MapError if two maps show different views at some step."""
    if ours != theirs:
        t = next(t for t, (a, b) in enumerate(zip(ours, theirs, strict=True)) if a != b)
        raise MapError(
            f"{name}: expected the view {brief(ours[t])} at step {t}, as {we_have}, got "
            f"{brief(theirs[t])}; {ONE_TRACE}"
        )


def _seen(ssh_map: SSHMap) -> tuple[View | None, ...]:
    """List the view seen at each step, from a map in which each dstate has one view."""
    views = [s.view for s in ssh_map.dstates]
    seen = [views[label] for label in ssh_map.dstate_at]
    for fault in ssh_map.faults:
        if fault.kind == "misread" and fault.seen is not None:
            seen[fault.step] = fault.seen
    return tuple(seen)


def trusted(weighed: Weighed | None) -> Weighed | None:
    """Return the costs of maps if probabilities follow from them, else None.

    None follow if the search did not finish, or if there is a reason to doubt the costs.
    """
    return None if weighed is None or weighed.confidence is None else weighed


@dataclass(frozen=True, slots=True)
class PairInMap:
    """What the first map of a list says about the places of two steps."""

    places: tuple[str, ...]  # where the two steps are, such as "place 4 (kitchen)"; one if equal
    # The probability that they are; None if it is unknown, as without costs in nats, or if the
    # search did not finish.
    probability: float | None

    @classmethod
    def of(cls, listing: Listing, first: int, second: int) -> PairInMap | None:
        """Compare the places of two steps; None without places."""
        ssh_map = listing.maps[0]
        at = dict.fromkeys(ssh_map.place_of(step) for step in (first, second))
        if None in at:
            return None
        weighed = trusted(listing.weighed)
        share = None if weighed is None else weighed.probability(first, second, "place")
        return cls(tuple(ssh_map.called("place", p) for p in at if p is not None), share)

    def __str__(self) -> str:
        number = "two places" if self.places[1:] else "one place"
        text = f"in map 1, the steps are at {number}, {' and '.join(self.places)}"
        if self.probability is not None:
            text += f"; the probability of one place is {probability_in_words(self.probability)}"
        return text

    def to_dict(self) -> dict[str, Any]:
        """Return the pair as plain data."""
        return {"same_place": not self.places[1:], "probability": self.probability}


@dataclass(frozen=True, slots=True)
class DriveJoin(PlainData):
    """A step of one drive and a step of another drive that are at one place in some map."""

    first: int  # the number of the step in its own drive
    second: int  # the number of the other step in its own drive
    # The share of the maps, 0 to 1, in which both are at one place. If maps were compared by cost
    # in nats, and these costs can be trusted, this is the probability that they are.
    share: float


@dataclass(frozen=True, slots=True)
class DrivePair(PlainData):
    """The places that two drives share.

    A join is two steps, one of each drive, at one place. Many joins may be about the same two
    places of the first map. Only the most probable one of these is listed.

    Attributes:
        first: The name of the earlier drive.
        second: The name of the later drive.
        of: "place"; or "dstate", if maps have no places.
        forced: The joins in all maps.
        possible: The joins in some maps, but not in all.
        excluded: The number of pairs of places that are one place in no map.
        proven: Whether all maps are known. If not, other maps may differ.
        of_maps: The number of maps that were compared; None if joins have a probability instead.
    """

    first: str
    second: str
    of: str
    forced: tuple[DriveJoin, ...]
    possible: tuple[DriveJoin, ...]
    excluded: int
    proven: bool
    of_maps: int | None

    def how_sure(self, join: DriveJoin) -> str:
        """Say in how many maps two drives have a join, or how probable the join is."""
        if join in self.forced:
            return "all maps" if self.proven else "all maps that were found"
        if self.of_maps is None:
            return probability_in_words(join.share)
        return f"{round(join.share * self.of_maps)} of {self.of_maps} maps"

    @property
    def not_forced(self) -> str:
        """Say how many joins are possible, and what is known of them."""
        maps = "maps" if self.proven else "maps that were found"
        each = "each with" if len(self.possible) > 1 else "with"
        known = f"{each} its probability" if self.of_maps is None else f"in some {maps}"
        return f"{counted(len(self.possible), 'possible joins')}, {known}"

    def __str__(self) -> str:
        maps = "maps" if self.proven else "maps that were found"
        parts = []
        if self.forced:
            number = counted(len(self.forced), f"{self.of}s")
            parts.append(f"{number} in common in all {maps} ({self._named(self.forced)})")
        if self.possible:
            parts.append(f"{self.not_forced} ({self._named(self.possible)})")
        if parts and self.excluded:
            parts.append(f"{counted(self.excluded, 'pairs')} of {self.of}s joined in no map")
        text = "; ".join(parts) or f"nothing in common in any of the {maps}"
        return f"{self.first} and {self.second}: {text}"

    def _named(self, joins: Sequence[DriveJoin]) -> str:
        """Put joins into words: "monday:2 = tuesday:0". At most SHOWN of them are named."""
        shown = [
            f"{self.first}:{join.first} = {self.second}:{join.second}"
            + ("" if joins is self.forced else f", {self.how_sure(join)}")
            for join in joins[:SHOWN]
        ]
        more = len(joins) - SHOWN
        return "; ".join([*shown, *([f"and {more} more"] if more > 0 else [])])


def joins_of_drives(listing: Listing) -> tuple[DrivePair, ...]:
    """Find what each pair of drives has in common in the maps of a joint trace.

    Args:
        listing: The maps. If they are compared by cost, rivals with a higher cost count, too.

    Returns:
        A value for each pair of drives, in order; empty for the maps of a single drive.
    """
    an_instance("listing", listing, Listing, MapError, mend="make one with Listing.of")
    placings, weights, proven = _placings(listing)
    count = None if trusted(listing.weighed) else len(placings)
    of = "place" if listing.maps[0].places else "dstate"

    def share(steps: tuple[int, int]) -> float:
        """The share of the maps in which two steps are at one place; 1.0 only for all maps."""
        are_one = [at[steps[0]] == at[steps[1]] for at in placings]
        sum_of_some = math.fsum(w for w, is_one in zip(weights, are_one, strict=True) if is_one)
        return 1.0 if all(are_one) else min(sum_of_some, ALMOST)

    def pair(one: Drive, other: Drive) -> DrivePair:
        joins = []
        for places in product(_visits(one, placings), _visits(other, placings)):
            # Of the steps at both places, take the pair that is most often at one place.
            steps = max(product(*places), key=share)
            joins.append(DriveJoin(steps[0] - one.first, steps[1] - other.first, share(steps)))
        forced = tuple(join for join in joins if join.share == 1)
        possible = sorted((j for j in joins if 0 < j.share < 1), key=lambda join: -join.share)
        excluded = len(joins) - len(forced) - len(possible)
        names = one.name, other.name
        return DrivePair(*names, of, forced, tuple(possible), excluded, proven, count)

    return tuple(pair(*drives) for drives in combinations(listing.drives, 2))


def _placings(listing: Listing) -> tuple[list[_Placing], list[float], bool]:
    """Return the place of each step in each map, the weights of maps, and if all are listed."""
    weighed = listing.weighed
    if weighed is not None:
        at: list[_Placing] = [rival.places or rival.dstates for rival in weighed.rivals]
        weights = weighed.weights if trusted(weighed) else [1 / len(at)] * len(at)
        return at, [*weights], weighed.within > 0
    placings: list[_Placing] = [
        [s if (place := ssh_map.dstates[s].place) is None else place for s in ssh_map.dstate_at]
        for ssh_map in listing.maps[: listing.minimal]
    ]
    return placings, [1 / len(placings)] * len(placings), listing.complete is True


def _visits(drive: Drive, placings: Sequence[_Placing]) -> list[list[int]]:
    """List the first steps of a drive's visits to each place of the first map."""
    first = firsts((tuple(at[t] for at in placings), t) for t in range(drive.first, drive.stop))
    return list(gathered((names[0], t) for names, t in first.items()).values())
