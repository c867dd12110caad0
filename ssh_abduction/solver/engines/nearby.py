"""Finds small maps near a guess, and proves that there are none with fewer dstates.

It serves the causal theory. `NearbySearch` yields ever smaller maps. If it ends with a `bound`, the
last map is minimal.

If all steps were free to change their dstates, the search would take long. So most steps keep the
dstates of a known map, and the search tries to save one dstate. If that is impossible, clingo
returns an unsat core: a set of steps that cannot all keep their dstates. All steps at these dstates
become free. This is repeated until a dstate is saved, or is proven to be needed. If neither happens
soon, all steps in some part of the map become free at once (large neighbourhood search: Shaw 1998).
The size of parts is adapted so that each question is answered soon.

If no single dstate can be saved, all steps become free. But at first no view may have more dstates
than in the known map. Then views are allowed more dstates, one view after the other, and in the end
any number (the rest, see `engines/naming.py`). Each time clingo is asked for a map with fewer
dstates in total.

*Claim.* If there is no such map when everything is allowed, the known map is minimal.
*Proof.* `engines/naming.py` asks the same question for its bound. So its claim applies, with a cost
that is lower by one. ∎
"""

from __future__ import annotations

import random
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, TypeAlias

import clingo
import numpy as np

from ssh_abduction.solver.asp.control import Asker, new_control
from ssh_abduction.solver.asp.facts import names_lp
from ssh_abduction.solver.asp.facts.atoms import numbers
from ssh_abduction.solver.asp.limits import Watch
from ssh_abduction.solver.engines.pinned import Pinned
from ssh_abduction.solver.engines.spare_names import (
    AT_A_TIME,
    SECONDS_A_CHARACTER,
    SpareNames,
    seen_labels,
)
from ssh_abduction.solver.steps.apart import Matrix

# At first, give up a question after this many conflicts. Each round of questions doubles it.
CONFLICTS = 2000
# A question in which all steps are free may take this many times as many conflicts.
WIDE = 10
# Stop freeing parts of the map after this many parts in a row without success.
REGIONS = 40
# A part has this many dstates at first, and at least.
FIRST_REGION = 10
# A part gets this many more dstates after a proof that it needs all its dstates, and this many
# fewer after a question was given up.
LARGER, SMALLER = 2, 4
# Clingo cannot be stopped while it prepares to solve. That takes about this many times as long as
# grounding took.
PREPARING = 1.0
Labels: TypeAlias = list[int]
_Verdict: TypeAlias = Literal["moved", "needed", "open"]


