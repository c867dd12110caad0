"""Finds closures: pairs of visits whose local maps match, and the relative pose of the two visits.

Two places may look alike. So a match counts only if the track allows it: its pose has to agree with
the track within ten times the covariance of the track, for some steady drift of the heading. A
match that counts says how far apart two visits are. It does not say that they are to one place.

Rooms look alike, and the track is uncertain after a long way. So a closure may pass this test
although it is false. It then pulls the track away from where the other closures put it. So all
closures are fitted to the track together. A closure is dropped if the fit is much better without
it.

The frames of two drives are unrelated. So each pair of their visits is matched in all rotations,
and each reliable match says how the frames relate.
Before that, the poses of the visits of each drive are fitted to its own closures, as a drift bends
the track. Places look alike, so a match counts only if at least VOTES visits of the second drive
agree on one relation, and no other relation has more than half as many. A relation that puts walls
seen by one drive where the other one saw free space does not count.

Relations of three drives form a loop. The two relations on which most visits agree say what the
third one is. If no match of the third relation agrees with them, it is not believed.

The parts of a drive before and after a cut of its track are like two drives.

Reference:
    Latif et al. 2013, "Robust loop closing over time for pose graph SLAM" (closures that do not fit
    are found by a fit of the pose graph). Here the leave-one-out chi-square finds them.
"""

from __future__ import annotations

import copy
import math
from bisect import bisect, bisect_left
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, combinations, islice, pairwise
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu

from perception.places.distinctive import Visit, patches_of
from perception.places.local_map import MOST, LocalScene, Match, Patch, Turned, match
from perception.places.track import (
    Array,
    Track,
    at_end,
    errors_of,
    points_moved,
    points_turned,
    seen_from,
)
from ssh_abduction.data.groups import gathered
from ssh_abduction.data.odometry import Pose, moved

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
# the form in which they are matched.
MATCHES, SCENES = 32, 128
# Of closures that fit nearly as badly as the worst one, the one with the lowest score is dropped.
# Nearly is this share of the chi-square of the worst one.
NEARLY = 0.9
# After a closure is dropped, only closures above this share of GATE are judged again.
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
TOGETHER = 256


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
        self._scenes: dict[int, LocalScene] = {}  # of the visits that were matched last

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
        here = sorted(_closings(self._scene, asked, last), key=lambda one: -one.match.score)
        self.found += here[:KEPT]
        # 3. The best closure corrects the position.
        if here:
            best = here[0].match
            placed[last] = moved(placed[here[0].first], (*best.shift.tolist(), best.turn))

    def copy(self) -> ClosureFinder:
        """A copy to which visits can be added alone."""
        other = copy.copy(self)
        other._visits, other._placed = [*self._visits], [*self._placed]
        other.found, other._scenes = [*self.found], {**self._scenes}
        return other

    def _scene(self, number: int) -> LocalScene:
        """The local map of a visit, prepared for matching."""
        if (scene := self._scenes.pop(number, None)) is None:
            visit = self._visits[number]
            (patch,) = patches_of([visit])
            scene = LocalScene.of(patch, visit.middle)
        self._scenes[number] = scene  # the last one
        if len(self._scenes) > SCENES:
            del self._scenes[next(iter(self._scenes))]
        return scene


def find_closures(track: Track, visits: Sequence[Visit], apart: float) -> list[VisitMatch]:
    """Find the closures between the visits of a log, as `ClosureFinder` does."""
    closures = ClosureFinder(apart)
    for visit in visits:
        closures.add(track, visit)
    return closures.found


