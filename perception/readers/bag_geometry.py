"""Where the beams of a bag's scans point: the angles of messages, and lasers that are tilted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perception.errors import LogError
from perception.readers.scans import Array, Damaged
from ssh_abduction.data.odometry import Pose

# A full turn with 1 % for rounding, and the least field of view that is believed in degrees.
FULL, LEAST_DEGREES = 1.01 * math.tau, 30.0
# Which angles of a message may be in degrees, in the order in which they are tried.
ANGLES = ("min", "max", "increment")
DEGREES = tuple(which for count in range(4) for which in combinations(ANGLES, count))
SAY_FOV = "say what the beams cover: --set fov=DEGREES"
# Two statements of a field of view agree if they differ by at most this share, or two steps.
SAME_SHARE = 0.03
# Tilts in degrees: up to LEVEL they change nothing; beyond STEEP a laser shows no floor plan.
LEVEL, STEEP = 2.0, 45.0
# Neighbouring beams see one surface if their distances differ by less than this factor.
ONE_SURFACE = 1.5
# The highest beams end at a ceiling if SPIKE times as many end within FLOOR metres of it as in an
# equally wide band below, and it is at least ROOM metres above the floor: a laser that rolls sees
# a wall beside it at one height, too. It is judged from LEAST_ENDS beams on.
SPIKE, ROOM, LEAST_ENDS = 5, 1.9, 50
# A beam meets the floor if it ends at most this many metres above it. Beams that end more than
# BELOW metres below the floor contradict the tilt if they are more than the share MANY_BELOW of
# those that look at the floor. But if the share ON_FLOOR of them ends at one height, within FLOOR
# metres, then the floor is there.
FLOOR, BELOW, MANY_BELOW, ON_FLOOR = 0.05, 0.1, 0.1, 0.6


def ranges_of(message: Any) -> Array:
    """Return the ranges of a scan, or the first echoes. A beam without an echo met nothing."""
    beams = message.ranges
    if len(beams) and hasattr(beams[0], "echoes"):
        beams = [beam.echoes[0] if len(beam.echoes) else np.inf for beam in beams]
    return np.array(beams, dtype=np.float64)


def angles_of(message: Any, fov: float | None = None) -> tuple[float, float, str | None]:
    """Return the first angle and the step of a scan in radians, and a note if they are doubtful.

    The number of ranges, angle_increment, and angle_min with angle_max should agree. They are
    tried in radians and degrees. `fov` is the field of view in degrees according to the user.
    Raises Damaged if they make no sense.
    """
    first, last, step = map(float, (message.angle_min, message.angle_max, message.angle_increment))
    count, degree, lost = len(message.ranges), math.pi / 180, ""
    steps = max(count - 1, 1)
    # The other two angles show one that is missing.
    if not math.isfinite(first):
        first, lost = last - step * steps, "angle_min"
    elif not step or not math.isfinite(step):
        step, lost = (last - first) / steps or math.nan, "angle_increment"
    by_step, by_ends = abs(step) * steps, abs(last - first)
    for which in DEGREES:
        low, high, increment = (
            value * degree if name in which else value
            for name, value in zip(ANGLES, (first, last, step), strict=True)
        )
        one, other = abs(increment) * steps, abs(high - low)
        near = max(2 * abs(increment), SAME_SHARE * one)
        least = LEAST_DEGREES * degree if which else 0.0
        # An end that makes sense in radians is not in degrees.
        ends = ("min", first), ("max", last)
        is_sensible = any(name in which and 0 < abs(end) <= FULL for name, end in ends)
        if is_sensible or abs(one - other) > near or not least <= one <= FULL:
            continue
        listed, note = ", ".join(f"angle_{name}" for name in which), None
        if lost:
            note = (
                f"The angles of the scans lack {lost}. By the others, the beams are taken to cover "
                f"{math.degrees(one):.0f} degrees. If that is wrong, {SAY_FOV}."
            )
        elif which:
            note = f"The angles of the scans are in degrees (read so: {listed}): write radians."
        if (high - low) / increment < -2:
            low, increment = min(low, high), abs(increment)
            note = (
                "The angles of the scans contradict each other: angle_increment leads from "
                "angle_min away from angle_max. The beams are taken to turn counterclockwise. If "
                f"they turn clockwise, say --set fov=-{math.degrees(one):.0f}."
            )
        return low, increment, note
    # They contradict each other. Lasers look as far to the left as to the right.
    is_known = math.isfinite(last) and last != first
    told = f"{count} ranges with the angle_increment cover {math.degrees(by_step):.0f} degrees" + (
        f", but angle_min to angle_max are {math.degrees(by_ends):.0f}" if is_known else ""
    )
    askew = abs(first + last) - abs(2 * first + step * steps)
    if fov is not None:
        askew = abs(math.degrees(by_ends) - abs(fov)) - abs(math.degrees(by_step) - abs(fov))
    if by_step <= FULL and not is_known:
        return first, step, None
    if is_known and by_ends <= FULL and (by_step > FULL or askew < 0):
        step, used = math.copysign(by_ends / steps, step), "angle_max"
    elif by_step <= FULL:
        used = "the angle_increment"
    elif fov is not None:
        return -abs(fov) * degree / 2, abs(fov) * degree / steps, None
    else:
        raise Damaged(f"expected beams over at most 360 degrees, got {told}; {SAY_FOV}")
    note = (
        f"The angles of the scans contradict each other: {told}. By {used}, the beams are taken to "
        f"cover {math.degrees(abs(step)) * steps:.0f} degrees. If that is wrong, {SAY_FOV}."
    )
    return first, step, note


@dataclass(frozen=True)
class Mount:
    """Where a laser is on the robot."""

    pose: Pose = (0.0, 0.0, 0.0)  # in the plane, in the frame of the robot
    is_flipped: bool = False  # whether it hangs upside down, so that its beams turn clockwise
    # Rotation of a tilted laser in the frame of the robot, three rows; empty for a level one.
    rotation: tuple[tuple[float, ...], ...] = ()
    height: float = 0.0  # of a tilted laser above the floor, in metres
    ceiling: float = math.inf  # height of the ceiling above the floor, in metres

    @property
    def tilt(self) -> float:
        """The angle in degrees between the plane of the beams and the floor, at most 90."""
        return math.degrees(math.acos(min(1.0, abs(self.rotation[2][2])))) if self.rotation else 0.0

    def rays(self, first: float, step: float, beams: int) -> Array:
        """The directions of the beams in the frame of the robot: (3, beams)."""
        angles = first + step * np.arange(beams)
        flat = np.stack([np.cos(angles), np.sin(angles), np.zeros(beams)])
        return np.asarray(np.array(self.rotation) @ flat)

    def levelled(self, ranges: Array, first: float, step: float, reach: float) -> Array:
        """Project ranges, (beams,), of a tilted laser to the plane.

        Between two beams that see one surface, a bearing gets its distance on the line between
        their ends; otherwise that of the nearest beam. The nearest beam alone would give walls
        steps that move along with the robot. Ranges are minus infinity (unknown) where no beam
        points, and where a beam meets the floor or the ceiling.
        """
        level = _levelling(self, first, step, len(ranges))
        ranges = np.where(ranges >= reach, np.inf, ranges)
        with np.errstate(invalid="ignore", divide="ignore"):
            ends = self.height + np.minimum(ranges, reach) * level.up
            met = (level.up < 0) & (ends <= FLOOR) | (level.up > 0) & (ends >= self.ceiling - FLOOR)
            flat = np.where(met, -np.inf, ranges * level.flat)
            near, other = flat[level.nearest], flat[level.other]
            far = np.maximum(near, other)
            between = level.weights[0] / near + level.weights[1] / other
            on_one = (np.minimum(near, other) > far / ONE_SURFACE) & np.isfinite(far)
            found = np.where(on_one & (between > 0), 1 / between, near)
        return np.asarray(np.where(level.is_seen, found, -np.inf))


@dataclass(frozen=True, eq=False)
class _Levelling:
    """How the beams of a tilted laser lie above the bearings of the projected scan."""

    flat: Array  # (beams,) the way along the floor of a beam, as a share of its length
    up: Array  # (beams,) the way up of a beam, as a share of its length
    nearest: NDArray[np.intp]  # (beams,) the nearest beam to each bearing
    other: NDArray[np.intp]  # (beams,) the nearest beam on the other side of the bearing
    is_seen: NDArray[np.bool_]  # (beams,) whether a beam points at the bearing, or nearly so
    # (2, beams): the sum of these shares of the inverse distances of `nearest` and `other` is the
    # inverse distance of the line between their ends.
    weights: Array


@lru_cache(maxsize=64)
def _levelling(mount: Mount, first: float, step: float, beams: int) -> _Levelling:
    """Find the beams around each bearing."""
    rays = mount.rays(first, step, beams)
    side = -1.0 if mount.is_flipped else 1.0
    wished = side * (first + step * np.arange(beams)) + mount.pose[2]
    off = np.angle(np.exp(1j * (np.arctan2(rays[1], rays[0]) - wished[:, None])))
    rows = np.arange(beams)
    nearest = np.abs(off).argmin(axis=1)
    beyond = np.where(off * off[rows, nearest][:, None] < 0, np.abs(off), np.inf)
    other = beyond.argmin(axis=1)
    one, two = off[rows, nearest], off[rows, other]
    with np.errstate(invalid="ignore", divide="ignore"):
        weights = np.stack([np.sin(two), -np.sin(one)]) / np.sin(two - one)
    # Without a beam on the other side, the nearest one counts alone.
    weights[:, ~np.isfinite(beyond.min(axis=1)) | (np.abs(two - one) > 3 * abs(step))] = np.nan
    seen = np.abs(one) <= abs(step)
    return _Levelling(np.hypot(rays[0], rays[1]), rays[2], nearest, other, seen, weights)


def believed(
    mount: Mount, scans: Sequence[Any], frame: str, source: str, is_told: bool, notes: list[str]
) -> Mount:
    """Check the tilt of a laser by some of its messages, and note what is done about it.

    If the user tells the mount (`is_told`), or the ranges contradict the tilt, the laser counts as
    level. Raises LogError if the laser is too steep.
    """
    tilt = mount.tilt
    level = Mount(mount.pose, mount.is_flipped)
    if tilt <= LEVEL or is_told:
        return level
    said = f"{tilt:.3g} degrees by the transforms to its frame {frame}"
    if tilt > STEEP:
        raise LogError(
            f"{source}: expected a laser that is tilted by at most {STEEP:.0f} degrees, got "
            f"{said}; mend the transforms, or say where it sits (--set mount=X,Y,DEGREES)"
        )
    ends, tops = [np.zeros(0)], [np.zeros(0)]
    for message in scans:
        first, step, _ = angles_of(message)
        ranges = ranges_of(message)
        up = mount.rays(first, step, len(ranges))[2]
        seen = (ranges > 0) & (ranges < message.range_max)
        ends.append((mount.height + ranges * up)[seen & (mount.height < -message.range_max * up)])
        tops.append((ranges * up)[seen & (up > 0)])
    heights, above = np.concatenate(ends), np.concatenate(tops)
    below = heights[heights < -BELOW]
    if len(below) > MANY_BELOW * len(heights):
        floor = float(np.median(below))
        if (np.abs(below - floor) <= FLOOR).mean() < ON_FLOOR:
            notes.append(
                f"The laser is tilted by {said}, but {100 * len(below) / len(heights):.0f} % of "
                "the beams that look at the floor would end below it. So the transforms are not "
                "believed, and the laser is taken to be level. Mend the transforms, or say where "
                "the laser sits: --set mount=X,Y,DEGREES."
            )
            return level
        mount = replace(mount, height=mount.height - floor)
        heights = heights - floor
    met = 100 * float((heights <= FLOOR).mean()) if len(heights) else 0.0
    mount = replace(mount, ceiling=_ceiling(mount.height + above))
    also = f" or the ceiling {mount.ceiling:.1f} m above it" if mount.ceiling < math.inf else ""
    notes.append(
        f"The laser is tilted by {said}. Its ranges are projected to the floor plane, and beams "
        f"that meet the floor ({met:.0f} % of those that look at it){also} count as unknown. If it "
        "is level, say where it sits: --set mount=X,Y,DEGREES."
    )
    return mount


def _ceiling(heights: Array) -> float:
    """Return the height of the ceiling; infinity if no ceiling shows.

    `heights`, in metres above the floor, are those at which the beams that look up end.
    """
    if len(heights) < LEAST_ENDS:
        return math.inf
    top = float(np.percentile(heights, 99.9))
    top = float(np.median(heights[np.abs(heights - top) <= FLOOR]))
    at, below = (int((np.abs(heights - z) <= FLOOR).sum()) for z in (top, top - 2 * FLOOR))
    return top if top >= ROOM and at > SPIKE * max(below, 1) else math.inf
