"""Pair the ends of the edges of a plan into paths, and find the sides of paths.

Clingo decides. See encodings/derived/paths.lp and encodings/derived/sides.lp for the axioms. Both
follow from a finished map, so they cannot change which maps there are. The cost of a pair of ends
is how unlikely it is that one straight way bends, shifts and changes its width so much.

>>> ends = [(0, 0, 7), (1, 0, 8), (2, 1, 8), (3, 1, 9)]  # edges 0 and 1 meet at place 8
>>> best, gaps = best_pairings(ends, {(1, 2): 0.5}, ())
>>> best, gaps
((((1, 2),),), (3.5,))
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from typing import Any

import numpy as np
from clingo import Function, Number

from perception.places.track import wrapped
from ssh_abduction.building.edges import Array, FloorPlan, Gap, PlanEdge
from ssh_abduction.data.map_parts import MapPath
from ssh_abduction.data.odometry import radians_between
from ssh_abduction.solver import Control, new_control

# The price of an end of a path, in nats. Costs of joints are rounded to 1 / UNIT nats.
PRICE, UNIT = 4.0, 100
Pairing = tuple[tuple[int, int], ...]  # pairs of ends, sorted
End = tuple[int, int, int]  # an end, its edge and its place


def best_pairings(
    ends: Iterable[End],
    costs: Mapping[tuple[int, int], float],
    apart: Iterable[tuple[int, int]],
    most: int = 1,
) -> tuple[tuple[Pairing, ...], tuple[float, ...]]:
    """Find the best pairings of the ends of edges.

    Args:
        ends: The ends: for each, its number, the number of its edge, and its place.
        costs: The cost of pairing two ends at one place, in nats, the smaller end first.
        apart: The pairs of edges that are not on one path, the smaller edge first.
        most: How many of the best pairings to list, which have equal costs; 0 for all.

    Returns:
        The best pairings. And for each path of the first one, in the order of `chains_of`, how many
        nats worse the best pairing without this path is; infinite if there is no other.
    """
    ends = list(ends)
    facts = [f"end({e},{x},{p})." for e, x, p in ends]
    facts += [f"joint({e},{f},{round(UNIT * cost)})." for (e, f), cost in costs.items()]
    facts += [f"apart({x},{y})." for x, y in apart]
    # Unsat cores prove the least cost place by place. By branch and bound, 158 edges took minutes.
    options = ["--opt-strategy=usc", "-c", f"price={round(UNIT * PRICE)}"]
    control = new_control("derived/paths", "\n".join(facts), options)
    found = sorted(_least(control, most))
    least = _saved(found[0], costs)
    gaps = []
    for k, chain in enumerate(chains_of(ends, found[0])):
        inner = [(e ^ 1, f) for e, f in pairwise(chain)]
        free = [chain[0], chain[-1] ^ 1]
        own = [f"part({k},{min(pair)},{max(pair)})." for pair in inner]
        control.add(f"of{k}", [], " ".join([*own, *(f"free({k},{e})." for e in free)]))
        control.ground([(f"of{k}", []), ("other", [Number(k)])])
        asked = Function("asked", [Number(k)])
        control.assign_external(asked, True)
        others = _least(control, 1)
        control.assign_external(asked, False)
        gaps.append((_saved(others[0], costs) - least) if others else float("inf"))
    return tuple(found), tuple(gaps)


def chains_of(ends: Iterable[End], pairing: Pairing) -> list[list[int]]:
    """Return the paths of a pairing, each as the ends at which its edges begin.

    The two ends of an edge are 2 x and 2 x + 1.
    """
    onward = dict(pairing) | {f: e for e, f in pairing}
    found, done = [], set[int]()
    for e, x, _ in sorted(ends):
        if x in done or e in onward:
            continue  # Begin where nothing goes on.
        chain = [e]
        while (after := onward.get(chain[-1] ^ 1)) is not None:
            chain.append(after)
        done |= {f // 2 for f in chain}
        found.append(chain)
    return found


def sides_of(
    on: Iterable[tuple[int, int]],
    leaves: Iterable[tuple[int, int, str, int]],
    joined: Iterable[tuple[int, int]],
) -> tuple[set[tuple[int, str, int]], set[tuple[int, int]]]:
    """Find the places beside paths, and around them.

    Args:
        on: The paths, each with one of its places.
        leaves: The edges that leave paths: a path, its place, the side, and the place at the end.
        joined: The places that an edge joins.

    Returns:
        The paths, each with a side and a place there; and the paths, each with a place around it.
    """
    facts = [f"on({h},{p})." for h, p in on]
    facts += [f"leaves({h},{p},{side},{q})." for h, p, side, q in leaves]
    facts += [f"joined({p},{q})." for p, q in joined]
    control = new_control("derived/sides", "\n".join(facts))
    beside = {(h.number, side.name, q.number) for h, side, q in _facts(control, "beside", 3)}
    around = {(h.number, q.number) for h, q in _facts(control, "around", 2)}
    return beside, around


def _facts(control: Control, name: str, arity: int) -> Iterable[Any]:
    return (atom.symbol.arguments for atom in control.symbolic_atoms.by_signature(name, arity))


def _least(control: Control, most: int) -> list[Pairing]:
    """List pairings of least cost: at most this many, or all for 0. Empty if there is none."""
    configuration: Any = control.configuration.solve
    configuration.opt_mode, configuration.models = ("opt", 0) if most == 1 else ("optN", most)
    found: list[Pairing] = []
    for model in control.models():
        if most == 1 or model.optimality_proven:
            pairs = (s.arguments for s in model.symbols(shown=True))
            found.append(tuple(sorted((e.number, f.number) for e, f in pairs)))
    return found[-1:] if most == 1 else found


def _saved(pairing: Pairing, costs: Mapping[tuple[int, int], float]) -> float:
    """The cost of a pairing in nats, less the price of the ends that it saves."""
    return round(sum(round(UNIT * costs[pair]) - UNIT * PRICE for pair in pairing) / UNIT, 2)


# Standard deviations of a straight joint: its bend in radians, its shift to the side in metres, and
# the logarithm of the ratio of the widths.
BEND, ASIDE, WIDER = math.radians(13), 1.2, 1.0
# A joint bends by at most MOST radians beyond its slack, and by ROUGH radians in all. The middle of
# a place is off by SLACK of its radius.
MOST, ROUGH, SLACK = math.radians(40), math.radians(60), 0.25
# The directions of two edges of a path differ by at most TURN radians, and by SLOW radians more for
# each metre between them.
TURN, SLOW = math.radians(60), math.radians(5)
# The direction of an end is measured from OUT to FAR metres outside of the disc of its place.
OUT, FAR = 0.3, 3.0
NARROW = 0.6  # metres; smaller widths count as this


@dataclass(frozen=True)
class Leaving:
    """How an end of an edge leaves its place."""

    bearing: float  # radians
    aside: float  # metres by which its line passes left of the middle of the place
    width: float  # metres; NaN if it is unknown


@dataclass(frozen=True, eq=False)
class PairedWay:
    """A path of a plan: its edges in its direction."""

    edges: tuple[PlanEdge, ...]
    ends: tuple[int, ...]  # for each edge, the end at which it begins: 2 x number + 0 or 1
    gap: float  # nats to the best pairing without this path

    @property
    def places(self) -> list[int]:
        """The places and corners in order."""
        return [self.edges[0].ends[0], *(edge.ends[1] for edge in self.edges)]

    @property
    def line(self) -> Array:
        """The course, (n, 2) metres."""
        return np.concatenate([edge.course for edge in self.edges])

    @property
    def stops(self) -> list[int]:
        """The points of the line at which its places are; the last point of an edge counts."""
        return [0, *(int(n) - 1 for n in np.cumsum([len(edge.course) for edge in self.edges]))]

    @property
    def metres(self) -> Array:
        """How far each point of the line is along it, (n,) metres."""
        steps = np.hypot(*np.diff(self.line, axis=0).T)
        return np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def passages(self) -> list[Gap]:
        """The doors that the way passes and the openings beside it, at points of the line."""
        begins = [0, *np.cumsum([len(edge.course) for edge in self.edges])]
        return [
            replace(p, at=p.at + int(begin))
            for begin, edge in zip(begins, self.edges, strict=False)
            for p in edge.passages
        ]

    @property
    def widths(self) -> Array:
        """The free space across the way at each point of the line, (n,) metres."""
        return np.concatenate([edge.widths.sum(axis=1) for edge in self.edges])


def ways_of(plan: FloorPlan, most: int = 0) -> Iterator[list[PairedWay]]:
    """Yield the paths of a plan, the longest first, for each pairing of least cost.

    There are at most `most`, or all for 0.
    """
    ends = [(2 * x + k, x, edge.ends[k]) for x, edge in enumerate(plan.edges) for k in (0, 1)]
    costs, apart = joints(plan), [*other_directions(plan)]
    (best,), gaps = best_pairings(ends, costs, apart)
    gap_of = dict(zip(map(tuple, chains_of(ends, best)), gaps, strict=True))
    yield _ways(plan, gap_of)
    for other in best_pairings(ends, costs, apart, most)[0]:
        if other != best:  # It costs the same, so paths that only one has are unsure.
            yield _ways(plan, {c: gap_of.get(c, 0.0) for c in map(tuple, chains_of(ends, other))})


def _ways(plan: FloorPlan, gap_of: Mapping[tuple[int, ...], float]) -> list[PairedWay]:
    """Make the paths of chains of ends, each with its gap."""
    found = []
    for chain, gap in gap_of.items():
        edges = [plan.edges[e // 2] for e in chain]
        turned = [x.turned() if e % 2 else x for e, x in zip(chain, edges, strict=True)]
        found.append(PairedWay(tuple(turned), chain, gap))
    return sorted(found, key=lambda way: (-round(sum(e.length for e in way.edges), 2), way.ends))


def joints(plan: FloorPlan) -> dict[tuple[int, int], float]:
    """Find the pairs of ends at one place that may be one path, and their costs in nats."""
    at = defaultdict(list)
    for x, edge in enumerate(plan.edges):
        for k in (0, 1):
            at[edge.ends[k]].append(2 * x + k)
    leaves = {e: leaving(plan, e) for ends in at.values() for e in ends}
    found = {}
    for place, ends in at.items():
        off = SLACK * plan.spots[place].radius
        for e, f in combinations(ends, 2):
            one, other = leaves[e], leaves[f]
            bend = radians_between(one.bearing, other.bearing + math.pi)
            slack = sum(math.atan(off / plan.edges[end // 2].length) for end in (e, f))
            if e // 2 == f // 2 or bend > ROUGH or (bend := max(0.0, bend - slack)) > MOST:
                continue
            wider = math.log(max(one.width, NARROW) / max(other.width, NARROW))
            errors = [bend / BEND, (one.aside + other.aside) / ASIDE, wider / WIDER]
            found[e, f] = float(np.nansum(np.square(errors))) / 2
    return found


def other_directions(plan: FloorPlan) -> Iterator[tuple[int, int]]:
    """Yield the pairs of edges whose directions differ too much for one path."""
    for (x, one), (y, other) in combinations(enumerate(plan.edges), 2):
        first, second = (edge.course[-1] - edge.course[0] for edge in (one, other))
        bend = math.atan2(*first[::-1]) - math.atan2(*second[::-1])
        bend = min(radians_between(bend, 0), radians_between(bend, math.pi))  # as undirected lines
        between = min(math.dist(p, q) for p in one.course[[0, -1]] for q in other.course[[0, -1]])
        if bend > TURN + SLOW * between:
            yield x, y


def leaving(plan: FloorPlan, end: int) -> Leaving:
    """Find how an end leaves its place: 2 x the number of its edge, plus 0 or 1."""
    edge = plan.edges[end // 2].turned() if end % 2 else plan.edges[end // 2]
    here, there = (plan.spots[p] for p in edge.ends)
    way = edge.course
    far = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way, axis=0).T))])
    begin = min(here.radius + OUT, far[-1] / 2)
    stop = max(min(here.radius + FAR, far[-1] - there.radius), min(begin + 1.0, far[-1]))
    points = [np.array([np.interp(s, far, way[:, k]) for k in (0, 1)]) for s in (begin, stop)]
    onward = _unit(points[1] - points[0])
    chord = _unit(
        np.array([np.interp(min(4.0, far[-1]), far, way[:, k]) for k in (0, 1)]) - here.at
    )
    bearing = math.atan2(*(onward + chord)[::-1])
    left = np.array([-math.sin(bearing), math.cos(bearing)])
    near = edge.widths.sum(axis=1)[(far >= begin) & (far <= stop)]
    width = float(np.median(near)) if len(near) else math.nan
    return Leaving(bearing, float((points[0] - here.at) @ left), width)


def _unit(off: Array) -> Array:
    return np.asarray(off / max(float(np.hypot(*off)), 1e-6))


def paths_of(plan: FloorPlan, ways: list[PairedWay]) -> tuple[MapPath, ...]:
    """Make the paths of a map from the ways of its plan."""
    beside, around = sides_of(
        [(k, p) for k, way in enumerate(ways) for p in way.places],
        [(k, p, side, edge.ends[1]) for k, p, side, edge in branches(plan, ways)],
        [edge.ends for edge in plan.edges],
    )

    def places(some: Iterable[int]) -> tuple[int, ...]:
        return tuple(sorted(p for p in some if p >= 0))

    found = []
    for k, way in enumerate(ways):
        length = round(sum(edge.length for edge in way.edges), 2)
        width = None if np.isnan(way.widths).any() else round(float(np.median(way.widths)), 2)
        sure = round(1 / (1 + math.exp(-way.gap)), 4)
        left, right = (
            places(q for h, w, q in beside if (h, w) == (k, s)) for s in ("left", "right")
        )
        line, order = chain_points(way.line), tuple(p for p in way.places if p >= 0)
        loop = places(q for h, q in around if h == k)
        found.append(MapPath(k, order, line, length, width, sure, left, right, loop))
    return tuple(found)


def branches(plan: FloorPlan, ways: list[PairedWay]) -> Iterator[tuple[int, int, str, PlanEdge]]:
    """Yield the edges that leave paths: the path, its place, the side, and the edge from there.

    An edge leaves on the left if its bearing is between that of the way ahead and that of the way
    back, counterclockwise.
    """
    for n, way in enumerate(ways):
        own = {e // 2 for e in way.ends}
        for i, place in enumerate(way.places):
            ahead = leaving(plan, way.ends[i]).bearing if i < len(way.ends) else None
            back = leaving(plan, way.ends[i - 1] ^ 1).bearing if i else None
            ahead = wrapped((back or 0.0) + math.pi) if ahead is None else ahead
            back = wrapped(ahead + math.pi) if back is None else back
            yield from (
                (n, place, side, edge) for side, edge in edges_beside(plan, place, own, ahead, back)
            )


def edges_beside(
    plan: FloorPlan, place: int, own: Collection[int], ahead: float, back: float
) -> Iterator[tuple[str, PlanEdge]]:
    """Yield the edges that leave a place, but for those numbered `own`, each with its side.

    `ahead` and `back` are the bearings of the way on and of the way back, in radians.
    """
    for x, edge in enumerate(plan.edges):
        for k in (0, 1):
            if edge.ends[k] == place and x not in own:
                turn = (leaving(plan, 2 * x + k).bearing - ahead) % math.tau
                side = "left" if turn < (back - ahead) % math.tau else "right"
                yield side, edge.turned() if k else edge


def chain_points(line: Array) -> tuple[tuple[float, float], ...]:
    """Simplify a course, (n, 2) metres, to a chain of points within 0.1 m of it."""
    from skimage.measure import approximate_polygon

    chain = approximate_polygon(line, 0.1) if len(line) > 2 else line
    return tuple((round(float(x), 2), round(float(y), 2)) for x, y in chain)
