"""Choose positions for drawing a map, by the poses of its dstates or, without poses, by its turns.

A dstate (distinctive state) is a place and a heading. A street is a line between two neighbours on
a path.

A map without poses has no distances, but it says to which side turns go. It is drawn with straight
paths (`straight`). If all turns fit right angles, the drawing is at right angles.
"""

from __future__ import annotations

import cmath
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import networkx as nx
import numpy as np
from scipy.spatial.distance import pdist

from ssh_abduction.data.maps import MapPath, Pose, SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.output.straight import GAP, Point, StraightDrawing, Turns, degrees_of

FARTHEST = 1e7  # metres: a robot's positions are nearer than this
SAME = 1e-6  # square metres: the ends of lifts are at one position
FLOOR_GAP = 0.25  # distance between two floors, as a share of the extent of the largest one


@dataclass(frozen=True, slots=True)
class Layout:
    """The positions at which a map is drawn, with x to the right and y up."""

    places: Mapping[int, Point]  # the position (x, y) of each place, by id
    # The position and heading (x, y, heading) of each dstate, by id. The heading is in radians
    # counterclockwise from x; None if it is unknown.
    dstates: tuple[tuple[float, float, float | None], ...] = field(repr=False)
    # Whether positions are metres. Otherwise the shortest street has about length 1.
    metric: bool = False
    # The covariance (xx, xy, yy) of the position of each dstate in m², if positions are metres.
    spreads: tuple[tuple[float, float, float], ...] = field(default=(), repr=False)


def layout(ssh_map: SSHMap, turns: Trace | Turns | None = None) -> Layout:
    """Choose positions for drawing a map: its poses if it can be drawn at them, else computed ones.

    `turns` says how actions turn, as in `to_svg`. Raises MapError for a value that is no turn.
    """
    degrees = degrees_of(turns)
    poses = drawable_poses(ssh_map)
    if poses is None:
        found = _straight(ssh_map, degrees) if ssh_map.places else _spread(ssh_map)
        return _floor_by_floor(ssh_map, found)
    at = [(pose.x, pose.y, pose.heading) for pose in poses]
    first = {s.place: s.id for s in reversed(ssh_map.dstates)}  # the first dstate of each place
    spreads = tuple(pose.spread for pose in poses)
    return Layout({p: at[first[p]][:2] for p in ssh_map.places}, tuple(at), True, spreads)


def drawable_poses(ssh_map: SSHMap) -> tuple[Pose, ...] | None:
    """Return the poses of the dstates if the map can be drawn at them; None otherwise.

    Each floor, and each piece of a joint map, has poses relative to its own first dstate. They are
    moved, so that each is drawn below the one before. Floors are first turned and moved, so that
    the ends of lifts are one below the other. A map cannot be drawn at its poses if other
    displacements between its parts are missing.
    """
    poses = ssh_map.fit.poses if ssh_map.fit else ()
    numbers = (number for pose in poses for number in (pose.x, pose.y, *pose.spread))
    if not poses or any(abs(number) > FARTHEST for number in numbers):
        return None
    if set(ssh_map.places) - {s.place for s in ssh_map.dstates}:
        return None
    parts = _parts(ssh_map, poses)
    for part in parts:
        here = ssh_map.dstates[_first(ssh_map, part)]
        for s in (ssh_map.dstates[s] for s in part if s != here.id and _is_origin(poses[s])):
            if s.place is None or s.place != here.place:
                return None
    poses = _on_each_other(ssh_map, poses)
    moves = _moves_of(parts, [(pose.x, pose.y) for pose in poses], beside=not ssh_map.floors)
    return tuple(
        replace(pose, x=pose.x + moves[s.id][0], y=pose.y + moves[s.id][1])
        for s, pose in zip(ssh_map.dstates, poses, strict=True)
    )


def _first(ssh_map: SSHMap, part: Sequence[int]) -> int:
    """Return the dstate of a part that the robot visited first."""
    return next((s for s in ssh_map.dstate_at if s in part), part[0])


def _is_origin(pose: Pose) -> bool:
    """Whether other poses are relative to this one."""
    return pose.x == pose.y == pose.heading == 0.0 and not any(pose.spread)


def _parts(ssh_map: SSHMap, poses: Sequence[Pose]) -> tuple[tuple[int, ...], ...]:
    """List the dstates of each floor; without floors, of each piece with poses of its own."""
    is_apart = all(_is_origin(poses[_first(ssh_map, piece)]) for piece in ssh_map.pieces)
    pieces = ssh_map.pieces if is_apart else (tuple(range(len(ssh_map.dstates))),)
    return ssh_map.floors or pieces


def fitted_motion(source: Sequence[complex], target: Sequence[complex]) -> tuple[complex, complex]:
    """Find the turn and the shift that move points nearest to other points, by least squares.

    Points are complex numbers. A point p moves to turn * p + shift. One point, or none, is not
    turned.
    """
    middle, goal = (sum(points) / max(1, len(points)) for points in (source, target))
    pairs = zip(source, target, strict=True)
    turn = sum(((y - goal) * (x - middle).conjugate() for x, y in pairs), 0j)
    turn = turn / abs(turn) if abs(turn) > SAME else 1 + 0j
    return turn, goal - turn * middle


