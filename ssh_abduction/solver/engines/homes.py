"""The fewest places for given dstates, if that needs no search.

This serves the engine without frames. If the number of pairwise distinct places is enough for a
map, it finds such a map and proves that no map has fewer places.

In a corridor of forty landmarks, driven there and back, the dstates are known at once. The places
of the way there follow each other on one path, so they are forty different ones. Fewer places will
not do. But clingo has to see that the forty places of the way back cannot be fewer either, and that
is a pigeonhole problem, which takes clasp minutes.

So a clique of places is looked for that are pairwise distinct: they are *fixed*. Suppose that a map
has just as many places. Then each other place is a fixed one, its *home*. Along a path, a place
that comes after another has a home that can come after the home of the other. This leaves few
homes, in a corridor one for each place, and clingo tries only these. If there is such a map, it has
the fewest places, and so have the other minimal maps: all of them are found with the same few
homes. If there is none, nothing was assumed, and all ways to merge places are tried
(`engines/frameless_paths.py`).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.solver.asp.facts.paths_lp import Segments
from ssh_abduction.solver.engines.paths import pairwise_distinct


def homes_of(told: Segments) -> Mapping[int, list[int]] | None:
    """The fixed places that each place may be, if there are no more places than fixed ones.

    None if some place can be no fixed one.

    Args:
        told: What the segments imply about places.
    """
    if any(c == p for c, p in told.elsewhere):
        return None  # the segments contradict each other: no places fit these dstates
    places = told.places
    number = {place: i for i, place in enumerate(places)}
    different = np.zeros((len(places), len(places)), dtype=bool)
    for c, p in told.elsewhere:
        different[number[c], number[p]] = different[number[p], number[c]] = True
    fixed = pairwise_distinct(places, told.elsewhere)
    columns = [number[place] for place in fixed]
    may_be = ~different[:, columns]
    may_be[columns] = np.eye(len(fixed), dtype=bool)
    steps = [(segment, number[c], number[b]) for segment, c, b in told.travels]
    follows = {
        segment: _may_follow(pairs, columns) for segment, pairs in _by_segment(steps).items()
    }
    before = -1
    while before != (before := int(may_be.sum())):
        for segment, c, b in [*steps, *reversed(steps)]:
            look_at_clock()
            may_be[c] &= (follows[segment] & may_be[b]).any(axis=1)
            may_be[b] &= (follows[segment] & may_be[c][:, None]).any(axis=0)
    if not may_be.any(axis=1).all():
        return None
    return {
        place: [fixed[k] for k in np.flatnonzero(row)]
        for place, row in zip(places, may_be, strict=True)
    }


def fewest_paths(told: Segments) -> int:
    """A lower bound on the number of paths: the size of a clique of pairwise distinct segments."""
    return len(pairwise_distinct(told.segments, told.distinct))


def _by_segment(steps: list[tuple[int, int, int]]) -> Mapping[int, list[tuple[int, int]]]:
    found: dict[int, list[tuple[int, int]]] = defaultdict(list)
    for segment, c, b in steps:
        found[segment].append((c, b))
    return found


def _may_follow(pairs: list[tuple[int, int]], columns: list[int]) -> NDArray[np.bool_]:
    """Whether one fixed place may come after another on the path of a segment: fixed x fixed.

    Args:
        pairs: For each travel of the segment, the places that it leads between, in its direction.
        columns: The fixed places.
    """
    members = sorted({place for pair in pairs for place in pair})
    number = {place: i for i, place in enumerate(members)}
    after = np.zeros((len(members), len(members)), dtype=np.float32)
    for c, b in pairs:
        after[number[c], number[b]] = 1
    reached = 0
    while reached != (reached := int(np.count_nonzero(after))):
        after = np.minimum(after + after @ after, 1)
    here = [k for k, place in enumerate(columns) if place in number]
    rows = [number[columns[k]] for k in here]
    follows = ~np.eye(len(columns), dtype=bool)
    follows[np.ix_(here, here)] &= after[np.ix_(rows, rows)].T == 0
    return follows
