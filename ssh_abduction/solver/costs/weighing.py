"""Find the maps of least cost, and prove that none costs less.

The cost of a map in nats is -log of its marginal likelihood (`misfit.py`). It is at least half of
its misfit to the displacements, which is a chi-square, and what its dstates, places and faults cost
at least (`theory/prior.py`).

*The search* is a logic-based Benders decomposition (Hooker & Ottosson 2003). Clingo finds the map
with the fewest dstates, and among these the fewest places and paths. Clingo does not compute the
misfit. If the misfit of some returns of this map makes each map with these returns too expensive,
clingo gets a rule that excludes maps with all of them. Then it finds the next map. The number of
dstates never falls from map to map. So what these dstates cost at least is a lower bound on the
cost of all maps that are left. The search ends when this bound reaches the cost of the best map. If
displacements may be wrong, a misfit excludes only maps that believe the displacements that cause
it.

*Rivals.* A map is too expensive if it costs at least `WITHIN` nats more than the best one. So all
cheaper maps are found, each with a probability proportional to exp(-cost).

*Places* are minimised only after dstates, so clingo proves no lower bound on them. Evidence gives
one: the size of a set of steps that are pairwise at different places.

*A better bound* comes from joins that all cheap maps have (`forced.py`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TypeAlias

from scipy.special import gammaincc

from ssh_abduction.data.drives import drives_of
from ssh_abduction.data.groups import first_index_of, firsts
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.runtime.limits import LimitError
from ssh_abduction.runtime.loggers import log_of
from ssh_abduction.solution.values import Cost, Found, Status
from ssh_abduction.solution.weighed import EQUAL, IMPROBABLE, MOST, Rival, Weighed
from ssh_abduction.solver.board import Judging, Known, projected
from ssh_abduction.solver.costs.beams import TRIED, Beams
from ssh_abduction.solver.costs.estimating import (
    CERTAIN,
    Course,
    course_completed,
    crowded,
    dstates_and_places,
    least_places,
    may_join_more,
    moved_visits,
    rival_of,
    rivals_of,
    rivals_with_misread_views,
)
from ssh_abduction.solver.costs.forced import Forcing
from ssh_abduction.solver.costs.misfit import Misfit
from ssh_abduction.solver.parts import Parts, Priced
from ssh_abduction.solver.schedule import Source, turn
from ssh_abduction.solver.sources.exact.choosing import READABLE, labelling_engine
from ssh_abduction.solver.sources.exact.engine import Task
from ssh_abduction.solver.sources.exact.prefixes import Prefixes
from ssh_abduction.solver.sources.metric.wrong_displacements import search_jumps
from ssh_abduction.solver.steps.faults import with_more_faults
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.evidence.displacement import jumped
from ssh_abduction.theory.prior import spreads_of
from ssh_abduction.theory.settle import Problem, displacement_of
from ssh_abduction.theory.speedups import row
from ssh_abduction.theory.theory import Theory

_log = log_of(__name__)

# Find all maps that cost less than this many nats more than the best one. All others are at least
# 100 times less probable than the best one.
WITHIN = math.log(100)
# Keep at most this many maps. If there are more, use fewer nats instead of WITHIN.
RIVALS = 50
# If the robot may be off the poses of its dstates, by errors with heavy tails, a misfit may be this
# many times as large as expected. Then standard deviations are 1.5 times too small.
EXCESS = 2.25
# Without a time limit, end Benders cuts after PATIENCE seconds plus MORE times the time of the best
# map.
PATIENCE, MORE = 10.0, 5.0
# Estimating rivals may end OVERTIME seconds late. It gets at least LEAST_ESTIMATING seconds.
OVERTIME, LEAST_ESTIMATING = 0.5, 0.1

# Lists the minimal maps of a trace and a theory within some seconds, and says whether they are
# proven.
OfLabels: TypeAlias = Callable[[Trace, Theory, float], tuple[tuple[SSHMap, ...], bool]]


@dataclass(frozen=True)
class Candidate:
    """A map with its cost in nats."""

    map: SSHMap
    nats: float


class Weighing:
    """The search for the maps of least cost of one trace.

    Attributes:
        beams: The guesses of the search.
        candidates: The maps found that cost little more than the best one, the best one first.
        bound: A proven lower bound on the cost of every map, in nats.
        of_labels: Lists the minimal maps of a theory within some time; None before the proof.
        proven: Whether it is proven that no map costs less than the best one.
    """

    def __init__(self, parts: Parts) -> None:
        """Prepare the search, whose sources are those of `beams`, and `proofs`."""
        self._parts = parts
        self._misfit = Misfit(parts.task.problem)
        # The counts that cost something, the one minimised first in front. If faults are allowed,
        # that one is the cost of dstates and faults in tenths of dstates.
        has_faults = parts.task.theory.has_faults
        self._counts = "tenths" if has_faults else "dstates", "places"
        # Every map has this many places, and this many nats of misfit.
        self._places = 0
        self._base = 0.0
        self._within = max(WITHIN, parts.limits.within)
        self._listed = 0.0  # all maps are known that cost up to this much more than the best one
        self.candidates: list[Candidate] = []
        self.bound = 0.0
        self.proven = False
        self.of_labels: OfLabels | None = None
        self.beams = Beams(parts, self._misfit, self.add, lambda: self._nats, self._believed)
        self._task = replace(parts.task, speedups=replace(parts.task.speedups, prefixes=False))
        self._forced: list[tuple[int, int]] = []  # pairs of steps at one dstate in all cheap maps
        # Faults need the readable encodings, which take too much memory for a long trace.
        self._is_long = has_faults and len(parts.task.trace) > READABLE
        # The seconds on the clock when the best map was found, and when Benders cuts began.
        self._improved = self._begun = 0.0

    @property
    def best(self) -> Candidate | None:
        """The map of least cost that is known; None before the first one."""
        return self.candidates[0] if self.candidates else None

    def minimal(self) -> list[Candidate]:
        """Return the maps of least cost."""
        return [candidate for candidate in self.candidates if candidate.nats <= self._nats + EQUAL]

    @property
    def _nats(self) -> float:
        """The cost of the best map in nats; infinite before the first one."""
        return self.candidates[0].nats if self.candidates else math.inf

    @property
    def _most(self) -> float:
        """The cost in nats from which on maps are not worth finding."""
        return self._nats + max(self._within, EQUAL)

    def _raise_bound(self, nats: float) -> None:
        """Raise the bound, unless it is higher. The best map costs as much as the bound or more."""
        self.bound = max(self.bound, min(nats, self._nats))

    def proofs(self) -> list[Source]:
        """List the sources that bound the cost of all maps, in the order of the schedule.

        Forget what was proven about counts, and bound the cost by what each map pays.
        """
        parts, problem, theory = self._parts, self._task.problem, self._task.theory
        parts.known.status = Status.UNKNOWN
        self._improved = parts.watch.elapsed()
        if parts.known.best is not None:
            self.add(parts.known.best)
        self._places = least_places(problem)
        may_be_wrong = range(1, len(problem.trace)) if theory.jumped else ()
        self._base = self._misfit.of_returns([], may_be_wrong) / 2
        return [
            Source(
                turn("forced joins, last" if self._is_long else "forced joins"),
                lambda: bool(self.candidates) and Forcing.holds_for(problem),
                self._force,
            ),
            Source(turn("Benders cuts"), lambda: not self.proven, self._cut),
        ]

    def _force(self) -> None:
        """Find all cheap maps, or joins that they have, and raise the bound.

        If a limit ends this, clingo asserts the joins.
        """
        task, most, watch = self._task, self._most, self._parts.watch
        forcing = Forcing(task.problem, task.log, self._misfit, self.candidates[0].map)
        spent = list[tuple[float, float]]()  # limits, and the work that each took
        try:
            for limit in forcing.limits(self._nats + 2 * EQUAL, most):
                if limit < self._nats and _proof_takes(spent, self._nats) < watch.left():
                    continue
                began = watch.elapsed()
                for bound in forcing.bounds(limit):
                    self._raise_bound(bound)
                spent.append((limit, watch.elapsed() - began))
                known = {dstates_and_places(candidate.map) for candidate in self.candidates}
                others = [one for one in forcing.found if one not in known]
                if limit > self._nats and forcing.is_complete and all(map(self._knows, others)):
                    self._keep_proof(limit - self._nats)
        finally:
            returns = forcing.returns(most)
            self._forced = [(one.first, one.second) for one in returns if one.of == "dstate"]
            self._base = max(self._base, self._misfit.of_returns(returns) / 2)

    def _keep_proof(self, listed: float) -> None:
        """Remember that all maps are known that cost less than this much more than the best one."""
        self.bound, self.proven, self._listed = self._nats, True, listed
        self._parts.known.status = Status.OPTIMAL

    def _knows(self, course: Course) -> bool:
        """Add a map with these dstates and places, if there is one. Return whether this is sure."""
        task = self._task
        found = course_completed(task.problem, self._misfit, *course)
        if found is not None and self._parts.candidates.accepts(found):
            self.add(found)
            return True
        if task.theory.has_faults or self.of_labels is None:
            return False
        pinned = _pinned(task.theory, course)
        maps, proven = self.of_labels(task.trace, pinned, self._parts.watch.left())
        costs = [self.add(ssh_map) for ssh_map in maps if dstates_and_places(ssh_map) == course]
        # The axioms may need more places. These maps have the fewest.
        by_places = task.theory.priorities[:2] == ("dstates", "places")
        too_few = by_places and all(len(one.places) > len({*course[1]}) for one in maps)
        return proven and (too_few or len(costs) == len(maps))

    def may_move(self) -> bool:
        """Whether to move visits: beams suit the trace, and no displacement may be wrong."""
        beam = self._parts.candidates.beam(1)
        return bool(self.candidates and beam) and not self._task.theory.jumped

    def move_visits(self) -> None:
        """Move single visits of the best map to places near them, as long as that costs less."""
        problem, candidates, before = self._task.problem, self._parts.candidates, math.inf
        while self._nats < before - EQUAL:
            before = self._nats
            for course in moved_visits(problem, self._misfit, self.candidates[0].map):
                look_at_clock()
                if self._misfit.nats_of_course(*course) < before + TRIED:
                    bare = course_completed(problem, self._misfit, *course)
                    merged = candidates.smoothed(self._misfit.beginning_at(*course))
                    if bare is not None and candidates.accepts(bare):
                        self.add(bare)
                    if merged is not None:
                        self.add(merged)

    def may_jump(self) -> bool:
        """Whether to search for wrong displacements: the trace is too long for a proof of them."""
        return self._is_long and bool(self.candidates and self._task.theory.jumped)

    def search_jumps(self) -> None:
        """Look for cheaper maps with other wrong displacements."""
        if self._parts.candidates.beam(1):
            beams, best = self.beams, self.candidates[0].map
            search_jumps(self._task.trace, beams.maps_without, beams.refitted, best, self.add)

    def _cut(self) -> None:
        """List maps by their counts, and exclude those whose misfit is too expensive."""
        parts, task = self._parts, self._task
        self._begun = parts.watch.elapsed()
        if self._is_long:
            raise LimitError("no proof")
        if self._forced and row("visits").holds_for(task.theory):
            theory = task.theory.replace(same=(*task.theory.same, *self._forced))
            asserted = Task.of(task.problem.changed(theory=theory), task.watch)
            task = replace(asserted, speedups=task.speedups)
        best = parts.known.best
        engine = labelling_engine(task, best.dstate_at if best else ())
        judging = _CostJudging(task.problem, self)
        engine.grow(len(task.trace))
        prefixes = Prefixes(task, Known(task.theory), judging, engine, 1, parts.report)
        try:
            last = prefixes.minimise()
        finally:
            if self.candidates and "dstates" in self._counts:
                # Clingo proved that each map left has at least this many dstates.
                self._raise_bound(self._at_least({"dstates": prefixes.engine.bound or 0}))
        if last is None and not self.candidates:
            parts.known.status = Status.UNSATISFIABLE
            return
        self._keep_proof(self._within)

    def keep_best(self) -> None:
        """Compute the cost of the search's best map. Make the cheapest known map the best one.

        If a limit ends the computation, the cheapest map whose cost is known becomes the best one.
        """
        known = self._parts.known
        try:
            if known.best is not None:
                self.add(known.best)
        finally:
            if not self.proven:
                dstates, tenths = known.bound.dstates or 0, known.bound.tenths or 0
                least = {"dstates": dstates, "tenths": max(tenths, 10 * dstates)}
                self._raise_bound(self._at_least({self._counts[0]: least[self._counts[0]]}))
            if self.candidates:
                best = self.candidates[0].map
                known.keep(Found.of(best, self._task.theory), best.dstate_at)

    def maps(self) -> Generator[Priced, None, None]:
        """Yield the maps of least cost, then maps that cost up to `within` nats more.

        All maps of least cost come with the counts of the best one, even if theirs differ. A map
        that costs more comes with its own counts and its rank, so that no other has its cost.
        """
        parts, theory = self._parts, self._task.theory
        complete = True
        # Candidates with the same dstates, places and wrong displacements differ only in paths.
        kinds = firsts(
            ((dstates_and_places(candidate.map), jumped(candidate.map)), candidate.map)
            for candidate in self.minimal()
        )
        for ssh_map in kinds.values():
            maps, proven = self._with_other_paths(ssh_map)
            complete &= proven
            yield from ((one, parts.known.cost) for one in maps)
        complete &= len(self.minimal()) < RIVALS and self._listed >= parts.limits.within
        parts.rivals.listed = complete
        most = self._nats + parts.limits.within
        for rank, candidate in enumerate(self.candidates[len(self.minimal()) :]):
            if candidate.nats <= most:
                yield candidate.map, (*Cost.of(candidate.map).preferred_by(theory), rank)
        if len(self.minimal()) == RIVALS:
            raise LimitError("maps limit")
        if not complete:
            raise LimitError(parts.limit_reached)

    def _with_other_paths(self, ssh_map: SSHMap) -> tuple[tuple[SSHMap, ...], bool]:
        """List all maps that differ from a map only in their paths, and have as many paths.

        They cost the same and have the same wrong displacements, but may have other faults. Also
        return whether these are proven to be all.
        """
        task, wrong = self._parts.task, jumped(ssh_map)
        theory = task.theory
        if (theory.level == "causal" and not theory.has_faults) or self.of_labels is None:
            return (ssh_map,), True
        trace = task.trace.without_displacements_at(wrong)
        pinned = _pinned(theory, dstates_and_places(ssh_map)).replace(
            jumped=0.0, displacement="use" if trace.has_displacements else "none"
        )
        found, proven = self.of_labels(trace, pinned, self._parts.watch.left())
        jumps = tuple(fault for fault in ssh_map.faults if fault.kind == "jumped")
        alike = [
            with_more_faults(other, jumps)
            for other in found
            if dstates_and_places(other) == dstates_and_places(ssh_map)
        ]
        return tuple(alike) or (ssh_map,), proven and bool(alike)

    def add(self, ssh_map: SSHMap) -> float:
        """Return the cost of a map in nats. Keep the map if it costs little more than the best."""
        ssh_map = projected(ssh_map, self._task.theory)
        nats = self._misfit.nats_of(ssh_map)
        if nats < self._nats - EQUAL:
            self._improved = self._parts.watch.elapsed()
        if all(known.map != ssh_map for known in self.candidates):
            self.candidates.append(Candidate(ssh_map, nats))
            self.candidates.sort(key=lambda candidate: candidate.nats)
            if len(self.candidates) > RIVALS:
                self._within = min(self._within, self.candidates[RIVALS].nats - self._nats)
            self.candidates = [c for c in self.candidates if c.nats < self._most][:RIVALS]
        return nats

    def too_expensive(self, ssh_map: SSHMap) -> frozenset[Equality] | None:
        """Add a map. Return equalities that exclude it; None if no map left is worth finding.

        The map has the fewest dstates, places and paths of all maps left. The equalities are
        returns and believed displacements. They exclude no map worth finding.
        """
        look_at_clock()
        watch = self._parts.watch
        lasts = watch.elapsed() - self._begun
        if watch.left() == math.inf and lasts > PATIENCE + MORE * self._improved:
            raise LimitError("no proof")
        least = self._cost_of_others(ssh_map)
        self._raise_bound(least)
        if least >= self._most:
            return None
        nats = self.add(ssh_map)
        _log.debug("a map of %.1f nats, and all others cost at least %.1f", nats, least)
        task, returns, wrong = self._parts.task, self._misfit.returns_of(ssh_map), jumped(ssh_map)
        # `least` already has the misfit that the track has without returns.
        enough = 2 * (self._most - least + self._base)
        if nats >= self._most and self._misfit.of_returns(returns, wrong) >= enough:
            returns = self._misfit.core(returns[::-1], enough, wrong)
        elif task.theory.has_faults:
            returns = _exactly(ssh_map)
        displacement = displacement_of(task.problem)
        believed = displacement.believed(task.trace, returns, wrong) if displacement else ()
        return frozenset((*returns, *believed)) or None

    def _cost_of_others(self, ssh_map: SSHMap) -> float:
        """Compute a lower bound on the cost of this map and of all maps after it in clingo's order.

        The order is lexicographic: the first count in which a later map differs is greater.
        """
        counts = Cost.of(ssh_map)
        found, known = list[float](), dict[str, int]()
        for name in self._task.theory.priorities:
            if name in self._counts:
                number = getattr(counts, name)
                found.append(self._at_least({**known, name: number + 1}))
                known[name] = number
        return min(*found, self._at_least(known))

    def _at_least(self, counts: Mapping[str, int]) -> float:
        """Return a lower bound on the cost of maps that have at least these counts, in nats."""
        counts = {"places": self._places, **counts}
        return self._task.problem.prior.at_least(counts) + self._base

    def weighed(self) -> Weighed | None:
        """Collect what is known about the costs of maps; None if no map is known."""
        if not self.candidates:
            return None
        known = (rival_of(candidate.map, candidate.nats) for candidate in self.candidates)
        rivals = firsts(((rival.dstates, rival.places), rival) for rival in known)
        found, excess, doubt = list(rivals.values()), self._excess(), None
        problem = self._task.problem
        is_likely = excess < math.inf and not may_join_more(problem, found)
        if self.proven and not 1 < excess < math.inf:
            doubt = _misfit_of(problem, self.candidates[0].map)
        misread = rivals_with_misread_views(
            problem, self._misfit, self.candidates[0].map, self._estimating
        )
        suspected = [rival for rival in misread if rival.nats < found[0].nats + CERTAIN]
        every = (*found, *self._estimated(found[0], set(rivals)), *suspected)
        return Weighed(
            bound=self.bound,
            within=min(self._listed, self._within),
            rivals=crowded(problem, self._misfit, [*map(self._with_aliases, every)]),
            searched=is_likely and self.beams.found(self._nats),
            broken=self.beams.broken,
            excess=excess if excess < math.inf else 1.0,
            doubt=doubt,
            drives=drives_of(problem.trace),
        )

    def _believed(self) -> Set[int]:
        """Return the numbers of the closures that the best map believes."""
        closures = range(len(self._task.trace.closures))
        if not self.candidates:
            return frozenset(closures)
        best = self._with_aliases(rival_of(self.candidates[0].map, 0.0))
        return {i for i in closures if not (best.aliases and best.aliases[i])}

    def _with_aliases(self, rival: Rival) -> Rival:
        wrong = [step for kind, step in rival.faults if kind == "jumped"]
        aliases = self._misfit.aliases_of(rival.dstates, rival.at, wrong)
        return replace(rival, aliases=aliases if any(aliases) else ())

    def _excess(self) -> float:
        """Return the misfit of the returns of the best map, divided by its expected value.

        Return 1 if the misfit is not improbable, and inf if it is too large to be trusted.
        """
        best = self.candidates[0].map
        returns = self._misfit.returns_of(best)
        square = self._misfit.of_closing(best)
        freedom = sum(3 if found.of == "dstate" else 2 for found in returns)
        if not freedom or gammaincc(freedom / 2, max(square, 0.0) / 2) >= IMPROBABLE:
            return 1.0
        is_off = spreads_of(self._task.trace).any()
        return square / freedom if is_off and square <= EXCESS * freedom else math.inf

    @property
    def _estimating(self) -> float:
        """The seconds that estimating rivals may take."""
        left = max(self._parts.watch.left() + OVERTIME, LEAST_ESTIMATING)
        return min(left, turn("estimated rivals").most)

    def _estimated(self, best: Rival, known: Collection[Course]) -> Iterator[Rival]:
        """Yield estimated rivals that the search did not find.

        If it found all maps below a cost, estimated rivals below it break axioms: leave them out.
        """
        least = best.nats + min(self._listed, self._within) if self.proven else -math.inf
        problem, ssh_map = self._task.problem, self.candidates[0].map
        for rival in rivals_of(problem, self._misfit, ssh_map, self._estimating):
            if rival.nats >= least and (rival.dstates, rival.places) not in known:
                yield rival


def _misfit_of(problem: Problem, best: SSHMap) -> str | None:
    """Say that the best map contradicts the displacements, if it does; else None.

    A map that costs least may still be false: the displacements, or the axioms, may be wrong.
    """
    from ssh_abduction.solver.geometry.fit import fit  # loads scipy

    believed = problem.trace.without_displacements_at(jumped(best))
    if fit(believed, best).p >= problem.theory.reject:
        return None
    return "the best map does not fit the displacements"


def _exactly(ssh_map: SSHMap) -> list[Equality]:
    """List for each pair of steps whether they are at one dstate, and whether at one place.

    These equalities exclude only maps with exactly these dstates and places. A map with more
    returns is not excluded, as it may have fewer faults.
    """
    dstates, places = dstates_and_places(ssh_map)
    found = []
    for of, names in (("dstate", dstates), ("place", places if ssh_map.places else ())):
        pairs = combinations(range(len(names)), 2)
        found += [Equality(i, j, of, names[i] == names[j]) for i, j in pairs]
    return found


def _proof_takes(spent: Sequence[tuple[float, float]], nats: float) -> float:
    """Estimate the work for a limit of `nats`, as the work for limits grows exponentially.

    `spent` has limits in rising order, and the work that each took.
    """
    if len(spent) < 2 or not 0 < spent[0][1] < spent[-1][1]:
        return math.inf
    (first, less), (last, work) = spent[0], spent[-1]
    growth = math.log(work / less) * (nats - last) / (last - first)
    return work * math.exp(min(growth, MOST))


def _pinned(theory: Theory, course: Course) -> Theory:
    """Return a theory that compares maps by counts, and asserts the dstates and places of steps.

    It asserts which dstates are at different places, but not which are at one place.
    """
    labels, places = course
    first = first_index_of(labels)
    same = [(first[label], t) for t, label in enumerate(labels) if t != first[label]]
    pairs = [*combinations(first.values(), 2)]
    different = [(i, j) for i, j in pairs if places[i] == places[j]]
    elsewhere = [(i, j) for i, j in pairs if places[i] != places[j]]
    return theory.replace(
        weigh="count",
        same=(*theory.same, *same),
        different=(*theory.different, *different),
        elsewhere=(*theory.elsewhere, *elsewhere),
    )


class _CostJudging(Judging):
    """Rejects maps that contradict evidence, and then those that are too expensive."""

    def __init__(self, problem: Problem, weighing: Weighing) -> None:
        super().__init__(problem)
        self._weighing = weighing

    def refusal(self, ssh_map: SSHMap) -> tuple[str, frozenset[Equality]] | None:
        """Return what rejects a map (evidence, or "cost"), and equalities to forbid, if any."""
        if (found := super().refusal(ssh_map)) is not None:
            return found
        returns = self._weighing.too_expensive(ssh_map)
        return None if returns is None else ("cost", returns)

    def why_refused(self, ssh_map: SSHMap) -> frozenset[Equality] | None:
        """Return equalities of a map that contradict evidence; None if no evidence rejects it."""
        found = super().refusal(ssh_map)
        return found[1] if found else None
