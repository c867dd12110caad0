"""Follows the robot from scan to scan: odometry, corrected by matching each scan with recent ones.

Points are matched with lines (Chen & Medioni 1992; Censi 2008): the pose moves until the points of
the scan lie on the walls that the last scans saw. Odometry is a prior. In a bare corridor, walls do
not show how far the robot went, so the odometer decides. An increment is the motion from one scan
to the next. There is no global map, so errors of increments accumulate along the trajectory. Each
increment has a covariance.

If the odometer jumps (`jumps`), the scan is matched near the previous pose without odometry. If it
matches, the track goes on, and only the increment is unknown: this is a cut. If nothing in the scan
was seen before, the robot may be anywhere. Then the track is broken, and a new trajectory begins.
"""

from __future__ import annotations

import math
from array import array
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from perception.places.contradictions import scans_after_a_carry
from perception.places.jumps import Doubt, Unknown, is_missing, unknown_steps
from perception.places.track import (
    Array,
    Track,
    covariance_turned,
    odometer_covariance,
    points_turned,
    wrapped,
)
from perception.places.walls import FEW_POINTS, ScanFit, Surfaces, in_sight, surfaces_in
from perception.readers.scans import RobotLog, Scan
from perception.readers.stored import in_turn
from ssh_abduction.data.odometry import Pose, displacement_between, moved

# Number of previous scans to match a scan with.
RECENT = 40
# Largest number of points of a scan to match, evenly spread. It bounds the time for a scan.
POINTS = 150
# A match is poor if less than the share POOR of the points lies on walls. Then HEADINGS headings
# are tried, because odometers miss turns, and logs miss lines.
POOR, HEADINGS = 0.5, 24
# Matching fails in at most 1.5 % of the scans of good logs.
FAILING = 0.05
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
# Numbers that a growing track keeps for each scan: pose, covariance and share.
ROW = 3 + 9 + 1


def follow(log: RobotLog) -> Track:
    """Compute the trajectory of a robot from its log, by odometry and scan matching.

    Corrected poses are not read.
    """
    steps = unknown_steps(log)
    track = _track_of(log, steps)
    # People or an arm of the robot can change what the laser sees while the robot stands.
    standing = frozenset(
        k
        for first, last in steps.still
        if _stands(log, track, first, last)
        for k in range(first, last + 1)
    )
    if standing:
        steps = steps.without(standing)
        track = _track_of(log, steps)
    # If matching fails in much of the log, contradictions do not show that the robot was carried.
    if share_failing(track) <= FAILING and (more := scans_after_a_carry(log, track)):
        track = _track_of(log, replace(steps, carried=steps.carried.union(more)))
    return track


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
            pose, _, share = _matched(seen, known, track.pose(first - 1), onward, wide)
            turns.append(abs(wrapped(pose[2] - track.poses[first - 1, 2] - onward[2])))
            shares.append(share)
    if not shares:  # the laser sees nothing
        return True
    return float(np.median(shares)) >= (SURE if np.median(turns) <= HELD else WELL)


def _track_of(log: RobotLog, steps: Unknown) -> Track:
    """Make the track, which is broken before each scan to which the robot was carried."""
    done = GrowingTrack()
    for one in poses_of_scans(in_turn(log.scans), lambda i, _: steps.doubt_of(i)):
        done.add(one)
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


class GrowingTrack:
    """A track to which scans are added. Each needs about 100 bytes."""

    def __init__(self) -> None:
        self.cuts: list[int] = []  # indices of the scans before which the motion is unknown, so far
        self._breaks: list[int] = []
        self._rows = array("d")  # pose, covariance and share of each scan

    def __len__(self) -> int:
        """The number of scans."""
        return len(self._rows) // ROW

    def add(self, one: Followed) -> None:
        """Add the next scan."""
        self.cuts += [len(self)] if one.cut else []
        self._breaks += [len(self)] if one.broken else []
        self._rows.extend((*one.pose, *one.covariance.ravel(), one.share))

    @property
    def track(self) -> Track:
        """The track up to the last scan. It is not copied: while it is in use, add no scan."""
        rows = np.asarray(self._rows).reshape(-1, ROW)
        covariances, shares = rows[:, 3:12].reshape(-1, 3, 3), rows[:, 12]
        return Track(rows[:, :3], covariances, shares, tuple(self.cuts), tuple(self._breaks))


def poses_of_scans(
    scans: Iterable[Scan], doubt_of: Callable[[int, Pose], Doubt]
) -> Iterator[Followed]:
    """Compute the pose of each scan from the scans before it, and yield it before the next is read.

    `doubt_of` takes the index of a scan and the motion from the previous scan by odometry. It says
    how far this motion can be trusted.
    """
    recent: deque[Surfaces] = deque(maxlen=RECENT)
    last: Followed | None = None
    before: Pose = (0.0, 0.0, 0.0)
    for i, scan in enumerate(scans):
        seen = surfaces_in(scan)
        if last is None:
            one = Followed(scan, (0.0, 0.0, 0.0))
        else:
            onward = displacement_between(last.scan.odometry, scan.odometry)
            step = _ScanMotion(scan, seen, recent, last.pose, onward, before)
            one = step.judged(doubt_of(i, onward))
            one = one if in_sight(scan).any() else replace(one, share=math.nan)
            before = displacement_between(last.pose, one.pose)
        if one.broken:
            recent.clear()
        # Walls are remembered while the laser sees none.
        if len(seen) or not recent:
            recent.append(seen.moved(one.pose))
        last = one
        yield one


