"""Hypotheses about the dstates and places of some steps, with one Gaussian of their poses.

A hypothesis is extended by a step (`beam.py`), or two of its places are merged (`overlay.py`). It
has the joint Gaussian distribution of the positions of its places and the headings of its dstates.
The equations are linear only near the means. So the chi-square of a hypothesis is close to that of
its map, but not equal to it.

A *piece* is a part of a hypothesis whose poses are in one frame. Each drive begins a new piece, and
so does each stretch after a lift. If the robot comes to a dstate of another piece, the heading
there fixes the two frames to each other. If the two pieces have only a place in common, this place
is a *hinge*: the new piece can still turn around it. The next place that the two pieces have in
common decides by how much it is turned. Before two pieces are joined, the means of one are turned
until they agree with the other.

Reference:
    Smith, Self & Cheeseman 1990, "Estimating uncertain spatial relationships in robotics".
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice, product
from statistics import median
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.drives import frames_of
from ssh_abduction.data.groups import gathered, numbered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.odometry import Closure, Displacement, Odometry
from ssh_abduction.data.trace import Trace
from ssh_abduction.solver.geometry.equations import noises
from ssh_abduction.solver.geometry.poses import Poses
from ssh_abduction.solver.sources.metric.completing import valid_map
from ssh_abduction.solver.sources.metric.sights import Sight, Sights, seen_at_both
from ssh_abduction.solver.steps.faults import with_faults
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.prior import Prior, spreads_of
from ssh_abduction.theory.theory import Theory

Array: TypeAlias = NDArray[np.float64]

# This is added to variances, in square metres and square radians, so that no matrix is singular.
BLUR = 1e-6
# The standard deviations, in metres and radians, of a move without a displacement.
UNKNOWN = (1e3, 1e3, 3.0)
# If the standard deviation of the sum of all turns exceeds this, in radians, linear equations are
# too rough: if the robot drives on for 10 m, they miss its position by about 0.5 m.
ROUGH = 0.3
# Displacements of at most this many next steps are compared with the links of a hypothesis.
AHEAD = 16
# The indices of the first entries of the means of a drive: the errors of the scale and of the drift
# of the odometry, in standard deviations.
SCALE, BEND = 0, 1
# The direction from one position to another is too uncertain to use if they are closer than this
# many metres.
NEAR = 1.0
# Try at most this many ways to turn the pieces with hinges: all ways for two pieces.
TURNS = 16


@dataclass(frozen=True, slots=True)
class Pieces:
    """Which poses of a hypothesis are in one frame. Pieces are named by their first steps.

    Attributes:
        here: The piece that the robot is in.
        of_place: The piece of each place.
        of_heading: The piece of the heading of each dstate.
        hinges: For each piece that has only a place in common with others: this place.
        joins: How pieces were joined: triples of a piece, and the place and dstate of another piece
            that the robot came to. The dstate is None if only the place was known.
    """

    here: int = 0
    of_place: tuple[int, ...] = (0,)
    of_heading: tuple[int, ...] = (0,)
    hinges: Mapping[int, int] = field(default_factory=dict)
    joins: tuple[tuple[int, int, int | None], ...] = ()

    @property
    def is_loose(self) -> bool:
        """Whether the piece that the robot is in is not joined to any other piece yet."""
        return self.here > 0 and all(piece != self.here for piece, _, _ in self.joins)

    def grown(self, place: bool, dstate: bool) -> Pieces:
        """Add a new place, or a new dstate, or both, to the piece of the robot."""
        return replace(
            self,
            of_place=self.of_place + (self.here,) * place,
            of_heading=self.of_heading + (self.here,) * dstate,
        )

    def merged(self, other: int) -> Pieces:
        """Make the piece of the robot a part of another piece."""
        of_place = tuple(other if piece == self.here else piece for piece in self.of_place)
        of_heading = tuple(other if piece == self.here else piece for piece in self.of_heading)
        hinges = {
            piece: place
            for piece, place in self.hinges.items()
            if piece not in (self.here, of_place[place])
        }
        return replace(self, here=other, of_place=of_place, of_heading=of_heading, hinges=hinges)


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A hypothesis about the dstate and place of some steps, with its poses and its cost.

    Attributes:
        labels: The dstate of each step.
        places: The place of each dstate.
        seen: For each dstate, the observations there as numbers (`Sights.seen`), each with the cost
            in nats of treating it as misread at all its steps.
        links: For each (dstate, action) with a link, the dstate that it leads to.
        sights: For each place, what each drive saw of it (`Sights.shown`), the last drive last.
        position: For each place, the index of its x in the means; y is the next one.
        heading: For each dstate, the index of its heading in the means.
        mean: The means, in metres, radians and standard deviations. In a beam, the errors of scale
            and drift come before positions and headings, and the pose of the robot (x, y, heading)
            comes last.
        covariance: The covariance of the means.
        nats: The cost.
        square: The chi-square of the returns and closures.
        faults: Pairs (step, kind): the steps at which an action "slipped" or a displacement
            "jumped".
        pieces: Which poses are in one frame.
        kept: The dstates of a map that must be kept, each with its piece of that map.
    """

    labels: Mapping[int, int]
    places: list[int]
    seen: list[Mapping[int, float]]
    links: Mapping[tuple[int, int], int]
    sights: list[Mapping[int, Sight]]
    position: list[int]
    heading: list[int]
    mean: Array
    covariance: Array
    nats: float
    faults: tuple[tuple[int, str], ...] = ()
    pieces: Pieces = field(default_factory=Pieces)
    kept: frozenset[tuple[int, int]] = frozenset()
    square: float = 0.0

    @classmethod
    def empty(cls, nats: float) -> Hypothesis:
        """Make the hypothesis before the first step, with the robot at the origin."""
        mean, covariance = np.zeros(5), np.zeros((5, 5))
        covariance[[SCALE, BEND], [SCALE, BEND]] = 1.0
        pieces = Pieces(0, (), ())
        return cls({}, [], [], {}, [], [], [], mean, covariance, nats, pieces=pieces)

    @classmethod
    def of_steps(
        cls,
        labels: Mapping[int, int],
        places: list[int],
        poses: tuple[Array, Array],
        nats: float,
        log: Log,
        sights: Sights,
    ) -> Hypothesis:
        """Make a hypothesis from labels (the dstate of each step) and the place of each dstate.

        `poses` are the means and the covariance of x and y of each place, in metres, and then of
        the heading of each dstate, in radians. `nats` is the cost. `log` and `sights` are those of
        the whole trace.
        """
        seen: list[dict[int, float]] = [{} for _ in places]
        links: dict[tuple[int, int], int] = {}
        shown: list[dict[int, Sight]] = [{} for _ in range(max(places) + 1)]
        for t, label in labels.items():
            seen[label] = seen_at_both(seen[label], {sights.seen[t]: sights.doubts[t]})
            shown[places[label]][sights.drive[t]] = sights.shown[t]
            if t + 1 in labels:
                links[label, log.actions[t]] = labels[t + 1]
        n = 2 * len(shown)
        position, heading = [*range(0, n, 2)], [*range(n, n + len(places))]
        return cls(labels, places, [*seen], links, [*shown], position, heading, *poses, nats)

    @property
    def here(self) -> int:
        """The dstate of the last step, if all steps up to it are known."""
        return self.labels[len(self.labels) - 1]

    @property
    def step_at(self) -> dict[int, int]:
        """The last step at each dstate."""
        return {label: t for t, label in self.labels.items()}

    @property
    def positions(self) -> Array:
        """The position of each place."""
        x = np.array(self.position)
        return np.stack([self.mean[x], self.mean[x + 1]], 1)

    @property
    def poses(self) -> tuple[Array, Array]:
        """The position and the heading of each dstate."""
        return self.positions[self.places], self.mean[self.heading]

    @property
    def laid(self) -> tuple[Array, NDArray[np.int_]]:
        """The pose of each dstate, (dstates, 3), and its piece."""
        return np.column_stack(self.poses), np.array(self.pieces.of_heading)

    def slips(self, t: int) -> bool:
        """Whether the action to step t, the newest step, slipped."""
        return self.faults[-1:] == ((t - 1, "slipped"),)

    def usual_travel(self, trace: Trace) -> float:
        """Return the median length in metres of the moves of these steps that are no turns."""
        moves = [trace.steps[t].displacement or (0.0, 0.0, 0.0) for t in self.labels]
        ways = [math.hypot(dx, dy) for dx, dy, _ in moves]
        least = max(ways) / 10
        return median([way for way in ways if way > least] or [1.0])

    def ssh_map(self, trace: Trace, theory: Theory, sights: Sights) -> SSHMap | None:
        """Make the map of these steps, which are those of the trace; None if it breaks an axiom.

        The theory may allow misread views, but no other faults.
        """
        if theory.misread:
            mended, bare = self.mended(trace, sights, theory), theory.replace(misread=0.0)
            found = self.ssh_map(mended, bare, sights)
            return found and with_faults(found, trace, mended, theory)
        labels = [self.labels[t] for t in sorted(self.labels)]
        order = list(dict.fromkeys(labels))  # of first visits
        places, facing = numbered(self.places[s] for s in order), self.poses[1][order].tolist()
        return valid_map(trace, theory, numbered(labels), places, facing)

    def mended(self, trace: Trace, sights: Sights, theory: Theory) -> Trace:
        """Return the trace of these steps, where each step shows what is right at its dstate."""
        steps = list(trace.steps)
        for i, t in enumerate(sorted(self.labels)):
            right = sights.example(sights.right(self.seen[self.labels[t]]))
            steps[i] = replace(steps[i], view=right.view)
            if theory.star in ("pattern", "frame"):
                steps[i] = replace(steps[i], star=right.star)
        return replace(trace, steps=tuple(steps))

    def beside(self, other: Hypothesis) -> Hypothesis:
        """Put a hypothesis about other steps beside this one. Their frames stay unrelated."""
        n, m, dstates = len(self.mean), len(other.mean), len(self.places)
        covariance = np.zeros((n + m, n + m))
        covariance[:n, :n], covariance[n:, n:] = self.covariance, other.covariance
        return Hypothesis(
            {**self.labels, **{t: dstates + s for t, s in other.labels.items()}},
            [*self.places, *(len(self.sights) + p for p in other.places)],
            [*self.seen, *other.seen],
            {**self.links, **{(dstates + s, a): dstates + x for (s, a), x in other.links.items()}},
            [*self.sights, *other.sights],
            [*self.position, *(n + x for x in other.position)],
            [*self.heading, *(n + x for x in other.heading)],
            np.concatenate([self.mean, other.mean]),
            covariance,
            self.nats + other.nats,
            kept=self.kept | {(dstates + s, piece) for s, piece in other.kept},
        )


