"""The order of the places along one path, from the list in a map and from travels."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterable, Mapping, Sequence
from graphlib import CycleError, TopologicalSorter

from ssh_abduction.checker.moves import Move


class Order:
    """The order of the places along one path, in directions +1 and -1.

    If the axioms demand a total order, this is the order that the map lists. Otherwise it has only
    the pairs that travels imply. A list always shows an order that is asymmetric and transitive. So
    if one of these two axioms is left out and a travel contradicts the list, the travel decides.
    Without the axiom on_path no place is known to be on the path, so the list is not used.

    Args:
        listed: The places as the map lists them, in direction +1.
        travels: For pairs (p, q) of places, a travel that shows that p comes before q in
            direction +1.
        axioms: Names of the axioms that hold.

    Attributes:
        listed: The argument `listed`.
        travels: The argument `travels`.
        position: The position of each listed place in the list, from 0.
        backward: The pairs of `travels` that the list has the other way round, or does not have.
        rings: Lists of places. Travels lead from each place to the next, and from the last to the
            first.
        can_be_listed: Whether the axioms demand an order that a list can show.
    """

    def __init__(
        self, listed: Sequence[int], travels: Mapping[tuple[int, int], Move], axioms: frozenset[str]
    ) -> None:
        self.listed, self.travels = listed, travels
        self.position = {p: i for i, p in reversed(list(enumerate(listed)))}
        self._total = {"path_order_total", "on_path"} <= axioms
        self._asymmetric = "order_asymmetric" in axioms
        self._transitive = "order_transitive" in axioms
        self._next: dict[int, defaultdict[int, dict[int, None]]] = {
            1: defaultdict(dict),
            -1: defaultdict(dict),
        }
        for p, q in travels:
            self._next[1][p][q] = self._next[-1][q][p] = None
        # travels whose places the list does not have in this order
        self.backward = [
            (p, q)
            for p, q in travels
            if self.position.get(p, len(listed)) >= self.position.get(q, -1)
        ]
        self.rings = self._rings()
        self.can_be_listed = self._asymmetric and self._transitive
        self._is_listed = self._total and (self.can_be_listed or not self.backward)

    def _rings(self) -> list[list[int]]:
        """Find the rings. Each has a travel that contradicts the list, so only these are tried."""
        try:
            TopologicalSorter(self._next[1]).prepare()
        except CycleError:
            rings = [ring for p, q in self.backward if (ring := self._way_back(p, q))]
            return list({frozenset(ring): ring for ring in reversed(rings)}.values())[::-1]
        return []

    def allows(self, ring: Sequence[int]) -> bool:
        """Tell whether the axioms let these places follow each other in a ring."""
        return not self._asymmetric or (not self._transitive and len(ring) > 2)

    def after(self, p: int, direction: int) -> Iterable[int]:
        """Find the places after p on the path, in this direction (+1 or -1)."""
        if self._is_listed:
            return self._later(p, direction)
        follows = self._follows(p, direction)
        if not self._transitive:
            return follows
        reached = dict.fromkeys(follows)
        queue = deque(reached)
        while queue:
            new = [q for q in self._follows(queue.popleft(), direction) if q not in reached]
            reached.update(dict.fromkeys(new))
            queue.extend(new)
        return reached

    def between(self, p: int, q: int, direction: int) -> set[int]:
        """Find the places after p and before q on the path, in this direction (+1 or -1)."""
        i, j = self.position.get(p), self.position.get(q)
        agrees = self._is_listed or not self.backward
        if agrees and i is not None and j is not None and abs(i - j) <= 1:
            return set()  # neighbours in the list: no need to walk along the path
        return set(self.after(p, direction)) & set(self.after(q, -direction)) - {p, q}

    def _way_back(self, p: int, q: int) -> list[int]:
        """Find a shortest way along travels from q to p, as places; empty if there is none."""
        came: dict[int, int | None] = {q: None}
        queue = deque([q])
        while queue and p not in came:
            here = queue.popleft()
            new = [r for r in self._next[1].get(here, ()) if r not in came]
            came.update(dict.fromkeys(new, here))
            queue.extend(new)
        way: list[int] = []
        place: int | None = p if p in came else None
        while place is not None:
            way.append(place)
            place = came[place]
        return way[::-1]

    def ring_steps(self, ring: Sequence[int]) -> list[int]:
        """List the steps of the travels that put places in a circular order.

        Args:
            ring: The places. A travel leads from each to the next, and from the last to the first.
        """
        edges = zip(ring, [*ring[1:], ring[0]], strict=True)
        return [step for edge in edges for step in self.travels[edge].steps]

    def _later(self, p: int, direction: int) -> Sequence[int]:
        """Find the places after p in the list, or before it if the direction is -1."""
        i = self.position.get(p)
        if i is None:
            return ()
        return self.listed[i + 1 :] if direction == 1 else self.listed[:i]

    def _follows(self, p: int, direction: int) -> list[int]:
        """Find the places that travels or the list put after p.

        The list is used only if the order is total. If a travel contradicts it, the travel decides.
        """
        travelled = self._next[direction].get(p, {})
        later = self._later(p, direction) if self._total else ()
        return [
            *travelled,
            *(q for q in later if q not in travelled and p not in self._next[direction].get(q, ())),
        ]