@dataclass(frozen=True, eq=False)
class _ScanMotion:
    """A motion from one scan to the next."""

    scan: Scan  # the next scan
    seen: Surfaces  # the surfaces that it shows
    recent: deque[Surfaces]  # the surfaces in previous scans, in the frame of the track
    last: Pose  # pose of the previous scan
    onward: Pose  # the motion by odometry
    before: Pose  # the motion to the previous scan

    def judged(self, doubt: Doubt) -> Followed:
        """Match the scan: with the odometry if it can be trusted, otherwise without."""
        still = odometer_covariance((0.0, 0.0, 0.0))
        nowhere = Followed(self.scan, self.last, still, 0.0, True, True)
        if doubt is Doubt.CARRIED:
            return nowhere
        if doubt is Doubt.UNKNOWN:
            return self._without_odometry() or nowhere
        prior = odometer_covariance(self.onward)
        # An odometer that misses a large turn stands still. In corridors, scans that hardly
        # overlap match as well if they are turned around.
        most = TURNED if any(self.onward) else math.pi
        found = _matched(self.seen, self.recent, self.last, self.onward, prior, most)
        if found[2] < POOR and doubt in (Doubt.DOUBTFUL, Doubt.SEAM):
            if other := self._without_odometry():
                return other
            if doubt is Doubt.SEAM:
                return nowhere
        return Followed(self.scan, *found)

    def _without_odometry(self) -> Followed | None:
        """Match the scan without odometry; None if it does not match.

        Two guesses are tried: the robot moved as it did before, or it stood still.
        """
        wide = np.diag(UNKNOWN) ** 2
        onward, stayed = (
            _matched(self.seen, self.recent, self.last, guess, wide)
            for guess in (self.before, (0.0, 0.0, 0.0))
        )
        best = stayed if stayed[2] > onward[2] + ALIKE else onward
        return Followed(self.scan, *best, cut=True) if best[2] >= SURE else None


def share_failing(track: Track) -> float:
    """Compute the share of the scans that show walls, but hardly match what was seen before."""
    return float((track.shares < POOR).mean())


def turned_wrongly(log: RobotLog, track: Track) -> list[tuple[int, float]]:
    """List scans that match well but turned differently from the odometry, by how many radians.

    Without odometry, there is none.
    """
    found: list[tuple[int, float]] = []
    for i in range(1, len(log)) if not is_missing(log) else ():
        measured = displacement_between(log.scans[i - 1].odometry, log.scans[i].odometry)[2]
        off = wrapped(float(track.poses[i, 2] - track.poses[i - 1, 2]) - measured)
        if abs(off) > TURNED and track.shares[i] >= POOR and i not in track.cuts:
            found.append((i, off))
    return found


def _matched(
    seen: Surfaces,
    recent: Iterable[Surfaces],
    last: Pose,
    onward: Pose,
    prior: Array,
    most: float = math.pi,
) -> tuple[Pose, Array, float]:
    """Match a scan with the walls that previous scans saw.

    `onward` is the expected motion since the previous scan, `prior` its (3, 3) covariance. The
    heading differs by at most `most` radians. Returns the pose; the covariance of the motion, in
    the frame of the robot at the previous scan; and the share of the points on walls.
    """
    walls = Surfaces.joined(recent)
    guess: Array = np.array(moved(last, onward))
    weight: Array = np.asarray(np.linalg.inv(covariance_turned(last[2], prior)), np.float64)
    pose, information, share = guess, weight, 0.0
    if len(walls) and len(seen):
        fit = ScanFit(seen.some(POINTS), walls)
        share, pose, information = fit.improved(guess, weight)
        # A poor match may have a wrong heading: try others.
        if share < POOR and len(seen) >= FEW_POINTS:
            turns = (wrapped(2 * math.pi * k / HEADINGS) for k in range(HEADINGS))
            turned = [guess + np.array([0, 0, turn]) for turn in turns if abs(turn) <= most]
            best = max(
                (fit.improved(other, weight) for other in turned), key=lambda found: found[0]
            )
            if best[0] > 1.5 * share:
                share, pose, information = best
    covariance = covariance_turned(-last[2], _accumulating(information, weight))
    off = pose - guess
    astray = np.array([*points_turned(-last[2], off[:2]), wrapped(float(off[2]))])
    if share < CLEAR and astray @ np.linalg.solve(prior, astray) > CONTRARY:
        covariance += np.diag(astray**2)
    return (float(pose[0]), float(pose[1]), wrapped(float(pose[2]))), covariance, share


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
