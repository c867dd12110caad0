"""Finds places and paths for given dstates. The engine without frames uses it.

The input is a label, the number of a dstate, for each step. paths_frameless.lp finds the fewest
places and paths that fit the labels. If none fit, then mostly some single path contradicts the
axioms. Clingo then gets the axioms of a few such paths at a time (sides_frameless.lp). Mostly a
dozen paths are enough. If no single path contradicts the axioms, clingo gets a rule against a
minimal set of links that no places and paths fit.
"""

from __future__ import annotations

from collections.abc import Collection, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import chain
from typing import TypeAlias

import clingo

from ssh_abduction.data.groups import minimal_part
from ssh_abduction.solver.asp.control import Asker, Control
from ssh_abduction.solver.asp.facts import number_symbols
from ssh_abduction.solver.sources.exact.engine import BETTERING, Settled, Task, maps_of_labels
from ssh_abduction.solver.sources.exact.framed_paths import PREPARING
from ssh_abduction.solver.sources.exact.homes import fewest_paths, homes_of
from ssh_abduction.solver.sources.exact.name_program import forbidden_links
from ssh_abduction.solver.sources.exact.names import NamedLabels
from ssh_abduction.solver.sources.exact.path_facts import (
    Segments,
    paths_frameless_facts,
    read_contraries,
    sides_frameless_facts,
    stretch_facts,
    tight_facts,
)
from ssh_abduction.solver.sources.exact.path_reader import PathReader
from ssh_abduction.solver.steps.chart import Link
from ssh_abduction.solver.values import Found
from ssh_abduction.theory import encodings
from ssh_abduction.theory.evidence import Equality

# Give clingo the axioms of this many paths at once. With fewer, clingo would be asked more often.
# With more, most would not be needed.
CONTRARY = 8

# The labels of all steps, the options of clasp, and the parts of the program.
_Question: TypeAlias = tuple[tuple[int, ...], tuple[str, ...], tuple[str, ...]]
# BEFORE_MERGING derives which places and segments are different before any are merged.
# PARTS finds the places and paths that fit labels. EACH also lists answers that differ only in
# paths.
BEFORE_MERGING, EACH = ("base", "segments"), ("each",)
PARTS = (*BEFORE_MERGING, "least", "paths")
# First ask whether the pairwise distinct places are enough (`homes.py`), until that failed
# for TIGHT labellings. Each question may take TIGHTLY conflicts. The answer mostly comes at once.
TIGHT, TIGHTLY = 5, 2000


@dataclass(frozen=True)
class _Far:
    """A constraint from evidence: at least one of these pairs of dstates is at two places.

    Mostly there is only one pair.

    Attributes:
        placed: The steps that the evidence names, each with its dstate.
        denied: Whether the constraint is the opposite: the user says that the one pair is at one
            place.
    """

    pairs: tuple[tuple[int, int], ...]
    placed: tuple[tuple[int, int], ...]
    denied: bool = False

    @classmethod
    def of(cls, labels: Sequence[int], equalities: Collection[Equality]) -> _Far | None:
        """Translate a forbidden set of equalities of steps to a constraint on dstates.

        Returns None if it cannot be violated: an equality of dstates does not hold in the labels,
        or the prefix does not have all the steps yet.
        """
        steps = dict.fromkeys(
            step for equality in equalities for step in (equality.first, equality.second)
        )
        if max(steps) >= len(labels) or any(
            e.of == "dstate" and labels[e.first] != labels[e.second] for e in equalities
        ):
            return None
        pairs = {(labels[e.first], labels[e.second]): None for e in equalities if e.of == "place"}
        return cls(tuple(pairs), tuple((step, labels[step]) for step in steps))


