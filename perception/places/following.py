"""Follows the robot: odometry, corrected by matching keyframes with the walls seen before.

Points are matched with lines (Chen & Medioni 1992; Censi 2008): the pose moves until the points of
the scan lie on the walls that the last keyframes saw. A scan that shows hardly anything new is no
keyframe, and the odometry alone places it between two of them. If scans are far apart, each is a
keyframe. So the time depends on the way, not on the number of scans. Odometry is a prior. In a
bare corridor, walls do not show how far the robot went, so the odometer decides. An increment is
the motion from one scan to the next. There is no global map, so errors of increments accumulate
along the trajectory. Each increment has a covariance.

If the odometer jumps, the scan is matched near the previous pose without odometry. If it
matches, the track goes on, and only the increment is unknown: this is a cut. If nothing in the scan
was seen before, the robot may be anywhere. Then the track is broken, and a new trajectory begins.

Scans may also contradict the scans before them: walls of one lie in free space of the other. This
happens where the robot was carried while nothing was logged, or where a file holds two drives.
"""

from __future__ import annotations

import math
from array import array
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from perception.places.odometers import Doubt, doubts_of, seconds_between, shows_motion
from perception.places.track import (
    Array,
    Track,
    covariance_turned,
    errors_of,
    is_near,
    odometer_covariance,
    points_moved,
    points_turned,
    wrapped,
)
from perception.readers.scans import RobotLog, Scan
from ssh_abduction.data.odometry import Pose, displacement_between, moved
from ssh_abduction.runtime.loggers import log_progress

# Longer beams are not matched, in metres: their neighbours are too far apart to show a wall.
FARTHEST = 25.0
# Standard deviation in metres of points from their wall: noise, and unevenness of the wall.
ROUGHNESS = 0.05
# Fewer points of a scan do not show whether the robot is where it seems to be.
FEW_POINTS = 20
# Errors of neighbouring points are correlated: this many points count as one independent point.
TOGETHER = 3
# Largest distance in metres from a point to a wall: BEGIN in the first round, then SHRINK times as
# large in each round, but at least END. ROUNDS is the largest number of rounds.
BEGIN, END, SHRINK, ROUNDS = 1.0, 0.25, 0.75, 12
# Points of a scan intrude if they lie in the free space of the other scans, at least MARGIN metres
# from walls. A scan contradicts the scans before it if two things hold: less than the share POORLY
# of its points matches, and more than the share INTRUDING of either side intrudes. BESIDE scans on
# each side are compared. In good logs, at most 27 % of the points of scans that match so badly
# intrude. The share INTRUDING_RARELY suffices if the share that matches is more than WORSE below
# the RARELY-th percentile of the log.
INTRUDING, MARGIN, POORLY, BESIDE = 0.3, 0.4, 0.6, 3
INTRUDING_RARELY, WORSE, RARELY = 0.15, 0.25, 1.0
# Nobody carries a robot in less than CARRYING seconds.
CARRYING = 1.0
# Number of previous keyframes to match a scan with.
RECENT = 40
# The keyframes, counted back, that show what moved since, if they are at most NEARBY metres away.
EARLIER, NEARBY = (10, 7, 4, 1), 1.0
# Largest number of points of a scan to match, evenly spread. It bounds the time for a scan.
POINTS = 150
# A match is poor if less than the share POOR of the points lies on walls. Then HEADINGS headings
# are tried, because odometers miss turns, and logs miss lines. An independent point on a wall is
# worth a nat. A pose loses what the odometry says against it, but at most MISSED nats, as odometers
# miss a turn once in thousands of steps. A pose that puts more than the share INTRUDING of the
# points into free space does not count: few walls fit by chance. Where odometers truly missed a
# turn, at most 24 % of the points intrude, and at least 80 % where they did not.
POOR, HEADINGS, MISSED = 0.5, 24, 8.0
# Matching fails in at most 1.5 % of the scans of good logs.
FAILING = 0.05
TOLD = 100  # scans between two lines of progress
# This many scans show whether a robot stood while its odometer stood still.
IN_A_ROW = 3
# Standard deviations of the motion without odometry, in metres and radians.
UNKNOWN = (0.5, 0.5, 0.5)
# The odometer turned wrongly if a well-matched scan differs by more than this, in radians.
TURNED = math.radians(60)
# A robot whose odometer stands still was carried if scans moved by more than this many metres.
CARRIED = 1.0
# Share of points on walls that a match needs without odometry. It is WELL if the robot turned by
# more than HELD radians, while its odometer stood still.
SURE, HELD, WELL = 0.7, 0.15, 0.9
# A match contradicts the odometer from this chi-square on (3 degrees of freedom). If less than the
# share CLEAR of the points lies on walls then, either may be right. So the covariance is widened by
# the difference of the two.
CONTRARY, CLEAR = 25.0, 0.8
# In a bare corridor, moving on and standing still match equally well. If their shares of points on
# walls differ by at most this, the robot is taken to have moved on.
ALIKE = 0.03
# Where the odometer is missing, the robot may have moved by AHEAD metres, with standard deviations
# ANYWHERE in metres and radians. A scan is matched from each of these guesses, with the standard
# deviations UNKNOWN around it: metres ahead, and radians of a turn on the way. The LIKELIEST
# matches are compared.
AHEAD, ANYWHERE = 0.5, (1.5, 0.75, 0.6)
GUESSES = [(x, math.radians(turn)) for x in (0.0, 1.0, 2.0, 3.0) for turn in range(-75, 76, 15)]
LIKELIEST = 8
# Numbers that a growing track keeps for each scan: pose, covariance and share.
ROW = 3 + 9 + 1
_Posed = tuple[Scan, Pose]


