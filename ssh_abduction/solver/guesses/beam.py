"""Guess the dstates and places of a trace from its displacements, by a beam of hypotheses.

A *hypothesis* says at which dstate and place each step so far is. It has the joint Gaussian
distribution of the positions of its places, the headings of its dstates, and the errors that all
displacements share. Its cost in nats is the prices of its dstates and places, plus half of the
chi-square of its returns, as for a map (`solver/costs/weighing.py`).

Each drive, and each stretch after a lift, begins a *piece* with a frame of its own (`pieces.py`).
At any step, this piece may be joined to others.

A closure is the pose of a step relative to an earlier step, from a match of local maps. At the
later step, the closure corrects the poses of a hypothesis, and the misfit of the closure adds to
the cost.

Each step extends each hypothesis in all ways that cost little: the robot is at a known dstate, at a
new dstate of a known place, or at a new place. If faults are allowed, the action may have slipped,
the displacement may be wrong, and the view may be misread, each at its price. The *beam* is the
hypotheses of least cost, and some with other places. The checker checks them every few steps. So a
hypothesis that breaks an axiom does not crowd out others for long.

The cost of a hypothesis is close to the cost of its map, and not equal to it (`reckoning.py`).

Reference:
    Reid 1979, "An algorithm for tracking multiple targets" (hypotheses in a beam).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice

from ssh_abduction.checker.checker import violations
from ssh_abduction.data.action import Action
from ssh_abduction.data.drives import frames_of
from ssh_abduction.data.groups import first_index_of
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.solver.guesses.completing import valid_map
from ssh_abduction.solver.guesses.pieces import fitted, headings_by_turn
from ssh_abduction.solver.guesses.reckoning import Hypothesis, HypothesisPoses, first_pose
from ssh_abduction.solver.guesses.sights import DEAREST, Sights, nats_of_misread, right_view
from ssh_abduction.solver.steps.faults import with_faults
from ssh_abduction.solver.steps.log import Log
from ssh_abduction.theory.settle import Problem
from ssh_abduction.theory.theory import Theory

# The checker checks the beam after each CHECKED_EVERY steps.
CHECKED_EVERY = 8
# If no hypothesis is left, search again with a beam that is this many times as wide.
WIDER = 2
# Most hypotheses of a beam differ only in dstates at the same places. So a beam wider than NARROW
# also keeps the cheapest ones with other places, as many as the share OTHERS of its width. These
# may crowd out others later, so each kind of beam finds maps that the other one drops.
OTHERS, NARROW = 0.25, 4
# With several drives or floors, it is open how they are joined. So keep up to LOST * ALIKE
# hypotheses, of which at most ALIKE join them in the same way. Check the beam at once if it has
# more than CROWDED times its width, so that false joins do not crowd out true ones.
LOST, ALIKE, CROWDED = 32, 4, 16
# Of each earlier checked beam, keep this many hypotheses.
SPARE = 2
# With several drives or floors, keep hypotheses that cost up to this many nats more than the best.
# A false join to a place that looks alike saves some dstates until the drive leads on.
UNSURE = 60.0
# With several drives or floors, fit the poses anew if a step adds more than this many nats of
# misfit. Then a return clearly turns or moves other poses.
STRAINED = 1.0


@dataclass(frozen=True, slots=True)
class _Extension:
    """A way to extend a hypothesis by a step: to a known place and dstate, or to new ones (None).

    In the hypothesis `of`, the robot has moved already: the last three entries of its mean vector
    are the pose at the new step.
    """

    nats: float
    place: int | None
    dstate: int | None
    of: Hypothesis


class Beam:
    """The search for hypotheses of little cost.

    Attributes:
        hypotheses: The hypotheses of the whole trace, by cost; none before `maps` has ended.
        refuses: Whether the checker refused a hypothesis.
    """

    def __init__(self, problem: Problem, log: Log, width: int) -> None:
        """Prepare the search with this many hypotheses in the beam. `maps` runs it."""
        trace, theory = problem.trace, problem.theory
        self._trace, self._log, self._width, self._problem = trace, log, width, problem
        self._bare = theory.without_faults().replace(
            displacement="none", weigh="count", changed=theory.changed
        )
        has_places = theory.level == "topological"
        self._stays = has_places and "turn_stays" in theory.hard
        self._leaves = has_places and "travel_leaves" in theory.hard
        # The prices of a dstate and of a place.
        self._prices = theory.prices[0], theory.prices[1] if has_places else 0.0
        self._reckoning, self._frames = HypothesisPoses(trace), frames_of(trace)
        self.hypotheses: list[Hypothesis] = []
        self.refuses = False
        self._kept: list[list[Hypothesis]] = []  # the beam after each check
        self._sights = Sights(trace, self._bare, log, misreads=theory.misread > 0)
        # For each kind of fault, its cost at each step in nats.
        self._fault = {
            kind: [self._prices[0] * theory.fault_tenths(kind, step) / 10 for step in trace.steps]
            for kind in ("misread", "slipped", "jumped")
            if getattr(theory, kind)
        }

    def maps(self, most: float = math.inf) -> Iterator[SSHMap]:
        """Yield the maps of the hypotheses of the whole trace that satisfy the axioms, by cost.

        Give up as soon as all hypotheses cost more than `most` nats.

        If a time limit or another exception ended an earlier call, go on from there. If no
        hypothesis is left after some steps, go back to an earlier beam and check each hypothesis at
        each step. If that does not help, extend this beam again with new dstates and places for
        free. Then go back twice as far.
        """
        kept = self._kept = self._kept or [[self._first()]]
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
            if not beam or beam[0].nats > most:
                return
            kept[-1] = kept[-1][:SPARE]  # saves memory
            kept.append(beam)
        self._kept = kept[-1:]
        self.hypotheses = kept[-1]
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
        beam = [self._first()]
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
            beam = list(self._best(self._options_of(beam, t, joins=True), t, self._width))
            if len(beam) > most:
                break
        return sorted(beam, key=lambda found: found.nats)

    def _best(
        self, options: Sequence[_Extension], t: int, width: int, checked: bool = False
    ) -> Iterator[Hypothesis]:
        """Yield the hypotheses to keep: the `width` cheapest, then some with other places.

        With several drives or floors, keep at most ALIKE hypotheses that connect the drives or
        floors in the same way, and at most LOST * ALIKE in all. Drop those that cost at least
        UNSURE more than the best. The last two limits apply separately to hypotheses whose present
        piece is not joined to others yet (`Pieces.is_loose`), as such hypotheses cost more.
        `options` are ways to extend the beam by step t, sorted by cost. If `checked`, drop what the
        checker refuses.
        """
        most, several = width + int(OTHERS * width * (width > NARROW)), bool(self._frames)
        if several:
            width, most = min(width, ALIKE), LOST * min(width, ALIKE)
        count: Counter[tuple[object, ...]] = Counter()
        known: set[tuple[object, ...]] = set()  # faults, and the place of each step
        kept, dearest = [0, 0], [math.inf, math.inf]  # by whether the present piece is joined
        for option in options:
            found, joined = option.of, not option.of.pieces.is_loose
            if kept[joined] >= most or option.nats > dearest[joined]:
                continue
            at = found.faults, option.place, *map(found.places.__getitem__, found.labels)
            if count[found.pieces.joins] >= width and (several or at in known):
                continue
            child = self._child(option, t)
            price = self._price_of(child) - self._price_of(found)
            if several and child.nats > found.nats + price + STRAINED:
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
            squares, better = self._reckoning.settled(found, self._believed(found))
            settled.append(replace(better, nats=self._price_of(found) + squares / 2))
        return sorted(settled, key=lambda found: found.nats)

    def _price_of(self, found: Hypothesis) -> float:
        """Return the price of the dstates, places and faults of a hypothesis, in nats."""
        price = self._prices[0] * len(found.places) + self._prices[1] * len(found.position)
        price += found.changes + self._problem.overlap.of_steps(found.labels, found.places)
        price += sum(self._fault[kind][t] for t, kind in found.faults)
        if "misread" in self._fault:
            price += sum(map(nats_of_misread, found.seen))
        return price

    def _checked(self, beam: list[Hypothesis], end: int, joins: bool = True) -> list[Hypothesis]:
        """Extend a beam to `end` steps, and check each hypothesis at each step.

        If `joins`, new dstates and places cost their prices, so that returns are cheaper. If not,
        they are free, and the robot returns to a place only if it has to.
        """
        for t in range(len(beam[0].labels) if beam else end, end):
            options = self._options_of(beam, t, joins)
            beam = list(self._best(options, t, WIDER * self._width, checked=True))
        return self._settled(beam)

    def _first(self) -> Hypothesis:
        """Make the hypothesis of the first step: one dstate at one place."""
        mean, covariance = first_pose()
        nowhere = Hypothesis([], [], [], {}, [], [], [], [], mean, covariance, self._prices[0])
        n, met = len(mean) - 3, self._reckoning.met(nowhere, 0, None, None)
        return replace(
            nowhere,
            labels=[0],
            places=[0],
            seen=[{self._sights.seen[0]: self._doubt(0)}],
            drives=[0],
            sights=self._sights.shown[:1],
            position=[n],
            heading=[n + 2],
            mean=met[0],
            covariance=met[1],
        )

    def _map(self, found: Hypothesis, since: int) -> SSHMap | None:
        """Make the map of a hypothesis; None if it contradicts the axioms or the evidence."""
        look_at_clock()
        steps = len(found.labels)
        trace, theory = self._mended(found), self._bare.of_steps(0, steps)
        ssh_map = next(self._completed(found, trace, theory), None)
        if ssh_map is None or any(e.refuse(trace, ssh_map, since) for e in self._problem.evidence):
            return None
        if not self._fault:
            return ssh_map
        whole, theory = self._trace.prefix(steps), self._problem.theory.of_steps(0, steps)
        ssh_map = with_faults(ssh_map, whole, trace, theory)
        return None if next(violations(whole, ssh_map, theory), None) else ssh_map

    def _completed(self, found: Hypothesis, trace: Trace, theory: Theory) -> Iterator[SSHMap]:
        """Yield the valid maps of a hypothesis, one for each way to rotate its unrelated frames."""
        ways = headings_by_turn(found)
        for facing in ways if theory.star == "frame" else islice(ways, 1):
            if ssh_map := valid_map(trace, theory, found.labels, found.places, facing):
                yield ssh_map

    def _believed(self, found: Hypothesis) -> Trace:
        """Return the trace of a hypothesis, without the displacements that it treats as wrong."""
        wrong = [t for t, kind in found.faults if kind == "jumped"]
        return self._trace.prefix(len(found.labels)).without_displacements_at(wrong)

    def _mended(self, found: Hypothesis) -> Trace:
        """Return the trace of a hypothesis, with the faults of the hypothesis corrected."""
        trace = self._believed(found)
        if not self._fault:
            return trace
        steps = list(trace.steps)
        first = first_index_of(self._sights.seen)
        for t, label in enumerate(found.labels):
            right = self._trace.steps[first[right_view(found.seen[label])]]
            steps[t] = replace(steps[t], view=right.view)
            if self._bare.star in ("pattern", "frame"):
                steps[t] = replace(steps[t], star=right.star)
        for t, kind in found.faults:
            if kind == "slipped":
                steps[t] = replace(steps[t], action=Action.that_slipped(t))
        return replace(trace, steps=tuple(steps))

    def _doubt(self, t: int) -> float:
        """Return the cost in nats of treating the view of step t as misread; inf if forbidden."""
        return self._fault["misread"][t] if "misread" in self._fault else math.inf

    def _misread(self, found: Hypothesis, dstate: int, t: int) -> float:
        """Return by how many nats the cost of misread views grows if step t is at a dstate."""
        seen, number, doubt = found.seen[dstate], self._sights.seen[t], self._doubt(t)
        if math.isinf(doubt):
            return 0.0 if number in seen else math.inf
        after = {**seen, number: seen.get(number, 0.0) + doubt}
        return nats_of_misread(after) - nats_of_misread(seen)

    def _options_of(self, beam: Sequence[Hypothesis], t: int, joins: bool) -> list[_Extension]:
        """List the ways to extend the hypotheses of a beam by step t, sorted by cost."""
        look_at_clock()
        options = [
            self._laid(option) if option.of.pieces is not moved.pieces else option
            for found in beam
            for moved in self._moves(found, t)
            for option in self._options(moved, t, joins)
        ]
        return sorted(options, key=lambda option: option.nats)

    def _laid(self, option: _Extension) -> _Extension:
        """Return an option with the price for places that its drive shares with other drives."""
        places = [option.of.places[s] for s in option.of.labels]
        nats = self._problem.overlap.nats
        price = nats([*places, option.place]) - nats(places)
        return replace(option, nats=option.nats + price)

    def _moves(self, found: Hypothesis, t: int) -> Iterator[Hypothesis]:
        """Yield a hypothesis after the move to step t, without and with a fault of the move."""
        moved = self._reckoning.moved(found, t)
        yield moved
        if "slipped" in self._fault and t not in self._frames:
            faults, price = (*found.faults, (t - 1, "slipped")), self._fault["slipped"][t - 1]
            yield replace(moved, faults=faults, nats=moved.nats + price)
        if "jumped" in self._fault and self._trace.steps[t].displacement is not None:
            faults, price = (*found.faults, (t, "jumped")), self._fault["jumped"][t]
            moved = self._reckoning.moved(found, t, believes=False)
            yield replace(moved, faults=faults, nats=moved.nats + price)

    def _options(self, moved: Hypothesis, t: int, joins: bool) -> list[_Extension]:
        """List the cheap ways to extend a hypothesis whose robot has moved to step t."""
        here, action = moved.labels[-1], self._log.actions[t - 1]
        slips = moved.slips(t)
        known = None if slips else moved.links.get((here, action))
        if known is not None:
            place = moved.places[known]
            moved = fitted(moved, place, known)
            nats = (
                moved.nats + self._misread(moved, known, t) + self._sights.changes(moved, place, t)
            )
            nats += float(self._reckoning.squares(moved, t, [place], known)[0]) / 2
            option = _Extension(nats, place, known, moved)
            return [option] if nats < math.inf and self._is_allowed(option, t) else []
        stays = self._stays and self._trace.actions[t - 1].kind == "turn" and not slips
        there = moved.places[here]
        leaves = self._leaves and not slips and t not in self._frames
        if stays:
            places = [there]
        else:
            places = [
                place
                for place in range(len(moved.sights))
                if (place != there or not leaves)
                and self._sights.changes(moved, place, t) < math.inf
            ]
        dstate, new_place = self._prices if joins else (0.0, 0.0)
        options = []
        if not stays:
            nats = moved.nats + dstate + new_place
            options.append(_Extension(nats, None, None, moved))
        for place, square, near in self._near(moved, t, places):
            if square / 2 > DEAREST and not stays:
                continue
            changes = 0.0 if stays else self._sights.changes(moved, place, t)
            if self._bare.level == "topological":
                nats = moved.nats + changes + dstate + square / 2
                options.append(_Extension(nats, place, None, near))
            for s, p in enumerate(moved.places):
                if p == place and (misread := self._misread(moved, s, t)) < math.inf:
                    facing = fitted(moved, place, s)
                    both = float(self._reckoning.squares(facing, t, [place], s)[0])
                    nats = moved.nats + changes + misread + both / 2
                    options.append(_Extension(nats, place, s, facing))
        kept: list[_Extension] = []
        for option in sorted(options, key=lambda option: option.nats):
            if kept and option.nats > kept[0].nats + self._sights.dearest:
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
        squares = self._reckoning.squares(moved, t, own).tolist() if own else []
        yield from ((place, square, moved) for place, square in zip(own, squares, strict=True))
        for place in places:
            if moved.pieces.of_place[place] != moved.pieces.here:
                turned = fitted(moved, place)
                yield place, float(self._reckoning.squares(turned, t, [place])[0]), turned

    def _is_allowed(self, option: _Extension, t: int) -> bool:
        """Whether the option agrees with the evidence about pairs of steps."""
        labels, places = option.of.labels, option.of.places
        if option.dstate is not None:
            return self._log.pairs.allow(t, [*labels, option.dstate], places)
        place = len(option.of.position) if option.place is None else option.place
        return self._log.pairs.allow(t, [*labels, len(places)], [*places, place])

    def _may_go_on(self, option: _Extension, t: int) -> bool:
        """Whether the next displacements agree with the links of the dstate of an option."""
        if option.dstate is None or "slipped" in self._fault or "jumped" in self._fault:
            return True
        actions = self._log.actions
        return self._reckoning.square_ahead(option.of, t, option.dstate, actions) <= 2 * DEAREST

    def _child(self, option: _Extension, t: int) -> Hypothesis:
        """Make the hypothesis that an option leads to, with its pose at step t."""
        moved = option.of
        n = len(moved.mean) - 3
        position, heading, places, seen = moved.position, moved.heading, moved.places, moved.seen
        place, there, sights = option.place, option.dstate, moved.sights
        drives, changes = moved.drives, moved.changes
        pose = self._reckoning.met(
            moved,
            t,
            None if place is None else position[place],
            None if there is None else heading[there],
        )
        if place is None:
            place = len(position)
            position, sights = [*position, n], [*sights, self._sights.shown[t]]
            drives = [*drives, self._sights.drive[t]]
        elif drives[place] != self._sights.drive[t]:
            changes += self._sights.changes(moved, place, t)
            sights = [*sights[:place], self._sights.shown[t], *sights[place + 1 :]]
            drives = [*drives[:place], self._sights.drive[t], *drives[place + 1 :]]
        if there is None:
            there = len(places)
            places, seen = [*places, place], [*seen, {}]
            heading = [*heading, len(pose[0]) - 4]
        number, links = self._sights.seen[t], moved.links
        if not moved.slips(t):
            links = {**links, (moved.labels[-1], self._log.actions[t - 1]): there}
        if number not in seen[there] or "misread" in self._fault:
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
