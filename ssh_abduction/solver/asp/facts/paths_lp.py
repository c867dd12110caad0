"""Facts for `fast/paths*.lp`, which find places and paths for fixed labels, and their answers."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

from clingo import Control, Function, Model

from ssh_abduction.data.trace import Action, Trace
from ssh_abduction.solver.asp.facts.atoms import read_atom
from ssh_abduction.solver.asp.facts.readable import preferred
from ssh_abduction.solver.asp.facts.sides_lp import sides_framed_facts
from ssh_abduction.solver.steps.chart import FramedChart
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.theory import Theory


def paths_framed_facts(
    trace: Trace, theory: Theory, chart: FramedChart, forbidden: Sequence[Collection[Equality]] = ()
) -> str:
    """What happened at the nodes of a chart, as facts for paths_framed.lp.

    forbidden  sets of equalities of steps that do not all hold
    """
    slipped = {
        chart.node_of[t]
        for t, action in enumerate(trace.actions[: len(chart.node_of) - 1])
        if action.slipped
    }
    facts = [f"rotated({s},{x},{-action})." for s, action, x in chart.links if action < 0]
    facts += [f"travelled({s},{x})." for s, _, x in chart.travels if s not in slipped]
    facts += [f"turned({s},{turn},{x})." for s, turn, x in chart.turns(trace)]
    facts += [f"excluded({s},{x})." for s, x in chart.excluded]
    visits = {(chart.facing[s][0], chart.facing[x][0]): (s, x) for s, x in chart.away}
    facts += [f"far_nodes({s},{x})." for s, x in visits.values()]
    steps = len(chart.node_of)
    for number, equalities in enumerate(forbidden):
        if all(max(equality.first, equality.second) < steps for equality in equalities):
            nodes = [
                (chart.node_of[equality.first], chart.node_of[equality.second], equality.of)
                for equality in equalities
            ]
            facts += [f"part({number},{k},{s},{x},{of})." for k, (s, x, of) in enumerate(nodes)]
    return "\n".join([*facts, sides_framed_facts(theory)])


def paths_frameless_facts(
    theory: Theory,
    dstates: Iterable[int],
    links: Iterable[tuple[int, int, int]],
    actions: Mapping[int, Action],
    far: Iterable[Collection[tuple[int, int]]] = (),
    *,
    single: bool = False,
) -> str:
    """Dstates and their links, as facts for paths_frameless.lp.

    Args:
        theory: The theory.
        dstates: The dstates.
        links: Links with actions as numbers.
        actions: The actions by number.
        far: Sets of pairs of dstates. In each set some pair is not at one place.
        single: Merge no places or segments unless they have to be one.
    """
    facts = [
        sides_framed_facts(theory),
        *(["total."] if theory.path_order == "total" else []),
        *(["single."] if single else []),
    ]
    facts += [f"is({x})." for x in dstates]
    for number, pairs in enumerate(far):
        facts += [
            f"far({x},{y})." if len(pairs) == 1 else f"far({number},{x},{y})." for x, y in pairs
        ]
    done = [(s, actions[a], x) for s, a, x in links]
    facts += [
        f"turn({s},{action.turn},{x})." if action.turn else f"travel({s},{x})."
        for s, action, x in done
        if action.kind
    ]
    return "\n".join([*facts, *preferred(theory)])


def read_contrary(model: Model) -> tuple[list[int], list[int]]:
    """Dstates that show that there are no places and paths.

    Returns:
        The dstates of contrary segments, short ones first; and dstates whose paths seem to
        cross twice.
    """
    atoms = list(map(read_atom, model.symbols(shown=True)))
    contrary = sorted((args[1], args[0]) for name, args in atoms if name == "contrary")
    return [dstate for _, dstate in contrary], sorted(
        args[0] for name, args in atoms if name == "twice"
    )


def settled_facts(
    theory: Theory,
    chart: FramedChart,
    labels: Sequence[int],
    nodes: Iterable[int],
    *,
    single: bool = False,
) -> str:
    """The labels of these nodes, as facts for paths_framed.lp.

    Args:
        theory: The theory.
        chart: The chart of the nodes.
        labels: The dstate of each node.
        nodes: The nodes to use.
        single: Merge no places or segments unless they have to be one.
    """
    facts = [
        settled_labels((node, labels[node]) for node in nodes),
        *(["single."] if single else []),
    ]
    for label, node in {
        label: node for node, label in enumerate(labels)
    }.items():  # all nodes of a dstate see one star (its openings)
        visit, slot = chart.facing[node]
        star = chart.stars[visit]
        facts += [f"open({label},{k})." for k in range(4) if star[(slot + k) % 4]]
    return "\n".join([*facts, *preferred(theory)])


def read_rivals(control: Control) -> tuple[list[int], list[tuple[int, int]]]:
    """All segments, and the pairs of them that cannot be one path in either direction."""
    segments = sorted(
        read_atom(atom.symbol)[1][0] for atom in control.symbolic_atoms.by_signature("segment", 1)
    )
    distinct = {
        tuple(read_atom(atom.symbol)[1])
        for atom in control.symbolic_atoms.by_signature("distinct", 3)
    }
    return segments, [
        (g, h) for g, h, direction in distinct if direction == 1 and (g, h, -1) in distinct
    ]


@dataclass(frozen=True)
class Segments:
    """What paths_frameless.lp derives about segments and places before merging any.

    Attributes:
        places: The places that turns distinguish.
        elsewhere: Pairs of places that are not one.
        travels: A segment, and two places that a travel along it leads between, in its direction.
        segments: All segments.
        distinct: Pairs of segments that are not one path.
    """

    places: list[int]
    elsewhere: list[tuple[int, int]]
    travels: list[tuple[int, int, int]]
    segments: list[int]
    distinct: list[tuple[int, int]]

    @classmethod
    def read(cls, control: Control) -> Segments:
        """Read a control in which the parts base and segments are grounded."""
        symbols = control.symbolic_atoms

        def atoms(name: str, arity: int) -> list[tuple[int, ...]]:
            return [tuple(read_atom(atom.symbol)[1]) for atom in symbols.by_signature(name, arity)]

        places = sorted(place for (place,) in atoms("visited", 1))
        elsewhere, travels = (
            [(c, p) for c, p in atoms("elsewhere", 2)],
            [(g, c, b) for g, c, b in atoms("travel_on", 3)],
        )
        return cls(places, elsewhere, travels, *read_rivals(control))


def tight_facts(homes: Mapping[int, Iterable[int]]) -> str:
    """For each place the fixed places that it may be, as facts for paths_frameless.lp."""
    return "tight.\n" + "\n".join(
        f"fixed({place},{home})." for place, found in homes.items() for home in found
    )


def pinned_facts(segments: Iterable[int]) -> str:
    """Segments no two of which can be one path, as facts for paths_framed.lp."""
    return " ".join(f"pinned({segment})." for segment in segments)


def read_told(model: Model) -> tuple[bool, list[tuple[int, int]], list[tuple[int, int]]]:
    """Read what follows from labels of nodes.

    Returns:
        Whether the labels have no places and paths. If they may have some: the pairs of dstates
        at different places, and the pairs that are one.
    """
    found: dict[str, list[tuple[int, int]]] = {"elsewhere": [], "one": []}
    for name, args in map(read_atom, model.symbols(shown=True)):
        if name == "violated":
            return True, [], []
        found[name].append((args[0], args[1]))
    return False, found["elsewhere"], found["one"]


def is_violated(control: Control) -> bool:
    """Whether grounding alone shows that no places and paths fit the labels of nodes."""
    return control.symbolic_atoms[Function("violated")] is not None


def loose(labels: Iterable[int]) -> str:
    """Dstates whose labels may be wrong, as facts."""
    return "\n".join(f"loose({label})." for label in labels)


def settled_labels(labels: Iterable[tuple[int, int]]) -> str:
    """Nodes and their dstates, as facts."""
    return "\n".join(f"is({node},{label})." for node, label in labels)


def open_labels(labels: Sequence[int]) -> str:
    """Labels of nodes. clingo chooses some that have no places and paths."""
    return "\n".join(
        [
            *(f"{{ is({node},{label}) }}." for node, label in enumerate(labels)),
            ":- not violated.",
            "#show is/2.",
        ]
    )


def read_contraries(model: Model) -> list[int]:
    """Dstates whose paths show that there are no places and paths for them."""
    return sorted(
        args[0] for name, args in map(read_atom, model.symbols(shown=True)) if name == "contrary"
    )
