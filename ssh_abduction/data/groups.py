"""Group values by their keys, and nodes by the links between them.

>>> gathered([("a", 1), ("b", 2), ("a", 3)]), firsts([("a", 1), ("b", 2), ("a", 3)])
({'a': [1, 3], 'b': [2]}, {'a': 1, 'b': 2})
>>> numbered("caca"), indices_of("caca"), first_index_of("caca")
([0, 1, 0, 1], {'c': [0, 2], 'a': [1, 3]}, {'c': 0, 'a': 1})
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Iterable
from typing import Generic, TypeVar

Node = TypeVar("Node", bound=Hashable)
Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")
Member = TypeVar("Member")


def gathered(pairs: Iterable[tuple[Key, Value]]) -> dict[Key, list[Value]]:
    """Return the values of each key, in the order of the pairs."""
    found: dict[Key, list[Value]] = {}
    for key, value in pairs:
        found.setdefault(key, []).append(value)
    return found


def firsts(pairs: Iterable[tuple[Key, Value]]) -> dict[Key, Value]:
    """Return the first value of each key."""
    found: dict[Key, Value] = {}
    for key, value in pairs:
        found.setdefault(key, value)
    return found


def numbered(labels: Iterable[Hashable]) -> list[int]:
    """Renumber labels from 0 in the order in which they first occur."""
    number: dict[Hashable, int] = {}
    return [number.setdefault(label, len(number)) for label in labels]


def indices_of(labels: Iterable[Key]) -> dict[Key, list[int]]:
    """Return the indices at which each label occurs."""
    return gathered((label, i) for i, label in enumerate(labels))


def first_index_of(labels: Iterable[Key]) -> dict[Key, int]:
    """Return the index at which each label first occurs."""
    return firsts((label, i) for i, label in enumerate(labels))


def reached(starts: Iterable[Node], beside: Callable[[Node], Iterable[Node]]) -> dict[Node, None]:
    """Find the nodes that links from `starts` reach, including `starts`, the nearest first.

    `beside` gives the nodes to which links of a node lead. The result is a dict whose keys are the
    nodes.
    """
    found = dict.fromkeys(starts)
    waiting = list(found)
    for node in waiting:  # the list grows
        new = dict.fromkeys(other for other in beside(node) if other not in found)
        found |= new
        waiting += new
    return found


def way(start: Node, goal: Node, beside: Callable[[Node], Iterable[Node]]) -> list[Node]:
    """Find a shortest way along links, from `start` to `goal`; empty if there is none."""
    came: dict[Node, Node | None] = {start: None}
    waiting = [start]
    for node in waiting:  # the list grows
        new = [other for other in beside(node) if other not in came]
        came |= dict.fromkeys(new, node)
        waiting += dict.fromkeys(new)
    found: list[Node] = []
    at: Node | None = goal if goal in came else None
    while at is not None:
        found.append(at)
        at = came[at]
    return found[::-1]


def linked(pairs: Iterable[tuple[Node, Node]]) -> dict[Node, dict[Node, None]]:
    """Return the nodes beside each node with a link. A pair is a link, which leads both ways."""
    beside: dict[Node, dict[Node, None]] = {}
    for one, other in pairs:
        beside.setdefault(one, {})[other] = None
        beside.setdefault(other, {})[one] = None
    return beside


def parts(nodes: Iterable[Node], pairs: Iterable[tuple[Node, Node]]) -> list[Collection[Node]]:
    """Group nodes that links connect. A pair is a link, which leads both ways."""
    found: list[Collection[Node]] = []
    known, beside = set[Node](), linked(pairs)
    for node in nodes:
        if node not in known:
            found.append(reached([node], lambda n: beside.get(n, ())).keys())
            known.update(found[-1])
    return found


class NodeClasses(Generic[Node]):
    """Classes of nodes that count as one. At first, each node is alone."""

    def __init__(self) -> None:
        self._above: dict[Node, Node] = {}

    def of(self, node: Node) -> Node:
        """Return the node that stands for the class of a node."""
        while (above := self._above.get(node, node)) != node:
            self._above[node] = node = self._above.get(above, above)
        return node

    def merge(self, first: Node, second: Node) -> None:
        """Merge the classes of two nodes. The node that stands for the first one remains."""
        one, other = self.of(first), self.of(second)
        if one != other:
            self._above[other] = one

    def are_one(self, first: Node, second: Node) -> bool:
        """Whether two nodes are in one class."""
        return self.of(first) == self.of(second)

    def merge_with_links(
        self, pairs: Iterable[tuple[Node, Node]], links: Collection[tuple[Node, str, Node]]
    ) -> None:
        """Merge pairs of nodes, and what links of one name lead to from one class.

        A link is its first node, its name, and its last node.
        """
        waiting = [*pairs]
        while waiting:
            for first, second in waiting:
                self.merge(first, second)
            led: dict[tuple[Node, str], Node] = {}
            ends = [(led.setdefault((self.of(s), name), x), x) for s, name, x in links]
            waiting = [pair for pair in ends if not self.are_one(*pair)]


def minimal_part(suffices: Callable[[list[Member]], bool], members: list[Member]) -> list[Member]:
    """Find a minimal subset of the members for which `suffices` is true.

    It has to be true for all members. If it is true for a set, it has to be true for each larger
    set.

    Reference:
        Junker 2004, "QuickXplain: preferred explanations and relaxations for over-constrained
        problems".
    """

    def needed(kept: list[Member], is_new: bool, rest: list[Member]) -> list[Member]:
        if is_new and suffices(kept):
            return []
        if len(rest) == 1:
            return rest
        first, second = rest[: len(rest) // 2], rest[len(rest) // 2 :]
        of_second = needed(kept + first, True, second)
        of_first = needed(kept + of_second, bool(of_second), first)
        return of_first + of_second

    return needed([], False, members)
