"""Finds closures: pairs of visits whose local maps match, and the relative pose of the two visits.

Two places may look alike. So a match counts only if the track allows it: its pose has to agree with
the track within ten times the covariance of the track, for some steady drift of the heading. A
match that counts says how far apart two visits are. It does not say that they are to one place.

Rooms look alike, and the track is uncertain after a long way. So a closure may pass this test
although it is false. It then pulls the track away from where the other closures put it. So all
closures are fitted to the track together. A closure is dropped if the fit is much better without
it.

Reference:
    Latif et al. 2013, "Robust loop closing over time for pose graph SLAM" (closures that do not fit
    are found by a fit of the pose graph). Here the leave-one-out chi-square finds them.
"""

from __future__ import annotations

import copy
import math
from bisect import bisect, bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu

from perception.places.distinctive import Visit, patches_of
from perception.places.local_map import MOST, LocalScene, Match, Turned, match
from perception.places.track import Array, Track, at_end, errors_of, seen_from
from ssh_abduction.data.odometry import Pose, moved
from ssh_abduction.runtime.threads import one_thread

# A match is reliable with at least this score and share of area that both maps observed.
SCORE, MUTUAL = 0.75, 0.5
# Standard deviations of a reliable match, in metres and radians (benchmarks/logs.md).
NOISE = (0.1, 0.1, math.radians(1))
# The covariance of the track is multiplied by INFLATED. The drifts are multiples of BEND up to
# BENDS times it, in radians per metre. A match may be off by a chi-square of GATE (3 degrees of
# freedom).
INFLATED, BEND, BENDS, GATE = 10.0, 2e-4, 10, 20.0
# The drifts of the heading that are tried, in radians per metre.
DRIFTS = BEND * np.arange(-BENDS, BENDS + 1)
# Standard deviations of the error of a closure, in metres and radians (benchmarks/logs.md).
ERROR = (0.05, 0.05, math.radians(0.5))
# The factors that are tried, and the standard deviation of the prior of their natural logarithm.
# Because of this prior, a few closures do not change the covariances much.
FACTORS = 2.0 ** np.arange(-7, 5, 0.5)
CHANGE = 0.5
# WRONG is the share of closures that are wrong. The errors of wrong closures are uniformly
# distributed in the ellipsoid that the gate of closures allows. VOLUME is the natural logarithm
# of its volume if the covariance is the unit matrix, so that it is a ball.
WRONG = 0.02
VOLUME = math.log(4 / 3 * math.pi * (INFLATED * GATE) ** 1.5)
# Systematic drift of the heading of a track of matched scans, in radians per metre.
DRIFT = 0.001
# Rotations are tried in steps of TURN radians, from the least to the largest that the track allows
# within SIGMAS standard deviations.
TURN, SIGMAS = math.radians(6), 3.0
# Each visit has at most this many closures with earlier ones: those with the best scores.
KEPT = 2
# Each visit is matched with at most MATCHES earlier ones. The last SCENES local maps are cached in
# the form in which they are matched, and the last RESULTS results.
MATCHES, SCENES, RESULTS = 32, 64, 512
# Of closures that fit nearly as badly as the worst one, the one with the lowest score is dropped.
# Nearly is this share of the chi-square of the worst one.
NEARLY = 0.9
# After a closure is dropped, others are judged again while their last gain is above this share of
# the largest new one, and of GATE.
DOUBTFUL = 0.5
# The fit ends after ROUNDS steps, or if a step lowers the chi-square by less than the share STILL.
# A step that raises the chi-square is halved, at most HALVINGS times.
ROUNDS, STILL, HALVINGS = 50, 1e-4, 8
# The inverse of the standard deviation of the drift. Its largest value, where closures are found,
# is two standard deviations.
SURE = 2 / (BENDS * BEND)
# The least variance of a motion, and a small number that makes the normal equations regular.
LEAST, REGULAR = 1e-8, 1e-9
# The gains of this many closures are computed at once.
TOGETHER = 32


