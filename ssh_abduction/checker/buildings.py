"""Check the paths, corridors, doors and rooms that were derived from a map, in plain Python.

>>> from ssh_abduction.data.maps import DState, MapPath, SSHMap
>>> twice = MapPath(0, (0, 1, 0), sure=0.9)
>>> ssh_map = SSHMap((0, 1), (DState(0, "a", 0), DState(1, "b", 1)), (), (0, 1), (twice,))
>>> [*faults_of_paths(ssh_map)]
['Path 0 lists a place twice.']
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import combinations, pairwise, product
from typing import Any

from ssh_abduction.checker.reading import Found, Reading
from ssh_abduction.data.building import Point
from ssh_abduction.data.maps import MapPath, SSHMap

NEAR = 1.0  # metres between two places of a junction, at most; courses are known as well


def building_follows_from_map(m: Reading) -> Found:
    """Check the derived paths, and that rooms are what doors cut off."""
    for faults in (faults_of_paths, faults_of_corridors, faults_of_numbers):
        for message in faults(m.map):
            yield [], message
    yield from rooms_are_cut_off_by_doors(m)


def faults_of_paths(ssh_map: SSHMap) -> Iterator[str]:
    """Yield what is wrong with the orders and sides of derived paths."""
    places, at = set(ssh_map.places), _positions(ssh_map)
    for path in ssh_map.paths:
        if path.sure is None:
            continue
        sides = [set(path.order), set(path.left), set(path.right), set(path.around)]
        if len(sides[0]) < len(path.order):
            yield f"Path {path.id} lists a place twice."
        if unknown := set().union(*sides) - places:
            yield f"Path {path.id} has places {sorted(unknown)}, which the map does not have."
        if sum(map(len, sides)) > len(set().union(*sides)):
            yield f"Path {path.id} has a place twice: on it, left, right or around."
        if not 0 <= path.sure <= 1:
            yield f"Path {path.id} has probability {path.sure}."
        far = [(_along(path.line, at[p]), p) for p in path.order if p in at]
        for ((before, spare), p), ((after, more), q) in pairwise(far):
            if after + more < before - spare:
                yield f"Path {path.id} comes to place {q} before place {p}."


def faults_of_corridors(ssh_map: SSHMap) -> Iterator[str]:
    """Yield what is wrong with corridors: each is a part of its path, and has its sides."""
    paths = {path.id: path for path in ssh_map.paths}
    for c in ssh_map.corridors:
        path = paths.get(c.path, MapPath(c.path, ()))
        begin = path.order.index(c.order[0]) if c.order and c.order[0] in path.order else 0
        if c.order != path.order[begin : begin + len(c.order)]:
            yield f"Corridor {c.id} is no part of path {c.path}."
        if (c.left, c.right, c.around) != (path.left, path.right, path.around):
            yield f"Corridor {c.id} has other sides than path {c.path}."
        for o in c.openings:
            beside = path.left if o.side == "left" else path.right
            if o.to not in {None, *path.order, *path.around, *beside}:
                yield f"Corridor {c.id} has a way to place {o.to}, which is not on its {o.side}."


def faults_of_numbers(ssh_map: SSHMap) -> Iterator[str]:
    """Yield numbers of corridors, rooms and doors that the map lacks, and too wide junctions."""
    kinds = ("corridors", "rooms", "doors")
    things: dict[str, Sequence[Any]] = {kind: getattr(ssh_map, kind) for kind in kinds}
    known = {kind: {thing.id for thing in some} for kind, some in things.items()}
    for what, kind in product(things, things):
        for thing in things[what]:
            if unknown := {*getattr(thing, kind, ())} - known[kind]:
                said = f"{what[:-1].capitalize()} {thing.id} has {kind} {sorted(unknown)}"
                yield f"{said}, which the map does not have."
    at = _positions(ssh_map)
    for places in ssh_map.building.junctions if ssh_map.building else ():
        for p, q in combinations(places, 2):
            if not abs(at.get(p, -9e9) - at.get(q, 9e9)) <= NEAR + 1e-6:
                yield f"Places {p} and {q} are one junction, but more than {NEAR:g} m apart."


def rooms_are_cut_off_by_doors(m: Reading) -> Found:
    """Check that each travel from one room to another passes a door of the room that it leaves."""
    room_of: dict[int, int] = {}
    for room in m.map.rooms:
        for p in room.places:
            if p in room_of:
                yield [], f"Place {p} is in rooms {room_of[p]} and {room.id}."
            room_of[p] = room.id
    for door in m.map.doors:
        own = {room_of[p] for p in door.places if p in room_of}
        if not own <= {*door.rooms} or (len(door.places) > 1 and own != {*door.rooms}):
            yield [], f"Door {door.id} is in rooms {door.rooms}, but its places in {sorted(own)}."
    for t, action in enumerate(m.trace.actions if m.map.rooms else ()):
        if action.kind != "travel":
            continue
        here, there = (m.states[m.map.dstate_at[k]] for k in (t, t + 1))
        rooms = {room_of.get(s.place) for s in (here, there) if s.place is not None}
        passed = [door for door in m.map.doors if here.id in door.dstates]
        if len(rooms) == 2 and not any(rooms & {*door.rooms} for door in passed):
            why = f"Places {here.place} and {there.place} are in two rooms, with no door between."
            yield [t, t + 1], why


def _positions(ssh_map: SSHMap) -> dict[int | None, complex]:
    """The position of the first dstate of each place, in metres."""
    poses = ssh_map.fit.poses if ssh_map.fit else ()
    every = [*zip(ssh_map.dstates, poses, strict=False)]
    return {state.place: complex(pose.x, pose.y) for state, pose in reversed(every)}


def _along(line: Sequence[Point], z: complex) -> tuple[float, float]:
    """How far the nearest point of a line to a point is along it, and how far others may be.

    These are at most NEAR metres farther from the point than the nearest one.
    """
    found, length = [(0.0, 0.0)], 0.0
    for a, b in pairwise(complex(*point) for point in line):
        side = abs(b - a)
        share = min(max(((z - a) * (b - a).conjugate()).real / max(side, 1e-9) ** 2, 0.0), 1.0)
        found.append((abs(z - a - share * (b - a)), length + share * side))
        length += side
    off, metres = min(found[1:] or found)
    return metres, math.sqrt((off + NEAR) ** 2 - off**2)
