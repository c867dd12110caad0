"""Estimate what dstates show and where actions lead: equations 3 and 4 of `localiser.py`.

A dstate (distinctive state) is a place and the direction that the robot faces there.

A map may have poses, and turns with names of their own such as "turn 91.3". Then another drive
hardly ever has turns of the same names. So turns are compared by their angles: a turn leads to the
dstates of its place that face the direction after the turn.

If the dstates of a map have poses, a displacement of the robot also says where it may be. A
displacement is (dx, dy, dtheta), in metres and radians, in the frame of the robot before it moved.
The robot is not exactly at the pose of a dstate, so displacements from the dstate are as uncertain
as this.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from perception.places.track import at_end, errors_of, pose_rotation, seen_from
from ssh_abduction.data.gateways import ways
from ssh_abduction.data.groups import gathered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.odometry import Covariance, Displacement, Odometry, moved
from ssh_abduction.data.star import SPREAD, Star
from ssh_abduction.data.step import STANDARD_ACTIONS, TURN_DEGREES
from ssh_abduction.data.trace import Action, Trace, View

Array: TypeAlias = NDArray[np.float64]
# A move of the robot: the name of an action, or a turn by whole degrees clockwise.
Move: TypeAlias = str | int
Fact = TypeVar("Fact", bound=tuple[Any, ...])

# A turn leads to dstates that face within FACING standard deviations of the direction after it.
FACING = 3.0
# Dstates at more than FAR standard deviations from the end of a displacement have the density 0.
FAR = 5.0
# Pieces and floors have no relative pose. They are put this many metres apart.
APART = 1e7
# Dstates that the robot left with a smaller probability are not followed.
LEAST = 1e-9
# The margin of a map around its dstates, in metres.
MARGIN = 1.0


@dataclass(frozen=True, eq=False, slots=True)
class Observation:
    """How well an observation o fits each of N dstates x. `localiser.py` defines f and q."""

    # The ids of k dstates, of shape (k,), or a slice of all dstates.
    where: NDArray[np.intp] | slice
    # f(o|x) / q(o) for each of these dstates, of shape (k,). For all others it is 0.
    ratio: NDArray[np.float64]
    # Probability, given o, that an unknown place looks like no dstate of the map. A priori, the N +
    # 1 cases are equally likely: it looks like one of the dstates, or none.
    novel: float

    def __and__(self, other: Observation) -> Observation:
        """Return the observation of both, if they are independent at each of the N + 1 cases.

        `other` has the ratios of all N dstates.
        """
        cases = len(other.ratio) + 1
        ratio = self.ratio * other.ratio[self.where]
        none = self.novel * other.novel * cases
        usual = float(ratio.sum()) / cases + none
        return Observation(self.where, ratio / usual, none / usual) if usual else NOVEL


NOVEL = Observation(np.empty(0, np.intp), np.empty(0), 1.0)


@dataclass(frozen=True)
class Links:
    """Where one action a leads from each of the N dstates."""

    # The probabilities p(x'|x,a), (N, N). Row x' is the end, column x the start. The column of a
    # dstate sums to 1, or is 0 if it is unknown where a leads from there.
    leads: sparse.csr_array
    missing: NDArray[np.float64]  # 1 for each dstate from which it is unknown where a leads, else 0


class Moves:
    """Where the moves of a robot lead from each of the N dstates of a map.

    The trace that was mapped serves to estimate probabilities by counting. Without it, all links
    are those of the map.
    """

    def __init__(self, ssh_map: SSHMap, trace: Trace | None) -> None:
        self._map = ssh_map
        self._links = transitions(ssh_map, trace)
        self._by_angle = _has_turns_of_its_own(ssh_map)

    def move(self, action: Action, turned: float | None = None) -> Move:
        """Return the move of an action.

        `turned` is the angle of the turn by odometry, in radians counterclockwise; None
        takes it from the action.
        """
        if not self._by_angle or action.kind != "turn":
            return action.name
        if turned is not None:
            return round(-math.degrees(turned)) % 360
        angle = TURN_DEGREES.get(action.name) if action.bearing is None else action.bearing
        return action.name if angle is None else round(angle) % 360

    def links(self, move: Move) -> Links | None:
        """Return where a move leads; None if the map has no such action."""
        if isinstance(move, int) and move not in self._links:
            self._links[move] = self._turn(move)
        return self._links.get(move)

    def _turn(self, degrees: int) -> Links:
        """Find where a turn leads: to dstates of its place about `degrees` further clockwise."""
        sources, targets, angles = self._pairs
        off = (angles - degrees + 180) % 360 - 180
        near = np.abs(off) <= FACING * SPREAD
        weights = np.exp(-((off[near] / SPREAD) ** 2) / 2)
        return _links_of(sources[near], targets[near], weights, len(self._map.dstates))

    @cached_property
    def _pairs(self) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
        """Pairs of dstates at one place, and the degrees clockwise from one to the other."""
        assert self._map.fit is not None
        places = np.array([-1 if s.place is None else s.place for s in self._map.dstates])
        sources, targets = np.nonzero((places[:, None] == places) & (places >= 0))
        headings = np.degrees([pose.heading for pose in self._map.fit.poses])
        return sources, targets, headings[sources] - headings[targets]


def _has_turns_of_its_own(ssh_map: SSHMap) -> bool:
    """Whether a map has poses, and links within places whose actions have no standard names."""
    place = {s.id: s.place for s in ssh_map.dstates}
    return (
        ssh_map.fit is not None
        and len(ssh_map.fit.poses) == len(ssh_map.dstates)
        and any(
            place[x] is not None and place[x] == place[y] and x != y
            for x, action, y in ssh_map.links
            if action not in STANDARD_ACTIONS
        )
    )


def _links_of(
    sources: NDArray[np.intp], targets: NDArray[np.intp], weights: NDArray[np.float64], number: int
) -> Links:
    """Make the links of one action from the relative weights of n pairs of dstates."""
    totals = np.bincount(sources, weights, number)
    shares = weights / totals[sources]
    leads = sparse.csr_array((shares, (targets, sources)), shape=(number, number))
    return Links(leads, np.where(totals > 0, 0.0, 1.0))


def view_ratios(ssh_map: SSHMap, trace: Trace | None) -> dict[View, Observation]:
    """For each view v, find the dstates x that show it, and the ratios f(v|x) / q(v).

    The trace that was mapped serves to estimate f by counting (equation 3). The map says what a
    dstate shows if no step of the trace is at it, or if the trace is None (equation 4).
    """
    steps = zip(ssh_map.dstate_at, trace or (), strict=False)
    counts = _counted(
        ((x, step.view) for x, step in steps if step.view is not None),
        ((s.id, s.view) for s in ssh_map.dstates if s.view is not None),
    )
    visits = Counter[int]()
    for (x, _), n in counts.items():
        visits[x] += n
    shown = gathered(
        (view, (x, n / visits[x]))
        for (x, view), n in sorted(counts.items(), key=lambda item: item[0][0])
    )
    number = len(ssh_map.dstates)
    ratios: dict[View, Observation] = {}
    for view, pairs in shown.items():
        f = np.array([p for _, p in pairs])
        ratios[view] = Observation(
            np.array([x for x, _ in pairs], np.intp), f * ((number + 1) / f.sum()), 0.0
        )
    return ratios


class Stars:
    """How well a star (the gateways seen at a place) fits each of the N dstates of a map.

    A star fits a step of the mapped trace if the robot may have faced the same way in both. Let
    f(s|x) be the share of the steps at dstate x that a star s fits. Stars that fit each other are
    not equal, so p(s|x) is only proportional to f. An unknown place looks like none of the dstates
    with a probability of 1 / (N + 1). `misread` is the probability that a star does not fit another
    step of its dstate. It is estimated from the mapped trace, but at least the given value. If that
    is 0, stars always fit.
    """

    def __init__(self, ssh_map: SSHMap, trace: Trace, misread: float) -> None:
        self._number = len(ssh_map.dstates)
        self._seen = gathered(
            (x, step.gateways)
            for x, step in zip(ssh_map.dstate_at, trace, strict=True)
            if step.gateways is not None
        )
        fits = [_fit(one, other) for stars in self._seen.values() for one, other in pairwise(stars)]
        self.misread = misread and max(misread, (1 + fits.count(False)) / (10 + len(fits)))

    def of(self, star: Star) -> Observation:
        """Return the observation of a star. Dstates whose star was not seen have the ratio 1."""
        f = np.full(self._number, np.nan)
        for x, stars in self._seen.items():
            f[x] = np.mean([_fit(star, other) for other in stars])
        mean = float(np.nanmean(f))
        ratio = np.nan_to_num(f / (mean or 1.0), nan=1.0)
        ratio = self.misread + (1 - self.misread) * ratio
        return Observation(slice(None), ratio, 1 - float(ratio.sum()) / (self._number + 1))


@lru_cache(maxsize=2**16)
def _fit(one: Star, other: Star) -> bool:
    """Whether the robot may have faced the same way when it saw two stars."""
    return any(
        first.slots == then.slots and ways(first, then, shift, frozenset((0,)))[0]
        for first in one.frames
        for then in other.frames
        for shift in range(first.slots)
    )


def transitions(ssh_map: SSHMap, trace: Trace | None) -> dict[Move, Links]:
    """For the name of each action, find where the action leads.

    The trace that was mapped serves to estimate probabilities by counting (equation 3). The links
    of the map say where an action leads if the trace lacks it there, or is None (equation 4).
    """
    labels = ssh_map.dstate_at
    steps = zip(labels, trace.actions if trace else (), labels[1:], strict=False)
    counts = _counted(((x, a.name, y) for x, a, y in steps if not a.starts), ssh_map.links)
    entries = gathered((action, (x, y, n)) for (x, action, y), n in counts.items())
    links: dict[Move, Links] = {}
    for action, listed in entries.items():
        sources, targets, tries = np.array(listed).T
        links[action] = _links_of(sources, targets, tries, len(ssh_map.dstates))
    return links


def _counted(of_trace: Iterable[Fact], of_map: Iterable[Fact]) -> Counter[Fact]:
    """Count facts (dstate, …, result) of a trace; where it has none, take those of the map."""
    counts = Counter(of_trace)
    known = {fact[:-1] for fact in counts}
    counts.update({fact for fact in of_map if fact[:-1] not in known})
    return counts


@dataclass(frozen=True, eq=False)
class Motion:
    """A displacement with its error."""

    displacement: Displacement  # (dx, dy, dtheta), in metres and radians
    noise: Array  # its covariance, (3, 3)

    @classmethod
    def of(cls, displacement: Displacement, covariance: Covariance, odometry: Odometry) -> Motion:
        """Make a motion, with the systematic errors of the odometry added to its covariance."""
        dx, dy, _ = displacement
        way = math.hypot(dx, dy)
        long = odometry.scale * np.array([dx, dy, 0.0])
        # A steady drift turns the robot by half of its sum when it is in the middle of the way.
        drift = odometry.bend * way * np.array([-dy / 2, dx / 2, 1.0])
        noise = np.array(covariance) + np.outer(long, long) + np.outer(drift, drift)
        return cls(displacement, noise)

    def then(self, other: Motion) -> Motion:
        """Return this motion followed by another one."""
        turned = pose_rotation(self.displacement[2])
        noise = at_end(turned @ other.displacement, self.noise)
        end = moved(self.displacement, other.displacement)
        return Motion(end, noise + turned @ other.noise @ turned.T)

    def error(self, odometry: Odometry) -> Array:
        """The covariance of the end relative to a dstate, (3, 3), if the start is at a dstate.

        The robot is off its dstate at both ends. The pose of the map has an error like the motion.
        """
        off = np.diag([odometry.offset**2, odometry.offset**2, odometry.facing**2])
        return 2 * self.noise + off + at_end(np.array(self.displacement), off)


@dataclass(frozen=True, eq=False, slots=True)
class Away:
    """The robot left a dstate some steps ago, and was at no dstate of the map since."""

    probabilities: Array  # the probability of this for each dstate that it left, (N,)
    motion: Motion  # the motion since then

    @property
    def total(self) -> float:
        """The probability of all dstates that the robot may have left."""
        return float(self.probabilities.sum())

    def after(self, motion: Motion, probability: float) -> Away:
        """Return this part after another motion, if it goes on with this probability."""
        return Away(probability * self.probabilities, self.motion.then(motion))


class DeadReckoning:
    """Where displacements lead in a map of N dstates with poses, (N, 3).

    `frame` has the number of the frame of each dstate, (N,). Pieces and floors have frames of their
    own. `odometry` says how far off a dstate the robot is at each visit.
    """

    def __init__(self, poses: Array, frame: NDArray[np.intp], odometry: Odometry) -> None:
        self._poses, self._odometry = poses, odometry
        self._spots = np.column_stack([poses[:, :2], APART * frame])
        self._tree = cKDTree(self._spots)
        sizes = np.ones(len(poses))
        for number in set(frame.tolist()):
            width, length = np.ptp(poses[frame == number, :2], axis=0) + 2 * MARGIN
            sizes[frame == number] = width * length
        self._uniform = 1 / (sizes * math.tau)

    @classmethod
    def of(cls, ssh_map: SSHMap, odometry: Odometry) -> DeadReckoning | None:
        """Return the poses of a map; None if it has none."""
        if ssh_map.fit is None or len(ssh_map.fit.poses) != len(ssh_map.dstates):
            return None
        piece_of = {s: number for number, piece in enumerate(ssh_map.pieces) for s in piece}
        frames = [(piece_of.get(s.id, 0), s.floor) for s in ssh_map.dstates]
        number_of = {frame: number for number, frame in enumerate(dict.fromkeys(frames))}
        frame = np.array([number_of[frame] for frame in frames], np.intp)
        poses = np.array([(pose.x, pose.y, pose.heading) for pose in ssh_map.fit.poses])
        return cls(poses, frame, odometry)

    def along(self, links: sparse.csr_array, motion: Motion) -> sparse.csr_array:
        """Compute p(x'|x,a) p(d|x,a,x') / q(d) for the links of an action a and a motion d, (N, N).

        q is the density at an unknown place: as from one of the links, or as broad as all of them
        together. Each of these cases is equally likely. `links` is p(x'|x,a), (N, N): row x' is the
        end, column x the start.
        """
        targets, starts = links.nonzero()
        ways = seen_from(self._poses[starts], self._poses[targets])
        error = motion.error(self._odometry)
        onward = np.array(motion.displacement)
        near = _gaussian(errors_of(ways, onward), error)
        # Turn the ways about their mean heading, so that their headings have a variance.
        mean = math.atan2(np.sin(ways[:, 2]).mean(), np.cos(ways[:, 2]).mean())
        centre = np.array([*ways[:, :2].mean(axis=0), mean])
        broad = np.diag((errors_of(ways, centre) ** 2).mean(axis=0)) + error
        usual = near.sum() + _gaussian(errors_of(onward, centre)[None], broad)[0]
        weighed = links[targets, starts] * near * ((len(near) + 1) / usual)
        return sparse.csr_array((weighed, (targets, starts)), shape=links.shape)

    def arrivals(self, away: Away, unmapped: float) -> tuple[Array, Away]:
        """Compute where a robot may be that went away from a dstate by no link of the map.

        `unmapped` is the prior probability that the end is at no dstate of the map. Return the
        probability of each dstate, (N,), and the part for which it is at none.
        """
        starts = np.flatnonzero(away.probabilities > LEAST)
        p, motion = away.probabilities[starts], away.motion
        error = motion.error(self._odometry)
        ends = self._moved(starts, motion)
        radius = FAR * math.sqrt(np.linalg.eigvalsh(error[:2, :2])[-1])
        near = self._tree.query_ball_point(ends, radius)
        which = np.repeat(np.arange(len(near)), [len(some) for some in near])
        targets = np.array([target for some in near for target in some], np.intp)
        prior = (1 - unmapped) / len(self._poses)
        ways = seen_from(self._poses[starts[which]], self._poses[targets])
        known = prior * _gaussian(errors_of(ways, np.array(motion.displacement)), error)
        none = unmapped * self._uniform[starts]
        total = np.bincount(which, known, len(starts)) + none
        share = np.divide(p, total, out=np.zeros_like(p), where=total > 0)
        stays = away.probabilities.copy()
        stays[starts] = np.where(total > 0, none * share, p)
        arrived = np.bincount(targets, known * share[which], len(self._poses))
        return np.asarray(arrived, np.float64), Away(stays, motion)

    def _moved(self, starts: NDArray[np.intp], motion: Motion) -> Array:
        """Where a motion leads from some dstates, as points of the tree, (n, 3)."""
        cos, sin = np.cos(self._poses[starts, 2]), np.sin(self._poses[starts, 2])
        dx, dy, _ = motion.displacement
        moves = np.column_stack([cos * dx - sin * dy, sin * dx + cos * dy, np.zeros(len(starts))])
        return np.asarray(self._spots[starts] + moves)


def _gaussian(off: Array, covariance: Array) -> Array:
    """Compute the densities of n errors, (n, 3), by a normal distribution."""
    squares = np.einsum("ni,ij,nj->n", off, np.linalg.inv(covariance), off)
    scale = math.sqrt(np.linalg.det(math.tau * covariance))
    return np.asarray(np.exp(-squares / 2) / scale)
