"""Join the maps of several drives to one map of little cost, without a search of all steps.

Each drive has a map of its own: a hypothesis with the poses of its places and dstates. Drives that
closures (matches of local maps) connect are mapped together, if that breaks no axiom. An *anchor*
is a dstate of one map and a dstate of another map that may be one. It says how one map lies on the
other. An anchor is good if many other dstates then coincide with dstates that show the same. Drives
that cross may share places, but no dstate. So an anchor may also be two places whose stars agree if
one map is turned. It is good if many other places then coincide with places that may be one.

The two maps with the best anchor are joined first: `overlay.py` merges the places and dstates that
coincide. Then the joint map may be joined to others. Maps that no anchor connects stay pieces.
A drive alone, or two, may fit better in a wrong way. So then one of these decisions is taken
otherwise, and the others as before (limited discrepancy search).

New drives may be laid on the map of old drives (`ExistingMap`). Each piece of this map must be
kept, but pieces may be joined to each other. The old drives are given by a *digest*: a trace in
which each link of their map occurs once (`solver/onto.py`). The displacements of the old drives are
fitted to the map. The fit gives the joint Gaussian distribution of the poses, and each link of the
digest gets the displacement between the poses of its ends.

References:
    Carpin 2008, "Fast and accurate map merging for multi-robot systems" (votes for a turn and a
    shift).
    Harvey & Ginsberg 1995, "Limited discrepancy search".
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations, islice, pairwise
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.drives import Drive, drives_of
from ssh_abduction.data.groups import firsts, numbered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.runtime.threads import one_thread
from ssh_abduction.solver.geometry.fit import poses_of
from ssh_abduction.solver.sources.metric.beam import Beam
from ssh_abduction.solver.sources.metric.hypothesis import Array, Hypothesis, parts_of
from ssh_abduction.solver.sources.metric.overlay import (
    Overlay,
    denied_pairs,
    smoothed,
    visits_apart,
)
from ssh_abduction.solver.sources.metric.sights import Sights
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.evidence.loops import vectors_turned
from ssh_abduction.theory.settle import Problem

_Pair: TypeAlias = tuple[Hypothesis, Hypothesis]


class _Anchor(NamedTuple):
    """A way to lay a map on another one.

    Attributes:
        good: How many dstates (or places) coincide that may be one, minus those that may not.
        old: A dstate of the first map.
        new: A dstate of the second map, which is laid on `old`.
        turn: By how many radians the second map is turned counterclockwise.
        by_places: Whether only the places of the two dstates are one, and not the dstates.
    """

    good: int
    old: int
    new: int
    turn: float
    by_places: bool = False


_Anchors: TypeAlias = dict[_Pair, list[_Anchor]]

# The width of the beam that maps each drive alone.
ALONE = 4
# Two dstates may coincide if their headings differ by less than this many radians, and their
# positions by less than this share of a usual travel.
TURNED, SHIFTED = 0.4, 0.4
# Try the VOTED ways with the most votes to lay a map on another one.
VOTED = 64
# Try this many of the best ways that lay two places on each other.
CROSSED = 8
# Where one decision is another one, try only the FEW best ways to lay each two maps.
FEW = 4
# List this many other ways to lay new drives on an existing map.
OTHERS = 2


class Joining:
    """Joins the maps of the drives of one trace.

    Attributes:
        broken: How many nats the drives cost less if each is mapped alone, without axioms.
    """

    def __init__(self, problem: Problem, log: Log) -> None:
        """Prepare the search. `maps` runs it."""
        self.broken = 0.0
        self._problem, self._log = problem, log
        # The maps that `maps` begins with; and maps of drives, each with another map of its drive.
        self._known: list[Hypothesis] = []
        self._others: list[tuple[Hypothesis, Hypothesis]] = []
        self._bare = problem.theory.replace(displacement="none", weigh="count")
        self.sights = Sights(problem.trace, self._bare)
        # The ways to lay one map on another.
        self._ways: _Anchors = {}
        # The ways that fit, each with its cost in nats.
        self._laid: dict[_Pair, list[tuple[float, _Anchor]]] = {}

    def maps(self, standing: Sequence[Hypothesis] = ()) -> Iterator[SSHMap]:
        """Yield a map in which no drives are joined, and last the cheapest map found.

        If the cheapest map has pieces, also yield the cheapest map in which two of them are joined.
        The caller has to check all maps. If `standing` is not empty, it has the pieces of a map of
        the first drives. Each piece must be kept.
        """
        first = sum(len(part.labels) for part in standing)
        drives = [drive for drive in drives_of(self._problem.trace) if drive.first >= first]
        found = [self._alone(drive) for drive in drives]
        known = [part for part in found if part is not None]
        if len(known) < len(found):
            return
        self._known = alone = [*standing, *self._connected(known)]
        best = self._all_joined(alone)
        if len(best) < len(alone):
            yield from self._beside(alone)
        # A rival of the best map: two more pieces joined.
        dearer = []
        for two in combinations(best, 2):
            pair = two[::-1] if two[::-1] in self._laid else two
            if (both := next(self._joins(*pair, math.inf), None)) is not None:
                dearer.append([*(part for part in best if part not in pair), both])
        if dearer:
            yield from self._beside(min(dearer, key=_nats_of))
        yield from self._beside(best)

    def others(self) -> Iterator[SSHMap]:
        """Yield maps in which one decision is another one than in `maps`, which was called before.

        This is the first way in which two maps are joined, and then the map of one drive alone, at
        other places. What costs least comes first.
        """
        for drive, other in [(None, None), *self._others]:
            parts = [other if other and part is drive else part for part in self._known]
            begun = dict[object, list[Hypothesis]]()
            for pair in combinations(parts, 2):
                rest = [part for part in parts if part not in pair]
                ways = self._joins(*pair, _nats_of(pair), FEW) if other in (None, *pair) else ()
                for both in ways:
                    begun.setdefault((_course(both), *map(_course, rest)), [both, *rest])
            for after in sorted(begun.values(), key=_nats_of):
                yield from self._beside(self._all_joined(after, FEW))

    def _connected(self, alone: list[Hypothesis]) -> list[Hypothesis]:
        """Map drives together that closures connect, if that costs less and breaks no axiom.

        `alone` has a map of each new drive alone.
        """
        if not self._problem.trace.closures:
            return alone
        apart = visits_apart(self._problem)
        for both in smoothed(self._problem, self._log, self.sights, *apart):
            parts = [part for part in alone if part.labels.keys() <= both.labels.keys()]
            covers = sum(len(part.labels) for part in parts) == len(both.labels)
            saves = covers and len(parts) > 1 and both.nats < _nats_of(parts)
            if saves and self._map(both):
                alone = [*(part for part in alone if part not in parts), both]
        return alone

    def _all_joined(self, parts: list[Hypothesis], tries: int | None = None) -> list[Hypothesis]:
        """Join the two maps with the best anchor (way to lay them) as long as any can be joined.

        `tries` is as in `_joins`.
        """
        anchors = {pair: self._anchors(*pair) for pair in combinations(parts, 2)}
        while anchors:
            pair = max(anchors, key=lambda pair: anchors[pair][:1])
            del anchors[pair]
            if (joined := next(self._joins(*pair, _nats_of(pair), tries), None)) is not None:
                parts = [part for part in parts if part not in pair]
                anchors = {two: ways for two, ways in anchors.items() if not {*two} & {*pair}}
                anchors |= {(joined, part): self._anchors(joined, part) for part in parts}
                parts.append(joined)
        return parts

    def _beside(self, parts: Sequence[Hypothesis]) -> Iterator[SSHMap]:
        """Yield a map with these parts as separate pieces, unless it breaks an axiom."""
        whole = parts[0]
        for part in parts[1:]:
            whole = whole.beside(part)
        if ssh_map := self._map(whole):
            yield ssh_map

    def _alone(self, drive: Drive) -> Hypothesis | None:
        """Map a drive alone. Return its cheapest map; None if none is found."""
        trace = self._problem.trace[drive.first : drive.stop]
        theory = self._problem.theory.of_steps(drive.first, len(trace))
        theory = replace(theory, several_drives=False, changed=0.0)
        problem = Problem.of(trace, theory)
        beam = Beam(problem, Log(trace, theory, problem.pairs), ALONE)
        if next(beam.maps(), None) is None:
            return None
        at_places = firsts((_course(found)[1], found) for found in beam.hypotheses)
        if beam.refuses:
            self.broken += beam.hypotheses[0].nats - beam.nats_without_axioms()
        best, *others = (self._of_drive(found, drive.first) for found in at_places.values())
        self._others += ((best, other) for other in others)
        return best

    def _of_drive(self, found: Hypothesis, first: int) -> Hypothesis:
        """Return a hypothesis about a drive alone as one about the steps of the whole trace."""
        poses = np.array([*(i + k for i in found.position for k in (0, 1)), *found.heading])
        gaussian = found.mean[poses], found.covariance[np.ix_(poses, poses)]
        labels = {first + t: label for t, label in found.labels.items()}
        places, log, sights = found.places, self._log, self.sights
        return Hypothesis.of_steps(labels, places, gaussian, found.nats, log, sights)

    def _anchors(self, first: Hypothesis, second: Hypothesis) -> list[_Anchor]:
        """List the anchors (ways to lay one map on the other) of two maps, the best first."""
        if (first, second) in self._ways:
            return self._ways[first, second]
        look_at_clock()
        changes = np.array(
            [[self.sights.merged(seen, other) for other in second.sights] for seen in first.sights]
        )
        near = SHIFTED * second.usual_travel(self._problem.trace)
        found = [
            *self._by_dstates(first, second, changes, near),
            *self._by_places(first, second, changes == 0, near),
        ]
        self._ways[first, second] = sorted(found, reverse=True)
        return self._ways[first, second]

    def _by_dstates(
        self, first: Hypothesis, second: Hypothesis, changes: Array, near: float
    ) -> Iterator[_Anchor]:
        """Yield ways to lay one map on another that make two dstates one.

        `changes` has, for each place of the first map and each of the second, what changed gateways
        cost if they are one place; inf if they cannot be. Dstates coincide if they are nearer than
        `near` metres.
        """
        merging = self.sights.merging
        alike = np.array(
            [[merging(seen, others) == 0 for others in second.seen] for seen in first.seen]
        )
        denied = denied_pairs(self._problem.theory, first, second)
        (at, facing), (there, turned) = first.poses, second.poses
        shown, step, other = self.sights.shown, first.step_at, second.step_at
        ways = [
            (s, x, facing[s] - turned[x])
            for s, x in np.argwhere(alike).tolist()
            if changes[first.places[s], second.places[x]] < math.inf
            and self.sights.are_alike(shown[step[s]], shown[other[x]])
            and (s, x) not in denied
        ]
        for s, x, turn in _voted(first, second, ways, near):
            twist = facing[:, None] - turned - turn
            twist -= math.tau * np.round(twist / math.tau)
            meets = _meeting(at, at[s] + vectors_turned(there - there[x], turn), near)
            meets &= np.abs(twist) < TURNED
            good = (meets & alike).sum() - (meets & ~alike).sum()
            yield _Anchor(int(good), s, x, turn)

    def _by_places(
        self, first: Hypothesis, second: Hypothesis, same: NDArray[np.bool_], near: float
    ) -> list[_Anchor]:
        """List the best ways to lay one map on another that make two places one, by their gateways.

        One pair of coinciding places is too little evidence, unless no other pair may be one.
        `same` tells whether each place of the first map may be each place of the second. Places
        coincide if they are nearer than `near` metres.
        """
        facing, turned = first.poses[1], second.poses[1]
        step, other = first.step_at, second.step_at
        ways = []
        for p, q in np.argwhere(same).tolist():
            s, x = first.places.index(p), second.places.index(q)
            turns = self.sights.turns(step[s], other[x])
            ways += [(s, x, facing[s] + turn - turned[x]) for turn in turns]
        found = []
        for s, x, turn in _voted(first, second, ways, near):
            moved = first.poses[0][s] + vectors_turned(second.positions - second.poses[0][x], turn)
            meets = _meeting(first.positions, moved, near)
            good = (meets & same).sum() - (meets & ~same).sum()
            found.append(_Anchor(int(good), s, x, turn, by_places=True))
        least = 1 if same.sum() == 1 else 2
        return sorted((way for way in found if way.good >= least), reverse=True)[:CROSSED]

    def _joins(
        self, first: Hypothesis, second: Hypothesis, most: float, tries: int | None = None
    ) -> Iterator[Hypothesis]:
        """Join two maps in the ways that break no axiom and cost less than `most` nats.

        If they were not tried before, try only the `tries` best ways; all of them if it is None.
        """
        overlay = Overlay(first, second, self._problem, self.sights)
        if (first, second) not in self._laid:
            ways = self._anchors(first, second)[:tries]
            laid = ((_laid(overlay, way), way) for way in ways)
            told = [(part.nats, way) for part, way in laid if part]
            self._laid[first, second] = sorted(told, key=lambda told: told[0])
        cheap = (way for nats, way in self._laid[first, second] if nats < most)
        joined = (_laid(overlay, way) for way in cheap)
        return (part for part in joined if part and self._map(part))

    def _map(self, part: Hypothesis) -> SSHMap | None:
        """Make the map of a part; None if it breaks an axiom."""
        look_at_clock()
        return part.ssh_map(self._trace_of(part), self._bare, self.sights)

    def _trace_of(self, part: Hypothesis) -> Trace:
        """Return the trace of the drives of a part."""
        trace, steps = self._problem.trace, sorted(part.labels)
        if len(steps) < len(trace):
            kept = [trace.steps[t] for t in steps]
            for i, (t, u) in enumerate(pairwise(steps)):
                if u > t + 1:  # drives in between are left out
                    kept[i] = replace(kept[i], action=trace.steps[u - 1].action)
            kept[-1] = replace(kept[-1], action=None)
            trace = replace(trace, steps=tuple(kept), closures=())
        return trace


def _nats_of(parts: Iterable[Hypothesis]) -> float:
    """Compute the cost of parts as separate pieces, in nats."""
    return sum(part.nats for part in parts)


def _course(part: Hypothesis) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the dstate and the place of each step of a part, numbered by first visit."""
    labels = [part.labels[t] for t in sorted(part.labels)]
    return tuple(numbered(labels)), tuple(numbered(part.places[label] for label in labels))


