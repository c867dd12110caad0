"""Joins that every cheap map has, and a lower bound on the cost of all maps.

A join is two visits that a map puts at one place (without frames, two steps at one dstate). Let F
be joins that every map of a cost below T has. At first F is empty. Each such map costs at least the
misfit of F plus what its dstates and places cost at least (`theory/prior.py`). Now take a further
join. A map without it costs at least the misfit of F plus what the dstates and places that are
needed without it cost. If this sum is T or more, then every map of a cost below T has the join, and
F gets it. Then the misfit of F is greater, and more dstates and places are needed without a further
join. If the misfit of F plus this cost is T or more, then no map costs less than T.

Only joins of the best known map are tried. If F gets no further join, assume that a map lacks a
certain join, and find what all cheap maps without this join have. If no map without it costs less
than T, F gets it. This is a branch and bound with few branches: one of the two sides always ends.

*Misread views.* If views may be misread, only evidence makes visits apart. Take k classes of visits
with a view each, such that any two are apart or differ in their views. If a map has fewer dstates
than k, it misreads all views of some classes, one for each dstate less. A class of several visits
costs several views then. The bound is the least over the number of dstates.

*Counts.* Two visits that cannot be at one place are apart. If the same action leads from two visits
to visits that are apart, these two are apart, too (`steps/chart.py`). Visits that are at one place
by F are apart from the same visits. A clique of dstates, or of places, is a lower bound on their
number.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from ssh_abduction.data.groups import firsts, gathered, indices_of
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.runtime.clock import LONG_TURN, look_at_clock
from ssh_abduction.solver.costs.misfit import Misfit
from ssh_abduction.solver.steps.apart import apart_classes, apart_matrix, clique, grown_clique
from ssh_abduction.solver.steps.chart import Chart, FramedChart
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.fields import FAULT
from ssh_abduction.theory.prior import Array
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.speedups import row

Ints = NDArray[np.int_]
Flags = NDArray[np.bool_]

# Search for a higher bound until it is known to this share.
NEARLY = 0.004
# The bound compares all pairs of visits, so it is only for traces of at most LONGEST steps.
LONGEST = 2500
# Try a clique with each of at most TRIED pairs that were not apart before.
TRIED = 20
# Consider joins of each visit with the last visits to its place, with at least one. Of all visits
# together, consider about this many joins at most.
PAIRS = 5000
# Assume the lack of at most BRANCHES joins, one after the other, until F gets one of them.
BRANCHES = 3


@dataclass(frozen=True, eq=False)
class Visits:
    """Visits to places, whose directions are numbered as in a map.

    With frames, a visit is the steps between two travels, and its place has four directions. Else
    each step is a visit, and its place has one direction.

    Attributes:
        visit: The visit of each step.
        direction: The direction of each step at the place of its visit.
        seen: The observation at each step, as a number.
        place: The place of each visit in the map; without frames, its dstate.
        links: For each visit but the last: the direction in which the robot leaves, the action, and
            the direction in which it arrives at the next visit; (visits - 1, 3).
        apart: The flag [R, I, J] says that visits I and J cannot be at one place such that
            direction 0 of I is direction R of J.
        away: The flag [I, J] says that visits I and J are at different places by evidence; None
            with frames, where `apart` says it.
        price: The nats that it costs to misread the view of each visit; None if no view may be
            misread. If there are prices, views make no visits apart in `apart`.
    """

    visit: Ints
    direction: Ints
    seen: Ints
    place: Ints
    links: Ints
    apart: Flags
    away: Flags | None
    price: Array | None = None

    @classmethod
    def of(cls, problem: Problem, log: Log, ssh_map: SSHMap) -> Visits:
        """Chart a trace, and number the directions as in a map of it."""
        chart = (
            Chart.framed(problem.trace, log) if row("visits").holds_for(problem.theory) else None
        )
        if chart is not None:
            return cls._framed(chart, ssh_map)
        visits, theory = cls._of_steps(log, ssh_map, bool(problem.theory.misread)), problem.theory
        if not theory.misread:
            return visits
        price = [FAULT / 10 * theory.fault_tenths("misread", one) for one in problem.trace.steps]
        return replace(visits, price=np.array(price))

    @classmethod
    def _framed(cls, chart: FramedChart, ssh_map: SSHMap) -> Visits:
        visit, slot = np.array(chart.facing)[list(chart.node_of)].T
        at = [ssh_map.dstates[label] for label in ssh_map.dstate_at]
        place, turned = np.zeros((2, len(chart.stars)), dtype=int)
        place[visit] = [dstate.place for dstate in at]
        turned[visit] = ([dstate.heading or 0 for dstate in at] - slot) % 4
        leaves = [(visit, *how) for visit, how in sorted(chart.leaves.items())]
        left, out, action = np.array(leaves, dtype=int).reshape(-1, 3).T
        links = np.stack([(out + turned[left]) % 4, action, turned[left + 1]], 1)
        rows, columns = np.indices(2 * (len(place),))
        apart, more = np.zeros_like(chart.misfits), (turned - turned[:, None]) % 4
        for r in range(4):
            apart[(r + more) % 4, rows, columns] = chart.misfits[r]
        apart |= apart[[0, 3, 2, 1]].transpose(0, 2, 1)
        seen = np.array(chart.seen)[list(chart.node_of)]
        return cls(visit, (slot + turned[visit]) % 4, seen, place, links, apart, None)

    @classmethod
    def _of_steps(cls, log: Log, ssh_map: SSHMap, misreads: bool) -> Visits:
        steps, none = len(log.seen), np.zeros(len(log.seen), dtype=int)
        links = np.stack([none[1:], np.array(log.actions, dtype=int), none[1:]], 1)
        chart = Chart.of_steps(log, steps)
        apart = (replace(chart, seen=tuple(none.tolist())) if misreads else chart).apart()[None]
        place = np.array(ssh_map.dstate_at)
        away = apart_matrix(log.pairs.elsewhere, steps)
        return cls(np.arange(steps), none, np.array(log.seen), place, links, apart, away)

    def lacking(self, first: int, second: int) -> Visits:
        """Copy the visits, with a flag that two of them are not joined as in the map."""
        apart = self.apart.copy()
        apart[0, first, second] = apart[0, second, first] = True
        return replace(self, apart=apart)

    def joined(self, of: Ints, pairs: Iterable[tuple[int, int]]) -> Ints:
        """Merge the classes of pairs of visits, and the classes that one action leads to from both.

        `of` has the class of each visit. So has the result.
        """
        of = of.copy()
        waiting = list(pairs)
        while waiting:
            for i, j in waiting:
                of[of == of[i]] = of[j]
            led: dict[tuple[int, int, int], int] = {}
            after = [
                (led.setdefault((a, out, action), v), v)
                for v, (a, (out, action, _)) in enumerate(
                    zip(of[:-1].tolist(), self.links.tolist(), strict=True), 1
                )
            ]
            waiting = [(i, j) for i, j in after if of[i] != of[j]]
        merged: Ints = np.unique(of, return_inverse=True)[1]
        return merged

    def returns(self, of: Ints) -> list[Equality]:
        """List the returns of all maps that have the visits of each class at one place."""
        found: list[Equality] = []
        first: dict[object, int] = {}
        for t, (a, x) in enumerate(
            zip(of[self.visit].tolist(), self.direction.tolist(), strict=True)
        ):
            if (begin := first.setdefault((a, x), t)) < t:
                found.append(Equality(begin, t))
            if (begin := first.setdefault(a, t)) < t and self.away is None:
                found.append(Equality(begin, t, "place"))
        return found


class _Cliques:
    """A clique in each part of the nodes. Nodes of different parts are always apart.

    So the union of the cliques is a clique, too.
    """

    def __init__(self, apart: Flags) -> None:
        self.apart, self._random = apart, np.random.default_rng(0)
        self.part: Ints = connected_components(csr_array(~apart), directed=False)[1]
        self._members = [np.flatnonzero(self.part == p) for p in range(self.part.max() + 1)]
        self._cliques = [
            some[clique(apart[np.ix_(some, some)], [0] * len(some))] for some in self._members
        ]
        self.size = sum(map(len, self._cliques))

    def size_with(self, pairs: Sequence[tuple[int, int]]) -> int:
        """Return the size of a clique of the whole graph if some more pairs are apart, too."""
        apart, larger = self.apart, dict[int, Ints]()
        if not pairs:
            return self.size
        first, second = np.array(pairs).T
        apart[first, second] = apart[second, first] = True
        for u, v in pairs[:TRIED]:
            part = int(self.part[u])
            best, some = larger.get(part, self._cliques[part]), self._members[part]
            kept = [u, v, *best[apart[u, best] & apart[v, best]].tolist()]
            left = some[apart[np.ix_(kept, some)].all(0)]
            if len(kept) + len(left) > len(best):
                more = grown_clique(apart[np.ix_(left, left)], [], self._random)
                if len(kept) + len(more) > len(best):
                    larger[part] = np.array([*kept, *left[more]])
        apart[first, second] = apart[second, first] = False
        return self.size + sum(len(c) - len(self._cliques[part]) for part, c in larger.items())


class _Joined:
    """Classes of visits that are at one place in every cheap map.

    Attributes:
        apart: The flag [R, A, B] says that classes A and B are apart, as in `Visits`.
        fails: Whether no map has these classes.
        counts: The least numbers of dstates (at all, and if no view of theirs is misread) and of
            places, unless `fails`.
        spoilt: The nats of views that are misread in each map with these classes.
        excused: The nats that misreading all views of 0, 1, 2, … classes costs at least.
    """

    def __init__(self, visits: Visits, of: Ints) -> None:
        self.apart = apart_classes(visits.apart, of)
        self._turns = len(self.apart)
        self._links = np.unique(np.column_stack([of[:-1], visits.links, of[1:]]), axis=0)
        self._close()
        self.fails = bool(self.apart[0].diagonal().any())
        if self.fails:
            return
        # The links into each class: from which class and direction, by (class, action, direction).
        links: list[list[int]] = self._links.tolist()
        self._into = gathered(
            ((b, action, arrives), (a, out)) for a, out, action, arrives, b in links
        )
        self._ways = gathered((b, (action, arrives)) for b, action, arrives in self._into)
        nodes = np.unique(np.column_stack([of[visits.visit], visits.direction]), axis=0)
        a, x = nodes.T
        self._node = {(a, x): node for node, (a, x) in enumerate(nodes.tolist())}
        apart = self.apart[(x - x[:, None]) % self._turns, a[:, None], a]
        apart |= (a[:, None] == a) & (x[:, None] != x)
        self._hard = self._dstates = _Cliques(apart)
        self.spoilt, self.excused = 0.0, np.zeros(1)
        if visits.price is not None:
            shown = np.zeros((len(nodes), int(visits.seen.max()) + 1))
            np.add.at(shown, (of, visits.seen), visits.price)
            of_views = np.unique(np.stack([of, visits.seen]), axis=1)[0]
            # Of two classes with a view each, and not the same one, one is misread in full if they
            # are one dstate.
            single = np.bincount(of_views) == 1
            view = np.where(single, shown.argmax(axis=1), -1)
            differ = (view[:, None] != view) & single[:, None] & single
            self._dstates = _Cliques(apart | differ)
            whole = shown.sum(axis=1)
            self.spoilt = float((whole - shown.max(axis=1)).sum())
            self.excused = np.cumsum([0.0, *np.sort(whole[single])])
        self._has_frames = visits.away is None
        apart = self.apart if visits.away is None else apart_classes(visits.away[None], of)
        self._places = _Cliques(np.logical_and.reduce(apart))
        self.counts = self._hard.size, self._dstates.size, self._places.size

    def _close(self) -> None:
        """Flag two classes as apart if one action leads from them to classes that are apart."""
        every = self._links.T
        actions = [every[:, every[2] == action] for action in np.unique(every[2])]
        before = -1
        while before < (before := int(np.count_nonzero(self.apart))):
            for a, out, _, arrives, b in actions:
                then = self.apart[(arrives - arrives[:, None]) % self._turns, b[:, None], b]
                e, f = np.nonzero(then)
                self.apart[(out[f] - out[e]) % self._turns, a[e], a[f]] = True

    def counts_lacking(self, a: int, b: int) -> tuple[int, int, int] | None:
        """Return what `counts` has for maps without a join; None if no map lacks it."""
        added = self._lack(a, b)
        fails = any(not r and c == d for r, c, d in added)
        node = self._node
        nodes = [
            (u, v)
            for r, c, d in added
            for x in range(self._turns)
            if (u := node.get((c, x))) is not None
            if (v := node.get((d, (x + r) % self._turns))) is not None
        ]
        places = [(c, d) for c, d in {(c, d) for _, c, d in added} if self.apart[:, c, d].all()]
        for r, c, d in added:
            self.apart[r, c, d] = self.apart[-r % self._turns, d, c] = False
        if fails:
            return None
        shown = self._dstates.size_with(nodes)
        hard = shown if self._hard is self._dstates else self._hard.size_with(nodes)
        return hard, shown, self._places.size_with(places if self._has_frames else [])

    def _lack(self, a: int, b: int) -> list[tuple[int, int, int]]:
        """Flag two classes as apart, and all that are apart if they are. Return the new flags."""
        added, waiting = [], [(0, a, b)]
        while waiting:
            r, a, b = waiting.pop()
            if self.apart[r, a, b]:
                continue
            self.apart[r, a, b] = self.apart[-r % self._turns, b, a] = True
            added.append((r, a, b))
            for action, arrives in self._ways.get(a, ()):
                for c, out in self._into[a, action, arrives]:
                    for d, other in self._into.get((b, action, (arrives + r) % self._turns), ()):
                        waiting.append(((other - out) % self._turns, c, d))
        return added


class Forcing:
    """Finds joins (pairs of visits at one place) that every cheap map has.

    Attributes:
        visits: The visits of the trace.
        joins: The joins that every cheap map is proven to have: the class of each visit.
        low: A lower bound on the cost of every map with these joins.
    """

    def __init__(
        self, problem: Problem, log: Log, misfit: Misfit, ssh_map: SSHMap, dstates: int = 0
    ) -> None:
        """Chart the trace of a problem.

        `ssh_map` is its best known map. Each map has at least `dstates` dstates.
        """
        self._misfit, self._dstates, self._prior = misfit, dstates, problem.prior
        self.visits = Visits.of(problem, log, ssh_map)
        at: dict[int, list[int]] = indices_of(self.visits.place.tolist())
        most = max(PAIRS // len(self.visits.place), 1)
        self._pairs = [
            (i, j)
            for some in at.values()
            for k, j in enumerate(some)
            for i in some[max(k - most, 0) : k]
        ]
        self.joins = self.visits.joined(np.arange(len(self.visits.place)), [])
        self.low = 0.0

    @staticmethod
    def holds_for(problem: Problem) -> bool:
        """Whether the bound holds for a theory, and the trace is not too long for it."""
        theory = problem.theory
        if theory.misread and theory.star == "none":
            theory = theory.replace(misread=0.0)
        is_known = row("visits").holds_for(theory) or row("clique").holds_for(theory)
        return is_known and not theory.has_faults and len(problem.trace) <= LONGEST

    @property
    def returns(self) -> list[Equality]:
        """The returns that every cheap map is proven to have."""
        return self.visits.returns(self.joins)

    def bounds(self, most: float, low: float = 0.0) -> Iterator[float]:
        """Yield rising lower bounds, above `low` and at most `most`, on the cost of all maps.

        The first bounds come without branching, which takes much longer. `joins` does not change.
        """
        for branches, top in ((0, 2 * most), (1, most)):
            high = top
            while low < most and high - low > NEARLY * most:
                middle = (low + high) / 2
                # The copy of the visits keeps these joins from becoming `joins`.
                if self._forced(replace(self.visits), self.joins, middle, branches):
                    low = middle
                    yield low
                else:
                    high = middle

    def force(self, most: float) -> None:
        """Find joins that every map of a cost below `most` has, until no more are found."""
        self._forced(self.visits, self.joins, most, 1)

    def _least(self, joins: Ints) -> tuple[Array, Array]:
        """Return what 0, 1, 2, … dstates, and places, cost at least.

        `joins` has the class of each visit. Only its first step may be the first one at a place.
        """
        at, facing = joins[self.visits.visit].tolist(), self.visits.direction.tolist()
        steps = range(len(at))
        dstates = [*firsts(zip(zip(at, facing, strict=True), steps, strict=True)).values()]
        places = [*firsts(zip(at, steps, strict=True)).values()]
        return self._prior.least(dstates[1:], places[1:])

    def _price(
        self, counts: tuple[int, int, int], classes: _Joined, least: tuple[Array, Array]
    ) -> float:
        """Return what at least this many dstates and places cost, and views that are misread.

        `counts` is as in `_Joined`, and `least` that of `_least`.
        """
        hard, shown, places = counts
        hard = max(hard, self._dstates)
        return classes.spoilt + min(
            self._prior.at_least({"dstates": some, "places": places}, least)
            + float(classes.excused[max(shown - some, 0)])
            for some in range(hard, max(shown, hard) + 1)
        )

    def _forced(self, visits: Visits, joins: Ints, most: float, branches: int) -> bool:
        """Add joins that every map of a cost below `most` has. Return whether there is no such map.

        `joins` has the joins found so far. Up to `branches` joins at a time are assumed to be
        lacking.
        """
        while True:
            joins, low, worth = self._grown(visits, joins, most)
            if visits is self.visits:
                self.joins, self.low = joins, low
            if low >= most:
                return True
            for i, j in worth[: BRANCHES if branches else 0]:
                if self._forced(visits.lacking(i, j), joins, most, branches - 1):
                    joins = visits.joined(joins, [(i, j)])
                    break
            else:
                return False

    def _grown(
        self, visits: Visits, joins: Ints, most: float
    ) -> tuple[Ints, float, list[tuple[int, int]]]:
        """Add joins that every map of a cost below `most` has, as far as bounds alone show them.

        Returns the class of each visit, a lower bound on the cost of maps with these joins, and the
        other joins of the best map, the one first without which maps cost most.
        """
        while True:
            look_at_clock(LONG_TURN)
            classes = _Joined(visits, joins)
            if classes.fails:
                return joins, math.inf, []
            misfit = self._misfit.of_returns(visits.returns(joins)) / 2
            least = self._least(joins)
            low = self._price(classes.counts, classes, least) + misfit
            if low >= most:
                return joins, low, []
            # Of each two classes that may join, try one pair of visits.
            left = firsts(
                ((min(a, b), max(a, b)), pair)
                for pair in self._pairs
                for a, b in [joins[[*pair]].tolist()]
                if a != b and not classes.apart[0, a, b]
            )
            worth = dict[tuple[int, int], float]()
            for (a, b), pair in left.items():
                look_at_clock()
                counts = classes.counts_lacking(a, b)
                worth[pair] = misfit + (
                    math.inf if counts is None else self._price(counts, classes, least)
                )
            forced = [pair for pair, nats in worth.items() if nats >= most]
            if not forced:
                return joins, low, sorted(worth, key=lambda pair: -worth[pair])
            joins = visits.joined(joins, forced)
