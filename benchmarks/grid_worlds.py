"""Worlds and drives for grid_localisation.py: streets at right angles, random drives, new boxes."""

from __future__ import annotations

import json
import random
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import networkx as nx
import numpy as np
import planar
from streets import Leg, _back, _moves, _way, drawn

from simulator.errors import SimulatorError, SimulatorWarning
from simulator.tours import simulate
from simulator.world import World
from ssh_abduction import Trace

State = tuple[
    object, object, bool
]  # a place, a street there, and whether the robot faces the street or has it behind
# If the robot can travel and turn, it travels with this probability in a random drive.
TRAVELS = 2 / 3
# A drive is drawn at most this many times, as some fail, for example because of a box in the way.
TRIES = 20


@dataclass(frozen=True)
class Scene:
    """A world as it is mapped, and the actions that lead from one dstate to another.

    Attributes:
        world: The world.
        moves: Dict from the name of each dstate to its actions, each with the dstate that it leads
            to.
        explore: An exploration: the dstate where the robot starts and ends, and its route.
    """

    world: World
    moves: dict[str, dict[str, str]]
    explore: tuple[str, tuple[str, ...]]

    def at(self, dstate: str, route: tuple[str, ...]) -> World:
        """Copy the world, with a robot that starts at a dstate and drives a route."""
        pose = next(s.pose for s in self.world.dstates if s.name == dstate)
        return replace(self.world, start=pose, route=route)

    def explored(self, tours: int, seed: int) -> Trace:
        return simulate(self.at(*self.explore), tours, seed)

    def driven(
        self,
        steps: int,
        seed: int,
        change: Callable[[World, np.random.Generator], World] | None = None,
    ) -> Trace:
        """Simulate a random drive from a random dstate.

        Args:
            steps: Number of actions.
            seed: Seed of the drive.
            change: Changes the world before the drive; None for no change.

        Raises:
            SimulatorError: The robot could not do any of TRIES drives that were drawn.
        """
        for attempt in range(TRIES):
            chance, rng = (
                random.Random(1000 * seed + attempt),
                np.random.default_rng([seed, attempt]),
            )
            here = first = chance.choice(sorted(self.moves))
            route: list[str] = []
            for _ in range(steps):
                ways = self.moves[here]
                turns = sorted(set(ways) - {"travel"})
                travels = "travel" in ways and (not turns or chance.random() < TRAVELS)
                route.append("travel" if travels else chance.choice(turns))
                here = ways[route[-1]]
            world = self.at(first, tuple(route))
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter(
                        "ignore", SimulatorWarning
                    )  # a random drive may end anywhere
                    return simulate(
                        change(world, rng) if change else world, 1, int(rng.integers(2**31))
                    )
            except SimulatorError as error:
                failure = error
        raise failure


