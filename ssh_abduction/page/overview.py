"""Make the overview of the page: everything that any map has, and in how many maps it occurs.

A dstate (distinctive state) is a place and a heading. A street is a line between two neighbours.
Dstates, places and streets of two maps count as the same if they have the same steps.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from statistics import fmean
from typing import Any, TypeAlias

from ssh_abduction.data.groups import gathered
from ssh_abduction.data.maps import SSHMap

Steps: TypeAlias = tuple[int, ...]
Spot: TypeAlias = tuple[float, float, float | None]
Pair: TypeAlias = frozenset[Steps]


class _Counts:
    """Counts the maps that have each dstate, place and street, given by its steps.

    `along` counts the maps in which a dstate or street is on a path with certain steps. Its keys
    are pairs: the dstate or street, and a number that stands for the steps of the path.
    """

    def __init__(self) -> None:
        self.dstates: Counter[Steps] = Counter()
        self.places: Counter[Steps] = Counter()
        self.streets: Counter[Pair] = Counter()
        self.along: Counter[tuple[Steps | Pair, int]] = Counter()
        self._numbers: dict[Steps, int] = {}  # of the steps along a path, as numbers hash faster

    def add(self, ssh_map: SSHMap, count: int) -> None:
        """Add `count` maps that are the same as this one."""
        at = [ssh_map.dstates[label] for label in ssh_map.dstate_at]
        of_dstate = _members(ssh_map.dstate_at)
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
        # Only streets that the robot travelled count: it went between two places along one path, or
        # in a map without paths. The order of other places on a path is one of many possible ones.
        streets: dict[Pair, int | None] = {}
        for s, _, x in ssh_map.links:
            a, b = ssh_map.dstates[s], ssh_map.dstates[x]
            if None in (a.place, b.place) or a.place == b.place or a.path != b.path:
                continue
            if a.floor == b.floor and a.place in of_place and b.place in of_place:
                pair = frozenset((of_place[a.place], of_place[b.place]))
                streets[pair] = None if a.path is None else of_path[a.path]
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
    """Collect all dstates, places and travelled streets that any map has, for JSON.

    `spots` has the position and heading of each step. In the result, `nodes` are places, or dstates
    if there are no places. `dstates` is empty if there are no places. Each node and dstate has its
    `steps`, position and heading, and `maps`, the number of maps with it. `path` of a dstate is the
    largest number of maps that agree on all steps along its path. `streets` are lists [node, node,
    maps, path].
    """
    # Count maps together if they are the same in everything that is counted here.
    alike: dict[Any, list[SSHMap]] = {}
    for ssh_map in maps:
        key = (ssh_map.dstate_at, tuple((s.place, s.path) for s in ssh_map.dstates))
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
    """For each number, list the steps that have it. Steps with None are left out."""
    found = gathered((name, t) for t, name in enumerate(names) if name is not None)
    return {name: tuple(steps) for name, steps in found.items()}


def _middle(steps: Steps, spots: Sequence[Spot]) -> dict[str, Any]:
    """Compute the mean position of steps as `x` and `y`, with the `heading` of the first step."""
    at = list(dict.fromkeys(spots[t][:2] for t in steps))
    return {
        "x": round(fmean(x for x, _ in at), 3),
        "y": round(fmean(y for _, y in at), 3),
        "heading": spots[steps[0]][2],
    }
