"""Judges the odometry of a log: finds jumps, and compares it with scan matching.

Scan matching corrects an odometer that drifts by some percent. If the trajectories differ by more,
one of these was read wrongly: the field of view, the position of the laser on the robot, the range
that means "nothing came back", or the odometer. The kind of difference shows which.

Both trajectories are cut into stretches of about a metre. The motion along a stretch is a complex
number in the frame of the robot at its beginning. A least-squares fit finds the complex factor that
maps motions by odometry to motions by scans. Its angle is the difference in direction.

Scan matching starts from the odometry. So in a corridor it hardly notices if the direction of the
laser is wrong. Pairs of scans show it better: if the second scan is moved by the odometry, its
points coincide with those of the first only if the direction is right. The field of view is tested
likewise.
"""

from __future__ import annotations

import cmath
import math
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import replace
from enum import Enum
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from perception.places.track import Array, Track, wrapped
from perception.readers.bags import TimedPoses, gaps_of, sources_of
from perception.readers.echoes import moving
from perception.readers.scans import RobotLog, Scan
from ssh_abduction.data.odometry import Pose, displacement_between
from ssh_abduction.data.words import counted

# A step between two scans is impossible if it is longer than both FAR metres and UNUSUAL times the
# usual step. It is doubtful if it is longer than half of that.
FAR, UNUSUAL = 1.5, 3.5
# A scan matches nothing if less than this share of its points lies on walls seen before. After a
# step of more than FAR metres, ten good logs have 0.32 or more.
UNMATCHED = 0.1
# After a pause of PAUSE times the usual interval, the robot may have driven on at up to FASTER
# times its usual speed.
PAUSE, FASTER = 3.0, 2.0
# Odometry stands still if it changes by less than STILL metres and radians. A beam changed if its
# range differs by more than CHANGED metres plus CHANGED_SHARE of the range. The robot moved if more
# than the share MOVED of the beams changed.
STILL, MOVED, CHANGED, CHANGED_SHARE = 1e-3, 0.35, 0.2, 0.03
# After a pause, this smaller share of changed beams shows a motion, because the robot may be far
# away in a corridor that looks similar.
MOVED_UNSEEN = 0.15
# Odometry that stands still in more than this share of the steps is missing.
MISSING = 0.5
# A clock starts anew if it goes back by more than ANEW_CLOCK seconds or on by more than a DAY, at
# most SEAMS times in a log.
ANEW_CLOCK, DAY, SEAMS = 60.0, 86400.0, 3
# A log is out of order if the times of more than this share of its scans run backwards.
RUNS_BACK = 0.05
# Sources are not told apart in fewer scans: if scans are far apart, a robot that drives to and fro
# looks like two sources. Of 1,534 such logs (drives with only each k-th scan, k up to 59), that
# holds for 25 logs of up to 19 scans.
LEAST_SCANS = 30
# While a robot drives, the usual length of a step is the median of this many earlier steps.
LATELY = 100
# Limit of ranges in metres, for comparing scans.
NO_RANGE = 25.0
# A step to within this many metres of the origin means that the odometer restarted.
ANEW = 1.0
# Seconds by which scans may be late. Turns between scans that differ by more than CAPPED radians
# count as CAPPED. A lag of at least LEAST_LAG seconds is found if turns then differ by CLEARLY
# times as much, and by LEAST_GAIN radians less in the mean.
LAGS, CAPPED = np.arange(-60, 61) * 0.05, 0.3
LEAST_LAG, CLEARLY, LEAST_GAIN = 0.15, 0.6, 0.005
TWO_DRIVES = (
    " Local maps that match may connect what lies before and after. If a drive through another "
    "building begins there, cut the log there, and map each part alone."
)


