"""An engine for the full theory where places have frames and fewest dstates come first: dstates first, then places and paths.

Frames tell so much that the dstates are all but settled before any place or path is: a turn rotates by known quarters, so a whole visit is
named at once (`chart.py`). The engine names dstates as `named.py` does, by names.lp, which knows the causal axioms and how turns
rotate, but not the order of places on a path, or its sides. For what that leaves of the dstates, streets.lp finds the fewest paths and places.

*Claim.* Cut to its dstates, a map of the full theory is a map that names.lp allows. So the fewest dstates of the latter are a lower bound, and
if some naming of that cost has streets, all minimal maps are among the namings of that cost with their least streets.
*If none has*, streets.lp is asked which labels clash: a smallest set of nodes at dstates that no streets fit. names.lp is told that
these do not go together, and asked again. As every map of the full theory keeps that, its bounds still hold.
"""

from __future__ import annotations

import time
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from itertools import islice, permutations, product

import clingo
import numpy as np
from numpy.typing import NDArray

from ssh_abduction import encodings, facts
from ssh_abduction.chart import Chart, FramedChart, NoFrame
from ssh_abduction.engine import AT_ONCE, Found, Watch
from ssh_abduction.named import NamedEngine
from ssh_abduction.replay import Log
from ssh_abduction.speedups import Speedups
from ssh_abduction.theory import Theory
from ssh_abduction.trace import Trace

SPARES = 4  # spare names of a view, to begin with
BETTERING = 20_000  # conflicts after which better streets are no longer sought one after another
RENAMED = 50  # ways to rename the spare names of a clash that clingo is told of, at most

Clash = tuple[tuple[int, tuple[int, int]], ...]  # nodes at dstates that do not go together


def _numbered(labels: Sequence[int]) -> tuple[int, ...]:
    """The labels with dstates numbered by first visit: a restart renames them."""
    number: dict[int, int] = {}
    return tuple(number.setdefault(label, len(number)) for label in labels)


