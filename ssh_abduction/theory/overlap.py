"""Compute the prices that are part of the cost of a joint map: of laying drives on each other,
and of different places at one position.

Nothing is known of where a drive starts. So it can be laid on a map of other drives in very many
ways, and in some of these ways a place or two look the same by chance. Closures (matches of local
maps) connect some drives to groups. A map pays the price each time that common places connect two
groups. So drives share places only if they have more in common than chance explains. The price is
higher if no stars are compared, and most steps of two drives look alike.

Two places cannot be at one position. If drives are laid on each other by chance, many of their
places are. So each two places that no drive (or group) saw both pay a price if they are at one
position, and less of it the farther they are apart.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import Counter
from collections.abc import Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from itertools import combinations, pairwise

from ssh_abduction.data.drives import drives_of, starts_of
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.theory.fields import TOLD, UNLIKE
from ssh_abduction.theory.theory import Theory

# The views of drives tell nothing if laying these costs more than AMBIGUOUS times the usual price.
AMBIGUOUS = 2.0
# Two places are not at one position if they are farther apart than this share of the shortest
# travel. A move is a travel if it is longer than TRAVEL of the longest one.
NEAR, TRAVEL = 0.4, 0.1


class Overlap:
    """Computes the price of laying the drives of one trace on each other.

    Attributes:
        price: The price of joining two groups of drives.
        crowded_price: The price of two places at one position.
        near: Places that are nearer than this, in metres, are at one position. 0 if positions are
            not known well enough.
    """

    def __init__(self, trace: Trace, theory: Theory) -> None:
        """Find the drives that closures connect.

        Args:
            trace: The trace of all drives.
            theory: The theory, which sets the price.
        """
        starts = starts_of(trace)
        self.crowded_price = theory.price_of_laying
        drives = (trace.views[drive.first : drive.stop] for drive in drives_of(trace))
        self.price = price_of_laying(theory, drives)
        self._drive = [bisect_right(starts, t) for t in range(len(trace))]
        closures = ((self._drive[c.first], self._drive[c.last]) for c in trace.closures)
        self._tied = _joined(range(len(starts) + 1), closures)  # a group for each drive
        ways = [math.hypot(*step.displacement[:2]) for step in trace.steps if step.displacement]
        longest = max(ways, default=0.0)
        moved = (step.displacement for t, step in enumerate(trace.steps) if t and t not in starts)
        has_frames = theory.level == "topological" and not (theory.lifts or theory.jumped)
        self.near = 0.0
        if has_frames and len({*self._tied}) > 1 and None not in moved:
            self.near = NEAR * min((way for way in ways if way > TRAVEL * longest), default=0.0)

    @property
    def is_ambiguous(self) -> bool:
        """Whether views tell so little that drives may share places without a sign of it."""
        return self.price > AMBIGUOUS * self.crowded_price

    def keeps_apart(self, ssh_map: SSHMap) -> bool:
        """Whether some drives share no place with others in a map of the whole trace."""
        return self.of_map(ssh_map) < self.price * (len({*self._tied}) - 1)

    @property
    def unit_of_step(self) -> list[int]:
        """A number of the drive of each step. Drives connected by closures have the same number."""
        return [self._tied[drive] for drive in self._drive]

    def is_tied(self, drive: int) -> bool:
        """Whether closures connect a drive, given by its number, to others."""
        return self._tied.count(self._tied[drive]) > 1

    def crowding(
        self, labels: Mapping[int, int], places: Sequence[Hashable], at: Sequence[Sequence[float]]
    ) -> float:
        """Return the price of places at one position.

        Args:
            labels: The dstate of each step, or of each step of some drives.
            places: The place of each dstate.
            at: The position of each dstate, in metres.
        """
        return self.crowded_price * sum(share for *_, share in self.crowded(labels, places, at))

    def share(self, here: Sequence[float], there: Sequence[float]) -> float:
        """Return the share of the price that two places at these positions, in metres, cost."""
        return max(0.0, 1 - math.dist(here, there) / self.near) if self.near else 0.0

    def crowded_in(self, ssh_map: SSHMap) -> Iterator[tuple[int, int, float]]:
        """Yield the same as `crowded` for a map of the whole trace that has a fit."""
        poses = ssh_map.fit.poses if ssh_map.fit else ()
        places, at = [s.place for s in ssh_map.dstates], [(pose.x, pose.y) for pose in poses]
        yield from self.crowded(dict(enumerate(ssh_map.dstate_at)), places, at)

    def crowded(
        self, labels: Mapping[int, int], places: Sequence[Hashable], at: Sequence[Sequence[float]]
    ) -> Iterator[tuple[int, int, float]]:
        """Yield the first steps at two places at one position, and the share of the price to pay.

        The arguments are those of `crowding`.
        """
        if not self.near:
            return
        first: dict[Hashable, int] = {}
        seen: dict[Hashable, set[int]] = {}  # the groups of drives that saw each place
        facing: dict[int, set[int]] = {}  # the groups of drives that saw each dstate
        for t, s in sorted(labels.items()):
            first.setdefault(places[s], t)
            for groups in (seen.setdefault(places[s], set()), facing.setdefault(s, set())):
                groups.add(self._tied[self._drive[t]])
        frame = self._frames(seen.values(), facing.values())
        in_order = sorted(first.values(), key=lambda t: at[labels[t]][0])
        for i, t in enumerate(in_order):
            for u in in_order[i + 1 :]:
                here, there = at[labels[t]], at[labels[u]]
                if there[0] - here[0] >= self.near:
                    break
                one, two = (seen[places[labels[step]]] for step in (t, u))
                is_known = {frame[group] for group in one} & {frame[group] for group in two}
                share = self.share(here, there)
                if share and is_known and not one & two:
                    yield min(t, u), max(t, u), share

    def _frames(self, seen: Iterable[set[int]], facing: Iterable[set[int]]) -> list[int]:
        """Merge groups of drives with a dstate or two places in common, which fix how they lie."""
        ties = [pair for groups in facing for pair in pairwise(groups)]
        shared = Counter(pair for groups in seen for pair in combinations(sorted(groups), 2))
        return _joined(self._tied, [*ties, *(pair for pair, count in shared.items() if count > 1)])

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


def price_of_laying(theory: Theory, parts: Iterable[Iterable[Hashable]]) -> float:
    """Return the price of the claim that parts of a trace share places.

    Each part is given by the views of its steps. Without stars, the price is higher if they look
    alike.
    """
    if theory.star != "none":
        return theory.price_of_laying
    pairs, alike = pairs_of_parts(parts)
    return theory.price_of_laying * max(TOLD / math.log((pairs + UNLIKE) / max(alike, 1)), 1.0)


def pairs_of_parts(parts: Iterable[Iterable[Hashable]]) -> tuple[int, int]:
    """Count the pairs of steps of different parts of a trace, and those that look alike.

    Each part is given by the views of its steps.

    >>> pairs_of_parts(["aab", "ac"])
    (6, 2)
    """
    counts = [Counter(views) for views in parts]
    every = sum(counts, Counter[Hashable]())
    pairs = every.total() ** 2 - sum(part.total() ** 2 for part in counts)
    alike = sum(n * n - sum(part[view] ** 2 for part in counts) for view, n in every.items())
    return pairs // 2, alike // 2


def groups_of(at: Iterable[Hashable], drive: Iterable[int], tied: Sequence[int]) -> int:
    """Count the groups of drives that share no place with each other.

    The arguments are those of `groups_of_each`.
    """
    return len({*groups_of_each(at, drive, tied)})


def groups_of_each(
    at: Iterable[Hashable], drive: Iterable[int], tied: Sequence[int]
) -> Sequence[int]:
    """Return the group of each drive, as a number. Drives of two groups share no place.

    Args:
        at: The place of each step.
        drive: The drive of each step, as a number.
        tied: For each drive, a number. Drives with equal numbers are in one group.
    """
    first: dict[Hashable, int] = {}
    pairs = {*zip(at, drive, strict=False)}
    return _joined(tied, ((first.setdefault(place, number), number) for place, number in pairs))


def _joined(groups: Sequence[int], pairs: Iterable[tuple[int, int]]) -> list[int]:
    """Merge the groups of the members of each pair. Return the group of each member."""
    found = [*groups]
    for one, other in pairs:
        kept, gone = found[one], found[other]
        if kept != gone:
            found = [kept if group == gone else group for group in found]
    return found
