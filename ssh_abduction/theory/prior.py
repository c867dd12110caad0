"""The prior probabilities of the cost of a map: of poses, views and stars.

The cost of a map is -log of its marginal likelihood: the probability of all displacements, closures
and views, integrated over the unknown poses. The prior says:

- The building has N places. They are about one travel apart, so N = A / l² for the area A of the
  building and the usual length l of a travel. Half of them, and at least two, are new to the robot.
  The robot comes to each with the same probability. The positions of places are uniform over A,
  and headings are uniform over 2 pi.
- A move leads to something near its end: to a known dstate, to a new dstate of a known place, or
  to a new place. If nothing known is near, it has to be something new (`chosen`).
- A dstate has a view with the probability that steps before it give it (`_surprises`). So has a
  place its number of gateways. But if an alias lays a part of the building on another part, it
  mostly shows the same.

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
from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence
from functools import cached_property
from statistics import median
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.drives import travels_of
from ssh_abduction.data.groups import first_index_of, indices_of, numbered
from ssh_abduction.data.odometry import Odometry
from ssh_abduction.data.trace import Step, Trace
from ssh_abduction.theory.evidence.loops import vectors_turned
from ssh_abduction.theory.fields import FAULT, MISREAD
from ssh_abduction.theory.theory import Theory

Array: TypeAlias = NDArray[np.float64]
Ints: TypeAlias = NDArray[np.int_]
Flags: TypeAlias = NDArray[np.bool_]
# The pose (x, y, heading) of each dstate, (dstates, 3), and the frame or the place of each.
Laid: TypeAlias = tuple[Array, Ints]

# The building reaches this many metres beyond the poses of dead reckoning, on each side.
AROUND = 3.0
# One of UNSEEN places of the building is new to the robot, halfway through its drive. At least
# FEWEST places are new.
UNSEEN, FEWEST = 2.0, 2.0
# A move may lead to what is known near its end: within about half of the usual length of a travel,
# and within about AIM radians. UNKNOWN is how many new places, and new headings of a place, are
# near a known one. Places are a usual travel apart, so four lie around a place, and half are new.
AIM = 0.5
UNKNOWN: Array = np.array([2 * math.exp(-2), AIM / math.sqrt(math.tau)])
# A bound leaves out what a move leads to with a smaller probability. There is always NOTHING.
UNLIKELY, NOTHING = 0.01, 1e-300
# If the odometry says that the robot may be off the poses of dstates, the standard deviation is at
# least this, in metres and radians.
LEAST = 1e-3


class MoveChoices(NamedTuple):
    """What n moves may lead to.

    Attributes:
        nats: The logarithm of the number of choices, (n,).
        far: How unlikely it is to come to the position of each dstate, in nats, (n, dstates).
        turned: The same for its heading, (n, dstates).
        dstates: The share of each known dstate in these choices, (n, dstates).
        places: The share of new dstates of known places. The first dstate of a place has it.
    """

    nats: Array
    far: Array
    turned: Array
    dstates: Array
    places: Array


class Pulls(NamedTuple):
    """Terms ½ w r² of a function of poses, for n pairs of dstates.

    Each r is the difference between a displacement and the one between the poses.

    Attributes:
        first: The dstates from which the displacements lead, (n,).
        last: The dstates to which they lead, (n,).
        moved: The displacements, (n, 3).
        weight: The w of x, y and turn, (n, 3). They may be negative.
        of: The dstate with which the term is lost if it is joined with earlier ones, or -1, (n,).
    """

    first: Ints
    last: Ints
    moved: Array
    weight: Array
    of: Ints


class LeastMoves(NamedTuple):
    """A lower bound on what moves cost in maps that join more dstates and places.

    Attributes:
        nats: The bound if none are joined, at the best poses.
        saved: By how much it is lower for each dstate, and place, that is joined with earlier ones.
        pulls: How it is at other poses.
    """

    nats: float
    saved: tuple[Array, Array]
    pulls: Pulls


class _FirstMoves(NamedTuple):
    """The first moves along n links.

    Attributes:
        steps: The steps to which the moves lead, (n,).
        begin: The dstates from which they lead, (n,).
        end: The dstates to which they lead, (n,).
        moved: The displacements, (n, 3).
        new: Whether the place, and the dstate, was new, (n, 2).
    """

    steps: Ints
    begin: Ints
    end: Ints
    moved: Array
    new: Flags

    def off(self, choices: MoveChoices) -> Array:
        """Return how unlikely it is to come to where the links lead, in nats, (n,)."""
        off: Array = (choices.far + choices.turned)[range(len(self.end)), self.end]
        return off - self.new @ np.log(UNKNOWN)


class Prior:
    """The prior probabilities of one trace.

    Attributes:
        area: The area A of the building in square metres.
        crowd: The logarithm of the number of places that are new to the robot.
        wide: The covariance of a Gaussian with the density of the prior at its mean: for x, y and
            heading, (3,).
        base: For each step, what to add to the volume of a map of the steps up to it (`Poses`). A
            map in which each step is at a new place then costs what its places cost. (steps,)
        saved: What a new position, and a new heading, save at most at each step, (steps, 2): a move
            that ends near nothing known has to lead somewhere (`chosen`).
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
        self._turns = np.array([False, *(action.kind == "turn" for action in trace.actions)])
        self._stays = self._turns & stays
        noise, spreads = np.tile(np.diag(self.wide), (len(trace), 1, 1)), spreads_of(trace)
        for t in (measured := [t for t in range(1, len(trace)) if trace.covariance(t)]):
            noise[t] = trace.covariance(t)
        off = noise + spreads[:, :, None] * np.identity(3)
        both, at = self.gain(off), self.gain(off[:, :2, :2])
        told: Array = np.zeros((len(trace), 2))
        told[measured] = np.stack([at, both - at], 1)[measured]
        self.saved: Array = np.zeros((len(trace), 2))
        near = math.log(self.area / math.tau / self.near**2)
        self.saved[measured] = near - self.crowd, -math.log(UNKNOWN[1])
        self.saved[self._stays, 0] = 0.0
        # The nats that a new position, and a new heading, cost at each step at least.
        self._apart: Array = np.maximum(told - [self.crowd, 0.0] - self.saved, 0.0)
        self._volume = volume = (np.log(self.wide).sum() - np.linalg.slogdet(noise)[1]) / 2
        if spreads.any():
            volume = volume - np.log(math.tau * spreads).sum(1) / 2
        self.base: Array = np.cumsum((self._apart + self.saved).sum(1) + self.crowd - volume)
        self._trace, names = trace, [action.name for action in trace.actions]
        self._shows = _shows(trace, theory)
        self.seen: Array = np.array([_surprises(some, names) for some in self._shows]).T
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
        return self.crowd + float((self._apart + self.saved)[step, : size - 1].sum())

    def lost(self, wrong: Iterable[int]) -> float:
        """Return the nats that it costs not to believe the displacements to some steps."""
        return float(self._volume[[*wrong]].sum())

    def shown(self, dstates: Sequence[int], places: Sequence[Hashable]) -> float:
        """Return the nats of dstates and places besides their poses, given by step.

        It takes the end of each move to be near nothing known. `chosen` has the rest.
        """
        seen = (
            float(self.seen[self._showing(of, steps), of] - self.saved[steps[0], 1 - of])
            for of, names in enumerate((dstates, places))
            for steps in indices_of(names).values()
        )
        return math.fsum([*seen, -self.crowd * len({*places})])

    def least_shown(self, of: int, steps: Sequence[int]) -> Array:
        """Return what dstates (of=0) or places cost at least by what they show, by first steps.

        If views may be misread, it may be less than at these steps.
        """
        return np.minimum(
            self.seen[steps, of], self.seen[:, of].min() if self._misreads else math.inf
        )

    def _showing(self, of: int, steps: Sequence[int]) -> int:
        """Return the step of a dstate (of=0) or place whose observation has a cost."""
        nats = self.seen[steps, of]
        return steps[int(nats.argmin() if self._misreads else (nats > 0).argmax())]

    def chosen(
        self,
        dstates: Sequence[int],
        places: Sequence[Hashable],
        laid: Laid,
        wrong: Collection[int] = (),
    ) -> float:
        """Return the nats that moves cost as they might have led to what is known near their ends.

        `dstates` and `places` are given by step. The poses of dstates come by first visit, and no
        displacement connects two frames. The displacements to `wrong` steps are not believed.
        """
        links, asked = self._links(dstates, places, laid)
        found = self.choices(*asked)
        nats = np.maximum(found.nats + links.off(found), 0.0)
        saved = (self.saved[links.steps] * links.new).sum(1)
        return float(np.where(np.isin(links.steps, [*wrong]), saved, nats).sum())

    def least_chosen(
        self,
        dstates: Sequence[int],
        places: Sequence[Hashable],
        laid: Laid,
        apart: tuple[Flags, Flags],
    ) -> LeastMoves:
        """Bound `chosen` of all maps that join more dstates and places.

        They join none that are known to be `apart`, (dstates, dstates) and (places, places).
        """
        links, (steps, ends, here, at, known) = self._links(dstates, places, laid)
        begin, end, of = links.begin, links.end, at[1]
        names = np.array(numbered(self._trace.actions[t - 1].name for t in steps.tolist()))
        known &= apart[1][np.ix_(here, of)] | self._turns[steps, None]
        found = self.choices(steps, ends, here, at, known)
        ways = (
            _likely_apart(found.dstates, apart[0]),
            _likely_apart(found.places, apart[1][of][:, of]),
        )
        found = self.choices(steps, ends, here, at, *ways)
        nats = found.nats + links.off(found)
        # If a dstate is joined with an earlier one, this one may have made the move before. If the
        # end is joined with earlier ones, the link may cost nothing.
        before = (steps[:, None] > steps) & (names[:, None] == names)
        may_join = [np.tril(~some, -1).sum(axis=1) > 0 for some in apart]
        joined = np.stack([may_join[1][of[end]], may_join[0][end]], axis=1)
        new = (links.new & joined) * -np.log(UNKNOWN)
        counts = ~(before & ~apart[0][np.ix_(begin, begin)]).any(axis=1)
        counts &= nats > new.sum(axis=1)
        # As an action leads to one dstate, no link leads to a dstate before its first step.
        perhaps = ~counts & links.new[:, 1]
        nats[perhaps] -= new[perhaps, 0]
        new[perhaps, 0], new[perhaps, 1] = 0.0, nats[perhaps]
        counts |= perhaps & (nats > 0)
        saved = np.zeros((2, len(of)))
        np.add.at(saved[0], end[counts], new[counts, 1])
        np.add.at(saved[1], of[end[counts]], new[counts, 0])
        moves = ~self._stays[steps]
        pull = -np.stack([(found.dstates + found.places) * moves[:, None], found.dstates], -1)
        pull[range(len(nats)), end] += np.stack([moves, np.ones(len(nats))], 1)
        i, to = np.nonzero(counts[:, None] & pull.any(axis=-1))
        spread = np.array([self.near, self.near, AIM]) ** 2
        weight = pull[i, to][:, [0, 0, 1]] / spread
        pulls = Pulls(begin[i], to, links.moved[i], weight, np.where(perhaps, end, -1)[i])
        return LeastMoves(float(nats[counts].sum()), (saved[0], saved[1, : len(apart[1])]), pulls)

    def _links(
        self, dstates: Sequence[int], places: Sequence[Hashable], laid: Laid
    ) -> tuple[_FirstMoves, tuple[Ints, Array, Ints, Laid, Flags]]:
        """Collect the first move along each link, and what `choices` asks of it."""
        labels, (poses, frame) = np.array(numbered(dstates)), laid
        first, first_at = (np.array([*first_index_of(x).values()]) for x in (dstates, places))
        of = np.array(numbered(places))[first]
        names, told = [action.name for action in self._trace.actions], self._trace.steps
        begun = first_index_of(zip(dstates, names, dstates[1:], strict=False)).values()
        steps = np.array([t + 1 for t in begun if told[t + 1].displacement is not None], dtype=int)
        moved = np.array([told[t].displacement for t in steps]).reshape(-1, 3)
        begin, end = labels[steps - 1], labels[steps]
        gone = vectors_turned(moved[:, :2], poses[begin, 2])
        ends = poses[begin] + np.column_stack([gone, moved[:, 2]])
        known = (first < steps[:, None]) & (frame[begin, None] == frame)
        new = np.stack([first_at[of[end]], first[end]], 1) == steps[:, None]
        first_moves = _FirstMoves(steps, begin, end, moved, new)
        return first_moves, (steps, ends, of[begin], (poses, of), known)

    def choices(
        self,
        steps: Ints,
        ends: Array,
        here: Ints,
        laid: Laid,
        known: Flags,
        known_places: Flags | None = None,
    ) -> MoveChoices:
        """Count what moves may lead to.

        Args:
            steps: The steps to which the moves lead, (n,).
            ends: The poses where they end, (n, 3).
            here: The places where they begin, (n,).
            laid: The poses and the places of dstates.
            known: Whether a dstate was known before the move, in its frame, (n, dstates).
            known_places: The same for places, if it differs. The first dstate of a place has it.
        """
        poses, places = laid
        stays, same = self._stays[steps, None], here[:, None] == places
        far = ((poses[:, :2] - ends[:, None, :2]) ** 2).sum(2) / (2 * self.near**2) * ~stays
        turned = (poses[:, 2] - ends[:, 2:] + math.pi) % math.tau - math.pi
        turned = turned**2 / (2 * AIM**2)
        near = np.exp(-far) * np.where(stays, same, ~same | self._turns[steps, None])
        of_dstates, of_places = known * near * np.exp(-turned), np.zeros_like(near)
        if self._has_places:  # a known place may have a new dstate
            first = [*first_index_of(places.tolist()).values()]
            known_places = known if known_places is None else known_places
            of_places[:, first] = (known_places * near)[:, first] * UNKNOWN[1]
        unknown = np.where(stays, NOTHING, UNKNOWN.prod())
        count = (of_dstates + of_places).sum(axis=1, keepdims=True) + unknown
        return MoveChoices(np.log(count)[:, 0], far, turned, of_dstates / count, of_places / count)

    def repeated(self, of: int, names: Sequence[int], pairs: Mapping[int, int]) -> float:
        """Return the nats that `shown` saves if dstates (of=0) or places (of=1) repeat others.

        `names` has the number of the dstate or place of each step, and `pairs` the number of the
        one that it repeats.
        """
        saved, steps = 0.0, indices_of(names)
        for name, other in pairs.items():
            step, then = (self._showing(of, steps[i]) for i in (name, other))
            here, there = self._shows[of][step], self._shows[of][then]
            if None not in (*here, *there):
                chance, odd = math.exp(-self.seen[step, of]), math.exp(-MISREAD)
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


