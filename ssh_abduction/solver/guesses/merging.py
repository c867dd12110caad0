"""Finds a small map of the causal theory without a search: steps are merged, those first for which there is most evidence.

>>> from ssh_abduction.solver.steps.apart import Continuations
>>> from ssh_abduction.solver.guesses.merging import merged
>>> merged(Continuations([0, 1, 0, 1], [0, 0, 0]).apart(), [(0, 0, 1), (1, 0, 2), (2, 0, 3)], [0, 1])
[0, 1, 0, 1]

The steps of a clique are *known* dstates to begin with. If two steps are one dstate, so are the steps that the same actions lead to from them, and so on. All of
these are merged; or none, if some two of them are apart. The more steps a merge touches without a contradiction, the less likely that is by chance: so the
*evidence* for a merge is how many classes it merges, plus how often it confirms a merge made before. Steps that fit one known dstate only, with much evidence,
are merged first; then steps with less evidence, or for which other known dstates have clearly less. A step that fits no known dstate becomes one.

A guess is completed in the same way: nodes to which it gives one label are merged first, as far as they can be one, and are known dstates then. While that goes
on, a caller can tell which nodes are apart or one, and the merge that led to a contradiction is taken back. And the dstates of a map are thinned in the same
way: dstates seen least are merged with others as long as that leaves a map, those with most evidence first.

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

from ssh_abduction.solver.steps.apart import Matrix
from ssh_abduction.solver.steps.chart import Chart, Link, numbered

# What is demanded of a merge, ever less: by how much its evidence is ahead of the next best merge of the same step, and how many known dstates may fit that
# step. What is demanded last lets every step be merged that fits some known dstate.
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
    (0, 1000),
)
# The same for merges of two known dstates, when a map is thinned.
THINNED = 10, 5, 3, 0
# When this many merges contradicted what the caller told, there is no map near the guess.
TAKEN_BACK = 20
# When this many merges did while a map was thinned, the map is thin enough: with 40 of them it came to have at most 1 % fewer dstates, and took twice as long.
THIN_ENOUGH = 5

Told: TypeAlias = tuple[
    Matrix, Sequence[tuple[int, int]]
]  # which nodes are apart, and pairs that are one
_Snapshot: TypeAlias = tuple[
    NDArray[np.int_], NDArray[np.bool_], Matrix, list[NDArray[np.int_]], list[dict[int, int]]
]  # of a _Classes
_Merge: TypeAlias = tuple[
    int, int
]  # two steps whose classes become one. Where these are one class already, that becomes a known dstate


def merged(
    apart: Matrix,
    links: Iterable[Link],
    clique: Sequence[int],
    check: Callable[[], None] = lambda: None,
) -> list[int]:
    """The dstate of each node of a chart in a small map, numbered by first node.

    apart   which nodes are apart, nodes x nodes
    links   of the chart
    clique  nodes that are pairwise apart
    check   called now and then; may raise
    """
    classes = _Classes(apart, links, check)
    classes.known[list(clique)] = True
    classes.settle_all()
    return classes.labels()


def merged_near(
    apart: Matrix,
    links: Iterable[Link],
    guess: Sequence[int],
    check: Callable[[], None] = lambda: None,
) -> list[int]:
    """The dstate of each node of a chart in a small map near a guess.

    guess  a label for each node; -1 where it is not known. A node that cannot be one dstate with the nodes before it of the same label is free, too
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
    """The dstate of each node in a small map near a guess, where the caller knows more than the causal axioms. The map is thinned. None where the guess contradicts
    what the caller knows, or no map is found soon.

    tell  given labels of all nodes, and the nodes whose labels are still open, says which nodes are apart and which are one; None if the labels contradict what
          the caller knows. It is asked whenever labels have changed
    fits  says, given the same, only whether the labels may hold, which takes less time
    """
    classes = _ToldClasses(apart, links, tell, fits, check)
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
    """The dstate of each node in a map that keeps the labels of a guess as far as possible, and merges only what has to be merged for that. All nodes that are -1
    in the guess, or cannot keep their label, are at dstates of their own.
    """
    return _from_guess(apart, links, guess).labels()


