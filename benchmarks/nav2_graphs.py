"""From a drive to a graph of Nav2's route server, beside a graph that a person drew.

    python benchmarks/nav2_graphs.py GRAPH.geojson [...] --runs FOLDER [--half 0.75] [--seed 0]

The graphs of Nav2 are in github.com/ros-navigation/navigation2, `nav2_bringup/graphs`. For each
graph the script draws walls `--half` metres beside its edges, simulates a drive along each edge in
both directions, maps the log, and exports the map with `export --to nav2 --frame-of`: the frame
is that of the true poses at each EVERY-th step, as a localiser would report them. It reads both
graphs by the rules of Nav2's loader. A junction is where three or more ways meet. It is found if
the exported graph has a junction within NEAR metres. The script prints a table in Markdown.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
from scipy.ndimage import distance_transform_edt
from skimage.draw import line
from skimage.measure import approximate_polygon, find_contours

from ssh_abduction import Trace
from ssh_abduction.cli import main as shell

CELL = 0.05  # metres of a cell on which the walls are drawn
NEAR = 1.0  # metres between two junctions that are one
BENT = 0.04  # metres by which a drawn wall may leave the outline of its cells
EVERY = 10  # steps from one pose of the other frame to the next
SAME = 0.05  # metres; nodes of a drawn graph that are this near are one
HEAD = (
    "| graph | metres driven | junctions found | false | residual (m) | "
    "ways between junctions found | false |",
    "|---|---|---|---|---|---|---|",
)


def read_graph(text: str) -> nx.Graph:
    """Read a graph by the rules of Nav2's loader, without directions; nodes at a place are one.

    Raises ValueError where the loader would fail.
    """
    features = json.loads(text)["features"]
    points = {f["properties"]["id"]: f for f in features if f["geometry"]["type"] == "Point"}
    graph, nodes = nx.Graph(), {}
    for name, feature in points.items():
        at = complex(*map(float, feature["geometry"]["coordinates"]))
        nodes[name] = next((n for n in graph if abs(graph.nodes[n]["at"] - at) < SAME), name)
        graph.add_node(nodes[name], at=at)
    for feature in features:
        if feature["geometry"]["type"] in ("LineString", "MultiLineString"):
            ends = [feature["properties"][end] for end in ("startid", "endid")]
            if not {*ends} <= {*nodes}:
                raise ValueError(f"edge {feature['properties']['id']}: no node {ends}")
            graph.add_edge(*(nodes[end] for end in ends))
    graph.remove_edges_from(list(nx.selfloop_edges(graph)))
    graph.remove_nodes_from(list(nx.isolates(graph)))
    return graph


def world_of(graph: nx.Graph, half: float) -> dict[str, Any]:
    """Draw walls beside the edges of a graph, and a route along each edge in both directions."""
    at = np.array([[graph.nodes[n]["at"].real, graph.nodes[n]["at"].imag] for n in graph])
    low = at.min(0) - half - 1
    shape = np.ceil((at.max(0) + half + 1 - low) / CELL).astype(int)
    away = np.ones(shape, dtype=bool)
    cells = dict(zip(graph, np.rint((at - low) / CELL).astype(int).tolist(), strict=True))
    for a, b in graph.edges:
        away[line(*cells[a], *cells[b])] = False
    outlines = find_contours(distance_transform_edt(away) * CELL, half)
    polygons = [approximate_polygon(outline, BENT / CELL)[:-1] for outline in outlines]
    route = [a for a, _ in nx.eulerian_circuit(graph.to_directed(), source=next(iter(graph)))]
    there = at[list(graph).index(route[1])] - at[0]
    return {
        "format": "ssh-world",
        "version": 1,
        "name": "nav2",
        "polygons": [(polygon * CELL + low).round(3).tolist() for polygon in polygons],
        "start": [*at[0].tolist(), math.degrees(math.atan2(there[1], there[0]))],
        "reach": half,
        "angles": "any",
        "route": [f"n{node}" for node in (*route, route[0])],
        "places": {f"n{n}": xy for n, xy in zip(graph, at.tolist(), strict=True)},
    }


def junctions(graph: nx.Graph) -> dict[Any, complex]:
    """The nodes at which three or more ways meet, with their positions."""
    return {n: graph.nodes[n]["at"] for n in graph if graph.degree(n) > 2}


def ways(graph: nx.Graph) -> set[frozenset[Any]]:
    """The pairs of junctions with a way in between on which no other junction is."""
    inner = nx.Graph(graph)
    ends = junctions(graph)
    found = {frozenset(edge) for edge in graph.edges if {*edge} <= {*ends}}
    inner.remove_nodes_from(ends)
    for part in nx.connected_components(inner):
        found.add(frozenset({n for p in part for n in graph[p]} & {*ends}))
    return {way for way in found if len(way) == 2}


def compared(drawn: nx.Graph, made: nx.Graph) -> list[str]:
    """Compare a graph with the drawn one: cells of the table."""
    truth, found = junctions(drawn), junctions(made)
    pairs = sorted((abs(p - q), t, f) for t, p in truth.items() for f, q in found.items())
    match: dict[Any, Any] = {}
    for off, t, f in pairs:
        if off <= NEAR and t not in match.values() and f not in match:
            match[f] = t
    offs = [abs(found[f] - truth[t]) for f, t in match.items()]
    true_ways, named = ways(drawn), set()
    for way in ways(made):
        named.add(frozenset(match.get(end, ("false", end)) for end in way))
    return [
        f"{len(match)} of {len(truth)}",
        str(len(found) - len(match)),
        f"{np.median(offs):.2f}" if offs else "",
        f"{len(true_ways & named)} of {len(true_ways)}",
        str(len(named - true_ways)),
    ]


def run(file: Path, runs: Path, half: float, seed: int) -> list[str]:
    """Simulate, map, export and compare one graph."""
    folder = runs / f"{file.stem}-{half:g}-{seed}"
    folder.mkdir(parents=True, exist_ok=True)
    drawn = read_graph(file.read_text(encoding="utf-8"))
    world, log, made = (folder / name for name in ("world.json", "drive.log", "made.geojson"))
    if not (folder / "map").exists():
        world.write_text(json.dumps(world_of(drawn, half)), encoding="utf-8")
        _do("simulate", world, "--format", "carmen", "--seed", seed, "-o", log)
        _do("map", log, "-o", folder / "map", "-q")
    truth = json.loads((folder / "drive.truth.json").read_text(encoding="utf-8"))
    steps = enumerate(Trace.load(folder / "map" / "trace.jsonl").steps)
    known = [(t, *truth["poses"][step.extra["scan"]][:2]) for t, step in steps if t % EVERY == 0]
    poses = folder / "poses.csv"
    rows = ["step,x,y", *(",".join(map(str, row)) for row in known)]
    poses.write_text("\n".join(rows), encoding="utf-8")
    _do("export", folder / "map", "--to", "nav2", "--frame-of", poses, "-o", made)
    graph = read_graph(made.read_text(encoding="utf-8"))
    return [file.stem, f"{truth['metres']:.0f}", *compared(drawn, graph)]


def _do(*words: object) -> None:
    if code := shell([str(word) for word in words]):
        raise SystemExit(code)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("graphs", nargs="+", type=Path)
    parser.add_argument("--runs", type=Path, required=True)
    parser.add_argument("--half", type=float, default=0.75)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print("\n".join(HEAD))
    for file in options.graphs:
        print(f"| {' | '.join(run(file, options.runs, options.half, options.seed))} |", flush=True)


if __name__ == "__main__":
    main()
