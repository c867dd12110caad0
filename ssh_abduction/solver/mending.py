"""Find maps with faults in theories with places: guess the faults, mend the trace, and solve it.

A fault is a view, an action or a displacement of the trace that a map treats as wrong. To *mend* a
trace is to correct its faults: replace a wrong view by another view, replace a wrong action by an
unknown action, and leave out a wrong displacement. So a map with faults is a map without faults of
a mended trace. All fast engines can solve a mended trace.

Two methods guess which steps have faults. If places have frames, visits are merged robustly
(`sources/symbolic/merging.py`). In any case, the causal theory with faults is solved
(`exact/faulty.py`). A map with places becomes a map of that theory when its places are dropped.

*Displacements.* A sketch shows which displacements may be wrong. A displacement that was guessed to
be wrong may agree with the map after all. Then it is no fault of the map.

*Bound.* A map of the theory, without its places, is a causal map with the same dstates and with no
more faults. So a lower bound for the causal theory holds here. If a mended trace has a map that
costs no more than this bound, its dstates and faults are minimal. If all cheapest causal maps are
listed, each minimal map of the theory has the labels and faults of one of these causal maps. So
solve all traces that the cheapest causal maps mend. The best of their minimal maps are the complete
answer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Action, Step, Trace
from ssh_abduction.solution.values import Found
from ssh_abduction.solver.board import Judging
from ssh_abduction.solver.sources.exact.engine import Task
from ssh_abduction.solver.sources.exact.faulty import FaultyEngine
from ssh_abduction.solver.sources.symbolic.merging import Merging
from ssh_abduction.solver.sources.symbolic.sketch import mended_sketch
from ssh_abduction.solver.steps.faults import with_faults
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.theory import Theory

# Mend the trace by at most this many cheapest causal maps. If there are more, the list of minimal
# maps may be incomplete.
MOST_CAUSAL = 200
# Solving a trace that was mended by merging takes at most MERGED seconds. Solving any mended trace
# takes at most SHARE of the time that is left.
MERGED, SHARE = 30.0, 0.5

# Solves a mended trace. Arguments: the trace, a theory without faults, the number of maps to list
# (0: all), and the seconds it may take. Returns the minimal maps and True, or the best map known
# and False.
Solver = Callable[[Trace, Theory, int, float], tuple[tuple[SSHMap, ...], bool]]


class Mending:
    """Finds maps with faults by correcting (mending) the trace of a task."""

    def __init__(self, task: Task, solver: Solver) -> None:
        self._task, self._solver = task, solver
        self._without_faults = task.theory.without_faults().replace(weigh="count")
        # The best map of each mended trace, and whether it is proven minimal. If not, the trace is
        # solved again when there is more time.
        self._solved: dict[Trace, tuple[Found | None, bool]] = {}
        self._best: Found | None = None
        self._cheapest: list[Trace] = []  # traces mended by all cheapest causal maps
        causal = Theory.causal().replace(misread=task.theory.misread, slipped=task.theory.slipped)
        # The log (the trace as integers) still belongs to the theory with places. So stars, and
        # pairs of steps at different places, distinguish dstates here, too.
        self._causal = FaultyEngine(replace(task, problem=task.problem.changed(theory=causal)))

    @property
    def bound(self) -> int | None:
        """A lower bound on the cost of any map, in tenths of dstates; None if none is known yet."""
        return self._causal.bound

    def maps(self) -> Iterator[Found]:
        """Yield maps of the whole trace, each better than the one before."""
        yield from self._by_merging()
        self._causal.grow(len(self._task.trace))
        for causal in self._causal.improving_maps():
            yield from self._improving(self._minimal(self._mended(causal.map))[0])
        for mended in self._by_cheapest_causal_maps():
            yield from self._improving(self._minimal(mended)[0])
        yield from self._by_sketch()

    def minimal_maps(self, most: int) -> tuple[tuple[SSHMap, ...], bool] | None:
        """List the minimal maps, and say whether these are all; None if nothing is proven.

        At most this many maps (0: all) are listed for each mended trace. Call this after the
        iteration over `maps` has ended. There is no proof if the best map costs more than the
        bound, or if not all mended traces were solved.
        """
        if self._best is None or self._best.cost[0] != self.bound or not self._cheapest:
            return None
        solved = {mended: self._minimal(mended) for mended in self._cheapest}
        if not all(proven for _, proven in solved.values()):
            return None
        found = {mended: one for mended, (one, _) in solved.items() if one is not None}
        least = min(one.cost for one in found.values())
        listed, is_all = dict[SSHMap, None](), True
        for mended, one in found.items():
            if one.cost == least:
                maps, proven = self._maps_of(mended, most)
                is_all &= proven
                # If the time was over, these maps need not be minimal. The one found before is.
                minimal = [self._as_found(m, mended).map for m in maps] if proven else [one.map]
                listed |= dict.fromkeys(minimal)
        return tuple(listed), is_all

    def _improving(self, better: Found | None) -> Iterator[Found]:
        """Yield a map, and remember it, if it is the best one so far."""
        if better is not None and (self._best is None or better.cost < self._best.cost):
            self._best = better
            yield better

    def _by_merging(self) -> Iterator[Found]:
        """Yield a better map, found by merging visits robustly (`sources/symbolic/merging.py`).

        Merging groups the visits, and the votes of the groups mend the trace.
        """
        trace, theory = self._task.trace, self._task.theory
        if theory.star == "frame" and (theory.misread or theory.jumped):
            merging = Merging(trace, theory, self._problem(trace).pairs)
            merging.merge()
            yield from self._improving(self._minimal(merging.mended(), MERGED)[0])

    def _by_cheapest_causal_maps(self) -> Iterator[Trace]:
        """Yield the distinct traces that the cheapest causal maps mend."""
        causal: list[SSHMap] = []
        found: dict[Trace, None] = {}
        for cheapest in self._causal.maps_of_cost((self.bound or 0,), MOST_CAUSAL):
            causal.append(cheapest.map)
            mended = self._mended(cheapest.map)
            if mended not in found:
                found[mended] = None
                yield mended
        self._cheapest = list(found) if len(causal) < MOST_CAUSAL else []

    def _by_sketch(self) -> Iterator[Found]:
        """Yield a better map, with the faults of a sketch (a map that is made without a search).

        The causal theory does not notice a fault that only adds links to its map. Such a fault may
        still contradict the axioms of places. Then the trace still has no map after causal maps
        have mended it.
        """
        proven = self._best is not None and self._best.cost[0] == self.bound
        if not proven and (guess := mended_sketch(self._task.trace, self._task.theory)):
            yield from self._improving(self._minimal(guess.trace)[0])

    def _mended(self, causal: SSHMap) -> Trace:
        """Mend the trace by the faults of a causal map. A wrong action becomes unknown."""
        wrong = {
            kind: {fault.step for fault in causal.faults if fault.kind == kind}
            for kind in ("misread", "slipped")
        }
        steps = list(self._task.trace.steps)
        right: dict[int, Step] = {}
        for t, label in enumerate(causal.dstate_at):
            if t not in wrong["misread"]:
                right.setdefault(label, steps[t])
        for t in wrong["misread"]:
            seen = right[causal.dstate_at[t]]
            star = seen.star if self._task.theory.star in ("pattern", "frame") else steps[t].star
            steps[t] = replace(steps[t], view=seen.view, star=star)
        for t in wrong["slipped"]:
            steps[t] = replace(steps[t], action=Action.that_slipped(t))
        return replace(self._task.trace, steps=tuple(steps))

    def _problem(self, mended: Trace) -> Problem:
        """Make the problem of a mended trace, in which no further faults are allowed."""
        return self._task.problem.changed(mended, self._without_faults)

    def _minimal(self, mended: Trace, seconds: float = math.inf) -> tuple[Found | None, bool]:
        """Find the best map of a mended trace, with its faults, and whether that is proven."""
        if mended not in self._solved or not (self._solved[mended][1] or seconds < math.inf):
            maps, proven = self._maps_of(mended, 1, seconds)
            self._solved[mended] = self._as_found(maps[0], mended) if maps else None, proven
        return self._solved[mended]

    def _maps_of(
        self, mended: Trace, most: int, seconds: float = math.inf
    ) -> tuple[tuple[SSHMap, ...], bool]:
        """Solve a mended trace within some seconds, as `Solver` does."""
        seconds = min(seconds, SHARE * self._task.watch.left())
        return self._solver(mended, self._without_faults, most, seconds)

    def _believed_again(self, ssh_map: SSHMap, mended: Trace) -> Trace:
        """Restore the missing displacements of a mended trace that agree with its map."""
        for t, (step, other) in enumerate(zip(self._task.trace.steps, mended.steps, strict=True)):
            if step.displacement == other.displacement:
                continue
            steps = list(mended.steps)
            steps[t] = replace(other, displacement=step.displacement, covariance=step.covariance)
            again = replace(mended, steps=tuple(steps))
            problem = self._problem(again)
            pairs = problem.pairs
            place_of = [s.place for s in ssh_map.dstates]
            fits = all(pairs.allow(k, ssh_map.dstate_at, place_of) for k in range(len(again)))
            if fits and not Judging(problem).why_refused(replace(ssh_map, faults=())):
                mended = again
        return mended

    def _as_found(self, ssh_map: SSHMap, mended: Trace) -> Found:
        """Turn a map of a mended trace into a map of the trace itself, with its faults."""
        if self._task.theory.jumped:
            mended = self._believed_again(ssh_map, mended)
        return Found.of(
            with_faults(ssh_map, self._task.trace, mended, self._task.theory), self._task.theory
        )
