"""Rooms and doors in files for planners, loaded by the rules of these planners."""

from __future__ import annotations

import itertools
import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass, replace
from pathlib import Path

import networkx as nx
import numpy as np
import pytest
from skimage.measure import points_in_poly
from test_derived_paths import CROSS, LINE, TOUR, drive, in_frames
from test_export import nav2_graph

from ssh_abduction import SSHMap, export_map
from ssh_abduction.building.derive import with_building
from ssh_abduction.cli import main
from ssh_abduction.data.errors import MapError
from ssh_abduction.data.maps import Name

DOORS = [(1, 4), (2, 5), (1, 2)]
RADIUS_OF_EARTH = 6378137.0


@dataclass
class AreaGraph:
    """An osmAG file as a planner reads it."""

    graph: nx.MultiGraph[int]  # of areas by the ids of their ways, with doors as edges
    rings: dict[int, list[complex]]  # the corners of each area, in metres
    tags: dict[int, dict[str, str]]


def loaded(text: str) -> AreaGraph:
    """Load an area graph by the rules of osmAG's parser. Fails where the parser would."""
    root = ET.fromstring(text)
    assert (root.tag, root.attrib["version"]) == ("osm", "0.6")
    nodes: dict[int, complex] = {}
    for node in root.iter("node"):
        assert int(node.attrib["id"]) not in nodes
        lat, lon = (math.radians(float(node.attrib[name])) for name in ("lat", "lon"))
        nodes[int(node.attrib["id"])] = RADIUS_OF_EARTH * complex(lon, lat)
    (origin,) = root.findall("node/tag[@k='name'][@v='root']/..")
    assert nodes[int(origin.attrib["id"])] == 0
    refs, tags = {}, {}
    for way in root.iter("way"):
        number = int(way.attrib["id"])
        assert number not in refs
        refs[number] = [int(nd.attrib["ref"]) for nd in way.iter("nd")]
        assert set(refs[number]) <= set(nodes)
        tags[number] = {tag.attrib["k"]: tag.attrib["v"] for tag in way.iter("tag")}
        assert abs(int(tags[number]["level"])) < 50
    graph: nx.MultiGraph[int] = nx.MultiGraph()
    rings = {}
    for number, ring in refs.items():
        if tags[number]["osmAG:type"] == "area":
            assert ring[0] == ring[-1], "an area is closed"
            assert len(set(ring)) == len(ring) - 1 >= 3
            rings[number] = [nodes[n] for n in ring]
            assert_simple(rings[number])
            if tags[number]["osmAG:areaType"] != "structure":
                assert tags[number]["osmAG:areaType"] in ("room", "corridor")
                graph.add_node(number)
            if parent := tags[number].get("osmAG:parent"):
                assert tags[int(parent)]["osmAG:areaType"] == "structure"
                assert tags[int(parent)]["level"] == tags[number]["level"]
    for number, ends in refs.items():
        if tags[number]["osmAG:type"] == "passage":
            one, other = (int(tags[number][f"osmAG:{end}"]) for end in ("from", "to"))
            assert one != other
            assert {one, other} <= set(graph)
            assert len(set(ends)) == 2
            shared = set(refs[one]) & set(refs[other])
            if tags[number].get("door"):
                assert set(ends) <= shared, "a door is on both areas"
            else:
                assert ends[0] in refs[one]
                assert ends[1] in refs[other]
            graph.add_edge(one, other, key=number)
        else:
            assert number in rings
    return AreaGraph(graph, rings, tags)


def assert_simple(ring: list[complex]) -> None:
    """No two sides of a ring cross."""

    def turns(a: complex, b: complex, c: complex) -> float:
        return ((b - a).conjugate() * (c - a)).imag

    sides = [*itertools.pairwise(ring)]
    for (a, b), (c, d) in itertools.combinations(sides, 2):
        assert not (
            turns(a, b, c) * turns(a, b, d) < -1e-9 and turns(c, d, a) * turns(c, d, b) < -1e-9
        )


@pytest.fixture
def house() -> SSHMap:
    found = with_building(*drive(CROSS, TOUR, doors=DOORS))
    return replace(found, names=(Name("room", 2, "kitchen"), Name("corridor", 0, "street")))


def test_a_planner_finds_routes_through_the_areas(house: SSHMap) -> None:
    found = loaded(export_map(house, "osm"))
    number = {found.tags[n]["name"]: n for n in found.graph}
    assert set(number) == {"room 0", "room 1", "kitchen", "room 3"}
    assert nx.is_connected(found.graph)
    way = nx.shortest_path(found.graph, number["kitchen"], number["room 3"])
    assert [found.tags[n]["name"] for n in way] == ["kitchen", "room 0", "room 1", "room 3"]
    assert {name: found.tags[n]["indoor"] for name, n in number.items()} == {
        "room 0": "corridor",
        "room 1": "corridor",
        "kitchen": "room",
        "room 3": "room",
    }
    assert found.tags[number["room 0"]]["corridors"] == "street"


