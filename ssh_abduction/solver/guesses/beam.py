"""Guess the dstates and places of a trace from its displacements, by a beam of hypotheses.

A *hypothesis* says at which dstate and place each step so far is. It has the joint Gaussian
distribution of the positions of its places, the headings of its dstates, and the errors that all
displacements share. It costs the prices of its dstates and places, and half of the chi-square of
its returns, as a map does (`solver/weighing.py`).

A closure says how a step lies relative to an earlier one. It moves the poses of a hypothesis when
the later step comes, and its misfit adds to the cost.

Each step extends each hypothesis in all ways that cost little: the robot is at a known dstate, at a
new dstate of a known place, or at a new place. The *beam* is the hypotheses of least cost. The
checker looks at them every few steps. So a hypothesis that breaks an axiom does not crowd out
others for long.

The equations are linear in the neighbourhood of the means. So the cost of a hypothesis is close to
the cost of its map, and not equal to it.

References:
    Smith, Self & Cheeseman 1990, "Estimating uncertain spatial relationships in robotics".
    Reid 1979, "An algorithm for tracking multiple targets" (hypotheses in a beam).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import islice, product
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.checker.checker import violations
from ssh_abduction.data.closure import Closure
from ssh_abduction.data.gateways import rotations
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.odometry import Odometry
from ssh_abduction.data.star import Star
from ssh_abduction.data.trace import Step
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.solver.equations import noise_of, noises
from ssh_abduction.solver.guesses.completing import completed
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.settle import Problem

Array: TypeAlias = NDArray[np.float64]

# The checker looks at the beam after this many steps.
CHECKED_EVERY = 8
# If no hypothesis is left, look for this many times as many.
WIDER = 2
# Of the beams at earlier looks, this many hypotheses are kept.
SPARE = 2
# An extension that costs this many nats more than the best one of its hypothesis is not made.
DEAREST = 20.0
# Added to variances, in square metres and square radians, so that no matrix is singular.
BLUR = 1e-6
# The standard deviations, in metres and radians, of a move without a displacement.
UNKNOWN = (1e3, 1e3, 3.0)
# The first entries of the means: how wrong the scale and the drift are, in standard deviations.
SCALE, BEND = 0, 1


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """What a robot may have visited.

    Attributes:
        labels: The dstate of each step so far.
        places: The place of each dstate.
        shows: For each dstate, a number for what is seen there.
        links: For each dstate and action, the dstate that it leads to.
        sights: For each place, what its first step shows of it.
        position: For each place, the index of its x in the means; y is the next one.
        heading: For each dstate, the index of its heading in the means.
        mean: The means in metres, radians and standard deviations.
        covariance: Their covariance.
        nats: The cost.
    """

    labels: list[int]
    places: list[int]
    shows: list[int]
    links: dict[tuple[int, int], int]
    sights: list[Star | tuple[bool, ...] | None]
    position: list[int]
    heading: list[int]
    mean: Array
    covariance: Array
    nats: float


@dataclass(frozen=True, slots=True)
class _Extension:
    """A way to extend a hypothesis by a step.

    Attributes:
        nats: The cost of the longer hypothesis.
        place: The known place; None if it is new.
        dstate: The known dstate; None if it is new.
        of: The hypothesis. Its means end with the pose after the last move.
    """

    nats: float
    place: int | None
    dstate: int | None
    of: Hypothesis


class Beam:
    """The search for hypotheses of little cost.

    Attributes:
        nats: The cost of the best hypothesis of the whole trace; inf before there is one.
    """

    def __init__(self, problem: Problem, log: Log, width: int) -> None:
        """Search nothing yet.

        Args:
            problem: A trace and a theory. The maps have no faults, also if the theory allows them.
            log: The trace as integers.
            width: How many hypotheses are kept.
        """
        trace, theory = problem.trace, problem.theory
        self._trace, self._log, self._width, self._problem = trace, log, width, problem
        self._bare = theory.without_faults().replace(displacement="none", weigh="count")
        self._has_places = theory.level == "topological"
        self._stays = self._has_places and "turn_stays" in theory.hard
        self._leaves = self._has_places and "travel_leaves" in theory.hard
        self._price, self._price_of_place = theory.prices[:2]
        if not self._has_places:
            self._price_of_place = 0.0
        odometry = trace.odometry or Odometry()
        self._sigma = odometry.scale, odometry.bend
        steps = [t for t in range(1, len(trace)) if trace.steps[t].displacement is not None]
        self._noise = dict(zip(steps, noises(trace, steps), strict=True))
        # The closures of each step, and their covariances.
        self._closures: dict[int, list[tuple[Closure, Array]]] = {}
        for closure in trace.closures:
            told = closure, noise_of(closure, odometry)
            self._closures.setdefault(closure.last, []).append(told)
        self.nats = math.inf
        self._sights = [self._sight(step) for step in trace.steps]

    def maps(self) -> Iterator[SSHMap]:
        """The maps of the hypotheses of the whole trace that agree with the axioms, by their cost.

        If no hypothesis is left, go back, and for some steps let the robot return to a place only
        if it has to. If that is not enough, go back twice as far.
        """
        kept = [[self._first()]]  # the beams after each look of the checker
        while (done := len(kept[-1][0].labels)) < len(self._trace):
            end = min(done + CHECKED_EVERY, len(self._trace))
            beam = self._extended(kept[-1], end)
            back = 1
            while not beam:
                beam = self._checked(kept[-back], end) or self._checked(
                    kept[-back], end, joins=False
                )
                if back == len(kept):
                    break
                back = min(2 * back, len(kept))
            if not beam:
                return
            kept[-1] = kept[-1][:SPARE]  # saves memory
            kept.append(beam)
        self.nats = float(kept[-1][0].nats)
        for found in kept[-1]:
            if (ssh_map := self._map(found, len(self._trace))) is not None:
                yield ssh_map

    def nats_without_axioms(self) -> float:
        """The cost of the best hypothesis if the checker does not look; inf if none is left.

        Actions still lead to one dstate, and stars at one place still agree.
        """
        beam = self._onward([self._first()], len(self._trace))
        return float(beam[0].nats) if beam else math.inf

    def _onward(self, beam: list[Hypothesis], end: int) -> list[Hypothesis]:
        """Extend a beam to a number of steps. Nothing is checked."""
        for t in range(len(beam[0].labels), end):
            options = self._options_of(beam, t, joins=True)
            beam = list(islice((self._child(option, t) for option in options), self._width))
        return beam

    def _sight(self, step: Step) -> Star | tuple[bool, ...] | None:
        """What a step shows of its place, in any direction: its star, or nothing."""
        if self._bare.star == "gateways":
            return step.gateways or Star(())
        star = step.openings if self._bare.star in ("pattern", "frame") else None
        return None if star is None else min(star[k:] + star[:k] for k in range(4))

    def _extended(self, beam: list[Hypothesis], end: int) -> list[Hypothesis]:
        """Extend a beam to a number of steps, and check it then."""
        begun = len(beam[0].labels)
        longer = self._onward(beam, end)
        return [found for found in longer if self._map(found, begun) is not None]

    def _checked(self, beam: list[Hypothesis], end: int, joins: bool = True) -> list[Hypothesis]:
        """Extend a beam to a number of steps, and check each hypothesis at each step.

        Args:
            beam: The beam.
            end: The number of steps.
            joins: Whether a new dstate or place costs its price. If not, the robot returns to a
                place only if it has to.
        """
        for t in range(len(beam[0].labels) if beam else end, end):
            children = (self._child(option, t) for option in self._options_of(beam, t, joins))
            valid = (child for child in children if self._map(child, t) is not None)
            beam = list(islice(valid, WIDER * self._width))
        return beam

    def _first(self) -> Hypothesis:
        mean, covariance = np.zeros(5), np.zeros((5, 5))
        covariance[[SCALE, BEND], [SCALE, BEND]] = 1.0
        return Hypothesis(
            [0],
            [0],
            [self._log.seen[0]],
            {},
            self._sights[:1],
            [2],
            [4],
            mean,
            covariance,
            self._price,
        )

    def _map(self, found: Hypothesis, since: int) -> SSHMap | None:
        """The map of a hypothesis if it agrees with the axioms and the evidence.

        Args:
            found: The hypothesis.
            since: How many of its first steps were checked already.
        """
        look_at_clock()
        steps = len(found.labels)
        trace, theory = self._trace.prefix(steps), self._bare.of_steps(0, steps)
        facing: list[float] = found.mean[found.heading].tolist()
        ssh_map = completed(trace, theory, found.labels, found.places, facing)
        if (
            ssh_map is None
            or next(violations(trace, ssh_map, theory), None) is not None
            or any(e.refuse(self._trace, ssh_map, since) for e in self._problem.evidence)
        ):
            return None
        return ssh_map

    def _options_of(self, beam: Sequence[Hypothesis], t: int, joins: bool) -> list[_Extension]:
        """The ways to extend the hypotheses of a beam by step t, by their cost."""
        look_at_clock()
        options = [
            option for found in beam for option in self._options(self._moved(found, t), t, joins)
        ]
        return sorted(options, key=lambda option: option.nats)

    def _moved(self, found: Hypothesis, t: int) -> Hypothesis:
        """Append the pose after the move to step t to the means of a hypothesis."""
        here = found.labels[-1]
        at, heading = found.position[found.places[here]], found.heading[here]
        mean, n = found.mean, len(found.mean)
        displacement = self._trace.steps[t].displacement
        dx, dy, turn = displacement or (0.0, 0.0, 0.0)
        way = math.hypot(dx, dy)
        scale = 1 + mean[SCALE] * self._sigma[SCALE]
        drift = mean[BEND] * self._sigma[BEND] * way
        facing = mean[heading] - drift / 2
        cos, sin = math.cos(facing), math.sin(facing)
        gone = np.array([cos * dx - sin * dy, sin * dx + cos * dy]) / scale
        aside = np.array([-gone[1], gone[0]])
        by = np.zeros((3, n))
        by[0, at] = by[1, at + 1] = by[2, heading] = 1.0
        by[:2, heading] = aside
        by[:2, SCALE] = -gone * self._sigma[SCALE] / scale
        by[:2, BEND] = aside * (-way / 2 * self._sigma[BEND])
        by[2, BEND] = -way * self._sigma[BEND]
        rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, scale]]) / scale
        noise = self._noise[t] if t in self._noise else np.diag(UNKNOWN) ** 2
        covariance = np.empty((n + 3, n + 3))
        covariance[:n, :n] = found.covariance
        covariance[n:, :n] = by @ found.covariance
        covariance[:n, n:] = covariance[n:, :n].T
        covariance[n:, n:] = covariance[n:, :n] @ by.T + rotation @ noise @ rotation.T
        pose = [*(mean[at : at + 2] + gone), mean[heading] + turn - drift]
        moved = replace(found, mean=np.concatenate([mean, pose]), covariance=covariance)
        for closure, spread in self._closures.get(t, ()):
            moved = self._closed(moved, closure, spread)
        return moved

    def _closed(self, moved: Hypothesis, closure: Closure, noise: Array) -> Hypothesis:
        """Update a hypothesis by a closure that leads to the last pose of its means.

        Args:
            moved: The hypothesis.
            closure: The closure.
            noise: The covariance of the closure, 3 x 3, with the errors of both ends.
        """
        mean, n = moved.mean, len(moved.mean) - 3
        there = moved.labels[closure.first]
        at, heading = moved.position[moved.places[there]], moved.heading[there]
        cos, sin = math.cos(mean[heading]), math.sin(mean[heading])
        back = np.array([[cos, sin], [-sin, cos]])
        gone = back @ (mean[n : n + 2] - mean[at : at + 2])
        # How the pose, relative to the earlier step, depends on the means.
        by = np.zeros((3, n + 3))
        by[:2, n : n + 2], by[:2, at : at + 2] = back, -back
        by[:2, heading] = gone[1], -gone[0]
        by[2, n + 2], by[2, heading] = 1.0, -1.0
        off = np.array([*gone, mean[n + 2] - mean[heading]]) - closure.displacement
        off[2] = math.remainder(off[2], math.tau)
        across = moved.covariance @ by.T
        solved = np.linalg.solve(by @ across + noise, np.column_stack([off, across.T]))
        covariance = moved.covariance - across @ solved[:, 1:]
        return replace(
            moved,
            mean=mean - across @ solved[:, 0],
            covariance=(covariance + covariance.T) / 2,
            nats=moved.nats + float(off @ solved[:, 0]) / 2,
        )

    def _options(self, moved: Hypothesis, t: int, joins: bool) -> list[_Extension]:
        """The ways to extend a hypothesis by step t that cost little."""
        here, action, seen = moved.labels[-1], self._log.actions[t - 1], self._log.seen[t]
        known = moved.links.get((here, action))
        if known is not None:
            if moved.shows[known] != seen:
                return []
            nats = moved.nats + self._squares(moved, [moved.places[known]], known)[0] / 2
            return [_Extension(nats, moved.places[known], known, moved)]
        stays = self._stays and self._trace.actions[t - 1].kind == "turn"
        there = moved.places[here]
        if stays:
            places = [there]
        else:
            places = [
                place
                for place, sight in enumerate(moved.sights)
                if (place != there or not self._leaves) and _agree(sight, self._sights[t])
            ]
        dstate, new_place = (self._price, self._price_of_place) if joins else (0.0, 0.0)
        options = []
        if not stays:
            nats = moved.nats + dstate + new_place
            options.append(_Extension(nats, None, None, moved))
        squares = self._squares(moved, places) if places else np.zeros(0)
        for place, square in zip(places, squares.tolist(), strict=True):
            if square / 2 > DEAREST and not stays:
                continue
            if self._has_places:
                nats = moved.nats + dstate + square / 2
                options.append(_Extension(nats, place, None, moved))
            for s, p in enumerate(moved.places):
                if p == place and moved.shows[s] == seen:
                    nats = moved.nats + float(self._squares(moved, [place], s)[0]) / 2
                    options.append(_Extension(nats, place, s, moved))
        least = min(option.nats for option in options)
        return [
            option
            for option in options
            if option.nats <= least + DEAREST and self._is_allowed(option, t)
        ]

    def _is_allowed(self, option: _Extension, t: int) -> bool:
        """Whether no pair of steps that evidence excludes becomes one dstate or place."""
        labels, places = option.of.labels, option.of.places
        if option.dstate is not None:
            return self._log.pairs.allow(t, [*labels, option.dstate], places)
        place = len(option.of.position) if option.place is None else option.place
        return self._log.pairs.allow(t, [*labels, len(places)], [*places, place])

    def _squares(
        self, moved: Hypothesis, places: Sequence[int], dstate: int | None = None
    ) -> Array:
        """The chi-square if the last pose is at each of some places, or at a dstate of one."""
        n = len(moved.mean) - 3
        at = np.array([moved.position[p] for p in places])
        rows = np.stack([at, at + 1], 1)
        last = np.array([n, n + 1])
        if dstate is not None:
            rows = np.concatenate([rows, [[moved.heading[dstate]]]], 1)
            last = np.array([n, n + 1, n + 2])
        off = moved.mean[last] - moved.mean[rows]
        if dstate is not None:
            off[:, 2] -= math.tau * np.round(off[:, 2] / math.tau)
        c = moved.covariance
        crossed = c[rows[:, :, None], last[None, None, :]]
        spread = (
            c[np.ix_(last, last)][None]
            + c[rows[:, :, None], rows[:, None, :]]
            - crossed
            - crossed.transpose(0, 2, 1)
            + BLUR * np.identity(len(last))
        )
        squares: Array = np.einsum("ni,ni->n", off, np.linalg.solve(spread, off[..., None])[..., 0])
        return squares

    def _child(self, option: _Extension, t: int) -> Hypothesis:
        """Make an extended hypothesis."""
        moved = option.of
        n = len(moved.mean) - 3
        mean, covariance = moved.mean, moved.covariance
        position, heading, places, shows = moved.position, moved.heading, moved.places, moved.shows
        last, keep, sights = [n, n + 1, n + 2], [*range(n)], moved.sights
        if option.place is not None:
            rows = [position[option.place], position[option.place] + 1]
            rows += [] if option.dstate is None else [heading[option.dstate]]
            mean, covariance = _conditioned(mean, covariance, last[: len(rows)], rows)
            keep += last[len(rows) :]
        else:
            keep += last
            position, sights = [*position, n], [*sights, self._sights[t]]
        place = len(moved.position) if option.place is None else option.place
        there = option.dstate
        if there is None:
            there = len(places)
            places, shows = [*places, place], [*shows, self._log.seen[t]]
            heading = [*heading, len(keep) - 1]
        return Hypothesis(
            [*moved.labels, there],
            places,
            shows,
            {**moved.links, (moved.labels[-1], self._log.actions[t - 1]): there},
            sights,
            position,
            heading,
            mean[keep],
            covariance[np.ix_(keep, keep)],
            option.nats,
        )


def _agree(first: Star | tuple[bool, ...] | None, second: Star | tuple[bool, ...] | None) -> bool:
    """Whether two sights may be of one place."""
    if isinstance(first, Star) and isinstance(second, Star):
        return _may_fit(first, second)
    return first == second


@lru_cache(maxsize=2**14)
def _may_fit(first: Star, second: Star) -> bool:
    """Whether two stars agree with some shift of their gateways."""
    return any(
        rotations(frame, other, shift)
        for frame, other in product(first.frames, second.frames)
        for shift in range(max(frame.slots, 1))
    )


def _conditioned(
    mean: Array, covariance: Array, first: Sequence[int], second: Sequence[int]
) -> tuple[Array, Array]:
    """Condition a Gaussian on equalities of entries. The third entry is an angle."""
    off = mean[first] - mean[second]
    off[2:] -= math.tau * np.round(off[2:] / math.tau)
    across = covariance[:, first] - covariance[:, second]
    spread = across[first] - across[second] + BLUR * np.identity(len(off))
    gain = np.linalg.solve(spread, across.T).T
    conditioned = covariance - gain @ across.T
    return mean - gain @ off, (conditioned + conditioned.T) / 2
