"""Estimate what dstates show and where actions lead: equations 3 and 4 of `localiser.py`.

A dstate (distinctive state) is a place and the direction that the robot faces there.

A map may have poses, and turns with names of their own such as "turn 91.3". Then another drive
hardly ever has turns of the same names. So turns are compared by their angles: a turn leads to the
dstates of its place that face the direction after the turn.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ssh_abduction.data.action import STANDARD_ACTIONS, TURN_DEGREES
from ssh_abduction.data.groups import gathered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.rotations import ways
from ssh_abduction.data.star import SPREAD, Star
from ssh_abduction.data.trace import Action, Trace, View
from ssh_abduction.online.belief import Observation

# A move of the robot: the name of an action, or a turn by whole degrees clockwise.
Move: TypeAlias = str | int

# A turn leads to dstates that face within FACING standard deviations of the direction after it.
FACING = 3.0


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
        self._links: dict[Move, Links] = {}
        self._links.update(transitions(ssh_map, trace).items())
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
    # Count the steps at each dstate that show each view.
    counts = Counter[tuple[int, View]]()
    if trace is not None:
        counts.update(
            (x, step.view)
            for x, step in zip(ssh_map.dstate_at, trace, strict=True)
            if step.view is not None
        )
    seen = {x for x, _ in counts}
    counts.update(
        (s.id, s.view) for s in ssh_map.dstates if s.id not in seen and s.view is not None
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


def transitions(ssh_map: SSHMap, trace: Trace | None) -> dict[str, Links]:
    """For the name of each action, find where the action leads.

    The trace that was mapped serves to estimate probabilities by counting (equation 3). The links
    of the map say where an action leads if the trace lacks it there, or is None (equation 4).
    """
    # Count how often each action led from one dstate to another.
    counts = Counter[tuple[int, str, int]]()
    labels = ssh_map.dstate_at
    if trace is not None:
        counts.update(
            (x, action.name, y)
            for x, action, y in zip(labels, trace.actions, labels[1:], strict=False)
            if not action.starts
        )
    tried = {(x, action) for x, action, _ in counts}
    counts.update({link for link in ssh_map.links if link[:2] not in tried})
    entries = gathered((action, (x, y, n)) for (x, action, y), n in counts.items())
    links: dict[str, Links] = {}
    for action, listed in entries.items():
        sources, targets, tries = np.array(listed).T
        links[action] = _links_of(sources, targets, tries, len(ssh_map.dstates))
    return links