def _laid(overlay: Overlay, way: _Anchor) -> Hypothesis | None:
    """Lay one map on another in one way, and merge what coincides; None if it does not fit."""
    look_at_clock()
    fits = overlay.merge(way.old, way.new, way.turn if way.by_places else None)
    return overlay.part() if fits else None


def _voted(
    first: Hypothesis, second: Hypothesis, ways: Iterable[tuple[int, int, float]], near: float
) -> Iterator[tuple[int, int, float]]:
    """Yield one way of each group of similar ways to lay a map on another, largest groups first.

    A way is a triple: a dstate of the first map, the dstate of the second map to lay on it, and the
    angle in radians by which to turn the second map. Ways are similar if they differ by less than
    about `near` metres.
    """
    listed = [*ways]
    if not listed:
        return
    at, there = first.poses[0], second.poses[0]
    turn = np.array([turn for _, _, turn in listed])
    s, x = np.array([way[:2] for way in listed]).T
    # Such ways put the centre of the second map into one cell.
    centre = at[s] + vectors_turned(there.mean(0) - there[x], turn)
    around = np.round(turn / TURNED) % round(math.tau / TURNED)
    cells = np.column_stack([np.round(centre / near), around]).astype(int)
    _, one, votes = np.unique(cells, axis=0, return_index=True, return_counts=True)
    yield from (listed[i] for i in one[np.argsort(-votes)[:VOTED]])