class PlacesAndPaths:
    """Finds the best places and paths for labels (dstates of steps), or why none fit.

    Attributes:
        named: The search for labels. Its control gets the rules that exclude labels.
    """

    def __init__(self, task: Task, asker: Asker, known: Sequence[int] = ()) -> None:
        """Begin with an empty prefix. `known` has each step's dstate in a small map, or nothing."""
        self.named = NamedLabels(task, asker, known, self)
        self._task, self._asker = task, asker
        self._actions = dict(zip(task.log.actions, task.trace.actions, strict=True))
        # Forbidden sets of equalities that include an equality of places.
        self._refused: list[Collection[Equality]] = []
        # Dstates for whose paths clingo has the axioms, as keys of `NameProgram.names`.
        self._grounded: set[tuple[int, int]] = set()
        # The last labels, and the control for their places and paths.
        self._asked: tuple[_Question, Control] | None = None
        # For each labelling for which the fixed places are enough: the homes (`homes.py`)
        # and a best map. And the labellings for which homes did not lead to a map.
        self._tight: dict[tuple[int, ...], tuple[Mapping[int, list[int]], Found]] = {}
        self._failed: set[tuple[int, ...]] = set()

    def forget(self) -> None:
        """Forget everything about the control. Call this before other steps get a control."""
        self._grounded = set()
        self._forget_tight()

    def _forget_tight(self) -> None:
        self._tight, self._failed, self._asked = {}, set(), None

    def give_again(self) -> None:
        """Give a new control the axioms of the paths that the previous control had."""
        grounded, self._grounded = self._grounded, set()
        if grounded:
            self._give_axioms([key for key in self.named.program.names() if key in grounded])

    def forbid_together(self, equalities: Collection[Equality]) -> None:
        """Exclude maps in which all of these equalities hold, if one is about places."""
        if any(equality.of == "place" for equality in equalities):
            self._refused.append(equalities)
            self._forget_tight()

    def _give_axioms(self, dstates: Collection[tuple[int, int]]) -> None:
        """Ground axioms of order and sides for dstates, given as keys of `NameProgram.names`."""
        with self._asker.grounding_timed():
            control, names = self._asker.control, self.named.program.names()
            parts: list[tuple[str, list[clingo.Symbol]]] = []
            if not self._grounded:
                control.load(encodings.path("sides_frameless"))
                control.add("sides", [], sides_frameless_facts(self._task.theory, self._actions))
                parts.append(("sides", []))
            parts += [("path", number_symbols(names[dstate])) for dstate in dstates]
            control.ground(parts)  # one call for all parts halves the time to ground and to search
            self._grounded.update(dstates)

    def fits(self, labels: Sequence[int]) -> bool:
        """Whether any places and paths fit these labels (the dstate of each step)."""
        return self._tightly(labels) is not None or self._has_paths(self._path_control(labels))

    def _tightly(self, labels: Sequence[int]) -> Found | None:
        """Find a best map that has only the fixed places of `homes.py`; None if that fails."""
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
                self._links_of(labels),
                labels,
                far=self._far_away(labels),
                parts=BEFORE_MERGING,
                labels=labels,
            )
            known = Segments.read(control)
            homes = homes_of(known)
            if homes is not None:
                _go_on_at_home(control, homes, (*PARTS, *EACH))
        # This fails if some place cannot be fixed. Then the general search decides.
        best = None if homes is None else self._best_at_home(labels, control, fewest_paths(known))
        if best is None or homes is None:
            self._failed.add(key)
            return None
        self._tight[key] = homes, best
        self._asked = (key, (), (*PARTS, *EACH)), control
        return best

    def _best_at_home(self, labels: Sequence[int], control: Control, fewest: int) -> Found | None:
        """Find the best map that merges each place with one of its homes: the pairwise distinct
        places that it may equal (`homes.py`).

        `fewest` is a lower bound on the number of paths. Returns None if the map is not proven to
        be the best of all maps with these dstates.
        """
        places_first = (
            next(count for count in self._task.theory.priorities if count in ("places", "paths"))
            == "places"
        )
        reader, theory = self._reader(control, labels), self._task.theory
        found = maps_of_labels(self._asker, reader, theory, "opt", TIGHTLY)
        best: Found | None = None
        with closing(found):
            while True:
                try:
                    best = next(found)
                except StopIteration as end:
                    return best if end.value and places_first else None
                if len(best.map.paths) <= fewest:
                    return best

    def _has_paths(self, control: Control) -> bool:
        """Whether a control has an answer, that is, places and paths."""
        return next(self._asker.answers(lambda _: True, "ignore", 1, control=control), False)

    def forbid(self, labels: Sequence[int]) -> None:
        """Give clingo rules that exclude these dstates of steps, as no places and paths fit."""
        links = self._links_of(labels)
        control = self._control_for(links, parts=("base",))
        contrary = next(self._asker.answers(read_contraries, "ignore", 1, control=control))
        dstate_of = {name: dstate for dstate, name in self.named.program.names().items()}
        new = [
            dstate
            for name in contrary
            if (dstate := dstate_of.get(name)) is not None and dstate not in self._grounded
        ][:CONTRARY]
        if new:
            self._give_axioms(new)
            return
        far = self._far_away(labels)
        members: list[Link | _Far] = minimal_part(self._clash, [*links, *far])
        placed = {at for member in members if isinstance(member, _Far) for at in member.placed}
        self.named.program.add_links_at({step for step, _ in placed})
        links = [member for member in members if not isinstance(member, _Far)]
        self._asker.control.tell(forbidden_links(links, placed))

    def _clash(self, members: list[Link | _Far]) -> bool:
        """Whether no places and paths fit these links and constraints."""
        links = [member for member in members if not isinstance(member, _Far)]
        far = [member for member in members if isinstance(member, _Far)]
        return not any(
            self._has_paths(self._control_for(links, far=far, single=single))
            for single in (True, False)
        )

    def _far_away(self, labels: Sequence[int]) -> list[_Far]:
        """List what is known about dstates at different places or at one, single pairs first."""
        away = self._task.log.pairs.elsewhere.items()
        found = {
            (labels[i], labels[t]): (i, t) for t, others in away if t < len(labels) for i in others
        }
        alone = [
            _Far((pair,), tuple(zip(steps, pair, strict=True))) for pair, steps in found.items()
        ]
        alone += [
            _Far(((labels[i], labels[t]),), ((i, labels[i]), (t, labels[t])), denied=True)
            for i, t in self._task.theory.same_place
            if max(i, t) < len(labels)
        ]
        return alone + [far for equalities in self._refused if (far := _Far.of(labels, equalities))]

    def _links_of(self, labels: Sequence[int]) -> list[Link]:
        """List the links between dstates that the labels of all steps imply, each once."""
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
        labels: Sequence[int] = (),
    ) -> Control:
        """Make a control whose answers are places and paths of dstates.

        `far` has constraints that evidence puts on the places. If `single`, places and segments are
        merged only if they must be one. `labels` has the dstate of each step, so that paths stay on
        one floor; empty to ignore that.
        """
        control = Control(options, self._asker.watch.check, PREPARING)
        control.load_encodings("paths_frameless", "preference")
        apart = [member.pairs for member in far if not member.denied]
        close = [pair for member in far if member.denied for pair in member.pairs]
        ends = chain(*((s, x) for s, _, x in links), *chain(*apart), *close)
        dstates = dict.fromkeys(chain(dstates, ends))
        control.add(
            "base",
            [],
            paths_frameless_facts(
                self._task.theory, dstates, links, self._actions, apart, close, single=single
            ),
        )
        task = self._task
        control.add("base", [], stretch_facts(task.trace, task.theory, labels))
        control.ground([(part, []) for part in parts])
        return control

    def _path_control(
        self,
        labels: Sequence[int],
        options: Sequence[str] = (),
        parts: Sequence[str] = (*PARTS, *EACH),
    ) -> Control:
        """Make a control for the places and paths of given dstates, or reuse the last one."""
        key = tuple(labels), tuple(options), tuple(parts)
        if self._asked is None or self._asked[0] != key:
            with self._asker.grounding_timed():
                at_home = key[0] in self._tight
                control = self._control_for(
                    self._links_of(labels),
                    labels,
                    options,
                    far=self._far_away(labels),
                    parts=BEFORE_MERGING if at_home else parts,
                    labels=labels,
                )
                if at_home:
                    _go_on_at_home(control, self._tight[key[0]][0], parts)
            self._asker.watch.check()
            self._asked = key, control
        return self._asked[1]

    def settled(self, labels: Sequence[int], mode: str) -> Settled:
        """Prepare questions about the best maps with these dstates. `mode` is clingo's opt-mode."""
        return Settled(self._asker, self._reader(self._path_control(labels), labels), mode)

    def improving_maps(self, labels: Sequence[int]) -> Iterator[Found]:
        """Yield maps with these dstates, none costlier than the one before; nothing if none fit."""
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
        """Yield maps with these dstates, as `maps_of_labels` does.

        `options` are those of clasp. Without `EACH` in `parts`, the parts of the program, there is
        one map for each choice of places.
        """
        reader = self._reader(self._path_control(labels, options, parts), labels)
        theory = self._task.theory
        return (yield from maps_of_labels(self._asker, reader, theory, mode, conflicts))

    def _reader(self, control: Control, labels: Sequence[int]) -> PathReader:
        """Make a reader of the places and paths in answers of a control."""
        return PathReader(control, self._task.trace, self._task.theory, self.named.chart, labels)


def _go_on_at_home(control: Control, homes: Mapping[int, list[int]], parts: Iterable[str]) -> None:
    """Restrict each place to its homes (`homes.py`), and ground the other program parts."""
    control.add("homes", [], tight_facts(homes))
    control.ground(
        [(part, []) for part in ("homes", *(part for part in parts if part not in BEFORE_MERGING))]
    )
