"""Where to draw a map: by the poses of its dstates or, without poses, by its turns.

A map without poses says nothing of metres, but it says which way turns go. It is drawn with
straight paths and turns to their side: first each path gets a heading (`headings`), then places are
put along these headings (`streets`). Turns that fit right angles give a drawing at right angles.

A map with few paths may join streets to one path that is not straight. If turns would then go to a
wrong side, or streets would bend, only what was travelled in one go is drawn straight.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import networkx as nx
import numpy as np
from scipy.spatial.distance import pdist

from ssh_abduction.data.maps import DState, MapPath, Pose, SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.output.headings import Course, headings_by, turns_between
from ssh_abduction.output.streets import LOOSE, Point, StreetProgram, Streets
from ssh_abduction.output.turns import Turns, degrees_of

FARTHEST = 1e7  # metres: positions farther away are not those of a robot
GAP = 1.5  # between parts of a map that nothing connects


@dataclass(frozen=True, slots=True)
class Layout:
    """Where the places and dstates of a map are drawn, x to the right and y up.

    Attributes:
        places: (x, y) of each place, by id.
        dstates: (x, y, heading) of each dstate, by id. The heading is in radians counterclockwise
            from x; None if it is unknown.
        metric: Whether positions are metres. Otherwise the shortest street has about length 1.
    """

    places: Mapping[int, Point]
    dstates: tuple[tuple[float, float, float | None], ...] = field(repr=False)
    metric: bool = False

    def to_dict(self) -> dict[str, Any]:
        """The layout as plain data.

        Returns:
            `places` as pairs [id, [x, y]], `dstates` as [x, y, heading or None], and `metric`.
        """
        return {
            "metric": self.metric,
            "places": [
                [place, [round(x, 4), round(y, 4)]] for place, (x, y) in self.places.items()
            ],
            "dstates": [
                [None if number is None else round(number, 4) for number in s] for s in self.dstates
            ],
        }


def layout(ssh_map: SSHMap, turns: Trace | Turns | None = None) -> Layout:
    """Where to draw a map: at its poses, if it has any.

    Args:
        ssh_map: The map.
        turns: How actions turn, as in `to_svg`.

    Raises:
        MapError: If a turn is none.
    """
    degrees = degrees_of(turns)
    poses = located(ssh_map)
    if poses is None:
        return _Drawing(ssh_map, degrees).layout()
    first = {s.place: s.id for s in reversed(ssh_map.dstates)}  # the first dstate of each place
    return Layout(
        {p: (poses[first[p]].x, poses[first[p]].y) for p in ssh_map.places},
        tuple((pose.x, pose.y, pose.heading) for pose in poses),
        True,
    )


def located(ssh_map: SSHMap) -> tuple[Pose, ...] | None:
    """The poses of the dstates; None if the map cannot be drawn by them.

    If displacements are missing between parts of the map, each part has poses relative to its own
    first dstate. Such a map cannot be drawn by its poses.
    """
    poses = ssh_map.fit.poses if ssh_map.fit else ()
    if not poses or any(
        abs(number) > FARTHEST for pose in poses for number in (pose.x, pose.y, *pose.spread)
    ):
        return None
    if set(ssh_map.places) - {s.place for s in ssh_map.dstates}:
        return None
    here = ssh_map.dstates[ssh_map.labels[0]]
    for s in ssh_map.dstates:
        pose = poses[s.id]
        is_origin = pose.x == pose.y == pose.heading == 0.0 and not any(pose.spread)
        if is_origin and s.id != here.id and (s.place is None or s.place != here.place):
            return None
    return poses


def travelled(ssh_map: SSHMap, path: MapPath) -> list[tuple[int, int]]:
    """The pairs of places on a path between which the robot travelled, the lower id first."""
    ends = [(ssh_map.dstates[s], ssh_map.dstates[x]) for s, _, x in ssh_map.links]
    pairs = {(a.place, b.place) for a, b in ends if a.path == b.path == path.id}
    return sorted(
        {(min(p, q), max(p, q)) for p, q in pairs if p is not None and q is not None and p != q}
    )


class _Drawing:
    """The layout of a map without poses.

    A spot is a place or, as a negative number, a dstate without a place.
    """

    def __init__(self, ssh_map: SSHMap, degrees: Mapping[str, tuple[float, float]]) -> None:
        self.map = ssh_map
        self.spot = [s.place if s.place is not None else -1 - s.id for s in ssh_map.dstates]
        self.spots = list(dict.fromkeys([*ssh_map.places, *self.spot]))
        self.turns = list(turns_between(ssh_map, degrees, self.spot))
        ends = [(ssh_map.dstates[s], ssh_map.dstates[x]) for s, _, x in ssh_map.links]
        # A path with the two spots between which the robot travelled along it.
        self.travels = {
            (s.path, *sorted((self.spot[s.id], self.spot[x.id])))
            for s, x in ends
            if s.path is not None and s.path == x.path and s.place != x.place
        }
        # Places of a path are in one segment if the robot travelled between them.
        self.segments: Any = nx.utils.UnionFind(
            (path.id, place) for path in ssh_map.paths for place in path.order
        )
        for path, p, q in self.travels:
            self.segments.union((path, p), (path, q))

    def layout(self) -> Layout:
        """The drawing with the fewest wrong turns and bent streets.

        It draws whole paths straight, or only their segments, each with robust headings or not.
        """
        if not self.map.places:
            return self._spread()
        best: tuple[dict[int, float], StreetProgram] | None = None
        fewest = math.inf
        for whole in (True, False):
            courses = {s.id: self._course(s, whole) for s in self.map.dstates}
            for robust in (True, False):
                headings, wrong = headings_by(self.turns, courses, robust)
                if wrong < fewest:
                    program = StreetProgram(self.spots, self._streets(headings, whole))
                    if wrong + program.bent < fewest:
                        best, fewest = (headings, program), wrong + program.bent
        assert best is not None  # as the first drawing has fewer than infinitely many
        headings, at = best[0], self._packed(best[1].put_apart())
        return Layout(
            {p: at[p] for p in self.map.places},
            tuple((*at[self.spot[s.id]], headings[s.id]) for s in self.map.dstates),
        )

    def _spread(self) -> Layout:
        """Dstates without places, with neighbours near each other (Kamada & Kawai 1989)."""
        graph: nx.Graph[Any] = nx.Graph()
        graph.add_nodes_from(s.id for s in self.map.dstates)
        graph.add_edges_from((s, x) for s, _, x in self.map.links if s != x)
        graph.add_edges_from(pairwise([min(part) for part in nx.connected_components(graph)]))
        found = (
            nx.kamada_kawai_layout(graph) if len(graph) > 1 else dict.fromkeys(graph, (0.0, 0.0))
        )
        at = np.array([found[s.id] for s in self.map.dstates])
        nearest = max(float(np.min(pdist(at))), 1e-6) if len(at) > 1 else 1.0
        return Layout({}, tuple((float(x), float(y), None) for x, y in at / nearest))

    def _course(self, s: DState, whole: bool) -> tuple[Course, float]:
        """The course of a dstate, and the radians by which it faces another way."""
        if s.path is None:
            return (-1 - s.id,), 0.0
        course = (s.path,) if whole else (s.path, *self.segments[s.path, self.spot[s.id]])
        return course, 0.0 if s.direction == 1 else math.pi

    def _streets(self, headings: Mapping[int, float], whole: bool) -> Streets:
        """The streets between neighbours on paths and, if only segments are straight, travels."""
        # The heading of direction +1 of each path at each of its spots.
        facing = {
            (s.path, self.spot[s.id]): headings[s.id] + (0.0 if s.direction == 1 else math.pi)
            for s in reversed(self.map.dstates)
        }
        streets: dict[tuple[int, int], tuple[float, float]] = {}
        for path in self.map.paths:
            pairs = list(pairwise(path.order))
            if not whole:
                index = {place: i for i, place in enumerate(path.order)}
                ends = [
                    (p, q)
                    for known, p, q in self.travels
                    if known == path.id and p in index and q in index
                ]
                pairs = [
                    *sorted((p, q) if index[p] < index[q] else (q, p) for p, q in ends),
                    *pairs,
                ]
            for p, q in pairs:
                is_travelled = whole or (path.id, *sorted((p, q))) in self.travels
                way = facing.get((path.id, p), facing.get((path.id, q), 0.0))
                if is_travelled or (p, q) not in streets:
                    streets[p, q] = way, 1.0 if is_travelled else LOOSE
        # Of two streets to and fro keep the one with the larger share, or else the first.
        kept: dict[tuple[int, int], tuple[float, float]] = {}
        for (p, q), street in sorted(streets.items(), key=lambda street: -street[1][1]):
            if (q, p) not in kept:
                kept[p, q] = street
        return kept

    def _packed(self, at: Mapping[int, Point]) -> dict[int, Point]:
        """The spots, with parts of the map that no street connects side by side."""
        graph: nx.Graph[Any] = nx.Graph()
        graph.add_nodes_from(self.spots)
        graph.add_edges_from(pair for path in self.map.paths for pair in pairwise(path.order))
        packed: dict[int, Point] = {}
        right = 0.0
        for part in nx.connected_components(graph):
            members = [p for p in self.spots if p in part]
            (x0, y0), left = at[members[0]], min(at[p][0] for p in members)
            shift = right - left if packed else -x0
            packed |= {p: (at[p][0] + shift, at[p][1] - y0) for p in members}
            right = max(packed[p][0] for p in members) + GAP
        return packed