def _meeting(here: Array, there: Array, near: float) -> NDArray[np.bool_]:
    """Flag the pairs of a point `here` and a point `there` that are nearer than `near`."""
    met: NDArray[np.bool_] = np.hypot(*np.moveaxis(here[:, None] - there, -1, 0)) < near
    return met


class ExistingMap:
    """The map of old drives, with the poses of its dstates and places.

    Attributes:
        broken: How many nats the new drives cost less if each is mapped alone, without axioms. It
            is known after `maps`.
    """

    def __init__(self, old: Trace, ssh_map: SSHMap) -> None:
        """Fit the poses to the old drives and their map."""
        self.broken = 0.0
        with one_thread("blas"):
            self._fitted = poses_of(old, ssh_map).gaussian()
        self._piece = ssh_map.piece_of
        self._places = numbered(-1 - s.id if s.place is None else s.place for s in ssh_map.dstates)

    def with_displacements(self, digest: Trace, labels: Sequence[int]) -> Trace:
        """Give each action of a digest the displacement between the steps before and after it.

        It stays unknown if no displacement of the old drives connects these steps.
        """
        part, mean, *_ = self._fitted
        positions = 2 * (max(self._places) + 1)
        at = mean[:positions].reshape(-1, 2)[self._places][list(labels)]
        facing = mean[positions:][list(labels)]
        gone = vectors_turned(at[1:] - at[:-1], -facing[:-1])
        turns = np.remainder(facing[1:] - facing[:-1] + np.pi, 2 * np.pi) - np.pi
        moves = zip(*gone.T.tolist(), turns.tolist(), strict=True)
        known = [
            part[s] == part[x] and not action.starts
            for (s, x), action in zip(pairwise(labels), digest.actions, strict=True)
        ]
        steps = [
            replace(step, displacement=move) if is_known else step
            for step, is_known, move in zip(digest.steps[1:], known, moves, strict=True)
        ]
        return replace(digest, steps=(digest.steps[0], *steps))

    def maps(self, problem: Problem, labels: Sequence[int]) -> Iterator[SSHMap]:
        """Yield maps of a digest and new drives. They keep the pieces of this map.

        The caller has to check them. The trace of the problem is a digest of the old drives, and
        then the new ones. `labels` has the dstate of each step of the digest.
        """
        log = Log(problem.trace, problem.theory, problem.pairs)
        joining = Joining(problem, log)
        parts = parts_of(self._fitted, labels, self._places, log, joining.sights, self._piece)
        found = [*joining.maps([replace(part, nats=0.0) for part in parts])]  # they must be kept
        others = islice(joining.others(), OTHERS)
        yield from (*found, *(other for other in others if other not in found))
        self.broken = joining.broken
