"""Decide whether edges between places can be drawn in the plane without a crossing.

The order of the edges around a place may be known only in part.

>>> three_edges = [("a", "b"), ("a", "b"), ("a", "b")]
>>> can_be_drawn(three_edges, lambda place, ends: True)
True
>>> is_planar({"a": (0, 2, 4), "b": (5, 3, 1)}), is_planar({"a": (0, 2, 4), "b": (1, 3, 5)})
(True, False)

Edge e has the two ends 2e and 2e + 1. The clockwise orders of the ends around all places are a
*rotation system*. To trace a face, go along an edge, leave by the next end around the place, and so
on. The rotation system has a drawing in the plane without crossings exactly if V - E + F = 2 for
each connected part, with V places, E edges and F faces (Euler; Edmonds 1960; Mohar & Thomassen,
Graphs on Surfaces, 2001, chapter 3).
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from functools import partial
from typing import TypeAlias, TypeVar

from ssh_abduction.data.groups import parts
from ssh_abduction.runtime.clock import each_looking, look_at_clock

Ends: TypeAlias = tuple[int, ...]
Place = TypeVar("Place", bound=Hashable)
State = TypeVar("State")
Step = TypeVar("Step")
End = TypeVar("End")


def is_planar(around: Mapping[Place, Ends]) -> bool:
    """Whether edges can be drawn in the plane without crossings, in this order around each place.

    Args:
        around: For each place, the ends of edges around it, clockwise from any end. Edge e has the
            ends 2e and 2e + 1. Both ends of each edge must be given.
    """
    place_of = {end: place for place, ends in around.items() for end in ends}
    places = dict.fromkeys(place_of.values())
    pieces = parts(places, ((place, place_of[end ^ 1]) for end, place in place_of.items()))
    return len(places) - len(place_of) // 2 + _faces(around) == 2 * len(pieces)


def _faces(around: Mapping[Place, Ends]) -> int:
    """Count the faces of a rotation system. Places without edges are ignored."""
    following = {
        end: ends[i - len(ends) + 1] for ends in around.values() for i, end in enumerate(ends)
    }
    faces = 0
    left = set(following)
    while left:
        faces += 1
        end = start = left.pop()
        while (end := following[end ^ 1]) != start:
            left.remove(end)
    return faces


def can_be_drawn(
    edges: Sequence[tuple[Place, Place]], allows: Callable[[Place, Ends], bool]
) -> bool:
    """Whether the ends of edges around each place have an order so that the edges do not cross.

    Args:
        edges: The two places of each edge. Edge e has the ends 2e and 2e + 1.
        allows: Returns whether some ends may lie around a place in this clockwise order, starting
            from any of them. If it allows an order, it must allow each part of the order, and some
            order of all ends that contains it.
    """
    place_of = [place for edge in edges for place in edge]
    if not all(allows(place, ()) for place in set(place_of)):
        return False
    rings = _on_rings(place_of)
    ends_at: dict[Place, list[int]] = {}
    for end, place in enumerate(place_of):
        if end // 2 in rings:
            ends_at.setdefault(place, []).append(end)
    orders = {
        place: clockwise_orders(ends, partial(allows, place)) for place, ends in ends_at.items()
    }

    def drawn(before: dict[Place, Ends], place: Place) -> Iterator[dict[Place, Ends]]:
        """Draw one more place, in each order in which its edges to drawn places do not cross."""
        found = ({**before, place: order} for order in orders[place])
        return (more for more in found if is_planar(_between(more, place_of)))

    nothing: dict[Place, Ends] = {}
    return has_way(nothing, _from_near_to_far(ends_at, place_of), drawn)


def _from_near_to_far(
    ends_at: Mapping[Place, Sequence[int]], place_of: Sequence[Place]
) -> list[Place]:
    """Sort places so that each has most of its edges to earlier places, if they are connected."""
    found: dict[Place, None] = {}
    while len(found) < len(ends_at):
        near = {
            place: sum(place_of[end ^ 1] in found for end in ends)
            for place, ends in ends_at.items()
            if place not in found
        }
        found[max(near, key=lambda place: near[place])] = None
    return list(found)


def _between(drawn: Mapping[Place, Ends], place_of: Sequence[Place]) -> dict[Place, Ends]:
    """Return the clockwise orders around drawn places, of the ends of edges between them."""
    return {
        place: tuple(end for end in ends if place_of[end ^ 1] in drawn)
        for place, ends in drawn.items()
    }


def _on_rings(place_of: Sequence[Place]) -> set[int]:
    """Return the edges that are in no dead end, as dead ends fit into any drawing."""
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


def clockwise_orders(
    ends: Sequence[End], allows: Callable[[tuple[End, ...]], bool]
) -> list[tuple[End, ...]]:
    """List the clockwise orders of some ends that are allowed. Each begins with the first end.

    If `allows` rejects an order, it must also reject each order of more ends that contains it.
    """
    orders: list[tuple[End, ...]] = [()]
    for end in ends:
        longer = (
            (*order[:gap], end, *order[gap:])
            for order in orders
            for gap in range(min(1, len(order)), len(order) + 1)
        )
        orders = [order for order in each_looking(longer) if allows(order)]
    return orders


def has_way(
    start: State, steps: Sequence[Step], ways: Callable[[State, Step], Iterator[State]]
) -> bool:
    """Whether some choice of one way for each step leads through all steps.

    `ways` yields the states to which a step can lead from a state. This is a depth-first search
    without recursion, because there may be many steps.
    """
    gone: list[Iterator[State]] = []
    state = start
    while len(gone) < len(steps):
        look_at_clock()
        gone.append(ways(state, steps[len(gone)]))
        while (following := next(gone[-1], None)) is None:
            look_at_clock()
            gone.pop()
            if not gone:
                return False
        state = following
    return True
