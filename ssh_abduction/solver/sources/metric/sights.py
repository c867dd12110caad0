"""Says what each step shows of its dstate and place, and what a change of gateways costs."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator, Mapping
from functools import lru_cache, partial
from itertools import combinations, pairwise, product
from typing import TypeAlias

import numpy as np

from ssh_abduction.data.drives import starts_of
from ssh_abduction.data.groups import numbered
from ssh_abduction.data.star import Frame, Star
from ssh_abduction.data.trace import Step, Trace
from ssh_abduction.solver.steps.frames import may_face, members, rotation_bits
from ssh_abduction.solver.steps.log import observation
from ssh_abduction.theory.fields import FAULT
from ssh_abduction.theory.theory import Theory

# What a step shows of its place.
Sight: TypeAlias = Star | tuple[bool, ...] | None

# Do not extend a hypothesis in a way that costs this many nats more than its cheapest extension.
DEAREST = 20.0
# If gateways may change between drives, an extension may also cost the price of this many changes.
CHANGES = 2


class Sights:
    """What each step of a trace shows.

    Attributes:
        seen: What each step shows of its dstate, as a number: its observation, or only its view if
            gateways may change between drives. An unknown view agrees with every view.
        shown: What each step shows of its place, whichever way it faces: its star, or None without
            stars. A star of four openings is turned to a normal form.
        drive: The number of the drive of each step.
        doubts: For each step, the nats of treating its view as misread; inf if that is forbidden.
        dearest: The most nats by which an extension of a hypothesis may cost more than its cheapest
            extension.
    """

    def __init__(self, trace: Trace, theory: Theory) -> None:
        """Read the views and stars of all steps.

        The theory's field `changed`, times FAULT nats, is the cost of a changed gateway. If it
        allows misread views, stars may be wrong, too. Then any step may be at any place.
        """
        starts = starts_of(trace)
        shows = [
            (step.view, None) if theory.changed else observation(step, theory)
            for step in trace.steps
        ]
        self.seen, self._shows = numbered(shows), [*dict.fromkeys(shows)]
        self._has_unknown = None in trace.views
        # In a causal theory, a place is a dstate, so star=alike compares the stars of places, too.
        is_alike = theory.star == "alike" and theory.level == "causal"
        star = "gateways" if is_alike else theory.star
        self.shown = [_shown(step, star) for step in trace.steps]
        self._steps, self._star = trace.steps, theory.star
        self.drive = [bisect_right(starts, t) for t in range(len(trace))]
        self.doubts = [
            FAULT * theory.fault_tenths("misread", step) / 10 or math.inf for step in trace.steps
        ]
        self._misreads, self._price = theory.misread > 0, FAULT * theory.changed
        self.dearest = DEAREST + CHANGES * self._price

    def changes(self, seen: Mapping[int, Sight], t: int) -> float:
        """Return the nats for changed gateways if step t is at a place; inf if it cannot be.

        `seen` has what each drive saw of the place, the last drive last.
        """
        *_, (drive, last) = seen.items()
        return self._between(last, self.shown[t], is_one_drive=drive == self.drive[t])

    def misread(self, seen: Mapping[int, float]) -> float:
        """Return the cost in nats of the misread views at a dstate; inf if they are not allowed.

        `seen` has what steps there saw, as in the attribute `seen`, and the cost in nats of taking
        that as misread. What would cost most to take as misread is right (`right`).
        """
        return self._wrong(seen, self.right(seen)) if len(seen) > 1 else 0.0

    def merging(self, first: Mapping[int, float], second: Mapping[int, float]) -> float:
        """Return how many nats more misread views cost if two dstates are one; inf if forbidden."""
        if first.keys() == second.keys() and not self._misreads:
            return 0.0
        if not (self._misreads or self._has_unknown):
            return math.inf
        cost = self.misread(seen_at_both(first, second))
        return cost - self.misread(first) - self.misread(second)

    def right(self, seen: Mapping[int, float]) -> int:
        """Return what steps at a dstate saw rightly, if the misread views cost the least nats."""
        known = [number for number in seen if self._shows[number][0] is not None]
        return min(known or seen, key=partial(self._wrong, seen))

    def example(self, number: int) -> Step:
        """Return the first step that shows what has a number in `seen`."""
        return self._steps[self.seen.index(number)]

    def _wrong(self, seen: Mapping[int, float], right: int) -> float:
        """Return the cost in nats of the views at a dstate that differ from the right one."""
        view, star = self._shows[right]
        return sum(
            nats
            for number, nats in seen.items()
            if number != right and self._shows[number] not in ((view, star), (None, star))
        )

    def merged(self, first: Mapping[int, Sight], second: Mapping[int, Sight]) -> float:
        """Return by how many nats changed gateways cost more if two places are one.

        The result is inf if they cannot be one. `first` and `second` have what each drive saw at
        one of the places, as in `shown`.
        """
        one, other = {*first.values()}, {*second.values()}
        if len(one) == len(other) == 1:  # mostly
            if agree(*one, *other):
                return 0.0
            if not self._price:
                return math.inf
        if any(not agree(first[drive], second[drive]) for drive in first.keys() & second.keys()):
            return math.inf
        return self.along({**first, **second}) - self.along(first) - self.along(second)

    def are_alike(self, first: Sight, second: Sight) -> bool:
        """Whether two steps that see these stars, not turned, may be at one dstate of a place."""
        if not isinstance(first, Star) or not isinstance(second, Star):
            return True  # the views, and the stars of four, are compared as `seen`
        return _may_face_alike(first, second, CHANGES if self._price else 0)

    def turns(self, t: int, u: int) -> Iterator[float]:
        """Yield by how much the robot may turn from step t to step u, if both are at one place.

        The turns are in radians, counterclockwise. Gateways do not change between the steps. Only
        stars with directions (frame, gateways) determine turns.
        """
        first, then = self._steps[t], self._steps[u]
        if self._star == "frame" and first.openings and then.openings:
            for k in range(4):
                if then.openings == first.openings[k:] + first.openings[:k]:
                    yield -k * math.pi / 2
        elif self._star == "gateways" and first.gateways and then.gateways:
            for frame, other in _equally_large(first.gateways, then.gateways):
                for shift in range(frame.slots):
                    if degrees := [*members(rotation_bits(frame, other, shift))]:
                        angles = np.radians(degrees)
                        yield -math.atan2(np.sin(angles).sum(), np.cos(angles).sum())

    def along(self, seen: Mapping[int, Sight]) -> float:
        """Return the cost in nats of the changes from each drive to the next at one place."""
        between = pairwise(seen[drive] for drive in sorted(seen))
        return sum(self._between(was, now, is_one_drive=False) for was, now in between)

    def _between(self, sight: Sight, own: Sight, *, is_one_drive: bool) -> float:
        """Return the cost in nats of the changes between two sights (seen stars) of a place."""
        if self._misreads or agree(sight, own):
            return 0.0
        if not self._price or is_one_drive:
            return math.inf
        if isinstance(sight, Star) and isinstance(own, Star):
            return self._price * _fewest_closed(sight, own)
        if not isinstance(sight, tuple) or not isinstance(own, tuple):
            return math.inf
        return self._price * _fewest_changes(sight, own)


def _shown(step: Step, star: str) -> Sight:
    """Return the star of a step in a form that all steps at its place share; None without stars."""
    if star == "gateways":
        return step.gateways or Star(())
    seen = step.openings if star in ("pattern", "frame") else None
    return None if seen is None else min(seen[k:] + seen[:k] for k in range(4))


def agree(first: Sight, second: Sight) -> bool:
    """Whether two steps that show these stars may be at one place."""
    if isinstance(first, Star) and isinstance(second, Star):
        return _may_fit(first, second)
    return first == second


@lru_cache(maxsize=2**14)
def _fewest_changes(first: tuple[bool, ...], second: tuple[bool, ...]) -> int:
    """Return the fewest openings that differ between two stars of four, over all rotations."""
    return min(
        sum(a != b for a, b in zip(first, second[k:] + second[:k], strict=True)) for k in range(4)
    )


@lru_cache(maxsize=2**14)
def _fewest_closed(first: Star, second: Star) -> float:
    """Return the fewest changed gateways that explain both stars; inf if more than CHANGES."""
    return next(
        (
            count
            for count in range(1, CHANGES + 1)
            if any(_turns(*frames) for frames in _without(first, second, count))
        ),
        math.inf,
    )


@lru_cache(maxsize=2**14)
def _smaller(star: Star, less: int) -> tuple[Frame, ...]:
    """List the frames of a star without `less` gateways: one frame for each choice of these."""
    return tuple(
        Frame(
            tuple(frame.bearings[k] for k in kept),
            tuple(frame.spreads[k] for k in kept),
            (None,) * len(kept),
        )
        for frame in star.frames
        if frame.slots >= less
        for kept in combinations(range(frame.slots), frame.slots - less)
    )


@lru_cache(maxsize=2**14)
def _may_face_alike(first: Star, second: Star, changes: int) -> bool:
    """Whether a robot may face one way at two stars, if up to `changes` gateways changed."""
    return any(
        "alike" in may_face(frame, other, shift)
        for frame, other in _equally_large(first, second)
        for shift in range(max(frame.slots, 1))
    ) or any(
        rotation_bits(frame, other, shift) & 1
        for count in range(1, changes + 1)
        for frame, other in _without(first, second, count)
        for shift in range(max(frame.slots, 1))
    )


def _without(first: Star, second: Star, count: int) -> Iterator[tuple[Frame, Frame]]:
    """Leave out `count` gateways of two stars in all. Yield pairs of frames of equal size."""
    for less in range(count + 1):
        for frame, other in product(_smaller(first, less), _smaller(second, count - less)):
            if frame.slots == other.slots:
                yield frame, other


def _equally_large(first: Star, second: Star) -> Iterator[tuple[Frame, Frame]]:
    """Yield the pairs of frames of two stars that have equally many gateways."""
    pairs = product(first.frames, second.frames)
    return ((frame, other) for frame, other in pairs if frame.slots == other.slots)


def seen_at_both(first: Mapping[int, float], second: Mapping[int, float]) -> dict[int, float]:
    """Return what steps at two dstates saw, as `Sights.misread` takes it."""
    return {n: first.get(n, 0.0) + second.get(n, 0.0) for n in [*first, *second]}


def _turns(frame: Frame, other: Frame) -> bool:
    """Whether two frames agree with some shift of their gateways."""
    return any(rotation_bits(frame, other, shift) for shift in range(max(frame.slots, 1)))


@lru_cache(maxsize=2**14)
def _may_fit(first: Star, second: Star) -> bool:
    """Whether two stars agree with some shift of their gateways."""
    return any(_turns(*frames) for frames in _equally_large(first, second))
