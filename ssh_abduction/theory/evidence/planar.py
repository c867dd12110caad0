"""Paths meet at places only: a map can be drawn in the plane, with turns right to the right, without a crossing.

>>> from ssh_abduction import Theory, Trace, solve
>>> trace = Trace.from_steps("aaaaa", ["travel", "around", "travel", "around"])
>>> [len(solve(trace, Theory(planar=planar, prefer=())).maps) for planar in (False, True)]
[2, 1]

A travel leads along an edge from a gateway of one place to a gateway of another, and no edge passes
a place unseen: a gateway leads to one other gateway. Around a place, the order of gateways is told
by turns, and where places have frames by stars, too; where it is not told, any order will do. So a
map is planar if *some* orders make a drawing of it. A map of first steps has fewer edges, and what
it says of orders the whole map says, too: a cut keeps a map planar.

To take an equality of places away may make a planar map one that is not: edges that crossed at a
place now cross elsewhere. So what cannot be is, that some steps are at one place while others are
at different ones. It is read off as few travels and turns as cross by themselves. For the places
given, an equality of dstates only takes drawings away; so of those only as few are said as let the
edges cross.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations, pairwise, product
from typing import TYPE_CHECKING, ClassVar, TypeAlias, TypeVar

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.star import Openings
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.theory.evidence.protocol import Equality
from ssh_abduction.theory.pairs import NO_PAIRS, Pairs
from ssh_abduction.theory.planarity import Ends, can_be_drawn, has_way, is_planar

if TYPE_CHECKING:
    from ssh_abduction.theory.theory import Theory

Side = TypeVar("Side", bound=Hashable)

QUARTERS = {"right": 1, "around": 2, "left": 3}
SLOTS = 4
BEHIND = 2  # so many slots from the one that is faced

AHEAD, BACK = 1, -1
# of an edge: its place, the group of dstates that it is known from, and its slot as that group has
# it
End: TypeAlias = tuple[int, int, int]
Arm: TypeAlias = tuple[int, int]  # what is ahead of a dstate, or back
Gateway: TypeAlias = tuple[int, Arm]  # of a place, and one of its arms that are this gateway


@dataclass(frozen=True)
class Planar:
    """The field `planar` of a theory.

    frames    places have frames of four slots: turns tell how many slots are between what two dstates face. If not, they tell sides only
    turns     turns tell what they tell
    stars     stars seen at a place agree, each turned by its heading
    distinct  no two dstates face one slot
    crossing  without frames: where a turn leads from one edge to another, these cross
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

    def remembering(self, known: Planar) -> Planar:
        return self

    def pairs(self, trace: Trace) -> Pairs:
        return NO_PAIRS

    def facts(self, trace: Trace, start: int, stop: int) -> str:
        return ""

    def refuse(self, trace: Trace, ssh_map: SSHMap, since: int = 0) -> frozenset[Equality] | None:
        places = [ssh_map.dstates[label].place for label in ssh_map.labels]
        labels: Mapping[int, int] = dict(enumerate(ssh_map.labels))
        moves = _first_moves(trace, ssh_map.labels)
        if since and all(t + 1 < since for t in moves):  # what the map is since then, it was before
            return None
        at = {t: place for t, place in enumerate(places) if place is not None}
        if len(at) < len(places) or not self._cross(trace, moves, labels, at, self.distinct):
            return None
        distinct = self.distinct and not self._cross(trace, moves, labels, at, False)
        moves = _fewest(moves, lambda fewer: self._cross(trace, fewer, labels, at, distinct))
        steps = sorted({step for t in moves for step in (t, t + 1)})
        if not distinct:
            labels = _split(
                labels, steps, lambda finer: self._cross(trace, moves, finer, at, False)
            )
        return frozenset(_description(labels, at, steps, distinct))

    def _cross(
        self,
        trace: Trace,
        moves: Sequence[int],
        labels: Mapping[int, int],
        at: Mapping[int, int],
        distinct: bool,
    ) -> bool:
        """Whether these travels and turns alone cannot be drawn.

        moves     the steps at which they begin
        labels    the dstate of each step
        at        the place of each step
        distinct  no two dstates face one slot
        """
        shown = _Shown(trace, moves, labels, at, stars=self.stars)
        return not (
            _can_draw_framed(shown, self.turns, distinct)
            if self.frames
            else _can_draw_sided(shown, self.crossing)
        )


def _first_moves(trace: Trace, labels: Sequence[int]) -> list[int]:
    """The steps at which the travels and turns of a map were first done."""
    first: dict[tuple[int, str, int], int] = {}
    for t, (here, there) in enumerate(pairwise(labels)):
        action = trace.steps[t].action
        if action is not None and action.kind is not None:
            first.setdefault((here, action.name, there), t)
    return sorted(first.values())


class _Shown:
    """What some travels and turns of a trace show.

    travels  pairs of dstates
    turns    at one place: a dstate, which way, and the dstate that is faced then
    places   the place of each dstate
    stars    the openings seen at each dstate, from ahead on clockwise
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
    """Whether there are headings with which the edges can be drawn.

    Dstates that turns link are turned to each other as the turns say; how others are turned is
    open, unless stars tell.
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
    """The slots that the ends of edges at a place may have, up to turning the place."""
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
    """Whether the edges both ends of which have slots join each gateway to one other, and do not cross."""
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
    """Whether each gateway is the end of one edge."""
    return len({gateway for edge in edges for gateway in edge}) == sum(map(len, edges))


