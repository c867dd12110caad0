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

Each step extends each hypothesis in all ways that cost little (`extending.py`). The *beam* is the
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
from dataclasses import replace
from itertools import islice

from ssh_abduction.checker.checker import violations
from ssh_abduction.data.action import Action
from ssh_abduction.data.drives import frames_of
from ssh_abduction.data.groups import first_index_of
from ssh_abduction.data.maps import SSHMap
from ssh_abduction.data.trace import Trace
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.solver.guesses.completing import valid_map
from ssh_abduction.solver.guesses.extending import Extending, Extension
from ssh_abduction.solver.guesses.pieces import headings_by_turn
from ssh_abduction.solver.guesses.reckoning import Hypothesis
from ssh_abduction.solver.steps.faults import with_faults
from ssh_abduction.solver.steps.log import Log
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


class Beam:
    """The search for hypotheses of little cost.

    Attributes:
        hypotheses: The hypotheses of the whole trace, by cost; none before `maps` has ended.
        refuses: Whether the checker refused a hypothesis.
    """

    def __init__(self, problem: Problem, log: Log, width: int) -> None:
        """Prepare the search with this many hypotheses in the beam. `maps` runs it."""
        self._trace, self._width, self._problem = problem.trace, width, problem
        self._extending = ways = Extending(problem, log)
        self._bare, self._fault, self._prices = ways.bare, ways.fault, ways.prices
        self._sights, self._reckoning = ways.sights, ways.reckoning
        self._has_frames = bool(frames_of(problem.trace))
        self.hypotheses: list[Hypothesis] = []
        self.refuses = False
        self._kept: list[list[Hypothesis]] = []  # the beam after each check

    def maps(self, most: float = math.inf) -> Iterator[SSHMap]:
        """Yield the maps of the hypotheses of the whole trace that satisfy the axioms, by cost.

        Give up as soon as all hypotheses cost more than `most` nats.

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
                continue
            at = found.faults, option.place, *map(found.places.__getitem__, found.labels)
            if count[found.pieces.joins] >= width and (several or at in known):
                continue
            child = self._extending.extended(option, t)
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
            price += sum(map(self._sights.misread, found.seen))
        return price

    def _checked(self, beam: list[Hypothesis], end: int, joins: bool = True) -> list[Hypothesis]:
        """Extend a beam to `end` steps, and check each hypothesis at each step.

        If `joins`, new dstates and places cost their prices, so that returns are cheaper. If not,
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
        maps = (valid_map(trace, theory, found.labels, found.places, way) for way in turned)
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
        steps = list(trace.steps)
        first = first_index_of(self._sights.seen)
        for t, label in enumerate(found.labels):
            right = self._trace.steps[first[self._sights.right(found.seen[label])]]
            steps[t] = replace(steps[t], view=right.view)
            if self._bare.star in ("pattern", "frame"):
                steps[t] = replace(steps[t], star=right.star)
        for t, kind in found.faults:
            if kind == "slipped":
                steps[t] = replace(steps[t], action=Action.that_slipped(t))
        return replace(trace, steps=tuple(steps))
