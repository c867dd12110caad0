"""The engine for the causal theory with faults: it finds all maps of least cost.

A view may be misread, and an action may slip. The cost of a map is the cost of its dstates and
faults. Clingo assigns a name, which stands for a dstate, to each step that it gets (faulty.lp). Of
a long trace it gets only some steps, the *given* steps. Fewer steps are fewer constraints. So the
least cost for the given steps is a lower bound for the whole trace. If a map of the whole trace
costs as much, it is minimal. If not, clingo gets more steps.

*Names.* Each view has some names and a *rest*. The rest is one name for all other dstates of the
view. A rest costs one dstate, and no axiom constrains the steps that have this name. So a minimal
answer without rests would also be minimal if there were more names. If an answer uses a rest, its
view gets more names. At first a misread step is *lost*: it has no dstate, so no link leads to or
from it. If a minimal answer loses a step, the step becomes *full*: it may be at any dstate.

*Maps.* A Viterbi pass explains the whole trace by the links of an answer, with the cheapest faults
(Viterbi 1967). Actions without a link get one to where the labels go most often, and the pass is
repeated. The explanation is a map of the whole trace, so it may be the new incumbent. Clingo begins
with the first steps, and gets the steps at fault and those around them.

>>> seen = [t % 4 for t in range(60)]
>>> seen[30] = 0
>>> explainer = Explainer(seen, [0] * 59, {"misread": [15] * 60})
>>> found = explainer.completed(PartialMachine([0, 1, 2, 3], {(0, 0): 1, (1, 0): 2, (2, 0): 3}))
>>> found.machine.goes[3, 0], found.misread, found.slips, found.tenths
(0, (30,), (), 55)

*Blocks.* If clingo does not end soon, the lower bound of a long trace comes from disjoint blocks of
its steps. Take a map of the
whole trace with N dstates. Restricted to a block of steps, it is a map of that block with at most N
dstates. So its faults in the block cost at least as much as the cheapest faults of any map of the
block with at most N dstates. Blocks that share no step add up:

    cost  >=  least over N of  (10 N + sum over blocks of the least faults with N dstates)

The blocks may differ for each N. A block needs a fault if it would otherwise contain a clique of
more than N steps. A clique is a set of steps that are pairwise different dstates
(`steps/apart.py`).
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from operator import itemgetter

import clingo
import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.runtime.limits import Watch
from ssh_abduction.solution.values import Found
from ssh_abduction.solver.asp import facts
from ssh_abduction.solver.asp.control import Asker, new_control
from ssh_abduction.solver.asp.facts import number_symbols, read_atom
from ssh_abduction.solver.sources.exact.engine import Task, in_fixed_order
from ssh_abduction.solver.steps.apart import Continuations
from ssh_abduction.theory.evidence import Equality

FIRST = 64  # clingo begins with this many steps
# From this many steps on, blocks may give a bound. Clingo gets at most so many steps at once.
LONG = 1000
# If clingo has not ended after this many conflicts, blocks may give a bound, and clingo gets more
# steps. Each time it may take twice as many.
PATIENCE = 2000
PLACES = 12  # after a Viterbi pass, clingo gets the steps around at most this many faults
AROUND = 8  # clingo gets this many steps before and after a step that a map does not predict
NAMES = 3  # names of each view at first
MORE_NAMES = 2  # names added to a view whose rest is used
NEVER = 1_000_000  # the cost of a forbidden fault
UNKNOWN = 0.5  # the cost of an unknown link, in tenths of dstates: less than any fault


class FaultyEngine:
    """The engine for the causal theory with faults. It minimises dstates and faults together."""

    def __init__(self, task: Task) -> None:
        self.asker = Asker(task.watch)
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
        self._control = FaultyControl(task, self.asker, self._price, self._raise_bound)

    def next_size(self, failed: int) -> int:
        return len(self._task.trace)

    def grow(self, size: int) -> None:
        """Take the whole trace as the prefix. Clingo gets only its first steps for now."""
        if size != self.size:
            self.size = size
            self._control.given = set(range(min(size, FIRST)))
            for t, others in self._task.log.pairs.one.items():
                self._control.given |= {t, *others}
                self._control.full |= {t, *others}  # these equalities hold even for misread steps

    def improving_maps(self, most: tuple[int, ...] = ()) -> Iterator[Found]:
        self._best = self._known = None
        patience = PATIENCE
        while self._best is None or self._best > (self.bound or 0):
            # 1. Explain the whole trace by each answer for the given steps.
            answer, doubted = None, list[int]()
            mode = f"opt,{self._best - 1}" if self._best else "opt"
            for answer in self._control.answers(mode, patience):
                explained, doubted = self._explained(answer)
                if explained is not None and self._is_better(explained):
                    yield explained
            # 2. An answer for all steps is a minimal map.
            if self._control.is_done:
                self._raise_bound([self._best or 0 if answer is None else answer.cost])
                if answer is None:
                    return
                if self._control.has_all and not answer.is_open:
                    if self._is_better(found := self._found_in(answer)):
                        yield found
                    return
            else:
                patience *= 2
                self._bound_by_blocks()
            # 3. Otherwise clingo gets more steps.
            if answer is not None:
                self._control.learn_from(answer)
                if doubted:
                    self._control.give_around(doubted)
                elif not answer.is_open:
                    self._control.give_all()

    def _is_better(self, found: Found) -> bool:
        """Make a map the incumbent if it costs less. Return whether it does."""
        cost = found.cost[0]
        if self._best is not None and cost >= self._best:
            return False
        self._best, self._known = cost, found.map
        return True

    def _bound_by_blocks(self) -> None:
        """Raise the bound by blocks of a long trace, up to the cost of the incumbent."""
        if self.size >= LONG and self._best is not None:
            blocks = Blocks(self._seen, self._actions, self._price, self.asker.watch)
            self._raise_bound([blocks.bound(self._best)])

    def maps_of_cost(self, cost: tuple[int, ...], enough: int) -> Iterator[Found]:
        given = set()
        if self._known is not None and self._best == cost[0]:
            given.add(self._known)
            yield Found.of(self._known, self._task.theory)
        self._control.give_all()
        while True:
            found: list[Found] = []
            for answer in self._control.answers_of_cost(cost[0], enough):
                if answer.is_open:
                    self._control.learn_from(answer)
                    break
                found.append(self._found_in(answer))
            else:
                yield from (one for one in found if one.map not in given)
                return

    def forbid(self, equalities: Collection[Equality]) -> bool:
        self._control.forbidden.append(in_fixed_order(equalities))
        self._control.give_around(
            [step for equality in equalities for step in (equality.first, equality.second)]
        )
        return True

    def _raise_bound(self, bound: Sequence[int]) -> None:
        """Take over a bound that clingo proved. A bound for the given steps holds for all steps."""
        if bound:
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

    def _explained(self, answer: FaultyAnswer) -> tuple[Found | None, list[int]]:
        """Explain the whole trace by the dstates and links of an answer, with the cheapest faults.

        Returns the map (None if it is not allowed), and up to PLACES steps to give to clingo next:
        those with a fault, or with an action without a link.
        """
        _, machine = self._machine(answer)
        if not machine.shows:  # all given steps are lost
            return None, []
        explained = self._explainer.explained(machine)
        doubted = sorted({*explained.unknown, *explained.faults} - self._control.given)
        return self._map_of(self._explainer.completed(machine)), doubted[:PLACES]

    def _map_of(self, explained: Explained) -> Found | None:
        """Make a map of an explanation of the trace, with its cost.

        Returns None if its faults are not allowed, if all steps of a dstate are misread, or if the
        map contradicts evidence about pairs of steps or has a forbidden set of equalities.
        """
        labels, shows = explained.labels, explained.machine.shows
        kinds = {"misread": explained.misread, "slipped": explained.slips}
        shown = {s for t, s in enumerate(labels) if shows[s] == self._seen[t]}
        if (
            any(steps and kind not in self._price for kind, steps in kinds.items())
            or set(labels) - shown
            or any(
                all(labels[one.first] == labels[one.second] for one in together)
                for together in self._control.forbidden
            )
            or self._task.log.pairs.broken_by(labels)
        ):
            return None
        return self._found(labels, explained.slips, shows)

    def _found_in(self, answer: FaultyAnswer) -> Found:
        """Make a map from an answer for all steps."""
        number, machine = self._machine(answer)
        labels = [number[answer.where[t]] for t in range(self.size)]
        return self._found(labels, answer.slips, machine.shows)

    def _found(self, labels: Sequence[int], slips: Collection[int], shows: Sequence[int]) -> Found:
        """Make a map of the whole trace, with its cost. `shows` has the view of each dstate."""
        shown = list(shows)
        # If all steps at a dstate are misread, its view is their usual one.
        for s in set(labels) - {s for t, s in enumerate(labels) if shown[s] == self._seen[t]}:
            at = Counter(self._seen[t] for t, label in enumerate(labels) if label == s)
            shown[s] = at.most_common(1)[0][0]
        misread = [t for t in range(self.size) if shown[labels[t]] != self._seen[t]]
        faults = [*((t, "misread") for t in misread), *((t, "slipped") for t in slips)]
        trace, theory = self._task.trace, self._task.theory
        return Found.of(facts.causal_map(labels, trace, faults, theory), theory)


@dataclass(frozen=True)
class FaultyAnswer:
    """An answer of clingo for the given steps.

    Attributes:
        cost: The cost of dstates and faults, in tenths of dstates.
        where: The name of the dstate of each given step that is not lost.
        slips: The given steps whose action slipped.
        lost: The given steps that are misread and at no dstate.
        rests: The views, as integers, whose rest (dstates without a name) is used.
    """

    cost: int
    where: Mapping[int, int]
    slips: frozenset[int]
    lost: frozenset[int]
    rests: frozenset[int]

    @property
    def is_open(self) -> bool:
        """Whether the answer is not a map yet: some dstate has no name, or some step no dstate."""
        return bool(self.rests or self.lost)


class FaultyControl:
    """Asks clingo for answers for the given steps.

    Changes of the attributes take effect with the next question.

    Attributes:
        names: The number of names of each view, not counting its rest.
        given: The steps that clingo gets.
        full: The steps that may be at any dstate, even if their view is misread.
        forbidden: Sets of equalities of steps. In no answer do all equalities of one set hold.
        is_done: Whether the last question was answered, before a limit of conflicts.
    """

    def __init__(
        self,
        task: Task,
        asker: Asker,
        price: Mapping[str, Sequence[int]],
        on_bound: Callable[[Sequence[int]], None],
    ) -> None:
        """Begin without any given step.

        `price` has, for each kind of fault, its cost at each step in tenths of dstates. `on_bound`
        is called with each bound that clingo proves.
        """
        self.names = dict.fromkeys(range(max(task.log.seen) + 1), NAMES)
        self.given: set[int] = set()
        self.full: set[int] = set()
        self.forbidden: list[Collection[Equality]] = []
        self._asker, self._log = asker, task.log
        self._price, self._on_bound = price, on_bound
        # What the present control was given: names and full steps, steps in their order, batches,
        # and the number of forbidden sets.
        self._began: tuple[dict[int, int], set[int]] = {}, set()
        self._steps: list[int] = []
        self._batches = self._ruled_out = 0
        self.is_done = True

    @property
    def has_all(self) -> bool:
        """Whether clingo gets all steps."""
        return len(self.given) == len(self._log.seen)

    def give_around(self, steps: Collection[int]) -> None:
        """Add these steps, and `AROUND` steps before and after each, to the given ones."""
        size = len(self._log.seen)
        for step in steps:
            self.given |= set(range(max(step - AROUND, 0), min(step + AROUND + 1, size)))

    def give_all(self) -> None:
        """Give clingo all steps."""
        self.given = set(range(len(self._log.seen)))

    def learn_from(self, answer: FaultyAnswer) -> None:
        """Add names for views whose rest an answer uses. Its misread steps may have any name."""
        if answer.rests:
            names = set(answer.where.values())
            used = Counter(view for name, view in faulty_names(self.names) if name in names)
            # A view whose names are all used gets one more, as it may soon need it.
            for view in self.names:
                self.names[view] += (
                    MORE_NAMES if view in answer.rests else used[view] == self.names[view]
                )
        self.full |= answer.lost

    def _prepare(self) -> None:
        """Bring the control up to date. Make a new one if names or full steps have changed."""
        with self._asker.grounding_timed():
            if self._began != (self.names, self.full):
                self._began = dict(self.names), set(self.full)
                self._steps, self._batches, self._ruled_out = [], 0, 0
                check = self._asker.watch.check
                self._asker.control = new_control(
                    "faulty", self._base(), ("--opt-strategy=usc,stratify",), check
                )
            control, new = self._asker.control, sorted(self.given.difference(self._steps))
            for start in range(0, len(new), LONG):
                self._asker.watch.check()
                self._give(new[start : start + LONG])
            for equalities in self.forbidden[self._ruled_out :]:
                one = (f"is({e.first},S{k}), is({e.second},S{k})" for k, e in enumerate(equalities))
                control.tell(f":- {', '.join(one)}.")
            self._ruled_out = len(self.forbidden)

    def _base(self) -> str:
        """Return the facts for the names of each view, the actions and the kinds of faults."""
        found = [f"action({action})." for action in sorted(set(self._log.actions))]
        found += [f"allowed({kind})." for kind in self._price]
        for view, some in groupby(faulty_names(self.names), key=itemgetter(1)):
            of_view = [name for name, _ in some]
            found += [f"view({name},{view})." for name in of_view]
            found += [f"after({before},{name})." for before, name in pairwise(of_view)]
            found.append(f"rest({of_view[-1]}).")
        return "\n".join(found)

    def _give(self, new: list[int]) -> None:
        """Ground the rules for new steps, as one batch."""
        control, batch, log = self._asker.control, self._batches, self._log
        given, added = {*self._steps, *new}, set(new)
        found = [f"node({batch},{t},{log.seen[t]})." for t in new]
        found += [f"full({t})." for t in new if t in self.full]
        found += [f"next({batch},{t},{u})." for t, u in pairwise([*self._steps[-1:], *new])]
        links = sorted(t for t in {t - d for t in new for d in (0, 1)} if given >= {t, t + 1})
        found += [f"link({batch},{t},{log.actions[t]},{t + 1})." for t in links]
        for kind, tenths in self._price.items():
            steps = new if kind == "misread" else links
            found += [f"price({kind},{t},{tenths[t]})." for t in steps]
        for name, pairs in (("excluded", log.pairs.apart), ("one", log.pairs.one)):
            found += [
                f"{name}({batch},{i},{t})."
                for t in given
                for i in pairs.get(t, ())
                if i in given and (i in added or t in added)
            ]
        control.add(f"batch_{batch}", [], "\n".join(found))
        control.ground([(f"batch_{batch}", []), ("more", number_symbols(batch))])
        self._steps += new
        self._batches += 1

    def answers(self, mode: str, conflicts: int) -> Iterator[FaultyAnswer]:
        """Yield answers, each cheaper than the one before. If `is_done`, the last one is minimal.

        Clingo ends after some conflicts.
        """
        self._prepare()
        self.is_done = yield from self._asker.answers(
            self._read, mode, 0, conflicts=conflicts, on_bound=self._on_bound
        )

    def answers_of_cost(self, cost: int, enough: int) -> Iterator[FaultyAnswer]:
        """Yield answers of the least cost, in tenths of dstates; at most `enough`, or all if 0."""
        self._prepare()
        seen: set[tuple[frozenset[tuple[int, int]], frozenset[int]]] = set()
        # The bound of a long trace comes from blocks. Clingo may not be able to prove it.
        mode = f"optN,{cost}" if len(self._log.seen) < LONG else f"enum,{cost}"
        for answer in self._asker.answers(self._read, mode, 0):
            key = frozenset(answer.where.items()), answer.slips
            if answer.cost == cost and key not in seen:
                seen.add(key)
                yield answer
                if len(seen) == enough:
                    return

    def _read(self, model: clingo.Model) -> FaultyAnswer:
        """Read an answer of clingo."""
        where: dict[int, int] = {}
        steps: dict[str, set[int]] = {"slips": set(), "lost": set()}
        for name, args in map(read_atom, model.symbols(shown=True)):
            if name == "is":
                where[args[0]] = args[1]
            else:
                steps[name].add(args[0])
        rest_of = {view: name for name, view in faulty_names(self.names)}  # the last name
        used = set(where.values())
        rests = frozenset(view for view, rest in rest_of.items() if rest in used)
        slips, lost = (frozenset(steps[name]) for name in ("slips", "lost"))
        return FaultyAnswer(model.cost[0] if model.cost else 0, where, slips, lost, rests)


def faulty_names(names: Mapping[int, int]) -> Iterator[tuple[int, int]]:
    """Yield all names, each with its view. The last name of each view is its rest: it stands for
    all further dstates with that view.

    `names` has, for each view, the number of its names without the rest.
    """
    first = 0
    for view, count in names.items():
        yield from ((name, view) for name in range(first, first + count + 1))
        first += count + 1


@dataclass
class Blocks:
    """Lower bounds on the cost of a trace.

    Attributes:
        seen: The observation at each step, as an integer.
        actions: The action after each step but the last, as an integer.
        price: For each kind of fault that is allowed, its cost at each step in tenths of dstates.
        watch: The limits of the search.
    """

    seen: Sequence[int]
    actions: Sequence[int]
    price: Mapping[str, Sequence[int]]
    watch: Watch

    def bound(self, cost: int) -> int:
        """Return a lower bound on the cost of all maps, in tenths; at most `cost`."""
        bound = cost
        most = -(-bound // 10) - 1  # the dstates of a larger map alone cost this bound
        while most > 0:
            least = self.least_faults(most)
            bound = min(bound, 10 * most + least)
            # With fewer dstates faults cost at least as much. So skip all numbers of dstates that,
            # with the cost of these faults, already reach the bound.
            most = min(most, -(-(bound - least) // 10)) - 1
        return bound

    def least_faults(self, most: int) -> int:
        """Return a lower bound, in tenths, on the faults of maps with at most `most` dstates.

        The trace is divided into blocks from its first step on. Each block ends as soon as it needs
        a fault. The least costs of the faults of all blocks are added up.
        """
        total = begin = 0
        while (end := self._shortest(begin, most)) is not None:
            total += min(
                min(price[begin : end - (kind == "slipped")]) for kind, price in self.price.items()
            )
            begin = end
        return total

    def _shortest(self, begin: int, most: int) -> int | None:
        """Return the end of the shortest block from `begin` on that needs a fault.

        The end is the step after the block. Returns None if even the block to the end of the trace
        needs no fault.
        """

        def takes_fault(end: int) -> bool:
            """Whether more than `most` of the steps of a block differ pairwise."""
            self.watch.check()
            seen, actions = self.seen[begin:end], self.actions[begin : end - 1]
            return end - begin > most and len(Continuations(seen, actions).clique()) > most

        steps = len(self.seen)
        low, stride = begin + most, 1
        high = min(low + 1, steps)
        while not takes_fault(high):
            if high == steps:
                return None
            low, high, stride = high, min(high + stride, steps), 2 * stride
        return low + 1 + bisect_left(range(low + 1, high), True, key=takes_fault)


@dataclass(frozen=True)
class PartialMachine:
    """Dstates with their views, and links. An action at a dstate need not have a link.

    Attributes:
        shows: The view of each dstate.
        goes: For each (dstate, action) with a link, the dstate that it leads to.
    """

    shows: Sequence[int]
    goes: Mapping[tuple[int, int], int]


@dataclass(frozen=True)
class Explained:
    """An explanation of a trace by a machine: labels, and the faults that they imply.

    Attributes:
        misread: The steps whose views are treated as wrong.
        slips: The steps whose actions are treated as wrong.
        unknown: The steps whose actions have no link in the machine.
        tenths: The cost of dstates and faults, in tenths of dstates.
    """

    machine: PartialMachine
    labels: Sequence[int]
    misread: Sequence[int]
    slips: Sequence[int]
    unknown: Sequence[int]
    tenths: int

    @property
    def faults(self) -> Sequence[int]:
        return (*self.misread, *self.slips)


@dataclass(frozen=True)
class Explainer:
    """Explains a trace by machines with the cheapest faults, and improves machines.

    Attributes:
        seen: The view of each step, numbered from 0.
        actions: The action after each step but the last, numbered from 0.
        price: For each allowed kind of fault ("misread", "slipped"), its cost at each step, in
            tenths of dstates.
    """

    seen: Sequence[int]
    actions: Sequence[int]
    price: Mapping[str, Sequence[int]]

    def explained(self, machine: PartialMachine) -> Explained:
        """Find the labels with the cheapest faults for a machine, by a Viterbi pass.

        An action without a link may lead to any dstate.
        """
        steps, count = len(self.seen), len(machine.shows)
        slip, misread = (
            np.array(self.price.get(kind, [NEVER] * steps), dtype=float)
            for kind in ("slipped", "misread")
        )
        known = np.zeros((max(self.actions, default=0) + 1, count), dtype=bool)
        target = np.zeros(known.shape, dtype=int)
        for (s, action), x in machine.goes.items():
            known[action, s], target[action, s] = True, x
        wrong = np.array(machine.shows)[None, :] != np.arange(max(self.seen) + 1)[:, None]
        free = [np.flatnonzero(~row) for row in known]
        led = [np.flatnonzero(row) for row in known]
        spent = wrong[self.seen[0]] * misread[0]
        came = np.zeros((steps, count), dtype=np.int32)
        for t in range(1, steps):
            if t % 500 == 0:
                look_at_clock()
            action = self.actions[t - 1]
            # There are three ways to reach a dstate: by a slip from the cheapest dstate, from the
            # cheapest dstate without a link for this action, or by a link.
            cheapest = int(spent.argmin())
            now = np.full(count, spent[cheapest] + slip[t - 1])
            came[t] = cheapest
            if len(free[action]):
                begin = int(free[action][spent[free[action]].argmin()])
                better = spent[begin] + UNKNOWN < now
                came[t][better], now[better] = begin, spent[begin] + UNKNOWN
            # If several links lead to one dstate, the cheapest one is written last.
            order = led[action][np.argsort(-spent[led[action]], kind="stable")]
            best = np.full(count, np.inf)
            source = np.zeros(count, dtype=np.int32)
            best[target[action, order]], source[target[action, order]] = spent[order], order
            better = best <= now
            came[t][better], now[better] = source[better], best[better]
            spent = now + wrong[self.seen[t]] * misread[t]
        return self._explained(machine, _traced_back(int(spent.argmin()), came))

    def completed(self, machine: PartialMachine) -> Explained:
        """Add links to a machine until no step of the trace lacks one, and explain the trace by it.

        An action without a link gets one to the dstate that follows most often in the labels.
        """
        explained = self.explained(machine)
        while explained.unknown:
            votes: dict[tuple[int, int], Counter[int]] = {}
            for t in explained.unknown:
                votes.setdefault((explained.labels[t], self.actions[t]), Counter())[
                    explained.labels[t + 1]
                ] += 1
            led = {key: counts.most_common(1)[0][0] for key, counts in votes.items()}
            machine = PartialMachine(machine.shows, {**machine.goes, **led})
            explained = self.explained(machine)
        return explained

    def _explained(self, machine: PartialMachine, labels: Sequence[int]) -> Explained:
        """Make an explanation of given labels: find their faults, and add up the cost."""
        # A step is at fault if its view, or where its action leads, differs from the machine.
        misread = [t for t, s in enumerate(labels) if machine.shows[s] != self.seen[t]]
        leads = [
            machine.goes.get((s, action)) for s, action in zip(labels, self.actions, strict=False)
        ]
        unknown = [t for t, x in enumerate(leads) if x is None]
        slips = [t for t, x in enumerate(leads) if x is not None and x != labels[t + 1]]
        paid = sum(self._cost("misread", t) for t in misread) + sum(
            self._cost("slipped", t) for t in slips
        )
        return Explained(
            machine,
            labels,
            tuple(misread),
            tuple(slips),
            tuple(unknown),
            10 * len(set(labels)) + paid,
        )

    def _cost(self, kind: str, step: int) -> int:
        """Return the cost of a fault in tenths of dstates; `NEVER` if the kind is not allowed."""
        return self.price[kind][step] if kind in self.price else NEVER


def _traced_back(last: int, came: NDArray[np.int32]) -> list[int]:
    """List the states of all steps. `came` has the state before each state, (steps, states)."""
    states = [last]
    for before in came[:0:-1]:
        states.append(int(before[states[-1]]))
    return states[::-1]
