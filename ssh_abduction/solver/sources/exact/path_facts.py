"""Write facts for `fast/paths_framed.lp` and `fast/paths_frameless.lp`, and read their answers.

These encodings find places and paths for fixed labels (the dstate of each step or node). A *node*
is the steps of one visit that face the same way. Travels and turns around connect dstates to
*segments*, which are parts of paths. Several segments may be one path.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

from clingo import Control, Model

from ssh_abduction.data.drives import stretches_of
from ssh_abduction.data.trace import Action, Trace
from ssh_abduction.solver.asp.facts import preferred, read_atom
from ssh_abduction.solver.steps.chart import FramedChart
from ssh_abduction.theory.evidence import Equality
from ssh_abduction.theory.theory import Theory


def paths_framed_facts(
    trace: Trace, theory: Theory, chart: FramedChart, forbidden: Sequence[Collection[Equality]] = ()
) -> str:
    """Return the facts for paths_framed.lp about the nodes of a chart: turns, travels and evidence.

    The equalities of steps in a `forbidden` set do not all hold, as evidence says.
    """
    unlinked = {
        chart.node_of[t]
        for t, action in enumerate(trace.actions[: len(chart.node_of) - 1])
        if action.leaves_paths
    }
    facts = [f"rotated({s},{x},{-action})." for s, action, x in chart.links if action < 0]
    facts += [f"travelled({s},{x})." for s, _, x in chart.travels if s not in unlinked]
    facts += [f"turned({s},{turn},{x})." for s, turn, x in chart.turns(trace)]
    facts += [f"excluded({s},{x})." for s, x in chart.excluded]
    visits = {(chart.facing[s][0], chart.facing[x][0]): (s, x) for s, x in chart.away}
    facts += [f"far_nodes({s},{x})." for s, x in visits.values()]
    steps = len(chart.node_of)
    facts += [
        f"together({chart.node_of[i]},{chart.node_of[t]})."
        for i, t in theory.same_place
        if max(i, t) < steps
    ]
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
    close: Iterable[tuple[int, int]] = (),
    *,
    single: bool = False,
) -> str:
    """Return the facts for paths_frameless.lp about dstates and the links between them.

    `links` are triples of a dstate, the number of an action, and the dstate that it leads to. In
    each set of `far`, at least one pair of dstates is at different places. The pairs of `close` are
    at one place. If `single`, places and segments are merged only if the axioms force them to be
    one. This is solved faster.
    """
    facts = [
        sides_framed_facts(theory),
        *(["total."] if theory.path_order == "total" else []),
        *(["single."] if single else []),
    ]
    facts += [f"is({x})." for x in dstates]
    facts += [f"close({x},{y})." for x, y in close]
    for number, pairs in enumerate(far):
        facts += [
            f"far({x},{y})." if len(pairs) == 1 else f"far({number},{x},{y})." for x, y in pairs
        ]
    done = [(s, actions[a], x) for s, a, x in links]
    facts += [
        f"turn({s},{action.turn},{x})." if action.turn else f"travel({s},{x})."
        for s, action, x in done
        if action.kind in ("travel", "turn")
    ]
    return "\n".join([*facts, *preferred(theory)])


def read_contrary(model: Model) -> tuple[list[int], list[int]]:
    """Read why no places and paths fit the labels: two lists of dstates.

    A segment is steps known to be along one path. Returns a dstate of each segment that contradicts
    the axioms, the shortest segment first. Also returns the dstates at which two paths cross, if
    these paths seem to meet again.
    """
    atoms = list(map(read_atom, model.symbols(shown=True)))
    contrary = sorted((args[1], args[0]) for name, args in atoms if name == "contrary")
    return [dstate for _, dstate in contrary], sorted(
        args[0] for name, args in atoms if name == "twice"
    )


def settled_facts(
    theory: Theory, chart: FramedChart, labels: Sequence[int], nodes: Iterable[int]
) -> str:
    """Return the facts for paths_framed.lp that give some nodes of a chart their dstates."""
    facts = [settled_labels((node, labels[node]) for node in nodes)]
    # All nodes of a dstate see the same star (openings), so take any of them.
    for label, node in {label: node for node, label in enumerate(labels)}.items():
        visit, slot = chart.facing[node]
        star = chart.stars[visit]
        facts += [f"open({label},{k})." for k in range(4) if star[(slot + k) % 4]]
    return "\n".join([*facts, *preferred(theory)])


def stretch_facts(trace: Trace, theory: Theory, labels: Iterable[int]) -> str:
    """Return the facts that say on which stretch each dstate is: which drive, between which lifts.

    There are none if a path may be in several pieces. `labels` has the dstate of each
    of the first steps, or of all.
    """
    if "path_in_one_piece" not in theory.axioms:
        return ""
    pairs = dict.fromkeys(zip(labels, stretches_of(trace), strict=False))
    return "\n".join(f"stretch({label},{stretch})." for label, stretch in pairs)


def read_distinct(control: Control) -> tuple[list[int], list[tuple[int, int]]]:
    """Read all segments (parts of paths), and the pairs of segments that cannot be one path."""
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
    """What paths_frameless.lp derives about places and segments before it merges any.

    Attributes:
        places: The places whose dstates are connected by turns. Several of them may be one place of
            a map.
        elsewhere: Pairs of these places that are different places in every map.
        travels: Triples of a segment and two places: in the direction of the segment, a travel
            leads from the first place to the second.
        distinct: Pairs of segments that cannot be one path.
    """

    places: list[int]
    elsewhere: list[tuple[int, int]]
    travels: list[tuple[int, int, int]]
    segments: list[int]
    distinct: list[tuple[int, int]]

    @classmethod
    def read(cls, control: Control) -> Segments:
        """Read places and segments from a control with the parts base and segments grounded."""
        symbols = control.symbolic_atoms

        def atoms(name: str, arity: int) -> list[tuple[int, ...]]:
            return [tuple(read_atom(atom.symbol)[1]) for atom in symbols.by_signature(name, arity)]

        places = sorted(place for (place,) in atoms("visited", 1))
        elsewhere = [(c, p) for c, p in atoms("elsewhere", 2)]
        travels = [(g, c, b) for g, c, b in atoms("travel_on", 3)]
        return cls(places, elsewhere, travels, *read_distinct(control))


def tight_facts(homes: Mapping[int, Iterable[int]]) -> str:
    """Return the facts for paths_frameless.lp that list the fixed places that a place may equal.

    Fixed places are pairwise different. The facts exclude all other places.
    """
    return "tight.\n" + "\n".join(
        f"fixed({place},{home})." for place, found in homes.items() for home in found
    )


def pinned_facts(segments: Iterable[int]) -> str:
    """Return the facts for paths_framed.lp that name segments known to be on different paths."""
    return " ".join(f"pinned({segment})." for segment in segments)


def settled_labels(labels: Iterable[tuple[int, int]]) -> str:
    """Return the facts that give nodes their dstates, from pairs (node, dstate)."""
    return "\n".join(f"is({node},{label})." for node, label in labels)


def open_labels(labels: Sequence[int]) -> str:
    """Return rules by which each answer is a subset of the labels that no paths fit."""
    return "\n".join(
        [
            *(f"{{ is({node},{label}) }}." for node, label in enumerate(labels)),
            ":- not violated.",
            "#show is/2.",
        ]
    )


def read_contraries(model: Model) -> list[int]:
    """Read the dstates whose segments (parts of paths) contradict the axioms."""
    return sorted(
        args[0] for name, args in map(read_atom, model.symbols(shown=True)) if name == "contrary"
    )


def sides_framed_facts(theory: Theory) -> str:
    """Return the facts that say which axioms about the sides of paths a theory has."""
    facts = ["sided."] if theory.boundary != "none" else []
    facts += ["symmetric."] if theory.symmetric_sides else []
    return "\n".join(facts)


def sides_frameless_facts(theory: Theory, actions: Mapping[int, Action]) -> str:
    """Return the facts for sides_frameless.lp: kinds of actions, and the axioms about sides."""
    kinds = [
        f"turns({a},{action.turn})." if action.turn else f"travels({a})."
        for a, action in actions.items()
        if action.kind in ("travel", "turn")
    ]
    return "\n".join([*kinds, sides_framed_facts(theory)])


def turn_facts(
    batch: int, chart: FramedChart, visits: Iterable[int], turns: Iterable[tuple[int, str, int]]
) -> str:
    """Return the facts about a batch: its new visits, and its turns (node, direction, node)."""
    facts = [f"visit({batch},{visit})." for visit in visits]
    for s, turn, x in turns:
        (visit, slot), (_, faced) = chart.facing[s], chart.facing[x]
        facts.append(f"{'about' if turn == 'around' else 'turns'}({batch},{visit},{slot},{faced}).")
    return "\n".join(facts)
