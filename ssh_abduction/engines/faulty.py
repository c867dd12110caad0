"""The engine for the causal theory where faults are allowed: views that are misread, and actions that slipped.

Clingo is given some steps of the trace. To leave steps and links away only takes constraints away, so what these steps cost at least, all of the trace costs at least.
A map of the given steps is followed through the others. Where it predicts all that is seen there, it is a map of the whole trace with no more dstates and no more faults:
so it is minimal. Where it does not, the steps around are given, too.

Which steps these are a Viterbi pass tells: it finds the fewest faults by which the map explains the whole trace (Viterbi 1967). That is a map of the whole trace, too, and
the best answer so far.

Dstates have names, as many for each view as are needed, and a rest: a name for all others of the view. A rest costs one dstate, and nothing is asked of the steps there.
So a minimum in which no rest is used is one for any number of names; where one is used, its view is given more names.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import clingo
import numpy as np

from ssh_abduction.asp import facts
from ssh_abduction.asp.control import Asker, Control
from ssh_abduction.engines.base import Found, Task
from ssh_abduction.theory.evidence import Equality

AT_FIRST = 80  # The first steps of the trace, which clingo is given at once.
AROUND = 8  # So many steps before and behind one that a map does not predict are given.
PLACES = 12  # Steps around so many of those that the Viterbi pass disbelieves are given at once.
NAMES = 3  # So many names a view has at first.
MORE_NAMES = 2  # So many more it is given where its rest is used.
OPTIONS = ("--opt-strategy=usc,stratify",)
NEVER = 1_000_000  # What the Viterbi pass pays for faults of a kind that may not be.
UNKNOWN = 0.5  # What the Viterbi pass pays, in tenths of dstates, where the map does not know where an action leads: less than any fault.


@dataclass(frozen=True)
class _Answer:
    """An answer of clingo.

    cost   tenths of dstates
    where  the name of the dstate of each given step
    slips  the given steps at which the action slipped
    rests  the views whose rest is used
    """

    cost: int
    where: Mapping[int, int]
    slips: frozenset[int]
    rests: frozenset[int]


@dataclass(frozen=True)
class _Machine:
    """The dstates of an answer, numbered from 0: the view of each, and where actions lead as far as given steps show."""

    shows: Sequence[int]
    goes: Mapping[tuple[int, int], int]


class FaultyEngine:
    """The causal theory with faults, fewest dstates and faults."""

    lists_least = False
    goes_on = False

    def __init__(self, task: Task, most_faults: int | None = None) -> None:
        """Nothing is given to clingo yet.

        most_faults  where this is a number, maps have so many faults at most, which then cost nothing
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
        self._names = dict.fromkeys(range(max(self._seen) + 1), NAMES)
        self._given: set[int] = set()
        self._forbidden: list[Collection[Equality]] = []
        # What clingo was told: the names of views, the steps in the order in which they were given, in how many batches, and how many of the forbidden sets.
        self._named: dict[int, int] = {}
        self._told: list[int] = []
        self._batches = self._ruled = 0

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
        """The prefix is the whole trace, of which clingo is given what it needs."""
        if size != self.size:
            self.size = size
            self._given = set(range(min(size, AT_FIRST)))
            for t, others in self._task.log.pairs.one.items():
                self._given |= {t, *others}

    def improving_maps(self, most: tuple[int, ...] = ()) -> Iterator[Found]:
        best: int | None = None
        while True:
            answer = self._best_answer()
            if answer is None:
                return
            self.bound = max(self.bound or 0, answer.cost)
            if answer.rests:
                self._name_more(answer)
                continue
            labels, failed = self._followed(answer)
            if labels is not None:
                yield self._found(labels, answer.slips, self._machine(answer)[0])
                return
            explained, doubted = self._explained(answer)
            if explained is not None and (best is None or self._cost_of(explained) < best):
                best = self._cost_of(explained)
                yield explained
                if best <= self.bound:
                    return
            self._give([failed, *doubted])

    def _cost_of(self, found: Found) -> int:
        """Tenths of dstates, as clingo counts them."""
        return found.cost[0] if self._most_faults is None else 10 * len(found.map.dstates)

    def maps_of_cost(self, cost: tuple[int, ...], enough: int) -> Iterator[Found]:
        while True:
            found: list[Found] = []
            for answer in self._answers_of_cost(cost[0], enough):
                labels, failed = (None, -1) if answer.rests else self._followed(answer)
                if labels is None:
                    break
                found.append(self._found(labels, answer.slips, self._machine(answer)[0]))
            else:
                yield from found
                return
            if answer.rests:
                self._name_more(answer)
            else:
                self._give([failed])

    def labellings(self, cost: tuple[int, ...]) -> None:
        """Labels are the maps."""

    def forbid(self, equalities: Collection[Equality]) -> bool:
        self._forbidden.append(equalities)
        self._give([step for equality in equalities for step in (equality.first, equality.second)])
        return True

    def settle(self) -> None:
        """Nothing goes on in clingo beyond an answer."""

    def _give(self, steps: Collection[int]) -> None:
        """Give clingo these steps, and those around them."""
        for step in steps:
            self._given |= set(range(max(step - AROUND, 0), min(step + AROUND + 1, self.size)))

    def _name_more(self, answer: _Answer) -> None:
        """Give the views more names whose rest is used, and also those all of whose names are."""
        used = Counter(view for name, view in facts.faulty_names(self._names) if name in set(answer.where.values()))
        for view in self._names:
            self._names[view] += MORE_NAMES if view in answer.rests else used[view] == self._names[view]

    def _prepare(self) -> None:
        """Tell clingo of the given steps that it does not know yet; a new control where views have more names than it knows."""
        with self.asker.grounding_timed():
            if self._named != self._names:
                self._named, self._told = dict(self._names), []
                self._batches = self._ruled = 0
                self.asker.control = Control(OPTIONS, self.asker.watch.check)
                self.asker.control.load_encodings("faulty")
                self.asker.control.add("base", [], facts.faulty_base(self._actions, self._names, self._price))
                self.asker.control.ground([("base", [])])
            control = self.asker.control
            if new := sorted(self._given.difference(self._told)):
                batch = self._batches
                price = self._price if self._most_faults is None else {kind: [0] * len(self._seen) for kind in self._price}
                told = facts.faulty_batch(batch, self._seen, self._actions, new, self._told, self._task.log.pairs, price)
                control.add(f"batch_{batch}", [], told)
                control.ground([(f"batch_{batch}", []), ("more", facts.numbers(batch))])
                if self._most_faults is not None:
                    control.add(f"most_{batch}", [], facts.at_most_faults(self._most_faults))
                    control.ground([(f"most_{batch}", [])])
                self._told += new
                self._batches += 1
            for number in range(self._ruled, len(self._forbidden)):
                control.add(f"forbidden_{number}", [], facts.not_all_one(self._forbidden[number]))
                control.ground([(f"forbidden_{number}", [])])
            self._ruled = len(self._forbidden)

    def _best_answer(self) -> _Answer | None:
        """A minimal answer for the given steps."""
        self._prepare()
        last = deque(self.asker.answers(self._read, "opt", 0), maxlen=1)
        return last[0] if last else None

    def _answers_of_cost(self, cost: int, enough: int) -> Iterator[_Answer]:
        """Answers for the given steps that cost so much, which is the least."""
        self._prepare()
        minimal = (answer for answer in self.asker.answers(self._read, "optN", 0) if answer.cost == cost)
        seen: set[tuple[frozenset[tuple[int, int]], frozenset[int]]] = set()
        for answer in minimal:  # the one that shows that there are no cheaper ones comes twice
            told = frozenset(answer.where.items()), answer.slips
            if told not in seen:
                seen.add(told)
                yield answer
                if len(seen) == enough:
                    return

    def _read(self, model: clingo.Model) -> _Answer:
        where, slips = facts.read_faulty(model)
        used = set(where.values())
        rests = frozenset(view for name, view in facts.faulty_rests(self._names) if name in used)
        return _Answer(model.cost[0] if model.cost else 0, where, slips, rests)

    def _machine(self, answer: _Answer) -> tuple[dict[int, int], _Machine]:
        """The number of each dstate that is named, by first visit, and what they are."""
        number: dict[int, int] = {}
        for t in sorted(answer.where):
            number.setdefault(answer.where[t], len(number))
        view_of = dict(facts.faulty_names(self._names))
        goes = {
            (number[answer.where[t]], self._actions[t]): number[answer.where[t + 1]]
            for t in answer.where
            if t + 1 in answer.where and t not in answer.slips
        }
        return number, _Machine([view_of[name] for name in number], goes)

    def _followed(self, answer: _Answer) -> tuple[list[int] | None, int]:
        """The dstate of each step, by following the map of the given steps through all others; or None, and a step that is not given and not predicted."""
        number, machine = self._machine(answer)
        labels: list[int] = []
        for t in range(self.size):
            here = answer.where.get(t)
            if t and (t - 1 not in answer.where or here is None):
                there = machine.goes.get((labels[-1], self._actions[t - 1]))
                known = there is not None and (machine.shows[there] == self._seen[t] if here is None else there == number[here])
                if not known and t - 1 not in answer.slips:
                    return None, t if here is None else t - 1
                if here is None:
                    if there is None:
                        return None, t
                    labels.append(there)
                    continue
            labels.append(number[here] if here is not None else 0)
        if wrong := self._task.log.pairs.broken_by(labels):
            new = [step for pair in wrong for step in pair if step not in self._given]
            return None, new[0]
        return labels, -1

    def _explained(self, answer: _Answer) -> tuple[Found | None, list[int]]:
        """A map of the whole trace with the dstates of an answer and the fewest faults, and the first steps that are not given and are disbelieved, or not known."""
        _, machine = self._machine(answer)
        goes = dict(machine.goes)
        labels, unknown, faults = self._viterbi(machine.shows, goes)
        doubted = [t for t in sorted({*unknown, *faults}) if t not in self._given]
        while unknown:  # what is not known leads where it was taken to lead most often
            votes: dict[tuple[int, int], Counter[int]] = {}
            for t in unknown:
                votes.setdefault((labels[t], self._actions[t]), Counter())[labels[t + 1]] += 1
            goes |= {key: counts.most_common(1)[0][0] for key, counts in votes.items()}
            labels, unknown, faults = self._viterbi(machine.shows, goes)
            self.asker.watch.check()
        return self._map_of(labels, machine.shows, goes), doubted[:PLACES]

    def _map_of(self, labels: Sequence[int], shows: Sequence[int], goes: Mapping[tuple[int, int], int]) -> Found | None:
        """The map of labels, whose faults are what the dstates and links do not say; None where faults of such a kind are not allowed."""
        misread = [t for t in range(self.size) if shows[labels[t]] != self._seen[t]]
        slips = frozenset(t for t in range(self.size - 1) if goes[labels[t], self._actions[t]] != labels[t + 1])
        right = {labels[t] for t in range(self.size)} - {labels[t] for t in misread}
        seen_right = right | {labels[t] for t in range(self.size) if shows[labels[t]] == self._seen[t]}
        if (misread and "misread" not in self._price) or (slips and "slipped" not in self._price) or set(labels) - seen_right:
            return None
        if self._task.log.pairs.broken_by(labels) or (self._most_faults is not None and len(misread) + len(slips) > self._most_faults):
            return None
        return self._found(labels, slips, {}, shows)

    def _viterbi(self, shows: Sequence[int], goes: Mapping[tuple[int, int], int]) -> tuple[list[int], list[int], list[int]]:
        """The dstates of all steps with the fewest faults; the steps whose action is not known there; and the steps with a fault."""
        count = len(shows)
        prices = (np.array(self._price.get(kind, [NEVER] * self.size), dtype=float) for kind in ("slipped", "misread"))
        slip, misread = prices
        moves = np.full((max(self._actions, default=0) + 1, count, count), slip[0])
        for action in range(len(moves)):
            for s in range(count):
                target = goes.get((s, action))
                if target is None:
                    moves[action, s] = UNKNOWN
                else:
                    moves[action, s, target] = 0.0
        wrong = np.where(np.array(shows)[None, :] == np.arange(max(self._seen) + 1)[:, None], 0.0, 1.0)
        spent = wrong[self._seen[0]] * misread[0]
        came = np.zeros((self.size, count), dtype=np.int32)
        for t in range(1, self.size):
            ways = spent[:, None] + moves[self._actions[t - 1]]
            came[t] = ways.argmin(axis=0)
            spent = ways[came[t], np.arange(count)] + wrong[self._seen[t]] * misread[t]
        labels = [int(spent.argmin())]
        for t in range(self.size - 1, 0, -1):
            labels.append(int(came[t, labels[-1]]))
        labels.reverse()
        unknown = [t for t in range(self.size - 1) if (labels[t], self._actions[t]) not in goes]
        faults = [t for t in range(self.size) if shows[labels[t]] != self._seen[t]]
        faults += [t for t in range(self.size - 1) if goes.get((labels[t], self._actions[t]), labels[t + 1]) != labels[t + 1]]
        return labels, unknown, faults

    def _found(self, labels: Sequence[int], slips: Collection[int], number: Mapping[int, int], shows: Sequence[int] | None = None) -> Found:
        """A map of the whole trace, and what it costs."""
        view_of = dict(facts.faulty_names(self._names))
        shown = shows or [view_of[name] for name in number]
        misread = [t for t in range(self.size) if shown[labels[t]] != self._seen[t]]
        faults = [*((t, "misread") for t in misread), *((t, "slipped") for t in slips)]
        return Found.of(facts.faulty_map(labels, self._task.trace, faults, self._task.theory), self._task.theory)
