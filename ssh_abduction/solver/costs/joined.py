"""Classes of visits that are at one place in every cheap map, and what further joins may gain.

A join is two visits that a map puts at one place (without frames, two steps at one dstate).

*Apart.* Two visits that cannot be at one place are apart. If the same action leads from two visits
to visits that are apart, these two are apart, too (`steps/chart.py`). Visits that are at one place
in every cheap map are apart from the same visits. A map joins no two classes of a clique of classes
that are apart. So each class outside a largest clique may be joined with an earlier one, and the
others may not: the bound takes the joins that gain most.

*Misread views.* If views may be misread, only evidence makes visits apart. Take k classes of visits
with a view each, such that any two are apart or differ in their views. If a map has fewer dstates
than k, it misreads all views of some classes, one for each dstate less. A class of several visits
costs several views then. The bound is the least over the number of dstates.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import product
from operator import or_
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.groups import NodeClasses, firsts, gathered, numbered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solver.steps.apart import apart_classes, apart_matrix, grown_clique
from ssh_abduction.solver.steps.chart import Chart, FramedChart
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.fields import FAULT
from ssh_abduction.theory.prior import Array
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.speedups import row

Ints = NDArray[np.int_]
Flags = NDArray[np.bool_]

# Try a clique with each of at most TRIED pairs that were not apart before.
TRIED = 20


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
        at: The place of each step in the map.
        met: Pairs of steps at one place, besides joins.
    """

    visit: Ints
    direction: Ints
    seen: Ints
    place: Ints
    links: Ints
    apart: Flags
    away: Flags | None
    at: Sequence[int]
    price: Array | None = None
    met: tuple[tuple[int, int], ...] = ()

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
        where = place[visit].tolist()
        return cls(visit, (slot + turned[visit]) % 4, seen, place, links, apart, None, where)

    @classmethod
    def _of_steps(cls, log: Log, ssh_map: SSHMap, misreads: bool) -> Visits:
        steps, none = len(log.seen), np.zeros(len(log.seen), dtype=int)
        links = np.stack([none[1:], np.array(log.actions, dtype=int), none[1:]], 1)
        chart = Chart.of_steps(log, steps)
        apart = (replace(chart, seen=tuple(none.tolist())) if misreads else chart).apart()[None]
        place = np.array(ssh_map.dstate_at)
        away = apart_matrix(log.pairs.elsewhere, steps)
        at = [s if (p := ssh_map.dstates[s].place) is None else p for s in ssh_map.dstate_at]
        return cls(np.arange(steps), none, np.array(log.seen), place, links, apart, away, at)

    def lacking(self, first: int, second: int) -> Visits:
        """Copy the visits, with a flag that two of them are not joined as in the map."""
        apart = self.apart.copy()
        apart[0, first, second] = apart[0, second, first] = True
        return replace(self, apart=apart)

    def parted(self, pairs: Sequence[tuple[int, int]]) -> Visits:
        """Copy the visits, with flags that pairs of steps are at different places."""
        if not pairs:
            return self
        apart, away = self.apart.copy(), None if self.away is None else self.away.copy()
        i, j = np.array(pairs).T
        apart[:, self.visit[i], self.visit[j]] = apart[:, self.visit[j], self.visit[i]] = True
        if away is not None:
            away[i, j] = away[j, i] = True
        return replace(self, apart=apart, away=away)

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


class _MoreApart(NamedTuple):
    """What changes if some more pairs of nodes are apart.

    Attributes:
        sizes: The sizes of the cliques of the parts that have these pairs.
        fixed: The nodes that cannot be joined with earlier ones any more.
    """

    sizes: dict[int, int]
    fixed: set[int]


