"""Where the robot went, from one scan to the next: odometry, mended by matching each scan with those shortly before it.

A scan is matched by points to lines (Chen & Medioni 1992; Censi 2008): the pose of the robot moves until the points of the scan lie on the walls that the last few scans
saw. Odometry is a prior, so along a bare corridor, where walls tell nothing of how far the robot went, the odometer does. Nothing here is global: errors add up along the
way, and the covariance of each increment says by how much.

An odometer that jumps says nothing there (`jumps`). The scan is then matched without it, near where the robot was. If it matches, the track goes on, and only the increment is unknown. If it shows
nothing of what was seen before, the robot may be anywhere, and the track is broken: what comes after is a way of its own.
"""

from __future__ import annotations

import math
from bisect import bisect
from collections import deque
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from perception.places.jumps import Unknown, unknown_steps
from perception.readers.scans import Pose, RobotLog, Scan
from ssh_abduction.data.odometry import between, moved

Array = NDArray[np.float64]

# A scan is matched with as many scans before it.
RECENT = 40
# Beams that reach farther are not matched, in metres: neighbouring beams are then too far apart to tell how a wall lies.
FARTHEST = 25.0
# Of a scan with more points so many are matched, evenly spread, which is enough and keeps the time for each scan small.
POINTS = 150
# Standard deviation of the distance of a point to the wall that it lies on, in metres: the laser's noise, and that walls are not straight.
ROUGHNESS = 0.05
# Errors of neighbouring points go together, so that many points tell as much as an independent one.
TOGETHER = 3
# A point may be off by so much at first, in metres, and by less in each round, down to the second number.
BEGIN, END, SHRINK, ROUNDS = 1.0, 0.25, 0.75, 12
# A match is poor where less than such a share of the points lies on walls. Odometers miss turns, and logs miss lines: then all headings are tried, in so many steps.
POOR, HEADINGS = 0.5, 24
# Of scans that show nothing of what was seen before, less than such a share of the points lies on walls, in so many scans in a row.
STRANGE, IN_A_ROW = 0.3, 3
# A robot that went no farther than so many metres, by its odometer, sees something of what it saw before.
NEARBY = 1.0
# Where the odometer says nothing, the robot moved like this, in metres and radians: standard deviations.
UNKNOWN = (0.5, 0.5, 0.5)
# An odometer has turned wrongly if a scan that matches well says otherwise by more than this, in radians.
TURNED = math.radians(60)
# A robot that stands, by its odometer, was carried if scans moved by more than so many metres.
CARRIED = 1.0
# Without odometry a scan has to match better: at least such a share of its points lies on walls.
SURE = 0.7
# In a bare corridor, to go on and to stay match alike, up to such a share: then the robot went on.
ALIKE = 0.03


@dataclass(frozen=True)
class Trust:
    """How far the increments of an odometer are believed while scans are matched: standard deviations.

    way      along the way, as a share of it; across it is half of that
    offset   in metres, whatever the way
    turning  as a share of the turn
    drift    of the heading, in radians a metre
    angle    of the heading, in radians, whatever the way
    """

    way: float = 0.1
    offset: float = 0.03
    turning: float = 0.1
    drift: float = 0.02
    angle: float = 0.02

    def covariance(self, onward: Pose) -> Array:
        """The covariance of an increment, (3, 3), in the frame of the robot before it."""
        way = math.hypot(onward[0], onward[1])
        along, across = self.offset + self.way * way, self.offset + self.way * way / 2
        heading = self.angle + self.turning * abs(onward[2]) + self.drift * way
        return np.diag([along**2, across**2, heading**2])