def keep_one_source(log: RobotLog) -> tuple[RobotLog, list[str]]:
    """Keep the odometry of one source if the poses of several sources alternate.

    The odometry of the other scans is interpolated. Also return a note about this, if any.
    """
    if len(log) < LEAST_SCANS:
        return log, []
    sources = sources_of(log.odometry)
    # Scans that are out of order look like poses of several sources.
    if len(sources) == 1 or times_back(log) > RUNS_BACK * len(log):
        return log, []
    said = (
        f"The poses of several sources alternate in the odometry, {len(sources[0])} and "
        f"{len(sources[1])} of {len(log)}. The source of more poses is used. If the other one is "
        "better, stop the source that was used, and record again."
    )
    poses = log.odometry[sources[0]]
    poses[:, 2] = np.unwrap(poses[:, 2])
    kept = TimedPoses(sources[0].astype(float), poses)
    scans = (replace(scan, odometry=kept.at(k)) for k, scan in enumerate(log.scans))
    return replace(log, scans=tuple(scans)), [said]


def lag_of(log: RobotLog, track: Track) -> float:
    """Estimate by how many seconds the scans are stamped late, from the turns of the track.

    The turns from scan to scan agree best with those of the odometer at times that are earlier by
    the lag. The result is 0 if that is hardly better than no lag, or the odometer has no times.
    """
    if log.odometer is None or any(scan.time is None for scan in log.scans) or len(log) < 2:
        return 0.0
    at, headings = log.odometer[0], log.odometer[1][:, 2]
    times = np.array([scan.time for scan in log.scans], dtype=float)
    # Only keyframes are matched. In between, the track follows the odometry.
    keys = np.flatnonzero(track.covariances.any(axis=(1, 2)))
    times, turns = times[keys], np.diff(track.poses[keys, 2])

    def off(lag: float) -> float:
        measured = np.diff(np.interp(times - lag, at, headings))
        apart = np.abs((turns - measured + math.pi) % math.tau - math.pi)
        return float(np.minimum(apart, CAPPED).mean())

    offs = [off(lag) for lag in LAGS]
    best, now = int(np.argmin(offs)), off(0.0)
    is_clear = offs[best] < CLEARLY * now and now - offs[best] > LEAST_GAIN
    return float(LAGS[best]) if is_clear and abs(LAGS[best]) >= LEAST_LAG else 0.0


def with_lag(log: RobotLog, lag: float) -> RobotLog:
    """Copy a log with its own odometer, read `lag` seconds before the stamp of each scan."""
    assert log.odometer is not None
    odometer = TimedPoses(*log.odometer)
    scans = (replace(scan, odometry=odometer.at((scan.time or 0.0) - lag)) for scan in log.scans)
    return replace(log, scans=tuple(scans))


def describe_lag(lag: float) -> str:
    """Say in a note that the scans are late, or early if the lag is negative."""
    late, then = ("late", "earlier") if lag > 0 else ("early", "later")
    return (
        f"The scans are stamped {abs(lag):.2f} s too {late}: their turns agree with those of the "
        f"odometry so much {then}. So the odometry is read {then} by this. Mend the stamps of "
        "the laser or the odometer."
    )


def times_back(log: RobotLog) -> int:
    """Count the scans whose time is before that of the scan before them."""
    times = np.array([scan.time for scan in log.scans if scan.time is not None])
    return int((np.diff(times) < 0).sum())


def seams_of(log: RobotLog) -> list[tuple[int, str]]:
    """Find the scans at which a second drive seems to begin, and say what changes there.

    The laser changes for good, or the clock is reset.
    """
    lasers = pairwise((s.laser.first, s.laser.step, s.laser.mount) for s in log.scans)
    other = [i for i, (last, laser) in enumerate(lasers, 1) if laser != last]
    seams = {i: "The laser changes" for i in other if len(other) == 1}
    times = pairwise(scan.time for scan in log.scans)
    steps = [0.0 if last is None or time is None else time - last for last, time in times]
    # A single wrong time is followed by a step back to the clock.
    resets = [i for i, step in enumerate(steps, 1) if not -ANEW_CLOCK <= step <= DAY]
    if len(resets) <= SEAMS and all(later - first > 1 for first, later in pairwise(resets)):
        seams |= {i: "The clock starts anew" for i in resets if i not in seams}
    return sorted(seams.items())