class FramedEngine(NamedEngine):
    """The full theory with frames, fewest dstates first."""

    _chart: FramedChart

    def __init__(self, trace: Trace, theory: Theory, watch: Watch, log: Log, speedups: Speedups) -> None:
        super().__init__(trace, theory, watch, log, speedups)
        self.paths = len(trace)  # names for paths are never short
        self._first_spares = SPARES
        self._cores = -1  # cores are about few views
        self._fits = True  # whether the visits fit their frames
        self._clashes: list[Clash] = []
        self._best: tuple[tuple[int, ...], list[list[int]]] | None = None  # the minimal cost, and all namings that have it

    def _take(self, size: int) -> None:
        self._clashes, self._best = [], None
        try:
            super()._take(size)
        except NoFrame:
            self._fits = False

    def improving_maps(self) -> Iterator[Found]:
        if not self._fits:
            return
        best: Found | None = None
        labels = self._minimal_labels()
        while labels is not None:
            for best in self._better_streets(labels):
                yield best
            if best is not None:
                break
            self._forbid(labels)
            labels = self._labels_at_bound() or self._minimal_labels()
        if best is None or labels is None:
            return
        namings = [labels]
        for others in self._fitting(best.cost[0], besides=labels):
            for found in self._better_streets(others):
                if found.cost < best.cost:
                    best, namings = found, []
                    yield best
            if found.cost == best.cost:
                namings.append(others)
        self._best = best.cost, namings

    def maps_of_cost(self, cost: tuple[int, ...], enough: int) -> Iterator[Found]:
        if not self._fits:
            return
        count = 0
        for labels in self._best[1] if self._best and self._best[0] == cost else self._fitting(cost[0]):
            for found in self._streets(labels, f"enum,{','.join(map(str, (0, *cost[1:])))}"):
                yield found
                count += 1
                if count == enough:
                    return

    def _fitting(self, dstates: int, besides: Sequence[int] = ()) -> Iterator[list[int]]:
        """All namings of so many dstates that have streets, each once, and not that one."""
        known = {_numbered(besides)}
        while True:
            refused: list[int] | None = None
            with closing(self._labels_of(dstates, 0)) as namings:
                for labels in namings:
                    if _numbered(labels) in known:
                        continue
                    if next(self._streets(labels, "ignore"), None) is None:
                        refused = labels
                        break
                    known.add(_numbered(labels))
                    yield labels
            if refused is None:
                return
            self._forbid(refused)

    def _better_streets(self, labels: Sequence[int]) -> Iterator[Found]:
        """Maps with these dstates, each as good as the one before or better, the last one best; none if no streets fit them.

        Where bettering maps does not end soon, the bound is raised from below instead.
        """
        if len(self._theory.priorities) == 1:
            yield from self._streets(labels, "ignore")
            return
        proven = yield from self._streets(labels, "opt", BETTERING)
        if not proven:
            yield from self._streets(labels, "opt", options=["--opt-strategy=usc"])

    def _streets(self, labels: Sequence[int], mode: str, conflicts: int = -1, options: Sequence[str] = ()) -> Generator[Found, None, bool]:
        """Maps with these dstates. Returns whether clingo came to an end, and not to the limit of conflicts."""
        began = time.perf_counter()
        control = self._streets_of(self._chart, options)
        control.load(encodings.path("preference"))
        control.add("base", [], facts.settled_facts(self._theory, self._chart, labels))
        control.ground([("base", []), ("least", [])])
        self._watch.check()
        self.ground_seconds += time.perf_counter() - began
        dstates = len(set(labels))

        def read(model: clingo.Model) -> Found:
            return Found(facts.read_streets(model, self._trace, self._chart, labels), (dstates, *model.cost[1:]))

        return (yield from self._answers(read, mode, int(mode == "ignore"), control=control, conflicts=conflicts))

    def _forbid(self, labels: Sequence[int]) -> None:
        """Tell clingo which of these labels do not go together."""
        self._end_begun()
        clashes = [tuple((node, self._stable(labels[node])) for node in nodes) for nodes in self._clashing(labels)]
        self._clashes += clashes
        nodes = {node for clash in clashes for node, _ in clash}
        self._add([link for link in self._chart.links if link[0] in nodes or link[2] in nodes])
        self._tell(clashes)

    def _restart(self) -> None:
        super()._restart()
        self._tell(self._clashes)

    def _tell(self, clashes: Sequence[Clash]) -> None:
        """Forbid what clashes, also with other spare names: those of a view are alike."""
        rules: dict[str, None] = {}
        for clash in clashes:
            spares = sorted({name for _, name in clash if name[0] >= 0})
            own = {view: [name for name in spares if name[0] == view] for view, _ in spares}
            ways = [islice(permutations(self._spare[view][:-1], len(names)), RENAMED) for view, names in own.items()]
            for way in [
                tuple(tuple(self._spare[view][k] for view, k in names) for names in own.values()),
                *islice(product(*ways), RENAMED),
            ]:
                label_of = {
                    name: label for names, labels in zip(own.values(), way, strict=True) for name, label in zip(names, labels, strict=True)
                }
                rules[facts.forbidden([(node, label_of.get(name, name[1])) for node, name in clash])] = None
        part = f"clashes_{self._batches}_{len(self._clashes)}"
        self._control.add(part, [], "\n".join(rules))
        self._control.ground([(part, [])])

    def _clashing(self, labels: Sequence[int]) -> list[list[int]]:
        """Sets of nodes, none in two of them, each smallest so that no streets fit their labels."""
        control = self._streets_of(self._chart)
        control.add("base", [], facts.open_labels(labels))
        control.ground([("base", [])])
        found: list[list[int]] = []
        left = list(range(len(labels)))
        while True:
            core = self._core(control, left, labels)
            if core is None:
                return found or [list(range(len(labels)))]
            core = self._smallest(control, core, labels)
            found.append(core)
            left = [node for node in left if node not in core]

    def _smallest(self, control: clingo.Control, core: list[int], labels: Sequence[int]) -> list[int]:
        """A core none of whose nodes can be spared: parts of it are left out, half of it first, single nodes last."""
        size = len(core)
        while size := size // 2:
            start = 0
            while start < len(core):
                fewer = self._core(control, core[:start] + core[start + size :], labels)
                if fewer is None:
                    start += size
                else:
                    core = sorted(fewer)
        return core

    def _core(self, control: clingo.Control, nodes: Sequence[int], labels: Sequence[int]) -> list[int] | None:
        """Some of these nodes whose labels no streets fit; None where they have streets."""
        self._watch.check()
        atoms = control.symbolic_atoms
        assumed = {atom.literal: node for node in nodes if (atom := atoms[facts.dstate_at(node, labels[node])])}
        with control.solve(assumptions=list(assumed), yield_=True) as handle:
            if handle.get().satisfiable:
                return None
            return [assumed[literal] for literal in handle.core()]

    def _stable(self, label: int) -> tuple[int, int]:
        """A name that survives a restart: the view and number of a spare name; -1 and itself for others."""
        view = next((view for view, names in self._spare.items() if label in names), -1)
        return (view, self._spare[view].index(label)) if view >= 0 else (-1, label)

    def _charted(self, size: int) -> Chart:
        """The nodes, and which of them are at different places because of what the trace alone says of order and sides."""
        chart = Chart.framed(self._trace, self._log, size)
        control = self._streets_of(chart)
        control.add("base", [], facts.settled_labels(range(len(chart.seen))))
        control.ground([("base", []), ("apart", [])])
        self._watch.check()
        return next((replace(chart, elsewhere=pairs) for pairs in self._answers(facts.read_elsewhere, "ignore", 1, control=control)), chart)

    def _streets_of(self, chart: FramedChart, options: Sequence[str] = ()) -> clingo.Control:
        """A control with the axioms of places and paths, and what happened."""
        control = clingo.Control(["--warn=none", *options])
        control.load(encodings.path("streets"))
        control.add("base", [], facts.street_facts(self._trace, self._theory, chart))
        return control

    def _columns(self, nodes: Sequence[int]) -> NDArray[np.bool_]:
        """Of nodes beyond the matrix only what they show is known."""
        seen = np.asarray(self._chart.seen)
        apart: NDArray[np.bool_] = seen[:, None] != seen[list(nodes)]
        apart[:AT_ONCE] |= self._chart.apart(AT_ONCE)[:, nodes]
        return apart
