"""An engine for the topological theory where places have no frames and fewest dstates come first: dstates first, then places and paths.

The axioms of places and paths for each step of a trace are too much for clingo after some dozen steps that keep exploring. But they speak
of dstates: of which place one is at, and which path it is along. So the dstates have names, as in the causal theory (`engines/naming.py`),
and sides_frameless.lp says what order and sides demand of where the actions at them lead. That depends on how many dstates there are, not on how many
steps.

*Claim.* Each map of the topological theory is an answer of names.lp and sides_frameless.lp, at the cost that it has in the causal theory.
*Proof.* Let `goes` hold of the links of the map, and of no others; let each atom of sides_frameless.lp hold where what its comment says is so in the map.
Then its rules are what the axioms say of two or three dstates: a travel keeps the path, and leads on along it, as the order is transitive;
a turn keeps the place. The rest (`engines/naming.py`) is no dstate of theirs. ∎

So the bounds hold, and if some answer of that cost has places and paths, all minimal maps are among the answers of that cost with the least
of them. paths_frameless.lp tells, and finds the least. If an answer has none, the path of some dstate mostly shows it: sides_frameless.lp is told some of
these paths at a time; a dozen are mostly enough. What no single path shows is forbidden: as few of the answer's links as have
no places and paths. All labels with the fewest dstates have to be seen for that, which takes most of the time where there are hundreds.
"""

from __future__ import annotations

from collections.abc import Collection, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import chain, islice, pairwise
from typing import TypeAlias

import clingo
import networkx as nx

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.solver.asp.control import Asker, Control, mapped
from ssh_abduction.solver.asp.facts import names_lp, path_reader, paths_lp, sides_lp
from ssh_abduction.solver.asp.facts.atoms import numbers
from ssh_abduction.solver.engines.base import Found, Task, next_charted_size
from ssh_abduction.solver.engines.doubts import Settled
from ssh_abduction.solver.engines.homes import fewest_paths, homes_of
from ssh_abduction.solver.engines.naming import NamedLabels
from ssh_abduction.solver.engines.paths import PREPARING
from ssh_abduction.solver.engines.refusing import all_accepted, smaller
from ssh_abduction.solver.steps.chart import Link, numbered
from ssh_abduction.theory import encodings
from ssh_abduction.theory.evidence import Equality

# Clingo is told of so many paths, or of so many pairs of dstates, in one go: of fewer it would be asked more often, and most of more would not be needed.
CONTRARY = 8
# So many maps whose places differ come first, or some more: they are remembered while the others are listed.
SOONER = 1000
# After so many conflicts better paths are no longer sought one after another; the bound is raised from below instead.
BETTERING = 20_000

# Labels of all steps, options of clasp, and the parts of the program.
_Question: TypeAlias = tuple[tuple[int, ...], tuple[str, ...], tuple[str, ...]]
# The parts of the program that say which places and paths fit labels; and that answers are listed, too, which differ in paths alone.
# TOLD is what segments tell of places and of each other before any two of them are one.
TOLD, EACH = ("base", "segments"), ("each",)
PARTS = (*TOLD, "least", "paths")
# Whether there are just as many places as no two of which can be one is asked for at most so many labels, and so many conflicts each: it mostly shows at once.
TIGHT, TIGHTLY = 5, 2000


@dataclass(frozen=True)
class _Far:
    """A set of pairs of dstates, mostly a single pair, in which there is a pair that is not at one place.

    pairs   of dstates
    placed  the steps that evidence says so of, each with the dstate that it is at
    """

    pairs: tuple[tuple[int, int], ...]
    placed: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, labels: Sequence[int], equalities: Collection[Equality]) -> _Far | None:
        """What follows for these labels if equalities do not all hold; None where nothing follows, as some steps that were to be one dstate are not."""
        steps = dict.fromkeys(
            step for equality in equalities for step in (equality.first, equality.second)
        )
        if max(steps) >= len(labels) or any(
            e.of == "dstate" and labels[e.first] != labels[e.second] for e in equalities
        ):
            return None
        pairs = {(labels[e.first], labels[e.second]): None for e in equalities if e.of == "place"}
        return cls(tuple(pairs), tuple((step, labels[step]) for step in steps))


