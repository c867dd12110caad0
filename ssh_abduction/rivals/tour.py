"""Plan the shortest tour through everything that is untried in a map.

>>> from ssh_abduction import Trace, solve
>>> from ssh_abduction.rivals.tour import next_tour
>>> seen = [(1, 0, 0, 0), (1, 0, 1, 0), (0, 0, 1, 0)]
>>> corridor = Trace.from_steps(["end", "hall", "wall"], ["travel", "travel"], stars=seen)
>>> next_tour(solve(corridor).maps[0], corridor, actions=["around"])
('around', 'travel', 'travel')

A robot that always does the nearest untried action looks around at each place, although it comes
back to most places later and could do so then. So the tour plans ahead, in a graph of stances
(places and headings) and moves (`rivals/tour.py`). The tour is the shortest walk that makes each
unknown move and each expected travel, and visits each stance. After that, expected turns are tried
one by one. Expected ends of moves are guesses for the plan only. No conclusion is drawn from them,
and the robot plans again after each surprise.

A map with the fewest dstates may merge places that only look alike. So the tour doubts each return
to a place until enough is seen there. Suppose that by the map, an unknown move leads to an earlier
place. Then the plan treats the end of the move as a new place. The robot explores the new place,
until it has seen more than `margin` dstates there and at the doubted places beside it. If the new
place is not the earlier one, the robot sees something new. Otherwise, it confirms the return. A
travel back to where the robot came from is not doubted.

The shortest walk is a flow of least cost on the graph of moves. A stance is a place and a heading
where the robot may stand. A move is an action that leads from one stance to another.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal, TypeAlias

import networkx as nx
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import coo_array

from ssh_abduction.data.groups import firsts, gathered, numbered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.star import Frame, Star, angle_between
from ssh_abduction.data.step import QUARTERS
from ssh_abduction.data.trace import Action, Trace
from ssh_abduction.rivals.machines import OF_FRAMES, Can, Seen, is_possible, leads_of
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.theory import Theory

# A place and 0. If a return to the place is doubted, a copy: the place and the step of the return.
Copy: TypeAlias = tuple[int, int]
# With more moves than this a flow takes about a second or more. Then the robot goes to the nearest
# untried move instead.
MOST_MOVES = 1500
How: TypeAlias = Literal["known", "implied", "expected", "unknown"]
# The cost of an unknown move in actions: go there, turn around, and come back.
THERE_AND_BACK = 3
AROUND = Action.of("around")
# Seconds for the search for one flow. If it takes longer, the robot goes to the nearest untried
# move instead.
PATIENCE = 2.0
# The greatest number of flows to seek. Later plans visit the parts that the last flow cuts off.
ROUNDS = 8


def next_tour(
    ssh_map: SSHMap,
    trace: Trace,
    *,
    theory: Theory | None = None,
    actions: Iterable[Action | str] = (),
    can: Can | None = None,
    margin: int = 0,
) -> tuple[str, ...]:
    """Plan the shortest tour through everything that is untried, and return its first actions.

    Args:
        ssh_map: A minimal map of the trace.
        trace: The trace that was mapped.
        theory: The theory of the map; Theory.topological() if None.
        actions: Actions that the robot can do, in addition to those of the trace.
        can: A function from what the robot sees to the names of the actions that it can do there.
            If None, the robot can do any action that the star (the openings seen) allows.
        margin: A return to a place is doubted until more than this many dstates are seen there. 0
            doubts no return. Only returns in maps with places are doubted.

    Returns:
        The actions up to the first one with an unknown end; empty if nothing is untried.
    """
    if margin and ssh_map.places:
        ssh_map = with_doubted_returns(ssh_map, trace, margin)
    stances = Stances(ssh_map, trace, settle(trace, theory).theory, [*map(Action.of, actions)], can)
    start, moves = ssh_map.dstate_at[-1], stances.moves()
    near = reached_from(moves, start)
    moves = [move for move in moves if move.source in near]
    unseen = {n for n in near if n >= len(ssh_map.dstates)}
    due = {k for k, move in enumerate(moves) if move.is_untried}
    if not due and not unseen:
        due = {k for k, move in enumerate(moves) if move.how == "expected"}
    if not due and not unseen:
        return ()
    walk = shortest_walk(moves, start, due, unseen) if len(moves) <= MOST_MOVES else ()
    return walk or nearest_of(moves, start, due, unseen)


def with_doubted_returns(ssh_map: SSHMap, trace: Trace, margin: int) -> SSHMap:
    """Copy a map, with a new place for each doubted return and without paths.

    A return is doubted until more than `margin` dstates are seen there.
    """
    believed: set[int] = set()
    # believing a return may add dstates to doubted places beside it: repeat until nothing changes
    while True:
        at = _copies(ssh_map, trace, believed)
        seen = {*zip(at, ssh_map.dstate_at, strict=True)}
        beside = nx.Graph((one, other) for one, other in pairwise(at) if one[1] and other[1])
        beside.add_nodes_from(copy for copy in at if copy[1])
        enough = (
            near
            for near in nx.connected_components(beside)
            if sum(copy in near for copy, _ in seen) > margin
        )
        more = {return_step for near in enough for _, return_step in near}
        if not more:
            break
        believed |= more
    copied = list(zip(at, ssh_map.dstate_at, strict=True))
    labels = tuple(numbered(copied))
    places: dict[Copy, int] = {}
    off_paths = [replace(s, path=None, direction=None) for s in ssh_map.dstates]
    links = {
        (one, action.name, other)
        for (one, other), action in zip(pairwise(labels), trace.actions, strict=True)
        if not action.starts
    }
    return replace(
        ssh_map,
        dstate_at=labels,
        dstates=tuple(
            replace(off_paths[label], id=n, place=places.setdefault(copy, n))
            for n, (copy, label) in enumerate(dict.fromkeys(copied))
        ),
        links=tuple(sorted(links)),
        places=tuple(places.values()),
        paths=(),
    )


def _copies(ssh_map: SSHMap, trace: Trace, believed: Collection[int]) -> list[Copy]:
    """Find the place of each step if we doubt that the robot returned to known places.

    A step that returns to an earlier place is then at a new copy of it. Returns at the steps
    `believed` are not doubted.
    """
    places = [ssh_map.dstates[label].place or 0 for label in ssh_map.dstate_at]
    at: list[Copy] = [(places[0], 0)]
    known = {places[0]}
    leads: dict[tuple[Copy, int, str], Copy] = {}
    came: dict[Copy, list[Copy]] = {}  # the places from which the robot came to each place
    for t, action in enumerate(trace.actions, 1):
        here, place = at[-1], places[t]
        if place == places[t - 1]:
            at.append(here)
            continue
        tried = here, ssh_map.dstate_at[t - 1], action.name
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


@dataclass(frozen=True, slots=True)
class StanceMove:
    """An action that leads from one stance to another."""

    source: int  # the number of the stance before the action
    action: Action
    # The number of the stance after the action. If `how` is "unknown", this is a guess: a travel
    # comes back through the same gateway, and any other action changes nothing.
    target: int
    # How the target is known. "known": the action was tried. "implied": the axioms imply it, for a
    # turn at a place with a frame. "expected": a turn by the angle that the star shows, or a travel
    # back the way that the robot came. "unknown": anything else.
    how: How

    @property
    def cost(self) -> int:
        """The cost as a number of actions."""
        return THERE_AND_BACK if self.how == "unknown" else 1

    @property
    def is_untried(self) -> bool:
        """Whether a tour has to make the move: it is unknown, or a travel expected to lead back."""
        return self.how == "unknown" or (self.how == "expected" and self.action.kind != "turn")


class Stances:
    """The stances of a map: places and headings where a robot may stand.

    The first stances are the dstates of the map, with the same numbers. The robot was never in the
    others: turns lead there from dstates. Parameters as in `next_tour`.
    """

    def __init__(
        self,
        ssh_map: SSHMap,
        trace: Trace,
        theory: Theory,
        actions: Sequence[Action],
        can: Can | None,
    ) -> None:
        self._links = leads_of(ssh_map, 0)
        known = (*actions, *trace.actions)
        self._actions = {action.name: action for action in known if not action.starts}
        self._can = can
        self._implies = theory.star == "frame" and theory.hard >= OF_FRAMES
        first = firsts(zip(ssh_map.dstate_at, trace.steps, strict=True))
        self._looks = [first[s.id] for s in ssh_map.dstates]
        self._stars = [
            Star.of(step.star) if step.star is not None and theory.star != "none" else None
            for step in self._looks
        ]
        self._frames = [_frame(star) for star in self._stars]
        # for each stance its room, and the heading in the room in degrees clockwise
        self._at: list[tuple[int, float]] = [
            (s.place or 0, 90.0 * (s.heading or 0)) for s in ssh_map.dstates
        ]
        if not self._implies or any(s.heading is None for s in ssh_map.dstates):
            self._at = self._rooms()
        # the stances in each room
        self._in = gathered((room, n) for n, (room, _) in enumerate(self._at))
        self._back: dict[int, int] = {}  # where a travel from a stance leads if it leads back

    def moves(self) -> list[StanceMove]:
        """List all moves from all stances (place, heading). This adds stances never seen before."""
        for source, tried in self._links.items():
            for name, target in tried.items():
                has_stars = self._frames[source] and self._frames[target]
                if self._actions[name].kind == "travel" and has_stars:
                    self._back.setdefault(self._around(target), self._around(source))
        found: list[StanceMove] = []
        for n, _ in enumerate(self._at):  # the list grows
            found += (self._move(n, action) for action in self._possible(n))
        return found

    def _rooms(self) -> list[tuple[int, float]]:
        """Return the room and the heading, in degrees clockwise, of each dstate.

        Dstates that are linked by turns are one room. Their headings differ by the angles of the
        turns. The first dstate of a room faces 0 degrees.
        """
        turns: nx.DiGraph[int] = nx.DiGraph()
        turns.add_nodes_from(self._links)
        for n, tried in self._links.items():
            for name, target in tried.items():
                action = self._actions[name]
                degrees = _degrees(action, self._frames[n]) if action.kind == "turn" else None
                if degrees is not None:
                    turns.add_edge(target, n, degrees=-degrees)
                    turns.add_edge(n, target, degrees=degrees)
        at: dict[int, tuple[int, float]] = {}
        for n in turns:
            if n not in at:
                at[n] = n, 0.0
                for one, other in nx.bfs_edges(turns, n):
                    at[other] = n, (at[one][1] + turns.edges[one, other]["degrees"]) % 360
        return [at[n] for n in sorted(at)]

    def _possible(self, n: int) -> list[Action]:
        """List the possible actions in stance n. If it was never seen, its star is predicted."""
        if n < len(self._looks):
            step = self._looks[n]
            seen = Seen(step.view, step.star if self._stars[n] else None)
            can = {*self._actions} if self._can is None else {*self._can(seen)}
            return [
                action
                for name, action in self._actions.items()
                if name in self._links[n] or (name in can and is_possible(action, seen))
            ]
        frame = self._frames[n]
        assert frame is not None
        return [
            action
            for action in self._actions.values()
            if (action.kind == "travel" and _faces(frame) is not None)
            or (action.kind == "turn" and _degrees(action, frame) is not None)
        ]

    def _move(self, n: int, action: Action) -> StanceMove:
        """Make the move for an action in stance n."""
        if n < len(self._links) and action.name in self._links[n]:
            return StanceMove(n, action, self._links[n][action.name], "known")
        frame = self._frames[n]
        if frame is not None and action.kind == "travel":
            if n in self._back:
                return StanceMove(n, action, self._back[n], "expected")
            return StanceMove(n, action, self._around(n), "unknown")
        degrees = _degrees(action, frame) if action.kind == "turn" else None
        if degrees is None:
            return StanceMove(n, action, n, "unknown")
        how: How = "implied" if self._implies and action.in_quarters else "expected"
        return StanceMove(n, action, self._turned(n, degrees), how)

    def _around(self, n: int) -> int:
        """Find the stance (place and heading) that a turn around leads to from stance n."""
        degrees = _degrees(AROUND, self._frames[n])
        assert degrees is not None
        return self._turned(n, degrees)

    def _turned(self, n: int, degrees: float) -> int:
        """Find the stance after a clockwise turn of this many degrees from stance n.

        If all stances of the room differ from that heading by more than the spread of bearings in
        the star, a new stance is added.
        """
        (room, before), star, frame = self._at[n], self._stars[n], self._frames[n]
        assert star is not None
        assert frame is not None
        goal = (before + degrees) % 360
        near = min(self._in[room], key=lambda m: angle_between(self._at[m][1], goal))
        if angle_between(self._at[near][1], goal) <= max(frame.spreads, default=0):
            return near
        self._at.append((room, goal))
        self._in[room].append(len(self._at) - 1)
        turned = Star(tuple(replace(g, bearing=(g.bearing - degrees) % 360) for g in star.gateways))
        self._stars.append(turned)
        self._frames.append(_frame(turned))
        return len(self._at) - 1


def _frame(star: Star | None) -> Frame | None:
    """Return the first frame (reading of the gateways) of a star; None without a star."""
    return None if star is None else star.frames[0]


def _faces(frame: Frame) -> int | None:
    """Find the slot (direction of a place) that the robot faces; None if it faces none."""
    return next((slot for slot in range(frame.slots) if frame.faces(slot)), None)


def _degrees(action: Action, frame: Frame | None) -> float | None:
    """Find by how many degrees clockwise a turn goes; None if the star does not show it."""
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


def shortest_walk(
    moves: Sequence[StanceMove], start: int, due: set[int], unseen: set[int]
) -> tuple[str, ...]:
    """Find the shortest walk that makes the moves `due` and visits the stances `unseen`.

    Return the names of the actions up to the first move with an unknown end. Empty if there is
    no such walk, or none is found in time. The order of the moves is found by Fleury's
    algorithm: each move must not cut off the rest of the walk. Among such moves, one with an
    unknown end comes first, as it is most informative.
    """
    times = shortest_flow(moves, start, due, unseen)
    if times is None:
        return ()
    left = Counter({k: n for k, n in enumerate(times) if n})
    actions: list[str] = []
    at = start
    while left:
        choices = sorted(
            (k for k in left if moves[k].source == at),
            key=lambda k: (moves[k].how != "unknown", k not in due, k),
        )
        # take a move unless the rest of the walk would be cut off
        for k in choices:
            after = left - Counter([k])
            rest = [moves[j] for j in after]
            if {move.source for move in rest} <= reached_from(rest, moves[k].target):
                break
        else:
            return ()
        actions.append(moves[k].action.name)
        if moves[k].how == "unknown":
            break
        left, at = after, moves[k].target
    return tuple(actions)


def shortest_flow(
    moves: Sequence[StanceMove],
    start: int,
    due: set[int],
    unseen: set[int],
    rounds: int = ROUNDS,
    patience: float = PATIENCE,
) -> list[int] | None:
    """Count how often the shortest walk makes each move.

    A walk is a flow on the graph of moves: each stance is entered as often as it is left, except
    for the first and the last one. `milp` of scipy finds a flow of least cost. A part of the flow
    may not be connected to the start. Then a constraint that the part is entered is added, and the
    flow is solved again, as Dantzig, Fulkerson & Johnson (1954) did for the travelling salesman.

    Args:
        moves: The moves that the robot can make between stances.
        start: The number of the stance where the robot is.
        due: Indices of the moves that the walk has to make.
        unseen: Numbers of the stances that the walk has to visit.
        rounds: The greatest number of flows to seek. After the last one, the result is the part of
            the flow that is connected to the start.
        patience: Seconds for each flow. At the limit the best flow so far is used. It may not be
            the shortest.

    Returns:
        A count for each move; None if there is no walk, or none was found in time.
    """
    costs, bounds, rules = _program(moves, start, due, unseen)
    for _ in range(rounds):
        found = milp(
            costs,
            constraints=rules,
            integrality=np.ones(len(costs)),
            bounds=bounds,
            options={"time_limit": patience},
        )
        if found.x is None:
            return None
        times = np.round(found.x[: len(moves)]).astype(int)
        used = [move for move, n in zip(moves, times, strict=True) if n]
        near = reached_from(used, start)
        cut_off = _graph(move for move in used if move.source not in near)
        if not cut_off:
            break
        for part in nx.weakly_connected_components(cut_off):
            entering = [float(x.target in part and x.source not in part) for x in moves]
            entering += [0.0] * (len(costs) - len(moves))
            rules.append(LinearConstraint(np.array([entering]), 1, np.inf))
    return [int(n) if move.source in near else 0 for move, n in zip(moves, times, strict=True)]


def _program(
    moves: Sequence[StanceMove], start: int, due: set[int], unseen: set[int]
) -> tuple[NDArray[np.float64], Bounds, list[LinearConstraint]]:
    """Make the integer program of a flow: costs, bounds and constraints of its variables.

    The variables are the count of each move, and for each stance whether it is the last one.
    """
    graph = _graph(moves)
    graph.add_node(start)
    stances = sorted(graph)
    m, size = len(moves), len(stances)
    sources, targets = (
        np.searchsorted(stances, ends)
        for ends in ([x.source for x in moves], [x.target for x in moves])
    )
    # Balance: a stance is entered as often as it is left, but for the start and the last one.
    enters, leaves = (
        coo_array((np.ones(m), (ends, np.arange(m))), (size, m)) for ends in (targets, sources)
    )
    last = sparse.eye_array(size)
    begins = -1.0 * (np.array(stances) == start)
    visited = np.isin(stances, sorted(unseen - {start})).astype(float)
    rules = [
        LinearConstraint(sparse.hstack([enters - leaves, -last]), begins, begins),
        LinearConstraint(np.r_[np.zeros(m), np.ones(size)][None], 1, 1),
        LinearConstraint(sparse.hstack([enters, 0 * last]), visited, np.inf),
    ]
    costs = np.r_[[float(move.cost) for move in moves], np.zeros(size)]
    bounds = Bounds(
        np.r_[[float(k in due) for k in range(m)], np.zeros(size)],
        np.r_[np.full(m, float(size)), np.ones(size)],
    )
    return costs, bounds, rules


def nearest_of(
    moves: Sequence[StanceMove], start: int, due: set[int], unseen: set[int]
) -> tuple[str, ...]:
    """Find the shortest way to one required move or stance (a place and a heading).

    Parameters as in `shortest_walk`. Return the names of the actions; empty if there is no way.
    """
    graph = _graph(move for move in moves if move.how != "unknown")
    graph.add_node(start)
    ways = nx.single_source_shortest_path(graph, start)
    goals = [
        (len(ways[move.source]), k not in due, k)
        for k, move in enumerate(moves)
        if (k in due or move.target in unseen) and move.source in ways
    ]
    if not goals:
        return ()
    last = moves[min(goals)[-1]]
    way = (graph.edges[edge]["action"] for edge in pairwise(ways[last.source]))
    return (*way, last.action.name)


def reached_from(moves: Iterable[StanceMove], start: int) -> set[int]:
    """Find all stances (place, heading) that moves from `start` reach, including `start`."""
    graph = _graph(moves)
    return {start} | (nx.descendants(graph, start) if start in graph else set())


def _graph(moves: Iterable[StanceMove]) -> nx.DiGraph[int]:
    """Make the graph of the stances and of the moves between them."""
    edges = ((move.source, move.target, {"action": move.action.name}) for move in moves)
    return nx.DiGraph(edges)
