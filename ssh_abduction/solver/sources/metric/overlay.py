"""Merge the places and dstates of hypotheses that coincide.

An `Overlay` lays one hypothesis on another one, whose frame is unrelated at first. Merging two
dstates, or two places with a known turn, fixes the frames to each other. From then on the two
places that most surely coincide are merged first, and the poses are conditioned on each merge.
Dstates at one place are merged after all places, or at once if an axiom demands it. Dstates that
one action leads to from merged dstates are merged, too. If gateways may change between drives,
places with different gateways may be merged, at a price for each change. Dstates and places of one
piece of a map that must be kept are never merged.

*Smoothing* guesses a map of each part that displacements and closures connect. A beam goes through
the trace once, so it does not know the closures of later steps. After a long way it may join places
that only the drift brings together. Smoothing first fits the poses of all visits to the
displacements and closures, as if no two visits were to one place, and then merges them. It may also
begin with a map, such as one of a beam, whose places are then merged further.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from ssh_abduction.data.groups import firsts, gathered, numbered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.solver.geometry.equations import visits_by_turns
from ssh_abduction.solver.geometry.poses import Poses
from ssh_abduction.solver.sources.metric.hypothesis import (
    BLUR,
    Array,
    Hypothesis,
    conditioned,
    parts_of,
    rotated,
)
from ssh_abduction.solver.sources.metric.sights import Sight, Sights, seen_at_both
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.pairs import pairs_in
from ssh_abduction.theory.prior import spreads_of
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.theory import Theory

# The standard deviations of the frame of a drive, in metres and radians, before it is joined.
ANYWHERE = np.array([1e3, 1e3, 3.0])
# Poses that are one may differ by this standard deviation in radians, and by this share of a usual
# travel, as the equations are linear only near the means.
SLACK = 0.01
# Merge no places whose positions differ by a chi-square of more than this.
FAR = 16.0
# Two dstates of a place may be one if their headings differ by less than this many radians.
TURNED = 0.4


@dataclass(slots=True, eq=False)
class _State:
    """The dstates and places that are merged so far, with their poses.

    Attributes:
        dstate: For each dstate, the first dstate that it is merged with.
        place: For each place, the first place that it is merged with.
        seen: For each first dstate, what steps there show, as in `Hypothesis`.
        sights: For each first place, what each drive saw of it.
        links: For each first dstate, the dstate that each of its actions leads to.
    """

    dstate: list[int]
    place: list[int]
    seen: list[Mapping[int, float]]
    sights: list[Mapping[int, Sight]]
    links: list[dict[int, int]]
    mean: Array
    covariance: Array
    nats: float

    def copy(self) -> _State:
        """Copy everything that a merge changes in place."""
        links = [dict(links) for links in self.links]
        return replace(self, seen=[*self.seen], sights=[*self.sights], links=links)


class _ClashError(Exception):
    """Two dstates or places cannot be merged."""


class Overlay:
    """Merges the dstates and places of two maps, such as an old map and the map of a drive."""

    def __init__(
        self, standing: Hypothesis, drive: Hypothesis | None, problem: Problem, sights: Sights
    ) -> None:
        """Prepare the merges. Without a second map, the first one is merged with itself."""
        self._problem, theory = problem, problem.theory
        both = standing if drive is None else standing.beside(drive)
        self._both, self._sights = both, sights
        self._old = len(standing.places), len(standing.sights)
        self._position, self._heading = np.array(both.position), np.array(both.heading)
        self._step_at = both.step_at
        slack = SLACK * both.usual_travel(problem.trace)
        self._spreads = spreads_of(problem.trace).max(axis=0) + np.array([slack, slack, SLACK]) ** 2
        # What each dstate shows of itself, and of its place, in nats; and a dstate of each place.
        begins = firsts((s, t) for t, s in sorted(both.labels.items()))
        self._shown = problem.prior.seen[[begins[s] for s in range(len(both.places))]]
        self._first = firsts(zip(both.places, range(len(both.places)), strict=True))
        links: list[dict[int, int]] = [{} for _ in both.places]
        for (s, action), x in both.links.items():
            links[s][action] = x
        self._apart = _State(
            [*range(len(both.places))],
            [*range(len(both.sights))],
            [*both.seen],
            [*both.sights],
            links,
            both.mean,
            both.covariance,
            both.nats,
        )
        at = {t: both.places[s] for t, s in both.labels.items()}
        self._dstates_apart = KeptApart(both.labels, pairs_in(problem.pairs.apart), both.kept)
        places = ((both.places[s], piece) for s, piece in both.kept)
        self._places_apart = KeptApart.of_places(problem, at, places)
        # The cost of changed gateways if two places are one; inf if they cannot be.
        self._costs = np.full(2 * (len(both.sights),), math.inf)
        for (p, seen), (q, others) in combinations(enumerate(both.sights), 2):
            self._costs[p, q] = sights.merged(seen, others)
        old = len(standing.places) if drive else 0
        denied = denied_pairs(theory, standing, drive or standing)
        self._denied = {(s, old + x) for s, x in denied}
        # These change while the two maps are merged.
        self._state, self._changes = self._apart, self._costs

    @property
    def _is_forced(self) -> bool:
        """Whether a place has only one dstate for each direction of a path."""
        return "one_dstate_per_course" not in self._problem.theory.without

    def merge(self, old: int, new: int, turn: float | None = None) -> bool:
        """Merge a dstate of the old map with one of the drive, and then all that coincide.

        An earlier merge is undone first. With a `turn`, only their places are merged, and the map
        of the drive is turned by it, in radians. Returns whether the two can be one dstate, or one
        place.
        """
        self._state = self._apart
        new += self._old[0]
        both, places = self._both, (self._both.places[old], self._both.places[new])
        at = both.mean[self._position[places[0]] :][:2]
        equal = float(both.mean[self._heading[old]] - both.mean[self._heading[new]])
        self._lay(new, at, equal if turn is None else turn, is_turn_known=turn is not None)
        # The first merge only fixes the frames. Whether it pays is seen from those that follow.
        dstates = [(old, new)] if turn is None else []
        if not self._tried(dstates, None if dstates else places, most=math.inf):
            return False
        self.merge_all()
        return True

    def merge_all(self) -> None:
        """Merge all places that coincide."""
        merged = True
        while merged:  # what was refused may fit now
            merged, self._changes = False, self._costs.copy()
            while pair := self._surest():
                look_at_clock()
                # A place alone may gain too little. Its dstates and their views may gain more.
                if self._tried([], pair) or self._tried([], pair, has_dstates=True):
                    merged = True
                else:
                    self._changes[pair] = math.inf
        self._merge_coinciding(set(self._state.place))

    def part(self) -> Hypothesis:
        """Return the part that all merges so far make of the two parts."""
        both, state = self._both, self._state
        dstates, places = sorted(set(state.dstate)), sorted(set(state.place))
        number = {s: i for i, s in enumerate(dstates)}
        place = {p: i for i, p in enumerate(places)}
        position = self._position[places]
        poses = [*np.stack([position, position + 1], 1).ravel(), *self._heading[dstates]]
        # The state of the new part: x and y of each place, then the heading of each dstate.
        n = 2 * len(places)
        return Hypothesis(
            {t: number[state.dstate[s]] for t, s in both.labels.items()},
            [place[state.place[both.places[s]]] for s in dstates],
            [state.seen[s] for s in dstates],
            {
                (number[s], action): number[state.dstate[x]]
                for s in dstates
                for action, x in state.links[s].items()
            },
            [state.sights[p] for p in places],
            [*range(0, n, 2)],
            [*range(n, n + len(dstates))],
            state.mean[poses],
            state.covariance[np.ix_(poses, poses)],
            state.nats,
            kept=frozenset((number[state.dstate[s]], piece) for s, piece in both.kept),
        )

    def _lay(self, new: int, at: Array, angle: float, is_turn_known: bool = False) -> None:
        """Turn the new drive by an angle, and shift its dstate `new` to the position `at`.

        All poses of the drive get a large common covariance, as the pose of its frame is unknown.
        If the turn is known, it is known up to TURNED.
        """
        both, state = self._both, self._state
        headings = self._heading[self._old[0] :]
        x = self._position[self._old[1] :]
        there = self._position[both.places[new]]
        mean, covariance = rotated(both.mean, both.covariance, x, headings, there, angle)
        dx, dy = mean[x] - mean[there], mean[x + 1] - mean[there + 1]
        mean[x], mean[x + 1] = at[0] + dx, at[1] + dy
        by = np.zeros((len(mean), 3))
        by[x, 0], by[x + 1, 1] = 1.0, 1.0
        by[x, 2], by[x + 1, 2] = -dy, dx
        by[headings, 2] = 1.0
        by *= np.array([*ANYWHERE[:2], TURNED]) if is_turn_known else ANYWHERE
        self._state = replace(state, mean=mean, covariance=covariance + by @ by.T)

    def _surest(self) -> tuple[int, int] | None:
        """Find the two places that most surely coincide; None if there are none."""
        state = self._state
        places = np.array(sorted(set(state.place)))
        at = np.stack([self._position[places], self._position[places] + 1], 1)
        c = state.covariance
        across = c[at[:, None, :, None], at[None, :, None, :]]
        own = c[at[:, :, None], at[:, None, :]]
        # The chi-square of the offset of each two places, and the determinant of its covariance.
        spread = own[:, None] + own - across - across.swapaxes(2, 3) + np.diag(self._spreads[:2])
        off = state.mean[at][:, None] - state.mean[at]
        a, b, d = spread[..., 0, 0], spread[..., 0, 1], spread[..., 1, 1]
        size = np.maximum(a * d - b * b, BLUR**2)
        x, y = off[..., 0], off[..., 1]
        squares = (d * x * x - 2 * b * x * y + a * y * y) / size
        unlikely = squares + np.log(size) + 2 * self._changes[np.ix_(places, places)]
        unlikely[squares > FAR] = math.inf
        i, j = np.unravel_index(np.argmin(unlikely), unlikely.shape)
        return None if math.isinf(unlikely[i, j]) else (int(places[i]), int(places[j]))

    def _tried(
        self,
        dstates: list[tuple[int, int]],
        places: tuple[int, int] | None = None,
        most: float = 0.0,
        *,
        has_dstates: bool = False,
    ) -> bool:
        """Merge dstates or places, and what follows, if that costs less than `most` nats more.

        If `has_dstates`, the coinciding dstates of the places are merged, too. Return whether they
        were merged.
        """
        before = self._state
        self._state = before.copy()
        try:
            touched = set()
            if places and self._problem.theory.level == "topological":
                self._merge_places(*places, heading=None)
                touched = {places[0]}
            elif places:
                dstates = [(self._dstates_at(places[0])[0], self._dstates_at(places[1])[0])]
            touched |= self._merge_dstates(dstates)
            if dstates or has_dstates or self._is_forced:
                self._merge_coinciding(touched)
        except _ClashError:
            self._state = before
        if self._state.nats >= before.nats + most:
            self._state = before
        return self._state is not before

    def _merge_coinciding(self, places: set[int]) -> None:
        """Merge the coinciding dstates at some places, unless some of them cannot be one.

        If no axiom demands it, they are merged only if that lowers the cost.
        """
        refused: set[tuple[int, int]] = set()
        while pairs := [
            found for p in places for found in self._coinciding(p) if found[1] not in refused
        ]:
            before, (_, nearest) = self._state, min(pairs)
            self._state = before.copy()
            try:
                places = places | self._merge_dstates([nearest])
                is_wanted = self._is_forced or self._state.nats < before.nats
            except _ClashError:
                is_wanted = False
            if not is_wanted:
                self._state = before
                refused.add(nearest)

    def _merge_dstates(self, pairs: list[tuple[int, int]]) -> set[int]:
        """Merge pairs of dstates, and what the same actions lead to. Return their places."""
        state, places = self._state, set()
        while pairs:
            s, x = sorted(state.dstate[i] for i in pairs.pop())
            if s == x:
                continue
            if not self._look_alike(s, x) or self._dstates_apart.includes(state.dstate, s, x):
                raise _ClashError
            for action, there in state.links[x].items():
                # Both ends of equal links become one dstate, too.
                if action in state.links[s]:
                    pairs.append((state.links[s][action], there))
                else:
                    state.links[s][action] = there
            state.nats += self._sights.merging(state.seen[s], state.seen[x])
            state.seen[s] = seen_at_both(state.seen[s], state.seen[x])
            state.dstate = [s if i == x else i for i in state.dstate]
            p, q = sorted(state.place[self._both.places[i]] for i in (s, x))
            headings = self._heading[s], self._heading[x]
            # The merged dstate has the most frequent view if views may be misread (`Prior.shown`).
            one, other = self._shown[[s, x], 0]
            is_misread = self._problem.theory.misread
            state.nats -= float(max(one, other) if is_misread else other * (one > 0))
            if p == q:
                self._condition([headings])
            else:
                self._merge_places(p, q, headings)
            places.add(p)
        return {state.place[p] for p in places}

    def _merge_places(self, p: int, q: int, heading: tuple[int, int] | None) -> None:
        """Merge two places, and perhaps two headings there. Raises _ClashError."""
        state, position = self._state, self._position
        changes = self._sights.merged(state.sights[p], state.sights[q])
        if math.isinf(changes) or self._places_apart.includes(state.place, p, q):
            raise _ClashError
        for s, x in self._denied:  # they would face one way on one path
            at = {state.place[self._both.places[i]] for i in (s, x)}
            if at == {p, q} and abs(self._twist(s, x)[0]) < TURNED:
                raise _ClashError
        if heading is None and not self._may_face(p, q):
            raise _ClashError
        state.sights[p] = {**state.sights[p], **state.sights[q]}
        state.place = [p if i == q else i for i in state.place]
        same = [(position[p], position[q]), (position[p] + 1, position[q] + 1)]
        state.nats += changes - float(self._shown[[self._first[p], self._first[q]], 1].min())
        self._condition(same if heading is None else [*same, heading])

    def _may_face(self, p: int, q: int) -> bool:
        """Whether the gateways of two places agree if each place is turned as its dstates face.

        This is unknown, and so True, if gateways may change between drives.
        """
        if self._problem.theory.changed:
            return True
        (s, *_), (x, *_) = self._dstates_at(p), self._dstates_at(q)
        turns = self._sights.turns(self._step_at[s], self._step_at[x])
        twists = [self._twist(s, x, turn) for turn in turns]
        return not twists or any(abs(off) < TURNED or square < FAR for off, square in twists)

    def _twist(self, s: int, x: int, turn: float = 0.0) -> tuple[float, float]:
        """Compute how far, in radians, s faces off x after a turn of s, and its chi-square."""
        state, i, j = self._state, self._heading[s], self._heading[x]
        c = state.covariance
        off = math.remainder(state.mean[i] + turn - state.mean[j], math.tau)
        return off, off * off / float(c[i, i] + c[j, j] - 2 * c[i, j] + self._spreads[2])

    def _condition(self, same: list[tuple[int, int]]) -> None:
        """Condition the poses on the equality of pairs of entries. Update the cost in nats."""
        state, (first, second) = self._state, map(list, zip(*same, strict=True))
        spreads = self._spreads[-len(same) :] if len(same) % 2 else self._spreads[:2]
        state.mean, state.covariance, square, spread = conditioned(
            state.mean, state.covariance, first, second, spreads
        )
        state.nats += square / 2 - float(self._problem.prior.gain(spread))
        state.nats += self._problem.prior.crowd * (len(same) > 1)  # for a place

    def _dstates_at(self, place: int) -> list[int]:
        """List the dstates at a place, one of each merged group."""
        state = self._state
        return [
            s
            for s, first in enumerate(state.dstate)
            if s == first and state.place[self._both.places[s]] == place
        ]

    def _look_alike(self, s: int, x: int) -> bool:
        """Whether two dstates show the same, except for gateways that changed."""
        seen, sights = self._state.seen, self._sights
        first, second = (sights.shown[self._step_at[i]] for i in (s, x))
        return sights.merging(seen[s], seen[x]) < math.inf and sights.are_alike(first, second)

    def _coinciding(self, place: int) -> list[tuple[float, tuple[int, int]]]:
        """List pairs of dstates at a place that show the same and may face the same way.

        Each has the chi-square of the difference of their headings.
        """
        found = []
        for s, x in combinations(self._dstates_at(place), 2):
            off, square = self._twist(s, x)
            is_one_way = abs(off) < TURNED and square < FAR
            if (
                is_one_way
                and self._look_alike(s, x)
                and not self._dstates_apart.includes(self._state.dstate, s, x)
            ):
                found.append((square, (s, x)))
        return found


def smoothed(
    problem: Problem,
    log: Log,
    sights: Sights,
    labels: Sequence[int],
    places: Sequence[int],
    poses: Poses,
) -> list[Hypothesis]:
    """Merge places and dstates at the poses that fit them best.

    There is a hypothesis for each part of the trace that displacements and closures connect.

    Args:
        problem: The trace and the theory.
        log: The log of the trace.
        sights: What each step shows.
        labels: The dstate of each step before the merges.
        places: The place of each dstate before the merges.
        poses: The equations of these dstates and places.
    """
    prior = problem.prior
    found = []
    for apart in parts_of(poses.gaussian(), labels, places, log, sights):
        new = firsts((label, t) for t, label in apart.labels.items()).values()
        price = float(prior.dstate[[*new]].sum())
        new = firsts((apart.places[label], t) for t, label in apart.labels.items()).values()
        price += float(prior.place[[*new]].sum())
        overlay = Overlay(replace(apart, nats=apart.nats + price), None, problem, sights)
        overlay.merge_all()
        found.append(overlay.part())
    return found


def visits_apart(problem: Problem) -> tuple[list[int], list[int], Poses]:
    """Return dstates and places for `smoothed` in which no two visits are to one place."""
    labels = [*range(len(problem.trace))]
    places = numbered(visits_by_turns(problem.trace, problem.theory))
    return labels, places, Poses(problem.trace, labels, places)


def smoothed_map(
    problem: Problem, log: Log, begin: tuple[Sequence[int], Sequence[int], Poses] | None = None
) -> SSHMap | None:
    """Make a map of a trace by smoothing, see `smoothed`, whose last arguments are `begin`.

    Without them, all visits are apart. Two parts that no displacement or closure connects are
    joined only where a known link leads from one to the other. None if the map breaks an axiom.
    """
    bare = problem.theory.replace(displacement="none", weigh="count")
    sights = Sights(problem.trace, bare)
    whole, *parts = smoothed(problem, log, sights, *(begin or visits_apart(problem)))
    for part in parts:
        led = (
            (whole.links.get((whole.labels[t - 1], log.actions[t - 1])), label)
            for t, label in part.labels.items()
            if t - 1 in whole.labels
        )
        pair = next(((known, label) for known, label in led if known is not None), None)
        overlay = Overlay(whole, part, problem, sights)
        joined = pair is not None and overlay.merge(*pair)
        whole = overlay.part() if joined else whole.beside(part)
    return whole.ssh_map(problem.trace, bare, sights)


class KeptApart:
    """Says which dstates (or places) of a map must not be merged.

    Two must not if a step of one is apart from a step of the other, or if a map that is kept has
    both of them in one piece.
    """

    def __init__(
        self,
        labels: Mapping[int, int],
        pairs: Iterable[tuple[int, int]],
        kept: Iterable[tuple[int, int]] = (),
    ) -> None:
        """Read pairs of steps that are apart. `labels` numbers steps; other steps are left out.

        `kept` has the numbers that a map keeps apart from each other, each with its piece.
        """
        size = max(labels.values()) + 1
        self._apart = np.zeros((size, size), bool)
        for of_piece in gathered((piece, number) for number, piece in kept).values():
            self._apart[np.ix_(of_piece, of_piece)] = True
        for t, u in pairs:
            if t in labels and u in labels:
                self._apart[labels[t], labels[u]] = self._apart[labels[u], labels[t]] = True

    @staticmethod
    def of_places(
        problem: Problem, labels: Mapping[int, int], kept: Iterable[tuple[int, int]]
    ) -> KeptApart:
        """List the places that are apart by evidence, or as a travel leads from one to the other.

        Travels are ignored if they may stay at a place, or if actions may have slipped.
        """
        theory, actions = problem.theory, enumerate(problem.trace.actions)
        leaves = theory.level == "topological" and "travel_leaves" in theory.hard
        travels = [(t, t + 1) for t, action in actions if action.kind == "travel"]
        known = travels if leaves and not theory.slipped else []
        return KeptApart(labels, [*pairs_in(problem.pairs.elsewhere), *known], kept)

    def includes(self, merged: Sequence[int], first: int, second: int) -> bool:
        """Whether any number merged into `first` is apart from any that is merged into `second`.

        `merged` has, for each number, the number that it is merged into.
        """
        into = np.asarray(merged)
        return self._apart[np.ix_(into == first, into == second)].any().item()


def denied_pairs(theory: Theory, first: Hypothesis, second: Hypothesis) -> set[tuple[int, int]]:
    """List the pairs of dstates of two maps that a person says are different.

    If one action leads from two dstates to such a pair, they are different, too.
    """
    here, there = first.labels, second.labels
    said = (pair for i, j in (*theory.different, *theory.elsewhere) for pair in ((i, j), (j, i)))
    todo = {(here[i], there[j]) for i, j in said if i in here and j in there}
    found = set[tuple[int, int]]()
    while todo:
        found.add(pair := todo.pop())
        todo |= {
            (s, x)
            for (s, action), y in first.links.items()
            for (x, other), z in second.links.items()
            if action == other and (y, z) == pair
        } - found
    return found
