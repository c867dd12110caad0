"""Keep the minimal maps of a growing trace up to date, for a theory that allows no faults.

A fault is a step that a map treats as wrong. A minimal map is kept by replaying it: following its
links along the steps of the trace, as long as it predicts what the robot sees.

A *draft* is a map that is made without a search from a good map of the first steps: each further
step gets a new dstate (a place and a heading) unless the axioms imply at which known dstate it is
(`solver/sources/symbolic/sketch.py`). It is used if finding a minimal map takes too long.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from ssh_abduction.checker.checker import unchecked
from ssh_abduction.data.groups import firsts, gathered
from ssh_abduction.data.maps import DState, Fault, SSHMap
from ssh_abduction.data.trace import Action, Step, Trace
from ssh_abduction.solution import Cost, Effort, Seconds, Solution, Status, Stop
from ssh_abduction.solver import Judging, Search, Sketch, Start, observation, sketch_beyond
from ssh_abduction.theory.evidence import said_by
from ssh_abduction.theory.pairs import Pairs
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.speedups import Speedups, row
from ssh_abduction.theory.theory import Theory

# After a search that was stopped, the trace grows by this factor before the next one, so that few
# steps are slow.
RETRY = 1.01
# It grows by at least this many steps.
PAUSE = 2
# Keep at most this many drafts, as each takes time at every step. Mostly at least one of the best
# drafts remains consistent for long.
DRAFTS = 3
# As `observation` returns it: the view, and the star (the openings seen) or None.
Seen = tuple[object, object]
# What a dstate costs, in tenths of dstates.
DSTATE = 10


@dataclass(frozen=True, slots=True)
class StepOptions:
    """The limits and speed-ups for solving at each step."""

    # Seconds for each step. A step may take a little longer. None waits for the exact answer.
    time_limit: float | None
    work_limit: float | None  # units of work for each step; None for no limit
    max_maps: int | None  # keep at most this many minimal maps; None keeps all
    speedups: Speedups  # flags that say which speed-ups of the solver to use


class Keeper(ABC):
    """Keeps the maps of a growing trace up to date, by a search at some steps.

    `problem` has the steps so far, and the theory, in which no field is "auto". `before` is the
    keeper of fewer steps that this one replaces; None for the first.
    """

    retry = RETRY  # after a search that was stopped, the trace grows by this factor
    _lists_links = False  # whether a map with an untried link is extended in all possible ways

    def __init__(self, problem: Problem, options: StepOptions, before: Keeper | None) -> None:
        self._problem, self._options = problem, options
        self._judging = Judging(problem)
        self.searches: int = before.searches if before else 0  # by clingo, so far
        self._next_search = 0  # no search before the trace has this many steps
        self._spent = 0.0  # seconds that all steps took
        self.maps: list[ExtendedMap] = []  # the maps known, the minimal ones first
        # Whether it is proven that the cheapest maps are minimal, that all minimal maps are listed,
        # and that no map satisfies the axioms.
        self.is_proven = self.is_complete = self.is_impossible = False
        self._least: tuple[int, ...] = ()  # what a minimal map costs, while proven
        # Whether the claim in `mapper.py` holds for the theory, so that maps are replayed.
        self._replays = row("prefixes").holds_for(problem.theory.replace(misread=0, slipped=0))

    def take(self, problem: Problem) -> None:
        """Add the last step: keep the maps that predict it, and drop those that it contradicts.

        Further minimal maps may exist if a minimal map has no link for the last action.
        """
        self._problem, was_proven = problem, self.is_proven
        if self.is_impossible and self._replays:
            return
        action, step = problem.trace.steps[-2].action, problem.trace.steps[-1]
        assert action
        if not self._lists_links and any(m.is_unknown(action.name) for m in self.minimal):
            self.is_complete = False
        self._keep(self._follow(action, step))
        if not self._replays:  # the answer for fewer steps says nothing about more steps
            self.maps, self.is_impossible, self._next_search = [], False, 0
        if not self.minimal:
            self.is_proven = self.is_complete = False
            if was_proven or not self._can_wait:
                self._next_search = 0

    def answer(self, began: float) -> Solution:
        """Search the steps so far if that is due, and return what is known.

        `began` is when the step began, by `time.perf_counter`.
        """
        steps = len(self._problem.trace)
        is_complete = self.is_complete or len(self.minimal) == self._options.max_maps
        is_settled = self.is_impossible or (self.is_proven and is_complete)
        if not is_settled and steps >= self._next_search:
            self.searches += 1
            was_stopped = self._ask() in ("work limit", "time limit", "interrupted")
            self._next_search = max(steps + PAUSE, int(self.retry * steps)) if was_stopped else 0
        return self._solution(began)

    def _keep(self, maps: list[ExtendedMap]) -> None:
        """Keep maps, the cheapest first. At most `max_maps` of the cheapest ones stay."""
        most, ties = self._options.max_maps, sum(m.cost == maps[0].cost for m in maps)
        if most and ties > most:
            maps, self.is_complete = maps[:most] + maps[ties:], False
        self.maps = maps

    def _prove(self, found: Solution, maps: Sequence[ExtendedMap]) -> None:
        """Record what a search for the maps of all steps proves. These are its maps."""
        if found.status is Status.UNSATISFIABLE:
            self.is_impossible, self.is_complete = True, found.complete
        elif found.status is Status.OPTIMAL and maps:
            self.is_proven, self.is_complete, self._least = True, found.complete, maps[0].cost

    @property
    def _can_wait(self) -> bool:
        """Whether the next search can wait though no map is proven."""
        return True

    @property
    def minimal(self) -> list[ExtendedMap]:
        """The maps that are proven minimal; empty without a proof."""
        return [m for m in self.maps if m.cost == self._least] if self.is_proven else []

    @property
    def _status(self) -> Status:
        """How much is proven about the maps."""
        if self.is_impossible:
            return Status.UNSATISFIABLE
        if self.is_proven:
            return Status.OPTIMAL
        return Status.FEASIBLE if self.maps else Status.UNKNOWN

    @abstractmethod
    def _follow(self, action: Action, step: Step) -> list[ExtendedMap]:
        """Follow all maps along the last step, and the action before it."""

    @abstractmethod
    def _ask(self) -> Stop | None:
        """Search for minimal maps, keep them, and return why the search ended early."""

    @abstractmethod
    def _solution(self, began: float) -> Solution:
        """The solution so far: the minimal maps, else the best map known, else none."""

    def _judge(self, maps: Sequence[SSHMap], began: float) -> None:
        """Let the checker check the first map, unless that takes too long."""
        trace = self._problem.trace
        self._spent += time.perf_counter() - began
        if maps and self._judging.has_time_for(len(trace), self._spent):
            self._judging.pass_grown_map(trace, maps[0])


class MapKeeper(Keeper):
    """Keeps the minimal maps up to date, or the best map that is found in time.

    The theory of `problem` allows no faults.
    """

    standing = None  # only `Recovery`, for theories with faults, has a standing

    def __init__(
        self, problem: Problem, options: StepOptions, before: MapKeeper | None = None
    ) -> None:
        super().__init__(problem, options, before)
        self._cost: Cost | None = None  # the counts of a minimal map; None if they are unknown
        # Drafts (see the head of this module), the best first. They need not be consistent.
        self._drafts: list[Sketch] = []
        # The last search, which the next one continues; None before the first.
        self.search: Search | None = None
        self._found: Solution | None = None  # the solution of this search, without its maps

    def restarted(self, problem: Problem) -> MapKeeper:
        """Make a keeper for the theory of `problem`, which changed with the last step.

        The minimal maps so far need not be minimal by the new theory. They become drafts
        (maps to be extended step by step) if the old theory already used displacements.
        """
        keeper = MapKeeper(problem, self._options, before=self)
        if self._problem.theory.displacement == "use":
            known = [m.explained() for m in self.maps[:DRAFTS]]
            for ssh_map in (*known, *(draft.map() for draft in self._drafts)):
                keeper._add_draft(ssh_map)
        return keeper

    @property
    def _can_wait(self) -> bool:
        return bool(self._drafts)

    def _follow(self, action: Action, step: Step) -> list[ExtendedMap]:
        """Keep the maps that predict the last step. If none does, those without a link are drafts.

        A map without a link for the action may be extended to further minimal maps.
        """
        trace, pairs = self._problem.trace, self._problem.pairs
        seen = observation(step, self._problem.theory)
        untried = [m for m in self.maps if m.is_unknown(action.name)]
        longer = (m.predicting(action.name, seen) for m in self.maps if self._replays)
        maps = [m for m in longer if m and m.is_allowed(trace, pairs, self._judging)]
        self._drafts = [draft for draft in self._drafts if draft.extend(action, step)]
        for rival in untried[:DRAFTS] if not maps else ():
            self._add_draft(rival.explained())
        return maps

    def _ask(self) -> Stop | None:
        """Search for minimal maps with clingo and keep them.

        If a minimal map is known, only the others are searched for. Known minimal maps stay if the
        search listed fewer. If maps are replayed, maps without a proof do not replace the known
        ones. The best of them becomes a draft, which later steps extend.
        """
        trace, theory, options = self._problem.trace, self._problem.theory, self._options
        before = self.search.parts if self.search else None
        minimal = self.maps[0].explained() if self.is_proven else None
        search = Search(
            trace,
            theory,
            time_limit=options.time_limit,
            work_limit=options.work_limit,
            max_maps=options.max_maps,
            speedups=options.speedups,
            _start=Start(after=before, minimal=minimal),
        )
        # The maps are not ranked, as ranking takes longer than a step may.
        found = tuple(search.unranked())
        said = search.solution()
        self.search, self._found = search, said
        if said.status in (Status.OPTIMAL, Status.UNSATISFIABLE) or not self._replays:
            if len(found) >= len(self.maps) or not self.is_proven:
                self._keep([ExtendedMap.of(m, trace, theory) for m in found])
            self._prove(said, self.maps)
            self._cost = said.cost
            self._drafts = []
        elif found:
            self._add_draft(found[0])
        return search.stopped

    def _solution(self, began: float) -> Solution:
        asked = self._found
        assert asked is not None
        problem, steps = self._problem, len(self._problem.trace)
        status, cost = self._status, self._cost
        maps = tuple(m.explained() for m in self.maps)
        if status is Status.UNKNOWN and (best := self._best_draft()):
            maps, status, cost = (best,), Status.FEASIBLE, Cost.of(best)
        self._judge(maps, began)
        searched = asked.seconds if asked.steps == steps else Seconds(0.0, 0.0, 0.0)
        refused = {name: said["refused"] for name, said in asked.effort.evidence.items()}
        return Solution(
            status=status,
            maps=maps,
            cost=cost if maps else None,
            bound=asked.bound,
            complete=self.is_complete,
            theory=problem.theory,
            steps=steps,
            effort=Effort(
                prefix=asked.effort.prefix,
                seconds=replace(searched, total=time.perf_counter() - began),
                evidence=said_by(problem.evidence, problem.trace, problem.theory, refused),
            ),
            stopped=None if self.is_complete else asked.stopped,
            support=asked.support,
        )

    def _add_draft(self, ssh_map: SSHMap) -> None:
        """Extend a map of the first steps to a draft of all steps, unless a step contradicts it."""
        trace, theory = self._problem.trace, self._problem.theory
        if not self._replays or unchecked(theory):
            return
        known = len(ssh_map.dstate_at)
        sketch = sketch_beyond(ssh_map, trace.prefix(known), theory)
        later = zip(trace.actions[known - 1 :], trace.steps[known:], strict=True)
        if all(sketch.extend(action, step) for action, step in later):
            drafts = [*self._drafts, sketch]
            drafts.sort(key=lambda draft: Cost.of(draft.map()).preferred_by(theory))
            self._drafts = drafts[:DRAFTS]

    def _best_draft(self) -> SSHMap | None:
        """Return the map of the best consistent draft, and drop the inconsistent ones before it."""
        judging = Judging(self._problem)
        while self._drafts:
            ssh_map = self._drafts[0].map()
            if judging.accepts(ssh_map):
                return ssh_map
            del self._drafts[0]
        return None


@dataclass(frozen=True, slots=True)
class ExtendedMap:
    """A rival: a map of all steps so far, and how it was extended.

    When a new step comes, a map that predicts it is extended in one way. If the theory allows
    faults, any other map is extended in each of these ways:

        contradicted  The observation is misread, and the robot is where the link leads. Or the
                      action slipped, and the robot is at one of the dstates that look like this,
                      or at a new dstate.
        unknown       A new link leads to one of the dstates that look like this, or to a new
                      dstate.

    New links and new dstates are for the causal theory alone. In a theory with places and paths,
    only the axioms say where a new link may lead.
    """

    map: SSHMap  # the map that the solver found, of the first steps or of all
    labels: tuple[int, ...]  # the dstate of each step so far
    shows: tuple[Seen, ...]  # the view and star of each dstate
    # For each dstate and name of an action, the dstate that the action leads to.
    links: Mapping[tuple[int, str], int]
    faults: tuple[Fault, ...]  # the observations and actions that are treated as wrong
    # The counts that the theory minimises, the most important first. Dstates, with the price of
    # faults, count in tenths.
    cost: tuple[int, ...]

    @classmethod
    def of(cls, ssh_map: SSHMap, trace: Trace, theory: Theory) -> ExtendedMap:
        """Make the hypothesis that a map of the trace, or of its first steps, is true."""
        wrong = {fault.step for fault in ssh_map.faults if fault.kind != "slipped"}
        first = firsts((s, t) for t, s in enumerate(ssh_map.dstate_at) if t not in wrong)
        shows = tuple(
            observation(trace.steps[first[s.id]], theory) if s.id in first else (s.view, None)
            for s in ssh_map.dstates
        )
        links = {(s, action): x for s, action, x in ssh_map.links}
        cost = Cost.of(ssh_map).preferred_by(theory)
        return cls(ssh_map, ssh_map.dstate_at, shows, links, ssh_map.faults, cost)

    @property
    def here(self) -> int:
        """The id of the dstate where the robot is after the last step."""
        return self.labels[-1]

    @property
    def places(self) -> list[int | None]:
        """The place of each dstate; None for a dstate without a place."""
        known = self.map.dstates
        return [s.place for s in known] + [None] * (len(self.shows) - len(known))

    def explained(self) -> SSHMap:
        """Make the map of all steps so far, with its faults."""
        if len(self.map.dstate_at) == len(self.labels):
            return self.map
        known = self.map.dstates
        new = (DState(s, self.shows[s][0]) for s in range(len(known), len(self.shows)))  # type: ignore[arg-type]
        links = self.map.links
        if len(links) < len(self.links):
            links = tuple(sorted((s, action, x) for (s, action), x in self.links.items()))
        faults = tuple(sorted(self.faults, key=lambda fault: (fault.step, fault.kind)))
        labels, dstates = self.labels, (*known, *new)
        return replace(
            self.map, dstate_at=labels, dstates=dstates, links=links, faults=faults, fit=None
        )

    def contradiction(self, action: str, seen: Seen) -> int | None:
        """Return the dstate that an action leads to, if it shows something else than `seen`.

        None if it shows that, or if the map has no link for the action.
        """
        there = self.links.get((self.here, action))
        return None if there is None or self.shows[there] == seen else there

    def predicting(self, action: str, seen: Seen) -> ExtendedMap | None:
        """Extend this map by a step that it predicts; None if it does not predict the step."""
        there = self.links.get((self.here, action))
        return None if there is None or self.shows[there] != seen else self._to(there)

    def is_allowed(self, trace: Trace, pairs: Pairs, judging: Judging) -> bool:
        """Whether the evidence allows the last step of a trace, as it allowed the earlier ones."""
        t = len(trace) - 1
        return pairs.allow(t, self.labels, self.places) and judging.allows_grown(
            trace, self.explained(), t
        )

    def is_unknown(self, action: str) -> bool:
        """Whether the map has no link for an action at the dstate where the robot is."""
        return (self.here, action) not in self.links

    def future(self) -> tuple[object, ...]:
        """Summarise what the map predicts from here on, as a value that can be compared.

        Two maps have equal values if they have the same dstates, the same links, and the robot at
        the same dstate, up to renaming. The past does not count. For dstates that cannot be
        reached from here, only their number counts.
        """
        ends = gathered((s, (action, x)) for (s, action), x in self.links.items())
        # Number the dstates in the order in which a breadth-first search from here reaches them.
        number, reached = {self.here: 0}, [self.here]
        links = []
        for s in reached:
            for action, x in sorted(ends.get(s, [])):
                if x not in number:
                    number[x] = len(reached)
                    reached.append(x)
                links.append((number[s], action, number[x]))
        return tuple(self.shows[s] for s in reached), tuple(links), len(self.shows)

    def ways_on(self, action: str, step: Step, seen: Seen, theory: Theory) -> Iterator[ExtendedMap]:
        """Yield the extensions of this rival by one step. Those without extra cost come first.

        `action` is the name of the action before the step. In the theory no field is "auto".
        """
        t, there = len(self.labels), self.links.get((self.here, action))
        alike = [s for s, shown in enumerate(self.shows) if shown == seen]
        is_causal = theory.level == "causal"
        if there is None:
            if is_causal:
                for s in alike:
                    yield self._to(s, link=action)
                yield self._to(len(self.shows), link=action, new=seen)
            return
        if longer := self.predicting(action, seen):
            yield longer
            return
        if theory.misread:
            view, star = self.shows[there]
            tenths = theory.fault_tenths("misread", step)
            doubted = []
            if view != seen[0]:
                doubted += [Fault(t, "misread", step.view, view, tenths / 10)]  # type: ignore[arg-type]
            if star != seen[1]:
                doubted += [Fault(t, "misseen", cost=tenths / 10)]
            yield self._to(there, faults=doubted, tenths=tenths * len(doubted))
        if theory.slipped:
            tenths = theory.fault_tenths("slipped", step)
            slipped = [Fault(t - 1, "slipped", action, cost=tenths / 10)]
            for s in alike:
                yield self._to(s, faults=slipped, tenths=tenths)
            if is_causal:
                yield self._to(len(self.shows), new=seen, faults=slipped, tenths=tenths)

    def _to(
        self,
        there: int,
        *,
        link: str | None = None,
        new: Seen | None = None,
        faults: Sequence[Fault] = (),
        tenths: int = 0,
    ) -> ExtendedMap:
        """Extend this rival by a step at the dstate `there`.

        `link` names the action if the step adds a link. `new` is the view and star of a new dstate.
        `tenths` is the cost of the faults that the step adds; 10 is the cost of one dstate.
        """
        tenths += DSTATE if new else 0
        return ExtendedMap(
            self.map,
            (*self.labels, there),
            (*self.shows, new) if new else self.shows,
            {**self.links, (self.here, link): there} if link else self.links,
            (*self.faults, *faults),
            (self.cost[0] + tenths, *self.cost[1:]) if tenths else self.cost,
        )
