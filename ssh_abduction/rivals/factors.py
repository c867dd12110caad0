"""Which questions decide between maps, and which of them are independent of each other.

A question is a column of truth values, one a map. Some questions *decide* if no two maps give the
same answers to all of them. They are chosen greedily: next comes the question that splits most
pairs of maps that are not told apart yet, and of equal ones the earliest; then those are dropped
again that the others make superfluous. No question can be left out of what remains, but a smaller
choice may exist: to find the smallest is NP-hard (minimum test set, Garey & Johnson 1979, SP6).

Maps, as answers to questions, are a set of rows. A choice is a set of questions, its *options* are
the different answers to these. Choices are *independent* if each combination of their options is a
map, so that the numbers of their options, multiplied, give the number of maps. There is one finest
division of the questions into independent choices, and it is found so: a smallest set of choices
that are not independent of each other, no part of which is dependent, lies within one choice of
that division (if two independent ones shared it, its parts would be independent, and so would be
the whole). So its members are made one, until all are independent.

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

from ssh_abduction.rivals.table import Bools


def deciding(columns: Sequence[Bools] | Bools, maps: int, tiers: Sequence[int] = ()) -> list[int]:
    """Questions that tell all maps apart which questions can tell apart, chosen greedily, in the order in which they are chosen. None is superfluous.

    columns  for each question, the most important first where they split equally, what each of the
    maps answers
    tiers    for each question its tier: those of a higher one are asked only once those of lower
        ones tell nothing more apart. One tier by default
    """
    groups = np.zeros(maps, dtype=np.intp)
    # What a question splits becomes less as others are asked. So it need be counted again only when
    # it seems to be the best one.
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
    """The finest division of questions into independent choices. The choices come in the order of their first questions.

    columns  for each question, what each of the maps answers; maps that give the same answers
    throughout count once
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
    """For each map the number of its answers to some questions, from 0: maps of one number answer all of them alike. Numbers are in the order of the maps."""
    if not len(columns):
        return np.zeros(maps, dtype=np.intp)
    packed = np.packbits(np.asarray(columns, dtype=bool), axis=0)
    _, first, inverse = np.unique(packed, axis=1, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.intp)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[inverse.reshape(-1)]


def _split(column: Bools, groups: NDArray[np.intp]) -> int:
    """How many pairs of maps of one group give different answers."""
    sizes = np.bincount(groups)
    yes = np.bincount(groups, weights=column).astype(np.int64)
    return int((yes * (sizes - yes)).sum())


def _linked(table: Bools) -> list[list[int]]:
    """Questions put together of which two depend on each other: the answers to both are not as frequent as they are where each is given with each."""
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
    """A set of choices that are not independent, of which each smaller part is; None where all are independent."""

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
