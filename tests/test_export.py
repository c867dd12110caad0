"""Exported maps are what other programs load: held against their rules as their documentation states them, and read back."""

from __future__ import annotations

import io
import json
import math
import re
from typing import Any

import networkx as nx
import pytest
import yaml
from worlds import rectangle

from ssh_abduction import MapError, SSHMap, Theory, Trace, export_map, solve
from ssh_abduction.cli import export as verb
from ssh_abduction.cli import main
from ssh_abduction.export import formats
from ssh_abduction.maps import DState


@pytest.fixture(scope="module")
def square() -> SSHMap:
    moves = [(10, 0, 0), (0, 0, 1.5708)] * 4
    return solve(Trace.from_steps("abababab" + "a", ["travel", "left"] * 4, displacements=moves)).maps[0]


def nav2_graph(text: str) -> tuple[dict[int, tuple[float, float]], dict[int, tuple[int, int, float]]]:
    """Nodes and edges by the rules of Nav2's loader. Fails where the loader would."""
    data = json.loads(text)
    assert data["type"] == "FeatureCollection"
    nodes: dict[int, tuple[float, float]] = {}
    edges: dict[int, tuple[int, int, float]] = {}
    for feature in data["features"]:
        assert feature["type"] == "Feature"
        properties, geometry = feature["properties"], feature["geometry"]
        assert type(properties["id"]) is int
        assert 0 <= properties["id"] < 2**32
        assert properties["id"] not in nodes
        assert properties["id"] not in edges
        plain_metadata(properties["metadata"])
        if geometry["type"] == "Point":
            x, y = (float(number) for number in geometry["coordinates"])
            assert isinstance(properties["frame"], str)
            nodes[properties["id"]] = (x, y)
        else:
            assert geometry["type"] in ("LineString", "MultiLineString")
            assert type(properties["cost"]) in (int, float)
            assert properties["cost"] >= 0
            edges[properties["id"]] = (properties["startid"], properties["endid"], properties["cost"])
    assert nodes
    assert edges
    assert {end for start, end, _ in edges.values()} | {start for start, _, _ in edges.values()} <= set(nodes)
    return nodes, edges


def plain_metadata(value: dict[str, Any]) -> None:
    for item in value.values():
        assert isinstance(item, str | int | float | bool)