@dataclass(frozen=True, eq=False)
class Track:
    """The way of the robot, by short-term odometry and scan matching.

    poses        (n, 3): x, y in metres and the heading in radians, in the frame of the first scan
    covariances  (n, 3, 3): of the increment that led to each scan, in the frame of the robot at the scan before it; zeros for the first
    shares       (n,): how much of each scan lay on walls that were seen before; 1 for the first. Empty where nothing was matched
    cuts         the scans before which nothing is known of how the robot moved, as the odometer jumped: no displacement leads across
    breaks       those of them that show nothing of what was seen before: the robot may be anywhere, and neither path nor place leads across
    """

    poses: Array
    covariances: Array
    shares: Array = field(default_factory=lambda: np.ones(0))
    cuts: tuple[int, ...] = ()
    breaks: tuple[int, ...] = ()

    @cached_property
    def way(self) -> Array:
        """Metres travelled up to each scan, (n,)."""
        return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(self.poses[:, :2], axis=0).T))])

    @cached_property
    def spans(self) -> tuple[tuple[int, int], ...]:
        """The first scan of each unbroken way, and the one after its last."""
        return tuple(pairwise((0, *self.breaks, len(self.poses))))

    def span_of(self, scan: int) -> tuple[int, int]:
        """The unbroken way that a scan is on."""
        return self.spans[bisect(self.breaks, scan)]

    def part(self, begin: int, end: int) -> Track:
        """An unbroken way as a track of its own, in the same frame."""
        some = slice(begin, end)
        cuts = tuple(cut - begin for cut in self.cuts if begin < cut < end)
        return Track(self.poses[some], self.covariances[some], self.shares[some], cuts)

    def cuts_between(self, first: int, last: int) -> list[int]:
        """The cuts after one scan and up to another."""
        return [cut for cut in self.cuts if first < cut <= last]


