"""Finds the fewest places for given dstates without a search, for the engine without frames.

Some places are pairwise distinct. If a map has only these places, no map has fewer. This module
narrows down the search for such a map.

As an example, take a corridor of forty landmarks, driven there and back. The dstates are found at
once. The places of the way there follow each other on one path, so they are forty distinct places.
No map has fewer places. But to prove that the way back needs no other places is a pigeonhole
problem, and it takes clasp minutes.

So this module finds a large clique of pairwise distinct places, which are called *fixed*. Suppose
that a map has only as many places as there are fixed ones. Then each other place equals a
fixed place, its *home*. If a place comes after another along a path, its home comes after the home
of the other. This leaves few possible homes. In the corridor each place has only one.

Clingo then tries only these homes. If it finds a map, this map has the fewest places, and all
minimal maps use these homes. If it finds none, the supposition was wrong, and clingo tries all ways
to merge places (`frameless_paths.py`).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.groups import gathered
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.solver.sources.exact.path_facts import Segments
from ssh_abduction.solver.steps.apart import pairwise_distinct


def homes_of(segments: Segments) -> Mapping[int, list[int]] | None:
    """Find the possible homes of each place, if a map has only as many places as fixed ones.

    Fixed places are pairwise distinct. Homes of a place are the fixed places that it may equal.
    Returns None if some place has none, or if no places fit these dstates at all.
    """
    if any(c == p for c, p in segments.elsewhere):
        return None  # the segments contradict each other: no places fit these dstates
    places = segments.places
    number = {place: i for i, place in enumerate(places)}
    different = np.zeros((len(places), len(places)), dtype=bool)
    for c, p in segments.elsewhere:
        different[number[c], number[p]] = different[number[p], number[c]] = True
    fixed = pairwise_distinct(places, segments.elsewhere)
    columns = [number[place] for place in fixed]
    may_be = ~different[:, columns]
    may_be[columns] = np.eye(len(fixed), dtype=bool)
    steps = [(segment, number[c], number[b]) for segment, c, b in segments.travels]
    travels = gathered((segment, (c, b)) for segment, c, b in steps)
    follows = {segment: _may_follow(pairs, columns) for segment, pairs in travels.items()}
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


def fewest_paths(segments: Segments) -> int:
    """Return a lower bound on the number of paths: how many segments are on different paths."""
    return len(pairwise_distinct(segments.segments, segments.distinct))


def _may_follow(pairs: list[tuple[int, int]], columns: list[int]) -> NDArray[np.bool_]:
    """Find which fixed places may come after each other on the path of a segment.

    A segment is a set of steps known to be along one path.

    Args:
        pairs: For each travel of the segment, the places where it begins and ends.
        columns: The numbers of the f fixed places.

    Returns:
        Whether fixed place j may come after fixed place i, at [i, j], (f, f).
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