@dataclass(frozen=True)
class _Members:
    """What no places and paths may fit: links, and dstates that are far from each other."""

    links: list[Link]
    far: list[_Far]

    @classmethod
    def of(cls, members: Iterable[Link | _Far]) -> _Members:
        links, far = list[Link](), list[_Far]()
        for member in members:
            if isinstance(member, _Far):
                far.append(member)
            else:
                links.append(member)
        return cls(links, far)

    def all(self) -> list[Link | _Far]:
        return [*self.links, *self.far]


class FramelessEngine:
    """The topological theory without frames, fewest dstates first, for a trace that has a map.

    known  the labels of all its steps, if one with few dstates is known
    """

    lists_least = True
    goes_on = False  # of the longer trace no map is known

    def __init__(self, task: Task, known: Sequence[int] = ()) -> None:
        self.asker = Asker(task.watch)
        self.intact = True
        self.paths = len(task.trace)  # names for paths are never short
        self._task = task
        self._given_map = known
        self._fitting = PlacesAndPaths(task, self.asker)
        self._named = NamedLabels(task, self.asker, known, self._fitting)
        self._fitting.named = self._named
        self._best: tuple[tuple[int, ...], list[list[int]]] | None = (
            None  # the minimal cost, and all labels that have it
        )

    @property
    def size(self) -> int:
        return self._named.size

    @property
    def bound(self) -> int | None:
        return self._named.bound

    def with_paths(self, paths: int) -> FramelessEngine:
        return FramelessEngine(self._task, self._given_map)

    def over(self, task: Task) -> FramelessEngine:
        return FramelessEngine(task)

    def next_size(self, failed: int) -> int:
        return next_charted_size(self.size, failed, len(self._task.trace))

    @property
    def size_to_go_on(self) -> int:
        return self.next_size(self.size)

    def grow(self, size: int) -> None:
        if size != self.size:
            self._best = None
            self._fitting.forget()
            self._named.grow(size)

    def improving_maps(self, most: tuple[int, ...] = ()) -> Iterator[Found]:
        *_, fewest = self._named.improving()
        if len(self._task.theory.priorities) == 1:
            yield from self._fitting.maps(fewest, "ignore")
            return
        best: Found | None = None
        as_good: list[list[int]] = []
        for labels in chain([fewest], self._all_that_fit(len(set(fewest)), besides=fewest)):
            for found in self._fitting.improving_maps(labels):
                if best is None or found.cost < best.cost:
                    best, as_good = found, []
                    yield best
            if best is not None and found.cost == best.cost:
                as_good.append(labels)
        assert best is not None
        self._best = best.cost, as_good

    def maps_of_cost(self, cost: tuple[int, ...], enough: int) -> Iterator[Found]:
        every = (
            self._best[1] if self._best and self._best[0] == cost else self._all_that_fit(cost[0])
        )
        mode = f"enum,{','.join(map(str, (0, *cost[1:])))}"
        yield from islice(self._listed(every, mode), enough or None)

    def _listed(self, every: Iterable[list[int]], mode: str) -> Iterator[Found]:
        """The maps with these labels. Where displacements are used, maps whose places differ come first: how well maps close depends on dstates and places alone."""
        left, sooner, first = iter(every), list[list[int]](), set[SSHMap]()
        while (
            self._task.theory.displacement == "use"
            and len(first) < SOONER
            and (labels := next(left, None))
        ):
            sooner.append(labels)
            for found in self._fitting.maps(labels, mode, parts=PARTS):
                first.add(found.map)
                yield found
        yield from (
            found
            for labels in chain(sooner, left)
            for found in self._fitting.maps(labels, mode)
            if found.map not in first
        )

    def labellings(self, cost: tuple[int, ...]) -> Iterator[Settled]:
        mode = f"enum,{','.join(map(str, (0, *cost[1:])))}"
        for labels in (
            self._best[1] if self._best and self._best[0] == cost else self._all_that_fit(cost[0])
        ):
            settled = self._fitting.settled(labels, mode)
            if settled.has_map():
                yield settled

    def _all_that_fit(self, dstates: int, besides: Sequence[int] = ()) -> Iterator[list[int]]:
        """All labels with so many dstates that have places and paths, each once, and not those."""
        return all_accepted(
            ask=lambda: self._named.all_of(dstates, 0),
            refuse=self._fitting.why_not,
            forbid=self._fitting.forbid,
            key=lambda labels: tuple(numbered(labels)),
            known={tuple(numbered(besides))},
        )

    def forbid(self, equalities: Collection[Equality]) -> bool:
        self._fitting.forbid_together(equalities)
        self._named.forbid_together(
            [(equality.first, equality.second) for equality in equalities]
        )  # as one dstate is at one place
        if self._best:  # maps of that cost that are left have some of these labels
            self._best = (
                self._best[0],
                [labels for labels in self._best[1] if self._named.is_allowed(labels)],
            )
        return True

    def settle(self) -> None:
        self._named.settle()


