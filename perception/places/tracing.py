"""Turns the visits of a log into a trace.

A visit is a stay at a place. Each step of the trace has what the robot saw at a distinctive state
(a place and a heading there). Turns and travels connect steps. The star of a step is the exits seen
at its place, as directions relative to its heading.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from perception.places.distinctive import Visit, Way
from perception.places.gateways import apart
from perception.places.local_map import CELL, LocalMaps, Patch
from perception.places.scale import Scale
from perception.places.track import Array, Track, wrapped
from perception.readers.scans import Pose, RobotLog
from ssh_abduction.data.odometry import Covariance, Odometry, between, moved
from ssh_abduction.data.star import Gateway
from ssh_abduction.data.trace import Action, Step, Trace

QUARTER = math.pi / 2
# An exit is at right angles to the walls if it is off by less than this, in radians.
OFF = math.radians(27)
# A building has right angles if this share of the exits that the robot took fit them.
RIGHT = 0.85
# Smallest agreement of the walls around a visit for their direction to be used.
AGREE = 0.2
# Standard deviations between two visits of the middle of a place, in metres, and of the direction
# of an exit, in radians.
MIDDLE, DIRECTION = 0.4, 0.1
# The same deviations if places are doors: those of the middle of a door, which is seen more
# exactly, and of the direction from one door to the next.
THRESHOLD, ACROSS = 0.05, 0.05
# Additional standard deviations of each displacement, beside those of scan matching, in metres and
# radians.
FLOOR = (0.02, 0.02, 0.002)
# Systematic errors of a track of matched scans: relative error of the scale, and drift of the
# heading in radians a metre.
SCALE, DRIFT = 0.01, 0.0003
# Standard deviation of the bearing of a gateway, in degrees.
SPREAD = 16.0
# A turn by less than this, in radians, goes straight on.
AHEAD = math.radians(35)
# Bearings of an image: a beam in each degree, from the right (-90) to the left (90).
BEAMS = np.radians(np.arange(-90.0, 91.0))


def has_right_angles(visits: Sequence[Visit]) -> bool:
    """Check whether most exits that the robot took are parallel or at right angles to the walls."""
    taken = [
        abs(_off(visit.ways[k].bearing - visit.axis, QUARTER)) < OFF
        for visit in visits
        for k in (visit.arrived, visit.left)
        if k is not None
    ]
    return bool(taken) and sum(taken) / len(taken) >= RIGHT


def to_trace(
    log: RobotLog, track: Track, scale: Scale, visits: Sequence[Visit], name: str | None = None
) -> Trace:
    """Make the trace of a log, without views.

    Args:
        log: The scans.
        track: Their poses.
        scale: Scale of the building.
        visits: The visits, in order.
        name: Name of the trace.

    Returns:
        A trace with one or two steps a visit. A step has an image, the displacement from the
        previous step, the next action and, unless places are doors, a star.
    """
    # Exits are rounded to multiples of the stride, in radians. Paths from door to door have any
    # direction.
    stride = None if scale.doors else QUARTER if has_right_angles(visits) else QUARTER / 2
    if stride is not None:
        visits = _aligned(visits, stride)
    maps = LocalMaps(log.scans, track, scale.window)
    steps: list[Step] = []
    last: tuple[Visit, Pose] | None = None
    for number, visit in enumerate(visits):
        # Make a step for the heading of arrival, and another one if the robot leaves with a
        # different heading.
        patch = maps.around(visit.scan, visit.middle, scale.half)
        came = (
            None if visit.arrived is None else wrapped(visit.ways[visit.arrived].bearing + math.pi)
        )
        went = None if visit.left is None else visit.ways[visit.left].bearing
        # If the visit has neither arrival nor departure, take the heading of the robot.
        headings = [heading for heading in (came, went) if heading is not None] or [
            float(track.poses[visit.scan, 2])
        ]
        if len(headings) == 2 and apart(*headings) < AHEAD and stride is not None:
            headings = headings[:1]
        for heading in headings:
            pose = (float(visit.middle[0]), float(visit.middle[1]), heading)
            steps.append(_step(log, track, visit, pose, patch, last, stride, number))
            last = (visit, pose)
        if steps and number < len(visits) - 1:
            carried = track.span_of(visit.scan) != track.span_of(visits[number + 1].scan)
            steps[-1] = replace(
                steps[-1],
                action=Action.that_slipped(len(steps) - 1) if carried else Action.of("travel"),
            )
    steps = _with_turns(steps, stride, visits)
    return Trace(
        tuple(steps),
        name=name,
        odometry=Odometry(
            scale=SCALE,
            bend=DRIFT,
            offset=THRESHOLD if scale.doors else MIDDLE,
            facing=ACROSS if scale.doors else DIRECTION,
        ),
        extra={"beams": {"first": -90, "step": 1}, "right_angles": stride == QUARTER},
    )


def _step(
    log: RobotLog,
    track: Track,
    visit: Visit,
    pose: Pose,
    patch: Patch,
    last: tuple[Visit, Pose] | None,
    stride: float | None,
    number: int,
) -> Step:
    """Make one step, without its action.

    Args:
        log: The scans.
        track: Their poses.
        visit: Visit that the step belongs to.
        pose: Pose of the step, at the middle of the place.
        patch: Local map around the middle.
        last: Visit and pose of the last step; None for the first step. The displacement leads from
            this pose, unless the track is cut between.
        stride: Angle in radians that exits are rounded to; None if places are doors.
        number: Index of the visit.
    """
    onward = covariance = None
    cuts = [] if last is None else track.cuts_between(last[0].scan, visit.scan)
    if last is not None and not cuts:
        onward = between(last[1], pose)
        covariance = _covariance(track, last[0].scan, visit.scan, last[1], pose)
    scan = log.scans[visit.scan]
    extra: dict[str, object] = {"scan": visit.scan, "visit": number}
    if scan.time is not None:
        extra["time"] = scan.time
    if cuts:  # They explain why there is no displacement.
        extra["cuts"] = cuts
    truth = None
    seen = between(_pose(track, visit.scan), pose)
    extra["seen"] = [round(x, 4) for x in seen]
    if scan.corrected is not None:
        truth = {"pose": [round(x, 4) for x in moved(scan.corrected, seen)]}
    return Step(
        image=tuple(round(float(r), 3) for r in _image(patch, visit.middle, pose[2])),
        star=None if stride is None else _star(visit, pose[2], stride),
        displacement=None
        if onward is None
        else (round(onward[0], 4), round(onward[1], 4), round(onward[2], 5)),
        covariance=covariance,
        truth=truth,
        extra=extra,
    )


def _aligned(visits: Sequence[Visit], stride: float) -> list[Visit]:
    """Round the bearing of each exit to a multiple of an angle, counted from the walls.

    So an exit has the same bearing at each visit. An exit that is far from all multiples becomes
    uncertain. If the walls at a visit show no clear direction, that of the previous visit is used.

    Args:
        visits: The visits, in order.
        stride: The angle, in radians.
    """
    aligned: list[Visit] = []
    axis = next((visit.axis for visit in visits if visit.straight >= AGREE), 0.0)
    count = round(2 * math.pi / stride)
    for visit in visits:
        # Walls show the axis only up to quarter turns. Take the one nearest to the last axis, so
        # that the axis does not jump.
        here = visit.axis if visit.straight >= AGREE else axis
        axis = axis + _off(here - axis, QUARTER)
        ways: dict[int, Way] = {}
        number: dict[int, int] = {}
        for k, way in enumerate(visit.ways):
            slot = round((way.bearing - axis) / stride) % count
            sure = way.sure and (
                abs(_off(way.bearing - axis, stride)) < OFF or k in (visit.arrived, visit.left)
            )
            ways[slot] = Way(
                wrapped(axis + slot * stride), sure or (slot in ways and ways[slot].sure)
            )
            number[k] = slot
        order = sorted(ways)
        aligned.append(
            replace(
                visit,
                ways=tuple(ways[slot] for slot in order),
                arrived=None if visit.arrived is None else order.index(number[visit.arrived]),
                left=None if visit.left is None else order.index(number[visit.left]),
                axis=axis,
            )
        )
    return aligned


def _off(angle: float, stride: float) -> float:
    """Signed difference of an angle from the nearest multiple of a stride."""
    return (angle + stride / 2) % stride - stride / 2


def _pose(track: Track, scan: int) -> Pose:
    x, y, heading = track.poses[scan]
    return float(x), float(y), float(heading)


def _star(visit: Visit, heading: float, stride: float) -> tuple[float | Gateway | None, ...]:
    """The exits of a visit as seen with a heading, clockwise.

    Returns:
        With a stride of a quarter turn, four numbers, for ahead, right, behind and left: 1 for an
        exit, 0 for none, None for an uncertain exit. Otherwise gateways with bearings in degrees.
    """
    seen = [(-math.degrees(wrapped(way.bearing - heading)), way.sure) for way in visit.ways]
    if stride == QUARTER:
        quarters = {round(bearing / 90) % 4: sure for bearing, sure in seen}
        return tuple((1 if quarters[k] else None) if k in quarters else 0 for k in range(4))
    return tuple(
        Gateway(round(bearing, 1), SPREAD, open=True if sure else None)
        for bearing, sure in sorted(seen)
    )


def _image(patch: Patch, middle: Array, heading: float) -> Array:
    """The ranges that a laser in the middle of a place would measure: (181,), metres."""
    far = np.arange(0.0, min(patch.free.shape) * CELL / 2, CELL / 2)
    angles = heading + BEAMS
    cells = np.rint(
        (
            middle
            + far[None, :, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)[:, None, :]
            - patch.corner
        )
        / CELL
    ).astype(int)
    inside = ((cells >= 0) & (cells < patch.free.shape)).all(axis=2)
    cells = np.clip(cells, 0, np.array(patch.free.shape) - 1)
    free = patch.free[cells[..., 0], cells[..., 1]] & inside
    # The middle itself counts as free.
    free[:, : round(2 * CELL / (CELL / 2))] = True
    return np.asarray(np.where(free.all(axis=1), far[-1], far[np.argmin(free, axis=1)]))


def _covariance(track: Track, begin: int, end: int, first: Pose, last: Pose) -> Covariance:
    """The covariance of the displacement between two steps, in the frame of the first.

    Args:
        track: Trajectory of the robot.
        begin: Scan of the first step.
        end: Scan of the last step.
        first: Pose of the first step.
        last: Pose of the last step.
    """
    if begin > end:
        begin, end = end, begin
    total = np.zeros((3, 3))
    x, y = last[0], last[1]
    for i in range(begin + 1, end + 1):
        pose = track.poses[i - 1]
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        # An error of this increment rotates and shifts all later poses. The last step moves as the
        # end of an arm that begins here.
        arm = np.array(
            [
                [cos, -sin, -(y - track.poses[i, 1])],
                [sin, cos, x - track.poses[i, 0]],
                [0.0, 0.0, 1.0],
            ]
        )
        total += arm @ track.covariances[i] @ arm.T
    turned = np.eye(3)
    cos, sin = math.cos(first[2]), math.sin(first[2])
    turned[:2, :2] = [[cos, sin], [-sin, cos]]
    found = turned @ total @ turned.T
    found += np.diag(FLOOR) ** 2
    found = (found + found.T) / 2
    return tuple(tuple(round(float(v), 8) for v in row) for row in found)  # type: ignore[return-value]


def _with_turns(steps: list[Step], stride: float | None, visits: Sequence[Visit]) -> list[Step]:
    """Add the turns between two steps of a visit.

    Args:
        steps: The steps. Those that end with a travel have their action.
        stride: Angle in radians that turns are rounded to; None if places are doors, so that turns
            may have any angle.
        visits: The visits.
    """
    done = list(steps)
    for i, step in enumerate(steps[:-1]):
        if step.action is None:
            turned = steps[i + 1].displacement
            assert turned is not None
            visit = visits[int(step.extra["visit"])]
            clockwise = -math.degrees(turned[2])
            done[i] = replace(
                step,
                action=_any_turn(clockwise, visit.arrived == visit.left)
                if stride is None
                else _turn(clockwise, stride),
            )
    return done


def _turn(clockwise: float, stride: float) -> Action:
    """The action of a turn, rounded to the nearest multiple of a stride.

    Args:
        clockwise: Angle of the turn in degrees.
        stride: Angle in radians.
    """
    rounded = round(clockwise / math.degrees(stride)) * round(math.degrees(stride)) % 360
    names = {90: "right", 180: "around", 270: "left"}
    if rounded in names:
        return Action.of(names[rounded])
    return Action(
        f"turn {rounded}", "turn", "right" if rounded < 180 else "left", bearing=float(rounded)
    )


def _any_turn(clockwise: float, back: bool) -> Action:
    """The action of a turn in a building whose places are doors.

    Args:
        clockwise: Angle of the turn in degrees.
        back: Whether the robot leaves by the exit of arrival. Then the action is "around".
    """
    if back:
        return Action.of("around")
    degrees = round(clockwise % 360, 1)
    return Action(f"turn {degrees:g}", "turn", "right" if degrees < 180 else "left")