class _Cliques:
    """A clique in each part of the nodes. Nodes of different parts are always apart.

    So the union of the cliques is a clique, too. Nodes are in the order of their first steps. A set
    of nodes is a number with a bit for each node, as such sets are small and intersected often.
    """

    def __init__(self, apart: Flags) -> None:
        """Find the cliques."""
        self.apart = apart
        flags, random = np.packbits(apart, axis=1, bitorder="little"), np.random.default_rng(0)
        self._rows = rows = [int.from_bytes(row.tobytes(), "little") for row in flags]
        self._part, self._members, self._cliques = [0] * len(rows), list[int](), list[int]()
        left = (1 << len(rows)) - 1
        while left:
            found = new = left & -left
            while new:
                new = left & ~found & reduce(or_, (~rows[node] for node in _nodes(new)))
                found |= new
            left ^= found
            some = [*_nodes(found)][::-1]
            for node in some:
                self._part[node] = len(self._members)
            self._members.append(found)
            if len(some) > 1:
                clique = grown_clique(apart[np.ix_(some, some)], [], random)
                found = sum(1 << some[k] for k in clique)
            self._cliques.append(found)
        self._may_join = [(~row & (1 << k) - 1).bit_count() for k, row in enumerate(rows)]
        self._size = sum(map(int.bit_count, self._cliques))
        self._lost: dict[int, tuple[Array, list[list[tuple[float, int]]], list[float]]] = {}

    @property
    def open(self) -> Flags:
        """Flag the nodes that are not apart from all others."""
        free = ~self.apart
        np.fill_diagonal(free, False)
        found: Flags = np.asarray(free.any(axis=1))
        return found

    def size(self, change: _MoreApart) -> int:
        """Return the size of a clique of the whole graph after a change."""
        return self._size + sum(
            size - self._cliques[part].bit_count() for part, size in change.sizes.items()
        )

    def lost(self, gains: Array, change: _MoreApart) -> float:
        """Return the most that joins of nodes may gain after a change.

        `gains` has what each node gains at most if it is joined with earlier ones. Nodes of a
        clique are not joined, so the nodes that gain least are taken to be these.
        """
        # The gains are kept, so no other gains get their id.
        if id(gains) not in self._lost:
            ranked: list[list[tuple[float, int]]] = [[] for _ in self._members]
            for gain, node in sorted(zip(gains.tolist(), range(len(gains)), strict=True)):
                if self._may_join[node] and gain > 0:
                    ranked[self._part[node]].append((gain, node))
            nothing = [
                self._lost_in(p, some, _MoreApart({}, set())) for p, some in enumerate(ranked)
            ]
            self._lost[id(gains)] = gains, ranked, nothing
        _, ranked, before = self._lost[id(gains)]
        return math.fsum(before) + math.fsum(
            self._lost_in(part, ranked[part], change) - before[part] for part in change.sizes
        )

    def _lost_in(self, part: int, ranked: list[tuple[float, int]], change: _MoreApart) -> float:
        """Return the most that joins may gain in one part. `ranked` has gains and their nodes."""
        left = [gain for gain, node in ranked if node not in change.fixed]
        size = change.sizes.get(part, self._cliques[part].bit_count())
        return math.fsum(left[max(size - self._members[part].bit_count() + len(left), 0) :])

    def changed(self, pairs: Sequence[tuple[int, int]]) -> _MoreApart:
        """Find what changes if some more pairs are apart."""
        new = {(min(u, v), max(u, v)) for u, v in pairs if not self.apart[u, v]}
        if not new:
            return _MoreApart({}, set())
        rows, before = self._rows, {v: self._rows[v] for pair in new for v in pair}
        fewer = Counter(v for _, v in new)
        for u, v in new:
            rows[u] |= 1 << v
            rows[v] |= 1 << u
        best = {self._part[v]: self._cliques[self._part[v]] for _, v in new}
        for u, v in pairs[:TRIED]:
            if (part := self._part[u]) not in best:
                continue
            found = best[part] & rows[u] & rows[v] | 1 << u | 1 << v
            left = self._members[part]
            for node in _nodes(found):
                left &= rows[node]
            while found.bit_count() + left.bit_count() > best[part].bit_count():
                if not left:
                    best[part] = found
                    break
                node = max(_nodes(left), key=lambda node: (rows[node] & left).bit_count())
                found |= 1 << node
                left &= rows[node]
        for v, others in before.items():
            rows[v] = others
        fixed = {v for v, number in fewer.items() if number == self._may_join[v]}
        return _MoreApart({part: some.bit_count() for part, some in best.items()}, fixed)


