"""Finds small maps of the causal theory without a search: it merges steps by evidence.

>>> from ssh_abduction.solver.steps.chart import Chart
>>> from ssh_abduction.solver.guesses.merging import merged
>>> links = ((0, 0, 1), (1, 0, 2), (2, 0, 3))
>>> merged(Chart((0, 1, 0, 1), links, range(4)), [0, 1])
[0, 1, 0, 1]

Two steps are *apart* if they are known to be different dstates. At first, the steps of a clique,
which are pairwise apart, are *known* dstates. All other steps are merged with known dstates.

If two steps are one dstate, then so are the steps that the same action leads to from both, and so
on. All of these are merged. If two of them are apart, nothing is merged. The more steps a merge
affects without a contradiction, the less likely it is wrong. So the *evidence* for a merge is the
number of classes that it merges, plus the number of earlier merges that it confirms. Steps that fit
only one known dstate, with much evidence, are merged first. Then come steps with less evidence.
Steps that fit several known dstates come if the evidence for one dstate is clearly the greatest. A
step that fits no known dstate becomes one.

A guess is completed in the same way. First, nodes with one label in the guess are merged if they
can be one dstate. They become known dstates.

A map is thinned in the same way. The dstates with the fewest nodes are merged first, each with the
dstate for which there is most evidence, while the result is still a map.

This is evidence-driven state merging (Lang, Pearlmutter, Price 1998, "Results of the Abbadingo One
DFA Learning Competition"). It is applied to one trace, and it begins at known dstates all over the
trace instead of at a root.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.solver.guesses.classes import Classes
from ssh_abduction.solver.steps.apart import Matrix
from ssh_abduction.solver.steps.chart import Chart, Link, numbered


def merged(
    chart: Chart, clique: Iterable[int] = (), guess: Sequence[int] = (), *, settles: bool = True
) -> list[int]:
    """Return the dstate of each node of a chart in a small map of the causal theory.

    The nodes of the clique are pairwise distinct. The map is near the guess, if one is given: a
    label for each node, or -1. A label is ignored if the node cannot be one dstate with earlier
    nodes of that label. Unless the rest `settles`, all other nodes are dstates of their own, if the
    links allow that. Dstates are numbered in the order of their first nodes.
    """
    classes = Classes(chart.apart(), chart.links)
    classes.known[list(clique)] = True
    classes.take(guess)
    if settles:
        classes.settle_all()
    return numbered(classes.root.tolist())


def dstates_merged(chart: Chart, labels: Sequence[int]) -> list[int]:
    """Merge dstates of a map of a chart until no two can be one.

    Dstates with the fewest nodes are merged first, each with the dstate for which there is most
    evidence.
    """
    dstates = numbered(labels)
    first = np.unique(dstates, return_index=True)[1]
    links = list(dict.fromkeys((dstates[t], action, dstates[u]) for t, action, u in chart.links))
    excluded = [(dstates[i], dstates[j]) for i, j in chart.excluded]
    root = np.array(
        thinned_map(
            np.asarray(chart.seen)[first].tolist(),
            links,
            np.bincount(dstates).tolist(),
            excluded,
        )
    )
    return numbered(root[dstates].tolist())


def thinned_map(
    shows: Sequence[int],
    links: Sequence[Link],
    visits: Sequence[int],
    excluded: Sequence[tuple[int, int]] = (),
) -> list[int]:
    """Merge dstates of a map until no two can be one, and return which dstate represents each.

    This merges as `dstates_merged` does, but for a map without a chart: with the view of each
    dstate, links (dstate, action, dstate), and the number of nodes at each dstate. `excluded` pairs
    must not be merged. A dstate that was not merged represents itself.
    """
    apart = _apart_in_map(np.asarray(shows), links, excluded)
    classes = Classes(apart, links, np.asarray(visits))
    classes.known[:] = True
    classes.thin_all()
    root: list[int] = classes.root.tolist()
    return root


def _apart_in_map(
    seen: NDArray[np.int_],
    links: Sequence[Link],
    excluded: Sequence[tuple[int, int]],
) -> Matrix:
    """Find the pairs of dstates of a map that are apart, as a matrix of dstates x dstates.

    Two dstates are apart if they show different views, if they are excluded, or if the same action
    leads from them to dstates that are apart.
    """
    leads: dict[int, NDArray[np.int_]] = {}
    for dstate, action, leads_to in links:
        leads.setdefault(action, np.full(len(seen), -1))[dstate] = leads_to
    apart: Matrix = seen[:, None] != seen
    for s, x in excluded:
        apart[s, x] = apart[x, s] = True
    while True:
        look_at_clock()
        before = apart.copy()
        for there in leads.values():
            known = np.flatnonzero(there >= 0)
            apart[np.ix_(known, known)] |= apart[np.ix_(there[known], there[known])]
        if (apart == before).all():
            return apart