def follow(log: RobotLog, known: tuple[Mapping[int, Doubt], Track] | None = None) -> Track:
    """Compute the trajectory of a robot from its log, by odometry and scan matching.

    Corrected poses are not read. `known` is a track of these scans that a `Follower` made, with its
    doubts; it saves time.
    """
    doubts, still = doubts_of(log)
    # Somebody who lifted the robot knows it.
    doubts |= {k: one for k, one in (known[0] if known else {}).items() if one is Doubt.CARRIED}
    track = known[1] if known and _is_of(log, *known, doubts) else _track_of(log, doubts)
    # People or an arm of the robot can change what the laser sees while the robot stands.
    standing = {
        k
        for first, last in still
        if _stands(log, track, first, last)
        for k in range(first, last + 1)
        if doubts[k] is not Doubt.CARRIED
    }
    if standing:
        doubts = {k: doubt for k, doubt in doubts.items() if k not in standing}
        track = _track_of(log, doubts)
    # If matching fails in much of the log, contradictions do not show that the robot was carried.
    if share_failing(track) <= FAILING and (more := scans_after_a_carry(log, track)):
        track = _track_of(log, {**doubts, **dict.fromkeys(more, Doubt.CARRIED)})
    return track


def _is_of(
    log: RobotLog, used: Mapping[int, Doubt], track: Track, doubts: Mapping[int, Doubt]
) -> bool:
    """Whether a track that used some doubts is the track of others."""
    weak = {Doubt.NONE, Doubt.DOUBTFUL, Doubt.SEAM}  # they matter only where a scan matches badly
    return all(
        {used.get(k, Doubt.NONE), doubts.get(k, Doubt.NONE)} <= weak
        and track.shares[k] >= POOR
        and log.scans[k].laser.mount == log.scans[k - 1].laser.mount
        for k in used.keys() | doubts.keys()
        if used.get(k) != doubts.get(k)
    )


def _stands(log: RobotLog, track: Track, first: int, last: int) -> bool:
    """Whether the robot stood or turned on the spot while its odometer stood still.

    `first` and `last` are scans of this stretch. If the robot was carried, the scans from `last` on
    do not match the walls that were seen before.
    """
    off = track.poses[first : last + 1, :2] - track.poses[first - 1, :2]
    if np.hypot(*off.T).max() > CARRIED:
        return False
    since = max(0, first - RECENT, *(b for b in track.breaks if b < first))
    known = [surfaces_in(log.scans[k]).moved(track.poses[k]) for k in range(since, first)]
    begin, wide, turns, shares = log.scans[first - 1].odometry, np.diag(UNKNOWN) ** 2, [], []
    for scan in log.scans[last : last + IN_A_ROW]:
        if len(seen := surfaces_in(scan)):
            onward = displacement_between(begin, scan.odometry)
            motion = ScanMotion(scan, seen, known, track.pose(first - 1), onward, onward)
            pose, _, share = motion.matched(onward, wide)
            turns.append(abs(wrapped(pose[2] - track.poses[first - 1, 2] - onward[2])))
            shares.append(share)
    if not shares:  # the laser sees nothing
        return True
    return float(np.median(shares)) >= (SURE if np.median(turns) <= HELD else WELL)