class NearbySearch:
    """A search for small maps near a guess.

    Attributes:
        bound: The fewest dstates, which the last map has; None until that is proven.
    """

    def __init__(
        self,
        watch: Watch,
        pinned: Pinned,
        *,
        far: Callable[[int], Matrix] | None,
        configuration: str | None = None,
    ) -> None:
        """Prepare a search.

        Args:
            watch: The limits.
            pinned: The nodes, their links, and the clique of nodes that have names of their own.
            far: Given a node, returns a flag for each node: whether evidence excludes that the two
                are at one dstate. None if there is no such evidence.
            configuration: The name of a configuration of clasp; None for its default.
        """
        self.bound: int | None = None
        self._asker = Asker(watch)
        self._pinned, self._far = pinned, far
        self._configuration = configuration
        self._names = SpareNames({}, frozenset(), (), {}, 0)
        self._labels: Labels = []
        self._needed: set[int] = set()  # names whose dstate is proven to be needed
        # For each view whose rest was used once, the number of spare names that it needs at least.
        self._fewest: dict[int, int] = {}
        # Names that are proven not to help if they are allowed together. None until each was tried
        # alone.
        self._allowed: list[int] | None = None
        self._waiting: list[int] = []  # names that were not yet allowed together with these
        self._region = FIRST_REGION
        self._random = random.Random(0)

    def fewer(self, guess: Sequence[int], tries: int | None = None) -> Iterator[Labels]:
        """Yield the guess, or a map near it, and then maps with fewer and fewer dstates.

        Args:
            guess: The dstate of each node, -1 if it is unknown. It need not be a map.
            tries: Give up after this many rounds that neither save a dstate nor prove that all are
                needed; None to go on until there is a proof.
        """
        if known := self._pinned.chart.is_map(guess):
            yield list(guess)
        guessed = seen_labels(guess, self._pinned.chart)
        name_of = {
            guessed[node]: name for name, node in reversed(list(enumerate(self._pinned.clique)))
        }
        # The dstates of the guess that no pinned node has need spare names.
        extra = dict.fromkeys(key for key in guessed if key is not None and key not in name_of)
        counts = Counter(view for view, _ in extra)
        self._take({view: counts[view] for view in dict.fromkeys(self._pinned.chart.seen)})
        left = {view: iter(spare) for view, spare in self._names.spare.items()}
        name_of |= {key: next(left[key[0]]) for key in extra}
        self._labels = [-1 if key is None else name_of[key] for key in guessed]
        # Ask even if the guess is a map: clasp then prefers the choices of its last answer, and so
        # stays near the guess. First allow only the names of the guess, then all but the rests.
        for allowed in ((), [name for spare in self._names.spare.values() for name in spare[:-1]]):
            verdict = self._moved(
                self._not_allowed(allowed), (), WIDE * CONFLICTS, step_by_step=True
            )
            if verdict == "moved":
                break
        else:
            return
        if not known:
            yield self._labels
        conflicts, failed = CONFLICTS, 0
        while failed != tries:
            yield from self._spared(conflicts)
            answer = yield from self._widened(conflicts * WIDE)
            if answer == "needed":
                self.bound = len(set(self._labels))
                return
            if answer == "open":
                if self._allowed is None:
                    yield from self._redrawn(CONFLICTS)
                conflicts, failed = 2 * conflicts, failed + 1

    def _take(self, counts: Mapping[int, int]) -> None:
        """Make a new control with names and all links.

        Args:
            counts: For each view, a number of spare names. The view gets one more, and a rest.
        """
        began = time.perf_counter()
        seen, clique = self._pinned.chart.seen, self._pinned.clique
        names = [(name, seen[node]) for name, node in enumerate(clique)]
        spare: dict[int, range] = {}
        for view, count in counts.items():
            spare[view] = range(len(names), len(names) + count + 2)
            names += [(name, view) for name in spare[view]]
        pinned = set(clique)
        choices = [
            options if t in pinned else [*options, *spare[seen[t]]]
            for t, options in enumerate(map(list, self._pinned.may_be))
        ]
        links = self._pinned.chart.links
        base = names_lp.name_facts(names, spare.values(), links, choices, ordered=False)
        self._asker.watch.check(SECONDS_A_CHARACTER * len(base))
        self._asker.control = new_control("names", base, ["--eq=1"])
        if self._configuration:
            configuration: Any = self._asker.control.configuration
            configuration.configuration, configuration.sat_prepro = self._configuration, "no"
        used = {
            name: self._literal(names_lp.used(name)) for some in spare.values() for name in some
        }
        self._names = SpareNames(
            spare,
            frozenset(some[-1] for some in spare.values()),
            choices,
            used,
            self._literal(names_lp.ordered()),
        )
        self._give_links(pinned)
        self._asker.watch.check(PREPARING * (time.perf_counter() - began))

    def _give_links(self, pinned: Collection[int]) -> None:
        """Give a new control all links and their nodes, in batches."""
        seen, links = self._pinned.chart.seen, self._pinned.chart.links
        given: set[int] = set()
        last: dict[int, int] = {}  # for each view, the last node that is not pinned
        for batch, start in enumerate(range(0, len(links), AT_A_TIME)):
            self._asker.watch.check()
            part, added = f"batch_{batch}", links[start : start + AT_A_TIME]
            new = sorted({end for s, _, x in added for end in (s, x)} - given)
            given.update(new)
            nodes: list[tuple[int, int, Sequence[int], int | None]] = []
            for t in new:
                nodes.append((t, seen[t], self._names.choices[t], last.get(seen[t])))
                if t not in pinned:
                    last[seen[t]] = t
            far = (
                [(t, int(u)) for t in new for u in np.flatnonzero(self._far(t)[:t])]
                if self._far is not None
                else []
            )
            self._asker.control.add(part, [], names_lp.batch_facts(batch, nodes, added, far))
            self._asker.control.ground([(part, []), ("more", numbers(batch))])

    def _literal(self, symbol: clingo.Symbol) -> int:
        """Return the literal of an atom."""
        atom = self._asker.control.symbolic_atoms[symbol]
        assert atom is not None
        return atom.literal

    def _not_allowed(self, allowed: Collection[int]) -> list[int]:
        """Return assumptions that exclude all spare names except those in use and `allowed`."""
        taken = {*self._labels, *allowed}
        return [-literal for name, literal in self._names.used.items() if name not in taken]

    def _moved(
        self,
        assumed: Sequence[int],
        free: Iterable[int],
        conflicts: int,
        *,
        step_by_step: bool = False,
    ) -> _Verdict:
        """Change the labels of some nodes so that the assumptions hold.

        Nodes with a name that is not free keep it, unless a core shows that this is impossible.

        Args:
            assumed: The assumptions, as literals.
            free: Names whose nodes may change their labels.
            conflicts: Give up after this many conflicts.
            step_by_step: What to free if a core shows that some nodes cannot all keep their names.
                True: these nodes only. False: all nodes with the names of these nodes.

        Returns:
            "moved" if the labels were changed; "needed" if the assumptions cannot hold; "open" if
            that is unknown.
        """
        free = {-1, *free}
        literals = self._literals()
        while True:
            stay = {
                literal: name
                for literal, name in zip(literals, self._labels, strict=True)
                if literal and name not in free
            }
            answer, core = self._asker.verdict(
                names_lp.read_names, [-self._names.ordered, *assumed, *stay], conflicts
            )
            if answer is not None:
                self._keep(answer)
                return "moved"
            if core is None:
                return "open"
            moving = [literal for literal in core if literal in stay]
            if not moving:
                return "needed"
            if step_by_step:
                literals = [0 if literal in moving else literal for literal in literals]
            else:
                free |= {stay[literal] for literal in moving}

    def _literals(self) -> list[int]:
        """For each node, return the literal that it has its label.

        The literal is 0 for a node that can only have one name, or has no label.
        """
        return [
            0
            if name < 0 or len(self._names.choices[t]) == 1 or name not in self._names.choices[t]
            else self._literal(names_lp.named(t, name))
            for t, name in enumerate(self._labels)
        ]

    def _keep(self, answer: Mapping[int, int]) -> None:
        """Take over the labels of an answer, with names changed to the first ones of each view.

        Args:
            answer: The name of each node.
        """
        taken = set(answer.values())
        name_of = {name: name for name in range(len(self._pinned.clique))}
        for spare in self._names.spare.values():
            name_of |= dict(zip([name for name in spare if name in taken], spare, strict=False))
        self._label([name_of[answer[t]] for t in range(len(answer))])

    def _label(self, labels: Labels) -> None:
        """Take over labels, and forget what was proven about the labels before."""
        self._labels, self._allowed, self._needed = labels, None, set()

    def _spared(self, conflicts: int) -> Iterator[Labels]:
        """Save one dstate after the other, and yield the labels each time, until none can be saved.

        Only names that the labels use are allowed.

        Args:
            conflicts: Give up each question after this many conflicts.
        """
        tried: set[int] = set()
        while True:
            count = Counter(self._labels)
            last = [
                max(used)
                for spare in self._names.spare.values()
                if (used := [name for name in spare if name in count])
            ]
            left = [name for name in last if name not in tried and name not in self._needed]
            if not left:
                return
            name = min(left, key=lambda name: (count[name], name))
            tried.add(name)
            verdict = self._moved(
                [*self._not_allowed(()), -self._names.used[name]], {name}, conflicts
            )
            if verdict == "moved":
                tried.clear()
                yield self._labels
            elif verdict == "needed":
                self._needed.add(name)

    def _redrawn(self, conflicts: int) -> Iterator[Labels]:
        """Save dstates by freeing all nodes in one part of the map at a time, and yield the labels.

        A part begins at a spare name drawn at random, and grows along the links. The search ends
        after `REGIONS` parts without success.
        """
        tried = 0
        while tried < REGIONS:
            tried += 1
            taken = set(self._labels)
            begin = sorted(taken.difference(range(len(self._pinned.clique))))
            if not begin:
                return
            near: dict[int, set[int]] = {}
            for t, _, u in self._pinned.chart.links:
                here, there = self._labels[t], self._labels[u]
                near.setdefault(here, set()).add(there)
                near.setdefault(there, set()).add(here)
            edge = [self._random.choice(begin)]
            free = set(edge)
            while edge and len(free) < self._region:
                for name in sorted(near[edge.pop(self._random.randrange(len(edge)))] - free)[
                    : self._region - len(free)
                ]:
                    free.add(name)
                    edge.append(name)
            stay = [
                literal
                for literal, name in zip(self._literals(), self._labels, strict=True)
                if literal and name not in free
            ]
            answer, core = self._with_fewer(
                [-self._names.ordered, *self._not_allowed(()), *stay], conflicts
            )
            if answer is not None:
                self._keep(answer)
                yield self._labels
                tried = 0
            elif core is not None:
                self._region = min(self._region + LARGER, len(taken))
            else:
                self._region = max(self._region - SMALLER, FIRST_REGION)

    def _widened(self, conflicts: int) -> Generator[Labels, None, _Verdict]:
        """Look for labels with fewer dstates, with all nodes free, by allowing more and more names.

        Yields:
            The new labels, if any are found.

        Returns:
            "moved" if there are new labels, or more names; "needed" if all names are allowed and
            there are no labels with fewer dstates; "open" if that is unknown.
        """
        if self._allowed is None:  # first allow no more names, then each of them alone
            taken = set(self._labels)
            more = [
                name
                for spare in self._names.spare.values()
                for name in spare[:-1]
                if name not in taken
            ]
            for names in ((), *((name,) for name in more)):
                verdict = yield from self._asked(names, conflicts)
                if verdict == "moved" or (verdict == "open" and not names):
                    return verdict
            self._allowed, self._waiting = (
                [],
                [*more, *(spare[-1] for spare in self._names.spare.values())],
            )
        at_once = 1  # the number of names to allow next
        left: list[int] | None = None
        while self._waiting and left != self._waiting:
            left, self._waiting = self._waiting, []
            queue = deque(left)
            doubling = True
            while queue:
                added = [queue.popleft() for _ in range(min(at_once, len(queue)))]
                verdict = yield from self._asked((*self._allowed, *added), conflicts)
                if verdict == "moved":
                    return verdict
                if verdict == "needed":
                    self._allowed += added
                    at_once *= 1 + doubling
                elif len(added) == 1:
                    self._waiting += added
                else:
                    queue.extendleft(reversed(added))
                    at_once, doubling = len(added) // 2, False
        return "open" if self._waiting else "needed"

    def _asked(self, allowed: Collection[int], conflicts: int) -> Generator[Labels, None, _Verdict]:
        """Ask for labels with fewer dstates that may also use these names.

        Args:
            allowed: Spare names besides those in use.
            conflicts: Give up after this many conflicts.

        Yields and returns the same as `_widened`.
        """
        answer, core = self._with_fewer(
            [self._names.ordered, *self._not_allowed(allowed)], conflicts
        )
        if answer is None:
            return "open" if core is None else "needed"
        if resting := self._names.rests.intersection(answer.values()):
            self._name_more(resting)
        else:
            self._keep(answer)
            yield self._labels
        return "moved"

    def _with_fewer(
        self, assumed: Sequence[int], conflicts: int
    ) -> tuple[dict[int, int] | None, list[int] | None]:
        """Ask for an answer with fewer dstates under these assumptions.

        Returns:
            The name of each node, and None; or None, and a core of the assumptions. Both are None
            if clingo gave up.
        """
        cost = len(set(self._labels)) - 1 - len(self._pinned.clique)
        if cost < 0:
            return None, []
        return self._asker.verdict(names_lp.read_names, assumed, conflicts, f"enum,{cost},{cost}")

    def _name_more(self, resting: Collection[int]) -> None:
        """Make a new control with more names for some views, and rename the labels accordingly.

        Args:
            resting: The rests of these views.
        """
        before, taken = self._names.spare, set(self._labels)
        used = {view: [name for name in spare if name in taken] for view, spare in before.items()}
        self._fewest |= {
            view: len(spare) - 1 for view, spare in before.items() if spare[-1] in resting
        }
        self._take(
            {view: max(len(names), self._fewest.get(view, 0)) for view, names in used.items()}
        )
        renamed = {
            old: new
            for view, names in used.items()
            for old, new in zip(names, self._names.spare[view], strict=False)
        }
        self._label([renamed.get(name, name) for name in self._labels])
