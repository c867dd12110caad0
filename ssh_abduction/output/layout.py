"""Where to draw a map: at the poses of its dstates or, without metres, so that paths are straight and turns go to their side.

Without poses a map says nothing of metres, but it does say which way turns go. First each path gets the heading that agrees best with all turns, as angles are
synchronised (Singer 2011, "Angular synchronization by eigenvectors and semidefinite programming"). Maps with few paths may join streets to one path that no straight line
holds; where turns would go to a wrong side or streets would bend, only what was travelled in one go stays straight. Then places are put along these headings by a linear program: a street
is at least one unit long, to leave its heading is dear, and streets are as short as that allows. Where two streets then lie on each other or cross, the program is
asked again with one more condition, that the one is on some side of the other, where that costs less than the crossing. Turns that fit right angles give a drawing at
right angles, on a grid.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, TypeAlias

import networkx as nx
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog
from scipy.sparse import coo_array
from scipy.spatial.distance import pdist

from ssh_abduction.data.trace import Trace
from ssh_abduction.output.turns import SURE, Turns, degrees_of

if TYPE_CHECKING:
    from ssh_abduction.data.maps import DState, MapPath, Pose, SSHMap

Point: TypeAlias = tuple[float, float]

FARTHEST = 1e7  # metres: positions farther away are not those of a robot
WRONG, WRONG_GUESS = (
    math.radians(46),
    math.radians(61),
)  # turns of either kind that a drawing misses by more may go to the wrong side
SWEEPS, REWEIGHTED = (
    60,
    15,
)  # of averaging, where turns do not agree on the headings of courses; and how often turns are weighted anew
LEAST_MISSED = 0.02  # radians: turns that are missed by less weigh all the same
EXACT = 1e-6  # radians by which headings may miss turns that they agree with
# What a unit that a street leaves its heading costs, one that it is too short, and streets that lie on each other: in units of length of a street.
ASTRAY, SHORT, CROSSING = 300.0, 600.0, 60.0
LOOSE = 0.001  # the share of these costs of a street that nobody travelled, so that only the order of its path says that it is there
CROOKED = 0.1  # a street that leaves its heading by more is seen to be bent
NEAR, APART = 0.5, 1.0  # streets that are nearer than the one are put as far apart as the other
PARALLEL = 0.1  # streets whose headings differ by no more, in radians, are parallel
# How many times the program is asked at most: so often, times streets, but this often at least. Counts and not seconds, so that one map has one drawing.
WORK, FEWEST = 6000, 12
BEAM = 3
GAP = 1.5  # between parts of a map that nothing connects


@dataclass(frozen=True, slots=True)
class Layout:
    """Where the places and dstates of a map are drawn, x to the right and y up.

    places   (x, y) of each place, by id
    dstates  (x, y, heading) of each dstate, by id: radians counterclockwise from x; the heading is None where it is not known
    metric   whether these are metres, of displacements; elsewhere the shortest street has about length 1, and lengths say nothing
    """

    places: Mapping[int, Point]
    dstates: tuple[tuple[float, float, float | None], ...] = field(repr=False)
    metric: bool = False

    def to_dict(self) -> dict[str, Any]:
        """The layout as plain data: `places` as pairs [id, [x, y]], `dstates` as [x, y, heading or null], and `metric`."""
        return {
            "metric": self.metric,
            "places": [
                [place, [round(x, 4), round(y, 4)]] for place, (x, y) in self.places.items()
            ],
            "dstates": [
                [None if number is None else round(number, 4) for number in s] for s in self.dstates
            ],
        }


def located(ssh_map: SSHMap) -> tuple[Pose, ...] | None:
    """The poses of the dstates, if the map can be drawn by them.

    It cannot where displacements are missing between parts of the map: each part has poses of its own then, seen from its own first dstate.
    """
    poses = ssh_map.fit.poses if ssh_map.fit else ()
    if not poses or any(
        abs(number) > FARTHEST for pose in poses for number in (pose.x, pose.y, *pose.spread)
    ):
        return None
    if set(ssh_map.places) - {s.place for s in ssh_map.dstates}:
        return None
    here = ssh_map.dstates[ssh_map.labels[0]]
    away = (
        s for s in ssh_map.dstates if s.id != here.id and (s.place is None or s.place != here.place)
    )
    return (
        None
        if any(
            (pose := poses[s.id]).x == pose.y == pose.heading == 0.0 and not any(pose.spread)
            for s in away
        )
        else poses
    )


def layout(ssh_map: SSHMap, turns: Trace | Turns | None = None) -> Layout:
    """Where to draw a map.

    turns  which way actions turn: the trace that was mapped, or for each action's name "right", "left", "around" or the degrees that it turns by, clockwise. Actions
           of these three names need none. Maps with poses (`fit`) are drawn by them

    Raises MapError where a turn is none of these.
    """
    degrees = degrees_of(turns)
    if (poses := located(ssh_map)) is not None:
        at = {
            s.place: (poses[s.id].x, poses[s.id].y)
            for s in reversed(ssh_map.dstates)
            if s.place is not None
        }
        return Layout(
            {p: at[p] for p in ssh_map.places},
            tuple((pose.x, pose.y, pose.heading) for pose in poses),
            True,
        )
    return _Drawing(ssh_map, degrees).layout()


def travelled(ssh_map: SSHMap, path: MapPath) -> list[tuple[int, int]]:
    """The pairs of places on a path between which the robot travelled, the lower number first."""
    ends = [(ssh_map.dstates[s], ssh_map.dstates[x]) for s, _, x in ssh_map.links]
    pairs = {(a.place, b.place) for a, b in ends if a.path == b.path == path.id}
    return sorted(
        {(min(p, q), max(p, q)) for p, q in pairs if p is not None and q is not None and p != q}
    )


class _Drawing:
    """The layout of one map without poses, while it is made. A spot is a place or, as a negative number, a dstate that is at none."""

    def __init__(self, ssh_map: SSHMap, degrees: Mapping[str, tuple[float, float]]) -> None:
        self.map, self.degrees = ssh_map, degrees
        self.spot = [s.place if s.place is not None else -1 - s.id for s in ssh_map.dstates]
        self.spots = list(dict.fromkeys([*ssh_map.places, *self.spot]))
        ends = [
            (ssh_map.dstates[source], ssh_map.dstates[target])
            for source, _, target in ssh_map.links
        ]
        self.travels = {
            (s.path, *sorted((self.spot[s.id], self.spot[x.id])))
            for s, x in ends
            if s.path is not None and s.path == x.path and s.place != x.place
        }
        self.segments: Any = nx.utils.UnionFind(
            (path.id, place) for path in ssh_map.paths for place in path.order
        )
        for path, p, q in self.travels:
            self.segments.union((path, p), (path, q))
        self.in_quarters = all(
            abs(math.remainder(turn, math.pi / 2)) < EXACT for _, _, turn, _ in self._turned()
        )

    def layout(self) -> Layout:
        """The best of these: with paths straight, or only segments of them; each with most turns as they are, and with all of them a little wrong."""
        if not self.map.places:
            return self._spread()
        best: tuple[dict[int, float], _Program] | None = None
        fewest = math.inf
        for whole in (True, False):
            for robust in (True, False):
                headings, wrong = self._headings(whole, robust)
                if wrong < fewest:
                    program = _Program(self.spots, self._streets(headings, whole))
                    if wrong + program.bent < fewest:
                        best, fewest = (headings, program), wrong + program.bent
        assert best is not None  # the first always is better than none
        headings, at = best[0], self._packed(best[1].put_apart())
        return Layout(
            {p: at[p] for p in self.map.places},
            tuple((*at[self.spot[s.id]], headings[s.id]) for s in self.map.dstates),
        )

    def _spread(self) -> Layout:
        """Dstates without places so that neighbours are near each other (Kamada & Kawai 1989): turns need not fit any headings there."""
        graph: nx.Graph[Any] = nx.Graph()
        graph.add_nodes_from(s.id for s in self.map.dstates)
        graph.add_edges_from((s, x) for s, _, x in self.map.links if s != x)
        graph.add_edges_from(pairwise([min(part) for part in nx.connected_components(graph)]))
        found = (
            nx.kamada_kawai_layout(graph) if len(graph) > 1 else dict.fromkeys(graph, (0.0, 0.0))
        )
        at = np.array([found[s.id] for s in self.map.dstates])
        nearest = float(np.min(pdist(at))) if len(at) > 1 else 1.0
        return Layout({}, tuple((float(x), float(y), None) for x, y in at / max(nearest, EXACT)))

    def _course(self, s: DState, whole: bool) -> tuple[tuple[int, ...], float]:
        """What has a heading: a path, or a segment of it, or a dstate along no path; and by how many radians the dstate faces another way than that."""
        if s.path is None:
            return (-1 - s.id,), 0.0
        course = (s.path,) if whole else (s.path, *self.segments[s.path, self.spot[s.id]])
        return course, 0.0 if s.direction == 1 else math.pi

    def _turned(self) -> Iterator[tuple[DState, DState, float, float]]:
        """Pairs of dstates, by how many radians the second faces more to the left than the first, and with which weight that is believed."""
        dstates = self.map.dstates
        slots = max((s.heading or 0 for s in dstates), default=0) < 4
        for members in _grouped(dstates).values():
            facing = [s for s in members if s.heading is not None]
            for a, b in pairwise(facing):
                yield (
                    a,
                    b,
                    -math.radians(((b.heading or 0) - (a.heading or 0)) * (90 if slots else 1)),
                    SURE,
                )
        for s, action, x in self.map.links:
            if action in self.degrees:
                turn, weight = self.degrees[action]
                if (
                    dstates[s].heading is None
                    or dstates[x].heading is None
                    or dstates[s].place != dstates[x].place
                ):
                    yield dstates[s], dstates[x], -math.radians(turn), weight
            elif dstates[s].path is None and self.spot[s] != self.spot[x]:
                yield dstates[s], dstates[x], 0.0, SURE

    def _headings(self, whole: bool, robust: bool) -> tuple[dict[int, float], int]:
        """The heading of each dstate, in radians counterclockwise, and how many turns are missed by so much that they may go to the wrong side.

        The first dstate of each connected part faces right.
        """
        graph: nx.MultiDiGraph[Any] = nx.MultiDiGraph()
        courses = {s.id: self._course(s, whole) for s in self.map.dstates}
        graph.add_nodes_from(course for course, _ in courses.values())
        turned = list(self._turned())
        for a, b, turn, weight in turned:
            (course, off), (other, other_off) = courses[a.id], courses[b.id]
            if course != other:
                graph.add_edge(course, other, turn=turn + off - other_off, weight=weight)
        angles: dict[tuple[int, ...], float] = {}
        for part in nx.weakly_connected_components(graph):
            first, ahead = next((course, off) for course, off in courses.values() if course in part)
            angles |= {
                course: angle - ahead
                for course, angle in _synchronised(graph.subgraph(part), first, robust).items()
            }
        if robust and self.in_quarters:
            angles = {
                course: round(angle / (math.pi / 2)) * math.pi / 2
                for course, angle in angles.items()
            }
        headings = {
            s: math.remainder(angles[course] + off, math.tau)
            for s, (course, off) in courses.items()
        }
        missed = (
            (abs(math.remainder(headings[a.id] + turn - headings[b.id], math.tau)), weight)
            for a, b, turn, weight in turned
        )
        return headings, sum(
            miss > (WRONG if weight == SURE else WRONG_GUESS) for miss, weight in missed
        )

    def _streets(
        self, headings: Mapping[int, float], whole: bool
    ) -> dict[tuple[int, int], tuple[float, float]]:
        """The heading of the street from one spot to another, and what share of the costs it has: neighbours on a path and, where only segments are straight, travels."""
        facing = {
            (s.path, self.spot[s.id]): headings[s.id] + (0.0 if s.direction == 1 else math.pi)
            for s in reversed(self.map.dstates)
        }
        streets = {}
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
                travelled = whole or (path.id, *sorted((p, q))) in self.travels
                way = facing.get((path.id, p), facing.get((path.id, q), 0.0))
                if travelled or (p, q) not in streets:
                    streets[p, q] = way, 1.0 if travelled else LOOSE
        return _once(streets)

    def _packed(self, at: Mapping[int, Point]) -> dict[int, Point]:
        """Parts of the map that no street connects, side by side."""
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


def _once(
    streets: Mapping[tuple[int, int], tuple[float, float]],
) -> dict[tuple[int, int], tuple[float, float]]:
    """The streets without those that go back along another one; of two, the one that weighs more is kept, or else the first."""
    kept: dict[tuple[int, int], tuple[float, float]] = {}
    for (p, q), (way, share) in sorted(streets.items(), key=lambda street: -street[1][1]):
        if (q, p) not in kept:
            kept[p, q] = way, share
    return kept


def _grouped(dstates: Sequence[DState]) -> dict[int, list[DState]]:
    """The dstates at each place."""
    groups: dict[int, list[DState]] = {}
    for s in dstates:
        if s.place is not None:
            groups.setdefault(s.place, []).append(s)
    return groups


def _synchronised(graph: nx.MultiDiGraph[Any], first: Any, robust: bool) -> dict[Any, float]:
    """The heading of each course that agrees best with the turns between them; that of the first is 0.

    robust  where turns contradict each other, most of them are kept as they are, rather than all a little wrong: what is missed counts by its size and not by its
            square, as averages are taken again and again, each with weights that fall with what was missed the last time
    """
    angles = {first: 0.0}
    for a, b in nx.bfs_edges(graph.to_undirected(as_view=True), first):
        turn = graph[a][b][0]["turn"] if graph.has_edge(a, b) else -graph[b][a][0]["turn"]
        angles[b] = angles[a] + turn
    courses = list(angles)
    number = {course: i for i, course in enumerate(courses)}
    turns = [
        (number[a], number[b], data["turn"], data["weight"])
        for a, b, data in graph.edges(data=True)
    ]
    found = np.array([angles[course] for course in courses])
    if turns:
        source, target, turn, weight = (np.array(column) for column in zip(*turns, strict=True))
        rows, columns = np.concatenate([target, source]), np.concatenate([source, target])
        for _ in range(REWEIGHTED):
            missed = np.abs(np.angle(np.exp(1j * (found[source] + turn - found[target]))))
            if missed.max() < EXACT:
                break
            now = weight / np.maximum(missed, LEAST_MISSED) if robust else weight
            factors = np.concatenate([now * np.exp(1j * turn), now * np.exp(-1j * turn)])
            own = 0.5 * np.bincount(
                rows, np.abs(factors), len(courses)
            )  # a share of what was there before, so that the sweeps do not swing to and fro
            matrix = coo_array((factors, (rows, columns)), (len(courses), len(courses))).tocsr()
            z = np.exp(1j * found)
            for _ in range(SWEEPS):
                z = matrix @ z + own * z
                z /= np.maximum(np.abs(z), 1e-12)
            found = np.angle(z)
    return {
        course: round(math.remainder(angle - found[number[first]], math.tau), 9)
        for course, angle in zip(courses, found.tolist(), strict=True)
    }


_Condition: TypeAlias = tuple[
    dict[int, float], float
]  # a sum of variables, and what it is at least


@dataclass(frozen=True, slots=True)
class _State:
    """Of the search that puts streets apart: what the drawing costs, where spots are, what was asked for, and pairs that stay as they are."""

    value: float
    at: NDArray[np.float64]
    conditions: tuple[_Condition, ...]
    left_alone: frozenset[tuple[int, int]]


class _Program:
    """The linear program that puts spots along the headings of streets, and keeps streets apart.

    Its variables are x and y of each spot, then for each street by how much it leaves its heading, and by how much it is too short.
    """

    def __init__(
        self, spots: Sequence[int], streets: Mapping[tuple[int, int], tuple[float, float]]
    ) -> None:
        self.spots = list(spots)
        number = {spot: i for i, spot in enumerate(spots)}
        self.ends = np.array([(number[p], number[q]) for p, q in streets], dtype=int).reshape(-1, 2)
        self.along = np.round(
            np.array([(math.cos(way), math.sin(way)) for way, _ in streets.values()]).reshape(
                -1, 2
            ),
            12,
        )
        self.across = self.along[:, ::-1] * (-1, 1)
        self.share = np.array([share for _, share in streets.values()])
        e, f = np.triu_indices(len(streets), 1)
        common = (self.ends[e][:, :, None] == self.ends[f][:, None, :]).any(axis=(1, 2))
        self.pairs = np.column_stack((e, f))[
            (self.share[e] == 1.0) & (self.share[f] == 1.0) & ~common
        ]
        self.rows: list[_Condition] = []
        self.cost = self._cost()
        self.at, self.value = self._asked([])

    @property
    def bent(self) -> int:
        """How many streets leave their headings, or are too short."""
        way = self.at[self.ends[:, 1]] - self.at[self.ends[:, 0]]
        astray = np.maximum(
            np.abs(np.sum(way * self.across, axis=1)), 1 - np.sum(way * self.along, axis=1)
        )
        return int(np.sum((astray > CROOKED) & (self.share == 1.0)))

    def _cost(self) -> NDArray[np.float64]:
        """What each variable costs; on the way the conditions of all streets are written down."""
        n, m = len(self.spots), len(self.ends)
        cost = np.concatenate([np.zeros(2 * n), ASTRAY * self.share, SHORT * self.share])
        for e, (p, q) in enumerate(self.ends):
            ahead, aside = _difference(p, q, self.along[e]), _difference(p, q, self.across[e])
            self.rows.append((ahead | {2 * n + m + e: 1.0}, 1.0))
            self.rows.append((aside | {2 * n + e: 1.0}, 0.0))
            self.rows.append(({k: -v for k, v in aside.items()} | {2 * n + e: 1.0}, 0.0))
            for variable, factor in ahead.items():
                cost[variable] += factor * self.share[e]
        return cost

    def put_apart(self) -> dict[int, Point]:
        """Where each spot is. Pairs of streets that are too near each other are put apart one by one, to either side or not at all: a search with a narrow beam."""
        best = _State(self.value, self.at, (), frozenset())
        beam, left = [best], max(FEWEST, WORK // (len(self.ends) + 1))
        while beam and left > 0:
            children = []
            for state in beam:
                pair = next(
                    (pair for pair in self._near(state.at) if pair not in state.left_alone), None
                )
                if pair is None:
                    continue
                children.append(replace(state, left_alone=state.left_alone | {pair}))
                for condition in self._conditions(*pair):
                    at, value = self._asked([*state.conditions, *condition])
                    children.append(
                        _State(value, at, (*state.conditions, *condition), state.left_alone)
                    )
                    left -= 1
            beam = sorted(children, key=lambda state: state.value)[:BEAM]
            best = min([best, *beam], key=lambda state: state.value)
        return {
            spot: (round(float(x), 9) + 0.0, round(float(y), 9) + 0.0)
            for spot, (x, y) in zip(self.spots, best.at, strict=True)
        }  # no -0.0

    def _asked(self, more: Sequence[_Condition]) -> tuple[NDArray[np.float64], float]:
        """Where the spots are best with more conditions, and what that costs, with all streets that are too near each other."""
        if not len(self.ends):
            return np.zeros((len(self.spots), 2)), 0.0
        rows = [*self.rows, *more]
        where = [
            (i, variable, -factor)
            for i, (factors, _) in enumerate(rows)
            for variable, factor in factors.items()
        ]
        i, variables, factors = zip(*where, strict=True)
        matrix = coo_array((factors, (i, variables)), (len(rows), len(self.cost))).tocsr()
        n = len(self.spots)
        bounds = (
            [(0.0, 0.0)] * 2
            + [(None, None)] * (2 * n - 2)
            + [(0.0, None)] * (len(self.cost) - 2 * n)
        )
        answer = linprog(
            self.cost,
            A_ub=matrix,
            b_ub=[-least for _, least in rows],
            bounds=bounds,
            method="highs-ds",
        )
        if answer.x is None:  # conditions that cannot hold together
            return np.zeros((n, 2)), math.inf
        at = np.asarray(answer.x[: 2 * n], dtype=float).reshape(n, 2)
        return at, float(answer.fun) + CROSSING * len(self._near(at))

    def _conditions(self, e: int, f: int) -> Iterator[list[_Condition]]:
        """What has to hold for one street to be apart from another: to the sides of the one and of the other, or ahead and behind where both are parallel."""
        parallel = abs(float(self.across[e] @ self.along[f])) < PARALLEL
        for normal in (self.across[e], self.along[e] if parallel else self.across[f]):
            for sign in (1.0, -1.0):
                yield [
                    (_difference(p, q, sign * normal), APART)
                    for p in self.ends[e]
                    for q in self.ends[f]
                ]

    def _near(self, at: NDArray[np.float64]) -> list[tuple[int, int]]:
        """Pairs of streets without a common end that are nearer to each other than they should be."""
        e, f = self.ends[self.pairs[:, 0]], self.ends[self.pairs[:, 1]]
        a, b, c, d = at[e[:, 0]], at[e[:, 1]], at[f[:, 0]], at[f[:, 1]]
        ends = (
            _from_street(a, c, d),
            _from_street(b, c, d),
            _from_street(c, a, b),
            _from_street(d, a, b),
        )
        crossing = (_side(a, b, c) * _side(a, b, d) < 0) & (_side(c, d, a) * _side(c, d, b) < 0)
        near: list[tuple[int, int]] = [
            (int(i), int(j)) for i, j in self.pairs[(np.min(ends, axis=0) < NEAR) | crossing]
        ]
        return near


def _difference(p: int, q: int, way: NDArray[np.float64]) -> dict[int, float]:
    """How far spot q is ahead of spot p along a way, as factors of variables."""
    x, y = float(way[0]), float(way[1])
    return {2 * int(q): x, 2 * int(q) + 1: y, 2 * int(p): -x, 2 * int(p) + 1: -y}


def _side(
    a: NDArray[np.float64], b: NDArray[np.float64], c: NDArray[np.float64]
) -> NDArray[np.float64]:
    """On which side of the line from a to b c is: above 0 to the left."""
    found: NDArray[np.float64] = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (
        c[:, 0] - a[:, 0]
    )
    return found


def _from_street(
    p: NDArray[np.float64], a: NDArray[np.float64], b: NDArray[np.float64]
) -> NDArray[np.float64]:
    """How far points are from streets."""
    way = b - a
    share = np.clip(
        np.sum((p - a) * way, axis=1) / np.maximum(np.sum(way * way, axis=1), 1e-12), 0, 1
    )
    far: NDArray[np.float64] = np.linalg.norm(p - a - share[:, None] * way, axis=1)
    return far
