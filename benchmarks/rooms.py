"""Whether a map tells the rooms and the doors of a building apart.

A robot drives through a floor plan. The simulator says in which room each scan was taken, and
which doors the robot drove through. Four questions judge a map:

* Is there a map?
* Are all joins right: are no two visits at one place that are more than 2 m apart?
* Has each room that the robot entered a place or an edge of its own? Most visits to its place are
  in the room. All travels on its edge pass the room between their ends.
* Are no two doors confused? Doors are on edges of the map. Two doors are confused if two travels
  are on one edge, and each passed a door that the other did not. The halves of a double door count
  as one door: two doors between the same rooms, less than HALF metres apart.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Hashable, Mapping, Sequence
from itertools import combinations, pairwise
from typing import Any

from courses import edges_of

from ssh_abduction import SSHMap, Trace

# The middles of the halves of a double door are less than this many metres apart.
HALF = 1.5


def untold(
    trace: Trace, ssh_map: SSHMap, rooms: Sequence[str | None], doors: Mapping[int, str]
) -> dict[str, list[str]]:
    """Find the rooms and the doors that a map does not tell apart.

    Args:
        trace: The trace of a log.
        ssh_map: Its map.
        rooms: The room in which each scan was taken; None for a scan outside of all rooms.
        doors: The door that the robot drove through just before a scan, by the index of the scan.

    Returns:
        The rooms without a place or an edge of their own, and the pairs of confused doors.
    """
    starts = [t for t in range(len(trace)) if t == 0 or trace.actions[t - 1].kind != "turn"]
    scans = [int(trace.steps[t].extra["scan"]) for t in starts]
    places = [ssh_map.dstates[ssh_map.dstate_at[t]].place for t in starts]
    travels = edges_of(trace, ssh_map)
    edges = [travels.get(after - 1) for after in starts[1:]]
    passed = [
        frozenset(rooms[begin : end + 1]) - {rooms[begin], rooms[end]}
        for begin, end in pairwise(scans)
    ]
    crossed = [
        frozenset(door for scan, door in doors.items() if begin < scan <= end)
        for begin, end in pairwise(scans)
    ]
    told = _with_places(places, [rooms[scan] for scan in scans]) | _with_edges(edges, passed)
    return {"rooms": sorted({*rooms} - told - {None}), "doors": _confused(edges, crossed)}


def rooms_and_doors(told: Mapping[str, Any]) -> tuple[list[str | None], dict[int, str]]:
    """Read the room of each scan, and the doors, from the truth that the simulator wrote."""
    doors = told["doors"]
    half_of = {
        name: next(
            other
            for other, half in doors.items()
            if {*half["rooms"]} == {*door["rooms"]} and math.dist(half["at"], door["at"]) < HALF
        )
        for name, door in doors.items()
    }
    passed = {crossing["scan"]: half_of[crossing["door"]] for crossing in told["crossings"]}
    return list(told["scans"]), passed


def told_line(rows: Sequence[dict[str, Any]]) -> str:
    """Say how many simulated drives have a map, and how many maps tell all rooms and doors apart.

    Args:
        rows: A row for each log, as `logs.py` makes them.
    """
    drives = [row for row in rows if row["simulated"]]
    maps = [row for row in drives if "untold" in row]  # of drives through floor plans
    right = [row for row in maps if row["visit_pairs"]["joined"] == row["visit_pairs"]["right"]]
    rooms, doors = ([row for row in maps if not row["untold"][kind]] for kind in ("rooms", "doors"))
    whole = [row for row in right if row in rooms and row in doors]
    return (
        f"{len(drives)} simulated drives: {sum(row.get('places') is not None for row in drives)} "
        f"have a map. Floor plans: {len(right)} of {len(maps)} maps have only right joins, "
        f"{len(rooms)} tell all rooms apart, {len(doors)} tell all doors apart, "
        f"{len(whole)} all of this"
    )


def _with_places(places: Sequence[Hashable], rooms: Sequence[str | None]) -> set[str | None]:
    """The rooms that most visits to some place are in."""
    seen: dict[Hashable, Counter[str | None]] = defaultdict(Counter)
    for place, room in zip(places, rooms, strict=True):
        seen[place][room] += 1
    return {counts.most_common(1)[0][0] for counts in seen.values()}


def _with_edges(
    edges: Sequence[Hashable], passed: Sequence[frozenset[str | None]]
) -> set[str | None]:
    """The rooms that all travels on some edge pass."""
    common: dict[Hashable, frozenset[str | None]] = {}
    for edge, rooms in zip(edges, passed, strict=True):
        common[edge] = common.get(edge, rooms) & rooms
    return {room for rooms in common.values() for room in rooms}


def _confused(edges: Sequence[Hashable], crossed: Sequence[frozenset[str]]) -> list[str]:
    """Pairs of doors on one edge, if one travel passed only one, and another only the other."""
    on: dict[Hashable, set[frozenset[str]]] = defaultdict(set)
    for edge, doors in zip(edges, crossed, strict=True):
        on[edge].add(doors)
    return sorted(
        {
            " and ".join(sorted([min(one - other), min(other - one)]))
            for sets in on.values()
            for one, other in combinations(sets, 2)
            if one - other and other - one
        }
    )