def _on_each_other(ssh_map: SSHMap, poses: Sequence[Pose]) -> tuple[Pose, ...]:
    """Turn and move floors, so that both ends of each lift have nearly one position.

    A floor with one lift is not turned. Positions are complex numbers here.
    """
    at = [complex(pose.x, pose.y) for pose in poses]
    found, floor = [*poses], [s.floor for s in ssh_map.dstates]
    for i, members in enumerate(ssh_map.floors):
        lifts = {
            at[s]: complex(found[x].x, found[x].y)
            for a, _, b in ssh_map.links
            for s, x in ((a, b), (b, a))
            if floor[s] == i and (floor[x] or 0) < i
        }
        turn, shift = fitted_motion([*lifts], [*lifts.values()])
        for s in members:
            found[s] = _turned(poses[s], turn, turn * at[s] + shift)
    return tuple(found)


def _turned(pose: Pose, turn: complex, at: complex) -> Pose:
    """Turn a pose by the direction of a number, and put it at a position."""
    xx, xy, yy = pose.spread
    mean, off = (xx + yy) / 2, complex((xx - yy) / 2, xy) * turn * turn
    spread = (mean + off.real, off.imag, mean - off.real)
    return Pose(at.real, at.imag, pose.heading + cmath.phase(turn), spread)


def _moves_of(
    parts: Sequence[Sequence[int]], at: Sequence[Point], least: float = 0.0, *, beside: bool = True
) -> list[Point]:
    """Find how far to move each dstate, so that each floor or piece is below the one before.

    If `beside`, all begin at one x. Otherwise each is a little right of the one before, so that
    lifts do not cover the ways of floors.
    """
    moves = [(0.0, 0.0)] * len(at)
    corners = [[*zip(*(at[s] for s in part), strict=True)] for part in parts]
    boxes = [(min(xs), min(ys), max(xs), max(ys)) for xs, ys in corners]
    extent = max((max(x1 - x0, y1 - y0) for x0, y0, x1, y1 in boxes), default=0.0)
    gap = max(FLOOR_GAP * extent, least)
    below = None  # the least y of the part above, where it is drawn
    for i, (part, (x0, y0, _, y1)) in enumerate(zip(parts, boxes, strict=True)):
        aside = boxes[0][0] - x0 if beside else i * gap
        move = (0.0, 0.0) if below is None else (aside, below - gap - y1)
        below = y0 + move[1]
        for s in part:
            moves[s] = move
    return moves


def _floor_by_floor(ssh_map: SSHMap, found: Layout) -> Layout:
    """Move the floors of a drawing, so that each is below the one before."""
    moves = _moves_of(ssh_map.floors, [(x, y) for x, y, _ in found.dstates], GAP)
    of_place = {s.place: moves[s.id] for s in ssh_map.dstates}
    places = {
        p: (x + of_place[p][0], y + of_place[p][1]) if p in of_place else (x, y)
        for p, (x, y) in found.places.items()
    }
    dstates = tuple(
        (x + dx, y + dy, heading)
        for (x, y, heading), (dx, dy) in zip(found.dstates, moves, strict=True)
    )
    return replace(found, places=places, dstates=dstates)


def travelled(ssh_map: SSHMap, path: MapPath) -> list[tuple[int, int]]:
    """List the pairs of places between which the robot travelled along a path, sorted.

    In each pair, the place with the lower id comes first.
    """
    ends = [(ssh_map.dstates[s], ssh_map.dstates[x]) for s, _, x in ssh_map.links]
    pairs = {(a.place, b.place) for a, b in ends if a.path == b.path == path.id}
    return sorted(
        {(min(p, q), max(p, q)) for p, q in pairs if p is not None and q is not None and p != q}
    )


def untravelled(ssh_map: SSHMap, path: MapPath) -> list[tuple[int, int]]:
    """List the neighbours on a path that are on one floor, but between which nobody travelled.

    In a map without floors, they are in one piece of the map.
    """
    streets = travelled(ssh_map, path)
    parts = ssh_map.floors or ssh_map.pieces
    part = {ssh_map.dstates[s].place: i for i, part in enumerate(parts) for s in part}
    return [
        (p, q)
        for p, q in pairwise(path.order)
        if (min(p, q), max(p, q)) not in streets and part.get(p) == part.get(q)
    ]


def _straight(ssh_map: SSHMap, degrees: Mapping[str, tuple[float, float]]) -> Layout:
    """Lay out a map with straight paths."""
    drawing = StraightDrawing(ssh_map, degrees)
    at, headings = drawing.positions()
    return Layout(
        {p: at[p] for p in ssh_map.places},
        tuple((*at[s.site], headings[s.id]) for s in ssh_map.dstates),
    )


def _spread(ssh_map: SSHMap) -> Layout:
    """Lay out a map without places: linked dstates are near (Kamada & Kawai 1989)."""
    graph: nx.Graph[Any] = nx.Graph()
    graph.add_nodes_from(s.id for s in ssh_map.dstates)
    floor = [s.floor for s in ssh_map.dstates]
    graph.add_edges_from((s, x) for s, _, x in ssh_map.links if s != x and floor[s] == floor[x])
    graph.add_edges_from(pairwise([min(part) for part in nx.connected_components(graph)]))
    found = nx.kamada_kawai_layout(graph) if len(graph) > 1 else dict.fromkeys(graph, (0.0, 0.0))
    at = np.array([found[s.id] for s in ssh_map.dstates])
    nearest = max(float(np.min(pdist(at))), 1e-6) if len(at) > 1 else 1.0
    return Layout({}, tuple((float(x), float(y), None) for x, y in at / nearest))
