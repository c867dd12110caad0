"""Derive the topological level of a building from the finished map of a robot's log.

The map is not changed. Paths, sides, corridors, doors and rooms follow from its places, its poses
and its trace, after the search for maps.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

from ssh_abduction.building.edges import FloorPlan
from ssh_abduction.building.rooms import (
    corridors_of,
    outlines_of,
    room_of_places,
    rooms_of,
    spaces_of,
    straightened,
    widened,
    with_doors,
)
from ssh_abduction.building.straight_paths import paths_of, ways_of
from ssh_abduction.data.building import Indoors
from ssh_abduction.data.groups import gathered
from ssh_abduction.data.map_parts import MapPath, right_of
from ssh_abduction.data.maps import SSHMap, check_of_trace, checked_map
from ssh_abduction.data.trace import Trace, checked_trace

NO_POSES = (
    "paths: the map has no poses, so it has neither paths nor corridors, doors and rooms; solve a "
    "trace with displacements, and without a short time limit"
)
ONLY_THEORY = (
    "corridors, doors, rooms: the map has no poses, so it has only the order of the places of its "
    "paths; solve a trace with displacements"
)
NO_PLACES = "paths: the map has no places, so it has no paths; solve with --theory topological"
NO_WIDTHS = (
    "corridors, doors, rooms: the trace has no widths, so the map has only paths; import the log "
    "again"
)
NO_SCANS = (
    "corridors, doors, rooms: the trace has no scans, so the map has only paths; map a robot's log"
)
NO_TRAVEL = "paths: the map has one place, so it has no path; take a longer drive"


def with_building(ssh_map: SSHMap, trace: Trace) -> SSHMap:
    """Return the same map with its paths, corridors, doors and rooms.

    A map that has paths of its theory keeps them, with their courses and sides.

    Args:
        ssh_map: A map of the trace.
        trace: The trace. The travels of a log have a course, widths and doors.

    Returns:
        The map with its field `building`, whose notes say what the map cannot have. The paths of a
        map without paths are derived.

    Raises:
        MapError: The map is not of the trace.

    Reference:
        Kuipers 2000, "The Spatial Semantic Hierarchy": places, paths and regions.
    """
    return next(buildings_of(ssh_map, trace))


def buildings_of(ssh_map: SSHMap, trace: Trace, most: int = 0) -> Iterator[SSHMap]:
    """Yield the map with each of its buildings of least cost: `with_building` returns the first.

    They differ where ends of edges can be paired into paths in several equally good ways.

    Args:
        ssh_map: A map of the trace.
        trace: The trace.
        most: How many buildings to list at most; 0 for all.

    Raises:
        MapError: The map is not of the trace.
    """
    checked_map(ssh_map)
    check_of_trace([ssh_map], checked_trace(trace), "map", views=False)
    if not ssh_map.places or not ssh_map.fit or not ssh_map.fit.poses:
        note = NO_TRAVEL if len(ssh_map.places) == 1 else NO_POSES if ssh_map.places else NO_PLACES
        note = ONLY_THEORY if ssh_map.paths else note
        yield replace(ssh_map, building=Indoors(notes=(note,)), paths=_theory_paths(ssh_map))
        return
    plan = FloorPlan.of(ssh_map, trace)
    junctions = gathered((name, p) for p, name in plan.name.items()).values()
    listed = tuple(tuple(sorted(some)) for some in junctions if len(some) > 1)
    if not plan.edges:
        empty = Indoors(junctions=listed, notes=(NO_TRAVEL,))
        yield replace(ssh_map, building=empty, paths=_theory_paths(ssh_map))
        return
    room = room_of_places(plan)
    doors = with_doors(plan, room, ssh_map) if plan.measured else ()
    scanned = any("course" in step.extra for step in trace.steps)
    notes = () if plan.measured else (NO_WIDTHS if scanned else NO_SCANS,)
    spaces = spaces_of(plan, room) if plan.measured else {}
    outlines = outlines_of(spaces)
    plan = straightened(plan, room, spaces)
    for ways in ways_of(plan, most):
        paths = paths_of(plan, ways)
        corridors = corridors_of(plan, widened(ways, room, spaces), paths, room, doors)
        rooms = rooms_of(plan, room, doors, corridors, outlines) if plan.measured else ()
        building = Indoors(corridors, rooms, doors, listed, notes)
        yield replace(ssh_map, building=building, paths=_theory_paths(ssh_map) or paths)


def _theory_paths(ssh_map: SSHMap) -> tuple[MapPath, ...]:
    """Add the course and the sides to the paths of the theory, as far as they are known."""
    poses = ssh_map.fit.poses if ssh_map.fit else ()
    at = {s.place: (p.x, p.y) for s, p in zip(ssh_map.dstates, poses, strict=False)}
    regions, found = ssh_map.regions or (), []
    for path in ssh_map.theory_paths:
        line = tuple(at[p] for p in path.order if p in at)
        length = round(sum(map(math.dist, line, line[1:])), 2) if len(line) > 1 else None
        left, right = (right_of(regions, path.id, way) for way in (-1, 1))
        found.append(replace(path, line=line, length=length, left=left, right=right))
    return tuple(found)
