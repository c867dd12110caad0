"""Guess the dstates and places of a trace from its displacements, by a beam of hypotheses.

A *hypothesis* says at which dstate and place each step so far is. It has the joint Gaussian
distribution of the positions of its places, the headings of its dstates, and the errors that all
displacements share (`hypothesis.py`). Its cost in nats is nearly that of a map
(`solver/costs/misfit.py`).

Each drive, and each stretch after a lift, begins a *piece* with a frame of its own. At any step,
this piece may be joined to others.

A closure is the pose of a step relative to an earlier step, from a match of local maps. At the
later step, the closure corrects the poses of a hypothesis, and the misfit of the closure adds to
the cost.

Each step extends each hypothesis in all ways that cost little: the robot is at a known dstate, at a
new dstate of a known place, or at a new place. If faults are allowed, the action may have slipped,
the displacement may be wrong, and the view may be misread, each at its price. The *beam* is the
hypotheses of least cost, and some with other places. The checker checks them every few steps. So a
hypothesis that breaks an axiom does not crowd out others for long.

Reference:
    Reid 1979, "An algorithm for tracking multiple targets" (hypotheses in a beam).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from ssh_abduction.checker.checker import violations
from ssh_abduction.data.drives import frames_of
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.step import Action
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.solver.sources.metric.completing import valid_map
from ssh_abduction.solver.sources.metric.hypothesis import (
    Hypothesis,
    HypothesisPoses,
    fitted,
    headings_by_turn,
)
from ssh_abduction.solver.sources.metric.sights import DEAREST, Sights
from ssh_abduction.solver.steps.faults import with_faults
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.fields import FAULT
from ssh_abduction.theory.prior import UNKNOWN
from ssh_abduction.theory.settle import Problem

# The checker checks the beam after each CHECKED_EVERY steps.
CHECKED_EVERY = 8
# If no hypothesis is left, search again with a beam that is this many times as wide.
WIDER = 2
# Most hypotheses of a beam differ only in dstates at the same places. So a beam wider than NARROW
# also keeps the cheapest ones with other places, as many as the share OTHERS of its width. These
# may crowd out others later, so each kind of beam finds maps that the other one drops.
OTHERS, NARROW = 0.25, 4
# With several drives or floors, it is open how they are joined. So keep up to LOST * ALIKE
# hypotheses. At most ALIKE of them join the drives or floors in the same way. Check the beam at
# once if it has more than CROWDED times its width, so that false joins do not crowd out true ones.
LOST, ALIKE, CROWDED = 32, 4, 16
# Of each earlier checked beam, keep this many hypotheses.
SPARE = 2
# With several drives or floors, keep hypotheses that cost up to this many nats more than the best.
# A false join to a place that looks alike saves some dstates until the drive leads on.
UNSURE = 30.0
# With several drives or floors, fit the poses anew if a step adds more than this many nats of
# misfit. Then a return clearly turns or moves other poses.
STRAINED = 1.0


@dataclass(frozen=True, slots=True)
class Extension:
    """A way to extend a hypothesis by a step: to a known place and dstate, or to new ones (None).

    In the hypothesis `of`, the robot has moved already: the last three entries of its mean vector
    are the pose at the new step. `square` is the chi-square of the return.
    """

    nats: float
    place: int | None
    dstate: int | None
    of: Hypothesis
    square: float = 0.0


class Extending:
    """Finds the ways to extend hypotheses by a step, and extends them.

    Attributes:
        bare: The theory without faults and displacements.
        fault: For each kind of fault that is allowed, its cost at each step in nats.
        sights: What each step shows.
        reckoning: Updates the poses of hypotheses.
    """

    def __init__(self, problem: Problem, log: Log) -> None:
        trace, theory = problem.trace, problem.theory
        self._trace, self._log, self._problem = trace, log, problem
        self.bare = theory.without_faults().replace(
            displacement="none", weigh="count", changed=theory.changed
        )
        self._has_places = theory.level == "topological"
        self._stays = self._has_places and "turn_stays" in theory.hard
        self._leaves = self._has_places and "travel_leaves" in theory.hard
        self._lands = "one_landing" in theory.hard
        self._place, self._dstate = problem.prior.place.tolist(), problem.prior.dstate.tolist()
        self.reckoning = HypothesisPoses(trace, problem.prior)
        self._frames = frames_of(trace)
        self.sights = Sights(trace, self.bare.replace(misread=theory.misread))
        self.fault = {
            kind: [FAULT * theory.fault_tenths(kind, step) / 10 for step in trace.steps]
            for kind in ("misread", "slipped", "jumped")
            if getattr(theory, kind)
        }
        if "jumped" in self.fault:  # a wrong displacement predicts nothing
            lost = [problem.prior.lost([t]) for t in range(len(trace))]
            self.fault["jumped"] = [*map(sum, zip(self.fault["jumped"], lost, strict=True))]

    def first(self) -> Hypothesis:
        """Make the hypothesis of the first step: one dstate at one place."""
        nats = float(self._problem.prior.seen[0].sum())
        return self.extended(Extension(nats, None, None, Hypothesis.empty(nats)), 0)

    def options_of(self, beam: Sequence[Hypothesis], t: int, joins: bool) -> list[Extension]:
        """List the ways to extend the hypotheses of a beam by step t, sorted by cost."""
        look_at_clock()
        options = [
            option
            for found in beam
            for moved in self._moves(found, t)
            for option in self._options(moved, t, joins)
        ]
        return sorted(options, key=lambda option: option.nats)

    def _moves(self, found: Hypothesis, t: int) -> Iterator[Hypothesis]:
        """Yield a hypothesis after the move to step t, without and with a fault of the move."""
        moved = self.reckoning.moved(found, t)
        yield moved
        if "slipped" in self.fault and t not in self._frames:
            faults, price = (*found.faults, (t - 1, "slipped")), self.fault["slipped"][t - 1]
            yield replace(moved, faults=faults, nats=moved.nats + price)
        if "jumped" in self.fault and self._trace.steps[t].displacement is not None:
            faults, price = (*found.faults, (t, "jumped")), self.fault["jumped"][t]
            moved = self.reckoning.moved(found, t, believes=False)
            yield replace(moved, faults=faults, nats=moved.nats + price)

    def _options(self, moved: Hypothesis, t: int, joins: bool) -> list[Extension]:
        """List the cheap ways to extend a hypothesis whose robot has moved to step t."""
        slips = moved.slips(t)
        known = None if slips else moved.links.get((moved.here, self._log.actions[t - 1]))
        if known is not None:
            return self._along_link(moved, known, t)
        stays = self._stays and self._trace.actions[t - 1].kind == "turn" and not slips
        landing = self._landing(moved, t)
        dstate, new_place = (self._dstate[t], self._place[t]) if joins else (0.0, 0.0)
        options = []
        new, at_place, at_dstate = self._chosen(moved, t)
        if not stays and landing is None:
            options.append(Extension(moved.nats + dstate + new_place + new, None, None, moved))
        possible = [p for p in self._possible(moved, t, stays=stays) if landing in (None, p)]
        for place, square, cost, near in self._near(moved, t, possible):
            if stays or square / 2 <= DEAREST:
                nats = moved.nats + (0.0 if stays else self.sights.changes(moved.sights[place], t))
                if self._has_places:
                    more = dstate + cost + at_place[moved.places.index(place)]
                    options.append(Extension(nats + more, place, None, near, square))
                options += self._at_known_dstates(moved, nats, place, t, at_dstate)
        return self._cheapest(options, t)

    def _chosen(self, moved: Hypothesis, t: int) -> tuple[float, list[float], list[float]]:
        """Return the nats that the choice of where step t is costs, as `Prior.chosen` has them.

        They are those of a new place, of a new dstate at the place of each dstate, and of each
        dstate.
        """
        prior, (poses, piece) = self._problem.prior, moved.laid
        known = piece[None] == moved.pieces.here
        nats, far, turned = np.zeros(1), np.zeros(known.shape), np.zeros(known.shape)
        place, dstate = prior.saved[t]
        if self._trace.steps[t].displacement is not None and (t, "jumped") not in moved.faults:
            places = np.array(moved.places)
            here, laid = places[[moved.here]], (poses, places)
            nats, far, turned, *_ = prior.choices(
                np.array([t]), moved.mean[None, -3:], here, laid, known
            )
            place, dstate = -np.log(UNKNOWN)
        near, turned = np.where(known, [nats[:, None] + far, turned], 0.0)[:, 0]
        return float(nats[0]) + place + dstate, (near + dstate).tolist(), (near + turned).tolist()

    def _along_link(self, moved: Hypothesis, dstate: int, t: int) -> list[Extension]:
        """List the way, if it is allowed, to the dstate to which a known link leads."""
        place = moved.places[dstate]
        moved = fitted(moved, place, dstate)
        nats = (
            moved.nats
            + self._misread(moved, dstate, t)
            + self.sights.changes(moved.sights[place], t)
        )
        (square,), (cost,) = self.reckoning.squares(moved, t, [place], dstate)
        option = Extension(nats + float(cost), place, dstate, moved, float(square))
        return [option] if nats < math.inf and self._is_allowed(option, t) else []

    def _possible(self, moved: Hypothesis, t: int, *, stays: bool) -> list[int]:
        """List the known places at which the robot may be at step t, whatever its pose."""
        there = moved.places[moved.here]
        if stays:
            return [there]
        leaves = self._leaves and not moved.slips(t) and t not in self._frames
        return [
            place
            for place in range(len(moved.sights))
            if (place != there or not leaves)
            and self.sights.changes(moved.sights[place], t) < math.inf
        ]

    def _landing(self, moved: Hypothesis, t: int) -> int | None:
        """Return the place to which the lift to step t led before, from the same place."""
        if not self._lands or not self._trace.actions[t - 1].changes_floor:
            return None
        there, lift = moved.places[moved.here], self._log.actions[t - 1]
        return next(
            (
                moved.places[target]
                for (source, action), target in moved.links.items()
                if action == lift and moved.places[source] == there
            ),
            None,
        )

    def _at_known_dstates(
        self, moved: Hypothesis, nats: float, place: int, t: int, more: Sequence[float]
    ) -> Iterator[Extension]:
        """Yield the ways to the known dstates of a place. `nats` is their cost without misfit.

        Each dstate has `more` nats for being chosen.
        """
        for s, p in enumerate(moved.places):
            if p == place and (misread := self._misread(moved, s, t)) < math.inf:
                facing = fitted(moved, place, s)
                (square,), (cost,) = self.reckoning.squares(facing, t, [place], s)
                yield Extension(
                    nats + misread + float(cost) + more[s], place, s, facing, float(square)
                )

    def _cheapest(self, options: Sequence[Extension], t: int) -> list[Extension]:
        """List the allowed options that cost little more than the cheapest one, by cost."""
        kept: list[Extension] = []
        for option in sorted(options, key=lambda option: option.nats):
            if kept and option.nats > kept[0].nats + self.sights.dearest:
                break
            if self._is_allowed(option, t) and self._may_go_on(option, t):
                kept.append(option)
        return kept

    def _near(
        self, moved: Hypothesis, t: int, places: Sequence[int]
    ) -> Iterator[tuple[int, float, float, Hypothesis]]:
        """Yield the chi-square and the cost of the robot being at each of some places at step t.

        Items are (place, chi-square, nats, hypothesis). If a place is in another piece (in
        another frame), the piece of the robot is turned to fit it.
        """
        own = [place for place in places if moved.pieces.of_place[place] == moved.pieces.here]
        if own:
            costs = (some.tolist() for some in self.reckoning.squares(moved, t, own))
            yield from ((*of, moved) for of in zip(own, *costs, strict=True))
        for place in places:
            if moved.pieces.of_place[place] != moved.pieces.here:
                turned = fitted(moved, place)
                (square,), (cost,) = self.reckoning.squares(turned, t, [place])
                yield place, float(square), float(cost), turned

    def _is_allowed(self, option: Extension, t: int) -> bool:
        """Whether the option agrees with the evidence about pairs of steps."""
        labels, places = [*option.of.labels.values()], option.of.places
        if option.dstate is not None:
            return self._log.pairs.allow(t, [*labels, option.dstate], places)
        place = len(option.of.position) if option.place is None else option.place
        return self._log.pairs.allow(t, [*labels, len(places)], [*places, place])

    def _may_go_on(self, option: Extension, t: int) -> bool:
        """Whether the next displacements agree with the links of the dstate of an option."""
        if option.dstate is None or "slipped" in self.fault or "jumped" in self.fault:
            return True
        actions = self._log.actions
        return self.reckoning.square_ahead(option.of, t, option.dstate, actions) <= 2 * DEAREST

    def _misread(self, found: Hypothesis, dstate: int, t: int) -> float:
        """Return by how many nats the cost of misread views grows if step t is at a dstate."""
        seen, number, doubt = found.seen[dstate], self.sights.seen[t], self.sights.doubts[t]
        if number in seen and math.isinf(doubt):
            return 0.0
        after = {**seen, number: seen.get(number, 0.0) + doubt}
        return self.sights.misread(after) - self.sights.misread(seen)

    def extended(self, option: Extension, t: int) -> Hypothesis:
        """Make the hypothesis that an option leads to, with its pose at step t."""
        moved = option.of
        n = len(moved.mean) - 3
        position, heading, places, seen = moved.position, moved.heading, moved.places, moved.seen
        place, there, sights = option.place, option.dstate, moved.sights
        pose = self.reckoning.met(
            moved,
            t,
            None if place is None else position[place],
            None if there is None else heading[there],
        )
        # Lists are copied, because other hypotheses share those of the old one.
        shown = {self.sights.drive[t]: self.sights.shown[t]}
        if place is None:
            place = len(position)
            position, sights = [*position, n], [*sights, shown]
        elif not shown.keys() <= sights[place].keys():
            sights = [*sights[:place], {**sights[place], **shown}, *sights[place + 1 :]]
        if there is None:
            there = len(places)
            places, seen = [*places, place], [*seen, {}]
            heading = [*heading, len(pose[0]) - 4]
        number, links = self.sights.seen[t], moved.links
        if t and not moved.slips(t):
            links = {**links, (moved.here, self._log.actions[t - 1]): there}
        # If views may be misread, each step adds its doubt. Otherwise, each view counts once.
        if number not in seen[there] or "misread" in self.fault:
            doubt = self.sights.doubts[t] + seen[there].get(number, 0.0)
            seen = [*seen[:there], {**seen[there], number: doubt}, *seen[there + 1 :]]
        return replace(
            moved,
            labels={**moved.labels, t: there},
            places=places,
            seen=seen,
            links=links,
            sights=sights,
            position=position,
            heading=heading,
            mean=pose[0],
            covariance=pose[1],
            nats=option.nats,
            square=moved.square + option.square,
            pieces=moved.pieces.grown(place=option.place is None, dstate=option.dstate is None),
        )


class Beam:
    """The search for hypotheses of little cost.

    Attributes:
        hypotheses: The hypotheses of the whole trace, by cost; none before `maps` has ended.
        refuses: Whether the checker refused a hypothesis.
        drops: Whether a wider beam may keep more hypotheses.
    """

    def __init__(self, problem: Problem, log: Log, width: int) -> None:
        """Prepare the search with this many hypotheses in the beam. `maps` runs it."""
        self._trace, self._width, self._problem = problem.trace, width, problem
        self._extending = ways = Extending(problem, log)
        self._bare, self._fault = ways.bare, ways.fault
        self._sights, self._reckoning = ways.sights, ways.reckoning
        self._has_frames = bool(frames_of(problem.trace))
        self.hypotheses: list[Hypothesis] = []
        self.refuses = self.drops = False
        self._kept: list[list[Hypothesis]] = []  # the beam after each check

    def maps(self) -> Iterator[SSHMap]:
        """Yield the maps of the hypotheses of the whole trace that satisfy the axioms, by cost.

        If a time limit or another exception ended an earlier call, go on from there. If no
        hypothesis is left after some steps, go back to an earlier beam and check each hypothesis at
        each step. If that does not help, extend this beam again with new dstates and places for
        free. Then go back twice as far.
        """
        kept = self._kept = self._kept or [[self._extending.first()]]
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
        self._kept = kept[-1:]
        self.hypotheses = kept[-1]
        self.drops |= len(kept[-1]) > ALIKE * self._width
        for found in kept[-1][: ALIKE * self._width]:
            if (ssh_map := self._map(found, len(self._trace))) is not None:
                yield ssh_map

    def partial(self) -> Iterator[SSHMap]:
        """Yield maps of the first steps that `maps` has reached so far, the longest first."""
        for found in [beam[0] for beam in reversed(self._kept)]:
            if (ssh_map := self._map(found, len(found.labels))) is not None:
                yield ssh_map

    def nats_without_axioms(self) -> float:
        """Return the cost of the best hypothesis without the checker; inf if none is left.

        The search itself still lets each action at a dstate lead to one dstate, and stars at one
        place agree. Only if no hypothesis is left, the checker checks each step.
        """
        beam = [self._extending.first()]
        while beam and (done := len(beam[0].labels)) < len(self._trace):
            end = min(done + CHECKED_EVERY, len(self._trace))
            beam = (
                self._settled(self._onward(beam, end))
                or self._checked(beam, end)
                or self._checked(beam, end, joins=False)
            )
        return float(beam[0].nats) if beam else math.inf

    def _onward(self, beam: list[Hypothesis], end: int) -> list[Hypothesis]:
        """Extend a beam to `end` steps without checks. End early if it has many hypotheses."""
        most = max(CROWDED * self._width, 2 * len(beam))
        for t in range(len(beam[0].labels), end):
            beam = list(self._best(self._extending.options_of(beam, t, joins=True), t, self._width))
            if len(beam) > most:
                break
        return sorted(beam, key=lambda found: found.nats)

    def _best(
        self, options: Sequence[Extension], t: int, width: int, checked: bool = False
    ) -> Iterator[Hypothesis]:
        """Yield the hypotheses to keep: the `width` cheapest, then some with other places.

        With several drives or floors, keep at most ALIKE hypotheses that connect the drives or
        floors in the same way, and at most LOST * ALIKE in all. Drop those that cost at least
        UNSURE more than the best. The last two limits apply separately to hypotheses whose present
        piece is not joined to others yet (`Pieces.is_loose`), as such hypotheses cost more.
        `options` are ways to extend the beam by step t, sorted by cost. If `checked`, drop what the
        checker refuses.
        """
        most, several = width + int(OTHERS * width * (width > NARROW)), self._has_frames
        if several:
            width, most = min(width, ALIKE), LOST * min(width, ALIKE)
        count: Counter[tuple[object, ...]] = Counter()
        known: set[tuple[object, ...]] = set()  # faults, and the place of each step
        kept, dearest = [0, 0], [math.inf, math.inf]  # by whether the present piece is joined
        for option in options:
            found, joined = option.of, not option.of.pieces.is_loose
            if kept[joined] >= most or option.nats > dearest[joined]:
                self.drops = True
                continue
            at = found.faults, option.place, *map(found.places.__getitem__, found.labels.values())
            if count[found.pieces.joins] >= width and (several or at in known):
                self.drops = True
                continue
            child = self._extending.extended(option, t)
            if several and child.square > found.square + 2 * STRAINED:
                child = self._settled([child])[0]
            if checked and self._map(child, t) is None:
                continue
            known.add(at)
            count[found.pieces.joins] += 1
            kept[joined] += 1
            if several and kept[joined] == 1:
                dearest[joined] = option.nats + max(UNSURE, self._sights.dearest)
            yield child

    def _extended(self, beam: list[Hypothesis], end: int) -> list[Hypothesis]:
        """Extend a beam as `_onward` does. Keep the hypotheses that the checker accepts.

        If all accepted ones cost much more than a refused one, the refused one may have crowded out
        others. Then check each step.
        """
        begun = len(beam[0].labels)
        longer = self._onward(beam, end)
        valid = [found for found in longer if self._map(found, begun) is not None]
        self.refuses |= len(valid) < len(longer)
        if valid and valid[0].nats > longer[0].nats + self._sights.dearest:
            return self._checked(beam, end) or self._settled(valid)
        return self._settled(valid)

    def _settled(self, beam: list[Hypothesis]) -> list[Hypothesis]:
        """Fit the poses of hypotheses anew, if they are rough, and sort the hypotheses by cost."""
        if not self._reckoning.is_rough:
            return beam
        settled = []
        for found in beam:
            look_at_clock()
            nats, better = self._reckoning.settled(found, self._believed(found))
            settled.append(replace(better, nats=self._base_of(found) + nats))
        return sorted(settled, key=lambda found: found.nats)

    def _base_of(self, found: Hypothesis) -> float:
        """Return the cost of a hypothesis besides its displacements, in nats."""
        labels = [*found.labels.values()]
        places = [found.places[s] for s in labels]
        prior, wrong = self._problem.prior, [t for t, kind in found.faults if kind == "jumped"]
        price = prior.shown(labels, places) + float(prior.base[len(labels) - 1])
        price += prior.chosen(labels, places, found.laid, wrong)
        price += sum(map(self._sights.along, found.sights))
        price += sum(self._fault[kind][t] for t, kind in found.faults)
        if "misread" in self._fault:
            price += sum(map(self._sights.misread, found.seen))
        return price

    def _checked(self, beam: list[Hypothesis], end: int, joins: bool = True) -> list[Hypothesis]:
        """Extend a beam to `end` steps, and check each hypothesis at each step.

        If `joins`, new dstates and places have their costs, so that returns are cheaper. If not,
        they are free, and the robot returns to a place only if it has to.
        """
        for t in range(len(beam[0].labels) if beam else end, end):
            options = self._extending.options_of(beam, t, joins)
            beam = list(self._best(options, t, WIDER * self._width, checked=True))
        return self._settled(beam)

    def _map(self, found: Hypothesis, since: int) -> SSHMap | None:
        """Make the map of a hypothesis; None if it contradicts the axioms or the evidence."""
        look_at_clock()
        steps = len(found.labels)
        trace, theory = self._mended(found), self._bare.of_steps(0, steps)
        # Unrelated frames can be rotated against each other.
        ways = headings_by_turn(found)
        turned = ways if theory.star == "frame" else islice(ways, 1)
        labels = [*found.labels.values()]
        maps = (valid_map(trace, theory, labels, found.places, way) for way in turned)
        ssh_map = next(filter(None, maps), None)
        if ssh_map is None or any(e.refuse(trace, ssh_map, since) for e in self._problem.evidence):
            return None
        if not self._fault:
            return ssh_map
        whole, theory = self._trace.prefix(steps), self._problem.theory.of_steps(0, steps)
        ssh_map = with_faults(ssh_map, whole, trace, theory)
        return None if next(violations(whole, ssh_map, theory), None) else ssh_map

    def _believed(self, found: Hypothesis) -> Trace:
        """Return the trace of a hypothesis, without the displacements that it treats as wrong."""
        wrong = [t for t, kind in found.faults if kind == "jumped"]
        return self._trace.prefix(len(found.labels)).without_displacements_at(wrong)

    def _mended(self, found: Hypothesis) -> Trace:
        """Return the trace of a hypothesis, with the faults of the hypothesis corrected."""
        trace = self._believed(found)
        if not self._fault:
            return trace
        steps = list(found.mended(trace, self._sights, self._bare).steps)
        for t, kind in found.faults:
            if kind == "slipped":
                steps[t] = replace(steps[t], action=Action.that_slipped(t))
        return replace(trace, steps=tuple(steps))