class PlacesAndPaths:
    """What places and paths demand of labels: whether some fit them, why none do, and which are best.

    named  the labels that are asked about, and the control that is told what no labels may do
    """

    named: NamedLabels

    def __init__(self, task: Task, asker: Asker) -> None:
        self._task, self._asker = task, asker
        self._actions = dict(zip(task.log.actions, task.trace.actions, strict=True))
        self._refused: list[
            Collection[Equality]
        ] = []  # sets of which not all hold, and some of which are of places
        self._forbidden = 0  # sets of links, so far
        self._told: set[tuple[int, int]] = (
            set()
        )  # dstates of whose paths clingo was told, as `NamedLabels.names` has them
        self._asked: tuple[_Question, clingo.Control] | None = (
            None  # the last labels, and the control for their places and paths
        )
        self._tight: dict[
            tuple[int, ...], tuple[Mapping[int, list[int]], Found]
        ] = {}  # labels of which the fewest places are known, with homes and a best map
        self._failed: set[tuple[int, ...]] = set()  # labels for which that was tried in vain

    def forget(self) -> None:
        """There is to be another control, for other labels."""
        self._told = set()
        self._forget_tight()

    def _forget_tight(self) -> None:
        self._tight, self._failed, self._asked = {}, set(), None

    def tell_again(self) -> None:
        told, self._told = self._told, set()
        if told:
            self._tell_of([key for key in self.named.program.names() if key in told])

    def forbid_together(self, equalities: Collection[Equality]) -> None:
        """From now on not all of these equalities hold."""
        if any(equality.of == "place" for equality in equalities):
            self._refused.append(equalities)
            self._forget_tight()

    def _tell_of(self, dstates: Collection[tuple[int, int]]) -> None:
        """Tell clingo what the paths of these dstates demand, of which it does not know yet."""
        with self._asker.grounding_timed():
            control, names = self._asker.control, self.named.program.names()
            parts: list[tuple[str, list[clingo.Symbol]]] = []
            if not self._told:
                control.load(encodings.path("sides_frameless"))
                control.add(
                    "sides", [], sides_lp.sides_frameless_facts(self._task.theory, self._actions)
                )
                parts.append(("sides", []))
            parts += [("path", numbers(names[dstate])) for dstate in dstates]
            control.ground(parts)  # in one go: that takes half as long, and searching, too
            self._told.update(dstates)

    def fits(self, labels: Sequence[int]) -> bool:
        return self._tightly(labels) is not None or self._has_paths(self._path_control(labels))

    def _tightly(self, labels: Sequence[int]) -> Found | None:
        """A best map with these dstates, where that has no more places than no two of which can be one (`engines/homes.py`). None where that is not known."""
        key = tuple(labels)
        if key in self._tight:
            return self._tight[key][1]
        if (
            "places" not in self._task.theory.priorities
            or key in self._failed
            or len(self._failed) >= TIGHT
        ):
            return None
        with self._asker.grounding_timed():
            control = self._control_for(
                self._links_of(labels), labels, far=self._far_away(labels), parts=TOLD
            )
            told = paths_lp.Segments.read(control)
            homes = homes_of(told)
            if homes is not None:
                _go_on_at_home(control, homes, (*PARTS, *EACH))
        best = None if homes is None else self._best_at_home(labels, control, fewest_paths(told))
        if best is None or homes is None:
            self._failed.add(key)
            return None
        self._tight[key] = homes, best
        self._asked = (key, (), (*PARTS, *EACH)), control
        return best

    def _best_at_home(self, labels: Sequence[int], control: Control, fewest: int) -> Found | None:
        """The best map that a control for some homes has, if it is known that no other map with these dstates is better.

        fewest  a lower bound on the number of paths
        """
        places_first = (
            next(count for count in self._task.theory.priorities if count in ("places", "paths"))
            == "places"
        )
        reader = path_reader.PathReader(
            control, self._task.trace, self._task.theory, self.named.chart, labels
        )
        answers = mapped(
            reader.map_of,
            self._asker.answers(reader.read, "opt", 0, control=control, conflicts=TIGHTLY),
        )
        best: Found | None = None
        with closing(answers):
            while True:
                try:
                    ssh_map = next(answers).without_headings()
                except StopIteration as end:
                    return best if end.value and places_first else None
                best = Found.of(ssh_map, self._task.theory)
                if len(ssh_map.paths) <= fewest:
                    return best

    def why_not(self, labels: list[int]) -> list[int] | None:
        """Labels that no places and paths fit; None where some do."""
        return None if self.fits(labels) else labels

    def _has_paths(self, control: clingo.Control) -> bool:
        return next(self._asker.answers(lambda _: True, "ignore", 1, control=control), False)

    def forbid(self, labels: Sequence[int]) -> None:
        links = self._links_of(labels)
        control = self._control_for(links, parts=("base",))
        contrary = next(self._asker.answers(paths_lp.read_contraries, "ignore", 1, control=control))
        dstate_of = {name: dstate for dstate, name in self.named.program.names().items()}
        new = [
            dstate
            for name in contrary
            if (dstate := dstate_of.get(name)) is not None and dstate not in self._told
        ][:CONTRARY]
        if new:
            self._tell_of(new)
            return
        far = self._far_away(labels)
        for members in self._turned_together(links, far) or [
            _Members.of(smaller(_Members([*links], far).all(), self._clashing))
        ]:
            placed = {at for apart in members.far for at in apart.placed}
            self.named.program.add_links_at({step for step, _ in placed})
            self._forbidden += 1
            self.named.program.tell(
                f"forbidden_{self._forbidden}", names_lp.forbidden_links(members.links, placed)
            )

    def _turned_together(self, links: Iterable[Link], far: Iterable[_Far]) -> list[_Members]:
        """Dstates that are far from each other though turns lead from one to the other, with as few links as lead there; the fewest links first."""
        turns = nx.Graph(
            (s, x, {"link": (s, action, x)}) for s, action, x in links if self._actions[action].turn
        )
        turns.add_nodes_from(dstate for apart in far for dstate in chain(*apart.pairs))
        found = []
        for apart in far:
            if all(nx.has_path(turns, x, y) for x, y in apart.pairs):
                ways = (nx.shortest_path(turns, x, y) for x, y in apart.pairs)
                found.append(
                    _Members(
                        [turns.edges[pair]["link"] for way in ways for pair in pairwise(way)],
                        [apart],
                    )
                )
        return sorted(found, key=lambda members: len(members.links))[:CONTRARY]

    def _clashing(self, members: list[Link | _Far]) -> list[Link | _Far] | None:
        """These links, and dstates that are far from each other, if no places and paths fit them."""
        some = _Members.of(members)
        found = any(
            self._has_paths(self._control_for(some.links, far=some.far, single=single))
            for single in (True, False)
        )
        return None if found else members

    def _far_away(self, labels: Sequence[int]) -> list[_Far]:
        """The dstates that are not at one place, as evidence says of steps at them; each pair once, and what is said of several pairs together."""
        away = self._task.log.pairs.elsewhere.items()
        found = {
            (labels[i], labels[t]): (i, t) for t, others in away if t < len(labels) for i in others
        }
        alone = [
            _Far((pair,), tuple(zip(steps, pair, strict=True))) for pair, steps in found.items()
        ]
        return alone + [far for equalities in self._refused if (far := _Far.of(labels, equalities))]

    def _links_of(self, labels: Sequence[int]) -> list[Link]:
        """The links that these labels of all steps make, each once."""
        return list(
            dict.fromkeys((labels[t], action, labels[u]) for t, action, u in self.named.chart.links)
        )

    def _control_for(
        self,
        links: Collection[Link],
        dstates: Iterable[int] = (),
        options: Sequence[str] = (),
        *,
        far: Collection[_Far] = (),
        single: bool = False,
        parts: Iterable[str] = PARTS,
    ) -> Control:
        """A control for the places and paths of dstates that are linked so, and of these."""
        control = Control(options, self._asker.watch.check, PREPARING)
        control.load_encodings("paths_frameless", "preference")
        apart = [member.pairs for member in far]
        dstates = dict.fromkeys(chain(dstates, *((s, x) for s, _, x in links), *chain(*apart)))
        control.add(
            "base",
            [],
            paths_lp.paths_frameless_facts(
                self._task.theory, dstates, links, self._actions, apart, single=single
            ),
        )
        control.ground([(part, []) for part in parts])
        return control

    def _path_control(
        self,
        labels: Sequence[int],
        options: Sequence[str] = (),
        parts: Sequence[str] = (*PARTS, *EACH),
    ) -> clingo.Control:
        """A control for the places and paths that fit these labels of all steps. The last one is kept, as the next question is often to it."""
        key = tuple(labels), tuple(options), tuple(parts)
        if self._asked is None or self._asked[0] != key:
            with self._asker.grounding_timed():
                at_home = key[0] in self._tight
                control = self._control_for(
                    self._links_of(labels),
                    labels,
                    options,
                    far=self._far_away(labels),
                    parts=TOLD if at_home else parts,
                )
                if at_home:
                    _go_on_at_home(control, self._tight[key[0]][0], parts)
            self._asker.watch.check()
            self._asked = key, control
        return self._asked[1]

    def settled(self, labels: Sequence[int], mode: str) -> Settled:
        """The maps with these dstates."""
        control = self._path_control(labels)
        reader = path_reader.PathReader(
            control, self._task.trace, self._task.theory, self.named.chart, labels
        )
        return Settled(
            self._asker,
            control,
            mode,
            reader,
            lambda answer: reader.map_of(answer).without_headings(),
        )

    def improving_maps(self, labels: Sequence[int]) -> Iterator[Found]:
        """Maps with these dstates, each as good as the one before or better, the last one best; none if no places and paths fit them."""
        if (best := self._tightly(labels)) is not None:
            yield best
            return
        proven = yield from self.maps(labels, "opt", BETTERING)
        if not proven:
            yield from self.maps(labels, "opt", options=["--opt-strategy=usc"])

    def maps(
        self,
        labels: Sequence[int],
        mode: str,
        conflicts: int = -1,
        options: Sequence[str] = (),
        parts: Sequence[str] = (*PARTS, *EACH),
    ) -> Generator[Found, None, bool]:
        """Maps with these dstates: without EACH one for each choice of places. Returns whether clingo came to an end, and not to the limit of conflicts."""
        control = self._path_control(labels, options, parts)
        reader = path_reader.PathReader(
            control, self._task.trace, self._task.theory, self.named.chart, labels
        )
        answers = self._asker.answers(
            reader.read,
            mode,
            int(mode == "ignore"),
            control=control,
            conflicts=conflicts,
            ahead=True,
        )
        return (
            yield from mapped(
                lambda answer: Found.of(
                    reader.map_of(answer).without_headings(), self._task.theory
                ),
                answers,
            )
        )


def _go_on_at_home(control: Control, homes: Mapping[int, list[int]], parts: Iterable[str]) -> None:
    """Ground the other parts of a control that has what segments tell, where each place is at one of its homes."""
    control.add("homes", [], paths_lp.tight_facts(homes))
    control.ground(
        [(part, []) for part in ("homes", *(part for part in parts if part not in TOLD))]
    )
