"""Find questions that decide between maps, and divide them into independent choices.

A question is a column of truth values: the answer of each map. A set of questions *decides* if no
two maps give the same answers to all of them. Questions are chosen greedily: the next one
distinguishes the most pairs of maps that are not distinguished yet, and ties go to the earliest.
Then superfluous questions are dropped. A smaller set may exist, but finding the smallest one is
NP-hard (minimum test set, Garey & Johnson 1979, SP6).

A *choice* is a set of questions, and its *options* are the different answers that maps give to
them. Choices are *independent* if each combination of their options is a map. Then the number of
maps is the product of the numbers of options. There is exactly one finest division of questions
into independent choices.

The finest division is found by merging. Start with small choices. If they are not all independent,
find a minimal set of dependent choices, merge its members, and repeat. The merged members belong to
one choice of the finest division. Otherwise two independent choices would split the set into two
parts. Each part is independent, as the set is minimal, so the whole set would be independent.

>>> import numpy as np
>>> rows = np.array([[0, 0, 0], [0, 1, 1], [1, 0, 0], [1, 1, 1]], dtype=bool)
>>> deciding(rows.T, 4)
[0, 1]
>>> independent(rows.T)
[[0], [1, 2]]
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from math import prod

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.rivals.table import Bools, columns_numbered


def deciding(columns: Sequence[Bools] | Bools, maps: int, tiers: Sequence[int] = ()) -> list[int]:
    """Choose questions that distinguish all maps that can be distinguished; none is superfluous.

    `columns` has, for each question, the answers of all maps. Earlier questions win ties. `tiers`
    ranks the questions; by default all have one rank. A question is chosen only when those of lower
    ranks distinguish no further maps. Return the indices of the questions, in the order of choice.
    """
    groups = np.zeros(maps, dtype=np.intp)
    # A question distinguishes ever fewer new pairs as others are chosen. So its pairs are counted
    # again only when it is at the top of the heap.
    waiting = [
        (tier, -_split(column, groups), i)
        for i, (column, tier) in enumerate(zip(columns, tiers or [0] * len(columns), strict=True))
    ]
    heapq.heapify(waiting)
    chosen: list[int] = []
    while waiting:
        tier, _, i = heapq.heappop(waiting)
        now = (tier, -_split(columns[i], groups), i)
        if not now[1]:
            continue
        if waiting and now > waiting[0]:
            heapq.heappush(waiting, now)
            continue
        chosen.append(i)
        _, groups = np.unique(groups * 2 + columns[i], return_inverse=True)
    for i in reversed(chosen):
        others = [j for j in chosen if j != i]
        if options_of([columns[j] for j in others], maps).max(initial=0) == groups.max(initial=0):
            chosen = others
    return chosen


def independent(columns: Sequence[Bools] | Bools) -> list[list[int]]:
    """Divide questions into the finest independent choices.

    `columns` has the answers of all maps for each question. Maps with equal answers count once.
    A choice is a list of indices of questions. Choices are sorted by their first question.
    """
    if not len(columns):
        return []
    table = np.unique(np.asarray(columns, dtype=bool), axis=1)
    choices = _linked(table)
    while (
        dependent := _dependent([options_of(table[choice], table.shape[1]) for choice in choices])
    ) is not None:
        merged = sorted(i for k in dependent for i in choices[k])
        choices = sorted(
            [choice for k, choice in enumerate(choices) if k not in dependent] + [merged]
        )
    return choices


def options_of(columns: Sequence[Bools] | Bools, maps: int) -> NDArray[np.intp]:
    """Return the number of each map's option, of shape (maps,).

    An option is a combination of answers. `columns` has the answers of all maps for each question.
    Options are numbered from 0 in the order of the maps.
    """
    if not len(columns):
        return np.zeros(maps, dtype=np.intp)
    return columns_numbered(np.packbits(np.asarray(columns, dtype=bool), axis=0))


def _split(column: Bools, groups: NDArray[np.intp]) -> int:
    """Count the pairs of maps that are in one group but answer a question differently."""
    sizes = np.bincount(groups)
    yes = np.bincount(groups, weights=column).astype(np.int64)
    return int((yes * (sizes - yes)).sum())


def _linked(table: Bools) -> list[list[int]]:
    """Group questions that depend on each other, directly or through others.

    Two questions are independent if the share of maps that answer yes to both is the product of the
    shares that answer yes to each.
    """
    counts = table.astype(np.int64)
    yes, maps = counts.sum(axis=1), table.shape[1]
    waiting = np.arange(len(table))
    choices = []
    while len(waiting):
        choice, frontier, waiting = [int(waiting[0])], [int(waiting[0])], waiting[1:]
        while frontier and len(waiting):
            i = frontier.pop()
            both = counts[waiting] @ counts[i]
            depends = both * maps != yes[waiting] * yes[i]
            found = waiting[depends].tolist()
            choice, frontier, waiting = choice + found, frontier + found, waiting[~depends]
        choices.append(sorted(choice))
    return choices


def _dependent(options: Sequence[NDArray[np.intp]]) -> set[int] | None:
    """Find a minimal set of dependent choices, as indices; None if all are independent."""

    def are_independent(which: Sequence[int]) -> bool:
        together = np.unique(np.stack([options[k] for k in which]), axis=1).shape[1] if which else 1
        return together == prod(int(options[k].max()) + 1 for k in which)

    which = list(range(len(options)))
    if are_independent(which):
        return None
    for k in list(which):
        without = [other for other in which if other != k]
        if not are_independent(without):
            which = without
    return set(which)
