"""The formats that maps are exported to, and what writes each.

>>> from ssh_abduction import Trace, solve
>>> corridor = Trace.from_steps(["end", "hall", "end"], ["travel", "travel"], displacements=[(5, 0, 0), (5, 0, 0)])
>>> text = export_map(solve(corridor).maps[0], "nav2")
>>> text[:28], text.count('"Point"')
('{"type": "FeatureCollection"', 3)
"""

from __future__ import annotations

from typing import Any

import networkx as nx

from ssh_abduction.data.errors import MapError, brief, is_writable
from ssh_abduction.data.files import json_line
from ssh_abduction.data.maps import SSHMap, checked_map
from ssh_abduction.data.trace import Trace
from ssh_abduction.output.dot import to_dot
from ssh_abduction.output.export.nav2 import nav2
from ssh_abduction.output.export.roads import Roads
from ssh_abduction.output.export.tmap2 import tmap2
from ssh_abduction.output.graphs import to_graphml, to_networkx
from ssh_abduction.output.turns import Turns, degrees_of

FORMATS = ("nav2", "tmap2", "graphml", "dot", "networkx-json")
FOR_NAVIGATION = ("nav2", "tmap2")  # which need positions
LEVELS = ("places", "dstates")


def export_map(
    ssh_map: SSHMap,
    to: str,
    *,
    level: str | None = None,
    name: str = "ssh-abduction",
    frame: str = "map",
    turns: Trace | Turns | None = None,
) -> str:
    """A map as the text of a file for another program.

    to     nav2: a route graph of Nav2 (GeoJSON); tmap2: a topological map of LCAS's topological_navigation (YAML); graphml; dot: Graphviz; networkx-json: what
           networkx.node_link_graph reads
    level  what nodes are, "places" or "dstates"; None for places in what robots navigate by, where the map has any, and dstates elsewhere
    name   of the map, for tmap2 of its pointset, too
    frame  the coordinate frame of the positions
    turns  which way actions turn, for the layout of a map without poses, as `to_svg` takes them

    Positions are metres where the map has poses, seen from the first dstate; else they are of a layout, and the file says so. Raises MapError for what no such file can hold.
    """
    checked_map(ssh_map)
    degrees_of(turns)
    if not isinstance(to, str) or to not in FORMATS:
        raise MapError(
            f"to: expected {', '.join(FORMATS[:-1])} or {FORMATS[-1]}, got {brief(to)}; take one of these"
        )
    level = _level(ssh_map, to, level)
    if not isinstance(level, str) or level not in LEVELS:
        raise MapError(f"level: expected places or dstates, got {brief(level)}; say what nodes are")
    for field, text in (("name", name), ("frame", frame)):
        if not isinstance(text, str) or not text or not is_writable(text):
            raise MapError(f"{field}: expected a text, got {brief(text)}; name it")
    if to in FOR_NAVIGATION:
        return (nav2 if to == "nav2" else tmap2)(Roads.of(ssh_map, level, turns), name, frame)
    if level == "places":
        if not ssh_map.places:
            raise MapError(
                "level: expected dstates, got places: the map has no places; export its dstates"
            )
        if to == "dot":
            raise MapError(
                "level: expected dstates, got places: DOT has a node a dstate, and a cluster a place; leave the level out"
            )
        graph = _graph_of_places(ssh_map, turns)
    elif to == "networkx-json":
        graph = to_networkx(ssh_map)
    else:
        return to_dot(ssh_map) if to == "dot" else to_graphml(ssh_map)
    return (
        json_line(nx.node_link_data(graph, edges="edges"))
        if to == "networkx-json"
        else "\n".join(nx.generate_graphml(graph))
    )


def _graph_of_places(ssh_map: SSHMap, turns: Trace | Turns | None) -> nx.Graph[Any]:
    """The graph of places with plain attributes alone, as files hold them."""
    graph = to_networkx(ssh_map, "places", turns)
    for _, data in graph.nodes(data=True):
        data["x"], data["y"] = (round(float(number), 4) for number in data.pop("pos"))
        data["dstates"] = " ".join(map(str, data["dstates"]))
    return graph


def doubts(
    ssh_map: SSHMap, to: str, *, level: str | None = None, turns: Trace | Turns | None = None
) -> tuple[str, ...]:
    """What a program that navigates by an exported map may stumble over.

    Args:
        ssh_map: The map.
        to: The format, as `export_map` takes it; so are `level` and `turns`.

    Returns:
        A sentence for each. None for formats that nothing navigates by.
    """
    if to not in FOR_NAVIGATION:
        return ()
    level = _level(ssh_map, to, level)
    roads = Roads.of(ssh_map, level, turns)
    found = []
    if not roads.metric:
        found.append(
            "the map has no poses: its positions are of a layout, and no metres; solve a trace with displacements"
        )
    if together := roads.together:
        mend = (
            "export places (export --level places)"
            if ssh_map.places
            else "solve with places (solve --theory topological)"
        )
        found.append(
            f"{together} of {len(roads.stops)} {level} share their position with others: "
            f"programs that look nodes up by position may take a wrong one; {mend}"
        )
    return tuple(found)


def _level(ssh_map: SSHMap, to: str, level: str | None) -> str:
    """The level that is exported where none is asked for."""
    return (
        level
        if level is not None
        else "places"
        if to in FOR_NAVIGATION and ssh_map.places
        else "dstates"
    )
