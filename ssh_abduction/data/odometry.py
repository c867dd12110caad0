"""Odometry: displacements, poses and closures, and a noise model of displacements.

>>> from ssh_abduction.data.odometry import Odometry
>>> covariance = Odometry(along=0.05, across=0.0, position=0.0).covariance((10.0, 0.0, 0.0))
>>> round(covariance[0][0], 3), round(covariance[1][1], 3)
(0.25, 0.0)

A displacement is (dx, dy, dtheta), in metres and radians, in the frame of the robot before it
moved: x ahead, y to the left, dtheta counterclockwise.

A closure says how two steps lie relative to each other, from a match of what was seen there:

>>> from ssh_abduction.data.odometry import Closure
>>> near = Closure(3, 19, (0.05, 0.05, 0.0), ((0.01, 0, 0), (0, 0.01, 0), (0, 0, 0.001)))
>>> str(near)
'the local maps of steps 3 and 19 match with an offset of 0.07 m'

It does not say that the two steps are at one place, but how far apart they are.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, TypeAlias

from ssh_abduction.data.checks import (
    a_list,
    a_number,
    a_whole_number,
    an_instance,
    an_object,
    finite,
)
from ssh_abduction.data.errors import TraceError, brief, named, said_of

Pose: TypeAlias = tuple[float, float, float]
Displacement: TypeAlias = tuple[float, float, float]
Covariance: TypeAlias = tuple[Displacement, Displacement, Displacement]

# The longest step in metres, and the largest turn in radians. Larger numbers are probably in other
# units.
FARTHEST, MOST_TURNED = 1000.0, 4 * math.pi
# The least standard deviation of a step, in metres and in radians, because logs round numbers.
ROUNDED = 1e-3
# The smallest and the largest variance, in square metres or square radians. Beyond these, rounding
# makes costs wrong.
LEAST_VARIANCE, MOST_VARIANCE = 1e-16, 1e16
# How much symmetric entries of a covariance may differ, as a share of its largest entry. Logs round
# these numbers, too.
SYMMETRIC = 1e-6


@dataclass(frozen=True, slots=True)
class Odometry:
    """The noise of displacements without a covariance, and systematic errors of all displacements.

    All numbers are standard deviations.

    Attributes:
        along: Error of position along a step, as a share of the step's length.
        across: Error of position across a step, as a share of the step's length.
        heading: Error of heading, in radians for each metre of a step.
        turning: Error of heading, as a share of the turn.
        position: Error of x and of y in each step, in metres.
        angle: Error of heading in each step, in radians.
        scale: Systematic error of all lengths, as a share; it is the same in the whole trace.
        bend: Systematic drift of heading, in radians per metre; it is the same in the whole trace.
        offset: Error of x and of y of a dstate (a place and a heading) at each visit, in metres.
            It does not accumulate along the way.
        facing: Error of the heading of a dstate at each visit, in radians.
        extra: Fields of the trace file that this package does not know.
    """

    along: float = 0.05
    across: float = 0.02
    heading: float = 0.005
    turning: float = 0.02
    position: float = 0.1
    angle: float = 0.02
    scale: float = 0.05
    bend: float = 0.0035
    offset: float = 0.0
    facing: float = 0.0
    extra: Mapping[str, Any] = field(default_factory=dict, compare=False, repr=False)

    def __post_init__(self) -> None:
        for name in NUMBERS:
            value, mend = getattr(self, name), "give a standard deviation"
            value = a_number(f"odometry.{name}", value, TraceError, 0, FARTHEST, mend=mend)
            object.__setattr__(self, name, value)
        an_object("odometry.extra", self.extra, TraceError)

    @classmethod
    def of(cls, value: Any) -> Odometry:
        """Make Odometry from a mapping with some of its fields. Others get their defaults.

        Raises:
            TraceError: If a field is wrong.
        """
        if isinstance(value, Odometry):
            return value
        an_object("odometry", value, TraceError, mend='write {"along": 0.05, "heading": 0.005}')
        known = {name: value[name] for name in NUMBERS if value.get(name) is not None}
        return cls(**known, extra={name: v for name, v in value.items() if name not in NUMBERS})

    def to_json(self) -> dict[str, Any]:
        """Return the fields as a dict, as the header of a trace file has them."""
        return {**{name: v for name, v in asdict(self).items() if name in NUMBERS}, **self.extra}

    def covariance(self, displacement: Displacement) -> Covariance:
        """Return the covariance of a displacement without its systematic errors.

        Args:
            displacement: (dx, dy, dtheta), in metres and radians.

        Returns:
            Three rows of three numbers, in metres and radians, in the frame of the robot before it
            moved.
        """
        dx, dy, turned = checked_displacement(displacement)
        # Variances along and across the way, turned into the frame of the robot.
        along = (self.along * dx) ** 2 + (self.along * dy) ** 2
        across = (self.across * dx) ** 2 + (self.across * dy) ** 2
        way = math.hypot(dx, dy)
        cos, sin = (dx / way, dy / way) if way else (1.0, 0.0)
        offset = self.position**2 + ROUNDED**2
        xx = along * cos**2 + across * sin**2 + offset
        yy = along * sin**2 + across * cos**2 + offset
        mixed = (along - across) * cos * sin
        heading = (
            (self.heading * way) ** 2 + (self.turning * turned) ** 2 + self.angle**2 + ROUNDED**2
        )
        return (xx, mixed, 0.0), (mixed, yy, 0.0), (0.0, 0.0, heading)


NUMBERS = tuple(f.name for f in fields(Odometry) if f.name != "extra")


def checked_displacement(value: Any) -> Displacement:
    """Return (dx, dy, dtheta) in metres and radians as floats, or raise TraceError."""
    if hasattr(value, "tolist"):
        value = value.tolist()  # numpy's
    if not _is_triple(value):
        raise TraceError(
            f"displacement: expected [dx, dy, dtheta], got {brief(value)}; "
            "give metres, metres, radians"
        )
    dx, dy, turned = (finite(x, f"displacement[{i}]") for i, x in enumerate(value))
    if max(abs(dx), abs(dy)) > FARTHEST:
        raise TraceError(
            f"displacement: expected metres, at most {FARTHEST:,.0f} in a step, "
            f"got {brief(list(value))}; convert it to metres"
        )
    if abs(turned) > MOST_TURNED:
        raise TraceError(
            f"displacement[2]: expected radians, from {-MOST_TURNED:.1f} to {MOST_TURNED:.1f}, "
            f"got {brief(value[2])}; convert it from degrees"
        )
    return dx, dy, turned


def checked_covariance(value: Any) -> Covariance:
    """Return a symmetric, positive definite covariance as 3 x 3 floats, or raise TraceError."""
    if hasattr(value, "tolist"):
        value = value.tolist()  # numpy's
    if not _is_triple(value) or not all(map(_is_triple, value)):
        raise TraceError(
            f"covariance: expected three rows of three numbers, got {brief(value)}; "
            f"give the covariance of [dx, dy, dtheta]"
        )
    (a, b, c), (d, e, f), (g, h, k) = (
        [finite(x, f"covariance[{i}][{j}]") for j, x in enumerate(row)]
        for i, row in enumerate(value)
    )
    largest = max(abs(x) for x in (a, b, c, d, e, f, g, h, k))
    if max(abs(b - d), abs(c - g), abs(f - h)) > SYMMETRIC * largest:
        raise TraceError(
            f"covariance: expected a symmetric matrix, got {brief(value)}; "
            f"mend the entries that differ"
        )
    if any(0 < x < LEAST_VARIANCE or x > MOST_VARIANCE for x in (a, e, k)):
        raise TraceError(
            f"covariance: expected variances from {LEAST_VARIANCE:g} to {MOST_VARIANCE:g}, got "
            f"{brief(value)}; give them in square metres and square radians"
        )
    # A matrix is positive definite if its leading minors are positive.
    minors = a, a * e - b * b, a * (e * k - f * f) - b * (b * k - f * c) + c * (b * f - e * c)
    if not all(minor > 0 for minor in minors) or not all(map(math.isfinite, minors)):
        raise TraceError(
            f"covariance: expected a positive definite matrix, got {brief(value)}; "
            f"give variances above 0, in square metres and square radians"
        )
    return (a, b, c), (b, e, f), (c, f, k)


def _is_triple(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str) and len(value) == 3


def moved(pose: Pose, displacement: Displacement) -> Pose:
    """Return the pose (x, y, heading) after a displacement in its frame, in metres and radians."""
    x, y, heading = pose
    dx, dy, turned = displacement
    cos, sin = math.cos(heading), math.sin(heading)
    return (
        x + cos * dx - sin * dy,
        y + sin * dx + cos * dy,
        math.remainder(heading + turned, math.tau),
    )


def displacement_between(start: Pose, end: Pose) -> Displacement:
    """Return the displacement from one pose to another, in the frame of the first pose.

    Its dtheta is the shorter of the two possible turns, in radians.
    """
    dx, dy = end[0] - start[0], end[1] - start[1]
    cos, sin = math.cos(start[2]), math.sin(start[2])
    return cos * dx + sin * dy, cos * dy - sin * dx, math.remainder(end[2] - start[2], math.tau)


def radians_between(a: float, b: float) -> float:
    """Return the angle between two directions in radians, from 0 to pi."""
    return abs((a - b + math.pi) % (2 * math.pi) - math.pi)


def in_words(displacement: Displacement) -> str:
    """Describe a displacement in words: metres to the nearest 0.1, and whole degrees.

    >>> in_words((4.1, -0.2, 0.0))
    '4.1 m ahead, 0.2 m right'
    """
    x, y, angle = displacement
    said = [
        f"{abs(value):.1f} m {ways[value < 0]}"
        for value, ways in ((x, ("ahead", "back")), (y, ("left", "right")))
        if round(abs(value), 1)
    ]
    if degrees := round(abs(math.degrees(angle))):
        said.append(f"turned {degrees} degrees {'left' if angle > 0 else 'right'}")
    return ", ".join(said) or "no move"


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
    what, mend = "a list of Closure", "make them with Closure.of"
    given = a_list(f"{where}: closures", value, TraceError, what=what, mend=mend)
    known: set[tuple[int, int]] = set()
    for i, closure in enumerate(given):
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
    return tuple(given)


def closures_among(closures: Sequence[Closure], steps: Sequence[int]) -> tuple[Closure, ...]:
    """Return the closures between these ascending steps. The steps are renumbered from 0."""
    number = {step: k for k, step in enumerate(steps)}
    return tuple(
        # Reuse a closure whose steps keep their numbers: making one checks its covariance.
        c if number[c.last] == c.last else replace(c, first=number[c.first], last=number[c.last])
        for c in closures
        if c.first in number and c.last in number
    )
