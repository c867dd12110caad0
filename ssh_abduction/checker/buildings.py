"""Check the paths, corridors, doors and rooms that were derived from a map, in plain Python.

>>> from ssh_abduction.data.maps import DState, MapPath, SSHMap
>>> twice = MapPath(0, (0, 1, 0), sure=0.9)
>>> ssh_map = SSHMap((0, 1), (DState(0, "a", 0), DState(1, "b", 1)), (), (0, 1), (twice,))
>>> [*faults_of_paths(ssh_map)]
['Path 0 lists a place twice.']
"""

from __future__ import annotations

from collections.abc import Iterator

from ssh_abduction.checker.reading import Found, Reading
from ssh_abduction.data.maps import SSHMap


def building_follows_from_map(m: Reading) -> Found:
    """Check the derived paths, and that rooms are what doors cut off."""
    for message in (*faults_of_paths(m.map), *faults_of_corridors(m.map)):
        yield [], message
    yield from rooms_are_cut_off_by_doors(m)


def faults_of_paths(ssh_map: SSHMap) -> Iterator[str]:
    """Yield what is wrong with the orders and sides of derived paths."""
    places = set(ssh_map.places)
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


def faults_of_corridors(ssh_map: SSHMap) -> Iterator[str]:
    """Yield what is wrong with corridors: each is a part of its path, in its order."""
    orders = {path.id: list(path.order) for path in ssh_map.paths}
    for c in ssh_map.corridors:
        order = orders.get(c.path, [])
        begin = order.index(c.order[0]) if c.order and c.order[0] in order else 0
        if list(c.order) != order[begin : begin + len(c.order)]:
            yield f"Corridor {c.id} is no part of path {c.path}."
        if unknown := {*c.doors} - {door.id for door in ssh_map.doors}:
            yield f"Corridor {c.id} has doors {sorted(unknown)}, which the map does not have."


def rooms_are_cut_off_by_doors(m: Reading) -> Found:
    """Check that each travel from one room to another passes a door of the room that it leaves."""
    room_of: dict[int, int] = {}
    for room in m.map.rooms:
        for p in room.places:
            if p in room_of:
                yield [], f"Place {p} is in rooms {room_of[p]} and {room.id}."
            room_of[p] = room.id
    for t, action in enumerate(m.trace.actions if m.map.rooms else ()):
        if action.kind != "travel":
            continue
        here, there = (m.states[m.map.dstate_at[k]] for k in (t, t + 1))
        rooms = {room_of.get(s.place) for s in (here, there) if s.place is not None}
        passed = [door for door in m.map.doors if here.id in door.dstates]
        if len(rooms) == 2 and not any(rooms & {*door.rooms} for door in passed):
            why = f"Places {here.place} and {there.place} are in two rooms, with no door between."
            yield [t, t + 1], why
