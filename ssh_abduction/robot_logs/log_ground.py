"""What the page of a log shows under its maps: the walls that the laser saw, and the robot's way.

The scans are drawn where the first map puts them. The map has a pose for each step. Each scan is
moved by the rigid motion that takes the steps near it, along the way, to their poses in the map. So
the walls of a map without errors are sharp, also where the track drifts. Corrected poses in the log
are not read.

The first dstate faces right, as in all drawings of a map. Each drive of a joint map has a frame of
its own, and is moved to where the map has its steps. Without a map with poses, each drive faces
right at its first step, and is beside the one before.
"""

from __future__ import annotations

import base64
import math
import struct
import zlib
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perception.places.importing import Imported
from perception.places.local_map import CELL
from perception.readers.scans import RobotLog, Scan
from ssh_abduction.data.drives import drives_of
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.odometry import Pose, displacement_between, moved
from ssh_abduction.output.layout import drawable_poses
from ssh_abduction.page.content import MOST, encoded

Array = NDArray[np.float64]

# There is at most one point of a wall in each square with sides of this many metres.
GRAIN = 0.1
# This many scans are moved, or the ends of their beams counted, at once.
AT_ONCE = 300
# Beams longer than this many metres are not drawn: their ends are too far apart to show a wall.
DRAWN = 12.0
# The motion of a scan fits the steps within about this many metres of the robot's way.
NEAR = 8.0
APART = 0.2  # metres between two points of the robot's way
ASIDE = 5.0  # metres between drives that no map joins
# The share of the points of walls that may lie outside the window at first: stray beams.
STRAY = 0.005
SECTORS = 180  # directions in which the page shows a scan
GREY = b"\x8a\x8a\x8a"  # the colour of walls, which can be seen on white and on black


def ground_of(log: RobotLog, imported: Imported, ssh_map: SSHMap | None) -> dict[str, Any]:
    """Make what the page shows under the maps of a log, as plain data. Positions are in metres.

    Returns:
        A dict with `walls`, a picture as the URL of a PNG; `grain`, the width of its points;
        `box`, its left, top, width and height;
        `view`, the box (left, lowest, right, highest) of all but stray points; `spots`, the x, y
        and heading (radians) of each step; `way`, points of the robot's way, with `headings`;
        `at`, the index of the point of each step; and `scans`, what the laser saw at the points,
        encoded as `drawn_images` encodes; None if no ranges are known.
    """
    poses = laid_over(imported, ssh_map)
    walls = _walls(log, poses)
    if not len(walls):  # a live mapper keeps no ranges
        walls = np.array([poses[0][:2], *_patched(imported, poses)])
    scans = [visit.scan for visit in imported.visits]
    passed = np.floor(imported.track.way / APART).astype(int)
    kept = sorted({*scans, *imported.starts, *np.flatnonzero(np.diff(passed, prepend=-1)).tolist()})
    way = np.array([poses[scan][:2] for scan in kept])
    corner, last = walls.min(axis=0), walls.max(axis=0)
    cells = np.rint((walls - corner) / GRAIN).astype(int)
    seen = np.zeros((cells.max(axis=0) + 1)[::-1], bool)
    seen[cells[:, 1].max() - cells[:, 1], cells[:, 0]] = True
    points = np.concatenate([np.quantile(walls, (STRAY, 1 - STRAY), axis=0), way])
    box = (corner[0] - GRAIN / 2, last[1] + GRAIN / 2, *(last - corner + GRAIN))
    return {
        "walls": f"data:image/png;base64,{base64.b64encode(_png(seen)).decode()}",
        "grain": GRAIN,
        "box": np.round(box, 3).tolist(),
        "view": np.round([*points.min(axis=0), *points.max(axis=0)], 2).tolist(),
        "spots": [[round(number, 3) for number in spot] for spot in _spots(poses, imported)],
        "way": np.round(way, 2).tolist(),
        "headings": [round(poses[scan][2], 2) for scan in kept],
        "scans": _scans([log.scans[scan] for scan in kept]),
        "at": [kept.index(scans[visit]) for visit in _visit_of(imported)],
    }


