"""A small map of the causal theory without a search: steps are merged where much speaks for it, in the order of how much.

>>> from ssh_abduction.apart import apartness
>>> from ssh_abduction.merging import merged
>>> merged(apartness([0, 1, 0, 1], [0, 0, 0]), [(0, 0, 1), (1, 0, 2), (2, 0, 3)], [0, 1])
[0, 1, 0, 1]

Steps that are apart are known dstates to begin with. To merge two steps means to merge what the same actions lead to from them, and so on:
all of it is merged, or nothing, if some two are apart. The more two steps have to say about each other, the less likely that is by chance:
the *evidence* is how many merges that makes, and how often it confirms one made before. Steps that fit a single known dstate, with much
evidence, go first; then those with less, or with rivals that have clearly less. A step that fits none is a new dstate.

What is guessed at can be finished in the same way: nodes that a guess has at one dstate are known to begin with, as far as they can be one.
And the dstates of a map are thinned so: those seen least are merged with others, as long as that leaves a map.

This is evidence-driven state merging (Lang, Pearlmutter, Price 1998, "Results of the Abbadingo One DFA Learning Competition") for one
trace, from known dstates all over it rather than from a root.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.apart import Matrix
from ssh_abduction.chart import Link, numbered

# Least evidence for a merge, and how much it has to be ahead of the next; among how many known dstates at most:
DEMANDS = ((10, 1), (5, 1), (5, 2), (3, 1), (3, 3), (2, 2), (2, 10), (1, 3), (1, 100), (0, 1), (0, 2), (0, 1000))

Told: TypeAlias = tuple[Matrix, Sequence[tuple[int, int]]]  # which nodes are apart, and pairs that are one


def merged(apart: Matrix, links: Iterable[Link], clique: Sequence[int], check: Callable[[], None] = lambda: None) -> list[int]:
    """The dstate of each node of a chart in some map, numbered by first node.

    apart   which nodes are apart, nodes x nodes
    links   of the chart
    clique  nodes that are pairwise apart
    check   called now and then; may raise
    """
    classes = _Classes(apart.copy(), links, clique)
    classes.settle_all(check)
    return classes.labels()


def merged_near(apart: Matrix, links: Iterable[Link], guess: Sequence[int], check: Callable[[], None] = lambda: None) -> list[int]:
    """The same near a guess.

    guess  a label of each node; -1 where it is not known. Nodes that cannot be at one dstate with the others of their label leave it
    """
    classes = _from_guess(apart, links, guess)
    classes.settle_all(check)
    return classes.labels()


def merged_as_told(
    apart: Matrix,
    links: Iterable[Link],
    guess: Sequence[int],
    tell: Callable[[Sequence[int], Sequence[int]], Told | None],
    check: Callable[[], None] = lambda: None,
) -> list[int] | None:
    """The same, where more is told on the way. None where that contradicts.

    tell  is asked what follows from labels of all nodes, and which of these are still open, whenever they have changed; None: they contradict
    """
    classes = _from_guess(apart, links, guess)
    agrees = classes.settle_all(check, lambda: classes.heed(tell(classes.labels(), classes.unsettled().tolist())))
    return classes.labels() if agrees else None


def kept(apart: Matrix, links: Iterable[Link], guess: Sequence[int]) -> list[int]:
    """The same where nothing is merged but what has to be: what is not known, or leaves its label, is something new."""
    return _from_guess(apart, links, guess).labels()


def thinned(apart: Matrix, links: Iterable[Link], labels: Sequence[int], check: Callable[[], None] = lambda: None) -> list[int]:
    """The dstate of each node in a map where no two dstates of this one are left that could be one.

    Those seen at the fewest nodes are merged first, each with that for which the evidence is most. Parameters as above; the labels are those of a map.
    """
    classes = _from_guess(apart, links, labels)
    nodes = np.bincount(classes.root)
    for root in sorted(np.flatnonzero(classes.known).tolist(), key=lambda root: int(nodes[root])):
        check()
        if classes.known[root]:  # still
            classes.thin(root)
    return classes.labels()


def _from_guess(apart: Matrix, links: Iterable[Link], guess: Sequence[int]) -> _Classes:
    """Nodes that a guess has at one dstate are merged, as far as they can be one; what follows from that is merged, too."""
    first = {label: node for node, label in reversed(list(enumerate(guess))) if label >= 0}
    classes = _Classes(apart.copy(), links, first.values())
    for node, label in enumerate(guess):
        if label >= 0:
            classes.merge(first[label], node)
    return classes


class _Classes:
    """Steps that were merged.

    root   of each step, the step that stands for its class
    known  of each root, whether its class is a dstate of the map
    """

    def __init__(self, apart: Matrix, links: Iterable[Link], known: Iterable[int]) -> None:
        steps = len(apart)
        self.root = np.arange(steps)
        self.known = np.zeros(steps, dtype=bool)
        self.known[list(known)] = True
        self._apart = apart  # of each root, the steps that are apart from some step of its class
        self._members: list[NDArray[np.int_]] = [np.array([t]) for t in range(steps)]
        self._leads: list[dict[int, int]] = [{} for _ in range(steps)]  # of each root, by action
        for t, action, u in links:
            self._leads[t][action] = u
        self._undo: list[tuple[int, int, bool, NDArray[np.bool_], dict[int, int], NDArray[np.int_]]] = []

    def labels(self) -> list[int]:
        """The class of each step, numbered by first step."""
        return numbered(self.root.tolist())

    def settle_all(self, check: Callable[[], None], agrees: Callable[[], bool] = lambda: True) -> bool:
        """Make every class a known dstate. Returns whether it agrees with what else is known, whenever some were."""
        if not agrees():
            return False
        for evidence, rivals in DEMANDS:
            while self.settle(evidence, rivals, check):
                if not agrees():
                    return False
        while len(rest := self.unsettled()):
            self.settle_at_any_rate(int(rest[0]))
            check()
            if not agrees():
                return False
        return True

    def heed(self, told: Told | None) -> bool:
        """Keep what is told of steps apart, and merge those that are one, as far as they can be. Returns whether anything is told."""
        if told is None:
            return False
        apart, one = told
        self._apart |= apart
        for root in np.flatnonzero(np.bincount(self.root) > 1):
            self._apart[root] |= apart[self._members[root]].any(axis=0)
        for a, b in one:
            self.merge(a, b, forced=True)
        return True

    def unsettled(self) -> NDArray[np.int_]:
        """The steps of classes that are no known dstates."""
        return np.flatnonzero(~self.known[self.root])

    def settle(self, evidence: int, rivals: int, check: Callable[[], None]) -> int:
        """Merge unsettled classes with known dstates, as far as that evidence goes, or make them known. Returns how many."""
        steps = self.unsettled()
        fitting = (~self._apart[np.flatnonzero(self.known)][:, steps]).sum(axis=0)
        settled = 0
        for t in steps[np.argsort(fitting, kind="stable")].tolist():
            check()
            root = int(self.root[t])
            if self.known[root]:
                continue
            fits = self._fitting(root)
            if len(fits) > rivals:
                continue
            ranked = self._ranked(root, fits)
            if not ranked:
                self.known[root] = True
            elif ranked[0][0] < evidence + (ranked[1][0] if len(ranked) > 1 else 0):
                continue
            else:
                self.merge(ranked[0][1], root)
            settled += 1
        return settled

    def thin(self, root: int) -> None:
        """Merge a known dstate with others, while it can be."""
        while ranked := self._ranked(root, [dstate for dstate in self._fitting(root) if dstate != root], forced=True):
            self.merge(ranked[0][1], root, forced=True)
            root = int(self.root[root])

    def settle_at_any_rate(self, step: int) -> None:
        """Merge the class of a step with the known dstate that most speaks for, if it fits any; or make it known."""
        root = int(self.root[step])
        ranked = self._ranked(root, self._fitting(root))
        if ranked:
            self.merge(ranked[0][1], root)
        else:
            self.known[root] = True

    def _fitting(self, root: int) -> list[int]:
        """The known dstates that no step of the class is apart from."""
        known = np.flatnonzero(self.known)
        fits: list[int] = known[~self._apart[np.ix_(known, self._members[root])].any(axis=1)].tolist()
        return fits

    def _ranked(self, root: int, fits: Sequence[int], *, forced: bool = False) -> list[tuple[int, int]]:
        """The evidence for each of these dstates that the class can be merged with, most first, and the dstate."""
        found = []
        for dstate in fits:
            evidence = self.merge(dstate, root, forced=forced)
            if evidence is not None:
                found.append((evidence, dstate))
                self._take_back()
        return sorted(found, reverse=True)

    def merge(self, a: int, b: int, *, forced: bool = False) -> int | None:
        """Merge two classes, and all that has to be merged then. Returns the evidence; None, and nothing is changed, if some are apart.

        forced  let known dstates turn out to be one
        """
        self._undo = []
        work = [(a, b)]
        confirmed = 0
        while work:
            a, b = (int(self.root[t]) for t in work.pop())
            if a == b:
                confirmed += 1
                continue
            if (self.known[a] and self.known[b] and not forced) or self._apart[a, self._members[b]].any():
                self._take_back()
                return None
            if self.known[b] or (not self.known[a] and len(self._members[a]) < len(self._members[b])):
                a, b = b, a
            leads, more = self._leads[a], self._leads[b]
            self._undo.append((a, b, bool(self.known[b]), self._apart[a].copy(), leads, self._members[a]))
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
            self._apart[a], self._leads[a], self._members[a], self.known[b] = apart, leads, members, known
            self.root[self._members[b]] = b
        self._undo = []
