"""Worlds drawn from street maps: walls along both sides of each street, and the true dstates.

    python benchmarks/streets.py [--seeds 20] [--tours 2]

The script simulates drives in such worlds, maps the traces, and prints a table in Markdown. A
street map is a networkx graph whose nodes have a position `at`, as in planar.py. A dstate
(distinctive state) is a place and a heading there.
"""

from __future__ import annotations

import argparse
import cmath
import json
import math
import tempfile
from collections.abc import Iterator
from pathlib import Path
from time import process_time
from typing import Any

import networkx as nx
import planar
from arguments import add_number

from perception.appearance import ReciprocalTransformer
from perception.images import images_of
from perception.views import ViewClusterer
from simulator.errors import SimulatorError
from simulator.tours import simulate
from simulator.world import World
from ssh_abduction import solve
from ssh_abduction.evaluation import evaluate

Leg = tuple[object, object]  # a place, and the next one along a street
STRAIGHT = 20.0  # degrees; two streets within this of one line are one path


def drawn(
    graph: nx.Graph, reach: float, start: Leg, route: list[str] | None = None, name: str = "streets"
) -> dict[str, Any]:
    """Make a world from a street map, as the content of a world file.

    Args:
        graph: The street map.
        reach: Half the width of a street, and its length beyond a dead end, in metres.
        start: The place where the robot starts, and the place that it faces.
        route: Actions of the robot; None for a tour of all streets in both directions.
        name: Name of the world.
    """
    ways = {(a, b): _way(graph, a, b) for a, b in graph.edges} | {
        (b, a): _way(graph, b, a) for a, b in graph.edges
    }
    return {
        "format": "ssh-world",
        "version": 1,
        "name": name,
        "polygons": [
            [[round(z.real, 4), round(z.imag, 4)] for z in polygon]
            for polygon in _polygons(graph, ways, reach)
        ],
        "reach": reach,
        "start": _pose(graph, start[0], ways[start]),
        "route": round_trip(graph, start) if route is None else route,
        "dstates": _dstates(graph, ways),
    }


def _way(graph: nx.Graph, here: object, there: object) -> complex:
    way: complex = graph.nodes[there]["at"] - graph.nodes[here]["at"]
    return way / abs(way)


def _pose(graph: nx.Graph, place: object, way: complex) -> list[float]:
    at: complex = graph.nodes[place]["at"]
    return [round(at.real, 4), round(at.imag, 4), round(math.degrees(cmath.phase(way)), 3)]


def _polygons(graph: nx.Graph, ways: dict[Leg, complex], reach: float) -> list[list[complex]]:
    """The outlines of the walls, as lists of points.

    An outline follows the streets from place to place. At each place, it goes on along the next
    street counterclockwise from the one by which it came.

    Args:
        graph: The street map.
        ways: Direction of each leg, as a unit vector.
        reach: Half the width of a street in metres.
    """
    left = set(ways)
    found = []
    while left:
        leg = first = min(left, key=str)
        polygon: list[complex] = []
        while leg in left:
            left.remove(leg)
            here, there = leg
            at: complex = graph.nodes[there]["at"]
            back = ways[there, here]
            others = sorted(
                graph[there],
                key=lambda other: (
                    cmath.phase(ways[there, other] / back / cmath.rect(1, 1e-9)) % math.tau
                ),
            )
            onward = others[0]
            way = ways[there, onward]
            if onward == here:
                polygon += [
                    at - reach * back + reach * 1j * back,
                    at - reach * back - reach * 1j * back,
                ]
            else:  # the corner between this street and the next one counter-clockwise
                a, b = reach * 1j * back, -reach * 1j * way
                turn = (back.conjugate() * way).imag
                along = ((b - a).conjugate() * way).imag / turn if abs(turn) > 1e-6 else 0.0
                polygon.append(at + a + along * back)
            leg = (there, onward)
        assert leg == first
        found.append(polygon)
    return found