def _closings(
    scene: Callable[[int], LocalScene], asked: Sequence[_Gate], last: int
) -> Iterator[VisitMatch]:
    """Match a visit with earlier ones, and yield the closures."""
    if not asked:
        return
    begin, end = min(gate.turns.start for gate in asked), max(gate.turns.stop for gate in asked)
    # The visit is rotated once, for all the earlier visits.
    turned = Turned.of(scene(last), [k * TURN for k in range(begin, end)])
    for gate in asked:
        part = turned.part(gate.turns.start - begin, gate.turns.stop - begin)
        found = match(scene(gate.first), part)
        if found is not None and is_reliable(found) and gate.allows(found):
            yield VisitMatch(gate.first, last, found)


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
    graph, kept = _ClosureGraph(track, visits, found), np.ones(len(found), bool)
    scores = np.array([closure.match.score for closure in found])
    doubtful = np.arange(len(found))  # a closure that fits well still does so without others
    while len(doubtful) and (gains := graph.gains(kept, doubtful)).max() > GATE:
        bad = doubtful[gains >= max(NEARLY * gains.max(), GATE)]
        kept[bad[np.argmin(scores[bad])]] = False
        doubtful = doubtful[(gains > DOUBTFUL * GATE) & kept[doubtful]]
    return [closure for closure, keep in zip(found, kept, strict=True) if keep]


def fitted_poses(track: Track, visits: Sequence[Visit], found: Sequence[VisitMatch]) -> Array:
    """Fit the poses of visits to the track and the closures: (n, 3).

    The pose of a visit is the middle of its place, in metres, and by how many radians the track is
    turned there.
    """
    graph = _ClosureGraph(track, visits, found)
    if found:
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

    def gains(self, kept: NDArray[np.bool_], asked: NDArray[np.int_]) -> Array:
        """Fit the poses to the closures kept. Return how much the chi-square falls without some.

        `asked` has the closures to leave out, each by itself.
        """
        off, jacobian, solver = self.fit(kept)
        rows = self._moves + np.searchsorted(np.flatnonzero(kept), asked)
        found = []
        for begin in range(0, len(rows), TOGETHER):
            some = rows[begin : begin + TOGETHER]
            own = (3 * some[:, None] + np.arange(3)).ravel()
            dense = jacobian[own].toarray()
            moved = solver.solve(dense.T).T.reshape(len(some), 3, -1)
            # How much of its own error each edge takes away by moving the poses.
            taken = dense.reshape(len(some), 3, -1) @ moved.transpose(0, 2, 1)
            left = (1 + REGULAR) * np.eye(3) - taken
            errors = off[some]
            rest = np.linalg.solve(left, errors[..., None])[..., 0]
            found.append(np.einsum("ki,ki->k", errors, rest))
        return np.concatenate(found)

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


# A match predicts where the visit of another match is. Two matches agree if this is right to within
# NEAR metres, plus ASTRAY metres for each metre between the two visits, and if their rotations
# differ by less than TWIST radians.
NEAR, ASTRAY, TWIST = 0.7, 0.05, math.radians(10)
VOTES = 3
TURNS = [k * TURN for k in range(round(math.tau / TURN))]
# A relation puts visits of two drives near each other. It clashes if, for most pairs of visits at
# most BESIDE metres apart, more than the share CLASHING of the wall points of the two visits lies
# in free space of the other one.
BESIDE, CLASHING = 6.0, 0.1
# Of a drive with cuts, at most this many visits are matched, as the time grows with the square.
MATCHED = 200


@dataclass(frozen=True, eq=False)
class DriveScenes:
    """The visits of a drive, prepared for matching."""

    scenes: Sequence[LocalScene]  # the local map of each visit
    poses: Array  # (n, 3) poses of the visits, as `fitted_poses` returns them

    @staticmethod
    def of(visits: Sequence[Visit], poses: Array) -> DriveScenes:
        """Prepare the local map of each visit."""
        pairs = zip(patches_of(visits), visits, strict=True)
        return DriveScenes([LocalScene.of(patch, visit.middle) for patch, visit in pairs], poses)


