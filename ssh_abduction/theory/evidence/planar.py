"""Planarity as evidence: paths meet at places only, so a map can be drawn without a crossing.

>>> from ssh_abduction import Theory, Trace, solve
>>> trace = Trace.from_steps("aaaaa", ["travel", "around", "travel", "around"])
>>> [len(solve(trace, Theory(planar=planar, prefer=())).maps) for planar in (False, True)]
[2, 1]

A gateway is a way out of a place. A travel leads along an edge from a gateway of one place to a
gateway of another, and passes no place unseen. So a gateway leads to exactly one other gateway.
Turns show the order of the gateways around a place. If places have frames (numbered directions),
stars (the openings seen) show it, too. A map is planar if *some* orders that agree with this allow
a drawing without a crossing. If a map is planar, so is the map of its first steps: it has fewer
edges, and its orders are parts of the same orders.

If a map is not planar, `refuse` returns a conflict: statements about a few travels and turns whose
edges cross by themselves. They say which steps are at one place, and which are at different places.
Both matter: if one place becomes two, edges that met there may cross elsewhere. For given places,
more equal dstates only make drawing harder. So the conflict has only the equalities of dstates that
make the edges cross.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations, pairwise, product
from typing import TYPE_CHECKING, ClassVar, TypeAlias, TypeVar

from ssh_abduction.data.groups import NodeClasses, gathered, minimal_part
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.star import Openings
from ssh_abduction.data.step import QUARTERS
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.theory.evidence.protocol import Equality, Evidence
from ssh_abduction.theory.planarity import Ends, can_be_drawn, has_way, is_planar

if TYPE_CHECKING:
    from ssh_abduction.theory.theory import Theory

Side = TypeVar("Side", bound=Hashable)

SLOTS = 4
BEHIND = 2  # slots from the one that is faced to the one behind

AHEAD, BACK = 1, -1
# The end of an edge: its place, its group of dstates that turns link, and its slot relative to the
# first dstate of the group.
End: TypeAlias = tuple[int, int, int]
Arm: TypeAlias = tuple[int, int]  # a dstate, and whether ahead of it or behind it
Gateway: TypeAlias = tuple[int, Arm]  # a place, and one of the arms that are this gateway


@dataclass(frozen=True)
class Planar(Evidence):
    """Evidence that maps can be drawn in the plane (the field `planar` of a theory).

    Attributes:
        frames: Whether places have frames of four slots (directions). Turns then give the number
            of slots between the headings of two dstates. Otherwise they give right and left only.
        turns: Whether the axioms allow using the turns.
        stars: Whether the stars (openings seen) of a place agree when turned by their headings.
        distinct: Whether different dstates at a place face different slots.
        crossing: Without frames: whether two edges cross if a turn leads from one to the other.
    """

    name: ClassVar[str] = "planar"
    axiom: ClassVar[str] = "planar"
    frames: bool
    turns: bool
    stars: bool
    distinct: bool
    crossing: bool

    @classmethod
    def of(cls, theory: Theory) -> Planar:
        axioms = set(theory.axioms)
        frames = theory.star == "frame"
        return cls(
            frames=frames,
            turns=not frames or {"turn_rotates", "one_heading"} <= axioms,
            stars="star_frame" in axioms,
            distinct="one_dstate_per_heading" in axioms,
            crossing=theory.symmetric_sides,
        )

    def refuse(self, trace: Trace, ssh_map: SSHMap, since: int = 0) -> frozenset[Equality] | None:
        places = [ssh_map.dstates[label].place for label in ssh_map.dstate_at]
        labels: Mapping[int, int] = dict(enumerate(ssh_map.dstate_at))
        moves = _first_moves(trace, ssh_map.dstate_at)
        if since and all(t + 1 < since for t in moves):  # no edge or turn is new since then
            return None
        at = {t: place for t, place in enumerate(places) if place is not None}
        if len(at) < len(places) or not self._cross(trace, moves, labels, at, self.distinct):
            return None
        distinct = self.distinct and not self._cross(trace, moves, labels, at, False)
        moves = minimal_part(lambda fewer: self._cross(trace, fewer, labels, at, distinct), moves)
        moves.sort()
        steps = sorted({step for t in moves for step in (t, t + 1)})
        if not distinct:
            labels = split(labels, steps, lambda finer: self._cross(trace, moves, finer, at, False))
        return frozenset(description(labels, at, steps, distinct))

    def _cross(
        self,
        trace: Trace,
        moves: Sequence[int],
        labels: Mapping[int, int],
        at: Mapping[int, int],
        distinct: bool,
    ) -> bool:
        """Whether travels and turns that begin at `moves` cannot be drawn without a crossing."""
        shown = _Shown(trace, moves, labels, at, stars=self.stars)
        return not (
            _can_draw_framed(shown, self.turns, distinct)
            if self.frames
            else _can_draw_sided(shown, self.crossing)
        )


def _first_moves(trace: Trace, labels: Sequence[int]) -> list[int]:
    """List the steps where each travel and turn of a map is done for the first time."""
    first: dict[tuple[int, str, int], int] = {}
    for t, (here, there) in enumerate(pairwise(labels)):
        action = trace.steps[t].action
        if action is not None and action.kind in ("travel", "turn"):
            first.setdefault((here, action.name, there), t)
    return sorted(first.values())


class _Shown:
    """What some travels and turns of a trace show, as keys of dicts, which keep their order.

    A travel has its first and last dstate, a turn at a place also its direction. `places` has the
    place of each dstate, `stars` the openings seen there, clockwise from ahead.
    """

    def __init__(
        self,
        trace: Trace,
        moves: Sequence[int],
        labels: Mapping[int, int],
        at: Mapping[int, int],
        *,
        stars: bool,
    ) -> None:
        self.travels: dict[tuple[int, int], None] = {}
        self.turns: dict[tuple[int, str, int], None] = {}
        self.places: dict[int, int] = {}
        self.stars: dict[int, set[Openings]] = {}
        for t in moves:
            action = trace.steps[t].action
            here, there = labels[t], labels[t + 1]
            assert action is not None
            if action.kind == "travel":
                self.travels[here, there] = None
            elif action.turn is not None and at[t] == at[t + 1]:
                self.turns[here, action.turn, there] = None
            for step in (t, t + 1):
                self.places[labels[step]] = at[step]
                seen = self.stars.setdefault(labels[step], set())
                if stars and (openings := trace.steps[step].openings) is not None:
                    seen.add(openings)


def _can_draw_framed(shown: _Shown, turns: bool, distinct: bool) -> bool:
    """Whether some headings allow the edges to be drawn, if places have frames of four slots.

    Turns fix the headings of the dstates that they link, relative to each other. The others may
    have any heading that the stars (openings seen) allow.
    """
    group, slot, agree = _groups(shown, turns)
    ahead = {s: (place, group[s], slot[s]) for s, place in shown.places.items()}
    behind = {s: (place, group[s], (slot[s] + BEHIND) % SLOTS) for s, place in shown.places.items()}
    edges = {(ahead[x], behind[y]): None for x, y in shown.travels}
    ends: dict[int, list[End]] = {place: [] for place in shown.places.values()}
    for end in dict.fromkeys(end for edge in edges for end in edge):
        ends[end[0]].append(end)
    choices = {place: _slots_of(shown, group, slot, place, ends[place], distinct) for place in ends}
    if not agree or not all(choices.values()):
        return False
    fixed = {end: k for slots in choices.values() if len(slots) == 1 for end, k in slots[0].items()}
    left = [place for place, slots in choices.items() if len(slots) > 1]

    def ways(chosen: dict[End, int], place: int) -> Iterator[dict[End, int]]:
        return (more for slots in choices[place] if _is_drawing(edges, more := chosen | slots))

    return _is_drawing(edges, fixed) and has_way(
        fixed, sorted(left, key=lambda place: len(choices[place])), ways
    )


def _slots_of(
    shown: _Shown,
    group: Mapping[int, int],
    slot: Mapping[int, int],
    place: int,
    ends: Sequence[End],
    distinct: bool,
) -> list[dict[End, int]]:
    """List all ways to choose slots for the ends of edges at a place, as dicts from end to slot.

    Ways that differ only by a rotation of the whole place count once. `group` has the first dstate
    that turns link to each dstate, and `slot` the slot relative to that.
    """
    here = [s for s in shown.places if shown.places[s] == place]
    groups = list(dict.fromkeys(group[s] for s in here))
    found: dict[tuple[int, ...], dict[End, int]] = {}
    for turned in product(*(range(SLOTS if i else 1) for i in range(len(groups)))):
        look_at_clock()
        quarters = dict(zip(groups, turned, strict=True))
        faced = {s: (slot[s] + quarters[group[s]]) % SLOTS for s in here}
        seen = {
            tuple(star[(k - faced[s]) % SLOTS] for k in range(SLOTS))
            for s in here
            for star in shown.stars[s]
        }
        if len(seen) <= 1 and not (distinct and len(set(faced.values())) < len(faced)):
            slots = [(k + quarters[g]) % SLOTS for _, g, k in ends]
            found.setdefault(
                tuple((k - slots[0]) % SLOTS for k in slots), dict(zip(ends, slots, strict=True))
            )
    return list(found.values())


def _is_drawing(edges: Iterable[tuple[End, End]], slots: Mapping[End, int]) -> bool:
    """Whether edges with known directions (slots) at both ends can be drawn without a crossing."""
    joined = {
        frozenset((end[0], slots[end]) for end in edge)
        for edge in edges
        if edge[0] in slots and edge[1] in slots
    }
    if not _are_paired(joined):
        return False
    around: dict[int, list[tuple[int, int]]] = {}
    for number, edge in enumerate(joined):
        for side, (place, k) in enumerate(tuple(edge) * (3 - len(edge))):
            around.setdefault(place, []).append((k, 2 * number + side))
    return is_planar(
        {place: tuple(end for _, end in sorted(ends)) for place, ends in around.items()}
    )


def _are_paired(edges: Collection[frozenset[Side]]) -> bool:
    """Whether each gateway is the end of only one edge."""
    return len({gateway for edge in edges for gateway in edge}) == sum(map(len, edges))


def _groups(shown: _Shown, turns: bool) -> tuple[dict[int, int], dict[int, int], bool]:
    """Group the dstates that turns link.

    Returns three things: for each dstate, the first dstate of its group; for each dstate, the
    number of quarter turns from that first dstate; and whether all turns agree.
    """
    links: dict[int, list[tuple[int, int]]] = {dstate: [] for dstate in shown.places}
    for x, turn, y in shown.turns if turns else ():
        links[x].append((y, QUARTERS[turn]))
        links[y].append((x, -QUARTERS[turn]))
    group: dict[int, int] = {}
    slot: dict[int, int] = {}
    for first in links:
        queue = [] if first in group else [first]
        group.setdefault(first, first)
        slot.setdefault(first, 0)
        while queue:
            x = queue.pop()
            for y, quarters in links[x]:
                if y not in group:
                    group[y], slot[y] = first, (slot[x] + quarters) % SLOTS
                    queue.append(y)
    drawn = ((x, y, quarters) for x, ys in links.items() for y, quarters in ys)
    return group, slot, all((slot[y] - slot[x] - quarters) % SLOTS == 0 for x, y, quarters in drawn)


def _can_draw_sided(shown: _Shown, crossing: bool) -> bool:
    """Whether some orders of gateways allow the edges to be drawn, if turns give sides only.

    If both dstates of a turn are at ends of edges, the turn shows which gateway is to the right of
    an edge. After turning around, a robot faces the gateway that was behind it.
    """
    same = NodeClasses[Arm]()
    for x, turn, y in shown.turns:
        if turn == "around":
            _join(same, (x, AHEAD), (y, BACK))
    edges = _paired(shown, same)
    if edges is None:
        return False
    clockwise: dict[int, list[list[Arm]]] = {place: [] for place in shown.places.values()}
    at_edge = _at_edges(shown)
    for x, turn, y in shown.turns:
        if turn != "around" and x in at_edge and y in at_edge:
            right, left = ((y, AHEAD), (y, BACK)) if turn == "right" else ((y, BACK), (y, AHEAD))
            arms_there = [(x, AHEAD), right, (x, BACK), left]
            clockwise[shown.places[x]].append(
                [same.of(arm) for arm in arms_there if crossing or arm != (y, BACK)]
            )
    # An edge from a gateway to itself has one end, which counts twice.
    ends = [end for edge in edges for end in tuple(edge) * (3 - len(edge))]

    @cache
    def allows(place: int, order: Ends) -> bool:
        arms = [ends[end][1] for end in order]
        others = dict.fromkeys(
            arm for arms_there in clockwise[place] for arm in arms_there if arm not in arms
        )
        return _can_complete(arms, list(others), clockwise[place])

    return can_be_drawn(
        [(p, q) for (p, _), (q, _) in zip(ends[::2], ends[1::2], strict=True)], allows
    )


def _paired(shown: _Shown, same: NodeClasses[Arm]) -> list[frozenset[Gateway]] | None:
    """Find the edges, each between two gateways. None if a gateway leads to two places.

    If two gateways of a place lead to the same gateway, they are merged. This changes `same`.
    """
    joined = [
        ((shown.places[x], (x, AHEAD)), (shown.places[y], (y, BACK))) for x, y in shown.travels
    ]
    while True:
        edges = list(
            dict.fromkeys(frozenset((p, same.of(arm)) for p, arm in edge) for edge in joined)
        )
        beyond: dict[Gateway, Gateway] = {}
        for edge in edges:
            ends = tuple(edge) * (3 - len(edge))
            for end, other in (ends, ends[::-1]):
                first = beyond.setdefault(end, other)
                if first[0] != other[0]:
                    return None
                _join(same, first[1], other[1])
        if _are_paired(edges):
            return edges


def _at_edges(shown: _Shown) -> set[int]:
    """The dstates at which travels start or end, and those that turning around links to them."""
    found = {dstate for travel in shown.travels for dstate in travel}
    around = [{x, y} for x, turn, y in shown.turns if turn == "around"]
    while more := {dstate for pair in around if pair & found for dstate in pair} - found:
        found |= more
    return found


def _can_complete(order: list[Arm], others: list[Arm], clockwise: Sequence[Sequence[Arm]]) -> bool:
    """Whether a clockwise order of arms (gateways) can be completed to agree with all turns."""
    if not all(_is_clockwise(order, sequence) for sequence in clockwise):
        return False
    if not others:
        return True
    first, *rest = others
    return any(
        _can_complete([*order[:gap], first, *order[gap:]], rest, clockwise)
        for gap in range(1 if order else 0, len(order) + 1)
    )


def _is_clockwise(order: Sequence[Arm], sequence: Sequence[Arm]) -> bool:
    """Whether `sequence` has this clockwise order. Arms not in `order` are ignored."""
    positions = [order.index(arm) for arm in sequence if arm in order]
    if len(set(sequence)) < len(sequence):
        return False
    return sum(positions[i - 1] > positions[i] for i in range(len(positions))) <= 1


def _join(same: NodeClasses[Arm], first: Arm, second: Arm) -> None:
    """Record that two arms (of dstates) are one gateway, and that their opposite arms are one."""
    for turned in (1, -1):
        same.merge((second[0], second[1] * turned), (first[0], first[1] * turned))


def split(
    labels: Mapping[int, int], steps: Sequence[int], cross: Callable[[Mapping[int, int]], bool]
) -> Mapping[int, int]:
    """Give each of these steps a dstate of its own, unless the edges then no longer cross."""
    new = max(labels.values()) + 1
    for step in steps:
        look_at_clock()
        finer = {**labels, step: new + step}
        if cross(finer):
            labels = finer
    return labels


def description(
    labels: Mapping[int, int], at: Mapping[int, int], steps: Sequence[int], distinct: bool
) -> Iterator[Equality]:
    """Yield which of these steps are one dstate or at one place, and which are not.

    `labels` and `at` have the dstate and the place of each step. With `distinct`, also yield
    that dstates at one place are different.
    """
    first: dict[int, int] = {}  # the first step of each dstate
    for step in steps:
        if first.setdefault(labels[step], step) != step:
            yield Equality(first[labels[step]], step)
    # for each place, the first step of each of its dstates
    visits = gathered((at[step], step) for step in first.values())
    for here in visits.values():
        yield from (Equality(here[0], step, "place") for step in here[1:])
        yield from (Equality(i, j, holds=False) for i, j in combinations(here, 2) if distinct)
    yield from (
        Equality(i[0], j[0], "place", holds=False) for i, j in combinations(visits.values(), 2)
    )
