"""Pairs of visits, pairs of travels, and points where the drive parts: how right a map of a log is.

A map of a log says which visits are at one place and which travels are on one edge. Corrected poses
say which visits are near each other and which travels have one course. A course is the true way of
the robot from one visit to the next. Two courses are one if their Fréchet distance is small, in
either direction. The drive parts where two stretches of it that ran together diverge. A map without
a visit there cannot tell the two ways apart.

Reference:
    Eiter & Mannila 1994, "Computing discrete Fréchet distance".
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from itertools import combinations, pairwise, product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from perception.places.passages import resampled
from ssh_abduction import Solution, SSHMap, Trace
from ssh_abduction.building.edges import grouped, laid_course
from ssh_abduction.evaluation import told_poses
from ssh_abduction.output.roads import place_of_steps

Array = NDArray[np.float64]
# Two visits are at one place if their middles are within ONE metres. Within SURE metres, no
# definition of a place tells them apart.
ONE, SURE = 2.0, 1.0
# Courses are compared at points STEP metres apart. Their largest distance is APART metres, and half
# of the shorter course at most.
STEP, APART = 0.25, 1.5
# The disc of a place without a radius, in metres.
DISC = 1.0
# Two stretches run together for TOGETHER metres within BESIDE metres, and part by more than PARTED
# metres within REACH metres. They are at least GAP metres of the drive apart.
PACE, TOGETHER, BESIDE, PARTED, REACH, GAP = 0.5, 2.0, 1.0, 2.0, 4.0, 8.0
# Partings within GROUP metres are one. A visit within SEEN metres notices a parting.
GROUP, SEEN = 3.0, 1.5


def counts_of(trace: Trace, ssh_map: SSHMap | None, poses: Array) -> dict[str, Any]:
    """Count the pairs that a map joins, those of them that are right, and those that are true.

    Args:
        trace: The trace of a log, with poses as its truth.
        ssh_map: Its map; None if there is none, so that nothing is joined.
        poses: (n, 3) true pose of each scan: metres and radians.

    Returns:
        The number of visits; pairs of visits (joined, right within 2 m, true within 1 m, found of
        these); pairs of travels (joined, right, true); and partings (all, and those with a visit).
    """
    starts = [t for t in range(len(trace)) if t == 0 or trace.actions[t - 1].kind != "turn"]
    told = told_poses(trace)
    middles = np.array([told[t][:2] for t in starts])  # type: ignore[index]
    scans = [int(trace.steps[t].extra["scan"]) for t in starts]
    radii = [float(trace.steps[t].extra.get("radius", DISC)) for t in starts]
    places = [_place(ssh_map, t) for t in starts]
    edges = edges_of(trace, ssh_map) if ssh_map is not None and ssh_map.places else {}
    travels = [edges.get(after - 1) for after in starts[1:]]
    return counted(poses, middles, scans, radii, places, travels)


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


def counted(
    poses: Array,
    middles: Array,
    scans: Sequence[int],
    radii: Sequence[float],
    places: Sequence[Hashable],
    edges: Sequence[Hashable],
) -> dict[str, Any]:
    """Count pairs, as `counts_of` does, for visits to the nodes of any graph.

    Args:
        poses: (n, 3) true pose of each scan: metres and radians.
        middles: (v, 2) true middle of the place of each visit in metres.
        scans: Index of the scan of each visit.
        radii: Radius of the disc of the place of each visit, in metres.
        places: Name of the place of each visit; None if unknown.
        edges: Name of the edge of each travel between two visits; None if unknown.
    """
    courses = [
        course_of(poses[begin : end + 1, :2], middles[k : k + 2], radii[k : k + 2])
        for k, (begin, end) in enumerate(pairwise(scans))
    ]
    return {
        "visits": len(scans),
        "visit_pairs": _visit_pairs(middles, places),
        "travel_pairs": _travel_pairs(courses, edges),
        "partings": _noticed(partings(poses[:, :2]), middles),
    }


def joins_of(trace: Trace, solution: Solution) -> list[tuple[float, bool]]:
    """The probability of each join of the best map, and whether it is right.

    A join is a visit to a place, and the visit before it to the same place. It is right if the
    middles of the two visits are within 2 m.

    Args:
        trace: The trace of a log, with poses as its truth.
        solution: Its maps, with probabilities; without them, as if a limit ended the search, there
            are no joins.
    """
    told = told_poses(trace)
    visit = [0]
    for t, action in enumerate(trace.actions, 1):
        visit.append(visit[-1] if action.kind == "turn" else t)
    return [
        (probability, math.dist(told[first][:2], told[second][:2]) <= ONE)  # type: ignore[index]
        for first, second, probability in (solution.weighed and solution.weighed.joins) or ()
        if visit[first] != visit[second] and probability is not None
    ]


def _place(ssh_map: SSHMap | None, step: int) -> int | None:
    return None if ssh_map is None else ssh_map.dstates[ssh_map.dstate_at[step]].place


def _visit_pairs(middles: Array, places: Sequence[Hashable]) -> dict[str, int]:
    joined = right = true = found = 0
    for i, j in combinations(range(len(middles)), 2):
        far = math.dist(middles[i], middles[j])
        one = places[i] is not None and places[i] == places[j]
        joined += one
        right += one and far <= ONE
        true += far <= SURE
        found += one and far <= SURE
    return {"joined": joined, "right": right, "true": true, "found": found}


def _travel_pairs(courses: Sequence[Array], edges: Sequence[Hashable]) -> dict[str, int]:
    joined = right = true = 0
    for a, b in combinations(range(len(courses)), 2):
        if min(len(courses[a]), len(courses[b])) < 2:
            continue
        one, same = edges[a] is not None and edges[a] == edges[b], is_one(courses[a], courses[b])
        joined, right, true = joined + one, right + (one and same), true + same
    return {"joined": joined, "right": right, "true": true}


def _noticed(points: Array, middles: Array) -> dict[str, int]:
    near = cdist(points, middles).min(axis=1) <= SEEN if len(points) else np.zeros(0)
    return {"all": len(points), "noticed": int(near.sum())}


def course_of(way: Array, middles: Array, radii: Sequence[float]) -> Array:
    """Cut the way between two visits at the discs of their places, and join it to their middles.

    Args:
        way: (n, 2) true positions from the scan of one visit to that of the next, in metres.
        middles: (2, 2) true middles of the places.
        radii: Radii of their discs in metres.

    Returns:
        (m, 2) points in metres, STEP apart.
    """
    fine = resampled(way, 0.1) if len(way) > 1 else way
    outside = [
        np.hypot(*(fine - middle).T) > radius for middle, radius in zip(middles, radii, strict=True)
    ]
    first = int(np.argmax(outside[0])) if outside[0].any() else len(fine)
    last = len(fine) - int(np.argmax(outside[1][::-1])) if outside[1].any() else 0
    return resampled(np.concatenate([middles[:1], fine[first:last], middles[1:]]), STEP)


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


def is_one(first: Array, second: Array) -> bool:
    """Check whether two courses are one, driven in any direction."""
    longer, shorter = max(len(first), len(second)) * STEP, min(len(first), len(second)) * STEP
    most = min(APART, shorter / 2)
    if longer > 1.6 * shorter + 3:
        return False
    return any(
        max(math.dist(first[0], other[0]), math.dist(first[-1], other[-1])) <= most
        and frechet(first, other) <= most
        for other in (second, second[::-1])
    )


def partings(positions: Array) -> Array:
    """Find the points where two stretches of a drive that ran together diverge.

    Args:
        positions: (n, 2) true position of each scan in metres.

    Returns:
        (m, 2) metres; partings that are near each other count once.
    """
    way = resampled(positions, PACE)
    near = cKDTree(way).query_pairs(BESIDE, output_type="ndarray")
    found = [
        (way[i] + way[j]) / 2
        for i, j in np.sort(near, axis=1)
        if j - i >= GAP / PACE
        for ahead, side in product((1, -1), (1, -1))
        if _lead_apart(way, int(i), int(j), ahead, side)
    ]
    points = np.array(found).reshape(-1, 2)
    if len(points) < 2:
        return points
    groups = fcluster(linkage(points, "complete"), GROUP, "distance")
    return np.array([points[groups == k].mean(axis=0) for k in np.unique(groups)])


def _lead_apart(way: Array, i: int, j: int, ahead: int, side: int) -> bool:
    """Check whether two stretches of a drive diverge at two of its points.

    Args:
        way: (n, 2) metres, PACE apart.
        i: Index of the point of the earlier stretch.
        j: Index of the point of the later stretch, near the other point.
        ahead: Direction along the earlier stretch in which they diverge: 1 or -1.
        side: 1 if the robot drove both in one direction, -1 if not.
    """
    back, reach = round(TOGETHER / PACE), round(REACH / PACE)
    other = ahead * side
    begins, ends = (i - ahead * back, j - other * back), (i + ahead * reach, j + other * reach)
    if min(*begins, *ends) < 0 or max(*begins, *ends) >= len(way):
        return False
    # A robot that turns around drives along its own way. That is one stretch, not two.
    if side < 0 and (
        abs(begins[1] - begins[0]) < 4 or (ahead > 0 and j - i - 2 * back < GAP / PACE / 2)
    ):
        return False
    k = np.arange(1, back + 1)
    if (np.hypot(*(way[i - ahead * k] - way[j - other * k]).T) > BESIDE + 0.25).any():
        return False
    if math.dist(way[i + 2 * ahead], way[j + 2 * other]) < BESIDE:
        return False
    k = np.arange(reach)
    far = cdist(way[i + ahead * k], way[j + other * k])
    return bool(min(far.min(axis=1).max(), far.min(axis=0).max()) > PARTED)
