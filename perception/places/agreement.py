"""Whether the way by scans is the way by odometry.

Scan matching mends an odometer that drifts by some percent. If both ways differ by more, something
is read wrongly: the field of view, the place of the laser on the robot, a range that means "nothing
came back", or the odometer itself. How they differ tells which.

Both ways are cut into stretches. A stretch is a motion in the plane: a complex number in the frame of
the robot at its beginning. The factor that best leads from the odometer's motions to those of the
scans (least squares) has an angle: the robot moves in another direction by scans.

Matching scans begins at the odometer's motion. So in a corridor, the way by scans hardly tells that
the laser looks elsewhere. Pairs of scans tell it: moved as the odometer says, their points meet if
the laser looks as it is taken to.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from perception.places.track import Array, Track, wrapped
from perception.readers.echoes import moving
from perception.readers.scans import RobotLog, Scan
from ssh_abduction.odometry import between

# A stretch ends where the robot went so many metres or turned by so many radians, by odometry.
STRETCH, BEND = 1.0, math.radians(30)
# Turns are compared in stretches that turn by so many radians, if there are so many of them.
TURN, LEAST_TURNS = math.radians(15), 8
# The ways part in a stretch if they end farther apart than this share of it and so many metres.
PARTED, ASIDE = 0.25, 0.2
# In good logs, recorded and simulated, both ways differ by at most 4 % in length, 2 degrees in
# direction and 6 % in turns, and they part in at most 3 % of the stretches. Matching is there to mend
# that. Differences of about twice as much are worth a warning.
LENGTH, ANGLE, TURNING, PARTING = 0.1, math.radians(10), 0.15, 0.05
# A robot that was pushed or slipped once has ways that part in fewer stretches.
LEAST_PARTED = 3
# Pairs of scans are so many metres apart, and turned by less than so many radians. So many of them are
# enough.
GAP, BEND_OF_PAIR, PAIRS = (0.8, 2.4), 0.6, 60
# Points of two scans meet up to so many metres, and those beyond so many metres do not count.
MEET, NEAR = 0.3, 8.0
# The laser is turned by so many degrees at a time. In all good logs points meet best within 5 degrees of
# the true direction, and 180 degrees away they are 2 to 4 times as far apart.
TURNS = np.arange(-180, 180, 5)
LEAST_TURN, CLOSER = 10, 0.75


@dataclass(frozen=True)
class Agreement:
    """How the way by scans compares with the way by odometry.

    odometry, scans  metres of both ways, along the stretches
    angle            radians by which the robot moves farther to the left by scans than by odometry
    turning          median ratio of the turns by scans to those by odometry; None for few turns
    parted, of       in how many stretches both ways part, and how many stretches there are
    """

    odometry: float
    scans: float
    angle: float = 0.0
    turning: float | None = None
    parted: int = 0
    of: int = 0

    @property
    def has_other_turns(self) -> bool:
        """Whether the robot turns more, or less, by scans than by odometry."""
        return self.turning is not None and abs(self.turning - 1) > TURNING

    @property
    def is_askew(self) -> bool:
        """Whether the robot moves in another direction by scans than by odometry."""
        return abs(self.angle) > ANGLE

    @property
    def is_good(self) -> bool:
        """Whether matching can mend the difference."""
        is_other_length = abs(self.scans - self.odometry) > max(LENGTH * self.odometry, STRETCH)
        is_parted = self.parted >= max(LEAST_PARTED, PARTING * self.of)
        return not (is_other_length or self.is_askew or self.has_other_turns or is_parted)


def agreement(log: RobotLog, track: Track) -> Agreement:
    """Compare the track of a log with its odometry.

    Args:
        log: The scans and where the odometer was at each.
        track: Where the robot was at each scan, by matching scans.

    Returns:
        How both compare, but for where the track is cut: nothing is known there. Only lengths are
        compared if the odometer hardly moved.
    """
    odometry = np.array([scan.odometry for scan in log.scans])
    stretches = [(i, j) for i, j in _stretches(odometry) if not any(i < cut <= j for cut in track.cuts)]
    if not stretches:
        return Agreement(float(np.hypot(*np.diff(odometry[:, :2], axis=0).T).sum()), float(track.way[-1]))
    told = np.array([between(odometry[i], odometry[j]) for i, j in stretches])
    seen = np.array([between(track.poses[i], track.poses[j]) for i, j in stretches])
    motion_told, motion_seen = (way[:, 0] + 1j * way[:, 1] for way in (told, seen))
    length = np.abs(motion_told)
    # The robot may turn on the spot: such a stretch says nothing of the way.
    driven = length >= STRETCH / 2
    parted = np.abs(motion_seen - motion_told)[driven] > PARTED * length[driven] + ASIDE
    turned = np.abs(told[:, 2]) >= TURN
    ratios = [wrapped(float(b)) / a for a, b in zip(told[turned, 2], seen[turned, 2], strict=True)]
    return Agreement(
        odometry=float(length.sum()),
        scans=float(np.abs(motion_seen).sum()),
        angle=cmath.phase(complex((np.conj(motion_told) * motion_seen).sum())),
        turning=float(np.median(ratios)) if len(ratios) >= LEAST_TURNS else None,
        parted=int(parted.sum()),
        of=len(parted),
    )


def disagreement(log: RobotLog, track: Track) -> str | None:
    """Say that the way by scans is not the way by odometry.

    Args:
        log: The scans and where the odometer was at each.
        track: Where the robot was at each scan, by matching scans.

    Returns:
        How they differ, with the likely causes and the options that mend them. None if they agree.
    """
    found = agreement(log, track)
    looks = None if found.has_other_turns else direction(log)
    if found.is_good and looks is None:
        return None
    laser = log.scans[0].laser
    differences = [f"{found.scans:.0f} m by scans, {found.odometry:.0f} m by odometry"]
    causes: list[str] = []
    if found.turning is not None and found.has_other_turns:
        differences.append(f"turns by scans are {found.turning:.2f} times those by odometry")
        fov = math.degrees(abs(laser.step)) * laser.steps
        if found.turning < 0:
            causes.append(f"the laser hangs upside down (--fov {-math.copysign(fov, laser.step):.0f})")
        elif fov / found.turning <= 360:
            causes.append(f"its beams cover about {fov / found.turning:.0f} degrees, not {fov:.0f} (--fov)")
    if found.is_askew:
        degrees, side = abs(math.degrees(found.angle)), "left" if found.angle > 0 else "right"
        differences.append(f"the direction by scans is {degrees:.0f} degrees to the {side} of that by odometry")
    if looks is not None:
        x, y, _ = laser.mount
        side = "left" if looks >= 0 else "right"
        causes.append(f"the laser looks {abs(looks):.0f} degrees to the {side} of straight ahead (--mount={x:g},{y:g},{looks:.0f})")
    if not causes:
        causes = [
            'a range that means "nothing came back" is read as a wall (--no-return, --zero-is)',
            "the laser sits or looks elsewhere on the robot (--mount)",
            "its field of view is another (--fov)",
        ]
    causes.append("the odometer jumps, slips or is out of scale")
    if found.parted:
        differences.append(f"they part in {found.parted} of {found.of} stretches of a metre")
    return (
        f"The way by scans is not the way by odometry: {'; '.join(differences)}. The map may be wrong. Likely causes: {'; '.join(causes)}."
    )


def direction(log: RobotLog) -> float | None:
    """Degrees to the left of straight ahead in which the laser seems to look.

    None if it looks as the log says, if the scans do not tell, or if there are several lasers.
    """
    mounts = {scan.laser.mount for scan in log.scans}
    if len(mounts) > 1:
        return None
    x, y, angle = mounts.pop()
    at, looks = complex(x, y), np.exp(1j * (angle + np.radians(TURNS)))
    distances = []
    for first, second in _pairs(log):
        dx, dy, turn = between(first.odometry, second.odometry)
        here, there = _points(first), _points(second)
        if not len(here) or not len(there):
            continue
        # From the laser of the second scan to its robot, to the robot of the first scan, and to its laser.
        moved = complex(dx, dy) + (at + there[:, None] * looks) * np.exp(1j * turn)
        seen = (moved - at) / looks
        tree = cKDTree(np.stack([here.real, here.imag], axis=-1))
        nearest, _ = tree.query(np.stack([seen.real, seen.imag], axis=-1), distance_upper_bound=MEET)
        distances.append(np.minimum(nearest, MEET).mean(axis=0))
    if len(distances) < PAIRS / 4:
        return None
    apart = np.mean(distances, axis=0)
    best = int(np.argmin(apart))
    if abs(TURNS[best]) < LEAST_TURN or apart[best] > CLOSER * float(apart[TURNS == 0][0]):
        return None
    return math.degrees(wrapped(angle + math.radians(TURNS[best])))


def _pairs(log: RobotLog) -> list[tuple[Scan, Scan]]:
    """Pairs of scans, so near each other that the odometer is right and that both see the same."""
    kept = moving(log.scans)
    pairs = []
    for i, scan in enumerate(kept):
        for later in kept[i + 1 : i + 10]:
            dx, dy, turn = between(scan.odometry, later.odometry)
            if math.hypot(dx, dy) >= GAP[0]:
                if math.hypot(dx, dy) < GAP[1] and abs(turn) < BEND_OF_PAIR:
                    pairs.append((scan, later))
                break
    return [pairs[i] for i in np.unique(np.linspace(0, len(pairs) - 1, min(PAIRS, len(pairs))).astype(int))]


def _points(scan: Scan) -> NDArray[np.complex128]:
    """What the beams of a scan met, seen from the laser, as complex numbers."""
    met = (scan.ranges > 0) & (scan.ranges < min(scan.laser.reach, NEAR))
    return np.asarray(scan.ranges[met] * np.exp(1j * scan.laser.bearings[met]))


def _stretches(odometry: Array) -> list[tuple[int, int]]:
    """The first and the last scan of each stretch of a way, whose poses are (n, 3)."""
    cuts, way, turned = [0], 0.0, 0.0
    steps = np.hypot(*np.diff(odometry[:, :2], axis=0).T)
    for i, (step, turn) in enumerate(zip(steps, np.diff(odometry[:, 2]), strict=True), 1):
        way, turned = way + step, turned + wrapped(turn)
        if way >= STRETCH or abs(turned) >= BEND:
            cuts.append(i)
            way, turned = 0.0, 0.0
    return list(pairwise(cuts))
