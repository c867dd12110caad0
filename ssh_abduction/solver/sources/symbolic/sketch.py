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

A sketch with faults treats a step that contradicts it as wrong, and is then made again from the
first step. It often has more faults than necessary.

>>> from ssh_abduction import Trace
>>> from ssh_abduction.theory.settle import settle
>>> trace = Trace.from_steps("abcb", ["travel", "around", "around"])
>>> theory = settle(trace, Theory(slipped=1.0, boundary="none")).theory
>>> mended_sketch(trace, theory).map.dstate_at
(0, 1, 2, 1)
>>> wrong = mended_sketch(trace.with_views("abcd"), theory).map
>>> [(fault.step, fault.kind) for fault in wrong.faults]
[(2, 'slipped')]
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Self

from ssh_abduction.checker.checker import violations
from ssh_abduction.data.gateways import (
    Sight,
    Turned,
    allowed_headings,
    are_opposite,
    frames_that_fit,
    leads,
)
from ssh_abduction.data.maps import DState, MapPath, SSHMap
from ssh_abduction.data.star import Star
from ssh_abduction.data.step import QUARTERS
from ssh_abduction.data.trace import Action, Step, Trace, View
from ssh_abduction.runtime.clock import each_looking
from ssh_abduction.solver.steps.faults import with_faults
from ssh_abduction.solver.steps.log import observation
from ssh_abduction.theory.theory import Theory

# A dstate, and a star that is seen there.
_Seen = tuple[int, Star]
# What was seen and done at a place: for each dstate and star, the first step; and the turns, each
# with the dstate and star before and after it.
_Shown = tuple[dict[_Seen, int], frozenset[tuple[_Seen, _Seen, Action]]]


def sketches_of(first: Step, theory: Theory) -> list[Sketch]:
    """Begin a sketch of each kind. A sketch is a map that is made without a search.

    The kinds differ in `homing` and, if the theory leaves it open, in `framed`. Kinds that mostly
    give smaller maps come first.
    """
    if _is_gated(theory):
        return [GatewaySketch(first, theory, homing) for homing in (True, False)]
    framed = [True, False] if theory.level == "topological" and theory.star != "frame" else [False]
    return [Sketch(first, theory, homing, frames) for frames in framed for homing in (True, False)]


def sketch_beyond(ssh_map: SSHMap, trace: Trace, theory: Theory, homing: bool = True) -> Sketch:
    """Make a sketch that begins with a map of a trace, which has to satisfy all axioms."""
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

    seen: tuple[View | None, object]
    place: int
    heading: int
    path: int | None = None
    direction: int = 1
    reverse: list[int] = field(default_factory=list)