def parts_of(
    fitted: tuple[Sequence[int], Array, Array, Array],
    labels: Sequence[int],
    places: Sequence[int],
    log: Log,
    sights: Sights,
    pieces: Mapping[int, int] | None = None,
) -> list[Hypothesis]:
    """Make a hypothesis for each part of a map that displacements and closures connect.

    Its cost in nats is the misfit alone.

    Args:
        fitted: What `Poses.gaussian` returns for the map.
        labels: The dstate of each step of a trace.
        places: The place of each dstate, numbered by first dstate.
        log: The log of the trace.
        sights: What each step of the trace shows.
        pieces: If the map must be kept, its piece for each dstate.
    """
    part, mean, covariance, squares = fitted
    found, first = [], 2 * (max(places) + 1)
    for number in dict.fromkeys(part):
        dstates = [s for s, other in enumerate(part) if other == number]
        index = {s: i for i, s in enumerate(dstates)}
        at = dict.fromkeys(places[s] for s in dstates)
        entries = [2 * p + k for p in at for k in (0, 1)] + [first + s for s in dstates]
        poses = mean[entries], covariance[np.ix_(entries, entries)]
        of_steps = {t: index[s] for t, s in enumerate(labels) if s in index}
        here, nats = numbered(places[s] for s in dstates), float(squares[number]) / 2
        kept = frozenset((i, pieces[s]) for s, i in index.items()) if pieces else frozenset()
        made = Hypothesis.of_steps(of_steps, here, poses, nats, log, sights)
        found.append(replace(made, kept=kept))
    return found


