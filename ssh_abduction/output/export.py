"""Export a map as the text of a file for another program.

>>> from ssh_abduction import Trace, solve
>>> moved = [(5, 0, 0), (5, 0, 0)]
>>> corridor = Trace.from_steps(["end", "hall", "end"], ["travel"] * 2, displacements=moved)
>>> text = export_map(solve(corridor).maps[0], "nav2")
>>> text[:28], text.count('"Point"')
('{"type": "FeatureCollection"', 3)

Route graphs of Nav2 are GeoJSON (docs.nav2.org, "Navigation2 Route Graph File Formats"). Nodes are
points, and directed edges are lines. Ids are not negative. Metadata are numbers, texts, truth
values, or objects of these. Nav2 reads no null and no list of objects in metadata.

Topological maps for LCAS's topological_navigation are tmap2, in YAML. Two versions of that program
read them. The one for ROS 2 Humble imports the `action` of an edge from nav2_msgs.action and sends
the `goal` of the edge. In the goal, "$node.pose" is replaced by the pose of the node where the edge
ends. The later version looks the action up in the `actions` of the map, and takes
`properties.weight` as the cost of an edge.
"""

from __future__ import annotations

import cmath
import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
import yaml

from ssh_abduction.data.checks import a_flag, one_of
from ssh_abduction.data.errors import MapError, brief, is_writable
from ssh_abduction.data.files import json_line
from ssh_abduction.data.maps import SSHMap, checked_map
from ssh_abduction.data.schema import only_known
from ssh_abduction.data.trace import Trace
from ssh_abduction.output.drawing import to_svg
from ssh_abduction.output.graphs import in_text, to_dot, to_graphml, to_networkx
from ssh_abduction.output.layout import Turns, degrees_of
from ssh_abduction.output.osm_areas import osm_areas
from ssh_abduction.output.roads import DIGITS, NO_PLACES, Road, Roads, Stop, undecided_places

FORMATS = ("nav2", "tmap2", "osm", "graphml", "dot", "svg", "networkx-json")
FOR_NAVIGATION = ("nav2", "tmap2")  # these need positions
LEVELS = ("places", "dstates")
# What all topological maps of LCAS's topological_navigation, their nodes and edges have in common.
TMAP2 = Path(__file__).with_name("tmap2.yaml")
# Tolerances of goals in metres and radians, from the program's own examples. The robot has to reach
# the heading of a dstate; at a place, any heading will do.
NEAR, FACING = 0.3, {"dstates": 0.1, "places": 6.28}
# The radius in metres of the octagon in which a robot is at a node.
RADIUS = 0.75


def export_map(
    ssh_map: SSHMap,
    to: str,
    *,
    level: str | None = None,
    name: str = "ssh-abduction",
    frame: str = "map",
    turns: Trace | Turns | None = None,
    hide_undecided: bool = False,
) -> str:
    """Export a map as the text of a file for another program.

    If the map has poses, positions are metres relative to the first dstate (distinctive state: a
    place and a heading). Otherwise positions are computed by a layout; nav2 and tmap2 files say so.

    Args:
        ssh_map: The map.
        to: The format: "nav2", a route graph of Nav2 (GeoJSON); "tmap2", a topological map of
            LCAS's topological_navigation (YAML); "osm", rooms and doors as an area graph (osmAG,
            OpenStreetMap XML); "graphml"; "dot", for Graphviz; "svg", a picture; or
            "networkx-json", which networkx.node_link_graph reads.
        level: What a node is: "places" or "dstates". None takes places for nav2 and tmap2 if the
            map has any, and dstates otherwise. Must be None for "svg" and "osm", and not "places"
            for "dot".
        name: The name of the map in nav2 and tmap2 files. In tmap2 it also names the pointset.
        frame: The name of the coordinate frame of the positions, in nav2 and tmap2 files.
        turns: How actions turn, for the layout of a map without poses: the trace that was mapped,
            or a dict from the name of an action to its turn, as in `to_svg`.
        hide_undecided: Whether nav2 and tmap2 files leave out each place that the robot only
            passed, always between the same two neighbours. One road then joins these neighbours.

    Raises:
        MapError: An argument is wrong, or the map has no such level or no roads.
    """
    checked_map(ssh_map)
    degrees_of(turns)
    one_of("to", to, FORMATS, MapError)
    hidden = a_flag("hide_undecided", hide_undecided, MapError)
    nodes = _level(ssh_map, to, level)
    if hidden and (to not in FOR_NAVIGATION or nodes != "places"):
        raise MapError(
            f"hide_undecided: expected nav2 or tmap2 with places, got {to} with {nodes}; "
            "export places for navigation, or show all"
        )
    if to in ("svg", "osm") and level is not None:
        shows = "places and dstates" if to == "svg" else "rooms"
        raise MapError(f"level: expected none for {to}, which shows {shows}; leave it out")
    if to == "svg":
        return to_svg(ssh_map, turns)
    if to == "osm":
        return osm_areas(ssh_map)
    level = one_of("level", nodes, LEVELS, MapError, mend="say what nodes are")
    for field, text in (("name", name), ("frame", frame)):
        if not isinstance(text, str) or not text or not is_writable(text):
            raise MapError(f"{field}: expected a text, got {brief(text)}; name it")
    if to in FOR_NAVIGATION:
        roads = _roads(ssh_map, level, turns, hide_undecided)
        return nav2(roads, name, frame) if to == "nav2" else tmap2(roads, name, frame)
    if level == "places":
        graph = _graph_of_places(ssh_map, to, turns)
    elif to == "dot":
        return to_dot(ssh_map)
    elif to == "graphml":
        return to_graphml(ssh_map)
    else:
        graph = to_networkx(ssh_map)
    if to == "networkx-json":
        return json_line(nx.node_link_data(graph, edges="edges"))
    return "\n".join(nx.generate_graphml(graph))


