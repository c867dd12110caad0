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

from collections.abc import Collection, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import TypeAlias

import numpy as np
from clingo import Function, Model
from numpy.typing import NDArray

from ssh_abduction.data.drives import stretches_of
from ssh_abduction.data.groups import first_index_of, gathered, minimal_part, numbered
from ssh_abduction.data.maps import DState, MapPath, SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.solver.asp import facts
from ssh_abduction.solver.asp.control import Asker, Control, mapped
from ssh_abduction.solver.asp.facts import number_symbols, places_in_order, read_atom
from ssh_abduction.solver.sources.exact.engine import Task
from ssh_abduction.solver.steps.apart import pairwise_distinct
from ssh_abduction.solver.steps.chart import Chart, FramedChart, Link
from ssh_abduction.solver.steps.faults import links_of, view_at
from ssh_abduction.solver.values import Found
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.theory import Theory

# After this many conflicts, stop improving paths one by one; raise the bound from below instead.
BETTERING = 20_000
# Give clingo up to this many clashes at once. Each of them saves a question, and one control lists
# them all.
CLASHES = 30
# With these options, clasp lists the answers with minimal sets of shown atoms.
SMALLEST = ("--heuristic=Domain", "--dom-mod=5,16", "--enum-mode=domRec")
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

# A path and two of its places, the earlier one first.
_Ahead: TypeAlias = tuple[int, int, int]
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
        self,
        labels: Sequence[int],
        mode: str,
        conflicts: int = -1,
        options: tuple[str, ...] = (),
    ) -> Generator[Found, None, bool]:
        """Yield maps with these dstates. Return whether clingo ended before the limit of conflicts.

        `mode` is clingo's opt-mode; "ignore" for a single map. -1 conflicts mean no limit.
        `options` are those of clasp.
        """
        reader = self._reader(labels, options)
        most, control = int(mode == "ignore"), reader.control
        answers = self._asker.answers(
            reader.read, mode, most, control=control, conflicts=conflicts, ahead=True
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

    def contrary(self, labels: Sequence[int]) -> tuple[list[int], list[int]]:
        """Find out why no places and paths fit labels.

        Returns a dstate of each segment that contradicts the axioms, the shortest segment first.
        Also returns the dstates at which two paths cross, if these paths seem to meet again.
        """
        control = self._base(labels, self._members(labels), ("base", "again"))
        atoms = control.symbolic_atoms
        length: dict[int, int] = {}
        for atom in atoms.by_signature("on_segment", 3):
            dstate = atom.symbol.arguments[0].number
            length[dstate] = length.get(dstate, 0) + 1

        def found(name: str, arity: int) -> set[int]:
            return {x.symbol.arguments[0].number for x in atoms.by_signature(name, arity)}

        contrary = sorted(found("contrary", 1), key=lambda dstate: (length[dstate], dstate))
        return contrary, sorted(found("again", 2))

    def clashes(self, labels: Sequence[int]) -> list[list[Member]]:
        """Find up to `CLASHES` clashes of these labels, which no places and paths fit."""
        members = self._members(labels)
        control = self._base(labels, members)
        if control.symbolic_atoms[Function("violated")] is not None:
            # Clingo finds sets that clash whichever segments and places are one.
            control = self._base(labels, members, ("base", "clash"), SMALLEST, chosen=True)
            numbers = self._asker.answers(
                lambda model: [x.arguments[0].number for x in model.symbols(shown=True)],
                "ignore",
                CLASHES,
                control=control,
            )
            return [[members[number] for number in sorted(found)] for found in numbers]

        def clash(some: list[Member]) -> bool:
            return not any(
                self._has_answer(self._control(labels, some, single=single))
                for single in (True, False)
            )

        return [minimal_part(clash, members)]

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
        chosen: bool = False,
        whole: bool = False,
    ) -> Control:
        """Make a control of paths.lp for some members, with these parts ground.

        If `chosen`, clingo chooses a subset of the members. If `whole`, the labels of all nodes
        count; otherwise only those that the members name.
        """
        theory, where = self.task.theory, self._where(labels)
        dstates = where if whole else [where[step] for member in members for step in member.steps]
        base = [f"is({x})." for x in dict.fromkeys(dstates)]
        base += facts.preferred(theory)
        base += facts.sides(theory)
        base += ["total."] if theory.path_order == "total" else []
        for number, member in enumerate(members):
            base += [f"{{ member({number}) }}."] if chosen else []
            base += [f"{x} :- member({number})." if chosen else f"{x}." for x in member.atoms]
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
    atoms = control.symbolic_atoms

    def found(name: str, arity: int) -> list[tuple[int, ...]]:
        return [read_atom(atom.symbol)[1] for atom in atoms.by_signature(name, arity)]

    segments, places = (sorted(x for (x,) in found(name, 1)) for name in ("segment", "visited"))
    different = set(found("distinct", 3))
    rivals = sorted((g, h) for g, h, d in different if d == 1 and (g, h, -1) in different)
    elsewhere = sorted((c, p) for c, p in found("elsewhere", 2))
    fixed = pairwise_distinct(places, elsewhere)
    homes = homes_of(places, fixed, elsewhere, [(g, c, b) for g, c, b in found("travel_on", 3)])
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


@dataclass(frozen=True, slots=True)
class PathAnswer:
    """The places and paths in an answer of paths.lp.

    Attributes:
        at: For each group of dstates connected by turns: its place in the map, and the rotation
            from the frame of this place to the frame of the group, in quarters clockwise.
        part: For each segment, its path, and its direction on the path (1 or -1).
        order: For each path, its places in order.
    """

    at: dict[int, tuple[int, int]]
    part: dict[int, tuple[int, int]]
    order: dict[int, list[int]]


