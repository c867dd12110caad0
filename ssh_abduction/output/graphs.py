"""Convert a map to a graph of networkx, to GraphML or DOT text, or to a table of pandas."""

from __future__ import annotations

import json
import math
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Literal

import networkx as nx

from ssh_abduction.data.checks import needed, one_of
from ssh_abduction.data.errors import MapError, printable, xml_text
from ssh_abduction.data.map_parts import course_named, ids_at, list_in_words
from ssh_abduction.data.maps import DState, SSHMap, checked_map
from ssh_abduction.data.schema import only_known
from ssh_abduction.data.trace import Trace
from ssh_abduction.output.layout import Turns, degrees_of

if TYPE_CHECKING:
    import pandas as pd

LEVELS = ("causal", "topological", "places")


def to_networkx(
    ssh_map: SSHMap,
    level: Literal["causal", "topological", "places"] = "causal",
    turns: Trace | Turns | None = None,
) -> nx.Graph[Any]:
    """Convert a map to a graph of networkx.

    There are three kinds of graphs:

    - "causal" is a MultiDiGraph. Each dstate (distinctive state: a place and a heading) is a node
      with the attributes view, place, path, direction, heading, floor, place_name and path_name.
      Each link is an edge with the attribute action. Unknown attributes are left out.
    - "topological" is a bipartite Graph with the nodes ("place", p) and ("path", h). Each place on
      a path gives an edge with the attribute index, its position in the order of the path.
    - "places" is a MultiGraph. Each place is a node with the attributes pos (x to the right, y up),
      dstates, and floor if there are floors. Each pair of neighbours on a path gives an edge with
      the path's id as its key. The attributes of the edge are path; order, the index of the first
      neighbour; travelled, whether the robot went from one to the other; and metres, if the map has
      poses. In a map without paths, each pair of places that a travel connects gives an edge.
      `graph.graph["metric"]` says whether positions are metres.

    In the last two kinds, the attribute name has the name that a person gave to a place or path. If
    the map lists regions, `graph.graph["regions"]` has them as dicts, and the nodes of dstates and
    places have the ids of their regions as the attribute regions.

    Args:
        ssh_map: The map.
        level: The kind of graph: "causal", "topological" or "places".
        turns: How actions turn, as in `to_svg`. It decides the positions of "places" if the map has
            no poses.

    Raises:
        MapError: `ssh_map` is not a map, `level` is none of these, or `turns` has a value that is
            no turn.
    """
    checked_map(ssh_map)
    one_of("level", level, LEVELS, MapError)
    degrees_of(turns)
    if level == "causal":
        graph: nx.Graph[Any] = _causal(ssh_map)
        place_of: dict[Any, int | None] = {s.id: s.place for s in ssh_map.dstates}
    elif level == "places":
        graph, place_of = _places(ssh_map, turns), {p: p for p in ssh_map.places}
    else:
        graph, place_of = _topological(ssh_map), {("place", p): p for p in ssh_map.places}
    if ssh_map.regions is not None:
        graph.graph["regions"] = [
            region.to_dict() | only_known(name=ssh_map.name_of("region", region.id))
            for region in ssh_map.regions
        ]
        for node, place in place_of.items():
            if found := ids_at(ssh_map.regions, place):
                graph.nodes[node]["regions"] = found
    return graph


def to_graphml(ssh_map: SSHMap) -> str:
    """Write the dstates and links of a map as GraphML text.

    Raises:
        MapError: `ssh_map` is not a map.
    """
    causal = in_text(to_networkx(ssh_map))
    graph: nx.MultiDiGraph[Any] = nx.MultiDiGraph(**causal.graph)
    for s, data in causal.nodes(data=True):
        said = {"view", "place_name", "path_name"} & data.keys()
        graph.add_node(s, **{**data, **{name: xml_text(str(data[name])) for name in said}})
    for source, target, action in causal.edges(data="action"):
        name = key = xml_text(action)
        if graph.has_edge(source, target, name):  # XML lacks the characters in which names differ
            key = f"{name} ({graph.number_of_edges(source, target)})"
        graph.add_edge(source, target, key=key, action=name)
    return "\n".join(nx.generate_graphml(graph))


