"""Finds small maps of the causal theory without a search: it merges steps by evidence.

>>> from ssh_abduction.solver.steps.chart import Chart
>>> from ssh_abduction.solver.sources.symbolic.merging import merged
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
Steps that fit several known dstates are merged if the evidence for one of these is clearly the
greatest. A step that fits no known dstate becomes one.

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

from ssh_abduction.data.groups import numbered
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.solver.steps.apart import Matrix
from ssh_abduction.solver.steps.chart import Chart, Link

# The demands on the merge of a step with a known dstate, from strict to lenient. The first number
# is by how much its evidence has to exceed that for the next best merge of the step. The second
# number is how many known dstates may fit the step at most. The last demand allows anything.
DEMANDS = (
    (10, 1),
    (5, 1),
    (5, 2),
    (3, 1),
    (3, 3),
    (2, 2),
    (2, 10),
    (1, 3),
    (1, 100),
    (0, 1),
    (0, 2),
    (0, 10**9),
)
# When a map is thinned, the evidence for a merge of two known dstates has to exceed that for the
# next best merge by these numbers. They are tried in this order.
THINNED = 10, 5, 3, 0


def merged(chart: Chart, clique: Iterable[int] = (), guess: Sequence[int] = ()) -> list[int]:
    """Return the dstate of each node of a chart in a small map of the causal theory.

    The nodes of the clique are pairwise distinct. The map is near the guess, if one is given: a
    label for each node, or -1. A label is ignored if the node cannot be one dstate with earlier
    nodes of that label. All other nodes are merged by evidence. Dstates are numbered in the order
    of their first nodes.
    """
    classes = Classes(chart.apart(), chart.links)
    classes.known[list(clique)] = True
    classes.take(guess)
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
            np.asarray(chart.seen)[first].tolist(), links, np.bincount(dstates).tolist(), excluded
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

    This merges as `dstates_merged` does, but needs no chart. `shows` has the view of each dstate,
    and `visits` the number of its nodes. Links are triples (dstate, action, dstate). `excluded`
    pairs must not be merged. A dstate that was not merged represents itself.
    """
    apart = _apart_in_map(np.asarray(shows), links, excluded)
    classes = Classes(apart, links, np.asarray(visits))
    classes.known[:] = True
    classes.thin_all()
    root: list[int] = classes.root.tolist()
    return root