@dataclass(frozen=True, eq=False)
class VisitMatch:
    """A reliable match of two visits."""

    first: int  # index of the earlier visit
    last: int  # index of the later visit
    # The pose of the middle of the later place relative to the middle of the earlier place.
    match: Match


class ClosureFinder:
    """Finds the closures of each visit of a drive with earlier ones, while visits come.

    Each visit is matched with at most MATCHES earlier ones, so the time grows with the number of
    visits, not with its square. These are the nearest ones by the track. Each closure that is found
    corrects the later positions for this choice. Two visits are matched if the robot drove at least
    `apart` metres between them, so that their local maps share no scans.
    """

    def __init__(self, apart: float) -> None:
        self._apart = apart
        self._visits: list[Visit] = []
        self._placed: list[Pose] = []  # the visits by the track. Each closure corrects later ones.
        self.found: list[VisitMatch] = []  # the closures so far
        # What was matched last, also by copies: visits that are expected are added again and again.
        self._scenes: dict[int, LocalScene] = {}
        self._matches: dict[tuple[int, int, range], Match | None] = {}

    def __len__(self) -> int:
        """The number of visits."""
        return len(self._visits)

    def add(self, track: Track, visit: Visit) -> None:
        """Add the next visit, which has its local map. The track may end anywhere after it."""
        self._visits.append(visit)
        last, visits = len(self._visits) - 1, self._visits
        scans = [one.scan for one in visits]
        way, middles = track.way[scans], np.array([one.middle for one in visits])
        x, y = (middles[-1] - middles[-2] if last else middles[-1]).tolist()
        placed = self._placed
        placed.append(moved(placed[-1], (x, y, 0.0)) if last else (x, y, 0.0))
        # 1. The earlier visits are far enough before. The motion across a cut is unknown.
        cuts = bisect(track.cuts, scans[last])
        begin = bisect_left(scans, track.cuts[cuts - 1]) if cuts else 0
        earlier = range(begin, int(np.searchsorted(way, way[last] - self._apart)))
        # 2. Take the nearest of them, and match those that the track allows to be near.
        far = [math.dist(placed[k][:2], placed[last][:2]) for k in earlier]
        nearest = sorted((np.argsort(far, kind="stable")[:MATCHES] + begin).tolist())
        poses = np.array([without_drift(middles, way, drift) for drift in DRIFTS if nearest])
        gates = [
            _Gate(
                k,
                seen_from(poses[:, k], poses[:, last]),
                INFLATED * uncertainty(track, scans[k], scans[last], middles[last]),
            )
            for k in nearest
        ]
        asked = [gate for gate in gates if gate.is_near]
        here = sorted(self._closings(asked, last), key=lambda one: -one.match.score)
        self.found += here[:KEPT]
        # 3. The best closure corrects the position.
        if here:
            best = here[0].match
            placed[last] = moved(placed[here[0].first], (*best.shift.tolist(), best.turn))

    def copy(self) -> ClosureFinder:
        """A copy to which visits can be added alone."""
        other = copy.copy(self)
        other._visits, other._placed = [*self._visits], [*self._placed]
        other.found = [*self.found]
        return other

    def _closings(self, asked: Sequence[_Gate], last: int) -> Iterator[VisitMatch]:
        """Match a visit with earlier ones, and yield the closures."""
        own = self._key(last)
        keys = [(self._key(gate.first), own, gate.turns) for gate in asked]
        known = {key: self._matches.pop(key) for key in keys if key in self._matches}
        if turns := [key[2] for key in keys if key not in known]:
            begin, end = min(some.start for some in turns), max(some.stop for some in turns)
            # The visit is rotated once, for all the earlier visits.
            turned = Turned.of(self._scene(last), [k * TURN for k in range(begin, end)])
        for gate, key in zip(asked, keys, strict=True):
            if key not in known:
                part = turned.part(gate.turns.start - begin, gate.turns.stop - begin)
                known[key] = match(self._scene(gate.first), part)
            _keep(self._matches, RESULTS, key, found := known[key])
            if found is not None and is_reliable(found) and gate.allows(found):
                yield VisitMatch(gate.first, last, found)

    def _key(self, number: int) -> int:
        """Equal for visits with equal local maps and middles."""
        (patch,) = patches_of(self._visits[number : number + 1])
        return hash(patch.bits.tobytes() + self._visits[number].middle.tobytes())

    def _scene(self, number: int) -> LocalScene:
        """The local map of a visit, prepared for matching."""
        if (scene := self._scenes.pop(key := self._key(number), None)) is None:
            (patch,) = patches_of(self._visits[number : number + 1])
            scene = LocalScene.of(patch, self._visits[number].middle)
        _keep(self._scenes, SCENES, key, scene)
        return scene