def _surprises(shows: Sequence[tuple[Hashable, ...]], actions: Sequence[str]) -> list[float]:
    """Return -log of the probability of what each step shows, given all steps before it.

    It shows what earlier steps showed after the same action, where the same was shown before it;
    or else what any earlier step showed; or else anything. None, which is unknown, has no cost.
    """
    count, found = Counter[Hashable](), [0.0] * len(shows)
    for k, kind in enumerate(zip(*shows, strict=True)):
        for t, name in enumerate(kind):
            chance = 1 / max(len({*kind} - {None}), 1)
            for before in [(k,), (k, kind[t - 1], *actions[t - 1 : t])][: t + 1]:
                chance = (count[before, name] + chance) / (count[before] + 1)
                count.update([(before, name), before] if name is not None else [])
            found[t] -= math.log(chance) * (name is not None)
    return found


def _likely_apart(shares: Array, apart: Flags) -> Flags:
    """For each row of shares, flag some that are not UNLIKELY, and are apart from each other."""
    left, flags = np.where(shares > UNLIKELY, shares, 0.0), np.zeros(shares.shape, dtype=bool)
    rows = np.arange(len(left))
    while left.any():
        most = left.argmax(axis=1)
        flags[rows, most] |= left[rows, most] > 0
        left = left * apart[most]
        left[rows, most] = 0.0
    return flags


def _star(step: Step) -> Hashable:
    """Return the number of gateways that a step shows; None if it is unknown."""
    seen = step.gateways.gateways if step.gateways else (None,)
    return len(seen) if all(gateway and gateway.open for gateway in seen) else None
