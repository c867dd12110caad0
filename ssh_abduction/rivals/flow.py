"""Find shortest walks that make required moves and visit required stances.

A stance is a place and a heading where the robot may stand. A move is an action that leads from one
stance to another.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import coo_array

from ssh_abduction.data.groups import gathered, parts, reached
from ssh_abduction.rivals.stances import StanceMove

T = TypeVar("T")
# Seconds for the search for one flow. If it takes longer, the robot goes to the nearest untried
# move instead.
PATIENCE = 2.0
# The greatest number of flows to seek. Later plans visit the parts that the last flow cuts off.
ROUNDS = 8


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
    left = {k: n for k, n in enumerate(times) if n}
    actions: list[str] = []
    at = start
    while left:
        choices = sorted(
            (k for k in left if moves[k].source == at),
            key=lambda k: (moves[k].how != "unknown", k not in due, k),
        )
        # take a move unless the rest of the walk would be cut off
        for k in choices:
            after = {j: n - (j == k) for j, n in left.items() if n > (j == k)}
            if {moves[j].source for j in after} <= reached_from(
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
        if not (cut_off := _parts_cut_off(used, start)):
            break
        for part in cut_off:
            entering = [float(x.target in part and x.source not in part) for x in moves]
            entering += [0.0] * (len(costs) - len(moves))
            rules.append(LinearConstraint(np.array([entering]), 1, np.inf))
    near = reached_from(used, start)
    return [int(n) if move.source in near else 0 for move, n in zip(moves, times, strict=True)]


def _program(
    moves: Sequence[StanceMove], start: int, due: set[int], unseen: set[int]
) -> tuple[NDArray[np.float64], Bounds, list[LinearConstraint]]:
    """Make the integer program of a flow: costs, bounds and constraints of its variables.

    The variables are the count of each move, and for each stance whether it is the last one.
    """
    number = {n: i for i, n in enumerate(sorted(reached_from(moves, start)))}
    m, size = len(moves), len(number)
    sources, targets = (
        np.array([number[n] for n in ends])
        for ends in ([x.source for x in moves], [x.target for x in moves])
    )
    # Balance: a stance is entered as often as it is left, but for the start and the last one.
    signs = np.r_[np.ones(m), -np.ones(m), -np.ones(size)]
    at = np.r_[targets, sources, :size], np.r_[:m, :m, m : m + size]
    balance = coo_array((signs, at), (size, m + size)).tocsr()
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
    return costs, bounds, rules


def _parts_cut_off(used: Sequence[StanceMove], start: int) -> list[set[int]]:
    """Find the parts of a flow that `start` is not connected to, as sets of stances."""
    near = reached_from(used, start)
    left = [(move.source, move.target) for move in used if move.source not in near]
    beside = gathered([*left, *((target, source) for source, target in left)])
    return [set(part) for part in parts(beside, beside.__getitem__)]


def nearest_of(
    moves: Sequence[StanceMove], start: int, due: set[int], unseen: set[int]
) -> tuple[str, ...]:
    """Find the shortest way to one required move or stance (a place and a heading).

    Parameters as in `shortest_walk`. Return the names of the actions; empty if there is no way.
    """
    after = gathered(
        (move.source, k)
        for k, move in sorted(enumerate(moves), key=lambda pair: pair[0] not in due)
    )
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


def reached_from(moves: Iterable[StanceMove], start: int) -> set[int]:
    """Find all stances (place, heading) that moves from `start` reach, including `start`."""
    return followed_from(((move.source, move.target) for move in moves), start)


def followed_from(links: Iterable[tuple[T, T]], start: T) -> set[T]:
    """Find all nodes that links (pairs of source and target) reach, including `start`."""
    after = gathered(links)
    return set(reached([start], lambda n: after.get(n, ())))
