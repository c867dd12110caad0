"""Finds out what the ranges of a log mean: which beams hit something, met nothing, or failed.

Drivers encode "nothing came back" in many ways: infinity, the largest range of the laser, a
constant below it, 0, or NaN. A log rarely says which. So the whole log is surveyed:

- If a range repeats at many poses, and hardly any range is longer, it is no wall. It means that
  nothing came back.
- If beams with 0 or NaN point where scans from nearby see no walls, nothing came back. If they
  point at walls nearly as often as other beams, the laser failed there, and nothing is known.

Notes say what was found. `LaserOptions` holds what the user says instead.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from perception.errors import LogError
from perception.readers.scans import Array, Scan, ScanTable, shared
from ssh_abduction.data.checks import a_number, numbers, one_of
from ssh_abduction.data.errors import brief, is_finite
from ssh_abduction.data.odometry import Pose, displacement_between
from ssh_abduction.data.words import counted, first_few

_Key = tuple[float, float, Pose]
Bools = NDArray[np.bool_]

# Meaning of a beam without a measurement: nothing is near, or nothing is known.
MEANINGS = ("free", "unknown")
# Kinds of beams without a measurement, as notes name them. Minus infinity is not among them: it
# means that something was too near to be measured (REP 117).
KINDS = ("0", "NaN", "below 0", "below the laser's least range")
# Largest distance in metres from the robot's middle to a laser.
FARTHEST_MOUNT = 100.0
# A standing robot repeats its ranges. So only scans after a motion of this many metres or
# radians are surveyed, and at most MOST_SURVEYED of them.
APART, TURNED, MOST_SURVEYED = 0.3, math.radians(20), 500
# A repeated range that means "nothing" occurs in this share of surveyed scans, at least
# LEAST_SCANS, and in this share of their beams. A wall has the same distance from few poses only.
SCANS, LEAST_SCANS, BEAMS = 0.1, 5, 0.005
# Noise of the repeated range, relative to that range. These values are tried in turn.
NOISES = (1e-5, 0.001, 0.004, 0.016)
# The repeated range is a spike at the end of the histogram of ranges. It has the share NEARLY_ALL
# of the ranges that are at least as long, and SPIKE times the ranges in an equally wide band just
# below.
NEARLY_ALL, SPIKE = 0.9, 10
# A beam sees the robot itself if it measures anything in half of the scans, and NEARLY_ALL these
# ranges are one, up to ROBOT metres, within SAME_RANGE: two standard deviations of cheap lasers. It
# is judged from LEAST_POSES poses on.
ROBOT, SAME_RANGE, LEAST_POSES = 0.6, 0.06, 30
# A kind of beam without a measurement is worth a note if it has at least this share of all beams.
WORTH_A_NOTE = 0.01
# Beams met nothing if scans from nearby see walls in their directions less often than this share of
# what chance would give. It was 0.003 in a log where zeros mean that nothing came back, and 0.3 in
# one where the laser failed.
BY_CHANCE = 0.1
# Fewer walls than these, by chance, show nothing.
LEAST_WALLS = 10
# Scans are near if the robot moved at most NEARBY metres and radians between them. Walls at up to
# the share INSIDE of the largest range count, as both scans must reach them.
NEARBY, INSIDE = (1.0, 0.6), 0.8


@dataclass(frozen=True)
class LaserOptions:
    """What the user says about the laser. None means that the log and the survey decide.

    Attributes:
        fov: Degrees from the first beam to the last, counterclockwise. The middle of the field of
            view stays as in the log. Negative if the beams turn clockwise, as those of a laser that
            hangs upside down.
        mount: Position of the laser on the robot: metres ahead, metres to the left, degrees to the
            left.
        no_return: A range of at least this many metres means that nothing came back.
        zero_is: Meaning of a range of 0, below 0, below the laser's least range, or NaN: "free"
            (nothing came back) or "unknown" (nothing is known).
        nearest: A range of at most this many metres is of the robot itself, so nothing is known.
            None finds such beams: they return one short range in nearly all scans.
        blind: Two bearings in degrees to the left of where the laser looks. Nothing is known of the
            beams from the first one counterclockwise to the second one.

    Raises:
        LogError: A value is out of range.
    """

    fov: float | None = None
    mount: Pose | None = None
    no_return: float | None = None
    zero_is: str | None = None
    nearest: float | None = None
    blind: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if self.fov is not None and not (is_finite(self.fov) and 0 < abs(self.fov) <= 360):
            raise LogError(
                f"fov: expected degrees from -360 to 360 other than 0, got {brief(self.fov)}; "
                "name the angle that the beams cover"
            )
        if self.mount is not None:
            what, mend = "metres ahead, metres to the left, and degrees", "name these three"
            for number in numbers("mount", self.mount, LogError, 3, what, mend)[:2]:
                least, most = -FARTHEST_MOUNT, FARTHEST_MOUNT
                a_number("mount", number, LogError, least, most, what="metres", mend=mend)
        if self.no_return is not None:
            mend = "name the range that means nothing came back"
            a_number("no_return", self.no_return, LogError, above=0, what="metres", mend=mend)
        if self.zero_is is not None:
            one_of("zero_is", self.zero_is, MEANINGS, LogError, mend="name one of these")
        if self.nearest is not None:
            mend = "name the range below which the laser sees its robot"
            a_number("nearest", self.nearest, LogError, 0, what="metres", mend=mend)
        if self.blind is not None:
            mend = "name the two bearings, as -10:10"
            for number in numbers("blind", self.blind, LogError, 2, "degrees", mend):
                a_number("blind", number, LogError, -360, 360, what="degrees", mend=mend)

    def placed(self, scan: Scan) -> Scan:
        """Copy a scan, with the laser's field of view, mount and blind beams by the user."""
        laser = scan.laser
        if self.fov is not None:
            middle, fov = laser.first + laser.step * laser.steps / 2, math.radians(self.fov)
            laser = replace(laser, first=middle - fov / 2, step=fov / laser.steps)
        if self.mount is not None:
            x, y, degrees = map(float, self.mount)
            laser = replace(laser, mount=(x, y, math.radians(degrees)))
        if laser is not scan.laser:
            scan = replace(scan, laser=shared(laser))
        limits = np.full(len(scan.ranges), self.nearest or 0.0)
        if self.blind is not None:
            begin, end = self.blind
            over = (np.degrees(scan.laser.bearings) - begin) % 360
            limits[over <= (360 if end - begin >= 360 else (end - begin) % 360)] = np.inf
        return _without_robot(scan, limits) if limits.any() else scan

    def reach(self, reach: float) -> float:
        """Return the reach of a laser in metres: from the user, or else from the log."""
        # The ranges may have been rounded to single precision.
        return reach if self.no_return is None else self.no_return * (1 - 1e-6)

    @property
    def free(self) -> frozenset[str]:
        """The kinds of beams that met nothing, according to the user: all of KINDS, or none."""
        return frozenset(KINDS if self.zero_is == "free" else ())