def to_dot(ssh_map: SSHMap) -> str:
    """Write the dstates and links of a map as DOT text.

    Each dstate (distinctive state: a place and a heading) is a node, each link an edge, and each
    place a cluster of nodes. A region behind one place is a cluster of places.

    Raises:
        MapError: `ssh_map` is not a map.
    """
    checked_map(ssh_map)
    lines = ["digraph map {", "  node [shape=box, style=rounded];"]
    lines += [f"  {_node(s, ssh_map)}" for s in ssh_map.dstates if s.place is None]
    lines += _clusters(ssh_map, {*ssh_map.places}, 0)
    lines += [
        f"  {source} -> {target} [label={_quoted(action)}];"
        for source, action, target in ssh_map.links
    ]
    return "\n".join([*lines, "}"])


def in_text(graph: nx.Graph[Any]) -> nx.Graph[Any]:
    """Convert the regions of a graph to texts, because files hold no lists. Return the graph.

    The regions of the graph become JSON. Those of a node become ids, separated by spaces.
    """
    if "regions" in graph.graph:
        graph.graph["regions"] = json.dumps(graph.graph["regions"])
    for _, data in graph.nodes(data=True):
        if "regions" in data:
            data["regions"] = " ".join(map(str, data["regions"]))
    return graph


def _causal(ssh_map: SSHMap) -> nx.MultiDiGraph[Any]:
    """Make the graph of dstates and links. Attributes that are None are left out."""
    graph: nx.MultiDiGraph[Any] = nx.MultiDiGraph()
    for s in ssh_map.dstates:
        facts = {name: getattr(s, name) for name in s.__slots__[1:]} | {
            f"{kind}_name": ssh_map.name_of(kind, getattr(s, kind)) for kind in ("place", "path")
        }
        graph.add_node(s.id, **only_known(**facts))
    for source, action, target in ssh_map.links:
        graph.add_edge(source, target, key=action, action=action)
    return graph


def _topological(ssh_map: SSHMap) -> nx.Graph[Any]:
    """Make the bipartite graph of places and paths."""
    graph: nx.Graph[Any] = nx.Graph()
    for place in ssh_map.places:
        graph.add_node(("place", place), bipartite=0, **_named(ssh_map, "place", place))
    for path in ssh_map.theory_paths:
        graph.add_node(("path", path.id), bipartite=1, **_named(ssh_map, "path", path.id))
        for index, place in enumerate(path.order):
            graph.add_edge(("place", place), ("path", path.id), index=index)
    return graph


def _places(ssh_map: SSHMap, turns: Trace | Turns | None) -> nx.MultiGraph[Any]:
    """Make the graph of places, with an edge for each pair of neighbours on a path."""
    from ssh_abduction.output.layout import layout, neighbours, travelled  # loads scipy

    found = layout(ssh_map, turns)
    graph: nx.MultiGraph[Any] = nx.MultiGraph(metric=found.metric)
    for place in ssh_map.places:
        dstates = tuple(s.id for s in ssh_map.dstates if s.place == place)
        floor = ssh_map.dstates[dstates[0]].floor if dstates else None
        more = only_known(floor=floor) | _named(ssh_map, "place", place)
        graph.add_node(place, pos=found.places[place], dstates=dstates, **more)
    for path in ssh_map.theory_paths:
        streets = travelled(ssh_map, path)
        for index, (p, q) in enumerate(pairwise(path.order)):
            metres = math.dist(found.places[p], found.places[q]) if found.metric else None
            more = only_known(metres=metres) | _named(ssh_map, "path", path.id)
            went = (min(p, q), max(p, q)) in streets
            graph.add_edge(p, q, key=path.id, path=path.id, order=index, travelled=went, **more)
    if not ssh_map.theory_paths:
        at = [s.place for s in ssh_map.dstates]
        for p, q in neighbours((at[s], at[x]) for s, _, x in ssh_map.links):
            metres = math.dist(found.places[p], found.places[q]) if found.metric else None
            graph.add_edge(p, q, travelled=True, **only_known(metres=metres))
    return graph


