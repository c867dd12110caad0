"""The engine for the causal theory with faults: it finds all maps of least cost.

A view may be misread, and an action may slip. The cost of a map is the cost of its dstates and
faults. Clingo gets only some steps of the trace, the *given* steps (`faulty_program.py`). Fewer
steps are fewer constraints. So the least cost for the given steps is a lower bound for the whole
trace. A minimal map of the given steps is then followed through all other steps. If it predicts all
their views, it is a minimal map of the whole trace. If not, clingo gets more steps.

A Viterbi pass chooses the further steps (Viterbi 1967). It explains the whole trace by the links
that clingo found, with the cheapest faults. Clingo gets the steps at fault and those around them.
The explanation is also a map of the whole trace, so it may be the new incumbent.

The first maps of a long trace are guessed (`sources/symbolic/state_merging.py`), and clingo is only
asked for cheaper ones. The lower bound of a long trace comes from its blocks (`blocks.py`). For a
short trace clingo is asked first, and maps are guessed if it does not end soon.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from itertools import chain

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solver.asp import facts
from ssh_abduction.solver.asp.control import Asker
from ssh_abduction.solver.asp.limits import StageTimeError
from ssh_abduction.solver.sources.exact.blocks import Blocks
from ssh_abduction.solver.sources.exact.engine import Task, in_fixed_order
from ssh_abduction.solver.sources.exact.faulty_program import (
    LONG,
    FaultyAnswer,
    FaultyControl,
    faulty_names,
)
from ssh_abduction.solver.sources.symbolic.state_merging import (
    Explained,
    Explainer,
    PartialMachine,
    robust_maps,
)
from ssh_abduction.solver.values import Found
from ssh_abduction.theory.evidence import Equality

FEW = 80  # make no guess for a trace of at most this many steps, as clingo is fast
GUESSED = 1000  # guess maps of a trace with at least this many steps before clingo is asked
# Guess maps of a shorter trace if clingo has not ended after this many seconds, or after this share
# of the time left.
ASKED_FIRST = 3.0
ASKED_FIRST_SHARE = 0.2
AT_FIRST = 1000  # clingo gets this many first steps at the beginning
PLACES = 12  # after a Viterbi pass, clingo gets the steps around at most this many faults
SPARE = 3  # names of each view beyond those of the best guess; with 1, answers use the rests
# Begin no start of EM after this many seconds, or after this share of the time left.
GUESSING = 5.0
GUESSING_SHARE = 0.1


class FaultyEngine:
    """The engine for the causal theory with faults. It minimises dstates and faults together."""

    def __init__(self, task: Task, most_faults: int | None = None) -> None:
        """Begin without steps. If given, up to `most_faults` faults cost nothing."""
        self.asker = Asker(task.watch)
        self._most_faults = most_faults
        self.size = 0
        self.bound: int | None = None
        self._task = task
        self._seen, self._actions = task.log.seen, task.log.actions
        # For each kind of fault that is allowed, its cost at each step in tenths of dstates.
        self._price = {
            kind: [task.theory.fault_tenths(kind, step) for step in task.trace.steps]
            for kind in ("misread", "slipped")
            if getattr(task.theory, kind)
        }
        self._best: int | None = None  # cost of the incumbent, in tenths of dstates
        self._known: SSHMap | None = None  # the incumbent
        self._explainer = Explainer(self._seen, self._actions, self._price)
        self._control = FaultyControl(task, self.asker, self._price, most_faults, self._raise_bound)

    def next_size(self, failed: int) -> int:
        return len(self._task.trace)

    def grow(self, size: int) -> None:
        """Take the whole trace as the prefix. Clingo gets only its first steps for now."""
        if size != self.size:
            self.size = size
            self._control.given = set(range(min(size, AT_FIRST)))
            for t, others in self._task.log.pairs.one.items():
                self._control.given |= {t, *others}
                self._control.full |= {t, *others}  # these equalities hold even for misread steps

    def improving_maps(self, most: tuple[int, ...] = ()) -> Iterator[Found]:
        best = self._best = self._known = None
        for found in chain(self._asked_first(), self._guessed(), self._asked()):
            if best is None or self._cost_of(found) < best:
                best = self._best = self._cost_of(found)
                self._known = found.map
                yield found
                if best <= (self.bound or 0):
                    return

    def _guesses(self) -> bool:
        """Whether to guess maps. Clingo solves the shortest traces at once."""
        return self.size > FEW and not self._task.log.pairs.one and bool(self._price)

    def _asked_first(self) -> Iterator[Found]:
        """Yield maps of a short trace that clingo finds soon, before maps are guessed."""
        watch = self._task.watch
        if self.size >= GUESSED or not self._guesses():
            return
        ends = watch.elapsed() + min(ASKED_FIRST, ASKED_FIRST_SHARE * watch.left())
        with suppress(StageTimeError), watch.stage(ends):
            yield from self._asked()
            return
        self._control.forget()
        watch.check()

    def _guessed(self) -> Iterator[Found]:
        """Yield guessed maps of the whole trace, each cheaper than the one before.

        There are none if the best map is proven minimal. Clingo gets the steps around the faults
        of the best guess, and as many names as this guess has dstates.
        """
        if not self._guesses() or (self._best is not None and self._best <= (self.bound or 0)):
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
        """Raise the lower bound of a long trace by its short parts (`blocks.py`)."""
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
        """Yield maps made from clingo's answers. At the end, the cheapest map known is minimal."""
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
                yield self._found(labels, answer.slips, self._machine(answer)[1].shows)
                return
            self._control.learn_from(answer)
            self._control.give_around([failed, *doubted] if failed >= 0 else doubted)

    def _cost_of(self, found: Found) -> int:
        """Return the cost of a map as clingo counts it, in tenths of dstates."""
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
                found.append(self._found(labels, answer.slips, self._machine(answer)[1].shows))
            else:
                yield from (one for one in found if one.map not in given)
                return
            self._control.learn_from(answer)
            if failed >= 0:
                self._control.give_around([failed])

    def forbid(self, equalities: Collection[Equality]) -> bool:
        self._control.forbidden.append(in_fixed_order(equalities))
        self._control.give_around(
            [step for equality in equalities for step in (equality.first, equality.second)]
        )
        return True

    def _raise_bound(self, bound: Sequence[int]) -> None:
        """Take over a bound that clingo proved. A bound for the given steps holds for all steps."""
        if bound and self._most_faults is None:
            self.bound = max(self.bound or 0, bound[0])

    def _machine(self, answer: FaultyAnswer) -> tuple[dict[int, int], PartialMachine]:
        """Make a machine (dstates and links) from an answer.

        Also return the number of the dstate that each name stands for.
        """
        number: dict[int, int] = {}
        for t in sorted(answer.where):
            number.setdefault(answer.where[t], len(number))
        view_of = dict(faulty_names(self._control.names))
        goes = {
            (number[answer.where[t]], self._actions[t]): number[answer.where[t + 1]]
            for t in answer.where
            if t + 1 in answer.where and t not in answer.slips
        }
        return number, PartialMachine([view_of[name] for name in number], goes)

    def _followed(self, answer: FaultyAnswer) -> tuple[list[int] | None, int]:
        """Follow the links of an answer through the steps that clingo was not given.

        Returns two values: the dstates of all steps, and -1 for "no step". If the links do not
        explain a step, or evidence contradicts its dstate, they are None and the step to give to
        clingo next.
        """
        number, machine = self._machine(answer)
        labels: list[int] = []
        for t in range(self.size):
            here = answer.where.get(t)
            # At least one end of this action was not given, so clingo has not checked its link.
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
        """Explain the whole trace by the dstates and links of an answer, with the cheapest faults.

        Returns the map (None if it is not allowed), and up to PLACES steps to give to clingo next:
        those with a fault, or with an action without a link.
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
        """Make a map of an explanation of the trace, with its cost.

        Returns None if its faults are not allowed, if all steps of a dstate are misread, or if the
        map contradicts evidence about pairs of steps or has a forbidden set of equalities.
        """
        labels, shows = explained.labels, explained.machine.shows
        if (explained.misread and "misread" not in self._price) or (
            explained.slips and "slipped" not in self._price
        ):
            return None
        if set(labels) - {
            s for t, s in enumerate(labels) if shows[s] == self._seen[t]
        }:  # the view of some dstate is misread each time
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
        return self._found(labels, explained.slips, shows)

    def _found(self, labels: Sequence[int], slips: Collection[int], shows: Sequence[int]) -> Found:
        """Make a map of the whole trace, with its cost. `shows` has the view of each dstate."""
        shown = self._views_of_dstates(labels, shows)
        misread = [t for t in range(self.size) if shown[labels[t]] != self._seen[t]]
        faults = [*((t, "misread") for t in misread), *((t, "slipped") for t in slips)]
        trace, theory = self._task.trace, self._task.theory
        return Found.of(facts.causal_map(labels, trace, faults, theory), theory)

    def _views_of_dstates(self, labels: Sequence[int], shown: Sequence[int]) -> list[int]:
        """Return the view of each dstate. If all steps there are misread, it is their usual view.

        `shown` has the view of each dstate in clingo's answer.
        """
        views = list(shown)
        for s in set(labels) - {s for t, s in enumerate(labels) if shown[s] == self._seen[t]}:
            views[s] = Counter(
                self._seen[t] for t, label in enumerate(labels) if label == s
            ).most_common(1)[0][0]
        return views
