"""Finds closures: pairs of visits whose local maps match, and the relative pose of the two visits.

Two places may look alike. So a match counts only if the track allows it: its pose has to agree with
the track within ten times the covariance of the track, for some steady drift of the heading. A
match that counts says how far apart two visits are. It does not say that they are to one place.
"""

from __future__ import annotations

import math
from bisect import bisect, bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from perception.places.local_map import PackedPatch
from perception.places.matching import MOST, Match, Scene, Turned, match
from perception.places.track import Array, Track, points_turned
from perception.places.visits import Visit

# A match is reliable with at least this score and share of area that both maps observed.
SCORE, MUTUAL = 0.75, 0.5
# Standard deviations of a reliable match, in metres and radians (docs/measurements/logs.md).
NOISE = (0.1, 0.1, math.radians(1))
# The covariance of the track is multiplied by INFLATED. The drifts are multiples of BEND up to
# BENDS times it, in radians per metre. A match may be off by a chi-square of GATE (3 degrees of
# freedom).
INFLATED, BEND, BENDS, GATE = 10.0, 2e-4, 10, 20.0
# The drifts of the heading that are tried, in radians per metre.
DRIFTS = BEND * np.arange(-BENDS, BENDS + 1)
# Rotations are tried in steps of TURN radians, from the least to the largest that the track allows
# within SIGMAS standard deviations.
TURN, SIGMAS = math.radians(6), 3.0
# Each visit has at most this many closures with earlier ones: those with the best scores.
KEPT = 2
# Each visit is matched with at most MATCHES earlier ones. The last SCENES local maps are cached in
# the form in which they are matched.
MATCHES, SCENES = 32, 128


@dataclass(frozen=True, eq=False)
class VisitMatch:
    """A reliable match of two visits."""

    first: int  # index of the earlier visit
    last: int  # index of the later visit
    # The pose of the middle of the later place relative to the middle of the earlier place.
    match: Match


def find_closures(
    track: Track, visits: Sequence[Visit], patches: Sequence[PackedPatch], apart: float
) -> list[VisitMatch]:
    """Find the closures between the visits of a log.

    Each visit is matched with at most MATCHES earlier ones, so the time grows with the number of
    visits, not with its square. These are the nearest ones by the track. Each closure that is found
    corrects the later positions for this choice. `patches` has the local map of each visit. Two
    visits are matched if the robot drove at least `apart` metres between them, so that their local
    maps share no scans.
    """

    @lru_cache(SCENES)
    def scene(visit: int) -> Scene:
        return Scene.of(patches[visit], visits[visit].middle)

    gates, corrected = _Gates(track, visits, apart), _Corrected(visits)
    found: list[VisitMatch] = []
    for last in range(len(visits)):
        corrected.predict(last)
        earlier = gates.earlier(last)
        near = corrected.nearest(last, earlier)
        asked = gates.allowed(last, near)
        here = sorted(_closings(scene, asked, last), key=lambda closing: -closing.match.score)
        found += here[:KEPT]
        if here:
            corrected.correct(here[0])
    return found


def _closings(
    scene: Callable[[int], Scene], asked: Sequence[tuple[int, _Gate]], last: int
) -> Iterator[VisitMatch]:
    """Match a visit with earlier ones, and yield the closures."""
    if not asked:
        return
    turns = [gate.turns for _, gate in asked]
    begin, end = min(some.start for some in turns), max(some.stop for some in turns)
    # The visit is rotated once, for all the earlier visits.
    turned = Turned.of(scene(last), [k * TURN for k in range(begin, end)])
    for (first, gate), some in zip(asked, turns, strict=True):
        found = match(scene(first), turned.part(some.start - begin, some.stop - begin))
        if found is not None and is_reliable(found) and gate.allows(found):
            yield VisitMatch(first, last, found)


def is_reliable(found: Match) -> bool:
    """Whether a match of two local maps may become a closure."""
    return found.score >= SCORE and found.mutual >= MUTUAL


@dataclass(frozen=True, eq=False)
class _Gate:
    """The relative poses that the track allows for two visits."""

    # (d, 3) x, y and rotation of the later visit in the frame of the earlier one, for each of the d
    # drifts of the heading that are tried.
    poses: Array
    covariance: Array  # (3, 3) covariance of these poses by the track, times INFLATED

    @property
    def turns(self) -> range:
        """The rotations that the track allows, as multiples of TURN."""
        margin = SIGMAS * math.sqrt(self.covariance[2, 2])
        least, most = self.poses[:, 2].min() - margin, self.poses[:, 2].max() + margin
        first, last = math.floor(least / TURN), math.ceil(most / TURN)
        if last - first >= math.tau / TURN:
            first, last = 0, round(math.tau / TURN) - 1
        return range(first, last + 1)

    def allows(self, found: Match) -> bool:
        """Whether a match agrees with the track for some drift."""
        off = errors_of(self.poses, np.array([*found.shift, found.turn]))
        inverse = np.linalg.inv(self.covariance + np.diag(NOISE) ** 2)
        return bool(np.einsum("di,ij,dj->d", off, inverse, off).min() < GATE)