def _named(ssh_map: SSHMap, kind: str, number: int) -> dict[str, str]:
    """Return the attribute `name` of a place or path; empty if a person gave it none."""
    name = ssh_map.name_of(kind, number)
    return {} if name is None else {"name": xml_text(name)}


def to_pandas(ssh_map: SSHMap) -> pd.DataFrame:
    """Make a table with a row for each step of the trace that was mapped.

    Returns:
        A table with the columns dstate, view, place, path, direction, heading and floor. If the map
        has poses, also x and y (metres) and pose_heading (radians). If it has names, also
        place_name. The index is named step.

    Raises:
        MapError: `ssh_map` is not a map, or pandas is not installed.
    """
    checked_map(ssh_map)
    with needed("to_pandas", "pandas", "pandas", MapError):
        import pandas as pd
    rows = []
    for s in (ssh_map.dstates[label] for label in ssh_map.dstate_at):
        row = {"dstate": s.id} | {name: getattr(s, name) for name in s.__slots__[1:]}
        if ssh_map.names:
            row["place_name"] = ssh_map.name_of("place", s.place)
        if ssh_map.fit and ssh_map.fit.poses:
            pose = ssh_map.fit.poses[s.id]
            row |= {"x": pose.x, "y": pose.y, "pose_heading": pose.heading}
        rows.append(row)
    table = pd.DataFrame(rows, index=pd.RangeIndex(len(rows), name="step"))
    whole = ["place", "path", "direction", "heading", "floor"]
    return table.astype(dict.fromkeys(whole, "Int64"))  # integers that may be missing


def _clusters(ssh_map: SSHMap, places: set[int], after: int, indent: str = "  ") -> list[str]:
    """Write a cluster for each place and, around these, one for each region behind one place.

    Of two such regions, one contains the other, or they have no place in common. The largest come
    first.
    """
    lines, left = [], set(places)
    for region in (ssh_map.regions or ())[after:]:
        if region.door is not None and left >= {*region.places}:
            door = ssh_map.called("place", region.door)
            label = _quoted(f"{ssh_map.called('region', region.id)}, behind {door}")
            lines.append(f"{indent}subgraph cluster_region_{region.id} {{ label={label};")
            lines += _clusters(ssh_map, {*region.places}, region.id + 1, f"{indent}  ")
            lines.append(f"{indent}}}")
            left -= {*region.places}
    for p in (p for p in ssh_map.places if p in left):
        inside = " ".join(_node(s, ssh_map) for s in ssh_map.dstates if s.place == p)
        bounds = {c for r in ssh_map.regions or () if p in r.places for c in r.bounds}
        beside = f"\nright of {list_in_words(map(course_named, sorted(bounds)))}" if bounds else ""
        names = (ssh_map.name_of("region", r) for r in ids_at(ssh_map.regions, p))
        beside += "".join(f"\nin {name}" for name in names if name is not None)
        label = _quoted(ssh_map.called("place", p) + beside)
        lines.append(f"{indent}subgraph cluster_{p} {{ label={label}; {inside} }}")
    return lines


def _node(s: DState, ssh_map: SSHMap) -> str:
    course = f"\npath {s.course}" if s.course else ""
    name = ssh_map.name_of("path", s.path)
    course += "" if name is None else f" ({name})"
    course += "" if s.floor is None else f"\nfloor {s.floor}"
    return f"{s.id} [label={_quoted(f'{s.id}: {s.shown}{course}')}];"


def _quoted(text: str) -> str:
    """Quote text as a DOT string, and escape control characters of terminals."""
    lines = (printable(line).replace("\\", "\\\\").replace('"', '\\"') for line in text.split("\n"))
    return '"' + "\\n".join(lines) + '"'
