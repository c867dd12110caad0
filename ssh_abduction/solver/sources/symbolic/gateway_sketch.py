"""Sketches (maps without a search) of traces whose stars have any number of gateways.

>>> from ssh_abduction import Theory, Trace
>>> from ssh_abduction.solver.sources.symbolic.gateway_sketch import sketches_of
>>> from ssh_abduction.theory.settle import settle
>>> there_and_back = ["travel", "around", "travel"]
>>> ends = [[0], [180], [0], [180]]
>>> trace = Trace.from_steps("abab", there_and_back, stars=ends)
>>> theory = settle(trace, Theory(star="gateways")).theory
>>> sketch = sketches_of(trace.steps[0], theory)[-1]
>>> later = zip(trace.actions, trace.steps[1:])
>>> all(sketch.extend(action, step) for action, step in later)
True
>>> sketch.map().places
(0, 1)

A travel leads to a new place if it can. A path ends at a place if no gateway leads on there. So a
travel to a place from which no gateway leads on reaches the end of its path. If the path has an end
in this direction already, the travel leads back to that place. Otherwise the place is new. All
other travels may lead to new places.

A turn leads to a known dstate of its place if the gateways that the robot sees fit the gateways
that it saw there, in the same directions.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Self

from ssh_abduction.data.gateways import (
    Sight,
    allowed_headings,
    are_opposite,
    frames_that_fit,
    leads,
)
from ssh_abduction.data.maps import DState, SSHMap
from ssh_abduction.data.star import Star
from ssh_abduction.data.trace import Action, Step, Trace
from ssh_abduction.solver.sources.symbolic.sketch import Contradiction, Sketch
from ssh_abduction.theory.theory import Theory

# A dstate, and a star that is seen there.
_Seen = tuple[int, Star]


def sketches_of(first: Step, theory: Theory) -> list[Sketch]:
    """Begin a sketch (a map without a search) of each kind, those with small maps first."""
    if _is_gated(theory):
        return [GatewaySketch(first, theory, homing) for homing in (True, False)]
    return Sketch.all_of(first, theory)


def sketch_beyond(ssh_map: SSHMap, trace: Trace, theory: Theory, homing: bool = True) -> Sketch:
    """Make a sketch that begins with a map of a trace, see `Sketch.beyond`."""
    kind = GatewaySketch if _is_gated(theory) else Sketch
    return kind.beyond(ssh_map, trace, theory, homing)


def _is_gated(theory: Theory) -> bool:
    return theory.star == "gateways" and theory.level == "topological"


@dataclass(slots=True)
class _PlaceSights:
    """What was seen and done at a place.

    Attributes:
        sights: For each dstate and star seen there, the first step.
        turns: For two such pairs of a dstate and a star: the turns from the first to the second.
    """

    sights: dict[_Seen, int] = field(default_factory=dict)
    turns: dict[tuple[_Seen, _Seen], set[Action]] = field(default_factory=dict)

    def with_sight(self, seen: _Seen, step: int, move: tuple[_Seen, Action] | None) -> _PlaceSights:
        """Return a copy to which a step at this place is added, with its dstate and star.

        `move` has the dstate and star before the turn to this step, and the turn; None without.
        """
        turns = self.turns
        if move:
            before, action = move
            turns = {**turns, (before, seen): turns.get((before, seen), set()) | {action}}
        return _PlaceSights({**self.sights, seen: self.sights.get(seen, step)}, turns)


class GatewaySketch(Sketch):
    """A sketch (a map made without a search) for stars with any number of gateways.

    If `homing`, a travel may lead back to the place that the robot came from, even if it may lead
    to a new place.
    """

    def __init__(self, first: Step, theory: Theory, homing: bool = True) -> None:
        self._shown: dict[int, _PlaceSights] = defaultdict(_PlaceSights)  # by place
        self._last: _Seen | None = None  # what the last step saw
        self._turn_made: Action | None = None  # the turn after it, if it was one
        self._star_seen = first.gateways or Star(())  # what the present step sees
        self._axioms = frozenset(name for name in theory.axioms if name.startswith("gateway"))
        super().__init__(first, theory, homing)
        self._must_show(0, first)

    @classmethod
    def beyond(cls, ssh_map: SSHMap, trace: Trace, theory: Theory, homing: bool = True) -> Self:
        """Make a sketch that begins with a map of a trace, see `Sketch.beyond`."""
        sketch = super().beyond(ssh_map, trace, theory, homing)
        sketch._shown, sketch._last = defaultdict(_PlaceSights), None
        for t, (label, step) in enumerate(zip(ssh_map.dstate_at, trace.steps, strict=True)):
            place = sketch._states[label].place
            sketch._star_seen = step.gateways or Star(())
            sketch._shown[place] = sketch._grown(place, label, t)
            sketch._last = label, sketch._star_seen
            sketch._turn_made = _turn_of(step.action)
        return sketch

    def extend(self, action: Action, step: Step) -> bool:
        self._turn_made, self._star_seen = _turn_of(action), step.gateways or Star(())
        return super().extend(action, step)

    def _must_show(self, there: int, step: Step) -> None:
        super()._must_show(there, step)
        if not self._may_show(there):
            raise Contradiction
        place = self._states[there].place
        self._shown[place] = self._grown(place, there, len(self.labels))
        self._last = there, self._star_seen

    def _may_show(self, there: int) -> bool:
        """Whether the present step fits a dstate, and the earlier steps at its place."""
        place = self._states[there].place
        grown = self._grown(place, there, len(self.labels))
        known = self._shown[place]
        if len(grown.sights) == len(known.sights) and grown.turns == known.turns:
            return True
        if not known.sights and not self._onward(there):
            return True
        return frames_that_fit(*self._sights(grown), self._axioms, as_shown=False) is not None

    def _grown(self, place: int, there: int, t: int) -> _PlaceSights:
        """Return the sights of a place with step t added, the present step, at dstate `there`."""
        move = None
        if self._turn_made and self._last and self._states[self._last[0]].place == place:
            move = self._last, self._turn_made
        return self._shown[place].with_sight((there, self._star_seen), t, move)

    def _sights(
        self, place: _PlaceSights
    ) -> tuple[list[Sight], dict[tuple[Sight, Sight], set[Action]]]:
        """Return the sights of a place, and the turns between them, for `frames_that_fit`."""
        made: dict[_Seen, Sight] = {}
        shown: set[int] = set()
        for (s, star), t in place.sights.items():
            known = self._states[s]
            direction = None if known.path is None else known.direction
            dstate = DState(s, known.view, known.place, known.path, direction)
            made[s, star] = Sight(dstate, star, t, s not in shown, not shown, self._onward(s))
            shown.add(s)
        return list(made.values()), {(made[a], made[b]): x for (a, b), x in place.turns.items()}

    def _onward(self, s: int) -> tuple[int, ...]:
        """Return the directions in which the path of a dstate goes on: 0 (ahead), 180 (behind)."""
        known = self._states[s]
        if known.path is None:
            return ()
        order = self._orders[known.path][:: known.direction]
        position = order.index(known.place)
        return (0,) * (position + 1 < len(order)) + (180,) * (position > 0)

    def _turned_to(self, here: int, heading: int, action: Action, step: Step) -> int | None:
        s = self._states[here]
        known = dict.fromkeys(x for x, _ in self._shown[s.place].sights)
        if action.turn == "around" and s.path is not None:
            reverse = self._along.get((s.place, s.path, -s.direction))
            known = {reverse: None} if reverse is not None else known
        if not self._homing and self._may_be_new(s.place, step):
            return None
        return self._first_of(known, step)

    def _may_be_new(self, place: int, step: Step) -> bool:
        """Whether a step may be at a new dstate of a known place."""
        there = self._new(step, place, 0)
        fits = self._may_show(there)
        self._states.pop()
        return fits

    def _first_of(self, known: Iterable[int], step: Step) -> int | None:
        """Return the first known dstate that fits a step; None if none does."""
        return next((x for x in known if self._may_be_at(x, step) and self._may_show(x)), None)

    def _course_through(self, here: int) -> tuple[int, int] | None:
        if not self._homing and self._may_begin_path(here):
            return None
        sights, turns = self._sights(self._shown_with(here))
        read = frames_that_fit(sights, turns, self._axioms, as_shown=False) or []
        own = [
            turned for sight, turned in zip(sights, read, strict=False) if sight.dstate.id == here
        ]
        for sight, turned in zip(sights, read, strict=False):
            path, direction = sight.dstate.path, sight.dstate.direction
            if path is not None and any(are_opposite(turned, x) for x in own):
                return path, -(direction or 1)
        return None

    def _shown_with(self, here: int) -> _PlaceSights:
        """Return the sights of the place of a dstate, which may be that of the present step."""
        known = self._shown[self._states[here].place]
        is_shown = any(x == here for x, _ in known.sights)
        return known if is_shown else self._grown(self._states[here].place, here, len(self.labels))

    def _may_begin_path(self, here: int) -> bool:
        """Whether a new path may leave a place in the heading of a dstate."""
        s = self._states[here]
        self._orders.append([s.place])
        s.path, s.direction = len(self._orders) - 1, 1
        fitted = frames_that_fit(
            *self._sights(self._shown_with(here)), self._axioms, as_shown=False
        )
        s.path = None
        self._orders.pop()
        return fitted is not None

    def _travel(self, here: int, step: Step) -> int:
        leads_on = any(leads(frame, 0) for frame in self._star_seen.frames)
        if "gateway_end" not in self._axioms or leads_on:
            return super()._travel(here, step)
        path, direction = self._find_course(here)
        place, order = self._states[here].place, self._orders[path]
        last = order[-1 if direction == 1 else 0]
        is_next = abs(order.index(last) - order.index(place)) == 1
        goes_on = self._may_go_on(last, path, direction)
        if last != place and (not goes_on or (self._homing and is_next)):
            there = self._known_ahead(last, path, direction, step)
            if there is not None:
                return there
        if not goes_on:
            raise Contradiction
        there = self._new_place(step)
        order.insert(len(order) if direction == 1 else 0, self._states[there].place)
        self._set_course(there, path, direction)
        return there

    def _may_go_on(self, last: int, path: int, direction: int) -> bool:
        """Whether a path may lead on from its last place, by the gateways seen there."""
        order = self._orders[path]
        order.insert(len(order) if direction == 1 else 0, len(self._stars))
        fitted = frames_that_fit(*self._sights(self._shown[last]), self._axioms, as_shown=False)
        del order[-1 if direction == 1 else 0]
        return fitted is not None

    def _known_ahead(self, place: int, path: int, direction: int, step: Step) -> int | None:
        there = self._along.get((place, path, direction))
        known = (
            [there]
            if there is not None
            else dict.fromkeys(
                x for x, _ in self._shown[place].sights if self._states[x].path is None
            )
        )
        found = self._first_of(known, step)
        if found is None and there is None and self._may_be_new(place, step):
            found = self._new(step, place, 0)
        if found is not None:
            self._set_course(found, path, direction)
        return found

    def _made(self, labels: tuple[int, ...]) -> SSHMap:
        ssh_map = super()._made(labels)
        sights: list[Sight] = []
        turns: dict[tuple[Sight, Sight], set[Action]] = {}
        for place in self._shown.values():
            seen, made = self._sights(place)
            sights.extend(seen)
            turns.update(made)
        found = allowed_headings(sights, turns, self._axioms)
        dstates = tuple(replace(s, heading=found.get(s.id)) for s in ssh_map.dstates)
        return replace(ssh_map, dstates=dstates)


def _turn_of(action: Action | None) -> Action | None:
    return action if action is not None and action.kind == "turn" else None
