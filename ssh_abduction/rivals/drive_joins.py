"""Find the places that two drives of a joint trace share: in all maps, in some, or in none.

>>> from ssh_abduction import Theory, Trace, solve
>>> from ssh_abduction.rivals.listing import Listing
>>> monday = Trace.from_steps("abc", ["travel", "travel"], name="monday")
>>> tuesday = Trace.from_steps("cd", ["travel"], name="tuesday")
>>> solution = solve([monday, tuesday], Theory.causal())
>>> print(*joins_of_drives(Listing.of(solution)))  # doctest: +NORMALIZE_WHITESPACE
monday and tuesday: 1 dstate in common in all maps (monday:2 = tuesday:0);
5 pairs of dstates joined in no map
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import TypeAlias

from ssh_abduction.data.checks import an_instance
from ssh_abduction.data.drives import Drive
from ssh_abduction.data.errors import MapError
from ssh_abduction.data.groups import firsts, gathered
from ssh_abduction.data.schema import PlainData
from ssh_abduction.data.words import counted
from ssh_abduction.rivals.listing import Listing, trusted
from ssh_abduction.solver import probability_in_words

ALMOST = 1 - 1e-9  # the largest share of a join that some map lacks
SHOWN = 6  # a sentence names at most this many joins of a kind

_Placing: TypeAlias = Sequence[int]  # the place of each step by one map; without places, the dstate


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
    return tuple(
        _pair(one, other, placings, weights, of, proven, count)
        for one, other in combinations(listing.drives, 2)
    )


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


def _pair(
    one: Drive,
    other: Drive,
    placings: Sequence[_Placing],
    weights: Sequence[float],
    of: str,
    proven: bool,
    count: int | None,
) -> DrivePair:
    """Find the places that two drives share. `of` is "dstate" if maps have no places."""
    forced: list[DriveJoin] = []
    possible: list[DriveJoin] = []
    excluded = 0
    for here in _visits(one, placings):
        for there in _visits(other, placings):
            weighed = list(zip(weights, placings, strict=True))
            joins = (
                DriveJoin(i, j, math.fsum(w for w, at in weighed if at[i] == at[j]))
                for i, j in product(here, there)
            )
            # Of the steps at both places, take the pair that is most often at one place.
            join = max(joins, key=lambda join: join.share)
            if join.share == 0:
                excluded += 1
                continue
            first, second = join.first - one.first, join.second - other.first
            is_forced = all(at[join.first] == at[join.second] for at in placings)
            (forced if is_forced else possible).append(
                DriveJoin(first, second, 1.0 if is_forced else min(join.share, ALMOST))
            )
    possible.sort(key=lambda join: -join.share)
    return DrivePair(
        one.name, other.name, of, tuple(forced), tuple(possible), excluded, proven, count
    )


def _visits(drive: Drive, placings: Sequence[_Placing]) -> list[list[int]]:
    """List the first steps of a drive's visits to each place of the first map."""
    first = firsts((tuple(at[t] for at in placings), t) for t in range(drive.first, drive.stop))
    return list(gathered((names[0], t) for names, t in first.items()).values())
