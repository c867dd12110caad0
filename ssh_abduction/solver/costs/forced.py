"""Joins that every cheap map has, a lower bound on the cost of all maps, and a list of cheap maps.

A join is two visits that a map puts at one place (without frames, two steps at one dstate). Let F
be joins that every map of a cost below T has. At first F is empty. Each such map costs at least the
cost of F less what further joins may gain (next paragraph). Now take a further join. If every map
without it costs T or more, then every map of a cost below T has the join, and F gets it. Then F
costs more, and fewer joins may follow. If the bound is T or more, then no map costs less than T.
Only joins of the best known map are tried.

*Branch and bound.* If F gets no further join, halve the maps: those without a certain join, and
those with it. Both halves have a bound of their own, and all that their cheap maps have. The half
with the lowest bound is halved next, so this bound holds for all maps. A half ends if its bound is
T or more, or if no two classes may be joined: this is a map. If no half is left, these are all maps
of a cost below T. A low T is fast. So first take T to be between the first bound and the cost of
the best map, then this cost, which proves that the map is the best one, and last a higher one, to
find all rivals. The work for a limit grows exponentially with it. As soon as the proof seems to fit
into the work that is left, the lower limits that remain are left out.

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
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property, lru_cache
from heapq import heappop, heappush
from itertools import chain, combinations, count
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

# First prove bounds that leave these shares of the gap between the first one and the best map.
SHARES = 0.75, 0.6, 0.5, 0.4, 0.3, 0.2
# The bound compares all pairs of visits, so it is only for traces of at most LONGEST steps.
LONGEST = 2500
# Consider joins of each visit with the last visits to its place, with at least one. Of all visits
# together, consider about this many joins at most.
PAIRS = 5000
# Without the bound by poses, halving is slower than clingo. Then halve the maps this many times.
HALVED = 20
# Keep the poses of the last KEPT sets of classes, and what is known of so many classes that they
# have about FLAGS flags.
KEPT, FLAGS = 50, 10**6


class _Part(NamedTuple):
    """Some of the maps, and joins that all cheap ones among them are proven to have.

    Attributes:
        visits: The visits, with what is known to be apart or to meet.
        joins: The class of each visit.
        low: A lower bound on the cost of these maps.
        lacking: Pairs of visits that are joined in the best map, but perhaps not in all cheap maps.
            Maps that do not join the first pair cost most.
    """

    visits: Visits
    joins: Ints
    low: float = -math.inf
    lacking: Sequence[tuple[int, int]] = ()


class Forcing:
    """Finds joins (pairs of visits at one place) that every cheap map has, and all cheap maps.

    Attributes:
        found: The dstates and places of maps that may cost less than the limit, for each step.
        is_complete: Whether these are all such maps.
    """

    def __init__(self, problem: Problem, log: Log, misfit: Misfit, ssh_map: SSHMap) -> None:
        """Chart the trace of a problem. `ssh_map` is its best known map."""
        self._misfit, self._prior = misfit, problem.prior
        self._is_causal = problem.theory.level == "causal"
        visits = Visits.of(problem, log, ssh_map)
        at: dict[int, list[int]] = indices_of(visits.place.tolist())
        most = max(PAIRS // len(visits.place), 1)
        self._pairs = [
            (i, j)
            for some in at.values()
            for k, j in enumerate(some)
            for i in some[max(k - most, 0) : k]
        ]
        self._all = _Part(visits, visits.joined(np.arange(len(visits.place)), []))
        # The parts that may have cheap maps, by their bounds, and the maps that were found.
        self._open, self._leaves, self._most = [(-math.inf, 0, self._all)], list[_Part](), math.inf
        self.found, self.is_complete = list[Course](), False
        self._may_turn = False  # whether a map that was found may be several maps
        # A map is bounded again if two of its classes are apart, or by its poses.
        self._bounding = lru_cache(maxsize=KEPT)(misfit.bounding)
        self._judged = lru_cache(maxsize=max(FLAGS // visits.apart.size, 1))(self._judge)

    @staticmethod
    def holds_for(problem: Problem) -> bool:
        """Whether the bound holds for a theory, and the trace is not too long for it."""
        theory = problem.theory
        if theory.misread and theory.star == "none":
            theory = theory.replace(misread=0.0)
        is_known = row("visits").holds_for(theory) or row("clique").holds_for(theory)
        return is_known and not theory.has_faults and len(problem.trace) <= LONGEST

    @cached_property
    def _is_by_poses(self) -> bool:
        """Whether there is the bound by poses if no classes are joined."""
        classes = self._classes(self._all.visits, self._all.joins)
        poses, _ = self._bounding(tuple(classes.node.tolist()), tuple(classes.place.tolist()))[0]
        return may_be_joined(poses)

    def returns(self, most: float) -> list[Equality]:
        """List returns that every map of a cost below `most` is proven to have."""
        parts = [part for *_, part in self._open] + self._leaves
        if not parts or self._most < most:
            return []
        common = np.unique([part.joins for part in parts], axis=1, return_inverse=True)[1]
        return self._all.visits.returns(common.ravel())

    def limits(self, nats: float, most: float) -> list[float]:
        """List limits for `bounds`, one after the other. The best known map costs `nats`.

        A low limit is fast, and proves a bound. The last ones are `nats` and `most`.
        """
        least = self._grown(self._all, most, False).low
        return [one for share in SHARES if (one := nats - share * (nats - least)) > least] + [
            nats,
            most,
        ]

    def bounds(self, most: float) -> Iterator[float]:
        """Find all maps of a cost below `most`, and yield lower bounds on the cost of all maps."""
        self._open, self._leaves, self._most = [(-math.inf, 0, self._all)], [], most
        self._may_turn = False
        self.found, self.is_complete, number = [], False, count()
        part = self._grown(self._all, most, False)
        self._open = [(part.low, next(number), part)] * (part.low < most)
        for _ in count() if self._is_by_poses else range(HALVED):
            if not self._open:
                break
            part = self._open[0][2]
            yield min(one.low for one in (part, *self._leaves))
            halves = self._halves(part, most)
            heappop(self._open)  # if a limit ends the halving, the part stays
            for half in halves:
                if (low := max(half.low, part.low)) < most:
                    heappush(self._open, (low, next(number), half._replace(low=low)))
        self.is_complete = not self._open and not self._may_turn
        left = [*self._leaves, *(part for *_, part in self._open)]
        yield min((part.low for part in left), default=most)

    def _halves(self, part: _Part, most: float) -> list[_Part]:
        """Halve the maps, and grow both halves. Keep the map if there is only one."""
        if not part.lacking:
            part = self._grown(part, most, True)
        visits, joins, low, lacking = part
        if low >= most:
            return []
        if lacking:
            pair = lacking[0]
        else:
            classes, _ = self._judged(visits, tuple(joins.tolist()))
            if (steps := classes.open_pair()) is None:
                places = [0] * len(classes.place) if self._is_causal else classes.place.tolist()
                self.found.append((tuple(numbered(classes.node.tolist())), tuple(places)))
                self._leaves.append(part)
                self._may_turn |= classes.may_turn
                return []
            kind, i, j = steps
            if kind == "place":
                met = replace(visits, met=(*visits.met, (i, j)))
                halves = part._replace(visits=visits.parted([(i, j)])), part._replace(visits=met)
                return [self._grown(half, most, False) for half in halves]
            pair = int(visits.visit[i]), int(visits.visit[j])
        without = part._replace(visits=visits.lacking(*pair))
        halves = without, part._replace(joins=visits.joined(joins, [pair]))
        return [self._grown(half, most, False) for half in halves]

    def _classes(self, visits: Visits, joins: Ints) -> Joined:
        return Joined(visits, joins, self._misfit.visit, self._is_causal)

    def _judge(self, visits: Visits, joins: tuple[int, ...]) -> tuple[Joined, list[list[Gains]]]:
        """Collect what is known of classes, and bound the cost of maps that have them."""
        classes = self._classes(visits, np.array(joins))
        return classes, [] if classes.fails else self._ways(classes)

    def _ways(self, classes: Joined) -> list[list[Gains]]:
        """Bound the cost of a map that joins no classes, and what joins gain at most.

        There is a list for each way in which maps may explain closures.
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
            if may_be_joined(poses):
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
        may_join = classes.open
        # In the order of first steps, each class may be joined with any class before it.
        units = sorted(
            (steps[0], -of, k)
            for of, some in enumerate(named)
            for k, steps in enumerate(some)
            if steps[0] and may_join[of][k]
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

    def _grown(self, part: _Part, most: float, is_last: bool) -> _Part:
        """Add joins that every map of a cost below `most` has, as far as bounds alone show them.

        If `is_last`, also find places that are not one in these maps.
        """
        visits, joins = part.visits, part.joins
        while True:
            look_at_clock(LONG_TURN // 2)
            classes, ways = self._judged(visits, tuple(joins.tolist()))
            if classes.fails:
                return _Part(visits, joins, math.inf)
            # Of each two classes that may join, try one pair of visits.
            left = firsts(
                ((min(a, b), max(a, b)), pair)
                for pair in self._pairs
                for a, b in [joins[[*pair]].tolist()]
                if a != b and not classes.apart[0, a, b]
            )
            if (low := classes.low(ways)) >= most:
                return _Part(visits, joins, low)
            lacking = list[tuple[float, tuple[int, int]]]()
            for (a, b), pair in left.items():
                look_at_clock(SHORT_TURN // 2)
                lacking.append((classes.low_lacking(ways, a, b), pair))
            forced = [pair for nats, pair in lacking if nats >= most]
            met = [] if forced else self._met(classes, ways, most)
            far = [] if forced or met or not is_last else self._far(visits, joins, classes, most)
            if not forced and not met and not far:
                lacking.sort(reverse=True)
                return _Part(visits, joins, low, [pair for _, pair in lacking])
            joins = visits.joined(joins, forced)
            visits = replace(visits.parted(far), met=(*visits.met, *met))

    def _met(
        self, classes: Joined, ways: Sequence[Sequence[Gains]], most: float
    ) -> list[tuple[int, int]]:
        """Find pairs of steps that are at one place in every map of a cost below `most`."""
        place, at = classes.place.tolist(), self._all.visits.at
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
        at = self._all.visits.at
        first = [*firsts((p, t) for t, p in enumerate(classes.place.tolist())).items()]
        found = []
        for (p, i), (q, j) in combinations(first, 2):
            if at[i] != at[j] and classes.may_meet(p, q):
                look_at_clock(LONG_TURN // 2)
                meeting = self._classes(replace(visits, met=(*visits.met, (i, j))), joins)
                if meeting.low(self._ways(meeting)) >= most:
                    found.append((i, j))
        return found
