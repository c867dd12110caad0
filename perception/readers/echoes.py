"""What the ranges of a log mean: which beams came back, which met nothing, and which failed.

Drivers say "nothing came back" in many ways: infinity, the laser's largest range, a constant below it,
0, or NaN. A log rarely says which way is meant, so the whole log is surveyed:

- A range that repeats at many poses, and beyond which nothing is seen, is no wall. It means that
  nothing came back.
- Beams of 0 or NaN mean that nothing came back if the beams beside them are long. If these are like
  all others, the laser failed there, and nothing is known.

Notes say what was found out. `Told` holds what the user knows better.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from perception.errors import LogError
from perception.readers.scans import Scan
from ssh_abduction.data.errors import brief, is_finite
from ssh_abduction.data.odometry import Pose, between

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]

# What a beam that measured nothing means: that nothing is near, or that nothing is known.
MEANINGS = ("free", "unknown")
# Kinds of beams that measured nothing, as notes name them. Minus infinity is none of them: it says
# that something was too near to be measured (REP 117).
KINDS = ("0", "NaN", "below 0", "below the laser's least range")
# A laser sits within so many metres of the robot's middle.
FARTHEST_MOUNT = 100.0
# A robot that stands sees each range again. So scans are surveyed if the robot has moved by so many
# metres or radians since the last one. So many of them are enough.
APART, TURNED, MOST_SURVEYED = 0.3, math.radians(20), 500
# A range that repeats comes in this share of these scans, in so many of them at least, and in this
# share of their beams. A wall is as far as that from few poses only.
SCANS, LEAST_SCANS, BEAMS = 0.1, 5, 0.005
# It may be noisy: its values differ by such a share at most.
NOISES = (1e-5, 0.001, 0.004, 0.016)
# It is a spike at the end of all ranges: this share of the ranges that are as long lie in it, and it
# has so many times the ranges of an equal band just below it.
NEARLY_ALL, SPIKE = 0.9, 10
# Beams that measured nothing are worth a note if they are this share of all.
WORTH_A_NOTE = 0.01
# Beams beside beams that met nothing are longer than this share of all beams. Beside beams that
# failed at random they are as long as others are (0.5).
LONG = 0.8


@dataclass(frozen=True)
class Told:
    """What the user says of the laser. None: as the log says, or as it seems.

    fov        degrees from the first beam to the last, counterclockwise, around the same middle as in
               the log; negative if they go clockwise, as of a laser that hangs upside down
    mount      the laser's place on the robot: metres ahead, metres to the left, degrees to the left
    no_return  metres from which on a range means that nothing came back
    zero_is    what a range of 0, below 0, below the laser's least range, or NaN means: "free"
               (nothing came back) or "unknown" (nothing is known)

    Raises LogError for any other value.
    """

    fov: float | None = None
    mount: Pose | None = None
    no_return: float | None = None
    zero_is: str | None = None

    def __post_init__(self) -> None:
        if self.fov is not None and not (is_finite(self.fov) and 0 < abs(self.fov) <= 360):
            raise LogError(
                f"fov: expected degrees from -360 to 360 other than 0, got {brief(self.fov)}; name the angle that the beams cover"
            )
        if self.mount is not None:
            values = tuple(self.mount) if isinstance(self.mount, Sequence | np.ndarray) else ()
            if (
                len(values) != 3
                or not all(map(is_finite, values))
                or max(map(abs, values[:2])) > FARTHEST_MOUNT
            ):
                raise LogError(
                    f"mount: expected metres ahead, metres to the left, and degrees, got {brief(self.mount)}; name these three"
                )
        if self.no_return is not None and not (is_finite(self.no_return) and self.no_return > 0):
            raise LogError(
                f"no_return: expected metres above 0, got {brief(self.no_return)}; name the range that means nothing came back"
            )
        if self.zero_is is not None and self.zero_is not in MEANINGS:
            raise LogError(
                f"zero_is: expected {' or '.join(MEANINGS)}, got {brief(self.zero_is)}; name one of these"
            )

    def placed(self, scan: Scan) -> Scan:
        """A scan whose laser looks where the user says."""
        laser = scan.laser
        if self.fov is not None:
            middle, fov = laser.first + laser.step * laser.steps / 2, math.radians(self.fov)
            laser = replace(laser, first=middle - fov / 2, step=fov / laser.steps)
        if self.mount is not None:
            x, y, degrees = map(float, self.mount)
            laser = replace(laser, mount=(x, y, math.radians(degrees)))
        return scan if laser is scan.laser else replace(scan, laser=laser)

    def reach(self, reach: float) -> float:
        """How far a laser reaches, of which the log says how far it does."""
        # The ranges may have been rounded to single precision.
        return reach if self.no_return is None else self.no_return * (1 - 1e-6)

    @property
    def free(self) -> frozenset[str]:
        """The kinds of beams that met nothing, as the user says."""
        return frozenset(KINDS if self.zero_is == "free" else ())


@dataclass(frozen=True)
class Meaning:
    """What the ranges of a laser mean.

    reach  metres from which on a range says that nothing came back
    free   the kinds of beams without a measurement that say the same, of KINDS
    """

    reach: float
    free: frozenset[str]


def understood(scans: Sequence[Scan], told: Told) -> tuple[tuple[Scan, ...], tuple[str, ...]]:
    """Find out what the ranges of a whole log mean.

    Args:
        scans: The scans, with ranges as the driver wrote them.
        told: What the user says. What it leaves open is surveyed.

    Returns:
        The scans with ranges as `Scan` describes them, and notes on what was found out.

    Raises:
        LogError: The user says where the laser sits, but the scans are those of several lasers.
    """
    lasers = len({scan.laser.mount for scan in scans})
    if told.mount is not None and lasers > 1:
        raise LogError(
            f"mount: expected the scans of one laser, got those of {lasers}; leave it out (--mount), or read the topic of one laser (--scan-topic)"
        )
    placed = [told.placed(scan) for scan in scans]
    # A log may have several lasers. The number of beams of one may differ from scan to scan.
    groups: dict[tuple[float, float, Pose], list[int]] = defaultdict(list)
    for i, scan in enumerate(placed):
        groups[scan.laser.reach, scan.laser.nearest, scan.laser.mount].append(i)
    meanings: dict[int, Meaning] = {}
    notes: list[str] = []
    for members in groups.values():
        kept = moving(placed[i] for i in members)
        some = np.unique(np.linspace(0, len(kept) - 1, min(len(kept), MOST_SURVEYED)).astype(int))
        meaning, said = _surveyed([kept[i] for i in some], told)
        meanings |= dict.fromkeys(members, meaning)
        notes += said
    return tuple(_measured(scan, meanings[i]) for i, scan in enumerate(placed)), tuple(
        dict.fromkeys(notes)
    )


def as_told(scan: Scan, told: Told) -> Scan:
    """Read the ranges of a single scan, of whose log nothing else is known.

    Args:
        scan: The scan, with ranges as the driver wrote them.
        told: What the user says.

    Returns:
        The scan with ranges as `Scan` describes them.
    """
    placed = told.placed(scan)
    return _measured(placed, Meaning(told.reach(placed.laser.reach), told.free))


def moving(scans: Iterable[Scan]) -> list[Scan]:
    """The scans before which the robot moved since the one before, by odometry."""
    kept: list[Scan] = []
    for scan in scans:
        dx, dy, turned = between(kept[-1].odometry, scan.odometry) if kept else (APART, 0.0, 0.0)
        if math.hypot(dx, dy) >= APART or abs(turned) >= TURNED:
            kept.append(scan)
    return kept


def _measured(scan: Scan, meaning: Meaning) -> Scan:
    """A scan whose ranges are infinite where nothing came back, and NaN where nothing is known."""
    ranges, kinds = scan.ranges.copy(), _kinds(scan)
    with np.errstate(invalid="ignore"):
        ranges[scan.ranges >= meaning.reach] = np.inf
        ranges[scan.ranges <= max(scan.laser.nearest, 0.0)] = np.nan
    for kind in meaning.free:
        ranges[kinds[kind]] = np.inf
    laser = (
        scan.laser
        if scan.laser.reach == meaning.reach
        else replace(scan.laser, reach=meaning.reach)
    )
    return replace(scan, ranges=ranges, laser=laser)


def _kinds(scan: Scan) -> dict[str, Bools]:
    """Which beams are of each of KINDS."""
    ranges = scan.ranges
    with np.errstate(invalid="ignore"):
        near = (ranges > 0) & (ranges <= scan.laser.nearest)
        found = ranges == 0, np.isnan(ranges), (ranges < 0) & np.isfinite(ranges), near
    return dict(zip(KINDS, found, strict=True))


def _surveyed(scans: Sequence[Scan], told: Told) -> tuple[Meaning, list[str]]:
    """What the ranges of a laser mean, and what is to be said of that."""
    laser, notes = scans[0].laser, list[str]()
    reach = told.reach(laser.reach)
    if told.no_return is None and (repeated := _repeated(scans)) is not None:
        reach, share = repeated
        but = (
            f", though the laser is said to reach {laser.reach:g} m"
            if math.isfinite(laser.reach)
            else ""
        )
        notes.append(
            f"Ranges of {reach:.4g} m repeat in {_percent(share)} of the beams, and hardly any are longer{but}. "
            "They are taken to mean that nothing came back. If they are walls, "
            "say how far the laser reaches: --no-return METRES."
        )
    if not math.isfinite(reach):
        # The largest range itself was measured.
        most = max(
            (float(r.max()) for scan in scans if len(r := scan.ranges[np.isfinite(scan.ranges)])),
            default=0.0,
        )
        reach = float(np.nextafter(most, math.inf)) if most > 0 else math.inf
        if most > 0:
            notes.append(
                f"The log does not say how far the laser reaches. By its largest range it is {most:.4g} m. "
                "If it reaches farther, or less far, say so: --no-return METRES."
            )
    if told.zero_is is not None:
        return Meaning(reach, told.free), notes
    free, said = _without_measurement(scans, reach)
    return Meaning(reach, free), notes + said


def _repeated(scans: Sequence[Scan]) -> tuple[float, float] | None:
    """The range that means "nothing came back", and its share of all beams.

    None if no range repeats as this one would.
    """
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
        # A few stray ranges may be longer. The middle of the spike is found from its upper part.
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


def _without_measurement(scans: Sequence[Scan], reach: float) -> tuple[frozenset[str], list[str]]:
    """The kinds of beams that met nothing, and what is to be said of beams without a measurement."""
    counts = dict.fromkeys(KINDS, 0)
    beside: dict[str, list[Array]] = {kind: [] for kind in KINDS}
    lengths: list[Array] = []
    for scan in scans:
        with np.errstate(invalid="ignore"):
            good = np.flatnonzero(scan.ranges > max(scan.laser.nearest, 0.0))
        ranges = np.minimum(scan.ranges[good], reach)
        lengths.append(ranges[ranges < reach])
        for kind, is_of_kind in _kinds(scan).items():
            counts[kind] += int(is_of_kind.sum())
            if len(good) and is_of_kind.any():
                # The longer one of the next measured beams on both sides.
                after = np.searchsorted(good, np.flatnonzero(is_of_kind))
                before, behind = np.maximum(after - 1, 0), np.minimum(after, len(good) - 1)
                beside[kind].append(np.maximum(ranges[before], ranges[behind]))
    everything = np.concatenate(lengths)
    usual = float(np.median(everything)) if len(everything) else 0.0
    beams = sum(len(scan.ranges) for scan in scans)
    free: set[str] = set()
    notes: list[str] = []
    for kind, count in counts.items():
        if count < WORTH_A_NOTE * beams:
            continue
        typical = float(np.median(np.concatenate(beside[kind]))) if beside[kind] else 0.0
        is_free = (
            bool(len(everything))
            and math.isfinite(reach)
            and float((everything < typical).mean()) >= LONG
        )
        free |= {kind} if is_free else set()
        taken, other = (
            ("nothing came back", "unknown") if is_free else ("nothing is known there", "free")
        )
        notes.append(
            f"{_percent(count / beams)} of the beams are {kind}. The beams beside them are {typical:.2g} m long, where "
            f"{usual:.2g} m is usual. So they are taken to mean that {taken}. If that is wrong, say --zero-is {other}."
        )
    return frozenset(free), notes


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if share >= 0.1 else f"{100 * share:.2g} %"
