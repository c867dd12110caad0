"""Write the rooms and doors of a map as an area graph in OpenStreetMap XML (osmAG).

An area graph has areas, which are closed ways, and passages, which are ways of two nodes that both
areas share. Areas are the rooms, and passages are the doors, or lifts and stairs.

References:
    Hou et al. 2019, "Area Graph: Generation of Topological Maps using the Voronoi Diagram".
    Feng et al. 2023, "osmAG: Hierarchical Semantic Topometric Area Graph Maps in the OSM Format for
    Mobile Robotics". Passages name their areas by the ids of the ways ("fix_id").
"""

from __future__ import annotations

import cmath
import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from ssh_abduction.data.building import MapDoor, MapRoom
from ssh_abduction.data.errors import MapError
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.schema import only_known
from ssh_abduction.output.layout import drawable_poses

DEGREE = math.radians(6378137.0)  # metres of a degree at the equator, where the map is put
RADIUS = 0.5  # in metres: half the side of the square at a place of a room without an outline
CORNERS = [RADIUS * complex(x, y) for x in (-1, 1) for y in (-1, 1)]


def osm_areas(ssh_map: SSHMap) -> str:
    """Write the rooms, doors, lifts and stairs of a map as OpenStreetMap XML in the osmAG form.

    Positions are metres, as in the other formats, on a plane that touches the earth at latitude and
    longitude 0. There is the node with the name "root".

    Raises:
        MapError: The map has no rooms, or no poses.
    """
    poses = drawable_poses(ssh_map)
    if not ssh_map.rooms or poses is None or ssh_map.fit is None:
        notes = (ssh_map.building and ssh_map.building.notes) or ("map a robot's log",)
        raise MapError(f"osm: expected a map with rooms, got one without; {notes[0]}")
    old = ssh_map.fit.poses
    turns = [cmath.exp(1j * (new.heading - p.heading)) for new, p in zip(poses, old, strict=True)]
    at = [complex(pose.x, pose.y) for pose in poses]
    shifts = [z - turn * complex(p.x, p.y) for z, turn, p in zip(at, turns, old, strict=True)]
    first = {s.place: s.id for s in reversed(ssh_map.dstates)}
    room_of = {p: room.id for room in ssh_map.rooms for p in room.places}
    graph, doors = _AreaGraph(), ssh_map.doors

    def moved(points: Iterable[tuple[float, float]], frame: int) -> list[complex]:
        return [turns[frame] * complex(*point) + shifts[frame] for point in points]

    def jambs(door: MapDoor) -> list[complex]:
        """The two ends of a door, across the way through it."""
        (middle,) = moved([door.at], door.dstates[0])
        way = [at[first[p]] for p in door.places[:2]] or [at[door.dstates[0]]]
        ahead = [*way, middle][1] - way[0]
        across = 1j * ahead / abs(ahead) if ahead else 1j
        return [middle + sign * door.width / 2 * across for sign in (1, -1)]

    gaps = {door.id: [graph.node(z) for z in jambs(door)] for door in doors if len(door.rooms) == 2}
    for room in ssh_map.rooms:
        frame = first[room.places[0]] if room.places else doors[room.doors[0]].dstates[0]
        middles = [at[first[p]] for p in room.places] or moved([doors[room.doors[0]].at], frame)
        walls = moved(room.outline, frame) or [z + corner for z in middles for corner in CORNERS]
        ring = graph.ring(walls, [gaps[door] for door in room.doors if door in gaps])
        graph.areas[room.id] = graph.way([*ring, ring[0]], **_room_tags(ssh_map, room, frame))
    for door in doors:
        if door.id in gaps:
            name = ssh_map.name_of("door", door.id) or f"door {door.id}"
            said = {"name": name, "door": "yes", "width": f"{door.width:.2f}"}
            graph.passage(gaps[door.id], door.rooms, level=_level(ssh_map, door.dstates[0]), **said)
    lifts = set()
    for s, action, x in ssh_map.links:
        one, other = ssh_map.dstates[s], ssh_map.dstates[x]
        if one.floor != other.floor and one.place in room_of and other.place in room_of:
            lifts.add((min(s, x), max(s, x), action))
    for s, x, action in sorted(lifts):
        ends = [room_of[place] for k in (s, x) if (place := ssh_map.dstates[k].place) is not None]
        nodes = [graph.nearest(room, at[k]) for room, k in zip(ends, (s, x), strict=True)]
        graph.passage(nodes, ends, level=_level(ssh_map, s), name=action)
    return graph.text()