def closures_between(
    drives: Sequence[Sequence[Visit]], poses: Sequence[Array]
) -> Iterator[VisitMatch]:
    """Yield the closures between drives, with visits numbered over all drives.

    `poses` has, for each drive, the poses of its visits, as `fitted_poses` returns them.
    """
    parts = [*map(DriveScenes.of, drives, poses)]
    counts = [0, *accumulate(len(visits) for visits in drives)]
    found = {
        (a, b): without_clashes(_reliable_matches(parts[a], parts[b]), parts[a], parts[b])
        for a, b in combinations(range(len(drives)), 2)
    }
    for (a, b), agreed in agreeing_matches(poses, found).items():
        for closing in _best_of_each_visit(agreed):
            yield replace(closing, first=closing.first + counts[a], last=closing.last + counts[b])


def closures_across_cuts(track: Track, visits: Sequence[Visit], poses: Array) -> list[VisitMatch]:
    """Find the closures between visits before and after cuts of the track of one drive.

    `poses` has the poses of the visits, as `fitted_poses` returns them.
    """
    if not track.cuts:
        return []
    some = range(0, len(visits), 1 + len(visits) // MATCHED)
    cuts_before = np.searchsorted(track.cuts, [visits[k].scan for k in some], "right").tolist()
    parts = gathered(zip(cuts_before, some, strict=True)).values()
    drives = [[visits[k] for k in part] for part in parts]
    return [
        replace(closing, first=some[closing.first], last=some[closing.last])
        for closing in closures_between(drives, [poses[part] for part in parts])
    ]


class Relocation:
    """Finds where a robot is that may be anywhere among known visits, while it drives.

    It compares local maps along the new trajectory, its stations, with those of the visits. The
    robot is located when the matches of enough stations agree, as those of two drives have to.

    Args:
        visits: The known visits, with their local maps.
        poses: (n, 3) the poses of the visits, as `fitted_poses` returns them.
    """

    def __init__(self, visits: Sequence[Visit], poses: Array) -> None:
        some = slice(None, None, 1 + len(visits) // MATCHED)
        self._known = DriveScenes.of(visits[some], poses[some])
        self._scenes, self._poses = list[LocalScene](), list[Array]()  # of the stations
        self._found: list[VisitMatch] = []
        self._matching: Iterator[Match | None] = iter(())
        self._open = 0  # how many visits the last station was not matched with yet

    @property
    def is_busy(self) -> bool:
        """Whether the last station was not matched with all visits yet."""
        return self._open > 0

    def begin(self, patch: Patch, middle: Array) -> None:
        """Begin the next station: the local map around `middle`, (x, y) metres on the new track."""
        self._scenes.append(LocalScene.of(patch, middle))
        self._poses.append(np.array([*middle, 0.0]))
        turned = Turned.of(self._scenes[-1], TURNS)
        self._matching = (match(scene, turned) for scene in self._known.scenes)
        self._open = len(self._known.scenes)

    def go_on(self, share: float) -> tuple[Pose, Pose] | None:
        """Match the last station with a share of the visits.

        Returns a pose on the new track, and the same in the frame of the visits; None if it is not
        known yet where the robot is.
        """
        total, last = len(self._known.scenes), len(self._scenes) - 1
        for matched in islice(self._matching, math.ceil(share * total)):
            if matched is not None and is_reliable(matched):
                self._found.append(VisitMatch(total - self._open, last, matched))
            self._open -= 1
        return None if self.is_busy else self._located()

    def _located(self) -> tuple[Pose, Pose] | None:
        known, stations = self._known, DriveScenes(self._scenes, np.array(self._poses))
        kept = without_clashes(self._found, known, stations)
        agreed = _largest(kept, _relations(kept, known.poses, stations.poses))
        if not agreed:
            return None
        x, y, _ = here = stations.poses[-1].tolist()
        at, turn, _ = _relations(agreed, known.poses, stations.poses).placed(here[:2])
        return (x, y, 0.0), (*at.tolist(), turn)


def _reliable_matches(ours: DriveScenes, theirs: DriveScenes) -> list[VisitMatch]:
    """Match each visit of a drive with each visit of an earlier one, in all rotations."""
    found: list[VisitMatch] = []
    for j, scene in enumerate(theirs.scenes):
        turned = Turned.of(scene, TURNS)
        for i, other in enumerate(ours.scenes):
            matched = match(other, turned)
            if matched is not None and is_reliable(matched):
                found.append(VisitMatch(i, j, matched))
    return found


def _best_of_each_visit(agreed: Sequence[VisitMatch]) -> list[VisitMatch]:
    """Keep the KEPT best matches of each later visit."""
    kept: list[VisitMatch] = []
    for j in sorted({closing.last for closing in agreed}):
        here = [closing for closing in agreed if closing.last == j]
        kept += sorted(here, key=lambda closing: -closing.match.score)[:KEPT]
    return kept


def agreeing_matches(
    poses: Sequence[Array], found: Mapping[tuple[int, int], Sequence[VisitMatch]]
) -> dict[tuple[int, int], list[VisitMatch]]:
    """Return, for each pair of drives, the matches that agree on the relation of their frames.

    `poses` has the poses of the visits of each drive, as `fitted_poses` returns them.

    If two better supported relations lead from one drive of a pair over a third drive to the other
    one, some matches must agree with them. Otherwise those that do are kept, if they are enough.
    """
    agreed = {
        (a, b): _largest(some, _relations(some, poses[a], poses[b]))
        for (a, b), some in found.items()
    }
    frames: dict[tuple[int, int], _FrameMatches] = {}  # of the relations that are believed
    for a, b in sorted(agreed, key=lambda pair: -_votes(agreed[pair])):
        here = _relations(found[a, b], poses[a], poses[b])
        ways = [
            (frames[c, b], frames[a, c])
            for c in range(len(poses))
            if (c, b) in frames and (a, c) in frames
        ]
        if ways:
            over, back = max(ways, key=lambda way: min(len(way[0].turns), len(way[1].turns)))
            fits = here.fitting(over, back)
            fitting = [one for one, fit in zip(found[a, b], fits, strict=True) if fit]
            if not any(one in fitting for one in agreed[a, b]):
                agreed[a, b] = fitting if _votes(fitting) >= VOTES else []
        if agreed[a, b]:
            frames[a, b] = _relations(agreed[a, b], poses[a], poses[b])
            frames[b, a] = frames[a, b].inverse()
    return agreed


def without_clashes(
    found: Sequence[VisitMatch], ours: DriveScenes, theirs: DriveScenes
) -> list[VisitMatch]:
    """Drop the matches of relations that put walls of one drive into free space of the other."""
    sets, votes = _support(found, _relations(found, ours.poses, theirs.poses))
    judged, kept = np.zeros(len(found), bool), np.ones(len(found), bool)
    # Matches that agree are judged together, those on which most visits agree first.
    for k in sorted(range(len(found)), key=lambda k: -votes[k]):
        if votes[k] > 1 and not judged[k]:
            agreed = [found[i] for i in np.flatnonzero(sets[k]).tolist()]
            shares = _clashes(_relations(agreed, ours.poses, theirs.poses), ours, theirs)
            if shares and median(shares) > CLASHING:
                kept[sets[k] & ~judged] = False
            judged |= sets[k]
    return [one for one, keep in zip(found, kept, strict=True) if keep]


def _clashes(relation: _FrameMatches, ours: DriveScenes, theirs: DriveScenes) -> list[float]:
    """Return the share of wall points in free space for each pair of visits that are near."""
    shares = []
    for scene, (x, y, turned) in zip(theirs.scenes, theirs.poses, strict=True):
        at, turn, _ = relation.placed(np.array([x, y]))
        for other, (*middle, bent) in zip(ours.scenes, ours.poses, strict=True):
            if math.dist(at, middle) < BESIDE:
                shift = points_turned(-bent, (at - middle)[None])[0]
                shares.append(other.clash(scene, turn + turned - bent, shift))
    return [share for share in shares if share is not None]


def _votes(matches: Sequence[VisitMatch]) -> int:
    return len({one.last for one in matches})


@dataclass(frozen=True, eq=False)
class _FrameMatches:
    """What n matches say about how two frames relate.

    `turns` are rotations of the later frame, in radians. The middle of the later visit is `here` in
    the earlier frame and `there` in its own, (n, 2) metres.
    """

    turns: Array
    here: Array
    there: Array

    def agreeing(self, k: int) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Mask of the matches that agree with match k."""
        onward = self.there - self.there[k]
        expected = self.here[k] + points_turned(self.turns[k], onward)
        far = np.hypot(*(self.here - expected).T)
        twist = np.abs((self.turns - self.turns[k] + math.pi) % math.tau - math.pi)
        return np.asarray((far < NEAR + ASTRAY * np.hypot(*onward.T)) & (twist < TWIST))

    def inverse(self) -> _FrameMatches:
        """Return what the matches say if the two drives change places."""
        return _FrameMatches(-self.turns, self.there, self.here)

    def placed(self, point: Array) -> tuple[Array, float, float]:
        """Place a point (x, y) of the later frame in the earlier one, by the nearest match.

        Returns the position in metres, the rotation of the match in radians, and how far the point
        is from the match in metres.
        """
        onward = point - self.there
        far = np.hypot(*onward.T)
        k = int(np.argmin(far))
        turn = float(self.turns[k])
        return self.here[k] + points_turned(turn, onward[k : k + 1])[0], turn, float(far[k])

    def fitting(self, over: _FrameMatches, back: _FrameMatches) -> list[bool]:
        """Whether each match agrees with two relations that lead over a third drive.

        `over` leads from the later frame to the frame of the third drive, and `back` from there to
        the earlier frame. Each is taken at its match that is nearest.
        """
        found = []
        for turn, here, at in zip(self.turns, self.here, self.there, strict=True):
            point, reach, twist = at, 2 * NEAR, turn
            for relation in (over, back):
                point, turned, far = relation.placed(point)
                reach += ASTRAY * far
                twist -= turned
            twist = abs((twist + math.pi) % math.tau - math.pi)
            found.append(bool(math.dist(point, here) < reach and twist < 2 * TWIST))
        return found


def _relations(found: Sequence[VisitMatch], first: Array, last: Array) -> _FrameMatches:
    """Collect what matches between the visits of two drives say about their frames.

    `first` and `last` have the poses of the visits of each drive, (n, 3).
    """
    at, there = first[[one.first for one in found]], last[[one.last for one in found]]
    seen = [points_moved(pose, one.match.shift) for pose, one in zip(at, found, strict=True)]
    turns = np.array([one.match.turn for one in found]) + at[:, 2] - there[:, 2]
    return _FrameMatches(turns, np.array(seen).reshape(-1, 2), there[:, :2])


def _largest(found: Sequence[VisitMatch], relations: _FrameMatches) -> list[VisitMatch]:
    """Find the relation of the frames on which most matches agree, and list these matches.

    The list is empty if too few visits agree, or if another relation has more than half as many.
    """
    sets, votes = _support(found, relations)
    most = max(votes, default=0)
    if most < VOTES:
        return []
    best = sets[votes.index(most)]
    if max((votes[k] for k in np.flatnonzero(~best)), default=0) > most / 2:
        return []
    return [found[k] for k in np.flatnonzero(best).tolist()]


def _support(
    found: Sequence[VisitMatch], relations: _FrameMatches
) -> tuple[list[np.ndarray[tuple[int], np.dtype[np.bool_]]], list[int]]:
    """For each match, return which matches agree with it, and how many later visits these have."""
    visits = np.array([one.last for one in found], int)
    sets = [relations.agreeing(k) for k in range(len(found))]
    return sets, [len(np.unique(visits[mask])) for mask in sets]
