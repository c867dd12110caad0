"""Compute the cost of maps in nats anew, and compare it with what an answer claims.

The solver looks for poses of dstates. This module looks for errors of the displacements instead, so
the two share no method. The unknowns z are the errors of all displacements and closures, the scale
and the drift, each in standard deviations. A map demands that its loops close, and that the two
steps of each closure lie as the closure says: c(z) = 0. The misfit is the least sum of z² with c(z)
= 0. It is found by Gauss-Newton: the next z is the smallest solution w of J w = J z - c(z), where J
holds the derivatives of c. This is the update of an iterated Kalman filter for all loops at once.

A displacement is missing where a drive starts, or where it was not logged. Between two gaps lies a
*stretch* of steps, whose poses by dead reckoning have a frame of their own. If two stretches have a
dstate or two places in common, or if a closure connects them, this determines how their frames lie
relative to each other. Such guesses of missing displacements are only a starting point: the misfit
does not depend on them.

An answer may say that closures are false. All false closures of one *alias* lay one part of the
building on another, by one unknown motion. So a motion for each alias is an unknown, too, which no
displacement restricts.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Collection, Hashable, Iterator, Mapping, Sequence
from itertools import pairwise, product
from statistics import median
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ssh_abduction.data.errors import brief
from ssh_abduction.data.groups import NodeClasses, firsts, gathered
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.odometry import Closure, Covariance, Displacement, Odometry
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.runtime.threads import one_thread
from ssh_abduction.theory.theory import Theory

Array: TypeAlias = NDArray[np.float64]
Faults: TypeAlias = Sequence[tuple[str, int]]

ROUNDS = 50
# Stop when no unknown moves by more than this many standard deviations. Near its least value, the
# sum of squares then changes by less than rounding to the digits of an answer does.
STILL = 1e-4
# The standard deviation of a missing displacement, in metres and radians. It is so large that any
# displacement is possible.
MISSING = 1e4
# Claimed costs may be wrong by this many nats, plus this share of the misfit.
EXACT, SHARE = 1e-3, 1e-3
# If the robot may be off its dstates, equations that are linear in other unknowns differ by this.
LINEAR = 0.05
# If the robot may be off its dstates, the standard deviation is at least this, in metres and
# radians.
SMALLEST = 1e-3
# The costs of traces with more steps are not checked, as the derivatives are a dense matrix.
LONGEST = 400
# The time for the cost of a map grows with the third power of the steps. Costs of rivals are
# checked for at most the time of five in the longest trace.
WORK = 5 * LONGEST**3
# The building reaches this many metres beyond the poses of dead reckoning, on each side.
MARGIN = 3.0
# The nats of a fault that costs as much as a dstate, and of an alias of false closures.
FAULT = 5.0
# The nats of a misread view that only a rival has, as the theory forbids it, besides those of what
# it shows. Parts of a building that repeat others differ from them as often.
SUSPECTED = 3.5
# Where an alias lays a part on another one, dstates that face one way differ by less radians.
TWIST = 0.4
# A move may lead to headings within about this many radians of the one at its end.
AIM = 0.5
# How many new places, and new headings of a place, are there near known ones.
PLACES, HEADINGS = 2 * math.exp(-2), AIM / math.sqrt(math.tau)
# The direction from one place to another is too uncertain to use if they are closer than this many
# metres.
NEAR = 1.0

# The tiny imaginary part of an unknown, and how many unknowns get one at once.
TINY, AT_ONCE = 1e-30, 200

_Numbers: TypeAlias = NDArray[Any]  # real, or complex while derivatives are computed
_Frame: TypeAlias = tuple[complex, float]  # a position, and a heading in radians


def misfit(trace: Trace, dstates: Sequence[int], places: Sequence[int]) -> float:
    """Compute the misfit (the least chi-square) if each step is at a given dstate and place."""
    with one_thread("blas"):  # more threads only wait for each other
        return _Errors(trace, dstates, places).least()


def count_checked_rivals(steps: int, rivals: int) -> int:
    """Count the rivals whose costs `false_costs` checks: the first ones, as far as time permits."""
    return 0 if steps > LONGEST else min(rivals, WORK // steps**3)


def false_costs(
    trace: Trace, answer: Mapping[str, Any], maps: Sequence[SSHMap], theory: Theory
) -> Iterator[str]:
    """Check the costs in nats that an answer claims for its maps, by a theory without "auto"."""
    weighed = answer.get("weighed")
    if not isinstance(weighed, Mapping) or not maps:
        return
    nats, bound, rivals = (weighed.get(name) for name in ("nats", "bound", "rivals"))
    is_optimal = answer.get("status") == "optimal"
    if is_optimal and bound != nats:
        yield (
            f"weighed.bound: expected {nats}, the cost of map 1, as the status is optimal, got "
            f"{brief(bound)}"
        )
    if not isinstance(bound, int | float) or not isinstance(nats, int | float) or bound > nats:
        yield f"weighed.bound: expected a number up to {brief(nats)}, got {brief(bound)}"
        return
    if not is_optimal and (within := weighed.get("within")):
        yield (
            f"weighed.within: expected 0, as it is not proven which map is the best, got "
            f"{brief(within)}"
        )
    if len(trace) > LONGEST:
        return
    # The cost of map 1, and of the rivals that can be checked in time. If a map has no places, its
    # dstates stand for them.
    places = [maps[0].dstates[label].place for label in maps[0].dstate_at]
    here = [p if p is not None else s for p, s in zip(places, maps[0].dstate_at, strict=True)]
    of_map: Faults = [(fault.kind, fault.step) for fault in maps[0].faults]
    rivals = rivals if isinstance(rivals, list) else []
    closures = (rivals[0].get("aliases") if rivals else None) or ()
    courses = [("weighed.nats", nats, maps[0].dstate_at, here, of_map, closures)]
    for i in range(count_checked_rivals(len(trace), len(rivals))):
        rival = rivals[i]
        at = rival.get("places") or rival.get("dstates")
        of_rival = rival.get("faults", [])
        name = f"weighed.rivals[{i}]"
        aliases = rival.get("aliases") or ()
        courses.append((name, rival.get("nats"), rival["dstates"], at, of_rival, aliases))
    for name, claimed, dstates, at, faults, aliases in courses:
        if not _are_numbered(aliases, len(trace.closures)):
            yield (
                f"{name}: expected aliases with a number for each of {len(trace.closures)} "
                f"closures, from 1 without gaps, got {brief(aliases)}"
            )
            continue
        true, square = cost_of(trace, theory, dstates, at, faults, aliases)
        linear = LINEAR if len(_off_dstates(trace)) else 0.0
        if abs(true - claimed) > EXACT + SHARE * square + linear:
            yield f"{name}: expected {true:.3f} nats, by the displacements, got {claimed}"


def _are_numbered(aliases: Sequence[int], closures: int) -> bool:
    """Whether aliases are empty, or one for each closure, numbered from 1; 0 for true closures."""
    numbers = {abs(alias) for alias in aliases} - {0}
    return len(aliases) in (0, closures) and numbers == {*range(1, len(numbers) + 1)}


def cost_of(
    trace: Trace,
    theory: Theory,
    dstates: Sequence[int],
    at: Sequence[int],
    faults: Faults,
    aliases: Sequence[int] = (),
) -> tuple[float, float]:
    """Compute the cost of a map in nats, and its misfit, if steps are at these dstates and places.

    The cost is the sum, over the steps, of what a new dstate and place would cost, and for each
    return the logarithm of two densities: that of a new pose, and that of the loop to close as the
    displacements predict it. `aliases` has a number for each closure that is false: it moves the
    last step of the closure, or the first step if the number is negative.
    """
    wrong = [step for kind, step in faults if kind == "jumped"]
    errors = _Errors(trace.without_displacements_at(wrong), dstates, at, aliases)
    with one_thread("blas"):  # more threads only wait for each other
        square = errors.least()
    model = _Occam(trace, theory)
    nats = square / 2 + errors.volume(model.wide) + model.of_steps()
    nats += FAULT * max(map(abs, aliases), default=0)
    nats += model.crowd * (len(at) - len(set(at)))
    nats += model.chosen(dstates, at, errors.laid(dstates), wrong)
    for of, names in enumerate((dstates, at)):
        for name in set(names):
            nats += model.shown(of, [t for t, x in enumerate(names) if x == name])
    pairs = errors.repeats(dstates, at, model.near) if aliases else ({}, {})
    for of, names in enumerate((dstates, at)):
        steps = gathered((name, t) for t, name in enumerate(names))
        nats -= sum(model.repeated(of, steps[a], steps[b]) for a, b in pairs[of].items())
    for kind, step in faults:
        tenths = theory.fault_tenths(kind, trace.steps[step])
        is_suspected = kind == "misread" and not tenths
        nats += SUSPECTED + model.shown(0, [step]) if is_suspected else FAULT * tenths / 10
    return nats, square


class _Occam:
    """The prior probabilities of the poses, views and stars of a trace.

    Attributes:
        wide: The covariance of a Gaussian that is as dense at its mean as the prior, (3, 3).
        crowd: The logarithm of the number of new places: half of those of the building.
        near: Half of the usual length of a travel, in metres.
    """

    def __init__(self, trace: Trace, theory: Theory) -> None:
        self._trace, self._theory = trace, theory
        area, at, usual = 0.0, [0j], []
        heading = 0.0
        for t, step in enumerate([*trace.steps[1:], None], 1):
            if step is None or step.displacement is None:  # a stretch of dead reckoning ends
                x, y = np.array([[z.real, z.imag] for z in at]).T
                area = max(area, float((np.ptp(x) + 2 * MARGIN) * (np.ptp(y) + 2 * MARGIN)))
                at, heading = [0j], 0.0
                continue
            gone = complex(*step.displacement[:2])
            at.append(at[-1] + cmath.rect(1, heading) * gone)
            heading += step.displacement[2]
            if trace.actions[t - 1].kind == "travel" and gone:
                usual.append(abs(gone))
        each = median(usual) ** 2 if usual else area
        self.crowd, self.near = math.log(max(area / each / 2, 2)), math.sqrt(each) / 2
        self.wide: Array = np.diag([area / math.tau, area / math.tau, math.tau])
        self._around = self.crowd - math.log(area / math.tau / self.near**2)
        self._has_places = theory.level == "topological"
        self._stays = self._has_places and "turn_stays" in theory.hard and not theory.jumped
        stars = [self._gateways(t) if theory.star != "none" else None for t in range(len(trace))]
        views = self._rarity(trace.views)
        self._shows: tuple[list[Any], list[Any]] = [*zip(trace.views)], [*zip(stars)]
        if theory.level == "causal":
            if theory.star != "none":
                self._shows = [*zip(trace.views, stars, strict=True)], []
            both = [a + b for a, b in zip(views, self._rarity(stars), strict=True)]
            self._seen = both, [0.0] * len(trace)
        else:
            self._seen = views, self._rarity(stars)

    def of_steps(self) -> float:
        """Compute what all steps cost at new places."""
        off, nats = _off_dstates(self._trace), 0.0
        for t in range(1, len(self._trace)):
            if (given := self._trace.covariance(t)) is None:
                continue
            spread = np.array(given) + (np.diag(off[t] ** 2) if len(off) else 0.0)
            ratio = (np.linalg.solve(spread[:k, :k], self.wide[:k, :k]) for k in (2, 3))
            dets = (np.linalg.slogdet(np.identity(len(some)) + some)[1] for some in ratio)
            position, both = (float(det) / 2 for det in dets)
            place, dstate = self._lucky(t)
            nats += max(position - self.crowd + place, 0.0) - place
            nats += max(both - position + dstate, 0.0) - dstate
        return nats

    def _lucky(self, t: int) -> tuple[float, float]:
        """Return minus the nats that a new place, and heading, save at t, near nothing known."""
        turns = self._stays and self._trace.actions[t - 1].kind == "turn"
        return 0.0 if turns else self._around, math.log(HEADINGS)

    def chosen(
        self,
        dstates: Sequence[int],
        places: Sequence[int],
        laid: Mapping[int, tuple[int, _Frame]],
        wrong: Collection[int],
    ) -> float:
        """Return minus the logarithms of the probabilities of where new moves lead.

        A move leads to something near its end: to a known dstate, to a new dstate of a known place,
        or to a new place. `laid` has the piece of the map and the pose of each dstate.
        """
        first, first_at = ({x: t for t, x in [*enumerate(of)][::-1]} for of in (dstates, places))
        moves = zip(dstates, self._trace.actions, dstates[1:], strict=False)
        new = firsts(((s, a.name, x), (t, a.kind)) for t, (s, a, x) in enumerate(moves, 1))
        nats = 0.0
        for (begin, _, end), (t, kind) in new.items():
            if (told := self._trace.steps[t].displacement) is None or t in wrong:
                continue
            stays = self._stays and kind == "turn"
            goes = {(True, True), (False, False), (False, kind == "turn")}
            there = _beyond(laid[begin][1], (complex(*told[:2]), told[2]))
            near = 0.0 if stays else self.near
            ways = 0.0 if stays else PLACES * HEADINGS
            for s, u in first.items():
                may = (stays, places[u] == places[t - 1]) in goes
                if u < t and laid[s][0] == laid[begin][0] and may:
                    far, turn = _unlikely(laid[s][1], there, near)
                    ways += math.exp(-far - turn)
                    if self._has_places and first_at[places[u]] == u:
                        ways += HEADINGS * math.exp(-far)
            is_new = first_at[places[t]] == t, first[end] == t
            nats += sum(less for less, new in zip(self._lucky(t), is_new, strict=True) if new)
            chosen = (PLACES if is_new[0] else 1.0) * (HEADINGS if is_new[1] else 1.0)
            nats += max(math.log(ways / chosen) + sum(_unlikely(laid[end][1], there, near)), 0.0)
        return nats

    def shown(self, of: int, steps: Sequence[int]) -> float:
        """Return the nats of what steps at one dstate (of=0) or place (of=1) see."""
        return self._seen[of][self._showing(of, steps)]

    def _showing(self, of: int, steps: Sequence[int]) -> int:
        """Return the step of a dstate or place whose view or star counts: the first known one."""
        if self._theory.misread or self._theory.changed:
            return min(steps, key=self._seen[of].__getitem__)
        return next((t for t in steps if self._seen[of][t]), steps[0])

    def repeated(self, of: int, steps: Sequence[int], others: Sequence[int]) -> float:
        """Return the nats saved if steps at one dstate or place see what it repeats of another."""
        if not self._shows[of]:
            return 0.0
        here, there = (self._showing(of, some) for some in (steps, others))
        first, second = self._shows[of][here], self._shows[of][there]
        if None in (*first, *second):
            return 0.0
        share, odd = math.exp(-self._seen[of][here]), math.exp(-SUSPECTED)
        return math.log(((1 - odd) * (first == second) + odd * share) / share)

    def _gateways(self, step: int) -> int | None:
        """Count the gateways that a step sees; None if some are unknown."""
        star = self._trace.steps[step].gateways
        known = star is not None and all(gateway.open for gateway in star.gateways)
        return len(star.gateways) if star is not None and known else None

    def _rarity(self, seen: Sequence[Hashable]) -> list[float]:
        """For each step, -log of the probability of what it sees after the steps before it.

        One more case stands for what was never seen before: after the same action where the same
        was seen, the case is any view so far, and among all views so far, it is any view. What is
        unknown has no cost.
        """
        kinds, nats = len({*seen} - {None}), list[float]()
        before = [None, *zip((action.name for action in self._trace.actions), seen, strict=False)]
        for t, name in enumerate(seen):
            past = [(x, b) for x, b in zip(seen[:t], before, strict=False) if x is not None]
            alike = [x for x, b in past if b == before[t] and t]
            chance = (sum(x == name for x, _ in past) + 1 / max(kinds, 1)) / (len(past) + 1)
            if t:
                chance = (alike.count(name) + chance) / (len(alike) + 1)
            nats.append(0.0 if name is None else -math.log(chance))
        return nats


class _Errors:
    """The errors of the displacements and closures that make the loops of a map close."""

    def __init__(
        self,
        trace: Trace,
        dstates: Sequence[int],
        places: Sequence[int],
        aliases: Sequence[int] = (),
    ) -> None:
        odometry = trace.odometry or Odometry()
        self._moved = np.zeros((len(trace), 3))
        self._root = np.tile(MISSING * np.identity(3), (len(trace), 1, 1))
        self._root[0] = 0.0
        self._missing = missing = list[int]()
        for t, step in enumerate(trace.steps[1:], 1):
            if step.displacement is None:
                missing.append(t)
            else:
                self._moved[t] = step.displacement
                self._root[t] = np.linalg.cholesky(np.array(trace.covariance(t)))
        self._way = np.hypot(self._moved[:, 0], self._moved[:, 1])
        self._scaled = np.array([step.displacement is not None for step in trace.steps])
        given = aliases or [0] * len(trace.closures)
        self._alias = abs(np.array(given, dtype=int))
        self._aliases = int(self._alias.max(initial=0))
        self._sigma = np.array([odometry.scale, odometry.bend])
        self._best: Array = np.zeros(0)
        self._off = _off_dstates(trace)
        closures = [(c.first, c.last, c.displacement, c.covariance) for c in trace.closures]
        told = [
            _backwards(*closure) if alias < 0 else closure
            for closure, alias in zip(closures, given, strict=True)
        ]
        self._closures = np.array([ends for *ends, _, _ in told], dtype=int).reshape(-1, 2).T
        self._told = np.array([moved for *_, moved, _ in told]).reshape(-1, 3)
        self._doubt = np.linalg.cholesky(np.array([c for *_, c in told]).reshape(-1, 3, 3))
        # A loop leads from the last earlier step at the dstate or place of a step to this step.
        # At one place, only the position has to be the same.
        ends: list[tuple[int, int]] = []
        counts: list[tuple[bool, bool, bool]] = []
        last: dict[tuple[str, int], int] = {}
        for t, (dstate, place) in enumerate(zip(dstates, places, strict=True)):
            here = ("dstate", dstate), ("place", place)
            if key := next((key for key in here if key in last), None):
                ends.append((last[key], t))
                counts.append((True, True, key[0] == "dstate"))
            last |= dict.fromkeys(here, t)
        self._loops = np.array(ends, dtype=int).reshape(-1, 2).T
        self._counts = np.array(counts, dtype=bool).reshape(-1, 3)
        # After a gap, dead reckoning begins at the last earlier step of the same piece of the map;
        # or else of one at a place of this piece; or else at the step before. So the prior of a
        # missing displacement does not depend on where other pieces lie.
        pieces, steps = NodeClasses[int](), range(len(trace))
        for i, j in [*self._connected(), *self._loops.T[self._counts[:, 2]].tolist()]:
            pieces.merge(i, j)
        before = self._before = dict[int, int]()
        for t in missing:
            there = {places[u] for u in steps if pieces.are_one(t, u)}
            near = [u for u in range(t) if places[u] in there] or [t - 1]
            before[t] = ([u for u in range(t) if pieces.are_one(t, u)] or near)[-1]
        # If a heading after a gap is too far off, Gauss-Newton fails. So begin near the solution.
        believed = [c for c, alias in zip(trace.closures, given, strict=True) if not alias]
        for t, likely in _likely_moves(self._moved, missing, before, dstates, places, believed):
            self._moved[t] = likely

    def least(self) -> float:
        """Compute the least sum of squares of the errors, in standard deviations."""
        steps = len(self._moved) + len(self._doubt) + len(self._off)
        z: Array = np.zeros(3 * (steps + self._aliases) + 2)
        self._begin(z)
        for _ in range(ROUNDS if self._loops.size + self._closures.size else 0):
            look_at_clock()
            jacobian = self._derivatives(z)
            wanted = jacobian @ z - self._closing(z)
            new = np.asarray(np.linalg.lstsq(jacobian, wanted, rcond=1e-14)[0], dtype=float)
            moved, z = float(abs(new - z).max()), new
            if moved < STILL:
                break
        self._best = z
        return float(z @ z)

    def _begin(self, z: Array) -> None:
        """Begin the motion of each alias with one of its closures."""
        pose = self._poses(z)[0]
        motions = z[len(z) - 2 - 3 * self._aliases : len(z) - 2].reshape(-1, 3)
        for alias, (i, j), told in zip(self._alias, self._closures.T, self._told, strict=True):
            angle = pose[i, 2] + told[2] - pose[j, 2]
            gone = pose[i, :2] + _turned(told, pose[i, 2]) - _turned(pose[j], angle)
            if alias:
                motions[alias - 1] = np.append(gone, angle) / MISSING

    def laid(self, dstates: Sequence[int]) -> dict[int, tuple[int, _Frame]]:
        """Return the piece of the map, which displacements connect, and the pose of each dstate."""
        pose, pieces = self._poses(self._best)[1], NodeClasses[int]()
        for i, j in self._connected():
            pieces.merge(dstates[i], dstates[j])
        first = firsts((s, pose[t]) for t, s in enumerate(dstates)).items()
        return {s: (pieces.of(s), (complex(x, y), float(turn))) for s, (x, y, turn) in first}

    def _connected(self) -> list[list[int]]:
        """List the pairs of steps that a displacement or a believed closure connects."""
        moves = [[t - 1, t] for t in range(1, len(self._moved)) if t not in self._missing]
        return [*moves, *self._closures.T[self._alias == 0].tolist()]

    def repeats(
        self, dstates: Sequence[int], places: Sequence[int], near: float
    ) -> tuple[dict[int, int], dict[int, int]]:
        """Find the dstates and the places that repeat earlier ones, by the motions of aliases.

        A place repeats the nearest other place to where an alias lays it, within `near` metres.
        """
        pose, (_, _, _, motions) = self._poses(self._best)[1], self._parts(self._best)
        order = {name: i for i, name in enumerate(dict.fromkeys(dstates))}
        rank = {name: i for i, name in enumerate(dict.fromkeys(places))}
        first = firsts((s, (t, places[t])) for t, s in enumerate(dstates))
        at = firsts((p, pose[t, :2]) for t, p in enumerate(places))
        pairs: tuple[dict[int, int], dict[int, int]] = {}, {}
        for *gone, turn in MISSING * motions:
            for p, here in at.items():
                image = _turned(here, turn) + gone
                off = {q: math.dist(image, there) for q, there in at.items() if q != p}
                if not off or off[q := min(off, key=off.__getitem__)] >= near:
                    continue
                late, early = sorted((p, q), key=rank.__getitem__, reverse=True)
                pairs[1].setdefault(late, early)
                for (s, (t, sp)), (x, (u, xp)) in product(first.items(), first.items()):
                    twist = _remainder(pose[t, 2] + turn - pose[u, 2])
                    if (sp, xp) == (p, q) and abs(twist) < TWIST:
                        late, early = sorted((s, x), key=order.__getitem__, reverse=True)
                        pairs[0].setdefault(late, early)
        return pairs

    def volume(self, wide: Array) -> float:
        """Compute by how much the loops are less surely predicted than by the prior, in nats.

        `wide` is the covariance of the prior, (3, 3). It is that of a missing displacement, too.
        """
        if not self._loops.size + self._closures.size:
            return 0.0
        steps, z = len(self._moved), self._best
        jacobian = self._derivatives(z)
        # The errors of displacements are in metres of the world, so they do not have its scale.
        stretch = np.diag([1 + self._sigma[0] * z[-2]] * 2 + [1.0])
        for t in range(1, steps):
            of = slice(3 * t, 3 * t + 3)
            root = np.sqrt(wide) if t in self._missing else stretch @ self._root[t]
            jacobian[:, of] = jacobian[:, of] @ np.linalg.solve(self._root[t], root)
        # The motion of an alias has the density of the prior, wherever it is.
        motion = float(np.linalg.slogdet(wide)[1]) / 2 - 3 * math.log(MISSING)
        counts = np.concatenate([self._counts, np.ones((len(self._doubt), 3), bool)])
        free = [np.linalg.cholesky(wide)] * len(self._counts) + [*self._doubt]
        expected = sum(
            float(np.log(np.diag(root)[count]).sum())
            for root, count in zip(free, counts, strict=True)
        )
        nats = float(np.linalg.slogdet(jacobian @ jacobian.T)[1]) / 2 - expected
        return nats + self._aliases * motion

    def _derivatives(self, z: Array) -> Array:
        """Compute the derivatives J of c(z), of shape (numbers in c, unknowns).

        If an unknown has a tiny imaginary part, the imaginary part of c is the derivative (Squire &
        Trapp 1998, "Using complex variables to estimate derivatives of real functions").
        """
        changes = np.array_split(TINY * 1j * np.identity(len(z)), 1 + len(z) // AT_ONCE)
        return np.concatenate([self._closing(z + some).imag / TINY for some in changes]).T

    def _closing(self, z: _Numbers) -> _Numbers:
        """Compute c(z), by how much loops and closures are off, for each row of unknowns."""
        pose, at = self._poses(z)
        doubt, motion = self._parts(z)[1], MISSING * self._parts(z)[3]
        begin, end = (at[..., steps, :] for steps in self._loops)
        off = _from_to(begin, end)[..., self._counts]
        first, last = (pose[..., steps, :] for steps in self._closures)
        # Motion 0 is none.
        motion = np.concatenate([np.zeros_like(pose[..., :1, :]), motion], axis=-2)
        motion = motion[..., self._alias, :]
        at = _turned(last, motion[..., 2]) + motion[..., :2]
        last = np.concatenate([at, last[..., 2:] + motion[..., 2:]], axis=-1)
        closed = _from_to(first, last) - self._told
        closed = closed - np.einsum("cij,...cj->...ci", self._doubt, doubt)
        closed[..., 2] = _remainder(closed[..., 2])
        return np.concatenate([off, closed.reshape(*z.shape[:-1], -1)], axis=-1)

    def _poses(self, z: _Numbers) -> tuple[_Numbers, _Numbers]:
        """Compute the poses of the robot, by dead reckoning, and of the dstates: (…, steps, 3)."""
        noise, _, off, _ = self._parts(z)
        scale, bend = (self._sigma[k] * z[..., k - 2, None] for k in (0, 1))
        moved = self._moved + np.einsum("tij,...tj->...ti", self._root, noise)
        turned = moved[..., 2] - bend * self._way
        heading = self._summed(turned[..., None])[..., 0]
        middle = heading - turned - bend * self._way / 2
        scale = scale * self._scaled  # a missing displacement is in metres of the world
        way = self._summed(_turned(moved, middle) / (1 + scale[..., None]))
        pose = np.concatenate([way, heading[..., None]], axis=-1)
        if not len(self._off):
            return pose, pose
        off = off * self._off
        aside = np.concatenate([_turned(off, heading - off[..., 2]), off[..., 2:]], axis=-1)
        return pose, pose - aside

    def _summed(self, moved: _Numbers) -> _Numbers:
        """Add up what steps add, (…, steps, n). After a gap, begin at the step `before` it."""
        found = np.zeros_like(moved)
        for a, b in pairwise([0, *self._missing, len(self._moved)]):
            begin = found[..., [self._before[a]], :] if a else 0.0
            found[..., a:b, :] = begin + np.cumsum(moved[..., a:b, :], axis=-2)
        return found

    def _parts(self, z: _Numbers) -> list[_Numbers]:
        """Split unknowns, (…, unknowns), into errors, (…, n, 3).

        They are those of the displacements, and of the closures, and how far the robot is off its
        dstate at each step: metres ahead and left of the dstate, and radians. The motions of
        aliases come last.
        """
        sizes = len(self._moved), len(self._doubt), len(self._off), self._aliases
        parts = np.split(z, 3 * np.cumsum(sizes), axis=-1)[:4]
        return [part.reshape(*z.shape[:-1], -1, 3) for part in parts]


def _turned(vectors: _Numbers, angle: _Numbers) -> _Numbers:
    """Turn vectors, whose last axis begins with x and y, counterclockwise by angles in radians."""
    x, y, cos, sin = vectors[..., 0], vectors[..., 1], np.cos(angle), np.sin(angle)
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def _from_to(first: _Numbers, last: _Numbers) -> _Numbers:
    """Compute poses in the frames of other poses, all (…, 3)."""
    gap = last - first
    there = _turned(gap, -first[..., 2])
    return np.concatenate([there, _remainder(gap[..., 2:])], axis=-1)


def _remainder(angle: _Numbers) -> _Numbers:
    """Return angles in radians between -pi and pi."""
    return angle - math.tau * np.round(angle.real / math.tau)


def _backwards(
    first: int, last: int, moved: Displacement, covariance: Covariance
) -> tuple[int, int, Displacement, Array]:
    """Return the displacement from the last step to the first one, and its covariance."""
    x, y, angle = moved
    back = -cmath.rect(1, -angle) * complex(x, y)
    cos, sin = math.cos(angle), math.sin(angle)
    by = np.array([[-cos, -sin, back.imag], [sin, -cos, -back.real], [0, 0, -1]])
    return last, first, (back.real, back.imag, -angle), by @ np.array(covariance) @ by.T


def _off_dstates(trace: Trace) -> Array:
    """The standard deviations of the robot's pose relative to its dstate, of shape (steps, 3).

    They are in metres and radians. Turns do not move the robot, so the k steps of a visit share one
    error of position. To count this error once, each of the steps gets k times its variance. Empty
    if the odometry declares no such errors.
    """
    odometry = trace.odometry or Odometry()
    if not odometry.offset and not odometry.facing:
        return np.zeros((0, 3))
    found: list[list[float]] = []
    steps = 0
    for t in range(len(trace)):
        steps += 1
        if t + 1 == len(trace) or trace.actions[t].kind != "turn":
            far = max(odometry.offset, SMALLEST) * math.sqrt(steps)
            found += [[far, far, max(odometry.facing, SMALLEST)]] * steps
            steps = 0
    return np.array(found)


def _likely_moves(
    moved: Array,
    missing: Sequence[int],
    before: Mapping[int, int],
    dstates: Sequence[int],
    places: Sequence[int],
    closures: Sequence[Closure],
) -> Iterator[tuple[int, tuple[float, float, float]]]:
    """Guess the displacements that lead to the `missing` steps from those that come `before`.

    `moved`, of shape (n, 3), has the displacement that leads to each step, in metres and radians.
    `dstates` and `places` have the dstate and the place of each step.
    """
    begins = [0, *missing]
    stretches = [range(a, b) for a, b in pairwise([*begins, len(moved)])]
    pose: list[_Frame] = []
    for t, (dx, dy, turned) in enumerate(moved.tolist()):
        pose.append((0j, 0.0) if t in begins else _beyond(pose[-1], (complex(dx, dy), turned)))
    framed: dict[int, None] = {}  # the steps of stretches that have a frame
    while stretches:
        found = (
            (stretch, frame)
            for stretch in stretches
            for frame in _frames(stretch, pose, dstates, places, closures, framed)
        )
        stretch, frame = next(found, (stretches[0], (0j, 0.0)))
        stretches.remove(stretch)
        framed |= dict.fromkeys(stretch)
        for t in stretch:
            pose[t] = _beyond(frame, pose[t])
    for t in missing:
        (at, heading), (after, facing) = pose[before[t]], pose[t]
        gone = (after - at) * cmath.rect(1, -heading)
        yield t, (gone.real, gone.imag, math.remainder(facing - heading, math.tau))


def _frames(
    stretch: range,
    pose: Sequence[_Frame],
    dstates: Sequence[int],
    places: Sequence[int],
    closures: Sequence[Closure],
    framed: Collection[int],
) -> Iterator[_Frame]:
    """Yield likely origins of a stretch, the best first.

    They follow from a dstate, from two places, or from a closure, with a step that has a frame.
    """
    known = firsts((dstates[t], pose[t]) for t in framed)
    position = firsts((places[t], pose[t][0]) for t in framed)
    for t in stretch:
        if dstates[t] in known:
            yield _origin(known[dstates[t]], pose[t])
    there = [t for t in stretch if places[t] in position]
    for t, u in product(there, there):
        way, mine = position[places[u]] - position[places[t]], pose[u][0] - pose[t][0]
        if min(abs(way), abs(mine)) > NEAR:
            here = position[places[t]], cmath.phase(way)
            yield _origin(here, (pose[t][0], cmath.phase(mine)))
    for closure in closures:
        x, y, turned = closure.displacement
        beyond = _beyond(pose[closure.first], (complex(x, y), turned))
        if closure.last in stretch and closure.first in framed:
            yield _origin(beyond, pose[closure.last])
        if closure.first in stretch and closure.last in framed:
            yield _origin(pose[closure.last], beyond)


def _unlikely(one: _Frame, other: _Frame, near: float) -> tuple[float, float]:
    """Return how unlikely it is to come to a pose near another one: its position and heading.

    If `near` is 0, the robot only turns.
    """
    far = abs(one[0] - other[0]) / near if near else 0.0
    turn = math.remainder(one[1] - other[1], math.tau) / AIM
    return far * far / 2, turn * turn / 2


def _beyond(frame: _Frame, pose: _Frame) -> _Frame:
    """Return a pose that is given relative to a frame."""
    return frame[0] + cmath.rect(1, frame[1]) * pose[0], frame[1] + pose[1]


def _origin(known: _Frame, pose: _Frame) -> _Frame:
    """Return the frame in which a known pose is `pose`."""
    turn = known[1] - pose[1]
    return known[0] - cmath.rect(1, turn) * pose[0], turn