def of_streets(graph: nx.Graph, start: Leg, reach: float, like: World | None = None) -> Scene:
    """Make the scene of a street map whose streets meet at right angles.

    Args:
        graph: The street map, as in planar.py.
        start: The place where the robot starts, and the place that it faces.
        reach: Half the width of a street in metres.
        like: A world with the same places, whose walls, clutter and names are used; None to draw
            walls along the streets.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "world.json"
        path.write_text(json.dumps({**drawn(graph, reach, start, route=[]), "angles": "right"}))
        world = World.load(path)
    ways = {leg: _way(graph, *leg) for edge in graph.edges for leg in (edge, _back(edge))}
    moves = _moves(ways)
    names: dict[State, str] = {
        state: f"{state[0]} {'to' if state[2] else 'from'} {state[1]}" for state in moves
    }
    if like is not None:
        poses = {s.name: s.pose for s in world.dstates}
        names = {state: like.nearest(poses[name]).name for state, name in names.items()}  # type: ignore[union-attr]
        world = like
    led = {
        names[a]: {action: names[b] for _, b, action in moves.edges(a, data="action")}
        for a in moves
    }
    first = names[(*start, True)]
    return Scene(world, led, (first, tuple(_all_moves(led, first))))


def _all_moves(moves: dict[str, dict[str, str]], start: str) -> list[str]:
    """A route that tries each action at each dstate, and leads back to the start.

    The robot always goes to the nearest action that it has not tried.
    """
    graph = nx.DiGraph(
        [(a, b, {"action": action}) for a, ways in moves.items() for action, b in ways.items()]
    )
    left = {(a, action) for a, ways in moves.items() for action in ways}
    here, route = start, []
    while left or here != start:
        ways = nx.single_source_shortest_path(graph, here)
        goal = min((a for a, _ in left), key=lambda a: (len(ways[a]), a)) if left else start
        for a, b in zip(ways[goal], ways[goal][1:], strict=False):
            route.append(graph.edges[a, b]["action"])
            left.discard((a, route[-1]))
        here = goal
        if tried := sorted(action for a, action in left if a == here):
            left.discard((here, tried[0]))
            route.append(tried[0])
            here = moves[here][tried[0]]
    return route


def rectangle(depth: float) -> Scene:
    """Make the notched rectangle with a notch of some depth in metres.

    The robot can only drive round it in one direction.
    """
    world = World.named("notched-rectangle")
    walls = world.segments.copy()
    walls[:, 1::2] = np.where(walls[:, 1::2] < 0, -depth, walls[:, 1::2])
    names = [s.name for s in world.dstates]
    moves = {
        name: {action: names[(i + 1) % 8]}
        for i, (name, action) in enumerate(zip(names, world.route, strict=True))
    }
    return Scene(replace(world, segments=walls), moves, (names[0], world.route))


def taylor_hall() -> Scene:
    at: dict[object, complex] = {
        "D1": -15j,
        "P1": 0j,
        "P2": 13 + 0j,
        "D2": 13 - 10j,
        "P3": 28 + 0j,
        "D3": 28 - 13j,
        "E": 40 + 0j,
    }
    streets: list[tuple[object, object]] = [
        ("D1", "P1"),
        ("P1", "P2"),
        ("P2", "D2"),
        ("P2", "P3"),
        ("P3", "D3"),
        ("P3", "E"),
    ]
    return of_streets(planar.world(at, streets), ("D1", "P1"), 1.0, World.named("taylor-hall"))


def comb(halls: int) -> Scene:
    """Make a main hallway with a number of similar side hallways, 6 m apart."""
    at: dict[object, complex] = {f"P{i}": 6.0 * i + 0j for i in range(halls)}
    at |= {f"D{i}": 6.0 * i - 6j for i in range(halls)}
    streets: list[tuple[object, object]] = [(f"P{i}", f"P{i + 1}") for i in range(halls - 1)]
    return of_streets(
        planar.world(at, streets + [(f"P{i}", f"D{i}") for i in range(halls)]), ("P0", "P1"), 0.8
    )


def ring(marked: bool) -> Scene:
    """Make a square of hallways, each with two side hallways to the outside.

    All sides of the square are alike. If `marked`, one side hallway is missing.
    """
    corners = [0j, 18 + 0j, 18 + 18j, 18j]
    at: dict[object, complex] = {f"C{k}": z for k, z in enumerate(corners)}
    streets: list[tuple[object, object]] = []
    for k, z in enumerate(corners):
        way = (corners[(k + 1) % 4] - z) / 18
        names = [
            f"C{k}",
            *(f"P{k}{i}" for i in (1, 2) if not (marked and (k, i) == (0, 2))),
            f"C{(k + 1) % 4}",
        ]
        for i in (1, 2):
            if f"P{k}{i}" in names:
                at |= {f"P{k}{i}": z + 6 * i * way, f"D{k}{i}": z + 6 * i * way - 5j * way}
                streets.append((f"P{k}{i}", f"D{k}{i}"))
        streets += pairwise(names)
    return of_streets(planar.world(at, streets), ("C0", "P01"), 0.8)


def maze(size: int, seed: int, cell: float = 5.0) -> Scene:
    """Make a maze of `size` by `size` cells, each `cell` metres wide.

    The maze has the streets of a random spanning tree of the grid, and each other street with a
    probability of a tenth. A cell through which a street goes straight is not a place.
    """
    chance = random.Random(seed)
    grid = nx.grid_2d_graph(size, size)
    graph = nx.Graph(
        nx.minimum_spanning_tree(
            nx.Graph([(a, b, {"weight": chance.random()}) for a, b in sorted(grid.edges)])
        ).edges
    )
    graph.add_edges_from(
        edge for edge in sorted(grid.edges) if not graph.has_edge(*edge) and chance.random() < 0.1
    )
    for place in sorted(graph):
        beside = sorted(graph[place])
        if len(beside) == 2 and (beside[0][0] == beside[1][0] or beside[0][1] == beside[1][1]):
            graph.remove_node(place)
            graph.add_edge(*beside)
    nx.set_node_attributes(graph, {(x, y): complex(cell * x, cell * y) for x, y in graph}, "at")
    nx.relabel_nodes(graph, {(x, y): f"{x}.{y}" for x, y in graph}, copy=False)
    first = min(node for node in graph if graph.degree(node) > 0)
    return of_streets(graph, (first, min(graph[first])), 0.8)


def boxes(count: int) -> Callable[[World, np.random.Generator], World]:
    """Return a function that puts boxes along the walls of a world.

    Boxes are 0.3 to 0.8 m long, and reach 0.3 m into the room.
    """

    def changed(world: World, rng: np.random.Generator) -> World:
        walls = world.segments
        lengths = np.hypot(*(walls[:, 2:] - walls[:, :2]).T)
        found = [walls]
        for wall in rng.choice(len(walls), count, p=lengths / lengths.sum()):
            start, way = walls[wall, :2], (walls[wall, 2:] - walls[wall, :2]) / lengths[wall]
            half = rng.uniform(0.15, 0.4) * way
            across = 0.3 * np.array([-way[1], way[0]])
            middle = start + rng.uniform(0, lengths[wall]) * way
            corners = np.array(
                [
                    middle - half - across,
                    middle + half - across,
                    middle + half + across,
                    middle - half + across,
                ]
            )
            found.append(np.hstack([corners, np.roll(corners, -1, axis=0)]))
        return replace(world, segments=np.vstack(found))

    return changed
