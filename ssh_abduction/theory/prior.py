"""The prior probabilities of the cost of a map: of poses, views and stars.

The cost of a map is -log of its marginal likelihood: the probability of all displacements, closures
and views, integrated over the unknown poses. The prior says:

- The building has N places. They are about one travel apart, so N = A / l² for the area A of the
  building and the usual length l of a travel. Half of them, and at least two, are new to the robot.
  The robot comes to each with the same probability. The positions of places are uniform over A,
  and headings are uniform over 2 pi.
- A dstate has a view with the probability with which steps have it. So has a place its number of
  gateways. But if a part of the building repeats another part, it mostly shows the same.

A displacement to a new place has the density 1/A, and there are N/2 new places. A displacement
to a known place must agree with it: its density is that of a Gaussian with the covariance S with
which the map predicts the displacement. S is never smaller than the covariance C of the
displacement itself. A cost of 0 stands for a step that could not be predicted better. So a new
place costs log A - 1/2 log |2 pi C| - log N/2 nats (`place`). A is in both A and N, so it
matters only where a displacement is missing: a new place then costs nothing, and a known one
log N/2. So parts of a trace that no displacement connects share places only if several agree.

Reference:
    Reid 1979, "An algorithm for tracking multiple targets"; MacKay 2003, "Information theory,
    inference, and learning algorithms", chapter 28 (the Occam factor).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Hashable, Iterable, Mapping, Sequence
from functools import cached_property
from statistics import median
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.drives import travels_of
from ssh_abduction.data.groups import gathered
from ssh_abduction.data.odometry import Odometry
from ssh_abduction.data.trace import Step, Trace
from ssh_abduction.theory.fields import FAULT, MISREAD
from ssh_abduction.theory.theory import Theory

Array: TypeAlias = NDArray[np.float64]

# The building reaches this many metres beyond the poses of dead reckoning, on each side.
AROUND = 3.0
# One of UNSEEN places of the building is new to the robot, halfway through its drive. At least
# FEWEST places are new.
UNSEEN, FEWEST = 2.0, 2.0
# If the odometry says that the robot may be off the poses of dstates, the standard deviation is at
# least this, in metres and radians.
LEAST = 1e-3


class Prior:
    """The prior probabilities of one trace.

    Attributes:
        area: The area A of the building in square metres.
        crowd: The logarithm of the number of places that are new to the robot.
        wide: The covariance of a Gaussian with the density of the prior at its mean: for x, y and
            heading, (3,).
        base: For each step, what to add to the volume of a map of the steps up to it (`Poses`). A
            map in which each step is at a new place then costs what its places cost. (steps,)
        seen: The nats of what each step shows of its dstate, and of its place, (steps, 2).
        near: Half of the usual length of a travel, in metres.
    """

    def __init__(self, trace: Trace, theory: Theory) -> None:
        """Compute the priors of a trace."""
        self.area = _area(trace)
        self.wide = wide_of(trace)
        self._has_places = theory.level == "topological"
        ways = travels_of(trace)
        usual = median(ways) ** 2 if ways else self.area
        self.near = math.sqrt(usual) / 2
        self.crowd = math.log(max(self.area / (UNSEEN * usual), FEWEST))
        stays = self._has_places and "turn_stays" in theory.hard and not theory.jumped
        kinds = ["", *(action.kind for action in trace.actions)]
        self._stays = np.array([stays and kind == "turn" for kind in kinds])
        noise, spreads = np.tile(np.diag(self.wide), (len(trace), 1, 1)), spreads_of(trace)
        for t in (measured := [t for t in range(1, len(trace)) if trace.covariance(t)]):
            noise[t] = trace.covariance(t)
        off = noise + spreads[:, :, None] * np.identity(3)
        both, at = self.gain(off), self.gain(off[:, :2, :2])
        told: Array = np.zeros((len(trace), 2))
        told[measured] = np.stack([at, both - at], 1)[measured]
        # The nats that a new position, and a new heading, cost at each step.
        self._apart: Array = np.maximum(told - [self.crowd, 0.0], 0.0)
        self._volume = volume = (np.log(self.wide).sum() - np.linalg.slogdet(noise)[1]) / 2
        if spreads.any():
            volume = volume - np.log(math.tau * spreads).sum(1) / 2
        self.base: Array = np.cumsum(self._apart.sum(1) + self.crowd - volume)
        self._shows = _shows(trace, theory)
        self.seen: Array = np.array([*map(_nats_of, self._shows)]).T
        self._repeats = bool(trace.closures)
        self._misreads = bool(theory.misread or theory.changed)

    @property
    def place(self) -> Array:
        """The nats that a new place costs at each step, (steps,)."""
        nats: Array = self._apart[:, 0] * self._has_places + self.seen[:, 1]
        return nats

    @property
    def dstate(self) -> Array:
        """The nats that a new dstate costs at each step, (steps,). In causal maps it is a place."""
        nats: Array = self._apart[:, 1] + self._apart[:, 0] * (not self._has_places)
        return nats + self.seen[:, 0]

    @property
    def new(self) -> Array:
        """The nats that a new dstate, and a new place, cost at each step at least, (steps, 2).

        That is without what they show.
        """
        new = self._apart[:, ::-1]
        return new if self._has_places else new.sum(axis=1, keepdims=True) * [1.0, 0.0]

    def gain(self, spread: Array) -> Array:
        """Return how many nats more density a prediction gives than the prior does.

        Args:
            spread: Covariances S of the prediction, (…, k, k): of a heading (k = 1), of a position
                (k = 2), or of both (k = 3). The density is that of the best prediction.
        """
        wide = np.diag(np.split(self.wide, [2])[1] if spread.shape[-1] == 1 else self.wide)
        wider = spread + wide[: spread.shape[-1], : spread.shape[-1]]
        gain: Array = (np.linalg.slogdet(wider)[1] - np.linalg.slogdet(spread)[1]) / 2
        return gain

    def predicted(self, step: int, size: int = 3) -> float:
        """Return what a known place, or dstate (size = 3), costs at a step, if it gains nothing."""
        return self.crowd + float(self._apart[step, : size - 1].sum())

    def lost(self, wrong: Iterable[int]) -> float:
        """Return the nats that it costs not to believe the displacements to some steps."""
        return float(self._volume[[*wrong]].sum())

    def shown(self, dstates: Sequence[int], places: Sequence[Hashable]) -> float:
        """Return the nats of dstates and places besides their poses, given by step."""
        pick = min if self._misreads else max  # an unknown view agrees with each view
        seen = (
            float(pick(self.seen[steps, of]))
            for of, names in enumerate((dstates, places))
            for steps in gathered(zip(names, range(len(names)), strict=True)).values()
        )
        return math.fsum([*seen, -self.crowd * len({*places})])

    def least_shown(self, of: int, steps: Sequence[int]) -> float:
        """Return what some steps cost at least by what they show of a dstate (of=0) or place.

        If views may be misread, it may be less than at the steps.
        """
        return float(self.seen[:, of].min() if self._misreads else self.seen[[*steps], of].max())

    def repeated(self, of: int, names: Sequence[int], pairs: Mapping[int, int]) -> float:
        """Return the nats that `shown` saves if dstates (of=0) or places (of=1) repeat others.

        `names` has the number of the dstate or place of each step, and `pairs` the number of the
        one that it repeats.
        """
        pick, saved = min if self._misreads else max, 0.0
        nats = self.seen[:, of].tolist()
        steps = gathered(zip(names, range(len(names)), strict=True))
        step = {name: pick(steps[name], key=nats.__getitem__) for name in {*pairs, *pairs.values()}}
        for name, other in pairs.items():
            here, there = (self._shows[of][step[i]] for i in (name, other))
            if None not in (*here, *there):
                chance, odd = math.exp(-nats[step[name]]), math.exp(-MISREAD)
                saved += math.log((1 - odd) * (here == there) / chance + odd)
        return saved

    def least(self, dstates: Sequence[int], places: Sequence[int]) -> tuple[Array, Array]:
        """Return lower bounds on what 0, 1, 2, … dstates, and places, cost.

        The arguments are the steps, besides the first one, that may be the first steps at a dstate,
        and at a place.
        """
        seen = self.seen
        if self._misreads:  # a dstate may have a more probable view than its first step
            seen = np.minimum(seen, seen.min(axis=0))
        # What a part of the building repeats may cost nothing to show.
        seen = seen * (not self._repeats)
        new = self.new + (seen if self._has_places else seen.sum(axis=1, keepdims=True) * [1, 0])
        of_dstates, of_places = np.sort(new[[*dstates], 0]), np.sort(new[[*places], 1])
        return np.cumsum([0.0, 0.0, *of_dstates]), np.cumsum([0.0, 0.0, *of_places])

    @cached_property
    def _least(self) -> tuple[Array, Array]:
        return self.least(range(1, len(self.seen)), np.flatnonzero(~self._stays)[1:].tolist())

    def at_least(
        self, counts: Mapping[str, int], least: tuple[Array, Array] | None = None
    ) -> float:
        """Return a lower bound on the cost of maps with at least these counts, in nats.

        Args:
            counts: The least numbers of "dstates", of "places", and of "tenths": dstates and faults
                together, in tenths of a dstate.
            least: What `least` returns, if more is known of the first steps.
        """
        dstates, places = least or self._least
        tenths = counts.get("tenths", 0)
        some = np.arange(min(tenths // 10, len(dstates) - 1) + 1)
        nats = max(
            dstates[min(counts.get("dstates", 0), len(dstates) - 1)],
            (dstates[some] + FAULT * (tenths / 10 - some)).min(),
        )
        return float(nats + places[min(counts.get("places", 0), len(places) - 1)])


def wide_of(trace: Trace) -> Array:
    """Compute the covariance of a Gaussian with the density of the prior at its mean, (3,)."""
    area = _area(trace)
    return np.array([area / math.tau, area / math.tau, math.tau])


def spreads_of(trace: Trace) -> Array:
    """Compute the variances of the pose of the robot at each step, relative to its dstate.

    A dstate has one pose in a map, but the robot is not at exactly this pose on each visit. Turns
    do not move it, so the k steps of a visit share one error of position. To count this error once,
    each of the steps gets k times its variance. The result has variances of x, y and heading,
    (steps, 3), in square metres and square radians. They are 0 if the odometry declares no such
    errors.
    """
    odometry = trace.odometry or Odometry()
    visit = np.cumsum([1, *(action.kind != "turn" for action in trace.actions)]) - 1
    steps = np.bincount(visit)[visit].astype(float)
    spreads = np.zeros((len(trace), 3))
    if odometry.offset or odometry.facing:
        spreads[:, :2] = (steps * max(odometry.offset, LEAST) ** 2)[:, None]
        spreads[:, 2] = max(odometry.facing, LEAST) ** 2
    return spreads


def _area(trace: Trace) -> float:
    """Return the area in square metres in which places may be.

    It is the largest bounding box of a stretch of dead reckoning, with AROUND on each side.
    """
    found, at, facing = [0.0], [(0.0, 0.0)], 0.0

    def box() -> float:
        sides = [max(some) - min(some) + 2 * AROUND for some in zip(*at, strict=True)]
        return float(math.prod(sides))

    for step in trace.steps[1:]:
        if step.displacement is None:
            found.append(box())
            at, facing = [(0.0, 0.0)], 0.0
            continue
        dx, dy, turn = step.displacement
        (x, y), cos, sin = at[-1], math.cos(facing), math.sin(facing)
        at.append((x + cos * dx - sin * dy, y + sin * dx + cos * dy))
        facing += turn
    return max(*found, box())


def _shows(trace: Trace, theory: Theory) -> list[list[tuple[Hashable, ...]]]:
    """List what each step shows of its dstate, and what it shows of its place. None is unknown."""
    stars = [_star(step) if theory.star != "none" else None for step in trace.steps]
    if theory.level == "causal":
        kinds = [trace.views, stars] if theory.star != "none" else [trace.views]
        return [[*zip(*kinds, strict=True)], [() for _ in stars]]
    return [[(view,) for view in trace.views], [(star,) for star in stars]]


def _nats_of(shows: Sequence[tuple[Hashable, ...]]) -> list[float]:
    """Return the nats of what each step shows. Unknown views and stars have no cost."""
    shares = [(_shares(kind), kind) for kind in zip(*shows, strict=True)]
    return [sum(share[kind[t]] for share, kind in shares) for t in range(len(shows))]


def _shares(shown: Sequence[Hashable]) -> Mapping[Hashable, float]:
    """Return -log of the share of the steps that show each thing. None has the share 1."""
    count = Counter(name for name in shown if name is not None)
    return {None: 0.0, **{name: math.log(count.total() / n) for name, n in count.items()}}


def _star(step: Step) -> Hashable:
    """Return the number of gateways that a step shows; None if it is unknown."""
    seen = step.gateways.gateways if step.gateways else (None,)
    return len(seen) if all(gateway and gateway.open for gateway in seen) else None
