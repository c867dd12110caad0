"""A *part*: a map of some drives, with the joint Gaussian distribution of its poses."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.trace import Trace
from ssh_abduction.solver.guesses.reckoning import Hypothesis
from ssh_abduction.solver.guesses.sights import Sight, Sights
from ssh_abduction.solver.steps.log import Log

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A map of some drives. The fields that are not listed are as in `Hypothesis`.

    Attributes:
        seen: For each dstate, what its steps show, as numbers.
        stars: For each dstate, the star of its last step.
        sights: For each place, what each drive saw of it.
        kept: The dstates of a map that must be kept, each with its piece of that map.
    """

    labels: Mapping[int, int]
    places: list[int]
    seen: list[frozenset[int]]
    stars: list[Sight]
    links: Mapping[tuple[int, int], int]
    sights: Sequence[Mapping[int, Sight]]
    position: NDArray[np.int_]
    heading: NDArray[np.int_]
    mean: Array
    covariance: Array
    nats: float
    kept: frozenset[tuple[int, int]] = frozenset()

    @classmethod
    def of(cls, found: Hypothesis, first: int, log: Log, sights: Sights) -> Part:
        """Make a part of a hypothesis about a drive that begins with step `first` of a log."""
        labels = {first + t: label for t, label in enumerate(found.labels)}
        poses = np.array([*(i + k for i in found.position for k in (0, 1)), *found.heading])
        mean, covariance = found.mean[poses], found.covariance[np.ix_(poses, poses)]
        return cls.of_steps(labels, found.places, (mean, covariance), found.nats, log, sights)

    @classmethod
    def of_steps(
        cls,
        labels: Mapping[int, int],
        places: Sequence[int],
        poses: tuple[Array, Array],
        nats: float,
        log: Log,
        sights: Sights,
    ) -> Part:
        """Make a part from labels (the dstate of each step) and the place of each dstate.

        `poses` are the means and the covariance of x and y of each place, in metres, and then of
        the heading of each dstate, in radians. `nats` is the cost of the part. `log` and `sights`
        are those of the whole trace.
        """
        seen: list[set[int]] = [set() for _ in places]
        stars: list[Sight] = [None for _ in places]
        links: dict[tuple[int, int], int] = {}
        shown: list[dict[int, Sight]] = [{} for _ in range(max(places) + 1)]
        for t, label in labels.items():
            seen[label].add(sights.seen[t])
            stars[label] = sights.shown[t]
            shown[places[label]][sights.drive[t]] = sights.shown[t]
            if t + 1 in labels:
                links[label, log.actions[t]] = labels[t + 1]
        n = len(shown)
        position, heading = 2 * np.arange(n), 2 * n + np.arange(len(places))
        numbers = [frozenset(shows) for shows in seen]
        return cls(
            labels, list(places), numbers, stars, links, shown, position, heading, *poses, nats
        )

    @property
    def step_at(self) -> dict[int, int]:
        """A step at each dstate."""
        return {label: t for t, label in self.labels.items()}

    @property
    def positions(self) -> Array:
        """The position of each place."""
        return np.stack([self.mean[self.position], self.mean[self.position + 1]], 1)

    @property
    def poses(self) -> tuple[Array, Array]:
        """The position and the heading of each dstate."""
        return self.positions[self.places], self.mean[self.heading]

    def usual_travel(self, trace: Trace) -> float:
        """Return the median length in metres of the moves of these drives that are no turns."""
        moves = [trace.steps[t].displacement or (0.0, 0.0, 0.0) for t in self.labels]
        ways = [math.hypot(dx, dy) for dx, dy, _ in moves]
        least = max(ways) / 10
        return median([way for way in ways if way > least] or [1.0])

    def beside(self, other: Part) -> Part:
        """Put another part beside this one. The frames of the two stay unrelated."""
        n, m, dstates = len(self.mean), len(other.mean), len(self.places)
        covariance = np.zeros((n + m, n + m))
        covariance[:n, :n], covariance[n:, n:] = self.covariance, other.covariance
        return Part(
            {**self.labels, **{t: dstates + s for t, s in other.labels.items()}},
            [*self.places, *(len(self.sights) + p for p in other.places)],
            [*self.seen, *other.seen],
            [*self.stars, *other.stars],
            {**self.links, **{(dstates + s, a): dstates + x for (s, a), x in other.links.items()}},
            [*self.sights, *other.sights],
            np.concatenate([self.position, n + other.position]),
            np.concatenate([self.heading, n + other.heading]),
            np.concatenate([self.mean, other.mean]),
            covariance,
            self.nats + other.nats,
            self.kept | {(dstates + s, piece) for s, piece in other.kept},
        )
