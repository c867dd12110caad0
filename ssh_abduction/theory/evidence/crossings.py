"""Shrink a set of travels and turns whose edges cross, and describe it by equalities of steps."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import combinations

from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.theory.evidence.protocol import Equality


def fewest(moves: list[int], cross: Callable[[list[int]], bool]) -> list[int]:
    """Return a minimal subset of the travels and turns that still crosses.

    Args:
        moves: The steps at which they begin.
        cross: Returns whether the edges of such a subset cross.
    """
    size = max(1, len(moves) // 2)
    while True:
        begin = 0
        while begin < len(moves):
            look_at_clock()
            fewer = moves[:begin] + moves[begin + size :]
            if cross(fewer):
                moves = fewer
            else:
                begin += size
        if size == 1:
            return moves
        size //= 2


def split(
    labels: Mapping[int, int], steps: Sequence[int], cross: Callable[[Mapping[int, int]], bool]
) -> Mapping[int, int]:
    """Give each of these steps a dstate of its own, unless the edges then no longer cross.

    Args:
        labels: The dstate of each step.
        steps: The steps.
        cross: Returns whether edges cross if the steps have some labels.

    Returns:
        The new labels.
    """
    new = max(labels.values()) + 1
    for step in steps:
        look_at_clock()
        finer = {**labels, step: new + step}
        if cross(finer):
            labels = finer
    return labels


def description(
    labels: Mapping[int, int], at: Mapping[int, int], steps: Sequence[int], distinct: bool
) -> Iterator[Equality]:
    """Yield which of these steps are one dstate or at one place, and which are not.

    Args:
        labels: The dstate of each step.
        at: The place of each step.
        steps: The steps.
        distinct: Whether to yield that dstates at one place are different.
    """
    first: dict[int, int] = {}  # the first step of each dstate
    for step in steps:
        if first.setdefault(labels[step], step) != step:
            yield Equality(first[labels[step]], step)
    visits: dict[int, list[int]] = {}  # for each place, the first step of each of its dstates
    for step in first.values():
        visits.setdefault(at[step], []).append(step)
    for here in visits.values():
        yield from (Equality(here[0], step, "place") for step in here[1:])
        yield from (Equality(i, j, holds=False) for i, j in combinations(here, 2) if distinct)
    yield from (
        Equality(i[0], j[0], "place", holds=False) for i, j in combinations(visits.values(), 2)
    )