def _track_of(log: RobotLog, doubts: Mapping[int, Doubt]) -> Track:
    """Make the track, which is broken before each scan to which the robot was carried."""
    done, follower = GrowingTrack(), Follower(lambda i, _: doubts.get(i, Doubt.NONE))
    for k, scan in enumerate(log.scans):
        done.add(follower.add(scan))
        if k % TOLD == 0:
            log_progress(f"scan {k} of {len(log)}")
    return done.track


@dataclass(frozen=True, eq=False, slots=True)
class Followed:
    """A scan with its pose on the track."""

    scan: Scan  # as it was logged
    pose: Pose  # x, y in metres and heading in radians, in the frame of the first scan
    # (3, 3) covariance of the motion from the previous scan, in the frame of the robot at the
    # previous scan.
    covariance: Array = field(default_factory=lambda: np.zeros((3, 3)))
    # Share of the points of the scan on known walls; NaN if its beams meet nothing.
    share: float = 1.0
    cut: bool = False  # whether the motion from the previous scan is unknown
    broken: bool = False  # whether the robot may be anywhere, so that a new trajectory begins

    def shows_the_same(self, scan: Scan, onward: Pose) -> bool:
        """Whether a scan shows hardly more than this one, after a motion by the odometry.

        If many beams change, the odometer misses a motion.
        """
        same = is_near(onward) and scan.laser == self.scan.laser
        return same and not shows_motion(self.scan, scan)


class GrowingTrack:
    """A track to which scans are added. Each needs about 100 bytes."""

    def __init__(self) -> None:
        # Indices of the scans so far before which the motion is unknown, and of those among them at
        # which a new trajectory begins.
        self.cuts, self.breaks = list[int](), list[int]()
        self._rows = array("d")  # pose, covariance and share of each scan

    def __len__(self) -> int:
        """The number of scans."""
        return len(self._rows) // ROW

    def add(self, one: Followed) -> None:
        """Add the next scan."""
        self.cuts += [len(self)] if one.cut else []
        self.breaks += [len(self)] if one.broken else []
        self._rows.extend((*one.pose, *one.covariance.ravel(), one.share))

    @property
    def track(self) -> Track:
        """The track up to the last scan. It is not copied: while it is in use, add no scan."""
        rows = np.asarray(self._rows).reshape(-1, ROW)
        covariances, shares = rows[:, 3:12].reshape(-1, 3, 3), rows[:, 12]
        return Track(rows[:, :3], covariances, shares, tuple(self.cuts), tuple(self.breaks))


