"""Find the doors, rooms and corridors of a plan.

Rooms are what doors cut off. Corridors are the long and slim parts of paths. A fire door across a
corridor parts rooms, but neither the path nor the corridor. A door in an end wall, which is much
wider than the door, parts two corridors of one path.

The free space of a room is what lies between the walls on both sides of the edges there.

In a wide corridor a robot drives from door to door, or in lanes. So its ways there bend at each
place, and go on straight nowhere. The walls on both sides say how the corridor lies. One straight
way is laid through each room that is long and slim.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, groupby, pairwise

import networkx as nx
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial.distance import cdist

from perception.places.passages import DOOR, STEP, WIDE, directions, resampled, to_the_left
from ssh_abduction.building.edges import Array, FloorPlan, Gap, PlanEdge, Spot, walls_beside
from ssh_abduction.building.straight_paths import PairedWay, branches, chain_points
from ssh_abduction.data.building import Corridor, MapDoor, MapRoom, Point, WayOut
from ssh_abduction.data.map_parts import MapPath
from ssh_abduction.data.maps import SSHMap

GRID = 0.1  # metres: a cell in which free space is drawn
# A person keeps BODY metres from walls, where the robot itself did.
BODY = 0.3


def strips_of(edge: PlanEdge, begin: int, stop: int, most: float = math.inf) -> Iterator[Array]:
    """Yield the corners, (4, 2) metres, of the free space between any two points of a course.

    Where the course bends, walls may stand between two views to one side. If these part by more
    than `most` metres, only what is nearer counts.
    """
    left, wide = to_the_left(edge.course), ndimage.median_filter(edge.widths, (3, 1))
    reach = [sign * wide[:, [j]] * left for j, sign in enumerate((1, -1))]
    ends = [np.hypot(*np.diff(edge.course + off, axis=0).T) for off in reach]
    for k in range(begin, stop):
        shares = (min(1.0, most / max(far[k], STEP / 2)) for far in ends)
        seen = (share * off[k : k + 2] for share, off in zip(shares, reach, strict=True))
        one, other = (edge.course[k : k + 2] + off for off in seen)
        corners = np.concatenate([one, other[::-1]])
        if np.isfinite(corners).all():
            yield corners


def drawn(strips: Sequence[Array], *more: Array) -> tuple[NDArray[np.bool_], Array]:
    """Draw strips: which cells of GRID metres are free, and the position of the first cell.

    There are cells for more points, (n, 2) metres, too.
    """
    from skimage.draw import polygon

    points = np.concatenate([*strips, *more])
    corner = points.min(axis=0) - 2 * GRID
    free = np.zeros(np.ceil((points.max(axis=0) - corner) / GRID).astype(int) + 3, dtype=bool)
    for strip in strips:
        free[polygon(*((strip - corner) / GRID).T, free.shape)] = True
    return free, corner


@dataclass(frozen=True, eq=False)
class RoomSpace:
    """The free space of a room: which cells are free, and the position of the first cell."""

    free: NDArray[np.bool_]
    corner: Array

    def beside(self, course: Array) -> Array:
        """How far the free space reaches left and right of a course, (n, 2) metres."""
        off = np.arange(1, round(2 * WIDE / GRID) + 1)[:, None, None] * GRID * to_the_left(course)
        reach = []
        for sign in (1, -1):
            cells = np.rint((course + sign * off - self.corner) / GRID).astype(int)
            inside = np.all((cells >= 0) & (cells < self.free.shape), axis=2)
            x, y = np.where(inside[..., None], cells, 0).transpose(2, 0, 1)
            reach.append(np.logical_and.accumulate(inside & self.free[x, y]).sum(axis=0) * GRID)
        return np.stack(reach, axis=1)


class FreeView:
    """Which points of a route see each other: all that is between them is free."""

    def __init__(self, edges: Sequence[PlanEdge]) -> None:
        strips = [s for edge in edges for s in strips_of(edge, 0, len(edge.course) - 1)]
        course = np.concatenate([edge.course for edge in edges])
        walls = np.concatenate([walls_beside(edge) for edge in edges])
        self._free, self._corner = drawn(strips, course, walls)
        blocked = ~ndimage.binary_erosion(self._free, iterations=round(BODY / GRID))
        blocked |= ndimage.binary_dilation(self._marked(walls), iterations=round(BODY / GRID))
        self._free = ~blocked | ndimage.binary_dilation(self._marked(course), iterations=2)

    def _marked(self, points: Array) -> NDArray[np.bool_]:
        """The cells that have a point."""
        found = np.zeros_like(self._free)
        found[tuple(self._cells(points).T)] = True
        return found

    def _cells(self, points: Array) -> NDArray[np.int64]:
        return np.rint((points - self._corner) / GRID).astype(int)

    def from_point(self, point: Array, others: Array) -> NDArray[np.bool_]:
        """Whether each of the others, (n, 2), is seen from a point."""
        far = float(np.hypot(*(others - point).T).max(initial=GRID))
        share = np.linspace(0, 1, int(np.ceil(far / GRID)) + 1)[:, None, None]
        cells = self._cells(point + share * (others - point))
        return np.asarray(self._free[cells[..., 0], cells[..., 1]].all(axis=0))


# Two doors between the same rooms, less than HALF metres apart, are the halves of a double door.
HALF = 1.5
# A corridor is at least LONG metres long, and SLIM times as long as wide. Its ends are at least
# STRAIGHT of its length apart.
LONG, SLIM, STRAIGHT = 6.0, 3.0, 0.8
# A part of a path between two doors is a room if it is shorter than SHORT metres, or than SQUARE
# widths; at an end of the path, than END widths. Its width is exceeded on WIDEST per cent of it.
SHORT, SQUARE, END, WIDEST = 2.0, 1.3, 2.0, 30
# A corridor ends at a door that takes less than LEAF of its width: it has an end wall there.
LEAF = 1 / 3
# The robot never drove through some openings. Leave out those of them that are less than BESIDE
# metres from an opening that it drove through.
BESIDE = 1.2
SPIKE = 0.6  # metres: the least width of a room
HOLE = 2.0  # square metres: smaller holes in free space are furniture
Part = tuple[int, int]  # the first and the last point of a part of a way


def room_of_places(plan: FloorPlan) -> dict[int, int]:
    """Find the room of each place and corner: those that no door parts have one room.

    Parts that share free space which is wider than a door are one room, too: no wall is between.
    """
    graph = nx.Graph()
    graph.add_nodes_from(plan.spots)
    graph.add_edges_from(edge.ends for edge in plan.edges if not edge.doors)
    graph.add_edges_from([*_shared(plan, _numbered(graph))])
    return _numbered(graph)


def _numbered(graph: nx.Graph) -> dict[int, int]:
    """Number the connected parts of a graph of places and corners."""
    parts = sorted(map(sorted, nx.connected_components(graph)), key=lambda part: abs(part[-1]))
    parts.sort(key=lambda part: next((p for p in part if p >= 0), math.inf))
    return {p: k for k, part in enumerate(parts) for p in part}


def _shared(plan: FloorPlan, room: dict[int, int]) -> Iterator[tuple[int, int]]:
    """Yield a place of each of two rooms that share free space which is wider than a door."""
    strips, spot = strips_of_rooms(plan, room, DOOR), {k: p for p, k in room.items()}
    every = [strip for some in strips.values() for strip in some]
    free = {k: drawn(some, *every)[0] for k, some in strips.items()}
    for k, other in combinations(free, 2):
        p, q = spot[k], spot[other]
        both = free[k] & free[other]
        if plan.spots[p].frame != plan.spots[q].frame or both.sum() * GRID < DOOR:
            continue
        if 2 * GRID * float(ndimage.distance_transform_edt(both).max()) > DOOR:
            yield p, q


def strips_of_rooms(
    plan: FloorPlan, room: dict[int, int], most: float = math.inf
) -> dict[int, list[Array]]:
    """Find the strips of free space along the ways of each room. Edges are cut at their doors.

    `most` is as in `strips_of`.
    """
    strips: dict[int, list[Array]] = {}
    for edge in plan.edges:
        stops = [0, *(gap.at for gap in edge.doors), len(edge.course) - 1]
        for end, begin, stop in ((edge.ends[0], *stops[:2]), (edge.ends[1], *stops[-2:])):
            strips.setdefault(room[end], []).extend(strips_of(edge, begin, stop, most))
    return {k: some for k, some in strips.items() if some}


def with_doors(plan: FloorPlan, room: dict[int, int], ssh_map: SSHMap) -> tuple[MapDoor, ...]:
    """Find the doors that edges pass, and number them. The halves of a double door are one."""
    found: list[MapDoor] = []
    edges = []
    for edge in plan.edges:
        passages = list(edge.passages)
        for k, passage in enumerate(edge.passages):
            if passage.side == "through":
                x, y = (round(float(v), 2) for v in edge.course[passage.at])
                places = tuple(sorted(p for p in edge.ends if p >= 0))
                rooms = tuple(sorted({room[p] for p in edge.ends}))
                dstates = tuple(sorted({ssh_map.dstate_at[t] for t in edge.travels}))
                new = MapDoor(len(found), (x, y), passage.width, places, rooms, dstates)
                halves = (d for d in found if d.rooms == new.rooms)
                number = next((d.id for d in halves if math.dist(d.at, new.at) < HALF), new.id)
                one = _joined(found[number], new) if number < new.id else new
                found[number : number + 1] = [one]
                passages[k] = replace(passage, door=number)
        edges.append(replace(edge, passages=tuple(passages)))
    plan.edges = edges
    return tuple(found)


def _joined(one: MapDoor, other: MapDoor) -> MapDoor:
    """Join the halves of a double door."""
    places = tuple(sorted({*one.places, *other.places}))
    dstates = tuple(sorted({*one.dstates, *other.dstates}))
    return replace(one, width=max(one.width, other.width), places=places, dstates=dstates)


def corridors_of(
    plan: FloorPlan,
    ways: Sequence[PairedWay],
    paths: Sequence[MapPath],
    room: Mapping[int, int],
    doors: Sequence[MapDoor],
) -> tuple[Corridor, ...]:
    """Find the corridors: the long and slim parts of paths, without the rooms that they cross.

    A closet may be long and slim, too. But all its doors lead to one room.
    """
    beside: dict[int, list[tuple[int, str, int, int | None]]] = {}
    for k, place, side, edge in branches(plan, list(ways)):
        door = next((p.door for p in edge.doors), None)
        beside.setdefault(k, []).append((place, side, edge.ends[1], door))
    found = []
    for path, way in zip(paths, ways, strict=True):
        if not np.isfinite(way.widths).all():
            continue
        far, stops = way.metres, dict(zip(way.places, way.stops, strict=True))
        for begin, end in long_parts(way):
            order = tuple(p for p in path.order if begin <= stops[p] <= end)
            metres = [round(float(m), 1) for m in far - far[begin]]
            driven = [
                WayOut(side, metres[stops[p]], p, door, to if to >= 0 else None)
                for p, side, to, door in beside.get(path.id, ())
                if p in order
            ]
            inside = [p for p in way.passages if begin < p.at < end]
            seen = [WayOut(p.side, metres[p.at]) for p in inside if p.side != "through"]
            new = [
                o
                for o in seen
                if all(o.side != d.side or abs(o.metres - d.metres) > BESIDE for d in driven)
            ]
            across = tuple(sorted({p.door for p in inside if p.door is not None}))
            openings = tuple(sorted([*driven, *new], key=lambda o: (o.metres, o.side)))
            if len(order) > 1:
                line = chain_points(way.line[begin : end + 1])
                width = round(float(np.median(way.widths[begin : end + 1])), 2)
                length, sides = metres[end], (path.left, path.right, path.around)
                one = Corridor(0, path.id, order, line, length, width, across, openings, *sides)
                found.append(one)
    found = [c for c in found if not _is_closet(c, {room[p] for p in c.order}, doors)]
    found.sort(key=lambda c: -c.length)
    return tuple(replace(c, id=k) for k, c in enumerate(found))


def _is_closet(corridor: Corridor, own: set[int], doors: Sequence[MapDoor]) -> bool:
    """Whether some doors lead out of its own rooms, all to one room, and no opening is seen."""
    beyond = [{*d.rooms} - own for d in doors if own & {*d.rooms}]
    out = [some for some in beyond if some]
    seen = any(opening.place is None for opening in corridor.openings)
    return len(out) > 1 and len(set[int]().union(*out)) == 1 and not seen


def long_parts(way: PairedWay) -> Iterator[Part]:
    """Yield the parts of a way that are corridors, between rooms that it crosses and end walls."""
    stops = sorted({p.at for p in way.passages if p.door is not None})
    parts = pairwise([0, *stops, len(way.line) - 1])
    for is_room, run in groupby(parts, key=lambda part: _is_room(way, part, SQUARE)):
        if not is_room and (whole := _corridor(way, [*run])) is not None:
            yield from pairwise([whole[0], *_end_walls(way, *whole), whole[1]])


def _end_walls(way: PairedWay, begin: int, end: int) -> Iterator[int]:
    """Yield the doors inside a part of a way that lead through end walls."""
    doors = {p.at: p.width for p in way.passages if p.door is not None and begin < p.at < end}
    for before, at, after in zip([begin, *doors], doors, [*doors, end][1:], strict=False):
        sides = way.widths[before : at + 1], way.widths[at : after + 1]
        if doors[at] < LEAF * min(map(np.median, sides)):
            yield at


def _corridor(way: PairedWay, parts: list[Part]) -> Part | None:
    """The parts of a way as one corridor, without rooms at its ends; None if it is none."""
    while parts and _is_room(way, parts[0], END):
        parts = parts[1:]
    while parts and _is_room(way, parts[-1], END):
        parts = parts[:-1]
    if not parts:
        return None
    begin, end = parts[0][0], parts[-1][1]
    length = float(way.metres[end] - way.metres[begin])
    width = float(np.median(way.widths[begin : end + 1]))
    chord = math.dist(way.line[begin], way.line[end])
    is_slim = length >= max(LONG, SLIM * width) and chord >= STRAIGHT * length
    return (begin, end) if is_slim else None


def _is_room(way: PairedWay, part: Part, share: float) -> bool:
    """Whether a part of a way is short for its width, or has no walls within WIDE metres."""
    begin, end = part
    widths = way.widths[begin : end + 1]
    short = max(SHORT, share * float(np.percentile(widths, 100 - WIDEST)))
    is_open = np.median(widths) >= 2 * (WIDE - GRID)
    return bool(way.metres[end] - way.metres[begin] < short or is_open)


def rooms_of(
    plan: FloorPlan,
    room: dict[int, int],
    doors: Sequence[MapDoor],
    corridors: Sequence[Corridor],
    outlines: Mapping[int, tuple[Point, ...]],
) -> tuple[MapRoom, ...]:
    """Make the rooms, from the room of each place. A room of corners alone has no places."""
    found = []
    for k in sorted({*room.values()}):
        places = tuple(sorted(p for p, name in plan.name.items() if room[name] == k))
        own = tuple(door.id for door in doors if k in door.rooms)
        inside = tuple(c.id for c in corridors if any(room[p] == k for p in c.order))
        found.append(MapRoom(k, places, own, inside, outlines.get(k, ())))
    return tuple(found)


def spaces_of(plan: FloorPlan, room: dict[int, int]) -> dict[int, RoomSpace]:
    """Draw the free space of each room: what lies between the walls along its ways.

    Edges are cut at their doors. Free space that is narrower than SPIKE metres, such as the view
    through a door, is left out.
    """
    found = {}
    for number, some in strips_of_rooms(plan, room).items():
        free, corner = drawn(some)
        free = ndimage.binary_opening(free, iterations=round(SPIKE / GRID / 2))
        found[number] = RoomSpace(free, corner)
    return found


def outlines_of(spaces: Mapping[int, RoomSpace]) -> dict[int, tuple[Point, ...]]:
    """Find the polygon of the free space of each room."""
    some = {k: space for k, space in spaces.items() if space.free.any()}
    rings = {k: space.corner + (_ring(space.free) - 1) * GRID for k, space in some.items()}
    return {k: tuple((x, y) for x, y in np.round(ring, 2).tolist()) for k, ring in rings.items()}


def _ring(free: NDArray[np.bool_]) -> Array:
    """The ring, (n, 2) cells, around the largest free part, with a line to each hole and back.

    The cells begin at 1. A hole is walls that the robot drove around.
    """
    from skimage.measure import approximate_polygon, find_contours

    parts = ndimage.label(free)[0]
    part = np.pad(parts == np.bincount(parts[free]).argmax(), 1).astype(float)
    chain, *rings = sorted(find_contours(part, 0.5), key=_area)  # Holes have a positive area.
    chains, holes = [chain], [ring for ring in rings if _area(ring) > HOLE / GRID**2]
    while holes:
        far = [(cdist(c, hole), k, n) for k, c in enumerate(chains) for n, hole in enumerate(holes)]
        between, k, n = min(far, key=lambda one: float(one[0].min()))
        i, j = np.unravel_index(between.argmin(), between.shape)
        hole, chain = holes.pop(n), chains[k]
        chains[k : k + 1] = chain[: i + 1], np.concatenate([hole[j:], hole[1 : j + 1]]), chain[i:]
    return np.concatenate([approximate_polygon(chain, 1.5) for chain in chains])[:-1]


def _area(ring: Array) -> float:
    """The area of a ring, (n, 2), whose last corner is its first: positive counterclockwise."""
    return float((ring[:-1, 0] * ring[1:, 1] - ring[1:, 0] * ring[:-1, 1]).sum() / 2)


ONWARD = math.radians(45)  # An edge that leaves within this angle goes on straight.
FREE = 0.5  # At least this share of a straight way through a room is free.


@dataclass(frozen=True, eq=False)
class Box:
    """The rectangle around a room, along its longer axis."""

    middle: Array
    ahead: Array  # the unit vector along it
    length: float
    width: float

    @classmethod
    def of(cls, space: RoomSpace) -> Box:
        """Find the rectangle around the free cells of a room."""
        cells = space.corner + GRID * np.argwhere(space.free)
        frame = np.linalg.eigh(np.cov(cells.T))[1].T[::-1]
        least, most = (cells @ frame.T).min(axis=0), (cells @ frame.T).max(axis=0)
        length, width = most - least
        return cls((least + most) / 2 @ frame, frame[0], float(length), float(width))

    def along(self, point: Array) -> float:
        """How far a point is along the box, from its middle."""
        return float((point - self.middle) @ self.ahead)


def straightened(
    plan: FloorPlan, room: Mapping[int, int], spaces: Mapping[int, RoomSpace]
) -> FloorPlan:
    """Return the plan with one straight way through each room that is long and slim."""
    spots, edges, corners = dict(plan.spots), list(plan.edges), plan.corners
    for number, space in spaces.items():
        inner = [e for e in edges if not e.doors and {room.get(p) for p in e.ends} == {number}]
        box = Box.of(space) if inner and space.free.any() else None
        if box is None or box.length < max(LONG, SLIM * box.width):
            continue
        others = [edge for edge in edges if all(edge is not e for e in inner)]
        far = sorted((box.along(spots[p].at), p) for p in spots if room.get(p) == number)
        line = box.middle + np.array([[far[0][0]], [far[-1][0]]]) * box.ahead
        if space.beside(resampled(line, STEP)).any(axis=1).mean() < FREE:
            continue  # The room bends.
        frame = spots[far[0][1]].frame
        for end, sign in ((far[0], -1), (far[-1], 1)):
            more = box.length / 2 - sign * end[0]
            if more > LONG / 4 and not _onward(others, end[1], sign * box.ahead):
                corners += 1
                far.append((end[0] + sign * more, -corners))
                spots[-corners] = Spot(box.middle, STEP, frame)
        far.sort()
        at: list[float] = []
        for metres, _ in far:  # Places beside each other are two places, too.
            at.append(max(metres, at[-1] + 2 * STEP) if at else metres)
        for metres, (_, p) in zip(at, far, strict=True):
            spots[p] = replace(spots[p], at=box.middle + metres * box.ahead)
        ends = [p for _, p in far]
        edges = [*others, *_chain(box, space, ends, at, inner)]
    edges.sort(key=lambda e: (min(e.travels), e.ends))
    return FloorPlan(spots, edges, plan.name, plan.measured, corners)


def widened(
    ways: Sequence[PairedWay], room: Mapping[int, int], spaces: Mapping[int, RoomSpace]
) -> list[PairedWay]:
    """Return the ways, each as wide in a room as the free space of all ways there."""

    def wide(edge: PlanEdge) -> PlanEdge:
        p, q = edge.ends
        if room.get(p) != room.get(q) or edge.doors or room.get(p) not in spaces:
            return edge
        beside = spaces[room[p]].beside(edge.course)
        return replace(edge, widths=np.maximum(edge.widths, beside))

    return [replace(way, edges=tuple(map(wide, way.edges))) for way in ways]


def _onward(edges: Sequence[PlanEdge], place: int, ahead: Array) -> bool:
    """Whether one of the edges leaves a place in a direction."""
    for edge in edges:
        if place in edge.ends:
            way = edge.course if edge.ends[0] == place else edge.course[::-1]
            off = way[min(round(LONG / 4 / STEP), len(way) - 1)] - way[0]
            if off @ ahead > math.cos(ONWARD) * math.hypot(*off):
                return True
    return False


def _chain(
    box: Box, space: RoomSpace, ends: Sequence[int], at: Sequence[float], inner: Sequence[PlanEdge]
) -> Iterator[PlanEdge]:
    """Yield the edges of a straight way along a box, with the widths and openings of its room."""
    seen: list[tuple[float, Gap]] = []
    for edge in inner:
        for gap in (p for p in edge.passages if p.side != "through"):
            same = directions(edge.course)[gap.at] @ box.ahead > 0
            side = gap.side if same else {"left": "right", "right": "left"}[gap.side]
            metres = box.along(edge.course[gap.at])
            if all(g.side != side or abs(m - metres) > BESIDE for m, g in seen):
                seen.append((metres, replace(gap, side=side)))
    travels = tuple(sorted({t for edge in inner for t in edge.travels}))
    for (p, begin), (q, end) in pairwise(zip(ends, at, strict=True)):
        line = box.middle + np.array([[begin], [end]]) * box.ahead
        course = resampled(line, STEP)
        passages = tuple(
            replace(gap, at=min(round((m - begin) / STEP), len(course) - 1))
            for m, gap in sorted(seen, key=lambda pair: pair[0])
            if begin < m <= end
        )
        yield PlanEdge((p, q), course, travels, space.beside(course), passages)
