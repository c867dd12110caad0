"""Find the maps of least cost, and prove it: the prices of what a map has, and its misfit.

The cost of a map is the sum of the prices of its dstates, places and paths, and half of the
chi-square of its misfit to the displacements (`misfit.py`).

*The search* is a logic-based Benders decomposition (Hooker & Ottosson 2003). clingo finds the map
with the fewest dstates, and among these the fewest places and paths. It knows nothing of the
misfit. If the map has returns whose misfit alone makes every map with them too expensive, clingo is
told so: no map has all of these returns. Then it finds the next map. Its number of dstates never
falls, so the prices of the last map bound the cost of all maps that are left. The search ends when
this bound reaches the cost of the best map.

*Rivals.* A map is too expensive if it costs at least `WITHIN` nats more than the best one. So all
maps that cost less are found, and each weighs exp(-cost) beside the others.

*Places* are not minimised first, so a bound on them comes from visits that are pairwise at
different places by the evidence.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Generator, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TypeAlias

from scipy.special import gammaincc

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.runtime.logs import log_of
from ssh_abduction.solver.asp.limits import LimitError, StageTimeError
from ssh_abduction.solver.choosing import FEW_STEPS, new_engine, takes_all
from ssh_abduction.solver.engines.base import Engine, Found, Task
from ssh_abduction.solver.engines.stepwise import StepEngine
from ssh_abduction.solver.judging import Judging
from ssh_abduction.solver.known import Known
from ssh_abduction.solver.map_list import Priced
from ssh_abduction.solver.misfit import Misfit
from ssh_abduction.solver.parts import Parts
from ssh_abduction.solver.prefixes import Prefixes
from ssh_abduction.solver.steps.chart import numbered
from ssh_abduction.solver.values import Cost, Status
from ssh_abduction.solver.weighed import EQUAL, Rival, Weighed
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.theory import Theory

_log = log_of(__name__)

# What has a price, in the order of `Theory.prices`.
NAMES = ("dstates", "places", "paths")
# Maps that cost less than this many nats more than the best one are found: 100 times less probable.
WITHIN = math.log(100)
# At most this many maps are kept. If there are more, fewer nats count.
RIVALS = 50
# A misfit is improbable if a true map is worse with less than this probability.
IMPROBABLE = 0.01
# Without a time limit, give the proof up when no better map was found for this many seconds, and
# this many times as long as it took to find the best one.
PATIENCE, MORE = 10.0, 5.0
# Guess maps by beams of hypotheses of these widths. Each may take time until this share of the time
# limit is over.
WIDTHS = {1: 0.8, 4: 0.6, 16: 0.4}
# A beam of this width or more ends with the map of least cost, nearly always.
BROAD = 4
# Estimating rivals may take this many seconds. A rival that costs CERTAIN nats more than the best
# map does not count: a million of them make 0.005 of a doubt.
ESTIMATING, CERTAIN = 0.5, 19.0


# Lists the minimal maps of a theory within some seconds, and says whether they are proven.
OfLabels: TypeAlias = Callable[[Theory, float], tuple[tuple[SSHMap, ...], bool]]


@dataclass(frozen=True)
class Candidate:
    """A map with its cost in nats."""

    map: SSHMap
    nats: float


class Weighing:
    """The search for the maps of least cost of one trace.

    Attributes:
        candidates: The maps found that cost little more than the best one, the best one first.
        bound: A proven lower bound on the cost of every map, in nats.
        proven: Whether the best map is proven to be one, and all its rivals are found.
    """

    def __init__(self, parts: Parts) -> None:
        """Search nothing yet.

        Args:
            parts: The parts of the search. Its stages may have found a map by counting.
        """
        self._parts = parts
        self._misfit = Misfit(parts.task.problem)
        self._prices = parts.task.theory.prices
        self._least: dict[str, int] = {}
        self._base = 0.0
        self._within = max(WITHIN, parts.limits.within)
        self.candidates: list[Candidate] = []
        self.bound = 0.0
        self.proven = False
        self._of_labels: OfLabels | None = None
        # The cost of the best map of the last broad beam, and the cost that the beam gave it.
        self._searched = math.inf, math.inf
        self._broken = -math.inf  # how many nats less a map costs that breaks axioms
        self._improved = 0.0  # when the best map was found

    @property
    def best(self) -> Candidate | None:
        """The map of least cost that is known; None before the first one."""
        return self.candidates[0] if self.candidates else None

    def minimal(self) -> list[Candidate]:
        """The maps of least cost."""
        least = self.candidates[0].nats + EQUAL if self.candidates else 0.0
        return [candidate for candidate in self.candidates if candidate.nats <= least]

    def guess(self) -> None:
        """Find some maps of little cost without clingo, in a share of the time."""
        parts, watch = self._parts, self._parts.watch
        begun, left = watch.elapsed(), watch.left()
        is_long = len(parts.task.trace) > FEW_STEPS
        if is_long and left > 0 and parts.task.theory.star != "gateways":
            parts.candidates.sketch(0.0)  # only the surest sketch has time
            self.keep_best()
        for width, share in WIDTHS.items():
            watch.end_stage_after(begun + share * left)
            if (beam := parts.candidates.beam(width)) is None:
                break
            with suppress(StageTimeError):
                found = [self.add(ssh_map) for ssh_map in parts.candidates.maps_of(beam)]
                if width >= BROAD:
                    self._searched = min(found, default=math.inf), beam.nats
                self.keep_best()
                parts.report()
        watch.end_stage_after(begun + WIDTHS[BROAD] * left)
        with suppress(StageTimeError):
            if self._searched[1] < math.inf and (beam := parts.candidates.beam(max(WIDTHS))):
                self._broken = self._searched[1] - beam.nats_without_axioms()
        watch.end_stage_after(math.inf)

    def search(self, of_labels: OfLabels) -> None:
        """Find the maps of least cost and their rivals, and prove that there are no others.

        Args:
            of_labels: Lists the minimal maps of a theory, within some seconds.

        Raises:
            LimitError: A limit is over. What was found so far is kept.
        """
        parts, self._of_labels = self._parts, of_labels
        parts.known.status = Status.UNKNOWN  # what was proven is about counts
        self._improved = parts.watch.elapsed()
        parts.watch.use_reserve()
        if parts.known.best is not None:
            self.add(parts.known.best)
        self._least = {"places": _least_places(parts.task.problem)}
        self._base = self._misfit.of_returns([]) / 2  # of every map
        task = replace(parts.task, speedups=replace(parts.task.speedups, prefixes=False))
        judging = _Judging(task.problem, self)
        engine = _engine(task, parts)
        engine.grow(len(task.trace))
        prefixes = Prefixes(task, Known(task.theory), judging, engine, 1, parts.report)
        try:
            last = prefixes.minimise()
        finally:
            prefixes.engine.settle()
        if last is None and not self.candidates:
            parts.known.status = Status.UNSATISFIABLE
            return
        self.bound = self.candidates[0].nats
        self.proven = True
        parts.known.status = Status.OPTIMAL
        self.keep_best()

    def keep_best(self) -> None:
        """Make the map of least cost the best map of the search.

        A map that the search made without weighing is weighed before.
        """
        known = self._parts.known
        if known.best is not None:
            self.add(known.best)
        if not self.proven:
            least = {**dict.fromkeys(NAMES, 0), **self._least, "dstates": known.bound.dstates or 0}
            self.bound = max(self.bound, self._price(least) + self._base)
        if self.candidates:
            best = self.candidates[0].map
            known.keep(Found.of(best, self._parts.task.theory), best.labels)

    def maps(self) -> Generator[Priced, None, None]:
        """The maps of least cost, and then those that cost up to `within` nats more."""
        parts, theory = self._parts, self._parts.task.theory
        complete = True
        listed: set[SSHMap] = set()  # Candidates with the same dstates and places list one another.
        for candidate in self.minimal():
            maps, proven = self._with_other_paths(candidate.map)
            complete &= proven
            new = [ssh_map for ssh_map in maps if ssh_map not in listed]
            listed.update(new)
            yield from ((ssh_map, Cost.of(ssh_map).preferred_by(theory)) for ssh_map in new)
        parts.rivals.listed = complete
        most = self.candidates[0].nats + parts.limits.within if self.candidates else 0.0
        for candidate in self.candidates[len(self.minimal()) :]:
            if candidate.nats <= most:
                yield candidate.map, Cost.of(candidate.map).preferred_by(theory)

    def _with_other_paths(self, ssh_map: SSHMap) -> tuple[tuple[SSHMap, ...], bool]:
        """All maps with the dstates and places of a map, and as few paths; and whether it is all.

        They cost the same, as displacements say nothing about paths.
        """
        theory, watch = self._parts.task.theory, self._parts.watch
        if theory.level == "causal" or self._of_labels is None:
            return (ssh_map,), True
        pinned = _pinned(theory, ssh_map)
        found, proven = self._of_labels(pinned, watch.left())
        alike = [other for other in found if _course(other) == _course(ssh_map)]
        return tuple(alike) or (ssh_map,), proven and bool(alike)

    def add(self, ssh_map: SSHMap) -> float:
        """Compute the cost of a map, and keep it if it costs little more than the best one.

        Returns:
            The cost in nats.
        """
        counts = Cost.of(ssh_map)
        prices = self._price({name: getattr(counts, name) for name in NAMES})
        nats = prices + self._misfit.of_map(ssh_map) / 2
        if self.candidates and nats < self.candidates[0].nats - EQUAL:
            self._improved = self._parts.watch.elapsed()
        if all(known.map != ssh_map for known in self.candidates):
            self.candidates.append(Candidate(ssh_map, nats))
            self.candidates.sort(key=lambda candidate: candidate.nats)
            if len(self.candidates) > RIVALS:
                beyond = self.candidates[RIVALS].nats - self.candidates[0].nats
                self._within = min(self._within, beyond)
            most = self.candidates[0].nats + max(self._within, EQUAL)
            self.candidates = [c for c in self.candidates if c.nats < most][:RIVALS]
        return nats

    def too_expensive(self, ssh_map: SSHMap) -> frozenset[Equality] | None:
        """Returns of a map that no other map worth finding has; None if no such map is left.

        Args:
            ssh_map: The map that has the fewest dstates, places and paths of all maps left.
        """
        look_at_clock()
        self._check_patience()
        least = self._cost_of_others(ssh_map)
        self.bound = max(self.bound, min(least, self.candidates[0].nats if self.candidates else 0))
        if self.candidates and least >= self._most:
            return None
        nats = self.add(ssh_map)
        _log.debug("a map of %.1f nats, and all others cost at least %.1f", nats, least)
        returns = self._misfit.returns_of(ssh_map)
        if nats < self._most:
            return frozenset(returns) or None
        # The misfit of no returns is in `least` already.
        enough = 2 * (self._most - least + self._base)
        return frozenset(self._misfit.core(returns[::-1], enough)) or None

    def _check_patience(self) -> None:
        """Without a time limit, raise LimitError if no better map was found for long."""
        watch = self._parts.watch
        if watch.left() == math.inf and watch.elapsed() > PATIENCE + MORE * self._improved:
            raise LimitError("no proof")

    @property
    def _most(self) -> float:
        """Maps of this cost or more are not worth finding."""
        return self.candidates[0].nats + max(self._within, EQUAL)

    def _cost_of_others(self, ssh_map: SSHMap) -> float:
        """A lower bound on the cost of all maps that are not before this one in clingo's order.

        The order compares one count after the other. So the counts of a later map are equal up to
        some count, and greater there.
        """
        counts, priorities = Cost.of(ssh_map), self._parts.task.theory.priorities
        least = {name: self._least.get(name, 0) for name in NAMES}
        found = []
        for name in priorities:
            if name in least:
                number = getattr(counts, name)
                found.append(self._price({**least, name: number + 1}))
                least[name] = number
        return min(*found, self._price(least)) + self._base

    def _price(self, counts: Mapping[str, int]) -> float:
        """The price of this many dstates, places and paths, in nats."""
        return sum(price * counts[name] for name, price in zip(NAMES, self._prices, strict=True))

    def weighed(self) -> Weighed | None:
        """What is known of the costs; None if no map is known."""
        if not self.candidates:
            return None
        rivals: dict[tuple[tuple[int, ...], ...], Rival] = {}
        for candidate in self.candidates:
            rival = _rival_of(candidate)
            rivals.setdefault((rival.dstates, rival.places), rival)
        found = list(rivals.values())
        return Weighed(
            bound=self.bound,
            within=self._within if self.proven else 0.0,
            rivals=(*found, *self._estimated(found[0], set(rivals))),
            searched=self._is_searched_and_closes(),
            broken=self._broken,
        )

    def _is_searched_and_closes(self) -> bool:
        """Whether a broad beam ended with the best map, and its misfit is not improbable."""
        is_best = self._searched[0] <= self.candidates[0].nats + EQUAL
        if not is_best or not math.isfinite(self._broken):
            return False
        best = self.candidates[0].map
        returns = self._misfit.returns_of(best)
        square = self._misfit.of_returns(returns) - self._misfit.of_returns([])
        freedom = sum(3 if found.of == "dstate" else 2 for found in returns)
        return freedom == 0 or float(gammaincc(freedom / 2, max(square, 0.0) / 2)) >= IMPROBABLE

    def _estimated(
        self, best: Rival, known: Collection[tuple[tuple[int, ...], ...]]
    ) -> Iterator[Rival]:
        """Rivals in which some visits to a place of the best map are visits to a new place.

        These are each single visit, and all visits from one on. The axioms may not allow them. If
        all maps within some nats are known, a rival that costs less breaks an axiom.
        """
        counts = Cost.of(self.candidates[0].map)
        paths = self._prices[2] * counts.paths
        least = best.nats + self._within if self.proven else -math.inf
        at = best.places or best.dstates
        visits: dict[int, list[int]] = {}  # the first steps of the visits to each place
        for step, begin in enumerate(_begins(at, self._misfit.visit)):
            if begin == step:
                visits.setdefault(at[step], []).append(step)
        ends = time.perf_counter() + ESTIMATING
        tried = set(known)
        for name, begins in visits.items():
            singly = [{begin} for begin in begins[1:]]
            from_then_on = [set(begins[i:]) for i in range(1, len(begins) - 1)]
            for moved in (*singly, *from_then_on) if len(begins) > 1 else ():
                if time.perf_counter() > ends:
                    return
                dstates, places = _moved(best, self._misfit.visit, name, moved)
                if (dstates, places) in tried:
                    continue
                tried.add((dstates, places))
                nats = paths + self._misfit.of_course(dstates, places or dstates) / 2
                nats += self._prices[0] * len(set(dstates)) + self._prices[1] * len(set(places))
                if least <= nats < best.nats + CERTAIN:
                    yield Rival(nats, dstates, places, estimated=True)


def _moved(
    best: Rival, visit: Sequence[int], place: int, moved: Collection[int]
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The dstates and places of a map, if some visits to a place are visits to a new one.

    Args:
        best: The map.
        visit: The first step of the visit of each step.
        place: The place; without places, the dstate.
        moved: The first steps of the visits.
    """
    at = best.places or best.dstates
    begins = _begins(at, visit)
    new = [name == place and begin in moved for name, begin in zip(at, begins, strict=True)]
    more = len(at)
    dstates = [name + more * is_new for name, is_new in zip(best.dstates, new, strict=True)]
    places = [name + more * is_new for name, is_new in zip(best.places, new, strict=False)]
    return tuple(numbered(dstates)), tuple(numbered(places))


