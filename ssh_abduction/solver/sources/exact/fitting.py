"""Finds places and paths for given dstates.

The input is a label, the number of a dstate, for each node of a chart. paths.lp finds the fewest
places and paths that fit the labels. If none fit, then mostly some single path contradicts the
axioms. Otherwise there is a *clash*: a minimal set of links and evidence that no places and paths
fit.

Travels and turns around join dstates to *segments*, which are parts of paths. Several segments may
be one path. In the same way turns connect dstates to small places, and several of these may be one
place of the map.

*Pairwise distinct segments and places.* To find the fewest paths, pairwise distinct segments get
paths of their own. Then other segments are assigned to these paths, or to new ones. The same is
done with places. As an example, take a corridor of forty landmarks, driven there and back. The
places of the way there are forty distinct places, so no map has fewer. Without this, it would be a
pigeonhole problem to prove that the way back needs no other places. To find a map with these places
alone is a similar problem. So clingo also gets the few *homes* that each place has in such a map.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from clingo import Model
from numpy.typing import NDArray

from ssh_abduction.data.drives import stretches_of
from ssh_abduction.data.groups import first_index_of, gathered, minimal_part, numbered
from ssh_abduction.data.maps import DState, MapPath, SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.solution.values import Found
from ssh_abduction.solver.asp import facts
from ssh_abduction.solver.asp.control import Asker, Control, mapped
from ssh_abduction.solver.asp.facts import places_in_order, read_atom
from ssh_abduction.solver.sources.exact.engine import Task
from ssh_abduction.solver.steps.apart import pairwise_distinct
from ssh_abduction.solver.steps.chart import Chart, FramedChart, Link
from ssh_abduction.solver.steps.faults import links_of, view_at
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.theory import Theory

# After this many conflicts, stop improving paths one by one; raise the bound from below instead.
BETTERING = 20_000
# Clasp prepares to solve for about these multiples of the time and the memory that grounding took.
# It cannot be stopped meanwhile.
PREPARING = (1.6, 2.1)
# Keep at most this many controls. A control takes some megabytes, and making it again may take
# seconds.
KEPT = 10
# The parts of paths.lp: SEGMENTS derives which places and segments are different before any two are
# one. PLACES finds the places and paths that fit labels.
SEGMENTS = ("base", "again", "segments")
PLACES = ("least", "paths")

# For each predicate, the arguments of its atoms in an answer.
_Answer: TypeAlias = dict[str, list[tuple[int, ...]]]
# The labels of all nodes, and the options of clasp.
_Question: TypeAlias = tuple[tuple[int, ...], tuple[str, ...]]


@dataclass(frozen=True)
class Member:
    """What labels imply for places and paths: a link between dstates, or evidence about dstates.

    Attributes:
        atoms: Its atoms for paths.lp.
        steps: The steps whose dstates imply it.
        link: The link; None for evidence.
    """

    atoms: tuple[str, ...]
    steps: tuple[int, ...]
    link: Link | None = None


class Fitting:
    """Asks clingo for the places and paths that fit labels, or why none fit."""

    def __init__(self, task: Task, asker: Asker) -> None:
        """Begin without a chart; `take` comes first."""
        self._chart: Chart
        self.task, self._asker = task, asker
        self._framed = task.theory.star == "frame"
        # Sets of equalities of steps. In no map do all equalities of one set hold.
        self._forbidden: list[Collection[Equality]] = []
        # The controls for the places and paths of labels, the one that was used last at the end.
        self._controls: dict[_Question, Control] = {}

    def take(self, chart: Chart) -> None:
        """Ask about labels of the nodes of this chart from now on."""
        self._chart = chart
        self._controls.clear()

    def forbid(self, equalities: Collection[Equality]) -> None:
        """Exclude all maps in which all of these equalities of steps hold."""
        if any(equality.of == "place" for equality in equalities):
            self._forbidden.append(equalities)
            self._controls.clear()

    def some(self, labels: Sequence[int]) -> Found | None:
        """Find a map with these dstates; None if no places and paths fit them."""
        return next(self.maps(labels, "ignore"), None)

    def improving(self, labels: Sequence[int]) -> Iterator[Found]:
        """Yield maps with these dstates, none costlier than the one before. The last is the best.

        If improving the maps takes many conflicts, clingo raises the lower bound instead (`usc`).
        """
        proven = yield from self.maps(labels, "opt", BETTERING)
        if not proven:
            yield from self.maps(labels, "opt", options=("--opt-strategy=usc",))

    def maps(
        self, labels: Sequence[int], mode: str, conflicts: int = -1, options: tuple[str, ...] = ()
    ) -> Generator[Found, None, bool]:
        """Yield maps with these dstates. Return whether clingo ended before the limit of conflicts.

        `mode` is clingo's opt-mode; "ignore" for a single map. -1 conflicts mean no limit.
        `options` are those of clasp.
        """
        reader = self._reader(labels, options)
        most, control = int(mode == "ignore"), reader.control
        answers = self._asker.answers(
            read_answer, mode, most, control=control, conflicts=conflicts, ahead=True
        )
        theory = self.task.theory
        return (yield from mapped(lambda answer: Found.of(reader.map_of(answer), theory), answers))

    def _reader(self, labels: Sequence[int], options: tuple[str, ...]) -> PathReader:
        """Make a reader of the places and paths that fit these dstates."""
        question = tuple(labels), options
        control = self._controls.pop(question, None)
        if control is None:
            control = self._control(labels, self._members(labels), options, pins=True)
            if len(self._controls) == KEPT:
                del self._controls[next(iter(self._controls))]
        self._controls[question] = control
        return PathReader(control, self.task.trace, self.task.theory, self._chart, labels)

    def contrary(self, labels: Sequence[int]) -> list[int]:
        """List a dstate of each segment that contradicts the axioms, the shortest segment first."""
        control = self._base(labels, self._members(labels))
        length = Counter(dstate for dstate, *_ in _atoms(control, "on_segment", 3))
        found = (dstate for (dstate,) in _atoms(control, "contrary", 1))
        return sorted(found, key=lambda dstate: (length[dstate], dstate))

    def clash(self, labels: Sequence[int]) -> list[Member]:
        """Find a clash of these labels, which no places and paths fit."""

        def clashes(some: list[Member]) -> bool:
            return not any(
                self._has_answer(self._control(labels, some, single=single))
                for single in (True, False)
            )

        return minimal_part(clashes, self._members(labels))

    def _has_answer(self, control: Control) -> bool:
        """Whether a control has an answer, that is, places and paths."""
        return next(self._asker.answers(lambda _: True, "ignore", 1, control=control), False)

    def _control(
        self,
        labels: Sequence[int],
        members: Sequence[Member],
        options: tuple[str, ...] = (),
        *,
        pins: bool = False,
        single: bool = False,
    ) -> Control:
        """Make a control whose answers are the places and paths that fit some members.

        If `pins`, all places and paths of the labels are wanted, and pairwise distinct ones are
        pinned. If `single`, places and segments are only one if they must be. This is solved
        faster.
        """
        self._asker.watch.check()
        with self._asker.grounding_timed():
            control = self._base(labels, members, SEGMENTS, options, whole=pins)
            more = ["single."] if single else []
            if pins and self.task.speedups.clique:
                more += _distinct(control)
            control.add("more", [], "\n".join(more))
            # With the last part, answers that differ only in paths are listed, too.
            parts = ("more", *PLACES, *(["each"] if pins else []))
            control.ground([(part, []) for part in parts])
        self._asker.watch.check()
        return control

    def _base(
        self,
        labels: Sequence[int],
        members: Sequence[Member],
        parts: Iterable[str] = ("base",),
        options: Sequence[str] = (),
        *,
        whole: bool = False,
    ) -> Control:
        """Make a control of paths.lp for some members, with these parts ground.

        If `whole`, the labels of all nodes count; otherwise only those that the members name.
        """
        theory, where = self.task.theory, self._where(labels)
        dstates = where if whole else [where[step] for member in members for step in member.steps]
        base = [f"is({x})." for x in dict.fromkeys(dstates)]
        base += facts.preferred(theory)
        base += facts.sides(theory)
        base += ["total."] if theory.path_order == "total" else []
        base += [f"{atom}." for member in members for atom in member.atoms]
        if isinstance(self._chart, FramedChart):
            # All nodes of a dstate see the same star (openings), so take any of them.
            for label, node in {label: node for node, label in enumerate(labels)}.items():
                visit, slot = self._chart.facing[node]
                star = self._chart.stars[visit]
                base += [f"open({label},{k})." for k in range(4) if star[(slot + k) % 4]]
        if "path_in_one_piece" in theory.axioms:
            pairs = dict.fromkeys(zip(where, stretches_of(self.task.trace), strict=False))
            base += [f"stretch({label},{stretch})." for label, stretch in pairs]
        slots = f"slots={4 if self._framed else 1}"
        control = Control(("-c", slots, *options), self._asker.watch.check, PREPARING)
        control.load_encodings("paths", "preference")
        control.add("base", [], "\n".join(base))
        control.ground([(part, []) for part in parts])
        return control

    def _where(self, labels: Sequence[int]) -> list[int]:
        """Return the dstate of each step."""
        return [labels[node] for node in self._chart.node_of]

    def _members(self, labels: Sequence[int]) -> list[Member]:
        """List the links between dstates that labels imply, and the evidence about places."""
        return [*self._links(labels), *self._evidence(labels)]

    def _links(self, labels: Sequence[int]) -> Iterator[Member]:
        """Yield the travels and turns between dstates, each once."""
        where, known = self._where(labels), set[Link]()
        steps = zip(self.task.trace.actions, self.task.log.actions, strict=True)
        for t, (action, number) in enumerate(steps):
            if t + 1 == len(where):
                return
            link = where[t], number, where[t + 1]
            if action.kind in ("travel", "turn") and link not in known:
                known.add(link)
                name = f"turn({link[0]},{action.turn},{link[2]})"
                atom = name if action.turn else f"travel({link[0]},{link[2]})"
                yield Member((atom,), (t, t + 1), link)

    def _evidence(self, labels: Sequence[int]) -> Iterator[Member]:
        """Yield what is known about dstates at different places or at one, single pairs first."""
        where, theory = self._where(labels), self.task.theory
        away = self.task.log.pairs.elsewhere.items()
        far = {(where[i], where[t]): (i, t) for t, others in away if t < len(where) for i in others}
        first = {node: step for step, node in reversed([*enumerate(self._chart.node_of)])}
        for i, j in self._chart.excluded:
            if labels[i] == labels[j]:
                far[labels[i], labels[j]] = first[i], first[j]
        yield from (Member((f"far({x},{y})",), steps) for (x, y), steps in far.items())
        for i, t in theory.same_place:
            if max(i, t) < len(where):
                yield Member((f"close({where[i]},{where[t]})",), (i, t))
        for number, equalities in enumerate(self._forbidden):
            steps = tuple(dict.fromkeys(step for e in equalities for step in (e.first, e.second)))
            if max(steps) < len(where) and all(
                where[e.first] == where[e.second] for e in equalities if e.of == "dstate"
            ):
                pairs = [(where[e.first], where[e.second]) for e in equalities if e.of == "place"]
                atoms = [f"far({number},{x},{y})" for x, y in dict.fromkeys(pairs)]
                single = f"far({pairs[0][0]},{pairs[0][1]})"
                yield Member((single,) if len(atoms) == 1 else tuple(atoms), steps)


def _distinct(control: Control) -> list[str]:
    """Return facts about pairwise distinct segments and places, for the parts SEGMENTS are ground.

    Such places are *fixed*. If all other places of a map are among the fixed ones, each is one of
    its homes.
    """
    segments, places = (
        sorted(x for (x,) in _atoms(control, name, 1)) for name in ("segment", "visited")
    )
    different = set(_atoms(control, "distinct", 3))
    rivals = sorted((g, h) for g, h, d in different if d == 1 and (g, h, -1) in different)
    elsewhere = sorted((c, p) for c, p in _atoms(control, "elsewhere", 2))
    fixed = pairwise_distinct(places, elsewhere)
    travels = [(g, c, b) for g, c, b in _atoms(control, "travel_on", 3)]
    homes = homes_of(places, fixed, elsewhere, travels)
    return [
        *(f"pinned({segment})." for segment in pairwise_distinct(segments, rivals)),
        *(f"fixed({place})." for place in fixed),
        *(f"home({place},{home})." for place, some in homes.items() for home in some),
    ]


def homes_of(
    places: Sequence[int],
    fixed: Sequence[int],
    elsewhere: Iterable[tuple[int, int]],
    travels: Sequence[tuple[int, int, int]],
) -> dict[int, list[int]]:
    """Find the homes of each place: the fixed places that it may be, if there are no others.

    Suppose that a map has only as many places as there are fixed ones, which are pairwise
    distinct. Then each other place is a fixed place, its home. If a place comes after another along
    a path, its home comes after the home of the other. This leaves few homes.

    Args:
        places: The places of dstates. Several of them may be one place of a map.
        fixed: Places that are pairwise distinct.
        elsewhere: Pairs of distinct places.
        travels: A travel of a segment leads from a place to another: (segment, place, place).
    """
    number = {place: i for i, place in enumerate(places)}
    columns = [number[place] for place in fixed]
    may_be = np.ones((len(places), len(places)), dtype=bool)
    for c, p in elsewhere:
        may_be[number[c], number[p]] = may_be[number[p], number[c]] = False
    may_be = may_be[:, columns]
    may_be[columns] = np.eye(len(fixed), dtype=bool)
    steps = [(segment, number[c], number[b]) for segment, c, b in travels]
    along = gathered((segment, (c, b)) for segment, c, b in steps)
    follows = {segment: _may_follow(pairs, columns) for segment, pairs in along.items()}
    before = -1
    while before != (before := int(may_be.sum())):
        for segment, c, b in [*steps, *reversed(steps)]:
            look_at_clock()
            may_be[c] &= (follows[segment] & may_be[b]).any(axis=1)
            may_be[b] &= (follows[segment] & may_be[c][:, None]).any(axis=0)
    return {
        place: [fixed[k] for k in np.flatnonzero(row).tolist()]
        for place, row in zip(places, may_be, strict=True)
    }


def _may_follow(pairs: list[tuple[int, int]], columns: list[int]) -> NDArray[np.bool_]:
    """Find which fixed places may come after each other on the path of a segment.

    A segment is a set of steps known to be along one path.

    Args:
        pairs: For each travel of the segment, the places where it begins and ends.
        columns: The numbers of the f fixed places.

    Returns:
        Whether fixed place j may come after fixed place i, at [i, j], (f, f).
    """
    members = sorted({place for pair in pairs for place in pair})
    number = {place: i for i, place in enumerate(members)}
    after = np.zeros((len(members), len(members)), dtype=np.float32)
    for c, b in pairs:
        after[number[c], number[b]] = 1
    reached = 0
    while reached != (reached := int(np.count_nonzero(after))):
        after = np.minimum(after + after @ after, 1)
    here = [k for k, place in enumerate(columns) if place in number]
    rows = [number[columns[k]] for k in here]
    follows = ~np.eye(len(columns), dtype=bool)
    follows[np.ix_(here, here)] &= after[np.ix_(rows, rows)].T == 0
    return follows


class PathReader:
    """Reads maps from answers of paths.lp, for fixed labels.

    Values that follow from the labels are computed once.

    Attributes:
        control: The control whose answers are the places and paths.
    """

    def __init__(
        self, control: Control, trace: Trace, theory: Theory, chart: Chart, labels: Sequence[int]
    ) -> None:
        self.control, self._framed = control, theory.star == "frame"
        stands = {label: (c, slot) for label, c, slot in _atoms(control, "stands", 3)}
        runs = {label: (g, direction) for label, g, direction in _atoms(control, "runs", 3)}
        where = [labels[node] for node in chart.node_of]
        self._labels = tuple(numbered(where))
        self._links = links_of(self._labels, trace)
        # For each dstate: its view, its place before any two are one, the slot that it faces there,
        # and its segment with the direction that it faces, or None.
        self._dstates = [
            (view_at(trace, t), *stands[label], runs.get(label))
            for label, t in first_index_of(where).items()
        ]

    def map_of(self, answer: _Answer) -> SSHMap:
        """Make the map that an answer describes."""
        at = {c: (place, turned) for c, place, turned in answer["at"]}
        course = {g: (path, direction) for g, path, direction in answer.get("course", ())}
        ahead: dict[int, int] = {}  # for each place, the slot that its first dstate faces
        dstates: list[DState] = []
        on: dict[int, dict[int, None]] = {}  # for each path, its places
        for i, (view, c, slot, run) in enumerate(self._dstates):
            place, turned = at[c]
            facing = slot + turned
            heading = (facing - ahead.setdefault(place, facing)) % 4 if self._framed else None
            path = direction = None
            if run is not None:
                path, direction = course[run[0]]
                direction *= run[1]
                on.setdefault(path, {})[place] = None
            dstates.append(DState(i, view, place, path, direction, heading))
        before = gathered((h, (p, q)) for h, p, q in answer.get("before", ()))
        paths = tuple(
            MapPath(h, tuple(places_in_order(places, before.get(h, ()))))
            for h, places in on.items()
        )
        return SSHMap(self._labels, tuple(dstates), self._links, tuple(ahead), paths).renumbered()


def read_answer(model: Model) -> _Answer:
    """Read the atoms of an answer. Then clingo may change the answer."""
    return gathered(map(read_atom, model.symbols(shown=True)))


def _atoms(control: Control, name: str, arity: int) -> list[tuple[int, ...]]:
    """List the arguments of all atoms of a predicate."""
    return [read_atom(x.symbol)[1] for x in control.symbolic_atoms.by_signature(name, arity)]