def _nodes(bits: int) -> Iterator[int]:
    """Yield the nodes of a set."""
    while bits:
        node = bits.bit_length() - 1
        yield node
        bits ^= 1 << node


class Gains(NamedTuple):
    """A lower bound on the cost of maps by the classes that they join.

    Attributes:
        nats: The cost of a map that joins no classes.
        dstates: What each dstate gains at most if it is joined with earlier ones.
        places: What each place gains at most if it is joined with earlier ones.
    """

    nats: float
    dstates: Array
    places: Array


class Joined:
    """Classes of visits that are at one place in every cheap map.

    Attributes:
        apart: The flag [R, A, B] says that classes A and B are apart, as in `Visits`.
        fails: Whether no map has these classes.
        node: The number of the dstate of each step, if no classes are joined.
        place: The number of the place of each step, if no classes are joined.
        spoilt: The nats of views that are misread in each map with these classes.
        excused: The nats that misreading all views of 0, 1, 2, … classes costs at least.
    """

    def __init__(self, visits: Visits, of: Ints, places: Sequence[int], is_causal: bool) -> None:
        """Collect what is known of classes of visits.

        Without frames, `places` has the place of each step if no classes are joined. If
        `is_causal`, each dstate is a place.
        """
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
        ways = np.column_stack([of[visits.visit], visits.direction])
        nodes, begin, node = np.unique(ways, axis=0, return_index=True, return_inverse=True)
        order = np.argsort(begin)
        self.node = np.argsort(order)[node]
        (a, x), of_step = nodes[order].T, self.node
        self._node = {(a, x): node for node, (a, x) in enumerate(nodes[order].tolist())}
        apart = self.apart[(x - x[:, None]) % self._turns, a[:, None], a]
        apart |= (a[:, None] == a) & (x[:, None] != x)
        self._dstates = _Cliques(apart)
        self.spoilt, self.excused = 0.0, np.zeros(1)
        if visits.price is not None:
            shown = np.zeros((len(nodes), int(visits.seen.max()) + 1))
            np.add.at(shown, (of_step, visits.seen), visits.price)
            of_views = np.unique(np.stack([of_step, visits.seen]), axis=1)[0]
            # Of two classes with a view each, and not the same one, one is misread in full if they
            # are one dstate.
            single = np.bincount(of_views) == 1
            view = np.where(single, shown.argmax(axis=1), -1)
            differ = (view[:, None] != view) & single[:, None] & single
            self._differ = _Cliques(apart | differ)
            whole = shown.sum(axis=1)
            self.spoilt = float((whole - shown.max(axis=1)).sum())
            self.excused = np.cumsum([0.0, *np.sort(whole[single])])
        self._kind = "frames" if visits.away is None else "causal" if is_causal else "places"
        at, class_at = NodeClasses[tuple[str, int]](), of[visits.visit].tolist()
        self._class_at = class_at
        for t, name in enumerate(places):
            at.merge(("step", t), ("class", class_at[t]))
            at.merge(("step", t), ("visit", name))
        for i, j in visits.met:
            at.merge(("step", i), ("step", j))
        self.place = np.array(numbered(at.of(("step", t)) for t in range(len(places))))
        self._at = gathered(dict.fromkeys(zip(self.place.tolist(), class_at, strict=True)))
        if visits.away is not None and not is_causal:
            apart = apart_classes(visits.away[None], self.place)[0]
        else:
            of_class = np.array(
                [x for _, x in sorted({*zip(class_at, self.place.tolist(), strict=True)})]
            )
            apart = apart_classes(np.logical_and.reduce(self.apart)[None], of_class)[0]
        self.fails = bool(apart.diagonal().any())
        if not self.fails:
            self._places = _Cliques(apart)

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

    def low(self, ways: Sequence[Sequence[Gains]]) -> float:
        """Return a lower bound on the cost of maps with these classes."""
        return self._low(ways, (), ())

    def low_lacking(self, ways: Sequence[Sequence[Gains]], a: int, b: int) -> float:
        """Return a lower bound on the cost of maps that do not join two classes."""
        return self._low_without(ways, [(0, a, b)], [])

    def low_apart(self, ways: Sequence[Sequence[Gains]], a: int, b: int) -> float:
        """Return a lower bound on the cost of maps that do not join two places."""
        turns, here, there = range(self._turns), self._at[a], self._at[b]
        return self._low_without(ways, [*product(turns, here, there)], [(a, b)])

    def may_meet(self, a: int, b: int) -> bool:
        """Whether two places may be one."""
        return not self._places.apart[a, b]

    def open_pair(self) -> tuple[str, int, int] | None:
        """Return two steps that may be at one place, or else at one dstate; None if there are none.

        At one dstate, their visits are joined without a turn.
        """
        for kind, cliques, of in (
            ("place", self._places, self.place),
            ("dstate", self._dstates, self.node),
        ):
            first = firsts((x, t) for t, x in enumerate(of.tolist()))
            for u, v in np.argwhere(np.triu(~cliques.apart, 1)).tolist():
                i, j = first[u], first[v]
                a, b = self._class_at[i], self._class_at[j]
                if kind == "place" or not self.apart[0, a, b]:
                    return kind, i, j
        return None

    @property
    def parted(self) -> tuple[Flags, Flags]:
        """Flag pairs of dstates, and of places, that are not joined."""
        return self._dstates.apart, self._places.apart

    @property
    def open(self) -> tuple[Flags, Flags]:
        """Flag the dstates, and the places, that may be joined with others."""
        return self._dstates.open, self._places.open

    @property
    def may_turn(self) -> bool:
        """Whether dstates may be one if their visits are turned."""
        return bool(self._dstates.open.any())

    def _low_without(
        self,
        ways: Sequence[Sequence[Gains]],
        joins: list[tuple[int, int, int]],
        places: list[tuple[int, int]],
    ) -> float:
        added = self._lack(joins)
        fails = any(not r and c == d for r, c, d in added)
        node = self._node
        nodes = [
            (u, v)
            for r, c, d in added
            for x in range(self._turns)
            if (u := node.get((c, x))) is not None
            if (v := node.get((d, (x + r) % self._turns))) is not None
        ]
        if self._kind != "places":
            where = {c: p for p, some in self._at.items() for c in some}
            pairs = {(c, d) for _, c, d in added if self.apart[:, c, d].all()}
            places = [*places, *((where[c], where[d]) for c, d in pairs if where[c] != where[d])]
        for r, c, d in added:
            self.apart[r, c, d] = self.apart[-r % self._turns, d, c] = False
        return math.inf if fails else self._low(ways, nodes, places)

    def _low(
        self,
        ways: Sequence[Sequence[Gains]],
        nodes: Sequence[tuple[int, int]],
        places: Sequence[tuple[int, int]],
    ) -> float:
        """Return a lower bound if some more dstates, and places, are apart."""
        of_dstates, of_places = self._dstates.changed(nodes), self._places.changed(places)
        hard = shown = 0
        if len(self.excused) > 1:
            hard = self._dstates.size(of_dstates)
            shown = self._differ.size(self._differ.changed(nodes))
        return self.spoilt + min(
            max(
                way.nats
                - min(self._dstates.lost(way.dstates, of_dstates), self._misread(way, hard, shown))
                - self._places.lost(way.places, of_places)
                for way in bounds
            )
            for bounds in ways
        )

    def _misread(self, way: Gains, hard: int, shown: int) -> float:
        """Return the most that joins of dstates may gain, less what they misread at least.

        There is a clique of `hard` dstates, and one of `shown` if no view is misread. If `shown` is
        0, no view may be misread.
        """
        if not shown:
            return math.inf
        left: list[float] = [*np.sort(way.dstates)[::-1].cumsum()[::-1].tolist(), 0.0]
        return max(
            left[min(k, len(left) - 1)] - float(self.excused[max(shown - k, 0)])
            for k in range(hard, max(shown, hard) + 1)
        )

    def _lack(self, waiting: list[tuple[int, int, int]]) -> list[tuple[int, int, int]]:
        """Flag classes as apart, and all that are apart if they are. Return the new flags."""
        added = []
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
