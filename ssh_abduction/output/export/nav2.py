"""Write route graphs of Nav2, in GeoJSON (docs.nav2.org, "Navigation2 Route Graph File Formats").

Nodes are points, and directed edges are lines. Ids are not negative. Metadata are numbers, texts,
truth values, or objects of these. Nav2 reads no null and no list of objects in metadata.
"""

from __future__ import annotations

from typing import Any

from ssh_abduction.data.files import json_line
from ssh_abduction.output.export.roads import Road, Roads, Stop

DIGITS = 4  # of coordinates, in metres


def nav2(roads: Roads, name: str, frame: str) -> str:
    """Write a map as the GeoJSON text of a route graph.

    Args:
        roads: The map as stops and roads.
        name: The name of the map.
        frame: The name of the coordinate frame of the positions.
    """
    # All ids must differ, so the ids of edges follow those of nodes.
    first = max(stop.id for stop in roads.stops) + 1
    at = {stop.id: [round(stop.x, DIGITS), round(stop.y, DIGITS)] for stop in roads.stops}
    nodes = [_feature("Point", at[stop.id], _node(stop, roads, frame)) for stop in roads.stops]
    edges = [
        _feature("LineString", [at[r.start], at[r.end]], _edge(r, first + i))
        for i, r in enumerate(roads.roads)
    ]
    return json_line({"type": "FeatureCollection", "name": name, "features": nodes + edges})


def _feature(kind: str, coordinates: list[Any], properties: dict[str, Any]) -> dict[str, Any]:
    return {
        "type": "Feature",
        "properties": properties,
        "geometry": {"type": kind, "coordinates": coordinates},
    }


def _node(stop: Stop, roads: Roads, frame: str) -> dict[str, Any]:
    metadata = {
        "level": roads.level,
        "metric": roads.metric,
        **stop.properties,
        "heading": round(stop.heading, DIGITS),
        **({} if stop.floor is None else {"floor": stop.floor}),
        **({} if stop.name is None else {"name": stop.name}),
    }
    return {"id": stop.id, "frame": frame, "metadata": metadata}


def _edge(road: Road, number: int) -> dict[str, Any]:
    """Make an edge. Its metadata leave out what is unknown, as Nav2 reads no null."""
    known = {
        "action": road.action,
        "path": road.path,
        "direction": road.direction,
        "path_name": road.name,
    }
    metadata = {
        "travelled": road.action is not None,
        **{field: value for field, value in known.items() if value is not None},
    }
    return {
        "id": number,
        "startid": road.start,
        "endid": road.end,
        "cost": round(road.cost, DIGITS),
        "metadata": metadata,
    }