def _keep(cache: dict[Any, Any], most: int, key: Any, value: Any) -> None:
    """Add an item to a cache, and drop the oldest one if there are too many."""
    cache[key] = value
    if len(cache) > most:
        del cache[next(iter(cache))]


def find_closures(track: Track, visits: Sequence[Visit], apart: float) -> list[VisitMatch]:
    """Find the closures between the visits of a log, as `ClosureFinder` does."""
    closures = ClosureFinder(apart)
    for visit in visits:
        closures.add(track, visit)
    return closures.found


def is_reliable(found: Match) -> bool:
    """Whether a match of two local maps may become a closure."""
    return found.score >= SCORE and found.mutual >= MUTUAL


@dataclass(frozen=True, eq=False)
class _Gate:
    """The relative poses that the track allows for two visits."""

    first: int  # index of the earlier visit
    # (d, 3) x, y and rotation of the later visit in the frame of the earlier one, for each of the d
    # drifts of the heading that are tried.
    poses: Array
    covariance: Array  # (3, 3) covariance of these poses by the track, times INFLATED

    @property
    def is_near(self) -> bool:
        """Whether the later visit may be near. Any shift that a match can have is allowed then."""
        far = float(np.hypot(*self.poses[:, :2].T).min()) - MOST
        return bool(far <= SIGMAS * math.sqrt(np.linalg.eigvalsh(self.covariance[:2, :2])[1]))

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
    return at_end(end, track.spreads[last] - track.spreads[first])


def agreeing(
    track: Track, visits: Sequence[Visit], found: Sequence[VisitMatch]
) -> list[VisitMatch]:
    """Drop closures, the worst first, until each one agrees with the track and the others.

    A closure agrees if the chi-square of the best fit is at most GATE lower without it. The
    covariances of the track are multiplied by INFLATED, and the heading may drift steadily.
    """
    if not found:
        return []
    graph, kept = _ClosureGraph(track, visits, found), np.ones(len(found), bool)
    scores = np.array([closure.match.score for closure in found])
    gains = np.full(len(found), np.inf)  # when each closure was judged last
    # The matrices are small: threads of BLAS would mostly wait for each other.
    with one_thread("blas"):
        while True:
            fitted = graph.fit(kept)
            left, worst = kept.copy(), GATE  # those not judged yet, and the largest gain of others
            while len(some := np.flatnonzero(left & (gains > DOUBTFUL * worst))):
                some = some[np.argsort(-gains[some], kind="stable")][:TOGETHER]
                gains[some], left[some] = graph.gains(fitted, kept, some), False
                worst = max(worst, gains[some].max())
            bad = np.flatnonzero(kept & ~left & (gains >= max(NEARLY * worst, GATE)))
            if not len(bad) or worst <= GATE:
                return [closure for closure, keep in zip(found, kept, strict=True) if keep]
            kept[bad[np.argmin(scores[bad])]] = False


def fitted_poses(track: Track, visits: Sequence[Visit], found: Sequence[VisitMatch]) -> Array:
    """Fit the poses of visits to the track and the closures: (n, 3).

    The pose of a visit is the middle of its place, in metres, and by how many radians the track is
    turned there.
    """
    graph = _ClosureGraph(track, visits, found)
    if found:
        with one_thread("blas"):
            graph.fit(np.ones(len(found), bool))
    return graph.poses


