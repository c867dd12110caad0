"""How the stars of a trace may be turned to each other: what the axioms of gateways.lp read, worked out before any map is sought.

A step sees one of few *frames*: its star, where each gateway that was not observed is there, or is not. At a place all frames have equally many slots. Slot K of a frame is slot (K+C) mod N of
an earlier one, for some *shift* C. That fixes by how much the robot has turned, up to the spreads of the bearings: a set of rotations, in whole degrees. No rotation at all means that the
two frames are not one place's, shifted so.

>>> from ssh_abduction.data.star import Star
>>> from ssh_abduction.solver.steps.frames import members, rotations
>>> junction, turned = Star.of((0, 120, 240)).frames[0], Star.of((60, 180, 300)).frames[0]
>>> [min(members(rotations(junction, turned, shift)), default=None) for shift in range(3)]
[280, 40, 160]
>>> rotations(junction, Star.of((0, 90, 180)).frames[0], 0)
0
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import lru_cache

from ssh_abduction.data.star import SPREAD, Frame, Star
from ssh_abduction.data.trace import Action, Trace

# A set of rotations is a number: its bit R says whether R degrees clockwise are in the set.
FULL = (1 << 360) - 1
# A turn right or left goes on by more degrees than this, and stops as many short of a turn around: two bearings may differ by so much and be those of one gateway.
LEAST_TURN = int(2 * SPREAD)
WAYS = {"alike": 0, "opposite": 180}  # by how many degrees the robot has turned


class Frames:
    """The frames of a trace, numbered by the first step that may see them.

    stars   for each step, the number of its star
    looks   for each star, the frames that it may be
    frames  all of them
    """

    def __init__(self, trace: Trace, stop: int | None = None) -> None:
        numbers: dict[Frame, int] = {}
        number_of: dict[Star, int] = {}
        self.stars = [
            number_of.setdefault(step.gateways or Star(()), len(number_of))
            for step in trace.steps[:stop]
        ]
        self.looks = [
            tuple(numbers.setdefault(frame, len(numbers)) for frame in star.frames)
            for star in number_of
        ]
        self.frames: tuple[Frame, ...] = tuple(numbers)

    def fits(self, x: int, y: int) -> Iterator[int]:
        """The shifts at which frame y, seen later, may be frame x."""
        first, then = self.frames[x], self.frames[y]
        if first.slots == then.slots:
            yield from (
                shift for shift in range(max(first.slots, 1)) if rotations(first, then, shift)
            )


@lru_cache(maxsize=2**16)
def rotations(first: Frame, then: Frame, shift: int) -> int:
    """The rotations by which the robot may have turned, if slot K of `then` is slot K + shift of `first`. Both have equally many slots."""
    n = first.slots
    found = FULL
    for k in range(n):
        j = (k + shift) % n
        found &= _about(first.bearings[j] - then.bearings[k], first.spreads[j] + then.spreads[k])
        a, b = first.opposite[j], then.opposite[k]
        if a is not None and b is not None and (b + shift) % n != a:
            return 0
    return found


def may_face(first: Frame, then: Frame, shift: int) -> list[str]:
    """Whether the robot may face the same way in both (alike), or the opposite way; or leave along the same path so."""
    found = rotations(first, then, shift)
    return [
        way
        for way, towards in WAYS.items()
        if found >> towards & 1 or way == _declared(first, then, shift)
    ]


def must_face(first: Frame, then: Frame, shift: int) -> list[str]:
    """Which of these ways it faces, as far as bearings can tell."""
    found = rotations(first, then, shift)
    return [
        way
        for way, towards in WAYS.items()
        if _surely(found, towards) or way == _declared(first, then, shift)
    ]


def may_turn(action: Action, first: Frame, then: Frame, shift: int) -> bool:
    """Whether a turn may lead from what is seen first to what is seen then."""
    return bool(rotations(first, then, shift) & _turned_by(action, first))


def ends(frame: Frame) -> list[str]:
    """Where no gateway leads on along the robot's path: ahead, behind. It may be off straight ahead, or straight behind, by twice its spread."""
    if _way(frame) is not None:
        return []
    near = [
        (bearing, 2 * spread) for bearing, spread in zip(frame.bearings, frame.spreads, strict=True)
    ]
    return [
        way
        for way, towards in (("ahead", 0), ("behind", 180))
        if not any(_about(*gateway) >> towards & 1 for gateway in near)
    ]


def heading(first: Frame, then: Frame, shift: int) -> int:
    """The heading in what is seen then, in whole degrees clockwise from the heading in what was seen first; 0 where bearings do not tell."""
    return middle(rotations(first, then, shift)) if first.slots == then.slots else 0


def middle(found: int) -> int:
    """The rotation in the middle of a set of rotations; 0 where it holds all rotations or none."""
    starts = [r for r in members(found) if not found >> (r - 1) % 360 & 1]
    lengths = {
        start: next(length for length in range(1, 361) if not found >> (start + length) % 360 & 1)
        for start in starts
    }
    longest = max(starts, key=lambda start: lengths[start], default=0)
    return (longest + (lengths.get(longest, 1) - 1) // 2) % 360


def members(found: int) -> list[int]:
    """The degrees in a set of rotations."""
    return [r for r in range(360) if found >> r & 1]


def _turned_by(action: Action, first: Frame) -> int:
    """The rotations that a turn may be."""
    if action.bearing is not None:
        return _about(round(action.bearing), int(SPREAD))
    if action.gateway is not None:
        slot = first.nth(action.turn, action.gateway)
        return 0 if slot is None else _about(first.bearings[slot], first.spreads[slot])
    if action.turn == "around":
        faced = next((k for k in range(first.slots) if first.faces(k)), None)
        behind = None if faced is None else first.opposite[faced]
        return 1 << 180 | (
            0 if behind is None else _about(first.bearings[behind], first.spreads[behind])
        )
    return (
        _between(LEAST_TURN + 1, 179 - LEAST_TURN)
        if action.turn == "right"
        else _between(181 + LEAST_TURN, 359 - LEAST_TURN)
    )


def _declared(first: Frame, then: Frame, shift: int) -> str | None:
    """Whether slots that are declared opposite say that the robot goes along its path in the same direction, or in the opposite one."""
    here, there = _way(first), _way(then)
    if here is None or there is None or not rotations(first, then, shift):
        return None
    ahead, behind = ((slot + shift) % first.slots for slot in there)
    return "alike" if ahead == here[0] else "opposite" if behind == here[0] else None


def _way(frame: Frame) -> tuple[int, int] | None:
    """The slots ahead and behind on the robot's path, where it faces one that has a declared opposite, or has its opposite behind it."""
    for ahead, behind in enumerate(frame.opposite):
        if behind is not None and (frame.faces(ahead) or frame.has_behind(behind)):
            return ahead, behind
    return None


def _surely(found: int, towards: int) -> bool:
    """Whether a set of rotations holds one direction, and is narrow: no gateways, or unknown ones, leave nearly all rotations, which says nothing."""
    return bool(found >> towards & 1) and not found >> 90 & 1 and not found >> 270 & 1


@lru_cache(maxsize=2**14)
def _about(degrees: int, spread: int) -> int:
    return _of((degrees + d) % 360 for d in range(-spread, spread + 1))


def _between(least: int, most: int) -> int:
    return _of(range(least, most + 1))


def _of(degrees: Iterable[int]) -> int:
    found = 0
    for r in degrees:
        found |= 1 << r
    return found