def thinned(
    chart: Chart, labels: Sequence[int], check: Callable[[], None] = lambda: None
) -> list[int]:
    """The dstate of each node in a smaller map: dstates of the given map are merged until no two of them can be one.

    Dstates seen at the fewest nodes are merged first, each with the dstate for which there is most evidence.

    labels  of the nodes of a chart, in a map
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
            check,
            excluded,
        )
    )
    return numbered(root[dstates].tolist())


def thinned_map(
    shows: Sequence[int],
    links: Sequence[Link],
    visits: Sequence[int],
    check: Callable[[], None] = lambda: None,
    excluded: Sequence[tuple[int, int]] = (),
) -> list[int]:
    """The dstate that each dstate of a map is merged with, until no two can be one: those visited least first, each with the one for which there is most evidence.

    shows     the view of each dstate
    visits    how many nodes are at each
    excluded  pairs of dstates that are not one
    """
    classes = _Classes(
        _apart_in_map(np.asarray(shows), links, excluded, check), links, check, np.asarray(visits)
    )
    classes.known[:] = True
    classes.thin_all()
    root: list[int] = classes.root.tolist()
    return root


def _apart_in_map(
    seen: NDArray[np.int_],
    links: Sequence[Link],
    excluded: Sequence[tuple[int, int]],
    check: Callable[[], None],
) -> Matrix:
    """Which pairs of dstates of a map are apart: those that show different views, that evidence excludes, or from which one action leads to dstates that are apart."""
    leads: dict[int, NDArray[np.int_]] = {}
    for dstate, action, leads_to in links:
        leads.setdefault(action, np.full(len(seen), -1))[dstate] = leads_to
    apart: Matrix = seen[:, None] != seen
    for s, x in excluded:
        apart[s, x] = apart[x, s] = True
    while True:
        check()
        before = apart.copy()
        for there in leads.values():
            known = np.flatnonzero(there >= 0)
            apart[np.ix_(known, known)] |= apart[np.ix_(there[known], there[known])]
        if (apart == before).all():
            return apart


def _from_guess(
    apart: Matrix,
    links: Iterable[Link],
    guess: Sequence[int],
    check: Callable[[], None] = lambda: None,
) -> _Classes:
    """Classes in which the nodes that a guess gives one label are merged, as far as they can be one, with all that follows from that."""
    classes = _Classes(apart, links, check)
    classes.take(guess)
    return classes


class _Classes:
    """Classes of steps that were merged.

    root   for each step, the step that stands for its class
    known  for each root, whether its class is a known dstate
    """

    def __init__(
        self,
        apart: Matrix,
        links: Iterable[Link],
        check: Callable[[], None] = lambda: None,
        nodes: NDArray[np.int_] | None = None,
    ) -> None:
        """
        nodes  how many nodes each step stands for (default one)
        """
        steps = len(apart)
        self._nodes = nodes
        self.root = np.arange(steps)
        self.known = np.zeros(steps, dtype=bool)
        self._apart = (
            apart.copy()
        )  # the row of each root: which steps are apart from some step of its class
        self._members: list[NDArray[np.int_]] = [np.array([t]) for t in range(steps)]
        self._leads: list[dict[int, int]] = [
            {} for _ in range(steps)
        ]  # for each root, a step that each action leads to
        for t, action, u in links:
            self._leads[t][action] = u
        self._undo: list[
            tuple[int, int, bool, NDArray[np.bool_], dict[int, int], NDArray[np.int_]]
        ] = []
        self._made: list[_Merge] = []
        self._check = check

    def take(self, guess: Sequence[int]) -> None:
        """Merge the nodes that a guess gives one label, as far as they can be one. Their classes become known dstates."""
        first = {label: node for node, label in reversed(list(enumerate(guess))) if label >= 0}
        self.known[list(first.values())] = True
        for node, label in enumerate(guess):
            self._check()
            if label >= 0:
                self.merge(first[label], node)

    def labels(self) -> list[int]:
        """The class of each step; classes are numbered by their first steps."""
        return numbered(self.root.tolist())

    def settle_all(self) -> None:
        """Make every class a known dstate."""
        for evidence, rivals in DEMANDS:
            while self._advanced(partial(self.settle, evidence, rivals)):
                pass
        while self._advanced(self.settle_at_any_rate):
            self._check()

    def thin_all(self) -> None:
        """Merge known dstates until no two of them can be one."""
        for evidence in THINNED:
            while self._advanced(partial(self.thin, evidence)):
                pass

    def _advanced(self, step: Callable[[], None]) -> bool:
        """Take a step, which may make merges. Returns whether it made any."""
        self._made = []
        step()
        return bool(self._made)

    def make(self, merge: _Merge) -> None:
        """Merge the classes of two steps; if they have one class, make that a known dstate."""
        a, b = (int(self.root[t]) for t in merge)
        if a == b:
            self.known[a] = True
        else:
            self.merge(a, b, forced=True)
        self._made.append(merge)

    def unsettled(self) -> NDArray[np.int_]:
        """The steps whose classes are not known dstates."""
        return np.flatnonzero(~self.known[self.root])

    def settle(self, evidence: int, rivals: int) -> None:
        """Merge unsettled classes with known dstates. A class that fits no known dstate becomes one.

        evidence  only where the evidence is ahead of that for the next dstate by this much
        rivals    only classes that fit at most this many known dstates
        """
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
        """Merge the class of the first unsettled step with the known dstate for which there is most evidence; if it fits none, make it one."""
        for t in self.unsettled()[:1].tolist():
            root = int(self.root[t])
            ranked = self._ranked(root, self._fitting(root))
            self.make((ranked[0][1] if ranked else root, root))

    def thin(self, evidence: int) -> None:
        """Merge known dstates with others, those seen least first.

        evidence  only where the evidence is ahead of that for the next dstate by this much
        """
        nodes = np.bincount(self.root, self._nodes)
        for root in sorted(np.flatnonzero(self.known).tolist(), key=lambda root: nodes[root]):
            self._check()
            if self.known[root]:  # it may have been merged since
                ranked = self._ranked(
                    root, [dstate for dstate in self._fitting(root) if dstate != root], forced=True
                )
                if ranked and _is_ahead(ranked, evidence):
                    self.make((ranked[0][1], root))

    def _fitting(self, root: int) -> list[int]:
        """The known dstates that no step of the class is apart from."""
        known = np.flatnonzero(self.known)
        fits: list[int] = known[
            ~self._apart[np.ix_(known, self._members[root])].any(axis=1)
        ].tolist()
        return fits

    def _ranked(
        self, root: int, fits: Sequence[int], *, forced: bool = False
    ) -> list[tuple[int, int]]:
        """Those of these dstates that the class can be merged with, as (evidence, dstate), the one with most evidence first."""
        found = []
        for dstate in fits:
            evidence = self.merge(dstate, root, forced=forced)
            if evidence is not None:
                found.append((evidence, dstate))
                self._take_back()
        return sorted(found, reverse=True)

    def merge(self, a: int, b: int, *, forced: bool = False) -> int | None:
        """Merge two classes, and all that has to be merged with them. Returns the evidence. If that would merge steps that are apart, nothing is changed, and None
        is returned.

        forced  let known dstates be merged with each other
        """
        self._undo = []
        work = [(a, b)]
        confirmed = 0
        while work:
            a, b = (int(self.root[t]) for t in work.pop())
            if a == b:
                confirmed += 1
                continue
            if (self.known[a] and self.known[b] and not forced) or self._apart[
                a, self._members[b]
            ].any():
                self._take_back()
                return None
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
            self._apart[a], self._leads[a], self._members[a], self.known[b] = (
                apart,
                leads,
                members,
                known,
            )
            self.root[self._members[b]] = b
        self._undo = []


class _Contradicted(Exception):  # noqa: N818 - not an error
    """The guess contradicts what the caller told, or too many merges do."""


class _ToldClasses(_Classes):
    """Classes near a guess. Whenever some were merged, the caller tells what follows from that; merges that contradict it are taken back."""

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
        if not self._keeps_what_is_told():
            raise _Contradicted
        super().settle_all()

    def _advanced(self, step: Callable[[], None]) -> bool:
        before = self._snapshot()
        advanced = super()._advanced(step)
        if advanced and not self._keeps_what_is_told():
            self._take_back_first_wrong(before, tuple(self._made))
        return advanced

    def _take_back_first_wrong(self, before: _Snapshot, made: Sequence[_Merge]) -> None:
        """Make these merges anew, up to the first with which they contradict what is told. The two classes of that merge are apart from now on."""

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

    def _make_anew(self, before: _Snapshot, merges: Iterable[_Merge]) -> None:
        """Go back to a snapshot, and make these merges."""
        root, known, apart, members, leads = before
        self.root, self.known, self._apart, self._members, self._leads = (
            root.copy(),
            known.copy(),
            apart.copy(),
            list(members),
            list(leads),
        )
        for merge in merges:
            self.make(merge)

    def _snapshot(self) -> _Snapshot:
        """What `_make_anew` needs to come back to the classes as they are now."""
        return (
            self.root.copy(),
            self.known.copy(),
            self._apart.copy(),
            list(self._members),
            list(self._leads),
        )

    def _keeps_what_is_told(self) -> bool:
        """Ask the caller, note which steps are apart, and merge those that are one, as far as they can be. Returns False where the classes contradict what the caller
        knows.
        """
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
    """The first number from `first` to `last` for which `holds` is false, found by bisection: it is false for all numbers after that, and for `last` anyway."""
    return first + bisect_left(range(first, last), True, key=lambda number: not holds(number))


def _is_ahead(ranked: Sequence[tuple[int, int]], evidence: int) -> bool:
    """Whether the first merge has this much more evidence than the next, or this much at all where it is the only one."""
    return ranked[0][0] >= evidence + (ranked[1][0] if len(ranked) > 1 else 0)
