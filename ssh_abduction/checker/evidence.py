"""Checks of the axioms about stars, pairs of steps, poses and planar drawings.

A star is the gateways seen at a step. Users may assert that two steps are the same or different.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import TypeAlias

from ssh_abduction.checker.reading import Found, MapLink, Reading, heading_of
from ssh_abduction.checker.topological import stars_of
from ssh_abduction.data.groups import NodeClasses, minimal_part, parts, reached
from ssh_abduction.data.odometry import Closure, Odometry, match_in_words
from ssh_abduction.data.star import Openings, Star
from ssh_abduction.data.step import QUARTERS
from ssh_abduction.theory.planarity import can_be_drawn, clockwise_orders, has_way, is_planar

_LIFTS = ("lift", "stairs")
# A dstate, and 1 (ahead) or -1 (behind).
Arm: TypeAlias = tuple[int, int]
# The clockwise position of each arm around its place. Arms of one gateway share a position.
Option: TypeAlias = Mapping[Arm, int]


def floors_of(m: Reading) -> dict[int, int]:
    """For each dstate, find the first dstate on its floor.

    The dstates of a floor are connected by common places, and by links that are not lifts.
    """
    pairs = [(t.source.id, t.target.id) for t in m.moves if t.action.kind not in _LIFTS]
    for s in m.states.values():
        pairs += [
            (s.id, x.id) for x in m.states.values() if s.place is not None and s.place == x.place
        ]
    in_order = sorted(m.states, key=lambda label: m.first.get(label, len(m.trace)))
    floors = parts(in_order, pairs)
    return {label: next(iter(floor)) for floor in floors for label in floor}


def other_floor(m: Reading) -> Found:
    """Check that the two ends of a lift are on different floors."""
    floor = m.once(floors_of)
    for t in m.moves:
        if t.action.kind in _LIFTS and floor[t.source.id] == floor[t.target.id]:
            yield (
                t.steps,
                f"{t} leads to another floor, but other links or places join both dstates.",
            )


def one_landing(m: Reading) -> Found:
    """Check that a lift leads from one place to one place."""
    landings: dict[tuple[int, str], MapLink] = {}
    for t in m.moves:
        if t.action.kind in _LIFTS and t.source.place is not None:
            other = landings.setdefault((t.source.place, t.action.name), t)
            if other.target.place != t.target.place:
                yield (
                    sorted({*other.steps, *t.steps}),
                    f"{other} and {t} lead from one place to places {other.target.place} and "
                    f"{t.target.place}.",
                )


def path_in_one_piece(m: Reading) -> Found:
    """Check that each path is on one floor, and in one piece of the map."""
    floor = m.once(floors_of)
    for h, there in m.along.items():
        first, *others = there.values()
        for s in others:
            if floor[s] != floor[first]:
                yield (
                    m.steps_of(first, s),
                    f"Dstates {first} and {s} are along path {h}, but no places and no links "
                    "without lifts connect them.",
                )
                break


def floors_are_listed(m: Reading) -> Found:
    """Check that a map lists the floors of all dstates, numbered by first visit, or of none."""
    listed = {s.id: s.floor for s in m.map.dstates}
    if not m.theory.lifts:
        if any(floor is not None for floor in listed.values()):
            yield [], "The map lists floors, but the trace has no lifts."
        return
    if all(floor is None for floor in listed.values()):
        return
    number: dict[int, int] = {}
    for i, s in m.visited:
        floor = number.setdefault(m.once(floors_of)[s.id], len(number))
        if listed.get(s.id) != floor:
            yield (
                [i],
                f"Dstate {s.id} is on floor {listed.get(s.id)} in the map, but its links and "
                f"places say floor {floor}.",
            )


def one_star(m: Reading) -> Found:
    """Check that all stars seen at a dstate show the same gateways, in the same directions."""
    seen: dict[int, dict[Star, int]] = {}
    for t, label, step in zip(m.steps, m.map.dstate_at, m.trace.steps, strict=False):
        stars, star = seen.setdefault(label, {}), step.gateways or Star(())
        for other, i in stars.items() if star not in stars else ():
            if not _may_show_the_same(other, star):
                yield (
                    [i, t],
                    f"Steps {i} and {t} are one dstate, {label}, but the gateways seen there are "
                    "not in the same directions.",
                )
        stars.setdefault(star, t)


def asserted(m: Reading) -> Found:
    """Check that the map satisfies each assertion of the theory about a pair of steps."""
    labels, theory = m.map.dstate_at, m.theory
    claims = [
        ("one dstate", theory.same),
        ("different dstates", theory.different),
        ("at different places", theory.elsewhere),
        ("at one place", theory.same_place),
    ]
    for said, pairs in claims:
        # only steps that the map labels are compared
        for i, j in ([m.steps[t] for t in pair] for pair in pairs if max(pair) < len(labels)):
            here, there = labels[i], labels[j]
            places = [m.states[label].place for label in (here, there) if label in m.states]
            is_one, is_known = len({*places}) == 1, None not in places
            got = ""
            if said in ("different dstates", "at different places") and here == there:
                got = f"one dstate, {here}"
            elif said == "at different places" and is_one and is_known:
                got = f"at one place, {places[0]}"
            elif said == "one dstate" and here != there:
                got = f"dstates {here} and {there}"
            elif said == "at one place" and places and not (is_one and is_known):
                got = f"at places {' and '.join(map(str, places))}"
            if got:
                yield [i, j], f"Steps {i} and {j} are {got}, but are said to be {said}."


def one_pose(m: Reading) -> Found:
    """Check that displacements agree with one pose per dstate and one position per place."""
    from ssh_abduction.checker.displacements import refused_returns  # loads numpy

    trusted = m.trace.without_displacements_at(
        [fault.step for fault in m.map.faults if fault.kind == "jumped"]
    )
    for refused in refused_returns(trusted, m.map, m.theory, m.since):
        said = " and ".join(
            f"steps {m.steps[i]} and {m.steps[j]} are at one "
            f"{'place' if freedom == 2 else 'dstate'}"
            for i, j, freedom in refused.returns
        )
        steps = [t for i, j, _ in refused.returns for t in (i, j)]
        yield (
            steps,
            f"By the displacements it cannot be that {said}: {refused.why} (chi-square "
            f"{refused.square:.0f}, and at most {refused.most:.0f} is allowed).",
        )


def closure(m: Reading) -> Found:
    """Check that closures agree with one pose per dstate and one position per place.

    A closure is a measured displacement between two steps of the trace.
    """
    labels, odometry = m.map.dstate_at, m.trace.odometry or Odometry()
    for match in m.trace.closures:
        i, j = match.first, match.last
        if j >= len(labels):
            continue
        named = m.steps[i], m.steps[j]
        here, there = (m.states.get(labels[step]) for step in (i, j))
        for freedom, kind, is_one in (
            (3, "dstate", labels[i] == labels[j]),
            (2, "place", here and there and here.place is not None and here.place == there.place),
        ):
            if is_one and _p_value(match, odometry, freedom) < m.theory.reject / max(
                m.theory.returns, 1
            ):
                yield (
                    [i, j],
                    f"Steps {named[0]} and {named[1]} are at one {kind}, but "
                    f"{match_in_words(match, *named)} and a turn of "
                    f"{math.degrees(match.displacement[2]):.0f} degrees.",
                )


def _p_value(match: Closure, odometry: Odometry, freedom: int) -> float:
    """Compute the p-value of a closure if its two steps have equal poses, or equal positions.

    `freedom` is 3 for poses and 2 for positions.
    """
    import numpy as np
    from scipy.special import chdtrc  # scipy.stats has the same, and loads for half a second

    spreads = np.array([odometry.offset, odometry.offset, odometry.facing])
    total = np.array(match.covariance) + np.diag(2 * spreads * spreads)
    x, y, turned = match.displacement
    off = np.array([x, y, math.remainder(turned, math.tau)])[:freedom]
    square = off @ np.linalg.inv(total[:freedom, :freedom]) @ off
    return float(chdtrc(freedom, square))


def planar(m: Reading) -> Found:
    """Check that the map can be drawn in the plane without a crossing.

    In the drawing, right turns must lead to the right.
    """
    place_of = {s.id: s.place for s in m.states.values() if s.place is not None}
    headings = {s: heading for s in place_of if (heading := heading_of(m.states[s])) is not None}
    turns = [
        (t.source.id, t.action.turn, t.target.id)
        for t in m.turns
        if t.action.turn and {t.source.id, t.target.id} <= place_of.keys()
    ]
    stars = (
        {s: [star for state, star, _ in stars_of(m) if state.id == s] for s in place_of}
        if "star_frame" in m.axioms
        else {}
    )

    def cross(travels: Sequence[MapLink]) -> bool:
        edges = Edges([(t.source.id, t.target.id) for t in travels], turns, place_of)
        if m.theory.star != "frame":
            return not edges.can_be_drawn(crossing=m.theory.symmetric_sides)
        if headings.keys() == place_of.keys() and edges.can_be_drawn_by(headings):
            return False
        turned = {"turn_rotates", "one_heading"} <= m.axioms
        distinct = "one_dstate_per_heading" in m.axioms
        return not edges.can_be_drawn_in_frames(stars, turned=turned, distinct=distinct)

    kept = [t for t in m.travels if {t.source.id, t.target.id} <= place_of.keys()]
    if not cross(kept):
        return
    # report only travels that are needed for the crossing
    kept = [] if cross([]) else minimal_part(cross, kept)
    ways = ", ".join(f"{t.source.place} to {t.target.place} (step {t.step})" for t in kept)
    yield (
        [step for t in kept for step in t.steps],
        "In every drawing, paths cross where there is no place. These travels follow the paths: "
        f"from place {ways}.",
    )


def _may_show_the_same(one: Star, other: Star) -> bool:
    """Tell whether two stars may show the same gateways, seen by a robot that has not turned.

    To test this, pair gateways of one star with gateways of the other. The bearings of a pair may
    differ by at most the sum of their spreads. Each gateway that is seen open must be in a pair.
    """
    import numpy as np
    from scipy.optimize import linear_sum_assignment

    bearings, spreads, seen = (
        [np.array([getattr(g, name) for g in star.gateways], dtype=float) for star in (one, other)]
        for name in ("bearing", "spread", "open")
    )
    seen = [np.nan_to_num(row) for row in seen]  # not observed (None) becomes 0
    off = np.abs((bearings[0][:, None] - bearings[1] + 180) % 360 - 180)
    near = off <= spreads[0][:, None] + spreads[1]
    taken_in = np.where(near, seen[0][:, None] + seen[1], 0)
    return bool(
        taken_in[linear_sum_assignment(taken_in, maximize=True)].sum()
        == sum(row.sum() for row in seen)
    )


class Edges:
    """The travels and turns of a map, for tests of whether they can be drawn without a crossing.

    An arm is the gateway ahead of a dstate or behind it. A travel leads from the arm ahead of one
    dstate to the arm behind another one. Arms lie around a place in some order, and two arms may be
    one gateway. `theory/planarity.py` decides whether orders are planar, and searches for a
    drawing. The evidence uses it, too, so the tests compare it with networkx and a brute force.

    >>> there_back_and_there = [(0, 1), (2, 3), (4, 5)]
    >>> edges = Edges(there_back_and_there, [], {0: 0, 1: 1, 2: 1, 3: 0, 4: 0, 5: 1})
    >>> edges.can_be_drawn_by({0: 1, 1: 1, 2: 0, 3: 2, 4: 3, 5: 3})
    True
    >>> edges.can_be_drawn_by({0: 1, 1: 1, 2: 2, 3: 2, 4: 3, 5: 2})
    False

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
        place must face different slots. All headings are tried, place by place.
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
        one = NodeClasses[Arm]()

        def join(first: Arm, second: Arm) -> bool:
            """Join two arms, and the arms behind them. Return whether they were not one yet."""
            is_new = not one.are_one(first, second)
            for turned in (1, -1):
                one.merge((first[0], turned * first[1]), (second[0], turned * second[1]))
            return is_new

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
                    other = beyond.setdefault(one.of(here), there)
                    if self.place_of[other[0]] != self.place_of[there[0]]:
                        return None
                    changed = join(other, there) or changed
        return {(s, side): one.of((s, side)) for s in self.place_of for side in (1, -1)}

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
