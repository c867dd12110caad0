"""What a list of maps already says about the places of two steps, before any new search."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ssh_abduction.rivals.listing import Listing
from ssh_abduction.solver import probability_in_words


@dataclass(frozen=True, slots=True)
class PairInMap:
    """What the first map of a list says about the places of two steps.

    Attributes:
        is_one_place: Whether the two steps are at one place.
        probability: The probability that they are; None if maps were not compared by cost.
        nats: The extra cost, in nats, of the best known map that contradicts `is_one_place`; None
            if no such map is known.
        is_estimated: Whether that map was only estimated, so that it may break axioms.
    """

    is_one_place: bool
    probability: float | None
    nats: float | None
    is_estimated: bool = False

    @classmethod
    def of(cls, listing: Listing, first: int, second: int) -> PairInMap | None:
        """Compare the places of two steps; None without places."""
        at = [listing.maps[0].place_of(step) for step in (first, second)]
        if None in at:
            return None
        weighed = listing.weighed
        if weighed is None:
            return cls(at[0] == at[1], None, None)
        rival = weighed.rival_if_other(first, second)
        return cls(
            at[0] == at[1],
            None if weighed.doubt is not None else weighed.probability(first, second, "place"),
            rival.nats - weighed.nats if rival else None,
            rival is not None and rival.estimated,
        )

    def __str__(self) -> str:
        text = f"in map 1, the steps are at {'one place' if self.is_one_place else 'two places'}"
        if self.probability is not None:
            text += f"; the probability of one place is {probability_in_words(self.probability)}"
        if self.nats is not None:
            other = "two places" if self.is_one_place else "one place"
            text += (
                f"; a map with {other} may cost only {self.nats:.1f} nats more, but was not checked"
                if self.is_estimated
                else f"; the best known map with {other} costs {self.nats:.1f} nats more"
            )
        return text

    def to_dict(self) -> dict[str, Any]:
        """Return the pair as plain data."""
        return {"same_place": self.is_one_place, "probability": self.probability, "nats": self.nats}