class HypothesisPoses:
    """Updates the poses of hypotheses by the displacements and closures of a trace.

    Attributes:
        is_rough: Whether poses must be fitted anew now and then (`settled`), as the equations are
            linear only near the means. In a single frame, this is so if the robot may be off the
            poses of its dstates (`spreads_of`). In several frames, it is so if the robot may not be
            off them, and headings may err by ROUGH.
    """

    def __init__(self, trace: Trace, prior: Prior) -> None:
        self._trace, self._frames, self._prior = trace, frames_of(trace), prior
        odometry = trace.odometry or Odometry()
        self._sigma = odometry.scale, odometry.bend
        steps = [t for t in range(1, len(trace)) if trace.steps[t].displacement is not None]
        self._noise = dict(zip(steps, noises(trace, steps), strict=True))
        self._closures = gathered((closure.last, closure) for closure in trace.closures)
        spreads = spreads_of(trace)
        self._is_off = bool(spreads.any())
        turns = np.array([noise[2, 2] for noise in self._noise.values()])
        self.is_rough = self._is_off
        if self._frames:
            self.is_rough = not self._is_off and math.sqrt(turns.sum()) > ROUGH
        self._spreads = spreads + BLUR

    def moved(self, found: Hypothesis, t: int, believes: bool = True) -> Hypothesis:
        """Move the robot of a hypothesis to step t, and use the closures that end there.

        If `believes` is False, the displacement to the step is not used: the move is unknown. The
        last three entries of the new means are the pose at step t.
        """
        displacement = self._trace.steps[t].displacement if believes else None
        mean, n = found.mean, len(found.mean)
        dx, dy, turn = displacement or (0.0, 0.0, 0.0)
        way = math.hypot(dx, dy)
        scale = 1 + mean[SCALE] * self._sigma[SCALE]
        drift = mean[BEND] * self._sigma[BEND] * way
        facing = mean[-1] - drift / 2
        cos, sin = math.cos(facing), math.sin(facing)
        gone = np.array([cos * dx - sin * dy, sin * dx + cos * dy]) / scale
        aside = np.array([-gone[1], gone[0]])
        by = np.zeros((3, n))
        by[:, -3:] = np.identity(3)
        by[:2, -1] = aside
        by[:2, SCALE] = -gone * self._sigma[SCALE] / scale
        by[:2, BEND] = aside * (-way / 2 * self._sigma[BEND])
        by[2, BEND] = -way * self._sigma[BEND]
        rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, scale]]) / scale
        noise = np.diag(UNKNOWN) ** 2 if displacement is None else self._noise[t]
        covariance, across = found.covariance.copy(), by @ found.covariance
        covariance[-3:], covariance[:, -3:] = across, across.T
        covariance[-3:, -3:] = across @ by.T + rotation @ noise @ rotation.T
        pose = mean[-3:] + np.array([*gone, turn - drift])
        piece = t if t in self._frames else found.pieces.of_heading[found.here]
        moved = replace(
            found,
            mean=np.concatenate([mean[:-3], pose]),
            covariance=covariance,
            pieces=replace(found.pieces, here=piece),
        )
        for closure in self._closures.get(t, ()):
            if closure.first >= len(moved.labels):  # only in `square_ahead`
                continue
            turned = closed(moved, moved.labels[closure.first], closure.displacement[2])
            moved = self._closed(turned, closure)
        return moved

    def _closed(self, moved: Hypothesis, closure: Closure) -> Hypothesis:
        """Update a hypothesis by a closure between an earlier step and the present one.

        The pose of the robot at the earlier step is not kept, so the pose of its dstate stands for
        it. The cost includes the misfit of the closure.
        """
        noise = np.array(closure.covariance) + np.diag(self._spreads[closure.first])
        n, there = len(moved.mean) - 3, moved.labels[closure.first]
        first = moved.position[moved.places[there]], moved.heading[there]
        by, off = closure_equations(moved.mean, first, (n, n + 2), closure.displacement)
        spread = by @ moved.covariance @ by.T + noise
        mean, covariance, square = updated(moved.mean, moved.covariance, by, off, noise)
        gain = self._prior.gain(np.array([noise, spread]))
        return replace(
            moved,
            mean=mean,
            covariance=covariance,
            nats=moved.nats + square / 2 + float(gain[0] - gain[1]),
            square=moved.square + square,
        )

    def settled(self, found: Hypothesis, trace: Trace) -> tuple[float, Hypothesis]:
        """Fit all poses of a hypothesis anew, as the equations are linear only near the means.

        The trace lacks the displacements that the hypothesis treats as wrong. Returns -log of the
        marginal likelihood, too.
        """
        labels = np.array([*found.labels.values()])
        poses = Poses(trace, labels.tolist(), found.places)
        dstates, places, position = len(found.places), len(found.position), np.array(found.position)
        at, facing = found.mean[np.stack([position, position + 1], 1)], found.mean[found.heading]
        place_at, dstate_at = np.array(found.places)[labels], labels
        if self._is_off:  # each step has a pose of its own, after those of places and dstates
            at = np.concatenate([at, at[place_at]])
            facing = np.concatenate([facing, facing[labels]])
            place_at, dstate_at = places + np.arange(len(labels)), dstates + np.arange(len(labels))
        start = np.concatenate([at.ravel(), facing, found.mean[[SCALE, BEND]]])
        pose_at = np.stack([2 * place_at, 2 * place_at + 1, 2 * len(at) + dstate_at], 1)
        order = np.empty(len(found.mean), dtype=int)
        order[[SCALE, BEND]] = len(start) - 2, len(start) - 1
        order[position], order[position + 1] = 2 * np.arange(places), 2 * np.arange(places) + 1
        order[found.heading] = 2 * len(at) + np.arange(dstates)
        order[-3:] = pose_at[-1]
        # Without poses of their own, the last step and its dstate share entries.
        wanted, entry = np.unique(order, return_inverse=True)
        nats, unknown, covariance = poses.settled(
            start, pose_at[0].tolist(), wanted.tolist(), self._prior.wide
        )
        return nats, replace(
            found, mean=unknown[order], covariance=covariance[np.ix_(entry, entry)]
        )

    def squares(
        self, moved: Hypothesis, t: int, places: Sequence[int], dstate: int | None = None
    ) -> tuple[Array, Array]:
        """Compute the chi-square and the cost of the robot being at each of some places at step t.

        `moved` is a hypothesis after the move to step t. If a dstate at these places is given, the
        heading of the robot has to fit, too. The costs are in nats.
        """
        at = np.array([moved.position[p] for p in places])
        rows, last = np.stack([at, at + 1], 1), np.arange(-3, -1)
        if dstate is not None:
            rows, last = np.concatenate([rows, [[moved.heading[dstate]]]], 1), np.arange(-3, 0)
        off = moved.mean[last] - moved.mean[rows]
        off[:, 2:] -= math.tau * np.round(off[:, 2:] / math.tau)
        c = moved.covariance
        crossed = c[rows[:, :, None], last[None, None, :]]
        spread = (
            c[np.ix_(last, last)][None]
            + c[rows[:, :, None], rows[:, None, :]]
            - crossed
            - crossed.transpose(0, 2, 1)
            + np.diag(self._spreads[t, : len(last)])
        )
        squares: Array = np.einsum("ni,ni->n", off, np.linalg.solve(spread, off[..., None])[..., 0])
        most = self._prior.predicted(t, len(last))
        return squares, squares / 2 + most - self._prior.gain(spread)

    def square_ahead(self, moved: Hypothesis, t: int, dstate: int, actions: Sequence[int]) -> float:
        """Compute the largest chi-square of the next steps if step t is at a known dstate.

        An action at a dstate always leads to the same dstate. So links say where the next steps
        are, until a link is not known. `moved` is a hypothesis after the move to step t.
        `actions` has a number for each action of the trace.
        """
        largest = 0.0
        for k in range(t + 1, min(t + 1 + AHEAD, len(self._trace))):
            there = moved.links.get((dstate, actions[k - 1]))
            if there is None or self._trace.steps[k].displacement is None:
                break
            moved, dstate = self.moved(moved, k), there
            squares, _ = self.squares(moved, k, [moved.places[dstate]])
            largest = max(largest, float(squares[0]))
        return largest

    def met(
        self, moved: Hypothesis, t: int, position: int | None, heading: int | None
    ) -> tuple[Array, Array]:
        """Condition the poses on the robot being at a place, and perhaps a dstate, at step t.

        A new place or dstate gets the position or heading of the robot. `position` is the index in
        the means of the x of a known place, and `heading` that of a known dstate; None for new
        ones. New entries, x and y before the heading, come just before the pose of the robot.
        """
        n = len(moved.mean) - 3
        old = [] if position is None else [position, position + 1]
        old += [] if position is None or heading is None else [heading]
        mean, covariance = moved.mean, moved.covariance
        if old:
            mean, covariance, *_ = conditioned(
                mean, covariance, [*range(n, n + len(old))], old, self._spreads[t]
            )
        new = [*range(n + len(old), n + 3)]  # entries of the robot that become known
        order = [*range(n), *new, *range(n, n + 3)]
        covariance = covariance[np.ix_(order, order)]
        added = range(n, n + len(new))
        covariance[added, added] += self._spreads[t, len(old) :]
        return mean[order], covariance


