"""Choose positions for drawing a map, by the poses of its dstates or, without poses, by its turns.

A map without poses has no distances, but it says to which side turns go. It is drawn with straight
paths. If all turns fit right angles, the drawing is at right angles.

A dstate (distinctive state) is a place and a heading. A spot is a place, or a dstate whose place is
unknown. A course is a path, or a part of one, that is drawn straight. A street is a line between
two neighbours on a path.

1. Each course gets the heading that agrees best with all turns. This is angular synchronisation
   (Singer 2011, "Angular synchronization by eigenvectors and semidefinite programming").
2. A linear program finds positions of spots. A street should be at least one unit long, and
   otherwise short. A street that deviates from its heading costs much. If two streets overlap or
   cross, the program is solved again with one street on a side of the other. This drawing is taken
   if it costs less than the crossing.

A map with the fewest paths may contain a path that is not straight in the world. If turns would
therefore go to a wrong side, or streets would bend, only the segments of each path are drawn
straight. The robot travelled between the places of a segment.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise, product
from typing import Any, NamedTuple, TypeAlias

import networkx as nx
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog
from scipy.sparse import coo_array, csr_array, eye_array, hstack, vstack
from scipy.spatial.distance import pdist

from ssh_abduction.data.checks import an_object
from ssh_abduction.data.errors import MapError, brief, is_finite
from ssh_abduction.data.groups import gathered
from ssh_abduction.data.maps import DState, MapPath, Pose, SSHMap
from ssh_abduction.data.step import TURN_DEGREES
from ssh_abduction.data.trace import Trace

FARTHEST = 1e7  # metres: a robot's positions are nearer than this
SAME = 1e-6  # square metres: the ends of lifts are at one position
FLOOR_GAP = 0.25  # distance between two floors, as a share of the extent of the largest one
Turns: TypeAlias = Mapping[str, "str | float"]
Point: TypeAlias = tuple[float, float]
# The key of a course: a path, a part of a path, or a dstate that is along no path.
Course: TypeAlias = tuple[int, ...]
# For each street from one spot to another: its heading in radians, and a factor for its costs.
Streets: TypeAlias = Mapping[tuple[int, int], tuple[float, float]]
# Two spots, and the direction in which the second one has to lie ahead of the first one.
_Condition: TypeAlias = tuple[int, int, float, float]
_Array: TypeAlias = NDArray[np.float64]

# Radians. If a drawing is off by more than this, a turn may go to the wrong side. The first is for
# turns by known degrees, the second for turns to a known side.
WRONG, WRONG_GUESS = math.radians(46), math.radians(61)
SURE, GUESSED = 1.0, 0.2  # the weights of a turn by known degrees, and of a turn to a known side
SWEEPS = 900  # the number of averaging sweeps over all headings
# Costs. A unit of a street's length costs 1. Each unit by which a street deviates from its heading
# costs ASTRAY, and each unit by which it is too short costs SHORT. Two streets that overlap or
# cross cost CROSSING.
ASTRAY, SHORT, CROSSING = 300.0, 600.0, 60.0
LOOSE = 0.001  # the factor for the costs of a street that the robot never travelled
CROOKED = 0.1  # a street that deviates from its heading by more units than this looks bent
NEAR, APART = 0.5, 1.0  # streets nearer than NEAR are moved to a distance of APART
PARALLEL = 0.1  # the largest sine of the angle between streets that count as parallel
# The program is solved at most WORK / streets times, or FEWEST times if that is more. The limit is
# a count and not a time, so that a map always has the same drawing.
WORK, FEWEST = 6000, 12
BEAM = 3
GAP = 1.5  # distance in the drawing between parts of a map that nothing connects


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
    if poses is None and not ssh_map.places:
        return _floor_by_floor(ssh_map, _spread(ssh_map))
    if poses is None:
        spots, headings = StraightDrawing(ssh_map, degrees).positions()
        dstates = tuple((*spots[s.site], headings[s.id]) for s in ssh_map.dstates)
        return _floor_by_floor(ssh_map, Layout({p: spots[p] for p in ssh_map.places}, dstates))
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
    spots = {i: (pose.x, pose.y) for i, pose in enumerate(poses)}
    moves = _moves_of(parts, spots, beside=not ssh_map.floors)
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
            found[s] = turned_pose(poses[s], turn, turn * at[s] + shift)
    return tuple(found)


def turned_pose(pose: Pose, turn: complex, at: complex) -> Pose:
    """Turn a pose by the direction of a number, and put it at a position."""
    xx, xy, yy = pose.spread
    mean, off = (xx + yy) / 2, complex((xx - yy) / 2, xy) * turn * turn
    spread = (mean + off.real, off.imag, mean - off.real)
    return Pose(at.real, at.imag, pose.heading + cmath.phase(turn), spread)


def _moves_of(
    parts: Sequence[Sequence[int]], at: Mapping[int, Point], least: float = 0.0, beside: bool = True
) -> dict[int, Point]:
    """Find how far to move the members of each part, so that each is below the part before.

    If `beside`, all begin at one x. Otherwise each is a little right of the one before, so that
    lifts do not cover the ways of floors.
    """
    moves: dict[int, Point] = {}
    corners = [[*zip(*(at[s] for s in part), strict=True)] for part in parts]
    boxes = [(min(xs), min(ys), max(xs), max(ys)) for xs, ys in corners]
    extent = max((max(x1 - x0, y1 - y0) for x0, y0, x1, y1 in boxes), default=0.0)
    gap = max(FLOOR_GAP * extent, least)
    below = None  # the least y of the part above, where it is drawn
    for i, (part, (x0, y0, _, y1)) in enumerate(zip(parts, boxes, strict=True)):
        aside = boxes[0][0] - x0 if beside else i * gap
        move = (0.0, 0.0) if below is None else (aside, below - gap - y1)
        below = y0 + move[1]
        moves |= dict.fromkeys(part, move)
    return moves


def _floor_by_floor(ssh_map: SSHMap, found: Layout) -> Layout:
    """Move the floors of a drawing, so that each is below the one before."""
    if not ssh_map.floors:
        return found
    spots = {i: (x, y) for i, (x, y, _) in enumerate(found.dstates)}
    moves = _moves_of(ssh_map.floors, spots, GAP)
    of_place = {s.place: moves[s.id] for s in ssh_map.dstates}
    places = {p: _sum(at, of_place.get(p, (0.0, 0.0))) for p, at in found.places.items()}
    dstates = tuple((*_sum(spots[i], moves[i]), s[2]) for i, s in enumerate(found.dstates))
    return replace(found, places=places, dstates=dstates)


def _sum(one: Point, other: Point) -> Point:
    return one[0] + other[0], one[1] + other[1]


def travelled(ssh_map: SSHMap, path: MapPath) -> list[tuple[int, int]]:
    """List the pairs of places between which the robot travelled along a path, sorted.

    In each pair, the place with the lower id comes first.
    """
    ends = [(ssh_map.dstates[s], ssh_map.dstates[x]) for s, _, x in ssh_map.links]
    return neighbours((a.place, b.place) for a, b in ends if a.path == b.path == path.id)


def neighbours(pairs: Iterable[tuple[int | None, int | None]]) -> list[tuple[int, int]]:
    """Sort the pairs of two different known places, without duplicates, the lower id first."""
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


def degrees_of(turns: Trace | Turns | None) -> dict[str, tuple[float, float]]:
    """Find by how many degrees each action turns.

    `turns` says how actions turn, as in `to_svg`. Return for each action's name the degrees
    clockwise, and their weight: SURE if the degrees are known, GUESSED if only the side is known.
    Raises MapError if a value is no turn.
    """
    known: dict[str, str | float] = {name: name for name in TURN_DEGREES}
    if isinstance(turns, Trace):
        known |= {
            action.name: (action.turn or "") if action.bearing is None else action.bearing
            for action in turns.actions
            if action.turn is not None
        }
    elif turns is not None:
        known |= an_object("turns", turns, MapError)
    degrees = {}
    for name, turn in known.items():
        if isinstance(turn, str) and turn in TURN_DEGREES:
            degrees[name] = (TURN_DEGREES[turn], GUESSED)
        elif is_finite(turn):
            degrees[name] = (float(turn), SURE)
        else:
            raise MapError(
                f'turns[{brief(name)}]: expected "right", "left", "around" or degrees clockwise, '
                f"got {brief(turn)}; say which"
            )
    return degrees


class StraightDrawing:
    """Computes the positions and headings of a map without poses that has places.

    Spots are those of `DState.site`. `degrees` has, for each action's name, the degrees clockwise
    that it turns, and their weight.
    """

    def __init__(self, ssh_map: SSHMap, degrees: Mapping[str, tuple[float, float]]) -> None:
        self.map = ssh_map
        self.spot = [s.site for s in ssh_map.dstates]
        self.spots = list(dict.fromkeys([*ssh_map.places, *self.spot]))
        self.turns = list(_turns_between(ssh_map, degrees, self.spot))
        ends = [(ssh_map.dstates[s], ssh_map.dstates[x]) for s, _, x in ssh_map.links]
        # Each path with two spots between which the robot travelled along it.
        self.travels = {
            (s.path, *sorted((self.spot[s.id], self.spot[x.id])))
            for s, x in ends
            if s.path is not None and s.path == x.path and s.place != x.place
        }
        # Travels between places of a path join these places to one segment.
        self.segments: Any = nx.utils.UnionFind(
            (path.id, place) for path in ssh_map.theory_paths for place in path.order
        )
        for path, p, q in self.travels:
            self.segments.union((path, p), (path, q))

    def positions(self) -> tuple[dict[int, Point], dict[int, float]]:
        """Return the position of each spot, and the heading of each dstate in radians.

        There are two drawings, with straight paths and with straight segments. Take the one with
        the fewest wrong turns and bent streets.
        """
        drawings = []
        for whole in (True, False):
            courses = {s.id: self._course(s, whole) for s in self.map.dstates}
            headings, wrong = _headings_by(self.turns, courses)
            program = StreetProgram(self.spots, self._streets(headings, whole))
            drawings.append((wrong + program.bent, headings, program))
        _, headings, program = min(drawings, key=lambda drawing: drawing[0])
        return self._packed(program.put_apart()), headings

    def _course(self, s: DState, whole: bool) -> tuple[Course, float]:
        """The course of a dstate, and the angle from the course to the dstate in radians, 0 or pi.

        A course is drawn straight: the whole path if `whole` is True, otherwise a part of it.
        """
        if s.path is None:
            return (-1 - s.id,), 0.0
        course = (s.path,) if whole else (s.path, *self.segments[s.path, self.spot[s.id]])
        return course, 0.0 if s.direction == 1 else math.pi

    def _walks(self) -> Iterator[tuple[int, int]]:
        """Yield the links between dstates that lead to another spot on the same floor."""
        floor = [s.floor for s in self.map.dstates]
        for s, _, x in self.map.links:
            if floor[s] == floor[x] and self.spot[s] != self.spot[x]:
                yield s, x

    def _streets(self, headings: Mapping[int, float], whole: bool) -> Streets:
        """Find the streets to draw, each with its heading and its share of the costs.

        They join neighbours on paths. If only segments are straight, the robot's travels along
        paths are streets, too. In a map without paths, all travels are streets.
        """
        # The heading of direction +1 of each path at each of its spots.
        facing = {
            (s.path, self.spot[s.id]): headings[s.id] + (0.0 if s.direction == 1 else math.pi)
            for s in reversed(self.map.dstates)
        }
        streets: dict[tuple[int, int], tuple[float, float]] = {}
        for path in self.map.theory_paths:
            pairs = list(pairwise(path.order))
            if not whole:
                index = {place: i for i, place in enumerate(path.order)}
                ends = [(p, q) for h, p, q in self.travels if h == path.id and {p, q} <= {*index}]
                pairs[:0] = sorted((p, q) if index[p] < index[q] else (q, p) for p, q in ends)
            for p, q in pairs:
                is_travelled = whole or (path.id, *sorted((p, q))) in self.travels
                way = facing.get((path.id, p), facing.get((path.id, q), 0.0))
                if is_travelled or (p, q) not in streets:
                    streets[p, q] = way, 1.0 if is_travelled else LOOSE
        for s, x in () if self.map.theory_paths else self._walks():
            streets.setdefault((self.spot[s], self.spot[x]), (headings[s], 1.0))
        # Of two streets between the same spots keep the one with the larger share, else the first.
        kept: dict[tuple[int, int], tuple[float, float]] = {}
        for (p, q), street in sorted(streets.items(), key=lambda street: -street[1][1]):
            if (q, p) not in kept:
                kept[p, q] = street
        return kept

    def _packed(self, at: Mapping[int, Point]) -> dict[int, Point]:
        """Move parts that no street connects below each other. The first spot is at (0, 0)."""
        graph: nx.Graph[Any] = nx.Graph()
        graph.add_nodes_from(self.spots)
        graph.add_edges_from(
            pair for path in self.map.theory_paths for pair in pairwise(path.order)
        )
        if not self.map.theory_paths:
            graph.add_edges_from((self.spot[s], self.spot[x]) for s, x in self._walks())
        parts = [[p for p in self.spots if p in part] for part in nx.connected_components(graph)]
        moves, (x0, y0) = _moves_of(parts, at, GAP), at[self.spots[0]]
        return {p: (x + moves[p][0] - x0, y + moves[p][1] - y0) for p, (x, y) in at.items()}


class _Turn(NamedTuple):
    """The angle between two dstates."""

    a: DState  # the first dstate
    b: DState  # the second dstate
    angle: float  # radians counterclockwise from the heading of a to the heading of b
    weight: float  # SURE if the angle is known, GUESSED if only the side is known


def _turns_between(
    ssh_map: SSHMap, degrees: Mapping[str, tuple[float, float]], spot: Sequence[int]
) -> Iterator[_Turn]:
    """Yield the known turns between dstates.

    They follow from the headings of dstates at one place, and from the actions of links. `spot` has
    a number for each dstate. Dstates at one place have the same number.
    """
    dstates = ssh_map.dstates
    unit = 90 if max((s.heading or 0 for s in dstates), default=0) < 4 else 1
    facing = [(s.place, s) for s in dstates if s.place is not None and s.heading is not None]
    for members in gathered(facing).values():
        for a, b in pairwise(members):
            yield _Turn(a, b, -math.radians(((b.heading or 0) - (a.heading or 0)) * unit), SURE)
    for source, action, target in ssh_map.links:
        s, x = dstates[source], dstates[target]
        if action in degrees:
            # Headings at a place say more than an action at this place.
            if s.heading is None or x.heading is None or s.place != x.place:
                turn, weight = degrees[action]
                yield _Turn(s, x, -math.radians(turn), weight)
        elif s.path is None and spot[source] != spot[target]:
            yield _Turn(s, x, 0.0, SURE)


def _headings_by(
    turns: Sequence[_Turn], courses: Mapping[int, tuple[Course, float]]
) -> tuple[dict[int, float], int]:
    """Find headings that agree best with all turns.

    In each connected part of the map, the first dstate faces right. `courses` has, for each dstate,
    its course, and the angle in radians from the heading of the course to the heading of the
    dstate. Return the heading of each dstate, in radians counterclockwise from x, and the number of
    turns that may go to a wrong side.
    """
    graph: nx.MultiDiGraph[Any] = nx.MultiDiGraph()
    graph.add_nodes_from(course for course, _ in courses.values())
    for a, b, turn, weight in turns:
        (course, off), (other, other_off) = courses[a.id], courses[b.id]
        if course != other:
            graph.add_edge(course, other, turn=turn + off - other_off, weight=weight)
    angles: dict[Course, float] = {}
    for part in nx.weakly_connected_components(graph):
        first, ahead = next((course, off) for course, off in courses.values() if course in part)
        found = _synchronised(graph.subgraph(part), first)
        angles |= {course: angle - ahead for course, angle in found.items()}
    headings = {
        s: math.remainder(angles[course] + off, math.tau) for s, (course, off) in courses.items()
    }
    wrong = 0
    for a, b, turn, weight in turns:
        missed = abs(math.remainder(headings[a.id] + turn - headings[b.id], math.tau))
        wrong += missed > (WRONG if weight == SURE else WRONG_GUESS)
    return headings, wrong


def _synchronised(graph: nx.MultiDiGraph[Any], first: Course) -> dict[Course, float]:
    """Find the headings of the courses of a connected part, in radians from the first course.

    Begin with headings along a tree of turns. Averaging leads from there to the least squared
    errors, if turns contradict each other.
    """
    angles = {first: 0.0}
    for a, b in nx.bfs_edges(graph.to_undirected(as_view=True), first):
        turn = graph[a][b][0]["turn"] if graph.has_edge(a, b) else -graph[b][a][0]["turn"]
        angles[b] = angles[a] + turn
    number = {course: i for i, course in enumerate(angles)}
    turned = np.zeros((len(angles), len(angles)), complex)
    for a, b, data in graph.edges(data=True):
        factor = data["weight"] * np.exp(1j * data["turn"])
        turned[number[b], number[a]] += factor
        turned[number[a], number[b]] += factor.conjugate()
    # Keep half of the old value in each sweep, so that the sweeps do not oscillate.
    turned += np.diag(0.5 * np.abs(turned).sum(axis=1) + 1e-9)
    z = np.exp(1j * np.array([*angles.values()]))
    for _ in range(SWEEPS):
        z = turned @ (z / np.maximum(np.abs(z), 1e-12))
    found = np.angle(z / z[number[first]]).tolist()
    return {course: round(found[i], 9) for course, i in number.items()}


@dataclass(frozen=True, slots=True)
class _StreetDrawing:
    """A drawing in the search that separates streets.

    `value` is its cost, and `at` has the positions of the spots, of shape (spots, 2). `conditions`
    are the inequalities that were added, `left_alone` the pairs of streets that may stay near or
    cross.
    """

    value: float
    at: _Array
    conditions: tuple[_Condition, ...]
    left_alone: frozenset[tuple[int, int]]


class StreetProgram:
    """The linear program that puts spots along the headings of streets and separates streets.

    Its first variables are x of all spots, and then y. Then comes for each street the distance by
    which it deviates from its heading, and last for each street the length by which it is too
    short.
    """

    def __init__(self, spots: Sequence[int], streets: Streets) -> None:
        self.spots = list(spots)
        number = {spot: i for i, spot in enumerate(spots)}
        self.ends = np.array([(number[p], number[q]) for p, q in streets], dtype=int).reshape(-1, 2)
        ways = [(math.cos(way), math.sin(way)) for way, _ in streets.values()]
        self.along = np.round(np.array(ways).reshape(-1, 2), 12)
        self.across = self.along[:, ::-1] * (-1, 1)
        self.share = np.array([share for _, share in streets.values()])
        # Keep pairs of travelled streets apart if they have no common end.
        e, f = np.triu_indices(len(streets), 1)
        common = (self.ends[e][:, :, None] == self.ends[f][:, None, :]).any(axis=(1, 2))
        both = (self.share[e] == 1.0) & (self.share[f] == 1.0)
        self.pairs = np.column_stack((e, f))[both & ~common]
        # The inequalities of all streets, and the cost of each variable.
        ahead, aside = self._ahead(self.ends, self.along), self._ahead(self.ends, self.across)
        one, none = eye_array(len(streets)), csr_array((len(streets), len(streets)))
        self.rows = vstack(
            [hstack([ahead, none, one]), hstack([aside, one, none]), hstack([-aside, one, none])]
        )
        self.least = np.repeat((1.0, 0.0), (len(streets), 2 * len(streets)))
        self.cost = np.concatenate([ahead.T @ self.share, ASTRAY * self.share, SHORT * self.share])
        self.at, self.value = self._solved(())

    @property
    def bent(self) -> int:
        """The number of travelled streets that deviate from their headings or are too short."""
        way = self.at[self.ends[:, 1]] - self.at[self.ends[:, 0]]
        aside, ahead = np.sum(way * self.across, axis=1), np.sum(way * self.along, axis=1)
        astray = np.maximum(np.abs(aside), 1 - ahead)
        return int(np.sum((astray > CROOKED) & (self.share == 1.0)))

    def put_apart(self) -> dict[int, Point]:
        """Separate streets that are too near each other, and return the position of each spot.

        This is a beam search. For each pair of streets that are too near, it tries to leave the
        pair alone, and to move one street to either side of the other.
        """
        best = _StreetDrawing(self.value, self.at, (), frozenset())
        beam, left = [best], max(FEWEST, WORK // (len(self.ends) + 1))
        while beam and left > 0:
            children = []
            for state in beam:
                near = (pair for pair in self._near(state.at) if pair not in state.left_alone)
                if (pair := next(near, None)) is None:
                    continue
                children.append(replace(state, left_alone=state.left_alone | {pair}))
                for condition in self._ways_apart(*pair):
                    conditions = (*state.conditions, *condition)
                    at, value = self._solved(conditions)
                    children.append(_StreetDrawing(value, at, conditions, state.left_alone))
                    left -= 1
            beam = sorted(children, key=lambda state: state.value)[:BEAM]
            best = min([best, *beam], key=lambda state: state.value)
        return {
            spot: (round(float(x), 9) + 0.0, round(float(y), 9) + 0.0)  # + 0.0 turns -0.0 into 0.0
            for spot, (x, y) in zip(self.spots, best.at, strict=True)
        }

    def _ahead(self, ends: NDArray[np.int64], ways: _Array) -> Any:
        """How far the second spot of each pair is ahead of the first one, along a direction.

        Return the factors of the positions of spots: a sparse matrix of shape (pairs, 2 spots).
        """
        rows, n = np.arange(len(ends)), len(self.spots)
        columns = [ends[:, 1], ends[:, 0], n + ends[:, 1], n + ends[:, 0]]
        x, y = ways.T
        factors = np.concatenate([x, -x, y, -y]), (np.tile(rows, 4), np.concatenate(columns))
        return coo_array(factors, (len(ends), 2 * n)).tocsr()

    def _solved(self, more: Sequence[_Condition]) -> tuple[_Array, float]:
        """Solve the program with more inequalities. Return the positions of the spots and the cost.

        The positions are of shape (spots, 2). The cost is inf if the inequalities contradict each
        other.
        """
        n, m = len(self.spots), len(self.ends)
        if not m:
            return np.zeros((n, 2)), 0.0
        table = np.array(more, dtype=float).reshape(-1, 4)
        apart = self._ahead(table[:, :2].astype(int), table[:, 2:])
        rows = vstack([self.rows, hstack([apart, csr_array((len(table), 2 * m))])])
        free = [(0.0, 0.0), *[(None, None)] * (n - 1)]  # the first spot is fixed
        answer = linprog(
            self.cost,
            A_ub=-rows.tocsr(),
            b_ub=-np.append(self.least, np.full(len(table), APART)),
            bounds=[*free, *free, *[(0.0, None)] * (2 * m)],
            method="highs-ds",
        )
        if answer.x is None:  # conditions that contradict each other
            return np.zeros((n, 2)), math.inf
        at = np.asarray(answer.x[: 2 * n], dtype=float).reshape(2, n).T
        return at, float(answer.fun) + CROSSING * len(self._near(at))

    def _ways_apart(self, e: int, f: int) -> Iterator[list[_Condition]]:
        """Yield inequalities that put one of two streets beside, ahead of or behind the other."""
        parallel = abs(float(self.across[e] @ self.along[f])) < PARALLEL
        for normal in (self.across[e], self.along[e] if parallel else self.across[f]):
            for x, y in (normal, -normal):
                yield [(p, q, x, y) for p, q in product(self.ends[e], self.ends[f])]

    def _near(self, at: _Array) -> list[tuple[int, int]]:
        """List the pairs of streets that cross or are too near, but have no common end."""
        e, f = self.ends[self.pairs[:, 0]], self.ends[self.pairs[:, 1]]
        a, b, c, d = at[e[:, 0]], at[e[:, 1]], at[f[:, 0]], at[f[:, 1]]
        far = np.min(
            (_distance(a, c, d), _distance(b, c, d), _distance(c, a, b), _distance(d, a, b)), axis=0
        )
        crossing = (_side(a, b, c) * _side(a, b, d) < 0) & (_side(c, d, a) * _side(c, d, b) < 0)
        return [(int(i), int(j)) for i, j in self.pairs[(far < NEAR) | crossing]]


def _side(a: _Array, b: _Array, c: _Array) -> _Array:
    """For each of n lines from a to b, find the side of point c: positive on the left."""
    (ux, uy), (vx, vy) = (b - a).T, (c - a).T
    side: _Array = ux * vy - uy * vx
    return side


def _distance(p: _Array, a: _Array, b: _Array) -> _Array:
    """The distance of each of n points p from the line segment between a and b."""
    way = b - a
    length = np.maximum(np.sum(way * way, axis=1), 1e-12)
    share = np.clip(np.sum((p - a) * way, axis=1) / length, 0, 1)
    far: _Array = np.linalg.norm(p - a - share[:, None] * way, axis=1)
    return far
