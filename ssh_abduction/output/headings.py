"""Find headings for drawing dstates on a page, from the turns between them.

A dstate (distinctive state) is a place and a heading. A course is a path, or a part of one, that
is drawn straight. Each course gets the heading that agrees best with all turns. This is angular
synchronisation (Singer 2011, "Angular synchronization by eigenvectors and semidefinite
programming").
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple, TypeAlias

import networkx as nx
import numpy as np
from scipy.sparse import coo_array

from ssh_abduction.data.action import TURN_DEGREES
from ssh_abduction.data.checks import an_object
from ssh_abduction.data.errors import MapError, brief, is_finite
from ssh_abduction.data.groups import gathered
from ssh_abduction.data.maps import DState, SSHMap
from ssh_abduction.data.trace import Trace

# The key of a course, which is drawn with one heading: a path, a part of a path, or a dstate that
# is along no path.
Course: TypeAlias = tuple[int, ...]

# Radians. If a drawing is off by more than this, a turn may go to the wrong side. The first is for
# turns by known degrees, the second for turns to a known side.
WRONG, WRONG_GUESS = math.radians(46), math.radians(61)
# Number of averaging sweeps for each set of weights, and number of times that weights are updated.
SWEEPS, REWEIGHTED = 60, 15
LEAST_MISSED = 0.02  # radians: turns with a smaller error all get the same weight
EXACT = 1e-6  # radians: a turn with a smaller error agrees with the headings
Turns: TypeAlias = Mapping[str, "str | float"]

# The weights of a turn by known degrees, and of a turn to a known side.
SURE, GUESSED = 1.0, 0.2


class Turn(NamedTuple):
    """The angle between two dstates."""

    a: DState  # the first dstate
    b: DState  # the second dstate
    angle: float  # radians counterclockwise from the heading of a to the heading of b
    weight: float  # SURE if the angle is known, GUESSED if only the side is known


def turns_between(
    ssh_map: SSHMap, degrees: Mapping[str, tuple[float, float]], spot: Sequence[int]
) -> Iterator[Turn]:
    """Yield the known turns between dstates.

    They follow from the headings of dstates at one place, and from the actions of links.
    `degrees` has, for each action's name, the degrees clockwise that it turns, and their weight.
    `spot` has a number for each dstate. Dstates at one place have the same number.
    """
    dstates = ssh_map.dstates
    in_slots = max((s.heading or 0 for s in dstates), default=0) < 4
    unit = 90 if in_slots else 1
    members = gathered(
        (s.place, s) for s in dstates if s.place is not None and s.heading is not None
    )
    for facing in members.values():
        for a, b in pairwise(facing):
            yield Turn(a, b, -math.radians(((b.heading or 0) - (a.heading or 0)) * unit), SURE)
    for source, action, target in ssh_map.links:
        s, x = dstates[source], dstates[target]
        if action in degrees:
            # Headings at a place say more than an action at this place.
            if s.heading is None or x.heading is None or s.place != x.place:
                turn, weight = degrees[action]
                yield Turn(s, x, -math.radians(turn), weight)
        elif s.path is None and spot[source] != spot[target]:
            yield Turn(s, x, 0.0, SURE)


def headings_by(
    turns: Sequence[Turn], courses: Mapping[int, tuple[Course, float]], robust: bool
) -> tuple[dict[int, float], int]:
    """Find headings that agree best with all turns.

    In each connected part of the map, the first dstate faces right. `courses` has, for each dstate,
    its course, and the angle in radians from the heading of the course to the heading of the
    dstate. If turns contradict each other, `robust` draws most turns exactly and a few of them very
    wrong, instead of all a little wrong. Return the heading of each dstate, in radians
    counterclockwise from x, and the number of turns that may go to a wrong side.
    """
    graph: nx.MultiDiGraph[Any] = nx.MultiDiGraph()
    graph.add_nodes_from(course for course, _ in courses.values())
    for a, b, turn, weight in turns:
        (course, off), (other, other_off) = courses[a.id], courses[b.id]
        if course != other:
            graph.add_edge(course, other, turn=turn + off - other_off, weight=weight)
    angles: dict[Course, float] = {}
    for part in nx.weakly_connected_components(graph):
        first, ahead = next((course, off) for course, off in courses.values() if course in part)
        found = _synchronised(graph.subgraph(part), first, robust)
        angles |= {course: angle - ahead for course, angle in found.items()}
    # If all turns are quarters, robust headings are, too.
    quarter = math.pi / 2
    if robust and all(abs(math.remainder(turn.angle, quarter)) < EXACT for turn in turns):
        angles = {course: round(angle / quarter) * quarter for course, angle in angles.items()}
    headings = {
        s: math.remainder(angles[course] + off, math.tau) for s, (course, off) in courses.items()
    }
    wrong = 0
    for a, b, turn, weight in turns:
        missed = abs(math.remainder(headings[a.id] + turn - headings[b.id], math.tau))
        wrong += missed > (WRONG if weight == SURE else WRONG_GUESS)
    return headings, wrong


def _synchronised(graph: nx.MultiDiGraph[Any], first: Course, robust: bool) -> dict[Course, float]:
    """Find the headings of the courses of a connected part, in radians from the first course.

    With `robust`, the sum of absolute errors is minimised, not the sum of squares. This is done by
    averaging again and again, with weights that are lower for turns with larger errors.
    """
    # Begin with headings along a tree of turns.
    angles = {first: 0.0}
    for a, b in nx.bfs_edges(graph.to_undirected(as_view=True), first):
        turn = graph[a][b][0]["turn"] if graph.has_edge(a, b) else -graph[b][a][0]["turn"]
        angles[b] = angles[a] + turn
    courses = list(angles)
    number = {course: i for i, course in enumerate(courses)}
    turns = [
        (number[a], number[b], data["turn"], data["weight"])
        for a, b, data in graph.edges(data=True)
    ]
    found = np.array([angles[course] for course in courses])
    if turns:
        source, target, turn, weight = (np.array(column) for column in zip(*turns, strict=True))
        rows, columns = np.concatenate([target, source]), np.concatenate([source, target])
        for _ in range(REWEIGHTED):
            missed = np.abs(np.angle(np.exp(1j * (found[source] + turn - found[target]))))
            if missed.max() < EXACT:
                break
            now = weight / np.maximum(missed, LEAST_MISSED) if robust else weight
            factors = np.concatenate([now * np.exp(1j * turn), now * np.exp(-1j * turn)])
            # Keep half of the old value, so that the sweeps do not oscillate.
            own = 0.5 * np.bincount(rows, np.abs(factors), len(courses))
            matrix = coo_array((factors, (rows, columns)), (len(courses), len(courses))).tocsr()
            z = np.exp(1j * found)
            for _ in range(SWEEPS):
                z = matrix @ z + own * z
                z /= np.maximum(np.abs(z), 1e-12)
            found = np.angle(z)
    return {
        course: round(math.remainder(angle - found[number[first]], math.tau), 9)
        for course, angle in zip(courses, found.tolist(), strict=True)
    }


def degrees_of(turns: Trace | Turns | None) -> dict[str, tuple[float, float]]:
    """Find by how many degrees each action turns.

    `turns` says how actions turn, as in `to_svg`. Return for each action's name the degrees
    clockwise, and their weight: SURE if the degrees are known, GUESSED if only the side is known.
    Raises MapError if a value is no turn.
    """
    known: dict[str, str | float] = {name: name for name in TURN_DEGREES}
    if isinstance(turns, Trace):
        known |= {
            action.name: (action.turn or "") if action.bearing is None else action.bearing
            for action in turns.actions
            if action.turn is not None
        }
    elif turns is not None:
        known |= an_object("turns", turns, MapError)
    degrees = {}
    for name, turn in known.items():
        if isinstance(turn, str) and turn in TURN_DEGREES:
            degrees[name] = (TURN_DEGREES[turn], GUESSED)
        elif is_finite(turn):
            degrees[name] = (float(turn), SURE)
        else:
            raise MapError(
                f'turns[{brief(name)}]: expected "right", "left", "around" or degrees clockwise, '
                f"got {brief(turn)}; say which"
            )
    return degrees
