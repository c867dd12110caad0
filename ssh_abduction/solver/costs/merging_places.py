"""Make a map cheaper by merging places that are at one position.

A beam of hypotheses goes through the trace once. If a new place was cheaper than a return for some
steps, the best map may have two places where one would do.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import combinations

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.odometry import Odometry
from ssh_abduction.solver.costs.misfit import Misfit
from ssh_abduction.solver.geometry.fit import Poses

# Places may be one if they are at most this many standard deviations of the position of a visit
# apart. The standard deviation is `offset` of the odometry.
NEAR = 5.0


def with_merged_places(
    ssh_map: SSHMap, misfit: Misfit, accepts: Callable[[SSHMap], bool]
) -> SSHMap:
    """Merge two places of a map while this lowers its cost and the result is accepted.

    A map with paths is returned as it is, as the paths at merged places would have to be found.
    """
    nats = misfit.nats_of(ssh_map)
    while not ssh_map.paths:
        for merged in _merged(ssh_map, misfit):
            if (cost := misfit.nats_of(merged)) < nats and accepts(merged):
                ssh_map, nats = merged, cost
                break
        else:
            break
    return ssh_map


def _merged(ssh_map: SSHMap, misfit: Misfit) -> Iterator[SSHMap]:
    """Yield the map with two near places merged, for each such pair, the nearest pair first."""
    near = NEAR * (misfit.trace.odometry or Odometry()).offset
    positions = Poses.of_map(misfit.trace, ssh_map).placed()[1].tolist() if near else []
    at = {s.place: position for s, position in zip(ssh_map.dstates, positions, strict=False)}
    pairs = [(math.dist(at[a], at[b]), a, b) for a, b in combinations(at, 2)]
    for _, kept, gone in sorted(pair for pair in pairs if pair[0] <= near):
        dstates = (replace(s, place=kept if s.place == gone else s.place) for s in ssh_map.dstates)
        places = tuple(place for place in ssh_map.places if place != gone)
        yield replace(ssh_map, dstates=tuple(dstates), places=places).renumbered()
