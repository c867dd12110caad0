"""Stars as evidence: steps with different stars are different dstates.

A star is all openings seen at a step. This evidence needs neither places nor right angles.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, ClassVar

from ssh_abduction.data.star import Star
from ssh_abduction.data.trace import Trace
from ssh_abduction.theory.evidence.protocol import Evidence, remembered
from ssh_abduction.theory.pairs import Pairs

if TYPE_CHECKING:
    from ssh_abduction.theory.theory import Theory

# A view (None if a dstate may have several views), and a star.
_Seen = tuple[str | int | None, Star]


@dataclass(frozen=True)
class Alike(Evidence):
    """Evidence from stars (openings seen), compared without rotating them.

    Attributes:
        has_one_view: Whether a dstate has only one view. Then steps with different views are
            different dstates anyway, so they give no pairs.
        known: The pairs of the last few traces, for reuse.
    """

    name: ClassVar[str] = "alike"
    axiom: ClassVar[str] = "one_star"
    has_one_view: bool
    known: dict[tuple[_Seen, ...], Pairs] = field(default_factory=dict, compare=False, repr=False)

    @classmethod
    def of(cls, theory: Theory) -> Alike:
        return cls("functional_view" in theory.hard and not theory.unknown_views)

    def pairs(self, trace: Trace) -> Pairs:
        seen: tuple[_Seen, ...] = tuple(
            (step.view if self.has_one_view else None, step.gateways or Star(()))
            for step in trace.steps
        )
        return remembered(self.known, seen, _pairs)

    def remembering(self, known: Alike) -> Alike:
        return replace(self, known=known.known)


def _pairs(seen: tuple[_Seen, ...]) -> Pairs:
    """Return the pairs of steps with the same view, but with stars that are not alike."""
    steps: dict[str | int | None, dict[Star, list[int]]] = {}
    apart: dict[int, frozenset[int]] = {}
    for t, (view, star) in enumerate(seen):
        others = steps.setdefault(view, {})
        if unlike := [
            i for other, there in others.items() if not are_alike(other, star) for i in there
        ]:
            apart[t] = frozenset(unlike)
        others.setdefault(star, []).append(t)
    return Pairs(apart)


@lru_cache(maxsize=2**16)
def are_alike(one: Star, other: Star) -> bool:
    """Whether two stars may show the same gateways to a robot that has not turned.

    Each gateway that is seen in one star must match a gateway of the other star, each a different
    one. A gateway that was not observed may match or not exist. It is enough to match the seen
    gateways of each star separately (Mendelsohn & Dulmage 1958).
    """
    return _pairable(one, other) and _pairable(other, one)


def _pairable(one: Star, other: Star) -> bool:
    """Whether all gateways seen in one star match different gateways of the other, by bearing."""
    partner: dict[int, int] = {}  # gateways of `one`, by their partner in `other`

    def pair(k: int, tried: set[int]) -> bool:
        """Find a partner for gateway k. A gateway that loses its partner to k gets another one."""
        here = one.gateways[k]
        for j, there in enumerate(other.gateways):
            if (
                j not in tried
                and abs((here.bearing - there.bearing + 180) % 360 - 180)
                <= here.spread + there.spread
            ):
                tried.add(j)
                if j not in partner or pair(partner[j], tried):
                    partner[j] = k
                    return True
        return False

    return all(pair(k, set()) for k, gateway in enumerate(one.gateways) if gateway.open)
