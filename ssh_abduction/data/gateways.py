"""Whether the stars seen at the places of a map can be those of one place each, where places have any number of gateways (star=gateways).

>>> from ssh_abduction.data.gateways import rotations
>>> from ssh_abduction.data.star import Star
>>> corner = Star.of((0, 120)).frames[0]
>>> min(rotations(corner, corner, 0)), max(rotations(corner, corner, 0)), rotations(corner, corner, 1)
(0, 359, frozenset())

A map shows for each dstate how it is turned, in degrees. Which gateway seen at one step is which one seen at another follows from that, but in tolerance only, and not where gateways were not
observed. So this seeks, for each place, a frame and a shift of its slots for each sight, such that all axioms hold. A *sight* is a dstate together with a star seen there.
Where there is none, a smallest set of sights without any is reported, under each axiom that has to be dropped to mend it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

from ssh_abduction.data.clock import look_at_clock
from ssh_abduction.data.maps import DState
from ssh_abduction.data.star import SPREAD, Frame, Star
from ssh_abduction.data.trace import Action

AXIOMS = (
    "gateway_frame",
    "gateway_heading",
    "gateway_turn",
    "gateway_dstate",
    "gateway_path",
    "gateway_end",
)


@dataclass(frozen=True)
class Sight:
    """A dstate, a star that is seen there, and the first step that sees it.

    shows  whether the heading of the dstate is that of this sight: the first one there
    first  whether it is the first sight at its place, from whose heading all others there are counted
    onward  degrees, clockwise from ahead, at which the path of the dstate goes on to another place: 0, 180
    """

    dstate: DState
    star: Star
    step: int
    shows: bool
    first: bool
    onward: tuple[int, ...] = ()


@dataclass(frozen=True)
class Clash:
    """Sights at a place that cannot all be of one place: their steps, and the axioms each of which forbids them."""

    place: int
    steps: tuple[int, ...]
    axioms: tuple[str, ...]


Turns = Mapping[tuple[Sight, Sight], Collection[Action]]
_Turned = tuple[Frame, int]  # what a sight sees, and how far its slots are shifted


def clashes(sights: Sequence[Sight], turns: Turns, axioms: Collection[str]) -> Iterator[Clash]:
    """What is wrong at each place.

    sights  by the step that first has them
    turns   the turns that lead from one sight to another
    axioms  those that hold
    """
    hard = [name for name in AXIOMS if name in axioms]
    for place, seen in _by_place(sights).items():
        if _reading(seen, turns, hard) is not None:
            continue
        core = list(seen)
        for sight in reversed(seen):
            rest = [other for other in core if other is not sight]
            core = core if _reading(rest, turns, hard) is not None else rest
        to_blame = [
            name
            for name in hard
            if _reading(core, turns, [other for other in hard if other != name]) is not None
        ]
        yield Clash(place, tuple(sight.step for sight in core), tuple(to_blame or hard))


def headings(sights: Sequence[Sight], turns: Turns, axioms: Collection[str]) -> dict[int, int]:
    """A heading of each dstate that the stars seen at its place allow, whatever headings the dstates show. Dstates at a place that cannot be are left out."""
    found: dict[int, int] = {}
    for seen in _by_place(sights).values():
        read = _reading(seen, turns, axioms, as_shown=False)
        for sight, (frame, shift) in zip(seen, read, strict=True) if read else ():
            if read and sight.shows:
                found[sight.dstate.id] = _middle(rotations(read[0][0], frame, shift))
    return found


def _by_place(sights: Sequence[Sight]) -> dict[int, list[Sight]]:
    there: dict[int, list[Sight]] = {}
    for sight in sights:
        if sight.dstate.place is not None:
            there.setdefault(sight.dstate.place, []).append(sight)
    return there


def _reading(
    sights: Sequence[Sight], turns: Turns, axioms: Collection[str], as_shown: bool = True
) -> list[_Turned] | None:
    """A frame and a shift for each sight such that all pairs of sights satisfy the axioms, or None.

    as_shown  whether the headings have to be those that the dstates show
    """

    def extended(chosen: list[_Turned]) -> list[_Turned] | None:
        if len(chosen) == len(sights):
            return chosen
        sight = sights[len(chosen)]
        for frame in sight.star.frames:
            if "gateway_end" in axioms and not all(
                _leads(frame, towards) for towards in sight.onward
            ):
                continue
            for shift in range(max(frame.slots, 1)) if chosen else (0,):
                look_at_clock()
                here = (frame, shift)
                before = zip([*sights[: len(chosen)], sight], [*chosen, here], strict=True)
                if all(
                    _allowed(other, turned, sight, here, turns, axioms, as_shown)
                    for other, turned in before
                ):
                    read = extended([*chosen, here])
                    if read is not None:
                        return read
        return None

    return extended([])


def _middle(found: Collection[int]) -> int:
    """A rotation in the middle of an arc of rotations; 0 where there are all or none."""
    starts = [r for r in sorted(found) if (r - 1) % 360 not in found]
    ends = [next(d for d in range(1, 361) if (r + d) % 360 not in found) for r in starts]
    length, start = max(zip(ends, [-r for r in starts], strict=True), default=(1, 0))
    return (-start + (length - 1) // 2) % 360


def _allowed(
    a: Sight,
    seen_a: _Turned,
    b: Sight,
    seen_b: _Turned,
    turns: Turns,
    axioms: Collection[str],
    as_shown: bool,
) -> bool:
    """Whether the axioms allow two sights at one place, the first of which comes first, to see so."""
    (first, back), (then, on) = seen_a, seen_b
    shift = (on - back) % max(first.slots, 1)
    found = rotations(first, then, shift)
    if "gateway_frame" in axioms and not found:
        return False
    if "gateway_turn" in axioms and not (
        all(_turns_so(action, first, found) for action in turns.get((a, b), ()))
        and all(
            _turns_so(action, then, frozenset(-r % 360 for r in found))
            for action in turns.get((b, a), ())
        )
    ):
        return False
    alike, opposite = _ways(first, then, shift, found)
    sure = not found & {90, 270}
    s, x = a.dstate, b.dstate
    if "gateway_heading" in axioms and s.id == x.id and not alike:
        return False
    if (
        "gateway_heading" in axioms
        and as_shown
        and a.first
        and b.shows
        and not _is_shown(x.heading, found)
    ):
        return False
    if "gateway_dstate" in axioms and s.id != x.id and alike and (sure or 0 not in found):
        return False
    if "gateway_path" in axioms and s.path is not None and x.path is not None:
        same, reverse = (
            s.path == x.path and s.direction == x.direction,
            s.path == x.path and s.direction != x.direction,
        )
        for way, on_course, towards in ((alike, same, 0), (opposite, reverse, 180)):
            if (on_course and not way) or (
                way and not on_course and (sure or towards not in found)
            ):
                return False
    return True


def _is_shown(heading: int | None, found: Collection[int]) -> bool:
    """Whether a dstate shows a heading, and one that the bearings allow."""
    return heading is not None and 0 <= heading < 360 and (heading in found or not found)


@lru_cache(maxsize=2**14)
def rotations(first: Frame, then: Frame, shift: int) -> frozenset[int]:
    """By how many degrees the robot may have turned, if gateway K of `then` is gateway K + shift of `first`; empty if they cannot be so."""
    n = first.slots
    if then.slots != n:
        return frozenset()
    pairs = [((k + shift) % n, k) for k in range(n)]
    for j, k in pairs:
        a, b = first.opposite[j], then.opposite[k]
        if a is not None and b is not None and (a, b) not in pairs:
            return frozenset()
    return frozenset(
        r
        for r in range(360)
        if all(
            _between(first.bearings[j], then.bearings[k] + r) <= first.spreads[j] + then.spreads[k]
            for j, k in pairs
        )
    )


def may_show_the_same(one: Star, other: Star) -> bool:
    """Whether two stars may show the same gateways to a robot that has not turned: some pairs in tolerance take in all that are seen in either."""
    import numpy as np
    from scipy.optimize import linear_sum_assignment

    bearings, spreads, seen = (
        [np.array([getattr(g, name) for g in star.gateways], dtype=float) for star in (one, other)]
        for name in ("bearing", "spread", "open")
    )
    seen = [np.nan_to_num(row) for row in seen]  # None, which is not observed, is 0
    off = np.abs((bearings[0][:, None] - bearings[1] + 180) % 360 - 180)
    near = off <= spreads[0][:, None] + spreads[1]
    taken_in = np.where(near, seen[0][:, None] + seen[1], 0)
    return bool(
        taken_in[linear_sum_assignment(taken_in, maximize=True)].sum()
        == sum(row.sum() for row in seen)
    )


def _between(a: float, b: float) -> float:
    """The angle between two bearings, 0 to 180 degrees."""
    return min((a - b) % 360, (b - a) % 360)


def _turns_so(action: Action, before: Frame, found: frozenset[int]) -> bool:
    """Whether one of these rotations is what a turn does."""
    if action.bearing is not None:
        return any(_between(r, round(action.bearing)) <= SPREAD for r in found)
    if action.gateway is not None:
        beside = [
            (bearing, spread)
            for bearing, spread in zip(before.bearings, before.spreads, strict=True)
            if _between(bearing, 0) > spread
        ]
        if action.turn == "left":
            beside.reverse()
        return action.gateway <= len(beside) and any(
            _between(r, beside[action.gateway - 1][0]) <= beside[action.gateway - 1][1]
            for r in found
        )
    if action.turn == "around":
        behind = [
            (before.bearings[other], before.spreads[other])
            for bearing, spread, other in zip(
                before.bearings, before.spreads, before.opposite, strict=True
            )
            if other is not None and _between(bearing, 0) <= spread
        ][:1]
        return any(
            _between(r, bearing) <= spread for r in found for bearing, spread in [(180, 0), *behind]
        )
    sides = (r if action.turn == "right" else 360 - r for r in found)
    return any(2 * SPREAD < side < 180 - 2 * SPREAD for side in sides)


def _ways(first: Frame, then: Frame, shift: int, found: frozenset[int]) -> tuple[bool, bool]:
    """Whether the robot may face the same way in both, and the opposite way; or go along one path so, by gateways that are declared opposite."""
    alike, opposite = 0 in found, 180 in found
    here, there = _passes(first), _passes(then)
    if found and here and there:
        ahead, behind = ((k + shift) % first.slots for k in there)
        if ahead == here[0]:
            alike = True
        elif behind == here[0]:
            opposite = True
    return alike, opposite


def _leads(frame: Frame, towards: int) -> bool:
    """Whether some gateway may be that of the robot's path, ahead (0) or behind (180)."""
    return _passes(frame) is not None or any(
        _between(bearing, towards) <= 2 * spread
        for bearing, spread in zip(frame.bearings, frame.spreads, strict=True)
    )


def _passes(frame: Frame) -> tuple[int, int] | None:
    """The gateways ahead and behind on a path that bends, if the robot faces one of them, or came through the other."""
    for k, (bearing, spread, other) in enumerate(
        zip(frame.bearings, frame.spreads, frame.opposite, strict=True)
    ):
        if other is not None and (
            _between(bearing, 0) <= spread
            or _between(frame.bearings[other], 180) <= frame.spreads[other]
        ):
            return k, other
    return None
