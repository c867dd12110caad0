"""How the stars of a trace fit each other when turned: the input of gateways.lp.

A star is the gateways that a step sees. A *frame* is a star in which each unobserved gateway has
been decided to exist or not. All frames at a place have the same number N of slots. Slot K of a
frame is slot (K+C) mod N of an earlier frame, for some *shift* C. The shift and the spreads of the
bearings limit how far the robot has turned: a set of rotations in whole degrees. If the set is
empty, the two frames are not seen at one place with this shift.

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

# A set of rotations is an integer: bit R is 1 if R degrees clockwise are in the set.
FULL = (1 << 360) - 1
# The least degrees of a turn right or left, and by how much it has to fall short of a turn around:
# bearings that differ by less may belong to one gateway.
LEAST_TURN = int(2 * SPREAD)
WAYS = {"alike": 0, "opposite": 180}  # the rotation of each way, in degrees


class Frames:
    """The frames of a trace, numbered by the first step that may see them.

    Attributes:
        stars: The number of the star of each step.
        looks: The frames that each star may be.
        frames: All frames.
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
        """The shifts with which frame y, seen later, may be frame x."""
        first, then = self.frames[x], self.frames[y]
        if first.slots == then.slots:
            yield from (
                shift for shift in range(max(first.slots, 1)) if rotations(first, then, shift)
            )


@lru_cache(maxsize=2**16)
def rotations(first: Frame, then: Frame, shift: int) -> int:
    """The rotations by which the robot may have turned between two frames.

    Args:
        first: The earlier frame.
        then: The later frame, with as many slots.
        shift: Slot K of `then` is slot K + shift of `first`.

    Returns:
        A set of rotations.
    """
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
    """The ways that the robot may face in the later frame: alike, opposite, or both.

    It may also leave along the same path in this direction.
    """
    found = rotations(first, then, shift)
    return [
        way
        for way, towards in WAYS.items()
        if found >> towards & 1 or way == _declared(first, then, shift)
    ]


def must_face(first: Frame, then: Frame, shift: int) -> list[str]:
    """The ways that the robot has to face in the later frame, by bearings."""
    found = rotations(first, then, shift)
    return [
        way
        for way, towards in WAYS.items()
        if _surely(found, towards) or way == _declared(first, then, shift)
    ]


def may_turn(action: Action, first: Frame, then: Frame, shift: int) -> bool:
    """Whether a turn may lead from one frame to the other."""
    return bool(rotations(first, then, shift) & _turned_by(action, first))


def ends(frame: Frame) -> list[str]:
    """The directions in which no gateway continues the robot's path: ahead, behind.

    A gateway continues the path if it is straight ahead, or behind, within twice its spread.
    """
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
    """The heading in the later frame, in whole degrees clockwise from the heading in the first.

    0 if bearings leave it open.
    """
    return middle(rotations(first, then, shift)) if first.slots == then.slots else 0


def middle(found: int) -> int:
    """The middle of the longest interval of a set of rotations; 0 if the set is full or empty."""
    starts = [r for r in members(found) if not found >> (r - 1) % 360 & 1]
    lengths = {
        start: next(length for length in range(1, 361) if not found >> (start + length) % 360 & 1)
        for start in starts
    }
    longest = max(starts, key=lambda start: lengths[start], default=0)
    return (longest + (lengths.get(longest, 1) - 1) // 2) % 360


def members(found: int) -> list[int]:
    """The rotations in a set, in degrees."""
    return [r for r in range(360) if found >> r & 1]


def _turned_by(action: Action, first: Frame) -> int:
    """The rotations that a turn may make, from a frame."""
    if action.bearing is not None:
        return _about(round(action.bearing), int(SPREAD))
    if action.gateway is not None:
        slot = first.nth(action.turn, action.gateway)
        return 0 if slot is None else _about(first.bearings[slot], first.spreads[slot])
    if action.turn == "around":
        # A half turn, or the turn to the slot declared opposite to the one that the robot faces.
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
    """The direction along the robot's path in the later frame, by slots declared opposite.

    "alike", "opposite", or None if these leave it open.
    """
    here, there = _way(first), _way(then)
    if here is None or there is None or not rotations(first, then, shift):
        return None
    ahead, behind = ((slot + shift) % first.slots for slot in there)
    return "alike" if ahead == here[0] else "opposite" if behind == here[0] else None


def _way(frame: Frame) -> tuple[int, int] | None:
    """The slots ahead and behind on the robot's path, if it leads through declared opposites."""
    for ahead, behind in enumerate(frame.opposite):
        if behind is not None and (frame.faces(ahead) or frame.has_behind(behind)):
            return ahead, behind
    return None


def _surely(found: int, towards: int) -> bool:
    """Whether a set of rotations is narrow and contains this direction.

    Stars without known gateways leave nearly all rotations open.
    """
    return bool(found >> towards & 1) and not found >> 90 & 1 and not found >> 270 & 1


@lru_cache(maxsize=2**14)
def _about(degrees: int, spread: int) -> int:
    """The rotations within a spread of some degrees."""
    return _of((degrees + d) % 360 for d in range(-spread, spread + 1))


def _between(least: int, most: int) -> int:
    """The rotations in a closed interval of degrees."""
    return _of(range(least, most + 1))


def _of(degrees: Iterable[int]) -> int:
    """The set of these rotations."""
    found = 0
    for r in degrees:
        found |= 1 << r
    return found