def fitted(found: Hypothesis, place: int, dstate: int | None = None) -> Hypothesis:
    """Turn the piece of the robot, so that its last pose fits a place or dstate of another piece.

    The last three entries of the means are the pose. Nothing changes if the place is in the piece
    of the robot already. Without a dstate, only the position is fitted: the first place becomes the
    hinge, and the second one decides by how much to turn. Once the piece is turned, it becomes a
    part of the other one.
    """
    pieces = found.pieces
    other = pieces.of_place[place] if dstate is None else pieces.of_heading[dstate]
    if other == pieces.here:
        return found
    joined = replace(pieces, joins=(*pieces.joins, (pieces.here, place, dstate)))
    mean, n = found.mean, len(found.mean) - 3
    hinge = pieces.hinges.get(pieces.here)
    if dstate is not None:
        angle = mean[found.heading[dstate]] - mean[n + 2]
    elif hinge is None:
        return replace(found, pieces=replace(joined, hinges={**pieces.hinges, pieces.here: place}))
    else:
        at = found.position[hinge]
        ways = [mean[[x, x + 1]] - mean[[at, at + 1]] for x in (n, found.position[place])]
        if min(math.hypot(*way) for way in ways) < NEAR:
            return found
        angle = math.atan2(*ways[1][::-1]) - math.atan2(*ways[0][::-1])
    return replace(_turned(found, float(angle)), pieces=joined.merged(other))