@dataclass(frozen=True)
class Meaning:
    """Which ranges of a laser mean that nothing came back."""

    reach: float  # a range of at least this many metres means that nothing came back
    # Metres for each beam, up to which it shows the robot itself; none if the log has no such beam.
    robot: Array
    # Kinds of beams without a measurement that also mean this, a subset of KINDS.
    free: frozenset[str]


def interpret_log(
    scans: Sequence[Scan], options: LaserOptions
) -> tuple[ScanTable, tuple[str, ...]]:
    """Interpret the ranges of a whole log, as the driver wrote them, and note what was found.

    `options` override the survey. In the result, ranges are infinite if nothing came back and
    NaN if nothing is known. Raises LogError if the user gives one mount, but the scans come from
    several lasers.
    """
    interpret, notes = interpreter_of(scans, options)
    return ScanTable(map(interpret, scans)), notes


def interpreter_of(
    scans: Sequence[Scan], options: LaserOptions
) -> tuple[Callable[[Scan], Scan], tuple[str, ...]]:
    """Find out from some scans what the ranges of a log mean, as `interpret_log` does.

    Return a function that interprets a scan of the same lasers, also a later one, and notes. The
    function interprets a scan of another laser by the options alone.
    """
    lasers = len({scan.laser.mount for scan in scans})
    if options.mount is not None and lasers > 1:
        raise LogError(
            f"mount: expected the scans of one laser, got those of {lasers}; leave it out "
            "(--set mount), or read the topic of one laser (--set scan_topic)"
        )
    # A log may have several lasers. The number of beams of a laser may change from scan to scan.
    groups: dict[_Key, list[Scan]] = defaultdict(list)
    for scan in map(options.placed, scans):
        groups[_key(scan)].append(scan)
    meanings: dict[_Key, Meaning] = {}
    notes: list[str] = []
    for key, members in groups.items():
        kept = moving(members)
        some = np.unique(np.linspace(0, len(kept) - 1, min(len(kept), MOST_SURVEYED)).astype(int))
        surveyed = [replace(kept[i], ranges=kept[i].ranges.copy()) for i in some]
        robot, seen = (
            (np.zeros(0), list[str]()) if options.nearest is not None else (_robot_in(surveyed))
        )
        surveyed = [_without_robot(scan, robot) for scan in surveyed]
        notes += seen
        after = [kept[i + 1] for i in some if i + 1 < len(kept)]
        meanings[key], said = _survey(surveyed, after, options, robot)
        notes += said

    def interpret(scan: Scan) -> Scan:
        placed = options.placed(scan)
        usual = Meaning(options.reach(placed.laser.reach), np.zeros(0), options.free)
        return _measured(placed, meanings.get(_key(placed), usual))

    return interpret, tuple(dict.fromkeys(notes))