class Follower:
    """Computes the pose of each scan from the scans before it, while they come.

    A keyframe is a scan that may show something new. Only keyframes are matched. The odometry leads
    on from the last one.
    """

    def __init__(self, doubt_of: Callable[[int, Pose], Doubt]) -> None:
        """Begin a track.

        `doubt_of` takes the index of a scan and the motion from the previous scan by odometry. It
        says how far this motion can be trusted.
        """
        self.doubts: dict[int, Doubt] = {}  # of the scans whose odometry was doubted
        self.lifted = False  # whether the robot may be anywhere at the next scan
        self._doubt_of, self._count = doubt_of, 0
        self._walls = LocalWalls()
        self._last: Followed | None = None
        self._before: Pose = (0.0, 0.0, 0.0)
        self._mounts: set[Pose] = set()  # of the lasers whose scans came since the last break

    def add(self, scan: Scan) -> Followed:
        """Add the next scan, and return it with its pose."""
        one, is_key = self._posed(scan)
        one = one if in_sight(scan).any() or not self._last else replace(one, share=math.nan)
        if self._last:
            self._before = displacement_between(self._last.pose, one.pose)
        if one.broken:
            self._walls = LocalWalls()
            self._mounts.clear()
        self._mounts.add(scan.laser.mount)
        if is_key:
            self._walls.add(one)
        self._last, self._count, self.lifted = one, self._count + 1, False
        return one

    def _posed(self, scan: Scan) -> tuple[Followed, bool]:
        """Compute the pose of the next scan. Also return whether it is a keyframe."""
        if not (last := self._last):
            return Followed(scan, (0.0, 0.0, 0.0)), True
        onward = displacement_between(last.scan.odometry, scan.odometry)
        doubt = Doubt.CARRIED if self.lifted else self._doubt_of(self._count, onward)
        may_lead = doubt in (Doubt.NONE, Doubt.MISSING)
        start = self._walls.keys[-1] if may_lead else last
        onward = displacement_between(start.scan.odometry, scan.odometry)
        guess = moved(start.pose, onward)
        if may_lead and start.shows_the_same(scan, onward):
            return Followed(scan, guess, share=start.share), False
        self.doubts |= {} if doubt is Doubt.NONE else {self._count: doubt}
        if doubt is Doubt.NONE and scan.laser.mount not in self._mounts:
            # The first scan of another laser may show none of the known walls.
            return Followed(scan, guess, odometer_covariance(onward)), True
        seen = surfaces_in(scan)
        keys = [*self._walls.keys][-BESIDE:]
        step = ScanMotion(scan, seen, self._walls.recent, start.pose, onward, self._before, keys)
        return step.judged(doubt), True


class LocalWalls:
    """The walls that the last keyframes saw, in the frame of the track."""

    def __init__(self) -> None:
        self.keys: deque[Followed] = deque(maxlen=EARLIER[0])
        self.recent: deque[Surfaces] = deque(maxlen=RECENT)

    def add(self, key: Followed) -> None:
        """Add a keyframe, and the surfaces in it. What moved is no wall."""
        seen = surfaces_in(key.scan, self._moved_in(key.scan, key.pose))
        # Walls are remembered while the laser sees none.
        if len(seen) or not self.recent:
            self.recent.append(seen.moved(key.pose))
        self.keys.append(key)

    def _moved_in(self, scan: Scan, pose: Pose) -> NDArray[np.bool_]:
        """Mask of the beams of a scan, (beams,), that end where keyframes saw free space."""
        gone = np.zeros(len(scan.ranges), bool)
        for old in (self.keys[-n] for n in EARLIER if n <= len(self.keys)):
            if math.dist(old.pose[:2], pose[:2]) < NEARBY:
                gone |= _in_free_space(scan, pose, old.scan, old.pose)[0]
        return gone


