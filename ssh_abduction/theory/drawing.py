"""Whether edges between places can be drawn in the plane without a crossing, where it is known in part how they lie around a place.

>>> three_edges = [("a", "b"), ("a", "b"), ("a", "b")]
>>> can_be_drawn(three_edges, lambda place, ends: True)
True
>>> is_planar({"a": (0, 2, 4), "b": (5, 3, 1)}), is_planar({"a": (0, 2, 4), "b": (1, 3, 5)})
(True, False)

Edge number e has two ends, 2e and 2e + 1. The ends around each place, clockwise, make a *rotation system*. Its faces are traced by going along an edge and
leaving by the next end around the place. It is the one of a drawing in the plane without crossings exactly if V - E + F = 2 for each
connected part (Euler; Edmonds 1960; Mohar & Thomassen, Graphs on Surfaces, 2001, chapter 3).
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from typing import TypeAlias, TypeVar

Ends: TypeAlias = tuple[int, ...]
Place = TypeVar("Place", bound=Hashable)
State = TypeVar("State")
Step = TypeVar("Step")


def is_planar(around: Mapping[Place, Ends]) -> bool:
    """Whether a rotation system is one of the plane.

    around  for each place, the ends of edges around it, clockwise, from any end on; each edge has both ends in it
    """
    places = [place for place, ends in around.items() if ends]
    edges = sum(len(around[place]) for place in places) // 2
    return len(places) - edges + _faces(around) == 2 * _parts(around)


def _faces(around: Mapping[Place, Ends]) -> int:
    """How many faces a rotation system has, not counting those around places without edges."""
    following = {end: ends[i - len(ends) + 1] for ends in around.values() for i, end in enumerate(ends)}
    faces = 0
    left = set(following)
    while left:
        faces += 1
        end = start = left.pop()
        while (end := following[end ^ 1]) != start:
            left.remove(end)
    return faces


def _parts(around: Mapping[Place, Ends]) -> int:
    """How many connected parts there are, not counting places without edges."""
    place_of = {end: place for place, ends in around.items() for end in ends}
    parts = 0
    left = set(place_of.values())
    while left:
        parts += 1
        queue = [left.pop()]
        while queue:
            new = {place_of[end ^ 1] for end in around[queue.pop()]} & left
            left -= new
            queue.extend(new)
    return parts


def can_be_drawn(edges: Sequence[tuple[Place, Place]], allows: Callable[[Place, Ends], bool]) -> bool:
    """Whether there is an order of the ends around each place in which the edges do not cross.

    edges   the two places that each one joins
    allows  whether some ends may lie around a place in this order, clockwise, from any of them on. What it allows of some ends it allows of fewer of them, and it
            allows some order of all ends that has an allowed order of some in it.
    """
    place_of = [place for edge in edges for place in edge]
    if not all(allows(place, ()) for place in set(place_of)):
        return False
    return all(_can_draw_part(part, place_of, allows) for part in _in_order(_on_rings(place_of), place_of))


def _on_rings(place_of: Sequence[Place]) -> set[int]:
    """The edges that are left when dead ends are taken away one after another: a dead end can be drawn wherever its edge has to begin."""
    ends_at: dict[Place, set[int]] = {}
    for end, place in enumerate(place_of):
        ends_at.setdefault(place, set()).add(end)
    queue = list(ends_at)
    while queue:
        if len(ends := ends_at[queue.pop()]) == 1:
            end = ends.pop()
            other = place_of[end ^ 1]
            ends_at[other].remove(end ^ 1)
            queue.append(other)
    return {end // 2 for ends in ends_at.values() for end in ends}


def _in_order(edges: set[int], place_of: Sequence[Place]) -> Iterator[list[int]]:
    """The edges of each connected part, in an order in which each is joined to those before it, and rings are closed as soon as they can be."""
    edges_at: dict[Place, list[int]] = {}
    for edge in sorted(edges):
        for end in (2 * edge, 2 * edge + 1):
            edges_at.setdefault(place_of[end], []).append(edge)
    reached: set[Place] = set()
    for first in edges_at:
        part: dict[int, None] = {}
        closing: list[int] = []
        leaving: list[int] = []
        new = {first} - reached
        while new or closing or leaving:
            for place in new:
                reached.add(place)
                for edge in edges_at[place]:
                    closes = place_of[2 * edge] in reached and place_of[2 * edge + 1] in reached
                    (closing if closes else leaving).append(edge)
            new = set()
            if closing or leaving:
                edge = closing.pop() if closing else leaving.pop()
                part[edge] = None
                new = {place_of[2 * edge], place_of[2 * edge + 1]} - reached
        if part:
            yield list(part)


def _can_draw_part(edges: Sequence[int], place_of: Sequence[Place], allows: Callable[[Place, Ends], bool]) -> bool:
    """Whether the edges of one part can be drawn, one after another; where an edge cannot be, those before it are drawn in another way."""
    nothing: dict[Place, Ends] = {}
    return has_way(nothing, edges, lambda around, edge: _with_edge(around, edge, place_of, allows))


def has_way(start: State, steps: Sequence[Step], ways: Callable[[State, Step], Iterator[State]]) -> bool:
    """Whether all steps can be gone from a start, each in one of its ways. It is a depth-first search, without recursion as there may be many steps."""
    gone: list[Iterator[State]] = []
    state = start
    while len(gone) < len(steps):
        gone.append(ways(state, steps[len(gone)]))
        while (following := next(gone[-1], None)) is None:
            gone.pop()
            if not gone:
                return False
        state = following
    return True


def _with_edge(
    around: dict[Place, Ends], edge: int, place_of: Sequence[Place], allows: Callable[[Place, Ends], bool]
) -> Iterator[dict[Place, Ends]]:
    """The ways to draw one more edge into a drawing that it is joined to."""
    p, q = place_of[2 * edge], place_of[2 * edge + 1]
    closes = p in around and q in around
    for begun in _with_end(around, p, 2 * edge, allows):
        for whole in _with_end(begun, q, 2 * edge + 1, allows):
            if not closes or len(whole) - sum(map(len, whole.values())) // 2 + _faces(whole) == 2:
                yield whole


def _with_end(around: dict[Place, Ends], place: Place, end: int, allows: Callable[[Place, Ends], bool]) -> Iterator[dict[Place, Ends]]:
    ends = around.get(place, ())
    for gap in range(max(len(ends), 1)):
        order = (*ends[: gap + 1], end, *ends[gap + 1 :])
        if allows(place, order):
            yield {**around, place: order}
