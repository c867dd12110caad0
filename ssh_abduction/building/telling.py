"""Tell the paths, corridors, doors and rooms of a map in words."""

from __future__ import annotations

from collections.abc import Iterator

from ssh_abduction.data.building import Corridor, MapRoom, WayOut
from ssh_abduction.data.map_parts import list_in_words
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.words import counted, noun_of


def told(ssh_map: SSHMap) -> Iterator[str]:
    """Yield lines about the building of a map: what it has, and what it cannot have."""
    building = ssh_map.building
    yield from (f"  {note}" for note in (building.notes if building else ()))
    for corridor in ssh_map.corridors:
        yield f"  {corridor_in_words(ssh_map, corridor)}"
    for path in ssh_map.paths:
        if all(path.id != c.path for c in ssh_map.corridors) and len(path.order) > 1:
            length = "" if path.length is None else f"{path.length:.0f} m, "
            width = "" if path.width is None else f"{path.width:.1f} m wide, "
            order = " – ".join(ssh_map.numbered("place", p) for p in path.order)
            yield f"  {ssh_map.called('path', path.id)}: {length}{width}places {order}"
    for room in ssh_map.rooms:
        if room.places:
            yield f"  {room_in_words(ssh_map, room)}"
    for door in ssh_map.doors:
        parts = list_in_words(ssh_map.called("room", r) for r in door.rooms)
        within = "between" if len(door.rooms) > 1 else "in"
        yield f"  {ssh_map.called('door', door.id)}: {door.width:.1f} m wide, {within} {parts}"
    for places in building.junctions if building else ():
        yield f"  places {list_in_words(places)} are one junction for paths and corridors"


def corridor_in_words(ssh_map: SSHMap, corridor: Corridor) -> str:
    """Describe a corridor: its size, its places, and the ways beside it."""
    order = " – ".join(ssh_map.numbered("place", p) for p in corridor.order)
    parts = [f"{corridor.length:.0f} m, {corridor.width:.1f} m wide, places {order}"]
    for side in ("left", "right"):
        ways = dict.fromkeys(_way(ssh_map, o) for o in corridor.openings if o.side == side)
        parts.append(f"{side}: {', '.join(ways) or 'nothing known'}")
    if corridor.doors:
        parts.append(f"{noun_of('door', corridor.doors)} {list_in_words(corridor.doors)} across it")
    sure = next((p.sure for p in ssh_map.paths if p.id == corridor.path), None)
    if sure is not None:
        parts.append(f"its path has probability {sure:.2f}")
    return f"{ssh_map.called('corridor', corridor.id)}: {'; '.join(parts)}"


def _way(ssh_map: SSHMap, opening: WayOut) -> str:
    where = f"after {opening.metres:.0f} m"
    if opening.place is None:
        return f"opening {where}, never driven through"
    where = f"at {ssh_map.numbered('place', opening.place)}"
    if opening.door is not None:
        room = ssh_map.building.room_of(opening.to) if ssh_map.building else None
        lead = "" if room is None else f" to {ssh_map.called('room', room)}"
        return f"{ssh_map.called('door', opening.door)}{lead} {where}"
    lead = "" if opening.to is None else f" to place {ssh_map.numbered('place', opening.to)}"
    return f"way{lead} {where}"


def room_in_words(ssh_map: SSHMap, room: MapRoom) -> str:
    """Describe a room: its places, doors and corridors."""
    places = list_in_words(ssh_map.numbered("place", p) for p in room.places)
    parts = [f"{noun_of('place', room.places)} {places}"]
    if room.doors:
        doors = list_in_words(ssh_map.numbered("door", d) for d in room.doors)
        parts.append(f"{noun_of('door', room.doors)} {doors}")
    if room.corridors:
        names = list_in_words(ssh_map.called("corridor", c) for c in room.corridors)
        parts.append(f"has {names}")
    return f"{ssh_map.called('room', room.id)}: {', '.join(parts)}"


def summary(ssh_map: SSHMap) -> str:
    """Count the corridors, rooms and doors of a map in words."""
    things = (ssh_map.corridors, "corridors"), (ssh_map.rooms, "rooms"), (ssh_map.doors, "doors")
    return ", ".join(counted(len(some), what) for some, what in things)
