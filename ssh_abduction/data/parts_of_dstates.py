"""Find the place, path, corridor, room or door of a map that a dstate belongs to."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ssh_abduction.data.map_parts import region_of
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.odometry import radians_between


def number_at(ssh_map: SSHMap, kind: str, label: int) -> int | None:
    """Return the number of the place, path, region and so on of a dstate; None if it has none.

    The door of a dstate is the first one through which a travel from there leads. The corridor of a
    dstate, and its path in a map without paths of its theory, is the one that it faces along.
    """
    dstate = ssh_map.dstates[label]
    if kind == "place":
        return dstate.place
    if kind == "region":
        return region_of(ssh_map.regions, dstate.place)
    if kind == "path" and ssh_map.theory_paths:
        return dstate.path
    things = ssh_map.things().get(kind, {})
    if kind == "door":
        here = ssh_map.fit.poses[label] if ssh_map.fit else None
        far = {
            door.id: math.dist(door.at, (here.x, here.y)) if here else 0.0
            for door in ssh_map.doors
            if label in door.dstates
        }
        return min(far, key=lambda door: far[door], default=None)
    own = [number for number, places in things.items() if dstate.place in places]
    if len(own) < 2:
        return next(iter(own), None)
    return min(own, key=lambda n: (_bend_to(ssh_map, label, things[n]), n))


def _bend_to(ssh_map: SSHMap, label: int, order: Sequence[int]) -> float:
    """The radians from the heading of a dstate to its next place in an order of places."""
    poses = ssh_map.fit.poses if ssh_map.fit else ()
    at = {s.place: pose for s, pose in zip(ssh_map.dstates, poses, strict=False)}
    k = order.index(ssh_map.dstates[label].place)
    return min(
        (
            radians_between(math.atan2(at[q].y - here.y, at[q].x - here.x), poses[label].heading)
            for q in (*order[max(k - 1, 0) : k], *order[k + 1 : k + 2])
            if q in at and (here := at[order[k]])
        ),
        default=math.inf,
    )