class _Gates:
    """Makes the gates (`_Gate`) of pairs of visits that are at least `apart` metres apart.

    That is how far the robot drove between the two visits.
    """

    def __init__(self, track: Track, visits: Sequence[Visit], apart: float) -> None:
        self._track, self._apart = track, apart
        self._scans = [visit.scan for visit in visits]
        self._way = track.way[self._scans]
        self._middles = np.array([visit.middle for visit in visits]).reshape(-1, 2)
        self._poses = np.array([without_drift(self._middles, self._way, drift) for drift in DRIFTS])

    def earlier(self, last: int) -> range:
        """The earlier visits far enough before a visit, without a cut of the track between.

        The motion across a cut is unknown.
        """
        cuts = bisect(self._track.cuts, self._scans[last])
        begin = bisect_left(self._scans, self._track.cuts[cuts - 1]) if cuts else 0
        end = int(np.searchsorted(self._way, self._way[last] - self._apart))
        return range(begin, max(begin, end))

    def allowed(self, last: int, some: Sequence[int]) -> list[tuple[int, _Gate]]:
        """List the candidates that may be near a visit, each with its gate (allowed poses)."""
        if not some:
            return []
        # By the axes of each earlier visit, for each drift: (drifts, visits, 3).
        there = seen_from(self._poses[:, some], self._poses[:, last, None])
        end = self._middles[last]
        spreads = [
            INFLATED * uncertainty(self._track, self._scans[k], self._scans[last], end)
            for k in some
        ]
        # Any shift that a match can have is allowed for the visits that are near.
        far = np.hypot(there[..., 0], there[..., 1]).min(axis=0) - MOST
        near = far <= SIGMAS * np.sqrt(np.linalg.eigvalsh(np.array(spreads)[:, :2, :2])[:, 1])
        return [(some[k], _Gate(there[:, k], spreads[k])) for k in np.flatnonzero(near).tolist()]


class _Corrected:
    """The positions of visits by the track. Each closure corrects the positions of later visits."""

    def __init__(self, visits: Sequence[Visit]) -> None:
        self._middles = np.array([visit.middle for visit in visits]).reshape(-1, 2)
        self._places = self._middles.copy()
        self._turns = np.zeros(len(visits))

    def predict(self, visit: int) -> None:
        """Compute the position of a visit from the position before it and the track."""
        if visit:
            turn = self._turns[visit - 1]
            onward = points_turned(turn, self._middles[visit] - self._middles[visit - 1])
            self._places[visit], self._turns[visit] = self._places[visit - 1] + onward, turn

    def correct(self, closing: VisitMatch) -> None:
        """Compute the position of the later visit of a closure from the earlier visit."""
        turn = self._turns[closing.first]
        onward = points_turned(turn, closing.match.shift)
        self._places[closing.last] = self._places[closing.first] + onward
        self._turns[closing.last] = turn + closing.match.turn

    def nearest(self, visit: int, some: range) -> list[int]:
        """List the MATCHES visits of a range that are nearest to a visit, in ascending order."""
        far = np.hypot(*(self._places[some.start : some.stop] - self._places[visit]).T)
        return sorted((np.argsort(far, kind="stable")[:MATCHES] + some.start).tolist())


def seen_from(first: Array, last: Array) -> Array:
    """Compute the poses `last` in the frames of the poses `first`.

    All poses are (..., 3): x, y in metres and rotation of the axes in radians.
    """
    cos, sin = np.cos(first[..., 2]), np.sin(first[..., 2])
    x, y, turned = np.moveaxis(last - first, -1, 0)
    return np.stack([cos * x + sin * y, cos * y - sin * x, turned], axis=-1)


def errors_of(poses: Array, matches: Array) -> Array:
    """Subtract poses found by matching from poses of the track: (..., 3) metres and radians."""
    off = poses - matches
    off[..., 2] = (off[..., 2] + math.pi) % math.tau - math.pi
    return off


def without_drift(middles: Array, way: Array, drift: float) -> Array:
    """Compute the middles of visits without a steady drift of the heading, in radians per metre.

    `middles` are (n, 2) metres by the track, and `way` the (n,) metres driven before each visit.
    The result is (n, 3): x, y in metres and rotation of the axes in radians.
    """
    turn = -drift * (way - way[0])
    halfway = (turn[1:] + turn[:-1]) / 2
    x, y = np.diff(middles, axis=0).T
    cos, sin = np.cos(halfway), np.sin(halfway)
    steps = np.stack([cos * x - sin * y, sin * x + cos * y], axis=1)
    places = np.concatenate([middles[:1], middles[0] + np.cumsum(steps, axis=0)])
    return np.column_stack([places, turn])


def uncertainty(track: Track, first: int, last: int, end: Array) -> Array:
    """Compute the covariance of a point near a later scan relative to an earlier scan, (3, 3).

    Scans are given by their indices. The point `end`, (x, y), and the covariance are in metres and
    radians, in the frame of the track.
    """
    # An error of an increment rotates and shifts all later poses. The point moves as the end of an
    # arm that begins there.
    first, last = min(first, last), max(first, last)
    return at_end(end, track.spread(last) - track.spread(first))


def at_end(end: Array, covariance: Array) -> Array:
    """Compute the covariance, (3, 3), of the end of an arm from that of its beginning.

    The rotation at the beginning moves the end, which is at (x, y) metres from there.
    """
    arm = np.array([[1.0, 0.0, -end[1]], [0.0, 1.0, end[0]], [0.0, 0.0, 1.0]])
    return np.asarray(arm @ covariance @ arm.T)
