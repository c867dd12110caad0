"""Finds labels with the fewest dstates, for theories without frames.

A label is the number of the dstate of a step. This module finds labels of the first steps with the
fewest dstates, proves that none have fewer, and lists all labels with that number of dstates.

The search works with names. Clingo assigns a name, which is a dstate, to each step (names.lp).
Pairwise distinct steps, a clique (`steps/apart.py`), are *pinned*: each gets a name of its own.
Their number is a lower bound on the dstates. Pinning leaves only one way to name these dstates. Any
other step may have the name of a pinned step that it can share a dstate with, or a *spare* name of
its view. A spare name costs one dstate. Each view also has a *rest*, one name that all its other
dstates share.

*Claim.* An answer of minimal cost that uses no rest is a minimal map.
*Proof.* Name the dstates of any map. The pinned steps have their names. The other dstates get spare
names of their view, while there are any, and then the rest. These names satisfy each rule of
names.lp, as the rules say nothing about steps that are named by a rest. They use no more spare
names than the map has dstates beyond the clique. So the minimal cost of answers is a lower bound on
the cost of maps. An answer without a rest is a map of the trace with its cost. ∎
If a minimal answer uses a rest, its view gets one more spare name, and clingo is asked again.

Not every step is needed. Clingo starts with the links of the pinned steps. Fewer links are a
relaxation, so a proven bound also holds for the whole trace. Each answer is followed along the
trace, and the links that it does not explain are added, until it explains all links. If clingo does
not answer soon, it gets all links, or some at a time if the trace is long.

Clasp raises the lower bound by one for each core. A core is a set of spare names, and at least one
of them is needed. Cores are small at first, as views share no names. If that takes long in the
causal theory, steps are also merged by evidence. The search ends as soon as some map has as few
dstates as the bound.

While a map is made from one answer, clingo searches for the next.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Generator, Iterable, Iterator, Sequence
from functools import lru_cache
from itertools import count, islice, pairwise
from typing import TypeAlias

import clingo
import numpy as np
from clingo import Function, Model, Symbol

from ssh_abduction.data.groups import numbered
from ssh_abduction.runtime.clock import now
from ssh_abduction.runtime.limits import LimitError
from ssh_abduction.solver.asp import facts
from ssh_abduction.solver.asp.control import Asker, new_control
from ssh_abduction.solver.asp.facts import number_symbols
from ssh_abduction.solver.sources.exact.engine import AT_ONCE, Task
from ssh_abduction.solver.sources.exact.fitting import Member
from ssh_abduction.solver.sources.symbolic.merging import merged
from ssh_abduction.solver.steps.chart import Chart, Link
from ssh_abduction.theory import encodings
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.pairs import pairs_in

# Before clingo has all links, any answer may show that a link is missing. So hold back the maps of
# a list until it is complete. If it has this many maps, give clingo all links instead, and then
# yield each map at once.
HELD_BACK = 100
# A view has this many spare names at first: one to use, and one to show that no more are needed.
SPARES = 2
# If clingo has not ended after this many conflicts, give it more links. If it lacks links that
# matter, this mostly shows sooner.
PATIENCE = 2000
# Clingo cannot be stopped while it prepares to solve. That takes about this share of the time that
# grounding took.
PREPARING = 0.6
# Give clingo this many links at once. It cannot be stopped while it grounds them.
AT_A_TIME = 100
# Clingo cannot be stopped while it reads and grounds the facts about names. That takes at most
# about this many seconds for each character of the facts.
SECONDS_A_CHARACTER = 1e-6
# Give clingo this many more links of a long trace at a time. Of a shorter trace it gets all links
# that are left.
MORE_LINKS = 1000
# Give clingo the axioms of this many paths at once. With fewer, clingo would be asked more often.
# With more, most would not be needed.
CONTRARY = 8

# A linked list of the links that were followed since the last node that clingo named. The latest
# link comes first.
_Trail: TypeAlias = "tuple[Link, _Trail] | None"


class NamedLabels:
    """Finds labels (dstates of steps) with the fewest dstates, for the first `size` steps.

    Attributes:
        bound: A proven lower bound on the number of dstates; None if none is known.
    """

    def __init__(self, task: Task, asker: Asker, given_map: Sequence[int] = ()) -> None:
        """Begin without any steps.

        `given_map` has the dstate of each step in a map with few dstates; empty if none is known.
        """
        self.size = 0
        self.bound: int | None = None
        self.task, self._asker, self._given_map = task, asker, given_map
        self._known: list[int] | None = None  # the best known labels of all steps
        # Sets of pairs of steps. A map must not have the steps of each pair of a set at one dstate.
        self._forbidden: list[list[tuple[int, int]]] = []
        self._program: NameProgram | None = None

    @property
    def program(self) -> NameProgram:
        """The control that assigns names of dstates to steps."""
        assert self._program is not None  # `grow` comes first
        return self._program

    @property
    def chart(self) -> Chart:
        """The first steps and the links between them."""
        return self.program.chart

    def grow(self, size: int) -> bool:
        """Make the first `size` steps the prefix. Return True, as there are always labels.

        Chart the steps, pin a clique of them, and make a new control.
        """
        self.size = 0  # an error may leave this prefix incomplete
        self._known = numbered(self._given_map[:size]) or None
        program = self._program = NameProgram(self.task, self._asker, size, self._forbidden)
        self._raise_bound(len(program.clique))
        program.begin(self._given_map)
        self.size = size
        return True

    def _raise_bound(self, bound: int) -> None:
        """Take over a lower bound if it is higher."""
        self.bound = max(self.bound or 0, bound)

    def _is_settled(self) -> bool:
        """Whether the known labels have as few dstates as the lower bound."""
        return self._known is not None and len(set(self._known)) <= (self.bound or 0)

    def improving(self) -> Iterator[list[int]]:
        """Yield labels of the first steps, with ever fewer dstates. The last have the fewest."""
        if not self.chart.links:
            yield [0]
            return
        try:
            for labels in self._searched():
                if self.program.is_allowed(labels):
                    self._known = labels
                    yield labels
        except (LimitError, KeyboardInterrupt) as end:
            if self._known:
                yield self._known
            if isinstance(end, KeyboardInterrupt) or not self._is_settled():
                raise

    def _searched(self) -> Iterator[list[int]]:
        """Yield labels as `improving` does. End early if a known map has the fewest dstates.

        An answer that is no map shows what clingo lacks: names, or links.
        """
        program, pinned = self.program, len(self.program.clique)
        may_merge = (
            self.task.theory.level == "causal"
            and self.task.speedups.greedy
            and len(self.chart.seen) <= AT_ONCE
        )
        while True:
            # 1. Find the cheapest answer. If that takes long, merge steps, and give clingo more
            # links. There is no answer if what the user says contradicts the trace.
            names, proven = self._cheapest(-1 if program.has_all_links else PATIENCE)
            if not proven and may_merge:
                may_merge = False
                yield merged(self.chart, program.clique)
            if (names is None and proven) or (not proven and self._is_settled()):
                if self._known:
                    yield self._known
                return
            if names is None or not proven:
                program.add(program.more_links())
                continue
            # 2. Give clingo more names if the answer uses a rest.
            if views := program.rests(names):
                program.name_more(views)
                continue
            # 3. Give clingo the links that the answer does not explain.
            spares = sum(name >= pinned for name in set(names.values()))
            self._raise_bound(pinned + spares)
            labels, failed = program.follow(names)
            if not failed:
                yield labels
                return
            program.add(failed)

    def _cheapest(self, conflicts: int) -> tuple[dict[int, int] | None, bool]:
        """Find the best answer within a number of conflicts, and whether it is proven the best."""
        pinned = len(self.program.clique)
        answer = None
        answers = self._asker.answers(
            read_names,
            "opt",
            0,
            conflicts=conflicts,
            on_bound=lambda costs: self._raise_bound(pinned + costs[0]),
            until=self._is_settled,
        )
        while True:
            try:
                answer = next(answers)
            except StopIteration as end:
                return answer, bool(end.value)

    def take_back(self, labels: Sequence[int]) -> bool:
        """Forget labels that turned out to have no map. Return whether they came from clingo.

        Evidence about places may refuse the places of a given map.
        """
        given, self._given_map = numbered(self._given_map[: self.size]), ()
        if self._known == list(labels):
            self._known = None
        return list(labels) != given

    def give_sides(self, labels: Sequence[int], contrary: Sequence[int]) -> bool:
        """Give clingo the axioms of paths that labels contradict. Return whether any are new."""
        return self.program.give_sides(contrary)

    def forbid(self, labels: Sequence[int], clash: Sequence[Member]) -> None:
        """Exclude all labels with the links of a clash, and with these labels of its steps."""
        placed = {step for member in clash if not member.link for step in member.steps}
        self.program.add_links_at(placed)
        body = [
            *("goes({},{},{})".format(*member.link) for member in clash if member.link),
            *(f"is({step},{labels[step]})" for step in sorted(placed)),
        ]
        self._asker.control.tell(f":- {', '.join(body)}.")

    def forbid_together(self, equalities: Collection[Equality]) -> None:
        """Exclude labels in which both steps of each of these equalities are at one dstate.

        Steps at one dstate are also at one place.
        """
        self._forbidden.append([(one.first, one.second) for one in equalities])
        if self._known and not self.program.is_allowed(self._known):
            self._known = None
        self.program.give_forbidden(len(self._forbidden) - 1)

    def all_of(self, dstates: int, enough: int) -> Generator[list[int], None, None]:
        """Yield each labelling with this number of dstates once. A known labelling comes first.

        Clingo is asked for at most `enough` labellings; 0 for all. It is not asked if `enough` is 1
        and a labelling is known.
        """
        known = self._known if self._known and len(set(self._known)) == dstates else None
        if known:
            yield known
        if not known or enough != 1:
            first = numbered(known or ())
            yield from (
                labels for labels in self._listed(dstates, enough) if numbered(labels) != first
            )

    def _listed(self, dstates: int, enough: int) -> Iterator[list[int]]:
        """Yield labels with this many dstates, in the order in which clingo lists them."""
        program, spares = self.program, dstates - len(self.program.clique)
        if spares < 0:
            return
        if not program.chart.links:
            yield [0]
            return
        while True:
            # Ask this again after nodes were added, as their names may be rests.
            while not enough and self._needs_rest(spares):
                pass
            held: list[list[int]] = []
            failed: Iterable[Link] = ()
            lazy = not program.has_all_links
            try:
                for answer in self._answers_of(spares):
                    labels, failed = program.follow(answer)
                    if failed:
                        break
                    held.append(labels)
                    if enough:
                        if len(held) == enough:
                            yield from held
                            return
                    elif not lazy:
                        yield held.pop()
                    elif len(held) == HELD_BACK:
                        failed = program.chart.links
                        break
            except LimitError:
                yield from held  # these are minimal, and explain all links
                raise
            if failed:
                program.add(failed)
            elif not enough or not self._needs_rest(spares):
                yield from held
                return

    def _needs_rest(self, spares: int) -> bool:
        """Look for an answer of this cost that uses a rest. If found, add names to its views."""
        assumptions = [self.program.resting(True)]
        mode = f"enum,{spares},{spares}"
        answer = next(self._asker.answers(read_names, mode, 1, assumptions=assumptions), None)
        views = self.program.rests(answer) if answer else set()
        if views:
            self.program.name_more(views)
        return bool(views)

    def _answers_of(self, spares: int) -> Iterator[dict[int, int]]:
        """Yield all answers without rests that use this many spare names."""
        resting, mode = self.program.resting(False), f"enum,{spares},0"
        return self._asker.answers(read_names, mode, 0, assumptions=[resting], ahead=True)


class NameProgram:
    """The control that assigns names of dstates to nodes, and a record of what it was given.

    Attributes:
        chart: The first steps, as nodes, and their links.
        clique: The pinned nodes, which are pairwise distinct. They have the names 0, 1, ….
    """

    def __init__(
        self, task: Task, asker: Asker, size: int, forbidden: list[list[tuple[int, int]]]
    ) -> None:
        """Chart the first `size` steps, and pin a largest clique, or else only the first step.

        `forbidden` has sets of pairs of nodes. A map must not have the nodes of each pair of a set
        at one dstate.
        """
        self._task, self._asker, self._forbidden = task, asker, forbidden
        with asker.grounding_timed():
            self.chart = Chart.of_steps(task.log, size)
            continuations = self.chart.continuations
            self.clique = continuations.clique() if task.speedups.clique else [0]
            apart = np.stack([continuations.apart_from(step) for step in self.clique], axis=1)
            # For each node, the clique nodes with which it may share a dstate.
            self._may_be = [(~row).nonzero()[0].tolist() for row in apart]
        asker.watch.check()
        self._one = pairs_in(task.log.pairs.one)
        # The spare names of each view, the last of which is the rest, and the names of each node.
        self._spare: dict[int, list[int]] = {}
        self._choices: list[list[int]] = []
        self._sides: list[int] = []  # names for whose paths clingo has the axioms of order, sides
        # What the present control was given: links and nodes; for each view the last node that may
        # have several names; and whether clingo has a node and has to choose its name.
        self._links: dict[Link, None] = {}
        self._nodes: set[int] = set()
        self._last: dict[int, int] = {}
        self._is_open = np.zeros(size, dtype=bool)
        self._batches = 0

    @property
    def has_all_links(self) -> bool:
        """Whether clingo has all links between the nodes of the chart."""
        return len(self._links) == len(self.chart.links)

    def begin(self, given_map: Sequence[int]) -> None:
        """Make a control with the first links.

        A view has SPARES spare names, or one more than the map needs that is given.
        """
        seen = self.chart.seen
        found = Counter(dict(zip(given_map, seen, strict=False)).values())
        taken = Counter(seen[node] for node in self.clique)
        names = count(len(self.clique))
        for view in dict.fromkeys(seen):
            spares = max(SPARES, found[view] - taken[view] + 1) if given_map else SPARES
            self._spare[view] = list(islice(names, spares + 1))
        links: Iterable[Link] = self.chart.links
        if self._task.speedups.lazy:
            # Only links that begin at the first step or at a pinned one, and those at steps that
            # the user says are one dstate.
            first, said = {0, *self.clique}, {t for pair in self._one for t in pair}
            links = [link for link in links if link[0] in first or not said.isdisjoint(link[::2])]
        self._make_control(links)

    def name_more(self, views: Collection[int]) -> None:
        """Add a name for dstates to each of these views, in a new control with the same links."""
        for view in views:
            rest = max(spare[-1] for spare in self._spare.values()) + 1
            self._spare[view].append(rest)
        self._asker.watch.check()
        self._make_control(self._links)

    def _make_control(self, links: Iterable[Link]) -> None:
        """Make a control with the present names, some links, and the rules that exclude labels."""
        with self._asker.grounding_timed():
            seen = self.chart.seen
            # A node of the clique has one name. Other nodes may also have any spare name.
            self._choices = [
                options
                if len(options) == 1 and t == self.clique[options[0]]
                else [*options, *self._spare[seen[t]]]
                for t, options in enumerate(self._may_be)
            ]
            cores = ["--opt-strategy=usc"] if self._task.speedups.core_guided else []
            base = self._name_facts()
            self._asker.watch.check(SECONDS_A_CHARACTER * len(base))
            self._asker.control = new_control("names", base, ["--eq=1", *cores])
        self._links, self._nodes, self._last, self._batches = {}, set(), {}, 0
        self._is_open = np.zeros(len(seen), dtype=bool)
        self.add(links)
        for given in range(len(self._forbidden)):
            self.give_forbidden(given)
        sides, self._sides = self._sides, []
        if sides:
            self._ground_sides(sides)

    def _name_facts(self) -> str:
        """Return the facts about names, and about where actions may lead."""
        seen, choices, spares = self.chart.seen, self._choices, self._spare.values()
        view_of = {name: seen[node] for name, node in enumerate(self.clique)}
        view_of |= {name: view for view, spare in self._spare.items() for name in spare}
        rests = {spare[-1] for spare in spares}
        leads = {
            (s, action, x)
            for t, action, u in self.chart.links
            for s in choices[t]
            if s not in rests
            for x in choices[u]
        }
        found = [f"view({name},{view})." for name, view in view_of.items()]
        for spare in spares:
            found += [f"spare({name})." for name in spare]
            found += [f"after({r},{s})." for r, s in pairwise(spare)]
            found.append(f"rest({spare[-1]}).")
        found += [f"leads({s},{action},{x})." for s, action, x in leads]
        shows = {(s, action, view_of[x]) for s, action, x in leads}
        found += [f"shows({s},{action},{view})." for s, action, view in shows]
        return "\n".join(found)

    def add(self, links: Iterable[Link]) -> None:
        """Give clingo more links and the nodes at their ends, in batches. Check limits between."""
        added, began = list(links), now()
        for start in range(0, len(added), AT_A_TIME):
            self._asker.watch.check()
            with self._asker.grounding_timed():
                self._give(added[start : start + AT_A_TIME])
        self._asker.watch.check(PREPARING * (now() - began))

    def add_links_at(self, nodes: Collection[int]) -> None:
        """Give clingo all links to and from these nodes that it lacks."""
        self.add(link for link in self._missing() if not {link[0], link[2]}.isdisjoint(nodes))

    def more_links(self) -> list[Link]:
        """List links that clingo lacks: all of them, or `MORE_LINKS` if the trace is long.

        In a long trace, links whose ends have the fewest possible names come first.
        """
        left, choices = self._missing(), self._choices
        if len(self.chart.seen) <= AT_ONCE:
            return left
        return sorted(left, key=lambda link: len(choices[link[0]]) * len(choices[link[2]]))[
            :MORE_LINKS
        ]

    def _missing(self) -> list[Link]:
        """List the links that clingo lacks."""
        return [link for link in self.chart.links if link not in self._links]

    def _give(self, links: Iterable[Link]) -> None:
        """Ground one batch (portion) of links, with the steps at their ends."""
        batch, before = self._batches, set(self._nodes)
        added = [link for link in links if link not in self._links]
        found: list[str] = []
        for t in (end for s, _, x in added for end in (s, x)):
            if t in self._nodes:
                continue
            self._nodes.add(t)
            view, choices = self.chart.seen[t], self._choices[t]
            found.append(f"node({batch},{t},{view}).")
            found += [f"may_be({t},{name})." for name in choices]
            if len(choices) == 1:
                continue
            if view in self._last:
                found.append(f"follows({self._last[view]},{t}).")
            self._last[view] = t
            # Pairs that evidence excludes are given if the names of both steps are open.
            if self.chart.excluded:
                excluded = self.chart.continuations.excluded_from(t) & self._is_open
                found += [f"apart({batch},{t},{u})." for u in np.flatnonzero(excluded).tolist()]
            self._is_open[t] = True
        self._links.update(dict.fromkeys(added))
        found += [f"link({batch},{t},{action},{u})." for t, action, u in added]
        found += [
            f"one({batch},{t},{u})."
            for t, u in self._one
            if self._nodes.issuperset((t, u)) > before.issuperset((t, u))
        ]
        self._asker.control.tell("\n".join(found))
        self._asker.control.ground([("more", number_symbols(batch))])
        self._batches += 1

    def give_forbidden(self, number: int) -> None:
        """Give clingo the rule against a forbidden set of pairs, and the nodes of this set.

        It is against answers with each pair at one dstate that is not a rest.
        """
        pairs = self._forbidden[number]
        self.add_links_at({step for pair in pairs for step in pair})
        together = [f"together({number},{k})" for k in range(len(pairs))]
        rules = [
            f"{atom} :- is({i},S), is({j},S), not rest(S)."
            for atom, (i, j) in zip(together, pairs, strict=True)
        ]
        self._asker.control.tell("\n".join([*rules, f":- {', '.join(together)}."]))

    def give_sides(self, contrary: Sequence[int]) -> bool:
        """Give clingo the axioms of order and sides for the paths of some of these dstates.

        Returns whether any of them are new. The dstates are given by their names.
        """
        new = [name for name in contrary if name not in self._sides][:CONTRARY]
        if new:
            self._ground_sides(new)
        return bool(new)

    def _ground_sides(self, names: Sequence[int]) -> None:
        """Ground the axioms of order and sides for dstates, given by their names."""
        control, task = self._asker.control, self._task
        with self._asker.grounding_timed():
            parts: list[tuple[str, list[clingo.Symbol]]] = []
            if not self._sides:
                control.load(encodings.path("sides_frameless"))
                actions = dict(zip(task.log.actions, task.trace.actions, strict=True))
                kinds = [
                    f"turns({a},{action.turn})." if action.turn else f"travels({a})."
                    for a, action in actions.items()
                    if action.kind in ("travel", "turn")
                ]
                control.add("sides", [], "\n".join([*kinds, *facts.sides(task.theory)]))
                parts.append(("sides", []))
            # One call for all parts halves the time to ground and to search.
            control.ground(parts + [("path", number_symbols(name)) for name in names])
        self._sides += names

    def is_allowed(self, labels: Sequence[int]) -> bool:
        """Whether the dstates of a map agree with what is known about pairs of steps."""
        if any(all(labels[i] == labels[j] for i, j in pairs) for pairs in self._forbidden):
            return False
        if any(labels[i] != labels[t] for i, t in self._one if t < len(labels)):
            return False
        return not self.chart.excluded or self.chart.is_map(labels)

    def rests(self, answer: dict[int, int]) -> set[int]:
        """Return the views whose rest an answer uses. The answer has the name of each node."""
        used = set(answer.values())
        return {view for view, spare in self._spare.items() if spare[-1] in used}

    def resting(self, value: bool) -> tuple[Symbol, bool]:
        """Return the assumption that some node has a rest as its name (True), or none (False)."""
        return Function("resting", number_symbols(self._batches - 1)), value

    def follow(self, answer: dict[int, int]) -> tuple[list[int], list[Link]]:
        """Follow the links of an answer through all nodes of the chart.

        Returns the name of each node, -1 if it is unknown; and links that clingo lacks and should
        get next, as the answer contradicts or does not explain them. If there are none, the names
        make a map.
        """
        if self.has_all_links and not self.rests(answer):
            return [answer[node] for node in range(len(answer))], []
        goes: dict[tuple[int, int], int] = {
            (answer[t], action): answer[u] for t, action, u in self._links
        }
        labels = [-1] * len(self.chart.seen)  # -1 if the name is unknown
        followed: list[_Trail] = [None] * len(labels)
        failed: dict[Link, None] = {}
        asked: set[tuple[int, int]] = set()  # ask for one link of each name and action
        labels[0] = answer[0]
        for link in self.chart.links:
            t, action, u = link
            here, key = labels[t], (labels[t], action)
            there = None
            if t < u and labels[u] < 0:
                if here >= 0 and key not in asked:
                    trail = (link, followed[t])
                    if key not in goes:
                        failed[link] = None
                        asked.add(key)
                    elif goes[key] not in self._choices[u] or answer.get(u, goes[key]) != goes[key]:
                        failed.update(self._not_given(trail))
                    else:
                        there = goes[key]
                        followed[u] = None if u in answer else trail
                labels[u] = answer.get(u, -1) if there is None else there
            elif here >= 0 and labels[u] >= 0 and goes.setdefault(key, labels[u]) != labels[u]:
                # The action leads to two names. So any link on the two trails that lead here may be
                # wrong.
                failed.update(self._not_given((link, followed[t])))
                failed.update(self._not_given(followed[u]))
        # Clingo should also get the links at steps that share a dstate against the evidence.
        excluded = {
            node
            for pair in self.chart.excluded
            if labels[pair[0]] == labels[pair[1]] >= 0
            for node in pair
        }
        if excluded:
            at = (link for link in self._missing() if not excluded.isdisjoint(link[::2]))
            failed.update(dict.fromkeys(at))
        return labels, list(failed)

    def _not_given(self, trail: _Trail) -> Iterator[tuple[Link, None]]:
        """Yield the links of a trail (connected links) that clingo lacks, as keys of a dict."""
        while trail is not None:
            link, trail = trail
            if link not in self._links:
                yield link, None


def read_names(model: Model) -> dict[int, int]:
    """Read an answer: a dict from the steps that clingo was given to their names."""
    return dict(map(_named, model.symbols(shown=True)))


@lru_cache(maxsize=2**16)
def _named(symbol: Symbol) -> tuple[int, int]:
    """Read a step and its name from an atom. This is cached, as answers share most atoms."""
    step, name = symbol.arguments
    return step.number, name.number
