"""Compares the trajectory by scan matching with the trajectory by odometry.

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
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from perception.places.track import Array, Track, wrapped
from perception.readers.echoes import moving
from perception.readers.scans import RobotLog, Scan
from ssh_abduction.data.odometry import displacement_between

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
PAIRS, POINTS = 60, 90
# Points coincide within MEET metres; points beyond NEAR metres are ignored.
MEET, NEAR = 0.3, 8.0
# Directions of the laser, in degrees, and fields of view to try. In all good logs, points coincide
# best within 5 degrees of the true direction and 10 of the true field.
TURNS, FIELDS = np.arange(-180, 180, 5), np.arange(60, 361, 10)
# Another direction or field is likely if it differs by this many degrees and reduces the distance
# of points by these factors.
LEAST_CHANGE, CLOSER_TURNED, CLOSER_WIDENED = 10, 0.75, 0.85


@dataclass(frozen=True)
class Agreement:
    """Comparison of the trajectories by scan matching and by odometry."""

    odometry: float  # metres driven by odometry, over all stretches
    scans: float  # metres driven by scan matching, over the same stretches
    angle: float = 0.0  # direction of motion by scans minus that by odometry; radians to the left
    # Median ratio of turns by scans to turns by odometry; None if there are few turns.
    turning: float | None = None
    parted: int = 0  # number of stretches in which the two trajectories diverge
    # Number of stretches that are compared for `parted`. The robot drives in each of them.
    of: int = 0

    @property
    def has_other_turns(self) -> bool:
        """Whether turns by scans are clearly larger or smaller than those by odometry."""
        return self.turning is not None and abs(self.turning - 1) > TURNING

    @property
    def is_askew(self) -> bool:
        """Whether scans and odometry clearly differ in the direction of motion."""
        return abs(self.angle) > ANGLE

    @property
    def differences(self) -> list[str]:
        """How the trajectories differ, in words."""
        found = [f"{self.scans:.0f} m by scans, {self.odometry:.0f} m by odometry"]
        if self.has_other_turns:
            found.append(f"turns by scans are {self.turning:.2f} times those by odometry")
        if self.is_askew:
            degrees, side = abs(math.degrees(self.angle)), "left" if self.angle > 0 else "right"
            found.append(
                f"the direction by scans is {degrees:.0f} degrees to the {side} of that by odometry"
            )
        if self.parted:
            found.append(f"they diverge in {self.parted} of {self.of} stretches of a metre")
        return found

    @property
    def is_good(self) -> bool:
        """Whether the two trajectories nearly agree, or are too short to be compared."""
        if max(self.scans, self.odometry) < STRETCH:
            return True
        is_other_length = abs(self.scans - self.odometry) > max(LENGTH * self.odometry, STRETCH)
        is_parted = self.parted >= max(LEAST_PARTED, PARTING * self.of)
        return not (is_other_length or self.is_askew or self.has_other_turns or is_parted)


def agreement(log: RobotLog, track: Track) -> Agreement:
    """Compare the track of a log with its odometry.

    Stretches across a cut of the track, where the motion is unknown, are ignored. If the
    odometer hardly moved, only lengths are compared.
    """
    odometry = log.odometry
    stretches = [
        (i, j) for i, j in _stretches(odometry) if not any(i < cut <= j for cut in track.cuts)
    ]
    if not stretches:
        return Agreement(
            float(np.hypot(*np.diff(odometry[:, :2], axis=0).T).sum()), float(track.way[-1])
        )
    measured = np.array([displacement_between(odometry[i], odometry[j]) for i, j in stretches])
    seen = np.array([displacement_between(track.poses[i], track.poses[j]) for i, j in stretches])
    motion_told, motion_seen = (way[:, 0] + 1j * way[:, 1] for way in (measured, seen))
    length = np.abs(motion_told)
    # Turning on the spot has no direction of motion.
    driven = length >= STRETCH / 2
    parted = np.abs(motion_seen - motion_told)[driven] > PARTED * length[driven] + ASIDE
    turned = np.abs(measured[:, 2]) >= TURN
    ratios = [
        wrapped(float(b)) / a for a, b in zip(measured[turned, 2], seen[turned, 2], strict=True)
    ]
    return Agreement(
        odometry=float(length.sum()),
        scans=float(np.abs(motion_seen).sum()),
        angle=cmath.phase(complex((np.conj(motion_told) * motion_seen).sum())),
        turning=float(np.median(ratios)) if len(ratios) >= LEAST_TURNS else None,
        parted=int(parted.sum()),
        of=len(parted),
    )


def disagreement(log: RobotLog, track: Track) -> str | None:
    """Describe how scan matching and odometry differ, likely causes, and options that correct it.

    Returns None if scans and odometry agree.
    """
    found = agreement(log, track)
    covers = None if found.is_good else field_of_view(log)
    looks = laser_direction(log) if covers is None and not found.has_other_turns else None
    if found.is_good and looks is None:
        return None
    causes = _causes(log.scans[0], found, covers, looks)
    return (
        f"Scan matching and odometry disagree: {'; '.join(found.differences)}. The map may be "
        f"wrong. Likely causes: {'; '.join(causes)}."
    )


def _causes(
    scan: Scan, found: Agreement, covers: float | None, looks: float | None
) -> Iterator[str]:
    """Yield the likely causes of a difference, each with an option that corrects it.

    `covers` and `looks` are the field of view and the direction of the laser, in degrees, if they
    are likely to be others than those of the scan.
    """
    fov, turning = _fov(scan), found.turning if found.has_other_turns else None
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
    now = _apart(log, np.zeros(1)) if len(angles) == 1 else None
    most = math.inf if now is None else CLOSER_TURNED * float(now[0])
    apart = None if now is None else _apart(log, np.radians(TURNS), most=most)
    if apart is None:
        return None
    best = int(np.argmin(apart))
    if abs(TURNS[best]) < LEAST_CHANGE or apart[best] > most:
        return None
    return math.degrees(wrapped(angles.pop() + math.radians(TURNS[best])))


def field_of_view(log: RobotLog) -> float | None:
    """Estimate the field of view of the laser in degrees.

    Returns None if the field of view given in the log is correct, or if the scans do not show it.
    """
    fov = _fov(log.scans[0])
    tried = [_apart(log, np.zeros(1), float(degrees) / fov) for degrees in FIELDS]
    now = _apart(log, np.zeros(1))
    if now is None or any(one is None for one in tried):
        return None
    apart = np.array([one[0] for one in tried if one is not None])
    best = int(np.argmin(apart))
    is_closer = apart[best] < CLOSER_WIDENED * now[0]
    return float(FIELDS[best]) if abs(FIELDS[best] - fov) >= LEAST_CHANGE and is_closer else None


def _fov(scan: Scan) -> float:
    """The field of view of a scan according to the log, in degrees."""
    return math.degrees(abs(scan.laser.step)) * scan.laser.steps


def _apart(
    log: RobotLog, turns: Array, stretch: float = 1.0, most: float = math.inf
) -> Array | None:
    """How far the points of two scans lie apart, if the odometry moves one scan to the other.

    The laser is rotated by each of `turns` radians, and angles between beams are stretched. The
    result is the mean distance in metres for each turn, (turns,); None if there are too few pairs.
    A mean above `most` may be too low, but not below `most`.
    """
    pairs = []
    for first, second in _pairs(log):
        here, there = _points(first, stretch), _points(second, stretch)
        if first.laser == second.laser and len(here) and len(there):
            pairs.append((first, second, here, there[:: 1 + len(there) // POINTS]))
    if len(pairs) < PAIRS / 4:
        return None
    apart = np.zeros(len(turns))
    for first, second, here, there in pairs:
        near = apart <= most * len(pairs)  # the others lie too far apart already
        x, y, angle = first.laser.mount
        at, looks = complex(x, y), np.exp(1j * (angle + turns[near]))
        dx, dy, turn = displacement_between(first.odometry, second.odometry)
        # Transform from the laser of the second scan to the robot then, to the robot at the first
        # scan, to the laser then.
        moved = complex(dx, dy) + (at + there[:, None] * looks) * np.exp(1j * turn)
        seen = (moved - at) / looks
        tree = cKDTree(np.stack([here.real, here.imag], axis=-1))
        nearest, _ = tree.query(
            np.stack([seen.real, seen.imag], axis=-1), distance_upper_bound=MEET
        )
        apart[near] += np.minimum(nearest, MEET).mean(axis=0)
    return apart / len(pairs)


def _pairs(log: RobotLog) -> list[tuple[Scan, Scan]]:
    """Choose at most PAIRS pairs of scans so near to each other that they see the same walls.

    The odometry between near scans is accurate.
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
    return [pairs[i] for i in some]


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