def closed(found: Hypothesis, dstate: int, turn: float) -> Hypothesis:
    """Turn the piece of the robot, and join it to the piece of the earlier dstate of a closure.

    This comes before the update by the closure, which is linear in the heading of the piece and so
    needs a heading that is nearly right. If the dstate is in the piece of the robot, nothing
    changes. `turn` is by how many radians the robot is turned to the left of this dstate.
    """
    pieces, n = found.pieces, len(found.mean) - 3
    other = pieces.of_heading[dstate]
    if other == pieces.here:
        return found
    angle = found.mean[found.heading[dstate]] + turn - found.mean[n + 2]
    joins = (*pieces.joins, (pieces.here, found.places[dstate], dstate))
    return replace(_turned(found, float(angle)), pieces=replace(pieces, joins=joins).merged(other))


def headings_by_turn(found: Hypothesis) -> Iterator[list[float]]:
    """Yield the headings of the dstates in radians, for each way to turn the pieces with hinges.

    At a place with four slots, frames differ by quarter turns. Where only a place joins a piece to
    others, the piece is first turned by up to an eighth, so that its headings there fit the slots.
    Then each quarter turn is possible.
    """
    pieces, facing = found.pieces, found.mean[found.heading]
    for piece, hinge in pieces.hinges.items():
        there = [s for s, place in enumerate(found.places) if place == hinge]
        own = next(s for s in there if pieces.of_heading[s] == piece)
        other = next(s for s in there if pieces.of_heading[s] != piece)
        facing[np.equal(pieces.of_heading, piece)] += math.remainder(
            facing[other] - facing[own], math.pi / 2
        )
    for quarters in islice(product(range(4), repeat=len(pieces.hinges)), TURNS):
        turn = dict(zip(pieces.hinges, quarters, strict=True))
        turns = [turn.get(piece, 0) * math.pi / 2 for piece in pieces.of_heading]
        yield (facing + turns).tolist()


