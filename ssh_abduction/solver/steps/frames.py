"""Find how the stars of a trace fit each other when they are turned. gateways.lp reads this.

A star is the gateways that are seen at a step. For some directions it may be unknown whether there
is a gateway. A *frame* is a star after this is decided. The gateways of a frame are numbered
clockwise; these numbers are its *slots*. All frames at a place have the same number N of slots.
Slot K of a frame is slot (K+C) mod N of an earlier frame, for some *shift* C. A gateway is seen at
some bearing, which may be off by a spread in degrees. So each shift allows only some rotations of
the robot between the two frames. Rotations are whole degrees clockwise. The ends of a set of them
are rounded outwards. If it is empty, the two frames are not seen at one place with this shift.

>>> from ssh_abduction.data.star import Star
>>> from ssh_abduction.solver.steps.frames import members, rotation_bits
>>> junction, turned = Star.of((0, 120, 240)).frames[0], Star.of((60, 180, 300)).frames[0]
>>> [min(members(rotation_bits(junction, turned, shift)), default=None) for shift in range(3)]
[280, 40, 160]
>>> rotation_bits(junction, Star.of((0, 90, 180)).frames[0], 0)
0
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import lru_cache
from math import ceil, floor

from ssh_abduction.data.star import ROUNDING, SPREAD, Frame, Star
from ssh_abduction.data.trace import Action, Trace

# A set of rotations is an integer: bit R is 1 if R degrees clockwise are in the set.
FULL = (1 << 360) - 1
# A turn right or left differs by more than this many degrees from no turn, and from a turn around.
# Bearings that differ by less may belong to one gateway.
LEAST_TURN = int(2 * SPREAD)
WAYS = {"alike": 0, "opposite": 180}  # the rotation of each way, in degrees


class Frames:
    """The stars and frames of a trace, numbered in the order of the first steps that see them.

    Only the first `stop` steps are used; None for all. With `changes`, gateways may change between
    drives. Then a star has more frames, with gateways that are closed on its drive.

    Attributes:
        stars: The number of the star of each step.
        looks: For each star, the numbers of its possible frames.
        frames: All frames, by number.
    """

    def __init__(self, trace: Trace, stop: int | None = None, *, changes: bool = False) -> None:
        numbers: dict[Frame, int] = {}
        number_of: dict[Star, int] = {}
        self.stars = [
            number_of.setdefault(step.gateways or Star(()), len(number_of))
            for step in trace.steps[:stop]
        ]
        self.looks = [
            tuple(
                numbers.setdefault(frame, len(numbers))
                for plain in star.frames
                for frame in (plain.with_closed if changes else (plain,))
            )
            for star in number_of
        ]
        self.frames: tuple[Frame, ...] = tuple(numbers)

    def fits(self, x: int, y: int) -> Iterator[int]:
        """Yield the shifts with which frames x and y may be at one place; y is the later one."""
        first, then = self.frames[x], self.frames[y]
        if first.slots == then.slots:
            yield from (
                shift for shift in range(max(first.slots, 1)) if rotation_bits(first, then, shift)
            )


@lru_cache(maxsize=2**16)
def rotation_bits(first: Frame, then: Frame, shift: int) -> int:
    """Find the rotations by which the robot may have turned between two frames at one place.

    The frames have the same number of slots, and slot K of `then` is slot K + shift of `first`. In
    the set of rotations, an integer, bit R is 1 if R degrees clockwise are in the set.
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
    """List how the robot may face in the later frame, compared to the earlier one.

    Slots that the trace declares opposite belong to one path, at any angle. If the robot faces the
    same direction of such a path in both frames, it may face the same way ("alike"). If it faces
    opposite directions of it, it may face the opposite way ("opposite"). Arguments are as for
    `rotation_bits`.
    """
    return _ways(first, then, shift, bool(rotation_bits(first, then, shift)))


def must_face(first: Frame, then: Frame, shift: int) -> list[str]:
    """Return the way that the robot has to face, as in `may_face`: a list of at most one.

    Bearings decide only if the set of rotations contains neither 90 nor 270 degrees. Stars without
    known gateways allow nearly all rotations, so that no direction is sure.
    """
    found = rotation_bits(first, then, shift)
    is_sure = bool(found) and not found >> 90 & 1 and not found >> 270 & 1
    return _ways(first, then, shift, is_sure)