def test_rooms_are_in_wings_and_wings_in_the_building(house: SSHMap) -> None:
    found = loaded(export_map(house, "osm"))
    names = {number: tags.get("name") for number, tags in found.tags.items()}
    parents = {
        names[n]: names[int(tags["osmAG:parent"])]
        for n, tags in found.tags.items()
        if "osmAG:parent" in tags
    }
    sides = {"left of street", "right of street"}
    assert {parents["kitchen"], parents["room 3"]} == sides
    whole = "building, level 0"
    assert parents["room 0"] == parents["room 1"] == whole
    assert all(parents[side] == whole for side in sides)


def test_the_area_of_a_room_leaves_out_the_walls_that_it_leads_around() -> None:
    """Corridors of 2 m lead around two blocks, as the strokes of an 8."""
    points = [(10.0 * x, 8.0 * y) for y in range(2) for x in range(3)]
    found = with_building(*drive(points, [0, 1, 2, 5, 4, 3, 0, 1, 4]))
    loaded_areas = loaded(export_map(found, "osm"))
    (ring,) = (loaded_areas.rings[n] for n in loaded_areas.graph)
    corners = np.array([[z.real, z.imag] for z in ring])
    inside = points_in_poly([(0, 4), (5, 8), (10, 4), (15, 8), (20, 4), (5, 4), (15, 4)], corners)
    assert inside.tolist() == [True] * 5 + [False] * 2
    area = abs(sum((a.conjugate() * b).imag for a, b in itertools.pairwise(ring))) / 2
    assert area == pytest.approx(2 * 22 * 2 + 3 * 6 * 2, abs=4)


def test_areas_contain_their_places_and_doors_their_middle(house: SSHMap) -> None:
    text = export_map(house, "osm")
    found = loaded(text)
    number = {found.tags[n]["name"]: n for n in found.graph}
    for room in house.rooms:
        ring = found.rings[number[house.name_of("room", room.id) or f"room {room.id}"]]
        corners = np.array([[z.real, z.imag] for z in ring])
        # The place at the end of a corridor is on the ring.
        inward = 0.97 * np.array([CROSS[p] for p in room.places]) + 0.03 * corners.mean(axis=0)
        assert points_in_poly(inward, corners).all()
    root = ET.fromstring(text)
    at = {n.attrib["id"]: n.attrib for n in root.iter("node")}
    ways = [w for w in root.iter("way") if w.find("tag[@v='passage']") is not None]
    for way, door in zip(ways, house.doors, strict=True):
        ends = [
            RADIUS_OF_EARTH * math.radians(float(at[nd.attrib["ref"]][name]))
            for nd in way.iter("nd")
            for name in ("lon", "lat")
        ]
        assert math.dist(ends[:2], ends[2:]) == pytest.approx(door.width, abs=1e-3)
        middle = [(ends[0] + ends[2]) / 2, (ends[1] + ends[3]) / 2]
        assert middle == pytest.approx(door.at, abs=1e-3)


@pytest.mark.parametrize("floors", [False, True])
def test_lifts_join_floors_and_pieces_lie_apart(floors: bool) -> None:
    parts = [drive(CROSS, TOUR, doors=DOORS), drive(LINE, [0, 1, 2, 3], doors=[(1, 2)])]
    found = loaded(export_map(with_building(*in_frames(parts, floors)), "osm"))
    levels = [found.tags[n]["level"] for n in found.graph]
    assert levels == (["0"] * 4 + ["1"] * 2 if floors else ["0"] * 6)
    assert nx.number_connected_components(found.graph) == (1 if floors else 2)
    heights = [[z.imag for z in found.rings[n]] for n in found.graph]
    assert max(max(h) for h in heights[4:]) < min(min(h) for h in heights[:4])


def test_nav2_finds_routes_between_rooms_and_knows_doors(house: SSHMap) -> None:
    nodes, edges = nav2_graph(export_map(house, "nav2"))
    graph: nx.DiGraph[int] = nx.DiGraph()
    for start, end, cost in edges.values():
        graph.add_edge(start, end, weight=cost)
    assert [nodes[p] for p in sorted(nodes)] == CROSS
    assert nx.shortest_path(graph, 4, 5, weight="weight") == [4, 1, 2, 5]


def test_maps_without_rooms_say_why() -> None:
    ssh_map, trace = drive(LINE, [0, 1, 2, 3])
    with pytest.raises(MapError, match="a map with rooms, got one without; map a robot's log"):
        export_map(ssh_map, "osm")
    bare = replace(trace, steps=tuple(replace(step, extra={}) for step in trace.steps))
    with pytest.raises(MapError, match="no scans"):
        export_map(with_building(ssh_map, bare), "osm")
    with pytest.raises(MapError, match="expected none for osm, which shows rooms"):
        export_map(with_building(ssh_map, trace), "osm", level="places")


def test_export_writes_an_area_graph(house: SSHMap, tmp_path: Path) -> None:
    house.save(tmp_path / "map.json")
    file = tmp_path / "house.osm"
    assert main(["export", str(tmp_path / "map.json"), "--to", "osm", "-o", str(file)]) == 0
    assert len(loaded(file.read_text()).graph) == 4
