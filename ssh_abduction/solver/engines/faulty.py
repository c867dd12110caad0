"""For the causal theory with faults: finds all maps with the fewest dstates and faults.

A view may be misread, and an action may slip. Clingo is given some steps of the trace
(`faulty_control.py`). Fewer steps are fewer constraints, so their cost is a lower bound for the
whole trace. A map of the given steps is followed through the others. If it predicts all views
there, it is a minimal map of the whole trace. If not, clingo is given the steps around.

A Viterbi pass chooses these steps: it finds the fewest faults with which a map explains the whole
trace (Viterbi 1967). The result is a map of the whole trace, the incumbent. The first maps are
guessed (`guesses/robust.py`). Clingo is only asked for cheaper ones. The bound of a long trace
comes from blocks of it (`engines/blocks.py`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import chain

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solver.asp.control import Asker
from ssh_abduction.solver.asp.facts import answer_maps, faulty_lp
from ssh_abduction.solver.engines.base import Found, Task
from ssh_abduction.solver.engines.blocks import Blocks
from ssh_abduction.solver.engines.faulty_control import LONG, FaultyAnswer, FaultyControl
from ssh_abduction.solver.guesses.robust import Explained, Explainer, Machine, robust_maps
from ssh_abduction.theory.evidence import Equality

FEW = 80  # no map of fewer steps is guessed, as clingo is fast
AT_FIRST = 1000  # steps at the beginning that clingo is given at once
PLACES = 12  # steps ignored by the Viterbi pass around which more are given at once
SPARE = 3  # names of each view beyond those of the best guess; with 1 the rests are used
GUESSING = 5.0  # seconds after which no start of EM begins,
GUESSING_SHARE = 0.1  # or a share of the time left


class FaultyEngine:
    """The causal theory with faults, fewest dstates and faults."""

    lists_least = False
    goes_on = False

    def __init__(self, task: Task, most_faults: int | None = None) -> None:
        """Give nothing to clingo yet.

        Args:
            task: What to solve.
            most_faults: If given, a map may have this many faults, and faults cost nothing.
        """
        self.asker = Asker(task.watch)
        self.intact = True
        self._most_faults = most_faults
        self.paths = 0
        self.size = 0
        self.bound: int | None = None
        self._task = task
        self._seen, self._actions = task.log.seen, task.log.actions
        # Tenths of dstates for each kind of fault that may be, at each step.
        self._price = {
            kind: [task.theory.fault_tenths(kind, step) for step in task.trace.steps]
            for kind in ("misread", "slipped")
            if getattr(task.theory, kind)
        }
        self._best: int | None = None  # cost of the best known map, in tenths of dstates
        self._known: SSHMap | None = None  # this map
        self._explainer = Explainer(self._seen, self._actions, self._price, task.watch.check)
        self._control = FaultyControl(task, self.asker, self._price, most_faults, self._raise_bound)

    def with_paths(self, paths: int) -> FaultyEngine:
        return FaultyEngine(self._task)

    def over(self, task: Task) -> FaultyEngine:
        return FaultyEngine(task)

    def next_size(self, failed: int) -> int:
        return len(self._task.trace)

    @property
    def size_to_go_on(self) -> int:
        return len(self._task.trace)

    def grow(self, size: int) -> None:
        """Take the whole trace as the prefix. Clingo is given the steps it needs."""
        if size != self.size:
            self.size = size
            self._control.given = set(range(min(size, AT_FIRST)))
            for t, others in self._task.log.pairs.one.items():
                self._control.given |= {t, *others}
                self._control.full |= {t, *others}  # a fault evades no equality

    def improving_maps(self, most: tuple[int, ...] = ()) -> Iterator[Found]:
        best = self._best = self._known = None
        for found in chain(self._guessed(), self._asked()):
            if best is None or self._cost_of(found) < best:
                best = self._best = self._cost_of(found)
                self._known = found.map
                yield found
                if best <= (self.bound or 0):
                    return

    def _guessed(self) -> Iterator[Found]:
        """Guessed maps of the whole trace. The best one decides clingo's names and steps."""
        if self.size <= FEW or self._task.log.pairs.one or not self._price:
            return
        watch = self._task.watch
        began, may_take = watch.elapsed(), min(GUESSING, GUESSING_SHARE * watch.left())
        for guess in robust_maps(self._explainer):
            found = None if guess is None else self._map_of(guess)
            if guess is not None and found is not None:
                used = Counter(guess.machine.shows[s] for s in set(guess.labels))
                names = self._control.names
                self._control.names = {view: used[view] + SPARE for view in names}
                self._control.give_around(guess.faults)
                yield found
            if watch.elapsed() - began > may_take:
                return

    def _bound_by_blocks(self) -> None:
        """Raise the bound of a long trace by disjoint blocks of it."""
        if self.size >= LONG and self._known is not None and self._most_faults is None:
            faults = {
                kind: [fault.step for fault in self._known.faults if fault.kind == kind]
                for kind in self._price
            }
            blocks = Blocks(
                self._seen,
                self._actions,
                self._price,
                faults,
                len(self._known.dstates),
                self._task.watch,
            )
            self._raise_bound([blocks.bound()])

    def _asked(self) -> Iterator[Found]:
        """Maps of the whole trace made of answers for the given steps; the best one is minimal."""
        self._bound_by_blocks()
        while self._best is None or self._best > (self.bound or 0):
            answer = None
            for answer in self._control.answers(f"opt,{self._best - 1}" if self._best else "opt"):
                explained, doubted = self._explained(answer)
                if explained is not None:
                    yield explained
            if answer is None:
                self.bound = max(self.bound or 0, self._best or 0)
                return
            self.bound = max(self.bound or 0, answer.cost)
            labels, failed = (None, -1) if answer.is_open else self._followed(answer)
            if labels is not None:
                yield self._found(labels, answer.slips, self._machine(answer)[0])
                return
            self._control.learn_from(answer)
            self._control.give_around([failed, *doubted] if failed >= 0 else doubted)

    def _cost_of(self, found: Found) -> int:
        """Tenths of dstates, as clingo counts them."""
        return found.cost[0] if self._most_faults is None else 10 * len(found.map.dstates)

    def maps_of_cost(self, cost: tuple[int, ...], enough: int) -> Iterator[Found]:
        given = set()
        if self._known is not None and self._best == cost[0]:
            given.add(self._known)
            yield Found.of(self._known, self._task.theory)
        while True:
            found: list[Found] = []
            for answer in self._control.answers_of_cost(cost[0], enough):
                labels, failed = (None, -1) if answer.is_open else self._followed(answer)
                if labels is None:
                    break
                found.append(self._found(labels, answer.slips, self._machine(answer)[0]))
            else:
                yield from (one for one in found if one.map not in given)
                return
            self._control.learn_from(answer)
            if failed >= 0:
                self._control.give_around([failed])

    def labellings(self, cost: tuple[int, ...]) -> None:
        """Labels are the maps."""

    def forbid(self, equalities: Collection[Equality]) -> bool:
        self._control.forbidden.append(equalities)
        self._control.give_around(
            [step for equality in equalities for step in (equality.first, equality.second)]
        )
        return True

    def settle(self) -> None:
        """Do nothing: clingo stops after each answer."""

    def _raise_bound(self, bound: Sequence[int]) -> None:
        """A bound for the given steps holds for the whole trace."""
        if bound and self._most_faults is None:
            self.bound = max(self.bound or 0, bound[0])

    def _machine(self, answer: FaultyAnswer) -> tuple[dict[int, int], Machine]:
        """Number the dstates of an answer by first visit, and make them a machine."""
        number: dict[int, int] = {}
        for t in sorted(answer.where):
            number.setdefault(answer.where[t], len(number))
        view_of = dict(faulty_lp.faulty_names(self._control.names))
        goes = {
            (number[answer.where[t]], self._actions[t]): number[answer.where[t + 1]]
            for t in answer.where
            if t + 1 in answer.where and t not in answer.slips
        }
        return number, Machine([view_of[name] for name in number], goes)

    def _followed(self, answer: FaultyAnswer) -> tuple[list[int] | None, int]:
        """Follow the map of the given steps through all others.

        Returns:
            The dstate of each step and -1; or None and a step neither given nor predicted.
        """
        number, machine = self._machine(answer)
        labels: list[int] = []
        for t in range(self.size):
            here = answer.where.get(t)
            if t and (t - 1 not in answer.where or here is None):
                there = machine.goes.get((labels[-1], self._actions[t - 1]))
                known = there is not None and (
                    machine.shows[there] == self._seen[t] if here is None else there == number[here]
                )
                if not known and t - 1 not in answer.slips:
                    return None, t if here is None else t - 1
                if here is None:
                    if there is None:
                        return None, t
                    labels.append(there)
                    continue
            labels.append(number[here] if here is not None else 0)
        if wrong := self._task.log.pairs.broken_by(labels):
            new = [step for pair in wrong for step in pair if step not in self._control.given]
            return None, new[0]
        return labels, -1

    def _explained(self, answer: FaultyAnswer) -> tuple[Found | None, list[int]]:
        """Explain the whole trace by the dstates of an answer, with the fewest faults.

        Returns:
            The map, if allowed, and the first steps that it ignores or lacks, of those not given.
        """
        _, machine = self._machine(answer)
        if not machine.shows:  # all given steps are lost
            return None, []
        explained = self._explainer.explained(machine)
        doubted = [
            t
            for t in sorted({*explained.unknown, *explained.faults})
            if t not in self._control.given
        ]
        return self._map_of(self._explainer.completed(machine)), doubted[:PLACES]

    def _map_of(self, explained: Explained) -> Found | None:
        """The map of an explanation of the trace; None if its faults are not allowed."""
        labels, shows = explained.labels, explained.machine.shows
        if (explained.misread and "misread" not in self._price) or (
            explained.slips and "slipped" not in self._price
        ):
            return None
        if set(labels) - {
            s for t, s in enumerate(labels) if shows[s] == self._seen[t]
        }:  # a dstate whose view is never read right
            return None
        if any(
            all(labels[one.first] == labels[one.second] for one in together)
            for together in self._control.forbidden
        ):
            return None
        if self._task.log.pairs.broken_by(labels) or (
            self._most_faults is not None and len(explained.faults) > self._most_faults
        ):
            return None
        return self._found(labels, explained.slips, {}, shows)

    def _found(
        self,
        labels: Sequence[int],
        slips: Collection[int],
        number: Mapping[int, int],
        shows: Sequence[int] | None = None,
    ) -> Found:
        """A map of the whole trace, and what it costs."""
        view_of = dict(faulty_lp.faulty_names(self._control.names))
        shown = self._shown_somewhere(labels, shows or [view_of[name] for name in number])
        misread = [t for t in range(self.size) if shown[labels[t]] != self._seen[t]]
        faults = [*((t, "misread") for t in misread), *((t, "slipped") for t in slips)]
        return Found.of(
            answer_maps.faulty_map(labels, self._task.trace, faults, self._task.theory),
            self._task.theory,
        )

    def _shown_somewhere(self, labels: Sequence[int], shown: Sequence[int]) -> list[int]:
        """The view of each dstate. One always misread gets the view seen there most often."""
        views = list(shown)
        for s in set(labels) - {s for t, s in enumerate(labels) if shown[s] == self._seen[t]}:
            views[s] = Counter(
                self._seen[t] for t, label in enumerate(labels) if label == s
            ).most_common(1)[0][0]
        return views
