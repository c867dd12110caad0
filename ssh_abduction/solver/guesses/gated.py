"""Builds a map step by step without a search, for places with gateways at any angles.

>>> from ssh_abduction import Theory, Trace
>>> from ssh_abduction.solver.guesses.gated import gated_map
>>> from ssh_abduction.theory.settle import settle
>>> stars = [[0, 120], [180, 300], [0, 240], [180, 300]]
>>> trace = Trace.from_steps("abcb", ["travel", "right", "travel"], stars=stars)
>>> gated_map(trace, settle(trace).theory, homing=True)
>>> stars = [[0], [180], [0], [180]]
>>> straight = Trace.from_steps("abab", ["travel", "around", "travel"], stars=stars)
>>> gated_map(straight, settle(straight).theory, homing=True).labels
(0, 1, 2, 3)

A star is the gateways, the ways out of a place, that are seen at a step. The stars seen at one
place have to fit one frame, which numbers the gateways of the place: each star is turned by some
shift so that all axioms of gateways hold.

The map grows by one step at a time. If no link says where an action leads, there are several
options. They are tried in order, and the first one that the stars of the places allow is kept:

- A turn leads to a dstate of the place with the right view, or to a new dstate.
- A travel follows the course of its dstate. If that is unknown, it follows the reverse of another
  course at the place, or a new path. It leads to a place ahead on the path, near ones first, or to
  a new place before one of these or behind all. `homing` decides whether a known place or the new
  place before it is tried first.

A star has a gateway in each direction in which a path goes on. This excludes many options. For
example, if a travel ends without a gateway ahead, it cannot end at a new place before a known one.

This is the counterpart of `guesses/tree.py`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial

from ssh_abduction.data.gateways import Sight, headings
from ssh_abduction.data.maps import DState, MapPath, SSHMap
from ssh_abduction.data.star import Star
from ssh_abduction.data.trace import Action, Step, Trace
from ssh_abduction.runtime.clock import look_at_clock
from ssh_abduction.theory.pairs import NO_PAIRS, Pairs
from ssh_abduction.theory.theory import Theory

_Seen = tuple[int, Star]  # a dstate, and a star that was seen there


def gated_map(
    trace: Trace, theory: Theory, *, homing: bool, pairs: Pairs = NO_PAIRS
) -> SSHMap | None:
    """Build a map of a trace greedily. The caller has to check it.

    Args:
        trace: The trace.
        theory: A theory with star=gateways and all defaults filled in.
        homing: Try a known place ahead before a new place on the way to it. If False, try the new
            place first.
        pairs: Pairs of steps that evidence says are one, or different.

    Returns:
        The map, in which the stars of each place agree within the tolerance of the theory. None if
        the first options lead to no map, or the theory has axioms that this does not support.
    """
    if theory.all_on_paths or theory.path_order != "total":
        return None
    growing = _Growing.of(trace.steps[0])
    axioms = frozenset(theory.axioms)
    for t, (action, step) in enumerate(zip(trace.actions, trace.steps[1:], strict=True), 1):
        # Keep the first option that evidence and the stars of the two places allow.
        for option in growing.options(action, step, homing):
            look_at_clock()
            other = growing.copy()
            here = other.labels[-1]
            there = option(other)
            other.arrive(action, there, step, t)
            places = {p for x in (here, there) if (p := other.dstates[x].place) is not None}
            allowed = pairs.allow(t, other.labels, [s.place for s in other.dstates])
            if allowed and all(other.fits(place, axioms) for place in places):
                growing = other
                break
        else:
            return None
    return growing.map(axioms)


@dataclass
class _Growing:
    """A map of the steps so far, which options extend.

    A *course* is a path and one of its directions, 1 or -1.

    Attributes:
        labels: The dstate of each step.
        dstates: All dstates, by number.
        sights: For each place, its pairs of a dstate and a star seen there, each with the first
            step that saw it.
        star: The star of the last step.
        links: For each dstate and name of an action, the dstate that it leads to.
        orders: For each path, its places in the order of direction 1.
        reverse: Pairs of dstates that a turn around links.
        sideways: Pairs of dstates that a turn right or left links.
        turns: For two pairs of a dstate and a star, the turns that lead from one to the other.
    """

    labels: list[int]
    dstates: list[DState]
    sights: list[dict[_Seen, int]]
    star: Star
    links: dict[tuple[int, str], int] = field(default_factory=dict)
    orders: list[tuple[int, ...]] = field(default_factory=list)
    reverse: list[tuple[int, int]] = field(default_factory=list)
    sideways: list[tuple[int, int]] = field(default_factory=list)
    turns: dict[tuple[_Seen, _Seen], tuple[Action, ...]] = field(default_factory=dict)

    @classmethod
    def of(cls, first: Step) -> _Growing:
        star = first.gateways or Star(())
        growing = cls([0], [], [{(0, star): 0}], star)
        growing.add(first, 0)
        return growing

    def copy(self) -> _Growing:
        return replace(
            self,
            labels=[*self.labels],
            dstates=[*self.dstates],
            sights=[*self.sights],
            links={**self.links},
            orders=[*self.orders],
            reverse=[*self.reverse],
            sideways=[*self.sideways],
            turns={**self.turns},
        )

    def options(
        self, action: Action, step: Step, homing: bool
    ) -> Iterator[Callable[[_Growing], int]]:
        """Yield the options for the next step, the preferred ones first.

        An option is a function. It is called with a copy of this map, extends the copy, and returns
        the dstate of the next step.
        """
        here = self.labels[-1]
        known = self.links.get((here, action.name))
        if known is not None:
            if self.dstates[known].view == step.view:
                yield partial(_stay, known)
        elif action.kind == "turn":
            yield from self._turning(here, action, step)
        elif action.kind == "travel":
            for course in self._courses(here):
                yield from self._travelling(here, course, step, homing)

    def _turning(
        self, here: int, action: Action, step: Step
    ) -> Iterator[Callable[[_Growing], int]]:
        s = self.dstates[here]
        around = action.turn == "around"
        for x in self.dstates:
            if x.place == s.place and x.view == step.view and self._may_turn(s, x, around):
                yield partial(_Growing.turned, here=here, there=x.id, around=around)
        yield lambda other: other.turned(here, other.add(step, s.place), around)

    @staticmethod
    def _may_turn(s: DState, x: DState, around: bool) -> bool:
        """Whether the courses of two dstates allow a turn between them."""
        if s.path is None or x.path is None or x.direction is None:
            return not around or s.id != x.id
        return (s.path, s.direction) == (x.path, -x.direction) if around else s.path != x.path

    def _courses(self, here: int) -> Iterator[tuple[int, int]]:
        """Yield the courses that a dstate may have: only its own, if that is known.

        Otherwise these are the reverses of other courses at its place, and then a new path.
        """
        s = self.dstates[here]
        if s.path is not None and s.direction is not None:
            yield s.path, s.direction
            return
        there = [
            x
            for x in self.dstates
            if x.place == s.place and x.path is not None and x.direction is not None
        ]
        # At a place, no two dstates have one course.
        taken = {(x.path, x.direction) for x in there}
        yield from (
            (x.path, -x.direction)
            for x in there
            if x.path is not None and x.direction and (x.path, -x.direction) not in taken
        )
        yield len(self.orders), 1

    def _travelling(
        self, here: int, course: tuple[int, int], step: Step, homing: bool
    ) -> Iterator[Callable[[_Growing], int]]:
        path, direction = course
        place = self.dstates[here].place
        assert place is not None
        order = self.orders[path] if path < len(self.orders) else (place,)
        ahead = (order if direction == 1 else order[::-1])[order[::direction].index(place) + 1 :]
        # Try the places ahead from near to far, and a new place before each.
        for number in range(len(ahead) + 1):
            known = [self._homing(here, course, ahead[number], step)] if number < len(ahead) else []
            new = [self._leaving(here, course, number, step)]
            for options in [*known, *new] if homing else [*new, *known]:
                yield from options

    def _homing(
        self, here: int, course: tuple[int, int], place: int, step: Step
    ) -> Iterator[Callable[[_Growing], int]]:
        """Yield options to travel to a known place ahead.

        They lead to the dstate there that has this course, if its view is right. If no dstate there
        has this course, they lead to one with the right view and no course yet, or to a new one.
        """
        there = [x for x in self.dstates if x.place == place]
        onward = [x.id for x in there if (x.path, x.direction) == course]
        shown = [
            x.id
            for x in there
            if x.view == step.view and (x.id in onward or (not onward and x.path is None))
        ]
        for x in shown:
            yield partial(_Growing.travelled, here=here, there=x, course=course)
        if not onward:
            yield lambda other: other.travelled(here, other.add(step, place), course)

    def _leaving(
        self, here: int, course: tuple[int, int], number: int, step: Step
    ) -> Iterator[Callable[[_Growing], int]]:
        """Yield the option to travel past `number` known places to a new place."""

        def leave(other: _Growing) -> int:
            place = len(other.sights)
            other.sights.append({})
            start = other.dstates[here].place
            assert start is not None
            path, direction = course
            if path == len(other.orders):
                other.orders.append((start,))
            order = list(other.orders[path])[::direction]
            order.insert(order.index(start) + 1 + number, place)
            other.orders[path] = tuple(order[::direction])
            return other.travelled(here, other.add(step, place), course)

        yield leave

    def add(self, step: Step, place: int | None) -> int:
        """Add a dstate at a place, and return its number."""
        assert step.view is not None
        self.dstates.append(DState(len(self.dstates), step.view, place=place))
        return len(self.dstates) - 1

    def turned(self, here: int, there: int, around: bool) -> int:
        """Add a turn between two dstates, and return the second one."""
        (self.reverse if around else self.sideways).append((here, there))
        if around:
            for s in (self.dstates[here], self.dstates[there]):
                if s.path is not None and s.direction is not None:
                    self._set(s.id, (s.path, s.direction))
                    self._set_reverse(s.id)
        return there

    def travelled(self, here: int, there: int, course: tuple[int, int]) -> int:
        """Add a travel between two dstates along a course, and return the second one."""
        for s in (here, there):
            self._set(s, course)
            self._set_reverse(s)
        return there

    def _set(self, s: int, course: tuple[int, int]) -> None:
        """Give a dstate its course."""
        self.dstates[s] = replace(self.dstates[s], path=course[0], direction=course[1])

    def _set_reverse(self, s: int) -> None:
        """Give the reverse course to all dstates that turns around link to this one, and so on."""
        queue = [s]
        while queue:
            here = self.dstates[queue.pop()]
            assert here.path is not None
            assert here.direction is not None
            for pair in self.reverse:
                other = next((x for x in pair if x != here.id), here.id)
                if here.id in pair and self.dstates[other].path is None:
                    self._set(other, (here.path, -here.direction))
                    queue.append(other)

    def arrive(self, action: Action, there: int, step: Step, t: int) -> None:
        """Record that the last action has led to a dstate, and the star that is seen there.

        Args:
            action: The action.
            there: The dstate that it has led to.
            step: The step there.
            t: The number of that step.
        """
        here = self.labels[-1]
        star = step.gateways or Star(())
        place = self.dstates[there].place
        assert place is not None
        self.labels.append(there)
        self.links[here, action.name] = there
        if (there, star) not in self.sights[place]:
            self.sights[place] = {**self.sights[place], (there, star): t}
        if action.kind == "turn":
            pair = (here, self.star), (there, star)
            self.turns[pair] = tuple(dict.fromkeys((*self.turns.get(pair, ()), action)))
        self.star = star

    def fits(self, place: int, axioms: frozenset[str]) -> bool:
        """Whether a place satisfies the axioms.

        No two dstates may have one course, courses have to agree with turns, and the stars have to
        fit one frame.
        """
        course = {
            s.id: None if s.path is None or s.direction is None else (s.path, s.direction)
            for s in self.dstates
            if s.place == place
        }
        # Check the courses, and whether turns agree with the courses that they link.
        known = [found for found in course.values() if found is not None]
        if len(set(known)) < len(known):
            return False
        for a, b in self.reverse:
            one, other = course.get(a), course.get(b)
            if a in course and (one and (one[0], -one[1])) != other:
                return False
        for a, b in self.sideways:
            one, other = course.get(a), course.get(b)
            if one and other and one[0] == other[0]:
                return False
        return headings(*self._seen_at(place), axioms).keys() >= course.keys()

    def _seen_at(
        self, place: int
    ) -> tuple[list[Sight], dict[tuple[Sight, Sight], tuple[Action, ...]]]:
        # A sight has flags for the first one of its dstate, and of its place.
        sights: dict[_Seen, Sight] = {}
        shown: set[int] = set()
        for (s, star), step in self.sights[place].items():
            sights[s, star] = Sight(
                self.dstates[s],
                star,
                step,
                s not in shown,
                not sights,
                self._onward(self.dstates[s]),
            )
            shown.add(s)
        turns = {
            (sights[a], sights[b]): actions
            for (a, b), actions in self.turns.items()
            if a in sights and b in sights
        }
        return list(sights.values()), turns

    def _onward(self, s: DState) -> tuple[int, ...]:
        """List the directions in which the path of a dstate goes on to another place.

        They are in degrees: 0 is ahead, 180 behind.
        """
        if s.path is None or s.place is None:
            return ()
        order = self.orders[s.path][:: s.direction]
        position = order.index(s.place)
        return tuple(
            towards
            for towards, goes_on in ((0, position + 1 < len(order)), (180, position > 0))
            if goes_on
        )

    def map(self, axioms: frozenset[str]) -> SSHMap | None:
        """Build the map, with headings that fit all stars, in degrees.

        Dstates, places and paths are numbered in the order of first visits.
        """
        facing: dict[int, int] = {}
        for place in range(len(self.sights)):
            facing |= headings(*self._seen_at(place), axioms)
        # Renumber dstates, places and paths in the order of first visits. Direction 1 of a path is
        # the one that is faced first.
        first = {s: i for i, s in enumerate(dict.fromkeys(self.labels))}
        paths: dict[int, tuple[int, int]] = {}
        places: dict[int, int] = {}
        dstates = []
        for old, new in first.items():
            s = self.dstates[old]
            assert s.place is not None
            path, faced = (
                paths.setdefault(s.path, (len(paths), s.direction or 1))
                if s.path is not None
                else (None, 1)
            )
            direction = None if s.direction is None else s.direction * faced
            dstates.append(
                replace(
                    s,
                    id=new,
                    place=places.setdefault(s.place, len(places)),
                    path=path,
                    direction=direction,
                    heading=facing.get(old),
                )
            )
        made = tuple(
            MapPath(number, tuple(places[p] for p in self.orders[path][::faced]))
            for path, (number, faced) in paths.items()
        )
        links = tuple(sorted((first[s], action, first[x]) for (s, action), x in self.links.items()))
        return SSHMap(
            tuple(first[label] for label in self.labels),
            tuple(dstates),
            links,
            tuple(places.values()),
            made,
        )


def _stay(known: int, _: _Growing) -> int:
    """Follow a known link: the option if the action has one."""
    return known
