"""Write the rooms and doors of a map as an area graph in OpenStreetMap XML (osmAG).

An area graph has areas, which are closed ways, and passages, which are ways of two nodes that both
areas share. Areas are the rooms, and passages are the doors, or lifts and stairs. Areas around
others, called structures, are the wings and the building on each level. Each area names its parent.

References:
    Hou et al. 2019, "Area Graph: Generation of Topological Maps using the Voronoi Diagram".
    Feng et al. 2023, "osmAG: Hierarchical Semantic Topometric Area Graph Maps in the OSM Format for
    Mobile Robotics". Passages name their areas, and areas their parents, by the ids of the ways
    ("fix_id").
"""

from __future__ import annotations

import cmath
import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import combinations, pairwise

from scipy.spatial import ConvexHull

from ssh_abduction.data.building import MapDoor, MapRoom
from ssh_abduction.data.errors import MapError
from ssh_abduction.data.groups import gathered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.schema import only_known
from ssh_abduction.output.layout import drawable_poses
from ssh_abduction.output.roads import wing_name

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
    top = dict.fromkeys(graph.areas.values())
    for wing in ssh_map.building.wings if ssh_map.building else ():
        areas = [graph.areas[room] for room in wing.rooms]
        said = {"name": wing_name(ssh_map, wing) or "", "level": graph.level(areas[0])}
        top = dict.fromkeys([*(a for a in top if a not in areas), graph.around(areas, **said)])
    for level, areas in gathered((graph.level(area), area) for area in top).items():
        graph.around(areas, name=f"building, level {level}", level=level)
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


def _distance(z: complex, a: complex, b: complex) -> float:
    """The distance of a point from the side between two corners."""
    off = abs(b - a) ** 2
    share = ((z - a) * (b - a).conjugate()).real / off if off else 0.0
    return abs(z - a - min(max(share, 0.0), 1.0) * (b - a))


def _cross(a: complex, b: complex, c: complex, d: complex) -> bool:
    """Whether the lines from a to b and from c to d cross, within both."""

    def turn(p: complex, q: complex, z: complex) -> float:
        return ((q - p).conjugate() * (z - p)).imag

    return turn(a, b, c) * turn(a, b, d) < 0 and turn(c, d, a) * turn(c, d, b) < 0


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

    def level(self, area: int) -> str:
        """The level of an area."""
        return self.ways[-area - 1][1]["level"]

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
        """Make the ring of a room from its walls, with the ends of each door in the nearest wall.

        Corners of walls within a door are left out, unless too few would be left. A ring that
        crosses itself is sorted around its middle.
        """
        ring, doors = [self.node(z) for z in walls], {n for gap in gaps for n in gap}
        for gap in gaps:
            one, other = (self.nodes[n] for n in gap)
            reach = abs(one - other) / 2
            near = {n for n in ring if abs(self.nodes[n] - (one + other) / 2) <= reach} - doors
            if len(ring) - len(near) > 1:
                ring = [n for n in ring if n not in near]
            ring = self._with_door(ring, gap)
        at = [self.nodes[n] for n in ring]
        if any(_cross(*s, *t) for s, t in combinations(pairwise([*at, at[0]]), 2)):
            middle = sum(at) / len(at)
            ring.sort(key=lambda n: cmath.phase(self.nodes[n] - middle))
        return ring

    def _with_door(self, ring: list[int], gap: Sequence[int]) -> list[int]:
        """Put the ends of a door into the nearest side of a ring where it then crosses no side."""
        corners, ends = [self.nodes[n] for n in [*ring, ring[0]]], [self.nodes[n] for n in gap]
        sides, middle = [*pairwise(corners)], sum(ends) / 2

        def crosses(k: int, way: int) -> bool:
            chain = [*pairwise([corners[k], *ends[::way], corners[k + 1]])]
            return any(_cross(*one, *other) for one in chain for other in [*sides, *chain])

        order = sorted(range(len(ring)), key=lambda k: _distance(middle, *sides[k]))
        ways = [(k, way) for k in order for way in (1, -1)]
        k, way = next((w for w in ways if not crosses(*w)), ways[0])
        return [*ring[: k + 1], *gap[::way], *ring[k + 1 :]]

    def around(self, areas: Sequence[int], **tags: str) -> int:
        """Add a structure around areas, and make it their parent."""
        nodes = [n for area in areas for n in self.ways[-area - 1][0][:-1]]
        hull = ConvexHull([[self.nodes[n].real, self.nodes[n].imag] for n in nodes]).vertices
        ring = [nodes[k] for k in hull]
        said = {"osmAG:type": "area", "osmAG:areaType": "structure"}
        structure = self.way([*ring, ring[0]], **tags, **said)
        for area in areas:
            self.ways[-area - 1][1]["osmAG:parent"] = str(structure)
        return structure

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
