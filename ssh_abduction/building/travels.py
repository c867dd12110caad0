"""Lay the travels of a trace into its map, and find those that are on one edge.

A travel of a log has a course. Travels between the same two places are on one edge if their courses
lie close together. So two ways that leave a place in nearly one direction are two edges, and a
robot that cuts a corner is on the same edge as one that does not.
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

from perception.places.passages import STEP, resampled
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.output.roads import place_of_steps

Array = NDArray[np.float64]

# Two courses are one edge if their Hausdorff distance is at most APART metres.
APART = 1.5
# Standard deviations of the heading at a dstate in radians, and of the chord of a course in metres.
# They weigh what both say about the rotation of the course.
HEADING, CHORD = 0.2, 0.3


def edges_of(trace: Trace, ssh_map: SSHMap) -> dict[int, int]:
    """Return the edge of each travel, by the step at which the travel begins.

    Edges are numbered by first use. Travels of a log have a `course`. Others count as straight.
    """
    places = place_of_steps(ssh_map)
    travels = {
        t: (places[t], places[t + 1], laid_course(trace, ssh_map, t))
        for t, action in enumerate(trace.actions)
        if action.kind == "travel" and places[t] is not None and places[t + 1] is not None
    }
    return dict(zip(travels, grouped(travels.values()), strict=True))


def grouped(travels: Iterable[tuple[Any, Any, Array]]) -> list[int]:
    """Number the edges of travels, each given by its first and last place and its course.

    The places can be compared. A course is (n, 2) metres, with points STEP apart. Any two travels
    on one edge are close together.
    """
    between: dict[tuple[Any, Any], dict[int, Array]] = defaultdict(dict)
    for k, (first, last, course) in enumerate(travels):
        between[min(first, last), max(first, last)][k] = course
    edges: dict[int, tuple[Any, ...]] = {}
    for ends, alike in between.items():
        far = [apart(one, other) for one, other in combinations(alike.values(), 2)]
        parts = fcluster(linkage(far, "complete"), APART, "distance") if far else [1]
        edges |= {k: (*ends, part) for k, part in zip(alike, parts, strict=True)}
    numbers: dict[tuple[Any, ...], int] = {}
    return [numbers.setdefault(edges[k], len(numbers)) for k in sorted(edges)]


def laid_course(trace: Trace, ssh_map: SSHMap, t: int) -> Array:
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


def apart(first: Array, second: Array) -> float:
    """Compute the Hausdorff distance of two sequences of points, (n, 2), in metres."""
    far = cdist(first, second)
    return float(max(far.min(axis=0).max(), far.min(axis=1).max()))