def _level(ssh_map: SSHMap, dstate: int) -> str:
    return str(ssh_map.dstates[dstate].floor or 0)


def _room_tags(ssh_map: SSHMap, room: MapRoom, frame: int) -> dict[str, str]:
    """The tags of a room. It is a corridor if most of its places are on corridors."""
    on = {p for c in room.corridors for p in ssh_map.corridors[c].order}
    kind = "corridor" if 2 * len(on.intersection(room.places)) > len(room.places) else "room"
    names = ", ".join(ssh_map.name_of("corridor", c) or f"corridor {c}" for c in room.corridors)
    return {
        "name": ssh_map.name_of("room", room.id) or f"room {room.id}",
        "indoor": kind,
        "level": _level(ssh_map, frame),
        "osmAG:type": "area",
        "osmAG:areaType": kind,
        **only_known(corridors=names or None),
    }


@dataclass
class _AreaGraph:
    """An area graph while it is written. New things in OpenStreetMap have negative ids."""

    nodes: dict[int, complex] = field(default_factory=lambda: {-1: 0j})
    ways: list[tuple[Sequence[int], dict[str, str]]] = field(default_factory=list)
    areas: dict[int, int] = field(default_factory=dict)  # the id of the way of each room

    def node(self, at: complex) -> int:
        """Add a node, and return its id."""
        self.nodes[-len(self.nodes) - 1] = at
        return -len(self.nodes)

    def way(self, nodes: Sequence[int], **tags: str) -> int:
        """Add a way, and return its id."""
        self.ways.append((nodes, tags))
        return -len(self.ways)

    def passage(self, nodes: Sequence[int], rooms: Sequence[int], **tags: str) -> None:
        """Add a passage between two rooms."""
        ends = {
            f"osmAG:{k}": str(self.areas[r]) for k, r in zip(("from", "to"), rooms, strict=True)
        }
        self.way(nodes, **tags, **ends, **{"osmAG:type": "passage"})

    def nearest(self, room: int, at: complex) -> int:
        """The node of a room that is nearest to a point."""
        return min(self.ways[-self.areas[room] - 1][0], key=lambda n: abs(self.nodes[n] - at))

    def ring(self, walls: Sequence[complex], gaps: Sequence[Sequence[int]]) -> list[int]:
        """Order walls and the ends of doors around their middle, without walls within a door."""
        ends = {n: self.nodes[n] for pair in gaps for n in pair}
        middle = sum([*walls, *ends.values()]) / (len(walls) + len(ends))
        sides = [[self.nodes[n] - middle for n in pair] for pair in gaps]

        def within(z: complex) -> bool:
            """Whether a wall is seen from the middle through a door."""
            return any(
                (a.conjugate() * z).imag * (z.conjugate() * b).imag > 0
                and (z.conjugate() * (a + b)).real > 0
                for a, b in sides
            )

        kept = [z for z in walls if not within(z - middle)]
        enough = len(kept) + len(ends) > 2
        around = ends | {self.node(z): z for z in (kept if enough else walls)}
        return sorted(around, key=lambda n: cmath.phase(around[n] - middle))

    def text(self) -> str:
        """The text of the file."""
        root = ET.Element("osm", version="0.6", generator="ssh-abduction")
        for n, z in self.nodes.items():
            lat, lon = (f"{metres / DEGREE:.9f}" for metres in (z.imag, z.real))
            given = {"id": str(n), "action": "modify", "visible": "true", "lat": lat, "lon": lon}
            ET.SubElement(root, "node", given)
        ET.SubElement(root[0], "tag", k="name", v="root")
        for k, (nodes, tags) in enumerate(self.ways, 1):
            way = ET.SubElement(root, "way", id=str(-k), action="modify", visible="true")
            for n in nodes:
                ET.SubElement(way, "nd", ref=str(n))
            for key, value in tags.items():
                ET.SubElement(way, "tag", k=key, v=value)
        ET.indent(root)
        return ET.tostring(root, encoding="unicode", xml_declaration=True)