def is_missing(log: RobotLog) -> bool:
    """Whether the odometry stands still in most steps from scan to scan of one laser.

    Two lasers may scan at one time.
    """
    mount = log.scans[0].laser.mount
    one = replace(log, scans=tuple(scan for scan in log.scans if scan.laser.mount == mount))
    return bool(len(one) > 1 and stands_still(one).mean() > MISSING)


def goes_back_and_forth(log: RobotLog) -> float:
    """Compare the length by odometry over every second scan with that over all scans.

    The ratio is about 1 for a drive, 0 for poses of two sources; 1 for less than three scans.
    """
    if len(log) < 3:
        return 1.0
    return float(_far(log, 2).mean() / max(2 * _far(log, 1).mean(), 1e-9))


def usual_step(log: RobotLog) -> float:
    """Compute the median step between two scans by odometry, in metres.

    Steps of 0 are ignored. The result is 0 if all steps are 0.
    """
    far = _far(log, 1)
    return float(np.median(far[far > 0])) if (far > 0).any() else 0.0


def describe_cuts(log: RobotLog, track: Track, turned: list[tuple[int, float]]) -> list[str]:
    """Say in notes where the odometry of a log is wrong: at cuts, breaks and some turns.

    At a *cut* the odometer jumped or hung, so the motion from one scan to the next is unknown.
    At a *break* the scans do not fit those before them: the robot may have been carried. `turned`
    has the indices of scans at which the robot turned differently from the odometry, and the
    differences in radians. There is a note for each kind of error.
    """
    # At a cut after a long step, the odometer jumped. After none, it stood still while the robot
    # moved. At the end of a usual step, only the scans show that the robot was carried.
    far = dict(enumerate(_far(log, 1).tolist(), 1))
    jumps = [cut for cut in track.cuts if far[cut] > FAR / 2]
    still = [cut for cut in track.cuts if far[cut] <= STILL and cut not in track.breaks]
    notes = []
    if jumps:
        notes.append(_describe_jumps(log, jumps, far))
    if still:
        notes.append(
            f"The odometry stands still in {counted(len(still), 'steps')}, from scan {still[0]} "
            f"({_where(log, still[0])}) on, while the scans show that the robot moved: it was "
            "carried, or the odometer hung. The trace has no displacement across."
        )
    if track.breaks:
        notes.append(
            f"The scans do not fit those before them, {times(len(track.breaks))}: from scan "
            f"{track.breaks[0]} ({_where(log, track.breaks[0])}) on. The robot may have been "
            "carried there, or another drive begins. The rest is mapped as a separate drive."
        )
    if gaps := _gaps(log, track):
        first = gaps[0]
        notes.append(
            f"The scans show nothing of what was seen before, {times(len(gaps))}, while the "
            f"odometry goes on: by {far[first]:.1f} m before scan {first} ({_where(log, first)}). "
            "The odometry alone connects the parts. If scans are missing there, or the robot was "
            "carried, cut the log there, and map each part."
        )
    if turned:
        first, angle = turned[0]
        notes.append(
            f"Scans turn differently from the odometry, {times(len(turned))}: at scan {first} "
            f"({_where(log, first)}) by {abs(math.degrees(angle)):.0f} degrees. The track follows "
            "the scans. If the robot was carried there, cut the log there, and map each part."
        )
    return notes


def _describe_jumps(log: RobotLog, jumps: list[int], far: Mapping[int, float]) -> str:
    """Say in a note that the odometer jumped at some cuts, and how far (metres)."""
    first, most = jumps[0], max(jumps, key=far.__getitem__)
    starts_anew = math.hypot(*log.scans[first].odometry[:2]) < ANEW
    return (
        f"The odometry jumps {times(len(jumps))} in {len(log)} scans: by {far[first]:.1f} m "
        f"before scan {first} ({_where(log, first)})"
        + (", where it starts anew from 0" if starts_anew else "")
        + (f", and by {far[most]:.1f} m at most" if len(jumps) > 1 else "")
        + ". Nothing is known of how the robot moved there, so the trace has no displacement "
        "across. An odometer that is started anew, or a second program that publishes the same "
        "odometry, jumps like this. So does a log that is not in the order of the drive."
        + (TWO_DRIVES if starts_anew or len(jumps) == 1 else "")
    )


