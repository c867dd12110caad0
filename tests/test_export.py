"""Exported maps: checked against the documented rules of the programs that load them."""

from __future__ import annotations

import io
import json
import math
import re
from dataclasses import replace
from typing import Any

import networkx as nx
import pytest
import yaml
from test_regions import LOG, TOUR, trace_of
from worlds import rectangle

from ssh_abduction import SSHMap, Theory, Trace, export_map, solve
from ssh_abduction.cli import main
from ssh_abduction.cli import use as verb
from ssh_abduction.data import MapError
from ssh_abduction.data.map_parts import Name
from ssh_abduction.data.maps import DState
from ssh_abduction.output import export as formats
from ssh_abduction.output import to_networkx, to_svg
from ssh_abduction.output.export import tmap2
from ssh_abduction.output.roads import TURN, Road, Roads, Stop


def nav2_graph(
    text: str,
) -> tuple[dict[int, tuple[float, float]], dict[int, tuple[int, int, float]]]:
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
            assert properties["cost"] > 0, "the planner refuses an edge that costs nothing"
            edges[properties["id"]] = (
                properties["startid"],
                properties["endid"],
                properties["cost"],
            )
    assert nodes
    assert edges
    assert {end for start, end, _ in edges.values()} | {
        start for start, _, _ in edges.values()
    } <= set(nodes)
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
            edges.append(edge["edge_id"])
    assert len(set(edges)) == len(edges)
    return data


# The actions that one can import from nav2_msgs.action.
NAV2_ACTIONS = {
    "NavigateToPose",
    "NavigateThroughPoses",
    "FollowWaypoints",
    "ComputePathToPose",
    "ComputePathThroughPoses",
}


def looked_up(node: dict[str, Any], path: str) -> Any:
    for key in path.split("."):
        node = node[key]
    return node


def filled(goal: Any, node: dict[str, Any]) -> Any:
    """Replace texts that begin with $ by fields of the node to which the edge leads."""
    if isinstance(goal, dict):
        return {key: filled(value, node) for key, value in goal.items()}
    return looked_up(node, goal[1:]) if isinstance(goal, str) and goal.startswith("$") else goal


def goals_of_humble(text: str) -> dict[str, tuple[str, dict[str, Any]]]:
    """For each edge the frame and pose to which LCAS's navigation of ROS 2 Humble drives."""
    data = yaml.safe_load(text)
    nodes = {entry["node"]["name"]: entry for entry in data["nodes"]}
    found = {}
    for entry in data["nodes"]:
        for edge in entry["node"]["edges"]:
            assert edge["action"] in NAV2_ACTIONS
            target = filled(edge["goal"], nodes[edge["node"]])["target_pose"]
            for part, axes in (("position", "xyz"), ("orientation", "xyzw")):
                assert all(type(target["pose"][part][axis]) is float for axis in axes), (
                    "a message takes floating-point numbers alone"
                )
            found[edge["edge_id"]] = target["header"]["frame_id"], target["pose"]
    return found


def graph_of_lcas(text: str) -> nx.DiGraph[Any]:
    """The graph on which the later navigation plans, with weights from properties."""
    data = yaml.safe_load(text)
    for action in data["actions"].values():
        module, _, name = action["action_type"].rpartition(".")
        assert (module, name in NAV2_ACTIONS, action["action_server"][0]) == (
            "nav2_msgs.action",
            True,
            "/",
        )
    graph: nx.DiGraph[Any] = nx.DiGraph()
    for entry in data["nodes"]:
        node = entry["node"]
        graph.add_node(
            node["name"],
            x=float(node["pose"]["position"]["x"]),
            y=float(node["pose"]["position"]["y"]),
        )
        for edge in node["edges"]:
            assert edge["action"] in data["actions"]
            graph.add_edge(node["name"], edge["node"], weight=float(edge["properties"]["weight"]))
    return graph


