"""Street maps in the plane, with streets at any angles, and drives of a robot through them.

The robot sees the bearings of gateways. A world is a networkx graph. Its nodes are places, each
with a position `at`: a complex number, with x to the right and y up. Its edges are straight
streets.
"""

from __future__ import annotations

import cmath
import math
import random
from collections.abc import Container
from dataclasses import dataclass

import networkx as nx

from ssh_abduction import Trace
from ssh_abduction.data.trace import Action

STRAIGHT = 20.0  # degrees; two streets within this of one line are one path


@dataclass(frozen=True)
class Tour:
    """What a robot saw and did.

    Attributes:
        trace: The trace.
        truth: Place of each step, and its direction as a whole number.
    """

    trace: Trace
    truth: tuple[tuple[object, int], ...]

    @property
    def labels(self) -> tuple[int, ...]:
        """The true dstate of each step, numbered by first visit."""
        number: dict[tuple[object, int], int] = {}
        return tuple(number.setdefault(state, len(number)) for state in self.truth)

    @property
    def places(self) -> int:
        """The number of places that were visited."""
        return len({place for place, _ in self.truth})


def world(at: dict[object, complex], streets: list[tuple[object, object]]) -> nx.Graph:
    """Make a world.

    Args:
        at: Position of each place.
        streets: Pairs of places that streets join.
    """
    graph = nx.Graph(streets)
    nx.set_node_attributes(graph, at, "at")
    return graph


def triangle() -> nx.Graph:
    """Make a world of three places, with corners of 60 degrees."""
    return world(
        {k: cmath.rect(1, math.radians(120 * k)) for k in range(3)}, [(0, 1), (1, 2), (2, 0)]
    )


def hexagon() -> nx.Graph:
    """Make a world of six places in a ring, with bends of 120 degrees."""
    return world(
        {k: cmath.rect(1, math.radians(60 * k)) for k in range(6)},
        [(k, (k + 1) % 6) for k in range(6)],
    )


def honeycomb(rows: int, columns: int) -> nx.Graph:
    """Make a honeycomb: junctions of three streets, 120 degrees apart."""
    graph = nx.hexagonal_lattice_graph(rows, columns)
    nx.set_node_attributes(
        graph, {node: complex(*pos) for node, pos in graph.nodes(data="pos")}, "at"
    )
    return graph


def triangles(rows: int, columns: int) -> nx.Graph:
    """Make a lattice of triangles: junctions of up to six streets, 60 degrees apart."""
    graph = nx.triangular_lattice_graph(rows, columns)
    nx.set_node_attributes(
        graph, {node: complex(*pos) for node, pos in graph.nodes(data="pos")}, "at"
    )
    return graph


def wheel(spokes: int) -> nx.Graph:
    """Make a hub with spokes, and a ring road around it."""
    rim = {k: cmath.rect(1, 2 * math.pi * k / spokes) for k in range(spokes)}
    return world(
        {"hub": 0j, **rim}, [("hub", k) for k in rim] + [(k, (k + 1) % spokes) for k in rim]
    )


def junction(*directions: float) -> nx.Graph:
    """Make a hub with a dead end in each of some directions, in degrees."""
    ends = {k: cmath.rect(1, math.radians(d)) for k, d in enumerate(directions)}
    return world({"hub": 0j, **ends}, [("hub", k) for k in ends])


def scattered(places: int, rng: random.Random) -> nx.Graph:
    """Make a world of places at random positions, with streets that do not cross.

    At each place, the streets are at least 45 degrees apart. No street is nearly, but not exactly,
    opposite to another.
    """
    from scipy.spatial import Delaunay

    while True:
        points = [complex(rng.random(), rng.random()) for _ in range(places)]
        edges = {
            frozenset(map(int, (s[i], s[i - 1])))
            for s in Delaunay([(z.real, z.imag) for z in points]).simplices
            for i in range(3)
        }
        graph: nx.Graph = nx.Graph()
        graph.add_nodes_from((k, {"at": z}) for k, z in enumerate(points))
        for a, b in rng.sample(sorted(map(sorted, edges)), len(edges)):
            graph.add_edge(a, b)
            if any(_crowded(graph, place) for place in (a, b)):
                graph.remove_edge(a, b)
        if nx.is_connected(graph):
            return graph