class _ClosureGraph:
    """Least squares over the poses of the visits of a drive and the drift of its heading.

    Edges are the motions between successive visits, and the closures.
    """

    def __init__(self, track: Track, visits: Sequence[Visit], found: Sequence[VisitMatch]) -> None:
        middles = np.array([visit.middle for visit in visits]).reshape(-1, 2)
        scans = [visit.scan for visit in visits]
        cuts = [track.cuts_between(*sorted(pair)) for pair in pairwise(scans)]
        moves = [k for k, between in enumerate(cuts, 1) if not between]
        self._first = np.array([*(k - 1 for k in moves), *(c.first for c in found)], int)
        self._last = np.array([*moves, *(c.last for c in found)], int)
        onward = [np.array([*(middles[k] - middles[k - 1]), 0.0]) for k in moves]
        self._measured = np.array([*onward, *((*c.match.shift, c.match.turn) for c in found)])
        spreads = [
            INFLATED * uncertainty(track, scans[k - 1], scans[k], middles[k]) + LEAST * np.eye(3)
            for k in moves
        ]
        noise = np.array([*spreads, *[np.diag(NOISE) ** 2] * len(found)]).reshape(-1, 3, 3)
        self._whitening = np.linalg.inv(np.linalg.cholesky(noise))
        # Closures have no way, as no drift turns a match.
        way = np.abs(np.diff(track.way[scans])) if len(visits) > 1 else np.zeros(0)
        self._way = np.array([*(way[k - 1] for k in moves), *[0.0] * len(found)])
        self._moves = len(moves)
        self._unknown = np.append(np.column_stack([middles, np.zeros(len(visits))]).ravel(), 0.0)

    @property
    def poses(self) -> Array:
        """The poses of the visits, (n, 3), by the last fit. Without a fit, those of the track."""
        return self._unknown[:-1].reshape(-1, 3)

    def gains(
        self, fitted: tuple[Array, Any, Any], kept: NDArray[np.bool_], asked: NDArray[np.int_]
    ) -> Array:
        """How much the chi-square of a fit to the closures kept falls without some.

        `fitted` is the result of `fit`. `asked` has the closures to leave out, each by itself.
        """
        off, jacobian, solver = fitted
        some = self._moves + np.searchsorted(np.flatnonzero(kept), asked)
        dense = jacobian[(3 * some[:, None] + np.arange(3)).ravel()].toarray()
        moved = solver.solve(dense.T).T.reshape(len(some), 3, -1)
        # How much of its own error each edge takes away by moving the poses.
        taken = dense.reshape(len(some), 3, -1) @ moved.transpose(0, 2, 1)
        left = (1 + REGULAR) * np.eye(3) - taken
        rest = np.linalg.solve(left, off[some][..., None])[..., 0]
        return np.asarray(np.einsum("ki,ki->k", off[some], rest))

    def fit(self, kept: NDArray[np.bool_]) -> tuple[Array, Any, Any]:
        """Fit the poses to the closures kept. The fit begins with the result of the last one.

        Returns the errors of the edges in standard deviations, (k, 3), their derivative, and the
        factors of the normal equations.
        """
        some = np.append(np.ones(self._moves, bool), kept)
        squares = self._squares(some, self._unknown)
        for _ in range(ROUNDS):
            off, jacobian = self._linear(some, self._unknown)
            normal = (jacobian.T @ jacobian).tocsc()
            normal.setdiag(normal.diagonal() + REGULAR)
            normal[-1, -1] += SURE**2
            solver = splu(normal, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
            pull = jacobian.T @ off.ravel()
            pull[-1] += SURE**2 * self._unknown[-1]
            step = solver.solve(-pull)
            # Far from the best fit, a whole step may go too far.
            tried = [(self._squares(some, better := self._unknown + step), better)]
            while tried[-1][0] > squares and len(tried) < HALVINGS:
                step /= 2
                tried.append((self._squares(some, better := self._unknown + step), better))
            if tried[-1][0] >= squares * (1 - STILL):
                break
            squares, self._unknown = tried[-1]
        return off, jacobian, solver

    def _squares(self, some: NDArray[np.bool_], unknown: Array) -> float:
        """Compute the chi-square of some edges and of the drift."""
        return float((self._linear(some, unknown)[0] ** 2).sum() + (SURE * unknown[-1]) ** 2)

    def _linear(self, some: NDArray[np.bool_], unknown: Array) -> tuple[Array, Any]:
        """Compute the errors of edges in standard deviations, (k, 3), and their derivative."""
        first, last, way = self._first[some], self._last[some], self._way[some]
        poses, drift = unknown[:-1].reshape(-1, 3), unknown[-1]
        bent = np.column_stack([0 * way, 0 * way, drift * way / 2])
        facing = poses[first] + bent  # halfway along each motion
        seen = seen_from(facing, poses[last]) - bent
        off, (ahead, left, _) = errors_of(seen, self._measured[some]), seen.T
        cos, sin = np.cos(facing[:, 2]), np.sin(facing[:, 2])
        zero, one = 0 * way, 1 + 0 * way
        by_last = np.stack([cos, sin, zero, -sin, cos, zero, zero, zero, one], axis=1)
        by_first = np.stack([-cos, -sin, left, sin, -cos, -ahead, zero, zero, -one], axis=1)
        by_drift = np.stack([left * way / 2, -ahead * way / 2, -way], axis=1)
        derivative = np.concatenate(
            [by_first.reshape(-1, 3, 3), by_last.reshape(-1, 3, 3), by_drift[..., None]], axis=2
        )
        whitening = self._whitening[some]
        own = np.stack([3 * node + k for node in (first, last) for k in range(3)], axis=1)
        columns = np.column_stack([own, np.full(len(first), len(unknown) - 1)])
        rows = np.arange(3 * len(first)).reshape(-1, 3, 1)
        entries = np.broadcast_arrays(whitening @ derivative, rows, columns[:, None])
        values, of, by = (entry.ravel() for entry in entries)
        jacobian = coo_array((values, (of, by)), shape=(3 * len(first), len(unknown))).tocsr()
        return (whitening @ off[..., None])[..., 0], jacobian


def factor_of(track: Track, visits: Sequence[Visit], closings: Sequence[VisitMatch]) -> float:
    """Estimate the factor that corrects the covariances of a track; 1 if there is no closure."""
    if not closings:
        return 1.0
    scans = [visit.scan for visit in visits]
    middles = np.array([visit.middle for visit in visits])
    first, last = [c.first for c in closings], [c.last for c in closings]
    matches = np.array([(*c.match.shift, c.match.turn) for c in closings])
    spreads = np.array(
        [uncertainty(track, scans[c.first], scans[c.last], middles[c.last]) for c in closings]
    )
    spread = FACTORS[:, None, None, None] * spreads + np.diag(ERROR) ** 2  # (factors, closures)
    inverse, size = np.linalg.inv(spread), np.linalg.slogdet(math.tau * spread)[1]
    wrong = math.log(WRONG) - VOLUME - np.linalg.slogdet(spreads + np.diag(ERROR) ** 2)[1] / 2
    best = np.full(len(FACTORS), -np.inf)
    for drift in DRIFTS:
        poses = without_drift(middles, track.way[scans], drift)
        off = errors_of(seen_from(poses[first], poses[last]), matches)
        squares = np.einsum("ni,fnij,nj->fn", off, inverse, off)
        right = math.log(1 - WRONG) - (squares + size) / 2
        fits = np.logaddexp(right, wrong).sum(axis=1) - (drift / DRIFT) ** 2 / 2
        best = np.maximum(best, fits)
    best -= (np.log(FACTORS) / CHANGE) ** 2 / 2
    return float(FACTORS[best.argmax()])
