"""Route graphs of Nav2: GeoJSON, as docs.nav2.org describes it ("Navigation2 Route Graph File Formats").

The loader takes points for nodes and lines for edges. Ids are unsigned, edges are directed, and metadata are numbers, texts, truth values or objects of these: no null, no list of objects.
"""

from __future__ import annotations

from typing import Any

from ssh_abduction.data.files import json_line
from ssh_abduction.output.export.roads import Road, Roads, Stop

DIGITS = 4  # of coordinates, in metres


def nav2(roads: Roads, name: str, frame: str) -> str:
    """The GeoJSON text of a route graph. Ids of edges go on where those of nodes end, as Nav2 wants all ids to be different."""
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
        "views": " ".join(map(str, stop.views)),
        "heading": round(stop.heading, DIGITS),
    }
    return {"id": stop.id, "frame": frame, "metadata": metadata}


def _edge(road: Road, number: int) -> dict[str, Any]:
    known = {"action": road.action, "path": road.path, "direction": road.direction}
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
