"""Closures: how two steps lie relative to each other, from a match of what was seen there.

>>> from ssh_abduction.data.closure import Closure
>>> near = Closure(3, 19, (0.05, 0.05, 0.0), ((0.01, 0, 0), (0, 0.01, 0), (0, 0, 0.001)))
>>> str(near)
'the local maps of steps 3 and 19 match with an offset of 0.07 m'

A closure does not say that the two steps are at one place. It says how far apart the steps are.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from ssh_abduction.data.checks import a_list, a_whole_number, an_instance
from ssh_abduction.data.errors import TraceError, brief, named, said_of
from ssh_abduction.data.odometry import (
    Covariance,
    Displacement,
    checked_covariance,
    checked_displacement,
)

_FIELDS = ("steps", "displacement", "covariance")


@dataclass(frozen=True, slots=True)
class Closure:
    """The pose at a later step, relative to the pose at an earlier one.

    Attributes:
        first: The earlier step.
        last: The later step.
        displacement: (dx, dy, dtheta) from the pose at the earlier step to the pose at the later
            one, in metres and radians, in the frame of the robot at the earlier step.
        covariance: The covariance of the displacement, 3 x 3.
    """

    first: int
    last: int
    displacement: Displacement
    covariance: Covariance

    def __post_init__(self) -> None:
        first = a_whole_number("steps[0]", self.first, TraceError, 0)
        last = a_whole_number("steps[1]", self.last, TraceError, 0)
        if first >= last:
            raise TraceError(
                f"steps: expected an earlier and a later step, got {first} and {last}; "
                f"swap them, and invert the displacement"
            )
        moved = checked_displacement(self.displacement)
        noise = checked_covariance(self.covariance)
        names = ("first", "last", "displacement", "covariance")
        for name, value in zip(names, (first, last, moved, noise), strict=True):
            object.__setattr__(self, name, value)

    def __str__(self) -> str:
        return match_in_words(self, self.first, self.last)

    @classmethod
    def of(cls, value: Any) -> Closure:
        """Make a closure from an object with the fields steps, displacement and covariance.

        Raises:
            TraceError: If a field is missing, unknown or wrong.
        """
        if isinstance(value, Closure):
            return value
        if not isinstance(value, Mapping) or set(value) != set(_FIELDS):
            raise TraceError(
                f"expected an object with {', '.join(_FIELDS)}, got {brief(value)}; "
                f'write {{"steps": [3, 19], "displacement": [0.1, 0, 0], "covariance": …}}'
            )
        steps = value["steps"]
        if not isinstance(steps, Sequence) or isinstance(steps, str) or len(steps) != 2:
            raise TraceError(
                f"steps: expected two steps, got {brief(steps)}; give an earlier and a later one"
            )
        return cls(steps[0], steps[1], value["displacement"], value["covariance"])

    def to_json(self) -> dict[str, Any]:
        """Return the closure as the header of a trace file has it."""
        return {
            "steps": [self.first, self.last],
            "displacement": list(self.displacement),
            "covariance": [list(row) for row in self.covariance],
        }


def match_in_words(closure: Closure, first: int, last: int) -> str:
    """Say how well the local maps of two steps match. `first` and `last` are the steps' names."""
    offset = math.hypot(*closure.displacement[:2])
    return f"the local maps of steps {first} and {last} match with an offset of {offset:.2f} m"


def parse_closures(value: Any) -> tuple[Closure, ...]:
    """Make closures from the list in the header of a trace file; none from None.

    Raises TraceError, which names the entry and the field.
    """
    if value is None:
        return ()
    found = []
    listed = a_list("closures", value, TraceError, mend="leave it out for none")
    for i, entry in enumerate(listed):
        with said_of(f"closures[{i}]"):
            found.append(Closure.of(entry))
    return tuple(found)


def checked_closures(value: Any, steps: int, source: str | None) -> tuple[Closure, ...]:
    """Return closures if they are valid for a trace of `steps` steps, or raise TraceError.

    Each pair of steps may have only one closure.
    """
    where = named(source or "trace")
    if not isinstance(value, Sequence) or isinstance(value, str | bytes):
        raise TraceError(
            f"{where}: closures: expected a list of Closure, got {brief(value)}; make them with "
            f"Closure.of"
        )
    known: set[tuple[int, int]] = set()
    for i, closure in enumerate(value):
        at = f"{where}: closures[{i}]"
        an_instance(at, closure, Closure, TraceError, mend="make one with Closure.of")
        if closure.last >= steps:
            raise TraceError(
                f"{at}: steps: expected steps from 0 to {steps - 1}, got {closure.last}; "
                f"steps are counted from 0"
            )
        if (closure.first, closure.last) in known:
            raise TraceError(
                f"{at}: steps: expected each pair once, got {closure.first} and "
                f"{closure.last} twice; leave one out"
            )
        known.add((closure.first, closure.last))
    return tuple(value)


def closures_among(closures: Sequence[Closure], steps: Sequence[int]) -> tuple[Closure, ...]:
    """Return the closures between these ascending steps. The steps are renumbered from 0."""
    number = {step: k for k, step in enumerate(steps)}
    return tuple(
        # Reuse a closure whose steps keep their numbers: making one checks its covariance.
        c if number[c.last] == c.last else replace(c, first=number[c.first], last=number[c.last])
        for c in closures
        if c.first in number and c.last in number
    )
