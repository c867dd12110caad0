"""Classes of steps, merged by evidence.

A merge of two classes also merges the steps that the same actions lead to from them, and so on. A
merge that contradicts what is apart is taken back.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.solver.steps.apart import Matrix
from ssh_abduction.solver.steps.chart import Link, numbered

# The demands on a merge, from strict to lenient: the least lead of its evidence over the next best
# merge of the same step, and the most known dstates that may fit the step. By the last demand,
# every step is merged that fits some known dstate.
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
# The leads for merges of two known dstates, when a map is thinned.
THINNED = 10, 5, 3, 0

# The fields of Classes that merges change.
Snapshot: TypeAlias = tuple[
    NDArray[np.int_], NDArray[np.bool_], Matrix, list[NDArray[np.int_]], list[dict[int, int]]
]
# Two steps whose classes are merged. If they are one class, it becomes a known dstate.
Merge: TypeAlias = tuple[int, int]


class Classes:
    """Classes of merged steps. Some of them are known dstates.

    Attributes:
        root: For each step, the step that represents its class.
        known: For each root, whether its class is a known dstate.
    """

    def __init__(
        self,
        apart: Matrix,
        links: Iterable[Link],
        check: Callable[[], None] = lambda: None,
        nodes: NDArray[np.int_] | None = None,
    ) -> None:
        """Begin with a class for each step.

        Args:
            apart: Which steps are apart, as a matrix of steps x steps.
            links: Triples (step, action, step).
            check: Called now and then; may raise.
            nodes: The number of nodes that each step stands for; 1 by default.
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
        # What the last call of `merge` changed, to be taken back.
        self._undo: list[
            tuple[int, int, bool, NDArray[np.bool_], dict[int, int], NDArray[np.int_]]
        ] = []
        self._made: list[Merge] = []
        self._check = check

    def take(self, guess: Sequence[int]) -> None:
        """Merge the nodes that share a label in a guess, where they can be one dstate.

        Their classes become known dstates. Nodes labelled -1 are ignored.
        """
        first = {label: node for node, label in reversed(list(enumerate(guess))) if label >= 0}
        self.known[list(first.values())] = True
        for node, label in enumerate(guess):
            self._check()
            if label >= 0:
                self.merge(first[label], node)

    def labels(self) -> list[int]:
        """The class of each step. Classes are numbered by their first steps."""
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
        """Take a step. Returns whether it made any merges."""
        self._made = []
        step()
        return bool(self._made)

    def make(self, merge: Merge) -> None:
        """Merge the classes of two steps. If they are one class, make it a known dstate."""
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
        """Merge other classes with known dstates. A class that fits none becomes known.

        Args:
            evidence: The least lead over the evidence for the next best dstate.
            rivals: The most known dstates that may fit the class.
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
        """Merge the class of the first open step with the known dstate of most evidence.

        If it fits no known dstate, it becomes one.
        """
        for t in self.unsettled()[:1].tolist():
            root = int(self.root[t])
            ranked = self._ranked(root, self._fitting(root))
            self.make((ranked[0][1] if ranked else root, root))

    def thin(self, evidence: int) -> None:
        """Merge known dstates with others, those with the fewest nodes first.

        Args:
            evidence: The least lead over the evidence for the next best dstate.
        """
        nodes = np.bincount(self.root, self._nodes)
        for root in sorted(np.flatnonzero(self.known).tolist(), key=lambda root: nodes[root]):
            self._check()
            if self.known[root]:  # not merged since
                ranked = self._ranked(
                    root, [dstate for dstate in self._fitting(root) if dstate != root], forced=True
                )
                if ranked and _is_ahead(ranked, evidence):
                    self.make((ranked[0][1], root))

    def _fitting(self, root: int) -> list[int]:
        """The known dstates from which no step of the class is apart."""
        known = np.flatnonzero(self.known)
        fits: list[int] = known[
            ~self._apart[np.ix_(known, self._members[root])].any(axis=1)
        ].tolist()
        return fits

    def _ranked(
        self, root: int, fits: Sequence[int], *, forced: bool = False
    ) -> list[tuple[int, int]]:
        """The dstates that the class can be merged with, as (evidence, dstate), best first."""
        found = []
        for dstate in fits:
            evidence = self.merge(dstate, root, forced=forced)
            if evidence is not None:
                found.append((evidence, dstate))
                self._take_back()
        return sorted(found, reverse=True)

    def merge(self, a: int, b: int, *, forced: bool = False) -> int | None:
        """Merge two classes, and all classes that have to be merged with them.

        Args:
            a: A root.
            b: Another root.
            forced: Whether two known dstates may be merged.

        Returns:
            The evidence. None if this would merge steps that are apart; then nothing is changed.
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
            # Keep the known class, or else the larger one.
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

    def separate(self, first: NDArray[np.int_], second: NDArray[np.int_]) -> None:
        """Mark all steps of two classes as apart.

        Args:
            first: The steps of one class.
            second: The steps of the other.
        """
        self._apart[np.ix_(first, second)] = self._apart[np.ix_(second, first)] = True
        self._apart[self.root[first[0]], second] = self._apart[self.root[second[0]], first] = True

    def separate_all(self, apart: Matrix) -> None:
        """Mark these further pairs of steps as apart."""
        self._apart |= apart
        for root in np.flatnonzero(np.bincount(self.root) > 1):
            self._apart[root] |= apart[self._members[root]].any(axis=0)

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

    def restore(self, before: Snapshot, merges: Iterable[Merge]) -> None:
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

    def snapshot(self) -> Snapshot:
        """A copy of all that merges change, for `restore`."""
        return (
            self.root.copy(),
            self.known.copy(),
            self._apart.copy(),
            list(self._members),
            list(self._leads),
        )


def _is_ahead(ranked: Sequence[tuple[int, int]], evidence: int) -> bool:
    """Whether the best merge leads the next best by this much evidence, or has it if alone."""
    return ranked[0][0] >= evidence + (ranked[1][0] if len(ranked) > 1 else 0)
