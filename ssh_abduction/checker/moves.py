"""Moves of a map, and the courses and headings of dstates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from ssh_abduction.data.maps import DState
from ssh_abduction.data.trace import Action

# A path and a direction, +1 or -1.
Course: TypeAlias = tuple[int, int]


@dataclass(frozen=True)
class Move:
    """An action that leads from one dstate to another, and the first step at which it was done."""

    step: int
    source: DState
    action: Action
    target: DState

    @property
    def steps(self) -> tuple[int, int]:
        """The steps before and after the action."""
        return self.step, self.step + 1

    def __str__(self) -> str:
        ends = f"from dstate {self.source.id} to dstate {self.target.id}"
        return f"{self.action.name!r} at step {self.step} {ends}"


def course_of(s: DState) -> Course | None:
    """The path and direction of a dstate that has both."""
    return (s.path, s.direction) if s.path is not None and s.direction in (1, -1) else None


def opposite(course: Course) -> Course:
    """The same path in the other direction."""
    return course[0], -course[1]


def along(course: Course) -> str:
    """A course in words."""
    return f"path {course[0]}{'+' if course[1] == 1 else '-'}"


def going(s: DState) -> str:
    """The course of a dstate in words."""
    course = course_of(s)
    return along(course) if course else "no path"


def heading_of(s: DState) -> int | None:
    """The heading of a dstate in a frame of four slots, if it is one."""
    return s.heading if s.heading in (0, 1, 2, 3) else None