def _crowded(graph: nx.Graph, place: object) -> bool:
    """Whether two streets at a place are hard to distinguish.

    They are if their angle is less than 45 degrees, or is 5 to 45 degrees from being opposite.
    """
    ways = [_direction(graph, place, there) for there in graph[place]]
    for i, a in enumerate(ways):
        for b in ways[:i]:
            apart = abs((a - b + 180) % 360 - 180)
            if apart < 45 or 180 - 45 < apart < 180 - 5:
                return True
    return False


def _direction(graph: nx.Graph, here: object, there: object) -> float:
    """The direction of a street, in degrees clockwise from up."""
    way = graph.nodes[there]["at"] - graph.nodes[here]["at"]
    return 90 - math.degrees(cmath.phase(way))


def _aligned(graph: nx.Graph, place: object, facing: float) -> float:
    """The direction of a robot after it arrives at a place, in degrees clockwise from up.

    The robot faces the street ahead, if there is one. Otherwise, it keeps its direction.
    """
    return next(
        (
            way
            for there in graph[place]
            if abs(((way := _direction(graph, place, there)) - facing + 180) % 360 - 180)
            <= STRAIGHT
        ),
        facing,
    )


def drive(
    graph: nx.Graph,
    start: object,
    towards: object,
    steps: int,
    rng: random.Random,
    noise: float = 0.0,
    unseen: bool = False,
    landmarks: Container[object] = (),
) -> Tour:
    """Drive a tour.

    At each place, the robot takes a street that it has used least often. A view is the bearings of
    the gateways, rounded to ten degrees. A star is the same bearings with errors.

    Args:
        graph: The world.
        start: The place where the robot starts.
        towards: The neighbouring place that it faces.
        steps: Number of steps of the trace.
        rng: Source of random choices.
        noise: Largest error of a bearing in a star, in degrees.
        unseen: Whether gateways behind the robot are not seen. Stars still have their bearings, but
            leave unknown whether they are open.
        landmarks: Places whose views also name the place.
    """
    here, facing = start, _direction(graph, start, towards)
    views: list[str] = []
    actions: list[Action] = []
    stars: list[list[object]] = []
    truth: list[tuple[object, int]] = []
    driven: dict[object, int] = {}

    def look() -> None:
        bearings = sorted((_direction(graph, here, there) - facing) % 360 for there in graph[here])
        seen: list[object] = []
        for bearing in bearings:
            off = bearing + rng.uniform(-noise, noise)
            hidden = unseen and 100 < bearing < 260
            seen.append(
                {"bearing": round(off, 2) % 360, "open": None} if hidden else round(off, 2) % 360
            )
        stars.append(seen)
        views.append(
            " ".join(
                [
                    *map(str, sorted(round(b / 10) % 36 for b in bearings)),
                    *([f"at {here}"] if here in landmarks else []),
                ]
            )
        )
        truth.append((here, round(facing / 5) % 72))

    look()
    ahead: object = towards
    while len(views) < steps:
        if ahead is not None:
            driven[frozenset((here, ahead))] = driven.get(frozenset((here, ahead)), 0) + 1
            facing = _direction(graph, here, ahead)
            here, ahead = ahead, None
            facing = _aligned(graph, here, facing)
            actions.append(Action.of("travel"))
            look()
            continue
        ways = list(graph[here])
        ahead = min(ways, key=lambda there: (driven.get(frozenset((here, there)), 0), rng.random()))
        turn = (_direction(graph, here, ahead) - facing) % 360
        if min(turn, 360 - turn) <= STRAIGHT:
            continue
        if abs(turn - 180) <= STRAIGHT:
            actions.append(Action.of("around"))
        else:
            side = "right" if turn < 180 else "left"
            others = sorted((_direction(graph, here, there) - facing) % 360 for there in ways)
            beside = [b for b in others if STRAIGHT < b < 360 - STRAIGHT]
            order = beside if side == "right" else beside[::-1]
            number = 1 + min(range(len(order)), key=lambda k: abs(order[k] - turn))
            actions.append(
                Action.of(
                    {"name": f"{side} {number}", "kind": "turn", "turn": side, "gateway": number}
                )
            )
        facing = _direction(graph, here, ahead)
        look()
    return Tour(Trace.from_steps(views, actions, stars=stars), tuple(truth))
