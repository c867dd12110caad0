"""Extend hypotheses about dstates and places by a step, in all ways that cost little (`beam.py`).

The robot is at a known dstate, at a new dstate of a known place, or at a new place. If faults are
allowed, the action may have slipped, the displacement may be wrong, and the view may be misread,
each at its price.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from ssh_abduction.data.drives import frames_of
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.solver.guesses.pieces import Pieces, fitted
from ssh_abduction.solver.guesses.reckoning import Hypothesis, HypothesisPoses, first_pose
from ssh_abduction.solver.guesses.sights import DEAREST, Sights
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.settle import Problem


@dataclass(frozen=True, slots=True)
class Extension:
    """A way to extend a hypothesis by a step: to a known place and dstate, or to new ones (None).

    In the hypothesis `of`, the robot has moved already: the last three entries of its mean vector
    are the pose at the new step.
    """

    nats: float
    place: int | None
    dstate: int | None
    of: Hypothesis


class Extending:
    """Finds the ways to extend hypotheses by a step, and extends them.

    Attributes:
        bare: The theory without faults, displacements and prices.
        prices: The prices of a dstate and of a place, in nats.
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
        self.prices = theory.prices[0], theory.prices[1] if self._has_places else 0.0
        self.reckoning, self._frames = HypothesisPoses(trace), frames_of(trace)
        self.sights = Sights(trace, self.bare, misreads=theory.misread > 0)
        self.fault = {
            kind: [self.prices[0] * theory.fault_tenths(kind, step) / 10 for step in trace.steps]
            for kind in ("misread", "slipped", "jumped")
            if getattr(theory, kind)
        }

    def first(self) -> Hypothesis:
        """Make the hypothesis of the first step: one dstate at one place."""
        price, pieces = self.prices[0], Pieces(0, (), ())
        empty = Hypothesis([], [], [], {}, [], [], [], [], *first_pose(), price, pieces=pieces)
        return self.extended(Extension(price, None, None, empty), 0)

    def options_of(self, beam: Sequence[Hypothesis], t: int, joins: bool) -> list[Extension]:
        """List the ways to extend the hypotheses of a beam by step t, sorted by cost."""
        look_at_clock()
        options = [
            self._laid(option) if option.of.pieces is not moved.pieces else option
            for found in beam
            for moved in self._moves(found, t)
            for option in self._options(moved, t, joins)
        ]
        return sorted(options, key=lambda option: option.nats)

    def _laid(self, option: Extension) -> Extension:
        """Return an option with the price for places that its drive shares with other drives."""
        places = [option.of.places[s] for s in option.of.labels]
        nats = self._problem.overlap.nats
        price = nats([*places, option.place]) - nats(places)
        return replace(option, nats=option.nats + price)

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
        known = None if slips else moved.links.get((moved.labels[-1], self._log.actions[t - 1]))
        if known is not None:
            return self._along_link(moved, known, t)
        stays = self._stays and self._trace.actions[t - 1].kind == "turn" and not slips
        landing = self._landing(moved, t)
        dstate, new_place = self.prices if joins else (0.0, 0.0)
        options = []
        if not stays and landing is None:
            options.append(Extension(moved.nats + dstate + new_place, None, None, moved))
        possible = [p for p in self._possible(moved, t, stays=stays) if landing in (None, p)]
        for place, square, near in self._near(moved, t, possible):
            if stays or square / 2 <= DEAREST:
                nats = moved.nats + (0.0 if stays else self.sights.changes(moved, place, t))
                if self._has_places:
                    options.append(Extension(nats + dstate + square / 2, place, None, near))
                options += self._at_known_dstates(moved, nats, place, t)
        return self._cheapest(options, t)

    def _along_link(self, moved: Hypothesis, dstate: int, t: int) -> list[Extension]:
        """List the way, if it is allowed, to the dstate to which a known link leads."""
        place = moved.places[dstate]
        moved = fitted(moved, place, dstate)
        nats = moved.nats + self._misread(moved, dstate, t) + self.sights.changes(moved, place, t)
        nats += float(self.reckoning.squares(moved, t, [place], dstate)[0]) / 2
        option = Extension(nats, place, dstate, moved)
        return [option] if nats < math.inf and self._is_allowed(option, t) else []

    def _possible(self, moved: Hypothesis, t: int, *, stays: bool) -> list[int]:
        """List the known places at which the robot may be at step t, whatever its pose."""
        there = moved.places[moved.labels[-1]]
        if stays:
            return [there]
        leaves = self._leaves and not moved.slips(t) and t not in self._frames
        return [
            place
            for place in range(len(moved.sights))
            if (place != there or not leaves) and self.sights.changes(moved, place, t) < math.inf
        ]

    def _landing(self, moved: Hypothesis, t: int) -> int | None:
        """Return the place to which the lift to step t led before, from the same place."""
        if not self._lands or not self._trace.actions[t - 1].changes_floor:
            return None
        there, lift = moved.places[moved.labels[-1]], self._log.actions[t - 1]
        return next(
            (
                moved.places[target]
                for (source, action), target in moved.links.items()
                if action == lift and moved.places[source] == there
            ),
            None,
        )

    def _at_known_dstates(
        self, moved: Hypothesis, nats: float, place: int, t: int
    ) -> Iterator[Extension]:
        """Yield the ways to the known dstates of a place. `nats` is their cost without misfit."""
        for s, p in enumerate(moved.places):
            if p == place and (misread := self._misread(moved, s, t)) < math.inf:
                facing = fitted(moved, place, s)
                both = float(self.reckoning.squares(facing, t, [place], s)[0])
                yield Extension(nats + misread + both / 2, place, s, facing)

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
    ) -> Iterator[tuple[int, float, Hypothesis]]:
        """Yield the chi-square of the pose of the robot at each of some places at step t.

        Items are triples (place, chi-square, hypothesis). If a place is in another piece (in
        another frame), the piece of the robot is turned to fit it.
        """
        own = [place for place in places if moved.pieces.of_place[place] == moved.pieces.here]
        squares = self.reckoning.squares(moved, t, own).tolist() if own else []
        yield from ((place, square, moved) for place, square in zip(own, squares, strict=True))
        for place in places:
            if moved.pieces.of_place[place] != moved.pieces.here:
                turned = fitted(moved, place)
                yield place, float(self.reckoning.squares(turned, t, [place])[0]), turned

    def _is_allowed(self, option: Extension, t: int) -> bool:
        """Whether the option agrees with the evidence about pairs of steps."""
        labels, places = option.of.labels, option.of.places
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

    def _doubt(self, t: int) -> float:
        """Return the cost in nats of treating the view of step t as misread; inf if forbidden."""
        return self.fault["misread"][t] if "misread" in self.fault else math.inf

    def _misread(self, found: Hypothesis, dstate: int, t: int) -> float:
        """Return by how many nats the cost of misread views grows if step t is at a dstate."""
        seen, number, doubt = found.seen[dstate], self.sights.seen[t], self._doubt(t)
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
        drives, changes = moved.drives, moved.changes
        pose = self.reckoning.met(
            moved,
            t,
            None if place is None else position[place],
            None if there is None else heading[there],
        )
        # Lists are copied, because other hypotheses share those of the old one.
        if place is None:
            place = len(position)
            position, sights = [*position, n], [*sights, self.sights.shown[t]]
            drives = [*drives, self.sights.drive[t]]
        elif drives[place] != self.sights.drive[t]:
            changes += self.sights.changes(moved, place, t)
            sights = [*sights[:place], self.sights.shown[t], *sights[place + 1 :]]
            drives = [*drives[:place], self.sights.drive[t], *drives[place + 1 :]]
        if there is None:
            there = len(places)
            places, seen = [*places, place], [*seen, {}]
            heading = [*heading, len(pose[0]) - 4]
        number, links = self.sights.seen[t], moved.links
        if t and not moved.slips(t):
            links = {**links, (moved.labels[-1], self._log.actions[t - 1]): there}
        # If views may be misread, each step adds its doubt. Otherwise, each view counts once.
        if number not in seen[there] or "misread" in self.fault:
            doubt = self._doubt(t) + seen[there].get(number, 0.0)
            seen = [*seen[:there], {**seen[there], number: doubt}, *seen[there + 1 :]]
        return Hypothesis(
            [*moved.labels, there],
            places,
            seen,
            links,
            sights,
            drives,
            position,
            heading,
            *pose,
            option.nats,
            changes,
            moved.faults,
            moved.pieces.grown(place=option.place is None, dstate=option.dstate is None),
        )
