"""Maps as values, as graphs, as files and as pictures."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import networkx as nx
import pytest
from worlds import SQUARE, TEE, TOURS, Streets, drive, rectangle, streets, written

from ssh_abduction import SSHMap, Theory, solve
from ssh_abduction.data import MapError
from ssh_abduction.output import to_dot, to_graphml, to_networkx, to_svg

SVG = "{http://www.w3.org/2000/svg}"


def the_map(tour: str, theory: Theory) -> SSHMap:
    (ssh_map,) = solve(drive(*TOURS[tour], stars=theory.star != "none"), theory).maps
    return ssh_map


def test_map_of_a_tee_equals_the_world() -> None:
    graph = to_networkx(the_map("tee", Theory.circumscriptive()), "topological")
    truth = nx.Graph([("W", "main"), ("J", "main"), ("E", "main"), ("J", "side"), ("S", "side")])
    assert nx.is_isomorphic(graph, truth)
    assert {data["bipartite"] for _, data in graph.nodes(data=True)} == {0, 1}


def test_the_comb_is_found_with_stars_and_paths_first() -> None:
    """The stand-in for Taylor Hall: 20 dstates, 7 places, 4 paths."""
    graph = to_networkx(the_map("comb", Theory.circumscriptive()), "topological")
    truth = nx.Graph([(p, "main") for p in ("P1", "P2", "P3", "P4")])
    truth.add_edges_from(
        [("P1", "s1"), ("D1", "s1"), ("P2", "s2"), ("D2", "s2"), ("P4", "s4"), ("D3", "s4")]
    )
    assert nx.is_isomorphic(graph, truth)


def test_causal_graph_has_one_edge_a_link() -> None:
    ssh_map = the_map("comb", Theory.circumscriptive())
    graph = to_networkx(ssh_map)
    assert {(s, data["action"], x) for s, x, data in graph.edges(data=True)} == set(ssh_map.links)
    assert graph.nodes[0]["view"] == ssh_map.dstates[0].view
    assert nx.parse_graphml(
        to_graphml(ssh_map), node_type=int, force_multigraph=True
    ).number_of_edges() == len(ssh_map.links)
    with pytest.raises(MapError, match="level: expected"):
        to_networkx(ssh_map, "metrical")  # type: ignore[arg-type]


def test_maps_survive_a_round_trip(tmp_path: Path) -> None:
    for ssh_map in solve(drive(*TOURS["comb"]), Theory.topological()).maps:
        ssh_map.save(tmp_path / "map.json")
        loaded = SSHMap.load(tmp_path / "map.json")
        assert loaded == ssh_map
        assert loaded.to_dict() == ssh_map.to_dict()
    with pytest.raises(MapError, match="cannot write the map"):
        ssh_map.save(tmp_path / "no" / "map.json")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"labels": [9]}, "labels[0]: expected the id of one of "),
        ({"labels": "no"}, "labels: expected a list"),
        ({"links": [[1.0, "travel", 0]]}, "links[0]: expected [dstate, action name, dstate]"),
        ({"links": [[[1], "travel", 0]]}, "links[0]: expected [dstate, action name, dstate]"),
        ({"paths": [{"id": 0, "order": [0, 1, 0]}]}, "paths[0].order: expected each place once"),
        ({"links": [[0, "travel", 77]]}, "links[0]: expected [dstate, action name, dstate]"),
        ({"places": []}, "places: expected every id that is used, also 0, got []"),
        (
            {"paths": [{"id": 3, "order": []}]},
            "paths: expected every id that is used, also 0, got [3]",
        ),
        ({"dstates": [{"id": 1, "view": "a"}]}, "dstates: expected the ids 0, 1, 2"),
        ({"dstates": [{"id": 0}]}, "dstates[0].view: expected a text or an integer"),
        (
            {"dstates": [{"id": 0, "view": "a", "path": 0}]},
            "dstates[0].direction: expected 1 or -1 where there is a path",
        ),
    ],
)
def test_malformed_maps_are_refused(change: dict[str, object], message: str) -> None:
    (ssh_map,) = solve(written("a T b")).maps
    with pytest.raises(MapError) as error:
        SSHMap.from_dict({**ssh_map.to_dict(), **change}, "file")
    assert str(error.value).startswith(f"file: {message}")


def positions(picture: str) -> dict[str, tuple[float, float]]:
    """Where the places are drawn, by the number in the title."""
    found = {}
    for group in ET.fromstring(picture).iter(f"{SVG}g"):
        circle, title = group.find(f"{SVG}circle"), str(group.findtext(f"{SVG}title"))
        if circle is not None and title.startswith("place "):
            place = title.removeprefix("place ").partition(",")[0]
            found[place] = (float(circle.attrib["cx"]), float(circle.attrib["cy"]))
    return found


@pytest.mark.parametrize("tour", ["comb", "tee"])
def test_right_angled_worlds_are_drawn_at_right_angles(tour: str) -> None:
    ssh_map = the_map(tour, Theory.circumscriptive().replace(star="frame"))
    at = positions(to_svg(ssh_map))
    assert len(set(at.values())) == len(ssh_map.places)
    for path in ssh_map.paths:
        xs, ys = zip(*(at[str(p)] for p in path.order), strict=True)
        assert len(set(xs)) == 1 or len(set(ys)) == 1
        assert list(xs) in (sorted(xs), sorted(xs, reverse=True))
        assert list(ys) in (sorted(ys), sorted(ys, reverse=True))


def test_drawing_shows_right_turns_clockwise() -> None:
    (ssh_map,) = solve(rectangle(16)).maps
    at = positions(to_svg(ssh_map))
    corners = [at[str(p)] for p in range(4)]
    area = sum(
        ax * by - bx * ay
        for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True)
    )
    assert area > 0  # y grows downwards


@pytest.mark.parametrize("world", [SQUARE, TEE, streets(("a", "E", "b"))])
def test_every_map_can_be_drawn(world: Streets) -> None:
    for theory in (
        Theory.causal(),
        Theory.topological(),
        Theory.topological().replace(boundary="none"),
    ):
        for ssh_map in solve(drive(world, min(world), min(world[min(world)]), "TATA"), theory).maps:
            ET.fromstring(to_svg(ssh_map))


def test_strange_names_are_drawn_and_written_safely() -> None:
    (ssh_map,) = solve(written('<a>&"\\ T <b>'), Theory.topological()).maps
    ET.fromstring(to_svg(ssh_map))
    assert '\\"' in to_dot(ssh_map)
    (causal,) = solve(written("<a> T <b>"), Theory.causal()).maps
    ET.fromstring(to_svg(causal))