def _apart_in_map(
    seen: NDArray[np.int_], links: Sequence[Link], excluded: Sequence[tuple[int, int]]
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


class Classes:
    """Classes of steps that are taken to be one dstate.

    Some classes are *known* dstates. Each other class is later merged with one of these, or becomes
    a known dstate. A merge of two classes also merges the classes that the same actions lead to
    from both, and so on. A merge of steps that are apart is undone.

    Attributes:
        root: For each step, the step that represents its class.
        known: For each root, whether its class is a known dstate.
    """

    def __init__(
        self, apart: Matrix, links: Iterable[Link], nodes: NDArray[np.int_] | None = None
    ) -> None:
        """Begin with a class for each step.

        `apart` flags the pairs of steps that are different dstates, in a matrix of steps x steps.
        Links are triples (step, action, step). If the "steps" are dstates of a map, `nodes` has the
        number of nodes at each; None for 1 each.
        """
        steps = len(apart)
        self._nodes = nodes
        self.root = np.arange(steps)
        self.known = np.zeros(steps, dtype=bool)
        # The row of each root has the steps that are apart from some step of its class.
        self._apart = apart.copy()
        self._members: list[NDArray[np.int_]] = [np.array([t]) for t in range(steps)]
        # For each root, a step that each action leads to.
        self._leads: list[dict[int, int]] = [{} for _ in range(steps)]
        for t, action, u in links:
            self._leads[t][action] = u
        # The values before the last call of `merge`, to undo it.
        self._undo: list[
            tuple[int, int, bool, NDArray[np.bool_], dict[int, int], NDArray[np.int_]]
        ] = []

    def take(self, guess: Sequence[int]) -> None:
        """Merge the steps that share a label in a guess, if they can be one dstate.

        Their classes become known dstates. The label is -1 where it is unknown.
        """
        first = {label: node for node, label in reversed(list(enumerate(guess))) if label >= 0}
        self.known[list(first.values())] = True
        for node, label in enumerate(guess):
            look_at_clock()
            if label >= 0:
                self.merge(first[label], node)

    def settle_all(self) -> None:
        """Merge classes with known dstates, or make them known, until every class is known."""
        for evidence, rivals in DEMANDS:
            while self._settle(evidence, rivals):
                pass

    def thin_all(self) -> None:
        """Merge known dstates until no two of them can be one."""
        for evidence in THINNED:
            while self._thin(evidence):
                pass

    def _settle(self, evidence: int, rivals: int) -> bool:
        """Merge each class that is not known with its best known dstate, if that is clear enough.

        A class that fits no known dstate becomes known. The classes that fit the fewest known
        dstates come first. The evidence for the best dstate has to exceed that for the next by
        `evidence`. A class that fits more than `rivals` known dstates is left as it is. Returns
        whether anything changed.
        """
        has_changed = False
        steps = np.flatnonzero(~self.known[self.root])
        fitting = (~self._apart[np.flatnonzero(self.known)][:, steps]).sum(axis=0)
        for t in steps[np.argsort(fitting, kind="stable")].tolist():
            look_at_clock()
            root = int(self.root[t])
            if self.known[root]:
                continue
            fits = self._fitting(root)
            if len(fits) > rivals:
                continue
            ranked = self._ranked(root, fits)
            if not ranked:
                self.known[root] = has_changed = True
            elif _is_ahead(ranked, evidence):
                self.merge(ranked[0][1], root, forced=True)
                has_changed = True
        return has_changed

    def _thin(self, evidence: int) -> bool:
        """Merge each known dstate with another one, if the evidence for that one is clear enough.

        Dstates with the fewest nodes come first. The evidence for the best dstate has to exceed
        that for the next by `evidence`. Returns whether any were merged.
        """
        has_merged = False
        nodes = np.bincount(self.root, self._nodes)
        for root in sorted(np.flatnonzero(self.known).tolist(), key=lambda root: nodes[root]):
            look_at_clock()
            if self.known[root]:  # it was not merged meanwhile
                ranked = self._ranked(
                    root, [dstate for dstate in self._fitting(root) if dstate != root], forced=True
                )
                if ranked and _is_ahead(ranked, evidence):
                    self.merge(ranked[0][1], root, forced=True)
                    has_merged = True
        return has_merged

    def _fitting(self, root: int) -> list[int]:
        """List the known dstates that each step of a root's class may be at."""
        known = np.flatnonzero(self.known)
        fits: list[int] = known[
            ~self._apart[np.ix_(known, self._members[root])].any(axis=1)
        ].tolist()
        return fits

    def _ranked(
        self, root: int, fits: Sequence[int], *, forced: bool = False
    ) -> list[tuple[int, int]]:
        """Rank possible merges of a class with dstates: pairs (evidence, dstate), best first."""
        found = []
        for dstate in fits:
            evidence = self.merge(dstate, root, forced=forced)
            if evidence is not None:
                found.append((evidence, dstate))
                self._take_back()
        return sorted(found, reverse=True)

    def merge(self, a: int, b: int, *, forced: bool = False) -> int | None:
        """Merge the classes of two roots, and all classes that have to be merged with them.

        Returns the evidence. If this would merge steps that are apart, or two known dstates without
        `forced`, it returns None, and nothing has changed.
        """
        self._undo = []
        work = [(a, b)]
        confirmed = 0
        while work:
            a, b = (int(self.root[t]) for t in work.pop())
            if a == b:
                confirmed += 1
                continue
            both_known = self.known[a] and self.known[b]
            if (both_known and not forced) or self._apart[a, self._members[b]].any():
                self._take_back()
                return None
            # Keep the class that is known. If none is, keep the larger one.
            if self.known[b] or (
                not self.known[a] and len(self._members[a]) < len(self._members[b])
            ):
                a, b = b, a
            leads, more = self._leads[a], self._leads[b]
            self._undo.append(
                (a, b, bool(self.known[b]), self._apart[a].copy(), leads, self._members[a])
            )
            self.known[b] = False
            work += [(leads[action], t) for action, t in more.items() if action in leads]
            self._leads[a] = more | leads
            self._apart[a] |= self._apart[b]
            self.root[self._members[b]] = a
            self._members[a] = np.concatenate([self._members[a], self._members[b]])
        return confirmed + len(self._undo)

    def _take_back(self) -> None:
        """Undo the last merge."""
        for a, b, known, apart, leads, members in reversed(self._undo):
            self._apart[a], self._leads[a], self._members[a] = apart, leads, members
            self.known[b] = known
            self.root[self._members[b]] = b
        self._undo = []


def _is_ahead(ranked: Sequence[tuple[int, int]], evidence: int) -> bool:
    """Whether the evidence for the best merge exceeds that for the next best by this much."""
    return ranked[0][0] >= evidence + (ranked[1][0] if len(ranked) > 1 else 0)