def _turned(found: Hypothesis, angle: float) -> Hypothesis:
    """Turn all poses of the robot's piece by radians, about its hinge or else about the robot."""
    n, pieces = len(found.mean) - 3, found.pieces
    hinge = pieces.hinges.get(pieces.here)
    centre = n if hinge is None else found.position[hinge]
    places = zip(found.position, pieces.of_place, strict=True)
    headings = zip(found.heading, pieces.of_heading, strict=True)
    x = np.array([n, *(at for at, piece in places if piece == pieces.here)])
    facing = np.array([n + 2, *(at for at, piece in headings if piece == pieces.here)])
    mean, covariance = rotated(found.mean, found.covariance, x, facing, centre, angle)
    return replace(found, mean=mean, covariance=covariance)


def rotated(
    mean: Array,
    covariance: Array,
    x: NDArray[np.int_],
    headings: NDArray[np.int_],
    centre: int,
    angle: float,
) -> tuple[Array, Array]:
    """Turn some poses of a Gaussian distribution about one position.

    Args:
        mean: The means.
        covariance: Their covariance.
        x: The indices of the x of the positions to turn. That of y comes next.
        headings: The indices of the headings to turn.
        centre: The index of the x of the position to turn about.
        angle: The angle in radians, counterclockwise.
    """
    cos, sin = math.cos(angle), math.sin(angle)
    mean, covariance = mean.copy(), covariance.copy()
    dx, dy = mean[x] - mean[centre], mean[x + 1] - mean[centre + 1]
    mean[x] += cos * dx - sin * dy - dx
    mean[x + 1] += sin * dx + cos * dy - dy
    mean[headings] += angle
    for half in (covariance, covariance.T):  # the rows, and then the columns
        half[x], half[x + 1] = (
            cos * half[x] - sin * half[x + 1],
            sin * half[x] + cos * half[x + 1],
        )
    return mean, covariance


