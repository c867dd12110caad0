"""Check that the edges of a map can be drawn in the plane without a crossing.

>>> there_back_and_there = [(0, 1), (2, 3), (4, 5)]
>>> edges = Edges(there_back_and_there, [], {0: 0, 1: 1, 2: 1, 3: 0, 4: 0, 5: 1})
>>> edges.can_be_drawn_by({0: 1, 1: 1, 2: 0, 3: 2, 4: 3, 5: 3})
True
>>> edges.can_be_drawn_by({0: 1, 1: 1, 2: 2, 3: 2, 4: 3, 5: 2})
False

An arm is the gateway ahead of a dstate or behind it. A travel leads from the arm ahead of one
dstate to the arm behind another one. Arms lie around a place in some order, and two arms may be one
gateway.

If places have frames (numbered directions), this module lists all headings that turns and stars
allow, and tries them place by place. Headings make a drawing if each gateway is joined to one
other, and the clockwise order of gateways around each place is planar.

Without frames the module lists the clockwise orders of gateways that turns allow.

`theory/planarity.py` decides whether orders are planar, and searches for a drawing. The evidence
uses it, too, so the tests compare it with networkx and with a brute force.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import TypeAlias

from ssh_abduction.data.groups import reached
from ssh_abduction.data.star import Openings
from ssh_abduction.data.step import QUARTERS
from ssh_abduction.theory.planarity import can_be_drawn, clockwise_orders, has_way, is_planar

# A dstate, and 1 (ahead) or -1 (behind).
Arm: TypeAlias = tuple[int, int]
# The clockwise position of each arm around its place. Arms of one gateway share a position.
Option: TypeAlias = Mapping[Arm, int]


class Edges:
    """The travels and turns of a map, for tests of whether they can be drawn without a crossing.

    Args:
        travels: Pairs of dstate ids: where a travel starts and where it ends.
        turns: For each turn the dstate before it, its kind ("right", "left" or "around"), and the
            dstate after it. Turns between places are ignored.
        place_of: The place of each dstate.
    """

    def __init__(
        self,
        travels: Iterable[tuple[int, int]],
        turns: Iterable[tuple[int, str, int]],
        place_of: Mapping[int, int],
    ) -> None:
        self.travels = list(travels)
        self.place_of = place_of
        self.turns = [(s, turn, t) for s, turn, t in turns if place_of[s] == place_of[t]]
        self._used = {arm for s, t in self.travels for arm in ((s, 1), (t, -1))}
        self._at: dict[int, list[int]] = defaultdict(list)  # the dstates at each place
        for s, p in place_of.items():
            self._at[p].append(s)

    def can_be_drawn_by(self, headings: Mapping[int, int]) -> bool:
        """Tell whether the slots that dstates face, 0 to 3 clockwise, give a planar drawing."""
        return self._is_drawing(
            {(s, side): (headings[s] + (1 - side)) % 4 for s in self.place_of for side in (1, -1)}
        )

    def can_be_drawn_in_frames(
        self, stars: Mapping[int, Iterable[Openings]], *, turned: bool, distinct: bool
    ) -> bool:
        """Tell whether some headings in frames of four slots make a drawing without a crossing.

        Headings must make the stars of one place (openings ahead, right, back and left)
        agree. If `turned`, turns must rotate the heading. If `distinct`, the dstates of a
        place must face different slots.
        """
        options = [
            self._options(here, stars, turned=turned, distinct=distinct)
            for here in self._at.values()
        ]
        return self._some_option_draws(options)

    def _options(
        self,
        here: Sequence[int],
        stars: Mapping[int, Iterable[Openings]],
        *,
        turned: bool,
        distinct: bool,
    ) -> list[Option]:
        """List the positions that the arms of the dstates at one place may have in a frame."""
        turns = [(s, QUARTERS[turn], t) for s, turn, t in self.turns if s in here] if turned else []
        headings: list[dict[int, int]] = [{here[0]: 0}]
        for t in here[1:]:
            headings = [
                {**faced, t: k}
                for faced in headings
                for k in range(4)
                if not (distinct and k in faced.values())
            ]
            headings = [
                faced for faced in headings if all(_is_turned(faced, turn) for turn in turns)
            ]
        # headings that differ by a rotation of the place are one option
        found: dict[tuple[int, ...], Option] = {}
        for faced in headings:
            seen = {
                tuple(star[(k - faced[s]) % 4] for k in range(4))
                for s in here
                for star in stars.get(s, ())
            }
            if len(seen) <= 1:
                option = {
                    (s, side): (faced[s] + (1 - side)) % 4
                    for s in here
                    for side in (1, -1)
                    if (s, side) in self._used
                }
                first = next(iter(option.values()), 0)
                found.setdefault(tuple((k - first) % 4 for k in option.values()), option)
        return list(found.values())

    def can_be_drawn(self, *, crossing: bool) -> bool:
        """Tell whether some clockwise orders of gateways make a drawing without a crossing.

        This is for places without frames: a turn shows only the side, not the angle. If
        `crossing`, the path after a right or left turn lies on both sides of the path
        before it. Otherwise only the part ahead is known to lie on the side of the turn.
        """
        one = self._gateways()
        if one is None:
            return False
        sequences = self._sequences(one, crossing)
        edges = {
            frozenset(((self.place_of[s], one[s, 1]), (self.place_of[t], one[t, -1])))
            for s, t in self.travels
        }
        ends = [choose(edge, key=repr) for edge in edges for choose in (min, max)]
        # All clockwise orders of the gateways of a place that agree with its turns.
        orders = {
            p: clockwise_orders(
                sorted({arm for arms in sequences[p] for arm in arms}, key=repr),
                partial(_agrees, sequences[p]),
            )
            for p in self._at
        }

        def allows(place: int, some: Sequence[int]) -> bool:
            return any(
                _goes_round(order, list(dict.fromkeys(ends[end][1] for end in some)))
                for order in orders[place]
            )

        return can_be_drawn(
            [(p, q) for (p, _), (q, _) in zip(ends[::2], ends[1::2], strict=True)], allows
        )

    def _sequences(self, one: Mapping[Arm, Arm], crossing: bool) -> Mapping[int, list[list[Arm]]]:
        """For each place, find gateways that are known to follow each other clockwise."""
        around: dict[int, set[int]] = defaultdict(set)
        for s, turn, t in self.turns:
            if turn == "around":
                around[s].add(t)
                around[t].add(s)
        at_edge = reached((s for s, _ in self._used), around.__getitem__).keys()
        sequences: dict[int, list[list[Arm]]] = defaultdict(list)
        for s, turn, t in self.turns:
            if turn != "around" and {s, t} <= at_edge:
                side = 1 if turn == "right" else -1
                arms = [(s, 1), (t, side), (s, -1), (t, -side)]
                sequences[self.place_of[s]].append(
                    [one[arm] for arm in arms if crossing or arm != (t, -1)]
                )
        return sequences

    def _gateways(self) -> dict[Arm, Arm] | None:
        """Find the arms that are one gateway: a dict from each arm to the arm that represents it.

        A turn around faces what was behind. A gateway leads to one gateway, so if two arms are one,
        the arms at their far ends are one. None if a gateway leads to two places.
        """
        one = {(s, side): (s, side) for s in self.place_of for side in (1, -1)}

        def join(first: Arm, second: Arm) -> bool:
            changed = False
            for turned in (1, -1):
                old, new = one[first[0], turned * first[1]], one[second[0], turned * second[1]]
                if old != new:
                    changed = True
                    one.update({arm: new for arm, gateway in one.items() if gateway == old})
            return changed

        for s, turn, t in self.turns:
            if turn == "around":
                join((s, 1), (t, -1))
        # joining gateways may show that their far ends are one, so repeat
        changed = True
        while changed:
            changed = False
            beyond: dict[Arm, Arm] = {}
            for s, t in self.travels:
                for here, there in (((s, 1), (t, -1)), ((t, -1), (s, 1))):
                    other = beyond.setdefault(one[here], there)
                    if self.place_of[other[0]] != self.place_of[there[0]]:
                        return None
                    changed = join(other, there) or changed
        return one

    def _some_option_draws(self, options: list[list[Option]]) -> bool:
        """Tell whether one option can be chosen for each place so that they make a drawing.

        Options are chosen place by place. A partial choice that makes no drawing is not extended.
        """
        settled: Option = {
            arm: k for some in options if len(some) == 1 for arm, k in some[0].items()
        }
        others = sorted((some for some in options if len(some) != 1), key=len)

        def extended(chosen: Option, some: list[Option]) -> Iterator[Option]:
            return (more for option in some if self._is_drawing(more := {**chosen, **option}))

        return self._is_drawing(settled) and has_way(settled, others, extended)

    def _is_drawing(self, position: Option) -> bool:
        """Tell whether a drawing exists for the travels whose arms both have a position.

        Each gateway has to be joined to one other, and the clockwise orders have to be planar.
        """
        joined = {
            frozenset(((self.place_of[s], position[s, 1]), (self.place_of[t], position[t, -1])))
            for s, t in self.travels
            if (s, 1) in position and (t, -1) in position
        }
        ends: dict[tuple[int, int], int] = {}
        around: dict[object, tuple[int, ...]] = {}
        for edge, gateways in enumerate(joined):
            for end, gateway in enumerate(gateways, 2 * edge):
                if ends.setdefault(gateway, end) != end:
                    return False
            # an edge that leads back to its own gateway gets an extra place at its other end
            if len(gateways) == 1:
                around["beyond", edge] = (2 * edge + 1,)
        for place, position_there in sorted(ends):
            around[place] = (*around.get(place, ()), ends[place, position_there])
        return is_planar(around)


def _is_turned(faced: Mapping[int, int], turn: tuple[int, int, int]) -> bool:
    """Tell whether headings fit a turn. They do if one of its two headings is not chosen yet."""
    s, quarters, t = turn
    return s not in faced or t not in faced or (faced[s] + quarters - faced[t]) % 4 == 0


def _agrees(sequences: Sequence[Sequence[Arm]], order: Sequence[Arm]) -> bool:
    """Whether a clockwise order agrees with sequences that are known to be clockwise."""
    return all(_goes_round(order, some) for some in sequences)


def _goes_round(order: Sequence[Arm], sequence: Sequence[Arm]) -> bool:
    """Whether a sequence has distinct gateways that `order` has in the same cyclic order.

    Gateways that are not in `order` yet do not count.
    """
    there = [order.index(gateway) for gateway in sequence if gateway in order]
    return (
        len(set(sequence)) == len(sequence)
        and sum(j < i for i, j in zip(there, [*there[1:], *there[:1]], strict=True)) <= 1
    )