class PathReader:
    """Reads maps from answers of paths.lp, for fixed labels.

    It asks clingo whether single atoms are in an answer, beginning with the atoms of the last
    answer. That takes a third of the time of reading all atoms. Values that follow from the labels
    are computed once.

    Attributes:
        control: The control whose answers are the places and paths.
    """

    def __init__(
        self, control: Control, trace: Trace, theory: Theory, chart: Chart, labels: Sequence[int]
    ) -> None:
        self.control = control
        stands, runs = (
            {a: (b, c) for a, b, c in _literals(control, name)} for name in ("stands", "runs")
        )
        where = [labels[node] for node in chart.node_of]
        first = first_index_of(where)  # for each label, the first step at its dstate
        self._labels = tuple(numbered(where))
        self._links = links_of(self._labels, trace)
        self._dstates = [(view_at(trace, t), *stands[label]) for label, t in first.items()]
        # For each segment, the dstates on it, and whether they face its direction (1) or not (-1).
        on_paths = [(i, *runs[label]) for i, label in enumerate(first) if label in runs]
        self._runs = gathered((segment, (i, direction)) for i, segment, direction in on_paths)
        self._passes = {
            (segment, self._dstates[i][1]): None
            for segment, members in self._runs.items()
            for i, _ in members
        }
        self._at, self._part = _Options(control, "at"), _Options(control, "course")
        self._total, self._framed = theory.path_order == "total", theory.star == "frame"
        # The literals of atoms of `before`; 0 if an atom is never true.
        self._before: dict[_Ahead, int] = {}
        # For each path, its places in order in the answer that was read last.
        self._order: dict[int, list[int]] = {}

    def read(self, model: Model) -> PathAnswer:
        """Read everything that `map_of` needs from an answer. Then clingo may change the answer."""
        at, part = self._at.made_in(model), self._part.made_in(model)
        on: dict[int, dict[int, None]] = {}  # for each path, the places on it
        for segment, component in self._passes:
            on.setdefault(part[segment][0], {})[at[component][0]] = None
        return PathAnswer(
            at, part, {path: self._ordered(model, path, places) for path, places in on.items()}
        )

    def _ordered(self, model: Model, path: int, places: Collection[int]) -> list[int]:
        """Sort the places of a path. Their order in the last answer saves questions to clingo."""
        order = list(
            dict.fromkeys([*(p for p in self._order.get(path, ()) if p in places), *places])
        )
        if self._total:
            # Insertion sort compares few pairs if the places are nearly in order.
            for i, place in enumerate(order):
                to = i
                while to and not self._is_before(model, (path, order[to - 1], place)):
                    to -= 1
                order.insert(to, order.pop(i))
        else:
            order = places_in_order(
                places,
                (pair for pair in permutations(places, 2) if self._is_before(model, (path, *pair))),
            )
        self._order[path] = order
        return order

    def _is_before(self, model: Model, ahead: _Ahead) -> bool:
        """Return whether an answer has the first of two places of a path before the second."""
        literal = self._before.get(ahead)
        if literal is None:
            atom = model.context.symbolic_atoms[Function("before", number_symbols(*ahead))]
            literal = self._before[ahead] = atom.literal if atom else 0
        return literal != 0 and model.is_true(literal)

    def map_of(self, answer: PathAnswer) -> SSHMap:
        """Make the map that an answer describes."""
        # For each path, its number in the map, and the direction that its first dstate faces.
        faced: dict[int, tuple[int, int]] = {}
        course: dict[int, tuple[int, int]] = {}
        for segment, members in self._runs.items():
            h, ahead = answer.part[segment]
            path, first = faced.setdefault(h, (len(faced), ahead * members[0][1]))
            course |= {i: (path, ahead * first * direction) for i, direction in members}
        # For each place, its number in the map, and the slot that its first dstate faces.
        arrived: dict[int, tuple[int, int]] = {}
        dstates: list[DState] = []
        for i, (view, component, slot) in enumerate(self._dstates):
            p, turned = answer.at[component]
            place, facing = arrived.setdefault(p, (len(arrived), (slot + turned) % 4))
            path_of, direction = course.get(i, (None, None))
            heading = (slot + turned - facing) % 4 if self._framed else None
            dstates.append(DState(i, view, place, path_of, direction, heading))
        paths = tuple(
            MapPath(path, tuple(arrived[p][0] for p in answer.order[h][::first]))
            for h, (path, first) in faced.items()
        )
        return SSHMap(self._labels, tuple(dstates), self._links, tuple(range(len(arrived))), paths)


class _Options:
    """Reads the atoms of a predicate that chooses, for each first argument, the other two.

    In each answer there is exactly one atom for each first argument.
    """

    def __init__(self, control: Control, name: str) -> None:
        # For each first argument, the literals of its atoms, and their other arguments.
        literals = _literals(control, name).items()
        self._among = gathered((a, (literal, (b, c))) for (a, b, c), literal in literals)

    def made_in(self, model: Model) -> dict[int, tuple[int, int]]:
        """Return a dict from the first argument to the other two that an answer chooses for it."""
        made = {}
        # Ask first about the atoms that the last answer had.
        for a, among in self._among.items():
            if len(among) > 1 and not model.is_true(among[0][0]):
                taken = next(i for i, (literal, _) in enumerate(among) if model.is_true(literal))
                among.insert(0, among.pop(taken))
            made[a] = among[0][1]
        return made


def _literals(control: Control, name: str) -> dict[tuple[int, int, int], int]:
    """Return a dict from the three arguments of each atom of a predicate to its literal."""
    found = {}
    for atom in control.symbolic_atoms.by_signature(name, 3):
        a, b, c = read_atom(atom.symbol)[1]
        found[a, b, c] = atom.literal
    return found