def _dstates(graph: nx.Graph, ways: dict[Leg, complex]) -> list[dict[str, Any]]:
    """The dstates of the world, as in a world file.

    There is a dstate that faces each street of a place. If no other street is opposite, there is
    also a dstate that has the street behind it. A path goes on through opposite streets.
    """
    course: dict[Leg, tuple[int, int]] = {}
    for leg in ways:
        if leg not in course:
            number = len(set(course.values())) // 2
            last = _straight_on(ways, _back(leg))[-1]
            for onward in _straight_on(ways, _back(last)):
                course[onward], course[_back(onward)] = (number, 1), (number, -1)
    found = []
    for (here, to), way in ways.items():
        path, direction = course[here, to]
        found.append(
            {
                "name": f"{here} to {to}",
                "place": f"{here}",
                "path": f"path {path}",
                "direction": direction,
                "pose": _pose(graph, here, way),
            }
        )
        if _opposite(ways, (here, to)) is None:
            found.append(
                {
                    "name": f"{here} from {to}",
                    "place": f"{here}",
                    "path": f"path {path}",
                    "direction": -direction,
                    "pose": _pose(graph, here, -way),
                }
            )
    return found


def _back(leg: Leg) -> Leg:
    return leg[1], leg[0]


def _straight_on(ways: dict[Leg, complex], leg: Leg) -> list[Leg]:
    """A leg, and the legs that lead straight on from it; a circle is followed once."""
    legs = [leg]
    while (onward := _opposite(ways, _back(legs[-1]))) not in (None, leg):
        assert onward is not None
        legs.append(onward)
    return legs


def _opposite(ways: dict[Leg, complex], leg: Leg) -> Leg | None:
    """The leg that leaves the same place in the opposite direction; None if there is none."""
    for other, way in ways.items():
        if (
            other[0] == leg[0]
            and other != leg
            and abs(math.degrees(cmath.phase(-way / ways[leg]))) <= STRAIGHT
        ):
            return other
    return None


def round_trip(graph: nx.Graph, start: Leg) -> list[str]:
    """Find actions that lead along all streets in both directions, and back to the start.

    The robot always goes to the nearest street that it has not travelled in that direction.
    """
    moves = _moves(
        {(a, b): _way(graph, a, b) for edge in graph.edges for a, b in (edge, edge[::-1])}
    )
    here = first = (*start, True)
    left = {leg for leg in moves if leg[2]}
    route: list[str] = []
    while left or here != first:
        ways = nx.single_source_shortest_path(moves, here)
        goal = min(left, key=lambda leg: (len(ways[leg]), str(leg))) if left else first
        for a, b in zip(ways[goal], ways[goal][1:], strict=False):
            route.append(moves.edges[a, b]["action"])
            left -= {a} if moves.edges[a, b]["action"] == "travel" else set()
        here = goal
        if left:
            route.append("travel")
            left.discard(here)
            here = next(
                b for _, b, action in moves.edges(here, data="action") if action == "travel"
            )
    return route


def _moves(ways: dict[Leg, complex]) -> nx.DiGraph:
    """The graph of dstates, with actions as edges.

    A dstate is a place, the place at the other end of a street, and whether that street is ahead
    (or behind).
    """
    moves: nx.DiGraph = nx.DiGraph()
    facing = {(*leg, True): way for leg, way in ways.items()}
    facing |= {(*leg, False): -way for leg, way in ways.items() if _opposite(ways, leg) is None}
    for state, way in facing.items():
        here, there, ahead = state

        def clockwise(other: tuple[object, object, bool], way: complex = way) -> float:
            return -math.degrees(cmath.phase(facing[other] / way)) % 360

        others = [other for other in facing if other[0] == here and other != state]
        streets = [other for other in others if other[2]]
        for side, order in (("right", clockwise), ("left", lambda other: -clockwise(other) % 360)):
            if beside := [other for other in streets if STRAIGHT < order(other) < 180 - STRAIGHT]:
                moves.add_edge(state, min(beside, key=order), action=side)
        if others:
            moves.add_edge(
                state, min(others, key=lambda other: abs(clockwise(other) - 180)), action="around"
            )
        if ahead:
            on = _opposite(ways, (there, here))
            moves.add_edge(
                state, (there, here, False) if on is None else (*on, True), action="travel"
            )
    return moves


