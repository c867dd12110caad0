"""A small map of the causal theory without a search: steps are merged where much speaks for it, in the order of how much.

>>> from ssh_abduction.steps.apart import Continuations
>>> from ssh_abduction.guesses.merging import merged
>>> merged(Continuations([0, 1, 0, 1], [0, 0, 0]).apart(), [(0, 0, 1), (1, 0, 2), (2, 0, 3)], [0, 1])
[0, 1, 0, 1]

Steps that are apart are known dstates to begin with. To merge two steps means to merge what the same actions lead to from them, and so on:
all of it is merged, or nothing, if some two are apart. The more two steps have to say about each other, the less likely that is by chance:
the *evidence* is how many merges that makes, and how often it confirms one made before. Steps that fit a single known dstate, with much
evidence, go first; then those with less, or with rivals that have clearly less. A step that fits none is a new dstate.

What is guessed at can be finished in the same way: nodes that a guess has at one dstate are known to begin with, as far as they can be one.
Where more is told on the way, of steps that are apart or one, the merge that leads to a contradiction is taken back.
And the dstates of a map are thinned so: those seen least are merged with others, as long as that leaves a map, those with most evidence first.

This is evidence-driven state merging (Lang, Pearlmutter, Price 1998, "Results of the Abbadingo One DFA Learning Competition") for one
trace, from known dstates all over it rather than from a root.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import partial
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.steps.apart import Matrix
from ssh_abduction.steps.chart import Chart, Link, numbered

# Least evidence for a merge, and how much it has to be ahead of the next; among how many known dstates at most:
DEMANDS = ((10, 1), (5, 1), (5, 2), (3, 1), (3, 3), (2, 2), (2, 10), (1, 3), (1, 100), (0, 1), (0, 2), (0, 1000))

THINNED = 10, 5, 3, 0  # how much more evidence than for the next, for dstates of a map to be merged
TAKEN_BACK = 20  # merges, after which there is no map,
THIN_ENOUGH = 5  # and after which a map is thin enough

Told: TypeAlias = tuple[Matrix, Sequence[tuple[int, int]]]  # which nodes are apart, and pairs that are one
_State: TypeAlias = tuple[NDArray[np.int_], NDArray[np.bool_], Matrix, list[NDArray[np.int_]], list[dict[int, int]]]
_Merge: TypeAlias = tuple[int, int]  # two steps whose classes become one; where they are one, that becomes known


def merged(apart: Matrix, links: Iterable[Link], clique: Sequence[int], check: Callable[[], None] = lambda: None) -> list[int]:
    """The dstate of each node of a chart in some map, numbered by first node.

    apart   which nodes are apart, nodes x nodes
    links   of the chart
    clique  nodes that are pairwise apart
    check   called now and then; may raise
    """
    classes = _Classes(apart, links, check)
    classes.known[list(clique)] = True
    classes.settle_all()
    return classes.labels()


def merged_near(apart: Matrix, links: Iterable[Link], guess: Sequence[int], check: Callable[[], None] = lambda: None) -> list[int]:
    """The same near a guess.

    guess  a label of each node; -1 where it is not known. Nodes that cannot be at one dstate with the others of their label leave it
    """
    classes = _from_guess(apart, links, guess, check)
    classes.settle_all()
    return classes.labels()


def merged_as_told(
    apart: Matrix,
    links: Iterable[Link],
    guess: Sequence[int],
    tell: Callable[[Sequence[int], Sequence[int]], Told | None],
    fits: Callable[[Sequence[int], Sequence[int]], bool],
    check: Callable[[], None] = lambda: None,
) -> list[int] | None:
    """The same, where more is told on the way, and thinned in the end. None where that contradicts, or no map is found soon.

    tell  is asked what follows from labels of all nodes, and which of these are still open, whenever they have changed; None: they contradict
    fits  is asked whether they do not, sooner
    """
    classes = _Heeding(apart, links, tell, fits, check)
    classes.take(guess)
    try:
        classes.settle_all()
    except _Contradicted:
        return None
    with suppress(_Contradicted):
        classes.may_take_back = THIN_ENOUGH
        classes.thin_all()
    return classes.labels()


def kept(apart: Matrix, links: Iterable[Link], guess: Sequence[int]) -> list[int]:
    """The same where nothing is merged but what has to be: what is not known, or leaves its label, is something new."""
    return _from_guess(apart, links, guess).labels()


def thinned(chart: Chart, labels: Sequence[int], check: Callable[[], None] = lambda: None) -> list[int]:
    """The dstate of each node in a map where no two dstates of this one are left that could be one.

    Those seen at the fewest nodes are merged first, each with that for which the evidence is most.

    labels  of the nodes of a chart, in a map
    """
    dstates = numbered(labels)
    first = np.unique(dstates, return_index=True)[1]
    links = list(dict.fromkeys((dstates[t], action, dstates[u]) for t, action, u in chart.links))
    classes = _Classes(_apart_in_map(np.asarray(chart.seen)[first], links, check), links, check, np.bincount(dstates))
    classes.known[:] = True
    classes.thin_all()
    return numbered(classes.root[dstates].tolist())


def _apart_in_map(seen: NDArray[np.int_], links: Sequence[Link], check: Callable[[], None]) -> Matrix:
    """Which dstates of a map are apart: those at which something else is seen, or from which an action leads to such, as far as the map says."""
    leads: dict[int, NDArray[np.int_]] = {}
    for dstate, action, leads_to in links:
        leads.setdefault(action, np.full(len(seen), -1))[dstate] = leads_to
    apart: Matrix = seen[:, None] != seen
    while True:
        check()
        before = apart.copy()
        for there in leads.values():
            known = np.flatnonzero(there >= 0)
            apart[np.ix_(known, known)] |= apart[np.ix_(there[known], there[known])]
        if (apart == before).all():
            return apart


def _from_guess(apart: Matrix, links: Iterable[Link], guess: Sequence[int], check: Callable[[], None] = lambda: None) -> _Classes:
    """Nodes that a guess has at one dstate are merged, as far as they can be one; what follows from that is merged, too."""
    classes = _Classes(apart, links, check)
    classes.take(guess)
    return classes


class _Classes:
    """Steps that were merged.

    root   of each step, the step that stands for its class
    known  of each root, whether its class is a dstate of the map
    """

    def __init__(
        self, apart: Matrix, links: Iterable[Link], check: Callable[[], None] = lambda: None, nodes: NDArray[np.int_] | None = None
    ) -> None:
        """
        nodes  how many nodes each step stands for, if not one
        """
        steps = len(apart)
        self._nodes = nodes
        self.root = np.arange(steps)
        self.known = np.zeros(steps, dtype=bool)
        self._apart = apart.copy()  # of each root, the steps that are apart from some step of its class
        self._members: list[NDArray[np.int_]] = [np.array([t]) for t in range(steps)]
        self._leads: list[dict[int, int]] = [{} for _ in range(steps)]  # of each root, by action
        for t, action, u in links:
            self._leads[t][action] = u
        self._undo: list[tuple[int, int, bool, NDArray[np.bool_], dict[int, int], NDArray[np.int_]]] = []
        self._made: list[_Merge] = []
        self._check = check

    def take(self, guess: Sequence[int]) -> None:
        """Merge the nodes that a guess has at one dstate, as far as they can be one. These are known dstates."""
        first = {label: node for node, label in reversed(list(enumerate(guess))) if label >= 0}
        self.known[list(first.values())] = True
        for node, label in enumerate(guess):
            self._check()
            if label >= 0:
                self.merge(first[label], node)

    def labels(self) -> list[int]:
        """The class of each step, numbered by first step."""
        return numbered(self.root.tolist())

    def settle_all(self) -> None:
        """Make every class a known dstate."""
        for evidence, rivals in DEMANDS:
            while self._advanced(partial(self.settle, evidence, rivals)):
                pass
        while self._advanced(self.settle_at_any_rate):
            self._check()

    def thin_all(self) -> None:
        """Merge known dstates while there are some that can be one."""
        for evidence in THINNED:
            while self._advanced(partial(self.thin, evidence)):
                pass

    def _advanced(self, step: Callable[[], None]) -> bool:
        """Take a step. Returns whether any merges were made."""
        self._made = []
        step()
        return bool(self._made)

    def make(self, merge: _Merge) -> None:
        """Make two classes one, or a class known."""
        a, b = (int(self.root[t]) for t in merge)
        if a == b:
            self.known[a] = True
        else:
            self.merge(a, b, forced=True)
        self._made.append(merge)

    def unsettled(self) -> NDArray[np.int_]:
        """The steps of classes that are no known dstates."""
        return np.flatnonzero(~self.known[self.root])

    def settle(self, evidence: int, rivals: int) -> None:
        """Merge unsettled classes with known dstates, as far as that evidence goes, or make them known."""
        steps = self.unsettled()
        fitting = (~self._apart[np.flatnonzero(self.known)][:, steps]).sum(axis=0)
        for t in steps[np.argsort(fitting, kind="stable")].tolist():
            self._check()
            root = int(self.root[t])
            if self.known[root]:
                continue
            fits = self._fitting(root)
            if len(fits) > rivals:
                continue
            ranked = self._ranked(root, fits)
            if not ranked:
                self.make((root, root))
            elif _is_ahead(ranked, evidence):
                self.make((ranked[0][1], root))

    def settle_at_any_rate(self) -> None:
        """Merge the class of the first step that is not settled with the known dstate that most speaks for, if it fits any; or make it known."""
        for t in self.unsettled()[:1].tolist():
            root = int(self.root[t])
            ranked = self._ranked(root, self._fitting(root))
            self.make((ranked[0][1] if ranked else root, root))

    def thin(self, evidence: int) -> None:
        """Merge known dstates, those seen least first, as far as that evidence goes."""
        nodes = np.bincount(self.root, self._nodes)
        for root in sorted(np.flatnonzero(self.known).tolist(), key=lambda root: nodes[root]):
            self._check()
            if self.known[root]:  # still
                ranked = self._ranked(root, [dstate for dstate in self._fitting(root) if dstate != root], forced=True)
                if ranked and _is_ahead(ranked, evidence):
                    self.make((ranked[0][1], root))

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


class _Contradicted(Exception):  # noqa: N818 - not an error
    """What is told contradicts, whatever is taken back."""


class _Heeding(_Classes):
    """Classes near a guess of which more is told whenever some were merged. The merges that contradict it are taken back."""

    def __init__(
        self,
        apart: Matrix,
        links: Iterable[Link],
        tell: Callable[[Sequence[int], Sequence[int]], Told | None],
        fits: Callable[[Sequence[int], Sequence[int]], bool],
        check: Callable[[], None],
    ) -> None:
        super().__init__(apart, links, check)
        self._tell = tell
        self._fits = fits
        self.may_take_back = TAKEN_BACK

    def settle_all(self) -> None:
        if not self._heeds():
            raise _Contradicted
        super().settle_all()

    def _advanced(self, step: Callable[[], None]) -> bool:
        before = self._state()
        advanced = super()._advanced(step)
        if advanced and not self._heeds():
            self._take_back_first_wrong(before, tuple(self._made))
        return advanced

    def _take_back_first_wrong(self, before: _State, made: Sequence[_Merge]) -> None:
        """Make these merges anew up to the first that contradicts, whose classes are apart from now on."""

        def fits(merges: int) -> bool:
            self._check()
            self._make_anew(before, made[:merges])
            return self._fits(self.labels(), self.unsettled().tolist())

        right = first_failing(fits, 1, len(made)) - 1
        self._make_anew(before, made[:right])
        self.may_take_back -= 1
        a, b = (self._members[self.root[t]] for t in made[right])
        if a is b or not self.may_take_back:
            raise _Contradicted
        self._apart[np.ix_(a, b)] = self._apart[np.ix_(b, a)] = True
        self._apart[self.root[a[0]], b] = self._apart[self.root[b[0]], a] = True

    def _make_anew(self, before: _State, merges: Iterable[_Merge]) -> None:
        root, known, apart, members, leads = before
        self.root, self.known, self._apart, self._members, self._leads = root.copy(), known.copy(), apart.copy(), list(members), list(leads)
        for merge in merges:
            self.make(merge)

    def _state(self) -> _State:
        return self.root.copy(), self.known.copy(), self._apart.copy(), list(self._members), list(self._leads)

    def _heeds(self) -> bool:
        """Keep what is told of steps apart, and merge those that are one, as far as they can be. Returns whether nothing contradicts."""
        self._check()
        told = self._tell(self.labels(), self.unsettled().tolist())
        if told is None:
            return False
        apart, one = told
        self._apart |= apart
        for root in np.flatnonzero(np.bincount(self.root) > 1):
            self._apart[root] |= apart[self._members[root]].any(axis=0)
        for a, b in one:
            self.merge(a, b, forced=True)
        return True


def first_failing(holds: Callable[[int], bool], first: int, last: int) -> int:
    """The first of these numbers for which something does not hold, if it does not for those that follow either; the last is known to be one such."""
    return first + bisect_left(range(first, last), True, key=lambda number: not holds(number))


def _is_ahead(ranked: Sequence[tuple[int, int]], evidence: int) -> bool:
    """Whether the first has that much more evidence than the next."""
    return ranked[0][0] >= evidence + (ranked[1][0] if len(ranked) > 1 else 0)
