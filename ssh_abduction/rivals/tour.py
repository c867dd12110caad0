"""The shortest tour through all that is untried in a map.

>>> from ssh_abduction import Trace, solve
>>> from ssh_abduction.rivals.tour import next_tour
>>> seen = [(1, 0, 0, 0), (1, 0, 1, 0), (0, 0, 1, 0)]
>>> corridor = Trace.from_steps(["end", "hall", "wall"], ["travel", "travel"], stars=seen)
>>> next_tour(solve(corridor).maps[0], corridor, actions=["around"])
('around', 'travel', 'travel')

An explorer that does whatever is untried and nearest looks around at each place, although it comes back to most of them and would see the same then. So it plans ahead. A *stance* is where the robot may stand and
what it faces there: a dstate, or one that was never seen, but that follows from the star of its place, as it is only a turn away. Moves lead from stance to stance:

    known      the action was tried
    implied    a turn whose end the axioms tell, as places have frames
    expected   a turn, if turns go as far as stars say; or a travel back the way that the robot came
    unknown    anything else. As it has to lead somewhere in the plan, a travel is taken to come back through the same gateway, and another action to do nothing

The tour is the shortest walk that does each unknown move, each expected travel, and gets to each stance. Only then are expected turns tried one by one, where no axiom tells their ends.

What is expected is a plan's guess, and no more: nothing is concluded from it. After each surprise there is a new plan.

A map of the fewest dstates takes places for one that only look alike, and believes to know what was never seen. So the tour is planned in a map in which each return to a place is doubted until enough was seen
there: where the robot came, by a move of unknown end, to what the map takes for a known place, that is a place of its own until it and its like next to it have more than `margin` dstates. Whatever is done there is new,
if they are two places; if they are one, it confirms that, and then the return is believed. The way back to where the robot came from is believed at once.

The walk is a flow on the graph of moves: as often as a stance is entered it is left, but for the first and the last one. A flow of the least cost is found by scipy's `milp`; where a part of it hangs
together with nothing, it is forbidden, and the flow sought again (Dantzig, Fulkerson & Johnson 1954 did so for the travelling salesman). The order of the moves is Fleury's: of those that do not cut off the rest one
of unknown end goes first, as it tells most.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, TypeAlias, TypeVar

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import coo_array

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.star import Frame, Star
from ssh_abduction.data.trace import Action, Step, Trace
from ssh_abduction.rivals.consequences import OF_FRAMES, QUARTERS, is_possible
from ssh_abduction.rivals.explore import Can
from ssh_abduction.rivals.machines import Seen, links_of
from ssh_abduction.theory.theory import Theory

T = TypeVar("T")
Copy: TypeAlias = tuple[
    int, int
]  # a place, and 0, or the step of a return to it that is not believed
How: TypeAlias = Literal["known", "implied", "expected", "unknown"]
# What an unknown move costs, in actions: there and back, and a turn there.
THERE_AND_BACK = 3
# Seconds for a flow. Where they are over, the robot goes to what is untried and nearest.
PATIENCE = 2.0
# So often, at most, what is cut off is forbidden. Then the robot does the part of the walk that hangs together with where it is, and the next plan the rest.
ROUNDS = 8
# With more moves than these a flow takes about a second, and the robot goes to what is untried and nearest.
MOST_MOVES = 1500


@dataclass(frozen=True, slots=True)
class Move:
    """An action from one stance to another, both by number."""

    source: int
    action: Action
    target: int
    how: How

    @property
    def cost(self) -> int:
        return THERE_AND_BACK if self.how == "unknown" else 1

    @property
    def is_untried(self) -> bool:
        """Whether it has to be done: its end is unknown, or it is a travel that is expected to lead back."""
        return self.how == "unknown" or (self.how == "expected" and self.action.kind != "turn")


def next_tour(
    ssh_map: SSHMap,
    trace: Trace,
    *,
    theory: Theory | None = None,
    actions: Iterable[Action | str] = (),
    can: Can | None = None,
    margin: int = 0,
) -> tuple[str, ...]:
    """The first actions of the shortest tour, up to one whose end is unknown; none where nothing is untried.

    theory   under which the map was solved; Theory.topological() by default
    actions  what else the robot can do, beside the actions of the trace
    can      names of what the robot can do where this is seen; by default any action, as far as the star lets it
    margin   a return to a place is believed once more dstates than these are seen there; 0 believes each at once. Only maps with places are so doubted
    """
    if margin and ssh_map.places:
        ssh_map = _doubted(ssh_map, trace, margin)
    stances = _Stances(
        ssh_map,
        trace,
        (theory or Theory.topological()).resolve(trace),
        [*map(Action.of, actions)],
        can,
    )
    start, moves = ssh_map.labels[-1], stances.moves()
    near = _reached(moves, start)
    moves = [move for move in moves if move.source in near]
    unseen = {n for n in near if n >= len(ssh_map.dstates)}
    due = {k for k, move in enumerate(moves) if move.is_untried}
    if not due and not unseen:
        due = {k for k, move in enumerate(moves) if move.how == "expected"}
    if not due and not unseen:
        return ()
    walk = _walk(moves, start, due, unseen) if len(moves) <= MOST_MOVES else ()
    return walk or _nearest(moves, start, due, unseen)


def _doubted(ssh_map: SSHMap, trace: Trace, margin: int) -> SSHMap:
    """The map with a place of its own for each return that is not believed yet; it has no paths."""
    believed: set[int] = set()
    while True:
        at = _copies(ssh_map, trace, believed)
        dstates: dict[Copy, set[int]] = {}
        for copy, label in zip(at, ssh_map.labels, strict=True):
            dstates.setdefault(copy, set()).add(label)
        beside = [(one, other) for one, other in pairwise(at) if one[1] and other[1]]
        more: set[int] = set()
        for copy in dstates:
            near = _followed([*beside, *((other, one) for one, other in beside)], copy)
            if copy[1] and sum(len(dstates[other]) for other in near) > margin:
                more.add(copy[1])
        if not more:
            break
        believed |= more
    numbers: dict[tuple[Copy, int], int] = {}
    labels = tuple(
        numbers.setdefault(pair, len(numbers)) for pair in zip(at, ssh_map.labels, strict=True)
    )
    places: dict[Copy, int] = {}
    return replace(
        ssh_map,
        labels=labels,
        dstates=tuple(
            replace(
                ssh_map.dstates[label],
                id=n,
                place=places.setdefault(copy, n),
                path=None,
                direction=None,
            )
            for (copy, label), n in numbers.items()
        ),
        links=tuple(
            sorted(
                {
                    (one, action.name, other)
                    for (one, other), action in zip(pairwise(labels), trace.actions, strict=True)
                }
            )
        ),
        places=tuple(places.values()),
        paths=(),
    )


def _copies(ssh_map: SSHMap, trace: Trace, believed: Collection[int]) -> list[Copy]:
    """The place of each step, where returns at these steps are believed, and others are not."""
    places = [ssh_map.dstates[label].place or 0 for label in ssh_map.labels]
    at: list[Copy] = [(places[0], 0)]
    known = {places[0]}
    leads: dict[tuple[Copy, int, str], Copy] = {}
    came: dict[Copy, list[Copy]] = {}  # from where the robot came to a place
    for t, action in enumerate(trace.actions, 1):
        here, place = at[-1], places[t]
        if place == places[t - 1]:
            at.append(here)
            continue
        tried = here, ssh_map.labels[t - 1], action.name
        there = leads.get(tried) or next(
            (copy for copy in came.get(here, ()) if copy[0] == place), None
        )
        if there is None:
            there = (place, t) if place in known and t not in believed else (place, 0)
        known.add(place)
        leads[tried] = there
        came.setdefault(there, []).append(here)
        at.append(there)
    return at


class _Stances:
    """Where a robot may stand, and face: the dstates of a map, by number, and then what is a turn away from them and was never seen."""

    def __init__(
        self,
        ssh_map: SSHMap,
        trace: Trace,
        theory: Theory,
        actions: Sequence[Action],
        can: Can | None,
    ) -> None:
        self._links = links_of(ssh_map, 0)
        self._actions = {action.name: action for action in (*actions, *trace.actions)}
        self._can = can
        self._implies = theory.star == "frame" and theory.hard >= OF_FRAMES
        first: dict[int, Step] = {}
        for label, step in zip(ssh_map.labels, trace.steps, strict=True):
            first.setdefault(label, step)
        self._looks = [first[s.id] for s in ssh_map.dstates]
        self._stars = [
            Star.of(step.star) if step.star is not None and theory.star != "none" else None
            for step in self._looks
        ]
        self._frames = [_frame(star) for star in self._stars]
        self._at: list[tuple[int, float]] = [
            (s.place or 0, 90.0 * (s.heading or 0)) for s in ssh_map.dstates
        ]  # room, and degrees clockwise in it
        if not self._implies or any(s.heading is None for s in ssh_map.dstates):
            self._at = self._rooms()
        self._in: dict[int, list[int]] = {}  # the stances in each room
        for n, (room, _) in enumerate(self._at):
            self._in.setdefault(room, []).append(n)
        self._back: dict[int, int] = {}  # where a travel from a stance leads if it leads back

    def moves(self) -> list[Move]:
        """All moves from all stances. As it goes on, stances come to light that were never seen."""
        for source, tried in self._links.items():
            for name, target in tried.items():
                if (
                    self._actions[name].kind == "travel"
                    and self._frames[source]
                    and self._frames[target]
                ):
                    self._back.setdefault(self._around(target), self._around(source))
        found: list[Move] = []
        n = 0
        while n < len(self._at):
            found += (self._move(n, action) for action in self._possible(n))
            n += 1
        return found

    def _rooms(self) -> list[tuple[int, float]]:
        """Dstates that turns link are in one room, and a turn tells the degrees from one to the next."""
        turns: dict[int, list[tuple[int, float]]] = {n: [] for n in self._links}
        for n, tried in self._links.items():
            for name, target in tried.items():
                degrees = (
                    _degrees(self._actions[name], self._frames[n])
                    if self._actions[name].kind == "turn"
                    else None
                )
                if degrees is not None:
                    turns[n].append((target, degrees))
                    turns[target].append((n, -degrees))
        at: dict[int, tuple[int, float]] = {}
        for n in turns:
            if n in at:
                continue
            at[n] = n, 0.0
            queue = [n]
            for source in queue:
                for target, degrees in turns[source]:
                    if target not in at:
                        at[target] = n, (at[source][1] + degrees) % 360
                        queue.append(target)
        return [at[n] for n in sorted(at)]

    def _possible(self, n: int) -> list[Action]:
        """What the robot can do in a stance; where it was never seen, as far as the star tells."""
        if n < len(self._looks):
            step = self._looks[n]
            seen = Seen(step.view, step.star if self._stars[n] else None)
            names = (
                self._actions.keys() if self._can is None else {*self._can(seen), *self._links[n]}
            )
            return [
                action
                for name, action in self._actions.items()
                if name in names and (name in self._links[n] or is_possible(action, seen))
            ]
        frame = self._frames[n]
        assert frame is not None
        return [
            action
            for action in self._actions.values()
            if (
                _faces(frame) is not None
                if action.kind == "travel"
                else action.kind == "turn" and _degrees(action, frame) is not None
            )
        ]

    def _move(self, n: int, action: Action) -> Move:
        if n < len(self._links) and action.name in self._links[n]:
            return Move(n, action, self._links[n][action.name], "known")
        frame = self._frames[n]
        if frame is not None and action.kind == "travel":
            return (
                Move(n, action, self._back[n], "expected")
                if n in self._back
                else Move(n, action, self._around(n), "unknown")
            )
        degrees = _degrees(action, frame) if action.kind == "turn" else None
        if degrees is None:
            return Move(n, action, n, "unknown")
        return Move(
            n,
            action,
            self._turned(n, degrees),
            "implied" if self._implies and action.in_quarters else "expected",
        )

    def _around(self, n: int) -> int:
        """The stance that a turn around leads to."""
        degrees = _degrees(AROUND, self._frames[n])
        assert degrees is not None
        return self._turned(n, degrees)

    def _turned(self, n: int, degrees: float) -> int:
        """The stance that a turn by so many degrees clockwise leads to. It is new if none is known there, as near as the star tells bearings."""
        (room, before), star, frame = self._at[n], self._stars[n], self._frames[n]
        assert star is not None
        assert frame is not None
        goal = (before + degrees) % 360
        near = min(self._in[room], key=lambda m: _apart(self._at[m][1], goal))
        if _apart(self._at[near][1], goal) <= max(frame.spreads, default=0):
            return near
        self._at.append((room, goal))
        self._in[room].append(len(self._at) - 1)
        turned = Star(
            tuple(
                replace(gateway, bearing=(gateway.bearing - degrees) % 360)
                for gateway in star.gateways
            )
        )
        self._stars.append(turned)
        self._frames.append(_frame(turned))
        return len(self._at) - 1


AROUND = Action.of("around")


def _frame(star: Star | None) -> Frame | None:
    return None if star is None else star.frames[0]


def _faces(frame: Frame) -> int | None:
    """The slot that the robot faces."""
    return next((slot for slot in range(frame.slots) if frame.faces(slot)), None)


def _degrees(action: Action, frame: Frame | None) -> float | None:
    """How far a turn goes clockwise, as the star tells; None where it does not."""
    if frame is None or action.bearing is not None:
        return action.bearing
    if action.gateway is not None:
        slot = frame.nth(action.turn, action.gateway)
        return None if slot is None else frame.bearings[slot]
    if action.turn == "around":
        faced = _faces(frame)
        opposite = None if faced is None else frame.opposite[faced]
        behind = next((slot for slot in range(frame.slots) if frame.has_behind(slot)), opposite)
        return 180.0 if behind is None else frame.bearings[behind if opposite is None else opposite]
    return 90.0 * QUARTERS[action.turn or "right"]


def _apart(one: float, other: float) -> float:
    """Degrees between two directions."""
    return abs((one - other + 180) % 360 - 180)


def _reached(moves: Iterable[Move], start: int) -> set[int]:
    """The stances that moves lead to."""
    return _followed(((move.source, move.target) for move in moves), start)


def _followed(links: Iterable[tuple[T, T]], start: T) -> set[T]:
    """All that links lead to from here, and what is here."""
    after: dict[T, list[T]] = {}
    for source, target in links:
        after.setdefault(source, []).append(target)
    found = {start}
    queue = [start]
    for n in queue:
        new = {*after.get(n, ())} - found
        found |= new
        queue += new
    return found


def _walk(moves: Sequence[Move], start: int, due: set[int], unseen: set[int]) -> tuple[str, ...]:
    """The shortest walk that makes these moves and gets to these stances, up to the first unknown move. None is found where no walk does all, or in no time."""
    times = shortest_flow(moves, start, due, unseen)
    if times is None:
        return ()
    left = {k: n for k, n in enumerate(times) if n}
    actions: list[str] = []
    at = start
    while left:
        choices = sorted(
            (k for k in left if moves[k].source == at),
            key=lambda k: (moves[k].how != "unknown", k not in due, k),
        )
        for k in choices:
            after = {j: n - (j == k) for j, n in left.items() if n > (j == k)}
            if {moves[j].source for j in after} <= _reached(
                [moves[j] for j in after], moves[k].target
            ):
                break
        else:
            return ()
        actions.append(moves[k].action.name)
        if moves[k].how == "unknown":
            break
        left, at = after, moves[k].target
    return tuple(actions)


def shortest_flow(
    moves: Sequence[Move],
    start: int,
    due: set[int],
    unseen: set[int],
    rounds: int = ROUNDS,
    patience: float = PATIENCE,
) -> list[int] | None:
    """How often each move is made on the shortest walk that makes those that are due and gets to what is unseen; None where there is none, or no time.

    rounds    so often, at most, what is cut off is forbidden
    patience  seconds for each round; where they are over, the walk may not be the shortest

    After the last round it may be the part of such a walk that hangs together with the start.
    """
    number = {n: i for i, n in enumerate(sorted(_reached(moves, start)))}
    m, size = len(moves), len(number)
    sources, targets = (
        np.array([number[n] for n in ends])
        for ends in ([x.source for x in moves], [x.target for x in moves])
    )
    kinds = [
        np.arange(m),
        np.arange(m),
        m + np.arange(size),
    ]  # columns: each move, and whether a stance is the last one
    balance = coo_array(
        (
            np.r_[np.ones(m), -np.ones(m), -np.ones(size)],
            (np.r_[targets, sources, np.arange(size)], np.concatenate(kinds)),
        ),
        (size, m + size),
    ).tocsr()
    enters = coo_array((np.ones(m), (targets, np.arange(m))), (size, m + size)).tocsr()
    begins = -1.0 * (np.arange(size) == number[start])
    rows = sorted(number[n] for n in unseen - {start})
    rules = [
        LinearConstraint(balance, begins, begins),
        LinearConstraint(np.r_[np.zeros(m), np.ones(size)][None], 1, 1),
        *([LinearConstraint(enters[rows], 1, np.inf)] if rows else []),
    ]
    costs = np.r_[[float(move.cost) for move in moves], np.zeros(size)]
    bounds = Bounds(
        np.r_[[float(k in due) for k in range(m)], np.zeros(size)],
        np.r_[np.full(m, float(size)), np.ones(size)],
    )
    for _ in range(rounds):
        found = milp(
            costs,
            constraints=rules,
            integrality=np.ones(m + size),
            bounds=bounds,
            options={"time_limit": patience},
        )
        if found.x is None:
            return None
        times = np.round(found.x[:m]).astype(int)
        used = [move for move, n in zip(moves, times, strict=True) if n]
        parts = _parts_cut_off(used, start)
        if not parts:
            break
        for part in parts:
            entering = [
                k for k, move in enumerate(moves) if move.target in part and move.source not in part
            ]
            rules.append(
                LinearConstraint(
                    coo_array(
                        (np.ones(len(entering)), ([0] * len(entering), entering)), (1, m + size)
                    ).tocsr(),
                    1,
                    np.inf,
                )
            )
    near = _reached([move for move, n in zip(moves, times, strict=True) if n], start)
    return [int(n) if move.source in near else 0 for move, n in zip(moves, times, strict=True)]


def _parts_cut_off(used: Sequence[Move], start: int) -> list[set[int]]:
    """The stances of moves that do not hang together with the start, in parts that do among themselves. Each part was wanted, as nothing else costs nothing."""
    near = _reached(used, start)
    left = [move for move in used if move.source not in near]
    parts: list[set[int]] = []
    while left:
        part = _reached(
            [*left, *(replace(move, source=move.target, target=move.source) for move in left)],
            left[0].source,
        )
        parts.append(part)
        left = [move for move in left if move.source not in part]
    return parts


def _nearest(moves: Sequence[Move], start: int, due: set[int], unseen: set[int]) -> tuple[str, ...]:
    """The way to the nearest of these moves, and stances; none where no moves lead to any."""
    after: dict[int, list[int]] = {}
    for k, move in sorted(enumerate(moves), key=lambda pair: pair[0] not in due):
        after.setdefault(move.source, []).append(k)
    ways: dict[int, tuple[str, ...]] = {start: ()}
    queue = deque([start])
    while queue:
        n = queue.popleft()
        for k in after.get(n, ()):
            way = (*ways[n], moves[k].action.name)
            if k in due or moves[k].target in unseen:
                return way
            if moves[k].target not in ways and moves[k].how != "unknown":
                ways[moves[k].target] = way
                queue.append(moves[k].target)
    return ()
