"""Read maps from answers of `fast/paths.lp`.

This encoding gets dstates and links as input, and finds places and paths for them. Travels and
turns around join dstates to *segments*, which are parts of paths. Several segments may be one path.
In the same way turns connect dstates to small places, and several of these may be one place of the
map.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import TypeAlias

from clingo import Function, Model

from ssh_abduction.data.groups import first_index_of, gathered, numbered
from ssh_abduction.data.maps import DState, MapPath, SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.solver.asp.control import Control
from ssh_abduction.solver.asp.facts import number_symbols, places_in_order, read_atom
from ssh_abduction.solver.steps.chart import Chart
from ssh_abduction.solver.steps.faults import links_of, view_at
from ssh_abduction.theory.theory import Theory

# A path and two of its places, the earlier one first.
_Ahead: TypeAlias = tuple[int, int, int]


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

    def condition(self, sort: str, i: int, j: int) -> str | None:
        """Return the body of a rule that holds if two dstates share a place, path or course.

        `sort` is "places", "paths" or "courses". Returns None if they never share one, as a dstate
        is along no path.
        """
        if sort == "places":
            return f"at({self._dstates[i][1]},P,_), at({self._dstates[j][1]},P,_)"
        runs = {
            dstate: (segment, direction)
            for segment, members in self._runs.items()
            for dstate, direction in members
        }
        if i not in runs or j not in runs:
            return None
        (g, d), (h, e) = runs[i], runs[j]
        same_way = f", {d} * D == {e} * E" if sort == "courses" else ""
        return f"course({g},H,D), course({h},H,E){same_way}"

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
