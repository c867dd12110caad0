"""The overview of the page: everything that some map has, with the number of maps that have it.

Dstates, places and streets of two maps are the same if they have the same steps.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from statistics import fmean
from typing import Any, TypeAlias

from ssh_abduction.data.maps import SSHMap

Steps: TypeAlias = tuple[int, ...]
Spot: TypeAlias = tuple[float, float, float | None]
Pair: TypeAlias = frozenset[Steps]


class _Counts:
    """How many maps have each dstate, place and street, and what is along its path.

    Attributes:
        dstates: The number of maps with each dstate.
        places: The number of maps with each place.
        streets: The number of maps with each street.
        along: The number of maps with each dstate or street and what is along its path.
    """

    def __init__(self) -> None:
        self.dstates: Counter[Steps] = Counter()
        self.places: Counter[Steps] = Counter()
        self.streets: Counter[Pair] = Counter()
        self.along: Counter[tuple[Steps | Pair, int]] = Counter()
        self._numbers: dict[Steps, int] = {}  # of the steps along a path, as numbers hash faster

    def add(self, ssh_map: SSHMap, count: int) -> None:
        """Count a map this many times."""
        at = [ssh_map.dstates[label] for label in ssh_map.labels]
        of_dstate = _members(ssh_map.labels)
        of_place = _members([s.place for s in at])
        of_path = {
            h: self._numbers.setdefault(steps, len(self._numbers))
            for h, steps in _members([s.path for s in at]).items()
        }
        for steps in of_dstate.values():
            self.dstates[steps] += count
            if (h := at[steps[0]].path) is not None:
                self.along[steps, of_path[h]] += count
        for steps in of_place.values():
            self.places[steps] += count
        # The robot travelled along a street if it went between two places along one path. The order
        # of a path elsewhere shows only that the map is consistent, and there may be thousands.
        streets: dict[Pair, int | None] = {}
        for s, x in set(pairwise(ssh_map.labels)):
            a, b = ssh_map.dstates[s], ssh_map.dstates[x]
            if None in (a.place, b.place, a.path) or a.place == b.place or a.path != b.path:
                continue
            streets[frozenset((of_place[a.place], of_place[b.place]))] = of_path[a.path]
        if not ssh_map.places:
            streets = {
                frozenset((of_dstate[s], of_dstate[x])): None
                for s, _, x in ssh_map.links
                if s != x and s in of_dstate and x in of_dstate
            }
        for pair, path in streets.items():
            self.streets[pair] += count
            if path is not None:
                self.along[pair, path] += count


def overview(maps: Sequence[SSHMap], spots: Sequence[Spot]) -> dict[str, Any]:
    """All dstates, places and travelled streets that some map has.

    Args:
        maps: The maps.
        spots: Position of each step.

    Returns:
        `nodes` (places, or dstates if there are no places), `dstates` and `streets`, each with its
        number of maps. Its `path` is the largest number of maps that agree on what is along the
        path of a dstate or street.
    """
    # Maps that are the same in everything that is counted here are counted at once.
    alike: dict[Any, list[SSHMap]] = {}
    for ssh_map in maps:
        key = (ssh_map.labels, tuple((s.place, s.path) for s in ssh_map.dstates))
        alike.setdefault(key, []).append(ssh_map)
    counts = _Counts()
    for some in alike.values():
        counts.add(some[-1], len(some))
    agreed: dict[Any, int] = {}
    for (thing, _), count in counts.along.items():
        agreed[thing] = max(count, agreed.get(thing, 0))
    nodes = counts.places or counts.dstates
    number = {steps: i for i, steps in enumerate(nodes)}
    return {
        "nodes": [
            {"steps": steps, "maps": count, **_middle(steps, spots)}
            for steps, count in nodes.items()
        ],
        "dstates": [
            {
                "steps": steps,
                "maps": count,
                "path": agreed.get(steps, count),
                **_middle(steps, spots),
            }
            for steps, count in counts.dstates.items()
            if counts.places
        ],
        "streets": [
            [*sorted(number[steps] for steps in pair), count, agreed.get(pair, count)]
            for pair, count in counts.streets.items()
            if len(pair) == 2
        ],
    }


def _members(names: Sequence[int | None]) -> dict[int | None, Steps]:
    """The steps with each name."""
    found: dict[int | None, list[int]] = {}
    for t, name in enumerate(names):
        if name is not None:
            found.setdefault(name, []).append(t)
    return {name: tuple(steps) for name, steps in found.items()}


def _middle(steps: Steps, spots: Sequence[Spot]) -> dict[str, Any]:
    """The middle of the spots of steps, and the heading of the first step."""
    at = list(dict.fromkeys(spots[t][:2] for t in steps))
    return {
        "x": round(fmean(x for x, _ in at), 3),
        "y": round(fmean(y for _, y in at), 3),
        "heading": spots[steps[0]][2],
    }