def checked_tmap2(text: str) -> dict[str, Any]:
    """A tmap2 by the rules of its schema. Fails where the schema does."""
    data = yaml.safe_load(text)
    assert re.fullmatch(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d", data["meta"]["last_updated"])
    assert all(isinstance(data[field], str) for field in ("metric_map", "name", "pointset"))
    names = [entry["node"]["name"] for entry in data["nodes"]]
    assert len(set(names)) == len(names)
    edges = []
    for entry in data["nodes"]:
        assert all(isinstance(entry["meta"][field], str) for field in ("map", "node", "pointset"))
        node = entry["node"]
        assert entry["meta"]["node"] == node["name"]
        assert isinstance(node["parent_frame"], str)
        assert math.hypot(*node["pose"]["orientation"].values()) == pytest.approx(1, abs=1e-4)
        assert all(isinstance(node["pose"]["position"][axis], float) for axis in "xyz")
        for edge in node["edges"]:
            assert edge["node"] in names
            assert isinstance(edge["action"], str)
            edges.append(edge["edge_id"])
    assert len(set(edges)) == len(edges)
    return data


def test_nav2_gets_metres_from_poses(square: SSHMap) -> None:
    nodes, edges = nav2_graph(export_map(square, "nav2"))
    assert len(nodes) == 4
    assert {(a, b) for a, b, _ in edges.values()} == {(a, b) for i in range(4) for a, b in ((i, (i + 1) % 4), ((i + 1) % 4, i))}
    for start, end, cost in edges.values():
        assert cost == pytest.approx(math.dist(nodes[start], nodes[end]), abs=1e-3)
        assert cost == pytest.approx(10, abs=0.2)


def test_dstates_have_an_edge_a_link(square: SSHMap) -> None:
    nodes, edges = nav2_graph(export_map(square, "nav2", level="dstates"))
    assert len(nodes) == 8
    assert {(a, b) for a, b, _ in edges.values()} == {(s, x) for s, _, x in square.links}


@pytest.mark.parametrize("level", ["places", "dstates"])
@pytest.mark.parametrize("to", formats.FORMATS)
def test_maps_without_poses_have_a_layout(to: str, level: str) -> None:
    ssh_map = solve(rectangle(8)).maps[0]
    if (to, level) == ("dot", "places"):
        with pytest.raises(MapError, match="DOT has a node a dstate"):
            export_map(ssh_map, to, level=level)
        return
    text = export_map(ssh_map, to, level=level)
    count = 4 if level == "places" else len(ssh_map.dstates)
    if to == "nav2":
        nodes, _ = nav2_graph(text)
        assert len(nodes) == count
        assert len(set(nodes.values())) == 4
        assert '"metric": false' in text
    elif to == "tmap2":
        data = checked_tmap2(text)
        assert len(data["nodes"]) == count
        assert data["meta"]["positions"] == "layout"
    elif to == "graphml":
        assert len(nx.read_graphml(io.BytesIO(text.encode()), force_multigraph=True)) == count
    elif to == "networkx-json":
        graph = nx.node_link_graph(json.loads(text), edges="edges")
        assert len(graph) == count
        assert level == "places" or set(graph.edges(data="action")) == {(s, x, action) for s, action, x in ssh_map.links}


def test_maps_of_dstates_alone_are_exported(square: SSHMap) -> None:
    ssh_map = solve(rectangle(8), Theory.causal()).maps[0]
    assert len(nav2_graph(export_map(ssh_map, "nav2"))[0]) == len(ssh_map.dstates)
    assert len(checked_tmap2(export_map(ssh_map, "tmap2"))["nodes"]) == len(ssh_map.dstates)
    with pytest.raises(MapError, match="level: expected dstates, got places: the map has no places"):
        export_map(ssh_map, "nav2", level="places")


@pytest.mark.parametrize("text", ["a: b", "- x", '"', "\\", "\x07\x1b[31m", "\u0085\u2028\ufeff", "null", "#", "é😀", "{}", "\n\t", "yes"])
def test_any_text_comes_back_from_yaml(text: str) -> None:
    ssh_map = SSHMap((0, 1), (DState(0, text), DState(1, "b")), ((0, text, 1),))
    data = checked_tmap2(export_map(ssh_map, "tmap2", name=text))
    assert data["name"] == text
    assert data["nodes"][0]["node"]["properties"]["views"] == text
    assert data["nodes"][0]["node"]["edges"][0]["properties"]["robot_action"] == text
    assert data["nodes"][1]["node"]["edges"] == []


def test_what_no_file_can_hold_is_refused(square: SSHMap) -> None:
    for arguments, message in [
        ({"to": "kml"}, "to: expected nav2, tmap2"),
        ({"to": "nav2", "level": "rooms"}, "level: expected places or dstates"),
        ({"to": "nav2", "frame": ""}, "frame: expected a text"),
        ({"to": "tmap2", "name": "\ud800"}, "name: expected a text"),
    ]:
        with pytest.raises(MapError, match=message):
            export_map(square, **arguments)
    with pytest.raises(MapError, match="expected roads between its dstates, got none"):
        export_map(SSHMap((0,), (DState(0, "a"),), ()), "nav2")


def test_the_command_writes_what_python_makes(square: SSHMap, tmp_path: object, capsys: pytest.CaptureFixture[str]) -> None:
    assert verb.FORMATS == formats.FORMATS
    assert verb.FOR_NAVIGATION == formats.FOR_NAVIGATION
    file = f"{tmp_path}/map.json"
    square.save(file)
    assert main(["export", file, "--to", "nav2", "-o", f"{tmp_path}/graph.geojson"]) == 0
    with open(f"{tmp_path}/graph.geojson", encoding="utf-8") as written:
        nodes, _ = nav2_graph(written.read())
    assert len(nodes) == 4
    assert capsys.readouterr().err == ""
    solve(rectangle(8)).maps[0].save(file)
    assert main(["export", file, "--to", "tmap2", "--name", "hall"]) == 0
    printed = capsys.readouterr()
    assert checked_tmap2(printed.out)["pointset"] == "hall"
    assert "positions are of a layout" in printed.err
    assert main(["export", file, "--to", "nav2", "--map", "3"]) == 1
    assert "1 to 1" in capsys.readouterr().err
