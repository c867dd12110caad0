"""An engine for the full theory where places have no frames and fewest dstates come first: dstates first, then places and paths.

The axioms of places and paths for each step of a trace are too much for clingo after some dozen steps that keep exploring. But they speak
of dstates: of which place one is at, and which path it is along. So the dstates have names, as in the causal theory (`engines/causal.py`),
and ways.lp says what order and sides demand of where the actions at them lead. That depends on how many dstates there are, not on how many
steps.

*Claim.* Each map of the full theory is an answer of names.lp and ways.lp, at the cost that it has in the causal theory.
*Proof.* Let `goes` hold of the links of the map, and of no others; let each atom of ways.lp hold where what its comment says is so in the map.
Then its rules are what the axioms say of two or three dstates: a travel keeps the path, and leads on along it, as the order is transitive;
a turn keeps the place. The rest (`engines/causal.py`) is no dstate of theirs. ∎

So the bounds hold, and if some answer of that cost has places and paths, all minimal maps are among the answers of that cost with the least
of them. courses.lp tells, and finds the least. If an answer has none, the path of some dstate mostly shows it: ways.lp is told some of
these paths at a time; a dozen are mostly enough. What no single path shows is forbidden: as few of the answer's links as have
no places and paths. All labels with the fewest dstates have to be seen for that, which takes most of the time where there are hundreds.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Collection, Generator, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import chain, islice
from typing import TypeAlias

import clingo

from ssh_abduction.asp import facts
from ssh_abduction.asp.control import Control, mapped
from ssh_abduction.asp.limits import Watch
from ssh_abduction.engines.base import Found
from ssh_abduction.engines.causal import NamedEngine, Settled
from ssh_abduction.engines.streets import PREPARING
from ssh_abduction.engines.visits import smaller
from ssh_abduction.steps.chart import Link, numbered
from ssh_abduction.steps.log import Log
from ssh_abduction.theory import encodings
from ssh_abduction.theory.speedups import Speedups
from ssh_abduction.theory.theory import Theory
from ssh_abduction.trace import Trace

CONTRARY = 8  # paths that clingo is told of in one go
BETTERING = 20_000  # conflicts after which better courses are no longer sought one after another

_Far: TypeAlias = tuple[int, int, int, int]  # two dstates that are not at one place, and two steps at them of which evidence says so
_Question: TypeAlias = tuple[tuple[int, ...], tuple[str, ...]]  # labels of all steps, and options of clasp


@dataclass(frozen=True)
class _Members:
    """What no places and paths may fit: links, and dstates that are far from each other."""

    links: list[Link]
    far: list[_Far]

    @classmethod
    def of(cls, members: Iterable[Link | _Far]) -> _Members:
        links, far = list[Link](), list[_Far]()
        for member in members:
            if len(member) == 3:
                links.append(member)
            else:
                far.append(member)
        return cls(links, far)

    def all(self) -> list[Link | _Far]:
        return [*self.links, *self.far]


class WaysEngine(NamedEngine):
    """The full theory without frames, fewest dstates first, for a trace that has a map.

    known  the labels of all its steps, if one with few dstates is known
    """

    lists_least = True
    goes_on = False  # of the longer trace no map is known

    def __init__(self, trace: Trace, theory: Theory, watch: Watch, log: Log, speedups: Speedups, known: Sequence[int] | None) -> None:
        super().__init__(trace, theory, watch, log, speedups)
        self._given_map = known or ()
        self.paths = len(trace)  # names for paths are never short
        self._actions = dict(zip(log.actions, trace.actions, strict=True))
        self._forbidden = 0  # sets of links, so far
        self._ways: set[int] = set()  # dstates of whose paths clingo was told
        self._asked: tuple[_Question, clingo.Control] | None = None  # the last labels, and the control for their places and paths
        self._best: tuple[tuple[int, ...], list[list[int]]] | None = None  # the minimal cost, and all labels that have it
        self._seeks_fewest = False  # whether the fewest dstates are being sought, rather than all labels with so many listed

    def grow(self, size: int) -> None:
        if size == self.size:
            return
        self._best, self._ways = None, set()
        super().grow(size)
        self._known = numbered(self._given_map[:size]) or None

    def _first_spares(self) -> dict[int, int]:
        """As many as the known map needs."""
        seen = self._chart.seen
        found = Counter(dict(zip(self._given_map, seen, strict=False)).values())
        pinned = Counter(seen[node] for node in self.clique)
        return {view: max(count, found[view] - pinned[view] + 1) for view, count in super()._first_spares().items()}

    def _settled(self) -> bool:
        """Never. Raises Settled where the fewest dstates are sought, and the known map has as few as the bound."""
        if self._seeks_fewest and self._known and (self.bound or 0) >= len(set(self._known)):
            raise Settled
        return False

    def _better_labels(self) -> Iterator[list[int]]:
        self._seeks_fewest = True
        try:
            yield from super()._better_labels()
        finally:
            self._seeks_fewest = False

    def improving_maps(self, most: tuple[int, ...] = ()) -> Iterator[Found]:
        *_, fewest = self._better_labels()
        if len(self._theory.priorities) == 1:
            yield from self._maps(fewest, "ignore")
            return
        best: Found | None = None
        named: list[list[int]] = []
        for labels in chain([fewest], self._fitting(len(set(fewest)), besides=fewest)):
            for found in self._better_courses(labels):
                if best is None or found.cost < best.cost:
                    best, named = found, []
                    yield best
            if best is not None and found.cost == best.cost:
                named.append(labels)
        assert best is not None
        self._best = best.cost, named

    def maps_of_cost(self, cost: tuple[int, ...], enough: int) -> Iterator[Found]:
        every = self._best[1] if self._best and self._best[0] == cost else self._fitting(cost[0])
        mode = f"enum,{','.join(map(str, (0, *cost[1:])))}"
        yield from islice((found for labels in every for found in self._maps(labels, mode)), enough or None)

    def _fitting(self, dstates: int, besides: Sequence[int] = ()) -> Iterator[list[int]]:
        """All ways to be at so many dstates that have places and paths, each once, and not that one."""
        known = {tuple(numbered(besides))}
        while True:
            refused: list[int] | None = None
            with closing(self._labels_of(dstates, 0)) as listed:
                for labels in listed:
                    if (found := tuple(numbered(labels))) in known:
                        continue
                    if not self._fits(labels):
                        refused = labels
                        break
                    known.add(found)
                    yield labels
            if refused is None:
                return
            self._forbid(refused)

    def _search_nearby(self) -> Iterator[list[int]]:
        """Nothing: what fits the causal theory need not fit this one."""
        return iter(())

    _search_alone = _search_nearby

    def _restart(self) -> None:
        """Take a new control, for other names, and tell it of the same paths."""
        told = {key for key, name in self._names().items() if name in self._ways} if self._ways else ()
        self._ways = set()
        super()._restart()
        if told:
            self._tell_of([name for key, name in self._names().items() if key in told])

    def _names(self) -> dict[tuple[int, int], int]:
        """The names of dstates, but for rests, by what they are whatever the number of spare names."""
        pinned = {(-1, name): name for name in range(len(self.clique))}
        return pinned | {(view, i): name for view, spare in self._spare.items() for i, name in enumerate(spare[:-1])}

    def _tell_of(self, names: Collection[int]) -> None:
        """Tell clingo what the paths of these dstates demand, of which it does not know yet."""
        began = time.perf_counter()
        parts: list[tuple[str, list[clingo.Symbol]]] = []
        if not self._ways:
            self._control.load(encodings.path("ways"))
            self._control.add("ways", [], facts.way_facts(self._theory, self._actions))
            parts.append(("ways", []))
        parts += [("way", facts.numbers(name)) for name in names]
        self._end_begun()
        self._control.ground(parts)  # in one go: that takes half as long, and searching, too
        self._ways.update(names)
        self.ground_seconds += time.perf_counter() - began

    def _fits(self, labels: Sequence[int]) -> bool:
        return self._has_courses(self._least_courses(labels))

    def _has_courses(self, control: clingo.Control) -> bool:
        return next(self._answers(lambda _: True, "ignore", 1, control=control), False)

    def _forbid(self, labels: Sequence[int]) -> None:
        links = self._links_of(labels)
        control = self._courses(links, parts=("base",))
        contrary = next(self._answers(facts.read_contraries, "ignore", 1, control=control))
        if new := [name for name in contrary if name not in self._ways][:CONTRARY]:
            self._tell_of(new)
            return
        clash = smaller(_Members([*links], self._far_away(labels)).all(), self._clashing)
        members = _Members.of(clash)
        placed = {end for far in members.far for end in ((far[2], far[0]), (far[3], far[1]))}
        steps = {step for step, _ in placed}
        self._add(link for link in self._chart.links if link not in self._links and not steps.isdisjoint(link[::2]))
        rule = facts.forbidden_links(members.links, placed)
        self._end_begun()
        self._forbidden += 1
        self._control.add(f"forbidden_{self._forbidden}", [], rule)
        self._control.ground([(f"forbidden_{self._forbidden}", [])])

    def _clashing(self, members: list[Link | _Far]) -> list[Link | _Far] | None:
        """These links, and dstates that are far from each other, if no places and paths fit them."""
        some = _Members.of(members)
        found = any(self._has_courses(self._courses(some.links, far=some.far, single=single)) for single in (True, False))
        return None if found else members

    def _far_away(self, labels: Sequence[int]) -> list[_Far]:
        """The dstates that are not at one place, as evidence says of steps at them; each pair once."""
        away = self._log.pairs.elsewhere.items()
        found = {(labels[i], labels[t]): (i, t) for t, others in away if t < len(labels) for i in others}
        return [(*dstates, *steps) for dstates, steps in found.items()]

    def _links_of(self, labels: Sequence[int]) -> list[Link]:
        """The links that these labels of all steps make, each once."""
        return list(dict.fromkeys((labels[t], action, labels[u]) for t, action, u in self._chart.links))

    def _courses(
        self,
        links: Collection[Link],
        dstates: Iterable[int] = (),
        options: Sequence[str] = (),
        *,
        far: Collection[_Far] = (),
        single: bool = False,
        parts: Iterable[str] = ("base", "least"),
    ) -> clingo.Control:
        """A control for the places and paths of dstates that are linked so, and of these."""
        control = Control(options, self._watch.check, PREPARING)
        control.load(encodings.path("courses"))
        control.load(encodings.path("preference"))
        dstates = dict.fromkeys(chain(dstates, *((s, x) for s, _, x in links), *(f[:2] for f in far)))
        control.add("base", [], facts.course_facts(self._theory, dstates, links, self._actions, [f[:2] for f in far], single=single))
        control.ground([(part, []) for part in parts])
        return control

    def _least_courses(self, labels: Sequence[int], options: Sequence[str] = ()) -> clingo.Control:
        """A control for the places and paths that fit these labels of all steps. The last one is kept, as the next question is often to it."""
        key = tuple(labels), tuple(options)
        if self._asked is None or self._asked[0] != key:
            began = time.perf_counter()
            control = self._courses(self._links_of(labels), labels, options, far=self._far_away(labels))
            self._watch.check()
            self.ground_seconds += time.perf_counter() - began
            self._asked = key, control
        return self._asked[1]

    def _better_courses(self, labels: Sequence[int]) -> Iterator[Found]:
        """Maps with these dstates, each as good as the one before or better, the last one best; none if no places and paths fit them."""
        proven = yield from self._maps(labels, "opt", BETTERING)
        if not proven:
            yield from self._maps(labels, "opt", options=["--opt-strategy=usc"])

    def _maps(self, labels: Sequence[int], mode: str, conflicts: int = -1, options: Sequence[str] = ()) -> Generator[Found, None, bool]:
        """Maps with these dstates. Returns whether clingo came to an end, and not to the limit of conflicts."""
        control = self._least_courses(labels, options)
        reader = facts.StreetReader(control, self._trace, self._theory, self._chart, labels)
        answers = self._answers(reader.read, mode, int(mode == "ignore"), control=control, conflicts=conflicts, ahead=True)
        return (yield from mapped(lambda answer: Found.of(reader.map_of(answer).without_headings(), self._theory), answers))
