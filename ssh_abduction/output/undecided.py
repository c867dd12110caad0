"""Find the places of a map that the robot only passed, such as corners of a corridor."""

from __future__ import annotations

from collections import defaultdict
from itertools import groupby, pairwise

from ssh_abduction.data.maps import SSHMap


def place_of_steps(ssh_map: SSHMap) -> list[int | None]:
    """Return the place of each step of a map."""
    return [ssh_map.dstates[label].place for label in ssh_map.dstate_at]


def undecided_places(ssh_map: SSHMap) -> frozenset[int]:
    """Find the places that the robot only passed.

    At every visit, the robot came from one of two neighbours and went on to the other. It never
    turned around at such a place, and never began or ended a drive there.
    """
    places, labels = place_of_steps(ssh_map), ssh_map.dstate_at
    # A drive starts where no action leads from the step before.
    linked = {(s, x) for s, _, x in ssh_map.links}
    starts = [t for t, pair in enumerate(pairwise(labels), 1) if pair not in linked]
    through = defaultdict[int, set[frozenset[int]]](set)
    ends: set[int] = set()
    for first, stop in pairwise([0, *starts, len(places)]):
        drive = [place for place in places[first:stop] if place is not None]
        stays = [place for place, _ in groupby(drive)]
        for before, place, after in zip(stays, stays[1:], stays[2:], strict=False):
            through[place].add(frozenset((before, after)))
        ends.update(stays[:1], stays[-1:])
    return frozenset(
        place
        for place, pairs in through.items()
        if place not in ends and len(pairs) == 1 and len(next(iter(pairs))) == 2
    )
