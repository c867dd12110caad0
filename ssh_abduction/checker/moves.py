"""Moves (links with their dstates), and the courses and headings of dstates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from ssh_abduction.data.map_parts import course_named
from ssh_abduction.data.maps import DState
from ssh_abduction.data.trace import Action

# A path and a direction, +1 or -1.
Course: TypeAlias = tuple[int, int]


@dataclass(frozen=True)
class MapLink:
    """A link of a map with its dstates.

    Attributes:
        step: The first step at which the action was done at the source.
        source: The dstate at which the action starts.
        action: The action.
        target: The dstate that the action leads to.
    """

    step: int
    source: DState
    action: Action
    target: DState

    @property
    def steps(self) -> tuple[int, int]:
        """The step at which the action starts, and the next one, at which it ends."""
        return self.step, self.step + 1

    def __str__(self) -> str:
        ends = f"from dstate {self.source.id} to dstate {self.target.id}"
        return f"{self.action.name!r} at step {self.step} {ends}"


def course_of(s: DState) -> Course | None:
    """Return the path of a dstate and its direction (+1 or -1); None if it lacks one of them."""
    return (s.path, s.direction) if s.path is not None and s.direction in (1, -1) else None


def opposite(course: Course) -> Course:
    """Return the same path in the other direction."""
    return course[0], -course[1]


def going(s: DState) -> str:
    """Describe the course of a dstate in words; "no path" if it has none."""
    course = course_of(s)
    return course_named(course) if course else "no path"


def heading_of(s: DState) -> int | None:
    """Return the heading of a dstate if it is a slot, 0 to 3; otherwise None."""
    return s.heading if s.heading in (0, 1, 2, 3) else None