def _roads(ssh_map: SSHMap, level: str, turns: Trace | Turns | None, hide_undecided: bool) -> Roads:
    """Make the stops and roads of a map, without undecided places if these are hidden."""
    roads = Roads.of(ssh_map, level, turns)
    return roads.without(undecided_places(ssh_map)) if hide_undecided else roads


def _graph_of_places(ssh_map: SSHMap, to: str, turns: Trace | Turns | None) -> nx.Graph[Any]:
    """Make the graph of places with numbers or texts. Raises MapError without places."""
    if not ssh_map.places:
        raise MapError(NO_PLACES)
    if to == "dot":
        raise MapError(
            "level: expected dstates, got places: DOT has a node for each dstate, and a cluster "
            "for each place; leave the level out"
        )
    graph = in_text(to_networkx(ssh_map, "places", turns))
    for _, data in graph.nodes(data=True):
        data["x"], data["y"] = (round(float(number), 4) for number in data.pop("pos"))
        data["dstates"] = " ".join(map(str, data["dstates"]))
    return graph


def export_doubts(
    ssh_map: SSHMap,
    to: str,
    *,
    level: str | None = None,
    turns: Trace | Turns | None = None,
    hide_undecided: bool = False,
) -> tuple[str, ...]:
    """Say for which reasons a program may navigate wrongly by a map in nav2 or tmap2.

    Parameters as in `export_map`. There are no reasons for other formats.
    """
    if to not in FOR_NAVIGATION:
        return ()
    level = _level(ssh_map, to, level)
    roads = _roads(ssh_map, level, turns, hide_undecided)
    found = []
    if not roads.metric:
        found.append(
            "the map has no poses, so its positions are those of a drawing, not metres; "
            "solve a trace with displacements, and without a short time limit"
        )
    if len(ssh_map.pieces) > 1:
        found.append(
            f"the map is in {len(ssh_map.pieces)} pieces, which are put below each other: nothing "
            "says how they lie relative to each other; log a drive that joins them"
        )
    if together := roads.together:
        mend = "solve with places (solve --theory topological)"
        mend = "export places (export --set level=places)" if ssh_map.places else mend
        found.append(
            f"{together} of {len(roads.stops)} {level} share their position with others: "
            f"programs that look nodes up by position may take a wrong one; {mend}"
        )
    return tuple(found)


def _level(ssh_map: SSHMap, to: str, level: str | None) -> str:
    """Choose the level to export: `level`, or the default of the format if it is None."""
    if level is not None:
        return level
    return "places" if to in FOR_NAVIGATION and ssh_map.places else "dstates"


def nav2(roads: Roads, name: str, frame: str) -> str:
    """Write a map as the GeoJSON text of a route graph.

    `frame` is the name of the coordinate frame of the positions.
    """
    # All ids must differ, so the ids of edges follow those of nodes.
    first = max(stop.id for stop in roads.stops) + 1
    at = {stop.id: [round(stop.x, DIGITS), round(stop.y, DIGITS)] for stop in roads.stops}
    features = []
    for stop in roads.stops:
        metadata = {
            "level": roads.level,
            "metric": roads.metric,
            **stop.properties,
            "heading": round(stop.heading, DIGITS),
            **only_known(floor=stop.floor, name=stop.name),
        }
        node = {"id": stop.id, "frame": frame, "metadata": metadata}
        features.append(_feature("Point", at[stop.id], node))
    for number, road in enumerate(roads.roads, first):
        # Nav2 reads no null, so leave out what is unknown.
        way = {"action": road.action, "path": road.path, "direction": road.direction}
        edge = {
            "id": number,
            "startid": road.start,
            "endid": road.end,
            "cost": round(road.cost, DIGITS),
            "metadata": {
                "travelled": road.action is not None,
                **only_known(**way, path_name=road.name),
                **road.indoors,
            },
        }
        features.append(_feature("LineString", [at[road.start], at[road.end]], edge))
    return json_line({"type": "FeatureCollection", "name": name, "features": features})


