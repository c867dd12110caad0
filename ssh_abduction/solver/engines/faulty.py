"""The engine for the causal theory where faults are allowed: views that are misread, and actions that slipped.

Clingo is given some steps of the trace. To leave steps and links away only takes constraints away, so what these steps cost at least, all of the trace costs at least.
A map of the given steps is followed through the others. Where it predicts all that is seen there, it is a map of the whole trace with no more dstates and no more faults:
so it is minimal. Where it does not, the steps around are given, too.

Which steps these are a Viterbi pass tells: it finds the fewest faults by which the map explains the whole trace (Viterbi 1967). That is a map of the whole trace, too, and
the best answer so far. The first such maps are guessed (`guesses/robust.py`), and clingo is only asked for cheaper ones. A long trace is bounded by blocks of it (`engines/blocks.py`).

Where a misread step is, clingo is not asked at first: it is *lost*, and nothing links it with others, which forbids less. Only where a minimal answer loses a step that step
is *full*: it may be at any dstate. Else each link would join all names with all.

Dstates have names, as many for each view as are needed, and a rest: a name for all others of the view. A rest costs one dstate, and nothing is asked of the steps there.
So a minimum in which no rest is used is one for any number of names; where one is used, its view is given more names.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

import clingo

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solver.asp.control import Asker, Control
from ssh_abduction.solver.asp.facts import answer_maps, faulty_lp
from ssh_abduction.solver.asp.facts.atoms import numbers
from ssh_abduction.solver.engines.base import Found, Task
from ssh_abduction.solver.engines.blocks import Blocks
from ssh_abduction.solver.guesses.robust import Explained, Explainer, Machine, robust_maps
from ssh_abduction.theory.evidence import Equality

LONG = 1000  # A trace of so many steps is bounded by blocks of it before clingo is asked.
FEW = 80  # For so few steps no map is guessed: clingo is as soon done.
AT_FIRST = 1000  # The first steps of the trace, which clingo is given at once.
AROUND = 8  # So many steps before and behind one that a map does not predict are given.
PLACES = 12  # Steps around so many of those that the Viterbi pass disbelieves are given at once.
NAMES = 3  # So many names a view has at first.
MORE_NAMES = 2  # So many more it is given where its rest is used.
OPTIONS = ("--opt-strategy=usc,stratify",)
SPARE = 3  # So many names a view has at first beside those of the best map that is guessed. With one the rests are used, and all begins anew.
GUESSING = 5.0  # No start of EM begins after so many seconds,
GUESSING_SHARE = 0.1  # or after such a share of the time that is left.


@dataclass(frozen=True)
class _Answer:
    """An answer of clingo.

    cost   tenths of dstates
    where  the name of the dstate of each given step
    slips  the given steps at which the action slipped
    lost   the given steps whose views are misread, and of which it was not asked where they are
    rests  the views whose rest is used
    """

    cost: int
    where: Mapping[int, int]
    slips: frozenset[int]
    lost: frozenset[int]
    rests: frozenset[int]


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
        self._full: set[int] = set()
        self._best: int | None = None  # tenths of dstates that the best map costs that is known
        self._known: SSHMap | None = None  # this map
        self._explainer = Explainer(self._seen, self._actions, self._price, task.watch.check)
        self._forbidden: list[Collection[Equality]] = []
        # What clingo was told: the names of views and the steps that are full, the steps in the order in which they were given, in how many batches, and how many of the forbidden sets.
        self._named: tuple[dict[int, int], set[int]] = {}, set()
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
                self._full |= {t, *others}  # so that none evades it

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
        """Maps of the whole trace that nothing proves. What is known of the best of them clingo is told: how many names views need, and what is disbelieved."""
        if self.size <= FEW or self._task.log.pairs.one or not self._price:
            return
        watch = self._task.watch
        began, may_take = watch.elapsed(), min(GUESSING, GUESSING_SHARE * watch.left())
        for guess in robust_maps(self._explainer):
            found = None if guess is None else self._map_of(guess)
            if guess is not None and found is not None:
                used = Counter(guess.machine.shows[s] for s in set(guess.labels))
                self._names = {view: used[view] + SPARE for view in self._names}
                self._give(guess.faults)
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
        """Maps of the whole trace by which clingo's answers for the given steps explain it. Where the iteration ends, the best one is minimal."""
        self._bound_by_blocks()
        while self._best is None or self._best > (self.bound or 0):
            answer = None
            for answer in self._answers(f"opt,{self._best - 1}" if self._best else "opt"):
                explained, doubted = self._explained(answer)
                if explained is not None:
                    yield explained
            if answer is None:
                self.bound = max(self.bound or 0, self._best or 0)
                return
            self.bound = max(self.bound or 0, answer.cost)
            labels, failed = (None, -1) if answer.rests or answer.lost else self._followed(answer)
            if labels is not None:
                yield self._found(labels, answer.slips, self._machine(answer)[0])
                return
            if answer.rests:
                self._name_more(answer)
            self._full |= answer.lost
            self._give([failed, *doubted] if failed >= 0 else doubted)

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
            for answer in self._answers_of_cost(cost[0], enough):
                labels, failed = (
                    (None, -1) if answer.rests or answer.lost else self._followed(answer)
                )
                if labels is None:
                    break
                found.append(self._found(labels, answer.slips, self._machine(answer)[0]))
            else:
                yield from (one for one in found if one.map not in given)
                return
            if answer.rests:
                self._name_more(answer)
            self._full |= answer.lost
            if failed >= 0:
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
        used = Counter(
            view
            for name, view in faulty_lp.faulty_names(self._names)
            if name in set(answer.where.values())
        )
        for view in self._names:
            self._names[view] += (
                MORE_NAMES if view in answer.rests else used[view] == self._names[view]
            )

    def _prepare(self) -> None:
        """Tell clingo of the given steps that it does not know yet; a new control where views have more names than it knows."""
        with self.asker.grounding_timed():
            if self._named != (self._names, self._full):
                self._named, self._told = (dict(self._names), set(self._full)), []
                self._batches = self._ruled = 0
                self.asker.control = Control(OPTIONS, self.asker.watch.check)
                self.asker.control.load_encodings("faulty")
                self.asker.control.add(
                    "base", [], faulty_lp.faulty_base(self._actions, self._names, self._price)
                )
                self.asker.control.ground([("base", [])])
            control = self.asker.control
            if new := sorted(self._given.difference(self._told)):
                batch = self._batches
                price = (
                    self._price
                    if self._most_faults is None
                    else {kind: [0] * len(self._seen) for kind in self._price}
                )
                told = faulty_lp.faulty_batch(
                    batch,
                    self._seen,
                    self._actions,
                    new,
                    self._told,
                    self._task.log.pairs,
                    price,
                    self._full,
                )
                control.add(f"batch_{batch}", [], told)
                control.ground([(f"batch_{batch}", []), ("more", numbers(batch))])
                if self._most_faults is not None:
                    control.add(f"most_{batch}", [], faulty_lp.at_most_faults(self._most_faults))
                    control.ground([(f"most_{batch}", [])])
                self._told += new
                self._batches += 1
            for number in range(self._ruled, len(self._forbidden)):
                control.add(
                    f"forbidden_{number}", [], faulty_lp.not_all_one(self._forbidden[number])
                )
                control.ground([(f"forbidden_{number}", [])])
            self._ruled = len(self._forbidden)

    def _answers(self, mode: str) -> Iterator[_Answer]:
        """Answers for the given steps, each cheaper than the one before; the last one is minimal."""
        self._prepare()
        yield from self.asker.answers(self._read, mode, 0, on_bound=self._raise_bound)

    def _raise_bound(self, bound: Sequence[int]) -> None:
        """What clingo proved of the given steps holds of the whole trace."""
        if bound and self._most_faults is None:
            self.bound = max(self.bound or 0, bound[0])

    def _answers_of_cost(self, cost: int, enough: int) -> Iterator[_Answer]:
        """Answers for the given steps that cost so much, which is the least."""
        self._prepare()
        seen: set[tuple[frozenset[tuple[int, int]], frozenset[int]]] = set()
        # Of a long trace the bound is proven by blocks, and not of the steps that clingo was given.
        mode = f"optN,{cost}" if self.size < LONG else f"enum,{cost}"
        for answer in (
            answer for answer in self.asker.answers(self._read, mode, 0) if answer.cost == cost
        ):
            told = frozenset(answer.where.items()), answer.slips
            if told not in seen:
                seen.add(told)
                yield answer
                if len(seen) == enough:
                    return

    def _read(self, model: clingo.Model) -> _Answer:
        where, slips, lost = faulty_lp.read_faulty(model)
        used = set(where.values())
        rests = frozenset(
            view for name, view in faulty_lp.faulty_rests(self._names) if name in used
        )
        return _Answer(model.cost[0] if model.cost else 0, where, slips, lost, rests)

    def _machine(self, answer: _Answer) -> tuple[dict[int, int], Machine]:
        """The number of each dstate that is named, by first visit, and what they are."""
        number: dict[int, int] = {}
        for t in sorted(answer.where):
            number.setdefault(answer.where[t], len(number))
        view_of = dict(faulty_lp.faulty_names(self._names))
        goes = {
            (number[answer.where[t]], self._actions[t]): number[answer.where[t + 1]]
            for t in answer.where
            if t + 1 in answer.where and t not in answer.slips
        }
        return number, Machine([view_of[name] for name in number], goes)

    def _followed(self, answer: _Answer) -> tuple[list[int] | None, int]:
        """The dstate of each step, by following the map of the given steps through all others; or None, and a step that is not given and not predicted."""
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
            new = [step for pair in wrong for step in pair if step not in self._given]
            return None, new[0]
        return labels, -1

    def _explained(self, answer: _Answer) -> tuple[Found | None, list[int]]:
        """A map of the whole trace with the dstates of an answer and the fewest faults, and the first steps that are not given and are disbelieved, or not known."""
        _, machine = self._machine(answer)
        if not machine.shows:  # all given steps are lost
            return None, []
        explained = self._explainer.explained(machine)
        doubted = [
            t for t in sorted({*explained.unknown, *explained.faults}) if t not in self._given
        ]
        return self._map_of(self._explainer.completed(machine)), doubted[:PLACES]

    def _map_of(self, explained: Explained) -> Found | None:
        """The map of an explanation of the trace; None where its faults are not allowed."""
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
            for together in self._forbidden
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
        view_of = dict(faulty_lp.faulty_names(self._names))
        shown = self._shown_somewhere(labels, shows or [view_of[name] for name in number])
        misread = [t for t in range(self.size) if shown[labels[t]] != self._seen[t]]
        faults = [*((t, "misread") for t in misread), *((t, "slipped") for t in slips)]
        return Found.of(
            answer_maps.faulty_map(labels, self._task.trace, faults, self._task.theory),
            self._task.theory,
        )

    def _shown_somewhere(self, labels: Sequence[int], shown: Sequence[int]) -> list[int]:
        """The views of dstates, so that each is read right at some step: of one that never is, any other view is as good, and the one seen most often needs fewer faults."""
        views = list(shown)
        for s in set(labels) - {s for t, s in enumerate(labels) if shown[s] == self._seen[t]}:
            views[s] = Counter(
                self._seen[t] for t, label in enumerate(labels) if label == s
            ).most_common(1)[0][0]
        return views
