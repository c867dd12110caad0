"""Finds closures: pairs of visits whose local maps match, and how they lie relative to each other.

Two places may look alike. So a match counts only if the track allows it: its pose has to agree with
the track within ten times the covariance of the track, for some steady drift of the heading. A
match that counts says how far apart two visits are. It does not say that they are to one place.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from perception.places.local_map import Patch
from perception.places.matching import MOST, Match, Scene, Turned, match
from perception.places.track import Array, Track, wrapped
from perception.places.visits import Visit

# A match is reliable with at least this score and share of area that both maps observed.
SCORE, MUTUAL = 0.75, 0.5
# Standard deviations of a reliable match, in metres and radians (docs/measurements/logs.md).
NOISE = (0.1, 0.1, math.radians(1))
# The covariance of the track is multiplied by INFLATED. The drifts are multiples of BEND up to
# BENDS times it, in radians a metre. A match may be off by a chi-square of GATE (3 degrees of
# freedom).
INFLATED, BEND, BENDS, GATE = 10.0, 2e-4, 10, 20.0
# Rotations are tried in steps of TURN radians, from the least to the largest that the track allows
# within SIGMAS standard deviations.
TURN, SIGMAS = math.radians(6), 3.0
# Each visit has at most this many closures with earlier ones: those with the best scores.
KEPT = 2


@dataclass(frozen=True, eq=False)
class Closing:
    """A reliable match of two visits.

    Attributes:
        first: Index of the earlier visit.
        last: Index of the later visit.
        match: How the later middle lies relative to the earlier one.
    """

    first: int
    last: int
    match: Match


def find_closures(
    track: Track, visits: Sequence[Visit], patches: Sequence[Patch], apart: float
) -> list[Closing]:
    """Find the closures between the visits of a log.

    Args:
        track: Trajectory of the robot.
        visits: The visits, in order.
        patches: The local map around the middle of each visit.
        apart: Two visits are matched if there are at least this many metres of way between them, so
            that their local maps share no scans.
    """
    scenes = [Scene.of(patch, visit.middle) for visit, patch in zip(visits, patches, strict=True)]
    found: list[Closing] = []
    for last, gates in enumerate(_gates(track, visits)):
        way = track.way[visits[last].scan] - apart
        asked = [(first, gate) for first, gate in gates if track.way[visits[first].scan] < way]
        here = sorted(_closings(scenes, asked, last), key=lambda closing: -closing.match.score)
        found += here[:KEPT]
    return found


def _closings(
    scenes: Sequence[Scene], asked: Sequence[tuple[int, _Gate]], last: int
) -> Iterator[Closing]:
    """Match a visit with earlier ones.

    Args:
        scenes: The local map of each visit.
        asked: The earlier visits to try, each with what the track says.
        last: Index of the visit.
    """
    turns = [gate.turns for _, gate in asked]
    begin = min((some.start for some in turns), default=0)
    end = max((some.stop for some in turns), default=0)
    # The visit is rotated once, for all the earlier visits.
    turned = Turned.of(scenes[last], [k * TURN for k in range(begin, end)])
    for (first, gate), some in zip(asked, turns, strict=True):
        found = match(scenes[first], turned.part(some.start - begin, some.stop - begin))
        if found is not None and is_reliable(found) and gate.allows(found):
            yield Closing(first, last, found)


def is_reliable(found: Match) -> bool:
    return found.score >= SCORE and found.mutual >= MUTUAL


@dataclass(frozen=True, eq=False)
class _Gate:
    """What the track says about how one visit lies relative to an earlier one.

    Attributes:
        poses: (d, 3) x, y and rotation of the later visit, by the axes of the earlier one, for each
            drift of the heading.
        covariance: (3, 3), inflated.
    """

    poses: Array
    covariance: Array

    @property
    def turns(self) -> range:
        """Rotations to try, those that the track allows: k for k times TURN."""
        margin = SIGMAS * math.sqrt(self.covariance[2, 2])
        least, most = self.poses[:, 2].min() - margin, self.poses[:, 2].max() + margin
        first, last = math.floor(least / TURN), math.ceil(most / TURN)
        if last - first >= math.tau / TURN:
            first, last = 0, round(math.tau / TURN) - 1
        return range(first, last + 1)

    def allows(self, found: Match) -> bool:
        """Whether a match agrees with the track for some drift."""
        off = self.poses - (*found.shift, found.turn)
        off[:, 2] = (off[:, 2] + math.pi) % math.tau - math.pi
        inverse = np.linalg.inv(self.covariance + np.diag(NOISE) ** 2)
        return bool(np.einsum("di,ij,dj->d", off, inverse, off).min() < GATE)


def _gates(track: Track, visits: Sequence[Visit]) -> Iterator[list[tuple[int, _Gate]]]:
    """For each visit, the earlier visits that may be near, each with what the track says.

    No gate leads across a cut of the track, where the motion is unknown.
    """
    drifts = BEND * np.arange(-BENDS, BENDS + 1)
    way = track.way[[visit.scan for visit in visits]]
    middles = np.array([visit.middle for visit in visits])
    poses = np.array([_drifted(middles, way, drift) for drift in drifts])
    covariances, begin = np.zeros((0, 3, 3)), 0  # of the visits since the last cut
    for last, visit in enumerate(visits):
        if last and track.cuts_between(visits[last - 1].scan, visit.scan):
            covariances, begin = covariances[:0], last
        elif last:
            covariances = _carried(covariances, track, visits[last - 1], visit)
        # The pose by the axes of each earlier visit, for each drift: (drifts, visits, 3).
        turn = poses[:, begin:last, 2]
        cos, sin = np.cos(turn), np.sin(turn)
        x, y = np.moveaxis(poses[:, last, None, :2] - poses[:, begin:last, :2], 2, 0)
        turned = poses[:, last, None, 2] - turn
        there = np.stack([cos * x + sin * y, cos * y - sin * x, turned], axis=2)
        spreads = INFLATED * covariances
        # Any shift that a match can have is allowed for the visits that are near.
        far = np.hypot(there[..., 0], there[..., 1]).min(axis=0) - MOST
        near = far <= SIGMAS * np.sqrt(np.linalg.eigvalsh(spreads[:, :2, :2])[:, 1])
        yield [(begin + k, _Gate(there[:, k], spreads[k])) for k in np.flatnonzero(near).tolist()]


def _drifted(middles: Array, way: Array, drift: float) -> Array:
    """The middles of visits, if the heading of the track drifts steadily.

    Args:
        middles: (n, 2) middles in metres, by the track.
        way: (n,) metres driven at each visit.
        drift: The drift to remove, in radians a metre.

    Returns:
        (n, 3) x, y and rotation of the axes.
    """
    turn = -drift * (way - way[0])
    halfway = (turn[1:] + turn[:-1]) / 2
    x, y = np.diff(middles, axis=0).T
    cos, sin = np.cos(halfway), np.sin(halfway)
    steps = np.stack([cos * x - sin * y, sin * x + cos * y], axis=1)
    places = np.concatenate([middles[:1], middles[0] + np.cumsum(steps, axis=0)])
    return np.column_stack([places, turn])


def _carried(covariances: Array, track: Track, before: Visit, visit: Visit) -> Array:
    """The covariances of the next visit relative to each earlier one, by the axes of the track.

    Args:
        covariances: (n, 3, 3) those of the visit before.
        track: Trajectory of the robot.
        before: The visit before.
        visit: The next visit.

    Returns:
        (n + 1, 3, 3); the last one is relative to the visit before.
    """
    onward = visit.middle - before.middle
    arm = np.array([[1.0, 0.0, -onward[1]], [0.0, 1.0, onward[0]], [0.0, 0.0, 1.0]])
    new = uncertainty(track, before.scan, visit.scan, visit.middle)
    carried = arm @ np.concatenate([covariances, np.zeros((1, 3, 3))]) @ arm.T + new
    return np.asarray(carried)


def uncertainty(track: Track, first: int, last: int, end: Array) -> Array:
    """Compute the covariance of a point near a later scan relative to an earlier scan.

    Args:
        track: Trajectory of the robot.
        first: Index of the earlier scan.
        last: Index of the later scan.
        end: (x, y) of the point in metres, in the frame of the track.

    Returns:
        (3, 3) in metres and radians, by the axes of the track.
    """
    total = np.zeros((3, 3))
    for i in range(min(first, last) + 1, max(first, last) + 1):
        cos, sin = math.cos(track.poses[i - 1, 2]), math.sin(track.poses[i - 1, 2])
        # An error of this increment rotates and shifts all later poses. The point moves as the end
        # of an arm that begins here.
        x, y = end - track.poses[i, :2]
        arm = np.array([[cos, -sin, -y], [sin, cos, x], [0.0, 0.0, 1.0]])
        total += arm @ track.covariances[i] @ arm.T
    return total


def relative(closing: Closing, first: float, last: float) -> tuple[float, float, float]:
    """Compute the pose at a later step relative to an earlier one from a closure.

    Args:
        closing: The closure of the visits.
        first: Heading of the earlier step in radians, in the frame of the track.
        last: Heading of the later step.

    Returns:
        Metres ahead and to the left, and radians counterclockwise.
    """
    x, y = closing.match.shift
    cos, sin = math.cos(first), math.sin(first)
    return cos * x + sin * y, cos * y - sin * x, wrapped(last + closing.match.turn - first)
