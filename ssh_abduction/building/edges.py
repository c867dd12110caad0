"""Make a plan of a finished map: its junctions, and the edges between them with widths and doors.

Travels are cut where they pass a known place without a stop. Places that the robot reached from
each other within NEAR metres are one junction, for this purpose only. Places that are near only by
the poses may be one place whose join was missed, or lie behind a wall. So they stay apart.

An edge is also cut where its course bends sharply between two places. Such a corner gets a negative
number. An edge that runs beside others, with no wall between, is a lane of theirs, and is left out.

A travel of a log has a course, which is laid into the map. Travels between the same two places are
on one edge if their courses lie close together. So two ways that leave a place in nearly one
direction are two edges, and a robot that cuts a corner is on the same edge as one that does not.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, groupby, pairwise
from typing import Any

import networkx as nx
import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import cdist

from perception.places.passages import STEP, WIDE, resampled, to_the_left
from ssh_abduction.data.groups import gathered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.output.roads import place_of_steps

Array = NDArray[np.float64]

# Two courses are one edge if their Hausdorff distance is at most APART metres.
APART = 1.5
# Standard deviations of the heading at a dstate in radians, and of the chord of a course in metres.
# They weigh what both say about the rotation of the course.
HEADING, CHORD = 0.2, 0.3


def grouped(travels: Iterable[tuple[Any, Any, Array]]) -> list[int]:
    """Number the edges of travels, each given by its first and last place and its course.

    The places can be compared. A course is (n, 2) metres, with points STEP apart. Any two travels
    on one edge are close together.
    """
    between: dict[tuple[Any, Any], dict[int, Array]] = defaultdict(dict)
    for k, (first, last, course) in enumerate(travels):
        between[min(first, last), max(first, last)][k] = course
    edges: dict[int, tuple[Any, ...]] = {}
    for ends, alike in between.items():
        far = [apart(one, other) for one, other in combinations(alike.values(), 2)]
        parts = fcluster(linkage(far, "complete"), APART, "distance") if far else [1]
        edges |= {k: (*ends, part) for k, part in zip(alike, parts, strict=True)}
    numbers: dict[tuple[Any, ...], int] = {}
    return [numbers.setdefault(edges[k], len(numbers)) for k in sorted(edges)]


def laid_course(trace: Trace, ssh_map: SSHMap, t: int) -> Array:
    """The course of the travel from step t in the frame of the map: (n, 2) metres.

    It is the origin alone if the map has no poses.
    """
    if ssh_map.fit is None or not ssh_map.fit.poses:
        return np.zeros((1, 2))
    here, there = (ssh_map.fit.poses[ssh_map.dstate_at[k]] for k in (t, t + 1))
    begin, end = complex(here.x, here.y), complex(there.x, there.y)
    told = trace.steps[t].extra.get("course", ())
    way = np.array([0.0, *(complex(x, y) for x, y in told)])
    # This rotation has the least squared errors of the heading and of the chord.
    turn = np.exp(1j * here.heading) / HEADING**2 + (end - begin) * way[-1].conj() / CHORD**2
    way = begin + way * turn / abs(turn)
    if not told:
        way = np.array([begin, end])
    far = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(way)))])
    # The error at the end grows steadily along the course.
    way += (end - way[-1]) * far / max(far[-1], STEP)
    return resampled(np.stack([way.real, way.imag], axis=1), STEP)


def apart(first: Array, second: Array) -> float:
    """Compute the Hausdorff distance of two sequences of points, (n, 2), in metres."""
    far = cdist(first, second)
    return float(max(far.min(axis=0).max(), far.min(axis=1).max()))


NEAR = 1.0  # places of one junction are at most this many metres apart
# A travel passes a place if it comes within PASSED radii of its middle, or within CLOSE metres.
PASSED, CLOSE = 0.7, 0.5
# A course bends sharply by more than CORNER radians, if it goes straight for LEG metres before and
# after. Wobbles of less than WOBBLE metres do not count.
CORNER, LEG, WOBBLE = math.radians(50), 1.5, 0.8
# A lane is at most LANE times as long as the edges beside it, and SPARE metres. There are at most
# MOST of these. At most WALL points of walls lie between.
LANE, SPARE, MOST, WALL = 1.25, 0.5, 3, 3
RADIUS = 0.5  # of a place whose radius is unknown, in metres


@dataclass(frozen=True)
class Gap:
    """A door on an edge, or an opening beside it."""

    at: int  # the point of the course
    width: float  # metres
    side: str  # "through", "left" or "right" of the course
    door: int | None = None  # the number of the door that the edge passes


@dataclass(frozen=True, eq=False)
class PlanEdge:
    """A way between two places, over travels that lie close together."""

    ends: tuple[int, int]
    course: Array  # (n, 2) metres, from the first end to the second, with points STEP apart
    travels: tuple[int, ...]  # the steps at which travels along it begin
    widths: Array  # (n, 2) metres to the walls on the left and right; NaN if it is unknown
    passages: tuple[Gap, ...] = ()

    @property
    def length(self) -> float:
        """The length in metres."""
        return float(np.hypot(*np.diff(self.course, axis=0).T).sum())

    @property
    def doors(self) -> tuple[Gap, ...]:
        """The doors that the edge passes."""
        return tuple(p for p in self.passages if p.side == "through")

    def turned(self) -> PlanEdge:
        """The edge from its second end to its first."""
        last, other = len(self.course) - 1, {"left": "right", "right": "left"}
        back = [replace(p, at=last - p.at, side=other.get(p.side, p.side)) for p in self.passages]
        passages, widths = tuple(sorted(back, key=lambda p: p.at)), self.widths[::-1, ::-1]
        return PlanEdge(self.ends[::-1], self.course[::-1], self.travels, widths, passages)

    def cut(self, begin: int, end: int, ends: tuple[int, int]) -> PlanEdge:
        """The part from one point of the course to another, both included."""
        inside = (p for p in self.passages if begin <= p.at <= end)
        passages, part = tuple(replace(p, at=p.at - begin) for p in inside), slice(begin, end + 1)
        return PlanEdge(ends, self.course[part], self.travels, self.widths[part], passages)


@dataclass(eq=False)
class Spot:
    """A place, junction or corner, with a position in metres."""

    at: Array
    radius: float
    frame: tuple[int, int]  # the piece of the map and the floor, which have frames of their own


@dataclass(eq=False)
class FloorPlan:
    """The edges of a finished map between places.

    Attributes:
        spots: The places by number, with the corners, which have negative numbers.
        edges: The edges.
        name: For each place, the smallest place of its junction.
        measured: Whether the trace has widths.
    """

    spots: dict[int, Spot]
    edges: list[PlanEdge]
    name: dict[int, int]
    measured: bool
    corners: int = field(default=0)

    @classmethod
    def of(cls, ssh_map: SSHMap, trace: Trace) -> FloorPlan:
        """Make the plan of a map with places and poses."""
        places = place_of_steps(ssh_map)
        spots = _spots(ssh_map, trace)
        travels = [_travel(ssh_map, trace, t) for t in _travels_of(trace, places)]
        name = _junctions(ssh_map, travels, spots)
        measured = any(np.isfinite(edge.widths).any() for edge in travels)
        kept = {p: spot for p, spot in spots.items() if name[p] == p}
        plan = cls(kept, [], name, measured)
        plan.edges = list(_grouped(part for edge in travels for part in plan._cut(edge)))
        plan._leave_out_lanes()
        plan._cut_at_corners()
        return plan

    def _cut(self, travel: PlanEdge) -> Iterator[PlanEdge]:
        """Cut a travel where it passes places without a stop."""
        p, q = (self.name[end] for end in travel.ends)
        way, frame = travel.course, self.spots[p].frame
        passed = []
        for other, spot in self.spots.items():
            if other in (p, q) or spot.frame != frame:
                continue
            far = np.hypot(*(way - spot.at).T)
            k = int(far.argmin())
            if far[k] <= max(CLOSE, PASSED * spot.radius) and 2 < k < len(way) - 3:
                passed.append((k, other))
        cuts = [(0, p)]
        for k, other in sorted(passed):
            if k - cuts[-1][0] > 2:
                cuts.append((k, other))
        for (begin, first), (end, last) in pairwise([*cuts, (len(way) - 1, q)]):
            if first != last:
                part = travel.cut(begin, end, (first, last))
                course = part.course.copy()
                course[[0, -1]] = self.spots[first].at, self.spots[last].at
                yield replace(part, course=course)

    def _leave_out_lanes(self) -> None:
        """Leave out each edge beside which others lead to the same place, with no wall between."""
        frame = {p: spot.frame for p, spot in self.spots.items()}
        beside = gathered((frame[edge.ends[0]], walls_beside(edge)) for edge in self.edges)
        walls = {of: np.concatenate(parts) for of, parts in beside.items()}
        for edge in sorted(self.edges, key=lambda e: -e.length):
            graph = nx.MultiGraph()
            graph.add_edges_from(
                (*other.ends, number)
                for number, other in enumerate(self.edges)
                if other is not edge and other.length < LANE * edge.length + SPARE
            )
            if not set(edge.ends) <= set(graph):
                continue
            for way in nx.all_simple_edge_paths(graph, *edge.ends, cutoff=MOST):
                chain = [self.edges[number] for _, _, number in way]
                if sum(e.length for e in chain) > LANE * edge.length + SPARE:
                    continue
                line = _line(chain, edge.ends[0])
                if not parted(walls[frame[edge.ends[0]]], edge.course, line):
                    keep = [other for other in self.edges if other is not edge]
                    self.edges = [
                        replace(e, travels=tuple(sorted({*e.travels, *edge.travels})))
                        if any(e is part for part in chain)
                        else e
                        for e in keep
                    ]
                    break

    def _cut_at_corners(self) -> None:
        """Cut edges where their course bends sharply."""
        todo, done = list(self.edges), []
        while todo:
            edge = todo.pop()
            if (k := next(_corners(edge.course), None)) is None:
                done.append(edge)
                continue
            self.corners += 1
            corner = -self.corners
            frame = self.spots[edge.ends[0]].frame
            self.spots[corner] = Spot(edge.course[k], RADIUS, frame)
            todo.append(edge.cut(0, k, (edge.ends[0], corner)))
            todo.append(edge.cut(k, len(edge.course) - 1, (corner, edge.ends[1])))
        self.edges = sorted(done, key=lambda e: (min(e.travels), e.ends))


def walls_beside(edge: PlanEdge) -> Array:
    """The points of walls beside an edge, (m, 2) metres."""
    left = to_the_left(edge.course)
    ends = [
        (edge.course + sign * edge.widths[:, [k]] * left)[edge.widths[:, k] < WIDE]
        for k, sign in enumerate((1, -1))
    ]
    return np.concatenate(ends)


def parted(walls: Array, one: Array, other: Array) -> bool:
    """Whether walls, (m, 2), lie between two courses, (n, 2), that have the same ends."""
    from skimage.measure import points_in_poly

    ring = np.concatenate([one, other[::-1]])
    return bool(points_in_poly(walls, ring).sum() > WALL)


def _line(chain: Sequence[PlanEdge], start: int) -> Array:
    """The course of a chain of edges from a place on."""
    parts, at = [], start
    for edge in chain:
        part = edge if edge.ends[0] == at else edge.turned()
        parts.append(part.course)
        at = part.ends[1]
    return np.concatenate(parts)


def _travels_of(trace: Trace, places: Sequence[int | None]) -> Iterator[int]:
    """Yield the steps at which a travel begins that leads from one place to another."""
    for t, action in enumerate(trace.actions):
        here, there = places[t : t + 2]
        if action.kind == "travel" and None not in (here, there) and here != there:
            yield t


def _travel(ssh_map: SSHMap, trace: Trace, t: int) -> PlanEdge:
    """Make the edge of one travel, with its own course, widths and doors."""
    here, there = (ssh_map.dstates[ssh_map.dstate_at[k]].place for k in (t, t + 1))
    assert here is not None
    assert there is not None
    course, extra = laid_course(trace, ssh_map, t), trace.steps[t].extra
    told = np.array(extra.get("widths", [[np.nan] * 2] * 2), float).reshape(-1, 2)
    old, new = np.linspace(0, 1, len(told)), np.linspace(0, 1, len(course))
    widths = np.stack([np.interp(new, old, told[:, k]) for k in (0, 1)], axis=1)
    scale = (len(course) - 1) / max(len(told) - 1, 1) / STEP
    passages = tuple(
        Gap(round(min(door["at"] * scale, len(course) - 1)), door["width"], door["side"])
        for door in extra.get("doors", ())
    )
    return PlanEdge((here, there), course, (t,), widths, passages)


def _spots(ssh_map: SSHMap, trace: Trace) -> dict[int, Spot]:
    """Find the position, radius and frame of each place."""
    assert ssh_map.fit is not None
    piece_of, radii = ssh_map.piece_of, defaultdict[int, list[float]](list)
    for t, place in enumerate(place_of_steps(ssh_map)):
        if place is not None:
            radii[place].append(float(trace.steps[t].extra.get("radius", RADIUS)))
    found: dict[int, Spot] = {}
    for dstate, pose in zip(ssh_map.dstates, ssh_map.fit.poses, strict=True):
        if dstate.place is not None and dstate.place not in found:
            radius = float(np.median(radii[dstate.place] or [RADIUS]))
            frame = piece_of[dstate.id], dstate.floor or 0
            found[dstate.place] = Spot(np.array([pose.x, pose.y]), radius, frame)
    return found


def _junctions(
    ssh_map: SSHMap, travels: Sequence[PlanEdge], spots: dict[int, Spot]
) -> dict[int, int]:
    """Find the junctions: for each place, the smallest place of its junction.

    The robot travelled between near places of one junction. No two places of a junction are more
    than NEAR metres apart.
    """
    name = {p: p for p in spots}
    pairs = {(min(edge.ends), max(edge.ends)) for edge in travels if edge.length <= 2 * NEAR}
    far = {(p, q): math.dist(spots[p].at, spots[q].at) for p, q in pairs}
    for p, q in sorted(far, key=lambda pair: (far[pair], pair)):
        both = [r for r in name if name[r] in (name[p], name[q])]
        if all(math.dist(spots[r].at, spots[s].at) <= NEAR for r, s in combinations(both, 2)):
            name |= dict.fromkeys(both, min(both))
    return name


def _grouped(parts: Iterator[PlanEdge]) -> Iterator[PlanEdge]:
    """Make one edge of all parts of travels that lie close together.

    It has the course of the shortest one with widths, and the passages that most of them show.
    """
    pieces = list(parts)
    numbers = grouped([(*edge.ends, edge.course) for edge in pieces])
    order = sorted(zip(numbers, range(len(pieces)), strict=True))
    for _, group in groupby(order, key=lambda pair: pair[0]):
        some = [
            pieces[k] if pieces[k].ends[0] <= pieces[k].ends[1] else pieces[k].turned()
            for _, k in group
        ]
        seen = [edge for edge in some if np.isfinite(edge.widths).all()] or some
        best = min(seen, key=lambda edge: (len(edge.course), edge.travels))
        travels = tuple(sorted({t for edge in some for t in edge.travels}))
        passages = best.passages
        for side in ("through", "left", "right"):
            counts = [sum(p.side == side for p in edge.passages) for edge in seen]
            if sum(map(bool, counts)) * 2 < len(counts):
                passages = tuple(p for p in passages if p.side != side)
            elif not any(p.side == side for p in passages):
                passages += tuple(
                    _taken(next(e for e, n in zip(seen, counts, strict=True) if n), best, side)
                )
        yield replace(best, travels=travels, passages=tuple(sorted(passages, key=lambda p: p.at)))


def _taken(edge: PlanEdge, best: PlanEdge, side: str) -> Iterator[Gap]:
    """Yield the passages of an edge on one side, at the nearest points of another course."""
    for passage in edge.passages:
        if passage.side == side:
            far = np.hypot(*(best.course - edge.course[passage.at]).T)
            yield replace(passage, at=int(far.argmin()))


def _corners(way: Array) -> Iterator[int]:
    """Yield the points of a course at which it bends sharply."""
    from skimage.measure import approximate_polygon

    chain = approximate_polygon(way, WOBBLE)
    legs = np.diff(chain, axis=0)
    bearing, length = np.arctan2(legs[:, 1], legs[:, 0]), np.hypot(*legs.T)
    bend = np.abs((np.diff(bearing) + math.pi) % math.tau - math.pi)
    sharp = (bend > CORNER) & (np.minimum(length[1:], length[:-1]) > LEG + 1e-6)
    for point in chain[1:-1][sharp]:
        yield int(np.hypot(*(way - point).T).argmin())
