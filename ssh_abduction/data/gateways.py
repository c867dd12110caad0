"""Fit the stars seen at each place of a map into one frame, for theories with star=gateways.

A star is all gateways (ways out of a place) seen at a step, each with a bearing. A sight is a
dstate (distinctive state: a place and a heading) with a star that is seen there. A sight numbers
its gateways; the numbers are its slots. The sights at a place see the same gateways, but a bearing
may be off, and some gateways are not observed. So `frames_that_fit` searches, at each place, for a
frame (which gateways exist) and a shift of the slots for each sight, such that all axioms hold.

The gateways of two frames match in clockwise order, by some shift of their slots. `rotations` finds
by which angles the robot may have turned between them:

>>> from ssh_abduction.data.star import Star
>>> corner = Star.of((0, 120)).frames[0]
>>> min(rotations(corner, corner, 0)), max(rotations(corner, corner, 0))
(0, 359)
>>> rotations(corner, corner, 1)
frozenset()
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations, pairwise

from ssh_abduction.data.groups import gathered
from ssh_abduction.data.maps import DState, SSHMap
from ssh_abduction.data.star import (
    CLOSED,
    MOST_CLOSED,
    ROUNDING,
    SPREAD,
    Frame,
    Star,
    angle_between,
)
from ssh_abduction.data.trace import Action, Trace
from ssh_abduction.runtime.clock import SHORT_TURN, look_at_clock

# A name beside those of axioms, for a weaker form of the axiom gateway_path: dstates of one course
# face one way, but dstates that face one way may be on different paths.
COURSE = "course"


@dataclass(frozen=True)
class Sight:
    """A dstate (a place and a heading) and a star (all gateways) seen there."""

    dstate: DState
    star: Star
    step: int  # the first step with this dstate and star, on this drive
    # Whether this is the first sight of its dstate. That sight fixes the dstate's heading.
    shows: bool
    # Whether this is the first sight at its place. That sight has heading 0.
    first: bool
    # The directions in which the dstate's path goes on, in degrees: 0 (ahead), 180 (behind), both
    # or neither.
    onward: tuple[int, ...] = ()
    drive: int = 0  # the number of the drive; 0 for all if gateways cannot change between drives


Turns = Mapping[tuple[Sight, Sight], Collection[Action]]
Turned = tuple[Frame, int]  # what a sight sees, and the shift of its slots


def with_allowed_headings(
    trace: Trace, ssh_map: SSHMap, axioms: Collection[str], changes: bool = False
) -> SSHMap | None:
    """Replace the headings of a map by headings that all stars of the trace allow.

    None if the stars (gateways seen) of some place allow none. `axioms` has the names of the
    theory's axioms, and `changes` says whether gateways may change between drives.
    """
    onward = _onward_of(trace, ssh_map, axioms)
    found = allowed_headings(*sights_of(trace, ssh_map, onward, changes), axioms)
    if any(s.place is not None and s.id not in found for s in ssh_map.dstates):
        return None
    return replace(
        ssh_map, dstates=tuple(replace(s, heading=found.get(s.id)) for s in ssh_map.dstates)
    )


def sights_of(
    trace: Trace,
    ssh_map: SSHMap,
    onward: Callable[[DState], tuple[int, ...]],
    changes: bool = False,
) -> tuple[list[Sight], dict[tuple[Sight, Sight], set[Action]]]:
    """List the sights of a map (dstates with stars), and the turns between them.

    The sights are sorted by first step. The turns are a dict. Its keys are pairs of sights at one
    place, and its values are the turns that lead from the first sight to the second. `onward`
    returns `Sight.onward` for a dstate. With `changes`, gateways may change between drives, and
    each drive has sights of its own.
    """
    states = {s.id: s for s in reversed(ssh_map.dstates)}
    sights: dict[tuple[int, Star, int], Sight] = {}
    seen: list[Sight | None] = []
    shown: set[int] = set()
    places: set[int | None] = set()
    drive = 0
    for i, (label, step) in enumerate(zip(ssh_map.dstate_at, trace.steps, strict=False)):
        s, star = states.get(label), step.gateways or Star(())
        key = label, star, drive
        if s and key not in sights:
            first = s.place not in places
            sights[key] = Sight(s, star, i, label not in shown, first, onward(s), drive)
            shown.add(label)
            places.add(s.place)
        seen.append(sights.get(key))
        drive += changes and step.action is not None and step.action.starts
    turns: dict[tuple[Sight, Sight], set[Action]] = defaultdict(set)
    for a, b, action in zip(seen, seen[1:], trace.actions, strict=False):
        if a and b and action.kind == "turn" and a.dstate.place == b.dstate.place:
            turns[a, b].add(action)
    return list(sights.values()), turns


def _onward_of(
    trace: Trace, ssh_map: SSHMap, axioms: Collection[str]
) -> Callable[[DState], tuple[int, ...]]:
    """Make a function that returns `Sight.onward` for a dstate."""
    kinds = {action.name: action.kind for action in trace.actions}
    states = {s.id: s for s in ssh_map.dstates}
    total = {"path_order_total", "on_path"} <= set(axioms)
    listed = {h.id: h.order for h in ssh_map.theory_paths} if total else {}
    # the places that travels along a path reach from a place, in each direction
    reached: dict[tuple[int, int, int], set[int]] = defaultdict(set)
    for source, name, target in ssh_map.links if "travel_orders" in axioms else ():
        s, p, q = states[source], states[source].place, states[target].place
        if kinds.get(name) != "travel" or p is None or q is None or p == q:
            continue
        if s.path is not None and s.direction is not None:
            reached[s.path, s.direction, p].add(q)
            reached[s.path, -s.direction, q].add(p)

    def goes_on(path: int, direction: int, place: int) -> bool:
        """Whether the path has a further place beyond this place, in this direction."""
        if reached[path, direction, place]:
            return True
        order = listed.get(path, ())[::direction]
        later = order[order.index(place) + 1 :] if place in order else ()
        # if a travel contradicts the order that the map lists, believe the travel
        return any(place not in reached[path, direction, q] for q in later)

    def onward(s: DState) -> tuple[int, ...]:
        if s.path is None or s.direction is None or s.place is None:
            return ()
        ways = ((0, s.direction), (180, -s.direction))
        return tuple(towards for towards, way in ways if goes_on(s.path, way, s.place))

    return onward


def allowed_headings(
    sights: Sequence[Sight], turns: Turns, axioms: Collection[str]
) -> dict[int, int]:
    """Find headings of dstates, in degrees, that the stars (gateways seen) allow.

    The sights are sorted by first step. Headings that the dstates already have are ignored. The
    result lacks the dstates of places that no frame fits.
    """
    found: dict[int, int] = {}
    for seen in by_place(sights).values():
        fitted = frames_that_fit(seen, turns, axioms, as_shown=False)
        for sight, (frame, shift) in zip(seen, fitted, strict=True) if fitted else ():
            if fitted and sight.shows:
                found[sight.dstate.id] = middle(rotations(fitted[0][0], frame, shift))
    return found


@dataclass(frozen=True)
class Facing:
    """How the dstates of a map face in the frames of their places."""

    headings: dict[int, int]  # for each dstate, its heading, if it is known
    opposite: list[tuple[int, int]]  # pairs of dstates at one place that face opposite ways
    # Pairs of a dstate and a direction, 0 (ahead) or 180 (behind), in which no gateway leads on.
    ends: list[tuple[int, int]]


def facing(
    trace: Trace, ssh_map: SSHMap, axioms: Collection[str], changes: bool = False
) -> Facing | None:
    """Find which way the dstates of a map face, from the stars (gateways seen).

    Paths of the map may still be merged. None if no frame fits the stars of some place. The
    headings of the map are ignored. `axioms` and `changes` are as in `with_allowed_headings`.
    """
    sights, turns = sights_of(trace, ssh_map, lambda s: (), changes)
    found = Facing({}, [], [])
    held = {COURSE, *axioms} - {"gateway_end"}
    for seen in by_place(sights).values():
        fitted = frames_that_fit(seen, turns, held, as_shown=False)
        if fitted is None:
            return None
        for sight in seen:
            s = sight.dstate.id
            found.ends.extend(
                (s, towards)
                for towards in (0, 180)
                if not changes and not any(leads(frame, towards) for frame in sight.star.frames)
            )
        found.opposite.extend(
            (one.dstate.id, other.dstate.id)
            for (one, before), (other, after) in combinations(zip(seen, fitted, strict=True), 2)
            if are_opposite(before, after)
        )
    return found


def are_opposite(seen_a: Turned, seen_b: Turned) -> bool:
    """Whether the robot surely faces opposite ways in two sights of a place.

    The sights (dstate and star) have the frames and shifts that `frames_that_fit` found.
    """
    (first, back), (then, on) = seen_a, seen_b
    shift = (on - back) % max(first.slots, 1)
    found = rotations(first, then, shift)
    return ways(first, then, shift, found)[1] and not found & {90, 270}


def by_place(sights: Sequence[Sight]) -> dict[int, list[Sight]]:
    """Group sights by place: return a dict from places to lists of sights."""
    return gathered(
        (sight.dstate.place, sight) for sight in sights if sight.dstate.place is not None
    )


def frames_that_fit(
    sights: Sequence[Sight], turns: Turns, axioms: Collection[str], as_shown: bool = True
) -> list[Turned] | None:
    """Find a frame and a shift for each sight at a place so that all pairs satisfy the axioms.

    Of several solutions, return one with the fewest gateways that change between drives; None
    if nothing fits. A frame says which gateways exist. A shift says how many slots to add, so
    that gateways have the same slots as in the first sight. With `as_shown`, the headings of the
    dstates must fit, too.
    """
    place, order = sights[0].dstate.place if sights else None, {s: k for k, s in enumerate(sights)}
    found_turns = [
        (order[a], order[b], a, b, frozenset(actions))
        for (a, b), actions in turns.items()
        if a.dstate.place == place and a in order and b in order
    ]
    made = tuple((a, b, actions) for *_, a, b, actions in sorted(found_turns, key=lambda t: t[:2]))
    headings = tuple(sight.dstate.heading for sight in sights) if as_shown else None
    for most in range(MOST_CLOSED * max(len({sight.drive for sight in sights}) - 1, 0) + 1):
        found = _fitted(tuple(sights), headings, made, frozenset(axioms), most)
        if found is not None:
            return list(found)
    return None


@lru_cache(maxsize=2**12)
def _fitted(
    sights: tuple[Sight, ...],
    headings: tuple[int | None, ...] | None,
    made: tuple[tuple[Sight, Sight, frozenset[Action]], ...],
    axioms: frozenset[str],
    most: int,
) -> tuple[Turned, ...] | None:
    """Fit frames and shifts as `frames_that_fit` does, with a cache.

    Maps of growing prefixes have many places in common. Dstates that differ only in their heading
    count as equal in the cache, so `headings` is an argument of its own.
    `made` has pairs of these sights, and the turns that lead from the first to the second.
    """
    turns = {(a, b): actions for a, b, actions in made}

    def extended(
        chosen: list[Turned], closed: dict[int, frozenset[int]]
    ) -> tuple[Turned, ...] | None:
        """Choose frames and shifts for the sights after the first `chosen`; None if none fit."""
        if len(chosen) == len(sights):
            return tuple(chosen)
        sight = sights[len(chosen)]
        for here in _readings(sight, axioms, most, turned=bool(chosen)):
            look_at_clock(SHORT_TURN)
            on_drives = {**closed, sight.drive: _closed(here)} if most else closed
            # The steps of a drive see the same gateways.
            if most and (
                closed.get(sight.drive, on_drives[sight.drive]) != on_drives[sight.drive]
                or _changes(on_drives) > most
            ):
                continue
            before = zip([*sights[: len(chosen)], sight], [*chosen, here], strict=True)
            if all(
                _allowed(other, turned, sight, here, turns, axioms, headings is not None)
                for other, turned in before
            ):
                read = extended([*chosen, here], on_drives)
                if read is not None:
                    return read
        return None

    return extended([], {})


def _readings(
    sight: Sight, axioms: Collection[str], most: int, *, turned: bool
) -> Iterator[Turned]:
    """Yield the frames that a sight may have, in all shifts of its slots if it may be `turned`."""
    for frame in _frames(sight.star, most):
        if "gateway_end" not in axioms or all(leads(frame, way) for way in sight.onward):
            # only shifts relative to the first sight matter
            yield from ((frame, shift) for shift in range(max(frame.slots, 1) if turned else 1))


@lru_cache(maxsize=2**12)
def _frames(star: Star, most: int) -> tuple[Frame, ...]:
    """The frames of a star, also with up to `most` gateways that only other drives saw open."""
    if not most:
        return star.frames
    every = (wider for frame in star.frames for wider in frame.with_closed)
    few = [frame for frame in every if frame.spreads.count(CLOSED) <= most]
    return tuple(sorted(few, key=lambda frame: frame.spreads.count(CLOSED)))


def _closed(read: Turned) -> frozenset[int]:
    """The gateways that are closed, by their slots in the first sight of the place."""
    frame, shift = read
    return frozenset((k + shift) % frame.slots for k in range(frame.slots) if frame.is_closed(k))


def _changes(closed: Mapping[int, frozenset[int]]) -> float:
    """Count how often gateways open or close from each drive to the next; inf if too often."""
    counts = [len(a ^ b) for a, b in pairwise([closed[drive] for drive in sorted(closed)])]
    return sum(counts) if max(counts, default=0) <= MOST_CLOSED else math.inf


@dataclass(frozen=True)
class GatewayChange:
    """A gateway that is open on one drive and closed on the one that came there before or after."""

    place: int
    bearing: int  # its direction in degrees, clockwise from the heading of the first dstate there
    step: int  # the first step of the later drive there
    drives: tuple[int, int]  # the numbers of the earlier drive and of the later one
    is_open: bool  # whether it is open on the later drive


def changes_in(trace: Trace, ssh_map: SSHMap, axioms: Collection[str]) -> Iterator[GatewayChange]:
    """Yield the gateways that change between drives, for a map with headings."""
    onward = _onward_of(trace, ssh_map, axioms)
    yield from changes_of(*sights_of(trace, ssh_map, onward, changes=True), axioms)


def changes_of(
    sights: Sequence[Sight], turns: Turns, axioms: Collection[str]
) -> Iterator[GatewayChange]:
    """Yield the gateways that change between drives, by the headings of the sights' dstates."""
    for place, seen in by_place(sights).items():
        fitted = frames_that_fit(seen, turns, axioms) or []
        first_of = {s.drive: k for k, s in reversed([*enumerate(seen)])}
        bearing: dict[int, int] = {}
        for frame, shift in fitted:
            turn = middle(rotations(fitted[0][0], frame, shift))
            for k in range(frame.slots):
                if not frame.is_closed(k):
                    at = round(frame.bearings[k] + turn) % 360
                    bearing.setdefault((k + shift) % frame.slots, at)
        for a, b in pairwise(sorted(first_of) if fitted else ()):
            was, now = (_closed(fitted[first_of[drive]]) for drive in (a, b))
            for slot in sorted(was ^ now):
                step = seen[first_of[b]].step
                yield GatewayChange(place, bearing[slot], step, (a, b), slot in was)