def _gaps(log: RobotLog, track: Track) -> list[int]:
    """Find the scans after a long step that match nothing, though the odometry is trusted."""
    far = _targets(_far(log, 1) > FAR).difference(track.cuts)
    return sorted(i for i in far if track.shares[i] < UNMATCHED)


def times(count: int) -> str:
    """Say how often something is the case: "once", "3 times"."""
    return "once" if count == 1 else f"{count} times"


def _where(log: RobotLog, number: int) -> str:
    """The position of a scan in its log, for a note."""
    scan = log.scans[number]
    time = "" if scan.time is None else f", {scan.time:.1f} s"
    return f"line or message {scan.line}{time}"


class Doubt(Enum):
    """How far the odometry of a step can be trusted. The value of each member explains it."""

    NONE = "as usual"
    SEAM = "a drive seems to begin: the step is unknown unless the scan matches at its end"
    DOUBTFUL = "the step is long: it is a jump if the scan matches only near the previous pose"
    UNKNOWN = "the odometer jumped, or missed a motion"
    MISSING = "the odometer does not show this step: it has a gap, or stands still in most steps"
    CARRIED = "the robot was carried while nothing was logged"


class LiveJumps:
    """Judges each step by those before it, while a robot drives.

    A step is a jump by the same measure as in `doubts_of`. The usual step is the median of the
    last LATELY steps. Clocks are not read.
    """

    def __init__(self) -> None:
        self._steps: deque[float] = deque(maxlen=LATELY)
        self._count = self._still = 0  # steps so far, and those in which the odometer stands still

    def __call__(self, scan: int, onward: Pose) -> Doubt:
        """Judge the step to the scan with this index, from its motion in metres and radians."""
        far, stands = math.hypot(*onward[:2]), max(map(abs, onward)) < STILL
        self._count, self._still = self._count + 1, self._still + stands
        if stands and self._still > MISSING * self._count:
            return Doubt.MISSING
        usual = float(np.median(self._steps)) if self._steps else 0.0
        least = max(FAR, UNUSUAL * usual)
        if far > 0:
            self._steps.append(far)
        if far > least:
            return Doubt.UNKNOWN
        return Doubt.DOUBTFUL if far > least / 2 else Doubt.NONE


def doubts_of(log: RobotLog) -> tuple[dict[int, Doubt], list[tuple[int, int]]]:
    """Find the scans for which the odometry of the step before them cannot be trusted.

    Return the doubt of each by its index, and the first and last scan of each stretch in which the
    odometer stands still, though the scans change.
    """
    if len(log) < 3:
        return {}, []
    seconds = seconds_between(log)
    paused = (
        np.zeros(len(log) - 1, bool) if seconds is None else seconds > PAUSE * np.median(seconds)
    )
    jumped, doubtful = _impossible(log, seconds, paused)
    carried, still = _moved_while_still(log, paused)
    # After a long step in a pause, the odometer may have restarted.
    far, anew = _far(log, 1), np.hypot(*log.odometry[1:, :2].T) < ANEW
    restarted = _targets(paused & anew & (far > FAR / 2) & ~jumped)
    moved = {k for first, last in still for k in range(first, last + 1)}
    doubts: dict[int, Doubt] = {}
    # The last doubt about a step counts.
    for scans, doubt in (
        (_targets(stands_still(log)) if is_missing(log) else (), Doubt.MISSING),
        (unmeasured(log), Doubt.MISSING),
        (_targets(doubtful), Doubt.DOUBTFUL),
        (restarted.union(scan for scan, _ in seams_of(log)), Doubt.SEAM),
        (_targets(jumped) | moved, Doubt.UNKNOWN),
        (carried, Doubt.CARRIED),
    ):
        doubts |= dict.fromkeys(scans, doubt)
    return doubts, still


def unmeasured(log: RobotLog) -> set[int]:
    """Find the scans that come in a gap of the odometry, or next after it."""
    if log.odometer is None or any(scan.time is None for scan in log.scans):
        return set()
    times, at = log.odometer[0], [scan.time or 0.0 for scan in log.scans]
    gaps = [(times[i], times[i + 1]) for i in gaps_of(*log.odometer)]
    steps = enumerate(pairwise(at), 1)
    return {k for k, (t, then) in steps if any(t < end and then > begin for begin, end in gaps)}


