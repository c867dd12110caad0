"""Plan the shortest tour through everything that is untried in a map.

>>> from ssh_abduction import Trace, solve
>>> from ssh_abduction.rivals.tour import next_tour
>>> seen = [(1, 0, 0, 0), (1, 0, 1, 0), (0, 0, 1, 0)]
>>> corridor = Trace.from_steps(["end", "hall", "wall"], ["travel", "travel"], stars=seen)
>>> next_tour(solve(corridor).maps[0], corridor, actions=["around"])
('around', 'travel', 'travel')

A robot that always does the nearest untried action looks around at each place, although it comes
back to most places later and could do so then. So the tour plans ahead, in a graph of stances
(places and headings) and moves (`rivals/stances.py`). The tour is the shortest walk that makes each
unknown move and each expected travel, and visits each stance. After that, expected turns are tried
one by one. Expected ends of moves are guesses for the plan only. No conclusion is drawn from them,
and the robot plans again after each surprise.

A map with the fewest dstates may merge places that only look alike. So the tour doubts each return
to a place until enough is seen there. Suppose that by the map, an unknown move leads to an earlier
place. Then the plan treats the end of the move as a new place. The robot explores the new place,
until it has seen more than `margin` dstates there and at the doubted places beside it. If the new
place is not the earlier one, the robot sees something new. Otherwise, it confirms the return. A
travel back to where the robot came from is not doubted.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import replace
from itertools import pairwise
from typing import TypeAlias

from ssh_abduction.data.groups import numbered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Action, Trace
from ssh_abduction.rivals.flow import followed_from, nearest_of, reached_from, shortest_walk
from ssh_abduction.rivals.machines import Can
from ssh_abduction.rivals.stances import Stances
from ssh_abduction.theory.settle import settle
from ssh_abduction.theory.theory import Theory

# A place and 0. If a return to the place is doubted, a copy: the place and the step of the return.
Copy: TypeAlias = tuple[int, int]
# With more moves than this a flow takes about a second or more. Then the robot goes to the nearest
# untried move instead.
MOST_MOVES = 1500


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
        dstates: dict[Copy, set[int]] = {}
        for copy, label in zip(at, ssh_map.dstate_at, strict=True):
            dstates.setdefault(copy, set()).add(label)
        beside = [(one, other) for one, other in pairwise(at) if one[1] and other[1]]
        more: set[int] = set()
        for copy in dstates:
            near = followed_from([*beside, *((other, one) for one, other in beside)], copy)
            if copy[1] and sum(len(dstates[other]) for other in near) > margin:
                more.add(copy[1])
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