def _allowed(
    a: Sight,
    seen_a: Turned,
    b: Sight,
    seen_b: Turned,
    turns: Turns,
    axioms: Collection[str],
    as_shown: bool,
) -> bool:
    """Whether the axioms allow frames and shifts for two sights at one place, the earlier first."""
    (first, back), (then, on) = seen_a, seen_b
    shift = (on - back) % max(first.slots, 1)
    found = rotations(first, then, shift)
    if "gateway_frame" in axioms and not found:
        return False
    if "gateway_turn" in axioms and not (
        all(turns_so(action, first, found) for action in turns.get((a, b), ()))
        and all(
            turns_so(action, then, frozenset(-r % 360 for r in found))
            for action in turns.get((b, a), ())
        )
    ):
        return False
    alike, opposite = ways(first, then, shift, found)
    sure = not found & {90, 270}  # if it may have turned by a right angle, its way is uncertain
    s, x = a.dstate, b.dstate
    if "gateway_heading" in axioms:
        if s.id == x.id and not alike:
            return False
        if as_shown and a.first and b.shows and x.heading not in (found or range(360)):
            return False
    if "gateway_dstate" in axioms and s.id != x.id and alike and (sure or 0 not in found):
        return False
    if {"gateway_path", COURSE} & set(axioms) and s.path is not None and x.path is not None:
        same = s.path == x.path and s.direction == x.direction
        reverse = s.path == x.path and s.direction != x.direction
        for way, on_course, towards in ((alike, same, 0), (opposite, reverse, 180)):
            off_course = COURSE not in axioms and way and not on_course
            if (on_course and not way) or (off_course and (sure or towards not in found)):
                return False
    return True