@pytest.mark.parametrize("level", ["places", "dstates"])
@pytest.mark.parametrize("has_poses", [True, False])
def test_tmap2_satisfies_the_lcas_format(level: str, has_poses: bool, square: SSHMap) -> None:
    ssh_map = square if has_poses else solve(rectangle(8)).maps[0]
    text = export_map(ssh_map, "tmap2", level=level, frame="hall")
    goals, graph = goals_of_humble(text), graph_of_lcas(text)
    assert len(goals) == graph.number_of_edges()
    assert {frame for frame, _ in goals.values()} == {"hall"}
    for start, end, weight in graph.edges(data="weight"):
        a, b = graph.nodes[start], graph.nodes[end]
        assert weight == pytest.approx(math.dist((a["x"], a["y"]), (b["x"], b["y"])), abs=1e-3)
        position = goals[f"{start}_{end}"][1]["position"]
        assert (position["x"], position["y"]) == (b["x"], b["y"])
    assert nx.shortest_path(graph, *list(graph)[:2], weight="weight")


@pytest.mark.parametrize("heading", [0.0, 8e-6, -8e-6, math.pi, -1e-9, 1e5])
@pytest.mark.parametrize("x", [0.0, -4e-6, 12345.678949, -0.0, 1e6, 1e20])
def test_numbers_have_a_decimal_point_and_no_exponent(x: float, heading: float) -> None:
    stops = (Stop(0, x, -x, heading, ("a",)), Stop(1, 5.0, 0.0, 0.0, ("b",)))
    text = tmap2(
        Roads("places", True, stops, (Road(0, 1, math.hypot(5 - x, x), None, None, None),)),
        "m",
        "map",
    )
    assert not re.search(r"\d[eE][-+]?\d", text.replace("place-", ""))
    (pose,) = (entry["node"]["pose"] for entry in yaml.safe_load(text)["nodes"][:1])
    assert all(type(value) is float for part in pose.values() for value in part.values())
    assert pose["position"]["x"] == pytest.approx(x, abs=1e-4)
    assert pose["orientation"]["w"] == pytest.approx(math.cos(heading / 2), abs=1e-6)


def test_nav2_turns_and_short_edges_have_positive_cost(square: SSHMap) -> None:
    nodes, edges = nav2_graph(export_map(square, "nav2", level="dstates"))
    costs = {nodes[start] == nodes[end]: cost for start, end, cost in edges.values()}
    assert costs[True] == TURN
    assert costs[False] == pytest.approx(10, abs=0.2)
    assert Road(0, 1, 1e-9, None, None, None).cost > 0
    near = Roads(
        "dstates", True, (Stop(0, 0, 0, 0, ()), Stop(1, 1e-9, 0, 0, ()), Stop(2, 3, 0, 0, ())), ()
    )
    assert near.together == 2


