"""Maps with faults in theories with places: guess the faults, mend the trace, and solve that.

To ignore a view is to replace it by another one. An ignored action becomes an unknown action.
An ignored displacement may as well be missing. So a map with faults is a map without
faults of a mended trace, which all fast engines can solve. The places of faults are guessed in two
ways: by robust merging of visits (`guesses/voting.py`), if places have frames, and by the causal
theory with faults (`engines/faulty.py`). Any map with places, without its places, is one of its
maps.

*Displacements.* Labels that ignore displacements show which of these may be wrong
(`guesses/outliers.py`), and so do the labels of the maps that follow. A map need not ignore all
that were guessed: those that agree with it are believed again.

*Bound.* A map of the theory, without its places, is a causal map with the same dstates and with no
more faults. So a bound for the causal theory holds here. If the mended trace has a map that costs
no more, its dstates and faults are minimal. If all cheapest causal maps are listed, each minimal
map of the theory has the labels and faults of one of them. So it is one of the minimal maps of the
traces that these mend, and the best of these are the complete answer.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Action, Step, Trace, View
from ssh_abduction.solver.asp.facts import answer_maps
from ssh_abduction.solver.engines.base import Found, Task
from ssh_abduction.solver.engines.faulty import FaultyEngine
from ssh_abduction.solver.engines.framed import FramedEngine
from ssh_abduction.solver.guesses.outliers import wrong_displacements
from ssh_abduction.solver.guesses.voting import Merging
from ssh_abduction.solver.judging import Judging
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.speedups import row
from ssh_abduction.theory.theory import Theory

# At most this many cheapest causal maps are mended. If there are more, the list of minimal maps may
# be incomplete.
MOST_CAUSAL = 200
ROUNDS = 5  # rounds of robust merging at most, each beginning with a better map
# A trace that merging mends is solved for at most this many seconds and this share of the time that
# is left.
MERGED, SHARE = 30.0, 0.5
# A dstate with at most RARE visits is rare. One of the BEFORE actions before it may have slipped.
# At most SUSPECTED actions are tried.
RARE, BEFORE, SUSPECTED = 1, 3, 60

# Solves a mended trace. Arguments: the trace, a theory without faults, the number of maps to list
# (0: all), and the seconds it may take. Returns the minimal maps and True, or the best map known
# and False.
Solver = Callable[[Trace, Theory, int, float], tuple[tuple[SSHMap, ...], bool]]


class Mending:
    """Finds maps with faults."""

    def __init__(self, task: Task, solver: Solver) -> None:
        self._task, self._solver = task, solver
        self._without_faults = task.theory.without_faults()
        # The best map of each mended trace, and whether it is proven minimal. If not, the trace is
        # solved again when there is more time.
        self._solved: dict[Trace, tuple[Found | None, bool]] = {}
        self._best: Found | None = None
        self._best_mended: Trace | None = None
        self._cheapest: list[Trace] = []  # traces mended by all cheapest causal maps
        causal = Theory.causal().replace(misread=task.theory.misread, slipped=task.theory.slipped)
        self._causal_labels: tuple[int, ...] = ()  # the labels of the last causal map
        # The log is that of the theory with places. So stars and pairs at different places
        # distinguish dstates.
        self._causal = FaultyEngine(replace(task, problem=task.problem.changed(theory=causal)))

    @property
    def bound(self) -> int | None:
        """A lower bound on the cost of a map, in tenths of dstates; None if none is known yet."""
        return self._causal.bound

    def settle(self) -> None:
        """Stop clingo."""
        self._causal.settle()

    def maps(self) -> Iterator[Found]:
        """Yield maps of the whole trace, each better than the one before."""
        if self._task.theory.jumped and self._task.theory.star == "frame":
            merging = Merging(
                self._task.trace, self._task.theory, self._task.log.pairs, self._task.watch.check
            )
            merging.merge()
            yield from self._by_missing_displacements(merging.labels(), merging.places())
        yield from self._by_merging(self._task.trace)
        for mended in self._by_causal_maps():
            yield from self._improving(self._minimal(mended)[0], mended)
            if self._task.theory.jumped:
                labels = self._causal_labels
                yield from self._by_missing_displacements(labels, [None] * len(labels))
        for mended in self._by_cheapest_causal_maps():
            yield from self._improving(self._minimal(mended)[0], mended)
        yield from self._by_rare_dstates()

    def minimal_maps(self, most: int) -> tuple[SSHMap, ...] | None:
        """The minimal maps. Call it when `maps` has ended.

        Args:
            most: The number of maps to list for each mended trace; 0 for all.

        Returns:
            The maps; None if a causal map is cheaper than the best map, or if some may be missing.
        """
        if self._best is None or self._best.cost[0] != self.bound or not self._cheapest:
            return None
        solved = {mended: self._minimal(mended) for mended in self._cheapest}
        if not all(proven for _, proven in solved.values()):
            return None
        costs = {mended: found.cost for mended, (found, _) in solved.items() if found is not None}
        least = min(costs.values())
        minimal = [mended for mended, cost in costs.items() if cost == least]
        listed = (
            self._as_found(ssh_map, mended).map
            for mended in minimal
            for ssh_map in self._maps_of(mended, most)[0]
        )
        return tuple(dict.fromkeys(listed))

    def _improving(self, better: Found | None, mended: Trace) -> Iterator[Found]:
        """Yield the map of a mended trace if it is the best one so far."""
        if better is not None and (self._best is None or better.cost < self._best.cost):
            self._best, self._best_mended = better, mended
            yield better

    def _by_merging(self, trace: Trace) -> Iterator[Found]:
        """Yield maps of what robust merging mends, and merge again from each better map's places.

        The merged groups are almost a map. It is yielded at once. A share of the time goes into a
        better one.

        Args:
            trace: The trace of the task, perhaps without some displacements.
        """
        theory = self._task.theory
        if theory.star != "frame" or not (theory.misread or theory.jumped):
            return
        before: Found | None = None
        pairs = self._problem(trace).pairs
        for _ in range(ROUNDS):
            merging = Merging(trace, theory, pairs, self._task.watch.check)
            if before is not None:
                merging.start_from(_places(before.map))
            merging.merge()
            mended = merging.mended()
            problem = self._problem(mended)
            task = Task.of(problem, self._task.watch, self._task.speedups)
            near = (
                FramedEngine(task).map_mended_from(merging.labels()) if _has_frames(task) else None
            )
            if near is not None and not Judging(problem).why_refused(near.map):
                yield from self._improving(self._as_found(near.map, mended), mended)
            yield from self._improving(self._minimal(mended, MERGED)[0], mended)
            if self._best is before:
                return
            before = self._best

    def _by_missing_displacements(
        self, labels: Sequence[int], places: Sequence[int | None]
    ) -> Iterator[Found]:
        """Yield maps that ignore displacements that do not fit the labels, then those of each
        better map.
        """
        trace, tried = self._task.trace, set()
        for _ in range(ROUNDS):
            wrong = wrong_displacements(trace, labels, places)
            if not wrong or wrong in tried:
                return
            tried.add(wrong)
            before, without = self._best, trace.without_displacements_at(wrong)
            yield from self._by_merging(without)
            yield from self._improving(self._minimal(without, MERGED)[0], without)
            if self._best is None or self._best is before:
                return
            labels, places = (
                self._best.map.labels,
                [self._best.map.dstates[label].place for label in self._best.map.labels],
            )

    def _by_causal_maps(self) -> Iterator[Trace]:
        """Yield maps of the traces that causal maps mend, each cheaper than the one before."""
        self._causal.grow(len(self._task.trace))
        for found in self._causal.improving_maps():
            self._causal_labels = found.map.labels
            yield self._mended(found.map)

    def _by_cheapest_causal_maps(self) -> Iterator[Trace]:
        """Yield maps of the traces that the cheapest causal maps mend.

        The faults of some of these have smaller maps with places than those of others.
        """
        causal: list[SSHMap] = []
        found: dict[Trace, None] = {}
        for cheapest in self._causal.maps_of_cost((self.bound or 0,), MOST_CAUSAL):
            causal.append(cheapest.map)
            mended = self._mended(cheapest.map)
            if mended not in found:
                found[mended] = None
                yield mended
        self._cheapest = list(found) if len(causal) < MOST_CAUSAL else []

    def _by_rare_dstates(self) -> Iterator[Found]:
        """Yield maps in which an action slipped shortly before a rarely visited dstate.

        The causal theory does not notice every slip: one more link in it may break a path. Then the
        places behind it come out as new ones.
        """
        before: Found | None = None
        while self._task.theory.slipped and self._best is not before:
            before, mended = self._best, self._best_mended
            if before is None or mended is None or before.cost[0] == self.bound:
                return
            visits = Counter(before.map.labels)
            rare = [t for t, label in enumerate(before.map.labels) if visits[label] <= RARE]
            suspected = dict.fromkeys(
                k for t in rare for k in range(t - 1, t - 1 - BEFORE, -1) if k >= 0
            )
            for k in list(suspected)[:SUSPECTED]:
                steps = list(mended.steps)
                steps[k] = replace(steps[k], action=Action.that_slipped(k))
                slipped = replace(mended, steps=tuple(steps))
                yield from self._improving(self._minimal(slipped)[0], slipped)

    def _mended(self, causal: SSHMap) -> Trace:
        """The trace without the faults of a causal map.

        A wrong view is replaced by that of another step at the same dstate, and a wrong action by
        an unknown one.
        """
        wrong = {
            kind: {fault.step for fault in causal.faults if fault.kind == kind}
            for kind in ("misread", "slipped")
        }
        steps = list(self._task.trace.steps)
        right: dict[int, Step] = {}
        for t, label in enumerate(causal.labels):
            if t not in wrong["misread"]:
                right.setdefault(label, steps[t])
        for t in wrong["misread"]:
            seen = right[causal.labels[t]]
            star = seen.star if self._task.theory.star in ("pattern", "frame") else steps[t].star
            steps[t] = replace(steps[t], view=seen.view, star=star)
        for t in wrong["slipped"]:
            steps[t] = replace(steps[t], action=Action.that_slipped(t))
        return replace(self._task.trace, steps=tuple(steps))

    def _problem(self, mended: Trace) -> Problem:
        """A mended trace, without faults."""
        return self._task.problem.changed(mended, self._without_faults)

    def _minimal(self, mended: Trace, seconds: float = math.inf) -> tuple[Found | None, bool]:
        """The best map of a mended trace, as a map of the trace itself, and whether it is minimal.

        Args:
            mended: The mended trace.
            seconds: The time it may take.

        Returns:
            The map, and whether it is proven minimal; None for the map if none was found.
        """
        if mended not in self._solved or not (self._solved[mended][1] or seconds < math.inf):
            maps, proven = self._maps_of(mended, 1, seconds)
            self._solved[mended] = self._as_found(maps[0], mended) if maps else None, proven
        return self._solved[mended]

    def _maps_of(
        self, mended: Trace, most: int, seconds: float = math.inf
    ) -> tuple[list[SSHMap], bool]:
        """Minimal maps of a mended trace, and whether they are proven minimal."""
        maps, proven = self._solver(
            mended, self._without_faults, most, min(seconds, SHARE * self._task.watch.left())
        )
        return list(maps), proven

    def _believed_again(self, ssh_map: SSHMap, mended: Trace) -> Trace:
        """The mended trace, with the missing displacements that fit the map put back."""
        for t, (step, other) in enumerate(zip(self._task.trace.steps, mended.steps, strict=True)):
            if step.displacement == other.displacement:
                continue
            steps = list(mended.steps)
            steps[t] = replace(other, displacement=step.displacement, covariance=step.covariance)
            again = replace(mended, steps=tuple(steps))
            problem = self._problem(again)
            pairs = problem.pairs
            place_of = [s.place for s in ssh_map.dstates]
            fits = all(pairs.allow(k, ssh_map.labels, place_of) for k in range(len(again)))
            if fits and not Judging(problem).why_refused(replace(ssh_map, faults=())):
                mended = again
        return mended

    def _as_found(self, ssh_map: SSHMap, mended: Trace) -> Found:
        """A map of a mended trace as one of the trace itself."""
        if self._task.theory.jumped:
            mended = self._believed_again(ssh_map, mended)
        return Found.of(
            with_faults(ssh_map, self._task.trace, mended, self._task.theory), self._task.theory
        )


def _has_frames(task: Task) -> bool:
    """Whether the engine with frames finds all minimal maps here."""
    return row("visits").holds_for(task.theory)


def _places(ssh_map: SSHMap) -> list[tuple[int, int] | None]:
    """The place of each step, and the slot of the place that the robot faces."""
    at = [
        None if s.place is None or s.heading is None else (s.place, s.heading)
        for s in ssh_map.dstates
    ]
    return [at[label] for label in ssh_map.labels]


def with_faults(ssh_map: SSHMap, trace: Trace, mended: Trace, theory: Theory) -> SSHMap:
    """A map of a mended trace as a map of the trace, with the mended observations as faults.

    Each dstate gets the view that most of its steps have.
    """
    votes: dict[int, Counter[View]] = {}
    for label, step in zip(ssh_map.labels, trace.steps, strict=True):
        assert step.view is not None
        votes.setdefault(label, Counter())[step.view] += theory.fault_tenths("misread", step) or 1
    shows = {label: max(counts, key=lambda view: counts[view]) for label, counts in votes.items()}
    faults: list[tuple[int, str]] = []
    for t, (step, other) in enumerate(zip(trace.steps, mended.steps, strict=True)):
        if step.view != shows[ssh_map.labels[t]]:
            faults.append((t, "misread"))
        if theory.star in ("pattern", "frame") and step.openings != other.openings:
            faults.append((t, "misseen"))
        if step.action != other.action:
            faults.append((t, "slipped"))
        if step.displacement != other.displacement:
            faults.append((t, "jumped"))
    told = answer_maps.faults_of(faults, dict(enumerate(ssh_map.labels)), shows, trace, theory)
    dstates = tuple(replace(s, view=shows[s.id]) for s in ssh_map.dstates)
    return replace(
        ssh_map,
        dstates=dstates,
        links=answer_maps.links_of(ssh_map.labels, trace, faults),
        faults=told,
    )
