"""Compute the price of laying drives on each other, which is part of the cost of a joint map.

Nothing is known of where a drive starts. So it can be laid on a map of other drives in very many
ways, and in some of these ways a place or two look the same by chance. Closures (matches of local
maps) connect some drives to groups. A map pays the price each time that common places connect two
groups. So drives share places only if they have more in common than chance explains.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Collection, Hashable, Iterable, Sequence

from ssh_abduction.data.drives import starts_of
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.theory.theory import Theory

# Two places are at one position if they are nearer than this share of the shortest travel. A move
# is a travel if it is longer than TRAVEL of the longest one.
NEAR, TRAVEL = 0.4, 0.1


class Overlap:
    """Computes the price of laying the drives of one trace on each other.

    Attributes:
        price: The price of joining two groups of drives.
    """

    def __init__(self, trace: Trace, theory: Theory) -> None:
        """Find the drives that closures connect.

        Args:
            theory: The theory, which sets the price.
        """
        starts = starts_of(trace)
        self.price = theory.price_of_laying
        self._drive = [bisect_right(starts, t) for t in range(len(trace))]
        closures = ((self._drive[c.first], self._drive[c.last]) for c in trace.closures)
        self._tied = _joined(range(len(starts) + 1), closures)  # a group for each drive
        ways = [math.hypot(*step.displacement[:2]) for step in trace.steps if step.displacement]
        longest = max(ways, default=0.0)
        # Places of two drives that are nearer than this, in metres, are at one position.
        self.near = NEAR * min((way for way in ways if way > TRAVEL * longest), default=0.0)

    @property
    def unit_of_step(self) -> list[int]:
        """A number of the drive of each step. Drives connected by closures have the same number."""
        return [self._tied[drive] for drive in self._drive]

    def is_tied(self, drive: int) -> bool:
        """Whether closures connect a drive, given by its number, to others."""
        return self._tied.count(self._tied[drive]) > 1

    def nats(self, at: Sequence[Hashable]) -> float:
        """Return the price of the claim that drives have these places in common.

        Args:
            at: The place of each step, or of each of the first steps; without places, its dstate.
        """
        if len(self._tied) == 1:
            return 0.0
        return self.price * (len({*self._tied}) - groups_of(at, self._drive, self._tied))

    def of_steps(self, labels: Sequence[int], places: Sequence[Hashable]) -> float:
        """Return the price for the dstates of the first steps and the places of dstates."""
        return self.nats([places[s] for s in labels]) if len(self._tied) > 1 else 0.0

    def of_map(self, ssh_map: SSHMap) -> float:
        """Return the price for a map of the whole trace."""
        places = [s.id if s.place is None else s.place for s in ssh_map.dstates]
        return self.of_steps(ssh_map.dstate_at, places)

    def between(self, some: Collection[int], others: Collection[int]) -> float:
        """Return the price of a common place of two pieces of a map, given by their steps."""
        groups = [{self._tied[self._drive[t]] for t in steps} for steps in (some, others)]
        return 0.0 if groups[0] & groups[1] else self.price


def groups_of(at: Iterable[Hashable], drive: Iterable[int], tied: Sequence[int]) -> int:
    """Count the groups of drives that share no place with each other.

    Args:
        at: The place of each step.
        drive: The drive of each step, as a number.
        tied: For each drive, a number. Drives with equal numbers are in one group.
    """
    first: dict[Hashable, int] = {}
    pairs = {*zip(at, drive, strict=False)}
    shared = ((first.setdefault(place, number), number) for place, number in pairs)
    return len({*_joined(tied, shared)})


def _joined(groups: Sequence[int], pairs: Iterable[tuple[int, int]]) -> list[int]:
    """Merge the groups of the members of each pair. Return the group of each member."""
    found = [*groups]
    for one, other in pairs:
        kept, gone = found[one], found[other]
        if kept != gone:
            found = [kept if group == gone else group for group in found]
    return found
