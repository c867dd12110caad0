"""The control of clingo that assigns names of dstates to steps (names.lp).

`names.py` uses it. Clingo gets only some links of the trace at first, and more if an answer needs
them. Fewer links are a relaxation, so a proven bound also holds for the whole trace.
Each answer is followed along the trace (`NameProgram.follow`). If it explains every link, it is a
map.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise
from typing import TypeAlias

import clingo
import numpy as np
from clingo import Function, Model, Symbol
from numpy.typing import NDArray

from ssh_abduction.data.action import Action
from ssh_abduction.runtime.clock import now
from ssh_abduction.solver.asp import facts
from ssh_abduction.solver.asp.control import Asker, new_control
from ssh_abduction.solver.asp.facts import number_symbols
from ssh_abduction.solver.sources.exact.engine import AT_ONCE, Task
from ssh_abduction.solver.steps.chart import Chart, Link
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory import encodings
from ssh_abduction.theory.pairs import pairs_in
from ssh_abduction.theory.theory import Theory

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


@dataclass
class _GivenNodes:
    """A record of everything that one control was given.

    Attributes:
        spare: The spare names of each view. The last one is the rest, which any number of dstates
            without a name of their own share.
        choices: For each node, the names that it may have.
        is_open: For each node, whether clingo has it and has to choose its name.
        links: The given links, as keys in the order in which they were given.
        last: For each view, the last given node that may have several names.
    """

    spare: dict[int, list[int]]
    choices: list[Sequence[int]]
    is_open: NDArray[np.bool_]
    links: dict[Link, None] = field(default_factory=dict)
    nodes: set[int] = field(default_factory=set)
    last: dict[int, int] = field(default_factory=dict)
    batches: int = 0


class NameProgram:
    """The control that assigns names of dstates to nodes, and a record of what it was given.

    Attributes:
        pinned: The nodes, their links, and the clique of nodes that have names of their own.
        forbidden: Sets of pairs of nodes. A map must not have the nodes of each pair of a set at
            one dstate.
    """

    def __init__(
        self,
        task: Task,
        asker: Asker,
        pinned: Pinned,
        spares: dict[int, int],
        forbidden: list[list[tuple[int, int]]],
    ) -> None:
        """Make a control that has the names, but no node yet.

        `spares` has the number of spare names of each view, not counting the rest.
        """
        self.pinned, self.forbidden = pinned, forbidden
        self._task, self._asker = task, asker
        self._spares = spares
        self._one = pairs_in(task.log.pairs.one)
        # Dstates for whose paths clingo has the axioms of order and sides, as keys of `names`.
        self._sides: dict[tuple[int, int], None] = {}
        self._known = self._new_control()

    @property
    def chart(self) -> Chart:
        """The nodes of the first steps and the links between them."""
        return self.pinned.chart

    @property
    def has_all_links(self) -> bool:
        """Whether clingo has all links between the nodes of the chart."""
        return len(self._known.links) == len(self.chart.links)

    def give_links(self, links: Iterable[Link]) -> None:
        """Give a new control some links, and the rules that exclude labels."""
        self.add(links)
        for number in range(len(self.forbidden)):
            self.give_forbidden(number)
        sides, self._sides = self._sides, {}
        if sides:
            self._ground_sides([key for key in self.names() if key in sides])

    def name_more(self, views: Collection[int]) -> None:
        """Add a name for dstates to each of these views, in a new control with the same links."""
        for view in views:
            self._spares[view] += 1
        self._asker.watch.check()
        links = self._known.links
        self._known = self._new_control()
        self.give_links(links)

    def _new_control(self) -> _GivenNodes:
        """Make a control that has the names, but no node yet."""
        with self._asker.grounding_timed():
            seen, clique = self.chart.seen, self.pinned.clique
            names = [(name, seen[node]) for name, node in enumerate(clique)]
            spare: dict[int, list[int]] = {}
            for view, count in self._spares.items():
                spare[view] = list(range(len(names), len(names) + count + 1))
                names += [(name, view) for name in spare[view]]
            # A node of the clique has one name. Other nodes may also have any spare name.
            choices = [
                options
                if len(options) == 1 and t == clique[options[0]]
                else [*options, *spare[seen[t]]]
                for t, options in enumerate(self.pinned.may_be)
            ]
            cores = ["--opt-strategy=usc"] if self._task.speedups.core_guided else []
            base = name_facts(names, spare.values(), self.chart.links, choices)
            self._asker.watch.check(SECONDS_A_CHARACTER * len(base))
            self._asker.control = new_control("names", base, ["--eq=1", *cores])
            return _GivenNodes(spare, choices, np.zeros(len(seen), dtype=bool))

    def add(self, links: Iterable[Link]) -> None:
        """Give clingo more links and the nodes at their ends, in batches. Check limits between."""
        added, began = list(links), now()
        for start in range(0, len(added), AT_A_TIME):
            self._asker.watch.check()
            with self._asker.grounding_timed():
                self._give(added[start : start + AT_A_TIME])
        self._asker.watch.check(PREPARING * (now() - began))

    def add_links_at(self, nodes: Collection[int]) -> None:
        """Give clingo all links to and from these steps that it lacks."""
        self.add(
            link
            for link in self.chart.links
            if link not in self._known.links and not {link[0], link[2]}.isdisjoint(nodes)
        )

    def more_links(self) -> list[Link]:
        """List links that clingo lacks: all of them, or `MORE_LINKS` if the trace is long.

        In a long trace, links whose ends have the fewest possible names come first.
        """
        known = self._known
        left = [link for link in self.chart.links if link not in known.links]
        if not self.pinned.is_long:
            return left
        return sorted(
            left, key=lambda link: len(known.choices[link[0]]) * len(known.choices[link[2]])
        )[:MORE_LINKS]

    def _give(self, links: Iterable[Link]) -> None:
        """Ground one batch (portion) of links, with the steps at their ends."""
        known = self._known
        added = [link for link in links if link not in known.links]
        given: list[tuple[int, int, Sequence[int], int | None]] = []
        far: list[tuple[int, int]] = []
        before = set(known.nodes)
        for t in (end for s, _, x in added for end in (s, x)):
            if t in known.nodes:
                continue
            known.nodes.add(t)
            view = self.chart.seen[t]
            given.append((t, view, known.choices[t], known.last.get(view)))
            # Pairs that evidence excludes are given if the names of both steps are open.
            if len(known.choices[t]) > 1:
                known.last[view] = t
                if self.chart.excluded:
                    excluded = self.chart.continuations.excluded_from(t) & known.is_open
                    far += [(t, int(u)) for u in np.flatnonzero(excluded)]
                known.is_open[t] = True
        known.links.update(dict.fromkeys(added))
        one = [pair for pair in self._one if known.nodes.issuperset(pair) > before.issuperset(pair)]
        self._asker.control.tell(batch_facts(known.batches, given, added, far, one))
        self._asker.control.ground([("more", number_symbols(known.batches))])
        known.batches += 1

    def give_forbidden(self, number: int) -> None:
        """Give clingo the rule against the set `forbidden[number]`, and the nodes of this set."""
        pairs = self.forbidden[number]
        self.add_links_at({step for pair in pairs for step in pair})
        self._asker.control.tell(not_together(number, pairs))

    def give_sides(self, contrary: Sequence[int]) -> bool:
        """Give clingo the axioms of order and sides for the paths of some of these dstates.

        Returns whether any of them are new. The dstates are given by their names.
        """
        key_of = {name: key for key, name in self.names().items()}
        keys = [key_of[name] for name in contrary if name in key_of]
        new = [key for key in keys if key not in self._sides][:CONTRARY]
        if new:
            self._ground_sides(new)
        return bool(new)

    def _ground_sides(self, keys: Sequence[tuple[int, int]]) -> None:
        """Ground the axioms of order and sides for dstates, given as keys of `names`."""
        control, names, task = self._asker.control, self.names(), self._task
        with self._asker.grounding_timed():
            parts: list[tuple[str, list[clingo.Symbol]]] = []
            if not self._sides:
                control.load(encodings.path("sides_frameless"))
                actions = dict(zip(task.log.actions, task.trace.actions, strict=True))
                control.add("sides", [], sides_facts(task.theory, actions))
                parts.append(("sides", []))
            # One call for all parts halves the time to ground and to search.
            control.ground(parts + [("path", number_symbols(names[key])) for key in keys])
        self._sides.update(dict.fromkeys(keys))

    def is_allowed(self, labels: Sequence[int]) -> bool:
        """Whether the dstates of a map agree with what is known about pairs of steps."""
        if any(all(labels[i] == labels[j] for i, j in pairs) for pairs in self.forbidden):
            return False
        if any(labels[i] != labels[t] for i, t in self._one if t < len(labels)):
            return False
        return not self.chart.excluded or self.chart.is_map(labels)

    def names(self) -> dict[tuple[int, int], int]:
        """Return a dict from keys to the names of dstates, without the rests.

        A key is (-1, number) for a pinned node, and (view, number) for a spare name. Keys stay the
        same when names are added.
        """
        pinned = {(-1, name): name for name in range(len(self.pinned.clique))}
        return pinned | {
            (view, i): name
            for view, spare in self._known.spare.items()
            for i, name in enumerate(spare[:-1])
        }

    def rests(self, answer: dict[int, int]) -> set[int]:
        """Return the views whose rest an answer uses. The answer has the name of each node."""
        used = set(answer.values())
        return {view for view, spare in self._known.spare.items() if spare[-1] in used}

    def resting(self, value: bool) -> tuple[clingo.Symbol, bool]:
        """Return the assumption that some node has a rest as its name (True), or none (False)."""
        return resting(self._known.batches - 1), value

    def follow(self, answer: dict[int, int]) -> tuple[list[int], list[Link]]:
        """Follow the links of an answer through all nodes of the chart.

        Returns the name of each node, -1 if it is unknown; and links that clingo lacks and should
        get next, as the answer contradicts or does not explain them. If there are none, the names
        make a map.
        """
        if self.has_all_links and not self.rests(answer):
            return [answer[node] for node in range(len(answer))], []
        known, choices = self._known.links, self._known.choices
        goes: dict[tuple[int, int], int] = {
            (answer[t], action): answer[u] for t, action, u in known
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
                    elif goes[key] not in choices[u] or answer.get(u, goes[key]) != goes[key]:
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
        failed.update(dict.fromkeys(self._links_at_excluded(labels)))
        return labels, list(failed)

    def _links_at_excluded(self, labels: Sequence[int]) -> list[Link]:
        """List links that clingo lacks, at steps that share a dstate against the evidence."""
        excluded = {
            node
            for pair in self.chart.excluded
            if labels[pair[0]] == labels[pair[1]] >= 0
            for node in pair
        }
        if not excluded:
            return []
        return [
            link
            for link in self.chart.links
            if link not in self._known.links and not excluded.isdisjoint(link[::2])
        ]

    def _not_given(self, trail: _Trail) -> Iterator[tuple[Link, None]]:
        """Yield the links of a trail (connected links) that clingo lacks, as keys of a dict."""
        while trail is not None:
            link, trail = trail
            if link not in self._known.links:
                yield link, None


@dataclass(frozen=True)
class Pinned:
    """A chart, and a clique of its nodes: pairwise distinct nodes, which get the names 0, 1, ….

    Attributes:
        clique: Nodes that are pairwise distinct.
        may_be: For each node, the names of those clique nodes with which it may share a dstate.
    """

    chart: Chart
    clique: Sequence[int]
    may_be: Sequence[Sequence[int]]

    @classmethod
    def of_steps(cls, log: Log, steps: int, *, largest: bool = True) -> Pinned:
        """Chart the first steps, and name a largest clique of them, or else only the first step."""
        chart = Chart.of_steps(log, steps)
        clique = chart.continuations.clique() if largest else [0]
        apart = np.stack([chart.continuations.apart_from(step) for step in clique], axis=1)
        return cls(chart, clique, [(~row).nonzero()[0].tolist() for row in apart])

    @property
    def is_long(self) -> bool:
        """Whether there are too many nodes to compare them in pairs."""
        return len(self.chart.seen) > AT_ONCE


def name_facts(
    names: Iterable[tuple[int, int]],
    spares: Collection[Sequence[int]],
    links: Iterable[tuple[int, int, int]],
    choices: Sequence[Sequence[int]],
) -> str:
    """Return the facts that hold for all batches (a batch is the nodes of one call).

    `names` are pairs of a name and its view. `spares` has the spare names of each view; the last
    one is the rest. `links` are triples of a node, an action, and the node that it leads to.
    `choices` has the names that each node can have.
    """
    view_of = dict(names)
    rests = {spare[-1] for spare in spares}
    leads = {
        (s, action, x)
        for t, action, u in links
        for s in choices[t]
        if s not in rests
        for x in choices[u]
    }
    facts = [f"view({name},{view})." for name, view in view_of.items()]
    for spare in spares:
        facts += (
            [f"spare({name})." for name in spare]
            + [f"after({r},{s})." for r, s in pairwise(spare)]
            + [f"rest({spare[-1]})."]
        )
    facts += [f"leads({s},{action},{x})." for s, action, x in leads]
    facts += [
        f"shows({s},{action},{view})."
        for s, action, view in {(s, action, view_of[x]) for s, action, x in leads}
    ]
    return "\n".join(facts)


def batch_facts(
    batch: int,
    nodes: Iterable[tuple[int, int, Sequence[int], int | None]],
    links: Iterable[tuple[int, int, int]],
    apart: Iterable[tuple[int, int]],
    one: Iterable[tuple[int, int]],
) -> str:
    """Return the facts for one batch: the nodes of one call.

    Each node has its number, its view, the names that it can have, and the last node with this view
    that clingo has already (or None). `links` are triples of a node, an action, and the node that
    the action leads to. Nodes that are `apart` are different dstates, nodes of `one` are one.
    """
    facts = []
    for t, view, names, before in nodes:
        facts.append(f"node({batch},{t},{view}).")
        facts += [f"may_be({t},{name})." for name in names]
        facts += [f"follows({before},{t})."] if before is not None and len(names) > 1 else []
    facts += [f"link({batch},{t},{action},{u})." for t, action, u in links]
    facts += [f"apart({batch},{t},{u})." for t, u in apart]
    facts += [f"one({batch},{t},{u})." for t, u in one]
    return "\n".join(facts)


def resting(batch: int) -> Symbol:
    """Return the atom "a step up to this batch is at a rest" (dstates of a view without a name)."""
    return Function("resting", number_symbols(batch))


def read_names(model: Model) -> dict[int, int]:
    """Read an answer: a dict from the steps that clingo was given to their names."""
    return dict(map(_named, model.symbols(shown=True)))


@lru_cache(maxsize=2**16)
def _named(symbol: Symbol) -> tuple[int, int]:
    """Read a step and its name from an atom. This is cached, as answers share most atoms."""
    step, name = symbol.arguments
    return step.number, name.number


def not_together(number: int, pairs: Sequence[tuple[int, int]]) -> str:
    """Return rules against answers in which each pair is at one dstate that is not a rest."""
    together = [
        f"together({number},{k}) :- is({i},S), is({j},S), not rest(S)."
        for k, (i, j) in enumerate(pairs)
    ]
    return "\n".join(
        [*together, f":- {', '.join(f'together({number},{k})' for k in range(len(pairs)))}."]
    )


def forbidden_links(
    links: Iterable[tuple[int, int, int]], placed: Iterable[tuple[int, int]] = ()
) -> str:
    """Return the rule that some links do not all hold while some steps have certain names."""
    body = [f"goes({s},{a},{x})" for s, a, x in links] + [f"is({t},{s})" for t, s in placed]
    return f":- {', '.join(body)}."


def sides_facts(theory: Theory, actions: Mapping[int, Action]) -> str:
    """Return the facts for sides_frameless.lp: kinds of actions, and the axioms about sides."""
    kinds = [
        f"turns({a},{action.turn})." if action.turn else f"travels({a})."
        for a, action in actions.items()
        if action.kind in ("travel", "turn")
    ]
    return "\n".join([*kinds, *facts.sides(theory)])
