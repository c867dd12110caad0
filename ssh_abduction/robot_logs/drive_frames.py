"""Lay the drives of a joint map over each other, to draw them.

Each drive has a frame of its own. A drive is moved and turned so that the places that it shares
with drives before it lie on each other. A drive that shares no place is put beside the others.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from perception.places.importing import Imported
from perception.readers.scans import Pose
from ssh_abduction.data.drives import Drive, drives_of
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.odometry import moved

Array = NDArray[np.float64]

BESIDE = 5.0  # metres between drives that share no place


def laid_over(poses: Sequence[Pose], imported: Imported, ssh_map: SSHMap | None) -> list[Pose]:
    """Move the poses of each drive into the frame of the first one.

    Args:
        poses: The pose of each scan, in the frame of its drive.
        imported: The trace, and how it was made.
        ssh_map: The map that says which places drives share; None if there is no map.
    """
    drives = drives_of(imported.trace)
    bounds = [0, *imported.starts, len(poses)]
    own = [np.array(poses[a:b]) for a, b in pairwise(bounds)]
    spots = _spots(poses, imported)
    laid: dict[int, Array] = {0: own[0]}
    while len(laid) < len(drives):
        k, pairs = _next(drives, ssh_map, list(laid))
        if pairs:
            move = _fitted(spots, pairs, ssh_map)
        else:
            right = max(part[:, 0].max() for part in laid.values()) + BESIDE
            lowest = min(part[:, 1].min() for part in laid.values())
            move = (right - own[k][:, 0].min(), lowest - own[k][:, 1].min(), 0.0)
        laid[k] = np.array([moved(move, pose) for pose in own[k].tolist()])
        for t in range(drives[k].first, drives[k].stop):
            spots[t] = moved(move, spots[t])
    return [(x, y, heading) for k in range(len(drives)) for x, y, heading in laid[k].tolist()]


def _spots(poses: Sequence[Pose], imported: Imported) -> list[Pose]:
    """The pose of each step: the middle of its place, and the heading of the robot."""
    spots = []
    for step in imported.trace.steps:
        visit = imported.visits[int(step.extra["visit"])]
        x, y, heading = step.extra["seen"]
        spots.append(moved(poses[visit.scan], (float(x), float(y), float(heading))))
    return spots


def _next(
    drives: Sequence[Drive], ssh_map: SSHMap | None, laid: Sequence[int]
) -> tuple[int, list[tuple[int, int]]]:
    """Choose the drive to move next: the one that shares most places with the moved drives, `laid`.

    Return its index, and pairs of a step of a moved drive and a step of this drive at one place.
    """
    known: dict[object, list[int]] = defaultdict(list)
    for k in laid:
        for t in range(drives[k].first, drives[k].stop):
            known[_station(ssh_map, t)].append(t)
    pairs = {
        k: [
            (other, t)
            for t in range(drives[k].first, drives[k].stop)
            for other in known.get(_station(ssh_map, t), ())
        ]
        for k in range(len(drives))
        if k not in laid
    }
    chosen = max(pairs, key=lambda k: len({_station(ssh_map, t) for _, t in pairs[k]}))
    return chosen, pairs[chosen]


def _station(ssh_map: SSHMap | None, step: int) -> object:
    """The place of a step; the step itself if it is unknown."""
    place = None if ssh_map is None else ssh_map.place_of(step)
    return ("step", step) if place is None else place


def _fitted(
    spots: Sequence[Pose], pairs: Sequence[tuple[int, int]], ssh_map: SSHMap | None
) -> Pose:
    """Find the motion that brings the second step of each pair to the first, by least squares.

    Each pose counts as two points: itself, and a point one metre ahead. So one pair is enough.
    """
    here, there = [], []
    for first, second in pairs:
        x, y, heading = spots[first]
        u, v, other = spots[second]
        heading += _turned(ssh_map, first, second)
        there += [(x, y), (x + math.cos(heading), y + math.sin(heading))]
        here += [(u, v), (u + math.cos(other), v + math.sin(other))]
    source, target = np.array(here), np.array(there)
    middle, goal = source.mean(axis=0), target.mean(axis=0)
    (a, b), (c, d) = (source - middle).T, (target - goal).T
    turn = math.atan2(float((a * d - b * c).sum()), float((a * c + b * d).sum()))
    cos, sin = math.cos(turn), math.sin(turn)
    x = goal[0] - cos * middle[0] + sin * middle[1]
    y = goal[1] - sin * middle[0] - cos * middle[1]
    return float(x), float(y), turn


def _turned(ssh_map: SSHMap | None, first: int, second: int) -> float:
    """The heading at `second` minus that at `first`, radians counterclockwise; 0 without poses."""
    assert ssh_map is not None
    if ssh_map.fit is None or not ssh_map.fit.poses:
        return 0.0
    one, other = (ssh_map.fit.poses[ssh_map.dstate_at[step]] for step in (first, second))
    return other.heading - one.heading