def _begins(at: Sequence[int], visit: Sequence[int]) -> list[int]:
    """The first step of the visit of each step to its place, or without places to its dstate."""
    begins: list[int] = []
    for step, name in enumerate(at):
        is_first = not step or at[step - 1] != name or visit[step] == step
        begins.append(step if is_first else begins[-1])
    return begins


def _course(ssh_map: SSHMap) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The dstate and the place of each step, numbered by first visit."""
    places = [ssh_map.dstates[label].place for label in ssh_map.labels]
    return tuple(numbered(ssh_map.labels)), tuple(numbered(places))


def _pinned(theory: Theory, ssh_map: SSHMap) -> Theory:
    """The theory that counts, and demands the dstates of a map and its different places."""
    labels = ssh_map.labels
    first = {label: labels.index(label) for label in dict.fromkeys(labels)}
    same = [(first[label], t) for t, label in enumerate(labels) if t != first[label]]
    different: list[tuple[int, int]] = []
    elsewhere: list[tuple[int, int]] = []
    for a, b in combinations(first, 2):
        is_one_place = ssh_map.dstates[a].place == ssh_map.dstates[b].place
        (different if is_one_place else elsewhere).append((first[a], first[b]))
    return theory.replace(
        weigh="count",
        same=(*theory.same, *same),
        different=(*theory.different, *different),
        elsewhere=(*theory.elsewhere, *elsewhere),
    )


def _rival_of(candidate: Candidate) -> Rival:
    dstates, places = _course(candidate.map)
    return Rival(candidate.nats, dstates, places if candidate.map.places else ())


class _Judging(Judging):
    """Rejects maps that contradict evidence, and then those that are too expensive."""

    def __init__(self, problem: Problem, weighing: Weighing) -> None:
        super().__init__(problem)
        self._weighing = weighing

    def refusal(self, ssh_map: SSHMap) -> tuple[str, frozenset[Equality]] | None:
        """The name of what rejects a map, and returns that no map left has; None to end here."""
        if (found := super().refusal(ssh_map)) is not None:
            return found
        returns = self._weighing.too_expensive(ssh_map)
        return None if returns is None else ("cost", returns)

    def why_refused(self, ssh_map: SSHMap) -> frozenset[Equality] | None:
        """Returns that contradict evidence; None if no evidence rejects the map."""
        found = super().refusal(ssh_map)
        return found[1] if found else None


def _engine(task: Task, parts: Parts) -> Engine:
    """A new engine for the whole trace, of the kind that found maps by counting."""
    engine = new_engine(task)
    best = parts.known.best
    if isinstance(engine, StepEngine) and takes_all(task) and task.speedups.ways and best:
        from ssh_abduction.solver.engines.frameless import FramelessEngine  # loads numpy

        return FramelessEngine(task, best.labels)
    return engine


def _least_places(problem: Problem) -> int:
    """The size of a large set of visits that are pairwise at different places by the evidence."""
    if problem.theory.level == "causal":
        return 0
    import numpy as np

    from ssh_abduction.solver.steps.apart import large_clique

    elsewhere = problem.pairs.elsewhere
    steps = sorted({0, *elsewhere, *(i for others in elsewhere.values() for i in others)})
    number = {step: i for i, step in enumerate(steps)}
    apart = np.zeros((len(steps), len(steps)), dtype=bool)
    for j, others in elsewhere.items():
        for i in others:
            apart[number[i], number[j]] = apart[number[j], number[i]] = True
    return len(large_clique(apart))
