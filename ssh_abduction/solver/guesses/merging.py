"""Small maps of the causal theory without a search: merge steps, those with most evidence first.

>>> from ssh_abduction.solver.steps.apart import Continuations
>>> from ssh_abduction.solver.guesses.merging import merged
>>> links = [(0, 0, 1), (1, 0, 2), (2, 0, 3)]
>>> merged(Continuations([0, 1, 0, 1], [0, 0, 0]).apart(), links, [0, 1])
[0, 1, 0, 1]

At first, the steps of a clique are *known* dstates. If two steps are one dstate, then so are the
steps that the same actions lead to from them, and so on. All of these are merged, or none if two of
them are apart. The more steps a merge affects without a contradiction, the less likely is it to be
wrong. So the *evidence* for a merge is the number of classes that it merges, plus the number of
earlier merges that it confirms. Steps that fit only one known dstate, with much evidence, are
merged first. Then come steps with less evidence, or with clearly less evidence for other known
dstates. A step that fits no known dstate becomes one.

A guess is completed in the same way. Nodes with one label in the guess are merged first if they can
be one, and become known dstates. Meanwhile a caller can say which nodes are apart or one; the merge
that led to a contradiction is then taken back. A map is thinned in the same way: dstates with the
fewest nodes are merged with others as long as the result is a map, those with most evidence first.

This is evidence-driven state merging (Lang, Pearlmutter, Price 1998, "Results of the Abbadingo One
DFA Learning Competition") for one trace, from known dstates all over it instead of from a root.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.solver.guesses.classes import Classes, Merge, Snapshot
from ssh_abduction.solver.steps.apart import Matrix
from ssh_abduction.solver.steps.chart import Chart, Link, numbered

# Give up a guess after this many merges that contradicted the caller.
TAKEN_BACK = 20
# Stop thinning after this many merges that contradicted the caller. With 40, maps had at most 1 %
# fewer dstates, and took twice as long.
THIN_ENOUGH = 5

# Which nodes are apart, and pairs of nodes that are one dstate.
Told: TypeAlias = tuple[Matrix, Sequence[tuple[int, int]]]


def merged(
    apart: Matrix,
    links: Iterable[Link],
    clique: Sequence[int],
    check: Callable[[], None] = lambda: None,
) -> list[int]:
    """The dstate of each node of a chart in a small map, numbered by first node.

    Args:
        apart: Which nodes are apart, as a matrix of nodes x nodes.
        links: The links of the chart.
        clique: Nodes that are pairwise distinct.
        check: Called now and then; may raise.
    """
    classes = Classes(apart, links, check)
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

    Args:
        apart: Which nodes are apart, as a matrix of nodes x nodes.
        links: The links of the chart.
        guess: A label for each node; -1 if unknown. The label of a node is ignored if the node
            cannot be one dstate with earlier nodes of that label.
        check: Called now and then; may raise.
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
    """The dstate of each node in a small map near a guess, with the caller's knowledge.

    Args:
        apart: Which nodes are apart, as a matrix of nodes x nodes.
        links: The links of the chart.
        guess: A label for each node; -1 if unknown.
        tell: Called with the labels of all nodes, and the nodes whose labels are still open, when
            labels have changed. Returns which nodes are apart and which are one, or None if the
            labels contradict what the caller knows.
        fits: Called with the same arguments. Returns whether the labels may hold; it is faster.
        check: Called now and then; may raise.

    Returns:
        The labels of a thinned map; None if the guess contradicts what the caller knows, or if no
        map is found soon.
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
    """The dstate of each node in a map that keeps the labels of a guess as far as possible.

    Only nodes that have to be one dstate because of that are merged. Nodes that are -1 in the
    guess, or cannot keep their labels, are dstates of their own.
    """
    return _from_guess(apart, links, guess).labels()


def thinned(
    chart: Chart, labels: Sequence[int], check: Callable[[], None] = lambda: None
) -> list[int]:
    """The dstate of each node in a smaller map.

    Dstates are merged until no two can be one. Those with the fewest nodes are merged first, each
    with the dstate for which there is most evidence.

    Args:
        chart: The chart.
        labels: The dstate of each node of the chart, in a map.
        check: Called now and then; may raise.
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
    """The dstate that each dstate of a map is merged with, until no two can be one.

    Dstates with the fewest nodes are merged first, each with the dstate for which there is most
    evidence.

    Args:
        shows: The view of each dstate.
        links: Triples (dstate, action, dstate).
        visits: The number of nodes at each dstate.
        check: Called now and then; may raise.
        excluded: Pairs of dstates that are not one.
    """
    classes = Classes(
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
    """The pairs of dstates of a map that are apart.

    Two dstates are apart if they show different views, if they are excluded, or if one action leads
    from them to dstates that are apart.
    """
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
) -> Classes:
    """Classes in which the nodes that share a label in a guess are merged, if they can be one."""
    classes = Classes(apart, links, check)
    classes.take(guess)
    return classes


class _Contradicted(Exception):  # noqa: N818 - not an error
    """The guess contradicts what the caller knows, or too many merges do."""


class _ToldClasses(Classes):
    """Classes near a guess. After merges, the caller says what follows from them.

    Merges that contradict what the caller knows are taken back.
    """

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
        before = self.snapshot()
        advanced = super()._advanced(step)
        if advanced and not self._keeps_what_is_told():
            self._take_back_first_wrong(before, tuple(self._made))
        return advanced

    def _take_back_first_wrong(self, before: Snapshot, made: Sequence[Merge]) -> None:
        """Repeat merges up to the first that contradicts the caller, and separate its classes."""

        def fits(merges: int) -> bool:
            self._check()
            self.restore(before, made[:merges])
            return self._fits(self.labels(), self.unsettled().tolist())

        right = first_failing(fits, 1, len(made)) - 1
        self.restore(before, made[:right])
        self.may_take_back -= 1
        a, b = (self._members[self.root[t]] for t in made[right])
        if a is b or not self.may_take_back:
            raise _Contradicted
        self.separate(a, b)

    def _keeps_what_is_told(self) -> bool:
        """Ask the caller which steps are apart and which are one, and apply the answer.

        Returns False if the classes contradict what the caller knows.
        """
        self._check()
        told = self._tell(self.labels(), self.unsettled().tolist())
        if told is None:
            return False
        apart, one = told
        self.separate_all(apart)
        for a, b in one:
            self.merge(a, b, forced=True)
        return True


def first_failing(holds: Callable[[int], bool], first: int, last: int) -> int:
    """The first number from `first` to `last` for which `holds` is false, by bisection.

    If `holds` is false for a number, it has to be false for all larger ones. It counts as false for
    `last`.
    """
    return first + bisect_left(range(first, last), True, key=lambda number: not holds(number))
