"""Find which travels of a robot are on one edge of its map, by the courses that it drove.

A course is the way of the robot from the middle of one place to the middle of the next. The map
says where these middles are. Travels between the same two places are on one edge if their courses
lie close together. So two ways that leave a place in nearly one direction are two edges, and a
robot that cuts a corner is on the same edge as one that does not.

Reference:
    Eiter & Mannila 1994, "Computing discrete Fréchet distance".
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import cdist

from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.output.roads import place_of_steps

Array = NDArray[np.float64]

# Two courses are one edge if their Fréchet distance is at most APART metres. They are compared at
# points STEP metres apart.
APART, STEP = 1.5, 0.25
# Standard deviations of the heading at a dstate in radians, and of the chord of a course in metres.
# They weigh what both say about the rotation of the course.
HEADING, CHORD = 0.2, 0.3


def edges_of(trace: Trace, ssh_map: SSHMap) -> dict[int, int]:
    """Return the edge of each travel, by the step at which the travel begins.

    Edges are numbered by first use. Travels of a log have a `course`. Others count as straight.
    """
    places = place_of_steps(ssh_map)
    travels = {
        t: (places[t], places[t + 1], _laid(trace, ssh_map, t))
        for t, action in enumerate(trace.actions)
        if action.kind == "travel" and places[t] is not None and places[t + 1] is not None
    }
    return dict(zip(travels, grouped(travels.values()), strict=True))


def grouped(travels: Iterable[tuple[Any, Any, Array]]) -> list[int]:
    """Number the edges of travels, each given by its first and last place and its course.

    The places can be compared. A course is (n, 2) metres, with points STEP apart. Any two travels
    on one edge are close together.
    """
    between: dict[tuple[Any, Any], list[tuple[int, Array]]] = defaultdict(list)
    for k, (first, last, course) in enumerate(travels):
        ends = min(first, last), max(first, last)
        between[ends].append((k, course if first == ends[0] else course[::-1]))
    edges: dict[int, tuple[Any, ...]] = {}
    for ends, alike in between.items():
        far = [
            _apart(one, other, loop=ends[0] == ends[1])
            for (_, one), (_, other) in combinations(alike, 2)
        ]
        parts = fcluster(linkage(far, "complete"), APART, "distance") if far else [1]
        edges |= {k: (*ends, part) for (k, _), part in zip(alike, parts, strict=True)}
    numbers: dict[tuple[Any, ...], int] = {}
    return [numbers.setdefault(edges[k], len(numbers)) for k in sorted(edges)]


def _apart(one: Array, other: Array, loop: bool) -> float:
    """The distance of two courses in metres. For loops it does not depend on their directions."""
    far = frechet(one, other)
    return min(far, frechet(one[::-1], other)) if loop else far


def _laid(trace: Trace, ssh_map: SSHMap, t: int) -> Array:
    """The course of the travel from step t in the frame of the map: (n, 2) metres.

    It is the origin alone if the map has no poses.
    """
    if ssh_map.fit is None or not ssh_map.fit.poses:
        return np.zeros((1, 2))
    here, there = (ssh_map.fit.poses[ssh_map.dstate_at[k]] for k in (t, t + 1))
    begin, end = complex(here.x, here.y), complex(there.x, there.y)
    told = trace.steps[t].extra.get("course", ())
    way = np.array([0.0, *(complex(x, y) for x, y in told)])
    # This rotation has the least squared errors of the heading and of the chord.
    turn = np.exp(1j * here.heading) / HEADING**2 + (end - begin) * way[-1].conj() / CHORD**2
    way = begin + way * turn / abs(turn)
    if not told:
        way = np.array([begin, end])
    far = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(way)))])
    # The error at the end grows steadily along the course.
    way += (end - way[-1]) * far / max(far[-1], STEP)
    return resampled(np.stack([way.real, way.imag], axis=1), STEP)


def resampled(way: Array, step: float) -> Array:
    """Place points every `step` metres along a chain, (n, 2) metres, the last one at its end."""
    far = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way, axis=0).T))])
    moving = np.concatenate([[True], np.diff(far) > 1e-6])
    if far[-1] < 1e-6:
        return way[:1]
    at = np.minimum(np.arange(0.0, far[-1] + step / 2, step), far[-1])
    return np.stack([np.interp(at, far[moving], way[moving, k]) for k in (0, 1)], axis=1)


def frechet(first: Array, second: Array) -> float:
    """Compute the discrete Fréchet distance of two sequences of points, (n, 2), in metres."""
    far = cdist(first, second)
    best = np.empty(far.shape)
    best[0] = np.maximum.accumulate(far[0])
    best[:, 0] = np.maximum.accumulate(far[:, 0])
    for i in range(1, len(far)):
        before = np.minimum(best[i - 1, 1:], best[i - 1, :-1])
        for j in range(1, far.shape[1]):
            best[i, j] = max(far[i, j], min(best[i, j - 1], before[j - 1]))
    return float(best[-1, -1])
