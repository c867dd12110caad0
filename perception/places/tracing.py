"""Turns the visits of a log into a trace.

A visit is a stay at a place. Each step of the trace has what the robot saw at a distinctive state
(a place and a heading there). The robot arrives with one heading and may leave with another. Turns
and travels connect steps. The star of a step is the ways out of its place, as directions relative
to its heading.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from perception.places.closures import DRIFT, NOISE, VisitMatch, uncertainty
from perception.places.distinctive import RIM, SMALL, Visit, Way, patches_of
from perception.places.local_map import CELL, PackedPatch
from perception.places.passages import Passages
from perception.places.track import Array, Track, covariance_turned, points_turned, wrapped
from perception.readers.scans import RobotLog
from ssh_abduction.data.odometry import (
    Closure,
    Covariance,
    Odometry,
    Pose,
    displacement_between,
    moved,
    radians_between,
)
from ssh_abduction.data.star import Gateway
from ssh_abduction.data.trace import Action, Step, Trace

Stop = tuple[Visit, Pose]  # a visit, and the pose of the robot in it
# How much two visits to one place differ: standard deviations of its middle, in metres, and of the
# direction of a way out, in radians (benchmarks/logs.md).
MIDDLE, DIRECTION = 0.15, 0.1
# A turn by less than this, in radians, goes straight on: it is no turn, and the visit has one step.
AHEAD = math.radians(15)
# Additional standard deviations of each displacement, beside those of scan matching, in metres and
# radians.
FLOOR = (0.02, 0.02, 0.002)
# Systematic relative error of the scale of a track of matched scans.
SCALE = 0.01
# Standard deviation of the bearing of a gateway, in degrees.
SPREAD = 16.0
# A course is at most this many metres away from its polygonal chain.
DETAIL = 0.1
# Directions to the left and to the right of a way out, relative to it, in radians.
SIDES = (math.pi / 2, -math.pi / 2)
# Bearings of an image: a beam in each degree, from the right (-90) to the left (90).
BEAMS = np.radians(np.arange(-90.0, 91.0))


def to_trace(
    log: RobotLog,
    track: Track,
    visits: Sequence[Visit],
    closings: Sequence[VisitMatch] = (),
    name: str | None = None,
) -> Trace:
    """Make the trace of a log, without views.

    There are one or two steps per visit. A step has an image, a star, the displacement from the
    previous step, and the next action.
    """
    steps: list[Step] = []
    last: Stop | None = None
    arrivals: list[tuple[int, float]] = []  # the first step of each visit, and its heading
    # For each visit with which another drive starts, the number of this drive.
    drives = {visit: drive for drive, visit in enumerate(starts_of_drives(track, visits), 2)}
    patches_of(visits)  # each visit has one
    passages = Passages(log, track)
    for number, visit in enumerate(visits):
        headings = _headings(visit, track)
        arrivals.append((len(steps), headings[0]))
        for heading in headings:
            pose = (float(visit.middle[0]), float(visit.middle[1]), heading)
            steps.append(_step(log, track, number, visit, pose, last))
            last = (visit, pose)
        if len(headings) > 1 and (turned := steps[-1].displacement) is not None:
            steps[-2] = replace(steps[-2], action=_turn(-math.degrees(turned[2]), visit))
        if number < len(visits) - 1:
            extra = dict(steps[-1].extra)
            if not track.cuts_between(visit.scan, visits[number + 1].scan):
                chain = _course(track, visit, visits[number + 1])
                ahead = points_turned(-headings[-1], chain[1:] - visit.middle)
                extra["course"] = [[round(x, 2), round(y, 2)] for x, y in ahead.tolist()]
                extra |= passages.along(chain, visit, visits[number + 1])
            onward = Action.of("travel")
            if drive := drives.get(number + 1):
                onward = Action(f"{name} part {drive}" if name else f"drive {drive}", "start")
            steps[-1] = replace(steps[-1], action=onward, extra=extra)
    return Trace(
        tuple(steps),
        name=name,
        odometry=Odometry(scale=SCALE, bend=DRIFT, offset=MIDDLE, facing=DIRECTION),
        extra={"beams": {"first": -90, "step": 1}},
        closures=tuple(closure_of(found, arrivals) for found in closings),
    )


def starts_of_drives(track: Track, visits: Sequence[Visit]) -> dict[int, int]:
    """Find the visits with which drives start, besides the first, and the scans at which they do.

    A drive starts where the robot may have been carried, and where the odometer jumped once.
    Several cuts between two visits are an odometer that stood still, and not a jump.
    """
    found = {}
    for number, (last, visit) in enumerate(pairwise(visits), 1):
        cuts = track.cuts_between(last.scan, visit.scan)
        begins = [cut for cut in cuts if cut in track.breaks] or (cuts if len(cuts) == 1 else [])
        if begins:
            found[number] = begins[-1]
    return found


def closure_of(found: VisitMatch, arrivals: Sequence[tuple[int, float]]) -> Closure:
    """Make a closure between the first steps of two visits from the match of the visits.

    `arrivals` has the first step of each visit, and its heading in radians.
    """
    (first, heading), (last, other) = arrivals[found.first], arrivals[found.last]
    later = (*found.match.shift, other + found.match.turn)
    x, y, turn = displacement_between((0.0, 0.0, heading), later)
    spread = [float(value**2) for value in NOISE]
    return Closure(
        first,
        last,
        (round(x, 4), round(y, 4), round(turn, 5)),
        ((spread[0], 0.0, 0.0), (0.0, spread[1], 0.0), (0.0, 0.0, spread[2])),
    )


def _headings(visit: Visit, track: Track) -> list[float]:
    """List the headings of a visit in radians: on arrival, and on departure if the robot turned.

    If the ways by which the robot came and left are both unknown, the list has the heading of the
    robot at the middle of the place.
    """
    came = [] if visit.arrived is None else [wrapped(visit.ways[visit.arrived].bearing + math.pi)]
    went = [] if visit.left is None else [visit.ways[visit.left].bearing]
    if came and went and radians_between(came[0], went[0]) < AHEAD:
        went = []
    return [*came, *went] or [float(track.poses[visit.scan, 2])]


def _step(
    log: RobotLog, track: Track, number: int, visit: Visit, pose: Pose, last: Stop | None
) -> Step:
    """Make one step, without its action.

    The displacement leads from the pose of the `last` step, unless the track is cut between.
    """
    assert visit.patch is not None
    onward = covariance = None
    cuts = [] if last is None else track.cuts_between(last[0].scan, visit.scan)
    if last is not None and not cuts:
        x, y, turn = displacement_between(last[1], pose)
        onward = round(x, 4), round(y, 4), round(turn, 5)
        covariance = _covariance(track, last[0].scan, visit.scan, last[1], pose)
    scan = log.scans[visit.scan]
    extra: dict[str, object] = {"scan": visit.scan, "visit": number}
    extra["radius"] = round(visit.radius, 2)
    if scan.time is not None:
        extra["time"] = scan.time
    if cuts:  # They explain why there is no displacement.
        extra["cuts"] = cuts
    if visit.ways:
        extra["branches"] = _branches(visit, visit.patch, pose[2])
    truth = None
    seen = displacement_between(track.pose(visit.scan), pose)
    extra["seen"] = [round(x, 4) for x in seen]
    if scan.corrected is not None:
        truth = {"pose": [round(x, 4) for x in moved(scan.corrected, seen)]}
    # The ranges that a laser in the middle of the place would measure: (181,), metres.
    image, _ = _free_along(visit.patch, visit.middle, pose[2] + BEAMS)
    return Step(
        image=tuple(round(metres, 3) for metres in image.tolist()),
        star=_star(visit, pose[2]),
        displacement=onward,
        covariance=covariance,
        truth=truth,
        extra=extra,
    )


def _course(track: Track, first: Visit, last: Visit) -> Array:
    """The course of the robot from one visit to the next: (n, 2) metres, from middle to middle.

    It is a polygonal chain in the frame of the track. The discs of both places are left out.
    """
    from skimage.measure import approximate_polygon

    way = track.poses[first.scan : last.scan + 1, :2]
    left, come = (
        np.flatnonzero(np.hypot(*(way - visit.middle).T) > visit.radius) for visit in (first, last)
    )
    part = way[left[0] : come[-1] + 1] if len(left) and len(come) else way[:0]
    return np.asarray(approximate_polygon(np.array([first.middle, *part, last.middle]), DETAIL))


def _star(visit: Visit, heading: float) -> tuple[Gateway, ...]:
    """Make the star of a place as seen with a heading, clockwise from the back."""
    return tuple(
        Gateway(
            round(-math.degrees(wrapped(way.bearing - heading)), 1),
            SPREAD,
            open=True if way.sure else None,
        )
        for way in _clockwise(visit, heading)
    )


def _clockwise(visit: Visit, heading: float) -> list[Way]:
    """The ways out of a place, clockwise from behind a robot with a heading in radians."""
    return sorted(visit.ways, key=lambda way: (-wrapped(way.bearing - heading), way.sure))


def _branches(visit: Visit, patch: PackedPatch, heading: float) -> list[dict[str, object]]:
    """Describe the ways out of a place in its local map, in the order of its star.

    `width` is the free space across a way where it leaves the disc, and `length` how far the space
    is free from the middle, in metres. `end_seen` says whether an obstacle ends it there.
    """
    bearings = np.array([way.bearing for way in _clockwise(visit, heading)])
    ahead = np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
    middles = np.broadcast_to(visit.middle, ahead.shape)
    rims = middles + (max(visit.radius, SMALL) + RIM) * ahead
    lengths, ends = _free_along(patch, middles, bearings)
    left, right = (_free_along(patch, rims, bearings + side)[0] for side in SIDES)
    return [
        {"width": round(width, 2), "length": round(length, 2), "end_seen": end_seen}
        for width, length, end_seen in zip(
            (left + right).tolist(), lengths.tolist(), ends.tolist(), strict=True
        )
    ]


def _free_along(
    patch: PackedPatch, starts: Array, bearings: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """How far the space of a local map is free from points in some directions, (k,) in metres.

    `starts` is one point, (2,), or a point for each of the k bearings, (k, 2). Also return whether
    an obstacle ends the free space, (k,). Otherwise the space beyond was not seen.
    """
    mask, occupied = patch.free, np.pad(patch.occupied, 1)
    far = np.arange(0.0, min(mask.shape) * CELL / 2, CELL / 2)
    ahead = np.stack([np.cos(bearings), np.sin(bearings)], axis=1)
    points = np.atleast_2d(starts)[:, None, :] + far[None, :, None] * ahead[:, None, :]
    cells = np.rint((points - patch.corner) / CELL).astype(int)
    inside = ((cells >= 0) & (cells < mask.shape)).all(axis=2)
    cells = np.clip(cells, 0, np.array(mask.shape) - 1)
    free = mask[cells[..., 0], cells[..., 1]] & inside
    free[:, :4] = True  # The point itself, within two cells, counts as free.
    end = np.where(free.all(axis=1), len(far) - 1, np.argmin(free, axis=1))
    rows, columns = cells[np.arange(len(end)), end].T
    near = [occupied[rows + row, columns + column] for row in range(3) for column in range(3)]
    return far[end], np.any(near, axis=0) & ~free.all(axis=1)


def _covariance(track: Track, begin: int, end: int, first: Pose, last: Pose) -> Covariance:
    """The covariance of the displacement between two steps, in the frame of the first step."""
    total = uncertainty(track, begin, end, np.array(last[:2]))
    found = covariance_turned(-first[2], total) + np.diag(FLOOR) ** 2
    found = (found + found.T) / 2
    return tuple(tuple(round(float(v), 8) for v in row) for row in found)  # type: ignore[return-value]


def _turn(clockwise: float, visit: Visit) -> Action:
    """The action of a turn at a visit by an angle in degrees."""
    if visit.arrived == visit.left:
        return Action.of("around")
    degrees = round(clockwise % 360, 1)
    return Action(f"turn {degrees:g}", "turn", "right" if degrees < 180 else "left")
