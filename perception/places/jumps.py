"""Finds jumps and wrong units in odometry, and describes them in notes."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from perception.readers.bags import RecordedTrack as Odometry
from perception.readers.bags import sources_of
from perception.readers.scans import Array, RobotLog, Scan, in_turn
from ssh_abduction.data.odometry import Pose, displacement_between
from ssh_abduction.data.words import counted

if TYPE_CHECKING:
    from perception.places.track import Track

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
    odometry = Odometry()
    for number, scan in enumerate(log.scans):
        odometry.add(number, number, scan.odometry)
    sources = sources_of(odometry)
    # Scans that are out of order look like poses of several sources.
    if len(sources) == 1 or times_back(log) > RUNS_BACK * len(log):
        return log, []
    said = (
        f"The poses of several sources alternate in the odometry, {len(sources[0])} and "
        f"{len(sources[1])} of {len(log)}. The source of more poses is used. If the other one is "
        "better, stop the source that was used, and record again."
    )
    return replace(log, scans=_of_source(log.scans, sources[0])), [said]


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
    """Whether the odometry stands still in most steps."""
    return bool(len(log) > 1 and stands_still(log).mean() > MISSING)


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


def _of_source(scans: Sequence[Scan], members: NDArray[np.intp]) -> tuple[Scan, ...]:
    """Replace the odometry of all scans by that of one source, interpolated or extrapolated."""
    from scipy.interpolate import interp1d

    poses = np.array([scans[number].odometry for number in members])
    poses[:, 2] = np.unwrap(poses[:, 2])
    rows = interp1d(members, poses, axis=0, fill_value="extrapolate")(np.arange(len(scans)))
    odometry: list[Pose] = [
        (x, y, math.remainder(heading, math.tau)) for x, y, heading in rows.tolist()
    ]
    return tuple(replace(scan, odometry=pose) for scan, pose in zip(scans, odometry, strict=True))


def describe_cuts(log: RobotLog, track: Track, turned: list[tuple[int, float]]) -> list[str]:
    """Say in notes where the odometry of a log is wrong: at cuts, breaks and some turns.

    At a *cut* the odometer jumped or hung, so the motion from one scan to the next is unknown.
    At a *break* the scans do not fit those before them: the robot may have been carried. `turned`
    has the indices of scans at which the robot turned differently from the odometry, and the
    differences in radians. There is a note for each kind of error.
    """
    # At a cut after a long step, the odometer jumped. After none, it stood still while the robot
    # moved. At the end of a usual step, only the scans show that the robot was carried.
    steps = {
        cut: displacement_between(log.scans[cut - 1].odometry, log.scans[cut].odometry)
        for cut in track.cuts
    }
    far = {cut: math.hypot(x, y) for cut, (x, y, _) in steps.items()}
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
        step = math.dist(log.scans[first - 1].odometry[:2], log.scans[first].odometry[:2])
        notes.append(
            f"The scans show nothing of what was seen before, {times(len(gaps))}, while the "
            f"odometry goes on: by {step:.1f} m before scan {first} ({_where(log, first)}). The "
            "odometry alone connects the parts. If scans are missing there, or the robot was "
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
    far = _far(log, 1) if len(log) > 1 else np.zeros(0)
    return [
        i
        for i in (np.flatnonzero(far > FAR) + 1).tolist()
        if track.shares[i] < UNMATCHED and i not in track.cuts and i not in track.breaks
    ]


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
    CARRIED = "the robot was carried while nothing was logged"


class LiveJumps:
    """Judges each step by those before it, while a robot drives.

    A step is a jump by the same measure as in `unknown_steps`. The usual step is the median of the
    last LATELY steps. Clocks are not read.
    """

    def __init__(self) -> None:
        self._steps: deque[float] = deque(maxlen=LATELY)

    def __call__(self, scan: int, onward: Pose) -> Doubt:
        """Judge the step to the scan with this index, from its motion in metres and radians."""
        far = math.hypot(*onward[:2])
        usual = float(np.median(self._steps)) if self._steps else 0.0
        least = max(FAR, UNUSUAL * usual)
        if far > 0:
            self._steps.append(far)
        if far > least:
            return Doubt.UNKNOWN
        return Doubt.DOUBTFUL if far > least / 2 else Doubt.NONE


@dataclass(frozen=True)
class Unknown:
    """Scans for which the odometry of the step before them cannot be trusted, by index."""

    # Scans after a jump of the odometer, or after a motion that the odometer missed.
    unknown: frozenset[int] = frozenset()
    # The scans in `unknown` before which the robot was carried while nothing was logged.
    carried: frozenset[int] = frozenset()
    # Scans after other long steps. Such a step is a jump if the scan matches only near the previous
    # pose.
    doubtful: frozenset[int] = frozenset()
    # Scans at which a second drive seems to begin. The step to such a scan is unknown unless the
    # scan matches where the step ends.
    seams: frozenset[int] = frozenset()
    # First and last scan of each stretch in which the odometer stands still, though the scans
    # change.
    still: tuple[tuple[int, int], ...] = ()

    def doubt_of(self, scan: int) -> Doubt:
        """How far the odometry of the step to a scan can be trusted."""
        if scan in self.carried:
            return Doubt.CARRIED
        if scan in self.unknown:
            return Doubt.UNKNOWN
        if scan in self.seams:
            return Doubt.SEAM
        return Doubt.DOUBTFUL if scan in self.doubtful else Doubt.NONE

    def without(self, standing: frozenset[int]) -> Unknown:
        """Make a copy in which the scans of a standing robot are not unknown."""
        return replace(self, unknown=self.unknown - (standing - self.carried), still=())


def unknown_steps(log: RobotLog) -> Unknown:
    """Find scans after a jump of the odometer or after a motion that only the laser shows."""
    if len(log) < 3:
        return Unknown()
    seconds = _seconds(log)
    paused = (
        np.zeros(len(log) - 1, bool) if seconds is None else seconds > PAUSE * np.median(seconds)
    )
    jumped, doubtful = _impossible(log, seconds, paused)
    seams = frozenset(scan for scan, _ in seams_of(log))
    # After a long step in a pause, the odometer may have restarted.
    far, anew = _far(log, 1), np.hypot(*log.odometry[1:, :2].T) < ANEW
    seams |= _targets(paused & anew & (far > FAR / 2) & ~jumped)
    carried, still = _moved_while_still(log, paused)
    moved = frozenset(k for first, last in still for k in range(first, last + 1))
    return Unknown(
        _targets(jumped) | moved | carried, carried, _targets(doubtful & ~jumped), seams, still
    )


def _targets(steps: NDArray[np.bool_]) -> frozenset[int]:
    """The indices of the scans that the marked steps, (n - 1,), lead to."""
    return frozenset((np.flatnonzero(steps) + 1).tolist())


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
) -> tuple[frozenset[int], tuple[tuple[int, int], ...]]:
    """Find stretches in which the odometer stands still, but the laser shows a motion.

    Returns the scans before which there was a pause and somebody moved the robot; and the first and
    last scan of each such stretch. Both are empty if the odometer mostly stands still, because then
    there is no odometry.
    """
    still = stands_still(log)
    if is_missing(log):
        return frozenset(), ()
    carried, found = set[int](), list[tuple[int, int]]()
    # Each stretch of standing still begins and ends at an edge of the mask.
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still, [0]])))
    for begin, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        if any(shows_motion(log.scans[begin], log.scans[k]) for k in range(begin + 1, end + 1)):
            found.append((begin + 1, end))
        carried |= {
            k
            for k in range(begin + 1, end + 1)
            if paused[k - 1] and _change(log.scans[k - 1], log.scans[k]) > MOVED_UNSEEN
        }
    return frozenset(carried), tuple(found)


def stands_still(log: RobotLog) -> NDArray[np.bool_]:
    """Find the steps between n scans in which the odometer repeats a pose: mask, (n - 1,)."""
    return np.asarray(np.abs(np.diff(log.odometry, axis=0)).max(axis=1) < STILL)


class StandstillCheck:
    """Notices whether the robot moves while its odometer stands still."""

    def __init__(self) -> None:
        self.moved = False  # whether the robot moved in this way
        self._first: Scan | None = None  # of those at one pose

    def add(self, scan: Scan) -> None:
        """Add the next scan."""
        first = self._first
        if first is None or np.abs(np.subtract(scan.odometry, first.odometry)).max() >= STILL:
            self._first = scan
        else:
            self.moved = self.moved or shows_motion(first, scan)


def moves_unseen(log: RobotLog) -> bool:
    """Whether the robot moves while its odometer stands still, as the scans of a log show."""
    standing = StandstillCheck()
    for scan in in_turn(log.scans):
        standing.add(scan)
    return standing.moved


def shows_motion(first: Scan, last: Scan) -> bool:
    """Whether enough beams changed between two scans to show that the robot moved."""
    return _change(first, last) > MOVED


def _change(first: Scan, last: Scan) -> float:
    """The share of the beams that changed between two scans; 0 for scans of different lasers.

    The share is of the beams that were measured in both scans and hit something in at least one.
    """
    if first.laser != last.laser:
        return 0.0
    before, after = (
        np.minimum(np.nan_to_num(scan.ranges, nan=0.0, posinf=NO_RANGE), NO_RANGE)
        for scan in (first, last)
    )
    valid = ((before < NO_RANGE) | (after < NO_RANGE)) & (before > 0) & (after > 0)
    changed = np.abs(before - after) > CHANGED + CHANGED_SHARE * np.minimum(before, after)
    return float(changed[valid].mean()) if valid.any() else 0.0


def _far(log: RobotLog, steps: int) -> Array:
    """Distances in metres by odometry from each scan to the scan `steps` later, (n - steps,)."""
    positions = log.odometry[:, :2]
    return np.asarray(np.hypot(*(positions[steps:] - positions[:-steps]).T))


def _seconds(log: RobotLog) -> Array | None:
    """Seconds from each scan to the next, (n - 1,).

    None if times are missing, run backwards, or are all equal.
    """
    if any(scan.time is None for scan in log.scans):
        return None
    seconds = np.diff(np.array([scan.time for scan in log.scans], dtype=float))
    return seconds if (seconds >= 0).all() and seconds.any() else None