@dataclass(frozen=True, eq=False)
class ScanMotion:
    """A motion from one scan to the next."""

    scan: Scan  # the next scan
    seen: Surfaces  # the surfaces that it shows
    recent: Iterable[Surfaces]  # the surfaces in previous scans, in the frame of the track
    last: Pose  # pose of the previous scan
    onward: Pose  # the motion by odometry
    before: Pose  # the motion to the previous scan
    keys: Sequence[Followed] = ()  # the last keyframes

    def judged(self, doubt: Doubt) -> Followed:
        """Match the scan: with the odometry if it can be trusted, otherwise without."""
        still = odometer_covariance((0.0, 0.0, 0.0))
        nowhere = Followed(self.scan, self.last, still, 0.0, True, True)
        if doubt is Doubt.CARRIED:
            return nowhere
        if doubt is Doubt.UNKNOWN:
            return self._without_odometry() or nowhere
        if doubt is Doubt.MISSING:
            return self._searched()
        prior = odometer_covariance(self.onward)
        # An odometer that misses a large turn stands still. In corridors, scans that hardly
        # overlap match as well if they are turned around.
        most = TURNED if any(self.onward) else math.pi
        found = self.matched(self.onward, prior, most)
        if found[2] < POOR and doubt in (Doubt.DOUBTFUL, Doubt.SEAM):
            if other := self._without_odometry():
                return other
            if doubt is Doubt.SEAM:
                return nowhere
        return Followed(self.scan, *found)

    def matched(
        self, onward: Pose, prior: Array, most: float = math.pi
    ) -> tuple[Pose, Array, float]:
        """Match a scan with the walls that previous scans saw.

        `onward` is the expected motion since the previous scan, `prior` its (3, 3) covariance. The
        heading differs by at most `most` radians, unless the share WELL of the points is on walls.
        Returns the pose, the covariance of the motion seen from the previous scan, and this share.
        """
        walls = Surfaces.joined(self.recent)
        guess: Array = np.array(moved(self.last, onward))
        weight: Array = np.asarray(
            np.linalg.inv(covariance_turned(self.last[2], prior)), np.float64
        )
        pose, information, share = guess, weight, 0.0
        if len(walls) and len(self.seen):
            fit = ScanFit(self.seen.some(POINTS), walls)
            share, pose, information = fit.improved(guess, weight)
            # If the match is poor, the odometer may be right, or the heading wrong.
            if share < POOR:
                found = [(share, pose, information), (fit.share(guess), guess, weight)]
                turns = (wrapped(2 * math.pi * k / HEADINGS) for k in range(HEADINGS))
                turned: list[tuple[float, Array, Array]] = []
                if len(self.seen) >= FEW_POINTS:
                    tried = (guess + np.array([0, 0, turn]) for turn in turns if abs(turn) <= most)
                    fits = (fit.improved(start, weight) for start in tried)
                    at = guess[2]
                    turned = [m for m in fits if m[0] >= WELL or abs(wrapped(m[1][2] - at)) <= most]

                def gain(match: tuple[float, Array, Array]) -> float:
                    loss = min(_square(match[1], guess, weight) / 2, MISSED)
                    return match[0] * len(self.seen) / TOGETHER - loss

                best = max([*found, *turned], key=gain)
                if self._intruding(best[1]) > INTRUDING:
                    best = max(found, key=gain)
                share, pose, information = best
        covariance = covariance_turned(-self.last[2], _accumulating(information, weight))
        if share < CLEAR and _square(pose, guess, weight) > CONTRARY:
            off = errors_of(pose, guess)
            off[:2] = points_turned(-self.last[2], off[:2])
            covariance += np.diag(off**2)
        return (float(pose[0]), float(pose[1]), wrapped(float(pose[2]))), covariance, share

    def _intruding(self, pose: Array) -> float:
        """The share of points of the scan, at a pose, and of the last keyframes in free space."""
        at: Pose = (float(pose[0]), float(pose[1]), float(pose[2]))
        inside, seen = _clashes([(self.scan, at)], [(key.scan, key.pose) for key in self.keys])
        return inside / max(seen, 1)

    def _searched(self) -> Followed:
        """Match the scan from many guesses, as the odometer does not say how the robot moved.

        The covariance is that of the best match, and how far other matches are from it, each
        weighed by its likelihood.
        """
        walls, turned = Surfaces.joined(self.recent), self.last[2]
        prior, near = (
            np.asarray(np.linalg.inv(covariance_turned(turned, np.diag(spread) ** 2)))
            for spread in (ANYWHERE, UNKNOWN)
        )
        middle = np.array(moved(self.last, (AHEAD, 0.0, 0.0)))
        if not (len(walls) and len(self.seen)):
            return Followed(self.scan, self.last, np.diag(ANYWHERE) ** 2, 0.0)
        fit = ScanFit(self.seen.some(POINTS), walls)
        independent = len(self.seen) / TOGETHER
        found = []
        for far, turn in GUESSES:
            onward = (far * math.cos(turn / 2), far * math.sin(turn / 2), turn)
            share, pose, information = fit.improved(np.array(moved(self.last, onward)), near, False)
            gain = share * independent - _square(pose, middle, prior) / 2
            found.append((gain, share, pose, information))
        found = sorted(found, key=lambda match: -match[0])[:LIKELIEST]
        gains = np.array([match[0] - self._intruding(match[2]) * independent for match in found])
        _, share, pose, information = found[int(gains.argmax())]
        off = errors_of(np.array([match[2] for match in found]), pose)
        off[:, :2] = points_turned(-turned, off[:, :2])
        weights = np.exp(gains - gains.max())
        covariance = covariance_turned(-turned, _accumulating(information, near))
        covariance += np.einsum("m,mi,mj->ij", weights / weights.sum(), off, off)
        x, y, heading = pose.tolist()
        return Followed(self.scan, (x, y, wrapped(heading)), covariance, share)

    def _without_odometry(self) -> Followed | None:
        """Match the scan as if the robot moved as before, or stood; None if neither matches."""
        wide = np.diag(UNKNOWN) ** 2
        onward, stayed = (self.matched(guess, wide) for guess in (self.before, (0.0, 0.0, 0.0)))
        best = stayed if stayed[2] > onward[2] + ALIKE else onward
        return Followed(self.scan, *best, cut=True) if best[2] >= SURE else None