def closure_equations(
    mean: Array, first: tuple[int, int], last: tuple[int, int], displacement: Displacement
) -> tuple[Array, Array]:
    """Find how the last pose of a closure, relative to the first one, depends on the means.

    A pose is given by the index of x, before that of y, and the index of the heading.

    Returns:
        The derivatives of the relative pose, (3, n), and by how much it is off the displacement.
    """
    (at, heading), (to, after) = first, last
    cos, sin = math.cos(mean[heading]), math.sin(mean[heading])
    back = np.array([[cos, sin], [-sin, cos]])
    gone = back @ (mean[to : to + 2] - mean[at : at + 2])
    by = np.zeros((3, len(mean)))
    by[:2, to : to + 2], by[:2, at : at + 2] = back, -back
    by[:2, heading] = gone[1], -gone[0]
    by[2, after], by[2, heading] = 1.0, -1.0
    off = np.array([*gone, mean[after] - mean[heading]]) - displacement
    off[2] = math.remainder(off[2], math.tau)
    return by, off


def updated(
    mean: Array, covariance: Array, by: Array, off: Array, noise: Array
) -> tuple[Array, Array, float]:
    """Update a Gaussian by k measurements (a Kalman filter).

    `by` has their derivatives, (k, n), `off` how much too large they are by the means, (k,), and
    `noise` their covariance, (k, k). The chi-square comes last in the result.
    """
    across = covariance @ by.T
    solved = np.linalg.solve(by @ across + noise, np.column_stack([off, across.T]))
    covariance = covariance - across @ solved[:, 1:]
    mean = mean - across @ solved[:, 0]
    return mean, (covariance + covariance.T) / 2, float(off @ solved[:, 0])


def conditioned(
    mean: Array, covariance: Array, first: Sequence[int], second: Sequence[int], spreads: Array
) -> tuple[Array, Array, float, Array]:
    """Condition a Gaussian on the equality of some entries with others, up to some variance.

    `first` and `second` have the indices of entries that should be equal: of x and y, of a heading,
    or of all three. `spreads` has the variance of each difference, in square metres and square
    radians. The chi-square of the differences, and their covariance, come last in the result.
    """
    off = mean[first] - mean[second]
    if len(off) % 2:
        off[-1] = math.remainder(off[-1], math.tau)
    across = covariance[:, first] - covariance[:, second]
    spread = across[first] - across[second] + np.diag(spreads[: len(off)])
    try:
        root = np.linalg.cholesky(spread)
    except np.linalg.LinAlgError:  # large variances were rounded, as after travels of 500 m
        variances, axes = np.linalg.eigh(spread)
        root = axes * np.sqrt(np.maximum(variances, BLUR))
    white = np.linalg.solve(root, across.T)
    misfit = np.linalg.solve(root, off)
    less = white.T @ white  # symmetric
    square, less = float(misfit @ misfit), np.subtract(covariance, less, out=less)
    return mean - misfit @ white, less, square, spread
