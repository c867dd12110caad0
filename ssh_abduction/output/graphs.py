"""A map as a graph of networkx, and as GraphML."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any, Literal

import networkx as nx

from ssh_abduction.data.checks import one_of
from ssh_abduction.data.errors import MapError, xml_text
from ssh_abduction.data.maps import SSHMap, checked_map
from ssh_abduction.data.trace import Trace
from ssh_abduction.output.turns import Turns, degrees_of

LEVELS = ("causal", "topological", "places")


def to_networkx(
    ssh_map: SSHMap,
    level: Literal["causal", "topological", "places"] = "causal",
    turns: Trace | Turns | None = None,
) -> nx.Graph[Any]:
    """A map as a graph of networkx.

    Args:
        ssh_map: The map.
        level: Which graph.
            "causal" is a MultiDiGraph with a node for each dstate (view, place, path, direction,
            heading) and an edge for each link (action).
            "topological" is a bipartite Graph with the nodes ("place", p) and ("path", h), and an
            edge for each place on a path (index: where in the order of the path).
            "places" is a MultiGraph with a node for each place (pos: x to the right, y up; dstates)
            and an edge for each two neighbours on a path, with the path's id as its key (path;
            order: the index of the first of the two; travelled: whether the robot went from one to
            the other; metres, if the map has poses). Its `graph["metric"]` says whether positions
            are metres.
        turns: How actions turn, as in `to_svg`; for the positions of places without poses.

    Raises:
        MapError: If an argument is none of these.
    """
    checked_map(ssh_map)
    one_of("level", level, LEVELS, MapError)
    degrees_of(turns)
    if level == "causal":
        return _causal(ssh_map)
    return _places(ssh_map, turns) if level == "places" else _topological(ssh_map)


def to_graphml(ssh_map: SSHMap) -> str:
    """The causal graph as GraphML text.

    Raises:
        MapError: If `ssh_map` is not a map.
    """
    graph: nx.MultiDiGraph[Any] = nx.MultiDiGraph()
    causal = to_networkx(ssh_map)
    for s, data in causal.nodes(data=True):
        view = {"view": xml_text(str(data["view"]))} if "view" in data else {}
        graph.add_node(s, **{**data, **view})
    for source, target, action in causal.edges(data="action"):
        name = key = xml_text(action)
        if graph.has_edge(source, target, name):  # two names that differ in what XML cannot hold
            key = f"{name} ({graph.number_of_edges(source, target)})"
        graph.add_edge(source, target, key=key, action=name)
    return "\n".join(nx.generate_graphml(graph))


def _causal(ssh_map: SSHMap) -> nx.MultiDiGraph[Any]:
    """Dstates and links. Attributes that are None are left out."""
    graph: nx.MultiDiGraph[Any] = nx.MultiDiGraph()
    for s in ssh_map.dstates:
        facts = {
            "view": s.view,
            "place": s.place,
            "path": s.path,
            "direction": s.direction,
            "heading": s.heading,
        }
        graph.add_node(s.id, **{k: v for k, v in facts.items() if v is not None})
    for source, action, target in ssh_map.links:
        graph.add_edge(source, target, key=action, action=action)
    return graph


def _topological(ssh_map: SSHMap) -> nx.Graph[Any]:
    """Places and paths, as a bipartite graph."""
    graph: nx.Graph[Any] = nx.Graph()
    graph.add_nodes_from((("place", p) for p in ssh_map.places), bipartite=0)
    graph.add_nodes_from((("path", p.id) for p in ssh_map.paths), bipartite=1)
    for path in ssh_map.paths:
        for index, place in enumerate(path.order):
            graph.add_edge(("place", place), ("path", path.id), index=index)
    return graph


def _places(ssh_map: SSHMap, turns: Trace | Turns | None) -> nx.MultiGraph[Any]:
    """Places and the streets between neighbours on paths."""
    from ssh_abduction.output.layout import layout, travelled  # loads scipy

    found = layout(ssh_map, turns)
    graph: nx.MultiGraph[Any] = nx.MultiGraph(metric=found.metric)
    for place in ssh_map.places:
        dstates = tuple(s.id for s in ssh_map.dstates if s.place == place)
        graph.add_node(place, pos=found.places[place], dstates=dstates)
    for path in ssh_map.paths:
        streets = travelled(ssh_map, path)
        for index, (p, q) in enumerate(pairwise(path.order)):
            facts: dict[str, Any] = {
                "path": path.id,
                "order": index,
                "travelled": (min(p, q), max(p, q)) in streets,
            }
            if found.metric:
                facts["metres"] = math.dist(found.places[p], found.places[q])
            graph.add_edge(p, q, key=path.id, **facts)
    return graph
