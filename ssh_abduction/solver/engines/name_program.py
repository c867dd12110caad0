"""Asks clingo about named dstates (names.lp), for the engines without frames.

Clingo is given only some links of the trace at first, and more if an answer needs them. That is a
relaxation, so a proven bound holds for the trace. An answer is followed along the trace
(`NameProgram.follow`): if it explains each link, it is a map.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeAlias

import clingo
import numpy as np
from numpy.typing import NDArray

from ssh_abduction.solver.asp.control import Asker, new_control
from ssh_abduction.solver.asp.facts import names_lp
from ssh_abduction.solver.asp.facts.atoms import numbers
from ssh_abduction.solver.engines.base import Task
from ssh_abduction.solver.engines.nearby import AT_A_TIME, SECONDS_A_CHARACTER
from ssh_abduction.solver.engines.pinned import Pinned
from ssh_abduction.solver.steps.chart import Chart, Link

# After grounding, clingo prepares to solve for about this share of the time that grounding took.
# It cannot be stopped meanwhile.
PREPARING = 0.6
# Of a long trace, give clingo this many more links at a time; of others all that are left.
MORE_LINKS = 1000

# Links that were followed since the last node that clingo named, the latest first.
_Trail: TypeAlias = "tuple[Link, _Trail] | None"


class Fitting(Protocol):
    """Demands on labels beyond the causal theory (`engines/frameless.py`)."""

    def fits(self, labels: Sequence[int]) -> bool:
        """Whether these labels of a causal map have a map with the demands."""
        ...

    def forbid(self, labels: Sequence[int]) -> None:
        """Forbid the reason why these labels have no map."""
        ...

    def tell_again(self) -> None:
        """Give a new control the rules of the one before."""
        ...


@dataclass
class _Known:
    """What one control knows.

    Attributes:
        spare: The spare names of each view; the last one is the rest.
        choices: For each node, the names that it may be at.
        is_open: Whether some given node is not pinned.
        links: The links that were given.
        nodes: The nodes that were given.
        last: For each view, the last node given that has a choice.
        batches: The number of batches given.
    """

    spare: dict[int, list[int]]
    choices: list[Sequence[int]]
    is_open: NDArray[np.bool_]
    links: dict[Link, None] = field(default_factory=dict)
    nodes: set[int] = field(default_factory=set)
    last: dict[int, int] = field(default_factory=dict)
    batches: int = 0


class NameProgram:
    """The control that names dstates, and what it was given.

    Attributes:
        pinned: The nodes, their links, and the nodes that have names of their own.
        forbidden: Sets of pairs of nodes. In each set, some pair is not one dstate.
    """

    def __init__(
        self,
        task: Task,
        asker: Asker,
        pinned: Pinned,
        spares: dict[int, int],
        forbidden: list[list[tuple[int, int]]],
        *,
        fitting: Fitting | None,
        check_ahead: Callable[[float], None],
    ) -> None:
        """Make a control that has the names, and no node yet.

        Args:
            task: The trace and the speed-ups that are on.
            asker: It asks the control.
            pinned: The nodes and links.
            spares: The number of spare names of each view, besides the rest.
            forbidden: See the attribute.
            fitting: Further demands on labels; None in the causal theory.
            check_ahead: Raises LimitError if there is no time for this many seconds of work that
                cannot be interrupted.
        """
        self.pinned, self.forbidden = pinned, forbidden
        self._task, self._asker, self._fitting = task, asker, fitting
        self._spares, self._check_ahead = spares, check_ahead
        self._known = self._new_control()

    @property
    def chart(self) -> Chart:
        """The nodes and links of the first steps."""
        return self.pinned.chart

    @property
    def has_all_links(self) -> bool:
        """Whether clingo was given all links."""
        return len(self._known.links) == len(self.chart.links)

    @property
    def links_given(self) -> int:
        """How many links clingo was given."""
        return len(self._known.links)

    def tell_all(self, links: Iterable[Link]) -> None:
        """Give a new control these links, and all that is forbidden."""
        self.add(links)
        for number in range(len(self.forbidden)):
            self.tell_forbidden(number)
        if self._fitting:
            self._fitting.tell_again()

    def name_more(self, views: Collection[int]) -> None:
        """Add a spare name to each of these views. This makes a new control."""
        for view in views:
            self._spares[view] += 1
        self._asker.watch.check()
        links = self._known.links
        self._known = self._new_control()
        self.tell_all(links)

    def _new_control(self) -> _Known:
        """Make a control that has the names, and no node yet."""
        with self._asker.grounding_timed():
            seen, clique = self.chart.seen, self.pinned.clique
            names = [(name, seen[node]) for name, node in enumerate(clique)]
            spare: dict[int, list[int]] = {}
            for view, count in self._spares.items():
                spare[view] = list(range(len(names), len(names) + count + 1))
                names += [(name, view) for name in spare[view]]
            # A node of the clique has no choice; others also choose among the spare names.
            choices = [
                options
                if len(options) == 1 and t == clique[options[0]]
                else [*options, *spare[seen[t]]]
                for t, options in enumerate(self.pinned.may_be)
            ]
            cores = ["--opt-strategy=usc"] if self._task.speedups.core_guided else []
            base = names_lp.name_facts(names, spare.values(), self.chart.links, choices)
            self._check_ahead(SECONDS_A_CHARACTER * len(base))
            self._asker.control = new_control("names", base, ["--eq=1", *cores])
            return _Known(spare, choices, np.zeros(len(seen), dtype=bool))

    def add(self, links: Iterable[Link]) -> None:
        """Give clingo more links, and the nodes at their ends.

        Give some at a time, as clingo cannot be stopped meanwhile.
        """
        added, before = list(links), self._asker.ground_seconds
        for start in range(0, len(added), AT_A_TIME):
            self._asker.watch.check()
            with self._asker.grounding_timed():
                self._give(added[start : start + AT_A_TIME])
        self._check_ahead(PREPARING * (self._asker.ground_seconds - before))

    def add_links_at(self, nodes: Collection[int]) -> None:
        """Give clingo the links to and from these nodes, unless it has them."""
        self.add(
            link
            for link in self.chart.links
            if link not in self._known.links and not {link[0], link[2]}.isdisjoint(nodes)
        )

    def more_links(self) -> list[Link]:
        """Links that clingo lacks: all of them, or some if the trace is long.

        Links whose ends have the fewest possible names come first.
        """
        known = self._known
        left = [link for link in self.chart.links if link not in known.links]
        if not self.pinned.is_long:
            return left
        return sorted(
            left, key=lambda link: len(known.choices[link[0]]) * len(known.choices[link[2]])
        )[:MORE_LINKS]

    def _give(self, links: Iterable[Link]) -> None:
        """Give clingo one batch of links, and the nodes at their ends."""
        known = self._known
        added = [link for link in links if link not in known.links]
        given: list[tuple[int, int, Sequence[int], int | None]] = []
        far: list[tuple[int, int]] = []
        for t in (end for s, _, x in added for end in (s, x)):
            if t in known.nodes:
                continue
            known.nodes.add(t)
            view = self.chart.seen[t]
            given.append((t, view, known.choices[t], known.last.get(view)))
            if len(known.choices[t]) > 1:
                known.last[view] = t
                if self.chart.excluded:
                    excluded = self.chart.continuations.excluded_from(t) & known.is_open
                    far += [(t, int(u)) for u in np.flatnonzero(excluded)]
                known.is_open[t] = True
        known.links.update(dict.fromkeys(added))
        self.tell(f"batch_{known.batches}", names_lp.batch_facts(known.batches, given, added, far))
        self._asker.control.ground([("more", numbers(known.batches))])
        known.batches += 1

    def tell(self, part: str, rules: str) -> None:
        """Give clingo rules in a program part of this name."""
        self._asker.control.add(part, [], rules)
        self._asker.control.ground([(part, [])])

    def tell_forbidden(self, number: int) -> None:
        """Give clingo the rule that the pairs of a forbidden set are not all one dstate.

        Also give it their nodes, unless it has them.
        """
        pairs = self.forbidden[number]
        self.add_links_at({step for pair in pairs for step in pair})
        self.tell(f"not_together_{number}", names_lp.not_together(number, pairs))

    def is_allowed(self, labels: Sequence[int]) -> bool:
        """Whether labels of a map agree with evidence about pairs of steps."""
        if any(all(labels[i] == labels[j] for i, j in pairs) for pairs in self.forbidden):
            return False
        return not self.chart.excluded or self.chart.is_map(labels)

    def names(self) -> dict[tuple[int, int], int]:
        """The names of dstates, without the rests, by keys that stay when names are added.

        A key is a view and a number, or -1 and a number for a pinned node.
        """
        pinned = {(-1, name): name for name in range(len(self.pinned.clique))}
        return pinned | {
            (view, i): name
            for view, spare in self._known.spare.items()
            for i, name in enumerate(spare[:-1])
        }

    def rests(self, answer: dict[int, int]) -> set[int]:
        """The views whose rest the answer uses."""
        used = set(answer.values())
        return {view for view, spare in self._known.spare.items() if spare[-1] in used}

    def resting(self, value: bool) -> tuple[clingo.Symbol, bool]:
        """The assumption that some node is at a rest, or that none is."""
        return names_lp.resting(self._known.batches - 1), value

    def reader(self) -> names_lp.NameReader:
        """A reader of answers for a control that was given all links."""
        actions = self._task.log.actions[: len(self.chart.seen) - 1]
        return names_lp.NameReader(actions, self._known.choices)

    def follow(self, answer: dict[int, int]) -> tuple[list[int], list[Link]]:
        """Follow the links of an answer from node to node.

        Returns:
            The name of each node, and the links that the answer does not explain. Clingo needs
            these links.
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
                # The action leads to two names: all links that led here may be wrong.
                failed.update(self._not_given((link, followed[t])))
                failed.update(self._not_given(followed[u]))
        failed.update(dict.fromkeys(self._links_at_excluded(labels)))
        return labels, list(failed)

    def _links_at_excluded(self, labels: Sequence[int]) -> list[Link]:
        """Links at nodes that share a label, though evidence says they are two dstates."""
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
        """The links on a trail that clingo does not know."""
        while trail is not None:
            link, trail = trail
            if link not in self._known.links:
                yield link, None
