"""Solve for a prefix, replay its maps to the end of the trace, and extend the prefix if they fail.

Grounding the axioms for a whole trace costs more than the square of its length. But once a map is
closed, the rest of the trace only re-traverses it. So a search solves for a prefix, replays the
maps found over the whole trace (`steps/log.py`), and extends the prefix, in the same clingo
control, while a replay stops early. This is exact.

*Claim.* Let every minimal map of a prefix, of cost c, replay to the end of the trace. Then the
replayed maps are exactly the minimal maps of the trace, and c is their cost.

*Proof.* (1) A map of the trace, cut down to the prefix, is a map of the prefix. Every axiom forbids
a pattern of links, observations and names, and a cut removes patterns. What the axioms ask for (a
course, an order, a side, a heading), the map of the trace has. A course that only a later travel
supports is dropped together with that travel. Cutting adds no dstate, place, path or excuse, so no
count grows. The minimum of the prefix therefore bounds that of the trace from below.
(2) A map that replays to the end has the same links and observations over the whole trace as over
the prefix. The axioms speak of nothing else, so the replayed map satisfies them, at cost c. By (1),
c is the minimum.
(3) A minimal map F of the trace has cost c by (2). Cut down to the prefix it costs at most c in
every count, and at least c in the order of preference by (1). So the cut is one of the minimal maps
of the prefix, R. As actions are deterministic and replaying R meets only links of R, F has the
labels of the replayed R, the same links, and so the same support for every course: F is the
replayed R. Different R replay to different maps, as they differ on the prefix already. ∎

*Names for paths.* Grounding grows with the square of the number of names for paths, and most traces
have far more segments than their maps have paths. So a control starts with a few names. What it
finds minimal stands if no map with more paths can be as good. Where fewest paths come first, this
holds once there is any map. Where fewest dstates come first, it holds once there are half as many
names as dstates in the minimal map: every path holds the two ends of a travel, and a dstate is
along one path (with all_on_paths a path may hold one dstate alone). Otherwise the control is made
again with more names. At most one for each segment of the prefix is enough for any map.

A map whose replay stops early is no answer. The longer prefix says how it continues. The claim
needs determinism, one place, course and heading for each dstate, and axioms that survive the cut.
`theory/speedups.py` lists the theories for which this is known. For any other theory, the prefix is
the whole trace.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from dataclasses import replace

from ssh_abduction.data.gateways import turned
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.runtime.logs import log_of
from ssh_abduction.solver.asp.facts import readable
from ssh_abduction.solver.asp.limits import LAST, LimitError, StageTimeError
from ssh_abduction.solver.engines.base import Engine, Found, Task
from ssh_abduction.solver.engines.refusing import first_accepted
from ssh_abduction.solver.engines.stepwise import StepEngine, paths_needed
from ssh_abduction.solver.judging import Judging
from ssh_abduction.solver.known import Known
from ssh_abduction.solver.steps.log import Outcome, Replay
from ssh_abduction.solver.values import Status
from ssh_abduction.theory.evidence import Equality

_log = log_of(__name__)

FIRST_PREFIX = 8  # steps of the first prefix, which is solved at once
# At most this many maps are held until a prefix proves long enough. Further maps stream, so that
# memory stays constant.
HELD_BACK = 1000
# If all maps are wanted and evidence may reject some, remember at most this many. Up to then,
# forbid each rejected set and list anew. After that, leave out rejected maps one by one.
REMEMBERED = 10_000
# Names for paths to begin with. Few traces need more, and grounding grows with their square.
FIRST_PATHS = 8


class Prefixes:
    """Finds the minimum and lists the minimal maps by growing prefixes.

    Attributes:
        engine: Holds the axioms for the prefix.
        start: The size of the first prefix.
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
        """Nothing is solved yet.

        Args:
            task: The task of the search.
            known: What is known about the trace.
            judging: Checks maps.
            engine: The engine to begin with.
            most: The number of maps that are wanted; 0 for all.
            report: Called now and then.
        """
        self.engine = engine
        self._task, self._known, self._judging, self._most, self._report = (
            task,
            known,
            judging,
            most,
            report,
        )
        self._at_once = not task.speedups.prefixes
        self._in_tolerance = task.theory.star == "gateways"
        self.start = len(task.trace) if self._at_once else FIRST_PREFIX

    def go_on_with(self, engine: Engine, start: int) -> None:
        """Solve with another engine, from a prefix of `start` steps on."""
        self.engine, self.start = engine, start

    def find_minimum(self) -> None:
        """Extend the prefix until a minimal map of it replays to the end, or it has no map.

        Sets the status accordingly.
        """
        size, steps = min(len(self._task.trace), self.start), len(self._task.trace)
        while True:
            if size == steps:
                self._task.watch.use_reserve(LAST)  # the reserve is kept for this search
            _log.debug("%s is given %d of %d steps", type(self.engine).__name__, size, steps)
            self.engine.grow(size)
            minimal = self.minimise()
            if minimal is None:
                self._known.status = Status.UNSATISFIABLE
                return
            self._known.raise_lower(minimal.cost)
            replayed = self._replay(minimal.map)
            _log.debug(
                "its minimal cost is %s; its map explains %d steps",
                minimal.cost,
                len(replayed.labels),
            )
            if self._predicts_all(minimal, replayed):
                self._known.keep(
                    replace(minimal, map=self._whole(minimal.map, replayed)), replayed.labels
                )
            # The best map of the whole trace is as cheap as any map of the prefix.
            if self._known.best is not None and self._known.cost <= minimal.cost:
                self._known.status = Status.OPTIMAL
                return
            size = self.engine.next_size(len(replayed.labels))

    def minimise(self) -> Found | None:
        """A minimal map of the prefix that no evidence rejects; None if it has no map."""

        def why_refused(found: Found) -> frozenset[Equality] | None:
            refusal = self._judging.refusal(found.map)
            if refusal is None:
                return None
            name, equalities = refusal
            _log.debug("%s refuses a map, for %d equalities", name, len(equalities))
            self._known.refused[name] = self._known.refused.get(name, 0) + 1
            return equalities

        return first_accepted(self._minimise_as_told, why_refused, self._forbid)

    def _forbid(self, equalities: frozenset[Equality]) -> None:
        """Forbid all maps with these equalities. Changes the engine if this one cannot do it."""
        if self._tell(equalities):
            return
        _log.debug("%s cannot be told so: the readable encodings go on", type(self.engine).__name__)
        self.engine.settle()
        size, theory = self.engine.size, self._task.theory
        self.engine = StepEngine(
            self._task, readable.most_paths(self._task.trace, theory, len(self._task.trace))
        )
        self.engine.grow(size)
        self.engine.forbid(equalities)

    def _tell(self, equalities: frozenset[Equality]) -> bool:
        """Forbid all maps with these equalities, in this engine. Returns whether it can."""
        can_be_told = isinstance(self.engine, StepEngine) or all(
            equality.holds for equality in equalities
        )
        return can_be_told and self.engine.forbid(equalities)

    def _minimise_as_told(self) -> Found | None:
        """A minimal map of the prefix under clingo's constraints; None if the prefix has none.

        Better maps of the whole trace are kept on the way.
        """
        while True:
            minimal = None
            for found in self.engine.improving_maps(
                self._known.cost if self._known.best and not self._at_once else ()
            ):
                minimal = found
                self._known.partial = found.map
                replayed = self._replay(found.map)
                if self._known.is_better(found) and self._predicts_all(found, replayed):
                    self._known.keep(
                        replace(found, map=self._whole(found.map, replayed)), replayed.labels
                    )
                    self._task.watch.use_reserve()
                self._report()
                if (
                    not self._at_once
                    and self._known.lower is not None
                    and found.cost <= self._known.lower
                ):
                    break
            if not self._name_more_paths(minimal.cost if minimal else None):
                return minimal

    def _predicts_all(self, found: Found, replayed: Replay) -> bool:
        """Whether a map of the prefix is one of the whole trace and no evidence rejects it."""
        whole = replayed.outcome is Outcome.PREDICTED
        return whole and not self._judging.why_refused(self._whole(found.map, replayed))

    def _name_more_paths(self, cost: tuple[int, ...] | None) -> bool:
        """Begin a control with more names for paths, if the minimal cost needs them.

        Returns whether it did.
        """
        needed = paths_needed(self._task, self.engine.size, cost)
        if needed <= self.engine.paths:
            return False
        size = self.engine.size
        _log.debug("%d names for paths are needed, not %d", needed, self.engine.paths)
        self.engine = self.engine.with_paths(needed)
        self.engine.grow(size)
        return True

    def minimal_maps(self) -> Iterator[SSHMap]:
        """List every minimal map once, after the prefix has proven long enough."""
        streamed: list[int] = []  # prefixes whose completely replayed maps were given
        held: list[SSHMap] = []  # maps of this prefix that replay
        try:
            while True:
                held.clear()
                stuck = yield from self._maps_of_prefix(held, streamed)
                if not stuck:
                    break
                self.engine.grow(self.engine.next_size(stuck))
                self._name_more_paths(self._known.cost)
        except (LimitError, StageTimeError):
            yield from held  # they replay at the proven cost: they are minimal
            raise
        yield from held

    def _maps_of_prefix(
        self, held: list[SSHMap], streamed: list[int]
    ) -> Generator[SSHMap, None, int]:
        """Find the minimal maps of this prefix that replay to the end.

        They are held back, or given if they are many or the prefix is the whole trace.

        Returns:
            The farthest step at which a replay fails; 0 if all maps replay and none are missing.
        """
        enough = min(HELD_BACK, self._most + 1) if self._most else HELD_BACK
        asked = self._most and self._most + 1
        streaming = self.engine.size == len(self._task.trace)
        stuck, telling = 0, True
        given = set[SSHMap]()  # or held back, if some maps may be rejected
        while True:
            came, refusal = 0, None
            for found in self.engine.maps_of_cost(self._known.cost, asked):
                came += 1
                replayed = self._replay(found.map)
                if replayed.outcome is not Outcome.PREDICTED:
                    stuck = max(stuck, len(replayed.labels))
                    if not streaming:
                        break
                    continue
                whole = self._whole(found.map, replayed)
                if whole in given or any(
                    self._replay(found.map, size).outcome is Outcome.PREDICTED for size in streamed
                ):
                    continue
                remembers = self._judging.may_refuse and (asked or len(given) < REMEMBERED)
                if self._judging.why_refused(whole):
                    refusal = (
                        self._judging.why_refused(found.map) if telling and remembers else None
                    )
                    if refusal:
                        break
                    continue
                if remembers:
                    given.add(whole)
                if streaming:
                    yield whole
                    continue
                held.append(whole)
                if len(held) == enough:
                    streaming = True
                    yield from held
                    held.clear()
            if refusal:  # list anew; forbid the rejected maps if the engine can
                telling = self._tell(refusal)
                continue
            if stuck or not asked or came < asked:
                break
            # clingo stopped at the number of maps asked for, but evidence rejected some of
            # them: there may be others
            asked *= 2
        if stuck and streaming:
            streamed.append(self.engine.size)
        return stuck

    def _replay(self, ssh_map: SSHMap, known: int | None = None) -> Replay:
        """Replay the trace over a map of a prefix.

        `known` is the number of steps of the prefix that make links. If stars are compared within
        tolerance, those of all steps must agree.
        """
        log = self._task.log
        replayed = log.replay(
            ssh_map.labels, known, [s.place for s in ssh_map.dstates] if log.pairs else None
        )
        replays = replayed.outcome is Outcome.PREDICTED and len(ssh_map.labels) < len(
            replayed.labels
        )
        if (
            self._in_tolerance
            and replays
            and turned(
                self._task.trace,
                replace(ssh_map, labels=replayed.labels),
                self._task.theory.axioms,
            )
            is None
        ):
            return Replay(replayed.labels[: len(ssh_map.labels)], Outcome.CONTRADICTED)
        return replayed

    def _whole(self, ssh_map: SSHMap, replayed: Replay) -> SSHMap:
        """A map of a prefix as a map of all steps that replay over it.

        If stars are compared within tolerance, its headings are those that all stars allow.
        """
        whole = replace(ssh_map, labels=replayed.labels)
        if not self._in_tolerance or len(ssh_map.labels) == len(replayed.labels):
            return whole
        return turned(self._task.trace, whole, self._task.theory.axioms) or whole