def _scans(scans: Sequence[Scan]) -> dict[str, Any] | None:
    """Encode how far the walls are in each direction of the robot, for as many scans as fit."""
    ranges = np.full((len(scans), SECTORS), np.inf)
    for row, scan in zip(ranges, scans, strict=True):
        x, y = scan.ends((0.0, 0.0, 0.0), DRAWN).T
        sectors = np.floor(np.arctan2(y, x) / math.tau * SECTORS).astype(int) + SECTORS // 2
        np.minimum.at(row, sectors % SECTORS, np.hypot(x, y))
    used = np.flatnonzero(np.isfinite(ranges).any(axis=0))
    if not len(used):
        return None
    ranges = np.where(np.isfinite(ranges), ranges / DRAWN, np.nan)[:, used[0] : used[-1] + 1]
    every = -(-ranges.size // MOST)
    return {
        "first": (used[0] + 0.5) * 360 / SECTORS - 180,
        "step": 360 / SECTORS,
        "reach": DRAWN,
        "images": [None if k % every else encoded(row) for k, row in enumerate(ranges)],
    }


def _png(mask: NDArray[np.bool_]) -> bytes:
    """Write a picture as PNG, with grey points where the mask is true, transparent elsewhere."""
    rows = np.pad(np.packbits(mask, axis=1), ((0, 0), (1, 0)))  # each row begins with its filter, 0
    parts = {
        b"IHDR": struct.pack(">IIBBBBB", mask.shape[1], mask.shape[0], 1, 3, 0, 0, 0),
        b"PLTE": b"\xff\xff\xff" + GREY,
        b"tRNS": b"\0",
        b"IDAT": zlib.compress(rows.tobytes(), 9),
        b"IEND": b"",
    }
    chunks = (
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in parts.items()
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


def _walls(log: RobotLog, poses: Sequence[Pose]) -> Array:
    """Find the walls: one point, in metres, for each square in which a laser beam ended, (n, 2).

    The squares have sides of GRAIN metres. In a log of more than 100 scans, at least two beams must
    have ended in a square, so that few stray beams are drawn.
    """
    squares = np.zeros((0, 2), int)
    counts: Array = np.zeros(0)
    # The ends of all beams of a long log would need much memory.
    for begin in range(0, len(log), AT_ONCE):
        some = slice(begin, begin + AT_ONCE)
        ends = [scan.ends(at, DRAWN) for scan, at in zip(log.scans[some], poses[some], strict=True)]
        cells = np.rint(np.concatenate(ends) / GRAIN).astype(int)
        every, weights = np.concatenate([squares, cells]), np.append(counts, np.ones(len(cells)))
        squares, numbers = np.unique(every, axis=0, return_inverse=True)
        counts = np.bincount(numbers.ravel(), weights).astype(float)
    return np.asarray(squares[counts > (1 if len(log) > 100 else 0)] * GRAIN)


def _patched(imported: Imported, poses: Sequence[Pose]) -> Iterator[Array]:
    """Yield the points, (2,) metres, at which the local maps of the visits show walls."""
    for visit in imported.visits:
        if visit.patch is not None:
            before = displacement_between(tuple(imported.track.poses[visit.scan]), (0.0, 0.0, 0.0))
            x, y, turn = moved(poses[visit.scan], before)
            cos, sin = math.cos(turn), math.sin(turn)
            points = np.argwhere(visit.patch.occupied) * CELL + visit.patch.corner
            yield from points @ np.array([(cos, sin), (-sin, cos)]) + (x, y)


def laid_over(imported: Imported, ssh_map: SSHMap | None) -> list[Pose]:
    """Move the poses of all scans to where the map has its steps."""
    at = drawable_poses(ssh_map) if ssh_map else None
    track = imported.track.poses
    spots, right, lowest = np.array(_spots(track.tolist(), imported)), -ASIDE, 0.0
    parts: list[Array] = []
    bounds = pairwise([0, *imported.starts, len(track)])
    for drive, (begin, stop) in zip(drives_of(imported.trace), bounds, strict=True):
        steps = range(drive.first, drive.stop)
        if at and ssh_map:
            there = [at[ssh_map.dstate_at[t]] for t in steps]
            to = np.array([(pose.x, pose.y, pose.heading) for pose in there])
            parts.append(np.concatenate([*_carried(imported, spots, to, steps, (begin, stop))]))
            continue
        alone = moved((0.0, 0.0, -spots[drive.first][2]), (0.0, 0.0, 0.0))
        part = np.array([moved(alone, pose) for pose in track[begin:stop].tolist()])
        part[:, :2] += (right + ASIDE, lowest) - part[:, :2].min(axis=0) if parts else 0
        right, lowest = part[:, 0].max(), part[:, 1].min()
        parts.append(part)
    return [(x, y, heading) for x, y, heading in np.concatenate(parts).tolist()]


def frame_among_visits(imported: Imported, ssh_map: SSHMap) -> Pose:
    """The pose of the frame of a map in that of the fitted visits, by least squares."""
    laid, track = laid_over(imported, ssh_map), imported.track.poses.tolist()
    pairs = []
    for visit, pose in zip(imported.visits, imported.poses.tolist(), strict=True):
        on_track = displacement_between((*visit.middle, 0.0), track[visit.scan])
        pairs.append((laid[visit.scan], moved(pose, on_track)))
    # A point a metre ahead of each scan brings in the headings.
    here, there = (
        np.concatenate([at, at + np.exp(1j * poses[:, 2])])
        for poses in np.array(pairs).swapaxes(0, 1)
        for at in [poses[:, 0] + 1j * poses[:, 1]]
    )
    turn = np.angle(there @ (here - here.mean()).conj())
    shift = there.mean() - here.mean() * np.exp(1j * turn)
    return float(shift.real), float(shift.imag), float(turn)


def _carried(
    imported: Imported, spots: Array, to: Array, steps: range, scans: tuple[int, int]
) -> Iterator[Array]:
    """Yield the poses of the scans of a drive, (n, 3), moved as the steps near them are moved.

    `spots` are the poses of all steps by the track, and `to` those of these steps in the map.
    Positions, and points a metre ahead, are fitted by least squares, with weights that fall with
    the distance along the way (moving least squares: Schaefer et al. 2006, "Image deformation using
    moving least squares", without scaling).
    """
    visits, way = _visit_of(imported), imported.track.way
    at = way[[imported.visits[visits[t]].scan for t in steps]]
    here, there = (
        np.concatenate([one, one + np.exp(1j * poses[:, 2])])
        for poses in (spots[steps.start : steps.stop], to)
        for one in [poses[:, 0] + 1j * poses[:, 1]]
    )
    for begin in range(scans[0], scans[1], AT_ONCE):
        some = slice(begin, min(begin + AT_ONCE, scans[1]))
        apart = (way[some, None] - at) / NEAR
        apart = np.square(apart) - np.square(apart).min(axis=1, keepdims=True)
        weights = np.tile(np.exp(-apart / 2), 2)
        weights /= weights.sum(axis=1, keepdims=True)
        middle, goal = weights @ here, weights @ there
        turn = np.angle(weights @ (there * here.conj()) - goal * middle.conj())
        x, y, heading = imported.track.poses[some].T
        moved_to = np.exp(1j * turn) * (x + 1j * y - middle) + goal
        yield np.stack([moved_to.real, moved_to.imag, heading + turn], axis=1)


def _visit_of(imported: Imported) -> list[int]:
    """The visit of each step."""
    return [int(step.extra["visit"]) for step in imported.trace.steps]


def _spots(poses: Sequence[Pose], imported: Imported) -> list[Pose]:
    """The pose of each step: the middle of its place, and the heading of the robot."""
    spots = []
    for step in imported.trace.steps:
        visit = imported.visits[int(step.extra["visit"])]
        x, y, heading = step.extra["seen"]
        spots.append(moved(poses[visit.scan], (float(x), float(y), float(heading))))
    return spots