class Sketch:
    """A map of the steps so far, made without a search, which grows with each step.

    Each action without a link leads to the first of some known dstates that fits the step after it,
    or else to a new dstate.

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
        there = self._new_place(first)
        if theory.all_on_paths and theory.level == "topological":
            self._find_course(there)
        self._must_show(there, first)
        self.labels.append(there)

    @classmethod
    def beyond(cls, ssh_map: SSHMap, trace: Trace, theory: Theory, homing: bool = True) -> Self:
        """Make a sketch that begins with a map of a trace, which has to satisfy all axioms."""
        sketch = cls(trace.steps[0], theory, homing)
        sketch._map, sketch.labels = ssh_map, list(ssh_map.dstate_at)
        sketch._links = {(s, action): x for s, action, x in ssh_map.links}
        sketch._excused = ssh_map.excused
        sketch._orders = [list(path.order) for path in ssh_map.theory_paths]
        sketch._states, sketch._along, sketch._facing, sketch._slots = [], {}, {}, {}
        stars: dict[int, object] = {}
        # The star of a dstate is that of its first step.
        seen = dict(zip(reversed(ssh_map.dstate_at), reversed(trace.steps), strict=True))
        for s in ssh_map.dstates:
            place, heading = s.place or 0, s.heading or 0
            shown = observation(replace(seen[s.id], view=s.view), theory)
            sketch._states.append(KnownDState(shown, place, heading))
            stars.setdefault(place, sketch._star(seen[s.id], heading))
            if sketch._framed:
                sketch._facing[place, heading] = s.id
            if s.path is not None:
                sketch._put_on(s.id, s.path, s.direction or 1)
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
            return self._chosen((), step, 0, 0)
        if action.leaves_paths:
            there = self._new_place(step)
        elif action.kind == "travel":
            there = self._travel(here, step)
        else:
            there = self._turn(here, action, step)
        if self._theory.all_on_paths:
            self._find_course(there)
        return there

    def _chosen(self, known: Iterable[int], step: Step, place: int, heading: int) -> int:
        """Return the first known dstate that fits a step, or else a new one at a place."""
        there = next((x for x in known if self._may_be_at(x, step)), None)
        there = self._new(step, place, heading) if there is None else there
        if there is None:
            raise Contradiction
        return there

    def _turn(self, here: int, action: Action, step: Step) -> int:
        """Decide where a turn without a link leads, and return the dstate there."""
        s = self._states[here]
        heading = (s.heading + QUARTERS[action.turn]) % 4
        known = self._turned_to(here, heading, action, step)
        there = self._chosen(known, step, s.place, heading)
        if action.turn == "around":
            # The two dstates get opposite directions of one path.
            s.reverse.append(there)
            self._states[there].reverse.append(here)
            for x in (s, self._states[there]):
                if x.path is not None:
                    for y in x.reverse:
                        self._set_course(y, x.path, -x.direction)
        return there

    def _turned_to(self, here: int, heading: int, action: Action, step: Step) -> Iterable[int]:
        """List the known dstates that a turn may lead to by the axioms."""
        s = self._states[here]
        if self._framed:
            known = self._facing.get((s.place, heading))
        elif action.turn != "around":
            return ()
        elif s.path is None:
            return s.reverse
        else:
            known = self._along.get((s.place, s.path, -s.direction))
        return () if known is None else (known,)

    def _travel(self, here: int, step: Step) -> int:
        """Decide where a travel without a link leads, and return the dstate there."""
        path, direction = self._find_course(here)
        known, position, may_be_new = self._ahead(self._states[here].place, path, direction)
        there = None if known is None else self._at_known(known, path, direction, step)
        if there is None:
            if not may_be_new:
                raise Contradiction
            there = self._new_place(step)
            self._orders[path].insert(position, self._states[there].place)
        self._set_course(there, path, direction)
        return there

    def _ahead(self, place: int, path: int, direction: int) -> tuple[int | None, int, bool]:
        """Return where a travel from a place along a path may lead.

        These are a known place, or None; the position that a new place gets in the order of the
        path; and whether a new place is allowed.
        """
        order = self._orders[path]
        position = order.index(place)
        is_known = self._homing and 0 <= position + direction < len(order)
        known = order[position + direction] if is_known else None
        may_be_new = known is None or not self._theory.next_place
        return known, position + (direction == 1), may_be_new

    def _at_known(self, place: int, path: int, direction: int, step: Step) -> int | None:
        """Return the dstate where a travel to a known place ends; None if the step rules it out."""
        known = self._along.get((place, path, direction))
        if known is not None:
            return known if self._may_be_at(known, step) else None
        heading = 0
        if self._framed:
            heading = next(k for k in range(4) if self._slots.get((place, k)) == (path, direction))
        with suppress(Contradiction):
            return self._chosen(self._off_paths(place, heading), step, place, heading)
        return None

    def _off_paths(self, place: int, heading: int) -> Iterable[int]:
        """List the known dstates of a place without a path that may have a heading."""
        known = self._facing.get((place, heading))
        return () if known is None else (known,)

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
        if s.path is not None or self._along.get((s.place, path, direction), here) != here:
            raise Contradiction
        self._put_on(here, path, direction)
        for x in s.reverse:
            self._set_course(x, path, -direction)

    def _put_on(self, here: int, path: int, direction: int) -> None:
        """Give a dstate a course."""
        s = self._states[here]
        s.path, s.direction = path, direction
        self._along[s.place, path, direction] = here
        if self._framed:
            self._slots[s.place, s.heading] = path, direction
            self._slots[s.place, (s.heading + 2) % 4] = path, -direction

    def _new_place(self, step: Step) -> int:
        """Add a place with a dstate for a step, and return the dstate."""
        self._stars.append(self._star(step, 0))
        return self._chosen((), step, len(self._stars) - 1, 0)

    def _new(self, step: Step, place: int, heading: int) -> int | None:
        """Add a dstate for a step at a place, and return it; None if the step does not fit there.

        With frames, it does not fit if the place has another dstate with this heading.
        """
        there = len(self._states)
        if self._star(step, heading) != self._stars[place]:
            return None
        if self._framed and self._facing.setdefault((place, heading), there) != there:
            return None
        self._states.append(KnownDState(observation(step, self._theory), place, heading))
        return there

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
        if s.seen[0] is None:
            s.seen = observation(step, self._theory)

    def _may_be_at(self, there: int, step: Step) -> bool:
        """Whether a step fits the observation of a dstate. An unknown view fits every view."""
        (known, star), (view, seen) = self._states[there].seen, observation(step, self._theory)
        return star == seen and (known == view or known is None or view is None)

    def _made(self, labels: tuple[int, ...]) -> SSHMap:
        """Build the map of all steps, with the dstate of each step as `labels`."""
        links = tuple(sorted((s, action, x) for (s, action), x in self._links.items()))
        if self._theory.level == "causal":
            return SSHMap(
                labels, tuple(DState(i, s.seen[0]) for i, s in enumerate(self._states)), links
            )
        # For each path, its number in the map, and the direction that is faced first.
        first: dict[int, tuple[int, int]] = {}
        for s in self._states:
            if s.path is not None:
                first.setdefault(s.path, (len(first), s.direction))
        dstates = tuple(
            DState(
                id=i,
                view=s.seen[0],
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


class GatewaySketch(Sketch):
    """A sketch (a map made without a search) for stars with any number of gateways.

    If `homing`, a travel may lead back to the place that the robot came from, even if it may lead
    to a new place.
    """

    def __init__(self, first: Step, theory: Theory, homing: bool = True) -> None:
        self._shown: dict[int, _Shown] = defaultdict(lambda: ({}, frozenset()))  # by place
        self._last: _Seen | None = None  # what the last step saw
        self._turn_made: Action | None = None  # the turn after it, if it was one
        self._star_seen = first.gateways or Star(())  # what the present step sees
        self._axioms = frozenset(name for name in theory.axioms if name.startswith("gateway"))
        super().__init__(first, theory, homing)

    @classmethod
    def beyond(cls, ssh_map: SSHMap, trace: Trace, theory: Theory, homing: bool = True) -> Self:
        sketch = super().beyond(ssh_map, trace, theory, homing)
        sketch._shown.clear()
        sketch._last, sketch.labels, action = None, [], None
        for label, step in zip(ssh_map.dstate_at, trace.steps, strict=True):
            sketch._see(action, step)
            sketch._note(label)
            sketch.labels.append(label)
            action = step.action
        return sketch

    def extend(self, action: Action, step: Step) -> bool:
        self._see(action, step)
        return super().extend(action, step)

    def _see(self, action: Action | None, step: Step) -> None:
        """Take over the star of the present step, and the action before it if it is a turn."""
        self._turn_made = action if action is not None and action.kind == "turn" else None
        self._star_seen = step.gateways or Star(())

    def _must_show(self, there: int, step: Step) -> None:
        super()._must_show(there, step)
        self._note(there)

    def _note(self, there: int) -> None:
        """Add the present step, at a dstate, to what was seen and done at its place."""
        self._shown[self._states[there].place] = self._grown(there)
        self._last = there, self._star_seen

    def _grown(self, there: int) -> _Shown:
        """Return what was seen and done at the place of a dstate, and the present step there."""
        place, seen = self._states[there].place, (there, self._star_seen)
        sights, turns = self._shown[place]
        if self._turn_made and self._last and self._states[self._last[0]].place == place:
            turns |= {(self._last, seen, self._turn_made)}
        return {**sights, seen: sights.get(seen, len(self.labels))}, turns

    def _may_be_at(self, there: int, step: Step) -> bool:
        """Whether the present step fits a dstate, and the earlier steps at its place."""
        if not super()._may_be_at(there, step):
            return False
        known, grown = self._shown[self._states[there].place], self._grown(there)
        if known == grown or not (known[0] or self._onward(there)):
            return True
        return self._fitted(grown) is not None

    def _new(self, step: Step, place: int, heading: int) -> int | None:
        there = super()._new(step, place, heading)
        if there is not None and not self._may_be_at(there, step):
            self._states.pop()
            return None
        return there

    def _fitted(self, shown: _Shown) -> list[tuple[Sight, Turned]] | None:
        """Fit frames to what was seen and done at a place, as `frames_that_fit` does."""
        sights, turns = self._sights(shown)
        fitted = frames_that_fit(sights, turns, self._axioms, as_shown=False)
        return None if fitted is None else list(zip(sights, fitted, strict=True))

    def _sights(self, shown: _Shown) -> tuple[list[Sight], dict[tuple[Sight, Sight], set[Action]]]:
        """Return the sights of a place, and the turns between them, for `frames_that_fit`."""
        made: dict[_Seen, Sight] = {}
        ids: set[int] = set()
        for (s, star), t in shown[0].items():
            known = self._states[s]
            direction = None if known.path is None else known.direction
            dstate = DState(s, known.seen[0], known.place, known.path, direction)
            made[s, star] = Sight(dstate, star, t, s not in ids, not ids, self._onward(s))
            ids.add(s)
        turns: dict[tuple[Sight, Sight], set[Action]] = defaultdict(set)
        for before, after, action in shown[1]:
            turns[made[before], made[after]].add(action)
        return list(made.values()), turns

    def _onward(self, s: int) -> tuple[int, ...]:
        """Return the directions in which the path of a dstate goes on: 0 (ahead), 180 (behind)."""
        known = self._states[s]
        if known.path is None:
            return ()
        order = self._orders[known.path][:: known.direction]
        position = order.index(known.place)
        return (0,) * (position + 1 < len(order)) + (180,) * (position > 0)

    def _known_at(self, place: int) -> list[int]:
        """List the known dstates of a place, in the order of their first steps."""
        return list(dict.fromkeys(x for x, _ in self._shown[place][0]))

    def _turned_to(self, here: int, heading: int, action: Action, step: Step) -> Iterable[int]:
        s = self._states[here]
        there = None if self._homing else self._new(step, s.place, heading)
        if there is not None:
            return (there,)
        is_reverse = action.turn == "around" and s.path is not None
        reverse = super()._turned_to(here, heading, action, step) if is_reverse else ()
        return reverse or self._known_at(s.place)

    def _off_paths(self, place: int, heading: int) -> Iterable[int]:
        return [x for x in self._known_at(place) if self._states[x].path is None]

    def _course_through(self, here: int) -> tuple[int, int] | None:
        s = self._states[here]
        is_shown = here in self._known_at(s.place)
        shown = self._shown[s.place] if is_shown else self._grown(here)
        if not self._homing:
            # Prefer a new path, if one may leave the place in the heading of the dstate.
            self._orders.append([s.place])
            s.path, s.direction = len(self._orders) - 1, 1
            fitted = self._fitted(shown)
            s.path = None
            self._orders.pop()
            if fitted is not None:
                return None
        read = self._fitted(shown) or []
        own = [turned for sight, turned in read if sight.dstate.id == here]
        for sight, turned in read:
            path, direction = sight.dstate.path, sight.dstate.direction
            if path is not None and any(are_opposite(turned, x) for x in own):
                return path, -(direction or 1)
        return None

    def _ahead(self, place: int, path: int, direction: int) -> tuple[int | None, int, bool]:
        leads_on = any(leads(frame, 0) for frame in self._star_seen.frames)
        if "gateway_end" not in self._axioms or leads_on:
            return super()._ahead(place, path, direction)
        order = self._orders[path]
        end = len(order) if direction == 1 else 0
        last = order[-1 if direction == 1 else 0]
        is_next = abs(order.index(last) - order.index(place)) == 1
        # The path may lead on from its last place if the gateways seen there fit a further place.
        order.insert(end, len(self._stars))
        goes_on = self._fitted(self._shown[last]) is not None
        del order[end]
        is_known = last != place and (not goes_on or (self._homing and is_next))
        return last if is_known else None, end, goes_on

    def _made(self, labels: tuple[int, ...]) -> SSHMap:
        ssh_map = super()._made(labels)
        found: dict[int, int] = {}
        for shown in self._shown.values():
            found |= allowed_headings(*self._sights(shown), self._axioms)
        dstates = tuple(replace(s, heading=found.get(s.id)) for s in ssh_map.dstates)
        return replace(ssh_map, dstates=dstates)


class MendedSketch(NamedTuple):
    """A map that was made without a search, and the trace with its faults corrected."""

    map: SSHMap
    trace: Trace


def mended_sketch(trace: Trace, theory: Theory) -> MendedSketch | None:
    """Make a map in which most steps are new dstates, with the faults that it needs.

    All views of the trace are known. Returns None if a step contradicts the sketch, and the theory
    allows no fault that mends it. The map may break axioms, so the caller has to check it.
    """
    mended = trace
    while True:
        sketch = sketches_of(mended.steps[0], theory)[-1]
        wrong = first_contradiction(sketch, mended)
        if wrong is not None:
            better = _mended(trace, mended, sketch, theory)
        else:
            ssh_map = with_faults(sketch.map(), trace, mended, theory)
            better = _without_jump(mended, ssh_map, trace, theory) if theory.jumped else None
            if better is None:
                return MendedSketch(ssh_map, mended)
        if better is None:
            return None
        mended = better


def first_contradiction(sketch: Sketch, trace: Trace) -> int | None:
    """Extend a map to the end of a trace, or return the step that contradicts it."""
    done = len(sketch.labels)
    later = each_looking(zip(trace.actions[done - 1 :], trace.steps[done:], strict=True))
    reaches_end = all(sketch.extend(action, step) for action, step in later)
    return None if reaches_end else len(sketch.labels)


def _mended(trace: Trace, mended: Trace, sketch: Sketch, theory: Theory) -> Trace | None:
    """Correct the step that contradicts a map: its view and star, or else the action before it."""
    t, steps = len(sketch.labels), list(mended.steps)
    action = mended.actions[t - 1]
    right = _right(mended, sketch, theory) if theory.misread else None
    if right is not None and steps[t] == trace.steps[t] != right:
        steps[t] = right
    elif theory.slipped and not action.unlinked:
        steps[t] = replace(trace.steps[t], action=steps[t].action)
        steps[t - 1] = replace(steps[t - 1], action=Action.that_slipped(t - 1))
    else:
        return None
    return replace(mended, steps=tuple(steps))


def _right(trace: Trace, sketch: Sketch, theory: Theory) -> Step | None:
    """Return the next step with the view and star that a map predicts; None if unknown."""
    t, action = len(sketch.labels), trace.actions[len(sketch.labels) - 1]
    there = sketch.leads_to(action)
    if there in sketch.labels:
        known = trace.steps[sketch.labels.index(there)]
        return replace(trace.steps[t], view=known.view, star=known.star)
    if action.turn is None or theory.star not in ("pattern", "frame"):
        return None
    seen, by = trace.steps[t - 1].openings or (), QUARTERS[action.turn]
    return replace(trace.steps[t], star=tuple(map(int, (*seen[by:], *seen[:by]))))


def _without_jump(mended: Trace, ssh_map: SSHMap, trace: Trace, theory: Theory) -> Trace | None:
    """Drop the longest displacement in the first loop that a map contradicts, if any."""
    refused = (v for v in violations(trace, ssh_map, theory) if v.axiom == "one_pose")
    found = next(refused, None)
    if found is None:
        return None
    steps = range(min(found.steps) + 1, max(found.steps) + 1)
    moved = {t: math.hypot(*d[:2]) for t in steps if (d := mended.steps[t].displacement)}
    if not moved:
        return None
    return mended.without_displacements_at([max(moved, key=moved.__getitem__)])