def wrapped(angle: float) -> float:
    """The same angle, from -pi to pi."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def follow(log: RobotLog, trust: Trust | None = None) -> Track:
    """The way of the robot. Corrected poses are not read."""
    steps = unknown_steps(log)
    follower = _Follower(log, trust or Trust(), steps)
    track = follower.followed(steps.carried)
    # Where people pass, or an arm of the robot moves, what the laser sees changes though the robot stands.
    standing = frozenset(
        k
        for first, last in steps.still
        for k in range(first, last + 1)
        if np.hypot(*(track.poses[first : last + 1, :2] - track.poses[first - 1, :2]).T).max()
        <= CARRIED
    )
    if standing:
        follower = replace(follower, steps=steps.but_for(standing))
        track = follower.followed(steps.carried)
    if more := frozenset(_carried(log, track)):
        track = follower.followed(steps.carried | more)
    return track


@dataclass(frozen=True)
class _Follower:
    """Follows a log.

    steps  those of which the odometer knows nothing
    """

    log: RobotLog
    trust: Trust
    steps: Unknown

    def followed(self, carried: frozenset[int]) -> Track:
        """The track, which is broken before the scans to which the robot was carried."""
        poses: list[Pose] = [(0.0, 0.0, 0.0)]
        covariances, shares = [np.zeros((3, 3))], [1.0]
        cuts: list[int] = []
        breaks: list[int] = []
        recent: deque[tuple[Array, Array]] = deque(maxlen=RECENT)
        before: Pose = (0.0, 0.0, 0.0)
        for i, scan in enumerate(self.log.scans):
            points, normals = surfaces(scan)
            if i > 0:
                onward = between(self.log.scans[i - 1].odometry, scan.odometry)
                pose, covariance, share = poses[-1], self.trust.covariance((0.0, 0.0, 0.0)), 0.0
                if i in carried:
                    breaks.append(i)
                elif i in self.steps.unknown:
                    cuts.append(i)
                    found = _bridged(points, normals, recent, poses[-1], before)
                    pose, covariance, share = found or (pose, covariance, share)
                    if found is None:
                        breaks.append(i)
                else:
                    pose, covariance, share = _matched(
                        points, normals, recent, poses[-1], onward, self.trust.covariance(onward)
                    )
                    doubtful = share < POOR and i in self.steps.doubtful
                    if (
                        doubtful
                        and (found := _bridged(points, normals, recent, poses[-1], before))
                        is not None
                    ):
                        cuts.append(i)
                        pose, covariance, share = found
                if breaks[-1:] == [i]:
                    recent.clear()
                before = between(poses[-1], pose)
                poses.append(pose)
                covariances.append(covariance)
                shares.append(share)
            recent.append((_moved(poses[-1], points), points_turned(poses[-1][2], normals)))
        return Track(
            np.array(poses),
            np.array(covariances),
            np.array(shares),
            tuple(sorted({*cuts, *breaks})),
            tuple(breaks),
        )


def _bridged(
    points: Array, normals: Array, recent: deque[tuple[Array, Array]], last: Pose, before: Pose
) -> tuple[Pose, Array, float] | None:
    """The pose of a scan by walls alone, with the covariance of the increment and the share of points on walls: near where the robot was, or where it went on as before. None where it matches nowhere."""
    wide = np.diag(UNKNOWN) ** 2
    onward, stayed = (
        _matched(points, normals, recent, last, guess, wide) for guess in (before, (0.0, 0.0, 0.0))
    )
    best = stayed if stayed[2] > onward[2] + ALIKE else onward
    return best if best[2] >= SURE else None


def _carried(log: RobotLog, track: Track) -> list[int]:
    """The scans from which on nothing is seen of what was seen before, though the odometer does not jump: the robot was carried while nobody logged."""
    found: list[int] = []
    for i in np.flatnonzero(track.shares < STRANGE).tolist():
        if (
            math.dist(log.scans[i - 1].odometry[:2], log.scans[i].odometry[:2]) > NEARBY
            or i in track.breaks
            or i + IN_A_ROW > len(log)
            or (found and i < found[-1] + IN_A_ROW)
        ):
            continue
        begin = max(0, i - RECENT, *(b for b in (*track.breaks, *found) if b <= i))
        known: deque[tuple[Array, Array]] = deque()
        for k in range(begin, i):
            points, normals = surfaces(log.scans[k])
            known.append(
                (_moved(track.poses[k], points), points_turned(track.poses[k, 2], normals))
            )
        wide = np.diag(UNKNOWN) ** 2
        if not sum(len(walls) for walls, _ in known):
            continue
        shares = [
            _matched(
                *surfaces(log.scans[k]), known, _as_pose(track.poses[k]), (0.0, 0.0, 0.0), wide
            )[2]
            for k in range(i, i + IN_A_ROW)
        ]
        # They have to see each other, or else it is the laser that sees nothing.
        if max(shares) < STRANGE and track.shares[i + 1 : i + IN_A_ROW].min() >= POOR:
            found.append(i)
    return found


def turned_wrongly(log: RobotLog, track: Track) -> list[tuple[int, float]]:
    """The scans that match well where the robot turned otherwise than the odometer says, and by how many radians."""
    found: list[tuple[int, float]] = []
    for i in range(1, len(log)):
        told = between(log.scans[i - 1].odometry, log.scans[i].odometry)[2]
        off = wrapped(float(track.poses[i, 2] - track.poses[i - 1, 2]) - told)
        if abs(off) > TURNED and track.shares[i] >= POOR and i not in track.cuts:
            found.append((i, off))
    return found


def _as_pose(row: Array) -> Pose:
    return float(row[0]), float(row[1]), float(row[2])


def surfaces(scan: Scan) -> tuple[Array, Array]:
    """The points of a scan that lie on a smooth surface, (m, 2), in metres in the frame of the robot, and the unit normals of the surface there, (m, 2)."""
    laser, ranges = scan.laser, scan.ranges
    good = np.isfinite(ranges) & (ranges < min(FARTHEST, laser.reach))
    r = np.where(good, ranges, 0.0)
    points = np.stack([r * np.cos(laser.bearings), r * np.sin(laser.bearings)], axis=1)
    normals = np.full(points.shape, np.nan)
    for k in (
        1,
        2,
        3,
    ):  # The farthest neighbours that still lie on one line with the point tell the normal best.
        if len(points) <= 2 * k:
            break
        middle = slice(k, len(points) - k)
        line = points[2 * k :] - points[: -2 * k]
        length = np.hypot(*line.T)
        normal = np.stack([-line[:, 1], line[:, 0]], axis=1) / np.maximum(length, 1e-9)[:, None]
        off = np.abs(((points[middle] - points[: -2 * k]) * normal).sum(axis=1))
        smooth = (
            good[2 * k :]
            & good[: -2 * k]
            & good[middle]
            & (length > 1e-6)
            & (length < 0.25 + 0.1 * r[middle])
            & (off < ROUGHNESS)
        )
        normals[middle][smooth] = normal[smooth]
    on_surface = good & np.isfinite(normals[:, 0])
    return _moved(laser.mount, points[on_surface]), points_turned(
        laser.mount[2], normals[on_surface]
    )


def _matched(
    points: Array,
    normals: Array,
    recent: deque[tuple[Array, Array]],
    last: Pose,
    onward: Pose,
    prior: Array,
) -> tuple[Pose, Array, float]:
    """The pose of a scan, the covariance of the increment, in the frame of the robot at the scan before, and the share of the points that lie on walls."""
    turn: Array = np.eye(3)
    turn[:2, :2] = _rotation(last[2])
    walls = np.concatenate([wall for wall, _ in recent])
    wall_normals = np.concatenate([normal for _, normal in recent])
    guess: Array = np.array(moved(last, onward))
    weight: Array = np.asarray(np.linalg.inv(turn @ prior @ turn.T), np.float64)
    pose, information, share = guess, weight, 0.0
    if len(walls) and len(points):
        kept = np.unique(np.linspace(0, len(points) - 1, min(len(points), POINTS)).astype(int))
        fit = _Fit(points[kept], normals[kept], walls, wall_normals, cKDTree(walls))
        share, pose, information = fit.improved(guess, weight)
        if share < POOR:
            turned = [guess + np.array([0, 0, 2 * math.pi * k / HEADINGS]) for k in range(HEADINGS)]
            best = max(
                (fit.improved(other, weight) for other in turned), key=lambda found: found[0]
            )
            if best[0] > 1.5 * share:
                share, pose, information = best
    covariance = np.asarray(turn.T @ _accumulating(information, weight) @ turn)
    return (float(pose[0]), float(pose[1]), wrapped(float(pose[2]))), covariance, share


def _accumulating(information: Array, prior: Array) -> Array:
    """The covariance of what an increment adds to the error of the track in the long run, (3, 3).

    What walls do not tell is the odometer's error, all of which stays. What they tell is told by the mean of many scans before, so that little of its error is handed on:
    of a value that is always measured against the mean of the last n, each error shifts what comes later by 2 / (n + 1) of itself.

    information  of the pose, by the odometer and by walls
    prior        that of the odometer alone
    """
    posterior = np.linalg.inv(information)
    by_odometer = posterior @ prior
    by_walls = posterior @ (information - prior) @ posterior
    return np.asarray(
        by_odometer @ np.linalg.inv(prior) @ by_odometer.T + 2 / (RECENT + 1) * by_walls
    )


@dataclass(frozen=True, eq=False)
class _Fit:
    """Points of a scan with their normals, in the frame of the robot, and the walls that they are to lie on, in the frame of the track."""

    points: Array
    normals: Array
    walls: Array
    wall_normals: Array
    tree: cKDTree

    def improved(self, guess: Array, weight: Array) -> tuple[float, Array, Array]:
        """From a guess with its weight, (3, 3): the share of the points that lie on walls, the pose at which they do, and its information, (3, 3)."""
        information, pose, share = weight, guess, 0.0
        for count in range(ROUNDS):
            placed = _moved(pose, self.points)
            distance, nearest = self.tree.query(
                placed, distance_upper_bound=max(END, BEGIN * SHRINK**count)
            )
            met = np.flatnonzero(np.isfinite(distance))
            alike = (
                points_turned(pose[2], self.normals[met]) * self.wall_normals[nearest[met]]
            ).sum(axis=1)
            met = met[np.abs(alike) > 0.8]
            share = float((distance[met] < END).sum() / len(placed))
            if len(met) < 5:
                break
            normal = self.wall_normals[nearest[met]]
            off = ((placed[met] - self.walls[nearest[met]]) * normal).sum(axis=1)
            arm = placed[met] - pose[:2]
            jacobian = np.column_stack(
                [normal, arm[:, 0] * normal[:, 1] - arm[:, 1] * normal[:, 0]]
            )
            weights = 1 / (
                TOGETHER * ROUGHNESS**2 * (1 + (off / (2 * ROUGHNESS)) ** 2)
            )  # Cauchy's: what is far off counts little.
            astray = pose - guess
            astray[2] = wrapped(astray[2])
            information = jacobian.T @ (jacobian * weights[:, None]) + weight
            step = np.linalg.solve(information, jacobian.T @ (weights * off) + weight @ astray)
            pose = pose - step
            if np.abs(step).max() < 1e-4:
                break
        return share, pose, information


def _rotation(angle: float) -> Array:
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin], [sin, cos]])


def points_turned(angle: float, points: Array) -> Array:
    """Points or directions, (n, 2), turned counterclockwise."""
    return np.asarray(points @ _rotation(angle).T)


def _moved(pose: Pose | Array, points: Array) -> Array:
    """Points that are seen from a pose, (n, 2), in the frame in which the pose is."""
    return np.asarray(points_turned(pose[2], points) + np.asarray(pose[:2]))
