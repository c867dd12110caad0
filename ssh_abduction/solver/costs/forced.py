"""Joins that every cheap map has, a lower bound on the cost of all maps, and a list of cheap maps.

A join is two visits that a map puts at one place (without frames, two steps at one dstate). Let F
be joins that every map of a cost below T has. At first F is empty. Each such map costs at least the
cost of F less what further joins may gain (next paragraph). Now take a further join. If every map
without it costs T or more, then every map of a cost below T has the join, and F gets it. Then F
costs more, and fewer joins may follow. If the bound is T or more, then no map costs less than T.
Only joins of the best known map are tried. If F gets no further join, assume that a map lacks a
certain join, and find what all cheap maps without this join have. If no map without it costs less
than T, F gets it. If this fails for single joins, assume that a map lacks two.

*What a join may gain.* There are two bounds, and the greater one counts. For the first one, a join
gains at most what a new place, or a new dstate, costs at its first step (`theory/prior.py`). The
second one knows how surely F predicts each class. A map that joins more classes than F costs

    χ²/2 + ½ log |H| + ½ log |D| + (what is left does not depend on poses),

where H is the information matrix of F, and D is the covariance of the differences that the further
joins make zero, both at the poses of the map. χ² is never less than that of F. Sort the classes. A
class that is joined with an earlier one gives D a factor that is at least the variance of this
class if all classes before it are known. So the join gains at most the logarithm of the density of
a new place, less half of the logarithm of this variance.

*Other poses.* H and these variances hold for the poses of F, and other joins have other poses. Let
s be the slopes of their logarithms, as a vector, and C the covariance of the poses of F. Poses that
are off by d raise χ²/2 by ½ d'C⁻¹d and lower the rest by at most s'd. So the cost is at least that
at the poses of F less ½ s'Cs. This is the second order. The third is left out, so s'Cs is
subtracted, twice as much. Products s'Cs of two classes that may both be joined are shared by them.
What moves cost has slopes, too, and may make poses less sure (`Prior.least_chosen`).

*All cheap maps.* If the bound is near the cost of the best map, list all maps of a cost below T.
Take two classes that may be joined, and assume first that they are not, and then that they are. A
branch ends if its bound is T or more, or if no two classes may be joined.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from itertools import chain, combinations
from typing import NamedTuple

import numpy as np

from ssh_abduction.data.groups import firsts, gathered, indices_of, numbered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.runtime.clock import LONG_TURN, SHORT_TURN, look_at_clock
from ssh_abduction.solver.costs.estimating import Course
from ssh_abduction.solver.costs.joined import Gains, Ints, Joined, Visits
from ssh_abduction.solver.costs.misfit import Misfit
from ssh_abduction.solver.geometry.poses import Poses, conditional, framed, may_be_joined
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.prior import Array, LeastMoves
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.speedups import row

# Search for a higher bound until it is known to these shares: before a proof, and after it failed.
ROUGHLY, NEARLY = 0.05, 0.01
# The bound compares all pairs of visits, so it is only for traces of at most LONGEST steps.
LONGEST = 2500
# Consider joins of each visit with the last visits to its place, with at least one. Of all visits
# together, consider about this many joins at most.
PAIRS = 5000
# List all cheap maps only if the bound is at least this share of their cost.
NEAR = 0.9
# To list all cheap maps, make at most LISTED steps.
LISTED = 100
# Keep the poses of the last KEPT sets of classes.
KEPT = 8
# Give up if assuming the lack of a join added nothing to F, BRANCHES times in a row.
BRANCHES = 3


class _Proven(NamedTuple):
    """Joins that every cheap map is proven to have.

    Attributes:
        visits: The visits, with what is known to be apart or to meet.
        joins: The class of each visit.
        low: A lower bound on the cost of maps with these joins.
        lacking: Pairs of visits that are joined in the best map, but perhaps not in all cheap maps.
            Maps that do not join the first pair cost most.
    """

    visits: Visits
    joins: Ints
    low: float = -math.inf
    lacking: Sequence[tuple[int, int]] = ()


class Forcing:
    """Finds joins (pairs of visits at one place) that every cheap map has.

    Attributes:
        visits: The visits of the trace.
        joins: The joins that every cheap map is proven to have: the class of each visit.
        low: A lower bound on the cost of every map with these joins.
    """

    def __init__(self, problem: Problem, log: Log, misfit: Misfit, ssh_map: SSHMap) -> None:
        """Chart the trace of a problem. `ssh_map` is its best known map."""
        self._misfit, self._prior = misfit, problem.prior
        self._is_causal = problem.theory.level == "causal"
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
        # A map is bounded again if two of its classes are apart, or by its poses.
        self._bounding = lru_cache(maxsize=KEPT)(misfit.bounding)

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

    def bounds(
        self, most: float, low: float = 0.0, depth: int = 0, nearly: float = NEARLY
    ) -> Iterator[float]:
        """Yield lower bounds, above `low` and at most `most`, on the cost of all maps.

        Up to `depth` joins at a time are assumed to be lacking. `joins` does not change. All maps
        of a cost below `most` have these joins, and more joins the less such a map may cost. End
        if the highest such bound is known to the share `nearly`.
        """
        state, gap = _Proven(self.visits, self.joins), nearly * most
        while most - low > gap:
            middle = (low + most) / 2
            found = self._forced(state, middle, depth)
            if found.low >= middle:
                low = middle
                yield low
            else:
                state, most = found, middle

    def force(self, most: float, depth: int) -> None:
        """Find joins that every map of a cost below `most` has, until no more are found.

        Up to `depth` joins at a time are assumed to be lacking.
        """
        self._forced(_Proven(self.visits, self.joins), most, depth, keep=True)

    def courses(self, most: float) -> list[Course] | None:
        """List the dstates and places of all maps of a cost below `most`, and perhaps some more.

        Returns None if they are too many. Each pair of classes that may be joined is taken to be
        joined, and then not to be joined.
        """
        found, waiting = list[Course](), [_Proven(self.visits, self.joins)]
        if self.low < NEAR * most:
            return None
        for _ in range(LISTED):
            if not waiting:
                return found
            visits, joins, low, _ = self._grown(waiting.pop(), most, True)
            if low >= most:
                continue
            classes = self._classes(visits, joins)
            if (pair := classes.open_pair()) is None:
                if classes.may_turn:
                    return None
                places = [0] * len(classes.place) if self._is_causal else classes.place.tolist()
                found.append((tuple(numbered(classes.node.tolist())), tuple(places)))
                continue
            kind, i, j = pair
            if kind == "place":
                waiting.append(_Proven(visits.parted([(i, j)]), joins))
                waiting.append(_Proven(replace(visits, met=(*visits.met, (i, j))), joins))
            else:
                v, w = int(visits.visit[i]), int(visits.visit[j])
                waiting.append(_Proven(visits.lacking(v, w), joins))
                waiting.append(_Proven(visits, visits.joined(joins, [(v, w)])))
        return None

    def _classes(self, visits: Visits, joins: Ints) -> Joined:
        return Joined(visits, joins, self._misfit.visit, self._is_causal)

    def _ways(self, classes: Joined, by_poses: bool) -> list[list[Gains]]:
        """Bound the cost of a map that joins no classes, and what joins gain at most.

        There is a list for each way in which maps may explain closures. The bound by how surely
        poses are known takes longer, and is made if `by_poses`.
        """
        prior, found = self._prior, []
        named = [
            [*gathered(zip(of.tolist(), range(len(of)), strict=True)).values()]
            for of in (classes.node, classes.place)
        ]
        first = [[steps[0] for steps in some] for some in named]
        shown = [prior.least_shown(of, steps) for of, steps in enumerate(first)]
        new = [prior.new[steps, of] for of, steps in enumerate(first)]
        ways = self._bounding(tuple(classes.node.tolist()), tuple(classes.place.tolist()))
        for i, (poses, alias) in enumerate(ways):
            look_at_clock(LONG_TURN // 2)
            seen = [some * (not i) for some in shown]
            prices = [some + more for some, more in zip(seen, new, strict=True)]
            least = poses.misfit() / 2 + sum(float(some[1:].sum()) for some in prices)
            found.append([Gains(least + alias, *prices)])
            if by_poses and may_be_joined(poses):
                # Moves may end near nothing known.
                known = [prior.saved[steps, 1 - of] for of, steps in enumerate(first)]
                seen = [some - less for some, less in zip(seen, known, strict=True)]
                nats = poses.likelihood(prior.wide)[1] + float(prior.base[-1]) + alias
                nats += sum(float(some.sum()) for some in seen) - prior.crowd * len(named[1])
                # If an alias explains closures, or poses are too unsure, moves may cost nothing.
                least_moves = [] if i else [self._moves(classes, poses)]
                for moves in (*least_moves, None):
                    with suppress(np.linalg.LinAlgError):
                        found[-1].append(self._joining(classes, named, poses, nats, seen, moves))
                        break
        return found

    def _moves(self, classes: Joined, poses: Poses) -> LeastMoves:
        course = classes.node.tolist(), classes.place.tolist()
        return self._prior.least_chosen(*course, framed(poses), classes.parted)

    def _joining(
        self,
        classes: Joined,
        named: Sequence[Sequence[Sequence[int]]],
        poses: Poses,
        nats: float,
        seen: Sequence[Array],
        moves: LeastMoves | None,
    ) -> Gains:
        """Compute what joins gain at most from how surely each class is predicted.

        `named` has the steps of each dstate and of each place, `nats` the cost of a map that joins
        no classes, `seen` what each dstate and place pays for what it shows, and `moves` what moves
        cost.
        """
        prior = self._prior
        free = math.log(prior.wide[2]) / 2, math.log(prior.wide[0]) - prior.crowd
        # In the order of first steps, each class may be joined with any class before it.
        units = sorted(
            (steps[0], -of, k)
            for of, some in enumerate(named)
            for k, steps in enumerate(some)
            if steps[0] and classes.open[of][k]
        )
        columns = [[2 * k, 2 * k + 1] if of else [2 * len(named[1]) + k] for _, of, k in units]
        logs, products = conditional(poses, [*chain(*columns)], moves and moves.pulls)
        begins = np.cumsum([0, 1, *map(len, columns)])[:-1] if units else np.array([0])
        products = np.add.reduceat(np.add.reduceat(products, begins), begins, axis=1)
        # The least of cost + slope is half a product below the cost. Take it twice.
        more = 2 * products[0, 1:] + np.maximum(products[1:, 1:], 0.0).sum(1)
        more -= np.add.reduceat(logs, begins[1:] - 1) if units else 0.0
        if moves:
            nats += moves.nats
            seen = [some + most for some, most in zip(seen, moves.saved, strict=True)]
        gains = [np.zeros(len(some)) for some in seen]
        for (_, of, k), nats_of in zip(units, more.tolist(), strict=True):
            gains[-of][k] = max(free[-of] + seen[-of][k] + nats_of, 0.0)
        return Gains(nats - float(products[0, 0]), *gains)

    def _forced(self, state: _Proven, most: float, depth: int, *, keep: bool = False) -> _Proven:
        """Add joins that every map of a cost below `most` has.

        Up to `depth` joins at a time are assumed to be lacking. If `keep`, keep what is found.
        """
        wanted = 1  # look for twice as many joins each time before what they imply
        while True:
            state = self._grown(state, most, False)
            if keep:
                self.visits, self.joins, self.low = state.visits, state.joins, state.low
            if state.low >= most:
                return state
            visits, joins, _, lacking = state
            for less in range(depth):
                found, failed = 0, 0
                for i, j in lacking:
                    if found == wanted or failed == BRANCHES:
                        break
                    if joins[i] != joins[j]:
                        branch = _Proven(visits.lacking(i, j), joins)
                        if self._forced(branch, most, less).low >= most:
                            joins, found, failed = visits.joined(joins, [(i, j)]), found + 1, 0
                        else:
                            failed += 1
                state = state._replace(joins=joins)
                if found:
                    break
            else:
                return state
            wanted *= 2

    def _grown(self, state: _Proven, most: float, is_last: bool) -> _Proven:
        """Add joins that every map of a cost below `most` has, as far as bounds alone show them.

        If `is_last`, also find places that are not one in these maps.
        """
        visits, joins = state.visits, state.joins
        while True:
            look_at_clock(LONG_TURN // 2)
            classes = self._classes(visits, joins)
            if classes.fails:
                return _Proven(visits, joins, math.inf)
            # Of each two classes that may join, try one pair of visits.
            left = firsts(
                ((min(a, b), max(a, b)), pair)
                for pair in self._pairs
                for a, b in [joins[[*pair]].tolist()]
                if a != b and not classes.apart[0, a, b]
            )
            for by_poses in (False, True):  # first, force what the faster bound forces
                ways = self._ways(classes, by_poses)
                if (low := classes.low(ways)) >= most:
                    return _Proven(visits, joins, low)
                lacking = list[tuple[float, tuple[int, int]]]()
                for (a, b), pair in left.items():
                    look_at_clock(SHORT_TURN // 2)
                    lacking.append((classes.low_lacking(ways, a, b), pair))
                if forced := [pair for nats, pair in lacking if nats >= most]:
                    break
            met = [] if forced else self._met(classes, ways, most)
            far = [] if forced or met or not is_last else self._far(visits, joins, classes, most)
            if not forced and not met and not far:
                lacking.sort(reverse=True)
                return _Proven(visits, joins, low, [pair for _, pair in lacking])
            joins = visits.joined(joins, forced)
            visits = replace(visits.parted(far), met=(*visits.met, *met))

    def _met(
        self, classes: Joined, ways: Sequence[Sequence[Gains]], most: float
    ) -> list[tuple[int, int]]:
        """Find pairs of steps that are at one place in every map of a cost below `most`."""
        place, at = classes.place.tolist(), self.visits.at
        first = firsts((p, t) for t, p in enumerate(place))
        found = []
        for t, p in enumerate(place):
            if first[p] < t:
                continue
            for other, i in first.items():
                if i < t and at[i] == at[t] and classes.may_meet(other, p):
                    look_at_clock(SHORT_TURN)
                    if classes.low_apart(ways, other, p) >= most:
                        found.append((i, t))
                        break
        return found

    def _far(
        self, visits: Visits, joins: Ints, classes: Joined, most: float
    ) -> list[tuple[int, int]]:
        """Find pairs of steps that are at one place in no map of a cost below `most`.

        They are at different places of the best map.
        """
        at = self.visits.at
        first = [*firsts((p, t) for t, p in enumerate(classes.place.tolist())).items()]
        found = []
        for (p, i), (q, j) in combinations(first, 2):
            if at[i] != at[j] and classes.may_meet(p, q):
                look_at_clock(LONG_TURN // 2)
                meeting = self._classes(replace(visits, met=(*visits.met, (i, j))), joins)
                if any(meeting.low(self._ways(meeting, poses)) >= most for poses in (False, True)):
                    found.append((i, j))
        return found
