"""Builds a consistent map without a search: an action leads to a new dstate if the axioms allow it.

>>> from ssh_abduction import Theory
>>> from ssh_abduction.data import Action, Step
>>> from ssh_abduction.solver.sources.symbolic.sketch import Sketch
>>> sketch = Sketch(Step("end"), Theory(star="none"))
>>> travel, around = Action("travel", "travel"), Action("around", "turn", "around")
>>> done = [(travel, "hall"), (around, "hall"), (travel, "end"), (around, "end")]
>>> [sketch.extend(action, Step(view)) for action, view in done]
[True, True, True, True]
>>> sketch.map().labels
(0, 1, 2, 3, 0)

Such a map is a *sketch*, and its paths make a tree. A travel leads to a new place, or back along
its path to the place that the robot came from. So two paths share at most one place. If a path
branches off from another one, the places of the branch are not on that other path. Therefore the
axioms of order and sides hold. Within a place, the axioms of turns, courses and headings determine
which dstates are one.

If a travel comes back to a place, but the step there contradicts what was seen there, the travel
leads to a new place instead. If a later step contradicts a known dstate, the sketch fails. A sketch
without `homing` never comes back to a place, unless the theory has the axiom next_place or planar.
So it may succeed when a sketch with `homing` fails.

A sketch may have frames, numbered directions at each place, even if the theory has none. That only
adds axioms.

A sketch may also begin with a map of some steps, and grow like a tree from there. New dstates lie
on new paths, or on one known path, and contradict nothing. In three cases the sketch does not know
whether it is still consistent:

- A turn is the first one that shows how two known paths cross. The crossing has to fit all their
  places.
- Without frames, a turn leads from a dstate to itself. Then the dstate can be on no path.
- Without frames, two turns to the right lead back. Then a new place ahead would be on both sides of
  a path.

Stars may have any number of gateways at any angles (`GatewaySketch`). Then a travel leads to a new
place if it can. A path ends at a place if no gateway leads on there. So a
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
from ssh_abduction.data.maps import DState, MapPath, SSHMap
from ssh_abduction.data.star import Star
from ssh_abduction.data.step import QUARTERS
from ssh_abduction.data.trace import Action, Step, Trace, View
from ssh_abduction.solver.steps.log import observation
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


class Contradiction(Exception):  # noqa: N818 - not an error
    """A step contradicts the axioms."""


@dataclass(slots=True)
class KnownDState:
    """A dstate of a sketch (a map made without a search), as far as it is known.

    Attributes:
        seen: The observation: the view, and the star if the theory uses stars. The view is None
            until a step at this dstate has a known view.
        heading: The heading in the frame of the place, in quarters clockwise.
        path: The number of the path; None if it is unknown.
        direction: The direction along the path, 1 or -1.
        reverse: The dstates that a turn around links with this one.
    """

    view: View | None
    seen: tuple[object, object]
    place: int
    heading: int
    path: int | None = None
    direction: int = 1
    reverse: list[int] = field(default_factory=list)


class Sketch:
    """A map of the steps so far, made without a search, which grows with each step.

    Args:
        first: The first step of the trace, with its view and star.
        theory: The axioms that the map obeys.
        homing: Whether a travel may lead back to the place that the robot came from. With the axiom
            next_place or planar it always may, as these often demand it.
        framed: Whether places have frames even if the theory has none. Then most turns lead to
            known dstates.

    Attributes:
        labels: The dstate of each step.
    """

    def __init__(
        self, first: Step, theory: Theory, homing: bool = True, framed: bool = False
    ) -> None:
        self.labels: list[int] = []
        self._theory = theory
        self._homing = homing or theory.next_place or theory.planar
        self._framed = framed or theory.star == "frame"
        self._states: list[KnownDState] = []
        self._links: dict[tuple[int, str], int] = {}
        self._stars: list[object] = []  # for each place, its star (the openings seen there)
        self._orders: list[list[int]] = []  # for each path, its places in the order of direction 1
        self._along: dict[tuple[int, int, int], int] = {}  # place, path, direction: dstate
        # Only with frames: for each place and heading, the dstate, and the path and direction.
        self._facing: dict[tuple[int, int], int] = {}
        self._slots: dict[tuple[int, int], tuple[int, int]] = {}
        self._excused: tuple[tuple[int, int], ...] = ()  # pairs of paths
        self._map: SSHMap | None = None
        self.labels.append(self._new_place(first))
        if theory.all_on_paths and theory.level == "topological":
            self._find_course(0)

    @classmethod
    def all_of(cls, first: Step, theory: Theory) -> list[Sketch]:
        """Begin a sketch of each kind, those with small maps first.

        The kinds differ in `homing` and, if the theory leaves it open, in `framed`.
        """
        framed = (
            [True, False] if theory.level == "topological" and theory.star != "frame" else [False]
        )
        return [cls(first, theory, homing, frames) for frames in framed for homing in (True, False)]

    @classmethod
    def beyond(cls, ssh_map: SSHMap, trace: Trace, theory: Theory, homing: bool = True) -> Self:
        """Make a sketch that begins with a map of a trace, which has to satisfy all axioms."""
        sketch = cls(trace.steps[0], theory, homing)
        sketch._map, sketch.labels = ssh_map, list(ssh_map.dstate_at)
        sketch._links = {(s, action): x for s, action, x in ssh_map.links}
        sketch._excused = ssh_map.excused
        sketch._orders = [list(path.order) for path in ssh_map.paths]
        sketch._states, sketch._along, sketch._facing, sketch._slots = [], {}, {}, {}
        stars: dict[int, object] = {}
        # The star of a dstate is that of its first step.
        seen = dict(zip(reversed(ssh_map.dstate_at), reversed(trace.steps), strict=True))
        for s in ssh_map.dstates:
            place, heading, direction = s.place or 0, s.heading or 0, s.direction or 1
            shown = observation(replace(seen[s.id], view=s.view), theory)
            sketch._states.append(KnownDState(s.view, shown, place, heading, s.path, direction))
            stars.setdefault(place, sketch._star(seen[s.id], heading))
            if s.path is not None:
                sketch._along[place, s.path, direction] = s.id
            if sketch._framed:
                sketch._facing[place, heading] = s.id
            if sketch._framed and s.path is not None:
                sketch._slots[place, heading] = s.path, direction
                sketch._slots[place, (heading + 2) % 4] = s.path, -direction
        sketch._stars = [stars[place] for place in sorted(stars)]
        turns = {action.name: action.turn for action in trace.actions}
        for here, action, there in ssh_map.links:
            if turns[action] == "around":
                sketch._states[here].reverse.append(there)
                sketch._states[there].reverse.append(here)
        return sketch

    def extend(self, action: Action, step: Step) -> bool:
        """Add an action and the step after it. If they contradict the sketch, return False.

        Then the sketch cannot be used any more.
        """
        here = self.labels[-1]
        there = self._links.get((here, action.name))
        try:
            if there is None:
                there = self._untried(here, action, step)
                if not action.starts:
                    self._links[here, action.name] = there
                self._map = None
            self._must_show(there, step)
        except Contradiction:
            return False
        self.labels.append(there)
        return True

    def leads_to(self, action: Action) -> int | None:
        """Return the dstate to which an action leads from the last step; None if it is unknown."""
        return self._links.get((self.labels[-1], action.name))

    def map(self) -> SSHMap:
        """Return the map of all steps so far. Numbers follow the order of first visits."""
        labels = tuple(self.labels)
        self._map = replace(self._map, dstate_at=labels) if self._map else self._made(labels)
        return self._map

    def _untried(self, here: int, action: Action, step: Step) -> int:
        """Decide where an action without a link leads, and return the dstate there."""
        if self._theory.level == "causal":
            return self._new(step, 0, 0)
        if action.leaves_paths:
            there = self._new_place(step)
        elif action.kind == "travel":
            there = self._travel(here, step)
        else:
            there = self._turn(here, action, step)
        if self._theory.all_on_paths:
            self._find_course(there)
        return there

    def _turn(self, here: int, action: Action, step: Step) -> int:
        """Decide where a turn without a link leads, and return the dstate there."""
        s = self._states[here]
        around = action.turn == "around"
        heading = (s.heading + QUARTERS[action.turn]) % 4
        there = self._turned_to(here, heading, action, step)
        if there is None:
            there = self._new(step, s.place, heading)
        if around:
            self._turned_around(here, there)
        return there

    def _turned_to(self, here: int, heading: int, action: Action, step: Step) -> int | None:
        """Return the known dstate that a turn leads to by the axioms; None if there is none."""
        s = self._states[here]
        if self._framed:
            return self._facing.get((s.place, heading))
        if action.turn != "around":
            return None
        if s.path is not None:
            return self._along.get((s.place, s.path, -s.direction))
        return next((x for x in s.reverse if self._may_be_at(x, step)), None)

    def _turned_around(self, here: int, there: int) -> None:
        """Link two dstates by a turn around. They get opposite directions of one path."""
        self._states[here].reverse.append(there)
        self._states[there].reverse.append(here)
        for s in (self._states[here], self._states[there]):
            if s.path is not None:
                for x in s.reverse:
                    self._set_course(x, s.path, -s.direction)

    def _travel(self, here: int, step: Step) -> int:
        """Decide where a travel without a link leads, and return the dstate there."""
        path, direction = self._find_course(here)
        place, order = self._states[here].place, self._orders[path]
        position = order.index(place)
        if self._homing and 0 <= position + direction < len(order):
            there = self._known_ahead(order[position + direction], path, direction, step)
            if there is not None:
                return there
            if self._theory.next_place:
                raise Contradiction
        there = self._new_place(step)
        order.insert(position + (direction == 1), self._states[there].place)
        self._set_course(there, path, direction)
        return there

    def _known_ahead(self, place: int, path: int, direction: int, step: Step) -> int | None:
        """Return the dstate where a travel to a known place ends; None if the step rules it out."""
        there = self._along.get((place, path, direction))
        heading = 0
        if there is None and self._framed:
            heading = next(k for k in range(4) if self._slots.get((place, k)) == (path, direction))
            there = self._facing.get((place, heading))
        if there is None:
            if self._star(step, heading) != self._stars[place]:
                return None
            there = self._new(step, place, heading)
        elif not self._may_be_at(there, step):
            return None
        self._set_course(there, path, direction)
        return there

    def _find_course(self, here: int) -> tuple[int, int]:
        """Return the path and direction of a dstate, and choose them if they are unknown.

        The dstate gets the path that leaves the place in its heading. If that is unknown, or there
        are no frames, it gets a new path.
        """
        s = self._states[here]
        if s.path is None:
            path, direction = self._course_through(here) or (len(self._orders), 1)
            if path == len(self._orders):
                self._orders.append([s.place])
            self._set_course(here, path, direction)
            return path, direction
        return s.path, s.direction

    def _course_through(self, here: int) -> tuple[int, int] | None:
        """Return the known path and direction in the heading of a dstate; None without frames."""
        s = self._states[here]
        return self._slots.get((s.place, s.heading))

    def _set_course(self, here: int, path: int, direction: int) -> None:
        """Give a dstate a course, and those that a turn around links with it the reverse one."""
        s = self._states[here]
        if (s.path, s.direction) == (path, direction):
            return
        if s.path is not None or self._along.setdefault((s.place, path, direction), here) != here:
            raise Contradiction
        s.path, s.direction = path, direction
        if self._framed:
            self._slots[s.place, s.heading] = path, direction
            self._slots[s.place, (s.heading + 2) % 4] = path, -direction
        for x in s.reverse:
            self._set_course(x, path, -direction)

    def _new_place(self, step: Step) -> int:
        """Add a place with a dstate for a step, and return the dstate."""
        self._stars.append(self._star(step, 0))
        return self._new(step, len(self._stars) - 1, 0)

    def _new(self, step: Step, place: int, heading: int) -> int:
        """Add a dstate for a step at a place, and return the dstate."""
        if self._star(step, heading) != self._stars[place]:
            raise Contradiction
        self._states.append(KnownDState(step.view, observation(step, self._theory), place, heading))
        if self._framed:
            self._facing[place, heading] = len(self._states) - 1
        return len(self._states) - 1

    def _star(self, step: Step, heading: int) -> object:
        """Return the star (openings) of a place, as a step with this heading sees it.

        With frames, the star is turned so that it begins with slot 0 of the place.
        """
        star = step.openings if self._theory.star in ("pattern", "frame") else None
        if self._framed and star is not None:
            return tuple(star[(slot - heading) % 4] for slot in range(4))
        return observation(step, self._theory)[1]

    def _must_show(self, there: int, step: Step) -> None:
        """Raise `Contradiction` if a step differs from the observation of its dstate."""
        if not self._may_be_at(there, step):
            raise Contradiction
        s = self._states[there]
        if s.view is None:
            s.view, s.seen = step.view, observation(step, self._theory)

    def _may_be_at(self, there: int, step: Step) -> bool:
        """Whether a step fits the observation of a dstate. An unknown view fits every view."""
        (known, star), (view, seen) = self._states[there].seen, observation(step, self._theory)
        return star == seen and (known == view or known is None or view is None)

    def _made(self, labels: tuple[int, ...]) -> SSHMap:
        """Build the map of all steps, with the dstate of each step as `labels`."""
        links = tuple(sorted((s, action, x) for (s, action), x in self._links.items()))
        if self._theory.level == "causal":
            return SSHMap(
                labels, tuple(DState(i, s.view) for i, s in enumerate(self._states)), links
            )
        # For each path, its number in the map, and the direction that is faced first.
        first: dict[int, tuple[int, int]] = {}
        for s in self._states:
            if s.path is not None:
                first.setdefault(s.path, (len(first), s.direction))
        dstates = tuple(
            DState(
                id=i,
                view=s.view,
                place=s.place,
                path=None if s.path is None else first[s.path][0],
                direction=None if s.path is None else s.direction * first[s.path][1],
                heading=s.heading if self._theory.star == "frame" else None,
            )
            for i, s in enumerate(self._states)
        )
        paths = tuple(
            MapPath(number, tuple(self._orders[path][::direction]))
            for path, (number, direction) in first.items()
        )
        excused = [sorted((first[h][0], first[g][0])) for h, g in self._excused]
        return SSHMap(
            labels,
            dstates,
            links,
            tuple(range(len(self._stars))),
            paths,
            tuple(sorted((h, g) for h, g in excused)),
        )


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
