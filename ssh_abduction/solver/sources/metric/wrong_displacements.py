"""Find wrong displacements by a best-first search over sets of them.

After a wrong displacement the pose is unknown, so a beam of hypotheses may drop the best map there.
If it is given which displacements are wrong, even a narrow beam mostly finds the best map, once its
places are merged further. So this is a search over sets of wrong displacements. It begins with
those of the best known map. One more or one less makes a neighbour. The neighbours come first for
which the map of the first set, with the same dstates and places, would cost least. If the map of a
neighbour costs less than that of the first set, its own neighbours are tried, too.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Collection, Iterable

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.solution.weighed import EQUAL
from ssh_abduction.theory.evidence.displacement import jumped


def search_jumps(
    trace: Trace,
    maps_without: Callable[[Collection[int]], Iterable[SSHMap]],
    refit: Callable[[SSHMap, Collection[int]], float],
    best: SSHMap,
    add: Callable[[SSHMap], float],
) -> None:
    """Try sets of wrong displacements near those of a map, the most promising first.

    `maps_without` lists maps in which the displacements to some steps are wrong. `refit` returns
    the cost of a map in nats if other displacements are wrong. `add` keeps a map, and returns its
    cost. Raises LimitError if the time is over.
    """
    steps = [t for t, step in enumerate(trace.steps) if step.displacement is not None]
    first = frozenset(jumped(best))
    seen, coming = {first}, list[tuple[float, list[int], float]]()

    def expand(wrong: frozenset[int], known: SSHMap, nats: float) -> None:
        """Let the neighbours of a set follow, with the cost of its map."""
        for near in {wrong ^ {t} for t in steps} - seen:
            heapq.heappush(coming, (refit(known, near), sorted(near), nats))
            seen.add(near)

    expand(first, best, add(best))
    while coming:
        _, chosen, nats = heapq.heappop(coming)
        found = {add(one): one for one in maps_without(chosen)}
        if found and min(found) < nats - EQUAL:
            expand(frozenset(chosen), found[min(found)], min(found))