def _key(scan: Scan) -> _Key:
    """The key that distinguishes the lasers of a log: reach, least range and mount."""
    return scan.laser.reach, scan.laser.nearest, scan.laser.mount


def moving(scans: Iterable[Scan]) -> list[Scan]:
    """Choose the first scan, and each one at least APART metres or TURNED radians further on."""
    kept: list[Scan] = []
    for scan in scans:
        dx, dy, turned = (
            displacement_between(kept[-1].odometry, scan.odometry) if kept else (APART, 0.0, 0.0)
        )
        if math.hypot(dx, dy) >= APART or abs(turned) >= TURNED:
            kept.append(scan)
    return kept


def _measured(scan: Scan, meaning: Meaning) -> Scan:
    """Copy a scan, with infinite ranges if nothing came back and NaN if nothing is known."""
    scan = _without_robot(scan, meaning.robot)
    ranges, kinds = scan.ranges.copy(), _kinds(scan)
    with np.errstate(invalid="ignore"):
        ranges[scan.ranges >= meaning.reach] = np.inf
        ranges[scan.ranges <= max(scan.laser.nearest, 0.0)] = np.nan
    for kind in meaning.free:
        ranges[kinds[kind]] = np.inf
    laser = scan.laser
    if laser.reach != meaning.reach:
        laser = shared(replace(laser, reach=meaning.reach))
    return replace(scan, ranges=ranges, laser=laser)


def _kinds(scan: Scan) -> dict[str, Bools]:
    """For each of KINDS, the mask of its beams in a scan, (beams,)."""
    ranges = scan.ranges
    with np.errstate(invalid="ignore"):
        near = (ranges > 0) & (ranges <= scan.laser.nearest)
        found = ranges == 0, np.isnan(ranges), (ranges < 0) & np.isfinite(ranges), near
    return dict(zip(KINDS, found, strict=True))


def _without_robot(scan: Scan, limits: Array) -> Scan:
    """Copy a scan, with minus infinity (unknown) for ranges up to the limit of their beam.

    Infinite limits hide a beam altogether. Limits of another number of beams are ignored.
    """
    if len(limits) != len(scan.ranges):
        return scan
    with np.errstate(invalid="ignore"):
        hidden = ((scan.ranges > 0) & (scan.ranges <= limits)) | np.isinf(limits)
    return replace(scan, ranges=np.where(hidden, -np.inf, scan.ranges))


