"""Finds closures between drives whose frames are unrelated, and where a lifted robot is.

The frames of two drives are unrelated. So each pair of their visits is matched in all rotations,
and each reliable match says how the frames relate.
Before that, the poses of the visits of each drive are fitted to its own closures, as a drift bends
the track. Places look alike, so a match counts only if at least VOTES visits of the second drive
agree on one relation, and no other relation has more than half as many. A relation that puts walls
seen by one drive where the other one saw free space does not count.

Relations of three drives form a loop. The two relations on which most visits agree say what the
third one is. If no match of the third relation agrees with them, it is not believed.

The parts of a drive before and after a cut of its track are like two drives.

A robot that is switched on somewhere is in a frame of its own, too. `Relocation` finds where that
is, while it drives.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, chain, combinations, islice
from statistics import median

import numpy as np

from perception.places.closures import KEPT, MUTUAL, SCORE, TURN, VisitMatch, is_reliable
from perception.places.distinctive import Visit, patches_of
from perception.places.local_map import MOST, LocalScene, Match, Patch, Turned, match, refined
from perception.places.track import Array, Track, points_moved, points_turned
from ssh_abduction.data.groups import gathered
from ssh_abduction.data.odometry import Pose

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
# Where is a robot that may be anywhere? Each station shows WALLS pieces of wall that earlier
# stations did not show. The known map lacks the share HIDDEN of all walls. A position is told to
# the user if each other one is SURE times less probable. The robot may also be in a part that is
# not known, or in another building. Then most stations match nothing that is known to be there. So
# at least MORE stations more have to match than do not.
WALLS, HIDDEN, SURE, MORE = 10, 0.05, 100, 4
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

    Attributes:
        left: How many visits the last station was not matched with yet.
    """

    def __init__(self, visits: Sequence[Visit], poses: Array) -> None:
        some = slice(None, None, 1 + len(visits) // MATCHED)
        self._known = DriveScenes.of(visits[some], poses[some])
        self._scenes, self._poses = list[LocalScene](), list[Array]()  # of the stations
        self.left, self._found = 0, list[VisitMatch]()
        self._matching: Iterator[VisitMatch | None] = iter(())

    def begin(self, patch: Patch, middle: Array) -> None:
        """Begin the next station: the local map around `middle`, (x, y) metres on the new track."""
        number, scene = len(self._scenes), LocalScene.of(patch, middle)
        self._scenes.append(scene)
        self._poses.append(np.array([*middle, 0.0]))
        self._matching = _matched(self._known.scenes, scene, number, MUTUAL)
        self.left = len(self._known.scenes)

    def go_on(self, share: float) -> tuple[Pose, Pose] | None:
        """Match the last station with a share of the visits.

        Returns a pose on the new track, and the same in the frame of the visits; None if it is not
        known yet where the robot is.
        """
        for one in islice(self._matching, math.ceil(share * len(self._known.scenes))):
            self._found += [] if one is None else [one]
            self.left -= 1
        return None if self.left else self._located()

    def _located(self) -> tuple[Pose, Pose] | None:
        known, stations = self._known, DriveScenes(self._scenes, np.array(self._poses))
        agreed = _surest(without_clashes(self._found, known, stations), known, stations)
        if not agreed:
            return None
        x, y, _ = here = stations.poses[-1].tolist()
        at, turn, _ = _relations(agreed, known.poses, stations.poses).placed(here[:2])
        return (x, y, 0.0), (*at.tolist(), turn)


def _reliable_matches(ours: DriveScenes, theirs: DriveScenes) -> list[VisitMatch]:
    """Match each visit of a drive with each visit of an earlier one, in all rotations."""
    each = (_matched(ours.scenes, scene, j) for j, scene in enumerate(theirs.scenes))
    return [one for one in chain.from_iterable(each) if one is not None]


def _matched(
    scenes: Sequence[LocalScene], scene: LocalScene, number: int, mutual: float = 0.0
) -> Iterator[VisitMatch | None]:
    """Match the scene with this number with each of some, in all rotations; None if unreliable.

    `mutual` is as in `match`.
    """
    turned = Turned.of(scene, TURNS)
    for i, other in enumerate(scenes):
        found = match(other, turned, mutual)
        yield VisitMatch(i, number, found) if found is not None and is_reliable(found) else None


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


def _surest(
    found: Sequence[VisitMatch], known: DriveScenes, stations: DriveScenes
) -> list[VisitMatch]:
    """Find the relation of the frames that explains best what is seen, and list its matches.

    The evidence for a relation is by how much the agreement at each station exceeds SCORE. The list
    is empty if a relation that puts the robot elsewhere is not shown to be less probable by the
    factor SURE. Where the map does not know what the rival would show, stations with a match count.
    It is also empty if too few stations match (MORE).
    """
    sets, votes = _support(found, _relations(found, known.poses, stations.poses))
    if max(votes, default=0) < MORE:
        return []
    rest, options = np.ones(len(found), bool), list[tuple[float, int, dict[int, Match]]]()
    for k in sorted(range(len(found)), key=lambda k: -votes[k]):
        if rest[k]:
            rest &= ~sets[k]
            agreed = [found[i] for i in np.flatnonzero(sets[k]).tolist()]
            there = _agreements(_relations(agreed, known.poses, stations.poses), known, stations)
            options.append((sum(one.score - SCORE for one in there.values()), k, there))
    (_, best, there), *others = sorted(options, key=lambda option: -option[0])
    agreed = [found[k] for k in np.flatnonzero(sets[best]).tolist()]
    matched = {one.last for one in agreed}
    for _, _, rival in others:
        both = there.keys() & rival.keys()
        better = sum(there[j].score - rival[j].score for j in both)
        better += sum(there[j].score - SCORE for j in (there.keys() - both) & matched)
        odds = WALLS * better * math.log((1 - HIDDEN) / HIDDEN)
        if odds < math.log(SURE) and not (both and _is_one(there[max(both)], rival[max(both)])):
            return []
    unmatched = sum(j not in matched and not is_reliable(one) for j, one in there.items())
    return agreed if len(matched) - unmatched >= MORE else []


def _is_one(first: Match, second: Match) -> bool:
    """Whether a station has nearly the same pose in both matches."""
    twist = math.remainder(first.turn - second.turn, math.tau)
    return math.dist(first.shift, second.shift) < NEAR and abs(twist) < TWIST


def _agreements(
    relation: _FrameMatches, known: DriveScenes, stations: DriveScenes
) -> dict[int, Match]:
    """How each station agrees with the nearest known local map, if one is near.

    Turn and shift are the pose of the station in the frame of the known visits.
    """
    found = {}
    for j, (scene, (x, y, turned)) in enumerate(zip(stations.scenes, stations.poses, strict=True)):
        at, turn, _ = relation.placed(np.array([x, y]))
        far = np.hypot(*(known.poses[:, :2] - at).T)
        if far.min() < MOST:
            pose, other = known.poses[far.argmin()], known.scenes[far.argmin()]
            shift = points_turned(-pose[2], (at - pose[:2])[None])[0]
            one = refined(other, scene, turn + turned - pose[2], shift)
            found[j] = replace(one, turn=one.turn + pose[2], shift=points_moved(pose, one.shift))
    return found


def _support(
    found: Sequence[VisitMatch], relations: _FrameMatches
) -> tuple[list[np.ndarray[tuple[int], np.dtype[np.bool_]]], list[int]]:
    """For each match, return which matches agree with it, and how many later visits these have."""
    visits = np.array([one.last for one in found], int)
    sets = [relations.agreeing(k) for k in range(len(found))]
    return sets, [len(np.unique(visits[mask])) for mask in sets]
