"""Write topological maps for LCAS's topological_navigation: tmap2, in YAML.

Two versions of that program read these maps. The one for ROS 2 Humble imports the `action` of an
edge from nav2_msgs.action and sends the `goal` of the edge. In the goal, "$node.pose" is replaced
by the pose of the node where the edge ends. The later version looks the action up in the `actions`
of the map, and takes `properties.weight` as the cost of an edge.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import Any

import numpy as np
import yaml

from ssh_abduction.data.words import only_known
from ssh_abduction.output.export.roads import DIGITS, Road, Roads, Stop

ACTION = "NavigateToPose"
# Tolerances of goals in metres and radians, from the program's own examples. The robot has to reach
# the heading of a dstate; at a place, any heading will do.
NEAR, FACING = 0.3, {"dstates": 0.1, "places": 6.28}
# The radius in metres of the octagon in which a robot is at a node.
RADIUS = 0.75


def tmap2(roads: Roads, name: str, frame: str) -> str:
    """Write a map as the YAML text of a topological map.

    `name` names the map and its pointset, `frame` the coordinate frame of the positions.
    """
    title = {"places": "place", "dstates": "dstate"}[roads.level]
    names = {stop.id: f"{title}-{stop.id}" for stop in roads.stops}
    if roads.level == "places":  # programs go to a place by its name
        own = {stop.id: stop.name for stop in roads.stops if stop.name is not None}
        names |= {number: name for number, name in own.items() if name not in names.values()}
    leaving: dict[int, list[Road]] = {stop.id: [] for stop in roads.stops}
    for road in roads.roads:
        leaving[road.start].append(road)
    # Edges name their action, which the map describes once.
    data = {
        "meta": {
            "last_updated": datetime.now(UTC).strftime("%Y-%m-%d_%H-%M-%S"),
            "positions": "metres" if roads.metric else "layout",
        },
        "metric_map": name,
        "name": name,
        "pointset": name,
        "transformation": {
            "rotation": _rotation(0.0),
            "translation": {"x": 0.0, "y": 0.0, "z": 0.0},
            "child": "topo_map",
            "parent": frame,
        },
        "actions": {ACTION: _action()},
        "nodes": [
            _node(stop, leaving[stop.id], names, name, frame, FACING[roads.level])
            for stop in roads.stops
        ],
    }
    text: str = yaml.dump(data, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=2**16)
    return text


def _action() -> dict[str, Any]:
    """Describe the action of all edges, for the later version, which looks it up in the map."""
    return {
        "action_type": f"nav2_msgs.action.{ACTION}",
        "action_server": "/navigate_to_pose",
        "composable": False,
        "action_goal_template": {
            "pose": {"header": {"frame_id": "${node.nav_frame}"}, "pose": "${node.pose}"}
        },
    }


def _node(
    stop: Stop, leaving: list[Road], names: dict[int, str], pointset: str, frame: str, facing: float
) -> dict[str, Any]:
    """Make a node with its goal tolerances, the octagon around it, and the edges from it."""
    corners = [math.tau * (i + 0.5) / 8 for i in range(8)]
    return {
        "meta": {"map": pointset, "node": names[stop.id], "pointset": pointset},
        "node": {
            "name": names[stop.id],
            "parent_frame": frame,
            "localise_by_topic": "",
            "pose": {
                "position": {"x": _rounded(stop.x), "y": _rounded(stop.y), "z": 0.0},
                "orientation": _rotation(stop.heading),
            },
            "properties": {
                "xy_goal_tolerance": NEAR,
                "yaw_goal_tolerance": facing,
                **stop.properties,
                **only_known(place_name=stop.name, floor=stop.floor),
            },
            "restrictions_planning": "True",
            "restrictions_runtime": "True",
            "verts": [
                {"x": _rounded(RADIUS * math.cos(a)), "y": _rounded(RADIUS * math.sin(a))}
                for a in corners
            ],
            "edges": [_edge(road, names) for road in leaving],
        },
    }


def _edge(road: Road, names: dict[int, str]) -> dict[str, Any]:
    """Make an edge that both versions of the program read."""
    return {
        "edge_id": f"{names[road.start]}_{names[road.end]}",
        "node": names[road.end],
        "action": ACTION,
        "action_type": f"nav2_msgs/action/{ACTION}",
        "config": [],
        "fail_policy": "fail",
        "fluid_navigation": True,
        "goal": {
            "target_pose": {"header": {"frame_id": "$node.parent_frame"}, "pose": "$node.pose"}
        },
        "recovery_behaviours_config": "",
        "restrictions_planning": "True",
        "restrictions_runtime": "True",
        "properties": {
            "weight": _rounded(road.length),
            "length": _rounded(road.length),
            "travelled": road.action is not None,
            **only_known(robot_action=road.action, path_name=road.name),
        },
    }


def _rotation(heading: float) -> dict[str, float]:
    """Convert a heading in radians to a quaternion."""
    return {
        "w": _rounded(math.cos(heading / 2), 6),
        "x": 0.0,
        "y": 0.0,
        "z": _rounded(math.sin(heading / 2), 6),
    }


def _rounded(number: float, digits: int = DIGITS) -> float:
    """Round a number, and turn -0.0 into 0.0."""
    return round(number, digits) + 0.0


class _Dumper(yaml.SafeDumper):
    """Writes numbers with a decimal point and no exponent, because PyYAML reads 4e-06 as text."""


_Dumper.add_multi_representer(str, _Dumper.represent_str)  # also texts of numpy
_Dumper.add_representer(
    float,
    lambda dumper, number: dumper.represent_scalar(
        "tag:yaml.org,2002:float", np.format_float_positional(number, trim="0")
    ),
)