@pytest.mark.parametrize(
    ("theory", "level", "doubt"),
    [
        ("topological", "places", None),
        ("topological", None, None),
        (
            "topological",
            "dstates",
            "8 of 8 dstates share their position with others: .* export places",
        ),
        ("causal", None, "2 of 2 dstates share their position with others: .*--theory topological"),
    ],
)
@pytest.mark.parametrize("to", formats.FOR_NAVIGATION)
def test_export_warns_of_nodes_at_one_position(
    to: str,
    theory: str,
    level: str | None,
    doubt: str | None,
    square: SSHMap,
    tmp_path: object,
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = f"{tmp_path}/map.json"
    (square if theory == "topological" else causal_pair()).save(file)
    assert (
        main(["export", file, "--to", to, *([] if level is None else ["--set", f"level={level}"])])
        == 0
    )
    said = capsys.readouterr().err
    assert re.search(doubt, said) if doubt else said == ""


def causal_pair() -> SSHMap:
    """A map without places: one position, two headings."""
    trace = Trace.from_steps(
        ["a", "b", "a"], ["left", "right"], displacements=[(0, 0, 1.5708), (0, 0, -1.5708)]
    )
    return solve(trace, Theory.causal()).maps[0]


def test_nav2_export_has_metres_from_poses(square: SSHMap) -> None:
    nodes, edges = nav2_graph(export_map(square, "nav2"))
    assert len(nodes) == 4
    assert {(a, b) for a, b, _ in edges.values()} == {
        (a, b) for i in range(4) for a, b in ((i, (i + 1) % 4), ((i + 1) % 4, i))
    }
    for start, end, cost in edges.values():
        assert cost == pytest.approx(math.dist(nodes[start], nodes[end]), abs=1e-3)
        assert cost == pytest.approx(10, abs=0.2)


def test_export_of_dstates_has_one_edge_a_link(square: SSHMap) -> None:
    nodes, edges = nav2_graph(export_map(square, "nav2", level="dstates"))
    assert len(nodes) == 8
    assert {(a, b) for a, b, _ in edges.values()} == {(s, x) for s, _, x in square.links}


@pytest.mark.parametrize("level", ["places", "dstates"])
@pytest.mark.parametrize("to", [to for to in formats.FORMATS if to != "osm"])
def test_export_lays_out_maps_without_poses(to: str, level: str) -> None:
    ssh_map = solve(rectangle(8)).maps[0]
    if (to, level) == ("dot", "places"):
        with pytest.raises(MapError, match="DOT has a node for each dstate"):
            export_map(ssh_map, to, level=level)
        return
    if to == "svg":
        with pytest.raises(MapError, match="level: expected none for svg"):
            export_map(ssh_map, to, level=level)
        assert export_map(ssh_map, to).startswith("<svg")
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
        assert level == "places" or set(graph.edges(data="action")) == {
            (s, x, action) for s, action, x in ssh_map.links
        }


def test_causal_maps_are_exported() -> None:
    ssh_map = solve(rectangle(8), Theory.causal()).maps[0]
    assert len(nav2_graph(export_map(ssh_map, "nav2"))[0]) == len(ssh_map.dstates)
    assert len(checked_tmap2(export_map(ssh_map, "tmap2"))["nodes"]) == len(ssh_map.dstates)
    with pytest.raises(
        MapError, match="level: expected dstates, got places: the map has no places"
    ):
        export_map(ssh_map, "nav2", level="places")


@pytest.mark.parametrize(
    "text",
    [
        "a: b",
        "- x",
        '"',
        "\\",
        "\x07\x1b[31m",
        "\u0085\u2028\ufeff",
        "null",
        "#",
        "é😀",
        "{}",
        "\n\t",
        "yes",
    ],
)
def test_tmap2_export_keeps_any_text(text: str) -> None:
    ssh_map = SSHMap((0, 1), (DState(0, text), DState(1, "b")), ((0, text, 1),))
    data = checked_tmap2(export_map(ssh_map, "tmap2", name=text))
    assert data["name"] == text
    assert data["nodes"][0]["node"]["properties"]["views"] == text
    assert data["nodes"][0]["node"]["edges"][0]["properties"]["robot_action"] == text
    assert data["nodes"][1]["node"]["edges"] == []


def test_export_refuses_wrong_arguments_and_maps_without_roads(square: SSHMap) -> None:
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


def test_export_command_writes_the_output_of_python(
    square: SSHMap, tmp_path: object, capsys: pytest.CaptureFixture[str]
) -> None:
    assert tuple(verb.FORMATS) == (*formats.FORMATS, "rerun")
    assert f"--to {{{','.join(verb.FORMATS)}}}!" in verb.run_export.rows
    file = f"{tmp_path}/map.json"
    square.save(file)
    assert main(["export", file, "--to", "nav2", "-o", f"{tmp_path}/graph.geojson"]) == 0
    with open(f"{tmp_path}/graph.geojson", encoding="utf-8") as written:
        nodes, _ = nav2_graph(written.read())
    assert len(nodes) == 4
    assert capsys.readouterr().err == ""
    solve(rectangle(8)).maps[0].save(file)
    assert main(["export", file, "--to", "tmap2", "--set", "name=hall"]) == 0
    printed = capsys.readouterr()
    assert checked_tmap2(printed.out)["pointset"] == "hall"
    assert "positions are those of a drawing" in printed.err
    assert main(["export", file, "--to", "nav2", "--map", "3"]) == 1
    assert "1 to 1" in capsys.readouterr().err


def test_export_hides_undecided_places_and_joins_their_roads(
    square: SSHMap, tmp_path: object, capsys: pytest.CaptureFixture[str]
) -> None:
    """The robot drove once around the square. It began and ended at place 0."""
    nodes, edges = nav2_graph(export_map(square, "nav2", hide_undecided=True))
    assert sorted(nodes) == [0, 2, 3]  # without one of the roads there would be no loop
    costs = {(start, end): cost for start, end, cost in edges.values()}
    assert set(costs) == {(0, 2), (2, 0), (2, 3), (3, 2), (3, 0), (0, 3)}
    assert costs[0, 2] == costs[2, 0] == pytest.approx(20, abs=0.1)
    assert costs[2, 3] == pytest.approx(10, abs=0.1)
    square.save(file := f"{tmp_path}/map.json")
    assert main(["export", file, "--to", "tmap2", "--set", "hide_undecided=true"]) == 0
    assert len(checked_tmap2(capsys.readouterr().out)["nodes"]) == 3
    assert main(["export", file, "--to", "svg", "--set", "hide_undecided=true"]) == 1
    assert "expected nav2 or tmap2 with places, got svg" in capsys.readouterr().err
    assert len(square.places) == 4


def test_road_past_a_hidden_place_keeps_its_travel_actions() -> None:
    """There and back along a corridor of four places. Two of them are undecided."""
    moves = [(5, 0, 0), (7, 0, 0), (5, 0, 0), (0, 0, math.pi)]
    moves += moves[:3]
    trace = Trace.from_steps(
        "abcdefgh", [*["travel"] * 3, "around", *["travel"] * 3], displacements=moves
    )
    ssh_map = solve(trace).maps[0]
    roads = Roads.of(ssh_map, "places").without({1, 2})
    assert [(road.start, road.end) for road in roads.roads] == [(0, 3), (3, 0)]
    assert [road.action for road in roads.roads] == ["travel", "travel"]
    assert [road.length for road in roads.roads] == pytest.approx([17, 17], abs=0.1)
    assert [stop.id for stop in roads.stops] == [0, 3]


def test_exports_contain_regions() -> None:
    (ssh_map,) = solve(Trace.from_steps("abcdef", ["travel", "right", "travel", "left", "travel"]))
    regions = [region.to_dict() for region in ssh_map.regions or ()]
    graph = to_networkx(ssh_map)
    assert graph.graph["regions"] == regions
    assert graph.nodes[0]["regions"] == (0,)
    assert "regions" not in to_networkx(replace(ssh_map, regions=None)).graph
    places = nx.parse_graphml(export_map(ssh_map, "graphml", level="places"))
    assert places.nodes["3"]["regions"] == "3"
    assert json.loads(places.graph["regions"]) == regions
    nodes = json.loads(export_map(ssh_map, "nav2"))["features"]
    assert nodes[0]["properties"]["metadata"]["regions"] == "0"
    (first, *_) = yaml.safe_load(export_map(ssh_map, "tmap2"))["nodes"]
    assert first["node"]["properties"]["regions"] == "0"
    named = replace(ssh_map, names=(Name("region", 0, "wing"),))
    assert [r.get("name") for r in to_networkx(named).graph["regions"]][:2] == ["wing", None]
    for form in ("nav2", "tmap2", "graphml", "networkx-json", "dot"):
        assert "wing" in export_map(named, form), form


def test_dot_nests_regions_behind_a_place() -> None:
    trace = trace_of(TOUR)
    text = export_map(solve(trace, LOG, max_maps=1)[0], "dot")
    outer, inner = text.index("cluster_region_0 "), text.index('label="region 3, behind place 0"')
    assert outer < inner < text.index("subgraph cluster_1 ") < text.index("cluster_region_1 ")
    assert text.count("{") == text.count("}")
    corner = solve(Trace.from_steps("abcd", ["travel", "right", "travel"]))[0]
    assert 'label="place 2\\nright of path 0+"' in export_map(corner, "dot")


@pytest.mark.filterwarnings("ignore:views. trace 2 has no view in common")
def test_export_places_pieces_below_each_other_in_metres() -> None:
    """Two drives share nothing, so nothing says how their pieces lie."""
    ways, hall = [(10, 0, 0), (12, 0, 0)], [(1, 0, 0, 0), (1, 0, 1, 0), (0, 0, 1, 0)]
    doors = [(ahead, 1, back, left) for ahead, _, back, left in hall]
    drives = (("abc", hall), ("xyz", doors))
    ssh_map = solve(
        [Trace.from_steps(v, ["travel"] * 2, stars=s, displacements=ways) for v, s in drives]
    ).maps[0]
    assert len(ssh_map.pieces) == 2
    features = json.loads(export_map(ssh_map, "nav2"))["features"]
    spots = [f["geometry"]["coordinates"] for f in features if f["geometry"]["type"] == "Point"]
    assert [x for x, _ in spots] == [0, 10, 22] * 2
    assert len({y for _, y in spots}) == 2
    assert [said[:26] for said in formats.export_doubts(ssh_map, "nav2")] == [
        "the map is in 2 pieces, wh"
    ]
    assert 'stroke-dasharray="2 5"' not in to_svg(ssh_map)  # no line leads from piece to piece
