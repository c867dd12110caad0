"""Solve a prefix of the trace, replay its maps to the end, and extend the prefix if a replay fails.

Grounding the axioms for n steps takes more than n² time. But once the robot has seen everything,
the rest of the trace only repeats links that the map has. So a search solves a *prefix*, the first
steps of the trace. Then it replays each map that it finds: it follows the links of the map along
the rest of the trace (`steps/log.py`). If a replay stops early, the prefix is extended in the same
clingo control. The result is exact.

*Claim.* Let c be the cost of the minimal maps of a prefix, and let all of these maps replay to the
end of the trace. Then the replayed maps are exactly the minimal maps of the trace, and c is their
cost.

*Proof.* (1) A map of the trace that is cut down to the prefix is a map of the prefix. Every axiom
forbids a pattern of links, observations and names, and a cut only removes patterns. Some axioms
demand a course, an order, a side or a heading: the cut map has the same as the whole map. If only a
later travel supports a course, the cut drops both. A cut adds no dstate, place, path or excuse, so
no count grows. So the minimum of the prefix is a lower bound on the minimum of the trace.
(2) A map that replays to the end has the same links and observations over the whole trace as over
the prefix. The axioms read nothing else, so the replayed map satisfies them, and it costs c. By
(1), c is the minimum.
(3) Let F be a minimal map of the trace. By (2) it costs c. The cut of F costs at most c in every
count, and by (1) no less than c in the order of preference. So the cut is one of the minimal maps
of the prefix; call it R. Actions are deterministic, and the replay of R meets only links of R. So F
has the same labels and links as the replayed R, and the same travels support its courses: F is the
replayed R. Two different minimal maps of the prefix differ in the prefix, so they replay to
different maps. ∎

*Names for paths.* The size of the grounding grows with the square of the number of names for paths.
Most traces have far more segments than their maps have paths, so a control begins with a few names.
Its minimum is right if no map with more paths can be as good. If the theory minimises paths first,
this holds as soon as there is a map. If it minimises dstates first, this holds if there are at
least half as many names as the minimal map has dstates: each path has the two ends of a travel, and
no dstate is along two paths. (Without the axiom course_needs_travel, a path may have a single
dstate. Then there must be as many names as dstates.) Otherwise the search makes a new control with
more names. One name for each segment of the prefix is enough for any map.

A map whose replay stops early is no answer. A longer prefix shows how it continues. The claim needs
determinism; one place, course and heading for each dstate; and axioms that a cut map still
satisfies. `theory/speedups.py` lists the theories for which this is known. For any other theory,
the prefix is the whole trace.

*Backbone.* A search lists at most as many minimal maps as the user asks for. Other minimal maps may
not share what the listed ones share. So the search goes on to list maps, but gives them to nobody.
When there are no more, the backbone is proven: what all minimal maps share.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from contextlib import suppress
from dataclasses import replace

from ssh_abduction.data.gateways import with_allowed_headings
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.runtime.limits import LimitError, StageTimeError
from ssh_abduction.runtime.loggers import log_of
from ssh_abduction.solution.sharing import Backbone, Sharing
from ssh_abduction.solution.values import Found, Status
from ssh_abduction.solver.asp import facts
from ssh_abduction.solver.board import Judging, Known
from ssh_abduction.solver.sources.exact.engine import Engine, Task
from ssh_abduction.solver.sources.exact.readable import StepEngine, paths_needed
from ssh_abduction.theory.evidence import Equality

_log = log_of(__name__)

FIRST_PREFIX = 8  # steps of the first prefix; clingo solves it at once
# Without these axioms a dstate may be at several places or along several courses, but a map shows
# only one.
SHOWN_ONCE = frozenset({"one_place", "one_course"})
# The number of names for paths to begin with. Few traces need more.
FIRST_PATHS = 8


class Prefixes:
    """Finds the minimal cost and lists the minimal maps by growing prefixes.

    Attributes:
        engine: The engine, which has the axioms for the prefix.
        start: The number of steps of the first prefix.
    """

    def __init__(
        self,
        task: Task,
        known: Known,
        judging: Judging,
        engine: Engine,
        most: int,
        report: Callable[[], None],
    ) -> None:
        """Prepare the search for `most` maps (0: all). `find_minimum` begins it."""
        self.engine = engine
        self._task, self._known, self._judging, self._most = task, known, judging, most
        self._report = report
        self._at_once = not task.speedups.prefixes
        self._in_tolerance = task.theory.star == "gateways"
        self.start = len(task.trace) if self._at_once else FIRST_PREFIX

    def find_minimum(self) -> None:
        """Extend the prefix until it has no map, or a minimal map that predicts all later steps."""
        size, steps = min(len(self._task.trace), self.start), len(self._task.trace)
        while True:
            _log.debug("%s is given %d of %d steps", type(self.engine).__name__, size, steps)
            self.engine.grow(size)
            minimal = self.minimise()
            if minimal is None:
                self._known.status = Status.UNSATISFIABLE
                return
            self._known.raise_lower(minimal.cost)
            replayed = self._replay(minimal.map)
            _log.debug(
                "its minimal cost is %s; its map explains %d steps", minimal.cost, len(replayed)
            )
            if self._predicts_all(minimal, replayed):
                self._known.keep(replace(minimal, map=self._whole(minimal.map, replayed)), replayed)
            # If the best map of the whole trace is as cheap as this minimal map, it is minimal.
            if self._known.best is not None and self._known.cost <= minimal.cost:
                self._known.status = Status.OPTIMAL
                return
            size = self.engine.next_size(len(replayed))

    def minimise(self) -> Found | None:
        """Find a minimal map of the prefix (first steps) that no evidence rejects, or None."""
        while (found := self._minimise_known()) is not None:
            if (refusal := self._judging.refusal(found.map)) is None:
                return found
            name, equalities = refusal
            _log.debug("%s refuses a map, for %d equalities", name, len(equalities))
            self._known.refused[name] = self._known.refused.get(name, 0) + 1
            self._forbid(equalities)
        return None

    def _forbid(self, equalities: frozenset[Equality]) -> None:
        """Forbid all maps with all these equalities, with a `StepEngine` if this engine cannot."""
        if self._forbid_in_engine(equalities):
            return
        _log.debug(
            "%s cannot forbid these maps, so the readable encodings go on",
            type(self.engine).__name__,
        )
        size, theory = self.engine.size, self._task.theory
        self.engine = StepEngine(
            self._task, facts.most_paths(self._task.trace, theory, len(self._task.trace))
        )
        self.engine.grow(size)
        self.engine.forbid(equalities)

    def _forbid_in_engine(self, equalities: frozenset[Equality]) -> bool:
        """Let the present engine forbid all maps with all of these equalities, if it can do so."""
        can_forbid = isinstance(self.engine, StepEngine) or all(
            equality.holds for equality in equalities
        )
        return can_forbid and self.engine.forbid(equalities)

    def _minimise_known(self) -> Found | None:
        """Find a minimal map under the rules that the engine has; None if there is none."""
        while True:
            minimal = None
            for found in self.engine.improving_maps(
                self._known.cost if self._known.best and not self._at_once else ()
            ):
                minimal = found
                self._known.partial = found.map
                replayed = self._replay(found.map)
                if self._known.is_better(found) and self._predicts_all(found, replayed):
                    self._known.keep(replace(found, map=self._whole(found.map, replayed)), replayed)
                self._report()
                if (
                    not self._at_once
                    and self._known.lower is not None
                    and found.cost <= self._known.lower
                ):
                    break
            if not self._name_more_paths(minimal.cost if minimal else None):
                return minimal

    def _predicts_all(self, found: Found, replayed: tuple[int, ...]) -> bool:
        """Whether a map of the prefix replays to the end, and no evidence rejects the whole map."""
        is_whole = len(replayed) == len(self._task.trace)
        return is_whole and not self._judging.why_refused(self._whole(found.map, replayed))

    def _name_more_paths(self, cost: tuple[int, ...] | None) -> bool:
        """Begin again with more names for paths, if the proof of this cost needs them."""
        if not isinstance(self.engine, StepEngine):
            return False  # other engines always have enough names for paths
        needed = paths_needed(self._task, self.engine.size, cost)
        if needed <= self.engine.paths:
            return False
        size = self.engine.size
        _log.debug("%d names for paths are needed, not %d", needed, self.engine.paths)
        self.engine = self.engine.with_paths(needed)
        self.engine.grow(size)
        return True

    def minimal_maps(self) -> Iterator[SSHMap]:
        """Yield every minimal map once, after `find_minimum` has proven the minimal cost.

        A map of a prefix that replays to the end at this cost is minimal, so it is yielded at once.
        """
        given = set[int]()  # hashes of maps, for maps that a longer prefix shows again
        self._name_more_paths(self._known.cost)
        while stuck := (yield from self._maps_of_prefix(given)):
            self.engine.grow(self.engine.next_size(stuck))
            self._name_more_paths(self._known.cost)

    def _maps_of_prefix(self, given: set[int]) -> Generator[SSHMap, None, int]:
        """Yield the minimal maps of this prefix, until one does not replay to the end.

        Returns the step at which its replay fails; 0 if all minimal maps replay to the end. Maps in
        `given` are left out, and maps that a later list may show again are added to it.
        """
        asked = self._most and self._most + 1
        is_listed_once = (
            not asked and not self._judging.may_refuse and self.engine.size == len(self._task.trace)
        )
        can_forbid = True
        while True:
            came, refusal = 0, None
            for found in self.engine.maps_of_cost(self._known.cost, asked):
                came += 1
                replayed = self._replay(found.map)
                if len(replayed) < len(self._task.trace):
                    return len(replayed)
                whole = self._whole(found.map, replayed)
                key = hash(whole)
                if key in given:
                    continue
                # Leave out maps that evidence rejects. If the engine can forbid them, list anew.
                if self._judging.why_refused(whole):
                    refusal = self._judging.why_refused(found.map) if can_forbid else None
                    if refusal:
                        break
                    continue
                if not is_listed_once:
                    given.add(key)
                yield whole
            if refusal:
                can_forbid = self._forbid_in_engine(refusal)
            elif asked and came >= asked:
                # Clingo stopped at the number of maps asked for, and some of these were left out.
                asked *= 2
            else:
                return 0

    def _replay(self, ssh_map: SSHMap) -> tuple[int, ...]:
        """Replay the trace over a map of a prefix. Return the dstates of the steps it explains.

        If stars (the openings seen at a step) need to agree only within their spread, also find out
        at the end whether the stars of all steps fit the map.
        """
        log, trace, prefix = self._task.log, self._task.trace, ssh_map.dstate_at
        replayed = log.replay(prefix, [s.place for s in ssh_map.dstates] if log.pairs else None)
        if self._in_tolerance and len(prefix) < len(replayed) == len(trace):
            whole = replace(ssh_map, dstate_at=replayed)
            if with_allowed_headings(trace, whole, self._task.theory.axioms) is None:
                return prefix
        return replayed

    def _whole(self, ssh_map: SSHMap, replayed: tuple[int, ...]) -> SSHMap:
        """Extend a map of a prefix to all steps that a replay explains.

        If stars need to agree only within their spread, give the map headings that all stars allow.
        """
        whole = replace(ssh_map, dstate_at=replayed)
        if not self._in_tolerance or len(ssh_map.dstate_at) == len(replayed):
            return whole
        return with_allowed_headings(self._task.trace, whole, self._task.theory.axioms) or whole


class Rivals:
    """The minimal maps of a trace that a search has found so far.

    Attributes:
        sharing: What these maps share.
        listed: Whether they are all minimal maps of the trace.
        engine: The engine that found the maps. None if no proof is needed, or if an error left the
            engine unusable.
        reasons: Whether engines can prove what all minimal maps share. They cannot if the maps
            were found by mending the trace.
    """

    def __init__(self, task: Task, judging: Judging) -> None:
        """Start without any known map."""
        self.sharing = Sharing()
        self.listed = False
        self.engine: Engine | None = None
        self.reasons = True
        self._task, self._judging = task, judging
        self._cost: tuple[int, ...] = ()
        self._proven = False

    def add(self, ssh_map: SSHMap, cost: tuple[int, ...]) -> None:
        """Add a minimal map, with the counts that the theory minimises."""
        self._cost = cost
        self.sharing.absorb(ssh_map)

    def reason(self) -> None:
        """Prove what all minimal maps share, unless all are listed. A limit ends the proof."""
        is_known = self.listed or self._proven or not self.sharing.maps
        if is_known or not self.reasons or self.engine is None:
            return
        _log.info("looking for what all minimal maps share, from %d of them", self.sharing.maps)
        with suppress(LimitError, StageTimeError, KeyboardInterrupt):
            self._proven = prove_backbone(
                self._task, self._judging, self._cost, self.sharing, self.engine
            )
        _log.info("what all minimal maps share is %s", "proven" if self._proven else "not proven")
        self.engine = None

    @property
    def backbone(self) -> Backbone | None:
        """The backbone as far as it is known; None if no minimal map is known."""
        return (
            self.sharing.backbone(proven=self.listed or self._proven) if self.sharing.maps else None
        )


def prove_backbone(
    task: Task, judging: Judging, cost: tuple[int, ...], sharing: Sharing, engine: Engine
) -> bool:
    """Find more minimal maps until `sharing` holds exactly what all minimal maps share.

    Each minimal map is added to `sharing`. `cost` has the preferred counts of minimal maps, the
    most important one first. The engine has the prefix that proved the minimum. Returns whether the
    proof is complete. No proof is possible if the theory allows a dstate at several places or along
    several courses. Raises LimitError if a limit is reached.
    """
    if SHOWN_ONCE & task.theory.given_up:
        return False
    known = Known(task.theory)
    known.cost = cost
    for ssh_map in Prefixes(task, known, judging, engine, 0, lambda: None).minimal_maps():
        sharing.absorb(ssh_map)
    return True
