"""Lifts as evidence: a lift leads to another floor, and from one place to one place.

A *stretch* is the steps of a drive between two lifts. The stretches before and after a lift are on
different floors. So no two of their steps are at one place. Two stretches are on one floor if they
have a dstate or a place in common, or if other stretches connect them in this way.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise, product
from typing import ClassVar

from ssh_abduction.data.drives import stretches_of
from ssh_abduction.data.groups import gathered, way
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.theory.evidence.protocol import Equality, Evidence, remembered
from ssh_abduction.theory.pairs import Pairs

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
        return remembered(self.known, (stretches_of(trace), _lifted(trace)), _pairs)

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


def _pairs(ridden: _Ridden) -> Pairs:
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