def _groups(shown: _Shown, turns: bool) -> tuple[dict[int, int], dict[int, int], bool]:
    """For each dstate, one of those that turns link it to, and how many slots from that one it faces; and whether the turns agree in that."""
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
    return (
        group,
        slot,
        all(
            (slot[y] - slot[x] - quarters) % SLOTS == 0
            for x, ys in links.items()
            for y, quarters in ys
        ),
    )


def _can_draw_sided(shown: _Shown, crossing: bool) -> bool:
    """Whether there are orders of gateways with which the edges can be drawn, by sides: a turn tells which gateway is to the right of an edge, where both dstates
    are at an edge. Who turns around faces the gateway that was behind.

    crossing  where a turn leads from one edge to another, these cross
    """
    same = _Classes()
    for x, turn, y in shown.turns:
        if turn == "around":
            same.join((x, AHEAD), (y, BACK))
    edges = _paired(shown, same)
    if edges is None:
        return False
    clockwise: dict[int, list[list[Arm]]] = {place: [] for place in shown.places.values()}
    at_edge = _at_edges(shown)
    for x, turn, y in shown.turns:
        if turn != "around" and x in at_edge and y in at_edge:
            right, left = ((y, AHEAD), (y, BACK)) if turn == "right" else ((y, BACK), (y, AHEAD))
            told = [(x, AHEAD), right, (x, BACK), left]
            clockwise[shown.places[x]].append(
                [same.of(arm) for arm in told if crossing or arm != (y, BACK)]
            )
    ends = [end for edge in edges for end in tuple(edge) * (3 - len(edge))]

    @cache
    def allows(place: int, order: Ends) -> bool:
        arms = [ends[end][1] for end in order]
        others = dict.fromkeys(arm for told in clockwise[place] for arm in told if arm not in arms)
        return _can_complete(arms, list(others), clockwise[place])

    return can_be_drawn(
        [(p, q) for (p, _), (q, _) in zip(ends[::2], ends[1::2], strict=True)], allows
    )


def _paired(shown: _Shown, same: _Classes) -> list[frozenset[Gateway]] | None:
    """The edges, each of which joins one gateway to one other, once gateways at one place to which one gateway leads are said to be one; None where it leads to
    gateways at different places.
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
                same.join(first[1], other[1])
        if _are_paired(edges):
            return edges


def _at_edges(shown: _Shown) -> set[int]:
    """The dstates that a travel starts or ends at, and those that turns around link to them."""
    found = {dstate for travel in shown.travels for dstate in travel}
    around = [{x, y} for x, turn, y in shown.turns if turn == "around"]
    while more := {dstate for pair in around if pair & found for dstate in pair} - found:
        found |= more
    return found


def _can_complete(order: list[Arm], others: list[Arm], clockwise: Sequence[Sequence[Arm]]) -> bool:
    """Whether the other gateways, too, can be put into a clockwise order of some, so that all is as told."""
    if not all(_is_clockwise(order, told) for told in clockwise):
        return False
    if not others:
        return True
    first, *rest = others
    return any(
        _can_complete([*order[:gap], first, *order[gap:]], rest, clockwise)
        for gap in range(1 if order else 0, len(order) + 1)
    )


def _is_clockwise(order: Sequence[Arm], told: Sequence[Arm]) -> bool:
    """Whether what is there already of some gateways is in this order."""
    positions = [order.index(arm) for arm in told if arm in order]
    if len(set(told)) < len(told):
        return False
    return sum(positions[i - 1] > positions[i] for i in range(len(positions))) <= 1


class _Classes:
    """Arms some of which are one."""

    def __init__(self) -> None:
        self._one_of: dict[Arm, Arm] = {}

    def of(self, arm: Arm) -> Arm:
        while arm in self._one_of:
            arm = self._one_of[arm]
        return arm

    def join(self, first: Arm, second: Arm) -> None:
        """Say that two arms are one; then what lies opposite, straight on, is one, too."""
        for turned in (1, -1):
            one, other = (self.of((dstate, side * turned)) for dstate, side in (first, second))
            if one != other:
                self._one_of[one] = other


def _fewest(moves: list[int], cross: Callable[[list[int]], bool]) -> list[int]:
    """As few of some travels and turns as cross still: none of them can be left out."""
    size = max(1, len(moves) // 2)
    while True:
        begin = 0
        while begin < len(moves):
            look_at_clock()
            fewer = moves[:begin] + moves[begin + size :]
            if cross(fewer):
                moves = fewer
            else:
                begin += size
        if size == 1:
            return moves
        size //= 2


def _split(
    labels: Mapping[int, int], steps: Sequence[int], cross: Callable[[Mapping[int, int]], bool]
) -> Mapping[int, int]:
    """Labels of these steps by which as few of them are one dstate as let the edges cross still."""
    new = max(labels.values()) + 1
    for step in steps:
        look_at_clock()
        finer = {**labels, step: new + step}
        if cross(finer):
            labels = finer
    return labels


def _description(
    labels: Mapping[int, int], at: Mapping[int, int], steps: Sequence[int], distinct: bool
) -> Iterator[Equality]:
    """Which of these steps are one dstate, and which are at one place, and which are not."""
    first: dict[int, int] = {}  # step of each dstate
    for step in steps:
        if first.setdefault(labels[step], step) != step:
            yield Equality(first[labels[step]], step)
    visits: dict[int, list[int]] = {}  # of each place, the first step of each of its dstates
    for step in first.values():
        visits.setdefault(at[step], []).append(step)
    for here in visits.values():
        yield from (Equality(here[0], step, "place") for step in here[1:])
        yield from (Equality(i, j, holds=False) for i, j in combinations(here, 2) if distinct)
    yield from (
        Equality(i[0], j[0], "place", holds=False) for i, j in combinations(visits.values(), 2)
    )