def share_failing(track: Track) -> float:
    """Compute the share of the scans that show walls, but hardly match what was seen before."""
    return float((track.shares < POOR).mean())


def _square(pose: Array, guess: Array, information: Array) -> float:
    """The chi-square of a pose, (3,), by a guess with this inverse covariance, (3, 3)."""
    off = errors_of(pose, guess)
    return float(off @ information @ off)


def _accumulating(information: Array, prior: Array) -> Array:
    """The covariance that one step adds to the error of the track in the long run, (3, 3).

    In directions in which no wall shows the position, the error of the odometer accumulates fully.
    In the other directions, a pose is measured against the mean of the n previous scans. So an
    error shifts later poses by only 2 / (n + 1) of itself. `information` is the (3, 3) inverse
    covariance of the pose by odometer and walls, and `prior` that by the odometer alone.
    """
    posterior = np.linalg.inv(information)
    by_odometer = posterior @ prior
    by_walls = posterior @ (information - prior) @ posterior
    return np.asarray(
        by_odometer @ np.linalg.inv(prior) @ by_odometer.T + 2 / (RECENT + 1) * by_walls
    )


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Points on smooth surfaces."""

    points: Array  # (m, 2) metres
    normals: Array  # (m, 2) unit normals
    lengths: Array  # (m,) length in metres of the line that shows the normal

    def __len__(self) -> int:
        """The number of points."""
        return len(self.points)

    def moved(self, pose: Pose | Array) -> Surfaces:
        """Transform to the frame that a pose is given in, from the frame of the pose."""
        points, normals = points_moved(pose, self.points), points_turned(pose[2], self.normals)
        return Surfaces(points, normals, self.lengths)

    def some(self, most: int) -> Surfaces:
        """Take at most this many points, evenly spread."""
        kept = np.unique(np.linspace(0, len(self) - 1, min(len(self), most)).astype(int))
        return Surfaces(self.points[kept], self.normals[kept], self.lengths[kept])

    @staticmethod
    def joined(several: Iterable[Surfaces]) -> Surfaces:
        """Make one of several."""
        parts = [(one.points, one.normals, one.lengths) for one in several]
        return Surfaces(*map(np.concatenate, zip(*parts, strict=True)))


def surfaces_in(scan: Scan, without: NDArray[np.bool_] | None = None) -> Surfaces:
    """Find the smooth surfaces that a scan shows, in the frame of the robot.

    The beams of the mask `without`, (beams,), are left out.
    """
    laser, ranges, good = scan.laser, scan.ranges, in_sight(scan)
    r = np.where(good, ranges, 0.0)
    points = np.stack([r * np.cos(laser.bearings), r * np.sin(laser.bearings)], axis=1)
    normals, lengths = np.full(points.shape, np.nan), np.zeros(len(points))
    # The farthest neighbours that still lie on one line with the point give the best normal.
    for k in (1, 2, 3):
        if len(points) <= 2 * k:
            break
        middle = slice(k, len(points) - k)
        line = points[2 * k :] - points[: -2 * k]
        length = np.hypot(*line.T)
        normal = np.stack([-line[:, 1], line[:, 0]], axis=1) / np.maximum(length, 1e-9)[:, None]
        off = np.abs(products(points[middle] - points[: -2 * k], normal))
        smooth = (
            good[2 * k :]
            & good[: -2 * k]
            & good[middle]
            & (length > 1e-6)
            & (length < 0.25 + 0.1 * r[middle])
            & (off < ROUGHNESS)
        )
        normals[middle][smooth], lengths[middle][smooth] = normal[smooth], length[smooth]
    on_surface = good & np.isfinite(normals[:, 0])
    if without is not None:
        on_surface &= ~without
    some = on_surface.nonzero()
    return Surfaces(points[some], normals[some], lengths[some]).moved(laser.mount)


def in_sight(scan: Scan) -> NDArray[np.bool_]:
    """Mask of the beams that meet something near enough to be matched, (beams,)."""
    return np.asarray(np.isfinite(scan.ranges) & (scan.ranges < min(FARTHEST, scan.laser.reach)))


def products(first: Array, second: Array) -> Array:
    """The scalar products of vectors, (n, 2) each: (n,). A sum over an axis is slower."""
    return np.asarray(first[:, 0] * second[:, 0] + first[:, 1] * second[:, 1])


@dataclass(frozen=True, eq=False)
class ScanFit:
    """Moves a scan until its points lie on walls.

    The scan is in the frame of the robot, and the walls are in the frame of the track.
    """

    scan: Surfaces
    walls: Surfaces

    @cached_property
    def tree(self) -> cKDTree:
        """The walls. These settings build the tree faster, and queries take no longer."""
        return cKDTree(self.walls.points, compact_nodes=False, balanced_tree=False)

    def improved(self, guess: Array, weight: Array, led: bool = True) -> tuple[float, Array, Array]:
        """Move a pose until the points lie on the walls, by Gauss-Newton steps.

        `weight` is the (3, 3) inverse covariance of the guess, and `led` whether odometry made it.
        Returns the share of the points on walls, the pose, and its inverse covariance.
        """
        information, pose, share, far = weight, guess, 0.0, BEGIN
        for _ in range(ROUNDS):
            placed, met, distance, nearest = self._met(pose, far)
            share = float((distance[met] < END).sum() / len(placed))
            if len(met) < 5:
                break
            wall = nearest[met]
            normal = self.walls.normals[wall]
            apart = placed[met] - self.walls.points[wall]
            off = products(apart, normal)
            along = normal[:, ::-1] * (1, -1)
            jacobian = np.column_stack([normal, products(placed[met] - pose[:2], along)])
            # Cauchy weights give little influence to points that are far off.
            weights = 1 / (TOGETHER * ROUGHNESS**2 * (1 + (off / (2 * ROUGHNESS)) ** 2))
            # A normal is as uncertain as the ends of its line. So it says little about points far
            # along the wall, as beyond its seen end. At first, points are far from their place.
            if led and far <= END:
                weights /= 1 + 2 * (products(apart, along) / self.walls.lengths[wall]) ** 2
            astray = pose - guess
            astray[2] = wrapped(astray[2])
            information = jacobian.T @ (jacobian * weights[:, None]) + weight
            step = np.linalg.solve(information, jacobian.T @ (weights * off) + weight @ astray)
            pose = pose - step
            is_still = np.abs(step).max() < 1e-4
            if is_still and (far <= END or not led):
                break
            far = END if is_still else max(END, far * SHRINK)
        return share, pose, information

    def share(self, pose: Array) -> float:
        """Compute the share of the points that lie on walls, with the scan at a pose."""
        placed, met, *_ = self._met(pose, END)
        return len(met) / len(placed)

    def _met(
        self, pose: Array, far: float
    ) -> tuple[Array, NDArray[np.intp], Array, NDArray[np.intp]]:
        """Find the walls that the points of the scan at a pose meet within `far` metres.

        Returns the points in the frame of the track; the indices of those that meet walls that face
        as they do; and for each point, the distance and the index of its nearest wall.
        """
        placed = points_moved(pose, self.scan.points)
        distance, nearest = self.tree.query(placed, distance_upper_bound=far)
        met = np.flatnonzero(np.isfinite(distance))
        facing = points_turned(pose[2], self.scan.normals[met])
        alike = products(facing, self.walls.normals[nearest[met]])
        return placed, met[np.abs(alike) > 0.8], distance, nearest


def contradicting_scans(log: RobotLog, track: Track) -> list[int]:
    """Find the scans that match badly and contradict the scans before them."""
    rare = float(np.nanpercentile(track.shares, RARELY)) - WORSE
    return [
        i
        for i, share in _intruding_shares(log, track).items()
        if share > (INTRUDING_RARELY if track.shares[i] < rare else INTRUDING)
    ]


def scans_after_a_carry(log: RobotLog, track: Track) -> list[int]:
    """Find the scans to which the robot was carried, although the odometer does not jump.

    Of contradicting scans near each other, the one that contradicts most is listed.
    """
    shares = _intruding_shares(log, track)
    return [
        i
        for i, share in shares.items()
        if share > INTRUDING
        and (share, -i) == max((shares.get(k, 0.0), -k) for k in range(i - BESIDE, i + BESIDE + 1))
    ]


def _intruding_shares(log: RobotLog, track: Track) -> dict[int, float]:
    """For each scan that matches badly, the share of points that intrude on either side."""
    found: dict[int, float] = {}
    # A scan without a share meets no wall, or the laser is covered.
    seeing, seconds = ~np.isnan(track.shares), seconds_between(log)
    for i in np.flatnonzero(track.shares < POORLY).tolist():
        before = [k for k in range(max(0, i - BESIDE), i) if seeing[k]]
        after = [k for k in range(i, min(len(log), i + BESIDE)) if seeing[k]]
        near = slice(max(0, i - BESIDE), i + BESIDE - 1)
        is_slow = seconds is None or seconds[near].max() >= CARRYING
        if before and is_slow and not track.cuts_between(i - BESIDE, i + BESIDE - 1):
            # If the next scans do not contradict, this scan alone was matched wrongly.
            found[i] = min(
                _intruding_share(log, track, before, some) for some in (after, after[1:]) if some
            )
    return found


def _intruding_share(log: RobotLog, track: Track, before: list[int], after: list[int]) -> float:
    """The share of the points of either scans that intrude on the others; 0 for few points."""
    sides = ([(log.scans[k], track.pose(k)) for k in some] for some in (before, after))
    inside, seen = _clashes(*sides)
    return inside / seen if seen >= FEW_POINTS * 2 * len(before) * len(after) else 0.0


def _clashes(some: Sequence[_Posed], others: Sequence[_Posed]) -> tuple[int, int]:
    """Count the points of either scans in the free space of the others, and those in their view."""
    inside = seen = 0
    for one, other in product(some, others):
        for masks in (_in_free_space(*one, *other), _in_free_space(*other, *one)):
            inside, seen = inside + int(masks[0].sum()), seen + int(masks[1].sum())
    return inside, seen


def _in_free_space(
    scan: Scan, pose: Pose, other: Scan, its: Pose
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Masks of the beams of a scan that end in the free space of another scan, and in its view.

    The poses are those of the robot at the two scans. The masks are (beams,).
    """
    laser = other.laser
    x, y, heading = displacement_between(moved(its, laser.mount), moved(pose, scan.laser.mount))
    met = np.isfinite(scan.ranges) & (scan.ranges > 0)
    angles = scan.laser.bearings[met] + heading
    points = scan.ranges[met] * np.exp(1j * angles) + complex(x, y)
    onward = math.copysign(1.0, laser.step)
    beam = np.rint(onward * (np.angle(points) - laser.first) % math.tau / abs(laser.step))
    beam = beam.astype(int)
    seen = (beam >= 1) & (beam < len(other.ranges) - 1)
    beam, far = beam[seen], np.abs(points[seen])
    ranges = np.where(np.isposinf(other.ranges), laser.reach, other.ranges)
    ranges[np.isnan(ranges)] = 0.0
    # The nearest and the farthest range of each beam and its two neighbours.
    around = ranges[[beam - 1, beam, beam + 1]]
    free, wall = around.min(axis=0), around.max(axis=0)
    margin = MARGIN + MARGIN / 8 * far
    inside, in_view = np.zeros((2, len(met)), bool)
    inside[np.flatnonzero(met)[seen]] = far < free - margin
    in_view[np.flatnonzero(met)[seen]] = far < wall + MARGIN
    return inside, in_view
