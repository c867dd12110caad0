"""A map as a picture: paths through places, and at each place its dstates, on the side that they face.

Where displacements say where the dstates are, they are drawn there (see `metric_picture`). Elsewhere the map says nothing of metres, so the layout is one of many. Where all turns fit right angles, paths are drawn at right angles
and places keep their order along them. Elsewhere places are spread so that neighbours are near each other (Kamada & Kawai 1989).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import combinations, pairwise
from typing import Any, TypeAlias

import networkx as nx

from ssh_abduction.drawing import COLOURS, RADIUS, escaped, page, text
from ssh_abduction.maps import SSHMap
from ssh_abduction.metric_picture import located, metric_svg

Point: TypeAlias = tuple[float, float]

# In units of the page: between neighbouring places, from the middle of a place to the name of a dstate, and how far a dstate is drawn beside the line of its path.
SPACING, DSTATE, LANE = 130.0, 38.0, 9.0
# Characters of a view that are shown below a dstate: longer ones would run into the neighbours. The end is kept, as long names often begin alike.
LONGEST_LABEL = 20
QUARTERS = {"right": 1, "around": 2, "left": 3}
AXES = ((0, -1), (1, 0), (0, 1), (-1, 0))  # up, right, down, left on the page


def svg(ssh_map: SSHMap, turns: Mapping[str, str] | None = None) -> str:
    """The map as SVG text.

    turns  which way actions turn ("right", "left" or "around"), by name; actions of these three names need none
    """
    if (where := located(ssh_map)) is not None:
        return metric_svg(ssh_map, where)
    if not ssh_map.places:
        return page(*_causal(ssh_map))
    return page(*_topological(ssh_map, layout(ssh_map, turns)))


def layout(ssh_map: SSHMap, turns: Mapping[str, str] | None = None) -> dict[int, Point]:
    """Where to draw each place: x to the right and y down. `turns` as for `svg`."""
    turns = {name: name for name in QUARTERS} | dict(turns or {})
    return _right_angled(ssh_map, turns) or _spread(ssh_map)


def _right_angled(ssh_map: SSHMap, turns: Mapping[str, str]) -> dict[int, Point] | None:
    """Places on a grid, if the turns fit right angles and the orders fit columns and rows."""
    faces = _faces(ssh_map, turns)
    if faces is None:
        return None
    coordinates: list[dict[int, int]] = []
    for across in (1, 0):  # first x, where places on an upright path share a column; then y, where places on a level path share a row
        shared = nx.utils.UnionFind(ssh_map.places)
        for path in ssh_map.paths:
            if path.order and faces[path.id] % 2 != across:
                shared.union(*path.order)
        after: nx.DiGraph[Any] = nx.DiGraph()
        after.add_nodes_from(shared[p] for p in ssh_map.places)
        for path in ssh_map.paths:
            if faces[path.id] % 2 == across:
                order = path.order if sum(AXES[faces[path.id]]) > 0 else path.order[::-1]
                after.add_edges_from((shared[p], shared[q]) for p, q in pairwise(order))
        if not nx.is_directed_acyclic_graph(after):
            return None
        level: dict[int, int] = {}
        for node in nx.topological_sort(after):
            level[node] = max((level[previous] + 1 for previous in after.predecessors(node)), default=0)
        coordinates.append({p: level[shared[p]] for p in ssh_map.places})
    xs, ys = coordinates
    at = {p: (xs[p] * SPACING, ys[p] * SPACING) for p in ssh_map.places}
    return at if len(set(at.values())) == len(at) and not _runs_over(ssh_map, at) else None


def _faces(ssh_map: SSHMap, turns: Mapping[str, str]) -> dict[int, int] | None:
    """Which way on the page direction +1 of each path faces (0 is up, then clockwise), or None if the turns contradict each other."""
    graph: nx.DiGraph[Any] = nx.DiGraph()
    graph.add_nodes_from(p.id for p in ssh_map.paths)
    for s, action, x in ssh_map.links:
        source, target = ssh_map.dstates[s], ssh_map.dstates[x]
        if action in turns and source.path is not None and target.path is not None:
            turn = (QUARTERS[turns[action]] + (source.direction != 1) * 2 + (target.direction != 1) * 2) % 4
            for a, b, quarters in ((source.path, target.path, turn), (target.path, source.path, -turn % 4)):
                if graph.get_edge_data(a, b, {"turn": quarters})["turn"] != quarters:
                    return None
                graph.add_edge(a, b, turn=quarters)
    faces: dict[int, int] = {}
    for component in nx.weakly_connected_components(graph):
        first = min(component)
        faces[first] = 1
        for a, b in nx.bfs_edges(graph, first):
            faces[b] = (faces[a] + graph[a][b]["turn"]) % 4
    fits = all((faces[a] + turn - faces[b]) % 4 == 0 for a, b, turn in graph.edges(data="turn"))
    return faces if fits else None


def _runs_over(ssh_map: SSHMap, at: Mapping[int, Point]) -> bool:
    """Whether a path would be drawn through a place that is not on it."""
    for path in ssh_map.paths:
        for (ax, ay), (bx, by) in pairwise(at[p] for p in path.order):
            for place in set(ssh_map.places) - set(path.order):
                x, y = at[place]
                along = min(ax, bx) <= x <= max(ax, bx) and min(ay, by) <= y <= max(ay, by)
                if along and (bx - ax) * (y - ay) == (by - ay) * (x - ax):
                    return True
    return False


def _spread(ssh_map: SSHMap) -> dict[int, Point]:
    """Places so that neighbours on a path are near each other."""
    graph: nx.Graph[Any] = nx.Graph()
    graph.add_nodes_from(ssh_map.places)
    for path in ssh_map.paths:
        graph.add_edges_from(pairwise(path.order))
    return _layout(graph)


def _layout(graph: nx.Graph[Any]) -> dict[int, Point]:
    """The layout of Kamada & Kawai, scaled so that the two nearest nodes are SPACING apart. Parts that are not connected are joined first."""
    if len(graph) < 2:
        return dict.fromkeys(graph, (0.0, 0.0))
    connected = nx.Graph(graph)
    parts = [min(part) for part in nx.connected_components(graph)]
    connected.add_edges_from(pairwise(parts))
    at = nx.kamada_kawai_layout(connected)
    nearest = min(math.dist(at[p], at[q]) for p, q in combinations(at, 2))
    scale = SPACING / max(nearest, 1e-6)
    return {node: (float(x) * scale, float(y) * scale) for node, (x, y) in at.items()}


def _topological(ssh_map: SSHMap, at: Mapping[int, Point]) -> tuple[list[str], list[Point]]:
    lines, marks = [], []
    for path in ssh_map.paths:
        colour = COLOURS[path.id % len(COLOURS)]
        points = [at[p] for p in path.order]
        if len(points) > 1:
            line = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
            lines.append(
                f'<polyline points="{line}" fill="none" stroke="{colour}" stroke-width="9" stroke-linecap="round" opacity="0.55"/>'
            )
            (ax, ay), (bx, by) = points[0], points[1]
            (mx, my), angle = ((ax + bx) / 2, (ay + by) / 2), math.degrees(math.atan2(by - ay, bx - ax))
            marks.append(f'<path d="M-7,-6 L7,0 L-7,6 Z" fill="{colour}" transform="translate({mx:.1f},{my:.1f}) rotate({angle:.1f})"/>')
            nx_, ny = -(by - ay), bx - ax
            far = 26 / math.hypot(nx_, ny)
            marks.append(text(mx + nx_ * far, my + ny * far, f"path {path.id}", colour))
    for place in ssh_map.places:
        x, y = at[place]
        marks.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{RADIUS}" fill="white" stroke="#222" stroke-width="2"/>')
        marks.append(text(x, y, str(place), "#222", size=15, weight="bold"))
        marks += _dstates(ssh_map, place, at)
    return lines + marks, list(at.values())


def _dstates(ssh_map: SSHMap, place: int, at: Mapping[int, Point]) -> list[str]:
    """The dstates at a place, each on the side that it faces. Dstates along no path are drawn where there is most room."""
    x, y = at[place]
    taken: list[float] = []
    marks = []
    facing = [(s, _bearing(ssh_map, s.path, s.direction, place, at)) for s in ssh_map.dstates if s.place == place]
    for s, faced in sorted(facing, key=lambda pair: pair[1] is None):
        bearing = _freest(taken) if faced is None else faced
        taken.append(bearing)
        dx, dy = math.cos(bearing), math.sin(bearing)
        aside = (0.0, 0.0) if faced is None else (-dy * LANE, dx * LANE)  # drawn to the right of the line of the path
        colour = "#555" if s.path is None else COLOURS[s.path % len(COLOURS)]
        title = f"dstate {s.id}: {s.view}"
        px, py = x + dx * (RADIUS + 6) + aside[0], y + dy * (RADIUS + 6) + aside[1]
        marks.append(
            f'<g><title>{escaped(title)}</title><path d="M-5,-5 L5,0 L-5,5 Z" fill="{colour}" '
            f'transform="translate({px:.1f},{py:.1f}) rotate({math.degrees(bearing):.1f})"/></g>'
        )
        marks.append(text(x + dx * DSTATE + aside[0] * 1.5, y + dy * DSTATE + aside[1] * 1.5, f"x{s.id}", "#222", halo=True))
    return marks


def _freest(taken: list[float]) -> float:
    """Of 16 bearings, the one that is farthest from those taken."""
    bearings = [k * math.pi / 8 for k in range(16)]
    return max(bearings, key=lambda b: min((abs(math.remainder(b - t, math.tau)) for t in taken), default=0.0))


def _bearing(ssh_map: SSHMap, path: int | None, direction: int | None, place: int, at: Mapping[int, Point]) -> float | None:
    """Which way on the page a dstate faces: to the next place of its path or, at the end of the path, away from the place before. None if that is not known."""
    if path is None or direction is None:
        return None
    order = next(p.order for p in ssh_map.paths if p.id == path)[:: 1 if direction == 1 else -1]
    if place not in order:
        return None
    i = order.index(place)
    if i + 1 < len(order):
        (ax, ay), (bx, by) = at[place], at[order[i + 1]]
    elif i:
        (ax, ay), (bx, by) = at[order[i - 1]], at[place]
    else:
        return None
    return math.atan2(by - ay, bx - ax)


def _causal(ssh_map: SSHMap) -> tuple[list[str], list[Point]]:
    graph: nx.Graph[Any] = nx.Graph()
    graph.add_nodes_from(s.id for s in ssh_map.dstates)
    graph.add_edges_from((s, x) for s, _, x in ssh_map.links if s != x)
    at = _layout(graph)
    marks = []
    actions: dict[tuple[int, int], list[str]] = {}
    for source, action, target in ssh_map.links:
        if source != target:
            actions.setdefault((source, target), []).append(action)
    for (source, target), names in actions.items():
        (ax, ay), (bx, by) = at[source], at[target]
        far = math.hypot(bx - ax, by - ay)
        ux, uy = (bx - ax) / far, (by - ay) / far
        mx, my = (ax + bx) / 2 - uy * 24, (ay + by) / 2 + ux * 24
        ex, ey = bx - ux * (RADIUS + 4), by - uy * (RADIUS + 4)
        marks.append(f'<path d="M{ax:.1f},{ay:.1f} Q{mx:.1f},{my:.1f} {ex:.1f},{ey:.1f}" fill="none" stroke="#888" stroke-width="1.5"/>')
        angle = math.degrees(math.atan2(ey - my, ex - mx))
        marks.append(f'<path d="M-8,-4 L0,0 L-8,4 Z" fill="#888" transform="translate({ex:.1f},{ey:.1f}) rotate({angle:.1f})"/>')
        marks.append(text(mx - ux * 12, my - uy * 12, ", ".join(names), "#555", halo=True))
    for s in ssh_map.dstates:
        x, y = at[s.id]
        marks.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{RADIUS}" fill="white" stroke="{COLOURS[0]}" stroke-width="2"/>')
        marks.append(text(x, y, f"x{s.id}", "#222", weight="bold"))
        label = str(s.view) if len(str(s.view)) <= LONGEST_LABEL else f"…{str(s.view)[1 - LONGEST_LABEL :]}"
        marks.append(f"<g><title>{escaped(f'dstate {s.id}: {s.view}')}</title>{text(x, y + RADIUS + 12, label, '#222', halo=True)}</g>")
    return marks, list(at.values())
