"""The control of clingo for some steps of a trace with faults (faulty.lp).

Clingo assigns a name, which stands for a dstate, to each step. Each view has some names and a
*rest*. The rest is one name for all other dstates of the view. A rest costs one dstate, and no
axiom constrains the steps that have this name. So a minimal answer without rests would also be
minimal if there were more names. If an answer uses a rest, its view gets more names.

At first a misread step is *lost*: it has no dstate, so no link leads to or from it. If a minimal
answer loses a step, the step becomes *full*: it may be at any dstate.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby, pairwise
from operator import itemgetter

import clingo
from clingo import Model

from ssh_abduction.solver.asp.control import Asker, new_control
from ssh_abduction.solver.asp.facts import number_symbols, read_atom
from ssh_abduction.solver.sources.exact.engine import Task
from ssh_abduction.theory.evidence import Equality, Pairs

LONG = 1000  # from this many steps on, blocks give the bound before clingo is asked
AROUND = 8  # clingo gets this many steps before and after a step that a map does not predict
NAMES = 3  # names of each view at first
MORE_NAMES = 2  # names added to a view whose rest is used
OPTIONS = ("--opt-strategy=usc,stratify",)


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


@dataclass
class _Given:
    """A record of everything that the present control was given."""

    names: dict[int, int] = field(default_factory=dict)
    full: set[int] = field(default_factory=set)
    steps: list[int] = field(default_factory=list)
    batches: int = 0
    forbidden: int = 0


class FaultyControl:
    """Asks clingo for answers for the given steps.

    Changes of the attributes take effect with the next question.

    Attributes:
        names: The number of names of each view, not counting its rest.
        full: The steps that may be at any dstate, even if their view is misread.
        forbidden: Sets of equalities of steps. In no answer do all equalities of one set hold.
    """

    def __init__(
        self,
        task: Task,
        asker: Asker,
        price: Mapping[str, Sequence[int]],
        most_faults: int | None,
        on_bound: Callable[[Sequence[int]], None],
    ) -> None:
        """Begin without any given step.

        `price` has, for each kind of fault, its cost at each step in tenths of dstates. If
        `most_faults` is given, a map may have up to this many faults, and they cost nothing.
        `on_bound` is called with each bound that clingo proves.
        """
        self.names = dict.fromkeys(range(max(task.log.seen) + 1), NAMES)
        self.given: set[int] = set()
        self.full: set[int] = set()
        self.forbidden: list[Collection[Equality]] = []
        self._asker, self._log, self._price = asker, task.log, price
        self._most_faults, self._on_bound = most_faults, on_bound
        self._given = _Given()

    def give_around(self, steps: Collection[int]) -> None:
        """Add these steps, and `AROUND` steps before and after each, to the given ones."""
        size = len(self._log.seen)
        for step in steps:
            self.given |= set(range(max(step - AROUND, 0), min(step + AROUND + 1, size)))

    def learn_from(self, answer: FaultyAnswer) -> None:
        """Add names for views whose rest an answer uses. Its misread steps may have any name."""
        if answer.rests:
            used = Counter(
                view
                for name, view in faulty_names(self.names)
                if name in set(answer.where.values())
            )
            # A view whose names are all used gets one more, as it may soon need it.
            for view in self.names:
                self.names[view] += (
                    MORE_NAMES if view in answer.rests else used[view] == self.names[view]
                )
        self.full |= answer.lost

    def _prepare(self) -> None:
        """Bring the control up to date. Make a new one if names or full steps have changed."""
        with self._asker.grounding_timed():
            if (self._given.names, self._given.full) != (self.names, self.full):
                self._begin()
            control, given = self._asker.control, self._given
            if new := sorted(self.given.difference(given.steps)):
                self._give(new)
            for number in range(given.forbidden, len(self.forbidden)):
                control.tell(not_all_one(self.forbidden[number]))
            given.forbidden = len(self.forbidden)

    def forget(self) -> None:
        """Use a new control for the next question. Clingo was stopped, and may lack rules."""
        self._given = _Given({}, set())

    def _begin(self) -> None:
        """Make a control with the present names, but without steps."""
        self._given = _Given(dict(self.names), set(self.full))
        base = faulty_base(self._log.actions, self.names, self._price)
        self._asker.control = new_control("faulty", base, OPTIONS, self._asker.watch.check)

    def _give(self, new: list[int]) -> None:
        """Ground the rules for new steps, as one batch."""
        control, given, batch = self._asker.control, self._given, self._given.batches
        seen, actions, pairs = self._log.seen, self._log.actions, self._log.pairs
        price = self._price
        if self._most_faults is not None:
            price = {kind: [0] * len(seen) for kind in self._price}
        rules = faulty_batch(batch, seen, actions, new, given.steps, pairs, price, self.full)
        control.add(f"batch_{batch}", [], rules)
        control.ground([(f"batch_{batch}", []), ("more", number_symbols(batch))])
        if self._most_faults is not None:
            control.tell(at_most_faults(self._most_faults))
        given.steps += new
        given.batches += 1

    def answers(self, mode: str) -> Iterator[FaultyAnswer]:
        """Yield answers, each cheaper than the one before. The last one is minimal."""
        self._prepare()
        yield from self._asker.answers(self._read, mode, 0, on_bound=self._on_bound)

    def answers_of_cost(self, cost: int, enough: int) -> Iterator[FaultyAnswer]:
        """Yield answers of the least cost, in tenths of dstates; at most `enough`, or all if 0."""
        self._prepare()
        seen: set[tuple[frozenset[tuple[int, int]], frozenset[int]]] = set()
        # The bound of a long trace comes from blocks. Clingo cannot prove it from the given steps.
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
        where, slips, lost = read_faulty(model)
        used = set(where.values())
        rest_of = {view: name for name, view in faulty_names(self.names)}  # the last name
        rests = frozenset(view for view, rest in rest_of.items() if rest in used)
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


def at_most_faults(most: int) -> str:
    """Return the rule that the steps given so far have at most this many faults."""
    return f":- #count {{ T,misread : misreads(T); T,slipped : slips(T) }} > {most}."


def dstates_and_faults_up_to(dstates: int, tenths: int) -> str:
    """Return rules that limit the number of dstates, and the cost of all faults in tenths."""
    faults = (
        "W,T,misread : misreads(T), price(misread,T,W); W,T,slipped : slips(T), price(slipped,T,W)"
    )
    return (
        f"#program more(b).\n:- #sum {{ {faults} }} > {tenths}.\n"
        f":- #count {{ S : used(S) }} > {dstates}."
    )


def faulty_base(actions: Iterable[int], names: Mapping[int, int], kinds: Iterable[str]) -> str:
    """Return the facts for the names of each view, the actions and the allowed kinds of faults."""
    found = [f"action({action})." for action in sorted(set(actions))]
    found += [f"allowed({kind})." for kind in kinds]
    for view, some in groupby(faulty_names(names), key=itemgetter(1)):
        of_view = [name for name, _ in some]
        found += [f"view({name},{view})." for name in of_view]
        found += [f"after({before},{name})." for before, name in pairwise(of_view)]
        found.append(f"rest({of_view[-1]}).")
    return "\n".join(found)


def faulty_batch(
    batch: int,
    seen: Sequence[int],
    actions: Sequence[int],
    steps: Sequence[int],
    known: Sequence[int],
    pairs: Pairs,
    price: Mapping[str, Sequence[int]],
    full: Collection[int] = (),
) -> str:
    """Return the facts for a batch: some further steps of a trace.

    `seen` has the view of each step, and `actions` the action after it, as numbers. `steps` are the
    steps of this batch, and `known` the steps of earlier batches, in the order in which clingo got
    them. `price` has, for each kind of fault, its cost at each step, in tenths of a dstate. At
    `full` steps an answer names the dstate even if they are misread.
    """
    given = {*known, *steps}
    new = set(steps)
    found = [f"node({batch},{t},{seen[t]})." for t in steps]
    found += [f"full({t})." for t in steps if t in full]
    found += [f"next({batch},{t},{u})." for t, u in pairwise([*known[-1:], *steps])]
    links = sorted({t for step in steps for t in (step - 1, step) if t in given and t + 1 in given})
    found += [f"link({batch},{t},{actions[t]},{t + 1})." for t in links]
    found += [
        f"price({kind},{t},{tenths[t]})."
        for kind, tenths in price.items()
        for t in (steps if kind == "misread" else links)
    ]
    for t in given:
        found += [
            f"excluded({batch},{i},{t})."
            for i in pairs.apart.get(t, ())
            if i in given and (i in new or t in new)
        ]
        found += [
            f"one({batch},{i},{t})."
            for i in pairs.one.get(t, ())
            if i in given and (i in new or t in new)
        ]
    return "\n".join(found)


def not_all_one(equalities: Collection[Equality]) -> str:
    """Return the rule that forbids maps in which all of these equalities of steps hold."""
    body = (f"is({e.first},S{k}), is({e.second},S{k})" for k, e in enumerate(equalities))
    return f":- {', '.join(body)}."


def read_faulty(model: Model) -> tuple[dict[int, int], frozenset[int], frozenset[int]]:
    """Read the dstate of each step, the slipped steps, and the misread steps without a dstate."""
    where: dict[int, int] = {}
    steps: dict[str, set[int]] = {"slips": set(), "lost": set()}
    for name, args in map(read_atom, model.symbols(shown=True)):
        if name == "is":
            where[args[0]] = args[1]
        else:
            steps[name].add(args[0])
    return where, frozenset(steps["slips"]), frozenset(steps["lost"])