@lru_cache(maxsize=2**14)
def rotations(first: Frame, then: Frame, shift: int) -> frozenset[int]:
    """Find by which angles the robot may have turned between two sights (gateways) of a place.

    Gateway k of `then` is taken to be gateway k + shift of `first`. The angles are whole
    degrees clockwise; empty if the gateways do not match.
    """
    n = first.slots
    if then.slots != n:
        return frozenset()
    pairs = [((k + shift) % n, k) for k in range(n)]
    for j, k in pairs:
        a, b = first.opposite[j], then.opposite[k]
        if a is not None and b is not None and (a, b) not in pairs:
            return frozenset()
    found: Collection[int] = range(360)
    for j, k in pairs:
        centre, most = first.bearings[j] - then.bearings[k], first.spreads[j] + then.spreads[k]
        found = arc(centre, most).intersection(found)
        if not found:
            break
    return frozenset(found)


@lru_cache(maxsize=2**14)
def arc(centre: float, most: float) -> frozenset[int]:
    """List the whole degrees from 0 to 359 that differ by at most `most` from `centre`."""
    least, last = centre - most + ROUNDING, centre + most - ROUNDING
    return frozenset(angle % 360 for angle in range(math.floor(least), math.ceil(last) + 1))


def turns_so(action: Action, before: Frame, found: frozenset[int]) -> bool:
    """Whether the angle of a turn may be one of `found`, in degrees clockwise.

    `before` has the gateways that the robot saw before the turn.
    """
    # the bearing or the gateway of a turn is more precise than right, left and around
    if action.bearing is not None:
        return any(angle_between(r, round(action.bearing)) <= SPREAD for r in found)
    if action.gateway is not None:
        slot = before.nth(action.turn, action.gateway)
        return slot is not None and bool(found & arc(before.bearings[slot], before.spreads[slot]))
    if action.turn == "around":
        behind = (k for slot, k in enumerate(before.opposite) if before.faces(slot))
        gateways = [(before.bearings[k], before.spreads[k]) for k in behind if k is not None]
        return any(found & arc(*gateway) for gateway in [(180, 0), *gateways[:1]])
    sides = (r if action.turn == "right" else 360 - r for r in found)
    return any(2 * SPREAD < side < 180 - 2 * SPREAD for side in sides)


