"""Find by which angles a robot may have turned between two frames of one place.

A frame is the gateways that are seen at a step, each with a bearing in tolerance (`star.py`). The
gateways of two frames match in clockwise order, by some shift of their slots.

>>> from ssh_abduction.data.star import Star
>>> corner = Star.of((0, 120)).frames[0]
>>> min(rotations(corner, corner, 0)), max(rotations(corner, corner, 0))
(0, 359)
>>> rotations(corner, corner, 1)
frozenset()
"""

from __future__ import annotations

import math
from collections.abc import Collection
from functools import lru_cache

from ssh_abduction.data.star import ROUNDING, SPREAD, Frame, angle_between
from ssh_abduction.data.trace import Action


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
    gateways = list(zip(before.bearings, before.spreads, strict=True))
    is_ahead = [angle_between(bearing, 0) <= spread + ROUNDING for bearing, spread in gateways]
    if action.gateway is not None:
        beside = [gateways[k] for k in range(before.slots) if not is_ahead[k]]
        if action.turn == "left":
            beside.reverse()
        return action.gateway <= len(beside) and bool(found & arc(*beside[action.gateway - 1]))
    if action.turn == "around":
        others = zip(is_ahead, before.opposite, strict=True)
        behind = [gateways[k] for ahead, k in others if ahead and k is not None]
        return any(found & arc(*gateway) for gateway in [(180, 0), *behind[:1]])
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
    for k, (bearing, spread, other) in enumerate(
        zip(frame.bearings, frame.spreads, frame.opposite, strict=True)
    ):
        if other is not None and (
            angle_between(bearing, 0) <= spread + ROUNDING
            or angle_between(frame.bearings[other], 180) <= frame.spreads[other] + ROUNDING
        ):
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
