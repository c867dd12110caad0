"""What all minimal maps of a trace share, without listing them.

Some minimal maps are known. What they share may not hold for all. Two steps may be one dstate in
all known maps, but not in some other minimal map, and vice versa. Each such possibility is a doubt.
clingo looks for a minimal map in which any doubt is true. If there is one, it is added, and fewer
doubts are left. If there is none, what is shared is proven. This combines brave and cautious
reasoning. Each answer is a map that can be checked.

*Prefixes.* clingo looks for maps of a prefix that cost at most as much as minimal maps of the
trace. The cuts of minimal maps are among these (`prefixes.py`). So a found map that replays to the
end is minimal. If a found map does not, the prefix grows. If no doubt about the prefix is left, the
classes of steps that are one in all known maps are one in all minimal maps. Actions are
deterministic, so these classes replay like a map. If they replay to the end, each later step is in
the class of a step of the prefix in every minimal map, and no doubt about it is left. Else the
prefix grows.

*Labels.* An engine that finds dstates before places and paths knows all labels of minimal maps.
There are few labels, even for thousands of maps. So dstates are not in doubt. Doubts about places
and paths are resolved for each labelling in turn.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import combinations

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.runtime.logs import log_of
from ssh_abduction.solver.asp.limits import LimitError, StageTimeError
from ssh_abduction.solver.engines.base import Engine, Task
from ssh_abduction.solver.engines.doubts import Doubt, Settled
from ssh_abduction.solver.engines.stepwise import StepEngine, paths_needed
from ssh_abduction.solver.judging import Judging
from ssh_abduction.solver.sharing import Backbone, Sharing
from ssh_abduction.solver.steps.log import Outcome, Replay
from ssh_abduction.theory.evidence import Equality

_log = log_of(__name__)

# Without these axioms a dstate may be at several places or along several courses, but a map shows
# only one.
SHOWN_ONCE = frozenset({"one_place", "one_course"})


class Rivals:
    """The minimal maps of a trace that are known.

    Attributes:
        sharing: What the known maps share.
        listed: Whether there are no other minimal maps.
        engine: The engine that found them.
        reasons: Whether that engine can prove what all minimal maps share.
    """

    def __init__(self, task: Task, judging: Judging) -> None:
        """No minimal map is known yet.

        Args:
            task: The task of the search that lists the maps.
            judging: Knows which maps the evidence rejects.
        """
        self.sharing = Sharing()
        self.listed = False
        self.engine: Engine | None = None
        self.reasons = True
        self._task, self._judging = task, judging
        self._cost: tuple[int, ...] = ()
        self._proven = False

    def add(self, ssh_map: SSHMap, cost: tuple[int, ...]) -> None:
        """Add a minimal map with its preferred counts."""
        self._cost = cost
        self.sharing.absorb(ssh_map)

    def reason(self) -> None:
        """Find out what all minimal maps share, unless all are listed.

        This ends early if a limit is over, or with Ctrl-C.
        """
        if self.listed or self._proven or not self.reasons or not self.sharing.maps:
            return
        _log.info("what all minimal maps share is sought, from %d of them", self.sharing.maps)
        with suppress(LimitError, StageTimeError, KeyboardInterrupt):
            self._proven = prove_backbone(
                self._task, self._judging, self._cost, self.sharing, self.engine
            )
        _log.info("what all minimal maps share is %s", "proven" if self._proven else "not proven")
        self.engine = None

    @property
    def backbone(self) -> Backbone | None:
        """What the known minimal maps share; None if none is known."""
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
    """Find minimal maps until they share only what all minimal maps of the trace share.

    Args:
        task: The task of the search.
        judging: Knows which maps the evidence rejects.
        cost: The preferred counts of minimal maps, the most important one first.
        sharing: What at least one known minimal map shares. New maps are added to it.
        engine: The engine that proved them minimal, if it is still available.

    Returns:
        Whether the sharing is proven. It never is if a dstate may be at several places, or along
        several courses.

    Raises:
        LimitError: A limit of the search is over.
    """
    if SHOWN_ONCE & task.theory.given_up:
        return False
    reasoning = _Reasoning(task, judging, cost, sharing)
    if engine is None or not reasoning.settle_labels(engine):
        reasoning.settle_steps()
    return True


class _Reasoning:
    """Finds minimal maps in which other steps are one than in all known ones."""

    def __init__(
        self, task: Task, judging: Judging, cost: tuple[int, ...], sharing: Sharing
    ) -> None:
        self._task, self._judging, self._cost, self._sharing = task, judging, cost, sharing

    def settle_labels(self, engine: Engine) -> bool:
        """Add maps for each labelling of minimal maps until no doubt is left.

        Returns:
            False if this engine cannot do it.
        """
        forbidden = set[frozenset[Equality]]()
        while (labellings := engine.labellings(self._cost)) is not None:
            failed, refused = 0, None
            for settled in labellings:
                found = settled.any_map()
                while found is not None:
                    replayed = self._replay(found)
                    if replayed.outcome is not Outcome.PREDICTED:
                        failed = len(replayed.labels)
                        break
                    if refused := self._judging.why_refused(replace(found, labels=replayed.labels)):
                        break
                    self._sharing.absorb(replace(found, labels=replayed.labels))
                    found = self._differing_map(settled, replayed.labels)
                if failed or refused:
                    break
            if refused:
                of_prefix = all(
                    max(equality.first, equality.second) < engine.size for equality in refused
                )
                if refused in forbidden or not of_prefix or not engine.forbid(refused):
                    return False
                forbidden.add(refused)
            elif failed:
                engine.grow(engine.next_size(failed))
            else:
                return True
        return False

    def _differing_map(self, settled: Settled, labels: Sequence[int]) -> SSHMap | None:
        """A map with these labels in which a doubt about places or paths is true."""
        return settled.map_with(
            [
                (sort, labels[i], labels[j], one)
                for sort, i, j, one in self._doubts_of_classes(len(labels))
                if sort != "dstates"
            ]
        )

    def settle_steps(self) -> None:
        """Add maps until no doubt is left, with the readable encodings."""
        # The cut of a minimal map never has more paths than the map.
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
        """The shortest prefix that may be enough: from it, the known classes replay to the end."""
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
        """Resolve the doubts about a prefix.

        Returns:
            The size of the next prefix; 0 if no doubt is left.
        """
        engine.grow(size)
        while (found := engine.map_with(list(self._doubts(size)), self._cost)) is not None:
            replayed = self._replay(found)
            whole = replace(found, labels=replayed.labels)
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
        """Replay the trace over a map of a prefix."""
        return self._task.log.replay(
            found.labels, None, [s.place for s in found.dstates] if self._task.log.pairs else None
        )

    def _doubts(self, size: int) -> Iterator[Doubt]:
        """The doubts about a prefix: steps that may be one, or may be different, after all."""
        firsts = self._sharing.firsts()
        yield from (
            ("dstates", firsts[self._sharing.classes[t]], t, False) for t in self._entering(size)
        )
        yield from self._doubts_of_classes(size)

    def _doubts_of_classes(self, size: int) -> Iterator[Doubt]:
        """The doubts about classes. The first step of each class stands for it."""
        sharing = self._sharing
        firsts = [t for t in sharing.firsts() if t < size]
        for sort in sharing.sorts():
            known = sharing.kept(sort)
            heads: dict[int, int] = {}  # for each number, its first class
            for c in range(len(firsts)):
                head = heads.setdefault(known.always[c], c)
                if head != c:
                    yield sort, firsts[head], firsts[c], False
                # It is in doubt whether this class is along a path.
                if sort == "paths" and ((c, c) in known.together) != (c in known.unnamed):
                    yield sort, firsts[c], firsts[c], c in known.unnamed
            for c, d in combinations(heads.values(), 2):
                if (c, d) not in known.together and (
                    sort != "dstates" or self._may_be_one(firsts[c], firsts[d])
                ):
                    yield sort, firsts[c], firsts[d], True

    def _may_be_one(self, i: int, j: int) -> bool:
        """Whether two steps may be one dstate by their views."""
        steps = self._task.trace.steps
        return (
            None in (views := {steps[i].view, steps[j].view})
            or len(views) == 1
            or "functional_view" not in self._task.theory.hard
        )

    def _entering(self, size: int) -> Iterator[int]:
        """Steps of the prefix that come back to a known class in a new way.

        If the same action led there from the same class before, determinism proves it.
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
