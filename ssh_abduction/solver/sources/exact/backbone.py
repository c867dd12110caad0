"""Find the backbone of a trace: what all its minimal maps share. Not all maps have to be listed.

Some minimal maps are known. Other minimal maps may not share what the known ones share. Two steps
may be one dstate in all known maps, but not in some unknown minimal map, or the other way round.
Each such possibility is a *doubt*. Clingo looks for a minimal map in which at least one doubt is
true. If there is such a map, it becomes known, and fewer doubts are left. If there is none, the
backbone is proven. This combines brave and cautious reasoning. Each answer is a map that can be
checked.

*Prefixes.* Clingo looks for maps of a prefix that cost at most as much as minimal maps of the
trace. Each minimal map, cut to the prefix, is such a map (`prefixes.py`). So a found map that
replays to the end of the trace is minimal. If a found map does not replay to the end, the prefix
grows. Steps that are one dstate in all known maps form a *class*. If no doubt about the prefix is
left, the steps of each class are one dstate in all minimal maps. Actions are deterministic, so the
classes replay like a map. Suppose that they replay to the end. Then in every minimal map each later
step is one dstate with a class of the prefix. So no doubt about later steps is left. Otherwise the
prefix grows.

*Labels.* An engine that finds dstates before places and paths lists all minimal maps. Then there
are no doubts.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import combinations

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.runtime.loggers import log_of
from ssh_abduction.solver.asp.limits import LimitError, StageTimeError
from ssh_abduction.solver.board import Judging, Known
from ssh_abduction.solver.solution.sharing import Backbone, Sharing
from ssh_abduction.solver.sources.exact.engine import Engine, Task
from ssh_abduction.solver.sources.exact.prefixes import Prefixes
from ssh_abduction.solver.sources.exact.readable import Doubt, StepEngine, paths_needed
from ssh_abduction.solver.steps.log import Outcome, Replay

_log = log_of(__name__)

# Without these axioms a dstate may be at several places or along several courses, but a map shows
# only one.
SHOWN_ONCE = frozenset({"one_place", "one_course"})


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
        if self.listed or self._proven or not self.reasons or not self.sharing.maps:
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
    task: Task,
    judging: Judging,
    cost: tuple[int, ...],
    sharing: Sharing,
    engine: Engine | None = None,
) -> bool:
    """Find more minimal maps until `sharing` holds exactly what all minimal maps share.

    At least one minimal map is known, and each new one is added to `sharing`. `cost` has the
    preferred counts of minimal maps, the most important one first. The engine is the one that
    proved the minimum; None if it is no longer available. Returns whether the proof is complete. No
    proof is possible if the theory allows a dstate at several places or along several courses.
    Raises LimitError if a limit is reached.
    """
    if SHOWN_ONCE & task.theory.given_up:
        return False
    if engine is None or isinstance(engine, StepEngine) or task.theory.level == "causal":
        _Reasoning(task, judging, cost, sharing).settle_steps()
        return True
    known = Known(task.theory)
    known.cost = cost
    for ssh_map in Prefixes(task, known, judging, engine, 0, lambda: None).minimal_maps():
        sharing.absorb(ssh_map)
    return True


class _Reasoning:
    """Finds minimal maps that differ from what all known minimal maps share."""

    def __init__(
        self, task: Task, judging: Judging, cost: tuple[int, ...], sharing: Sharing
    ) -> None:
        self._task, self._judging, self._cost, self._sharing = task, judging, cost, sharing

    def settle_steps(self) -> None:
        """Resolve all doubts with the readable encodings (`encodings/*.lp`)."""
        # A minimal map that is cut to a prefix does not have more paths than before.
        counts = dict(zip(self._task.theory.priorities, self._cost, strict=True))
        names = (
            counts["paths"]
            if "paths" in counts
            else paths_needed(self._task, len(self._task.trace), self._cost)
        )
        engine = StepEngine(self._task, names)
        size = self._first_size()
        while size:
            size = self._settle_prefix(engine, size)

    def _first_size(self) -> int:
        """Return the length of the shortest prefix that determines the classes of later steps."""
        classes, actions = self._sharing.classes, self._task.log.actions
        if not self._task.speedups.prefixes:
            return len(classes)
        links = set[tuple[int, int]]()
        size = 1
        for t, action in enumerate(actions):
            if (classes[t], action) not in links:
                links.add((classes[t], action))
                size = t + 2
        return size

    def _settle_prefix(self, engine: StepEngine, size: int) -> int:
        """Resolve the doubts about the first `size` steps. Return the next size; 0 at the end."""
        engine.grow(size)
        while (found := engine.map_with(list(self._doubts(size)), self._cost)) is not None:
            replayed = self._replay(found)
            whole = replace(found, dstate_at=replayed.labels)
            if equalities := self._judging.why_refused(found) or self._judging.why_refused(whole):
                last = max(max(equality.first, equality.second) for equality in equalities)
                if last >= size:
                    return engine.next_size(last)
                engine.forbid(equalities)
            elif replayed.outcome is not Outcome.PREDICTED:
                return engine.next_size(len(replayed.labels))
            else:
                self._sharing.absorb(whole)
        replayed = self._task.log.replay(self._sharing.classes[:size])
        return (
            0 if replayed.outcome is Outcome.PREDICTED else engine.next_size(len(replayed.labels))
        )

    def _replay(self, found: SSHMap) -> Replay:
        """Replay the trace over a map of a prefix: follow the links of the map to the end."""
        return self._task.log.replay(
            found.dstate_at,
            None,
            [s.place for s in found.dstates] if self._task.log.pairs else None,
        )

    def _doubts(self, size: int) -> Iterator[Doubt]:
        """Yield the doubts (possible differences of minimal maps) about the first `size` steps."""
        firsts = self._sharing.firsts()
        yield from (
            ("dstates", firsts[self._sharing.classes[t]], t, False) for t in self._entering(size)
        )
        yield from self._doubts_of_classes(size)

    def _doubts_of_classes(self, size: int) -> Iterator[Doubt]:
        """Yield the doubts about classes of steps. Each class is given by its first step."""
        sharing = self._sharing
        firsts = [t for t in sharing.firsts() if t < size]
        for sort in sharing.sorts():
            known = sharing.kept(sort)
            heads: dict[int, int] = {}  # the first class of each group that all known maps share
            for c in range(len(firsts)):
                head = heads.setdefault(known.always[c], c)
                if head != c:
                    yield sort, firsts[head], firsts[c], False
                # If the class is along a path in all known maps, or in none, other maps may differ.
                if sort == "paths" and ((c, c) in known.together) != (c in known.unnamed):
                    yield sort, firsts[c], firsts[c], c in known.unnamed
            for c, d in combinations(heads.values(), 2):
                if (c, d) not in known.together and (
                    sort != "dstates" or self._may_be_one(firsts[c], firsts[d])
                ):
                    yield sort, firsts[c], firsts[d], True

    def _may_be_one(self, i: int, j: int) -> bool:
        """Whether the views of two steps allow that these are one dstate."""
        steps = self._task.trace.steps
        return (
            None in (views := {steps[i].view, steps[j].view})
            or len(views) == 1
            or "functional_view" not in self._task.theory.hard
        )

    def _entering(self, size: int) -> Iterator[int]:
        """Yield the steps of the prefix at which a new link leads back to a known class.

        If an earlier step reached the class by the same action from the same class, determinism
        already proves that both steps are one dstate.
        """
        classes, actions = self._sharing.classes, self._task.log.actions
        seen, links = {classes[0]}, set[tuple[int, int]]()
        deterministic = "deterministic" in self._task.theory.hard
        for t in range(1, size):
            link = classes[t - 1], actions[t - 1]
            if classes[t] in seen and not (deterministic and link in links):
                yield t
            seen.add(classes[t])
            links.add(link)