def _feature(kind: str, coordinates: list[Any], properties: dict[str, Any]) -> dict[str, Any]:
    geometry = {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "properties": properties, "geometry": geometry}


def tmap2(roads: Roads, name: str, frame: str) -> str:
    """Write a map as the YAML text of a topological map.

    `name` names the map and its pointset, `frame` the coordinate frame of the positions.
    """
    title = {"places": "place", "dstates": "dstate"}[roads.level]
    names = {stop.id: f"{title}-{stop.id}" for stop in roads.stops}
    if roads.level == "places":  # programs go to a place by its name
        own = {stop.id: stop.name for stop in roads.stops if stop.name is not None}
        names |= {number: name for number, name in own.items() if name not in names.values()}
    same = yaml.safe_load(TMAP2.read_text(encoding="utf-8"))
    edges: dict[int, list[dict[str, Any]]] = {stop.id: [] for stop in roads.stops}
    for road in roads.roads:
        edges[road.start].append({**same["edge"], **_edge(road, names)})
    made = datetime.now(UTC).strftime("%Y-%m-%d_%H-%M-%S")
    nodes = [
        {
            "meta": {"map": name, "node": names[stop.id], "pointset": name},
            "node": {
                **same["node"],
                **_node(stop, FACING[roads.level]),
                "name": names[stop.id],
                "parent_frame": frame,
                "edges": edges[stop.id],
            },
        }
        for stop in roads.stops
    ]
    data = {
        **same["map"],
        "meta": {"last_updated": made, "positions": "metres" if roads.metric else "layout"},
        **dict.fromkeys(("metric_map", "name", "pointset"), name),
        "transformation": {**same["map"]["transformation"], "parent": frame},
        "nodes": nodes,
    }
    text: str = yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=2**16)
    return text


def _node(stop: Stop, facing: float) -> dict[str, Any]:
    """Make the pose of a node, its goal tolerances, and the octagon around it."""
    properties = {"xy_goal_tolerance": NEAR, "yaw_goal_tolerance": facing, **stop.properties}
    octagon = [cmath.rect(RADIUS, math.tau * (i + 0.5) / 8) for i in range(8)]
    position = {"x": _rounded(stop.x), "y": _rounded(stop.y), "z": 0.0}
    return {
        "pose": {"position": position, "orientation": _rotation(stop.heading)},
        "properties": {**properties, **only_known(place_name=stop.name, floor=stop.floor)},
        "verts": [{"x": _rounded(z.real), "y": _rounded(z.imag)} for z in octagon],
    }


def _edge(road: Road, names: dict[int, str]) -> dict[str, Any]:
    """Make what is special to an edge."""
    own = only_known(robot_action=road.action, path_name=road.name)
    measured = dict.fromkeys(("weight", "length"), _rounded(road.length))
    return {
        "edge_id": f"{names[road.start]}_{names[road.end]}",
        "node": names[road.end],
        "properties": {**measured, "travelled": road.action is not None, **own},
    }


def _rotation(heading: float) -> dict[str, float]:
    """Convert a heading in radians to a quaternion."""
    half = cmath.rect(1.0, heading / 2)
    return {"w": _rounded(half.real, 6), "x": 0.0, "y": 0.0, "z": _rounded(half.imag, 6)}


def _rounded(number: float, digits: int = DIGITS) -> float:
    """Round a number, and turn -0.0 into 0.0."""
    return round(number, digits) + 0.0


class _Dumper(yaml.SafeDumper):
    """Writes numbers with a decimal point and no exponent, because PyYAML reads 4e-06 as text.

    What edges have in common is written for each.
    """

    def ignore_aliases(self, data: object) -> bool:
        return True


_Dumper.add_multi_representer(str, _Dumper.represent_str)  # also texts of numpy
_Dumper.add_representer(
    float,
    lambda dumper, number: dumper.represent_scalar(
        "tag:yaml.org,2002:float", np.format_float_positional(number, trim="0")
    ),
)
