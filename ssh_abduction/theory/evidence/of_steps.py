"""Evidence about pairs of steps: stars that differ, what a person asserts, closures, and lifts.

A star is all openings seen at a step. Steps with different stars are different dstates. This needs
neither places nor right angles.

A *closure* is the relative pose of two steps, measured by matching what the robot saw around them.
The local maps of two visits may match with an offset that is far from zero, by the covariance of
the match and of the middles of places. Then the visits are not at one place. The axiom `closure`
demands this for each closure alone. The probability `reject` of rejecting a true map is divided
among the returns that may be true, as for displacements. Closures together with displacements
count in the misfit (`solver/geometry/fit.py`).

A lift leads to another floor, and from one place to one place. A *stretch* is the steps of a drive
between two lifts. The stretches before and after a lift are on different floors. So no two of their
steps are at one place. Two stretches are on one floor if they have a dstate or a place in common,
or if other stretches connect them in this way.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import pairwise, product
from typing import TYPE_CHECKING, ClassVar

from ssh_abduction.data.drives import stretches_of
from ssh_abduction.data.groups import gathered, way
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.odometry import Closure, Odometry
from ssh_abduction.data.star import Star
from ssh_abduction.data.trace import Trace
from ssh_abduction.theory.evidence.protocol import Equality, Evidence, remembered
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


@dataclass(frozen=True)
class Asserted(Evidence):
    """Evidence from the fields `same`, `different`, `elsewhere` and `same_place` of a theory.

    Pairs with a step that the trace does not have yet are ignored.
    """

    name: ClassVar[str] = "asserted"
    axiom: ClassVar[str] = "asserted"
    said: Pairs
    together: tuple[tuple[int, int], ...] = ()

    @classmethod
    def of(cls, theory: Theory) -> Asserted:
        return cls(theory.asserted, theory.same_place)

    def pairs(self, trace: Trace) -> Pairs:
        return self.said

    def facts(self, trace: Trace, start: int, stop: int) -> str:
        said = [(i, t) for i, t in self.together if start <= t < stop]
        return "\n".join(f"together({i},{t})." for i, t in said)


@dataclass(frozen=True)
class Closures(Evidence):
    """Evidence from closures, with the fields `reject` and `returns` of a theory.

    Attributes:
        reject: The largest probability of rejecting the true map.
        returns: How many returns may be true.
        has_places: Whether maps have places.
    """

    name: ClassVar[str] = "closure"
    axiom: ClassVar[str] = "closure"
    reject: float
    returns: int
    has_places: bool

    @classmethod
    def of(cls, theory: Theory) -> Closures:
        return cls(theory.reject, theory.returns, theory.level == "topological")

    def pairs(self, trace: Trace) -> Pairs:
        return Pairs.of(self._refused(trace, False), self._refused(trace, True))

    def _refused(self, trace: Trace, places: bool) -> Iterator[tuple[int, int]]:
        """Yield the steps of the closures that rule out one place (`places`), or one dstate."""
        if not trace.closures or (places and not self.has_places):
            return
        from scipy.special import gammainccinv

        most = 2 * gammainccinv((2 if places else 3) / 2, self.reject / max(self.returns, 1))
        odometry = trace.odometry or Odometry()
        for match in trace.closures:
            if _square(match, odometry, places) > most:
                yield match.first, match.last


def _square(match: Closure, odometry: Odometry, places: bool) -> float:
    """The chi-square of a closure if its two steps have one position (`places`), or one pose."""
    import numpy as np

    kept = 2 if places else 3
    ends = 2 * np.diag([odometry.offset, odometry.offset, odometry.facing]) ** 2
    noise = (np.array(match.covariance) + ends)[:kept, :kept]
    off = np.array(match.displacement)
    off[2] = math.remainder(off[2], math.tau)
    return float(off[:kept] @ np.linalg.solve(noise, off[:kept]))


_Ridden = tuple[tuple[int, ...], tuple[int, ...]]  # the stretch of each step, and lifted steps


@dataclass(frozen=True)
class Floors(Evidence):
    """Evidence from actions that lead to other floors.

    Attributes:
        known: The pairs of the last few traces, for reuse.
    """

    name: ClassVar[str] = "floors"
    axiom: ClassVar[str] = "other_floor"
    known: dict[_Ridden, Pairs] = field(default_factory=dict, compare=False, repr=False)

    def pairs(self, trace: Trace) -> Pairs:
        return remembered(self.known, (stretches_of(trace), _lifted(trace)), _floors_apart)

    def remembering(self, known: Floors) -> Floors:
        return replace(self, known=known.known)

    def refuse(self, trace: Trace, ssh_map: SSHMap, since: int = 0) -> frozenset[Equality] | None:
        stretches = stretches_of(trace)
        beside: dict[int, dict[int, Equality]] = {}  # stretches that meet, and where
        for found in _meetings(ssh_map):
            one, other = stretches[found.first], stretches[found.second]
            beside.setdefault(one, {}).setdefault(other, found)
            beside.setdefault(other, {}).setdefault(one, found)
        for t in _lifted(trace):
            if t < len(ssh_map.dstate_at):
                met = way(stretches[t - 1], stretches[t], lambda stretch: beside.get(stretch, ()))
                if len(met) > 1:  # the fewest meetings that connect both
                    return frozenset(beside[one][other] for one, other in pairwise(met))
        return None


def _lifted(trace: Trace) -> tuple[int, ...]:
    """The steps that a lift leads to."""
    return tuple(t for t, action in enumerate(trace.actions, 1) if action.changes_floor)


def _floors_apart(ridden: _Ridden) -> Pairs:
    """Pair each step of the stretch before a lift with each step of the stretch after it."""
    stretches, lifted = ridden
    steps = gathered((stretch, t) for t, stretch in enumerate(stretches))
    return Pairs.of(
        elsewhere=[
            pair for t in lifted for pair in product(steps[stretches[t - 1]], steps[stretches[t]])
        ]
    )


def _meetings(ssh_map: SSHMap) -> Iterator[Equality]:
    """Yield each step where the robot is back at a dstate or place, with the first step there."""
    dstates: dict[int, int] = {}
    places: dict[int, int] = {}
    for t, label in enumerate(ssh_map.dstate_at):
        place = ssh_map.dstates[label].place
        if (first := dstates.setdefault(label, t)) != t:
            yield Equality(first, t)
        elif place is not None and (first := places.setdefault(place, t)) != t:
            yield Equality(first, t, "place")


@dataclass(frozen=True)
class Landings(Evidence):
    """Evidence from lifts that are taken again at the same place.

    A robot may enter a lift with any heading, so at several dstates of a place. It always leaves
    it at the same place of the other floor.
    """

    name: ClassVar[str] = "landings"
    axiom: ClassVar[str] = "one_landing"

    def refuse(self, trace: Trace, ssh_map: SSHMap, since: int = 0) -> frozenset[Equality] | None:
        places = [ssh_map.place_of(t) for t in range(len(ssh_map.dstate_at))]
        first: dict[tuple[int | None, str], int] = {}  # the first step after each lift
        for t in range(1, len(places)):
            action = trace.actions[t - 1]
            if not action.changes_floor or places[t - 1] is None:
                continue
            landing = first.setdefault((places[t - 1], action.name), t)
            if places[landing] != places[t]:
                return frozenset(
                    (
                        Equality(landing - 1, t - 1, "place"),
                        Equality(landing, t, "place", holds=False),
                    )
                )
        return None