def _robot_in(scans: Sequence[Scan]) -> tuple[Array, list[str]]:
    """Find the beams that the robot itself blocks: one short range at one bearing in most scans.

    Return the limit of each beam in metres, 0 for the others, and a note. If there are none, or
    too few scans show them, both are empty.
    """
    laser = scans[0].laser
    alike = [scan.ranges for scan in scans if len(scan.ranges) == laser.beams]
    if len(alike) < LEAST_POSES:
        return np.zeros(0), []
    ranges = np.stack(alike)
    ranges[~(ranges > max(laser.nearest, 0.0))] = np.inf
    usual = np.median(ranges, axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = (np.abs(ranges - usual) <= SAME_RANGE).sum(axis=0) / np.isfinite(ranges).sum(axis=0)
    blocked = (usual <= ROBOT) & (share >= NEARLY_ALL)
    if not blocked.any():
        return np.zeros(0), []
    # Beams beside meet the edge of the same part in some scans.
    limits = np.where(blocked, usual + SAME_RANGE, 0.0)
    limits = np.maximum(limits, ndimage.maximum_filter1d(limits, 3, mode="nearest"))
    bearings = np.degrees(laser.bearings[blocked])
    parts = np.split(bearings, np.flatnonzero(np.diff(np.flatnonzero(blocked)) > 1) + 1)
    listed = first_few([f"{part.min():.0f} to {part.max():.0f}" for part in parts], 5)
    return limits, [
        f"{counted(int(blocked.sum()), 'beams')} return one short range, "
        f"{usual[blocked].min():.2g} to {usual[blocked].max():.2g} m, in nearly all scans: at "
        f"{listed} degrees to the left of where the laser looks. They are taken to see the robot "
        "itself, and count as unknown. If they see walls, say --set nearest=0. If the robot hides "
        "more, say --set nearest=METRES or --set blind=FROM:TO in degrees."
    ]


def _survey(
    scans: Sequence[Scan], after: Sequence[Scan], options: LaserOptions, robot: Array
) -> tuple[Meaning, list[str]]:
    """Find out what the ranges of one laser mean. `after` has those that follow."""
    laser, notes = scans[0].laser, list[str]()
    reach = options.reach(laser.reach)
    if options.no_return is None and (repeated := _repeated(scans)) is not None:
        reach, share = repeated
        but = (
            f", though the laser is said to reach {laser.reach:g} m"
            if math.isfinite(laser.reach)
            else ""
        )
        notes.append(
            f"Ranges of {reach:.4g} m repeat in {_percent(share)} of the beams, and hardly any are "
            f"longer{but}. They are taken to mean that nothing came back. If they are walls, say "
            "how far the laser reaches: --set no_return=METRES."
        )
    if not math.isfinite(reach):
        # The largest range itself was measured, so the reach lies just above it.
        most = max(
            (float(r.max()) for scan in scans if len(r := scan.ranges[np.isfinite(scan.ranges)])),
            default=0.0,
        )
        reach = float(np.nextafter(most, math.inf)) if most > 0 else math.inf
        if most > 0:
            notes.append(
                "The log does not say how far the laser reaches. By its largest range it is "
                f"{most:.4g} m. If it reaches farther, or less far, say so: --set no_return=METRES."
            )
    if options.zero_is is not None:
        return Meaning(reach, robot, options.free), notes
    free, said = _without_measurement(scans, after, reach)
    return Meaning(reach, robot, free), notes + said


def _repeated(scans: Sequence[Scan]) -> tuple[float, float] | None:
    """Find the range that means "nothing came back", in metres, and its share of all beams."""
    laser = scans[0].laser
    with np.errstate(invalid="ignore"):
        kept = [
            scan.ranges[(scan.ranges > max(laser.nearest, 0.0)) & (scan.ranges < laser.reach)]
            for scan in scans
        ]
    ranges = np.sort(np.concatenate(kept))
    beams = sum(len(scan.ranges) for scan in scans)
    few = math.ceil(BEAMS * beams)
    if len(ranges) < few:
        return None
    for noise in NOISES:
        # A few stray ranges may be longer than the spike. Skip them to find its middle.
        middle = float(ranges[-few])
        width = noise * middle
        for _ in range(5):
            middle = float(
                np.median(ranges[(ranges >= middle - width) & (ranges <= middle + width)])
            )
        beyond = ranges >= middle - width
        inside = int((beyond & (ranges <= middle + width)).sum())
        below = int((~beyond & (ranges >= middle - 3 * width)).sum())
        if inside < max(few, NEARLY_ALL * beyond.sum(), SPIKE * below):
            continue
        showing = sum(bool((r >= middle - width).any()) for r in kept)
        if showing >= max(LEAST_SCANS, SCANS * len(scans)):
            return float(ranges[beyond][0]), float(beyond.sum() / beams)
    return None


def _without_measurement(
    scans: Sequence[Scan], after: Sequence[Scan], reach: float
) -> tuple[frozenset[str], list[str]]:
    """Find the kinds of beams without a measurement that mean "nothing came back"."""
    beams = sum(len(scan.ranges) for scan in scans)
    masks = [_kinds(scan) for scan in scans]
    with np.errstate(invalid="ignore"):
        found = [
            s.ranges[(s.ranges > max(s.laser.nearest, 0.0)) & (s.ranges < reach)] for s in scans
        ]
    farthest = max((float(ranges.max()) for ranges in found if len(ranges)), default=0.0)
    free: set[str] = set()
    notes: list[str] = []
    for kind in KINDS:
        count = sum(int(of_kind[kind].sum()) for of_kind in masks)
        if count < WORTH_A_NOTE * beams:
            continue
        if not farthest:
            notes.append(
                f"{_percent(count / beams)} of the beams are {kind}, and no beam measured "
                "anything. Look at the laser and its driver."
            )
            continue
        walls = None
        if math.isfinite(reach):
            pairs = [*zip(scans, after, (of_kind[kind] for of_kind in masks), strict=False)]
            walls = _walls_there(pairs, INSIDE * farthest)
        is_free = walls is not None and walls < BY_CHANCE
        free |= {kind} if is_free else set()
        taken, other = (
            ("nothing came back", "unknown") if is_free else ("nothing is known there", "free")
        )
        shown = (
            "No scan from nearby shows whether walls are there"
            if walls is None
            else f"Scans from nearby see walls there {walls:.2g} times as often as elsewhere"
        )
        notes.append(
            f"{_percent(count / beams)} of the beams are {kind}. {shown}. So they are taken "
            f"to mean that {taken}. If that is wrong, say --set zero_is={other}."
        )
    return frozenset(free), notes


def _walls_there(pairs: Sequence[tuple[Scan, Scan, Bools]], most: float) -> float | None:
    """Return how often beams of a kind point at walls that the next scan sees, relative to chance.

    Each pair is a scan, the next one, and the mask of the beams of the kind in the first. Walls
    count up to `most` metres. None if too few scans are near each other, or see walls.
    """
    walls = hits = of_kind = beams = 0
    alike = [mask for *_, mask in pairs if len(mask) == len(pairs[0][2])]
    # A beam that nearly never measures, as behind a mast, meets no wall that the next scan sees.
    works = np.mean(alike, axis=0) < NEARLY_ALL if alike else np.zeros(0, bool)
    for scan, then, mask in pairs:
        dx, dy, turned = displacement_between(scan.odometry, then.odometry)
        is_near = math.hypot(dx, dy) <= NEARBY[0] and abs(turned) <= NEARBY[1]
        if not is_near or len(mask) != len(works):
            continue
        with np.errstate(invalid="ignore"):
            seen = (then.ranges > max(then.laser.nearest, ROBOT)) & (then.ranges < most)
        x, y, facing = then.laser.mount
        points = x + 1j * y + then.ranges[seen] * np.exp(1j * (then.laser.bearings[seen] + facing))
        x, y, facing = scan.laser.mount
        points = dx + 1j * dy + np.exp(1j * turned) * points - (x + 1j * y)
        off = np.angle(points * np.exp(-1j * facing)) - scan.laser.first
        beam = np.round(off / scan.laser.step).astype(int)
        beam %= round(math.tau / abs(scan.laser.step))
        beam = beam[(beam < len(mask)) & (np.abs(points) < most)]
        beam = beam[works[beam]]
        walls, hits = walls + len(beam), hits + int(mask[beam].sum())
        of_kind, beams = of_kind + int(mask[works].sum()), beams + int(works.sum())
    by_chance = walls * of_kind / beams if beams else 0.0
    return hits / by_chance if by_chance >= LEAST_WALLS else None


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if share >= 0.1 else f"{100 * share:.2g} %"
