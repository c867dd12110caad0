"""Find wrong displacements by a local search over sets of them.

After a wrong displacement the pose is unknown, so a beam of hypotheses may drop the best map there.
If it is given which displacements are wrong, even a narrow beam mostly finds the best map. So this
is a local search over sets of wrong displacements. It begins with those of the best known map. One
more or one less makes a neighbour, and the neighbours of the cheapest set come first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.solution.weighed import EQUAL
from ssh_abduction.theory.evidence.displacement import jumped

# End after the neighbours of this many sets in turn had no map that costs less than the best one.
IN_VAIN = 3
# Give up a set as soon as its map costs this many nats more than the best one.
BEYOND = 20.0


def search_jumps(
    trace: Trace,
    map_without: Callable[[Collection[int], float], SSHMap | None],
    best: SSHMap,
    add: Callable[[SSHMap], float],
) -> None:
    """Try sets of wrong displacements near those of a map, the cheapest first.

    `map_without` returns a map in which the displacements to some steps are wrong, or None if it
    costs more than some nats.
    `add` keeps a map, and returns its cost in nats. Raises LimitError if the time is over.
    """
    steps = [t for t, step in enumerate(trace.steps) if step.displacement is not None]
    steps.sort(key=lambda t: trace.actions[t - 1].kind != "travel")  # most errors are of travels
    nats = {frozenset(jumped(best)): add(best)}
    opened, in_vain = set[frozenset[int]](), 0
    while in_vain < IN_VAIN and (closed := nats.keys() - opened):
        before, near = min(nats.values()), min(closed, key=lambda wrong: nats[wrong])
        opened.add(near)
        for wrong in (near ^ {t} for t in steps):
            if wrong not in nats:
                found = map_without(wrong, min(nats.values()) + BEYOND)
                nats[wrong] = math.inf if found is None else add(found)
        in_vain = 0 if min(nats.values()) < before - EQUAL else in_vain + 1
