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
    are pairs: the dstate or street, and the steps of the path.
    """

    def __init__(self) -> None:
        self.dstates: Counter[Steps] = Counter()
        self.places: Counter[Steps] = Counter()
        self.streets: Counter[Pair] = Counter()
        self.along: Counter[tuple[Steps | Pair, Steps]] = Counter()

    def add(self, ssh_map: SSHMap) -> None:
        """Count what a map has."""
        at = [ssh_map.dstates[label] for label in ssh_map.dstate_at]
        of_dstate = _members(ssh_map.dstate_at)
        of_place = _members([s.place for s in at])
        of_path = _members([s.path for s in at])
        self.dstates.update(of_dstate.values())
        self.places.update(of_place.values())
        paths = ((steps, at[steps[0]].path) for steps in of_dstate.values())
        self.along.update((steps, of_path[h]) for steps, h in paths if h is not None)
        # Only streets that the robot travelled count: it went between two places along one path, or
        # in a map without paths. The order of other places on a path is one of many possible ones.
        streets: dict[Pair, Steps | None] = {}
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
        self.streets.update(streets.keys())
        self.along.update((pair, path) for pair, path in streets.items() if path is not None)


def overview(maps: Sequence[SSHMap], spots: Sequence[Spot]) -> dict[str, Any]:
    """Collect all dstates, places and travelled streets that any map has, for JSON.

    `spots` has the position and heading of each step. In the result, `nodes` are places, or dstates
    if there are no places. `dstates` is empty if there are no places. Each node and dstate has its
    `steps`, position and heading, and `maps`, the number of maps with it. `path` of a dstate is the
    largest number of maps that agree on all steps along its path. `streets` are lists [node, node,
    maps, path].
    """
    counts = _Counts()
    for ssh_map in maps:
        counts.add(ssh_map)
    agreed: dict[Any, int] = {}
    for (thing, _), count in counts.along.items():
        agreed[thing] = max(count, agreed.get(thing, 0))
    nodes = counts.places or counts.dstates
    number = {steps: i for i, steps in enumerate(nodes)}
    return {
        "nodes": [{"steps": s, "maps": n, **_middle(s, spots)} for s, n in nodes.items()],
        "dstates": [
            {"steps": s, "maps": count, "path": agreed.get(s, count), **_middle(s, spots)}
            for s, count in counts.dstates.items()
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