def _targets(steps: NDArray[np.bool_]) -> set[int]:
    """The indices of the scans that the marked steps, (n - 1,), lead to."""
    return set((np.flatnonzero(steps) + 1).tolist())


def _impossible(
    log: RobotLog, seconds: Array | None, paused: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Find impossible steps and doubtful ones, (n - 1,) masks. The doubtful include the impossible.

    A step is impossible if it is long in metres, longer than the usual step, and too long for the
    time that it took. `paused` is the mask of the steps that took unusually long.
    """
    far, over_two = _far(log, 1), _far(log, 2)
    if not far.any():
        return np.zeros(len(far), bool), np.zeros(len(far), bool)
    # If the poses of two sources alternate, each step is a jump, but steps to the scan after the
    # next are not.
    usual = min(
        float(np.median(steps[steps > 0])) for steps in (far, over_two) if (steps > 0).any()
    )
    least = max(FAR, UNUSUAL * usual)
    jumped, doubtful = far > least, far > least / 2
    if seconds is not None and paused.any():
        timed = (seconds > 0) & ~jumped
        fastest = float(np.percentile(far[timed] / seconds[timed], 95)) if timed.any() else 0.0
        driven = paused & (far <= FASTER * fastest * seconds)
        jumped, doubtful = jumped & ~driven, doubtful & ~driven
    return jumped, doubtful


def _moved_while_still(
    log: RobotLog, paused: NDArray[np.bool_]
) -> tuple[set[int], list[tuple[int, int]]]:
    """Find stretches in which the odometer stands still, but the laser shows a motion.

    Returns the scans before which there was a pause and somebody moved the robot; and the first and
    last scan of each such stretch. Both are empty if the odometer mostly stands still, because then
    there is no odometry.
    """
    still = stands_still(log)
    if is_missing(log):
        return set(), []
    carried, found = set[int](), list[tuple[int, int]]()
    # Each stretch of standing still begins and ends at an edge of the mask.
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still, [0]])))
    for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        if any(shows_motion(log.scans[begin], log.scans[k]) for k in range(begin + 1, end + 1)):
            found.append((begin + 1, end))
        carried |= {
            k
            for k in range(begin + 1, end + 1)
            if paused[k - 1] and change_between(log.scans[k - 1], log.scans[k]) > MOVED_UNSEEN
        }
    return carried, found


def stands_still(log: RobotLog) -> NDArray[np.bool_]:
    """Find the steps between n scans in which the odometer repeats a pose: mask, (n - 1,)."""
    return np.asarray(np.abs(np.diff(log.odometry, axis=0)).max(axis=1) < STILL)


def moves_unseen(log: RobotLog) -> bool:
    """Whether the robot moves while its odometer stands still, as the scans of a log show."""
    first: Scan | None = None  # of those at one pose
    for scan in log.scans:
        if first is None or np.abs(np.subtract(scan.odometry, first.odometry)).max() >= STILL:
            first = scan
        elif shows_motion(first, scan):
            return True
    return False


def shows_motion(first: Scan, last: Scan) -> bool:
    """Whether enough beams changed between two scans to show that the robot moved."""
    return change_between(first, last) > MOVED


def change_between(first: Scan, last: Scan) -> float:
    """The share of the beams that changed between two scans; 0 for lasers with different mounts.

    The share is of the beams that were measured in both scans and hit something in at least one.
    """
    if first.laser.mount != last.laser.mount:
        return 0.0
    # Unknown ranges stay NaN.
    before, after = (np.clip(scan.ranges, 0.0, NO_RANGE) for scan in (first, last))
    if first.laser != last.laser:  # Compare the nearest beams.
        at = (last.laser.bearings - first.laser.first) / first.laser.step
        beams = np.rint(at).astype(int)
        inside = (beams >= 0) & (beams < len(before))
        before, after = before[beams[inside]], after[inside]
    valid = ((before < NO_RANGE) | (after < NO_RANGE)) & (before > 0) & (after > 0)
    unlike = np.abs(before - after) > CHANGED + CHANGED_SHARE * np.minimum(before, after)
    return float(unlike[valid].mean()) if valid.any() else 0.0


def _far(log: RobotLog, steps: int) -> Array:
    """Distances in metres by odometry from each scan to the scan `steps` later, (n - steps,)."""
    positions = log.odometry[:, :2]
    return np.asarray(np.hypot(*(positions[steps:] - positions[:-steps]).T))


def seconds_between(log: RobotLog) -> Array | None:
    """Seconds from each scan to the next, (n - 1,).

    None if times are missing, run backwards, or are all equal.
    """
    if any(scan.time is None for scan in log.scans):
        return None
    seconds = np.diff(np.array([scan.time for scan in log.scans], dtype=float))
    return seconds if (seconds >= 0).all() and seconds.any() else None


# A stretch ends after this many metres or radians, by odometry.
STRETCH, BEND = 1.0, math.radians(30)
# Turns are compared over stretches that turn by at least this many radians, if there are at least
# LEAST_TURNS of them.
TURN, LEAST_TURNS = math.radians(15), 8
# Trajectories diverge in a stretch if their ends differ by more than this share of it plus this
# many metres.
PARTED, ASIDE = 0.25, 0.2
# In good logs, recorded and simulated, the trajectories differ by at most 4 % in length, 2 degrees
# in direction and 6 % in turns, and diverge in at most 3 % of the stretches. Matching can correct
# that. About twice as much is worth a warning.
LENGTH, ANGLE, TURNING, PARTING = 0.1, math.radians(10), 0.15, 0.05
# If the robot was pushed or slipped once, the trajectories diverge in fewer stretches than this.
LEAST_PARTED = 3
# Distance of the scans of a pair: at least the first number and less than the second, in metres
# (GAP) or radians (TURN_OF_PAIR).
GAP, TURN_OF_PAIR = (0.8, 2.4), (0.35, 1.2)
# Number of pairs to compare, and about how many points of the second scan of each pair.
PAIRS, POINTS = 40, 90
# Points coincide within MEET metres; points beyond NEAR metres are ignored.
MEET, NEAR = 0.3, 8.0
# Directions of the laser, in degrees, and fields of view to try. In all good logs, points coincide
# best within 5 degrees of the true direction and 10 of the true field.
TURNS, FIELDS = np.arange(-180, 180, 5), np.arange(60, 361, 10)
# Another direction or field is likely if it differs by this many degrees and reduces the distance
# of points by these factors.
LEAST_CHANGE, CLOSER_TURNED, CLOSER_WIDENED = 10, 0.75, 0.85


def disagreement(log: RobotLog, track: Track) -> str | None:
    """Describe how scan matching and odometry differ, likely causes, and options that correct it.

    Returns None if scans and odometry agree. Stretches across a cut of the track or a gap of the
    odometry are ignored. If the odometer hardly moved, only lengths are compared.
    """
    # 1. Compare the motions along stretches: their lengths, directions, ends and turns.
    odometry, unknown = log.odometry, unmeasured(log).union(track.cuts)
    stretches = [(i, j) for i, j in _stretches(odometry) if unknown.isdisjoint(range(i + 1, j + 1))]
    measured, seen = (
        np.array([displacement_between(way[i], way[j]) for i, j in stretches]).reshape(-1, 3)
        for way in (odometry, track.poses)
    )
    told, shown = (way[:, 0] + 1j * way[:, 1] for way in (measured, seen))
    length = np.abs(told)
    by_odometry, by_scans = float(length.sum()), float(np.abs(shown).sum())
    if not stretches:
        by_odometry = float(np.hypot(*np.diff(odometry[:, :2], axis=0).T).sum())
        by_scans = float(track.way[-1])
    angle = cmath.phase(complex((np.conj(told) * shown).sum()))
    # Turning on the spot has no direction of motion.
    driven = length >= STRETCH / 2
    parted = int((np.abs(shown - told) > PARTED * length + ASIDE)[driven].sum())
    turned = np.abs(measured[:, 2]) >= TURN
    pairs = zip(measured[turned, 2], seen[turned, 2], strict=True)
    ratios = [wrapped(float(b)) / a for a, b in pairs]
    turning = float(np.median(ratios)) if len(ratios) >= LEAST_TURNS else 1.0

    # 2. Judge the differences, and look for another field of view or direction.
    has_other_turns, is_askew = abs(turning - 1) > TURNING, abs(angle) > ANGLE
    is_good = max(by_scans, by_odometry) < STRETCH or not (
        abs(by_scans - by_odometry) > max(LENGTH * by_odometry, STRETCH)
        or is_askew
        or has_other_turns
        or parted >= max(LEAST_PARTED, PARTING * driven.sum())
    )
    covers = None if is_good else field_of_view(log)
    looks = laser_direction(log) if covers is None and not has_other_turns else None
    if is_good and looks is None:
        return None

    # 3. Say it.
    found = [f"{by_scans:.0f} m by scans, {by_odometry:.0f} m by odometry"]
    if has_other_turns:
        found.append(f"turns by scans are {turning:.2f} times those by odometry")
    if is_askew:
        degrees, side = abs(math.degrees(angle)), "left" if angle > 0 else "right"
        found.append(
            f"the direction by scans is {degrees:.0f} degrees to the {side} of that by odometry"
        )
    if parted:
        found.append(f"they diverge in {parted} of {driven.sum()} stretches of a metre")
    causes = _causes(log.scans[0], turning if has_other_turns else None, covers, looks)
    return (
        f"Scan matching and odometry disagree: {'; '.join(found)}. The map may be wrong. Likely "
        f"causes: {'; '.join(causes)}."
    )


def _causes(
    scan: Scan, turning: float | None, covers: float | None, looks: float | None
) -> Iterator[str]:
    """Yield the likely causes of a difference, each with an option that corrects it.

    `turning` is the ratio of turns by scans to turns by odometry, if they differ clearly. `covers`
    and `looks` are the field of view and the direction of the laser, in degrees, if they
    are likely to be others than those of the scan.
    """
    fov = _fov(scan)
    # Turns show the field of view; a negative ratio means that left and right are swapped.
    if turning is not None and turning < 0:
        covers = None
        yield f"the laser hangs upside down (--set fov={-math.copysign(fov, scan.laser.step):.0f})"
    elif turning is not None and covers is None and fov / turning <= 360:
        covers = fov / turning
    if covers is not None:
        yield f"its beams cover about {covers:.0f} degrees, not {fov:.0f} (--set fov)"
    if looks is not None:
        x, y, _ = scan.laser.mount
        side = "left" if looks >= 0 else "right"
        yield (
            f"the laser looks {abs(looks):.0f} degrees to the {side} of straight ahead "
            f"(--set mount={x:g},{y:g},{looks:.0f})"
        )
    if covers is None and looks is None and (turning is None or turning >= 0):
        yield (
            'a range that means "nothing came back" is read as a wall (--set no_return, --set '
            "zero_is)"
        )
        yield "the laser sits or looks elsewhere on the robot (--set mount)"
        yield "its field of view is another (--set fov)"
    yield "the odometer jumps, slips or is out of scale"


def laser_direction(log: RobotLog) -> float | None:
    """Estimate the direction of the laser, in degrees to the left of straight ahead.

    Returns None if the direction given in the log is correct, if the scans do not show the
    direction, or if there are several lasers.
    """
    angles = {scan.laser.mount[2] for scan in log.scans}
    apart = _apart(log, np.radians(TURNS)) if len(angles) == 1 else None
    if apart is None:
        return None
    best, now = int(np.argmin(apart)), int(np.argmin(np.abs(TURNS)))
    if abs(TURNS[best]) < LEAST_CHANGE or apart[best] > CLOSER_TURNED * apart[now]:
        return None
    return math.degrees(wrapped(angles.pop() + math.radians(TURNS[best])))


def field_of_view(log: RobotLog) -> float | None:
    """Estimate the field of view of the laser in degrees.

    Returns None if the field of view given in the log is correct, or if the scans do not show it.
    """
    fov = _fov(log.scans[0])
    tried = [_apart(log, np.zeros(1), float(degrees) / fov) for degrees in (fov, *FIELDS)]
    now, *apart = [float(one[0]) for one in tried if one is not None] or [0.0]
    if len(apart) < len(FIELDS):
        return None
    best = int(np.argmin(apart))
    is_other = abs(FIELDS[best] - fov) >= LEAST_CHANGE and apart[best] < CLOSER_WIDENED * now
    return float(FIELDS[best]) if is_other else None


def _fov(scan: Scan) -> float:
    """The field of view of a scan according to the log, in degrees."""
    return math.degrees(abs(scan.laser.step)) * scan.laser.steps


def _apart(log: RobotLog, turns: Array, stretch: float = 1.0) -> Array | None:
    """How far the points of two scans lie apart, if the odometry moves one scan to the other.

    The laser is rotated by each of `turns` radians, and angles between beams are stretched. The
    result is the mean distance in metres for each turn, (turns,); None if there are too few pairs.
    """
    apart = []
    for first, second in _pairs(log):
        here, there = _points(first, stretch), _points(second, stretch)
        if first.laser != second.laser or not (len(here) and len(there)):
            continue
        x, y, angle = first.laser.mount
        at, looks = complex(x, y), np.exp(1j * (angle + turns))
        dx, dy, turn = displacement_between(first.odometry, second.odometry)
        # Transform from the laser of the second scan to the robot then, to the robot at the first
        # scan, to the laser then.
        there = there[:: 1 + len(there) // POINTS, None]
        seen = (complex(dx, dy) + (at + there * looks) * np.exp(1j * turn) - at) / looks
        tree = cKDTree(np.stack([here.real, here.imag], axis=-1))
        points = np.stack([seen.real, seen.imag], axis=-1)
        nearest, _ = tree.query(points, distance_upper_bound=MEET)
        apart.append(np.minimum(nearest, MEET).mean(axis=0))
    return np.mean(apart, axis=0) if len(apart) >= PAIRS / 2 else None


def _pairs(log: RobotLog) -> list[tuple[Scan, Scan]]:
    """Choose at most PAIRS pairs of scans so near to each other that they see the same walls.

    The odometry between near scans is accurate. Each pair comes in both orders: a laser that looks
    ahead sees again what it saw, and one that looks back sees later what it will not see again.
    """
    kept = moving(log.scans)
    pairs = []
    for i, scan in enumerate(kept):
        for later in kept[i + 1 : i + 10]:
            dx, dy, turn = displacement_between(scan.odometry, later.odometry)
            if math.hypot(dx, dy) >= GAP[0] or abs(turn) >= TURN_OF_PAIR[0]:
                if math.hypot(dx, dy) < GAP[1] and abs(turn) < TURN_OF_PAIR[1]:
                    pairs.append((scan, later))
                break
    some = np.unique(np.linspace(0, len(pairs) - 1, min(PAIRS, len(pairs))).astype(int))
    return [pair for i in some for pair in (pairs[i], pairs[i][::-1])]


def _points(scan: Scan, stretch: float) -> NDArray[np.complex128]:
    """Points that the beams of a scan hit, in the frame of the laser, as complex numbers."""
    met = (scan.ranges > 0) & (scan.ranges < min(scan.laser.reach, NEAR))
    middle = scan.laser.bearings.mean()
    return np.asarray(
        scan.ranges[met] * np.exp(1j * (middle + stretch * (scan.laser.bearings[met] - middle)))
    )


def _stretches(odometry: Array) -> list[tuple[int, int]]:
    """Indices of the first and last scan of each stretch of a trajectory, (n, 3) poses."""
    cuts, way, turned = [0], 0.0, 0.0
    steps = np.hypot(*np.diff(odometry[:, :2], axis=0).T)
    for i, (step, turn) in enumerate(zip(steps, np.diff(odometry[:, 2]), strict=True), 1):
        way, turned = way + step, turned + wrapped(turn)
        if way >= STRETCH or abs(turned) >= BEND:
            cuts.append(i)
            way, turned = 0.0, 0.0
    return list(pairwise(cuts))