@lru_cache(maxsize=2**14)
def ways(first: Frame, then: Frame, shift: int, found: frozenset[int]) -> tuple[bool, bool]:
    """Return two flags: may the robot face the same way in both sights, and opposite ways?

    The flags are true if the robot may have turned by 0, or by 180, degrees (`found` has all
    possible turns). Gateways that are declared opposite are on one path, which may bend. So the
    first flag is also true if the robot faces the same one of them in both sights, and the second
    flag if it faces the other one. Gateway k of `then` is k + shift of `first`.
    """
    alike, opposite = (
        bool(found)
        and all(
            angle_between(first.bearings[(k + shift) % first.slots] - towards, bearing)
            <= first.spreads[(k + shift) % first.slots] + spread + ROUNDING
            for k, (bearing, spread) in enumerate(zip(then.bearings, then.spreads, strict=True))
        )
        for towards in (0, 180)
    )
    here, there = passes(first), passes(then)
    if found and here and there:
        ahead, behind = ((k + shift) % first.slots for k in there)
        if ahead == here[0]:
            alike = True
        elif behind == here[0]:
            opposite = True
    return alike, opposite


def leads(frame: Frame, towards: int) -> bool:
    """Whether the robot's path may go on through a gateway ahead (`towards` 0) or behind (180)."""
    return passes(frame) is not None or any(
        angle_between(bearing, towards) <= 2 * spread + ROUNDING
        for bearing, spread in zip(frame.bearings, frame.spreads, strict=True)
    )


@lru_cache(maxsize=2**12)
def passes(frame: Frame) -> tuple[int, int] | None:
    """Return the slots of two gateways that are declared opposite, one ahead and one behind.

    The robot must face the first one, or have the second one straight behind it. None if there is
    no such pair.
    """
    for k, other in enumerate(frame.opposite):
        if other is not None and (frame.faces(k) or frame.has_behind(other)):
            return k, other
    return None


def middle(found: Collection[int]) -> int:
    """Return the middle of the longest arc in a set of rotations, in whole degrees.

    It is 0 if the set contains all rotations or none.
    """
    starts = [r for r in sorted(found) if (r - 1) % 360 not in found]
    ends = [next(d for d in range(1, 361) if (r + d) % 360 not in found) for r in starts]
    length, start = max(zip(ends, [-r for r in starts], strict=True), default=(1, 0))
    return (-start + (length - 1) // 2) % 360