def turning(*turns: float) -> nx.Graph:
    """Make a chain of streets. Each turns left from the one before, by the given degrees."""
    at, heading, found = 0j, 10.0, {0: 0j}
    for k, turn in enumerate((0.0, *turns), 1):
        heading += turn
        at += cmath.rect(5.5 + 0.5 * k, math.radians(heading))
        found[k] = at
    return planar.world(found, [(k, k + 1) for k in range(len(turns) + 1)])  # type: ignore[arg-type]


def hub(*directions: float) -> nx.Graph:
    """Make a hub with dead ends of different lengths in the given directions, in degrees."""
    graph = planar.junction(*directions)
    for k in range(len(directions)):
        graph.nodes[k]["at"] *= 6 + 0.7 * k
    return graph


def ring(graph: nx.Graph, size: float) -> nx.Graph:
    """Enlarge a street map by a factor, in place."""
    for place in graph:
        graph.nodes[place]["at"] *= size
    return graph


MAPS: dict[str, tuple[nx.Graph, Leg]] = {
    "bends of 150 degrees": (turning(30, 30), (0, 1)),
    "bends of 135 and 90 degrees": (turning(45, -90), (0, 1)),
    "bends of 120 degrees": (turning(60, -60), (0, 1)),
    "a corner of 60 degrees": (turning(120), (0, 1)),
    "a corner of 45 degrees": (turning(135), (0, 1)),
    "a ring of six bends of 120 degrees": (ring(planar.hexagon(), 6), (0, 1)),
    "three streets at 90 degrees": (hub(0, 90, 180), ("hub", 0)),
    "three streets, one at 45 degrees": (hub(0, 45, 180), ("hub", 0)),
    "three streets at 120 degrees": (hub(90, 210, 330), ("hub", 0)),
    "four streets at 90 degrees": (hub(0, 90, 180, 270), ("hub", 0)),
    "five streets at odd angles": (hub(0, 50, 135, 180, 270), ("hub", 0)),
    "seven streets": (hub(*(360 / 7 * k for k in range(7))), ("hub", 0)),
}


def _worlds(reach: float) -> Iterator[World]:
    yield from (World.named(name) for name in ("triangle", "three-ways", "five-ways", "six-ways"))
    with tempfile.TemporaryDirectory() as folder:
        for name, (graph, start) in MAPS.items():
            path = Path(folder) / "world.json"
            path.write_text(json.dumps({**drawn(graph, reach, start, name=name), "angles": "any"}))
            yield World.load(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    add_number(parser, "--seeds", "N", 20, "drives through each world")
    add_number(parser, "--tours", "N", 2, "tours of each drive")
    add_number(parser, "--reach", "M", 0.8, "half the width of the streets that are drawn")
    options = parser.parse_args()
    print(
        "| world | steps | driven | dstates and places right | and paths | the only "
        "minimal map | seconds: simulate, solve |\n|---|---|---|---|---|---|---|"
    )
    for world in _worlds(options.reach):
        driven = places = paths = alone = 0
        simulating = solving = 0.0
        for seed in range(1000, 1000 + options.seeds):
            began = process_time()
            try:
                run = simulate(world, options.tours, seed)
            except SimulatorError:
                continue
            simulated = process_time()
            views = (
                ViewClusterer(random_state=0)
                .fit(ReciprocalTransformer().fit_transform(images_of(run)))
                .labels_
            )
            trace = run.with_views(views.tolist())
            clustered = process_time()
            solution = solve(trace, max_maps=None, time_limit=60)
            found = evaluate(solution.maps, trace) if solution.maps else None
            driven += 1
            places += bool(found and all(m.dstates_right and m.places_right for m in found.maps))
            paths += bool(found and found.rank)
            alone += bool(found and found.rank and solution.complete and len(solution.maps) == 1)
            simulating, solving = (
                simulating + simulated - began,
                solving + process_time() - clustered,
            )
        seconds = f"{simulating / max(driven, 1):.1f}, {solving / max(driven, 1):.1f}"
        steps = options.tours * len(world.route)
        print(
            f"| {world.name} | {steps} | {driven} of {options.seeds} | {places} | "
            f"{paths} | {alone} | {seconds} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
