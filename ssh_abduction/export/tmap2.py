"""Topological maps of LCAS's topological_navigation: tmap2, in YAML, as its schema describes them."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

from ssh_abduction.export.roads import Road, Roads, Stop

ACTION, ACTION_TYPE = "navigate_to_pose", "nav2_msgs.action.NavigateToPose"
DIGITS = 4  # of coordinates, in metres
# Tolerances of goals, in metres and radians, and the radius of the octagon around a node in which a robot is at it, in metres: those of the programs' own examples.
NEAR, FACING, RADIUS = 0.3, 0.1, 0.75


def tmap2(roads: Roads, name: str, frame: str, updated: datetime | None = None) -> str:
    """The YAML text of a topological map.

    updated  when the map was made; None for now
    """
    title = {"places": "place", "dstates": "dstate"}[roads.level]
    names = {stop.id: f"{title}-{stop.id}" for stop in roads.stops}
    leaving: dict[int, list[Road]] = {stop.id: [] for stop in roads.stops}
    for road in roads.roads:
        leaving[road.start].append(road)
    data = {
        "meta": {
            "last_updated": (updated or datetime.now(UTC)).strftime("%Y-%m-%d_%H-%M-%S"),
            "positions": "metres" if roads.metric else "layout",
        },
        "metric_map": name,
        "name": name,
        "pointset": name,
        "transformation": {"rotation": _rotation(0.0), "translation": {"x": 0.0, "y": 0.0, "z": 0.0}, "child": "topo_map", "parent": frame},
        "nodes": [_node(stop, leaving[stop.id], names, name, frame) for stop in roads.stops],
    }
    return "\n".join(_yaml(data)) + "\n"


def _node(stop: Stop, leaving: list[Road], names: dict[int, str], pointset: str, frame: str) -> dict[str, Any]:
    corners = [math.tau * (i + 0.5) / 8 for i in range(8)]
    return {
        "meta": {"map": pointset, "node": names[stop.id], "pointset": pointset},
        "node": {
            "name": names[stop.id],
            "parent_frame": frame,
            "localise_by_topic": "",
            "pose": {
                "position": {"x": round(stop.x, DIGITS), "y": round(stop.y, DIGITS), "z": 0.0},
                "orientation": _rotation(stop.heading),
            },
            "properties": {"xy_goal_tolerance": NEAR, "yaw_goal_tolerance": FACING, "views": " ".join(map(str, stop.views))},
            "restrictions_planning": "True",
            "restrictions_runtime": "True",
            "verts": [{"x": round(RADIUS * math.cos(a), DIGITS), "y": round(RADIUS * math.sin(a), DIGITS)} for a in corners],
            "edges": [_edge(road, names) for road in leaving],
        },
    }


def _edge(road: Road, names: dict[int, str]) -> dict[str, Any]:
    return {
        "edge_id": f"{names[road.start]}_{names[road.end]}",
        "node": names[road.end],
        "action": ACTION,
        "action_type": ACTION_TYPE,
        "config": [],
        "fail_policy": "fail",
        "fluid_navigation": True,
        "goal": {},
        "recovery_behaviours_config": "",
        "restrictions_planning": "True",
        "restrictions_runtime": "True",
        "properties": {
            "length": round(road.length, DIGITS),
            "travelled": road.action is not None,
            **({} if road.action is None else {"robot_action": road.action}),
        },
    }


def _rotation(heading: float) -> dict[str, float]:
    """A turn about the vertical as a quaternion."""
    return {"w": round(math.cos(heading / 2), 6), "x": 0.0, "y": 0.0, "z": round(math.sin(heading / 2), 6)}


def _yaml(value: Any, indent: str = "") -> Iterator[str]:
    """The lines of a value in YAML's block style. Scalars are written as JSON writes them, which YAML reads alike."""
    for name, item in value.items() if isinstance(value, dict) else (("-", item) for item in value):
        head = f"{indent}-" if name == "-" else f"{indent}{name}:"
        if not isinstance(item, dict | list) or not item:
            yield f"{head} {_scalar(item)}"
        elif name == "-":
            first, *rest = _yaml(item, f"{indent}  ")
            yield f"{head} {first.lstrip()}"
            yield from rest
        else:
            yield head
            yield from _yaml(item, f"{indent}  ")


def _scalar(value: Any) -> str:
    if isinstance(value, str):
        return '"' + "".join(c if c.isprintable() and c not in '"\\' else json.dumps(c)[1:-1] for c in value) + '"'
    return json.dumps(value)