def _ways(first: Frame, then: Frame, shift: int, by_bearings: bool) -> list[str]:
    """List the ways to face that slots declared opposite give, or bearings, if these may decide."""
    declared = _declared(first, then, shift)
    return [
        way
        for way, towards in WAYS.items()
        if way == declared or (by_bearings and _looks(first, then, shift, towards))
    ]


def may_turn(action: Action, first: Frame, then: Frame, shift: int) -> bool:
    """Whether a turn may lead from the first frame to the other one with this shift."""
    return bool(rotation_bits(first, then, shift) & _turned_by(action, first))


def ends(frame: Frame) -> list[str]:
    """List the directions in which the path of the robot ends at this place: "ahead", "behind".

    A path ends ahead if no gateway is straight ahead within twice its spread, and likewise behind.
    A path that leads through gateways declared opposite does not end.
    """
    if _way(frame) is not None:
        return []
    return [
        way
        for way, towards in (("ahead", 0), ("behind", 180))
        if not any(
            _near(bearing - towards, 2 * spread)
            for bearing, spread in zip(frame.bearings, frame.spreads, strict=True)
        )
    ]


def heading(first: Frame, then: Frame, shift: int) -> int:
    """Return the middle of the possible rotations in degrees clockwise; 0 if all or none are."""
    return middle_of_bits(rotation_bits(first, then, shift)) if first.slots == then.slots else 0


def middle_of_bits(found: int) -> int:
    """Return the middle of the longest interval in a set of rotations; 0 if it is full or empty."""
    starts = [r for r in members(found) if not found >> (r - 1) % 360 & 1]
    lengths = {
        start: next(length for length in range(1, 361) if not found >> (start + length) % 360 & 1)
        for start in starts
    }
    longest = max(starts, key=lambda start: lengths[start], default=0)
    return (longest + (lengths.get(longest, 1) - 1) // 2) % 360


def members(found: int) -> list[int]:
    """List the rotations in a set, in degrees."""
    return [r for r in range(360) if found >> r & 1]


def _turned_by(action: Action, first: Frame) -> int:
    """Return the set of rotations by which a turn may rotate a robot that sees a frame."""
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
    begin = 0 if action.turn == "right" else 180
    return _of(range(begin + LEAST_TURN + 1, begin + 180 - LEAST_TURN))


def _declared(first: Frame, then: Frame, shift: int) -> str | None:
    """Say how the robot faces along its path in the later frame, by slots declared opposite.

    It is "alike" if it faces the same direction of the path as in the first frame, "opposite" if
    the opposite one; None if declared slots do not decide this.
    """
    here, there = _way(first), _way(then)
    if here is None or there is None or not rotation_bits(first, then, shift):
        return None
    ahead, behind = ((slot + shift) % first.slots for slot in there)
    return "alike" if ahead == here[0] else "opposite" if behind == here[0] else None


def _way(frame: Frame) -> tuple[int, int] | None:
    """Find the slots ahead and behind of a robot, if they are declared opposite; None if not."""
    for ahead, behind in enumerate(frame.opposite):
        if behind is not None and (frame.faces(ahead) or frame.has_behind(behind)):
            return ahead, behind
    return None


def _looks(first: Frame, then: Frame, shift: int, towards: int) -> bool:
    """Whether bearings allow a rotation by exactly `towards` (0 or 180) degrees."""
    n = first.slots
    return all(
        _near(
            first.bearings[(k + shift) % n] - then.bearings[k] - towards,
            first.spreads[(k + shift) % n] + then.spreads[k],
        )
        for k in range(n)
    )


def _near(degrees: float, spread: float) -> bool:
    """Whether an angle is 0 to within a spread, both in degrees."""
    return abs((degrees + 180) % 360 - 180) <= spread + ROUNDING


@lru_cache(maxsize=2**14)
def _about(degrees: float, spread: float) -> int:
    """Return the rotations within `spread` of `degrees`, as a set. It is rounded outwards."""
    least, most = floor(degrees - spread + ROUNDING), ceil(degrees + spread - ROUNDING)
    return _of(r % 360 for r in range(least, most + 1))


def _of(degrees: Iterable[int]) -> int:
    """Make a set of rotations from a list of degrees."""
    found = 0
    for r in degrees:
        found |= 1 << r
    return found
